"""Taps found: by the tiles of a level; off the surface by those of coarser levels; else by the walk."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float64s, Int64s, Uint32s, Uint64s
from octex.field.neighborhood import walked_taps
from octex.field.sources import Batch, Group, forget_others, nearest_rows, new_group, tiled_taps
from octex.field.splines import LINEAR, NEAREST, QUADRATIC
from octex.field.taps import MOST_TILED, OFF, Ahead, Taps, hold_outside, new_taps, with_room
from octex.field.tiles import Levels, tiles_at
from octex.field.windows import MOST_TAPS, Walk, walk_of
from octex.jit import inlined, kernel, part, step
from octex.tree.layout import MAX_DEPTH, TreeArrays
from octex.tree.search import nearest_cell, new_scratch

#: Taps of a point that a walk is given room for at first.
_WALKED = 24


class Cells(NamedTuple):
    """The cells of a tree, and how they are found."""

    arrays: TreeArrays
    kept: Uint32s  # (kept nodes,)
    first_kept: int  # what the first kept coefficient is counted as
    levels: Levels  # tiles: of all levels above the first one that is searched, when they are built
    marks: Uint64s  # see `Tiles`
    first: int  # the level whose tiles are searched first, or −1: all points are walked to
    finer: int  # a level whose tiles are searched for what those of the first leave to others, or −1


class Room(NamedTuple):
    """Where points are searched for, so many at once."""

    group: Group
    walk: Walk  # of (0, …) where points are seldom walked to
    lists: Int64s  # (3, n)   points without cells, those of the level before, and those for the walk
    places: Float64s  # (n, 3)   of the points without cells


@step
def first_level(cells: Cells, filter_code: int) -> int:
    """Return the level whose tiles are searched first for a filter, or −1."""
    is_marked_for = filter_code in (LINEAR, QUADRATIC)
    return cells.first if is_marked_for or cells.marks.size == 0 else -1


@kernel
def new_room(cells: Cells, points: int, gradient: bool) -> Room:
    """Return room for so many points."""
    is_walked = cells.first < 0 or cells.marks.size > 0
    walk = walk_of(MAX_DEPTH + 1 if is_walked else 0)
    return Room(new_group(gradient), walk, np.empty((3, points), np.int64), np.empty((points, 3), np.float64))


@kernel
def new_tap_room(cells: Cells, filter_code: int, points: int, gradient: bool) -> Taps:
    """Return room for the taps of so many points."""
    # Half a page more, so that rows and weights do not begin at like places of their pages: reading the one
    # would wait for writing the other, and `linear` take 8 % longer.
    room = points * MOST_TILED[filter_code] + 520
    if first_level(cells, filter_code) < 0:
        room = MOST_TAPS + points * _WALKED
    return new_taps(points, room, gradient)


@inlined
def _gather(places: Float64s, points: Int64s, count: int, room: Room) -> None:
    """Let some of the points be searched for next."""
    for n in range(count):
        point = room.lists[1, n] = points[n]
        for axis in range(3):
            room.places[n, axis] = places[point, axis]


@step
def search_tiles(
    cells: Cells, filter_code: int, places: Float64s, ahead: Ahead, room: Room, taps: Taps
) -> tuple[int, int, int]:
    """Find the taps of points of texture space (n, 3) by tiles; those for the walk are listed.

    Off the surface the tiles of the deepest level answer that has any cell there. Returns the end of the
    taps, how many points are listed, in the last of ``room.lists``, and a level whose tiles are wanted and
    are not built, where it stopped, or −1.
    """
    level, last, count, here = cells.first, cells.arrays.flags.size - 1, places.shape[0], places
    empty, which, rim = room.lists[0], room.lists[1], room.lists[2]
    for n in range(count):
        which[n] = n
    end = n_rim = 0
    is_off = False
    while count > 0 and level >= 0:
        if cells.levels.tops[level, 0] < 0:
            return end, n_rim, level
        tiles = tiles_at(cells.levels, level, cells.marks)
        batch = Batch(here, which[:count], last, empty, rim[n_rim:], ahead)
        end, count, more = tiled_taps(tiles, filter_code, is_off, batch, room.group, taps, end)
        n_rim += more
        _gather(places, empty, count, room)
        here = room.places[:count]
        level -= filter_code != NEAREST or is_off  # around points that no leaf holds, its level comes first
        is_off = True
    if n_rim > 0 and cells.finer >= 0:
        tiles = tiles_at(cells.levels, cells.finer, cells.marks)
        _gather(places, rim, n_rim, room)
        batch = Batch(room.places[:n_rim], which[:n_rim], last, empty, rim, ahead)
        end, count, n_rim = tiled_taps(tiles, filter_code, False, batch, room.group, taps, end)
        for n in range(count):
            rim[n_rim + n] = empty[n]
        n_rim += count
    return end, n_rim, -1


@part
def _nearest(cells: Cells, places: Float64s, taps: Taps) -> None:
    """Find the cells nearest to points in any tree."""
    scratch = new_scratch(cells.arrays)
    for n in range(places.shape[0]):
        cell, is_held = nearest_cell(cells.arrays, places[n, 0], places[n, 1], places[n, 2], scratch)
        weight = np.float32(1.0) if is_held else OFF
        taps.rows[n], taps.weights[n], taps.covers[n] = cell, weight, np.float32(is_held)
        taps.starts[n], taps.ends[n] = n, n + 1


@part
def _walk_on(
    cells: Cells,
    filter_code: int,
    is_constant: bool,
    places: Float64s,
    which: Int64s,
    walk: Walk,
    taps: Taps,
    end: int,
) -> Taps:
    """Walk to the taps of some points."""
    if walk.windows.size == 0:
        walk = walk_of(MAX_DEPTH + 1)
    done = 0
    while done < which.size:
        taps = with_room(taps, end, end + MOST_TAPS)
        task = places, which, done, filter_code, is_constant, walk, taps, end
        done, end = walked_taps(cells.arrays, cells.kept, cells.first_kept, *task)
    return taps


@kernel
def find_taps(
    cells: Cells, filter_code: int, is_constant: bool, places: Float64s, ahead: Ahead, room: Room, taps: Taps
) -> tuple[Taps, int]:
    """Find the taps of points of texture space (n, 3), as many as there is room for or fewer.

    If ``is_constant``, slopes are those of weights with a constant sum: see `walked_taps`. Returns them, in
    arrays of their own if they had no room, and a level whose tiles are wanted and are not built, or −1.
    """
    n = places.shape[0]
    taps = Taps(taps.rows, taps.weights, taps.slopes, taps.starts[:n], taps.ends[:n], taps.covers[:n])
    end, n_rim, lacking, which = 0, n, -1, room.lists[2]
    if first_level(cells, filter_code) >= 0:
        end, n_rim, lacking = search_tiles(cells, filter_code, places, ahead, room, taps)
        if lacking >= 0:
            return taps, lacking
    elif filter_code == NEAREST:
        _nearest(cells, places, taps)
        n_rim = 0
    else:
        for m in range(n):
            which[m] = m
    if n_rim > 0:
        taps = _walk_on(cells, filter_code, is_constant, places, which[:n_rim], room.walk, taps, end)
    if taps.slopes.shape[0] > 0:
        hold_outside(taps, places)
    return taps, -1


@step
def find_held(cells: Cells, places: Float64s, ahead: Ahead, room: Room, rows: Uint32s) -> int:
    """Write the leaves that hold points (n, 3), by the tiles searched first; return how many none holds."""
    tiles = tiles_at(cells.levels, cells.first, cells.marks)
    batch = Batch(places, room.lists[1], cells.arrays.flags.size - 1, room.lists[0], room.lists[2], ahead)
    forget_others(room.group, cells.first, NEAREST)
    return nearest_rows(tiles, batch, room.group, rows)
