"""A z-buffer: the triangle that each pixel's centre sees, and its barycentric coordinates.

Edge functions are homogeneous, so triangles through the camera plane need no clipping (Olano & Greer,
"Triangle Scan Conversion using 2D Homogeneous Coordinates", 1997). Vertices snap to 2⁻¹⁴ of a pixel. The edge
functions of triangles up to 4096 pixels across are then exact in float64.
"""

from __future__ import annotations

from concurrent.futures import Executor
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Uint8s
from octex.cameras.camera import Camera
from octex.jit import kernel, part
from octex.parallel import cpu_count, ordered_map, sharing
from octex.source.vectors import Vector, cross_product, dot_product

Index = int | np.integer[Any]

#: Snapped positions are multiples of 1 / _SUBPIXELS of a pixel.
_SUBPIXELS = 2.0**14
#: Vertices farther than this from the image's corner, in pixels, do not snap.
_FAR = 2.0**20
#: Depths closer than this part of the largest depth are equal: the rounding of interpolation.
_SAME_DEPTH = 1e-12
#: Bits of a vertex's position: left of, right of, above and below the image, and behind the camera. A
#: triangle whose vertices share a bit is invisible.
_LEFT, _RIGHT, _ABOVE, _BELOW, _BEHIND = 1, 2, 4, 8, 16


class Buffers(NamedTuple):
    """The nearest triangle of each pixel; row 0 is the top of the image."""

    triangle: Int32s  # (height, width)      the nearest triangle; −1: none
    barycentric: Float32s  # (height, width, 3)   perspective-correct; zeros without a triangle
    depth: Float64s  # (height, width)      along the camera's axis; inf without a triangle


