"""Lenses: distort and undistort normalised coordinates (x/z, y/z).

Lenses with a > 0 first map the radius r = √(x² + y²) to atan(a·r) / ω. Then all lenses distort:

    radial   (1 + k1·s + k2·s² + k3·s³ + k4·s⁴) / (1 + d1·s + d2·s² + d3·s³),  s = x² + y²
    x        x·radial + 2·p1·x·y + p2·(s + 2·x²) + sx·s
    y        y·radial + p1·(s + 2·y²) + 2·p2·x·y + sy·s
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from octex.arrays import Float64s
from octex.jit import inlined, kernel

#: Meaning of the coefficients: see `octex.Camera`. Those of ``fisheye`` are of angles instead of slopes; ω of
#: ``fov`` is that of Devernay & Faugeras, "Straight Lines Have to Be Straight" (2001).
DistortionModel = Literal["opencv", "fisheye", "fov"]
DISTORTION_MODELS: tuple[DistortionModel, ...] = get_args(DistortionModel)
#: Allowed numbers of coefficients.
COUNTS: dict[DistortionModel, tuple[int, ...]] = {"opencv": (2, 4, 5, 8), "fisheye": (4, 8), "fov": (1,)}

# Indices into a lens's numbers (14,).
_A, _OMEGA, _K, _D, _P, _S, _REACH = 0, 1, 2, 6, 9, 11, 13

#: Bounds of Newton's method in `undistort`.
_MOST_STEPS = 100
_LEAST_STEP = 1e-6
_ROUNDING = 2.0**-51
_CONVERGED = 1e-12


def lens_numbers(model: DistortionModel, distortion: Sequence[float]) -> Float64s:
    """Return a, ω (0: no bending of angles), k1 … k4, d1 … d3, p1, p2, sx, sy and the squared reach, (14,).

    The reach is the radius where the distorted radius stops rising; the lens would fold points beyond it
    back.
    """
    numbers = np.zeros(14)
    coefficients = list(distortion)
    if model == "fov":
        if coefficients[0] != 0.0:
            numbers[_A], numbers[_OMEGA] = 2.0 * math.tan(coefficients[0] / 2.0), coefficients[0]
    elif model == "fisheye":
        if len(coefficients) == 4:
            coefficients = [*coefficients[:2], 0.0, 0.0, *coefficients[2:], 0.0, 0.0]
        numbers[_A] = numbers[_OMEGA] = 1.0
        numbers[_K : _K + 4] = *coefficients[:2], *coefficients[4:6]
        numbers[_P : _P + 2], numbers[_S : _S + 2] = coefficients[2:4], coefficients[6:8]
    else:
        coefficients = [*coefficients, *[0.0] * (8 - len(coefficients))]
        numbers[_K : _K + 3] = *coefficients[:2], coefficients[4]
        numbers[_D : _D + 3] = coefficients[5:8]
        numbers[_P : _P + 2] = coefficients[2:4]
    until = _rising_until(numbers[_K : _K + 4], numbers[_D : _D + 3])
    if numbers[_OMEGA] != 0.0 and until < math.inf:
        angle = math.sqrt(until) * numbers[_OMEGA]
        until = (math.tan(angle) / numbers[_A]) ** 2 if angle < math.pi / 2 else math.inf
    numbers[_REACH] = until
    return numbers


def _rising_until(k: Float64s, d: Float64s) -> float:
    """Return the s = r² up to which r · radial(s) rises and is finite."""
    over, under = np.poly1d([*k[::-1], 1.0]), np.poly1d([*d[::-1], 1.0])
    s = np.poly1d([2.0, 0.0])
    slope = (over + s * over.deriv()) * under - s * over * under.deriv()
    # In 1/s, where both begin with 1: the least numbers overflow nothing.
    roots = np.concatenate([np.roots(each.coeffs[::-1]) for each in (slope, under)])
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
    return 1.0 / float(real.max()) if real.size else math.inf


@kernel
def is_bent(lens: Float64s) -> bool:
    """Return whether a lens moves any point."""
    return bool(lens[:_REACH].any())


@inlined
def distorted(lens: Float64s, x: float, y: float) -> tuple[float, float]:
    """Return distorted coordinates; NaN at and beyond the lens's reach."""
    square = x * x + y * y
    if not square < lens[_REACH]:
        return np.nan, np.nan
    if lens[_OMEGA] != 0.0:
        bent = _bent(lens, square)
        x, y = x * bent, y * bent
        square = x * x + y * y
    radial = 1.0 + square * (
        lens[_K] + square * (lens[_K + 1] + square * (lens[_K + 2] + square * lens[_K + 3]))
    )
    radial /= 1.0 + square * (lens[_D] + square * (lens[_D + 1] + square * lens[_D + 2]))
    p1, p2 = lens[_P], lens[_P + 1]
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x) + lens[_S] * square,
        y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y + lens[_S + 1] * square,
    )


