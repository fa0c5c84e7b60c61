"""Paint as it lies on cells of a level."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int64s, Uint8s
from octex.channels import ALPHA, ChannelFormat, decode
from octex.errors import ArgumentError, DefectError
from octex.jit import kernel
from octex.texture import OctreeTexture
from octex.tree.edit import among, first_not_below, locate, places
from octex.tree.layout import FACING_FLAGS, SPLIT
from octex.tree.octree import Octree, distinct
from octex.tree.split import rows_of


class Paint(NamedTuple):
    """Paint on cells of one level."""

    codes: Int64s  # (n,)   Morton codes, ascending
    values: Float32s  # (n, components)   decoded
    coverage: Float32s  # (n,)   0 … 1
    cells: Int64s  # (n,)   the cells of the paint octree that say what each facing has
    flags: Uint8s  # (n,)   the facings that have paint, and SPLIT where these are told from others


class SurfaceCells(NamedTuple):
    """The cells of a surface near paint."""

    tree: Octree
    codes: list[Int64s]  # by level


def some(paint: Paint, chosen: Bools | Int64s | slice) -> Paint:
    """Return the paint on chosen cells."""
    codes, values, coverage, cells, flags = paint
    if not isinstance(chosen, slice):  # of rows, `take` is 4 × as fast as indexing
        chosen = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen
        return Paint(
            codes[chosen], values.take(chosen, axis=0), coverage[chosen], cells[chosen], flags[chosen]
        )
    return Paint(codes[chosen], values[chosen], coverage[chosen], cells[chosen], flags[chosen])


def joined(*parts: Paint) -> Paint:
    """Return all of the paint, on cells of one level."""
    filled = [part for part in parts if part.codes.size] or parts
    if len(filled) == 1:
        return filled[0]
    codes, *columns = (np.concatenate(column) for column in zip(*filled, strict=True))
    order = np.argsort(codes, kind="stable")
    return Paint(codes[order], *(column.take(order, axis=0) for column in columns))


def channel_of(layer: OctreeTexture) -> ChannelFormat:
    """Return the channel that a layer paints; raise ArgumentError for a texture that is no layer."""
    if len(layer.channels) != 2 or ALPHA.name not in layer.channels:
        raise ArgumentError("a layer must have one channel and alpha, its coverage")
    return layer.channels[painted_channel(layer)].format


def painted_channel(layer: OctreeTexture) -> str:
    """Return the name of the channel that a layer paints."""
    return next(name for name in layer.channels if name != ALPHA.name)


def paint_of(layer: OctreeTexture, opacity: float) -> list[Paint]:
    """Return the paint on a layer's leaves, level by level."""
    values, coverage = layer.channels[painted_channel(layer)], layer.channels[ALPHA.name]
    flags = layer.tree.arrays.flags & np.uint8(FACING_FLAGS)  # without SPLIT all of a cell is painted
    rows = rows_of(layer.tree.split)
    flags[rows.cells] = SPLIT
    np.bitwise_or.at(flags, rows.cells, rows.bits * (coverage.split_values[:, 0] > 0))
    found = []
    for level, (codes, is_node) in enumerate(layer.tree.walk()):
        cells = np.flatnonzero(~is_node) + int(layer.tree.arrays.level_cells[level])
        part = decode(coverage.values[cells], "data")[:, 0] * np.float32(opacity)
        has_paint = part > 0
        codes, cells = codes[~is_node][has_paint], cells[has_paint]
        colors = decode(values.values[cells], values.format.space)
        found.append(Paint(codes, colors, part[has_paint], cells, flags[cells]))
    return found


def with_bare_facings(layer: OctreeTexture) -> OctreeTexture:
    """Return a layer whose facings without paint have the values of their cells: averages are then alike."""
    name, rows = painted_channel(layer), rows_of(layer.tree.split)
    channel, is_bare = layer.channels[name], layer.channels[ALPHA.name].split_values == 0
    values = np.where(is_bare, channel.values[rows.cells], channel.split_values)
    return layer.with_cells(layer.tree, {**layer.channels, name: channel._replace(split_values=values)})


