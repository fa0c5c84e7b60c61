"""A surface of your own, from arrays.

A knotted tube, coloured by a formula, one colour a vertex: nothing here has UVs.

    python samples/05_own_mesh.py [FOLDER]     writes FOLDER/knot.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "9"))
ORANGE, BLUE = np.array([[[0.90, 0.35, 0.06]], [[0.03, 0.10, 0.16]]])  # linear light


def main(folder: Path, along: int = 1200, around: int = 90) -> None:
    t = np.arange(along)[:, None] * (2 * np.pi / along)
    s = np.arange(around)[None, :] * (2 * np.pi / around)
    r, z = 2 + np.cos(3 * t) + 0.45 * np.cos(s), np.sin(3 * t) + 0.45 * np.sin(s)
    positions = np.stack([r * np.cos(2 * t), r * np.sin(2 * t), z], axis=-1)
    stripe = 0.5 + 0.5 * np.tanh(8 * np.sin(24 * t + 4 * s))[..., None]
    colors = stripe * ORANGE + (1 - stripe) * BLUE
    a = np.arange(along * around).reshape(along, around)
    b, c, d = np.roll(a, -1, 0), np.roll(a, -1, (0, 1)), np.roll(a, -1, 1)
    triangles = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)

    vertices = positions.reshape(-1, 3)
    surface = octex.Surface.from_arrays(vertices, triangles, colors=colors.reshape(-1, 3), name="knot")
    texture = octex.convert(surface, depth=DEPTH)
    folder.mkdir(parents=True, exist_ok=True)
    octex.write_preview(folder / "knot.png", texture, surface)
    print(f"{texture.tree.n_leaves:,} leaves; colours of some points:")
    print(texture.sample(surface.scatter(3).rest).round(2))


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
