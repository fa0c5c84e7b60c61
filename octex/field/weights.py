"""What weighs a tap beside the spline: the area of its cell, and which way the surface in it faces.

Averages weigh by the roots of their areas. A *split* cell has a row of values for each way that the surface
in it faces (paper 3.5.2): a lookup that knows its normal takes the rows that face it, and cells that face
away weigh next to nothing; one that does not leaves split cells with opposite facings, a front and a back, to
the next finer level.
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
    let_sum_to_off,
    with_row,
)
from octex.jit import decoded, inlined, kernel, part, popcount, prefetch, trailing_zeros
from octex.tree.areas import AREAS
from octex.tree.layout import FACING_FLAGS, SPLIT
from octex.tree.octree import Octree
from octex.tree.split import counts_of

#: What averages weigh by the codes of their cells' areas: the root of the area, in cell faces; 1 if that is
#: not known. By the area itself, cells that the surface hardly touches count for as little as they hold, but
#: what is then looked at is more ragged: half way from equal weights, painted content was nearest to the
#: truth.
AREA_WEIGHTS = np.sqrt(AREAS).astype(np.float32)
AREA_WEIGHTS[0] = 1.0
#: Cosine between the normal and one of a cell's facings from which on the cell counts in full. A surface is
#: flagged with the axis nearest to its normal, so that they are never more than 54.7° apart (cosine 0.577):
#: what belongs to the surface looked at is never weakened.
_FULL = np.float32(0.5)
#: Difference of cosines, to the facing nearest to the normal, within which others of a split cell count too.
_NEAR = np.float32(0.2)
#: Weight of what faces away: decides only where nothing else is there, as behind double-sided materials.
AWAY = np.float32(1e-6)

#: Most taps that stand for one: a facing of each axis.
MOST_ROWS = 3

#: So many rows lie in the processor's second cache, and need not be asked for.
NEAR_ROWS = 1 << 16


class Facings(NamedTuple):
    """Which ways the cells of a tree face, and where the rows of its split cells are."""

    flags: Uint8s  # (cells,)
    rows: Uint32s  # (cells,)   a split cell's first row in the split table; or (0,) if that is empty
    kept: Uint32s  # (kept nodes,)   the cells whose coefficients are kept: they face as these do


def facings_of(tree: Octree) -> Facings:
    """Index the split cells of a tree.

    Only where they are is the index written to: the rest of it takes no memory.
    """
    cells, facings, areas = tree.split
    rows, counts = np.zeros(tree.n_cells if areas.size else 0, np.uint32), counts_of(facings)
    there = cells < rows.size
    rows[cells[there]] = (np.cumsum(counts) - counts)[there]
    return Facings(tree.arrays.flags, rows, tree.kept.cells)


def _directions() -> Uint8s:
    """Say which of the three facings that can see a normal a cell has, by the normal's signs and the flags.

    [signs · 64 + flags]: a bit for each axis; 8 for a cell without facings.
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
    """Rise from 0 to 1 between no and the full cosine, without a bend."""
    t = min(cosine / _FULL, np.float32(1.0))
    return t * t * (np.float32(3.0) - np.float32(2.0) * t)


#: The sizes of a normal's cosines with the axes, and their signs as bits.
View: TypeAlias = tuple[np.float32, np.float32, np.float32, int]


NO_VIEW: View = np.float32(0.0), np.float32(0.0), np.float32(0.0), 0


@inlined
def view_of(normals: Float32s, n: int) -> View:
    """Return how cells are seen along one of some normals."""
    return view_along(normals[n, 0], normals[n, 1], normals[n, 2])


@inlined
def view_along(x: float, y: float, z: float) -> View:
    """Return how cells are seen along a normal of any length."""
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
    """Write what cells weigh (9,) by `direction_of` them, along a normal."""
    x, y, z = ramp(view[0]) + AWAY, ramp(view[1]) + AWAY, ramp(view[2]) + AWAY
    parts[0], parts[8] = AWAY, np.float32(1.0) + AWAY
    parts[1], parts[2], parts[3], parts[4] = x, y, max(x, y), z
    parts[5], parts[6], parts[7] = max(x, z), max(y, z), max(x, max(y, z))


