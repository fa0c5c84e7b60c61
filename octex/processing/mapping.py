"""Maps every value of a texture: by functions, levels and curves, or to other types."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Float32s, Float64s, Floats, Int64s
from octex.channels import (
    ALPHA,
    ONE,
    ChannelFormat,
    check_range,
    decode,
    decode_table,
    encode,
    linear_to_srgb,
    srgb_to_linear,
)
from octex.checks import answer, as_names, as_number, as_reals, name_of, takes_both
from octex.errors import ArgumentError
from octex.processing.edit import Centres, edited, names_of, with_operation
from octex.texture import Channel, OctreeTexture, as_texture
from octex.texture.channel import Dtypes, formats_as

#: Values a function call: values and results stay in the processor's cache.
BLOCK = 1 << 13
#: Values recoded at once.
_RECODED = 1 << 14
_MOST, _LARGEST = float(np.finfo(np.float64).max), float(np.finfo(np.float32).max)
_MOST_GAMMA = 100.0

#: Maps decoded values (n, components), and optionally the rest positions (n, 3) of cell centres, to values of
#: the same shape.
ValueFunction = Callable[..., npt.ArrayLike]
#: A number for all components, or one for each.
PerComponent = float | Sequence[float]
#: Maps encoded values (n, components).
Tone = Callable[[Float64s], Float64s]


def map_values(
    texture: OctreeTexture, f: ValueFunction, channel: str | Sequence[str] = "base_color"
) -> OctreeTexture:
    """Return a texture whose values are f of another's; exported as ``octex.map``.

    f         takes values (n, components), float32, and returns the same shape. Values are linear light for
              colours, −1 … 1 for directions, otherwise as stored, 0 … 1 for integers. If f has a second
              parameter without a default, it gets the rest positions (n, 3) of the cells' centres
    channel   one name or several; each channel is mapped separately

    Results are rounded and clamped to the channel's type; alpha is clamped to 0 … 1. f is applied to the
    values of leaves, facings and kept nodes. A node gets the mean of the new values below it, plus a
    residual: f(its value) − f(the mean of the values below it). So an affine f maps averages exactly.

    Raises ArgumentError for unknown channels, and if f raises an error, or returns another shape, non-numbers
    or non-finite values; the message names the first position.
    """
    if not callable(f):
        raise ArgumentError(f"f must be a function of values, not {f!r}")
    names = names_of(texture, channel)
    centres = Centres(texture.tree, texture.placement)
    return edited(texture, names, lambda each: _Mapped(f, each, centres), "map", function=name_of(f))


class _Mapped:
    def __init__(self, f: ValueFunction, channel: Channel, centres: Centres) -> None:
        self._f, self._form, self._centres = f, channel.format, centres
        self._what = f"channel {self._form.name!r}: {name_of(f)}"
        self._wants_positions = takes_both(f, self._what, "values", "positions")

    def stored(self, values: Array, cells: Int64s | None) -> Array:
        """Return mapped stored values of ``cells``, or of all cells for None."""
        form = self._form
        mapped = np.empty_like(values)
        for rows, of_rows in _blocks(len(values), cells):
            mapped[rows] = encode(self._of(decode(values[rows], form.space), of_rows), form.dtype, form.space)
        return mapped

    def changed(self, cells: Int64s, values: Float64s, means: Float64s) -> Float64s:
        """Return f(values) − f(means)."""
        differences = np.empty_like(values)
        for rows, of_rows in _blocks(len(values), cells):
            differences[rows] = self._of(values[rows].astype(np.float32), of_rows)
            differences[rows] -= self._of(means[rows].astype(np.float32), of_rows)
        return differences

    def _of(self, values: Float32s, cells: Int64s | range) -> Float64s:
        arguments: list[Any] = [values, self._centres[cells]] if self._wants_positions else [values]
        mapped = answer(
            self._f, arguments, [values.shape], self._what,
            lambda row: self._centres[cells[row : row + 1]][0],
            least=-_MOST, most=_MOST,
        )  # fmt: skip
        return np.clip(mapped, 0, 1) if self._form.name == ALPHA.name else mapped


def _blocks(count: int, cells: Int64s | None) -> Iterator[tuple[slice, Int64s | range]]:
    """Yield rows, and the cells in these rows, or of these numbers for None."""
    for begin in range(0, count, BLOCK):
        end = min(begin + BLOCK, count)
        yield slice(begin, end), range(begin, end) if cells is None else cells[begin:end]


def levels(
    texture: OctreeTexture,
    channel: str | Sequence[str] = "base_color",
    black: PerComponent = 0.0,
    white: PerComponent = 1.0,
    gamma: PerComponent = 1.0,
    out_black: PerComponent = 0.0,
    out_white: PerComponent = 1.0,
) -> OctreeTexture:
    """Return a texture with other levels: ``black`` … ``white`` become ``out_black`` … ``out_white``.

    All are encoded values, 0 … 1, as image editors show them (times 255): sRGB for light, in any stored type.
    Each is one number, or one for each component. In between, values follow x^(1/gamma): a gamma above 1
    makes the middle lighter. Values outside of black … white are clamped, except floats above white. Averages
    follow as in ``octex.map``.

    Raises ArgumentError for unknown channels, for directions, and for numbers out of range: ``black`` must be
    below ``white``, ``gamma`` above zero.
    """
    numbers = {"black": black, "white": white, "gamma": gamma, "out_black": out_black, "out_white": out_white}

    def tone_of(form: ChannelFormat) -> Tone:
        low, high, power, below, above = (
            _per_component(form, name, value, _MOST_GAMMA if name == "gamma" else 1.0)
            for name, value in numbers.items()
        )
        if (low >= high).any() or (power <= 0).any():
            raise ArgumentError(
                f"levels of {form.name!r} need black below white and gamma above zero, "
                f"not {low.tolist()}, {high.tolist()} and {power.tolist()}"
            )
        top = _LARGEST if form.dtype.startswith("float") and form.name != ALPHA.name else 1.0

        def tone(values: Float64s) -> Float64s:
            with np.errstate(over="ignore"):  # black may be close to white, or gamma close to zero
                part = np.clip((values - low) / (high - low), 0, top) ** (1 / power)
            return np.asarray(below + (above - below) * np.minimum(part, top))

        return tone

    recorded = {name: as_reals(value, name, (), (-1,)).tolist() for name, value in numbers.items()}
    return _edited(texture, channel, tone_of, "levels", recorded)


def curves(
    texture: OctreeTexture, channel: str | Sequence[str], points: npt.ArrayLike | Sequence[npt.ArrayLike]
) -> OctreeTexture:
    """Return a texture whose encoded values follow a curve through ``points``, as in image editors.

    points    (k, 2): encoded values, 0 … 1, and their results, ascending in the first column; one curve for
              all components, or a list with one for each

    Between the points the curve is the monotone cubic of Fritsch & Carlson (1980); outside it is constant.
    Encoded values are sRGB for light, in any stored type. Averages follow as in ``octex.map``.

    Raises ArgumentError for unknown channels, for directions, and for points of another shape or order.
    """

    def tone_of(form: ChannelFormat) -> Tone:
        by_component = _curves_of(form, points)
        return lambda values: np.stack([*map(_monotone, by_component, values.T)], axis=1)

    recorded = [np.asarray(each).tolist() for each in points] if np.iterable(points) else points
    return _edited(texture, channel, tone_of, "curves", {"points": recorded})


def _edited(
    texture: OctreeTexture,
    channel: str | Sequence[str],
    tone_of: Callable[[ChannelFormat], Tone],
    operation: str,
    recorded: dict[str, Any],
) -> OctreeTexture:
    names = names_of(texture, channel)
    for name in names:
        if texture.channels[name].format.space == "direction":
            raise ArgumentError(f"channel {name!r} holds directions, which have no {operation}")
    return edited(
        texture, names, lambda each: _Toned(each.format, tone_of(each.format)), operation, **recorded
    )


class _Toned:
    """A tone curve on one channel's values; integers use tables and interpolate between codes."""

    def __init__(self, form: ChannelFormat, tone: Tone) -> None:
        self._form, self._tone = form, tone
        self._has_tables = form.dtype.startswith("u")
        if self._has_tables:
            one = ONE[form.dtype]
            codes = np.repeat(np.arange(one + 1)[:, None] / one, form.components, axis=1)
            self._codes = np.ascontiguousarray(np.rint(np.clip(tone(codes), 0, 1) * one).astype(form.dtype).T)
            self._light = decode_table(form.dtype, form.space)
            light = np.repeat(self._light[:, None], form.components, axis=1)
            self._toned_light = self._of(light).astype(np.float32)

    def stored(self, values: Array, _cells: Int64s | None) -> Array:
        """Return mapped stored values."""
        form = self._form
        if not self._has_tables:
            return encode(self._of(decode(values, form.space)), form.dtype, form.space)
        if (self._codes == self._codes[0]).all():  # one table takes half as long
            return np.asarray(self._codes[0][values])
        return np.asarray(self._codes[np.arange(form.components), values])

    def changed(self, _cells: Int64s, values: Float64s, means: Float64s) -> Float64s:
        """Return tone(values) − tone(means)."""
        if not self._has_tables:
            return self._of(values) - self._of(means)
        columns = [
            np.interp(values[:, k], self._light, toned) - np.interp(means[:, k], self._light, toned)
            for k, toned in enumerate(self._toned_light.T)
        ]
        return np.stack(columns, axis=1)

    def _of(self, values: Floats) -> Float64s:
        """Map decoded values; light is encoded by sRGB's curve first."""
        wide = values.astype(np.float64)
        if self._form.space == "data":
            return np.asarray(self._tone(wide))
        return np.asarray(srgb_to_linear(self._tone(linear_to_srgb(wide))), np.float64)


