"""MikkTSpace in plain Python, corner by corner, with v running down as in glTF."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence

from tests.oracles.naive_obj import dot, minus

Vector = tuple[float, ...]


def times(a: Vector, factor: float) -> Vector:
    return tuple(x * factor for x in a)


def unit(a: Vector) -> Vector:
    length = math.sqrt(dot(a, a))
    return times(a, 1 / length) if length else a


def seen_along(a: Vector, normal: Vector) -> Vector:
    return unit(minus(a, times(normal, dot(a, normal))))


def tangents(
    points: Sequence[Vector],
    triangles: Sequence[Sequence[int]],
    normals: Sequence[Sequence[Vector]],
    uv: Sequence[Sequence[Vector]],
) -> list[list[Vector | None]]:
    """The tangent and handedness of each corner; None where MikkTSpace leaves it to the application.

    ``points`` by vertex; ``normals`` and ``uv`` by triangle and corner.
    """
    sums: dict[object, list[Vector]] = defaultdict(list)
    groups: dict[tuple[int, int], object] = {}
    for number, triangle in enumerate(triangles):
        a, b, c = (points[i] for i in triangle)
        if a in (b, c) or b == c:
            continue
        (s0, t0), (s1, t1), (s2, t2) = ((u, 1 - v) for u, v in uv[number])
        area = (s1 - s0) * (t2 - t0) - (s2 - s0) * (t1 - t0)
        if area == 0:
            continue
        along = minus(times(minus(b, a), t2 - t0), times(minus(c, a), t1 - t0))
        along = times(along, math.copysign(1, area))
        for corner in range(3):
            normal = normals[number][corner]
            point, after, before = (points[triangle[(corner + i) % 3]] for i in range(3))
            one, other = (seen_along(minus(end, point), normal) for end in (after, before))
            # Exact near 0, where the arc cosine is noise (Kahan).
            angle = 2 * math.atan2(math.dist(one, other), math.dist(one, times(other, -1)))
            key = (point, normal, uv[number][corner], area > 0)
            groups[number, corner] = key
            sums[key].append(times(seen_along(along, normal), angle))
    found: list[list[Vector | None]] = []
    for number in range(len(triangles)):
        row: list[Vector | None] = []
        for corner in range(3):
            key = groups.get((number, corner))
            total = tuple(map(sum, zip(*sums[key], strict=True))) if key else (0, 0, 0)
            sign = 1.0 if key and key[3] else -1.0
            row.append((*unit(total), sign) if dot(total, total) > 1e-18 else None)
        found.append(row)
    return found
