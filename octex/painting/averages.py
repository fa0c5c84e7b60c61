"""Averages above paint: what becomes of the residuals of the nodes that it reaches.

They are kept for the part of a node that is not painted, and taken from the paint for the part that is: so
averages stay those of the source where nothing changed, and become those of the paint where all did.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Int64s
from octex.channels import ChannelFormat
from octex.editing.averages import Residuals, average, residuals_at
from octex.editing.nodes import Nodes, nodes_at
from octex.texture import Channel, OctreeTexture
from octex.tree.edit import among, locate, with_all_above
from octex.tree.layout import SPLIT
from octex.tree.octree import Octree, distinct
from octex.tree.split import Rows


class Above(NamedTuple):
    """The nodes above paint, and where they are in other trees; see `nodes_at`."""

    nodes: Nodes
    before: Nodes  # of the texture before it was raised
    layer: Nodes  # of the paint octree


def nodes_above(tree: Octree, codes: Sequence[Int64s], is_new: Bools, before: Octree, layer: Octree) -> Above:
    """Find the nodes above leaves, given by their Morton codes level by level.

    So are split nodes, old ones, above new cells (cells,): these may face other ways than what they divide.
    """
    above = [distinct(own >> 3) for own in with_all_above(codes)[1:]]
    for level, turned in enumerate(_split_above(tree, is_new, before)[: len(above)]):
        above[level] = distinct(np.concatenate([above[level], turned]))
    return Above(*(nodes_at(each, above) for each in (tree, before, layer)))


def _split_above(tree: Octree, is_new: Bools, before: Octree) -> list[Int64s]:
    """Return the codes of split nodes above new cells that were nodes before, by level."""
    if not (is_new.any() and before.split.cells.size):
        return []
    found: list[Int64s] = []
    above = np.empty(0, np.int64)
    for level, (codes, is_node) in reversed(list(enumerate(tree.walk()))):
        here = slice(*tree.arrays.level_cells[level : level + 2].tolist())
        own = codes[is_node & (tree.arrays.flags[here] & SPLIT != 0)]
        own = own[among(own, above)]
        where = locate(before, own, level)
        found.insert(0, own[(where.levels == level) & ~where.is_leaf])
        above = distinct(np.concatenate([above, codes[is_new[here]]]) >> 3)
    return found


def residuals_before(
    before: OctreeTexture, raised: OctreeTexture, name: str, above: Above, is_fresh: Bools, rows: Rows
) -> Residuals:
    """Return the residuals that nodes, and ``rows`` of them, had; none where the texture had nothing.

    Those that were no nodes have the residuals of leaves that were raised.
    """
    nodes, was = above.nodes, above.before.numbers >= 0
    owners = np.searchsorted(nodes.cells, rows.cells)
    numbers = np.where(was | is_fresh[nodes.cells], -1, nodes.numbers)
    kinds = (before, above.before), (raised, nodes._replace(numbers=numbers))
    one, other = (residuals_at(texture, name, places, owners, rows.bits) for texture, places in kinds)
    return Residuals(one.nodes + other.nodes, one.rows + other.rows)


def residuals_of_paint(layer: OctreeTexture, name: str, above: Above, rows: Rows) -> Residuals:
    """Return the residuals that the paint has in nodes, and in ``rows`` of them; zeros where it has none."""
    owners = np.searchsorted(above.nodes.cells, rows.cells)
    return residuals_at(layer, name, above.layer, owners, rows.bits)


def average_above(
    texture: OctreeTexture,
    channel: Channel,
    part: Channel | None,
    above: Above,
    rows: Rows,
    before: Residuals,
    paint: Residuals | None,
) -> Residuals:
    """Make the averages of a texture's channel anew, in place, for nodes and ``rows`` of theirs.

    ``part`` says how much of leaves, and of their rows, is painted, 0 … 1; that of nodes is filled in.
    None stands for nothing. Returns what of residuals is left.
    """
    left = before
    if part is not None:
        own = part._replace(format=ChannelFormat(channel.format.name, 1, "data", "float32"))
        average(texture, own, nodes=above.nodes)
        covered, row_covered = own.values[above.nodes.cells], own.split_values[rows.rows]
        left = Residuals(left.nodes * (1 - covered), left.rows * (1 - row_covered))
        if paint is not None:
            left = Residuals(left.nodes + paint.nodes * covered, left.rows + paint.rows * row_covered)
    average(texture, channel, left, above.nodes)
    return left
