"""Image files and arrays as texels: RGBA with unassociated alpha, without loss.

Texels are uint16 codes, sRGB or data by their use, or linear float32 values. Colour profiles, gamma chunks
and orientation tags are ignored, as glTF asks (3.9.2). AVIF of 10 and 12 bits is read as 8 bits.
"""

from __future__ import annotations

import ctypes
import hashlib
import io
import logging
import struct
import threading
import warnings
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import BinaryIO

import numpy as np
import numpy.typing as npt
import PIL._imaging
import PIL.Image

from octex.arrays import Uint8s
from octex.checks import as_array, as_path, is_path
from octex.errors import ImageError, MissingExtraError
from octex.files import open_file, read_bytes
from octex.jit import kernel
from octex.parallel import cpu_count
from octex.source.images import ktx2
from octex.source.images.openimage import (
    MOST_PER_BYTE,
    check_size,
    decode_deep,
    deep_format,
    jpeg2000_header,
    spread,
)
from octex.source.images.pyramid import Texels

#: EXIF's tag of the orientation (CIPA DC-008, 4.6.5), and its first and last values.
_TAG, _UPRIGHT, _MOST = 0x0112, 1, 8
#: The formats that octex opens with Pillow, by Pillow's names. Others are rarely textures, and several are
#: traps: an icon's images may be larger than its header states, and for EPS Pillow runs a program.
FORMATS = (
    "AVIF", "BMP", "DDS", "GIF", "JPEG", "JPEG2000", "PNG", "PPM", "PSD", "QOI", "SGI", "TGA", "TIFF", "WEBP",
)  # fmt: skip
_LISTED = "PNG, JPEG, WebP, AVIF, TIFF, EXR, HDR"
# Pillow writes plain images of 8192 × 8192 in these formats with 30,000 texels a byte.
_DENSEST = ("WEBP", "AVIF", "JPEG2000")
_MOST_PER_BYTE_DENSEST = 65536
# Keeps Pillow's messages about damaged files off the screen: errors report them.
logging.getLogger("PIL").addHandler(logging.NullHandler())


PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}  # by colour type: grey, RGB, grey and alpha, RGBA
# First column and row, and steps, of the seven passes of an interlaced image (8.2).
_PASSES = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))

_lock = threading.RLock()


@contextmanager
def global_settings() -> Iterator[None]:
    """Let a block change the warning filters or another library's globals: one thread at a time."""
    with _lock, warnings.catch_warnings():
        yield


def decode_image(data: bytes, name: str) -> Texels:
    """Return the texels (height, width, 4) of an image file: uint16 codes, or float32 linear values.

    Raises ImageError, with ``name``, for a damaged file, a format that octex does not read, more texels than
    16384 × 16384 or than the file can hold, or infinite ones; MissingExtraError for a missing extra.
    """
    try:
        if data.startswith(ktx2.SIGNATURE):
            return _finite(ktx2.decode_ktx2(data, name), name)
        with global_settings():
            warnings.simplefilter("ignore")
            image = deep_format(data) or _open(io.BytesIO(data))
        # Outside of the lock, threads decode in parallel.
        if isinstance(image, str):
            return _finite(decode_deep(data, image, name), name)
        with image:
            return _texels(image, data, name)
    except (ImageError, MissingExtraError):
        raise
    except MemoryError:
        raise ImageError(f"{name}: the image does not fit into memory") from None
    except Exception as error:  # Pillow's plugins raise nearly anything for damaged files
        reason = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, PIL.UnidentifiedImageError):
            reason = f"not an image of a format that octex reads: {_LISTED} and others"
        raise ImageError(f"{name} cannot be read as an image ({reason}); save it again") from None


def as_texels(image: npt.ArrayLike | PIL.Image.Image) -> Texels:
    """Return the texels (height, width, 4) of a Pillow image or an array: uint16 codes, or linear float32.

    Arrays have shape (height, width) or (height, width, 1 to 4): uint8 or uint16 codes, or floats, which are
    linear with unassociated alpha. Raises ImageError for anything else, and for floats that are not finite.
    """
    if isinstance(image, PIL.Image.Image):
        return _texels(image, b"", "the image")
    array = as_array(image)
    if array.ndim == 2:
        array = array[:, :, None]
    if array.ndim != 3 or not 1 <= array.shape[2] <= 4 or 0 in array.shape:
        raise ImageError(f"an image must have shape (height, width, 1 to 4), not {array.shape}")
    if array.dtype not in (np.uint8, np.uint16) and array.dtype.kind != "f":
        raise ImageError(f"an image must be uint8 or uint16 (codes) or float (linear), not {array.dtype}")
    return _finite(spread(array), "the image")


