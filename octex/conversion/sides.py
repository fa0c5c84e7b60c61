"""Leaves that show each side of a surface something of its own.

A leaf is fitted together with all leaves around it. Where some of them face another way, as in a wall that is
thinner than a few cells or along a crease, its value suits lookups that see all of them, but not those that
know their normal and see their own side alone. Its rows, one for each facing, are fitted to those: to what is
looked up with the samples' own normals. Leaves whose rows then hold what they hold themselves need none.
"""

from __future__ import annotations

from concurrent.futures import Executor

import numpy as np

from octex.arrays import Bools, Int8s, Int64s, Uint64s, bit_counts
from octex.conversion.evaluator import NO_KEPT, SPLIT_KIND, is_refined, kind_of
from octex.conversion.fit import Fitter
from octex.conversion.numbering import Leaves
from octex.conversion.prune import Channels
from octex.conversion.samples import UNIT, Samples, sample_points
from octex.editing.split import split_in_vain, with_split, without_split
from octex.field.blend import listed
from octex.field.field import Field
from octex.field.splines import QUADRATIC
from octex.field.windows import BEGIN, INSIDE, Way, cell_at, follow, new_walk
from octex.jit import kernel, trailing_zeros
from octex.parallel import ordered_map, sharing
from octex.texture import OctreeTexture
from octex.tree.layout import FACING_FLAGS, MAX_DEPTH, SPLIT, TreeArrays
from octex.tree.morton import decode
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
        beside = _face_opposite(_kinds_around(coarse, above[starts], level))
        cells = np.flatnonzero(np.repeat(beside, np.diff(starts, append=codes.size))) + first
        around = _kinds_around(tree.arrays, samples.codes[cells], depth)
        beside = _face_opposite(around)
        cells, around = cells[beside], around[beside]
        mixed, counts = samples.rows(cells), samples.firsts[cells + 1] - samples.firsts[cells]
        mixed = mixed[_has_opposite(samples.normals[mixed], np.repeat(around, counts))]
        for begin in range(0, mixed.size, _BLOCK):
            some = mixed[begin : begin + _BLOCK]
            normals = samples.normals[some].astype(np.float32)
            for each in field.runs(sample_points(samples, some, UNIT), UNIT, normals=normals):
                taps = listed(each, 1.0)
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


@kernel
def _kinds_around(arrays: TreeArrays, codes: Int64s, depth: int) -> Uint64s:
    """Return the kinds of all leaves that lookups in some cells of a level (n,), which ascend, may read."""
    walk, kinds = new_walk(), np.empty(codes.size, np.uint64)
    way = Way(arrays, NO_KEPT, walk, QUADRATIC, 2, 1, False)
    of_levels = np.zeros(MAX_DEPTH + 1, np.uint64)
    shift = MAX_DEPTH - depth
    for n in range(codes.size):
        i, j, k = decode(codes[n])
        walk.previous[5] = MAX_DEPTH  # becomes the last level whose window is that of the cell before
        last = follow(way, i << shift, j << shift, k << shift)
        for level in range(walk.previous[5] + 1, last + 1):
            found = of_levels[level - 1] if is_refined(walk, level) else np.uint64(0)
            inside = INSIDE[0, walk.levels[level, BEGIN], 0]
            leaves = (walk.cells[level, 0] ^ walk.nodes[level, 0]) & inside
            while leaves != 0:
                cell = cell_at(arrays, walk, level, 0, trailing_zeros(leaves))
                leaves &= leaves - np.uint64(1)
                found |= kind_of(arrays.flags[cell])
            of_levels[level] = found
        kinds[n] = of_levels[last]
    return kinds


def _face_opposite(kinds: Uint64s) -> Bools:
    """Say whether any of some kinds (n,) face both ways along an axis, one by itself or two, or are split."""
    found = kinds & SPLIT_KIND > 0
    for axis in range(3):
        found |= (kinds & _HAVING[2 * axis] > 0) & (kinds & _HAVING[2 * axis + 1] > 0)
    return found


#: By the number of a facing: the kinds of cells that have it.
_HAVING = np.array([sum(1 << kind for kind in range(64) if kind >> f & 1) for f in range(6)], np.uint64)


def _has_opposite(normals: Int8s, kinds: Uint64s) -> Bools:
    """Say whether something of some kinds (n,) is split, or faces away from what has normals (n, 3)."""
    opposite: Bools = (kinds & _OPPOSITE[_facings_of(normals)]) != 0
    return opposite


def _facings_of(normals: Int8s) -> Int64s:
    """Return the numbers of the facings that are nearest to normals (n, 3)."""
    normals = normals.astype(np.int16)
    axes = np.abs(normals).argmax(axis=1)
    found: Int64s = 2 * axes + (np.take_along_axis(normals, axes[:, None], 1)[:, 0] < 0)
    return found


#: By the number of a facing: the kinds of cells that have the opposite one and not this, and of split ones.
_OPPOSITE = np.array(
    [1 | sum(1 << kind for kind in range(64) if kind >> (f ^ 1) & ~(kind >> f) & 1) for f in range(6)],
    np.uint64,
)
