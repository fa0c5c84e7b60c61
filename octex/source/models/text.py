"""Numbers in text files."""

from __future__ import annotations

import warnings

import numpy as np

from octex.arrays import Array, Float64s, Int64s
from octex.source.alone import alone


def parse_numbers(text: str) -> Float64s | None:
    """Return the numbers of a text that blanks and line ends part; None if there is anything else."""
    with alone():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, np.float64, sep=" ")
        except (DeprecationWarning, ValueError):
            return None


def whole_numbers(values: Array) -> Int64s:
    """Return values as indices; −1 for those that are none."""
    numbers = values.astype(np.float64)
    return np.where((np.abs(numbers) < 2**31) & (numbers == np.floor(numbers)), numbers, -1).astype(np.int64)
