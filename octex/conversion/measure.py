"""Measures how far values are apart in codes, at points and all over patches of the surface.

Errors are in 8-bit codes of encoded values: light on sRGB's curve, and above 1 by ratio, however it is
stored; fractions in 1/255; each component of a direction in 1/127.5. Errors under an alpha weigh by it.
Directions are compared as stored, and as unit vectors, as lookups return them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int64s
from octex.channels import ChannelFormat, linear_to_srgb
from octex.editing.split import SLOPE
from octex.jit import chosen, inlined, mask_bits
from octex.jit.vectors import eight, eight_at, lanes

#: How much larger errors may be between samples than at them, in codes. In random trials (60,000 points each,
#: edges, dots and light up to 20) no error was larger.
BETWEEN = 1.0
_LIGHT, _FRACTION, _DIRECTION = 0, 1, 2
_KINDS = {"srgb": _LIGHT, "linear": _LIGHT, "data": _FRACTION, "direction": _DIRECTION}
#: sRGB's curve over the square root of light: linear interpolation errs by 3·10⁻⁴ codes at most.
_STEPS = 4096
_CURVE = 255.0 * linear_to_srgb((np.arange(_STEPS + 2) / _STEPS) ** 2)
#: The slope of sRGB's curve at 0, and its upper bounds from the light in the first column on.
_STEEPEST = np.float32(12.93)
_STEEP = np.array([[0.01, 6.5], [0.05, 2.55], [0.2, 1.14]], np.float32)


class ErrorColumns(NamedTuple):
    """How the errors of components are measured, channel after channel."""

    kinds: Int64s  # (components,)
    vectors: Int64s  # (components,)   the first component of its direction, or −1
    alpha: int  # the component that weighs all others, or −1
    curve: Float64s

    @classmethod
    def of(cls, channels: Sequence[ChannelFormat]) -> ErrorColumns:
        """List the components of channels."""
        kinds: list[int] = []
        vectors: list[int] = []
        alpha = -1
        for form in channels:
            alpha = len(kinds) if form.name == "alpha" else alpha
            vectors += [len(kinds) if form.space == "direction" else -1] * form.components
            kinds += [_KINDS[form.space]] * form.components
        return cls(np.array(kinds, np.int64), np.array(vectors, np.int64), alpha, _CURVE)


@inlined
def _code(value: float, kind: int, curve: Float64s) -> float:
    if kind == _FRACTION:
        return 255.0 * value
    if kind == _DIRECTION:
        return 127.5 * value
    if value > 1.0:
        return 255.0 + SLOPE * math.log(value)
    steps = math.sqrt(max(value, 0.0)) * _STEPS
    step = int(steps)
    low, high = float(curve[step]), float(curve[step + 1])
    return low + (steps - step) * (high - low)


@inlined
def _code_between(low: float, high: float, kind: int, curve: Float64s) -> float:
    """Return how many codes ``high`` lies above ``low``."""
    if low == high:
        return 0.0
    return _code(high, kind, curve) - _code(low, kind, curve)


@inlined
def subtract(
    values: Float32s, columns: ErrorColumns, component: int, count: int, differences: Float64s
) -> None:
    """Write how many codes a field lies above the full tree's at points.

    ``values`` (2, components, points) are those of both fields. ``differences`` (2, points) become those of
    the component, and of unit vectors, 0 for a component of no direction.
    """
    kind, vector = columns.kinds[component], columns.vectors[component]
    is_covered = columns.alpha >= 0 and component != columns.alpha
    end = vector
    while vector >= 0 and end < columns.kinds.size and columns.vectors[end] == vector:
        end += 1
    for point in range(count):
        coverage = float(values[1, columns.alpha, point]) if is_covered else 1.0
        value, wanted = float(values[0, component, point]), float(values[1, component, point])
        differences[0, point] = coverage * _code_between(wanted, value, kind, columns.curve)
        differences[1, point] = 0.0
        if vector >= 0:
            one, other = 0.0, 0.0
            for each in range(vector, end):
                one += float(values[0, each, point]) ** 2
                other += float(values[1, each, point]) ** 2
            value = value / math.sqrt(one) if one > 0.0 else 0.0
            wanted = wanted / math.sqrt(other) if other > 0.0 else 0.0
            differences[1, point] = coverage * _code_between(wanted, value, kind, columns.curve)


@inlined
def are_near(differences: Float64s, count: int, most: float) -> bool:
    """Say whether all differences at the first ``count`` points are ``most`` codes at most."""
    near = True
    for column in range(differences.shape[0]):
        for point in range(count):
            near &= abs(differences[column, point]) <= most  # NaN is not near
    return near


@inlined
def are_near_between(differences: Float64s, count: int, most: float) -> bool:
    """Say whether differences are ``most`` at most all over a patch of ``count`` points: see `lay_out`.

    On each triangle the difference is taken for the quadratic polynomial through its six points, which lies
    between its Bézier coefficients.
    """
    corners = count // 3
    for column in range(differences.shape[0]):
        middle = differences[column, 0]
        near = abs(middle) <= most
        for corner in range(1, 1 + corners):
            at_corner = differences[column, corner]
            after = differences[column, corner + 1 if corner < corners else 1]
            near &= abs(at_corner) <= most
            near &= abs(2.0 * differences[column, corner + corners] - 0.5 * (at_corner + middle)) <= most
            near &= abs(2.0 * differences[column, corner + 2 * corners] - 0.5 * (at_corner + after)) <= most
        if not near:
            return False
    return True


@inlined
def are_surely_near(values: Float32s, columns: ErrorColumns, component: int, count: int, most: float) -> bool:
    """Bound the error of a component of no direction: False says nothing.

    Of all pairs of lights with one difference, the darkest pair is farthest apart in codes. Rows of
    ``values`` are filled up to a multiple of eight points.
    """
    zero, room = eight(0.0), values.shape[2]
    one, other = component * room, (columns.kinds.size + component) * room
    kind = columns.kinds[component]
    low, apart, invalid = eight(np.inf), zero, zero
    for first in range(0, count, 8):
        value, wanted = eight_at(values, one + first), eight_at(values, other + first)
        difference = value - wanted
        difference = chosen(difference > zero, difference, zero - difference)
        apart = chosen(difference > apart, difference, apart)
        invalid = invalid + difference * zero  # NaN where one is NaN
        smaller = chosen(value < wanted, value, wanted)
        low = chosen(smaller < low, smaller, low)
    slopes = eight(1.0)
    if kind == _LIGHT:
        slopes = chosen(low > eight(_STEEP[0, 0]), eight(_STEEP[0, 1]), eight(_STEEPEST))
        slopes = chosen(low > eight(_STEEP[1, 0]), eight(_STEEP[1, 1]), slopes)
        slopes = chosen(low > eight(_STEEP[2, 0]), eight(_STEEP[2, 1]), slopes)
    if mask_bits(apart * slopes + invalid <= eight(most / 255.0)) == np.uint64(255):
        return True
    darkest, largest = np.float32(np.inf), np.float32(0)
    for each in lanes(low):
        darkest = min(darkest, each)
    for each in lanes(apart):
        largest = max(largest, each)
    for each in lanes(invalid):
        largest += each
    dark, light = float(darkest), float(darkest + largest)
    return _code_between(dark, light, kind, columns.curve) <= most
