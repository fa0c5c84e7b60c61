"""A surface that is given by a function alone: where it is zero. There is no mesh to unwrap.

python samples/16_implicit.py [FOLDER]      writes FOLDER/implicit.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "8"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "560")) // 2


def gyroid(points):
    """Return a value below zero in the walls of a gyroid, cut to a ball, with rounded edges."""
    x, y, z = 7.0 * points.T
    walls = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
    walls, ball = np.abs(walls) / 7.0 - 0.06, np.linalg.norm(points, axis=1) - 1.0
    return np.maximum(walls, ball) + np.maximum(0.06 - np.abs(walls - ball), 0.0) ** 2 / 0.24


def glaze(points):
    """Return linear light: from a warm core to a cool rind, with rings."""
    radius = np.linalg.norm(points, axis=1)[:, None]
    core, rind = np.array([0.9, 0.28, 0.06]), np.array([0.06, 0.32, 0.5])
    mixed = core + (rind - core) * np.clip(2.2 * radius - 1.1, 0.0, 1.0)
    return (0.85 + 0.15 * np.cos(60.0 * radius)) * mixed


def main(folder: Path) -> None:
    shape = octex.Surface.from_function(gyroid, [[-1.1] * 3, [1.1] * 3], 2.0 / min(2**DEPTH, 96))
    surface = octex.Surface.from_arrays(shape.vertices, shape.triangles, colors=glaze(shape.vertices))
    texture = octex.convert(surface, DEPTH)
    camera = octex.Camera.fitted(surface.vertices, (0.5, 0.45, 1.0), size=(SIZE, SIZE))
    images = [octex.render(texture, surface, camera)]
    images.append(octex.render(texture, None, camera, level=min(DEPTH, 6), cubes=True))
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack(images)).save(folder / "implicit.png")
    print(f"{folder / 'implicit.png'}: {surface!r}, off by {np.abs(gyroid(shape.vertices)).max():.0e}")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
