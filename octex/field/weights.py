"""Weights of taps besides the spline: by the area of the cell, and by the facing of its surface.

Averages weigh by the roots of their areas. A *split* cell has a row of values for each facing of its surface
(paper 3.5.2). A lookup with a normal takes the visible rows, and cells that face away weigh next to nothing.
One without leaves split cells with opposite facings, a front and a back, to the next finer level.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from octex.arrays import ChannelValues, Float32s, Floats, Uint8s, Uint32s
from octex.field.taps import (
    AT_ONCE,
    NO_FIVE,
    Codes,
    Five,
    Flat,
    Taps,
    end_of,
    flat_of,
    scale_to_off,
    with_row,
)
from octex.jit import decoded, inlined, kernel, part, popcount, prefetch
from octex.tree.areas import AREAS
from octex.tree.children import rank_in
from octex.tree.layout import FACING_FLAGS, SPLIT
from octex.tree.octree import Octree
from octex.tree.split import counts_of

#: Weights of averages by area code: the root of the area in cell faces, 1 if unknown. Half way between equal
#: weights and the area itself, whose footprints are ragged, painted content had the least errors.
AREA_WEIGHTS = np.sqrt(AREAS).astype(np.float32)
AREA_WEIGHTS[0] = 1.0
#: Cosine of the normal and a cell's facing from which on the cell has full weight. A surface's flag is at
#: most 54.7° (cosine 0.577) from its normal, so a visible surface always has.
_FULL = np.float32(0.5)
#: Difference of cosines, to the facing nearest to the normal, within which others of a split cell count too.
_NEAR = np.float32(0.2)
#: Weight of surface that faces away: counts only where no other is there, as behind double-sided materials.
AWAY = np.float32(1e-6)

#: Most taps that stand for one: a facing of each axis.
MOST_ROWS = 3

#: So many rows fit the processor's second cache and need no prefetch.
CACHED_ROWS = 1 << 16


class Facings(NamedTuple):
    """The facings of a tree's cells, and the rows of split cells."""

    flags: Uint8s  # (cells,)
    rows: Uint32s  # (cells,)   a split cell's first row in the split table; or (0,) if that is empty
    kept: Uint32s  # (kept nodes,)   their cells


def facings_of(tree: Octree) -> Facings:
    """Index a tree's split cells; the index's untouched pages take no memory."""
    cells, facings, areas = tree.split
    rows, counts = np.zeros(tree.n_cells if areas.size else 0, np.uint32), counts_of(facings)
    is_inside = cells < rows.size
    rows[cells[is_inside]] = (np.cumsum(counts) - counts)[is_inside]
    return Facings(tree.arrays.flags, rows, tree.kept.cells)


def _directions() -> Uint8s:
    """Tabulate which facings of a cell can see a normal: [signs of the normal · 64 + the cell's flags].

    An entry has a bit for each axis; it is 8 for a cell without facings.
    """
    table = np.zeros((8, 64), np.uint8)
    for signs in range(8):
        for flags in range(64):
            bits = [flags >> (2 * axis + (signs >> axis & 1)) & 1 for axis in range(3)]
            table[signs, flags] = bits[0] | bits[1] << 1 | bits[2] << 2 if flags else 8
    return table.reshape(-1)


DIRECTIONS = _directions()


@inlined
def ramp(cosine: np.float32) -> np.float32:
    """Rise smoothly from 0 to 1 between cosine 0 and the full cosine."""
    t = min(cosine / _FULL, np.float32(1.0))
    return t * t * (np.float32(3.0) - np.float32(2.0) * t)


#: The sizes of a normal's cosines with the axes, and their signs as bits.
View: TypeAlias = tuple[np.float32, np.float32, np.float32, int]


NO_VIEW: View = np.float32(0.0), np.float32(0.0), np.float32(0.0), 0


@inlined
def view_of(normals: Float32s, n: int) -> View:
    """Return the view along normal n."""
    return view_along(normals[n, 0], normals[n, 1], normals[n, 2])


@inlined
def view_along(x: float, y: float, z: float) -> View:
    """Return the view along a normal of any length."""
    signs = int(x < 0) | int(y < 0) << 1 | int(z < 0) << 2
    x, y, z = abs(x), abs(y), abs(z)
    largest = max(x, max(y, z))
    if largest > 0.0:  # before anything is squared
        x, y, z = x / largest, y / largest, z / largest
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
    return np.float32(x), np.float32(y), np.float32(z), signs


