"""Paint as it lies on cells: on a layer's leaves, brought to a texture's (paper 4.1, steps 2 and 3)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Int64s, Uint8s
from octex.channels import ALPHA, ChannelFormat, decode
from octex.editing.refined import refined_values
from octex.errors import ArgumentError
from octex.texture import OctreeTexture
from octex.tree.edit import among, boundary, locate
from octex.tree.layout import FACING_FLAGS
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.octree import Octree, distinct
from octex.tree.split import rows_of

_AROUND = np.array([[x, y, z] for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1) if x or y or z])
#: The area that skirts have, the least there is: in averages they weigh next to nothing.
SKIRT = np.uint8(1)


class Paint(NamedTuple):
    """Paint on cells of one level."""

    codes: Int64s  # (n,)   Morton codes, ascending
    values: Float32s  # (n, components)   decoded
    coverage: Float32s  # (n,)   0 … 1
    cells: Int64s  # (n,)   the cells of the paint octree that say what each facing has
    facings: Uint8s  # (n,)   which of them have paint


def paint_of(layer: OctreeTexture, opacity: float) -> tuple[ChannelFormat, list[Paint]]:
    """Return what a layer paints: its channel, and the paint on its leaves, level by level.

    Raises ArgumentError for a texture that is no layer.
    """
    if len(layer.channels) != 2 or ALPHA.name not in layer.channels:
        raise ArgumentError("a layer has one channel, and alpha: what paint covers")
    values, coverage = layer.channels[painted_channel(layer)], layer.channels[ALPHA.name]
    facings = _painted_facings(layer)
    found = []
    for level, (codes, is_node) in enumerate(layer.tree.walk()):
        cells = np.flatnonzero(~is_node) + int(layer.tree.arrays.level_cells[level])
        part = decode(coverage.values[cells], "data")[:, 0] * np.float32(opacity)
        has_paint = part > 0
        cells = cells[has_paint]
        own = codes[~is_node][has_paint]
        found.append(
            Paint(
                own,
                decode(values.values[cells], values.format.space),
                part[has_paint],
                cells,
                facings[cells],
            )
        )
    return values.format, found


def painted_channel(layer: OctreeTexture) -> str:
    """Return the name of the channel that a layer paints."""
    return next(name for name in layer.channels if name != ALPHA.name)


def _painted_facings(layer: OctreeTexture) -> Uint8s:
    """Return the facings of a layer's cells (cells,) that have paint: all, but in split cells."""
    facings = layer.tree.arrays.flags & np.uint8(FACING_FLAGS)
    rows = rows_of(layer.tree.split)
    facings[rows.cells] = 0
    np.bitwise_or.at(facings, rows.cells, rows.bits * (layer.channels[ALPHA.name].split_values[:, 0] > 0))
    return facings


def refine_paint(paint: Sequence[Paint], layer: OctreeTexture, tree: Octree, opacity: float) -> list[Paint]:
    """Bring paint to the resolution of a tree that is deeper, by the field's refinement (paper 4.1, step 2).

    The paper does so where paint is translucent. Here opaque paint goes down too: a texture of even depth is
    looked up four times as fast as one of many.
    """
    name = painted_channel(layer)
    found = list(paint)
    while len(found) <= tree.max_depth:
        found.append(some(paint[0], slice(0)))
    if all(locate(tree, each.codes, level).is_leaf.all() for level, each in enumerate(paint)):
        return found
    walk = list(tree.walk())
    for level in range(len(walk) - 1):
        codes, is_node = walk[level]
        below = among(found[level].codes, codes[is_node])
        if not below.any():
            continue
        coarse = found[level]
        found[level] = some(coarse, ~below)
        parents, cells, facings = coarse.codes[below], coarse.cells[below], coarse.facings[below]
        source_codes = parents
        for deeper in range(level + 1, len(walk)):
            codes, is_node = walk[deeper]
            children = codes[among(codes >> 3, parents)]
            if not children.size:
                break
            is_leaf = ~is_node[np.searchsorted(codes, children)]
            leaves, parents = children[is_leaf], children[~is_leaf]
            if leaves.size:
                owners = np.searchsorted(source_codes, leaves >> 3 * (deeper - level))
                values, coverage = _refined_paint(layer, name, leaves, deeper, opacity)
                finer = Paint(leaves, values, coverage, cells[owners], facings[owners])
                found[deeper] = _joined(found[deeper], finer)
    return found


