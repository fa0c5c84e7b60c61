"""The field over one tree: which taps a lookup reads, for any tree and filter."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from threading import RLock
from weakref import ref

import numpy as np

from octex.arrays import Float32s, Float64s, Floats, Int64s, Uint8s, bit_counts
from octex.errors import TextureFileError
from octex.field.blend import Listed, joined, listed
from octex.field.bricks import Tree
from octex.field.find import Cells, find_tiled, new_room
from octex.field.neighborhood import walked_taps
from octex.field.splines import FILTERS, NEAREST
from octex.field.taps import (
    BLOCK,
    MOST_TILED,
    OFF,
    Ahead,
    Taps,
    hold_outside,
    new_taps,
    place_points,
    with_room,
)
from octex.field.tiles import Tiles, TileStore, can_be_tiled, marks_of, painted_levels
from octex.field.weights import Facings, Weighing, facings_of, weigh_taps
from octex.field.windows import MOST_TAPS, Walk, new_walk
from octex.jit import unlocked
from octex.parallel import built_once
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from octex.tree.search import Positions, nearest_cells

#: Taps of a point that a walk is given room for at first.
_WALKED = 24
_NONE = np.empty(0, np.uint8)
_NOTHING: Uint8s = np.empty((1, 1), np.uint8)
_NO_LEFT = np.empty(0, np.float32), np.empty((0, 3), np.float32)
_NO_MARKS = np.empty(0, np.uint64)
_NO_FACINGS = Facings(_NONE, np.empty(0, np.uint32), np.empty(0, np.uint32))


class NotFiniteError(ValueError):
    """A position that is not finite: the row of it."""

    def __init__(self, row: int) -> None:
        super().__init__(f"points[{row}] is not finite")
        self.row = row


class Field:
    """The field over one tree: which cells count, and how much, is the same for all channels."""

    def __init__(self, tree: Octree, root: Field | None = None) -> None:
        self.tree = tree
        self._store: TileStore = root._store if root else TileStore(tree)
        self.depth, self.n_cells, self.n_leaves = tree.max_depth, tree.n_cells, tree.n_leaves
        self._root = ref(
            root or self
        )  # of a level, the field that it is of; it keeps its levels, not they it
        self._lock = RLock()
        self._levels: dict[int, Field] = {}
        self._areas: dict[int, Uint8s] = {}

    def __reduce__(self) -> tuple[type[Field], tuple[Octree]]:
        return Field, (self.tree,)

    def level(self, level: int) -> Field:
        """Return the field over the averages of a level, whose cells have the same numbers."""
        if level >= self.depth:
            return self
        root = self._root() or self
        with root._lock:
            if level not in root._levels:
                root._levels[level] = Field(self.tree.truncated(level), root)
            return root._levels[level]

    def areas_of_averages(self, level: int) -> Uint8s:
        """Return the codes of the areas of nodes down to a level (cells,), 0 for leaves: not known."""
        with self._lock:
            if level not in self._areas:
                areas = self.tree.arrays.areas
                if any(leaves for leaves, _ in self.tree.cells_by_depth()[: level + 1]):
                    areas = np.zeros(areas.size, np.uint8)
                    for above, (_, is_node) in enumerate(islice(self.tree.walk(), level + 1)):
                        nodes = np.flatnonzero(is_node) + int(self.tree.arrays.level_cells[above])
                        areas[nodes] = self.tree.arrays.areas[nodes]
                self._areas[level] = areas
            return self._areas[level]

    @built_once
    def facings(self) -> Facings:
        """Return the tree's facings, indexed on first use."""
        found: Facings = unlocked(facings_of(self.tree))
        return found

    @built_once
    def tiles(self) -> Tiles | None:
        """Return the tiles of the tree's deepest level, built on first use; None for trees without any."""
        return self._store.at(self.depth) if can_be_tiled(self.tree) else None

    @built_once
    def cells(self) -> Cells:
        """Return the tree's cells as lookups find them, indexed on first use.

        Tiles are searched where leaves have one depth, or had it before a part was painted more finely.
        """
        tree, first, finer, marks = self.tree, -1, -1, _NO_MARKS
        if self.tiles is not None:
            first = self.depth
        else:
            for level in painted_levels(tree):
                own = marks_of(self._store.at(level), tree)
                n_marked, n_cells = int(bit_counts(own).sum()), sum(tree.cells_by_depth()[level])
                if first < 0:
                    first, marks = level, own
                elif 2 * n_marked < n_cells:  # they serve the most
                    own[: marks.size] |= marks
                    finer, marks = level, own
        searched = self._store.levels, marks, first, finer
        cells: Cells = unlocked(Cells(tree.arrays, tree.kept.cells, self.n_cells, *searched))
        return cells

    def cells_in(self, whole: Field) -> Cells:
        """Return the cells, of which kept ones have the rows of the field that this is a level of."""
        cells: Cells = self.cells
        return cells if self is whole else cells._replace(first_kept=whole.n_cells)

    def build(self, level: int) -> None:
        """Build the tiles of a level, which off the surface has the averages that answer.

        Raises TextureFileError for a damaged tree: all leaves have one depth, or had it before a part was
        painted, so that it has no other cells.
        """
        if not can_be_tiled(self.level(level).tree):
            raise TextureFileError(f"level {level}: its nodes and leaves are not those that the groups count")
        self._store.at(level)

    @built_once
    def mixed(self) -> Tree:
        """Return the tree as bricks are decoded from it, indexed on first use."""
        return Tree.of(self.tree)

    def prepare(self) -> None:
        """Build what lookups of the leaves read, before threads share it."""
        self.cells, self.mixed  # noqa: B018

    def taps(
        self,
        points: Floats,
        placement: Placement,
        filter: str = "quadratic",
        *,
        normals: Float32s | None = None,
        gradient: bool = False,
    ) -> Listed:
        """List the taps of rest positions (n, 3), with their slopes if ``gradient``. See ``runs``."""
        runs = self.runs(points, placement, filter, normals=normals, gradient=gradient)
        return joined([listed(taps, 1.0 / placement.size) for taps in runs])

    def runs(
        self,
        points: Floats,
        placement: Placement,
        filter: str = "quadratic",
        *,
        normals: Float32s | None = None,
        gradient: bool = False,
    ) -> Iterator[Taps]:
        """Yield what runs of rest positions (n, 3) blend, as it is found: valid until the next run.

        With ``normals`` (n, 3) it is what faces these; after the kept rows come those of the split table.
        Raises NotFiniteError.
        """
        finder = Finder(self, filter, gradient=gradient)
        for begin in range(0, len(points), BLOCK):
            block = slice(begin, begin + BLOCK)
            taps, fault = finder.at(points[block], placement)
            if fault >= 0:
                raise NotFiniteError(begin + fault)
            if normals is not None:
                taps = weigh_taps(taps, self.weighing(self, True), normals[block], _NOTHING, *_NO_LEFT)
            yield taps

    def weighing(self, whole: Field, faces: bool, mixed: Uint8s = _NONE) -> Weighing:
        """Return what weighs the taps of this field, toward normals or not.

        ``whole`` is the field that this is a level of: its cells are those that rows are counted after.
        """
        areas = _NONE if self is whole else unlocked(whole.areas_of_averages(self.depth)[: self.n_cells])
        facings, first_kept = self.facings if faces else _NO_FACINGS, whole.n_cells
        return Weighing(areas, mixed, 0, facings, faces, first_kept, first_kept + whole.tree.kept.cells.size)


