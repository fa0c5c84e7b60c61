"""Robust statistics of values that several images have at the same points."""

from __future__ import annotations

import numpy as np

from octex.arrays import Float64s
from octex.jit import kernel

#: Residuals beyond this multiple of their scale weigh less; the scale is the median residual.
_SCALES = 2.0
#: Images of a point that are compared: the time grows with their square.
_MOST = 16


def few_at(weights: Float64s) -> Float64s:
    """Return weights (images, n) with zeros for all but a few images of each point, chosen at random."""
    if len(weights) <= _MOST:
        return weights
    ranks = np.where(weights > 0, np.random.default_rng(0).random(weights.shape), 0.0)
    few: Float64s = np.where(ranks < np.partition(ranks, -_MOST, axis=0)[-_MOST], 0.0, weights)
    return few


def consensus(values: Float64s, weights: Float64s) -> Float64s:
    """Return the weighted mean of each point (n,) over images (images, n); 0 without any weight."""
    totals = weights.sum(axis=0)
    mean: Float64s = (weights * values).sum(axis=0) / np.maximum(totals, 1e-300)
    return mean


def robust_weights(values: Float64s, weights: Float64s, least: float) -> tuple[Float64s, float]:
    """Return weights (images, n) that fall with the distance from the median, and their scale.

    (Geman & McClure 1985.)
    """
    middle = medians(values, weights)
    several = (weights > 0).sum(axis=0) > 1
    far = np.abs(values - middle)
    counted = (weights > 0) & several
    scale = max(least, _SCALES * float(np.median(far[counted])) if counted.any() else least)
    robust = np.where(counted, weights / (1.0 + (far / scale) ** 2) ** 2, 0.0)
    return robust, scale


@kernel
def medians(values: Float64s, weights: Float64s) -> Float64s:
    """Return the weighted median of each point (n,), two values' mean if between; 0 if none."""
    images, count = values.shape
    middles = np.zeros(count)
    ranked, weight_of = np.empty(images), np.empty(images)
    for n in range(count):
        seen, total = 0, 0.0
        for i in range(images):
            weight, value = weights[i, n], values[i, n]
            if not weight > 0.0:
                continue
            at = seen
            while at > 0 and ranked[at - 1] > value:
                ranked[at], weight_of[at] = ranked[at - 1], weight_of[at - 1]
                at -= 1
            ranked[at], weight_of[at] = value, weight
            seen += 1
            total += weight
        part, half, low = 0.0, 0.5 * total, -1
        for at in range(seen):
            part += weight_of[at]
            if low < 0 and part >= half * (1.0 - 1e-9):
                low = at
            if part > half * (1.0 + 1e-9) or at == seen - 1:
                middles[n] = 0.5 * (ranked[low] + ranked[at])
                break
    return middles


def agreed_step(
    slopes: Float64s, values: Float64s, weights: Float64s, ridge: Float64s, pull: Float64s | None = None
) -> Float64s:
    """Return the changes (images, numbers) by which values agree best with each point's consensus.

    Least squares of weights · (values + slopes · changes − consensus)²; slopes (images, n, numbers).
    ``ridge`` holds changes at 0; an infinite one keeps them there. ``pull`` is half the slope of other costs.
    """
    images, _, numbers = slopes.shape
    size = images * numbers
    matrix, right = np.zeros((size, size)), np.zeros(size) if pull is None else -pull.ravel()
    _add_points(slopes, values, weights, matrix, right)
    matrix += np.tril(matrix, -1).T
    stays = np.isinf(ridge.ravel())
    matrix[np.diag_indices(size)] += np.where(stays, 0.0, ridge.ravel())
    free = np.flatnonzero(~stays)
    changes = np.zeros(size)
    changes[free] = np.linalg.pinv(matrix[np.ix_(free, free)], rcond=1e-12, hermitian=True) @ right[free]
    return changes.reshape(images, numbers)


@kernel
def _add_points(
    slopes: Float64s, values: Float64s, weights: Float64s, matrix: Float64s, right: Float64s
) -> None:
    """Add the points to the normal equations: the lower half of the matrix, and the right side."""
    images, count, numbers = slopes.shape
    which = np.empty(images, np.int64)
    for n in range(count):
        seen, total, middle = 0, 0.0, 0.0
        for i in range(images):
            if weights[i, n] > 0.0:
                which[seen] = i
                total += weights[i, n]
                middle += weights[i, n] * values[i, n]
                seen += 1
        for a in range(seen):
            i = which[a]
            weight, apart = weights[i, n], values[i, n] - middle / total
            for p in range(numbers):
                right[i * numbers + p] -= weight * apart * slopes[i, n, p]
            for b in range(a + 1):
                j = which[b]
                share = weight * ((1.0 if a == b else 0.0) - weights[j, n] / total)
                for p in range(numbers):
                    row, slope = i * numbers + p, share * slopes[i, n, p]
                    for q in range(numbers if a > b else p + 1):
                        matrix[row, j * numbers + q] += slope * slopes[j, n, q]
