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

import numpy as np
import numpy.typing as npt

from octex.jit import inlined
from octex.source.pyramid import AREAS, CLAMP, MIPS, MIRROR, REPEAT, RIPS, WHOLE, Images

#: The image filters, by name; the default last.
FILTERS = ("nearest", "bilinear", "bicubic", "trilinear", "ripmap", "sat", "ewa")
NEAREST, BILINEAR, BICUBIC, TRILINEAR, RIPMAP, SAT, EWA = range(7)
#: The levels that each reads.
LEVELS_OF = (WHOLE, WHOLE, WHOLE, MIPS, RIPS, AREAS, MIPS)

#: How a threshold acts on alpha: not at all, on each texel of the finest level, on their sum.
NEVER, EACH, SUM = 0, 1, 2

#: The most taps that a footprint can have; beside them lie the spans of summed-area tables.
MOST_TAPS = 4096
TAP_ROOM = MOST_TAPS + 16

_SKEW = 0.1
# EWA reads the level at which its kernel's least variance, in texels², is at least this and less than four
# times this (and a twelfth).
_LEAST = 0.25
# A kernel 1 − q over the ellipse q < 1 has a variance of a sixth of its radius squared.
_RADIUS = 6.0
# Ellipses are at most this many times as long as wide; what is longer is read wider.
_LONGEST = 16.0
# A coarser level is read if the product of a kernel's variances is above this: 6 π times its root are taps.
_LARGEST = 6.0
# At the coarsest level of an image a footprint reaches no farther than this many texels.
_FARTHEST = 24.0


@inlined
def find_taps(
    images: Images,
    layout: int,
    name: int,
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
    places: npt.NDArray[np.int64],
    weights: npt.NDArray[np.float64],
) -> tuple[int, int, float]:
    """List the taps of a footprint at (u, v); return how many, how to cut alpha, and what to scale sums by.

    ``name`` is an index into FILTERS, ``flat`` images have flat texels. (xx, xy, yy) is the footprint's
    covariance in texels², ``least`` and ``most`` its variance along the short and the long axis. ``places``
    and ``weights`` have TAP_ROOM elements. The second result is NEVER, EACH or SUM.
    """
    row = images.layouts[layout, 0]
    u = _unwrap(u, wrap_u, xx, images.levels[row, 1])
    v = _unwrap(v, wrap_v, yy, images.levels[row, 2])
    if name == EWA:
        if 12.0 * max(xx, yy) <= 1.0:
            if flat:
                return _flat(images, row, wrap_u, wrap_v, u, v, xx, yy, places, weights), SUM, 1.0
            return _small(images, row, wrap_u, wrap_v, u, v, xx, xy, yy, places, weights), SUM, 1.0
        if not flat and 12.0 * max(xx, yy) <= 4.0 and abs(xy) <= _SKEW:
            return _wide(images, row, wrap_u, wrap_v, u, v, xx, xy, yy, places, weights), SUM, 1.0
        return _ellipse(images, layout, wrap_u, wrap_v, flat, u, v, xx, xy, yy, least, most, places, weights)
    cut = SUM
    if name == TRILINEAR:
        count, cut = _levels(images, layout, wrap_u, wrap_v, flat, u, v, most, places, weights)
    elif name == RIPMAP:
        count, cut = _rips(images, layout, wrap_u, wrap_v, flat, u, v, xx, yy, places, weights)
    elif name == SAT:
        count, cut = _areas(images, row, wrap_u, wrap_v, flat, u, v, xx, yy, places, weights), NEVER
    elif name == BICUBIC:
        count = _bicubic(images, row, wrap_u, wrap_v, u, v, places, weights)
    elif name == NEAREST or flat:
        count = _flat(images, row, wrap_u, wrap_v, u, v, 0.0, 0.0, places, weights)
    else:
        count = _bilinear(images, row, wrap_u, wrap_v, u, v, 1.0, 0, places, weights)
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
def _unwrap(coordinate: float, mode: int, variance: float, size: int) -> float:
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
def _wrap(index: int, size: int, mode: int) -> int:
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
def _bilinear(
    images: Images,
    row: int,
    wrap_u: int,
    wrap_v: int,
    u: float,
    v: float,
    weight: float,
    count: int,
    places: npt.NDArray[np.int64],
    weights: npt.NDArray[np.float64],
) -> int:
    """Add the four texels of a level around a point, with a weight in all."""
    first, width, height = images.levels[row, 0], images.levels[row, 1], images.levels[row, 2]
    x, y = u * width - 0.5, v * height - 0.5
    left, top = math.floor(x), math.floor(y)
    right, down = x - left, y - top
    x0, y0 = int(left), int(top)
    x1, y1 = x0 + 1, y0 + 1
    if x0 < 0 or x1 >= width:
        x0, x1 = _wrap(x0, width, wrap_u), _wrap(x1, width, wrap_u)
    if y0 < 0 or y1 >= height:
        y0, y1 = _wrap(y0, height, wrap_v), _wrap(y1, height, wrap_v)
    upper, lower = first + y0 * (width + 2), first + y1 * (width + 2)
    places[count], weights[count] = upper + x0, weight * (1.0 - right) * (1.0 - down)
    places[count + 1], weights[count + 1] = upper + x1, weight * right * (1.0 - down)
    places[count + 2], weights[count + 2] = lower + x0, weight * (1.0 - right) * down
    places[count + 3], weights[count + 3] = lower + x1, weight * right * down
    return count + 4


