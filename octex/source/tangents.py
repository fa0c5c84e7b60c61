"""Frames of normals and tangents at the corners of triangles: the tangent space of normal maps.

Missing tangents are computed as MikkTSpace does (M. S. Mikkelsen, "Simulation of Wrinkled Surfaces
Revisited", 2008, and its mikktspace.c), as glTF 2.0 asks (3.7.2.1).
"""

from __future__ import annotations

import math

import numpy as np

from octex.arrays import Float32s, Float64s, Floats, Int32s, Integers
from octex.jit import inlined, kernel
from octex.source.corners import Corners, Frames, area_vectors
from octex.source.vectors import (
    Vector,
    between,
    cross_product,
    dot_product,
    edges_from,
    length_of,
    minus,
    plus,
    row_of,
    times,
    unit,
)  # fmt: skip
from octex.source.welding import welded


def corner_frames(
    positions: Float64s,
    triangles: Integers,
    normals: Corners | None,
    tangents: Corners | None,
    coordinates: Corners | None,
) -> Frames:
    """Return unit normals, and unit tangents with their handedness, at the corners of triangles.

    ``positions`` (n, 3), ``triangles`` (m, 3); ``normals`` (rows, 3), ``tangents`` (rows, 4) and
    ``coordinates`` (rows, 2), v running down. The bitangent, along which v decreases, is normal × tangent
    times the handedness, 1 or −1. Without normals triangles are flat, and tangents are ignored (3.7.2.1).
    Missing tangents point along u: corners of equal position, normal and coordinates share the mean of their
    triangles' directions, weighted by angles; mirrored triangles have separate means. Triangles without area
    take their neighbours'. Unlike in mikktspace.c, such corners need not be connected by edges.
    """
    flat = area_vectors(positions[triangles])
    flat = _unit(flat, np.broadcast_to([0.0, 0.0, 1.0], flat.shape))
    if normals is None:
        normals, tangents = Corners.of_triangles(flat.astype(np.float32), np.arange(len(triangles))), None
    else:
        normals = _mended(normals, np.broadcast_to(flat[:, None], (len(triangles), 3, 3)))
    if tangents is not None:
        mended = _mended(tangents, _perpendicular(normals.values)[normals.rows])
        return Frames(normals, mended)
    if coordinates is None:
        signed = np.ones((len(normals.values), 4), np.float32)
        signed[:, :3] = _perpendicular(normals.values)
        return Frames(normals, Corners(signed, normals.rows))
    keys = np.stack(
        [
            welded(positions)[triangles],
            welded(normals.values)[normals.rows],
            welded(coordinates.values)[coordinates.rows],
        ],
        axis=-1,
    )
    groups = welded(keys.reshape(-1, 3)).reshape(-1, 3)
    values = np.zeros((2 * (int(groups.max(initial=-1)) + 1), 4), np.float32)
    rows = np.empty((len(triangles), 3), np.int32)
    sums = np.zeros((len(values), 3))
    corners = np.ascontiguousarray(triangles, np.int32)
    _sum_tangents(positions, corners, normals, coordinates, groups, sums, rows)
    _finish_tangents(normals, groups, sums, rows, values)
    return Frames(normals, Corners(values, rows))


def carried(frames: Frames, triangles: Integers, before: Float64s, after: Float64s) -> Frames:
    """Return frames moved from one set of vertex positions (n, 3) to another, each corner by its triangle.

    Normals are scaled by the root of the ratio of areas, so that scaling alone keeps angles.
    """
    count = 3 * len(triangles)
    normals, tangents = np.empty((count, 3), np.float32), np.empty((count, 4), np.float32)
    _carry(frames, np.ascontiguousarray(triangles, np.int32), before, after, normals, tangents)
    rows = np.arange(count, dtype=np.int32).reshape(-1, 3)
    return Frames(Corners(normals, rows), Corners(tangents, rows))


