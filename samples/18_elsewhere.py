"""Colours from elsewhere: from coloured points, and from another model's nearest surface.

200,000 points of the droid's head by themselves; the same laid on a mesh of fewer and other triangles; and
that mesh with the colours of the model's own surface where it is nearest.

    python samples/18_elsewhere.py [FOLDER]      writes FOLDER/elsewhere.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "9"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "330"))
MODEL = Path(__file__).with_name("droid.glb")


def main(folder: Path) -> None:
    model = octex.load_surface(MODEL, channels=["base_color"])
    heights = model.vertices[model.triangles][:, :, 1]
    is_head = (heights.min(axis=1) > 0.43) & (heights.max(axis=1) < 0.66)
    coarse = np.round(model.vertices / 0.012) * 0.012  # faces between two steps of a grid vanish
    bare = octex.Surface.from_arrays(coarse, model.triangles[is_head])
    samples = model.scatter(1_500_000)
    near = np.flatnonzero((samples.rest[:, 1] > 0.43) & (samples.rest[:, 1] < 0.66))[:200_000]
    cloud = octex.PointCloud(samples.rest[near], model.evaluate(samples)[near], samples.normals[near])
    alone = octex.convert(cloud, DEPTH - 1)
    laid = octex.convert(bare, DEPTH, sources=cloud.sources)
    transferred = octex.convert(bare, DEPTH, sources=octex.Transfer(model).sources)

    seen = coarse[model.triangles[is_head]].reshape(-1, 3)
    camera = octex.Camera.fitted(seen, (1, 0.3, 0.5), size=(SIZE, 2 * SIZE // 3))
    images = [octex.render(alone, None, camera, level=DEPTH - 1, cubes=True)]
    images += [octex.render(each, bare, camera) for each in (laid, transferred)]
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack(images)).save(folder / "elsewhere.png")
    print(f"{folder / 'elsewhere.png'}: {len(cloud):,} points alone, on another mesh, and a transfer")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
