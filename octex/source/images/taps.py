"""Taps, weighted texels of one image's levels: how filters list them, and how they are summed."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int64s
from octex.jit import inlined
from octex.source.images.pyramid import CLAMP, DATA, FAINT, MIRROR, REPEAT, SRGB, Images

#: How a threshold acts on alpha: not at all, on each texel of the finest level, on their sum.
NEVER, EACH, SUM = 0, 1, 2

#: Most taps of a footprint. Indices and weights are two arguments: a tuple of them costs EWA up to a tenth of
#: its time.
MOST_TAPS = 4096

# Images are read in single precision: 17 ns where double takes 26 (bilinear, in cache).
_NONE, _ALL, _CODES, _FAINT = np.float32(0), np.float32(1), np.float32(65535), np.float32(FAINT)
# A texel is a word of four codes: red in the lowest bits, then green, blue and alpha.
_CODE, _GREEN, _BLUE, _ALPHA = np.uint64(65535), np.uint64(16), np.uint64(32), np.uint64(48)


class Footprint(NamedTuple):
    """A point in texture coordinates, a covariance around it in texels², and how the image is read."""

    u: float
    v: float
    xx: float
    xy: float
    yy: float
    least: float  # its variance along the short axis
    most: float  # and along the long one
    wrap_u: int
    wrap_v: int
    flat: bool  # whether texels are flat, or else joined by bilinear patches


@inlined
def unwrapped(coordinate: float, mode: int, variance: float, size: int) -> float:
    """Move a coordinate by whole periods, or of a clamped image toward its border."""
    if mode == CLAMP:
        if -4.0 <= coordinate <= 5.0:
            return coordinate
        far = 4.0 + min(math.sqrt(12.0 * variance) / size, 1e9)
        return min(max(coordinate, -far), 1.0 + far)
    # Coordinates may exceed the integers that math.floor returns.
    if mode == MIRROR:
        return float(coordinate - 2.0 * np.floor(coordinate * 0.5))
    return float(coordinate - np.floor(coordinate))


@inlined
def wrapped(index: int, size: int, mode: int) -> int:
    """Return the texel at an index beyond the image; −1 and ``size`` are the rim of clamped images."""
    if 0 <= index < size:
        return index
    if mode == CLAMP:
        return max(min(index, size), -1)
    if mode == REPEAT:
        return index % size
    index %= 2 * size
    return index if index < size else 2 * size - 1 - index


@inlined
def window(
    images: Images, row: int, foot: Footprint, left: int, top: int, across: tuple[float | np.float32, ...],
    down: tuple[float | np.float32, ...], indices: Int64s, weights: Float64s, count: int,
) -> int:  # fmt: skip
    """Add a window of a level's texels, with the weights of its columns and rows."""
    first, width, height = images.levels[row, 0], images.levels[row, 1], images.levels[row, 2]
    is_inside = left >= 0 and left + len(across) <= width
    for j in range(len(down)):
        start = first + wrapped(top + j, height, foot.wrap_v) * (width + 2)
        for i in range(len(across)):
            x = left + i if is_inside else wrapped(left + i, width, foot.wrap_u)
            indices[count], weights[count] = start + x, across[i] * down[j]
            count += 1
    return count


@inlined
def bilinear(
    images: Images, row: int, foot: Footprint, weight: float, indices: Int64s, weights: Float64s, count: int
) -> int:
    """Add the four texels of a level around a point, whose weights sum to ``weight``."""
    x, y = foot.u * images.levels[row, 1] - 0.5, foot.v * images.levels[row, 2] - 0.5
    left, top = math.floor(x), math.floor(y)
    right, down = x - left, y - top
    across = (weight * (1.0 - right), weight * right)
    return window(images, row, foot, left, top, across, (1.0 - down, down), indices, weights, count)


