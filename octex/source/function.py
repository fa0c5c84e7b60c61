"""A channel whose values a function of position gives."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.channels import ChannelFormat
from octex.errors import ArgumentError
from octex.source.materials import MOST_IN_FLOAT16, light_format
from octex.source.spatial import Floats, Int32s, SpatialSource

# Values may be out of their range by so much, and are then brought into it.
_ROUNDING = 1e-6


class FunctionSource(SpatialSource):
    """One channel that a function gives: ``function(points)`` or ``function(points, normals)``.

    It is called with rest positions (n, 3), in the model's units, and unit normals (n, 3) of the faces at
    rest if it requires a second positional argument, both float64 and its own to write to. It returns
    (n, components), or (n,) for one component: linear light for colours, 0 … 1 (0 … 65504 for ``emissive``,
    which is stored as floats), vectors in rest space for ``normal``, each component in −1 … 1, which are made
    unit vectors. Conversion calls it with batches of points, from several threads at once.

    A function is read at points, whatever the footprint: detail finer than the cells of a texture is only
    averaged as far as conversion takes means over the pieces of surface in a cell.

    Raises ArgumentError for a function that takes other arguments; and when it is read, if it raises (the
    cause is kept), returns another shape, or anything that is not a finite number in the range.
    """

    def __init__(
        self, form: ChannelFormat, function: Callable[..., Any], rest: Floats, triangles: Int32s
    ) -> None:
        most = MOST_IN_FLOAT16 if form.name == "emissive" else 1.0
        super().__init__([light_format(form, most)], rest, triangles)
        self._least, self._most = -1.0 if form.space == "direction" else 0.0, most
        self._function = function
        self._what = f"the function {name_of(function)} of {form.name}"
        self._takes_normals = _takes_normals(function, self._what)

    def at(
        self,
        points: Floats,
        normals: Floats,
        widths: npt.NDArray[np.float32],  # noqa: ARG002
    ) -> npt.NDArray[np.float32]:
        """Return values (n, components) at rest positions (n, 3)."""
        [form] = self.channels
        if len(points) == 0:
            return np.empty((0, form.components), np.float32)
        arguments = (points.copy(), normals.copy()) if self._takes_normals else (points.copy(),)
        try:
            found = self._function(*arguments)
        except Exception as error:
            reason = " ".join(str(error).split())
            kind = type(error).__name__
            raise ArgumentError(
                f"{self._what} raised {kind}{f': {reason}' if reason else ''} "
                f"for {len(points)} points from {_place(points[0])} on"
            ) from error
        values = self._as_rows(found, len(points), form.components)
        with np.errstate(invalid="ignore"):
            fits = (values >= self._least - _ROUNDING) & (values <= self._most * (1.0 + _ROUNDING))
            lengths = np.linalg.norm(values, axis=1, keepdims=True)
        fits = fits.all(axis=1) & ((form.space != "direction") | (lengths[:, 0] > 0.0))
        if not fits.all():
            bad = int(np.argmin(fits))
            numbers = ", ".join(f"{value:.6g}" for value in values[bad])
            wanted = f"from {self._least:g} to {self._most:g}" + (
                ", not all zeros" if form.space == "direction" else ""
            )
            raise ArgumentError(
                f"{self._what} returned {numbers} at {_place(points[bad])}; values must be {wanted}"
            )
        if form.space == "direction":
            values = values / lengths
        return np.clip(values, self._least, self._most).astype(np.float32)

    def _as_rows(self, found: object, count: int, components: int) -> Floats:
        """Return what the function returned as (count, components), or refuse it."""
        shapes = [(count, components)] + [(count,)] * (components == 1)
        wanted = " or ".join(map(str, shapes))
        try:
            values = np.asarray(found)
        except ValueError:  # rows of unequal lengths
            raise ArgumentError(f"{self._what} must return an array of shape {wanted}") from None
        if values.shape not in shapes:
            raise ArgumentError(
                f"{self._what} must return an array of shape {wanted}, not {values.shape}, for {count} points"
            )
        if values.dtype.kind not in "fiub":
            raise ArgumentError(f"{self._what} must return real numbers, not {values.dtype}")
        return values.reshape(count, components).astype(np.float64)


def name_of(function: Callable[..., Any]) -> str:
    """Return a function's name as its author knows it."""
    return str(getattr(function, "__name__", type(function).__name__))


def _takes_normals(function: Callable[..., Any], what: str) -> bool:
    """Say whether a function requires two positional arguments; raises ArgumentError if not one or two."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # written in C
        return False
    required = [
        each
        for each in signature.parameters.values()
        if each.default is each.empty and each.kind in (each.POSITIONAL_ONLY, each.POSITIONAL_OR_KEYWORD)
    ]
    count = max(len(required), 1)
    try:
        signature.bind(*range(count))
    except TypeError:
        count = 0
    if count not in (1, 2):
        raise ArgumentError(f"{what} must take positions, or positions and normals, not {signature}")
    return count == 2


def _place(point: Floats) -> str:
    return "({})".format(", ".join(f"{x:.6g}" for x in point))
