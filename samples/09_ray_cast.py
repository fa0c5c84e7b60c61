"""A renderer of its own: a ray's hit, the rest position there, the footprint of a pixel, and the colour.

The footprint says what a pixel averages over: how the hit moves on the surface when the ray goes on by one
to the right (dPdx) and by one down (dPdy). With the normal, something thin shows the side that was hit.

    python samples/09_ray_cast.py [FOLDER]      writes FOLDER/ray_cast.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import octex
from octex.channels import encode

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "9"))
WIDTH = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "480"))
CORNERS = np.array([[-8.0, 0.0, 1.4], [8.0, 0.0, 1.4], [8.0, 0.0, -7.0], [-8.0, 0.0, -7.0]])
EYE, NORMAL = np.array([0.0, 0.4, 1.4]), np.array([0.0, 1.0, 0.0])


def main(folder: Path) -> None:
    tiles = np.full((64, 64, 3), (214, 205, 190), np.uint8)
    tiles[:32, :32] = tiles[32:, 32:] = (52, 72, 94)
    faces, uv = [[0, 1, 2], [0, 2, 3]], CORNERS[:, [0, 2]]
    texture = octex.convert(octex.Surface.from_arrays(CORNERS, faces, uv=uv, image=tiles), depth=DEPTH)
    # A ray a pixel, through its middle; those that meet the floor near enough are all in the lower rows.
    height, step = WIDTH * 5 // 8, 1.5 / WIDTH
    right, down = np.array([step, 0.0, 0.0]), np.array([0.0, -step, 0.0])
    y, x = np.mgrid[-height / 2 : height / 2, -WIDTH / 2 : WIDTH / 2].reshape(2, -1) + 0.5
    rays = np.array([0.15, -0.4, -1.0]) + np.outer(x, right) + np.outer(y, down)
    rays = rays[rays @ NORMAL < -0.048]
    distance = -(EYE @ NORMAL) / (rays @ NORMAL)[:, None]
    points = EYE + distance * rays  # the floor is not posed: it rests where it was hit
    dPdx, dPdy = (distance * (d - rays * ((d @ NORMAL) / (rays @ NORMAL))[:, None]) for d in (right, down))

    colors = texture.sample(points, dPdx=dPdx, dPdy=dPdy, normals=np.tile(NORMAL, (len(points), 1)))
    images = np.full((2, height * WIDTH, 3), 0.75, np.float32)
    images[:, -len(points) :] = texture.sample(points), colors
    folder.mkdir(parents=True, exist_ok=True)
    codes = np.hstack(encode(images, "uint8", "srgb").reshape(2, height, WIDTH, 3))
    Image.fromarray(codes).save(folder / "ray_cast.png")
    print(f"{folder / 'ray_cast.png'}: at the hits alone, and averaged over pixels; {texture.tree!r}")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
