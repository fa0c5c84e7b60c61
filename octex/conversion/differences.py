"""How far two trees' fields are apart in finest cells, at samples and all over the surface around them.

On a finest cell both fields are rational functions. Their coefficients are gathered once a cell and serve all
points in it, eight at a time. Where both trees have the same leaves, nothing is computed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int8s, Int64s, Uint16s
from octex.channels import ChannelFormat, decode
from octex.conversion import large
from octex.conversion.evaluator import (
    LEVELS,
    PLACES,
    Coefficients,
    Windows,
    add_up,
    enter,
    find_coefficients,
    is_refined,
)
from octex.conversion.measure import (
    BETWEEN,
    ErrorColumns,
    are_near,
    are_near_between,
    are_surely_near,
    subtract,
)
from octex.conversion.samples import MOST_POINTS, POSITION_STEPS, Samples, lay_out
from octex.field.weights import NO_VIEW, facings_of, view_of
from octex.field.windows import Walk, new_walk
from octex.jit import chosen, inlined, kernel, part, put, step
from octex.jit.vectors import eight, eight_at
from octex.texture.channel import Channel
from octex.tree.layout import MAX_DEPTH
from octex.tree.morton import decode as decode_cell
from octex.tree.octree import Octree

#: A finest cell, and its level.
Cell: TypeAlias = tuple[int, int, int, int]
#: Rows that are decoded at once.
_BLOCK = 1 << 18
#: From this cosine on, rounding included, lookups give a facing its full weight (see `field.weights`).
_FULL = 0.52
#: By the facings of full weight: the kinds of cells without any of them, and the split kind. A normal changes
#: no lookup among other kinds.
_HIDDEN = np.array(
    [sum(1 << kind for kind in range(64) if kind & facings == 0) for facings in range(64)], np.uint64
)


def coefficients(
    tree: Octree, channels: Mapping[str, Channel], forms: Sequence[ChannelFormat]
) -> Coefficients:
    """Return the field of the channels of a tree that have these formats."""
    columns = ErrorColumns.of(forms)
    components, cells = columns.kinds.size, tree.n_cells
    rows = large.zeros((cells + tree.split.areas.size, (components + 4) // 4 * 4), np.float32)
    rows[:, components] = 1.0
    end = 0
    for form in forms:
        start, end = end, end + form.components
        channel = channels[form.name]
        for into, stored in ((rows[:cells], channel.values), (rows[cells:], channel.split_values)):
            for begin in range(0, len(stored), _BLOCK):
                block = slice(begin, begin + _BLOCK)
                into[block, start:end] = decode(stored[block], form.space)
    return Coefficients(
        tree.arrays, facings_of(tree).rows, cells, rows.reshape(-1, 4), components, columns.alpha
    )


class Reference(NamedTuple):
    """The full tree's field, and the samples of its finest cells: see `Samples`."""

    field: Coefficients
    columns: ErrorColumns
    depth: int
    codes: Int64s
    firsts: Int64s
    positions: Uint16s
    normals: Int8s
    values: Float32s  # (samples, components)   of the field

    @classmethod
    def of(cls, field: Coefficients, samples: Samples, forms: Sequence[ChannelFormat]) -> Reference:
        """Take the full tree's field, and the formats of its components."""
        values = np.empty((0, field.components), np.float32)
        return cls(field, ErrorColumns.of(forms), samples.depth, *samples[2:6], values)


class ComparisonScratch(NamedTuple):
    """Scratch arrays of the tests, and the windows of the cell tested last."""

    walks: tuple[Walk, Walk]  # of both fields
    windows: Windows  # of both fields; of both with a normal
    totals: Float32s  # (4 · vectors, points)
    values: Float32s  # (2, components, points)   of both fields
    differences: Float64s  # (2, points)
    points: Float32s  # (3, points)   positions in the finest cell, 0 … 1
    normal: Float32s  # (1, 3)


