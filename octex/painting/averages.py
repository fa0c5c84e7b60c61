"""Averages after an edit: what changes in leaves changes the means of all cells above them.

A fitted leaf holds a coefficient, not a mean. What the mean of a node differs by from that of its children's
values, its *residual*, is kept for the part that is not painted, and taken from the paint for the part that
is: so averages stay those of the source where nothing changed, and become those of the paint where all did.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import ALPHA, ChannelFormat, decode
from octex.jit import kernel
from octex.texture import OctreeTexture
from octex.texture.channel import Channel
from octex.tree.edit import Located, children_of, first_children, locate, nodes_by_level
from octex.tree.layout import AREA_ONE, AREA_STEPS
from octex.tree.octree import Octree, distinct

Int64s = npt.NDArray[np.int64]
Float32s = npt.NDArray[np.float32]
Float64s = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

#: Areas in cell faces by their codes; contacts weigh next to nothing.
AREAS = 2.0 ** ((np.arange(256) - AREA_ONE) / AREA_STEPS)
AREAS[0] = 2.0**-30


def add_up_areas(
    tree: Octree,
    is_new: Bools,
    areas: npt.NDArray[np.uint8],
) -> None:
    """Give nodes above new cells the areas of all their children, in place."""
    first = tree.arrays.level_cells
    above = is_new.copy()
    nodes_of = nodes_by_level(tree)
    for level in range(tree.max_depth - 1, -1, -1):
        starts = first_children(tree, level) - first[level + 1]
        if not starts.size:
            continue
        below = slice(int(first[level + 1]), int(first[level + 2]))
        changed = np.logical_or.reduceat(above[below], starts)
        nodes = nodes_of[level][changed]
        above[nodes] = True
        sums = np.add.reduceat(np.where(areas[below] > 0, AREAS[areas[below]], 0.0), starts)[changed] / 4
        coded = np.rint(AREA_STEPS * np.log2(np.maximum(sums, 1e-30)) + AREA_ONE)
        areas[nodes] = np.where(sums > 0, np.clip(coded, 1, 255), 0)


class Updated(NamedTuple):
    """The nodes above paint, from the deepest level up."""

    nodes: Int64s  # (n,)   cells of the texture's tree
    values: Float64s  # (n, components)   their new averages, decoded
    sources: Int64s  # (n,)   the deepest cells of the paint octree that hold them


def updated_averages(
    tree: Octree,
    before: npt.NDArray[Any],
    after: npt.NDArray[Any],
    form: ChannelFormat,
    painted: Int64s,
    coverage: Float32s,
    codes: Sequence[Int64s],
    layer: OctreeTexture,
    paint: Channel | None,
    has_average: Bools,
) -> Updated:
    """Find the nodes above painted leaves, and their new values.

    before, after     (cells, components), as stored: before and after leaves were painted
    painted, coverage leaves, ascending, and 0 … 1 how much of each
    codes             the Morton codes of these leaves, level by level
    layer, paint      the paint octree, and its channel whose residuals count; None: none do
    has_average       (cells,) nodes whose value before was an average; of others it is made anew
    """
    opacity = decode(layer.channels[ALPHA.name].values, "data")[:, 0]
    part = np.zeros(tree.n_cells, np.float32)
    part[painted] = coverage
    none = np.empty(0, np.int64)
    found = [Updated(none, np.empty((0, after.shape[1])), none)]
    below = none  # nodes of the level below, as codes
    for level in range(tree.max_depth - 1, -1, -1):
        leaves = codes[level + 1] if level + 1 < len(codes) else none
        above = distinct(np.concatenate([below, leaves]) >> 3)
        if not above.size:
            continue
        where = locate(tree, above, level)
        nodes = where.cells
        children, counts = _below(tree, where.nodes)
        shares = AREAS[tree.arrays.areas[children]]
        old = decode(before[children], form.space)
        new = decode(after[children], form.space).astype(np.float64)
        _replace(children, *found[-1][:2], new)  # more precise than what is stored
        covered = _means(counts, shares, part[children, None])[:, 0]
        residual = decode(before[nodes], form.space) - _means(counts, shares, old)
        residual[~has_average[nodes]] = 0.0
        mean = _means(counts, shares, new) + residual * (1.0 - covered[:, None])
        sources = locate(layer.tree, above, level)
        if paint is not None:
            own = (sources.levels == level) & ~sources.is_leaf
            mean[own] += _residuals(layer.tree, sources.of(own), paint, opacity) * covered[own, None]
        part[nodes] = covered
        below = above
        found.append(Updated(nodes, mean, sources.cells))
    return Updated(*(np.concatenate(arrays) for arrays in zip(*found, strict=True)))


def _residuals(tree: Octree, where: Located, channel: Channel, opacity: Float32s) -> Float64s:
    """Return what the values of nodes differ by from the means of their children, as opaque as they are."""
    children, counts = _below(tree, where.nodes)
    shares = AREAS[tree.arrays.areas[children]] * np.maximum(opacity[children], 1e-9)
    space = channel.format.space
    of_children = _means(counts, shares, decode(channel.values[children], space))
    residuals: Float64s = decode(channel.values[where.cells], space) - of_children
    return residuals


def _below(tree: Octree, nodes: Int64s) -> tuple[Int64s, Int64s]:
    """Return the children of nodes, given by their numbers among nodes, and how many each has."""
    firsts, counts = children_of(tree, nodes)
    starts = np.cumsum(counts) - counts
    return np.repeat(firsts - starts, counts) + np.arange(counts.sum()), counts


@kernel
def _means(counts: Int64s, shares: Float64s, values: npt.NDArray[Any]) -> Float64s:
    """Average runs of rows, by their shares."""
    components = values.shape[1]
    means = np.zeros((counts.size, components))
    row = 0
    for n in range(counts.size):
        total = 0.0
        for child in range(row, row + counts[n]):
            total += shares[child]
            for k in range(components):
                means[n, k] += shares[child] * np.float64(values[child, k])
        for k in range(components):
            means[n, k] /= total
        row += counts[n]
    return means


@kernel
def _replace(cells: Int64s, known: Int64s, values: Float64s, found: Float64s) -> None:
    """Put the values of known cells among those of cells; both ascend."""
    at = 0
    for n in range(cells.size):
        while at < known.size and known[at] < cells[n]:
            at += 1
        if at < known.size and known[at] == cells[n]:
            for k in range(found.shape[1]):
                found[n, k] = values[at, k]