@inlined
def parts_of(parts: Float32s, view: View) -> None:
    """Write the weights (9,) of cells by `direction_of`, along a normal."""
    x, y, z = ramp(view[0]) + AWAY, ramp(view[1]) + AWAY, ramp(view[2]) + AWAY
    parts[0], parts[8] = AWAY, np.float32(1.0) + AWAY
    parts[1], parts[2], parts[3], parts[4] = x, y, max(x, y), z
    parts[5], parts[6], parts[7] = max(x, z), max(y, z), max(x, max(y, z))


@inlined
def direction_of(signs: int, flags: np.uint8) -> np.uint8:
    """Return which facings of a cell can see a normal, from its signs: see `_directions`."""
    return DIRECTIONS[np.uint64(64 * signs) + np.uint64(flags & np.uint8(FACING_FLAGS))]  # type: ignore[no-any-return]


@inlined
def _flags_of(facings: Facings, first_kept: int, row: np.uint32) -> np.uint8:
    """Return the flags of a tap's cell; a kept row's cell is its node."""
    cell, flags = np.int64(row), np.uint8(0)
    if cell < facings.flags.size:
        flags = facings.flags[np.uint64(cell)]
    elif facings.kept.size > 0 and cell >= first_kept:
        flags = facings.flags[facings.kept[min(int(cell) - first_kept, facings.kept.size - 1)]]
    return flags


@inlined
def shares_of(x: np.float32, y: np.float32, z: np.float32) -> tuple[np.float32, np.float32, np.float32]:
    """Share a split cell out among its rows by their cosines to the normal; 0 for no row."""
    none = np.float32(0.0)
    if ramp(max(x, max(y, z))) == none:
        return none, none, none
    least = max(x, max(y, z)) - _NEAR
    x = max(x - least, none) if x > none else none
    y = max(y - least, none) if y > none else none
    z = max(z - least, none) if z > none else none
    total = x + y + z
    if total > max(x, max(y, z)):
        return x / total, y / total, z / total
    one = np.float32(1.0)  # one alone
    return one if x > none else none, one if y > none else none, one if z > none else none


@inlined
def face_cell(flags: np.uint8, view: View) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return a cell's weight for a view, and the shares of its visible rows of x, y and z.

    The shares are 0 without such rows, and where the cell is taken as a whole.
    """
    x, y, z, signs = view
    none = np.float32(0.0)
    bits = direction_of(signs, flags)
    if bits >= np.uint8(8):
        return np.float32(1.0) + AWAY, none, none, none
    x = x if bits & np.uint8(1) else none
    y = y if bits & np.uint8(2) else none
    z = z if bits & np.uint8(4) else none
    part = ramp(max(x, max(y, z)))
    if flags & np.uint8(SPLIT) == 0 or part == none:
        return part + AWAY, none, none, none
    a, b, c = shares_of(x, y, z)
    return part + AWAY, a, b, c


class Weighing(NamedTuple):
    """Weights besides the spline; unused arrays are empty."""

    areas: Uint8s  # (cells,) or (0,)
    mixed: Uint8s  # (cells,) or (0,)   which cells mix facings, see `mark_mixed`: they weigh nothing
    first_mixed: int  # the first of these cells
    facings: Facings
    faces: bool  # lookups have normals
    first_kept: int  # the row number of the first kept node
    first_row: int  # and of the first row of the split table


class Visible(NamedTuple):
    """The visible part of cells for a normal, by the bits of `DIRECTIONS`; and slopes of mixed cells."""

    parts: Float32s  # (9,)   weights of cells
    is_split: Uint8s  # (AT_ONCE,)   which points of a group have split cells
    slopes: Float32s  # (2, 3)   of the weights of all cells, and of those that mix facings


@part
def new_visible() -> Visible:
    """Return room for a normal's visible parts."""
    return Visible(np.empty(9, np.float32), np.zeros(AT_ONCE, np.uint8), np.empty((2, 3), np.float32))


@inlined
def row_of(first: int, flags: np.uint8, axis: int, signs: int) -> int:
    """Return the row of a split cell, from its first, that faces a normal of these signs along an axis."""
    return first + rank_in(np.uint64(flags & np.uint8(FACING_FLAGS)), 2 * axis + (signs >> axis & 1))


