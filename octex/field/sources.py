"""Sources by tiles: the taps of points by each filter.

`nearest` has the cell that holds the point; `linear` the 2×2×2 cells with centres around it, `quadratic` and
`quartic` the 3×3×3 or 5×5×5 around that of the point, under a spline. These lie in a *window*, the children
of 2×2×2 or 3×3×3 nodes, which is kept while points stay in it.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Int64s, Uint8s, Uint16s, Uint32s, Uint64s
from octex.field.splines import (
    LINEAR,
    NEAREST,
    QUADRATIC,
    quartic_slopes,
    quartic_weights,
    single_quadratic_weights,
)
from octex.field.taps import LEAST, OFF, Ahead, Taps, ask_for, scale_off
from octex.field.tiles import GROUP, Near, Tiles, code_in_tile, find_tiles, is_marked, new_near, tile_key
from octex.jit import inlined, part, popcount, step, trailing_zeros
from octex.tree.layout import GRID_BITS, MAX_DEPTH
from octex.tree.morton import encode
from octex.tree.search import UNITS


class Batch(NamedTuple):
    """Points whose taps are sought by tiles, and lists of those that these do not answer."""

    places: Float64s  # (n, 3)   in texture space
    which: Int64s  # (n,)   the points' numbers among the taps
    last: int  # the largest number of a cell
    empty: Int64s  # (n,)   takes points without any cell around them
    rim: Int64s  # (n,)   takes points for the walk: their weights are too small, or other levels count there
    ahead: Ahead  # what is asked for of the cells


@inlined
def rounded_cell(x: float, depth: int) -> np.int32:
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
def _place_nearest(places: Float64s, begin: int, count: int, depth: int, group: Group) -> None:
    """Find each point's tile, and the code of its cell there."""
    three, seven = np.int32(3), np.int32(7)
    for n in range(count):
        first, at = np.uint64(3 * (begin + n)), np.uint64(n)
        x, y, z = places[first], places[first + np.uint64(1)], places[first + np.uint64(2)]
        i, j, k = rounded_cell(x, depth), rounded_cell(y, depth), rounded_cell(z, depth)
        group.near.keys[at] = tile_key(np.int64(i >> three), np.int64(j >> three), np.int64(k >> three))
        group.near.reached[at] = 0
        group.codes[at] = code_in_tile(i & seven, j & seven, k & seven)


@step
def nearest_rows(tiles: Tiles, batch: Batch, group: Group, found: Uint32s) -> int:
    """Write the cells that hold points to ``found`` (n,); return how many none holds, which are listed."""
    near, flat, last = group.near, batch.places.reshape(-1), batch.last
    n_empty = 0
    for begin in range(0, batch.places.shape[0], GROUP):
        count = min(GROUP, batch.places.shape[0] - begin)
        _place_nearest(flat, begin, count, tiles.depth, group)
        find_tiles(tiles, near, count)
        for n in range(count):
            code = np.int64(group.codes[np.uint64(n)])
            octant = near.octants[np.uint64(near.slots[np.uint64(n)])] + (code >> 8)
            cell, is_stored = _look_in(tiles, int(octant), int(code))
            ask_for(batch.ahead, int(cell))
            found[np.uint64(begin + n)] = min(cell, last)
            batch.empty[np.uint64(n_empty)] = begin + n
            n_empty += not is_stored
    return n_empty


@inlined
def _finish(
    batch: Batch, n: int, taps: Taps, start: int, end: int, total: np.float32, n_empty: int, n_rim: int
) -> tuple[int, int, int]:
    """Note where the taps of a point are; one that has none, or too small ones, is listed instead.

    Returns the end of the taps, and how many points are listed.
    """
    point = batch.which[np.uint64(n)]
    at = np.uint64(point)
    if not total >= LEAST:
        taps.starts[at] = taps.ends[at] = start
        if end == start:
            batch.empty[np.uint64(n_empty)] = point
            return end, n_empty + 1, n_rim
        batch.rim[np.uint64(n_rim)] = point
        return start, n_empty, n_rim + 1
    taps.starts[at], taps.ends[at] = start, end
    taps.covers[at] = total
    return end, n_empty, n_rim


