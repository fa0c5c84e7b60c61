"""Charts for meshes that nobody has modelled: pieces that face about one way, laid flat by projection.

Normals are averaged over neighbours first, so that noise does not tear charts apart. Charts grow within a
cone of normals from one triangle after the other, then all at once from their middles, as those of
Cohen-Steiner, Alliez and Desbrun (2004) do. Neighbours are merged while they face about one way.
"""

from __future__ import annotations

from heapq import heappop, heappush
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float64s, Int32s, Int64s
from octex.baking.layout import doubled_areas, neighbors_of, steps_between
from octex.jit import kernel, part
from octex.source.corners import area_vectors, unit
from octex.source.mesh import Mesh
from octex.source.welding import first_equal

#: The longest side of the model in the map that charts are laid flat in.
SIDE = 1024.0
#: The least cosine between averaged normals and a chart's axis, where charts grow one by one and at once.
_LEAST, _WIDEST = 0.6, 0.5
#: Charts are merged while their axis shows so much of their area, and triangles lie within this angle;
#: those of less than this doubled area within a larger one alone.
_SHOWN, _MERGED = 0.8, np.radians(65.0)
_SMALL, _MERGED_SMALL = 2.0 * 256.0 / SIDE**2, np.radians(78.0)
#: Charts of less than this doubled area, and this part of their connected mesh, are merged anyhow.
_TINY, _TINY_PART = 2.0 * 16.0 / SIDE**2, 0.01
#: Directions are counted in so many bins a side of a cube's faces.
_BINS = 6
#: Pairs of charts of which angles are found at once.
_PAIRS = 16_384
#: How often charts grow from their middles.
_ROUNDS = 2
#: How much longer the way to a triangle is that faces at right angles to the chart's axis.
_BEND = 2.0
#: Normals are averaged over this part of the model's longest side, in at most so many rounds.
_AVERAGED, _MOST_AVERAGED = 0.02, 25
#: The power of the cosine between normals with which they average.
_SHARP = 2
#: Around folds the surface is smoothed so often, then the chart.
_PASSED, _RELAXED = 3, 4
#: What shows less than this part of its area is on edge; where that is little, it may show so much less.
_ON_EDGE, _LEAST_SHOWN = 0.3, 0.02
#: What is cut out takes in so many rings of triangles around, while it is tiny.
_WIDENED = 4
#: How far a position moves to the mean of its neighbours at once.
_STEP = 0.6
#: Overlaps are looked for at so many points a side, and are there if a chart covers so much twice.
_PROBE, _OVERLAPPING = 256, 0.01
#: Where these points lie in their squares.
_ASIDE = 0.4142135, 0.7320508
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


class Flat(NamedTuple):
    """Triangles laid flat."""

    corners: Float64s  # (m, 3, 2)   y down; charts lie over each other
    charts: Int32s  # (m,)   connected, counting from 0
    edges: Bools  # (m, 3)   which sides are edges of charts


def laid_flat(mesh: Mesh) -> Flat:
    """Lay a mesh flat, `SIDE` for its longest side."""
    low, high = mesh.bounds
    rows = first_equal(mesh.rest)[mesh.triangles]
    positions = (mesh.rest - low) / (float((high - low).max()) or 1.0)
    corners = positions[rows]
    crosses = area_vectors(corners)
    areas, normals = np.linalg.norm(crosses, axis=1), unit(crosses)
    others, _ = neighbors_of(rows)
    side = max(float(np.sqrt(areas @ areas / max(areas.sum(), 1e-300))), 1e-9)  # of triangles, by area
    facings = normals.copy()
    _average(normals, areas, others, min(int((_AVERAGED / side) ** 2), _MOST_AVERAGED), facings)
    pieces = _Pieces(corners, others, areas, normals, facings)
    flat, charts = _unfolded(pieces, rows, positions, _clustered(pieces))
    flat, charts = _without_overlaps(pieces, flat, charts)
    charts = _connected(others, charts)
    return Flat(flat, charts.astype(np.int32), (others < 0) | (charts[others] != charts[:, None]))


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
        seeds = _least(charts, apart, count)
        _grow_at_once(others, facings, areas, middles, axes, seeds, charts)
        is_taken = charts >= 0
        charts[is_taken] = _numbered(charts[is_taken])
        first = int(charts.max()) + 1
        count = _grow(others, facings, areas, np.flatnonzero(~is_taken), _LEAST, first, charts)
    return _merged(pieces, charts)


def _axes(pieces: _Pieces, charts: Int64s) -> Float64s:
    """Return the mean normals of charts (n, 3)."""
    return unit(_sums(charts, pieces.normals * pieces.areas[:, None]))


