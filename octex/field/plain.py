"""Lookups where all leaves lie at the deepest level: 1, 8 or 27 cells around each point, found by tiles.

Points are taken in blocks. A block's tiles are asked for (`prefetch`) when its points are placed, the values
of a lookup's cells when the cells are found, and both are read a stage later: of random points most of the
time is waiting. What is known of a tile or a window is kept while points stay in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.field.neighborhood import MOST_TAPS, Walk, walk_taps
from octex.field.splines import LINEAR, NEAREST, QUADRATIC
from octex.field.tiles import Tiles, bit_of, octant_of, tile_row
from octex.jit import fused_kernel, inlined, kernel, popcount, prefetch, trailing_zeros
from octex.tree.layout import GRID_BITS, TreeArrays
from octex.tree.search import Origin

#: Points in a block: enough that all can wait for memory at once, few enough to stay in the nearest cache.
BLOCK = 64

Points = npt.NDArray[np.float32 | np.float64]
Values = npt.NDArray[np.uint8 | np.uint16]
Float32s = npt.NDArray[np.float32]


class Scratch(NamedTuple):
    """A block of points, the latest tile, and the latest window: 4×4×4 cells, the children of 2×2×2 nodes."""

    corners: npt.NDArray[np.int64]  # (BLOCK · 4,)   the lowest cell that each lookup reads, from −1 on
    steps: Float32s  # (BLOCK · 4,)   the point's distance from it, or from its centre, in cells
    ahead: npt.NDArray[np.int64]  # (BLOCK,)   rows of the corners' tiles
    tile: npt.NDArray[np.int64]  # (3,)   the latest tile
    rows: npt.NDArray[np.int64]  # (8,)   rows of the 2×2×2 tiles from that on; −1: not looked up
    window: npt.NDArray[np.int64]  # (3,)   the lowest node of the latest window
    mask: npt.NDArray[np.uint64]  # (1,)   which of its cells are stored, in Morton order
    firsts: npt.NDArray[np.int64]  # (8,)   the first stored child of each of its nodes
    along: Float32s  # (16,)   weights along x, then products of those along y and z
    cells: npt.NDArray[np.uint32]  # (BLOCK · 27,)   taps
    weights: Float32s  # (BLOCK · 27,)
    ends: npt.NDArray[np.int64]  # (BLOCK,)


@kernel
def new_scratch() -> Scratch:
    """Return a scratch that knows nothing. It serves one tree."""
    return Scratch(
        np.zeros(BLOCK * 4, np.int64),
        np.zeros(BLOCK * 4, np.float32),
        np.zeros(BLOCK, np.int64),
        np.full(3, -9, np.int64),
        np.full(8, -1, np.int64),
        np.full(3, -9, np.int64),
        np.zeros(1, np.uint64),
        np.zeros(8, np.int64),
        np.zeros(16, np.float32),
        np.zeros(BLOCK * 27, np.uint32),
        np.zeros(BLOCK * 27, np.float32),
        np.zeros(BLOCK, np.int64),
    )


def _window_masks() -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.uint8]]:
    """Say what of a window is read, by the parities of the lowest cell read.

    Returns masks (8,) of the 3×3×3 cells, and for each bit (8 · 64,) where its weights are in
    `Scratch.along`: that of x in the high four bits, that of y and z in the low ones.
    """
    masks, places = np.zeros(8, np.uint64), np.zeros((8, 64), np.uint8)
    for parity in range(8):
        for bit in range(64):
            x, y, z = (
                (bit >> axis & 1 | (bit >> axis + 3 & 1) << 1) - (parity >> axis & 1) for axis in range(3)
            )
            if min(x, y, z) >= 0 and max(x, y, z) < 3:
                masks[parity] |= np.uint64(1 << bit)
                places[parity, bit] = x << 4 | 3 + 3 * y + z
    return masks, places.reshape(-1)


WINDOW_MASKS, WINDOW_PLACES = _window_masks()


@inlined
def _locate(x: float, depth: int, filter_code: int) -> tuple[int, np.float32]:
    """Find the lowest cell read along an axis, and how far from it the point is: LINEAR from its centre."""
    x = min(max(x, 0.0), 1.0)
    cells = 1 << depth
    if filter_code == NEAREST:  # a surface lies in the cells of its vertices, which are rounded too
        return min(int(x * (1 << GRID_BITS) + 0.5) >> (GRID_BITS - depth), cells - 1), np.float32(0.0)
    x *= cells
    if filter_code == LINEAR:
        x -= 0.5
    cell = min(np.floor(x), cells - 1.0)
    return int(cell) - (1 if filter_code == QUADRATIC else 0), np.float32(x - cell)


@inlined
def place_block(
    tiles: Tiles,
    points: Points,
    begin: int,
    count: int,
    origin: Origin,
    inverse: float,
    filter_code: int,
    scratch: Scratch,
) -> int:
    """Place a block of points; return the index of the first that is not finite, or −1."""
    i, j, k = scratch.tile[0], scratch.tile[1], scratch.tile[2]
    row = scratch.rows[0]
    for n in range(count):
        at = np.uint64(begin + n)
        x, y, z = np.float64(points[at, 0]), np.float64(points[at, 1]), np.float64(points[at, 2])
        if not (abs(x) < np.inf) & (abs(y) < np.inf) & (abs(z) < np.inf):
            return begin + n
        a, r = _locate((x - origin[0]) * inverse, tiles.depth, filter_code)
        b, s = _locate((y - origin[1]) * inverse, tiles.depth, filter_code)
        c, t = _locate((z - origin[2]) * inverse, tiles.depth, filter_code)
        first = np.uint64(4 * n)
        (
            scratch.corners[first],
            scratch.corners[first + np.uint64(1)],
            scratch.corners[first + np.uint64(2)],
        ) = a, b, c
        if filter_code != NEAREST:
            (
                scratch.steps[first],
                scratch.steps[first + np.uint64(1)],
                scratch.steps[first + np.uint64(2)],
            ) = r, s, t
        a, b, c = a >> 3, b >> 3, c >> 3
        if a != i or b != j or c != k:
            i, j, k = a, b, c
            row = tile_row(tiles, i, j, k)
            prefetch(tiles.masks, 8 * row)
            prefetch(tiles.firsts, 8 * row)
        scratch.ahead[np.uint64(n)] = row
    return -1


@inlined
def _find_tiles(tiles: Tiles, scratch: Scratch, n: int, width: int) -> None:
    """Know the rows of the tiles that ``width`` cells from the corner of point n on lie in."""
    first = np.uint64(4 * n)
    x, y, z = (
        scratch.corners[first],
        scratch.corners[first + np.uint64(1)],
        scratch.corners[first + np.uint64(2)],
    )
    i, j, k = x >> 3, y >> 3, z >> 3
    tile, rows = scratch.tile, scratch.rows
    if i != tile[0] or j != tile[1] or k != tile[2]:
        tile[0], tile[1], tile[2] = i, j, k
        for other in range(8):
            rows[other] = -1
        rows[0] = scratch.ahead[np.uint64(n)]
    a, b, c = (x & 7) + width - 1, (y & 7) + width - 1, (z & 7) + width - 1
    if (a | b | c) & 8:
        reached = a >> 3 | b >> 3 << 1 | c >> 3 << 2
        for other in range(1, 8):
            if other & ~reached == 0 and rows[other] < 0:
                rows[other] = tile_row(tiles, i + (other & 1), j + (other >> 1 & 1), k + (other >> 2))


@inlined
def _add_node(
    tiles: Tiles, scratch: Scratch, node: int, i: int, j: int, k: int, mask: np.uint64
) -> np.uint64:
    """Add the children of a node of the window, at (i, j, k), 0 … 4, in the tile, to the window's mask."""
    row = scratch.rows[np.uint64(i >> 2 | (j >> 2) << 1 | (k >> 2) << 2)]
    octant = np.uint64(8 * row + (i >> 1 & 1 | (j & 2) | (k & 2) << 1))
    shift = np.uint64((i & 1) << 3 | (j & 1) << 4 | (k & 1) << 5)
    word = tiles.masks[octant]
    below = word & ((np.uint64(1) << shift) - np.uint64(1))
    scratch.firsts[np.uint64(node)] = np.int64(tiles.firsts[octant]) + popcount(below)
    return np.uint64(mask | ((word >> shift) & np.uint64(0xFF)) << np.uint64(8 * node))