def read_image(image: object) -> tuple[Texels, dict[str, str]]:
    """Return the texels of a file, a Pillow image or an array, and its name with the hash of its content."""
    if not is_path(image):
        texels = as_texels(image)  # type: ignore[arg-type]
        return texels, {"array": hashlib.sha256(texels.tobytes()).hexdigest()}
    path = as_path(image, "image")
    texels, data = read_image_file(path)
    return texels, {path.name: hashlib.sha256(data).hexdigest()}


def read_image_file(path: Path) -> tuple[Texels, bytes]:
    """Return the texels of a file, and its content; raises ImageError as ``read_image`` does."""
    try:
        data = read_bytes(path)
    except OSError as error:
        raise ImageError(f"{path} cannot be read: {error.strerror or error}") from None
    return decode_image(data, path.name), data


def _finite(texels: Texels, name: str) -> Texels:
    """Return texels, floats with alpha clipped to 0 … 1, or refuse infinite values and NaN."""
    if texels.dtype == np.float32:
        bad = texels.size - np.count_nonzero(np.isfinite(texels))
        if bad:
            raise ImageError(f"{name} has {bad} values that are infinite or not a number; repair the image")
        np.clip(texels[..., 3], 0, 1, out=texels[..., 3])
    return texels


def is_translucent(texels: Texels) -> bool:
    """Say whether any alpha of an image is below 1."""
    return bool((texels[..., 3] < (65535 if texels.dtype.kind == "u" else 1)).any())


def image_size(path: Path) -> tuple[int, int]:
    """Return the width and height of an image file; raises ImageError as ``read_image`` does."""
    try:
        with open_file(path) as file, global_settings():
            warnings.simplefilter("ignore")
            with _open(file) as image:
                return image.size
    except Exception:  # Pillow's plugins raise nearly anything, and octex reads more formats
        height, width = read_image_file(path)[0].shape[:2]
        return width, height


def _open(file: BinaryIO) -> PIL.Image.Image:
    # Pillow's limit on sizes is lower, and global, like that on AVIF's threads.
    settings: list[tuple[ModuleType, str, object]] = [(PIL.Image, "MAX_IMAGE_PIXELS", None)]
    with suppress(ImportError):  # from Pillow 11.3 on
        settings.append((import_module("PIL.AvifImagePlugin"), "DEFAULT_MAX_THREADS", cpu_count()))
    PIL.Image.init()
    formats = [name for name in FORMATS if name in PIL.Image.OPEN]  # a build of Pillow may lack formats
    with ExitStack() as stack:
        for module, name, value in settings:
            stack.callback(setattr, module, name, getattr(module, name))
            setattr(module, name, value)
        return PIL.Image.open(file, formats=formats)


@contextmanager
def _silent_libtiff() -> Iterator[None]:
    """Keep libtiff, which Pillow uses, from printing: errors report damaged images."""
    library = ctypes.CDLL(PIL._imaging.__file__)
    set_handler = getattr(library, "TIFFSetErrorHandler", None)
    if set_handler is None:  # hidden in Pillow, as on Windows
        yield
        return
    set_handler.argtypes, set_handler.restype = [ctypes.c_void_p], ctypes.c_void_p
    with global_settings():
        before = set_handler(None)
        try:
            yield
        finally:
            set_handler(before)


def _texels(image: PIL.Image.Image, data: bytes, name: str) -> Texels:
    most = _MOST_PER_BYTE_DENSEST if image.format in _DENSEST else MOST_PER_BYTE
    check_size(*image.size, len(data) or None, name, most)
    if image.format == "JPEG2000":  # the codestream's size counts
        check_size(*jpeg2000_header(data)[:2], len(data), name, most)
    if image.format == "TIFF":
        with _silent_libtiff():
            image.load()
    if data[:8] == PNG_SIGNATURE:
        chunks = png_chunks(data, name)  # Pillow overlooks wrong checksums of texels
        if data[12:16] == b"IHDR" and data[24:25] == b"\x10":
            return _decode_png16(data, chunks, name)
    if image.mode.startswith("I;16") or (image.mode == "I" and image.format == "PPM"):
        return as_texels(np.asarray(image).astype(np.uint16))
    if image.mode == "F":
        return _finite(spread(np.asarray(image)[:, :, None]), name)
    raw_modes = str([tile[3] for tile in getattr(image, "tile", [])])
    if image.mode == "I" or any(deep in raw_modes for deep in (";16L", ";16B", ";16N")):
        raise ImageError(f"{name} has a bit depth that Pillow does not read; save it as a 16-bit PNG")
    is_plain = image.mode in ("L", "LA", "RGB", "RGBA") and "transparency" not in image.info
    values = np.asarray(image if is_plain else image.convert("RGBA"))
    return spread(values[:, :, None] if values.ndim == 2 else values)


