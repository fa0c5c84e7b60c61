"""Images as filters read them: whole, as mip pyramids, as ripmaps, or as summed-area tables.

Texel centres lie at (i + 0.5) / n, u runs right and v down the rows. Every level is made from the image's
decoded texels: linear light, fractions or directions; colours that an alpha covers are averaged with it as
weight and stored unmultiplied, so that the colour of a texel that covers nothing leaks nowhere. A level of a
pyramid holds half the texels of the one below it, rounded down, in each direction, a ripmap also those with
one direction halved more than the other; each texel is the exact mean over its area, for any size.

Around each level lies a rim, one texel wide, of what lies beyond the border of a clamped image: the border
texels themselves, averaged along the border only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import decode_table, encode
from octex.jit import kernel

REPEAT, MIRROR, CLAMP = 0, 1, 2
WRAPS = ("repeat", "mirror", "clamp")

#: How an image is stored: 16-bit codes of sRGB or of fractions, floats, or sums of floats.
SRGB, DATA, FLOAT, SUMS = 0, 1, 2, 3
#: Which levels of an image are stored.
WHOLE, MIPS, RIPS, AREAS = 0, 1, 2, 3

#: Weight of a texel that covers nothing: its colour counts only where no other does.
FAINT = 2.0**-40


class Picture(NamedTuple):
    """An image as one material reads it."""

    texels: npt.NDArray[np.uint16] | npt.NDArray[np.float32]  # (height, width, 4)
    is_light: bool  # its codes are sRGB; else fractions
    covered: bool = False  # its alpha weighs its colours; else all lanes are alike
    threshold: float = -1.0  # averages take alpha as 1 where it reaches this and else 0; negative: as it is


class Images(NamedTuple):
    """All images of a model with their levels, as kernels see them.

    Images of one size share a layout. A level's rows are ``width + 2`` texels apart, its rim included, and
    ``first`` is the place of texel (0, 0) after an image's own first.
    """

    kinds: npt.NDArray[np.uint8]  # (images,)   SRGB, DATA, FLOAT or SUMS
    covered: npt.NDArray[np.bool_]  # (images,)
    bases: npt.NDArray[np.int64]  # (images,)   first word in codes, or row in floats or sums
    layouts: npt.NDArray[np.int64]  # (layouts, 3)   first level, levels in x, levels in y
    levels: npt.NDArray[np.int64]  # (levels, 3)   first, width, height
    codes: npt.NDArray[np.uint64]  # (words,)   four codes each, red in the lowest bits
    floats: npt.NDArray[np.float32]  # (rows, 4)
    sums: npt.NDArray[np.float64]  # (rows, 4)   premultiplied by alpha if covered
    linear: npt.NDArray[np.float32]  # (65536,)   linear light of an sRGB code


class Stored(NamedTuple):
    """Images, and the layout of each."""

    images: Images
    layout_of: list[int]


def store(pictures: Sequence[Picture], what: int) -> Stored:
    """Store images with all the levels that ``what`` (WHOLE, MIPS, RIPS or AREAS) asks for."""
    sizes = list(dict.fromkeys(picture.texels.shape[:2] for picture in pictures))
    layouts, levels = [], []
    for height, width in sizes:
        shapes, across, down = _shapes(width, height, what)
        layouts.append((len(levels), across, down))
        first = 0
        for wide, high in shapes:
            rim = 0 if what == AREAS else 1
            stride = wide + 1 + rim
            levels.append((first + rim * stride + rim, wide, high))
            first += stride * (high + 1 + rim)
    layout_of = [sizes.index(picture.texels.shape[:2]) for picture in pictures]
    parts: dict[int, list[npt.NDArray[np.generic]]] = {SRGB: [], FLOAT: [], SUMS: []}
    kinds, bases = [], []
    for picture in pictures:
        is_float = picture.texels.dtype == np.float32
        kind = SUMS if what == AREAS else FLOAT if is_float else SRGB if picture.is_light else DATA
        kinds.append(kind)
        held = parts[SRGB if kind == DATA else kind]
        bases.append(sum(len(part) for part in held))
        held.append(_stored(picture, kind, what))
    images = Images(
        np.array(kinds, np.uint8),
        np.array([picture.covered for picture in pictures], np.bool_),
        np.array(bases, np.int64),
        np.array(layouts, np.int64).reshape(-1, 3),
        np.array(levels, np.int64).reshape(-1, 3),
        _joined(parts[SRGB], np.empty(0, np.uint64)),
        _joined(parts[FLOAT], np.empty((0, 4), np.float32)),
        _joined(parts[SUMS], np.empty((0, 4), np.float64)),
        decode_table("uint16", "srgb"),
    )
    return Stored(images, layout_of)


def _shapes(width: int, height: int, what: int) -> tuple[list[tuple[int, int]], int, int]:
    """Return (width, height) of each level in order, and how many there are across and down."""
    wides, highs = _halved(width), _halved(height)
    if what == RIPS:
        return [(wide, high) for high in highs for wide in wides], len(wides), len(highs)
    count = max(len(wides), len(highs)) if what == MIPS else 1
    wides += [1] * (count - len(wides))
    highs += [1] * (count - len(highs))
    return list(zip(wides, highs, strict=False))[:count], count, count


def _halved(size: int) -> list[int]:
    sizes = [size]
    while sizes[-1] > 1:
        sizes.append(sizes[-1] // 2)
    return sizes


def _stored(picture: Picture, kind: int, what: int) -> npt.NDArray[np.generic]:
    """Return all levels of an image with their rims, end to end, as words or rows."""
    height, width = picture.texels.shape[:2]
    shapes, across, _ = _shapes(width, height, what)
    values = _decoded(picture, picture.threshold if what == AREAS else -1.0)
    if kind == SUMS:
        sums = np.zeros((height + 1, width + 1, 4))
        sums[1:, 1:] = values.cumsum(axis=0, dtype=np.float64).cumsum(axis=1)
        return sums.reshape(-1, 4)
    first = _rimmed(picture.texels)
    parts = [np.ascontiguousarray(first).view("<u8").reshape(-1) if kind != FLOAT else first.reshape(-1, 4)]
    if len(shapes) == 1:
        return parts[0]
    if picture.covered and picture.threshold >= 0.0:
        values = _decoded(picture, picture.threshold)
    rims = _Rims.of(values)
    done = {0: (values, rims)}
    for level in range(1, len(shapes)):
        # From the level of half the reduction: one step down, or for ripmaps one across.
        below = level - 1 if what == MIPS or level % across else level - across
        wide, high = shapes[level]
        values, rims = done[below]
        values, rims = _resized(values, high, wide), rims.resized(high, wide)
        parts.append(_encoded(rims.around(values), picture, kind))
        done[level] = values, rims
        if what == MIPS:
            del done[below]
    return np.concatenate(parts)


def _decoded(picture: Picture, threshold: float) -> npt.NDArray[np.float32]:
    """Return an image's values (height, width, 4), premultiplied by alpha if it is covered."""
    if picture.texels.dtype == np.float32:
        values = picture.texels.copy()
    else:
        table = decode_table("uint16", "srgb" if picture.is_light else "data")
        values = np.empty(picture.texels.shape, np.float32)
        _decode(picture.texels, table, values)
    if picture.covered:
        if threshold >= 0.0:
            values[..., 3] = values[..., 3] >= threshold
        values[..., :3] *= values[..., 3:] + np.float32(FAINT)
    return values


