"""Decides for surface points whether a camera sees them, by comparing them with the planes that pixels see.

Each visible triangle stores its plane as *nearness* over the image: 1 / depth for pinhole cameras, minus
depth for orthographic ones. Nearness is linear in pixel coordinates. So a pixel's plane can be evaluated at a
nearby point, and a point's plane at a pixel.
"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Int64s
from octex.cameras.camera import Camera
from octex.jit import inlined, kernel
from octex.source.vectors import Vector, cross_product, dot_product, minus
from octex.view.zbuffer import z_buffer

#: Surfaces closer than this, in pixels at their depth, count as one ...
_CLOSE = 0.01
#: ... plus this where triangles are smaller than pixels, so that a rough surface does not hide itself.
_ROUGH = 0.5
#: Largest width of the undistorted image, as a multiple of the distorted one.
_WIDEST = 4.0


Pixel = tuple[float, float]


class Visibility(NamedTuple):
    """The triangles that the pixels of a camera without distortion see; row 0 is the top of the image."""

    rows: Int32s  # (height, width)   row of the visible triangle; −1: none
    triangles: Int32s  # (k,)   the visible triangles
    planes: Float64s  # (k, 3)   nearness at pixel (0, 0), and its slopes to the right and down
    corner: Int64s  # (2,)   pixel coordinates, x and y, of the first pixel's corner

    def triangle(self, rows: Int32s) -> Int32s:
        """Return the triangles of rows of any shape; −1 stays −1."""
        triangles = np.full(rows.shape, -1, np.int32)
        sees = rows >= 0
        triangles[sees] = self.triangles[rows[sees]]
        return triangles


class View(NamedTuple):
    """A camera in the form that kernels read."""

    world_to_camera: Float64s  # (4, 4)
    K: Float64s  # (3, 3)
    inverse_k: Float64s  # (3, 3)
    focal: float  # pixels a world unit, at depth 1 if pinhole
    is_pinhole: bool


def view_of(camera: Camera) -> View:
    """Return a camera without distortion in the form that kernels read."""
    inverse = np.linalg.inv(camera.K).astype(np.float64)
    focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    return View(camera.world_to_camera, camera.K, inverse, focal, camera.projection == "pinhole")


def visibility_of(
    vertices: Float64s, triangles: Int32s, camera: Camera, executor: Executor | None = None
) -> Visibility:
    """Find the triangles (m, 3) of vertices (n, 3) that the pixels of a camera without distortion see."""
    rows = z_buffer(vertices, triangles, camera, executor).triangle
    seen = _number(rows, len(triangles))
    planes = _planes_of(vertices, triangles[seen], view_of(camera))
    return Visibility(rows, seen, planes, np.zeros(2, np.int64))


def straight(camera: Camera) -> Camera:
    """Return a camera without distortion that covers the view of ``camera`` at the same resolution."""
    if not camera.is_distorted:
        return camera
    width, height = camera.width, camera.height
    x, y = np.arange(width + 1.0), np.arange(height + 1.0)
    rim = np.concatenate(
        [np.column_stack([x, np.full(x.size, row)]) for row in (0.0, float(height))]
        + [np.column_stack([np.full(y.size, column), y]) for column in (0.0, float(width))]
    )
    pinhole = camera.undistorted
    origins, directions = camera.rays(rim)
    projected, _ = pinhole.project(origins + directions)
    projected = projected[np.isfinite(projected).all(axis=1)]
    middle, most = np.array([width, height]) / 2, np.array([width, height]) * _WIDEST / 2
    low = np.floor(np.clip(np.minimum(projected.min(axis=0, initial=0.0), 0.0), middle - most, 0.0))
    high = np.maximum(projected.max(axis=0, initial=0.0), [width, height])
    high = np.ceil(np.clip(high, [width, height], middle + most))
    shift = np.array([[1.0, 0.0, -low[0]], [0.0, 1.0, -low[1]], [0.0, 0.0, 1.0]])
    across, along = (high - low).astype(int).tolist()
    return replace(pinhole, width=across, height=along, K=shift @ pinhole.K)


@inlined
def transformed(view: View, points: Float64s, row: int) -> Vector:
    """Return a world point in camera axes."""
    M = view.world_to_camera
    x, y, z = points[row, 0], points[row, 1], points[row, 2]
    return (
        M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3],
        M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3],
        M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3],
    )


@inlined
def plane_through(a: Vector, b: Vector, c: Vector) -> tuple[float, float, float, float]:
    """Return normal n and offset d, n · x = d, of the plane through three points; |n| is twice the area."""
    normal = cross_product(minus(b, a), minus(c, a))
    return normal[0], normal[1], normal[2], dot_product(normal, a)


@inlined
def nearness(view: View, plane: tuple[float, float, float, float]) -> Vector:
    """Return a plane's nearness at pixel (0, 0), and its slopes; zeros if seen edge-on."""
    L = view.inverse_k
    x, y, z, d = plane
    right = x * L[0, 0]
    down = x * L[0, 1] + y * L[1, 1]
    base = x * L[0, 2] + y * L[1, 2]
    if view.is_pinhole:
        if d == 0.0:
            return 0.0, 0.0, 0.0
        return (base + z) / d, right / d, down / d
    if z == 0.0:
        return 0.0, 0.0, 0.0
    return (base - d) / z, right / z, down / z


