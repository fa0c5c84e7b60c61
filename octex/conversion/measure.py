"""How far values are apart, in 8-bit codes of what is encoded.

Light is measured on sRGB's curve and above 1 by ratio, whatever it is stored as; fractions in 1/255, each
component of a direction in 1/127.5. What an alpha covers in part counts by as much.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from octex.channels import ChannelFormat, linear_to_srgb
from octex.jit import inlined, kernel
from octex.texture.blend import NO_GRADIENTS, make_unit

_LIGHT, _FRACTION, _DIRECTION = 0, 1, 2
_KINDS = {"srgb": _LIGHT, "linear": _LIGHT, "data": _FRACTION, "direction": _DIRECTION}
#: sRGB's curve over the square root of light: straight lines between its points are within 2·10⁻⁴ codes.
_STEPS = 1024
_CURVE = 255.0 * linear_to_srgb((np.arange(_STEPS + 2) / _STEPS) ** 2)
_SLOPE = 255.0 * 1.055 / 2.4  # of the curve at 1


def exceeding(
    found: npt.NDArray[np.float32],
    source: npt.NDArray[np.floating],
    channels: Sequence[ChannelFormat],
    most: float,
) -> npt.NDArray[np.bool_]:
    """Say of each point whether a component of any channel differs by more than ``most`` codes.

    Both are as ``apart`` takes them.
    """
    near: npt.NDArray[np.bool_] = np.abs(apart(found, source, channels)) <= most
    far: npt.NDArray[np.bool_] = ~np.all(near, axis=1)  # what is not a number is far from anything
    return far


def apart(
    found: npt.NDArray[np.float32], source: npt.NDArray[np.floating], channels: Sequence[ChannelFormat]
) -> npt.NDArray[np.float32]:
    """Return how many codes each component of points lies above the source (n, components).

    Both have the values (n, components) of ``channels`` side by side. Light is linear. Directions count both
    as they are and as unit vectors, as lookups give them: these come last.
    """
    source = np.ascontiguousarray(source, np.float32)
    ends = np.cumsum([0, *(form.components for form in channels)]).tolist()
    firsts = dict(zip((form.name for form in channels), ends, strict=False))
    directions = [form for form in channels if form.space == "direction"]
    differences = np.empty((len(source), ends[-1] + sum(form.components for form in directions)), np.float32)
    last = ends[-1]
    for form in channels:
        alpha = firsts.get("alpha", -1) if form.name != "alpha" else -1
        first, end = firsts[form.name], firsts[form.name] + form.components
        _subtract(found, source, first, end, alpha, _KINDS[form.space], _CURVE, first, differences)
        if form.space == "direction":
            units, wanted = _with_units(found, first, end), _with_units(source, first, end)
            _subtract(units, wanted, first, end, alpha, _DIRECTION, _CURVE, last, differences)
            last += form.components
    return differences


def _with_units(values: npt.NDArray[np.float32], first: int, end: int) -> npt.NDArray[np.float32]:
    """Return values whose columns from ``first`` up to ``end`` are unit vectors."""
    vectors = values[:, first:end].copy()
    make_unit(vectors, NO_GRADIENTS)
    values = values.copy()
    values[:, first:end] = vectors
    return values


@inlined
def _code(value: float, kind: int, curve: npt.NDArray[np.float64]) -> float:
    if kind == _FRACTION:
        return 255.0 * value
    if kind == _DIRECTION:
        return 127.5 * value
    if value > 1.0:
        return 255.0 + _SLOPE * math.log(value)
    place = math.sqrt(max(value, 0.0)) * _STEPS
    step = int(place)
    low, high = float(curve[step]), float(curve[step + 1])
    return low + (place - step) * (high - low)


@kernel
def _subtract(
    found: npt.NDArray[np.float32],
    source: npt.NDArray[np.float32],
    first: int,
    end: int,
    alpha: int,
    kind: int,
    curve: npt.NDArray[np.float64],
    column: int,
    differences: npt.NDArray[np.float32],
) -> None:
    for n in range(found.shape[0]):
        coverage = 1.0 if alpha < 0 else np.float64(source[n, alpha])
        for component in range(first, end):
            differences[n, column + component - first] = coverage * (
                _code(np.float64(found[n, component]), kind, curve)
                - _code(np.float64(source[n, component]), kind, curve)
            )


@kernel
def exceeding_between(
    differences: npt.NDArray[np.float32], firsts: npt.NDArray[np.int64], most: float
) -> npt.NDArray[np.bool_]:
    """Say of each patch of points whether what is between them may differ by more than ``most``.

    ``differences`` (n, columns) are those at the points of ``Samples.patches``, which begin at ``firsts``.
    Between them they are taken for the quadratic polynomial on each triangle that has them at its six points;
    it lies between its Bézier coefficients.
    """
    far = np.zeros(firsts.size - 1, np.bool_)
    for patch in range(far.size):
        first, end = firsts[patch], firsts[patch + 1]
        for column in range(differences.shape[1]):
            middle = differences[first, column]
            near = abs(middle) <= most
            for corner in range(first + 1, end, 3):
                here = differences[corner, column]
                after = differences[corner + 3 if corner + 3 < end else first + 1, column]
                near &= abs(here) <= most
                near &= abs(2.0 * differences[corner + 1, column] - 0.5 * (here + middle)) <= most
                near &= abs(2.0 * differences[corner + 2, column] - 0.5 * (here + after)) <= most
            far[patch] |= not near  # what is not a number is far from anything
    return far
