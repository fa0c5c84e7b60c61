"""The mode of pictures and what is masked for it, a point and a patch at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


def difference(colors: Array, weights: Array, own: int) -> float:
    """Return how far the colour of a picture is from the mode of those with a weight; NaN for none."""
    seen = [i for i in range(len(weights)) if weights[i] > 0]
    if own not in seen or len(seen) < 3:
        return np.nan
    say = {i: (weights[i] / max(weights)) ** 0.125 for i in seen}

    def apart(i: int, j: int) -> float:
        return float(
            max(
                abs(255 * np.sqrt(max(a, 0)) - 255 * np.sqrt(max(b, 0)))
                for a, b in zip(colors[i], colors[j], strict=True)
            )
        )

    support = {
        i: say[i] + sum(say[j] / (1 + (apart(i, j) / 10) ** 2) ** 2 for j in seen if j != i) for i in seen
    }
    best = max(seen, key=lambda i: support[i])
    return apart(best, own) if support[best] >= 1.5 * say[best] else np.nan


def mask(differences: Array, far: float) -> Array:
    """Return 0 for patches near which most known ones are far off, and for their neighbours; else 1."""
    rows, columns = differences.shape
    unlike = np.zeros(differences.shape, bool)
    for i in range(rows):
        for j in range(columns):
            around = differences[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
            known = around[np.isfinite(around)]
            unlike[i, j] = known.size > 0 and (known > far).mean() > 0.5
    found = np.ones(differences.shape)
    for i in range(rows):
        for j in range(columns):
            if unlike[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2].any():
                found[i, j] = 0
    return found
