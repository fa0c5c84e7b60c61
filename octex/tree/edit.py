"""Trees made from trees: leaves raised to nodes, cells added and dropped (paper 4.1, steps 2, 4, 5 and 7).

Trees are immutable: an edit returns a new one, and which of its cells were in the old one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Int64s, Uint8s
from octex.jit import inlined, kernel
from octex.tree.areas import SKIRT
from octex.tree.children import gather_facings, node_cells
from octex.tree.layout import FACING_FLAGS, KEPT, MAX_DEPTH, KeptTable, TreeArrays
from octex.tree.octree import Octree, distinct
from octex.tree.search import child
from octex.tree.split import taken


class Edited(NamedTuple):
    """A tree made from another, with the flags, areas, split cells and kept nodes that it shares with it."""

    tree: Octree
    old: Int64s  # (cells,)   each cell's number in the old tree; −1: it was not there
    split_rows: Bools  # (rows of the old split table,)   which stay
    kept_rows: Bools  # (rows of the old kept table,)   which stay

    def carried(self, values: Array) -> Array:
        """Return the old cells' values (cells, …) for the new cells; zeros for new ones."""
        carried_values = values.take(self.old, axis=0, mode="clip")
        carried_values[self.old < 0] = 0
        return carried_values


class Located(NamedTuple):
    """Where cells of one level are in a tree."""

    cells: Int64s  # (n,)   the deepest stored cell that holds each, down to this level
    levels: Int64s  # (n,)   that cell's level
    nodes: Int64s  # (n,)   its number among nodes; −1 for a leaf

    @property
    def is_leaf(self) -> Bools:
        """Which of these cells are leaves."""
        leaves: Bools = self.nodes < 0
        return leaves

    def of(self, chosen: Bools) -> Located:
        """Select cells."""
        return Located(self.cells[chosen], self.levels[chosen], self.nodes[chosen])


def locate(tree: Octree, codes: Int64s, level: int) -> Located:
    """Find cells (n,) of a level, or the deepest stored cells that contain them, by Morton code."""
    cells, levels, nodes = np.empty((3, codes.size), np.int64)
    _locate(tree.arrays, codes, level, cells, levels, nodes)
    return Located(cells, levels, nodes)


@kernel
def _locate(
    arrays: TreeArrays, codes: Int64s, level: int, cells: Int64s, levels: Int64s, nodes: Int64s
) -> None:
    deepest = min(level, arrays.level_cells.size - 2)
    path = np.zeros((MAX_DEPTH + 1, 2), np.int64)  # cell and node at each level on the way to the code before
    path[0, 1] = 0 if arrays.groups.shape[0] > 0 else -1
    reached, previous = 0, np.int64(0)
    for n in range(codes.size):
        code = codes[n]
        while (code ^ previous) >> (3 * (level - reached)) != 0:
            reached -= 1
        previous = code
        while path[reached, 1] >= 0 and reached < deepest:
            cell, node = child(arrays, path[reached, 1], code >> (3 * (level - 1 - reached)) & 7)
            if cell < 0:
                break
            reached += 1
            path[reached, 0], path[reached, 1] = cell, node
        cells[n], levels[n], nodes[n] = path[reached, 0], reached, path[reached, 1]


def unchanged(tree: Octree) -> Edited:
    """Return a tree as an edit without changes."""
    rows = np.ones(tree.split.areas.size, np.bool_)
    return Edited(tree, np.arange(tree.n_cells), rows, np.ones(tree.kept.cells.size, np.bool_))


def cull(tree: Octree, is_kept: Bools) -> Edited:
    """Return the tree of some of its leaves (paper 4.1, step 7), without nodes that lose all leaves.

    ``is_kept`` (cells,) selects leaves; its values for nodes do not count.
    """
    leaves = [
        codes[~is_node & is_kept[tree.cells_at(level)]] for level, (codes, is_node) in enumerate(tree.walk())
    ]
    return rebuilt(tree, leaves)


