"""Lists of taps found by tiles, as `neighborhood.walk_all` finds them in any tree."""

from __future__ import annotations

import numpy as np

from octex.field.blend import LEAST
from octex.field.blocks import BLOCK, Float32s, Int64s, Points, Uint32s
from octex.field.linear import linear_block, new_linear_block
from octex.field.neighborhood import MOST_TAPS, Walk, walk_all
from octex.field.quadratic import Uint16s, Uint64s, new_quadratic_block, quadratic_block
from octex.field.splines import LINEAR
from octex.field.tiles import Tiles
from octex.jit import inlined, kernel
from octex.tree.layout import TreeArrays
from octex.tree.search import Origin


@inlined
def _take(
    cells: Uint32s,
    weights: Float32s,
    first: int,
    last: int,
    step: int,
    rows: Uint32s,
    parts: Float32s,
    end: int,
) -> tuple[int, np.float32]:
    """Write the taps that weigh, with weights of sum 1, from ``end`` on; return their end, and the cover."""
    total = np.float32(0.0)
    for tap in range(first, last, step):
        total += weights[tap]
    if total >= LEAST:
        for tap in range(first, last, step):
            rows[end] = cells[tap]
            parts[end] = weights[tap] / total
            end += weights[tap] > np.float32(0.0)
    return end, total


@kernel
def tiled_taps(
    tiles: Tiles,
    arrays: TreeArrays,
    kept_cells: Uint32s,
    points: Points,
    first_point: int,
    origin: Origin,
    size: float,
    filter_code: int,
    walk: Walk,
    starts: Int64s,
    rows: Uint32s,
    weights: Float32s,
    slopes: Float32s,
    covers: Float32s,
    masks: Uint64s,
    places: Uint16s,
) -> int:
    """Do as `neighborhood.walk_all`, for LINEAR or QUADRATIC without slopes; walk off the surface only."""
    linear, quadratic = new_linear_block(), new_quadratic_block()
    flat = points.reshape(-1)
    end = 0
    done = 0
    starts[0] = 0
    for begin in range(first_point, points.shape[0], BLOCK):
        if end + BLOCK * MOST_TAPS > rows.size:
            break
        count = min(BLOCK, points.shape[0] - begin)
        if filter_code == LINEAR:
            fault = linear_block(tiles, flat, begin, count, origin, size, arrays.flags, linear)
        else:
            fault = quadratic_block(
                tiles, flat, begin, count, origin, size, arrays.flags, masks, places, quadratic
            )
        if fault >= 0:
            return -1 - fault
        tap = 0
        for n in range(count):
            start = end
            if filter_code == LINEAR:
                end, covers[done] = _take(
                    linear.cells, linear.weights, n, n + 8 * BLOCK, BLOCK, rows, weights, end
                )
            else:
                end, covers[done] = _take(
                    quadratic.cells, quadratic.weights, tap, quadratic.ends[n], 1, rows, weights, end
                )
                tap = quadratic.ends[n]
            if end == start:
                point, ends = points[begin + n : begin + n + 1], starts[done : done + 2]
                walk_all(
                    *(arrays, kept_cells, point, 0, origin, size, filter_code, walk),
                    *(ends, rows[start:], weights[start:], slopes, covers[done : done + 1]),
                )
                end = start + ends[1]
                starts[done] = start
            done += 1
            starts[done] = end
    return done
