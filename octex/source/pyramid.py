"""Mip pyramids of images, and reads from them: wraps, nearest, bilinear, and averages over footprints.

Texel centres lie at (i + 0.5) / n, u runs right and v down the rows. Texels are sRGB codes of 16 bits and
linear alpha of 16 bits; each is decoded before anything is averaged. Colours are averaged with their alpha as
weight and stored unmultiplied, so that the colour of a texel that covers nothing leaks nowhere.

A level holds half the texels of the one below it, rounded down, in each direction; each is the exact mean over
its area, for any size.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import decode_table
from octex.jit import kernel

REPEAT, MIRROR, CLAMP = 0, 1, 2
WRAPS = ("repeat", "mirror", "clamp")
#: The longest footprints are read at this many places; what lies between them is blurred.
MAX_TAPS = 16

# Weight of a texel that covers nothing: its colour counts only where no other does.
_FAINT = 2.0**-30


class Pyramids(NamedTuple):
    """All images of a model with their levels, as kernels see them."""

    texels: npt.NDArray[np.uint16]  # (texels, 4)   all levels of all images, row by row
    levels: npt.NDArray[np.int64]  # (levels, 3)   first texel, width, height
    first_levels: npt.NDArray[np.int64]  # (images + 1,)
    translucent: npt.NDArray[np.bool_]  # (images,)   whether any alpha is below 1
    linear: npt.NDArray[np.float32]  # (65536,)   linear light of an sRGB code


class Layer(NamedTuple):
    """An image as one material reads it."""

    texels: npt.NDArray[np.uint16]  # (height, width, 4)
    uses_alpha: bool  # else every texel covers
    threshold: float  # from level 1 up, alpha is 1 where it reached this and else 0; negative: as it is


def build_pyramids(layers: Sequence[Layer]) -> Pyramids:
    """Build every level of every image."""
    shapes: list[tuple[int, int]] = []
    first_levels = [0]
    for layer in layers:
        height, width, _ = layer.texels.shape
        shapes.append((width, height))
        while width > 1 or height > 1:
            width, height = max(width // 2, 1), max(height // 2, 1)
            shapes.append((width, height))
        first_levels.append(len(shapes))
    sizes = np.array([w * h for w, h in shapes], np.int64)
    ends = np.cumsum(sizes)
    levels = np.array([(e - s, w, h) for (w, h), s, e in zip(shapes, sizes, ends, strict=True)], np.int64)
    texels = np.empty((int(ends[-1]) if len(ends) else 0, 4), np.uint16)
    linear = decode_table("uint16", "srgb")
    translucent = np.zeros(len(layers), np.bool_)
    for number, (layer, first) in enumerate(zip(layers, first_levels, strict=False)):
        base = texels[levels[first, 0] : levels[first, 0] + sizes[first]]
        base[:] = layer.texels.reshape(-1, 4)
        if layer.uses_alpha:
            translucent[number] = bool((base[:, 3] != 65535).any())
        else:
            base[:, 3] = 65535
        threshold = layer.threshold if translucent[number] else -1.0
        for row in range(first + 1, first_levels[number + 1]):
            _reduce(texels, levels[row - 1], levels[row], linear, threshold if row == first + 1 else -1.0)
    return Pyramids(texels, levels.reshape(-1, 3), np.array(first_levels, np.int64), translucent, linear)


@kernel
def _encode(linear: float) -> int:
    """Return the 16-bit sRGB code nearest to linear light (IEC 61966-2-1)."""
    encoded = linear * 12.92 if linear <= 0.0031308 else 1.055 * linear ** (1.0 / 2.4) - 0.055
    return np.int64(min(max(encoded, 0.0), 1.0) * 65535.0 + 0.5)


@kernel
def _reduce(
    texels: npt.NDArray[np.uint16],
    source: npt.NDArray[np.int64],
    target: npt.NDArray[np.int64],
    linear: npt.NDArray[np.float32],
    threshold: float,
) -> None:
    """Fill the level ``target`` with means of the level ``source`` over each texel's area."""
    width, height = source[1], source[2]
    step_x, step_y = width / target[1], height / target[2]
    for y in range(target[2]):
        top, bottom = y * step_y, (y + 1) * step_y
        y0, y1 = np.int64(top), min(np.int64(np.ceil(bottom - 1e-9)), height)
        for x in range(target[1]):
            left, right = x * step_x, (x + 1) * step_x
            x0, x1 = np.int64(left), min(np.int64(np.ceil(right - 1e-9)), width)
            red = green = blue = covered = alpha = area = 0.0
            for j in range(y0, y1):
                part_y = min(bottom, j + 1.0) - max(top, float(j))
                for i in range(x0, x1):
                    part = part_y * (min(right, i + 1.0) - max(left, float(i)))
                    at = source[0] + j * width + i
                    opacity = texels[at, 3] / 65535.0
                    if threshold >= 0.0:
                        opacity = 1.0 if opacity >= threshold else 0.0
                    weight = part * (opacity + _FAINT)
                    red += weight * linear[texels[at, 0]]
                    green += weight * linear[texels[at, 1]]
                    blue += weight * linear[texels[at, 2]]
                    covered += weight
                    alpha += part * opacity
                    area += part
            at = target[0] + y * target[1] + x
            texels[at, 0] = _encode(red / covered)
            texels[at, 1] = _encode(green / covered)
            texels[at, 2] = _encode(blue / covered)
            texels[at, 3] = np.int64(alpha / area * 65535.0 + 0.5)


