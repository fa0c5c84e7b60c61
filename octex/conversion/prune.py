"""Trees pruned at nodes that become leaves.

All arrays count the finest cells of the full tree: a state is the depth of the leaf that holds each of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import numpy as np

from octex.arrays import Bools, Int64s, Uint8s
from octex.conversion import large
from octex.jit import kernel
from octex.texture.channel import Channel
from octex.tree.layout import SPLIT
from octex.tree.octree import Octree
from octex.tree.split import taken

Channels: TypeAlias = Mapping[str, Channel]


class Finest(NamedTuple):
    """The finest cells of a full tree, and the cells above them."""

    tree: Octree
    codes: Int64s  # (n,)   Morton codes, ascending
    firsts: list[Int64s]  # for each level above, the first finest cell in each of its cells

    @classmethod
    def of(cls, tree: Octree) -> Finest:
        """List the finest cells below each cell of a tree whose leaves are all of one level."""
        codes = large.copied(tree.level_codes(tree.max_depth))
        firsts: list[Int64s] = []
        above = codes
        for _ in range(tree.max_depth):
            above = above >> 3
            starts = np.flatnonzero(np.diff(above, prepend=-1))
            above = above[starts]
            firsts.append(large.copied(firsts[-1][starts] if firsts else starts))
        return cls(tree, codes, firsts[::-1])

    def first(self, level: int) -> Int64s | slice:
        """Return an index of the first finest cell in each cell of a level."""
        return self.firsts[level] if level < self.tree.max_depth else slice(None)

    def spread(self, level: int, values: Bools) -> Bools:
        """Give each finest cell the value of the cell of ``level`` that holds it."""
        return np.repeat(values, np.diff(self.firsts[level], append=self.codes.size))


class Pruned(NamedTuple):
    """A pruned tree, and its cells in the full tree."""

    tree: Octree
    cells: Int64s  # (cells,)   numbers in the full tree
    leaves: Bools  # (cells,)
    starts: Int64s  # (leaves,)   the first finest cell of each leaf, in Morton order
    split_rows: Bools  # (rows of the full tree's split table,)   those of this tree
    n_finest: int

    @property
    def sizes(self) -> Int64s:
        """The number of finest cells in each leaf (leaves,), in Morton order."""
        return np.diff(self.starts, append=self.n_finest)

    def leaf_cells(self, depths: Uint8s) -> Int64s:
        """Return the cell number of each leaf (leaves,) in Morton order."""
        levels = depths[self.starts]
        cells = np.empty(self.starts.size, np.int64)
        for level, first in enumerate(self.tree.arrays.level_cells[:-1].tolist()):
            rows = slice(first, int(self.tree.arrays.level_cells[level + 1]))
            cells[levels == level] = first + np.flatnonzero(self.leaves[rows])
        return cells

    def carried(self, channels: Channels) -> dict[str, Channel]:
        """Return the full tree's channels for this tree's cells."""
        return {
            name: channel._replace(
                values=large.taken(channel.values, self.cells),
                split_values=channel.split_values[self.split_rows],
            )
            for name, channel in channels.items()
        }


def prune(finest: Finest, depths: Uint8s) -> Pruned:
    """Prune a tree at ``depths`` (n,), those of the finest cells' leaves; cells keep flags and areas."""
    tree = finest.tree
    starts, codes = _leaves_of(finest.codes, depths, tree.max_depth)
    full = tree.arrays
    cells, leaves = [], []
    for level, first in enumerate(full.level_cells[:-1]):
        depths_there = depths[finest.first(level)]
        stored = np.flatnonzero(depths_there >= level)
        cells.append(stored + first)
        leaves.append(depths_there[stored] == level)
    numbers = large.joined(cells)
    places = np.minimum(np.searchsorted(numbers, tree.split.cells), numbers.size - 1)
    split, rows = taken(tree.split, np.where(numbers[places] == tree.split.cells, places, -1))
    pruned = Octree.from_leaves(codes, depths[starts])
    pruned = pruned.with_cell_data(large.taken(full.flags, numbers), large.taken(full.areas, numbers), split)
    return Pruned(pruned, numbers, np.concatenate(leaves), starts, rows, depths.size)


def grafted(
    tree: Octree, channels: Channels, pruned: Pruned, grown: Octree, values: Channels
) -> tuple[Octree, dict[str, Channel]]:
    """Return a tree and its channels with the split rows and the leaves' values of a pruned one.

    ``grown`` is the pruned tree, perhaps with more split leaves; ``values`` are its channels. Cells below its
    leaves become unsplit.
    """
    flags = tree.arrays.flags & np.uint8(~SPLIT & 0xFF)
    flags[pruned.cells] = grown.arrays.flags
    split = grown.split._replace(cells=pruned.cells[grown.split.cells].astype(np.uint32))
    grafted_channels = {}
    for name, channel in channels.items():
        copy = large.copied(channel.values)
        copy[pruned.cells[pruned.leaves]] = values[name].values[pruned.leaves]
        grafted_channels[name] = channel._replace(values=copy, split_values=values[name].split_values)
    return tree.with_cell_data(flags, tree.arrays.areas, split), grafted_channels


@kernel
def _leaves_of(codes: Int64s, depths: Uint8s, depth: int) -> tuple[Int64s, Int64s]:
    """Return the first finest cell of each leaf, and the leaf's Morton code at its own level."""
    starts = np.empty(codes.size, np.int64)
    leaves = np.empty(codes.size, np.int64)
    count = 0
    end = np.int64(-1)  # of the latest leaf, as a code of the deepest level
    for n in range(codes.size):
        if codes[n] >= end:
            shift = 3 * (depth - np.int64(depths[n]))
            starts[count] = n
            leaves[count] = codes[n] >> shift
            end = (leaves[count] + 1) << shift
            count += 1
    return starts[:count].copy(), leaves[:count].copy()


def limits_of(finest: Finest, wanted: Uint8s | None) -> Uint8s:
    """Return the deepest level of each finest cell's leaf: that of the highest node without a deeper wish."""
    depth = finest.tree.max_depth
    limits = np.full(finest.codes.size, depth, np.uint8)
    if wanted is not None:
        for level in range(depth - 1, -1, -1):
            shallow = np.maximum.reduceat(wanted, finest.firsts[level]) <= level
            limits[finest.spread(level, shallow)] = level
    return limits
