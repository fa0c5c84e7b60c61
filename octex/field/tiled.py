"""Lookups by tiles in one call: from points to values, in groups that fit the first cache.

Prefetched values are still cached when they are weighted and blended: with 2 M cells this takes a third less
time than blocks of thousands of points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Floats, Int32s, Int64s
from octex.field.blend import (
    ProbeSums,
    add_weighed,
    blend,
    blend_slopes,
    divide,
    gather,
    new_sums,
    weigh_by_alpha,
)
from octex.field.splines import LINEAR, NEAREST
from octex.field.taps import (
    MOST_TILED,
    Ahead,
    Batch,
    Codes,
    Taps,
    clear_outside_slopes,
    new_taps,
    to_coordinates,
)
from octex.field.tile_taps import linear_taps, nearest_taps, quadratic_taps
from octex.field.tiles import Tiles, nearest_rows
from octex.field.weights import MOST_ROWS, Weighing, weigh_taps
from octex.jit import kernel, part
from octex.tree.search import Origin, Positions, count_of

#: Points that are looked up at once.
_STEP = 256


class TileSearch(NamedTuple):
    """How to find and weight taps; unused arrays are empty."""

    filter_code: int  # NEAREST, LINEAR or QUADRATIC
    tiles: Tiles
    last: int  # the largest number of a cell
    is_off: bool  # points are off the surface: deeper tiles lack their cells
    weighing: Weighing


class Weighed(NamedTuple):
    """A channel, and the alpha that weights it."""

    codes: Codes
    alpha: Codes  # of the same type
    has_alpha: bool


class Additions(NamedTuple):
    """Probes whose sums are added to those of their owners; or none."""

    owners: Int32s  # (n,)   the point of each probe
    shares: Float32s  # (n,)   factors of their sums
    passed: Float32s  # (n,) or (0,)   output: the part of each in mixed cells
    sums: ProbeSums  # of the owners


@part
def _new_room(filter_code: int, points: int, is_split: bool, gradient: bool) -> tuple[Taps, Float64s, Int64s]:
    """Return room for the taps of points at once, of split cells too, for their coordinates and numbers."""
    # Half a page more, so that rows and weights do not begin at like places of their pages: reading the one
    # would wait for writing the other, and `linear` take 8 % longer.
    room = points * MOST_TILED[filter_code] + 520
    if is_split:
        room *= 1 + MOST_ROWS
    numbers = np.empty(points, np.int64)
    for n in range(points):
        numbers[n] = n
    return new_taps(points, room, gradient), np.empty((points, 3), np.float64), numbers


@kernel
def look_up_tiled(
    search: TileSearch,
    singles: Floats,
    doubles: Floats,
    origin: Origin,
    size: float,
    normals: Float32s,
    channel: Weighed,
    results: Float32s,
    gradients: Float32s,
    additions: Additions,
    lost: Int64s,
) -> tuple[int, int, int]:
    """Write the mean (n, components) of a channel at points, see `Positions`, and its gradient.

    ``gradients`` are (n, components, 3) or (0, components, 3). Where ``additions`` have owners, sums are
    added to the owners' instead, without alpha and gradients; normals are then the owners'. ``lost`` (2, n)
    lists the points without cells around them, and those for the walk. Returns both counts, and the first
    point that is not finite, where it stopped, or −1.
    """
    points, weighing = Positions(singles, doubles), search.weighing
    adds, faces = additions.owners.size > 0, weighing.faces
    gradient = gradients.shape[0] > 0 and not adds
    # Leaves with normals are weighted as they are summed, too, in three quarters of the time.
    is_faced = faces and not (adds or gradient or channel.has_alpha)
    all_points = count_of(points)
    step = max(min(_STEP, all_points), 1)
    is_split = weighing.facings.rows.size > 0 and faces and not (adds or is_faced)
    room, coords, numbers = _new_room(search.filter_code, step, is_split, gradient)
    step_normals = np.empty((step if faces else 0, 3), np.float32)
    if is_faced:  # points own one probe each
        shares, none = np.ones(step, np.float32), np.empty(0, np.float32)
        additions = Additions(np.arange(step, dtype=np.int32), shares, none, new_sums(step, results, False))
    alpha = channel.alpha.values if channel.has_alpha else channel.alpha.values[:0]
    flags = weighing.facings.flags if faces else weighing.facings.flags[:0]
    ahead = Ahead(channel.codes.values.view(np.uint8), alpha.view(np.uint8), flags, weighing.areas)
    only_cells = search.filter_code == NEAREST and not (channel.has_alpha or faces or search.is_off or adds)
    n_empty = n_rim = 0
    for begin in range(0, all_points, step):
        end = min(begin + step, all_points)
        count = end - begin
        placed, empty, rim = coords[:count], lost[0, n_empty:], lost[1, n_rim:]
        fault = to_coordinates(
            Positions(points.singles[begin:end], points.doubles[begin:end]), origin, size, placed
        )
        if fault >= 0:
            return n_empty, n_rim, begin + fault
        batch = Batch(placed, numbers[:count], search.last, empty, rim, ahead)
        if only_cells:
            more_empty, more_rim = nearest_rows(search.tiles, batch, room.rows), 0
            gather(room.rows[:count], channel.codes, results[begin:end])
        else:
            starts, ends, covers = room.starts[:count], room.ends[:count], room.covers[:count]
            taps = Taps(room.rows, room.weights, room.slopes, starts, ends, covers)
            if search.filter_code == NEAREST:
                _, more_empty, more_rim = nearest_taps(search.tiles, search.is_off, batch, taps, 0)
            elif search.filter_code == LINEAR:
                _, more_empty, more_rim = linear_taps(search.tiles, search.is_off, batch, taps, 0)
            else:
                _, more_empty, more_rim = quadratic_taps(search.tiles, search.is_off, batch, taps, 0)
            if gradient:
                clear_outside_slopes(taps, placed)
            if adds or is_faced:
                at, sums = 0 if is_faced else begin, additions.sums
                owners, shares = additions.owners[at : at + count], additions.shares[at : at + count]
                for n in range(count if faces else 0):
                    owner = np.uint64(begin + n if is_faced else int(owners[n]))
                    for axis in range(3):
                        step_normals[n, axis] = normals[owner, axis]
                if is_faced:
                    sums.values[:], sums.totals[:] = 0.0, 0.0
                passed = additions.passed[at : at + count]
                add_weighed(taps, weighing, step_normals[:count], channel.codes, owners, shares, passed, sums)
                if is_faced:
                    mean = ProbeSums(sums.values[:count], sums.totals[:count], sums.slopes, sums.total_slopes)
                    divide(mean, 1.0, results[begin:end], gradients[:0])
            else:
                if faces:
                    split = channel.codes.split_values.view(np.uint8)
                    weigh_taps(taps, weighing, normals[begin:end], split, additions.passed, normals[:0])
                if channel.has_alpha:
                    weigh_by_alpha(taps, channel.alpha, True, False)
                blend(taps, channel.codes, True, results[begin:end])
                if gradient:
                    slopes = gradients[begin:end]
                    blend_slopes(taps, channel.codes, 1.0 / size, results[begin:end], slopes)
        for n in range(more_empty):
            empty[n] += begin
        for n in range(more_rim):
            rim[n] += begin
        n_empty, n_rim = n_empty + more_empty, n_rim + more_rim
    return n_empty, n_rim, -1
