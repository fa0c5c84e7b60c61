"""A cage of polygons with Ptex: an octree texture as texels for each polygon, and back.

A box with a pentagonal roof, by its octree texture; by the .ptx of it; by one of a sixteenth of the texels.

    python samples/24_ptex.py [FOLDER]      writes FOLDER/house.obj, .ptx and ptex.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "8"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "420"))
VERTICES = "0 0 0, 2 0 0, 2 0 1, 0 0 1, 0 1 0, 2 1 0, 2 1 1, 0 1 1, 0 1.5 0.5, 2 1.5 0.5"
POLYGONS = "1 5 6 2, 3 7 8 4, 5 9 10 6, 7 10 9 8, 4 8 9 5 1, 2 6 10 7 3"


def rings(points: np.ndarray) -> np.ndarray:
    """Return rings around a corner, in linear light."""
    wave = 0.5 + 0.5 * np.sin(14 * np.linalg.norm(points - [2, 0.4, 1], axis=1, keepdims=True))
    return wave * [0.8, 0.35, 0.1] + (1 - wave) * [0.05, 0.2, 0.4]


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f"v {each.strip()}" for each in VERTICES.split(",")]
    lines += [f"f {each.strip()}" for each in POLYGONS.split(",")]
    (folder / "house.obj").write_text("\n".join(lines))
    model = octex.load_surface(folder / "house.obj", sources={"base_color": rings})
    texture = octex.convert(model, DEPTH)
    camera = octex.Camera.fitted(model.vertices, (0.9, 0.5, 1), size=(SIZE, SIZE))
    images = [octex.render(texture, model, camera)]
    for texels in (texture.tree.n_leaves, texture.tree.n_leaves // 16):
        octex.write_ptex(texture, model, folder / "house.ptx", texels=texels)
        read = octex.load_surface(folder / "house.obj", sources=octex.Ptex(folder / "house.ptx").sources)
        images.append(octex.render(None, read, camera))
    Image.fromarray(np.hstack(images)).save(folder / "ptex.png")
    print(f"{folder / 'house.ptx'}: 14 faces of six polygons, and the octree texture beside it")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
