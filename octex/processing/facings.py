"""Rows of split nodes after an edit: means of what their children show the same way, and what is left."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import ALPHA, decode, encode
from octex.conversion.accumulate import LEAST_COVERAGE
from octex.painting.averages import AREAS
from octex.processing.averages import Change, limits, node_cells, within
from octex.texture import Channel, OctreeTexture
from octex.texture.split import bits_of, find_rows, rows_facing
from octex.tree.edit import children_of
from octex.tree.layout import FACING_FLAGS
from octex.tree.octree import Octree

Int64s = npt.NDArray[np.int64]
Float64s = npt.NDArray[np.float64]
Uint8s = npt.NDArray[np.uint8]


class Rows(NamedTuple):
    """Rows of the split table."""

    rows: Int64s  # (n,)
    cells: Int64s  # (n,)   whose rows they are
    bits: Uint8s  # (n,)   their facings, as flags


def rows_of(tree: Octree) -> Rows:
    """Return all rows of a tree."""
    cells = np.repeat(tree.split.cells.astype(np.int64), np.bitwise_count(tree.split.facings))
    return Rows(np.arange(cells.size), cells, bits_of(tree.split.facings))


def row_residuals(texture: OctreeTexture, channel: Channel, change: Change) -> Float64s:
    """Return the residuals of all rows (rows, components), changed; zeros for those of leaves."""
    form = channel.format
    found = np.zeros((texture.tree.split.areas.size, form.components))
    for rows in _by_level(texture.tree):
        means, has = _means(texture, channel, rows)
        stored = channel.split_values[rows.rows]
        apart = has & (encode(means, form.dtype, form.space) != stored).any(axis=1)
        if apart.any():
            values = decode(stored[apart], form.space).astype(np.float64)
            found[rows.rows[apart]] = change(rows.cells[apart], values, means[apart])
    return found


def average_rows(texture: OctreeTexture, channel: Channel, left: Float64s) -> None:
    """Make the rows of split nodes anew, in place: means of their children, and residuals ``left``.

    A row that no child shows the same way as stays.
    """
    form, bounds = channel.format, limits(channel)
    for rows in _by_level(texture.tree):
        means, has = _means(texture, channel, rows)
        made = within(means[has] + left[rows.rows[has]], form, *bounds)
        channel.split_values[rows.rows[has]] = encode(made, form.dtype, form.space)


def _by_level(tree: Octree) -> Iterator[Rows]:
    """Yield the rows of split nodes, from the deepest level up."""
    if not tree.split.cells.size:
        return
    rows, cells, bits = rows_of(tree)
    is_node = np.isin(cells, node_cells(tree))
    levels = np.searchsorted(tree.arrays.level_cells, cells, side="right") - 1
    for level in range(tree.max_depth - 1, -1, -1):
        chosen = is_node & (levels == level)
        if chosen.any():
            yield Rows(rows[chosen], cells[chosen], bits[chosen])


def _means(texture: OctreeTexture, channel: Channel, rows: Rows) -> tuple[Float64s, npt.NDArray[np.bool_]]:
    """Return the means (n, components) of what children show as rows do, and for which rows some do."""
    tree, form = texture.tree, channel.format
    firsts, counts = children_of(tree, np.searchsorted(node_cells(tree), rows.cells))
    starts = np.cumsum(counts) - counts
    children = np.repeat(firsts - starts, counts) + np.arange(counts.sum())
    bits = np.repeat(rows.bits, counts)
    flags = tree.arrays.flags[children]
    shares = AREAS[tree.arrays.areas[children]] / np.maximum(
        np.bitwise_count(flags & np.uint8(FACING_FLAGS)), 1
    )
    there, found = find_rows(tree.split, children, bits)
    shares[there] = AREAS[tree.split.areas[found]]
    shares[flags & bits == 0] = 0.0
    alpha = texture.channels.get(ALPHA.name)
    if alpha is not None and form.name != ALPHA.name:
        shares *= np.maximum(rows_facing(texture, alpha, children, bits)[:, 0], LEAST_COVERAGE)
    values = rows_facing(texture, channel, children, bits) * shares[:, None]
    totals = np.add.reduceat(shares, starts)
    sums = np.add.reduceat(values, starts, axis=0)
    return sums / np.where(totals > 0, totals, 1.0)[:, None], totals > 0
