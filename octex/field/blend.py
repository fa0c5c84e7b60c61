"""From the taps of a point to its colour, on the shortest way."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.field.blocks import Float32s, Int64s, Points, Uint32s, Values
from octex.field.facings import ALL, MOST_SEEN, Sight, take_seen
from octex.jit import decoded, inlined, kernel


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
    colors: Colors


class Seen(NamedTuple):
    """Room for what is seen of the taps of one point."""

    rows: Uint32s
    weights: Float32s


@kernel
def new_seen() -> Seen:
    """Return room for 27 taps."""
    return Seen(np.zeros(27 * MOST_SEEN, np.uint32), np.zeros(27 * MOST_SEEN, np.float32))


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

    ``values`` and ``results`` are flat. Taps of weight 0 leave the result alone.
    """
    a = b = c = total = np.float32(0.0)
    for tap in range(first, end, step):
        weight = weights[np.uint64(tap)]
        row = np.uint64(3) * np.uint64(cells[np.uint64(tap)])
        a += weight * decoded(table, values[row])
        b += weight * decoded(table, values[row + np.uint64(1)])
        c += weight * decoded(table, values[row + np.uint64(2)])
        total += weight
    if total > np.float32(0.0):
        inverse = np.float32(1.0) / total
        row = np.uint64(3 * point)
        results[row] = a * inverse
        results[row + np.uint64(1)] = b * inverse
        results[row + np.uint64(2)] = c * inverse
    return total


@inlined
def _blend_seen(seen: Seen, end: int, first_row: int, task: Task, point: int) -> np.float32:
    """Do as `_blend_cells` for what is seen of the taps."""
    values, split_values, table = task.codes
    results = task.colors.results
    a = b = c = total = np.float32(0.0)
    last = split_values.shape[0] - 1
    for tap in range(end):
        weight, row = seen.weights[tap], np.int64(seen.rows[tap])
        total += weight
        if row < first_row:
            a += weight * decoded(table, values[row, 0])
            b += weight * decoded(table, values[row, 1])
            c += weight * decoded(table, values[row, 2])
        else:
            row = min(row - first_row, last)
            a += weight * decoded(table, split_values[row, 0])
            b += weight * decoded(table, split_values[row, 1])
            c += weight * decoded(table, split_values[row, 2])
    inverse = np.float32(1.0) / total if total > np.float32(0.0) else np.float32(0.0)
    results[point, 0], results[point, 1], results[point, 2] = a * inverse, b * inverse, c * inverse
    return total


@inlined
def color_point(
    task: Task,
    point: int,
    cells: Uint32s,
    weights: Float32s,
    first: int,
    end: int,
    step: int,
    seen: Seen,
    flat_values: Values,
    flat_results: Float32s,
) -> bool:
    """Write the colour of a point under taps ``first``, ``first + step`` …; say whether it has any."""
    if task.sight.mode == ALL:
        total = _blend_cells(
            cells, weights, first, end, step, flat_values, task.codes.table, flat_results, point
        )
        if task.colors.covers.size > 0:
            task.colors.covers[point] = total
        return bool(total > np.float32(0.0))
    total = np.float32(0.0)
    for tap in range(first, end, step):
        total += weights[tap]
    if not total > np.float32(0.0):
        task.colors.covers[point] = task.colors.left[point] = np.float32(0.0)
        return False
    n_seen = take_seen(task.sight, point, cells, weights, first, end, step, seen.rows, seen.weights, 0)
    cover = _blend_seen(seen, n_seen, task.sight.first_row, task, point)
    task.colors.covers[point] = cover
    task.colors.left[point] = max(total - cover, np.float32(0.0)) / total
    return True
