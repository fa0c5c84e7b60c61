"""Images to paint with, decoded to mips."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt
import PIL.Image

from octex.arrays import Array, Bools, Float32s, Float64s, Int64s
from octex.cameras.camera import Camera
from octex.cameras.lens import is_bent
from octex.channels import ChannelFormat, decode_table, linear_to_srgb, screen_color
from octex.checks import as_choice, as_items, as_memory, as_number, as_path, as_reals, is_path
from octex.conversion.large import NOT_STORED, Stages, digest_of, scratch
from octex.errors import ArgumentError, ImageError
from octex.files import open_file
from octex.jit import inlined, kernel
from octex.painting.sharpened import sharpen
from octex.painting.unwrap import Patch
from octex.parallel import Run, folder_of, usual_memory
from octex.source.images.decode import as_texels, orientation_of, read_image_file, turned
from octex.source.images.pyramid import decode_texels, shrink
from octex.source.images.taps import catmull_rom

Image = str | os.PathLike[str] | PIL.Image.Image | npt.ArrayLike

#: How paint p of coverage a blends with the texture b, in linear light:
#: ``over`` (1−a)·b + a·p, ``multiply`` and ``screen`` likewise with b·p and 1 − (1−b)(1−p) for p, ``add``
#: b + a·p; ``erase`` removes a of the texture's alpha; ``replace`` is p, whatever its coverage.
Blend = Literal["over", "multiply", "screen", "add", "erase", "replace"]
BLENDS: tuple[Blend, ...] = get_args(Blend)

#: Least alpha that counts as 1: the spline's weights sum to 1 but for rounding.
_OPAQUE = np.float32(1.0 - 1e-6)
#: Largest difference of a component from the key's colour, in 1/255.
_KEY_DIFFERENCE = 24
#: Bytes of a pixel in memory: its mips, their masked copy, and the visible surface.
_PIXEL_MEMORY = 64
#: Largest value of a texel.
_LARGEST = 65535.0


@dataclass(frozen=True, eq=False)
class Projection:
    """An image and the camera through which it is projected onto a surface.

    image     a file, a Pillow image, or an array as for ``Surface.from_arrays``: sRGB integers or linear
              floats. Its alpha is the opacity of the paint. Files follow their EXIF orientation, unless only
              the unrotated image fits the camera
    camera    the camera that took the image or drew the view; or a Patch. It has the image's size
    mask      an image of the same size: white where paint goes, black where not. If it has transparency, its
              alpha is used
    opacity   0 … 1, multiplies the alpha
    blend     how paint combines with the texture: one of BLENDS
    since     the unedited image, of the same size: only pixels that differ from it are painted
    key       the colour of a backdrop, "#rrggbb" or 8-bit (red, green, blue): pixels within 24/255 of it are
              not painted
    """

    image: Image
    camera: Camera | Patch
    mask: Image | None = None
    opacity: float = 1.0
    blend: Blend = "over"
    since: Image | None = None
    key: Sequence[int] | str | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.camera, (Camera, Patch)):
            raise ArgumentError(
                f"camera must be an octex.Camera or a Patch, not {type(self.camera).__name__}"
            )
        object.__setattr__(self, "opacity", as_number(self.opacity, "opacity", 0.0, 1.0))
        as_choice(self.blend, BLENDS, "blend")
        if isinstance(self.key, str):
            object.__setattr__(self, "key", screen_color(self.key))
            if self.key is None:
                raise ArgumentError("key must be a colour '#rrggbb' or (red, green, blue)")
        elif self.key is not None:
            as_reals(self.key, "key", (3,), most=255.0)

    @property
    def name(self) -> str:
        """The image's name in messages."""
        return _name_of(self.image, "the image")


def room_for(projections: Sequence[Projection], run: Run) -> AbstractContextManager[object]:
    """Store images in files until the end of the block, if they exceed the memory of a run."""
    pixels = sum(each.camera.width * each.camera.height for each in projections)
    memory = usual_memory() if run.memory is None else as_memory(run.memory)
    if memory is None or memory >= _PIXEL_MEMORY * pixels:
        return nullcontext()
    return scratch(folder_of(run, Path(tempfile.gettempdir())))


