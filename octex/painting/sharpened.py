"""Pictures sharpened, so that what is read between their pixels' centres has the pixels as its means.

A pixel is the mean of what it covers, in photographs as in what is rendered. Read as if that stood at its
centre, pictures lose up to 0.6 of their finest detail, and what is painted from them is too soft. Noise would
be more than half again as strong, and is left as it is.
"""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s
from octex.jit import inlined, kernel

#: The inverse of what the mean over a pixel makes of the spline of Catmull and Rom, (−1, 7.2, 64.4, 7.2, −1)
#: / 76.8, along one axis: what pixels 1, 2 and 3 away count for. What follows sums to 0.0003.
_TAPS = (-0.14336, 0.03579, -0.00638)

_LIMIT = np.float32(4.0)

#: What noise of 1 in pixels makes of what sharpening adds to one, along one axis.
_GAIN = float(np.sqrt(2 * sum(tap**2 for tap in _TAPS) + (2 * sum(_TAPS)) ** 2))
#: What is added is noise where it is less than so many deviations of that, and partly so where it is more.
_DEVIATIONS = 3.0
#: Noise is what is added in the quietest tenth of patches of so many pixels each way, which is 1.2 times less
#: than the mean; of fewer patches it is not known.
_PATCH, _QUIETEST, _LESS, _FEWEST = 8, 0.1, 1.2, 16
#: No noise is taken to be stronger, of 1: what is as strong all over a picture may be gravel or grass.
_MOST = 5.0 / 255.0
#: Light outside of this may be cut off: of 2 and 250 of 255 codes.
_DARKEST, _LIGHTEST = np.float32(0.0006), np.float32(0.955)


def sharpened(pixels: Float32s, is_light: bool = True) -> Float32s:
    """Return pixels (height, width, 4), colours times alpha, as values at their centres.

    Nothing is sharpened across another alpha, by more than four times the difference to a neighbour, or by
    less than noise: as strong as in the picture's quietest tenth, 5 of 255 at most.
    """
    noise = np.float32(min(noise_of(pixels, is_light), _MOST))
    return _sharpened(_sharpened(pixels, 0, 1, noise, is_light), 1, 0, noise, is_light)


def noise_of(pixels: Float32s, is_light: bool = True) -> float:
    """Return the deviation of noise in pixels (height, width, 4), colours times alpha; 0 if not known."""
    patches = _loudness(pixels, is_light)
    known = patches[patches >= 0.0]
    if known.size < _FEWEST:
        return 0.0
    return float(_LESS * np.sqrt(np.quantile(known, _QUIETEST)) / _GAIN)


@kernel
def _loudness(pixels: Float32s, is_light: bool) -> Float32s:
    """Return the mean square of what sharpening adds to patches (rows, columns, 3); −1 if clipped."""
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
    """Return the square of what a value times alpha changes by as the value, or a light's root, does by 1."""
    return np.float32(4.0) * max(here, np.float32(0.0)) * alpha if is_light else alpha * alpha


@inlined
def _change(
    pixels: Float32s, row: int, column: int, part: int, down: int, right: int
) -> tuple[np.float32, np.float32]:
    """Return what sharpening along one axis adds to a pixel, and the most that it may."""
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
