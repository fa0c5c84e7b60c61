"""B-splines on cells: the weights of the cells around a point, and how a spline's cells are split in two.

``t`` is the position within the cell in the middle, 0 at its lower face and 1 at its upper one. Weights are
those of the cells from the lowest to the highest; slopes are their derivatives by t.
"""

from __future__ import annotations

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
    """Slopes of ``linear_weights``: in the cell's centre, those above it."""
    if t < 0.5:
        return -1.0, 1.0, 0.0
    return 0.0, -1.0, 1.0


@inlined
def quadratic_weights(t: float) -> Three:
    """Weights of the quadratic B-spline."""
    return 0.5 * (1.0 - t) * (1.0 - t), 0.75 - (t - 0.5) * (t - 0.5), 0.5 * t * t


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
def refinement(quartic: bool) -> Three:
    """Coefficients that refine a cell, along an axis, from its parent and the cells on both sides of that.

    First that of the parent's neighbour on the cell's side, then the parent's, then the other neighbour's.
    """
    if quartic:
        return 0.3125, 0.625, 0.0625
    return 0.25, 0.75, 0.0
