"""Leaf values fitted to the source: a spline smooths, so that smoothed averages would look dull.

The field is linear in the leaf values, so the best ones solve a least-squares problem over the samples (see
`samples` and `solve`). It is solved brick by brick: a run of leaves in Morton order with a halo around it.
Leaves beyond the halo stay at their means. A brick's result depends on nothing else, so the whole does not
depend on threads.

A leaf is fitted together with all leaves around it. Next to leaves that face another way, as in a thin wall
or along a crease, its value suits lookups without normals, but not lookups with normals. Such leaves are
split: each facing has a row, fitted to lookups with the samples' normals. Rows that equal their leaf are
dropped.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import Executor
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Float32s, Floats, Int32s, Int64s, Uint64s, bit_counts
from octex.channels import CHANNELS, ChannelFormat, decode, encode
from octex.conversion import large
from octex.conversion.evaluator import NO_KEPT, SPLIT_KIND, is_refined, kind_of
from octex.conversion.lookups import CubeLookups, FittedLeaves, Heads, members_of, numbered
from octex.conversion.prune import Channels
from octex.conversion.samples import SHARE_STEPS, UNIT, Samples, nearest_facings, sample_points
from octex.conversion.solve import (
    NO_ROUNDING,
    Equations,
    Rounding,
    approach,
    covered,
    diagonal,
    residuals,
    sweep,
    transpose,
    weigh,
)
from octex.editing.split import split_in_vain, with_split, without_split
from octex.field.blend import joined, listed
from octex.field.field import Field
from octex.field.splines import QUADRATIC
from octex.field.taps import TapList
from octex.field.windows import BEGIN, INSIDE, Way, cell_at, follow, new_walk
from octex.jit import kernel, trailing_zeros
from octex.parallel import Progress, ordered_map, sharing
from octex.texture import Channel, OctreeTexture
from octex.tree.layout import FACING_FLAGS, MAX_DEPTH, SPLIT, TreeArrays
from octex.tree.morton import decode as decode_cell
from octex.tree.octree import Octree, distinct

#: Samples in a brick; each takes about 400 bytes. With half as many a fit takes up to 8 % longer.
BRICK_SAMPLES = 100_000
#: Little work is cut into this many bricks, of at least this many samples.
_BRICKS, _LEAST_SAMPLES = 4, 20_000
#: Most samples in a leaf that it is fitted to. 64 bring nothing.
LEAF_SAMPLES = 8
#: Sweeps over the leaves, back and forth; for 8 bits those after the first two round. One more wins 0.04 dB.
SWEEPS, FREE_SWEEPS = 4, 2
#: Light above 1 by less than this counts as 1: it is rounding.
LEAST_BRIGHT = 2.0**-10
#: Least weight of a sample, however small its coverage.
LEAST_COVERAGE = 2.0**-10
#: A leaf of a smaller weight in a lookup is not split for it.
_LEAST_WEIGHT = 0.03
#: Samples that are looked up at once.
_BLOCK = 1 << 16
#: Finest cells that are tested at once, and the levels above them at which facings are tested first.
_RUN, _COARSER = 1 << 17, 2


class ComponentGroup(NamedTuple):
    """Up to three components that are solved together."""

    columns: slice
    format: ChannelFormat

    def range(self, samples: Samples) -> tuple[float, float]:
        """Return the least and the largest value that a leaf may take: 0 … 1 for light nowhere above 1."""
        space, dtype = self.format.space, self.format.dtype
        if space == "direction":
            return -1.0, 1.0
        if not dtype.startswith("float") or (space == "data" and self.format.name in CHANNELS):
            return 0.0, 1.0
        largest = float(np.finfo(dtype).max)
        if space == "data":
            return -largest, largest
        is_bright = (samples.values[:, self.columns] > 1.0 + LEAST_BRIGHT).any()
        return 0.0, largest if is_bright else 1.0


class FitJob(NamedTuple):
    """The input that all bricks share."""

    field: Field
    channels: list[Channel]  # those of the samples
    samples: Samples
    leaves: FittedLeaves
    heads: Heads | None  # if the leaves are all finest cells
    unfitted: Collection[str]  # channels whose means stay
    is_facing: bool  # whether lookups use the samples' normals
    groups: list[ComponentGroup]
    ranges: list[tuple[float, float]]  # of each group


class SampleLookups(NamedTuple):
    """The samples of a brick and its halo, and the field's taps there."""

    samples: Int64s  # (n,)
    strides: Float32s  # (n,)   the number of samples that each stands for
    starts: Int64s  # (n + 1,)   the first tap of each
    leaves: Int32s  # (taps,)   rows of `cells`
    weights: Float32s  # (taps,)
    cells: Int64s  # (m,)   cell numbers: the brick's, the halo's, the rest
    unknowns: int  # how many of the cells are solved for

    def residuals(
        self, values: Float32s, targets: Float32s, shares: Float32s, components: int, is_light: int
    ) -> Float32s:
        """Return the residuals of values. See `solve.residuals`."""
        taps = self.starts, self.leaves, self.weights
        return residuals(*taps, values, targets, shares, components, is_light)

    def equations(self) -> Equations:
        """List the lookups by unknown."""
        return transpose(self.starts, self.leaves, self.weights, self.unknowns)

    def covered(self, coverage: Float32s) -> SampleLookups:
        """Return the same lookups with cells (m,) weighted by coverage."""
        return self._replace(weights=covered(self.starts, self.leaves, self.weights, coverage))