def raised(
    tree: Octree,
    wanted: Sequence[Int64s],
    met: Sequence[Int64s],
    added: Sequence[Int64s],
    freed: Sequence[Int64s] = (),
) -> Edited:
    """Return a tree that goes down to wanted cells, by splitting the leaves above them (paper 4.1, step 4).

    All arguments are ascending Morton codes for each level:

    wanted   cells below leaves of the tree
    met      of all cells below these leaves, the ones to store
    added    leaves to add where the tree has nothing
    freed    leaves of the tree that become nodes without a kept coefficient

    A leaf without ``met`` cells below stays. Nodes that were leaves, and new nodes below these or below kept
    nodes, are flagged KEPT. The caller fills in their coefficients, in the order of the kept table.
    """
    depth = max(tree.max_depth, len(wanted) - 1, len(added) - 1)
    none = np.empty(0, np.int64)
    wanted, met, added, freed = (
        [*each, *[none] * (depth + 1 - len(each))] for each in (wanted, met, added, freed)
    )
    node_codes = [none] * (depth + 2)
    for level in range(depth, 0, -1):
        node_codes[level - 1] = distinct(np.concatenate([node_codes[level], wanted[level]]) >> 3)
    walk = tree.walk()
    above_added = [none] * (depth + 1)  # new nodes below kept ones
    if tree.kept.cells.size:
        above = none
        for level in range(depth, 0, -1):
            above = distinct(np.concatenate([above, added[level]]) >> 3)
            located = locate(tree, above, level - 1)
            is_kept = tree.arrays.flags[located.cells] & KEPT != 0
            above_added[level - 1] = above[is_kept & (located.levels < level - 1)]
    leaves: list[Int64s] = []
    kept_codes: list[Int64s] = []  # nodes that were leaves, and below them
    raised_codes = freed_above = none  # those of the level above
    for level in range(depth + 1):
        codes, is_node = next(walk, (none, np.empty(0, np.bool_)))
        old_leaves = codes[~is_node]
        below = met[level + 1] >> 3 if level < depth else none
        is_raised = among(old_leaves, node_codes[level]) & among(old_leaves, below)
        child_codes = (raised_codes[:, None] << 3 | np.arange(8)).reshape(-1)
        child_codes = child_codes[among(child_codes, met[level])]
        is_inner = among(child_codes, node_codes[level]) & among(child_codes, below)
        leaves.append(_merged(old_leaves[~is_raised], child_codes[~is_inner], added[level]))
        raised_codes = _merged(old_leaves[is_raised], child_codes[is_inner])
        is_freed = among(raised_codes >> 3, freed_above) | among(raised_codes, freed[level])
        kept_codes.append(_merged(raised_codes[~is_freed], above_added[level]))
        freed_above = raised_codes[is_freed]
    return _with_kept(rebuilt(tree, leaves), kept_codes)


def _merged(*codes: Int64s) -> Int64s:
    """Return codes of several ascending runs in order."""
    return np.sort(np.concatenate(codes), kind="stable")


def among(codes: Int64s, known: Int64s) -> Bools:
    """Return which codes (n,) are among ascending ones."""
    if not known.size or not codes.size:
        return np.zeros(codes.size, np.bool_)
    is_known: Bools = indices_in(codes, known) >= 0
    return is_known


def indices_in(codes: Int64s, known: Int64s) -> Int64s:
    """Return the index of each code (n,) among ascending ones, −1 for none.

    Fastest, a tenth of numpy's time, if the codes ascend or nearly do.
    """
    indices = np.empty(codes.size, np.int64)
    _indices_in(np.ascontiguousarray(codes), np.ascontiguousarray(known), indices)
    return indices


@kernel
def _indices_in(codes: Int64s, known: Int64s, indices: Int64s) -> None:
    index = 0
    for n in range(codes.size):
        index = first_not_below(known, codes[n], index)
        indices[n] = index if index < known.size and known[index] == codes[n] else -1


