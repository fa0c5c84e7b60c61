"""What must hold: of the arrays' lengths, always; of their content, when someone asks."""

from __future__ import annotations

import numpy as np

from octex.arrays import Uint8s, Uint32s, Uint64s, bit_counts
from octex.errors import ArgumentError, TextureFileError
from octex.jit import kernel, popcount
from octex.tree.layout import (
    FACING_FLAGS,
    KEPT,
    MAX_CELLS,
    MAX_DEPTH,
    SPLIT,
    KeptTable,
    SplitTable,
    TreeArrays,
)

#: Cells whose flags are looked at together.
_PIECE = 1 << 20


def check_layout(arrays: TreeArrays, split: SplitTable, kept: KeptTable) -> None:
    """Check types, lengths and levels in O(levels): then kernels stay inside the arrays, whatever they hold.

    Raises ArgumentError.
    """
    columns = (
        ("groups", arrays.groups, np.uint64, 2),
        ("level_cells", arrays.level_cells, np.int64, 1),
        ("level_nodes", arrays.level_nodes, np.int64, 1),
        ("flags", arrays.flags, np.uint8, 1),
        ("areas", arrays.areas, np.uint8, 1),
        ("split cells", split.cells, np.uint32, 1),
        ("split facings", split.facings, np.uint8, 1),
        ("split areas", split.areas, np.uint8, 1),
        ("kept cells", kept.cells, np.uint32, 1),
    )
    for name, array, dtype, dimensions in columns:
        if array.dtype != dtype or array.ndim != dimensions or not array.flags.c_contiguous:
            expected = f"a C-ordered {np.dtype(dtype).name} array of {dimensions} dimension(s)"
            raise ArgumentError(f"{name} must be {expected}, not {array.dtype} {array.shape}")
    n_levels = arrays.level_cells.size - 1
    if not 1 <= n_levels <= MAX_DEPTH + 1 or arrays.level_nodes.size != n_levels + 1:
        raise ArgumentError("level_cells and level_nodes must both have an entry a level and one more")
    firsts = np.concatenate([arrays.level_cells, arrays.level_nodes])
    cells, nodes = np.diff(arrays.level_cells), np.diff(arrays.level_nodes)
    is_empty_tree = n_levels == 1 and nodes[0] == 1
    if (
        (firsts < 0).any()
        or (firsts > MAX_CELLS).any()
        or arrays.level_cells[0] != 0
        or arrays.level_nodes[0] != 0
        or cells[0] != 1
        or (cells < 1).any()
        or (cells[1:] > 8 * nodes[:-1]).any()
        or (nodes > cells).any()
        or (nodes[:-1] < 1).any()
        or (nodes[-1] != 0 and not is_empty_tree)
    ):
        raise ArgumentError("levels must have cells, children of the nodes above, and nodes among them")
    shapes = (
        ("groups", arrays.groups.shape, (-(-int(arrays.level_nodes[-1]) // 8), 3)),
        ("flags", arrays.flags.shape, (int(arrays.level_cells[-1]),)),
        ("areas", arrays.areas.shape, (int(arrays.level_cells[-1]),)),
        ("split facings", split.facings.shape, split.cells.shape),
    )
    for name, found, wanted in shapes:
        if found != wanted:
            raise ArgumentError(f"{name} must have shape {wanted}, not {found}")
    check_rows(int(arrays.level_cells[-1]), split.areas.size, kept.cells.size)


def check_rows(cells: int, split_rows: int, kept: int) -> None:
    """Raise ArgumentError for more rows of values than can be numbered: cells', facings' and kept nodes'."""
    if cells + split_rows + kept > MAX_CELLS:
        raise ArgumentError(
            f"{cells:,} cells, {split_rows:,} rows of split cells and {kept:,} kept nodes together are more "
            "than can be numbered; use a smaller depth"
        )


def check_meaning(arrays: TreeArrays, split: SplitTable, kept: KeptTable) -> None:
    """Check structure, flags, split table and kept nodes; raise TextureFileError naming what is broken."""
    _check_structure(arrays)
    _check_split(arrays.flags, split)
    _check_kept(arrays, kept)
    cell = _facing_fault(arrays)
    if cell >= 0:
        raise TextureFileError(f"node cell {cell}: its normal flags are not those of its children together")


def _check_structure(arrays: TreeArrays) -> None:
    groups, n_nodes = arrays.groups, int(arrays.level_nodes[-1])
    both = np.flatnonzero(groups[:, 0] & groups[:, 1])
    if both.size:
        raise TextureFileError(f"group {both[0]}: a child is both node and leaf")
    if n_nodes % 8 and (groups[-1, :2] >> np.uint64(8 * (n_nodes % 8))).any():
        raise TextureFileError(f"group {len(groups) - 1}: children of nodes beyond the last")
    if arrays.level_cells.size > 2:
        node = _childless_node(groups, n_nodes)
        if node >= 0:
            raise TextureFileError(f"node {node} has no children")
    group = _rank_fault(groups)
    if group >= 0:
        raise TextureFileError(f"group {group}: its first child is not the one after the groups before it")
    level = _level_fault(arrays)
    if level >= 0:
        raise TextureFileError(f"level {level}: the masks above count other cells or nodes")


def _check_split(flags: Uint8s, split: SplitTable) -> None:
    if not _are_flagged(flags, SPLIT, split.cells):
        raise TextureFileError("split table: its cells are not those flagged as split, in order")
    if (flags[split.cells] & FACING_FLAGS != split.facings).any():
        raise TextureFileError("split table: a cell's facings are not its normal flags")
    rows = int(bit_counts(split.facings).sum())
    if rows != split.areas.size:
        raise TextureFileError(f"split table: {split.areas.size} rows, but the facings number {rows}")


def _check_kept(arrays: TreeArrays, kept: KeptTable) -> None:
    if not _are_flagged(arrays.flags, KEPT, kept.cells):
        raise TextureFileError("kept table: its cells are not those flagged as kept, in order")
    row = _leaf_among(arrays, kept.cells)
    if row >= 0:
        raise TextureFileError(f"kept table: cell {kept.cells[row]} has no children")


def _are_flagged(flags: Uint8s, flag: int, cells: Uint32s) -> bool:
    """Say whether cells are all those that have a flag, in order."""
    row = 0
    for begin in range(0, flags.size, _PIECE):
        flagged = begin + np.flatnonzero(flags[begin : begin + _PIECE] & flag)
        if not np.array_equal(cells[row : row + flagged.size], flagged):
            return False
        row += flagged.size
    return row == cells.size


@kernel
def _childless_node(groups: Uint64s, n_nodes: int) -> int:
    for node in range(n_nodes):
        if (groups[node >> 3, 0] | groups[node >> 3, 1]) >> np.uint64(8 * (node & 7)) & np.uint64(0xFF) == 0:
            return node
    return -1


@kernel
def _rank_fault(groups: Uint64s) -> int:
    child_node = child_cell = np.int64(1)
    for g in range(groups.shape[0]):
        if groups[g, 2] != np.uint64(child_node) | np.uint64(child_cell) << np.uint64(32):
            return g
        child_node += popcount(groups[g, 0])
        child_cell += popcount(groups[g, 0] | groups[g, 1])
    return -1


@kernel
def _level_fault(arrays: TreeArrays) -> int:
    """First level whose numbers of cells and nodes are not those of the masks above, or −1."""
    for level in range(arrays.level_cells.size - 2):
        n_nodes = n_cells = np.int64(0)
        for node in range(arrays.level_nodes[level], arrays.level_nodes[level + 1]):
            byte = np.uint64(0xFF) << np.uint64(8 * (node & 7))
            nodes, leaves = arrays.groups[node >> 3, 0] & byte, arrays.groups[node >> 3, 1] & byte
            n_nodes += popcount(nodes)
            n_cells += popcount(nodes | leaves)
        if (
            n_nodes != arrays.level_nodes[level + 2] - arrays.level_nodes[level + 1]
            or n_cells != arrays.level_cells[level + 2] - arrays.level_cells[level + 1]
        ):
            return level + 1
    return -1


@kernel
def _leaf_among(arrays: TreeArrays, cells: Uint32s) -> int:
    """First row of ascending cells that is no node with children, or −1; needs a sound structure."""
    has_children = arrays.level_cells.size > 2
    row = int(has_children and cells.size > 0 and cells[0] == 0)
    cell = np.int64(1)
    for node in range(arrays.level_nodes[-1] if has_children else 0):
        for octant in range(8):
            bit = np.uint64(1) << np.uint64(8 * (node & 7) + octant)
            is_node = arrays.groups[node >> 3, 0] & bit != 0
            if row < cells.size and cell == cells[row] and is_node:
                row += 1
            cell += is_node or arrays.groups[node >> 3, 1] & bit != 0
    return row if row < cells.size else -1


@kernel
def _facing_fault(arrays: TreeArrays) -> int:
    """First node's cell whose facings are not its children's together, or −1; needs a sound structure."""
    groups = arrays.groups
    n_nodes = int(arrays.level_nodes[-1])
    cell, next_cell = np.int64(0), np.int64(1)
    g, nodes = -1, np.uint64(0)  # a group, and those of its children that are nodes and still to come
    for node in range(n_nodes if arrays.level_cells.size > 2 else 0):
        facings = 0
        for octant in range(8):
            bit = np.uint64(1) << np.uint64(8 * (node & 7) + octant)
            if (groups[node >> 3, 0] | groups[node >> 3, 1]) & bit:
                facings |= int(np.int64(arrays.flags[next_cell])) & FACING_FLAGS
                next_cell += 1
        if np.int64(arrays.flags[cell]) & FACING_FLAGS != facings:
            return int(cell)
        while nodes == 0 and g + 1 < groups.shape[0]:
            g += 1
            nodes = groups[g, 0]
        below = (nodes & (~nodes + np.uint64(1))) - np.uint64(1)
        cell = np.int64(groups[g, 2] >> np.uint64(32)) + popcount((groups[g, 0] | groups[g, 1]) & below)
        nodes &= nodes - np.uint64(1)
    return -1
