"""Finds the point of the surface that each texel shows: draws triangles at their texture coordinates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s
from octex.baking.layout import Layout
from octex.jit import inlined, kernel
from octex.source.vectors import Vector, between, times

#: Texels covered by less than this part count as gutter.
_LEAST = 1e-4
#: Side of the tiles in which the texels of a triangle are listed together.
_TILE = 32
#: Edges this close to a texel touch it.
_NEAR = 1e-9
#: Centres of texels this close to an edge are on it.
_ON_EDGE = 1e-6


class TexelRows(NamedTuple):
    """The triangle that each texel of a band of rows shows, and the part that its chart covers."""

    triangles: Int32s  # (rows, width)   −1: none
    centroids: Float32s  # (rows, width, 2)   of the covered part, right and down from the texel's corner
    areas: Float32s  # (rows, width)   the covered part, 0 … 1


class Drawing(NamedTuple):
    """A layout that is drawn in bands of rows."""

    layout: Layout
    tops: Float64s  # (k,)   of the triangles
    bottoms: Float64s  # (k,)

    @classmethod
    def of(cls, layout: Layout) -> Drawing:
        """Prepare a layout."""
        rows = layout.corners[..., 1]
        return cls(layout, rows.min(axis=1), rows.max(axis=1))

    def rows(self, first: int, end: int) -> TexelRows:
        """Draw rows; ``triangles`` of the result are the layout's."""
        numbers = np.flatnonzero((self.tops <= end) & (self.bottoms >= first)).astype(np.int32)
        chosen = self.layout.of(numbers)
        drawn = draw_texels(chosen.corners, chosen.charts, chosen.edges, chosen.width, first, end)
        is_drawn = drawn.triangles >= 0
        drawn.triangles[is_drawn] = numbers[drawn.triangles[is_drawn]]
        return drawn


def draw_texels(
    corners: Float64s, charts: Int32s, edges: Bools, width: int, first: int, end: int
) -> TexelRows:
    """Draw rows ``first`` to ``end`` of a map.

    ``corners`` (m, 3, 2) are triangles in texels, x to the right and y down; ``charts`` (m,) their charts;
    ``edges`` (m, 3) the sides that are edges of charts. A texel belongs to the chart whose triangle covers
    most of it. It shows the centroid of the part that this chart covers, on the triangle there or nearest to
    it.
    """
    shape = end - first, width
    triangles, areas = np.full(shape, -1, np.int32), np.zeros(shape, np.float32)
    centroids, cut = np.zeros((*shape, 2), np.float32), np.zeros(shape, np.bool_)
    _mark_cut(corners, edges, first, cut)
    count = 0
    for _ in range(2):  # once to count pieces
        pieces = _Pieces(np.empty(count, np.int64), np.empty(count, np.int32), np.zeros((count, 3)))
        count = _fill(corners, first, cut, triangles, areas, centroids, pieces)
    cells = cut.ravel(), triangles.ravel(), areas.ravel(), centroids.reshape(-1, 2)
    _assign(corners, charts, first, width, pieces, *cells)
    return TexelRows(triangles, centroids, areas)


class _Pieces(NamedTuple):
    """Parts of triangles in texels that edges of charts cut or nearly touch."""

    texels: Int64s  # (n,)   counted row by row
    triangles: Int32s  # (n,)
    covered: Float64s  # (n, 3)   the area, and the area times the centroid relative to the texel


@inlined
def _reach(corners: Float64s, triangle: int, axis: int, low: int, high: int) -> tuple[int, int]:
    """Return the first and the end of the texels that a triangle reaches along an axis, within limits."""
    a, b, c = corners[triangle, 0, axis], corners[triangle, 1, axis], corners[triangle, 2, axis]
    least, most = min(a, min(b, c)), max(a, max(b, c))
    return int(max(np.floor(least), np.float64(low))), int(min(np.floor(most) + 1.0, np.float64(high)))


@inlined
def _cut(polygon: Float64s, corners: int, axis: int, limit: float, sign: float, clipped: Float64s) -> int:
    """Clip a polygon along an axis to sign · (coordinate − limit) ≥ 0."""
    count = 0
    for n in range(corners):
        m = n + 1 if n + 1 < corners else 0
        before, after = sign * (polygon[n, axis] - limit), sign * (polygon[m, axis] - limit)
        if before >= 0.0:
            clipped[count, 0], clipped[count, 1] = polygon[n, 0], polygon[n, 1]
            count += 1
        if (before >= 0.0) != (after >= 0.0):
            part = before / (before - after)
            clipped[count, 0] = polygon[n, 0] + part * (polygon[m, 0] - polygon[n, 0])
            clipped[count, 1] = polygon[n, 1] + part * (polygon[m, 1] - polygon[n, 1])
            count += 1
    return count