class Finder:
    """Finds the taps of points, a block after another, in one field.

    ``whole`` is the field that it is a level of, by default itself. With ``adds`` the taps of several levels
    are added up.
    """

    def __init__(
        self,
        field: Field,
        filter: str,
        *,
        gradient: bool = False,
        whole: Field | None = None,
        adds: bool = False,
    ) -> None:
        self._field, self._cells, self._filter = field, field.cells_in(whole or field), FILTERS.index(filter)
        self._gradient, self._adds = gradient, adds
        self._walk: Walk | None = None
        #: Where the latest points lie in texture space.
        self.places = np.empty((0, 3))

    def at(self, points: Floats, placement: Placement, rows: Uint8s = _NOTHING) -> tuple[Taps, int]:
        """Return the taps of rest positions (n, 3), valid until the next are found.

        Beside them comes the first position that is not finite, or −1. ``rows`` are what will be read of the
        cells next: they are asked for.
        """
        n, cells, code = len(points), self._cells, self._filter
        is_tiled = cells.has_tiles_for(code)
        if len(self.places) < n:
            self.places = np.empty((n, 3))
            self._room = new_room(n, self._gradient)
            most = MOST_TILED[code] * n + 520 if is_tiled else _WALKED * n + MOST_TAPS
            self._taps = new_taps(n, most, self._gradient)
        places, taps, which = self.places[:n], self._taps, np.arange(n)
        fault = place_points(Positions.of(points), *placement, places)
        taps = taps._replace(starts=taps.starts[:n], ends=taps.ends[:n], covers=taps.covers[:n])
        end, lacking = 0, 0
        while is_tiled and lacking >= 0:
            ahead = Ahead(rows, _NOTHING[:0], _NONE, _NONE)
            end, n_rim, lacking = find_tiled(cells, code, places, ahead, self._room, taps)
            if lacking >= 0:
                self._field.build(lacking)
            which = self._room.lists[2, :n_rim]
        if code == NEAREST and not is_tiled:
            held = np.empty(n, np.bool_)
            nearest_cells(cells.arrays, places, (0.0, 0.0, 0.0), 1.0, which, held)
            taps.rows[:n], taps.weights[:n] = which, np.where(held, np.float32(1), OFF)
            taps.starts[:], taps.ends[:], taps.covers[:] = np.arange(n), np.arange(1, n + 1), held
        elif which.size:
            taps = self._walked(places, taps, end, which)
        if self._gradient:
            hold_outside(taps, places)
        return taps, fault

    def _walked(self, places: Float64s, taps: Taps, end: int, which: Int64s) -> Taps:
        """Walk to the taps of some points."""
        if self._walk is None:
            self._walk = new_walk()
        cells, done = self._cells, 0
        while done < which.size:
            if end + MOST_TAPS > taps.rows.size:
                taps = with_room(taps, end, end + MOST_TAPS)
                self._taps = self._taps._replace(rows=taps.rows, weights=taps.weights, slopes=taps.slopes)
            task = places, which, done, self._filter, not self._adds, self._walk, taps, end
            done, end = walked_taps(cells.arrays, cells.kept, cells.first_kept, *task)
        return taps
