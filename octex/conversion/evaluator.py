"""The quadratic field by coefficients, for many points in one cell after another.

A window (`field.windows`) has the coefficients of its leaves; below coarser leaves, those of the window
above, refined by subdivision. They are written once for all points in the window. A value is their sum under
the spline's weights. With a normal, they are those of the facing rows, weighted as `field.weights` does.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Uint32s, Uint64s
from octex.field.splines import QUADRATIC
from octex.field.weights import View, face_cell, row_of
from octex.field.windows import BEGIN, CONTENT, INSIDE, UPPER, Walk, Way, cell_at, follow, place_of
from octex.jit import fused_inlined, inlined, put, spline_at_eight, trailing_zeros
from octex.jit.vectors import eight, four, four_at, lanes, vector_of
from octex.tree.layout import FACING_FLAGS, MAX_DEPTH, SPLIT, TreeArrays

PLACES = 27
LEVELS = MAX_DEPTH + 1
NO_KEPT = np.empty(0, np.uint32)
_ZERO = np.float32(0)
#: A cell's *kind* is one of 64 bits, for its set of facings; split cells have the bit of the empty set.
SPLIT_KIND = np.uint64(1)


class Coefficients(NamedTuple):
    """A tree without kept nodes, and its channels as windows read them."""

    arrays: TreeArrays
    splits: Uint32s  # (cells,) or (0,)   a split cell's first row in the split table
    first_row: int  # the number of cells: the split table's first row among `rows`
    rows: Float32s  # (rows · vectors, 4)   of a cell or a facing: components, a one, zeros
    components: int
    alpha: int  # the component that weighs all others, or −1


class Windows(NamedTuple):
    """The windows around the latest point, of several fields with equally many vectors a row."""

    rows: Float32s  # (fields · vectors · levels · places, 4)   coefficients; zeros where there is no cell
    known: Bools  # (fields, levels)   whether the level's coefficients are written
    kinds: Uint64s  # (fields, levels)   the kinds of their cells


@inlined
def enter(field: Coefficients, walk: Walk, windows: Windows, which: int, i: int, j: int, k: int) -> int:
    """Return the level whose window is read around a cell of MAX_DEPTH, and drop the windows that change.

    Every second field from ``which`` on belongs to the walk.
    """
    walk.previous[5] = MAX_DEPTH  # becomes the last level whose window did not change
    level = follow(Way(field.arrays, NO_KEPT, walk, QUADRATIC, 2, 1, False), i, j, k)
    for changed in range(walk.previous[5] + 1, level + 1):
        for each in range(which, windows.known.shape[0], 2):
            windows.known[each, changed] = False
    return level


@inlined
def is_refined(walk: Walk, level: int) -> bool:
    """Say whether a window has coefficients of a coarser level."""
    if level == 0 or walk.levels[level - 1, CONTENT] == 0:
        return False
    return bool(INSIDE[0, walk.levels[level, BEGIN], 0] & ~walk.real[level, 0] != 0)


@inlined
def kind_of(flags: np.uint8) -> np.uint64:
    """Return a cell's kind."""
    if flags & np.uint8(SPLIT) != 0:
        return SPLIT_KIND
    facings = flags & np.uint8(FACING_FLAGS)
    return np.uint64(1) << np.uint64(facings) if facings != 0 else np.uint64(0)


@inlined
def find_coefficients(
    field: Coefficients, walk: Walk, windows: Windows, which: int, level: int, is_facing: bool, view: View
) -> None:
    """Write the coefficients of a level's window, after those of the windows that it is refined from."""
    top = level
    while not windows.known[which, top] and is_refined(walk, top):
        top -= 1
    for each in range(top, level + 1):
        if not windows.known[which, each]:
            _gather(field, walk, windows, which, each, is_facing, view)


@fused_inlined
def add_up(
    windows: Windows,
    which: int,
    vectors: int,
    level: int,
    points: tuple[Any, Any, Any],
    totals: Float32s,
    first: int,
) -> None:
    """Write the spline's sums of coefficients at eight points in the middle cell, 0 … 1.

    They go to columns of ``totals`` (4 · vectors, MOST_POINTS), from ``first`` on.
    """
    of_x, of_y, of_z = _weights(points[0]), _weights(points[1]), _weights(points[2])
    for vector in range(vectors):
        row = ((which * vectors + vector) * LEVELS + level) * PLACES
        sums = spline_at_eight(windows.rows, row, of_x, of_y, of_z)
        at = 4 * vector * totals.shape[1] + first
        put(totals, at, sums[0])
        put(totals, at + totals.shape[1], sums[1])
        put(totals, at + 2 * totals.shape[1], sums[2])
        put(totals, at + 3 * totals.shape[1], sums[3])


