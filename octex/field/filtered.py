"""Filtered lookups: the looks of footprints at all levels, and what each sees, put together."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.field.blend import AREA_WEIGHTS, Codes
from octex.field.blocks import Points
from octex.field.facings import ALL, FACING, MOST_SEEN, UNMIXED, Sight, all_in_sight, see_all
from octex.field.field import Field, Taps
from octex.field.footprints import Footprints, Looks, spread
from octex.field.splines import FILTERS
from octex.jit import kernel
from octex.tree.placement import Placement

Float32s = npt.NDArray[np.float32]
Int64s = npt.NDArray[np.int64]
Int32s = npt.NDArray[np.int32]
Uint8s = npt.NDArray[np.uint8]

#: What leaves are looked up with: they do not weigh by their areas.
NO_AREAS: Uint8s = np.empty(0, np.uint8)

#: Looks whose taps are kept at once.
_LOOKS_OF_TAPS = 1 << 13
#: Weight of looks off the surface: decides only where all are.
_OFF = np.float32(1e-9)
#: What is no more than this of a weight is rounding.
_ROUNDED = np.float32(1e-6)


class Query(NamedTuple):
    """What is asked of points. Its arrays have a row for each."""

    filter: str
    footprints: Footprints | None = None  # None: the leaves where the points are
    normals: Float32s | None = None  # (n, 3)   what faces away from them is not seen
    #: For lookups without normals: how far opposite facings of the split cells of a level's field differ.
    #: Cells where they do by ``threshold`` or more are left to the next finer level.
    spreads: Callable[[int], Float32s] | None = None
    threshold: float = 0.0

    @property
    def is_plain(self) -> bool:
        """Whether it is the field over the leaves that is asked for."""
        return self.footprints is None and self.normals is None

    def of(self, points: Int64s) -> Query:
        """Return what is asked of some of the points."""
        return self._replace(
            footprints=None if self.footprints is None else self.footprints.of(points),
            normals=None if self.normals is None else self.normals[points],
        )


class _Found(NamedTuple):
    """What looks at one level have found."""

    looks: Looks
    taps: Taps


def filtered_colors(
    field: Field, points: Points, placement: Placement, query: Query, codes: Codes, results: Float32s
) -> Int64s | None:
    """Write colours at rest positions (n, 3) to ``results``, as `Field.colors` does."""
    missed = []
    for run, by_level in _runs(field, points, placement, query):
        n_points = run.stop - run.start
        sums, totals = np.zeros((n_points, 3), np.float32), np.zeros(n_points, np.float32)
        for level, looks in _levels(field, by_level):
            n = len(looks.points)
            here = field.level(level)
            sight = _sight(field, here, query, run, looks)
            alone = len(by_level) == 1 and looks.owners is None and sight.mode != UNMIXED
            found = results[run] if alone else np.zeros((n, 3), np.float32)
            covers = np.empty(n, np.float32)
            left = np.empty(0 if sight.mode == ALL else n, np.float32)
            areas = _areas(field, here)
            missing = here.colors(
                looks.points, placement, query.filter, sight, codes, areas, found, covers, left
            )
            if missing is None:
                return None
            if alone:  # nothing to put together
                missed.append(run.start + missing)
                break
            _add_colors(_owners(looks), looks.shares, covers, found, sums, totals)
            if sight.mode == UNMIXED:
                _pass_on(by_level, level, looks, left)
        else:
            without = np.empty(n_points, np.int64)
            n_missed = _finish_colors(sums, totals, results[run], without)
            missed.append(run.start + without[:n_missed])
    return np.concatenate(missed) if missed else np.empty(0, np.int64)


def filtered_taps(
    field: Field, points: Points, placement: Placement, query: Query, *, gradient: bool = False
) -> Iterator[Taps]:
    """Yield the taps of consecutive runs of points, as `Field.batches` does.

    Rows of the split table are counted after those of kept nodes.
    """
    for run, by_level in _runs(field, points, placement, query, _LOOKS_OF_TAPS):
        found = []
        for level, looks in _levels(field, by_level):
            here = field.level(level)
            taps = here.taps(looks.points, placement, query.filter, gradient=gradient)
            _weigh_by_area(_areas(field, here)[: here.tree.n_cells], *taps)
            if here.tree.kept.cells.size:
                kept = taps.rows >= here.tree.n_cells
                taps.rows[kept] += np.uint32(field.tree.n_cells - here.tree.n_cells)
            sight = _sight(field, here, query, run, looks)
            if sight.mode != ALL:
                taps, left = _seen(sight, taps)
                if sight.mode == UNMIXED:
                    _pass_on(by_level, level, looks, left)
            found.append(_Found(looks, taps))
        yield _joined(found, run.stop - run.start, gradient)


def _runs(
    field: Field, points: Points, placement: Placement, query: Query, room: int | None = None
) -> Iterator[tuple[slice, dict[int, Looks]]]:
    """Yield runs of points, and their looks by level."""
    depth = field.tree.max_depth
    if query.footprints is not None:
        more = () if room is None else (room,)
        yield from spread(points, query.footprints, placement.size, depth, FILTERS.index(query.filter), *more)
        return
    step = room or max(len(points), 1)
    for first in range(0, len(points), step):
        run = slice(first, min(first + step, len(points)))
        n = run.stop - first
        yield run, {depth: Looks(points[run], None, np.ones(n, np.float32))}


def _levels(field: Field, by_level: dict[int, Looks]) -> Iterator[tuple[int, Looks]]:
    """Yield the levels that have looks, coarse before fine; looks may be added below the latest."""
    for level in range(field.tree.max_depth + 1):
        if level in by_level:
            yield level, by_level[level]


def _areas(field: Field, here: Field) -> Uint8s:
    """Return the areas that a level's averages weigh by; none for the leaves."""
    return NO_AREAS if here is field else field.areas_of_averages(here.tree.max_depth)


