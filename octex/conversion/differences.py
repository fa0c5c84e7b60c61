"""How far two trees' fields are apart in finest cells, at samples and all over the surface around them.

On a finest cell both fields are rational functions. Their coefficients are gathered once a cell, and serve
all points in it, eight at a time. The same leaves in both say enough.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int8s, Int64s, Uint16s
from octex.channels import ChannelFormat, decode
from octex.conversion import large
from octex.conversion.evaluator import (
    Coefficients,
    Windows,
    add_up,
    enter,
    find_coefficients,
    is_refined,
    new_windows,
)
from octex.conversion.measure import (
    ErrorColumns,
    are_apart_by_less,
    are_near,
    are_near_between,
    subtract,
)
from octex.conversion.samples import MOST_POINTS, PLACE_STEPS, Samples, lay_out
from octex.field.weights import View, facings_of, view_of
from octex.field.windows import Walk, new_walk
from octex.jit import chosen, inlined, kernel, part, put
from octex.jit.vectors import eight, eight_at
from octex.texture.channel import Channel
from octex.tree.layout import MAX_DEPTH
from octex.tree.morton import decode as decode_cell
from octex.tree.octree import Octree

#: A finest cell, and its level.
Place: TypeAlias = tuple[int, int, int, int]
_ZERO = np.float32(0)
#: Rows that are decoded at once.
_BLOCK = 1 << 18
#: Cosine from which on lookups take what faces so in full (see `field.taps`), and what it is rounded by.
_FULL = 0.52
#: How many codes more fields may be apart between samples than at them. In random trials (60,000 points each,
#: edges, dots and light up to 20) none then went beyond it.
BETWEEN = 1.0
#: By the facings that are taken in full: the kinds of cells that have none of them, and of split ones.
#: Lookups with a normal that find none of these kinds find the same as those without.
_HIDDEN = np.array(
    [sum(1 << kind for kind in range(64) if kind & facings == 0) for facings in range(64)], np.uint64
)


def coefficients(
    tree: Octree, channels: Mapping[str, Channel], forms: Sequence[ChannelFormat]
) -> Coefficients:
    """Return the field of a tree's channels of some formats."""
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
                some = slice(begin, begin + _BLOCK)
                into[some, start:end] = decode(stored[some], form.space)
    return Coefficients(
        tree.arrays, facings_of(tree).rows, cells, rows.reshape(-1, 4), components, columns.alpha
    )


class Reference(NamedTuple):
    """The full tree's field, and where the samples of its finest cells lie: see `Samples`."""

    field: Coefficients
    columns: ErrorColumns
    depth: int
    codes: Int64s
    firsts: Int64s
    places: Uint16s
    normals: Int8s

    @classmethod
    def of(cls, field: Coefficients, samples: Samples, forms: Sequence[ChannelFormat]) -> Reference:
        """Take the full tree's field of some formats."""
        return cls(field, ErrorColumns.of(forms), samples.depth, *samples[2:6])


class Scratch(NamedTuple):
    """Where the tests of one cell after another work."""

    walks: tuple[Walk, Walk]  # of both fields
    windows: Windows  # of both fields; of both looked up with a normal
    totals: Float32s  # (4 · vectors, points)
    values: Float32s  # (2, components, points)   of both fields
    differences: Float64s  # (2, points)
    points: Float32s  # (3, points)   in the finest cell, 0 … 1
    normal: Float32s  # (1, 3)


@part
def _new_scratch(components: int) -> Scratch:
    vectors = (components + 4) // 4
    return Scratch(
        (new_walk(), new_walk()),
        new_windows(4, vectors),
        np.zeros((4 * vectors, MOST_POINTS), np.float32),
        np.zeros((2, components, MOST_POINTS), np.float32),
        np.zeros((2, MOST_POINTS), np.float64),
        np.zeros((3, MOST_POINTS), np.float32),
        np.zeros((1, 3), np.float32),
    )


@kernel
def values_at_samples(reference: Reference, first: int, end: int) -> Float32s:
    """Return the full tree's values (samples, components) at the samples of a run of finest cells."""
    field, scratch = reference.field, _new_scratch(reference.field.components)
    start = reference.firsts[first]
    found = np.empty((reference.firsts[end] - start, field.components), np.float32)
    for cell in range(first, end):
        count = _look_up_samples(field, reference, scratch, 1, cell)
        for point in range(count):
            for component in range(field.components):
                found[reference.firsts[cell] - start + point, component] = scratch.values[1, component, point]
    return found


