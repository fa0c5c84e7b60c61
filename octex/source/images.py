"""Image files and arrays as texels: RGBA of 16 bits, sRGB codes and linear alpha, nothing lost.

A code c of eight bits becomes 257·c, which is the same fraction of 65535. Colour profiles, gamma chunks and
orientation tags are ignored, as glTF asks (3.9.2).
"""

from __future__ import annotations

import io
import logging
import warnings

import numpy as np
import numpy.typing as npt
import PIL.Image

from octex.errors import ImageError
from octex.source.alone import alone
from octex.source.png import SIGNATURE, decode_png16, is_png16, png_chunks

#: The largest image that is read.
MAX_TEXELS = 16384 * 16384

# Deflate packs at most 1032 bytes into one, and PNG eight texels into a byte; other formats pack less, but
# these may hold a plain image of any size in a few bytes.
_MOST_PER_BYTE = 8256
_DENSEST = ("WEBP", "AVIF", "JPEG2000")
_KTX2 = b"\xabKTX 20\xbb\r\n\x1a\n"
# What Pillow logs of damaged files, the errors here say.
logging.getLogger("PIL").addHandler(logging.NullHandler())


def decode_image(data: bytes, name: str) -> npt.NDArray[np.uint16]:
    """Return the texels (height, width, 4) of an image file.

    Raises ImageError, with ``name``, for a damaged file, a format or depth that octex does not read, or more
    than MAX_TEXELS texels.
    """
    if data.startswith(_KTX2):
        raise ImageError(f"{name} is a KTX2 texture, which octex does not decode; convert it to PNG first")
    try:
        with alone():
            warnings.simplefilter("ignore")
            with _open(data) as image:
                return _texels(image, data, name)
    except ImageError:
        raise
    except MemoryError:
        raise ImageError(f"{name}: the image needs more memory than there is") from None
    except Exception as error:
        # Pillow's plugins raise nearly anything for damaged files.
        raise ImageError(f"{name} cannot be read as an image ({_reason(error)}); save it again") from None


def as_texels(image: npt.ArrayLike | PIL.Image.Image) -> npt.NDArray[np.uint16]:
    """Return the texels (height, width, 4) of a Pillow image or of an array of sRGB codes.

    Arrays are uint8 or uint16 of shape (height, width) or (height, width, 1 to 4), for grey, grey and alpha,
    RGB, RGBA. Raises ImageError for anything else.
    """
    if isinstance(image, PIL.Image.Image):
        return _texels(image, b"", "the image")
    array = np.asarray(image)
    if array.ndim == 2:
        array = array[:, :, None]
    if array.ndim != 3 or not 1 <= array.shape[2] <= 4 or 0 in array.shape:
        raise ImageError(f"an image must have shape (height, width, 1 to 4), not {np.shape(image)}")
    if array.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"an image must be uint8 or uint16 (sRGB codes), not {array.dtype}")
    channels = array.shape[2]
    texels = np.empty((*array.shape[:2], 4), np.uint16)
    unit = np.uint16(257 if array.dtype == np.uint8 else 1)
    np.multiply(array[..., : 3 if channels >= 3 else 1], unit, out=texels[..., :3], dtype=np.uint16)
    if channels in (2, 4):
        np.multiply(array[..., -1], unit, out=texels[..., 3], dtype=np.uint16)
    else:
        texels[..., 3] = 65535
    return texels


def _open(data: bytes) -> PIL.Image.Image:
    before = PIL.Image.MAX_IMAGE_PIXELS  # Pillow's own limit on sizes is lower, and global
    PIL.Image.MAX_IMAGE_PIXELS = None
    try:
        return PIL.Image.open(io.BytesIO(data))
    finally:
        PIL.Image.MAX_IMAGE_PIXELS = before


def _texels(image: PIL.Image.Image, data: bytes, name: str) -> npt.NDArray[np.uint16]:
    width, height = image.size
    if width * height > MAX_TEXELS:
        raise ImageError(
            f"{name} has {width} × {height} texels; octex reads up to {MAX_TEXELS}: scale it down"
        )
    if data and image.format not in _DENSEST and width * height > _MOST_PER_BYTE * len(data):
        raise ImageError(f"{name} is truncated: it cannot hold {width} × {height} texels; save it again")
    if data[:8] == SIGNATURE:
        png_chunks(data, name)  # Pillow overlooks wrong checksums of texels
    if is_png16(data):
        return decode_png16(data, name)
    if image.mode.startswith("I;16"):
        return as_texels(np.asarray(image).astype(np.uint16))
    raw_modes = str([tile[3] for tile in getattr(image, "tile", [])])
    if image.mode in ("I", "F") or any(deep in raw_modes for deep in (";16L", ";16B", ";16N")):
        raise ImageError(f"{name} has texels of a depth that Pillow does not keep; save it as a 16-bit PNG")
    whole = image.mode in ("L", "LA", "RGB", "RGBA") and "transparency" not in image.info
    return as_texels(np.asarray(image if whole else image.convert("RGBA")))


def _reason(error: Exception) -> str:
    if isinstance(error, PIL.UnidentifiedImageError):
        return "not an image, or of an unknown format"
    return " ".join(str(error).split()) or type(error).__name__
