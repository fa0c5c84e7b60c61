"""Adaptive trees: which cells become leaves, so that the field stays near the source.

Everything here counts in the finest cells, those of the tree that a conversion fills: the state is the depth
of the leaf that each of them lies in.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from octex.conversion.lookups import Coefficients, source_at, values_at, values_of
from octex.conversion.measure import exceeding
from octex.conversion.samples import Samples
from octex.errors import ArgumentError
from octex.jit import kernel
from octex.parallel import Progress, ordered_map
from octex.texture.channel import Channel
from octex.tree.layout import SplitTable
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.octree import Octree

Channels: TypeAlias = Mapping[str, Channel]
#: Fits the leaves of a tree whose values are means: a conversion's `fitted` with all but these two given.
Fit: TypeAlias = Callable[[Octree, Channels], Channels]
Bools: TypeAlias = npt.NDArray[np.bool_]
Depths: TypeAlias = npt.NDArray[np.uint8]
Values: TypeAlias = npt.NDArray[Any]

#: Finest cells whose samples are looked up at once.
_BLOCK = 1 << 15
#: What samples, float16 numbers, are rounded by at most, in codes: so much more is allowed.
_ROUNDING = 1 / 16
#: A leaf is tested at a sample in each cell so many levels below it: at most 16 or so where it is flat.
_TESTED_BELOW = 2
#: If no more than this part of all leaves fail, only those around them are tested again.
_FEW = 0.05
#: Leaves that fail are split by a level, which mostly is enough; by one more after each so many rounds, since
#: their neighbours may fail in turn.
_PATIENCE = 6
#: Rounds of tests after the first fit; they find nearly all that is to be split.
_FIRST_ROUNDS = 2


def as_max_error(max_error: float) -> float:
    """Return a number of 8-bit codes, finite and 0 or more, or raise ArgumentError."""
    try:
        number = float(max_error)
    except (TypeError, ValueError):
        raise ArgumentError(f"max_error must be a number of 8-bit codes, not {max_error!r}") from None
    if not 0.0 <= number < np.inf:
        raise ArgumentError(f"max_error must be finite and not negative, not {number:g}")
    return number


class Finest(NamedTuple):
    """The finest cells of a full tree, and which of them the cells above hold."""

    tree: Octree
    codes: npt.NDArray[np.int64]  # (n,)   Morton codes, ascending
    firsts: list[npt.NDArray[np.int64]]  # for each level above, the first finest cell in each of its cells

    @classmethod
    def of(cls, tree: Octree) -> Finest:
        """List the finest cells below each cell of a tree whose leaves are all of one level."""
        codes = tree.level_codes(tree.max_depth)
        firsts: list[npt.NDArray[np.int64]] = []
        above = codes
        for _ in range(tree.max_depth):
            above = above >> 3
            starts = np.flatnonzero(np.diff(above, prepend=-1))
            above = above[starts]
            firsts.append(firsts[-1][starts] if firsts else starts)
        return cls(tree, codes, firsts[::-1])

    def first(self, level: int) -> npt.NDArray[np.int64] | slice:
        """Return what picks the first finest cell in each cell of a level."""
        return self.firsts[level] if level < self.tree.max_depth else slice(None)

    def spread(self, level: int, values: Bools) -> Bools:
        """Give each finest cell what the cell of ``level`` that holds it has."""
        return np.repeat(values, np.diff(self.firsts[level], append=self.codes.size))


class Pruned(NamedTuple):
    """A tree with some nodes as leaves, and where its cells were."""

    tree: Octree
    cells: npt.NDArray[np.int64]  # (cells,)   their numbers in the full tree
    leaves: Bools  # (cells,)
    starts: npt.NDArray[np.int64]  # (leaves,)   the first finest cell of each leaf, in Morton order
    split_rows: Bools  # (rows of the full tree's split table,)   those that are left

    def carried(self, channels: Channels) -> dict[str, Channel]:
        """Return the values of the full tree's channels in this tree."""
        return {
            name: channel._replace(
                values=channel.values[self.cells], split_values=channel.split_values[self.split_rows]
            )
            for name, channel in channels.items()
        }

    def scattered(self, fitted: Channels, means: Channels) -> dict[str, Values]:
        """Return the values of this tree's leaves where they are in the full tree, between its means."""
        found = {name: channel.values.copy() for name, channel in means.items()}
        for name, values in found.items():
            values[self.cells[self.leaves]] = fitted[name].values[self.leaves]
        return found


