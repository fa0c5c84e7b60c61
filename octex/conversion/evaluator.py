"""The quadratic field by coefficients, for points that lie close together one after another.

A window's coefficients (`windows`) are those of its leaves, and below leaves what the window above refines
to; they are written once for all points in it. A value is their sum under the spline's weights. Looked up
with a normal, coefficients are those of the rows that face it, and what faces away weighs next to nothing:
see `field.taps`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Uint32s, Uint64s
from octex.field.splines import QUADRATIC
from octex.field.weights import View, face_cell
from octex.field.windows import BEGIN, CONTENT, INSIDE, UPPER, Walk, Way, cell_at, follow, place_of
from octex.jit import (
    fused_inlined,
    inlined,
    kernel,
    popcount,
    put,
    spline_at_eight,
    trailing_zeros,
)
from octex.jit.vectors import eight, four, four_at, lanes, vector_of
from octex.tree.layout import FACING_FLAGS, MAX_DEPTH, SPLIT, TreeArrays

_PLACES = 27
_LEVELS = MAX_DEPTH + 1
NO_KEPT = np.empty(0, np.uint32)
_ZERO = np.float32(0)
#: For kinds of cells, a bit for each of the 2⁶ sets of facings: split cells have that of the empty set.
SPLIT_KIND = np.uint64(1)


class Coefficients(NamedTuple):
    """A tree without kept coefficients, and its channels as windows read them."""

    arrays: TreeArrays
    splits: Uint32s  # (cells,) or (0,)   the first of a split cell's rows in the split table
    first_row: int  # that table's first, among the rows
    rows: Float32s  # (rows · vectors, 4)   of a cell or a facing: components, a one, zeros
    components: int
    alpha: int  # the component that covers all others, or −1


class Windows(NamedTuple):
    """What is known of the windows around the latest point, of several fields of as many vectors a row."""

    rows: Float32s  # (fields · vectors · levels · places, 4)   coefficients; zeros where there is none
    known: Bools  # (fields, levels)   whether the level's coefficients are written
    kinds: Uint64s  # (fields, levels)   the kinds of cells that they are made of


@kernel
def new_windows(fields: int, vectors: int) -> Windows:
    """Return windows of which nothing is known."""
    return Windows(
        np.zeros((fields * vectors * _LEVELS * _PLACES, 4), np.float32),
        np.zeros((fields, _LEVELS), np.bool_),
        np.zeros((fields, _LEVELS), np.uint64),
    )


@inlined
def enter(field: Coefficients, walk: Walk, windows: Windows, which: int, i: int, j: int, k: int) -> int:
    """Return the level whose window is read around a cell of MAX_DEPTH; forget the windows that it left.

    Those of each second field from ``which`` on belong to the walk.
    """
    walk.previous[5] = MAX_DEPTH  # becomes the last level whose window is that of the point before
    level = follow(Way(field.arrays, NO_KEPT, walk, QUADRATIC, 2, 1, False), i, j, k)
    for changed in range(walk.previous[5] + 1, level + 1):
        for each in range(which, windows.known.shape[0], 2):
            windows.known[each, changed] = False
    return level


@inlined
def is_refined(walk: Walk, level: int) -> bool:
    """Say whether a window has cells below leaves, or below nothing beside these."""
    if level == 0 or walk.levels[level - 1, CONTENT] == 0:
        return False
    return bool(INSIDE[0, walk.levels[level, BEGIN], 0] & ~walk.real[level, 0] != 0)


@inlined
def kind_of(flags: np.uint8) -> np.uint64:
    """Return the kind of a cell as a bit: its facings, or that it is split."""
    if flags & np.uint8(SPLIT) != 0:
        return SPLIT_KIND
    facings = flags & np.uint8(FACING_FLAGS)
    return np.uint64(1) << np.uint64(facings) if facings != 0 else np.uint64(0)


@inlined
def find_coefficients(
    field: Coefficients, walk: Walk, windows: Windows, which: int, level: int, is_facing: bool, view: View
) -> None:
    """Write the coefficients of a level's window, and before it of those that it is refined from."""
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
    """Write the sums of coefficients under the spline's weights at eight points in the middle cell, 0 … 1.

    They go to columns of ``totals`` (4 · vectors, MOST_POINTS), from ``first`` on.
    """
    of_x, of_y, of_z = _weights(points[0]), _weights(points[1]), _weights(points[2])
    for vector in range(vectors):
        row = ((which * vectors + vector) * _LEVELS + level) * _PLACES
        found = spline_at_eight(windows.rows, row, of_x, of_y, of_z)
        at = 4 * vector * totals.shape[1] + first
        put(totals, at, found[0])
        put(totals, at + totals.shape[1], found[1])
        put(totals, at + 2 * totals.shape[1], found[2])
        put(totals, at + 3 * totals.shape[1], found[3])


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
    """Write the coefficients of a level's window, and what they are made of."""
    vectors = (field.components + 4) // 4
    begin = walk.levels[level, BEGIN]
    inside = INSIDE[0, begin, 0]
    leaves = (walk.cells[level, 0] ^ walk.nodes[level, 0]) & inside
    start, stride = (which * vectors * _LEVELS + level) * _PLACES, _LEVELS * _PLACES
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
                shown = _faced(field, cell, flags, view, vectors, vector)
                put(windows.rows, 4 * (at + vector * stride), shown)
            continue
        kinds |= kind_of(flags)
        for vector in range(vectors):
            put(windows.rows, 4 * (at + vector * stride), _covered(field, cell, vectors, vector))
    windows.kinds[which, level] = kinds
    windows.known[which, level] = True


@inlined
def _faced(field: Coefficients, cell: int, flags: np.uint8, view: View, vectors: int, vector: int) -> Any:
    """Return a part of what a cell shows to a normal."""
    part, x, y, z = face_cell(flags, view)
    if not (x + y + z > _ZERO and field.splits.size > 0):
        return four(0.0) + four(part) * _covered(field, cell, vectors, vector)
    found = four(0.0)
    for axis in range(3):
        share = x if axis == 0 else (y if axis == 1 else z)
        if share > _ZERO:
            row = _row_of(field, cell, flags, 2 * axis + (view[3] >> axis & 1))
            found = found + four(part * share) * _covered(field, row, vectors, vector)
    return found


@inlined
def _row_of(field: Coefficients, cell: int, flags: np.uint8, facing: int) -> int:
    """Return the row of a split cell's facing."""
    below = np.uint64(flags) & ((np.uint64(1) << np.uint64(facing)) - np.uint64(1))
    return int(field.first_row + np.int64(field.splits[cell]) + popcount(below))


@inlined
def _covered(field: Coefficients, row: int, vectors: int, vector: int) -> Any:
    """Return a part of a row, times its alpha."""
    stored, alpha = four_at(field.rows, 4 * (row * vectors + vector)), field.alpha
    if alpha < 0:
        return stored
    a, b, c, d = lanes(stored)
    coverage = field.rows[row * vectors + (alpha >> 2), alpha & 3]
    own, one = alpha - 4 * vector, field.components - 4 * vector
    a = a if own == 0 or one == 0 else a * coverage
    b = b if own == 1 or one == 1 else b * coverage
    c = c if own == 2 or one == 2 else c * coverage
    d = d if own == 3 or one == 3 else d * coverage
    return vector_of((a, b, c, d))


@inlined
def _refine(rows: Float32s, first: int, upper: int) -> None:
    """Refine the window above into that from row ``first`` on; ``upper`` is the half of its parent."""
    step, near, far = 4, four(0.75), four(0.25)
    first, places = 4 * first, 4 * _PLACES
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
