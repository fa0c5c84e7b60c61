"""Images that Pillow would cut to eight bits or cannot open, read by OpenImageIO: the extra ``images``.

A file's first bytes decide. Only JPEG 2000 allocates memory by its header, which is checked.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from contextlib import closing
from typing import Any

import numpy as np
import PIL.TiffImagePlugin

from octex.arrays import Array
from octex.errors import ImageError, MissingExtraError
from octex.files import scratch_folder
from octex.source.images.pyramid import Texels

#: The largest image that is read.
MAX_TEXELS = 16384 * 16384

# Deflate packs at most 1032 bytes into one, and a byte has eight texels at most. JPEG 2000 has no such bound:
# real images take far more than 1/32 bit a texel.
MOST_PER_BYTE = 8256
_MOST_PER_BYTE_JPEG2000 = 256

_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_JPEG2000 = (b"\0\0\0\x0cjP  ", b"\xff\x4f\xff\x51")
_MOST_OF_PPM = re.compile(rb"P[36](?:\s+|#[^\n]*\n)+\d+(?:\s+|#[^\n]*\n)+\d+(?:\s+|#[^\n]*\n)+(\d+)")
# TIFF's photometric interpretations that are read: white is zero, black is zero, RGB, CMYK.
_WHITE_IS_ZERO = 0
_PHOTOMETRIC = (_WHITE_IS_ZERO, 1, 2, 5)


def deep_format(data: bytes) -> str | None:
    """Return the ending of an image file that Pillow would read with loss or not at all; None for others."""
    if data.startswith(b"\x76\x2f\x31\x01"):
        return "exr"
    if data.startswith(b"#?"):
        return "hdr"
    if data.startswith(_TIFF):
        directory = PIL.TiffImagePlugin.ImageFileDirectory_v2(data[: 16 if b"+" in data[2:4] else 8])
        file = io.BytesIO(data)
        file.seek(directory.next)
        directory.load(file)
        bits = tuple(directory.get(258, (1,)))
        kind, photometric = directory.get(339, (1,))[0], directory.get(262)
        whole = photometric == 1 and (bits, kind) in (((16,), 1), ((32,), 3))  # which Pillow reads
        return "tif" if max(bits) > 8 and not whole else None
    if data.startswith(_JPEG2000):
        return "jp2" if any(size & 0x7F > 7 for size in jpeg2000_header(data)[2]) else None
    if data.startswith(b"8BPS"):
        return "psd" if data[4:6] == b"\0\2" or data[22:24] > b"\0\x08" else None
    if data.startswith(b"\x01\xda"):
        return "sgi" if data[3:4] == b"\2" else None
    if data.startswith(b"PF"):
        return "pfm"
    most = _MOST_OF_PPM.match(data[:4096])
    return "ppm" if most and len(most[1]) > 2 and int(most[1][:6]) > 255 else None


def jpeg2000_header(data: bytes) -> tuple[int, int, bytes]:
    """Return a JPEG 2000 codestream's width, height and component sizes (depth − 1, the upper bit: signs)."""
    at = data.find(_JPEG2000[1]) + 4
    words = np.frombuffer(data[at + 4 : at + 36], ">u4")
    if at < 4 or len(words) < 8:
        return 0, 0, b""
    right, below, left, above = (int(word) for word in words[:4])
    count = int.from_bytes(data[at + 36 : at + 38], "big")
    return right - left, below - above, data[at + 38 : at + 38 + 3 * count : 3]


def decode_deep(data: bytes, ending: str, name: str) -> Texels:
    """Return the texels (height, width, 4) of an image file of a format named by ``deep_format``.

    Associated alpha (EXR always, TIFF by its tag) is divided out. The first part with colour is read: R, G, B
    or Y, with A, without a layer or else of the first layer that has them; a single channel is grey. EXR's
    display window is filled with transparent black. Radiance HDR's EXPOSURE is not divided out.
    """
    try:
        import OpenImageIO
    except ImportError:
        what = f"{name}: to be read without loss"
        raise MissingExtraError.needed(what, "OpenImageIO", "images") from None
    if ending == "jp2":
        check_size(*jpeg2000_header(data)[:2], len(data), name, _MOST_PER_BYTE_JPEG2000)
    with scratch_folder() as folder:  # the library reads paths only
        path = folder / f"image.{ending}"
        path.write_bytes(data)
        config = OpenImageIO.ImageSpec()
        config.attribute("oiio:UnassociatedAlpha", 1)
        file = OpenImageIO.ImageInput.open(str(path), config)
        if file is None:
            raise _unreadable(name, OpenImageIO.geterror().replace(str(path), path.name))
        with closing(file):
            return _read(OpenImageIO, file, len(data), ending, name)


def check_size(width: int, height: int, size: int | None, name: str, most: int = MOST_PER_BYTE) -> None:
    """Refuse more than MAX_TEXELS, or more than ``size`` bytes can hold at ``most`` texels a byte."""
    if width * height > MAX_TEXELS:
        raise ImageError(
            f"{name} has {width} × {height} texels; octex reads up to {MAX_TEXELS}: scale it down"
        )
    if size is not None and width * height > most * size:
        raise ImageError(f"{name} is truncated: it cannot hold {width} × {height} texels; save it again")


