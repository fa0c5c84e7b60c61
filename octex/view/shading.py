"""Normals of triangles, and smooth normals at their corners."""

from __future__ import annotations

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s, Integers
from octex.jit import kernel
from octex.source.vectors import cross_product, dot_product, edges_from, length_of, minus, plus, row_of, unit
from octex.source.welding import welded

#: Above this many triangles at one position, corners get the face normal: comparing all pairs is slow.
_MANY = 256


@kernel
def face_normals(positions: Float64s, triangles: Int32s) -> tuple[Float64s, Float64s]:
    """Return unit normals (m, 3), zeros for triangles without area, and areas (m,) of triangles (m, 3)."""
    normals, areas = np.empty((len(triangles), 3)), np.empty(len(triangles))
    for n in range(len(triangles)):
        normal = cross_product(*edges_from(positions, triangles, n))
        normals[n, 0], normals[n, 1], normals[n, 2] = unit(normal)
        areas[n] = length_of(normal) / 2.0
    return normals, areas


def corner_normals(positions: Float64s, triangles: Int32s, crease: float = 40.0) -> Float32s:
    """Return smooth unit normals (m, 3, 3) at the corners of triangles (m, 3).

    A corner's normal is the angle-weighted mean over the triangles at its position. Only normals within
    ``crease`` degrees of its own triangle's normal count (Thürmer & Wüthrich 1998).
    """
    rows = np.arange(len(triangles), dtype=np.int32)
    return _smoothed(positions, triangles, welded(positions), rows, crease)


def corner_normals_of(
    numbers: Integers, positions: Float64s, triangles: Int32s, crease: float = 40.0
) -> Float32s:
    """Return `corner_normals` (k, 3, 3) of the triangles ``numbers`` (k,), from their neighbours alone."""
    if not len(numbers):
        return np.empty((0, 3, 3), np.float32)
    is_ascending = bool((numbers[1:] > numbers[:-1]).all())
    ascending = (numbers if is_ascending else np.unique(numbers)).astype(np.int64)
    inside = np.flatnonzero(_inside(positions, triangles, ascending))
    point_of = np.full(len(positions), -1, np.int32)
    point_of[inside] = welded(positions[inside])
    neighbours, rows = _around(point_of, triangles, ascending)
    normals = _smoothed(positions, triangles[neighbours], point_of, rows, crease)
    return normals if is_ascending else normals[np.searchsorted(ascending, numbers)]


def _smoothed(
    positions: Float64s, triangles: Int32s, point_of: Int32s, rows: Int32s, crease: float
) -> Float32s:
    """Return the corner normals of triangles (m,) in output ``rows`` (m,), −1 for no output.

    ``point_of`` (n,) numbers the distinct positions of vertices; −1 for vertices that do not count.
    """
    faces, areas = face_normals(positions, triangles)
    angles = _angles(positions, triangles, areas)
    # Sorted by position, since vertices at one position may differ.
    by_point, starts = _corners_by_point(point_of, triangles)
    normals = np.empty((int(rows.max(initial=-1)) + 1, 3, 3), np.float32)
    cosines = np.cos(np.radians(crease)), np.cos(np.radians(crease / 2))
    _smooth(faces, angles.ravel(), by_point, starts, cosines, rows, normals)
    return normals


@kernel
def _inside(positions: Float64s, triangles: Int32s, chosen: Int64s) -> Bools:
    """Return which positions lie in the bounding box of the chosen triangles."""
    box = np.empty((2, 3), np.float64)
    box[0], box[1] = np.inf, -np.inf
    for n in range(chosen.size):
        for corner in range(3):
            for axis in range(3):
                coordinate = positions[triangles[chosen[n], corner], axis]
                box[0, axis], box[1, axis] = min(box[0, axis], coordinate), max(box[1, axis], coordinate)
    inside = np.zeros(len(positions), np.bool_)
    for n in range(len(positions)):
        is_in = True
        for axis in range(3):
            is_in = is_in and box[0, axis] <= positions[n, axis] <= box[1, axis]
        inside[n] = is_in
    return inside


