"""What an octree is in memory (and, byte for byte, on disk).

Cells are numbered level by level (breadth first), within a level in Morton order, nodes and leaves together:

    level 0      0                                the root
    level 1      1 2 3 4                          its stored children, in the order of their octants
    level 2      5 6 7 8 9 ...                    the stored children of cell 1, then of cell 2, ...

A cell's number indexes every per-cell array: its flags, its area and each channel's value. So the cells of
levels 0 … k are a prefix of each array. Nodes, the cells with children, are numbered likewise among
themselves; the root is node 0 unless it is a leaf.

Nothing points. Eight consecutive nodes share one group, a row of three unsigned 64-bit words:

    groups[n >> 3, 0]    bit 8·(n & 7) + octant: that child of node n is a node
    groups[n >> 3, 1]    bit 8·(n & 7) + octant: that child of node n is a leaf
    groups[n >> 3, 2]    low 32 bits: the number of the group's first child node
                         high 32 bits: the number of the group's first child cell

    below      = the bits under 8·(n & 7) + octant
    child node = first child node + popcount(word 0 & below)
    child cell = first child cell + popcount((word 0 | word 1) & below)

An octant is x + 2·y + 4·z, each 0 for the lower half of its axis and 1 for the upper.

(Benson & Davis 2002, 3.2 and 3.6: child flags, packed leaves, pointers recreated from the flags.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Int64s, Uint8s, Uint32s, Uint64s

#: Deepest level of any tree; a Morton code then has 63 bits.
MAX_DEPTH = 21
#: Positions are rounded to 2⁻³⁰ of the root's edge before the cells that hold them are found, a surface's and
#: those looked up alike: points of a face in a cell plane then lie in the cells stored for it.
GRID_BITS = 30
#: Cells and nodes are numbered in 32 bits, and so are rows of values: cells', facings' and kept nodes'.
MAX_CELLS = 2**32 - 1

# A cell's flags. Bits 0 to 5, the normal flags, are the facings of the surface in the cell (paper 3.5.2): the
# facing of a triangle is the axis direction nearest to its normal. From bit 0: +x −x +y −y +z −z.
FACING_FLAGS = 0b111111
KEPT = 0b1000000  # a node that keeps the coefficient of the leaf it once was
SPLIT = 0b10000000  # a cell with a value per facing in the split table
#: The flags' bits of +x, +y and +z; shifted left by one, those of −x, −y and −z.
POSITIVE_FACINGS = 0b010101
#: Of facings, as flags, the opposite ones.
OPPOSITE: Uint8s = np.array(
    [(bits & POSITIVE_FACINGS) << 1 | bits >> 1 & POSITIVE_FACINGS for bits in range(64)], np.uint8
)

# A cell's area: 0 for none, else round(AREA_STEPS · log2(area / edge²)) + AREA_ONE, clamped to 1 … 255.
# One step is 9 %; the range is 2⁻²⁵·⁷⁵ to 2⁶ times the edge squared.
AREA_STEPS = 8
AREA_ONE = 207


class TreeArrays(NamedTuple):
    """An octree as kernels read it."""

    groups: Uint64s  # (⌈nodes / 8⌉, 3)   24 bytes for eight nodes
    level_cells: Int64s  # (max_depth + 2,)   first cell of each level, then the number of cells
    level_nodes: Int64s  # (max_depth + 2,)   first node of each level, then the number of nodes
    flags: Uint8s  # (cells,)
    areas: Uint8s  # (cells,)


class SplitTable(NamedTuple):
    """Values per facing of the cells flagged SPLIT.

    A split cell has a row for each of its facings, cell after cell, in the order of the facings' bits. The
    channels have these rows' values. A node's are means over the surface of that facing. Lookups with normals
    blend a leaf's rows instead of its value.
    """

    cells: Uint32s  # (split cells,)   ascending
    facings: Uint8s  # (split cells,)   the cell's normal flags
    areas: Uint8s  # (rows,)   coded like a cell's area


class KeptTable(NamedTuple):
    """The nodes flagged KEPT; the channels have their coefficients, row for row."""

    cells: Uint32s  # (kept nodes,)   ascending


NO_SPLIT = SplitTable(np.empty(0, np.uint32), np.empty(0, np.uint8), np.empty(0, np.uint8))
NO_KEPT = KeptTable(np.empty(0, np.uint32))
