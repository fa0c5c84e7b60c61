"""Pictures that overlap made to agree: a gain for each picture and component."""

from __future__ import annotations

import numpy as np

from octex.arrays import Bools, Float32s, Float64s
from octex.painting.projected import Projected
from octex.source.surface import Surface

#: Points of the surface that pictures are compared at.
_POINTS = 30_000
#: Over how many pixels they are read there: what is a pixel out of place matters less.
_WIDTH = 6.0
#: Values that tell of no gain: too dark, or cut off.
_DARKEST, _LIGHTEST = 0.004, 0.97
#: Rounds of least squares, and from what difference of logarithms on a pair counts for less each time.
_ROUNDS, _FAR = 6, 0.05


def balanced(source: Projected, surface: Surface) -> Float32s:
    """Return gains (pictures, 3), by which pictures agree best where more than one sees the surface.

    Least squares of the differences of logarithms, those that are far off weighing less (Huber). The gains'
    logarithms sum to zero, so that the whole stays as light as it is; pictures that overlap no other keep 1.
    """
    samples = surface.scatter(_POINTS)
    widths = source.widths(samples.triangles, samples.barycentric)
    widths = np.where(np.isfinite(widths), widths * np.float32(_WIDTH), np.float32(0))
    paint, weights = source.each(samples.triangles, samples.barycentric, widths)
    gains = np.ones((len(paint), 3), np.float32)
    for component in range(3):
        values = paint[:, :, component].astype(np.float64)
        usable = (weights > 0) & (values > _DARKEST) & (values < _LIGHTEST)
        logs = np.log(np.where(usable, values, 1.0))
        gains[:, component] = np.exp(_solved(logs, usable))
    return gains


def _solved(logs: Float64s, usable: Bools) -> Float64s:
    """Return what to add to each row (pictures, points) so that rows agree where both are usable."""
    count = len(logs)
    found = np.zeros(count)
    pairs = [(i, j) for i in range(count) for j in range(i) if (usable[i] & usable[j]).any()]
    apart = {(i, j): (logs[i] - logs[j])[usable[i] & usable[j]] for i, j in pairs}
    for _ in range(_ROUNDS):
        matrix, right = np.zeros((count, count)), np.zeros(count)
        for i, j in pairs:
            distance = np.abs(apart[i, j] + found[i] - found[j])
            weights = np.minimum(1.0, _FAR / np.maximum(distance, 1e-12))
            total, moment = weights.sum(), (weights * apart[i, j]).sum()
            matrix[i, i] += total
            matrix[j, j] += total
            matrix[i, j] -= total
            matrix[j, i] -= total
            right[i] -= moment
            right[j] += moment
        found = np.linalg.pinv(matrix, hermitian=True) @ right
    return found
