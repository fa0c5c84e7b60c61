"""Cells that a source knows nothing of, left out of a conversion."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from octex.arrays import Array, Bools, Int64s
from octex.channels import ALPHA, ONE, decode
from octex.conversion import large
from octex.conversion.samples import UNIT, Samples
from octex.editing.averages import average
from octex.editing.nodes import nodes_at
from octex.texture import Channel, OctreeTexture
from octex.tree.octree import Octree

#: The alpha of what hardly weighs more than gaps: what they add to others is lost in float32's rounding.
_TRANSPARENT = 2.0**-20


def average_transparent(tree: Octree, channels: Mapping[str, Channel], gaps: Int64s) -> None:
    """Make the colours of nodes anew, in place, that are transparent and had gaps, finest cells, below them.

    A gap weighs as much as what is transparent: means of both are not those of what is left.
    """
    cells = np.flatnonzero(_is_transparent(channels[ALPHA.name].values))
    if not cells.size:
        return
    texture = OctreeTexture(tree, channels, UNIT, np.zeros((2, 3)))
    gaps, found = np.sort(gaps, kind="stable"), []
    for level, (codes, is_node) in enumerate(tree.walk()):
        first, end = np.searchsorted(cells, tree.arrays.level_cells[level : level + 2]).tolist()
        own = cells[first:end] - tree.arrays.level_cells[level]
        codes, shift = codes[own[is_node[own]]], 3 * (tree.max_depth - level)
        begins, ends = np.searchsorted(gaps, [codes << shift, codes + 1 << shift])
        found.append(codes[begins < ends])
    nodes = nodes_at(tree, found)
    for name, channel in channels.items():
        if name != ALPHA.name and nodes.cells.size:
            average(texture, channel, nodes=nodes)


def _is_transparent(alpha: Array) -> Bools:
    """Say which cells of some alpha (n, 1), as stored, hardly weigh more than gaps."""
    found: Bools = decode(alpha[:, 0], "data") < _TRANSPARENT
    return found


def without_opaque(channels: Mapping[str, Channel]) -> dict[str, Channel]:
    """Leave out a channel ``alpha`` that is 1 everywhere: it tells nothing."""
    alpha = channels[ALPHA.name]
    is_opaque = (alpha.values == ONE[alpha.format.dtype]).all()
    return {name: channel for name, channel in channels.items() if not (is_opaque and name == ALPHA.name)}


def with_bare_as_means(samples: Samples, channels: Mapping[str, Channel]) -> Samples:
    """Give samples whose ``alpha`` is 0 the means of their cells.

    They tell nothing of the others; as black they would darken the rim of what is known.
    """
    columns = np.cumsum([0, *(form.components for form in samples.channels)]).tolist()
    names = [form.name for form in samples.channels]
    bare = np.flatnonzero(samples.values[:, columns[names.index(ALPHA.name)]] == 0)
    cells = np.repeat(np.arange(samples.codes.size), np.diff(samples.firsts))[bare]
    values = large.copied(samples.values)
    for name, first, end in zip(names, columns[:-1], columns[1:], strict=True):
        if name != ALPHA.name:
            finest = channels[name].values[-samples.codes.size :]
            values[bare, first:end] = decode(finest[cells], channels[name].format.space)
    return samples._replace(values=values)
