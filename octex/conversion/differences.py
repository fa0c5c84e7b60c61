"""How far two trees' fields are apart in finest cells: at samples, or all over the surface around them.

On a finest cell both fields are rational functions. Their coefficients are gathered once a cell, and mostly
say enough: the same leaves in both, or values that are all near to each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from octex.arrays import Array, Bools, Float32s, Float64s, Int8s, Int64s, Uint16s
from octex.channels import ChannelFormat, ColorSpace, decode
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
from octex.conversion.facings import HIDDEN
from octex.conversion.measure import ErrorColumns, all_near, are_near, are_near_between, subtract
from octex.conversion.prune import Pruned
from octex.conversion.samples import MOST_POINTS, Samples, lay_first, lay_out
from octex.field.weights import View, facings_of, view_of
from octex.field.windows import Walk, new_walk
from octex.jit import inlined, kernel
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


class Decoded(NamedTuple):
    """Channels of a tree side by side, decoded, as coefficients are laid out."""

    values: Float32s  # (cells, columns)   components, a one, zeros
    split_values: Float32s  # (rows, columns)
    columns: ErrorColumns

    @classmethod
    def of(cls, channels: Mapping[str, Channel], forms: Sequence[ChannelFormat]) -> Decoded:
        """Decode the channels of some formats."""
        given = [channels[form.name] for form in forms]
        spaces = [channel.format.space for channel in given]
        values = _side_by_side([channel.values for channel in given], spaces)
        split_values = _side_by_side([channel.split_values for channel in given], spaces)
        return cls(values, split_values, ErrorColumns.of(forms))

    def put(self, channels: Mapping[str, Channel], forms: Sequence[ChannelFormat], cells: Int64s) -> None:
        """Take other values of some cells (n,), which channels of some formats have."""
        spaces = [form.space for form in forms]
        self.values[cells] = _side_by_side([channels[form.name].values[cells] for form in forms], spaces)

    def field(self, tree: Octree, cells: Int64s | slice, split_rows: Bools | slice) -> Coefficients:
        """Return the field of a tree that has some of the cells and of the rows for facings."""
        some = large.taken(self.values, cells) if isinstance(cells, np.ndarray) else self.values[cells]
        rows = large.joined([some, self.split_values[split_rows]])
        kinds, _, alpha, _ = self.columns
        return Coefficients(
            tree.arrays, facings_of(tree).rows, tree.n_cells, rows.reshape(-1, 4), kinds.size, alpha
        )

    def truncated(self, tree: Octree, level: int) -> Coefficients:
        """Return the field of the averages of a level."""
        coarse = tree.truncated(level)
        return self.field(coarse, slice(coarse.n_cells), slice(coarse.split.areas.size))

    def pruned(self, pruned: Pruned) -> Coefficients:
        """Return the field of a tree with some nodes as leaves."""
        return self.field(pruned.tree, pruned.cells, pruned.split_rows)


def _side_by_side(columns: Sequence[Array], spaces: Sequence[ColorSpace]) -> Float32s:
    """Return columns decoded, with a one after them, and zeros up to whole vectors."""
    components = sum(each.shape[1] for each in columns)
    rows = large.zeros((len(columns[0]), (components + 4) // 4 * 4), np.float32)
    for begin in range(0, len(rows), _BLOCK):
        some = slice(begin, begin + _BLOCK)
        given = [decode(each[some], space) for each, space in zip(columns, spaces, strict=True)]
        np.concatenate(given, axis=1, out=rows[some, :components])
    rows[:, components] = 1.0
    return rows


class Places(NamedTuple):
    """Where the samples of finest cells lie: see `Samples`."""

    depth: int
    codes: Int64s
    firsts: Int64s
    places: Uint16s
    normals: Int8s


class Scratch(NamedTuple):
    """Where the tests of one cell after another work."""

    totals: Float32s  # (vectors, 4)
    values: Float32s  # (2, components, points)   of both fields
    differences: Float64s  # (2 · components, points)
    points: Float32s  # (3, points)   in the finest cell, 0 … 1
    normal: Float32s  # (1, 3)
    bounds: Float32s  # (2, components)


def far_cells(
    found: Coefficients,
    full: Coefficients,
    samples: Samples,
    most: float,
    cells: Int64s,
    *,
    owners: Int64s | None = None,
    is_all_over: bool = False,
) -> Bools:
    """Say in which finest cells (n,), which ascend, a field is more than ``most`` codes from the full tree's.

    That is, at a sample, looked up without a normal. With ``owners`` (all finest cells,) it is not the field
    but the value of such a cell. If ``is_all_over``, also in the plane of the surface at a sample, as far as
    it lies in the cell (see `lay_out`), by more than one code more; and both with the sample's own normal.
    """
    far = np.zeros(cells.size, np.bool_)
    places = Places(samples.depth, samples.codes, samples.firsts, samples.places, samples.normals)
    own = np.full(cells.size, -1, np.int64) if owners is None else owners[cells]
    columns = ErrorColumns.of(samples.channels)
    _find_far((found, full), places, columns, cells, own, is_all_over, float(most), far)
    return far


@kernel
def _find_far(
    fields: tuple[Coefficients, Coefficients],
    samples: Places,
    columns: ErrorColumns,
    cells: Int64s,
    owners: Int64s,
    is_all_over: bool,
    most: float,
    far: Bools,
) -> None:
    components = columns.kinds.size
    vectors = (components + 4) // 4
    walks = (new_walk(), new_walk())
    windows = new_windows(4, vectors)  # of both fields; of both looked up with a normal
    scratch = Scratch(
        np.zeros((vectors, 4), np.float32),
        np.zeros((2, components, MOST_POINTS), np.float32),
        np.zeros((2 * components, MOST_POINTS), np.float64),
        np.zeros((3, MOST_POINTS), np.float32),
        np.zeros((1, 3), np.float32),
        np.zeros((2, components), np.float32),
    )
    for n in range(cells.size):
        cell, owner = int(cells[n]), int(owners[n])
        far[n] = _is_far(fields, walks, windows, samples, columns, scratch, cell, owner, is_all_over, most)


@inlined
def _is_far(
    fields: tuple[Coefficients, Coefficients],
    walks: tuple[Walk, Walk],
    windows: Windows,
    samples: Places,
    columns: ErrorColumns,
    scratch: Scratch,
    cell: int,
    owner: int,
    is_all_over: bool,
    most: float,
) -> bool:
    """Say whether fields are too far apart in a finest cell, or the value of its owner if that is not −1."""
    i, j, k = decode_cell(samples.codes[cell])
    shift = MAX_DEPTH - samples.depth
    full = enter(fields[1], walks[1], windows, 1, i << shift, j << shift, k << shift)
    level = 0
    if owner < 0:
        level = enter(fields[0], walks[0], windows, 0, i << shift, j << shift, k << shift)
        if level == full and not is_refined(walks[0], level):
            return False  # both have the same leaves there
    place = (i, j, k, samples.depth)
    normal = scratch.normal
    view = view_of(normal, 0)
    for sample in range(samples.firsts[cell], samples.firsts[cell + 1]):
        if is_all_over:
            count = lay_out(samples.places, samples.normals, sample, scratch.points)
        else:
            count = lay_first(samples.places, sample, scratch.points)
        for look in range(2 if is_all_over else 1):  # without a normal, then with it
            one, other = 0, 1
            if look == 1:
                is_new = False
                for axis in range(3):
                    is_new |= normal[0, axis] != samples.normals[sample, axis]
                    normal[0, axis] = samples.normals[sample, axis]
                view = view_of(normal, 0)
                if is_new:
                    windows.known[2:] = False
                hidden = HIDDEN[_full_facings(view)]
                one = 2 if windows.kinds[0, level] & hidden != np.uint64(0) else 0
                other = 3 if windows.kinds[1, full] & hidden != np.uint64(0) else 1
                if one == 0 and other == 1:
                    continue  # the normal changes nothing
            find_coefficients(fields[1], walks[1], windows, other, full, other == 3, view)
            if owner >= 0:
                _read_value(fields[0], owner, scratch)
            else:
                find_coefficients(fields[0], walks[0], windows, one, level, one == 2, view)
                is_first = look == 0 and sample == samples.firsts[cell]
                if is_first and _are_made_alike(windows, level, full, columns, most, scratch.bounds):
                    return False
                _look_up(fields[0], windows, one, level, place, 0, 1, scratch)
            _look_up(fields[1], windows, other, full, place, 0, 1, scratch)
            subtract(scratch.values, columns, 0, scratch.differences)
            if not are_near(scratch.differences, 0, most):
                return True
            if not is_all_over:
                continue
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
def _read_value(field: Coefficients, cell: int, scratch: Scratch) -> None:
    """Write the value of a cell as the field's at the first point."""
    vectors = (field.components + 4) // 4
    for component in range(field.components):
        row = cell * vectors + (component >> 2)
        scratch.values[0, component, 0] = field.rows[row, component & 3]


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
