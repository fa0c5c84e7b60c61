"""Polygons as triangles: fans where one corner sees all of a polygon, manifold3d's ear clipping elsewhere."""

from __future__ import annotations

import numpy as np

from octex.arrays import Bools, Float64s, Int64s
from octex.jit import inlined, kernel
from octex.source.corners import Polygons
from octex.source.vectors import Vector, cross_product, dot_product, minus, row_of


def triangulate(positions: Float64s, corners: Int64s, sizes: Int64s) -> tuple[Int64s, Int64s]:
    """Cut polygons into triangles.

    ``corners`` are rows of ``positions``, all in range, polygon after polygon, of ``sizes`` corners each.
    Returns triangles (m, 3) as indices into ``corners``, and the polygon of each (m,): n − 2 for one of n
    corners, none for fewer than three. A polygon stays as it winds. Convex ones become fans from their first
    corner.
    """
    if len(sizes) and (sizes == 3).all():
        return np.arange(len(corners)).reshape(-1, 3), np.arange(len(sizes))
    counts = np.maximum(sizes - 2, 0)
    triangles = np.empty((int(counts.sum()), 3), np.int64)
    lacking = np.zeros(len(sizes), np.bool_)
    _fans(positions, corners, sizes, triangles, lacking)
    firsts, ends = np.cumsum(sizes) - sizes, np.cumsum(counts)
    for polygon in np.flatnonzero(lacking).tolist():
        first, size, end = firsts[polygon], sizes[polygon], ends[polygon]
        cut = _ears(positions[corners[first : first + size]])
        if len(cut) == size - 2:
            triangles[end - size + 2 : end] = first + cut
    return triangles, np.repeat(np.arange(len(sizes)), counts)


def cut_polygons(corners: Int64s, polygons: Int64s, sizes: Int64s) -> Polygons | None:
    """Return what ``triangulate`` returned as a mesh keeps it; None where each polygon was a triangle."""
    if (sizes == 3).all():
        return None
    within = corners - (np.cumsum(sizes) - sizes)[polygons, None]
    return Polygons(polygons.astype(np.int32), within.astype(np.int32))


def _ears(outline: Float64s) -> Int64s:
    """Return the triangles (m, 3) of a polygon (n, 3), by its area vector; none if it has no extent."""
    from manifold3d import triangulate  # takes 6 ms

    low = outline.min(axis=0)
    with np.errstate(all="ignore"):
        outline = (outline - low) / (outline - low).max()
        after = np.roll(outline, -1, axis=0)
        normal = np.cross(outline, after).sum(axis=0)
    if not np.isfinite(outline).all():
        return np.empty((0, 3), np.int64)
    # Without one axis the coordinates stay as they are: corners at one place stay at one.
    axis = int(np.abs(normal).argmax())
    across, up = (axis + 1) % 3, (axis + 2) % 3
    plane = [across, up] if normal[axis] >= 0 else [up, across]
    return np.asarray(triangulate([np.ascontiguousarray(outline[:, plane])]), np.int64).reshape(-1, 3)


@kernel
def _fans(positions: Float64s, corners: Int64s, sizes: Int64s, triangles: Int64s, lacking: Bools) -> None:
    """Cut each polygon into a fan; say in ``lacking`` where that may cover what is outside of it.

    A polygon with one reflex corner is the union of two convex ones that share it: a fan from there is right.
    """
    first = 0
    done = 0
    for polygon in range(len(sizes)):
        size = sizes[polygon]
        apex = 0
        if size > 3:
            apex = _apex(positions, corners, first, size)
            lacking[polygon] = apex < 0
            apex = max(apex, 0)
        for i in range(size - 2):
            triangles[done + i, 0] = first + apex
            triangles[done + i, 1] = first + (apex + i + 1) % size
            triangles[done + i, 2] = first + (apex + i + 2) % size
        done += max(size - 2, 0)
        first += size


@kernel
def _apex(positions: Float64s, corners: Int64s, first: int, size: int) -> int:
    """Return the reflex corner of a polygon, 0 if it has none, −1 if it has several or turns right back.

    A quad with two crosses itself, however it is cut.
    """
    normal = (0.0, 0.0, 0.0)  # twice the area vector, by Newell's method
    for i in range(size):
        a = row_of(positions, corners[first + i])
        b = row_of(positions, corners[first + (i + 1) % size])
        normal = (
            normal[0] + (a[1] - b[1]) * (a[2] + b[2]),
            normal[1] + (a[2] - b[2]) * (a[0] + b[0]),
            normal[2] + (a[0] - b[0]) * (a[1] + b[1]),
        )
    last = size - 1
    edge = _edge(positions, corners, first, size, last)
    while last > 0 and edge[0] == edge[1] == edge[2] == 0.0:
        last -= 1
        edge = _edge(positions, corners, first, size, last)
    apex = 0
    reflex = 0
    for i in range(size):
        to = _edge(positions, corners, first, size, i)
        if to[0] == to[1] == to[2] == 0.0:  # two corners at one place turn once
            continue
        turn = dot_product(cross_product(edge, to), normal)
        if turn < 0.0:
            apex = i
            reflex += 1
        elif turn == 0.0 and dot_product(edge, to) < 0.0:
            return -1
        edge = to
    return apex if reflex <= 1 or size == 4 else -1


@inlined
def _edge(positions: Float64s, corners: Int64s, first: int, size: int, i: int) -> Vector:
    """Return the way from a corner of a polygon to the next."""
    next_one = row_of(positions, corners[first + (i + 1) % size])
    return minus(next_one, row_of(positions, corners[first + i]))
