"""Where lookups with normals find something else than those without: near what faces away, or is split."""

from __future__ import annotations

from concurrent.futures import Executor
from itertools import pairwise

import numpy as np

from octex.arrays import Bools, Int8s, Int64s, Uint8s, Uint32s, Uint64s
from octex.conversion import large
from octex.conversion.coefficients import SPLIT_KIND
from octex.field.blend import Listed
from octex.field.field import Field
from octex.jit import kernel, trailing_zeros
from octex.parallel import ordered_map
from octex.tree.layout import FACING_FLAGS, SPLIT
from octex.tree.morton import decode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement

#: Cells whose surroundings are looked at at once.
_BLOCK = 1 << 16
#: Bit of nodes beside their octants.
_NODE = 8


def kinds_around(tree: Octree, executor: Executor) -> Uint64s:
    """Return the kinds of all leaves that lookups in each leaf may read (cells,).

    0 where none of them face opposite ways or are split. Found from the root down, a level's cells in
    parallel: what is around a cell is around what lies in it. ``executor`` is one of `parallel.sharing`.
    """
    n_cells, firsts = tree.n_cells, tree.arrays.level_cells.tolist()
    kinds, parents = large.empty(n_cells, np.uint64), large.zeros(n_cells, np.uint32)
    octants = large.zeros(n_cells, np.uint8)
    _gather_kinds(tree.arrays.groups, tree.arrays.flags, n_cells - tree.n_leaves, kinds, parents, octants)
    field = Field(tree)
    found = large.zeros(n_cells, np.uint64)
    meets, codes = large.zeros(n_cells, np.bool_), large.zeros(n_cells, np.int64)  # codes of those looked at
    for level, (first, end) in enumerate(pairwise(firsts)):
        chosen = np.flatnonzero(meets[parents[first:end]]) + first if level else np.arange(1)
        own = field.level(level)

        def look(some: Int64s, level: int = level, own: Field = own) -> None:
            codes[some] = codes[parents[some]] << 3 | octants[some] & 7
            taps = _around(own, level, codes[some])
            around = np.bitwise_or.reduceat(kinds[taps.rows], taps.starts[:-1])
            meets[some] = _face_opposite(around) | (around & SPLIT_KIND > 0)
            found[some] = np.where(meets[some] & (octants[some] < _NODE), around, 0)

        parts = [chosen[begin : begin + _BLOCK] for begin in range(0, len(chosen), _BLOCK)]
        for _ in ordered_map(executor, look, parts):
            pass
    return found


def _face_opposite(kinds: Uint64s) -> Bools:
    """Say whether any of some kinds (n,) face both ways along an axis, one by itself or two."""
    found = np.zeros(kinds.size, np.bool_)
    for axis in range(3):
        found |= (kinds & _HAVING[2 * axis] > 0) & (kinds & _HAVING[2 * axis + 1] > 0)
    return found


#: By the number of a facing: the kinds of cells that have it.
_HAVING = np.array([sum(1 << kind for kind in range(64) if kind >> f & 1) for f in range(6)], np.uint64)


@kernel
def _gather_kinds(
    groups: Uint64s, flags: Uint8s, n_nodes: int, kinds: Uint64s, parents: Uint32s, octants: Uint8s
) -> None:
    """Write the kind of each leaf, the kinds of all leaves below each node; each cell's parent and octant."""
    cells = np.zeros(n_nodes, np.uint32)  # of each node
    one, byte = np.uint64(1), np.uint64(0xFF)
    child, child_node = 1, 1
    octants[0] = _NODE if n_nodes > 0 else 0
    for node in range(n_nodes):
        shift = np.uint64(8 * (node & 7))
        nodes = groups[node >> 3, 0] >> shift & byte
        left = nodes | groups[node >> 3, 1] >> shift & byte
        while left != 0:
            parents[child] = cells[node]
            octants[child] = trailing_zeros(left)
            if nodes & left & (~left + one) != 0:
                octants[child] |= np.uint8(_NODE)
                cells[child_node] = child
                child_node += 1
            left &= left - one
            child += 1
    for cell in range(flags.size):
        facings = flags[cell] & np.uint8(FACING_FLAGS)
        kinds[cell] = one << np.uint64(facings) if facings != 0 else np.uint64(0)
        if flags[cell] & np.uint8(SPLIT) != 0:
            kinds[cell] = SPLIT_KIND
    for node in range(n_nodes):
        kinds[cells[node]] = np.uint64(0)
    for cell in range(flags.size - 1, 0, -1):
        kinds[parents[cell]] |= kinds[cell]


def has_opposite(normals: Int8s, kinds: Uint64s) -> Bools:
    """Say whether something of some kinds (n,) is split, or faces away from what has normals (n, 3)."""
    normals = normals.astype(np.int16)
    axes = np.abs(normals).argmax(axis=1)
    facings = 2 * axes + (np.take_along_axis(normals, axes[:, None], 1)[:, 0] < 0)
    opposite: Bools = (kinds & _OPPOSITE[facings]) != 0
    return opposite


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


def _around(field: Field, level: int, codes: Int64s) -> Listed:
    """Return the taps of a level's field in the middles of its cells, where all 3×3×3 cells around weigh."""
    centres = (decode_cells(codes) + np.float64(0.5)) / 2**level
    return field.taps(centres, Placement((0.0, 0.0, 0.0), 1.0))
