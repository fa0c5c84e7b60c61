"""Taps: the stored rows that a lookup blends, their weights, and the stages that change these.

*Sources* find each point's taps, by tiles (`sources`) where the leaves have one depth, else by the walk
(`neighborhood`); *sinks* blend the values of any channel under the weights, or list the taps (`sinks`).

Weights are those of the spline, so that those of one point sum to its *cover*, 0 … 1: how much of the
spline's weight falls on leaves. Off the surface, where that is zero, they are those of the coarser averages
that answer there and sum to OFF: beside looks that lie on the surface they count for nothing.

Between source and sink, averages weigh by the roots of their areas. A *split* cell has a row of values for
each way that the surface in it faces (paper 3.5.2): a lookup that knows its normal takes the rows that face
the normal, and cells that face away weigh nothing; one that does not leaves split cells with opposite
facings, a front and a back, to the next finer level. Where a texture has alpha, other channels weigh by it
(`sinks.weigh_by_alpha`).
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from octex.arrays import ChannelValues, Float32s, Float64s, Floats, Int64s, Uint8s, Uint32s
from octex.jit import decoded, inlined, kernel, popcount, prefetch, trailing_zeros
from octex.tree.areas import AREAS
from octex.tree.layout import FACING_FLAGS, POSITIVE_FACINGS, SPLIT
from octex.tree.octree import Octree
from octex.tree.search import Origin, Positions, position

#: Points whose taps are found before any is blended: enough that calls cost little, few enough that their
#: taps stay in the processor's second cache.
BLOCK = 4096
#: Points whose rows are asked for before any is read.
AT_ONCE = 64
#: Most taps of a point that tiles give, by filter.
MOST_TILED = 1, 8, 27, 125
#: What weights off the surface sum to.
OFF = np.float32(1e-9)
#: Taps that weigh less in sum lie at the rim of the spline's support, where products of single precision have
#: lost their digits: the walk answers there.
LEAST = np.float32(1e-24)


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


class Ahead(NamedTuple):
    """What will be read of cells next, to be asked for ahead; what is empty will not be read."""

    values: Uint8s  # (cells, bytes)
    alpha: Uint8s  # (cells, bytes) or (0, bytes)
    flags: Uint8s  # (cells,) or (0,)
    areas: Uint8s  # (cells,) or (0,)


@inlined
def ask_for(ahead: Ahead, cell: int) -> None:
    """Ask for what will be read of a cell, and of those that lie beside it."""
    prefetch(ahead.values, cell)
    if ahead.alpha.shape[0] > 0:
        prefetch(ahead.alpha, cell)
    if ahead.flags.size > 0:
        prefetch(ahead.flags, cell)
    if ahead.areas.size > 0:
        prefetch(ahead.areas, cell)


class Taps(NamedTuple):
    """The taps of a block of points.

    A row is a cell's number; after all cells come the rows of the kept table, then those of the split table.
    """

    rows: Uint32s  # (room,)
    weights: Float32s  # (room,)
    slopes: Float32s  # (room, 3)   derivatives of the weights in texture space; (0, 3) if they are not wanted
    starts: Int64s  # (points,)   those of a point are from its start
    ends: Int64s  # (points,)   to its end
    covers: Float32s  # (points,)

    @classmethod
    def of(cls, points: int, room: int, gradient: bool) -> Taps:
        """Return room for the taps of so many points."""
        return cls(
            np.empty(room, np.uint32),
            np.empty(room, np.float32),
            np.empty((room if gradient else 0, 3), np.float32),
            np.empty(points, np.int64),
            np.empty(points, np.int64),
            np.empty(points, np.float32),
        )

    def with_room(self, used: int, room: int) -> Taps:
        """Return the same taps, of which so many are used, with room for as many in all."""
        if room <= self.rows.size:
            return self
        larger = Taps.of(0, 2 * room, self.slopes.shape[0] > 0)
        for new, old in zip(larger[:3], self[:3], strict=True):
            new[: min(used, len(old))] = old[:used]
        return larger._replace(starts=self.starts, ends=self.ends, covers=self.covers)


@inlined
def end_of(taps: Taps) -> int:
    """Return the end of all taps."""
    end = np.int64(0)
    for n in range(taps.ends.size):
        end = max(end, taps.ends[np.uint64(n)])
    return int(end)


@inlined
def scale(taps: Taps, tap: int, factor: np.float32) -> None:
    """Multiply the weight of a tap, and its slopes."""
    at = np.uint64(tap)
    taps.weights[at] *= factor
    if taps.slopes.shape[0] > 0:
        taps.slopes[at, 0] *= factor
        taps.slopes[at, 1] *= factor
        taps.slopes[at, 2] *= factor


@inlined
def finish(
    taps: Taps,
    point: int,
    start: int,
    end: int,
    total: np.float32,
    is_off: bool,
    empty: Int64s,
    n_empty: int,
    rim: Int64s,
    n_rim: int,
) -> tuple[int, int, int]:
    """Note where the taps of a point are, and scale them if it is off the surface.

    A point that has none, or too small ones, is listed instead. Returns the end of the taps, and how many
    points are listed.
    """
    at = np.uint64(point)
    if not total >= LEAST:
        taps.starts[at] = taps.ends[at] = start
        if end == start:
            empty[np.uint64(n_empty)] = point
            return end, n_empty + 1, n_rim
        rim[np.uint64(n_rim)] = point
        return start, n_empty, n_rim + 1
    taps.starts[at], taps.ends[at] = start, end
    taps.covers[at] = np.float32(0.0) if is_off else total
    if is_off:
        let_sum_to_off(taps, start, end, total)
    return end, n_empty, n_rim


@kernel
def hold_outside(taps: Taps, places: Float64s) -> None:
    """Set the slopes of points outside the root cell to zero along the axes that ``places`` (n, 3) clamp."""
    for n in range(places.shape[0]):
        for axis in range(3):
            if 0.0 < places[n, axis] < 1.0:
                continue
            for tap in range(taps.starts[n], taps.ends[n]):
                taps.slopes[tap, axis] = 0.0


@inlined
def let_sum_to_off(taps: Taps, start: int, end: int, total: np.float32) -> None:
    """Scale the taps of a point, of weight ``total``, to the sum OFF: their slopes then sum to zero."""
    factor = OFF / total
    for axis in range(3 if taps.slopes.shape[0] > 0 else 0):
        drift = np.float32(0.0)
        for tap in range(start, end):
            drift += taps.slopes[np.uint64(tap), axis]
        drift /= total
        for tap in range(start, end):
            at = np.uint64(tap)
            taps.slopes[at, axis] = (taps.slopes[at, axis] - taps.weights[at] * drift) * factor
    for tap in range(start, end):
        taps.weights[np.uint64(tap)] *= factor


@inlined
def _place_rows(rows: Floats, origin: Origin, inverse: float, places: Float64s) -> bool:
    """Write where rows (n, 3) lie; say whether some are not finite."""
    faults = 0
    for n in range(rows.shape[0]):
        x, y, z = np.float64(rows[n, 0]), np.float64(rows[n, 1]), np.float64(rows[n, 2])
        faults |= int(not ((abs(x) < np.inf) & (abs(y) < np.inf) & (abs(z) < np.inf)))
        places[n, 0] = min(max(0.0, (x - origin[0]) * inverse), 1.0)
        places[n, 1] = min(max(0.0, (y - origin[1]) * inverse), 1.0)
        places[n, 2] = min(max(0.0, (z - origin[2]) * inverse), 1.0)
    return faults != 0


@kernel
def place_points(points: Positions, origin: Origin, size: float, places: Float64s) -> int:
    """Write where points lie in texture space (n, 3), clamped to 0 … 1.

    Returns the first position that is not finite, or −1.
    """
    if points.singles.shape[0] > 0:
        is_faulty = _place_rows(points.singles, origin, 1.0 / size, places)
    else:
        is_faulty = _place_rows(points.doubles, origin, 1.0 / size, places)
    if not is_faulty:
        return -1
    for n in range(places.shape[0]):
        x, y, z = position(points, n)
        if not ((abs(x) < np.inf) & (abs(y) < np.inf) & (abs(z) < np.inf)):
            return n
    return -1


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
    rows = np.zeros(tree.n_cells if areas.size else 0, np.uint32)
    _index_split(cells, facings, rows)
    return Facings(tree.arrays.flags, rows, tree.kept.cells)


@kernel
def _index_split(cells: Uint32s, facings: Uint8s, rows: Uint32s) -> None:
    row = 0
    for n in range(cells.size):
        if np.int64(cells[n]) < rows.size:
            rows[cells[n]] = row
        row += popcount(np.uint64(facings[n] & np.uint8(FACING_FLAGS)))


@kernel
def spreads_of(
    table: Floats, values: ChannelValues, facings: Uint8s, first_row: int, spreads: Float32s
) -> None:
    """Write how far the decoded values of opposite facings differ, in any component, to ``spreads`` (rows,).

    The rows of consecutive split cells begin at ``first_row`` of ``values`` (rows, components) and
    ``spreads``; only each cell's first is written.
    """
    if values.shape[0] < 2:
        return
    row = first_row
    for n in range(facings.size):
        flags = np.uint64(facings[n])
        largest = np.float32(0.0)
        for axis in range(3):
            if flags >> np.uint64(2 * axis) & np.uint64(3) == np.uint64(3):
                at = row + popcount(flags & (np.uint64(1) << np.uint64(2 * axis)) - np.uint64(1))
                at = max(min(at, values.shape[0] - 2), 0)
                for component in range(values.shape[1]):
                    apart = decoded(table, values[at, component]) - decoded(table, values[at + 1, component])
                    largest = max(largest, abs(apart))
        if row < spreads.size:
            spreads[row] = largest
        row += popcount(flags & np.uint64(FACING_FLAGS))


@kernel
def weigh_by_area(taps: Taps, areas: Uint8s) -> None:
    """Multiply the weights of cells by what their areas weigh; off the surface they still sum to OFF."""
    for tap in range(end_of(taps)):
        row = taps.rows[np.uint64(tap)]
        if row < areas.size:
            scale(taps, tap, AREA_WEIGHTS[areas[np.uint64(row)]])
    for n in range(taps.starts.size):
        if taps.covers[np.uint64(n)] != np.float32(0.0):
            continue
        total = np.float32(0.0)
        for tap in range(taps.starts[n], taps.ends[n]):
            total += taps.weights[tap]
        if total > np.float32(0.0):
            let_sum_to_off(taps, taps.starts[n], taps.ends[n], total)


@kernel
def mark_mixed(cells: Uint32s, facings: Uint8s, spreads: Float32s, threshold: float, mixed: Uint8s) -> None:
    """Mark the split cells whose opposite facings differ by ``threshold`` or more in ``mixed`` (cells,).

    ``spreads`` (rows,) say how far they differ, at each split cell's first row.
    """
    row = 0
    for n in range(cells.size):
        flags = facings[n] & np.uint8(FACING_FLAGS)
        is_double = flags & (flags >> np.uint8(1)) & np.uint8(POSITIVE_FACINGS) != 0
        if is_double and np.int64(cells[n]) < mixed.size and row < spreads.size:
            mixed[cells[n]] = spreads[row] >= threshold
        row += popcount(np.uint64(flags))


@kernel
def leave_mixed(taps: Taps, mixed: Uint8s, left: Float32s, slopes: Float32s) -> None:
    """Let cells that are marked in ``mixed`` (cells,) weigh nothing; see `mark_mixed`.

    Writes to ``left`` (points,) the part of the weight that is taken away, and its derivatives to ``slopes``
    (points, 3), or (0, 3) if they are not wanted.
    """
    zero = np.float32(0.0)
    for n in range(taps.starts.size):
        total = gone = zero
        x = y = z = of_x = of_y = of_z = zero  # the slopes of what is gone, and of all
        for tap in range(taps.starts[np.uint64(n)], taps.ends[np.uint64(n)]):
            at = np.uint64(tap)
            weight, cell = taps.weights[at], taps.rows[at]
            is_mixed = cell < mixed.size and mixed[np.uint64(cell)] != 0
            total += weight
            if slopes.shape[0] > 0:
                p, q, r = taps.slopes[at, 0], taps.slopes[at, 1], taps.slopes[at, 2]
                of_x, of_y, of_z = of_x + p, of_y + q, of_z + r
                if is_mixed:
                    x, y, z = x + p, y + q, z + r
            if is_mixed:
                gone += weight
                scale(taps, tap, zero)
        share = gone / total if gone > zero else zero
        left[np.uint64(n)] = share
        if slopes.shape[0] > 0:
            inverse = np.float32(1.0) / total if gone > zero else zero
            slopes[n, 0], slopes[n, 1] = (x - share * of_x) * inverse, (y - share * of_y) * inverse
            slopes[n, 2] = (z - share * of_z) * inverse


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


@inlined
def unit_of(normals: Float32s, n: int) -> tuple[np.float32, np.float32, np.float32, int]:
    """Return the sizes of a normal's cosines with the axes, and their signs as bits."""
    x, y, z = normals[n, 0], normals[n, 1], normals[n, 2]
    signs = int(x < 0) | int(y < 0) << 1 | int(z < 0) << 2
    x, y, z = abs(x), abs(y), abs(z)
    largest = max(x, max(y, z))
    if largest > np.float32(0.0):  # before anything is squared
        x, y, z = x / largest, y / largest, z / largest
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
    return x, y, z, signs


