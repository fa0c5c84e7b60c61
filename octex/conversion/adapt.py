"""Adaptive trees: which cells become leaves, so that the field stays near that of the full tree.

The full tree's field is what leaves are judged by, not the source: two fields differ smoothly within a finest
cell, so that a few points in each bound how far they are apart everywhere in it. Where the source has more
detail than that, a leaf that meets it at some points can be far off at others.
"""

from __future__ import annotations

from concurrent.futures import Executor
from functools import partial

import numpy as np
import numpy.typing as npt

from octex.conversion.nearness import Decoded, Ranges, far_cells, narrow_blocks
from octex.conversion.prune import Bools, Channels, Depths, Finest, Pruned, grafted, limits_of, prune
from octex.conversion.samples import Samples
from octex.conversion.sides import Fit, Split
from octex.errors import ArgumentError
from octex.field.coefficients import Coefficients
from octex.parallel import Progress, ordered_map
from octex.texture.channel import Channel
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.octree import Octree

#: Finest cells that are tested at once.
_BLOCK = 1 << 14
#: From so many levels above the finest cells on, what is near is looked for by what it is made of.
_LEVELS = 2
#: What the fields are rounded by at most, in codes.
_ROUNDING = 1 / 16
#: If no more than this part of all leaves fail, only those around them are tested again.
_FEW = 0.05
#: Leaves that fail are split by a level, which mostly is enough; by one more after each so many rounds, since
#: their neighbours may fail in turn.
_PATIENCE = 6


def as_max_error(max_error: float) -> float:
    """Return a number of 8-bit codes, finite and 0 or more, or raise ArgumentError."""
    try:
        number = float(max_error)
    except (TypeError, ValueError):
        raise ArgumentError(f"max_error must be a number of 8-bit codes, not {max_error!r}") from None
    if not 0.0 <= number < np.inf:
        raise ArgumentError(f"max_error must be finite and not negative, not {number:g}")
    return number


def adapted(
    tree: Octree,
    channels: Channels,
    samples: Samples | None,
    *,
    max_error: float | None,
    wanted: Depths | None,
    fit: Fit | None,
    split: Split | None,
    executor: Executor | None,
    progress: Progress,
) -> tuple[Octree, dict[str, Channel]]:
    """Return the tree with fewer leaves, and its channels, fitted if there is a ``fit``, then ``split``.

    ``tree`` is full: all its leaves have its depth; channels hold the source's means. ``wanted`` (finest
    cells,) are the depths wanted there, in Morton order. Without samples none can merge.

    With ``max_error``, in 8-bit codes of what is encoded (see `measure`), leaves merge upward from there.
    Then the quadratic field differs from that of the tree without ``max_error`` by at most that and 1/16
    (what both are rounded by) at every sample, looked up without normals and with the samples' own; and by at
    most one code more where the plane of the surface at a sample goes through its finest cell, with the
    difference taken for a quadratic polynomial on each of the triangles that ``samples.lay_out`` makes of
    that. Leaves that do not merge have the values that they have without it.
    """
    finest, limits, pruned = None, None, None
    if wanted is not None and wanted.min(initial=tree.max_depth) < tree.max_depth:
        finest = Finest.of(tree)
        limits = limits_of(finest, wanted)
        pruned = prune(finest, limits)
    whole = tree if pruned is None else pruned.tree
    means = channels if pruned is None else pruned.carried(channels)
    values = fit(whole, means, None) if fit else means
    if split:
        whole, values = split(whole, means, values)
    if max_error is None or samples is None:
        return whole, dict(values)
    if finest is None or limits is None or pruned is None:
        finest = Finest.of(tree)
        limits = limits_of(finest, None)
        pruned = prune(finest, limits)
    full, known = grafted(tree, channels, pruned, whole, values)
    finest = finest._replace(tree=full)
    merger = _Merger(finest, channels, known, samples, max_error, limits, executor, progress)
    return merger.merged(fit)


