"""A piece of a model laid flat, painted on in 2D, and back on the model (Benson & Davis 2002, 6.1).

The droid's head around a point, flat, along the surface; a target drawn on that; and the droid with it.

    python samples/25_unwrap.py [FOLDER]      writes FOLDER/unwrap.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "9"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "420"))
MODEL = Path(__file__).with_name("droid.glb")


def main(folder: Path) -> None:
    model = octex.load_surface(MODEL, channels=["base_color"])
    texture = octex.convert(model, DEPTH)
    patch = octex.unwrap(model, (0.004, 0.529, 0.18), 0.048, up=(0, 0, -1), size=SIZE)  # on its forehead
    flat = octex.render(texture, patch.surface, patch.camera)
    drawn = Image.fromarray(flat)
    pen = ImageDraw.Draw(drawn)
    for ring in range(4):
        reach = SIZE * (0.42 - 0.1 * ring)
        box = [SIZE / 2 - reach, SIZE / 2 - reach, SIZE / 2 + reach, SIZE / 2 + reach]
        pen.ellipse(box, outline=(220, 40, 30, 255), width=SIZE // 24)
    painted = octex.paint(texture, model, octex.Projection(drawn, patch, since=flat))
    _, height, depth = model.vertices.T
    head = model.vertices[(height > 0.43) & (height < 0.6) & (depth > 0.1)]
    camera = octex.Camera.fitted(head, (0.3, 1.0, 0.6), size=(SIZE, SIZE))
    after = octex.render(painted, model, camera)
    folder.mkdir(parents=True, exist_ok=True)
    shown = [flat, np.array(drawn), after]
    Image.fromarray(np.hstack([each[..., :3] for each in shown])).save(folder / "unwrap.png")
    print(f"{folder / 'unwrap.png'}: {patch}, painted flat")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