@kernel
def _around(point_of: Int32s, triangles: Int32s, chosen: Int64s) -> tuple[Int32s, Int32s]:
    """Return all triangles that share a position with chosen ones, and their index in ``chosen`` or −1."""
    is_used = np.zeros(point_of.size + 1, np.bool_)  # the last entry is for the point −1
    for n in range(chosen.size):
        for corner in range(3):
            is_used[point_of[triangles[chosen[n], corner]]] = True
    for n in range(point_of.size):
        if point_of[n] >= 0 and not is_used[point_of[n]]:
            point_of[n] = -1
    neighbours = np.empty(len(triangles), np.int32)
    rows = np.empty(len(triangles), np.int32)
    count = at = 0
    for n in range(len(triangles)):
        if max(point_of[triangles[n, 0]], point_of[triangles[n, 1]], point_of[triangles[n, 2]]) >= 0:
            is_chosen = at < chosen.size and chosen[at] == n
            neighbours[count], rows[count] = n, at if is_chosen else -1
            at += is_chosen
            count += 1
    return neighbours[:count].copy(), rows[:count].copy()


@kernel
def _corners_by_point(point_of: Int32s, triangles: Int32s) -> tuple[Int32s, Int64s]:
    """Return triangle corners sorted by the point of their vertex, and the start of each point."""
    # Entry point + 1 moves from the start of the point to its end, which is the start of the next one.
    starts = np.zeros(point_of.size + 2, np.int64)
    for n in range(len(triangles)):
        for corner in range(3):
            starts[point_of[triangles[n, corner]] + 2] += 1
    starts[1] = 0  # of vertices without a point, −1
    for point in range(point_of.size):
        starts[point + 2] += starts[point + 1]
    corners = np.empty(triangles.size, np.int32)
    for n in range(len(triangles)):
        for corner in range(3):
            point = point_of[triangles[n, corner]]
            if point >= 0:
                corners[starts[point + 1]] = 3 * n + corner
                starts[point + 1] += 1
    return corners, starts[:-1]


@kernel
def _angles(positions: Float64s, triangles: Int32s, areas: Float64s) -> Float64s:
    """Return the angles at the corners (m, 3) of triangles with ``areas`` (m,)."""
    angles = np.empty((len(triangles), 3))
    for n in range(len(triangles)):
        for corner in range(3):
            apex = row_of(positions, triangles[n, corner])
            forward = minus(row_of(positions, triangles[n, (corner + 1) % 3]), apex)
            backward = minus(row_of(positions, triangles[n, (corner + 2) % 3]), apex)
            angles[n, corner] = np.arctan2(2.0 * areas[n], dot_product(forward, backward))
    return angles


@kernel
def _smooth(
    faces: Float64s,
    angles: Float64s,
    by_point: Int32s,
    starts: Int64s,
    cosines: tuple[float, float],
    rows: Int32s,
    normals: Float32s,
) -> None:
    """Write the corner normals of ``rows``; ``cosines`` are those of the crease angle and of half of it."""
    for point in range(len(starts) - 1):
        first, end = starts[point], starts[point + 1]
        if first == end:
            continue
        corners = by_point[first:end]
        mean = (0.0, 0.0, 0.0)
        for corner in corners:
            mean = plus(mean, row_of(faces, corner // 3), angles[corner])
        # If all normals lie within half the crease angle of the mean, each pair lies within the crease angle:
        # all corners then share the mean.
        least = cosines[1] * length_of(mean) * (1.0 + 1e-9)
        is_shared = corners.size <= _MANY
        for corner in corners:
            is_shared = is_shared and dot_product(mean, row_of(faces, corner // 3)) > least
        for corner in corners:
            row = rows[corner // 3]
            if row < 0:
                continue
            own_face = row_of(faces, corner // 3)
            total = mean if is_shared else own_face
            if not is_shared and corners.size <= _MANY:
                total = (0.0, 0.0, 0.0)
                for other in corners:
                    face = row_of(faces, other // 3)
                    if dot_product(own_face, face) >= cosines[0]:
                        total = plus(total, face, angles[other])
            normal = unit(total)
            for axis in range(3):
                normals[row, corner % 3, axis] = normal[axis]
