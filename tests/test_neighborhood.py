from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex.field.neighborhood import MOST_TAPS, Walk, new_walk, walk_all
from octex.field.splines import FILTERS
from octex.tree.layout import TreeArrays
from octex.tree.octree import Octree
from tests import naive
from tests.strategies import leaf_sets, points_around, with_random_data

UNIT = ((0.0, 0.0, 0.0), 1.0)
Points = npt.NDArray[np.float32 | np.float64]

each_filter = pytest.mark.parametrize("filter", FILTERS[1:])


class Drawn(NamedTuple):
    tree: Octree
    cells: list[naive.Cell]
    points: npt.NDArray[np.float64]

    def field(self, filter: str) -> naive.Field:
        """A field whose values are the weights of the rows."""
        kept_cells = self.tree.kept.cells.tolist()
        n_cells = len(self.cells)
        kept = {cell: n_cells + row for row, cell in enumerate(kept_cells)}
        return naive.Field(self.cells, np.eye(n_cells + len(kept)), filter, kept)


@st.composite
def trees_and_points(draw: st.DrawFn) -> Drawn:
    leaves = draw(leaf_sets())
    tree = with_random_data(Octree.from_leaves(*leaves), draw(st.integers(0, 2**32 - 1)))
    points = np.array(draw(st.lists(points_around(leaves), min_size=1, max_size=6)))
    return Drawn(tree, naive.cells_of(leaves.places()), points.clip(0, 1) + 1 - 1)  # whole 2⁻⁵²


class Taps(NamedTuple):
    starts: npt.NDArray[np.int64]
    rows: npt.NDArray[np.uint32]
    weights: npt.NDArray[np.float32]
    slopes: npt.NDArray[np.float32]

    def spread(self, n: int, n_rows: int) -> npt.NDArray[np.float64]:
        """Weight and slopes of every row in point n: (4, rows)."""
        here = slice(self.starts[n], self.starts[n + 1])
        rows = self.rows[here]
        assert np.unique(rows).size == rows.size
        spread = np.zeros((4, n_rows))
        spread[0, rows] = self.weights[here]
        spread[1:, rows] = self.slopes[here].T
        return spread


def taps(
    arrays: TreeArrays,
    kept_cells: npt.NDArray[np.uint32],
    points: Points,
    filter: str,
    walk: Walk | None = None,
    *,
    room: int = MOST_TAPS,
    gradient: bool = True,
) -> Taps:
    """All points' taps, in blocks with room for the taps of at least one point."""
    walk = walk or new_walk()
    starts = np.zeros(len(points) + 1, np.int64)
    rows, weights = np.zeros(room, np.uint32), np.zeros(room, np.float32)
    slopes = np.zeros((room * gradient, 3), np.float32)
    code = FILTERS.index(filter)
    parts = []
    done = 0
    while done < len(points):
        own = starts[done:].copy()
        n = walk_all(arrays, kept_cells, points, done, *UNIT, code, walk, own, rows, weights, slopes)
        assert n > 0
        starts[done : done + n + 1] = starts[done] + own[: n + 1]
        parts.append([array[: own[n]].copy() for array in (rows, weights, slopes)])
        done += n
    return Taps(starts, *(np.concatenate(columns) for columns in zip(*parts, strict=True)))


@each_filter
@given(trees_and_points())
def test_taps_are_what_the_field_is_made_of(filter: str, drawn: Drawn) -> None:
    found = taps(drawn.tree.arrays, drawn.tree.kept.cells, drawn.points, filter)
    field = drawn.field(filter)
    edge = 2.0**-drawn.tree.max_depth
    for n, point in enumerate(drawn.points.tolist()):
        by_axis = [field.derivatives(point, axis, 1) for axis in np.eye(3).tolist()]
        weights, *slopes = found.spread(n, len(field.values))
        np.testing.assert_allclose(weights, by_axis[0][0], atol=1e-6)
        for own, expected in zip(slopes, by_axis, strict=True):
            np.testing.assert_allclose(own * edge, expected[1] * edge, atol=1e-5)
