"""The rows of a texture's arrays that lookups read, and their bytes in its file."""

from __future__ import annotations

import mmap
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from octex.arrays import Array, Int64s, bit_counts, in_runs
from octex.checks import as_choice
from octex.container import header_length
from octex.field.lookups import Reads, joined_reads
from octex.field.tiles import MOST_TOP_LEVEL, can_be_tiled
from octex.parallel import Run
from octex.texture.lookup import Request, in_blocks
from octex.tree.children import children_before, octants_of
from octex.tree.edit import among
from octex.tree.layout import SplitTable
from octex.tree.neighbours import with_boundary
from octex.tree.octree import Octree, count_before, distinct
from octex.tree.split import counts_of, rows_of

if TYPE_CHECKING:
    from octex.texture.texture import OctreeTexture


class RowsRead:
    """Gathers the rows of arrays that are read."""

    def rows(self, array: Array, rows: Array) -> None:
        """Add rows of an array."""
        raise NotImplementedError

    def nodes(self, groups: Array, nodes: Int64s) -> None:
        """Add the groups of nodes."""
        self.rows(groups, nodes >> 3)

    def until(self, array: Array, end: int) -> None:
        """Add all rows before one."""
        self.rows(array, np.arange(min(end, len(array))))


class Spans(RowsRead):
    """Gathers rows of arrays that are views of a mapped file, as blocks of its bytes."""

    def __init__(self, mapping: mmap.mmap, block_size: int) -> None:
        self._size = len(mapping)
        self._first = np.frombuffer(mapping, np.uint8).ctypes.data
        self._block = block_size
        self._is_read = np.zeros(-(-self._size // block_size), np.bool_)
        self._is_read[: -(-header_length(mapping) // block_size)] = True

    def rows(self, array: Array, rows: Array) -> None:
        """Add rows of an array, unless it is no view of the file."""
        offset = array.ctypes.data - self._first
        rows = rows[(rows >= 0) & (rows < len(array))]
        if array.size and 0 <= offset < self._size and rows.size:
            length = array.nbytes // len(array)
            begins = offset + rows.astype(np.int64) * length
            first, last = begins // self._block, (begins + length - 1) // self._block
            for step in range(int((last - first).max()) + 1):
                self._is_read[np.minimum(first + step, last)] = True

    def until(self, array: Array, end: int) -> None:
        """Add all rows of an array before one, which may be many."""
        offset, end = array.ctypes.data - self._first, min(end, len(array))
        if end and 0 <= offset < self._size:
            length = array.nbytes // len(array)
            self._is_read[offset // self._block : (offset + end * length - 1) // self._block + 1] = True

    def ranges(self) -> Int64s:
        """Return begins and ends of runs of blocks (n, 2), in order."""
        changes = np.flatnonzero(np.diff(self._is_read, prepend=False, append=False))
        return np.minimum(changes.reshape(-1, 2) * self._block, self._size)


def lookup_reads(texture: OctreeTexture, request: Request) -> dict[str, dict[int, Reads]]:
    """Return the reads of lookups by channel and level."""
    inputs, channel, settings = request
    names: list[Any] = list(channel) if isinstance(channel, (list, tuple)) else [channel]
    for name in names:
        as_choice(name, texture.channels, "channel")
    reads_by_channel: dict[str, dict[int, Reads]] = {}
    for name in names:
        reads: list[dict[int, Reads]] = []
        in_blocks(inputs, [], partial(texture._lookups.list_reads, name, settings, reads), Run(threads=1))
        reads_by_channel[name] = joined_reads(reads)
    return reads_by_channel


def cells_of(reads: Iterable[Mapping[int, Reads]]) -> dict[int, Int64s]:
    """Return the cells of each level that lookups of channels read."""
    return {level: read.cells for level, read in joined_reads(reads).items()}


def nodes_read(tree: Octree, cells: Mapping[int, Int64s], filter: str) -> Iterator[Int64s]:
    """Yield the nodes that lookups at points in cells read, level by level.

    ``cells`` are ascending Morton codes by level. Of a tree with tiles these are all nodes of the levels
    where every search begins, then those whose cells touch one that holds a point, and their siblings, as a
    word of a tile has all children of a node. Of other trees all nodes are read. A level is determined by the
    groups of the levels above, when the next item is requested.
    """
    deepest = max((level for level, held in cells.items() if held.size), default=0)
    firsts = tree.arrays.level_nodes
    if not can_be_tiled(tree):
        yield np.arange(firsts[deepest])
        return
    begin = min(MOST_TOP_LEVEL + 1, deepest)
    yield np.arange(firsts[begin])
    around_by_level: dict[int, Int64s] = {}
    holding = np.empty(0, np.int64)  # cells of a level that hold points of probes there or below
    for level in range(deepest - 1, 0, -1):
        level_cells = cells.get(level + 1, holding[:0])
        if filter == "quartic":  # whose windows reach one cell farther
            level_cells = with_boundary(level_cells, level + 1)
        holding = distinct(np.concatenate([holding, level_cells]) >> 3)
        around_by_level[level] = with_boundary(holding, level)
    codes = nodes = np.zeros(min(tree.n_nodes, 1), np.int64)
    for level in range(1, deepest):
        parents, codes, numbers = _child_nodes(tree, codes, nodes)
        is_around = among(codes, around_by_level[level])
        if level >= begin:
            has_child_around = np.bincount(parents[is_around], minlength=nodes.size) > 0
            yield numbers[has_child_around[parents]]
        codes, nodes = codes[is_around], numbers[is_around]


def _child_nodes(tree: Octree, codes: Int64s, nodes: Int64s) -> tuple[Int64s, Int64s, Int64s]:
    """Return the child nodes of nodes: the index of each parent, their Morton codes, and their numbers."""
    groups = tree.arrays.groups
    masks = (groups[nodes >> 3, 0] >> (8 * (nodes & 7)).astype(np.uint64)).astype(np.uint8)
    parents, octants = octants_of(masks)
    numbers = in_runs(children_before(groups, nodes)[1], bit_counts(masks).astype(np.int64))
    return parents, codes[parents] << 3 | octants, np.minimum(numbers, tree.n_nodes - 1)


def add_reads(
    texture: OctreeTexture, reads: Mapping[str, Mapping[int, Reads]], request: Request, spans: RowsRead
) -> None:
    """Add the rows that lookups read, except the groups of nodes.

    With normals all rows of a split cell are added: its flags, read later, select some of them.
    """
    tree = texture.tree
    arrays, split, kept = tree.arrays, tree.split, tree.kept
    alpha = [] if texture._lookups.rows_of()[1] is None else [texture.channels["alpha"]]
    by_facing = "normals" in request.inputs
    is_ruled = not by_facing and request.has_footprints  # by the bleed threshold
    first_facing = tree.n_cells + kept.cells.size
    has_leaves = [leaves > 0 for leaves, _ in tree.cells_by_depth()]
    for name, levels in reads.items():
        channel = texture.channels[name]
        for array in arrays.level_cells, arrays.level_nodes, kept.cells:
            spans.until(array, array.size)
        n_cells = int(arrays.level_cells[max(levels, default=0) + 1])
        if kept.cells.size:
            spans.until(arrays.flags, n_cells)
        n_split = count_before(split.cells, n_cells)
        split_table = SplitTable(split.cells[:n_split], split.facings[:n_split], split.areas)
        n_rows = int(counts_of(split_table.facings).sum())
        is_coarse = any(
            level < tree.max_depth or (read.rows < arrays.level_cells[level]).any()
            for level, read in levels.items()
        )
        if by_facing or is_coarse:
            spans.until(split.cells, 2 * n_split + 2)  # read by the search for its end
            spans.until(split.facings, n_split)
        if is_ruled and n_split:
            spans.until(channel.split_values, n_rows)
        for level, read in levels.items():
            rows = read.rows.astype(np.int64)
            facings = rows[rows >= first_facing] - first_facing
            owners = rows_of(split_table).cells[facings[facings < n_rows]] if facings.size else facings
            keeping = kept.cells[rows[(rows >= tree.n_cells) & (rows < first_facing)] - tree.n_cells]
            cells = distinct(np.concatenate([rows[rows < tree.n_cells], owners, keeping]))
            if by_facing:
                spans.rows(arrays.flags, cells)
            if level < tree.max_depth:
                spans.rows(arrays.areas, cells)
                if any(has_leaves[: level + 1]):
                    spans.until(arrays.areas, int(arrays.level_cells[level + 1]))
            of_split = rows_of(split_table, cells).rows if by_facing else facings[:0]
            for used_channel in [channel, *alpha]:
                first = 0
                for array in used_channel.values, used_channel.kept_values, used_channel.split_values:
                    spans.rows(array, rows - first)
                    first += len(array)
                spans.rows(used_channel.split_values, of_split)
