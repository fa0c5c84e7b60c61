"""What cells show each way: the rows of split cells, read and changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.channels import decode, encode
from octex.texture.channel import Channel
from octex.texture.texture import OctreeTexture
from octex.tree.edit import facings_of_nodes
from octex.tree.layout import AREA_STEPS, FACING_FLAGS, SPLIT, SplitTable

Array = npt.NDArray[Any]
Int64s = npt.NDArray[np.int64]
Uint8s = npt.NDArray[np.uint8]


def bits_of(facings: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return the facings of cells one by one, as flags, in the order of their bits."""
    bits = np.uint8(1) << np.arange(6, dtype=np.uint8)
    chosen = facings[:, None] & bits
    found: Uint8s = chosen[chosen != 0]
    return found


def rows_facing(
    texture: OctreeTexture, channel: Channel, cells: Int64s, bits: Uint8s
) -> npt.NDArray[np.float32]:
    """Decode what cells (n,) show facings (n,): a split cell's row, or the cell's value."""
    found = decode(channel.values[cells], channel.format.space)
    there, rows = find_rows(texture.tree.split, cells, bits)
    found[there] = decode(channel.split_values[rows], channel.format.space)
    return found


def find_rows(split: SplitTable, cells: Int64s, bits: Uint8s) -> tuple[npt.NDArray[np.bool_], Int64s]:
    """Say which cells (n,) have a row for a facing, and which rows these are."""
    if not split.cells.size:
        return np.zeros(cells.size, np.bool_), np.empty(0, np.int64)
    at = np.minimum(np.searchsorted(split.cells, cells.astype(np.uint32)), split.cells.size - 1)
    there = (split.cells[at] == cells) & (split.facings[at] & bits != 0)
    counts = np.bitwise_count(split.facings).astype(np.int64)
    starts = np.cumsum(counts) - counts
    rows = starts[at] + np.bitwise_count(split.facings[at] & (bits - np.uint8(1)))
    return there, rows[there]


def with_split(
    texture: OctreeTexture,
    cells: Int64s,
    facings: Uint8s,
    rows: Mapping[str, Array],
) -> OctreeTexture:
    """Return a texture whose ``cells``, ascending, are split, with given rows for some of its channels.

    Other channels keep the rows that they have, or take the cells' values.
    """
    tree = texture.tree
    old = tree.split
    stays = ~np.isin(old.cells, cells)
    old_rows = np.repeat(stays, np.bitwise_count(old.facings))
    counts = np.bitwise_count(facings).astype(np.int64)
    owners = np.repeat(cells, counts)
    bits = bits_of(facings)
    shared = tree.arrays.areas[cells].astype(np.float64) - AREA_STEPS * np.log2(np.maximum(counts, 1))
    shares = np.where(tree.arrays.areas[cells] > 0, np.clip(np.rint(shared), 1, 255), 0).astype(np.uint8)
    areas = np.repeat(shares, counts)
    there, known = find_rows(old, owners, bits)
    areas[there] = old.areas[known]
    order = np.argsort(np.concatenate([old.cells[stays], cells]), kind="stable")
    kept_owners = np.repeat(old.cells[stays], np.bitwise_count(old.facings[stays]))
    row_order = np.argsort(np.concatenate([kept_owners, owners]), kind="stable")
    table = SplitTable(
        np.concatenate([old.cells[stays], cells]).astype(np.uint32)[order],
        np.concatenate([old.facings[stays], facings])[order],
        np.concatenate([old.areas[old_rows], areas])[row_order],
    )
    flags = tree.arrays.flags.copy()
    flags[cells] |= np.uint8(SPLIT)
    channels = {}
    for name, channel in texture.channels.items():
        if name in rows:
            own = rows[name]
        else:
            form = channel.format
            own = encode(rows_facing(texture, channel, owners, bits), form.dtype, form.space)
        values = np.concatenate([channel.split_values[old_rows], own])[row_order]
        channels[name] = channel._replace(split_values=np.ascontiguousarray(values))
    tree = tree.with_cell_data(flags, tree.arrays.areas, table, tree.kept)
    return OctreeTexture(tree, channels, texture.placement, texture.bounds, texture.metadata)


def without_split(texture: OctreeTexture, cells: Int64s) -> OctreeTexture:
    """Return a texture in which ``cells``, that are split, are not."""
    if not cells.size:
        return texture
    tree = texture.tree
    stays = ~np.isin(tree.split.cells, cells)
    rows = np.repeat(stays, np.bitwise_count(tree.split.facings))
    table = SplitTable(tree.split.cells[stays], tree.split.facings[stays], tree.split.areas[rows])
    flags = tree.arrays.flags.copy()
    flags[cells] &= np.uint8(0xFF ^ SPLIT)
    channels = {
        name: channel._replace(split_values=channel.split_values[rows])
        for name, channel in texture.channels.items()
    }
    tree = tree.with_cell_data(flags, tree.arrays.areas, table, tree.kept)
    return OctreeTexture(tree, channels, texture.placement, texture.bounds, texture.metadata)


def refaced(texture: OctreeTexture) -> OctreeTexture:
    """Return a texture whose nodes face all ways that their children do, and no other.

    Split nodes lose and gain rows with that; new ones have the cell's value.
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
    texture = OctreeTexture(tree, texture.channels, texture.placement, texture.bounds, texture.metadata)
    return with_split(texture, cells, facings[changed], {}) if cells.size else texture
