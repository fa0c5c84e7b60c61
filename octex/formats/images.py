"""Encodes images of materials as files."""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Iterable, Sequence
from typing import Any, Literal

import numpy as np
import PIL.Image

from octex.arrays import Array, Float32s, Uint8s, Uint16s
from octex.channels import CHANNELS
from octex.errors import ModelError
from octex.jit import kernel
from octex.parallel import ordered_map, workers
from octex.source.images.decode import PNG_SIGNATURE
from octex.source.materials import Material

FileFormat = Literal["png", "jpeg", "webp", "exr"]
#: How a model's images are stored; "jpeg" only for colours, "jpeg-all" also for numbers and directions.
ImageFormat = Literal["png", "jpeg", "jpeg-all", "webp", "exr"]
IMAGE_FORMATS: tuple[ImageFormat, ...] = ("png", "jpeg", "jpeg-all", "webp", "exr")
#: Pillow's settings. zlib level 3 takes a third of the time of the default, for a tenth more bytes.
_SETTINGS: dict[FileFormat, dict[str, Any]] = {
    "png": {"compress_level": 3},
    "jpeg": {"quality": 95, "subsampling": 0},
    "webp": {"lossless": True, "exact": True},
    "exr": {},
}
#: zlib level of 16-bit PNG and OpenEXR files.
_LEVEL = 3
#: Numbers of UDIM tiles: 1001 to 1010 to the right, the next ten above.
_TILE = re.compile(r"[1-9]\d{3}")
#: Rows of an OpenEXR image that are compressed together.
_EXR_ROWS = 16


def encoded_images(
    materials: Sequence[Material], form: ImageFormat
) -> tuple[list[tuple[bytes, FileFormat]], dict[int, int]]:
    """Return the files of materials' images, with alpha if it is used, and their numbers by id of texels."""
    texels: dict[int, Array] = {}
    channels: dict[int, set[str]] = {}
    for material in materials:
        for name, item in material.inputs.items():
            if item.texture is not None:
                key = id(item.texture.texels)
                texels[key] = item.texture.texels
                names = channels.setdefault(key, set())
                if name != "alpha" or material.alpha_mode != "opaque":
                    names.add(name)

    def encoded(key: int) -> tuple[bytes, FileFormat]:
        lanes = slice(4 if "alpha" in channels[key] else 3)
        return image_file(texels[key], lanes, file_format(form, channels[key] - {"alpha"}))

    with workers(tasks=len(texels)) as pool:
        files = ordered_map(pool, encoded, list(texels))
        return list(files), {key: number for number, key in enumerate(texels)}


def file_format(form: ImageFormat, channels: Iterable[str]) -> FileFormat:
    """Return the file format of an image that holds these channels."""
    if form == "jpeg-all":
        return "jpeg"
    is_color = all(CHANNELS[name].space == "srgb" for name in channels)
    return "png" if form == "jpeg" and not is_color else form


def image_file(
    texels: Array, lanes: slice | tuple[int, ...], form: FileFormat = "png"
) -> tuple[bytes, FileFormat]:
    """Return an image file of lanes of texels (height, width, 4), and its format.

    A PNG has 16 bits where eight do not suffice. "jpeg" with alpha gives a PNG. Raises ModelError for floats
    in any format but "exr", and for integers in that.
    """
    if (texels.dtype == np.float32) != (form == "exr"):
        raise ModelError("only exr holds images of floats; bake with 32 bits for exr, else with fewer")
    stored = texels[..., lanes]
    if form == "exr":
        return _exr_file(stored), form
    codes: Uint8s = np.empty(stored.shape, np.uint8)
    count = stored.shape[2]
    is_deep = _bytes_of(stored, codes)
    file_form: FileFormat = "png" if form == "jpeg" and count == 4 else form
    if is_deep and file_form == "png":
        return _png16_file(stored), file_form
    image = PIL.Image.fromarray(codes[..., 0] if count == 1 else codes)
    file = io.BytesIO()
    image.save(file, file_form, **_SETTINGS[file_form])
    return file.getvalue(), file_form


@kernel
def _bytes_of(texels: Uint16s, codes: Uint8s) -> bool:
    """Write 16-bit integers as 8-bit ones; return whether any lies between two of these."""
    has_between = False
    for row in range(codes.shape[0]):
        for column in range(codes.shape[1]):
            for lane in range(codes.shape[2]):
                code16 = np.uint32(texels[row, column, lane])
                code = (code16 + np.uint32(128)) // np.uint32(257)
                has_between |= code * np.uint32(257) != code16
                codes[row, column, lane] = code
    return has_between