def _per_component(form: ChannelFormat, name: str, value: PerComponent, most: float) -> Float64s:
    numbers = as_reals(value, f"{name} of {form.name!r}", (), (form.components,))
    every = np.broadcast_to(numbers, form.components)
    return np.array([as_number(number, name, 0.0, most) for number in every])


def _curves_of(form: ChannelFormat, points: Any) -> list[Float64s]:
    """Return a curve for each component, or raise ArgumentError."""
    try:
        curves = [as_reals(points, "points", (-1, 2))] * form.components
    except ArgumentError:  # one curve for each component
        try:
            curves = [as_reals(curve, "points", (-1, 2)) for curve in points]
        except (ArgumentError, TypeError):
            curves = []
    if len(curves) != form.components or not all(
        len(curve) and ((curve >= 0) & (curve <= 1)).all() and (np.diff(curve[:, 0]) > 0).all()
        for curve in curves
    ):
        raise ArgumentError(
            f"points of a curve for {form.name!r} must be pairs of encoded values, 0 to 1, in "
            f"ascending order of the first, or a list of them for each of {form.components} components"
        )
    return curves


def _monotone(points: Float64s, values: Float64s) -> Float64s:
    """Evaluate the monotone cubic through points (k, 2) (Fritsch & Carlson 1980)."""
    x, y = points.T
    if len(x) == 1:
        return np.full_like(values, y[0])
    widths = np.diff(x)
    secants = np.diff(y) / widths
    slopes = np.concatenate([secants[:1], (secants[1:] + secants[:-1]) / 2, secants[-1:]])
    slopes[1:-1][secants[1:] * secants[:-1] <= 0] = 0.0
    for k, secant in enumerate(secants):
        if secant == 0:
            slopes[k : k + 2] = 0.0
            continue
        steep = float(np.hypot(*(slopes[k : k + 2] / secant)))
        if steep > 3:
            slopes[k : k + 2] *= 3 / steep
    inside = np.clip(values, x[0], x[-1])
    at = np.clip(np.searchsorted(x, inside, side="right") - 1, 0, len(widths) - 1)
    t = (inside - x[at]) / widths[at]
    rise = secants[at] * widths[at]
    left, right = slopes[at] * widths[at], slopes[at + 1] * widths[at]
    return np.asarray(y[at] + t * (left + t * (3 * rise - 2 * left - right + t * (left + right - 2 * rise))))


