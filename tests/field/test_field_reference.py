"""What the field promises, shown on the slow reference of tests/oracles/naive.py."""

from __future__ import annotations

import itertools
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from octex import jit
from tests.make.strategies import leaf_sets, points_around
from tests.oracles import naive

SMOOTH = {"quadratic": 1, "quartic": 3}  # filters: the highest derivative that is continuous
FILTERS = ("linear", *SMOOTH)

few = settings(max_examples=10 if jit.DISABLED else 15)


class Tree(NamedTuple):
    cells: list[naive.Cell]
    kept: dict[int, int]
    points: list[tuple[float, float, float]]
    seed: int

    @property
    def rows(self):
        return len(self.cells) + len(self.kept)

    def field(self, filter):
        values = np.random.default_rng(self.seed).random((self.rows, 2))
        return naive.Field(self.cells, values, filter, self.kept)


@st.composite
def trees(draw, deepest=6):
    """Leaves at mixed depths; none, some or all nodes kept; points near leaves, elsewhere and outside."""
    leaves = draw(leaf_sets(deepest))
    cells = naive.cells_of(leaves.places())
    nodes = [number for number, cell in enumerate(cells) if not cell.is_leaf]
    seed = draw(st.integers(0, 2**32 - 1))
    chosen = np.random.default_rng(seed).random(len(nodes)) < draw(st.sampled_from([0, 0.3, 1]))
    kept = [node for node, keep in zip(nodes, chosen, strict=True) if keep and len(cells) > 1]
    points = draw(st.lists(points_around(leaves), min_size=1, max_size=8))
    return Tree(cells, {node: len(cells) + n for n, node in enumerate(kept)}, points, seed)


def sphere(coarse, fine):
    """The leaves of a spherical shell, finer where x, y and z are above the middle."""

    def below(level, place):
        corners = np.array([place, np.add(place, 1)]) / 2**level - 0.5
        nearest = np.linalg.norm(np.maximum(np.maximum(corners[0], -corners[1]), 0))
        farthest = np.linalg.norm(np.abs(corners).max(0))
        if nearest <= 0.31 <= farthest:
            if level == (fine if corners[0].min() >= 0 and level >= coarse else coarse):
                yield level, place
            else:
                for octant in itertools.product((0, 1), repeat=3):
                    yield from below(level + 1, tuple(2 * i + o for i, o in zip(place, octant, strict=True)))

    return list(below(0, (0, 0, 0)))


def crossings(field, leaves, random):
    """Points in the leaves on faces of their cells and of any cells below, each with a direction through it.

    Also says whether the depth changes there.
    """
    for leaf, axis in itertools.product(leaves, range(3)):
        for level in range(leaf.level, field.max_depth + 1):
            first = leaf.place[axis] << level - leaf.level
            for plane in range(first, first + (1 << level - leaf.level) + 1):
                if 0 < plane < 2**level and (level == leaf.level or plane % 2):
                    point = (np.array(leaf.place) + random.random(3)) / 2**leaf.level
                    point[axis] = plane / 2**level
                    direction = random.normal(size=3)
                    direction /= np.linalg.norm(direction)
                    changes = field.stop(point, direction)[0] != field.stop(point, -direction)[0]
                    yield point, direction, changes


def jumps(field, point, direction, order):
    """How far value and derivatives jump at a point, per cell of the finer side."""
    finest = max(field.stop(point, direction)[0], field.stop(point, -direction)[0])
    after, before = (field.derivatives(point, direction, order, before=side) for side in (False, True))
    return np.abs(after - before).max(1) / 2.0 ** (finest * np.arange(order + 1))


@cache
def sphere_field(filter):
    """An adaptive sphere of random values, and where its leaves meet a change of depth."""
    cells = naive.cells_of(sphere(4, 6))
    field = naive.Field(cells, np.random.default_rng(7).random((len(cells), 1)), filter)
    beside = [cell for cell in cells if cell.is_leaf and field.meets_node(cell.level, cell.place)]
    met = crossings(field, 3 * beside, np.random.default_rng(3))
    return field, [(point, direction) for point, direction, changes in met if changes]


