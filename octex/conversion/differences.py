"""How far two trees' fields are apart in finest cells, all over the surface around samples.

On a finest cell both fields are rational functions. Their coefficients are gathered once a cell, and mostly
say enough: the same leaves in both, or values that are all near to each other.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from octex.conversion.measure import ErrorColumns, all_near, are_near, are_near_between, subtract
from octex.conversion.samples import MOST_POINTS, Samples, lay_out
from octex.field.weights import View, facings_of, view_of
from octex.field.windows import Walk, new_walk
from octex.jit import inlined, kernel
from octex.texture import OctreeTexture
from octex.tree.layout import MAX_DEPTH
from octex.tree.morton import decode as decode_cell

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


def coefficients(texture: OctreeTexture, forms: Sequence[ChannelFormat]) -> Coefficients:
    """Return the field of a texture's channels of some formats."""
    tree = texture.tree
    columns = ErrorColumns.of(forms)
    components, cells = columns.kinds.size, tree.n_cells
    rows = large.zeros((cells + tree.split.areas.size, (components + 4) // 4 * 4), np.float32)
    rows[:, components] = 1.0
    end = 0
    for form in forms:
        start, end = end, end + form.components
        channel = texture.channels[form.name]
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
    def of(cls, texture: OctreeTexture, samples: Samples) -> Reference:
        """Take the full tree's texture."""
        field = coefficients(texture, samples.channels)
        return cls(field, ErrorColumns.of(samples.channels), samples.depth, *samples[2:6])


class Scratch(NamedTuple):
    """Where the tests of one cell after another work."""

    totals: Float32s  # (vectors, 4)
    values: Float32s  # (2, components, points)   of both fields
    differences: Float64s  # (2 · components, points)
    points: Float32s  # (3, points)   in the finest cell, 0 … 1
    normal: Float32s  # (1, 3)
    bounds: Float32s  # (2, components)


@kernel
def far_all_over(found: Coefficients, reference: Reference, most: float, cells: Int64s) -> Bools:
    """Say in which finest cells (n,), which ascend, a field is too far from the full tree's somewhere.

    That is, at a sample by more than ``most`` codes; or in the plane of the surface there, as far as it lies
    in the cell (see `lay_out`), by more than one code more; both without a normal and with the sample's own.
    """
    components = found.components
    fields, walks = (found, reference.field), (new_walk(), new_walk())
    windows = new_windows(4, (components + 4) // 4)  # of both fields; of both looked up with a normal
    scratch = Scratch(
        np.zeros(((components + 4) // 4, 4), np.float32),
        np.zeros((2, components, MOST_POINTS), np.float32),
        np.zeros((2 * components, MOST_POINTS), np.float64),
        np.zeros((3, MOST_POINTS), np.float32),
        np.zeros((1, 3), np.float32),
        np.zeros((2, components), np.float32),
    )
    far = np.empty(cells.size, np.bool_)
    for n in range(cells.size):
        far[n] = _is_far_all_over(fields, walks, windows, reference, scratch, cells[n], most)
    return far


@inlined
def _is_far_all_over(
    fields: tuple[Coefficients, Coefficients],
    walks: tuple[Walk, Walk],
    windows: Windows,
    reference: Reference,
    scratch: Scratch,
    cell: int,
    most: float,
) -> bool:
    i, j, k = decode_cell(reference.codes[cell])
    shift = MAX_DEPTH - reference.depth
    full = enter(fields[1], walks[1], windows, 1, i << shift, j << shift, k << shift)
    level = enter(fields[0], walks[0], windows, 0, i << shift, j << shift, k << shift)
    if level == full and not is_refined(walks[0], level):
        return False  # both have the same leaves there
    place = (i, j, k, reference.depth)
    columns, normal = reference.columns, scratch.normal
    view = view_of(normal, 0)
    for sample in range(reference.firsts[cell], reference.firsts[cell + 1]):
        count = lay_out(reference.places, reference.normals, sample, scratch.points)
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
            is_first = look == 0 and sample == reference.firsts[cell]
            if is_first and _are_made_alike(windows, level, full, columns, most, scratch.bounds):
                return False
            _look_up(fields[0], windows, one, level, place, 0, 1, scratch)
            _look_up(fields[1], windows, other, full, place, 0, 1, scratch)
            subtract(scratch.values, columns, 0, scratch.differences)
            if not are_near(scratch.differences, 0, most):
                return True
            _look_up(fields[0], windows, one, level, place, 1, count, scratch)
            _look_up(fields[1], windows, other, full, place, 1, count, scratch)
            if _are_all_near(scratch.values, columns, count, most + BETWEEN, scratch.bounds):
                continue
            for point in range(1, count):
                subtract(scratch.values, columns, point, scratch.differences)
            if not are_near_between(scratch.differences, count, most + BETWEEN):
                return True
    return False


@inlined
def _look_up(
    field: Coefficients,
    windows: Windows,
    which: int,
    level: int,
    place: Place,
    first: int,
    end: int,
    scratch: Scratch,
) -> None:
    """Write a field's values at the points of a finest cell from the first to the end."""
    i, j, k, depth = place
    points, totals, values = scratch.points, scratch.totals, scratch.values
    last, scale = (1 << depth - level) - 1, 1.0 / (1 << depth - level)
    components, alpha = field.components, field.alpha
    for point in range(first, end):
        x = ((i & last) + points[0, point]) * scale
        y = ((j & last) + points[1, point]) * scale
        z = ((k & last) + points[2, point]) * scale
        add_up(windows, which, (components + 4) // 4, level, x, y, z, totals)
        for component in range(components):
            by = components if alpha < 0 or component == alpha else alpha
            total, divisor = totals[component >> 2, component & 3], totals[by >> 2, by & 3]
            values[which & 1, component, point] = total / divisor if divisor > _ZERO else _ZERO


@inlined
def _are_made_alike(
    windows: Windows, level: int, full: int, columns: ErrorColumns, most: float, bounds: Float32s
) -> bool:
    """Say whether all that the fields are made of in a cell is near: so are they, with any normal."""
    vectors = (columns.kinds.size + 4) // 4
    rows = windows.ranges.shape[0] // 4
    for component in range(columns.kinds.size):
        vector, column = component >> 2, component & 3
        one, other = level * vectors + vector, rows + full * vectors + vector
        bounds[0, component] = min(windows.ranges[one, 0, column], windows.ranges[other, 0, column])
        bounds[1, component] = max(windows.ranges[one, 1, column], windows.ranges[other, 1, column])
    return all_near(bounds, columns, most)


@inlined
def _are_all_near(values: Float32s, columns: ErrorColumns, count: int, most: float, bounds: Float32s) -> bool:
    """Say whether differences at the points of a patch are so small that they are near between them, too.

    The Bézier coefficients are three times as large at most. Of all pairs of light that differ by as much,
    the darkest is apart by most codes.
    """
    for component in range(columns.kinds.size):
        low, apart = np.float32(np.inf), _ZERO
        for point in range(count):
            found, wanted = values[0, component, point], values[1, component, point]
            low = min(low, min(found, wanted))
            apart = max(apart, abs(found - wanted))
        bounds[0, component], bounds[1, component] = low, low + apart
    return all_near(bounds, columns, most / 3.0)


@inlined
def _full_facings(view: View) -> int:
    """Return the facings that lookups with a normal take in full."""
    x, y, z, signs = view
    full = int(x >= _FULL) << (signs & 1)
    full |= int(y >= _FULL) << (2 + (signs >> 1 & 1))
    return full | int(z >= _FULL) << (4 + (signs >> 2 & 1))
