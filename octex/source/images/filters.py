"""Image filters: a footprint in, weighted texels out.

Every filter lists *taps*, places of stored texels, and their weights; images of one size under one footprint
share the list. Nearest, bilinear and bicubic read at points. The others add the footprint to what the image
is, bilinear patches or flat texels, and match that sum's variance: w²/12 for a width of w texels, and 1/6 for
bilinear texels, 1/12 for flat ones. A texel of level l is a mean of 2ˡ texels, of variance (4ˡ − 1) / 12.
"""

from __future__ import annotations

import math

import numpy as np

from octex.arrays import Float64s, Int64s
from octex.jit import inlined
from octex.source.images.pyramid import AREAS, CLAMP, MIPS, REPEAT, RIPS, WHOLE, Images
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
    wrapped,
)

#: The image filters, by name; the default last. Mip levels: Williams 1983; sums of areas: Crow 1984;
#: ellipses: Greene & Heckbert 1986.
FILTERS = ("nearest", "bilinear", "bicubic", "trilinear", "ripmap", "sat", "ewa")
NEAREST, BILINEAR, BICUBIC, TRILINEAR, RIPMAP, SAT, EWA = range(7)
#: The levels that each reads.
LEVELS_OF = (WHOLE, WHOLE, WHOLE, MIPS, RIPS, AREAS, MIPS)

#: Footprints must have at most this variance, in texels², so that their ends fit integers.
MOST_VARIANCE = 1e24
# What is more than so many times as long as wide is read wider.
_LONGEST = 16.0
#: Footprints of up to two texels are read as boxes if their covariance, in texels², is at most this.
SKEW = 0.1
#: The level is read at which the kernel's least variance, in texels², is at least this and less than four
#: times this (and a twelfth).
LEAST = 0.2
#: A coarser level is read if the product of a kernel's variances is above this: 6 π times its root are taps.
LARGEST = 7.0
#: A kernel 1 − q over the ellipse q < 1 has a variance of a sixth of its radius squared.
RADIUS = 6.0
#: At the coarsest level of an image a footprint reaches no farther than this many texels.
FARTHEST = 24.0


def told(filter: int) -> int | None:
    """Return how kernels are told a filter: the default by None, for which the others are not compiled."""
    return None if filter == EWA else filter


