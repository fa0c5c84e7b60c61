"""Taps: the stored rows that a lookup blends, and their weights.

A lookup of many points goes through three kinds of kernels, a block of points at a time:

    sources   find each point's taps: from tiles (`cells_at`, `spline`) where the leaves have one depth, else
              by the walk (`neighborhood`)
    stages    change the weights: by the areas of averages, by what faces a normal, by alpha (`stages`)
    sinks     blend the values of any channel under the weights, or list the taps (`sinks`)

Weights are those of the spline, so that those of one point sum to its *cover*, 0 … 1: how much of the
spline's weight falls on leaves. Off the surface, where that is zero, they are those of the coarser averages
that answer there and sum to OFF: beside looks that lie on the surface they count for nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Floats, Int64s, Uint8s, Uint32s
from octex.jit import inlined, kernel, prefetch

#: Points whose taps are found before any is blended: enough that calls cost little, few enough that their
#: taps stay in the processor's second cache.
BLOCK = 4096
#: Most taps of a point that tiles give, by filter.
MOST_TILED = 1, 8, 27, 125
#: What weights off the surface sum to.
OFF = np.float32(1e-9)
#: Taps that weigh less in sum lie at the rim of the spline's support, where products of single precision have
#: lost their digits: the walk answers there.
LEAST = np.float32(1e-24)


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
        for tap in range(start, end):
            scale(taps, tap, OFF / total)
    return end, n_empty, n_rim


@kernel
def place_points(points: Floats, origin: tuple[float, float, float], size: float, places: Float64s) -> int:
    """Write where rest positions (n, 3) lie in texture space, clamped to 0 … 1.

    Returns the first position that is not finite, or −1.
    """
    inverse = 1.0 / size
    faults = 0
    for n in range(points.shape[0]):
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        faults |= int(not ((abs(x) < np.inf) & (abs(y) < np.inf) & (abs(z) < np.inf)))
        places[n, 0] = min(max(0.0, (x - origin[0]) * inverse), 1.0)
        places[n, 1] = min(max(0.0, (y - origin[1]) * inverse), 1.0)
        places[n, 2] = min(max(0.0, (z - origin[2]) * inverse), 1.0)
    if faults == 0:
        return -1
    for n in range(points.shape[0]):
        for axis in range(3):
            if not abs(np.float64(points[n, axis])) < np.inf:
                return n
    return -1
