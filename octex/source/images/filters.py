"""Image filters: a footprint in, weighted texels out.

Every filter lists *taps*, indices of stored texels and their weights; images of one size under one footprint
share the list. Nearest, bilinear and bicubic read at points. The others match a variance: that of the
footprint, w²/12 for a width of w texels, plus that of the texels, 1/6 if bilinear, 1/12 if flat. A texel of
level l is a mean of 2ˡ texels, of variance (4ˡ − 1) / 12.
"""

from __future__ import annotations

import math

import numpy as np

from octex.arrays import Float64s, Int64s
from octex.checks import as_choice
from octex.jit import inlined
from octex.source.images.pyramid import Images
from octex.source.images.taps import (
    EACH,
    MOST_TAPS,
    NEVER,
    SUM,
    Footprint,
    bilinear,
    catmull_rom,
    flat_texels,
    unwrapped,
    window,
    wrapped,
)
from octex.source.vectors import Vector

#: The image filters, by name; the default last. Mip levels: Williams 1983; ellipses: Greene & Heckbert 1986.
FILTERS = ("nearest", "bilinear", "bicubic", "trilinear", "ewa")
NEAREST, BILINEAR, BICUBIC, TRILINEAR, EWA = range(5)

#: Largest variance of a footprint, in texels²: its ends must fit integers.
MOST_VARIANCE = 1e24
# Footprints longer than this many times their width are widened.
_LONGEST = 16.0
#: Footprints of up to two texels are read as boxes if their covariance, in texels², is at most this.
SKEW = 0.1
#: EWA reads the level at which the kernel's least variance, in texels², is from this to four times this, plus
#: a twelfth.
LEAST = 0.2
#: A coarser level is read if the product of a kernel's variances exceeds this: taps are 6 π times its root.
LARGEST = 7.0
#: A kernel 1 − q over the ellipse q < 1 has a variance of a sixth of its radius squared.
RADIUS = 6.0
#: At an image's coarsest level a footprint reaches this many texels at most.
FARTHEST = 24.0


def kernel_code(filter: str) -> int | None:
    """Return a filter's number for kernels: None for the default, which compiles without the others."""
    number = FILTERS.index(as_choice(filter, FILTERS, "filter"))
    return None if number == EWA else number


def reads_mips(code: int | None) -> bool:
    """Return whether the filter of a kernel code reads all levels."""
    return code is None or code == TRILINEAR


@inlined
def find_taps(
    images: Images, layout: int, filter: int | None, foot: Footprint, indices: Int64s, weights: Float64s
) -> tuple[int, int, float]:
    """List the taps of a footprint; return how many, NEVER, EACH or SUM, and what to scale sums by."""
    row = images.layouts[layout, 0]
    xx, xy, yy = foot.xx, foot.xy, foot.yy
    u = unwrapped(foot.u, foot.wrap_u, xx, images.levels[row, 1])
    v = unwrapped(foot.v, foot.wrap_v, yy, images.levels[row, 2])
    foot = Footprint(u, v, xx, xy, yy, foot.least, foot.most, foot.wrap_u, foot.wrap_v, foot.flat)
    if filter is None:
        if 12.0 * max(xx, yy) <= 1.0:
            if foot.flat:
                return flat_texels(images, row, foot, xx, yy, indices, weights), SUM, 1.0
            # Thresholding does not commute with averaging, except under tiny footprints.
            cut = SUM if 12.0 * max(xx, yy) < 0.25 else EACH
            return _small(images, row, foot, indices, weights), cut, 1.0
        if not foot.flat and 12.0 * max(xx, yy) <= 4.0 and abs(xy) <= SKEW:
            return _wide(images, row, foot, indices, weights), EACH, 1.0
        return _ellipse(images, layout, foot, indices, weights)
    cut = SUM
    if filter == TRILINEAR:
        count, cut = _mixed_levels(images, layout, foot, indices, weights)
    elif filter == BICUBIC:
        count = _bicubic(images, row, foot, indices, weights)
    elif filter == NEAREST or foot.flat:
        count = flat_texels(images, row, foot, 0.0, 0.0, indices, weights)
    else:
        count = bilinear(images, row, foot, 1.0, indices, weights, 0)
    return count, cut, 1.0


