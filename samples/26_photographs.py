"""From photographs to a .glb: passers-by, exposures and cameras a little off.

Eight pictures of the droid are each exposed otherwise and darker in the corners; in three of them something
stands before it, and their cameras are a pixel or two off. They are painted as an average, and then robustly,
balanced and with refined cameras; that is baked to a .glb.

    python samples/26_photographs.py [FOLDER]      writes FOLDER/photographs.png and .glb (default: out)
"""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import octex
from octex.channels import encode
from octex.preview import render, source_shader, texture_shader
from octex.preview.pictures import rest_normals, visible_hits

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "10"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "320"))
MODEL = Path(__file__).with_name("droid.glb")
COUNT, PASSED = 8, {1: (0.45, 0.5), 3: (0.6, 0.4), 6: (0.4, 0.6)}


def photo(surface: octex.Surface, camera: octex.Camera) -> np.ndarray:
    image = np.zeros((camera.height * camera.width, 4), np.float32)
    for pixels, hits in visible_hits(surface, camera, rest_normals(surface)):
        image[pixels, :3], image[pixels, 3] = source_shader(surface)(hits).unlit(), 1.0
    return image.reshape(camera.height, camera.width, 4)


def disturbed(image: np.ndarray, number: int) -> np.ndarray:
    """Return a picture as a hurried photographer takes it; the first one is as it should be."""
    random = np.random.default_rng(number)
    size = len(image)
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    image = image.copy()
    if number in PASSED:
        across, down = PASSED[number]
        there = np.hypot(x - across, 0.6 * (y - down)) < 0.13
        image[there] = *random.uniform(0.02, 0.6, 3), 1.0
    if number:
        light = random.uniform(0.7, 1.3) * random.uniform(0.9, 1.1, 3)
        image[..., :3] *= light * (1 - 0.5 * ((x - 0.5) ** 2 + (y - 0.5) ** 2))[..., None]
    return image


def off(camera: octex.Camera, number: int) -> octex.Camera:
    """Return a camera that is moved by a pixel or two; the first one is where it was."""
    view = camera.world_to_camera.copy()
    view[:3, 3] += min(number, 1) * 0.002 * np.random.default_rng(number).normal(size=3)
    return replace(camera, world_to_camera=view)


def main(folder: Path) -> None:
    surface = octex.load_surface(MODEL, channels=["base_color"])
    head = surface.vertices[(surface.vertices[:, 1] > 0.43) & (surface.vertices[:, 1] < 0.64)]
    turns = 2 * np.pi * np.arange(COUNT) / COUNT + 0.3
    sides = [(np.sin(turn), 0.25 * (-1) ** n + 0.1, np.cos(turn)) for n, turn in enumerate(turns)]
    cameras = [octex.Camera.fitted(head, side, size=(2 * SIZE, 2 * SIZE)) for side in sides]
    photos = [disturbed(photo(surface, camera), n) for n, camera in enumerate(cameras)]
    taken = [off(camera, n) for n, camera in enumerate(cameras)]
    pictures = [octex.Projection(*each) for each in zip(photos, taken, strict=True)]

    averaged = octex.paint(None, surface, pictures, max_depth=DEPTH, pictures="average")
    refined = octex.refine_cameras(surface, pictures, reference=0)
    pictures = [octex.Projection(*each) for each in zip(photos, refined, strict=True)]
    painted = octex.paint(None, surface, pictures, max_depth=DEPTH, balance="full", reference=0)

    folder.mkdir(parents=True, exist_ok=True)
    octex.write_model(octex.bake(painted, surface, texture_size=1024), folder / "photographs.glb")
    shown = [photos[n][::2, ::2] for n in (0, 1, 3)]
    top = [encode(each[..., :3] + (1 - each[..., 3:]), "uint8", "srgb") for each in shown]
    view = octex.Camera.fitted(head, sides[1], size=(SIZE, SIZE))
    looks = texture_shader(averaged), texture_shader(painted), source_shader(surface)
    below = [encode(render(surface, view, look), "uint8", "srgb") for look in looks]
    Image.fromarray(np.vstack([np.hstack(top), np.hstack(below)])).save(folder / "photographs.png")
    print(
        f"{folder / 'photographs.png'}: three of {COUNT} pictures; averaged, painted robustly, and the truth"
    )


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