def is_within(codes: Int64s, cells: Sequence[Int64s], level: int) -> Bools:
    """Say which cells of a level are among others, given level by level, or lie in larger ones of them."""
    found = np.zeros(codes.size, np.bool_)
    for above, own in enumerate(cells[: level + 1]):
        found |= among(codes >> 3 * (level - above), own)
    return found


def are_beside(codes: Int64s, leaves: Sequence[Int64s], level: int) -> Bools:
    """Say which cells (n,) of a level have some of leaves, given by level, in or beside them."""
    near = distinct(np.concatenate([codes, boundary(codes, level)]))
    below = np.empty(0, np.int64)
    for deeper in range(len(leaves) - 1, level - 1, -1):
        own = leaves[deeper] >> 3 * (deeper - level)
        below = np.concatenate([below, own[among(own, near)]])
    taken = near[is_within(near, [*leaves[:level], distinct(below)], level)]
    return among(codes, taken) | among(codes, boundary(taken, level))


def among_at(codes: Int64s, level: int, others: Int64s, at: int) -> Bools:
    """Say which cells of a level lie in, or hold, others of level ``at``."""
    if level < at:
        return among(codes, distinct(others >> 3 * (at - level)))
    return among(codes >> 3 * (level - at), others)


def facings_within(codes: Int64s, paint: Sequence[Paint], level: int) -> Uint8s:
    """Return which facings have paint in cells (n,) of a level, which may lie in larger painted ones."""
    found = np.zeros(codes.size, np.uint8)
    for above, each in enumerate(paint[: level + 1]):
        own = codes >> 3 * (level - above)
        inside = among(own, each.codes)
        found[inside] |= each.facings[np.searchsorted(each.codes, own[inside])]
    return found


def _each_beside(codes: Int64s, level: int) -> Iterator[tuple[Bools, Int64s]]:
    """Yield, for each of 26 directions, whether a cell is beside cells (n,) of a level, and its code."""
    for step in _AROUND if codes.size else ():
        cells = decode_cells(codes) + step
        inside = ((cells >= 0) & (cells < 1 << level)).all(axis=1)
        yield inside, encode_cells(np.where(inside[:, None], cells, 0))


def beside_larger(codes: Int64s, tree: Octree, level: int) -> Bools:
    """Say which cells (n,) of a level are beside leaves of a tree that are larger."""
    found = np.zeros(codes.size, np.bool_)
    for inside, beside in _each_beside(codes, level):
        where = locate(tree, beside, level)
        found |= inside & where.is_leaf & (where.levels < level)
    return found


def skirt_of(outer: Int64s, painted: Sequence[Int64s], ring: Int64s, met: Int64s, level: int) -> Int64s:
    """Return those cells beside paint, off the surface, that nothing but paint and its boundary is beside."""
    free = np.ones(outer.size, np.bool_)
    for inside, codes in _each_beside(outer, level):
        free &= ~inside | among(codes, ring) | is_within(codes, painted, level) | ~among(codes, met)
    return outer[free]


