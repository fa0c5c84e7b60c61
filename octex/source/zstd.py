"""Unpack zstd, which Python has from 3.14 on."""

from __future__ import annotations

import sys
from importlib import import_module

from octex.errors import MissingExtraError


def unpack_zstd(data: bytes | memoryview, most: int, name: str) -> tuple[bytes, bool]:
    """Return the unpacked bytes, ``most`` of them at most, and whether these are all.

    Raises ValueError for damaged data; MissingExtraError, which names the file, if zstd is missing.
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
