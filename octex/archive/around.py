"""What lies around the nodes of a block, and around their children.

A block is a run of nodes of one level. Around a node are the 27 cells of its level that touch it, itself in
the middle (number 13; x runs fastest): where each is stored, and which node it is. They are found from the
root down, for the block's ancestors alone, so that a block needs the levels above it and nothing else.
"""

from __future__ import annotations

import numpy as np

from octex.arrays import Int64s, Uint8s, Uint64s
from octex.jit import inlined, kernel, popcount
from octex.tree.layout import TreeArrays

# A row of what lies around a child: cells' numbers, its parent's where none is stored.
PARENT = 0
ABOVE = 1  # ten of the parent's level: across 3 faces, 3 edges and the corner on its side, 3 faces beyond
BESIDE = 11  # three of its own level, stored before it in the same block: −x, −y, −z
LEFT = 14  # how many children of the parent are left, with itself
SHAPE = 15  # which of the six cells across its faces are there, for ``shapes``; bit 6: it is a node
ROW = 16


@inlined
def children_of(groups: Uint64s, node: int) -> tuple[int, int, int, int]:
    """Return the masks of a node's children that are nodes, and leaves, its first child node and cell."""
    shift = np.uint64(8 * (node & 7))
    nodes, leaves, first = groups[node >> 3, 0], groups[node >> 3, 1], groups[node >> 3, 2]
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
def place_beside(octant: int, dx: int, dy: int, dz: int) -> tuple[int, int]:
    """Return which of a node's 27 holds the cell beside its child, and that cell's octant there."""
    x, y, z = (octant & 1) + dx, (octant >> 1 & 1) + dy, (octant >> 2 & 1) + dz
    place = (x + 2 >> 1) + 3 * (y + 2 >> 1) + 9 * (z + 2 >> 1)
    return place, (x & 1) | (y & 1) << 1 | (z & 1) << 2


@kernel
def _descended(groups: Uint64s, begin: int, nodes: Int64s, first: int, last: int) -> tuple[Int64s, Int64s]:
    """Return what lies around nodes ``first`` to ``last``, children of those from ``begin`` on."""
    cells_below = np.full((last - first, 27), -1, np.int64)
    nodes_below = np.full((last - first, 27), -1, np.int64)
    for row in range(nodes.shape[0]):
        is_node, _, child, _ = children_of(groups, begin + row)
        for octant in range(8):
            if not is_node >> octant & 1:
                continue
            if first <= child < last:
                for n in range(27):
                    place, inside = place_beside(octant, n % 3 - 1, n // 3 % 3 - 1, n // 9 - 1)
                    if nodes[row, place] < 0:
                        continue
                    inner, leaves, next_node, next_cell = children_of(groups, nodes[row, place])
                    below = (1 << inside) - 1
                    if (inner | leaves) >> inside & 1:
                        cells_below[child - first, n] = next_cell + ones((inner | leaves) & below)
                        if inner >> inside & 1:
                            nodes_below[child - first, n] = next_node + ones(inner & below)
            child += 1
    return cells_below, nodes_below


def around_nodes(arrays: TreeArrays, level: int, first: int, last: int) -> tuple[Int64s, Int64s]:
    """Return the cells and nodes (nodes, 27) around nodes of a level; −1 for none. Reads the levels above."""
    runs = [(first, last)]
    for above in range(level - 1, -1, -1):
        low, high = int(arrays.level_nodes[above]), int(arrays.level_nodes[above + 1])
        runs.append(
            (
                _parent(arrays.groups, low, high, runs[-1][0]),
                _parent(arrays.groups, low, high, runs[-1][1] - 1) + 1,
            )
        )
    cells = np.full((1, 27), -1, np.int64)
    cells[0, 13] = 0
    nodes = cells.copy()
    for above in range(level):
        begin, _ = runs[level - above]
        cells, nodes = _descended(arrays.groups, begin, nodes, *runs[level - above - 1])
    return cells, nodes


@kernel
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
def around_children(
    groups: Uint64s, first: int, last: int, cells: Int64s, nodes: Int64s, count: int
) -> Int64s:
    """Return a row (count, ROW) for each child of the nodes of a block, in order."""
    rows = np.empty((count, ROW), np.int64)
    t = 0
    for node in range(first, last):
        inner, leaves, _, cell = children_of(groups, node)
        occupied = inner | leaves
        own = node - first
        left = ones(occupied)
        for octant in range(8):
            if not occupied >> octant & 1:
                continue
            parent = cells[own, 13]
            rows[t, PARENT] = parent
            x = 1 if octant & 1 else -1
            y = 3 if octant & 2 else -3
            z = 9 if octant & 4 else -9
            rows[t, ABOVE] = cells[own, 13 + x]
            rows[t, ABOVE + 1] = cells[own, 13 + y]
            rows[t, ABOVE + 2] = cells[own, 13 + z]
            rows[t, ABOVE + 3] = cells[own, 13 + x + y]
            rows[t, ABOVE + 4] = cells[own, 13 + x + z]
            rows[t, ABOVE + 5] = cells[own, 13 + y + z]
            rows[t, ABOVE + 6] = cells[own, 13 + x + y + z]
            rows[t, ABOVE + 7] = cells[own, 13 - x]
            rows[t, ABOVE + 8] = cells[own, 13 - y]
            rows[t, ABOVE + 9] = cells[own, 13 - z]
            for n in range(ABOVE, BESIDE):
                if rows[t, n] < 0:
                    rows[t, n] = parent
            shape = 0
            for axis in range(3):
                bit = 1 << axis
                # One of the two is a sibling; the other lies in the next node's cell.
                other = occupied >> (octant ^ bit) & 1
                step = (1, 3, 9)[axis] * (1 if octant & bit else -1)
                beyond = nodes[own, 13 + step]
                across, at = 0, parent
                if first <= beyond < last:
                    inner2, leaves2, _, cell2 = children_of(groups, beyond)
                    there = inner2 | leaves2
                    across = there >> (octant ^ bit) & 1
                    if across and not octant & bit:
                        at = cell2 + ones(there & ((1 << (octant ^ bit)) - 1))
                elif cells[own, 13 + step] >= 0:
                    across = 1
                if octant & bit and other:
                    at = cell + ones(occupied & ((1 << (octant ^ bit)) - 1))
                rows[t, BESIDE + axis] = at
                shape += 1 << 2 * (other + across)
            rows[t, LEFT] = left
            rows[t, SHAPE] = shape | (inner >> octant & 1) << 6
            left -= 1
            t += 1
    return rows


def shapes() -> Uint8s:
    """Return a number 0 … 9 for each SHAPE: how many axes have no, one or two of the cells across faces."""
    numbers = np.zeros(64, np.uint8)
    combinations = [(a, b, c) for a in range(4) for b in range(4) for c in range(4) if a + b + c == 3]
    for number, (none, one, two) in enumerate(combinations):
        numbers[none + 4 * one + 16 * two] = number
    return numbers
