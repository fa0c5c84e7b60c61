"""A new texture: the surface that no image sees is filled, and the first layer is laid over the fill."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple, get_args

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s, Uint8s
from octex.channels import ALPHA, ONE, ChannelFormat, decode, encode
from octex.conversion.levels import assemble, cell_levels
from octex.editing.averages import average
from octex.editing.draft import OpenTiles
from octex.editing.nodes import all_leaves, nodes_at
from octex.editing.refined import Below, refined_below, refined_rows, refined_values, with_rows
from octex.editing.runs import carried
from octex.editing.split import refaced, rows_facing
from octex.errors import ArgumentError
from octex.painting.blend import (
    Above,
    Merge,
    Raised,
    all_above,
    averaged,
    blend_rows,
    facings_of_paint,
    may_differ,
    no_parts,
    own_making,
    read,
    with_areas_above,
    with_split_cells,
    writable,
    write,
)
from octex.painting.image import Blend
from octex.painting.layer import (
    COVERAGE,
    Paint,
    blocks_meeting,
    empty_texture,
    leaves_by_level,
    paint_in,
    painted_channel,
)
from octex.painting.multigrid import added, graph_of, solve
from octex.painting.sheets import Sheets, sheets_of
from octex.painting.steps import cull_cells
from octex.painting.surface import Job
from octex.source.base import Source
from octex.source.overrides import FunctionSource
from octex.source.surface import Surface
from octex.texture import Channel, OctreeTexture
from octex.tree.edit import among, locate, rebuilt
from octex.tree.layout import FACING_FLAGS, SPLIT
from octex.tree.neighbours import with_boundary
from octex.tree.octree import Octree, distinct
from octex.tree.placement import on_grid
from octex.tree.split import rows_of
from octex.voxelize.fragments import divided, whole

#: Contents of a new texture where no image sees the surface: no cells, or smooth values.
Fill = Literal["leave", "smooth"]
FILLS: tuple[Fill, ...] = get_args(Fill)
#: The channel with the part of the surface that images cover.
COVERED = "coverage"
#: Least coverage of a known value.
_KNOWN = 0.5
#: Largest number of filled cells, about; beyond it cells are larger.
_MOST_CELLS = 1 << 21
#: Levels from the filled cells up to the blocks that are searched for uncovered surface.
_BLOCK = 3
#: Weight that ties unknown values to the mean of the known ones, which parts without any get.
_HOLD = 1e-9


@dataclass(eq=False)
class SheetValues(Source):
    """One value for each sheet of a surface; the last one for all other points."""

    form: ChannelFormat
    sheets: Sheets
    values: Float32s  # (sheets + 1, components)

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """The channel of the values."""
        return (self.form,)

    def evaluate(
        self,
        triangles: Int32s,
        barycentric: Float64s,
        widths: Float32s,  # noqa: ARG002
    ) -> Float32s:
        """Return the values of the sheets of points."""
        values: Float32s = self.values[self.sheets.at(triangles, barycentric)]
        return values


def _fill_below(job: Job, layer: OctreeTexture, fill: Fill | Float32s, *, is_hidden: bool) -> OctreeTexture:
    """Return the texture below the first layer; its cells are as large as most leaves of the layer.

    All have the value ``fill``, or are "smooth": values that the layer covers by half or more are known, the
    rest is harmonic, and a part without known values gets the mean. If the layer hides the fill
    (``is_hidden``), only the surroundings of uncovered surface have cells.
    """
    name, surface = painted_channel(layer), job.surface.surface
    form = layer.channels[name].format
    nothing = empty_texture([form], layer.placement, layer.bounds, surface)
    if (isinstance(fill, str) and fill == "leave") or not layer.tree.n_leaves:
        return nothing
    job.progress("fill", 0, 1)
    level, region = _uncovered(layer, surface)
    if isinstance(fill, str):
        if not region.codes.size:
            return nothing
        source: Source = _smooth(job, layer, level, region)
    else:
        source = FunctionSource(
            form, lambda points: np.tile(fill, (len(points), 1)), surface.rest, surface.triangles
        )
    levels = cell_levels(
        surface, source, (form,), layer.placement, level, job.executor, job.progress,
        has_samples=False, reached=partial(blocks_meeting, [region]) if is_hidden else None,
    )  # fmt: skip
    tree, channels, *_ = assemble(levels)
    job.progress("fill", 1, 1)
    return nothing.with_cells(tree, channels)


def _smooth(job: Job, layer: OctreeTexture, level: int, region: OpenTiles) -> SheetValues:
    """Return the smooth values of the surface in cells of a level, within a region."""
    name = painted_channel(layer)
    form = layer.channels[name].format
    sheets = sheets_of(job.surface.surface, layer.placement, level, job.executor, region)
    where = locate(layer.tree, sheets.codes, level)
    values = rows_facing(layer, layer.channels[name], where.cells, sheets.bits).astype(np.float64)
    coverage = rows_facing(layer, layer.channels[ALPHA.name], where.cells, sheets.bits)[:, 0]
    is_there = where.is_leaf | (where.levels == level)
    coverage[~is_there | (layer.tree.arrays.flags[where.cells] & sheets.bits == 0)] = 0.0
    mean = decode(layer.channels[name].values[0], form.space).astype(np.float64)
    values = np.concatenate([filled(sheets, values, coverage >= _KNOWN, mean), mean[None]])
    return SheetValues(form, sheets, values.astype(np.float32))


def _uncovered(layer: OctreeTexture, surface: Surface) -> tuple[int, OpenTiles]:
    """Return the level of most of a layer's leaves, or a coarser one with few cells, and the open blocks."""
    level = int(np.argmax([leaves.size * 4.0**-level for level, leaves, _ in leaves_by_level(layer.tree)]))
    blocks = _open_blocks(layer, surface, max(level - _BLOCK, 0))
    excess = blocks.codes.size * 4**_BLOCK / _MOST_CELLS
    if excess > 1:
        level = max(level - int(np.ceil(np.log(excess) / np.log(4))), 0)
        blocks = _open_blocks(layer, surface, max(level - _BLOCK, 0))
    return level, blocks