def _tabulate() -> tuple[Uint64s, Uint16s, Uint64s]:
    """Tabulate what of windows is read."""
    masks, places = np.zeros((2, 8, 4), np.uint64), np.zeros((2, 8, 216, 2), np.uint16)
    eight = np.zeros((8, 8), np.uint64)
    for spline, parity in product(range(2), range(8)):
        side, nodes = 2 * spline + 3, spline + 2
        for child in range(8 * nodes**3):
            node, octant = child >> 3, child & 7
            corner = node % nodes, node // nodes % nodes, node // nodes**2
            x, y, z = (2 * corner[axis] + (octant >> axis & 1) - (parity >> axis & 1) for axis in range(3))
            if min(x, y, z) >= 0 and max(x, y, z) < side:
                masks[spline, parity, child >> 6] |= np.uint64(1 << (child & 63))
                places[spline, parity, child] = GROUP * x, GROUP * (side + side * y + z)
                if spline == 0 and max(x, y, z) < 2:
                    eight[parity, x + 2 * y + 4 * z] = child
    return masks, places, eight


# By the spline, 3³ or 5³, and the parities of the lowest cell read, x | y << 1 | z << 2:
# MASKS [… word]     which cells are read; bit child & 63 of word child >> 6, child = 8 · node + octant
# PLACES [… child]   where in `Group.along` a child's weight along x is for the first point of a group, and
#                    that along y and z
# EIGHT [… x + 2·y + 4·z]   by the parities alone: the children that `linear` reads
MASKS, PLACES, EIGHT = _tabulate()


class Group(NamedTuple):
    """Points placed, and the window of the latest."""

    near: Near
    codes: Int32s  # (GROUP,)   for `nearest`, where each point's cell is in its tile
    windows: Uint8s  # (GROUP,)   the lowest node of each point's window in the tile: x | y << 2 | z << 4
    parities: Uint8s  # (GROUP,)   of the lowest cell read, which lies in that node: x | y << 1 | z << 2
    along: Float32s  # (30 · GROUP,)   weights along x, then products of those along y and z
    #: (55 · GROUP,) or (0,): slopes along x, then products of slopes along y and weights along z, then of
    #: weights along y and slopes along z
    slopes: Float32s
    latest: Int64s  # (3,)   the latest window, the key of its tile, and what `forget_others` was told
    masks: Uint64s  # (4,)   which of its cells are stored
    firsts: Int64s  # (27,)   the first stored child of each of its nodes, less all that the word has before


@part
def new_group(gradient: bool) -> Group:
    """Return a group that knows nothing. It serves one tree."""
    return Group(
        new_near(),
        np.zeros(GROUP, np.int32),
        np.zeros(GROUP, np.uint8),
        np.zeros(GROUP, np.uint8),
        np.zeros(30 * GROUP, np.float32),
        np.zeros(55 * GROUP if gradient else 0, np.float32),
        np.full(3, -1, np.int64),
        np.zeros(4, np.uint64),
        np.zeros(27, np.int64),
    )


@inlined
def forget_others(group: Group, level: int, filter_code: int) -> None:
    """Forget what is known of another level, or for another filter."""
    key = 4 * level + filter_code
    if group.latest[2] != key:
        group.latest[0] = group.latest[1] = group.near.latest[0] = -1
        group.latest[2] = key


