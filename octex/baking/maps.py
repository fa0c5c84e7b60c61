"""Turns channels at the texels of a map into the images of a material (glTF 2.0, 3.9)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from octex.arrays import Float32s
from octex.channels import ALPHA, CHANNELS, decode, encode
from octex.jit import kernel
from octex.parallel import ordered_map
from octex.source.images.pyramid import Texels
from octex.source.materials import AlphaMode, Input, Texture

#: The images of a material, each named by a channel: the channels in red, green and blue, and alpha.
IMAGES = {
    "base_color": ("base_color", "alpha"),
    "roughness": ("occlusion", "roughness", "metallic"),
    "emissive": ("emissive",),
    "specular": ("specular",),
    "normal": ("normal",),
}
#: Alpha is a mask if at most this part of its translucent texels lies between the two values.
_CLEAR, _SOLID, _MOST_BETWEEN = 0.05, 0.95, 0.1
#: Averages of colours may exceed 1 by this much: their weights are rounded.
_ROUNDING = 1e-5
#: Rows of texels that are encoded at once.
_ENCODED = 8
#: Bits per number in maps; 32 are floats.
Bits = Literal[8, 16, 32]
BITS: tuple[Bits, ...] = (8, 16, 32)
_FLOAT = 32
#: Texels that differ by at most this are equal, by bits: 8-bit cells are rounded.
_ALIKE = {8: 1.001 / 255, 16: 0.0, _FLOAT: 1e-6}
#: Parts of second differences that a map needs on top of its texels, along each axis, to read bilinearly like
#: the field: of point samples, and additionally of means over texels. Exact for parabolas.
_LACKING, _OF_MEANS = 1.0 / 12.0, 1.0 / 24.0


class MapValues(NamedTuple):
    """Linear channels at the texels of a map, side by side."""

    lanes: Mapping[str, slice]
    values: Float32s  # (height, width, lanes)
    areas: Float32s  # (height, width)   0 where nothing is drawn

    @classmethod
    def of(cls, names: list[str], height: int, width: int) -> MapValues:
        """Allocate zeros."""
        ends = np.cumsum([0, *(CHANNELS[name].components for name in names)]).tolist()
        lanes = {name: slice(*span) for name, span in zip(names, pairwise(ends), strict=True)}
        values = np.zeros((height, width, ends[-1]), np.float32)
        return cls(lanes, values, np.zeros((height, width), np.float32))

    def channel(self, name: str) -> Float32s:
        """Return one channel (height, width, components)."""
        return self.values[..., self.lanes[name]]


def average(fine: Float32s, covered: Float32s, n: int, values: Float32s, areas: Float32s) -> None:
    """Write the means of n² texels, weighted by ``covered``, and the covered part of the texel."""
    for row, column in np.ndindex(n, n):
        part = covered[row::n, column::n]
        areas += part
        values += part[..., None] * fine[row::n, column::n]
    values /= np.where(areas > 0.0, areas, np.float32(1.0))[..., None]
    areas /= np.float32(n * n)


def inputs_of(maps: MapValues, bits: int, part: float, wrap: int, executor: Executor) -> dict[str, Input]:
    """Return the inputs of materials, read from images of channels with 8, 16 or 32 bits.

    Texels are fitted to bilinear reading; ``part`` is as in `lacking`. ``wrap`` is the images' wrap mode. A
    constant channel becomes a number, and 1 in an image of other channels.
    """
    inputs: dict[str, Input] = {}
    images: list[tuple[Texels, dict[str, Input]]] = []
    for channels in IMAGES.values():
        present = [name for name in channels if name in maps.lanes]
        if not present:
            continue
        texels: Texels = np.empty((*maps.areas.shape, 4), np.float32 if bits == _FLOAT else np.uint16)
        for name in present:
            form = CHANNELS[name]
            first = 3 if name == ALPHA.name else channels.index(name)
            lanes = tuple(range(first, first + form.components))
            strength = 1.0
            if form.space == "srgb" and bits != _FLOAT:
                most = float(maps.channel(name).max(initial=0.0))
                strength = most if most > 1.0 + _ROUNDING else 1.0
            inputs[name] = Input((strength,) * form.components, Texture(texels, wrap, wrap), lanes)
        images.append((texels, {name: inputs[name] for name in present}))
    firsts = range(0, len(maps.areas), _ENCODED)
    list(ordered_map(executor, lambda first: _encode(maps, bits, part, images, first), firsts))
    for texels, image_inputs in images:
        for name, item in image_inputs.items():
            number = _constant_input(name, item, texels, _ALIKE[bits])
            if number is not None:
                inputs[name] = number
                texels[..., list(item.lanes)] = _full_value(texels)
    return inputs


def _constant_input(name: str, item: Input, texels: Texels, alike: float) -> Input | None:
    """Return a constant channel's input, a number; None if texels differ, or glTF has no such number."""
    one, lanes = _full_value(texels), list(item.lanes)
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
    return Input(tuple((values * item.factor).tolist()))