@inlined
def _bent(lens: Float64s, square: float) -> float:
    """Return atan(a·r) / (ω·r)."""
    r = np.sqrt(square)
    if r < 1e-9:
        return float(lens[_A] / lens[_OMEGA])
    return float(np.arctan(lens[_A] * r) / (lens[_OMEGA] * r))


@inlined
def _slopes(lens: Float64s, x: float, y: float) -> tuple[float, float, float, float]:
    """Return the Jacobian of `distorted`: dx/dx, dx/dy, dy/dx, dy/dy."""
    square = x * x + y * y
    bent = along = 1.0  # scale across the radius and along it
    r = np.sqrt(square)
    if lens[_OMEGA] != 0.0:
        a = lens[_A]
        bent, along = _bent(lens, square), a / (lens[_OMEGA] * (1.0 + a * a * square))
    ux, uy = (x / r, y / r) if r > 1e-9 else (1.0, 0.0)
    axx = bent + (along - bent) * ux * ux
    axy = (along - bent) * ux * uy
    ayy = bent + (along - bent) * uy * uy
    x, y = x * bent, y * bent
    s = x * x + y * y
    k1, k2, k3, k4 = lens[_K], lens[_K + 1], lens[_K + 2], lens[_K + 3]
    d1, d2, d3 = lens[_D], lens[_D + 1], lens[_D + 2]
    over, under = 1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))), 1.0 + s * (d1 + s * (d2 + s * d3))
    of_over = k1 + s * (2.0 * k2 + s * (3.0 * k3 + s * 4.0 * k4))
    of_under = d1 + s * (2.0 * d2 + s * 3.0 * d3)
    radial = over / under
    slope = 2.0 * (of_over - radial * of_under) / under
    p1, p2, sx, sy = lens[_P], lens[_P + 1], lens[_S], lens[_S + 1]
    bxx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * sx * x
    bxy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * sx * y
    byx = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * sy * x
    byy = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * sy * y
    return (bxx * axx + bxy * axy, bxx * axy + bxy * ayy, byx * axx + byy * axy, byx * axy + byy * ayy)


@kernel
def distort(lens: Float64s, points: Float64s, out: Float64s) -> None:
    """Write the distorted coordinates of points (n, 2)."""
    for n in range(len(points)):
        out[n, 0], out[n, 1] = distorted(lens, points[n, 0], points[n, 1])


@kernel
def undistort(lens: Float64s, distorted_points: Float64s, out: Float64s) -> None:
    """Write the points that a lens maps to ``distorted_points`` (n, 2); NaN for points without one.

    Newton's method from the image centre. It halves a step that does not come closer or that leaves the
    lens's domain.
    """
    for n in range(len(distorted_points)):
        u, v = distorted_points[n, 0], distorted_points[n, 1]
        size = 1.0 + max(abs(u), abs(v))
        x = y = 0.0
        error_x, error_y = u, v
        part = 1.0
        for _ in range(_MOST_STEPS):
            xx, xy, yx, yy = _slopes(lens, x, y)
            area = xx * yy - xy * yx
            if area == 0.0:
                break
            trial_x = x + part * (yy * error_x - xy * error_y) / area
            trial_y = y + part * (xx * error_y - yx * error_x) / area
            trial_u, trial_v = distorted(lens, trial_x, trial_y)
            if np.hypot(u - trial_u, v - trial_v) < np.hypot(error_x, error_y):
                x, y, error_x, error_y = trial_x, trial_y, u - trial_u, v - trial_v
                part = 1.0
            else:
                part *= 0.5
            if max(abs(error_x), abs(error_y)) <= _ROUNDING * size or part <= _LEAST_STEP:
                break
        is_converged = max(abs(error_x), abs(error_y)) <= _CONVERGED * size
        out[n, 0] = x if is_converged else np.nan
        out[n, 1] = y if is_converged else np.nan