def transformed(frames: Frames, linear: Float64s) -> Frames:
    """Return frames under a linear map (3, 3); one that mirrors inverts the handedness.

    Tangent and normal stay at right angles, as in glTF; a direction that becomes zero stays as it was.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        x, y, z = linear / np.abs(linear).max()
        # Cofactors instead of the inverse, which does not exist if a scale is zero.
        cofactors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)])
        side = -1.0 if cofactors[0] @ x < 0 else 1.0
        normals, tangents = frames.normals.values, frames.tangents.values.copy()
        tangents[:, :3] = _unit(tangents[:, :3] @ np.stack([x, y, z]).T, tangents[:, :3])
        tangents[:, 3] *= side
        normals = _unit(normals @ (side * cofactors).T, normals).astype(np.float32)
    return Frames(frames.normals._replace(values=normals), frames.tangents._replace(values=tangents))


def _unit(vectors: Floats, fallback: Floats) -> Float64s:
    """Return vectors (…, 3) at length 1; ``fallback`` for those without a direction."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        wide = vectors.astype(np.float64)
        largest = np.abs(wide).max(axis=-1, keepdims=True)
        wide /= largest  # squares must not overflow
        wide /= np.linalg.norm(wide, axis=-1, keepdims=True)
    return np.where(np.isfinite(wide).all(axis=-1, keepdims=True), wide, fallback)


def _perpendicular(normals: Floats) -> Float64s:
    """Return a unit vector at right angles to each unit normal (…, 3)."""
    # The axis farthest from the normal, minus its component along the normal.
    axis = np.eye(3)[np.abs(normals).argmin(axis=-1)]
    return _unit(axis - normals * (axis * normals).sum(axis=-1, keepdims=True), axis)


def _mended(corners: Corners, fallback: Floats) -> Corners:
    """Return unit vectors (rows, 3 or 4), or their corners' ``fallback`` (m, 3, 3) without direction."""
    values = np.ones(corners.values.shape, np.float32)
    unit = _unit(corners.values[:, :3], np.full(3, np.nan))
    broken = np.isnan(unit[:, 0])
    if broken.any():
        unit[broken] = (0.0, 0.0, 1.0)
        triangle, corner = np.nonzero(broken[corners.rows])
        unit[corners.rows[triangle, corner]] = fallback[triangle, corner]
    values[:, :3] = unit
    values[:, 3:][corners.values[:, 3:] < 0] = -1.0
    return Corners(values, corners.rows)


@inlined
def axes_at(frames: Frames, triangle: int, shares: Vector) -> tuple[Vector, Vector, Vector, float]:
    """Return tangent, normal × tangent and normal at a point of a triangle, and the handedness."""
    normals, tangents = frames
    normal = unit(between(normals.values, normals.rows, triangle, shares))
    tangent = between(tangents.values, tangents.rows, triangle, shares)
    tangent = unit(minus(tangent, times(normal, dot_product(normal, tangent))))
    hand = 1.0 if tangents.values[tangents.rows[triangle, 0], 3] >= 0.0 else -1.0
    return tangent, cross_product(normal, tangent), normal, hand


@inlined
def _in_plane(vector: Vector, normal: Vector) -> Vector:
    """Project a vector along a normal, and return a unit vector, or zeros."""
    along = minus(vector, times(normal, dot_product(vector, normal)))
    length = length_of(along)
    if not 0.0 < length < math.inf:
        return 0.0, 0.0, 0.0
    return along[0] / length, along[1] / length, along[2] / length


@kernel
def _sum_tangents(
    positions: Float64s, triangles: Int32s, normals: Corners, coordinates: Corners, groups: Int32s,
    sums: Float64s, rows: Int32s,
) -> None:  # fmt: skip
    """Sum the directions of u, one row for mirrored, one for other triangles of each group of corners.

    ``rows`` receives the row of each corner, −1 for triangles without such a direction.
    """
    for triangle in range(len(triangles)):
        e, f = edges_from(positions, triangles, triangle)
        uv = coordinates.values
        a, b, c = coordinates.rows[triangle, 0], coordinates.rows[triangle, 1], coordinates.rows[triangle, 2]
        u0, v0 = float(uv[a, 0]), float(uv[a, 1])
        eu, ev = float(uv[b, 0]) - u0, float(uv[b, 1]) - v0
        fu, fv = float(uv[c, 0]) - u0, float(uv[c, 1]) - v0
        area = eu * fv - fu * ev
        sign = 1.0 if area > 0.0 else -1.0
        # The directions of u and v: the inverse of the map from the edges to the image, up to its scale.
        s = (sign * (fv * e[0] - ev * f[0]), sign * (fv * e[1] - ev * f[1]), sign * (fv * e[2] - ev * f[2]))
        t = (eu * f[0] - fu * e[0], eu * f[1] - fu * e[1], eu * f[2] - fu * e[2])
        distinct = dot_product(e, e) > 0.0 and dot_product(f, f) > 0.0 and e != f
        usable = 0.0 < abs(area) < math.inf and dot_product(s, s) > 0.0 and dot_product(t, t) > 0.0
        if not (distinct and usable):
            rows[triangle] = -1
            continue
        edges = (e, minus(f, e), times(f, -1.0))
        for corner in range(3):
            normal = row_of(normals.values, normals.rows[triangle, corner])
            one, other = edges[corner], times(edges[(corner + 2) % 3], -1.0)
            cosine = dot_product(_in_plane(one, normal), _in_plane(other, normal))
            angle = math.acos(min(max(cosine, -1.0), 1.0))
            x, y, z = _in_plane(s, normal)
            row = 2 * groups[triangle, corner] + (1 if sign < 0.0 else 0)
            rows[triangle, corner] = row
            sums[row, 0] += angle * x
            sums[row, 1] += angle * y
            sums[row, 2] += angle * z