class Mips(NamedTuple):
    """An image and smaller ones, each half as wide and high; colours are multiplied by alpha."""

    pixels: Float32s  # (pixels of all mips, 4)
    sizes: Int64s  # (mips, 3)   first row, width, height
    range: Float32s  # (2, 3)   the least and the largest value of each component where alpha is not 0


class Window(NamedTuple):
    """A part of an image, in pixels."""

    left: int
    top: int
    right: int
    bottom: int

    def of(self, array: Array) -> Array:
        """Return that part of an array (height, width, …)."""
        return array[self.top : self.bottom, self.left : self.right]


def mips_of(
    projection: Projection, form: ChannelFormat, scale: float = 1.0, stages: Stages = NOT_STORED
) -> Mips:
    """Decode all of a projection; see `window_of`."""
    return window_of(projection, form, scale, None, stages)[0]


def window_of(
    projection: Projection,
    form: ChannelFormat,
    scale: float = 1.0,
    around: int | None = None,
    stages: Stages = NOT_STORED,
) -> tuple[Mips, Window]:
    """Decode a projection's image and mask for a channel; alpha is multiplied by ``scale``.

    ``around`` limits it to so many pixels around paint, and the window is that part of the image.
    """
    camera = projection.camera
    if isinstance(camera, Patch) or is_bent(camera.lens):
        around = None  # its window in the undistorted view is no rectangle
    size = camera.width, camera.height
    stage = stages.of(lambda: [size, form, scale, around, content_of(projection)])
    arrays = stage.arrays("image", lambda: _window_of(projection, form, scale, around))
    return Mips(arrays["pixels"], arrays["sizes"], arrays["range"]), Window(*arrays["window"].tolist())


def _window_of(
    projection: Projection, form: ChannelFormat, scale: float, around: int | None
) -> dict[str, Array]:
    size, image = (projection.camera.width, projection.camera.height), projection.image
    window, before = Window(0, 0, *size), None
    if (
        around is not None
        and projection.since is None
        and isinstance(image, np.ndarray)
        and image.dtype == np.uint8
        and image.shape == (*size[::-1], 4)
    ):
        window = _window_around(image[:, :, 3] > 0, around)
        texels = as_texels(window.of(image))  # only this part is decoded
    else:
        texels = texels_of(image, "the image", size)
        if projection.since is not None:
            before = texels_of(projection.since, "the image as it was", size)
        if around is not None:
            has_paint = texels[:, :, 3] > 0
            if before is not None and before.dtype == texels.dtype:
                has_paint &= (texels != before).any(axis=2)
            window = _window_around(has_paint, around)
        texels = window.of(texels)
    sizes = _sizes(*texels.shape[1::-1])
    ends = sizes[:, 0] + sizes[:, 1] * sizes[:, 2]
    rows = np.empty((int(ends[-1]), 4), np.float32)
    mips = [
        rows[first:end].reshape(down, across, 4)
        for (first, across, down), end in zip(sizes, ends, strict=True)
    ]
    pixels = _decoded(texels, form, mips[0])
    factor: np.float32 | Float32s = np.float32(scale)
    if before is not None:
        factor = factor * (pixels != _decoded(window.of(before), form)).any(axis=2)
    if projection.mask is not None:
        mask = texels_of(projection.mask, "the mask", size)
        shown = _as_fractions(mask[:, :, 3])
        if (shown == 1.0).all():
            shown = _as_fractions(mask[:, :, :3].mean(axis=2, dtype=np.float32).astype(mask.dtype))
        factor = window.of(shown) * factor
    if projection.key is not None:
        if texels.dtype == np.uint16:
            colors = texels[:, :, :3].astype(np.float32) / 257.0
        else:
            colors = (255.0 * linear_to_srgb(np.clip(texels[:, :, :3], 0, 1))).astype(np.float32)
        key = np.asarray(projection.key, np.float32)
        factor = factor * ~(np.abs(colors - key) <= _KEY_DIFFERENCE).all(axis=2)
        del colors
    del texels  # as large as the mips
    pixels[:, :, 3] *= np.clip(factor, 0.0, 1.0)
    limits = _multiply(pixels)
    for above, level in pairwise(mips):
        shrink(above, level)
    if (limits[0] != limits[1]).any():
        sharpen(pixels, form.space in ("srgb", "linear"))
    return {"pixels": rows, "sizes": sizes, "range": limits, "window": np.array(window, np.int64)}


