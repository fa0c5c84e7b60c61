"""The field over one tree: which taps a lookup reads, for any tree and filter."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from itertools import islice
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.field.bricks import Tree
from octex.field.linear import linear_taps, nearest_rows
from octex.field.neighborhood import MOST_TAPS, Walk, new_walk, walked_taps
from octex.field.sinks import list_taps
from octex.field.spline import (
    QUADRATIC_TABLES,
    QUARTIC_TABLES,
    nearest_around,
    quadratic_taps,
    quartic_taps,
)
from octex.field.splines import FILTERS, LINEAR, NEAREST, QUADRATIC
from octex.field.stages import MOST_ROWS, Facings, face, facings_of, take_rows
from octex.field.taps import (
    BLOCK,
    MOST_TILED,
    OFF,
    Float32s,
    Float64s,
    Int64s,
    Memory,
    Points,
    Taps,
    place_points,
)
from octex.field.tiles import Tiles, build_tiles, can_be_tiled, marked, painted_depth
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from octex.tree.search import nearest_cells

#: Taps of a point that a walk is given room for at first.
_WALKED = 24
_NOTHING: Memory = np.empty((1, 1), np.uint8)


class Listed(NamedTuple):
    """The taps of points, one point's after another's.

    A row is a cell's number, that of a leaf or, off the surface, of a node; after the cells come the rows of
    the kept table.
    """

    starts: npt.NDArray[np.int64]  # (points + 1,)   a point's taps are those from its start to the next one's
    rows: npt.NDArray[np.uint32]  # (taps,)
    weights: Float32s  # (taps,)   none negative, 1 in sum for each point
    slopes: Float32s  # (taps, 3)   derivatives of the weights by rest position; (0, 3) if they are not wanted
    covers: Float32s  # (points,)   how much of the spline's weight falls on leaves; 0 off the surface


class NotFiniteError(ValueError):
    """A position that is not finite: the row of it."""

    def __init__(self, row: int) -> None:
        super().__init__(f"points[{row}] is not finite")
        self.row = row


class Field:
    """The field over one tree: which cells count, and how much, is the same for all channels."""

    def __init__(self, tree: Octree, root: Field | None = None) -> None:
        self.tree = tree
        self.root = root or self  # of a level, the field that it is of
        self._levels: dict[int, Field] = {}
        self._areas: dict[int, npt.NDArray[np.uint8]] = {}

    def level(self, level: int) -> Field:
        """Return the field over the averages of a level, whose cells have the same numbers."""
        if level >= self.tree.max_depth:
            return self
        levels = self.root._levels
        if level not in levels:
            levels[level] = Field(self.tree.truncated(level), self.root)
        return levels[level]

    def areas_of_averages(self, level: int) -> npt.NDArray[np.uint8]:
        """Return the codes of the areas of nodes down to a level (cells,), 0 for leaves: not known."""
        areas = self.tree.arrays.areas
        if not any(leaves for leaves, _ in self.tree.cells_by_depth()[: level + 1]):
            return areas
        if level not in self._areas:
            found = np.zeros(areas.size, np.uint8)
            for above, (_, is_node) in enumerate(islice(self.tree.walk(), level + 1)):
                nodes = np.flatnonzero(is_node) + int(self.tree.arrays.level_cells[above])
                found[nodes] = areas[nodes]
            self._areas[level] = found
        return self._areas[level]

    @cached_property
    def facings(self) -> Facings:
        """The tree's facings, indexed on first use."""
        return facings_of(self.tree)

    @cached_property
    def tiles(self) -> Tiles | None:
        """The tree's tiles, built on first use; None for trees that cannot have them."""
        return build_tiles(self.tree) if can_be_tiled(self.tree) else None

    @cached_property
    def painted(self) -> Tiles | None:
        """The tiles of a tree of one depth that was painted more finely, marked where; None for others."""
        depth = painted_depth(self.tree)
        if depth < 0 or self.tiles is not None:
            return None
        tiles = self.level(depth).tiles
        return None if tiles is None else marked(tiles, self.tree)

    @cached_property
    def mixed(self) -> Tree:
        """The tree as bricks are decoded from it, indexed on first use."""
        return Tree.of(self.tree)

    def tiles_for(self, filter_code: int) -> Tiles | None:
        """Return the tiles that serve a filter: all of the points, or the most of them."""
        return self.painted if self.tiles is None and filter_code in (LINEAR, QUADRATIC) else self.tiles

    def prepare(self, filter_code: int) -> None:
        """Build what lookups of the leaves read, before threads share it."""
        self.tiles_for(filter_code)
        self.mixed  # noqa: B018

    def taps(
        self, points: Points, placement: Placement, filter: str = "quadratic", *, gradient: bool = False
    ) -> Listed:
        """List the taps of rest positions (n, 3), with their slopes if ``gradient``.

        Raises NotFiniteError.
        """
        found = list(self.batches(points, placement, filter, gradient=gradient))
        if len(found) == 1:
            return found[0]
        ends = np.cumsum([0, *(taps.rows.size for taps in found)])
        starts = [taps.starts[:-1] + end for taps, end in zip(found, ends, strict=False)]
        return Listed(
            np.concatenate([*starts, ends[-1:]]),
            np.concatenate([np.empty(0, np.uint32), *(taps.rows for taps in found)]),
            np.concatenate([np.empty(0, np.float32), *(taps.weights for taps in found)]),
            np.concatenate([np.empty((0, 3), np.float32), *(taps.slopes for taps in found)]),
            np.concatenate([np.empty(0, np.float32), *(taps.covers for taps in found)]),
        )

    def batches(
        self,
        points: Points,
        placement: Placement,
        filter: str = "quadratic",
        *,
        normals: Float32s | None = None,
        gradient: bool = False,
    ) -> Iterator[Listed]:
        """Yield the taps of consecutive runs of rest positions. See ``taps``.

        With ``normals`` (n, 3) they are what faces these; after the kept rows come those of the split table.
        """
        finder = Finder(self, filter, gradient=gradient)
        places = np.empty((min(len(points), BLOCK), 3))
        for begin in range(0, len(points), BLOCK):
            some = points[begin : begin + BLOCK]
            here = places[: len(some)]
            fault = place_points(some, *placement, here)
            if fault >= 0:
                raise NotFiniteError(begin + fault)
            taps = finder.find(here)
            if normals is not None:
                taps = self.facing(taps, normals[begin : begin + BLOCK], self)
            room = int((taps.ends - taps.starts).sum()) + 1
            starts, rows, weights = (
                np.empty(len(some) + 1, np.int64),
                np.empty(room, np.uint32),
                np.empty(room, np.float32),
            )
            slopes = np.empty((room if gradient else 0, 3), np.float32)
            list_taps(taps, 1.0 / placement.size, starts, rows, weights, slopes)
            end = starts[-1]
            yield Listed(starts, rows[:end], weights[:end], slopes[:end], taps.covers)

    def facing(self, taps: Taps, normals: Float32s, whole: Field) -> Taps:
        """Return what faces the normals (points, 3) of taps, which change: see `stages.face`.

        ``whole`` is the field that this is a level of: its cells are those that rows are counted after.
        """
        first_kept = whole.tree.n_cells
        n_split = face(taps, self.facings, first_kept, normals)
        if not n_split:
            return taps
        room = int((taps.ends - taps.starts).sum()) + (MOST_ROWS - 1) * n_split
        rows = Taps.of(taps.starts.size, room, taps.slopes.shape[0] > 0)
        first_row = first_kept + whole.tree.kept.cells.size
        take_rows(taps, self.facings, first_kept, first_row, normals, rows)
        return rows


