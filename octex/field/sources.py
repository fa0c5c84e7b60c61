"""Sources by tiles: the taps of points by each filter.

`nearest` has the cell that holds the point, `linear` the 2×2×2 cells with centres around it. `quadratic` and
`quartic` have the 3×3×3 or 5×5×5 around that of the point, under a spline: they lie in a *window*, the
children of 2×2×2 or 3×3×3 nodes, which is kept while points stay in it.
"""

from __future__ import annotations

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
from octex.jit import (
    fused_kernel,
    fused_part,
    inlined,
    kernel,
    part,
    popcount,
    prefetch,
    trailing_zeros,
)
from octex.tree.layout import GRID_BITS
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
def look_in(tiles: Tiles, octant: int, code: int) -> tuple[int, bool]:
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
        i, j, k = rounded_cell(x, depth), rounded_cell(y, depth), rounded_cell(z, depth)
        near.keys[np.uint64(n)] = tile_key(np.int64(i >> three), np.int64(j >> three), np.int64(k >> three))
        codes[np.uint64(n)] = code_in_tile(i & seven, j & seven, k & seven)


@fused_part
def nearest_rows(tiles: Tiles, batch: Batch, found: Uint32s) -> int:
    """Write the cells that hold points to ``found`` (n,); return how many none holds, which are listed."""
    places, last, empty, ahead = batch.places, batch.last, batch.empty, batch.ahead
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
            cell, is_stored = look_in(tiles, int(octant), int(code))
            ask_for(ahead, int(cell))
            found[np.uint64(begin + n)] = min(cell, last)
            empty[np.uint64(n_empty)] = begin + n
            n_empty += not is_stored
    return n_empty


