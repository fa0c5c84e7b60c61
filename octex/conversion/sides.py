"""Leaves that show each side of a surface something of its own.

A leaf is fitted together with all leaves around it. Where some of them face another way, as in a wall that is
thinner than a few cells or along a crease, its value suits lookups that see all of them, but not those that
know their normal and see their own side alone. Its rows, one for each facing, are fitted to those: to what is
looked up with the samples' own normals. Leaves whose rows then hold what they hold themselves need none.
"""

from __future__ import annotations

from concurrent.futures import Executor

import numpy as np

from octex.arrays import Bools, bit_counts
from octex.conversion.facings import face_opposite, has_opposite, kinds_around
from octex.conversion.fit import Fitter
from octex.conversion.numbering import Leaves
from octex.conversion.prune import Channels
from octex.conversion.samples import UNIT, Samples, sample_points
from octex.editing.split import split_in_vain, with_split, without_split
from octex.field.field import Field
from octex.parallel import ordered_map, sharing
from octex.texture import OctreeTexture
from octex.tree.layout import FACING_FLAGS, SPLIT
from octex.tree.octree import Octree

#: Leaves that have less of the weight of a lookup are left as they are.
_LEAST_WEIGHT = 0.03
#: Samples looked up at once.
_BLOCK = 1 << 16
#: Finest cells looked at at once, and levels above them whose facings are looked at first.
_RUN, _COARSER = 1 << 17, 2


def with_sides(fitter: Fitter, tree: Octree, means: Channels, values: Channels) -> tuple[Octree, Channels]:
    """Return a tree and its channels with rows for leaves that lookups with normals want other values of.

    ``means`` and the fitted ``values`` hold the same in nodes and rows; the latter's cells are kept.
    """
    samples = fitter.samples
    leaves = Leaves.of(tree, samples)
    with sharing(fitter.executor) as threads:
        chosen = _in_sight(tree, leaves, samples, threads)
    if not chosen.any():
        return tree, values
    whole = np.sort(leaves.numbers_of(chosen))
    whole = whole[tree.arrays.flags[whole] & SPLIT == 0]
    tried = OctreeTexture(tree, means, UNIT, np.zeros((2, 3)))
    tried = with_split(tried, whole, tree.arrays.flags[whole] & np.uint8(FACING_FLAGS), {})
    start = {name: channel._replace(values=values[name].values) for name, channel in tried.channels.items()}
    finest = chosen
    if leaves.cells.size:
        own = np.repeat(chosen, np.diff(leaves.firsts))
        finest = np.logical_or.reduceat(own, samples.firsts[:-1])
    rows = leaves.rows_of(tried.tree, chosen)
    found = fitter.fit_rows(tried.tree, start, samples.of(np.flatnonzero(finest)), rows)
    made = OctreeTexture(tried.tree, found, UNIT, tried.bounds)
    made = without_split(made, split_in_vain(made, whole))
    return made.tree, made.channels


def _in_sight(tree: Octree, leaves: Leaves, samples: Samples, executor: Executor) -> Bools:
    """Say which leaves, in order, weigh where lookups with normals find something else than others."""
    field, depth, count = Field(tree), samples.depth, len(leaves.firsts) - 1
    owners = np.repeat(tree.split.cells, bit_counts(tree.split.facings)).astype(np.int64)
    reached = np.zeros(tree.n_cells, np.bool_)  # threads write nothing but True
    level = max(depth - _COARSER, 0)
    coarse = tree.truncated(min(level, tree.max_depth)).arrays

    def reach(first: int) -> None:
        codes = samples.codes[first : first + _RUN]
        # Mostly all that is around a coarser cell faces alike: then so does what is around those in it.
        above = codes >> 3 * (depth - level)
        starts = np.flatnonzero(np.diff(above, prepend=-1))
        beside = face_opposite(kinds_around(coarse, above[starts], level))
        cells = np.flatnonzero(np.repeat(beside, np.diff(starts, append=codes.size))) + first
        around = kinds_around(tree.arrays, samples.codes[cells], depth)
        beside = face_opposite(around)
        cells, around = cells[beside], around[beside]
        mixed, counts = samples.rows(cells), samples.firsts[cells + 1] - samples.firsts[cells]
        mixed = mixed[has_opposite(samples.normals[mixed], np.repeat(around, counts))]
        for begin in range(0, mixed.size, _BLOCK):
            some = mixed[begin : begin + _BLOCK]
            normals = samples.normals[some].astype(np.float32)
            for taps in field.batches(sample_points(samples, some, UNIT), UNIT, normals=normals):
                used = slice(0, taps.starts[-1])
                rows = taps.rows[used][taps.weights[used] >= _LEAST_WEIGHT].astype(np.int64)
                in_table = rows >= tree.n_cells
                rows[in_table] = owners[rows[in_table] - tree.n_cells]
                reached[rows] = True

    for _ in ordered_map(executor, reach, range(0, samples.codes.size, _RUN)):
        pass
    order = leaves.numbers(0, count)
    found: Bools = reached[order] & (tree.arrays.flags[order] & FACING_FLAGS > 0)
    return found
