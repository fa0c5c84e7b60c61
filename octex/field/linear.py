"""`nearest` and `linear` by tiles: the cell that holds the point, or the 2×2×2 with centres around it."""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Int64s, Uint8s, Uint32s
from octex.field.blocks import GROUP, Near, find_tiles, new_near, tile_key
from octex.field.taps import Ahead, Taps, ask_for, finish
from octex.field.tiles import Tiles, code_in_tile, is_marked
from octex.jit import fused_kernel, inlined, popcount, prefetch
from octex.tree.layout import GRID_BITS


@inlined
def cell_of(x: float, depth: int) -> np.int32:
    """Find the cell that holds a coordinate 0 … 1, rounded as the vertices of surfaces are."""
    cell = np.int32(x * (1 << GRID_BITS) + 0.5) >> np.int32(GRID_BITS - depth)
    return min(cell, np.int32((1 << depth) - 1))


@inlined
def _look_in(tiles: Tiles, octant: int, code: int) -> tuple[int, bool]:
    """Return the number that a cell of an octant has if it is stored, and whether it is."""
    bit = np.uint64(code & 63)
    mask = tiles.masks[np.uint64(octant)]
    below = mask & ((np.uint64(1) << bit) - np.uint64(1))
    number = np.int64(tiles.firsts[np.uint64(octant)]) + popcount(below)
    return int(number), (mask >> bit) & np.uint64(1) != np.uint64(0)


@inlined
def _place_nearest(places: Float64s, begin: int, count: int, depth: int, near: Near, codes: Int32s) -> None:
    """Find each point's tile, and the code of its cell there."""
    three, seven = np.int32(3), np.int32(7)
    for n in range(count):
        at = np.uint64(3 * (begin + n))
        x, y, z = places[at], places[at + np.uint64(1)], places[at + np.uint64(2)]
        i, j, k = cell_of(x, depth), cell_of(y, depth), cell_of(z, depth)
        near.keys[np.uint64(n)] = tile_key(np.int64(i >> three), np.int64(j >> three), np.int64(k >> three))
        codes[np.uint64(n)] = code_in_tile(i & seven, j & seven, k & seven)


@fused_kernel
def nearest_rows(
    tiles: Tiles, places: Float64s, last: int, found: Uint32s, empty: Int64s, ahead: Ahead
) -> int:
    """Write the cells that hold points (n, 3) of texture space to ``found`` (n,).

    ``last`` is the largest cell number; ``ahead`` is asked for.
    Points that no cell of the tiles holds are listed in ``empty``; returns their number.
    """
    near, codes = new_near(), np.zeros(GROUP, np.int32)
    flat = places.reshape(-1)
    n_empty = 0
    for begin in range(0, places.shape[0], GROUP):
        count = min(GROUP, places.shape[0] - begin)
        _place_nearest(flat, begin, count, tiles.depth, near, codes)
        find_tiles(tiles, near, count)
        for n in range(count):
            code = np.int64(codes[np.uint64(n)])
            octant = near.octants[np.uint64(near.slots[np.uint64(n)])] + (code >> 8)
            cell, is_stored = _look_in(tiles, int(octant), int(code))
            ask_for(ahead, int(cell))
            found[np.uint64(begin + n)] = min(cell, last)
            empty[np.uint64(n_empty)] = begin + n
            n_empty += not is_stored
    return n_empty


@inlined
def _place(
    places: Float64s,
    begin: int,
    count: int,
    depth: int,
    near: Near,
    steps: Float32s,
    octants: Uint8s,
    bits: Uint8s,
) -> None:
    """Find each point's tile and the codes of its cells there.

    ``steps`` (3 · GROUP,) are from the lowest cell's centre, in cells.
    """
    cells = float(1 << depth)
    one, two, three = np.int32(1), np.int32(2), np.int32(3)
    for n in range(count):
        first = np.uint64(3 * (begin + n))
        x = places[first] * cells - 0.5
        y = places[first + np.uint64(1)] * cells - 0.5
        z = places[first + np.uint64(2)] * cells - 0.5
        u, v, w = np.floor(x), np.floor(y), np.floor(z)
        at = np.uint64(n)
        steps[at] = x - u
        steps[at + np.uint64(GROUP)] = y - v
        steps[at + np.uint64(2 * GROUP)] = z - w
        i, j, k = np.int32(u), np.int32(v), np.int32(w)
        near.keys[at] = tile_key(np.int64(i >> three), np.int64(j >> three), np.int64(k >> three))
        i, j, k = i & np.int32(7), j & np.int32(7), k & np.int32(7)
        near.reached[at] = (i + one) >> three | (j + one) >> three << one | (k + one) >> three << two
        for tap in range(8):
            code = code_in_tile(
                i + one if tap & 1 else i, j + one if tap & 2 else j, k + one if tap & 4 else k
            )
            octants[at + np.uint64(tap * GROUP)] = code >> np.int32(8)
            bits[at + np.uint64(tap * GROUP)] = code & np.int32(63)


