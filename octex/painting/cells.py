"""Paint as it lies on cells: on a layer's leaves, brought to a texture's (paper 4.1, steps 2 and 3)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int64s, Uint8s
from octex.channels import ALPHA, ChannelFormat, decode
from octex.editing.refined import refined_values
from octex.errors import ArgumentError
from octex.jit import kernel
from octex.parallel import ordered_map, sharing
from octex.texture import OctreeTexture
from octex.tree import morton
from octex.tree.beside import are_beside, boundary, is_within, near, with_boundary
from octex.tree.edit import among, first_not_below, locate, places
from octex.tree.layout import FACING_FLAGS, SPLIT
from octex.tree.octree import Octree, distinct
from octex.tree.split import rows_of

#: Cells of a skirt that are painted at once.
_BLOCK = 1 << 13


class Paint(NamedTuple):
    """Paint on cells of one level."""

    codes: Int64s  # (n,)   Morton codes, ascending
    values: Float32s  # (n, components)   decoded
    coverage: Float32s  # (n,)   0 … 1
    cells: Int64s  # (n,)   the cells of the paint octree that say what each facing has
    flags: Uint8s  # (n,)   the facings that have paint, and SPLIT where these are told from others


def channel_of(layer: OctreeTexture) -> ChannelFormat:
    """Return the channel that a layer paints; raise ArgumentError for a texture that is no layer."""
    if len(layer.channels) != 2 or ALPHA.name not in layer.channels:
        raise ArgumentError("a layer has one channel, and alpha: what paint covers")
    return layer.channels[painted_channel(layer)].format


def paint_of(layer: OctreeTexture, opacity: float) -> list[Paint]:
    """Return the paint on a layer's leaves, level by level."""
    values, coverage = layer.channels[painted_channel(layer)], layer.channels[ALPHA.name]
    flags = _painted_flags(layer)
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
                flags[cells],
            )
        )
    return found


def painted_channel(layer: OctreeTexture) -> str:
    """Return the name of the channel that a layer paints."""
    return next(name for name in layer.channels if name != ALPHA.name)


def _painted_flags(layer: OctreeTexture) -> Uint8s:
    """Return the flags of paint on a layer's cells (cells,); without SPLIT all of a cell is painted."""
    flags = layer.tree.arrays.flags & np.uint8(FACING_FLAGS)
    rows = rows_of(layer.tree.split)
    flags[rows.cells] = SPLIT
    np.bitwise_or.at(flags, rows.cells, rows.bits * (layer.channels[ALPHA.name].split_values[:, 0] > 0))
    return flags


def leave_bare(facings: Uint8s, painted: Uint8s) -> Bools:
    """Say which cells (n,) have some of their facings left bare by the paint on them, of flags (n,).

    Paint that tells no facings apart is on the cell as a whole.
    """
    bare: Bools = (painted & SPLIT != 0) & (facings & ~painted & np.uint8(FACING_FLAGS) != 0)
    return bare


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
        parents, cells, flags = coarse.codes[below], coarse.cells[below], coarse.flags[below]
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
                finer = Paint(leaves, values, coverage, cells[owners], flags[owners])
                found[deeper] = joined(found[deeper], finer)
    return found


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


def beside_larger(codes: Int64s, tree: Octree, tops: Sequence[Int64s], level: int) -> Bools:
    """Say which cells (n,) of a level, in no leaf of a tree, are beside leaves that are larger.

    Those do not count that are among ``tops``, given by level.
    """
    around = boundary(codes, level)
    where = locate(tree, around, level)
    around = around[where.is_leaf & (where.levels < level)]
    around = around[~is_within(around, tops[:level], level)]
    return near(codes, around, level)


def skirt_of(outer: Int64s, painted: Sequence[Int64s], ring: Int64s, met: Int64s, level: int) -> Int64s:
    """Return those cells beside paint, off the surface, that nothing but paint and its boundary is beside."""
    if not outer.size:
        return outer
    bare = met[near(met, outer, level)]
    bare = bare[~among(bare, ring)]
    bare = bare[~is_within(bare, painted, level)]
    return outer[~near(outer, bare, level)]


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
    outer = met[near(met >> shift, tops, top)]
    outer = outer[~among(outer, ring) & ~is_within(outer, painted, level)]
    taken = distinct(with_boundary(outer, level) >> shift)
    free = tops[~among(tops, taken) & ~are_beside(tops, unraised, top)]
    return absent[among(absent >> shift, free)]


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


