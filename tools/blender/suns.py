#!/usr/bin/env python
"""Have Blender draw a light model and the full one under six suns, and compare the images.

usage: tools/blender/suns.py PYTHON LIGHT.glb FULL.ply [--image 512] [--samples 8] [--keep FOLDER]

PYTHON is that of an environment with PyPI's bpy; it runs worker.py. FULL is a .ply with colours at its
vertices, or a .glb; `tools/bench light --keep FOLDER` makes both. The suns stand around the camera, 60
degrees from its view, so that each lights another side. Cycles draws with shadows and bounces. The exit
code is 1 if an image is not within 32 dB inside the silhouette, or if silhouettes are over a pixel apart.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from bake import Z_UP, blender, job_of
from PIL import Image, ImageFilter

import octex

DECIBELS, PIXELS = 32.0, 1
SUNS, FROM_VIEW = 6, np.radians(60.0)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("python", type=Path)
    parser.add_argument("light", type=Path)
    parser.add_argument("full", type=Path)
    parser.add_argument("--image", type=int, default=512)
    parser.add_argument("--samples", type=int, default=8, help="rays along each side of a pixel")
    parser.add_argument("--sky", type=float, default=0.2, help="light from all around; a sun has 3")
    parser.add_argument("--direction", type=float, nargs=3, default=(1.0, 0.4, 0.7), metavar=("X", "Y", "Z"))
    parser.add_argument("--keep", type=Path, help="a folder for the images")
    options = parser.parse_args()
    points = octex.load_surface(options.full).vertices
    camera = octex.Camera.fitted(points, options.direction, size=(options.image,) * 2)
    angles = 2 * np.pi * np.arange(SUNS) / SUNS
    around = [np.cos(angles), np.sin(angles), np.full(SUNS, -1.0 / np.tan(FROM_VIEW))]
    suns = np.stack(around, axis=1) @ camera.world_to_camera[:3, :3] @ Z_UP[:3, :3].T
    worst, far = np.inf, 0
    with TemporaryDirectory() as room:
        folder = options.keep or Path(room)
        models = {"light": str(options.light), "full": str(options.full)}
        sky = {"suns": suns.tolist(), "sky": options.sky}
        view = job_of(camera, options.samples, folder)
        spent = blender(options.python, "suns", models=models, view=view, folder=str(folder), **sky)
        for number in range(SUNS):
            light, full = (Image.open(folder / f"{name}-{number}.png") for name in models)
            one, other = np.array(light, np.float64), np.array(full, np.float64)
            inside = (one[..., 3] == 255) & (other[..., 3] == 255)
            decibels = 10 * np.log10(255**2 / np.mean((one - other)[inside][:, :3] ** 2))
            apart = max(pixels_apart(light, full), pixels_apart(full, light))
            print(f"sun {number}: {decibels:.1f} dB inside the silhouette, which is {apart} pixels off")
            worst, far = min(worst, decibels), max(far, apart)
    print(f"{options.light.name}: worst {worst:.1f} dB, {far} pixels;", end=" ")
    print(", ".join(f"{name} {sum(each):.0f} s of the processor" for name, each in spent.items()))
    return int(worst < DECIBELS or far > PIXELS)


def pixels_apart(one: Image.Image, other: Image.Image) -> int:
    """Return by how many pixels one image's silhouette must be widened to hold the other's."""
    held = np.array(other.getchannel("A")) >= 128
    mask = one.getchannel("A").point(lambda alpha: 255 * (alpha >= 128))
    for pixels in range(max(one.size)):
        if np.array(mask)[held].all():
            return pixels
        mask = mask.filter(ImageFilter.MaxFilter(3))
    return max(one.size)


if __name__ == "__main__":
    sys.exit(main())
