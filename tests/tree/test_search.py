import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex import jit
from octex.field.field import Field
from octex.jit import kernel
from octex.tree.layout import TreeArrays
from octex.tree.morton import encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from octex.tree.search import Positions, child, in_leaves, nearest_cells
from tests.make.strategies import leaf_sets, points_around
from tests.make.taps import taps_of
from tests.oracles import naive

UNIT = ((0.0, 0.0, 0.0), 1.0)


@st.composite
def trees_and_points(draw):
    leaves = draw(leaf_sets())
    points = draw(st.lists(points_around(leaves), min_size=1, max_size=12))
    return leaves, np.array(points)


@kernel
def child_of(arrays, node, octant):
    return child(arrays, node, octant)


@pytest.mark.skipif(jit.DISABLED, reason="what is not compiled can be called anywhere")
def test_what_is_inlined_is_not_called_from_python():
    tree = Octree.from_leaves([0], 1)
    child_of(tree.arrays, 0, 0)
    for _ in range(2):
        with pytest.raises(TypeError, match="child can be called in kernels only"):
            child(tree.arrays, 0, 0)


@given(leaf_sets(deepest=5))
def test_children_are_found_from_the_masks(leaves):
    tree = Octree.from_leaves(*leaves)
    cells = naive.cells_of(leaves.places())
    numbers = {(cell.level, cell.place): number for number, cell in enumerate(cells)}
    nodes = [number for number, cell in enumerate(cells) if not cell.is_leaf]
    for node, number in enumerate(nodes):
        level, place, _ = cells[number]
        for octant in range(8):
            below = tuple(2 * x + (octant >> axis & 1) for axis, x in enumerate(place))
            expected = numbers.get((level + 1, below), -1)
            expected_node = nodes.index(expected) if expected in nodes else -1
            assert child_of(tree.arrays, node, octant) == (expected, expected_node)


@given(trees_and_points())
def test_nearest_is_the_leaf_that_holds_the_point_if_any_or_the_nearest_of_27_cells(drawn):
    leaves, points = drawn
    tree = Octree.from_leaves(*leaves)
    cells = naive.cells_of(leaves.places())
    found, (held, inside) = np.empty(len(points), np.int64), np.empty((2, len(points)), np.bool_)
    assert nearest_cells(tree.arrays, Positions.of(points), *UNIT, found, held) == -1
    assert found.tolist() == [naive.nearest(cells, point) for point in points.tolist()]
    numbers = [naive.find(cells, np.clip(point, 0, 1 - 2**-31).tolist()) for point in points]
    assert held.tolist() == [cells[number].is_leaf for number in numbers]
    assert in_leaves(tree.arrays, Positions.of(points), *UNIT, inside) == -1
    numbers = [naive.find(cells, point) for point in points.tolist()]
    assert inside.tolist() == [number >= 0 and cells[number].is_leaf for number in numbers]


def test_points_are_placed_in_float64_before_anything_else():
    tree = Octree.from_leaves(np.arange(8), 1)
    points = np.full((1, 3), 0.6, np.float32)
    just_above = float(points[0, 0]) - 0.5 + 1e-8  # the difference is 0.5 in float32, below it in float64
    cells = np.empty(1, np.int64)
    nearest_cells(
        tree.arrays, Positions.of(points), (just_above, 0.0, 0.0), 1.0, cells, np.empty(1, np.bool_)
    )
    assert cells[0] == 1 + 0b110


@given(leaf_sets(), st.integers(0, 2**32 - 1))
def test_damaged_structures_are_searched_without_harm(leaves, seed):
    tree = Octree.from_leaves(*leaves)
    noise = np.random.default_rng(seed)
    groups = noise.integers(0, 2**64, tree.arrays.groups.shape, dtype=np.uint64)
    arrays = TreeArrays(groups, *tree.arrays[1:])
    points = noise.random((50, 3))
    cells = np.empty(50, np.int64)
    nearest_cells(arrays, Positions.of(points), *UNIT, cells, np.empty(50, np.bool_))
    assert cells.min() >= 0 and cells.max() < tree.n_cells
    in_leaves(arrays, Positions.of(points), *UNIT, np.empty(50, np.bool_))


def test_points_between_two_steps_lie_in_one_cell_however_they_are_asked_for():
    depth, placement = 10, Placement((0.1, -0.3, 0.7), 0.9437)
    ends = np.arange(1, 1 << depth)  # of cells along x, every other of which is stored
    places = np.full((len(ends), 3), 2.0**-12)
    places[:, 0] = ends / 2.0**depth - 2.0**-31
    points = placement.to_rest(places)
    cells = np.zeros((1 << depth - 1, 3), np.int64)
    cells[:, 0] = np.arange(0, 1 << depth, 2)
    tree = Octree.from_leaves(np.sort(encode_cells(cells)), depth)
    steps = np.floor(placement.to_texture_space(points)[:, 0] * 2.0**30 + 0.5).astype(np.int64)
    inside = np.empty(len(points), np.bool_)
    in_leaves(tree.arrays, Positions.of(points), *placement, inside)
    np.testing.assert_array_equal(inside, steps >> 20 & 1 == 0)
    np.testing.assert_array_equal(taps_of(Field(tree), points, placement, "nearest").covers > 0, inside)
