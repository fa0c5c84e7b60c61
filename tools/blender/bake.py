#!/usr/bin/env python
"""Bake a model, have Blender draw it unlit, and by the octree itself, and time both programs' bakes.

usage: tools/blender/bake.py PYTHON [MODEL] [--depth 10] [--texture-size 2048] [--image 512] [--samples 4]

PYTHON is that of an environment with PyPI's bpy (5.0.1 is for Python 3.11); it runs worker.py.
Blender imports the baked .glb and draws its base colour with Cycles: emission, the Standard view transform.
Blender reads maps without averaging, so that where texels are smaller than pixels one ray a pixel differs by
aliasing: the whole model is drawn with several, and a part of it from so near that texels are larger than
pixels, with one. Then an OSL node draws both from the octree. The exit code is 1 if an image of what was
baked is not within 35 dB of octex's own inside the silhouette, if one of the octree is not within 40, or if
octex does not bake 4 times as many texels a second as Blender (processor time; the same mesh and maps).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

import octex
from octex.channels import linear_to_srgb
from octex.drawing import texture_shader
from octex.drawing.hits import Hits
from octex.drawing.rasters import film_surface
from octex.drawing.shaders import Appearance

DROID = Path(__file__).parents[2] / "samples" / "droid.glb"
#: From glTF's axes to those that Blender's importer gives them.
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
DECIBELS = {"baked": 35.0, "exact": 40.0}
TIMES = 4.0


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("python", type=Path)
    parser.add_argument("model", type=Path, nargs="?", default=DROID)
    parser.add_argument("--depth", type=int, default=10)
    parser.add_argument("--texture-size", type=int, default=2048)
    parser.add_argument("--image", type=int, default=512)
    parser.add_argument("--samples", type=int, default=4, help="rays along each side of a pixel")
    parser.add_argument("--direction", type=float, nargs=3, default=(0.5, 0.3, 1.0), metavar=("X", "Y", "Z"))
    parser.add_argument("--keep", type=Path, help="a folder for both images")
    options = parser.parse_args(arguments)
    surface = octex.load_surface(options.model, channels=["base_color"], normals=True)
    texture = octex.convert(surface, options.depth)
    size = options.texture_size
    baked = octex.bake(texture, surface, texture_size=size)
    began = time.process_time(), time.perf_counter()
    octex.bake(texture, baked, uv="keep", texture_size=size)
    spent = {"cpu": time.process_time() - began[0], "wall": time.perf_counter() - began[1]}
    frame = {"direction": options.direction, "size": (options.image,) * 2}
    far = octex.Camera.fitted(surface.vertices, **frame)
    near = octex.Camera.fitted(beside(baked, far, size, options.image), **frame)
    views = {"the whole model": (far, options.samples), "texels larger than pixels": (near, 1)}
    with TemporaryDirectory() as folder:
        model = Path(folder) / "baked.glb"
        octex.write_model(baked, model)
        shader = Path(folder) / "exact.osl"
        octex.write_osl(texture, shader, channels=["base_color"])
        jobs = {
            kind: [job_of(*each, Path(folder) / f"{kind}-{n}.png") for n, each in enumerate(views.values())]
            for kind in DECIBELS
        }
        told = blender(
            options.python, "bake", model=str(model), texture_size=size, shader=str(shader), **jobs
        )
        drawn = {
            kind: [np.array(Image.open(each["image"])).astype(np.float64) for each in own]
            for kind, own in jobs.items()
        }
    is_near, share = True, 1.0
    for number, (name, (camera, samples)) in enumerate(views.items()):
        own = view(texture, surface, camera, samples)
        print(f"{options.model.name}, {name}: {options.image}² pixels of {samples}² rays")
        if options.keep is not None:
            Image.fromarray(own.round().astype(np.uint8)).save(options.keep / f"octex-{number}.png")
        for kind, least in DECIBELS.items():
            image = drawn[kind][number]
            inside = (image[..., 3] == 255) & (own[..., 3] == 255)
            decibels = 10 * np.log10(255**2 / np.mean((image[..., :3] - own[..., :3])[inside] ** 2))
            covered = inside.sum() / max((own[..., 3] == 255).sum(), 1)
            is_near, share = is_near and decibels >= least, min(share, covered)
            if options.keep is not None:
                codes = image.round().astype(np.uint8)
                Image.fromarray(codes).save(options.keep / f"{kind}-{number}.png")
            print(
                f"{kind}: {decibels:.1f} dB inside the silhouette, {100 * covered:.1f} % of it (at least "
                f"{least:g}), {told[kind][number]:.2f} s of the processor"
            )
    texels = told["texels"]
    for name, each in (("octex.bake", spent), (f"Blender {told['version']}", told)):
        rate = f"{1e9 * each['cpu'] / texels:.0f} ns a texel"
        taken = f"{each['cpu']:.2f} s of the processor, {each['wall']:.2f} s"
        print(f"{name}: {texels / size**2:g} × {size}², {taken}, {rate}")
    times = told["cpu"] / spent["cpu"]
    print(f"octex bakes {times:.1f} times as many texels a second (at least {TIMES:g})")
    return int(not is_near or times < TIMES or share < 0.95)


def blender(python: Path, task: str, **job: Any) -> Any:
    """Have Blender do a task of worker.py; return its answer."""
    call = [str(python), str(Path(__file__).with_name("worker.py")), task, json.dumps(job)]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"Blender's part failed:\n{done.stdout}{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def beside(baked: octex.Surface, far: octex.Camera, size: int, pixels: int) -> np.ndarray:
    """Return corners of a box around what is nearest to a camera: half a texel a pixel wide."""
    assert baked.uv is not None
    flat = baked.uv.values[baked.uv.rows].astype(np.float64) * size
    texels = np.abs(np.linalg.det(flat[:, 1:] - flat[:, :1])).sum() / 2
    half = 0.25 * pixels * np.sqrt(baked.areas().sum() / texels)
    points = baked.scatter(20_000).points
    middle = points[np.argmin(np.linalg.norm(points - far.position, axis=1))]
    return middle + half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def job_of(camera: octex.Camera, samples: int, image: Path) -> dict[str, Any]:
    """Return an image to draw, as worker.py reads it."""
    pose = np.linalg.inv(np.diag([1.0, -1.0, -1.0, 1.0]) @ camera.world_to_camera)
    return {
        "image": str(image),
        "pose": (Z_UP @ pose).tolist(),
        "focal": camera.K[0, 0] / camera.width,
        "pixels": [camera.width, camera.height],
        "samples": samples,
    }


def view(
    texture: octex.OctreeTexture, surface: octex.Surface, camera: octex.Camera, samples: int
) -> np.ndarray:
    """Draw a surface unlit by its texture; return codes (height, width, 4), the last what is covered."""
    look = texture_shader(texture)

    def unlit(hits: Hits) -> Appearance:
        return Appearance(emitted=look(hits).unlit())

    color, coverage = film_surface(surface, camera, [unlit], samples)[0].exposure()
    return 255 * np.concatenate([linear_to_srgb(np.clip(color, 0, 1)), coverage > 1 - 1e-6], axis=2)


if __name__ == "__main__":
    sys.exit(main())