def orientation_of(data: bytes) -> int:
    """Return the EXIF orientation of an image file, 1 … 8; 1 without the tag."""
    try:
        with global_settings():
            warnings.simplefilter("ignore")
            with PIL.Image.open(io.BytesIO(data), formats=["JPEG", "PNG", "TIFF", "WEBP", "AVIF"]) as image:
                tag = image.getexif().get(_TAG, _UPRIGHT)
    except Exception:  # Pillow's plugins raise nearly anything; other files have no orientation
        return _UPRIGHT
    return tag if isinstance(tag, int) and _UPRIGHT <= tag <= _MOST else _UPRIGHT


def turned(texels: Texels, orientation: int) -> Texels:
    """Return texels (height, width, …), stored in an orientation, upright."""
    bits = orientation - _UPRIGHT
    if bits & 4:  # rows are columns
        texels = texels.swapaxes(0, 1)
    if bits & 3 in (1, 2):
        texels = texels[:, ::-1]
    if bits & 3 in (2, 3):
        texels = texels[::-1]
    return np.ascontiguousarray(texels)


def _decode_png16(data: bytes, chunks: list[tuple[bytes, bytes]], name: str) -> Texels:
    width, height, _, color_type, _, _, interlaced = struct.unpack_from(">IIBBBBB", data, 16)
    channels = _CHANNELS[color_type]
    passes = _PASSES if interlaced else ((0, 0, 1, 1),)
    sizes = [(max(-(-(width - x) // dx), 0), max(-(-(height - y) // dy), 0)) for x, y, dx, dy in passes]
    expected = sum(h * (1 + w * channels * 2) for w, h in sizes if w)
    compressed, transparent = [], None
    for kind, body in chunks:
        if kind == b"IDAT":
            compressed.append(body)
        elif kind == b"tRNS" and channels in (1, 3) and len(body) >= 2 * channels:
            transparent = np.frombuffer(body, ">u2", channels).astype(np.uint16)
    try:
        raw = zlib.decompressobj().decompress(b"".join(compressed), expected)
    except zlib.error as error:
        raise ImageError(f"{name}: the image data are damaged ({error}); save the image again") from None
    if len(raw) < expected:
        raise ImageError(f"{name}: the image data are truncated; save the image again")
    stored = np.empty((height, width, channels), np.uint16)
    rows = np.frombuffer(bytearray(raw), np.uint8)
    for (x, y, dx, dy), (w, h) in zip(passes, sizes, strict=True):
        if w == 0 or h == 0:
            continue
        stride = 1 + w * channels * 2
        part, rows = rows[: h * stride].reshape(h, stride), rows[h * stride :]
        if part[:, 0].max() > 4:
            raise ImageError(f"{name}: the image data are damaged (unknown filter); save the image again")
        _unfilter(part, channels * 2)
        stored[y::dy, x::dx] = np.ascontiguousarray(part[:, 1:]).view(">u2").reshape(h, w, channels)
    texels = spread(stored)
    if transparent is not None:
        texels[..., 3] = np.where((stored == transparent).all(axis=2), 0, 65535)
    return texels


def png_chunks(data: bytes, name: str) -> list[tuple[bytes, bytes]]:
    """Return the kinds and bodies of a PNG file's chunks up to the end of the image; refuse damaged ones."""
    chunks: list[tuple[bytes, bytes]] = []
    at = 8
    while True:
        if at + 12 > len(data):
            raise ImageError(f"{name}: the image file is truncated; save the image again")
        (length,) = struct.unpack_from(">I", data, at)
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        checksum = int.from_bytes(data[at + 8 + length : at + 12 + length], "big")
        if (
            kind[:1].isupper()
            and at + 12 + length <= len(data)
            and checksum != zlib.crc32(body, zlib.crc32(kind))
        ):
            raise ImageError(f"{name}: a checksum of the image file is wrong; save the image again")
        if kind == b"IEND":
            return chunks
        if kind == b"IDAT" and chunks and chunks[-1][0] != kind and kind in dict(chunks):
            raise ImageError(f"{name}: the image data are torn apart by other chunks; save the image again")
        chunks.append((kind, body))
        at += 12 + length


@kernel
def _unfilter(rows: Uint8s, step: int) -> None:
    """Undo the filter of each row, named by its first byte, in place (9.2)."""
    for y in range(rows.shape[0]):
        kind = rows[y, 0]
        for i in range(1, rows.shape[1]):
            left = int(rows[y, i - step]) if i > step else 0
            up = int(rows[y - 1, i]) if y > 0 else 0
            corner = int(rows[y - 1, i - step]) if y > 0 and i > step else 0
            guess = 0
            if kind == 1:
                guess = left
            elif kind == 2:
                guess = up
            elif kind == 3:
                guess = (left + up) >> 1
            elif kind == 4:
                from_left, from_up = abs(up - corner), abs(left - corner)
                from_corner = abs(left + up - 2 * corner)
                if from_left <= from_up and from_left <= from_corner:
                    guess = left
                elif from_up <= from_corner:
                    guess = up
                else:
                    guess = corner
            rows[y, i] = (int(rows[y, i]) + guess) & 255
