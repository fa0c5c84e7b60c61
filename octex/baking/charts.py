"""Charts for meshes that nobody has modelled: pieces that face about one way, laid flat by projection.

Normals are averaged over neighbours first, so that noise does not tear charts apart. Charts grow within a
cone of normals from one triangle after the other, then all at once from their middles, as those of
Cohen-Steiner, Alliez and Desbrun (2004) do. Neighbours are merged while they face about one way.
"""

from __future__ import annotations

from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float64s, Int32s, Int64s
from octex.baking.layout import doubled_areas, neighbors, steps_between
from octex.baking.texels import draw_texels
from octex.jit import kernel, part
from octex.source.corners import area_vectors, unit
from octex.source.mesh import Mesh
from octex.source.welding import first_equal

#: The longest side of the model in the map that charts are laid flat in.
SIDE = 1024.0
#: The least cosine between averaged normals and a chart's axis, where charts grow one by one and at once.
_LEAST, _WIDEST = 0.6, 0.5
#: Charts are merged while their axis shows so much of their area, and triangles lie within this angle of it;
#: those of less than this doubled area within a larger one alone.
_SHOWN, _MERGED = 0.8, np.radians(65.0)
_SMALL, _MERGED_SMALL = 2.0 * 256.0 / SIDE**2, np.radians(78.0)
#: How often charts grow from their middles.
_ROUNDS = 2
#: How much longer the way to a triangle is that faces at right angles to the chart's axis.
_BEND = 2.0
#: Normals are averaged over this part of the model's longest side, in at most so many rounds.
_AVERAGED, _MOST_AVERAGED = 0.02, 60
#: The power of the cosine between normals with which they average.
_SHARP = 2
#: Positions of charts that fold are smoothed in so many rounds, and in so many more.
_SMOOTHED = (3, 6, 12)
#: What shows less than this part of its area is on edge.
_ON_EDGE = 0.3
#: How often triangles that their chart does not show go to a neighbour's.
_PASSED = 8
#: How far a position moves to the mean of its neighbours at once.
_STEP = 0.6
#: Overlaps are looked for in a map of so many texels a side, and are there if a chart covers so much less.
_PROBE, _OVERLAPPING = 256, 0.01
#: Triangles of a chart up to which every two of them are compared first.
_FEW = 64
#: Charts that overlap themselves are halved so often; then their triangles lie apart.
_MOST_HALVED = 8


class _Pieces(NamedTuple):
    """The triangles to lay flat; the model's longest side is 1."""

    corners: Float64s  # (m, 3, 3)
    others: Int32s  # (m, 3)   the triangle beyond each side; −1
    areas: Float64s  # (m,)   doubled
    normals: Float64s  # (m, 3)   of triangles
    facings: Float64s  # (m, 3)   normals averaged over neighbours


def laid_flat(mesh: Mesh) -> Float64s:
    """Return flattened corners (m, 3, 2), `SIDE` for the longest side, y down; charts lie apart."""
    low, high = mesh.bounds
    rows = first_equal(mesh.rest)[mesh.triangles]
    positions = (mesh.rest - low) / (float((high - low).max()) or 1.0)
    corners = positions[rows]
    crosses = area_vectors(corners)
    areas, normals = np.linalg.norm(crosses, axis=1), unit(crosses)
    others, _ = neighbors(mesh)
    side = max(float(np.sqrt(areas @ areas / max(areas.sum(), 1e-300))), 1e-9)  # of triangles, by area
    facings = normals.copy()
    _average(normals, areas, others, min(int((_AVERAGED / side) ** 2), _MOST_AVERAGED), facings)
    pieces = _Pieces(corners, others, areas, normals, facings)
    charts = _clustered(pieces)
    _pass_on(pieces, charts)
    flat = _projected(corners, _axes(pieces, charts)[charts])
    flat, charts = _unfolded(pieces, rows, positions, flat, charts)
    flat, charts = _without_overlaps(pieces, flat, charts)
    across = float(np.ptp(flat, axis=(0, 1)).max()) + 1.0  # what is apart must not look joined
    moved: Float64s = flat + (charts * across * 2.0)[:, None, None] * (1.0, 0.0)
    return moved


