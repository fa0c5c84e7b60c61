"""What guesses weigh: fitted to the texture by least squares, class by class."""

from __future__ import annotations

import numpy as np

from octex.archive.coding import CLASSES, TERMS, WEIGHT_BITS
from octex.arrays import Float64s, Int64s
from octex.jit import inlined, kernel

_MOST_WEIGHT = 8 << WEIGHT_BITS


def new_squares(components: int) -> Float64s:
    """Return room for what ``code_values`` measures: of each class sums of squares, the count last."""
    return np.zeros((2 * components * CLASSES, TERMS + 1, TERMS + 1))


@inlined
def measure(terms: Int64s, off: int, scale: float, squares: Float64s, number: int) -> None:
    """Add to the sums of least squares: terms by terms, the number wanted last; how many there are."""
    weight = scale * scale / (abs(off) * scale + 0.5)
    for n in range(np.uint64(TERMS + 1)):
        weighted = weight * terms[n]
        if weighted != 0.0:
            for m in range(np.uint64(TERMS)):  # more than is read, in vectors
                squares[number, n, m] += weighted * terms[m]
    squares[number, TERMS, TERMS] += 1.0


@kernel
def solve(squares: Float64s, weights: Int64s) -> None:
    """Write the weights that make weighted squares of errors least, 0 of few; Cholesky's way."""
    for number in range(squares.shape[0]):
        square, right = squares[number], np.zeros(TERMS)
        if square[TERMS, TERMS] < 4 * TERMS:
            continue
        ridge = 1e-3 * np.sqrt(square[TERMS, TERMS])
        for n in range(TERMS):
            right[n] = square[TERMS, n]
            square[n, n] += ridge
            for m in range(n + 1):
                total = square[n, m]
                for k in range(m):
                    total -= square[n, k] * square[m, k]
                square[n, m] = np.sqrt(max(total, ridge)) if n == m else total / square[m, m]
        for n in range(TERMS):
            for k in range(n):
                right[n] -= square[n, k] * right[k]
            right[n] /= square[n, n]
        for n in range(TERMS - 1, -1, -1):
            for k in range(n + 1, TERMS):
                right[n] -= square[k, n] * right[k]
            right[n] /= square[n, n]
            weight = np.rint(right[n] * (1 << WEIGHT_BITS))
            weights[number * TERMS + n] = int(min(max(weight, -_MOST_WEIGHT), _MOST_WEIGHT))
