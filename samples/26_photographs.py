"""Eight images with passers-by, other exposures and cameras a little off, painted robustly and baked.

python samples/26_photographs.py [FOLDER]      writes FOLDER/photographs.png and .glb (default: out)
"""

import os
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
from PIL import Image

import octex
from octex.channels import encode

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "10"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "320"))


def taken(surface: octex.Surface, camera: octex.Camera, number: int) -> octex.Projection:
    random, image = np.random.default_rng(number), import_module("12_photos").photo(surface, camera, 1.0)
    y, x = (np.mgrid[: 2 * SIZE, : 2 * SIZE] + 0.5) / (2 * SIZE) - 0.5
    if number in (1, 3, 6):
        image[np.hypot(x, 0.6 * y) < 0.12] = *random.uniform(0.02, 0.6, 3), 1.0
    if number:  # the first one is as it should be
        image[..., :3] *= (random.uniform(0.7, 1.3) * (1 - 0.5 * (x**2 + y**2)))[..., None]
        off = np.pad(0.002 * random.normal(size=(3, 1)), ((0, 1), (3, 0)))
        camera = replace(camera, world_to_camera=camera.world_to_camera + off)
    return octex.Projection(image, camera)


folder = Path(*sys.argv[1:2] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
surface = octex.load_surface(Path(__file__).with_name("droid.glb"), channels=["base_color"])
head = surface.vertices[(surface.vertices[:, 1] > 0.43) & (surface.vertices[:, 1] < 0.64)]
sides = [(np.sin(0.3 + 0.785 * n), 0.1 + 0.25 * (-1) ** n, np.cos(0.3 + 0.785 * n)) for n in range(8)]
photos = [taken(surface, octex.Camera.fitted(head, sides[n], size=(2 * SIZE,) * 2), n) for n in range(8)]
averaged = octex.paint(None, surface, photos, max_depth=DEPTH, pictures="average")
refined = octex.refine_cameras(surface, photos, reference=0)
mended = [replace(photo, camera=camera) for photo, camera in zip(photos, refined, strict=True)]
painted = octex.paint(None, surface, mended, max_depth=DEPTH, balance="full", reference=0)
octex.write_model(octex.bake(painted, surface, texture_size=1024), folder / "photographs.glb")
camera = octex.Camera.fitted(head, sides[1], size=(SIZE, SIZE))
below = [octex.render(each, surface, camera) for each in (averaged, painted, None)]
above = encode(np.hstack([photos[n].image[::2, ::2, :3] for n in (0, 1, 3)]), "uint8", "srgb")
Image.fromarray(np.vstack([above, np.hstack(below)])).save(folder / "photographs.png")
print(f"{folder / 'photographs.png'}: three images; averaged, painted robustly, and the truth")
