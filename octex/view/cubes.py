"""A z-buffer of axis-aligned cubes: draws the cells of an octree."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int8s, Int32s
from octex.cameras.camera import Camera
from octex.jit import kernel


class CubeBuffers(NamedTuple):
    """The nearest cube of each pixel; row 0 is the top of the image."""

    cube: Int32s  # (height, width)   number of the nearest cube; −1: none
    axis: Int8s  # (height, width)   normal axis of the visible face: 0, 1 or 2
    border: Float32s  # (height, width)   distance to the face's border, 0 … ½ of the edge
    depth: Float64s  # (height, width)   along the camera's axis; inf without a cube


def rasterize_cubes(
    corners: Float64s, edges: Float64s, camera: Camera, behind: CubeBuffers | None = None
) -> CubeBuffers:
    """Find the cube that each pixel's centre sees.

    corners    (n, 3) float64: each cube's corner of smallest coordinates, in the world
    edges      (n,) float64: edge lengths
    behind     an earlier result: return the next layer behind it, and nothing where it has no cube

    At equal depth the first cube wins. Cubes that reach to depth 0 or less are invisible.
    """
    shape = camera.height, camera.width
    buffers = CubeBuffers(
        np.full(shape, -1, np.int32),
        np.zeros(shape, np.int8),
        np.zeros(shape, np.float32),
        np.full(shape, np.inf),
    )
    unproject = np.linalg.inv(camera.K)
    to_world = camera.world_to_camera[:3, :3].T
    if camera.projection == "pinhole":
        origins, directions = np.zeros((3, 3)), to_world @ unproject
    else:
        origins = to_world @ np.diag([1.0, 1.0, 0.0]) @ unproject
        directions = to_world @ np.diag([0.0, 0.0, 1.0])
    if behind is None:
        behind = CubeBuffers._make(array[:0] for array in buffers)
    _draw(corners, edges, camera.matrix, camera.position, origins, directions, behind, buffers)
    return buffers


@kernel
def _draw(
    corners: Float64s,
    edges: Float64s,
    matrix: Float64s,
    position: Float64s,
    origins: Float64s,
    directions: Float64s,
    behind: CubeBuffers,
    buffers: CubeBuffers,
) -> None:
    """Intersect the rays of a cube's bounding rectangle with the cube (slabs: Kay & Kajiya 1986).

    The ray of the pixel centre p = (x, y, 1) is position + origins · p + depth · directions · p.
    """
    cubes, axes, borders, depths = buffers
    height, width = cubes.shape
    start, toward = np.empty(3), np.empty(3)
    for n in range(len(corners)):
        corner, edge = corners[n], edges[n]
        rectangle = _rectangle(corner, edge, matrix, width, height)
        for row in range(rectangle[2], rectangle[3]):
            for column in range(rectangle[0], rectangle[1]):
                x, y = column + 0.5, row + 0.5
                enter, leave, across = 0.0, np.inf, -1
                for axis in range(3):
                    start[axis] = (
                        position[axis] + origins[axis, 0] * x + origins[axis, 1] * y + origins[axis, 2]
                    )
                    toward[axis] = directions[axis, 0] * x + directions[axis, 1] * y + directions[axis, 2]
                    if toward[axis] == 0.0:
                        toward[axis] = 1e-300
                    low = (corner[axis] - start[axis]) / toward[axis]
                    high = (corner[axis] + edge - start[axis]) / toward[axis]
                    if min(low, high) > enter:
                        enter, across = min(low, high), axis
                    leave = min(leave, max(low, high))
                if across >= 0 and enter <= leave and enter < depths[row, column]:
                    if len(behind.cube) > 0:
                        last, further = behind.cube[row, column], enter - behind.depth[row, column]
                        if last < 0 or further < 0.0 or (further == 0.0 and n <= last):
                            continue
                    depths[row, column] = enter
                    cubes[row, column] = n
                    axes[row, column] = across
                    border = 0.5
                    for axis in range(3):
                        if axis != across:
                            inside = (start[axis] + enter * toward[axis] - corner[axis]) / edge
                            border = min(border, max(min(inside, 1.0 - inside), 0.0))
                    borders[row, column] = border


@kernel
def _rectangle(
    corner: Float64s, edge: float, matrix: Float64s, width: int, height: int
) -> tuple[int, int, int, int]:
    """Return the column range, then the row range, [first, end) of pixel centres that a cube may cover."""
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for vertex in range(8):
        x = corner[0] + edge * (vertex & 1)
        y = corner[1] + edge * (vertex >> 1 & 1)
        z = corner[2] + edge * (vertex >> 2)
        w = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
        depth = matrix[3, 0] * x + matrix[3, 1] * y + matrix[3, 2] * z + matrix[3, 3]
        if not (depth > 0.0 and w > 0.0):
            return 0, 0, 0, 0
        column = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / w
        row = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / w
        low_x, high_x = min(low_x, column), max(high_x, column)
        low_y, high_y = min(low_y, row), max(high_y, row)
    # Widened by the rounding error, and clipped to the image so that it fits an integer.
    return (
        int(np.ceil(min(max(low_x - 0.501, 0.0), float(width)))),
        int(np.floor(min(max(high_x + 0.501, 0.0), float(width)))),
        int(np.ceil(min(max(low_y - 0.501, 0.0), float(height)))),
        int(np.floor(min(max(high_y + 0.501, 0.0), float(height)))),
    )
