"""Prepares a texture's channel for lookups in kernels."""

from __future__ import annotations

import numpy as np

from octex.arrays import Array, Int32s, Int64s, Uint32s, Uint64s
from octex.channels import decode
from octex.checks import as_choice, as_number, locked
from octex.field.tiles import Tiles
from octex.kernels.lookups import LookupArrays
from octex.texture.channel import NO_TABLE, Channel, mixed_cells, stored
from octex.texture.lookup import BLEED_THRESHOLD
from octex.texture.texture import OctreeTexture, as_texture
from octex.tree.layout import MAX_DEPTH


def arrays_of(
    texture: OctreeTexture, channel: str = "base_color", *, bleed_threshold: float = BLEED_THRESHOLD
) -> LookupArrays:
    """Prepare a channel for lookups in kernels.

    It shares the texture's arrays. It adds 3 bytes a cell to find cells, 5 more where cells are split, and
    decoded values for float32 channels that are not linear light. ``bleed_threshold`` is as for
    `OctreeTexture.sample`. Raises ArgumentError for an unknown channel.
    """
    texture = as_texture(texture)
    known = texture.channels[as_choice(channel, texture.channels, "channel")]
    threshold = as_number(bleed_threshold, "bleed_threshold", 0.0, np.inf)
    tree, field = texture.tree, texture._field
    areas = tree.arrays.areas.copy()
    areas[tree.leaf_cells()] = 0
    mixed = np.zeros(tree.n_cells if tree.split.cells.size else 0, np.uint8)
    for level in range(tree.max_depth):
        above = field.level(level).tree
        if above.split.cells.size:
            first = int(tree.arrays.level_cells[level])
            mixed[first : above.n_cells] = mixed_cells(known, above, threshold)[first:]
    alpha = texture.channels.get("alpha")
    if alpha is known or (alpha is not None and alpha.format.components != 1):
        alpha = None
    tiles = _joined_tiles([field.level(level).tiles for level in range(tree.max_depth + 1)])
    return LookupArrays(
        np.array([*texture.placement.origin, texture.placement.size]),
        *tree.arrays._replace(areas=areas),
        tree.kept.cells,
        field.facings.rows,
        *tiles,
        *_values(known),
        *(_NO_VALUES if alpha is None else _values(alpha)),
        known.format.components,
        mixed,
    )


_NONE = locked(np.empty(0, np.uint8))
_NO_VALUES: tuple[Array, Array, Array, Array] = _NONE, _NONE, _NONE, locked(np.empty(0, np.float64))


def _values(channel: Channel) -> tuple[Array, Array, Array, Array]:
    """Return a channel's flattened values of cells, kept nodes and facings, and its decoding table."""
    (*arrays, table), space, _ = stored(channel)
    if space is not None:
        arrays, table = [decode(array, space) for array in arrays], NO_TABLE
    cells, kept, split = (locked(array.reshape(-1)) for array in arrays)
    return cells, kept, split, locked(table)


def _joined_tiles(levels: list[Tiles | None]) -> tuple[Int64s, Int32s, Uint64s, Uint32s]:
    """Join the tiles of all levels; levels without tiles get a top level of −1."""
    table = np.full((MAX_DEPTH + 1, 5), -1, np.int64)
    tops, masks, firsts = [np.empty(0, np.int32)], [np.empty(0, np.uint64)], [np.empty(0, np.uint32)]
    top = row = 0
    for level, tiles in enumerate(levels):
        if tiles is not None:
            tops, masks, firsts = [*tops, tiles.top], [*masks, tiles.masks], [*firsts, tiles.firsts]
            table[level] = tiles.top_level, top, top + tiles.top.size, row, row + tiles.masks.size
            top, row = top + tiles.top.size, row + tiles.masks.size
    return table, np.concatenate(tops), np.concatenate(masks), np.concatenate(firsts)
