"""A land, a rounded box, a tin and a ball, none with UVs, and a board to lay on them."""

import numpy as np
from PIL import Image, ImageDraw

import octex


def board(columns: int, field: int = 128) -> Image.Image:
    """Return four rows of numbered fields, of another hue in each column."""
    image = Image.new("HSV", (columns * field, 4 * field))
    draw = ImageDraw.Draw(image)
    for y, x in np.ndindex(4, columns):
        dark, left, top = (x + y) % 2, field * x, field * y
        color = 255 * x // columns, 130 + 70 * dark, 230 - 90 * dark
        draw.rectangle((left, top, left + field - 1, top + field - 1), color)
        middle, label = (left + field / 2, top + field / 2), f"{'ABCD'[y]}{x + 1}"
        draw.text(middle, label, (0, 0, 255 * dark), anchor="mm", font_size=0.55 * field)
    return image.convert("RGB")


def shapes(n: int = 121) -> dict[str, octex.Surface]:
    """Return surfaces of grids of n × n points, z up; all but the land are made of a cube's six sides."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, n)] * 2, indexing="ij")
    land = np.stack([x, y, 0.12 * np.sin(4 * x + 1) * np.cos(4 * y)], -1)[None]
    top = np.stack([x, y, np.ones_like(x)], -1)
    cube = np.stack([np.roll(top * way, k, -1) for way in ((1, 1, 1), (-1, 1, -1)) for k in range(3)])
    box, ball = (cube / np.linalg.norm(cube, p, axis=-1, keepdims=True) for p in (8, 2))
    x, y, z = np.moveaxis(cube, -1, 0)
    inward = 0.8 * np.maximum(np.abs(x), np.abs(y)) / np.maximum(np.hypot(x, y), 1e-9)
    tin = np.stack([inward * x, inward * y, z], -1)
    return {
        name: _mesh(points) for name, points in {"land": land, "box": box, "tin": tin, "ball": ball}.items()
    }


def _mesh(grids: np.ndarray) -> octex.Surface:
    a = np.arange(grids[..., 0].size).reshape(grids.shape[:3])
    a, b, c, d = a[:, :-1, :-1], a[:, 1:, :-1], a[:, 1:, 1:], a[:, :-1, 1:]
    triangles = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
    return octex.Surface.from_arrays(grids.reshape(-1, 3), triangles)
