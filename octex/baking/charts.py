"""Charts for arbitrary meshes: regions that face roughly one way, flattened by projection.

Normals are first averaged over neighbours, so that noise does not split charts. Charts grow one by one within
a cone of normals, then all at once from their centres (Cohen-Steiner, Alliez & Desbrun 2004). Neighbours
merge while the result still faces roughly one way.
"""

from __future__ import annotations

from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float64s, Int32s, Int64s
from octex.baking.layout import neighbours_of, numbered, sums_of
from octex.baking.unfold import (
    LEAST,
    SIDE,
    TINY,
    TINY_PART,
    ChartMesh,
    axes_of,
    connected,
    grow,
    unfolded,
    without_overlaps,
)
from octex.jit import kernel
from octex.source.corners import area_vectors, unit
from octex.source.mesh import Mesh
from octex.source.vectors import dot_product, length_of, minus, plus, row_of, times
from octex.source.welding import first_equal

#: Charts merge if their common axis shows this part of their area, or one has less than this doubled area,
#: and all triangles lie within this angle.
_SHOWN, _SMALL, _MERGED = 0.8, 2.0 * 256.0 / SIDE**2, np.radians(65.0)
#: Bins of directions along a side of a cube's faces.
_BINS = 6
#: Pairs of charts that are tested at once.
_PAIRS = 16_384
#: Least cosine between averaged normals and a chart's axis, where charts grow at once.
_WIDEST = 0.5
#: Rounds in which charts grow from their centres.
_ROUNDS = 2
#: Extra length of the path to a triangle at right angles to the chart's axis.
_BEND = 2.0
#: Normals are averaged over this part of the model's longest side, in at most this many rounds.
_AVERAGED, _MOST_AVERAGED = 0.02, 25
#: Power of the cosine between normals that weighs their average.
_SHARP = 2


class Flattened(NamedTuple):
    """Flattened triangles."""

    corners: Float64s  # (m, 3, 2)   y down; charts overlap each other
    charts: Int32s  # (m,)   connected, from 0
    edges: Bools  # (m, 3)   sides that are edges of charts


def laid_flat(mesh: Mesh) -> Flattened:
    """Flatten a mesh whose longest side becomes `SIDE`."""
    low, high = mesh.bounds
    rows = first_equal(mesh.rest)[mesh.triangles]
    positions = (mesh.rest - low) / (float((high - low).max()) or 1.0)
    corners = positions[rows]
    crosses = area_vectors(corners)
    areas, normals = np.linalg.norm(crosses, axis=1), unit(crosses)
    neighbours, _ = neighbours_of(rows)
    side = max(float(np.sqrt(areas @ areas / max(areas.sum(), 1e-300))), 1e-9)  # of a typical triangle
    facings = normals.copy()
    _average(normals, areas, neighbours, min(int((_AVERAGED / side) ** 2), _MOST_AVERAGED), facings)
    chart_mesh = ChartMesh(corners, neighbours, areas, normals, facings)
    flat, charts = unfolded(chart_mesh, rows, positions, _grown(chart_mesh))
    flat, charts = without_overlaps(chart_mesh, flat, charts)
    charts = connected(neighbours, charts)
    edges = (neighbours < 0) | (charts[neighbours] != charts[:, None])
    return Flattened(flat, charts.astype(np.int32), edges)


def _grown(mesh: ChartMesh) -> Int64s:
    """Return the chart of each triangle."""
    _, neighbours, areas, _, facings = mesh
    charts = np.full(len(areas), -1, np.int64)
    count = grow(neighbours, facings, areas, np.argsort(-areas, kind="stable"), LEAST, 0, charts)
    middles = mesh.corners.mean(axis=1)
    for _ in range(_ROUNDS):
        axes = axes_of(mesh, charts)
        weights = np.maximum(np.bincount(charts, areas, count), 1e-300)
        centers = sums_of(charts, middles * areas[:, None]) / weights[:, None]
        distances = ((middles - centers[charts]) ** 2).sum(axis=1)
        distances += np.where(areas > 0.0, 1e-3 * (1.0 - (facings * axes[charts]).sum(axis=1)), np.inf)
        order = np.lexsort((distances, charts))
        seeds = order[np.flatnonzero(np.diff(charts[order], prepend=-1))]  # nearest to each centre
        _grow_at_once(neighbours, facings, areas, middles, axes, seeds, charts)
        is_taken = charts >= 0
        charts[is_taken] = numbered(charts[is_taken])
        first = int(charts.max()) + 1
        count = grow(neighbours, facings, areas, np.flatnonzero(~is_taken), LEAST, first, charts)
    return _merged(mesh, charts)


