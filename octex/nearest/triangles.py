"""The point of a triangle mesh that is nearest to a point."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Int64s
from octex.errors import ModelError
from octex.jit import inlined, kernel, nearest_box, squares_to_boxes, trailing_zeros
from octex.nearest.boxes import (
    Boxes,
    NodeCache,
    Search,
    Sought,
    agrees,
    begin,
    boxes_of,
    cache_around,
    is_cached,
    local,
    morton_order,
    new_node_cache,
    new_search,
    next_node,
    reach,
)

#: Triangles with an area below this part of their longest edge squared are left out.
_THINNEST = 1e-12


class Nearest(NamedTuple):
    """The nearest surface point of each query."""

    triangles: Int32s  # (n,)   −1: none within the distance
    barycentric: Float64s  # (n, 3)   of the point on the triangle
    squares: Float64s  # (n,)   squared distance; infinity for none


class Triangles(NamedTuple):
    """A searchable mesh."""

    boxes: Boxes
    order: Int64s  # (triangles,)   their original numbers, in the boxes' order
    corners: Float64s  # (triangles, 9)   in the boxes' order: the first corner, and the vectors to the others
    normals: Float32s  # (triangles, 3)   unit length, in the boxes' order
    width: float  # typical size of a triangle

    @classmethod
    def of(cls, vertices: Float64s, faces: Int32s) -> Triangles:
        """Build from triangles (m, 3) of vertices (n, 3); those without area are left out.

        Raises ModelError if none has area.
        """
        corners = vertices[faces]
        low, high = corners.min(axis=1), corners.max(axis=1)
        crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(crosses, axis=1)
        has_area = lengths > _THINNEST * ((high - low) ** 2).sum(axis=1)
        normals = np.zeros_like(crosses, np.float32)
        normals[has_area] = crosses[has_area] / lengths[has_area, None]
        numbers = np.flatnonzero(has_area)
        if not numbers.size:
            raise ModelError("all triangles are degenerate; there is no surface to search")
        order = numbers[morton_order((low + high)[numbers])]
        width = float(np.median((high - low)[order].max(axis=1)))
        rows = corners[order]
        rows[:, 1:] -= rows[:, :1]
        return cls(boxes_of(low[order], high[order]), order, rows.reshape(-1, 9), normals[order], width)

    def nearest(
        self,
        points: Float64s,
        directions: Float64s | None = None,
        *,
        distance: float = np.inf,
        least_cosine: float = -1.0,
    ) -> Nearest:
        """Find the nearest surface point of points (n, 3), within ``distance``.

        With unit ``directions`` (n, 3), only triangles count whose normal's cosine to the direction is at
        least ``least_cosine``. At equal distance the first triangle wins.
        """
        result = Nearest(np.empty(len(points), np.int32), np.empty((len(points), 3)), np.empty(len(points)))
        facing = np.empty((0, 3)) if directions is None else directions
        _nearest(self, points, facing, float(distance), float(least_cosine), *result)
        return result


@inlined
def _on_triangle(corners: Float64s, row: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the squared distance of a point and a triangle, and the nearest point's second and third weight.

    (Ericson, Real-Time Collision Detection, 2005, 5.1.5.)
    """
    ax, ay, az = x - corners[row, 0], y - corners[row, 1], z - corners[row, 2]
    ux, uy, uz = corners[row, 3], corners[row, 4], corners[row, 5]
    wx, wy, wz = corners[row, 6], corners[row, 7], corners[row, 8]
    d1, d2 = ux * ax + uy * ay + uz * az, wx * ax + wy * ay + wz * az
    uu, uw, ww = ux * ux + uy * uy + uz * uz, ux * wx + uy * wy + uz * wz, wx * wx + wy * wy + wz * wz
    d3, d4 = d1 - uu, d2 - uw  # from b
    d5, d6 = d1 - uw, d2 - ww  # from c
    of_c, of_b, of_a = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if d1 <= 0.0 and d2 <= 0.0:
        p, q = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        p, q = 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        p, q = 0.0, 1.0
    elif of_c <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        p, q = d1 / (d1 - d3), 0.0
    elif of_b <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        p, q = 0.0, d2 / (d2 - d6)
    elif of_a <= 0.0 and d4 >= d3 and d5 >= d6:
        q = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        p = 1.0 - q
    else:
        total = of_a + of_b + of_c
        p, q = of_b / total, of_c / total
    rx, ry, rz = ax - p * ux - q * wx, ay - p * uy - q * wy, az - p * uz - q * wz
    return rx * rx + ry * ry + rz * rz, p, q