def _sums(charts: Int64s, values: Float64s) -> Float64s:
    return np.stack([np.bincount(charts, column) for column in values.T], axis=1)


def _merged(pieces: _Pieces, charts: Int64s) -> Int64s:
    """Merge charts with the neighbour along the longest border while their triangles face about one way."""
    _, others, areas, _, facings = pieces
    sums, sizes = _sums(charts, facings * areas[:, None]), np.bincount(charts, areas)
    bins, directions = _binned(facings)
    counts = np.bincount(charts * len(directions) + bins, areas > 0.0, sizes.size * len(directions))
    shares = counts.reshape(sizes.size, -1) > 0.0  # which ways each chart faces
    triangles, sides = np.nonzero((others >= 0) & (charts[others] != charts[:, None]))
    one, two = charts[triangles], charts[others[triangles, sides]]
    ends = pieces.corners[triangles, sides], pieces.corners[triangles, (sides + 1) % 3]
    borders = np.linalg.norm(ends[1] - ends[0], axis=1)
    whole = _connected(others, np.zeros_like(charts))
    tiny = np.empty(sizes.size)
    tiny[charts] = np.minimum(_TINY, _TINY_PART * np.bincount(whole, areas))[whole]
    made = np.arange(sizes.size)  # of the charts that there were
    while True:
        pairs, rows = np.unique(one * sizes.size + two, return_inverse=True)
        borders = np.bincount(rows, borders, pairs.size)
        one, two = pairs // sizes.size, pairs % sizes.size
        both = sums[one] + sums[two]
        is_shown = np.linalg.norm(both, axis=1) >= _SHOWN * (sizes[one] + sizes[two])
        is_small = np.minimum(sizes[one], sizes[two]) < _SMALL
        fits = (sizes < tiny)[one] | (sizes < tiny)[two]
        some = np.flatnonzero((is_shown | is_small) & ~fits)
        widest = _widest(unit(both[some]), shares, one[some], two[some], directions)
        fits[some] = (widest <= _MERGED) & is_shown[some] | (widest <= _MERGED_SMALL) & is_small[some]
        order = np.flatnonzero(fits)
        if not order.size:
            return made[charts]
        order = order[np.lexsort((two[order], -borders[order], one[order]))]
        firsts = order[np.flatnonzero(np.diff(one[order], prepend=-1))]
        best = np.full(sizes.size, -1)
        best[one[firsts]] = two[firsts]
        numbers = np.arange(sizes.size)
        is_mutual = (best >= 0) & (best[best] == numbers) & (numbers > best)
        numbers[is_mutual] = best[is_mutual]
        numbers = _numbered(numbers)
        made = numbers[made]
        last = np.flatnonzero(~is_mutual)
        first, second = best[is_mutual], np.flatnonzero(is_mutual)
        for each in (sums, sizes):
            each[first] += each[second]
        shares[first] |= shares[second]
        tiny[first] = np.minimum(tiny[first], tiny[second])
        sums, sizes, shares, tiny = sums[last], sizes[last], shares[last], tiny[last]
        one, two = numbers[one], numbers[two]
        is_border = one != two
        one, two, borders = one[is_border], two[is_border], borders[is_border]


