"""Copies the values of a texture into an edited tree."""

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

    Stored ``values`` (cells, components) are those of the new cells; default: ``edited.carried``, with zeros
    in cells that the texture lacked. Newly kept nodes keep their values as coefficients.
    """
    kept = edited.tree.kept.cells
    was_kept = among(edited.old[kept], texture.tree.kept.cells.astype(np.int64))
    channels = {}
    for name, channel in texture.channels.items():
        stored = edited.carried(channel.values) if values is None else values[name]
        kept_values = np.ascontiguousarray(stored[kept])
        kept_values[was_kept] = channel.kept_values[edited.kept_rows]
        channels[name] = Channel(channel.format, stored, channel.split_values[edited.split_rows], kept_values)
    return channels
