"""What a lookup sees of its taps: what faces it, or what does not mix opposite facings (paper 3.5.2).

A *split* cell has a row of values for each way that the surface in it faces. A lookup that knows its normal
takes the rows that face the normal, and cells that face away weigh nothing. One that does not leaves split
cells with opposite facings, a front and a back, to the next finer level.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.field.blocks import Bytes, Float32s, Int64s, Rows, Uint32s
from octex.jit import decoded, inlined, kernel, popcount
from octex.tree.layout import POSITIVE_FACINGS, SPLIT
from octex.tree.octree import Octree

Uint64s = npt.NDArray[np.uint64]

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
    split: Uint64s  # (⌈cells / 64⌉,)   a bit for each split cell
    before: Uint32s  # (⌈cells / 64⌉,)   the split cells before each word
    rows: Uint32s  # (split cells,)   the first row of each in the split table


class Sight(NamedTuple):
    """What lookups see, and from where; arrays of one row a point, or none."""

    mode: int
    facings: Facings
    first_row: int  # what the first row of the split table is counted as
    normals: Float32s  # (n, 3)   for FACING
    spreads: Float32s  # (split cells,)   for UNMIXED: how far opposite facings differ
    threshold: float  # from what spread on a cell is left out


def facings_of(tree: Octree) -> Facings:
    """Index the split cells of a tree."""
    cells, facings, _ = tree.split
    words = -(-tree.n_cells // 64)
    split, before = np.zeros(words, np.uint64), np.zeros(words, np.uint32)
    rows = np.zeros(cells.size, np.uint32)
    _index(cells, facings, split, before, rows)
    return Facings(tree.arrays.flags, split, before, rows)


def all_in_sight() -> Sight:
    """Return what sees all taps."""
    return _ALL


_ALL = Sight(
    ALL,
    Facings(np.zeros(1, np.uint8), np.zeros(1, np.uint64), np.zeros(1, np.uint32), np.zeros(0, np.uint32)),
    0,
    np.zeros((0, 3), np.float32),
    np.zeros(0, np.float32),
    0.0,
)


@kernel
def _index(cells: Uint32s, facings: Bytes, split: Uint64s, before: Uint32s, rows: Uint32s) -> None:
    row = 0
    for n in range(cells.size):
        cell = np.int64(cells[n])
        if cell >> 6 < split.size:
            split[cell >> 6] |= np.uint64(1) << np.uint64(cell & 63)
        rows[n] = row
        row += popcount(np.uint64(facings[n]))
    count = 0
    for word in range(split.size):
        before[word] = count
        count += popcount(split[word])


@kernel
def spreads_of(table: Float32s, values: Rows, facings: Bytes, first_row: int, spreads: Float32s) -> None:
    """Write how far the decoded values of opposite facings differ, in any component, to ``spreads`` (n,).

    The rows of n consecutive split cells begin at ``first_row`` of ``values`` (rows, components).
    """
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
        spreads[n] = largest
        row += popcount(flags)


@inlined
def _split_number(facings: Facings, cell: int) -> int:
    """Say which of the split cells a cell is, or −1."""
    word = np.uint64(cell >> 6)
    bit = np.uint64(1) << np.uint64(cell & 63)
    if facings.split[word] & bit == np.uint64(0):
        return -1
    number = int(facings.before[word]) + popcount(facings.split[word] & (bit - np.uint64(1)))
    return min(number, facings.rows.size - 1)


@inlined
def _ramp(cosine: np.float32) -> np.float32:
    """Rise from 0 to 1 between no and the full cosine, without a bend."""
    t = min(cosine / _FULL, np.float32(1.0))
    return t * t * (np.float32(3.0) - np.float32(2.0) * t)


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
    square = x * x + y * y + z * z
    scale = np.float32(1.0) / np.sqrt(square) if square > np.float32(0.0) else np.float32(0.0)
    bit_x, bit_y, bit_z = np.uint64(x < 0), np.uint64(2 + (y < 0)), np.uint64(4 + (z < 0))
    x, y, z = abs(x) * scale, abs(y) * scale, abs(z) * scale
    ramp_x, ramp_y, ramp_z = _ramp(x), _ramp(y), _ramp(z)
    one, none = np.uint64(1), np.float32(0.0)
    for tap in range(first, end, step):
        cell, weight = cells[tap], weights[tap]
        if weight == none:
            continue
        flags = np.uint64(facings.flags[cell]) if cell < n_cells else np.uint64(0)
        has_x, has_y, has_z = flags >> bit_x & one, flags >> bit_y & one, flags >> bit_z & one
        part = np.float32(1.0)
        if flags & np.uint64(0b111111) != np.uint64(0):
            part = max(ramp_x if has_x else none, max(ramp_y if has_y else none, ramp_z if has_z else none))
            part += _AWAY
        weight *= part
        number = -1
        if flags & np.uint64(SPLIT) != np.uint64(0) and has_x | has_y | has_z:
            number = _split_number(facings, int(cell))
        if number < 0:
            rows[at], seen[at] = cell, weight
            at += 1
            continue
        a, b, c = (x if has_x else none), (y if has_y else none), (z if has_z else none)
        least = max(a, max(b, c)) - _NEAR
        a, b, c = (
            max(a - least, none) if has_x else none,
            max(b - least, none) if has_y else none,
            max(c - least, none) if has_z else none,
        )
        weight /= a + b + c
        row = sight.first_row + np.int64(facings.rows[number])
        if a > none:
            rows[at], seen[at] = row + popcount(flags & ((one << bit_x) - one)), weight * a
            at += 1
        if b > none:
            rows[at], seen[at] = row + popcount(flags & ((one << bit_y) - one)), weight * b
            at += 1
        if c > none:
            rows[at], seen[at] = row + popcount(flags & ((one << bit_z) - one)), weight * c
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
            number = _split_number(facings, int(cell))
            if number >= 0 and sight.spreads[number] >= sight.threshold:
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
