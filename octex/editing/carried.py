"""The values of a texture in a tree that was made from its own."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from octex.arrays import Array
from octex.texture import Channel, OctreeTexture
from octex.tree.edit import Edited, among


def carried(
    texture: OctreeTexture, edited: Edited, values: Mapping[str, Array] | None = None
) -> dict[str, Channel]:
    """Return the channels of a texture for the cells, rows and kept nodes of an edited tree.

    ``values`` (cells, components), as stored, are those of its cells; by default ``edited.carried``, where
    new cells have zeros. Nodes that did not keep a coefficient before keep their values.
    """
    kept = edited.tree.kept.cells
    was_kept = among(edited.old[kept], texture.tree.kept.cells.astype(np.int64))
    found = {}
    for name, channel in texture.channels.items():
        own = edited.carried(channel.values) if values is None else values[name]
        kept_values = np.ascontiguousarray(own[kept])
        kept_values[was_kept] = channel.kept_values[edited.kept_rows]
        found[name] = Channel(channel.format, own, channel.split_values[edited.split_rows], kept_values)
    return found
