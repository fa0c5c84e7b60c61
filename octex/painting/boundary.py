"""The boundary around paint: neighbours on the surface, and skirts off it (paper 4.1, step 3; 4.2)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from itertools import islice
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Int64s
from octex.editing.nodes import all_children
from octex.jit import kernel
from octex.painting.layer import Paint, SurfaceCells, joined, leave_bare, paint_at
from octex.parallel import ordered_map, sharing
from octex.tree import morton
from octex.tree.edit import Located, among, first_not_below, indices_in, locate, with_all_above
from octex.tree.layout import FACING_FLAGS, KEPT, POSITIVE_FACINGS, SPLIT
from octex.tree.neighbours import among_at, are_adjacent, boundary, is_within, near, touch, with_boundary
from octex.tree.octree import Octree, distinct

#: Cells of a skirt that are painted in one task.
_BLOCK = 1 << 13


class Finer(NamedTuple):
    """Where paint or its neighbours are finer than a texture; lists are by level."""

    below: list[Int64s]  # paint in leaves
    added: list[Int64s]  # paint where the texture has no cell
    refined: list[Int64s]  # neighbours in leaves or kept nodes
    stored: list[Int64s]  # neighbours that are cells
    absent: list[Int64s]  # neighbours of paint in leaves, where the texture has no cell
    leaves: list[tuple[int, Int64s]]  # the leaves above paint and neighbours: levels and codes


def find_finer(
    tree: Octree, paint: Sequence[Paint], is_skirt: Bools, shallowest: int, is_all_painted: bool
) -> Finer:
    """Find where paint or its neighbours are finer than a tree, whose largest leaves are ``shallowest``."""
    finer = Finer([], [], [], [], [], [])
    for level, each in enumerate(paint):
        where = locate(tree, each.codes, level)
        is_missing = where.levels < level
        in_leaf = is_missing & where.is_leaf
        below = each.codes[in_leaf]
        finer.leaves.extend(_leaves_above(below, where.of(in_leaf), level))
        refined = stored = absent = np.empty(0, np.int64)
        if each.codes.size and shallowest < level:
            around = boundary(each.codes, level)
            where_around = locate(tree, around, level)
            flags = tree.arrays.flags[where_around.cells]
            is_old = where_around.is_leaf & is_skirt[where_around.cells]  # see `with_old_skirts`
            is_refined = (
                (where_around.levels < level) & (where_around.is_leaf | (flags & KEPT != 0)) & ~is_old
            )
            refined = around[is_refined]
            stored = around[(where_around.levels == level) & ~is_old]
            if is_all_painted:
                is_absent = (where_around.levels < level - 1) & ~where_around.is_leaf & (flags & KEPT == 0)
                absent = around[is_absent & near(around, below, level)]
            in_leaf = is_refined & where_around.is_leaf
            finer.leaves.extend(_leaves_above(around[in_leaf], where_around.of(in_leaf), level))
        finer.below.append(below)
        finer.added.append(each.codes[is_missing & ~where.is_leaf])
        finer.refined.append(refined)
        finer.stored.append(stored)
        finer.absent.append(absent)
    return finer


def _leaves_above(codes: Int64s, where: Located, level: int) -> list[tuple[int, Int64s]]:
    """Return the leaves above cells of a level: levels and codes."""
    return [
        (top, distinct(codes[where.levels == top] >> 3 * (level - top)))
        for top in np.flatnonzero(np.bincount(where.levels)).tolist()
    ]


def doubted_leaves(tree: Octree, paint: Sequence[Paint], is_skirt: Bools) -> list[tuple[int, Int64s]]:
    """Return the leaves near paint, by level, that ``resize`` may have made off the surface.

    Their nodes have more than four equal leaves, in or next to kept nodes with paint; see `on_kept`.
    """
    codes = np.empty(0, np.int64)
    doubted: list[tuple[int, Int64s]] = []
    painted = with_all_above([each.codes for each in paint])
    walk = islice(enumerate(tree.walk()), 1, None)
    for (deeper, (below, is_node)), above in zip(walk, painted, strict=False):
        where = locate(tree, above, deeper - 1)
        is_kept = (where.levels == deeper - 1) & (tree.arrays.flags[where.cells] & KEPT != 0)
        codes = distinct(np.concatenate([codes, with_boundary(above[is_kept], deeper - 1)]))
        where = locate(tree, codes, deeper - 1)
        children, starts = all_children(tree, where.nodes[(where.levels == deeper - 1) & ~where.is_leaf])
        if not children.size:
            codes = codes[:0]
            continue
        kinds = tree.arrays.areas[children].astype(np.int64) << 8 | tree.arrays.flags[children] & FACING_FLAGS
        counts = np.diff(starts, append=children.size)
        at = children - tree.arrays.level_cells[deeper]
        least, most = np.where(is_node[at], 1 << 16, kinds), np.where(is_node[at], -1, kinds)
        is_filled = np.minimum.reduceat(least, starts) == np.maximum.reduceat(most, starts)
        is_filled = np.repeat(is_filled & (counts > 4), counts) & ~is_node[at] & ~is_skirt[children]
        if is_filled.any():
            doubted.append((deeper, below[at[is_filled]]))
        codes = below[at]
    return doubted


def skirt_of(outer: Int64s, painted: Sequence[Int64s], ring: Int64s, met: Int64s, level: int) -> Int64s:
    """Return the cells off the surface, next to paint, whose neighbours are all paint or its boundary."""
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
    """Return the ``absent`` cells whose cell of level ``top`` has no surface in it or next to it.

    Splines reach half a cell beyond leaves: one stored cell there would hide the others.
    """
    shift = 3 * (level - top)
    tops = distinct(absent >> shift)
    outer = met[near(met >> shift, tops, top)]
    outer = outer[~among(outer, ring) & ~is_within(outer, painted, level)]
    taken = distinct(with_boundary(outer, level) >> shift)
    free = tops[~among(tops, taken) & ~are_adjacent(tops, unraised, top)]
    return absent[among(absent >> shift, free)]


def are_next_to_larger(codes: Int64s, tree: Octree, tops: Sequence[Int64s], level: int) -> Bools:
    """Return which cells (n,) of a level adjoin larger leaves of a tree other than ``tops``, by level."""
    around = boundary(codes, level)
    where = locate(tree, around, level)
    around = around[where.is_leaf & (where.levels < level)]
    around = around[~is_within(around, tops[:level], level)]
    return near(codes, around, level)


def are_next_to_old(
    codes: Int64s,
    level: int,
    tree: Octree,
    above: Sequence[Int64s],
    tops: Sequence[Int64s],
    bare: Sequence[Int64s],
) -> Bools:
    """Return which cells (n,) lie in or next to painted nodes whose coefficient stays; see `on_kept`.

    Such nodes are kept already, or are the raised ``tops``, by level.
    """
    are_next = np.zeros(codes.size, np.bool_)
    for at, nodes in enumerate(above[:level] if codes.size else []):
        where = locate(tree, nodes, at)
        is_kept = (where.levels == at) & (tree.arrays.flags[where.cells] & KEPT != 0)
        nodes = nodes[is_kept | among(nodes, tops[at])]
        are_next |= near(codes >> 3 * (level - at), nodes[are_adjacent(nodes, bare, at)], at)
    return are_next


def bare_surface(
    tree: Octree,
    is_skirt: Bools,
    paint: Sequence[Paint],
    above: Sequence[Int64s],
    tops: Sequence[Int64s],
    met: SurfaceCells,
) -> tuple[list[Int64s], list[Int64s]]:
    """Return the unpainted surface, by level: leaves other than the raised ``tops``, and all cells."""
    painted = [each.codes for each in paint]
    leaves, _ = bare_leaves(tree, paint, is_skirt)
    unraised = [codes[~among(codes, tops[level])] for level, codes in enumerate(leaves)]
    bare = [*unraised, *[np.empty(0, np.int64)] * (len(met.codes) - len(unraised))]
    for level, codes in enumerate(met.codes):
        inside = codes[is_within(codes >> 3, tops[:level], level - 1)] if level else codes[:0]
        is_bare = ~among(inside, above[level]) & ~is_within(inside, painted, level)
        painted_places = np.flatnonzero(among(inside, painted[level]))
        start = int(met.tree.arrays.level_cells[level]) if codes.size else 0  # nothing met: no such level
        at = np.searchsorted(codes, inside[painted_places]) + start
        flags = paint[level].flags[np.searchsorted(painted[level], inside[painted_places])]
        is_bare[painted_places] = leave_bare(met.tree.arrays.flags[at], flags)
        bare[level] = distinct(np.concatenate([bare[level], inside[is_bare]]))
    return unraised, bare


def free_leaves(
    tree: Octree,
    paint: Sequence[Paint],
    tops: Sequence[Int64s],
    bare: Sequence[Int64s],
    coarsest: int,
    hiding: float,
) -> list[Int64s]:
    """Return the raised leaves, of ``tops`` by level, that keep no coefficient as nodes.

    Paint hides all surface within two cells of them, and of the cells above them that the field reads. The
    largest have level ``coarsest``.
    """
    none = np.empty(0, np.int64)
    shown = [[none, *bare[level : level + 1]] for level in range(len(tops))]
    for level, each in enumerate(paint[: len(tops)]):
        shown[level].append(each.codes[each.coverage < hiding])
    visible = [distinct(np.concatenate(codes)) for codes in shown]
    held, freed = none, []
    for level, codes in enumerate(with_all_above(tops)):
        is_held = among(codes >> 3, held)
        if level >= coarsest and codes.size:
            around = with_boundary(codes, level)
            where = locate(tree, around, level)
            is_read = where.is_leaf | (tree.arrays.flags[where.cells] & KEPT != 0)
            read = around[(where.levels == level) & is_read]
            around = around[are_adjacent(around, visible, level)]
            is_held |= near(codes, read, level) & near(codes, around, level)
        held = codes[is_held]
        freed.append(tops[level][~among(tops[level], held)])
    return freed


def bare_leaves(tree: Octree, paint: Sequence[Paint], is_skirt: Bools) -> tuple[list[Int64s], list[Int64s]]:
    """Return the leaves with unpainted surface, and the skirts, by level."""
    bare, skirts = [], []
    for level, (codes, is_node) in enumerate(tree.walk()):
        span = slice(*tree.arrays.level_cells[level : level + 2].tolist())
        flags = tree.arrays.flags[span]
        skirts.append(codes[~is_node & is_skirt[span]])
        is_bare = ~is_node & ~is_skirt[span]
        for above, each in enumerate(paint[: level + 1]):
            if each.codes.size:
                at = indices_in(codes >> 3 * (level - above), each.codes)
                is_painted = at >= 0
                is_bare[is_painted] &= leave_bare(flags[is_painted], each.flags[at[is_painted]])
        bare.append(codes[is_bare])
    return bare, skirts


def with_old_skirts(
    tree: Octree, paint: Sequence[Paint], bare: Sequence[Int64s], skirts: Sequence[Int64s], executor: Executor
) -> list[Paint]:
    """Add the tree's skirts, by level, next to paint whose neighbours in ``bare`` all adjoin paint."""
    extended = list(paint)
    painted = _on_surface(paint, skirts) if skirts else []
    for level, skirt in enumerate(skirts):
        if not skirt.size:
            continue
        skirt = skirt[~among(skirt, paint[level].codes) & touch(skirt, painted, level, refined=True)]
        if skirt.size:
            around = boundary(skirt, level)
            far = [codes[among_at(codes, at, around, level)] for at, codes in enumerate(bare)]
            far = [codes[~touch(codes, painted, at)] for at, codes in enumerate(far)]
            added = skirt_paint(skirt, level, executor, paint_at(paint, around, level))
            extended[level] = joined(extended[level], _unseen(tree, added, far, level))
    return extended


