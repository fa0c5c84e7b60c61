"""Textures at an address: lookups fetch what they read.

A render file is fetched in blocks of bytes. Of an archive whole levels of the structure are fetched, and
blocks of areas and channels down to the requested level; these are decoded into memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np

from octex import container
from octex.archive.layout import AREAS, KEPT_NAME, MAGIC, SPLIT_NAMES, TREE_NAMES, known_names
from octex.archive.read import Decoding, naming
from octex.arrays import Array, Int64s
from octex.field.tiles import can_be_tiled
from octex.remote import BLOCK, RemoteFile
from octex.texture.channel import Channel
from octex.texture.file import Storage
from octex.texture.lookup import Request
from octex.texture.spans import RowsRead, Spans, add_reads, cells_of, lookup_reads, nodes_read
from octex.texture.texture import OctreeTexture, texture_of
from octex.tree.layout import GRID_BITS
from octex.tree.morton import encode_cells
from octex.tree.octree import Octree, distinct
from octex.tree.placement import on_grid

#: Bytes that are fetched first: the header, and the groups of the coarse levels.
_FIRST = 1 << 14

#: Least rows of the split table to fetch.
_LEAST_SPLIT = 1 << 8
#: Tensors of an archive.
_GROUPS, _LEVEL_CELLS, _LEVEL_NODES, _FLAGS, _ = TREE_NAMES
#: Those that are coded with the structure, and their tables.
_LISTS = {_FLAGS: "cell", SPLIT_NAMES[0]: "split", SPLIT_NAMES[1]: "split", KEPT_NAME: "kept"}

Fetch = Callable[..., object]


def open_remote(address: str, cache: Path | None = None) -> OctreeTexture:
    """Open the file at an address; fetches its header, or the directory of an archive.

    Raises TextureFileError, OutputError and MissingExtraError: see RemoteFile.
    """
    remote = RenderFile(address, cache)
    file: RemoteContent = remote
    remote.fetch([(0, min(len(MAGIC), remote.size))])
    if remote.mapping[: len(MAGIC)] == MAGIC:
        file = archive = Archive(remote)
        tensors, metadata, sizes = archive.decoding.contents
        storage = Storage(address, None, dict(tensors), dict(metadata), sizes)
    else:
        remote.fetch([(0, min(_FIRST, remote.size))])
        length = container.header_length(remote.mapping)
        if length <= remote.size:
            remote.fetch([(0, length)])
        contents = container.read_mapped(remote.mapping, address)
        levels = (contents.tensors.get(name) for name in (_LEVEL_CELLS, _LEVEL_NODES))
        fetch_arrays(remote, *(array for array in levels if array is not None))
        if not all(map(remote.holds, contents.tensors.values())):  # unaligned arrays were copied
            remote.fetch_all()
            contents = container.read_mapped(remote.mapping, address)
        storage = Storage(address, remote.mapping, dict(contents.tensors), dict(contents.metadata))
    texture, fetch = texture_of(storage), partial(fetch_arrays, file)
    channels = {name: _RemoteChannel.over(channel, fetch) for name, channel in texture.channels.items()}
    return texture._with_parts(_RemoteTree(texture.tree, fetch), channels, RemoteStorage(texture, file))


class RemoteStorage(Storage):
    """A file at an address. Lookups fetch what they read; all other users fetch whole arrays.

    A field never changes its indices: when more has come, there is a new field.
    """

    is_local = False

    def __init__(self, texture: OctreeTexture, file: RemoteContent) -> None:
        super().__init__(texture.storage.path)
        self.file = file
        self._loaded = texture
        self._fetching = RLock()
        self._is_whole = file.is_whole
        self._reached: tuple[str, dict[int, Int64s]] = "", {}

    def loaded(self, _texture: OctreeTexture) -> OctreeTexture:
        """Return a texture of the fetched part, zeros for the rest."""
        return self._loaded

    def load_all(self, _texture: OctreeTexture) -> OctreeTexture:
        """Fetch all of the texture, and return it."""
        with self._fetching:
            self.file.fetch_all()
            if not self._is_whole:
                self._renew(True)
                self._is_whole = True
            return self._loaded

    def load_levels(self, _texture: OctreeTexture, level: int) -> OctreeTexture:
        """Fetch the levels 0 … ``level``, and return the texture that has them."""
        with self._fetching:
            was_more = self._fetch_groups(np.arange(int(self._loaded.tree.level_nodes[level])))
            self._renew(self.file.fetch_tables(self._loaded.tree, level) or was_more)
            tree = self._loaded.tree.truncated(level)
            values = [array for channel in self._loaded.channels.values() for array in channel.of(tree)[1:]]
            fetch_arrays(self.file, *tree.arrays[1:], *tree.split, *tree.kept, *values)
            return self._loaded

    def prepare(
        self, _texture: OctreeTexture, _count: int, request: Callable[[], Request], /
    ) -> OctreeTexture:
        """Fetch what lookups read, and return the texture that answers them."""
        with self._fetching, self.file.checked_once():
            lookup = request()
            return self._fetched_around(lookup) if lookup.channel is None else self._fetched(lookup)

    def _fetched(self, request: Request) -> OctreeTexture:
        """Fetch what lookups of channels read, and return the texture that answers them.

        First come the groups around the points, level by level, then the rows of the cells there. The points
        are known without the groups; but coarse cells with mixed facings pass probes on to finer ones, so
        this repeats until all is fetched.
        """
        has_tables = request.has_footprints or "normals" in request.inputs
        has_tables |= not can_be_tiled(self._loaded.tree)
        is_more = True
        while is_more and not self.file.is_whole:
            reads = lookup_reads(self._loaded, request)
            cells = cells_of(reads.values())
            is_more = has_tables and self.file.fetch_tables(self._loaded.tree, max(cells, default=0))
            is_more |= self._fetch_nodes(cells, request.settings.filter)
            if not is_more:
                is_more = self.file.fetch_rows(partial(add_reads, self._loaded, reads, request))
            self._renew(is_more)
        return self.load_all(self._loaded) if self.file.is_whole else self._loaded

    def _fetched_around(self, request: Request) -> OctreeTexture:
        """Fetch the groups that decide which points leaves hold, and return the texture."""
        depth = self._loaded.tree.max_depth
        points = np.nan_to_num(request.inputs["points"], posinf=0.0, neginf=0.0)
        codes = encode_cells(on_grid(points, self._loaded.placement) >> (GRID_BITS - depth))
        self._renew(self._fetch_nodes({depth: distinct(codes)}, "nearest"))
        return self._loaded

    def _fetch_nodes(self, cells: dict[int, Int64s], filter: str) -> bool:
        """Fetch the groups around cells, by level; return whether any were missing."""
        reached_filter, reached = self._reached
        is_same_request = filter == reached_filter and reached.keys() == cells.keys()
        if is_same_request and all(np.array_equal(reached[level], codes) for level, codes in cells.items()):
            return False
        was_fetched = False
        for nodes in nodes_read(self._loaded.tree, cells, filter):
            was_fetched |= self._fetch_groups(nodes)
        self._reached = filter, cells
        return was_fetched

    def _fetch_groups(self, nodes: Int64s) -> bool:
        """Fetch the groups of nodes; return whether any were missing."""
        groups = self._loaded.tree.arrays.groups
        return self.file.fetch_rows(lambda rows: rows.nodes(groups, nodes))

    def _renew(self, has_more: bool) -> None:
        """Drop the texture's indices if more of it has come."""
        if has_more:
            loaded = self._loaded
            self._loaded = loaded._with_parts(loaded.tree, loaded.channels, loaded.storage)