def _full_value(texels: Texels) -> float:
    """Return the texel value that stands for 1."""
    return 1.0 if texels.dtype == np.float32 else 65535.0


def _encode(
    maps: MapValues, bits: int, part: float, images: Sequence[tuple[Texels, Mapping[str, Input]]], first: int
) -> None:
    """Write rows of images from ``first`` on: fitted texels as integers of ``bits`` bits, or as floats."""
    end = min(first + _ENCODED, len(maps.areas))
    fitted = np.empty((end - first, *maps.values.shape[1:]), np.float32)
    fit_rows(maps.values, maps.areas, part, first, fitted)
    for texels, inputs in images:
        rows = texels[first:end]
        written = set()
        for name, item in inputs.items():
            space, strength, columns = CHANNELS[name].space, item.factor[0], maps.lanes[name]
            lanes = slice(item.lanes[0], item.lanes[0] + len(item.lanes))
            written |= {*item.lanes}
            if bits == 8:
                codes = encode(np.float64(1.0 / strength) * fitted[..., columns], "uint8", space)
                np.multiply(codes, np.uint16(257), out=rows[..., lanes])
            elif bits == 16:
                rows[..., lanes] = encode(fitted[..., columns] / strength, "uint16", space)
            elif space == "direction":
                rows[..., lanes] = 0.5 * fitted[..., columns] + 0.5
            else:
                rows[..., lanes] = np.maximum(fitted[..., columns], 0.0)
        for lane in {*range(4)} - written:
            rows[..., lane] = _full_value(texels)


def lacking(supersample: int, blur: float) -> float:
    """Return the part of second differences to add to texels, means of lookups blurred by ``blur``."""
    part = 1.0 / supersample**2
    return _LACKING + _OF_MEANS * (1.0 - part + part * blur)


@kernel
def fit_rows(values: Float32s, areas: Float32s, part: float, first: int, fitted: Float32s) -> None:
    """Write rows of a map (height, width, lanes) fitted to bilinear reading, except rims; see `lacking`."""
    height, width, lanes = values.shape
    numbers, lacks, across = values.reshape(-1), np.float32(part), width * lanes
    for row in range(fitted.shape[0]):
        fitted[row] = values[first + row]
        if not 0 < first + row < height - 1 or width < 3:
            continue
        begin, count = (first + row) * across, across - 2 * lanes
        left, middle, right = numbers[begin:], numbers[begin + lanes :], numbers[begin + 2 * lanes :]
        above, below = numbers[begin + lanes - across :], numbers[begin + lanes + across :]
        row_fitted = fitted[row].reshape(-1)[lanes:]
        for n in range(count):
            sides = (left[n] + right[n]) + (above[n] + below[n])
            row_fitted[n] = middle[n] - lacks * (sides - np.float32(4.0) * middle[n])
        for column in range(1, width - 1):
            least = min(areas[first + row, column - 1], areas[first + row, column + 1])
            least = min(least, min(areas[first + row - 1, column], areas[first + row + 1, column]))
            if not min(least, areas[first + row, column]) > np.float32(0.0):
                for lane in range(lanes):
                    fitted[row, column, lane] = values[first + row, column, lane]


def alpha_mode(alpha: Float32s) -> AlphaMode:
    """Return the alpha mode: opaque if all are 1, mask if few texels lie between, else blend."""
    if float(alpha.min(initial=1.0)) > 254 / 255:
        return "opaque"
    translucent = alpha < 1.0
    between = (alpha > _CLEAR) & (alpha < _SOLID)
    return "mask" if between.sum() <= _MOST_BETWEEN * translucent.sum() else "blend"