def _open_blocks(layer: OctreeTexture, surface: Surface, above: int) -> OpenTiles:
    """Return the cells of a level with surface that a layer leaves uncovered, and their neighbours."""
    blocks = divided(whole(on_grid(surface.rest, layer.placement), surface.triangles, above), 0)
    is_open = _shows_through(layer)
    where = locate(layer.tree, blocks.codes, above)
    is_missing = ~where.is_leaf & (where.levels < above)
    codes = [blocks.codes[is_missing | is_open[where.cells]]]
    firsts = layer.tree.arrays.level_cells
    for level, (level_codes, _) in enumerate(layer.tree.walk()):
        if level > above:
            codes.append(level_codes[is_open[firsts[level] : firsts[level + 1]]] >> 3 * (level - above))
    return OpenTiles(above, with_boundary(distinct(np.concatenate(codes)), above))


def _shows_through(layer: OctreeTexture) -> Bools:
    """Return which cells (cells,) of a layer show the fill below them."""
    alpha = layer.channels[ALPHA.name]
    full = ONE[alpha.format.dtype]
    shows: Bools = alpha.values[:, 0] < full
    shows[rows_of(layer.tree.split).cells[alpha.split_values[:, 0] < full]] = True
    return shows


def filled(sheets: Sheets, values: Float64s, known: Bools, mean: Float64s) -> Float64s:
    """Return values (n, components) of sheets, harmonic where not ``known``, or the ``mean``."""
    free = np.flatnonzero(~known)
    numbers = np.full(known.size, -1, np.int64)
    numbers[free] = np.arange(free.size)
    first, second = sheets.pairs.T
    hold, right = np.full(free.size, _HOLD), np.tile(_HOLD * mean, (free.size, 1))
    for inner, outer in ((first, second), (second, first)):
        rim = ~known[inner] & known[outer]
        rows, ties = numbers[inner[rim]], sheets.ties[rim]
        hold += added(rows, ties, free.size)
        for component in range(values.shape[1]):
            right[:, component] += added(rows, ties * values[outer[rim], component], free.size)
    inside = ~known[first] & ~known[second]
    graph = graph_of(numbers[sheets.pairs[inside]], sheets.ties[inside], free.size)
    harmonic = values.copy()
    harmonic[free] = solve(graph, sheets.codes[free], sheets.level, hold, right)
    return harmonic


