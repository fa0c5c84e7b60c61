"""Soft light from near the camera, of little contrast, so that colours stay comparable; and the backdrop.

All values are linear light. The lights turn with the camera.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from octex.arrays import Float32s, Float64s
from octex.cameras.camera import Camera
from octex.jit import kernel

# In camera axes: x right, y down, z away from the camera.
_KEY_FROM, _KEY = (-0.45, -0.65, -0.61), 0.52
_FILL_FROM, _FILL = (0.85, 0.10, -0.52), 0.12
_FROM_ABOVE, _FROM_BELOW = 0.52, 0.30


def light(camera: Camera, points: npt.ArrayLike, faces: npt.ArrayLike, normals: npt.ArrayLike) -> Float32s:
    """Return the light (n,), 0.35 to 1.03, on the visible side; multiply base colours by it.

    points     (n, 3) in the world
    faces      (n, 3) face normals: they decide which side is visible
    normals    (n, 3) shading normals on the same side as the face normals; of any length
    """
    points, faces, normals = (np.ascontiguousarray(array, np.float64) for array in (points, faces, normals))
    lit = np.empty(len(points), np.float32)
    perspective = camera.projection == "pinhole"
    _light(points, faces, normals, camera.world_to_camera, camera.position, perspective, lit)
    return lit


@kernel
def _light(
    points: Float64s, faces: Float64s, normals: Float64s, view: Float64s, position: Float64s,
    perspective: bool, lit: Float32s,
) -> None:  # fmt: skip
    for n in range(len(points)):
        away = 0.0
        for axis in range(3):
            toward = points[n, axis] - position[axis] if perspective else view[2, axis]
            away += faces[n, axis] * toward
        side = -1.0 if away > 0.0 else 1.0
        x, y, z = normals[n, 0] * side, normals[n, 1] * side, normals[n, 2] * side
        length = np.sqrt(x * x + y * y + z * z)
        scale = 1.0 / length if length > 0.0 else 0.0
        right = (view[0, 0] * x + view[0, 1] * y + view[0, 2] * z) * scale
        down = (view[1, 0] * x + view[1, 1] * y + view[1, 2] * z) * scale
        ahead = (view[2, 0] * x + view[2, 1] * y + view[2, 2] * z) * scale
        # Half-Lambert: lights so large that they reach around the edge.
        key = 0.5 + 0.5 * (right * _KEY_FROM[0] + down * _KEY_FROM[1] + ahead * _KEY_FROM[2])
        fill = 0.5 + 0.5 * (right * _FILL_FROM[0] + down * _FILL_FROM[1] + ahead * _FILL_FROM[2])
        ambient = 0.5 * (_FROM_ABOVE + _FROM_BELOW) - 0.5 * (_FROM_ABOVE - _FROM_BELOW) * down
        lit[n] = ambient + _KEY * key * key + _FILL * fill * fill


def background(height: int, width: int) -> Float32s:
    """Return a grey backdrop (height, width, 3), constant along rows, brightest slightly below the middle."""
    down = (np.arange(height) + 0.5) / height
    grey = 0.40 - 0.40 * (down - 0.55) ** 2
    return np.broadcast_to(grey[:, None, None], (height, width, 3)).astype(np.float32)
