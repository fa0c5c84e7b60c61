"""Halves the texels of faces."""

from __future__ import annotations

import numpy as np

from octex.arrays import Array, Floats


def multiply(values: Floats, alpha: int, one: float) -> None:
    """Multiply the colours' channels by alpha, where they are."""
    values[..., colors(alpha)] *= values[..., alpha : alpha + 1] / one


def colors(alpha: int) -> slice:
    """Return the channels that are multiplied by alpha: those before it, or if it is the first all others."""
    return slice(0, alpha) if alpha else slice(1, None)


def halved(texels: Array, is_triangle: bool) -> Array:
    """Return means (n, v/2, u/2, channels) of four texels (n, v, u, channels), a triangle's as it divides."""
    values = texels if texels.dtype == np.float64 else texels.astype(np.float64)
    total = values[:, ::2, ::2] + values[:, ::2, 1::2] + values[:, 1::2, ::2]
    last = values[:, 1::2, 1::2]
    if is_triangle:
        last = np.swapaxes(values[:, ::-2, ::-2], 1, 2)
    return stored((total + last) / 4, texels.dtype)


def stored(values: Floats, dtype: np.dtype) -> Array:
    """Return values as numbers of a type, whole ones rounded to nearest."""
    if dtype.kind == "u":
        return np.rint(np.clip(values, 0, np.iinfo(dtype).max)).astype(dtype)
    with np.errstate(over="ignore"):
        return values.astype(dtype)
