"""What goes wrong with photographs, above, and after the remedy, below.

From the left: cameras that are off, refined; exposures that differ, balanced; a ball that the mesh lacks, and
sky on a mesh that is too thick, both masked.

    python samples/draw_failures.py [FOLDER]      writes FOLDER/failures.png (default: out)
"""

import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "10"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "300"))
SKY = 0.35, 0.6, 0.95
take, enlarged = import_module("12_photos").photo, import_module("draw_concepts").enlarged


def with_alpha(image: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    return np.dstack([image[..., :3], alpha]).astype(np.float32)


def attempts(surface: octex.Surface, head: np.ndarray) -> Iterator[octex.OctreeTexture]:
    """Yield for each fault the model, the texture with it, and the texture after the remedy."""
    random = np.random.default_rng(5)
    turns = 0.3 + np.pi / 4 * np.arange(8)
    sides = [(np.sin(turn), 0.1 + 0.25 * (-1) ** n, np.cos(turn)) for n, turn in enumerate(turns)]
    cameras = [octex.Camera.fitted(head, side, size=(2 * SIZE, 2 * SIZE)) for side in sides]
    images = [take(surface, camera, 1.0) for camera in cameras]
    masks = [image[..., 3] for image in images]

    def painted(images, cameras=cameras, model=surface, **options) -> octex.OctreeTexture:
        photos = map(octex.Projection, images, cameras)
        return octex.paint(None, model, list(photos), max_depth=DEPTH, **options)

    moves = [np.pad(0.003 * random.normal(size=(3, 1)), ((0, 1), (3, 0))) for _ in cameras]
    off = [
        replace(each, world_to_camera=each.world_to_camera + move)
        for each, move in zip(cameras, moves, strict=True)
    ]
    refined = octex.refine_cameras(surface, list(map(octex.Projection, images, off)))
    yield surface, painted(images, off), painted(images, refined)

    uneven = [image * [*3 * [1.6 - n % 2], 1.0] for n, image in enumerate(images)]
    yield surface, painted(uneven), painted(uneven, balance="gain")

    sphere = trimesh.creation.icosphere(3, 0.035)
    ball = octex.Surface.from_arrays(
        sphere.vertices + head.mean(axis=0) + [0.12, 0.03, 0.05], sphere.faces, factor=(0.1, 0.5, 0.15)
    )
    both = [take(octex.Surface.joined([surface, ball]), camera, 1.0) for camera in cameras]
    alike = [np.abs(one - two).max(axis=2) == 0 for one, two in zip(both, images, strict=True)]
    yield surface, painted(both), painted(map(with_alpha, both, map(np.multiply, masks, alike)))

    normals = trimesh.Trimesh(surface.vertices, surface.triangles, process=False).vertex_normals
    thick = octex.Surface.from_arrays(surface.vertices + 0.002 * normals, surface.triangles)
    skies = [
        with_alpha(np.where(mask[..., None], image[..., :3], SKY), 1 + 0 * mask)
        for image, mask in zip(images, masks, strict=True)
    ]
    yield thick, painted(skies, model=thick), painted(map(with_alpha, skies, masks), model=thick)


def main(folder: Path) -> None:
    surface = octex.load_surface(Path(__file__).with_name("droid.glb"), channels=["base_color"])
    head = surface.vertices[(surface.vertices[:, 1] > 0.43) & (surface.vertices[:, 1] < 0.64)]
    camera = enlarged(octex.Camera.fitted(head, (0.9, 0.35, 0.6), size=(SIZE, SIZE)), 0.66, 0.4, 1.7)
    columns = [
        np.vstack([octex.render(texture, model, camera) for texture in textures])
        for model, *textures in attempts(surface, head)
    ]
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack(columns)).save(folder / "failures.png", optimize=True)
    print(f"{folder / 'failures.png'}: faults above, remedies below")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
