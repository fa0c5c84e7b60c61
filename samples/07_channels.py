"""All channels of a material, and channels of one's own.

A texture holds what the model's materials state, one array a channel over one tree. Here the droid also gets
bumps, from an image read with its texture coordinates, which become normals at rest. Where a cell averages
normals that differ, their mean is shorter than 1: what such a surface reflects is spread as by roughness.

    python samples/07_channels.py [FOLDER]      writes FOLDER/droid.octex (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "10"))
MODEL = Path(__file__).with_name("droid.glb")


def bumps(size: int, count: int) -> np.ndarray:
    """Return a normal map (size, size, 3), uint8, of round bumps."""
    y, x = np.mgrid[:size, :size] / size * count * 2 * np.pi
    directions = np.stack([0.5 * np.sin(x), 0.5 * np.sin(y), np.ones_like(x)], axis=-1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return np.rint((directions + 1) * 127.5).astype(np.uint8)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    sources = {"normal": bumps(512, 24), "occlusion": 0.9}
    texture = octex.convert(MODEL, depth=DEPTH, sources=sources, dtype={"normal": "uint16"})
    texture.save(folder / "droid.octex")
    print(*(channel.format for channel in texture.channels.values()), sep="\n")

    points = octex.load_surface(MODEL).scatter(100_000).rest
    values = texture.sample(points, ["base_color", "roughness", "normal"])  # one walk for all three
    print("normals are unit vectors:", np.allclose(np.linalg.norm(values["normal"], axis=1), 1, atol=1e-3))
    for level in (DEPTH, DEPTH - 2, DEPTH - 4):
        means = texture.level(level).sample(points, "normal", normalize=False)
        print(f"level {level:2}: their means are {np.linalg.norm(means, axis=1).mean():.3f} long")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