@kernel
def _number(seen: Int32s, count: int) -> Int32s:
    """Return the visible triangles, out of ``count``, and replace triangles in ``seen`` by their rows."""
    rows, visible, size = np.full(count, -1, np.int32), np.empty(min(count, seen.size), np.int32), 0
    for i in range(seen.shape[0]):
        for j in range(seen.shape[1]):
            triangle = seen[i, j]
            if triangle < 0:
                continue
            if rows[triangle] < 0:
                rows[triangle], visible[size] = size, triangle
                size += 1
            seen[i, j] = rows[triangle]
    return visible[:size].copy()


@kernel
def _planes_of(vertices: Float64s, triangles: Int32s, view: View) -> Float64s:
    planes = np.empty((len(triangles), 3))
    for n in range(len(triangles)):
        a = transformed(view, vertices, triangles[n, 0])
        b = transformed(view, vertices, triangles[n, 1])
        c = transformed(view, vertices, triangles[n, 2])
        planes[n, 0], planes[n, 1], planes[n, 2] = nearness(view, plane_through(a, b, c))
    return planes


@inlined
def _plane_at(seen: Visibility, row: int, column: int) -> Vector:
    """Return the nearness, and its slopes, at a pixel's centre."""
    at = seen.rows[row, column]
    base, right, down = seen.planes[at, 0], seen.planes[at, 1], seen.planes[at, 2]
    x, y = seen.corner[0] + column + 0.5, seen.corner[1] + row + 0.5
    return (
        np.float64(np.float32(base + right * x + down * y)),
        np.float64(np.float32(right)),
        np.float64(np.float32(down)),
    )


@inlined
def tolerance(view: View, near: float, right: float, down: float, size: float) -> float:
    """Return the nearness margin by which an occluder must exceed a point's plane."""
    pixel = (abs(near) if view.is_pinhole else 1.0) / view.focal
    return float((_CLOSE + _ROUGH / (1.0 + size)) * (abs(right) + abs(down) + pixel))


@inlined
def hides(seen: Visibility, row: int, column: int, pixel: Pixel, plane: Vector, slack: float) -> bool:
    """Return whether a pixel's surface hides a point at ``pixel``, by its own plane and by the point's.

    Both must agree: extended beyond a crease, the planes of its two faces pass before each other.
    """
    (x, y), (near, right, down) = pixel, plane
    front, across, along = _plane_at(seen, row, column)
    dx, dy = column + 0.5 - x, row + 0.5 - y
    if near + right * dx + down * dy >= front - slack:
        return False
    return bool(front - across * dx - along * dy > near + slack)


