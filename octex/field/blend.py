"""From the taps of a point to its colour, on the shortest way."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.field.blocks import BLOCK, Bytes, Float32s, Int64s, Points, Uint32s, Values
from octex.field.facings import MOST_SEEN, Sight, take_seen
from octex.jit import decoded, inlined, kernel, prefetch
from octex.tree.layout import AREA_ONE, AREA_STEPS

#: What averages weigh by the codes of their cells' areas: the root of the area, in cell faces; 1 if that is
#: not known. By the area itself, cells that the surface hardly touches count for as little as they hold, but
#: what is then looked at is more ragged: half way from equal weights, painted content was nearest to the
#: truth.
AREA_WEIGHTS = (2.0 ** ((np.arange(256) - AREA_ONE) / AREA_STEPS / 2)).astype(np.float32)
AREA_WEIGHTS[0] = 1.0


#: Taps that weigh less in sum lie at the rim of the spline's support, where products of single precision have
#: lost their digits: the walk answers there.
LEAST = np.float32(1e-24)
#: What of them is seen may weigh less, but not so little that its inverse is infinite.
_LEAST_SEEN = np.float32(1e-36)


class Codes(NamedTuple):
    """A channel of three components as it is stored, and what its codes stand for."""

    values: Values  # (cells, 3)
    split_values: Values  # (split rows, 3)
    table: Float32s  # (codes,)   the decoded values; empty if values are float32


class Colors(NamedTuple):
    """Where lookups of n points write what they find."""

    results: Float32s  # (n, 3)
    covers: Float32s  # (n,) or (0,)   how much of the spline's weight fell on what was seen
    left: Float32s  # (n,) or (0,)   the part of the taps' weight that was not seen
    missed: Int64s  # (n,)   the points without taps, whose results are not written


class Task(NamedTuple):
    """What a lookup of colours is to do."""

    points: Points  # (n, 3)   rest positions
    sight: Sight
    codes: Codes
    areas: Bytes  # (cells,)   averages weigh by these (AREA_WEIGHTS); or (0,): leaves, which do not
    colors: Colors


class Seen(NamedTuple):
    """What is seen of the taps of a block of points, one point's after another's."""

    rows: Uint32s
    weights: Float32s
    ends: Int64s  # (BLOCK,)   of each point's
    totals: Float32s  # (BLOCK,)   weight of all taps of each point


@kernel
def new_seen() -> Seen:
    """Return room for 27 taps a point."""
    room = 27 * BLOCK * MOST_SEEN
    return Seen(
        np.zeros(room, np.uint32),
        np.zeros(room, np.float32),
        np.zeros(BLOCK, np.int64),
        np.zeros(BLOCK, np.float32),
    )


@inlined
def weigh_by_area(areas: Bytes, cells: Uint32s, weights: Float32s, end: int) -> None:
    """Multiply the weights of cells that are averages by what their areas weigh."""
    if areas.size == 0:
        return
    for tap in range(0, end, 4):  # the others mostly lie beside these
        prefetch(areas, int(cells[np.uint64(tap)]))
    for tap in range(end):
        weights[np.uint64(tap)] *= AREA_WEIGHTS[areas[np.uint64(cells[np.uint64(tap)])]]


@inlined
def _blend_cells(
    cells: Uint32s,
    weights: Float32s,
    first: int,
    end: int,
    step: int,
    values: Values,
    table: Float32s,
    results: Float32s,
    point: int,
) -> np.float32:
    """Write the mean of three components under taps ``first``, ``first + step`` …; return their weight.

    ``values`` and ``results`` are flat. Taps that weigh less than LEAST leave the result alone.
    """
    a = b = c = total = np.float32(0.0)
    for tap in range(first, end, step):
        weight = weights[np.uint64(tap)]
        row = np.uint64(3) * np.uint64(cells[np.uint64(tap)])
        a += weight * decoded(table, values[row])
        b += weight * decoded(table, values[row + np.uint64(1)])
        c += weight * decoded(table, values[row + np.uint64(2)])
        total += weight
    if total >= LEAST:
        inverse = np.float32(1.0) / total
        row = np.uint64(3 * point)
        results[row] = a * inverse
        results[row + np.uint64(1)] = b * inverse
        results[row + np.uint64(2)] = c * inverse
    return total


@inlined
def blend_all(
    task: Task,
    point: int,
    cells: Uint32s,
    weights: Float32s,
    first: int,
    end: int,
    step: int,
    flat_values: Values,
    flat_results: Float32s,
) -> bool:
    """Write the colour of a point under taps ``first``, ``first + step`` …; say whether it has any."""
    table = task.codes.table
    total = _blend_cells(cells, weights, first, end, step, flat_values, table, flat_results, point)
    if task.colors.covers.size > 0:
        task.colors.covers[point] = total
    return bool(total >= LEAST)


@inlined
def ask_for_facings(sight: Sight, cells: Uint32s, end: int) -> None:
    """Ask for what is read of cells to see them."""
    for tap in range(0, end, 4):  # the others mostly lie beside these
        cell = int(cells[np.uint64(tap)])
        prefetch(sight.facings.flags, cell)
        prefetch(sight.facings.rows, cell)


@inlined
def see_taps(
    task: Task,
    begin: int,
    n: int,
    cells: Uint32s,
    weights: Float32s,
    first: int,
    end: int,
    step: int,
    seen: Seen,
) -> None:
    """See taps ``first``, ``first + step`` … of point n of a block, and ask for their split values."""
    total = np.float32(0.0)
    for tap in range(first, end, step):
        total += weights[tap]
    seen.totals[n] = total
    at = seen.ends[n - 1] if n > 0 else 0
    first_row = task.sight.first_row
    last = take_seen(task.sight, begin + n, cells, weights, first, end, step, seen.rows, seen.weights, at)
    for tap in range(at, last):
        row = int(seen.rows[tap]) - first_row
        if row >= 0:
            prefetch(task.codes.split_values, row)
    seen.ends[n] = last


@inlined
def _blend_seen(task: Task, begin: int, n: int, seen: Seen) -> bool:
    """Write the colour of point n of a block under what is seen of its taps; say whether it has any."""
    point = begin + n
    first_row = task.sight.first_row
    values, split_values, table = task.codes
    a = b = c = cover = np.float32(0.0)
    last = split_values.shape[0] - 1
    for tap in range(seen.ends[n - 1] if n > 0 else 0, seen.ends[n]):
        weight, row = seen.weights[tap], np.int64(seen.rows[tap])
        cover += weight
        if row < first_row:
            a += weight * decoded(table, values[row, 0])
            b += weight * decoded(table, values[row, 1])
            c += weight * decoded(table, values[row, 2])
        else:
            row = min(row - first_row, last)
            a += weight * decoded(table, split_values[row, 0])
            b += weight * decoded(table, split_values[row, 1])
            c += weight * decoded(table, split_values[row, 2])
    inverse = np.float32(1.0) / cover if cover > _LEAST_SEEN else np.float32(0.0)
    results, total = task.colors.results, seen.totals[n]
    results[point, 0], results[point, 1], results[point, 2] = a * inverse, b * inverse, c * inverse
    task.colors.covers[point] = cover
    task.colors.left[point] = max(total - cover, np.float32(0.0)) / total if total > np.float32(0.0) else 0.0
    return bool(total >= LEAST)


@inlined
def blend_seen(task: Task, begin: int, count: int, seen: Seen, n_missed: int) -> int:
    """Write the colours of a block of points under what is seen of their taps.

    Those that have no taps are written to ``missed`` from ``n_missed`` on; returns their number.
    """
    for n in range(count):
        if not _blend_seen(task, begin, n, seen):
            task.colors.missed[n_missed] = begin + n
            n_missed += 1
    return n_missed
