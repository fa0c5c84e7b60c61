"""What a lookup sees of its taps: what faces it, or what does not mix opposite facings (paper 3.5.2).

A *split* cell has a row of values for each way that the surface in it faces. A lookup that knows its normal
takes the rows that face the normal, and cells that face away weigh nothing. One that does not leaves split
cells with opposite facings, a front and a back, to the next finer level.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.field.blocks import Bytes, Float32s, Int64s, Rows, Uint32s
from octex.jit import decoded, inlined, kernel, popcount
from octex.tree.layout import FACING_FLAGS, POSITIVE_FACINGS, SPLIT
from octex.tree.octree import Octree

#: What of its taps a lookup sees: all; what faces its normal; or all but cells that mix opposite facings.
ALL, FACING, UNMIXED = range(3)

#: Cosine between the normal and one of a cell's facings from which on the cell counts in full. A surface is
#: flagged with the axis nearest to its normal, so that they are never more than 54.7° apart (cosine 0.577):
#: what belongs to the surface looked at is never weakened.
_FULL = np.float32(0.5)
#: Difference of cosines, to the facing nearest to the normal, within which others of a split cell count too.
_NEAR = np.float32(0.2)
#: Weight of what faces away: decides only where nothing else is there, as behind double-sided materials.
_AWAY = np.float32(1e-6)

#: Most taps that stand for one: a facing of each axis.
MOST_SEEN = 3


class Facings(NamedTuple):
    """Which ways the cells of a tree face, and where the rows of its split cells are."""

    flags: Bytes  # (cells,)
    rows: Uint32s  # (cells,)   a split cell's first row in the split table; or (0,) if that is empty
    kept: Uint32s  # (kept nodes,)   the cells whose coefficients are kept: they face as these do


class Sight(NamedTuple):
    """What lookups see, and from where; arrays of one row a point, or none."""

    mode: int
    facings: Facings
    first_kept: int  # what the first kept coefficient is counted as
    first_row: int  # what the first row of the split table is counted as
    normals: Float32s  # (n, 3)   for FACING
    spreads: Float32s  # (rows,)   for UNMIXED: how far a cell's opposite facings differ, at its first row
    threshold: float  # from what spread on a cell is left out


def facings_of(tree: Octree) -> Facings:
    """Index the split cells of a tree.

    Only where they are is the index written to: the rest of it takes no memory.
    """
    cells, facings, areas = tree.split
    rows = np.zeros(tree.n_cells if areas.size else 0, np.uint32)
    _index(cells, facings, rows)
    return Facings(tree.arrays.flags, rows, tree.kept.cells)


def all_in_sight() -> Sight:
    """Return what sees all taps."""
    return _ALL


_ALL = Sight(
    ALL,
    Facings(np.zeros(1, np.uint8), np.zeros(0, np.uint32), np.zeros(0, np.uint32)),
    0,
    0,
    np.zeros((0, 3), np.float32),
    np.zeros(0, np.float32),
    0.0,
)


@kernel
def _index(cells: Uint32s, facings: Bytes, rows: Uint32s) -> None:
    row = 0
    for n in range(cells.size):
        if np.int64(cells[n]) < rows.size:
            rows[cells[n]] = row
        row += popcount(np.uint64(facings[n] & np.uint8(FACING_FLAGS)))


@kernel
def spreads_of(table: Float32s, values: Rows, facings: Bytes, first_row: int, spreads: Float32s) -> None:
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


@inlined
def _ramp(cosine: np.float32) -> np.float32:
    """Rise from 0 to 1 between no and the full cosine, without a bend."""
    t = min(cosine / _FULL, np.float32(1.0))
    return t * t * (np.float32(3.0) - np.float32(2.0) * t)


@inlined
def _share_of_split(
    sight: Sight,
    cell: np.uint32,
    flags: np.uint64,
    x: np.float32,
    y: np.float32,
    z: np.float32,
    bits: tuple[np.uint64, np.uint64, np.uint64],
    weight: np.float32,
    rows: Uint32s,
    seen: Float32s,
    at: int,
) -> int:
    """Write a split cell's rows that face the normal; x, y and z are 0 where it has none such."""
    none, one = np.float32(0.0), np.uint64(1)
    least = max(x, max(y, z)) - _NEAR
    x = max(x - least, none) if x > none else none
    y = max(y - least, none) if y > none else none
    z = max(z - least, none) if z > none else none
    total = x + y + z
    if total > max(x, max(y, z)):
        x, y, z = x / total, y / total, z / total
    else:  # one alone
        x = np.float32(1.0) if x > none else none
        y = np.float32(1.0) if y > none else none
        z = np.float32(1.0) if z > none else none
    row = sight.first_row + np.int64(sight.facings.rows[cell])
    if x > none:
        rows[at], seen[at] = row + popcount(flags & ((one << bits[0]) - one)), weight * x
        at += 1
    if y > none:
        rows[at], seen[at] = row + popcount(flags & ((one << bits[1]) - one)), weight * y
        at += 1
    if z > none:
        rows[at], seen[at] = row + popcount(flags & ((one << bits[2]) - one)), weight * z
        at += 1
    return at