@inlined
def _place_linear(
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
def _slope_linear(steps: Float32s, n: int, depth: int, stored: int, slopes: Float32s, end: int) -> None:
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


@fused_kernel
def _linear_taps(tiles: Tiles, batch: Batch, taps: Taps, end: int) -> tuple[int, int, int]:
    """Find the taps of trilinear interpolation. See `find_taps`."""
    places, which, ahead, last = batch.places, batch.which, batch.ahead, batch.last
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
        _place_linear(flat, begin, count, tiles.depth, near, steps, octants, bits)
        find_tiles(tiles, near, count)
        for n in range(count):
            at = np.uint64(n)
            slot, start, total, stored = near.slots[at], end, np.float32(0.0), 0
            r, s, t = steps[at], steps[at + np.uint64(GROUP)], steps[at + np.uint64(2 * GROUP)]
            for tap in range(8):
                tap_at = at + np.uint64(tap * GROUP)
                octant = np.int64(octants[tap_at])
                octant = np.int64(near.octants[np.uint64(slot + (octant >> 3))]) + (octant & 7)
                cell, is_stored = look_in(tiles, int(octant), int(bits[tap_at]))
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
                _slope_linear(steps, n, tiles.depth, stored, taps.slopes, start)
            end, n_empty, n_rim = _finish(batch, begin + n, taps, start, end, total, n_empty, n_rim)
        for n in range(count if tiles.marks.size > 0 else 0):
            at = np.uint64(which[np.uint64(begin + n)])
            if taps.ends[at] > taps.starts[at] and is_marked(tiles, int(taps.rows[taps.starts[at]])):
                taps.ends[at] = taps.starts[at]
                batch.rim[n_rim] = at
                n_rim += 1
    return end, n_empty, n_rim


class Tables(NamedTuple):
    """What of a window is read, by the parities of the lowest cell read: x | y << 1 | z << 2."""

    masks: Uint64s  # (8 · words,)   which cells; bit child & 63 of word child >> 6, child = 8 · node + octant
    #: (2 · 8 · children,) where in `Group.along` a child's weight along x is for the first point of a group,
    #: and that along y and z.
    places: Uint16s


def _tabulate(reach: int) -> Tables:
    """Tabulate windows of (2 · reach + 1)³ cells in the children of (reach + 1)³ nodes."""
    side, nodes = 2 * reach + 1, reach + 1
    children = 8 * nodes**3
    masks = np.zeros((8, -(-children // 64)), np.uint64)
    places = np.zeros((8, children, 2), np.uint16)
    for parity in range(8):
        for child in range(children):
            node, octant = child >> 3, child & 7
            corner = node % nodes, node // nodes % nodes, node // nodes**2
            x, y, z = (2 * corner[axis] + (octant >> axis & 1) - (parity >> axis & 1) for axis in range(3))
            if min(x, y, z) >= 0 and max(x, y, z) < side:
                masks[parity, child >> 6] |= np.uint64(1 << (child & 63))
                places[parity, child] = GROUP * x, GROUP * (side + side * y + z)
    return Tables(masks.reshape(-1), places.reshape(-1))


_QUADRATIC, _QUARTIC = _tabulate(1), _tabulate(2)


class Group(NamedTuple):
    """Points placed, and the window of the latest."""

    near: Near
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
def new_group(gradient: bool) -> Group:
    """Return a group that knows nothing. It serves one tree and one spline."""
    latest = np.empty(2, np.int64)
    latest[0] = latest[1] = -1
    return Group(
        new_near(),
        np.zeros(GROUP, np.uint8),
        np.zeros(GROUP, np.uint8),
        np.zeros(30 * GROUP, np.float32),
        np.zeros(55 * GROUP if gradient else 0, np.float32),
        latest,
        np.zeros(4, np.uint64),
        np.zeros(27, np.int64),
    )


@inlined
def _find_place(group: Group, n: int, i: np.int32, j: np.int32, k: np.int32, reach: int) -> None:
    """Find the tile and the window whose lowest cell is (i, j, k)."""
    one, two, three, four = np.int32(1), np.int32(2), np.int32(3), np.int32(4)
    more = np.int32(reach)
    at = np.uint64(n)
    group.near.keys[at] = tile_key(np.int64(i >> three), np.int64(j >> three), np.int64(k >> three))
    e, f, g = i >> one & three, j >> one & three, k >> one & three
    group.windows[at] = e | f << two | g << four
    group.near.reached[at] = (e + more) >> two | (f + more) >> two << one | (g + more) >> two << two
    group.parities[at] = i & one | (j & one) << one | (k & one) << two


@inlined
def _lowest(places: Float64s, point: int, cells: float) -> tuple[float, float, float, float, float, float]:
    """Return a point in cells, and the cell that holds it, as floats."""
    at = np.uint64(3 * point)
    x, y, z = places[at] * cells, places[at + np.uint64(1)] * cells, places[at + np.uint64(2)] * cells
    most = cells - 1.0
    return x, y, z, min(np.floor(x), most), min(np.floor(y), most), min(np.floor(z), most)


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
        _find_place(group, n, np.int32(u) - one, np.int32(v) - one, np.int32(w) - one, 1)
        at = np.uint64(n)
        p, q, r = single_quadratic_weights(np.float32(x - u))
        _put_three(along, at, np.float32(1.0), p, q, r)
        a, b, c = single_quadratic_weights(np.float32(y - v))
        p, q, r = single_quadratic_weights(np.float32(z - w))
        _put_three(along, at + np.uint64(3 * GROUP), a, p, q, r)
        _put_three(along, at + np.uint64(6 * GROUP), b, p, q, r)
        _put_three(along, at + np.uint64(9 * GROUP), c, p, q, r)


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
        _find_place(group, n, np.int32(u) - two, np.int32(v) - two, np.int32(w) - two, 2)
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
def _find_window(tiles: Tiles, group: Group, n: int, reach: int, ahead: Ahead) -> None:
    """Know the window of point n, and ask for the rows of its cells."""
    window, key = np.int64(group.windows[np.uint64(n)]), group.near.keys[np.uint64(n)]
    if (window == group.latest[0]) & (key == group.latest[1]):
        return
    group.latest[0], group.latest[1] = window, key
    i, j, k = int(window & 3), int(window >> 2 & 3), int(window >> 4)
    slot = group.near.slots[np.uint64(n)]
    side = reach + 1
    for word in range(1 if reach == 1 else 4):
        group.masks[word] = np.uint64(0)
    node = 0
    for c in range(side):
        for b in range(side):
            for a in range(side):
                _add_node(tiles, group, slot, node, i + a, j + b, k + c, ahead)
                node += 1


@inlined
def _is_window_marked(tiles: Tiles, group: Group) -> bool:
    """Say whether the first cell of the latest window, of 2×2×2 nodes, is marked."""
    mask = group.masks[0]
    return mask != np.uint64(0) and is_marked(tiles, int(group.firsts[trailing_zeros(mask) >> 3]))


@inlined
def _take_word(
    group: Group,
    n: int,
    word: int,
    tables: Tables,
    reach: int,
    last: int,
    taps: Taps,
    end: int,
    total: np.float32,
) -> tuple[int, np.float32]:
    """Write the taps in one word of a window; return their end, and the weight of all."""
    at = np.uint64(n)
    words, children, ys = (1, 64, 9) if reach == 1 else (4, 216, 25)
    parity = np.int64(group.parities[at])
    mask = group.masks[np.uint64(word)]
    left = mask & tables.masks[np.uint64(words * parity + word)]
    base = 2 * (children * parity + 64 * word)
    along, slopes, places = group.along, group.slopes, tables.places
    gradient = slopes.size > 0
    while left != np.uint64(0):
        bit = np.uint64(trailing_zeros(left))
        left &= left - np.uint64(1)
        below = mask & ((np.uint64(1) << bit) - np.uint64(1))
        place = np.uint64(base) + (bit << np.uint64(1))
        x = np.uint64(places[place]) + at
        yz = np.uint64(places[place + np.uint64(1)]) + at
        weight = along[x] * along[yz]
        cell = group.firsts[np.uint64(8 * word) + (bit >> np.uint64(3))] + popcount(below)
        taps.rows[np.uint64(end)] = min(cell, last)
        taps.weights[np.uint64(end)] = weight
        if gradient:
            taps.slopes[np.uint64(end), 0] = slopes[x] * along[yz]
            taps.slopes[np.uint64(end), 1] = along[x] * slopes[yz]
            taps.slopes[np.uint64(end), 2] = along[x] * slopes[yz + np.uint64(ys * GROUP)]
        total += weight
        end += 1
    return end, total


@inlined
def _spline_taps(
    tiles: Tiles, batch: Batch, taps: Taps, end: int, group: Group, tables: Tables, reach: int
) -> tuple[int, int, int]:
    """Find the taps of a spline over (2 · reach + 1)³ cells. See `find_taps`."""
    flat = batch.places.reshape(-1)
    n_empty = n_rim = 0
    for begin in range(0, batch.places.shape[0], GROUP):
        count = min(GROUP, batch.places.shape[0] - begin)
        if reach == 1:
            _place_quadratic(flat, begin, count, tiles.depth, group)
            if group.slopes.size > 0:
                _slope_quadratic(flat, begin, count, tiles.depth, group)
        else:
            _place_quartic(flat, begin, count, tiles.depth, group)
        find_tiles(tiles, group.near, count)
        for n in range(count):
            _find_window(tiles, group, n, reach, batch.ahead)
            start, total = end, np.float32(0.0)
            if reach == 1 and tiles.marks.size > 0 and _is_window_marked(tiles, group):
                end += 1  # others answer: that one weighs nothing
            else:
                for word in range(1 if reach == 1 else 4):
                    end, total = _take_word(group, n, word, tables, reach, batch.last, taps, end, total)
            end, n_empty, n_rim = _finish(batch, begin + n, taps, start, end, total, n_empty, n_rim)
    return end, n_empty, n_rim


@kernel
def _quadratic_taps(tiles: Tiles, batch: Batch, taps: Taps, end: int) -> tuple[int, int, int]:
    return _spline_taps(tiles, batch, taps, end, new_group(taps.slopes.shape[0] > 0), _QUADRATIC, 1)


@kernel
def _quartic_taps(tiles: Tiles, batch: Batch, taps: Taps, end: int) -> tuple[int, int, int]:
    return _spline_taps(tiles, batch, taps, end, new_group(taps.slopes.shape[0] > 0), _QUARTIC, 2)


@kernel
def _nearest_around(tiles: Tiles, batch: Batch, taps: Taps, end: int) -> tuple[int, int]:
    """Find the nearest stored cell of the 27 around points that no leaf holds; of equally near the first.

    Else as `find_taps`.
    """
    places, which = batch.places, batch.which
    group = new_group(False)
    shift = 21 - tiles.depth
    size = 1 << shift
    one = np.int32(1)
    n_empty = 0
    for begin in range(0, places.shape[0], GROUP):
        count = min(GROUP, places.shape[0] - begin)
        for n in range(count):
            a = rounded_cell(places[begin + n, 0], tiles.depth) - one
            b = rounded_cell(places[begin + n, 1], tiles.depth) - one
            c = rounded_cell(places[begin + n, 2], tiles.depth) - one
            _find_place(group, n, a, b, c, 1)
        find_tiles(tiles, group.near, count)
        for n in range(count):
            _find_window(tiles, group, n, 1, batch.ahead)
            x, y, z = (
                places[begin + n, 0] * UNITS,
                places[begin + n, 1] * UNITS,
                places[begin + n, 2] * UNITS,
            )
            low = (
                np.int64(rounded_cell(places[begin + n, 0], tiles.depth)) - 1,
                np.int64(rounded_cell(places[begin + n, 1], tiles.depth)) - 1,
                np.int64(rounded_cell(places[begin + n, 2], tiles.depth)) - 1,
            )
            parity = np.int64(group.parities[n])
            mask = group.masks[0]
            left = mask & _QUADRATIC.masks[parity]
            nearest, least, least_code = np.int64(-1), np.inf, np.int64(0)
            while left != np.uint64(0):
                bit = trailing_zeros(left)
                left &= left - np.uint64(1)
                place = 2 * (64 * parity + bit)
                yz = np.int64(_QUADRATIC.places[place + 1]) // GROUP - 3
                i = int(low[0] + np.int64(_QUADRATIC.places[place]) // GROUP << shift)
                j = int(low[1] + yz // 3 << shift)
                k = int(low[2] + yz % 3 << shift)
                dx = max(i - x, x - (i + size), 0.0)
                dy = max(j - y, y - (j + size), 0.0)
                dz = max(k - z, z - (k + size), 0.0)
                distance = dx * dx + dy * dy + dz * dz
                code = np.int64(encode(i, j, k))
                if distance < least or (distance == least and code < least_code):
                    below = mask & ((np.uint64(1) << np.uint64(bit)) - np.uint64(1))
                    nearest, least, least_code = group.firsts[bit >> 3] + popcount(below), distance, code
            point = which[begin + n]
            if nearest < 0:
                batch.empty[n_empty] = point
                n_empty += 1
                continue
            taps.rows[end], taps.weights[end] = min(int(nearest), batch.last), OFF
            taps.starts[point], taps.ends[point], taps.covers[point] = end, end + 1, np.float32(0.0)
            end += 1
    return end, n_empty


@part
def _nearest_taps(tiles: Tiles, batch: Batch, taps: Taps) -> int:
    """Find the cells that hold all points there are; return how many none holds, which are listed."""
    n_empty = nearest_rows(tiles, batch, taps.rows)
    for n in range(batch.places.shape[0]):
        taps.starts[n], taps.ends[n] = n, n + 1
        taps.weights[n] = taps.covers[n] = np.float32(1.0)
    for n in range(n_empty):
        taps.ends[batch.empty[n]] = taps.starts[batch.empty[n]]
    return n_empty


@kernel
def find_taps(
    tiles: Tiles, filter_code: int, is_off: bool, batch: Batch, taps: Taps, end: int
) -> tuple[int, int, int]:
    """Find the taps of points by tiles, from index ``end`` on.

    ``is_off`` says that they are off the surface. Returns the end of the taps, and how many points are listed
    as without cells and for the walk.
    """
    if filter_code == NEAREST:
        if is_off:
            end, n_empty = _nearest_around(tiles, batch, taps, end)
            return end, n_empty, 0
        return batch.places.shape[0], _nearest_taps(tiles, batch, taps), 0
    if filter_code == LINEAR:
        end, n_empty, n_rim = _linear_taps(tiles, batch, taps, end)
    elif filter_code == QUADRATIC:
        end, n_empty, n_rim = _quadratic_taps(tiles, batch, taps, end)
    else:
        end, n_empty, n_rim = _quartic_taps(tiles, batch, taps, end)
    if is_off:
        for n in batch.which:
            scale_off(taps, n)
    return end, n_empty, n_rim
