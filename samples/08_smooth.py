"""An adaptive texture, close up: the paper's interpolation beside the smooth field.

A plate is stored with cells of several sizes, small in the middle, larger outwards. Its light and dark are
read as heights, lit from one side: what jumps or bends too sharply casts a line.

    python samples/08_smooth.py [FOLDER]      writes FOLDER/smooth.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "8"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "640"))
CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.2], [1.0, 1.0, 0.3], [0.0, 1.0, 0.1]])


def wanted_depth(points: np.ndarray) -> np.ndarray:
    return DEPTH - np.floor(np.hypot(points[:, 0] - 0.5, points[:, 1] - 0.5) / 0.09)


def relief(texture: octex.OctreeTexture, filter: str) -> np.ndarray:
    y, x = np.mgrid[:SIZE, :SIZE].reshape(2, -1) / SIZE * 0.36 + 0.32
    points = np.stack([x, y, 0.2 * x + 0.1 * y], axis=1)  # on the plate
    colors, slopes = texture.sample(points, filter=filter, gradient=True)
    light = np.clip(0.75 - slopes.mean(axis=1) @ [0.008, 0.014, 0.0], 0.1, 1.3)
    return np.clip(colors * light[:, None], 0, 1).reshape(SIZE, SIZE, 3)


def main(folder: Path) -> None:
    y, x = np.mgrid[-0.53:0.47:1024j, -0.47:0.53:1024j]
    wave = 0.5 + 0.5 * np.sin(np.hypot(x, y) * 70 + 1.5 * np.sin(5 * np.arctan2(y, x)))[..., None]
    image = (wave * [235, 200, 150] + (1 - wave) * [60, 110, 130]).astype(np.uint8)[::-1]
    faces, uv = [[0, 1, 2], [0, 2, 3]], CORNERS[:, :2]
    plate = octex.Surface.from_arrays(CORNERS, faces, uv=uv, image=image, name="plate")
    texture = octex.convert(plate, depth=DEPTH, detail=wanted_depth)
    views = np.hstack([relief(texture, "linear"), relief(texture, "quadratic")])
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray((views ** (1 / 2.2) * 255).astype(np.uint8)).save(folder / "smooth.png")
    print(f"{folder / 'smooth.png'}: linear, quadratic; {texture.tree!r}")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
