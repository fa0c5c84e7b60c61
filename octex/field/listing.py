"""Lists the rows that lookups blend and read: for solvers, and for files that are read in part."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from octex.arrays import Floats, Int64s, Uint32s, in_runs
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
            all_keys, all_weights = [np.empty(0, np.int64)], [np.empty(0)]
            for _, probes, taps in self.each_probe(run, by_level):
                self._weigh_all(taps, always=True)
                probe, at = _each_tap(taps)
                all_keys.append(probes.owners[probe].astype(np.int64) << 32 | taps.rows[at])
                all_weights.append(taps.weights[at].astype(np.float64) * probes.shares[probe])
            keys, which = np.unique(np.concatenate(all_keys), return_inverse=True)
            weights = np.bincount(which, np.concatenate(all_weights), keys.size)
            owners, rows = keys >> 32, keys & 0xFFFFFFFF
            totals = np.bincount(owners, weights, n_points)
            (transparent,) = np.nonzero(totals == 0)
            has_weight = (totals[owners] != 0) & (weights != 0)
            owners, rows, weights = owners[has_weight], rows[has_weight], weights[has_weight]
            weights = weights / totals[owners]
            if transparent.size:  # alpha is zero throughout
                numbers = run.start + transparent
                query = self._query.of(numbers)
                listing = Listing(self._field, self._placement, query, self._channels, None)
                unweighted = listing.blends(points[numbers])
                owners = np.concatenate([owners, np.repeat(transparent, np.diff(unweighted.starts))])
                order = np.argsort(owners, kind="stable")
                rows = np.concatenate([rows, unweighted.rows])[order]
                weights = np.concatenate([weights, unweighted.weights])[order]
            starts = np.cumsum(np.append(0, np.bincount(owners, minlength=n_points)))
            yield TapList(starts, rows, weights.astype(np.float32))

    def reads(self, points: Floats) -> dict[int, Reads]:
        """List the rows and cells read, by level."""
        depth = self._field.depth
        if self._query.footprints is None:
            return joined_reads({depth: self._read(taps, depth)} for _, taps in self.each_block(points))
        probes = (each for run in self.each_run(points) for each in self.each_probe(*run))
        return joined_reads({level: self._read(taps, level)} for level, _, taps in probes)

    def _read(self, taps: Taps, level: int) -> Reads:
        """Return the rows that the latest block reads, and the cells that hold its points."""
        coords, side = self.finder(self._field.level(level)).coords, 1 << level
        cells = encode_cells(np.minimum((coords * side).astype(np.int64), side - 1))
        return Reads(distinct(taps.rows[_each_tap(taps)[1]]).astype(np.uint32), distinct(cells))

    def _weigh_all(self, taps: Taps, *, always: bool) -> None:
        """Weigh taps as lookups of the channel do."""
        for _ in self.each_weighed(taps, False, always=always):
            pass


def joined_reads(reads_of_blocks: Iterable[Mapping[int, Reads]]) -> dict[int, Reads]:
    """Join the reads of several blocks of points, or channels, by level."""
    by_level: dict[int, list[Reads]] = {}
    for levels in reads_of_blocks:
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
    return np.repeat(np.arange(counts.size), counts), in_runs(taps.starts, counts)