@inlined
def first_not_below(known: Int64s, code: int, start: int) -> int:
    """Return the index of the first of ascending codes that is not below ``code``.

    Steps from ``start`` double, then the last one is bisected: it is fast if the index is near ``start``.
    """
    low = high = start
    step = 1
    if low < known.size and known[low] < code:
        while high < known.size and known[high] < code:
            low, high = high + 1, high + step
            step *= 2
        high = min(high, known.size)
    else:
        while low > 0 and known[low - 1] >= code:
            high, low = low - 1, max(low - step, 0)
            step *= 2
    while low < high:
        middle = (low + high) // 2
        if known[middle] < code:
            low = middle + 1
        else:
            high = middle
    return low


def with_all_above(codes: Sequence[Int64s]) -> list[Int64s]:
    """Return cells, listed level by level, with all cells above them; ascending."""
    levels = []
    above = np.empty(0, np.int64)
    for cells in reversed(codes):
        levels.append(distinct(np.concatenate([cells, above])))
        above = levels[-1] >> 3
    return levels[::-1]


def rebuilt(tree: Octree, leaves: Sequence[Int64s]) -> Edited:
    """Build a tree of other leaves, ascending Morton codes by level, and carry over all shared cell data."""
    built = Octree.from_levels(leaves)
    n_old = tree.n_cells
    old_cells = np.full(built.n_cells, -1, np.int64)
    is_node = np.zeros(built.n_cells, np.bool_)
    for level, ((codes, nodes), (old_codes, _)) in enumerate(zip(built.walk(), tree.walk(), strict=False)):
        of_level = built.cells_at(level)
        is_node[of_level] = nodes & (built.n_leaves > 0)  # a root without children keeps nothing
        indices = indices_in(codes, old_codes)
        old_cells[of_level] = np.where(indices >= 0, indices + tree.level_cells[level], -1)
    del codes, nodes, old_codes, indices  # at the deepest level as large as half of the arrays below
    flags, areas = np.zeros((2, built.n_cells), np.uint8)
    shared = np.flatnonzero(old_cells >= 0)
    old_shared = old_cells[shared]
    flags[shared], areas[shared] = tree.arrays.flags[old_shared], tree.arrays.areas[old_shared]
    flags[shared[~is_node[shared]]] &= np.uint8(0xFF ^ KEPT)
    new_cells = np.full(n_old, -1, np.int64)
    new_cells[old_shared] = shared
    split, split_rows = taken(tree.split, new_cells[tree.split.cells])
    kept_cells = new_cells[tree.kept.cells]
    kept_rows = (kept_cells >= 0) & is_node[kept_cells]
    kept = KeptTable(kept_cells[kept_rows].astype(np.uint32))
    return Edited(built.with_cell_data(flags, areas, split, kept), old_cells, split_rows, kept_rows)


def _with_kept(edited: Edited, nodes: Sequence[Int64s]) -> Edited:
    """Flag nodes, listed by level, as KEPT, in addition to kept ones."""
    tree = edited.tree
    cells = [tree.kept.cells.astype(np.int64)]
    for first, (codes, _), kept_codes in zip(tree.arrays.level_cells, tree.walk(), nodes, strict=False):
        cells.append(first + np.searchsorted(codes, kept_codes))
    kept = np.sort(np.concatenate(cells))
    flags = tree.arrays.flags.copy()
    flags[kept] |= np.uint8(KEPT)
    table = KeptTable(kept.astype(np.uint32))
    return edited._replace(tree=tree.with_cell_data(flags, tree.arrays.areas, tree.split, table))


def facings_of_nodes(tree: Octree) -> Uint8s:
    """Return the cells' flags (cells,) with the facings of nodes recomputed from their children."""
    return _gathered(tree, tree.arrays.flags.copy())


def facings_of_skirts(tree: Octree) -> Uint8s:
    """Return the facings (cells,) that only skirts have, in a cell or below a node."""
    with_surface = np.where(tree.arrays.areas == SKIRT, np.uint8(0), tree.arrays.flags)
    return facings_of_nodes(tree) & ~_gathered(tree, with_surface) & np.uint8(FACING_FLAGS)


def _gathered(tree: Octree, flags: Uint8s) -> Uint8s:
    """Write the facings of nodes, those of their children, to flags (cells,), and return these."""
    if tree.max_depth:
        gather_facings(tree.arrays.groups, node_cells(tree.arrays), flags, flags)
    return flags
