"""Every value of a texture through a function."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Float32s, Float64s, Int64s
from octex.channels import ALPHA, decode, encode
from octex.checks import as_choice, as_names
from octex.errors import ArgumentError
from octex.functions import answer, name_of, takes_both
from octex.processing.edit import noted, with_values
from octex.texture import Channel, OctreeTexture, as_texture
from octex.tree.morton import decode_cells
from octex.tree.octree import Octree
from octex.tree.split import rows_of

#: Values that a function is given at once: with what it makes of them they stay in the processor's cache.
BLOCK = 1 << 13
_MOST = float(np.finfo(np.float64).max)

#: From decoded values (n, components), and the positions (n, 3) of their cells' centres at rest if it wants
#: them, to as many values.
ValueFunction = Callable[..., npt.ArrayLike]


def names_of(texture: OctreeTexture, channel: str | Sequence[str] | None) -> list[str]:
    """Return the names of channels to work on, None for all. Raises ArgumentError, also for no texture."""
    as_texture(texture)
    names = list(texture.channels) if channel is None else as_names(channel, "channel")
    return [as_choice(name, texture.channels, "channel") for name in dict.fromkeys(names)]


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
    made, change = {}, {}
    cells = _Cells(texture)
    for name in names_of(texture, channel):
        before = texture.channels[name]
        mapped = _Mapped(f, before, cells)
        rows = rows_of(texture.tree.split).cells
        made[name] = before._replace(
            values=mapped.stored(before.values, None),
            split_values=mapped.stored(before.split_values, rows),
            kept_values=mapped.stored(before.kept_values, texture.tree.kept.cells.astype(np.int64)),
        )
        change[name] = mapped.changed
    metadata = noted(texture.metadata, "map", channels=list(made), function=name_of(f))
    return with_values(texture, made, change, metadata)


class _Cells:
    """Where cells are; found when it is first asked."""

    def __init__(self, texture: OctreeTexture) -> None:
        self._texture = texture
        self._codes: Int64s | None = None

    def centres(self, cells: Int64s | range) -> Float64s:
        """Return the centres (n, 3) of cells at rest."""
        if self._codes is None:
            self._codes = np.concatenate([codes for codes, _ in self._texture.tree.walk()])
        chosen = np.asarray(cells, np.int64)
        return centres_of(self._texture, self._codes[chosen], levels_of(self._texture.tree, chosen))


def levels_of(tree: Octree, cells: Int64s) -> Int64s:
    """Return the levels of cells (n,)."""
    return np.searchsorted(tree.arrays.level_cells, cells, side="right") - 1


def centres_of(texture: OctreeTexture, codes: Int64s, levels: Int64s | int) -> Float64s:
    """Return the centres (n, 3), at rest, of cells of some Morton codes and levels."""
    edges = np.ldexp(1.0, -np.asarray(levels))
    return texture.placement.to_rest((decode_cells(codes) + 0.5) * edges[..., None])


class _Mapped:
    """A function on the values of one channel."""

    def __init__(self, f: ValueFunction, channel: Channel, cells: _Cells) -> None:
        self._f, self._form, self._cells = f, channel.format, cells
        self._what = f"channel {self._form.name!r}: {name_of(f)}"
        self._wants_positions = takes_both(f, self._what, "values", "positions")

    def stored(self, values: Array, cells: Int64s | None) -> Array:
        """Map values as stored, which are those of ``cells``, or one a cell."""
        form = self._form
        found = np.empty_like(values)
        for here, own in _blocks(len(values), cells):
            found[here] = encode(self._of(decode(values[here], form.space), own), form.dtype, form.space)
        return found

    def changed(self, cells: Int64s, values: Float64s, means: Float64s) -> Float64s:
        """Return how far f of values is from f of means."""
        apart = np.empty_like(values)
        for here, own in _blocks(len(values), cells):
            apart[here] = self._of(values[here].astype(np.float32), own)
            apart[here] -= self._of(means[here].astype(np.float32), own)
        return apart

    def _of(self, values: Float32s, cells: Int64s | range) -> Float64s:
        arguments: list[Any] = [values]
        if self._wants_positions:
            arguments.append(self._cells.centres(cells))
        found = answer(
            self._f, arguments, [values.shape], self._what,
            lambda row: self._cells.centres(cells[row : row + 1])[0],
            least=-_MOST, most=_MOST,
        )  # fmt: skip
        return np.clip(found, 0, 1) if self._form.name == ALPHA.name else found


def _blocks(count: int, cells: Int64s | None) -> Iterator[tuple[slice, Int64s | range]]:
    for begin in range(0, count, BLOCK):
        here = slice(begin, min(begin + BLOCK, count))
        yield here, range(here.start, here.stop) if cells is None else cells[here]
