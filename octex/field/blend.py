"""Blends taps in double precision, adds probes up, and lists taps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Uint32s
from octex.field.taps import (
    AT_ONCE,
    NO_FIVE,
    OFF,
    Codes,
    Five,
    Flat,
    Four,
    TapList,
    Taps,
    end_of,
    flat_of,
    put_value,
    value_at,
    value_of,
    with_row,
)
from octex.field.weights import NO_VIEW, Weighing, find_split, new_visible, view_of, weigh
from octex.jit import by_constants, fused_kernel, fused_part, inlined, kernel, part, prefetch

Three = tuple[float, float, float]


@inlined
def _prefetch_rows(taps: Taps, begin: int, end: int, codes: Codes) -> None:
    """Prefetch every other row of a group of points: the rows between share its cache lines."""
    first_kept = codes.values.shape[0]
    first_row = first_kept + codes.kept_values.shape[0]
    for n in range(begin, end):
        for tap in range(taps.starts[n], taps.ends[n], 2):
            row = int(taps.rows[np.uint64(tap)])
            if row < first_kept:
                prefetch(codes.values, row)
            else:
                prefetch(codes.split_values, row - first_row)


@by_constants
@inlined
def _sum(taps: Taps, n: int, flat: Flat, components: int) -> Five:
    """Return Σ w·v of up to four components, and Σ w."""
    five = NO_FIVE
    for tap in range(taps.starts[n], taps.ends[n]):
        row, weight = int(taps.rows[np.uint64(tap)]), taps.weights[np.uint64(tap)]
        five = with_row(five, flat, row, weight, components)
    return five


@inlined
def _sum_any(taps: Taps, n: int, flat: Flat, components: int) -> Five:
    if components == 3:
        return _sum(taps, n, flat, 3)
    if components == 1:
        return _sum(taps, n, flat, 1)
    if components == 2:
        return _sum(taps, n, flat, 2)
    return _sum(taps, n, flat, 4)


@part
def gather(rows: Uint32s, codes: Codes, results: Float32s) -> None:
    """Write the values of cells ``rows`` (points,)."""
    flat, components = flat_of(codes), codes.values.shape[1]
    flat_results = results.reshape(-1)
    for n in range(rows.size):
        a, b, c, d = value_of(flat, int(rows[np.uint64(n)]), components)
        put_value(flat_results, n * components, components, a, b, c, d)


@by_constants
@fused_kernel
def blend(taps: Taps, codes: Codes, is_prefetched: bool, results: Float32s) -> None:
    """Write the weighted mean (points, components): Σ w·v / Σ w. ``is_prefetched``: the rows already are."""
    flat, components = flat_of(codes), codes.values.shape[1]
    flat_results = results.reshape(-1)
    for begin in range(0, taps.starts.size, AT_ONCE):
        end = min(begin + AT_ONCE, taps.starts.size)
        if not is_prefetched:
            _prefetch_rows(taps, begin, end, codes)
        for n in range(begin, end):
            if taps.ends[n] - taps.starts[n] == 1:
                a, b, c, d = value_of(flat, int(taps.rows[taps.starts[n]]), components)
                put_value(flat_results, n * components, components, a, b, c, d)
                continue
            a, b, c, d, total = _sum_any(taps, n, flat, components)
            inverse = 1.0 / total if total > 0.0 else 0.0
            a, b, c, d = a * inverse, b * inverse, c * inverse, d * inverse
            put_value(flat_results, n * components, components, a, b, c, d)


@inlined
def _sum_slopes(
    taps: Taps, n: int, flat: Flat, components: int, mean: Four
) -> tuple[Three, Three, Three, Three, Three]:
    """Return Σ w′·(v − mean) by position of up to four components, and Σ w′."""
    ax = ay = az = bx = by = bz = cx = cy = cz = dx = dy = dz = ox = oy = oz = 0.0
    for tap in range(taps.starts[n], taps.ends[n]):
        at = np.uint64(tap)
        x, y = np.float64(taps.slopes[at, 0]), np.float64(taps.slopes[at, 1])
        z = np.float64(taps.slopes[at, 2])
        p, q, r, s = value_of(flat, int(taps.rows[at]), components)
        ox, oy, oz = ox + x, oy + y, oz + z
        p -= mean[0]
        ax, ay, az = ax + x * p, ay + y * p, az + z * p
        if components > 1:
            q -= mean[1]
            bx, by, bz = bx + x * q, by + y * q, bz + z * q
        if components > 2:
            r -= mean[2]
            cx, cy, cz = cx + x * r, cy + y * r, cz + z * r
        if components > 3:
            s -= mean[3]
            dx, dy, dz = dx + x * s, dy + y * s, dz + z * s
    return (ax, ay, az), (bx, by, bz), (cx, cy, cz), (dx, dy, dz), (ox, oy, oz)


@fused_kernel
def blend_slopes(taps: Taps, codes: Codes, scale: float, results: Float32s, gradients: Float32s) -> None:
    """Write the derivatives of the known mean: Σ w′·(v − mean) / Σ w, times ``scale``.

    Those of constants are zero, however the weights are rounded.
    """
    flat, components = flat_of(codes), codes.values.shape[1]
    flat_results = results.reshape(-1)
    for n in range(taps.starts.size):
        total = 0.0
        for tap in range(taps.starts[n], taps.ends[n]):
            total += np.float64(taps.weights[np.uint64(tap)])
        factor = scale / total if total > 0.0 else 0.0
        mean = value_at(flat_results, flat.table, np.uint64(n * components), components)
        slopes = _sum_slopes(taps, n, flat, components, mean)
        for component in range(components):
            for axis in range(3):
                gradients[n, component, axis] = slopes[component][axis] * factor


class ProbeSums(NamedTuple):
    """Sums over the probes at several levels, by the point that owns the probes."""

    values: Float64s  # (points, components)
    totals: Float64s  # (points,)   of the weights
    slopes: Float64s  # (points, components, 3) or (0, components, 3)
    total_slopes: Float64s  # (points, 3) or (0, 3)


@kernel
def new_sums(points: int, answers: Float32s, gradient: bool) -> ProbeSums:
    """Return zeros for the components of ``answers``."""
    n, components = points if gradient else 0, answers.shape[1]
    return ProbeSums(
        np.zeros((points, components), np.float64),
        np.zeros(points, np.float64),
        np.zeros((n, components, 3), np.float64),
        np.zeros((n, 3), np.float64),
    )


@inlined
def _add_to(sums: ProbeSums, owner: np.uint64, factor: float, five: Five, components: int) -> None:
    """Add a sum times a factor to those of a point."""
    sums.values[owner, 0] += factor * five[0]
    if components > 1:
        sums.values[owner, 1] += factor * five[1]
    if components > 2:
        sums.values[owner, 2] += factor * five[2]
    if components > 3:
        sums.values[owner, 3] += factor * five[3]
    sums.totals[owner] += factor * five[4]


@by_constants
@fused_kernel
def add_up(
    taps: Taps, codes: Codes, owners: Int32s, shares: Float32s, share_slopes: Float32s, sums: ProbeSums
) -> None:
    """Add the blends of probes, times their shares, to the sums of their owners.

    ``share_slopes`` (probes, 3) are the derivatives of the shares, for gradients.
    """
    flat, components = flat_of(codes), codes.values.shape[1]
    gradient = sums.total_slopes.shape[0] > 0
    for begin in range(0, taps.starts.size, AT_ONCE):
        end = min(begin + AT_ONCE, taps.starts.size)
        _prefetch_rows(taps, begin, end, codes)
        for n in range(begin, end):
            five = _sum_any(taps, n, flat, components)
            owner = np.uint64(owners[np.uint64(n)])
            share = np.float64(shares[np.uint64(n)])
            _add_to(sums, owner, share, five, components)
            if gradient:
                slopes = _sum_slopes(taps, n, flat, components, (0.0, 0.0, 0.0, 0.0))
                for axis in range(3):
                    share_slope = np.float64(share_slopes[n, axis])
                    sums.total_slopes[owner, axis] += share * slopes[4][axis] + share_slope * five[4]
                    for component in range(components):
                        sums.slopes[owner, component, axis] += (
                            share * slopes[component][axis] + share_slope * five[component]
                        )


@fused_part
def add_weighed(
    taps: Taps,
    weighing: Weighing,
    normals: Float32s,
    codes: Codes,
    owners: Int32s,
    shares: Float32s,
    passed: Float32s,
    sums: ProbeSums,
) -> None:
    """Weigh and add up at once: `weights.weigh_taps`, then `add_up`, for taps that are cells.

    Taps are not written and read again, which saves a fifth of the time. ``passed`` (probes,) as there.
    """
    visible, flat, components = new_visible(), flat_of(codes), codes.values.shape[1]
    for begin in range(0, taps.starts.size, AT_ONCE):
        last = min(begin + AT_ONCE, taps.starts.size)
        find_split(taps, begin, last, weighing, codes.split_values, visible)
        for n in range(begin, last):
            is_split = visible.is_split[np.uint64(n - begin)] != 0
            view = view_of(normals, n) if weighing.faces else NO_VIEW
            if components != 3:
                _, five, total, of_mixed = weigh(
                    taps, n, 0, weighing, view, visible, weighing.faces, is_split, flat, components
                )
            elif not weighing.faces:
                _, five, total, of_mixed = weigh(taps, n, 0, weighing, view, visible, False, False, flat, 3)
            elif is_split:
                _, five, total, of_mixed = weigh(taps, n, 0, weighing, view, visible, True, True, flat, 3)
            else:
                _, five, total, of_mixed = weigh(taps, n, 0, weighing, view, visible, True, False, flat, 3)
            at = np.uint64(n)
            share = np.float64(shares[at])
            if weighing.mixed.size > 0:
                passed[at] = of_mixed / total if of_mixed > 0.0 else 0.0
            if weighing.areas.size > 0 and taps.covers[at] == np.float32(0.0) and total > 0.0:
                share *= np.float64(OFF) / total
            _add_to(sums, np.uint64(owners[at]), share, five, components)


@kernel
def divide(sums: ProbeSums, scale: float, results: Float32s, gradients: Float32s) -> None:
    """Write sums divided by their weights, and the derivatives of that times ``scale``."""
    for n in range(sums.totals.size):
        inverse = 1.0 / sums.totals[n] if sums.totals[n] != 0.0 else 0.0
        for component in range(sums.values.shape[1]):
            value = sums.values[n, component] * inverse
            results[n, component] = value
            for axis in range(3 if gradients.shape[0] > 0 else 0):
                slope = sums.slopes[n, component, axis] - value * sums.total_slopes[n, axis]
                gradients[n, component, axis] = slope * inverse * scale


@kernel
def weigh_by_alpha(taps: Taps, alpha: Codes, is_prefetched: bool, always: bool) -> None:
    """Multiply the weights by alpha; unless ``always``, only where the weighted alpha is not zero."""
    flat = flat_of(alpha)
    end = end_of(taps)
    alphas = np.empty(end, np.float32)
    least = np.float32(1.0)
    if not is_prefetched:
        _prefetch_rows(taps, 0, taps.starts.size, alpha)
    for tap in range(end):
        value = np.float32(value_of(flat, int(taps.rows[np.uint64(tap)]), 1)[0])
        alphas[np.uint64(tap)] = value
        least = min(least, value)
    for n in range(taps.starts.size if not always and least <= np.float32(0.0) else 0):
        total = 0.0
        for tap in range(taps.starts[n], taps.ends[n]):
            total += np.float64(taps.weights[tap]) * np.float64(alphas[tap])
        if not total > 0.0:
            for tap in range(taps.starts[n], taps.ends[n]):
                alphas[tap] = np.float32(1.0)
    for tap in range(end):
        at = np.uint64(tap)
        taps.weights[at] *= alphas[at]
        for axis in range(3 if taps.slopes.shape[0] > 0 else 0):
            taps.slopes[at, axis] *= alphas[at]


def joined(lists: Sequence[TapList]) -> TapList:
    """Concatenate lists of taps."""
    no_taps = TapList(np.zeros(1, np.int64), np.empty(0, np.uint32), np.empty(0, np.float32))
    parts = [(np.diff(each.starts), *each[1:]) for each in (no_taps, *lists)]
    counts, *columns = map(np.concatenate, zip(*parts, strict=True))
    return TapList(np.cumsum(np.append(0, counts)), *columns)


@kernel
def listed(taps: Taps) -> TapList:
    """List the taps that have weight; weights sum to 1 for each point."""
    room = 1
    for n in range(taps.starts.size):
        room += taps.ends[n] - taps.starts[n]
    starts, rows = np.empty(taps.starts.size + 1, np.int64), np.empty(room, np.uint32)
    weights = np.empty(room, np.float32)
    end = starts[0] = 0
    for n in range(taps.starts.size):
        total = 0.0
        for tap in range(taps.starts[n], taps.ends[n]):
            total += np.float64(taps.weights[tap])
        inverse = 1.0 / total if total > 0.0 else 0.0
        for tap in range(taps.starts[n], taps.ends[n]):
            weight = np.float64(taps.weights[tap]) * inverse
            rows[end], weights[end] = taps.rows[tap], weight
            end += bool(weight > 0.0)
        starts[n + 1] = end
    return TapList(starts, rows[:end], weights[:end])