@kernel
def near_nodes(
    even: Coefficients,
    reference: Reference,
    wanted: Float32s,
    most: float,
    nodes: tuple[Int64s, Int64s, Int64s],
    own: int,
    candidates: Int64s,
) -> Bools:
    """Say which nodes (n,), which ascend, may be leaves as far as the samples in them show.

    Either the field of an ``even`` tree, whose leaves they are, is near the full tree's at the samples of a
    finest cell in each child; or the node's own value is at all samples. ``wanted`` are the full tree's
    values at all samples; ``nodes`` the first finest cell and the first child of each node, and the first
    finest cell of each child, ends included; ``own`` is the cell of the first node.
    """
    firsts, children, child_firsts = nodes
    scratch = _new_scratch(even.components)
    near = np.empty(candidates.size, np.bool_)
    for n in range(candidates.size):
        node = candidates[n]
        near[n] = True
        for child in range(children[node], children[node + 1]):
            cell = child_firsts[child]
            count = _look_up_samples(even, reference, scratch, 0, cell)
            if not _are_near_at(scratch, reference, wanted, cell, count, most):
                near[n] = False
                break
        if near[n]:
            continue
        near[n] = True
        vectors = (even.components + 4) // 4
        for component in range(even.components):
            value = even.rows[(own + node) * vectors + (component >> 2), component & 3]
            for point in range(MOST_POINTS):
                scratch.values[0, component, point] = value
        for cell in range(firsts[node], firsts[node + 1]):
            count = reference.firsts[cell + 1] - reference.firsts[cell]
            if not _are_near_at(scratch, reference, wanted, cell, count, most):
                near[n] = False
                break
    return near


@kernel
def far_at_samples(
    found: Coefficients, reference: Reference, wanted: Float32s, most: float, first: int, end: int
) -> Bools:
    """Say in which finest cells of a run a field is more than ``most`` codes from the full tree's."""
    scratch = _new_scratch(found.components)
    far = np.empty(end - first, np.bool_)
    for cell in range(first, end):
        count = _look_up_samples(found, reference, scratch, 0, cell)
        far[cell - first] = not _are_near_at(scratch, reference, wanted, cell, count, most)
    return far