@inlined
def _lines(corners: Float64s, triangle: int, lines: Float64s) -> bool:
    """Write a triangle's sides (3, 3) as a x + b y + c, positive inside; return whether it has area."""
    ax, ay = corners[triangle, 0, 0], corners[triangle, 0, 1]
    doubled = (corners[triangle, 1, 0] - ax) * (corners[triangle, 2, 1] - ay)
    doubled -= (corners[triangle, 1, 1] - ay) * (corners[triangle, 2, 0] - ax)
    sign = 1.0 if doubled > 0.0 else -1.0
    for k in range(3):
        m = k + 1 if k < 2 else 0
        x, y = corners[triangle, k, 0], corners[triangle, k, 1]
        across, down = sign * (y - corners[triangle, m, 1]), sign * (corners[triangle, m, 0] - x)
        lines[k, 0], lines[k, 1], lines[k, 2] = across, down, -across * x - down * y
    return bool(doubled != 0.0)


@inlined
def _ranges(
    corners: Float64s, triangle: int, first: int, shape: tuple[int, int], lines: Float64s
) -> tuple[int, int, int, int]:
    """Write a triangle's sides; return its ranges of rows (empty without area) and columns."""
    top, bottom = _reach(corners, triangle, 1, first, first + shape[0])
    left, right = _reach(corners, triangle, 0, 0, shape[1])
    if top >= bottom or left >= right or not _lines(corners, triangle, lines):
        return 0, 0, 0, 0
    return top, bottom, left, right


@inlined
def _touched_range(lines: Float64s, row: int, left: int, right: int) -> tuple[int, int]:
    """Narrow a row's range to texels that a triangle may meet."""
    low, high = float(left), float(right)
    for k in range(3):
        across, down = lines[k, 0], lines[k, 1]
        offset = down * row + lines[k, 2] + max(across, 0.0) + max(down, 0.0)
        if across > 0.0:
            low = min(max(low, np.floor(-offset / across)), high)
        elif across < 0.0:
            high = max(min(high, np.ceil(-offset / across) + 1.0), low)
    return int(low), int(high)


@inlined
def _meets(lines: Float64s, column: int, row: int) -> bool:
    """Return whether a triangle meets a texel that meets its box."""
    meets = True
    for k in range(3):
        across, down = lines[k, 0], lines[k, 1]
        offset = across * column + down * row + lines[k, 2]
        meets &= offset + max(across, 0.0) + max(down, 0.0) > 0.0
    return meets


@inlined
def _has_centre(lines: Float64s, column: int, row: int) -> bool:
    """Return whether a triangle covers a texel's centre; edges belong to both sides."""
    has_centre = True
    for k in range(3):
        across, down = lines[k, 0], lines[k, 1]
        slack = _ON_EDGE * abs(across) if across != 0.0 else _NEAR
        has_centre &= across * (column + 0.5) + down * (row + 0.5) + lines[k, 2] >= -slack
    return has_centre


@kernel
def _mark_cut(corners: Float64s, edges: Bools, first: int, cut: Bools) -> None:
    """Mark the texels that edges of charts touch."""
    height, width = cut.shape
    for triangle in range(corners.shape[0]):
        for side in range(3):
            if not edges[triangle, side]:
                continue
            ax, ay = corners[triangle, side, 0], corners[triangle, side, 1] - first
            other = side + 1 if side < 2 else 0
            bx, by = corners[triangle, other, 0], corners[triangle, other, 1] - first
            x0, x1 = max(np.floor(min(ax, bx) - _NEAR), 0.0), min(np.floor(max(ax, bx) + _NEAR), width - 1.0)
            y0, y1 = max(np.floor(min(ay, by) - _NEAR), 0.0), min(np.floor(max(ay, by) + _NEAR), height - 1.0)
            across, down = by - ay, ax - bx
            reach = 0.5 * (abs(across) + abs(down)) + _NEAR
            for row in range(int(y0), int(y1) + 1):
                for column in range(int(x0), int(x1) + 1):
                    if abs(across * (column + 0.5 - ax) + down * (row + 0.5 - ay)) <= reach:
                        cut[row, column] = True


