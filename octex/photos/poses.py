"""Cameras turned, moved and zoomed a little, and what their pictures then show of points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int64s
from octex.cameras.camera import Camera
from octex.jit import kernel
from octex.painting.picture import Mips

#: Numbers of a camera that change: turns about three axes, moves along them, zoom.
NUMBERS = 7
#: By how many pixels cameras are moved to see what changes.
_TRIAL = 1e-3


class Observations(NamedTuple):
    """Pictures at a level, and who sees which points."""

    cameras: Sequence[Camera]  # as given
    scales: Sequence[float]  # see `pixel_at`
    points: Float64s  # (n, 3)
    pictures: Sequence[Mips]
    level: int  # that is read
    gains: Float32s  # (pictures, 3)
    weights: Float64s  # (pictures, n)   how well a picture sees a point

    def at(self, some: Int64s) -> Observations:
        """Return the same at some of the points."""
        return self._replace(points=self.points[some], weights=self.weights[:, some])

    def seen_by(self, n: int, numbers: Float64s) -> tuple[Float64s, Float64s]:
        """Return what a picture shows of the points that it sees (k, 3), and how that changes."""
        some = self.points[self.weights[n] > 0]
        picture, camera, scale = self.pictures[n], self.cameras[n], self.scales[n]
        return _seen(picture, self.level, camera, some, scale, numbers, self.gains[n])

    def seen(self, numbers: Float64s) -> tuple[Float64s, Float64s]:
        """Return what pictures show (pictures, n · 3), and how that changes with numbers of cameras."""
        values = np.full((*self.weights.shape, 3), np.nan)
        slopes = np.zeros((*values.shape, NUMBERS))
        for n, sees in enumerate(self.weights > 0):
            values[n, sees], slopes[n, sees] = self.seen_by(n, numbers[n])
        return values.reshape(len(values), -1), np.nan_to_num(slopes).reshape(len(slopes), -1, NUMBERS)


def _seen(
    picture: Mips,
    level: int,
    camera: Camera,
    points: Float64s,
    scale: float,
    numbers: Float64s,
    gains: Float32s,
) -> tuple[Float64s, Float64s]:
    """Return what a picture shows of points (n, 3), and how that changes with the camera's numbers."""
    level = min(level, len(picture.sizes) - 1)
    size = picture.sizes[level, 1:] / [camera.width, camera.height]
    pixels, _ = adjusted(camera, scale, numbers).project(points)
    read = np.empty((len(points), 9))
    _read(picture.pixels, picture.sizes[level], pixels * size, read)
    read *= np.tile(np.sqrt(gains), 3)
    slopes = np.empty((len(points), 3, NUMBERS))
    for number in range(NUMBERS):
        step = numbers.copy()
        step[number] += _TRIAL
        there, _ = adjusted(camera, scale, step).project(points)
        shift = (there - pixels) * size / _TRIAL
        slopes[..., number] = read[:, 3:6] * shift[:, :1] + read[:, 6:] * shift[:, 1:]
    return read[:, :3], slopes


@kernel
def _read(pixels: Float32s, size: Int64s, places: Float64s, found: Float64s) -> None:
    """Write square roots of a level's light at places (n, 2), and their slopes across and down (n, 9).

    Between the middles of pixels both are linear. NaN outside these, and where there is no paint.
    """
    first, width, height = size[0], size[1], size[2]
    light = np.empty((4, 4, 3))
    for n in range(len(places)):
        found[n] = np.nan
        x, y = places[n, 0] - 0.5, places[n, 1] - 0.5
        if not (0.0 <= x <= width - 1 and 0.0 <= y <= height - 1):
            continue
        left, top = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
        for i in range(4):
            row = first + min(max(top + i - 1, 0), height - 1) * width
            for j in range(4):
                pixel = pixels[row + min(max(left + j - 1, 0), width - 1)]
                for k in range(3):
                    light[i, j, k] = np.nan
                    if pixel[3] >= np.float32(0.5):
                        light[i, j, k] = np.sqrt(max(pixel[k] / pixel[3], np.float32(0.0)))
        u, v = x - left, y - top
        for k in range(9):
            found[n, k] = 0.0
        for i in range(1, 3):
            for j in range(1, 3):
                weight = (u if j == 2 else 1.0 - u) * (v if i == 2 else 1.0 - v)
                for k in range(3):
                    found[n, k] += weight * light[i, j, k]
                    found[n, k + 3] += weight * 0.5 * (light[i, j + 1, k] - light[i, j - 1, k])
                    found[n, k + 6] += weight * 0.5 * (light[i + 1, j, k] - light[i - 1, j, k])


def pixel_at(camera: Camera, points: Float64s) -> float:
    """Return how wide a camera's pixel is in the middle of points (n, 3)."""
    focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    depths = points @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    return (abs(float(np.median(depths))) if camera.projection == "pinhole" else 1.0) / focal


def adjusted(camera: Camera, scale: float, numbers: Float64s) -> Camera:
    """Return a camera turned and moved so that points shift by so many pixels, and zoomed likewise.

    ``scale`` is how wide its pixels are there; see `pixel_at`.
    """
    size = max(camera.width, camera.height)
    view = camera.world_to_camera.copy()
    focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1])) if camera.projection == "pinhole" else size
    view[:3] = _rotation(numbers[:3] / focal) @ view[:3]
    view[:3, 3] += numbers[3:6] * scale
    K = camera.K.copy()
    K[:2, :2] *= np.exp(numbers[6] / (size / 2))
    return replace(camera, world_to_camera=view, K=K)


def _rotation(angles: Float64s) -> Float64s:
    """Return the matrix (3, 3) of a rotation about a vector, by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(angles))
    x, y, z = angles / max(angle, 1e-300)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    found: Float64s = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return found
