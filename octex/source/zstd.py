"""Unpack zstd, which Python has from 3.14 on."""

from __future__ import annotations

import sys
from importlib import import_module

from octex.errors import MissingExtraError


def unpack_zstd(data: bytes | memoryview, most: int, name: str) -> tuple[bytes, bool]:
    """Return what is packed, at most so many bytes, and whether that is all. Raises ValueError for damage.

    MissingExtraError, which names the file, where zstd is missing.
    """
    module = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
    try:
        zstd = import_module(module)
    except ImportError:
        raise MissingExtraError.needed(f"{name}: to unpack zstd", "backports.zstd", "ktx2") from None
    unpacker = zstd.ZstdDecompressor()
    try:
        unpacked: bytes = unpacker.decompress(data, most)
    except zstd.ZstdError as error:
        raise ValueError(str(error)) from None
    return unpacked, bool(unpacker.eof)
