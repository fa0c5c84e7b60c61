"""Averages after an edit: each node is the mean of its children plus its residual before the edit.

The mean weights children by area and alpha, as a conversion does; alpha itself by area only. A fitted leaf
holds a coefficient, not a mean. So a node's value, the mean of the source, is not the mean of its children.
The difference is its *residual*; differences within rounding are 0. An edit maps residuals, then adds them to
the means of the edited children.

The rows of a split node are averages in the same way, over its children's rows of equal facing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Bools, ChannelValues, Float32s, Float64s, Floats, Int64s, Uint8s, in_runs
from octex.channels import (
    CHANNELS,
    LEAST_COVERAGE,
    ChannelFormat,
    ColorSpace,
    alpha_of,
    code_table,
    decode,
    encode,
    plain_name,
)
from octex.editing.nodes import Nodes, all_children, all_nodes, by_level, rows_by_level
from octex.editing.split import rows_facing
from octex.jit import decoded, kernel
from octex.texture import Channel, OctreeTexture
from octex.texture.channel import NO_TABLE
from octex.tree.areas import AREAS, SKIRT, area_codes
from octex.tree.children import children_of
from octex.tree.octree import Octree
from octex.tree.split import Rows, counts_of, find_rows, rows_of

#: Limits of float values, for light without values above 1; encoding clamps integers.
_LIMITS = {"srgb": (0.0, 1.0), "linear": (0.0, 1.0), "data": (-np.inf, np.inf), "direction": (-1.0, 1.0)}

#: Residuals of up to this many nodes are computed for all levels at once; of more level by level, to save
#: memory.
_FEW = 1 << 16
#: Maps cells (n,), their values and the means of their children, decoded (n, components), to residuals.
ResidualsOf = Callable[[Int64s, Float64s, Float64s], Float64s]


def as_they_are(_cells: Int64s, values: Float64s, means: Float64s) -> Float64s:
    """Return the residuals of values."""
    return values - means


class Residuals(NamedTuple):
    """Differences of nodes from the averages of their children."""

    nodes: Floats  # (n, components)
    rows: Floats  # (rows of these nodes, components)


def _alpha_for(texture: OctreeTexture, name: str) -> Channel | None:
    """Return the channel that weights the averages of a channel, if the texture has it."""
    alpha = alpha_of(name)
    return None if alpha is None else texture.channels.get(alpha)


def coverage(alpha: Array) -> Float32s:
    """Return the weight (n,) in averages of cells with stored alpha (n, 1), besides their areas."""
    return np.maximum(decode(alpha[:, 0], "data"), np.float32(LEAST_COVERAGE))


def residuals(
    texture: OctreeTexture, name: str, nodes: Nodes | None = None, change: ResidualsOf = as_they_are
) -> Residuals:
    """Return the mapped residuals of nodes, by default of all."""
    tree, channel = texture.tree, texture.channels[name]
    nodes = all_nodes(tree) if nodes is None else nodes
    form, alpha = channel.format, _alpha_for(texture, name)
    precise = np.float64 if form.dtype == "float32" else np.float32
    of_nodes = np.zeros((nodes.cells.size, form.components), precise)
    for of_level in [slice(None)] if 0 < nodes.cells.size <= _FEW else by_level(tree, nodes):
        cells = nodes.cells[of_level]
        means = child_means(tree, nodes.numbers[of_level], channel.values, form.space, alpha)
        _write_residuals(form, channel.values.take(cells, axis=0), means, cells, change, of_nodes[of_level])
    of_rows = np.zeros((rows_of(tree.split, nodes.cells).rows.size, form.components))
    for of_level, rows, owners in rows_by_level(tree, nodes):
        means, has_mean = _row_means(texture, channel, rows, owners)
        stored = channel.split_values[rows.rows[has_mean]]
        row_residuals = np.zeros((stored.shape[0], form.components))
        _write_residuals(form, stored, means[has_mean], rows.cells[has_mean], change, row_residuals)
        of_rows[of_level][has_mean] = row_residuals
    return Residuals(of_nodes, of_rows)


def _write_residuals(
    form: ChannelFormat, stored: Array, means: Float64s, cells: Int64s, change: ResidualsOf, out: Floats
) -> None:
    """Write the mapped residuals of stored values (n, components) where these differ from the means."""
    differs = encode(means, form.dtype, form.space) != stored
    if differs.any():
        differing = np.logical_or.reduce(list(differs.T))  # twice as fast as along an axis of three
        values = decode(stored[differing], form.space).astype(np.float64)
        out[differing] = change(cells[differing], values, means[differing])


def residuals_at(texture: OctreeTexture, name: str, nodes: Nodes, owners: Int64s, bits: Uint8s) -> Residuals:
    """Return a texture's residuals at nodes (n,) of another tree, and at its rows (m,).

    ``nodes`` have the numbers that these nodes have in the texture; −1, for no node, gets zeros. ``owners``
    (m,) index the rows' nodes, ``bits`` (m,) are their facings; a missing row gets its node's residual.
    """
    has_node = nodes.numbers >= 0
    of_nodes = np.zeros((has_node.size, texture.channels[name].format.components))
    if not has_node.any():
        return Residuals(of_nodes, of_nodes[owners])
    shared = nodes.of(has_node)
    known = residuals(texture, name, shared)
    of_nodes[slice(None) if has_node.all() else has_node] = known.nodes
    of_rows = of_nodes[owners]
    split = texture.tree.split
    has_row, rows = find_rows(split, np.where(has_node, nodes.cells, -1)[owners], bits)
    if rows.size:
        of_rows[has_row] = known.rows[np.searchsorted(rows_of(split, shared.cells).rows, rows)]
    return Residuals(of_nodes, of_rows)


def average(
    texture: OctreeTexture,
    channel: Channel,
    added: Residuals | None = None,
    nodes: Nodes | None = None,
    limits: tuple[float, float] | None = None,
) -> None:
    """Recompute the values of nodes, by default all, and of their rows, in place.

    A value becomes the mean of its children plus the residual in ``added``; None means zeros. Keep a facing's
    row when no child has that facing. ``texture`` has the tree, and the alpha that weights. ``limits``
    default to `limits_of`.
    """
    tree, form, limits = texture.tree, channel.format, limits or limits_of(channel)
    nodes = all_nodes(tree) if nodes is None else nodes
    alpha = _alpha_for(texture, form.name)
    for of_level in reversed(by_level(tree, nodes)):
        means = child_means(tree, nodes.numbers[of_level], channel.values, form.space, alpha)
        values = means if added is None else with_residuals(limits, means, added.nodes[of_level])
        channel.values[nodes.cells[of_level]] = encode(values, form.dtype, form.space)
    average_rows(texture, channel, None if added is None else added.rows, nodes, limits)


def average_rows(
    texture: OctreeTexture,
    channel: Channel,
    added: Floats | None,
    nodes: Nodes,
    limits: tuple[float, float] | None = None,
) -> None:
    """Recompute the rows of nodes, in place, with residuals ``added`` (rows, components). See `average`."""
    form, limits = channel.format, limits or limits_of(channel)
    for of_level, rows, owners in reversed(list(rows_by_level(texture.tree, nodes))):
        means, has_mean = _row_means(texture, channel, rows, owners)
        values = means[has_mean]
        if added is not None:
            values = with_residuals(limits, values, added[of_level][has_mean])
        channel.split_values[rows.rows[has_mean]] = encode(values, form.dtype, form.space)


def average_plain(tree: Octree, numbers: Float32s, nodes: Nodes | None = None) -> None:
    """Set the numbers (cells,) of nodes, in place, to the means of their children's."""
    nodes = all_nodes(tree) if nodes is None else nodes
    for of_level in reversed(by_level(tree, nodes)):
        means = child_means(tree, nodes.numbers[of_level], numbers[:, None], "data", None)
        numbers[nodes.cells[of_level]] = means[:, 0]