@pytest.mark.parametrize("filter", SMOOTH)
@few
@given(trees())
def test_the_field_is_smooth_across_every_face_and_change_of_depth(filter, tree):
    field = tree.field(filter)
    random = np.random.default_rng(tree.seed)
    leaves = [cell for cell in tree.cells if cell.is_leaf]
    random.shuffle(leaves)
    met = list(itertools.islice(crossings(field, leaves[:3], random), 200))
    for point, direction, _ in sorted(met, key=lambda crossing: not crossing[2])[:24]:
        value, *slopes = jumps(field, point, direction, SMOOTH[filter])
        assert value <= 1e-9
        assert max(slopes) <= 1e-6


@pytest.mark.parametrize("filter", SMOOTH)
def test_the_field_of_an_adaptive_sphere_is_smooth_across_every_change_of_depth(filter):
    field, changes = sphere_field(filter)
    assert len(changes) > 200
    value, *slopes = np.max([jumps(field, *change, SMOOTH[filter]) for change in changes[:400]], 0)
    assert value <= 1e-14
    assert max(slopes) <= 1e-13


def test_linear_jumps_by_five_percent_of_the_range_where_the_depth_changes():
    field, changes = sphere_field("linear")
    assert max(jumps(field, *change, 0)[0] for change in changes) > 0.05


@pytest.mark.parametrize(("filter", "order"), [("quadratic", 2), ("quartic", 4)])
def test_the_next_derivative_does_jump_so_that_the_jumps_are_measured(filter, order):
    field, changes = sphere_field(filter)
    assert max(jumps(field, *change, order)[order] for change in changes[:50]) > 0.1


@pytest.mark.parametrize("filter", FILTERS)
@few
@given(trees(deepest=naive.MAX_DEPTH))
def test_weights_are_never_negative_and_sum_to_one(filter, tree):
    rows = naive.Field(tree.cells, np.eye(tree.rows), filter, tree.kept)
    for point in tree.points:
        weights = rows.at(point)
        assert weights.min() >= 0
        assert abs(weights.sum() - 1) <= 1e-13


@pytest.mark.parametrize("filter", FILTERS)
@few
@given(trees())
def test_constants_are_exact(filter, tree):
    field = naive.Field(tree.cells, np.full((tree.rows, 1), 0.3), filter, tree.kept)
    assert all(abs(field.at(point) - 0.3) <= 1e-15 for point in tree.points)


@pytest.mark.parametrize("filter", FILTERS)
@few
@given(trees(deepest=naive.MAX_DEPTH))
def test_every_stored_leaf_has_weight_throughout(filter, tree):
    field = tree.field(filter)
    random = np.random.default_rng(tree.seed)
    for leaf in [cell for cell in tree.cells if cell.is_leaf][:4]:
        for offset in (*np.ndindex(2, 2, 2), random.random(3)):
            assert field.weight((np.array(leaf.place) + offset) / 2**leaf.level) > 0


def split(field, random):
    """Turn some leaves into kept nodes, whose children, some of them stored, take the refined values."""
    cells = {(cell.level, cell.place): field.values[n, :-1] for n, cell in enumerate(field.cells)}
    coefficients = {field.cells[node][:2]: field.values[row, :-1] for node, row in field.kept.items()}
    leaves = {cell[:2] for cell in field.cells if cell.is_leaf}
    for level, place in sorted(leaves):
        if random.random() < 0.5:
            leaves.remove((level, place))
            coefficients[level, place] = cells[level, place]
            octants = list(itertools.product((0, 1), repeat=3))
            random.shuffle(octants)
            for octant in octants[: random.integers(1, 9)]:
                child = tuple(2 * i + o for i, o in zip(place, octant, strict=True))
                refined = field.refined(level + 1, child)
                cells[level + 1, child] = refined[:-1] / refined[-1]
                leaves.add((level + 1, child))
    numbered = naive.cells_of(leaves) if leaves else field.cells
    kept = {
        n: len(numbered) + m for m, n in enumerate(n for n, c in enumerate(numbered) if c[:2] in coefficients)
    }
    rows = [cells[cell[:2]] for cell in numbered] + [coefficients[numbered[node][:2]] for node in kept]
    return naive.Field(numbered, np.array(rows), field.filter, kept)


