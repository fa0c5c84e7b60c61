"""Textures of another depth, and of a part of space."""

from __future__ import annotations

from concurrent.futures import Executor

import numpy as np
import numpy.typing as npt

from octex.channels import ALPHA, encode
from octex.checks import as_depth, as_reals
from octex.editing.averages import (
    Nodes,
    add_up_areas,
    all_nodes,
    alpha_beside,
    average,
    levels_of,
    node_cells,
    residuals,
)
from octex.editing.facings import add_up_rows, average_rows, row_residuals, rows_of
from octex.errors import ArgumentError
from octex.painting.raising import split_below
from octex.parallel import workers
from octex.processing.edit import noted
from octex.processing.refine import refined
from octex.texture import Channel, OctreeTexture, as_texture
from octex.texture.split import find_rows, refaced
from octex.tree.edit import children_of, cull, raised
from octex.tree.layout import AREA_STEPS, FACING_FLAGS, MAX_CELLS
from octex.tree.morton import decode_cells

Int64s = npt.NDArray[np.int64]


def resize(
    texture: OctreeTexture, depth: int, *, threads: int | None = None, executor: Executor | None = None
) -> OctreeTexture:
    """Return a texture of another depth.

    Below ``depth`` it is ``texture.level(depth)``: leaves there become the averages stored above them. Every
    leaf above ``depth``, of an adaptive texture too, is divided into the 8^k cells of
    ``depth`` that fill it, wherever the surface is in it, for nothing says where; their values are what the
    field refines to, and their nodes keep the leaves' coefficients, so that the field stays as it was but for
    rounding (paper 4.2). So does the field looked up with normals where all of the surface faces about one
    way. Rows for the six facings cannot hold what it is for every normal: on either side of a thin sheet it
    moves by up to 0.03 of the range, within a leaf of creases by up to 0.25. Levels down to the old leaves
    stay as they were; areas of leaves are shared out evenly. To be painted on, a texture needs no larger
    depth ahead: ``octex.paint`` raises it where paint is finer.

    Who works in parallel: ``threads``, so many, by default all processors for large batches and the calling
    thread alone for small ones; or the workers of ``executor``, any concurrent.futures.Executor. The result
    is the same.

    Raises ArgumentError for a depth that is not 0 … 21, and for one with more cells than can be numbered.
    """
    as_texture(texture)
    depth = as_depth(depth)
    metadata = noted(texture.metadata, "resize", depth=depth)
    if any(leaves for leaves, _ in texture.tree.cells_by_depth()[:depth]):
        with workers(threads, executor) as pool:
            texture = _divided(texture, depth, pool)
    texture = texture.level(depth)
    return OctreeTexture(texture.tree, texture.channels, texture.placement, texture.bounds, metadata)