def _png16_file(texels: Uint16s) -> bytes:
    """Return a PNG of 16 bits of texels (height, width, 1, 3 or 4); PNG specification (W3C), 5 to 11."""
    height, width, lanes = texels.shape
    rows = np.ascontiguousarray(texels, ">u2").view(np.uint8).reshape(height, -1)
    filtered = np.empty((height, 1 + rows.shape[1]), np.uint8)
    filtered[:, 0], filtered[0, 1:] = 2, rows[0]  # filter 2: subtract the byte above
    filtered[1:, 1:] = rows[1:] - rows[:-1]
    header = struct.pack(">IIBBBBB", width, height, 16, {1: 0, 3: 2, 4: 6}[lanes], 0, 0, 0)
    chunks = (b"IHDR", header), (b"IDAT", zlib.compress(filtered.tobytes(), _LEVEL)), (b"IEND", b"")
    parts = [PNG_SIGNATURE]
    for kind, body in chunks:
        parts += [struct.pack(">I", len(body)), kind, body, struct.pack(">I", zlib.crc32(kind + body))]
    return b"".join(parts)


def _exr_file(texels: Float32s) -> bytes:
    """Return an OpenEXR image (height, width, 1, 3 or 4) of scan lines, zlib, colours times alpha."""
    height, width, lanes = texels.shape
    if lanes == 4:
        texels = np.concatenate([texels[..., :3] * texels[..., 3:], texels[..., 3:]], axis=2)
    order = {1: (0,), 3: (2, 1, 0), 4: (3, 2, 1, 0)}[lanes]  # channels sorted by name
    names = [b"Y"] if lanes == 1 else [b"RGBA"[lane : lane + 1] for lane in order]
    entry = struct.pack("<iB3xii", 2, 0, 1, 1)  # float32, in each pixel
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = [
        (b"channels", b"chlist", b"".join(name + b"\0" + entry for name in names) + b"\0"),
        (b"compression", b"compression", b"\3"),
        (b"dataWindow", b"box2i", window),
        (b"displayWindow", b"box2i", window),
        (b"lineOrder", b"lineOrder", b"\0"),
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1.0)),
        (b"screenWindowCenter", b"v2f", struct.pack("<2f", 0.0, 0.0)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1.0)),
    ]
    head = b"\x76\x2f\x31\x01" + struct.pack("<I", 2)
    for name, kind, value in attributes:
        head += name + b"\0" + kind + b"\0" + struct.pack("<I", len(value)) + value
    head += b"\0"
    blocks = []
    for first in range(0, height, _EXR_ROWS):
        lines = texels[first : first + _EXR_ROWS, :, order].transpose(0, 2, 1)
        raw = np.ascontiguousarray(lines, "<f4").view(np.uint8).reshape(-1)
        halves = np.concatenate([raw[0::2], raw[1::2]]).astype(np.int16)
        halves[1:] = halves[1:] - halves[:-1] + 128  # differences around 128
        packed = zlib.compress((halves & 255).astype(np.uint8).tobytes(), _LEVEL)
        data = packed if len(packed) < raw.size else raw.tobytes()
        blocks.append(struct.pack("<iI", first, len(data)) + data)
    places = len(head) + 8 * len(blocks) + np.cumsum([0, *map(len, blocks[:-1])])
    return b"".join([head, places.astype("<u8").tobytes(), *blocks])


def image_names(materials: Sequence[Material], stem: str, files: Sequence[tuple[bytes, str]]) -> list[str]:
    """Return the file names of the images that materials read, in the order of `encoded_images`."""
    names: dict[int, str] = {}
    for material in materials:
        for channel, item in material.inputs.items():
            if item.texture is not None:
                key, number = id(item.texture.texels), str(len(names))
                names.setdefault(key, image_name(stem, material, channel, number))
    return [f"{name}.{ending}" for name, (_, ending) in zip(names.values(), files, strict=True)]


def image_name(stem: str, material: Material, channel: str, otherwise: str) -> str:
    """Return an image's file name without ending; for a UDIM tile its channel and number."""
    name, _, tile = material.name.rpartition(".")
    if not _TILE.fullmatch(tile):
        return f"{stem}-{otherwise}"
    return "-".join([stem, *([re.sub(r"[^\w-]", "_", name)] if name else []), channel]) + f".{tile}"
