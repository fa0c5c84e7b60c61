"""The concepts in images: cells, the field, footprints, and paint finer than the texture.

python samples/draw_concepts.py [FOLDER]      writes cells, field, footprints and kept .png (default: out)
"""

import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import octex
from octex.channels import encode
from octex.drawing.hits import Hits, rest_normals, visible_hits

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "8"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "300"))
MODEL = Path(__file__).with_name("droid.glb")
SIDE = (0.9, 0.25, 0.6)


def save(path: Path, *images: np.ndarray) -> None:
    Image.fromarray(np.hstack(images)).save(path, optimize=True)
    print(path)


def enlarged(camera: octex.Camera, column: float, row: float, times: float) -> octex.Camera:
    """Return a camera that sees the surroundings of a point of the image, 0 … 1, larger."""
    K = camera.K * [[times], [times], [1]]
    K[:2, 2] += SIZE * (0.5 - times * np.array([column, row]))
    return replace(camera, K=K)


def seen(surface: octex.Surface, camera: octex.Camera, look_up: Callable[[Hits], np.ndarray]) -> np.ndarray:
    """Return the image of a camera with a colour for the middle of each pixel, unlit."""
    image = np.full((SIZE * SIZE, 3), 0.18, np.float32)
    for pixels, hits in visible_hits(surface, camera, rest_normals(surface)):
        image[pixels] = look_up(hits)
    return encode(image.reshape(SIZE, SIZE, 3), "uint8", "srgb")


def draw_cells(folder: Path, surface: octex.Surface, camera: octex.Camera) -> None:
    texture = octex.convert(surface, depth=DEPTH)
    cubes = [octex.render(texture, camera=camera, cubes=True, level=DEPTH - up) for up in (3, 2, 1)]
    save(folder / "cells.png", *cubes, octex.render(texture, surface, camera))


def draw_field(folder: Path, surface: octex.Surface, camera: octex.Camera) -> None:
    averages, fitted = (octex.convert(surface, depth=DEPTH, fit=fit) for fit in (False, True))
    lookups = (averages, "nearest"), (averages, "quadratic"), (fitted, "quadratic")
    images = [
        seen(surface, camera, lambda hits, of=of, by=by: of.sample(hits, filter=by)) for of, by in lookups
    ]
    model = seen(
        surface, camera, lambda hits: surface.evaluate_all(hits.triangles, hits.barycentric, hits.width)
    )
    save(folder / "field.png", *images, model)


def draw_footprints(folder: Path) -> None:
    corners = np.array([[-8.0, 0.0, 0.0], [8.0, 0.0, 0.0], [8.0, 0.0, -16.0], [-8.0, 0.0, -16.0]])
    squares = np.where(np.indices((32, 32)).sum(axis=0)[..., None] % 2, [205, 90, 50], [240, 225, 190])
    floor = octex.Surface.from_arrays(
        corners, [[0, 1, 2], [0, 2, 3]], uv=[[0, 0], [1, 0], [1, 1], [0, 1]],
        image=squares.astype(np.uint8), mag_filter="nearest", name="floor",
    )  # fmt: skip
    texture = octex.convert(floor, depth=DEPTH + 2)
    pose = [[1, 0, 0, 0], [0, 0.96, 0.28, 0.8], [0, -0.28, 0.96, 0.3]]  # looks down a little
    camera = octex.Camera.pinhole((SIZE, SIZE), pose=pose, convention="opengl", focal=0.9 * SIZE)
    save(
        folder / "footprints.png",
        seen(floor, camera, lambda hits: texture.sample(hits)),
        seen(floor, camera, lambda hits: texture.sample(hits, width=np.linalg.norm(hits.dPdy, axis=1))),
        seen(floor, camera, lambda hits: texture.sample(hits, dPdx=hits.dPdx, dPdy=hits.dPdy)),
    )


def draw_kept(folder: Path, surface: octex.Surface, camera: octex.Camera) -> None:
    before = octex.convert(surface, depth=DEPTH - 2, fit=False)
    stroke = Image.new("RGBA", (4 * SIZE, 4 * SIZE))
    line = [(x * SIZE, y * SIZE) for x, y in ((1, 2.6), (1.7, 1.6), (2.3, 2.4), (3, 1.4))]
    ImageDraw.Draw(stroke).line(line, (40, 150, 220, 255), SIZE // 3, joint="curve")
    stroke = stroke.resize((SIZE, SIZE), Image.Resampling.LANCZOS)
    after = octex.paint(before, surface, octex.Projection(stroke, camera), max_depth=DEPTH)
    cubes = [octex.render(each, camera=camera, cubes=True) for each in (before, after)]
    save(folder / "kept.png", *cubes, octex.render(after, surface, camera))


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    surface = octex.load_surface(MODEL, channels=["base_color"])
    head = surface.vertices[(surface.vertices[:, 1] > 0.43) & (surface.vertices[:, 1] < 0.64)]
    camera = octex.Camera.fitted(head, SIDE, size=(SIZE, SIZE))
    draw_cells(folder, surface, camera)
    draw_field(folder, surface, enlarged(camera, 0.75, 0.42, 6))
    draw_footprints(folder)
    draw_kept(folder, surface, enlarged(camera, 0.69, 0.44, 3.5))


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
