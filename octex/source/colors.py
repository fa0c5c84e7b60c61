"""Colours of users and files, converted to linear light and alpha."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from octex.arrays import Float32s, Float64s, Floats
from octex.channels import decode, srgb_to_linear
from octex.checks import as_array
from octex.errors import ArgumentError, ModelError

#: Colours may exceed 1 by this much; they are clipped to 1.
_ROUNDING = 1e-5


def linear_colors(colors: npt.ArrayLike, rows: int, name: str) -> Float32s:
    """Convert integers (sRGB) or floats (linear light) (rows, 3 or 4) to linear light and alpha (rows, 4).

    Raises ModelError for colours that are not finite or not in 0 … 1.
    """
    array = as_array(colors)
    if array.ndim != 2 or array.shape[0] != rows or array.shape[1] not in (3, 4):
        raise ArgumentError(f"{name} must have shape ({rows}, 3) or ({rows}, 4), not {array.shape}")
    linear = np.ones((rows, 4), np.float32)
    if array.dtype in (np.uint8, np.uint16):
        linear[:, :3] = decode(array[:, :3], "srgb")
        linear[:, 3 : array.shape[1]] = decode(array[:, 3:], "data")
    elif array.dtype.kind == "f":
        with np.errstate(over="ignore"):
            linear[:, : array.shape[1]] = array
        finite = np.isfinite(linear).all(axis=1)
        fits = ((linear >= 0.0) & (linear <= 1.0 + _ROUNDING)).all(axis=1)
        if not finite.all():
            raise ModelError(f"{name}: colour {int(np.argmin(finite))} is not finite")
        if not fits.all():
            raise ModelError(
                f"{name}: colour {int(np.argmin(fits))} is not from 0 to 1, as linear light is; give sRGB "
                "codes as uint8 or uint16"
            )
    else:
        raise ArgumentError(f"{name} must be uint8 or uint16 (sRGB) or floats (linear), not {array.dtype}")
    return np.minimum(linear, np.float32(1.0))


def guessed_colors(values: Float64s) -> Float32s:
    """Convert sRGB values in 0 … 1, or 0 … 255 if any is above 1, to linear light; NaN is white."""
    most = 255.0 if np.nanmax(values, initial=0.0) > 1.0 else 1.0
    return screen_colors(np.nan_to_num(values / most, nan=1.0))


def screen_colors(colors: Floats) -> Float32s:
    """Convert sRGB values in 0 … 1 (n, 3 or 4) to linear light and alpha (n, 4)."""
    linear = np.ones((len(colors), 4), np.float32)
    linear[:, : colors.shape[1]] = np.clip(colors, 0.0, 1.0)
    linear[:, :3] = srgb_to_linear(linear[:, :3])
    return linear
