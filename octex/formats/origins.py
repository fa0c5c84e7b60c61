"""Positions in float32: those of a model far from the origin are written from a place nearer to it."""

from __future__ import annotations

import numpy as np

from octex.arrays import Float64s

#: Models that reach no farther from the origin than so many times their size are written as they are:
#: float32 moves no vertex by more than 4·10⁻⁶ of that.
_FAR = 64.0
#: Significant digits of an origin: as many as all files hold.
_DIGITS = 5


def origin_of(vertices: Float64s) -> Float64s:
    """Return the origin (3,) that positions are to be written from."""
    low, high = vertices.min(axis=0, initial=np.inf), vertices.max(axis=0, initial=-np.inf)
    if not np.maximum(-low, high).max() > _FAR * (high - low).max():
        return np.zeros(3)
    return np.array([float(f"{each:.{_DIGITS - 1}e}") for each in (low + high) / 2])
