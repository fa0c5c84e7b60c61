"""Image filters: a footprint in, weighted texels out.

A footprint is a point in texture coordinates and a covariance about it: that of a box of the lookup's width
on the surface, as it looks in the image. Every filter lists *taps*, places of stored texels, and their
weights; images of one size under one footprint share the list.

    nearest     the texel that holds the point
    bilinear    the four around the point
    bicubic     sixteen, by Catmull and Rom's spline; may overshoot
    trilinear   mip levels, as coarse as the footprint is long (Williams 1983)
    ripmap      levels as coarse as the footprint is wide and high
    sat         the mean over the footprint's own box, by a summed-area table (Crow 1984)
    ewa         the texels in the footprint's ellipse, weighted (Greene & Heckbert 1986)

The first three read at points, whatever the footprint. The others add the footprint to what the image is: a
surface of bilinear patches, or of flat texels where its sampler says so. Their kernels match that sum's
variance: w²/12 for a width of w texels, and 1/6 for bilinear texels, 1/12 for flat ones. A texel of level l
is a mean over 2ˡ texels, with a variance of (4ˡ − 1) / 12 of its own.
"""

from __future__ import annotations

import math

from octex.arrays import Float64s, Int64s
from octex.jit import inlined
from octex.source.images.ellipse import SKEW, ellipse, small, wide
from octex.source.images.pyramid import AREAS, CLAMP, MIPS, REPEAT, RIPS, WHOLE, Images
from octex.source.images.taps import EACH, MOST_TAPS, NEVER, SUM, bilinear, flat_texels, unwrapped, wrapped

#: The image filters, by name; the default last.
FILTERS = ("nearest", "bilinear", "bicubic", "trilinear", "ripmap", "sat", "ewa")
NEAREST, BILINEAR, BICUBIC, TRILINEAR, RIPMAP, SAT, EWA = range(7)
#: The levels that each reads.
LEVELS_OF = (WHOLE, WHOLE, WHOLE, MIPS, RIPS, AREAS, MIPS)

#: Footprints must have at most this variance, in texels², so that their ends fit integers.
MOST_VARIANCE = 1e24
# What is more than so many times as long as wide is read wider.
_LONGEST = 16.0


def told(filter: int) -> int | None:
    """Return how kernels are told a filter: the default by None, for which the others are not compiled."""
    return None if filter == EWA else filter


@inlined
def find_taps(
    images: Images,
    layout: int,
    filter: int | None,
    wrap_u: int,
    wrap_v: int,
    flat: bool,
    u: float,
    v: float,
    xx: float,
    xy: float,
    yy: float,
    least: float,
    most: float,
    places: Int64s,
    weights: Float64s,
) -> tuple[int, int, float]:
    """List the taps of a footprint at (u, v); return how many, how to cut alpha, and what to scale sums by.

    ``filter`` is as `told`, ``flat`` images have flat texels. (xx, xy, yy) is the footprint's covariance in
    texels², ``least`` and ``most`` its variance along the short and the long axis. ``places`` and ``weights``
    have TAP_ROOM elements. The second result is NEVER, EACH or SUM.
    """
    row = images.layouts[layout, 0]
    u = unwrapped(u, wrap_u, xx, images.levels[row, 1])
    v = unwrapped(v, wrap_v, yy, images.levels[row, 2])
    if filter is None:
        if 12.0 * max(xx, yy) <= 1.0:
            if flat:
                return flat_texels(images, row, wrap_u, wrap_v, u, v, xx, yy, places, weights), SUM, 1.0
            # What a threshold leaves of a mean is no mean of what it leaves: not but for tiny footprints.
            cut = SUM if 12.0 * max(xx, yy) < 0.25 else EACH
            return small(images, row, wrap_u, wrap_v, u, v, xx, xy, yy, places, weights), cut, 1.0
        if not flat and 12.0 * max(xx, yy) <= 4.0 and abs(xy) <= SKEW:
            return wide(images, row, wrap_u, wrap_v, u, v, xx, xy, yy, places, weights), EACH, 1.0
        return ellipse(images, layout, wrap_u, wrap_v, flat, u, v, xx, xy, yy, least, most, places, weights)
    cut = SUM
    if filter == TRILINEAR:
        count, cut = _levels(images, layout, wrap_u, wrap_v, flat, u, v, most, places, weights)
    elif filter == RIPMAP:
        count, cut = _rips(images, layout, wrap_u, wrap_v, flat, u, v, xx, yy, places, weights)
    elif filter == SAT:
        count, cut = _areas(images, row, wrap_u, wrap_v, flat, u, v, xx, yy, places, weights), NEVER
    elif filter == BICUBIC:
        count = _bicubic(images, row, wrap_u, wrap_v, u, v, places, weights)
    elif filter == NEAREST or flat:
        count = flat_texels(images, row, wrap_u, wrap_v, u, v, 0.0, 0.0, places, weights)
    else:
        count = bilinear(images, row, wrap_u, wrap_v, u, v, 1.0, 0, places, weights)
    return count, cut, 1.0