def leave_bare(facings: Uint8s, painted: Uint8s) -> Bools:
    """Say which cells (n,) have facings left bare by paint of flags (n,), which without SPLIT covers all."""
    bare: Bools = (painted & SPLIT != 0) & (facings & ~painted & np.uint8(FACING_FLAGS) != 0)
    return bare


def among_at(codes: Int64s, level: int, others: Int64s, at: int) -> Bools:
    """Say which cells of a level lie in, or hold, others of level ``at``."""
    if not codes.size:
        return np.zeros(0, np.bool_)
    if level < at:
        return among(codes, distinct(others >> 3 * (at - level)))
    return among(codes >> 3 * (level - at), others)


def facings_within(codes: Int64s, paint: Sequence[Paint], level: int) -> Uint8s:
    """Return which facings have paint in cells (n,) of a level, which may lie in larger painted ones."""
    found = np.zeros(codes.size, np.uint8)
    for above, each in enumerate(paint[: level + 1]):
        if each.codes.size:
            at = places(codes >> 3 * (level - above), each.codes)
            found[at >= 0] |= each.flags[at[at >= 0]]
    return found & np.uint8(FACING_FLAGS)


def paint_at(paint: Sequence[Paint], codes: Int64s, level: int) -> Paint:
    """Return the paint in cells of a level, ascending: of larger ones and the mean of smaller ones too."""
    sums = np.zeros((codes.size, paint[0].values.shape[1] + 2))
    cells, flags = np.zeros(codes.size, np.int64), np.zeros(codes.size, np.uint8)
    for at, each in enumerate(paint):
        if each.codes.size:
            _add_within(codes, level - at, each, sums, cells, flags)
    has = sums[:, -1] > 0
    sums = sums[has]
    values = (sums[:, :-2] / np.maximum(sums[:, -2:-1], 1e-30)).astype(np.float32)
    coverage = (sums[:, -2] / sums[:, -1]).astype(np.float32)
    return Paint(codes[has], values, coverage, cells[has], flags[has])


@kernel
def _add_within(
    codes: Int64s, steps: int, paint: Paint, sums: Float64s, cells: Int64s, flags: Uint8s
) -> None:
    """Add paint on cells of a level so many ``steps`` above that of ``codes``, or below, by area."""
    finer, coarser = (codes, paint.codes) if steps >= 0 else (paint.codes, codes)
    components = paint.values.shape[1]
    weight = 4.0 ** min(steps, 0)
    above = 0
    for below in range(finer.size):
        code = finer[below] >> 3 * abs(steps)
        above = first_not_below(coarser, code, above)
        if above == coarser.size or coarser[above] != code:
            continue
        n, own = (below, above) if steps >= 0 else (above, below)
        for component in range(components):
            sums[n, component] += weight * (paint.values[own, component] * paint.coverage[own])
        sums[n, components] += weight * paint.coverage[own]
        sums[n, components + 1] += weight
        cells[n] = paint.cells[own]
        flags[n] |= paint.flags[own]


def paint_on_leaves(tree: Octree, paint: Sequence[Paint]) -> tuple[Int64s, Paint]:
    """Return the leaves that are painted, ascending, and the paint on them."""
    found = []
    for level, each in enumerate(paint):
        if each.codes.size:
            where = locate(tree, each.codes, level)
            if not (where.is_leaf & (where.levels == level)).all():
                raise DefectError(f"paint of level {level} does not lie on leaves")
            found.append((where.cells, *each))
    columns = zip(*found, strict=True)
    cells, *paint_on = (own[0] if len(own) == 1 else np.concatenate(own) for own in columns)
    if (np.diff(cells) <= 0).any():
        raise DefectError("paint has a cell twice, or its cells are out of order")
    return cells, Paint(*paint_on)
