"""A channel's values: packed arrays with rows numbered by the tree; and their form for lookups."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import NamedTuple, TypeAlias

import numpy as np

from octex.arrays import Array, Float32s, Floats, Integers, Uint8s
from octex.channels import COLOR_SPACES, ONE, ChannelFormat, ColorSpace, decode, decode_table
from octex.checks import as_choice, as_entries, locked
from octex.errors import ArgumentError
from octex.field.lookups import ChannelRows
from octex.field.taps import Codes
from octex.field.weights import mark_mixed
from octex.jit import kernel, unlocked
from octex.tree.octree import Octree

NO_GRADIENTS = np.empty((0, 4, 3), np.float32)
NO_TABLE = np.empty(0, np.float32)

#: A stored type for all channels, or by name; None for their present types.
Dtypes: TypeAlias = str | Mapping[str, str] | None

#: Rows that are looked at together.
_PIECE = 1 << 18


class Channel(NamedTuple):
    """A named array of values, one a cell: a leaf's value, or a node's average."""

    format: ChannelFormat
    values: Array  # (cells, components)   as stored
    split_values: Array  # (split rows, components)
    kept_values: Array  # (kept nodes, components)   the coefficients of the leaves that they were

    @classmethod
    def full(cls, form: ChannelFormat, tree: Octree, value: float = 0) -> Channel:
        """Return a channel of a tree with one stored number everywhere."""
        arrays = [np.zeros((rows, form.components), form.dtype) for rows in row_counts(tree)]
        for array in arrays if value else ():
            array.fill(value)
        return cls(form, *arrays)

    def copied(self) -> Channel:
        """Copy the arrays."""
        return Channel(self.format, *(array.copy() for array in self[1:]))

    def named(self, name: str) -> Channel:
        """Return the same values under another name."""
        return self._replace(format=self.format._replace(name=name))

    @property
    def nbytes(self) -> int:
        """Bytes of all values."""
        return self.values.nbytes + self.split_values.nbytes + self.kept_values.nbytes

    def of(self, tree: Octree) -> Channel:
        """Return views of the values of a truncated tree."""
        parts = zip(self[1:], row_counts(tree), strict=True)
        return Channel(self.format, *(array[:count] for array, count in parts))

    def rows(self, numbers: Integers) -> Array:
        """Return the stored values of rows (n,): cells, then kept nodes, then split facings."""
        values = self.values.take(numbers, axis=0, mode="clip")
        begin = len(self.values)
        for part in (self.kept_values, self.split_values):
            beyond = np.flatnonzero(numbers >= begin)
            if beyond.size and len(part):
                values[beyond] = part.take(numbers[beyond] - begin, axis=0, mode="clip")
            begin += len(part)
        return values

    def locked(self) -> Channel:
        """Return the same values as read-only views; itself, if they are."""
        if not any(array.flags.writeable for array in self[1:]):
            return self
        return Channel(self.format, *map(locked, self[1:]))

    def is_finite(self) -> bool:
        """Return whether all values are finite."""
        return all(
            np.isfinite(array[begin : begin + _PIECE]).all()
            for array in self[1:]
            if array.dtype.kind == "f"
            for begin in range(0, len(array), _PIECE)
        )


def row_counts(tree: Octree) -> tuple[int, int, int]:
    """Return the numbers of rows of a tree's channels: cells, facings of split cells, kept nodes."""
    return tree.n_cells, tree.split.areas.size, tree.kept.cells.size


def as_channels(channels: Mapping[str, Channel], tree: Octree) -> dict[str, Channel]:
    """Return channels, read-only, or raise ArgumentError for those that do not fit the tree, or no tree."""
    if not isinstance(tree, Octree):
        raise ArgumentError(f"tree must be an Octree, not {tree!r}")
    entries = as_entries(channels, "channels")
    for name, channel in entries.items():
        if not isinstance(channel, Channel):
            raise ArgumentError(f"channel {name!r} must be a Channel, not {channel!r}")
        form = channel.format
        if not isinstance(form, ChannelFormat):
            raise ArgumentError(f"channel {name!r} must have a ChannelFormat, not {form!r}")
        if not name or name != form.name:
            raise ArgumentError(f"channel {name!r} must have the name of its format, {form.name!r}")
        as_choice(form.space, COLOR_SPACES, f"colour space of channel {name!r}:")
        as_choice(form.dtype, ONE, f"dtype of channel {name!r}:")
        if form.components not in range(1, 5):
            raise ArgumentError(f"channel {name!r} must have 1 to 4 components, not {form.components}")
        for array, rows in zip(channel[1:], row_counts(tree), strict=True):
            expected = (rows, form.components)
            if not isinstance(array, np.ndarray):
                raise ArgumentError(f"channel {name!r} must have arrays, not {array!r}")
            if array.shape != expected or array.dtype != form.dtype or not array.flags.c_contiguous:
                raise ArgumentError(
                    f"channel {name!r} must be a C-ordered {form.dtype} array of shape {expected}, "
                    f"not {array.dtype} {array.shape}"
                )
    return {name: channel.locked() for name, channel in entries.items()}


