"""The point of a triangle mesh that is nearest to a point."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Int64s
from octex.errors import ModelError
from octex.jit import inlined, kernel, part, trailing_zeros
from octex.nearest.boxes import (
    Boxes,
    Search,
    Sought,
    agrees,
    begin,
    boxes_of,
    local,
    morton_order,
    new_search,
    next_node,
    reach,
)

#: The radius of a search, by the distance found for the previous point, and by the size of triangles: points
#: of a surface in any order take a third of the time of searches without it.
_FARTHER, _MARGIN = 1.1, 0.1
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
    def of(cls, vertices: Float64s, faces: Int32s, name: str = "the surface") -> Triangles:
        """Build from triangles (m, 3) of vertices (n, 3); those without area are left out.

        Raises ModelError, with ``name``, if none has area.
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
            raise ModelError(f"{name}: all triangles are degenerate; there is no surface to search")
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
def _nearer(mesh: Triangles, row: int, sought: Sought, best: Best) -> Best:
    """Return the nearer of ``best`` (square, row, weights) and a triangle."""
    square, nearest, _, _ = best
    if row != nearest and agrees(mesh.normals, row, sought):
        squared, p, q = _on_triangle(mesh.corners, row, *sought.point)
        if squared < square or (squared == square and (nearest < 0 or mesh.order[row] < mesh.order[nearest])):
            return squared, row, p, q
    return best


@inlined
def _best(mesh: Triangles, search: Search, sought: Sought, distance: float, guess: int) -> Best:
    """Return the nearest triangle within a distance; a good guess speeds it up."""
    best = distance * distance, -1, 0.0, 0.0
    if guess >= 0:
        best = _nearer(mesh, guess, sought, best)
    slack = sought.local[3]
    bound = reach(best[0], slack)
    waiting = begin(mesh.boxes, search)
    while waiting > 0:
        node, children, waiting = next_node(mesh.boxes, search, waiting, sought.local, bound)
        while children != np.uint64(0):
            child = trailing_zeros(children)
            children &= children - np.uint64(1)
            if search.children[child] <= bound:
                best = _nearer(mesh, node * 8 + child, sought, best)
                bound = reach(best[0], slack)
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
    search = new_search()
    last, radius = -1, distance
    for n in range(len(points)):
        point = points[n, 0], points[n, 1], points[n, 2]
        sought = Sought(point, local(mesh.boxes, *point), directions, n, least_cosine)
        best = _best(mesh, search, sought, radius, last)
        if best[1] < 0 and radius < distance:
            best = _best(mesh, search, sought, distance, last)
        square, last, p, q = best
        # Consecutive points mostly lie at about the same distance.
        radius = min(_FARTHER * np.sqrt(square) + _MARGIN * mesh.width, distance) if last >= 0 else distance
        triangles[n] = mesh.order[last] if last >= 0 else -1
        squares[n] = square if last >= 0 else np.inf
        barycentric[n, 0], barycentric[n, 1], barycentric[n, 2] = 1.0 - p - q, p, q


class MeshBoxes(NamedTuple):
    """Triangles and a box hierarchy over them."""

    corners: Float64s  # (m, 3, 3)   along a Morton curve
    boxes: Boxes


def mesh_of(corners: Float64s) -> MeshBoxes:
    """Build the hierarchy over triangles (m, 3, 3)."""
    corners = np.ascontiguousarray(corners[morton_order(corners.mean(axis=1))])
    return MeshBoxes(corners, boxes_of(corners.min(axis=1), corners.max(axis=1)))


def gap(a: MeshBoxes, b: MeshBoxes, most: float) -> float:
    """Return the smallest distance of two meshes, 0 where they intersect; infinite above ``most``."""
    few, many = (a, b) if len(a.corners) <= len(b.corners) else (b, a)
    count = len(few.corners)
    stride = max(round(0.618 * count), 1)
    while math.gcd(stride, count) > 1:
        stride += 1
    return float(_gap(few.corners, many, most, stride))


@kernel
def _gap(few: Float64s, many: MeshBoxes, most: float, stride: int) -> float:
    search = new_search()
    best = most * most
    is_reached = False
    for number in range(few.shape[0]):
        i = number * stride % few.shape[0]  # spread over the mesh, to find a small distance early
        # Query with the ball around the triangle's box.
        (x0, x1), (y0, y1), (z0, z1) = _extent(few, i, 0), _extent(few, i, 1), _extent(few, i, 2)
        radius = 0.5 * np.sqrt((x1 - x0) ** 2 + (y1 - y0) ** 2 + (z1 - z0) ** 2)
        at = local(many.boxes, 0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * (z0 + z1))
        bound = reach(best, at[3] + radius)
        waiting = begin(many.boxes, search)
        while waiting > 0:
            node, children, waiting = next_node(many.boxes, search, waiting, at, bound)
            while children != np.uint64(0):
                j = node * 8 + trailing_zeros(children)
                children &= children - np.uint64(1)
                if _box_distance(few, i, many.corners, j) > best:
                    continue
                distance = _triangle_distance(few, i, many.corners, j)
                if distance <= best:
                    best, is_reached = distance, True
                    if best == 0.0:
                        return 0.0
                    bound = reach(best, at[3] + radius)
    return np.sqrt(best) if is_reached else np.inf


