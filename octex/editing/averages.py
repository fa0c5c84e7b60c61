"""Averages after an edit: each node is the mean of its children, and what it differed by from that before.

The mean weighs children by area and alpha, as a conversion does; alpha itself by area alone. A fitted leaf
holds a coefficient, not a mean, so the value of a node, the mean of the source, is not the mean of its
children. What it differs by is its *residual*; a difference that is no more than rounding is none. An edit
says what becomes of residuals; the mean of the children as they are then is added to that.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import (
    ALPHA,
    CHANNELS,
    LEAST_COVERAGE,
    ChannelFormat,
    ColorSpace,
    decode,
    decode_table,
    encode,
)
from octex.jit import decoded, kernel, popcount
from octex.texture.blend import NO_TABLE
from octex.texture.channel import Channel
from octex.tree.edit import children_of, first_children, nodes_by_level
from octex.tree.layout import AREA_ONE, AREA_STEPS, TreeArrays
from octex.tree.octree import Octree

Array = npt.NDArray[np.generic]
Bools = npt.NDArray[np.bool_]
Int64s = npt.NDArray[np.int64]
Float32s = npt.NDArray[np.float32]
Floats = npt.NDArray[np.floating[Any]]
Float64s = npt.NDArray[np.float64]

#: Areas in cell faces by their codes; contacts weigh next to nothing.
AREAS = 2.0 ** ((np.arange(256) - AREA_ONE) / AREA_STEPS)
AREAS[0] = 2.0**-30

_PLAIN = ChannelFormat("number", 1, "data", "float32")
#: What values of floats may be, light that is nowhere brighter than white; integers are clamped as they are
#: stored.
_LIMITS = {
    "srgb": (0.0, 1.0),
    "linear": (0.0, 1.0),
    "data": (-np.inf, np.inf),
    "direction": (-1.0, 1.0),
}

#: What becomes of residuals: from cells (n,), their values and the means of what is below them, decoded
#: (n, components) each, to residuals.
Change = Callable[[Int64s, Float64s, Float64s], Float64s]


def difference(_cells: Int64s, values: Float64s, means: Float64s) -> Float64s:
    """Return residuals as they are."""
    return values - means


class Nodes(NamedTuple):
    """Some nodes of a tree, level by level."""

    numbers: Int64s  # (n,)   among its nodes, ascending
    cells: Int64s  # (n,)   among its cells, ascending

    def of(self, chosen: Bools) -> Nodes:
        """Return some of them."""
        return Nodes(self.numbers[chosen], self.cells[chosen])


def all_nodes(tree: Octree) -> Nodes:
    """Return all nodes of a tree."""
    return Nodes(np.arange(tree.n_nodes), node_cells(tree))


def node_cells(tree: Octree) -> Int64s:
    """Return the cell numbers of all nodes (nodes,), ascending."""
    cells = np.zeros(tree.n_nodes, np.int64)
    _node_cells(tree.arrays, cells)
    return cells


def levels_of(tree: Octree, nodes: Nodes) -> list[slice]:
    """Return where the nodes of each level stand that has any, from the root on."""
    ends = np.searchsorted(nodes.numbers, tree.arrays.level_nodes[: tree.max_depth + 1])
    return [slice(begin, end) for begin, end in pairwise(ends.tolist()) if begin < end]


def alpha_beside(channels: Mapping[str, Channel], name: str) -> Array | None:
    """Return alpha, as stored (cells, 1), if averages of a channel weigh by it."""
    return channels[ALPHA.name].values if ALPHA.name in channels and name != ALPHA.name else None


def coverage(alpha: Array) -> Float32s:
    """Return what cells of some alpha (n, 1), as stored, weigh in averages beside their areas, (n,)."""
    return np.maximum(decode(alpha[:, 0], "data"), np.float32(LEAST_COVERAGE))


def residuals(
    tree: Octree,
    channel: Channel,
    alpha: Array | None,
    change: Change = difference,
    nodes: Nodes | None = None,
) -> Floats:
    """Return the residuals of nodes (n, components), of all if none are given, changed.

    For ``alpha`` see ``alpha_beside``. They are float32, and float64 where float32 is stored.
    """
    nodes = all_nodes(tree) if nodes is None else nodes
    form = channel.format
    precise = np.float64 if form.dtype == "float32" else np.float32
    found = np.zeros((nodes.cells.size, form.components), precise)
    for here in levels_of(tree, nodes):
        cells, own = nodes.cells[here], found[here]
        means = child_means(tree, nodes.numbers[here], channel.values, form.space, alpha)
        stored = channel.values[cells]
        apart = (encode(means, form.dtype, form.space) != stored).any(axis=1)
        if apart.any():
            values = decode(stored[apart], form.space).astype(np.float64)
            own[apart] = change(cells[apart], values, means[apart])
    return found


def average(
    tree: Octree, channel: Channel, alpha: Array | None, left: Floats, nodes: Nodes | None = None
) -> None:
    """Make the values of nodes, of all if none are given, anew, in place.

    They become the means of their children and residuals ``left`` (n, components).
    """
    nodes = all_nodes(tree) if nodes is None else nodes
    form, limits = channel.format, limits_of(channel)
    for here in reversed(levels_of(tree, nodes)):
        means = child_means(tree, nodes.numbers[here], channel.values, form.space, alpha)
        made = with_residuals(limits, means, left[here])
        channel.values[nodes.cells[here]] = encode(made, form.dtype, form.space)


def average_plain(tree: Octree, numbers: Float32s, nodes: Nodes | None = None) -> None:
    """Make the numbers of nodes, in place, the means of those of their children; ``numbers`` (cells,)."""
    channel = Channel(_PLAIN, numbers[:, None], numbers[:0, None], numbers[:0, None])
    count = tree.n_nodes if nodes is None else nodes.cells.size
    average(tree, channel, None, np.zeros((count, 1)), nodes)


def limits_of(channel: Channel) -> tuple[float, float]:
    """Return what values of a channel may be, decoded: light no more than the most that is stored, or 1."""
    form = channel.format
    if form.space == "data" and form.name in CHANNELS:
        return 0.0, 1.0
    low, high = _LIMITS[form.space]
    if form.space in ("srgb", "linear"):
        for stored in (channel.values, channel.split_values):
            if stored.dtype.kind == "f" and stored.size:
                high = max(high, float(decode(stored.max(keepdims=True), form.space).max()))
    return low, high


def with_residuals(limits: tuple[float, float], means: Float64s, left: Floats) -> Float64s:
    """Add residuals to means (n, components), decoded; they leave no value out of limits that it was in."""
    low, high = limits
    limited = np.clip(means + left, np.minimum(means, low), np.maximum(means, high))
    return np.asarray(limited, np.float64)


def child_means(
    tree: Octree, numbers: Int64s, values: Array, space: ColorSpace, alpha: Array | None
) -> Float64s:
    """Return the means of the children of nodes (n, components), decoded.

    ``numbers`` (n,) are the nodes', among all nodes. ``values`` (cells, components), as stored, weigh by
    their areas, and by ``alpha`` (cells, 1), as stored.
    """
    means = np.zeros((numbers.size, values.shape[1]))
    firsts, counts = children_of(tree, numbers)
    begin, end = int(firsts[0]), int(firsts[-1] + counts[-1])
    children: Int64s | slice = slice(begin, end)
    starts = firsts - begin
    if counts.sum() != end - begin:  # they do not stand side by side
        starts = np.cumsum(counts) - counts
        children = np.repeat(firsts - starts, counts) + np.arange(counts.sum())
        children = np.clip(children, 0, tree.n_cells - 1)
    stored = values[children]
    is_coded = stored.dtype.kind == "u"
    is_plain = is_coded or (stored.dtype == np.float32 and space != "srgb")
    codes: npt.NDArray[Any] = stored if is_plain else decode(stored, space)
    table = decode_table(stored.dtype.name, space) if is_coded else NO_TABLE
    weights = np.empty(0, np.float32) if alpha is None else coverage(alpha[children])
    _means(starts, counts, tree.arrays.areas[children], AREAS, weights, codes, table, means)
    return means


@kernel
def _means(
    starts: Int64s,
    counts: Int64s,
    areas: npt.NDArray[np.uint8],
    shares: Float64s,
    weights: Float32s,
    codes: npt.NDArray[np.uint8 | np.uint16 | np.float32],
    table: Float32s,
    means: Float64s,
) -> None:
    """Average runs of rows."""
    for n in range(counts.size):
        total = 0.0
        for child in range(max(starts[n], 0), min(starts[n] + counts[n], areas.size)):
            share = shares[areas[child]]
            if weights.size > 0:
                share *= np.float64(weights[child])
            total += share
            for k in range(codes.shape[1]):
                means[n, k] += share * np.float64(decoded(table, codes[child, k]))
        for k in range(codes.shape[1] if total > 0.0 else 0):
            means[n, k] /= total


@kernel
def _node_cells(arrays: TreeArrays, cells: Int64s) -> None:
    """Fill in the cells of the nodes after the root."""
    groups = arrays.groups
    next_node, begin = 1, np.int64(1)
    for node in range(cells.size):
        shift = np.uint64(8 * (node & 7))
        nodes = groups[node >> 3, 0] >> shift & np.uint64(0xFF)
        children = nodes | groups[node >> 3, 1] >> shift & np.uint64(0xFF)
        while nodes != np.uint64(0) and next_node < cells.size:
            lowest = nodes & (~nodes + np.uint64(1))
            nodes ^= lowest
            cell = begin + popcount(children & (lowest - np.uint64(1)))
            cells[next_node] = min(cell, np.int64(arrays.areas.size - 1))
            next_node += 1
        begin += popcount(children)


def add_up_areas(tree: Octree, is_new: Bools, areas: npt.NDArray[np.uint8]) -> None:
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