def _divided(texture: OctreeTexture, depth: int, executor: Executor) -> OctreeTexture:
    """Divide all leaves above a level down to it."""
    tree = texture.tree
    counts = [leaves for leaves, _ in tree.cells_by_depth()[:depth]]
    n_new = sum(count * (8 ** (depth + 1 - level) // 7) for level, count in enumerate(counts))
    if tree.n_cells + n_new > MAX_CELLS:
        raise ArgumentError(f"depth {depth} takes {n_new:,} more cells, more than a tree can number")
    met: list[Int64s] = [np.empty(0, np.int64)]
    for codes, is_node in tree.walk():
        above = np.sort(np.concatenate([met[-1], codes[~is_node]]))
        if len(met) > depth:
            break
        met.append((above[:, None] << 3 | np.arange(8)).reshape(-1))
    while len(met) <= depth:
        met.append((met[-1][:, None] << 3 | np.arange(8)).reshape(-1))
    edited = raised(tree, [*[met[0]] * depth, met[depth]], met, [])
    tree = edited.tree
    flags, areas = tree.arrays.flags.copy(), tree.arrays.areas.copy()
    arrays = {
        name: [edited.carried(each.values), each.split_values[edited.split_rows]]
        for name, each in texture.channels.items()
    }
    for level, codes in enumerate(met):
        if not codes.size:
            continue
        first = int(tree.arrays.level_cells[level])
        cells = np.flatnonzero(edited.old[first : tree.arrays.level_cells[level + 1]] < 0) + first
        below = refined(texture, codes, level, executor)
        flags[cells] |= texture.tree.arrays.flags[below.leaves] & np.uint8(FACING_FLAGS)
        area = texture.tree.arrays.areas[below.leaves].astype(np.int64)
        shared = np.clip(area - AREA_STEPS * (level - below.levels), 1, 255)
        areas[cells] = np.where(area > 0, shared, 0)
        for name, each in texture.channels.items():
            arrays[name][0][cells] = encode(below.values[name], each.format.dtype, each.format.space)
    old_kept = edited.old[tree.kept.cells]
    was_kept = np.isin(old_kept, texture.tree.kept.cells)
    channels = {}
    for name, each in texture.channels.items():
        values, split_values = arrays[name]
        kept_values = np.ascontiguousarray(values[tree.kept.cells])
        kept_values[was_kept] = each.kept_values[edited.kept_rows]
        channels[name] = Channel(each.format, values, split_values, kept_values)
    tree = tree.with_cell_data(flags, areas, tree.split, tree.kept)
    made = OctreeTexture(tree, channels, texture.placement, texture.bounds, texture.metadata)
    return split_below(made, texture, edited.old)


def crop(texture: OctreeTexture, low: npt.ArrayLike, high: npt.ArrayLike) -> OctreeTexture:
    """Return the part of a texture whose leaves meet the box from ``low`` to ``high``, in rest positions.

    The root cell stays where it is, so that rest positions stay valid; bounds become those of the part.
    Leaves and coefficients are as they were. Nodes that have lost cells are averaged, and their areas summed,
    over those that are left; they keep their residuals.

    Raises ArgumentError for corners that are not finite or out of order, and for a box that no leaf meets.
    """
    as_texture(texture)
    corners = np.array([as_reals(low, "low", (3,)), as_reals(high, "high", (3,))])
    if not np.isfinite(corners).all() or (corners[0] > corners[1]).any():
        raise ArgumentError(f"a box needs a finite lowest and highest corner, not {corners.tolist()}")
    tree = texture.tree
    box = texture.placement.to_texture_space(corners)
    meets = [np.zeros(0, np.bool_)]
    for level, (codes, is_node) in enumerate(tree.walk()):
        cells = decode_cells(codes)
        scaled = box * 2.0**level
        meets.append(is_node | ((cells <= scaled[1]) & (cells + 1 > scaled[0])).all(axis=1))
    is_kept = np.concatenate(meets)
    edited = cull(tree, is_kept)
    if not edited.tree.n_leaves:
        raise ArgumentError(
            f"no leaf of the texture meets the box from {corners[0].tolist()} to {corners[1].tolist()}; its "
            f"surface is from {texture.bounds[0].tolist()} to {texture.bounds[1].tolist()}"
        )
    low, high = np.maximum(corners[0], texture.bounds[0]), np.minimum(corners[1], texture.bounds[1])
    bounds = np.array([np.minimum(low, high), np.maximum(low, high)])
    metadata = noted(texture.metadata, "crop", box=corners.tolist())
    areas = edited.tree.arrays.areas.copy()
    nodes = all_nodes(edited.tree)
    old = Nodes(np.searchsorted(node_cells(tree), edited.old[nodes.cells]), edited.old[nodes.cells])
    firsts, counts = children_of(edited.tree, nodes.numbers)
    is_cut = counts < children_of(tree, old.numbers)[1]
    below_cut = np.zeros(edited.tree.n_cells, np.bool_)
    below_cut[firsts[is_cut]] = True
    add_up_areas(edited.tree, below_cut, areas)
    parents = np.repeat(nodes.numbers, counts)[nodes.cells[1:] - 1]  # of all nodes but the root
    for here in reversed(levels_of(edited.tree, nodes)[1:]):
        is_cut[parents[here.start - 1 : here.stop - 1][is_cut[here]]] = True
    nodes, old = nodes.of(is_cut), old.of(is_cut)
    cut = edited.tree.with_cell_data(edited.tree.arrays.flags, areas, edited.tree.split, edited.tree.kept)
    channels = {
        name: Channel(
            each.format,
            edited.carried(each.values),
            each.split_values[edited.split_rows],
            each.kept_values[edited.kept_rows],
        )
        for name, each in texture.channels.items()
    }
    made = refaced(OctreeTexture(cut, channels, texture.placement, bounds, metadata))
    for name, each in made.channels.items():
        channels[name] = channels[name]._replace(split_values=each.split_values.copy())
    areas = made.tree.split.areas.copy()
    add_up_rows(made.tree, areas, nodes)
    split = made.tree.split._replace(areas=areas)
    whole = made.tree.with_cell_data(made.tree.arrays.flags, made.tree.arrays.areas, split, made.tree.kept)
    made = OctreeTexture(whole, channels, texture.placement, bounds, metadata)
    rows, cells, bits = rows_of(made.tree)
    there, old_rows = find_rows(tree.split, edited.old[cells], bits)
    for name in sorted(channels, key=lambda name: name != ALPHA.name):
        before, after = texture.channels[name], channels[name]
        left = residuals(tree, before, alpha_beside(texture.channels, name), nodes=old)
        average(made.tree, after, alpha_beside(made.channels, name), left, nodes)
        left = np.zeros((rows.size, before.format.components))
        left[there] = row_residuals(texture, before, nodes=old)[old_rows]
        average_rows(made, after, left, nodes)
    return made