@inlined
def find_split(
    taps: Taps, begin: int, end: int, weighing: Weighing, split: ChannelValues, visible: Visible
) -> None:
    """Find which points of a group have split cells, and prefetch their rows."""
    facings = weighing.facings
    if not weighing.faces or facings.rows.size == 0:
        return
    for n in range(begin, end):
        all_flags = np.uint8(0)
        for tap in range(taps.starts[np.uint64(n)], taps.ends[np.uint64(n)]):
            all_flags |= _flags_of(facings, weighing.first_kept, taps.rows[np.uint64(tap)])
        visible.is_split[np.uint64(n - begin)] = all_flags & np.uint8(SPLIT)
    for n in range(begin, end if facings.rows.size > CACHED_ROWS else begin):
        if visible.is_split[np.uint64(n - begin)] != 0:
            for tap in range(taps.starts[np.uint64(n)], taps.ends[np.uint64(n)]):
                prefetch(facings.rows, int(taps.rows[np.uint64(tap)]))
    for n in range(begin, end):
        if visible.is_split[np.uint64(n - begin)] != 0:
            for tap in range(taps.starts[np.uint64(n)], taps.ends[np.uint64(n)]):
                row = np.uint64(taps.rows[np.uint64(tap)])
                if row < facings.rows.size and facings.flags[row] >= np.uint8(SPLIT):
                    prefetch(split, int(facings.rows[row]))


@inlined
def weigh(
    taps: Taps,
    n: int,
    end: int,
    weighing: Weighing,
    view: View,
    visible: Visible,
    faces: bool,
    is_split: bool,
    flat: Flat,
    components: int,
) -> tuple[int, Five, float, float]:
    """Weigh the cells of a point: mixed cells weigh nothing, split ones as their visible rows.

    Returns the sum of the values; or, without ``components``, writes the taps from ``end`` on and returns
    their end. The last two results are the weights by area, of all cells and of mixed ones.
    """
    five, total, of_mixed, none = NO_FIVE, 0.0, 0.0, np.float32(0.0)
    facings, gradient = weighing.facings, components == 0 and taps.slopes.shape[0] > 0
    x = y = z = np.float32(0.0)  # of all slopes
    if gradient:
        visible.slopes[:] = np.float32(0.0)
    if faces:
        parts_of(visible.parts, view)
    latest_bits, shares = np.uint8(0), (none, none, none)  # of the latest split cell's rows of x, y and z
    for tap in range(taps.starts[n], taps.ends[n]):
        row = taps.rows[np.uint64(tap)]
        weight, factor = taps.weights[np.uint64(tap)], np.float32(1.0)
        if weighing.areas.size > 0 and row < weighing.areas.size:
            factor = AREA_WEIGHTS[np.uint64(weighing.areas[np.uint64(row)])]
            weight *= factor
        total += np.float64(weight)
        cell = np.int64(row) - weighing.first_mixed
        is_mixed = bool(0 <= cell < weighing.mixed.size and weighing.mixed[np.uint64(cell)] != 0)
        if gradient:
            at = np.uint64(tap)
            p, q, r = taps.slopes[at, 0], taps.slopes[at, 1], taps.slopes[at, 2]
            x, y, z = x + factor * p, y + factor * q, z + factor * r
            if is_mixed:
                visible.slopes[1, 0] += factor * p
                visible.slopes[1, 1] += factor * q
                visible.slopes[1, 2] += factor * r
        if is_mixed:
            of_mixed += np.float64(weight)
            weight = factor = np.float32(0.0)
        flags, is_whole = np.uint8(0), True
        if faces:
            flags = _flags_of(facings, weighing.first_kept, row)
            bits = direction_of(view[3], flags)
            weight *= visible.parts[np.uint64(bits)]
            factor *= visible.parts[np.uint64(bits)]
            if is_split and flags >= np.uint8(SPLIT):
                if bits != latest_bits:
                    p, q = view[0] if bits & 1 else none, view[1] if bits & 2 else none
                    latest_bits, shares = bits, shares_of(p, q, view[2] if bits & 4 else none)
                is_whole = max(shares[0], max(shares[1], shares[2])) == none
        if is_whole:
            if components > 0:
                five = with_row(five, flat, int(row), weight, components)
            else:
                end = _write(taps, end, tap, row, weight, factor, gradient)
            continue
        cell = np.int64(row)
        if cell >= facings.rows.size:
            cell = np.int64(facings.kept[min(int(cell) - weighing.first_kept, facings.kept.size - 1)])
        first = weighing.first_row + int(np.int64(facings.rows[np.uint64(cell)]))
        for axis in range(3):
            visible_row, share = row_of(first, flags, axis, view[3]), shares[axis]
            if share == none:
                continue
            if components > 0:
                five = with_row(five, flat, visible_row, share * weight, components)
            else:
                end = _write(taps, end, tap, np.uint32(visible_row), share * weight, share * factor, gradient)
    if gradient:
        visible.slopes[0, 0], visible.slopes[0, 1], visible.slopes[0, 2] = x, y, z
    return end, five, total, of_mixed


