"""The quadratic field at samples: what lies around a cell is gathered once for all samples in it.

Samples lie in Morton order, so that consecutive ones share windows (`field.windows`) at all levels. A
window's coefficients are those of its leaves, and below leaves what the window above refines to; a value is
their sum under the spline's weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from octex.channels import decode
from octex.conversion.samples import PLACE_STEPS, Samples
from octex.field.splines import QUADRATIC, quadratic_weights
from octex.field.windows import BEGIN, CONTENT, INSIDE, UPPER, Walk, cell_at, follow, new_walk, place_of
from octex.jit import inlined, kernel, trailing_zeros, weighted_rows
from octex.texture.channel import Channel
from octex.tree.layout import MAX_DEPTH, TreeArrays
from octex.tree.morton import decode as decode_cell
from octex.tree.octree import Octree

Floats = npt.NDArray[np.float32]
Int64s = npt.NDArray[np.int64]

Four: TypeAlias = tuple[np.float32, np.float32, np.float32, np.float32]

_PLACES = 27
_ZERO = np.float32(0)
_NO_KEPT = np.empty(0, np.uint32)


class Coefficients(NamedTuple):
    """A tree without kept coefficients, and its cells' values as lookups add them up."""

    arrays: TreeArrays
    rows: Floats  # (cells · vectors, 4)   a cell's components, times its alpha, then a one
    components: int
    alpha: int  # the component that is the alpha, or −1

    @classmethod
    def of(cls, tree: Octree, channels: Mapping[str, Channel], samples: Samples) -> Coefficients:
        """Decode the channels that the samples have."""
        components = sum(form.components for form in samples.channels)
        rows = np.zeros((tree.n_cells, -(-(components + 1) // 4) * 4), np.float32)
        alpha = -1
        end = 0
        for form in samples.channels:
            start, end = end, end + form.components
            rows[:, start:end] = decode(channels[form.name].values[: tree.n_cells], form.space)
            alpha = start if form.name == "alpha" else alpha
        if alpha >= 0:
            others = np.arange(components) != alpha
            rows[:, :components][:, others] *= rows[:, alpha, None]
        rows[:, components] = 1.0
        return cls(tree.arrays, rows.reshape(-1, 4), components, alpha)


class Windows(NamedTuple):
    """What is known of the windows around the latest sample."""

    rows: Floats  # (vectors · levels · places, 4)   coefficients; zeros where there is none
    numbers: npt.NDArray[np.int32]  # (vectors, levels · places)   their rows, one after another
    weights: Floats  # (levels · places,)   the spline's, in the window that is read
    known: npt.NDArray[np.bool_]  # (levels,)   whether the level's coefficients are written


@kernel
def _new_windows(vectors: int) -> Windows:
    levels = MAX_DEPTH + 1
    rows = vectors * levels * _PLACES
    return Windows(
        np.zeros((rows, 4), np.float32),
        np.arange(rows).astype(np.int32).reshape(vectors, -1),
        np.zeros(levels * _PLACES, np.float32),
        np.zeros(levels, np.bool_),
    )


def values_at(coefficients: Coefficients, samples: Samples, cells: Int64s) -> Floats:
    """Return the field (n, components) at all samples of finest cells, which ascend.

    Every one of the cells must lie in a leaf of the tree. What nothing covers is black.
    """
    counts = samples.firsts[cells + 1] - samples.firsts[cells]
    found = np.empty((int(counts.sum()), coefficients.components), np.float32)
    arrays = samples.codes, samples.firsts, samples.places
    _values_at(coefficients, _NO_KEPT, *arrays, samples.depth, cells, found)
    return found


def values_of(coefficients: Coefficients, samples: Samples, cells: Int64s, nodes: Int64s) -> Floats:
    """Return at the same samples the values of the cells of the last level that hold them.

    ``nodes`` are the first finest cells in these, all that have any.
    """
    arrays, rows, components, alpha = coefficients
    owners = np.searchsorted(nodes, cells, side="right") - 1 + arrays.level_cells[-2]
    values = rows.reshape(len(arrays.flags), -1)[owners, :components]
    if alpha >= 0:
        others = np.arange(components) != alpha
        coverage = values[:, alpha, None]
        values[:, others] /= np.where(coverage > 0, coverage, 1)
    return np.repeat(values, samples.firsts[cells + 1] - samples.firsts[cells], axis=0)


def source_at(samples: Samples, cells: Int64s) -> npt.NDArray[np.floating]:
    """Return the source (n, components) at the same samples."""
    values = samples.values
    bits: npt.NDArray[Any] = values.view(np.uint16 if values.dtype == np.float16 else np.uint32)
    counts = samples.firsts[cells + 1] - samples.firsts[cells]
    found = np.empty((int(counts.sum()), values.shape[1]), bits.dtype)
    _copy_rows(bits, samples.firsts, cells, found)
    return found.view(values.dtype)


@kernel
def _copy_rows(
    bits: npt.NDArray[np.uint16 | np.uint32],
    firsts: Int64s,
    cells: Int64s,
    found: npt.NDArray[np.uint16 | np.uint32],
) -> None:
    n = 0
    for cell in cells:
        for sample in range(firsts[cell], firsts[cell + 1]):
            for component in range(bits.shape[1]):
                found[n, component] = bits[sample, component]
            n += 1


@kernel
def _values_at(
    coefficients: Coefficients,
    kept: npt.NDArray[np.uint32],
    codes: Int64s,
    firsts: Int64s,
    places: npt.NDArray[np.uint16],
    depth: int,
    cells: Int64s,
    found: Floats,
) -> None:
    arrays, rows, components, alpha = coefficients
    vectors = (components + 4) // 4
    walk, windows = new_walk(), _new_windows(vectors)
    totals = np.empty(4 * vectors, np.float32)
    step = 1.0 / PLACE_STEPS
    scale = 1.0 / (1 << depth)
    n = 0
    for cell in cells:
        i, j, k = decode_cell(codes[cell])
        for sample in range(firsts[cell], firsts[cell + 1]):
            x = (i + (places[sample, 0] + 0.5) * step) * scale
            y = (j + (places[sample, 1] + 0.5) * step) * scale
            z = (k + (places[sample, 2] + 0.5) * step) * scale
            _add_up(arrays, kept, rows, vectors, x, y, z, walk, windows, totals)
            for component in range(components):
                divisor = totals[components if alpha < 0 or component == alpha else alpha]
                found[n, component] = totals[component] / divisor if divisor > 0 else np.float32(0)
            n += 1


@inlined
def _add_up(
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
    """Write the sums of coefficients under the spline's weights at a point of texture space."""
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
