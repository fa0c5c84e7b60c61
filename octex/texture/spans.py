"""Which bytes of its file a texture reads, before it reads them."""

from __future__ import annotations

import mmap
from collections.abc import Mapping, Sequence

import numpy as np

from octex.arrays import Array, Int64s
from octex.container import header_length
from octex.texture.channel import Channel
from octex.tree.octree import Octree, count_before


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
        """Add rows of an array; what is no view of the file was read when that was opened."""
        offset = array.ctypes.data - self._first
        if array.size and 0 <= offset < self._size and rows.size:
            length = array.nbytes // len(array)
            begins = offset + rows.astype(np.int64) * length
            self._add(begins, begins + length)

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


def add_reads(
    spans: Spans,
    tree: Octree,
    channels: Sequence[Channel],
    levels: Mapping[int, Array],
    *,
    by_facing: bool,
    is_ruled: bool,
) -> None:
    """Add what lookups of a channel read, whose rows are given by the level looked at.

    ``channels`` are that and what it weighs by; ``by_facing`` is for lookups with normals, ``is_ruled`` for
    those that leave what mixes opposite facings of the channel to finer levels.
    """
    arrays, split, kept = tree.arrays, tree.split, tree.kept
    for array in arrays.level_cells, arrays.level_nodes, kept.cells:
        spans.until(array, array.size)
    deepest = max(levels, default=0)
    n_cells = int(arrays.level_cells[deepest + 1])
    spans.until(arrays.groups, -(-int(arrays.level_nodes[deepest]) // 8))
    if kept.cells.size:
        spans.until(arrays.flags, n_cells)
    n_split = count_before(split.cells, n_cells)
    ends = np.cumsum(np.bitwise_count(split.facings[:n_split]), dtype=np.int64)  # of split cells' rows
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
        owners = split.cells[np.searchsorted(ends, facings, side="right")]
        cells = np.concatenate([rows[rows < tree.n_cells], owners])
        if by_facing or is_ruled:
            spans.rows(arrays.flags, cells)
        if level < tree.max_depth:
            spans.rows(arrays.areas, cells)
            if any(has_leaves[: level + 1]):
                spans.until(arrays.areas, int(arrays.level_cells[level + 1]))
        for channel in channels:
            _add_values(spans, channel, rows)


def _add_values(spans: Spans, channel: Channel, rows: Array) -> None:
    """Add rows of a channel's values: cells', kept nodes' and split cells'."""
    for array in channel.values, channel.kept_values, channel.split_values:
        is_here = (rows >= 0) & (rows < len(array))
        spans.rows(array, rows[is_here])
        rows = rows[~is_here].astype(np.int64) - len(array)
