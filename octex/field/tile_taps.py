"""Taps from tiles, for each filter.

`nearest` takes the cell that holds the point, `linear` the 2×2×2 cells with centres around it. `quadratic`
and `quartic` take the 3×3×3 or 5×5×5 cells around the point's, under a spline. They lie in a *window*, the
children of 2×2×2 or 3×3×3 nodes, which is cached while points stay in it.

Each filter's kernel writes taps from index ``end`` on; ``is_off`` marks points off the surface. It returns
the end of the taps, and the numbers of points listed as without cells and for the walk.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int64s, Uint8s, Uint16s, Uint64s
from octex.field.splines import (
    quartic_slopes,
    quartic_weights,
    single_quadratic_slopes,
    single_quadratic_weights,
)
from octex.field.taps import OFF, Ahead, Batch, Taps, finish, prefetch_cell, scale_off
from octex.field.tiles import (
    GROUP,
    Tiles,
    TilesAround,
    code_in_tile,
    find_tiles,
    is_marked,
    look_in,
    nearest_rows,
    new_tiles_around,
    rounded_cell,
    tile_key,
)
from octex.field.windows import INSIDE, PLACES
from octex.jit import by_constants, fused_kernel, inlined, kernel, part, popcount, prefetch, trailing_zeros
from octex.tree.children import rank_in
from octex.tree.layout import MAX_DEPTH
from octex.tree.search import UNITS, nearer_box


@inlined
def _place_linear(
    coords: Float64s,
    begin: int,
    count: int,
    depth: int,
    around: TilesAround,
    steps: Float32s,
    octants: Uint8s,
    bits: Uint8s,
) -> None:
    """Find each point's tile and its cells' codes; ``steps`` are from the lowest cell's centre, in cells."""
    cells = float(1 << depth)
    one, two, three = np.int32(1), np.int32(2), np.int32(3)
    for n in range(count):
        first = np.uint64(3 * (begin + n))
        x = coords[first] * cells - 0.5
        y = coords[first + np.uint64(1)] * cells - 0.5
        z = coords[first + np.uint64(2)] * cells - 0.5
        u, v, w = np.floor(x), np.floor(y), np.floor(z)
        at = np.uint64(n)
        steps[at] = x - u
        steps[at + np.uint64(GROUP)] = y - v
        steps[at + np.uint64(2 * GROUP)] = z - w
        i, j, k = np.int32(u), np.int32(v), np.int32(w)
        around.keys[at] = tile_key(np.int64(i >> three), np.int64(j >> three), np.int64(k >> three))
        i, j, k = i & np.int32(7), j & np.int32(7), k & np.int32(7)
        around.reached[at] = (i + one) >> three | (j + one) >> three << one | (k + one) >> three << two
        for tap in range(8):
            code = code_in_tile(
                i + one if tap & 1 else i, j + one if tap & 2 else j, k + one if tap & 4 else k
            )
            octants[at + np.uint64(tap * GROUP)] = code >> np.int32(8)
            bits[at + np.uint64(tap * GROUP)] = code & np.int32(63)


