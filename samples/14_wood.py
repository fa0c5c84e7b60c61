"""Functions of position as textures: models cut from a block of wood, and of marble.

Rings go through the block from side to side, and bend around a knot: see make_blocks.py.

    python samples/14_wood.py [FOLDER]      writes FOLDER/wood.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from make_blocks import marble, wood
from make_shapes import shapes
from PIL import Image

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "10"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "260"))
MODEL = Path(__file__).with_name("droid.glb")


def main(folder: Path) -> None:
    block, droid = shapes()["box"], octex.load_surface(MODEL, channels=["base_color"])
    head = droid.vertices[(droid.vertices[:, 1] > 0.43) & (droid.vertices[:, 1] < 0.64)]
    cameras = [
        octex.Camera.fitted(block.vertices, (0.7, -1, 0.8), size=(SIZE, SIZE), up=(0, 0, 1)),
        octex.Camera.fitted(head, (0.9, 0.22, 1), size=(SIZE, SIZE)),
    ]
    textures = [
        octex.convert(block, DEPTH - 2, sources={"base_color": wood}),
        octex.convert(droid, DEPTH, sources={"base_color": lambda points: wood(7 * points[:, [1, 2, 0]])}),
        octex.convert(droid, DEPTH, sources={"base_color": lambda points: marble(7 * points)}),
    ]
    drawn = zip((block, droid, droid), (cameras[0], cameras[1], cameras[1]), textures, strict=True)
    tiles = [octex.render(of, surface, at) for surface, at, of in drawn]
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack(tiles)).save(folder / "wood.png", optimize=True)
    print(f"{folder / 'wood.png'}: wood and marble")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
