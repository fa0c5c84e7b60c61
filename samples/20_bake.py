"""An octree texture for any other tool: baked to images, and written as a .glb.

The droid by its octree texture; the .glb that was baked from it, read back; and the base colour of its atlas.

    python samples/20_bake.py [FOLDER]      writes FOLDER/baked.glb, .gltf and .png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "9"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "420"))
MODEL = Path(__file__).with_name("droid.glb")


def main(folder: Path) -> None:
    model = octex.load_surface(MODEL, channels=["base_color"])
    texture = octex.convert(model, DEPTH)
    baked = octex.bake(texture, model, uv="atlas", texture_size=1024)
    folder.mkdir(parents=True, exist_ok=True)
    octex.write_model(baked, folder / "baked.glb")
    octex.write_model(baked, folder / "baked.gltf")  # whose images are files of their own

    read = octex.load_surface(folder / "baked.glb", channels=["base_color"])
    heights = model.vertices[:, 1]
    head = model.vertices[(heights > 0.43) & (heights < 0.66)]
    camera = octex.Camera.fitted(head, (1, 0.3, 0.8), size=(SIZE, SIZE))
    images = [octex.render(texture, model, camera), octex.render(None, read, camera)]
    atlas = np.array(Image.open(folder / "baked-0.png").resize((SIZE, SIZE), Image.Resampling.BOX))
    Image.fromarray(np.hstack([*images, atlas])).save(folder / "baked.png")
    print(f"{folder / 'baked.glb'}: {(folder / 'baked.glb').stat().st_size / 1e6:.1f} MB, for any viewer")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
