"""What a channel's stored numbers mean: type, components, colour space, and the value of 1.0.

Values are averaged, filtered and blended in linear light; encoding and decoding happen here and nowhere else.
"""

from __future__ import annotations

from functools import cache
from typing import Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from octex.jit import kernel

#: ``srgb``: stored with the sRGB transfer curve; ``linear``: light, as it is; ``data``: not light;
#: ``direction``: a mean of unit vectors, in unsigned integers (x + 1) / 2.
ColorSpace = Literal["srgb", "linear", "data", "direction"]
COLOR_SPACES: tuple[ColorSpace, ...] = ("srgb", "linear", "data", "direction")

#: The stored number that means 1.0.
ONE = {"uint8": 255.0, "uint16": 65535.0, "float16": 1.0, "float32": 1.0}


class ChannelFormat(NamedTuple):
    """How a named channel is stored."""

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

#: The channels of materials, with glTF's names, in the order in which a texture holds them.
CHANNELS = {
    form.name: form
    for form in (BASE_COLOR, ALPHA, METALLIC, ROUGHNESS, OCCLUSION, EMISSIVE, SPECULAR, NORMAL)
}


def srgb_to_linear(encoded: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Decode sRGB values in 0 … 1 to linear light (IEC 61966-2-1)."""
    encoded = np.asarray(encoded, np.float64)
    return np.where(
        encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.04045) + 0.055) / 1.055) ** 2.4
    )


def linear_to_srgb(linear: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Encode linear light in 0 … 1 as sRGB values (IEC 61966-2-1)."""
    linear = np.asarray(linear, np.float64)
    return np.where(
        linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    )


@cache
def decode_table(dtype: str, space: ColorSpace) -> npt.NDArray[np.float32]:
    """Return the decoded value of every code of an unsigned integer dtype."""
    codes = np.arange(int(ONE[dtype]) + 1) / ONE[dtype]
    return (srgb_to_linear(codes) if space == "srgb" else codes).astype(np.float32)


def decode(stored: npt.NDArray[np.generic], space: ColorSpace) -> npt.NDArray[np.float32]:
    """Return stored values as float32: linear light for colours."""
    name = stored.dtype.name
    if name in ("uint8", "uint16"):
        return cast("npt.NDArray[np.float32]", decode_table(name, space)[stored])
    values = stored.astype(np.float32)
    return srgb_to_linear(values).astype(np.float32) if space == "srgb" else values


def encode(values: npt.NDArray[np.floating], dtype: str, space: ColorSpace) -> npt.NDArray[np.generic]:
    """Return values (linear light for colours) as stored numbers, rounded to nearest.

    Integers clamp to 0 … 1 and take NaN as 0; float16 stops at its largest finite number.
    """
    if dtype == "uint8" and space == "srgb":
        flat = np.ascontiguousarray(values, np.float64).reshape(-1)
        return _encode_srgb8(flat, *_srgb8_encoder()).reshape(values.shape)
    encoded = linear_to_srgb(values) if space == "srgb" else values
    if dtype in ("uint8", "uint16"):
        unit = np.fmin(np.fmax(encoded, 0.0), 1.0)
        scaled: npt.NDArray[np.generic] = np.rint(unit * ONE[dtype]).astype(dtype)
        return scaled
    largest = np.finfo(dtype).max
    return np.clip(encoded, -largest, largest).astype(dtype)


_ENCODER_BINS = 4096


@cache
def _srgb8_encoder() -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float64]]:
    """Return a first guess by bin of linear light, and the light at which each code gives way to the next."""
    thresholds = np.append(srgb_to_linear((np.arange(255) + 0.5) / 255), np.inf)
    guesses = np.searchsorted(thresholds, np.arange(_ENCODER_BINS) / _ENCODER_BINS, side="right")
    return guesses.astype(np.uint8), thresholds


@kernel
def _encode_srgb8(
    values: npt.NDArray[np.float64], guesses: npt.NDArray[np.uint8], thresholds: npt.NDArray[np.float64]
) -> npt.NDArray[np.uint8]:
    # The curve's steepest part crosses less than one code a bin, so the guess is at most one short.
    codes = np.empty(values.size, np.uint8)
    for i in range(values.size):
        value = values[i]
        clamped = value if value > 0.0 else 0.0  # NaN too
        clamped = clamped if clamped < 1.0 else 1.0
        code = np.int64(guesses[min(int(clamped * _ENCODER_BINS), _ENCODER_BINS - 1)])
        while clamped >= thresholds[code]:
            code += 1
        codes[i] = code
    return codes
