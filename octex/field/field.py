"""The field over one tree: finds the taps of a lookup, for any tree and filter."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from threading import RLock
from weakref import ref

import numpy as np

from octex.arrays import Float32s, Float64s, Floats, Int64s, Uint8s, bit_counts
from octex.errors import TextureFileError
from octex.field.splines import FILTERS, LINEAR, NEAREST, QUADRATIC
from octex.field.taps import (
    BLOCK,
    MOST_TILED,
    OFF,
    Ahead,
    Batch,
    Taps,
    clear_outside_slopes,
    new_taps,
    to_coordinates,
)
from octex.field.tile_taps import FINDERS
from octex.field.tiles import Tiles, build_tiles, can_be_tiled, marked, painted_levels
from octex.field.walk_taps import walked_taps
from octex.field.weights import MOST_ROWS, Facings, Weighing, facings_of, weigh_taps
from octex.field.windows import MOST_TAPS, Walk, new_walk
from octex.jit import unlocked
from octex.parallel import built_once
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from octex.tree.search import Positions, nearest_cells

#: Initial room for the taps of a point that is walked to.
_WALKED = 24
NO_BYTES = np.empty(0, np.uint8)
NO_VECTORS = np.empty((0, 3), np.float32)
_NO_DOUBLES = np.empty((0, 3))
_NO_ROWS: Uint8s = np.empty((1, 1), np.uint8)
#: The part of probes that mixes opposite facings, and its derivatives; empty if not wanted.
Passed = tuple[Float32s, Float32s]
NO_PASSED: Passed = np.empty(0, np.float32), NO_VECTORS
_NO_FACINGS = Facings(NO_BYTES, np.empty(0, np.uint32), np.empty(0, np.uint32))


class NotFiniteError(ValueError):
    """A position is not finite; every lookup raises it."""

    def __init__(self, row: int) -> None:
        super().__init__(f"points[{row}] is not finite")
        self.row = row


def positions(points: Floats) -> Positions:
    """Return rest positions (n, 3) as kernels take them: `Positions.of` on read-only arrays too."""
    points = unlocked(points)
    return Positions(points, _NO_DOUBLES) if points.itemsize == 4 else Positions(NO_VECTORS, points)


class Field:
    """The field over one tree. Cells and weights are the same for all channels."""

    def __init__(self, tree: Octree, root: Field | None = None) -> None:
        self.tree = tree
        self.depth, self.n_cells, self.n_leaves = tree.max_depth, tree.n_cells, tree.n_leaves
        self._root = ref(root or self)  # weak, as it owns the fields of its levels
        self._lock = RLock()
        self._levels: dict[int, Field] = {}
        self._areas: dict[int, Uint8s] = {}

    def __reduce__(self) -> tuple[type[Field], tuple[Octree]]:
        return Field, (self.tree,)

    def level(self, level: int) -> Field:
        """Return the field over the averages of a level. Its cells have the same numbers."""
        if level >= self.depth:
            return self
        root = self._root() or self
        with root._lock:
            if level not in root._levels:
                root._levels[level] = Field(self.tree.truncated(level), root)
            return root._levels[level]

    def areas_of_averages(self, level: int) -> Uint8s:
        """Return the area codes of nodes down to a level (cells,), and 0, unknown, for leaves."""
        with self._lock:
            if level not in self._areas:
                areas = self.tree.arrays.areas
                if any(leaves for leaves, _ in self.tree.cells_by_depth()[: level + 1]):
                    areas = np.zeros(areas.size, np.uint8)
                    for above, (_, is_node) in enumerate(islice(self.tree.walk(), level + 1)):
                        cells = self.tree.cells_at(above)
                        areas[cells] = np.where(is_node, self.tree.arrays.areas[cells], 0)
                self._areas[level] = areas
            return self._areas[level]

    @built_once
    def facings(self) -> Facings:
        """Return the tree's facings, indexed on first use."""
        facings: Facings = unlocked(facings_of(self.tree))
        return facings

    @built_once
    def tiles(self) -> Tiles | None:
        """Return the tree's tiles, built on first use; None for trees that cannot have them."""
        return build_tiles(self.tree) if can_be_tiled(self.tree) else None

    @built_once
    def painted(self) -> tuple[Tiles, ...]:
        """Return marked tiles of one or two levels of a tree of one depth with finer paint; else none."""
        levels = [] if self.tiles is not None else painted_levels(self.tree)
        painted: list[Tiles] = []
        for level in levels:
            tiles = marked(build_tiles(self.level(level).tree), self.tree)
            n_marked, n_cells = int(bit_counts(tiles.marks).sum()), sum(self.tree.cells_by_depth()[level])
            if not painted or 2 * n_marked < n_cells:  # most points are unmarked
                painted.append(tiles)
        return tuple(painted)

    def tiles_for(self, filter_code: int) -> Tiles | None:
        """Return the tiles that find all or most points for a filter."""
        tiles: Tiles | None = self.tiles
        if tiles is None and filter_code in (LINEAR, QUADRATIC) and self.painted:
            tiles = self.painted[0]
        return tiles

    def searched(self, filter_code: int) -> Iterator[Tiles]:
        """Yield the tiles to search, each for the points that the ones before lack.

        Off the surface these are the averages of the deepest level with cells there; `nearest` first searches
        around the cell that should hold the point. Raises TextureFileError for a damaged tree.
        """
        tiles = self.tiles_for(filter_code)
        assert tiles is not None
        yield tiles
        for level in range(tiles.depth - (filter_code != NEAREST), -1, -1):
            above = self.level(level).tiles
            if above is None:  # above one depth of leaves there are nodes alone
                raise TextureFileError(
                    f"level {level}: its nodes and leaves are not those that the groups count"
                )
            yield above

    def blocks(self, points: Floats, placement: Placement, normals: Float32s | None) -> Iterator[Taps]:
        """Yield the taps of ``quadratic`` for blocks of rest positions (n, 3), as `Finder.blocks` does."""
        finder = Finder(self, placement, "quadratic")
        for _, taps in finder.blocks(points, self.weighing(self, normals is not None), normals):
            yield taps

    def weighing(self, whole: Field, faces: bool, mixed: Uint8s = NO_BYTES) -> Weighing:
        """Return the weighing of this field's taps; ``whole`` is the field that this is a level of."""
        areas = NO_BYTES if self is whole else unlocked(whole.areas_of_averages(self.depth)[: self.n_cells])
        facings, first_kept = self.facings if faces else _NO_FACINGS, whole.n_cells
        return Weighing(areas, mixed, 0, facings, faces, first_kept, first_kept + whole.tree.kept.cells.size)


