"""Model, unwrap and paint the droid head, and write it as droid.glb.

    python samples/make_droid.py [droid.glb]

The head of a survey droid, modelled with manifold3d and textured as models usually are: four maps of
1024×512, 256×1024, 256×1024 and 128×1024 texels, like the part that the octree texture paper measures
(figure 6).
"""

from __future__ import annotations

import sys
from pathlib import Path

from droid.glb import write
from droid.model import MAPS, build
from droid.paint import paint
from droid.unwrap import unwrap


def main(path: Path) -> None:
    model = build()
    unwrapped = unwrap(model, MAPS)
    images, coverage = paint(model, unwrapped)
    write(path, model, unwrapped, images)
    print(f"{path.name}: {len(model.triangles):,} triangles, {path.stat().st_size:,} bytes")
    for name, image in images.items():
        print(f"  {name}: {image.width}×{image.height}, {coverage[name]:.0%} of its texels used")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("droid.glb"))