@inlined
def find_taps(
    images: Images, layout: int, filter: int | None, foot: Footprint, places: Int64s, weights: Float64s
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
                return flat_texels(images, row, foot, xx, yy, places, weights), SUM, 1.0
            # Thresholding does not commute with averaging, but for tiny footprints.
            cut = SUM if 12.0 * max(xx, yy) < 0.25 else EACH
            return _small(images, row, foot, places, weights), cut, 1.0
        if not foot.flat and 12.0 * max(xx, yy) <= 4.0 and abs(xy) <= SKEW:
            return _wide(images, row, foot, places, weights), EACH, 1.0
        return _ellipse(images, layout, foot, places, weights)
    cut = SUM
    if filter == TRILINEAR:
        count, cut = _trilinear(images, layout, foot, places, weights)
    elif filter == RIPMAP:
        count, cut = _ripmap(images, layout, foot, places, weights)
    elif filter == SAT:
        count, cut = _areas(images, row, foot, places, weights), NEVER
    elif filter == BICUBIC:
        count = _bicubic(images, row, foot, places, weights)
    elif filter == NEAREST or foot.flat:
        count = flat_texels(images, row, foot, 0.0, 0.0, places, weights)
    else:
        count = bilinear(images, row, foot, 1.0, places, weights, 0)
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
def _small(images: Images, row: int, foot: Footprint, places: Int64s, weights: Float64s) -> int:
    """List the texels of bilinear patches under a footprint of at most a texel.

    The mean over its box is exact; a skew adds the patch's mixed slope times the covariance.
    """
    xx, xy, yy = foot.xx, foot.xy, foot.yy
    if 12.0 * max(xx, yy) < 1e-4:
        return bilinear(images, row, foot, 1.0, places, weights, 0)

    first, width, height = images.levels[row, 0], images.levels[row, 1], images.levels[row, 2]
    x, y = foot.u * width - 0.5, foot.v * height - 0.5
    near_x, near_y = math.floor(x + 0.5), math.floor(y + 0.5)
    part_x, part_y = x - near_x, y - near_y
    left, right = _sides(part_x, math.sqrt(12.0 * xx))
    up, down = _sides(part_y, math.sqrt(12.0 * yy))
    x1, y1 = int(near_x), int(near_y)
    x0, x2, y0, y2 = x1 - 1, x1 + 1, y1 - 1, y1 + 1
    u_mode, v_mode = foot.wrap_u, foot.wrap_v
    if x0 < 0 or x2 >= width:
        x0, x1, x2 = wrapped(x0, width, u_mode), wrapped(x1, width, u_mode), wrapped(x2, width, u_mode)
    if y0 < 0 or y2 >= height:
        y0, y1, y2 = wrapped(y0, height, v_mode), wrapped(y1, height, v_mode), wrapped(y2, height, v_mode)
    middle_x, middle_y = 1.0 - left - right, 1.0 - up - down
    row0, row1, row2 = first + y0 * (width + 2), first + y1 * (width + 2), first + y2 * (width + 2)
    places[0], weights[0] = row0 + x0, up * left
    places[1], weights[1] = row0 + x1, up * middle_x
    places[2], weights[2] = row0 + x2, up * right
    places[3], weights[3] = row1 + x0, middle_y * left
    places[4], weights[4] = row1 + x1, middle_y * middle_x
    places[5], weights[5] = row1 + x2, middle_y * right
    places[6], weights[6] = row2 + x0, down * left
    places[7], weights[7] = row2 + x1, down * middle_x
    places[8], weights[8] = row2 + x2, down * right
    a = (0 if part_y < 0.0 else 3) + (0 if part_x < 0.0 else 1)  # the patch's first texel
    _skew(weights, a, a + 3, xy)
    return 9


@inlined
def _sides(part: float, width: float) -> tuple[float, float]:
    """Return the weights of the texels before and after the nearest, in a box of a width up to 1."""
    half = 0.5 * max(width, 1e-3)
    a, b = max(half - part, 0.0), max(-half - part, 0.0)
    c, d = max(half + part, 0.0), max(part - half, 0.0)
    return (a * a - b * b) / (4.0 * half), (c * c - d * d) / (4.0 * half)


@inlined
def _wide(images: Images, row: int, foot: Footprint, places: Int64s, weights: Float64s) -> int:
    """List the texels of bilinear patches under a footprint of one to two texels, as ``_small`` does."""
    first, width, height = images.levels[row, 0], images.levels[row, 1], images.levels[row, 2]
    x, y = foot.u * width - 0.5, foot.v * height - 0.5
    across, down = math.sqrt(12.0 * foot.xx), math.sqrt(12.0 * foot.yy)
    i0, j0 = math.ceil(x - 0.5 * across - 1.0), math.ceil(y - 0.5 * down - 1.0)
    is_inside = i0 >= 0 and i0 + 4 <= width
    # The share of texel i is a difference of the tent's integral.
    for j in range(4):
        weight = (_tent(y + 0.5 * down - j0 - j) - _tent(y - 0.5 * down - j0 - j)) / down
        start = first + wrapped(j0 + j, height, foot.wrap_v) * (width + 2)
        for i in range(4):
            place = i0 + i if is_inside else wrapped(i0 + i, width, foot.wrap_u)
            places[4 * j + i] = start + place
            share = (_tent(x + 0.5 * across - i0 - i) - _tent(x - 0.5 * across - i0 - i)) / across
            weights[4 * j + i] = weight * share
    a = 4 * min(max(math.floor(y) - j0, 0), 2) + min(max(math.floor(x) - i0, 0), 2)
    _skew(weights, a, a + 4, foot.xy)
    return 16


@inlined
def _skew(weights: Float64s, upper: int, lower: int, shift: float) -> None:
    """Shift weight between the corners of a patch, two of which each row begins with; none goes below 0."""
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
    images: Images, layout: int, foot: Footprint, places: Int64s, weights: Float64s
) -> tuple[int, int, float]:
    """List the texels in an ellipse, each with 1 − its squared distance from the middle."""
    base, coarsest = images.layouts[layout, 0], images.layouts[layout, 1] - 1
    texel = 1.0 / 6.0 if foot.flat else 0.25  # of the texels, with the twelfth that a mean over one has
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
    # Every row tries as many texels, as if the ellipse were as wide as in its middle: branches that depend
    # on each row's width cost more.
    for j in range(math.ceil(y - reach), math.floor(y + reach) + 1):
        dy = j - y
        start = first + wrapped(j, high, foot.wrap_v) * (wide + 2)
        middle = x + slope * dy
        i0 = math.ceil(middle - extent)
        rest, dx = 1.0 - dy * dy * per_row, i0 - middle
        if count + tries > MOST_TAPS:
            break
        if i0 >= 0 and i0 + tries <= wide:
            for i in range(i0, i0 + tries):
                weight = rest - dx * dx * per_column
                dx += 1.0
                places[count], weights[count] = start + i, weight
                total += max(weight, 0.0)
                count += weight > 0.0
        else:
            for i in range(i0, i0 + tries):
                weight = rest - dx * dx * per_column
                dx += 1.0
                places[count], weights[count] = start + wrapped(i, wide, foot.wrap_u), weight
                total += max(weight, 0.0)
                count += weight > 0.0
    if not total > 0.0:
        return bilinear(images, row, foot, 1.0, places, weights, 0), NEVER, 1.0
    return count, EACH if level == 0 else NEVER, 1.0 / total


@inlined
def _trilinear(
    images: Images, layout: int, foot: Footprint, places: Int64s, weights: Float64s
) -> tuple[int, int]:
    """List the texels of the two levels whose mixture has the variance of the footprint's long axis."""
    base, most = images.layouts[layout, 0], foot.most
    level, part = _level_of(most, foot.flat, images.layouts[layout, 1])
    if level == 0 and part == 0.0 and foot.flat:
        return flat_texels(images, base, foot, most, most, places, weights), SUM
    count = bilinear(images, base + level, foot, 1.0 - part, places, weights, 0)
    if part > 0.0:
        count = bilinear(images, base + level + 1, foot, part, places, weights, count)
    return count, NEVER if level > 0 else SUM if part == 0.0 else EACH