@inlined
def _take_facing(
    sight: Sight,
    point: int,
    cells: Uint32s,
    weights: Float32s,
    first: int,
    end: int,
    step: int,
    rows: Uint32s,
    seen: Float32s,
    at: int,
) -> int:
    facings = sight.facings
    n_cells = np.uint32(facings.flags.size)
    x, y, z = sight.normals[point, 0], sight.normals[point, 1], sight.normals[point, 2]
    bits = np.uint64(x < 0), np.uint64(2 + (y < 0)), np.uint64(4 + (z < 0))
    x, y, z = abs(x), abs(y), abs(z)
    largest = max(x, max(y, z))
    if largest > np.float32(0.0):  # before anything is squared
        x, y, z = x / largest, y / largest, z / largest
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
    ramp_x, ramp_y, ramp_z = _ramp(x), _ramp(y), _ramp(z)
    none, one = np.float32(0.0), np.uint64(1)
    has_rows = facings.rows.size > 0
    for tap in range(first, end, step):
        cell = cells[tap]
        if weights[tap] == none:
            continue
        source = cell
        if cell >= n_cells and facings.kept.size > 0 and np.int64(cell) >= sight.first_kept:
            source = facings.kept[min(int(cell) - sight.first_kept, facings.kept.size - 1)]
        flags = np.uint64(facings.flags[source]) if source < n_cells else np.uint64(0)
        part_x = ramp_x if flags >> bits[0] & one else none
        part_y = ramp_y if flags >> bits[1] & one else none
        part_z = ramp_z if flags >> bits[2] & one else none
        part = max(part_x, max(part_y, part_z))
        if flags & np.uint64(FACING_FLAGS) == np.uint64(0):
            part = np.float32(1.0)
        weight = weights[tap] * (part + _AWAY)
        if has_rows and flags & np.uint64(SPLIT) != np.uint64(0) and part > none:
            a, b, c = x if part_x > none else none, y if part_y > none else none, z if part_z > none else none
            at = _share_of_split(sight, source, flags, a, b, c, bits, weight, rows, seen, at)
        else:
            rows[at], seen[at] = cell, weight
            at += 1
    return at


@inlined
def _take_unmixed(
    sight: Sight,
    cells: Uint32s,
    weights: Float32s,
    first: int,
    end: int,
    step: int,
    rows: Uint32s,
    seen: Float32s,
    at: int,
) -> int:
    facings = sight.facings
    n_cells = np.uint32(facings.flags.size)
    for tap in range(first, end, step):
        cell = cells[tap]
        flags = facings.flags[cell] if cell < n_cells else np.uint8(0)
        if flags & np.uint8(SPLIT) != 0 and flags & (flags >> np.uint8(1)) & np.uint8(POSITIVE_FACINGS) != 0:
            row = np.int64(facings.rows[cell]) if facings.rows.size > 0 else -1
            row = min(row, sight.spreads.size - 1)
            if row >= 0 and sight.spreads[row] >= sight.threshold:
                continue
        rows[at], seen[at] = cell, weights[tap]
        at += 1
    return at


@inlined
def take_seen(
    sight: Sight,
    point: int,
    cells: Uint32s,
    weights: Float32s,
    first: int,
    end: int,
    step: int,
    rows: Uint32s,
    seen: Float32s,
    at: int,
) -> int:
    """Write what a point sees of taps ``first``, ``first + step`` … from index ``at`` on; return the end.

    A row is a cell's number, or ``first_row`` + a row of the split table; the weights are what is left of the
    taps'. There must be room for MOST_SEEN times as many.
    """
    if sight.mode == FACING:
        return _take_facing(sight, point, cells, weights, first, end, step, rows, seen, at)
    return _take_unmixed(sight, cells, weights, first, end, step, rows, seen, at)


@kernel
def see_all(
    sight: Sight,
    starts: Int64s,
    rows: Uint32s,
    weights: Float32s,
    slopes: Float32s,
    seen_starts: Int64s,
    seen_rows: Uint32s,
    seen_weights: Float32s,
    seen_slopes: Float32s,
) -> None:
    """Write what is seen of the taps of points, with what is left of their slopes. See ``take_seen``."""
    at = 0
    seen_starts[0] = 0
    one = np.ones(1, np.float32)
    for point in range(starts.size - 1):
        if slopes.shape[0] == 0:
            first, end = starts[point], starts[point + 1]
            at = take_seen(sight, point, rows, weights, first, end, 1, seen_rows, seen_weights, at)
            seen_starts[point + 1] = at
            continue
        for tap in range(starts[point], starts[point + 1]):
            row = rows[tap : tap + 1]
            end = take_seen(sight, point, row, one, 0, 1, 1, seen_rows, seen_weights, at)
            for seen in range(at, end):
                part = seen_weights[seen]
                seen_weights[seen] = part * weights[tap]
                for axis in range(3):
                    seen_slopes[seen, axis] = part * slopes[tap, axis]
            at = end
        seen_starts[point + 1] = at