def _window_around(has_paint: Bools, around: int) -> Window:
    """Return the part within ``around`` pixels of paint, in multiples of it, which mips divide evenly."""
    ends = []
    for axis in (1, 0):  # of columns, and of rows
        size = has_paint.shape[axis]
        painted = np.flatnonzero(has_paint.any(axis=1 - axis))
        if not painted.size:
            return Window(0, 0, *has_paint.shape[::-1])
        first, last = int(painted[0]) // around - 1, int(painted[-1]) // around + 2
        ends.append((max(first * around, 0), min(last * around, size)))
    (left, right), (top, bottom) = ends
    return Window(left, top, right, bottom)


def _sizes(width: int, height: int) -> Int64s:
    """Return the first row, width and height of an image's mips; see Mips."""
    sizes = [(0, width, height)]
    while min(sizes[-1][1:]) > 1:
        first, across, down = sizes[-1]
        sizes.append((first + across * down, across // 2, down // 2))
    return np.array(sizes, np.int64)


@kernel
def _multiply(pixels: Float32s) -> Float32s:
    """Multiply colours by alpha; return their range before, where alpha is not 0, or zeros for none."""
    ends = np.zeros((2, 3), np.float32)
    is_first = True
    for row in range(pixels.shape[0]):
        for column in range(pixels.shape[1]):
            alpha = pixels[row, column, 3]
            for part in range(3):
                value = pixels[row, column, part]
                pixels[row, column, part] = value * alpha
                if alpha > 0:
                    ends[0, part] = value if is_first else min(value, ends[0, part])
                    ends[1, part] = value if is_first else max(value, ends[1, part])
            is_first = is_first and not alpha > 0
    return ends


def _name_of(image: Image, otherwise: str) -> str:
    return str(as_path(image, "image")) if is_path(image) else otherwise


def texels_of(image: Image, otherwise: str, size: tuple[int, int]) -> npt.NDArray[np.uint16 | np.float32]:
    """Return the texels of an image of a size (width, height); a file is turned upright if that fits."""
    if is_path(image):
        texels, data = read_image_file(as_path(image, "image"))
        upright = turned(texels, orientation_of(data))
        texels = upright if upright.shape[1::-1] == size else texels
    else:
        try:
            texels = as_texels(image)  # type: ignore[arg-type]
        except ImageError as error:
            raise ImageError(f"{otherwise}: {error}") from None
    rows, columns = texels.shape[:2]
    if (columns, rows) != size:
        raise ArgumentError(
            f"{_name_of(image, otherwise)} has {columns}×{rows} pixels, its camera {size[0]}×{size[1]}; "
            "scale the image, or give the camera that it was taken with"
        )
    return texels


def _as_fractions(alpha: npt.NDArray[np.uint16 | np.float32]) -> Float32s:
    scale = np.float32(1.0 / _LARGEST if alpha.dtype == np.uint16 else 1.0)
    fractions: Float32s = np.clip(alpha.astype(np.float32) * scale, 0.0, 1.0)
    return fractions


def _decoded(
    texels: npt.NDArray[np.uint16 | np.float32], form: ChannelFormat, out: Float32s | None = None
) -> Float32s:
    """Return colours decoded for a channel, and alpha (height, width, 4)."""
    pixels = np.empty((*texels.shape[:2], 4), np.float32) if out is None else out
    if texels.dtype == np.uint16:
        table = decode_table("uint16", "srgb" if form.space in ("srgb", "linear") else form.space)
        decode_texels(np.ascontiguousarray(texels, np.uint16), table, pixels)
    else:
        pixels[:, :, :3] = texels[:, :, :3]
        pixels[:, :, 3] = _as_fractions(texels[:, :, 3])
    return pixels


def content_of(projection: Projection) -> bytes:
    """Return a digest of a projection's images and key."""
    images = projection.image, projection.mask, projection.since
    return digest_of([_content(each) for each in images], projection.key)


def _content(image: Image | None) -> Any:
    if image is None or not is_path(image):
        return None if image is None else as_texels(image)  # type: ignore[arg-type]
    try:
        with open_file(as_path(image, "image")) as file:
            return hashlib.file_digest(file, "sha256").digest()
    except OSError:
        return None  # decoding raises the error


def check_projections(projections: Projection | Sequence[Projection]) -> list[Projection]:
    """Return projections as a list, or raise ArgumentError if it is empty or has other items."""
    return as_items(projections, Projection, "projection to paint")


@inlined
def falloff_at(falloff: Float64s, width: int, height: int, x: float, y: float) -> float:
    """Return exp(a·r² + b·r⁴) at a place in an image, with r = 1 in its corners."""
    if falloff[0] == 0.0 and falloff[1] == 0.0:
        return 1.0
    x, y = x - 0.5 * width, y - 0.5 * height
    square = 4.0 * (x * x + y * y) / (width * width + height * height)
    return float(np.exp(square * (falloff[0] + square * falloff[1])))


@inlined
def read_paint(
    mips: Mips, x: float, y: float, width: float
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return paint, times alpha, and alpha in a footprint of ``width`` pixels around pixel coordinates.

    By Catmull and Rom's spline (bilinear filtering loses 5 dB): one sample if the footprint is a pixel or
    less; else four in the next finer mip, whose variance is the footprint's.
    """
    if not width > 1.0:
        return _bicubic(mips, 0, x, y)
    level = min(int(np.log2(width)), mips.sizes.shape[0] - 1)
    scale_x = mips.sizes[level, 1] / mips.sizes[0, 1]
    scale_y = mips.sizes[level, 2] / mips.sizes[0, 2]
    x, y = x * scale_x, y * scale_y
    offset = np.sqrt(max((width * scale_x) ** 2 - 1.0, 0.0) / 12.0)
    if not offset > 0.0:
        return _bicubic(mips, level, x, y)
    a = b = c = d = np.float32(0.0)
    for corner in range(4):
        u = x + (offset if corner & 1 else -offset)
        v = y + (offset if corner & 2 else -offset)
        e, f, g, h = _bicubic(mips, level, u, v)
        a, b, c, d = a + e, b + f, c + g, d + h
    quarter = np.float32(0.25)
    return a * quarter, b * quarter, c * quarter, d * quarter


@inlined
def _bicubic(
    mips: Mips, level: int, x: float, y: float
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    start, width, height = mips.sizes[level, 0], mips.sizes[level, 1], mips.sizes[level, 2]
    u, v = x - 0.5, y - 0.5
    i, j = int(np.floor(u)), int(np.floor(v))
    of_x, of_y = catmull_rom(np.float32(u - i)), catmull_rom(np.float32(v - j))
    none = np.float32(0.0)
    a = b = c = d = none
    columns = (
        min(max(i - 1, 0), width - 1),
        min(max(i, 0), width - 1),
        min(max(i + 1, 0), width - 1),
        min(max(i + 2, 0), width - 1),
    )
    for row in range(4):
        first = start + min(max(j + row - 1, 0), height - 1) * width
        for column in range(4):
            at = np.uint64(first + columns[column])  # unsigned indices need no test for negative ones
            weight = of_y[row] * of_x[column]
            a += weight * mips.pixels[at, 0]
            b += weight * mips.pixels[at, 1]
            c += weight * mips.pixels[at, 2]
            d += weight * mips.pixels[at, 3]
    return clipped(mips, a, b, c, d)


@inlined
def clipped(
    mips: Mips, a: np.float32, b: np.float32, c: np.float32, d: np.float32
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Clip paint, times alpha, and alpha to the image's range, which splines leave."""
    none = np.float32(0.0)
    if not d > none:
        return none, none, none, none
    if d > _OPAQUE:  # if alpha overshoots, colours do so by the same factor
        a, b, c, d = a / d, b / d, c / d, np.float32(1.0)
    least, most = mips.range[0], mips.range[1]
    return (
        min(max(a, d * least[0]), d * most[0]),
        min(max(b, d * least[1]), d * most[1]),
        min(max(c, d * least[2]), d * most[2]),
        d,
    )