@inlined
def _level_of(variance: float, flat: bool, levels: int) -> tuple[int, float]:
    """Return the finer of two levels, and the share of the coarser, that together have a variance."""
    spread = 4.0 * variance + (2.0 / 3.0 if flat else 1.0)  # 4ˡ at a level read bilinearly
    level = 0
    while spread >= 4.0 and level < levels - 1:
        spread *= 0.25
        level += 1
    if spread > 1.0 and level < levels - 1:
        return level, (spread - 1.0) / 3.0
    return level, 0.0


@inlined
def _ripmap(
    images: Images, layout: int, foot: Footprint, places: Int64s, weights: Float64s
) -> tuple[int, int]:
    """List the texels of up to four levels, chosen in u and in v like a pyramid's."""
    base, across = images.layouts[layout, 0], images.layouts[layout, 1]
    level_x, part_x = _level_of(foot.xx, foot.flat, across)
    level_y, part_y = _level_of(foot.yy, foot.flat, images.layouts[layout, 2])
    whole = level_x == 0 and level_y == 0
    if whole and part_x == 0.0 and part_y == 0.0:
        if foot.flat:
            return flat_texels(images, base, foot, foot.xx, foot.yy, places, weights), SUM
        return bilinear(images, base, foot, 1.0, places, weights, 0), SUM
    count = 0
    for step_y in range(2 if part_y > 0.0 else 1):
        for step_x in range(2 if part_x > 0.0 else 1):
            weight = (part_x if step_x else 1.0 - part_x) * (part_y if step_y else 1.0 - part_y)
            row = base + (level_y + step_y) * across + level_x + step_x
            count = bilinear(images, row, foot, weight, places, weights, count)
    return count, EACH if whole else NEVER


@inlined
def _bicubic(images: Images, row: int, foot: Footprint, places: Int64s, weights: Float64s) -> int:
    """List the sixteen texels around a point, weighted by Catmull and Rom's spline."""
    first, width, height = images.levels[row, 0], images.levels[row, 1], images.levels[row, 2]
    x, y = foot.u * width - 0.5, foot.v * height - 0.5
    left, top = math.floor(x), math.floor(y)
    across, down = catmull_rom(np.float32(x - left)), catmull_rom(np.float32(y - top))
    for j in range(4):
        start = first + wrapped(int(top) - 1 + j, height, foot.wrap_v) * (width + 2)
        for i in range(4):
            places[4 * j + i] = start + wrapped(int(left) - 1 + i, width, foot.wrap_u)
            weights[4 * j + i] = across[i] * down[j]
    return 16


@inlined
def _areas(images: Images, row: int, foot: Footprint, places: Int64s, weights: Float64s) -> int:
    """List the entries of a summed-area table that give the mean over a box; weights add up to 0."""
    width, height = images.levels[row, 1], images.levels[row, 2]
    texel = 1e-6 if foot.flat else 1.0
    across, down = math.sqrt(12.0 * foot.xx + texel), math.sqrt(12.0 * foot.yy + texel)
    at = MOST_TAPS
    n_x = _span(foot.u * width, across, width, foot.wrap_u, at, places, weights)
    n_y = _span(foot.v * height, down, height, foot.wrap_v, at + 8, places, weights)
    count = 0
    for j in range(at + 8, at + 8 + n_y):
        for i in range(at, at + n_x):
            places[count] = places[j] * (width + 1) + places[i]
            weights[count] = weights[j] * weights[i]
            count += 1
    return count


@inlined
def _span(
    middle: float, width: float, size: int, mode: int, at: int, places: Int64s, weights: Float64s
) -> int:
    """List, from ``at`` on, the sums that give the mean over a span, however far beyond the image."""
    count = 0
    for end in range(2):
        sign = (1.0 if end else -1.0) / width
        x = middle + (0.5 if end else -0.5) * width
        whole = 0.0  # how often the whole image's sum counts
        if mode == CLAMP:
            # Beyond the border the last texel goes on.
            if x < 0.0:
                places[at + count], weights[at + count] = 1, sign * x
                count += 1
                x = 0.0
            elif x > size:
                places[at + count], weights[at + count] = size - 1, sign * (size - x)
                count += 1
                whole = 1.0 + (x - size)
                x = 0.0
        else:
            period = size if mode == REPEAT else 2 * size
            turns = math.floor(x / period)
            x -= turns * period
            whole = turns if mode == REPEAT else 2.0 * turns
            if x > size:
                whole += 2.0
                x = 2.0 * size - x
                sign = -sign
                whole = -whole
        if whole != 0.0:
            places[at + count], weights[at + count] = size, sign * whole
            count += 1
        left = min(max(math.floor(x), 0), size - 1)
        places[at + count], weights[at + count] = int(left) + 1, sign * (x - left)
        places[at + count + 1], weights[at + count + 1] = int(left), sign * (1.0 - (x - left))
        count += 2
    return count