@inlined
def footprint(
    uu: float, uv: float, vv: float, width: int, height: int
) -> tuple[float, float, float, float, float]:
    """Return a covariance in texels², widened to _LONGEST at most, and its least and largest variance."""
    xx, xy, yy = uu * width * width, uv * width * height, vv * height * height
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    spread = math.sqrt(half * half + xy * xy)
    least, most = mean - spread, mean + spread
    short = most / (_LONGEST * _LONGEST) - least
    if short > 0.0:
        least += short
        xx += short * 0.5 * (1.0 - half / spread)
        yy += short * 0.5 * (1.0 + half / spread)
        xy -= short * 0.5 * xy / spread
    return xx, xy, yy, least, most


@inlined
def _small(images: Images, row: int, foot: Footprint, indices: Int64s, weights: Float64s) -> int:
    """List the texels of bilinear patches under a footprint of at most a texel.

    The mean over its box is exact; a skew adds the patch's mixed slope times the covariance.
    """
    xx, xy, yy = foot.xx, foot.xy, foot.yy
    if 12.0 * max(xx, yy) < 1e-4:
        return bilinear(images, row, foot, 1.0, indices, weights, 0)

    x, y = foot.u * images.levels[row, 1] - 0.5, foot.v * images.levels[row, 2] - 0.5
    near_x, near_y = math.floor(x + 0.5), math.floor(y + 0.5)
    part_x, part_y = x - near_x, y - near_y
    across, down = _thirds(part_x, math.sqrt(12.0 * xx)), _thirds(part_y, math.sqrt(12.0 * yy))
    count = window(images, row, foot, near_x - 1, near_y - 1, across, down, indices, weights, 0)
    a = (0 if part_y < 0.0 else 3) + (0 if part_x < 0.0 else 1)  # the patch's first texel
    _skew(weights, a, a + 3, xy)
    return count


@inlined
def _thirds(part: float, width: float) -> Vector:
    """Return the weights of the nearest texel and its two neighbours, in a box of a width up to 1."""
    half = 0.5 * max(width, 1e-3)
    a, b = max(half - part, 0.0), max(-half - part, 0.0)
    c, d = max(half + part, 0.0), max(part - half, 0.0)
    before, after = (a * a - b * b) / (4.0 * half), (c * c - d * d) / (4.0 * half)
    return before, 1.0 - before - after, after


@inlined
def _wide(images: Images, row: int, foot: Footprint, indices: Int64s, weights: Float64s) -> int:
    """List the texels of bilinear patches under a footprint of one to two texels, as ``_small`` does."""
    x, y = foot.u * images.levels[row, 1] - 0.5, foot.v * images.levels[row, 2] - 0.5
    width, height = math.sqrt(12.0 * foot.xx), math.sqrt(12.0 * foot.yy)
    left, top = math.ceil(x - 0.5 * width - 1.0), math.ceil(y - 0.5 * height - 1.0)
    across, down = _quarters(x, width, left), _quarters(y, height, top)
    count = window(images, row, foot, left, top, across, down, indices, weights, 0)
    a = 4 * min(max(math.floor(y) - top, 0), 2) + min(max(math.floor(x) - left, 0), 2)
    _skew(weights, a, a + 4, foot.xy)
    return count


@inlined
def _quarters(middle: float, width: float, first: int) -> tuple[float, float, float, float]:
    """Return the weights of four texels from a first one on, in a box of a width up to 2."""
    low, high = middle - 0.5 * width - first, middle + 0.5 * width - first
    return (
        (_tent(high) - _tent(low)) / width,
        (_tent(high - 1) - _tent(low - 1)) / width,
        (_tent(high - 2) - _tent(low - 2)) / width,
        (_tent(high - 3) - _tent(low - 3)) / width,
    )


@inlined
def _skew(weights: Float64s, upper: int, lower: int, shift: float) -> None:
    """Shift weight between the corners of a patch, from its first texels in both rows; none goes below 0."""
    if shift > 0.0:
        shift = min(shift, weights[upper + 1], weights[lower])
    else:
        shift = -min(-shift, weights[upper], weights[lower + 1])
    weights[upper] += shift
    weights[upper + 1] -= shift
    weights[lower] -= shift
    weights[lower + 1] += shift


@inlined
def _tent(distance: float) -> float:
    """Return the integral of a tent of width 2 and height 1 up to a distance from its middle."""
    inside = min(max(distance, -1.0), 1.0)
    return 0.5 + inside - 0.5 * inside * abs(inside)


