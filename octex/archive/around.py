"""What lies around the nodes of a block, and around their children.

A block is a run of nodes of one level. Around a node are the six cells of its level that it shares faces
with, in the order −x, +x, −y, +y, −z, +z. They are found from the root down, for the block's ancestors alone,
so that a block needs the levels above it and nothing else.
"""

from __future__ import annotations

import numpy as np

from octex.archive.layout import Block
from octex.arrays import Int32s, Uint32s, Uint64s
from octex.jit import inlined, kernel, part, popcount
from octex.tree.children import children
from octex.tree.layout import MAX_CELLS, TreeArrays

# A row of what is known of a node: the cells around it, its own, and the nodes around it. Its own cell stands
# also where there is none, NO_NODE where there is no node.
OWN, NODES = 6, 7
_AROUND = 13
NO_NODE = MAX_CELLS
# A row of what is known of a child: which of the block's cells lies across its faces −x, −y and −z, −1 for
# none; then ABOUT: bits 0 … 3 how many children of its node are left, with itself, 4 whether any of these is
# a node, 5 … 7 its octant; 8 … 13 of each axis whether a cell lies beyond its node, and a sibling.
ABOUT = 3


@inlined
def children_of(groups: Uint64s, node: int) -> tuple[int, int, int, int]:
    """Return as `children` which children of a node are nodes, which are stored, and the first of both."""
    nodes, stored, first_node, first_cell = children(groups, node)
    return int(np.int64(nodes)), int(np.int64(stored)), first_node, first_cell


@inlined
def ones(mask: int) -> int:
    """Count a mask's bits."""
    return popcount(np.uint64(mask))


@inlined
def before(mask: int, place: int) -> int:
    """Count a mask's bits before a place."""
    return popcount(np.uint64(mask & (1 << place) - 1))


@inlined
def lowest(mask: int) -> int:
    """Return the place of a mask's lowest bit, of one that has any."""
    return popcount(np.uint64(~mask & mask - 1))


@part
def _descended(groups: Uint64s, begin: int, above: Uint32s, first: int, last: int, below: Uint32s) -> None:
    """Write what lies around nodes ``first`` to ``last``, children of those from ``begin`` on."""
    room = np.empty((4, 7), np.int64)
    inner, stored, next_node, next_cell = room[0], room[1], room[2], room[3]
    for row in range(above.shape[0]):
        inner[OWN], stored[OWN], next_node[OWN], next_cell[OWN] = children_of(groups, begin + row)
        for k in range(6):
            node = int(np.int64(above[row, NODES + k]))
            inner[k] = stored[k] = 0
            if node != NO_NODE:
                inner[k], stored[k], next_node[k], next_cell[k] = children_of(groups, node)
        child, bits = next_node[OWN], inner[OWN]
        while bits:
            octant = lowest(bits)
            bits &= bits - 1
            if first <= child < last:
                own, cell = np.uint64(child - first), next_cell[OWN] + before(stored[OWN], octant)
                below[own, OWN] = cell
                for k in range(6):
                    across = octant ^ 1 << (k >> 1)
                    at = np.uint64(k if octant >> (k >> 1) & 1 == k & 1 else OWN)  # else a sibling
                    other, node = next_cell[at] + before(stored[at], across), next_node[at]
                    node += before(inner[at], across)
                    below[own, k] = other if stored[at] >> across & 1 else cell
                    below[own, NODES + k] = node if inner[at] >> across & 1 else NO_NODE
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


@kernel
def around_nodes(arrays: TreeArrays, block: Block) -> Uint32s:
    """Return a row for each of a block's nodes (n, 13). Reads the levels above."""
    groups, level_nodes, level = arrays.groups, arrays.level_nodes, block.level
    runs = np.empty((level + 1, 2), np.int64)
    runs[level, 0], runs[level, 1] = block.first, block.last
    for above in range(level - 1, -1, -1):
        low, high = level_nodes[above], level_nodes[above + 1]
        runs[above, 0] = _parent(groups, low, high, runs[above + 1, 0])
        runs[above, 1] = _parent(groups, low, high, runs[above + 1, 1] - 1) + 1
    around = np.zeros((1, _AROUND), np.uint32)
    around[0, NODES:] = NO_NODE
    for above in range(level):
        begin, end = runs[above + 1, 0], runs[above + 1, 1]
        below = np.empty((end - begin, _AROUND), np.uint32)
        _descended(groups, runs[above, 0], around, begin, end, below)
        around = below
    return around


@kernel
def around_children(arrays: TreeArrays, block: Block, around: Uint32s) -> Int32s:
    """Return a row for each child of the nodes of a block, in order."""
    first, begin, count = block.first, block.begin.cell, block.last - block.first
    rows = np.empty((block.end.cell - begin, 4), np.int32)
    stored, firsts = np.empty(count, np.uint8), np.empty(count, np.int32)
    has_nodes = np.empty(count, np.uint8)
    for n in range(count):
        inner, mask, _, cell = children_of(arrays.groups, first + n)
        has_nodes[n], stored[n], firsts[n] = inner != 0, mask, cell - begin
    masks, begins = np.zeros(7, np.int64), np.zeros(7, np.int64)
    t = 0
    for own in range(count):
        masks[OWN], begins[OWN] = stored[own], firsts[own]
        for k in range(6):
            beyond = np.int64(around[own, NODES + k]) - first
            masks[k], begins[k] = 0xFF if around[own, k] != around[own, OWN] else 0, -1
            if 0 <= beyond < count:
                masks[k], begins[k] = stored[beyond], firsts[beyond]
        left = ones(masks[OWN])
        bits = masks[OWN]
        while bits:
            octant = lowest(bits)
            bits &= bits - 1
            about, row = left | np.int64(has_nodes[own]) << 4 | octant << 5, np.uint64(t)
            for axis in range(3):
                across = octant ^ 1 << axis
                upper = octant >> axis & 1
                beyond = masks[np.uint64(2 * axis + upper)] >> across & 1
                about |= ((masks[OWN] >> across & 1) << 1 | beyond) << 2 * axis + 8
                at = np.uint64(OWN if upper else 2 * axis)
                other = begins[at] + before(masks[at], across)
                is_beside = (masks[at] >> across & 1) & np.int64(begins[at] >= 0)
                rows[row, axis] = other if is_beside else -1
            rows[row, ABOUT] = about
            left -= 1
            t += 1
    return rows
