"""Paint on kept coefficients: those that nothing but paint is refined from (paper 4.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.painting.cells import SKIRT, Paint, boundary, is_within
from octex.tree.edit import among
from octex.tree.layout import FACING_FLAGS
from octex.tree.octree import Octree, distinct

Int64s = npt.NDArray[np.int64]
Float32s = npt.NDArray[np.float32]


class OnKept(NamedTuple):
    """Paint on kept coefficients."""

    rows: Int64s  # (n,)   of the kept table, ascending
    values: Float32s  # (n, components)   decoded
    coverage: Float32s  # (n,)   0 … 1


def on_kept(tree: Octree, paint: Sequence[Paint]) -> OnKept:
    """Return the paint on kept nodes around which all of the surface is painted, in all its facings.

    It is the mean of the paint in them. The field reads their coefficients in cells off the surface, and from
    the cells beside them at most: nothing that is not painted depends on them.
    """
    components = paint[0].values.shape[1]
    rows, values = [np.empty(0, np.int64)], [np.empty((0, components + 1))]
    codes_above: list[Int64s] = []  # painted cells, or cells above them, by level
    above = np.empty(0, np.int64)
    for each in reversed(paint):
        above = distinct(np.concatenate([above >> 3, each.codes]))
        codes_above.insert(0, above)
    if tree.kept.cells.size:
        bare = _bare(tree, paint)
    for level, painted in enumerate(codes_above if tree.kept.cells.size else ()):
        own = slice(*np.searchsorted(tree.kept.cells, tree.arrays.level_cells[level : level + 2]).tolist())
        if own.start == own.stop:
            continue
        first = int(tree.arrays.level_cells[level])
        codes = tree.level_codes(level)[tree.kept.cells[own].astype(np.int64) - first]
        chosen = among(codes, painted)
        chosen[chosen] = ~_beside(codes[chosen], bare, level)
        codes = codes[chosen]
        sums = np.zeros((codes.size, components + 2))
        for below in range(level, len(paint)):
            inside = paint[below].codes >> 3 * (below - level)
            there = among(inside, codes)
            coverage = paint[below].coverage[there, None]
            parts = np.hstack([paint[below].values[there] * coverage, coverage, np.ones_like(coverage)])
            np.add.at(sums, np.searchsorted(codes, inside[there]), parts * 4.0 ** (level - below))
        rows.append(np.flatnonzero(chosen) + own.start)
        means = sums[:, :-2] / np.maximum(sums[:, -2:-1], 1e-30)
        values.append(np.hstack([means, sums[:, -2:-1] / np.maximum(sums[:, -1:], 1e-30)]))
    found = np.concatenate(values).astype(np.float32)
    return OnKept(np.concatenate(rows), found[:, :-1], found[:, -1])


def _bare(tree: Octree, paint: Sequence[Paint]) -> list[Int64s]:
    """Return leaves that the surface is in and not all of it painted, by level."""
    found = []
    for level, (codes, is_node) in enumerate(tree.walk()):
        here = slice(*tree.arrays.level_cells[level : level + 2].tolist())
        facings = tree.arrays.flags[here] & np.uint8(FACING_FLAGS)
        is_bare = ~is_node & (tree.arrays.areas[here] != SKIRT)
        if level < len(paint):
            there = among(codes, paint[level].codes)
            own = paint[level].facings[np.searchsorted(paint[level].codes, codes[there])]
            is_bare[there] &= facings[there] & ~own != 0
        found.append(codes[is_bare])
    return found


def _beside(codes: Int64s, leaves: Sequence[Int64s], level: int) -> npt.NDArray[np.bool_]:
    """Say which cells (n,) of a level have some of leaves, given by level, in or beside them."""
    near = distinct(np.concatenate([codes, boundary(codes, level)]))
    below = np.empty(0, np.int64)
    for deeper in range(len(leaves) - 1, level - 1, -1):
        own = leaves[deeper] >> 3 * (deeper - level)
        below = np.concatenate([below, own[among(own, near)]])
    taken = near[is_within(near, [*leaves[:level], distinct(below)], level)]
    return among(codes, taken) | among(codes, boundary(taken, level))