@inlined
def _slope_linear(steps: Float32s, n: int, depth: int, stored: int, slopes: Float32s, end: int) -> None:
    """Write the slopes of a point's taps, those with a bit in ``stored``, from index ``end`` on."""
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
def linear_taps(tiles: Tiles, is_off: bool, batch: Batch, taps: Taps, end: int) -> tuple[int, int, int]:
    """Find the taps of trilinear interpolation."""
    coords, which, ahead, last = batch.coords, batch.which, batch.ahead, batch.last
    around = new_tiles_around()
    steps, octants, bits = (
        np.zeros(3 * GROUP, np.float32),
        np.zeros(8 * GROUP, np.uint8),
        np.zeros(8 * GROUP, np.uint8),
    )
    flat = coords.reshape(-1)
    gradient, one = taps.slopes.shape[0] > 0, np.float32(1.0)
    n_empty = n_rim = 0
    # Seldom used steps stay outside the loop over eight cells, which takes a fifth longer with them.
    prefetches_more = ahead.alpha.shape[0] + ahead.flags.size + ahead.areas.size > 0
    for begin in range(0, coords.shape[0], GROUP):
        count = min(GROUP, coords.shape[0] - begin)
        _place_linear(flat, begin, count, tiles.depth, around, steps, octants, bits)
        find_tiles(tiles, around, count)
        for n in range(count):
            at = np.uint64(n)
            slot, start, total, stored = around.slots[at], end, np.float32(0.0), 0
            r, s, t = steps[at], steps[at + np.uint64(GROUP)], steps[at + np.uint64(2 * GROUP)]
            for tap in range(8):
                tap_at = at + np.uint64(tap * GROUP)
                octant = np.int64(octants[tap_at])
                octant = np.int64(around.octants[np.uint64(slot + (octant >> 3))]) + (octant & 7)
                cell, is_stored = look_in(tiles, int(octant), int(bits[tap_at]))
                weight = (r if tap & 1 else one - r) * (
                    (s if tap & 2 else one - s) * (t if tap & 4 else one - t)
                )
                if 0b01101001 >> tap & 1:  # mostly with the others in the same cache lines
                    prefetch(ahead.values, cell)
                taps.rows[np.uint64(end)], taps.weights[np.uint64(end)] = min(cell, last), weight
                total += weight * np.float32(is_stored)
                stored |= int(is_stored) << tap
                end += is_stored
            for tap in range(start, end if prefetches_more else start, 2):
                prefetch_cell(ahead, int(taps.rows[np.uint64(tap)]))
            if gradient:
                _slope_linear(steps, n, tiles.depth, stored, taps.slopes, start)
            end, n_empty, n_rim = finish(batch, begin + n, taps, start, end, total, n_empty, n_rim)
        for n in range(count if tiles.marks.size > 0 else 0):
            at = np.uint64(which[np.uint64(begin + n)])
            if taps.ends[at] > taps.starts[at] and is_marked(tiles, int(taps.rows[taps.starts[at]])):
                taps.ends[at] = taps.starts[at]
                batch.rim[n_rim] = at
                n_rim += 1
    if is_off:
        scale_off(taps, which)
    return end, n_empty, n_rim


class WindowTables(NamedTuple):
    """Tables of a window by the parities of the lowest cell read: x | y << 1 | z << 2."""

    masks: Uint64s  # (8 · words,)   which cells; bit child & 63 of word child >> 6, child = 8 · node + octant
    #: (2 · 8 · children,) where in `PointGroup.along` a child's weight along x is for the first point of a
    #: group, and that along y and z
    places: Uint16s


