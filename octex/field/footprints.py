"""Footprints: the area to average over around a point, as probes at coarser levels that add up to it.

A *probe* samples the field over the averages of one level (paper 3.5.1). These averages are means over boxes
of the cells' edge h. The quadratic spline between them makes each probe the surface's mean under a cubic
B-spline of scale h, with variance h²/3. A box of width w has the variance w²/12, so one probe at h = w / 2
stands for it. Several probes, w / k apart with h = w / 2k, approximate the box better. Probes are made at the
two levels with cells next to h in size and blended, so that nothing jumps while a width changes.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Floats, Int32s, Int64s
from octex.field.splines import LINEAR
from octex.jit import inlined, kernel
from octex.tree.layout import MAX_DEPTH

#: Probes made at once: they fit the processor's cache.
_ROOM = 1 << 15
#: By filter: levels by which probes are finer than cells of the footprint's width, for round footprints and,
#: besides those for rows of probes, for long ones. They nearly minimize errors of painted content on a sphere
#: of 20², 64² and 256² pixels.
ROUND_FINER = 0.85, 0.6, 0.85, 1.15
LONG_FINER = 1.0, 0.85, 1.0, 1.2
#: Distance of the probes of a single row, in widths: a fifth fewer than at 1, hardly worse.
_ROW_STEP = 1.15
#: Shorter axes have no direction; longer ones are clamped.
_SHORTEST, _LONGEST = 1e-150, 1e150
#: Longest axis, in root cells.
_ROOTS = 4.0
#: Least and largest widths, in root cells.
_NARROWEST, WIDEST = 0.25**MAX_DEPTH, 4.0**MAX_DEPTH
#: Levels this near to a whole one use that alone: 15 % fewer probes, for 3 % more error, and one probe for
#: widths of 1, 2, 4 … cells.
WHOLE = 0.1501

NO_SLOPES = np.empty((0, 3), np.float32)


class Footprints(NamedTuple):
    """Footprints of n points in the units of rest positions; elongated if there are lengths."""

    widths: Float64s  # (n,)   of the short axis
    lengths: Float64s  # (n,) or (0,)   of the long axis
    along: Float64s  # (n, 3) or (0, 3)   the long axis, of length 1
    across: Float64s  # (n, 3) or (0, 3)   the short axis, of length 1
    sharpness: float  # 0 … 1

    def of(self, points: Int64s) -> Footprints:
        """Select points."""
        widths, lengths, along, across = (array[points] if array.size else array for array in self[:4])
        return Footprints(widths, lengths, along, across, self.sharpness)


class Probes(NamedTuple):
    """Probes at one level."""

    points: Floats  # (m, 3)
    owners: Int32s  # (m,)   the point of each
    shares: Float32s  # (m,)   1 in sum for each owner, over all levels
    slopes: Float32s = NO_SLOPES  # (m, 3) or (0, 3)   derivatives of the shares in texture space

    def of(self, rows: Int64s | slice) -> Probes:
        """Select rows."""
        slopes = self.slopes[rows] if self.slopes.size else self.slopes
        return Probes(self.points[rows], self.owners[rows], self.shares[rows], slopes)


#: Shared fields of all footprints that are as wide as long.
ROUND = Footprints(np.empty(0), np.empty(0), np.empty((0, 3)), np.empty((0, 3)), 0.0)


@kernel
def long_footprints(
    dPdx: Floats, dPdy: Floats, blur: float, anisotropy: float, sharpness: float
) -> Footprints:
    """Return the footprints of pixels from derivatives of positions by pixel (n, 3).

    A pixel is a parallelogram on the surface; its footprint has the same mean and variances. The short axis
    is at least the long one divided by ``anisotropy``.
    """
    n_points = dPdx.shape[0]
    widths, lengths = np.empty(n_points, np.float64), np.empty(n_points, np.float64)
    along, across = np.empty((n_points, 3), np.float64), np.empty((n_points, 3), np.float64)
    for n in range(widths.size):
        scale = 0.0
        for axis in range(3):
            scale = max(scale, max(abs(np.float64(dPdx[n, axis])), abs(np.float64(dPdy[n, axis]))))
        scale = max(scale, _SHORTEST)
        a = b = c = 0.0
        for axis in range(3):
            x, y = np.float64(dPdx[n, axis]) / scale, np.float64(dPdy[n, axis]) / scale
            a, b, c = a + x * x, b + x * y, c + y * y
        # Eigenvalues and the eigenvector of the larger one, of [[a, b], [b, c]].
        root = np.sqrt((a - c) * (a - c) + 4.0 * b * b)
        larger, smaller = 0.5 * (a + c + root), max(0.5 * (a + c - root), 0.0)
        p, q = (0.5 * (a - c + root), b) if a >= c else (b, 0.5 * (c - a + root))
        norm = np.sqrt(p * p + q * q)
        p, q = (p / norm, q / norm) if norm > 0.0 else (1.0, 0.0)
        length, width = np.sqrt(larger), np.sqrt(smaller)
        for axis in range(3):
            x, y = np.float64(dPdx[n, axis]) / scale, np.float64(dPdy[n, axis]) / scale
            along[n, axis] = (p * x + q * y) / length if length > 0.0 else 0.0
            across[n, axis] = (p * y - q * x) / width if width > 0.0 else 0.0
        lengths[n] = min(length * scale, _LONGEST) + blur
        widths[n] = max(min(width * scale, _LONGEST) + blur, lengths[n] / anisotropy)
    return Footprints(widths, lengths, along, across, sharpness)


@kernel
def passed_on(
    probes: Probes, passed: Float32s, passed_slopes: Float32s, least: np.float32, more: Probes
) -> Probes:
    """Return ``more`` probes, and probes whose ``passed`` part (m,) exceeds ``least``, with that share.

    ``passed_slopes`` are the derivatives of ``passed``, where probes have slopes. A probe of the same owner
    at the same point takes the share instead. Owners ascend in all arguments and in the result.
    """
    gradient = probes.slopes.shape[0] > 0
    count = n_more = more.shares.size
    for n in range(passed.size):
        count += passed[n] > least
    points, owners = np.empty((count, 3), probes.points.dtype), np.empty(count, np.int32)
    shares, slopes = np.empty(count, np.float32), np.zeros((count if gradient else 0, 3), np.float32)
    at = m = 0
    for n in range(passed.size + 1):
        is_last = n == passed.size
        if not is_last and not passed[n] > least:
            continue
        while m < n_more and (is_last or more.owners[m] < probes.owners[n]):
            for axis in range(3 if gradient else 0):
                slopes[at, axis] = more.slopes[m, axis]
            at = _write_probe(more, m, more.shares[m], points, owners, shares, at)
            m += 1
        if is_last:
            break
        share, same = probes.shares[n] * passed[n], m
        while same < n_more and more.owners[same] == probes.owners[n] and not _is_same(more, same, probes, n):
            same += 1
        is_there = same < n_more and more.owners[same] == probes.owners[n]
        for axis in range(3 if gradient else 0):
            slope = probes.slopes[n, axis] * passed[n] + probes.shares[n] * passed_slopes[n, axis]
            if is_there:
                more.slopes[same, axis] += slope
            else:
                slopes[at, axis] = slope
        if is_there:
            more.shares[same] += share
        else:
            at = _write_probe(probes, n, share, points, owners, shares, at)
    return Probes(points[:at], owners[:at], shares[:at], slopes[:at])


@inlined
def _is_same(probes: Probes, n: int, others: Probes, m: int) -> bool:
    """Return whether two probes are at the same point."""
    a, b = probes.points, others.points
    return bool((a[n, 0] == b[m, 0]) & (a[n, 1] == b[m, 1]) & (a[n, 2] == b[m, 2]))


@inlined
def _write_probe(
    probes: Probes, n: int, share: np.float32, points: Floats, owners: Int32s, shares: Float32s, at: int
) -> int:
    """Write a probe with a share; return the end of the list."""
    for axis in range(3):
        points[at, axis] = probes.points[n, axis]
    owners[at], shares[at] = probes.owners[n], share
    return at + 1


@inlined
def level_of(width: float, size: float, depth: int, finer: float) -> np.float32:
    """Return the level, 0 … depth and between, for probes of a width."""
    width = min(max(width, size * _NARROWEST), size * WIDEST)
    level = np.log2(np.float32(size / width)) + np.float32(finer)
    whole = np.floor(level)
    part = (level - whole - np.float32(WHOLE)) / np.float32(1.0 - 2.0 * WHOLE)
    level = whole + min(max(part, np.float32(0.0)), np.float32(1.0))
    return min(max(level, np.float32(0.0)), np.float32(depth))


@kernel
def _levels_of(widths: Float64s, size: float, depth: int, finer: float) -> Float32s:
    levels = np.empty(widths.size, np.float32)
    for n in range(widths.size):
        levels[n] = level_of(widths[n], size, depth, finer)
    return levels


@kernel
def _level_shares(level: np.float32, depth: int, sharpness: float) -> tuple[int, float, float, float]:
    """Return the coarser of two levels, and the shares of the level before it, of it and of the next.

    Sharpening subtracts part of the next coarser levels, up to a variance of 0 for ``sharpness`` 1. Leaves
    are not sharpened.
    """
    lower = min(int(level), depth)
    upper = float(level) - lower
    excess = sharpness / 3.0 * min(depth - float(level), 1.0)
    before, at_lower = -excess * (1.0 - upper), 1.0 + excess - upper * (1.0 + 2.0 * excess)
    if lower == 0:
        before, at_lower = 0.0, at_lower + before
    return lower, before, at_lower, upper * (1.0 + excess)


@inlined
def _lay(width: float, length: float, rows: int, least: float) -> tuple[float, float, float]:
    """Lay probes out over a long footprint: return their distance, and the reach along and across.

    They reach to both sides, along in steps of one distance; two rows lie across. The variances are then the
    footprint's, less the probes' width. Distances are at least ``least``, a leaf's edge.
    """
    distance = max(width * (0.5 if rows > 1 else _ROW_STEP), least)
    if not distance > 0.0:
        return 0.0, 0.0, 0.0
    steps = length / distance
    along = 0.5 * np.sqrt(max(steps * steps - 2.0, 0.0))
    across = np.sqrt(max(width * width - distance * distance, 0.0) / 12.0) if rows > 1 else 0.0
    return distance, float(along), float(across)


@inlined
def _steps(along: float) -> int:
    """Return the number of probes to each side of the middle."""
    return int(np.ceil(max(along - 0.5, 0.0)))


@kernel
def _count(
    shape: Footprints,
    levels: Float32s,
    first: int,
    depth: int,
    rows: int,
    least: float,
    counts: Int64s,
) -> int:
    """Count probes by level (depth + 1,) from point ``first`` on, while they fit; return the end."""
    total = 0
    probes = 1
    for n in range(first, levels.size):
        if rows > 0:
            _, along, across = _lay(shape.widths[n], shape.lengths[n], rows, least)
            probes = (2 * _steps(along) + 1) * (2 if across > 0.0 else 1)
        total += probes
        if total > _ROOM and n > first:
            return n
        lower, before, at_lower, after = _level_shares(levels[n], depth, shape.sharpness)
        counts[max(lower - 1, 0)] += probes * (before != 0.0)
        counts[lower] += probes * (at_lower != 0.0)
        counts[min(lower + 1, depth)] += probes * (after != 0.0)
    return levels.size


@inlined
def _put_probe(
    ends: Int64s,
    level: int,
    share: float,
    x: float,
    y: float,
    z: float,
    owner: int,
    coords: Floats,
    owners: Int32s,
    shares: Float32s,
) -> None:
    """Write a probe unless its share is 0."""
    if share != 0.0:
        at = ends[level]
        coords[at, 0], coords[at, 1], coords[at, 2] = x, y, z
        owners[at], shares[at] = owner, share
        ends[level] = at + 1


@kernel
def _write_probes(
    points: Floats,
    shape: Footprints,
    levels: Float32s,
    first: int,
    end: int,
    depth: int,
    rows: int,
    least: float,
    ends: Int64s,
    coords: Floats,
    owners: Int32s,
    shares: Float32s,
) -> None:
    """Write the probes of points ``first`` … ``end`` − 1, each level's from its ``ends`` on."""
    for n in range(first, end):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        lower, before, at_lower, after = _level_shares(levels[n], depth, shape.sharpness)
        target = n - first, coords, owners, shares
        if rows == 0:
            _put_probe(ends, lower - 1, before, x, y, z, *target)
            _put_probe(ends, lower, at_lower, x, y, z, *target)
            _put_probe(ends, lower + 1, after, x, y, z, *target)
            continue
        distance, along, across = _lay(shape.widths[n], shape.lengths[n], rows, least)
        steps = _steps(along)
        n_rows = 2 if across > 0.0 else 1
        for step in range(-steps, steps + 1):
            part = 1.0 / n_rows
            if along > 0.5:
                part *= (min(step + 0.5, along) - max(step - 0.5, -along)) / (2.0 * along)
            for row in range(n_rows):
                a, b = step * distance, (2 * row - 1) * across
                u = x + a * shape.along[n, 0] + b * shape.across[n, 0]
                v = y + a * shape.along[n, 1] + b * shape.across[n, 1]
                w = z + a * shape.along[n, 2] + b * shape.across[n, 2]
                _put_probe(ends, lower - 1, part * before, u, v, w, *target)
                _put_probe(ends, lower, part * at_lower, u, v, w, *target)
                _put_probe(ends, lower + 1, part * after, u, v, w, *target)


