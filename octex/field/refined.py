"""Coefficients of cells that are not stored: what the field refines to them (paper 4.2)."""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s, Int64s, Uint32s
from octex.field.neighborhood import MOST_TAPS, collect, new_walk, normalize
from octex.field.refinement import change_level
from octex.field.splines import QUADRATIC
from octex.field.windows import SHARES, UPPER, Walk, follow
from octex.jit import kernel
from octex.tree.layout import MAX_DEPTH, TreeArrays
from octex.tree.morton import decode
from octex.tree.octree import Octree

#: Cells whose taps are found at once: most have 8 to 27.
_BLOCK = 1 << 14
_MIDDLE = 13


def refined_taps(tree: Octree, codes: Int64s, level: int) -> tuple[Int64s, Uint32s, Float32s]:
    """Find what the quadratic field refines to cells (n,) of a level that lie below leaves of a tree.

    ``codes`` are Morton codes. Returns starts (n + 1,), rows and weights as `Field.taps` does; a cell that
    nothing is refined to has no taps.
    """
    walk = new_walk()
    starts = np.zeros(codes.size + 1, np.int64)
    rows, weights = [np.empty(0, np.uint32)], [np.empty(0, np.float32)]
    room = 27 * _BLOCK + MOST_TAPS
    some_rows, some_weights = np.empty(room, np.uint32), np.empty(room, np.float32)
    begin = 0
    while begin < codes.size:
        done = _refine_all(
            tree.arrays, tree.kept.cells, codes, begin, level, walk, starts[begin:], some_rows, some_weights
        )
        end = int(starts[begin + done])
        rows.append(some_rows[:end].copy())
        weights.append(some_weights[:end].copy())
        starts[begin : begin + done + 1] += sum(map(len, rows[:-1]))
        begin += done
    return starts, np.concatenate(rows), np.concatenate(weights)


@kernel
def _refine_all(
    arrays: TreeArrays,
    kept_cells: Uint32s,
    codes: Int64s,
    begin: int,
    level: int,
    walk: Walk,
    starts: Int64s,
    rows: Uint32s,
    weights: Float32s,
) -> int:
    """Write the taps of cells from ``begin`` on, as many as fit; return how many are done."""
    no_slopes = np.empty((0, 3), np.float32)
    shift = MAX_DEPTH - level
    end = 0
    starts[0] = 0
    done = 0
    for n in range(begin, codes.size):
        if end + MOST_TAPS > rows.size:
            break
        i, j, k = decode(codes[n])
        i, j, k = i << shift, j << shift, k << shift
        deepest = follow(arrays, kept_cells, walk, i, j, k, QUADRATIC, 2)
        walk.windows[SHARES, :27] = 0.0
        walk.windows[SHARES, _MIDDLE] = 1.0
        for each in range(level, deepest, -1):  # windows without stored cells
            half = MAX_DEPTH - each
            walk.levels[each, UPPER] = i >> half & 1 | (j >> half & 1) << 1 | (k >> half & 1) << 2
            change_level(walk, SHARES, each, 2, False)
        first = min(level, deepest)
        count, total = collect(arrays, kept_cells, walk, first, False, QUADRATIC, 2, 1, rows, end)
        if total > 0.0:
            normalize(walk, count, total, weights, no_slopes, end)
            end += count
        done += 1
        starts[done] = end
    return done
