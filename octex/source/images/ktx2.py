"""KTX2 textures (KTX File Format 2.0, Khronos) of plain texels, or in Basis Universal's codes.

The largest mip is read. As for other images, the use decides whether texels are sRGB, not vkFormat.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

from octex.errors import ImageError, MissingExtraError
from octex.source.images.openimage import check_size, spread
from octex.source.images.pyramid import Texels
from octex.source.zstd import unpack_zstd

SIGNATURE = b"\xabKTX 20\xbb\r\n\x1a\n"
#: zstd packs 128 kB of equal bytes, as many texels of one lane, into four.
_MOST_PER_BYTE = 65536
#: The type and the stored lanes of the values of VkFormat that are read: UNORM and SRGB of 8 bits, UNORM of
#: 16, and SFLOAT.
_FORMATS = {
    **{first + 7 * n: ("u1", lanes) for first in (9, 15)
       for n, lanes in enumerate(("r", "rg", "rgb", "bgr", "rgba", "bgra"))},
    **{70 + 7 * n: ("<u2", "rgba"[: n + 1]) for n in range(4)},
    **{76 + 7 * n: ("<f2", "rgba"[: n + 1]) for n in range(4)},
    **{100 + 3 * n: ("<f4", "rgba"[: n + 1]) for n in range(4)},
}  # fmt: skip
_PLAIN, _ZSTD, _ZLIB = 0, 2, 3  # schemes of supercompression


def decode_ktx2(data: bytes, name: str) -> Texels:
    """Return the texels (height, width, 4) of the largest image of a KTX2 texture.

    In plain texels, missing lanes are 0, a missing alpha is 1. Raises ImageError, and MissingExtraError if
    codes need the extra ``ktx2``.
    """
    # With the offsets of the data format descriptor, the metadata and the largest level, and its sizes.
    (
        vk_format, _, width, height, depth, layers, faces, _, scheme, descriptor, _, entries, entries_size,
        _, _, level, packed, unpacked,
    ) = struct.unpack_from("<13I5Q", data, len(SIGNATURE))  # fmt: skip
    if vk_format == 0:
        return _universal(data, name, unpacked)
    if vk_format not in _FORMATS:
        raise ImageError(
            f"{name} has vkFormat {vk_format}, which octex does not read; save it as R8G8B8A8, or in Basis "
            "Universal's codes"
        )
    if max(depth, 1) * max(layers, 1) * faces != 1:
        raise ImageError(f"{name} is a volume, an array or a cube of images; save the one that you mean")
    if any(byte & 1 for byte in data[descriptor + 15 : descriptor + 16]):
        raise ImageError(f"{name} has colours multiplied by alpha; save it without (straight alpha)")
    height = max(height, 1)
    check_size(width, height, len(data), name, _MOST_PER_BYTE)
    dtype, lanes = _FORMATS[vk_format]
    what = f"texels of vkFormat {vk_format}"
    size = width * height * len(lanes) * np.dtype(dtype).itemsize
    content = _unpacked(data[level : level + packed], scheme, size, name, what)
    if size == 0 or len(content) != size:
        raise ImageError(
            f"{name} is damaged: {width} × {height} {what} take {size} bytes, and it has another number; "
            "save it again"
        )
    metadata = _metadata(data[entries : entries + entries_size])
    orientation = metadata.get(b"KTXorientation", b"rd")
    values = np.frombuffer(content, dtype).reshape(height, width, len(lanes))
    values = values[:: -1 if orientation[1:2] == b"u" else 1, :: -1 if orientation[:1] == b"l" else 1]
    one = np.iinfo(dtype).max if values.dtype.kind == "u" else 1
    texels = np.zeros((height, width, 4), dtype)
    for column, lane in enumerate(metadata.get(b"KTXswizzle", b"rgba").decode("ascii")[:4]):
        texels[..., column] = values[..., lanes.index(lane)] if lane in lanes else one * (lane in "1a")
    return spread(texels)


def _unpacked(data: bytes, scheme: int, size: int, name: str, what: str) -> bytes:
    """Return the unpacked bytes, at most one more than ``size``; none of truncated data."""
    if scheme == _PLAIN:
        return data
    if scheme not in (_ZLIB, _ZSTD):
        raise ImageError(
            f"{name} has {what} packed by scheme {scheme}, which octex does not read; pack them by zstd"
        )
    if scheme == _ZSTD:
        unpacked, is_all = unpack_zstd(data, size + 1, name)
        return unpacked if is_all else b""
    unpacker = zlib.decompressobj()
    unpacked = unpacker.decompress(data, size + 1)
    return unpacked if unpacker.eof else b""


def _metadata(data: bytes) -> dict[bytes, bytes]:
    """Return the values of keys, without their final zeros."""
    entries = {}
    at = 0
    while at + 4 <= len(data):
        (length,) = struct.unpack_from("<I", data, at)
        key, _, value = data[at + 4 : at + 4 + length].partition(b"\0")
        entries[key] = value.rstrip(b"\0")
        at += 4 + length + -length % 4
    return entries


def _universal(data: bytes, name: str, unpacked: int) -> Texels:
    """Return the texels of Basis Universal's codes, ETC1S or UASTC."""
    try:
        import opengl_basisu
    except ImportError:
        what = f"{name}: to decode KTX2 textures of Basis Universal's codes"
        raise MissingExtraError.needed(what, "opengl-basisu", "ktx2") from None
    texture = opengl_basisu.open(data)
    check_size(texture.width, texture.height, len(data), name, _MOST_PER_BYTE)
    blocks = -(-texture.width // 4) * -(-texture.height // 4) * texture.faces * texture.layers
    if unpacked > 16 * blocks:  # of the largest image
        raise ImageError(f"{name} is damaged: its texels unpack to too many bytes; save it again")
    return spread(texture.transcode("rgba8").data)
