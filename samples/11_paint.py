"""Paint over an image, and send it back through its camera.

What is drawn on a transparent image is projected onto what the camera sees.

    python samples/11_paint.py [FOLDER]      writes FOLDER/paint.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "10"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "480"))
MODEL = Path(__file__).with_name("droid.glb")


def drawn(size: int) -> Image.Image:
    image = Image.new("RGBA", (4 * size, 4 * size))
    draw = ImageDraw.Draw(image)
    for radius, color in ((0.9, (250, 60, 40)), (0.62, (255, 200, 40)), (0.34, (40, 150, 220))):
        draw.circle((2.3 * size, 1.9 * size), radius * size, (*color, 255))
    for at in range(0, 4 * size, max(size // 4, 1)):  # a wash of stripes
        draw.line([at, 2.9 * size, at + size, 3.9 * size], (30, 160, 90, 120), size // 12)
    return image.resize((size, size), Image.Resampling.LANCZOS)


def main(folder: Path) -> None:
    surface = octex.load_surface(MODEL, channels=["base_color"])
    head = surface.vertices[(surface.vertices[:, 1] > 0.43) & (surface.vertices[:, 1] < 0.64)]
    ways = (1.0, 0.2, 0.6), (0.3, 0.5, 1.0)
    camera, other = (octex.Camera.fitted(head, way, size=(SIZE, SIZE)) for way in ways)
    before = octex.convert(surface, depth=DEPTH)
    after = octex.paint(before, surface, octex.Projection(drawn(SIZE), camera), max_depth=DEPTH + 1)
    views = (other, before), (camera, before), (other, after)
    codes = [octex.render(of, surface, at) for at, of in views]
    over = Image.alpha_composite(Image.fromarray(codes[1]).convert("RGBA"), drawn(SIZE)).convert("RGB")
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack([codes[0], np.asarray(over), codes[2]])).save(folder / "paint.png")
    print(f"{folder / 'paint.png'}: before, what is painted over the camera's view, after; {after.tree!r}")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