def _clustered(pieces: _Pieces) -> Int64s:
    """Return the chart of each triangle."""
    _, others, areas, _, facings = pieces
    charts = np.full(len(areas), -1, np.int64)
    count = _grow(others, facings, areas, np.argsort(-areas, kind="stable"), _LEAST, 0, charts)
    middles = pieces.corners.mean(axis=1)
    for _ in range(_ROUNDS):
        axes = _axes(pieces, charts)
        weights = np.maximum(np.bincount(charts, areas, count), 1e-300)
        centers = _sums(charts, middles * areas[:, None]) / weights[:, None]
        apart = ((middles - centers[charts]) ** 2).sum(axis=1)
        apart += np.where(areas > 0.0, 1e-3 * (1.0 - (facings * axes[charts]).sum(axis=1)), np.inf)
        order = np.lexsort((apart, charts))
        seeds = order[np.flatnonzero(np.diff(charts[order], prepend=-1))]
        _grow_at_once(others, facings, areas, middles, axes, seeds, charts)
        is_taken = charts >= 0
        numbers = np.unique(charts[is_taken], return_inverse=True)[1]
        charts[is_taken] = numbers
        first = int(numbers.max(initial=-1)) + 1
        count = _grow(others, facings, areas, np.flatnonzero(~is_taken), _LEAST, first, charts)
    return _merged(pieces, charts)


def _pass_on(pieces: _Pieces, charts: Int64s) -> None:
    """Give triangles that lie on edge or upside down in their chart to a neighbour's that shows them."""
    axes = _axes(pieces, charts)
    for _ in range(_PASSED):
        shown = np.einsum("mx,mx->m", pieces.normals, axes[charts])
        folded = np.flatnonzero((shown < _ON_EDGE) & (pieces.areas > 0.0))
        others = pieces.others[folded]
        nearby = charts[others]
        better = np.einsum("mx,mkx->mk", pieces.normals[folded], axes[nearby])
        better[others < 0] = -1.0
        best = better.argmax(axis=1)
        rows = np.arange(folded.size)
        is_better = better[rows, best] > np.maximum(shown[folded], _ON_EDGE)
        if not is_better.any():
            return
        charts[folded[is_better]] = nearby[rows, best][is_better]


def _axes(pieces: _Pieces, charts: Int64s) -> Float64s:
    """Return the mean normals of charts (n, 3)."""
    return unit(_sums(charts, pieces.normals * pieces.areas[:, None]))


def _sums(charts: Int64s, values: Float64s) -> Float64s:
    return np.stack([np.bincount(charts, column) for column in values.T], axis=1)


def _merged(pieces: _Pieces, charts: Int64s) -> Int64s:
    """Merge charts with the neighbour along the longest border while all triangles face about one way."""
    _, others, areas, _, facings = pieces
    corners = pieces.corners
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    while True:
        sums = _sums(charts, facings * areas[:, None])
        axes, sizes = unit(sums), np.bincount(charts, areas)
        dots = np.where(areas > 0.0, (facings * axes[charts]).sum(axis=1), 1.0)
        cones = np.full(len(sizes), -1.0)
        np.maximum.at(cones, charts, np.arccos(np.clip(dots, -1.0, 1.0)))
        triangles, sides = np.nonzero((others >= 0) & (charts[others] != charts[:, None]))
        one, two = charts[triangles], charts[others[triangles, sides]]
        pairs, rows = np.unique(one * len(sizes) + two, return_inverse=True)
        borders = np.bincount(rows, lengths[triangles, sides])
        one, two = pairs // len(sizes), pairs % len(sizes)
        both = sums[one] + sums[two]
        shown = np.linalg.norm(both, axis=1)
        is_small = np.minimum(sizes[one], sizes[two]) < _SMALL
        both = unit(both)
        turns = [np.arccos(np.clip((both * axes[each]).sum(axis=1), -1.0, 1.0)) for each in (one, two)]
        widest = np.maximum(turns[0] + cones[one], turns[1] + cones[two])
        fits = (widest <= _MERGED) & (shown >= _SHOWN * (sizes[one] + sizes[two]))
        fits |= is_small & (widest <= _MERGED_SMALL)
        one, two, borders = one[fits], two[fits], borders[fits]
        if not one.size:
            return charts
        order = np.lexsort((two, -borders, one))
        firsts = order[np.flatnonzero(np.diff(one[order], prepend=-1))]
        best = np.full(len(sizes), -1)
        best[one[firsts]] = two[firsts]
        numbers = np.arange(len(sizes))
        is_mutual = (best >= 0) & (best[best] == numbers) & (numbers > best)
        numbers[is_mutual] = best[is_mutual]
        charts = np.unique(numbers[charts], return_inverse=True)[1]


def _projected(corners: Float64s, directions: Float64s) -> Float64s:
    """Project triangles (m, 3, 3) along directions (m, 3): to the right and down, seen from their tips."""
    helper = np.where(np.abs(directions[:, 1:2]) < 0.9, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0))
    right = unit(np.cross(helper, directions))
    down = np.cross(right, directions)
    flat = [np.einsum("mkx,mx->mk", SIDE * corners, way) for way in (right, down)]
    return np.stack(flat, axis=-1)


