"""Lookups that list what they blend, and the rows that they read, in place of blending it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Floats, Int32s, Int64s, Uint32s
from octex.field.field import Field
from octex.field.footprints import Footprints, Probes, spread
from octex.field.lookups import ChannelRows, Query, _levels, _Lookup, _pass_on
from octex.field.sinks import list_taps
from octex.field.splines import FILTERS
from octex.field.taps import BLOCK, Taps
from octex.tree.placement import Placement

_NO_SLOPES = np.empty((0, 3), np.float32)


class TapList(NamedTuple):
    """What points blend, in compressed sparse rows: Σ weights · values, over a point's taps, is its value.

    Rows count cells, then the rows of the kept nodes, then those of the split cells.
    """

    starts: Int64s  # (n + 1,)   a point's taps are those from its start to the next one's
    rows: Int64s  # (taps,)   none twice for a point
    weights: Float32s  # (taps,)   1 in sum for each point


def list_blends(
    field: Field,
    placement: Placement,
    points: Floats,
    query: Query,
    channel: ChannelRows,
    alpha: ChannelRows | None,
) -> tuple[TapList, int]:
    """List what `lookups.look_up` blends of a channel; also the first row that is not finite, or −1."""
    task = _Listing(field, placement, query, [channel], alpha, [], [])
    if query.footprints is None:
        return task.leaves_listed(points)
    return task.footprints_listed(points, query.footprints)


def rows_read(
    field: Field, placement: Placement, points: Floats, query: Query, channel: ChannelRows
) -> tuple[dict[int, Uint32s], int]:
    """Return the rows that `lookups.look_up` reads of a channel, each once, by the level looked at.

    Also the first row of points that is not finite, or −1.
    """
    return _Listing(field, placement, query, [channel], None, [], []).rows_by_level(points)


class _Listing(_Lookup):
    """Lookups of one channel."""

    def leaves_listed(self, points: Floats) -> tuple[TapList, int]:
        """List the blends of leaves."""
        counts, rows, weights = [np.zeros(1, np.int64)], [np.empty(0, np.uint32)], [np.empty(0, np.float32)]
        for begin in range(0, len(points), BLOCK):
            some = slice(begin, begin + BLOCK)
            normals = None if self._query.normals is None else self._query.normals[some]
            taps, fault = self._taps(self._field, points[some], normals)
            if fault >= 0:
                return _of(counts, rows, weights), begin + fault
            self._weigh(taps, always=False)
            room = int((taps.ends - taps.starts).sum()) + 1
            starts, found = np.empty(len(points[some]) + 1, np.int64), np.empty(room, np.uint32)
            shares = np.empty(room, np.float32)
            list_taps(taps, 1.0, starts, found, shares, _NO_SLOPES)
            counts.append(np.diff(starts))
            rows.append(found[: starts[-1]])
            weights.append(shares[: starts[-1]])
        return _of(counts, rows, weights), -1

    def footprints_listed(self, points: Floats, footprints: Footprints) -> tuple[TapList, int]:
        """List the blends of footprints: looks at all levels, added up."""
        counts, rows, weights = [np.zeros(1, np.int64)], [np.empty(0, np.int64)], [np.empty(0, np.float32)]
        is_finite = np.isfinite(points).all(axis=1)
        if not is_finite.all():
            return _of(counts, rows, weights), int(np.argmin(is_finite))
        depth, code = self._field.tree.max_depth, FILTERS.index(self._query.filter)
        for run, by_level in spread(points, footprints, self._placement.size, depth, code):
            n_points = run.stop - run.start
            keys, parts = [np.empty(0, np.int64)], [np.empty(0)]
            for _, taps, owner_of, shares in self._looks(run, by_level):
                self._weigh(taps, always=True)
                look, at = _each(taps)
                keys.append(owner_of[look].astype(np.int64) << 32 | taps.rows[at])
                parts.append(taps.weights[at].astype(np.float64) * shares[look])
            key, which = np.unique(np.concatenate(keys), return_inverse=True)
            part = np.bincount(which, np.concatenate(parts), key.size)
            owner, row = key >> 32, key & 0xFFFFFFFF
            totals = np.bincount(owner, part, n_points)
            (bare,) = np.nonzero(totals == 0)
            is_any = (totals[owner] != 0) & (part != 0)
            owner, row, part = owner[is_any], row[is_any], part[is_any] / totals[owner[is_any]]
            if bare.size:  # alpha is zero throughout
                numbers = run.start + bare
                again = _Listing(
                    *(self._field, self._placement, self._query.of(numbers), self._channels, None, [], [])
                )
                more, _ = again.footprints_listed(points[numbers], footprints.of(numbers))
                owner = np.concatenate([owner, np.repeat(bare, np.diff(more.starts))])
                order = np.argsort(owner, kind="stable")
                row = np.concatenate([row, more.rows])[order]
                part = np.concatenate([part, more.weights])[order]
            counts.append(np.bincount(owner, minlength=n_points))
            rows.append(row)
            weights.append(part.astype(np.float32))
        return _of(counts, rows, weights), -1

    def rows_by_level(self, points: Floats) -> tuple[dict[int, Uint32s], int]:
        """List the rows that are read, each once."""
        depth, code = self._field.tree.max_depth, FILTERS.index(self._query.filter)
        found: dict[int, list[Uint32s]] = {}
        if self._query.footprints is None:
            for begin in range(0, len(points), BLOCK):
                some = slice(begin, begin + BLOCK)
                normals = None if self._query.normals is None else self._query.normals[some]
                taps, fault = self._taps(self._field, points[some], normals)
                if fault >= 0:
                    return {}, begin + fault
                found.setdefault(depth, []).append(np.unique(taps.rows[_each(taps)[1]]))
        else:
            is_finite = np.isfinite(points).all(axis=1)
            if not is_finite.all():
                return {}, int(np.argmin(is_finite))
            for run, by_level in spread(points, self._query.footprints, self._placement.size, depth, code):
                for level, taps, _, _ in self._looks(run, by_level):
                    found.setdefault(level, []).append(np.unique(taps.rows[_each(taps)[1]]))
        return {level: np.unique(np.concatenate(rows)) for level, rows in found.items()}, -1

    def _looks(self, run: slice, by_level: dict[int, Probes]) -> Iterator[tuple[int, Taps, Int32s, Float32s]]:
        """Yield the level, the taps, the owners and the shares of the looks of a run, in blocks."""
        normals = None if self._query.normals is None else self._query.normals[run]
        for level, looks in _levels(by_level, self._field.tree.max_depth):
            left, owners = np.zeros(len(looks.points), np.float32), looks.owners
            for begin in range(0, len(looks.points), BLOCK):
                some = slice(begin, begin + BLOCK)
                facing = None if normals is None else normals[owners[some]]
                taps, _ = self._taps(self._field.level(level), looks.points[some], facing, left[some])
                yield level, taps, owners[some], looks.shares[some]
            _pass_on(by_level, level, looks, left)

    def _weigh(self, taps: Taps, *, always: bool) -> None:
        """Let taps weigh as the channel's do."""
        for _ in self._weighed(taps, False, always=always):
            pass


def _each(taps: Taps) -> tuple[Int64s, Int64s]:
    """Return of each tap, point after point, the point's number and where it is."""
    counts = taps.ends - taps.starts
    points = np.repeat(np.arange(counts.size), counts)
    before = np.cumsum(counts) - counts
    return points, np.arange(points.size) + (taps.starts - before)[points]


def _of(
    counts: Sequence[Int64s], rows: Sequence[Uint32s] | Sequence[Int64s], weights: Sequence[Float32s]
) -> TapList:
    """Join the taps of runs of points, of which so many are each point's."""
    return TapList(
        np.cumsum(np.concatenate(counts)), np.concatenate(rows).astype(np.int64), np.concatenate(weights)
    )


def joined(lists: Sequence[TapList]) -> TapList:
    """Join the taps of points, one list's after another's."""
    if len(lists) == 1:
        return lists[0]
    none = np.zeros(1, np.int64), np.empty(0, np.int64), np.empty(0, np.float32)
    _, *more = zip(none, *lists, strict=True)
    counts = [none[0], *(np.diff(each.starts) for each in lists)]
    return _of(counts, *more)
