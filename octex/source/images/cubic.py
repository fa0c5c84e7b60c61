"""Weights of the spline of Catmull and Rom: less blurred between texels than linear ones."""

from __future__ import annotations

import numpy as np

from octex.jit import inlined


@inlined
def catmull_rom(t: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return the weights of four texels, for a point 0 ≤ t < 1 from the second to the third."""
    half, one = np.float32(0.5), np.float32(1.0)
    square, s = t * t, one - t
    return (
        -half * t * s * s,
        one - half * square * (np.float32(5.0) - np.float32(3.0) * t),
        half * t * (one + np.float32(4.0) * t - np.float32(3.0) * square),
        -half * square * s,
    )
