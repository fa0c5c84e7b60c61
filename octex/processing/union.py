"""The union of two trees, and the origin of each of its cells.

Both trees are walked together, level by level. Their cells are in Morton order, so the union is a merge that
reads and writes every array from front to back.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Int64s, Uint8s
from octex.errors import ArgumentError
from octex.jit import inlined, kernel, popcount
from octex.tree.children import children, groups_of
from octex.tree.edit import facings_of_nodes
from octex.tree.layout import FACING_FLAGS, MAX_CELLS, MAX_DEPTH, TreeArrays
from octex.tree.octree import Octree

#: Origin of a cell that a tree lacks.
NOTHING = -1
#: Origin of a cell below a leaf: this minus the leaf's number.
BELOW = -2

#: Children of a node: those that are nodes, and all, as bits; the next node, and the next cell, of them.
_Children = tuple[int, int, int, int]


class Origins(NamedTuple):
    """The origins of a union's cells in one of the trees."""

    cells: Int64s  # (cells,)   the same cell; NOTHING; or BELOW − the leaf that contains it
    nodes: Int64s  # (nodes,)   the same node; NOTHING; or BELOW − the leaf that it divides or lies in


def unite(first: Octree, second: Octree) -> tuple[Octree, Origins, Origins]:
    """Return the union of two trees, with the facings of both and zero areas, and its cells' origins in each.

    A node of either is a node. Facings come from leaves, and go up from children.
    """
    n_nodes = first.n_nodes + second.n_nodes
    n_cells = first.n_cells + second.n_cells
    masks = np.zeros((2, -(-n_nodes // 8) * 8), np.uint8)
    cells, nodes = np.empty((2, n_cells), np.int64), np.empty((2, n_nodes), np.int64)
    flags = np.zeros(n_cells, np.uint8)
    level_cells, level_nodes = np.zeros((2, MAX_DEPTH + 2), np.int64)
    _unite(first.arrays, second.arrays, masks, cells, nodes, flags, level_cells, level_nodes)
    depth = max(first.max_depth, second.max_depth)
    level_cells, level_nodes = level_cells[: depth + 2].copy(), level_nodes[: depth + 2].copy()
    n_cells, n_nodes = int(level_cells[-1]), int(level_nodes[-1])
    if n_cells > MAX_CELLS:
        raise ArgumentError(f"{n_cells:,} cells together are more than a tree can hold")
    groups = groups_of(masks[:, : -(-n_nodes // 8) * 8])
    areas = np.zeros(n_cells, np.uint8)
    tree = Octree(TreeArrays(groups, level_cells, level_nodes, flags[:n_cells], areas))
    first_origins, second_origins = map(Origins, cells[:, :n_cells], nodes[:, :n_nodes])
    if any((origins.nodes < NOTHING).any() for origins in (first_origins, second_origins)):
        # Some nodes were leaves, whose facings other cells lack.
        tree = tree.with_cell_data(facings_of_nodes(tree), areas)
    return tree, first_origins, second_origins


@kernel
def _unite(
    first: TreeArrays,
    second: TreeArrays,
    masks: Uint8s,
    cells: Int64s,
    nodes: Int64s,
    flags: Uint8s,
    level_cells: Int64s,
    level_nodes: Int64s,
) -> None:
    """Merge two trees; damaged trees cannot make it read or write outside the arrays."""
    ours = int(first.level_nodes[-1] > 0), 1, 0, 0  # the root, as an only child
    theirs = int(second.level_nodes[-1] > 0), 1, 0, 0
    is_node = ours[0] | theirs[0]
    cells[0, 0], one, our_facings, _ = _child(first, NOTHING, ours, 1, is_node)
    cells[1, 0], other, their_facings, _ = _child(second, NOTHING, theirs, 1, is_node)
    flags[0] = (our_facings | their_facings) & FACING_FLAGS
    if is_node:
        nodes[0, 0], nodes[1, 0] = one, other
    n_cells, n_nodes, done = 1, is_node, 0
    level_cells[1], level_nodes[1] = n_cells, n_nodes
    for level in range(1, level_cells.size - 1):
        for node in range(done, n_nodes):
            one, other = nodes[0, node], nodes[1, node]
            ours, theirs = _children(first, one), _children(second, other)
            is_node, is_stored = ours[0] | theirs[0], ours[1] | theirs[1]
            masks[0, node] = is_node
            masks[1, node] = is_stored & ~is_node
            for octant in range(8):
                bit = 1 << octant
                if is_stored & bit == 0 or n_cells == flags.size:
                    continue
                our_cell, our_node, our_facings, ours = _child(first, one, ours, bit, is_node)
                their_cell, their_node, their_facings, theirs = _child(second, other, theirs, bit, is_node)
                cells[0, n_cells], cells[1, n_cells] = our_cell, their_cell
                flags[n_cells] = (our_facings | their_facings) & FACING_FLAGS
                n_cells += 1
                if is_node & bit != 0 and n_nodes < masks.shape[1] and n_nodes < nodes.shape[1]:
                    nodes[0, n_nodes], nodes[1, n_nodes] = our_node, their_node
                    n_nodes += 1
        done = level_nodes[level]
        level_cells[level + 1], level_nodes[level + 1] = n_cells, n_nodes


@inlined
def _children(tree: TreeArrays, node: int) -> _Children:
    """Return a node's children that are nodes, and all, as bits, and the first of both; zeros for no node."""
    if node < 0 or node >= tree.level_nodes[-1]:
        return 0, 0, 0, 0
    inner, stored, first_node, first_cell = children(tree.groups, node)
    return int(np.int64(inner)), int(np.int64(stored)), first_node, first_cell


@inlined
def _child(
    tree: TreeArrays, parent: int, rest: _Children, bit: int, is_node: int
) -> tuple[int, int, int, _Children]:
    """Return a child's origins as a cell and as a node, its facings, and the children after it."""
    inner, stored, node, cell = rest
    if stored & bit == 0:
        return min(parent, NOTHING), min(parent, NOTHING), 0, rest
    number = min(cell, tree.flags.size - 1)
    facings = int(np.int64(tree.flags[number])) if inner & bit == is_node & bit else 0
    if inner & bit == 0:
        return number, BELOW - number, facings, (inner, stored, node, cell + 1)
    return number, node, facings, (inner, stored, node + 1, cell + 1)


@kernel
def take(
    first_cells: Int64s, second_cells: Int64s, share: Float32s, first: Uint8s, second: Uint8s, taken: Uint8s
) -> None:
    """Copy rows of bytes from the side with the larger share, or from the only side that has the cell."""
    for n in range(taken.shape[0]):
        source = second_cells[n]
        if source >= 0 and (share[n] >= 0.5 or first_cells[n] < 0):
            for k in range(taken.shape[1]):
                taken[n, k] = second[source, k]
        elif first_cells[n] >= 0:
            source = first_cells[n]
            for k in range(taken.shape[1]):
                taken[n, k] = first[source, k]


@kernel
def find_mixed_nodes(
    arrays: TreeArrays,
    nodes: Int64s,
    first_nodes: Int64s,
    second_nodes: Int64s,
    share: Float32s,
    is_mixed: Bools,
    is_mixed_node: Bools,
) -> None:
    """Find the nodes whose content mixes both textures, from the deepest level up.

    It also sets ``is_mixed`` (cells,), which leaves have on entry, for these nodes, and a ``share`` of 0 or 1
    for the others.
    """
    groups = arrays.groups
    end = share.size
    for node in range(nodes.size - 1, -1, -1):
        _, stored, _, _ = children(groups, node)
        begin = max(end - popcount(stored), 0)
        part = share[begin]
        mixes = (second_nodes[node] if part > 0.5 else first_nodes[node]) < 0
        for child in range(begin, end):
            mixes |= is_mixed[child] or share[child] != part
        is_mixed_node[node] = is_mixed[nodes[node]] = mixes
        if not mixes:
            share[nodes[node]] = part
        end = begin
