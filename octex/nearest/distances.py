"""The smallest distance of two meshes: queries a box hierarchy of one for each triangle of the other."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from octex.arrays import Float64s
from octex.jit import inlined, kernel, part, trailing_zeros
from octex.nearest.boxes import Boxes, begin, boxes_of, local, morton_order, new_search, next_node, reach


class Mesh(NamedTuple):
    """Triangles and a box hierarchy over them."""

    corners: Float64s  # (m, 3, 3)   along a Morton curve
    boxes: Boxes


def mesh_of(corners: Float64s) -> Mesh:
    """Build the hierarchy over triangles (m, 3, 3)."""
    corners = np.ascontiguousarray(corners[morton_order(corners.mean(axis=1))])
    return Mesh(corners, boxes_of(corners.min(axis=1), corners.max(axis=1)))


def gap(a: Mesh, b: Mesh, most: float) -> float:
    """Return the smallest distance of two meshes, 0 where they intersect; infinite above ``most``."""
    few, many = (a, b) if len(a.corners) <= len(b.corners) else (b, a)
    count = len(few.corners)
    stride = max(round(0.618 * count), 1)
    while math.gcd(stride, count) > 1:
        stride += 1
    return float(_gap(few.corners, many, most, stride))


@kernel
def _gap(few: Float64s, many: Mesh, most: float, stride: int) -> float:
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
            node, near, waiting = next_node(many.boxes, search, waiting, 0, at, bound)
            while near != np.uint64(0):
                j = node * 8 + trailing_zeros(near)
                near &= near - np.uint64(1)
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
        apart = max(first - high, low - last, 0.0)
        total += apart * apart
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
        apart = p[axis] + along * (q[axis] - p[axis]) - r[axis] - other * (s[axis] - r[axis])
        total += apart * apart
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
        apart = p[axis] - a[axis] - (v * (b[axis] - a[axis]) + w * (c[axis] - a[axis])) / area
        total += apart * apart
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