@inlined
def parts_of(parts: Float32s, x: np.float32, y: np.float32, z: np.float32) -> None:
    """Write what cells weigh (9,) by `direction_of` them, for the sizes of a normal's cosines."""
    x, y, z = ramp(x) + AWAY, ramp(y) + AWAY, ramp(z) + AWAY
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


@kernel
def face(
    taps: Taps, facings: Facings, first_kept: int, first_row: int, normals: Float32s, split: Uint8s
) -> None:
    """Let what faces away from the normals (points, 3) weigh next to nothing.

    Points with split cells get their taps anew, after all others, where there must be room for MOST_ROWS
    times those that there are. ``first_kept`` and ``first_row`` are what the first kept
    coefficient and the first row of the split table are counted as; rows of that, as bytes, are asked for.
    """
    end = end_of(taps)
    parts = np.zeros(9, np.float32)
    shares, wanted = np.zeros((8, 3), np.float32), np.zeros(8, np.uint8)
    mixed = np.zeros(AT_ONCE, np.int64)
    for begin in range(0, taps.starts.size, AT_ONCE):
        n_mixed = 0
        for n in range(begin, min(begin + AT_ONCE, taps.starts.size)):
            x, y, z, signs = unit_of(normals, n)
            parts_of(parts, x, y, z)
            seen = np.uint8(0)
            for tap in range(taps.starts[np.uint64(n)], taps.ends[np.uint64(n)]):
                flags = _flags_of(facings, first_kept, taps.rows[np.uint64(tap)])
                seen |= flags
                scale(taps, int(tap), parts[np.uint64(direction_of(signs, flags))])
            mixed[np.uint64(n_mixed)] = n
            n_mixed += int(seen >= np.uint8(SPLIT))
        if facings.rows.size == 0:
            continue
        for m in range(n_mixed if facings.rows.size > NEAR_ROWS else 0):
            for tap in range(taps.starts[mixed[m]], taps.ends[mixed[m]]):
                prefetch(facings.rows, int(taps.rows[tap]))
        for m in range(n_mixed):
            rows = shares, wanted, split
            end = _take_rows(taps, int(mixed[m]), end, facings, first_kept, first_row, normals, *rows)