@inlined
def _find_window(tiles: Tiles, scratch: Scratch, n: int) -> bool:
    """Know the window of point n; say whether it is another than before."""
    _find_tiles(tiles, scratch, n, 3)
    first = np.uint64(4 * n)
    x, y, z = (
        scratch.corners[first],
        scratch.corners[first + np.uint64(1)],
        scratch.corners[first + np.uint64(2)],
    )
    i, j, k = x >> 1, y >> 1, z >> 1
    window = scratch.window
    is_new = bool(i != window[0] or j != window[1] or k != window[2])
    if is_new:
        window[0], window[1], window[2] = i, j, k
        i, j, k = i & 3, j & 3, k & 3
        mask = _add_node(tiles, scratch, 0, i, j, k, np.uint64(0))
        mask = _add_node(tiles, scratch, 1, i + 1, j, k, mask)
        mask = _add_node(tiles, scratch, 2, i, j + 1, k, mask)
        mask = _add_node(tiles, scratch, 3, i + 1, j + 1, k, mask)
        mask = _add_node(tiles, scratch, 4, i, j, k + 1, mask)
        mask = _add_node(tiles, scratch, 5, i + 1, j, k + 1, mask)
        mask = _add_node(tiles, scratch, 6, i, j + 1, k + 1, mask)
        mask = _add_node(tiles, scratch, 7, i + 1, j + 1, k + 1, mask)
        scratch.mask[0] = mask
    return is_new