@inlined
def footprint(
    uu: float, uv: float, vv: float, width: int, height: int
) -> tuple[float, float, float, float, float]:
    """Return a covariance in texels², and its least and largest variance along any axis.

    What is more than _LONGEST times as long as wide is made wider, across its long axis only.
    """
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
def _levels(
    images: Images,
    layout: int,
    wrap_u: int,
    wrap_v: int,
    flat: bool,
    u: float,
    v: float,
    longest: float,
    places: Int64s,
    weights: Float64s,
) -> tuple[int, int]:
    """List the texels of the two levels whose mixture has the variance of the footprint's long axis."""
    base = images.layouts[layout, 0]
    level, part = _level_of(longest, flat, images.layouts[layout, 1])
    if level == 0 and part == 0.0 and flat:
        return flat_texels(images, base, wrap_u, wrap_v, u, v, longest, longest, places, weights), SUM
    count = bilinear(images, base + level, wrap_u, wrap_v, u, v, 1.0 - part, 0, places, weights)
    if part > 0.0:
        count = bilinear(images, base + level + 1, wrap_u, wrap_v, u, v, part, count, places, weights)
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
def _rips(
    images: Images,
    layout: int,
    wrap_u: int,
    wrap_v: int,
    flat: bool,
    u: float,
    v: float,
    xx: float,
    yy: float,
    places: Int64s,
    weights: Float64s,
) -> tuple[int, int]:
    """List the texels of up to four levels, chosen in u and in v like a pyramid's."""
    base, across = images.layouts[layout, 0], images.layouts[layout, 1]
    level_x, part_x = _level_of(xx, flat, across)
    level_y, part_y = _level_of(yy, flat, images.layouts[layout, 2])
    whole = level_x == 0 and level_y == 0
    if whole and part_x == 0.0 and part_y == 0.0:
        if flat:
            return flat_texels(images, base, wrap_u, wrap_v, u, v, xx, yy, places, weights), SUM
        return bilinear(images, base, wrap_u, wrap_v, u, v, 1.0, 0, places, weights), SUM
    count = 0
    for step_y in range(2 if part_y > 0.0 else 1):
        for step_x in range(2 if part_x > 0.0 else 1):
            weight = (part_x if step_x else 1.0 - part_x) * (part_y if step_y else 1.0 - part_y)
            row = base + (level_y + step_y) * across + level_x + step_x
            count = bilinear(images, row, wrap_u, wrap_v, u, v, weight, count, places, weights)
    return count, EACH if whole else NEVER


@inlined
def _bicubic(
    images: Images,
    row: int,
    wrap_u: int,
    wrap_v: int,
    u: float,
    v: float,
    places: Int64s,
    weights: Float64s,
) -> int:
    """List the sixteen texels around a point, weighted by Catmull and Rom's spline."""
    first, width, height = images.levels[row, 0], images.levels[row, 1], images.levels[row, 2]
    x, y = u * width - 0.5, v * height - 0.5
    left, top = math.floor(x), math.floor(y)
    for j in range(4):
        weight_y = _catmull_rom(abs(y - top + 1.0 - j))
        start = first + wrapped(int(top) - 1 + j, height, wrap_v) * (width + 2)
        for i in range(4):
            weight_x = _catmull_rom(abs(x - left + 1.0 - i))
            places[4 * j + i] = start + wrapped(int(left) - 1 + i, width, wrap_u)
            weights[4 * j + i] = weight_x * weight_y
    return 16


@inlined
def _catmull_rom(distance: float) -> float:
    if distance < 1.0:
        return (1.5 * distance - 2.5) * distance * distance + 1.0
    return ((2.5 - 0.5 * distance) * distance - 4.0) * distance + 2.0


@inlined
def _areas(
    images: Images,
    row: int,
    wrap_u: int,
    wrap_v: int,
    flat: bool,
    u: float,
    v: float,
    xx: float,
    yy: float,
    places: Int64s,
    weights: Float64s,
) -> int:
    """List the entries of a summed-area table that give the mean over a box; weights add up to 0.

    Bilinear patches are flat texels averaged over a texel, so the box is wider for them.
    """
    width, height = images.levels[row, 1], images.levels[row, 2]
    own = 1e-6 if flat else 1.0
    across, down = math.sqrt(12.0 * xx + own), math.sqrt(12.0 * yy + own)
    at = MOST_TAPS
    n_x = _span(u * width, across, width, wrap_u, at, places, weights)
    n_y = _span(v * height, down, height, wrap_v, at + 8, places, weights)
    count = 0
    for j in range(at + 8, at + 8 + n_y):
        for i in range(at, at + n_x):
            places[count] = places[j] * (width + 1) + places[i]
            weights[count] = weights[j] * weights[i]
            count += 1
    return count


@inlined
def _span(
    middle: float,
    width: float,
    size: int,
    mode: int,
    at: int,
    places: Int64s,
    weights: Float64s,
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
