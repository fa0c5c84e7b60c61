"""Morton codes: a cell's three coordinates with their bits interleaved, x lowest.

A code has three bits a level; a cell's parent is ``code >> 3``, its octant ``code & 7``.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from octex.arrays import Int64s
from octex.jit import kernel, part


@part
def spread(value: int) -> int:
    """Move bit b of a 21-bit number to bit 3·b."""
    value = value & 0x1FFFFF
    value = (value | value << 32) & 0x1F00000000FFFF  # 43210 ···· fedcba9876543210
    value = (value | value << 16) & 0x1F0000FF0000FF
    value = (value | value << 8) & 0x100F00F00F00F00F
    value = (value | value << 4) & 0x10C30C30C30C30C3
    return (value | value << 2) & 0x1249249249249249  # every third bit


@part
def gather(code: int) -> int:
    """Collect every third bit, from bit 0 on: the inverse of spread."""
    value = code & 0x1249249249249249
    value = (value | value >> 2) & 0x10C30C30C30C30C3
    value = (value | value >> 4) & 0x100F00F00F00F00F
    value = (value | value >> 8) & 0x1F0000FF0000FF
    value = (value | value >> 16) & 0x1F00000000FFFF
    return (value | value >> 32) & 0x1FFFFF


@part
def encode(i: int, j: int, k: int) -> int:
    """Morton code of cell (i, j, k), each coordinate of at most 21 bits."""
    return spread(i) | spread(j) << 1 | spread(k) << 2


@part
def decode(code: int) -> tuple[int, int, int]:
    """Cell (i, j, k) of a Morton code."""
    return gather(code), gather(code >> 1), gather(code >> 2)


def encode_cells(cells: npt.ArrayLike) -> Int64s:
    """Morton codes (n,) of cell coordinates (n, 3), whole numbers of at most 21 bits."""
    i, j, k = np.asarray(cells, np.int64).T
    return _encode_all(i, j, k)


def decode_cells(codes: npt.ArrayLike) -> Int64s:
    """Cell coordinates (n, 3) of Morton codes (n,)."""
    return _decode_all(np.ascontiguousarray(codes, np.int64))


@kernel
def _encode_all(i: Int64s, j: Int64s, k: Int64s) -> Int64s:
    codes = np.empty(i.size, np.int64)
    for n in range(i.size):
        codes[n] = encode(i[n], j[n], k[n])
    return codes


@kernel
def _decode_all(codes: Int64s) -> Int64s:
    cells = np.empty((codes.size, 3), np.int64)
    for n in range(codes.size):
        cells[n, 0], cells[n, 1], cells[n, 2] = decode(codes[n])
    return cells
