"""Taps: the stored rows that a lookup blends, their weights, and their decoded values.

Tiles (`tile_taps`) find them where all leaves have one depth, else the walk (`walk_taps`). Then they are
weighted (`weights`), and blended or listed (`blend`).

Weights are those of the spline. The weights of a point sum to its *cover*, 0 … 1: the part of the spline's
weight on leaves. Off the surface, with cover zero, taps are coarser averages and their weights sum to OFF:
next to probes on the surface they are negligible.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import ChannelValues, Float32s, Float64s, Floats, Int64s, Uint8s, Uint32s
from octex.jit import by_constants, decoded, inlined, kernel, part, prefetch
from octex.tree.search import Origin, Positions, placed, position

#: Points whose taps are found before any is blended: calls cost little, and taps fit the second cache.
BLOCK = 4096
#: Points whose rows are prefetched before any is read.
AT_ONCE = 64
#: Most taps of a point that tiles give, by filter.
MOST_TILED = 1, 8, 27, 125
#: Sum of the weights off the surface.
OFF = np.float32(1e-9)
#: Smaller sums lie at the rim of the spline's support, where products of single precision have lost their
#: digits: the walk answers there.
LEAST = np.float32(1e-24)


class Ahead(NamedTuple):
    """The arrays of cells to prefetch; empty ones are not read."""

    values: Uint8s  # (cells, bytes)
    alpha: Uint8s  # (cells, bytes) or (0, bytes)
    flags: Uint8s  # (cells,) or (0,)
    areas: Uint8s  # (cells,) or (0,)


@inlined
def prefetch_cell(ahead: Ahead, cell: int) -> None:
    """Prefetch a cell, and the cells next to it."""
    prefetch(ahead.values, cell)
    if ahead.alpha.shape[0] > 0:
        prefetch(ahead.alpha, cell)
    if ahead.flags.size > 0:
        prefetch(ahead.flags, cell)
    if ahead.areas.size > 0:
        prefetch(ahead.areas, cell)


class Batch(NamedTuple):
    """Points whose taps tiles look for, and lists of those without an answer."""

    coords: Float64s  # (n, 3)   in texture space
    which: Int64s  # (n,)   the points' numbers among the taps
    last: int  # the largest number of a cell
    empty: Int64s  # (n,)   output: points without any cell around them
    rim: Int64s  # (n,)   output: points for the walk, with too small weights, or near other levels
    ahead: Ahead


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


class TapList(NamedTuple):
    """The taps of points in compressed sparse rows: a point's value is Σ weights · values over its taps.

    Rows are numbered as those of `Taps`.
    """

    starts: Int64s  # (n + 1,)   a point's taps are those from its start to the next one's
    rows: Uint32s | Int64s  # (taps,)   none twice for a point
    weights: Float32s  # (taps,)   1 in sum for each point


@kernel
def new_taps(points: int, room: int, gradient: bool) -> Taps:
    """Return room for the taps of points."""
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
def finish(
    batch: Batch, n: int, taps: Taps, start: int, end: int, total: np.float32, n_empty: int, n_rim: int
) -> tuple[int, int, int]:
    """Write the range of a point's taps, or list the point if it has none or too small ones."""
    point = batch.which[np.uint64(n)]
    at = np.uint64(point)
    if not total >= LEAST:
        taps.starts[at] = taps.ends[at] = start
        if end == start:
            batch.empty[np.uint64(n_empty)] = point
            return end, n_empty + 1, n_rim
        batch.rim[np.uint64(n_rim)] = point
        return start, n_empty, n_rim + 1
    taps.starts[at], taps.ends[at] = start, end
    taps.covers[at] = total
    return end, n_empty, n_rim


@inlined
def scale_to_off(
    taps: Taps, start: int, end: int, total: np.float32, x: np.float32, y: np.float32, z: np.float32
) -> None:
    """Scale a point's taps to the sum OFF, and make slopes sum to 0; total, x, y, z are the sums so far."""
    factor = OFF / total
    x, y, z = x / total, y / total, z / total
    for tap in range(start, end):
        at = np.uint64(tap)
        if taps.slopes.shape[0] > 0:
            taps.slopes[at, 0] = (taps.slopes[at, 0] - taps.weights[at] * x) * factor
            taps.slopes[at, 1] = (taps.slopes[at, 1] - taps.weights[at] * y) * factor
            taps.slopes[at, 2] = (taps.slopes[at, 2] - taps.weights[at] * z) * factor
        taps.weights[at] *= factor


@inlined
def scale_off(taps: Taps, which: Int64s) -> None:
    """Scale the taps of points off the surface, whose covers are their weights, to the sum OFF."""
    for n in which:
        start, end, total = int(taps.starts[n]), int(taps.ends[n]), taps.covers[n]
        if start == end:
            continue
        x = y = z = np.float32(0.0)
        for tap in range(start, end if taps.slopes.shape[0] > 0 else start):
            x, y, z = x + taps.slopes[tap, 0], y + taps.slopes[tap, 1], z + taps.slopes[tap, 2]
        scale_to_off(taps, start, end, total, x, y, z)
        taps.covers[n] = np.float32(0.0)


