"""Light from all around, on metal and plastic: one texture under three lights (octex help previews).

Balls from mirror to matte, of gold and of blue plastic.

    python samples/28_light.py [FOLDER]      writes FOLDER/light.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "8"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "420"))
GOLD, BLUE = ((1.0, 0.78, 0.34), 1.0), ((0.05, 0.2, 0.7), 0.0)  # colour, metallic


def ball(x: int, y: int, color: tuple[float, float, float], metallic: float) -> octex.Surface:
    middle = np.array([x, y, 0.0])
    bounds = [middle - 0.5, middle + 0.5]
    plain = octex.Surface.from_function(lambda at: np.linalg.norm(at - middle, axis=1) - 0.45, bounds, 0.05)
    return plain.with_sources({"base_color": color, "metallic": metallic, "roughness": x / 4})


def main(folder: Path) -> None:
    model = octex.Surface.joined([ball(x, y, *kind) for y, kind in enumerate((BLUE, GOLD)) for x in range(5)])
    texture = octex.convert(model, DEPTH)
    camera = octex.Camera.fitted(model.vertices, (0.1, 0.15, 1), size=(2 * SIZE, SIZE))
    sky = np.broadcast_to(np.linspace(1.6, 0.2, 64)[:, None, None] * [0.5, 0.7, 1.0], (64, 128, 3))
    lights = [octex.Environment.studio(), octex.Environment.of(sky), octex.Environment.of(np.ones((8, 16)))]
    images = [octex.render(texture, model, camera, light=light) for light in lights]
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.vstack(images)).save(folder / "light.png")
    print(f"{folder / 'light.png'}: {len(images)} lights on {texture.tree.n_leaves:,} leaves")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
