"""Flattens charts by projection: folds are smoothed, passed on or cut out, overlapping charts halved."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float64s, Int32s, Int64s
from octex.baking.layout import doubled_areas, pieces_of, steps_between, sums_of
from octex.jit import kernel, part
from octex.source.corners import area_vectors, unit, unit_normals
from octex.source.vectors import dot_product, length_of, plus, row_of

#: Length of the model's longest side in the map in which charts are flattened.
SIDE = 1024.0
#: Least cosine between averaged normals and a chart's axis, where charts grow one by one.
LEAST = 0.6
#: Charts below this doubled area, and below this part of their connected mesh, always merge.
TINY, TINY_PART = 2.0 * 16.0 / SIDE**2, 0.01
#: Rounds of smoothing around folds: of the surface, then of the chart.
_PASSED, _RELAXED = 3, 4
#: Triangles that show less than this part of their area are edge-on; small ones may show this much less.
_ON_EDGE, _LEAST_SHOWN = 0.25, 0.02
#: A tiny cut-out chart grows by at most this many rings of triangles.
_WIDENED = 4
#: Part of the way to its neighbours' mean that a position moves at once.
_STEP = 0.6
#: Overlaps are probed at this many points a side. A chart overlaps if it covers this part of itself twice,
#: and this part of a triangle: folds of noise are smaller. Else a rod over a blob may show its colour.
_PROBE, _OVERLAPPING, _OF_TRIANGLE = 256, 0.0002, 0.2
#: Position of the probes in their squares.
_ASIDE = 0.4142135, 0.7320508
#: Charts of at most this many triangles are first tested pair by pair.
_FEW = 64
#: Overlapping charts are halved this often; then their triangles are separated.
_MOST_HALVED = 8


class ChartMesh(NamedTuple):
    """The triangles to flatten; the model's longest side is 1."""

    corners: Float64s  # (m, 3, 3)
    neighbours: Int32s  # (m, 3)   the triangle across each side; −1: none
    areas: Float64s  # (m,)   doubled
    normals: Float64s  # (m, 3)   of triangles
    facings: Float64s  # (m, 3)   normals averaged over neighbours


def axes_of(mesh: ChartMesh, charts: Int64s) -> Float64s:
    """Return the mean normals of charts (n, 3)."""
    return unit(sums_of(charts, mesh.normals * mesh.areas[:, None]))


def _projected(corners: Float64s, directions: Float64s) -> Float64s:
    """Project triangles (m, 3, 3) along directions (m, 3), to the right and down as seen from their tips."""
    helper = np.where(np.abs(directions[:, 1:2]) < 0.9, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0))
    right = unit(np.cross(helper, directions))
    down = np.cross(right, directions)
    flat = [np.einsum("mkx,mx->mk", SIDE * corners, way) for way in (right, down)]
    return np.stack(flat, axis=-1)


def _folded(corners: Float64s, flat: Float64s) -> Bools:
    """Return the triangles (m, 3, 3) that are upside down, or stretched as if seen nearly edge-on."""
    right, down = steps_between(SIDE * corners, flat)
    is_stretched = (right**2 + down**2).sum(axis=1) > 1.0 + _ON_EDGE**-2.0
    is_folded: Bools = ((doubled_areas(flat) >= 0.0) | is_stretched) & area_vectors(corners).any(axis=1)
    return is_folded


