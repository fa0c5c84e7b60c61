"""`quadratic` by tiles: the 3×3×3 cells around that of the point, under a spline.

They lie in a *window* of 4×4×4, the children of 2×2×2 nodes, which is kept while points stay in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.field.blend import (
    Task,
    ask_for_facings,
    blend_all,
    blend_seen,
    new_seen,
    see_taps,
    weigh_by_area,
)
from octex.field.blocks import (
    BLOCK,
    Bytes,
    Float32s,
    Int64s,
    Near,
    Points,
    Rows,
    Uint32s,
    find_tiles,
    first_fault,
    in_root,
    new_near,
    tile_key,
)
from octex.field.facings import ALL
from octex.field.tiles import Tiles, code_in_tile
from octex.jit import fused_kernel, inlined, kernel, popcount, prefetch, trailing_zeros
from octex.tree.search import Origin

Uint16s = npt.NDArray[np.uint16]
Uint64s = npt.NDArray[np.uint64]


class QuadraticBlock(NamedTuple):
    """A block of points and their taps, one point's after another's."""

    near: Near
    windows: Bytes  # (BLOCK,)   the lowest node of each point's window in the tile: x | y << 2 | z << 4
    parities: Bytes  # (BLOCK,)   of the lowest cell read, which lies in that node: x | y << 1 | z << 2
    along: Float32s  # (12 · BLOCK,)   weights along x, then products of those along y and z
    latest: Int64s  # (2,)   the latest window, and the key of its tile
    mask: Uint64s  # (1,)   which of its cells are stored, in Morton order
    firsts: Int64s  # (8,)   the first stored child of each of its nodes, less all that the mask has before
    cells: Uint32s  # (27 · BLOCK,)
    weights: Float32s  # (27 · BLOCK,)
    ends: Int64s  # (BLOCK,)   of each point's taps


@kernel
def new_quadratic_block() -> QuadraticBlock:
    """Return a block that knows nothing. It serves one tree."""
    return QuadraticBlock(
        new_near(),
        np.zeros(BLOCK, np.uint8),
        np.zeros(BLOCK, np.uint8),
        np.zeros(12 * BLOCK, np.float32),
        np.full(2, -1, np.int64),
        np.zeros(1, np.uint64),
        np.zeros(8, np.int64),
        np.zeros(27 * BLOCK, np.uint32),
        np.zeros(27 * BLOCK, np.float32),
        np.zeros(BLOCK, np.int64),
    )


def _window_tables() -> tuple[Uint64s, Uint16s]:
    """Say what of a window is read, by the parities of the lowest cell read.

    Returns masks (8,) of the 3×3×3 cells, and for each bit (2 · 8 · 64,) where in `QuadraticBlock.along` its
    weight along x is for the first point of a block, and then that along y and z.
    """
    masks, places = np.zeros(8, np.uint64), np.zeros((8, 64, 2), np.uint16)
    for parity in range(8):
        for bit in range(64):
            x, y, z = (
                (bit >> axis & 1 | (bit >> axis + 3 & 1) << 1) - (parity >> axis & 1) for axis in range(3)
            )
            if min(x, y, z) >= 0 and max(x, y, z) < 3:
                masks[parity] |= np.uint64(1 << bit)
                places[parity, bit] = BLOCK * x, BLOCK * (3 + 3 * y + z)
    return masks, places.reshape(-1)


#: What of a window is read, for `quadratic_block`.
WINDOW_TABLES = _window_tables()


@inlined
def _weights(t: np.float32) -> tuple[np.float32, np.float32, np.float32]:
    half, one = np.float32(0.5), np.float32(1.0)
    low, high = half * (one - t) * (one - t), half * t * t
    return low, one - low - high, high


@inlined
def _weigh_along(
    along: Float32s, at: np.uint64, weight: np.float32, p: np.float32, q: np.float32, r: np.float32
) -> None:
    along[at] = weight * p
    along[at + np.uint64(BLOCK)] = weight * q
    along[at + np.uint64(2 * BLOCK)] = weight * r


@inlined
def _place(
    points: Points, begin: int, count: int, origin: Origin, inverse: float, depth: int, block: QuadraticBlock
) -> int:
    """Find each point's tile and window, and weigh; return the first point that is not finite, or −1."""
    cells = float(1 << depth)
    most = cells - 1.0
    one, two, three, four = np.int32(1), np.int32(2), np.int32(3), np.int32(4)
    faults = 0
    for n in range(count):
        x, y, z, fault = in_root(points, begin + n, origin, inverse)
        faults |= fault
        x, y, z = x * cells, y * cells, z * cells
        u, v, w = min(np.floor(x), most), min(np.floor(y), most), min(np.floor(z), most)
        i, j, k = np.int32(u) - one, np.int32(v) - one, np.int32(w) - one
        at = np.uint64(n)
        block.near.keys[at] = tile_key(np.int64(i >> three), np.int64(j >> three), np.int64(k >> three))
        e, f, g = i >> one & three, j >> one & three, k >> one & three
        block.windows[at] = e | f << two | g << four
        block.near.reached[at] = (e + one) >> two | (f + one) >> two << one | (g + one) >> two << two
        block.parities[at] = i & one | (j & one) << one | (k & one) << two
        along = block.along
        p, q, r = _weights(np.float32(x - u))
        _weigh_along(along, at, np.float32(1.0), p, q, r)
        a, b, c = _weights(np.float32(y - v))
        p, q, r = _weights(np.float32(z - w))
        _weigh_along(along, at + np.uint64(3 * BLOCK), a, p, q, r)
        _weigh_along(along, at + np.uint64(6 * BLOCK), b, p, q, r)
        _weigh_along(along, at + np.uint64(9 * BLOCK), c, p, q, r)
    return first_fault(points, begin, count, origin, inverse) if faults != 0 else -1


