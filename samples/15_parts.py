"""Parts that run through each other share cells, and their colours run together; moved apart at rest, not.

The texture remembers how far: Surface.placed_in and Surface.rest_positions say where it has the surface.

    python samples/15_parts.py [FOLDER]      writes FOLDER/parts.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from manifold3d import Manifold
from PIL import Image

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "6"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "960")) // 3
TURNS = ((0, 0, 0), (90, 0, 0), (0, 90, 0))
COLORS = [[0.95, 0.75, 0.25], [0.75, 0.08, 0.1], [0.1, 0.45, 0.2], [0.08, 0.2, 0.6]]


def main(folder: Path) -> None:
    bar = Manifold.cylinder(2.0, 0.22, circular_segments=64, center=True)
    solids = [Manifold.sphere(0.62, 128), *(bar.rotate(turn) for turn in TURNS)]
    meshes = [solid.to_mesh() for solid in solids]
    starts = np.cumsum([0] + [len(mesh.vert_properties) for mesh in meshes])
    colors = np.repeat(COLORS, np.diff(starts), axis=0)
    points = np.concatenate([mesh.vert_properties[:, :3] for mesh in meshes])
    triangles = np.concatenate([mesh.tri_verts + start for mesh, start in zip(meshes, starts, strict=False)])
    surface = octex.Surface.from_arrays(points, triangles, colors=colors, name="jack")
    print(surface.overlapping_parts())

    camera = octex.Camera.fitted(surface.vertices, (0.8, 0.55, 1.0), size=(SIZE, SIZE))
    images = []
    for cells in (None, 3):
        texture = octex.convert(surface, DEPTH, separate=cells)
        images.append(octex.render(texture, surface, camera))
    camera = octex.Camera.fitted(surface.rest_positions(texture), (0.8, 0.55, 1.0), size=(SIZE, SIZE))
    images.append(octex.render(texture, None, camera, level=min(DEPTH, 6), cubes=True))
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack(images)).save(folder / "parts.png")
    print(f"{folder / 'parts.png'}: as it is, moved apart at rest, and the cells of that; {texture.tree!r}")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