def _merged(mesh: ChartMesh, charts: Int64s) -> Int64s:
    """Merge charts across their longest borders while their triangles face roughly one way."""
    _, neighbours, areas, _, facings = mesh
    sums, sizes = sums_of(charts, facings * areas[:, None]), np.bincount(charts, areas)
    bins, directions = _binned(facings)
    counts = np.bincount(charts * len(directions) + bins, areas > 0.0, sizes.size * len(directions))
    faced = counts.reshape(sizes.size, -1) > 0.0  # directions that each chart faces
    triangles, sides = np.nonzero((neighbours >= 0) & (charts[neighbours] != charts[:, None]))
    first, second = charts[triangles], charts[neighbours[triangles, sides]]  # both ways
    ends = mesh.corners[triangles, sides], mesh.corners[triangles, (sides + 1) % 3]
    borders = np.linalg.norm(ends[1] - ends[0], axis=1)
    pieces = connected(neighbours, np.zeros_like(charts))
    tiny = np.empty(sizes.size)
    tiny[charts] = np.minimum(TINY, TINY_PART * np.bincount(pieces, areas))[pieces]
    merged_into = np.arange(sizes.size)  # of the charts that there were
    while True:
        keys = np.minimum(first, second) * sizes.size + np.maximum(first, second)
        pairs, rows = np.unique(keys, return_inverse=True)
        borders = np.bincount(rows, borders, pairs.size)
        first, second = pairs // sizes.size, pairs % sizes.size
        joint = sums[first] + sums[second]
        is_shown = np.linalg.norm(joint, axis=1) >= _SHOWN * (sizes[first] + sizes[second])
        is_small = np.minimum(sizes[first], sizes[second]) < _SMALL
        fits = (sizes < tiny)[first] | (sizes < tiny)[second]
        tested = np.flatnonzero((is_shown | is_small) & ~fits)
        angles = _largest_angle(unit(joint[tested]), faced, first[tested], second[tested], directions)
        fits[tested] = angles <= _MERGED
        if not fits.any():
            return merged_into[charts]
        fitting = np.stack([first, second], axis=1)[fits]
        directed = np.concatenate([fitting, fitting[:, ::-1]])
        order = np.lexsort((directed[:, 1], -np.tile(borders[fits], 2), directed[:, 0]))
        firsts = order[np.flatnonzero(np.diff(directed[order, 0], prepend=-1))]
        best = np.full(sizes.size, -1)
        best[directed[firsts, 0]] = directed[firsts, 1]  # two charts merge if each is the other's best
        numbers = np.arange(sizes.size)
        is_mutual = (best >= 0) & (best[best] == numbers) & (numbers > best)
        numbers[is_mutual] = best[is_mutual]
        numbers = numbered(numbers)
        merged_into = numbers[merged_into]
        last = np.flatnonzero(~is_mutual)
        kept, absorbed = best[is_mutual], np.flatnonzero(is_mutual)
        for each in (sums, sizes):
            each[kept] += each[absorbed]
        faced[kept] |= faced[absorbed]
        tiny[kept] = np.minimum(tiny[kept], tiny[absorbed])
        sums, sizes, faced, tiny = sums[last], sizes[last], faced[last], tiny[last]
        first, second = numbers[first], numbers[second]
        is_border = first != second
        first, second, borders = first[is_border], second[is_border], borders[is_border]


