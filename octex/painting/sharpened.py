"""Sharpens images, so that interpolated values average to the pixels.

A pixel is the average over the area that it covers. Interpolation between such averages loses up to 0.6 of
the finest detail. Sharpening removes this blur, but would amplify noise by more than half, so noise stays.
"""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s
from octex.jit import inlined, kernel

#: Weights of pixels 1, 2 and 3 away along one axis: the inverse of a pixel's average over the spline of
#: Catmull and Rom, (−1, 7.2, 64.4, 7.2, −1) / 76.8. The omitted weights sum to 0.0003.
_NEXT, _SECOND, _THIRD = np.float32(-0.14336), np.float32(0.03579), np.float32(-0.00638)

_LIMIT = np.float32(4.0)

#: Deviation of the change along one axis for noise of deviation 1.
_GAIN = float(
    np.sqrt(2 * (_NEXT**2 + _SECOND**2 + _THIRD**2) + 4 * (_NEXT + _SECOND + _THIRD) ** 2, dtype=np.float64)
)
#: Deviations of noise up to which a change is dropped.
_DEVIATIONS = 3.0
#: Noise is measured in the quietest tenth of square patches, of so many pixels each way, where it is 1.2
#: times less than its mean; and the least number of patches.
_PATCH, _QUIETEST, _LESS, _FEWEST = 8, 0.1, 1.2, 16
#: Largest noise: stronger variation all over an image may be gravel or grass.
_MOST = 5.0 / 255.0
#: Range of light, 2/255 to 250/255 in sRGB, outside of which it may be clipped.
_DARKEST, _LIGHTEST = np.float32(0.0006), np.float32(0.955)


def sharpen(pixels: Float32s, is_light: bool = True) -> None:
    """Make pixels (height, width, 4), colours times alpha, values at their centres, in place.

    Sharpening stops at changes of alpha. A change is at most four times the smaller difference to a
    neighbour, and is dropped below the noise of the image's quietest tenth, 5/255 at most.
    """
    sharpen_above(pixels, min(noise_of(pixels, is_light), _MOST), is_light)


def noise_of(pixels: Float32s, is_light: bool = True) -> float:
    """Return the deviation of noise in pixels (height, width, 4), colours times alpha; 0 if unknown."""
    patches = _loudness(pixels, is_light)
    known = patches[np.isfinite(patches)]
    if known.size < _FEWEST:
        return 0.0
    return float(_LESS * np.sqrt(np.quantile(known, _QUIETEST)) / _GAIN)