@kernel
def _decode(
    texels: npt.NDArray[np.uint16], table: npt.NDArray[np.float32], values: npt.NDArray[np.float32]
) -> None:
    for y in range(texels.shape[0]):
        for x in range(texels.shape[1]):
            for lane in range(3):
                values[y, x, lane] = table[texels[y, x, lane]]
            values[y, x, 3] = np.float32(texels[y, x, 3]) / np.float32(65535.0)


def _encoded(
    values: npt.NDArray[np.float32], picture: Picture, kind: int
) -> npt.NDArray[np.uint64] | npt.NDArray[np.float32]:
    """Return a level's values as they are stored: unmultiplied, words or rows."""
    if picture.covered:
        values = values.copy()
        values[..., :3] /= values[..., 3:] + np.float32(FAINT)
    if kind == FLOAT:
        return values.reshape(-1, 4)
    codes = np.empty(values.shape, np.uint16)
    codes[..., :3] = encode(values[..., :3], "uint16", "srgb" if kind == SRGB else "data")
    codes[..., 3] = encode(values[..., 3], "uint16", "data")
    return codes.reshape(-1, 4).view("<u8")[:, 0]


class _Rims(NamedTuple):
    """What lies beyond a level's borders."""

    left: npt.NDArray[np.float32]  # (height, 1, 4)
    right: npt.NDArray[np.float32]
    top: npt.NDArray[np.float32]  # (1, width, 4)
    bottom: npt.NDArray[np.float32]
    corners: npt.NDArray[np.float32]  # (2, 2, 4)

    @classmethod
    def of(cls, values: npt.NDArray[np.float32]) -> _Rims:
        corners = np.ascontiguousarray(values[[0, -1]][:, [0, -1]])
        return cls(*(np.ascontiguousarray(part) for part in (values[:, :1], values[:, -1:])),
                   *(np.ascontiguousarray(part) for part in (values[:1], values[-1:])), corners)  # fmt: skip

    def resized(self, height: int, width: int) -> _Rims:
        return _Rims(
            _resized(self.left, height, 1),
            _resized(self.right, height, 1),
            _resized(self.top, 1, width),
            _resized(self.bottom, 1, width),
            self.corners,
        )

    def around(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        corners = self.corners
        return np.vstack(
            [
                np.hstack([corners[:1, :1], self.top, corners[:1, 1:]]),
                np.hstack([self.left, values, self.right]),
                np.hstack([corners[1:, :1], self.bottom, corners[1:, 1:]]),
            ]
        )


def _rimmed(texels: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
    return np.pad(texels, ((1, 1), (1, 1), (0, 0)), mode="edge")


def _joined(parts: list[npt.NDArray[np.generic]], empty: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
    return np.concatenate(parts) if len(parts) > 1 else parts[0] if parts else empty


def _resized(values: npt.NDArray[np.float32], height: int, width: int) -> npt.NDArray[np.float32]:
    """Return exact means (height, width, 4) over each texel's area, for a size that is no larger."""
    smaller = np.empty((height, width, 4), np.float32)
    _reduce(values, smaller)
    return smaller


@kernel
def _reduce(values: npt.NDArray[np.float32], smaller: npt.NDArray[np.float32]) -> None:
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