def _owners(looks: Looks) -> Int32s:
    return np.arange(len(looks.points), dtype=np.int32) if looks.owners is None else looks.owners


def _sight(field: Field, here: Field, query: Query, run: slice, looks: Looks) -> Sight:
    """Say what looks at a level see."""
    first_kept = field.tree.n_cells
    first_row = first_kept + field.tree.kept.cells.size
    no_spreads = np.empty(0, np.float32)
    if query.normals is not None:
        normals = query.normals[run]
        if looks.owners is not None:
            normals = normals.take(looks.owners, axis=0)
        return Sight(FACING, here.facings, first_kept, first_row, normals, no_spreads, 0.0)
    if query.spreads is not None and here is not field and here.tree.split.cells.size:
        spreads = query.spreads(here.tree.max_depth)
        return Sight(
            UNMIXED,
            here.facings,
            first_kept,
            first_row,
            np.empty((0, 3), np.float32),
            spreads,
            query.threshold,
        )
    return all_in_sight()


def _pass_on(by_level: dict[int, Looks], level: int, looks: Looks, left: Float32s) -> None:
    """Look at the next level for what was not seen at this."""
    unseen = np.flatnonzero(left > _ROUNDED)
    if not unseen.size:
        return
    more = Looks(looks.points[unseen], _owners(looks)[unseen], looks.shares[unseen] * left[unseen])
    if level + 1 in by_level:
        there = by_level[level + 1]
        more = Looks(
            np.concatenate([there.points, more.points]),
            np.concatenate([_owners(there), _owners(more)]),
            np.concatenate([there.shares, more.shares]),
        )
    by_level[level + 1] = more


def _seen(sight: Sight, taps: Taps) -> tuple[Taps, Float32s]:
    """Return what is seen of taps, and the part of their weight that is not, by point."""
    room = MOST_SEEN * taps.rows.size
    seen = Taps(
        np.empty_like(taps.starts),
        np.empty(room, np.uint32),
        np.empty(room, np.float32),
        np.empty((room if taps.slopes.size else 0, 3), np.float32),
        taps.covers,
    )
    see_all(sight, *taps[:4], *seen[:4])
    left = 1 - np.add.reduceat(np.append(seen.weights[: seen.starts[-1]], 0), seen.starts[:-1])
    left[seen.starts[:-1] == seen.starts[1:]] = 1
    return seen, np.maximum(left, 0).astype(np.float32)