def limits_of(channel: Channel) -> tuple[float, float]:
    """Return the limits of a channel's decoded values: of light at least 1 and the stored maximum."""
    form = channel.format
    if form.space == "data" and plain_name(form.name) in CHANNELS:
        return 0.0, 1.0
    low, high = _LIMITS[form.space]
    if form.space in ("srgb", "linear"):
        for stored in (channel.values, channel.split_values):
            if stored.dtype.kind == "f" and stored.size:
                high = max(high, float(decode(stored.max(keepdims=True), form.space).max()))
    return low, high


def with_residuals(limits: tuple[float, float], means: Float64s, added: Floats) -> Float64s:
    """Add residuals to decoded means (n, components); a mean within the limits stays within."""
    if not added.any():
        return means
    low, high = limits
    limited = np.clip(means + added, np.minimum(means, low), np.maximum(means, high))
    return np.asarray(limited, np.float64)


def child_means(
    tree: Octree, numbers: Int64s, values: Array, space: ColorSpace, alpha: Channel | None
) -> Float64s:
    """Return the decoded means of the children of nodes (n, components).

    ``numbers`` (n,) number the nodes of the tree. Stored ``values`` (cells, components) are weighted by area,
    and by ``alpha``.
    """
    means = np.zeros((numbers.size, values.shape[1]))
    firsts, counts = children_of(tree.arrays.groups, numbers)
    if alpha is None and (values.dtype.kind == "u" or _is_plain(values, space)):
        _means(firsts, counts, tree.arrays.areas, AREAS, NO_TABLE, *_as_codes(values, space), means)
        return means
    begin, end = int(firsts[0]), int(firsts[-1] + counts[-1])
    children: Int64s | slice = slice(begin, end)
    starts = firsts - begin
    if counts.sum() != end - begin:  # they are not consecutive
        starts = np.cumsum(counts) - counts
        children = in_runs(firsts, counts)
        children = np.clip(children, 0, tree.n_cells - 1)
    weights = NO_TABLE if alpha is None else coverage(alpha.values[children])
    areas = tree.arrays.areas[children], AREAS
    _means(starts, counts, *areas, weights, *_as_codes(values[children], space), means)
    return means


