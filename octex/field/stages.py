"""Stages: what changes the weights of taps between their source and the sinks.

Averages weigh by the roots of their areas. A *split* cell has a row of values for each way that the surface
in it faces (paper 3.5.2): a lookup that knows its normal takes the rows that face the normal, and cells that
face away weigh nothing; one that does not leaves split cells with opposite facings, a front and a back, to
the next finer level. Where a texture has alpha, other channels weigh by it (`sinks.cover`).
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from octex.field.taps import OFF, Bytes, Float32s, Taps, Uint32s
from octex.jit import decoded, inlined, kernel, popcount, prefetch
from octex.tree.layout import AREA_ONE, AREA_STEPS, FACING_FLAGS, POSITIVE_FACINGS, SPLIT
from octex.tree.octree import Octree

Rows = npt.NDArray[np.uint8 | np.uint16 | np.float32]
Table = npt.NDArray[np.float32 | np.float64]

#: What averages weigh by the codes of their cells' areas: the root of the area, in cell faces; 1 if that is
#: not known. By the area itself, cells that the surface hardly touches count for as little as they hold, but
#: what is then looked at is more ragged: half way from equal weights, painted content was nearest to the
#: truth.
AREA_WEIGHTS = (2.0 ** ((np.arange(256) - AREA_ONE) / AREA_STEPS / 2)).astype(np.float32)
AREA_WEIGHTS[0] = 1.0

#: Cosine between the normal and one of a cell's facings from which on the cell counts in full. A surface is
#: flagged with the axis nearest to its normal, so that they are never more than 54.7° apart (cosine 0.577):
#: what belongs to the surface looked at is never weakened.
_FULL = np.float32(0.5)
#: Difference of cosines, to the facing nearest to the normal, within which others of a split cell count too.
_NEAR = np.float32(0.2)
#: Weight of what faces away: decides only where nothing else is there, as behind double-sided materials.
_AWAY = np.float32(1e-6)

#: Most taps that stand for one: a facing of each axis.
MOST_ROWS = 3

#: Points whose flags are asked for before any is read.
_GROUP = 64


class Facings(NamedTuple):
    """Which ways the cells of a tree face, and where the rows of its split cells are."""

    flags: Bytes  # (cells,)
    rows: Uint32s  # (cells,)   a split cell's first row in the split table; or (0,) if that is empty
    kept: Uint32s  # (kept nodes,)   the cells whose coefficients are kept: they face as these do


def facings_of(tree: Octree) -> Facings:
    """Index the split cells of a tree.

    Only where they are is the index written to: the rest of it takes no memory.
    """
    cells, facings, areas = tree.split
    rows = np.zeros(tree.n_cells if areas.size else 0, np.uint32)
    _index(cells, facings, rows)
    return Facings(tree.arrays.flags, rows, tree.kept.cells)


@kernel
def _index(cells: Uint32s, facings: Bytes, rows: Uint32s) -> None:
    row = 0
    for n in range(cells.size):
        if np.int64(cells[n]) < rows.size:
            rows[cells[n]] = row
        row += popcount(np.uint64(facings[n] & np.uint8(FACING_FLAGS)))


@kernel
def spreads_of(table: Table, values: Rows, facings: Bytes, first_row: int, spreads: Float32s) -> None:
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
def weigh_by_area(taps: Taps, areas: Bytes) -> None:
    """Multiply the weights of cells by what their areas weigh; off the surface they still sum to OFF."""
    gradient = taps.slopes.shape[0] > 0
    for begin in range(0, taps.starts.size, _GROUP):
        end = min(begin + _GROUP, taps.starts.size)
        for n in range(begin, end):
            for tap in range(taps.starts[n], taps.ends[n], 4):  # the others mostly lie beside these
                prefetch(areas, int(taps.rows[tap]))
        for n in range(begin, end):
            total = np.float32(0.0)
            for tap in range(taps.starts[n], taps.ends[n]):
                row = taps.rows[tap]
                if row < areas.size:
                    factor = AREA_WEIGHTS[areas[row]]
                    taps.weights[tap] *= factor
                    if gradient:
                        for axis in range(3):
                            taps.slopes[tap, axis] *= factor
                total += taps.weights[tap]
            if taps.covers[n] == np.float32(0.0) and total > np.float32(0.0):
                for tap in range(taps.starts[n], taps.ends[n]):
                    taps.weights[tap] *= OFF / total
                    if gradient:
                        for axis in range(3):
                            taps.slopes[tap, axis] *= OFF / total


@kernel
def leave_mixed(taps: Taps, facings: Facings, spreads: Float32s, threshold: float, left: Float32s) -> None:
    """Let cells whose opposite facings differ by ``threshold`` or more weigh nothing.

    ``spreads`` (rows,) say how far they differ, at each split cell's first row. Writes to ``left`` (points,)
    the part of the weight that is taken away.
    """
    gradient = taps.slopes.shape[0] > 0
    n_cells = np.uint32(facings.flags.size)
    for n in range(taps.starts.size):
        total = gone = np.float32(0.0)
        for tap in range(taps.starts[n], taps.ends[n]):
            cell = taps.rows[tap]
            weight = taps.weights[tap]
            total += weight
            flags = facings.flags[cell] if cell < n_cells else np.uint8(0)
            if flags & np.uint8(SPLIT) == 0:
                continue
            if flags & (flags >> np.uint8(1)) & np.uint8(POSITIVE_FACINGS) == 0 or facings.rows.size == 0:
                continue
            row = min(int(facings.rows[cell]), spreads.size - 1)
            if row >= 0 and spreads[row] >= threshold:
                gone += weight
                taps.weights[tap] = np.float32(0.0)
                if gradient:
                    taps.slopes[tap, 0] = taps.slopes[tap, 1] = taps.slopes[tap, 2] = np.float32(0.0)
        left[n] = gone / total if total > np.float32(0.0) else np.float32(0.0)


def _directions() -> Bytes:
    """Say which of the three facings that can see a normal a cell has, by the normal's signs and the flags.

    [signs · 64 + flags]: a bit for each axis; 8 for a cell without facings.
    """
    table = np.zeros((8, 64), np.uint8)
    for signs in range(8):
        for flags in range(64):
            bits = [flags >> (2 * axis + (signs >> axis & 1)) & 1 for axis in range(3)]
            table[signs, flags] = bits[0] | bits[1] << 1 | bits[2] << 2 if flags else 8
    return table.reshape(-1)


_DIRECTIONS = _directions()


@inlined
def _ramp(cosine: np.float32) -> np.float32:
    """Rise from 0 to 1 between no and the full cosine, without a bend."""
    t = min(cosine / _FULL, np.float32(1.0))
    return t * t * (np.float32(3.0) - np.float32(2.0) * t)


@inlined
def _unit(normals: Float32s, n: int) -> tuple[np.float32, np.float32, np.float32, int]:
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
def _flags_of(facings: Facings, first_kept: int, row: np.uint32) -> tuple[np.uint8, int]:
    """Return the flags of a tap's cell, and that; a kept coefficient's cell is the node that keeps it."""
    cell = np.int64(row)
    if cell >= facings.flags.size:
        if facings.kept.size == 0 or cell < first_kept:
            return np.uint8(0), -1
        cell = np.int64(facings.kept[min(int(cell) - first_kept, facings.kept.size - 1)])
    return facings.flags[cell], int(cell)


@kernel
def face(taps: Taps, facings: Facings, first_kept: int, normals: Float32s) -> int:
    """Let what faces away from the normals (points, 3) weigh next to nothing.

    ``first_kept`` is what the first kept coefficient is counted as. Returns how many taps are of split cells
    that have rows facing the normal: see ``take_rows``.
    """
    gradient = taps.slopes.shape[0] > 0
    parts = np.empty(9, np.float32)
    parts[8] = np.float32(1.0) + _AWAY
    has_rows = facings.rows.size > 0
    n_split = 0
    for begin in range(0, taps.starts.size, _GROUP):
        end = min(begin + _GROUP, taps.starts.size)
        for n in range(begin, end):
            for tap in range(taps.starts[n], taps.ends[n], 4):  # the others mostly lie beside these
                prefetch(facings.flags, int(taps.rows[tap]))
                if has_rows:
                    prefetch(facings.rows, int(taps.rows[tap]))  # read by `take_rows`
        for n in range(begin, end):
            x, y, z, signs = _unit(normals, n)
            ramps = _ramp(x), _ramp(y), _ramp(z)
            parts[0] = _AWAY
            for bits in range(1, 8):
                part = np.float32(0.0)
                for axis in range(3):
                    part = max(part, ramps[axis]) if bits >> axis & 1 else part
                parts[bits] = part + _AWAY
            for tap in range(taps.starts[n], taps.ends[n]):
                flags, _ = _flags_of(facings, first_kept, taps.rows[tap])
                bits = _DIRECTIONS[64 * signs + int(flags & np.uint8(FACING_FLAGS))]
                part = parts[bits]
                taps.weights[tap] *= part
                if gradient:
                    for axis in range(3):
                        taps.slopes[tap, axis] *= part
                n_split += has_rows & (flags & np.uint8(SPLIT) != 0) & (bits > 0) & (bits < 8)
    return n_split


@inlined
def _shares(x: np.float32, y: np.float32, z: np.float32) -> tuple[np.float32, np.float32, np.float32]:
    """Share a split cell out among its rows, by the cosines of those that face the normal; 0 for no row."""
    none = np.float32(0.0)
    least = max(x, max(y, z)) - _NEAR
    x = max(x - least, none) if x > none else none
    y = max(y - least, none) if y > none else none
    z = max(z - least, none) if z > none else none
    total = x + y + z
    if total > max(x, max(y, z)):
        return x / total, y / total, z / total
    one = np.float32(1.0)  # one alone
    return one if x > none else none, one if y > none else none, one if z > none else none


@kernel
def take_rows(
    taps: Taps, facings: Facings, first_kept: int, first_row: int, normals: Float32s, result: Taps
) -> None:
    """Write taps anew, those of split cells as the rows that face the normals: after ``face``.

    ``first_row`` is what the first row of the split table is counted as. ``result`` must have room for two
    taps more for each that is of a split cell.
    """
    gradient = taps.slopes.shape[0] > 0
    none, one = np.float32(0.0), np.uint64(1)
    at = 0
    for n in range(taps.starts.size):
        x, y, z, signs = _unit(normals, n)
        start = at
        for tap in range(taps.starts[n], taps.ends[n]):
            flags, cell = _flags_of(facings, first_kept, taps.rows[tap])
            bits = _DIRECTIONS[64 * signs + int(flags & np.uint8(FACING_FLAGS))]
            a, b, c = (
                x if bits & np.uint8(1) else none,
                y if bits & np.uint8(2) else none,
                z if bits & np.uint8(4) else none,
            )
            is_split = facings.rows.size > 0 and flags & np.uint8(SPLIT) != 0 and bits < np.uint8(8)
            if not is_split or _ramp(max(a, max(b, c))) == none:
                result.rows[at], result.weights[at] = taps.rows[tap], taps.weights[tap]
                if gradient:
                    for axis in range(3):
                        result.slopes[at, axis] = taps.slopes[tap, axis]
                at += 1
                continue
            shares = _shares(a, b, c)
            row = first_row + np.int64(facings.rows[cell])
            for axis in range(3):
                if shares[axis] > none:
                    bit = np.uint64(2 * axis + (signs >> axis & 1))
                    result.rows[at] = row + popcount(np.uint64(flags) & ((one << bit) - one))
                    result.weights[at] = shares[axis] * taps.weights[tap]
                    if gradient:
                        for each in range(3):
                            result.slopes[at, each] = shares[axis] * taps.slopes[tap, each]
                    at += 1
        result.starts[n], result.ends[n], result.covers[n] = start, at, taps.covers[n]


#: The sizes of a normal's cosines with the axes, and their signs as bits.
View: TypeAlias = tuple[np.float32, np.float32, np.float32, int]


@inlined
def view_of(normals: Float32s, n: int) -> View:
    """Return how ``face_cell`` takes normal ``n`` of some (m, 3)."""
    return _unit(normals, n)


@inlined
def face_cell(flags: np.uint8, view: View) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return what ``face`` multiplies the weight of a cell by, and what ``take_rows`` gives its rows.

    These are the shares of the rows of x, y and z that face the normal; all 0 where the cell has none, or is
    taken as a whole.
    """
    x, y, z, signs = view
    none = np.float32(0.0)
    bits = _DIRECTIONS[64 * signs + int(flags & np.uint8(FACING_FLAGS))]
    if bits >= np.uint8(8):
        return np.float32(1.0) + _AWAY, none, none, none
    x = x if bits & np.uint8(1) else none
    y = y if bits & np.uint8(2) else none
    z = z if bits & np.uint8(4) else none
    part = _ramp(max(x, max(y, z)))
    if flags & np.uint8(SPLIT) == 0 or part == none:
        return part + _AWAY, none, none, none
    a, b, c = _shares(x, y, z)
    return part + _AWAY, a, b, c
