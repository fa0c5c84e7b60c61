"""Textures made from textures.

As it is; with other levels; blurred over its surface; mixed with its own greys, more and more
towards its front; and a box of it without colours, cut out and laid over it again.

    python samples/17_processing.py [FOLDER]      writes FOLDER/processing.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "10"))
WIDTH = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "240"))
MODEL = Path(__file__).with_name("droid.glb")


def main(folder: Path) -> None:
    surface = octex.load_surface(MODEL, channels=["base_color"])
    head = surface.vertices[(surface.vertices[:, 1] > 0.43) & (surface.vertices[:, 1] < 0.64)]
    low, high = head.min(axis=0), head.max(axis=0)
    texture = octex.convert(surface, depth=DEPTH)
    grey = octex.map(texture, lambda light: np.repeat(light @ [[0.2126], [0.7152], [0.0722]], 3, axis=1))
    box = octex.crop(grey, low, [*high[:2], (low + high)[2] / 2])
    made = {
        "as it is": texture,
        "levels": octex.levels(texture, black=0.1, white=0.75, gamma=1.3),
        "blurred": octex.blur(texture, 0.03),
        "mixed": octex.mix(texture, grey, lambda points: (points[:, 2] - low[2]) / (high - low)[2]),
        "cropped and combined": octex.combine(texture, box),
    }
    camera = octex.Camera.fitted(head, (1.0, 0.3, 0.5), size=(WIDTH, WIDTH))
    views = [octex.render(each, surface, camera) for each in made.values()]
    folder.mkdir(parents=True, exist_ok=True)
    image = np.hstack(views)
    Image.fromarray(image).save(folder / "processing.png")
    print(f"{folder / 'processing.png'}: {', '.join(made)}")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
