"""Texels fitted to how maps are read: bilinearly."""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s, Float64s
from octex.jit import kernel

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


@kernel
def fit_rows(
    values: Float32s, areas: Float32s, part: float, first: int, lane: int, most: float, fitted: Float64s
) -> None:
    """Write rows of a map (height, width, lanes), from ``first`` on, fitted to bilinear reading.

    ``values`` lack ``part`` of their second differences (`lacking`). Of their lanes those from ``lane`` on
    are written to ``fitted`` (rows, width, components), within −``most`` … ``most``. Texels stay that lie at
    the map's rim, or beside one of area 0.
    """
    height, width = areas.shape
    for row in range(first, first + fitted.shape[0]):
        is_inside = 0 < row < height - 1
        for x in range(width):
            is_fitted = is_inside and 0 < x < width - 1
            if is_fitted:
                least = min(areas[row, x - 1], areas[row, x + 1], areas[row - 1, x], areas[row + 1, x])
                is_fitted = min(least, areas[row, x]) > np.float32(0.0)
            for k in range(fitted.shape[2]):
                here = values[row, x, lane + k]
                if is_fitted:
                    left, right = values[row, x - 1, lane + k], values[row, x + 1, lane + k]
                    above, below = values[row - 1, x, lane + k], values[row + 1, x, lane + k]
                    bend = (left + right) + (above + below) - np.float32(4.0) * here
                    here -= np.float32(part) * bend
                fitted[row - first, x, k] = min(max(here, np.float32(-most)), np.float32(most))