@inlined
def direction_of(signs: int, flags: np.uint8) -> np.uint8:
    """Return which facings of a cell can see a normal whose signs are known: see `_directions`."""
    return DIRECTIONS[np.uint64(64 * signs) + np.uint64(flags & np.uint8(FACING_FLAGS))]  # type: ignore[no-any-return]


@inlined
def _flags_of(facings: Facings, first_kept: int, row: np.uint32) -> np.uint8:
    """Return the flags of a tap's cell; a kept coefficient's cell is the node that keeps it."""
    cell, flags = np.int64(row), np.uint8(0)
    if cell < facings.flags.size:
        flags = facings.flags[np.uint64(cell)]
    elif facings.kept.size > 0 and cell >= first_kept:
        flags = facings.flags[facings.kept[min(int(cell) - first_kept, facings.kept.size - 1)]]
    return flags


@inlined
def shares_of(x: np.float32, y: np.float32, z: np.float32) -> tuple[np.float32, np.float32, np.float32]:
    """Share a split cell out among its rows, by the cosines of those that face the normal; 0 for no row."""
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
    """Return what ``face`` multiplies the weight of a cell by, and what ``take_rows`` gives its rows.

    These are the shares of the rows of x, y and z that face the normal; all 0 where the cell has none, or is
    taken as a whole.
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
    """What weighs taps beside the spline; what does not is empty."""

    areas: Uint8s  # (cells,) or (0,)
    mixed: Uint8s  # (cells,) or (0,)   which cells mix facings, see `mark_mixed`: they weigh nothing
    first_mixed: int  # the first of these cells
    facings: Facings
    faces: bool  # there are normals
    first_kept: int  # what the first kept coefficient is counted as
    first_row: int  # and the first row of the split table


class Sight(NamedTuple):
    """What a normal sees of cells, by the bits of `DIRECTIONS`; and what is left to the next finer level."""

    parts: Float32s  # (9,)   what cells weigh
    shares: Float32s  # (9, 3)   how a split cell is shared out among its rows of x, y and z
    rows: Uint8s  # (9,)   which of these there are, a bit for each; _UNKNOWN until it is asked for
    is_split: Uint8s  # (AT_ONCE,)   which points of a group see split cells
    slopes: Float32s  # (2, 3)   of the weights of all cells, and of those that mix facings


_UNKNOWN = np.uint8(8)


@part
def new_sight() -> Sight:
    """Return room for what a normal sees."""
    return Sight(
        np.empty(9, np.float32),
        np.empty((9, 3), np.float32),
        np.empty(9, np.uint8),
        np.zeros(AT_ONCE, np.uint8),
        np.empty((2, 3), np.float32),
    )


@inlined
def _rows_seen(sight: Sight, view: View, bits: np.uint8) -> np.uint8:
    """Return which rows of a split cell are seen, a bit for each axis; none if it is taken as a whole."""
    at = np.uint64(bits)
    if sight.rows[at] == _UNKNOWN:
        none = np.float32(0.0)
        x, y, z, _ = view
        x, y, z = shares_of(x if bits & 1 else none, y if bits & 2 else none, z if bits & 4 else none)
        sight.shares[at, 0], sight.shares[at, 1], sight.shares[at, 2] = x, y, z
        sight.rows[at] = int(x > none) | int(y > none) << 1 | int(z > none) << 2
    return sight.rows[at]  # type: ignore[no-any-return]


@inlined
def row_of(first: int, flags: np.uint8, axis: int, signs: int) -> int:
    """Return which row of a split cell, whose first is known, faces a normal of such signs along an axis."""
    below = (np.uint64(1) << np.uint64(2 * axis + (signs >> axis & 1))) - np.uint64(1)
    return first + popcount(np.uint64(flags & np.uint8(FACING_FLAGS)) & below)


@inlined
def find_split(taps: Taps, begin: int, end: int, by: Weighing, split: ChannelValues, sight: Sight) -> None:
    """Note which points of a group see split cells, and ask for the rows of these."""
    facings = by.facings
    if not by.faces or facings.rows.size == 0:
        return
    for n in range(begin, end):
        seen = np.uint8(0)
        for tap in range(taps.starts[np.uint64(n)], taps.ends[np.uint64(n)]):
            seen |= _flags_of(facings, by.first_kept, taps.rows[np.uint64(tap)])
        sight.is_split[np.uint64(n - begin)] = seen & np.uint8(SPLIT)
    for n in range(begin, end if facings.rows.size > NEAR_ROWS else begin):
        if sight.is_split[np.uint64(n - begin)] != 0:
            for tap in range(taps.starts[np.uint64(n)], taps.ends[np.uint64(n)]):
                prefetch(facings.rows, int(taps.rows[np.uint64(tap)]))
    for n in range(begin, end):
        if sight.is_split[np.uint64(n - begin)] != 0:
            for tap in range(taps.starts[np.uint64(n)], taps.ends[np.uint64(n)]):
                row = np.uint64(taps.rows[np.uint64(tap)])
                if row < facings.rows.size and facings.flags[row] >= np.uint8(SPLIT):
                    prefetch(split, int(facings.rows[row]))


@inlined
def weigh(
    taps: Taps,
    n: int,
    end: int,
    by: Weighing,
    view: View,
    sight: Sight,
    faces: bool,
    is_split: bool,
    flat: Flat,
    components: int,
) -> tuple[int, Five, float, float]:
    """Weigh the cells of a point; those that mix facings weigh nothing, split ones as the rows that are seen.

    Returns the sum of the values; or, without ``components``, writes the taps anew from ``end`` on, and
    returns their end. The last two are the weights by areas, of all cells and of those that mix facings.
    """
    five, total, gone = NO_FIVE, 0.0, 0.0
    gradient = components == 0 and taps.slopes.shape[0] > 0
    x = y = z = np.float32(0.0)  # of all slopes
    if gradient:
        sight.slopes[:] = np.float32(0.0)
    if faces:
        parts_of(sight.parts, view)
    for known in range(9 if is_split else 0):
        sight.rows[np.uint64(known)] = np.uint8(0) if known & 7 == 0 else _UNKNOWN
    for tap in range(taps.starts[n], taps.ends[n]):
        row = taps.rows[np.uint64(tap)]
        weight, factor = taps.weights[np.uint64(tap)], np.float32(1.0)
        if by.areas.size > 0 and row < by.areas.size:
            factor = AREA_WEIGHTS[np.uint64(by.areas[np.uint64(row)])]
            weight *= factor
        total += np.float64(weight)
        cell = np.int64(row) - by.first_mixed
        is_mixed = bool(0 <= cell < by.mixed.size and by.mixed[np.uint64(cell)] != 0)
        if gradient:
            at = np.uint64(tap)
            p, q, r = taps.slopes[at, 0], taps.slopes[at, 1], taps.slopes[at, 2]
            x, y, z = x + factor * p, y + factor * q, z + factor * r
            if is_mixed:
                sight.slopes[1, 0] += factor * p
                sight.slopes[1, 1] += factor * q
                sight.slopes[1, 2] += factor * r
        if is_mixed:
            gone += np.float64(weight)
            weight = factor = np.float32(0.0)
        flags, bits, left = np.uint8(0), np.uint8(0), np.uint8(0)
        if faces:
            flags = _flags_of(by.facings, by.first_kept, row)
            bits = direction_of(view[3], flags)
            weight *= sight.parts[np.uint64(bits)]
            factor *= sight.parts[np.uint64(bits)]
            if is_split and flags >= np.uint8(SPLIT):
                left = _rows_seen(sight, view, bits)
        if left == 0:
            if components > 0:
                five = with_row(five, flat, int(row), weight, components)
            else:
                end = _write(taps, end, tap, row, weight, factor, gradient)
            continue
        cell = np.int64(row)
        if cell >= by.facings.rows.size:
            cell = np.int64(by.facings.kept[min(int(cell) - by.first_kept, by.facings.kept.size - 1)])
        first = by.first_row + int(np.int64(by.facings.rows[np.uint64(cell)]))
        while left != 0:
            axis = trailing_zeros(np.uint64(left))
            left &= left - np.uint8(1)
            own = row_of(first, flags, axis, view[3])
            share = sight.shares[np.uint64(bits), np.uint64(axis)]
            if components > 0:
                five = with_row(five, flat, own, share * weight, components)
            else:
                end = _write(taps, end, tap, np.uint32(own), share * weight, share * factor, gradient)
    if gradient:
        sight.slopes[0, 0], sight.slopes[0, 1], sight.slopes[0, 2] = x, y, z
    return end, five, total, gone


@inlined
def _write(
    taps: Taps, end: int, tap: int, row: np.uint32, weight: np.float32, factor: np.float32, gradient: bool
) -> int:
    """Write a tap in place of another, whose slopes are multiplied by a factor; return the end then."""
    taps.rows[np.uint64(end)], taps.weights[np.uint64(end)] = row, weight
    for axis in range(3 if gradient else 0):
        taps.slopes[end, axis] = factor * taps.slopes[tap, axis]
    return end + 1


@kernel
def weigh_taps(
    taps: Taps, by: Weighing, normals: Float32s, split: Uint8s, left: Float32s, left_slopes: Float32s
) -> None:
    """Weigh the taps of points in place; normals (points, 3), or none.

    Points with split cells get their taps anew, after all others, where there must be room for MOST_ROWS
    times those that there are. Rows of the split table, as bytes, are asked for. Off the surface weights by
    areas still sum to OFF. Where cells mix facings, the part of the weight that is taken away is written to
    ``left`` (points,), and its derivatives to ``left_slopes`` (points, 3), or (0, 3) if they are not wanted.
    """
    end, sight = end_of(taps), new_sight()
    slopes, flat = sight.slopes, flat_of(Codes(split, split, split, sight.parts))  # of which nothing is read
    for begin in range(0, taps.starts.size, AT_ONCE):
        last = min(begin + AT_ONCE, taps.starts.size)
        find_split(taps, begin, last, by, split, sight)
        for n in range(begin, last):
            is_split = sight.is_split[np.uint64(n - begin)] != 0
            view = view_of(normals, n) if by.faces else NO_VIEW
            start = end if is_split else int(taps.starts[n])
            stop, _, total, gone = weigh(taps, n, start, by, view, sight, by.faces, is_split, flat, 0)
            if is_split:
                taps.starts[n], taps.ends[n], end = start, stop, stop
            inverse = np.float32(1.0 / total) if total > 0.0 else np.float32(0.0)
            if by.mixed.size > 0:
                share = left[n] = np.float32(gone * inverse)
                for axis in range(3 if left_slopes.shape[0] > 0 else 0):
                    left_slopes[n, axis] = (slopes[1, axis] - share * slopes[0, axis]) * inverse
            if by.areas.size > 0 and taps.covers[n] == np.float32(0.0) and total > 0.0:
                drift = slopes[0, 0], slopes[0, 1], slopes[0, 2]
                let_sum_to_off(taps, start, stop, np.float32(total), *drift)


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
    """Mark the split cells whose opposite facings differ by ``threshold`` or more in ``mixed`` (cells,).

    The decoded ``values`` (rows, components) of the split table are compared in each component, of cells from
    number ``first`` on; others do not differ.
    """
    row = 0
    for n in range(cells.size):
        flags = np.uint64(facings[n] & np.uint8(FACING_FLAGS))
        largest, is_double = np.float32(0.0), False
        for axis in range(3):
            if flags >> np.uint64(2 * axis) & np.uint64(3) != np.uint64(3):
                continue
            is_double = True
            at = row + popcount(flags & (np.uint64(1) << np.uint64(2 * axis)) - np.uint64(1))
            at = max(min(at, values.shape[0] - 2), 0)
            for component in range(values.shape[1] if cells[n] >= first and values.shape[0] > 1 else 0):
                apart = decoded(table, values[at, component]) - decoded(table, values[at + 1, component])
                largest = max(largest, np.float32(abs(apart)))
        if is_double and np.int64(cells[n]) < mixed.size:
            mixed[cells[n]] = largest >= threshold
        row += popcount(flags)
