"""A few images into one texture, without UVs.

Three images of the droid, each exposed a little differently, are projected onto its bare mesh and balanced.

    python samples/12_photos.py [FOLDER]      writes FOLDER/photos.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import octex
from octex.channels import encode
from octex.drawing import source_shader
from octex.drawing.hits import rest_normals, visible_hits

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "11"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "480"))
MODEL = Path(__file__).with_name("droid.glb")
SIDES, LIGHTS = ((1, 0.15, 0.35), (-0.8, 0.3, 0.8), (-0.1, 0.3, -1)), (1.0, 0.8, 1.2)


def photo(surface: octex.Surface, camera: octex.Camera, exposure: float) -> np.ndarray:
    image = np.zeros((camera.height * camera.width, 4), np.float32)
    for pixels, hits in visible_hits(surface, camera, rest_normals(surface)):
        image[pixels, :3], image[pixels, 3] = exposure * source_shader(surface)(hits).unlit(), 1.0
    return image.reshape(camera.height, camera.width, 4)


def main(folder: Path) -> None:
    surface = octex.load_surface(MODEL, channels=["base_color"])
    head = surface.vertices[(surface.vertices[:, 1] > 0.43) & (surface.vertices[:, 1] < 0.64)]
    cameras = [octex.Camera.fitted(head, side, size=(2 * SIZE, 2 * SIZE)) for side in SIDES]
    photos = [photo(surface, camera, light) for camera, light in zip(cameras, LIGHTS, strict=True)]
    projections = [octex.Projection(image, camera) for image, camera in zip(photos, cameras, strict=True)]
    texture = octex.paint(None, surface, projections, max_depth=DEPTH, balance="full")
    shown = [encode(p[::2, ::2, :3] + (1 - p[::2, ::2, 3:]), "uint8", "srgb") for p in photos]
    view = octex.Camera.fitted(head, (0.5, 0.3, 1), size=(SIZE * 3 // 2, SIZE))
    both = [octex.render(each, surface, view) for each in (texture, None)]
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.vstack([np.hstack(shown), np.hstack(both)])).save(folder / "photos.png")
    print(f"{folder / 'photos.png'}: three images; painted with them, and the truth; {texture.tree!r}")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
