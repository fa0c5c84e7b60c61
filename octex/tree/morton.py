"""Morton codes: a cell's three coordinates with their bits interleaved, x lowest.

A code has three bits a level; a cell's parent is ``code >> 3``, its octant ``code & 7``.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from octex.arrays import Int64s, Uint64s
from octex.jit import inlined, kernel, new_array, part, popcount

#: The cells of a block of 4³, as bits, that are the first along each axis.
FIRST_PLACES = np.array(
    [sum(1 << cell for cell in range(64) if not cell & 9 << axis) for axis in range(3)], np.uint64
)


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
    """Undo spread: collect every third bit, from bit 0 on."""
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


def cells_beside(codes: Int64s, level: int) -> Int64s:
    """Return the cells beside some of a level, at faces, edges and corners, without themselves.

    Morton codes, ascending, of which none is twice, given and returned. They are gathered as bits of blocks
    of 4³ cells: a twentieth of the cells' number are sorted.
    """
    blocks, masks = _blocks_beside(codes, level)
    order = np.argsort(blocks)
    found = np.empty(int(np.bitwise_count(masks).sum()), np.int64)
    return found[: _write_cells(blocks[order], masks[order], codes, found)].copy()


@kernel
def _blocks_beside(codes: Int64s, level: int) -> tuple[Int64s, Uint64s]:
    """Return blocks with a bit for each cell beside cells of one block; a block may come several times."""
    count = 0
    for n in range(codes.size):
        count += n == 0 or codes[n] >> 6 != codes[n - 1] >> 6
    blocks, masks = new_array(27 * count, np.int64), new_array(27 * count, np.uint64)
    around = new_array(27, np.uint64)
    end = 1 << max(level - 2, 0)
    bits = 8 ** min(level, 2)  # of a block that are in the root
    inside = ~np.uint64(0) >> np.uint64(64 - bits)
    n = made = 0
    while n < codes.size:
        block = codes[n] >> 6
        a, b, c = decode(block)
        mask = np.uint64(0)
        while n < codes.size and codes[n] >> 6 == block:
            mask |= np.uint64(1) << np.uint64(codes[n] & 63)
            n += 1
        around[12], around[13], around[14] = _widened(mask, 0)
        for place in range(12, 15):
            around[place - 3], around[place], around[place + 3] = _widened(around[place], 1)
        for place in range(9, 18):
            around[place - 9], around[place], around[place + 9] = _widened(around[place], 2)
        for place in range(27):
            x, y, z = a + place % 3 - 1, b + place // 3 % 3 - 1, c + place // 9 - 1
            if around[place] & inside != 0 and min(x, y, z) >= 0 and max(x, y, z) < end:
                blocks[made] = spread(x) | spread(y) << 1 | spread(z) << 2
                masks[made] = around[place] & inside
                made += 1
    return blocks[:made].copy(), masks[:made].copy()


@inlined
def _widened(mask: np.uint64, axis: int) -> tuple[np.uint64, np.uint64, np.uint64]:
    """Return cells of a block, as bits, with those beside them along an axis: before, in and after it."""
    step = np.uint64(1 << axis)  # from an even place to the next
    carry, across = np.uint64(7) * step, np.uint64(9) * step  # from an odd one; from the last to the first
    first, second = mask & FIRST_PLACES[axis], mask >> step & FIRST_PLACES[axis]
    third = mask >> (step + carry) & FIRST_PLACES[axis]
    fourth = mask >> across & FIRST_PLACES[axis]
    one, two, three = first | second | third, second | third | fourth, third | fourth
    own = first | second | one << step | two << (step + carry) | three << across
    return first << across, own, fourth


@kernel
def _write_cells(blocks: Int64s, masks: Uint64s, without: Int64s, found: Int64s) -> int:
    """Write the cells whose bits are set in blocks, which ascend, but for some, ascending too; count them."""
    count = n = at = 0
    while n < blocks.size:
        block, mask = blocks[n], np.uint64(0)
        while n < blocks.size and blocks[n] == block:
            mask |= masks[n]
            n += 1
        while at < without.size and without[at] >> 6 < block:
            at += 1
        while at < without.size and without[at] >> 6 == block:
            mask &= ~(np.uint64(1) << np.uint64(without[at] & 63))
            at += 1
        while mask != np.uint64(0):
            lowest = mask & (~mask + np.uint64(1))
            mask ^= lowest
            found[count] = block << 6 | np.int64(popcount(lowest - np.uint64(1)))
            count += 1
    return count


@kernel
def _encode_all(i: Int64s, j: Int64s, k: Int64s) -> Int64s:
    codes = new_array(i.size, np.int64)
    for n in range(i.size):
        codes[n] = encode(i[n], j[n], k[n])
    return codes


@kernel
def _decode_all(codes: Int64s) -> Int64s:
    cells = new_array((codes.size, 3), np.int64)
    for n in range(codes.size):
        cells[n, 0], cells[n, 1], cells[n, 2] = decode(codes[n])
    return cells