@inlined
def _slope(steps: Float32s, n: int, depth: int, stored: int, slopes: Float32s, end: int) -> None:
    """Write the slopes of a point's taps from index ``end`` on: those whose bit in ``stored`` is set."""
    one, cells = np.float32(1.0), np.float32(1 << depth)
    r, s, t = steps[n], steps[n + GROUP], steps[n + 2 * GROUP]
    for tap in range(8):
        if stored >> tap & 1 != 0:
            a, b, c = r if tap & 1 else one - r, s if tap & 2 else one - s, t if tap & 4 else one - t
            slopes[end, 0] = (cells if tap & 1 else -cells) * (b * c)
            slopes[end, 1] = (cells if tap & 2 else -cells) * (a * c)
            slopes[end, 2] = (cells if tap & 4 else -cells) * (a * b)
            end += 1


@fused_kernel
def linear_taps(
    tiles: Tiles,
    places: Float64s,
    which: Int64s,
    is_off: bool,
    last: int,
    taps: Taps,
    end: int,
    empty: Int64s,
    rim: Int64s,
    ahead: Ahead,
) -> tuple[int, int, int]:
    """Find the taps of trilinear interpolation, from index ``end`` on. See `spline.quadratic_taps`."""
    near = new_near()
    steps, octants, bits = (
        np.zeros(3 * GROUP, np.float32),
        np.zeros(8 * GROUP, np.uint8),
        np.zeros(8 * GROUP, np.uint8),
    )
    flat = places.reshape(-1)
    gradient, one = taps.slopes.shape[0] > 0, np.float32(1.0)
    n_empty = n_rim = 0
    # What is seldom wanted stands outside the loop over eight cells, which takes a fifth longer with it.
    asks_more = ahead.alpha.shape[0] + ahead.flags.size + ahead.areas.size > 0
    for begin in range(0, places.shape[0], GROUP):
        count = min(GROUP, places.shape[0] - begin)
        _place(flat, begin, count, tiles.depth, near, steps, octants, bits)
        find_tiles(tiles, near, count)
        for n in range(count):
            at = np.uint64(n)
            slot, start, total, stored = near.slots[at], end, np.float32(0.0), 0
            r, s, t = steps[at], steps[at + np.uint64(GROUP)], steps[at + np.uint64(2 * GROUP)]
            for tap in range(8):
                tap_at = at + np.uint64(tap * GROUP)
                octant = np.int64(octants[tap_at])
                octant = np.int64(near.octants[np.uint64(slot + (octant >> 3))]) + (octant & 7)
                cell, is_stored = _look_in(tiles, int(octant), int(bits[tap_at]))
                weight = (r if tap & 1 else one - r) * (
                    (s if tap & 2 else one - s) * (t if tap & 4 else one - t)
                )
                if 0b01101001 >> tap & 1:  # the others mostly lie beside these
                    prefetch(ahead.values, cell)
                taps.rows[np.uint64(end)], taps.weights[np.uint64(end)] = min(cell, last), weight
                total += weight * np.float32(is_stored)
                stored |= int(is_stored) << tap
                end += is_stored
            for tap in range(start, end if asks_more else start, 2):
                ask_for(ahead, int(taps.rows[np.uint64(tap)]))
            if gradient:
                _slope(steps, n, tiles.depth, stored, taps.slopes, start)
            point = int(which[np.uint64(begin + n)])
            end, n_empty, n_rim = finish(taps, point, start, end, total, is_off, empty, n_empty, rim, n_rim)
        for n in range(count if tiles.marks.size > 0 else 0):
            at = np.uint64(which[np.uint64(begin + n)])
            if taps.ends[at] > taps.starts[at] and is_marked(tiles, int(taps.rows[taps.starts[at]])):
                taps.ends[at] = taps.starts[at]
                rim[n_rim] = at
                n_rim += 1
    return end, n_empty, n_rim