def _binned(directions: Float64s) -> tuple[Int64s, Float64s]:
    """Return the bin of each direction (m,), and the bins' centres (n, 3): squares on a cube's faces."""
    axes = np.abs(directions).argmax(axis=1)
    along = np.take_along_axis(directions, axes[:, None], axis=1)[:, 0]
    scale = _BINS / 2.0 / np.maximum(np.abs(along), 1e-300)
    faces = 2 * axes + (along < 0.0)
    places = (np.choose((axes + k) % 3, directions.T) * scale + _BINS / 2.0 for k in (1, 2))
    row, column = (np.clip(each.astype(np.int64), 0, _BINS - 1) for each in places)
    middles = np.empty((6, _BINS, _BINS, 3))
    across = (np.arange(_BINS) + 0.5) * 2.0 / _BINS - 1.0
    for face in range(6):
        middles[face, ..., face // 2] = 1.0 - 2.0 * (face % 2)
        middles[face, ..., (face // 2 + 1) % 3] = across[:, None]
        middles[face, ..., (face // 2 + 2) % 3] = across
    return (faces * _BINS + row) * _BINS + column, unit(middles.reshape(-1, 3))


def _largest_angle(axes: Float64s, shares: Bools, one: Int64s, two: Int64s, directions: Float64s) -> Float64s:
    """Return the largest angle between axes (n, 3) and the directions of two charts each (n,)."""
    angles = np.empty(one.size)
    for first in range(0, one.size, _PAIRS):
        pairs = slice(first, first + _PAIRS)
        dots = np.where(shares[one[pairs]] | shares[two[pairs]], axes[pairs] @ directions.T, 1.0)
        angles[pairs] = np.arccos(np.clip(dots.min(axis=1), -1.0, 1.0))
    return angles


@kernel
def _average(normals: Float64s, areas: Float64s, neighbours: Int32s, rounds: int, averaged: Float64s) -> None:
    """Average normals (m, 3) over neighbours ``rounds`` times, by area, and less across sharp edges."""
    before = normals.copy()
    for _ in range(rounds):
        for triangle in range(areas.size):
            normal = row_of(before, triangle)
            total = times(normal, areas[triangle])
            for side in range(3):
                neighbour = neighbours[triangle, side]
                if neighbour >= 0:
                    other = row_of(before, neighbour)
                    share = areas[neighbour] * max(dot_product(normal, other), 0.0) ** _SHARP
                    total = plus(total, other, share)
            length = length_of(total)
            if length > 0.0:
                for axis in range(3):
                    averaged[triangle, axis] = total[axis] / length
        for triangle in range(areas.size):  # the whole at once compiles for 2 s more
            for axis in range(3):
                before[triangle, axis] = averaged[triangle, axis]


@kernel
def _grow_at_once(
    neighbours: Int32s, facings: Float64s, areas: Float64s, middles: Float64s, axes: Float64s, seeds: Int64s,
    charts: Int64s,
) -> None:  # fmt: skip
    """Grow charts from one triangle each along shortest paths; triangles off their axes keep −1."""
    charts[:] = -1
    costs = np.full(charts.size, np.inf)
    waiting = [(0.0, seeds[0], 0)]
    for chart in range(1, seeds.size):
        heappush(waiting, (0.0, seeds[chart], chart))
    while waiting:
        cost, triangle, chart = heappop(waiting)
        if charts[triangle] >= 0:
            continue
        charts[triangle] = chart
        for side in range(3):
            neighbour = neighbours[triangle, side]
            if neighbour < 0 or charts[neighbour] >= 0:
                continue
            along = dot_product(row_of(facings, neighbour), row_of(axes, chart))
            if along < _WIDEST and areas[neighbour] > 0.0:
                continue
            away = length_of(minus(row_of(middles, neighbour), row_of(middles, triangle)))
            farther = cost + away * (1.0 + _BEND * (1.0 - along))
            if farther < costs[neighbour]:
                costs[neighbour] = farther
                heappush(waiting, (farther, np.int64(neighbour), chart))
