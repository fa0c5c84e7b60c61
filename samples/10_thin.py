"""Something thin from near to far: a ribbon whose sides have colours of their own.

Far away a cell holds both sides, and their mean is a colour that nobody sees. The paper's flags go down to
finer cells, which no longer average over the pixel. A value per facing does neither.

    python samples/10_thin.py [FOLDER]      writes FOLDER/thin.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from make_ribbon import ribbon
from PIL import Image

import octex
from octex.cameras.camera import Camera
from octex.channels import encode
from octex.drawing.rasters import film_surface
from octex.drawing.shaders import Appearance, source_shader

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "8"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "240"))
WAYS = {"averaged blindly": {"bleed_threshold": np.inf}, "the paper's flags": {"filter": "nearest"}}


def main(folder: Path) -> None:
    texture = octex.convert(surface := ribbon(), depth=DEPTH)

    def looks(hits, **how):  # the footprint of a pixel, of which 4×4 samples are hits
        return Appearance(texture.sample(hits.rest, dPdx=4 * hits.dPdx, dPdy=4 * hits.dPdy, **how))

    ways, rows = [lambda hits, how=how: looks(hits, **how) for how in WAYS.values()], []
    ways.append(lambda hits: looks(hits, normals=hits.normals))
    for pixels in (96, 48, 24, 12):
        camera = Camera.fitted(surface.vertices, (0.1, 0.25, 1.0), size=(pixels, pixels * 5 // 8))
        truth = film_surface(surface, camera, [source_shader(surface)], 64 if SIZE >= 240 else 8)
        images = [film.image() for film in film_surface(surface, camera, ways, 4) + truth]
        errors = (np.sqrt(((each - images[-1]) ** 2).mean()) for each in images[:-1])
        print(f"{pixels} pixels wide, RMS:", *map("{:.2%}".format, errors))
        tiles = [Image.fromarray(encode(each, "uint8", "srgb")) for each in images]
        rows.append(np.hstack([tile.resize((SIZE, SIZE * 5 // 8), 0) for tile in tiles]))
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.vstack(rows)).save(folder / "thin.png")
    print(f"{folder / 'thin.png'}: {', '.join(WAYS)}, octex, truth")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