class Finder:
    """Finds the taps of points of texture space, a block after another, in one field.

    ``whole`` is the field that it is a level of, by default itself.
    """

    def __init__(
        self, field: Field, filter: str, *, gradient: bool = False, whole: Field | None = None
    ) -> None:
        self.field = field
        self._whole = whole or field
        self.filter = FILTERS.index(filter)
        self._gradient = gradient
        self._walk: Walk | None = None
        self._taps: Taps | None = None
        self._all = self._next = self._empty = self._rim = np.empty(0, np.int64)

    def find(self, places: Float64s, rows: Memory = _NOTHING) -> Taps:
        """Return the taps of points (n, 3), at most BLOCK; valid until the next are found.

        ``rows`` are what will be read of the cells next: they are asked for.
        """
        self._rows = rows
        n = len(places)
        tiles = self.field.tiles_for(self.filter)
        most = MOST_TILED[self.filter] * n + 8 if tiles is not None else _WALKED * n + MOST_TAPS
        if self._taps is None or self._taps.starts.size < n:
            self._taps = Taps.of(n, most, self._gradient)
            self._all, self._next = np.arange(n), np.arange(1, n + 1)
            self._empty, self._rim = np.empty(n, np.int64), np.empty(n, np.int64)
        taps = self._taps
        if taps.starts.size > n:
            taps = taps._replace(starts=taps.starts[:n], ends=taps.ends[:n], covers=taps.covers[:n])
        if self.filter == NEAREST:
            return self._nearest(places, taps)
        if tiles is None:
            return self._walked(places, taps, 0, self._all[:n])
        empty, rim = self._empty, self._rim
        end, n_empty, n_rim = self._tiled(tiles, self.field, places, self._all[:n], False, taps, 0, rim)
        level = tiles.depth
        while n_empty:  # off the surface: the averages of the deepest level that has any there
            level -= 1
            above = self.field.level(level)
            which = empty[:n_empty].copy()
            taps = taps.with_room(end, end + MOST_TILED[self.filter] * n_empty + 8)
            assert above.tiles is not None  # as all leaves of the tree have one depth
            end, n_empty, more = self._tiled(
                above.tiles, above, places[which], which, True, taps, end, rim[n_rim:]
            )
            n_rim += more
        return self._walked(places, taps, end, rim[:n_rim])

    def _tiled(
        self,
        tiles: Tiles,
        field: Field,
        places: Float64s,
        which: Int64s,
        is_off: bool,
        taps: Taps,
        end: int,
        rim: Int64s,
    ) -> tuple[int, int, int]:
        last = field.tree.n_cells - 1
        if self.filter == LINEAR:
            return linear_taps(tiles, places, which, is_off, last, taps, end, self._empty, rim, self._rows)
        if self.filter == QUADRATIC:
            more = QUADRATIC_TABLES, taps, end, self._empty, rim, self._rows
            return quadratic_taps(tiles, places, which, is_off, last, *more)
        more = QUARTIC_TABLES, taps, end, self._empty, rim, self._rows
        return quartic_taps(tiles, places, which, is_off, last, *more)

    def _walked(self, places: Float64s, taps: Taps, end: int, which: Int64s) -> Taps:
        """Walk to the taps of some points."""
        if not which.size:
            return taps
        if self._walk is None:
            self._walk = new_walk()
        tree = self.field.tree
        done = 0
        while done < which.size:
            taps = taps.with_room(end, end + MOST_TAPS)
            done, end = walked_taps(
                *(tree.arrays, tree.kept.cells, self._whole.tree.n_cells, places, which, done),
                *(self.filter, self._walk, taps, end),
            )
        return taps

    def _nearest(self, places: Float64s, taps: Taps) -> Taps:
        tree, n = self.field.tree, len(places)
        tiles = self.field.tiles
        if tiles is None:
            cells, held = np.empty(n, np.int64), np.empty(n, np.bool_)
            nearest_cells(tree.arrays, places, (0.0, 0.0, 0.0), 1.0, cells, held)
            taps.rows[:n], taps.weights[:n] = cells, np.where(held, np.float32(1), OFF)
            taps.starts[:], taps.ends[:], taps.covers[:] = self._all[:n], self._next[:n], held
            return taps
        taps.starts[:], taps.ends[:], taps.covers[:] = self._all[:n], self._next[:n], 1
        taps.weights[:n] = 1
        n_empty = nearest_rows(tiles, places, tree.n_cells - 1, taps.rows, self._empty, self._rows)
        end = n
        level = tree.max_depth
        while n_empty:
            here = self.field.level(level)
            which = self._empty[:n_empty].copy()
            taps = taps.with_room(end, end + n_empty)
            assert here.tiles is not None
            end, n_empty = nearest_around(
                *(here.tiles, places[which], which, here.tree.n_cells - 1, QUADRATIC_TABLES),
                *(taps, end, self._empty, self._rows),
            )
            level -= 1
        return taps
