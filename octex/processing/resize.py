"""Textures of another depth, and crops."""

from __future__ import annotations

from concurrent.futures import Executor

import numpy as np
import numpy.typing as npt

from octex.arrays import Bools, Int64s
from octex.channels import ALPHA, encode
from octex.checks import as_depth, as_reals
from octex.editing.averages import average, residuals_at, with_summed_areas
from octex.editing.nodes import nodes_at
from octex.editing.refined import Below, refined_below, with_rows
from octex.editing.runs import carried
from octex.editing.split import refaced
from octex.errors import ArgumentError
from octex.parallel import Run, as_run, workers
from octex.processing.edit import with_operation
from octex.texture import OctreeTexture, as_texture
from octex.tree.edit import cull, locate, raised, with_all_above
from octex.tree.layout import FACING_FLAGS, MAX_CELLS
from octex.tree.morton import decode_cells
from octex.tree.split import rows_of, shared_codes


def resize(
    texture: OctreeTexture, depth: int, *, threads: int | None = None, run: Run | None = None
) -> OctreeTexture:
    """Return a texture of another depth.

    Coarser: ``texture.level(depth)``; leaves become the averages of the cells below them. Deeper: every leaf
    above ``depth`` is divided into all its cells of that depth, with values from the field, and becomes a
    kept node (paper 4.2). So the field does not move, except for rounding. Areas are divided evenly. Painting
    needs no deeper texture: ``octex.paint`` divides cells where paint is finer.

    A lookup with normals does not move where the surface in a cell has one facing. Otherwise it moves by up
    to 0.03 of the range on a thin sheet, and by up to 0.25 inside a leaf at a crease.

    ``run`` says how to work (octex.Run). Raises ArgumentError for a depth outside of 0 … 21, and for one that
    needs too many cells.
    """
    as_texture(texture)
    depth, run = as_depth(depth), as_run(run, threads)
    metadata = with_operation(texture.metadata, "resize", depth=depth)
    if any(leaves for leaves, _ in texture.tree.cells_by_depth()[:depth]):
        with workers(run) as pool:
            texture = _divided(texture, depth, pool)
    texture = texture.level(depth)
    return texture.with_cells(texture.tree, texture.channels, metadata)


def _divided(texture: OctreeTexture, depth: int, executor: Executor) -> OctreeTexture:
    tree = texture.tree
    counts = [leaves for leaves, _ in tree.cells_by_depth()[:depth]]
    n_new = sum(count * (8 ** (depth + 1 - level) // 7) for level, count in enumerate(counts))
    if tree.n_cells + n_new > MAX_CELLS:
        raise ArgumentError(f"depth {depth} takes {n_new:,} more cells, more than a tree can hold")
    leaves = [codes[~is_node] for codes, is_node in tree.walk()]
    divided_codes: list[Int64s] = [np.empty(0, np.int64)]
    for level in range(depth):
        above = np.sort(np.concatenate([divided_codes[level], *leaves[level : level + 1]]))
        divided_codes.append((above[:, None] << 3 | np.arange(8)).reshape(-1))
    edited = raised(tree, [*[divided_codes[0]] * depth, divided_codes[depth]], divided_codes, [])
    tree = edited.tree
    flags, areas = tree.arrays.flags.copy(), tree.arrays.areas.copy()
    values = {name: edited.carried(channel.values) for name, channel in texture.channels.items()}
    rows: list[tuple[Int64s, Below]] = []
    for level, codes in enumerate(divided_codes):
        if not codes.size:
            continue
        first = int(tree.arrays.level_cells[level])
        cells = np.flatnonzero(edited.old[first : tree.arrays.level_cells[level + 1]] < 0) + first
        where = locate(texture.tree, codes, level)
        flags[cells] |= texture.tree.arrays.flags[where.cells] & np.uint8(FACING_FLAGS)
        areas[cells] = shared_codes(texture.tree.arrays.areas[where.cells], 2.0 ** (level - where.levels))
        below = refined_below(texture, codes, level, flags[cells] & np.uint8(FACING_FLAGS), executor)
        rows.append((cells, below))
        for name, channel in texture.channels.items():
            values[name][cells] = encode(below.values[name], channel.format.dtype, channel.format.space)
    channels = carried(texture, edited, values)
    tree = tree.with_cell_data(flags, areas, tree.split, tree.kept)
    return with_rows(texture.with_cells(tree, channels), rows)


def crop(texture: OctreeTexture, low: npt.ArrayLike, high: npt.ArrayLike) -> OctreeTexture:
    """Return the part of a texture whose leaves meet the box from ``low`` to ``high``, in rest positions.

    The root cell does not change, so rest positions stay valid; the bounds shrink. Leaves keep their values.
    Nodes that lose cells are averaged again over the remaining ones.

    Raises ArgumentError for corners that are not finite or out of order, and for a box that no leaf meets.
    """
    as_texture(texture)
    corners = np.array([as_reals(low, "low", (3,)), as_reals(high, "high", (3,))])
    if not np.isfinite(corners).all() or (corners[0] > corners[1]).any():
        raise ArgumentError(f"a box needs a finite lowest and highest corner, not {corners.tolist()}")
    box = texture.placement.to_texture_space(corners)
    meets = [np.zeros(0, np.bool_)]
    for level, (codes, _) in enumerate(texture.tree.walk()):
        cells = decode_cells(codes)
        scaled = box * 2.0**level
        meets.append(((cells <= scaled[1]) & (cells + 1 > scaled[0])).all(axis=1))
    cropped = with_leaves(texture, np.concatenate(meets))
    if not cropped.tree.n_leaves:
        raise ArgumentError(
            f"no leaf of the texture meets the box from {corners[0].tolist()} to {corners[1].tolist()}; its "
            f"surface is from {texture.bounds[0].tolist()} to {texture.bounds[1].tolist()}"
        )
    low, high = np.maximum(corners[0], texture.bounds[0]), np.minimum(corners[1], texture.bounds[1])
    bounds = np.array([np.minimum(low, high), np.maximum(low, high)])
    metadata = with_operation(texture.metadata, "crop", box=corners.tolist())
    return OctreeTexture(cropped.tree, cropped.channels, texture.placement, bounds, metadata)


def with_leaves(texture: OctreeTexture, is_kept: Bools) -> OctreeTexture:
    """Return a texture with some of its leaves; ``is_kept`` (cells,) counts for leaves only.

    Nodes that lose cells are averaged again over the remaining ones.
    """
    tree, first = texture.tree, texture.tree.arrays.level_cells
    lost = [
        codes[~is_node & ~is_kept[first[level] : first[level + 1]]]
        for level, (codes, is_node) in enumerate(tree.walk())
    ]
    edited = cull(tree, is_kept)
    carried_channels = carried(texture, edited)
    culled = refaced(texture.with_cells(edited.tree, carried_channels))
    above = with_all_above([codes >> 3 for codes in lost[1:]])
    nodes = nodes_at(culled.tree, above)
    remains = nodes.numbers >= 0
    nodes, old_nodes = nodes.of(remains), nodes_at(tree, above).of(remains)
    channels = {
        name: each._replace(values=carried_channels[name].values, split_values=each.split_values.copy())
        for name, each in culled.channels.items()
    }
    culled = culled.with_cells(with_summed_areas(culled.tree, nodes), channels)
    rows = rows_of(culled.tree.split, nodes.cells)
    owners = np.searchsorted(nodes.cells, rows.cells)
    for name in sorted(channels, key=lambda name: name != ALPHA.name):
        average(culled, channels[name], residuals_at(texture, name, old_nodes, owners, rows.bits), nodes)
    return culled
