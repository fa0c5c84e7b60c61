"""OctreeTexture: a tree, channels of values and a placement; what everything else meets.

In a file (see container for the bytes around it), with n cells, s of them split, with r rows:

    tree/groups           U64 (⌈nodes / 8⌉, 3)       these five as tree/layout draws them
    tree/level_cells      I64 (max_depth + 2,)
    tree/level_nodes      I64 (max_depth + 2,)
    tree/flags            U8 (n,)
    tree/areas            U8 (n,)
    split/cells           U32 (s,)                   the split table; absent without split cells
    split/facings         U8 (s,)
    split/areas           U8 (r,)
    channels/NAME         U8, U16, F16 or F32 (n, components)
    split/channels/NAME   the same type (r, components); likewise

    metadata              "format": "octex", "format_version": "1", and as JSON
    placement             {"origin": [x, y, z], "size": edge} of the root cell, in rest positions
    bounds                [[x, y, z], [x, y, z]] of the surface, in rest positions
    channels              {NAME: colour space, …}, in the order of the texture's channels
    provenance            {name: text, …}

Other tensors and metadata are kept when an opened texture is saved again.
"""

from __future__ import annotations

import json
import math
import mmap
import os
from collections.abc import Callable, Mapping
from functools import cache
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar, overload

import numpy as np
import numpy.typing as npt

from octex import container
from octex.channels import COLOR_SPACES, ONE, ChannelFormat, ColorSpace, decode, decode_table
from octex.checks import as_choice, as_depth, as_points
from octex.errors import ArgumentError, InputError, TextureFileError
from octex.jit import kernel
from octex.tree.layout import SplitTable, TreeArrays
from octex.tree.octree import Octree, no_split
from octex.tree.placement import Placement
from octex.tree.search import in_leaves, nearest_cells

Array = npt.NDArray[Any]
Result = TypeVar("Result")

FORMAT = "octex"
FORMAT_VERSION = 1
ENDING = ".octex"
#: How a lookup turns cells into a value.
FILTERS = ("nearest",)
#: Points looked up at once: the cell numbers stay in the processor's cache.
_BLOCK = 1 << 14


class Channel(NamedTuple):
    """A named array of values, one a cell: a leaf's value, or a node's average."""

    format: ChannelFormat
    values: Array  # (cells, components)   as stored
    split_values: Array  # (split rows, components)


class _File(NamedTuple):
    """The file that a texture was opened from."""

    path: str
    mapping: mmap.mmap
    tensors: dict[str, Array]  # those that octex does not know
    metadata: dict[str, str]