@inlined
def _small(
    images: Images,
    row: int,
    wrap_u: int,
    wrap_v: int,
    u: float,
    v: float,
    xx: float,
    xy: float,
    yy: float,
    places: npt.NDArray[np.int64],
    weights: npt.NDArray[np.float64],
) -> int:
    """List the texels of bilinear patches under a footprint of at most a texel.

    The mean over a box of the footprint's width and height is exact; that it is turned or skewed is what the
    patch's mixed slope times the covariance adds.
    """
    if 12.0 * max(xx, yy) < 1e-4:
        return _bilinear(images, row, wrap_u, wrap_v, u, v, 1.0, 0, places, weights)
    first, width, height = images.levels[row, 0], images.levels[row, 1], images.levels[row, 2]
    x, y = u * width - 0.5, v * height - 0.5
    near_x, near_y = math.floor(x + 0.5), math.floor(y + 0.5)
    part_x, part_y = x - near_x, y - near_y
    left, right = _sides(part_x, math.sqrt(12.0 * xx))
    up, down = _sides(part_y, math.sqrt(12.0 * yy))
    x1, y1 = int(near_x), int(near_y)
    x0, x2, y0, y2 = x1 - 1, x1 + 1, y1 - 1, y1 + 1
    if x0 < 0 or x2 >= width:
        x0, x1, x2 = _wrap(x0, width, wrap_u), _wrap(x1, width, wrap_u), _wrap(x2, width, wrap_u)
    if y0 < 0 or y2 >= height:
        y0, y1, y2 = _wrap(y0, height, wrap_v), _wrap(y1, height, wrap_v), _wrap(y2, height, wrap_v)
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
    shift = xy
    if shift > 0.0:
        shift = min(shift, weights[a + 1], weights[a + 3])
    else:
        shift = -min(-shift, weights[a], weights[a + 4])
    weights[a] += shift
    weights[a + 1] -= shift
    weights[a + 3] -= shift
    weights[a + 4] += shift
    return 9


@inlined
def _sides(part: float, width: float) -> tuple[float, float]:
    """Return the weights of the texels before and after the nearest, in a box of a width up to 1."""
    half = 0.5 * max(width, 1e-3)
    a, b = max(half - part, 0.0), max(-half - part, 0.0)
    c, d = max(half + part, 0.0), max(part - half, 0.0)
    return (a * a - b * b) / (4.0 * half), (c * c - d * d) / (4.0 * half)