Best = tuple[float, int, float, float]


@inlined
def _best_in(mesh: Triangles, node: int, near: np.uint64, sought: Sought, best: Best) -> Best:
    """Return the nearer of ``best`` (square, row, weights) and the triangles in a node."""
    square, chosen, p, q = best
    while near != np.uint64(0):
        child = trailing_zeros(near)
        near &= near - np.uint64(1)
        row = node * 8 + child
        if row == chosen or not agrees(mesh.normals, row, sought):
            continue
        far, of_b, of_c = _on_triangle(mesh.corners, row, *sought.point)
        if far < square or (far == square and (chosen < 0 or mesh.order[row] < mesh.order[chosen])):
            square, chosen, p, q = far, row, of_b, of_c
    return square, chosen, p, q


@inlined
def _best_cached(mesh: Triangles, search: Search, cache: NodeCache, sought: Sought, best: Best) -> Best:
    """Return the nearer of ``best`` and the triangles in the cached nodes."""
    x, y, z, slack = sought.local
    i, j, k = np.float32(x), np.float32(y), np.float32(z)
    bound = reach(best[0], slack)
    bounds = mesh.boxes.bounds
    # Start with the triangle of the nearest box: it is mostly the result, and excludes most others.
    first = nearest_box(bounds, cache.nodes, cache.filled[0], i, j, k)
    if first >= 0:
        best = _best_in(mesh, first >> 3, np.uint64(1) << np.uint64(first & 7), sought, best)
        bound = reach(best[0], slack)
    for row in range(cache.filled[0]):
        near = squares_to_boxes(bounds, cache.nodes[row], i, j, k, bound, search.children)
        if near != np.uint64(0):
            best = _best_in(mesh, cache.nodes[row], near, sought, best)
            bound = reach(best[0], slack)
    return best


@inlined
def _best_of_all(mesh: Triangles, search: Search, sought: Sought, best: Best) -> Best:
    """Return the nearer of ``best`` and all triangles."""
    bound = reach(best[0], sought.local[3])
    waiting = begin(mesh.boxes, search)
    while waiting > 0:
        node, near, waiting = next_node(mesh.boxes, search, waiting, 0, sought.local, bound)
        if near != np.uint64(0):
            best = _best_in(mesh, node, near, sought, best)
            bound = reach(best[0], sought.local[3])
    return best


@kernel
def _nearest(
    mesh: Triangles,
    points: Float64s,
    directions: Float64s,
    distance: float,
    least_cosine: float,
    triangles: Int32s,
    barycentric: Float64s,
    squares: Float64s,
) -> None:
    boxes = mesh.boxes
    search, cache = new_search(), new_node_cache(mesh.width)
    radius = -1.0  # distance from the previous point; −1: none
    for n in range(len(points)):
        point = points[n, 0], points[n, 1], points[n, 2]
        at = local(boxes, *point)
        sought = Sought(point, at, directions, n, least_cosine)
        best = distance * distance, -1, 0.0, 0.0
        # Consecutive points mostly follow a surface, at about the same distance from this one.
        if radius >= 0.0 and (is_cached(cache, at, radius) or cache_around(boxes, search, cache, at, radius)):
            best = _best_cached(mesh, search, cache, sought, best)
        if best[1] < 0 or not is_cached(cache, at, np.sqrt(best[0]) + at[3]):
            best = _best_of_all(mesh, search, sought, best)
        radius = np.sqrt(best[0]) + at[3] if best[1] >= 0 else -1.0
        square, chosen, p, q = best
        triangles[n] = mesh.order[chosen] if chosen >= 0 else -1
        squares[n] = square if chosen >= 0 else np.inf
        barycentric[n, 0], barycentric[n, 1], barycentric[n, 2] = 1.0 - p - q, p, q
