"""Which bytes of its file a texture reads, before it reads them."""

from __future__ import annotations

import mmap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Protocol

import numpy as np

from octex.arrays import Array, Int64s, bit_counts
from octex.container import header_length
from octex.field.listing import Reads
from octex.field.tiles import MOST_TOP_LEVEL, can_be_tiled
from octex.texture.channel import Channel
from octex.tree.beside import with_boundary
from octex.tree.octree import Octree, count_before, distinct


class Rows(Protocol):
    """Gathers the rows of arrays that are read."""

    def rows(self, array: Array, rows: Array) -> None:
        """Add some rows."""

    def nodes(self, groups: Array, nodes: Int64s) -> None:
        """Add what says which children nodes have."""

    def until(self, array: Array, end: int) -> None:
        """Add all rows before one."""


class Spans:
    """Bytes of a mapped file, gathered from the rows of arrays that are views of it, as blocks."""

    def __init__(self, mapping: mmap.mmap, block_size: int) -> None:
        self._size = len(mapping)
        self._first = np.frombuffer(mapping, np.uint8).ctypes.data
        self._block = block_size
        self._is_read = np.zeros(-(-self._size // block_size), np.bool_)
        self._add(np.zeros(1, np.int64), np.array([header_length(mapping)]))

    def _add(self, begins: Int64s, ends: Int64s) -> None:
        """Add bytes from ``begins`` (n,) to before ``ends`` (n,)."""
        first, last = begins // self._block, (ends - 1) // self._block
        for more in range(int((last - first).max(initial=-1)) + 1):
            self._is_read[np.minimum(first + more, last)] = True

    def rows(self, array: Array, rows: Array) -> None:
        """Add rows of an array that it has; what is no view of the file was read when that was opened."""
        offset = array.ctypes.data - self._first
        rows = rows[(rows >= 0) & (rows < len(array))]
        if array.size and 0 <= offset < self._size and rows.size:
            length = array.nbytes // len(array)
            begins = offset + rows.astype(np.int64) * length
            self._add(begins, begins + length)

    def nodes(self, groups: Array, nodes: Int64s) -> None:
        """Add the rows of a tree's groups that say what nodes have."""
        self.rows(groups, nodes >> 3)

    def until(self, array: Array, end: int) -> None:
        """Add all rows of an array before one."""
        offset, end = array.ctypes.data - self._first, min(end, len(array))
        if end and 0 <= offset < self._size:
            length = array.nbytes // len(array)
            self._is_read[offset // self._block : (offset + end * length - 1) // self._block + 1] = True

    def ranges(self) -> Int64s:
        """Return where runs of blocks begin and end (n, 2), in order."""
        changes = np.flatnonzero(np.diff(self._is_read, prepend=False, append=False))
        return np.minimum(changes.reshape(-1, 2) * self._block, self._size)


def cells_of(reads: Iterable[Mapping[int, Reads]]) -> dict[int, Int64s]:
    """Return the cells of each level that lookups of some channels look at."""
    found: dict[int, list[Int64s]] = {}
    for levels in reads:
        for level, read in levels.items():
            found.setdefault(level, []).append(read.cells)
    return {level: distinct(np.concatenate(cells)) for level, cells in found.items()}


def nodes_read(tree: Octree, cells: Mapping[int, Int64s], filter: str) -> Iterator[Int64s]:
    """Yield the nodes that lookups at points in some cells read, level by level.

    ``cells`` are ascending Morton codes by level. Of a tree with tiles these are all nodes of the levels from
    which every search begins, then those whose cells touch one that holds a point, and their siblings: a word
    of a tile is made of all children of a node. Of other trees all nodes are read. Which they are of a level
    is read in those above when it is asked for.
    """
    deepest = max((level for level, held in cells.items() if held.size), default=0)
    firsts = tree.arrays.level_nodes
    if not can_be_tiled(tree):
        yield np.arange(firsts[deepest])
        return
    begin = min(MOST_TOP_LEVEL + 1, deepest)
    yield np.arange(firsts[begin])
    around: dict[int, Int64s] = {}
    wanted = np.empty(0, np.int64)  # cells of a level that hold points, where there are looks at it or below
    for level in range(deepest - 1, 0, -1):
        here = cells.get(level + 1, wanted[:0])
        if filter == "quartic":  # whose windows reach one cell farther
            here = with_boundary(here, level + 1)
        wanted = distinct(np.concatenate([wanted, here]) >> 3)
        around[level] = with_boundary(wanted, level)
    codes = nodes = np.zeros(min(tree.n_nodes, 1), np.int64)
    for level in range(1, deepest):
        parents, codes, numbers = _child_nodes(tree, codes, nodes)
        near = around[level]
        is_near = near[np.minimum(np.searchsorted(near, codes), near.size - 1)] == codes
        if level >= begin:
            with_near = np.bincount(parents[is_near], minlength=nodes.size) > 0
            yield numbers[with_near[parents]]
        codes, nodes = codes[is_near], numbers[is_near]


def _child_nodes(tree: Octree, codes: Int64s, nodes: Int64s) -> tuple[Int64s, Int64s, Int64s]:
    """Return the child nodes of some nodes: whose they are, 0 …, their Morton codes, and their numbers."""
    groups, shifts = tree.arrays.groups[nodes >> 3], (8 * (nodes & 7)).astype(np.uint64)
    masks = (groups[:, 0] >> shifts).astype(np.uint8)
    before = bit_counts(groups[:, 0] & ((np.uint64(1) << shifts) - np.uint64(1)))
    parents, octants = np.nonzero(np.unpackbits(masks[:, None], axis=1, bitorder="little"))
    counts = bit_counts(masks).astype(np.int64)
    firsts = (groups[:, 2] & np.uint64(0xFFFFFFFF)).astype(np.int64) + before - (np.cumsum(counts) - counts)
    numbers = np.minimum(firsts[parents] + np.arange(parents.size), tree.n_nodes - 1)
    return parents, codes[parents] << 3 | octants, numbers


def add_reads(
    spans: Rows,
    tree: Octree,
    channels: Sequence[Channel],
    levels: Mapping[int, Array],
    *,
    by_facing: bool,
    is_ruled: bool,
) -> None:
    """Add what lookups of a channel read, whose rows are given by the level looked at.

    ``channels`` are that and what it weighs by; ``by_facing`` is for lookups with normals, ``is_ruled`` for
    those that leave what mixes opposite facings of the channel to finer levels. Where there are normals, all
    rows of a split cell are added: which of them are read, its flags say.
    """
    arrays, split, kept = tree.arrays, tree.split, tree.kept
    for array in arrays.level_cells, arrays.level_nodes, kept.cells:
        spans.until(array, array.size)
    deepest = max(levels, default=0)
    n_cells = int(arrays.level_cells[deepest + 1])
    if kept.cells.size:
        spans.until(arrays.flags, n_cells)
    n_split = count_before(split.cells, n_cells)
    ends = np.cumsum(bit_counts(split.facings[:n_split]), dtype=np.int64)  # of split cells' rows
    is_coarse = any(
        level < tree.max_depth or (rows < arrays.level_cells[level]).any() for level, rows in levels.items()
    )
    if by_facing or is_coarse:
        spans.until(split.cells, 2 * n_split + 2)  # as far as its end is looked for
        spans.until(split.facings, n_split)
    if is_ruled and n_split:
        spans.until(channels[0].split_values, int(ends[-1]))
    first_facing = tree.n_cells + kept.cells.size
    has_leaves = [leaves > 0 for leaves, _ in tree.cells_by_depth()]
    for level, rows in levels.items():
        facings = rows[rows >= first_facing] - first_facing
        owners = split.cells[:n_split][
            np.searchsorted(ends, facings[facings < ends[-1:].sum()], side="right")
        ]
        keeping = kept.cells[rows[(rows >= tree.n_cells) & (rows < first_facing)] - tree.n_cells]
        cells = np.concatenate([rows[rows < tree.n_cells], owners, keeping])
        if by_facing:
            spans.rows(arrays.flags, cells)
        if level < tree.max_depth:
            spans.rows(arrays.areas, cells)
            if any(has_leaves[: level + 1]):
                spans.until(arrays.areas, int(arrays.level_cells[level + 1]))
        seen = np.flatnonzero(np.isin(split.cells[:n_split], cells)) if by_facing else owners[:0]
        counts = bit_counts(split.facings[seen]).astype(np.int64)
        firsts = ends[seen] - np.cumsum(counts)
        of_split = np.repeat(firsts, counts) + np.arange(counts.sum())
        for channel in channels:
            _add_values(spans, channel, rows)
            spans.rows(channel.split_values, of_split)


def _add_values(spans: Rows, channel: Channel, rows: Array) -> None:
    """Add rows of a channel's values: cells', kept nodes' and split cells'."""
    first = 0
    for array in channel.values, channel.kept_values, channel.split_values:
        spans.rows(array, rows.astype(np.int64) - first)
        first += len(array)
