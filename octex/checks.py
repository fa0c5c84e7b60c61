"""The border: what users give is cast here to the one form that kernels take, or refused."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.errors import ArgumentError
from octex.tree.layout import MAX_DEPTH


def as_points(points: npt.ArrayLike, name: str = "points") -> npt.NDArray[np.float32 | np.float64]:
    """Return positions as a C-ordered (n, 3) float32 or float64 array; float input is not copied if it fits.

    Raises ArgumentError for another shape or for values that are not real numbers.
    """
    array = as_point_rows(points, name)
    return np.ascontiguousarray(array, np.float32 if array.dtype == np.float32 else np.float64)


def as_point_rows(points: npt.ArrayLike, name: str = "points") -> npt.NDArray[Any]:
    """Return positions as an (n, 3) array of whatever real type and order; an array is not copied.

    Raises ArgumentError like ``as_points``. An empty list is a batch of no points.
    """
    try:
        array = np.asarray(points)
    except ValueError:  # rows of unequal lengths
        raise ArgumentError(f"{name} must have shape (n, 3)") from None
    if array.dtype.kind not in "fiu":
        raise ArgumentError(f"{name} must be real numbers, not {array.dtype}")
    if array.shape == (0,):
        array = array.reshape(0, 3)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ArgumentError(f"{name} must have shape (n, 3), not {array.shape}")
    return array


def as_depth(depth: int, name: str = "depth") -> int:
    """Return a tree depth, 0 … 21, or raise ArgumentError."""
    if isinstance(depth, bool) or not isinstance(depth, (int, np.integer)) or not 0 <= depth <= MAX_DEPTH:
        raise ArgumentError(f"{name} must be a whole number from 0 to {MAX_DEPTH}, not {depth!r}")
    return int(depth)


def as_choice(value: str, choices: Iterable[str], name: str) -> str:
    """Return ``value`` if it is one of ``choices``; else raise ArgumentError listing them."""
    known = list(choices)
    if value not in known:
        listing = ", ".join(known) or "none"
        raise ArgumentError(f"unknown {name} {value!r}; there are: {listing}")
    return value


def as_number(value: float, name: str, least: float, most: float) -> float:
    """Return a number from ``least`` to ``most``, or raise ArgumentError."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ArgumentError(f"{name} must be a number, not {value!r}") from None
    if not least <= number <= most:
        above = f" to {most:g}" if most < np.finfo(np.float64).max else " on"
        raise ArgumentError(f"{name} must be from {least:g}{above}, not {number:g}")
    return number


def as_positive(value: float, name: str) -> float:
    """Return a finite number above zero, or raise ArgumentError."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ArgumentError(f"{name} must be a number, not {value!r}") from None
    if not 0.0 < number < np.inf:
        raise ArgumentError(f"{name} must be finite and above zero, not {number:g}")
    return number