@inlined
def _are_near_at(
    scratch: Scratch, reference: Reference, wanted: Float32s, cell: int, count: int, most: float
) -> bool:
    """Say whether the first field's values at a cell's samples are near the full tree's."""
    first, values = reference.firsts[cell], scratch.values
    for point in range(-(-count // 8) * 8):
        row = first + (point if point < count else 0)
        for component in range(values.shape[1]):
            values[1, component, point] = wanted[row, component]
    return _are_near(scratch, reference.columns, count, most, most, False)


@inlined
def _look_up_samples(
    field: Coefficients, reference: Reference, scratch: Scratch, side: int, cell: int
) -> int:
    """Write a field's values at the samples of a finest cell, and return how many these are."""
    i, j, k = decode_cell(reference.codes[cell])
    shift = MAX_DEPTH - reference.depth
    walk, windows = scratch.walks[0], scratch.windows
    level = enter(field, walk, windows, 0, i << shift, j << shift, k << shift)
    find_coefficients(field, walk, windows, 0, level, False, view_of(scratch.normal, 0))
    first = reference.firsts[cell]
    count = reference.firsts[cell + 1] - first
    for point in range(count):
        for axis in range(3):
            scratch.points[axis, point] = (reference.places[first + point, axis] + 0.5) * (1.0 / PLACE_STEPS)
    _fill(scratch.points, count)
    _look_up(field, scratch, 0, level, (i, j, k, reference.depth), side, count)
    return int(count)


@inlined
def _fill(points: Float32s, count: int) -> None:
    """Repeat the first of some points up to a multiple of eight."""
    for point in range(count, -(-count // 8) * 8):
        for axis in range(3):
            points[axis, point] = points[axis, 0]


@kernel
def far_all_over(found: Coefficients, reference: Reference, most: float, cells: Int64s) -> Bools:
    """Say in which finest cells (n,), which ascend, a field is too far from the full tree's somewhere.

    That is, at a sample by more than ``most`` codes; or in the plane of the surface there, as far as it lies
    in the cell (see `lay_out`), by more than one code more; both without a normal and with the sample's own.
    """
    scratch = _new_scratch(found.components)
    far = np.empty(cells.size, np.bool_)
    for n in range(cells.size):
        far[n] = _is_far_all_over((found, reference.field), reference, scratch, cells[n], most)
    return far


@inlined
def _is_far_all_over(
    fields: tuple[Coefficients, Coefficients], reference: Reference, scratch: Scratch, cell: int, most: float
) -> bool:
    walks, windows, columns = scratch.walks, scratch.windows, reference.columns
    i, j, k = decode_cell(reference.codes[cell])
    shift = MAX_DEPTH - reference.depth
    full = enter(fields[1], walks[1], windows, 1, i << shift, j << shift, k << shift)
    level = enter(fields[0], walks[0], windows, 0, i << shift, j << shift, k << shift)
    if level == full and not is_refined(walks[0], level):
        return False  # both have the same leaves there
    normal = scratch.normal
    view = view_of(normal, 0)
    for sample in range(reference.firsts[cell], reference.firsts[cell + 1]):
        count = lay_out(reference.places, reference.normals, sample, scratch.points)
        _fill(scratch.points, count)
        for look in range(2):  # without a normal, then with it
            one, other = 0, 1
            if look == 1:
                is_new = False
                for axis in range(3):
                    is_new |= normal[0, axis] != reference.normals[sample, axis]
                    normal[0, axis] = reference.normals[sample, axis]
                view = view_of(normal, 0)
                if is_new:
                    windows.known[2:] = False
                hidden = _HIDDEN[_full_facings(view)]
                one = 2 if windows.kinds[0, level] & hidden != np.uint64(0) else 0
                other = 3 if windows.kinds[1, full] & hidden != np.uint64(0) else 1
                if one == 0 and other == 1:
                    continue  # the normal changes nothing
            find_coefficients(fields[1], walks[1], windows, other, full, other == 3, view)
            find_coefficients(fields[0], walks[0], windows, one, level, one == 2, view)
            for side in range(2):
                which, own = (one, level) if side == 0 else (other, full)
                _look_up(fields[0], scratch, which, own, (i, j, k, reference.depth), side, count)
            if not _are_near(scratch, columns, count, most, most + BETWEEN, True):
                return True
    return False


@inlined
def _look_up(
    field: Coefficients, scratch: Scratch, which: int, level: int, place: Place, side: int, count: int
) -> None:
    """Write a field's values at points of a finest cell; ``field`` says what they are."""
    i, j, k, depth = place
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
        for component in range(components):
            by = components if alpha < 0 or component == alpha else alpha
            total, divisor = eight_at(totals, component * room + first), eight_at(totals, by * room + first)
            is_any = divisor > none
            found = chosen(is_any, total / chosen(is_any, divisor, one), none)
            put(values, (side * components + component) * room + first, found)


@inlined
def _are_near(
    scratch: Scratch, columns: ErrorColumns, count: int, most: float, between: float, is_patch: bool
) -> bool:
    """Say whether the values of both fields are near at points; or all over a patch, see `lay_out`.

    Bézier coefficients between the points of a patch are three times as large as differences at most.
    """
    values, differences = scratch.values, scratch.differences
    surely = min(most, between / 3.0) if is_patch else most
    for component in range(columns.kinds.size):
        is_plain = columns.vectors[component] < 0
        if is_plain and are_apart_by_less(values, columns, component, count, surely):
            continue
        subtract(values, columns, component, count, differences)
        if not are_near(differences, 1 if is_patch else count, most):
            return False
        if is_patch and not are_near_between(differences, count, between):
            return False
    return True


@inlined
def _full_facings(view: View) -> int:
    """Return the facings that lookups with a normal take in full."""
    x, y, z, signs = view
    full = int(x >= _FULL) << (signs & 1)
    full |= int(y >= _FULL) << (2 + (signs >> 1 & 1))
    return full | int(z >= _FULL) << (4 + (signs >> 2 & 1))
