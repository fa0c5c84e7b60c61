"""Averages after an edit: what changes in leaves changes the means of all cells above them.

A fitted leaf holds a coefficient, not a mean. What the mean of a node differs by from that of its children's
values, its *residual*, is kept for the part that is not painted, and taken from the paint for the part that
is: so averages stay those of the source where nothing changed, and become those of the paint where all did.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.channels import ChannelFormat, decode
from octex.tree.edit import children_of, first_children, locate, nodes_by_level
from octex.tree.layout import AREA_ONE, AREA_STEPS
from octex.tree.octree import Octree, distinct

Int64s = npt.NDArray[np.int64]
Float32s = npt.NDArray[np.float32]
Float64s = npt.NDArray[np.float64]

#: Areas in cell faces by their codes; contacts weigh next to nothing.
_AREAS = 2.0 ** ((np.arange(256) - AREA_ONE) / AREA_STEPS)
_AREAS[0] = 2.0**-30


def residuals(
    tree: Octree, values: npt.NDArray[Any], form: ChannelFormat, coverage: npt.NDArray[Any] | None = None
) -> Float32s:
    """Return what each node's value differs by from the mean of its children's values; zeros for leaves.

    values (cells, components) as stored; children weigh by area, and by ``coverage`` (cells,) in 0 … 1
    """
    found = np.zeros(values.shape, np.float32)
    first = tree.arrays.level_cells
    own = decode(values, form.space).astype(np.float64)
    shares = _AREAS[tree.arrays.areas]
    if coverage is not None:
        shares = shares * np.maximum(coverage, 1e-9)
    for level, (_, is_node) in enumerate(tree.walk()):
        nodes = np.flatnonzero(is_node) + int(first[level])
        if nodes.size and level < tree.max_depth:
            starts = first_children(tree, level)
            below = slice(int(first[level + 1]), int(first[level + 2]))
            part = shares[below, None]
            sums = np.add.reduceat(np.hstack([own[below] * part, part]), starts - first[level + 1], axis=0)
            found[nodes] = own[nodes] - sums[:, :-1] / sums[:, -1:]
    return found


def add_up_areas(
    tree: Octree,
    is_new: npt.NDArray[np.bool_],
    areas: npt.NDArray[np.uint8],
) -> None:
    """Give nodes above new cells the areas of all their children, in place."""
    first = tree.arrays.level_cells
    above = is_new.copy()
    nodes_of = nodes_by_level(tree)
    for level in range(tree.max_depth - 1, -1, -1):
        starts = first_children(tree, level) - first[level + 1]
        if not starts.size:
            continue
        below = slice(int(first[level + 1]), int(first[level + 2]))
        changed = np.logical_or.reduceat(above[below], starts)
        nodes = nodes_of[level][changed]
        above[nodes] = True
        sums = np.add.reduceat(np.where(areas[below] > 0, _AREAS[areas[below]], 0.0), starts)[changed] / 4
        coded = np.rint(AREA_STEPS * np.log2(np.maximum(sums, 1e-30)) + AREA_ONE)
        areas[nodes] = np.where(sums > 0, np.clip(coded, 1, 255), 0)


def updated_averages(
    tree: Octree,
    before: npt.NDArray[Any],
    after: npt.NDArray[Any],
    form: ChannelFormat,
    painted: Int64s,
    coverage: Float32s,
    codes: Sequence[Int64s],
    paint_residuals: Float32s,
    has_average: npt.NDArray[np.bool_],
) -> tuple[Int64s, Float64s]:
    """Return the nodes above painted leaves, and their new values, decoded.

    before, after     (cells, components), as stored: before and after leaves were painted
    painted, coverage leaves, ascending, and 0 … 1 how much of each
    codes             the Morton codes of these leaves, level by level
    paint_residuals   (cells, components) of the paint's own nodes, in this tree; zeros elsewhere
    has_average       (cells,) nodes whose value before was an average; of others it is made anew
    """
    part = np.zeros(tree.n_cells, np.float32)
    part[painted] = coverage
    cells, values = [np.empty(0, np.int64)], [np.empty((0, after.shape[1]))]
    below = np.empty(0, np.int64)  # nodes of the level below, as codes
    for level in range(tree.max_depth - 1, -1, -1):
        leaves = codes[level + 1] if level + 1 < len(codes) else np.empty(0, np.int64)
        above = distinct(np.concatenate([below, leaves]) >> 3)
        if not above.size:
            continue
        where = locate(tree, above, level)
        nodes = where.cells
        firsts, counts = children_of(tree, where.nodes)
        at = np.cumsum(counts) - counts
        children = np.repeat(firsts - at, counts) + np.arange(counts.sum())
        shares = _AREAS[tree.arrays.areas[children]]
        new, old = (
            decode(after[children], form.space).astype(np.float64),
            decode(before[children], form.space),
        )
        known = np.minimum(np.searchsorted(cells[-1], children), max(cells[-1].size - 1, 0))
        if cells[-1].size:  # more precise than what is stored
            hit = cells[-1][known] == children
            new[hit] = values[-1][known[hit]]
        totals = np.add.reduceat(shares, at)
        mean = np.add.reduceat(new * shares[:, None], at, axis=0) / totals[:, None]
        old_mean = np.add.reduceat(old * shares[:, None], at, axis=0) / totals[:, None]
        covered = np.add.reduceat(shares * part[children], at) / totals
        residual = decode(before[nodes], form.space) - old_mean
        residual[~has_average[nodes]] = 0.0
        mean += residual * (1.0 - covered[:, None]) + paint_residuals[nodes] * covered[:, None]
        part[nodes] = covered
        below = above
        cells.append(nodes)
        values.append(mean)
    return np.concatenate(cells), np.concatenate(values)