@inlined
def _write(
    taps: Taps, end: int, tap: int, row: np.uint32, weight: np.float32, factor: np.float32, gradient: bool
) -> int:
    """Write a tap in place of another, with its slopes times a factor; return the end."""
    taps.rows[np.uint64(end)], taps.weights[np.uint64(end)] = row, weight
    for axis in range(3 if gradient else 0):
        taps.slopes[end, axis] = factor * taps.slopes[tap, axis]
    return end + 1


@kernel
def weigh_taps(
    taps: Taps,
    weighing: Weighing,
    normals: Float32s,
    split: Uint8s,
    passed: Float32s,
    passed_slopes: Float32s,
) -> None:
    """Weigh the taps of points in place; normals (points, 3), or none.

    Taps of points with split cells move behind all others; there must be room for MOST_ROWS times all taps.
    Rows of the split table, as bytes, are prefetched. Off the surface weights still sum to OFF. The weight of
    mixed cells is written to ``passed`` (points,), as a part of all, and its derivatives to ``passed_slopes``
    (points, 3) or (0, 3).
    """
    end, visible, faces = end_of(taps), new_visible(), weighing.faces
    slopes, flat = visible.slopes, flat_of(Codes(split, split, split, visible.parts))  # ``flat`` is not read
    for begin in range(0, taps.starts.size, AT_ONCE):
        last = min(begin + AT_ONCE, taps.starts.size)
        find_split(taps, begin, last, weighing, split, visible)
        for n in range(begin, last):
            is_split = visible.is_split[np.uint64(n - begin)] != 0
            view = view_of(normals, n) if faces else NO_VIEW
            start = end if is_split else int(taps.starts[n])
            stop, _, total, of_mixed = weigh(
                taps, n, start, weighing, view, visible, faces, is_split, flat, 0
            )
            if is_split:
                taps.starts[n], taps.ends[n], end = start, stop, stop
            inverse = np.float32(1.0 / total) if total > 0.0 else np.float32(0.0)
            if weighing.mixed.size > 0:
                share = passed[n] = np.float32(of_mixed * inverse)
                for axis in range(3 if passed_slopes.shape[0] > 0 else 0):
                    passed_slopes[n, axis] = (slopes[1, axis] - share * slopes[0, axis]) * inverse
            if weighing.areas.size > 0 and taps.covers[n] == np.float32(0.0) and total > 0.0:
                drift = slopes[0, 0], slopes[0, 1], slopes[0, 2]
                scale_to_off(taps, start, stop, np.float32(total), *drift)


@kernel
def mark_mixed(
    cells: Uint32s,
    facings: Uint8s,
    table: Floats,
    values: ChannelValues,
    first: int,
    threshold: float,
    mixed: Uint8s,
) -> None:
    """Mark split cells whose opposite facings differ by ``threshold`` or more in ``mixed`` (cells,).

    The decoded ``values`` (rows, components) of the split table are compared in each component, for cells
    from number ``first`` on; others do not differ.
    """
    row = 0
    for n in range(cells.size):
        flags = np.uint64(facings[n] & np.uint8(FACING_FLAGS))
        largest, is_double = np.float32(0.0), False
        for axis in range(3):
            if flags >> np.uint64(2 * axis) & np.uint64(3) != np.uint64(3):
                continue
            is_double = True
            at = row + rank_in(flags, 2 * axis)
            at = max(min(at, values.shape[0] - 2), 0)
            for component in range(values.shape[1] if cells[n] >= first and values.shape[0] > 1 else 0):
                difference = decoded(table, values[at, component]) - decoded(table, values[at + 1, component])
                largest = max(largest, np.float32(abs(difference)))
        if is_double and np.int64(cells[n]) < mixed.size:
            mixed[cells[n]] = largest >= threshold
        row += popcount(flags)
