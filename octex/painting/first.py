"""A new texture: the surface that no picture sees is filled, and the first layer is laid over the fill."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s
from octex.channels import ALPHA, ChannelFormat, decode, encode
from octex.conversion.levels import assemble, cell_levels
from octex.editing.averages import average
from octex.editing.draft import Tiles
from octex.editing.nodes import all_nodes
from octex.editing.split import rows_facing
from octex.errors import ArgumentError, own_making
from octex.painting.blend import Merge
from octex.painting.layer import (
    COVERAGE,
    SurfaceCells,
    blocks_meeting,
    empty_texture,
    paint_of,
    painted_channel,
)
from octex.painting.merge import paint_by_tiles
from octex.painting.multigrid import added, graph_of, solve
from octex.painting.options import Holes
from octex.painting.picture import Blend
from octex.painting.sheets import Sheets, sheets_of
from octex.painting.steps import cull_cells, merge_paint, raise_texture
from octex.painting.surface import Job
from octex.source.base import Source
from octex.source.surface import Surface
from octex.texture import Channel, OctreeTexture
from octex.tree.beside import with_boundary
from octex.tree.edit import among, locate, rebuilt
from octex.tree.octree import distinct
from octex.tree.placement import on_grid
from octex.tree.split import rows_of
from octex.voxelize.fragments import divided, whole

#: The channel with the part of the surface that pictures cover.
COVERED = "coverage"
#: Least coverage of a known value.
_KNOWN = 0.5
#: Largest number of filled cells, about; beyond it cells are larger.
_MOST_CELLS = 1 << 21
#: Levels from the filled cells up to the blocks in which uncovered surface is found.
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
        found: Float32s = self.values[self.sheets.at(triangles, barycentric)]
        return found


def begun(job: Job, layer: OctreeTexture, holes: Holes, *, is_hidden: bool = False) -> OctreeTexture:
    """Return the texture below the first layer: ``smooth`` where the layer has no paint.

    Values that the layer covers by half or more are known, in cells as large as most of its leaves. The rest
    is harmonic; a part without known values gets the mean. If the layer hides the fill (``is_hidden``), only
    the surroundings of uncovered surface have cells.
    """
    name, surface = painted_channel(layer), job.surface.surface
    form = layer.channels[name].format
    nothing = empty_texture([form], layer.placement, layer.bounds, surface)
    if holes == "leave" or not layer.tree.n_leaves:
        return nothing
    job.progress("fill", 0, 1)
    level, region = _uncovered(layer, surface)
    if not region.codes.size:
        return nothing
    sheets = sheets_of(surface, layer.placement, level, job.executor, region)
    where = locate(layer.tree, sheets.codes, level)
    values = rows_facing(layer, layer.channels[name], where.cells, sheets.bits).astype(np.float64)
    coverage = rows_facing(layer, layer.channels[ALPHA.name], where.cells, sheets.bits)[:, 0]
    is_there = where.is_leaf | (where.levels == level)
    coverage[~is_there | (layer.tree.arrays.flags[where.cells] & sheets.bits == 0)] = 0.0
    mean = decode(layer.channels[name].values[0], form.space).astype(np.float64)
    values = np.concatenate([filled(sheets, values, coverage >= _KNOWN, mean), mean[None]])
    source = SheetValues(form, sheets, values.astype(np.float32))
    made = cell_levels(
        surface, source, (form,), layer.placement, level, job.executor, job.progress,
        has_samples=False, reached=partial(blocks_meeting, [region]) if is_hidden else None,
    )  # fmt: skip
    tree, channels, *_ = assemble(made)
    job.progress("fill", 1, 1)
    return nothing.with_cells(tree, channels)


def _uncovered(layer: OctreeTexture, surface: Surface) -> tuple[int, Tiles]:
    """Return the level of most of a layer's leaves, or a coarser one with few cells, and the open blocks."""
    areas = [np.count_nonzero(~is_node) * 4.0**-level for level, (_, is_node) in enumerate(layer.tree.walk())]
    level = int(np.argmax(areas))
    found = _open_blocks(layer, surface, max(level - _BLOCK, 0))
    many = found.size * 4**_BLOCK / _MOST_CELLS
    if many > 1:
        level = max(level - int(np.ceil(np.log(many) / np.log(4))), 0)
        found = _open_blocks(layer, surface, max(level - _BLOCK, 0))
    return level, Tiles(max(level - _BLOCK, 0), found)


def _open_blocks(layer: OctreeTexture, surface: Surface, above: int) -> Int64s:
    """Return the cells of a level in or next to which a layer leaves surface uncovered."""
    blocks = divided(whole(on_grid(surface.rest, layer.placement), surface.triangles, above), 0)
    alpha = layer.channels[ALPHA.name]
    full = np.iinfo(alpha.format.dtype).max
    is_open = alpha.values[:, 0] < full
    is_open[rows_of(layer.tree.split).cells[alpha.split_values[:, 0] < full]] = True
    where = locate(layer.tree, blocks.codes, above)
    missing = ~where.is_leaf & (where.levels < above)
    found = [blocks.codes[missing | is_open[where.cells]]]
    firsts = layer.tree.arrays.level_cells
    for level, (codes, _) in enumerate(layer.tree.walk()):
        if level > above:
            is_here = is_open[firsts[level] : firsts[level + 1]]
            found.append(codes[is_here] >> 3 * (level - above))
    return with_boundary(distinct(np.concatenate(found)), above)