@inlined
def _quadratic(t: np.float32) -> tuple[np.float32, np.float32, np.float32]:
    half, one = np.float32(0.5), np.float32(1.0)
    low, high = half * (one - t) * (one - t), half * t * t
    return low, one - low - high, high


@inlined
def _weigh_window(scratch: Scratch, n: int) -> None:
    """Write the quadratic spline's weights for point n."""
    first = np.uint64(4 * n)
    along = scratch.along
    along[0], along[1], along[2] = _quadratic(scratch.steps[first])
    a, b, c = _quadratic(scratch.steps[first + np.uint64(1)])
    d, e, f = _quadratic(scratch.steps[first + np.uint64(2)])
    along[3], along[4], along[5] = a * d, a * e, a * f
    along[6], along[7], along[8] = b * d, b * e, b * f
    along[9], along[10], along[11] = c * d, c * e, c * f


@inlined
def _quadratic_taps(
    scratch: Scratch,
    n: int,
    last: int,
    masks: npt.NDArray[np.uint64],
    places: npt.NDArray[np.uint8],
    end: int,
) -> int:
    """Write the taps of point n, whose window is known, from ``end`` on; return their end."""
    _weigh_window(scratch, n)
    first = np.uint64(4 * n)
    x, y, z = (
        scratch.corners[first],
        scratch.corners[first + np.uint64(1)],
        scratch.corners[first + np.uint64(2)],
    )
    parity = np.uint64(x & 1 | (y & 1) << 1 | (z & 1) << 2)
    mask = scratch.mask[0]
    left = mask & masks[parity]
    while left != np.uint64(0):
        bit = np.uint64(trailing_zeros(left))
        left &= left - np.uint64(1)
        below = (np.uint64(1) << bit) - (np.uint64(1) << (bit & np.uint64(56)))
        place = np.int64(places[parity << np.uint64(6) | bit])
        cell = scratch.firsts[bit >> np.uint64(3)] + popcount(mask & below)
        scratch.cells[np.uint64(end)] = min(cell, last)
        scratch.weights[np.uint64(end)] = (
            scratch.along[np.uint64(place >> 4)] * scratch.along[np.uint64(place & 15)]
        )
        end += 1
    return end


@inlined
def _linear_tap(
    tiles: Tiles, scratch: Scratch, i: int, j: int, k: int, weight: np.float32, last: int, end: int
) -> int:
    """Write the tap of the cell at (i, j, k), 0 … 8, of the tiles; without weight if none is stored."""
    row = scratch.rows[np.uint64(i >> 3 | (j >> 3) << 1 | (k >> 3) << 2)]
    octant = np.uint64(8 * row + octant_of(i, j, k))
    bit = bit_of(i, j, k)
    mask = tiles.masks[octant]
    below = mask & ((np.uint64(1) << bit) - np.uint64(1))
    cell = min(int(np.int64(tiles.firsts[octant])) + popcount(below), last)
    scratch.cells[np.uint64(end)] = cell
    scratch.weights[np.uint64(end)] = weight * np.float32(np.int32((mask >> bit) & np.uint64(1)))
    return end + 1


