from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex.field import taps as taps_of
from octex.field.splines import FILTERS
from octex.field.walk_taps import walked_taps
from octex.field.windows import MOST_TAPS, new_walk
from octex.tree.layout import KEPT
from octex.tree.octree import Octree
from tests.make.strategies import leaf_sets, points_around, with_random_data
from tests.oracles import naive

each_filter = pytest.mark.parametrize("filter", FILTERS[1:])


class Drawn(NamedTuple):
    tree: Octree
    points: npt.NDArray[np.float64]


@st.composite
def trees_and_points(draw):
    leaves = draw(leaf_sets())
    tree = with_random_data(Octree.from_leaves(*leaves), draw(st.integers(0, 2**32 - 1)))
    points = np.array(draw(st.lists(points_around(leaves), min_size=1, max_size=3)))
    return Drawn(tree, points.clip(0, 1) + 1 - 1)  # whole 2⁻⁵²


class Taps(NamedTuple):
    starts: npt.NDArray[np.int64]
    rows: npt.NDArray[np.uint32]
    weights: npt.NDArray[np.float32]
    slopes: npt.NDArray[np.float32]
    covers: npt.NDArray[np.float32]

    def spread(self, n, n_rows):
        """Weight and slopes of every row in point n: (4, rows)."""
        here = slice(self.starts[n], self.starts[n + 1])
        rows = self.rows[here]
        assert np.unique(rows).size == rows.size
        spread = np.zeros((4, n_rows))
        spread[0, rows] = self.weights[here]
        spread[1:, rows] = self.slopes[here].T
        return spread


def taps(arrays, kept_cells, points, filter, walk=None, *, room=MOST_TAPS, gradient=True):
    """All points' taps, in blocks with room for the taps of at least one point."""
    walk = walk or new_walk()
    n = len(points)
    found = taps_of.new_taps(n, room, gradient)
    which, code = np.arange(n), FILTERS.index(filter)
    parts = []
    done = 0
    while done < n:
        begin = done
        task = arrays, kept_cells, arrays.flags.size, np.asarray(points, np.float64), which, begin
        done, end = walked_taps(*task, code, True, walk, found, 0)
        assert done > begin
        counts = (found.ends - found.starts)[begin:done]
        covers = found.covers[begin:done]
        sums = np.where(covers > 0, np.maximum(covers, taps_of.LEAST), taps_of.OFF)
        scales = np.repeat(sums, counts)
        slopes = found.slopes[:end] / scales[:, None] if gradient else found.slopes
        parts.append((counts, found.rows[:end].copy(), found.weights[:end] / scales, slopes))
    counts, *columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Taps(np.cumsum([0, *counts]), *columns, found.covers)


@each_filter
@given(trees_and_points())
def test_taps_are_what_the_field_is_made_of(filter, drawn):
    found = taps(drawn.tree.arrays, drawn.tree.kept.cells, drawn.points, filter)
    field = naive.field_of(drawn.tree, filter)
    edge = 2.0**-drawn.tree.max_depth
    for n, point in enumerate(drawn.points.tolist()):
        by_axis = [field.derivatives(point, axis, 1) for axis in np.eye(3).tolist()]
        weights, *slopes = found.spread(n, len(field.values))
        np.testing.assert_allclose(weights, by_axis[0][0], atol=1e-6)
        for own, expected in zip(slopes, by_axis, strict=True):
            np.testing.assert_allclose(own * edge, expected[1] * edge, atol=1e-5)


@given(trees_and_points())
def test_one_walk_serves_all_filters_and_slopes_do_not_change_weights(drawn):
    walk = new_walk()
    for filter in (*FILTERS[1:], *FILTERS[:0:-1]):
        found = taps(drawn.tree.arrays, drawn.tree.kept.cells, drawn.points, filter, walk, gradient=False)
        expected = taps(drawn.tree.arrays, drawn.tree.kept.cells, drawn.points, filter)
        assert found.slopes.size == 0
        for n in range(len(drawn.points)):
            here, there = (slice(each.starts[n], each.starts[n + 1]) for each in (found, expected))
            shares = dict(zip(expected.rows[there].tolist(), expected.weights[there].tolist(), strict=True))
            own = dict(zip(found.rows[here].tolist(), found.weights[here].tolist(), strict=True))
            assert own == {row: share for row, share in shares.items() if row in own}
            assert all(share == 0 for row, share in shares.items() if row not in own)


def test_points_are_done_until_there_might_be_no_room_for_more():
    points = np.random.default_rng(5).random((40, 3))
    arrays, kept_cells = Octree.from_leaves(np.arange(64), 2).arrays, np.zeros(0, np.uint32)
    at_once = taps(arrays, kept_cells, points, "quadratic", room=MOST_TAPS + 40 * 27)
    in_blocks = taps(arrays, kept_cells, points, "quadratic", room=MOST_TAPS + 50)
    for found, expected in zip(in_blocks, at_once, strict=True):
        np.testing.assert_array_equal(found, expected)


@each_filter
@given(trees_and_points(), st.integers(0, 2**32 - 1))
def test_damaged_structures_are_walked_without_harm(filter, drawn, seed):
    arrays = drawn.tree.arrays
    noise = np.random.default_rng(seed)
    damaged = arrays._replace(
        groups=noise.integers(0, 2**64, arrays.groups.shape, dtype=np.uint64),
        flags=noise.integers(0, 256, arrays.flags.shape, dtype=np.uint8),
    )
    kept_cells = noise.integers(0, 2**32, 5, dtype=np.uint32)
    found = taps(damaged, kept_cells, drawn.points, filter)
    assert found.rows.max(initial=0) < drawn.tree.n_cells + kept_cells.size


def test_a_node_that_is_flagged_but_not_listed_has_no_taps():
    tree = Octree.from_leaves(np.arange(16), 2)
    flags = tree.arrays.flags.copy()
    flags[1] |= KEPT
    arrays = tree.arrays._replace(flags=flags)
    found = taps(arrays, np.array([3], np.uint32), np.array([[0.2, 0.3, 0.1]]), "quadratic")
    assert found.rows.max() < tree.n_cells
