"""Lookups: the looks of footprints at all levels, through sources, stages and sinks (see `taps`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import ColorSpace, decode
from octex.field.bricks import Values, new_bricks
from octex.field.crowded import Asked, look_up_crowded
from octex.field.field import Field, Finder
from octex.field.footprints import Footprints, Looks, spread
from octex.field.order import order_of
from octex.field.plain import look_up_plain
from octex.field.sinks import Codes, Sums, add_up, blend, blend_slopes, cover, divide
from octex.field.spline import QUADRATIC_TABLES, QUARTIC_TABLES
from octex.field.splines import FILTERS
from octex.field.stages import leave_mixed, weigh_by_area
from octex.field.taps import BLOCK, Float32s, Int64s, Points, Taps, place_points
from octex.field.windows import new_walk
from octex.tree.placement import Placement

Int32s = npt.NDArray[np.int32]
Integers = npt.NDArray[np.int32 | np.int64]

#: Points for which it is worth while to sort them.
_LEAST_SORTED = 64
#: What is no more than this of a weight is rounding.
_ROUNDED = np.float32(1e-6)
_NO_OWNERS = np.empty(0, np.int32)
_NO_GRADIENTS = np.empty((0, 1, 3), np.float32)
_NO_TABLE = np.empty(0, np.float32)


class Query(NamedTuple):
    """What is asked of points. Its arrays have a row for each."""

    filter: str
    footprints: Footprints | None = None  # None: the leaves where the points are
    normals: Float32s | None = None  # (n, 3)   what faces away from them is not seen
    #: For footprints without normals: how far opposite facings of the split cells of a level's field differ.
    #: Cells where they do by ``threshold`` or more are left to the next finer level.
    spreads: Callable[[int], Float32s] | None = None
    threshold: float = 0.0

    def of(self, points: Int64s) -> Query:
        """Return what is asked of some of the points."""
        return self._replace(
            footprints=None if self.footprints is None else self.footprints.of(points),
            normals=None if self.normals is None else self.normals[points],
        )


class Stored(NamedTuple):
    """A channel of a texture, as lookups read it."""

    codes: Codes
    space: ColorSpace | None  # of float32 values that are still to be decoded
    is_alpha: bool


def look_up(
    field: Field,
    placement: Placement,
    points: Points,
    query: Query,
    channels: Sequence[Stored],
    alpha: Stored | None,
    answers: Sequence[Float32s],
    gradients: Sequence[Float32s],
) -> int:
    """Write the field of channels at rest positions (n, 3) to ``answers`` (n, components), decoded.

    ``gradients`` (n, components, 3) or none. Channels that are not alpha weigh by it, if there is one, except
    where it is zero throughout. Returns the first row of points that is not finite, or −1.
    """
    if not channels:
        return -1
    task = _Lookup(field, placement, query, channels, alpha, answers, gradients)
    if query.footprints is not None:
        return task.footprints(points, query.footprints)
    spaces, is_bare = [each.space for each in channels], query.normals is None and not gradients
    if is_bare and field.tiles is None and query.filter == "quadratic" and len(points) >= _LEAST_SORTED:
        alone = (
            ([channel], alpha, [results], ()) for channel, results in zip(channels, answers, strict=True)
        )
        return max(_Lookup(field, placement, query, *each).mixed(points) for each in alone)
    is_plain = is_bare and spaces == [None] and (alpha is None or channels[0].is_alpha)
    return task.plain(points) if is_plain and field.tiles is not None else task.leaves(points)


class _Lookup:
    """One lookup: what is the same for all its blocks of points."""

    def __init__(
        self,
        field: Field,
        placement: Placement,
        query: Query,
        channels: Sequence[Stored],
        alpha: Stored | None,
        answers: Sequence[Float32s],
        gradients: Sequence[Float32s],
    ) -> None:
        self._field = field
        self._placement = placement
        self._query = query
        self._channels = channels
        self._alpha = alpha
        self._answers = answers
        self._gradients = gradients
        self._finders: dict[int, Finder] = {}
        self._places = np.empty((0, 3))
        # Alpha itself comes first: then it weighs all others.
        self._order = sorted(range(len(channels)), key=lambda number: not channels[number].is_alpha)
        # The first values that are read, to be asked for ahead.
        first = alpha.codes.values if alpha else channels[self._order[0]].codes.values
        self._rows = first.view(np.uint8).reshape(len(first), -1)

    def plain(self, points: Points) -> int:
        """Look up one channel's leaves, as far as tiles have them."""
        (channel,), (results,), field = self._channels, self._answers, self._field
        missed = np.empty(len(points), np.int64)
        code, tables = FILTERS.index(self._query.filter), (QUADRATIC_TABLES, QUARTIC_TABLES)
        tiles = field.tiles_for(code)
        assert tiles is not None
        n_missed, fault = look_up_plain(
            *(code, tiles, tables, points, *self._placement),
            *(channel.codes, self._rows, results, missed),
        )
        is_even = field.tiles is not None or n_missed < _LEAST_SORTED
        look_up_rest = self.leaves if is_even else self.sorted
        return self._rest(points, missed[:n_missed], look_up_rest) if fault < 0 else fault

    def mixed(self, points: Points) -> int:
        """Look up one channel's leaves, of several depths."""
        (channel,), alpha = self._channels, self._alpha
        if channel.space is not None:
            return self.leaves(points)
        if self._field.painted is not None and (alpha is None or channel.is_alpha):
            return self.plain(points)
        return self.leaves(points) if alpha is not None and alpha.space is not None else self.sorted(points)

    def sorted(self, points: Points) -> int:
        """Look up one channel's leaves in the order of space."""
        (channel,), (results,) = self._channels, self._answers
        alpha = None if channel.is_alpha or self._alpha is None else self._alpha.codes
        places, missed = np.empty((len(points), 3)), np.empty(len(points), np.int32)
        fault = place_points(points, *self._placement, places)
        if fault >= 0:
            return fault
        asked = Asked(places, order_of(places), results, missed)
        values = Values.of(channel.codes, alpha)
        n_missed = look_up_crowded(self._field.mixed, values, asked, new_bricks(), new_walk())
        return self._rest(points, missed[:n_missed], self.leaves)

    def _rest(self, points: Points, which: Integers, look_up_rest: Callable[[Points], int]) -> int:
        """Look up what is left of one channel's leaves."""
        if which.size:
            (results,) = self._answers
            found = np.empty((which.size, results.shape[1]), np.float32)
            self._answers = [found]
            look_up_rest(points[which])
            results[which] = found
        return -1

    def leaves(self, points: Points) -> int:
        """Look up the leaves."""
        scale = 1.0 / self._placement.size
        # Values of cells are asked for with their tiles; what is walked to is not, nor what faces a normal.
        is_asked = self._alpha is None and self._query.normals is None and self._field.tiles is not None
        for begin in range(0, len(points), BLOCK):
            rows = slice(begin, begin + BLOCK)
            normals = None if self._query.normals is None else self._query.normals[rows]
            taps, fault = self._taps(self._field, points[rows], normals)
            if fault >= 0:
                return begin + fault
            for number, channel in self._weighed(taps, always=False):
                used, codes = _as_read(taps, channel)
                results = self._answers[number][rows]
                blend(used, codes, is_asked and number == self._order[0], results)
                if self._gradients:
                    blend_slopes(used, codes, scale, results, self._gradients[number][rows])
        return -1

    def footprints(self, points: Points, footprints: Footprints) -> int:
        """Look footprints up: add the looks at all levels up."""
        is_finite = np.isfinite(points)
        if not is_finite.all():
            return int(np.argmin(is_finite)) // 3
        depth, code = self._field.tree.max_depth, FILTERS.index(self._query.filter)
        for run, by_level in spread(points, footprints, self._placement.size, depth, code):
            bare = self._add_looks(run, by_level)
            if bare.size:
                self._look_without_alpha(points, run, bare)
        return -1

    def _add_looks(self, run: slice, by_level: dict[int, Looks]) -> Int64s:
        """Add the looks of a run of points up, and write what they show.

        Returns the points whose looks are all of alpha zero.
        """
        n_points = run.stop - run.start
        gradient = bool(self._gradients)
        sums = [Sums.of(n_points, channel.codes.components, gradient) for channel in self._channels]
        for level, looks in _levels(by_level, self._field.tree.max_depth):
            here = self._field.level(level)
            left = np.zeros(len(looks.points), np.float32)
            for begin in range(0, len(looks.points), BLOCK):
                rows = slice(begin, begin + BLOCK)
                owners = _NO_OWNERS if looks.owners is None else looks.owners[rows]
                if looks.owners is None and begin:
                    owners = np.arange(begin, begin + len(looks.points[rows]), dtype=np.int32)
                normals = None
                if self._query.normals is not None:
                    normals = self._query.normals[run]
                    normals = normals[rows] if looks.owners is None else normals[owners]
                taps, _ = self._taps(here, looks.points[rows], normals, left[rows])
                for number, channel in self._weighed(taps, always=True):
                    used, codes = _as_read(taps, channel)
                    add_up(used, codes, owners, looks.shares[rows], sums[number])
            _pass_on(by_level, level, looks, left)
        bare = np.zeros(n_points, np.bool_)
        for number, channel in enumerate(self._channels):
            gradients = self._gradients[number][run] if gradient else _NO_GRADIENTS
            divide(sums[number], 1.0 / self._placement.size, self._answers[number][run], gradients)
            if self._alpha is not None and not channel.is_alpha:
                bare |= sums[number].totals == 0.0
        return np.flatnonzero(bare)

    def _look_without_alpha(self, points: Points, run: slice, which: Int64s) -> None:
        """Look some points of a run up again, as if there were no alpha."""
        rows = run.start + which
        numbers = [n for n, channel in enumerate(self._channels) if not channel.is_alpha]
        answers = [np.empty((rows.size, self._answers[n].shape[1]), np.float32) for n in numbers]
        gradients = [np.empty((*answer.shape, 3), np.float32) for answer in answers if self._gradients]
        channels = [self._channels[n] for n in numbers]
        look_up(
            *(self._field, self._placement, points[rows], self._query.of(rows)),
            *(channels, None, answers, gradients),
        )
        for at, number in enumerate(numbers):
            self._answers[number][rows] = answers[at]
            if self._gradients:
                self._gradients[number][rows] = gradients[at]

    def _taps(
        self, here: Field, points: Points, normals: Float32s | None, left: Float32s | None = None
    ) -> tuple[Taps, int]:
        """Return the taps of a block of points in a level's field, weighed; and the first that is not finite.

        ``left`` takes what mixes opposite facings.
        """
        if len(self._places) < len(points):
            self._places = np.empty((len(points), 3))
        places = self._places[: len(points)]
        fault = place_points(points, *self._placement, places)
        if here.tree.max_depth not in self._finders:
            self._finders[here.tree.max_depth] = Finder(
                here, self._query.filter, gradient=bool(self._gradients), whole=self._field
            )
        taps = self._finders[here.tree.max_depth].find(places, self._rows)
        field = self._field
        if here is not field:
            weigh_by_area(taps, field.areas_of_averages(here.tree.max_depth)[: here.tree.n_cells])
        if normals is not None:
            taps = here.facing(taps, normals, field)
        elif left is not None and self._mixes(here):
            assert self._query.spreads is not None
            spreads = self._query.spreads(here.tree.max_depth)
            leave_mixed(taps, here.facings, spreads, self._query.threshold, left)
        return taps, fault

    def _mixes(self, here: Field) -> bool:
        """Say whether a level's averages may mix opposite facings."""
        return here is not self._field and self._query.spreads is not None and here.tree.split.cells.size > 0

    def _weighed(self, taps: Taps, *, always: bool) -> Iterator[tuple[int, Stored]]:
        """Yield the channels by number, those that are not alpha after their taps weigh by it."""
        alpha, is_covered = self._alpha, False
        for number in self._order:
            channel = self._channels[number]
            if alpha is not None and not channel.is_alpha and not is_covered:
                used, codes = _as_read(taps, alpha)
                cover(used, codes, always)
                is_covered = True
            yield number, channel