def _folded(corners: Float64s, flat: Float64s) -> Bools:
    """Say which triangles (m, 3, 3) lie upside down, or are stretched like what is seen nearly on edge."""
    right, down = steps_between(SIDE * corners, flat)
    is_stretched = (right**2 + down**2).sum(axis=1) > 1.0 + _ON_EDGE**-2.0
    found: Bools = ((doubled_areas(flat) >= 0.0) | is_stretched) & area_vectors(corners).any(axis=1)
    return found


def _unfolded(
    pieces: _Pieces, rows: Int64s, positions: Float64s, flat: Float64s, charts: Int64s
) -> tuple[Float64s, Int64s]:
    """Lay charts with folds flat as a smoother surface lies; what folds even then is cut out."""
    axes = _axes(pieces, charts)
    folded = _folded(pieces.corners, flat)
    for rounds in _SMOOTHED:
        counts = np.bincount(charts, folded)
        if not counts.any():
            return flat, charts
        own = (counts > 0)[charts]
        _smooth(rows, pieces.others, rounds, positions)
        smooth = _projected(positions[rows[own]], axes[charts[own]])
        still = _folded(pieces.corners[own], smooth)
        is_better = (np.bincount(charts[own], still, counts.size) < counts)[charts[own]]
        chosen = np.flatnonzero(own)[is_better]
        flat[chosen], folded[chosen] = smooth[is_better], still[is_better]
    charts = np.where(folded, -1, charts)
    order = np.flatnonzero(folded)
    _grow(pieces.others, pieces.normals, pieces.areas, order, _LEAST, len(axes), charts)
    flat[folded] = _projected(pieces.corners[folded], _axes(pieces, charts)[charts[folded]])
    return flat, charts


