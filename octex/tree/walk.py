"""The leaves of a tree one after another, in Morton order, a block at a time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from octex.arrays import Int64s, Uint8s
from octex.jit import kernel
from octex.tree.layout import MAX_DEPTH, TreeArrays
from octex.tree.search import child


class Leaves(NamedTuple):
    """Some leaves: their cell numbers, their Morton codes and their depths."""

    cells: Int64s
    codes: Int64s
    depths: Uint8s


def walk_leaves(arrays: TreeArrays, block: int = 1 << 16) -> Iterator[Leaves]:
    """Yield all leaves in Morton order, at most ``block`` at once; needs no memory beyond a block.

    Damaged arrays yield at most as many leaves as they claim to have.
    """
    left = int(arrays.level_cells[-1] - arrays.level_nodes[-1])
    if arrays.level_nodes[-1] == 0:
        yield Leaves(np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros(1, np.uint8))
        return
    path = np.zeros((MAX_DEPTH + 2, 3), np.int64)
    while left > 0:
        room = min(block, left)
        cells, codes, depths = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.uint8)
        found = _next_leaves(arrays, path, cells, codes, depths)
        if found:
            yield Leaves(cells[:found], codes[:found], depths[:found])
        if found < room:
            return
        left -= found


@kernel
def _next_leaves(
    arrays: TreeArrays,
    path: Int64s,
    cells: Int64s,
    codes: Int64s,
    depths: Uint8s,
) -> int:
    """Go on with a walk until ``cells`` is full; return the number found.

    ``path`` holds (node, its code, its next octant) for each level down to where the walk is; its last row is
    that level, or −1 at the end, and the number of nodes entered.
    """
    level, entered = path[-1, 0], path[-1, 1]
    found = 0
    while level >= 0 and found < cells.size:
        octant = path[level, 2]
        if octant == 8:
            level -= 1
            continue
        path[level, 2] += 1
        cell, node = child(arrays, path[level, 0], octant)
        if cell < 0:
            continue
        code = path[level, 1] << 3 | octant
        if node < 0:
            cells[found], codes[found], depths[found] = cell, code, level + 1
            found += 1
        elif level + 1 < MAX_DEPTH and entered < arrays.level_nodes[-1]:
            level += 1
            entered += 1
            path[level, 0], path[level, 1], path[level, 2] = node, code, 0
    path[-1, 0], path[-1, 1] = level, entered
    return found
