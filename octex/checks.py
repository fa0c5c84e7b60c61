"""Checks of arguments: casts users' input to the form that kernels take, or refuses it."""

from __future__ import annotations

import inspect
import os
import reprlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Float64s, Floats, Int64s
from octex.errors import ArgumentError, OctexError
from octex.files import size_of
from octex.tree.layout import MAX_DEPTH

Item = TypeVar("Item")
AnyArray = TypeVar("AnyArray", bound=Array)
Choice = TypeVar("Choice", bound=str)


def as_points(points: npt.ArrayLike, name: str = "points") -> Floats:
    """Return positions as C-ordered (n, 3) float32 or float64, or raise ArgumentError."""
    array = as_point_rows(points, name)
    return np.ascontiguousarray(array, np.float32 if array.dtype == np.float32 else np.float64)


def as_point_rows(points: npt.ArrayLike, name: str = "points") -> Array:
    """Return positions (n, 3) of any real type and order, not copied, or raise ArgumentError."""
    array = points if type(points) is np.ndarray else as_array(points)  # in most calls it is one
    if array.dtype == np.void:  # rows of unequal lengths
        raise ArgumentError(f"{name} must have shape (n, 3)")
    if array.dtype.kind not in "fiu":
        raise ArgumentError(f"{name} must be real numbers, not {array.dtype}")
    if array.shape == (0,):
        array = array.reshape(0, 3)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ArgumentError(f"{name} must have shape (n, 3), not {array.shape}")
    return array


def as_array(value: Any) -> Array:
    """Return an array, not copied if it is one; a void array of shape () for rows of unequal lengths.

    Tensors of other libraries are read by ``__array__``, or else by ``__dlpack__``. Raises ArgumentError for
    unreadable ones, such as a tensor on a GPU.
    """
    is_tensor = hasattr(value, "__dlpack__") and not isinstance(value, np.ndarray)
    try:
        return np.from_dlpack(value) if is_tensor and not hasattr(value, "__array__") else np.asarray(value)
    except Exception as error:
        if not is_tensor:
            if isinstance(error, ValueError):
                return np.empty((), np.void)
            raise
        reason = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
        raise ArgumentError(
            f"octex reads arrays in main memory, and this {type(value).__name__} cannot be read as one "
            f"({reason}); give a copy there, like tensor.detach().cpu(), of a type that numpy has"
        ) from None


def as_row_numbers(numbers: npt.ArrayLike, count: int, what: str = "row") -> Int64s:
    """Return numbers of rows, or of ``what`` (n,), each below ``count``, or raise ArgumentError."""
    array = as_array(numbers)
    if array.shape == (0,):
        return np.empty(0, np.int64)
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise ArgumentError(f"{what}s must be whole numbers (n,), not {array.dtype} {array.shape}")
    if not 0 <= array.min() <= array.max() < count:
        worst = array.min() if array.min() < 0 else array.max()
        raise ArgumentError(f"there is no {what} {worst}; there are 0 to {count - 1}")
    return array.astype(np.int64, copy=False)


def as_reals(value: npt.ArrayLike, name: str, *shapes: tuple[int, ...], most: float = np.inf) -> Float64s:
    """Return numbers as a float64 array of one of ``shapes``, in which −1 stands for any length.

    Raises ArgumentError for another shape, for anything but real numbers, and for numbers beyond ±``most``.
    """

    def refusal() -> ArgumentError:
        shape_text = " or ".join(str(shape).replace("-1", "n") for shape in shapes)
        kind = "finite numbers" if most < np.inf else "numbers"
        return ArgumentError(f"{name} must be {kind} of shape {shape_text}, not {reprlib.repr(value)}")

    array = as_array(value)
    is_shape = any(
        len(shape) == array.ndim and all(n in (-1, m) for n, m in zip(shape, array.shape, strict=True))
        for shape in shapes
    )
    if not is_shape or array.dtype.kind not in "fiu":
        raise refusal()
    with np.errstate(over="ignore"):  # of longer floats
        array = array.astype(np.float64)
    if most < np.inf and not (np.abs(array) <= most).all():
        raise ArgumentError(f"{refusal()}, all from {-most:g} to {most:g}")
    return array


def as_whole(number: int, name: str, least: int, most: int) -> int:
    """Return a whole number from ``least`` to ``most``, or raise ArgumentError."""
    is_whole = isinstance(number, (int, np.integer)) and not isinstance(number, bool)
    if not is_whole or not least <= number <= most:
        raise ArgumentError(f"{name} must be a whole number from {least} to {most}, not {number!r}")
    return int(number)


def as_path(path: Any, name: str = "path", refusal: type[OctexError] = ArgumentError) -> Path:
    """Return a path; raises ArgumentError for another type, ``refusal`` for an invalid name."""
    try:
        text = os.fsdecode(path)
        named = bool(text) and b"\0" not in os.fsencode(text)
    except TypeError:
        raise ArgumentError(f"{name} must be a path, not {path!r}") from None
    except UnicodeError:  # lone surrogates
        named = False
    if not named:
        raise refusal(f"{name}: {path!r} is not a valid file name")
    return Path(text)


def is_path(value: object) -> TypeGuard[str | os.PathLike[str]]:
    """Return whether an object is the path of a file: text, bytes, or an ``os.PathLike``."""
    return isinstance(value, (str, bytes, os.PathLike))


