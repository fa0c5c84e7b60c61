"""Neighbouring cells, across faces, edges and corners: gathered as bits of blocks of 4³ cells, unsorted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from octex.arrays import Bools, Int64s, Uint64s, bit_counts
from octex.jit import inlined, kernel, trailing_zeros
from octex.tree.edit import among, indices_in
from octex.tree.morton import decode, spread
from octex.tree.octree import distinct

#: The cells of a block of 4³, as bits, that are the first along each axis.
_FIRST_PLACES = np.array(
    [sum(1 << cell for cell in range(64) if not cell & 9 << axis) for axis in range(3)], np.uint64
)


def boundary(codes: Int64s, level: int) -> Int64s:
    """Return the neighbours of cells of a level, without these (paper 4.1, step 3). All codes here ascend."""
    around = with_boundary(codes, level)
    return around[~among(around, codes)]


def with_boundary(codes: Int64s, level: int) -> Int64s:
    """Return cells of a level with their neighbours."""
    if not codes.size:
        return codes
    above = max(level - 2, 0)  # of few blocks all
    blocks = np.arange(8**above) if above < 4 else with_boundary(distinct(codes >> 6), above)
    masks = _masks_around(codes, level, blocks)
    cells = np.empty(int(bit_counts(masks).sum()), np.int64)
    _write(blocks, masks, cells)
    return cells


def near(codes: Int64s, others: Int64s, level: int) -> Bools:
    """Return which cells (n,) of a level are among others, or neighbours of them."""
    if not codes.size or not others.size:
        return np.zeros(codes.size, np.bool_)
    blocks = distinct(codes >> 6)
    masks = _masks_around(others, level, blocks)[indices_in(codes >> 6, blocks)]
    return np.asarray(masks >> (codes & 63).astype(np.uint64) & np.uint64(1) != 0)


def is_within(codes: Int64s, cells: Sequence[Int64s], level: int) -> Bools:
    """Return which cells of a level are among cells listed level by level, or lie in larger ones of them."""
    is_inside = np.zeros(codes.size, np.bool_)
    for above, larger in enumerate(cells[: level + 1]):
        if larger.size:
            is_inside |= among(codes >> 3 * (level - above), larger)
    return is_inside


def are_adjacent(codes: Int64s, leaves: Sequence[Int64s], level: int) -> Bools:
    """Return which cells (n,) of a level contain or neighbour any leaf, listed by level."""
    if not codes.size:
        return np.zeros(0, np.bool_)
    around = with_boundary(codes, level)
    below = np.empty(0, np.int64)
    for deeper in range(len(leaves) - 1, level - 1, -1):
        if leaves[deeper].size:
            parents = leaves[deeper] >> 3 * (deeper - level)
            below = np.concatenate([below, parents[among(parents, around)]])
    return near(codes, around[is_within(around, [*leaves[:level], distinct(below)], level)], level)


def among_at(codes: Int64s, level: int, others: Int64s, at: int) -> Bools:
    """Return which cells of a level lie in others of level ``at``, or contain one."""
    if not codes.size:
        return np.zeros(0, np.bool_)
    if level < at:
        return among(codes, distinct(others >> 3 * (at - level)))
    return among(codes >> 3 * (level - at), others)


def touch(codes: Int64s, leaves: Sequence[Int64s], level: int, *, refined: bool = False) -> Bools:
    """Return which cells (n,) of a level lie in or next to leaves, or refine to such cells if ``refined``."""
    if not codes.size:
        return np.zeros(0, np.bool_)
    around = with_boundary(codes, level)
    touches = near(codes, around[is_within(around, leaves[: level + 1], level)], level)
    for at in range(level + 1, len(leaves)):
        reached = with_boundary(leaves[at][among_at(leaves[at], at, around, level)], at)
        for deeper in range(at, level, -1):
            reached = distinct((with_boundary(reached, deeper) if refined else reached) >> 3)
        touches |= among(codes, reached)
    return touches


@kernel
def _masks_around(codes: Int64s, level: int, blocks: Int64s) -> Uint64s:
    """Return for each block (n,) the bits of its cells that are among ``codes`` or their neighbours."""
    masks = np.zeros(blocks.size, np.uint64)
    around = np.empty(27, np.uint64)
    ways = np.empty((3, 3), np.int64)  # along each axis the bits of the blocks before, here and after it
    bits = 1
    while 1 << bits < 2 * blocks.size:
        bits += 1
    slots = np.empty(1 << bits, np.int32)  # of a hash table: blocks' numbers, or −1
    slots[:] = -1
    for at in range(blocks.size):
        slot = _slot(blocks[at], bits)
        while slots[slot] >= 0:
            slot = slot + 1 & slots.size - 1
        slots[slot] = at
    end = 1 << max(level - 2, 0)
    inside = ~np.uint64(0) >> np.uint64(64 - 8 ** min(level, 2))  # of a block that are in the root
    n = 0
    while n < codes.size:
        block = codes[n] >> 6
        mask = np.uint64(0)
        while n < codes.size and codes[n] >> 6 == block:
            mask |= np.uint64(1) << np.uint64(codes[n] & 63)
            n += 1
        around[12], around[13], around[14] = _widened(mask, 0)
        for side in range(12, 15):
            around[side - 3], around[side], around[side + 3] = _widened(around[side], 1)
        for side in range(9, 18):
            around[side - 9], around[side], around[side + 9] = _widened(around[side], 2)
        for axis, first in enumerate(decode(block)):
            for step in range(3):
                is_out = first + step < 1 or first + step > end
                ways[axis, step] = -1 if is_out else spread(first + step - 1) << axis
        for side in range(27):
            bits_there = around[side] & inside
            x, y, z = ways[0, side % 3], ways[1, side // 3 % 3], ways[2, side // 9]
            if bits_there == np.uint64(0) or x | y | z < 0:
                continue
            slot = _slot(x | y | z, bits)
            while slots[slot] >= 0 and blocks[slots[slot]] != x | y | z:
                slot = slot + 1 & slots.size - 1
            if slots[slot] >= 0:
                masks[slots[slot]] |= bits_there
    return masks


@inlined
def _slot(code: int, bits: int) -> int:
    """Return the hash of a code in a table of 2^bits slots; near codes lie far apart."""
    last = (1 << bits) - 1
    return ((code ^ code >> bits ^ code >> 2 * bits) & last) * 0x9E3779B1 & last


@inlined
def _widened(mask: np.uint64, axis: int) -> tuple[np.uint64, np.uint64, np.uint64]:
    """Return a block's cells, as bits, with neighbours along an axis: before, in and after the block."""
    step = np.uint64(1 << axis)  # from an even place to the next
    carry, across = np.uint64(7) * step, np.uint64(9) * step  # from an odd one; from the last to the first
    first, second = mask & _FIRST_PLACES[axis], mask >> step & _FIRST_PLACES[axis]
    third = mask >> (step + carry) & _FIRST_PLACES[axis]
    fourth = mask >> across & _FIRST_PLACES[axis]
    one, two, three = first | second | third, second | third | fourth, third | fourth
    middle = first | second | one << step | two << (step + carry) | three << across
    return first << across, middle, fourth


@kernel
def _write(blocks: Int64s, masks: Uint64s, cells: Int64s) -> None:
    """Write the cells whose bits are set."""
    count = 0
    for n in range(blocks.size):
        mask = masks[n]
        while mask != np.uint64(0):
            cells[count] = blocks[n] << 6 | np.int64(trailing_zeros(mask))
            mask &= mask - np.uint64(1)
            count += 1