def _with_room(taps: Taps, used: int, room: int) -> Taps:
    """Return the taps, the first ``used`` of them copied, with room for ``room`` in all."""
    larger = new_taps(0, 2 * room, taps.slopes.shape[0] > 0)
    for new, old in zip(larger[:3], taps[:3], strict=True):
        new[: min(used, len(old))] = old[:used]
    return larger._replace(starts=taps.starts, ends=taps.ends, covers=taps.covers)


class Finder:
    """Finds the taps of rest positions, block after block, in one field.

    ``whole`` is the field that it is a level of, by default itself. With ``adds`` the caller sums several
    levels.
    """

    def __init__(
        self,
        field: Field,
        placement: Placement,
        filter: str,
        *,
        gradient: bool = False,
        whole: Field | None = None,
        adds: bool = False,
    ) -> None:
        self.field = field
        self._placement = placement
        self._whole = whole or field
        self.filter = FILTERS.index(filter)
        self._gradient = gradient
        self._adds = adds
        self._walk: Walk | None = None
        self._taps: Taps | None = None
        # Room for the numbers of a block's points: all of them, those plus one, without cells, for the walk.
        self._all = self._next = self._empty = self._rim = np.empty(0, np.int64)
        self.coords = np.empty((0, 3))  # of the latest block, in texture space

    def blocks(
        self,
        points: Floats,
        weighing: Weighing,
        normals: Float32s | None = None,
        passed: Passed = NO_PASSED,
        rows: Uint8s = _NO_ROWS,
    ) -> Iterator[tuple[slice, Taps]]:
        """Yield the weighted taps of blocks of rest positions (n, 3); each is valid until the next.

        With ``normals`` (n, 3) only visible taps. ``passed`` takes the weight of mixed facings and its
        derivatives: see `weights.weigh_taps`. Raises NotFiniteError.
        """
        memory = np.empty((min(len(points), BLOCK), 3))
        for begin in range(0, len(points), BLOCK):
            block = slice(begin, begin + BLOCK)
            block_points = points[block]
            self.coords = memory[: len(block_points)]
            fault = to_coordinates(positions(block_points), *self._placement, self.coords)
            if fault >= 0:
                raise NotFiniteError(begin + fault)
            taps = self.find(self.coords, rows)
            if weighing.faces or weighing.areas.size:
                end = int(taps.ends.max(initial=0))
                if weighing.facings.rows.size and (1 + MOST_ROWS) * end > taps.rows.size:
                    taps = _with_room(taps, end, (1 + MOST_ROWS) * end)
                facing = NO_VECTORS if normals is None else normals[block]
                weigh_taps(taps, weighing, facing, _NO_ROWS, passed[0][block], passed[1][block])
            yield block, taps

    def find(self, coords: Float64s, rows: Uint8s = _NO_ROWS) -> Taps:
        """Return the taps of at most BLOCK points (n, 3), valid until the next call.

        ``rows``, which are read of the cells next, are prefetched.
        """
        n = len(coords)
        tiles = self.field.tiles_for(self.filter)
        most = MOST_TAPS + n * (_WALKED if tiles is None else MOST_TILED[self.filter])
        if self._taps is None or self._taps.starts.size < n:
            self._taps = new_taps(n, most, self._gradient)
            self._all, self._next = np.arange(n), np.arange(1, n + 1)
            self._empty, self._rim = np.empty(n, np.int64), np.empty(n, np.int64)
        taps = self._taps
        if taps.starts.size > n:
            taps = taps._replace(starts=taps.starts[:n], ends=taps.ends[:n], covers=taps.covers[:n])
        if tiles is not None:
            taps, end, rim = self._tiled(coords, taps, rows)
            taps = self._walked(coords, taps, end, rim)
        elif self.filter == NEAREST:
            taps = self._nearest(coords, taps)
        else:
            taps = self._walked(coords, taps, 0, self._all[:n])
        if self._gradient:
            clear_outside_slopes(taps, coords)
        return taps

    def _tiled(self, coords: Float64s, taps: Taps, rows: Uint8s) -> tuple[Taps, int, Int64s]:
        """Find taps by tiles; return them, their end, and the points for the walk."""
        ahead = Ahead(rows, _NO_ROWS[:0], NO_BYTES, NO_BYTES)
        end = n_rim = 0
        last, which = self.field.n_cells - 1, self._all[: len(coords)]
        for number, tiles in enumerate(self.field.searched(self.filter)):
            room = end + MOST_TILED[self.filter] * which.size + 8
            if room > taps.rows.size:
                taps = _with_room(taps, end, room)
            level_coords = coords if number == 0 else coords[which]
            batch = Batch(level_coords, which, last, self._empty, self._rim[n_rim:], ahead)
            end, n_empty, more_rim = FINDERS[self.filter](tiles, number > 0, batch, taps, end)
            n_rim += more_rim
            which = self._empty[:n_empty].copy()
            if not n_empty:
                break
        return taps, end, self._rim[:n_rim]

    def _walked(self, coords: Float64s, taps: Taps, end: int, which: Int64s) -> Taps:
        """Find the taps of points ``which`` by the walk."""
        tree, done = self.field.tree, 0
        while done < which.size:
            self._walk = self._walk or new_walk()
            if end + MOST_TAPS > taps.rows.size:
                taps = _with_room(taps, end, end + MOST_TAPS)
            done, end = walked_taps(
                *(tree.arrays, tree.kept.cells, self._whole.n_cells, coords, which, done),
                *(self.filter, not self._adds, self._walk, taps, end),
            )
        return taps

    def _nearest(self, coords: Float64s, taps: Taps) -> Taps:
        tree, n = self.field.tree, len(coords)
        cells, held = np.empty(n, np.int64), np.empty(n, np.bool_)
        nearest_cells(tree.arrays, positions(coords), (0.0, 0.0, 0.0), 1.0, cells, held)
        taps.rows[:n], taps.weights[:n] = cells, np.where(held, np.float32(1), OFF)
        taps.starts[:], taps.ends[:], taps.covers[:] = self._all[:n], self._next[:n], held
        return taps