class _RemoteTree(Octree):
    """A tree at an address; it fetches arrays on access."""

    __slots__ = ("_fetch", "_loaded")

    def __init__(self, tree: Octree, fetch: Fetch) -> None:
        self._loaded, self._fetch = tree, fetch
        self.level_cells, self.level_nodes = tree.level_cells, tree.level_nodes

    def __getattr__(self, name: str) -> Any:
        """Return the arrays, the split table or the kept nodes."""
        arrays = getattr(self._loaded, name)
        self._fetch(*arrays)
        return arrays

    def __reduce__(self) -> tuple[Any, ...]:
        return Octree, (self.arrays, self.split, self.kept)


class _RemoteChannel(Channel):
    """A channel at an address; it fetches values on access."""

    _fetch: Fetch
    values = property(lambda self: self[1])
    split_values = property(lambda self: self[2])
    kept_values = property(lambda self: self[3])

    @classmethod
    def over(cls, channel: Channel, fetch: Fetch) -> _RemoteChannel:
        """Return a fetching channel."""
        fetching = cls(*channel)
        fetching._fetch = fetch
        return fetching

    def __getitem__(self, key: Any) -> Any:
        item = super().__getitem__(key)
        items = item if isinstance(key, slice) else [item]
        self._fetch(*(each for each in items if isinstance(each, np.ndarray)))
        return item

    def __iter__(self) -> Any:
        return map(self.__getitem__, range(4))

    def _replace(self, **changes: Any) -> Channel:  # type: ignore[override]
        return Channel(*self)._replace(**changes)

    def __reduce__(self) -> tuple[Any, ...]:
        return Channel, tuple(self)