@inlined
def _take_rows(
    taps: Taps,
    n: int,
    end: int,
    facings: Facings,
    first_kept: int,
    first_row: int,
    normals: Float32s,
    shares: Float32s,
    wanted: Uint8s,
    split: Uint8s,
) -> int:
    """Write the taps of a point anew, from ``end`` on: those of split cells as the rows that face the normal.

    ``shares`` (8, 3) and ``wanted`` (8,) are room for the shares of rows by the bits of `DIRECTIONS`, and
    for which of them there are.
    """
    gradient = taps.slopes.shape[0] > 0
    none, one, bit = np.float32(0.0), np.uint64(1), np.uint8(1)
    x, y, z, signs = unit_of(normals, n)
    known = np.uint8(1)  # what faces away is left as it is
    wanted[0] = 0
    start = end
    for tap in range(taps.starts[n], taps.ends[n]):
        row, weight = taps.rows[np.uint64(tap)], taps.weights[np.uint64(tap)]
        flags = _flags_of(facings, first_kept, row)
        bits = direction_of(signs, flags)
        left = np.uint8(0)
        if flags & np.uint8(SPLIT) != 0 and bits < np.uint8(8):
            if known >> bits & bit == 0:
                known |= bit << bits
                a, b, c = x if bits & 1 else none, y if bits & 2 else none, z if bits & 4 else none
                shares[bits, 0], shares[bits, 1], shares[bits, 2] = a, b, c = shares_of(a, b, c)
                wanted[bits] = int(a > none) | int(b > none) << 1 | int(c > none) << 2
            left = wanted[np.uint64(bits)]
        if left == 0:
            taps.rows[np.uint64(end)], taps.weights[np.uint64(end)] = row, weight
            if gradient:
                for each in range(3):
                    taps.slopes[end, each] = taps.slopes[tap, each]
            end += 1
            continue
        cell = np.int64(row)
        if cell >= facings.rows.size:
            cell = np.int64(facings.kept[min(int(cell) - first_kept, facings.kept.size - 1)])
        first = np.int64(facings.rows[np.uint64(cell)])
        while left != 0:
            axis = trailing_zeros(np.uint64(left))
            left &= left - bit
            share = shares[np.uint64(bits), np.uint64(axis)]
            below = (one << np.uint64(2 * axis + (signs >> axis & 1))) - one
            own = first + popcount(np.uint64(flags) & below)
            prefetch(split, int(own))
            taps.rows[np.uint64(end)], taps.weights[np.uint64(end)] = first_row + own, share * weight
            if gradient:
                for each in range(3):
                    taps.slopes[end, each] = share * taps.slopes[tap, each]
            end += 1
    taps.starts[n], taps.ends[n] = start, end
    return end


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


#: The sizes of a normal's cosines with the axes, and their signs as bits.
View: TypeAlias = tuple[np.float32, np.float32, np.float32, int]


@inlined
def view_of(normals: Float32s, n: int) -> View:
    """Return how ``face_cell`` takes normal ``n`` of some (m, 3)."""
    return unit_of(normals, n)


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
