"""Taps by tiles: those of a level, off the surface those of coarser ones; what is left is for the walk."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float64s, Int64s, Uint32s, Uint64s
from octex.field.sources import Batch, Group, forget_others, nearest_rows, new_group, tiled_taps
from octex.field.splines import LINEAR, NEAREST, QUADRATIC
from octex.field.taps import Ahead, Taps
from octex.field.tiles import Levels, tiles_at
from octex.jit import inlined, kernel, step
from octex.tree.layout import TreeArrays


class Cells(NamedTuple):
    """The cells of a tree, and how they are found."""

    arrays: TreeArrays
    kept: Uint32s  # (kept nodes,)
    first_kept: int  # what the first kept coefficient is counted as
    levels: Levels  # tiles: of all levels above the first one that is searched, when they are built
    marks: Uint64s  # see `Tiles`
    first: int  # the level whose tiles are searched first, or −1: all points are walked to
    finer: int  # a level whose tiles are searched for what those of the first leave to others, or −1

    def has_tiles_for(self, filter_code: int) -> bool:
        """Say whether tiles are searched for a filter: marks serve the smaller windows alone."""
        return self.first >= 0 and (not self.marks.size or filter_code in (LINEAR, QUADRATIC))


class Room(NamedTuple):
    """Where points are searched for, so many at once."""

    group: Group
    lists: Int64s  # (3, n)   points without cells, those of the level before, and those for the walk
    places: Float64s  # (n, 3)   of the points without cells


@kernel
def new_room(points: int, gradient: bool) -> Room:
    """Return room for so many points."""
    lists, places = np.empty((3, points), np.int64), np.empty((points, 3), np.float64)
    return Room(new_group(gradient), lists, places)


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
    end = n_rim = turn = int(np.int64(0))  # a constant 0 would have all that takes it compiled twice
    while count > 0 and level >= 0:
        if cells.levels.tops[level, 0] < 0:
            return end, n_rim, level
        tiles = tiles_at(cells.levels, level, cells.marks)
        batch = Batch(here, which[:count], last, empty, rim[n_rim:], ahead)
        end, count, more = tiled_taps(tiles, filter_code, turn > 0, batch, room.group, taps, end)
        n_rim += more
        _gather(places, empty, count, room)
        here = room.places[:count]
        level -= filter_code != NEAREST or turn > 0  # around points that no leaf holds, its level comes first
        turn += 1
    if n_rim > 0 and cells.finer >= 0:
        tiles = tiles_at(cells.levels, cells.finer, cells.marks)
        _gather(places, rim, n_rim, room)
        batch = Batch(room.places[:n_rim], which[:n_rim], last, empty, rim, ahead)
        end, count, n_rim = tiled_taps(tiles, filter_code, turn < 0, batch, room.group, taps, end)
        for n in range(count):
            rim[n_rim + n] = empty[n]
        n_rim += count
    return end, n_rim, -1


@kernel
def find_tiled(
    cells: Cells, filter_code: int, places: Float64s, ahead: Ahead, room: Room, taps: Taps
) -> tuple[int, int, int]:
    """Do for Python what `search_tiles` does for kernels, whose views of arrays none but steps may hold."""
    return search_tiles(cells, filter_code, places, ahead, room, taps)


@step
def find_held(cells: Cells, places: Float64s, ahead: Ahead, room: Room, rows: Uint32s) -> int:
    """Write the leaves that hold points (n, 3), by the tiles searched first; return how many none holds."""
    tiles = tiles_at(cells.levels, cells.first, cells.marks)
    batch = Batch(places, room.lists[1], cells.arrays.flags.size - 1, room.lists[0], room.lists[2], ahead)
    forget_others(room.group, cells.first, NEAREST)
    return nearest_rows(tiles, batch, room.group, rows)
