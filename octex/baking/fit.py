"""Texels fitted to how maps are read: bilinearly."""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s
from octex.jit import kernel

#: What values at the middles of texels lack of the nearest map that is linear in between, of their second
#: differences along each axis: of a parabola, exactly.
_LACKING = 1.0 / 12.0


def sharpen(values: Float32s, areas: Float32s) -> None:
    """Fit a map (height, width, components) of values at the middles of texels to bilinear reading, in place.

    Texels stay that lie at its rim, or beside one of area 0; none leaves the range that values had.
    """
    _sharpen(values, areas, values.min(), values.max(), values[0].copy(), values[0].copy())


@kernel
def _sharpen(
    values: Float32s, areas: Float32s, least: np.float32, most: np.float32, above: Float32s, here: Float32s
) -> None:
    """``above`` and ``here``, (width, components), are room for rows as they were."""
    height, width, components = values.shape
    part, four = np.float32(_LACKING), np.float32(4.0)
    for row in range(1, height - 1):
        here[:] = values[row]
        for x in range(1, width - 1):
            if min(areas[row, x - 1], areas[row, x + 1]) <= 0.0 or areas[row, x] <= 0.0:
                continue
            if min(areas[row - 1, x], areas[row + 1, x]) <= 0.0:
                continue
            for k in range(components):
                around = here[x - 1, k] + here[x + 1, k] + above[x, k] + values[row + 1, x, k]
                fitted = here[x, k] - part * (around - four * here[x, k])
                values[row, x, k] = min(max(fitted, least), most)
        above[:] = here
