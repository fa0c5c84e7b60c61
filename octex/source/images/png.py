"""PNG images of 16 bits a channel, whole: Pillow keeps only the upper eight bits of colours.

Written from the PNG specification (W3C, third edition).
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

from octex.arrays import Uint8s
from octex.errors import ImageError
from octex.jit import kernel
from octex.source.images.openimage import spread
from octex.source.images.pyramid import Texels

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}  # by colour type: grey, RGB, grey and alpha, RGBA
# First column and row, and steps, of the seven passes of an interlaced image (8.2).
_PASSES = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))


def is_png16(data: bytes) -> bool:
    """Whether bytes begin a PNG image of 16 bits a channel."""
    return data[:8] == SIGNATURE and data[12:16] == b"IHDR" and data[24:25] == b"\x10"


def decode_png16(data: bytes, name: str) -> Texels:
    """Return the texels (height, width, 4) of a PNG image of 16 bits a channel.

    Raises ImageError for damaged data.
    """
    width, height, _, color_type, _, _, interlaced = struct.unpack_from(">IIBBBBB", data, 16)
    channels = _CHANNELS[color_type]
    passes = _PASSES if interlaced else ((0, 0, 1, 1),)
    sizes = [(max(-(-(width - x) // dx), 0), max(-(-(height - y) // dy), 0)) for x, y, dx, dy in passes]
    expected = sum(h * (1 + w * channels * 2) for w, h in sizes if w)
    compressed, transparent = [], None
    for kind, body in png_chunks(data, name):
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
    """Return the kinds and bodies of a PNG file's chunks up to the end of the image.

    Raises ImageError for a file without an end, a wrong checksum of a chunk that the image needs, or image
    data with other chunks between (5.6).
    """
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