@inlined
def _linear_taps(tiles: Tiles, scratch: Scratch, n: int, last: int, end: int) -> int:
    """Write the eight taps of point n from ``end`` on; return their end."""
    _find_tiles(tiles, scratch, n, 2)
    first = np.uint64(4 * n)
    second, third = first + np.uint64(1), first + np.uint64(2)
    i, j, k = scratch.corners[first] & 7, scratch.corners[second] & 7, scratch.corners[third] & 7
    r, s, t = scratch.steps[first], scratch.steps[second], scratch.steps[third]
    one = np.float32(1.0)
    a, b, c, d = (one - s) * (one - t), s * (one - t), (one - s) * t, s * t
    end = _linear_tap(tiles, scratch, i, j, k, (one - r) * a, last, end)
    end = _linear_tap(tiles, scratch, i + 1, j, k, r * a, last, end)
    end = _linear_tap(tiles, scratch, i, j + 1, k, (one - r) * b, last, end)
    end = _linear_tap(tiles, scratch, i + 1, j + 1, k, r * b, last, end)
    end = _linear_tap(tiles, scratch, i, j, k + 1, (one - r) * c, last, end)
    end = _linear_tap(tiles, scratch, i + 1, j, k + 1, r * c, last, end)
    end = _linear_tap(tiles, scratch, i, j + 1, k + 1, (one - r) * d, last, end)
    return _linear_tap(tiles, scratch, i + 1, j + 1, k + 1, r * d, last, end)


@inlined
def _nearest_tap(tiles: Tiles, scratch: Scratch, n: int, last: int) -> None:
    """Write the tap of the cell that holds point n; of no weight if none is stored."""
    first = np.uint64(4 * n)
    i, j, k = (
        scratch.corners[first],
        scratch.corners[first + np.uint64(1)],
        scratch.corners[first + np.uint64(2)],
    )
    octant = np.uint64(8 * scratch.ahead[np.uint64(n)] + octant_of(i, j, k))
    bit = bit_of(i, j, k)
    mask = tiles.masks[octant]
    below = mask & ((np.uint64(1) << bit) - np.uint64(1))
    cell = min(int(np.int64(tiles.firsts[octant])) + popcount(below), last)
    scratch.cells[np.uint64(n)] = cell
    scratch.weights[np.uint64(n)] = np.float32(np.int32((mask >> bit) & np.uint64(1)))


@inlined
def _blend_color(
    scratch: Scratch, tap: int, end: int, values: Values, table: Float32s, results: Float32s, point: int
) -> bool:
    """Write the mean of three components under taps ``tap`` … ``end`` − 1, unless they have no weight."""
    a = b = c = total = np.float32(0.0)
    while tap < end:
        weight = scratch.weights[np.uint64(tap)]
        first = np.uint64(3) * np.uint64(scratch.cells[np.uint64(tap)])
        a += weight * table[values[first]]
        b += weight * table[values[first + np.uint64(1)]]
        c += weight * table[values[first + np.uint64(2)]]
        total += weight
        tap += 1
    if total > np.float32(0.0):
        inverse = np.float32(1.0) / total
        row = np.uint64(point)
        results[row, 0], results[row, 1], results[row, 2] = a * inverse, b * inverse, c * inverse
        return True
    return False


# The three kernels below look up rest positions (n, 3). ``values`` (cells, 3) are codes, which ``table``
# decodes. The points where no cell has any weight are written to ``missed``, not their results. They return
# the number of these, and the index of the first position that is not finite, where they stopped, or −1.


@fused_kernel
def nearest_colors(
    tiles: Tiles,
    points: Points,
    origin: Origin,
    size: float,
    values: Values,
    table: Float32s,
    results: Float32s,
    missed: npt.NDArray[np.int64],
) -> tuple[int, int]:
    """Look up the cells that hold the points."""
    scratch = new_scratch()
    flat = values.reshape(-1)
    n_missed = 0
    for begin in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - begin)
        fault = place_block(tiles, points, begin, count, origin, 1.0 / size, NEAREST, scratch)
        if fault >= 0:
            return n_missed, fault
        for n in range(count):
            _nearest_tap(tiles, scratch, n, values.shape[0] - 1)
            prefetch(values, int(scratch.cells[np.uint64(n)]))
        for n in range(count):
            if scratch.weights[np.uint64(n)] > np.float32(0.0):
                first = np.uint64(3) * np.uint64(scratch.cells[np.uint64(n)])
                row = np.uint64(begin + n)
                results[row, 0] = table[flat[first]]
                results[row, 1] = table[flat[first + np.uint64(1)]]
                results[row, 2] = table[flat[first + np.uint64(2)]]
            else:
                missed[n_missed] = begin + n
                n_missed += 1
    return n_missed, -1


