"""What lookups in kernels take: arrays of a texture, and room to work in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Float32s, Float64s, Int32s, Int64s, Uint8s, Uint32s, Uint64s
from octex.field.taps import Taps, new_taps
from octex.field.weights import MOST_ROWS, Sight, new_sight
from octex.field.windows import MOST_TAPS, Walk, new_walk
from octex.jit import kernel
from octex.tree.layout import TreeArrays
from octex.tree.search import Scratch as Search
from octex.tree.search import new_scratch as new_search


class LookupArrays(NamedTuple):
    """One channel of a texture, as ``arrays_of`` makes it; its fields are not for others.

    They are arrays and numbers alone, as numba's parallel loops want them.
    """

    place: Float64s  # (4,)   the root cell's lowest corner, and the length of its edge
    groups: Uint64s  # what is in the tree, see `TreeArrays`; areas are those of nodes alone
    level_cells: Int64s
    level_nodes: Int64s
    flags: Uint8s
    areas: Uint8s
    kept: Uint32s  # (kept nodes,)
    facings: Uint32s  # (cells,)   a split cell's first facing; (0,) without any
    tile_levels: Int64s  # (22, 5)   of each level with tiles their top level, begin and end in tops and rows
    tops: Int32s
    masks: Uint64s
    firsts: Uint32s
    values: Array  # (cells · components,)
    kept_values: Array
    split_values: Array
    table: Array  # what codes stand for; empty for float32
    alpha: Array  # (cells,), likewise; (0,) without it
    kept_alpha: Array
    split_alpha: Array
    alpha_table: Array
    components: int
    mixed: Uint8s  # (cells,)   which mix opposite facings, as averages; (0,) without any


class Scratch(NamedTuple):
    """Where lookups work, and what they remember from one point to the next. One serves one thread."""

    walk: Walk
    search: Search
    taps: Taps  # of one look, and these as they face a normal
    sight: Sight
    tiles: Int64s  # (8,)   the rows of 2×2×2 tiles
    codes: Int32s  # (3, 3)   along each axis, the codes of cells in tiles
    along: Float32s  # (3, 3)   and their weights
    sums: Float64s  # (10,)   four components, under alpha, and their weight; then without it


@kernel
def new_scratch(arrays: LookupArrays) -> Scratch:
    """Return room for lookups in one texture: make one for each thread, outside the loop."""
    tree = TreeArrays(arrays.groups, arrays.level_cells, arrays.level_nodes, arrays.flags, arrays.areas)
    return Scratch(
        new_walk(),
        new_search(tree),
        new_taps(1, (1 + MOST_ROWS) * MOST_TAPS, False),
        new_sight(),
        np.empty(8, np.int64),
        np.empty((3, 3), np.int32),
        np.empty((3, 3), np.float32),
        np.empty(10, np.float64),
    )
