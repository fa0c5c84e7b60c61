"""The union of two trees, and the origin of each of its cells.

Both trees are walked together, level by level. Their cells are in Morton order, so the union is a merge that
reads and writes every array from front to back.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Int64s, Uint8s
from octex.errors import ArgumentError
from octex.jit import kernel, popcount
from octex.tree.children import children, groups_of
from octex.tree.edit import facings_of_nodes
from octex.tree.layout import FACING_FLAGS, MAX_CELLS, MAX_DEPTH, TreeArrays
from octex.tree.octree import Octree

#: Origin of a cell that a tree lacks.
NOTHING = -1
#: Origin of a cell below a leaf: this minus the leaf's number.
BELOW = -2


class Origins(NamedTuple):
    """The origins of a union's cells in one of the trees."""

    cells: Int64s  # (cells,)   the same cell; NOTHING; or BELOW − the leaf that contains it
    nodes: Int64s  # (nodes,)   the same node; NOTHING; or BELOW − the leaf that it divides or lies in


class Union(NamedTuple):
    """The union of two trees."""

    tree: Octree  # facings of both trees; areas are zero
    first: Origins
    second: Origins


def unite(first: Octree, second: Octree) -> Union:
    """Unite two trees: a node of either is a node. Facings come from leaves, and go up from children."""
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
    one, other = (Origins(cells[each, :n_cells], nodes[each, :n_nodes]) for each in range(2))
    if (one.nodes < NOTHING).any() or (other.nodes < NOTHING).any():  # leaves, whose facings other cells lack
        tree = tree.with_cell_data(facings_of_nodes(tree), areas)
    return Union(tree, one, other)


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
    one_ends = first.level_nodes[-1]
    other_ends = second.level_nodes[-1]
    n_cells, n_nodes = 1, 0
    cells[0, 0] = cells[1, 0] = 0
    one_facing = int(np.int64(first.flags[0])) & FACING_FLAGS
    other_facing = int(np.int64(second.flags[0])) & FACING_FLAGS
    if one_ends > 0 or other_ends > 0:
        n_nodes = 1
        nodes[0, 0] = 0 if one_ends > 0 else BELOW
        nodes[1, 0] = 0 if other_ends > 0 else BELOW
        one_facing = one_facing if one_ends > 0 else 0
        other_facing = other_facing if other_ends > 0 else 0
    flags[0] = one_facing | other_facing
    one_cell = one_node = other_cell = other_node = 1  # the next of each
    level_cells[1], level_nodes[1] = n_cells, n_nodes
    done = 0
    for level in range(1, level_cells.size - 1):
        for node in range(done, n_nodes):
            one, other = nodes[0, node], nodes[1, node]
            one_nodes, one_leaves = _children(first, one)
            other_nodes, other_leaves = _children(second, other)
            is_node = one_nodes | other_nodes
            is_leaf = (one_leaves | other_leaves) & ~is_node
            masks[0, node] = is_node
            masks[1, node] = is_leaf
            for octant in range(8):
                bit = 1 << octant
                if (is_node | is_leaf) & bit == 0 or n_cells == flags.size:
                    continue
                one_below, other_below = min(one, NOTHING), min(other, NOTHING)  # the origin of children
                one_here, other_here = one_below, other_below
                facing = 0
                if (one_nodes | one_leaves) & bit != 0:
                    one_here = min(one_cell, first.flags.size - 1)
                    one_cell += 1
                    one_below = BELOW - one_here
                    if one_nodes & bit != 0:
                        one_below = one_node
                        one_node += 1
                    if one_nodes & bit == is_node & bit:
                        facing |= int(np.int64(first.flags[one_here]))
                if (other_nodes | other_leaves) & bit != 0:
                    other_here = min(other_cell, second.flags.size - 1)
                    other_cell += 1
                    other_below = BELOW - other_here
                    if other_nodes & bit != 0:
                        other_below = other_node
                        other_node += 1
                    if other_nodes & bit == is_node & bit:
                        facing |= int(np.int64(second.flags[other_here]))
                cells[0, n_cells], cells[1, n_cells] = one_here, other_here
                flags[n_cells] = facing & FACING_FLAGS
                n_cells += 1
                if is_node & bit != 0 and n_nodes < masks.shape[1] and n_nodes < nodes.shape[1]:
                    nodes[0, n_nodes], nodes[1, n_nodes] = one_below, other_below
                    n_nodes += 1
        done = level_nodes[level]
        level_cells[level + 1], level_nodes[level + 1] = n_cells, n_nodes


@kernel
def _children(arrays: TreeArrays, node: int) -> tuple[int, int]:
    """Return a node's masks of child nodes and child leaves; zeros for no node."""
    if node < 0 or node >= arrays.level_nodes[-1]:
        return 0, 0
    shift = np.uint64(8 * (node & 7))
    nodes, leaves = arrays.groups[node >> 3, 0], arrays.groups[node >> 3, 1]
    below = np.uint64(0xFF)
    return int(np.int64(nodes >> shift & below)), int(np.int64(leaves >> shift & below))


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
def find_made(
    arrays: TreeArrays,
    nodes: Int64s,
    first_nodes: Int64s,
    second_nodes: Int64s,
    share: Float32s,
    is_mixed: Bools,
    is_made: Bools,
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
        made = (second_nodes[node] if part > 0.5 else first_nodes[node]) < 0
        for child in range(begin, end):
            made |= is_mixed[child] or share[child] != part
        is_made[node] = is_mixed[nodes[node]] = made
        if not made:
            share[nodes[node]] = part
        end = begin