class OctreeTexture:
    """Values stored in the octree cells that a surface passes through, looked up by rest position.

    Immutable. ``metadata`` is provenance: free text by name, kept in the file.

    Raises ArgumentError if tree, channels, placement and bounds do not fit together.
    """

    __slots__ = ("_file", "bounds", "channels", "metadata", "placement", "tree")

    def __init__(
        self,
        tree: Octree,
        channels: Mapping[str, Channel],
        placement: Placement,
        bounds: npt.ArrayLike,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        self.tree = tree
        self.channels = MappingProxyType(dict(channels))
        x, y, z = map(float, placement.origin)
        self.placement = Placement((x, y, z), float(placement.size))
        self.bounds = np.asarray(bounds, np.float64)
        self.metadata = MappingProxyType(dict(metadata or {}))
        self._file: _File | None = None
        if not all(isinstance(text, str) for pair in self.metadata.items() for text in pair):
            raise ArgumentError("metadata must map strings to strings")
        for name, channel in self.channels.items():
            _check_channel(name, channel, tree)
        if not np.isfinite(self.placement.origin).all() or not 0 < self.placement.size < math.inf:
            raise ArgumentError(f"the root cell must be finite, its size above zero, not {self.placement}")
        if self.bounds.shape != (2, 3) or not np.isfinite(self.bounds).all():
            raise ArgumentError(f"bounds must be two finite corners, not {self.bounds.tolist()}")

    def __repr__(self) -> str:
        return f"<OctreeTexture of {', '.join(self.channels) or 'no channels'}; {self.tree!r}>"

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays: structure, flags, areas, values and the split table."""
        values = sum(
            channel.values.nbytes + channel.split_values.nbytes for channel in self.channels.values()
        )
        return self.tree.nbytes + values

    @overload
    def sample(
        self,
        points: npt.ArrayLike,
        channel: str = "base_color",
        filter: str = "nearest",
        normalize: bool = True,
    ) -> npt.NDArray[np.float32]: ...
    @overload
    def sample(
        self,
        points: npt.ArrayLike,
        channel: list[str] | tuple[str, ...],
        filter: str = "nearest",
        normalize: bool = True,
    ) -> dict[str, npt.NDArray[np.float32]]: ...
    def sample(
        self,
        points: npt.ArrayLike,
        channel: str | list[str] | tuple[str, ...] = "base_color",
        filter: str = "nearest",
        normalize: bool = True,
    ) -> npt.NDArray[np.float32] | dict[str, npt.NDArray[np.float32]]:
        """Look up values at rest positions (n, 3), float32 or float64.

        Returns float32 (n, components): linear light for colours, −1 … 1 for directions, 0 … 1 for other
        integers. A list of channel names gives a dict. ``nearest``: the leaf that holds the point; else the
        nearest cell among the 27 around it at the deepest level that has one there, so that every point has
        a value.

        Directions come back as unit vectors; without ``normalize`` as the means that are stored, whose
        length, 1 where all directions agree, tells how far they spread. A mean of zero stays zeros in floats;
        integers have no code for zero, so it has no direction worth the name there.

        Raises ArgumentError for positions that are not finite (n, 3), and for unknown channels and filters.
        """
        points = as_points(points)
        as_choice(filter, FILTERS, "filter")
        names = [channel] if isinstance(channel, str) else list(channel)
        for name in names:
            as_choice(name, self.channels, "channel")
        wanted = [self.channels[name] for name in names]
        results = [np.empty((len(points), values.shape[1]), np.float32) for _, values, _ in wanted]
        cells = np.empty(min(len(points), _BLOCK), np.int64)

        def look_up(begin: int, block: Array) -> int:
            fault = nearest_cells(self.tree.arrays, block, *self.placement, cells)
            if fault < 0:
                for (form, values, _), result in zip(wanted, results, strict=True):
                    rows = result[begin : begin + len(block)]
                    _gather(values, form.space, cells[: len(block)], rows)
                    if normalize and form.space == "direction":
                        _normalize(rows)
            return fault

        self._in_blocks(points, look_up)
        return results[0] if isinstance(channel, str) else dict(zip(names, results, strict=True))

    def contains(self, points: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Say of each rest position (n, 3) whether a leaf holds it.

        Raises ArgumentError for positions that are not finite (n, 3).
        """
        points = as_points(points)
        inside = np.empty(len(points), np.bool_)
        self._in_blocks(
            points,
            lambda begin, block: in_leaves(self.tree.arrays, block, *self.placement, inside[begin:]),
        )
        return inside

    def _in_blocks(self, points: Array, look_up: Callable[[int, Array], int]) -> None:
        if len(points) * mmap.PAGESIZE > self.nbytes:  # about a page a point: most of the file will be read
            self._read_ahead()
        for begin in range(0, len(points), _BLOCK):
            fault = look_up(begin, points[begin : begin + _BLOCK])
            if fault >= 0:
                row = points[begin + fault].tolist()
                raise ArgumentError(f"points must be finite, but points[{begin + fault}] is {row}")

    def level(self, level: int) -> OctreeTexture:
        """Return the texture of levels 0 … ``level``, whose leaves include the averages stored there.

        Its arrays are views; nothing deeper is read. Raises ArgumentError for a level that is not 0 … 21.
        """
        if as_depth(level, "level") >= self.tree.max_depth:
            return self
        tree = self.tree.truncated(level)
        rows = tree.split.areas.size
        channels = {
            name: Channel(form, values[: tree.n_cells], split_values[:rows])
            for name, (form, values, split_values) in self.channels.items()
        }
        return OctreeTexture(tree, channels, self.placement, self.bounds, self.metadata)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an ``.octex`` file; the same texture gives the same bytes.

        Raises ArgumentError for another ending, OutputError if the file cannot be written; what stood at
        ``path`` then still stands.
        """
        if not os.fspath(path).lower().endswith(ENDING):
            raise ArgumentError(f"{path}: a texture is saved as NAME{ENDING}")
        self._read_ahead()
        container.write(path, *self._contents())

    def validate(self) -> None:
        """Prove that the tree is sound and the values are finite.

        Raises TextureFileError that names what is broken.
        """
        self._read_ahead()
        try:
            self.tree.validate()
            for name, (_, *arrays) in self.channels.items():
                if not all(np.isfinite(array).all() for array in arrays if array.dtype.kind == "f"):
                    raise TextureFileError(f"channel {name!r} has values that are not finite")
        except TextureFileError as error:
            raise TextureFileError(f"{self._file.path}: {error}" if self._file else str(error)) from None

    def info(self) -> dict[str, Any]:
        """Describe the texture as numbers and strings, ready for JSON. Lengths are in the model's units.

        Reads no cell. ``bytes`` says where the bytes of its file go.
        """
        tree = self.tree
        tensors, metadata = self._contents()
        parts = {
            "header": len(container.header(tensors, metadata)),
            "structure": sum(array.nbytes for array in tree.arrays[:3]),
            "flags": tree.arrays.flags.nbytes,
            "areas": tree.arrays.areas.nbytes,
            "split": sum(array.nbytes for array in tree.split),
            **{
                f"channel {name}": channel.values.nbytes + channel.split_values.nbytes
                for name, channel in self.channels.items()
            },
            "other": sum(array.nbytes for array in self._file.tensors.values()) if self._file else 0,
        }
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "placement": {"origin": list(self.placement.origin), "size": self.placement.size},
            "bounds": self.bounds.tolist(),
            "depth": tree.max_depth,
            "finest_cell": self.placement.size / (1 << tree.max_depth),
            "cells": tree.n_cells,
            "leaves": tree.n_leaves,
            "nodes": tree.n_nodes,
            "split_cells": tree.split.cells.size,
            "levels": [
                {"level": level, "leaves": leaves, "nodes": nodes}
                for level, (leaves, nodes) in enumerate(tree.cells_by_depth())
            ],
            "bytes": {**parts, "total": sum(parts.values())},
            "channels": [channel.format._asdict() for channel in self.channels.values()],
            "provenance": dict(self.metadata),
        }

    def _read_ahead(self) -> None:
        if self._file:
            container.read_ahead(self._file.mapping)

    def _contents(self) -> tuple[dict[str, Array], dict[str, str]]:
        arrays, split = self.tree.arrays, self.tree.split
        tensors: dict[str, Array] = {f"tree/{name}": array for name, array in arrays._asdict().items()}
        if split.cells.size:
            tensors |= {f"split/{name}": array for name, array in split._asdict().items()}
        for name, channel in self.channels.items():
            tensors[f"channels/{name}"] = channel.values
            if split.cells.size:
                tensors[f"split/channels/{name}"] = channel.split_values
        metadata = {
            "format": FORMAT,
            "format_version": str(FORMAT_VERSION),
            "placement": json.dumps({"origin": self.placement.origin, "size": self.placement.size}),
            "bounds": json.dumps(self.bounds.tolist()),
            "channels": json.dumps({name: channel.format.space for name, channel in self.channels.items()}),
            "provenance": json.dumps(dict(self.metadata)),
        }
        if self._file:
            tensors |= self._file.tensors
            metadata |= self._file.metadata
        return tensors, metadata


def open_texture(path: str | os.PathLike[str]) -> OctreeTexture:
    """Open an ``.octex`` file. It is mapped: only its header is read, the rest when it is looked at.

    Raises TextureFileError for a file that is missing, damaged, of another type or of a newer version.
    """
    contents = container.read(path)
    try:
        return _assembled(os.fspath(path), contents)
    except InputError as error:
        raise TextureFileError(f"{path}: {error}") from error


def _assembled(path: str, contents: container.Contents) -> OctreeTexture:
    tensors, metadata = dict(contents.tensors), dict(contents.metadata)
    if metadata.pop("format", None) != FORMAT:
        raise TextureFileError("is not an octree texture; make one with octree-convert")
    version = metadata.pop("format_version", "")
    if version != str(FORMAT_VERSION):
        raise TextureFileError(f"has format version {version!r}, newer than this octex reads; update octex")
    placement = _taken_json(metadata, "placement", _placement)
    bounds = _taken_json(metadata, "bounds", _floats)
    spaces = _taken_json(metadata, "channels", _texts)
    provenance = _taken_json(metadata, "provenance", _texts)
    arrays = TreeArrays(*(_taken(tensors, f"tree/{name}") for name in TreeArrays._fields))
    split = no_split()
    if "split/cells" in tensors:
        split = SplitTable(*(_taken(tensors, f"split/{name}") for name in SplitTable._fields))
    tree = Octree(arrays, split)
    channels = {}
    for name, space in spaces.items():
        values = _taken(tensors, f"channels/{name}")
        if values.ndim != 2:
            raise TextureFileError(f"channel {name!r} has shape {values.shape}, not a row a cell")
        split_values = _taken(tensors, f"split/channels/{name}") if split.cells.size else values[:0]
        form = ChannelFormat(name, values.shape[1], space, values.dtype.name)  # type: ignore[arg-type]
        channels[name] = Channel(form, values, split_values)
    texture = OctreeTexture(tree, channels, placement, bounds, provenance)
    texture._file = _File(path, contents.mapping, tensors, metadata)
    return texture


def _taken(tensors: dict[str, Array], name: str) -> Array:
    if name not in tensors:
        raise TextureFileError(f"lacks the tensor {name!r}: damaged, or not an octree texture")
    return tensors.pop(name)


def _taken_json(metadata: dict[str, str], name: str, meaning: Callable[[Any], Result]) -> Result:
    try:
        return meaning(json.loads(metadata.pop(name)))
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError):
        raise TextureFileError(f"its metadata {name!r} are missing or damaged") from None


def _placement(value: Any) -> Placement:
    x, y, z = _floats(value["origin"]).tolist()
    return Placement((x, y, z), float(value["size"]))


def _floats(value: Any) -> npt.NDArray[np.float64]:
    return np.array(value, np.float64)


def _texts(value: Any) -> dict[str, str]:
    if not isinstance(value, dict) or not all(isinstance(text, str) for text in value.values()):
        raise TypeError
    return value


def _check_channel(name: str, channel: Channel, tree: Octree) -> None:
    form, values, split_values = channel
    if not name or name != form.name:
        raise ArgumentError(f"channel {name!r} must have the name of its format, {form.name!r}")
    as_choice(form.space, COLOR_SPACES, f"colour space of channel {name!r}:")
    as_choice(form.dtype, ONE, f"dtype of channel {name!r}:")
    if not 1 <= form.components <= 4:
        raise ArgumentError(f"channel {name!r} must have 1 to 4 components, not {form.components}")
    for array, rows in ((values, tree.n_cells), (split_values, tree.split.areas.size)):
        expected = (rows, form.components)
        if array.shape != expected or array.dtype != form.dtype or not array.flags.c_contiguous:
            raise ArgumentError(
                f"channel {name!r} must be a C-ordered {form.dtype} array of shape {expected}, "
                f"not {array.dtype} {array.shape}"
            )


def _gather(values: Array, space: ColorSpace, cells: Array, result: npt.NDArray[np.float32]) -> None:
    """Write the decoded values of cells to ``result``."""
    if values.dtype == np.float32:
        result[:] = decode(values[cells], space)
    elif values.dtype == np.float16:
        _gather_codes(values.view(np.uint16), _half_table(space), cells, result)
    else:
        _gather_codes(values, decode_table(values.dtype.name, space), cells, result)


@cache
def _half_table(space: ColorSpace) -> npt.NDArray[np.float32]:
    """Decode all bit patterns of float16."""
    with np.errstate(invalid="ignore"):  # NaNs are among them
        return decode(np.arange(1 << 16, dtype=np.uint16).view(np.float16), space)


@kernel
def _gather_codes(
    values: npt.NDArray[np.uint8 | np.uint16],
    table: npt.NDArray[np.float32],
    cells: npt.NDArray[np.int64],
    result: npt.NDArray[np.float32],
) -> None:
    for n in range(cells.size):
        for component in range(values.shape[1]):
            result[n, component] = table[values[cells[n], component]]


@kernel
def _normalize(vectors: npt.NDArray[np.float32]) -> None:
    """Make vectors (n, components) of length 1, in place; zeros stay."""
    for n in range(vectors.shape[0]):
        square = 0.0
        for component in range(vectors.shape[1]):
            square += np.float64(vectors[n, component]) ** 2
        if square > 0.0:
            inverse = 1.0 / np.sqrt(square)
            for component in range(vectors.shape[1]):
                vectors[n, component] *= inverse