@part
def _new_scratch(components: int) -> ComparisonScratch:
    vectors = (components + 4) // 4
    return ComparisonScratch(
        (new_walk(), new_walk()),
        Windows(
            np.zeros((4 * vectors * LEVELS * PLACES, 4), np.float32),
            np.zeros((4, LEVELS), np.bool_),
            np.zeros((4, LEVELS), np.uint64),
        ),
        np.zeros((4 * vectors, MOST_POINTS), np.float32),
        np.zeros((2, components, MOST_POINTS), np.float32),
        np.zeros((2, MOST_POINTS), np.float64),
        np.zeros((3, MOST_POINTS), np.float32),
        np.zeros((1, 3), np.float32),
    )


@kernel
def values_at_samples(reference: Reference, cells: Int64s) -> Float32s:
    """Return the full tree's values (samples, components) at the samples of finest cells (n,), a run."""
    components = reference.field.components
    count = reference.firsts[cells[-1] + 1] - reference.firsts[cells[0]]
    values = np.empty((count, components), np.float32)
    _write_values(reference, cells, _new_scratch(components), values)
    return values


# Loops are steps, not kernels: where tuples of arrays pass from call to call, kernels count references, 25
# for each cell, and take a sixth longer.


@step
def _write_values(reference: Reference, cells: Int64s, scratch: ComparisonScratch, values: Float32s) -> None:
    field, start = reference.field, reference.firsts[cells[0]]
    for cell in cells:
        level = _enter(field, reference, scratch, cell)
        count = _look_up_samples(field, reference, scratch, level, 1, cell)
        row = reference.firsts[cell] - start
        for point in range(count):
            for component in range(field.components):
                values[row + point, component] = scratch.values[1, component, point]


@kernel
def near_nodes(
    even: Coefficients,
    reference: Reference,
    most: float,
    nodes: tuple[Int64s, Int64s, Int64s],
    first_node: int,
    candidates: Int64s,
) -> Bools:
    """Say which nodes (n,), in ascending order, may become leaves, by their samples.

    Either the field of an ``even`` tree, whose leaves they are, is near the full tree's at the samples of a
    finest cell in each child; or the node's value is near at all samples. ``nodes`` are the first finest cell
    and the first child of each node, and the first finest cell of each child, ends included; ``first_node``
    is the cell number of the first node.
    """
    near = np.empty(candidates.size, np.bool_)
    _find_near(even, reference, most, nodes, first_node, candidates, _new_scratch(even.components), near)
    return near


@step
def _find_near(
    even: Coefficients,
    reference: Reference,
    most: float,
    nodes: tuple[Int64s, Int64s, Int64s],
    first_node: int,
    candidates: Int64s,
    scratch: ComparisonScratch,
    near: Bools,
) -> None:
    firsts, children, child_firsts = nodes
    for n in range(candidates.size):
        node = candidates[n]
        near[n] = True
        for child in range(children[node], children[node + 1]):
            if not _is_near_at_samples(even, reference, scratch, child_firsts[child], most):
                near[n] = False
                break
        if near[n]:
            continue
        near[n] = True
        vectors = (even.components + 4) // 4
        for component in range(even.components):
            value = even.rows[(first_node + node) * vectors + (component >> 2), component & 3]
            for point in range(MOST_POINTS):
                scratch.values[0, component, point] = value
        for cell in range(firsts[node], firsts[node + 1]):
            count = reference.firsts[cell + 1] - reference.firsts[cell]
            if not _are_near_at(scratch, reference, cell, count, most):
                near[n] = False
                break


@kernel
def find_far(
    field: Coefficients, reference: Reference, most: float, ends: Int64s, is_patch: bool, cells: Int64s
) -> Bools:
    """Find finest cells (n,), in ascending order, in which a field is too far off.

    That is by more than ``most`` codes at a sample; with ``is_patch`` also by one code more on the patch
    around it (see `lay_out`), without a normal and with the sample's normal. ``ends`` (finest cells,) say
    where a leaf ends that will be split as a whole: no other cell of it is tested after one that is far.
    """
    far = np.zeros(cells.size, np.bool_)
    _test_cells(
        (field, reference.field), reference, most, ends, is_patch, cells, _new_scratch(field.components), far
    )
    return far