def as_flag(flag: bool, name: str) -> bool:
    """Return True or False, or raise ArgumentError."""
    if not isinstance(flag, (bool, np.bool_)):
        raise ArgumentError(f"{name} must be True or False, not {flag!r}")
    return bool(flag)


def is_several(value: object) -> TypeGuard[Iterable[Any]]:
    """Return whether an object is iterable, and no text."""
    if isinstance(value, np.ndarray):
        return value.ndim > 0
    return isinstance(value, Iterable) and not isinstance(value, (str, bytes))


def as_names(
    names: str | Iterable[str], name: str, known: Collection[str] | None = None, kind: str = "channel"
) -> list[str]:
    """Return one name or several as a list; raises ArgumentError for anything but text, or not ``known``."""
    listed: list[Any] = list(names) if is_several(names) else [names]
    for each in listed:
        if not isinstance(each, str):
            raise ArgumentError(f"{name} must be text, one or several, not {each!r}")
        if known is not None:
            as_choice(each, known, kind)
    return listed


def as_text(text: str, name: str) -> str:
    """Return text, or raise ArgumentError."""
    if not isinstance(text, str):
        raise ArgumentError(f"{name} must be text, not {text!r}")
    return text


def as_entries(value: Mapping[Any, Item], name: str) -> dict[str, Item]:
    """Return a mapping with text keys as a dict, or raise ArgumentError."""
    if not isinstance(value, Mapping):
        raise ArgumentError(f"{name} must be a dict with names as keys, not {value!r}")
    entries = dict(value)
    for each in entries:
        if not isinstance(each, str):
            raise ArgumentError(f"{name} must have names, not {each!r}")
    return entries


def locked(array: AnyArray) -> AnyArray:
    """Return a read-only view of an array; kernels take it as any other."""
    view = array.view()
    view.flags.writeable = False
    return view


def as_depth(depth: int, name: str = "depth") -> int:
    """Return a tree depth, 0 … 21, or raise ArgumentError."""
    return as_whole(depth, name, 0, MAX_DEPTH)


def as_items(value: Any, kind: type[Item], name: str) -> list[Item]:
    """Return one object or several of a kind as a list, or raise ArgumentError for anything else."""
    if isinstance(value, kind):
        return [value]
    listed = list(value) if is_several(value) else []
    if not listed:
        raise ArgumentError(f"{name} is missing: give octex.{kind.__name__}, one or several, not {value!r}")
    for each in listed:
        if not isinstance(each, kind):
            raise ArgumentError(f"each {name} must be an octex.{kind.__name__}, not {each!r}")
    return listed


def as_choice(value: Choice, choices: Iterable[str], name: str) -> Choice:
    """Return ``value`` if it is one of ``choices``; else raise ArgumentError listing them."""
    known = list(choices)
    if not isinstance(value, str) or value not in known:
        listing = ", ".join(known) or "none"
        raise ArgumentError(f"unknown {name} {value!r}; there are: {listing}")
    return value


def as_memory(size: int | str) -> int:
    """Return ``memory`` in bytes, from a number or a text like "2GB", or raise ArgumentError."""
    if not isinstance(size, str):
        return as_whole(size, "memory", 1, 1 << 53)
    try:
        return size_of(size)
    except ValueError as error:
        raise ArgumentError(f"memory: {error}") from None


def as_number(value: float, name: str, least: float, most: float) -> float:
    """Return a number from ``least`` to ``most``, or raise ArgumentError."""
    number = as_real(value, name)
    if not least <= number <= most:
        above = f" to {most:g}" if most < np.finfo(np.float64).max else " on"
        raise ArgumentError(f"{name} must be from {least:g}{above}, not {number:g}")
    return number


def as_positive(value: float, name: str) -> float:
    """Return a finite number above zero, or raise ArgumentError."""
    number = as_real(value, name)
    if not 0.0 < number < np.inf:
        raise ArgumentError(f"{name} must be finite and above zero, not {number:g}")
    return number


def as_real(value: Any, name: str, kind: str = "a number") -> float:
    """Return one real number, also infinite or NaN, or raise ArgumentError."""
    if type(value) is float:  # a fifth of a lookup of one point otherwise
        return value
    try:
        if isinstance(value, (str, bytes)) or np.iscomplexobj(value) or is_several(value):
            raise TypeError
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise ArgumentError(f"{name} must be {kind}, not {value!r}") from None


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
    """Call a user's function for arrays with a row for each point; return its numbers, of one of ``shapes``.

    ``what`` names the function in messages, ``where`` returns the position of a row's point. Raises
    ArgumentError, with the cause, if the function raises, and for another shape, for anything but real
    numbers, and for numbers outside ``least`` to ``most`` by more than ``slack``.
    """
    count = len(arguments[0])

    def place(row: int) -> str:
        return f"({', '.join(f'{coordinate:.6g}' for coordinate in where(row))})"

    try:
        returned = function(*arguments)
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
        points = f"{count} points from {place(0)} on" if count else "no points"
        raise ArgumentError(f"{what} raised {reason} for {points}") from error
    shape_text = " or ".join(map(str, shapes))
    values = as_array(returned)
    if values.dtype == np.void:  # rows of unequal lengths
        raise ArgumentError(f"{what} must return an array of shape {shape_text}")
    if values.shape not in shapes:
        raise ArgumentError(
            f"{what} must return an array of shape {shape_text}, not {values.shape}, for {count} points"
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
    """Return whether a function requires ``other`` besides ``one``; refuse other numbers of arguments."""
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
