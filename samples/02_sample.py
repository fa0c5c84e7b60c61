"""Colours anywhere on the surface, and how near they are to the model's own.

The texture coordinate is the rest position: where a point lies on the model before anything deforms it. Here
random points are looked up in the octree and in the model's images, averaged over a cell's width.

    python samples/02_sample.py
"""

import os
from pathlib import Path

import numpy as np

import octex
from octex.channels import linear_to_srgb

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "10"))
MODEL = Path(__file__).with_name("droid.glb")


def main() -> None:
    surface = octex.load_surface(MODEL)
    texture = octex.convert(surface, depth=DEPTH)
    samples = surface.scatter(100_000, seed=0)  # uniform by area
    cell = texture.placement.size / 2**DEPTH

    colors = texture.sample(samples)  # where they rest, toward their normals: (n, 3) float32, linear light
    truth = surface.evaluate(samples, width=cell)
    error = linear_to_srgb(colors) - linear_to_srgb(truth)
    print(f"every point lies in a leaf: {texture.contains(samples).all()}")
    print(f"PSNR {-10 * np.log10((error**2).mean()):.1f} dB at depth {DEPTH}, cells of {cell:.2g}")
    for level in range(DEPTH - 3, DEPTH):
        error = linear_to_srgb(texture.level(level).sample(samples)) - linear_to_srgb(truth)
        print(f"PSNR {-10 * np.log10((error**2).mean()):.1f} dB from the averages of level {level}")


if __name__ == "__main__":
    main()
