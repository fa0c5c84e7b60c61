"""The meaning of a channel's stored numbers: type, components, colour space, and the value of 1.0.

Values are averaged, filtered and blended in linear light. Only this module encodes and decodes them.
"""

from __future__ import annotations

import re
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, ChannelCodes, Float32s, Float64s, Floats, Uint16s
from octex.errors import ArgumentError
from octex.jit import inlined, kernel

#: ``srgb``: stored with the sRGB transfer curve; ``linear``: light, as it is; ``data``: not light;
#: ``direction``: a mean of unit vectors, in unsigned integers (x + 1) / 2.
ColorSpace = Literal["srgb", "linear", "data", "direction"]
COLOR_SPACES: tuple[ColorSpace, ...] = ("srgb", "linear", "data", "direction")

#: The stored number that means 1.0.
ONE = {"uint8": 255.0, "uint16": 65535.0, "float16": 1.0, "float32": 1.0}


class ChannelFormat(NamedTuple):
    """The stored form of a named channel."""

    name: str
    components: int
    space: ColorSpace
    dtype: str = "uint8"


BASE_COLOR = ChannelFormat("base_color", 3, "srgb")
ALPHA = ChannelFormat("alpha", 1, "data")
METALLIC = ChannelFormat("metallic", 1, "data")
ROUGHNESS = ChannelFormat("roughness", 1, "data")
OCCLUSION = ChannelFormat("occlusion", 1, "data")
EMISSIVE = ChannelFormat("emissive", 3, "srgb")
SPECULAR = ChannelFormat("specular", 3, "srgb")
NORMAL = ChannelFormat("normal", 3, "direction")
HEIGHT = ChannelFormat("height", 1, "data")
DETAIL = ChannelFormat("detail", 1, "data")

#: Weights of the components in a colour's luminance (ITU-R BT.709).
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])

#: The least alpha weight in averages, so that a transparent cell's colour is still a mean.
LEAST_COVERAGE = 2.0**-40

#: Largest rounding error above 1 or below 0: a quarter of a code of 16 bits.
_ROUNDING = 2.0**-18

_MATERIAL = BASE_COLOR, ALPHA, METALLIC, ROUGHNESS, OCCLUSION, EMISSIVE, SPECULAR, NORMAL
#: The channels of materials, with glTF's names, in a texture's order.
MATERIAL_CHANNELS = tuple(form.name for form in _MATERIAL)
#: All known channels: also relief, and one that sets the resolution of the others, 1 for the finest.
CHANNELS = {form.name: form for form in (*_MATERIAL, HEIGHT, DETAIL)}


#: Separates a channel's name from its layer's.
_IN = "\0in "


def channel_in(layer: str, name: str) -> str:
    """Return the stored name of a layer's channel."""
    return name + _IN + layer


def plain_name(name: str) -> str:
    """Return a channel's name without its layer."""
    return name.partition(_IN)[0]


def alpha_of(name: str) -> str | None:
    """Return the name of the channel that weights averages of a channel; None for alpha itself."""
    plain, mark, layer = name.partition(_IN)
    return None if plain == ALPHA.name else ALPHA.name + mark + layer


def srgb_to_linear(encoded: npt.ArrayLike) -> Float64s:
    """Decode sRGB values in 0 … 1 to linear light (IEC 61966-2-1)."""
    encoded = np.asarray(encoded, np.float64)
    return np.where(
        encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.04045) + 0.055) / 1.055) ** 2.4
    )


def linear_to_srgb(linear: npt.ArrayLike) -> Float64s:
    """Encode linear light in 0 … 1 as sRGB values (IEC 61966-2-1)."""
    linear = np.asarray(linear, np.float64)
    return np.where(
        linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    )


def screen_color(text: str) -> tuple[int, int, int] | None:
    """Return the red, green and blue codes of the sRGB colour #rrggbb; None for other text."""
    if not re.fullmatch("#[0-9a-fA-F]{6}", text):
        return None
    red, green, blue = bytes.fromhex(text[1:])
    return red, green, blue


def color_in_light(text: str, form: ChannelFormat) -> Float32s:
    """Return the linear light (3,) of the sRGB colour #rrggbb, or raise ArgumentError."""
    codes = screen_color(text)
    if codes is None:
        raise ArgumentError(f"{text!r} is not a colour '#rrggbb', like '#ff0000'")
    if form.components != 3 or form.space not in ("srgb", "linear"):
        raise ArgumentError(f"{form.name!r} holds no colours, so {text!r} has no meaning; give numbers")
    return decode(np.array(codes, np.uint8), "srgb")


def check_range(values: Floats, form: ChannelFormat, dtype: str, name: str = "") -> None:
    """Raise ArgumentError for float values that ``dtype`` cannot hold; messages begin with ``name``."""
    if not dtype.startswith("u") or not form.dtype.startswith("float") or form.space == "direction":
        return
    for is_beyond, where in ((values > 1 + _ROUNDING, "above 1"), (values < -_ROUNDING, "below 0")):
        if is_beyond.any():
            raise ArgumentError(
                f"{name}{': ' * bool(name)}channel {form.name!r} has values {where}, which {dtype} cannot "
                "hold; give it the dtype float16 or float32"
            )