@inlined
def _extent(corners: Float64s, i: int, axis: int) -> tuple[float, float]:
    """Return a triangle's extent along an axis."""
    x, y, z = corners[i, 0, axis], corners[i, 1, axis], corners[i, 2, axis]
    return min(x, y, z), max(x, y, z)


@inlined
def _box_distance(a: Float64s, i: int, b: Float64s, j: int) -> float:
    """Return the squared distance of two triangles' boxes."""
    total = 0.0
    for axis in range(3):
        low, high = _extent(a, i, axis)
        first, last = _extent(b, j, axis)
        distance = max(first - high, low - last, 0.0)
        total += distance * distance
    return total


@part
def _triangle_distance(a: Float64s, i: int, b: Float64s, j: int) -> float:
    """Return the squared distance of two triangles, of edges or corner and face; 0 if they intersect."""
    best = np.inf
    for m in range(3):
        p, q = a[i, m], a[i, (m + 1) % 3]
        for n in range(3):
            best = min(best, _segment_distance(p, q, b[j, n], b[j, (n + 1) % 3]))
        best = min(best, _point_distance(p, b[j, 0], b[j, 1], b[j, 2]))
        best = min(best, _point_distance(b[j, m], a[i, 0], a[i, 1], a[i, 2]))
    if best > 0.0:
        for m in range(3):
            n = (m + 1) % 3
            if _pierces(a[i, m], a[i, n], b[j, 0], b[j, 1], b[j, 2]) or _pierces(
                b[j, m], b[j, n], a[i, 0], a[i, 1], a[i, 2]
            ):
                return 0.0
    return best


@inlined
def _dot(a: Float64s, b: Float64s, c: Float64s, d: Float64s) -> float:
    """Return (b − a) · (d − c)."""
    product: float = (b[0] - a[0]) * (d[0] - c[0])
    product += (b[1] - a[1]) * (d[1] - c[1])
    product += (b[2] - a[2]) * (d[2] - c[2])
    return product


@part
def _segment_distance(p: Float64s, q: Float64s, r: Float64s, s: Float64s) -> float:
    """Return the squared distance of two segments (Ericson, Real-Time Collision Detection, 5.1.9)."""
    a, e = _dot(p, q, p, q), _dot(r, s, r, s)
    b, c, f = _dot(p, q, r, s), _dot(p, q, r, p), _dot(r, s, r, p)
    along = 0.0
    if a > 0.0:
        across = a * e - b * b
        along = min(max((b * f - c * e) / across, 0.0), 1.0) if across > 0.0 else 0.0
    other = (b * along + f) / e if e > 0.0 else 0.0
    if not 0.0 < other < 1.0:
        other = 1.0 if other >= 1.0 else 0.0
        along = min(max((other * b - c) / a, 0.0), 1.0) if a > 0.0 else 0.0
    total = 0.0
    for axis in range(3):
        difference = p[axis] + along * (q[axis] - p[axis]) - r[axis] - other * (s[axis] - r[axis])
        total += difference * difference
    return total


@part
def _point_distance(p: Float64s, a: Float64s, b: Float64s, c: Float64s) -> float:
    """Return the squared distance of a point and a triangle's plane; infinite if an edge is nearer."""
    aa, ab, bb = _dot(a, b, a, b), _dot(a, b, a, c), _dot(a, c, a, c)
    ap, bp = _dot(a, b, a, p), _dot(a, c, a, p)
    area = aa * bb - ab * ab
    v, w = bb * ap - ab * bp, aa * bp - ab * ap
    if area <= 0.0 or v < 0.0 or w < 0.0 or v + w > area:
        return np.inf
    total = 0.0
    for axis in range(3):
        difference = p[axis] - a[axis] - (v * (b[axis] - a[axis]) + w * (c[axis] - a[axis])) / area
        total += difference * difference
    return total


@part
def _pierces(p: Float64s, q: Float64s, a: Float64s, b: Float64s, c: Float64s) -> bool:
    """Return whether a segment passes through a triangle."""
    nx = (b[1] - a[1]) * (c[2] - a[2]) - (b[2] - a[2]) * (c[1] - a[1])
    ny = (b[2] - a[2]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[2] - a[2])
    nz = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    over = nx * (p[0] - a[0]) + ny * (p[1] - a[1]) + nz * (p[2] - a[2])
    under = nx * (q[0] - a[0]) + ny * (q[1] - a[1]) + nz * (q[2] - a[2])
    if over * under >= 0.0:
        return False
    t = over / (over - under)
    aa, ab, bb = _dot(a, b, a, b), _dot(a, b, a, c), _dot(a, c, a, c)
    ap = _dot(a, b, a, p) + t * _dot(a, b, p, q)
    bp = _dot(a, c, a, p) + t * _dot(a, c, p, q)
    v, w = bb * ap - ab * bp, aa * bp - ab * ap
    return bool(v >= 0.0 and w >= 0.0 and v + w <= aa * bb - ab * ab)
