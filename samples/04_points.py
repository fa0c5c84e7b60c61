"""To a coloured point cloud.

Every leaf becomes a point with a colour and a normal, which most 3D tools open.

    python samples/04_points.py [FOLDER]       writes FOLDER/droid.ply (default: out)
"""

import os
import sys
from pathlib import Path

import octex
from octex.formats.ply import write_points

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "9"))
MODEL = Path(__file__).with_name("droid.glb")


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    texture = octex.convert(MODEL, depth=DEPTH)
    write_points(texture, folder / "droid.ply")
    print(f"{texture.tree.n_leaves:,} points in {folder / 'droid.ply'}")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