def weighted_means(starts: Int64s, weights: Float32s, stored: Array, space: ColorSpace) -> Float32s:
    """Return the decoded means of runs of stored values (m, components); zeros for a total weight of 0.

    Run n begins at ``starts`` (n + 1,); ``weights`` are (m,).
    """
    means = np.zeros((starts.size - 1, stored.shape[1]))
    equal_areas = np.zeros(weights.size, np.uint8), np.ones(1)
    _means(starts[:-1], np.diff(starts), *equal_areas, weights, *_as_codes(stored, space), means)
    return means.astype(np.float32)


def _as_codes(stored: Array, space: ColorSpace) -> tuple[Array, Float32s]:
    """Return stored values in a form that `_means` reads, and their decoding table."""
    if stored.dtype.kind == "u":
        return stored, code_table(stored.dtype, space)
    return stored if _is_plain(stored, space) else decode(stored, space), NO_TABLE


def _is_plain(stored: Array, space: ColorSpace) -> bool:
    """Return whether stored values need no decoding."""
    return stored.dtype == np.float32 and space != "srgb"


@kernel
def _means(
    starts: Int64s,
    counts: Int64s,
    areas: Uint8s,
    shares: Float64s,
    weights: Float32s,
    codes: ChannelValues,
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


def _row_means(
    texture: OctreeTexture, channel: Channel, rows: Rows, owners: Int64s
) -> tuple[Float64s, Bools]:
    """Return the means (n, components) of children's values by the rows' facings, and which rows have any."""
    tree = texture.tree
    children, bits, starts, shares = _row_shares(tree, tree.split.areas, rows, owners)
    alpha = _alpha_for(texture, channel.format.name)
    if alpha is not None:
        shares *= np.maximum(rows_facing(texture, alpha, children, bits)[:, 0], LEAST_COVERAGE)
    values = rows_facing(texture, channel, children, bits) * shares[:, None]
    totals = np.add.reduceat(shares, starts)
    sums = np.add.reduceat(values, starts, axis=0)
    return sums / np.where(totals > 0, totals, 1.0)[:, None], totals > 0


def _row_shares(
    tree: Octree, areas: Uint8s, rows: Rows, owners: Int64s
) -> tuple[Int64s, Uint8s, Int64s, Float64s]:
    """Return the children (n,) of rows' owners, the rows' facings, the start of each row's part, and areas.

    ``areas`` are those of all rows of the tree. A child without the facing weighs nothing.
    """
    children, starts = all_children(tree, owners)
    bits = np.repeat(rows.bits, np.diff(starts, append=children.size))
    flags = tree.arrays.flags[children]
    shares = AREAS[tree.arrays.areas[children]] / np.maximum(counts_of(flags), 1)
    has_row, split_rows = find_rows(tree.split, children, bits)
    shares[has_row] = AREAS[areas[split_rows]]
    shares[flags & bits == 0] = 0.0
    return children, bits, starts, shares


def with_summed_areas(tree: Octree, nodes: Nodes) -> Octree:
    """Return a tree in which the areas of nodes, and of their rows, are the sums of their children's.

    Keep a row's area when no child has its facing. A node whose leaves are all skirt is skirt, too.
    """
    areas, row_areas = tree.arrays.areas.copy(), tree.split.areas.copy()
    for of_level in reversed(by_level(tree, nodes)):
        children, starts = all_children(tree, nodes.numbers[of_level])
        sums = np.add.reduceat(AREAS[areas[children]], starts)
        has_surface = np.maximum.reduceat(areas[children], starts) != SKIRT
        areas[nodes.cells[of_level]] = np.where(has_surface, area_codes(sums / 4), SKIRT)
    tree = tree.with_cell_data(tree.arrays.flags, areas, tree.split, tree.kept)
    for _, rows, owners in reversed(list(rows_by_level(tree, nodes))):
        _, _, starts, shares = _row_shares(tree, row_areas, rows, owners)
        totals = np.add.reduceat(shares, starts)
        row_areas[rows.rows[totals > 0]] = area_codes(totals[totals > 0] / 4)
    return tree.with_cell_data(tree.arrays.flags, areas, tree.split._replace(areas=row_areas), tree.kept)