class Fitter(NamedTuple):
    """Fits the leaves of trees, the samples' finest cells or cells above them, to the samples.

    Colours are fitted on sRGB's curve, light above 1 by ratio, directions as vectors; each sample weighs by
    its alpha. Values stay inside their types' ranges. ``unfitted`` channels keep their values, which still
    weigh the others. The result does not depend on the executor.
    """

    samples: Samples
    executor: Executor
    progress: Progress
    unfitted: Collection[str] = ()

    def fit(self, tree: Octree, channels: Channels, chosen: Bools | None = None) -> Channels:
        """Return channels whose leaves fit the quadratic field to the samples; other cells stay.

        The leaves' values in ``channels``, those of the samples, are means. With ``chosen`` (leaves,), in
        Morton order, only these leaves are fitted, to the samples in them.
        """
        leaves = FittedLeaves.of(tree, self.samples)
        if chosen is not None:
            leaves = leaves.chosen(chosen, tree.n_cells)
        return self._fitted(tree, channels, leaves, is_facing=False)

    def fit_rows(self, tree: Octree, channels: Channels, rows: FittedLeaves) -> Channels:
        """Return channels whose ``rows`` of split leaves fit lookups with normals to the samples in them."""
        return self._fitted(tree, channels, rows, is_facing=True)

    def _fitted(self, tree: Octree, channels: Channels, leaves: FittedLeaves, *, is_facing: bool) -> Channels:
        samples, field, heads = self.samples, Field(tree), None
        if is_facing:
            field.facings  # noqa: B018 (built before threads share it)
        elif field.tiles is not None and not leaves.cells.size:
            heads = Heads.of(field.tiles, samples.codes)
        known = [channels[form.name] for form in samples.channels]
        groups = _groups(samples.channels)
        ranges = [group.range(samples) for group in groups]
        job = FitJob(field, known, samples, leaves, heads, self.unfitted, is_facing, groups, ranges)
        counts = leaves.ends - leaves.firsts
        size = min(max(int(counts.sum()) // _BRICKS, _LEAST_SAMPLES), BRICK_SAMPLES)
        bricks = list(pairwise(_cuts(counts, size, LEAF_SAMPLES)))
        fitted = ordered_map(
            self.executor, partial(_fit_brick, job), bricks, stage="fit", progress=self.progress
        )
        table, first_row = ("split_values", tree.n_cells) if is_facing else ("values", 0)
        stored = [large.copied(getattr(channel, table)) for channel in known]
        for brick, parts in zip(bricks, fitted, strict=True):
            rows = leaves.numbers(*brick) - first_row
            for whole, part in zip(stored, parts, strict=True):
                whole[rows] = part
        new_channels = {
            channel.format.name: channel._replace(**{table: each})  # type: ignore[arg-type]
            for channel, each in zip(known, stored, strict=True)
            if channel.format.name not in self.unfitted
        }
        return {**channels, **new_channels}


def _cuts(counts: Int64s, brick: int, most: int) -> list[int]:
    """Cut leaves with counts (n,) of samples into runs of about ``brick``, ``most`` at most of each leaf."""
    totals, cuts = np.append(0, np.cumsum(np.minimum(counts, most))), [0]
    while cuts[-1] < counts.size:
        end = int(np.searchsorted(totals, totals[cuts[-1]] + brick))
        cuts.append(min(end, counts.size))
    return cuts


def _groups(channels: Sequence[ChannelFormat]) -> list[ComponentGroup]:
    """Group components with equal weights; alpha first, since lookups of the others depend on it."""
    groups: list[ComponentGroup] = []
    end = 0
    for form in channels:
        first, end = end, end + form.components
        is_alike = (
            bool(groups)
            and form.components == 1
            and form.space == "data"
            and groups[-1].format[2:] == form[2:]
            and "alpha" not in (form.name, groups[-1].format.name)
            and end - groups[-1].columns.start <= 3
        )
        if is_alike:
            form, first = groups[-1].format, groups.pop().columns.start
        groups += (ComponentGroup(slice(i, min(i + 3, end)), form) for i in range(first, end, 3))
    return sorted(groups, key=lambda group: group.format.name != "alpha")


def _fit_brick(job: FitJob, brick: tuple[int, int]) -> list[Array]:
    """Fit a run of leaves; return their stored values, by channel."""
    lookups: SampleLookups | CubeLookups
    if job.heads is None:
        lookups = _look_up(job, *brick)
    else:
        lookups = CubeLookups.of(job.samples, job.heads, job.leaves, *brick)
    equations = None
    is_fixed = job.leaves.ranks_of(lookups.cells[: lookups.unknowns]) < 0
    values = _values(job.channels, lookups.cells, job.field.tree.n_cells, is_facing=job.is_facing)
    targets = job.samples.values.take(lookups.samples, axis=0)
    shares = job.samples.shares.take(lookups.samples) * (lookups.strides * np.float32(1 / SHARE_STEPS))
    for group, limits in zip(job.groups, job.ranges, strict=True):
        components = group.columns.stop - group.columns.start
        is_light = int(group.format.space in ("srgb", "linear"))
        wanted = _four(targets[:, group.columns])
        is_even = _is_even(wanted) and _is_even(values[:, group.columns])  # then means are best
        if group.format.name not in job.unfitted and not is_even:
            means = _four(values[:, group.columns])
            fitted = means.copy()
            rows = lookups.residuals(fitted, wanted, shares, components, 0)
            equations = equations or lookups.equations()
            approach(equations, rows, fitted)
            fitted[: lookups.unknowns][is_fixed] = means[: lookups.unknowns][is_fixed]
            rows = lookups.residuals(fitted, wanted, shares, components, is_light)
            if is_light:
                weigh(equations, rows, wanted, shares, components)
            sums, is_flat = diagonal(equations, rows, wanted)
            sums[is_fixed] = 0.0
            is_rounded = group.format.dtype == "uint8"
            to_codes = Rounding.of_bytes(group.format.space) if is_rounded else NO_ROUNDING
            for turn in range(SWEEPS):
                codes = to_codes if turn >= FREE_SWEEPS else NO_ROUNDING
                sweep(equations, rows, sums, is_flat, means, components, *limits, codes, turn % 2, fitted)
            values[:, group.columns] = fitted[:, :components]
        if group.format.name == "alpha":
            coverage = values[:, group.columns.start].copy()
            if (coverage < 1.0).any():
                lookups, equations = lookups.covered(coverage), None
            shares = shares * np.maximum(wanted[:, 0], np.float32(LEAST_COVERAGE))
    values = values[: brick[1] - brick[0]]
    ends = np.cumsum([channel.format.components for channel in job.channels])
    return [
        encode(part, channel.format.dtype, channel.format.space)
        for channel, part in zip(job.channels, np.split(values, ends[:-1], axis=1), strict=True)
    ]


def _look_up(job: FitJob, first: int, end: int) -> SampleLookups:
    """Look the field up at the samples of leaves ``first`` … ``end`` − 1, and of one ring around them."""
    leaves, others = job.leaves, np.empty(0, np.int64)
    ring = leaves.with_samples(np.arange(first, end))
    parts: list[tuple[Int64s, Float32s, TapList]] = []
    for _ in range(2):
        unknowns = end - first + others.size
        members, strides = members_of(leaves.firsts, leaves.ends, ring, LEAF_SAMPLES)
        normals = job.samples.normals[members].astype(np.float32) if job.is_facing else None
        points = sample_points(job.samples, members)
        taps = joined([listed(each) for each in job.field.blocks(points, UNIT, normals)])
        parts.append((members, strides, taps))
        ranks = leaves.ranks_of(taps.rows)
        outside = distinct(taps.rows[(ranks < first) | (ranks >= end)])
        outside = np.setdiff1d(outside, others, assume_unique=True)
        others = np.append(others, outside)
        ranks = leaves.ranks_of(outside)
        ring = leaves.with_samples(ranks[ranks >= 0])
    members, strides = (np.concatenate(each) for each in list(zip(*parts, strict=True))[:2])
    starts, rows, weights = joined([taps for *_, taps in parts])
    numbers = numbered(rows, leaves.ranks_of(rows), first, end, others)
    cells = np.append(leaves.numbers(first, end), others)
    return SampleLookups(members, strides, starts, numbers, weights, cells, unknowns)


def _is_even(rows: Float32s) -> bool:
    """Say whether all rows are equal."""
    return bool((rows[-1:] == rows[:1]).all() and (rows == rows[:1]).all())


def _four(columns: Floats) -> Float32s:
    """Return up to three columns as float32 rows of four."""
    rows = np.zeros((len(columns), 4), np.float32)
    rows[:, : columns.shape[1]] = columns
    return rows


def _values(channels: Sequence[Channel], rows: Int64s, n_cells: int, *, is_facing: bool) -> Float32s:
    """Return the decoded values (rows, components) of cells; numbers beyond are split rows or kept nodes."""
    beyond = np.flatnonzero(rows >= n_cells)
    cells = np.minimum(rows, n_cells - 1) if beyond.size else rows
    values = np.empty((len(rows), sum(channel.format.components for channel in channels)), np.float32)
    end = 0
    for channel in channels:
        start, end = end, end + channel.format.components
        more, space = channel.split_values if is_facing else channel.kept_values, channel.format.space
        values[:, start:end] = decode(channel.values.take(cells, axis=0), space)
        values[beyond, start:end] = decode(more[rows[beyond] - n_cells], space)
    return values


def with_sides(fitter: Fitter, tree: Octree, means: Channels, values: Channels) -> tuple[Octree, Channels]:
    """Split leaves where lookups with normals fit better; return the tree and its channels.

    ``means`` and the fitted ``values`` differ only in leaves, which keep the fitted values.
    """
    samples = fitter.samples
    leaves = FittedLeaves.of(tree, samples)
    with sharing(fitter.executor) as threads:
        chosen = _facing_apart(tree, leaves, samples, threads)
    if not chosen.any():
        return tree, values
    whole = np.sort(leaves.numbers_of(chosen))
    whole = whole[tree.arrays.flags[whole] & SPLIT == 0]
    tried = OctreeTexture(tree, means, UNIT, np.zeros((2, 3)))
    tried = with_split(tried, whole, tree.arrays.flags[whole] & np.uint8(FACING_FLAGS), {})
    start = {name: channel._replace(values=values[name].values) for name, channel in tried.channels.items()}
    fitted = fitter.fit_rows(tried.tree, start, leaves.rows_of(tried.tree, chosen))
    adapted = tried.with_cells(tried.tree, fitted)
    adapted = without_split(adapted, split_in_vain(adapted, whole))
    return adapted.tree, adapted.channels


def _facing_apart(tree: Octree, leaves: FittedLeaves, samples: Samples, executor: Executor) -> Bools:
    """Say which leaves, in order, weigh in lookups that a normal changes."""
    field, depth, count = Field(tree), samples.depth, len(leaves.firsts)
    owners = np.repeat(tree.split.cells, bit_counts(tree.split.facings)).astype(np.int64)
    reached = np.zeros(tree.n_cells, np.bool_)  # threads write nothing but True
    level = max(depth - _COARSER, 0)
    coarse = tree.truncated(min(level, tree.max_depth)).arrays

    def reach(first: int) -> None:
        codes = samples.codes[first : first + _RUN]
        # Mostly all leaves around a coarser cell face the same way: then so do those around cells in it.
        above = codes >> 3 * (depth - level)
        starts = np.flatnonzero(np.diff(above, prepend=-1))
        is_mixed = _face_opposite(_kinds_around(coarse, above[starts], level))
        cells = np.flatnonzero(np.repeat(is_mixed, np.diff(starts, append=codes.size))) + first
        around = _kinds_around(tree.arrays, samples.codes[cells], depth)
        is_mixed = _face_opposite(around)
        cells, around = cells[is_mixed], around[is_mixed]
        mixed, counts = samples.rows(cells), samples.firsts[cells + 1] - samples.firsts[cells]
        facings = nearest_facings(samples.normals[mixed].astype(np.int16))
        mixed = mixed[np.repeat(around, counts) & _OPPOSITE[facings] != 0]
        for begin in range(0, mixed.size, _BLOCK):
            block = mixed[begin : begin + _BLOCK]
            normals = samples.normals[block].astype(np.float32)
            for each in field.blocks(sample_points(samples, block), UNIT, normals):
                taps = listed(each)
                used = slice(0, taps.starts[-1])
                rows = taps.rows[used][taps.weights[used] >= _LEAST_WEIGHT].astype(np.int64)
                in_table = rows >= tree.n_cells
                rows[in_table] = owners[rows[in_table] - tree.n_cells]
                reached[rows] = True

    for _ in ordered_map(executor, reach, range(0, samples.codes.size, _RUN)):
        pass
    order = leaves.numbers(0, count)
    chosen: Bools = reached[order] & (tree.arrays.flags[order] & FACING_FLAGS > 0)
    return chosen


@kernel
def _kinds_around(arrays: TreeArrays, codes: Int64s, depth: int) -> Uint64s:
    """Return the kinds of all leaves that lookups in ascending cells of a level (n,) may read."""
    walk, kinds = new_walk(), np.empty(codes.size, np.uint64)
    way = Way(arrays, NO_KEPT, walk, QUADRATIC, 2, 1, False)
    of_levels = np.zeros(MAX_DEPTH + 1, np.uint64)
    shift = MAX_DEPTH - depth
    for n in range(codes.size):
        i, j, k = decode_cell(codes[n])
        walk.previous[5] = MAX_DEPTH  # becomes the last level whose window is that of the cell before
        last = follow(way, i << shift, j << shift, k << shift)
        for level in range(walk.previous[5] + 1, last + 1):
            around = of_levels[level - 1] if is_refined(walk, level) else np.uint64(0)
            inside = INSIDE[0, walk.levels[level, BEGIN], 0]
            leaves = (walk.cells[level, 0] ^ walk.nodes[level, 0]) & inside
            while leaves != 0:
                cell = cell_at(arrays, walk, level, 0, trailing_zeros(leaves))
                leaves &= leaves - np.uint64(1)
                around |= kind_of(arrays.flags[cell])
            of_levels[level] = around
        kinds[n] = of_levels[last]
    return kinds


def _face_opposite(kinds: Uint64s) -> Bools:
    """Say which sets of kinds (n,) face both ways along an axis, or have a split cell."""
    mixed = kinds & SPLIT_KIND > 0
    for axis in range(3):
        mixed |= (kinds & _HAVING[2 * axis] > 0) & (kinds & _HAVING[2 * axis + 1] > 0)
    return mixed


#: By the number of a facing: the kinds of cells that have it.
_HAVING = np.array([sum(1 << kind for kind in range(64) if kind >> f & 1) for f in range(6)], np.uint64)


#: By the number of a facing: the kinds that have the opposite facing and not this one, and the split kind.
_OPPOSITE = np.array(
    [1 | sum(1 << kind for kind in range(64) if kind >> (f ^ 1) & ~(kind >> f) & 1) for f in range(6)],
    np.uint64,
)
