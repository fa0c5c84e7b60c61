"""The slow, obvious version of cutting a surface along cells: rational arithmetic, every cell of the box."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from fractions import Fraction
from itertools import pairwise

Point = tuple[Fraction, ...]
Corner = tuple[int, int, int]


def clip(polygon: list[Point], axis: int, bound: int, sign: int) -> list[Point]:
    """Keep the part of a convex polygon with sign · (p[axis] − bound) ≥ 0."""
    kept = []
    for i, end in enumerate(polygon):
        start = polygon[i - 1]
        d0, d1 = sign * (start[axis] - bound), sign * (end[axis] - bound)
        if (d0 < 0) != (d1 < 0):
            t = d0 / (d0 - d1)
            kept.append(tuple(a + t * (b - a) for a, b in zip(start, end, strict=True)))
        if d1 >= 0:
            kept.append(end)
    return kept


def cross(a: Point, b: Point, c: Point) -> Point:
    """Return (b − a) × (c − a)."""
    u = [b[i] - a[i] for i in range(3)]
    v = [c[i] - a[i] for i in range(3)]
    return (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])


def facing(normal: Point) -> int:
    """Return the axis direction nearest to a normal: +x −x +y −y +z −z."""
    axis = max(range(3), key=lambda i: (abs(normal[i]), -i))
    return 2 * axis + (normal[axis] < 0)


def slabs(polygon: list[Point], edge: int, axis: int = 0) -> Iterator[tuple[tuple[int, ...], list[Point]]]:
    """Cut a polygon into slabs along each axis in turn; yield the closed cells and the polygon in each."""
    if axis == 3:
        yield (), polygon
        return
    first, last = (int(bound(p[axis] for p in polygon) // edge) for bound in (min, max))
    for i in range(first, last + 1):
        inside = clip(clip(polygon, axis, i * edge, 1), axis, (i + 1) * edge, -1)
        if inside:
            for cell, piece in slabs(inside, edge, axis + 1):
                yield (i, *cell), piece


def cells_of(triangle: list[Corner], edge: int) -> dict[tuple[int, ...], tuple[float, Point | None]]:
    """Return each cell of edge ``edge`` that a triangle meets, with area and centroid (None without area).

    A half-open cell [a, b)³ is met if the triangle clipped to the closed cell is not wholly in a far face.
    """
    corners = [tuple(Fraction(x) for x in corner) for corner in triangle]
    normal = cross(*corners)
    axis = facing(normal) // 2
    found = {}
    for cell, polygon in slabs(corners, edge):
        if any(all(p[i] == (cell[i] + 1) * edge for p in polygon) for i in range(3)):
            continue
        doubled, moment = Fraction(0), [Fraction(0)] * 3
        for b, c in pairwise(polygon[1:]):
            part = cross(polygon[0], b, c)[axis] / normal[axis]
            doubled += part
            moment = [m + part * (polygon[0][i] + b[i] + c[i]) / 3 for i, m in enumerate(moment)]
        length = float(sum(n * n for n in normal)) ** 0.5
        center = tuple(m / doubled for m in moment) if doubled else None
        found[cell] = (float(doubled) * length / 2 / edge**2, center)
    return found


def sums_of(triangles: list[list[Corner]], edge: int) -> dict[tuple[int, ...], dict[int, float]]:
    """Return the area of each facing in each cell met by any triangle; degenerate triangles meet none."""
    cells: dict[tuple[int, ...], dict[int, float]] = defaultdict(lambda: defaultdict(float))
    for triangle in triangles:
        normal = cross(*(tuple(map(Fraction, corner)) for corner in triangle))
        if any(normal):
            for cell, (area, _) in cells_of(triangle, edge).items():
                cells[cell][facing(normal)] += area
    return cells
