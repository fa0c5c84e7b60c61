"""Paint before it is merged: its source, its depth, its layer, and its values on cells of a level."""

from __future__ import annotations

from abc import abstractmethod
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Bools, Float32s, Float64s, Floats, Int32s, Int64s, Uint8s
from octex.channels import ALPHA, ChannelFormat, decode, encode
from octex.errors import DefectError
from octex.jit import kernel
from octex.source.base import Source
from octex.source.parts import SEPARATION
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.texture.channel import Channel
from octex.tree.edit import first_not_below, indices_in, locate
from octex.tree.layout import FACING_FLAGS, MAX_DEPTH, SPLIT
from octex.tree.neighbours import among_at
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from octex.tree.split import rows_of
from octex.voxelize.fragments import Blocks

#: Least number of cells in the width of a pixel; less than twice as many are used. One needs a fourth of the
#: leaves of two, with 1.3 to 3 times the error (RMS).
CELLS, FINEST_CELLS = 1.0, 2.0
#: Share of the surface with the finest pixels that is ignored.
_FINEST_PART = 0.01
#: Share of the surface with finer pixels than the level of most of it allows, for several images. One
#: image gets next to none, so that its edges stay sharp.
_FINER_PART = 0.5
#: Levels by which paint may be coarser than its detail.
_SLACK = 0.1
#: Pixels up to so many levels coarser or finer than most of the surface get its level: fitting a tree of even
#: depth takes half the time per leaf.
_COARSER, _FINER = 2.0, 0.5
#: Share of the surface with coarser pixels up to which all of it gets the finest cells.
_UNEVEN_PART = 0.1

#: Coverage has 16 bits: 8 would change a wash by up to half a step.
COVERAGE = ALPHA._replace(dtype="uint16")


class PaintSource(Source):
    """Gives a channel's components, and their coverage as ``alpha``, to points of a surface."""

    form: ChannelFormat  # of the painted channel
    has_gaps = True  # paint covers a part of the surface
    alpha_is_coverage = True

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """The painted channel, and its coverage."""
        return self.form, COVERAGE

    @property
    def color(self) -> Float32s | None:
        """The decoded value (components,) of all paint; None if it may have several."""
        return None

    @abstractmethod
    def touched(self) -> Int32s:
        """Return triangles, ascending; all paint lies on them or next to them."""

    def reaches(self, blocks: Blocks, placement: Placement, rest: Float64s) -> Bools:  # noqa: ARG002
        """Return which blocks of a root cell may have paint, for a surface at ``rest`` (n, 3)."""
        return np.ones(blocks.codes.size, np.bool_)

    def widths(
        self,
        triangles: Int32s,
        barycentric: Float64s,  # noqa: ARG002
    ) -> Float32s:
        """Return the width of the paint's finest detail at points (n,), in rest units; 0: any."""
        return np.zeros(len(triangles), np.float32)


class Depths(NamedTuple):
    """The levels of paint."""

    most: int  # of most of the surface
    deepest: int
    is_even: bool = True  # nearly all paint has the deepest level

    def levels(self, widths: Floats, size: float, cells: float) -> Float64s:
        """Return the levels (n,) that put ``cells`` into each width (n,), in a root cell of this size."""
        levels = _levels(widths, size, cells)
        levels[(levels > self.most - _COARSER) & (levels <= self.most + _FINER)] = self.most
        clipped: Float64s = np.clip(levels, 0.0, self.deepest)
        return clipped


def wanted_depths(
    widths: Floats,
    areas: Floats,
    size: float,
    cells: float,
    depth: int = MAX_DEPTH,
    *,
    is_single: bool = False,
) -> Depths:
    """Return the levels of paint with details of these widths (n,) on these areas (n,) of the surface.

    Most of the surface gets ``cells`` or more per width, in a root cell of ``size``; a single image all but
    its finest hundredth. No level is deeper than ``depth``.
    """
    is_known = np.isfinite(widths) & (widths > 0.0) & (areas > 0.0)
    if not is_known.all():
        widths, areas = widths[is_known], areas[is_known]
    if not widths.size:
        return Depths(0, 0)
    if (widths[1:] < widths[:-1]).any():
        order = np.argsort(widths, kind="stable")
        widths, areas = widths[order], areas[order]
    parts = np.cumsum(areas)
    parts /= parts[-1]
    middle = widths[np.searchsorted(parts, _FINEST_PART if is_single else _FINER_PART)]
    most = int(np.clip(np.ceil(_levels(middle, size, cells)), 0, depth))

    def level(at: int) -> int:
        return int(np.ceil(Depths(most, depth).levels(widths[at : at + 1], size, cells)[0]))

    deepest = level(int(np.searchsorted(parts, _FINEST_PART)))
    first = bisect_left(range(widths.size), 1 - deepest, key=lambda at: -level(at))  # the first coarser one
    return Depths(most, deepest, bool(1.0 - (parts[first - 1] if first else 0.0) <= _UNEVEN_PART))


