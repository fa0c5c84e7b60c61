"""Packs the change of a texture for a page: new cells, and the new numbers of known ones.

A cell is known if the old texture has it with the same level, position, children, flags and values, including
its rows and kept coefficient. Known cells form runs of consecutive numbers in both textures. One stream:

    runs        per run: number of new cells before it; its first old cell; its length; as planes of bytes
    new cells   node masks, leaf masks, areas of nodes, flags, components of channels: a byte for each cell
    their rows  components of channels: kept coefficients of new nodes, then rows of new split cells
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Int64s, Uint8s
from octex.editing.draft import Change, numbers_in
from octex.formats.streams import planes
from octex.texture import OctreeTexture
from octex.tree.children import masks_of, node_cells, octants_of
from octex.tree.morton import decode_cells
from octex.tree.octree import Octree
from octex.tree.split import rows_of

#: Header fields that must not change while a page shows a part: the layout and meaning of values.
_STAYS = "origin", "size", "channels", "area", "flags", "planes"


def is_like(header: dict[str, Any], other: dict[str, Any]) -> bool:
    """Return whether a page that shows one part can be sent changes to another."""
    return all(header[name] == other[name] for name in _STAYS)


def with_new_channels(before: OctreeTexture, after: OctreeTexture) -> tuple[OctreeTexture | None, bytes]:
    """Return ``before`` with the channels of ``after``, and a stream of the new channels.

    The stream has, for each new component, cells, kept coefficients and split rows. Returns None instead of
    the texture if cells differ, or channels of equal name.
    """
    tree, channels, parts = before.tree, {}, []
    arrays: list[list[Array]] = [
        [*each.tree.arrays[:3], *each.tree.split, *each.tree.kept] for each in (before, after)
    ]
    is_same = before.placement == after.placement and all(map(np.array_equal, *arrays))
    for name, channel in after.channels.items():
        channels[name] = before.channels.get(name, channel)
        is_same &= channels[name].format == channel.format
        if name not in before.channels:
            rows = np.concatenate([channel.values, channel.kept_values, channel.split_values])
            parts.append(np.ascontiguousarray(rows.T, np.uint8).tobytes())
    return before.with_cells(tree, channels) if is_same else None, b"".join(parts)


class _KnownRuns(NamedTuple):
    """Runs of known cells: first new number, first old number, length."""

    now: Int64s
    before: Int64s
    lengths: Int64s

    @classmethod
    def of_cells(cls, now: Int64s, before: Int64s) -> _KnownRuns:
        """Return the longest runs of cells."""
        return cls(now, before, np.ones_like(now)).joined()

    def joined(self) -> _KnownRuns:
        """Join runs that are consecutive in both textures."""
        begins = np.ones(self.now.size, np.bool_)
        ends = self.now + self.lengths, self.before + self.lengths
        begins[1:] = (self.now[1:] != ends[0][:-1]) | (self.before[1:] != ends[1][:-1])
        first = np.flatnonzero(begins)
        lengths = np.add.reduceat(self.lengths, first) if first.size else self.lengths
        return _KnownRuns(self.now[first], self.before[first], lengths)


def change_between(before: OctreeTexture, after: OctreeTexture) -> tuple[dict[str, int], bytes]:
    """Return the sizes of a change's parts, and its stream; textures are as the page has them."""
    if before is after:
        count = after.tree.n_cells
        return _packed(_around(np.empty(0, np.int64), count), after, np.ones(count, np.bool_))
    old, is_known = _known(before, after)
    known = np.flatnonzero(is_known)
    return _packed(_KnownRuns.of_cells(known, old[known]), after, is_known)