def unfolded(mesh: ChartMesh, rows: Int64s, positions: Float64s, charts: Int64s) -> tuple[Float64s, Int64s]:
    """Flatten charts by projection. Folds are smoothed on the surface, then cut out.

    Triangles that fold move to a neighbour's chart if that shows them.
    """
    corners, neighbours, areas = mesh.corners, mesh.neighbours, mesh.areas
    axes = axes_of(mesh, charts)
    flat = _projected(corners, axes[charts])
    folded = _folded(corners, flat)
    for n in range(_PASSED):
        rows_folded = np.flatnonzero(folded)
        before = charts.copy()
        normals = unit_normals(positions[rows[rows_folded]])
        _move_to_neighbours(neighbours, normals, axes, rows_folded, charts)
        _absorb(neighbours, areas, charts)
        near, is_near = _around(rows, folded | (charts != before), len(positions), n)
        _smooth(rows[near], neighbours[near], is_near, 2, positions)
        flat[near] = _projected(positions[rows[near]], axes[charts[near]])
        folded[near] = _folded(corners[near], flat[near])
    for n in range(_RELAXED):
        if not folded.any():
            break
        near, _ = _around(rows, folded, len(positions), n + 1)
        vertex_keys = charts[near, None] * len(positions) + rows[near]
        keys_of_vertices, numbers = np.unique(vertex_keys, return_inverse=True)
        relaxed = np.empty((keys_of_vertices.size, 2))
        numbers = numbers.reshape(-1, 3)
        relaxed[numbers] = flat[near]
        _, is_near = _around(numbers, folded[near], keys_of_vertices.size, n)
        chart_neighbours = np.where(charts[neighbours[near]] == charts[near, None], neighbours[near], -1)
        _smooth(numbers, chart_neighbours, is_near, 4, relaxed)
        flat[near] = relaxed[numbers]
        folded[near] = _folded(corners[near], flat[near])
    folded = _cut(mesh, flat, folded, charts)
    flat[folded] = _projected(corners[folded], axes_of(mesh, charts)[charts[folded]])
    return flat, charts


def _around(rows: Int64s, is_chosen: Bools, count: int, rings: int) -> tuple[Int64s, Bools]:
    """Return the triangles within ``rings`` rings of the chosen ones, and the vertices there."""
    is_near = np.zeros(count, np.bool_)
    is_near[rows[is_chosen]] = True
    for _ in range(rings):
        is_near[rows[is_near[rows].any(axis=1)]] = True
    return np.flatnonzero(is_near[rows].any(axis=1)), is_near


def _cut(mesh: ChartMesh, flat: Float64s, folded: Bools, charts: Int64s) -> Bools:
    """Make charts of folded triangles and part of their surroundings; return the triangles in new charts.

    Small edge-on triangles stay.
    """
    _, neighbours, areas, normals, _ = mesh
    is_upside = folded & (doubled_areas(flat) >= -_LEAST_SHOWN * SIDE**2 * areas)
    groups = connected(neighbours, folded.astype(np.int64))
    is_cut = folded & ((np.bincount(groups, areas)[groups] >= TINY) | is_upside)
    count = int(charts.max()) + 1
    new_charts = np.where(is_cut, -1, charts)
    chart_count = grow(neighbours, normals, areas, np.flatnonzero(is_cut), LEAST, count, new_charts)
    for _ in range(_WIDENED):
        is_new = new_charts >= count
        sizes = np.bincount(new_charts[is_new] - count, areas[is_new], chart_count - count)
        ring = np.flatnonzero(~is_new & ((neighbours >= 0) & is_new[neighbours]).any(axis=1))
        if not ring.size:
            break
        axes = unit(sums_of(new_charts[is_new] - count, normals[is_new] * areas[is_new, None]))
        ring_charts = np.where(neighbours[ring] >= 0, new_charts[neighbours[ring]], -1) - count
        is_none, ring_charts = ring_charts < 0, np.maximum(ring_charts, 0)
        cosines = np.einsum("mx,mkx->mk", normals[ring], axes[ring_charts])
        cosines[is_none | (sizes[ring_charts] >= TINY)] = -1.0
        best = cosines.argmax(axis=1)
        joins = np.take_along_axis(cosines, best[:, None], axis=1)[:, 0] > LEAST
        new_charts[ring[joins]] = ring_charts[joins, best[joins]] + count
    charts[:] = new_charts
    return new_charts >= count


def _absorb(neighbours: Int32s, areas: Float64s, charts: Int64s) -> None:
    """Merge tiny pieces of charts into the chart that they share most sides with."""
    groups = connected(neighbours, charts)
    is_tiny = (np.bincount(groups, areas) < TINY)[groups]
    nearby = charts[neighbours]
    triangles, sides = np.nonzero(is_tiny[:, None] & (neighbours >= 0) & (nearby != charts[:, None]))
    pairs, counts = np.unique(
        groups[triangles] * (int(charts.max()) + 1) + nearby[triangles, sides], return_counts=True
    )
    piece, chart = np.divmod(pairs, int(charts.max()) + 1)
    order = np.lexsort((chart, -counts, piece))
    firsts = order[np.flatnonzero(np.diff(piece[order], prepend=-1))]
    target = np.full(int(groups.max()) + 1, -1)
    target[piece[firsts]] = chart[firsts]
    is_absorbed = target[groups] >= 0
    charts[is_absorbed] = target[groups[is_absorbed]]