@cache
def decode_table(dtype: str, space: ColorSpace) -> Float32s:
    """Return the decoded value of every code of an unsigned integer dtype."""
    codes = np.arange(int(ONE[dtype]) + 1) / ONE[dtype]
    if space == "srgb":
        codes = srgb_to_linear(codes)
    elif space == "direction":
        codes = 2.0 * codes - 1.0
    return codes.astype(np.float32)


def code_table(dtype: np.dtype[Any], space: ColorSpace) -> Float32s:
    """Return the table of uint8 or uint16; ``dtype.name`` takes longer than decoding a few values."""
    return decode_table("uint8" if dtype.itemsize == 1 else "uint16", space)


def decode(stored: Array, space: ColorSpace) -> Float32s:
    """Return stored values as float32: linear light for colours, −1 … 1 for directions."""
    if stored.dtype.kind == "u":
        return code_table(stored.dtype, space)[stored]
    values = stored.astype(np.float32)
    return srgb_to_linear(values).astype(np.float32) if space == "srgb" else values


def encode(values: Floats, dtype: str, space: ColorSpace) -> Array:
    """Return values (linear light for colours) as stored numbers of the same shape, rounded to nearest.

    Integers clamp to 0 … 1, directions to −1 … 1; floats stop at their largest finite number. NaN becomes the
    stored number 0.
    """
    if space == "srgb" and dtype.startswith("float"):
        values = linear_to_srgb(values)
    flat = np.ascontiguousarray(values, np.float64).reshape(-1)
    codes = np.empty(flat.size, dtype)
    if dtype == "float32":
        largest = float(np.finfo(np.float32).max)
        np.clip(flat, -largest, largest, out=codes, casting="same_kind")
        codes[codes != codes] = 0.0
    elif dtype == "float16":
        _encode_half(flat, codes.view(np.uint16))
    elif space != "srgb":
        half = 0.5 if space == "direction" else 0.0
        _encode_unit(flat, 1.0 - half, half, ONE[dtype], codes)
    else:
        _encode_srgb(flat, *srgb_encoder(dtype), codes)
    return codes.reshape(np.shape(values))


# The kernels below take 0.5 to 0.7 ns a value in vectors; sRGB 1.5 in 8 bits, 3 in 16 (a power takes 25).


@inlined
def _unit(value: float) -> float:
    """Clamp to 0 … 1, and NaN to 0."""
    positive = value if value > 0.0 else 0.0
    return positive if positive < 1.0 else 1.0


@kernel
def _encode_unit(values: Float64s, scale: float, shift: float, one: float, codes: ChannelCodes) -> None:
    """Write value · scale + shift, clamped to 0 … 1, as integers of which ``one`` stands for 1."""
    for i in range(values.size):
        codes[i] = np.int32(np.rint(_unit(values[i] * scale + shift) * one))


@kernel
def _encode_half(values: Float64s, codes: Uint16s) -> None:
    """Write the bits of float16, ties to even: sign, 5 bits of exponent (bias 15), 10 of mantissa."""
    for i in range(values.size):
        value = values[i] if values[i] == values[i] else 0.0
        sign = np.float64(value).view(np.int64) >> 48 & 0x8000
        size = np.float64(min(abs(value), 65504.0))
        bits = size.view(np.int64)
        rounded = (bits + ((1 << 41) - 1) + (bits >> 42 & 1) >> 42) - (1023 - 15 << 10)
        # Below 2⁻¹⁴ they are multiples of 2⁻²⁴, the last bit of a float64 that lies above 2²⁸.
        small = np.float64(size + 2.0**28).view(np.int64) & 0xFFFF
        codes[i] = sign | (rounded if size >= 2.0**-14 else small)


@cache
def srgb_encoder(dtype: str) -> tuple[ChannelCodes, Float64s]:
    """Return a first guess of the code by bin of linear light, and the upper limit of light of each code."""
    last, bins = int(ONE[dtype]), _SRGB_BINS[dtype]
    thresholds = srgb_to_linear((np.arange(last) + 0.5) / last)
    below = np.bincount(np.ceil(thresholds * bins).astype(np.int64), minlength=bins + 1)
    return np.cumsum(below).astype(dtype), np.append(thresholds, np.inf)


#: The curve's steepest part crosses less than one code a bin, so that the guess is at most one short.
_SRGB_BINS = {"uint8": 1 << 12, "uint16": 1 << 20}


@kernel
def _encode_srgb(values: Float64s, guesses: ChannelCodes, thresholds: Float64s, codes: ChannelCodes) -> None:
    """Write linear light as sRGB codes; ``guesses`` and ``thresholds`` are those of `srgb_encoder`."""
    for i in range(values.size):
        light = _unit(values[i])
        guess = np.uint64(guesses[np.uint64(np.int64(light * (guesses.size - 1)))])
        codes[i] = np.int64(guess) + (light >= thresholds[guess])
