"""What a texture has in cells below its leaves: what its field refines to (paper 4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import decode
from octex.editing.averages import limits_of, with_residuals
from octex.painting.cells import refined_values
from octex.parallel import ordered_map
from octex.texture import Channel, OctreeTexture
from octex.texture.split import rows_facing
from octex.tree.edit import locate
from octex.tree.octree import Octree

Int64s = npt.NDArray[np.int64]
Float32s = npt.NDArray[np.float32]

#: Cells that a thread refines at once.
_BLOCK = 1 << 14


class Refined(NamedTuple):
    """Cells of a level below leaves."""

    values: dict[str, Float32s]  # (n, components) by channel, decoded
    leaves: Int64s  # (n,)   the leaves that they are in
    levels: Int64s  # (n,)   the levels of these


def refined(texture: OctreeTexture, codes: Int64s, level: int, executor: Executor) -> Refined:
    """Refine a texture to cells (n,) of a level below its leaves, given by ascending Morton codes."""
    blocks = [codes[begin : begin + _BLOCK] for begin in range(0, codes.size, _BLOCK)] or [codes]
    found = list(
        ordered_map(executor, partial(_refined, texture.tree, dict(texture.channels), level), blocks)
    )
    where = locate(texture.tree, codes, level)
    values = {name: np.concatenate([each[name] for each in found]) for name in texture.channels}
    return Refined(values, where.cells, where.levels)


def _refined(tree: Octree, channels: Mapping[str, Channel], level: int, codes: Int64s) -> dict[str, Float32s]:
    return refined_values(tree, channels, codes, level)


def rows_below(
    texture: OctreeTexture,
    channel: Channel,
    own: Float32s,
    leaves: Int64s,
    bits: npt.NDArray[np.uint8],
) -> Float32s:
    """Return what cells (n,) below leaves show facings: what differs from their ``own`` as in the leaves."""
    whole = decode(channel.values[leaves], channel.format.space)
    rows = rows_facing(texture, channel, leaves, bits)
    return np.asarray(with_residuals(limits_of(channel), rows.astype(np.float64), own - whole), np.float32)
