"""A texture whose file is elsewhere: each lookup fetches the bytes that it will read before it reads them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from threading import RLock
from types import MappingProxyType
from typing import Any

import numpy as np

from octex import container
from octex.archive.layout import MAGIC
from octex.arrays import Array, Uint8s
from octex.errors import InputError, TextureFileError
from octex.field.field import Field
from octex.files import scratch_folder
from octex.remote import BLOCK, RemoteFile
from octex.texture.channel import Channel
from octex.texture.file import File, taken
from octex.texture.texture import OctreeTexture, open_texture
from octex.tree.layout import KeptTable, SplitTable, TreeArrays
from octex.tree.octree import Octree

#: What of a lookup says which bytes it reads.
_VIEW = "width", "normals", "dPdx", "dPdy", "anisotropy", "blur", "sharpness", "bleed_threshold"

Fetch = Callable[..., None]


def open_remote(address: str, cache: Path | None = None) -> OctreeTexture:
    """Open the file at an address, of which only the header is fetched; an archive is fetched whole.

    Raises TextureFileError, OutputError and MissingExtraError: see RemoteFile.
    """
    remote = RemoteFile(address, cache)
    remote.fetch(np.array([[0, min(4 * BLOCK, remote.size)]]))
    if remote.mapping[: len(MAGIC)] == MAGIC:
        remote.fetch_all()
        with scratch_folder() as folder:
            with (folder / "archive.octz").open("wb") as file:
                remote.mapping.seek(0)
                shutil.copyfileobj(remote.mapping, file)
            try:
                return open_texture(folder / "archive.octz")
            except TextureFileError as error:
                text = str(error).replace(str(folder / "archive.octz"), address)
                raise TextureFileError(text) from error
    length = 8 + int.from_bytes(remote.mapping[:8], "little")
    if length <= remote.size:
        remote.fetch(np.array([[0, length]]))
    contents = container.read_mapped(remote.mapping, address)
    for name in ("tree/level_cells", "tree/level_nodes"):
        if name in contents.tensors:
            remote.fetch_rows(contents.tensors[name])
    if not all(map(remote.holds, contents.tensors.values())):  # what is not aligned was copied
        remote.fetch_all()
        contents = container.read_mapped(remote.mapping, address)
    tensors, metadata = dict(contents.tensors), dict(contents.metadata)
    try:
        partial = _Partial(*taken(tensors, metadata))
    except InputError as error:
        raise TextureFileError(f"{address}: {error}") from error
    partial._file = File(address, remote.mapping, tensors, metadata)
    partial.fetch_rows = remote.fetch_rows
    partial._field = _Field(partial.tree, remote.fetch_rows)
    return RemoteTexture(partial, remote)


class RemoteTexture(OctreeTexture):
    """A texture whose file is elsewhere. Lookups fetch what they read; all else, what it asks for, whole."""

    __slots__ = ("_channels", "_partial", "_remote", "_tree")

    def __init__(self, partial: _Partial, remote: RemoteFile) -> None:
        self._partial, self._remote = partial, remote
        self._tree = _Tree(partial.tree, remote.fetch_rows)
        self._channels = MappingProxyType(
            {name: _Channel.over(channel, remote.fetch_rows) for name, channel in partial.channels.items()}
        )
        for name in ("placement", "bounds", "metadata", "_components", "_field", "_file", "_known_mixed",
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
        self._fetch_for(points, channel, filter, options)
        return self._partial.sample(points, channel, filter, **options)

    def taps(
        self, points: Any, channel: Any = "base_color", filter: Any = "quadratic", **options: Any
    ) -> Any:
        """List what ``sample`` blends; see `OctreeTexture.taps`."""
        self._fetch_for(points, channel, filter, options)
        return self._partial.taps(points, channel, filter, **options)

    def blocks(
        self, points: Any, channel: Any = "base_color", filter: Any = "quadratic", **options: Any
    ) -> Any:
        """List the bytes that ``sample`` needs, which are fetched; see `OctreeTexture.blocks`."""
        self._fetch_for(points, channel, filter, options)
        return self._partial.blocks(points, channel, filter, **options)

    def contains(self, points: Any, **options: Any) -> Any:
        """Say which points leaves hold; see `OctreeTexture.contains`."""
        self._partial.reach(self._tree.max_depth)
        return self._partial.contains(points, **options)

    def level(self, level: int) -> OctreeTexture:
        """Return the texture of levels 0 … ``level``, which are fetched; see `OctreeTexture.level`."""
        found = self._partial.level(level)
        if found is self._partial:
            return self
        for array in (*found.tree.arrays, *found.tree.split, *found.tree.kept):
            self._remote.fetch_rows(array)
        for channel in found.channels.values():
            for array in channel[1:]:
                self._remote.fetch_rows(array)
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
        self._remote.fetch_all()
        return self._partial

    def _fetch_for(self, points: Any, channel: Any, filter: Any, options: dict[str, Any]) -> None:
        """Fetch what a lookup reads: what says which cells there are first, then what these are said to hold.

        Normal flags say which rows of values are read, so it is listed again until nothing is missing.
        """
        if self._remote.is_whole:
            return
        view = {name: options[name] for name in _VIEW if name in options}
        if all(view.get(name) is None for name in ("width", "dPdx", "dPdy")):
            self._partial.reach(self._tree.max_depth)
        while self._remote.fetch(self._partial.blocks(points, channel, filter, block_size=BLOCK, **view)):
            pass


class _Partial(OctreeTexture):
    """A texture in a file of which only a part is here: it answers what that part says."""

    __slots__ = ("fetch_rows",)

    fetch_rows: Fetch

    def reach(self, level: int) -> None:
        """Fetch what says which cells there are down to a level."""
        self._field.level(level)

    def _mixed(self, channel: Channel, threshold: float, level: int) -> Uint8s:
        rows = self._field.level(level).tree.split.areas.size
        self.fetch_rows(channel.split_values, rows)
        return super()._mixed(channel, threshold, level)


class _Field(Field):
    """The field over a tree of which only a part is here: levels are fetched when they are asked for."""

    def __init__(self, tree: Octree, fetch_rows: Fetch) -> None:
        super().__init__(tree)
        self._fetch_rows = fetch_rows
        self._reached = -1
        self._reaching = RLock()

    def level(self, level: int) -> Field:
        """Return the field over a level, of which is here what says which cells there are."""
        level = min(level, self.tree.max_depth)
        with self._reaching:
            if level > self._reached:
                self._reach(level)
                self._reached = level
        return super().level(level)

    def _reach(self, level: int) -> None:
        arrays, split, kept = self.tree.arrays, self.tree.split, self.tree.kept
        n_cells = int(arrays.level_cells[level + 1])
        self._fetch_rows(arrays.groups, -(-int(arrays.level_nodes[level]) // 8))
        self._fetch_rows(kept.cells)
        if kept.cells.size:
            self._fetch_rows(arrays.flags, n_cells)
        if any(leaves for leaves, _ in self.tree.cells_by_depth()[: level + 1]):
            self._fetch_rows(arrays.areas, n_cells)
        n_split = 1  # of the table, which is in the cells' order: in steps like those of its search
        self._fetch_rows(split.cells, n_split + 1)
        while n_split < split.cells.size and split.cells[n_split] < n_cells:
            n_split *= 2
            self._fetch_rows(split.cells, n_split + 1)
        self._fetch_rows(split.facings, n_split + 1)


class _Tree(Octree):
    """A tree of which only a part is here: its arrays are fetched when they are asked for."""

    __slots__ = ("_fetch_rows", "_here")

    def __init__(self, here: Octree, fetch_rows: Fetch) -> None:
        self._here, self._fetch_rows = here, fetch_rows

    def _fetched(self, arrays: Any) -> Any:
        for array in arrays:
            self._fetch_rows(array)
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

    _fetch_rows: Fetch
    _here: Channel

    @classmethod
    def over(cls, here: Channel, fetch_rows: Fetch) -> _Channel:
        """Return what fetches the values of a channel."""
        found = cls(*here)
        found._here, found._fetch_rows = here, fetch_rows
        return found

    def _fetched(self, array: Array) -> Array:
        self._fetch_rows(array)
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
