"""Rows of split nodes after an edit: means of what their children show the same way, and what is left."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import ALPHA, LEAST_COVERAGE, decode, encode
from octex.editing.averages import (
    AREAS,
    Change,
    Nodes,
    all_nodes,
    difference,
    levels_of,
    limits_of,
    with_residuals,
)
from octex.texture import Channel, OctreeTexture
from octex.texture.split import bits_of, find_rows, rows_facing
from octex.tree.edit import among, children_of
from octex.tree.layout import AREA_ONE, AREA_STEPS, FACING_FLAGS
from octex.tree.octree import Octree

Int64s = npt.NDArray[np.int64]
Float64s = npt.NDArray[np.float64]
Uint8s = npt.NDArray[np.uint8]


class Rows(NamedTuple):
    """Rows of the split table."""

    rows: Int64s  # (n,)
    cells: Int64s  # (n,)   whose rows they are
    bits: Uint8s  # (n,)   their facings, as flags


def rows_of(tree: Octree, cells: Int64s | None = None) -> Rows:
    """Return all rows of a tree, or those of some cells, ascending, whether they are split or not."""
    split = tree.split
    chosen = np.arange(split.cells.size)
    if cells is not None:
        chosen = np.searchsorted(split.cells, cells.astype(np.uint32))
        chosen = chosen[among(cells, split.cells.astype(np.int64))]
    counts = np.bitwise_count(split.facings).astype(np.int64)
    firsts, own = (np.cumsum(counts) - counts)[chosen], counts[chosen]
    starts = np.cumsum(own) - own
    rows = np.repeat(firsts - starts, own) + np.arange(own.sum())
    return Rows(rows, np.repeat(split.cells[chosen].astype(np.int64), own), bits_of(split.facings[chosen]))


def row_residuals(
    texture: OctreeTexture, channel: Channel, change: Change = difference, nodes: Nodes | None = None
) -> Float64s:
    """Return the residuals of the rows (rows, components) of nodes, of all if none are given, changed.

    Those of other cells are zeros.
    """
    form = channel.format
    found = np.zeros((texture.tree.split.areas.size, form.components))
    for rows, owners in _by_level(texture.tree, nodes):
        means, has = _means(texture, channel, rows, owners)
        stored = channel.split_values[rows.rows]
        apart = has & (encode(means, form.dtype, form.space) != stored).any(axis=1)
        if apart.any():
            values = decode(stored[apart], form.space).astype(np.float64)
            found[rows.rows[apart]] = change(rows.cells[apart], values, means[apart])
    return found


def average_rows(
    texture: OctreeTexture, channel: Channel, left: Float64s, nodes: Nodes | None = None
) -> None:
    """Make the rows of split nodes, of all if none are given, anew, in place.

    They become the means of their children and residuals ``left`` (rows of the tree, components). A row that
    no child shows the same way as stays.
    """
    form, limits = channel.format, limits_of(channel)
    for rows, owners in reversed(list(_by_level(texture.tree, nodes))):
        means, has = _means(texture, channel, rows, owners)
        made = with_residuals(limits, means[has], left[rows.rows[has]])
        channel.split_values[rows.rows[has]] = encode(made, form.dtype, form.space)


def _by_level(tree: Octree, nodes: Nodes | None) -> Iterator[tuple[Rows, Int64s]]:
    """Yield the rows of split nodes, from the root down, and their owners' numbers among nodes."""
    if not tree.split.cells.size:
        return
    nodes = all_nodes(tree) if nodes is None else nodes
    rows = rows_of(tree, nodes.cells)
    owners = np.searchsorted(nodes.cells, rows.cells)
    for here in levels_of(tree, nodes):
        some = slice(*np.searchsorted(owners, [here.start, here.stop]).tolist())
        if some.start < some.stop:
            yield Rows(rows.rows[some], rows.cells[some], rows.bits[some]), nodes.numbers[owners[some]]


def _means(
    texture: OctreeTexture, channel: Channel, rows: Rows, owners: Int64s
) -> tuple[Float64s, npt.NDArray[np.bool_]]:
    """Return the means (n, components) of what children show as rows do, and for which rows some do."""
    form = channel.format
    children, bits, starts, shares = _shares(texture.tree, texture.tree.split.areas, rows, owners)
    alpha = texture.channels.get(ALPHA.name)
    if alpha is not None and form.name != ALPHA.name:
        shares *= np.maximum(rows_facing(texture, alpha, children, bits)[:, 0], LEAST_COVERAGE)
    values = rows_facing(texture, channel, children, bits) * shares[:, None]
    totals = np.add.reduceat(shares, starts)
    sums = np.add.reduceat(values, starts, axis=0)
    return sums / np.where(totals > 0, totals, 1.0)[:, None], totals > 0


def add_up_rows(tree: Octree, areas: Uint8s, nodes: Nodes) -> None:
    """Make the areas (rows,) of the rows of split nodes, in place, sums of what their children show that way.

    A row that no child shows the same way as stays.
    """
    for rows, owners in reversed(list(_by_level(tree, nodes))):
        _, _, starts, shares = _shares(tree, areas, rows, owners)
        totals = np.add.reduceat(shares, starts)
        has = totals > 0
        codes = np.rint(AREA_STEPS * np.log2(totals[has] / 4)) + AREA_ONE
        areas[rows.rows[has]] = np.clip(codes, 1, 255).astype(np.uint8)


def _shares(
    tree: Octree, areas: Uint8s, rows: Rows, owners: Int64s
) -> tuple[Int64s, Uint8s, Int64s, Float64s]:
    """Return the children (n,) of rows' owners, the rows' facings, where each row's begin, and their areas.

    ``areas`` are those of all rows of the tree. What a child does not face counts for nothing.
    """
    firsts, counts = children_of(tree, owners)
    starts = np.cumsum(counts) - counts
    children = np.repeat(firsts - starts, counts) + np.arange(counts.sum())
    bits = np.repeat(rows.bits, counts)
    flags = tree.arrays.flags[children]
    shares = AREAS[tree.arrays.areas[children]] / np.maximum(
        np.bitwise_count(flags & np.uint8(FACING_FLAGS)), 1
    )
    there, found = find_rows(tree.split, children, bits)
    shares[there] = AREAS[areas[found]]
    shares[flags & bits == 0] = 0.0
    return children, bits, starts, shares