def with_coverage(texture: OctreeTexture, layers: Sequence[OctreeTexture]) -> OctreeTexture:
    """Return a texture with the channel ``coverage``: 1 − (1 − c)(1 − d) for layers that cover c and d."""
    tree = texture.tree
    form = COVERAGE._replace(name=COVERED)
    rows = rows_of(tree.split)
    of_leaves = all_leaves(tree)[rows.cells]
    if COVERED in texture.channels:
        old = texture.channels[COVERED]
        if old.format.components != 1 or old.format.space != "data":
            raise ArgumentError(f"the texture's channel {COVERED!r} is not a coverage channel")
        form, kept_values = old.format, old.kept_values
        clear, clear_rows = (1 - decode(each[:, 0], "data") for each in (old.values, old.split_values))
    else:
        kept_values = np.zeros((tree.kept.cells.size, 1), form.dtype)
        clear, clear_rows = np.ones(tree.n_cells, np.float32), np.ones(rows.rows.size, np.float32)
    for layer in layers:
        for level, leaves, codes in leaves_by_level(tree):
            sources, coverage = _coverage_at(layer, codes, level)
            clear[leaves] *= 1 - coverage
            chosen = np.flatnonzero(of_leaves & among(rows.cells, leaves))
            at = np.searchsorted(leaves, rows.cells[chosen])
            facing = rows_facing(layer, layer.channels[ALPHA.name], sources[at], rows.bits[chosen])[:, 0]
            has_paint = (layer.tree.arrays.flags[sources[at]] & rows.bits[chosen] != 0) & (coverage[at] > 0)
            clear_rows[chosen] *= 1 - np.where(has_paint, facing, np.float32(0))
    values, split_values = (encode(1 - each[:, None], form.dtype, form.space) for each in (clear, clear_rows))
    channel = Channel(form, values, split_values, kept_values)
    average(texture, channel)
    return texture.with_cells(tree, {**texture.channels, COVERED: channel})


def _coverage_at(layer: OctreeTexture, codes: Int64s, level: int) -> tuple[Int64s, Float32s]:
    """Return the layer's cells at or above cells (n,) of a level, and how much of these it covers."""
    where, alpha = locate(layer.tree, codes, level), layer.channels[ALPHA.name]
    coverage = decode(alpha.values[where.cells, 0], "data")
    finer = np.flatnonzero(where.levels < level)
    coverage[finer] = 0.0
    finer = finer[where.is_leaf[finer]]
    if finer.size:
        refined = refined_values(layer.tree, {ALPHA.name: alpha}, codes[finer], level)
        coverage[finer] = refined[ALPHA.name][:, 0]
    return where.cells, coverage


class MissingLeaves(NamedTuple):
    """Leaves of one level that the layer lacks."""

    codes: Int64s  # (n,)   Morton codes, ascending
    flags: Uint8s  # (n,)
    areas: Uint8s  # (n,)


def started(
    job: Job, layer: OctreeTexture, fill: Fill | Float32s, blend: Blend
) -> tuple[OctreeTexture, bool]:
    """Return a new texture for a layer, and whether it includes the layer.

    It does unless the layer erases or the ``fill`` is a value: else there is nothing to blend with. Without
    it the texture holds only the fill.
    """
    is_in = blend != "erase" and isinstance(fill, str) and layer.tree.n_leaves > 0
    texture = _fill_below(job, layer, fill, is_hidden=is_in)
    return (_laid_over(job, texture, layer) if is_in else texture), is_in


