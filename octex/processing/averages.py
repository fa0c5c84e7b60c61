"""Averages after an edit: each node is the mean of its children, and what it differed by from that before.

A fitted leaf holds a coefficient, not a mean, so the value of a node, the mean of the source, is not the mean
of its children. What it differs by is its *residual*; a difference that is no more than rounding is none.
An edit says what becomes of residuals; the mean of the children as they are now is added to that, and the
sum is kept in the range that there is: no light is darker than black.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import ALPHA, ChannelFormat, ColorSpace, decode, decode_table, encode
from octex.conversion.accumulate import LEAST_COVERAGE
from octex.jit import decoded, kernel, popcount
from octex.painting.averages import AREAS
from octex.texture import Channel
from octex.texture.blend import NO_TABLE
from octex.tree.layout import TreeArrays
from octex.tree.octree import Octree

Array = npt.NDArray[np.generic]
Bools = npt.NDArray[np.bool_]
Int64s = npt.NDArray[np.int64]
Float32s = npt.NDArray[np.float32]
Floats = npt.NDArray[np.floating[Any]]
Float64s = npt.NDArray[np.float64]

_PLAIN = ChannelFormat("number", 1, "data", "float32")

#: What becomes of residuals: from cells (n,), their values and the means of what is below them, decoded
#: (n, components) each, to residuals.
Change = Callable[[Int64s, Float64s, Float64s], Float64s]


def difference(_cells: Int64s, values: Float64s, means: Float64s) -> Float64s:
    """Return residuals as they are."""
    return values - means


def coverage(channels: Mapping[str, Channel], name: str) -> Float32s:
    """Return what cells (cells,) weigh in averages of a channel beside their areas; none if that is 1."""
    if ALPHA.name not in channels or name == ALPHA.name:
        return np.empty(0, np.float32)
    alpha = decode(channels[ALPHA.name].values[:, 0], "data")
    return np.maximum(alpha, np.float32(LEAST_COVERAGE))


class Tables(NamedTuple):
    """A function of each component of a channel of integers: what becomes of their codes' values."""

    decoded: Float32s  # (codes,)   the value of each code, ascending
    mapped: Float32s  # (components, codes)   what it becomes
    bins: Int64s  # (_BINS + 1,)   the last code up to each of as many steps from the first value to the last


_BINS = 4096


def tables_of(mapped: Float32s, dtype: str, space: ColorSpace) -> Tables:
    """Return the tables of a channel whose codes become ``mapped`` (components, codes), decoded."""
    values = decode_table(dtype, space)
    steps = np.linspace(float(values[0]), float(values[-1]), _BINS + 1)
    return Tables(values, mapped, np.searchsorted(values, steps.astype(np.float32), side="right") - 1)


def average_by_tables(
    tree: Octree, before: Channel, after: Channel, weights: Float32s, tables: Tables
) -> None:
    """Do with ``after`` what ``residuals`` and ``average`` do, at once; in place.

    Between its codes a function is taken to be straight.
    """
    form, nodes = before.format, node_cells(tree)
    for level in range(tree.max_depth - 1, -1, -1):
        first, end = tree.arrays.level_nodes[level : level + 2].tolist()
        below = slice(*tree.arrays.level_cells[level + 1 : level + 3].tolist())
        here = nodes[first:end]
        found = np.zeros((end - first, form.components))
        _mapped_means(
            *(tree.arrays.groups, first, tree.arrays.areas[below], AREAS, weights[below]),
            *(before.values[below], after.values[below], before.values[here], tables, found),
        )
        after.values[here] = encode(found, form.dtype, form.space)


def changed_by(tables: Tables) -> Change:
    """Return what tables do to residuals."""

    def changed(_cells: Int64s, values: Float64s, means: Float64s) -> Float64s:
        columns = [
            np.interp(values[:, k], tables.decoded, mapped) - np.interp(means[:, k], tables.decoded, mapped)
            for k, mapped in enumerate(tables.mapped)
        ]
        return np.stack(columns, axis=1)

    return changed


