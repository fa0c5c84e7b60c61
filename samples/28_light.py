"""Light from all around, on metal, plastic and glass: one texture under three lights (octex help pictures).

A row of balls from mirror to matte, gold and blue plastic, behind a sheet of tinted glass with a hole in it.

    python samples/28_light.py [FOLDER]      writes FOLDER/light.png (default: out)
"""

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import octex
from octex.channels import encode
from octex.preview import render, texture_shader
from octex.view.environment import Environment

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "8"))
SIZE = int(os.environ.get("OCTEX_SAMPLE_WIDTH", "420"))
BALLS = 5


def ball(
    centre: tuple[float, float, float], color: tuple[float, float, float], **material: float
) -> octex.Surface:
    """Return a ball of one material."""
    surface = octex.Surface.from_function(
        lambda at: np.linalg.norm(at - np.array(centre), axis=1) - 0.45,
        [np.array(centre) - 0.5, np.array(centre) + 0.5],
        0.05,
    )
    return surface.with_sources({"base_color": color, **material})


def glass() -> octex.Surface:
    """Return a sheet in front of half of the balls, with a round hole."""
    corners = np.array([[-0.5, -0.5, 0.7], [2.2, -0.5, 0.7], [2.2, 1.6, 0.7], [-0.5, 1.6, 0.7]])
    y, x = np.mgrid[1.5:-0.5:256j, -0.5:2.2:256j]
    tint = np.zeros((256, 256, 4), np.uint8)
    tint[...] = 40, 160, 110, 110
    tint[np.hypot(x - 1.0, y - 0.5) < 0.35, 3] = 0
    sheet = octex.Surface.from_arrays(
        corners, [[0, 1, 2], [0, 2, 3]], uv=[[0, 0], [1, 0], [1, 1], [0, 1]], image=tint, wrap="clamp"
    )
    return sheet.with_sources({"metallic": 0.0, "roughness": 0.1})


def lights() -> list[Environment]:
    """Return the built-in light, an evening sky, and white all around, in which white shows nothing."""
    down, across = np.mgrid[0:64, 0:128] / 64
    sky = np.where((down < 0.5)[..., None], [0.25, 0.4, 0.8], [0.25, 0.2, 0.16]) * 1.2
    sky = sky + np.exp(-(((down - 0.47) / 0.12) ** 2))[..., None] * [1.2, 0.5, 0.1]
    sky = sky + 60 * (np.hypot(down - 0.4, across - 0.7) < 0.04)[..., None] * [1.0, 0.8, 0.5]
    return [Environment.studio(), Environment.of(sky), Environment.of(np.ones((8, 16)))]


def main(folder: Path) -> None:
    steps = [number / (BALLS - 1) for number in range(BALLS)]
    gold = [ball((n, 1, 0), (1.0, 0.78, 0.34), metallic=1.0, roughness=r) for n, r in enumerate(steps)]
    blue = [ball((n, 0, 0), (0.05, 0.2, 0.7), metallic=0.0, roughness=r) for n, r in enumerate(steps)]
    model = octex.Surface.joined([*gold, *blue, glass()])
    texture = octex.convert(model, DEPTH)
    camera = octex.Camera.fitted(model.vertices, (0.1, 0.15, 1), size=(2 * SIZE, SIZE))
    look = texture_shader(texture, materials=True)
    pictures = [encode(render(model, camera, look, light=light), "uint8", "srgb") for light in lights()]
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.vstack(pictures)).save(folder / "light.png")
    print(f"{folder / 'light.png'}: {len(pictures)} lights on {texture.tree.n_leaves:,} leaves")


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
