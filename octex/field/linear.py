"""`linear` by tiles: the 2×2×2 cells whose centres are around the point."""

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
from octex.jit import fused_kernel, inlined, kernel, popcount, prefetch
from octex.tree.search import Origin


class LinearBlock(NamedTuple):
    """A block of points and their taps: tap t of point n is at t · BLOCK + n. x changes first."""

    near: Near
    steps: Float32s  # (3 · BLOCK,)   from the lowest cell's centre, in cells; y and z a block later each
    octants: Bytes  # (8 · BLOCK,)   of 2×2×2 tiles
    bits: Bytes  # (8 · BLOCK,)
    masks: npt.NDArray[np.int32]  # (8 · BLOCK,)   the low bit: is the cell stored?
    cells: Uint32s  # (8 · BLOCK,)
    weights: Float32s  # (8 · BLOCK,)   zero where no cell is stored


@kernel
def new_linear_block() -> LinearBlock:
    """Return a block that knows nothing. It serves one tree."""
    return LinearBlock(
        new_near(),
        np.zeros(3 * BLOCK, np.float32),
        np.zeros(8 * BLOCK, np.uint8),
        np.zeros(8 * BLOCK, np.uint8),
        np.zeros(8 * BLOCK, np.int32),
        np.zeros(8 * BLOCK, np.uint32),
        np.zeros(8 * BLOCK, np.float32),
    )


@inlined
def _place(
    points: Points, begin: int, count: int, origin: Origin, inverse: float, depth: int, block: LinearBlock
) -> int:
    """Find each point's tile and the codes of its cells; return the first that is not finite, or −1."""
    cells = float(1 << depth)
    one, two, three = np.int32(1), np.int32(2), np.int32(3)
    faults = 0
    for n in range(count):
        x, y, z, fault = in_root(points, begin + n, origin, inverse)
        faults |= fault
        x, y, z = x * cells - 0.5, y * cells - 0.5, z * cells - 0.5
        u, v, w = np.floor(x), np.floor(y), np.floor(z)
        at = np.uint64(n)
        block.steps[at] = x - u
        block.steps[at + np.uint64(BLOCK)] = y - v
        block.steps[at + np.uint64(2 * BLOCK)] = z - w
        i, j, k = np.int32(u), np.int32(v), np.int32(w)
        block.near.keys[at] = tile_key(np.int64(i >> three), np.int64(j >> three), np.int64(k >> three))
        i, j, k = i & np.int32(7), j & np.int32(7), k & np.int32(7)
        block.near.reached[at] = (i + one) >> three | (j + one) >> three << one | (k + one) >> three << two
        for tap in range(8):
            code = code_in_tile(
                i + one if tap & 1 else i, j + one if tap & 2 else j, k + one if tap & 4 else k
            )
            block.octants[at + np.uint64(tap * BLOCK)] = code >> np.int32(8)
            block.bits[at + np.uint64(tap * BLOCK)] = code & np.int32(63)
    return first_fault(points, begin, count, origin, inverse) if faults != 0 else -1


@inlined
def _find(tiles: Tiles, octant: int, block: LinearBlock, at: np.uint64) -> None:
    bit = np.uint64(block.bits[at])
    mask = tiles.masks[np.uint64(octant)]
    below = mask & ((np.uint64(1) << bit) - np.uint64(1))
    block.cells[at] = np.int64(tiles.firsts[np.uint64(octant)]) + popcount(below)
    block.masks[at] = np.int32(mask >> bit)


@inlined
def _find_cells(tiles: Tiles, rows: Rows, block: LinearBlock, count: int) -> None:
    """Find the cells of each point by the tiles, which are known, and ask for their rows."""
    near = block.near
    for n in range(count):
        at = np.uint64(n)
        slot = near.slots[at]
        if near.reached[at] == 0:
            first = near.octants[np.uint64(slot)]
            for tap in range(8):
                tap_at = at + np.uint64(tap * BLOCK)
                _find(tiles, first + np.int64(block.octants[tap_at]), block, tap_at)
        else:
            for tap in range(8):
                tap_at = at + np.uint64(tap * BLOCK)
                octant = np.int64(block.octants[tap_at])
                _find(tiles, near.octants[np.uint64(slot + (octant >> 3))] + (octant & 7), block, tap_at)
        for tap in (0, 3, 5, 6):  # the others mostly lie beside these
            prefetch(rows, int(block.cells[at + np.uint64(tap * BLOCK)]))


@inlined
def _weigh(block: LinearBlock, count: int, last: int) -> None:
    one = np.float32(1.0)
    steps, weights = block.steps, block.weights
    for n in range(count):
        at = np.uint64(n)
        r, s, t = steps[at], steps[at + np.uint64(BLOCK)], steps[at + np.uint64(2 * BLOCK)]
        for tap in range(8):
            weight = (r if tap & 1 else one - r) * ((s if tap & 2 else one - s) * (t if tap & 4 else one - t))
            tap_at = at + np.uint64(tap * BLOCK)
            weights[tap_at] = weight * np.float32(block.masks[tap_at] & np.int32(1))
    most = np.uint32(last)
    for n in range(8 * BLOCK):
        block.cells[n] = min(block.cells[n], most)


@inlined
def linear_block(
    tiles: Tiles,
    points: Points,
    begin: int,
    count: int,
    origin: Origin,
    size: float,
    rows: Rows,
    block: LinearBlock,
) -> int:
    """Find the taps of a block of points, flat; return the index of the first that is not finite, or −1.

    ``rows`` are what will be read of the cells, and are asked for.
    """
    fault = _place(points, begin, count, origin, 1.0 / size, tiles.depth, block)
    if fault < 0:
        find_tiles(tiles, block.near, count)
        _find_cells(tiles, rows, block, count)
        _weigh(block, count, rows.shape[0] - 1)
    return fault


@fused_kernel
def linear_colors(tiles: Tiles, origin: Origin, size: float, task: Task) -> tuple[int, int]:
    """Interpolate between the 2×2×2 nearest cells. See `nearest_colors`."""
    block, seen = new_linear_block(), new_seen()
    points, values = task.points, task.codes.values
    flat_points, flat_values, flat_results = (
        points.reshape(-1),
        values.reshape(-1),
        task.colors.results.reshape(-1),
    )
    n_missed = 0
    for begin in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - begin)
        fault = linear_block(tiles, flat_points, begin, count, origin, size, values, block)
        if fault >= 0:
            return n_missed, fault
        weigh_by_area(task.areas, block.cells, block.weights, 8 * BLOCK)
        if task.sight.mode == ALL:
            for n in range(count):
                if not blend_all(
                    *(task, begin + n, block.cells, block.weights, n, n + 8 * BLOCK, BLOCK),
                    *(flat_values, flat_results),
                ):
                    task.colors.missed[n_missed] = begin + n
                    n_missed += 1
            continue
        ask_for_facings(task.sight, block.cells, 8 * BLOCK)
        for n in range(count):
            see_taps(task, begin, n, block.cells, block.weights, n, n + 8 * BLOCK, BLOCK, seen)
        n_missed = blend_seen(task, begin, count, seen, n_missed)
    return n_missed, -1