@kernel
def _mapped_means(
    groups: npt.NDArray[np.uint64],
    first: int,
    areas: npt.NDArray[np.uint8],
    shares: Float64s,
    weights: Float32s,
    before: npt.NDArray[np.uint8 | np.uint16],
    after: npt.NDArray[np.uint8 | np.uint16],
    nodes: npt.NDArray[np.uint8 | np.uint16],
    tables: Tables,
    found: Float64s,
) -> None:
    """Write the means of children as they are after, and what of residuals is mapped."""
    values, last = tables.decoded, tables.decoded.size - 1
    sums = np.zeros((2, found.shape[1]))
    low, scale = np.float64(values[0]), _BINS / (np.float64(values[last]) - np.float64(values[0]))
    begin = 0
    for n in range(found.shape[0]):
        node = first + n
        children = (groups[node >> 3, 0] | groups[node >> 3, 1]) >> np.uint64(8 * (node & 7))
        end = min(begin + popcount(children & np.uint64(0xFF)), areas.size)
        total = 0.0
        sums[:] = 0.0
        for child in range(begin, end):
            share = shares[areas[child]]
            if weights.size > 0:
                share *= np.float64(weights[child])
            total += share
            for k in range(found.shape[1]):
                sums[0, k] += share * np.float64(values[before[child, k]])
                sums[1, k] += share * np.float64(values[after[child, k]])
        begin = end
        for k in range(found.shape[1] if total > 0.0 else 0):
            mean, mapped = sums[0, k] / total, sums[1, k] / total
            step = min(max(int((mean - low) * scale), 0), _BINS - 1)
            at, beyond = tables.bins[step], tables.bins[step + 1]
            while at < beyond:  # the last code whose value is not above the mean
                middle = (at + beyond + 1) >> 1
                if np.float64(values[middle]) <= mean:
                    at = middle
                else:
                    beyond = middle - 1
            at = min(max(at, 0), last - 1)
            code = int(nodes[n, k])
            part = (mean - values[at]) / (np.float64(values[at + 1]) - np.float64(values[at]))
            if abs(at + part - code) > 0.5:
                one, other = np.float64(tables.mapped[k, at]), np.float64(tables.mapped[k, at + 1])
                mapped += np.float64(tables.mapped[k, code]) - (one + part * (other - one))
            found[n, k] = mapped


def within(values: Floats, form: ChannelFormat, *stored: npt.NDArray[Any]) -> Floats:
    """Bring what was reckoned into 0 … 1, directions −1 … 1, or as far beyond as what is ``stored`` goes.

    Residuals and differences may lead out of it. ``stored`` are decoded and broadcast with ``values``.
    Integers are clamped when they are encoded.
    """
    if form.dtype.startswith("u"):
        return values
    low, high = np.float64(-1.0 if form.space == "direction" else 0.0), np.float64(1.0)
    for each in stored:
        low, high = np.minimum(low, each), np.maximum(high, each)
    return np.clip(values, low, high)


def limits(channel: Channel) -> tuple[npt.NDArray[Any], ...]:
    """Return the least and the largest value of a channel of floats, decoded; integers limit themselves."""
    values = channel.values
    if values.dtype.kind != "f":
        return ()
    return decode(values.min(keepdims=True), channel.format.space), decode(
        values.max(keepdims=True), channel.format.space
    )


def node_cells(tree: Octree) -> Int64s:
    """Return the cell numbers of all nodes (nodes,), ascending."""
    cells = np.zeros(tree.n_nodes, np.int64)
    _node_cells(tree.arrays, cells)
    return cells


def residuals(
    tree: Octree,
    channel: Channel,
    weights: Float32s,
    change: Change = difference,
    chosen: Bools | None = None,
) -> Floats:
    """Return the residuals of all nodes (nodes, components), changed; see ``coverage`` for weights.

    They are float32, and float64 where float32 is stored. Zeros stand for nodes that are not ``chosen``.
    """
    form, nodes = channel.format, node_cells(tree)
    precise = np.float64 if form.dtype == "float32" else np.float32
    found = np.zeros((tree.n_nodes, form.components), precise)
    for level, here in _levels(tree, chosen):
        means = child_means(tree, level, channel.values, form.space, weights, chosen)
        stored = channel.values[nodes[here]]
        apart = (encode(means, form.dtype, form.space) != stored).any(axis=1)
        if apart.any():
            values = decode(stored[apart], form.space).astype(np.float64)
            found[here[apart]] = change(nodes[here[apart]], values, means[apart])
    return found


