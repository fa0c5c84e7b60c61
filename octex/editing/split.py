"""Values of cells by facing: reads and changes the rows of split cells."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from octex.arrays import Array, Bools, Float32s, Floats, Int64s, Uint8s
from octex.channels import ONE, ChannelFormat, decode, linear_to_srgb
from octex.texture import Channel, OctreeTexture
from octex.tree.areas import SKIRT
from octex.tree.edit import among, facings_of_nodes, facings_of_skirts
from octex.tree.layout import FACING_FLAGS, SPLIT
from octex.tree.split import find_rows, inserted, rows_of, taken

#: Least difference, in 8-bit codes, at which a facing gets a row.
MOST = 1.0
#: Slope of the sRGB curve at 1, in codes: above it light is compared by ratio.
SLOPE = 255.0 * 1.055 / 2.4


def in_codes(stored: Array, form: ChannelFormat) -> Floats:
    """Return stored values on the scale of 8-bit codes: light on sRGB's curve, a logarithm from 1 on."""
    if form.space == "linear" and form.dtype.startswith("float"):
        light = stored.astype(np.float64)
        return 255.0 * linear_to_srgb(np.minimum(light, 1.0)) + SLOPE * np.log(np.maximum(light, 1.0))
    scale = 255.0 / ONE[form.dtype]
    if form.space == "direction" and form.dtype.startswith("float"):
        scale /= 2  # −1 … 1
    return stored.astype(np.float32) * np.float32(scale)


def differ(form: ChannelFormat, rows: Array, cells: Array) -> Bools:
    """Return which stored facing values (n, components) differ enough from those of their cells (n,)."""
    differences = np.abs(in_codes(rows, form) - in_codes(cells, form)) > MOST
    return np.asarray(differences.any(axis=1))


def rows_facing(texture: OctreeTexture, channel: Channel, cells: Int64s, bits: Uint8s) -> Float32s:
    """Return the decoded value of each cell (n,) for its facing (n,): the row, or the cell's value."""
    has_row, rows = find_rows(texture.tree.split, cells, bits)
    return decode(_stored_facing(channel, cells, has_row, rows), channel.format.space)


def _stored_facing(channel: Channel, cells: Int64s, has_row: Bools, rows: Int64s) -> Array:
    """Return the stored values of cells (n,), and those of ``rows`` for the cells in ``has_row`` (n,)."""
    values = channel.values[cells]
    values[has_row] = channel.split_values[rows]
    return values


def with_split(
    texture: OctreeTexture, cells: Int64s, facings: Uint8s, rows: Mapping[str, Array]
) -> OctreeTexture:
    """Return a texture whose ascending ``cells`` are split, with these rows for some of its channels.

    Other channels keep existing rows, or take the cells' values. A new row that only skirts face is skirt.
    """
    tree = texture.tree
    table, order, cell_rows = inserted(tree.split, cells, facings, tree.arrays.areas[cells])
    is_old = cell_rows.rows >= 0
    is_other = ~among(rows_of(tree.split).cells, cells)
    channels = {}
    for name, channel in texture.channels.items():
        if name in rows:
            values = rows[name]
        else:
            values = _stored_facing(channel, cell_rows.cells, is_old, cell_rows.rows[is_old])
        values = np.concatenate([channel.split_values[is_other], values])[order]
        channels[name] = channel._replace(split_values=np.ascontiguousarray(values))
    if not is_old.all() and (tree.arrays.areas == SKIRT).any():
        is_skirt = ~is_old & (facings_of_skirts(tree)[cell_rows.cells] & cell_rows.bits != 0)
        table.areas[np.flatnonzero(among(rows_of(table).cells, cells))[is_skirt]] = SKIRT
    flags = tree.arrays.flags.copy()
    flags[cells] |= np.uint8(SPLIT)
    tree = tree.with_cell_data(flags, tree.arrays.areas, table, tree.kept)
    return texture.with_cells(tree, channels)


def without_split(texture: OctreeTexture, cells: Int64s) -> OctreeTexture:
    """Return a texture without the splits of ``cells``, which are split."""
    if not cells.size:
        return texture
    tree = texture.tree
    split_cells = tree.split.cells.astype(np.int64)
    split, rows = taken(tree.split, np.where(among(split_cells, cells), -1, split_cells))
    flags = tree.arrays.flags.copy()
    flags[cells] &= np.uint8(0xFF ^ SPLIT)
    channels = {
        name: channel._replace(split_values=channel.split_values[rows])
        for name, channel in texture.channels.items()
    }
    tree = tree.with_cell_data(flags, tree.arrays.areas, split, tree.kept)
    return texture.with_cells(tree, channels)


def split_in_vain(texture: OctreeTexture, cells: Int64s) -> Int64s:
    """Return the split cells, ascending, whose facings all equal the cell's value."""
    rows = rows_of(texture.tree.split, cells)
    differs = np.zeros(rows.rows.size, np.bool_)
    for channel in texture.channels.values():
        differs |= differ(channel.format, channel.split_values[rows.rows], channel.values[rows.cells])
    return cells[~among(cells, rows.cells[differs])]


def refaced(texture: OctreeTexture) -> OctreeTexture:
    """Return a texture whose nodes have exactly the facings of their children.

    Split nodes lose and gain rows accordingly; new rows get the cell's value.
    """
    tree = texture.tree
    flags = facings_of_nodes(tree)
    if (flags == tree.arrays.flags).all():
        return texture
    split = tree.split
    facings = flags[split.cells] & np.uint8(FACING_FLAGS)
    changed = facings != split.facings
    cells = split.cells[changed].astype(np.int64)
    tree = tree.with_cell_data(flags, tree.arrays.areas, split, tree.kept)
    texture = texture.with_cells(tree, texture.channels)
    return with_split(texture, cells, facings[changed], {}) if cells.size else texture
