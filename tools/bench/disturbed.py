"""What a ring of images gives back when it is disturbed: exposures, strangers, cameras a little off, noise.

Each time it is painted as an average, and then as well as octex can: robust, balanced, with refined cameras.

Image 0 is never exposed otherwise and its camera is never moved: it says how light the whole is, and where.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from time import process_time
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from measuring import Setup, decibels, table

import octex
from octex.channels import linear_to_srgb, srgb_to_linear
from tests.make.painted import codes

Array = npt.NDArray[Any]

#: Which images a stranger stands in, and how much of each it hides.
STRANGERS, HIDDEN = (1, 5, 8), 0.1
#: What of light is lost in the corners, at most.
_VIGNETTING = 0.4
#: Standard deviation of noise, in codes.
_NOISE = 4.0


class Ring(NamedTuple):
    """Images, linear light and alpha (height, width, 4), and what their cameras are taken to be."""

    images: Sequence[Array]
    cameras: Sequence[octex.Camera]

    def projections(self) -> list[octex.Projection]:
        """Return what is painted."""
        return [octex.Projection(*pair) for pair in zip(self.images, self.cameras, strict=True)]


def exposed(ring: Ring) -> Ring:
    """Gains of ± 30 %, white balance of ± 10 %, and vignetting, other for each image."""
    random = np.random.default_rng(10)
    made = []
    for number, (image, camera) in enumerate(zip(ring.images, ring.cameras, strict=True)):
        gain = random.uniform(0.7, 1.3) * random.uniform(0.9, 1.1, 3)
        lost = random.uniform(0.0, _VIGNETTING)
        if number == 0:
            gain, lost = np.ones(3), 0.0
        made.append(image * np.append(gain, 1).astype(np.float32))
        made[-1][..., :3] *= 1 - np.float32(lost) * _radii(camera)[..., None] ** 2
    return ring._replace(images=made)


def _radii(camera: octex.Camera) -> Array:
    """Return how far pixels are from the middle: 1 in the corners."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    x, y = x - camera.width / 2, y - camera.height / 2
    return (np.hypot(x, y) / np.hypot(camera.width / 2, camera.height / 2)).astype(np.float32)


def visited(ring: Ring) -> tuple[Ring, list[Array]]:
    """Put an opaque striped disc into some images; return also where it is in each (height, width)."""
    random = np.random.default_rng(11)
    made, hidden = [], []
    for number, image in enumerate(ring.images):
        there = np.zeros(image.shape[:2], np.bool_)
        image = image.copy()
        if number in STRANGERS:
            height, width = there.shape
            rows, columns = np.nonzero(image[..., 3])
            at = random.integers(rows.size)
            y, x = np.mgrid[:height, :width]
            across, along = x - columns[at], y - rows[at]
            there = np.hypot(across, along) < np.sqrt(HIDDEN * width * height / np.pi)
            colors = random.uniform(0.02, 0.8, (2, 3)).astype(np.float32)
            stripes = (np.sin((across + 2 * along) * 40 / width) > 0).astype(int)
            image[there, :3] = colors[stripes[there]]
            image[there, 3] = 1
        made.append(image)
        hidden.append(there)
    return ring._replace(images=made), hidden


def moved(ring: Ring, surface: octex.Surface, pixels: float) -> Ring:
    """Turn and move cameras so that the surface's middle shifts by so many pixels, and zoom them by 0.5 %."""
    random = np.random.default_rng(12)
    middle = surface.bounds.mean(axis=0)
    made = list(ring.cameras[:1])
    for camera in ring.cameras[1:]:
        turn, shift = random.normal(size=(2, 3))
        depth = float(camera.project(middle[None])[1][0])
        pixel = float(camera.pixel_width(depth))
        angle = 0.7 * pixels * pixel / depth * turn / np.linalg.norm(turn)
        view = camera.world_to_camera.copy()
        view[:3, :3] = _rotation(angle) @ view[:3, :3]
        view[:3, 3] = _rotation(angle) @ view[:3, 3]
        view[:3, 3] += 0.7 * pixels * pixel * shift / np.linalg.norm(shift)
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
    """Add noise to the codes of images."""
    random = np.random.default_rng(13)
    made = []
    for image in ring.images:
        encoded = linear_to_srgb(np.clip(image[..., :3], 0, 1))
        encoded = encoded + random.normal(0, _NOISE / 255, encoded.shape)
        made.append(image.copy())
        made[-1][..., :3] = srgb_to_linear(np.clip(encoded, 0, 1))
    return ring._replace(images=made)


