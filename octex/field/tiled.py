"""Lookups by tiles in one call: from points to values, so many points at once as the first cache holds.

What taps are made of is asked for ahead, and is still near when they are weighed and blended: in 2 M cells
that takes a third less time than blocks of thousands of points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Floats, Int32s, Int64s, Uint8s
from octex.field.blend import Sums, add_weighed, blend, blend_slopes, divide, take, weigh_by_alpha
from octex.field.find import Cells, find_held, new_room, search_tiles
from octex.field.splines import NEAREST
from octex.field.taps import MOST_TILED, Ahead, Taps, hold_outside, new_taps, place_points
from octex.field.values import Codes
from octex.field.weights import Weighing, weigh_taps
from octex.jit import bytes_of, kernel, part
from octex.tree.search import Origin, Positions, count_of

#: Points that are looked up at once.
_STEP = 256


class Search(NamedTuple):
    """Where taps are found, and what changes their weights; what is not wanted is empty."""

    filter_code: int
    cells: Cells
    by: Weighing


class Weighed(NamedTuple):
    """A channel, and the alpha that it weighs by."""

    codes: Codes
    alpha: Codes  # of the same type
    has_alpha: bool


class Additions(NamedTuple):
    """Looks whose sums are added to those of others; or none."""

    owners: Int32s  # (n,)   whose looks these are
    shares: Float32s  # (n,)   what their sums are multiplied by
    left: Float32s  # (n,) or (0,)   takes the part of each that mixes facings
    sums: Sums  # of the owners


@part
def _new_additions(points: int, components: int) -> Additions:
    """Return those of points that own one look each, of which nothing is summed yet."""
    columns = components + 1
    sums = Sums(np.empty((points, columns), np.float64), np.empty((0, columns, 3), np.float64))
    owners, shares = np.arange(points, dtype=np.int32), np.ones(points, np.float32)
    return Additions(owners, shares, np.empty(0, np.float32), sums)


@part
def _read_ahead(search: Search, codes: Codes, alpha: Uint8s) -> Ahead:
    """Return what is read of cells."""
    flags = search.by.facings.flags if search.by.faces else search.by.facings.flags[:0]
    return Ahead(bytes_of(codes.values), alpha, flags, search.by.areas)


@kernel
def look_up_points(
    search: Search,
    singles: Floats,
    doubles: Floats,
    origin: Origin,
    size: float,
    normals: Float32s,
    channel: Weighed,
    results: Float32s,
    gradients: Float32s,
    additions: Additions,
    first: int,
    lost: Int64s,
) -> tuple[int, int, int]:
    """Write the mean (n, components) of a channel at points, see `Positions`, and its gradient.

    ``gradients`` (n, components, 3) or (0, components, 3). Where ``additions`` have owners, sums are added to
    those of the owners instead, without alpha and gradients; normals are then the owners'.

    Begins at the ``first`` point. Returns where it stopped, the level whose tiles must be built to go on,
    which is −1 at the end and at a point that is not finite, and how many points are listed in ``lost`` (n,)
    for the walk.
    """
    points, cells, by = Positions(singles, doubles), search.cells, search.by
    adds, faces = additions.owners.size > 0, by.faces
    gradient = gradients.shape[0] > 0 and not adds
    # Leaves toward normals are weighed as they are summed, too: that takes three quarters of the time.
    sees = faces and not (adds or gradient or channel.has_alpha)
    all_points = count_of(points)
    step = max(min(_STEP, all_points), 1)
    room, places = new_room(step, gradient), np.empty((step, 3), np.float64)
    # Half a page more, so that rows and weights do not begin at like places of their pages: reading the one
    # would wait for writing the other, and `linear` take 8 % longer.
    taps = new_taps(step, step * MOST_TILED[search.filter_code] + 520, gradient)
    facing = np.empty((step if faces else 0, 3), np.float32)
    if sees:
        additions = _new_additions(step, results.shape[1])
    alpha = channel.alpha.values if channel.has_alpha else channel.alpha.values[:0]
    ahead = _read_ahead(search, channel.codes, bytes_of(alpha))
    only_cells = search.filter_code == NEAREST and not (channel.has_alpha or faces or adds)
    n_lost = 0
    for begin in range(first, all_points, step):
        end = min(begin + step, all_points)
        count = end - begin
        here = places[:count]
        fault = place_points(
            Positions(points.singles[begin:end], points.doubles[begin:end]), origin, size, here
        )
        if fault >= 0:
            return begin + fault, -1, n_lost
        if only_cells and find_held(cells, here, ahead, room, taps.rows) == 0:
            take(taps.rows[:count], channel.codes, results[begin:end])
            continue
        starts, ends, covers = taps.starts[:count], taps.ends[:count], taps.covers[:count]
        found = Taps(taps.rows, taps.weights, taps.slopes, starts, ends, covers)
        _, n_rim, lacking = search_tiles(cells, search.filter_code, here, ahead, room, found)
        if lacking >= 0:
            return begin, lacking, n_lost
        for n in range(n_rim):
            lost[n_lost + n] = begin + room.lists[2, n]
        n_lost += n_rim
        if gradient:
            hold_outside(found, here)
        if adds or sees:
            at, sums = 0 if sees else begin, additions.sums
            owners, shares = additions.owners[at : at + count], additions.shares[at : at + count]
            for n in range(count if faces else 0):
                owner = np.uint64(begin + n if sees else int(owners[n]))
                for axis in range(3):
                    facing[n, axis] = normals[owner, axis]
            if sees:
                sums.values[:] = 0.0
            task = facing[:count], channel.codes, owners, shares, additions.left[at : at + count], sums
            add_weighed(found, by, *task)
            if sees:
                divide(sums, 1.0, results[begin:end], gradients[:0])
            continue
        if faces:
            split = bytes_of(channel.codes.split_values)
            found = weigh_taps(found, by, normals[begin:end], split, additions.left, normals[:0])
        if channel.has_alpha:
            weigh_by_alpha(found, channel.alpha, True, False)
        blend(found, channel.codes, True, results[begin:end])
        if gradient:
            blend_slopes(found, channel.codes, 1.0 / size, results[begin:end], gradients[begin:end])
    return all_points, -1, n_lost