def cast(
    texture: OctreeTexture,
    dtype: Dtypes = None,
    channels: Sequence[str] | None = None,
) -> OctreeTexture:
    """Return a texture with other stored types, and optionally only some channels.

    dtype      "uint8", "uint16", "float16" or "float32", for all channels or a dict by name. Floats store
               linear light, integers sRGB
    channels   names of the channels in the result, in this order (default: all)

    Raises ArgumentError for unknown names, and for an integer type if light or data exceed 0 … 1.
    """
    as_texture(texture)
    names = list(texture.channels) if channels is None else as_names(channels, "channels", texture.channels)
    if len(set(names)) < len(names):
        raise ArgumentError(f"channels are named twice: {', '.join(names)}")
    forms = formats_as([texture.channels[name].format for name in names], dtype)
    converted = {form.name: in_format(texture.channels[form.name], form) for form in forms}
    metadata = with_operation(texture.metadata, "cast", channels={form.name: form.dtype for form in forms})
    return texture.with_cells(texture.tree, converted, metadata)


def in_format(channel: Channel, form: ChannelFormat) -> Channel:
    """Return a channel converted to another format of equal component count. Raises ArgumentError."""
    before = channel.format
    if form == before:
        return channel
    arrays = [np.empty(values.shape, form.dtype) for values in channel[1:]]
    for values, recoded in zip(channel[1:], arrays, strict=True):
        for begin in range(0, len(values), _RECODED):
            block = decode(values[begin : begin + _RECODED], before.space)
            check_range(block, before, form.dtype)
            recoded[begin : begin + _RECODED] = encode(block, form.dtype, form.space)
    return Channel(form, *arrays)