def _levels(widths: Floats, size: float, cells: float) -> Float64s:
    with np.errstate(divide="ignore"):
        levels: Float64s = np.log2(cells * size / np.asarray(widths, np.float64)) - _SLACK
    return levels


def is_plain(source: PaintSource) -> bool:
    """Return whether all paint has one value, which is stored without rounding."""
    if source.color is None:
        return False
    form = source.channels[0]
    stored = decode(encode(source.color, form.dtype, form.space), form.space)
    return bool(np.allclose(stored, source.color, rtol=1e-6, atol=1e-7))


def empty_texture(
    forms: Sequence[ChannelFormat],
    placement: Placement,
    bounds: npt.ArrayLike,
    surface: Surface | None = None,
) -> OctreeTexture:
    """Return a texture without leaves; its metadata record how far a surface's parts were moved apart."""
    provenance = {} if surface is None else surface.provenance
    metadata = {name: text for name, text in provenance.items() if name == SEPARATION}
    tree = Octree.from_leaves(np.empty(0, np.int64), 0)
    channels = {form.name: Channel.full(form, tree) for form in forms}
    return OctreeTexture(tree, channels, placement, bounds, metadata)


class Paint(NamedTuple):
    """Paint on cells of one level."""

    codes: Int64s  # (n,)   Morton codes, ascending
    values: Float32s  # (n, components)   decoded
    coverage: Float32s  # (n,)   0 … 1
    cells: Int64s  # (n,)   cells of the layer, which hold the paint of each facing
    flags: Uint8s  # (n,)   facings with paint, and SPLIT if others have none

    def of(self, chosen: Bools | Int64s | slice) -> Paint:
        """Return the paint on chosen cells."""
        if isinstance(chosen, slice):
            return Paint._make(column[chosen] for column in self)
        rows = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen
        return Paint._make(column.take(rows, axis=0) for column in self)  # 4 × as fast as indexing


class SurfaceCells(NamedTuple):
    """The cells that the surface meets near paint."""

    tree: Octree
    codes: list[Int64s]  # by level


def joined(*parts: Paint) -> Paint:
    """Return all of the paint, on cells of one level."""
    filled = [part for part in parts if part.codes.size] or parts
    if len(filled) == 1:
        return filled[0]
    codes, *columns = (np.concatenate(column) for column in zip(*filled, strict=True))
    order = np.argsort(codes, kind="stable")
    return Paint(codes[order], *(column.take(order, axis=0) for column in columns))


def painted_channel(layer: OctreeTexture) -> str:
    """Return the name of a layer's painted channel."""
    return next(name for name in layer.channels if name != ALPHA.name)


def leaves_by_level(tree: Octree) -> Iterator[tuple[int, Int64s, Int64s]]:
    """Yield the levels of a tree, and the cells and Morton codes of their leaves."""
    for level, (codes, is_node) in enumerate(tree.walk()):
        leaves = np.flatnonzero(~is_node)
        yield level, int(tree.arrays.level_cells[level]) + leaves, codes[leaves]


def paint_of(layer: OctreeTexture, opacity: float) -> list[Paint]:
    """Return the paint on a layer's leaves, level by level."""
    flags = layer.tree.arrays.flags & np.uint8(FACING_FLAGS)  # cells without SPLIT have paint on all facings
    rows = rows_of(layer.tree.split)
    flags[rows.cells] = SPLIT
    has_paint = layer.channels[ALPHA.name].split_values[:, 0] > 0
    np.bitwise_or.at(flags, rows.cells, rows.bits * has_paint)
    paint = []
    for _, cells, codes in leaves_by_level(layer.tree):
        on_level = paint_in(layer, cells, codes, flags[cells], opacity)
        is_painted = on_level.coverage > 0
        paint.append(on_level if is_painted.all() else on_level.of(is_painted))
    return paint


def paint_in(
    layer: OctreeTexture, cells: Int64s, codes: Int64s, flags: Uint8s, opacity: float = 1.0
) -> Paint:
    """Return the paint in cells (n,) of a layer, from their codes and the flags of `Paint`."""
    values, coverage = layer.channels[painted_channel(layer)], layer.channels[ALPHA.name]
    colors = decode(values.values.take(cells, axis=0), values.format.space)
    return Paint(
        codes, colors, decode(coverage.values.take(cells), "data") * np.float32(opacity), cells, flags
    )


