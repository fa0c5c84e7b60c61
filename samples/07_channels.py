"""All channels of a material, some of them one's own.

This torus has a colour image, and is given bumps: a normal map, read at the same coordinates, which becomes
normals at rest. Where a cell averages normals that differ, their mean is shorter than 1.

    python samples/07_channels.py [FOLDER]      writes FOLDER/torus.octex (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "9"))


def torus(around: int, across: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, triangles, and texture coordinates whose v runs up."""
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, around), np.linspace(0, 1, across)))
    ring, turn = np.exp(2j * np.pi * v) * 0.4, np.exp(2j * np.pi * u)
    vertices = np.stack([(1 + ring.real) * turn.real, (1 + ring.real) * turn.imag, ring.imag], axis=1)
    a = np.add.outer(around * np.arange(across - 1), np.arange(around - 1)).ravel()
    quads = np.stack([a, a + 1, a + around + 1, a + around], axis=1)
    return vertices, np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), np.stack([48 * u, 18 * v], axis=1)


def main(folder: Path) -> None:
    y, x = np.mgrid[:64, :64] / 64 * 2 * np.pi
    bumps = np.stack([0.5 * np.sin(x), 0.5 * np.sin(y), 0.8 * np.ones_like(x)], axis=-1)
    normal_map = np.rint((bumps + 1) * 127.5).astype(np.uint8)  # of any length
    stripes = np.where(np.sin(x)[..., None] > 0, [230, 120, 20], [40, 60, 90]).astype(np.uint8)

    vertices, triangles, uv = torus(240, 120)
    surface = octex.Surface.from_arrays(vertices, triangles, uv=uv, image=stripes, name="torus")
    texture = octex.convert(surface, depth=DEPTH, sources={"normal": normal_map, "roughness": 0.4})
    folder.mkdir(parents=True, exist_ok=True)
    texture.save(folder / "torus.octex")
    points = surface.scatter(100_000).rest
    values = texture.sample(points, ["base_color", "roughness", "normal"])  # one walk for all three
    print("normals are unit vectors:", np.allclose(np.linalg.norm(values["normal"], axis=1), 1, atol=1e-3))
    for level in range(DEPTH, DEPTH - 5, -1):
        means = texture.level(level).sample(points, "normal", normalize=False)
        print(f"level {level:2}: their means are {np.linalg.norm(means, axis=1).mean():.3f} long")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
