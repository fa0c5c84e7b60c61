"""A control cage, its Catmull–Clark surface, and one with creases, by one texture of the cage.

python samples/22_subdivision.py [FOLDER]      writes FOLDER/subdivision.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "9"))
WIDTH = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "360"))
#: A cube with a second one on top, and the edges that get creases.
QUADS = "1 3 4 2  1 2 6 5  3 7 8 4  1 5 7 3  2 4 8 6  5 6 10 9  7 11 12 8  5 9 11 7  6 8 12 10  9 10 12 11"
CREASES = np.array([[8, 9], [9, 11], [11, 10], [10, 8]])


def checks(at: np.ndarray) -> np.ndarray:
    """Checker the cage by its own positions."""
    odd = np.floor(4 * at + 1e-6).astype(int).sum(axis=1) % 2 == 1
    return np.where(odd[:, None], (0.75, 0.20, 0.08), (0.9, 0.82, 0.6))


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    rows = ((1.0, -1.0), (1.0, 1.0), (0.7, 2.4))
    lines = [f"v {x * r} {y} {z * r}" for r, y in rows for x in (-1, 1) for z in (-1, 1)]
    lines += [f"f {face}" for face in QUADS.split("  ")]
    path = folder / "cage.obj"
    path.write_text("\n".join(lines), encoding="utf-8")

    cage = octex.load_surface(path)
    sharp = octex.Creases(CREASES, np.full(4, 2.5), np.empty(0), np.empty(0))
    smooth, creased = octex.subdivide(cage, 5), octex.subdivide(cage, 5, creases=sharp)
    texture = octex.convert(cage, DEPTH, sources={"base_color": checks})
    camera = octex.Camera.fitted(cage.vertices, (0.5, 0.45, 1.0), size=(WIDTH, WIDTH))
    views = [octex.render(texture, each, camera) for each in (cage, smooth, creased)]
    Image.fromarray(np.hstack(views)).save(folder / "subdivision.png")
    print(f"{folder / 'subdivision.png'}: the cage, its limit surface, and with creases")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
