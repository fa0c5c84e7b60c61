"""Images as filters read them: whole, or as mip pyramids.

Every level has the exact means of decoded texels over its texels' areas; colours under an alpha are averaged
with it as weight and stored unmultiplied. Around each level lies a rim, one texel wide: the border texels,
averaged along the border only, which a clamped image repeats.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Bools, Float32s, Int64s, Uint8s, Uint64s
from octex.channels import decode_table, encode
from octex.checks import as_choice
from octex.errors import ArgumentError
from octex.jit import kernel
from octex.parallel import cpu_count, pool_of

#: 16-bit codes, or floats as they are.
Texels = npt.NDArray[np.uint16 | np.float32]

REPEAT, MIRROR, CLAMP = 0, 1, 2
WRAPS = ("repeat", "mirror", "clamp")


def as_wraps(wrap: str | tuple[str, str]) -> tuple[int, int]:
    """Return the wraps of u and v, of one name or one for each; raises ArgumentError for anything else."""
    names = (wrap, wrap) if isinstance(wrap, str) else wrap
    if not isinstance(names, (tuple, list)) or len(names) != 2:
        raise ArgumentError(f"wrap must be one name, or one for u and one for v, not {wrap!r}")
    return WRAPS.index(as_choice(names[0], WRAPS, "wrap")), WRAPS.index(as_choice(names[1], WRAPS, "wrap"))


#: How an image is stored: 16-bit codes of sRGB or of fractions, or floats.
SRGB, DATA, FLOAT = range(3)

#: Weight of a texel of alpha 0: its colour counts only where all have alpha 0.
FAINT = 2.0**-40

_BAND = 128  # rows of the second level that are made at once


class ImageTexels(NamedTuple):
    """An image as one material reads it."""

    texels: Texels  # (height, width, 4)
    is_light: bool  # its codes are sRGB, or else fractions
    covered: bool = False  # whether its alpha weighs its colours
    threshold: float = -1.0  # averages count alpha as 1 from this on, else as 0; negative: no threshold


class Images(NamedTuple):
    """All images of a model with their levels, for kernels; images of one size share a layout.

    A level's rows are ``width + 2`` texels apart; ``first`` is the index of texel (0, 0) in the image.
    """

    kinds: Uint8s  # (images,)   SRGB, DATA or FLOAT
    covered: Bools  # (images,)
    bases: Int64s  # (images,)   first word in codes, or row in floats
    layouts: Int64s  # (layouts, 2)   first level, number of levels
    levels: Int64s  # (levels, 3)   first, width, height
    codes: Uint64s  # (words,)   four codes each, red in the lowest bits
    floats: Float32s  # (rows, 4)
    linear: Float32s  # (65536,)   linear light of an sRGB code


def store(sources: Sequence[ImageTexels], has_mips: bool) -> tuple[Images, list[int]]:
    """Store images, with all levels if ``has_mips``; return the layout of each too."""
    sizes = list(dict.fromkeys(image.texels.shape[:2] for image in sources))
    layouts: list[tuple[int, int]] = []
    levels: list[tuple[int, int, int]] = []
    row_counts: list[int] = []  # of an image, by layout
    for height, width in sizes:
        shapes = _shapes(width, height, has_mips)
        layouts.append((len(levels), len(shapes)))
        first = 0
        for wide, high in shapes:
            levels.append((first + wide + 3, wide, high))
            first += (wide + 2) * (high + 2)
        row_counts.append(first)
    layout_of = [sizes.index(image.texels.shape[:2]) for image in sources]
    bases, kinds, ends = [], [], {SRGB: 0, FLOAT: 0}
    for image, layout in zip(sources, layout_of, strict=True):
        array = FLOAT if image.texels.dtype == np.float32 else SRGB
        kinds.append(DATA if array == SRGB and not image.is_light else array)
        bases.append(ends[array])
        ends[array] += row_counts[layout]
    images = Images(
        np.array(kinds, np.uint8),
        np.array([image.covered for image in sources], np.bool_),
        np.array(bases, np.int64),
        np.array(layouts, np.int64).reshape(-1, 2),
        np.array(levels, np.int64).reshape(-1, 3),
        np.empty(ends[SRGB], np.uint64),
        np.empty((ends[FLOAT], 4), np.float32),
        decode_table("uint16", "srgb"),
    )

    def fill(number: int) -> None:
        rows = slice(bases[number], bases[number] + row_counts[layout_of[number]])
        is_float = kinds[number] == FLOAT
        texels = images.floats[rows] if is_float else images.codes[rows].view(np.uint16).reshape(-1, 4)
        _fill(sources[number], has_mips, texels)

    with pool_of(cpu_count()) as pool:
        list(pool.map(fill, range(len(sources))))
    return images, layout_of


def _shapes(width: int, height: int, has_mips: bool) -> list[tuple[int, int]]:
    """Return (width, height) of each level, the finest first."""
    count = max(width, height).bit_length() if has_mips else 1
    return [(max(width >> level, 1), max(height >> level, 1)) for level in range(count)]


def _fill(image: ImageTexels, has_mips: bool, rows: Texels) -> None:
    """Write all levels of an image, each with its rim."""
    height, width = image.texels.shape[:2]
    shapes = _shapes(width, height, has_mips)
    finest = _level_rows(rows, 0, width, height)
    finest[1:-1, 1:-1] = image.texels
    finest[0, 1:-1], finest[-1, 1:-1] = image.texels[0], image.texels[-1]
    finest[:, 0], finest[:, -1] = finest[:, 1], finest[:, -2]
    if len(shapes) == 1:
        return
    values = None
    texels = image.texels
    borders = (texels[:, :1], texels[:, -1:], texels[:1], texels[-1:], texels[[0, -1]][:, [0, -1]])
    rims = [_decoded(image._replace(texels=border)) for border in borders]
    first = finest.shape[0] * finest.shape[1]
    for wide, high in shapes[1:]:
        values = _shrunk(image, high, wide) if values is None else resized(values, high, wide)
        sizes = (high, 1), (high, 1), (1, wide), (1, wide), (2, 2)
        rims = [resized(part, *size) for part, size in zip(rims, sizes, strict=True)]
        target = _level_rows(rows, first, wide, high)
        first += target.shape[0] * target.shape[1]
        corners = target[:: high + 1, :: wide + 1]
        sides = target[1:-1, :1], target[1:-1, -1:], target[:1, 1:-1], target[-1:, 1:-1], corners
        for part, means in zip((target[1:-1, 1:-1], *sides), (values, *rims), strict=True):
            part[...] = _encoded(means, image, target.dtype == np.float32)


def _shrunk(image: ImageTexels, height: int, width: int) -> Float32s:
    """Return an image's values at a smaller size; if rows align, bands of them are decoded in turn."""
    values = np.empty((height, width, 4), np.float32)
    rows, remainder = divmod(image.texels.shape[0], height)
    band = height if remainder else _BAND
    for first in range(0, height, band):
        end = None if remainder else (first + band) * rows
        part = image._replace(texels=image.texels[first * rows : end])
        shrink(_decoded(part), values[first : first + band])
    return values