def average(
    tree: Octree, channel: Channel, weights: Float32s, left: Floats, chosen: Bools | None = None
) -> None:
    """Make the values of nodes anew, in place: means of their children, and residuals ``left``.

    ``left`` (nodes, components), if not all are ``chosen`` of those alone.
    """
    form, nodes, bounds = channel.format, node_cells(tree), limits(channel)
    end = len(left)
    for level, here in reversed(list(_levels(tree, chosen))):
        begin = end - here.size if chosen is not None else int(here[0])
        means = child_means(tree, level, channel.values, form.space, weights, chosen)
        means += left[begin : begin + here.size]
        channel.values[nodes[here]] = encode(within(means, form, *bounds), form.dtype, form.space)
        end = begin


def average_plain(tree: Octree, numbers: Float32s, chosen: Bools | None = None) -> None:
    """Make the numbers of nodes, in place, the means of those of their children; ``numbers`` (cells,)."""
    channel = Channel(_PLAIN, numbers[:, None], numbers[:0, None], numbers[:0, None])
    count = tree.n_nodes if chosen is None else int(chosen.sum())
    average(tree, channel, np.empty(0, np.float32), np.zeros((count, 1)), chosen)


def _levels(tree: Octree, chosen: Bools | None) -> Iterator[tuple[int, Int64s]]:
    """Yield levels, and which of their nodes, that have children, are chosen, if any is."""
    for level in range(tree.max_depth):
        first, end = tree.arrays.level_nodes[level : level + 2].tolist()
        here = np.arange(first, end) if chosen is None else np.flatnonzero(chosen[first:end]) + first
        if here.size:
            yield level, here


def child_means(
    tree: Octree,
    level: int,
    values: Array,
    space: ColorSpace,
    weights: Float32s,
    chosen: Bools | None = None,
) -> Float64s:
    """Return the means of the children of a level's nodes (nodes there, components), decoded.

    ``values`` (cells, components), as stored, weigh by their areas, and by ``weights`` (cells,) if not empty.
    ``chosen`` (nodes of the tree,) says whose are wanted; None: all.
    """
    first, end = tree.arrays.level_nodes[level : level + 2].tolist()
    below = slice(*tree.arrays.level_cells[level + 1 : level + 3].tolist())
    wanted = np.ones(end - first, np.bool_) if chosen is None else chosen[first:end]
    means = np.zeros((int(wanted.sum()), values.shape[1]))
    stored = values[below]
    is_coded = stored.dtype.kind == "u"
    is_plain = is_coded or (stored.dtype == np.float32 and space != "srgb")
    codes: npt.NDArray[Any] = stored if is_plain else decode(stored, space)
    table = decode_table(stored.dtype.name, space) if is_coded else NO_TABLE
    areas = tree.arrays.areas[below]
    _means(tree.arrays.groups, first, wanted, areas, AREAS, weights[below], codes, table, means)
    return means


@kernel
def _means(
    groups: npt.NDArray[np.uint64],
    first: int,
    wanted: Bools,
    areas: npt.NDArray[np.uint8],
    shares: Float64s,
    weights: Float32s,
    codes: npt.NDArray[np.uint8 | np.uint16 | np.float32],
    table: Float32s,
    means: Float64s,
) -> None:
    begin = n = 0
    for each in range(wanted.size):
        node = first + each
        children = (groups[node >> 3, 0] | groups[node >> 3, 1]) >> np.uint64(8 * (node & 7))
        end = min(begin + popcount(children & np.uint64(0xFF)), areas.size)
        if not wanted[each]:
            begin = end
            continue
        total = 0.0
        for child in range(begin, end):
            share = shares[areas[child]]
            if weights.size > 0:
                share *= np.float64(weights[child])
            total += share
            for k in range(codes.shape[1]):
                means[n, k] += share * np.float64(decoded(table, codes[child, k]))
        for k in range(codes.shape[1] if total > 0.0 else 0):
            means[n, k] /= total
        begin = end
        n += 1


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
