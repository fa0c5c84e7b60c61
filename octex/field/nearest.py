"""`nearest` by tiles: the colour of the cell that holds the point."""

from __future__ import annotations

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
    Near,
    Points,
    find_tiles,
    first_fault,
    in_root,
    new_near,
    tile_key,
)
from octex.field.facings import ALL
from octex.field.tiles import Tiles, code_in_tile
from octex.jit import fused_kernel, inlined, popcount, prefetch
from octex.tree.layout import GRID_BITS
from octex.tree.search import Origin


@inlined
def _cell(x: float, depth: int) -> np.int32:
    """Find the cell that holds a coordinate 0 … 1, rounded as the vertices of surfaces are."""
    cell = np.int32(x * (1 << GRID_BITS) + 0.5) >> np.int32(GRID_BITS - depth)
    return min(cell, np.int32((1 << depth) - 1))


@inlined
def _place(
    points: Points,
    begin: int,
    count: int,
    origin: Origin,
    inverse: float,
    depth: int,
    near: Near,
    codes: npt.NDArray[np.int32],
) -> int:
    """Find each point's tile, and the code of its cell there; return the first that is not finite, or −1."""
    three, seven = np.int32(3), np.int32(7)
    faults = 0
    for n in range(count):
        x, y, z, fault = in_root(points, begin + n, origin, inverse)
        faults |= fault
        i, j, k = _cell(x, depth), _cell(y, depth), _cell(z, depth)
        near.keys[np.uint64(n)] = tile_key(np.int64(i >> three), np.int64(j >> three), np.int64(k >> three))
        codes[np.uint64(n)] = code_in_tile(i & seven, j & seven, k & seven)
    return first_fault(points, begin, count, origin, inverse) if faults != 0 else -1


@fused_kernel
def nearest_colors(tiles: Tiles, origin: Origin, size: float, task: Task) -> tuple[int, int]:
    """Write the colours of the cells that hold rest positions.

    Where no cell is stored the point's index is written to ``missed`` instead. Returns the number of these,
    and the index of the first position that is not finite, where all stopped, or −1.
    """
    near, codes, seen = new_near(), np.zeros(BLOCK, np.int32), new_seen()
    cells, stored = np.zeros(BLOCK, np.uint32), np.zeros(BLOCK, np.float32)
    points, values = task.points, task.codes.values
    flat_points, flat_values, flat_results = (
        points.reshape(-1),
        values.reshape(-1),
        task.colors.results.reshape(-1),
    )
    last = values.shape[0] - 1
    n_missed = 0
    for begin in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - begin)
        fault = _place(flat_points, begin, count, origin, 1.0 / size, tiles.depth, near, codes)
        if fault >= 0:
            return n_missed, fault
        find_tiles(tiles, near, count)
        for n in range(count):
            at = np.uint64(n)
            code = np.int64(codes[at])
            octant = np.uint64(near.octants[np.uint64(near.slots[at])] + (code >> 8))
            bit = np.uint64(code & 63)
            mask = tiles.masks[octant]
            below = mask & ((np.uint64(1) << bit) - np.uint64(1))
            cell = min(np.int64(tiles.firsts[octant]) + popcount(below), last)
            cells[at] = cell
            stored[at] = np.float32((mask >> bit) & np.uint64(1))
            prefetch(values, cell)
        weigh_by_area(task.areas, cells, stored, count)
        if task.sight.mode == ALL:
            for n in range(count):
                if not blend_all(task, begin + n, cells, stored, n, n + 1, 1, flat_values, flat_results):
                    task.colors.missed[n_missed] = begin + n
                    n_missed += 1
            continue
        ask_for_facings(task.sight, cells, count)
        for n in range(count):
            see_taps(task, begin, n, cells, stored, n, n + 1, 1, seen)
        n_missed = blend_seen(task, begin, count, seen, n_missed)
    return n_missed, -1
