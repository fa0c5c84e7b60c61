"""What is stored per facing: which cells are split, and leaves that must not share what they were fitted to.

A cell in which the surface shows both ways along an axis is *split* if its facings show something else than
the whole. A leaf is fitted together with all leaves around it; where some of them face the other way, as in a
wall that is thinner than a few cells, its value suits lookups that see both sides, but not those that know
their normal. It is then split too, and keeps the mean of what faces each way.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from octex.channels import ONE, ChannelFormat, linear_to_srgb
from octex.field.field import Field
from octex.texture.channel import Channel
from octex.tree.layout import AREA_STEPS, FACING_FLAGS, POSITIVE_FACINGS, SPLIT, SplitTable
from octex.tree.morton import decode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement

#: Difference, in 8-bit codes, from which on a facing's value is stored for itself.
MOST = 1.0
#: Cells whose surroundings are looked at at once.
_BLOCK = 1 << 16


def in_codes(stored: npt.NDArray[np.generic], channel: ChannelFormat) -> npt.NDArray[np.floating]:
    """Return stored values on the scale of 8-bit codes: light on sRGB's curve, a logarithm from 1 on."""
    if channel.space == "linear" and channel.dtype.startswith("float"):
        light = stored.astype(np.float64)
        slope = 1.055 / 2.4  # of the curve at 1
        return 255.0 * (linear_to_srgb(np.minimum(light, 1.0)) + slope * np.log(np.maximum(light, 1.0)))
    scale = 255.0 / ONE[channel.dtype]
    if channel.space == "direction" and channel.dtype.startswith("float"):
        scale /= 2  # −1 … 1
    return stored.astype(np.float32) * np.float32(scale)


def separated(
    tree: Octree, means: Mapping[str, Channel], fitted: Mapping[str, Channel]
) -> tuple[Octree, dict[str, Channel]]:
    """Split leaves beside others that face the other way, if fitting has moved them from their means.

    Channels have the tree's cells; those of ``means`` and ``fitted`` differ in leaves alone.
    """
    flags = tree.arrays.flags
    cells = _beside_opposite(tree)
    cells = cells[flags[cells] & SPLIT == 0]
    moved = np.zeros(len(cells), np.bool_)
    for name, channel in fitted.items():
        apart = in_codes(channel.values[cells], channel.format)
        apart = apart - in_codes(means[name].values[cells], channel.format)
        moved |= (np.abs(apart) > MOST).any(axis=1)
    cells = cells[moved]
    if not len(cells):
        return tree, dict(fitted)
    facings = flags[cells] & np.uint8(FACING_FLAGS)
    counts = np.bitwise_count(facings).astype(np.int64)
    rows = np.repeat(cells, counts)
    areas = tree.arrays.areas[cells].astype(np.float64) - AREA_STEPS * np.log2(counts)
    areas = np.where(tree.arrays.areas[cells] > 0, np.clip(np.rint(areas), 1, 255), 0).astype(np.uint8)

    split = tree.split
    order = np.argsort(np.concatenate([split.cells, cells]), kind="stable")
    old_rows = np.repeat(split.cells, np.bitwise_count(split.facings))
    row_order = np.argsort(np.concatenate([old_rows, rows]), kind="stable")
    table = SplitTable(
        np.concatenate([split.cells, cells]).astype(np.uint32)[order],
        np.concatenate([split.facings, facings])[order],
        np.concatenate([split.areas, np.repeat(areas, counts)])[row_order],
    )
    flags = flags.copy()
    flags[cells] |= SPLIT
    channels = {
        name: channel._replace(
            split_values=np.concatenate([channel.split_values, means[name].values[rows]])[row_order]
        )
        for name, channel in fitted.items()
    }
    return tree.with_cell_data(flags, tree.arrays.areas, table, tree.kept), channels


def _beside_opposite(tree: Octree) -> npt.NDArray[np.int64]:
    """Numbers of the leaves that have cells around them, 3×3×3, which do not show what the leaf itself faces.

    Found from the root down: where the cells around a node have no opposite facings, those around its
    children have none.
    """
    field, flags = Field(tree), tree.arrays.flags
    found = [np.empty(0, np.int64)]
    meets, codes_above = np.ones(1, np.bool_), np.zeros(1, np.int64)
    for level, (codes, is_node) in enumerate(tree.walk()):
        chosen = np.flatnonzero(meets[np.searchsorted(codes_above, codes >> 3)]) if level else np.arange(1)
        meets, codes_above = np.zeros(len(codes), np.bool_), codes
        first = int(tree.arrays.level_cells[level])
        for begin in range(0, len(chosen), _BLOCK):
            some = chosen[begin : begin + _BLOCK]
            centres = (decode_cells(codes[some]) + np.float64(0.5)) / 2**level
            # The spline's weight in the middle of a cell falls on all 3×3×3 cells.
            taps = field.level(level).taps(centres, Placement((0.0, 0.0, 0.0), 1.0))
            around, own = flags[taps.rows], np.repeat(flags[first + some], np.diff(taps.starts))
            opposite = _opposite(own) & around
            is_beside = (opposite != 0) & ((_opposite(opposite) & ~around | around & SPLIT) != 0)
            starts = taps.starts[:-1]
            meets[some] = np.logical_or.reduceat(opposite != 0, starts)
            leaves = some[np.logical_or.reduceat(is_beside, starts) & ~is_node[some]]
            found.append(first + leaves)
    return np.concatenate(found)


def _opposite(flags: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return the flags of the opposite facings."""
    positive = np.uint8(POSITIVE_FACINGS)
    return (flags & positive) << np.uint8(1) | flags >> np.uint8(1) & positive
