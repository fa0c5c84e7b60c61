"""Integers as deflated planes of bytes, for web files and pages."""

from __future__ import annotations

import zlib

import numpy as np

from octex.arrays import Array, Int64s


def zigzag(numbers: Array) -> Int64s:
    """Map integers to non-negative ones: 0, −1, 1, −2 become 0, 1, 2, 3."""
    numbers = numbers.astype(np.int64)
    return (numbers << 1) ^ (numbers >> 63)


def planes(numbers: Array) -> bytes:
    """Return integers (n,), 0 to 2³² − 1, as four planes of bytes, the lowest first."""
    return np.ascontiguousarray(numbers.astype("<u4").view(np.uint8).reshape(-1, 4).T).tobytes()


def deflated(stream: bytes, level: int) -> bytes:
    """Return a stream as raw deflate, of ``level`` 1 to 9."""
    packer = zlib.compressobj(level, zlib.DEFLATED, -15, 9)
    return packer.compress(stream) + packer.flush()