def _without_overlaps(pieces: _Pieces, flat: Float64s, charts: Int64s) -> tuple[Float64s, Int64s]:
    """Halve charts that overlap themselves until none does; in the end their triangles lie apart."""
    charts = np.unique(charts, return_inverse=True)[1]
    doubted = np.arange(int(charts.max()) + 1)
    for n in range(_MOST_HALVED + 1):
        doubted = _overlapping(flat, charts, doubted)
        made = []
        for chart in doubted.tolist():
            own = np.flatnonzero(charts == chart)
            count = int(charts.max()) + 1
            if n == _MOST_HALVED:
                charts[own[1:]] = count + np.arange(own.size - 1)
                flat[own] = _projected(pieces.corners[own], pieces.normals[own])
                continue
            _farthest_last(pieces.others, charts, own)
            _farthest_last(pieces.others, charts, own[::-1])
            charts[own[: own.size // 2]] = count
            made += [chart, count]
        doubted = np.array(made, np.int64)
    return flat, charts


def _overlapping(flat: Float64s, charts: Int64s, doubted: Int64s) -> Int64s:
    """Return those of some charts that overlap themselves."""
    found = []
    order = np.argsort(charts, kind="stable")
    starts = np.searchsorted(charts[order], np.stack([doubted, doubted + 1]))
    for chart, first, end in zip(doubted.tolist(), *starts.tolist(), strict=True):
        own = order[first:end]
        if own.size < 2 or (own.size <= _FEW and not _cross(flat[own])):
            continue
        corners = flat[own] - flat[own].min(axis=(0, 1))
        corners *= _PROBE / max(float(corners.max()), 1e-300)
        every = np.ones((own.size, 3), np.bool_)
        drawn = draw_texels(corners, np.zeros(own.size, np.int32), every, _PROBE + 1, 0, _PROBE + 1)
        area = float(np.abs(doubled_areas(corners)).sum() / 2)
        if area - float(drawn.areas.sum()) > _OVERLAPPING * area:
            found.append(chart)
    return np.array(found, np.int64)


@kernel
def _cross(flat: Float64s) -> bool:
    """Say whether two of some triangles (m, 3, 2) overlap: no side of either parts them."""
    for one in range(len(flat)):
        for other in range(one):
            if not (_parts(flat[one], flat[other]) or _parts(flat[other], flat[one])):
                return True
    return False


@part
def _parts(triangle: Float64s, other: Float64s) -> bool:
    """Say whether another triangle lies beyond a side of a triangle."""
    for side in range(3):
        start, end, last = triangle[side], triangle[(side + 1) % 3], triangle[(side + 2) % 3]
        right, down = end[0] - start[0], end[1] - start[1]
        within = right * (last[1] - start[1]) - down * (last[0] - start[0])
        sign, most = np.sign(within), -np.inf
        for corner in range(3):
            across = right * (other[corner, 1] - start[1]) - down * (other[corner, 0] - start[0])
            most = max(most, sign * across)
        if most <= 1e-9 * abs(within):
            return True
    return False


@kernel
def _average(normals: Float64s, areas: Float64s, others: Int32s, rounds: int, averaged: Float64s) -> None:
    """Average normals (m, 3) over neighbours, by area and less across sharp edges, so many times."""
    before, sums = normals.copy(), np.empty(3)
    for _ in range(rounds):
        for triangle in range(areas.size):
            for axis in range(3):
                sums[axis] = areas[triangle] * before[triangle, axis]
            for side in range(3):
                other = others[triangle, side]
                if other < 0:
                    continue
                cosine = 0.0
                for axis in range(3):
                    cosine += before[triangle, axis] * before[other, axis]
                for axis in range(3):
                    sums[axis] += areas[other] * max(cosine, 0.0) ** _SHARP * before[other, axis]
            length = np.sqrt(sums[0] ** 2 + sums[1] ** 2 + sums[2] ** 2)
            if length > 0.0:
                for axis in range(3):
                    averaged[triangle, axis] = sums[axis] / length
        for triangle in range(areas.size):  # the whole at once compiles for 2 s more
            for axis in range(3):
                before[triangle, axis] = averaged[triangle, axis]


@kernel
def _smooth(rows: Int64s, others: Int32s, rounds: int, positions: Float64s) -> None:
    """Move positions (n, 3) toward the means of their neighbours, so many times; borders stay."""
    stays = np.zeros(len(positions), np.bool_)
    for triangle in range(len(rows)):
        for side in range(3):
            if others[triangle, side] < 0:
                stays[rows[triangle, side]] = stays[rows[triangle, (side + 1) % 3]] = True
    sums, counts = np.empty_like(positions), np.empty(len(positions))
    for _ in range(rounds):
        sums[:] = 0.0
        counts[:] = 0.0
        for triangle in range(len(rows)):
            for side in range(3):
                a, b = rows[triangle, side], rows[triangle, (side + 1) % 3]
                for axis in range(3):
                    sums[a, axis] += positions[b, axis]
                    sums[b, axis] += positions[a, axis]
                counts[a] += 1.0
                counts[b] += 1.0
        for n in range(len(positions)):
            if counts[n] > 0.0 and not stays[n]:
                for axis in range(3):
                    positions[n, axis] += _STEP * (sums[n, axis] / counts[n] - positions[n, axis])


@kernel
def _farthest_last(others: Int32s, charts: Int64s, own: Int64s) -> None:
    """Put a chart's triangles into the order of their steps from the first one."""
    chart, end = charts[own[0]], 0
    for start in own.copy():
        if charts[start] != chart:
            continue
        charts[start] = -1
        own[end] = start
        first, end = end, end + 1
        while first < end:
            for side in range(3):
                other = others[own[first], side]
                if other >= 0 and charts[other] == chart:
                    charts[other] = -1
                    own[end] = other
                    end += 1
            first += 1
    charts[own] = chart


@kernel
def _grow(
    others: Int32s,
    facings: Float64s,
    areas: Float64s,
    order: Int64s,
    least: float,
    count: int,
    charts: Int64s,
) -> int:
    """Grow charts from triangles in order, nearest first, over those that face about as their mean does."""
    queue = np.empty(charts.size, np.int64)
    for n in range(order.size):
        if charts[order[n]] >= 0:
            continue
        queue[0] = order[n]
        charts[order[n]] = count
        x = y = z = 0.0
        first, end = 0, 1
        while first < end:
            triangle = queue[first]
            first += 1
            x += areas[triangle] * facings[triangle, 0]
            y += areas[triangle] * facings[triangle, 1]
            z += areas[triangle] * facings[triangle, 2]
            length = least * np.sqrt(x * x + y * y + z * z)
            for side in range(3):
                other = others[triangle, side]
                if other < 0 or charts[other] >= 0:
                    continue
                along = x * facings[other, 0] + y * facings[other, 1] + z * facings[other, 2]
                if along >= length or areas[other] == 0.0:
                    charts[other] = count
                    queue[end] = other
                    end += 1
        count += 1
    return count


@kernel
def _grow_at_once(
    others: Int32s,
    facings: Float64s,
    areas: Float64s,
    middles: Float64s,
    axes: Float64s,
    seeds: Int64s,
    charts: Int64s,
) -> None:
    """Grow charts from a triangle each, by the shortest ways that do not turn from their axes; −1 is left."""
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
            other = others[triangle, side]
            if other < 0 or charts[other] >= 0:
                continue
            along = away = 0.0
            for axis in range(3):
                along += facings[other, axis] * axes[chart, axis]
                away += (middles[other, axis] - middles[triangle, axis]) ** 2
            if along < _WIDEST and areas[other] > 0.0:
                continue
            farther = cost + np.sqrt(away) * (1.0 + _BEND * (1.0 - along))
            if farther < costs[other]:
                costs[other] = farther
                heappush(waiting, (farther, np.int64(other), chart))