@inlined
def _find_place(group: Group, n: int, i: np.int32, j: np.int32, k: np.int32, side: int) -> None:
    """Find the tile and the window of ``side``³ cells of which the lowest is (i, j, k)."""
    one, two, three, four = np.int32(1), np.int32(2), np.int32(3), np.int32(4)
    at = np.uint64(n)
    group.near.keys[at] = tile_key(np.int64(i >> three), np.int64(j >> three), np.int64(k >> three))
    e, f, g = i >> one & three, j >> one & three, k >> one & three
    x, y, z = i & one, j & one, k & one
    group.windows[at] = e | f << two | g << four
    group.parities[at] = x | y << one | z << two
    if side > 2:
        x = y = z = np.int32(side // 2)
    group.near.reached[at] = (e + x) >> two | (f + y) >> two << one | (g + z) >> two << two


@inlined
def _lowest(places: Float64s, point: int, cells: float) -> tuple[float, float, float, float, float, float]:
    """Return a point in cells, and the cell that holds it, as floats."""
    at = np.uint64(3 * point)
    x, y, z = places[at] * cells, places[at + np.uint64(1)] * cells, places[at + np.uint64(2)] * cells
    most = cells - 1.0
    return x, y, z, min(np.floor(x), most), min(np.floor(y), most), min(np.floor(z), most)


@inlined
def _place_linear(places: Float64s, begin: int, count: int, depth: int, group: Group) -> None:
    """Find each point's tile and window, and weigh; with slopes, if they are wanted."""
    one, size = np.float32(1.0), np.float32(1 << depth)
    along, slopes = group.along, group.slopes
    cells = float(1 << depth)
    for n in range(count):
        first, at = np.uint64(3 * (begin + n)), np.uint64(n)
        x = places[first] * cells - 0.5
        y = places[first + np.uint64(1)] * cells - 0.5
        z = places[first + np.uint64(2)] * cells - 0.5
        u, v, w = np.floor(x), np.floor(y), np.floor(z)
        _find_place(group, n, np.int32(u), np.int32(v), np.int32(w), 2)
        r, s, t = np.float32(x - u), np.float32(y - v), np.float32(z - w)
        p, q, a, b = one - s, s, one - t, t
        along[at], along[at + np.uint64(GROUP)] = one - r, r
        _put_four(along, at + np.uint64(2 * GROUP), p, q, a, b)
        if slopes.size > 0:
            slopes[at], slopes[at + np.uint64(GROUP)] = -size, size
            _put_four(slopes, at + np.uint64(2 * GROUP), -size, size, a, b)
            _put_four(slopes, at + np.uint64(6 * GROUP), p, q, -size, size)


@inlined
def _put_four(
    along: Float32s, at: np.uint64, p: np.float32, q: np.float32, a: np.float32, b: np.float32
) -> None:
    along[at], along[at + np.uint64(GROUP)] = p * a, p * b
    along[at + np.uint64(2 * GROUP)], along[at + np.uint64(3 * GROUP)] = q * a, q * b


@inlined
def _put_three(
    along: Float32s, at: np.uint64, factor: np.float32, p: np.float32, q: np.float32, r: np.float32
) -> None:
    along[at] = factor * p
    along[at + np.uint64(GROUP)] = factor * q
    along[at + np.uint64(2 * GROUP)] = factor * r


@inlined
def _place_quadratic(places: Float64s, begin: int, count: int, depth: int, group: Group) -> None:
    """Find each point's tile and window, and weigh."""
    cells = float(1 << depth)
    one = np.int32(1)
    along = group.along
    for n in range(count):
        x, y, z, u, v, w = _lowest(places, begin + n, cells)
        _find_place(group, n, np.int32(u) - one, np.int32(v) - one, np.int32(w) - one, 3)
        at = np.uint64(n)
        p, q, r = single_quadratic_weights(np.float32(x - u))
        _put_three(along, at, np.float32(1.0), p, q, r)
        a, b, c = single_quadratic_weights(np.float32(y - v))
        p, q, r = single_quadratic_weights(np.float32(z - w))
        _put_three(along, at + np.uint64(3 * GROUP), a, p, q, r)
        _put_three(along, at + np.uint64(6 * GROUP), b, p, q, r)
        _put_three(along, at + np.uint64(9 * GROUP), c, p, q, r)
    if group.slopes.size > 0:
        _slope_quadratic(places, begin, count, depth, group)


@inlined
def _slope_quadratic(places: Float64s, begin: int, count: int, depth: int, group: Group) -> None:
    """Write the slopes that go with the weights."""
    cells, one, two = np.float32(1 << depth), np.float32(1.0), np.float32(2.0)
    slopes = group.slopes
    for n in range(count):
        x, y, z, u, v, w = _lowest(places, begin + n, float(1 << depth))
        at = np.uint64(n)
        r, s, t = np.float32(x - u), np.float32(y - v), np.float32(z - w)
        _put_three(slopes, at, cells, r - one, one - two * r, r)
        a, b, c = single_quadratic_weights(t)
        _put_three(slopes, at + np.uint64(3 * GROUP), cells * (s - one), a, b, c)
        _put_three(slopes, at + np.uint64(6 * GROUP), cells * (one - two * s), a, b, c)
        _put_three(slopes, at + np.uint64(9 * GROUP), cells * s, a, b, c)
        a, b, c = single_quadratic_weights(s)
        p, q, r = cells * (t - one), cells * (one - two * t), cells * t
        _put_three(slopes, at + np.uint64(12 * GROUP), a, p, q, r)
        _put_three(slopes, at + np.uint64(15 * GROUP), b, p, q, r)
        _put_three(slopes, at + np.uint64(18 * GROUP), c, p, q, r)


@inlined
def _place_quartic(places: Float64s, begin: int, count: int, depth: int, group: Group) -> None:
    cells = float(1 << depth)
    two = np.int32(2)
    gradient = group.slopes.size > 0
    along, slopes = group.along, group.slopes
    for n in range(count):
        x, y, z, u, v, w = _lowest(places, begin + n, cells)
        _find_place(group, n, np.int32(u) - two, np.int32(v) - two, np.int32(w) - two, 5)
        of_x, of_y, of_z = quartic_weights(x - u), quartic_weights(y - v), quartic_weights(z - w)
        for a in range(5):
            along[n + GROUP * a] = of_x[a]
            for b in range(5):
                along[n + GROUP * (5 + 5 * a + b)] = of_y[a] * of_z[b]
        if gradient:
            by_x, by_y, by_z = quartic_slopes(x - u), quartic_slopes(y - v), quartic_slopes(z - w)
            for a in range(5):
                slopes[n + GROUP * a] = cells * by_x[a]
                for b in range(5):
                    slopes[n + GROUP * (5 + 5 * a + b)] = cells * by_y[a] * of_z[b]
                    slopes[n + GROUP * (30 + 5 * a + b)] = cells * of_y[a] * by_z[b]


@inlined
def _add_node(tiles: Tiles, group: Group, slot: int, node: int, i: int, j: int, k: int, ahead: Ahead) -> None:
    """Add the children of a node at (i, j, k), 0 … 5, from the tile on, to the window's masks."""
    code = code_in_tile(2 * i, 2 * j, 2 * k)
    octant = np.uint64(group.near.octants[np.uint64(slot + (code >> 11))] + (code >> 8 & 7))
    shift = np.uint64(code & 63)
    stored = tiles.masks[octant]
    below = stored & ((np.uint64(1) << shift) - np.uint64(1))
    first = np.int64(tiles.firsts[octant]) + popcount(below)
    ask_for(ahead, int(first))
    word = np.uint64(node >> 3)
    group.firsts[np.uint64(node)] = first - popcount(group.masks[word])
    group.masks[word] |= ((stored >> shift) & np.uint64(0xFF)) << np.uint64(8 * (node & 7))


@inlined
def _find_window(tiles: Tiles, group: Group, n: int, side: int, ahead: Ahead) -> None:
    """Know the window of point n, and ask for the rows of its cells."""
    window, key = np.int64(group.windows[np.uint64(n)]), group.near.keys[np.uint64(n)]
    last = x = y = z = side // 2  # of its nodes along each axis
    if side == 2:  # which in some windows lie in one of them alone
        parity = np.int64(group.parities[np.uint64(n)])
        window |= parity << 6
        x, y, z = int(parity & 1), int(parity >> 1 & 1), int(parity >> 2)
    if (window == group.latest[0]) & (key == group.latest[1]):
        return
    group.latest[0], group.latest[1] = window, key
    i, j, k = int(window & 3), int(window >> 2 & 3), int(window >> 4 & 3)
    slot = group.near.slots[np.uint64(n)]
    for word in range(4 if side == 5 else 1):
        group.masks[word] = np.uint64(0)
    for c in range(z + 1):
        for b in range(y + 1):
            for a in range(x + 1):
                node = a + (last + 1) * (b + (last + 1) * c)
                _add_node(tiles, group, slot, node, i + a, j + b, k + c, ahead)


@inlined
def _is_window_marked(tiles: Tiles, group: Group) -> bool:
    """Say whether the first cell of the latest window, of 2×2×2 nodes, is marked."""
    mask = group.masks[0]
    return mask != np.uint64(0) and is_marked(tiles, int(group.firsts[trailing_zeros(mask) >> 3]))


@inlined
def _take_word(
    group: Group, n: int, word: int, side: int, last: int, taps: Taps, end: int, total: np.float32
) -> tuple[int, np.float32]:
    """Write the taps in one word of a window; return their end, and the weight of all."""
    at, spline, parity = np.uint64(n), side // 2 - 1, np.uint64(group.parities[np.uint64(n)])
    mask = group.masks[np.uint64(word)]
    left = mask & MASKS[spline, parity, word]
    along, slopes = group.along, group.slopes
    gradient = slopes.size > 0
    while left != np.uint64(0):
        bit = np.uint64(trailing_zeros(left))
        left &= left - np.uint64(1)
        below = mask & ((np.uint64(1) << bit) - np.uint64(1))
        child = np.uint64(64 * word) + bit
        x = np.uint64(PLACES[spline, parity, child, 0]) + at
        yz = np.uint64(PLACES[spline, parity, child, 1]) + at
        weight = along[x] * along[yz]
        cell = group.firsts[np.uint64(8 * word) + (bit >> np.uint64(3))] + popcount(below)
        taps.rows[np.uint64(end)] = min(cell, last)
        taps.weights[np.uint64(end)] = weight
        if gradient:
            taps.slopes[np.uint64(end), 0] = slopes[x] * along[yz]
            taps.slopes[np.uint64(end), 1] = along[x] * slopes[yz]
            taps.slopes[np.uint64(end), 2] = along[x] * slopes[yz + np.uint64(side * side * GROUP)]
        total += weight
        end += 1
    return end, total


@inlined
def _take_eight(group: Group, n: int, last: int, taps: Taps, end: int) -> tuple[int, np.float32]:
    """Write the taps of `linear` in a window, as `_take_word` does those of others."""
    at, parity, mask, total = np.uint64(n), group.parities[np.uint64(n)], group.masks[0], np.float32(0.0)
    along, slopes = group.along, group.slopes
    for tap in range(8):
        child = EIGHT[np.uint64(parity), tap]
        x, yz = at + np.uint64(GROUP * (tap & 1)), at + np.uint64(GROUP * (2 + (tap & 2) + (tap >> 2)))
        weight = along[x] * along[yz]
        below = mask & ((np.uint64(1) << child) - np.uint64(1))
        cell = group.firsts[child >> np.uint64(3)] + popcount(below)
        is_stored = (mask >> child) & np.uint64(1) != np.uint64(0)
        to = np.uint64(end)  # without a branch, which could not be foretold
        taps.rows[to], taps.weights[to] = min(cell, last), weight
        if slopes.size > 0:
            taps.slopes[to, 0] = slopes[x] * along[yz]
            taps.slopes[to, 1] = along[x] * slopes[yz]
            taps.slopes[to, 2] = along[x] * slopes[yz + np.uint64(4 * GROUP)]
        total += weight * np.float32(is_stored)
        end += is_stored
    return end, total


@inlined
def _spline_taps(
    tiles: Tiles, batch: Batch, group: Group, taps: Taps, end: int, side: int
) -> tuple[int, int, int]:
    """Find the taps of a spline over ``side``³ cells. See `tiled_taps`."""
    flat, n_words = batch.places.reshape(-1), 4 if side == 5 else 1
    n_empty = n_rim = int(np.int64(0))  # see `find.search_tiles`
    for begin in range(0, batch.places.shape[0], GROUP):
        count = min(GROUP, batch.places.shape[0] - begin)
        if side == 2:
            _place_linear(flat, begin, count, tiles.depth, group)
        elif side == 3:
            _place_quadratic(flat, begin, count, tiles.depth, group)
        else:
            _place_quartic(flat, begin, count, tiles.depth, group)
        find_tiles(tiles, group.near, count)
        for n in range(count):
            _find_window(tiles, group, n, side, batch.ahead)
            start, total = end, np.float32(0.0)
            if tiles.marks.size > 0 and _is_window_marked(tiles, group):
                end += 1  # others answer: that one weighs nothing
            elif side == 2:
                end, total = _take_eight(group, n, batch.last, taps, end)
            else:
                for word in range(n_words):
                    end, total = _take_word(group, n, word, side, batch.last, taps, end, total)
            end, n_empty, n_rim = _finish(batch, begin + n, taps, start, end, total, n_empty, n_rim)
    return end, n_empty, n_rim


@step
def _linear_taps(tiles: Tiles, batch: Batch, group: Group, taps: Taps, end: int) -> tuple[int, int, int]:
    return _spline_taps(tiles, batch, group, taps, end, 2)


@step
def _quadratic_taps(tiles: Tiles, batch: Batch, group: Group, taps: Taps, end: int) -> tuple[int, int, int]:
    return _spline_taps(tiles, batch, group, taps, end, 3)


@step
def _quartic_taps(tiles: Tiles, batch: Batch, group: Group, taps: Taps, end: int) -> tuple[int, int, int]:
    return _spline_taps(tiles, batch, group, taps, end, 5)


@step
def _nearest_taps(tiles: Tiles, batch: Batch, group: Group, taps: Taps) -> tuple[int, int, int]:
    """Find the cells that hold points, which are all that there are."""
    n_empty = nearest_rows(tiles, batch, group, taps.rows)
    for n in range(batch.places.shape[0]):
        taps.starts[n], taps.ends[n] = n, n + 1
        taps.weights[n] = taps.covers[n] = np.float32(1.0)
    for n in range(n_empty):
        taps.ends[batch.empty[n]] = taps.starts[batch.empty[n]]
    return batch.places.shape[0], n_empty, 0


@step
def _nearest_around(tiles: Tiles, batch: Batch, group: Group, taps: Taps, end: int) -> tuple[int, int, int]:
    """Find the nearest stored cell of the 27 around points that no leaf holds; of equally near the first."""
    places, depth, shift = batch.places, tiles.depth, MAX_DEPTH - tiles.depth
    one, size = np.int32(1), 1 << shift
    n_empty = 0
    for begin in range(0, places.shape[0], GROUP):
        count = min(GROUP, places.shape[0] - begin)
        for n in range(count):
            a, b, c = places[begin + n, 0], places[begin + n, 1], places[begin + n, 2]
            i, j, k = rounded_cell(a, depth), rounded_cell(b, depth), rounded_cell(c, depth)
            _find_place(group, n, i - one, j - one, k - one, 3)
        find_tiles(tiles, group.near, count)
        for n in range(count):
            _find_window(tiles, group, n, 3, batch.ahead)
            a, b, c = places[begin + n, 0], places[begin + n, 1], places[begin + n, 2]
            u, v, w = rounded_cell(a, depth) - one, rounded_cell(b, depth) - one, rounded_cell(c, depth) - one
            x, y, z = a * UNITS, b * UNITS, c * UNITS
            parity, mask = np.int64(group.parities[n]), group.masks[0]
            left = mask & MASKS[0, parity, 0]
            nearest, least, least_code = np.int64(-1), np.inf, np.int64(0)
            while left != np.uint64(0):
                bit = trailing_zeros(left)
                left &= left - np.uint64(1)
                yz = np.int64(PLACES[0, parity, bit, 1]) // GROUP - 3
                low_x = int(np.int64(u) + np.int64(PLACES[0, parity, bit, 0]) // GROUP << shift)
                low_y, low_z = int(np.int64(v) + yz // 3 << shift), int(np.int64(w) + yz % 3 << shift)
                dx = max(low_x - x, x - (low_x + size), 0.0)
                dy = max(low_y - y, y - (low_y + size), 0.0)
                dz = max(low_z - z, z - (low_z + size), 0.0)
                distance = dx * dx + dy * dy + dz * dz
                code = np.int64(encode(low_x, low_y, low_z))
                if distance < least or (distance == least and code < least_code):
                    below = mask & ((np.uint64(1) << np.uint64(bit)) - np.uint64(1))
                    nearest, least, least_code = group.firsts[bit >> 3] + popcount(below), distance, code
            point = batch.which[begin + n]
            if nearest < 0:
                batch.empty[n_empty] = point
                n_empty += 1
                continue
            taps.rows[end], taps.weights[end] = min(int(nearest), batch.last), OFF
            taps.starts[point], taps.ends[point], taps.covers[point] = end, end + 1, np.float32(0.0)
            end += 1
    return end, n_empty, 0


@step
def tiled_taps(
    tiles: Tiles, filter_code: int, is_off: bool, batch: Batch, group: Group, taps: Taps, end: int
) -> tuple[int, int, int]:
    """Find the taps of points by tiles, from index ``end`` on.

    ``is_off`` says that they are off the surface. Returns the end of the taps, and how many points are listed
    as without cells and for the walk.
    """
    forget_others(group, tiles.depth, filter_code)
    if filter_code == NEAREST:
        if is_off:
            return _nearest_around(tiles, batch, group, taps, end)
        return _nearest_taps(tiles, batch, group, taps)
    if filter_code == LINEAR:
        end, n_empty, n_rim = _linear_taps(tiles, batch, group, taps, end)
    elif filter_code == QUADRATIC:
        end, n_empty, n_rim = _quadratic_taps(tiles, batch, group, taps, end)
    else:
        end, n_empty, n_rim = _quartic_taps(tiles, batch, group, taps, end)
    for n in range(batch.places.shape[0] if is_off else 0):
        scale_off(taps, batch.which[n])
    return end, n_empty, n_rim