@inlined
def _add_node(
    tiles: Tiles,
    rows: Rows,
    block: QuadraticBlock,
    slot: int,
    node: int,
    i: int,
    j: int,
    k: int,
    mask: np.uint64,
) -> np.uint64:
    """Add the children of a node at (i, j, k), 0 … 4, from the tile on, to the window's mask."""
    code = code_in_tile(2 * i, 2 * j, 2 * k)
    octant = np.uint64(block.near.octants[np.uint64(slot + (code >> 11))] + (code >> 8 & 7))
    shift = np.uint64(code & 63)
    word = tiles.masks[octant]
    below = word & ((np.uint64(1) << shift) - np.uint64(1))
    first = np.int64(tiles.firsts[octant]) + popcount(below)
    prefetch(rows, int(first))
    block.firsts[np.uint64(node)] = first - popcount(mask)
    return np.uint64(mask | ((word >> shift) & np.uint64(0xFF)) << np.uint64(8 * node))


@inlined
def _find_window(tiles: Tiles, rows: Rows, block: QuadraticBlock, n: int) -> None:
    """Know the window of point n, and ask for the rows of its cells."""
    window, key = np.int64(block.windows[np.uint64(n)]), block.near.keys[np.uint64(n)]
    if (window == block.latest[0]) & (key == block.latest[1]):
        return
    block.latest[0], block.latest[1] = window, key
    i, j, k = int(window & 3), int(window >> 2 & 3), int(window >> 4)
    slot = block.near.slots[np.uint64(n)]
    mask = np.uint64(0)
    for node in range(8):
        mask = _add_node(
            tiles, rows, block, slot, node, i + (node & 1), j + (node >> 1 & 1), k + (node >> 2), mask
        )
    block.mask[0] = mask


@inlined
def quadratic_block(
    tiles: Tiles,
    points: Points,
    begin: int,
    count: int,
    origin: Origin,
    size: float,
    rows: Rows,
    masks: Uint64s,
    places: Uint16s,
    block: QuadraticBlock,
) -> int:
    """Find the taps of a block of points, flat; return the index of the first that is not finite, or −1.

    ``rows`` are what will be read of the cells, and are asked for; ``masks`` and ``places`` WINDOW_TABLES.
    """
    fault = _place(points, begin, count, origin, 1.0 / size, tiles.depth, block)
    if fault >= 0:
        return fault
    find_tiles(tiles, block.near, count)
    end = 0
    for n in range(count):
        _find_window(tiles, rows, block, n)
        at = np.uint64(n)
        parity = np.uint64(block.parities[at])
        mask = block.mask[0]
        left = mask & masks[parity]
        while left != np.uint64(0):
            bit = np.uint64(trailing_zeros(left))
            left &= left - np.uint64(1)
            below = mask & ((np.uint64(1) << bit) - np.uint64(1))
            place = parity << np.uint64(7) | bit << np.uint64(1)
            block.cells[np.uint64(end)] = block.firsts[bit >> np.uint64(3)] + popcount(below)
            block.weights[np.uint64(end)] = (
                block.along[np.uint64(places[place]) + at]
                * block.along[np.uint64(places[place + np.uint64(1)]) + at]
            )
            end += 1
        block.ends[at] = end
    most = np.uint32(rows.shape[0] - 1)
    for tap in range(end):
        block.cells[tap] = min(block.cells[tap], most)
    return -1


@fused_kernel
def quadratic_colors(
    tiles: Tiles, origin: Origin, size: float, task: Task, masks: Uint64s, places: Uint16s
) -> tuple[int, int]:
    """Blend 3×3×3 cells under the quadratic spline. See `nearest_colors` and `quadratic_block`."""
    block, seen = new_quadratic_block(), new_seen()
    points, values = task.points, task.codes.values
    flat_points, flat_values, flat_results = (
        points.reshape(-1),
        values.reshape(-1),
        task.colors.results.reshape(-1),
    )
    n_missed = 0
    for begin in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - begin)
        fault = quadratic_block(tiles, flat_points, begin, count, origin, size, values, masks, places, block)
        if fault >= 0:
            return n_missed, fault
        weigh_by_area(task.areas, block.cells, block.weights, block.ends[np.uint64(count - 1)])
        tap = 0
        if task.sight.mode == ALL:
            for n in range(count):
                end = block.ends[np.uint64(n)]
                if not blend_all(
                    task, begin + n, block.cells, block.weights, tap, end, 1, flat_values, flat_results
                ):
                    task.colors.missed[n_missed] = begin + n
                    n_missed += 1
                tap = end
            continue
        ask_for_facings(task.sight, block.cells, block.ends[count - 1])
        for n in range(count):
            see_taps(task, begin, n, block.cells, block.weights, tap, block.ends[n], 1, seen)
            tap = block.ends[n]
        n_missed = blend_seen(task, begin, count, seen, n_missed)
    return n_missed, -1