@inlined
def _covered(
    corners: Float64s, triangle: int, column: int, row: int, polygon: Float64s, clipped: Float64s
) -> tuple[float, float, float]:
    """Return the area of a triangle in a texel, and the area times its centroid relative to the texel."""
    for k in range(3):
        polygon[k, 0], polygon[k, 1] = corners[triangle, k, 0] - column, corners[triangle, k, 1] - row
    doubled = (polygon[1, 0] - polygon[0, 0]) * (polygon[2, 1] - polygon[0, 1])
    doubled -= (polygon[1, 1] - polygon[0, 1]) * (polygon[2, 0] - polygon[0, 0])
    sign = 1.0 if doubled > 0.0 else -1.0
    count = _cut(polygon, 3, 0, 0.0, 1.0, clipped)
    count = _cut(clipped, count, 0, 1.0, -1.0, polygon)
    count = _cut(polygon, count, 1, 0.0, 1.0, clipped)
    count = _cut(clipped, count, 1, 1.0, -1.0, polygon)
    area = x = y = 0.0
    for n in range(1, count - 1):
        bx, by = polygon[n, 0] - polygon[0, 0], polygon[n, 1] - polygon[0, 1]
        cx, cy = polygon[n + 1, 0] - polygon[0, 0], polygon[n + 1, 1] - polygon[0, 1]
        part = 0.5 * sign * (bx * cy - by * cx)
        area += part
        x += part * (polygon[0, 0] + (bx + cx) / 3.0)
        y += part * (polygon[0, 1] + (by + cy) / 3.0)
    return area, x, y


@kernel
def _fill(
    corners: Float64s, first: int, cut: Bools, triangles: Int32s, areas: Float32s, centroids: Float32s,
    pieces: _Pieces,
) -> int:  # fmt: skip
    """Write the texels that no edge cuts, by their centres: a chart covers each wholly or not at all.

    List the pieces of triangles in the others, as far as there is room; return how many there are.
    """
    polygon, clipped, lines = np.empty((8, 2)), np.empty((8, 2)), np.empty((3, 3))
    count, room = 0, pieces.texels.size
    for triangle in range(corners.shape[0]):
        top, bottom, left, right = _ranges(corners, triangle, first, cut.shape, lines)
        for row in range(top, bottom):
            low, high = _touched_range(lines, row, left, right)
            for column in range(low, high):
                at = np.uint64(row - first), np.uint64(column)
                if not cut[at]:
                    if triangles[at] < 0 and _has_centre(lines, column, row):
                        triangles[at], areas[at] = triangle, 1.0
                        centroids[at[0], at[1], 0] = centroids[at[0], at[1], 1] = 0.5
                    continue
                if count < room:
                    pieces.texels[count] = (row - first) * cut.shape[1] + column
                    pieces.triangles[count] = triangle
                    if _meets(lines, column, row):
                        area, x, y = _covered(corners, triangle, column, row, polygon, clipped)
                        covered = pieces.covered[count]
                        covered[0], covered[1], covered[2] = area, x, y
                count += 1
    return count


@inlined
def _barycentric(corners: Float64s, triangle: int, x: float, y: float) -> Vector:
    """Return the barycentric coordinates of a map position on a triangle; thirds without area."""
    ax, ay = corners[triangle, 0, 0], corners[triangle, 0, 1]
    bx, by = corners[triangle, 1, 0] - ax, corners[triangle, 1, 1] - ay
    cx, cy = corners[triangle, 2, 0] - ax, corners[triangle, 2, 1] - ay
    doubled = bx * cy - by * cx
    if doubled == 0.0:
        return 1 / 3, 1 / 3, 1 / 3
    q = ((x - ax) * cy - (y - ay) * cx) / doubled
    r = (bx * (y - ay) - by * (x - ax)) / doubled
    return 1.0 - q - r, q, r


@inlined
def _clamped(corners: Float64s, triangle: int, x: float, y: float) -> Vector:
    """Return barycentric coordinates, clamped to the triangle."""
    p, q, r = _barycentric(corners, triangle, x, y)
    p, q, r = max(p, 0.0), max(q, 0.0), max(r, 0.0)
    return times((p, q, r), 1.0 / (p + q + r))


@kernel
def barycentric_at(corners: Float64s, triangles: Int32s, points: Float64s) -> Float64s:
    """Return barycentric coordinates (n, 3) of map positions (n, 2), clamped to triangles (n,)."""
    weights = np.empty((triangles.size, 3))
    for n in range(triangles.size):
        weights[n] = _clamped(corners, int(triangles[n]), points[n, 0], points[n, 1])
    return weights


