"""Lookups of points by tiles, bricks or the walk; footprints at all levels.

They are also listed, for solvers and for files that are read in part.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import repeat
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Floats, Int64s, Uint8s, Uint32s, in_runs
from octex.field.blend import (
    ProbeSums,
    add_up,
    blend,
    blend_slopes,
    divide,
    joined,
    listed,
    new_sums,
    weigh_by_alpha,
)
from octex.field.bricks import NUMBER_BITS, SORTED, Targets, look_up_crowded, new_bricks
from octex.field.field import NO_BYTES, NO_PASSED, NO_VECTORS, Field, Finder, NotFiniteError, positions
from octex.field.footprints import Footprints, Probes, passed_on, spread
from octex.field.splines import FILTERS, QUADRATIC, QUARTIC
from octex.field.taps import Codes, TapList, Taps, to_coordinates
from octex.field.tiled import Additions, TileSearch, Weighed, look_up_tiled
from octex.field.weights import Weighing
from octex.jit import direct, unlocked
from octex.tree.morton import encode_cells
from octex.tree.octree import distinct
from octex.tree.placement import Placement
from octex.tree.search import keys_of, put_rows

#: Fewer points are not sorted.
_LEAST_SORTED = 64
#: Relative weights up to this are rounding errors.
_ROUNDED = np.float32(1e-6)
_NO_GRADIENTS = np.empty((0, 1, 3), np.float32)
NO_ADDITIONS = Additions(
    *(np.empty(0, np.int32), NO_PASSED[0], NO_PASSED[0]),
    ProbeSums(np.empty((0, 1)), np.empty(0), np.empty((0, 1, 3)), np.empty((0, 3))),
)
#: Result of `look_up_tiled` where tiles find all points.
_ALL_FOUND = 0, 0, -1
#: Searches and channels hold unlocked arrays.
_look_up_tiled = direct(look_up_tiled)


class Query(NamedTuple):
    """The options of a lookup. Its arrays have a row for each point."""

    filter: str
    footprints: Footprints | None = None  # None: the leaves where the points are
    normals: Float32s | None = None  # (n, 3)   hide surface that faces away
    #: For footprints without normals: marks a level's cells that pass on to the next finer level, see
    #: `weights.mark_mixed`.
    mixed: Callable[[int], Uint8s] | None = None

    def of(self, points: Int64s) -> Query:
        """Select points."""
        return self._replace(
            footprints=None if self.footprints is None else self.footprints.of(points),
            normals=None if self.normals is None else self.normals[points],
        )


class ChannelRows(NamedTuple):
    """A channel of a texture, as lookups read it."""

    codes: Codes
    is_alpha: bool


class Lookup:
    """One lookup, for all its blocks of points.

    Channels other than alpha are weighted by it, except where it is zero throughout. ``answers`` (n,
    components) take the decoded values, and ``gradients`` (n, components, 3), if any, their derivatives.
    """

    def __init__(
        self,
        field: Field,
        placement: Placement,
        query: Query,
        channels: Sequence[ChannelRows],
        alpha: ChannelRows | None,
        answers: Sequence[Float32s] = (),
        gradients: Sequence[Float32s] = (),
    ) -> None:
        self._field = field
        self._placement = placement
        self._query = query
        self._channels = channels
        self._alpha = alpha
        self._answers = answers
        self._gradients = gradients
        self._finders: dict[int, Finder] = {}
        #: Channel numbers, alpha first: it then weights all others.
        self._numbers = sorted(range(len(channels)), key=lambda number: not channels[number].is_alpha)
        values = (alpha or channels[self._numbers[0]]).codes.values
        #: The first values to read, as bytes, for prefetching.
        self._rows: Uint8s = values.view(np.uint8).reshape(len(values), -1)
        #: The channel if there is only one, and `look_up_tiled` takes it.
        self._channel: Weighed | None = None
        if len(channels) == 1:
            channel, weighing = channels[0], None if channels[0].is_alpha else alpha
            other = weighing or channel
            if channel.codes.values.dtype == other.codes.values.dtype:  # else many pairs would be compiled
                self._channel = Weighed(channel.codes, other.codes, weighing is not None)

    @property
    def is_tiled(self) -> bool:
        """Whether tiles look leaves up from points to values in one call."""
        code = FILTERS.index(self._query.filter)
        return self._channel is not None and code != QUARTIC and self._field.tiles_for(code) is not None

    def is_sortable(self, count: int) -> bool:
        """Return whether bricks look up ``count`` points, one channel after another."""
        query = self._query
        is_bare = query.normals is None and not self._gradients and query.filter == "quadratic"
        return is_bare and self._field.tiles is None and _LEAST_SORTED <= count < 1 << NUMBER_BITS

    def look_up(self, points: Floats) -> None:
        """Look up rest positions (n, 3) by the fastest path. All lookups raise NotFiniteError."""
        if self._query.footprints is not None:
            self.look_up_footprints(points)
        elif len(self._channels) > 1 and self.is_sortable(len(points)):
            for channel, answer in zip(self._channels, self._answers, strict=True):
                one = Lookup(self._field, self._placement, self._query, [channel], self._alpha, [answer])
                one.look_up(points)
        elif not self.is_tiled:
            self.look_up_untiled(points)
        else:
            rim = self._by_tiles(self._field, points, NO_ADDITIONS, self._query.normals)
            if rim.size:
                self._look_again(points, rim, [0], self._alpha, Lookup.look_up_untiled)

    def prepare_few(self) -> Callable[[Floats], Float32s | None] | None:
        """Prepare lookups of a few points of leaves by tiles; None where there are no tiles.

        The result takes rest positions as kernels do. It returns None where tiles alone do not answer: call
        `look_up`.
        """
        if not self.is_tiled or self._channel is None:
            return None
        code, components = FILTERS.index(self._query.filter), self._channel.codes.values.shape[1]
        tiles = next(self._field.searched(code))
        search = TileSearch(code, tiles, self._field.n_cells - 1, False, self.weighing(self._field))
        fixed = self._placement.origin, self._placement.size, NO_VECTORS, self._channel

        def look_up(points: Floats) -> Float32s | None:
            answer = np.empty((len(points), components), np.float32)
            lost = np.empty((2, len(points)), np.int64)
            task = *positions(points), *fixed, answer, _NO_GRADIENTS
            is_all = _look_up_tiled(search, *task, NO_ADDITIONS, lost) == _ALL_FOUND
            return answer if is_all else None

        return look_up

    def look_up_untiled(self, points: Floats) -> None:
        """Look up the leaves without tiles."""
        if len(self._channels) == 1 and self.is_sortable(len(points)):
            self.look_up_sorted(points)
        else:
            self.look_up_leaves(points)

    def look_up_sorted(self, points: Floats) -> None:
        """Look up one channel's leaves by bricks, in Morton order."""
        (channel,), (results,) = self._channels, self._answers
        alpha = channel.codes._replace(values=channel.codes.values[:0])
        if self._alpha is not None and not channel.is_alpha:
            alpha = self._alpha.codes
        coords, missed = np.empty((len(points), 3)), np.empty(len(points), np.int32)
        fault = to_coordinates(positions(points), *self._placement, coords)
        if fault >= 0:
            raise NotFiniteError(fault)
        keys = keys_of(coords, SORTED, NUMBER_BITS)
        keys.sort()
        targets = Targets(coords, keys, results.reshape(-1), results.shape[1], missed)
        tree = self._field.tree
        n_missed = look_up_crowded(tree.arrays, tree.kept.cells, channel.codes, alpha, targets, new_bricks())
        if n_missed:
            rows = missed[:n_missed].astype(np.int64)
            self._look_again(points, rows, [0], self._alpha, Lookup.look_up_leaves)

    def _by_tiles(
        self, field: Field, points: Floats, additions: Additions, normals: Float32s | None
    ) -> Int64s:
        """Look up by a level's tiles, else by coarser ones; return the points for the walk."""
        code, weighing = FILTERS.index(self._query.filter), self.weighing(field)
        task = points, additions, normals
        empty: Int64s | None = None
        rims: list[Int64s] = []
        for number, tiles in enumerate(field.searched(code)):
            search = TileSearch(code, tiles, field.n_cells - 1, number > 0, weighing)
            empty, rim = self._search(search, empty, *task)
            rims.append(rim)
            if not empty.size:
                break
        rim = np.concatenate(rims)
        for tiles in field.painted[1:] if rim.size else ():
            search = TileSearch(code, tiles, field.n_cells - 1, False, weighing)
            rim = np.concatenate(self._search(search, rim, *task))
        return rim

    def _search(
        self,
        search: TileSearch,
        which: Int64s | None,
        points: Floats,
        additions: Additions,
        normals: Float32s | None,
    ) -> tuple[Int64s, Int64s]:
        """Look up points, by default all, and return those without cells and those for the walk."""
        assert self._channel is not None
        adds, answers = additions is not NO_ADDITIONS, self._answers[0]
        selected, results = additions, answers
        slopes = self._gradients[0] if self._gradients else _NO_GRADIENTS
        normals = NO_VECTORS if normals is None else normals
        if which is not None:
            points = np.take(points, which, axis=0)
            if adds:
                passed = np.zeros(which.size if additions.passed.size else 0, np.float32)
                selected = Additions(additions.owners[which], additions.shares[which], passed, additions.sums)
            else:
                results = np.empty((which.size, answers.shape[1]), np.float32)
                slopes = np.empty((which.size if self._gradients else 0, answers.shape[1], 3), np.float32)
                normals = np.take(normals, which, axis=0) if len(normals) else normals
        lost = np.empty((2, len(points)), np.int64)
        where = *positions(points), *self._placement, unlocked(normals)
        n_empty, n_rim, fault = _look_up_tiled(search, *where, self._channel, results, slopes, selected, lost)
        if fault >= 0:
            raise NotFiniteError(fault)
        empty, rim = lost[0, :n_empty], lost[1, :n_rim]
        if which is None:
            return empty, rim
        if additions.passed.size:
            additions.passed[which] = selected.passed
        if not adds:
            put_rows(results, which, answers)
            if self._gradients:
                self._gradients[0][which] = slopes
        return which[empty], which[rim]

    def weighing(self, field: Field) -> Weighing:
        """Return the weighing of a level's taps."""
        query, mixed = self._query, NO_BYTES
        faces = query.normals is not None
        if not (field is self._field or query.mixed is None or faces) and field.tree.split.cells.size:
            mixed = query.mixed(field.depth)
        return field.weighing(self._field, faces, mixed)

    def look_up_leaves(self, points: Floats) -> None:
        """Look up the leaves of any tree."""
        scale = 1.0 / self._placement.size
        # Tiles prefetch the values of cells; walks and split rows do not.
        is_prefetched = self._query.normals is None and self._field.tiles is not None
        for rows, taps in self.each_block(points):
            for number, codes in self.each_weighed(taps, is_prefetched, always=False):
                results = self._answers[number][rows]
                is_first = self._alpha is None and number == self._numbers[0]
                blend(taps, codes, is_prefetched and is_first, results)
                if self._gradients:
                    blend_slopes(taps, codes, scale, results, self._gradients[number][rows])

    def finder(self, field: Field) -> Finder:
        """Return the finder of a level's taps."""
        if field.depth not in self._finders:
            options = {"gradient": bool(self._gradients), "adds": self._query.footprints is not None}
            finder = Finder(field, self._placement, self._query.filter, whole=self._field, **options)
            self._finders[field.depth] = finder
        return self._finders[field.depth]

    def each_block(self, points: Floats) -> Iterator[tuple[slice, Taps]]:
        """Yield the weighted taps of the leaves, block after block."""
        field = self._field
        return self.finder(field).blocks(points, self.weighing(field), self._query.normals, rows=self._rows)

    def each_run(self, points: Floats) -> Iterator[tuple[slice, dict[int, Probes]]]:
        """Yield the probes of footprints: see `footprints.spread`."""
        assert self._query.footprints is not None
        is_finite = np.isfinite(points)
        if not is_finite.all():
            raise NotFiniteError(int(np.argmin(is_finite)) // 3)
        depth, code = self._field.depth, FILTERS.index(self._query.filter)
        return spread(points, self._query.footprints, self._placement.size, depth, code)

    def look_up_footprints(self, points: Floats) -> None:
        """Look footprints up: add the probes at all levels up."""
        gradient = bool(self._gradients)
        # By tiles, from points to sums at once.
        is_bare = self._channel is not None and not self._channel.has_alpha
        is_added = is_bare and self._query.filter == "quadratic" and not gradient
        for run, by_level in self.each_run(points):
            n_points = run.stop - run.start
            sums = list(map(new_sums, repeat(n_points), self._answers, repeat(gradient)))
            if gradient:
                for level, probes in by_level.items():
                    by_level[level] = probes._replace(slopes=np.zeros((probes.shares.size, 3), np.float32))
            for _, probes, taps in self.each_probe(run, by_level, sums[0] if is_added else None):
                for number, codes in self.each_weighed(taps, False, always=True):
                    add_up(taps, codes, probes.owners, probes.shares, probes.slopes, sums[number])
            bare = np.zeros(n_points, np.bool_)
            for number, channel in enumerate(self._channels):
                gradients = self._gradients[number][run] if gradient else _NO_GRADIENTS
                divide(sums[number], 1.0 / self._placement.size, self._answers[number][run], gradients)
                if self._alpha is not None and not channel.is_alpha:
                    bare |= sums[number].totals == 0.0
            if bare.any():
                numbers = [n for n, channel in enumerate(self._channels) if not channel.is_alpha]
                rows = run.start + np.flatnonzero(bare)
                self._look_again(points, rows, numbers, None, Lookup.look_up_footprints)

    def each_probe(
        self, run: slice, by_level: dict[int, Probes], sums: ProbeSums | None = None
    ) -> Iterator[tuple[int, Probes, Taps]]:
        """Yield the probes of a run, level by level and block after block, and their weighted taps.

        With ``sums``, probes that tiles can look up are added to them instead.
        """
        normals = None if self._query.normals is None else self._query.normals[run]
        for level in range(self._field.depth + 1):
            if level not in by_level:
                continue
            field, probes = self._field.level(level), by_level[level]
            weighing = self.weighing(field)
            rows: slice | Int64s = slice(None)  # those that tiles do not answer
            count = len(probes.points) if weighing.mixed.size else 0
            passed = np.zeros(count, np.float32), np.zeros((count if self._gradients else 0, 3), np.float32)
            if sums is not None and field.tiles_for(QUADRATIC) is not None:
                additions = Additions(probes.owners, probes.shares, passed[0], sums)
                rows = self._by_tiles(field, probes.points, additions, normals)
            untiled, parts = probes.of(rows), (passed[0][rows] if count else passed[0], passed[1])
            untiled_normals = None if normals is None else normals[untiled.owners]
            task = untiled.points, weighing, untiled_normals, parts, self._rows
            for block, taps in self.finder(field).blocks(*task):
                yield level, untiled.of(block), taps
            if count:  # the next level answers for mixed cells
                passed[0][rows] = parts[0]
                finer = passed_on(probes, *passed, _ROUNDED, by_level.get(level + 1, probes.of(slice(0))))
                if finer.shares.size:
                    by_level[level + 1] = finer

    def _look_again(
        self,
        points: Floats,
        rows: Int64s,
        numbers: Sequence[int],
        alpha: ChannelRows | None,
        look_up_points: Callable[[Lookup, Floats], None],
    ) -> None:
        """Look up channels ``numbers`` at points ``rows`` by another path."""
        answers = [np.empty((rows.size, self._answers[n].shape[1]), np.float32) for n in numbers]
        gradients = [np.empty((*answer.shape, 3), np.float32) for answer in answers if self._gradients]
        channels = [self._channels[n] for n in numbers]
        query = self._query.of(rows)
        again = Lookup(self._field, self._placement, query, channels, alpha, answers, gradients)
        look_up_points(again, points[rows])
        for at, number in enumerate(numbers):
            self._answers[number][rows] = answers[at]
            if self._gradients:
                self._gradients[number][rows] = gradients[at]

    def each_weighed(self, taps: Taps, is_prefetched: bool, *, always: bool) -> Iterator[tuple[int, Codes]]:
        """Yield each channel's number and codes; alpha weights the taps of all but itself."""
        alpha = self._alpha
        for number in self._numbers:
            channel = self._channels[number]
            if alpha is not None and not channel.is_alpha:
                weigh_by_alpha(taps, alpha.codes, is_prefetched, always)
                alpha = None
            yield number, channel.codes


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
