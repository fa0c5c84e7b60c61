"""The lookup that is asked for most, in one call: a channel's leaves, from tiles, weighed by the spline."""

from __future__ import annotations

import numpy as np

from octex.field.linear import linear_taps, nearest_rows
from octex.field.sinks import Codes, blend, take
from octex.field.spline import Tables, quadratic_taps, quartic_taps
from octex.field.splines import LINEAR, NEAREST, QUADRATIC
from octex.field.taps import MOST_TILED, Float32s, Int64s, Memory, Points, Taps, place_points
from octex.field.tiles import Tiles
from octex.jit import kernel
from octex.tree.search import Origin

#: Points taken from source to sink at once: what is read of them stays in the processor's first cache.
_STEP = 128


@kernel
def look_up_plain(
    filter_code: int,
    tiles: Tiles,
    tables: tuple[Tables, Tables],
    points: Points,
    origin: Origin,
    size: float,
    codes: Codes,
    rows: Memory,
    results: Float32s,
    missed: Int64s,
) -> tuple[int, int]:
    """Write the mean (n, components) at rest positions (n, 3).

    ``tables`` are those of `quadratic` and `quartic`. Points whose taps the tiles do not have are listed in
    ``missed`` instead. Returns how many these are, and the first point that is not finite, where all
    stopped, or −1.
    """
    step = max(min(_STEP, points.shape[0]), 1)
    room = step * MOST_TILED[filter_code] + 8
    places, which = np.empty((step, 3)), np.arange(step)
    empty, rim = np.empty(step, np.int64), np.empty(step, np.int64)
    found, weights, slopes = (
        np.empty(room, np.uint32),
        np.empty(room, np.float32),
        np.empty((0, 3), np.float32),
    )
    starts, ends, covers = np.zeros(step, np.int64), np.zeros(step, np.int64), np.zeros(step, np.float32)
    last = codes.values.shape[0] - 1
    n_missed = 0
    for begin in range(0, points.shape[0], step):
        count = min(step, points.shape[0] - begin)
        here = places[:count]
        fault = place_points(points[begin : begin + count], origin, size, here)
        if fault >= 0:
            return n_missed, begin + fault
        n_empty = n_rim = 0
        if filter_code == NEAREST:
            n_empty = nearest_rows(tiles, here, last, found, empty, rows)
            take(found[:count], codes, results[begin : begin + count])
        else:
            taps = Taps(found, weights, slopes, starts[:count], ends[:count], covers[:count])
            task = tiles, here, which[:count], False, last
            if filter_code == LINEAR:
                _, n_empty, n_rim = linear_taps(*task, taps, 0, empty, rim, rows)
            elif filter_code == QUADRATIC:
                _, n_empty, n_rim = quadratic_taps(*task, tables[0], taps, 0, empty, rim, rows)
            else:
                _, n_empty, n_rim = quartic_taps(*task, tables[1], taps, 0, empty, rim, rows)
            for n in range(n_empty):
                starts[empty[n]] = ends[empty[n]] = 0
            for n in range(n_rim):
                starts[rim[n]] = ends[rim[n]] = 0
            blend(taps, codes, True, results[begin : begin + count])
        for n in range(n_empty):
            missed[n_missed] = begin + empty[n]
            n_missed += 1
        for n in range(n_rim):
            missed[n_missed] = begin + rim[n]
            n_missed += 1
    return n_missed, -1
