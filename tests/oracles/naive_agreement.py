"""The mode of images and what is masked for it, a point and a patch at a time."""

from __future__ import annotations

from heapq import heappop, heappush
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


def mode(colors: Array, weights: Array, own: int) -> Array:
    """Return the codes of the mode of the colours with a weight; NaN for none, or if `own` has none."""
    none = np.full(3, np.nan)
    seen = [i for i in range(len(weights)) if weights[i] > 0]
    if own not in seen or len(seen) < 3:
        return none
    say = {i: (weights[i] / max(weights)) ** 0.5 for i in seen}
    codes = 255 * np.sqrt(np.maximum(colors, 0))

    def apart(i: int, j: int) -> float:
        return float(max(abs(codes[i] - codes[j])))

    support = {
        i: say[i] + sum(say[j] / (1 + (apart(i, j) / 10) ** 2) ** 2 for j in seen if j != i) for i in seen
    }
    best = max(seen, key=lambda i: support[i])
    return np.asarray(codes[best]) if support[best] >= 1.5 * say[best] else none


def off(codes: Array, modes: Array) -> Array:
    """Return how far codes are from the mode of their patch and from lines between it and those around."""
    rows, columns, _ = modes.shape
    found = np.full((rows, columns), np.nan)
    for i in range(rows):
        for j in range(columns):
            own, code = modes[i, j].astype(np.float64), codes[i, j].astype(np.float64)
            if np.isfinite(own).all():
                apart = [abs(code - own).max()]
                for other in near(modes, i, j, 1).reshape(-1, 3).astype(np.float64):
                    if np.isfinite(other).all() and (other != own).any():
                        part = np.dot(code - own, other - own) / np.linalg.norm(other - own) ** 2
                        nearest = own if part < 0 else other if part > 1 else own + part * (other - own)
                        apart.append(abs(code - nearest).max())
                found[i, j] = min(apart)
    return found


def near(values: Array, i: int, j: int, reach: int) -> Array:
    """Return the part of an array around an entry."""
    return values[max(i - reach, 0) : i + reach + 1, max(j - reach, 0) : j + reach + 1]


def filled(values: Array, looks: Array, step: float) -> Array:
    """Return values with that of the nearest known patch where they are NaN (Dijkstra 1959).

    A step to one of eight neighbours costs ``step`` and the largest difference of their looks.
    """
    found = values.copy()
    queue = [(0.0, i, j, values[i, j]) for i, j in np.argwhere(np.isfinite(values)).tolist()]
    done = set()
    while queue:
        cost, i, j, value = heappop(queue)
        if (i, j) in done:
            continue
        done.add((i, j))
        found[i, j] = value
        for row, column in np.ndindex(values.shape):
            if max(abs(row - i), abs(column - j)) == 1:
                edge = float(abs(looks[row, column] - looks[i, j]).max())
                heappush(queue, (cost + edge + step, row, column, value))
    return found


def mask(differences: Array, far: float) -> Array:
    """Return 0 for patches near which most are far off, in groups that one is certain of, and beside; else 1.

    All are known.
    """
    is_far = differences > far
    entries = list(np.ndindex(differences.shape))
    unlike = {(i, j) for i, j in entries if near(is_far, i, j, 1).mean() > 0.5}
    certain = [
        (i, j) for i, j in unlike if near(is_far, i, j, 2).sum() >= 8 and near(is_far, i, j, 2).mean() > 0.5
    ]
    group = set(certain)
    while certain:
        i, j = certain.pop()
        beside = {(i + k, j + m) for k in (-1, 0, 1) for m in (-1, 0, 1)} & unlike
        certain += beside - group
        group |= beside
    found = np.ones(differences.shape)
    for i, j in group:
        near(found, i, j, 1)[:] = 0
    return found
