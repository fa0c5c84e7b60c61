"""The source of a texture whose file is elsewhere: it fetches what a lookup will read before it reads it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np

from octex import container
from octex.archive.layout import MAGIC
from octex.arrays import Int64s
from octex.field.tiles import can_be_tiled
from octex.texture.channel import Channel
from octex.texture.elsewhere import Archive, Elsewhere, RenderFile, fetch_arrays
from octex.texture.file import Source
from octex.texture.lookup import Question
from octex.texture.spans import add_reads, cells_of, lookup_reads, nodes_read
from octex.texture.texture import OctreeTexture, opened
from octex.tree.morton import encode_cells
from octex.tree.octree import Octree, distinct

#: Bytes that are fetched first: the header, and what says which cells there are down to some level.
_FIRST = 1 << 14

Fetch = Callable[..., object]


def open_remote(address: str, cache: Path | None = None) -> OctreeTexture:
    """Open the file at an address, of which the header is fetched, or the directory of an archive.

    Raises TextureFileError, OutputError and MissingExtraError: see RemoteFile.
    """
    remote = RenderFile(address, cache)
    file: Elsewhere = remote
    remote.fetch(np.array([[0, min(len(MAGIC), remote.size)]]))
    if remote.mapping[: len(MAGIC)] == MAGIC:
        file = archive = Archive(remote)
        tensors, metadata, sizes = archive.decoding.contents
        source = Source(address, None, dict(tensors), dict(metadata), sizes)
    else:
        remote.fetch(np.array([[0, min(_FIRST, remote.size)]]))
        length = container.header_length(remote.mapping)
        if length <= remote.size:
            remote.fetch(np.array([[0, length]]))
        contents = container.read_mapped(remote.mapping, address)
        levels = [contents.tensors.get(f"tree/{name}") for name in ("level_cells", "level_nodes")]
        fetch_arrays(remote, *(array for array in levels if array is not None))
        if not all(map(remote.holds, contents.tensors.values())):  # what is not aligned was copied
            remote.fetch_all()
            contents = container.read_mapped(remote.mapping, address)
        source = Source(address, remote.mapping, dict(contents.tensors), dict(contents.metadata))
    here, fetch = opened(source), partial(fetch_arrays, file)
    channels = {name: _Channel.over(channel, fetch) for name, channel in here.channels.items()}
    return here._over(_Tree(here.tree, fetch), channels, RemoteSource(here, file))


class RemoteSource(Source):
    """A file elsewhere. Lookups fetch what they read; all else, what it asks for, whole.

    What a field has indexed of a texture does not change: when more has come, there is a new one.
    """

    is_here = False

    def __init__(self, here: OctreeTexture, file: Elsewhere) -> None:
        super().__init__(here.source.path)
        self.file = file
        self._here = here
        self._fetching = RLock()
        self._is_whole = file.is_whole
        self._reached: tuple[str, dict[int, Int64s]] = "", {}

    def here(self, _texture: OctreeTexture) -> OctreeTexture:
        """Return a texture of what is here of it, zeros for what is not."""
        return self._here

    def whole(self, _texture: OctreeTexture) -> OctreeTexture:
        """Fetch all of the texture, and return it."""
        with self._fetching:
            self.file.fetch_all()
            if not self._is_whole:
                self._renew(True)
                self._is_whole = True
            return self._here

    def levels(self, _texture: OctreeTexture, level: int) -> OctreeTexture:
        """Fetch the levels 0 … ``level``, and return the texture that has them."""
        with self._fetching:
            was_more = self._fetch_groups(np.arange(int(self._here.tree.level_nodes[level])))
            self._renew(self.file.fetch_tables(self._here.tree, level) or was_more)
            tree = self._here.tree.truncated(level)
            values = [array for channel in self._here.channels.values() for array in channel.of(tree)[1:]]
            fetch_arrays(self.file, *tree.arrays[1:], *tree.split, *tree.kept, *values)
            return self._here

    def prepare(
        self, _texture: OctreeTexture, _count: int, question: Callable[[], Question], /
    ) -> OctreeTexture:
        """Fetch what lookups read, and return the texture that answers them."""
        with self._fetching, self.file.checked_once():
            found = question()
            return self._fetched_around(found) if found.channel is None else self._fetched(found)

    def _fetched(self, question: Question) -> OctreeTexture:
        """Fetch what lookups of channels read, and return the texture that answers them.

        What says which cells there are around the points comes first, level by level, then what these are
        said to hold. Coarse cells that mix facings leave looks to finer ones: so again until all is here.
        """
        given, _, lens = question
        has_tables = lens.has_footprints(given) or "normals" in given or not can_be_tiled(self._here.tree)
        is_first = is_more = True
        while is_more and not self.file.is_whole:
            reads = lookup_reads(self._here, question, cells_alone=is_first)
            cells = cells_of(reads.values())
            is_more = has_tables and self.file.fetch_tables(self._here.tree, max(cells, default=0))
            is_more |= self._fetch_nodes(cells, lens.filter)
            if not (is_first or is_more):
                is_more = self.file.fetch_rows(partial(add_reads, self._here, reads, question))
            self._renew(is_more)
            is_more |= is_first
            is_first = False
        return self.whole(self._here) if self.file.is_whole else self._here

    def _fetched_around(self, question: Question) -> OctreeTexture:
        """Fetch what says which points leaves hold, and return the texture that says so."""
        origin, size = self._here.placement
        places = np.clip(np.nan_to_num((question.given["points"] - np.array(origin)) / size), 0.0, 1.0)
        depth = self._here.tree.max_depth
        cells = np.minimum((places * 2**depth).astype(np.int64), 2**depth - 1)
        self._renew(self._fetch_nodes({depth: distinct(encode_cells(cells))}, "nearest"))
        return self._here

    def _fetch_nodes(self, cells: dict[int, Int64s], filter: str) -> bool:
        """Fetch what says which cells there are around some, by level; say whether there was any."""
        known_filter, known = self._reached
        is_like = filter == known_filter and known.keys() == cells.keys()
        if is_like and all(np.array_equal(known[level], each) for level, each in cells.items()):
            return False
        was_fetched = False
        for nodes in nodes_read(self._here.tree, cells, filter):
            was_fetched |= self._fetch_groups(nodes)
        self._reached = filter, cells
        return was_fetched

    def _fetch_groups(self, nodes: Int64s) -> bool:
        """Fetch the groups of some nodes; say whether there was anything to fetch."""
        groups = self._here.tree.arrays.groups
        return self.file.fetch_rows(lambda rows: rows.nodes(groups, nodes))

    def _renew(self, has_more: bool) -> None:
        """Forget what was indexed of the texture, if more of it has come."""
        if has_more:
            self._here = self._here._over(self._here.tree, self._here.channels, self._here.source)


class _Tree(Octree):
    """A tree elsewhere: its arrays are fetched when they are asked for."""

    __slots__ = ("_fetch", "_here")

    def __init__(self, here: Octree, fetch: Fetch) -> None:
        self._here, self._fetch = here, fetch
        self.level_cells, self.level_nodes = here.level_cells, here.level_nodes

    def __getattr__(self, name: str) -> Any:
        """Return the arrays, the split table or the kept nodes."""
        found = getattr(self._here, name)
        self._fetch(*found)
        return found

    def __reduce__(self) -> tuple[Any, ...]:
        return Octree, (self.arrays, self.split, self.kept)


class _Channel(Channel):
    """A channel elsewhere: its values are fetched when they are asked for."""

    _fetch: Fetch
    values = property(lambda self: self[1])
    split_values = property(lambda self: self[2])
    kept_values = property(lambda self: self[3])

    @classmethod
    def over(cls, here: Channel, fetch: Fetch) -> _Channel:
        """Return what fetches the values of a channel."""
        found = cls(*here)
        found._fetch = fetch
        return found

    def __getitem__(self, key: Any) -> Any:
        found = super().__getitem__(key)
        several = found if isinstance(key, slice) else [found]
        self._fetch(*(each for each in several if isinstance(each, np.ndarray)))
        return found

    def __iter__(self) -> Any:
        return map(self.__getitem__, range(4))

    def _replace(self, **changes: Any) -> Channel:  # type: ignore[override]
        return Channel(*self)._replace(**changes)

    def __reduce__(self) -> tuple[Any, ...]:
        return Channel, tuple(self)
