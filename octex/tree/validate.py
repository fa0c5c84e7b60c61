"""Checks of an octree: of the arrays' lengths, always; of their content, on demand."""

from __future__ import annotations

import numpy as np

from octex.arrays import Uint8s, Uint32s, bit_counts
from octex.errors import ArgumentError, TextureFileError
from octex.tree.children import children_before, gather_facings, masks_of, node_cells, rank
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

#: Cells checked at once.
_PIECE = 1 << 20


def check_layout(arrays: TreeArrays, split: SplitTable, kept: KeptTable) -> None:
    """Check types, lengths and levels in O(levels): then kernels stay inside the arrays.

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
    for name, shape, expected_shape in shapes:
        if shape != expected_shape:
            raise ArgumentError(f"{name} must have shape {expected_shape}, not {shape}")
    check_rows(int(arrays.level_cells[-1]), split.areas.size, kept.cells.size)


def check_rows(cells: int, split_rows: int, kept: int) -> None:
    """Raise ArgumentError for more rows of values than 32 bits number: cells', facings' and kept nodes'."""
    if cells + split_rows + kept > MAX_CELLS:
        raise ArgumentError(
            f"{cells:,} cells, {split_rows:,} rows of split cells and {kept:,} kept nodes together are more "
            "than can be numbered; use a smaller depth"
        )


def check_meaning(arrays: TreeArrays, split: SplitTable, kept: KeptTable) -> None:
    """Check structure, flags, split table and kept nodes; raise TextureFileError naming the fault."""
    _check_structure(arrays)
    flags = arrays.flags
    if not _are_flagged(flags, SPLIT, split.cells):
        raise TextureFileError("split table: its cells are not those flagged as split, in order")
    if (flags[split.cells] & FACING_FLAGS != split.facings).any():
        raise TextureFileError("split table: a cell's facings are not its normal flags")
    rows = int(bit_counts(split.facings).sum())
    if rows != split.areas.size:
        raise TextureFileError(f"split table: {split.areas.size} rows, but the facings number {rows}")
    if not _are_flagged(flags, KEPT, kept.cells):
        raise TextureFileError("kept table: its cells are not those flagged as kept, in order")
    cells = node_cells(arrays) if arrays.level_cells.size > 2 else np.empty(0, np.int64)
    leaves = kept.cells[~np.isin(kept.cells, cells)]
    if leaves.size:
        raise TextureFileError(f"kept table: cell {leaves[0]} has no children")
    if arrays.level_cells.size > 2:
        gathered = flags.copy()
        gather_facings(arrays.groups, cells, flags, gathered)
        differ = np.flatnonzero(gathered != flags)
        if differ.size:
            raise TextureFileError(
                f"node cell {differ[0]}: its normal flags are not those of its children together"
            )


def _check_structure(arrays: TreeArrays) -> None:
    groups, n_nodes = arrays.groups, int(arrays.level_nodes[-1])
    both = np.flatnonzero(groups[:, 0] & groups[:, 1])
    if both.size:
        raise TextureFileError(f"group {both[0]}: a child is both node and leaf")
    masks = masks_of(groups, 0) | masks_of(groups, 1)
    if masks[n_nodes:].any():
        raise TextureFileError(f"group {len(groups) - 1}: children of nodes beyond the last")
    if arrays.level_cells.size > 2 and not masks[:n_nodes].all():
        raise TextureFileError(f"node {np.argmin(masks[:n_nodes] != 0)} has no children")
    ranked = groups.copy()
    rank(ranked)
    wrong = np.flatnonzero(ranked[:, 2] != groups[:, 2])
    if wrong.size:
        raise TextureFileError(f"group {wrong[0]}: its first child is not the one after the groups before it")
    if arrays.level_cells.size > 2:
        cells, nodes = children_before(groups, arrays.level_nodes[:-1])
        are_wrong = (cells != arrays.level_cells[1:]) | (nodes != arrays.level_nodes[1:])
        if are_wrong.any():
            level = int(np.argmax(are_wrong))
            raise TextureFileError(f"level {level}: the masks above count other cells or nodes")


def _are_flagged(flags: Uint8s, flag: int, cells: Uint32s) -> bool:
    """Return whether cells are exactly those with a flag, in order."""
    row = 0
    for begin in range(0, flags.size, _PIECE):
        flagged = begin + np.flatnonzero(flags[begin : begin + _PIECE] & flag)
        if not np.array_equal(cells[row : row + flagged.size], flagged):
            return False
        row += flagged.size
    return row == cells.size
