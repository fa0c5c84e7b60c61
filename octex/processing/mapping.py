"""Every value of a texture through a function."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Float32s, Float64s, Int64s
from octex.channels import ALPHA, decode, encode
from octex.errors import ArgumentError
from octex.functions import answer, name_of, takes_both
from octex.processing.edit import Centres, edited, names_of
from octex.texture import Channel, OctreeTexture

#: Values that a function is given at once: with what it makes of them they stay in the processor's cache.
BLOCK = 1 << 13
_MOST = float(np.finfo(np.float64).max)

#: From decoded values (n, components), and the positions (n, 3) of their cells' centres at rest if it wants
#: them, to as many values.
ValueFunction = Callable[..., npt.ArrayLike]


def map_values(
    texture: OctreeTexture, f: ValueFunction, channel: str | Sequence[str] = "base_color"
) -> OctreeTexture:
    """Return a texture whose values are f of another's; exported as ``octex.map``.

    f         takes values (n, components), float32, and returns the same shape. Values are linear light for
              colours, −1 … 1 for directions, otherwise as stored, 0 … 1 for integers. If f has a second
              parameter without a default, it gets the rest positions (n, 3) of the cells' centres
    channel   one name or several; each channel is mapped separately

    Results are rounded and clamped as the channel is stored; alpha is clamped to 0 … 1. f is applied to the
    values of leaves, facings and kept nodes. A node gets the mean of the new values below it, plus a
    residual: f(its value) − f(the mean of the values below it). So an affine f maps averages exactly.

    Raises ArgumentError for unknown channels, and if f raises an error, or returns another shape, no numbers
    or values that are not finite; the message names the first position.
    """
    if not callable(f):
        raise ArgumentError(f"f must be a function of values, not {f!r}")
    names = names_of(texture, channel)
    centres = Centres(texture.tree, texture.placement)
    return edited(texture, names, lambda each: _Mapped(f, each, centres), "map", function=name_of(f))


class _Mapped:
    """A function on the values of one channel."""

    def __init__(self, f: ValueFunction, channel: Channel, centres: Centres) -> None:
        self._f, self._form, self._centres = f, channel.format, centres
        self._what = f"channel {self._form.name!r}: {name_of(f)}"
        self._wants_positions = takes_both(f, self._what, "values", "positions")

    def stored(self, values: Array, cells: Int64s | None) -> Array:
        """Map values as stored, which are those of ``cells``, or one a cell."""
        form = self._form
        mapped = np.empty_like(values)
        for here, chosen in _blocks(len(values), cells):
            mapped[here] = encode(self._of(decode(values[here], form.space), chosen), form.dtype, form.space)
        return mapped

    def changed(self, cells: Int64s, values: Float64s, means: Float64s) -> Float64s:
        """Return how far f of values is from f of means."""
        apart = np.empty_like(values)
        for here, chosen in _blocks(len(values), cells):
            apart[here] = self._of(values[here].astype(np.float32), chosen)
            apart[here] -= self._of(means[here].astype(np.float32), chosen)
        return apart

    def _of(self, values: Float32s, cells: Int64s | range) -> Float64s:
        arguments: list[Any] = [values, self._centres[cells]] if self._wants_positions else [values]
        mapped = answer(
            self._f, arguments, [values.shape], self._what,
            lambda row: self._centres[cells[row : row + 1]][0],
            least=-_MOST, most=_MOST,
        )  # fmt: skip
        return np.clip(mapped, 0, 1) if self._form.name == ALPHA.name else mapped


def _blocks(count: int, cells: Int64s | None) -> Iterator[tuple[slice, Int64s | range]]:
    for begin in range(0, count, BLOCK):
        here = slice(begin, min(begin + BLOCK, count))
        yield here, range(here.start, here.stop) if cells is None else cells[here]