@pytest.mark.parametrize("filter", SMOOTH)
@few
@given(trees())
def test_splitting_leaves_with_kept_coefficients_does_not_move_the_field(filter, tree):
    before = tree.field(filter)
    random = np.random.default_rng(tree.seed)
    once = split(before, random)
    twice = split(once, random)
    for point in tree.points:
        expected = before.at(point)
        assert np.abs(once.at(point) - expected).max() <= 1e-12
        assert np.abs(twice.at(point) - expected).max() <= 1e-12


@given(trees(), st.integers(0, 5))
def test_off_the_surface_the_averages_of_the_deepest_level_that_has_any_answer(tree, level):
    field = tree.field("quadratic")
    for point in tree.points:
        inside = naive.clamped(point)
        if field.series(inside)[0, -1] == 0 < field.truncated(level).series(inside)[0, -1]:
            deeper = [field.truncated(n).weight(inside) for n in range(level + 1, field.max_depth)]
            assume(not any(deeper))
            assert (field.at(point) == field.truncated(level).at(point)).all()


def plane(normal, fine):
    """A plane of cells of depth 4, of depth ``fine`` where x < ½, whose leaves hold the mean position on it.

    Also points well within it, and two axes along it.
    """
    axes = np.linalg.svd(np.array([normal]))[2]
    random = np.random.default_rng(0)
    points = 0.5 + 0.013 * axes[0] + random.uniform(-0.45, 0.45, (50_000, 2)) @ axes[1:]
    depths = np.where(points[:, 0] < 0.5, fine, 4)
    places = np.floor(points * 2.0 ** depths[:, None]).astype(int)
    names = np.column_stack([depths, places]) @ 100 ** np.arange(4)[::-1]
    _, first, owner = np.unique(names, return_index=True, return_inverse=True)
    leaves = np.column_stack([depths, places])[first]
    means = np.stack([np.bincount(owner, points[:, axis]) for axis in range(3)], 1)
    means /= np.bincount(owner)[:, None]
    found = {(depth, tuple(place)): n for n, (depth, *place) in enumerate(leaves.tolist())}
    cells = naive.cells_of(found)
    values = np.array([means[found[cell[:2]]] if cell.is_leaf else np.zeros(3) for cell in cells])
    inner = points[(np.abs(points - 0.5) < 0.3).all(1)]
    return naive.Field(cells, values, "quadratic"), inner[:120], axes[1:]


@pytest.mark.parametrize(
    ("fine", "largest", "typical"),
    [
        pytest.param(4, 0.35, 0.065, id="one depth"),
        pytest.param(6, 0.35, 0.04, id="a change of depth by two"),
    ],
)
@pytest.mark.parametrize("normal", [(1, 1, 1), (1, 2, 3), (1, 0.2, 0.1), (1, 1, 0), (1, 0.05, 0.02)])
def test_a_ramp_along_an_oblique_plane_is_off_by_at_most_a_part_of_a_coarse_cell(
    normal, fine, largest, typical
):
    """Means of the ramp as leaf values, not fitted.

    Measured at worst, in coarse cells times the ramp's slope: 0.34 (root mean square 0.056) with one depth,
    where the plane cuts corners off cells whose neighbours are empty; 0.29 (0.035) where the depth changes.
    """
    field, points, axes = plane(normal, fine)
    errors = (np.array([field.at(point) for point in points]) - points) @ axes.T * 2**4
    assert np.abs(errors).max() <= largest
    assert np.sqrt((errors**2).mean()) <= typical