def prune(finest: Finest, depths: Depths) -> Pruned:
    """Make leaves of the nodes at ``depths`` (n,) above the finest cells; flags and areas are taken over."""
    tree = finest.tree
    starts, codes = _leaves_of(finest.codes, depths, tree.max_depth)
    full = tree.arrays
    cells, leaves = [], []
    for level, first in enumerate(full.level_cells[:-1]):
        depths_there = depths[finest.first(level)]
        stored = np.flatnonzero(depths_there >= level)
        cells.append(stored + first)
        leaves.append(depths_there[stored] == level)
    numbers = np.concatenate(cells)
    is_left = np.zeros(tree.n_cells, np.bool_)
    is_left[numbers] = True
    split = tree.split
    is_split = is_left[split.cells]
    rows = np.repeat(is_split, np.bitwise_count(split.facings))
    split = SplitTable(
        np.searchsorted(numbers, split.cells[is_split]).astype(np.uint32),
        split.facings[is_split],
        split.areas[rows],
    )
    pruned = Octree.from_leaves(codes, depths[starts])
    pruned = pruned.with_cell_data(full.flags[numbers], full.areas[numbers], split)
    return Pruned(pruned, numbers, np.concatenate(leaves), starts, rows)


@kernel
def _leaves_of(
    codes: npt.NDArray[np.int64], depths: Depths, depth: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the first finest cell of each leaf, and the leaf's Morton code at its own level."""
    starts = np.empty(codes.size, np.int64)
    leaves = np.empty(codes.size, np.int64)
    count = 0
    end = np.int64(-1)  # of the latest leaf, as a code of the deepest level
    for n in range(codes.size):
        if codes[n] >= end:
            shift = 3 * (depth - np.int64(depths[n]))
            starts[count] = n
            leaves[count] = codes[n] >> shift
            end = (leaves[count] + 1) << shift
            count += 1
    return starts[:count].copy(), leaves[:count].copy()


def limits_of(finest: Finest, wanted: Depths | None) -> Depths:
    """Return the depth that each finest cell's leaf must not go below, for the depths wanted in them.

    A node becomes a leaf if no cell in it wants to go deeper.
    """
    depth = finest.tree.max_depth
    limits = np.full(finest.codes.size, depth, np.uint8)
    if wanted is not None:
        for level in range(depth - 1, -1, -1):
            shallow = np.maximum.reduceat(wanted, finest.firsts[level]) <= level
            limits[finest.spread(level, shallow)] = level
    return limits


def adapted(
    tree: Octree,
    channels: Channels,
    samples: Samples | None,
    *,
    max_error: float | None,
    wanted: Depths | None,
    fit: Fit | None,
    executor: Executor | None,
    progress: Progress,
) -> tuple[Octree, dict[str, Channel], dict[str, Channel]]:
    """Return the tree with fewer leaves, its channels' means, and its channels, fitted if there is a ``fit``.

    ``tree`` is full: all its leaves have its depth; channels hold the source's means. ``wanted`` (finest
    cells,) are the depths wanted there, in Morton order. Without samples none can merge.

    With ``max_error``, in 8-bit codes of what is encoded (see `measure`), leaves merge upward from there.
    Then the quadratic field, as it is stored, differs from the source by at most that and 1/8 (what samples
    are rounded by, and what is allowed for it) in all leaves that are less deep than what is wanted: at every
    sample of those one or two levels above the finest cells, at one in each cell two levels below of those
    further up. Leaves as deep as wanted stay, whatever their error. What the last tests split
    has means, unfitted.
    """
    if max_error is None and (wanted is None or wanted.min(initial=tree.max_depth) == tree.max_depth):
        return tree, dict(channels), dict(fit(tree, channels) if fit else channels)
    finest = Finest.of(tree)
    limits = limits_of(finest, wanted)
    if max_error is None or samples is None:
        pruned = prune(finest, limits)
        carried = pruned.carried(channels)
        return pruned.tree, carried, dict(fit(pruned.tree, carried) if fit else carried)
    return _Merger(finest, channels, samples, max_error, limits, executor, progress).merged(fit)


class _Merger:
    """Merges leaves and splits them again until every merged one is near the source."""

    def __init__(
        self,
        finest: Finest,
        channels: Channels,
        samples: Samples,
        max_error: float,
        limits: Depths,
        executor: Executor | None,
        progress: Progress,
    ) -> None:
        self._finest = finest
        self._channels = channels
        self._samples = samples
        self._most = max_error + _ROUNDING
        self._limits = limits
        self._executor = executor
        self._progress = progress

    def merged(self, fit: Fit | None) -> tuple[Octree, dict[str, Channel], dict[str, Channel]]:
        """Return the tree of fewest leaves that was found, and its channels' means and values."""
        depth = self._finest.tree.max_depth
        depths = self._limits.copy()
        for done, level in enumerate(range(depth - 1, -1, -1)):
            self._progress("adapt", done, depth + 3)
            self._merge(level, depths)
        self._progress("adapt", depth, depth + 3)
        # What was judged on even trees is judged again on the tree of many depths: first at few samples, and
        # at more as the leaves were fitted. What that splits is worth another fit.
        pruned, values = self._split(depths, None, 1, 1)
        for done, rounds in ((1, _FIRST_ROUNDS if fit else depths.size), (2, depths.size)):
            self._progress("adapt", depth + done, depth + 3)
            before = pruned
            fitted = None
            if fit:
                fitted = before.scattered(fit(before.tree, before.carried(self._channels)), self._channels)
            pruned, values = self._split(depths, fitted, _TESTED_BELOW, rounds)
            if not fit or pruned.tree.n_leaves == before.tree.n_leaves:
                break
        self._progress("adapt", depth + 3, depth + 3)
        return pruned.tree, pruned.carried(self._channels), values

    def _merge(self, level: int, depths: Depths) -> None:
        """Make leaves of the nodes of a level all of whose children are, where that seems to be near enough.

        Either the averages of this level, as a field, are near the source in the node, or the node's own
        average is: beside an edge the former are not, but finer leaves on the edge will keep it.
        """
        finest = self._finest
        firsts = finest.firsts[level]
        may = np.maximum.reduceat(depths, firsts) == level + 1
        if not may.any():
            return
        averages = Coefficients.of(finest.tree.truncated(level), self._channels, self._samples)
        smooth = self._near(level, averages, may)
        flat = self._near(level, averages, may & ~smooth, by_itself=True)
        depths[finest.spread(level, smooth | flat)] = level

    def _near(self, level: int, averages: Coefficients, may: Bools, *, by_itself: bool = False) -> Bools:
        """Say in which of some nodes of a level its averages are near enough to the source.

        Each ``by_itself``, or as a field.
        """
        finest = self._finest
        firsts = finest.firsts[level]
        # Most nodes that fail do so in their first finest cell.
        first = np.zeros(finest.codes.size, np.bool_)
        first[firsts[may]] = True
        nodes = firsts if by_itself else None
        may = may & ~self._fails(averages, first, nodes)[firsts]
        # What is small, finer levels have seen: one of the finest cells in each child will do.
        children = np.zeros(finest.codes.size, np.bool_)
        children[finest.first(level + 1)] = True
        failing = self._fails(averages, children & finest.spread(level, may), nodes)
        return may & ~np.logical_or.reduceat(failing, firsts)

    def _probes(self, depths: Depths, below: int) -> Bools:
        """Mark the first finest cell in each cell ``below`` levels below a leaf that may be split."""
        finest = self._finest
        marked = np.zeros(depths.size, np.bool_)
        for level in range(finest.tree.max_depth):
            first = finest.first(min(level + below, finest.tree.max_depth))
            marked[first] |= depths[first] == level
        return marked & (depths < self._limits)

    def _split(
        self, depths: Depths, fitted: Mapping[str, Values] | None, below: int, rounds: int
    ) -> tuple[Pruned, dict[str, Channel]]:
        """Split merged leaves until the field is near the source in each that is left; changes ``depths``.

        Tested is a finest cell in each cell ``below`` levels below a leaf, at most ``rounds`` times. Leaves
        have ``fitted`` values, by cells of the full tree; new ones have their means there.
        """
        suspects = np.ones(depths.size, np.bool_)
        for attempt in range(rounds):
            pruned, values = self._pruned(depths, fitted)
            field = Coefficients.of(pruned.tree, values, self._samples)
            failing = self._fails(field, suspects & self._probes(depths, below))
            failing = np.logical_or.reduceat(failing, pruned.starts)
            if not failing.any():
                return pruned, values
            if np.count_nonzero(failing) > _FEW * failing.size:
                suspects = np.ones(depths.size, np.bool_)
            else:
                suspects = self._around(pruned.starts[failing], depths)
            failing = np.repeat(failing, np.diff(pruned.starts, append=depths.size))
            steps = 1 + attempt // _PATIENCE
            depths[failing] = np.minimum(depths[failing] + steps, self._limits[failing])
        return self._pruned(depths, fitted)

    def _pruned(
        self, depths: Depths, fitted: Mapping[str, Values] | None
    ) -> tuple[Pruned, dict[str, Channel]]:
        """Return the tree whose leaves have some depths, and their values: ``fitted`` ones, or means."""
        pruned = prune(self._finest, depths)
        values = pruned.carried(self._channels)
        for name, leaf_values in (fitted or {}).items():
            values[name].values[pruned.leaves] = leaf_values[pruned.cells[pruned.leaves]]
        return pruned, values

    def _around(self, starts: npt.NDArray[np.int64], depths: Depths) -> Bools:
        """Mark the finest cells in leaves and in the cells of their sizes around: as far as splits reach."""
        codes, depth = self._finest.codes, self._finest.tree.max_depth
        changes = np.zeros(codes.size + 1, np.int32)
        offsets = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
        for level in np.unique(depths[starts]).tolist():
            shift = 3 * (depth - level)
            cells = decode_cells(codes[starts[depths[starts] == level]] >> shift)
            around = (cells[:, None] + offsets).reshape(-1, 3)
            around = around[((around >= 0) & (around < 1 << level)).all(axis=1)]
            held = encode_cells(around)
            np.add.at(changes, np.searchsorted(codes, held << shift), 1)
            np.add.at(changes, np.searchsorted(codes, held + 1 << shift), -1)
        np.cumsum(changes, out=changes)
        return changes[:-1] > 0

    def _fails(self, field: Coefficients, chosen: Bools, nodes: npt.NDArray[np.int64] | None = None) -> Bools:
        """Say in which of the chosen finest cells a field is too far from the source at a sample.

        With ``nodes``, the first finest cells in those of the field's last level, it is their own values.
        """
        fails = np.zeros(chosen.size, np.bool_)
        cells = np.flatnonzero(chosen)
        blocks = [cells[begin : begin + _BLOCK] for begin in range(0, cells.size, _BLOCK)]
        work = partial(_failing, field, self._samples, self._most, nodes)
        done = map(work, blocks) if self._executor is None else ordered_map(self._executor, work, blocks)
        for failing in done:
            fails[failing] = True
        return fails


def _failing(
    field: Coefficients,
    samples: Samples,
    most: float,
    nodes: npt.NDArray[np.int64] | None,
    cells: npt.NDArray[np.int64],
) -> npt.NDArray[np.int64]:
    """Return the finest cells, of some, where a field is more than ``most`` codes from the source."""
    found = values_at(field, samples, cells) if nodes is None else values_of(field, samples, cells, nodes)
    far = exceeding(found, source_at(samples, cells), samples.channels, most)
    counts = samples.firsts[cells + 1] - samples.firsts[cells]
    return np.repeat(cells, counts)[far]