@fused_inlined
def _weights(t: Any) -> Any:
    """Return the weights of the quadratic B-spline at eight points."""
    half, one = eight(0.5), eight(1.0)
    low, high = half * (one - t) * (one - t), half * t * t
    return low, one - low - high, high


@inlined
def _gather(
    field: Coefficients, walk: Walk, windows: Windows, which: int, level: int, is_facing: bool, view: View
) -> None:
    """Write the coefficients of a level's window, and their kinds."""
    vectors = (field.components + 4) // 4
    begin = walk.levels[level, BEGIN]
    inside = INSIDE[0, begin, 0]
    leaves = (walk.cells[level, 0] ^ walk.nodes[level, 0]) & inside
    start, stride = (which * vectors * LEVELS + level) * PLACES, LEVELS * PLACES
    empty, kinds = inside, np.uint64(0)
    is_below = is_refined(walk, level)
    if is_below:
        for vector in range(vectors):
            _refine(windows.rows, start + vector * stride, walk.levels[level, UPPER])
        kinds = windows.kinds[which, level - 1]
        empty = inside & walk.real[level, 0] & ~leaves
    while empty != 0:
        at = start + place_of(2, begin, trailing_zeros(empty))
        empty &= empty - np.uint64(1)
        for vector in range(vectors):
            put(windows.rows, 4 * (at + vector * stride), four(0.0))
    while leaves != 0:
        child = trailing_zeros(leaves)
        leaves &= leaves - np.uint64(1)
        at = start + place_of(2, begin, child)
        cell = cell_at(field.arrays, walk, level, 0, child)
        flags = field.arrays.flags[cell]
        if is_facing:
            for vector in range(vectors):
                faced = _faced(field, cell, flags, view, vectors, vector)
                put(windows.rows, 4 * (at + vector * stride), faced)
            continue
        kinds |= kind_of(flags)
        for vector in range(vectors):
            put(windows.rows, 4 * (at + vector * stride), _weighted(field, cell, vectors, vector))
    windows.kinds[which, level] = kinds
    windows.known[which, level] = True


@inlined
def _faced(field: Coefficients, cell: int, flags: np.uint8, view: View, vectors: int, vector: int) -> Any:
    """Return a vector of a cell's value for a normal."""
    part, x, y, z = face_cell(flags, view)
    if not (x + y + z > _ZERO and field.splits.size > 0):
        return four(0.0) + four(part) * _weighted(field, cell, vectors, vector)
    total = four(0.0)
    for axis in range(3):
        share = x if axis == 0 else (y if axis == 1 else z)
        if share > _ZERO:
            first = int(field.first_row + np.int64(field.splits[cell]))
            row = row_of(first, flags, axis, view[3])
            total = total + four(part * share) * _weighted(field, row, vectors, vector)
    return total


@inlined
def _weighted(field: Coefficients, row: int, vectors: int, vector: int) -> Any:
    """Return a vector of a row, times the row's alpha."""
    stored, alpha = four_at(field.rows, 4 * (row * vectors + vector)), field.alpha
    if alpha < 0:
        return stored
    a, b, c, d = lanes(stored)
    coverage = field.rows[row * vectors + (alpha >> 2), alpha & 3]
    lane, one = alpha - 4 * vector, field.components - 4 * vector
    a = a if lane == 0 or one == 0 else a * coverage
    b = b if lane == 1 or one == 1 else b * coverage
    c = c if lane == 2 or one == 2 else c * coverage
    d = d if lane == 3 or one == 3 else d * coverage
    return vector_of((a, b, c, d))


@inlined
def _refine(rows: Float32s, first: int, upper: int) -> None:
    """Subdivide the window above into that from row ``first`` on, the ``upper`` half of its parent."""
    step, near, far = 4, four(0.75), four(0.25)
    first, places = 4 * first, 4 * PLACES
    for axis in range(3):
        turn = 2 * step if upper >> axis & 1 else 0  # begin at the other end
        source = first - places if axis == 0 else first
        for block in range(0, places, 3 * step):
            for at in range(block, block + step, 4):
                low, middle, high = at + turn, at + step, at + 2 * step - turn
                a, b = four_at(rows, source + low), four_at(rows, source + middle)
                c = four_at(rows, source + high)
                put(rows, first + low, near * a + far * b)
                put(rows, first + middle, near * b + far * a)
                put(rows, first + high, near * b + far * c)
        step *= 3