def z_buffer(
    positions: Float64s,
    triangles: Int32s,
    camera: Camera,
    executor: Executor | None = None,
    *,
    behind: Buffers | None = None,
) -> Buffers:
    """Find the triangle that each pixel's centre sees.

    positions    (n, 3), finite, in the world
    triangles    (m, 3) numbers of positions; both sides are visible; triangles without area are not
    camera       for several samples a pixel, pass ``camera.scaled``
    executor     spreads the work over bands of rows; the result stays the same
    behind       an earlier result: return the next layer behind it, and nothing where it has no triangle
                 (depth peeling: C. Everitt, "Interactive Order-Independent Transparency", 2001)

    A centre on the edge between two triangles belongs to exactly one of them (the top-left rule), whether
    they share vertices or only positions. At equal depth the first triangle wins, and the next one lies
    behind it. Points at depth 0 or less are invisible.
    """
    points, corners = np.ascontiguousarray(positions, np.float64), np.ascontiguousarray(triangles, np.int32)
    screen, snapped, outside = _to_screen(points, camera.matrix, camera.width, camera.height)
    same = _SAME_DEPTH * float(np.abs(screen[:, 3]).max(initial=0.0))
    shape = camera.height, camera.width
    buffers = Buffers(
        np.empty(shape, np.int32), np.empty((*shape, 3), np.float32), np.empty(shape, np.float64)
    )
    if behind is None:
        behind = Buffers._make(array[:0] for array in buffers)

    def draw(ends: tuple[int, int]) -> None:
        rows = slice(*ends)
        band = Buffers._make(array[rows] for array in buffers)
        band_behind = Buffers._make(array[rows] for array in behind)
        band.triangle[:], band.barycentric[:], band.depth[:] = -1, 0.0, np.inf
        _draw(screen, snapped, outside, corners, same, ends[0], band_behind, band)

    if executor is None:
        draw((0, camera.height))
        return buffers
    bands = min(cpu_count(), camera.height)
    ends = [camera.height * band // bands for band in range(bands + 1)]
    with sharing(executor) as pool:
        for _ in ordered_map(pool, draw, list(pairwise(ends))):
            pass
    return buffers


@kernel
def _to_screen(
    positions: Float64s, matrix: Float64s, width: int, height: int
) -> tuple[Float64s, Bools, Uint8s]:
    """Return rows (x, y, w, depth) of the vertices, whether each snapped, and its position bits.

    x and y are pixel coordinates of snapped vertices. Of others, behind the camera or far outside the image,
    they are multiplied by w.
    """
    screen = np.empty((len(positions), 4), np.float64)
    snapped = np.zeros(len(positions), np.bool_)
    outside = np.zeros(len(positions), np.uint8)
    for n in range(len(positions)):
        for row in range(4):
            # Not a matrix product: vertices at one position must get the same bits.
            screen[n, row] = (
                matrix[row, 0] * positions[n, 0]
                + matrix[row, 1] * positions[n, 1]
                + matrix[row, 2] * positions[n, 2]
                + matrix[row, 3]
            )
        x, y, w = screen[n, 0], screen[n, 1], screen[n, 2]
        outside[n] = (
            (_LEFT if x < 0.0 else 0)
            | (_RIGHT if x > width * w else 0)
            | (_ABOVE if y < 0.0 else 0)
            | (_BELOW if y > height * w else 0)
            | (0 if w > 0.0 else _BEHIND)
        )
        if w > 0.0 and abs(x) <= _FAR * w and abs(y) <= _FAR * w:
            screen[n, 0] = np.floor(x / w * _SUBPIXELS + 0.5) / _SUBPIXELS
            screen[n, 1] = np.floor(y / w * _SUBPIXELS + 0.5) / _SUBPIXELS
            snapped[n] = True
    return screen, snapped, outside


@part
def _edge(
    screen: Float64s, snapped: Bools, p: Index, q: Index
) -> tuple[float, float, float, float, float, float]:
    """Return x0, y0, across, down, constant and scale of the edge function from vertex p to q.

    The function is ((x − x0) · across + (y − y0) · down + constant) · scale. From q to p it is exactly
    negated.
    """
    sign = 1.0
    for axis in range(3):
        if screen[p, axis] != screen[q, axis]:
            if screen[p, axis] > screen[q, axis]:
                p, q, sign = q, p, -1.0
            break
    px, py, pw = screen[p, 0], screen[p, 1], screen[p, 2]
    qx, qy, qw = screen[q, 0], screen[q, 1], screen[q, 2]
    if snapped[p] and snapped[q]:
        return px, py, sign * (py - qy), sign * (qx - px), 0.0, pw * qw
    if snapped[p]:
        px, py = px * pw, py * pw
    if snapped[q]:
        qx, qy = qx * qw, qy * qw
    return 0.0, 0.0, sign * (py * qw - pw * qy), sign * (pw * qx - px * qw), sign * (px * qy - py * qx), 1.0


@part
def _orientation(screen: Float64s, snapped: Bools, a: Index, b: Index, c: Index) -> float:
    """Return 1 or −1 for the visible side of a triangle, 0 for no area in the image."""
    if snapped[a] and snapped[b] and snapped[c]:
        abx, aby = screen[b, 0] - screen[a, 0], screen[b, 1] - screen[a, 1]
        acx, acy = screen[c, 0] - screen[a, 0], screen[c, 1] - screen[a, 1]
        return float(np.sign(abx * acy - aby * acx))
    across = cross_product(_homogeneous(screen, snapped, b), _homogeneous(screen, snapped, c))
    return float(np.sign(dot_product(_homogeneous(screen, snapped, a), across)))


@part
def _homogeneous(screen: Float64s, snapped: Bools, vertex: Index) -> Vector:
    x, y, w = screen[vertex, 0], screen[vertex, 1], screen[vertex, 2]
    if snapped[vertex]:
        return x * w, y * w, w
    return x, y, w


@part
def _pixel_range(
    screen: Float64s, snapped: Bools, corners: tuple[Index, Index, Index], axis: int, first: int, end: int
) -> tuple[int, int]:
    """Return the range [first, end) of pixels along an axis whose centres the triangle may cover."""
    a, b, c = corners
    if not (snapped[a] and snapped[b] and snapped[c]):
        return first, end
    low = min(screen[a, axis], screen[b, axis], screen[c, axis])
    high = max(screen[a, axis], screen[b, axis], screen[c, axis])
    # Snapped positions lie within ±2²⁰ and fit an integer.
    return max(int(np.ceil(low - 0.5)), first), min(int(np.floor(high - 0.5)) + 1, end)


@part
def _covers(value: float, across: float, down: float) -> bool:
    """Return whether a point is inside an edge, or on a left or top edge."""
    return value > 0.0 or (value == 0.0 and (across > 0.0 or (across == 0.0 and down > 0.0)))


@kernel
def _draw(
    screen: Float64s,
    snapped: Bools,
    outside: Uint8s,
    triangles: Int32s,
    same_depth: float,
    top: int,
    behind: Buffers,
    buffers: Buffers,
) -> None:
    """Draw triangles into a band of rows from ``top`` on."""
    visible, barycentric, depths = buffers
    height, width = visible.shape
    is_behind = len(behind.triangle) > 0
    edges = np.empty((3, 6), np.float64)
    row_constant = np.empty(3, np.float64)
    for number in range(len(triangles)):
        corners = triangles[number]
        a, b, c = np.int64(corners[0]), np.int64(corners[1]), np.int64(corners[2])
        if outside[a] & outside[b] & outside[c] != 0:
            continue
        first_row, end_row = _pixel_range(screen, snapped, (a, b, c), 1, top, top + height)
        first_column, end_column = _pixel_range(screen, snapped, (a, b, c), 0, 0, width)
        if first_column >= end_column or first_row >= end_row:
            continue
        side = _orientation(screen, snapped, a, b, c)
        if side == 0.0:
            continue
        for e in range(3):
            p, q = (b, c) if e == 0 else (c, a) if e == 1 else (a, b)
            x0, y0, across, down, constant, scale = _edge(screen, snapped, p, q)
            # Scalar by scalar: an array expression takes four seconds to compile.
            edges[e, 0], edges[e, 1], edges[e, 5] = x0, y0, scale
            edges[e, 2], edges[e, 3], edges[e, 4] = across * side, down * side, constant * side
        a_depth, b_depth, c_depth = screen[a, 3], screen[b, 3], screen[c, 3]
        for row in range(first_row, end_row):
            first, end = first_column, end_column
            for e in range(3):
                x0, across = edges[e, 0], edges[e, 2]
                constant = (row + 0.5 - edges[e, 1]) * edges[e, 3] + edges[e, 4]
                row_constant[e] = constant
                if end - first <= 4:
                    continue
                if across == 0.0:
                    end = end if constant >= 0.0 else first
                    continue
                # The pixel where the edge crosses the row, widened by one for rounding.
                crossing = min(max(x0 - constant / across, -1.0), width + 1.0)
                if across > 0.0:
                    first = max(first, int(crossing) - 1)
                else:
                    end = min(end, int(crossing) + 2)
            for column in range(first, end):
                x = column + 0.5
                in_a = (x - edges[0, 0]) * edges[0, 2] + row_constant[0]
                in_b = (x - edges[1, 0]) * edges[1, 2] + row_constant[1]
                in_c = (x - edges[2, 0]) * edges[2, 2] + row_constant[2]
                if not (
                    _covers(in_a, edges[0, 2], edges[0, 3])
                    and _covers(in_b, edges[1, 2], edges[1, 3])
                    and _covers(in_c, edges[2, 2], edges[2, 3])
                ):
                    continue
                in_a, in_b, in_c = in_a * edges[0, 5], in_b * edges[1, 5], in_c * edges[2, 5]
                total = in_a + in_b + in_c
                in_a, in_b, in_c = in_a / total, in_b / total, in_c / total
                depth = in_a * a_depth + in_b * b_depth + in_c * c_depth
                if 0.0 < depth < depths[row - top, column] - same_depth:
                    if is_behind:
                        last = behind.triangle[row - top, column]
                        further = depth - behind.depth[row - top, column]
                        if last < 0 or further < -same_depth or (further <= same_depth and number <= last):
                            continue
                    visible[row - top, column] = number
                    depths[row - top, column] = depth
                    barycentric[row - top, column, 0] = in_a
                    barycentric[row - top, column, 1] = in_b
                    barycentric[row - top, column, 2] = in_c