def shifts(cameras: Sequence[octex.Camera], truth: Sequence[octex.Camera], points: Points) -> Array:
    """Return by how many pixels (root of the mean square) points that a camera sees land elsewhere."""
    found = []
    for camera, true, seen in zip(cameras, truth, points.seen, strict=True):
        apart = camera.project(points.samples.points[seen])[0] - true.project(points.samples.points[seen])[0]
        found.append(np.sqrt((apart**2).sum(1).mean()))
    return np.array(found)


#: By disturbance: options for `octex.paint`, and whether cameras are refined.
_OPTIONS: Mapping[str, tuple[Mapping[str, Any], bool]] = {
    "exposed": ({"balance": "full", "reference": 0}, False),
    "strangers": ({}, False),
    "1 pixel off": ({}, True),
    "2 pixels off": ({}, True),
    "all together": ({"balance": "full", "reference": 0}, True),
}
#: Ghosts differ by more than this, in 1/255, from the clean ring.
_GHOST = 8.0
#: Ghosts are sought at points that so many images see, and at most so many of them disturbed.
_SEEN, _DISTURBED = 4, 1


class Points(NamedTuple):
    """Where painted textures are compared with the truth."""

    samples: Any
    truth: Array  # (n, components), in 1/255
    seen: Array  # (images, n), whether an image sees a point


def disturbed(
    setup: Setup, name: str, surface: octex.Surface, ring: Ring, depth: int, points: Points
) -> None:
    """Paint a ring disturbed, as an average and as well as octex can; print a table.

    "shown" are decibels at points that an image shows: strangers do not hide them in all.
    """

    def painted(given: Ring, **options: Any) -> tuple[Array, float]:
        texture = octex.paint(None, surface, given.projections(), max_depth=depth, **options)
        found = codes(texture.sample(points.samples.rest, normals=points.samples.normals))
        return found, decibels((found - points.truth)[points.seen.any(axis=0)])

    clean, _ = painted(ring)
    rows = []
    for what, (given, hidden) in disturbances(ring.images, ring.cameras, surface).items():
        options, refines = _OPTIONS[what]
        if setup.quick and what not in ("strangers", "all together"):
            continue  # all together goes the same ways
        averaged = painted(given, pictures="average")[1]
        off = ["", ""]
        began = process_time()
        if refines:
            before = shifts(given.cameras, ring.cameras, points).max()
            cameras = octex.refine_cameras(surface, given.projections(), reference=0)
            given = given._replace(cameras=cameras)
            off = [f"{before:.2f}", f"{shifts(cameras, ring.cameras, points).max():.2f}"]
        found, figure = painted(given, **options)
        spent = process_time() - began
        ghosts = shown = ""
        if hidden is not None:
            count, sees = _hiding(ring, hidden, points), points.seen.sum(axis=0)
            shown = f"{decibels((found - points.truth)[sees > count]):.1f}"
            many = (sees >= _SEEN) & (count <= _DISTURBED)
            is_ghost = np.abs(found - clean).max(axis=1)[many] > _GHOST
            ghosts = f"{100 * is_ghost.sum() / max(is_ghost.size, 1):.2f} %"
        rows.append([what, f"{averaged:.1f}", f"{figure:.1f}", *off, ghosts, shown, f"{spent:.0f} s"])
    heads = ["averaged, dB", "octex, dB", "off, pixels", "refined", "ghosts", "shown, dB", "cpu"]
    table([f"{name}, disturbed", *heads], rows)


def _hiding(ring: Ring, hidden: Sequence[Array], points: Points) -> Array:
    """Return in how many of the images that see a point a stranger hides it (n,)."""
    count = np.zeros(points.seen.shape[1], np.int64)
    for camera, there, seen in zip(ring.cameras, hidden, points.seen, strict=True):
        pixels, _ = camera.project(points.samples.points)
        i, j = np.clip(pixels.astype(np.int64), 0, [camera.width - 1, camera.height - 1]).T
        count += seen & there[j, i]
    return count


def disturbances(
    images: Sequence[Array], cameras: Sequence[octex.Camera], surface: octex.Surface
) -> Mapping[str, tuple[Ring, Sequence[Array] | None]]:
    """Return the ring as it is disturbed, by what, and where strangers are."""
    clean = Ring(images, cameras)
    strangers, hidden = visited(clean)
    all_of_it, _ = visited(exposed(moved(clean, surface, 1.5)))
    return {
        "exposed": (exposed(clean), None),
        "strangers": (strangers, hidden),
        "1 pixel off": (moved(clean, surface, 1.0), None),
        "2 pixels off": (moved(clean, surface, 2.0), None),
        "all together": (noisy(all_of_it), hidden),
    }