def _move_to_neighbours(
    neighbours: Int32s, normals: Float64s, axes: Float64s, chosen: Int64s, charts: Int64s
) -> None:
    """Move the triangles ``chosen``, of these normals, to the neighbour's chart that shows them best."""
    nearby = charts[neighbours[chosen]]
    cosines = np.einsum("mx,mkx->mk", normals, axes[nearby])
    cosines[neighbours[chosen] < 0] = -1.0
    best = cosines.argmax(axis=1)
    rows = np.arange(chosen.size)
    is_better = cosines[rows, best] > np.einsum("mx,mx->m", normals, axes[charts[chosen]])
    charts[chosen[is_better]] = nearby[rows, best][is_better]


def without_overlaps(mesh: ChartMesh, flat: Float64s, charts: Int64s) -> tuple[Float64s, Int64s]:
    """Halve charts that overlap themselves until none does; at last separate their triangles."""
    charts = connected(mesh.neighbours, charts)
    order = np.argsort(charts, kind="stable")
    starts = np.append(np.flatnonzero(np.diff(charts[order], prepend=-1)), charts.size)
    suspects = [order[first:end] for first, end in pairwise(starts.tolist())]
    count = len(suspects)
    for n in range(_MOST_HALVED + 1):
        suspects = [chart for chart in suspects if _overlaps(flat[chart])]
        halves = []
        for chart in suspects:
            if n == _MOST_HALVED:
                charts[chart[1:]] = count + np.arange(chart.size - 1)
                count += chart.size - 1
                flat[chart] = _projected(mesh.corners[chart], mesh.normals[chart])
                continue
            _farthest_last(mesh.neighbours, charts, chart)
            _farthest_last(mesh.neighbours, charts, chart[::-1])
            half = chart.size // 2
            charts[chart[:half]] = count
            count += 1
            halves += [chart[:half], chart[half:]]
        suspects = halves
    return flat, charts


def _overlaps(flat: Float64s) -> bool:
    """Return whether a chart's triangles (m, 3, 2) overlap."""
    if len(flat) < 2 or (len(flat) <= _FEW and not _any_overlap(flat)):
        return False
    corners = flat - flat.min(axis=(0, 1))
    corners *= _PROBE / max(float(corners.max()), 1e-300)
    part = max(_OVERLAPPING, _OF_TRIANGLE / len(flat))
    return bool(_covered_again(corners) > part * np.abs(doubled_areas(corners)).sum() / 2.0)