class RenderFile(RemoteFile):
    """A render file at an address; arrays are views of its mapping."""

    def fetch_rows(self, gather: Callable[[RowsRead], None]) -> bool:
        """Fetch the rows that a function gathers; return whether any were missing."""
        rows = Spans(self.mapping, BLOCK)
        gather(rows)
        return self.fetch(rows.ranges().tolist())

    def fetch_tables(self, tree: Octree, level: int) -> bool:
        """Fetch the tables of split and kept cells down to a level; return whether any were missing."""
        split, n_cells, n_split = tree.split, int(tree.level_cells[level + 1]), _LEAST_SPLIT
        kept: list[Array] = [tree.kept.cells, tree.arrays.flags[:n_cells]] if tree.kept.cells.size else []
        was_more = fetch_arrays(self, *kept, split.cells[: n_split + 1])
        # The table is in the cells' order: fetch it in the steps of its search.
        while n_split < split.cells.size and split.cells[n_split] < n_cells:
            n_split *= 2
            was_more |= fetch_arrays(self, split.cells[: n_split + 1])
        return fetch_arrays(self, split.facings[: n_split + 1]) or was_more


class _ArchiveRows(RowsRead):
    """Gathers the rows to decode of an archive."""

    def __init__(self, archive: Archive) -> None:
        self._archive = archive
        self.level = 0  # of the structure
        self.tables: dict[str, list[tuple[str, Int64s]]] = {}  # rows of areas and channels

    def rows(self, array: Array, rows: Array) -> None:
        """Add rows."""
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
        """Add the groups of nodes."""
        if groups.size and nodes.size:
            firsts = self._archive.level_nodes
            last = min(int(nodes.max()), int(firsts[-1]) - 1)
            self.level = max(self.level, int(np.searchsorted(firsts, last, "right")))


class Archive:
    """An archive at an address, decoded into arrays as far as requested.

    Raises TextureFileError, which names the address, for a damaged one.
    """

    def __init__(self, remote: RemoteFile) -> None:
        self._remote = remote
        self._lock = RLock()
        with self._decoded():
            self.decoding = Decoding(remote.mapping, remote.fetch)
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

    def fetch_rows(self, gather: Callable[[RowsRead], None]) -> bool:
        """Fetch the rows that a function gathers; return whether any were missing."""
        rows = _ArchiveRows(self)
        gather(rows)
        with self._decoded():
            return self.decoding.decode(rows.tables, rows.level)

    def fetch_tables(self, _tree: Octree, level: int) -> bool:
        """Fetch the tables of split and kept cells down to a level; return whether any were missing."""
        with self._decoded():
            return self.decoding.decode({}, level)

    def fetch_all(self) -> None:
        """Fetch all of it."""
        with self._decoded():
            self.decoding.decode_all()

    def checked_once(self) -> AbstractContextManager[None]:
        """Check once, at the end of the block, whether the file has changed."""
        return self._remote.checked_once()

    def place_of(self, array: Array) -> tuple[str | None, int]:
        """Return the tensor that an array is a view of, None for none, and its first row."""
        address = array.ctypes.data
        if array.nbytes:
            for begin, end, name, length in self._places:
                if begin <= address < end:
                    return name, (address - begin) // length
        return None, 0

    @contextmanager
    def _decoded(self) -> Iterator[None]:
        with self._lock, naming(self._remote.address):
            yield


#: A file at an address.
RemoteContent = RenderFile | Archive


def fetch_arrays(file: RemoteContent, *arrays: Array) -> bool:
    """Fetch whole arrays of a file, or views of them; return whether any part was missing."""

    def gather(rows: RowsRead) -> None:
        for array in arrays:
            rows.until(array, len(array))

    return file.fetch_rows(gather)