@kernel
def _unwrap(coordinate: float, mode: int) -> float:
    """Bring a coordinate into 0 … 1, for mirrored images into 0 … 2."""
    if mode == CLAMP:
        return min(max(coordinate, 0.0), 1.0)
    if mode == MIRROR:
        return coordinate - 2.0 * np.floor(coordinate * 0.5)
    return coordinate - np.floor(coordinate)


@kernel
def _wrap(index: int, size: int, mode: int) -> int:
    """Return the texel that stands for one just outside an image, of an unwrapped coordinate."""
    if 0 <= index < size:
        return index
    if mode == REPEAT:
        return index + size if index < 0 else index - size
    if mode == MIRROR:
        if index < 0 or index >= 2 * size:
            return 0
        return 2 * size - 1 - index
    return 0 if index < 0 else size - 1


@kernel
def _read_level(
    pyramids: Pyramids,
    image: int,
    level: int,
    u: float,
    v: float,
    wrap_u: int,
    wrap_v: int,
    sharpness: float,
    threshold: float,
) -> tuple[float, float, float, float, float]:
    """Read a level: sums of weight × colour, of weights, and alpha.

    A sharpness of 1 is bilinear. Above, texels are flat and meet in a ramp of 1 / sharpness texels, the mean
    over a footprint of that width; infinite: the texel that holds the point.
    """
    row = pyramids.levels[pyramids.first_levels[image] + level]
    first, width, height = row[0], row[1], row[2]
    x = _unwrap(u, wrap_u) * width - 0.5
    y = _unwrap(v, wrap_v) * height - 0.5
    left, top = np.floor(x), np.floor(y)
    part_x, part_y = x - left, y - top
    if sharpness != 1.0:
        if sharpness > 1e9:
            part_x = 1.0 if part_x >= 0.5 else 0.0
            part_y = 1.0 if part_y >= 0.5 else 0.0
        else:
            part_x = min(max((part_x - 0.5) * sharpness + 0.5, 0.0), 1.0)
            part_y = min(max((part_y - 0.5) * sharpness + 0.5, 0.0), 1.0)
    x0, y0 = np.int64(left), np.int64(top)
    x1, y1 = _wrap(x0 + 1, width, wrap_u), _wrap(y0 + 1, height, wrap_v)
    x0, y0 = _wrap(x0, width, wrap_u), _wrap(y0, height, wrap_v)
    texels, linear = pyramids.texels, pyramids.linear
    a, b = texels[first + y0 * width + x0], texels[first + y0 * width + x1]
    c, d = texels[first + y1 * width + x0], texels[first + y1 * width + x1]
    weight_a, weight_b = (1.0 - part_x) * (1.0 - part_y), part_x * (1.0 - part_y)
    weight_c, weight_d = (1.0 - part_x) * part_y, part_x * part_y
    covered = alpha = 1.0
    if pyramids.translucent[image]:
        alpha_a, alpha_b = a[3] / 65535.0, b[3] / 65535.0
        alpha_c, alpha_d = c[3] / 65535.0, d[3] / 65535.0
        if threshold >= 0.0 and sharpness != 1.0 and level == 0:
            alpha_a = 1.0 if alpha_a >= threshold else 0.0
            alpha_b = 1.0 if alpha_b >= threshold else 0.0
            alpha_c = 1.0 if alpha_c >= threshold else 0.0
            alpha_d = 1.0 if alpha_d >= threshold else 0.0
        alpha = weight_a * alpha_a + weight_b * alpha_b + weight_c * alpha_c + weight_d * alpha_d
        weight_a *= alpha_a + _FAINT
        weight_b *= alpha_b + _FAINT
        weight_c *= alpha_c + _FAINT
        weight_d *= alpha_d + _FAINT
        covered = weight_a + weight_b + weight_c + weight_d
        if threshold >= 0.0 and level == 0 and sharpness == 1.0:
            scale = covered
            alpha = 1.0 if alpha >= threshold else 0.0
            covered = alpha + _FAINT
            scale = covered / scale
            weight_a *= scale
            weight_b *= scale
            weight_c *= scale
            weight_d *= scale
    red = (
        weight_a * linear[a[0]] + weight_b * linear[b[0]] + weight_c * linear[c[0]] + weight_d * linear[d[0]]
    )
    green = (
        weight_a * linear[a[1]] + weight_b * linear[b[1]] + weight_c * linear[c[1]] + weight_d * linear[d[1]]
    )
    blue = (
        weight_a * linear[a[2]] + weight_b * linear[b[2]] + weight_c * linear[c[2]] + weight_d * linear[d[2]]
    )
    return red, green, blue, covered, alpha


