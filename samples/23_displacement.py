"""Displacement: a ball moved along its normals by its texture, with the normals of what comes out.

python samples/23_displacement.py [FOLDER]      writes FOLDER/displacement.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "8"))
WIDTH = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "420"))
OCTAHEDRON = np.concatenate([np.eye(3), -np.eye(3)])
FACES = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]


def craters(at: np.ndarray) -> np.ndarray:
    """Height, 0.5 between craters: the nearest of some places says how deep, and how high its rim is."""
    random = np.random.default_rng(7)
    centres = random.normal(size=(60, 3))
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    sizes = random.uniform(0.1, 0.35, 60)
    found = np.full(len(at), 0.5)
    for centre, size in zip(centres, sizes, strict=True):
        t = np.linalg.norm(at / np.linalg.norm(at, axis=1, keepdims=True) - centre, axis=1) / size
        found += size * (0.9 * np.exp(-(((t - 1) / 0.22) ** 2)) - 1.1 * np.exp(-((t / 0.65) ** 4)))
    return np.clip(found, 0.0, 1.0)


def main(folder: Path) -> None:
    ball = octex.subdivide(octex.Surface.from_arrays(OCTAHEDRON, FACES), 5, rest="limit")
    sources = {"base_color": lambda at: craters(at)[:, None] * (0.95, 0.85, 0.7), "roughness": craters}
    ball = ball.with_sources(sources)
    texture = octex.convert(ball, DEPTH, dtype={"base_color": "uint8", "roughness": "uint16"})
    moved = octex.displace(texture, ball, "roughness", 0.15, middle=0.5)
    camera = octex.Camera.fitted(moved.vertices, (0.3, 0.4, 1.0), size=(WIDTH, WIDTH))
    views = np.hstack([octex.render(texture, each, camera) for each in (ball, moved)])
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(views).save(folder / "displacement.png")
    print(f"{folder / 'displacement.png'}: the ball, and displaced to {len(moved.triangles):,} triangles")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
