"""Paint on what only paint is refined from, or beside: kept coefficients (paper 4.2), and skirts."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Int64s
from octex.painting.cells import (
    Paint,
    among_at,
    joined,
    leave_bare,
    paint_at,
    skirt_paint,
    some,
)
from octex.tree.beside import are_beside, boundary, is_within, near, with_boundary
from octex.tree.edit import among, locate, places, with_all_above
from octex.tree.layout import FACING_FLAGS, POSITIVE_FACINGS, SPLIT
from octex.tree.octree import Octree, distinct


class OnKept(NamedTuple):
    """Paint on kept coefficients."""

    rows: Int64s  # (n,)   of the kept table, ascending
    values: Float32s  # (n, components)   decoded
    coverage: Float32s  # (n,)   0 … 1


def on_kept(
    tree: Octree, paint: Sequence[Paint], bare: Sequence[Int64s], is_skirt: Bools, executor: Executor
) -> OnKept:
    """Return the paint on kept nodes around which there are no ``bare`` leaves, given by level.

    It is the mean of the paint in them, or else, where they are refined to beside paint, of that beside them.
    The field reads their coefficients in cells off the surface, and from the cells beside them at most:
    nothing that is not painted depends on them.
    """
    found: list[OnKept] = []
    above = with_all_above([each.codes for each in paint]) if tree.kept.cells.size else []
    leaves = _on_surface(tree, paint, is_skirt) if above else []
    for level, painted in enumerate(above):
        own = slice(*np.searchsorted(tree.kept.cells, tree.arrays.level_cells[level : level + 2]).tolist())
        if own.start == own.stop:
            continue
        first = int(tree.arrays.level_cells[level])
        codes = tree.level_codes(level)[tree.kept.cells[own].astype(np.int64) - first]
        chosen = among(codes, painted) | _touch(codes, leaves, level, refined=True)
        chosen[chosen] = ~are_beside(codes[chosen], bare, level)
        inside = paint_at(paint, codes[chosen], level)
        off = codes[chosen & ~among(codes, painted)]
        beside = skirt_paint(off, level, executor, paint_at(paint, boundary(off, level), level))
        inside = joined(inside, beside)
        found.append(OnKept(np.flatnonzero(chosen) + own.start, inside.values, inside.coverage))
    if not found:
        return OnKept(np.empty(0, np.int64), paint[0].values[:0], paint[0].coverage[:0])
    return OnKept(*(np.concatenate(column) for column in zip(*found, strict=True)))


def with_old_skirts(
    tree: Octree, paint: Sequence[Paint], bare: Sequence[Int64s], is_skirt: Bools, executor: Executor
) -> list[Paint]:
    """Add the skirts of a tree, ``is_skirt`` (cells,), that are beside paint, which lies on leaves.

    Beside them are no ``bare`` leaves, given by level, but such as are beside paint too, or do not see it.
    """
    found = list(paint)
    if not is_skirt.any():
        return found
    painted = _on_surface(tree, paint, is_skirt)
    for level, (codes, is_node) in enumerate(tree.walk()):
        here = slice(*tree.arrays.level_cells[level : level + 2].tolist())
        skirt = codes[~is_node & is_skirt[here]]
        if not skirt.size:
            continue
        skirt = skirt[_are_near(skirt, painted, level) & ~among(skirt, paint[level].codes)]
        skirt = skirt[_touch(skirt, painted, level, refined=True)]
        if skirt.size:
            around = boundary(skirt, level)
            far = [own[among_at(own, at, around, level)] for at, own in enumerate(bare)]
            far = [own[~_touch(own, painted, at)] for at, own in enumerate(far)]
            added = skirt_paint(skirt, level, executor, paint_at(paint, around, level))
            found[level] = joined(found[level], _unseen(tree, added, far, level))
    return found


def _on_surface(tree: Octree, paint: Sequence[Paint], is_skirt: Bools) -> list[Int64s]:
    """Return the cells that have paint and are no skirts, by level."""
    cells = [locate(tree, each.codes, level).cells for level, each in enumerate(paint)]
    return [each.codes[~is_skirt[own]] for each, own in zip(paint, cells, strict=True)]


def _unseen(tree: Octree, skirt: Paint, far: Sequence[Int64s], level: int) -> Paint:
    """Return a skirt's paint without what changes bare leaves ``far`` from paint, given by level.

    Beside leaves that all face one way, paint that faces the opposite way stays, on that facing alone.
    """
    is_beside = are_beside(skirt.codes, far, level)
    chosen = ~is_beside
    for bit in np.unique(skirt.flags[is_beside] & np.uint8(FACING_FLAGS)).tolist():
        if bit.bit_count() == 1:
            opposite = bit << 1 if bit & POSITIVE_FACINGS else bit >> 1
            flags = [tree.arrays.flags[locate(tree, own, at).cells] for at, own in enumerate(far)]
            seeing = [own[each & FACING_FLAGS != opposite] for own, each in zip(far, flags, strict=True)]
            own = is_beside & (skirt.flags & FACING_FLAGS == bit)
            chosen[own] = ~are_beside(skirt.codes[own], seeing, level)
    skirt.coverage[is_beside] = 0.0
    skirt.flags[is_beside] |= np.uint8(SPLIT)
    return some(skirt, chosen)


def _are_near(codes: Int64s, leaves: Sequence[Int64s], level: int) -> Bools:
    """Say at a glance which cells (n,) of a level may reach leaves, given by level: by cells four as wide."""
    top = max(level - 2, 0)
    inside = [own >> 3 * (at - top) for at, own in enumerate(leaves) if at >= top]
    coarse = [*leaves[:top], distinct(np.concatenate(inside))]
    around = [with_boundary(own, at) for at, own in enumerate(coarse)]
    return is_within(codes >> 3 * (level - top), around, top)


def _touch(codes: Int64s, leaves: Sequence[Int64s], level: int, *, refined: bool = False) -> Bools:
    """Say which cells (n,) of a level are in or beside some of leaves, given by level.

    With ``refined`` also those that cells in or beside some are refined from.
    """
    if not codes.size:
        return np.zeros(0, np.bool_)
    around = with_boundary(codes, level)
    found = near(codes, around[is_within(around, leaves[: level + 1], level)], level)
    for at in range(level + 1, len(leaves)):
        reached = with_boundary(leaves[at][among_at(leaves[at], at, around, level)], at)
        for deeper in range(at, level, -1):
            reached = distinct((with_boundary(reached, deeper) if refined else reached) >> 3)
        found |= among(codes, reached)
    return found


def bare_leaves(tree: Octree, paint: Sequence[Paint], is_skirt: Bools) -> list[Int64s]:
    """Return leaves that the surface is in and not all of it painted, by level.

    What lies in larger cells of paint is painted with them.
    """
    found = []
    for level, (codes, is_node) in enumerate(tree.walk()):
        here = slice(*tree.arrays.level_cells[level : level + 2].tolist())
        flags = tree.arrays.flags[here]
        is_bare = ~is_node & ~is_skirt[here]
        for above, each in enumerate(paint[: level + 1]):
            if each.codes.size:
                at = places(codes >> 3 * (level - above), each.codes)
                there = at >= 0
                is_bare[there] &= leave_bare(flags[there], each.flags[at[there]])
        found.append(codes[is_bare])
    return found
