"""Averages above paint: what becomes of the residuals of the nodes that it reaches.

They are kept for the part of a node that is not painted, and taken from the paint for the part that is: so
averages stay those of the source where nothing changed, and become those of the paint where all did.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import ChannelFormat
from octex.editing.averages import Nodes, alpha_beside, average, residuals
from octex.editing.facings import Rows, average_rows, row_residuals
from octex.texture import OctreeTexture
from octex.texture.channel import Channel
from octex.texture.split import find_rows
from octex.tree.edit import among, locate
from octex.tree.layout import SPLIT
from octex.tree.octree import Octree, distinct

Bools = npt.NDArray[np.bool_]
Int64s = npt.NDArray[np.int64]
Float32s = npt.NDArray[np.float32]
Float64s = npt.NDArray[np.float64]


class Above(NamedTuple):
    """The nodes above paint, and where they are in other trees."""

    nodes: Nodes
    before: Nodes  # of the texture before it was raised; −1 for what was no node there
    layer: Nodes  # of the paint octree; the numbers are −1, the cells those around, where it has no node

    def of(self, chosen: Bools) -> Above:
        """Return some of them."""
        return Above(*(each.of(chosen) for each in self))


def nodes_above(tree: Octree, codes: Sequence[Int64s], is_new: Bools, before: Octree, layer: Octree) -> Above:
    """Find the nodes above leaves, given by their Morton codes level by level.

    So are split nodes, old ones, above new cells (cells,): these may face other ways than what they divide.
    """
    none = np.empty(0, np.int64)
    found = [Above(*[Nodes(none, none)] * 3)]
    painted = none
    turned = _split_above(tree, is_new, before)
    for level in range(len(codes) - 2, -1, -1):
        painted = distinct(np.concatenate([painted, codes[level + 1]]) >> 3)
        above = distinct(np.concatenate([painted, turned[level]])) if level < len(turned) else painted
        where = [locate(each, above, level) for each in (tree, before, layer)]
        numbers = [np.where(each.levels == level, each.nodes, -1) for each in where]
        cells = where[0].cells, np.where(numbers[1] >= 0, where[1].cells, -1), where[2].cells
        found.append(Above(*(Nodes(*each) for each in zip(numbers, cells, strict=True))))
    columns = zip(*((column for each in level for column in each) for level in reversed(found)), strict=True)
    joined = [np.concatenate(column) for column in columns]
    return Above(*(Nodes(*joined[n : n + 2]) for n in (0, 2, 4)))


def _split_above(tree: Octree, is_new: Bools, before: Octree) -> list[Int64s]:
    """Return the codes of split nodes above new cells that were nodes before, by level."""
    if not (is_new.any() and before.split.cells.size):
        return []
    found: list[Int64s] = []
    above = np.empty(0, np.int64)
    for level, (codes, is_node) in reversed(list(enumerate(tree.walk()))):
        here = slice(*tree.arrays.level_cells[level : level + 2].tolist())
        is_split = is_node & (tree.arrays.flags[here] & SPLIT != 0)
        where = locate(before, codes, level)
        is_split &= (where.levels == level) & ~where.is_leaf
        found.insert(0, codes[is_split & among(codes, above)])
        above = distinct(np.concatenate([above, codes[is_new[here]]]) >> 3)
    return found


class Left(NamedTuple):
    """What is left of residuals."""

    nodes: Float64s  # (n, components)
    rows: Float64s  # (rows of these nodes, components)


def residuals_before(
    before: OctreeTexture, raised: OctreeTexture, name: str, above: Above, is_fresh: Bools, rows: Rows
) -> Left:
    """Return the residuals that nodes, and ``rows`` of them, had; none where the texture had nothing.

    Those that were no nodes have the residuals of leaves that were raised.
    """
    was = above.before.numbers >= 0
    kinds = (before, above.before, was), (raised, above.nodes, ~was & ~is_fresh[above.nodes.cells])
    components = raised.channels[name].format.components
    found = np.zeros((was.size, components))
    for texture, nodes, chosen in kinds:
        if chosen.any():
            channels = texture.channels
            own = residuals(
                texture.tree, channels[name], alpha_beside(channels, name), nodes=nodes.of(chosen)
            )
            found[chosen] = own
    owners = np.searchsorted(above.nodes.cells, rows.cells)
    of_rows = found[owners]
    for texture, nodes, chosen in kinds:
        _take_rows(texture, name, nodes.of(chosen), nodes.cells[owners], rows.bits, of_rows)
    return Left(found, of_rows)


def residuals_of_paint(layer: OctreeTexture, name: str, above: Above, rows: Rows) -> Left:
    """Return the residuals that the paint has in nodes, and in ``rows`` of them; zeros where it has none."""
    channel, nodes = layer.channels[name], above.layer
    has = nodes.numbers >= 0
    found = np.zeros((has.size, channel.format.components))
    chosen = nodes.of(has)
    found[has] = residuals(layer.tree, channel, alpha_beside(layer.channels, name), nodes=chosen)
    owners = np.searchsorted(above.nodes.cells, rows.cells)
    of_rows = found[owners]
    _take_rows(layer, name, chosen, np.where(has, nodes.cells, -1)[owners], rows.bits, of_rows)
    return Left(found, of_rows)


def _take_rows(
    texture: OctreeTexture,
    name: str,
    nodes: Nodes,
    cells: Int64s,
    bits: npt.NDArray[np.uint8],
    found: Float64s,
) -> None:
    """Write the residuals of rows of ``nodes`` where cells (n,) have rows for facings (n,)."""
    if not texture.tree.split.cells.size or not nodes.cells.size:
        return
    own = np.flatnonzero(np.isin(cells, nodes.cells))
    there, rows = find_rows(texture.tree.split, cells[own], bits[own])
    if rows.size:
        found[own[there]] = row_residuals(texture, texture.channels[name], nodes=nodes)[rows]


def average_above(
    texture: OctreeTexture,
    channel: Channel,
    part: Channel | None,
    above: Above,
    rows: Rows,
    before: Left,
    paint: Left | None,
) -> Float64s:
    """Make the averages of a texture's channel anew, in place, for nodes and ``rows`` of theirs.

    ``part`` says how much of leaves, and of their rows, is painted, 0 … 1; that of nodes is filled in.
    None stands for nothing.
    Returns what of residuals is left in all rows of the tree (rows, components).
    """
    tree, name = texture.tree, channel.format.name
    alpha = alpha_beside(texture.channels, name)
    left, of_rows = before
    if part is not None:
        own = part._replace(format=ChannelFormat(name, 1, "data", "float32"))
        average(tree, own, alpha, np.zeros((above.nodes.cells.size, 1)), above.nodes)
        average_rows(texture, own, np.zeros((len(own.split_values), 1)), above.nodes)
        covered, row_covered = own.values[above.nodes.cells], own.split_values[rows.rows]
        left, of_rows = left * (1 - covered), of_rows * (1 - row_covered)
        if paint is not None:
            left += paint.nodes * covered
            of_rows += paint.rows * row_covered
    left_rows = np.zeros(channel.split_values.shape)
    left_rows[rows.rows] = of_rows
    average(tree, channel, alpha, left, above.nodes)
    average_rows(texture, channel, left_rows, above.nodes)
    return left_rows
