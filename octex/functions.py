"""Users' functions: what they return, checked wherever they are called."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from octex.arrays import Array, Float64s
from octex.checks import as_array
from octex.errors import ArgumentError

_MOST = float(np.finfo(np.float64).max)


def answer(
    function: Callable[..., Any],
    arguments: Sequence[Array],
    shapes: Sequence[tuple[int, ...]],
    what: str,
    where: Callable[[int], Sequence[float] | Array],
    *,
    least: float = -np.inf,
    most: float = np.inf,
    slack: float = 0.0,
) -> Float64s:
    """Return what a function returns for arrays with a row for each point: numbers of one of some shapes.

    ``what`` is the function in messages, ``where`` gives the position of the point of a row. Raises
    ArgumentError, which keeps the cause, if the function raises, and for another shape, for what are no real
    numbers and for those not from ``least`` to ``most``, which may be missed by so much ``slack``.
    """
    count = len(arguments[0])

    def place(row: int) -> str:
        return f"({', '.join(f'{coordinate:.6g}' for coordinate in where(row))})"

    try:
        found = function(*arguments)
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
        points = f"{count} points from {place(0)} on" if count else "no points"
        raise ArgumentError(f"{what} raised {reason} for {points}") from error
    wanted = " or ".join(map(str, shapes))
    values = as_array(found)
    if values.dtype == np.void:  # rows of unequal lengths
        raise ArgumentError(f"{what} must return an array of shape {wanted}")
    if values.shape not in shapes:
        raise ArgumentError(
            f"{what} must return an array of shape {wanted}, not {values.shape}, for {count} points"
        )
    if values.dtype.kind not in "fiub":
        raise ArgumentError(f"{what} must return real numbers, not {values.dtype}")
    numbers = values.astype(np.float64)
    sound = (numbers >= least - slack) & (numbers <= most * (1.0 + slack))
    if not sound.all():
        row = int(np.argmin(sound.reshape(count, -1).all(axis=1)))
        limits = "numbers" if most == np.inf else "finite" if most == _MOST else f"from {least:g} to {most:g}"
        listing = ", ".join(f"{number:.6g}" for number in numbers[row].ravel())
        raise ArgumentError(f"{what} returned {listing} at {place(row)}; values must be {limits}")
    return numbers


def name_of(function: object) -> str:
    """Return a function's name as its author knows it."""
    return str(getattr(function, "__name__", type(function).__name__))


def takes_both(function: Callable[..., Any], what: str, one: str, other: str) -> bool:
    """Say whether a function requires ``other`` beside ``one``; refuse other numbers of arguments."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # written in C
        return False
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    required = [
        each
        for each in signature.parameters.values()
        if each.default is each.empty and each.kind in positional
    ]
    count = max(len(required), 1)
    try:
        signature.bind(*range(count))
    except TypeError:
        count = 0
    if count not in (1, 2):
        raise ArgumentError(f"{what} must take {one}, or {one} and {other}, not {signature}")
    return count == 2
