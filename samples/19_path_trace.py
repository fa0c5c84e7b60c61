"""A path tracer in one kernel, which looks its texture up at every bounce: octex.kernels.

python samples/19_path_trace.py [FOLDER]      writes FOLDER/path_trace.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from make_walls import march, normal_at, surface, unit
from numba import njit
from PIL import Image

import octex.kernels
from octex.channels import encode

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "7"))
WIDTH = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "480"))


@njit
def trace(arrays, image, random):
    scratch, (height, width, _) = octex.kernels.new_scratch(arrays), image.shape
    for row, column, _ in np.ndindex(height, width, 32):
        at, color, spread = np.array([0, 0, 3.8]), np.full(3, 1 / 32), 0.9 / width
        way = unit(random.random(3) + np.array([column - width / 2, height / 2 - row, -1.1 * width]))
        for _ in range(5):
            t = march(at, way)
            if t == np.inf:  # the sky
                for c in range(3):  # numba takes 3 s longer to compile whole rows
                    image[row, column, c] += color[c] * (0.2 + 1.8 * max(way[1], 0.0))
                break
            at = at + t * way
            normal = normal_at(at)
            color *= np.array(octex.kernels.footprint(arrays, at, spread * t, normal, scratch)[:3])
            way, spread = unit(normal + unit(random.normal(0, 1, 3))), 0.5


def main(folder: Path) -> None:
    texture = octex.convert(surface(), DEPTH)
    image = np.zeros((WIDTH * 5 // 8, WIDTH, 3))
    trace(octex.kernels.arrays_of(texture), image, np.random.default_rng(0))
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(encode(image, "uint8", "srgb")).save(folder / "path_trace.png")
    print(f"{folder / 'path_trace.png'}: 32 paths a pixel, a lookup a bounce; {texture!r}")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
