"""What image filters share: where a texel lies under a wrap, and the reads of one level."""

from __future__ import annotations

import math

import numpy as np

from octex.arrays import Float64s, Int64s
from octex.jit import inlined
from octex.source.images.pyramid import CLAMP, MIRROR, REPEAT, Images

#: How a threshold acts on alpha: not at all, on each texel of the finest level, on their sum.
NEVER, EACH, SUM = 0, 1, 2

#: The most taps that a footprint can have; beside them lie the spans of summed-area tables.
MOST_TAPS = 4096
TAP_ROOM = MOST_TAPS + 16


@inlined
def unwrapped(coordinate: float, mode: int, variance: float, size: int) -> float:
    """Bring a coordinate to where the image, its mirror image, or no more than its border is in reach."""
    if mode == CLAMP:
        if -4.0 <= coordinate <= 5.0:
            return coordinate
        far = 4.0 + min(math.sqrt(12.0 * variance) / size, 1e9)
        return min(max(coordinate, -far), 1.0 + far)
    # math.floor makes an integer, which coordinates may exceed.
    if mode == MIRROR:
        return float(coordinate - 2.0 * np.floor(coordinate * 0.5))
    return float(coordinate - np.floor(coordinate))


@inlined
def wrapped(index: int, size: int, mode: int) -> int:
    """Return the texel that stands for one anywhere; −1 and ``size`` are the rim of clamped images."""
    if 0 <= index < size:
        return index
    if mode == CLAMP:
        return max(min(index, size), -1)
    if mode == REPEAT:
        return index % size
    index %= 2 * size
    return index if index < size else 2 * size - 1 - index


@inlined
def bilinear(
    images: Images,
    row: int,
    wrap_u: int,
    wrap_v: int,
    u: float,
    v: float,
    weight: float,
    count: int,
    places: Int64s,
    weights: Float64s,
) -> int:
    """Add the four texels of a level around a point, with a weight in all."""
    first, width, height = images.levels[row, 0], images.levels[row, 1], images.levels[row, 2]
    x, y = u * width - 0.5, v * height - 0.5
    left, top = math.floor(x), math.floor(y)
    right, down = x - left, y - top
    x0, y0 = int(left), int(top)
    x1, y1 = x0 + 1, y0 + 1
    if x0 < 0 or x1 >= width:
        x0, x1 = wrapped(x0, width, wrap_u), wrapped(x1, width, wrap_u)
    if y0 < 0 or y1 >= height:
        y0, y1 = wrapped(y0, height, wrap_v), wrapped(y1, height, wrap_v)
    upper, lower = first + y0 * (width + 2), first + y1 * (width + 2)
    places[count], weights[count] = upper + x0, weight * (1.0 - right) * (1.0 - down)
    places[count + 1], weights[count + 1] = upper + x1, weight * right * (1.0 - down)
    places[count + 2], weights[count + 2] = lower + x0, weight * (1.0 - right) * down
    places[count + 3], weights[count + 3] = lower + x1, weight * right * down
    return count + 4


@inlined
def flat_texels(
    images: Images,
    row: int,
    wrap_u: int,
    wrap_v: int,
    u: float,
    v: float,
    xx: float,
    yy: float,
    places: Int64s,
    weights: Float64s,
) -> int:
    """List the flat texels under a footprint of at most a texel: they meet in ramps of its own width."""
    first, width, height = images.levels[row, 0], images.levels[row, 1], images.levels[row, 2]
    x, y = u * width - 0.5, v * height - 0.5
    left, top = math.floor(x), math.floor(y)
    right, down = _ramp(x - left, math.sqrt(12.0 * xx)), _ramp(y - top, math.sqrt(12.0 * yy))
    x0, x1 = wrapped(int(left), width, wrap_u), wrapped(int(left) + 1, width, wrap_u)
    y0, y1 = wrapped(int(top), height, wrap_v), wrapped(int(top) + 1, height, wrap_v)
    upper, lower = first + y0 * (width + 2), first + y1 * (width + 2)
    places[0], weights[0] = upper + x0, (1.0 - right) * (1.0 - down)
    places[1], weights[1] = upper + x1, right * (1.0 - down)
    places[2], weights[2] = lower + x0, (1.0 - right) * down
    places[3], weights[3] = lower + x1, right * down
    return 4


@inlined
def _ramp(part: float, width: float) -> float:
    """Return the share of the farther of two flat texels."""
    if width <= 0.0:
        return 1.0 if part >= 0.5 else 0.0
    return min(max((part - 0.5) / width + 0.5, 0.0), 1.0)
