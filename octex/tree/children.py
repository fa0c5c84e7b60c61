"""The children of a node, counted from the flags of its group: see `tree.layout`."""

from __future__ import annotations

import numpy as np

from octex.arrays import Int64s, Uint8s, Uint64s
from octex.jit import inlined, kernel, popcount
from octex.tree.layout import FACING_FLAGS, TreeArrays


@inlined
def rank_in(mask: np.uint64, bit: int | np.uint64) -> int:
    """Count a mask's bits below a bit: a child's number among those stored."""
    return popcount(mask & ((np.uint64(1) << np.uint64(bit)) - np.uint64(1)))


@inlined
def children(groups: Uint64s, node: int) -> tuple[np.uint64, np.uint64, int, int]:
    """Return a node's child nodes and stored children, as bits, and the first of both.

    A number beyond the groups is clamped.
    """
    group = np.uint64(min(max(node >> 3, 0), groups.shape[0] - 1))
    shift = np.uint64(8 * (node & 7))
    nodes, firsts = groups[group, 0], groups[group, 2]
    cells = nodes | groups[group, 1]
    first_node = int(np.int64(firsts & np.uint64(0xFFFFFFFF))) + rank_in(nodes, shift)
    first_cell = int(np.int64(firsts >> np.uint64(32))) + rank_in(cells, shift)
    return nodes >> shift & np.uint64(0xFF), cells >> shift & np.uint64(0xFF), first_node, first_cell


@kernel
def children_of(groups: Uint64s, nodes: Int64s) -> tuple[Int64s, Int64s]:
    """Return the first child of nodes (n,), by node number, and their numbers of children."""
    firsts, counts = np.empty(nodes.size, np.int64), np.empty(nodes.size, np.int64)
    for n in range(nodes.size):
        _, stored, _, firsts[n] = children(groups, nodes[n])
        counts[n] = popcount(stored)
    return firsts, counts


def masks_of(groups: Uint64s, word: int) -> Uint8s:
    """Return a byte for each node: its children that are nodes (word 0), or leaves (word 1)."""
    return np.ascontiguousarray(groups[:, word]).astype("<u8", copy=False).view(np.uint8)


def octants_of(masks: Uint8s) -> tuple[Int64s, Uint8s]:
    """List the children (m,) in masks (n,): the index of each child's mask, and its octant."""
    bits = np.flatnonzero(np.unpackbits(masks, bitorder="little").view(np.bool_))
    return bits >> 3, (bits & 7).astype(np.uint8)


def groups_of(masks: Uint8s) -> Uint64s:
    """Return the groups for masks of nodes (2, a multiple of 8), as `masks_of` returns them."""
    groups = np.zeros((masks.shape[1] // 8, 3), np.uint64)
    for word in range(2):
        groups[:, word] = masks[word].view("<u8")
    rank(groups)
    return groups


@kernel
def rank(groups: Uint64s) -> None:
    """Fill in each group's first child node and first child cell; the root is node 0 and cell 0."""
    child_node = child_cell = np.int64(1)
    for g in range(groups.shape[0]):
        groups[g, 2] = np.uint64(child_node) | np.uint64(child_cell) << np.uint64(32)
        child_node += popcount(groups[g, 0])
        child_cell += popcount(groups[g, 0] | groups[g, 1])


@kernel
def gather_facings(groups: Uint64s, cells: Int64s, flags: Uint8s, gathered: Uint8s) -> None:
    """Write nodes' ``flags``, with the facings of their children, to ``gathered``; it may be ``flags``."""
    end = flags.size
    for node in range(cells.size - 1, -1, -1):
        _, stored, _, _ = children(groups, node)
        begin = max(end - popcount(stored), 0)
        facings = 0
        for child in range(begin, end):
            facings |= int(np.int64(flags[child]))
        cell = cells[node]
        gathered[cell] = int(np.int64(flags[cell])) & ~FACING_FLAGS | facings & FACING_FLAGS
        end = begin


@kernel
def children_before(groups: Uint64s, nodes: Int64s) -> tuple[Int64s, Int64s]:
    """Return how many cells, and how many nodes, come before the children of nodes (n,).

    These are the numbers of the first of them. The node after the last counts as one.
    """
    cells, numbers = np.empty(nodes.size, np.int64), np.empty(nodes.size, np.int64)
    for n in range(nodes.size):
        node = min(nodes[n], 8 * np.int64(groups.shape[0]) - 1)
        inner, stored, numbers[n], cells[n] = children(groups, node)
        if node < nodes[n]:  # beyond the last group all children come before
            numbers[n] += popcount(inner)
            cells[n] += popcount(stored)
    return cells, numbers


@kernel
def node_cells(arrays: TreeArrays) -> Int64s:
    """Return the cell numbers of all nodes, ascending."""
    groups, last = arrays.groups, np.int64(arrays.flags.size) - 1
    cells = np.zeros(arrays.level_nodes[-1], np.int64)
    count, cell = 1, np.int64(1)
    for node in range(cells.size):
        nodes, stored, _, _ = children(groups, node)
        while nodes != np.uint64(0) and count < cells.size:
            lowest = nodes & (~nodes + np.uint64(1))
            nodes ^= lowest
            cells[count] = min(cell + popcount(stored & (lowest - np.uint64(1))), last)
            count += 1
        cell += popcount(stored)
    return cells