def _joined(found: list[_Found], n_points: int, gradient: bool) -> Taps:
    """Join the taps of all looks, owner by owner."""
    starts = np.zeros(n_points + 1, np.int64)
    for looks, taps in found:
        _count_taps(_owners(looks), taps.starts, starts)
    np.cumsum(starts, out=starts)
    room = int(starts[-1])
    covers = np.zeros(n_points, np.float32)
    joined = Taps(
        starts,
        np.empty(room, np.uint32),
        np.empty(room, np.float32),
        np.empty((room if gradient else 0, 3), np.float32),
        covers,
    )
    ends = starts[:-1].copy()
    for looks, taps in found:
        _add_taps(_owners(looks), looks.shares, *taps, ends, *joined[1:4], covers)
    _normalize(starts, joined.weights, joined.slopes)
    return joined


@kernel
def _weigh_by_area(
    areas: Uint8s,
    starts: Int64s,
    rows: npt.NDArray[np.uint32],
    weights: Float32s,
    slopes: Float32s,
    covers: Float32s,
) -> None:
    """Let averages weigh by their areas. Weights still sum to 1; what they summed to is in the covers."""
    if areas.size == 0:
        return
    for n in range(starts.size - 1):
        total = 0.0
        for tap in range(starts[n], starts[n + 1]):
            factor = AREA_WEIGHTS[areas[rows[tap]]] if rows[tap] < areas.size else np.float32(1.0)
            weights[tap] *= factor
            total += np.float64(weights[tap])
            for axis in range(3 if slopes.shape[0] > 0 else 0):
                slopes[tap, axis] *= factor
        covers[n] *= total
        inverse = 1.0 / total if total > 0.0 else 0.0
        for tap in range(starts[n], starts[n + 1]):
            weights[tap] *= inverse
            for axis in range(3 if slopes.shape[0] > 0 else 0):
                slopes[tap, axis] *= inverse


@kernel
def _count_taps(owners: Int32s, starts: Int64s, counts: Int64s) -> None:
    for look in range(owners.size):
        counts[owners[look] + 1] += starts[look + 1] - starts[look]


@kernel
def _add_taps(
    owners: Int32s,
    shares: Float32s,
    starts: Int64s,
    rows: npt.NDArray[np.uint32],
    weights: Float32s,
    slopes: Float32s,
    covers: Float32s,
    ends: Int64s,
    all_rows: npt.NDArray[np.uint32],
    all_weights: Float32s,
    all_slopes: Float32s,
    all_covers: Float32s,
) -> None:
    for look in range(owners.size):
        owner = owners[look]
        share = shares[look] * (covers[look] + _OFF)
        at = ends[owner]
        for tap in range(starts[look], starts[look + 1]):
            all_rows[at], all_weights[at] = rows[tap], share * weights[tap]
            for axis in range(3 if all_slopes.shape[0] > 0 else 0):
                all_slopes[at, axis] = share * slopes[tap, axis]
            at += 1
        ends[owner] = at
        all_covers[owner] += shares[look] * covers[look]


@kernel
def _normalize(starts: Int64s, weights: Float32s, slopes: Float32s) -> None:
    """Divide weights, and slopes, by the weights' sum."""
    for n in range(starts.size - 1):
        total = 0.0
        for tap in range(starts[n], starts[n + 1]):
            total += np.float64(weights[tap])
        scale = 1.0 / total if total != 0.0 else 0.0
        for tap in range(starts[n], starts[n + 1]):
            weights[tap] = np.float64(weights[tap]) * scale
            for axis in range(3 if slopes.shape[0] > 0 else 0):
                slopes[tap, axis] = np.float64(slopes[tap, axis]) * scale


@kernel
def _add_colors(
    owners: Int32s, shares: Float32s, covers: Float32s, found: Float32s, sums: Float32s, totals: Float32s
) -> None:
    for look in range(owners.size):
        owner, weight = owners[look], shares[look] * covers[look]
        for component in range(3):
            sums[owner, component] += weight * found[look, component]
        totals[owner] += weight


@kernel
def _finish_colors(sums: Float32s, totals: Float32s, results: Float32s, missed: Int64s) -> int:
    """Divide sums by totals; list the points that have none, and return their number."""
    n_missed = 0
    for n in range(totals.size):
        scale = np.float32(0.0)
        if abs(totals[n]) > _OFF:
            scale = np.float32(1.0) / totals[n]
        else:
            missed[n_missed] = n
            n_missed += 1
        for component in range(3):
            results[n, component] = sums[n, component] * scale
    return n_missed
