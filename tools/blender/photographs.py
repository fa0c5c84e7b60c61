#!/usr/bin/env python
"""Paint a model with all photographs but one, and compare with that one: of a real set, or Blender's own.

usage: photographs.py PYTHON [MODEL] [--count 14] [--width 800] [--held-out 4] [--keep FOLDER]
       photographs.py --scan MESH --cameras FILE [--balance full] [--refine-cameras] [--keep FOLDER]

PYTHON is that of an environment with PyPI's bpy (5.0.1 is for Python 3.11); it runs worker.py.
The model stands in sun and skylight on a ground that no mesh has; the photographs are JPEG files, the bare
mesh is a PLY, the cameras are a transforms.json. With --keep an earlier run's photographs in FOLDER serve
again. Photographs that are held out are drawn from what the others painted, and compared inside the
silhouette, two pixels from its edge, where others saw the surface: as they are, and without the difference of
their means, for what shines looks lighter from some sides, and nothing tells how long one was exposed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import numpy.typing as npt
from calling import DROID, blender
from PIL import Image

import octex
from octex.channels import linear_to_srgb
from octex.drawing import render_surface, texture_shader
from octex.drawing.hits import rest_normals, visible_hits
from octex.painting.options import BALANCES, PICTURES

#: Pixels from the silhouette's edge on that are compared: those at it show the ground, too.
FROM_EDGE = 2
#: How much of what is compared others saw, at least.
COVERED = 0.5


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("python", type=Path, nargs="?")
    parser.add_argument("model", type=Path, nargs="?", default=DROID)
    parser.add_argument("--count", type=int, default=14)
    parser.add_argument("--width", type=int, default=800)
    parser.add_argument("--rays", type=int, default=48, help="paths of light a pixel")
    parser.add_argument("--held-out", type=int, default=4)
    parser.add_argument("--scan", type=Path, help="a bare mesh, of real photographs")
    parser.add_argument("--cameras", type=Path, help="their cameras, which name them")
    parser.add_argument("--pictures", choices=PICTURES, nargs="+", default=PICTURES)
    parser.add_argument("--balance", choices=BALANCES)
    parser.add_argument("--refine-cameras", action="store_true")
    parser.add_argument("--keep", type=Path, help="a folder for photographs and pictures")
    options = parser.parse_args(arguments)
    if (options.python is None) == (options.cameras is None):
        parser.error("give PYTHON, or --scan and --cameras")
    with folder_at(options.keep) as folder:
        if options.cameras is None and not (folder / "transforms.json").exists():
            job = {"count": options.count, "width": options.width, "rays": options.rays}
            blender(
                options.python, "photograph", model=str(options.model), folder=str(folder.resolve()), **job
            )
        surface = octex.load_surface(options.scan or folder / "scan.ply")
        frames = octex.read_cameras(options.cameras or folder / "transforms.json")
        frames = [each for each in frames if each.image is not None and each.image.exists()]
        given = [octex.Projection(each.image, each.camera()) for each in frames]
        if options.refine_cameras:
            cameras = octex.refine_cameras(surface, given)
            given = [replace(each, camera=camera) for each, camera in zip(given, cameras, strict=True)]
        chosen = np.linspace(0, len(given), options.held_out, endpoint=False).astype(int).tolist()
        for pictures in options.pictures:
            for number in chosen:
                others = [each for n, each in enumerate(given) if n != number]
                texture = octex.paint(
                    None, surface, others, pictures=pictures, balance=options.balance, coverage=True
                )
                found = compared(surface, texture, given[number], folder / f"{pictures}{number:02d}.png")
                print(
                    f"{pictures}, {frames[number].name}: {found[0]:.1f} dB, {found[1]:.1f} without the means",
                    flush=True,
                )
    return 0


@contextmanager
def folder_at(path: Path | None) -> Iterator[Path]:
    """Yield a folder, a temporary one for None."""
    if path is None:
        with TemporaryDirectory() as name:
            yield Path(name)
    else:
        path.mkdir(parents=True, exist_ok=True)
        yield path


def compared(
    surface: octex.Surface, texture: octex.OctreeTexture, held: octex.Projection, picture: Path
) -> tuple[float, float]:
    """Draw what a photograph shows; return how near it is, in dB, and without the means' difference."""
    camera = held.camera
    assert isinstance(camera, octex.Camera)
    truth = np.asarray(Image.open(str(held.image)).convert("RGB"), np.float64)
    made = 255 * linear_to_srgb(np.clip(render_surface(surface, camera, texture_shader(texture)), 0, 1))
    inside = np.zeros(truth.shape[:2], np.bool_)
    for pixels, hits in visible_hits(surface, camera, rest_normals(surface)):
        inside.ravel()[pixels] = texture.sample(hits.rest, "coverage", normals=hits.normals)[:, 0] > COVERED
    for _ in range(FROM_EDGE):
        around = np.pad(inside, 1)
        inside = around[:-2, 1:-1] & around[2:, 1:-1] & around[1:-1, :-2] & around[1:-1, 2:] & inside
    Image.fromarray(np.hstack([truth, made]).round().astype(np.uint8)).save(picture)
    off = (made - truth)[inside]
    return decibels(off), decibels(off - off.mean(axis=0))


def decibels(off: npt.NDArray[np.float64]) -> float:
    """Return the PSNR of differences between codes."""
    return float(10 * np.log10(255**2 / np.mean(off**2)))


if __name__ == "__main__":
    sys.exit(main())
