"""Adaptive trees: merges leaves where the field stays near that of the full tree.

The reference is the full tree's field, not the source. Two fields differ smoothly within a finest cell, so a
few points bound their distance in all of it. A source may have more detail than a cell: a leaf that matches
it at a few points can be far off between them.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from functools import partial
from itertools import count

import numpy as np

from octex.arrays import Array, Bools, Int64s, Uint8s
from octex.channels import ALPHA, ChannelFormat, decode
from octex.checks import as_real
from octex.conversion import large
from octex.conversion.differences import (
    Reference,
    coefficients,
    find_far,
    near_nodes,
    values_at_samples,
)
from octex.conversion.evaluator import Coefficients
from octex.conversion.fit import Fitter, with_sides
from octex.conversion.levels import Filled
from octex.conversion.prune import Channels, Finest, Pruned, grafted, limits_of, prune
from octex.conversion.samples import Samples
from octex.errors import ArgumentError
from octex.field.weights import facings_of
from octex.parallel import Progress, ordered_map, sharing
from octex.texture import Channel
from octex.tree.neighbours import near
from octex.tree.octree import Octree, distinct

#: Finest cells, or nodes, that are tested at once.
_BLOCK = 1 << 14
#: Bound of the fields' rounding, in codes.
_ROUNDING = 1 / 16
#: Leaves that fail are split by one level; by one level more after every two rounds, since neighbours may
#: fail in turn.
_PATIENCE = 2


def as_max_error(max_error: float) -> float:
    """Return a number of 8-bit codes, finite and 0 or more, or raise ArgumentError."""
    number = as_real(max_error, "max_error", "a number, in 1/255")
    if not 0.0 <= number < np.inf:
        raise ArgumentError(f"max_error must be finite and not negative, not {number:g}")
    return number


def adapted(
    filled: Filled, *, fit: bool, max_error: float | None, executor: Executor, progress: Progress
) -> tuple[Octree, dict[str, Channel]]:
    """Return a tree no deeper than wanted, and its channels; fitted with ``fit`` and samples.

    With ``max_error``, in 8-bit codes (see `differences`), and samples, leaves merge upward from there. At
    every sample, with its normal and without, the quadratic field then differs from that of the tree without
    ``max_error`` by at most that and 1/16, the rounding. On the patch around the sample (see
    ``samples.lay_out``) it differs by one code more at most, if the difference is a quadratic polynomial on
    each of the patch's triangles. Leaves that do not merge keep their values.
    """
    tree, channels, samples, wanted, has_gaps = filled
    finest, limits, pruned, fitter = None, None, None, None
    if fit and samples is not None:
        # A fitted alpha would differ from 1 next to gaps, and opaque paint would not stay opaque.
        fitter = Fitter(samples, executor, progress, (ALPHA.name,) if has_gaps else ())
    if wanted is not None and wanted.min(initial=tree.max_depth) < tree.max_depth:
        finest = Finest.of(tree)
        limits = limits_of(finest, wanted)
        pruned = prune(finest, limits)
    whole = tree if pruned is None else pruned.tree
    means = channels if pruned is None else pruned.carried(channels)
    values: Channels = means
    if fitter is not None:
        whole, values = with_sides(fitter, whole, means, fitter.fit(whole, means))
    if max_error is None or samples is None:
        return whole, dict(values)
    if finest is None or limits is None or pruned is None:
        finest = Finest.of(whole)
        limits = limits_of(finest, None)
        values = {
            name: channel._replace(values=large.copied(channel.values)) for name, channel in values.items()
        }
    else:
        full, values = grafted(tree, channels, pruned, whole, values)
        finest = finest._replace(tree=full)
    merger = _Merger(finest, values, samples, max_error, limits, executor, progress)
    return merger.merged(fitter)


class _Merger:
    """Merges leaves, and splits them again until the field is near the full tree's."""

    def __init__(
        self,
        finest: Finest,
        known: Channels,
        samples: Samples,
        max_error: float,
        limits: Uint8s,
        executor: Executor,
        progress: Progress,
    ) -> None:
        self._finest = finest
        self._known = dict(known)
        self._most = max_error + _ROUNDING
        self._limits = limits
        self._executor = executor
        self._progress = progress
        self._forms = [form for form in samples.channels if _varies(known[form.name], form)]
        self._whole = coefficients(finest.tree, known, self._forms)
        is_full = limits.min(initial=finest.tree.max_depth) == finest.tree.max_depth
        full = self._whole if is_full else self._field(prune(finest, limits))
        self._reference = Reference.of(full, samples, self._forms)
        self._cells = np.arange(limits.size)
        values = self._mapped(partial(values_at_samples, self._reference), self._cells)
        self._reference = self._reference._replace(values=large.joined(values))

    def merged(self, fitter: Fitter | None) -> tuple[Octree, dict[str, Channel]]:
        """Return the tree with merged leaves, and its channels."""
        depth = self._finest.tree.max_depth
        depths = self._limits.copy()
        for done, level in enumerate(range(depth - 1, -1, -1)):
            self._progress("adapt", done, depth + 3)
            self._merge(level, depths)
        self._progress("adapt", depth, depth + 3)
        # Nodes were tested on trees of one depth: test the tree of many depths.
        self._split(prune(self._finest, depths), depths)
        self._progress("adapt", depth + 1, depth + 3)
        pruned = prune(self._finest, depths)
        if fitter is not None:
            self._fit(fitter, pruned, depths)
        self._progress("adapt", depth + 2, depth + 3)
        self._split(pruned, depths)
        pruned = self._settle(depths)
        self._progress("adapt", depth + 3, depth + 3)
        return pruned.tree, pruned.carried(self._known)

    def _fit(self, fitter: Fitter, pruned: Pruned, depths: Uint8s) -> None:
        """Fit merged leaves, which have means so far, to the full tree's field at the samples."""
        cells, is_merged = pruned.leaf_cells(depths), (depths < self._limits)[pruned.starts]
        merged = cells[is_merged]
        if not merged.size or not self._forms:
            return
        samples = fitter.samples._replace(channels=tuple(self._forms), values=self._reference.values)
        values = fitter._replace(samples=samples).fit(pruned.tree, pruned.carried(self._known), is_merged)
        whole, cells, end = self._whole, pruned.cells[merged], 0
        rows = whole.rows.reshape(-1, (whole.components + 4) // 4 * 4)
        for name, channel in values.items():
            self._known[name].values[cells] = channel.values[merged]
        for form in self._forms:
            start, end = end, end + form.components
            rows[cells, start:end] = decode(values[form.name].values[merged], form.space)

    def _merge(self, level: int, depths: Uint8s) -> None:
        """Merge the leaves below nodes of a level, all of whose children are leaves, where they seem near.

        Either the field of this level's averages is near the full tree's in the node, or the node's average
        is: next to an edge that field is not near, but finer leaves on the edge will keep the edge.
        """
        finest, firsts = self._finest, self._finest.firsts[level]
        candidates = np.flatnonzero(np.maximum.reduceat(depths, firsts) == level + 1)
        if not candidates.size:
            return
        even = self._whole._replace(arrays=finest.tree.truncated(level).arrays)
        # Finer levels have tested details: one finest cell in each child suffices.
        children = np.append(np.arange(depths.size)[finest.first(level + 1)], depths.size)
        firsts = np.append(firsts, depths.size)
        nodes = firsts, np.searchsorted(children, firsts), children
        first = int(finest.tree.arrays.level_cells[level])
        work = partial(near_nodes, even, self._reference, self._most, nodes, first)
        merges = np.zeros(firsts.size - 1, np.bool_)
        merges[candidates] = np.concatenate(self._mapped(work, candidates))
        depths[finest.spread(level, merges)] = level

    def _settle(self, depths: Uint8s) -> Pruned:
        """Split merged leaves until the field is near everywhere, with and without normals."""
        cells = self._cells
        for attempt in count():
            pruned = prune(self._finest, depths)
            far = self._far(pruned, depths, cells, is_patch=True)
            cells = np.flatnonzero(self._refined(far, pruned, depths, 1 + attempt // _PATIENCE))
            if not cells.size:
                break
        return pruned

    def _split(self, pruned: Pruned, depths: Uint8s) -> None:
        """Split merged leaves by a level where the field is far off at samples."""
        self._refined(self._far(pruned, depths, self._cells, is_patch=False), pruned, depths, 1)

    def _far(self, pruned: Pruned, depths: Uint8s, cells: Int64s, *, is_patch: bool) -> Bools:
        """Mark those of ``cells`` in which the field is found too far off. See `find_far`."""
        ends = np.repeat(np.append(pruned.starts[1:], depths.size), pruned.sizes)
        ends[depths == self._limits] = 0  # such a leaf is not split
        far = np.zeros(depths.size, np.bool_)
        work = partial(find_far, self._field(pruned), self._reference, self._most, ends, is_patch)
        far[cells] = np.concatenate(self._mapped(work, cells))
        return far

    def _mapped(self, work: Callable[[Int64s], Array], items: Int64s) -> list[Array]:
        """Call ``work`` with blocks of items."""
        blocks = [items[begin : begin + _BLOCK] for begin in range(0, items.size, _BLOCK)]
        with sharing(self._executor) as pool:  # tasks read all samples, too many to send to processes
            return list(ordered_map(pool, work, blocks))

    def _refined(self, failing: Bools, pruned: Pruned, depths: Uint8s, steps: int) -> Bools:
        """Split merged leaves by ``steps`` levels, in ``depths``, and return the cells that this can change.

        These are the leaves that hold failing cells. For a failing cell in a leaf that has not merged, all
        merged leaves are split whose values reach it.
        """
        may, codes = depths < self._limits, self._finest.codes
        splits, others = failing & may, codes[failing & ~may]
        for level in np.unique(depths[may]).tolist() if others.size else ():
            splits |= self._around(others, level) & may & (depths == level)
        splits = np.repeat(np.logical_or.reduceat(splits, pruned.starts), pruned.sizes)
        starts = pruned.starts[splits[pruned.starts]]
        reached = np.zeros(depths.size, np.bool_)
        for level in np.unique(depths[starts]).tolist():
            reached |= self._around(codes[starts[depths[starts] == level]], level)
        depths[splits] = np.minimum(depths[splits] + steps, self._limits[splits])
        return reached

    def _around(self, codes: Int64s, level: int) -> Bools:
        """Mark the finest cells in the cells of a level that hold ``codes``, and in the cells around them."""
        shift = 3 * (self._finest.tree.max_depth - level)
        cells = self._finest.codes[self._finest.firsts[level]] >> shift
        return self._finest.spread(level, near(cells, distinct(codes >> shift), level))

    def _field(self, pruned: Pruned) -> Coefficients:
        """Return the field of a pruned tree."""
        whole, tree = self._whole, pruned.tree
        vectors = (whole.components + 4) // 4
        rows = whole.rows.reshape(-1, 4 * vectors)
        split = whole.first_row + np.flatnonzero(pruned.split_rows)
        rows = large.taken(rows, np.concatenate([pruned.cells, split])).reshape(-1, 4)
        return whole._replace(
            arrays=tree.arrays, splits=facings_of(tree).rows, first_row=tree.n_cells, rows=rows
        )


def _varies(channel: Channel, form: ChannelFormat) -> bool:
    """Say whether a channel has several values, or is alpha, which weighs the others."""
    first = channel.values[:1]
    return form.name == ALPHA.name or bool(
        (channel.values != first).any() or (channel.split_values != first).any()
    )