@inlined
def _wide(
    images: Images,
    row: int,
    wrap_u: int,
    wrap_v: int,
    u: float,
    v: float,
    xx: float,
    xy: float,
    yy: float,
    places: npt.NDArray[np.int64],
    weights: npt.NDArray[np.float64],
) -> int:
    """List the texels of bilinear patches under a footprint of one to two texels, as ``_small`` does."""
    first, width, height = images.levels[row, 0], images.levels[row, 1], images.levels[row, 2]
    x, y = u * width - 0.5, v * height - 0.5
    across, down = math.sqrt(12.0 * xx), math.sqrt(12.0 * yy)
    i0, j0 = math.ceil(x - 0.5 * across - 1.0), math.ceil(y - 0.5 * down - 1.0)
    is_inside = i0 >= 0 and i0 + 4 <= width
    # The share of texel i is a difference of the tent's integral.
    for j in range(4):
        weight = (_tent(y + 0.5 * down - j0 - j) - _tent(y - 0.5 * down - j0 - j)) / down
        start = first + _wrap(j0 + j, height, wrap_v) * (width + 2)
        for i in range(4):
            place = i0 + i if is_inside else _wrap(i0 + i, width, wrap_u)
            places[4 * j + i] = start + place
            share = (_tent(x + 0.5 * across - i0 - i) - _tent(x - 0.5 * across - i0 - i)) / across
            weights[4 * j + i] = weight * share
    a = 4 * min(max(math.floor(y) - j0, 0), 2) + min(max(math.floor(x) - i0, 0), 2)
    shift = xy
    if shift > 0.0:
        shift = min(shift, weights[a + 1], weights[a + 4])
    else:
        shift = -min(-shift, weights[a], weights[a + 5])
    weights[a] += shift
    weights[a + 1] -= shift
    weights[a + 4] -= shift
    weights[a + 5] += shift
    return 16


@inlined
def _tent(distance: float) -> float:
    """Return the integral of a tent of width 2 and height 1 up to a distance from its middle."""
    inside = min(max(distance, -1.0), 1.0)
    return 0.5 + inside - 0.5 * inside * abs(inside)


@inlined
def _flat(
    images: Images,
    row: int,
    wrap_u: int,
    wrap_v: int,
    u: float,
    v: float,
    xx: float,
    yy: float,
    places: npt.NDArray[np.int64],
    weights: npt.NDArray[np.float64],
) -> int:
    """List the flat texels under a footprint of at most a texel: they meet in ramps of its own width."""
    first, width, height = images.levels[row, 0], images.levels[row, 1], images.levels[row, 2]
    x, y = u * width - 0.5, v * height - 0.5
    left, top = math.floor(x), math.floor(y)
    right, down = _ramp(x - left, math.sqrt(12.0 * xx)), _ramp(y - top, math.sqrt(12.0 * yy))
    x0, x1 = _wrap(int(left), width, wrap_u), _wrap(int(left) + 1, width, wrap_u)
    y0, y1 = _wrap(int(top), height, wrap_v), _wrap(int(top) + 1, height, wrap_v)
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


