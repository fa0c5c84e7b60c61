"""Taps: the stored rows that a lookup blends, their weights, and the stages that change these.

*Sources* find each point's taps, by tiles (`sources`) where the leaves have one depth, else by the walk
(`neighborhood`); *sinks* blend the values of any channel under the weights, or list the taps (`sinks`).

Weights are those of the spline, so that those of one point sum to its *cover*, 0 … 1: how much of the
spline's weight falls on leaves. Off the surface, where that is zero, they are those of the coarser averages
that answer there and sum to OFF: beside looks that lie on the surface they count for nothing.

Between source and sink, averages weigh by the roots of their areas. A *split* cell has a row of values for
each way that the surface in it faces (paper 3.5.2): a lookup that knows its normal takes the rows that face
it, and cells that face away weigh nothing (`facings`); one that does not leaves split cells with opposite
facings, a front and a back, to the next finer level. Where a texture has alpha, other channels weigh by it
(`sinks.weigh_by_alpha`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import ChannelValues, Float32s, Float64s, Floats, Int64s, Uint8s, Uint32s
from octex.jit import decoded, inlined, kernel, popcount, prefetch
from octex.tree.areas import AREAS
from octex.tree.layout import FACING_FLAGS, POSITIVE_FACINGS
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


@kernel
def new_taps(points: int, room: int, gradient: bool) -> Taps:
    """Return room for the taps of so many points."""
    return Taps(
        np.empty(room, np.uint32),
        np.empty(room, np.float32),
        np.empty((room if gradient else 0, 3), np.float32),
        np.zeros(points, np.int64),
        np.zeros(points, np.int64),
        np.zeros(points, np.float32),
    )


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