def _unseen(tree: Octree, skirt: Paint, far: Sequence[Int64s], level: int) -> Paint:
    """Remove the paint of a skirt that would show in bare leaves ``far`` from paint, listed by level.

    Next to leaves with one facing only, paint of the opposite facing stays.
    """
    adjoins = are_adjacent(skirt.codes, far, level)
    chosen = ~adjoins
    for bit in np.unique(skirt.flags[adjoins] & np.uint8(FACING_FLAGS)).tolist():
        if bit.bit_count() == 1:
            opposite = bit << 1 if bit & POSITIVE_FACINGS else bit >> 1
            flags = [tree.arrays.flags[locate(tree, codes, at).cells] for at, codes in enumerate(far)]
            seeing = [codes[each & FACING_FLAGS != opposite] for codes, each in zip(far, flags, strict=True)]
            has_bit = adjoins & (skirt.flags & FACING_FLAGS == bit)
            chosen[has_bit] = ~are_adjacent(skirt.codes[has_bit], seeing, level)
    skirt.coverage[adjoins] = 0.0
    skirt.flags[adjoins] |= np.uint8(SPLIT)
    return skirt.of(chosen)


def on_kept(
    tree: Octree, paint: Sequence[Paint], bare: Sequence[Int64s], skirts: Sequence[Int64s], executor: Executor
) -> tuple[Int64s, Float32s, Float32s]:
    """Return the rows of kept nodes without ``bare`` neighbours, and the paint in or next to them.

    The field reads their coefficients only off the surface, and from neighbours at most.
    """
    on_levels = [(np.empty(0, np.int64), paint[0].values[:0], paint[0].coverage[:0])]
    above = with_all_above([each.codes for each in paint]) if tree.kept.cells.size else []
    leaves = _on_surface(paint, skirts) if above else []
    for level, painted in enumerate(above):
        ends = tree.arrays.level_cells[level : level + 2]
        first, end = np.searchsorted(tree.kept.cells, ends).tolist()  # rows of the level's kept nodes
        if first == end:
            continue
        codes = tree.level_codes(level)[tree.kept.cells[first:end].astype(np.int64) - ends[0]]
        chosen = among(codes, painted) | touch(codes, leaves, level, refined=True)
        chosen[chosen] = ~are_adjacent(codes[chosen], bare, level)
        inside = paint_at(paint, codes[chosen], level)
        off = codes[chosen & ~among(codes, painted)]
        outside = skirt_paint(off, level, executor, paint_at(paint, boundary(off, level), level))
        in_or_next = joined(inside, outside)
        on_levels.append((np.flatnonzero(chosen) + first, in_or_next.values, in_or_next.coverage))
    rows, values, coverage = (np.concatenate(column) for column in zip(*on_levels, strict=True))
    return rows, values, coverage