@kernel
def _loudness(pixels: Float32s, is_light: bool) -> Float32s:
    """Return the mean square of the change of patches (rows, columns, 3); infinity for clipped ones."""
    rows, columns = pixels.shape[0] // _PATCH, pixels.shape[1] // _PATCH
    loudness = np.zeros((rows, columns, 3), np.float32)
    line = np.full((4, pixels.shape[1] + 6), np.float32(-1.0))
    loud = np.empty(columns * _PATCH, np.float32)
    for row in range(rows * _PATCH):
        _read(pixels, row, line)
        a = line[3]
        for part in range(3):
            v = line[part]
            for column in range(columns * _PATCH):
                value, alpha = v[column + 3], a[column + 3]
                neighbours = _beside(v, a, column)
                change, _ = _change(value, alpha, neighbours)
                is_known = _DARKEST * alpha < value < _LIGHTEST * alpha
                loud[column] = change * change / _square(value, alpha, is_light) if is_known else np.inf
            for column in range(columns * _PATCH):
                loudness[row // _PATCH, column // _PATCH, part] += loud[column] / np.float32(_PATCH * _PATCH)
    return loudness


@kernel
def sharpen_above(pixels: Float32s, noise: float, is_light: bool) -> None:
    """Sharpen along rows, and these sharpened rows along columns, in place."""
    height, width = pixels.shape[0], pixels.shape[1]
    least = np.float32((_DEVIATIONS * _GAIN * noise) ** 2)
    line = np.full((4, width + 6), np.float32(-1.0))
    latest = np.empty((7, 4, width), np.float32)  # sharpened rows, by their numbers modulo 7
    latest[:, 3] = np.float32(-1.0)
    for row in range(height + 3):
        new = latest[row % 7]
        new[3] = np.float32(-1.0)
        if row < height:
            _read(pixels, row, line)
            a = line[3]
            new[3] = a[3 : width + 3]
            for part in range(3):
                v = line[part]
                for column in range(width):
                    neighbours = _beside(v, a, column)
                    new[part, column] = _sharper(v[column + 3], a[column + 3], neighbours, least, is_light)
        middle = row - 3
        if middle < 0:
            continue
        p, q, r = latest[(middle + 6) % 7], latest[(middle + 5) % 7], latest[(middle + 4) % 7]
        s, t, u = latest[(middle + 1) % 7], latest[(middle + 2) % 7], latest[(middle + 3) % 7]
        row_values = latest[middle % 7]
        for part in range(3):
            for n in range(width):
                neighbours = (
                    (p[part, n], p[3, n]), (q[part, n], q[3, n]), (r[part, n], r[3, n]),
                    (s[part, n], s[3, n]), (t[part, n], t[3, n]), (u[part, n], u[3, n]),
                )  # fmt: skip
                line[part, n] = _sharper(row_values[part, n], row_values[3, n], neighbours, least, is_light)
        for n in range(width):
            for part in range(3):
                pixels[middle, n, part] = line[part, n]


#: Pixels 1, 2 and 3 before another, and after: values times alpha, and alpha.
Near = tuple[tuple[np.float32, np.float32], ...]


@inlined
def _read(pixels: Float32s, row: int, line: Float32s) -> None:
    """Write a row of pixels to a line (4, width + 6); three before and after it have an alpha of −1."""
    for column in range(pixels.shape[1]):
        for part in range(4):
            line[part, column + 3] = pixels[row, column, part]


@inlined
def _beside(v: Float32s, a: Float32s, column: int) -> Near:
    """Return the pixels beside one in a line, whose values are v, and alphas a."""
    n = column + 3
    return (
        (v[n - 1], a[n - 1]), (v[n - 2], a[n - 2]), (v[n - 3], a[n - 3]),
        (v[n + 1], a[n + 1]), (v[n + 2], a[n + 2]), (v[n + 3], a[n + 3]),
    )  # fmt: skip


@inlined
def _square(value: np.float32, alpha: np.float32, is_light: bool) -> np.float32:
    """Return the squared derivative of a value times alpha by the value, or by the square root of light."""
    return np.float32(4.0) * max(value, np.float32(0.0)) * alpha if is_light else alpha * alpha


@inlined
def _difference(value: np.float32, alpha: np.float32, neighbour: tuple[np.float32, np.float32]) -> np.float32:
    return neighbour[0] - value if neighbour[1] == alpha else np.float32(0.0)


@inlined
def _change(value: np.float32, alpha: np.float32, neighbours: Near) -> tuple[np.float32, np.float32]:
    """Return the change of a pixel by sharpening along one axis, and its limit."""
    p, q, r, s, t, u = neighbours
    before, after = _difference(value, alpha, p), _difference(value, alpha, s)
    change = _NEXT * (before + after)
    change += _SECOND * (_difference(value, alpha, q) + _difference(value, alpha, t))
    change += _THIRD * (_difference(value, alpha, r) + _difference(value, alpha, u))
    most = min(
        _LIMIT * abs(before) if p[1] == alpha else np.float32(np.inf),
        _LIMIT * abs(after) if s[1] == alpha else np.float32(np.inf),
    )
    return change, most


@inlined
def _sharper(
    value: np.float32, alpha: np.float32, neighbours: Near, least: np.float32, is_light: bool
) -> np.float32:
    """Return a pixel's value after sharpening along one axis; changes with squares of ``least`` are noise."""
    change, most = _change(value, alpha, neighbours)
    noisy = least * _square(value, alpha, is_light)
    change = change - noisy / change if change * change > noisy else np.float32(0.0)
    return value + min(max(change, -most), most)
