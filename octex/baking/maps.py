"""Channels of a texture at the texels of a map, as the images of a material (glTF 2.0, 3.9)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from octex.arrays import ChannelCodes, Float32s, Float64s, Uint16s
from octex.channels import ALPHA, CHANNELS, decode, encode, srgb_code, srgb_encoder, unit_code
from octex.jit import kernel
from octex.parallel import ordered_map
from octex.source.images.pyramid import Texels
from octex.source.materials import AlphaMode, Input, Texture

#: The images of a material, by the channel that names each: the channels in red, green and blue, and alpha.
IMAGES = {
    "base_color": ("base_color", "alpha"),
    "roughness": ("occlusion", "roughness", "metallic"),
    "emissive": ("emissive",),
    "specular": ("specular",),
    "normal": ("normal",),
}
#: Alpha that is hardly anywhere between these is a mask.
_CLEAR, _SOLID, _MOST_BETWEEN = 0.05, 0.95, 0.1
#: Rows of texels that are encoded at once.
_ENCODED = 8
#: Bits of numbers in maps; those of floats.
Bits = Literal[8, 16, 32]
BITS: tuple[Bits, ...] = (8, 16, 32)
_FLOAT = 32
#: Texels that differ by no more than this are alike, by the bits of a number: cells of 8 bits are rounded.
_ALIKE = {8: 1.001 / 255, 16: 0.0, _FLOAT: 1e-6}
#: What texels lack of the nearest map that is linear in between, of their second differences along each axis,
#: where they are the values at their middles; and what means over texels lack beyond that. Of a parabola,
#: exactly.
_LACKING, _OF_MEANS = 1.0 / 12.0, 1.0 / 24.0


class Values(NamedTuple):
    """Channels at the texels of a map, side by side, linear."""

    lanes: Mapping[str, slice]
    values: Float32s  # (height, width, lanes)
    areas: Float32s  # (height, width)   0 where nothing is shown

    @classmethod
    def of(cls, names: list[str], height: int, width: int) -> Values:
        """Return zeros."""
        ends = np.cumsum([0, *(CHANNELS[name].components for name in names)]).tolist()
        lanes = {name: slice(*each) for name, each in zip(names, pairwise(ends), strict=True)}
        return cls(
            lanes, np.zeros((height, width, ends[-1]), np.float32), np.zeros((height, width), np.float32)
        )

    def channel(self, name: str) -> Float32s:
        """Return one channel (height, width, components)."""
        return self.values[..., self.lanes[name]]


def average(fine: Float32s, covered: Float32s, n: int, values: Float32s, areas: Float32s) -> None:
    """Write the means of n² texels, by how much of each is ``covered``, and how much is of all."""
    for row, column in np.ndindex(n, n):
        part = covered[row::n, column::n]
        areas += part
        values += part[..., None] * fine[row::n, column::n]
    values /= np.where(areas > 0.0, areas, np.float32(1.0))[..., None]
    areas /= np.float32(n * n)


def inputs_of(maps: Values, bits: int, part: float, wrap: int, executor: Executor) -> dict[str, Input]:
    """Return the inputs of materials whose images are maps of channels, with numbers of 8, 16 or 32 bits.

    Texels are fitted to bilinear reading: ``part`` is what they lack (`lacking`). ``wrap`` is how
    coordinates beyond the unit square meet the images. A channel that does not vary is a number, and 1 in an
    image of others.
    """
    inputs: dict[str, Input] = {}
    images: list[tuple[Texels, dict[str, Input]]] = []
    for channels in IMAGES.values():
        given = [name for name in channels if name in maps.lanes]
        if not given:
            continue
        texels: Texels = np.empty((*maps.areas.shape, 4), np.float32 if bits == _FLOAT else np.uint16)
        for name in given:
            form = CHANNELS[name]
            first = 3 if name == ALPHA.name else channels.index(name)
            lanes = tuple(range(first, first + form.components))
            strength = 1.0
            if form.space == "srgb" and bits != _FLOAT:
                strength = max(1.0, float(maps.channel(name).max(initial=0.0)))
            inputs[name] = Input((strength,) * form.components, Texture(texels, wrap, wrap), lanes)
        images.append((texels, {name: inputs[name] for name in given}))
    firsts = range(0, len(maps.areas), _ENCODED)
    list(ordered_map(executor, lambda first: _encode(maps, bits, part, images, first), firsts))
    for texels, made in images:
        for name, read in made.items():
            number = _number(name, read, texels, _ALIKE[bits])
            if number is not None:
                inputs[name] = number
                texels[..., list(read.lanes)] = _one(texels)
    return inputs


def _number(name: str, given: Input, texels: Texels, alike: float) -> Input | None:
    """Return a channel's input without its image; None if texels differ, or glTF has no such number."""
    one, lanes = _one(texels), list(given.lanes)
    fixed = {"normal": (0.5, 0.5, 1.0), "occlusion": (1.0,)}.get(name)
    first = texels[0, 0, lanes] / one if fixed is None else np.array(fixed)
    if not all((np.abs(rows[:, lanes] / one - first) <= alike).all() for rows in texels):
        return None
    if fixed is not None:
        return Input((1.0,) * len(lanes))
    mean = texels[..., lanes].mean(axis=(0, 1), dtype=np.float64)
    if texels.dtype == np.float32:
        return Input(tuple(mean.tolist()))
    values = decode(np.rint(mean).astype(np.uint16), CHANNELS[name].space)
    return Input(tuple((values * given.factor).tolist()))


