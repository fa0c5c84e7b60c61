"""A texture whose file is elsewhere: each lookup fetches the bytes that it will read before it reads them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import RLock
from types import MappingProxyType
from typing import Any

import numpy as np

from octex import container
from octex.archive.layout import MAGIC
from octex.arrays import Array, Int64s, Uint8s
from octex.checks import as_depth
from octex.errors import InputError, TextureFileError
from octex.field.field import Field
from octex.field.tiles import can_be_tiled
from octex.texture.channel import Channel
from octex.texture.elsewhere import Archive, Elsewhere, RenderFile
from octex.texture.file import File, taken
from octex.texture.lookup import Given, Lens, placed
from octex.texture.spans import cells_of, nodes_read
from octex.texture.texture import OctreeTexture
from octex.tree.layout import KeptTable, SplitTable, TreeArrays
from octex.tree.morton import encode_cells
from octex.tree.octree import Octree, distinct

#: Bytes that are fetched first: the header, and what says which cells there are down to some level.
_FIRST = 1 << 14

Fetch = Callable[..., None]


def open_remote(address: str, cache: Path | None = None) -> OctreeTexture:
    """Open the file at an address, of which the header is fetched, or the directory of an archive.

    Raises TextureFileError, OutputError and MissingExtraError: see RemoteFile.
    """
    remote = RenderFile(address, cache)
    remote.fetch(np.array([[0, min(len(MAGIC), remote.size)]]))
    if remote.mapping[: len(MAGIC)] == MAGIC:
        archive = Archive(remote)
        tensors, metadata, sizes = archive.contents
        return _opened(File(address, None, dict(tensors), dict(metadata), sizes), archive)
    remote.fetch(np.array([[0, min(_FIRST, remote.size)]]))
    length = 8 + int.from_bytes(remote.mapping[:8], "little")
    if length <= remote.size:
        remote.fetch(np.array([[0, length]]))
    contents = container.read_mapped(remote.mapping, address)
    levels = [contents.tensors.get(f"tree/{name}") for name in ("level_cells", "level_nodes")]
    remote.fetch_arrays(*(array for array in levels if array is not None))
    if not all(map(remote.holds, contents.tensors.values())):  # what is not aligned was copied
        remote.fetch_all()
        contents = container.read_mapped(remote.mapping, address)
    file = File(address, remote.mapping, dict(contents.tensors), dict(contents.metadata))
    return _opened(file, remote)


def _opened(file: File, remote: Elsewhere) -> RemoteTexture:
    try:
        partial = _Partial(*taken(file.tensors, file.metadata))
    except InputError as error:
        raise TextureFileError(f"{file.path}: {error}") from error
    partial._file = file
    return RemoteTexture(partial.renewed(remote), remote)


class RemoteTexture(OctreeTexture):
    """A texture whose file is elsewhere. Lookups fetch what they read; all else, what it asks for, whole."""

    __slots__ = ("_channels", "_fetching", "_is_whole", "_partial", "_reached", "_remote", "_tree")

    def __init__(self, partial: _Partial, remote: Elsewhere) -> None:
        self._partial, self._remote = partial, remote
        self._fetching = RLock()
        self._is_whole = remote.is_whole
        self._reached: tuple[str, dict[int, Int64s]] = "", {}
        self._tree = _Tree(partial.tree, remote.fetch_arrays)
        self._channels = MappingProxyType(
            {name: _Channel.over(channel, remote.fetch_arrays) for name, channel in partial.channels.items()}
        )
        self._field = Field(self._tree)
        for name in ("placement", "bounds", "metadata", "_components", "_file", "_known_mixed",
                     "_known_plain", "_known_stored"):  # fmt: skip
            setattr(self, name, getattr(partial, name))

    @property
    def tree(self) -> Octree:  # type: ignore[override]
        """The tree, whose arrays are fetched when they are asked for."""
        return self._tree

    @property
    def channels(self) -> MappingProxyType[str, Channel]:  # type: ignore[override]
        """The channels, whose values are fetched when they are asked for."""
        return self._channels

    def __reduce__(self) -> tuple[Any, ...]:
        return self._whole().__reduce__()

    def sample(
        self, points: Any, channel: Any = "base_color", filter: Any = "quadratic", **options: Any
    ) -> Any:
        """Look up the field; see `OctreeTexture.sample`."""
        here = self._fetched_for(points, channel, filter, options)
        return here.sample(points, channel, filter, **options)

    def taps(
        self, points: Any, channel: Any = "base_color", filter: Any = "quadratic", **options: Any
    ) -> Any:
        """List what ``sample`` blends; see `OctreeTexture.taps`."""
        here = self._fetched_for(points, channel, filter, options)
        return here.taps(points, channel, filter, **options)

    def blocks(
        self, points: Any, channel: Any = "base_color", filter: Any = "quadratic", **options: Any
    ) -> Any:
        """List the bytes that ``sample`` needs, which are fetched; see `OctreeTexture.blocks`."""
        here = self._fetched_for(points, channel, filter, options)
        return here.blocks(points, channel, filter, **options)

    def contains(self, points: Any, **options: Any) -> Any:
        """Say which points leaves hold; see `OctreeTexture.contains`."""
        return self._fetched_around(placed(points)[0]).contains(points, **options)

    def level(self, level: int) -> OctreeTexture:
        """Return the texture of levels 0 … ``level``, which are fetched; see `OctreeTexture.level`."""
        if as_depth(level, "level") >= self._tree.max_depth:
            return self
        here = self._partial.tree.arrays
        with self._fetching:
            self._remote.fetch_nodes(here.groups, int(here.level_nodes[level]))
            self._partial = self._partial.renewed()
        found = self._partial.level(level)
        tree, values = found.tree, [array for channel in found.channels.values() for array in channel[1:]]
        self._remote.fetch_arrays(*tree.arrays[1:], *tree.split, *tree.kept, *values)
        return found

    def save(self, path: Any, *, max_error: int = 0) -> None:
        """Write all of the texture; see `OctreeTexture.save`."""
        self._whole().save(path, max_error=max_error)

    def validate(self) -> None:
        """Prove that all of the texture is sound; see `OctreeTexture.validate`."""
        self._whole().validate()

    def info(self) -> dict[str, Any]:
        """Describe the texture, of which nothing is fetched; see `OctreeTexture.info`."""
        return self._partial.info()

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return self._partial.nbytes

    def _whole(self) -> OctreeTexture:
        with self._fetching:
            self._remote.fetch_all()
            if not self._is_whole:
                self._partial, self._is_whole = self._partial.renewed(), True
            return self._partial

    def _fetched_for(self, points: Any, channel: Any, filter: Any, options: dict[str, Any]) -> OctreeTexture:
        """Fetch what a lookup reads, and return the texture that answers it."""
        lens = Lens(filter, **{name: options[name] for name in Lens._fields if name in options})
        normals, width, dPdx, dPdy = (options.get(name) for name in ("normals", "width", "dPdx", "dPdy"))
        given = lens.given(points, normals=normals, width=width, dPdx=dPdx, dPdy=dPdy)
        return self._fetched(channel, lens, given)

    def _ready_for(
        self,
        _count: int,
        channel: str | list[str] | tuple[str, ...] | None,
        lens: Lens | None,
        given: Callable[[], Given],
    ) -> OctreeTexture:
        """Fetch what lookups read, and return the texture that answers them."""
        if channel is None or lens is None:
            return self._fetched_around(given()["points"])
        return self._fetched(channel, lens, given())

    def _fetched(self, channel: str | list[str] | tuple[str, ...], lens: Lens, given: Given) -> OctreeTexture:
        """Fetch what a lookup reads, and return the texture that answers it.

        What says which cells there are around the points comes first, level by level, then what these are
        said to hold. Coarse cells that mix facings leave looks to finer ones: then around these, too.
        """
        with self._fetching, self._remote.checked_once():
            is_first, is_tiled = True, can_be_tiled(self._partial.tree)
            while not self._remote.is_whole:
                if not lens.has_footprints(given) and ("normals" in given or not is_tiled):
                    self._partial._field.level(self._tree.max_depth)
                reads = self._partial._reads(channel, lens, given, cells_alone=is_first)
                is_more = self._fetch_nodes(cells_of(reads.values()), lens.filter)
                if not (is_first or is_more):
                    rows = self._remote.rows()
                    self._partial._add_reads(rows, reads, lens, given)
                    self._remote.fetch_rows(rows)
                    return self._partial
                is_first = False
            return self._whole()

    def _fetched_around(self, points: Array) -> OctreeTexture:
        """Fetch what says which points leaves hold, and return the texture that says so."""
        origin, size = self.placement
        places = np.clip(np.nan_to_num((points - np.array(origin)) / size), 0.0, 1.0)
        depth = self._tree.max_depth
        cells = np.minimum((places * 2**depth).astype(np.int64), 2**depth - 1)
        with self._fetching:
            self._fetch_nodes({depth: distinct(encode_cells(cells))}, "nearest")
            return self._partial

    def _fetch_nodes(self, cells: dict[int, Int64s], filter: str) -> bool:
        """Fetch what says which cells there are around some, by level; say whether there was any."""
        known_filter, known = self._reached
        is_like = filter == known_filter and known.keys() == cells.keys()
        if is_like and all(np.array_equal(known[level], each) for level, each in cells.items()):
            return False
        was_fetched = False
        for nodes in nodes_read(self._partial.tree, cells, filter):
            rows = self._remote.rows()
            rows.nodes(self._partial.tree.arrays.groups, nodes)
            was_fetched |= self._remote.fetch_rows(rows)
        self._reached = filter, cells
        if was_fetched:
            self._partial = self._partial.renewed()
        return was_fetched


class _Partial(OctreeTexture):
    """A texture in a file of which only a part is here: it answers what that part says.

    What a field has indexed of it does not change: when more has come, there is a new one.
    """

    __slots__ = ("remote",)

    remote: Elsewhere

    def renewed(self, remote: Elsewhere | None = None) -> _Partial:
        """Return the same without what was indexed."""
        found = _Partial(self.tree, self.channels, self.placement, self.bounds, self.metadata)
        found._file = self._file
        found.remote = remote or self.remote
        found._field = _Field(found.tree, found.remote)
        return found

    def _mixed(self, channel: Channel, threshold: float, level: int) -> Uint8s:
        rows = self._field.level(level).tree.split.areas.size
        self.remote.fetch_arrays(channel.split_values[:rows])
        return super()._mixed(channel, threshold, level)


class _Field(Field):
    """The field over a tree of which only a part is here: of levels, the tables are fetched."""

    def __init__(self, tree: Octree, remote: Elsewhere) -> None:
        super().__init__(tree)
        self._remote = remote
        self._reached = -1
        self._reaching = RLock()

    def level(self, level: int) -> Field:
        """Return the field over a level, of which is here what says which cells are split or kept."""
        level = min(level, self.tree.max_depth)
        with self._reaching:
            if level > self._reached:
                self._remote.fetch_tables(self.tree, level)
                self._reached = level
        return super().level(level)

    def areas_of_averages(self, level: int) -> Uint8s:
        """Return the codes of the areas of nodes down to a level, which are fetched."""
        if level not in self._areas:
            self._remote.fetch_arrays(self.tree.arrays.areas[: int(self.tree.arrays.level_cells[level + 1])])
        return super().areas_of_averages(level)


class _Tree(Octree):
    """A tree of which only a part is here: its arrays are fetched when they are asked for."""

    __slots__ = ("_fetch_arrays", "_here")

    def __init__(self, here: Octree, fetch_arrays: Fetch) -> None:
        self._here, self._fetch_arrays = here, fetch_arrays

    def _fetched(self, arrays: Any) -> Any:
        self._fetch_arrays(*arrays)
        return arrays

    @property
    def arrays(self) -> TreeArrays:  # type: ignore[override]
        """Structure, flags and areas."""
        found: TreeArrays = self._fetched(self._here.arrays)
        return found

    @property
    def split(self) -> SplitTable:  # type: ignore[override]
        """The split table."""
        found: SplitTable = self._fetched(self._here.split)
        return found

    @property
    def kept(self) -> KeptTable:  # type: ignore[override]
        """The kept nodes."""
        found: KeptTable = self._fetched(self._here.kept)
        return found

    @property
    def max_depth(self) -> int:
        """The level of the deepest cell."""
        return self._here.max_depth

    @property
    def n_cells(self) -> int:
        """Number of leaves and nodes."""
        return self._here.n_cells

    @property
    def n_nodes(self) -> int:
        """Number of cells with children."""
        return self._here.n_nodes

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return self._here.nbytes

    def cells_by_depth(self) -> list[tuple[int, int]]:
        """Numbers of leaves and of nodes at each level."""
        return self._here.cells_by_depth()

    def __reduce__(self) -> tuple[Any, ...]:
        return Octree, (self.arrays, self.split, self.kept)


class _Channel(Channel):
    """A channel of which only a part is here: its values are fetched when they are asked for."""

    _fetch_arrays: Fetch
    _here: Channel

    @classmethod
    def over(cls, here: Channel, fetch_arrays: Fetch) -> _Channel:
        """Return what fetches the values of a channel."""
        found = cls(*here)
        found._here, found._fetch_arrays = here, fetch_arrays
        return found

    def _fetched(self, array: Array) -> Array:
        self._fetch_arrays(array)
        return array

    @property
    def values(self) -> Array:
        """Values of all cells."""
        return self._fetched(self._here.values)

    @property
    def split_values(self) -> Array:
        """Values of all split rows."""
        return self._fetched(self._here.split_values)

    @property
    def kept_values(self) -> Array:
        """Values of all kept nodes."""
        return self._fetched(self._here.kept_values)

    def __iter__(self) -> Any:
        return iter((self.format, self.values, self.split_values, self.kept_values))

    def __getitem__(self, key: Any) -> Any:
        return tuple(self)[key]

    @property
    def nbytes(self) -> int:
        """Bytes of all values."""
        return self._here.nbytes

    def __reduce__(self) -> tuple[Any, ...]:
        return Channel, tuple(self)