def _read(library: Any, file: Any, size: int, ending: str, name: str) -> Texels:
    part, spec, indices = _find(file, name)
    kinds = {str(spec.channelformats[index] if spec.channelformats else spec.format) for index in indices}
    integers = not kinds <= {"half", "float", "double"}
    if spec.getattribute("tiff:PhotometricInterpretation") not in (*_PHOTOMETRIC, None):
        raise ImageError(f"{name} has colours in a form that octex does not read; save it as RGB")
    if integers and (ending == "exr" or not kinds <= {"uint8", "uint16", "uint"}):
        raise ImageError(f"{name} has texels of {', '.join(sorted(kinds))}, which are not colours")
    check_size(spec.width, spec.height, size, name)
    check_size(spec.full_width, spec.full_height, size, name)
    first, last = min(indices), max(indices) + 1
    check_size(spec.width, spec.height * (last - first), 4 * size, name)
    kind = library.UINT16 if integers else library.FLOAT
    values = file.read_image(part, 0, first, last, kind)
    if values is None:
        raise _unreadable(name, file.geterror())
    values = values.reshape(spec.height, spec.width, -1)[..., [index - first for index in indices]]
    if ending == "tif" and spec.getattribute("tiff:PhotometricInterpretation") == _WHITE_IS_ZERO:
        values[..., 0] = (65535 if integers else np.float32(1)) - values[..., 0]
    if ending == "hdr":  # rows and columns may be reversed (1 to 4 as in TIFF's tag of that name)
        orientation = spec.getattribute("Orientation")
        if orientation not in (None, 1, 2, 3, 4):
            raise ImageError(f"{name} is stored column by column; save it again, row by row")
        values = values[:: -1 if orientation in (3, 4) else 1, :: -1 if orientation in (2, 3) else 1]
    texels = spread(values)
    is_associated = ending == "exr" or (ending == "tif" and not spec.getattribute("oiio:UnassociatedAlpha"))
    if len(indices) in (2, 4) and is_associated:
        _divide_by_alpha(texels)
    return _placed(texels, spec, name) if ending == "exr" else texels


def _find(file: Any, name: str) -> tuple[int, Any, list[int]]:
    """Return the first part that has colour, its description, and the indices of its colours and alpha."""
    names: list[str] = []
    part = 0
    while file.seek_subimage(part, 0):
        spec = file.spec()
        indices = _color_channels(spec.channelnames)
        if indices and spec.deep:
            raise ImageError(f"{name} is a deep image, of several layers at a pixel; flatten it")
        if indices:
            return part, spec, indices
        names += spec.channelnames
        part += 1
    if part == len(names) == 1 and not spec.deep and file.seek_subimage(0, 0):
        return 0, file.spec(), [0]
    listing = ", ".join(dict.fromkeys(names)) or "none"
    raise ImageError(f"{name} has no channels R, G and B or Y, but {listing}; save it with colour")


def _color_channels(names: Sequence[str]) -> list[int]:
    """Return the indices of R, G, B or of Y, then of A, among the names; none without colour."""
    split = [name.upper().rpartition(".")[::2] for name in names]
    for layer in dict.fromkeys(["", *(layer for layer, _ in split)]):
        indices = {channel: index for index, (of, channel) in enumerate(split) if of == layer}
        for color in ("RGB", "Y", "L"):
            if all(channel in indices for channel in color) and not {"RY", "BY"} & indices.keys():
                return [indices[channel] for channel in [*color, "A"] if channel in indices]
    return []


def spread(values: Array) -> Texels:
    """Return texels (height, width, 4) of 1 to 4 lanes: 8-bit codes times 257, floats as float32."""
    channels = values.shape[2]
    integers = values.dtype.kind == "u"
    if not integers:
        with np.errstate(over="ignore"):
            values = values.astype(np.float32, copy=False)
    texels = np.empty((*values.shape[:2], 4), np.uint16 if integers else np.float32)
    if channels == 4:
        texels[...] = values
    else:
        for lane in range(3):  # one at a time: twice as fast as rows of three
            texels[..., lane] = values[..., lane if channels == 3 else 0]
        opaque = np.iinfo(values.dtype).max if integers else 1
        texels[..., 3] = values[..., 1] if channels == 2 else opaque
    if values.dtype == np.uint8:
        texels *= np.uint16(257)
    return texels


def _divide_by_alpha(texels: Texels) -> None:
    """Make associated alpha unassociated, in place; colours of alpha 0 stay."""
    alpha = texels[..., 3:]
    most = 65535.0 if texels.dtype == np.uint16 else 1.0
    partial = (alpha > 0) & (alpha != most)
    if not partial.any():
        return
    with np.errstate(over="ignore"):
        colors = np.divide(texels[..., :3] * np.float64(most), alpha, where=partial, out=None)
    if texels.dtype == np.uint16:
        colors = np.minimum(np.rint(colors), most)
    np.copyto(texels[..., :3], colors, where=partial, casting="unsafe")


def _placed(texels: Array, spec: Any, name: str) -> Array:
    """Return the display window of an image, from the texels of its data window."""
    down, right = spec.y - spec.full_y, spec.x - spec.full_x
    height, width = spec.full_height, spec.full_width
    if (down, right, height, width) == (0, 0, *texels.shape[:2]):
        return texels
    inside = texels[max(-down, 0) : max(height - down, 0), max(-right, 0) : max(width - right, 0)]
    if inside.size == 0:
        raise ImageError(f"{name}: the data window lies outside of the display window; save it again")
    window = np.zeros((height, width, 4), texels.dtype)
    top, left = max(down, 0), max(right, 0)
    window[top : top + inside.shape[0], left : left + inside.shape[1]] = inside
    return window


def _unreadable(name: str, reason: str) -> ImageError:
    reason = " ".join(reason.split()) or "it is damaged"
    return ImageError(f"{name} cannot be read as an image ({reason}); save it again")
