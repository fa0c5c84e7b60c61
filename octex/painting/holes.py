"""What no picture saw, filled from its surroundings over the surface."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s
from octex.channels import ALPHA, ChannelFormat, decode, encode
from octex.conversion.levels import assemble, cell_levels
from octex.editing.averages import average
from octex.editing.nodes import all_nodes
from octex.editing.split import rows_facing
from octex.errors import ArgumentError
from octex.painting.cells import painted_channel
from octex.painting.layer import COVERAGE, empty_texture
from octex.painting.merge import paint_by_tiles
from octex.painting.multigrid import added, graph_of, solve
from octex.painting.options import Holes
from octex.painting.sheets import Region, Sheets, sheets_of
from octex.parallel import Progress
from octex.source.base import Source
from octex.source.surface import Surface
from octex.texture import Channel, OctreeTexture
from octex.tree.beside import with_boundary
from octex.tree.edit import among, locate
from octex.tree.octree import distinct
from octex.tree.placement import on_grid
from octex.tree.split import rows_of
from octex.voxelize.fragments import divided, whole

#: The channel that says where pictures have covered the surface.
COVERED = "coverage"
#: What paint covers to so much is known.
_KNOWN = 0.5
#: So many cells are filled at most, about: beyond that larger ones.
_MOST_CELLS = 1 << 21
#: What is not covered is found in blocks of cells this many levels above them.
_BLOCK = 3
#: How strongly what is unknown is held at the mean of all that is known: parts without any become that.
_HOLD = 1e-9


@dataclass(eq=False)
class SheetValues(Source):
    """One value for each sheet of a surface, and one, the last, for all else."""

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
        """Return the values of the sheets that points are on."""
        found: Float32s = self.values[self.sheets.at(triangles, barycentric)]
        return found


def begun(
    layer: OctreeTexture,
    surface: Surface,
    holes: Holes,
    executor: Executor,
    progress: Progress,
    *,
    is_hidden: bool = False,
) -> OctreeTexture:
    """Return what the first layer of paint is merged into: ``smooth`` where it has no paint.

    What the layer covers by half or more is known, in cells as large as most of its leaves. The rest is
    harmonic; a part of which nothing is known has the mean. If what lies under the layer ``is_hidden``, there
    is nothing far from where it does not cover the surface.
    """
    name = painted_channel(layer)
    form = layer.channels[name].format
    nothing = empty_texture([form], layer.placement, layer.bounds, surface)
    if holes == "leave" or not layer.tree.n_leaves:
        return nothing
    progress("fill", 0, 1)
    level, region = _uncovered(layer, surface)
    if not region.codes.size:
        return nothing
    sheets = sheets_of(surface, layer.placement, level, executor, region)
    where = locate(layer.tree, sheets.codes, level)
    values = rows_facing(layer, layer.channels[name], where.cells, sheets.bits).astype(np.float64)
    coverage = rows_facing(layer, layer.channels[ALPHA.name], where.cells, sheets.bits)[:, 0]
    is_there = where.is_leaf | (where.levels == level)
    coverage[~is_there | (layer.tree.arrays.flags[where.cells] & sheets.bits == 0)] = 0.0
    mean = decode(layer.channels[name].values[0], form.space).astype(np.float64)
    values = np.concatenate([filled(sheets, values, coverage >= _KNOWN, mean), mean[None]])
    source = SheetValues(form, sheets, values.astype(np.float32))
    made = cell_levels(
        surface, source, (form,), layer.placement, level, executor, progress,
        has_samples=False, reached=region.reaches if is_hidden else None,
    )  # fmt: skip
    tree, channels, *_ = assemble(made)
    progress("fill", 1, 1)
    return OctreeTexture(tree, channels, layer.placement, layer.bounds, nothing.metadata)


def _uncovered(layer: OctreeTexture, surface: Surface) -> tuple[int, Region]:
    """Return the level of most of a layer's leaves, or a coarser one with few cells, and the open region."""
    areas = [np.count_nonzero(~is_node) * 4.0**-level for level, (_, is_node) in enumerate(layer.tree.walk())]
    level = int(np.argmax(areas))
    found = _open_blocks(layer, surface, max(level - _BLOCK, 0))
    many = found.size * 4**_BLOCK / _MOST_CELLS
    if many > 1:
        level = max(level - int(np.ceil(np.log(many) / np.log(4))), 0)
        found = _open_blocks(layer, surface, max(level - _BLOCK, 0))
    return level, Region(max(level - _BLOCK, 0), found)


def _open_blocks(layer: OctreeTexture, surface: Surface, above: int) -> Int64s:
    """Return the cells of a level in or beside which a layer does not cover the surface wholly."""
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
            own = is_open[firsts[level] : firsts[level + 1]]
            found.append(codes[own] >> 3 * (level - above))
    return with_boundary(distinct(np.concatenate(found)), above)


def filled(sheets: Sheets, values: Float64s, known: Bools, mean: Float64s) -> Float64s:
    """Return values (n, components) of sheets, harmonic where not ``known``; ``mean`` in unknown parts."""
    free = np.flatnonzero(~known)
    numbers = np.full(known.size, -1, np.int64)
    numbers[free] = np.arange(free.size)
    one, other = sheets.pairs.T
    hold, right = np.full(free.size, _HOLD), np.tile(_HOLD * mean, (free.size, 1))
    for inner, outer in ((one, other), (other, one)):
        rim = ~known[inner] & known[outer]
        own, ties = numbers[inner[rim]], sheets.ties[rim]
        hold += added(own, ties, free.size)
        for component in range(values.shape[1]):
            right[:, component] += added(own, ties * values[outer[rim], component], free.size)
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
            own = where.is_leaf & (where.levels == level)
            cells, sources = where.cells[own], each.cells[own]
            clear[cells] *= 1 - each.coverage[own]
            chosen = np.flatnonzero(of_leaves)[among(rows.cells[of_leaves], cells)]
            at = np.searchsorted(cells, rows.cells[chosen])
            facing = rows_facing(painted, alpha, sources[at], rows.bits[chosen])[:, 0]
            facing[painted.tree.arrays.flags[sources[at]] & rows.bits[chosen] == 0] = 0
            clear_rows[chosen] *= 1 - facing
    values, split_values = (encode(1 - each[:, None], form.dtype, form.space) for each in (clear, clear_rows))
    channel = Channel(form, values, split_values, kept)
    average(texture, channel)
    channels = {**texture.channels, COVERED: channel}
    return OctreeTexture(tree, channels, texture.placement, texture.bounds, texture.metadata)