def with_bare_facings(layer: OctreeTexture) -> OctreeTexture:
    """Return a layer whose facings without paint have the values of their cells, so that averages agree."""
    name, rows = painted_channel(layer), rows_of(layer.tree.split)
    channel, is_bare = layer.channels[name], layer.channels[ALPHA.name].split_values == 0
    values = np.where(is_bare, channel.values[rows.cells], channel.split_values)
    return layer.with_cells(layer.tree, {**layer.channels, name: channel._replace(split_values=values)})


def leave_bare(facings: Uint8s, painted: Uint8s) -> Bools:
    """Return which cells (n,) have facings without paint; paint without SPLIT covers all facings."""
    bare: Bools = (painted & SPLIT != 0) & (facings & ~painted & np.uint8(FACING_FLAGS) != 0)
    return bare


def blocks_meeting(cells: Sequence[tuple[int, Int64s]], blocks: Blocks) -> Bools:
    """Return which blocks meet cells, listed as levels and codes."""
    meet = np.zeros(blocks.codes.size, np.bool_)
    for level, codes in cells:
        meet |= among_at(blocks.codes, blocks.level, codes, level)
    return meet


def facings_within(codes: Int64s, paint: Sequence[Paint], level: int) -> Uint8s:
    """Return the painted facings of cells (n,) of a level, which may lie in larger painted cells."""
    facings = np.zeros(codes.size, np.uint8)
    for above, each in enumerate(paint[: level + 1]):
        if each.codes.size:
            at = indices_in(codes >> 3 * (level - above), each.codes)
            facings[at >= 0] |= each.flags[at[at >= 0]]
    return facings & np.uint8(FACING_FLAGS)


def paint_at(paint: Sequence[Paint], codes: Int64s, level: int) -> Paint:
    """Return the paint in cells of a level, ascending: that of larger cells, or the mean of smaller ones."""
    sums = np.zeros((codes.size, paint[0].values.shape[1] + 2))
    cells, flags = np.zeros(codes.size, np.int64), np.zeros(codes.size, np.uint8)
    for at, each in enumerate(paint):
        if each.codes.size:
            _add_within(codes, level - at, each, sums, cells, flags)
    is_painted = sums[:, -1] > 0
    sums = sums[is_painted]
    values = (sums[:, :-2] / np.maximum(sums[:, -2:-1], 1e-30)).astype(np.float32)
    coverage = (sums[:, -2] / sums[:, -1]).astype(np.float32)
    return Paint(codes[is_painted], values, coverage, cells[is_painted], flags[is_painted])


@kernel
def _add_within(
    codes: Int64s, steps: int, paint: Paint, sums: Float64s, cells: Int64s, flags: Uint8s
) -> None:
    """Sum paint by area; its level is ``steps`` above that of ``codes``, or below if negative."""
    finer, coarser = (codes, paint.codes) if steps >= 0 else (paint.codes, codes)
    components = paint.values.shape[1]
    weight = 4.0 ** min(steps, 0)
    above = 0
    for below in range(finer.size):
        code = finer[below] >> 3 * abs(steps)
        above = first_not_below(coarser, code, above)
        if above == coarser.size or coarser[above] != code:
            continue
        n, row = (below, above) if steps >= 0 else (above, below)
        for component in range(components):
            sums[n, component] += weight * (paint.values[row, component] * paint.coverage[row])
        sums[n, components] += weight * paint.coverage[row]
        sums[n, components + 1] += weight
        cells[n] = paint.cells[row]
        flags[n] |= paint.flags[row]


def paint_on_leaves(tree: Octree, paint: Sequence[Paint]) -> tuple[Int64s, Paint]:
    """Return the painted leaves, ascending, and the paint on them."""
    columns_by_level = []
    for level, each in enumerate(paint):
        if each.codes.size:
            where = locate(tree, each.codes, level)
            if not (where.is_leaf & (where.levels == level)).all():
                raise DefectError(f"paint of level {level} does not lie on leaves")
            columns_by_level.append((where.cells, *each))
    columns = zip(*columns_by_level, strict=True)
    cells, *paint_on = (column[0] if len(column) == 1 else np.concatenate(column) for column in columns)
    if (np.diff(cells) <= 0).any():
        raise DefectError("paint has a cell twice, or its cells are out of order")
    return cells, Paint(*paint_on)
