"""From a textured model to an octree texture.

A model with UVs and four images becomes one file of cells: no UVs, no seams. The texture is saved and looked
at: the model coloured by its images on the left, by the octree on the right.

    python samples/01_convert.py [FOLDER]      writes FOLDER/droid.octex and FOLDER/droid.png (default: out)
"""

import os
import sys
from pathlib import Path

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "10"))
MODEL = Path(__file__).with_name("droid.glb")


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    surface = octex.load_surface(MODEL)
    texture = octex.convert(surface, depth=DEPTH)  # or cell=0.001, in the model's units
    texture.save(folder / "droid.octex")
    octex.write_preview(folder / "droid.png", texture, surface)
    print(f"{texture.tree.n_leaves:,} leaves, {texture.nbytes:,} bytes")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
