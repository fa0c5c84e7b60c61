"""A page of three models for three.js: painted images, wood without UVs, and thin walls of two colours.

In FOLDER, ``npm install three CLONE/octex/viewer`` gets three and octex-three. Then
``python -m http.server`` shows the page. It is three.html beside this script, as it is.

    python samples/30_three.py [FOLDER]      writes FOLDER/index.html and three .octw files (default: out)
"""

import os
import shutil
import sys
from pathlib import Path

from make_blocks import wood
from make_shapes import shapes
from make_walls import surface as walls

import octex
from octex.viewer.export import write_page

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "9"))
HERE = Path(__file__).parent


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    models = {
        "droid": octex.load_surface(HERE / "droid.glb"),
        "wood": shapes(61)["box"].with_sources({"base_color": wood, "roughness": 0.5}),
        "walls": walls().with_sources({"roughness": 0.4}),
    }
    for name, surface in models.items():
        texture = octex.convert(surface, DEPTH)
        write_page(texture, folder / f"{name}.octw", surface, max_size=2_000_000)
        print(f"{folder / name}.octw: {(folder / name).with_suffix('.octw').stat().st_size / 1e3:.0f} kB")
    shutil.copy(HERE / "three.html", folder / "index.html")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