@inlined
def _ellipse(
    images: Images, layout: int, foot: Footprint, indices: Int64s, weights: Float64s
) -> tuple[int, int, float]:
    """List the texels in an ellipse, each weighted by 1 − its squared distance from the middle."""
    base, coarsest = images.layouts[layout, 0], images.layouts[layout, 1] - 1
    texel = 1.0 / 6.0 if foot.flat else 0.25  # the texels' variance, plus a twelfth for a mean over one texel
    level = 0
    narrow, long = foot.least + texel, foot.most + texel
    floor = LEAST + 1.0 / 12.0
    while level < coarsest and (narrow >= 4.0 * floor or max(narrow, floor) * long > LARGEST):
        narrow *= 0.25
        long *= 0.25
        level += 1
    row = base + level
    first, wide, high = images.levels[row, 0], images.levels[row, 1], images.levels[row, 2]
    scale_x = scale_y = 1.0
    if level > 0:
        scale_x, scale_y = wide / images.levels[base, 1], high / images.levels[base, 2]
    short = max(floor - narrow, 0.0) - 1.0 / 12.0
    xx = max((foot.xx + texel) * scale_x * scale_x + short, LEAST)
    yy = max((foot.yy + texel) * scale_y * scale_y + short, LEAST)
    xy = foot.xy * scale_x * scale_y
    if level == coarsest:
        reach = max(xx, yy) * RADIUS / (FARTHEST * FARTHEST)
        if reach > 1.0:
            xx, xy, yy = xx / reach, xy / reach, yy / reach
    # The distance's square is (dx − slope dy)² / across + dy² / down.
    down = yy * RADIUS
    inverse = 1.0 / yy
    slope = xy * inverse
    across = max((xx - xy * slope) * RADIUS, 1e-3)
    per_row, per_column = inverse / RADIUS, 1.0 / across
    reach, extent = math.sqrt(down), math.sqrt(across)
    x, y = foot.u * wide - 0.5, foot.v * high - 0.5
    tries = int(2.0 * extent) + 1
    total = 0.0
    count = 0
    # Every row tries as many texels as the middle row: branches that depend on a row's width cost more.
    for j in range(math.ceil(y - reach), math.floor(y + reach) + 1):
        dy = j - y
        start = first + wrapped(j, high, foot.wrap_v) * (wide + 2)
        middle = x + slope * dy
        i0 = math.ceil(middle - extent)
        rest, dx = 1.0 - dy * dy * per_row, i0 - middle
        if count + tries > MOST_TAPS:
            break
        is_inside = i0 >= 0 and i0 + tries <= wide
        for i in range(i0, i0 + tries):
            weight = rest - dx * dx * per_column
            dx += 1.0
            column = i if is_inside else wrapped(i, wide, foot.wrap_u)
            indices[count], weights[count] = start + column, weight
            total += max(weight, 0.0)
            count += weight > 0.0
    if not total > 0.0:
        return bilinear(images, row, foot, 1.0, indices, weights, 0), NEVER, 1.0
    return count, EACH if level == 0 else NEVER, 1.0 / total


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
def _mixed_levels(
    images: Images, layout: int, foot: Footprint, indices: Int64s, weights: Float64s
) -> tuple[int, int]:
    """List the texels of the two levels whose mixture has the footprint's larger variance."""
    level, part = _level_of(foot.most, foot.flat, images.layouts[layout, 1])
    row, is_finest = images.layouts[layout, 0] + level, level == 0 and part == 0.0
    if is_finest and foot.flat:
        return flat_texels(images, row, foot, foot.most, foot.most, indices, weights), SUM
    count = bilinear(images, row, foot, 1.0 - part, indices, weights, 0)
    if part > 0.0:
        count = bilinear(images, row + 1, foot, part, indices, weights, count)
    return count, SUM if is_finest else EACH if level == 0 else NEVER


@inlined
def _bicubic(images: Images, row: int, foot: Footprint, indices: Int64s, weights: Float64s) -> int:
    """List the sixteen texels around a point, weighted by Catmull and Rom's spline."""
    x, y = foot.u * images.levels[row, 1] - 0.5, foot.v * images.levels[row, 2] - 0.5
    left, top = math.floor(x), math.floor(y)
    across, down = catmull_rom(np.float32(x - left)), catmull_rom(np.float32(y - top))
    return window(images, row, foot, left - 1, top - 1, across, down, indices, weights, 0)
