"""What is stored per facing: which cells are split, and leaves that must not share what they were fitted to.

A cell in which the surface shows both ways along an axis is *split* if its facings show something else than
the whole. A leaf is fitted together with all leaves around it; where some of them face the other way, as in a
wall that is thinner than a few cells, its value suits lookups that see both sides, but not those that know
their normal. It is then split too, and keeps the mean of what faces each way.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from octex.channels import ONE, ChannelFormat, linear_to_srgb
from octex.field.field import Field, Taps
from octex.texture.channel import Channel
from octex.tree.layout import AREA_STEPS, FACING_FLAGS, POSITIVE_FACINGS, SPLIT, SplitTable
from octex.tree.morton import decode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement

#: Of cells: a bit for each of the 2⁶ sets of facings that a cell can have; the empty set's for split cells.
Kinds: TypeAlias = npt.NDArray[np.uint64]
_SPLIT_KIND = np.uint64(1)

#: Difference, in 8-bit codes, from which on a facing's value is stored for itself.
MOST = 1.0
#: Cosine from which on lookups take what faces so in full: see `field.facings`; and what it is rounded by.
_FULL = 0.52
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


def kinds_around(tree: Octree) -> Kinds:
    """Return the kinds of all leaves that lookups in each leaf may read, 0 where they are of one (cells,).

    Found from the root down: what is around a cell is around what lies in it.
    """
    kinds = _kinds_below(tree)
    field = Field(tree)
    found = np.zeros(tree.n_cells, np.uint64)
    meets, codes_above = np.ones(1, np.bool_), np.zeros(1, np.int64)
    for level, (codes, is_node) in enumerate(tree.walk()):
        chosen = np.flatnonzero(meets[np.searchsorted(codes_above, codes >> 3)]) if level else np.arange(1)
        meets, codes_above = np.zeros(len(codes), np.bool_), codes
        first = int(tree.arrays.level_cells[level])
        for begin in range(0, len(chosen), _BLOCK):
            some = chosen[begin : begin + _BLOCK]
            taps = _around(field, level, codes[some])
            around = np.bitwise_or.reduceat(kinds[taps.rows], taps.starts[:-1])
            meets[some] = (np.bitwise_count(around) > 1) | (around == _SPLIT_KIND)
            found[first + some] = np.where(meets[some] & ~is_node[some], around, 0)
    return found


def _kinds_below(tree: Octree) -> Kinds:
    """Return the kind of each leaf, and the kinds of all leaves below each node (cells,)."""
    flags, firsts = tree.arrays.flags, tree.arrays.level_cells
    facings = flags & np.uint8(FACING_FLAGS)
    kinds = np.where(facings > 0, np.uint64(1) << facings.astype(np.uint64), np.uint64(0))
    kinds[flags & SPLIT > 0] = _SPLIT_KIND
    levels = list(tree.walk())
    for level in range(len(levels) - 1, 0, -1):
        starts = np.flatnonzero(np.diff(levels[level][0] >> 3, prepend=-1))
        nodes = np.flatnonzero(levels[level - 1][1]) + int(firsts[level - 1])
        kinds[nodes] = np.bitwise_or.reduceat(kinds[firsts[level] : firsts[level + 1]], starts)
    return kinds


def sees_all(normals: npt.NDArray[np.int8], kinds: Kinds) -> npt.NDArray[np.bool_]:
    """Say whether lookups with normals (n, 3) take in full what is of some kinds (n,), and nothing is split.

    Lookups without normals then find the same.
    """
    lengths = np.maximum(np.linalg.norm(normals.astype(np.float32), axis=1), 1)
    least = (_FULL * lengths)[:, None]
    full = np.stack([normals >= least, -normals.astype(np.float32) >= least], axis=2).reshape(-1, 6)
    hidden = _HIDDEN[np.packbits(full, axis=1, bitorder="little")[:, 0]]
    seen: npt.NDArray[np.bool_] = (kinds & hidden) == 0
    return seen


#: By the facings that are taken in full: the kinds of cells that have none of them, and of split ones.
_HIDDEN = np.array(
    [sum(1 << kind for kind in range(64) if kind & facings == 0) for facings in range(64)], np.uint64
)


def _around(field: Field, level: int, codes: npt.NDArray[np.int64]) -> Taps:
    """Return the taps in the middles of a level's cells, where all 3×3×3 cells around weigh."""
    centres = (decode_cells(codes) + np.float64(0.5)) / 2**level
    return field.level(level).taps(centres, Placement((0.0, 0.0, 0.0), 1.0))


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
            taps = _around(field, level, codes[some])
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