@inlined
def parts(seen: Visibility, row: int, column: int, pixel: Pixel, plane: Vector, slack: float) -> bool:
    """Return whether a pixel's surface and a point's are apart in depth, in either order; see `hides`."""
    (x, y), (near, right, down) = pixel, plane
    dx, dy = column + 0.5 - x, row + 0.5 - y
    front, across, along = _plane_at(seen, row, column)
    at_pixel = near + right * dx + down * dy - front
    at_point = near - (front - across * dx - along * dy)
    return bool((at_pixel < -slack and at_point < -slack) or (at_pixel > slack and at_point > slack))


@inlined
def visible_part(seen: Visibility, triangle: int, pixel: Pixel, plane: Vector, slack: float) -> float:
    """Return the visible fraction of a point, 0 … 1: the bilinear weights of the four pixels that see it."""
    (x, y), (height, width) = pixel, seen.rows.shape
    left, top = np.floor(x - 0.5), np.floor(y - 0.5)
    part_x, part_y = x - 0.5 - left, y - 0.5 - top
    total = 0.0
    for corner in range(4):
        weight = (part_x if corner & 1 else 1.0 - part_x) * (part_y if corner & 2 else 1.0 - part_y)
        column = min(max(int(left) + (corner & 1), 0), width - 1)
        row = min(max(int(top) + (corner >> 1), 0), height - 1)
        other = seen.rows[row, column]
        if (
            other < 0
            or seen.triangles[other] == triangle
            or not hides(seen, row, column, pixel, plane, slack)
        ):
            total += weight
    return total


@kernel
def distances_to_edges(seen: Visibility, view: View, reach: float) -> Float32s:
    """Return each pixel centre's distance to the nearest visible edge, in pixels, at most ``reach``.

    Edges are the image border, the background, and occlusions. Distances step over 8 neighbours and are at
    most 8 % too long.
    """
    height, width = seen.rows.shape
    distances = np.empty((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            rim = min(min(row, height - 1 - row), min(column, width - 1 - column)) + 0.5
            distances[row, column] = min(rim, reach)
            if seen.rows[row, column] < 0:
                distances[row, column] = 0.0
            elif (
                (column + 1 < width and _is_border(seen, view, row, column, row, column + 1))
                or (row + 1 < height and _is_border(seen, view, row, column, row + 1, column))
                or (row > 0 and _is_border(seen, view, row - 1, column, row, column))
                or (column > 0 and _is_border(seen, view, row, column - 1, row, column))
            ):
                distances[row, column] = min(distances[row, column], 0.5)
    diagonal = np.float32(np.sqrt(2.0))
    for turn in range(2):
        step = 1 if turn == 0 else -1
        for n_row in range(height):
            row = n_row if turn == 0 else height - 1 - n_row
            for n_column in range(width):
                column = n_column if turn == 0 else width - 1 - n_column
                nearest = distances[row, column]
                before, above = column - step, row - step
                if 0 <= before < width:
                    nearest = min(nearest, distances[row, before] + np.float32(1.0))
                if 0 <= above < height:
                    nearest = min(nearest, distances[above, column] + np.float32(1.0))
                    if column > 0:
                        nearest = min(nearest, distances[above, column - 1] + diagonal)
                    if column + 1 < width:
                        nearest = min(nearest, distances[above, column + 1] + diagonal)
                distances[row, column] = nearest
    return distances


@inlined
def _is_border(
    seen: Visibility, view: View, row: int, column: int, other_row: int, other_column: int
) -> bool:
    """Return whether an edge separates two adjacent pixels: background, or a surface behind the other."""
    visible, other = seen.rows[row, column], seen.rows[other_row, other_column]
    if visible == other:
        return False
    if visible < 0 or other < 0:
        return True
    return _is_hidden(seen, view, row, column, other_row, other_column) or _is_hidden(
        seen, view, other_row, other_column, row, column
    )


@inlined
def _is_hidden(
    seen: Visibility, view: View, row: int, column: int, other_row: int, other_column: int
) -> bool:
    """Return whether the second pixel's surface continues behind the first pixel's."""
    near, right, down = _plane_at(seen, other_row, other_column)
    slack = tolerance(view, near, right, down, 0.0)
    return hides(seen, row, column, (other_column + 0.5, other_row + 0.5), (near, right, down), slack)
