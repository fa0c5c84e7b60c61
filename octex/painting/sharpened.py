"""Sharpens pictures, so that interpolated values average to the pixels.

A pixel is the average over the area that it covers. Interpolation between such averages loses up to 0.6 of
the finest detail. Sharpening removes this blur, but would amplify noise by more than half, so noise stays.
"""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s
from octex.jit import inlined, kernel

#: Weights of pixels 1, 2 and 3 away along one axis: the inverse of a pixel's average over the spline of
#: Catmull and Rom, (−1, 7.2, 64.4, 7.2, −1) / 76.8. The omitted weights sum to 0.0003.
_TAPS = (-0.14336, 0.03579, -0.00638)

_LIMIT = np.float32(4.0)

#: Deviation of the change along one axis for noise of deviation 1.
_GAIN = float(np.sqrt(2 * sum(tap**2 for tap in _TAPS) + (2 * sum(_TAPS)) ** 2))
#: Deviations of noise up to which a change is dropped.
_DEVIATIONS = 3.0
#: Noise is measured in the quietest tenth of square patches, of so many pixels each way, where it is 1.2
#: times less than its mean; and the least number of patches.
_PATCH, _QUIETEST, _LESS, _FEWEST = 8, 0.1, 1.2, 16
#: Largest noise: stronger variation all over a picture may be gravel or grass.
_MOST = 5.0 / 255.0
#: Range of light, 2/255 to 250/255 in sRGB, outside of which it may be clipped.
_DARKEST, _LIGHTEST = np.float32(0.0006), np.float32(0.955)


def sharpened(pixels: Float32s, is_light: bool = True) -> Float32s:
    """Return pixels (height, width, 4), colours times alpha, as values at their centres.

    Sharpening stops at changes of alpha. A change is at most four times the smaller difference to a
    neighbour, and is dropped below the noise of the picture's quietest tenth, 5/255 at most.
    """
    noise = np.float32(min(noise_of(pixels, is_light), _MOST))
    return _sharpened(_sharpened(pixels, 0, 1, noise, is_light), 1, 0, noise, is_light)


def noise_of(pixels: Float32s, is_light: bool = True) -> float:
    """Return the deviation of noise in pixels (height, width, 4), colours times alpha; 0 if unknown."""
    patches = _loudness(pixels, is_light)
    known = patches[patches >= 0.0]
    if known.size < _FEWEST:
        return 0.0
    return float(_LESS * np.sqrt(np.quantile(known, _QUIETEST)) / _GAIN)


@kernel
def _loudness(pixels: Float32s, is_light: bool) -> Float32s:
    """Return the mean square of the change of patches (rows, columns, 3); −1 for clipped ones."""
    rows, columns = pixels.shape[0] // _PATCH, pixels.shape[1] // _PATCH
    found = np.full((rows, columns, 3), np.float32(-1.0))
    for i in range(rows):
        for j in range(columns):
            for part in range(3):
                total, is_known = 0.0, True
                for row in range(i * _PATCH, (i + 1) * _PATCH):
                    for column in range(j * _PATCH, (j + 1) * _PATCH):
                        here, alpha = pixels[row, column, part], pixels[row, column, 3]
                        if not _DARKEST * alpha < here < _LIGHTEST * alpha:
                            is_known = False
                            break
                        change, _ = _change(pixels, row, column, part, 0, 1)
                        total += float(change * change / _square(here, alpha, is_light))
                    if not is_known:
                        break
                if is_known:
                    found[i, j, part] = total / (_PATCH * _PATCH)
    return found


@kernel
def _sharpened(pixels: Float32s, down: int, right: int, noise: np.float32, is_light: bool) -> Float32s:
    """Sharpen along one axis."""
    height, width = pixels.shape[0], pixels.shape[1]
    found = pixels.copy()
    least = np.float32((_DEVIATIONS * _GAIN * noise) ** 2)
    for row in range(height):
        for column in range(width):
            alpha = pixels[row, column, 3]
            if not alpha > 0:
                continue
            for part in range(3):
                here = pixels[row, column, part]
                change, most = _change(pixels, row, column, part, down, right)
                noisy = least * _square(here, alpha, is_light)
                change = change - noisy / change if change * change > noisy else np.float32(0.0)
                found[row, column, part] = here + min(max(change, -most), most)
    return found


@inlined
def _square(here: np.float32, alpha: np.float32, is_light: bool) -> np.float32:
    """Return the squared derivative of a value times alpha by the value, or by the square root of light."""
    return np.float32(4.0) * max(here, np.float32(0.0)) * alpha if is_light else alpha * alpha


@inlined
def _change(
    pixels: Float32s, row: int, column: int, part: int, down: int, right: int
) -> tuple[np.float32, np.float32]:
    """Return the change of a pixel by sharpening along one axis, and its limit."""
    here, alpha = pixels[row, column, part], pixels[row, column, 3]
    change, most = np.float32(0.0), np.float32(np.inf)
    for step in range(1, 4):
        for side in range(2):
            away = step if side else -step
            j, i = row + down * away, column + right * away
            if 0 <= j < pixels.shape[0] and 0 <= i < pixels.shape[1] and pixels[j, i, 3] == alpha:
                difference = pixels[j, i, part] - here
                change += np.float32(_TAPS[step - 1]) * difference
                if step == 1:
                    most = min(most, _LIMIT * abs(difference))
    return change, most
