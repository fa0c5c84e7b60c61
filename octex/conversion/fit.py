"""Leaf values fitted to the source: a spline smooths, and averages that it smooths once more are dull.

The field is linear in the leaf values, so the best ones are a least squares over the samples (see `samples`
and `solve`). It is solved brick by brick: a run of leaves in Morton order with a halo around it, found by
following what the lookups touch; leaves beyond the halo stay at their means. A brick's result depends on
nothing else, so that of the whole does not depend on threads.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import Executor
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Float32s, Floats, Int32s, Int64s
from octex.channels import CHANNELS, ChannelFormat, decode, encode
from octex.conversion import large
from octex.conversion.cubes import CubeLookups, Heads
from octex.conversion.numbering import Leaves, Outside, members_of, number
from octex.conversion.prune import Channels
from octex.conversion.samples import SHARE_STEPS, UNIT, Samples, sample_points
from octex.conversion.solve import (
    Codes,
    Equations,
    approach,
    covered,
    diagonal,
    residuals,
    sweep,
    transpose,
    weigh,
)
from octex.field.field import Field
from octex.jit import kernel
from octex.parallel import Progress, ordered_map
from octex.texture.channel import Channel
from octex.tree.octree import Octree

#: Samples in a brick, whose lists take some 400 bytes for each. Half as many take up to 8 % longer.
BRICK_SAMPLES = 100_000
#: Little work is cut into so many bricks, of no fewer samples than this.
_BRICKS, _LEAST_SAMPLES = 4, 20_000
#: Rings of leaves around a brick that are solved with it. Two are not nearer to the source (0.00 dB).
RINGS = 1
#: Samples that one leaf is fitted to at most, of those in it. 64 are not nearer.
LEAF_SAMPLES = 8
#: Sweeps over the leaves, back and forth; for 8 bits those after the first two round. One more wins 0.04 dB.
SWEEPS, FREE_SWEEPS = 4, 2
#: Light by so much above 1 is 1, rounded.
LEAST_BRIGHT = 2.0**-10
#: What samples that nothing covers still weigh.
LEAST_COVERAGE = 2.0**-10


class Group(NamedTuple):
    """Up to three components that are solved together."""

    columns: slice
    format: ChannelFormat

    def range(self, samples: Samples) -> tuple[float, float]:
        """Return the least and the largest value that can be stored, or that such a channel can have.

        Floats can hold any light, but what is nowhere above 1 is fitted in 0 … 1, as integers are.
        """
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


class Job(NamedTuple):
    """All that a brick needs."""

    field: Field
    channels: list[Channel]  # that the samples have
    samples: Samples
    leaves: Leaves
    heads: Heads | None  # if the leaves are all finest cells
    unfitted: Collection[str]  # channels whose means stay
    is_facing: bool  # whether lookups are those with the samples' normals
    groups: list[Group]
    ranges: list[tuple[float, float]]  # of each group


class Lookups(NamedTuple):
    """The samples of a brick and its halo, and the taps of the field there."""

    samples: Int64s  # (n,)
    strides: Float32s  # (n,)   how many samples each stands for
    starts: Int64s  # (n + 1,)   the first tap of each
    leaves: Int32s  # (taps,)   rows of `cells`
    weights: Float32s  # (taps,)
    cells: Int64s  # (m,)   numbers of the cells in reach: the brick's own, the halo's, the rest
    unknowns: int  # how many of them are solved for

    def residuals(
        self,
        values: Float32s,
        targets: Float32s,
        shares: Float32s,
        components: int,
        is_light: int,
    ) -> Float32s:
        """Return the residuals of values. See `solve.residuals`."""
        task = values, targets, shares, components, is_light
        return residuals(self.starts, self.leaves, self.weights, *task)

    def equations(self) -> Equations:
        """List by unknown what lookups blend."""
        return transpose(self.starts, self.leaves, self.weights, self.unknowns)

    def covered(self, coverage: Float32s) -> Lookups:
        """Return the same with cells (m,) that weigh by their coverage."""
        return self._replace(weights=covered(self.starts, self.leaves, self.weights, coverage))


class Fitter(NamedTuple):
    """Makes the leaves of trees meet samples, whose finest cells they are, or cells above them.

    Colours are fitted on sRGB's curve, light above 1 by ratio, directions as vectors; what alpha does not
    cover counts for alpha alone. Values stay inside their types' ranges. Channels that are ``unfitted`` keep
    their values after they served the others. The result does not depend on the executor.
    """

    samples: Samples
    executor: Executor
    progress: Progress
    unfitted: Collection[str] = ()

    def fit(self, tree: Octree, channels: Channels, chosen: Bools | None = None) -> Channels:
        """Return channels whose leaves make the quadratic field meet the samples; all else keeps its values.

        The leaves' values in ``channels``, which hold what the samples hold, are means. With ``chosen``
        (leaves,), in Morton order, these leaves alone are fitted, to the samples in them.
        """
        samples, leaves = self.samples, Leaves.of(tree, self.samples)
        if chosen is not None:
            finest = np.searchsorted(samples.firsts, leaves.firsts)  # the first finest cell of each leaf
            samples = samples.of(np.flatnonzero(np.repeat(chosen, np.diff(finest))))
            leaves = leaves.some(chosen, tree.n_cells)
        return self._fitted(tree, channels, samples, leaves, is_facing=False)

    def fit_rows(self, tree: Octree, channels: Channels, samples: Samples, rows: Leaves) -> Channels:
        """Return channels some ``rows`` of whose split leaves make the field meet ``samples``.

        These are all samples in these leaves, and looked up with their normals. All else is as in ``fit``.
        """
        return self._fitted(tree, channels, samples, rows, is_facing=True)

    def _fitted(
        self, tree: Octree, channels: Channels, samples: Samples, leaves: Leaves, *, is_facing: bool
    ) -> Channels:
        field, heads = Field(tree), None
        if is_facing:
            field.facings  # noqa: B018 (built before threads share it)
        elif field.tiles is not None and not leaves.cells.size:
            heads = Heads.of(field.tiles, samples.codes)
        given = [channels[form.name] for form in samples.channels]
        groups = _groups(samples.channels)
        ranges = [group.range(samples) for group in groups]
        job = Job(field, given, samples, leaves, heads, self.unfitted, is_facing, groups, ranges)
        size = min(max(len(samples.places) // _BRICKS, _LEAST_SAMPLES), BRICK_SAMPLES)
        bricks = list(pairwise(_cuts(leaves.firsts, size, LEAF_SAMPLES).tolist()))
        found = ordered_map(
            self.executor, partial(_fit_brick, job), bricks, stage="fit", progress=self.progress
        )
        table, first_row = ("split_values", tree.n_cells) if is_facing else ("values", 0)
        stored = [large.copied(getattr(channel, table)) for channel in given]
        for brick, parts in zip(bricks, found, strict=True):
            rows = leaves.numbers(*brick) - first_row
            for whole, part in zip(stored, parts, strict=True):
                whole[rows] = part
        made = {
            channel.format.name: channel._replace(**{table: each})  # type: ignore[arg-type]
            for channel, each in zip(given, stored, strict=True)
            if channel.format.name not in self.unfitted
        }
        return {**channels, **made}


@kernel
def _cuts(firsts: Int64s, brick: int, most: int) -> Int64s:
    """Cut leaves into runs of about ``brick`` samples, of which a leaf has ``most`` at most."""
    cuts = np.zeros(firsts[firsts.size - 1] // brick + 3, np.int64)
    n_cuts = 1
    size = 0
    for leaf in range(firsts.size - 1):
        size += min(firsts[leaf + 1] - firsts[leaf], most)
        if size >= brick or leaf == firsts.size - 2:
            cuts[n_cuts] = leaf + 1
            n_cuts += 1
            size = 0
    return cuts[:n_cuts].copy()


def _groups(channels: Sequence[ChannelFormat]) -> list[Group]:
    """Put components together that weigh alike; alpha first, since lookups of the others depend on it."""
    groups: list[Group] = []
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
        groups += (Group(slice(i, min(i + 3, end)), form) for i in range(first, end, 3))
    return sorted(groups, key=lambda group: group.format.name != "alpha")


def _fit_brick(job: Job, brick: tuple[int, int]) -> list[Array]:
    """Fit a run of leaves; return each channel's values of them, as stored."""
    lookups: Lookups | CubeLookups
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
        is_even = _is_even(wanted) and _is_even(values[:, group.columns])  # then means are the best values
        if group.format.name not in job.unfitted and not is_even:
            means = _four(values[:, group.columns])
            found = means.copy()
            rows = lookups.residuals(found, wanted, shares, components, 0)
            equations = equations or lookups.equations()
            approach(equations, rows, found)
            found[: lookups.unknowns][is_fixed] = means[: lookups.unknowns][is_fixed]
            rows = lookups.residuals(found, wanted, shares, components, is_light)
            if is_light:
                weigh(equations, rows, wanted, shares, components)
            sums, is_flat = diagonal(equations, rows, wanted)
            sums[is_fixed] = 0.0
            is_rounded = group.format.dtype == "uint8"
            to_codes = Codes.of_bytes(group.format.space) if is_rounded else Codes.none()
            for turn in range(SWEEPS):
                codes = to_codes if turn >= FREE_SWEEPS else Codes.none()
                sweep(equations, rows, sums, is_flat, means, components, *limits, codes, turn % 2, found)
            values[:, group.columns] = found[:, :components]
        if group.format.name == "alpha":
            coverage = values[:, group.columns.start].copy()
            if (coverage < 1.0).any():
                lookups, equations = lookups.covered(coverage), None
            shares = shares * np.maximum(wanted[:, 0], np.float32(LEAST_COVERAGE))
    own = values[: brick[1] - brick[0]]
    ends = np.cumsum([channel.format.components for channel in job.channels])
    return [
        encode(part, channel.format.dtype, channel.format.space)
        for channel, part in zip(job.channels, np.split(own, ends[:-1], axis=1), strict=True)
    ]


