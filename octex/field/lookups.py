"""Lookups: what is asked of points, by tiles, bricks or the walk; footprints at all levels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import repeat
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Floats, Int64s, Uint8s
from octex.channels import ColorSpace, decode
from octex.field.blend import Sums, add_up, blend, blend_slopes, divide, new_sums, weigh_by_alpha
from octex.field.bricks import Asked, Values, look_up_crowded, new_bricks
from octex.field.field import Field, Finder, NotFiniteError
from octex.field.footprints import NO_SLOPES, Footprints, Probes, passed_on, spread
from octex.field.splines import FILTERS, QUADRATIC
from octex.field.taps import BLOCK, Taps, place_points
from octex.field.tiled import Additions, Search, Weighed, look_up_points
from octex.field.values import Codes
from octex.field.weights import Weighing, weigh_taps
from octex.field.windows import new_walk
from octex.jit import direct, unlocked
from octex.tree.order import order_of
from octex.tree.placement import Placement
from octex.tree.search import Positions

#: Points for which it is worth while to sort them.
_LEAST_SORTED = 64
#: What is no more than this of a weight is rounding.
_ROUNDED = np.float32(1e-6)
_NO_GRADIENTS = np.empty((0, 1, 3), np.float32)
_NO_TABLE = np.empty(0, np.float32)
_NO_VECTORS = np.empty((0, 3), np.float32)
_NO_BYTES = np.empty(0, np.uint8)
_NO_ROWS = np.empty((1, 1), np.uint8)
_NO_DOUBLES = np.empty((0, 3))
_NO_SHARES = np.empty(0, np.float32)
NO_ADDITIONS = Additions(
    np.empty(0, np.int32),
    _NO_SHARES,
    _NO_SHARES,
    Sums(np.empty((0, 2)), np.empty((0, 2, 3))),
)
#: What searches and channels hold is unlocked where they are made.
_look_up_points = direct(look_up_points)


#: The part of looks that mixes opposite facings, and its derivatives; empty where it is not wanted.
Left = tuple[Float32s, Float32s]
_NO_LEFT: Left = _NO_SHARES, NO_SLOPES


class Query(NamedTuple):
    """What is asked of points. Its arrays have a row for each."""

    filter: str
    footprints: Footprints | None = None  # None: the leaves where the points are
    normals: Float32s | None = None  # (n, 3)   what faces away from them is not seen
    #: For footprints without normals: which cells (cells,) of a level's field are left to the next finer
    #: level, see `weights.mark_mixed`.
    mixed: Callable[[int], Uint8s] | None = None

    def of(self, points: Int64s) -> Query:
        """Return what is asked of some of the points."""
        return self._replace(
            footprints=None if self.footprints is None else self.footprints.of(points),
            normals=None if self.normals is None else self.normals[points],
        )


class ChannelRows(NamedTuple):
    """A channel of a texture, as lookups read it."""

    codes: Codes
    space: ColorSpace | None  # of float32 values that are still to be decoded
    is_alpha: bool


def look_up(
    field: Field,
    placement: Placement,
    points: Floats,
    query: Query,
    channels: Sequence[ChannelRows],
    alpha: ChannelRows | None,
    answers: Sequence[Float32s],
    gradients: Sequence[Float32s],
) -> int:
    """Write the field of channels at rest positions (n, 3) to ``answers`` (n, components), decoded.

    ``gradients`` (n, components, 3) or none. Channels that are not alpha weigh by it, if there is one, except
    where it is zero throughout. Returns the first row of points that is not finite, or −1.
    """
    if not channels:
        return -1
    task = Lookup(field, placement, query, channels, alpha, answers, gradients)
    try:
        if query.footprints is not None:
            task.footprints(points)
        elif len(channels) == 1 or not task.is_sortable(len(points)):
            task.at(points)
        else:
            for channel, answer in zip(channels, answers, strict=True):
                Lookup(field, placement, query, [channel], alpha, [answer], ()).at(points)
    except NotFiniteError as error:
        return error.row
    return -1


def _positions(points: Floats) -> Positions:
    """Return rest positions (n, 3) as kernels take them, like `Positions.of`."""
    points = unlocked(points)
    return Positions(points, _NO_DOUBLES) if points.itemsize == 4 else Positions(_NO_VECTORS, points)


class PlainLookup:
    """Leaves of one channel looked up by tiles, again and again: what points do not change is prepared."""

    def __init__(self, search: Search, placement: Placement, channel: Weighed) -> None:
        self._before = placement.origin, placement.size, _NO_VECTORS, channel
        self._search = search
        self._components = channel.codes.values.shape[1]

    def at(self, points: Floats) -> Float32s | None:
        """Return the values at rest positions (n, 3), float32 or float64, as kernels take them.

        None where tiles alone do not answer: `look_up` does, or finds what is wrong.
        """
        n = len(points)
        answer = np.empty((n, self._components), np.float32)
        given = *_positions(points), *self._before, answer, _NO_GRADIENTS
        found = _look_up_points(self._search, *given, NO_ADDITIONS, 0, np.empty(n, np.int64))
        return answer if found == (n, -1, 0) else None


def plain_lookup(
    field: Field, placement: Placement, filter: str, channel: ChannelRows, alpha: ChannelRows | None
) -> PlainLookup | None:
    """Prepare plain lookups of a channel; None where leaves are not looked up by tiles."""
    task = Lookup(field, placement, Query(filter), [channel], alpha, [], [])
    if task._channel is None or not field.cells.has_tiles_for(FILTERS.index(filter)):
        return None
    search = Search(FILTERS.index(filter), field.cells, task.weighing(field))
    return PlainLookup(search, placement, task._channel)


class Lookup:
    """One lookup: what is the same for all its blocks of points."""

    def __init__(
        self,
        field: Field,
        placement: Placement,
        query: Query,
        channels: Sequence[ChannelRows],
        alpha: ChannelRows | None,
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
        #: The numbers of channels; alpha itself comes first: then it weighs all others.
        is_alpha = list(map(attrgetter("is_alpha"), channels))
        self._numbers = sorted(range(len(channels)), key=is_alpha.__getitem__, reverse=True)
        values = (alpha or channels[self._numbers[0]]).codes.values
        #: The first values that are read, as bytes, to be asked for ahead.
        self._rows: Uint8s = values.view(np.uint8).reshape(len(values), -1)
        self._channel: Weighed | None = None
        if len(channels) == 1:
            own, weighing = channels[0], None if channels[0].is_alpha else alpha
            other = weighing or own
            is_alike = own.codes.values.dtype == other.codes.values.dtype
            if own.space is other.space is None and is_alike:  # else many pairs of types would be compiled
                self._channel = Weighed(own.codes, other.codes, weighing is not None)

    def is_sortable(self, count: int) -> bool:
        """Say whether so many points are looked up by bricks, a channel after the other."""
        query, spaces = self._query, set(map(attrgetter("space"), self._channels))
        is_bare = query.normals is None and not self._gradients and query.filter == "quadratic"
        has_bricks = self._field.tiles is None and count >= _LEAST_SORTED
        return is_bare and has_bricks and {*spaces, self._alpha and self._alpha.space} == {None}

    def at(self, points: Floats) -> None:
        """Look up the leaves in the way that suits. Raises NotFiniteError, as all lookups do."""
        code = FILTERS.index(self._query.filter)
        if self._channel is None or not self._field.cells.has_tiles_for(code):
            self.untiled(points)
            return
        rim = self._look_up(self._field, points, NO_ADDITIONS, self._query.normals)
        if rim.size:
            self._look_again(points, rim, [0], self._alpha, Lookup.untiled)

    def untiled(self, points: Floats) -> None:
        """Look up the leaves by bricks, or the walk."""
        if len(self._channels) == 1 and self.is_sortable(len(points)):
            self.sorted(points)
        else:
            self.leaves(points)

    def sorted(self, points: Floats) -> None:
        """Look up one channel's leaves by bricks, in the order of space."""
        (channel,), (results,) = self._channels, self._answers
        alpha = None if channel.is_alpha or self._alpha is None else self._alpha.codes
        places, missed = np.empty((len(points), 3)), np.empty(len(points), np.int32)
        fault = place_points(_positions(points), *self._placement, places)
        if fault >= 0:
            raise NotFiniteError(fault)
        asked = Asked(places, order_of(places), results, missed)
        values = Values.of(channel.codes, alpha)
        n_missed = look_up_crowded(self._field.mixed, values, asked, new_bricks(), new_walk())
        if n_missed:
            rows = missed[:n_missed].astype(np.int64)
            self._look_again(points, rows, [0], self._alpha, Lookup.leaves)

    def _look_up(self, here: Field, points: Floats, additions: Additions, normals: Float32s | None) -> Int64s:
        """Look one channel up by a level's tiles; return which points these do not answer.

        ``normals`` are those of the owners of looks.
        """
        assert self._channel is not None
        cells = here.cells_in(self._field)
        search = Search(FILTERS.index(self._query.filter), cells, self.weighing(here))
        gradients = self._gradients[0] if self._gradients else _NO_GRADIENTS
        facing = _NO_VECTORS if normals is None else unlocked(normals)
        given = *_positions(points), *self._placement, facing, self._channel, self._answers[0], gradients
        lost = np.empty(len(points), np.int64)
        done = n_lost = 0
        while done < len(points):
            done, lacking, more = _look_up_points(search, *given, additions, done, lost[n_lost:])
            n_lost += more
            if lacking >= 0:
                here.build(lacking)
            elif done < len(points):
                raise NotFiniteError(done)
        return lost[:n_lost]

    def weighing(self, here: Field) -> Weighing:
        """Return what weighs the taps of a level."""
        query, mixed = self._query, _NO_BYTES
        faces = query.normals is not None
        if not (here is self._field or query.mixed is None or faces) and here.tree.split.cells.size:
            mixed = query.mixed(here.depth)
        return here.weighing(self._field, faces, mixed)

    def leaves(self, points: Floats) -> None:
        """Look up the leaves, in any tree."""
        scale = 1.0 / self._placement.size
        # Values of cells are asked for with their tiles; what is walked to is not, nor what faces a normal.
        is_asked = self._query.normals is None and self._field.cells.first >= 0
        for rows, taps in self.each_block(points):
            for number, used, codes in self.each_weighed(taps, is_asked, always=False):
                results = self._answers[number][rows]
                blend(used, codes, is_asked and self._alpha is None and number == self._numbers[0], results)
                if self._gradients:
                    blend_slopes(used, codes, scale, results, self._gradients[number][rows])

    def each_block(self, points: Floats) -> Iterator[tuple[slice, Taps]]:
        """Yield the taps of the leaves, weighed, a block of points after another."""
        for begin in range(0, len(points), BLOCK):
            rows = slice(begin, begin + BLOCK)
            normals = None if self._query.normals is None else self._query.normals[rows]
            taps, fault = self.weighed_taps(self._field, points[rows], normals)
            if fault >= 0:
                raise NotFiniteError(begin + fault)
            yield rows, taps

    def each_run(self, points: Floats) -> Iterator[tuple[slice, dict[int, Probes]]]:
        """Yield the looks of footprints: see `footprints.spread`."""
        assert self._query.footprints is not None
        is_finite = np.isfinite(points)
        if not is_finite.all():
            raise NotFiniteError(int(np.argmin(is_finite)) // 3)
        depth, code = self._field.depth, FILTERS.index(self._query.filter)
        return spread(points, self._query.footprints, self._placement.size, depth, code)

    def footprints(self, points: Floats) -> None:
        """Look footprints up: add the looks at all levels up."""
        gradient = bool(self._gradients)
        # From points to sums at once.
        is_bare = self._channel is not None and not self._channel.has_alpha
        is_added = is_bare and self._query.filter == "quadratic" and not gradient
        for run, by_level in self.each_run(points):
            n_points = run.stop - run.start
            sums = list(map(new_sums, repeat(n_points), self._answers, repeat(gradient)))
            if gradient:
                for level, looks in by_level.items():
                    by_level[level] = looks._replace(slopes=np.zeros((looks.shares.size, 3), np.float32))
            normals = None if self._query.normals is None else self._query.normals[run]
            for level in range(self._field.depth + 1):
                if level in by_level:
                    here, looks = self._field.level(level), by_level[level]
                    count = len(looks.points) if self.weighing(here).mixed.size else 0
                    left = np.zeros(count, np.float32), np.zeros((count if gradient else 0, 3), np.float32)
                    rim: Int64s | None = None
                    if is_added and here.cells.has_tiles_for(QUADRATIC):
                        own = Additions(looks.owners, looks.shares, left[0], sums[0])
                        rim = self._look_up(here, looks.points, own, normals)
                    if rim is None or rim.size:
                        self._add_by_taps(here, looks, rim, normals, sums, left)
                    pass_on(by_level, level, looks, *left)
            bare = np.zeros(n_points, np.bool_)
            for number, channel in enumerate(self._channels):
                gradients = self._gradients[number][run] if gradient else _NO_GRADIENTS
                divide(sums[number], 1.0 / self._placement.size, self._answers[number][run], gradients)
                if self._alpha is not None and not channel.is_alpha:
                    bare |= sums[number].values[:, -1] == 0.0
            if bare.any():
                numbers = [n for n, channel in enumerate(self._channels) if not channel.is_alpha]
                rows = run.start + np.flatnonzero(bare)
                self._look_again(points, rows, numbers, None, Lookup.footprints)

    def _add_by_taps(
        self,
        here: Field,
        looks: Probes,
        which: Int64s | None,
        normals: Float32s | None,
        sums: Sequence[Sums],
        left: Left,
    ) -> None:
        """Add looks at a level up, or some of them, in any tree."""
        for begin in range(0, len(looks.points) if which is None else which.size, BLOCK):
            run = slice(begin, begin + BLOCK)
            rows = run if which is None else which[run]
            owners, slopes = looks.owners[rows], looks.slopes[rows] if self._gradients else looks.slopes
            facing = None if normals is None else normals[owners]
            parts = left[0][rows] if left[0].size else left[0], left[1][rows] if left[1].size else left[1]
            taps, _ = self.weighed_taps(here, looks.points[rows], facing, parts)
            for number, used, codes in self.each_weighed(taps, False, always=True):
                add_up(used, codes, False, owners, looks.shares[rows], slopes, sums[number])
            if which is not None and left[0].size:
                left[0][rows] = parts[0]

    def _look_again(
        self,
        points: Floats,
        rows: Int64s,
        numbers: Sequence[int],
        alpha: ChannelRows | None,
        look_up_points: Callable[[Lookup, Floats], None],
    ) -> None:
        """Look some channels of some points up anew, in another way."""
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

    def weighed_taps(
        self,
        here: Field,
        points: Floats,
        normals: Float32s | None,
        left: Left = _NO_LEFT,
    ) -> tuple[Taps, int]:
        """Return the taps of a block of points in a level's field, weighed; and the first that is not finite.

        ``left`` takes what mixes opposite facings, and its derivatives: see `weights.weigh_taps`.
        """
        if here.depth not in self._finders:
            options = {"gradient": bool(self._gradients), "adds": self._query.footprints is not None}
            self._finders[here.depth] = Finder(here, self._query.filter, whole=self._field, **options)
        taps, fault = self._finders[here.depth].at(points, self._placement, self._rows)
        if normals is not None or here is not self._field:
            facing = _NO_VECTORS if normals is None else normals
            taps = weigh_taps(taps, self.weighing(here), facing, _NO_ROWS, *left)
        return taps, fault

    def each_weighed(self, taps: Taps, is_asked: bool, *, always: bool) -> Iterator[tuple[int, Taps, Codes]]:
        """Yield the channels by number, and their taps and codes; alpha weighs those that are not alpha."""
        alpha, is_covered = self._alpha, False
        for number in self._numbers:
            channel = self._channels[number]
            if alpha is not None and not channel.is_alpha and not is_covered:
                weighing = (taps, alpha.codes) if alpha.space is None else _as_read(taps, alpha)
                weigh_by_alpha(*weighing, is_asked, always)
                is_covered = True
            used, codes = taps, channel.codes
            if channel.space is not None:
                used, codes = _as_read(taps, channel)
            yield number, used, codes


def _as_read(taps: Taps, channel: ChannelRows) -> tuple[Taps, Codes]:
    """Return taps and codes as `blend` takes them: float32 numbers decoded, a row for each tap."""
    assert channel.space is not None
    end = int(taps.ends.max(initial=0))
    values, kept_values, split_values, _ = channel.codes
    rows = taps.rows[:end].astype(np.int64)
    found = values[np.minimum(rows, len(values) - 1)]
    beyond = rows >= len(values)
    found[beyond] = np.concatenate([kept_values, split_values])[rows[beyond] - len(values)]
    decoded, none = decode(found, channel.space), found[:0]
    return taps._replace(rows=np.arange(end, dtype=np.uint32)), Codes(decoded, none, none, _NO_TABLE)


def pass_on(
    by_level: dict[int, Probes], level: int, looks: Probes, left: Float32s, slopes: Float32s = NO_SLOPES
) -> None:
    """Look at the next level for what was not seen at this, and how that changes: see `passed_on`."""
    if left.size:
        none = Probes(looks.points[:0], looks.owners[:0], looks.shares[:0], looks.slopes[:0])
        more = passed_on(looks, left, slopes, _ROUNDED, by_level.get(level + 1, none))
        if more.shares.size:
            by_level[level + 1] = more
