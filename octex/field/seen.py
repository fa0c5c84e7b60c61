"""What looks show, weighed as it is blended: by areas, by what mixes facings, by what faces a normal.

These are the stages and the sink (`stages`, `sinks`) in one pass over the taps, where no other stage comes
between them: taps are neither written anew nor read again.
"""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s, Int32s, Uint8s
from octex.field.sinks import Codes, Flat, Sums, flat_of
from octex.field.stages import (
    AREA_WEIGHTS,
    NEAR_ROWS,
    Facings,
    direction_of,
    parts_of,
    shares_of,
    unit_of,
)
from octex.field.taps import OFF, Taps
from octex.jit import decoded, fused_kernel, inlined, popcount, prefetch, trailing_zeros
from octex.tree.layout import SPLIT

#: Points whose split cells are asked for before any is read.
_GROUP = 64

Five = tuple[float, float, float, float, float]


@inlined
def _added(five: Five, flat: Flat, of_split: bool, row: int, weight: np.float32, components: int) -> Five:
    """Add a row times a weight to four components, and the weight to the fifth."""
    a, b, c, d, total = five
    factor, at, table = np.float64(weight), np.uint64(row * components), flat.table
    values = flat.split if of_split else flat.values
    a += factor * np.float64(decoded(table, values[at]))
    if components > 1:
        b += factor * np.float64(decoded(table, values[at + np.uint64(1)]))
    if components > 2:
        c += factor * np.float64(decoded(table, values[at + np.uint64(2)]))
    if components > 3:
        d += factor * np.float64(decoded(table, values[at + np.uint64(3)]))
    return a, b, c, d, total + factor


@inlined
def _average(
    taps: Taps, n: int, areas: Uint8s, mixed: Uint8s, is_mixed: bool, flat: Flat, components: int
) -> tuple[Five, float]:
    """Sum the averages of a point up but for those that mix facings; return also the weight of all."""
    five, total = (0.0, 0.0, 0.0, 0.0, 0.0), 0.0
    for tap in range(taps.starts[n], taps.ends[n]):
        row = np.uint64(taps.rows[np.uint64(tap)])
        weight = taps.weights[np.uint64(tap)]
        if areas.size > 0:
            weight *= AREA_WEIGHTS[np.uint64(areas[row])]
        total += np.float64(weight)
        if is_mixed:
            weight *= np.float32(np.uint8(1) - mixed[row])
        five = _added(five, flat, False, int(row), weight, components)
    return five, total


@inlined
def _ask_for_split(taps: Taps, begin: int, end: int, facings: Facings, codes: Codes, split: Uint8s) -> None:
    """Ask for the rows of the split cells of a group of points, and note which points have any."""
    for n in range(begin, end):
        seen = np.uint8(0)
        for tap in range(taps.starts[np.uint64(n)], taps.ends[np.uint64(n)]):
            seen |= facings.flags[np.uint64(taps.rows[np.uint64(tap)])]
        split[np.uint64(n - begin)] = seen & np.uint8(SPLIT)
    for n in range(begin, end if facings.rows.size > NEAR_ROWS else begin):
        if split[np.uint64(n - begin)] != 0:
            for tap in range(taps.starts[np.uint64(n)], taps.ends[np.uint64(n)]):
                prefetch(facings.rows, int(taps.rows[np.uint64(tap)]))
    for n in range(begin, end):
        if split[np.uint64(n - begin)] != 0:
            for tap in range(taps.starts[np.uint64(n)], taps.ends[np.uint64(n)]):
                row = np.uint64(taps.rows[np.uint64(tap)])
                if facings.flags[row] >= np.uint8(SPLIT):
                    prefetch(codes.split_values, int(facings.rows[row]))


@inlined
def _facing(
    taps: Taps,
    n: int,
    areas: Uint8s,
    facings: Facings,
    normals: Float32s,
    parts: Float32s,
    shares: Float32s,
    wanted: Uint8s,
    is_split: bool,
    flat: Flat,
    components: int,
) -> Five:
    """Sum up what faces the normal of a point: see `stages.face`."""
    x, y, z, signs = unit_of(normals, n)
    parts_of(parts, x, y, z)
    none, one = np.float32(0.0), np.uint64(1)
    known = np.uint8(1)
    last = flat.split.size // components - 1
    five = (0.0, 0.0, 0.0, 0.0, 0.0)
    for tap in range(taps.starts[n], taps.ends[n]):
        row = np.uint64(taps.rows[np.uint64(tap)])
        flags = facings.flags[row]
        bits = direction_of(signs, flags)
        weight = taps.weights[np.uint64(tap)] * parts[np.uint64(bits)]
        if areas.size > 0:
            weight *= AREA_WEIGHTS[np.uint64(areas[row])]
        left = np.uint8(0)
        if is_split and flags >= np.uint8(SPLIT) and bits < np.uint8(8):
            if known >> bits & np.uint8(1) == 0:
                known |= np.uint8(1) << bits
                a, b, c = x if bits & 1 else none, y if bits & 2 else none, z if bits & 4 else none
                shares[bits, 0], shares[bits, 1], shares[bits, 2] = a, b, c = shares_of(a, b, c)
                wanted[bits] = int(a > none) | int(b > none) << 1 | int(c > none) << 2
            left = wanted[np.uint64(bits)]
        if left == 0:
            five = _added(five, flat, False, int(row), weight, components)
            continue
        first = np.int64(facings.rows[row])
        while left != 0:
            axis = trailing_zeros(np.uint64(left))
            left &= left - np.uint8(1)
            below = (one << np.uint64(2 * axis + (signs >> axis & 1))) - one
            own = min(int(first) + popcount(np.uint64(flags) & below), last)
            share = weight * shares[np.uint64(bits), np.uint64(axis)]
            five = _added(five, flat, True, own, share, components)
    return five


