"""B-splines on cells: the weights of the cells around a point, and the refinement of a spline's cells.

``t`` is the position within the middle cell, 0 at its lower face and 1 at its upper one. Weights are those of
the cells from the lowest to the highest; slopes are their derivatives by t.
"""

from __future__ import annotations

import numpy as np

from octex.jit import inlined

#: How a texture is looked up. Kernels know them by their index.
FILTERS = ("nearest", "linear", "quadratic", "quartic")
NEAREST, LINEAR, QUADRATIC, QUARTIC = range(4)

Three = tuple[float, float, float]
Five = tuple[float, float, float, float, float]


@inlined
def linear_weights(t: float) -> Three:
    """Weights of the linear interpolation between cell centres."""
    if t < 0.5:
        return 0.5 - t, 0.5 + t, 0.0
    return 0.0, 1.5 - t, t - 0.5


@inlined
def linear_slopes(t: float) -> Three:
    """Slopes of ``linear_weights``; in the cell's centre the upper ones."""
    if t < 0.5:
        return -1.0, 1.0, 0.0
    return 0.0, -1.0, 1.0


@inlined
def quadratic_weights(t: float) -> Three:
    """Weights of the quadratic B-spline."""
    return 0.5 * (1.0 - t) * (1.0 - t), 0.75 - (t - 0.5) * (t - 0.5), 0.5 * t * t


@inlined
def single_quadratic_weights(t: float | np.float32) -> tuple[np.float32, np.float32, np.float32]:
    """`quadratic_weights` in single precision; the outer ones have full precision."""
    part, half, one = np.float32(t), np.float32(0.5), np.float32(1.0)
    low, high = half * (one - part) * (one - part), half * part * part
    return low, one - low - high, high


@inlined
def single_quadratic_slopes(t: float) -> tuple[np.float32, np.float32, np.float32]:
    """`quadratic_slopes` in single precision."""
    part, one, two = np.float32(t), np.float32(1.0), np.float32(2.0)
    return part - one, one - two * part, part


@inlined
def quadratic_slopes(t: float) -> Three:
    """Slopes of ``quadratic_weights``."""
    return t - 1.0, 1.0 - 2.0 * t, t


@inlined
def _quartic_tail(t: float) -> float:
    return t * t * t * t / 24.0


@inlined
def _quartic_flank(t: float) -> float:
    return (1.0 + t * (4.0 + t * (6.0 + t * (4.0 - 4.0 * t)))) / 24.0


@inlined
def quartic_weights(t: float) -> Five:
    """Weights of the quartic B-spline."""
    s = 1.0 - t
    middle = (11.0 + t * s * (12.0 + 6.0 * t * s)) / 24.0
    return _quartic_tail(s), _quartic_flank(s), middle, _quartic_flank(t), _quartic_tail(t)


@inlined
def _quartic_flank_slope(t: float) -> float:
    return (1.0 + t * (3.0 + t * (3.0 - 4.0 * t))) / 6.0


@inlined
def quartic_slopes(t: float) -> Five:
    """Slopes of ``quartic_weights``."""
    s = 1.0 - t
    middle = 0.5 * (s - t) * (1.0 + t * s)
    return -s * s * s / 6.0, -_quartic_flank_slope(s), middle, _quartic_flank_slope(t), t * t * t / 6.0


@inlined
def refine(quartic: bool, a: float, b: float, c: float, d: float, e: float) -> Five:
    """Refine the cells around one, lowest first: returns the finer cells around its lower half.

    For the upper half, reverse arguments and results. Without ``quartic`` there are three of each.
    """
    if quartic:
        return (
            (5.0 * a + 10.0 * b + c) / 16.0,
            (a + 10.0 * b + 5.0 * c) / 16.0,
            (5.0 * b + 10.0 * c + d) / 16.0,
            (b + 10.0 * c + 5.0 * d) / 16.0,
            (5.0 * c + 10.0 * d + e) / 16.0,
        )
    return 0.75 * a + 0.25 * b, 0.25 * a + 0.75 * b, 0.75 * b + 0.25 * c, 0.0, 0.0


@inlined
def send_up(quartic: bool, a: float, b: float, c: float, d: float, e: float) -> Five:
    """Send weights of finer cells up to those that they are refined from: the transpose of ``refine``."""
    if quartic:
        return (
            (5.0 * a + b) / 16.0,
            (10.0 * (a + b) + 5.0 * c + d) / 16.0,
            (a + 5.0 * b + 10.0 * (c + d) + 5.0 * e) / 16.0,
            (c + 5.0 * d + 10.0 * e) / 16.0,
            e / 16.0,
        )
    return 0.75 * a + 0.25 * b, 0.25 * a + 0.75 * (b + c), 0.25 * c, 0.0, 0.0