def spread(
    points: Floats, shape: Footprints, size: float, depth: int, filter_code: int
) -> Iterator[tuple[slice, dict[int, Probes]]]:
    """Yield runs of points and their probes by level, about ``_ROOM`` at a time.

    ``size`` is the root cell's edge. Owners count from the first point of the run.
    """
    rows = 0 if not shape.lengths.size else 1 if filter_code <= LINEAR else 2
    finer = LONG_FINER[filter_code] + np.log2(rows) if rows else ROUND_FINER[filter_code]
    levels = _levels_of(shape.widths, size, depth, finer)
    shape = shape._replace(
        widths=np.minimum(shape.widths, _ROOTS * size), lengths=np.minimum(shape.lengths, _ROOTS * size)
    )
    least = size / 2**depth
    first = 0
    while first < len(points):
        counts = np.zeros(depth + 1, np.int64)
        end = _count(shape, levels, first, depth, rows, least, counts)
        starts = np.concatenate([[0], np.cumsum(counts)])
        coords, owners = np.empty((starts[-1], 3), points.dtype), np.empty(starts[-1], np.int32)
        shares = np.empty(starts[-1], np.float32)
        ends = starts[:-1].copy()
        _write_probes(points, shape, levels, first, end, depth, rows, least, ends, coords, owners, shares)
        probes = {}
        for level in np.flatnonzero(counts).tolist():
            at = slice(starts[level], starts[level + 1])
            probes[level] = Probes(coords[at], owners[at], shares[at])
        yield slice(first, end), probes
        first = end