def change_of(change: Change, before: OctreeTexture, after: OctreeTexture) -> tuple[dict[str, int], bytes]:
    """Return `change_between` of two textures that differ by a known change, from its drafts alone."""
    tiles, draft = change.tiles, change.after
    if tiles is None:
        return change_between(before, after)
    numbers_now = numbers_in(after, tiles, draft)
    is_open = numbers_now >= 0
    if change.has_same_cells:
        is_known = _as_before(change.before, draft) | ~is_open
        return _packed(_around(numbers_now[~is_known], after.tree.n_cells), draft, is_known, ~is_open)
    old, is_known = _known(change.before, draft)
    numbers_before = numbers_in(before, tiles, change.before)
    known = np.flatnonzero(is_known & is_open)
    opened = _KnownRuns.of_cells(numbers_now[known], numbers_before[old[known]])
    numbers = (each[each >= 0] for each in (numbers_now, numbers_before))
    closed = _closed(next(numbers), after.tree.n_cells, next(numbers), before.tree.n_cells)
    runs = _KnownRuns(*(np.concatenate(each) for each in zip(opened, closed, strict=True)))
    in_order = np.argsort(runs.now, kind="stable")
    return _packed(
        _KnownRuns(*(each[in_order] for each in runs)).joined(), draft, is_known | ~is_open, ~is_open
    )


def touched_by(changes: Sequence[Change]) -> list[list[float]] | None:
    """Return the corners (low, high) of the box that changes may touch, in root cells; None for everything.

    Averages of larger cells change beyond the box, by the cells' size.
    """
    corners = []
    for change in changes:
        if change.tiles is None:
            return None
        cells = decode_cells(change.tiles.codes)
        corners.append(np.stack([cells.min(axis=0), cells.max(axis=0) + 1]) / 2**change.tiles.level)
    if not corners:
        return []
    low, high = np.min(corners, axis=0)[0], np.max(corners, axis=0)[1]
    return [low.tolist(), high.tolist()]


def _around(new: Int64s, count: int) -> _KnownRuns:
    """Return the runs of all other cells of ``count``, whose numbers do not change."""
    ends = np.concatenate([[-1], new, [count]])
    at = np.flatnonzero(np.diff(ends) > 1)
    return _KnownRuns(ends[at] + 1, ends[at] + 1, ends[at + 1] - ends[at] - 1)


def _closed(new_numbers: Int64s, count: int, old_numbers: Int64s, old_count: int) -> _KnownRuns:
    """Return the runs of cells outside two sets, now and before; both have the same order."""
    gaps = []
    for numbers, end in ((new_numbers, count), (old_numbers, old_count)):
        offsets = np.append(numbers - np.arange(numbers.size), end - numbers.size)
        at = np.flatnonzero(np.diff(offsets, prepend=0))
        gaps.append((np.concatenate([[0], offsets])[at], at))
    first = np.union1d(gaps[0][0], gaps[1][0])
    lengths = np.diff(first, append=count - new_numbers.size)
    now, before = (first + at[np.searchsorted(begins, first, "right") - 1] for begins, at in gaps)
    return _KnownRuns(now, before, lengths)


def _packed(
    runs: _KnownRuns, texture: OctreeTexture, is_known: Bools, is_closed: Bools | None = None
) -> tuple[dict[str, int], bytes]:
    """Return a change's part sizes and stream; new cells are those of a texture that are not known.

    Closed cells are leaves of a draft but nodes of its texture, so their parents' masks are corrected.
    """
    new = np.flatnonzero(~is_known)
    gaps = np.diff(runs.now, prepend=0) - np.concatenate([[0], runs.lengths[:-1]])[: runs.now.size]
    masks, areas = _nodes_data(texture.tree)
    if is_closed is not None:
        nodes, closed = node_cells(texture.tree.arrays), np.flatnonzero(is_closed)
        nodes = nodes[: np.searchsorted(nodes, closed.max(initial=0))]  # all above closed cells
        stored = octants_of(np.bitwise_or.reduce(masks[nodes], axis=1))
        parents, octants = (each[closed - 1] for each in stored)  # of all cells but the root
        np.bitwise_xor.at(masks, nodes[parents], np.uint8(1) << octants[:, None])
    channels = list(texture.channels.values())
    columns = masks, areas, texture.tree.arrays.flags, *(channel.values for channel in channels)
    parts: list[Array] = [each.take(new, axis=0).T for each in columns]
    kept, sides = _owners(texture.tree)
    kept_rows, side_rows = np.flatnonzero(~is_known[kept]), np.flatnonzero(~is_known[sides])
    for channel in channels:
        rows = np.concatenate([channel.kept_values[kept_rows], channel.split_values[side_rows]])
        parts.append(rows.T)
    counts = {"runs": runs.now.size, "cells": new.size, "kept": kept_rows.size, "sides": side_rows.size}
    numbers = [planes(each) for each in (gaps, runs.before, runs.lengths)]
    return counts, b"".join([*numbers, *(np.ascontiguousarray(part, np.uint8).data for part in parts)])