def _level_rows(rows: Texels, first: int, width: int, height: int) -> Texels:
    """Return the rows of one level with its rim, as (height + 2, width + 2, 4)."""
    count = (height + 2) * (width + 2)
    return rows[first : first + count].reshape(height + 2, width + 2, 4)


def _decoded(image: ImageTexels) -> Float32s:
    """Return an image's values (height, width, 4) for averages, premultiplied by alpha if it is covered."""
    values = np.empty(image.texels.shape, np.float32)
    if image.texels.dtype == np.float32:
        values[:] = image.texels
    else:
        decode_texels(image.texels, decode_table("uint16", "srgb" if image.is_light else "data"), values)
    if image.covered:
        if image.threshold >= 0.0:
            values[..., 3] = values[..., 3] >= image.threshold
        values[..., :3] *= values[..., 3:] + np.float32(FAINT)
    return values


@kernel
def decode_texels(texels: Texels, table: Float32s, values: Float32s) -> None:
    """Decode codes by a table, and alpha to a fraction."""
    for y in range(texels.shape[0]):
        for x in range(texels.shape[1]):
            for lane in range(3):
                values[y, x, lane] = table[texels[y, x, lane]]
            values[y, x, 3] = np.float32(texels[y, x, 3]) / np.float32(65535.0)


def _encoded(values: Float32s, image: ImageTexels, as_floats: bool) -> Array:
    if image.covered:
        values = values.copy()
        values[..., :3] /= values[..., 3:] + np.float32(FAINT)
    if as_floats:
        return values
    if not image.is_light:
        return encode(values, "uint16", "data")
    codes = np.empty(values.shape, np.uint16)
    codes[..., :3] = encode(values[..., :3], "uint16", "srgb")
    codes[..., 3] = encode(values[..., 3], "uint16", "data")
    return codes


def resized(values: Float32s, height: int, width: int) -> Float32s:
    """Return exact means (height, width, 4) over each texel's area, for a size that is no larger."""
    smaller = np.empty((height, width, 4), np.float32)
    shrink(values, smaller)
    return smaller


@kernel
def shrink(values: Float32s, smaller: Float32s) -> None:
    """Write exact means over the area of each texel of ``smaller``, which is no larger."""
    height, width = smaller.shape[0], smaller.shape[1]
    step_x, step_y = values.shape[1] / width, values.shape[0] / height
    scale = 1.0 / (step_x * step_y)
    for y in range(height):
        top, bottom = y * step_y, (y + 1) * step_y
        y0, y1 = int(top), min(int(np.ceil(bottom - 1e-9)), values.shape[0])
        for x in range(width):
            left, right = x * step_x, (x + 1) * step_x
            x0, x1 = int(left), min(int(np.ceil(right - 1e-9)), values.shape[1])
            red = green = blue = alpha = 0.0
            for j in range(y0, y1):
                part_y = min(bottom, j + 1.0) - max(top, float(j))
                for i in range(x0, x1):
                    part = part_y * (min(right, i + 1.0) - max(left, float(i))) * scale
                    red += part * values[j, i, 0]
                    green += part * values[j, i, 1]
                    blue += part * values[j, i, 2]
                    alpha += part * values[j, i, 3]
            smaller[y, x, 0] = red
            smaller[y, x, 1] = green
            smaller[y, x, 2] = blue
            smaller[y, x, 3] = alpha
