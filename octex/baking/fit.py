"""Texels fitted to how maps are read: bilinearly."""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s, Float64s, Uint8s, Uint16s
from octex.channels import srgb8_code, unit_code
from octex.jit import inlined, kernel

#: What texels lack of the nearest map that is linear in between, of their second differences along each axis,
#: where they are the values at their middles; and what means over texels lack beyond that. Of a parabola,
#: exactly.
_LACKING, _OF_MEANS = 1.0 / 12.0, 1.0 / 24.0


def lacking(supersample: int, blur: float) -> float:
    """Return the part of the second differences that texels lack.

    They are means of so many lookups along each side, of which each shows what variance a mean over its part
    of the texel has, times ``blur``, 0 … 1.
    """
    part = 1.0 / supersample**2
    return _LACKING + _OF_MEANS * (1.0 - part + part * blur)


@inlined
def is_fitted(areas: Float32s, row: int, column: int) -> bool:
    """Say whether a texel is fitted: those at the map's rim stay, and those beside one of area 0."""
    if not (0 < row < areas.shape[0] - 1 and 0 < column < areas.shape[1] - 1):
        return False
    least = min(areas[row, column - 1], min(areas[row, column + 1], areas[row - 1, column]))
    return bool(min(least, min(areas[row + 1, column], areas[row, column])) > np.float32(0.0))


@inlined
def fitted_at(
    values: Float32s, row: int, column: int, lane: int, part: float, most: float, fits: bool
) -> np.float32:
    """Return a lane of a texel of maps (height, width, lanes), fitted if it ``fits``, within ± ``most``."""
    here = values[row, column, lane]
    if fits:
        across = values[row, column - 1, lane] + values[row, column + 1, lane]
        down = values[row - 1, column, lane] + values[row + 1, column, lane]
        here -= np.float32(part) * (across + down - np.float32(4.0) * here)
    return np.float32(min(max(here, np.float32(-most)), np.float32(most)))


@kernel
def fit_rows(
    values: Float32s, areas: Float32s, part: float, first: int, lane: int, most: float, fitted: Float64s
) -> None:
    """Write rows of a map (height, width, lanes), from ``first`` on, fitted to bilinear reading.

    ``values`` lack ``part`` of their second differences (`lacking`). Of their lanes those from ``lane`` on
    are written to ``fitted`` (rows, width, components), within −``most`` … ``most``.
    """
    for row in range(fitted.shape[0]):
        for column in range(fitted.shape[1]):
            fits = is_fitted(areas, first + row, column)
            for k in range(fitted.shape[2]):
                fitted[row, column, k] = fitted_at(values, first + row, column, lane + k, part, most, fits)


@kernel
def fit_codes(
    values: Float32s, areas: Float32s, part: float, first: int, lanes: tuple[int, int, int], most: float,
    is_srgb: bool, half: float, guesses: Uint8s, thresholds: Float64s, texels: Uint16s,
) -> None:  # fmt: skip
    """Write rows like `fit_rows`, divided by ``most``, as codes of 8 bits to texels of 16 (rows, width, 4).

    ``lanes`` are the first of the values, how many, and the first of the texels. Colours become sRGB, by
    `channels.srgb8_encoder`; what goes from −1 to 1 has ``half`` 0.5, numbers from 0 to 1 have 0.
    """
    lane, count, to = lanes
    scale, over = 1.0 - half, 1.0 / most
    for row in range(texels.shape[0]):
        for column in range(texels.shape[1]):
            fits = is_fitted(areas, first + row, column)
            for k in range(count):
                value = np.float64(fitted_at(values, first + row, column, lane + k, part, most, fits)) * over
                if is_srgb:
                    code = srgb8_code(value, guesses, thresholds)
                else:
                    code = int(unit_code(value, scale, half, 255.0))
                texels[row, column, to + k] = np.uint16(257 * code)
