"""Sets of nodes of a tree, and the rows of split ones, level by level."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Int64s, in_runs
from octex.tree.children import children_of, node_cells
from octex.tree.edit import locate
from octex.tree.octree import Octree
from octex.tree.split import Rows, rows_of


class Nodes(NamedTuple):
    """A set of nodes of a tree, in ascending order."""

    numbers: Int64s  # (n,)   among its nodes, ascending
    cells: Int64s  # (n,)   among its cells, ascending

    def of(self, chosen: Bools) -> Nodes:
        """Return the nodes that a mask selects."""
        return Nodes(self.numbers[chosen], self.cells[chosen])


def all_nodes(tree: Octree) -> Nodes:
    """Return all nodes of a tree."""
    return Nodes(np.arange(tree.n_nodes), node_cells(tree.arrays))


def all_leaves(tree: Octree) -> Bools:
    """Return which cells (cells,) of a tree are leaves."""
    is_leaf = np.ones(tree.n_cells, np.bool_)
    is_leaf[node_cells(tree.arrays)] = False
    return is_leaf


def nodes_at(tree: Octree, codes: Sequence[Int64s]) -> Nodes:
    """Return the nodes of a tree at places (n,), listed as Morton codes by level.

    Without a node there, the number is −1, and the cell is the one that contains the place.
    """
    found_nodes = [Nodes(np.empty(0, np.int64), np.empty(0, np.int64))]
    for level, level_codes in enumerate(codes):
        if level_codes.size:
            located = locate(tree, level_codes, level)
            found_nodes.append(Nodes(np.where(located.levels == level, located.nodes, -1), located.cells))
    return Nodes(*(np.concatenate(column) for column in zip(*found_nodes, strict=True)))


def by_level(tree: Octree, nodes: Nodes) -> list[slice]:
    """Return the slice of each level that has nodes, from the root on."""
    ends = np.searchsorted(nodes.numbers, tree.arrays.level_nodes[: tree.max_depth + 1])
    return [slice(begin, end) for begin, end in pairwise(ends.tolist()) if begin < end]


def all_children(tree: Octree, numbers: Int64s) -> tuple[Int64s, Int64s]:
    """Return the children (m,) of the nodes with these numbers (n,), and the start of each node's (n,)."""
    firsts, counts = children_of(tree.arrays.groups, numbers)
    return in_runs(firsts, counts), np.cumsum(counts) - counts


def rows_by_level(tree: Octree, nodes: Nodes) -> Iterator[tuple[slice, Rows, Int64s]]:
    """Yield, from the root down, the slice of a level in all rows of the nodes, these rows, and owners.

    The owners (n,) are the numbers of the rows' nodes.
    """
    if not tree.split.cells.size:
        return
    rows = rows_of(tree.split, nodes.cells)
    owners = np.searchsorted(nodes.cells, rows.cells)
    for of_level in by_level(tree, nodes):
        span = slice(*np.searchsorted(owners, [of_level.start, of_level.stop]).tolist())
        if span.start < span.stop:
            yield span, rows.of(span), nodes.numbers[owners[span]]
