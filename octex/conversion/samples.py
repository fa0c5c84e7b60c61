"""Points of the surface with the source's values, for fitting leaves and measuring errors.

A finest cell gives points for each facing of the surface in it: the centroid of the largest fragment of that
facing, and the centroid of its other fragments, with their mean. So the samples' mean is the cell's mean.
More samples are not worth their time where cells are small (0.3 dB for eight, in trials). Fewer miss folds in
a cell of many texels (0.8 dB).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Bools, Float32s, Float64s, Int8s, Int32s, Int64s, Uint8s, Uint16s, in_runs
from octex.channels import LEAST_COVERAGE, ChannelFormat
from octex.conversion import large
from octex.jit import inlined, kernel, popcount, put
from octex.jit.vectors import eight, eight_at
from octex.source.base import Source
from octex.source.vectors import Vector, between, cross_product, edges_from, length_of
from octex.tree.edit import first_not_below
from octex.tree.layout import GRID_BITS
from octex.tree.morton import decode
from octex.tree.placement import Placement
from octex.voxelize.fragments import Blocks, Fragments

#: Stored steps: of positions in a cell, over its edge; of shares, over the cell's area; of unit normals.
POSITION_STEPS, SHARE_STEPS, NORMAL_STEPS = 65536, 255, 127
#: Room for the points of a patch, filled up to a multiple of eight: a sample, and three for each corner of a
#: polygon of at most six corners, two of which may occur twice. No cell has more samples.
MOST_POINTS = 40
#: Least width over which the source is read, in cells. Compared with points, half a cell costs 0.1 dB; it
#: wins 1 dB where the source itself is filtered to the cell.
LEAST_WIDTH = 0.5
#: The largest fragment and the others become two samples if neither has less than this share of the other's
#: area. Else there is one sample: the largest fragment, or the mean of all.
LEAST_PART = 0.1
#: Widths that differ by less than this factor count as equal.
SAME_WIDTH = 1.2
#: Larger than any step along a side that is not level, in its length.
_HUGE = 1e30
#: Cells whose samples are counted at once.
_RUN = 1 << 20
#: The root cell itself: positions from 0 to 1.
UNIT = Placement((0.0, 0.0, 0.0), 1.0)


class Samples(NamedTuple):
    """Samples of the surface in the finest cells, cell by cell in Morton order."""

    depth: int  # of the finest cells
    channels: tuple[ChannelFormat, ...]  # of the values' columns, as they are stored
    codes: Int64s  # (cells,)   Morton codes, ascending
    firsts: Int64s  # (cells + 1,)   the first sample of each cell
    positions: Uint16s  # (n, 3)   in the cell, (position + ½) / 65536 of its edge
    normals: Int8s  # (n, 3)   of the surface at rest, in 127ths
    shares: Uint8s  # (n,)   of the area in the cell, in 255ths
    values: npt.NDArray[np.float16 | np.float32]  # (n, components)   linear light, −1 … 1 for directions

    def rows(self, cells: Int64s) -> Int64s:
        """Return the numbers of the samples of cells (k,), cell by cell."""
        return in_runs(self.firsts[cells], self.firsts[cells + 1] - self.firsts[cells])


class SamplesOfRun(NamedTuple):
    """The samples of a run of blocks, cell by cell."""

    counts: Uint8s  # (cells,)
    positions: Uint16s
    normals: Int8s
    shares: Uint8s
    values: npt.NDArray[np.float16 | np.float32]


class Chosen(NamedTuple):
    """The fragments that become samples, cell by cell."""

    counts: Uint8s  # (cells,)   number of samples
    shares: Uint8s  # (n,)
    fragments: Int64s  # (n,)   a sample's largest
    is_mean: Bools  # (n,)   whether the sample is the mean of several fragments
    means: Int64s  # (entries, 2)   the mean's sample, and the fragment that it leaves out; −1: none


def take_samples(
    source: Source,
    blocks: Blocks,
    fragments: Fragments,
    widths: Float32s,
    values: Float32s,
    cell: float,
    channels: Sequence[ChannelFormat],
    alpha: int,
) -> SamplesOfRun:
    """Take the samples of a run's fragments, whose ``values`` were read over ``widths``.

    ``cell`` is the edge of a cell in rest units; ``alpha`` is the column of coverage, or −1.

    A sample is read over a width w with w² = cell² − texel², but half a cell at least: the field is as wide
    as a cell, and the source already as wide as a texel. If the fragment's width is nearly that, its value is
    taken instead. Means are made of the fragments' values.
    """
    chosen = _choose(fragments.flags, fragments.entries, fragments.areas)
    triangles = fragments.triangles.take(chosen.fragments)
    texels = source.texel_edges(triangles).astype(np.float64) ** 2
    wanted = np.maximum(cell * cell - texels, (LEAST_WIDTH * cell) ** 2)
    samples = values.take(chosen.fragments, axis=0)
    read = widths.take(chosen.fragments).astype(np.float64) ** 2
    positions = np.empty((len(triangles), 3), np.uint16)
    _place(blocks, fragments, chosen, values, alpha, samples, positions)
    same, one, other = SAME_WIDTH**2, read + texels, wanted + texels
    differ = np.flatnonzero(((one * same < other) | (one > same * other)) & ~chosen.is_mean)
    samples[differ] = source.evaluate(
        triangles[differ],
        fragments.barycentric.take(chosen.fragments[differ], axis=0),
        np.sqrt(wanted[differ]).astype(np.float32),
    )
    is_fine = any(channel.dtype in ("uint16", "float32") for channel in channels)
    dtype = np.float32 if is_fine else np.float16
    most = np.finfo(dtype).max
    if not (np.abs(samples) <= most).all():
        samples = np.clip(np.nan_to_num(samples), -most, most)
    normals = face_normals(blocks.grid, blocks.faces, triangles)
    return SamplesOfRun(chosen.counts, positions, normals, chosen.shares, samples.astype(dtype, copy=False))


def join(depth: int, channels: tuple[ChannelFormat, ...], codes: Int64s, runs: list[SamplesOfRun]) -> Samples:
    """Lay the samples of all runs end to end, and empty ``runs``, which saves memory."""
    columns = [list(arrays) for arrays in zip(*runs, strict=True)]
    runs.clear()
    counts, *arrays = (large.joined(columns.pop(0)) for _ in SamplesOfRun._fields)
    firsts = large.zeros(len(codes) + 1, np.int64)
    for begin in range(0, len(codes), _RUN):  # one sum over all cells would lie in memory first
        end = min(begin + _RUN, len(codes))
        firsts[begin + 1 : end + 1] = firsts[begin] + np.cumsum(counts[begin:end], dtype=np.int64)
    return Samples(depth, channels, codes, firsts, *arrays)


def sample_points(samples: Samples, chosen: Int64s) -> Float64s:
    """Return where ``chosen`` samples lie in texture space (n, 3); fastest if they ascend."""
    return _points(samples.codes, samples.firsts, samples.positions, 0.5**samples.depth, chosen)


def nearest_facings(normals: npt.NDArray[np.integer | np.floating]) -> Int64s:
    """Return the numbers of the facings nearest to normals (n, 3)."""
    axes = np.abs(normals).argmax(axis=1)
    facings: Int64s = 2 * axes + (np.take_along_axis(normals, axes[:, None], axis=1)[:, 0] < 0)
    return facings


@inlined
def lay_out(positions: Uint16s, normals: Int8s, sample: int, points: Float32s) -> int:
    """Write a sample's position in its cell, 0 … 1, and points of the patch around it; return their number.

    The patch is the polygon in which the plane of the surface cuts the cell. After the sample come its
    corners, in order around; as many middles between a corner and the sample; and as many between a corner
    and the next. So each triangle from the sample to a side has points at its corners and in the middles of
    its sides. Points are columns of ``points`` (3, MOST_POINTS); the sample is repeated up to a multiple of
    eight.
    """
    for axis in range(3):
        points[axis, 0] = (positions[sample, axis] + 0.5) / POSITION_STEPS
    count = _cut(normals[sample, 0], normals[sample, 1], normals[sample, 2], points)
    half = eight(0.5)
    for axis in range(3):
        first, middle = axis * MOST_POINTS + 1, eight(points[axis, 0])
        points[axis, 1 + count] = points[axis, 1]  # after the last corner comes the first
        corners, after = eight_at(points, first), eight_at(points, first + 1)
        put(points, first + count, half * (corners + middle))
        put(points, first + 2 * count, half * (corners + after))
        put(points, first + 3 * count, middle)
    return 1 + 3 * count


@inlined
def _cut(x: float, y: float, z: float, points: Float32s) -> int:
    """Write the corners of the polygon in which a plane cuts a cell, and return their number.

    The plane goes through the first of ``points``, which lies in the cell, and has the normal x, y, z. Its
    height over the cell's face is linear: each side of the face has the part where it lies in the cell.
    """
    up = 0 if abs(x) >= max(abs(y), abs(z)) else (1 if abs(y) >= abs(z) else 2)
    along, across = (up + 1) % 3, (up + 2) % 3
    normal = (float(x), float(y), float(z))
    steep, one, other = normal[up], normal[along], normal[across]
    inverse = 1.0 / steep if steep != 0.0 else 1.0
    slopes = one * inverse, other * inverse
    # A level side lies in the cell as a whole, or not at all: its steps are huge.
    steps = steep / one if one != 0.0 else _HUGE, steep / other if other != 0.0 else _HUGE
    begin = points[up, 0] + slopes[0] * points[along, 0] + slopes[1] * points[across, 0]
    count = 0
    for side in range(4):
        a, b = float((side + 1) // 2 % 2), float(side // 2)
        c, d = 1.0 - b, a
        sign = -1.0 if side >= 2 else 1.0
        slope, step = sign * slopes[side & 1], sign * steps[side & 1]
        top, bottom = (begin - 1.0) * step, begin * step
        low, high = max(0.0, min(bottom, top)), min(1.0, max(bottom, top))
        end = begin - slope
        for part in range(2):
            at = low if part == 0 else high
            column = 1 + count
            points[along, column] = a + at * (c - a)
            points[across, column] = b + at * (d - b)
            points[up, column] = min(max(begin - at * slope, 0.0), 1.0)
            count += (low <= high) & ((part == 0) | (at == low) | (at < 1.0))
        begin = end
    return count


@kernel
def _points(codes: Int64s, firsts: Int64s, positions: Uint16s, edge: float, chosen: Int64s) -> Float64s:
    points = np.empty((chosen.size, 3), np.float64)
    step = 1.0 / POSITION_STEPS
    cell = np.int64(0)
    for n in range(chosen.size):
        sample = chosen[n]
        if not (firsts[cell] <= sample < firsts[cell + 1]):
            cell += 1  # mostly the next
            if cell >= codes.size or not (firsts[cell] <= sample < firsts[cell + 1]):
                cell = np.int64(first_not_below(firsts, int(sample) + 1, int(cell)) - 1)
        i, j, k = decode(codes[cell])
        points[n, 0] = (i + (positions[sample, 0] + 0.5) * step) * edge
        points[n, 1] = (j + (positions[sample, 1] + 0.5) * step) * edge
        points[n, 2] = (k + (positions[sample, 2] + 0.5) * step) * edge
    return points


@kernel
def _choose(flags: Uint8s, entries: Int32s, areas: Float64s) -> Chosen:
    """Choose the samples of each entry: its largest fragment, and the mean of the others."""
    counts = np.empty(flags.size, np.uint8)
    n_entries = 0
    for cell in range(flags.size):
        n_entries += popcount(np.uint64(flags[cell]))
    largest = np.empty((n_entries, 2), np.int64)
    means = np.empty((n_entries, 2), np.int64)
    for entry in range(n_entries):
        largest[entry, 0] = largest[entry, 1] = means[entry, 0] = means[entry, 1] = -1
    totals = np.empty(n_entries, np.float64)
    sizes = np.empty(n_entries, np.int32)
    for entry in range(n_entries):  # numpy's zeros compile for a quarter of a second a type
        totals[entry] = 0.0
        sizes[entry] = 0
    for fragment in range(entries.size):
        entry = entries[fragment]
        totals[entry] += areas[fragment]
        sizes[entry] += 1
        if largest[entry, 0] < 0 or areas[fragment] > areas[largest[entry, 0]]:
            largest[entry, 1] = largest[entry, 0]
            largest[entry, 0] = fragment
        elif largest[entry, 1] < 0 or areas[fragment] > areas[largest[entry, 1]]:
            largest[entry, 1] = fragment
    shares = np.empty(2 * n_entries, np.uint8)
    chosen = np.empty(2 * n_entries, np.int64)
    is_mean = np.empty(2 * n_entries, np.bool_)
    n = entry = 0
    for cell in range(flags.size):
        end = entry + popcount(np.uint64(flags[cell]))
        first = n
        whole = 0.0
        for i in range(entry, end):
            whole += totals[i]
        for i in range(entry, end):
            one = largest[i, 0]
            area = areas[one]
            others = totals[i] - area if sizes[i] > 1 else 0.0
            share, part = totals[i] / whole * SHARE_STEPS, area / totals[i]
            if others < LEAST_PART * area:
                part = 1.0
            elif area < LEAST_PART * others:
                part = 0.0
            if part > 0.0:
                chosen[n], is_mean[n] = one, False
                shares[n] = max(int(share * part + 0.5), 1)
                n += 1
            if part < 1.0:
                chosen[n], is_mean[n] = largest[i, int(part > 0.0)], sizes[i] > 2
                shares[n] = max(int(share * (1.0 - part) + 0.5), 1)
                if is_mean[n]:
                    means[i, 0], means[i, 1] = n, one if part > 0.0 else -1
                n += 1
        counts[cell] = n - first
        entry = end
    return Chosen(counts, shares[:n].copy(), chosen[:n].copy(), is_mean[:n].copy(), means)


@kernel
def face_normals(grid: Int32s, corners: Int32s, triangles: Int32s) -> Int8s:
    """Return the unit normals (n, 3) of triangles (n,), in 127ths."""
    normals = np.empty((triangles.size, 3), np.int8)
    for n in range(triangles.size):
        if n > 0 and triangles[n] == triangles[n - 1]:
            for axis in range(3):
                normals[n, axis] = normals[n - 1, axis]
            continue
        x, y, z = cross_product(*edges_from(grid, corners, int(triangles[n])))
        length = length_of((x, y, z))
        scale = NORMAL_STEPS / length if length > 0.0 else 0.0
        normals[n, 0] = np.int8(np.rint(x * scale))
        normals[n, 1] = np.int8(np.rint(y * scale))
        normals[n, 2] = np.int8(np.rint(z * scale))
    return normals


@inlined
def _step(position: float, cell: int) -> int:
    return min(max(int((position - cell) * POSITION_STEPS), 0), POSITION_STEPS - 1)


@inlined
def _centroid(
    grid: Int32s, corners: Int32s, fragments: Fragments, fragment: np.uint64, scale: float
) -> Vector:
    """Return the centroid of a fragment, in cells."""
    shares = (
        fragments.barycentric[fragment, 0] * scale,
        fragments.barycentric[fragment, 1] * scale,
        fragments.barycentric[fragment, 2] * scale,
    )
    return between(grid, corners, int(fragments.triangles[fragment]), shares)


@kernel
def _place(
    blocks: Blocks,
    fragments: Fragments,
    chosen: Chosen,
    values: Float32s,
    alpha: int,
    samples: Float32s,
    positions: Uint16s,
) -> None:
    """Write the samples' positions in their cells, and the means of several fragments to ``samples``."""
    grid, corners = blocks.grid, blocks.faces
    scale = 1.0 / (1 << (GRID_BITS - blocks.level - blocks.bits))
    centroids = np.empty((chosen.fragments.size, 3), np.float64)
    totals = np.empty((chosen.fragments.size, 2), np.float64)  # the areas of means, and their coverage
    for n in range(chosen.fragments.size):
        fragment = np.uint64(chosen.fragments[n])
        x, y, z = _centroid(grid, corners, fragments, fragment, scale)
        centroids[n, 0], centroids[n, 1], centroids[n, 2] = x, y, z
        totals[n, 0] = totals[n, 1] = fragments.areas[fragment]
        if alpha >= 0:
            totals[n, 1] *= max(np.float64(values[fragment, alpha]), LEAST_COVERAGE)
    for one in range(fragments.entries.size):
        row, apart = chosen.means[fragments.entries[one], 0], chosen.means[fragments.entries[one], 1]
        if row < 0 or one == apart or one == chosen.fragments[row]:
            continue
        fragment = np.uint64(one)
        area = fragments.areas[fragment]
        weight = area if alpha < 0 else area * max(np.float64(values[fragment, alpha]), LEAST_COVERAGE)
        totals[row, 0] += area
        totals[row, 1] += weight
        area /= totals[row, 0]
        weight /= totals[row, 1]
        x, y, z = _centroid(grid, corners, fragments, fragment, scale)
        centroids[row, 0] += area * (x - centroids[row, 0])
        centroids[row, 1] += area * (y - centroids[row, 1])
        centroids[row, 2] += area * (z - centroids[row, 2])
        for k in range(values.shape[1]):
            part = area if k == alpha else weight  # a difference of infinities would be NaN
            value, more = np.float64(samples[row, k]), np.float64(values[fragment, k])
            samples[row, k] = (1.0 - part) * value + part * more
    n = 0
    for cell in range(chosen.counts.size):
        u, v, w = decode(fragments.codes[cell])
        for _ in range(chosen.counts[cell]):
            positions[n, 0] = _step(centroids[n, 0], u)
            positions[n, 1] = _step(centroids[n, 1], v)
            positions[n, 2] = _step(centroids[n, 2], w)
            n += 1
