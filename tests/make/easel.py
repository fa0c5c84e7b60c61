"""A model that a page paints with images."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import octex
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from tests.make.browser import sharp
from tests.make.fixtures import saved
from tests.make.same import assert_same
from tests.make.studio import Studio


class Easel(Studio):
    """A model, a page that paints it, and what that page has sent."""

    def __init__(self, browser: Any, folder: Path, surface: Surface | None = None) -> None:
        super().__init__(browser, folder, surface, depth=8)  # about as fine as the view
        self.bodies: list[bytes] = []
        take = self.session.take

        def taken(body: bytes) -> int:
            self.bodies.append(body)
            return take(body)

        self.session.take = taken

    def clear(self) -> None:
        """Undo all, and forget what the page has sent."""
        self.shown.evaluate(
            """async () => {
              const { painting } = viewer;
              painting.stencil.remove();
              painting.stencil.set({ colors: "own", isThrough: true, isMirrored: false });
              painting.retouch.set({ point: null, offset: null, effect: "blur", radius: 4 });
              painting.selectTool("brush");
              painting.set({ size: 40, hardness: 0.7, opacity: 1, mirror: "" });
              viewer.camera.reset(0.55, 0.3);
              for (let n = painting.status.done; n > 0; n--) painting.commands.send({ kind: "undo" });
              await painting.commands.flush();
            }"""
        )
        self.done()
        assert_same(self.session.shown.texture, self.texture)
        self.bodies.clear()

    def done(self) -> None:
        """Wait until the page shows all that it has sent."""
        self.is_done(self.shown)
        sharp(self.shown)

    def lay(self, image: npt.NDArray[np.uint8], name: str = "photo.png") -> None:
        """Choose an image as stencil."""
        self.give(name, saved(image))
        self.shown.wait_for_function("viewer.painting.stencil.bitmap")

    def give(self, name: str, content: bytes) -> None:
        file = {"name": name, "mimeType": "image/png", "buffer": content}
        self.shown.set_input_files("#stencil-section input[type=file]", file)

    def says(self, text: str) -> None:
        self.shown.wait_for_function(
            "(text) => document.getElementById('paint-note').textContent.includes(text)", arg=text
        )

    def sent(self) -> tuple[dict[str, Any], npt.NDArray[np.uint8], octex.Camera]:
        """Return the last stroke that was sent, as an image of the view."""
        line, _, content = self.bodies[-1].partition(b"\n")
        given = json.loads(line)
        left, top, right, bottom = given["box"]
        width, height = given["camera"]["width"], given["camera"]["height"]
        planes = np.frombuffer(zlib.decompress(content, -15), np.uint8)
        image = np.zeros((height, width, 4), np.uint8)
        image[top:bottom, left:right] = planes.reshape(4, bottom - top, right - left).transpose(1, 2, 0)
        pose, K = np.array(given["camera"]["pose"]), np.array(given["camera"]["K"])
        camera = octex.Camera.pinhole((width, height), pose=pose, convention="opencv", K=K)
        return given, image, camera

    def painted(self, image: Any, camera: octex.Camera, since: Any = None, **options: Any) -> OctreeTexture:
        """Return the model painted by the library."""
        projection = octex.Projection(image, camera, since=since)
        return octex.paint(self.texture, self.surface, projection, **{"max_angle": 85, **options})