def _look_up(job: Job, first: int, end: int) -> Lookups:
    """Look the field up at the samples of leaves ``first`` … ``end`` − 1 and around them."""
    leaves = job.leaves
    own = leaves.numbers(first, end)
    outside = Outside.of(0)
    ring = leaves.with_samples(np.arange(first, end))
    samples, strides, starts = [], [], [np.zeros(1, np.int64)]
    numbers, weights = [], []
    n_taps = unknowns = 0
    for _ in range(RINGS + 1):
        known = int(outside.total[0])
        unknowns = len(own) + known
        members, stride = members_of(leaves.firsts, ring, LEAF_SAMPLES)
        samples.append(members)
        strides.append(stride)
        normals = job.samples.normals[members].astype(np.float32) if job.is_facing else None
        points = sample_points(job.samples, members, UNIT)
        for taps in job.field.runs(points, UNIT, normals=normals):
            room = int((taps.ends - taps.starts).sum())
            outside = outside.with_room(room)
            ends = np.empty(taps.starts.size, np.int64)
            some, shares = np.empty(room, np.int32), np.empty(room, np.float32)
            found = number(taps, leaves, first, end, outside, ends, some, shares)
            starts.append(ends + n_taps)
            numbers.append(some[:found])
            weights.append(shares[:found])
            n_taps += found
        ranks = leaves.ranks_of(outside.found()[known:])
        ring = leaves.with_samples(ranks[ranks >= 0])
    return Lookups(
        np.concatenate(samples),
        np.concatenate(strides),
        np.concatenate(starts),
        np.concatenate(numbers),
        np.concatenate(weights),
        np.concatenate([own, outside.found()]),
        unknowns,
    )


def _is_even(rows: Float32s) -> bool:
    """Say whether all rows are the same."""
    return bool((rows[-1:] == rows[:1]).all() and (rows == rows[:1]).all())


def _four(columns: Floats) -> Float32s:
    """Return up to three columns as float32 rows of four."""
    rows = np.zeros((len(columns), 4), np.float32)
    rows[:, : columns.shape[1]] = columns
    return rows


def _values(channels: Sequence[Channel], rows: Int64s, n_cells: int, *, is_facing: bool) -> Float32s:
    """Return the decoded values (rows, components) of cells, and after them of rows or kept coefficients."""
    beyond = np.flatnonzero(rows >= n_cells)
    cells = np.minimum(rows, n_cells - 1) if beyond.size else rows
    found = np.empty((len(rows), sum(channel.format.components for channel in channels)), np.float32)
    end = 0
    for channel in channels:
        start, end = end, end + channel.format.components
        more, space = channel.split_values if is_facing else channel.kept_values, channel.format.space
        found[:, start:end] = decode(channel.values.take(cells, axis=0), space)
        found[beyond, start:end] = decode(more[rows[beyond] - n_cells], space)
    return found
