"""Images through a camera of your own.

The head from near, coloured by the model's images and by the octree at three depths: what a texture of each
size still shows.

    python samples/06_image.py [FOLDER]      writes FOLDER/head.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "10"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "800"))
MODEL = Path(__file__).with_name("droid.glb")


def main(folder: Path) -> None:
    surface = octex.load_surface(MODEL)
    head = surface.vertices[(surface.vertices[:, 1] > 0.43) & (surface.vertices[:, 1] < 0.64)]
    camera = octex.Camera.fitted(head, direction=(0.9, 0.22, 1.0), size=(SIZE, SIZE * 9 // 16))
    texture = octex.convert(surface, depth=DEPTH)
    images = [octex.render(None, surface, camera)]
    images += [octex.render(texture, surface, camera, level=DEPTH - i) for i in (0, 1, 2)]
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.vstack([np.hstack(images[:2]), np.hstack(images[2:])])).save(folder / "head.png")
    print(f"{folder / 'head.png'}: by the images, at depth {DEPTH}, {DEPTH - 1} and {DEPTH - 2}")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
