"""The children of a node, counted from the flags of its group: see `tree.layout`."""

from __future__ import annotations

import numpy as np

from octex.arrays import Uint64s
from octex.jit import inlined, popcount


@inlined
def children(groups: Uint64s, node: int) -> tuple[np.uint64, np.uint64, int, int]:
    """Return which children of a node are nodes, which are stored, a bit for each, and the first of both.

    A number that no group has is taken for the nearest that one has.
    """
    group = np.uint64(min(max(node >> 3, 0), groups.shape[0] - 1))
    shift = np.uint64(8 * (node & 7))
    nodes, firsts = groups[group, 0], groups[group, 2]
    cells = nodes | groups[group, 1]
    before = (np.uint64(1) << shift) - np.uint64(1)
    first_node = int(np.int64(firsts & np.uint64(0xFFFFFFFF))) + popcount(nodes & before)
    first_cell = int(np.int64(firsts >> np.uint64(32))) + popcount(cells & before)
    return nodes >> shift & np.uint64(0xFF), cells >> shift & np.uint64(0xFF), first_node, first_cell
