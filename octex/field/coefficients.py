"""The quadratic field by coefficients, for points that lie close together one after another.

A window's coefficients (`windows`) are those of its leaves, and below leaves what the window above refines
to; they are written once for all points in it. A value is their sum under the spline's weights.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from octex.field.splines import QUADRATIC, quadratic_weights
from octex.field.windows import BEGIN, CONTENT, INSIDE, UPPER, Walk, cell_at, follow, place_of
from octex.jit import inlined, kernel, trailing_zeros, weighted_rows
from octex.tree.layout import MAX_DEPTH, TreeArrays

Floats = npt.NDArray[np.float32]

Four: TypeAlias = tuple[np.float32, np.float32, np.float32, np.float32]

_PLACES = 27
_ZERO = np.float32(0)


class Windows(NamedTuple):
    """What is known of the windows around the latest sample."""

    rows: Floats  # (vectors · levels · places, 4)   coefficients; zeros where there is none
    numbers: npt.NDArray[np.int32]  # (vectors, levels · places)   their rows, one after another
    weights: Floats  # (levels · places,)   the spline's, in the window that is read
    known: npt.NDArray[np.bool_]  # (levels,)   whether the level's coefficients are written


@kernel
def new_windows(vectors: int) -> Windows:
    """Return windows of which nothing is known, of one tree with ``vectors`` rows of four a cell."""
    levels = MAX_DEPTH + 1
    rows = vectors * levels * _PLACES
    return Windows(
        np.zeros((rows, 4), np.float32),
        np.arange(rows).astype(np.int32).reshape(vectors, -1),
        np.zeros(levels * _PLACES, np.float32),
        np.zeros(levels, np.bool_),
    )


@inlined
def add_up(
    arrays: TreeArrays,
    kept: npt.NDArray[np.uint32],
    rows: Floats,
    vectors: int,
    x: float,
    y: float,
    z: float,
    walk: Walk,
    windows: Windows,
    totals: Floats,
) -> None:
    """Write the sums of coefficients under the spline's weights at a point of texture space, 0 … 1.

    ``rows`` (cells · vectors, 4) hold the coefficients of leaves; ``totals`` (4 · vectors,). There must be no
    kept coefficients; ``kept`` is empty. Points off the surface have zeros.
    """
    edge = float(1 << MAX_DEPTH)
    i, j, k = int(x * edge), int(y * edge), int(z * edge)
    walk.previous[5] = MAX_DEPTH  # becomes the last level whose window is that of the point before
    level = follow(arrays, kept, walk, i, j, k, QUADRATIC, 2)
    for changed in range(walk.previous[5] + 1, level + 1):
        windows.known[changed] = False
    if not windows.known[level]:
        _find(arrays, rows, vectors, walk, windows, level)
    shift = MAX_DEPTH - level
    cells = float(1 << level)
    first = level * _PLACES
    _weigh(windows, first, x * cells - (i >> shift), y * cells - (j >> shift), z * cells - (k >> shift))
    for vector in range(vectors):
        a, b, c, d = weighted_rows(
            windows.rows, windows.numbers[vector], windows.weights, first, first + _PLACES
        )
        totals[4 * vector], totals[4 * vector + 1] = a, b
        totals[4 * vector + 2], totals[4 * vector + 3] = c, d


@inlined
def _weigh(windows: Windows, first: int, x: float, y: float, z: float) -> None:
    """Write the spline's weights for a point in the cell in the middle, 0 … 1 along each axis."""
    a, b, c = quadratic_weights(x)
    d, e, f = quadratic_weights(y)
    u, v, w = quadratic_weights(z)
    at = first
    for of_z in (u, v, w):
        for of_y in (d, e, f):
            both = of_z * of_y
            windows.weights[at] = a * both
            windows.weights[at + 1] = b * both
            windows.weights[at + 2] = c * both
            at += 3


@inlined
def _find(arrays: TreeArrays, rows: Floats, vectors: int, walk: Walk, windows: Windows, level: int) -> None:
    """Write the coefficients of a level's window, and before it of those that it is refined from."""
    top = level
    while not windows.known[top] and _is_refined(walk, top):
        top -= 1
    for each in range(top, level + 1):
        if not windows.known[each]:
            _gather(arrays, rows, vectors, walk, windows, each)


@inlined
def _is_refined(walk: Walk, level: int) -> bool:
    """Say whether a window has cells below leaves, or below nothing beside these."""
    if level == 0 or walk.levels[level - 1, CONTENT] == 0:
        return False
    return bool(INSIDE[0, walk.levels[level, BEGIN], 0] & ~walk.real[level, 0] != 0)


@inlined
def _gather(arrays: TreeArrays, rows: Floats, vectors: int, walk: Walk, windows: Windows, level: int) -> None:
    """Write the coefficients of a level's window."""
    begin = walk.levels[level, BEGIN]
    inside = INSIDE[0, begin, 0]
    leaves = (walk.cells[level, 0] ^ walk.nodes[level, 0]) & inside
    stride = (MAX_DEPTH + 1) * _PLACES
    empty = inside
    if _is_refined(walk, level):
        for vector in range(vectors):
            _refine(windows.rows, level * _PLACES + vector * stride, walk.levels[level, UPPER])
        empty = inside & walk.real[level, 0] & ~leaves
    while empty != 0:
        at = level * _PLACES + place_of(2, begin, trailing_zeros(empty))
        empty &= empty - np.uint64(1)
        for vector in range(vectors):
            _write(windows.rows, at + vector * stride, (_ZERO, _ZERO, _ZERO, _ZERO))
    while leaves != 0:
        child = trailing_zeros(leaves)
        leaves &= leaves - np.uint64(1)
        at = level * _PLACES + place_of(2, begin, child)
        cell = cell_at(arrays, walk, level, 0, child) * vectors
        for vector in range(vectors):
            _write(windows.rows, at + vector * stride, _read(rows, cell + vector))
    windows.known[level] = True


@inlined
def _refine(rows: Floats, first: int, upper: int) -> None:
    """Refine the window above into that from row ``first`` on; ``upper`` is the half of its parent."""
    step = 1
    for axis in range(3):
        turn = 2 * step if upper >> axis & 1 else 0  # begin at the other end
        source = first - _PLACES if axis == 0 else first
        for block in range(0, _PLACES, 3 * step):
            for at in range(block, block + step):
                low, middle, high = at + turn, at + step, at + 2 * step - turn
                a, b, c = _read(rows, source + low), _read(rows, source + middle), _read(rows, source + high)
                _write(rows, first + low, _blended(a, b))
                _write(rows, first + middle, _blended(b, a))
                _write(rows, first + high, _blended(b, c))
        step *= 3


# Rows are read as a whole before one is written: the compiler makes vectors of that.


@inlined
def _read(rows: Floats, row: int) -> Four:
    return rows[row, 0], rows[row, 1], rows[row, 2], rows[row, 3]


@inlined
def _write(rows: Floats, row: int, values: Four) -> None:
    rows[row, 0], rows[row, 1], rows[row, 2], rows[row, 3] = values


@inlined
def _blended(near: Four, far: Four) -> Four:
    a, b = np.float32(0.75), np.float32(0.25)
    return (
        a * near[0] + b * far[0],
        a * near[1] + b * far[1],
        a * near[2] + b * far[2],
        a * near[3] + b * far[3],
    )