@kernel
def _assign(
    corners: Float64s, charts: Int32s, first: int, width: int, pieces: _Pieces, cut: Bools,
    triangles: Int32s, areas: Float32s, centroids: Float32s,
) -> None:  # fmt: skip
    """Assign ``cut`` texels to the chart whose triangle covers most, with the part that it covers."""
    texels, owners, covered = pieces
    for n in range(texels.size):
        if covered[n, 0] > max(np.float64(areas[texels[n]]), _LEAST):
            areas[texels[n]], triangles[texels[n]] = covered[n, 0], owners[n]
    for texel in range(cut.size):
        if cut[texel]:
            areas[texel] = 0.0
    for n in range(texels.size):
        owner = triangles[texels[n]]
        if owner >= 0 and charts[owner] == charts[owners[n]]:
            areas[texels[n]] += np.float32(covered[n, 0])
            centroids[texels[n], 0] += np.float32(covered[n, 1])
            centroids[texels[n], 1] += np.float32(covered[n, 2])
    nearest = np.full(cut.size, np.inf, np.float32)
    for texel in range(cut.size):
        if cut[texel] and triangles[texel] >= 0:
            for axis in range(2):
                middle = centroids[texel, axis] / areas[texel]
                centroids[texel, axis] = min(max(middle, np.float32(0.0)), np.float32(1.0))
            areas[texel] = min(areas[texel], np.float32(1.0))
            nearest[texel] = _inside(corners, int(triangles[texel]), first, width, texel, centroids)
    # The chart's triangle that contains the centroid, or comes nearest.
    for n in range(texels.size):
        texel = texels[n]
        if nearest[texel] < 0.0 and charts[triangles[texel]] == charts[owners[n]]:
            inside = _inside(corners, int(owners[n]), first, width, texel, centroids)
            if inside > np.float64(nearest[texel]):
                nearest[texel], triangles[texel] = inside, owners[n]


@inlined
def _inside(
    corners: Float64s, triangle: int, first: int, width: int, texel: int, centroids: Float32s
) -> float:
    """Return the least barycentric coordinate of a texel's centroid on a triangle."""
    x, y = np.float64(centroids[texel, 0]), np.float64(centroids[texel, 1])
    p, q, r = _barycentric(corners, triangle, texel % width + x, first + texel // width + y)
    return min(p, min(q, r))


class TexelPoints(NamedTuple):
    """Points that texels show, by tile and triangle; within a triangle by squares of 8² in Morton order."""

    texels: Int32s  # (t,)   counted row by row
    rest: Float64s  # (t, 3)   rest positions
    barycentric: Float64s  # (t, 3)   on the drawn triangle
    starts: Int32s  # (runs + 1,)   a run's texels lie in one tile and show one triangle
    triangles: Int32s  # (runs,)   of the surface

    def triangle_of_each(self) -> Int32s:
        """Return the triangle of each texel (t,)."""
        return np.repeat(self.triangles, np.diff(self.starts))


def texel_points(
    corners: Float64s, faces: Int32s, drawn: TexelRows, first: int, rest: Float64s, triangles: Int32s
) -> TexelPoints:
    """Return the points that a map's texels show, from row ``first`` on.

    ``corners`` (k, 3, 2) were drawn for the surface's triangles ``faces`` (k,); ``triangles`` (m, 3) index
    ``rest`` (n, 3).
    """
    row, column = np.nonzero(drawn.triangles >= 0)
    width = drawn.triangles.shape[1]
    owners = drawn.triangles[row, column].astype(np.int64)
    tile = (row >> 5) * (width // _TILE + 1) + (column >> 5)
    square = column >> 3 & 1 | row >> 2 & 2 | column >> 2 & 4 | row >> 1 & 8
    keys = (tile << 31 | owners) << 10 | square << 6 | (row & 7) << 3 | column & 7
    order = np.argsort(keys)
    starts = np.flatnonzero(np.diff(keys[order] >> 10, prepend=-1))
    runs = owners[order[starts]].astype(np.int32)
    count = row.size
    points = TexelPoints(
        (row * width + column)[order].astype(np.int32), np.empty((count, 3)), np.empty((count, 3)),
        np.append(starts, count).astype(np.int32), faces[runs],
    )  # fmt: skip
    _find_points(corners, runs, drawn.centroids, first, rest, triangles, points)
    return points


@kernel
def _find_points(
    corners: Float64s, runs: Int32s, centroids: Float32s, first: int, rest: Float64s, triangles: Int32s,
    points: TexelPoints,
) -> None:  # fmt: skip
    """Write the points of texels; ``runs`` (n,) are the drawn triangles of the runs."""
    width = centroids.shape[1]
    for run in range(runs.size):
        face = points.triangles[run]
        for n in range(points.starts[run], points.starts[run + 1]):
            row, column = points.texels[n] // width, points.texels[n] % width
            x, y = column + centroids[row, column, 0], first + row + centroids[row, column, 1]
            shares = _clamped(corners, int(runs[run]), x, y)
            points.barycentric[n, 0], points.barycentric[n, 1], points.barycentric[n, 2] = shares
            points.rest[n, 0], points.rest[n, 1], points.rest[n, 2] = between(rest, triangles, face, shares)
