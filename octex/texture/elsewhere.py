"""Files elsewhere as lookups want them: which rows of arrays they read, and these fetched.

A render file is fetched in blocks of bytes. Of an archive whole levels of the structure are fetched, and
blocks of areas and channels, no deeper than asked for; these are decoded into memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from threading import RLock

import numpy as np

from octex.archive.layout import AREAS, KEPT_NAME, SPLIT_NAMES, TREE_NAMES, DamagedError, known_names
from octex.archive.read import Decoding
from octex.arrays import Array, Int64s
from octex.errors import ArgumentError, TextureFileError
from octex.remote import BLOCK, RemoteFile
from octex.texture.spans import Rows, Spans
from octex.tree.octree import Octree

#: Rows of the split table that are fetched at least.
_LEAST_SPLIT = 1 << 8
#: Tensors of an archive.
_GROUPS, _LEVEL_CELLS, _LEVEL_NODES, _FLAGS, _ = TREE_NAMES
#: Those that come with the structure, and which rows they have.
_LISTS = {_FLAGS: "cell", SPLIT_NAMES[0]: "split", SPLIT_NAMES[1]: "split", KEPT_NAME: "kept"}


class RenderFile(RemoteFile):
    """A render file elsewhere, of whose mapping arrays are views."""

    def fetch_rows(self, gather: Callable[[Rows], None]) -> bool:
        """Fetch the rows that a function gathers; say whether there was anything to fetch."""
        rows = Spans(self.mapping, BLOCK)
        gather(rows)
        return self.fetch(rows.ranges())

    def fetch_tables(self, tree: Octree, level: int) -> bool:
        """Fetch what says which cells down to a level are split or kept; say whether there was anything."""
        split, n_cells, n_split = tree.split, int(tree.level_cells[level + 1]), _LEAST_SPLIT
        kept: list[Array] = [tree.kept.cells, tree.arrays.flags[:n_cells]] if tree.kept.cells.size else []
        was_more = fetch_arrays(self, *kept, split.cells[: n_split + 1])
        # Of the table, which is in the cells' order, in steps like those of its search.
        while n_split < split.cells.size and split.cells[n_split] < n_cells:
            n_split *= 2
            was_more |= fetch_arrays(self, split.cells[: n_split + 1])
        return fetch_arrays(self, split.facings[: n_split + 1]) or was_more


class _Wanted(Rows):
    """Gathers what is read of an archive."""

    def __init__(self, archive: Archive) -> None:
        self._archive = archive
        self.level = 0  # of the structure
        self.tables: dict[str, list[tuple[str, Int64s]]] = {}  # rows of areas and channels

    def rows(self, array: Array, rows: Array) -> None:
        """Add some rows."""
        rows = rows[(rows >= 0) & (rows < len(array))]
        name, first = self._archive.place_of(array)
        if name is None or not rows.size:
            return
        rows = first + rows.astype(np.int64)
        if name == _GROUPS:
            self.nodes(array, 8 * rows + 7)
        elif name in _LISTS:
            self.level = max(self.level, self._archive.decoding.level_of(_LISTS[name], rows))
        elif name not in (_LEVEL_CELLS, _LEVEL_NODES):
            table = {"split": "row", "kept": "kept"}.get(name.partition("/")[0], "cell")
            self.tables.setdefault(name.partition("channels/")[2] or AREAS, []).append((table, rows))

    def nodes(self, groups: Array, nodes: Int64s) -> None:
        """Add the groups of some nodes."""
        if groups.size and nodes.size:
            firsts = self._archive.level_nodes
            last = min(int(nodes.max()), int(firsts[-1]) - 1)
            self.level = max(self.level, int(np.searchsorted(firsts, last, "right")))


class Archive:
    """An archive elsewhere, decoded as far as it was asked for into arrays of its own.

    Raises TextureFileError, which names the address, for one that is damaged.
    """

    def __init__(self, remote: RemoteFile) -> None:
        self._remote = remote
        self._lock = RLock()
        with self._decoded():
            self.decoding = Decoding(remote.mapping, self._fetch)
        tensors = self.decoding.contents.tensors
        self.level_nodes = tensors[_LEVEL_NODES]
        coded = known_names(tensors, self.decoding.channels)
        self._places = sorted(
            (array.ctypes.data, array.ctypes.data + array.nbytes, name, array.nbytes // len(array))
            for name, array in tensors.items()
            if array.nbytes and name in coded
        )

    @property
    def is_whole(self) -> bool:
        """Whether all of it is decoded."""
        return self.decoding.is_whole

    def fetch_rows(self, gather: Callable[[Rows], None]) -> bool:
        """Fetch the rows that a function gathers; say whether there was anything to fetch."""
        rows = _Wanted(self)
        gather(rows)
        with self._decoded():
            return self.decoding.decode(rows.tables, rows.level)

    def fetch_tables(self, _tree: Octree, level: int) -> bool:
        """Fetch what says which cells down to a level are split or kept; say whether there was anything."""
        with self._decoded():
            return self.decoding.decode({}, level)

    def fetch_all(self) -> None:
        """Fetch all of it."""
        with self._decoded():
            self.decoding.decode_all()

    def checked_once(self) -> AbstractContextManager[None]:
        """Look once, at the end of the block, whether the file has changed meanwhile."""
        return self._remote.checked_once()

    def place_of(self, array: Array) -> tuple[str | None, int]:
        """Return which tensor an array is a view of, None for none, and from which row on."""
        address = array.ctypes.data
        if array.nbytes:
            for begin, end, name, length in self._places:
                if begin <= address < end:
                    return name, (address - begin) // length
        return None, 0

    def _fetch(self, ranges: Sequence[tuple[int, int]]) -> None:
        self._remote.fetch(np.array(ranges, np.int64).reshape(-1, 2))

    @contextmanager
    def _decoded(self) -> Iterator[None]:
        with self._lock:
            try:
                yield
            except (DamagedError, ArgumentError) as error:
                raise TextureFileError(f"{self._remote.address}: {error}") from error
            except (MemoryError, OverflowError):
                raise TextureFileError(f"{self._remote.address}: does not fit into memory") from None


#: A file elsewhere.
Elsewhere = RenderFile | Archive


def fetch_arrays(file: Elsewhere, *arrays: Array) -> bool:
    """Fetch whole arrays of a file, or what of them is viewed; say whether there was anything to fetch."""

    def gather(rows: Rows) -> None:
        for array in arrays:
            rows.until(array, len(array))

    return file.fetch_rows(gather)