def skirt_paint(skirt: Int64s, level: int, executor: Executor, beside: Paint) -> Paint:
    """Return the paint of a skirt: the mean of the paint beside it."""
    if not skirt.size:
        return some(beside, slice(0))
    found = Paint(
        skirt,
        np.zeros((skirt.size, beside.values.shape[1]), np.float32),
        np.zeros(skirt.size, np.float32),
        np.zeros(skirt.size, np.int64),
        np.zeros(skirt.size, np.uint8),
    )
    parts = [some(found, slice(begin, begin + _BLOCK)) for begin in range(0, skirt.size, _BLOCK)]
    with sharing(executor) as pool:
        list(ordered_map(pool, lambda part: _average_beside(part, level, beside), parts))
    return found


@kernel
def _average_beside(skirt: Paint, level: int, paint: Paint) -> None:
    """Fill in the mean of the paint beside cells.

    The paint in and around a block of 8³ cells is looked up for all that are in it.
    """
    components = paint.values.shape[1]
    sums = np.empty(components, np.float64)
    nearest = np.zeros(64, np.int64)  # of each block of 4³ in reach, where the paint was for the one before
    around = np.empty((10, 10, 10), np.int64)  # the place of paint in the block and beside it, or −1
    last = np.int64(-1)
    end = ((1 << level) - 1) >> 2
    for n in range(skirt.codes.size):
        code = skirt.codes[n]
        if code >> 9 != last:
            last = code >> 9
            around[:] = -1
            i, j, k = morton.decode(last << 3)
            for side in range(64):
                x, y, z = i + side % 4 - 1, j + side // 4 % 4 - 1, k + side // 16 - 1
                if min(x, y, z) < 0 or max(x, y, z) > end:
                    continue
                block = morton.encode(x, y, z)
                at = first_not_below(paint.codes, block << 6, nearest[side])
                nearest[side] = at
                while at < paint.codes.size and paint.codes[at] >> 6 == block:
                    u, v, w = morton.decode(paint.codes[at] & 63)
                    u, v, w = u + 4 * (x - i) + 1, v + 4 * (y - j) + 1, w + 4 * (z - k) + 1
                    if min(u, v, w) >= 0 and max(u, v, w) < 10:
                        around[w, v, u] = at
                    at += 1
        sums[:] = 0.0
        coverage, count = 0.0, 0
        u, v, w = morton.decode(code & 511)
        for z in range(w, w + 3):
            for y in range(v, v + 3):
                for x in range(u, u + 3):
                    at = around[z, y, x]
                    if at < 0 or paint.codes[at] == code:
                        continue
                    for component in range(components):
                        sums[component] += np.float64(paint.values[at, component] * paint.coverage[at])
                    coverage += np.float64(paint.coverage[at])
                    count += 1
                    skirt.cells[n] = paint.cells[at]
                    skirt.flags[n] |= paint.flags[at]
        for component in range(components):
            skirt.values[n, component] = sums[component] / max(coverage, 1e-30)
        skirt.coverage[n] = coverage / max(count, 1)


def some(paint: Paint, chosen: Bools | Int64s | slice) -> Paint:
    """Return the paint on some of the cells."""
    codes, values, coverage, cells, flags = paint
    return Paint(codes[chosen], values[chosen], coverage[chosen], cells[chosen], flags[chosen])


def joined(*parts: Paint) -> Paint:
    """Return all of the paint, on cells of one level."""
    codes, *columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(codes, kind="stable")
    return Paint(codes[order], *(column[order] for column in columns))


def _refined_paint(
    layer: OctreeTexture, name: str, codes: Int64s, level: int, opacity: float
) -> tuple[Float32s, Float32s]:
    found = refined_values(layer.tree, layer.channels, codes, level)
    return found[name], found[ALPHA.name][:, 0] * np.float32(opacity)
