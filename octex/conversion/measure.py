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

    Both have the values (n, components) of ``channels`` side by side. Light is linear. Directions count both
    as they are and as unit vectors, as lookups give them.
    """
    source = np.ascontiguousarray(source, np.float32)
    ends = np.cumsum([0, *(form.components for form in channels)]).tolist()
    firsts = dict(zip((form.name for form in channels), ends, strict=False))
    exceeds = np.zeros(len(source), np.bool_)
    for form in channels:
        alpha = firsts.get("alpha", -1) if form.name != "alpha" else -1
        columns = firsts[form.name], firsts[form.name] + form.components
        _mark(found, source, *columns, alpha, _KINDS[form.space], most, _CURVE, exceeds)
        if form.space == "direction":
            units, wanted = _with_units(found, *columns), _with_units(source, *columns)
            _mark(units, wanted, *columns, alpha, _DIRECTION, most, _CURVE, exceeds)
    return exceeds


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
def _mark(
    found: npt.NDArray[np.float32],
    source: npt.NDArray[np.float32],
    first: int,
    end: int,
    alpha: int,
    kind: int,
    most: float,
    curve: npt.NDArray[np.float64],
    exceeds: npt.NDArray[np.bool_],
) -> None:
    for n in range(found.shape[0]):
        coverage = 1.0 if alpha < 0 else np.float64(source[n, alpha])
        for component in range(first, end):
            apart = _code(np.float64(found[n, component]), kind, curve) - _code(
                np.float64(source[n, component]), kind, curve
            )
            if not abs(apart) * coverage <= most:  # what is not a number is far from anything
                exceeds[n] = True
                break