@kernel
def read(
    pyramids: Pyramids,
    image: int,
    u: float,
    v: float,
    wrap_u: int,
    wrap_v: int,
    nearest: bool,
    threshold: float,
    major_u: float,
    major_v: float,
    major: float,
    minor: float,
) -> tuple[float, float, float, float]:
    """Return red, green, blue (linear light, unmultiplied) and alpha of an image over a footprint about (u, v).

    The footprint is ``major`` texels long, in the direction and length (major_u, major_v) of coordinates, and
    ``minor`` texels wide; 0 and 0 reads at the point. A ``threshold`` of 0 or more makes alpha 0 or 1.

    Long footprints are read at up to MAX_TAPS places, each at the level whose texels, read bilinearly, spread
    as far as a box of the place's share: a level l spreads by a variance of 4ˡ/4 − 1/12 texels², and a box of
    width w over bilinear texels by 1/6 + w²/12, over flat ones by 1/12 + w²/12.
    """
    if major <= 0.0:
        sharpness = np.inf if nearest else 1.0
        red, green, blue, covered, alpha = _read_level(
            pyramids, image, 0, u, v, wrap_u, wrap_v, sharpness, threshold
        )
        return red / covered, green / covered, blue / covered, alpha
    taps = min(max(np.int64(np.ceil(min(major / max(minor, 1.0), 2.0 * MAX_TAPS) - 0.1)), 1), MAX_TAPS)
    width = max(minor, major / taps)
    sharpness = 1.0
    if nearest:
        spread = (2.0 + width * width) / 3.0
        if spread < 1.0:
            sharpness = 1.0 / width
            spread = 1.0
    else:
        spread = 1.0 + width * width / 3.0
    highest = pyramids.first_levels[image + 1] - pyramids.first_levels[image] - 1
    level = min(0.5 * np.log2(spread), float(highest))
    lower = np.int64(level)
    part = level - lower
    red = green = blue = covered = alpha = 0.0
    for tap in range(taps):
        along = (tap + 0.5) / taps - 0.5
        at_u, at_v = u + along * major_u, v + along * major_v
        r, g, b, c, a = _read_level(pyramids, image, lower, at_u, at_v, wrap_u, wrap_v, sharpness, threshold)
        red += (1.0 - part) * r
        green += (1.0 - part) * g
        blue += (1.0 - part) * b
        covered += (1.0 - part) * c
        alpha += (1.0 - part) * a
        if part > 0.0:
            r, g, b, c, a = _read_level(
                pyramids, image, lower + 1, at_u, at_v, wrap_u, wrap_v, 1.0, threshold
            )
            red += part * r
            green += part * g
            blue += part * b
            covered += part * c
            alpha += part * a
    return red / covered, green / covered, blue / covered, alpha / taps