def skirt_on_nothing(
    absent: Int64s,
    painted: Sequence[Int64s],
    ring: Int64s,
    met: Int64s,
    unraised: Sequence[Int64s],
    level: int,
    top: int,
) -> Int64s:
    """Return those of cells below nothing whose whole surroundings, a cell of level ``top``, are free.

    A spline reaches half a cell beyond leaves, so that what was a leaf is refined to cells beside it too. A
    single stored cell there makes all others below the same cell of level ``top`` count for nothing, also
    to what is beside it of ``unraised`` leaves, given by level.
    """
    shift = 3 * (level - top)
    tops = distinct(absent >> shift)
    near = distinct(np.concatenate([tops, boundary(tops, top)]))
    outer = met[among(met >> shift, near)]
    outer = outer[~among(outer, ring) & ~is_within(outer, painted, level)]
    taken = distinct(np.concatenate([outer, boundary(outer, level)]) >> shift)
    free = tops[~among(tops, taken) & ~are_beside(tops, unraised, top)]
    return absent[among(absent >> shift, free)]


def paint_at(paint: Sequence[Paint], codes: Int64s, level: int) -> Paint:
    """Return the paint in cells of a level, ascending: of larger ones and the mean of smaller ones too."""
    components = paint[0].values.shape[1]
    sums = np.zeros((codes.size, components + 2))
    cells, facings = np.zeros(codes.size, np.int64), np.zeros(codes.size, np.uint8)
    for at, each in enumerate(paint):
        if at <= level:
            own = codes >> 3 * (level - at)
            rows = np.flatnonzero(among(own, each.codes))
            there = np.searchsorted(each.codes, own[rows])
        else:
            inside = each.codes >> 3 * (at - level)
            there = np.flatnonzero(among(inside, codes))
            rows = np.searchsorted(codes, inside[there])
        coverage = each.coverage[there, None]
        parts = np.hstack([each.values[there] * coverage, coverage, np.ones_like(coverage)])
        np.add.at(sums, rows, parts * 4.0 ** min(level - at, 0))
        cells[rows] = each.cells[there]
        np.bitwise_or.at(facings, rows, each.facings[there])
    has = sums[:, -1] > 0
    sums = sums[has]
    values = (sums[:, :-2] / np.maximum(sums[:, -2:-1], 1e-30)).astype(np.float32)
    coverage = (sums[:, -2] / sums[:, -1]).astype(np.float32)
    return Paint(codes[has], values, coverage, cells[has], facings[has])


def with_skirt(paint: Paint, skirt: Int64s, level: int, beside: Paint | None = None) -> Paint:
    """Add a skirt: its paint is the mean of the paint beside it, of this paint unless another is given."""
    if not skirt.size:
        return paint
    beside = paint if beside is None else beside
    values = np.zeros((skirt.size, paint.values.shape[1]))
    coverage, count = np.zeros(skirt.size), np.zeros(skirt.size)
    cells = np.zeros(skirt.size, np.int64)
    facings = np.zeros(skirt.size, np.uint8)
    for inside, codes in _each_beside(skirt, level):
        at = np.minimum(np.searchsorted(beside.codes, codes), beside.codes.size - 1)
        hit = inside & (beside.codes[at] == codes)
        values[hit] += (beside.values * beside.coverage[:, None])[at[hit]]
        coverage[hit] += beside.coverage[at[hit]]
        count[hit] += 1
        cells[hit] = beside.cells[at[hit]]
        facings[hit] |= beside.facings[at[hit]]
    values /= np.maximum(coverage, 1e-30)[:, None]
    coverage /= np.maximum(count, 1)
    extra = Paint(skirt, values.astype(np.float32), coverage.astype(np.float32), cells, facings)
    return _joined(paint, extra)


def some(paint: Paint, chosen: Bools | slice) -> Paint:
    """Return the paint on some of the cells."""
    codes, values, coverage, cells, facings = paint
    return Paint(codes[chosen], values[chosen], coverage[chosen], cells[chosen], facings[chosen])


def _joined(*parts: Paint) -> Paint:
    codes, *columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(codes, kind="stable")
    return Paint(codes[order], *(column[order] for column in columns))


def _refined_paint(
    layer: OctreeTexture, name: str, codes: Int64s, level: int, opacity: float
) -> tuple[Float32s, Float32s]:
    found = refined_values(layer.tree, layer.channels, codes, level)
    return found[name], found[ALPHA.name][:, 0] * np.float32(opacity)
