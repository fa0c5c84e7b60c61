"""A glTF model that carries its octree texture, by the extension EXT_octree_texture.

The droid by the octree that was read back from the .glb; and by what other viewers show, colours at vertices.

    python samples/29_gltf.py [FOLDER]      writes FOLDER/octree.glb, .gltf, .octw and .png (default: out)
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
    folder.mkdir(parents=True, exist_ok=True)
    octex.write_model(octex.bake_vertices(texture, model), folder / "octree.glb", octree=texture)
    images = octex.bake(texture, model, texture_size=512)
    octex.write_model(images, folder / "octree.gltf", octree=texture)  # the octree is a file of its own

    read, other = octex.open(folder / "octree.glb"), octex.load_surface(folder / "octree.glb")
    heights = model.vertices[:, 1]
    head = model.vertices[(heights > 0.43) & (heights < 0.66)]
    camera = octex.Camera.fitted(head, (1, 0.3, 0.8), size=(SIZE, SIZE))
    views = [octex.render(read, other, camera), octex.render(None, other, camera)]
    Image.fromarray(np.hstack(views)).save(folder / "octree.png")
    print(f"{folder / 'octree.glb'}: {(folder / 'octree.glb').stat().st_size / 1e6:.1f} MB, for any viewer")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
