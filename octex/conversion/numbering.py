"""Leaves or their rows in Morton order, the samples of each, and what numbers cells have within a brick."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Int32s, Int64s, bit_counts, in_runs
from octex.conversion import large
from octex.conversion.samples import Samples
from octex.field.taps import Taps
from octex.jit import inlined, kernel
from octex.tree.octree import Octree, distinct


class Leaves(NamedTuple):
    """The leaves of a tree in Morton order, which is that of samples, whatever their levels."""

    cells: Int64s  # (leaves,)   their cell numbers; empty if they follow one another from `offset` on
    ranks: Int64s  # (cells,)   each leaf's place in this order, −1 for nodes; empty likewise
    offset: int
    firsts: Int64s  # (leaves + 1,)   the first sample of each
    heads: Int64s  # (leaves,)   of rows of leaves: the place of each leaf's first, which has the samples

    @classmethod
    def of(cls, tree: Octree, samples: Samples) -> Leaves:
        """Put the leaves of a tree in order; they are the samples' finest cells, or cells above them."""
        none = np.empty(0, np.int64)
        if tree.max_depth == samples.depth and tree.n_leaves == len(samples.codes):
            return cls(none, none, tree.n_cells - tree.n_leaves, samples.firsts, none)
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
        return cls(in_order, ranks, 0, samples.firsts[np.append(starts, len(samples.codes))], none)

    def some(self, chosen: Bools, n_cells: int) -> Leaves:
        """Put some leaves (leaves,) in order. The samples are then those of these leaves alone."""
        cells = self.numbers_of(chosen)
        ranks = np.full(n_cells, -1, np.int64)
        ranks[cells] = np.arange(cells.size)
        firsts = np.append(0, np.cumsum(np.diff(self.firsts)[chosen]))
        return self._replace(cells=cells, ranks=ranks, offset=0, firsts=firsts)

    def rows_of(self, tree: Octree, chosen: Bools) -> Leaves:
        """Put the rows of some leaves (leaves,), all split, in order: after all cells, by table.

        The samples are then those of these leaves alone.
        """
        cells = self.numbers_of(chosen)
        counts = bit_counts(tree.split.facings).astype(np.int64)
        at = np.searchsorted(tree.split.cells, cells)
        first_rows, counts = (np.cumsum(counts) - counts)[at], counts[at]
        heads = np.cumsum(counts) - counts
        rows = tree.n_cells + in_runs(first_rows, counts)
        ranks = large.empty(tree.n_cells + tree.split.areas.size, np.int64)
        ranks[:] = -1
        ranks[rows] = np.arange(rows.size)
        ends = np.cumsum(np.diff(self.firsts)[chosen])
        firsts = np.repeat(ends, counts)
        firsts[heads] = np.append(0, ends[:-1])
        return Leaves(rows, ranks, 0, np.append(firsts, ends[-1:]), np.repeat(heads, counts))

    def numbers(self, first: int, end: int) -> Int64s:
        """Return the cell numbers of leaves ``first`` … ``end`` − 1 of the order."""
        return self.cells[first:end] if self.cells.size else np.arange(first, end) + self.offset

    def numbers_of(self, chosen: Bools) -> Int64s:
        """Return the cell numbers of some leaves (leaves,), in order."""
        return self.cells[chosen] if self.cells.size else np.flatnonzero(chosen) + self.offset

    def with_samples(self, places: Int64s) -> Int64s:
        """Return which leaves have the samples of those at places in the order, each once."""
        return distinct(self.heads[places]) if self.heads.size else np.sort(places)

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
def members_of(firsts: Int64s, leaves: Int64s, most: int) -> tuple[Int64s, Float32s]:
    """List the samples of leaves, about ``most`` of each evenly chosen; and how many each stands for."""
    total = 0
    for leaf in leaves:
        count = firsts[leaf + 1] - firsts[leaf]
        total += count if count <= most else most + 1
    members = np.empty(total, np.int64)
    strides = np.empty(total, np.float32)
    n = 0
    for leaf in leaves:
        count = firsts[leaf + 1] - firsts[leaf]
        stride = 1 if count <= most else (count + most - 1) // most  # dividing takes longer than all else
        for sample in range(firsts[leaf], firsts[leaf + 1], stride):
            members[n] = sample
            strides[n] = stride
            n += 1
    return members[:n].copy(), strides[:n].copy()


class Outside(NamedTuple):
    """The rows that lookups touch outside a run of leaves, numbered as they come: a hash table."""

    keys: Int64s  # (2 · room,)   a power of two; −1: free
    numbers: Int32s  # (2 · room,)
    rows: Int64s  # (room,)   by number
    total: Int64s  # (1,)

    @classmethod
    def of(cls, room: int) -> Outside:
        """Return an empty table with at least this room."""
        size = 1 << max(2 * room - 1, 15).bit_length()
        return cls(
            np.full(size, -1, np.int64),
            np.empty(size, np.int32),
            np.empty(size // 2, np.int64),
            np.zeros(1, np.int64),
        )

    def with_room(self, room: int) -> Outside:
        """Return the table, or a larger one that holds the same if it has not this room left."""
        if self.total[0] + room <= self.rows.size:
            return self
        larger = Outside.of(2 * (int(self.total[0]) + room))
        extend(larger, self.found())
        return larger

    def found(self) -> Int64s:
        """Return the rows by number."""
        return self.rows[: self.total[0]]


@inlined
def number_of(outside: Outside, row: int) -> int:
    """Return a row's number (Knuth's multiplicative hashing)."""
    slot = row * 0x9E3779B1 & outside.keys.size - 1
    while outside.keys[slot] != row:
        if outside.keys[slot] < 0:
            outside.keys[slot] = row
            outside.numbers[slot] = outside.total[0]
            outside.rows[outside.total[0]] = row
            outside.total[0] += 1
            break
        slot = slot + 1 & outside.keys.size - 1
    return int(outside.numbers[slot])


@kernel
def extend(outside: Outside, rows: Int64s) -> None:
    """Give rows their numbers, in turn."""
    for i in range(rows.size):
        number_of(outside, int(rows[i]))


@kernel
def number(
    taps: Taps,
    leaves: Leaves,
    first: int,
    end: int,
    outside: Outside,
    ends: Int64s,
    numbers: Int32s,
    weights: Float32s,
) -> int:
    """List the taps of points that weigh anything, with weights that sum to 1; return how many.

    Their rows get numbers: leaves ``first`` … ``end`` − 1 from 0 on, then the rest. ``outside``, which must
    have room for all of them, takes what it does not have yet. A point's taps end at ``ends`` (points,).
    """
    count = 0
    for n in range(taps.starts.size):
        total = 0.0
        for tap in range(taps.starts[n], taps.ends[n]):
            total += np.float64(taps.weights[tap])
        inverse = 1.0 / total if total > 0.0 else 0.0
        for tap in range(taps.starts[n], taps.ends[n]):
            weight = np.float32(np.float64(taps.weights[tap]) * inverse)
            if not weight > np.float32(0):
                continue
            row = int(np.int64(taps.rows[tap]))
            rank = row - leaves.offset
            if leaves.ranks.size > 0:
                rank = int(leaves.ranks[row]) if row < leaves.ranks.size else -1
            numbers[count] = rank - first if first <= rank < end else end - first + number_of(outside, row)
            weights[count] = weight
            count += 1
        ends[n] = count
    return count
