"""Channels as lookups read them, and directions made unit vectors."""

from __future__ import annotations

from functools import cache

import numpy as np

from octex.arrays import Array, Float32s, Uint8s
from octex.channels import ColorSpace, decode, decode_table
from octex.field.lookups import ChannelRows
from octex.field.values import Codes
from octex.field.weights import mark_mixed
from octex.jit import kernel, unlocked
from octex.texture.channel import Channel
from octex.tree.octree import Octree

NO_GRADIENTS = np.empty((0, 4, 3), np.float32)
NO_TABLE = np.empty(0, np.float32)


def stored(channel: Channel) -> ChannelRows:
    """Return a channel as lookups read it."""
    dtype, space = channel.values.dtype, channel.format.space
    arrays: tuple[Array, Array, Array] = unlocked((channel.values, channel.kept_values, channel.split_values))
    is_alpha = channel.format.name == "alpha" and channel.format.components == 1
    if dtype == np.float32:
        return ChannelRows(Codes(*arrays, NO_TABLE), space if space == "srgb" else None, is_alpha)
    if dtype == np.float16:
        values, kept_values, split_values = (array.view(np.uint16) for array in arrays)
        return ChannelRows(Codes(values, kept_values, split_values, _half_table(space)), None, is_alpha)
    table = decode_table(dtype.name, space)
    return ChannelRows(
        Codes(*arrays, table.astype(np.float64) if table.size == 256 else table), None, is_alpha
    )


def mixed_cells(channel: Channel, tree: Octree, threshold: float) -> Uint8s:
    """Mark the cells (cells,) of a tree whose opposite facings differ by ``threshold`` or more.

    Of split cells above the deepest level, which are leaves, none differ.
    """
    mixed = np.zeros(tree.n_cells, np.uint8)
    cells, facings, _ = tree.split
    codes, space, _ = stored(channel.of(tree))
    values = np.asarray(codes.split_values) if space is None else decode(codes.split_values, space)
    first = int(tree.arrays.level_cells[tree.max_depth])
    mark_mixed(cells, facings, codes.table, values, first, float(threshold), mixed)
    return mixed


@cache
def _half_table(space: ColorSpace) -> Float32s:
    """Decode all bit patterns of float16."""
    with np.errstate(invalid="ignore"):  # NaNs are among them
        return decode(np.arange(1 << 16, dtype=np.uint16).view(np.float16), space)


@kernel
def make_unit(vectors: Float32s, gradients: Float32s) -> None:
    """Make vectors (n, components) of length 1, in place; zeros stay.

    ``gradients`` (n or 0, components, 3) become those of the unit vectors: what of them is across the vector,
    divided by its length; zeros where it has none.
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
