"""The first layer of a new texture: its leaves become the texture's, over the fill and beside it.

Nothing has to stay as it was, so there are no coefficients to keep and no skirts around the paint, as in
`merge`. What the layer lacks of the surface becomes leaves with the values that the fill refines to.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Int64s, Uint8s
from octex.channels import ALPHA, ONE, decode, encode
from octex.editing.averages import with_summed_areas
from octex.editing.nodes import nodes_at
from octex.editing.refined import Below, refined_below, refined_rows, with_rows
from octex.editing.runs import carried
from octex.editing.split import refaced, rows_facing
from octex.errors import own_making
from octex.painting.blend import (
    Above,
    Blended,
    Merge,
    Raised,
    averaged,
    blended,
    facings_of_paint,
    may_differ,
    no_parts,
    with_split_cells,
    writable,
)
from octex.painting.cells import Paint, painted_channel, some
from octex.painting.holes import begun
from octex.painting.layer import COVERAGE
from octex.painting.options import Holes
from octex.painting.picture import Blend
from octex.painting.steps import cull_cells
from octex.painting.surface import PaintedSurface
from octex.parallel import Progress
from octex.texture import Channel, OctreeTexture
from octex.tree.edit import among, locate, rebuilt, with_all_above
from octex.tree.layout import FACING_FLAGS, SPLIT
from octex.tree.octree import Octree, distinct
from octex.tree.split import rows_of

#: Coverage that hides the fill wholly.
_FULL = ONE[COVERAGE.dtype]


class Leaves(NamedTuple):
    """Leaves of one level that a layer lacks."""

    codes: Int64s  # (n,)   Morton codes, ascending
    flags: Uint8s  # (n,)
    areas: Uint8s  # (n,)


def started(
    layer: OctreeTexture,
    surface: PaintedSurface,
    holes: Holes,
    opacity: float,
    blend: Blend,
    executor: Executor,
    progress: Progress,
) -> tuple[OctreeTexture, bool]:
    """Return a new texture for a layer, and whether the layer is in it, or is still to be merged into it.

    A layer is in it if its paint lies opaque on what there is: nothing, or the fill of ``holes``.
    """
    is_in = opacity == 1.0 and blend == "over" and layer.tree.n_leaves > 0
    fill = begun(layer, surface.surface, holes, executor, progress, is_hidden=is_in)
    return (_laid_over(fill, layer, surface, executor, progress) if is_in else fill), is_in


def _laid_over(
    fill: OctreeTexture, layer: OctreeTexture, surface: PaintedSurface, executor: Executor, progress: Progress
) -> OctreeTexture:
    """Return a texture of a layer's leaves, with its ``fill`` beneath them and where it has none.

    The fill's leaves are of one level, wherever the layer does not hide them; or it has none.
    """
    name = painted_channel(layer)
    if not fill.tree.n_leaves:
        return fill.with_cells(layer.tree, {name: layer.channels[name]})
    task = Merge(fill, layer, surface, name, "over", 1.0, executor, progress, 0)
    progress("merge", 0, 1)
    with own_making():
        lacking, paint = _lacking(task), _showing(task)
        made = _with_paint(task, *_united(task, lacking), paint, lacking)
    progress("merge", 1, 1)
    return made


def _united(task: Merge, lacking: Sequence[Leaves]) -> tuple[OctreeTexture, Bools]:
    """Return a texture of a layer's leaves and those that it lacks; and say which cells the layer has."""
    layer, name = task.layer, task.target
    leaves = [codes[~is_node] for codes, is_node in layer.tree.walk()]
    every = [distinct(np.concatenate([own, more.codes])) for own, more in zip(leaves, lacking, strict=True)]
    del leaves
    edited = rebuilt(layer.tree, every)
    tree, channel = edited.tree, carried(layer, edited)[name]
    flags, areas, added = tree.arrays.flags.copy(), tree.arrays.areas.copy(), []
    for level, own in enumerate(lacking):
        cells, below = locate(tree, own.codes, level).cells, _filled(task, own.codes, level, own.flags)
        flags[cells], areas[cells] = own.flags, own.areas
        channel.values[cells] = encode(below.values[name], channel.format.dtype, channel.format.space)
        added.append((cells, below))
    tree = tree.with_cell_data(flags, areas, tree.split, tree.kept)
    texture = refaced(with_rows(task.texture.with_cells(tree, {name: channel}), added))
    above = with_all_above([own.codes for own in lacking])[1:]
    tree = with_summed_areas(texture.tree, nodes_at(tree, [distinct(codes >> 3) for codes in above]))
    return texture.with_cells(tree, texture.channels), edited.old >= 0


