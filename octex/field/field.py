"""The field over one tree: what a lookup reads, for any tree and filter, and as fast as the tree allows."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from itertools import islice
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.field.blend import Codes, Colors, Task
from octex.field.blocks import BLOCK
from octex.field.facings import Facings, Sight, facings_of
from octex.field.linear import linear_colors
from octex.field.nearest import nearest_colors
from octex.field.neighborhood import MOST_TAPS, new_walk, walk_all
from octex.field.quadratic import WINDOW_TABLES, quadratic_colors
from octex.field.splines import FILTERS
from octex.field.tiled import tiled_taps
from octex.field.tiles import Tiles, build_tiles, can_be_tiled
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from octex.tree.search import nearest_cells

Points = npt.NDArray[np.float32 | np.float64]
Float32s = npt.NDArray[np.float32]

#: Room for the taps of a batch of points: a thousand or more.
_ROOM = BLOCK * MOST_TAPS + (1 << 14)


class Taps(NamedTuple):
    """What lookups read: rows of values, and the weights under which they are blended.

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

    def __init__(self, tree: Octree) -> None:
        self.tree = tree
        self._levels: dict[int, Field] = {}
        self._areas: dict[int, npt.NDArray[np.uint8]] = {}

    def level(self, level: int) -> Field:
        """Return the field over the averages of a level, whose cells have the same numbers."""
        if level >= self.tree.max_depth:
            return self
        if level not in self._levels:
            self._levels[level] = Field(self.tree.truncated(level))
        return self._levels[level]

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

    def taps(
        self, points: Points, placement: Placement, filter: str = "quadratic", *, gradient: bool = False
    ) -> Taps:
        """Find the taps of rest positions (n, 3), with their slopes if ``gradient``.

        Raises NotFiniteError.
        """
        found = [
            Taps(
                taps.starts.copy(),
                taps.rows.copy(),
                taps.weights.copy(),
                taps.slopes.copy(),
                taps.covers.copy(),
            )
            for taps in self.batches(points, placement, filter, gradient=gradient)
        ]
        if len(found) == 1:
            return found[0]
        ends = np.cumsum([0, *(taps.rows.size for taps in found)])
        starts = [taps.starts[:-1] + end for taps, end in zip(found, ends, strict=False)]
        return Taps(
            np.concatenate([*starts, ends[-1:]]),
            np.concatenate([np.empty(0, np.uint32), *(taps.rows for taps in found)]),
            np.concatenate([np.empty(0, np.float32), *(taps.weights for taps in found)]),
            np.concatenate([np.empty((0, 3), np.float32), *(taps.slopes for taps in found)]),
            np.concatenate([np.empty(0, np.float32), *(taps.covers for taps in found)]),
        )

    def batches(
        self, points: Points, placement: Placement, filter: str = "quadratic", *, gradient: bool = False
    ) -> Iterator[Taps]:
        """Yield the taps of consecutive runs of rest positions, each valid until the next. See ``taps``."""
        if filter == "nearest":
            yield self._nearest(points, placement)
            return
        code, walk = FILTERS.index(filter), new_walk()
        starts = np.empty(len(points) + 1, np.int64)
        rows, weights = np.empty(_ROOM, np.uint32), np.empty(_ROOM, np.float32)
        slopes = np.empty((_ROOM if gradient else 0, 3), np.float32)
        covers = np.empty(len(points), np.float32)
        target = starts, rows, weights, slopes, covers
        arrays, kept_cells = self.tree.arrays, self.tree.kept.cells
        tiles = None if gradient or filter == "quartic" else self.tiles
        begin = 0
        while begin < len(points):
            where = points, begin, *placement, code, walk
            if tiles is None:
                done = walk_all(arrays, kept_cells, *where, *target)
            else:
                done = tiled_taps(tiles, arrays, kept_cells, *where, *target, *WINDOW_TABLES)
            if done < 0:
                raise NotFiniteError(-1 - done)
            end = starts[done]
            yield Taps(starts[: done + 1], rows[:end], weights[:end], slopes[:end], covers[:done])
            begin += done

    def _nearest(self, points: Points, placement: Placement) -> Taps:
        n = len(points)
        cells, held = np.empty(n, np.int64), np.empty(n, np.bool_)
        fault = nearest_cells(self.tree.arrays, points, *placement, cells, held)
        if fault >= 0:
            raise NotFiniteError(fault)
        ones = np.ones(n, np.float32)
        covers = held.astype(np.float32)
        return Taps(np.arange(n + 1), cells.astype(np.uint32), ones, np.empty((0, 3), np.float32), covers)

    def colors(
        self,
        points: Points,
        placement: Placement,
        filter: str,
        sight: Sight,
        codes: Codes,
        areas: npt.NDArray[np.uint8],
        results: Float32s,
        covers: Float32s,
        left: Float32s,
    ) -> npt.NDArray[np.int64] | None:
        """Write the field of three components at rest positions (n, 3) to ``results`` (n, 3).

        The shortest way through all, for what is asked for most. See `Colors` for ``covers`` and ``left``,
        `Task` for ``areas``.
        Returns the points that are off the surface, whose results are not written; or None, and nothing is
        written, if the tree has no tiles or the filter none of its own. Raises NotFiniteError.
        """
        if filter == "quartic" or self.tiles is None:
            return None
        missed = np.empty(len(points), np.int64)
        colors = Colors(results, covers, left, missed)
        task = self.tiles, *placement, Task(points, sight, codes, areas, colors)
        if filter == "nearest":
            n_missed, fault = nearest_colors(*task)
        elif filter == "linear":
            n_missed, fault = linear_colors(*task)
        else:
            n_missed, fault = quadratic_colors(*task, *WINDOW_TABLES)
        if fault >= 0:
            raise NotFiniteError(fault)
        return missed[:n_missed]
