"""What the field promises, shown on the slow reference of tests/oracles/naive.py."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest

from tests.oracles import naive

SMOOTH = {"quadratic": 1, "quartic": 3}  # filters: the highest derivative that is continuous


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
