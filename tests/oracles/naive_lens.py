"""Lenses as OpenCV's and COLMAP's documentation write them, a point at a time."""

from __future__ import annotations

from collections.abc import Sequence
from math import atan, atan2, sqrt, tan

import numpy as np
import numpy.typing as npt


def through(model: str, lens: Sequence[float], x: float, y: float) -> npt.NDArray[np.float64]:
    """Return where a lens of a model of COLMAP's puts the slopes x, y."""
    if model in ("SIMPLE_PINHOLE", "PINHOLE"):
        return np.array([x, y])
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        k1, k2 = (*lens, 0.0)[:2]
        r2 = x**2 + y**2
        return np.array([x, y]) * (1 + k1 * r2 + k2 * r2**2)
    if model in ("OPENCV", "FULL_OPENCV"):
        k1, k2, p1, p2, k3, k4, k5, k6 = (*lens, 0, 0, 0, 0)[:8]
        r2 = x**2 + y**2
        radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        return np.array(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
                y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
            ]
        )
    r = sqrt(x * x + y * y)
    if model == "FOV":
        (omega,) = lens
        return np.array([x, y]) * (atan(2 * r * tan(omega / 2)) / (omega * r))
    theta = atan2(r, 1.0)
    u, v = x / r * theta, y / r * theta
    if model == "THIN_PRISM_FISHEYE":
        k1, k2, p1, p2, k3, k4, sx1, sy1 = lens
        radial = k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8
        return np.array(
            [
                u + u * radial + 2 * p1 * u * v + p2 * (theta**2 + 2 * u**2) + sx1 * theta**2,
                v + v * radial + 2 * p2 * u * v + p1 * (theta**2 + 2 * v**2) + sy1 * theta**2,
            ]
        )
    k1, k2, k3, k4 = (*lens, 0, 0, 0)[:4]
    theta_d = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    return np.array([x, y]) * (theta_d / r)