@step
def _test_cells(
    fields: tuple[Coefficients, Coefficients],
    reference: Reference,
    most: float,
    ends: Int64s,
    is_patch: bool,
    cells: Int64s,
    scratch: ComparisonScratch,
    far: Bools,
) -> None:
    end = 0
    for n in range(cells.size):
        cell = cells[n]
        if cell < end:
            continue
        if is_patch:
            far[n] = _is_far_all_over(fields, reference, scratch, cell, most)
        else:
            far[n] = not _is_near_at_samples(fields[0], reference, scratch, cell, most)
        if far[n]:
            end = ends[cell]


@inlined
def _is_near_at_samples(
    field: Coefficients, reference: Reference, scratch: ComparisonScratch, cell: int, most: float
) -> bool:
    """Say whether a field is near the full tree's at the samples of a finest cell."""
    level = _enter(field, reference, scratch, cell)
    if level == reference.depth and not is_refined(scratch.walks[0], level):
        return True  # both have the same leaves there
    count = _look_up_samples(field, reference, scratch, level, 0, cell)
    return _are_near_at(scratch, reference, cell, count, most)


@inlined
def _are_near_at(
    scratch: ComparisonScratch, reference: Reference, cell: int, count: int, most: float
) -> bool:
    """Say whether the first field's values at a cell's samples are near the full tree's."""
    first, values = reference.firsts[cell], scratch.values
    for point in range(-(-count // 8) * 8):
        row = first + (point if point < count else 0)
        for component in range(values.shape[1]):
            values[1, component, point] = reference.values[row, component]
    return _are_near(scratch, reference.columns, count, most, most, False)


@inlined
def _enter(field: Coefficients, reference: Reference, scratch: ComparisonScratch, cell: int) -> int:
    """Go to a finest cell in the first field, and return the level of its window."""
    i, j, k = decode_cell(reference.codes[cell])
    shift = MAX_DEPTH - reference.depth
    return enter(field, scratch.walks[0], scratch.windows, 0, i << shift, j << shift, k << shift)


@inlined
def _look_up_samples(
    field: Coefficients, reference: Reference, scratch: ComparisonScratch, level: int, side: int, cell: int
) -> int:
    """Write a field's values at the samples of the finest cell entered, and return their number."""
    i, j, k = decode_cell(reference.codes[cell])
    find_coefficients(field, scratch.walks[0], scratch.windows, 0, level, False, NO_VIEW)
    first = reference.firsts[cell]
    count = reference.firsts[cell + 1] - first
    for point in range(count):
        for axis in range(3):
            steps = reference.positions[first + point, axis] + 0.5
            scratch.points[axis, point] = steps * (1.0 / POSITION_STEPS)
    _fill(scratch.points, count)
    _look_up(field, scratch, 0, level, (i, j, k, reference.depth), side, count)
    return int(count)


@inlined
def _fill(points: Float32s, count: int) -> None:
    """Repeat the first point up to a multiple of eight points."""
    for point in range(count, -(-count // 8) * 8):
        for axis in range(3):
            points[axis, point] = points[axis, 0]


@inlined
def _is_far_all_over(
    fields: tuple[Coefficients, Coefficients],
    reference: Reference,
    scratch: ComparisonScratch,
    cell: int,
    most: float,
) -> bool:
    walks, windows, columns = scratch.walks, scratch.windows, reference.columns
    i, j, k = decode_cell(reference.codes[cell])
    shift = MAX_DEPTH - reference.depth
    level = _enter(fields[0], reference, scratch, cell)
    if level == reference.depth and not is_refined(walks[0], level):
        return False  # both have the same leaves there
    full = enter(fields[1], walks[1], windows, 1, i << shift, j << shift, k << shift)
    if level == full and not is_refined(walks[0], level):
        return False
    normal, view = scratch.normal, NO_VIEW
    for sample in range(reference.firsts[cell], reference.firsts[cell + 1]):
        count = lay_out(reference.positions, reference.normals, sample, scratch.points)
        for with_normal in range(2):
            one, other = 0, 1
            if with_normal == 1:
                hidden = _HIDDEN[_full_facings(reference.normals, sample)]
                one = 2 if windows.kinds[0, level] & hidden != np.uint64(0) else 0
                other = 3 if windows.kinds[1, full] & hidden != np.uint64(0) else 1
                if one == 0 and other == 1:
                    continue  # the normal changes nothing
                is_new = False
                for axis in range(3):
                    is_new |= normal[0, axis] != reference.normals[sample, axis]
                    normal[0, axis] = reference.normals[sample, axis]
                view = view_of(normal, 0)
                for known in range(full + 1 if is_new else 0):
                    windows.known[2, known] = windows.known[3, known] = False
            find_coefficients(fields[1], walks[1], windows, other, full, other == 3, view)
            find_coefficients(fields[0], walks[0], windows, one, level, one == 2, view)
            for side in range(2):
                which, from_level = (one, level) if side == 0 else (other, full)
                if with_normal == 0 or which != side:  # else the normal changes nothing there
                    _look_up(fields[0], scratch, which, from_level, (i, j, k, reference.depth), side, count)
            if not _are_near(scratch, columns, count, most, most + BETWEEN, True):
                return True
    return False


@inlined
def _look_up(
    field: Coefficients, scratch: ComparisonScratch, which: int, level: int, cell: Cell, side: int, count: int
) -> None:
    """Write a field's values at points of a finest cell."""
    i, j, k, depth = cell
    points, totals, values, room = scratch.points, scratch.totals, scratch.values, MOST_POINTS
    last, scale = (1 << depth - level) - 1, eight(1.0 / (1 << depth - level))
    a, b, c = eight(i & last), eight(j & last), eight(k & last)
    components, alpha = field.components, field.alpha
    none, one = eight(0.0), eight(1.0)
    for first in range(0, count, 8):
        x = (a + eight_at(points, first)) * scale
        y = (b + eight_at(points, room + first)) * scale
        z = (c + eight_at(points, 2 * room + first)) * scale
        add_up(scratch.windows, which, (components + 4) // 4, level, (x, y, z), totals, first)
        weight = eight_at(totals, components * room + first)
        inverse = chosen(weight > none, one / weight, none)
        by_coverage = inverse
        if alpha >= 0:
            coverage = eight_at(totals, alpha * room + first)
            by_coverage = chosen(coverage > none, one / coverage, none)
        for component in range(components):
            by = inverse if component == alpha else by_coverage
            value = eight_at(totals, component * room + first) * by
            put(values, (side * components + component) * room + first, value)


@inlined
def _are_near(
    scratch: ComparisonScratch, columns: ErrorColumns, count: int, most: float, between: float, is_patch: bool
) -> bool:
    """Say whether the values of both fields are near at points; or all over a patch, see `lay_out`.

    The Bézier coefficients of a patch are at most three times the largest difference at its points.
    """
    values, differences = scratch.values, scratch.differences
    surely = min(most, between / 3.0) if is_patch else most
    for component in range(columns.kinds.size):
        is_plain = columns.vectors[component] < 0
        if is_plain and are_surely_near(values, columns, component, count, surely):
            continue
        subtract(values, columns, component, count, differences)
        if not are_near(differences, 1 if is_patch else count, most):
            return False
        if is_patch and not are_near_between(differences, count, between):
            return False
    return True


@inlined
def _full_facings(normals: Int8s, sample: int) -> int:
    """Return the facings of full weight in lookups with a sample's normal."""
    square = 0
    for axis in range(3):
        square += int(normals[sample, axis]) ** 2
    full = 0
    for axis in range(3):
        component = int(normals[sample, axis])
        is_full = component != 0 and component * component >= _FULL * _FULL * square
        full |= int(is_full) << (2 * axis + int(component < 0))
    return full
