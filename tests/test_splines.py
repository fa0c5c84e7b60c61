from __future__ import annotations

import numpy as np
import pytest

from octex.field import splines
from tests import naive

FUNCTIONS = {
    "linear": (splines.linear_weights, splines.linear_slopes),
    "quadratic": (splines.quadratic_weights, splines.quadratic_slopes),
    "quartic": (splines.quartic_weights, splines.quartic_slopes),
}


@pytest.mark.parametrize("filter", FUNCTIONS)
def test_weights_and_slopes_are_those_of_the_b_spline(filter: str) -> None:
    weights, slopes = FUNCTIONS[filter]
    for t in np.linspace(0, 1, 33).tolist():
        np.testing.assert_allclose([weights(t), slopes(t)], naive.weights_of(filter, 1, t), atol=1e-15)


def test_the_outermost_weights_end_at_exactly_zero() -> None:
    for weights, _ in FUNCTIONS.values():
        assert weights(0.0)[-1] == weights(1.0)[0] == 0


@pytest.mark.parametrize("filter", ["quadratic", "quartic"])
def test_refined_cells_carry_the_same_spline(filter: str) -> None:
    weights, _ = FUNCTIONS[filter]
    near, middle, far = splines.refinement(filter == "quartic")
    reach = 2 if filter == "quartic" else 1
    values = np.random.default_rng(3).random(9)
    fine = {}
    for cell in range(2, 16):
        parent, side = cell >> 1, 2 * (cell & 1) - 1
        fine[cell] = near * values[parent + side] + middle * values[parent] + far * values[parent - side]
    for x in np.linspace(4, 5, 17)[:-1].tolist():
        coarse = weights(x - 4) @ values[4 - reach : 5 + reach]
        cell = int(2 * x)
        refined = [fine[cell + n] for n in range(-reach, reach + 1)]
        assert weights(2 * x - cell) @ np.array(refined) == pytest.approx(coarse, abs=1e-15)
