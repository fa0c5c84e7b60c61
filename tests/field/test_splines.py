import numpy as np
import pytest

from octex.field import splines
from octex.jit import kernel
from tests.oracles import naive


def called(function):
    """Return a kernel that calls what only kernels can call."""

    @kernel
    def call(*arguments):
        return function(*arguments)

    return call


FUNCTIONS = {
    "linear": (called(splines.linear_weights), called(splines.linear_slopes)),
    "quadratic": (called(splines.quadratic_weights), called(splines.quadratic_slopes)),
    "quartic": (called(splines.quartic_weights), called(splines.quartic_slopes)),
}
refine, send_up = called(splines.refine), called(splines.send_up)


@pytest.mark.parametrize("filter", FUNCTIONS)
def test_weights_and_slopes_are_those_of_the_b_spline(filter):
    weights, slopes = FUNCTIONS[filter]
    for t in np.linspace(0, 1, 33).tolist():
        np.testing.assert_allclose([weights(t), slopes(t)], naive.weights_of(filter, 1, t), atol=1e-15)


def test_the_outermost_weights_end_at_exactly_zero():
    for weights, _ in FUNCTIONS.values():
        assert weights(0.0)[-1] == weights(1.0)[0] == 0


@pytest.mark.parametrize("upper", [0, 1])
@pytest.mark.parametrize("filter", ["quadratic", "quartic"])
def test_refined_cells_carry_the_same_spline(filter, upper):
    weights, _ = FUNCTIONS[filter]
    cells = 5 if filter == "quartic" else 3
    around = np.pad(np.random.default_rng(3).random(cells), (0, 5 - cells))
    way = -1 if upper else 1
    refined = refine(cells == 5, *around[:cells][::way], *around[cells:])[:cells][::way]
    for t in np.linspace(0, 1, 17).tolist():
        assert np.dot(weights(t), refined) == pytest.approx(np.dot(weights((t + upper) / 2), around[:cells]))


@pytest.mark.parametrize("quartic", [False, True])
def test_what_is_sent_up_weighs_as_what_is_refined(quartic):
    units = np.eye(5)
    down = np.array([refine(quartic, *unit) for unit in units])
    up = np.array([send_up(quartic, *unit) for unit in units])
    np.testing.assert_array_equal(down, up.T)