@kernel
def _covered_again(corners: Float64s) -> int:
    """Return how many points of a grid triangles (m, 3, 2) cover again."""
    is_covered = np.zeros((_PROBE + 1, _PROBE + 1), np.bool_)
    count = 0
    for triangle in range(corners.shape[0]):
        a, b, c = corners[triangle, 0], corners[triangle, 1], corners[triangle, 2]
        x0, x1 = int(min(a[0], min(b[0], c[0]))), int(max(a[0], max(b[0], c[0])))
        y0, y1 = int(min(a[1], min(b[1], c[1]))), int(max(a[1], max(b[1], c[1])))
        for row in range(y0, y1 + 1):
            for column in range(x0, x1 + 1):
                x, y = column + _ASIDE[0], row + _ASIDE[1]  # on no edge
                first = (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
                second = (c[0] - b[0]) * (y - b[1]) - (c[1] - b[1]) * (x - b[0])
                third = (a[0] - c[0]) * (y - c[1]) - (a[1] - c[1]) * (x - c[0])
                if min(first, min(second, third)) > 0.0 or max(first, max(second, third)) < 0.0:
                    count += is_covered[row, column]
                    is_covered[row, column] = True
    return count


@kernel
def _any_overlap(flat: Float64s) -> bool:
    """Return whether any two triangles (m, 3, 2) overlap: no side of either separates them."""
    for one in range(len(flat)):
        for other in range(one):
            if not (_separates(flat[one], flat[other]) or _separates(flat[other], flat[one])):
                return True
    return False


@part
def _separates(triangle: Float64s, other: Float64s) -> bool:
    """Return whether a side of ``triangle`` separates it from ``other``."""
    for side in range(3):
        start, end, last = triangle[side], triangle[(side + 1) % 3], triangle[(side + 2) % 3]
        right, down = end[0] - start[0], end[1] - start[1]
        inside = right * (last[1] - start[1]) - down * (last[0] - start[0])
        sign, farthest = np.sign(inside), -np.inf
        for corner in range(3):
            across = right * (other[corner, 1] - start[1]) - down * (other[corner, 0] - start[0])
            farthest = max(farthest, sign * across)
        if farthest <= 1e-9 * abs(inside):
            return True
    return False


@kernel
def _smooth(rows: Int64s, neighbours: Int32s, near: Bools, rounds: int, positions: Float64s) -> None:
    """Move positions (n, 3 or 2) that are ``near`` toward their neighbours' means; borders stay."""
    for triangle in range(len(rows)):
        for side in range(3):
            if neighbours[triangle, side] < 0:
                near[rows[triangle, side]] = near[rows[triangle, (side + 1) % 3]] = False
    sums, counts = np.zeros_like(positions), np.zeros(len(positions))
    for _ in range(rounds):
        for triangle in range(len(rows)):
            for side in range(3):
                a, b = rows[triangle, side], rows[triangle, (side + 1) % 3]
                for axis in range(positions.shape[1]):
                    sums[a, axis] += positions[b, axis]
                    sums[b, axis] += positions[a, axis]
                counts[a] += 1.0
                counts[b] += 1.0
        for triangle in range(len(rows)):
            for side in range(3):
                n = rows[triangle, side]
                if counts[n] > 0.0 and near[n]:
                    for axis in range(positions.shape[1]):
                        positions[n, axis] += _STEP * (sums[n, axis] / counts[n] - positions[n, axis])
                counts[n] = sums[n, 0] = sums[n, 1] = sums[n, -1] = 0.0


def connected(neighbours: Int32s, charts: Int64s) -> Int64s:
    """Return the connected piece of its chart that each triangle (m,) is in, from 0."""
    return pieces_of(neighbours, (neighbours >= 0) & (charts[neighbours] == charts[:, None]))


@kernel
def _farthest_last(neighbours: Int32s, charts: Int64s, rows: Int64s) -> None:
    """Sort a chart's triangles by their number of steps from the first one."""
    chart, end = charts[rows[0]], 0
    for start in rows.copy():
        if charts[start] != chart:
            continue
        charts[start] = -1
        rows[end] = start
        first, end = end, end + 1
        while first < end:
            for side in range(3):
                neighbour = neighbours[rows[first], side]
                if neighbour >= 0 and charts[neighbour] == chart:
                    charts[neighbour] = -1
                    rows[end] = neighbour
                    end += 1
            first += 1
    charts[rows] = chart


@kernel
def grow(
    neighbours: Int32s, facings: Float64s, areas: Float64s, order: Int64s, least: float, count: int,
    charts: Int64s,
) -> int:  # fmt: skip
    """Grow charts from triangles in order, nearest first, over triangles that face like the chart's mean."""
    queue = np.empty(charts.size, np.int64)
    for n in range(order.size):
        if charts[order[n]] >= 0:
            continue
        queue[0] = order[n]
        charts[order[n]] = count
        total = (0.0, 0.0, 0.0)
        first, end = 0, 1
        while first < end:
            triangle = queue[first]
            first += 1
            total = plus(total, row_of(facings, triangle), areas[triangle])
            length = least * length_of(total)
            for side in range(3):
                neighbour = neighbours[triangle, side]
                if neighbour < 0 or charts[neighbour] >= 0:
                    continue
                if dot_product(total, row_of(facings, neighbour)) >= length or areas[neighbour] == 0.0:
                    charts[neighbour] = count
                    queue[end] = neighbour
                    end += 1
        count += 1
    return count
