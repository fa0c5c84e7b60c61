"""Lists the rows that lookups blend and read: for solvers, and for files that are read in part."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from octex.arrays import Float64s, Floats, Int64s, Uint32s
from octex.field.blend import joined, listed
from octex.field.lookups import Lookup
from octex.field.taps import TapList, Taps
from octex.tree.morton import encode_cells
from octex.tree.octree import distinct

_NO_ROWS = np.empty(0, np.uint32)


class Reads(NamedTuple):
    """The rows and cells that lookups of a channel read at a level."""

    rows: Uint32s  # (n,)   each once
    cells: Int64s  # (m,)   the Morton codes of those that hold the probes' points, ascending


class Listing(Lookup):
    """Lists lookups of one channel. All methods raise NotFiniteError."""

    def blends(self, points: Floats) -> TapList:
        """List the taps of points."""
        return joined(
            list(self._leaves(points) if self._query.footprints is None else self._of_probes(points))
        )

    def _leaves(self, points: Floats) -> Iterator[TapList]:
        for _, taps in self.each_block(points):
            self._weigh_all(taps, always=False)
            yield listed(taps)

    def _of_probes(self, points: Floats) -> Iterator[TapList]:
        """List the taps of footprints: probes at all levels, added up."""
        for run, by_level in self.each_run(points):
            n_points = run.stop - run.start
            keys, parts = [np.empty(0, np.int64)], [np.empty(0)]
            for _, probes, taps in self.each_probe(run, by_level):
                self._weigh_all(taps, always=True)
                probe, at = _each_tap(taps)
                keys.append(probes.owners[probe].astype(np.int64) << 32 | taps.rows[at])
                parts.append(taps.weights[at].astype(np.float64) * probes.shares[probe])
            key, which = np.unique(np.concatenate(keys), return_inverse=True)
            part = np.bincount(which, np.concatenate(parts), key.size)
            owner, row = key >> 32, key & 0xFFFFFFFF
            totals = np.bincount(owner, part, n_points)
            (bare,) = np.nonzero(totals == 0)
            is_any = (totals[owner] != 0) & (part != 0)
            owner, row, part = owner[is_any], row[is_any], part[is_any] / totals[owner[is_any]]
            if bare.size:  # alpha is zero throughout
                numbers = run.start + bare
                query = self._query.of(numbers)
                again = Listing(self._field, self._placement, query, self._channels, None)
                more = again.blends(points[numbers])
                owner = np.concatenate([owner, np.repeat(bare, np.diff(more.starts))])
                order = np.argsort(owner, kind="stable")
                row = np.concatenate([row, more.rows])[order]
                part = np.concatenate([part, more.weights])[order]
            starts = np.cumsum(np.append(0, np.bincount(owner, minlength=n_points)))
            yield TapList(starts, row, part.astype(np.float32))

    def reads(self, points: Floats) -> dict[int, Reads]:
        """List the rows and cells read, by level."""
        depth = self._field.depth
        if self._query.footprints is None:
            return joined_reads({depth: self._read(taps, depth)} for _, taps in self.each_block(points))
        probes = (each for run in self.each_run(points) for each in self.each_probe(*run))
        return joined_reads({level: self._read(taps, level)} for level, _, taps in probes)

    def _read(self, taps: Taps, level: int) -> Reads:
        """Return the rows that the latest block reads, and the cells that hold its points."""
        coords = self.finder(self._field.level(level)).coords
        return Reads(distinct(taps.rows[_each_tap(taps)[1]]).astype(np.uint32), _cells_at(coords, level))

    def _weigh_all(self, taps: Taps, *, always: bool) -> None:
        """Weigh taps as lookups of the channel do."""
        for _ in self.each_weighed(taps, False, always=always):
            pass


def _cells_at(coords: Float64s, level: int) -> Int64s:
    """Return the Morton codes of the cells of a level that hold points of texture space, ascending."""
    side = 1 << level
    return distinct(encode_cells(np.minimum((coords * side).astype(np.int64), side - 1)))


def joined_reads(found: Iterable[Mapping[int, Reads]]) -> dict[int, Reads]:
    """Join the reads of several blocks of points, or channels, by level."""
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
    """Return for each tap, point after point, the point's number and the tap's index."""
    counts = taps.ends - taps.starts
    points = np.repeat(np.arange(counts.size), counts)
    before = np.cumsum(counts) - counts
    return points, np.arange(points.size) + (taps.starts - before)[points]