@fused_kernel
def linear_colors(
    tiles: Tiles,
    points: Points,
    origin: Origin,
    size: float,
    values: Values,
    table: Float32s,
    results: Float32s,
    missed: npt.NDArray[np.int64],
) -> tuple[int, int]:
    """Interpolate between the 2×2×2 nearest cells."""
    scratch = new_scratch()
    flat = values.reshape(-1)
    n_missed = 0
    for begin in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - begin)
        fault = place_block(tiles, points, begin, count, origin, 1.0 / size, LINEAR, scratch)
        if fault >= 0:
            return n_missed, fault
        for n in range(count):
            _linear_taps(tiles, scratch, n, values.shape[0] - 1, 8 * n)
            for tap in range(8 * n, 8 * n + 8):
                prefetch(values, int(scratch.cells[np.uint64(tap)]))
        for n in range(count):
            if not _blend_color(scratch, 8 * n, 8 * n + 8, flat, table, results, begin + n):
                missed[n_missed] = begin + n
                n_missed += 1
    return n_missed, -1


@fused_kernel
def quadratic_colors(
    tiles: Tiles,
    points: Points,
    origin: Origin,
    size: float,
    values: Values,
    table: Float32s,
    results: Float32s,
    missed: npt.NDArray[np.int64],
    masks: npt.NDArray[np.uint64],
    places: npt.NDArray[np.uint8],
) -> tuple[int, int]:
    """Blend 3×3×3 cells under the quadratic spline. ``masks`` and ``places`` are WINDOW_…."""
    scratch = new_scratch()
    flat = values.reshape(-1)
    n_missed = 0
    for begin in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - begin)
        fault = place_block(tiles, points, begin, count, origin, 1.0 / size, QUADRATIC, scratch)
        if fault >= 0:
            return n_missed, fault
        end = 0
        for n in range(count):
            if _find_window(tiles, scratch, n):
                for node in range(8):
                    prefetch(values, scratch.firsts[node])
            end = _quadratic_taps(scratch, n, values.shape[0] - 1, masks, places, end)
            scratch.ends[np.uint64(n)] = end
        tap = 0
        for n in range(count):
            end = scratch.ends[np.uint64(n)]
            if not _blend_color(scratch, tap, end, flat, table, results, begin + n):
                missed[n_missed] = begin + n
                n_missed += 1
            tap = end
    return n_missed, -1


@fused_kernel
def tiled_taps(
    tiles: Tiles,
    arrays: TreeArrays,
    kept_cells: npt.NDArray[np.uint32],
    points: Points,
    first_point: int,
    origin: Origin,
    size: float,
    filter_code: int,
    walk: Walk,
    starts: npt.NDArray[np.int64],
    rows: npt.NDArray[np.uint32],
    weights: Float32s,
    slopes: Float32s,
    masks: npt.NDArray[np.uint64],
    places: npt.NDArray[np.uint8],
) -> int:
    """Do as `neighborhood.walk_all`, for LINEAR or QUADRATIC without slopes; walk off the surface only."""
    scratch = new_scratch()
    last = arrays.flags.size - 1
    end = 0
    done = 0
    starts[0] = 0
    for begin in range(first_point, points.shape[0], BLOCK):
        if end + BLOCK * MOST_TAPS > rows.size:
            break
        count = min(BLOCK, points.shape[0] - begin)
        fault = place_block(tiles, points, begin, count, origin, 1.0 / size, filter_code, scratch)
        if fault >= 0:
            return -1 - fault
        for n in range(count):
            if filter_code == LINEAR:
                n_taps = _linear_taps(tiles, scratch, n, last, 0)
            else:
                _find_window(tiles, scratch, n)
                n_taps = _quadratic_taps(scratch, n, last, masks, places, 0)
            total = np.float32(0.0)
            for tap in range(n_taps):
                total += scratch.weights[tap]
            if total > np.float32(0.0):
                for tap in range(n_taps):
                    rows[end] = scratch.cells[tap]
                    weights[end] = scratch.weights[tap] / total
                    end += scratch.weights[tap] > np.float32(0.0)
            else:
                x = (np.float64(points[begin + n, 0]) - origin[0]) / size
                y = (np.float64(points[begin + n, 1]) - origin[1]) / size
                z = (np.float64(points[begin + n, 2]) - origin[2]) / size
                end = walk_taps(arrays, kept_cells, x, y, z, filter_code, walk, rows, weights, slopes, end)
            done += 1
            starts[done] = end
    return done
