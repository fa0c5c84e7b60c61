"""A box that commands paint."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

import octex
from tests.make.command import colored_box
from tests.make.same import assert_same

SIZE = 40
SQUARE = (16, 16, 23, 23)  # in the image's middle, on the box: left, top, right, bottom, all inside


class Scene:
    """A box with its texture, a camera before it and images for that."""

    def __init__(self, folder: Path) -> None:
        self.model = colored_box(folder)
        self.surface = octex.load_surface(self.model)
        self.texture = folder / "box.octex"
        octex.convert(self.model, 4).save(self.texture)
        self.camera = octex.Camera.fitted(self.surface.vertices, (0.4, 0.3, 1), size=(SIZE, SIZE))
        self.cameras = folder / "cameras.json"
        octex.write_cameras(self.cameras, {"square.png": self.camera, "blue.png": self.camera})
        self.square = folder / "square.png"
        paint = np.zeros((SIZE, SIZE, 4), np.uint8)
        paint[SQUARE[1] : SQUARE[3] + 1, SQUARE[0] : SQUARE[2] + 1] = [255, 0, 0, 255]
        Image.fromarray(paint).save(self.square)
        self.blue = folder / "blue.png"
        Image.fromarray(np.full((SIZE, SIZE, 3), [0, 0, 255], np.uint8)).save(self.blue)

    @property
    def shot(self) -> list[Any]:
        """Arguments to paint the square."""
        return [self.texture, self.model, self.square, "--camera", f"{self.cameras}#square.png"]

    def places(self, beside: float) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        """Return rest positions that the camera sees, and whether they are so many pixels in the square."""
        samples = self.surface.scatter(4000)
        toward = self.camera.position - samples.points
        seen = np.einsum("nk,nk->n", toward, samples.normals) > 0.5 * np.linalg.norm(toward, axis=1)
        pixels, _ = self.camera.project(samples.points[seen])
        low, high = np.array(SQUARE[:2]) + beside, np.array(SQUARE[2:]) + 1 - beside
        return samples.rest[seen], ((pixels >= low) & (pixels <= high)).all(axis=1)


def assert_painted(one: octex.OctreeTexture, other: octex.OctreeTexture) -> None:
    """Two textures are the same, and lie in the same place; a command's metadata say more."""
    assert_same(one, other)
    assert one.placement == other.placement
    np.testing.assert_array_equal(one.bounds, other.bounds)
