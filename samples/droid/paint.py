"""Four painted maps: every part's finish, then light and weather over all."""

from __future__ import annotations

import numpy as np
from PIL import Image

from .canvas import Canvas, clouds, noise, ramp
from .finishes import FINISHES, STEEL
from .solids import Array, Model
from .unwrap import Unwrap

GRIME = np.array([58, 46, 34]) / 255
DUST = np.array([158, 140, 112]) / 255


def scatter(model: Model, spacing: float) -> Array:
    """Return points all over the surface, about one to a square of the spacing."""
    a, b, c = np.moveaxis(model.corners, 1, 0)
    steps = np.ceil(np.sqrt(np.linalg.norm(model.crosses, axis=1)) / spacing).astype(int)
    points = []
    for n in np.unique(steps):
        i, j = np.nonzero(np.add.outer(np.arange(n), np.arange(n)) < n)
        u, v = ((np.stack([i, j]) + 1 / 3) / max(n, 1))[..., None]
        mine = steps == n
        points.append(a[mine, None] + u * (b - a)[mine, None] + v * (c - a)[mine, None])
    return np.concatenate([p.reshape(-1, 3) for p in points])


def openness(occluders: Array, points: Array, normals: Array, directions: int = 48) -> Array:
    """Return the share of the sky that each point (n, 3) sees, 0…1, by one depth map a direction."""
    step, bias = 0.0022, 0.0035
    reach = int(np.linalg.norm(occluders, axis=1).max() / step) + 2
    width = 2 * reach
    points, normals, occluders = (np.ascontiguousarray(v.T, np.float32) for v in (points, normals, occluders))
    seen, total = np.zeros(points.shape[1], np.float32), np.full(points.shape[1], 1e-6, np.float32)
    for i in range(directions):
        y, turn = 1 - (2 * i + 1) / directions, np.pi * (1 + 5**0.5) * i
        toward = np.array([np.sqrt(1 - y * y) * np.cos(turn), y, np.sqrt(1 - y * y) * np.sin(turn)])
        right = np.cross(toward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        axes = np.stack([right / step, np.cross(toward, right) / step, toward]).astype(np.float32)
        nearest = np.full(width * width, -9, np.float32)
        u, v, depth = axes @ occluders
        np.maximum.at(nearest, (u + reach).astype(np.int32) * width + (v + reach).astype(np.int32), depth)
        u, v, depth = axes @ points
        cell = (u + reach).astype(np.int32) * width + (v + reach).astype(np.int32)
        weight = np.maximum(axes[2] @ normals - 0.05, 0) * np.float32(
            1.25 if y > -0.3 else 0.55
        )  # less from below
        seen += weight * (nearest[cell] < depth + np.float32(bias))
        total += weight
    return seen / total


def weather(c: Canvas, light: Array) -> Array:
    """Mottle the paint, chip its edges, scratch it, let grime run; return colours (n, 3)."""
    p = c.points
    color = (
        c.color * (0.94 + 0.10 * clouds(p, 0.05, 1))[:, None] * (0.975 + 0.05 * noise(p, 0.0035, 9))[:, None]
    )

    worn = c.edges * (0.35 + 0.9 * clouds(p, 0.020, 11)) * c.bare
    chips = ramp(worn + 0.35 * noise(p, 0.0022, 13) * (c.edges > 0.08), 0.62, 0.80)
    primer = ramp(worn + 0.30 * noise(p, 0.0030, 14) * (c.edges > 0.05), 0.46, 0.58) * (1 - chips)
    spots = ramp(clouds(p, 0.011, 17, 3), 0.795, 0.83) * c.bare
    scratches = np.zeros(len(p))
    for seed, direction, size in ((21, (1.0, 0.25, 0.9), 0.0011), (22, (0.3, 1.0, -0.8), 0.0013)):
        d = np.array(direction) / np.linalg.norm(direction)
        stretched = p - 0.97 * np.outer(p @ d, d)
        here = ramp(clouds(p, 0.045, seed + 2), 0.60, 0.70) * c.bare
        scratches = np.maximum(scratches, ramp(noise(stretched, size, seed), 0.92, 0.97) * here)
    color *= (1 - 0.225 * primer)[:, None]
    color += np.clip(chips + 0.85 * spots, 0, 1)[:, None] * (0.92 * STEEL - color)
    color += 0.45 * scratches[:, None] * (0.97 * STEEL - color)

    upright = np.clip(1.2 - 1.6 * np.abs(c.normals[:, 1]), 0, 1)
    runs = (
        ramp(clouds(p / [1, 9, 1], 0.0045, 41, 3), 0.52, 0.80)
        * ramp(clouds(p, 0.09, 43), 0.42, 0.68)
        * upright
    )
    creases = np.clip(c.creases * (0.5 + clouds(p, 0.012, 47)), 0, 1)
    dirt = np.clip(0.75 * creases + 0.50 * runs + 0.55 * ramp(0.80 - light, 0.0, 0.65), 0, 0.85)
    color *= c.relief[:, None]
    color += 0.85 * dirt[:, None] * (GRIME * (0.6 + 0.8 * color.mean(1, keepdims=True)) - color)
    dust = ramp(clouds(p, 0.030, 53), 0.50, 0.78) * np.clip(c.normals[:, 1], 0, 1)
    color += 0.22 * dust[:, None] * (DUST - color)
    return color * (0.50 + 0.50 * np.clip(light * 1.12, 0, 1))[:, None]


def fill(image: Array, known: Array, levels: int = 4) -> Array:
    """Carry the colours of the charts outward, so that smaller mip levels keep them; a mean beyond."""
    if levels == 0:
        return np.where(known[..., None], image, image[known].mean(0))
    h, w = known.shape
    weight = known.reshape(h // 2, 2, w // 2, 2).sum((1, 3))
    total = (image * known[..., None]).reshape(h // 2, 2, w // 2, 2, 3).sum((1, 3))
    coarse = fill(total / np.maximum(weight, 1)[..., None], weight > 0, levels - 1).repeat(2, 0).repeat(2, 1)
    padded = np.pad(coarse, ((1, 1), (1, 1), (0, 0)), "edge")
    smooth = np.mean([padded[i : i + h, j : j + w] for i in range(3) for j in range(3)], axis=0)
    return np.where(known[..., None], image, smooth)


def to_palette(image: Image.Image) -> Image.Image:
    """Reduce an image to 256 colours, chosen from a ninth of its texels."""
    few = image.resize((image.width // 3, image.height // 3), Image.Resampling.NEAREST)
    palette = few.quantize(256, Image.Quantize.MEDIANCUT, kmeans=2)
    return image.quantize(palette=palette, dither=Image.Dither.NONE)


def paint(model: Model, unwrapped: Unwrap) -> tuple[dict[str, Image.Image], dict[str, float]]:
    """Return the maps as palette images, and how much of each the triangles cover."""
    canvases = {name: Canvas(model, unwrapped, name) for name in unwrapped.maps}
    points, normals = (
        np.concatenate([getattr(c, v) for c in canvases.values()]) for v in ("points", "normals")
    )
    light = openness(scatter(model, 0.0012), points, normals)
    images, coverage = {}, {}
    for name, c in canvases.items():
        mine, light = light[: len(c.points)], light[len(c.points) :]
        for finish in np.unique(c.finish):
            FINISHES[finish](c, np.flatnonzero(c.finish == finish))
        shape = c.size.height, c.size.width
        image, known = np.zeros((*shape, 3)), np.zeros(shape, bool)
        image[c.texels.rows, c.texels.columns] = weather(c, mine)
        known[c.texels.rows, c.texels.columns] = True
        codes = np.rint(np.clip(fill(image, known), 0, 1) * 255).astype(np.uint8)
        images[name] = to_palette(Image.fromarray(codes))
        coverage[name] = float(c.texels.covered.sum() / known.size)
    return images, coverage
