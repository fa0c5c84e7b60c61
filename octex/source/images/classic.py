"""The filters besides EWA: mip maps and ripmaps, summed-area tables, and a bicubic spline."""

from __future__ import annotations

import math

import numpy as np

from octex.arrays import Float64s, Int64s
from octex.jit import inlined
from octex.source.images.pyramid import CLAMP, REPEAT, Images
from octex.source.images.taps import (
    EACH,
    MOST_TAPS,
    NEVER,
    SUM,
    Footprint,
    bilinear,
    catmull_rom,
    flat_texels,
    window,
)


@inlined
def _level_of(variance: float, flat: bool, levels: int) -> tuple[int, float]:
    """Return the finer of two levels, and the coarser one's share, whose mixture has a variance."""
    spread = 4.0 * variance + (2.0 / 3.0 if flat else 1.0)  # 4ˡ at a level read bilinearly
    level = 0
    while spread >= 4.0 and level < levels - 1:
        spread *= 0.25
        level += 1
    if spread > 1.0 and level < levels - 1:
        return level, (spread - 1.0) / 3.0
    return level, 0.0


@inlined
def mixed_levels(
    images: Images, layout: int, foot: Footprint, is_ripmap: bool, indices: Int64s, weights: Float64s
) -> tuple[int, int]:
    """List the texels of the levels whose mixture has the footprint's variances, or the larger one."""
    base, across, most = images.layouts[layout, 0], images.layouts[layout, 1], foot.most
    xx, yy = (foot.xx, foot.yy) if is_ripmap else (most, most)
    level_x, part_x = _level_of(xx, foot.flat, across)
    level_y, part_y = _level_of(yy, foot.flat, images.layouts[layout, 2])
    whole = level_x == 0 and level_y == 0
    if whole and part_x == 0.0 and part_y == 0.0:
        if foot.flat:
            return flat_texels(images, base, foot, xx, yy, indices, weights), SUM
        return bilinear(images, base, foot, 1.0, indices, weights, 0), SUM
    if not is_ripmap:
        count = bilinear(images, base + level_x, foot, 1.0 - part_x, indices, weights, 0)
        if part_x > 0.0:
            count = bilinear(images, base + level_x + 1, foot, part_x, indices, weights, count)
        return count, EACH if whole else NEVER
    count = 0
    for step_y in range(2 if part_y > 0.0 else 1):
        for step_x in range(2 if part_x > 0.0 else 1):
            weight = (part_x if step_x else 1.0 - part_x) * (part_y if step_y else 1.0 - part_y)
            row = base + (level_y + step_y) * across + level_x + step_x
            count = bilinear(images, row, foot, weight, indices, weights, count)
    return count, EACH if whole else NEVER


@inlined
def bicubic(images: Images, row: int, foot: Footprint, indices: Int64s, weights: Float64s) -> int:
    """List the sixteen texels around a point, weighted by Catmull and Rom's spline."""
    x, y = foot.u * images.levels[row, 1] - 0.5, foot.v * images.levels[row, 2] - 0.5
    left, top = math.floor(x), math.floor(y)
    across, down = catmull_rom(np.float32(x - left)), catmull_rom(np.float32(y - top))
    return window(images, row, foot, left - 1, top - 1, across, down, indices, weights, 0)


@inlined
def areas(images: Images, row: int, foot: Footprint, indices: Int64s, weights: Float64s) -> int:
    """List the entries of a summed-area table for the mean over a box; their weights sum to 0."""
    width, height = images.levels[row, 1], images.levels[row, 2]
    texel = 1e-6 if foot.flat else 1.0
    across, down = math.sqrt(12.0 * foot.xx + texel), math.sqrt(12.0 * foot.yy + texel)
    at = MOST_TAPS
    n_x = _span(foot.u * width, across, width, foot.wrap_u, at, indices, weights)
    n_y = _span(foot.v * height, down, height, foot.wrap_v, at + 8, indices, weights)
    count = 0
    for j in range(at + 8, at + 8 + n_y):
        for i in range(at, at + n_x):
            indices[count] = indices[j] * (width + 1) + indices[i]
            weights[count] = weights[j] * weights[i]
            count += 1
    return count


@inlined
def _span(
    middle: float, width: float, size: int, mode: int, at: int, indices: Int64s, weights: Float64s
) -> int:
    """List, from ``at`` on, the sums for the mean over a span, which may lie beyond the image."""
    count = 0
    for end in range(2):
        sign = (1.0 if end else -1.0) / width
        x = middle + (0.5 if end else -0.5) * width
        if mode != CLAMP:
            period = size if mode == REPEAT else 2 * size
            turns = math.floor(x / period)
            x -= turns * period
            whole = turns if mode == REPEAT else 2.0 * turns  # copies of the whole image's sum
            if x > size:
                whole += 2.0
                x = 2.0 * size - x
                sign = -sign
                whole = -whole
            if whole != 0.0:
                indices[at + count], weights[at + count] = size, sign * whole
                count += 1
        # Beyond the border of a clamped image its last texel repeats.
        left = min(max(math.floor(x), 0), size - 1)
        indices[at + count], weights[at + count] = int(left) + 1, sign * (x - left)
        indices[at + count + 1], weights[at + count + 1] = int(left), sign * (1.0 - (x - left))
        count += 2
    return count
