"""Where lookups with normals find something else than those without: near what faces away, or is split."""

from __future__ import annotations

import numpy as np

from octex.arrays import Bools, Int8s, Int64s, Uint64s
from octex.conversion.evaluator import SPLIT_KIND, is_refined, kind_of
from octex.field.splines import QUADRATIC
from octex.field.windows import BEGIN, INSIDE, Way, cell_at, follow, new_walk
from octex.jit import kernel, trailing_zeros
from octex.tree.layout import MAX_DEPTH, TreeArrays
from octex.tree.morton import decode

_NO_KEPT = np.empty(0, np.uint32)


@kernel
def kinds_around(arrays: TreeArrays, codes: Int64s, depth: int) -> Uint64s:
    """Return the kinds of all leaves that lookups in some cells of a level (n,), which ascend, may read."""
    walk, kinds = new_walk(), np.empty(codes.size, np.uint64)
    way = Way(arrays, _NO_KEPT, walk, QUADRATIC, 2, 1, False)
    of_levels = np.zeros(MAX_DEPTH + 1, np.uint64)
    shift = MAX_DEPTH - depth
    for n in range(codes.size):
        i, j, k = decode(codes[n])
        walk.previous[5] = MAX_DEPTH  # becomes the last level whose window is that of the cell before
        last = follow(way, i << shift, j << shift, k << shift)
        for level in range(walk.previous[5] + 1, last + 1):
            found = of_levels[level - 1] if is_refined(walk, level) else np.uint64(0)
            inside = INSIDE[0, walk.levels[level, BEGIN], 0]
            leaves = (walk.cells[level, 0] ^ walk.nodes[level, 0]) & inside
            while leaves != 0:
                cell = cell_at(arrays, walk, level, 0, trailing_zeros(leaves))
                leaves &= leaves - np.uint64(1)
                found |= kind_of(arrays.flags[cell])
            of_levels[level] = found
        kinds[n] = of_levels[last]
    return kinds


def face_opposite(kinds: Uint64s) -> Bools:
    """Say whether any of some kinds (n,) face both ways along an axis, one by itself or two, or are split."""
    found = kinds & SPLIT_KIND > 0
    for axis in range(3):
        found |= (kinds & _HAVING[2 * axis] > 0) & (kinds & _HAVING[2 * axis + 1] > 0)
    return found


#: By the number of a facing: the kinds of cells that have it.
_HAVING = np.array([sum(1 << kind for kind in range(64) if kind >> f & 1) for f in range(6)], np.uint64)


def has_opposite(normals: Int8s, kinds: Uint64s) -> Bools:
    """Say whether something of some kinds (n,) is split, or faces away from what has normals (n, 3)."""
    opposite: Bools = (kinds & _OPPOSITE[facings_of(normals)]) != 0
    return opposite


def facings_of(normals: Int8s) -> Int64s:
    """Return the numbers of the facings that are nearest to normals (n, 3)."""
    normals = normals.astype(np.int16)
    axes = np.abs(normals).argmax(axis=1)
    found: Int64s = 2 * axes + (np.take_along_axis(normals, axes[:, None], 1)[:, 0] < 0)
    return found


#: By the number of a facing: the kinds of cells that have the opposite one and not this, and of split ones.
_OPPOSITE = np.array(
    [1 | sum(1 << kind for kind in range(64) if kind >> (f ^ 1) & ~(kind >> f) & 1) for f in range(6)],
    np.uint64,
)

#: By the facings that are taken in full: the kinds of cells that have none of them, and of split ones.
#: Lookups with a normal that find none of these kinds find the same as those without.
HIDDEN = np.array(
    [sum(1 << kind for kind in range(64) if kind & facings == 0) for facings in range(64)], np.uint64
)