def _one(texels: Texels) -> float:
    """Return what texels have where a channel is 1."""
    return 1.0 if texels.dtype == np.float32 else 65535.0


def _encode(
    maps: Values, bits: int, part: float, images: Sequence[tuple[Texels, Mapping[str, Input]]], first: int
) -> None:
    """Write rows of images, from one on, that inputs read: fitted, as codes of so many bits or floats."""
    end = min(first + _ENCODED, len(maps.areas))
    fitted = np.empty((end - first, *maps.values.shape[1:]), np.float32)
    fit_rows(maps.values, maps.areas, part, first, fitted)
    for texels, inputs in images:
        rows = texels[first:end]
        used = set()
        for name, given in inputs.items():
            space, strength, own = CHANNELS[name].space, given.factor[0], maps.lanes[name]
            lane, count = given.lanes[0], len(given.lanes)
            lanes = slice(lane, lane + count)
            used |= {*given.lanes}
            if bits == 8:
                half = 0.5 if space == "direction" else 0.0
                coder = space == "srgb", half, *srgb_encoder("uint8")
                put_codes(fitted, (own.start, count, lane), strength, *coder, rows.view(np.uint16))
            elif bits == 16:
                rows[..., lanes] = encode(fitted[..., own] / strength, "uint16", space)
            elif space == "direction":
                rows[..., lanes] = 0.5 * fitted[..., own] + 0.5
            else:
                rows[..., lanes] = np.maximum(fitted[..., own], 0.0)
        for lane in {*range(4)} - used:
            rows[..., lane] = _one(texels)


def lacking(supersample: int, blur: float) -> float:
    """Return the part of second differences that texels, means of lookups blurred by ``blur``, lack."""
    part = 1.0 / supersample**2
    return _LACKING + _OF_MEANS * (1.0 - part + part * blur)


@kernel
def fit_rows(values: Float32s, areas: Float32s, part: float, first: int, fitted: Float32s) -> None:
    """Write rows of a map (height, width, lanes) fitted to bilinear reading; rims stay. See `lacking`."""
    height, width, lanes = values.shape
    numbers, lacks, across = values.reshape(-1), np.float32(part), width * lanes
    for row in range(fitted.shape[0]):
        fitted[row] = values[first + row]
        if not 0 < first + row < height - 1 or width < 3:
            continue
        begin, count = (first + row) * across, across - 2 * lanes
        left, here, right = numbers[begin:], numbers[begin + lanes :], numbers[begin + 2 * lanes :]
        above, below = numbers[begin + lanes - across :], numbers[begin + lanes + across :]
        made = fitted[row].reshape(-1)[lanes:]
        for n in range(count):
            sides = (left[n] + right[n]) + (above[n] + below[n])
            made[n] = here[n] - lacks * (sides - np.float32(4.0) * here[n])
        for column in range(1, width - 1):
            least = min(areas[first + row, column - 1], areas[first + row, column + 1])
            least = min(least, min(areas[first + row - 1, column], areas[first + row + 1, column]))
            if not min(least, areas[first + row, column]) > np.float32(0.0):
                for lane in range(lanes):
                    fitted[row, column, lane] = values[first + row, column, lane]


@kernel
def put_codes(
    fitted: Float32s, lanes: tuple[int, int, int], most: float, is_srgb: bool, half: float,
    guesses: ChannelCodes, thresholds: Float64s, texels: Uint16s,
) -> None:  # fmt: skip
    """Write lanes of a map, divided by ``most``, as codes of 8 bits to texels of 16 (rows, width, 4).

    ``lanes`` are the first of the values, how many, and the first of the texels. Colours become sRGB, by
    `channels.srgb_encoder`; what goes from −1 to 1 has ``half`` 0.5, numbers from 0 to 1 have 0.
    """
    lane, count, to = lanes
    scale, over = 1.0 - half, 1.0 / most
    for row in range(texels.shape[0]):
        for k in range(count):
            of, at = np.uint64(lane + k), np.uint64(to + k)
            if is_srgb:
                for column in range(texels.shape[1]):
                    code = srgb_code(np.float64(fitted[row, column, of]) * over, guesses, thresholds)
                    texels[row, column, at] = np.uint16(257 * code)
            else:
                for column in range(texels.shape[1]):
                    number = unit_code(np.float64(fitted[row, column, of]) * over, scale, half, 255.0)
                    texels[row, column, at] = np.uint16(257 * number)


def alpha_mode(alpha: Float32s) -> AlphaMode:
    """Return how alpha counts: not at all if it is 1 all over, as a mask if hardly any is between."""
    if float(alpha.min(initial=1.0)) > 254 / 255:
        return "opaque"
    translucent = alpha < 1.0
    between = (alpha > _CLEAR) & (alpha < _SOLID)
    return "mask" if between.sum() <= _MOST_BETWEEN * translucent.sum() else "blend"