@kernel
def _finish_tangents(
    normals: Corners, groups: Int32s, sums: Float64s, rows: Int32s, values: Float32s
) -> None:
    """Turn sums into unit tangents with handedness; triangles without rows get their neighbours' rows."""
    for triangle in range(len(rows)):
        if rows[triangle, 0] < 0:
            side = -1
            for corner in range(3):
                for candidate in (1, 0):
                    total = row_of(sums, 2 * groups[triangle, corner] + candidate)
                    if side < 0 and dot_product(total, total) > 0.0:
                        side = candidate
            for corner in range(3):
                rows[triangle, corner] = 2 * groups[triangle, corner] + (1 if side < 0 else side)
        for corner in range(3):
            row = rows[triangle, corner]
            normal = row_of(normals.values, normals.rows[triangle, corner])
            x, y, z = _in_plane(row_of(sums, row), normal)
            if x == 0.0 and y == 0.0 and z == 0.0:
                a, b, c = abs(normal[0]), abs(normal[1]), abs(normal[2])
                axis = 0 if a <= b and a <= c else 1 if b <= c else 2
                along = (1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0, 1.0 if axis == 2 else 0.0)
                x, y, z = _in_plane(along, normal)
            values[row, 0], values[row, 1], values[row, 2] = x, y, z
            values[row, 3] = 1.0 if row % 2 else -1.0


@inlined
def _store(values: Float32s, row: int, vector: Vector, fallback: Vector) -> None:
    """Write a vector at length 1, or ``fallback`` if it has no direction."""
    length = length_of(vector)
    x, y, z = times(vector, 1.0 / length) if 0.0 < length < math.inf else fallback
    values[row, 0], values[row, 1], values[row, 2] = x, y, z


@kernel
def _carry(
    frames: Frames, triangles: Int32s, before: Float64s, after: Float64s, normals: Float32s,
    tangents: Float32s,
) -> None:  # fmt: skip
    """Write the moved normals (3m, 3) and tangents (3m, 4), corner by corner."""
    for triangle in range(len(triangles)):
        e, f = edges_from(before, triangles, triangle)
        new_e, new_f = edges_from(after, triangles, triangle)
        cross, new_cross = cross_product(e, f), cross_product(new_e, new_f)
        area, new_area = length_of(cross), length_of(new_cross)  # twice the area
        usable = 0.0 < area < math.inf and 0.0 < new_area < math.inf
        for corner in range(3):
            normal = row_of(frames.normals.values, frames.normals.rows[triangle, corner])
            source = frames.tangents.rows[triangle, corner]
            tangent = row_of(frames.tangents.values, source)
            moved_normal, moved_tangent = normal, tangent
            if usable:
                # The edges, and a normal as long as the root of the area, are a basis. A tangent keeps its
                # components, its products with the dual basis; a shading normal keeps its products with the
                # basis, and so its right angle to tangents. Both are too long by a power of an area.
                root = 1.0 / (math.sqrt(area) * math.sqrt(new_area))
                moved_tangent = times(new_e, dot_product(tangent, cross_product(f, cross)) / area)
                share = dot_product(tangent, cross_product(cross, e)) / area
                moved_tangent = plus(moved_tangent, new_f, share)
                moved_tangent = plus(moved_tangent, new_cross, dot_product(tangent, cross) * root)
                moved_normal = times(cross_product(new_f, new_cross), dot_product(normal, e) / new_area)
                share = dot_product(normal, f) / new_area
                moved_normal = plus(moved_normal, cross_product(new_cross, new_e), share)
                moved_normal = plus(moved_normal, new_cross, dot_product(normal, cross) * root)
            row = 3 * triangle + corner
            _store(normals, row, moved_normal, normal)
            _store(tangents, row, moved_tangent, tangent)
            tangents[row, 3] = frames.tangents.values[source, 3]