def _on_surface(paint: Sequence[Paint], skirts: Sequence[Int64s]) -> list[Int64s]:
    """Return the painted cells that are no skirts, by level."""
    return [each.codes[~among(each.codes, skirt)] for each, skirt in zip(paint, skirts, strict=False)]


def skirt_paint(skirt: Int64s, level: int, executor: Executor, around: Paint) -> Paint:
    """Return the paint of a skirt: the mean of the paint next to it."""
    if not skirt.size:
        return around.of(slice(0))
    paint = Paint(
        skirt,
        np.zeros((skirt.size, around.values.shape[1]), np.float32),
        np.zeros(skirt.size, np.float32),
        np.zeros(skirt.size, np.int64),
        np.zeros(skirt.size, np.uint8),
    )
    parts = [paint.of(slice(begin, begin + _BLOCK)) for begin in range(0, skirt.size, _BLOCK)]
    with sharing(executor) as pool:
        list(ordered_map(pool, lambda part: _average_around(part, level, around), parts))
    return paint


@kernel
def _average_around(skirt: Paint, level: int, paint: Paint) -> None:
    """Set cells to the mean of the paint next to them."""
    components = paint.values.shape[1]
    sums = np.empty(components, np.float64)
    nearest = np.zeros(64, np.int64)  # the last row of paint found for each block of 4³ in reach
    around = np.empty((10, 10, 10), np.int64)  # rows of paint in the block and next to it, or −1
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
        coverage, n_around = 0.0, 0
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
                    n_around += 1
                    skirt.cells[n] = paint.cells[at]
                    skirt.flags[n] |= paint.flags[at]
        for component in range(components):
            skirt.values[n, component] = sums[component] / max(coverage, 1e-30)
        skirt.coverage[n] = coverage / max(n_around, 1)
