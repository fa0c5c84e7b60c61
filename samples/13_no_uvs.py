"""Images on models without UVs: laid on from a plane, a box, a cylinder and a sphere.

The fields of the image are numbered: none is mirrored, what stands is upright, and the lid has its own.

    python samples/13_no_uvs.py [FOLDER]      writes FOLDER/no_uvs.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from make_shapes import board, shapes
from PIL import Image

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "9"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "250"))
KINDS = {"land": "planar", "box": "box", "tin": "cylindrical", "ball": "spherical"}


def main(folder: Path) -> None:
    tiles = []
    for name, surface in shapes().items():
        image = octex.MappedImage(board(8 if name in ("tin", "ball") else 4), KINDS[name])
        texture = octex.convert(surface, DEPTH, sources={"base_color": image})
        camera = octex.Camera.fitted(surface.vertices, (0.7, -1, 0.8), size=(SIZE, SIZE), up=(0, 0, 1))
        tiles.append(octex.render(texture, surface, camera))
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack(tiles)).save(folder / "no_uvs.png", optimize=True)
    print(f"{folder / 'no_uvs.png'}: {', '.join(KINDS.values())}")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