def _laid_over(job: Job, fill: OctreeTexture, layer: OctreeTexture) -> OctreeTexture:
    """Lay a layer over its fill, whose leaves have one level: the layer's leaves, and leaves that it lacks.

    No cell existed before, so there are no coefficients to keep and no skirts, as there are in `merge`.
    """
    name = painted_channel(layer)
    if not fill.tree.n_leaves:
        return fill.with_cells(layer.tree, {name: layer.channels[name]})
    task = Merge(job, fill, layer, name, "over", 1.0, 0)
    job.progress("merge", 0, 1)
    with own_making():
        lacking = _lacking(task)
        texture = _with_paint(task, *_united(task, lacking), _translucent(task), lacking)
    job.progress("merge", 1, 1)
    return texture


def _united(task: Merge, lacking: Sequence[MissingLeaves]) -> tuple[OctreeTexture, Bools]:
    """Return the filled texture with the layer's leaves and those that it lacks, and the layer's cells."""
    layer, name = task.layer, task.target
    leaves = [
        distinct(np.concatenate([codes, bare.codes]))
        for (_, _, codes), bare in zip(leaves_by_level(layer.tree), lacking, strict=True)
    ]
    edited = rebuilt(layer.tree, leaves)
    tree, channel = edited.tree, carried(layer, edited)[name]
    flags, areas, added = tree.arrays.flags.copy(), tree.arrays.areas.copy(), []
    for level, each in enumerate(lacking):
        cells, below = locate(tree, each.codes, level).cells, _fill_in(task, each.codes, level, each.flags)
        flags[cells], areas[cells] = each.flags, each.areas
        write(channel, "values", cells, below.values[name])
        added.append((cells, below))
    tree = tree.with_cell_data(flags, areas, tree.split, tree.kept)
    texture = refaced(with_rows(task.texture.with_cells(tree, {name: channel}), added))
    return with_areas_above(texture, [each.codes for each in lacking]), edited.old >= 0


def _with_paint(
    task: Merge,
    texture: OctreeTexture,
    is_painted: Bools,
    paint: Sequence[Paint],
    lacking: Sequence[MissingLeaves],
) -> OctreeTexture:
    """Blend paint with the fill below it, and average the nodes above both."""
    name, tree = task.target, texture.tree
    cells = [locate(tree, each.codes, level).cells for level, each in enumerate(paint)]
    below = [_fill_in(task, each.codes, level, each.flags) for level, each in enumerate(paint)]
    split = np.concatenate([at[each.is_split] for at, each in zip(cells, below, strict=True)])
    texture = with_split_cells(texture, split[tree.arrays.flags[split] & SPLIT == 0])
    changed = [
        distinct(np.concatenate([bare.codes, each.codes])) for bare, each in zip(lacking, paint, strict=True)
    ]
    codes = all_above(changed)
    nodes, none = nodes_at(tree, codes), np.empty(0, np.int64)
    absent = nodes._replace(numbers=np.full_like(nodes.numbers, -1))
    above = Above(nodes, absent, nodes_at(task.layer.tree, codes))
    base = with_split_cells(texture, may_differ(texture.tree, none, none.astype(np.uint8), above))
    channels, parts = writable(base, [name]), no_parts(base.tree, [name])
    parts[name].values[is_painted] = 1.0
    parts[name].split_values[is_painted[rows_of(base.tree.split).cells]] = 1.0
    nowhere = np.zeros(tree.n_cells, np.bool_)
    for level, (at, each, fill) in enumerate(zip(cells, paint, below, strict=True)):
        blend = partial(blend_rows, task, channels, parts)
        blend("values", at, fill.values, each.values, each.coverage, nowhere[at])
        rows = rows_of(base.tree.split, at)
        owners = each.of(np.searchsorted(at, rows.cells))
        facings = facings_of_paint(task, owners, rows.bits)
        old = {name: _fill_facing(task, owners.codes, level, rows.bits)}
        blend("split_values", rows.rows, old, *facings, nowhere[rows.cells])
    raised = Raised(texture, np.where(is_painted, 0, -1), ~nowhere, nowhere, [])
    return averaged(task, task.texture, raised, base, channels, parts, above, changed).texture


