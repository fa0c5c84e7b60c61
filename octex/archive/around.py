"""What lies around the nodes of a block, and around their children.

A block is a run of nodes of one level. Around a node are the six cells of its level that it shares faces
with, in the order −x, +x, −y, +y, −z, +z. They are found from the root down, for the block's ancestors alone,
so that a block needs the levels above it and nothing else.
"""

from __future__ import annotations

import numpy as np

from octex.archive.layout import Block
from octex.arrays import Int32s, Int64s, Uint64s
from octex.jit import inlined, kernel, popcount
from octex.tree.layout import TreeArrays

#: Where a node's own cell stands, after those around it; where there is none, its own stands there too.
OWN = 6
# A row of what is known of a child: which of the block's cells lies across its faces −x, −y and −z, −1 for
# none; then ABOUT: bits 0 … 3 how many children of its node are left, with itself, 4 whether any of these is
# a node, 5 … 7 its octant; 8 … 13 of each axis whether a cell lies beyond its node, and a sibling.
ABOUT = 3


@inlined
def children_of(groups: Uint64s, node: int) -> tuple[int, int, int, int]:
    """Return the masks of a node's children that are nodes, and leaves, its first child node and cell."""
    group = np.uint64(node >> 3)
    shift = np.uint64(8 * (node & 7))
    nodes, leaves, first = groups[group, 0], groups[group, 1], groups[group, 2]
    below = (np.uint64(1) << shift) - np.uint64(1)
    return (
        int(np.int64(nodes >> shift & np.uint64(0xFF))),
        int(np.int64(leaves >> shift & np.uint64(0xFF))),
        int(np.int64(first & np.uint64(0xFFFFFFFF))) + popcount(nodes & below),
        int(np.int64(first >> np.uint64(32))) + popcount((nodes | leaves) & below),
    )


@inlined
def ones(mask: int) -> int:
    """Count a mask's bits."""
    return popcount(np.uint64(mask))


@inlined
def lowest(mask: int) -> int:
    """Return the place of a mask's lowest bit, of one that has any."""
    return popcount(np.uint64(~mask & mask - 1))


def first_below(arrays: TreeArrays, node: int) -> tuple[int, int]:
    """Return the first child node and the first child of a node."""
    first = int(arrays.groups[node >> 3, 2])
    below = (1 << 8 * (node & 7)) - 1
    nodes, leaves = (int(word) & below for word in arrays.groups[node >> 3, :2])
    return (first & 0xFFFFFFFF) + nodes.bit_count(), (first >> 32) + (nodes | leaves).bit_count()


@inlined
def _descended(
    groups: Uint64s,
    begin: int,
    nodes: Int64s,
    first: int,
    last: int,
    cells_below: Int64s,
    nodes_below: Int64s,
    room: Int64s,
) -> None:
    """Write what lies around nodes ``first`` to ``last``, children of those from ``begin`` on."""
    inner, leaves, next_node, next_cell = room[0], room[1], room[2], room[3]
    for row in range(nodes.shape[0]):
        _, _, child, _ = children_of(groups, begin + row)
        for k in range(7):
            node = nodes[row, k] if k < OWN else begin + row
            inner[k] = leaves[k] = 0
            if node >= 0:
                inner[k], leaves[k], next_node[k], next_cell[k] = children_of(groups, node)
        bits = inner[OWN]
        while bits:
            octant = lowest(bits)
            bits &= bits - 1
            if first <= child < last:
                own = np.uint64(child - first)
                cell = next_cell[OWN] + ones((inner[OWN] | leaves[OWN]) & ((1 << octant) - 1))
                cells_below[own, OWN] = cell
                for k in range(6):
                    across = octant ^ 1 << (k >> 1)
                    at = np.uint64(k if octant >> (k >> 1) & 1 == k & 1 else OWN)  # else a sibling
                    there, below = inner[at] | leaves[at], (1 << across) - 1
                    is_there = there >> across & 1
                    cells_below[own, k] = next_cell[at] + ones(there & below) if is_there else cell
                    nodes_below[own, k] = (
                        next_node[at] + ones(inner[at] & below) if inner[at] >> across & 1 else -1
                    )
            child += 1


@inlined
def _parent(groups: Uint64s, low: int, high: int, node: int) -> int:
    """Return the node of ``low`` … ``high`` whose child a node is."""
    high -= 1
    while low < high:
        middle = low + high + 1 >> 1
        if children_of(groups, middle)[2] <= node:
            low = middle
        else:
            high = middle - 1
    return low


def around_nodes(arrays: TreeArrays, block: Block) -> tuple[Int64s, Int64s]:
    """Return the cells (nodes, 7) and nodes (nodes, 6) around a block's nodes; −1 where there is no node.

    Reads the levels above.
    """
    return _around_nodes(arrays.groups, arrays.level_nodes, block.level, block.first, block.last)


@kernel
def _around_nodes(
    groups: Uint64s, level_nodes: Int64s, level: int, first: int, last: int
) -> tuple[Int64s, Int64s]:
    runs, room = np.empty((level + 1, 2), np.int64), np.empty((4, 7), np.int64)
    runs[level, 0], runs[level, 1] = first, last
    for above in range(level - 1, -1, -1):
        low, high = level_nodes[above], level_nodes[above + 1]
        runs[above, 0] = _parent(groups, low, high, runs[above + 1, 0])
        runs[above, 1] = _parent(groups, low, high, runs[above + 1, 1] - 1) + 1
    cells, nodes = np.zeros((1, 7), np.int64), np.full((1, 6), -1, np.int64)
    for above in range(level):
        around, count = nodes, runs[above + 1, 1] - runs[above + 1, 0]
        cells, nodes = np.empty((count, 7), np.int64), np.empty((count, 6), np.int64)
        _descended(groups, runs[above, 0], around, runs[above + 1, 0], runs[above + 1, 1], cells, nodes, room)
    return cells, nodes


@kernel
def around_children(
    groups: Uint64s, first: int, last: int, cells: Int64s, nodes: Int64s, begin: int, rows: Int32s
) -> None:
    """Write a row for each child of the nodes of a block, in order; its first is cell ``begin``."""
    masks, begins = np.zeros(7, np.int64), np.zeros(7, np.int64)
    t = 0
    for node in range(first, last):
        own = np.uint64(node - first)
        inner, leaves, _, cell = children_of(groups, node)
        masks[OWN], begins[OWN] = inner | leaves, cell - begin
        for k in range(6):
            beyond = nodes[own, k]
            masks[k] = 0xFF if cells[own, k] != cells[own, OWN] else 0
            begins[k] = -1
            if first <= beyond < last:
                inner2, leaves2, _, cell2 = children_of(groups, beyond)
                masks[k], begins[k] = inner2 | leaves2, cell2 - begin
        left = ones(masks[OWN])
        bits = masks[OWN]
        while bits:
            octant = lowest(bits)
            bits &= bits - 1
            about, row = left | np.int64(masks[OWN] != leaves) << 4 | octant << 5, np.uint64(t)
            for axis in range(3):
                across = octant ^ 1 << axis
                upper = octant >> axis & 1
                beyond = masks[np.uint64(2 * axis + upper)] >> across & 1
                about |= ((masks[OWN] >> across & 1) << 1 | beyond) << 2 * axis + 8
                at = np.uint64(OWN if upper else 2 * axis)
                is_beside = (masks[at] >> across & 1) & np.int64(begins[at] >= 0)
                rows[row, axis] = begins[at] + ones(masks[at] & ((1 << across) - 1)) if is_beside else -1
            rows[row, ABOUT] = about
            left -= 1
            t += 1