@kernel
def clear_outside_slopes(taps: Taps, coords: Float64s) -> None:
    """Zero the slopes of points outside the root cell, along the axes that ``coords`` (n, 3) clamp."""
    for n in range(coords.shape[0]):
        for axis in range(3):
            if 0.0 < coords[n, axis] < 1.0:
                continue
            for tap in range(taps.starts[n], taps.ends[n]):
                taps.slopes[tap, axis] = 0.0


@inlined
def _to_coordinates(rows: Floats, origin: Origin, inverse: float, coords: Float64s) -> bool:
    """Write the coordinates of rows (n, 3); return whether any row is not finite."""
    faults = 0
    for n in range(rows.shape[0]):
        x, y, z = np.float64(rows[n, 0]), np.float64(rows[n, 1]), np.float64(rows[n, 2])
        faults |= int(not ((abs(x) < np.inf) & (abs(y) < np.inf) & (abs(z) < np.inf)))
        x, y, z = placed(x, y, z, origin, inverse)
        coords[n, 0] = min(max(0.0, x), 1.0)
        coords[n, 1] = min(max(0.0, y), 1.0)
        coords[n, 2] = min(max(0.0, z), 1.0)
    return faults != 0


@kernel
def to_coordinates(points: Positions, origin: Origin, size: float, coords: Float64s) -> int:
    """Write points in texture space (n, 3), clamped to 0 … 1; return the first one not finite, or −1."""
    if points.singles.shape[0] > 0:
        is_faulty = _to_coordinates(points.singles, origin, 1.0 / size, coords)
    else:
        is_faulty = _to_coordinates(points.doubles, origin, 1.0 / size, coords)
    if not is_faulty:
        return -1
    for n in range(coords.shape[0]):
        x, y, z = position(points, n)
        if not ((abs(x) < np.inf) & (abs(y) < np.inf) & (abs(z) < np.inf)):
            return n
    return -1


Four = tuple[float, float, float, float]
#: Four components under weights, and the sum of the weights.
Five = tuple[float, float, float, float, float]
NO_FIVE = 0.0, 0.0, 0.0, 0.0, 0.0


class Codes(NamedTuple):
    """A channel as stored, and the decoding table of its codes."""

    values: ChannelValues  # (cells, components)
    kept_values: ChannelValues  # (kept nodes, components)
    split_values: ChannelValues  # (split rows, components)
    #: (codes,)   the decoded values, float64 for 8 bits, which saves an instruction each; empty for float32
    table: Floats


class Flat(NamedTuple):
    """`Codes` as kernels read them."""

    values: ChannelValues
    kept: ChannelValues
    split: ChannelValues
    table: Floats
    first_kept: int
    first_row: int


@part
def flat_of(codes: Codes) -> Flat:
    """Flatten the values."""
    n_cells = codes.values.shape[0]
    return Flat(
        codes.values.reshape(-1),
        codes.kept_values.reshape(-1),
        codes.split_values.reshape(-1),
        codes.table,
        n_cells,
        n_cells + codes.kept_values.shape[0],
    )


@by_constants
@inlined
def value_at(values: ChannelValues, table: Floats, at: np.uint64, components: int) -> Four:
    """Return the decoded components at an index of flat values, padded with zeros."""
    a = np.float64(decoded(table, values[at]))
    b = c = d = 0.0
    if components > 1:
        b = np.float64(decoded(table, values[at + np.uint64(1)]))
    if components > 2:
        c = np.float64(decoded(table, values[at + np.uint64(2)]))
    if components > 3:
        d = np.float64(decoded(table, values[at + np.uint64(3)]))
    return a, b, c, d


@inlined
def put_value(results: Float32s, at: int, components: int, a: float, b: float, c: float, d: float) -> None:
    """Write components to flat results."""
    results[np.uint64(at)] = a
    if components > 1:
        results[np.uint64(at + 1)] = b
    if components > 2:
        results[np.uint64(at + 2)] = c
    if components > 3:
        results[np.uint64(at + 3)] = d


@by_constants
@inlined
def value_of(flat: Flat, row: int, components: int) -> Four:
    """Return the decoded components of a row, by branches, as most rows are cells."""
    if row < flat.first_kept:
        return value_at(flat.values, flat.table, np.uint64(row * components), components)
    if row < flat.first_row:
        return value_at(flat.kept, flat.table, np.uint64((row - flat.first_kept) * components), components)
    row = min(row - flat.first_row, flat.split.size // components - 1)
    return value_at(flat.split, flat.table, np.uint64(row * components), components)


@by_constants
@inlined
def with_row(five: Five, flat: Flat, row: int, weight: np.float32, components: int) -> Five:
    """Add a row times a weight to four components, and the weight to the fifth."""
    factor = np.float64(weight)
    a, b, c, d = value_of(flat, row, components)
    return (
        five[0] + factor * a,
        five[1] + factor * b,
        five[2] + factor * c,
        five[3] + factor * d,
        five[4] + factor,
    )
