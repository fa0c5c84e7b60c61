"""Leaves in Morton order, the samples of each, and the numbers that cells have within a brick."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.conversion.samples import Samples
from octex.jit import inlined, kernel
from octex.tree.octree import Octree

Int64s = npt.NDArray[np.int64]


class Leaves(NamedTuple):
    """The leaves of a tree in Morton order, which is that of samples, whatever their levels."""

    cells: Int64s  # (leaves,)   their cell numbers; empty if they follow one another from `offset` on
    ranks: Int64s  # (cells,)   each leaf's place in this order, −1 for nodes; empty likewise
    offset: int
    firsts: Int64s  # (leaves + 1,)   the first sample of each

    @classmethod
    def of(cls, tree: Octree, samples: Samples) -> Leaves:
        """Put the leaves of a tree in order; they are the samples' finest cells, or cells above them."""
        none = np.empty(0, np.int64)
        if tree.max_depth == samples.depth and tree.n_leaves == len(samples.codes):
            return cls(none, none, tree.n_cells - tree.n_leaves, samples.firsts)
        codes, cells = [], []
        first = 0
        for level, (level_codes, is_node) in enumerate(tree.walk()):
            codes.append(level_codes[~is_node] << 3 * (samples.depth - level))
            cells.append(first + np.flatnonzero(~is_node))
            first += len(level_codes)
        finest = np.concatenate(codes)
        order = np.argsort(finest, kind="stable")
        in_order = np.concatenate(cells)[order]
        ranks = np.full(tree.n_cells, -1, np.int64)
        ranks[in_order] = np.arange(len(in_order))
        starts = np.searchsorted(samples.codes, finest[order])
        return cls(in_order, ranks, 0, samples.firsts[np.append(starts, len(samples.codes))])

    def numbers(self, first: int, end: int) -> Int64s:
        """Return the cell numbers of leaves ``first`` … ``end`` − 1 of the order."""
        return self.cells[first:end] if self.cells.size else np.arange(first, end) + self.offset

    def ranks_of(self, rows: Int64s) -> Int64s:
        """Return the places in the order of rows that lookups touch, −1 for what is no leaf."""
        ranks = np.full(len(rows), -1, np.int64)
        if self.ranks.size:
            are_cells = rows < self.ranks.size
            ranks[are_cells] = self.ranks[rows[are_cells]]
        else:
            places = rows - self.offset
            are_leaves = (places >= 0) & (places < len(self.firsts) - 1)
            ranks[are_leaves] = places[are_leaves]
        return ranks


@kernel
def members_of(firsts: Int64s, leaves: Int64s, most: int) -> tuple[Int64s, npt.NDArray[np.float32]]:
    """List the samples of leaves, about ``most`` of each evenly chosen; and how many each stands for."""
    total = 0
    for leaf in leaves:
        count = firsts[leaf + 1] - firsts[leaf]
        stride = max((count + most - 1) // most, 1)
        total += (count + stride - 1) // stride
    members = np.empty(total, np.int64)
    strides = np.empty(total, np.float32)
    n = 0
    for leaf in leaves:
        count = firsts[leaf + 1] - firsts[leaf]
        stride = max((count + most - 1) // most, 1)
        for sample in range(firsts[leaf], firsts[leaf + 1], stride):
            members[n] = sample
            strides[n] = stride
            n += 1
    return members, strides


def number(
    rows: npt.NDArray[np.uint32], leaves: Leaves, first: int, end: int, outside: Int64s
) -> tuple[npt.NDArray[np.int32], Int64s, Int64s]:
    """Give numbers to what lookups touch: leaves ``first`` … ``end`` − 1 from 0 on, then all outside.

    ``outside`` are the rows that are numbered already. Returns the numbers, all rows outside, and the places
    of the leaves that are new among them.
    """
    numbers, found = _number(rows, leaves.ranks, leaves.offset, first, end, outside)
    ranks = leaves.ranks_of(found[len(outside) :])
    return numbers, found, ranks[ranks >= 0]


@inlined
def _slot(keys: Int64s, row: int, bits: int) -> int:
    """Where a row stands in a hash table, or is to stand (Knuth's multiplicative hashing)."""
    slot = (row * 0x9E3779B1 & 0xFFFFFFFF) >> 32 - bits
    while keys[slot] >= 0 and keys[slot] != row:
        slot = (slot + 1) & (keys.size - 1)
    return slot


@kernel
def _number(
    rows: npt.NDArray[np.uint32], ranks: Int64s, offset: int, first: int, end: int, outside: Int64s
) -> tuple[npt.NDArray[np.int32], Int64s]:
    numbers = np.empty(rows.size, np.int32)
    n_outside = 0
    for i in range(rows.size):
        row = int(rows[i])
        rank = row - offset
        if ranks.size > 0:
            rank = int(ranks[row]) if row < ranks.size else -1
        numbers[i] = rank - first if first <= rank < end else -1
        n_outside += numbers[i] < 0
    bits = 4
    while (1 << bits) < 2 * (n_outside + outside.size):
        bits += 1
    keys = np.full(1 << bits, -1, np.int64)
    places = np.empty(1 << bits, np.int32)
    found = np.empty(n_outside + outside.size, np.int64)
    n_found = 0
    for i in range(outside.size):
        row = int(outside[i])
        slot = _slot(keys, row, bits)
        keys[slot] = row
        places[slot] = n_found
        found[n_found] = row
        n_found += 1
    for i in range(rows.size):
        if numbers[i] < 0:
            row = int(rows[i])
            slot = _slot(keys, row, bits)
            if keys[slot] < 0:
                keys[slot] = row
                places[slot] = n_found
                found[n_found] = row
                n_found += 1
            numbers[i] = end - first + places[slot]
    return numbers, found[:n_found].copy()