@inlined
def _add_to(sums: Sums, owner: np.uint64, factor: float, five: Five, components: int) -> None:
    sums.values[owner, 0] += factor * five[0]
    if components > 1:
        sums.values[owner, 1] += factor * five[1]
    if components > 2:
        sums.values[owner, 2] += factor * five[2]
    if components > 3:
        sums.values[owner, 3] += factor * five[3]
    sums.totals[owner] += factor * five[4]


@fused_kernel
def add_averages(
    taps: Taps,
    areas: Uint8s,
    mixed: Uint8s,
    codes: Codes,
    owners: Int32s,
    shares: Float32s,
    left: Float32s,
    sums: Sums,
) -> None:
    """Add the averages that looks show, times their shares, to the sums of the points that own them.

    The taps are cells, which weigh by their ``areas`` if there are any. Those in ``mixed``, (cells,) or (0,),
    weigh nothing, and ``left`` (looks,) takes the part of the weight that is taken away.
    """
    flat, components = flat_of(codes), codes.values.shape[1]
    is_mixed = mixed.size > 0
    for n in range(taps.starts.size):
        if components == 3:
            if is_mixed:
                five, total = _average(taps, n, areas, mixed, True, flat, 3)
            else:
                five, total = _average(taps, n, areas, mixed, False, flat, 3)
        else:
            five, total = _average(taps, n, areas, mixed, is_mixed, flat, components)
        at = np.uint64(n)
        factor = np.float64(shares[at])
        if is_mixed:
            left[at] = (total - five[4]) / total if total > five[4] else 0.0
        if areas.size > 0 and taps.covers[at] == np.float32(0.0) and total > 0.0:
            factor *= np.float64(OFF) / total
        _add_to(sums, np.uint64(owners[at]), factor, five, components)


@fused_kernel
def add_facing(
    taps: Taps,
    areas: Uint8s,
    facings: Facings,
    normals: Float32s,
    codes: Codes,
    owners: Int32s,
    shares: Float32s,
    sums: Sums,
) -> None:
    """Add what faces the normals (looks, 3), times the looks' shares, to the sums of who owns them.

    The taps are cells, which weigh by their ``areas`` if there are any.
    """
    flat, components = flat_of(codes), codes.values.shape[1]
    parts, of_rows = np.zeros(9, np.float32), np.zeros((8, 3), np.float32)
    wanted, split = np.zeros(9, np.uint8), np.zeros(_GROUP, np.uint8)
    for begin in range(0, taps.starts.size, _GROUP):
        end = min(begin + _GROUP, taps.starts.size)
        if facings.rows.size > 0:
            _ask_for_split(taps, begin, end, facings, codes, split)
        for n in range(begin, end):
            room = normals, parts, of_rows, wanted
            if components == 3:
                if split[np.uint64(n - begin)] != 0:
                    five = _facing(taps, n, areas, facings, *room, True, flat, 3)
                else:
                    five = _facing(taps, n, areas, facings, *room, False, flat, 3)
            else:
                is_split = split[np.uint64(n - begin)] != 0
                five = _facing(taps, n, areas, facings, *room, is_split, flat, components)
            at = np.uint64(n)
            factor = np.float64(shares[at])
            if areas.size > 0 and taps.covers[at] == np.float32(0.0):
                factor *= _to_off(taps, n, areas)
            _add_to(sums, np.uint64(owners[at]), factor, five, components)


@inlined
def _to_off(taps: Taps, n: int, areas: Uint8s) -> float:
    """Return what makes the weights of a point off the surface, by areas, sum to OFF."""
    total = 0.0
    for tap in range(taps.starts[n], taps.ends[n]):
        row = np.uint64(taps.rows[np.uint64(tap)])
        total += np.float64(taps.weights[np.uint64(tap)] * AREA_WEIGHTS[np.uint64(areas[row])])
    return np.float64(OFF) / total if total > 0.0 else 1.0