@inlined
def _ellipse(
    images: Images,
    layout: int,
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
    places: npt.NDArray[np.int64],
    weights: npt.NDArray[np.float64],
) -> tuple[int, int, float]:
    """List the texels in an ellipse, each with 1 − its squared distance from the middle."""
    base, coarsest = images.layouts[layout, 0], images.layouts[layout, 1] - 1
    own = 1.0 / 6.0 if flat else 0.25  # of the texels, with the twelfth that a mean over one has
    level = 0
    narrow, long = least + own, most + own
    floor = _LEAST + 1.0 / 12.0
    while level < coarsest and (narrow >= 4.0 * floor or max(narrow, floor) * long > _LARGEST):
        narrow *= 0.25
        long *= 0.25
        level += 1
    row = base + level
    first, wide, high = images.levels[row, 0], images.levels[row, 1], images.levels[row, 2]
    scale_x = scale_y = 1.0
    if level > 0:
        scale_x, scale_y = wide / images.levels[base, 1], high / images.levels[base, 2]
    short = max(floor - narrow, 0.0) - 1.0 / 12.0
    xx = max((xx + own) * scale_x * scale_x + short, _LEAST)
    yy = max((yy + own) * scale_y * scale_y + short, _LEAST)
    xy *= scale_x * scale_y
    if level == coarsest:
        reach = max(xx, yy) * _RADIUS / (_FARTHEST * _FARTHEST)
        if reach > 1.0:
            xx, xy, yy = xx / reach, xy / reach, yy / reach
    # The distance's square is (dx − slope dy)² / across + dy² / down.
    down = yy * _RADIUS
    inverse = 1.0 / yy
    slope = xy * inverse
    across = max((xx - xy * slope) * _RADIUS, 1e-3)
    per_row, per_column = inverse / _RADIUS, 1.0 / across
    reach, extent = math.sqrt(down), math.sqrt(across)
    x, y = u * wide - 0.5, v * high - 0.5
    tries = int(2.0 * extent) + 1
    total = 0.0
    count = 0
    # Every row tries as many texels, as if the ellipse were as wide as in its middle: branches that depend
    # on each row's width cost more.
    for j in range(math.ceil(y - reach), math.floor(y + reach) + 1):
        dy = j - y
        start = first + _wrap(j, high, wrap_v) * (wide + 2)
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
                places[count], weights[count] = start + _wrap(i, wide, wrap_u), weight
                total += max(weight, 0.0)
                count += weight > 0.0
    if not total > 0.0:
        return _bilinear(images, row, wrap_u, wrap_v, u, v, 1.0, 0, places, weights), NEVER, 1.0
    return count, EACH if level == 0 else NEVER, 1.0 / total


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
    places: npt.NDArray[np.int64],
    weights: npt.NDArray[np.float64],
) -> tuple[int, int]:
    """List the texels of the two levels whose mixture has the variance of the footprint's long axis."""
    base = images.layouts[layout, 0]
    level, part = _level_of(longest, flat, images.layouts[layout, 1])
    if level == 0 and part == 0.0 and flat:
        return _flat(images, base, wrap_u, wrap_v, u, v, longest, longest, places, weights), SUM
    count = _bilinear(images, base + level, wrap_u, wrap_v, u, v, 1.0 - part, 0, places, weights)
    if part > 0.0:
        count = _bilinear(images, base + level + 1, wrap_u, wrap_v, u, v, part, count, places, weights)
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
    places: npt.NDArray[np.int64],
    weights: npt.NDArray[np.float64],
) -> tuple[int, int]:
    """List the texels of up to four levels, chosen in u and in v like a pyramid's."""
    base, across = images.layouts[layout, 0], images.layouts[layout, 1]
    level_x, part_x = _level_of(xx, flat, across)
    level_y, part_y = _level_of(yy, flat, images.layouts[layout, 2])
    whole = level_x == 0 and level_y == 0
    if whole and part_x == 0.0 and part_y == 0.0:
        if flat:
            return _flat(images, base, wrap_u, wrap_v, u, v, xx, yy, places, weights), SUM
        return _bilinear(images, base, wrap_u, wrap_v, u, v, 1.0, 0, places, weights), SUM
    count = 0
    for step_y in range(2 if part_y > 0.0 else 1):
        for step_x in range(2 if part_x > 0.0 else 1):
            weight = (part_x if step_x else 1.0 - part_x) * (part_y if step_y else 1.0 - part_y)
            row = base + (level_y + step_y) * across + level_x + step_x
            count = _bilinear(images, row, wrap_u, wrap_v, u, v, weight, count, places, weights)
    return count, EACH if whole else NEVER


@inlined
def _bicubic(
    images: Images,
    row: int,
    wrap_u: int,
    wrap_v: int,
    u: float,
    v: float,
    places: npt.NDArray[np.int64],
    weights: npt.NDArray[np.float64],
) -> int:
    """List the sixteen texels around a point, weighted by Catmull and Rom's spline."""
    first, width, height = images.levels[row, 0], images.levels[row, 1], images.levels[row, 2]
    x, y = u * width - 0.5, v * height - 0.5
    left, top = math.floor(x), math.floor(y)
    for j in range(4):
        weight_y = _catmull_rom(abs(y - top + 1.0 - j))
        start = first + _wrap(int(top) - 1 + j, height, wrap_v) * (width + 2)
        for i in range(4):
            weight_x = _catmull_rom(abs(x - left + 1.0 - i))
            places[4 * j + i] = start + _wrap(int(left) - 1 + i, width, wrap_u)
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
    places: npt.NDArray[np.int64],
    weights: npt.NDArray[np.float64],
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
    places: npt.NDArray[np.int64],
    weights: npt.NDArray[np.float64],
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