def _lacking(task: Merge) -> list[MissingLeaves]:
    """Return the leaves that a layer lacks, by level: the fill's, or surface in them next to finer paint."""
    fill, layer, level = task.texture.tree, task.layer.tree, task.texture.tree.max_depth
    none = MissingLeaves(np.empty(0, np.int64), *np.empty((2, 0), np.uint8))
    lacking = [none] * (layer.max_depth + 1)
    codes = fill.level_codes(level)
    where = locate(layer, codes, level)
    is_open = ~where.is_leaf & (where.levels == level)
    cells = np.flatnonzero(~where.is_leaf & (where.levels < level))
    lacking[level] = _leaves_at(fill, level, cells)
    opened = codes[is_open]
    met = cull_cells(task, [(level, opened)], layer.max_depth)
    walk = list(layer.walk())
    for deeper in range(level + 1, layer.max_depth + 1):
        nodes = walk[deeper - 1][0][walk[deeper - 1][1]]
        nodes = nodes[among(nodes >> 3 * (deeper - 1 - level), opened)]
        codes = met.codes[deeper]
        lacks = among(codes >> 3, nodes) & ~among(codes, walk[deeper][0])
        lacking[deeper] = _leaves_at(met.tree, deeper, np.flatnonzero(lacks))
    return lacking


def _leaves_at(tree: Octree, level: int, chosen: Int64s) -> MissingLeaves:
    """Return chosen cells of a level as leaves."""
    cells = chosen + int(tree.arrays.level_cells[level])
    flags = tree.arrays.flags[cells] & np.uint8(FACING_FLAGS)
    return MissingLeaves(tree.level_codes(level)[chosen], flags, tree.arrays.areas[cells])


def _translucent(task: Merge) -> list[Paint]:
    """Return the paint, by level, on leaves that show the fill."""
    layer, shows, paint = task.layer, _shows_through(task.layer), []
    for level, cells, codes in leaves_by_level(layer.tree):
        cells, codes = cells[shows[cells]], codes[shows[cells]]
        where = locate(task.texture.tree, codes, level)
        is_filled = (where.levels == level) | where.is_leaf
        cells = cells[is_filled]
        paint.append(paint_in(layer, cells, codes[is_filled], layer.tree.arrays.flags[cells]))
    return paint


def _fill_in(task: Merge, codes: Int64s, level: int, facings: Uint8s) -> Below:
    """Return the fill's values in cells (n,) of a level with these facings."""
    fill, name = task.texture, task.target
    if level > fill.tree.max_depth:
        return refined_below(fill, codes, level, facings & np.uint8(FACING_FLAGS), task.job.executor)
    cells, stored = locate(fill.tree, codes, level).cells, fill.channels[name]
    return Below(
        {name: read(stored, "values", cells)},
        fill.tree.arrays.flags[cells] & SPLIT != 0,
        {name: read(stored, "split_values", rows_of(fill.tree.split, cells).rows)},
    )


def _fill_facing(task: Merge, codes: Int64s, level: int, bits: Uint8s) -> Float32s:
    """Return the fill's values for facings (n,) of cells (n,) of a level."""
    fill, name = task.texture, task.target
    if level > fill.tree.max_depth:
        return refined_rows(fill, codes, level, bits)[name]
    return rows_facing(fill, fill.channels[name], locate(fill.tree, codes, level).cells, bits)