def _as_read(taps: Taps, channel: Stored) -> tuple[Taps, Codes]:
    """Return taps and codes as sinks take them: float32 numbers decoded, a row for each tap."""
    if channel.space is None:
        return taps, channel.codes
    end = int(taps.ends.max(initial=0))
    values, kept_values, split_values, _ = channel.codes
    rows = taps.rows[:end].astype(np.int64)
    found = values[np.minimum(rows, len(values) - 1)]
    beyond = rows >= len(values)
    found[beyond] = np.concatenate([kept_values, split_values])[rows[beyond] - len(values)]
    decoded, none = decode(found, channel.space), found[:0]
    return taps._replace(rows=np.arange(end, dtype=np.uint32)), Codes(decoded, none, none, _NO_TABLE)


def _levels(by_level: dict[int, Looks], depth: int) -> Iterator[tuple[int, Looks]]:
    """Yield the levels that have looks, coarse before fine; looks may be added below the latest."""
    for level in range(depth + 1):
        if level in by_level:
            yield level, by_level[level]


def _pass_on(by_level: dict[int, Looks], level: int, looks: Looks, left: Float32s) -> None:
    """Look at the next level for what was not seen at this."""
    unseen = np.flatnonzero(left > _ROUNDED)
    if not unseen.size:
        return
    owners = _owners(looks)
    more = Looks(looks.points[unseen], owners[unseen], looks.shares[unseen] * left[unseen])
    if level + 1 in by_level:
        there = by_level[level + 1]
        more = Looks(
            np.concatenate([there.points, more.points]),
            np.concatenate([_owners(there), more.owners]),
            np.concatenate([there.shares, more.shares]),
        )
    by_level[level + 1] = more


def _owners(looks: Looks) -> Int32s:
    return np.arange(len(looks.points), dtype=np.int32) if looks.owners is None else looks.owners