class _Merger:
    """Merges leaves and splits them again until the field is near that of the full tree."""

    def __init__(
        self,
        finest: Finest,
        means: Channels,
        known: Channels,
        samples: Samples,
        max_error: float,
        limits: Depths,
        executor: Executor | None,
        progress: Progress,
    ) -> None:
        self._finest = finest
        self._means = means
        self._known = dict(known)
        self._samples = samples
        self._most = max_error + _ROUNDING
        self._limits = limits
        self._executor = executor
        self._progress = progress
        self._averages = Decoded.of(means, samples.channels)
        self._decoded = Decoded.of(known, samples.channels)
        whole = prune(finest, limits)
        self._full = self._decoded.pruned(whole)
        self._ranges = Ranges.below(finest, self._decoded, whole)

    def merged(self, fit: Fit | None) -> tuple[Octree, dict[str, Channel]]:
        """Return the tree of fewest leaves that was found, and its channels."""
        depth = self._finest.tree.max_depth
        depths = self._limits.copy()
        for done, level in enumerate(range(depth - 1, -1, -1)):
            self._progress("adapt", done, depth + 3)
            self._merge(level, depths)
        self._progress("adapt", depth, depth + 3)
        # What was judged on even trees is judged again on the tree of many depths.
        self._split(depths, rounds=1)
        self._progress("adapt", depth + 1, depth + 3)
        if fit:
            self._fit(fit, depths)
        self._progress("adapt", depth + 2, depth + 3)
        self._split(depths)
        self._progress("adapt", depth + 3, depth + 3)
        pruned = prune(self._finest, depths)
        return pruned.tree, pruned.carried(self._known)

    def _fit(self, fit: Fit, depths: Depths) -> None:
        """Give merged leaves fitted values."""
        pruned = prune(self._finest, depths)
        cells, is_merged = pruned.leaf_cells(depths), (depths < self._limits)[pruned.starts]
        merged = cells[is_merged]
        if not merged.size:
            return
        # Merged leaves are known by their means as yet.
        values = fit(pruned.tree, pruned.carried(self._known), is_merged)
        for name, channel in values.items():
            self._known[name].values[pruned.cells[merged]] = channel.values[merged]
        some = {name: channel._replace(values=channel.values[merged]) for name, channel in values.items()}
        self._decoded.values[pruned.cells[merged]] = Decoded.of(some, self._samples.channels).values

    def _merge(self, level: int, depths: Depths) -> None:
        """Make leaves of the nodes of a level all of whose children are, where that seems to be near enough.

        Either the averages of this level, as a field, are near the full tree's in the node, or the node's own
        average is: beside an edge the former are not, but finer leaves on the edge will keep it.
        """
        finest = self._finest
        firsts = finest.firsts[level]
        may = np.maximum.reduceat(depths, firsts) == level + 1
        if not may.any():
            return
        tree = finest.tree.truncated(level)
        averages = self._averages.truncated(tree)
        near = self._narrow(level, averages, may)
        near |= self._near(level, averages, may & ~near)
        near |= self._near(level, averages, may & ~near, by_itself=True)
        depths[finest.spread(level, near)] = level

    def _narrow(self, level: int, field: Coefficients, chosen: Bools) -> Bools:
        """Say in which of some cells of a level all that a field and the full tree's are made of is near."""
        narrow = np.zeros(chosen.size, np.bool_)
        codes = self._finest.codes[self._finest.firsts[level][chosen]]
        own, columns = Ranges.of(field), self._averages.columns
        work = partial(narrow_blocks, own, self._ranges, columns, self._samples.depth, self._most, level)
        blocks = [codes[begin : begin + _BLOCK] for begin in range(0, codes.size, _BLOCK)]
        done = map(work, blocks) if self._executor is None else ordered_map(self._executor, work, blocks)
        narrow[chosen] = np.concatenate([np.zeros(0, np.bool_), *done])
        return narrow

    def _near(self, level: int, averages: Coefficients, may: Bools, *, by_itself: bool = False) -> Bools:
        """Say in which of some nodes of a level its averages are near enough to the full tree's field.

        Each ``by_itself``, or as a field.
        """
        finest = self._finest
        firsts = finest.firsts[level]
        # Most nodes that fail do so in their first finest cell.
        first = np.zeros(finest.codes.size, np.bool_)
        first[firsts[may]] = True
        nodes = None
        if by_itself:
            nodes = averages.arrays.level_cells[-2] + np.arange(firsts.size)
            nodes = np.repeat(nodes, np.diff(firsts, append=finest.codes.size))
        may = may & ~self._fails(averages, first, nodes)[firsts]
        # What is small, finer levels have seen: one of the finest cells in each child will do.
        children = np.zeros(finest.codes.size, np.bool_)
        children[finest.first(level + 1)] = True
        failing = self._fails(averages, children & finest.spread(level, may), nodes)
        return may & ~np.logical_or.reduceat(failing, firsts)

    def _split(self, depths: Depths, rounds: int | None = None) -> None:
        """Split merged leaves where the field is not near the full tree's; changes ``depths``.

        At most ``rounds`` times; or until it is near everywhere, looked up with normals too.
        """
        suspects = np.ones(depths.size, np.bool_)
        attempt = 0
        while rounds is None or attempt < rounds:
            pruned = prune(self._finest, depths)
            field = self._decoded.pruned(pruned)
            chosen = suspects.copy()
            for level in range(max(self._finest.tree.max_depth - _LEVELS, 0), self._finest.tree.max_depth):
                blocks = np.logical_or.reduceat(chosen, self._finest.firsts[level])
                chosen &= ~self._finest.spread(level, self._narrow(level, field, blocks))
            failing = self._fails(field, chosen, between=rounds is None)
            splits = self._splits(failing, pruned, depths)
            if not splits.any():
                return
            starts = pruned.starts[splits[pruned.starts]]
            few = starts.size <= _FEW * pruned.starts.size
            suspects = self._around(starts, depths) if few else np.ones(depths.size, np.bool_)
            steps = 1 + attempt // _PATIENCE
            depths[splits] = np.minimum(depths[splits] + steps, self._limits[splits])
            attempt += 1

    def _splits(self, failing: Bools, pruned: Pruned, depths: Depths) -> Bools:
        """Mark the finest cells in the merged leaves that are to be split where the field is too far off.

        Those that hold the place; where the leaf there has not merged, those whose values reach it.
        """
        may = depths < self._limits
        splits = np.repeat(np.logical_or.reduceat(failing & may, pruned.starts), pruned.sizes)
        codes, depth = self._finest.codes, self._finest.tree.max_depth
        others = codes[failing & ~may]
        for level in np.unique(depths[may]).tolist() if others.size else ():
            shift = 3 * (depth - level)
            held = _around(others >> shift, level)
            firsts, ends = np.searchsorted(codes, [held << shift, held + 1 << shift])
            stored = firsts < ends
            firsts, ends = firsts[stored], ends[stored]
            merged = may[firsts] & (depths[firsts] == level)
            splits |= _marked(firsts[merged], ends[merged], codes.size)
        return splits

    def _around(self, starts: npt.NDArray[np.int64], depths: Depths) -> Bools:
        """Mark the finest cells in leaves and in the cells of their sizes around: as far as splits reach."""
        codes, depth = self._finest.codes, self._finest.tree.max_depth
        marked = np.zeros(codes.size, np.bool_)
        for level in np.unique(depths[starts]).tolist():
            shift = 3 * (depth - level)
            held = _around(codes[starts[depths[starts] == level]] >> shift, level)
            firsts, ends = np.searchsorted(codes, [held << shift, held + 1 << shift])
            marked |= _marked(firsts, ends, codes.size)
        return marked

    def _fails(
        self,
        field: Coefficients,
        chosen: Bools,
        nodes: npt.NDArray[np.int64] | None = None,
        *,
        between: bool = False,
    ) -> Bools:
        """Say in which of the chosen finest cells a field is too far from the full tree's: see `far_cells`.

        With ``nodes`` (finest cells,) it is what these cells of its tree hold by themselves.
        """
        fails = np.zeros(chosen.size, np.bool_)
        cells = np.flatnonzero(chosen)
        blocks = [cells[begin : begin + _BLOCK] for begin in range(0, cells.size, _BLOCK)]

        work = partial(far_cells, field, self._full, self._samples, self._most, between, nodes)
        done = map(work, blocks) if self._executor is None else ordered_map(self._executor, work, blocks)
        for block, failing in zip(blocks, done, strict=True):
            fails[block] = failing
        return fails


_OFFSETS = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)


def _around(codes: npt.NDArray[np.int64], level: int) -> npt.NDArray[np.int64]:
    """Return cells of a level and all around them, each once."""
    cells = decode_cells(np.unique(codes))
    around = (cells[:, None] + _OFFSETS).reshape(-1, 3)
    around = around[((around >= 0) & (around < 1 << level)).all(axis=1)]
    return np.unique(encode_cells(around))


def _marked(firsts: npt.NDArray[np.int64], ends: npt.NDArray[np.int64], size: int) -> Bools:
    """Mark all from each of ``firsts`` up to its end."""
    changes = np.zeros(size + 1, np.int32)
    np.add.at(changes, firsts, 1)
    np.add.at(changes, ends, -1)
    np.cumsum(changes, out=changes)
    return changes[:-1] > 0
