"""What an image's texels at taps add up to."""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s, Float64s, Int64s
from octex.jit import inlined
from octex.source.images.pyramid import DATA, FAINT, FLOAT, SRGB, Images
from octex.source.images.taps import EACH, SUM

# Images are read in single precision: 17 ns where double takes 26 (bilinear, in cache).
_NONE, _ALL, _CODES, _FAINT = np.float32(0), np.float32(1), np.float32(65535), np.float32(FAINT)
# A texel is a word of four codes: red in the lowest bits, then green, blue and alpha.
_CODE, _GREEN, _BLUE, _ALPHA = np.uint64(65535), np.uint64(16), np.uint64(32), np.uint64(48)


@inlined
def gather(
    images: Images,
    image: int,
    layout: int,
    places: Int64s,
    weights: Float64s,
    count: int,
    scale: float,
    cut: int,
    threshold: float,
    lanes: Float32s,
    at: int,
) -> None:
    """Add up an image's texels at taps into four lanes; colours unmultiplied."""
    kind, base, covered = images.kinds[image], images.bases[image], images.covered[image]
    linear, codes = images.linear, images.codes
    red = green = blue = alpha = _NONE
    factor = np.float32(scale)
    opacity = factor
    if kind == SRGB and not covered:
        for i in range(count):
            word, weight = codes[base + places[i]], np.float32(weights[i])
            red += weight * linear[word & _CODE]
            green += weight * linear[(word >> _GREEN) & _CODE]
            blue += weight * linear[(word >> _BLUE) & _CODE]
            alpha += weight * np.float32(np.int64(word >> _ALPHA))
        opacity = factor / _CODES
    elif kind == DATA:
        for i in range(count):
            word, weight = codes[base + places[i]], np.float32(weights[i])
            red += weight * np.float32(np.int64(word & _CODE))
            green += weight * np.float32(np.int64((word >> _GREEN) & _CODE))
            blue += weight * np.float32(np.int64((word >> _BLUE) & _CODE))
            alpha += weight * np.float32(np.int64(word >> _ALPHA))
        factor /= _CODES
        opacity = factor
    elif kind in (SRGB, FLOAT):
        row = images.layouts[layout, 0]
        fine = (images.levels[row, 1] + 2) * (images.levels[row, 2] + 2)  # texels of the finest level
        weighed = _NONE
        for i in range(count):
            weight = np.float32(weights[i])
            if kind == SRGB:
                word = codes[base + places[i]]
                r, g = linear[word & _CODE], linear[(word >> _GREEN) & _CODE]
                b, a = linear[(word >> _BLUE) & _CODE], np.float32(np.int64(word >> _ALPHA)) / _CODES
            else:
                floats, place = images.floats, base + places[i]
                r, g, b, a = floats[place, 0], floats[place, 1], floats[place, 2], floats[place, 3]
            if covered and cut == EACH and threshold >= 0.0 and places[i] < fine:
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
    else:
        sums = images.sums
        total_red = total_green = total_blue = total_alpha = 0.0
        for i in range(count):
            place = base + places[i]
            total_red += weights[i] * sums[place, 0]
            total_green += weights[i] * sums[place, 1]
            total_blue += weights[i] * sums[place, 2]
            total_alpha += weights[i] * sums[place, 3]
        if covered:
            total_alpha = max(total_alpha, 0.0)  # but for rounding it is
            factor = np.float32(1.0 / (total_alpha + FAINT))
        red, green, blue = np.float32(total_red), np.float32(total_green), np.float32(total_blue)
        alpha = np.float32(total_alpha)
    lanes[at] = red * factor
    lanes[at + 1] = green * factor
    lanes[at + 2] = blue * factor
    lanes[at + 3] = alpha * opacity