def _binned(directions: Float64s) -> tuple[Int64s, Float64s]:
    """Return the bin of each direction (m,), and the middle of each bin (n, 3): squares on a cube's faces."""
    axes = np.abs(directions).argmax(axis=1)
    along = np.take_along_axis(directions, axes[:, None], axis=1)[:, 0]
    scale = _BINS / 2.0 / np.maximum(np.abs(along), 1e-300)
    faces = 2 * axes + (along < 0.0)
    squares = [
        np.clip(
            (np.choose((axes + k) % 3, directions.T) * scale + _BINS / 2.0).astype(np.int64), 0, _BINS - 1
        )
        for k in (1, 2)
    ]
    middles = np.empty((6, _BINS, _BINS, 3))
    across = (np.arange(_BINS) + 0.5) * 2.0 / _BINS - 1.0
    for face in range(6):
        middles[face, ..., face // 2] = 1.0 - 2.0 * (face % 2)
        middles[face, ..., (face // 2 + 1) % 3] = across[:, None]
        middles[face, ..., (face // 2 + 2) % 3] = across
    return (faces * _BINS + squares[0]) * _BINS + squares[1], unit(middles.reshape(-1, 3))


def _widest(axes: Float64s, shares: Bools, one: Int64s, two: Int64s, directions: Float64s) -> Float64s:
    """Return the angle from an axis each (n, 3) within which two charts (n,) face."""
    found = np.empty(one.size)
    for first in range(0, one.size, _PAIRS):
        some = slice(first, first + _PAIRS)
        dots = np.where(shares[one[some]] | shares[two[some]], axes[some] @ directions.T, 1.0)
        found[some] = np.arccos(np.clip(dots.min(axis=1), -1.0, 1.0))
    return found


def _numbered(charts: Int64s) -> Int64s:
    """Return numbers for charts (m,) from 0 up, in their order."""
    numbers: Int64s = (np.cumsum(np.bincount(charts) > 0) - 1)[charts]
    return numbers


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


def _unfolded(pieces: _Pieces, rows: Int64s, positions: Float64s, charts: Int64s) -> tuple[Float64s, Int64s]:
    """Project charts, laid flat where they fold as a smoother surface lies; what folds even then is cut out.

    Triangles that fold change to a neighbour's chart if that shows them.
    """
    corners, others, areas = pieces.corners, pieces.others, pieces.areas
    axes = _axes(pieces, charts)
    flat = _projected(corners, axes[charts])
    folded = _folded(corners, flat)
    for n in range(_PASSED):
        own = np.flatnonzero(folded)
        before = charts.copy()
        _pass_on(others, unit(area_vectors(positions[rows[own]])), axes, own, charts)
        _absorb(others, areas, charts)
        some, near = _around(rows, folded | (charts != before), len(positions), n)
        _smooth(rows[some], others[some], near, 2, positions)
        flat[some] = _projected(positions[rows[some]], axes[charts[some]])
        folded[some] = _folded(corners[some], flat[some])
    for n in range(_RELAXED):
        if not folded.any():
            break
        some, _ = _around(rows, folded, len(positions), n + 1)
        keys = charts[some, None] * len(positions) + rows[some]
        known, numbers = np.unique(keys, return_inverse=True)
        places = np.empty((known.size, 2))
        numbers = numbers.reshape(-1, 3)
        places[numbers] = flat[some]
        _, near = _around(numbers, folded[some], known.size, n)
        joined = np.where(charts[others[some]] == charts[some, None], others[some], -1)
        _smooth(numbers, joined, near, 4, places)
        flat[some] = places[numbers]
        folded[some] = _folded(corners[some], flat[some])
    folded = _cut(pieces, flat, folded, charts)
    flat[folded] = _projected(corners[folded], _axes(pieces, charts)[charts[folded]])
    return flat, charts


def _around(rows: Int64s, chosen: Bools, count: int, rings: int) -> tuple[Int64s, Bools]:
    """Return the vertices (n,) of chosen triangles and of so many rings around, and all triangles there."""
    near = np.zeros(count, np.bool_)
    near[rows[chosen]] = True
    for _ in range(rings):
        near[rows[near[rows].any(axis=1)]] = True
    return np.flatnonzero(near[rows].any(axis=1)), near


def _cut(pieces: _Pieces, flat: Float64s, folded: Bools, charts: Int64s) -> Bools:
    """Make charts of what folds, and of some of what lies around; return what these are of.

    Few triangles on edge stay.
    """
    _, others, areas, normals, _ = pieces
    upside = folded & (doubled_areas(flat) >= -_LEAST_SHOWN * SIDE**2 * areas)
    groups = _connected(others, folded.astype(np.int64))
    is_cut = folded & ((np.bincount(groups, areas)[groups] >= _TINY) | upside)
    count = int(charts.max()) + 1
    cut = np.where(is_cut, -1, charts)
    end = _grow(others, normals, areas, np.flatnonzero(is_cut), _LEAST, count, cut)
    for _ in range(_WIDENED):
        is_new = cut >= count
        sizes = np.bincount(cut[is_new] - count, areas[is_new], end - count)
        own = np.flatnonzero(~is_new & ((others >= 0) & is_new[others]).any(axis=1))
        if not own.size:
            break
        axes = unit(_sums(cut[is_new] - count, normals[is_new] * areas[is_new, None]))
        nearby = np.where(others[own] >= 0, cut[others[own]], -1) - count
        is_none, nearby = nearby < 0, np.maximum(nearby, 0)
        shown = np.einsum("mx,mkx->mk", normals[own], axes[nearby])
        shown[is_none | (sizes[nearby] >= _TINY)] = -1.0
        best = shown.argmax(axis=1)
        joins = np.take_along_axis(shown, best[:, None], axis=1)[:, 0] > _LEAST
        cut[own[joins]] = nearby[joins, best[joins]] + count
    charts[:] = cut
    return cut >= count


def _absorb(others: Int32s, areas: Float64s, charts: Int64s) -> None:
    """Give tiny pieces of charts to the chart that they have most sides with."""
    groups = _connected(others, charts)
    is_tiny = (np.bincount(groups, areas) < _TINY)[groups]
    nearby = charts[others]
    triangles, sides = np.nonzero(is_tiny[:, None] & (others >= 0) & (nearby != charts[:, None]))
    pairs, counts = np.unique(
        groups[triangles] * (int(charts.max()) + 1) + nearby[triangles, sides], return_counts=True
    )
    one, two = np.divmod(pairs, int(charts.max()) + 1)
    order = np.lexsort((two, -counts, one))
    firsts = order[np.flatnonzero(np.diff(one[order], prepend=-1))]
    chosen = np.full(int(groups.max()) + 1, -1)
    chosen[one[firsts]] = two[firsts]
    is_moved = chosen[groups] >= 0
    charts[is_moved] = chosen[groups[is_moved]]


def _pass_on(others: Int32s, normals: Float64s, axes: Float64s, own: Int64s, charts: Int64s) -> None:
    """Give some triangles, of these normals, to the neighbour's chart that shows them best."""
    nearby = charts[others[own]]
    shown = np.einsum("mx,mkx->mk", normals, axes[nearby])
    shown[others[own] < 0] = -1.0
    best = shown.argmax(axis=1)
    every = np.arange(own.size)
    is_better = shown[every, best] > np.einsum("mx,mx->m", normals, axes[charts[own]])
    charts[own[is_better]] = nearby[every, best][is_better]


def _without_overlaps(pieces: _Pieces, flat: Float64s, charts: Int64s) -> tuple[Float64s, Int64s]:
    """Halve charts that overlap themselves until none does; in the end their triangles lie apart."""
    charts = _connected(pieces.others, charts)
    order = np.argsort(charts, kind="stable")
    starts = np.append(np.flatnonzero(np.diff(charts[order], prepend=-1)), charts.size)
    doubted = [order[first:end] for first, end in pairwise(starts.tolist())]
    count = len(doubted)
    for n in range(_MOST_HALVED + 1):
        doubted = [own for own in doubted if _overlaps(flat[own])]
        halves = []
        for own in doubted:
            if n == _MOST_HALVED:
                charts[own[1:]] = count + np.arange(own.size - 1)
                count += own.size - 1
                flat[own] = _projected(pieces.corners[own], pieces.normals[own])
                continue
            _farthest_last(pieces.others, charts, own)
            _farthest_last(pieces.others, charts, own[::-1])
            half = own.size // 2
            charts[own[:half]] = count
            count += 1
            halves += [own[:half], own[half:]]
        doubted = halves
    return flat, charts


def _overlaps(flat: Float64s) -> bool:
    """Say whether a chart's triangles (m, 3, 2) overlap."""
    if len(flat) < 2 or (len(flat) <= _FEW and not _cross(flat)):
        return False
    corners = flat - flat.min(axis=(0, 1))
    corners *= _PROBE / max(float(corners.max()), 1e-300)
    return bool(_twice(corners) > _OVERLAPPING * np.abs(doubled_areas(corners)).sum() / 2.0)


@kernel
def _twice(corners: Float64s) -> int:
    """Return how many points of a grid are covered again by triangles (m, 3, 2)."""
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
def _least(charts: Int64s, values: Float64s, count: int) -> Int64s:
    """Return the triangle of the least value in each chart."""
    found = np.full(count, -1, np.int64)
    for triangle in range(charts.size):
        best = found[charts[triangle]]
        if best < 0 or values[triangle] < values[best]:
            found[charts[triangle]] = triangle
    return found


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
def _smooth(rows: Int64s, others: Int32s, near: Bools, rounds: int, positions: Float64s) -> None:
    """Move positions (n, 3 or 2) that are ``near`` toward the means of their neighbours; borders stay."""
    for triangle in range(len(rows)):
        for side in range(3):
            if others[triangle, side] < 0:
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


@kernel
def _connected(others: Int32s, charts: Int64s) -> Int64s:
    """Return the connected piece of a chart that each triangle (m,) is in, counting from 0."""
    numbers, queue = np.full(charts.size, -1, np.int64), np.empty(charts.size, np.int64)
    count = 0
    for start in range(charts.size):
        if numbers[start] >= 0:
            continue
        queue[0] = start
        numbers[start] = count
        first, end = 0, 1
        while first < end:
            triangle = queue[first]
            first += 1
            for side in range(3):
                other = others[triangle, side]
                if other >= 0 and numbers[other] < 0 and charts[other] == charts[start]:
                    numbers[other] = count
                    queue[end] = other
                    end += 1
        count += 1
    return numbers


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