def _with_paint(
    task: Merge, texture: OctreeTexture, is_own: Bools, paint: Sequence[Paint], lacking: Sequence[Leaves]
) -> OctreeTexture:
    """Return the texture with paint blended with the fill beneath it, and averages made anew above both."""
    name, tree = task.target, texture.tree
    cells = [locate(tree, each.codes, level).cells for level, each in enumerate(paint)]
    beneath = [_filled(task, each.codes, level, each.flags) for level, each in enumerate(paint)]
    apart = np.concatenate([own[each.is_split] for own, each in zip(cells, beneath, strict=True)])
    texture = with_split_cells(texture, apart[tree.arrays.flags[apart] & SPLIT == 0])
    changed = [
        distinct(np.concatenate([own.codes, each.codes])) for own, each in zip(lacking, paint, strict=True)
    ]
    codes = [distinct(own >> 3) for own in with_all_above(changed)[1:]]
    nodes, none = nodes_at(tree, codes), np.empty(0, np.int64)
    absent = nodes._replace(numbers=np.full_like(nodes.numbers, -1))
    above = Above(nodes, absent, nodes_at(task.layer.tree, codes))
    may_split = may_differ(texture.tree, none, none.astype(np.uint8), above)
    base = with_split_cells(texture, may_split)
    channels, parts = writable(base, [name]), no_parts(base.tree, [name])
    parts[name].values[is_own] = 1.0
    parts[name].split_values[is_own[rows_of(base.tree.split).cells]] = 1.0
    for level, (own, each, below) in enumerate(zip(cells, paint, beneath, strict=True)):
        _put_paint(task, base.tree, level, own, each, below, channels[name], parts[name])
    is_fresh = np.ones(tree.n_cells, np.bool_)
    raised = Raised(texture, np.where(is_own, 0, -1), is_fresh, ~is_fresh, [])
    return averaged(
        task, task.texture, raised, Blended(base, channels, parts, above, may_split), changed
    ).texture


def _lacking(task: Merge) -> list[Leaves]:
    """Return the leaves that a layer lacks, by level: the fill's, and what finer paint leaves of them."""
    fill, layer, level = task.texture.tree, task.layer.tree, task.texture.tree.max_depth
    none = Leaves(np.empty(0, np.int64), *np.empty((2, 0), np.uint8))
    found = [none] * (layer.max_depth + 1)
    codes = fill.level_codes(level)
    where = locate(layer, codes, level)
    is_open = ~where.is_leaf & (where.levels == level)
    cells = np.flatnonzero(~where.is_leaf & (where.levels < level))
    found[level] = _leaves_at(fill, level, cells)
    opened = codes[is_open]
    met = cull_cells(task, [(level, opened)], layer.max_depth)
    walk = list(layer.walk())
    for deeper in range(level + 1, layer.max_depth + 1):
        nodes = walk[deeper - 1][0][walk[deeper - 1][1]]
        nodes = nodes[among(nodes >> 3 * (deeper - 1 - level), opened)]
        codes = met.codes[deeper]
        lacks = among(codes >> 3, nodes) & ~among(codes, walk[deeper][0])
        found[deeper] = _leaves_at(met.tree, deeper, np.flatnonzero(lacks))
    return found


def _leaves_at(tree: Octree, level: int, chosen: Int64s) -> Leaves:
    """Return some cells of a level of a tree as leaves."""
    cells = chosen + int(tree.arrays.level_cells[level])
    flags = tree.arrays.flags[cells] & np.uint8(FACING_FLAGS)
    return Leaves(tree.level_codes(level)[chosen], flags, tree.arrays.areas[cells])


def _showing(task: Merge) -> list[Paint]:
    """Return the paint, by level, on leaves that show some of the fill."""
    layer, name = task.layer, task.target
    alpha, rows = layer.channels[ALPHA.name], rows_of(layer.tree.split)
    shows = alpha.values[:, 0] < _FULL
    shows[rows.cells[alpha.split_values[:, 0] < _FULL]] = True
    found = []
    for level, (codes, is_node) in enumerate(layer.tree.walk()):
        first = int(layer.tree.arrays.level_cells[level])
        own = np.flatnonzero(~is_node & shows[first : first + codes.size])
        where = locate(task.texture.tree, codes[own], level)
        own = own[(where.levels == level) | where.is_leaf]
        cells = own + first
        values = decode(layer.channels[name].values[cells], layer.channels[name].format.space)
        coverage = decode(alpha.values[cells, 0], "data")
        found.append(Paint(codes[own], values, coverage, cells, layer.tree.arrays.flags[cells]))
    return found


def _filled(task: Merge, codes: Int64s, level: int, facings: Uint8s) -> Below:
    """Return what the fill has in cells (n,) of a level of such facings."""
    fill, name = task.texture, task.target
    if level > fill.tree.max_depth:
        return refined_below(fill, codes, level, facings & np.uint8(FACING_FLAGS), task.executor)
    cells, form = locate(fill.tree, codes, level).cells, fill.channels[name].format
    rows = rows_of(fill.tree.split, cells).rows
    is_split = fill.tree.arrays.flags[cells] & SPLIT != 0
    stored = fill.channels[name]
    return Below(
        {name: decode(stored.values[cells], form.space)},
        is_split,
        {name: decode(stored.split_values[rows], form.space)},
    )


def _put_paint(
    task: Merge,
    tree: Octree,
    level: int,
    cells: Int64s,
    paint: Paint,
    below: Below,
    channel: Channel,
    part: Channel,
) -> None:
    """Blend paint on cells of a level with the fill ``below`` it, and say how much is paint, in place."""
    fill, name, form = task.texture, task.target, channel.format
    new = blended(below.values[name], paint.values, paint.coverage, "over")
    channel.values[cells] = encode(new, form.dtype, form.space)
    part.values[cells, 0] = paint.coverage
    rows = rows_of(tree.split, cells)
    own = some(paint, np.searchsorted(cells, rows.cells))
    values, coverage = facings_of_paint(task.layer, own, rows.bits, 1.0)
    if level > fill.tree.max_depth:
        old = refined_rows(fill, own.codes, level, rows.bits)[name]
    else:
        old = rows_facing(fill, fill.channels[name], locate(fill.tree, own.codes, level).cells, rows.bits)
    new = blended(old, values, coverage, "over")
    channel.split_values[rows.rows] = encode(new, form.dtype, form.space)
    part.split_values[rows.rows, 0] = coverage
