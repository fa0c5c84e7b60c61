"""Mip pyramids of images, and reads from them: wraps, nearest, bilinear, and averages over footprints.

Texel centres lie at (i + 0.5) / n, u runs right and v down the rows. Texels are sRGB codes of 16 bits and
linear alpha of 16 bits; each is decoded before anything is averaged. Colours are averaged with their alpha as
weight and stored unmultiplied, so that the colour of a texel that covers nothing leaks nowhere.

A level holds half the texels of the one below it, rounded down, in each direction; each texel is the exact
mean over its area, for any size. Beyond the border of a clamped image a footprint so reads a margin of the
image as wide as itself, not the border alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import decode_table
from octex.jit import inlined, kernel

REPEAT, MIRROR, CLAMP = 0, 1, 2
WRAPS = ("repeat", "mirror", "clamp")
#: The longest footprints are read at this many places; what lies between them is blurred.
MAX_TAPS = 16

# Weight of a texel that covers nothing: its colour counts only where no other does.
_FAINT = np.float32(2.0**-40)
# Reads are in single precision: 17 ns where double takes 26 (bilinear, in cache).
_NONE, _ALL, _CODES = np.float32(0), np.float32(1), np.float32(65535)
# A texel is a word of four codes: red in the lowest bits, then green, blue and alpha.
_CODE, _GREEN, _BLUE, _ALPHA = np.uint64(65535), np.uint64(16), np.uint64(32), np.uint64(48)


class Pyramids(NamedTuple):
    """All images of a model with their levels, as kernels see them."""

    texels: npt.NDArray[np.uint64]  # (texels,)   all levels of all images, row by row
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
    return Pyramids(
        texels.view("<u8")[:, 0], levels.reshape(-1, 3), np.array(first_levels, np.int64), translucent, linear
    )


@kernel
def _encode(linear: float) -> int:
    """Return the 16-bit sRGB code nearest to linear light (IEC 61966-2-1)."""
    encoded = linear * 12.92 if linear <= 0.0031308 else 1.055 * linear ** (1.0 / 2.4) - 0.055
    return int(min(max(encoded, 0.0), 1.0) * 65535.0 + 0.5)


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


@inlined
def _unwrap(coordinate: float, mode: int) -> float:
    """Bring a coordinate into 0 … 1, for mirrored images into 0 … 2."""
    if mode == CLAMP:
        return min(max(coordinate, 0.0), 1.0)
    if mode == MIRROR:
        return float(coordinate - 2.0 * np.floor(coordinate * 0.5))
    return float(coordinate - np.floor(coordinate))


@inlined
def _wrap(index: int, size: int, mode: int) -> int:
    """Return the texel that stands for one at most just outside an image (or its mirror image)."""
    if 0 <= index < size:
        return index
    if mode == REPEAT:
        return index + size if index < 0 else index - size
    if mode == CLAMP:
        return 0 if index < 0 else size - 1
    if index < 0 or index >= 2 * size:
        return 0
    return 2 * size - 1 - index


@inlined
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
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return red, green, blue (linear light, unmultiplied) and alpha of an image over a footprint at (u, v).

    The footprint is ``major`` texels long, which (major_u, major_v) is in coordinates, and ``minor`` texels
    wide; 0 and 0 reads at the point. A ``threshold`` of 0 or more makes alpha 0 or 1.

    Long footprints are read at up to MAX_TAPS places, spaced so that together they spread as far as the
    footprint is long; each place is read from the two levels whose mixture spreads as far as the footprint is
    wide. Reading level l bilinearly spreads by a variance of 4ˡ/4 − 1/12 texels², a box of width w by w²/12
    on top of 1/6 for bilinear texels, of 1/12 for flat ones; the variance of a mixture is the mixture of
    variances. Where flat texels are magnified, they meet in a ramp as wide as the footprint. A second level
    that would count for less than 1/256 is not read.
    """
    taps, level, layers = 1, 0, 1
    part = _NONE
    step = 0.0  # from place to place, as a share of the long axis
    ramp_x = ramp_y = 0.0 if nearest else 1.0
    if major > 0.0:
        width = minor
        if major > 1.1 * max(minor, 1.0):
            taps = int(min(math.ceil(major / max(minor, 1.0) - 0.1), float(MAX_TAPS)))
            if taps == MAX_TAPS:
                width = max(minor, major / taps)
            step = math.sqrt((major * major - width * width) / (taps * taps - 1)) / major
        else:
            width = math.sqrt(0.5 * (major * major + minor * minor))
        spread = 1.0 + width * width / 3.0
        highest = pyramids.first_levels[image + 1] - pyramids.first_levels[image] - 1
        if nearest:
            spread -= 1.0 / 3.0
            ramp_x = ramp_y = 1.0
            if spread < 1.0:
                base = pyramids.first_levels[image]
                x, y = major_u * pyramids.levels[base, 1] / taps, major_v * pyramids.levels[base, 2] / taps
                across = minor / major * taps
                ramp_x = min(math.sqrt(x * x + across * across * y * y), 1.0)
                ramp_y = min(math.sqrt(y * y + across * across * x * x), 1.0)
        while spread >= 4.0 and level < highest:
            spread *= 0.25
            level += 1
        if spread > 1.0 + 3.0 / 256.0 and level < highest:
            part = np.float32((spread - 1.0) / 3.0)
            layers = 2
    translucent = pyramids.translucent[image]
    red = green = blue = covered = alpha = _NONE
    at_u, at_v = u, v
    for tap in range(taps):
        if taps > 1:
            along = (tap - 0.5 * (taps - 1)) * step
            at_u, at_v = u + along * major_u, v + along * major_v
        at_u, at_v = _unwrap(at_u, wrap_u), _unwrap(at_v, wrap_v)
        for layer in range(layers):
            row = pyramids.first_levels[image] + level + layer
            first, wide, high = pyramids.levels[row, 0], pyramids.levels[row, 1], pyramids.levels[row, 2]
            x, y = at_u * wide - 0.5, at_v * high - 0.5
            left, top = math.floor(x), math.floor(y)
            right, down = np.float32(x - left), np.float32(y - top)
            if ramp_x < 1.0:
                right = _ramp(right, ramp_x)
            if ramp_y < 1.0:
                down = _ramp(down, ramp_y)
            x0, y0 = int(left), int(top)
            x1, y1 = x0 + 1, y0 + 1
            if x0 < 0 or x1 >= wide:
                x0, x1 = _wrap(x0, wide, wrap_u), _wrap(x1, wide, wrap_u)
            if y0 < 0 or y1 >= high:
                y0, y1 = _wrap(y0, high, wrap_v), _wrap(y1, high, wrap_v)
            a, b = pyramids.texels[first + y0 * wide + x0], pyramids.texels[first + y0 * wide + x1]
            c, d = pyramids.texels[first + y1 * wide + x0], pyramids.texels[first + y1 * wide + x1]
            share = part if layer == 1 else _ALL - part
            weight_a, weight_b = share * (_ALL - right) * (_ALL - down), share * right * (_ALL - down)
            weight_c, weight_d = share * (_ALL - right) * down, share * right * down
            if translucent:
                alpha_a, alpha_b = np.float32(a >> _ALPHA) / _CODES, np.float32(b >> _ALPHA) / _CODES
                alpha_c, alpha_d = np.float32(c >> _ALPHA) / _CODES, np.float32(d >> _ALPHA) / _CODES
                cut = threshold >= 0.0 and level + layer == 0
                if cut and nearest:
                    alpha_a, alpha_b = _cut(alpha_a, threshold), _cut(alpha_b, threshold)
                    alpha_c, alpha_d = _cut(alpha_c, threshold), _cut(alpha_d, threshold)
                opacity = weight_a * alpha_a + weight_b * alpha_b + weight_c * alpha_c + weight_d * alpha_d
                weight_a *= alpha_a + _FAINT
                weight_b *= alpha_b + _FAINT
                weight_c *= alpha_c + _FAINT
                weight_d *= alpha_d + _FAINT
                if cut and not nearest:
                    scale = weight_a + weight_b + weight_c + weight_d
                    opacity = _cut(opacity / share, threshold) * share
                    scale = (opacity + _FAINT * share) / scale
                    weight_a *= scale
                    weight_b *= scale
                    weight_c *= scale
                    weight_d *= scale
                alpha += opacity
                covered += weight_a + weight_b + weight_c + weight_d
            linear = pyramids.linear
            red += weight_a * linear[a & _CODE] + weight_b * linear[b & _CODE]
            red += weight_c * linear[c & _CODE] + weight_d * linear[d & _CODE]
            green += weight_a * linear[(a >> _GREEN) & _CODE] + weight_b * linear[(b >> _GREEN) & _CODE]
            green += weight_c * linear[(c >> _GREEN) & _CODE] + weight_d * linear[(d >> _GREEN) & _CODE]
            blue += weight_a * linear[(a >> _BLUE) & _CODE] + weight_b * linear[(b >> _BLUE) & _CODE]
            blue += weight_c * linear[(c >> _BLUE) & _CODE] + weight_d * linear[(d >> _BLUE) & _CODE]
    if translucent:
        return red / covered, green / covered, blue / covered, alpha / np.float32(taps)
    if taps > 1:
        share = _ALL / np.float32(taps)
        return red * share, green * share, blue * share, _ALL
    return red, green, blue, _ALL


@inlined
def _ramp(part: np.float32, width: float) -> np.float32:
    """Return the share of the farther of two flat texels in a footprint of a width below 1."""
    if width <= 0.0:
        return _ALL if part >= 0.5 else _NONE
    ramp = (float(part) - 0.5) / width + 0.5
    return np.float32(min(max(ramp, 0.0), 1.0))


@inlined
def _cut(alpha: np.float32, threshold: float) -> np.float32:
    return _ALL if alpha >= threshold else _NONE