def _tables(side: int) -> WindowTables:
    """Return the tables of a spline over ``side``³ cells, in the children of (side // 2 + 1)³ nodes."""
    reach = side // 2
    width, children = 2 * reach + 1, 8 * (reach + 1) ** 3
    place = PLACES[reach - 1, :, :children].astype(np.uint16)
    x, y, z = place % width, place // width % width, place // width**2
    along = (GROUP * np.stack([x, side + side * y + z], axis=-1)).astype(np.uint16)
    words = INSIDE[reach - 1, :, : -(-children // 64)]
    return WindowTables(words.ravel().copy(), along.ravel())  # numba compiles no strides


_QUADRATIC, _QUARTIC = _tables(3), _tables(5)


class PointGroup(NamedTuple):
    """A group of points in their tiles, and the latest window."""

    around: TilesAround
    windows: Uint8s  # (GROUP,)   the lowest node of each point's window in the tile: x | y << 2 | z << 4
    parities: Uint8s  # (GROUP,)   of the lowest cell read, which lies in that node: x | y << 1 | z << 2
    along: Float32s  # (30 · GROUP,)   weights along x, then products of those along y and z
    #: (55 · GROUP,) or (0,): slopes along x, then products of slopes along y and weights along z, then of
    #: weights along y and slopes along z
    slopes: Float32s
    latest: Int64s  # (2,)   the latest window, and the key of its tile
    masks: Uint64s  # (4,)   which of its cells are stored
    firsts: Int64s  # (27,)   the first stored child of each of its nodes, less all that the word has before


@part
def new_group(gradient: bool) -> PointGroup:
    """Return an empty group for one tree and one spline."""
    latest = np.empty(2, np.int64)
    latest[0] = latest[1] = -1
    return PointGroup(
        new_tiles_around(),
        np.zeros(GROUP, np.uint8),
        np.zeros(GROUP, np.uint8),
        np.zeros(30 * GROUP, np.float32),
        np.zeros(55 * GROUP if gradient else 0, np.float32),
        latest,
        np.zeros(4, np.uint64),
        np.zeros(27, np.int64),
    )


@by_constants
@inlined
def _find_place(group: PointGroup, n: int, i: np.int32, j: np.int32, k: np.int32, side: int) -> None:
    """Find the tile and the window with lowest cell (i, j, k)."""
    one, two, three, four = np.int32(1), np.int32(2), np.int32(3), np.int32(4)
    reach = np.int32(side // 2)
    at = np.uint64(n)
    group.around.keys[at] = tile_key(np.int64(i >> three), np.int64(j >> three), np.int64(k >> three))
    e, f, g = i >> one & three, j >> one & three, k >> one & three
    group.windows[at] = e | f << two | g << four
    group.around.reached[at] = (e + reach) >> two | (f + reach) >> two << one | (g + reach) >> two << two
    group.parities[at] = i & one | (j & one) << one | (k & one) << two


@inlined
def _lowest(coords: Float64s, point: int, cells: float) -> tuple[float, float, float, float, float, float]:
    """Return a point in cells, and the cell that holds it, as floats."""
    at = np.uint64(3 * point)
    x, y, z = coords[at] * cells, coords[at + np.uint64(1)] * cells, coords[at + np.uint64(2)] * cells
    most = cells - 1.0
    return x, y, z, min(np.floor(x), most), min(np.floor(y), most), min(np.floor(z), most)


@inlined
def _put_products(to: Float32s, at: np.uint64, factor: Any, left: Any, right: Any) -> None:
    """Write the products of each number of a tuple with each of another."""
    for a in range(len(left)):
        for b in range(len(right)):
            to[at + np.uint64(GROUP * (a * len(right) + b))] = factor * (left[a] * right[b])


@by_constants
@inlined
def _place(
    coords: Float64s,
    begin: int,
    count: int,
    depth: int,
    group: PointGroup,
    weights: Any,
    slopes: Any,
    side: int,
) -> None:
    """Find each point's tile, window, and weights and slopes along the axes: functions of its place."""
    cells, one, reach = float(1 << depth), np.float32(1.0), np.int32(side // 2)
    for n in range(count):
        at = np.uint64(n)
        x, y, z, u, v, w = _lowest(coords, begin + n, cells)
        _find_place(group, n, np.int32(u) - reach, np.int32(v) - reach, np.int32(w) - reach, side)
        _put_products(group.along, at, one, (one,), weights(x - u))
        _put_products(group.along, at + np.uint64(side * GROUP), one, weights(y - v), weights(z - w))
    for n in range(count if group.slopes.size > 0 else 0):
        x, y, z, u, v, w = _lowest(coords, begin + n, cells)
        scale, at = np.float32(cells), np.uint64(n)
        _put_products(group.slopes, at, scale, (one,), slopes(x - u))
        at += np.uint64(side * GROUP)
        _put_products(group.slopes, at, scale, slopes(y - v), weights(z - w))
        at += np.uint64(side * side * GROUP)
        _put_products(group.slopes, at, scale, weights(y - v), slopes(z - w))


@inlined
def _add_node(
    tiles: Tiles, group: PointGroup, slot: int, node: int, i: int, j: int, k: int, ahead: Ahead
) -> None:
    """Add the children of a node at (i, j, k), 0 … 5 from the tile on, to the window's masks."""
    code = code_in_tile(2 * i, 2 * j, 2 * k)
    octant = np.uint64(group.around.octants[np.uint64(slot + (code >> 11))] + (code >> 8 & 7))
    shift = np.uint64(code & 63)
    stored = tiles.masks[octant]
    first = np.int64(tiles.firsts[octant]) + rank_in(stored, shift)
    prefetch_cell(ahead, int(first))
    word = np.uint64(node >> 3)
    group.firsts[np.uint64(node)] = first - popcount(group.masks[word])
    group.masks[word] |= ((stored >> shift) & np.uint64(0xFF)) << np.uint64(8 * (node & 7))


@by_constants
@inlined
def _find_window(tiles: Tiles, group: PointGroup, n: int, side: int, ahead: Ahead) -> None:
    """Find the window of point n, unless it is the latest, and prefetch its cells' rows."""
    window, key = np.int64(group.windows[np.uint64(n)]), group.around.keys[np.uint64(n)]
    if (window == group.latest[0]) & (key == group.latest[1]):
        return
    group.latest[0], group.latest[1] = window, key
    i, j, k = int(window & 3), int(window >> 2 & 3), int(window >> 4)
    slot = group.around.slots[np.uint64(n)]
    nodes = side // 2 + 1
    for word in range(1 if nodes == 2 else 4):
        group.masks[word] = np.uint64(0)
    node = 0
    for c in range(nodes):
        for b in range(nodes):
            for a in range(nodes):
                _add_node(tiles, group, slot, node, i + a, j + b, k + c, ahead)
                node += 1


@inlined
def _is_window_marked(tiles: Tiles, group: PointGroup) -> bool:
    """Return whether the first cell of the latest window, of 2×2×2 nodes, is marked."""
    mask = group.masks[0]
    return mask != np.uint64(0) and is_marked(tiles, int(group.firsts[trailing_zeros(mask) >> 3]))


@by_constants
@inlined
def _take_word(
    group: PointGroup,
    n: int,
    word: int,
    tables: WindowTables,
    side: int,
    last: int,
    taps: Taps,
    end: int,
    total: np.float32,
) -> tuple[int, np.float32]:
    """Write the taps in one word of a window; return their end, and the weight of all."""
    at = np.uint64(n)
    words, children = (1, 64) if side < 5 else (4, 216)
    parity = np.int64(group.parities[at])
    mask = group.masks[np.uint64(word)]
    cells = mask & tables.masks[np.uint64(words * parity + word)]
    base = 2 * (children * parity + 64 * word)
    along, slopes, places = group.along, group.slopes, tables.places
    gradient = slopes.size > 0
    while cells != np.uint64(0):
        bit = np.uint64(trailing_zeros(cells))
        cells &= cells - np.uint64(1)
        entry = np.uint64(base) + (bit << np.uint64(1))
        x = np.uint64(places[entry]) + at
        yz = np.uint64(places[entry + np.uint64(1)]) + at
        weight = along[x] * along[yz]
        cell = group.firsts[np.uint64(8 * word) + (bit >> np.uint64(3))] + rank_in(mask, bit)
        taps.rows[np.uint64(end)] = min(cell, last)
        taps.weights[np.uint64(end)] = weight
        if gradient:
            taps.slopes[np.uint64(end), 0] = slopes[x] * along[yz]
            taps.slopes[np.uint64(end), 1] = along[x] * slopes[yz]
            taps.slopes[np.uint64(end), 2] = along[x] * slopes[yz + np.uint64(side * side * GROUP)]
        total += weight
        end += 1
    return end, total


@by_constants
@inlined
def _spline_taps(
    tiles: Tiles,
    is_off: bool,
    batch: Batch,
    taps: Taps,
    end: int,
    group: PointGroup,
    tables: WindowTables,
    weights: Any,
    slopes: Any,
    side: int,
) -> tuple[int, int, int]:
    """Find the taps of a spline over ``side``³ cells."""
    flat = batch.coords.reshape(-1)
    n_empty = n_rim = 0
    for begin in range(0, batch.coords.shape[0], GROUP):
        count = min(GROUP, batch.coords.shape[0] - begin)
        _place(flat, begin, count, tiles.depth, group, weights, slopes, side)
        find_tiles(tiles, group.around, count)
        for n in range(count):
            _find_window(tiles, group, n, side, batch.ahead)
            start, total = end, np.float32(0.0)
            if side < 5 and tiles.marks.size > 0 and _is_window_marked(tiles, group):
                end += 1  # others answer: that one weighs nothing
            else:
                for word in range(1 if side < 5 else 4):
                    end, total = _take_word(group, n, word, tables, side, batch.last, taps, end, total)
            end, n_empty, n_rim = finish(batch, begin + n, taps, start, end, total, n_empty, n_rim)
    if is_off:
        scale_off(taps, batch.which)
    return end, n_empty, n_rim


@kernel
def quadratic_taps(tiles: Tiles, is_off: bool, batch: Batch, taps: Taps, end: int) -> tuple[int, int, int]:
    """Find the taps of the quadratic spline."""
    group, weights = new_group(taps.slopes.shape[0] > 0), single_quadratic_weights
    slopes = single_quadratic_slopes
    return _spline_taps(tiles, is_off, batch, taps, end, group, _QUADRATIC, weights, slopes, 3)


@kernel
def quartic_taps(tiles: Tiles, is_off: bool, batch: Batch, taps: Taps, end: int) -> tuple[int, int, int]:
    """Find the taps of the quartic spline."""
    group, weights, slopes = new_group(taps.slopes.shape[0] > 0), quartic_weights, quartic_slopes
    return _spline_taps(tiles, is_off, batch, taps, end, group, _QUARTIC, weights, slopes, 5)


@part
def _nearest_around(tiles: Tiles, batch: Batch, taps: Taps, end: int) -> tuple[int, int, int]:
    """Find the nearest of the 27 cells around points without a leaf; the first of equally near ones."""
    coords, which = batch.coords, batch.which
    group = new_group(False)
    shift, one = MAX_DEPTH - tiles.depth, np.int32(1)
    n_empty = 0
    for begin in range(0, coords.shape[0], GROUP):
        count = min(GROUP, coords.shape[0] - begin)
        for n in range(count):
            a = rounded_cell(coords[begin + n, 0], tiles.depth) - one
            b = rounded_cell(coords[begin + n, 1], tiles.depth) - one
            c = rounded_cell(coords[begin + n, 2], tiles.depth) - one
            _find_place(group, n, a, b, c, 3)
        find_tiles(tiles, group.around, count)
        for n in range(count):
            _find_window(tiles, group, n, 3, batch.ahead)
            x, y, z = coords[begin + n, 0], coords[begin + n, 1], coords[begin + n, 2]
            a, b, c = rounded_cell(x, tiles.depth), rounded_cell(y, tiles.depth), rounded_cell(z, tiles.depth)
            point = x * UNITS, y * UNITS, z * UNITS
            parity, mask = np.int64(group.parities[n]), group.masks[0]
            cells = mask & INSIDE[0, parity, 0]
            nearest, least, least_code = np.int64(-1), np.inf, np.int64(0)
            while cells != np.uint64(0):
                bit = trailing_zeros(cells)
                cells &= cells - np.uint64(1)
                place = np.int64(PLACES[0, parity, bit])
                low = a - 1 + place % 3 << shift, b - 1 + place // 3 % 3 << shift, c - 1 + place // 9 << shift
                is_nearer, distance, code = nearer_box(point, low, 1 << shift, least, least_code)
                if is_nearer:
                    nearest, least, least_code = group.firsts[bit >> 3] + rank_in(mask, bit), distance, code
            point = which[begin + n]
            if nearest < 0:
                batch.empty[n_empty] = point
                n_empty += 1
                continue
            taps.rows[end], taps.weights[end] = min(int(nearest), batch.last), OFF
            taps.starts[point], taps.ends[point], taps.covers[point] = end, end + 1, np.float32(0.0)
            end += 1
    return end, n_empty, 0


@kernel
def nearest_taps(tiles: Tiles, is_off: bool, batch: Batch, taps: Taps, end: int) -> tuple[int, int, int]:
    """Find the cells that hold points, or those nearest to points off the surface."""
    if is_off:
        return _nearest_around(tiles, batch, taps, end)
    n_empty = nearest_rows(tiles, batch, taps.rows)
    for n in range(batch.coords.shape[0]):
        taps.starts[n], taps.ends[n] = n, n + 1
        taps.weights[n] = taps.covers[n] = np.float32(1.0)
    for m in range(n_empty):
        taps.ends[batch.empty[m]] = taps.starts[batch.empty[m]]
    return batch.coords.shape[0], n_empty, 0


#: By the number of the filter.
FINDERS = nearest_taps, linear_taps, quadratic_taps, quartic_taps