def formats_as(forms: Sequence[ChannelFormat], dtype: Dtypes) -> tuple[ChannelFormat, ...]:
    """Return channels' formats with other stored types: floats store linear light, integers sRGB.

    A format stays where ``dtype`` has none, or the same one. Raises ArgumentError for unknown names and
    types. Whether an integer type can hold the values is checked when they are read.
    """
    names = [form.name for form in forms]
    dtypes = as_entries(dtype, "dtype") if isinstance(dtype, Mapping) else dict.fromkeys(names, dtype)
    for name, wanted in dtypes.items():
        as_choice(name, names, "channel of dtype")
        if wanted is not None:
            as_choice(wanted, ONE, "dtype")
    return tuple(_format_as(form, dtypes.get(form.name)) for form in forms)


def _format_as(form: ChannelFormat, dtype: str | None) -> ChannelFormat:
    if dtype is None or dtype == form.dtype:
        return form
    space = form.space
    if dtype.startswith("float"):
        space = "linear" if space == "srgb" else space
    elif space == "linear" and form.dtype.startswith("float"):
        space = "srgb"
    return form._replace(space=space, dtype=dtype)


def stored(channel: Channel) -> ChannelRows:
    """Return a channel as lookups read it: float32 numbers on sRGB's curve are copied as linear light."""
    dtype, space = channel.values.dtype, channel.format.space
    arrays = [unlocked(array) for array in (channel.values, channel.kept_values, channel.split_values)]
    table: Floats = NO_TABLE
    if dtype == np.float32 and space == "srgb":
        arrays = [decode(array, space) for array in arrays]
    elif dtype == np.float16:
        arrays, table = [array.view(np.uint16) for array in arrays], _half_table(space)
    elif dtype != np.float32:
        table = decode_table(dtype.name, space)
        table = table.astype(np.float64) if table.size == 256 else table
    codes = Codes(arrays[0], arrays[1], arrays[2], table)
    return ChannelRows(codes, channel.format.name == "alpha" and channel.format.components == 1)


def mixed_cells(channel: Channel, tree: Octree, threshold: float) -> Uint8s:
    """Mark the cells (cells,) of a tree whose opposite facings differ by ``threshold`` or more.

    Split cells above the deepest level, which are leaves, do not count.
    """
    mixed = np.zeros(tree.n_cells, np.uint8)
    cells, facings, _ = tree.split
    codes, first = stored(channel.of(tree)).codes, int(tree.arrays.level_cells[tree.max_depth])
    mark_mixed(cells, facings, codes.table, codes.split_values, first, float(threshold), mixed)
    return mixed


@cache
def _half_table(space: ColorSpace) -> Float32s:
    """Decode all bit patterns of float16."""
    with np.errstate(invalid="ignore"):  # NaNs are among them
        return decode(np.arange(1 << 16, dtype=np.uint16).view(np.float16), space)


@kernel
def make_unit(vectors: Float32s, gradients: Float32s) -> None:
    """Normalize vectors (n, components) in place; zeros stay.

    ``gradients`` (n or 0, components, 3) become those of the unit vectors: their part across the vector,
    divided by its length; zeros for zero vectors.
    """
    components = vectors.shape[1]
    for n in range(vectors.shape[0]):
        square = 0.0
        for component in range(components):
            square += np.float64(vectors[n, component]) ** 2
        inverse = 1.0 / np.sqrt(square) if square > 0.0 else 0.0
        if square > 0.0:
            for component in range(components):
                vectors[n, component] *= inverse
        for axis in range(3 if gradients.shape[0] > 0 else 0):
            along = 0.0
            for component in range(components):
                along += np.float64(vectors[n, component]) * np.float64(gradients[n, component, axis])
            for component in range(components):
                across = np.float64(gradients[n, component, axis]) - along * np.float64(vectors[n, component])
                gradients[n, component, axis] = across * inverse