def _known(before: OctreeTexture, after: OctreeTexture) -> tuple[Int64s, Bools]:
    """Return each cell's old number, and whether it is unchanged; the number is undefined for others."""
    old = np.full(after.tree.n_cells, -1)
    firsts, old_firsts = (tree.arrays.level_cells.tolist() for tree in (after.tree, before.tree))
    levels = zip(before.tree.walk(), after.tree.walk(), firsts, old_firsts, strict=False)
    for (had, _), (codes, _), first, first_old in levels:
        at = np.minimum(np.searchsorted(had, codes), had.size - 1)
        old_here = old[first : first + codes.size]
        old_here[:] = np.where(had[at] == codes, first_old + at, -1)
    is_known = old >= 0
    now, was = (
        np.column_stack([*_nodes_data(each.tree), each.tree.arrays.flags]) for each in (after, before)
    )
    is_known &= (now == was[old]).all(axis=1)
    kept, sides = _owners(after.tree)
    old_kept, old_sides = _owners(before.tree)
    is_same = [_rows_of(kept, old_kept, old, is_known), _rows_of(sides, old_sides, old, is_known)]
    for name, channel in after.channels.items():
        past = before.channels[name]
        is_known &= (channel.values == past.values[old]).all(axis=1)
        for owners, at, values, old_values in (
            (kept, is_same[0], channel.kept_values, past.kept_values),
            (sides, is_same[1], channel.split_values, past.split_values),
        ):
            chosen = at >= 0
            differ = (values[chosen] != old_values[at[chosen]]).any(axis=1)
            is_known[owners[chosen][differ]] = False
    return old, is_known


def _as_before(before: OctreeTexture, after: OctreeTexture) -> Bools:
    """Return which cells are unchanged, for trees with the same cells."""
    arrays, old_arrays = after.tree.arrays, before.tree.arrays
    differs = arrays.flags != old_arrays.flags
    nodes = node_cells(arrays)
    differs[nodes] |= arrays.areas[nodes] != old_arrays.areas[nodes]
    kept, sides = _owners(after.tree)
    for name, channel in after.channels.items():
        past = before.channels[name]
        for now, was in zip(channel.values.T, past.values.T, strict=True):
            differs |= now != was
        differs[kept[(channel.kept_values != past.kept_values).any(axis=1)]] = True
        differs[sides[(channel.split_values != past.split_values).any(axis=1)]] = True
    is_same: Bools = ~differs
    return is_same


def _rows_of(owners: Int64s, old_owners: Int64s, old: Int64s, is_known: Bools) -> Int64s:
    """Return each row's old row, or −1 where its cell is new or has other flags."""
    first = np.searchsorted(owners, owners)
    at = np.searchsorted(old_owners, old[owners]) + np.arange(owners.size) - first
    return np.where(is_known[owners], at, -1)


def _nodes_data(tree: Octree) -> tuple[Uint8s, Uint8s]:
    """Return masks (cells, 2) and areas of nodes; 0 for leaves."""
    arrays = tree.arrays
    nodes = node_cells(arrays)
    masks, areas = np.zeros((tree.n_cells, 2), np.uint8), np.zeros(tree.n_cells, np.uint8)
    for word in range(2):
        masks[nodes, word] = masks_of(arrays.groups, word)[: nodes.size]
    areas[nodes] = arrays.areas[nodes]
    return masks, areas


def _owners(tree: Octree) -> tuple[Int64s, Int64s]:
    """Return the cells that own the rows of kept nodes, and of split cells."""
    return tree.kept.cells.astype(np.int64), rows_of(tree.split).cells