def filled(sheets: Sheets, values: Float64s, known: Bools, mean: Float64s) -> Float64s:
    """Return values (n, components) of sheets, harmonic where not ``known``, or the ``mean``."""
    free = np.flatnonzero(~known)
    numbers = np.full(known.size, -1, np.int64)
    numbers[free] = np.arange(free.size)
    one, other = sheets.pairs.T
    hold, right = np.full(free.size, _HOLD), np.tile(_HOLD * mean, (free.size, 1))
    for inner, outer in ((one, other), (other, one)):
        rim = ~known[inner] & known[outer]
        rows, ties = numbers[inner[rim]], sheets.ties[rim]
        hold += added(rows, ties, free.size)
        for component in range(values.shape[1]):
            right[:, component] += added(rows, ties * values[outer[rim], component], free.size)
    inside = ~known[one] & ~known[other]
    graph = graph_of(numbers[sheets.pairs[inside]], sheets.ties[inside], free.size)
    found = values.copy()
    found[free] = solve(graph, sheets.codes[free], sheets.level, hold, right)
    return found


def with_coverage(texture: OctreeTexture, layers: Sequence[OctreeTexture]) -> OctreeTexture:
    """Return a texture with the channel ``coverage``: 1 − (1 − c)(1 − d) for layers that cover c and d."""
    tree = texture.tree
    form = COVERAGE._replace(name=COVERED)
    rows = rows_of(tree.split)
    leaves = np.ones(tree.n_cells, np.bool_)
    leaves[all_nodes(tree).cells] = False
    of_leaves = leaves[rows.cells]
    if COVERED in texture.channels:
        had = texture.channels[COVERED]
        if had.format.components != 1 or had.format.space != "data":
            raise ArgumentError(f"the texture's channel {COVERED!r} is not a coverage channel")
        form, kept = had.format, had.kept_values
        clear, clear_rows = (1 - decode(each[:, 0], "data") for each in (had.values, had.split_values))
    else:
        kept = np.zeros((tree.kept.cells.size, 1), form.dtype)
        clear, clear_rows = np.ones(tree.n_cells, np.float32), np.ones(rows.rows.size, np.float32)
    for painted, paint in (each for layer in layers for each in paint_by_tiles(texture, layer)):
        alpha = painted.channels[ALPHA.name]
        for level, each in enumerate(paint):
            where = locate(tree, each.codes, level)
            is_leaf = where.is_leaf & (where.levels == level)
            cells, sources = where.cells[is_leaf], each.cells[is_leaf]
            clear[cells] *= 1 - each.coverage[is_leaf]
            chosen = np.flatnonzero(of_leaves)[among(rows.cells[of_leaves], cells)]
            at = np.searchsorted(cells, rows.cells[chosen])
            facing = rows_facing(painted, alpha, sources[at], rows.bits[chosen])[:, 0]
            facing[painted.tree.arrays.flags[sources[at]] & rows.bits[chosen] == 0] = 0
            clear_rows[chosen] *= 1 - facing
    values, split_values = (encode(1 - each[:, None], form.dtype, form.space) for each in (clear, clear_rows))
    channel = Channel(form, values, split_values, kept)
    average(texture, channel)
    channels = {**texture.channels, COVERED: channel}
    return texture.with_cells(tree, channels)


def started(job: Job, layer: OctreeTexture, holes: Holes, blend: Blend) -> tuple[OctreeTexture, bool]:
    """Return a new texture for a layer, and whether it includes the layer.

    It does unless the layer erases: with nothing below there is nothing to blend with. Else the texture holds
    only the fill of ``holes``.
    """
    is_in = blend != "erase" and layer.tree.n_leaves > 0
    fill = begun(job, layer, holes, is_hidden=is_in)
    return (_laid_over(job, fill, layer) if is_in else fill), is_in


def _laid_over(job: Job, fill: OctreeTexture, layer: OctreeTexture) -> OctreeTexture:
    """Merge a layer into its fill, raised to the layer's leaves without kept coefficients or skirts.

    Nothing has shown the fill before, so its field may move.
    """
    name = painted_channel(layer)
    if not fill.tree.n_leaves:
        return fill.with_cells(layer.tree, {name: layer.channels[name]})
    task = Merge(job, fill, layer, name, "over", 1.0, 0)
    job.progress("merge", 0, 1)
    with own_making():
        leaves, met = _united(task)
        paint, is_skirt = paint_of(layer, 1.0), np.zeros(fill.tree.n_cells, np.bool_)
        raised = raise_texture(task, fill, rebuilt(fill.tree, leaves), met, paint, is_skirt)
        made = merge_paint(task, fill, raised, paint)
    job.progress("merge", 1, 1)
    return made.texture


def _united(task: Merge) -> tuple[list[Int64s], SurfaceCells]:
    """Return the leaves of a layer and those that it lacks, by level, and the surface in the fill's leaves.

    A layer lacks leaves of the fill, and surface in these next to finer paint.
    """
    layer, level = task.layer.tree, task.texture.tree.max_depth
    walk = list(layer.walk())
    found = [[codes[~is_node]] for codes, is_node in walk]
    codes = task.texture.tree.level_codes(level)
    where = locate(layer, codes, level)
    found[level].append(codes[~where.is_leaf & (where.levels < level)])
    opened = codes[~where.is_leaf & (where.levels == level)]
    met = cull_cells(task, [(level, opened)], layer.max_depth)
    for deeper in range(level + 1, layer.max_depth + 1):
        (above, is_node), codes = walk[deeper - 1], met.codes[deeper]
        found[deeper].append(codes[among(codes >> 3, above[is_node]) & ~among(codes, walk[deeper][0])])
    return [distinct(np.concatenate(leaves)) for leaves in found], met