@inlined
def flat_texels(
    images: Images, row: int, foot: Footprint, xx: float, yy: float, indices: Int64s, weights: Float64s
) -> int:
    """List the flat texels under a footprint of at most a texel: they meet in ramps of its width."""
    x, y = foot.u * images.levels[row, 1] - 0.5, foot.v * images.levels[row, 2] - 0.5
    left, top = math.floor(x), math.floor(y)
    right, down = _ramp(x - left, math.sqrt(12.0 * xx)), _ramp(y - top, math.sqrt(12.0 * yy))
    return window(images, row, foot, left, top, (1.0 - right, right), (1.0 - down, down), indices, weights, 0)


@inlined
def _ramp(part: float, width: float) -> float:
    """Return the share of the farther of two flat texels."""
    if width <= 0.0:
        return 1.0 if part >= 0.5 else 0.0
    return min(max((part - 0.5) / width + 0.5, 0.0), 1.0)


@inlined
def gather(
    images: Images, image: int, layout: int, indices: Int64s, weights: Float64s, count: int, cut: int,
    scale: float, threshold: float, lanes: Float32s, at: int,
) -> None:  # fmt: skip
    """Sum an image's texels at taps into four lanes; colours unmultiplied."""
    kind, base, covered = images.kinds[image], images.bases[image], images.covered[image]
    linear, codes = images.linear, images.codes
    red = green = blue = alpha = _NONE
    factor = np.float32(scale)
    opacity = factor
    if kind == SRGB and not covered:
        for i in range(count):
            word, weight = codes[base + indices[i]], np.float32(weights[i])
            red += weight * linear[word & _CODE]
            green += weight * linear[(word >> _GREEN) & _CODE]
            blue += weight * linear[(word >> _BLUE) & _CODE]
            alpha += weight * np.float32(np.int64(word >> _ALPHA))
        opacity = factor / _CODES
    elif kind == DATA:
        for i in range(count):
            word, weight = codes[base + indices[i]], np.float32(weights[i])
            red += weight * np.float32(np.int64(word & _CODE))
            green += weight * np.float32(np.int64((word >> _GREEN) & _CODE))
            blue += weight * np.float32(np.int64((word >> _BLUE) & _CODE))
            alpha += weight * np.float32(np.int64(word >> _ALPHA))
        factor /= _CODES
        opacity = factor
    else:
        row = images.layouts[layout, 0]
        fine = (images.levels[row, 1] + 2) * (images.levels[row, 2] + 2)  # texels of the finest level
        weighed = _NONE
        for i in range(count):
            weight = np.float32(weights[i])
            if kind == SRGB:
                word = codes[base + indices[i]]
                r, g = linear[word & _CODE], linear[(word >> _GREEN) & _CODE]
                b, a = linear[(word >> _BLUE) & _CODE], np.float32(np.int64(word >> _ALPHA)) / _CODES
            else:
                floats, texel = images.floats, base + indices[i]
                r, g, b, a = floats[texel, 0], floats[texel, 1], floats[texel, 2], floats[texel, 3]
            if covered and cut == EACH and threshold >= 0.0 and indices[i] < fine:
                a = _ALL if a >= threshold else _NONE
            alpha += weight * a
            if covered:  # bicubic weights may be negative, but no coverage is
                weight = max(weight, _NONE) * (a + _FAINT)
            weighed += weight
            red += weight * r
            green += weight * g
            blue += weight * b
        if covered:
            alpha = min(max(alpha, _NONE), _ALL / factor)
        if covered and cut == SUM and threshold >= 0.0:
            alpha = _ALL if alpha * factor >= threshold else _NONE
            opacity = _ALL
        factor = _ALL / weighed
    lanes[at] = red * factor
    lanes[at + 1] = green * factor
    lanes[at + 2] = blue * factor
    lanes[at + 3] = alpha * opacity


@inlined
def catmull_rom(t: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return the weights of four texels, for a point 0 ≤ t < 1 from the second to the third."""
    half, one = np.float32(0.5), np.float32(1.0)
    square, s = t * t, one - t
    return (
        -half * t * s * s,
        one - half * square * (np.float32(5.0) - np.float32(3.0) * t),
        half * t * (one + np.float32(4.0) * t - np.float32(3.0) * square),
        -half * square * s,
    )
