"""A ring of pictures, disturbed: other exposures, strangers, cameras a little off, noise.

Picture 0 is never exposed otherwise and its camera is never moved: it says how light the whole is, and where.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

import octex
from octex.channels import linear_to_srgb, srgb_to_linear

Array = npt.NDArray[Any]

#: Which pictures a stranger stands in, and how much of each it hides.
STRANGERS, HIDDEN = (1, 5, 8), 0.1
#: What of light is lost in the corners, at most.
_VIGNETTING = 0.4
#: Standard deviation of noise, in codes.
_NOISE = 4.0
#: How `octex.paint` is told to even exposures out.
_EVENED = {"balance": "full", "reference": 0}


class Ring(NamedTuple):
    """Pictures, linear light and alpha (height, width, 4), and what their cameras are taken to be."""

    pictures: Sequence[Array]
    cameras: Sequence[octex.Camera]

    def projections(self) -> list[octex.Projection]:
        """Return what is painted."""
        return [octex.Projection(*pair) for pair in zip(self.pictures, self.cameras, strict=True)]


def disturbances(clean: Ring, surface: octex.Surface) -> Iterator[tuple[str, Ring, dict[str, Any], bool]]:
    """Yield what disturbs a ring, the ring, what octex is told of it, and whether cameras are off."""
    yield "as it is", clean, {}, False
    yield "exposed", exposed(clean), _EVENED, False
    yield "strangers", visited(clean), {}, False
    yield "1 pixel off", moved(clean, surface, 1.0), {}, True
    yield "2 pixels off", moved(clean, surface, 2.0), {}, True
    yield "all together", noisy(visited(exposed(moved(clean, surface, 1.5)))), _EVENED, True


def exposed(ring: Ring) -> Ring:
    """Gains of ± 30 %, white balance of ± 10 %, and vignetting, other for each picture."""
    random = np.random.default_rng(10)
    made = list(ring.pictures[:1])
    for picture, camera in zip(ring.pictures[1:], ring.cameras[1:], strict=True):
        gain = random.uniform(0.7, 1.3) * random.uniform(0.9, 1.1, 3)
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        x, y = x - camera.width / 2, y - camera.height / 2
        radii = np.hypot(x, y) / np.hypot(camera.width / 2, camera.height / 2)
        made.append(picture.copy())
        made[-1][..., :3] *= gain * (1 - random.uniform(0.0, _VIGNETTING) * radii[..., None] ** 2)
    return ring._replace(pictures=made)


def visited(ring: Ring) -> Ring:
    """Put an opaque striped disc into some pictures."""
    random = np.random.default_rng(11)
    made = [picture.copy() for picture in ring.pictures]
    for picture in (made[number] for number in STRANGERS):
        height, width = picture.shape[:2]
        rows, columns = np.nonzero(picture[..., 3])
        at = random.integers(rows.size)
        y, x = np.mgrid[:height, :width]
        across, along = x - columns[at], y - rows[at]
        there = np.hypot(across, along) < np.sqrt(HIDDEN * width * height / np.pi)
        colors = random.uniform(0.02, 0.8, (2, 3)).astype(np.float32)
        stripes = (np.sin((across + 2 * along) * 40 / width) > 0).astype(int)
        picture[there, :3] = colors[stripes[there]]
        picture[there, 3] = 1
    return ring._replace(pictures=made)


def moved(ring: Ring, surface: octex.Surface, pixels: float) -> Ring:
    """Turn and move cameras so that the surface's middle shifts by so many pixels, and zoom them by 0.5 %."""
    random = np.random.default_rng(12)
    middle = surface.bounds.mean(axis=0)
    made = list(ring.cameras[:1])
    for camera in ring.cameras[1:]:
        turn, shift = random.normal(size=(2, 3))
        depth = float(camera.project(middle[None])[1][0])
        pixel = 0.7 * pixels * float(camera.pixel_width(depth))
        view = camera.world_to_camera.copy()
        view[:3] = _rotation(pixel / depth * turn / np.linalg.norm(turn)) @ view[:3]
        view[:3, 3] += pixel * shift / np.linalg.norm(shift)
        K = camera.K.copy()
        K[[0, 1], [0, 1]] *= 1 + 0.005 * random.choice([-1, 1])
        made.append(replace(camera, world_to_camera=view, K=K))
    return ring._replace(cameras=made)


def _rotation(angles: Array) -> Array:
    """Return the matrix of a rotation about a vector, by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(angles))
    x, y, z = angles / max(angle, 1e-300)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turned: Array = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turned


def noisy(ring: Ring) -> Ring:
    """Add noise to the codes of pictures."""
    random = np.random.default_rng(13)
    made = [picture.copy() for picture in ring.pictures]
    for picture in made:
        codes = linear_to_srgb(np.clip(picture[..., :3], 0, 1))
        codes = codes + random.normal(0, _NOISE / 255, codes.shape)
        picture[..., :3] = srgb_to_linear(np.clip(codes, 0, 1))
    return ring._replace(pictures=made)


def shift_of(cameras: Sequence[octex.Camera], truth: Sequence[octex.Camera], points: Array) -> float:
    """Return by how many pixels (root of the mean square) points land elsewhere, at the worst camera."""
    pairs = zip(cameras, truth, strict=True)
    apart = (camera.project(points)[0] - true.project(points)[0] for camera, true in pairs)
    return max(float(np.sqrt((each**2).sum(1).mean())) for each in apart)
