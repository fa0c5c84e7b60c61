"""What lookups blend and read, listed: for solvers, and for files that are read by parts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Floats, Int64s, Uint32s
from octex.field.blend import Listed, joined, listed
from octex.field.field import Field, NotFiniteError
from octex.field.footprints import NO_SLOPES
from octex.field.lookups import ChannelRows, Lookup, Query
from octex.field.taps import Taps, place_points
from octex.tree.morton import encode_cells
from octex.tree.octree import distinct
from octex.tree.placement import Placement
from octex.tree.search import Positions

_NO_ROWS, _NO_COVERS = np.empty(0, np.uint32), np.empty(0, np.float32)


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
) -> Listed:
    """List what `lookups.look_up` blends of a channel. Raises NotFiniteError."""
    task = _Listing(field, placement, query, [channel], alpha, [], [])
    return task.leaves_listed(points) if query.footprints is None else task.footprints_listed(points)


class Reads(NamedTuple):
    """What lookups of a channel read at a level."""

    rows: Uint32s  # (n,)   each once
    cells: Int64s  # (m,)   the Morton codes of those that hold the looks' points, ascending


def reads_of(
    field: Field,
    placement: Placement,
    points: Floats,
    query: Query,
    channel: ChannelRows,
    *,
    cells_alone: bool = False,
) -> dict[int, Reads]:
    """Return what `lookups.look_up` reads of a channel, by the level looked at.

    With ``cells_alone`` no rows, and only the cells that no content of the tree changes. Raises
    NotFiniteError.
    """
    listing = _Listing(field, placement, query, [channel], None, [], [])
    return listing.cells(points) if cells_alone else listing.reads(points)


class _Listing(Lookup):
    """Lookups of one channel."""

    def leaves_listed(self, points: Floats) -> Listed:
        found = []
        for _, taps in self.each_block(points):
            self._weigh_all(taps, always=False)
            found.append(listed(taps, 1.0))
        return joined(found)

    def footprints_listed(self, points: Floats) -> Listed:
        """List the blends of footprints: looks at all levels, added up."""
        found = []
        for run, by_level in self.each_run(points):
            n_points = run.stop - run.start
            keys, parts = [np.empty(0, np.int64)], [np.empty(0)]
            for _, looks, taps in self.each_look(run, by_level):
                self._weigh_all(taps, always=True)
                look, at = _each_tap(taps)
                keys.append(looks.owners[look].astype(np.int64) << 32 | taps.rows[at])
                parts.append(taps.weights[at].astype(np.float64) * looks.shares[look])
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
                more = again.footprints_listed(points[numbers])
                owner = np.concatenate([owner, np.repeat(bare, np.diff(more.starts))])
                order = np.argsort(owner, kind="stable")
                row = np.concatenate([row, more.rows])[order]
                part = np.concatenate([part, more.weights])[order]
            starts = np.cumsum(np.append(0, np.bincount(owner, minlength=n_points)))
            found.append(Listed(starts, row, part.astype(np.float32), NO_SLOPES, _NO_COVERS))
        return joined(found)

    def reads(self, points: Floats) -> dict[int, Reads]:
        """List what is read at each level."""
        depth = self._field.depth
        if self._query.footprints is None:
            return joined_reads({depth: self._read(taps, depth)} for _, taps in self.each_block(points))
        looks = (each for run in self.each_run(points) for each in self.each_look(*run))
        return joined_reads({level: self._read(taps, level)} for level, _, taps in looks)

    def cells(self, points: Floats) -> dict[int, Reads]:
        """List the cells that hold points that are looked at, at each level, whatever is stored."""
        depth = self._field.depth
        places = np.empty((len(points), 3))
        fault = place_points(Positions.of(points), *self._placement, places)
        if fault >= 0:
            raise NotFiniteError(fault)
        if self._query.footprints is None:
            return {depth: Reads(_NO_ROWS, _cells_at(places, depth))}
        found = []
        for _, by_level in self.each_run(points):
            for level, looks in by_level.items():
                places = np.empty((len(looks.points), 3))
                place_points(Positions.of(looks.points), *self._placement, places)
                found.append({level: Reads(_NO_ROWS, _cells_at(places, level))})
        return joined_reads(found)

    def _read(self, taps: Taps, level: int) -> Reads:
        """Return what the taps of the latest block of points read, and which cells hold these."""
        places = self.finder(self._field.level(level)).places
        return Reads(distinct(taps.rows[_each_tap(taps)[1]]).astype(np.uint32), _cells_at(places, level))

    def _weigh_all(self, taps: Taps, *, always: bool) -> None:
        """Let taps weigh as the channel's do."""
        for _ in self.each_weighed(taps, False, always=always):
            pass


def _cells_at(places: Float64s, level: int) -> Int64s:
    """Return the Morton codes of the cells of a level that hold points of texture space, ascending."""
    side = 1 << level
    return distinct(encode_cells(np.minimum((places * side).astype(np.int64), side - 1)))


def joined_reads(found: Iterable[Mapping[int, Reads]]) -> dict[int, Reads]:
    """Join what several blocks of points, or lookups of several channels, read by level."""
    by_level: dict[int, list[Reads]] = {}
    for levels in found:
        for level, read in levels.items():
            by_level.setdefault(level, []).append(read)
    return {
        level: Reads(
            distinct(np.concatenate([each.rows for each in parts])).astype(np.uint32),
            distinct(np.concatenate([each.cells for each in parts])),
        )
        for level, parts in by_level.items()
    }


def _each_tap(taps: Taps) -> tuple[Int64s, Int64s]:
    """Return of each tap, point after point, the point's number and where it is."""
    counts = taps.ends - taps.starts
    points = np.repeat(np.arange(counts.size), counts)
    before = np.cumsum(counts) - counts
    return points, np.arange(points.size) + (taps.starts - before)[points]
