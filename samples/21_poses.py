"""A model that moves: converted once, painted in one pose, drawn in others.

python samples/21_poses.py [FOLDER]      writes FOLDER/poses.png and reed.gltf (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from make_reed import write_reed
from PIL import Image, ImageDraw

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "9"))
WIDTH = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "360"))
SIZE = (WIDTH, 4 * WIDTH // 3)


def rings(at: np.ndarray) -> np.ndarray:
    dark = (np.sin(25 * at[:, 1]) > 0.6)[:, None]
    return np.where(dark, (0.30, 0.16, 0.05), (0.62, 0.60, 0.22))


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_reed(path := folder / "reed.gltf")
    poses = "Bend@0.5", None, "Bend@1.5"  # rest positions are those of the file in all of them
    surfaces = [octex.load_surface(path, pose=pose) for pose in poses]
    bent = surfaces[0]
    texture = octex.convert(path, DEPTH, sources={"base_color": rings})

    every = np.concatenate([each.vertices for each in surfaces])
    camera = octex.Camera.fitted(every, (0.2, 0.2, 1.0), size=SIZE)
    image = Image.new("RGBA", SIZE)
    draw = ImageDraw.Draw(image)
    x, y = camera.project([bent.vertices[bent.vertices[:, 1] > 0.5].mean(axis=0)])[0][0]
    draw.circle((x, y), 0.16 * WIDTH, (210, 40, 40, 255))
    draw.circle((x, y), 0.09 * WIDTH, (250, 240, 220, 255))
    painted = octex.paint(texture, bent, octex.Projection(image, camera))
    views = np.hstack([octex.render(painted, each, camera) for each in surfaces])
    Image.fromarray(views).save(folder / "poses.png")
    print(f"{folder / 'poses.png'}: painted in one pose, at rest, and in another pose")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
