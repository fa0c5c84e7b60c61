"""Texels fitted to how maps are read: bilinearly."""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s, Float64s, Uint8s, Uint16s
from octex.channels import srgb8_code, unit_code
from octex.jit import kernel

#: What texels lack of the nearest map that is linear in between, of their second differences along each axis,
#: where they are the values at their middles; and what means over texels lack beyond that. Of a parabola,
#: exactly.
_LACKING, _OF_MEANS = 1.0 / 12.0, 1.0 / 24.0


def lacking(supersample: int, blur: float) -> float:
    """Return the part of the second differences that texels lack.

    They are means of so many lookups along each side, of which each shows what variance a mean over its part
    of the texel has, times ``blur``, 0 … 1.
    """
    part = 1.0 / supersample**2
    return _LACKING + _OF_MEANS * (1.0 - part + part * blur)


@kernel
def fit_rows(values: Float32s, areas: Float32s, part: float, first: int, fitted: Float32s) -> None:
    """Write rows of a map (height, width, lanes), from ``first`` on, fitted to bilinear reading.

    ``values`` lack ``part`` of their second differences (`lacking`). Texels at the map's rim, and those
    beside one of area 0, stay as they are.
    """
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
    fitted: Float32s, lanes: tuple[int, int, int], most: float, is_srgb: bool, half: float, guesses: Uint8s,
    thresholds: Float64s, texels: Uint16s,
) -> None:  # fmt: skip
    """Write lanes of a map, divided by ``most``, as codes of 8 bits to texels of 16 (rows, width, 4).

    ``lanes`` are the first of the values, how many, and the first of the texels. Colours become sRGB, by
    `channels.srgb8_encoder`; what goes from −1 to 1 has ``half`` 0.5, numbers from 0 to 1 have 0.
    """
    lane, count, to = lanes
    scale, over = 1.0 - half, 1.0 / most
    for row in range(texels.shape[0]):
        for k in range(count):
            of, at = np.uint64(lane + k), np.uint64(to + k)
            if is_srgb:
                for column in range(texels.shape[1]):
                    code = srgb8_code(np.float64(fitted[row, column, of]) * over, guesses, thresholds)
                    texels[row, column, at] = np.uint16(257 * code)
            else:
                for column in range(texels.shape[1]):
                    number = unit_code(np.float64(fitted[row, column, of]) * over, scale, half, 255.0)
                    texels[row, column, at] = np.uint16(257 * number)
