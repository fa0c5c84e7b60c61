"""Turns directions, and expresses them in tangent space."""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s
from octex.jit import kernel
from octex.source.corners import Frames
from octex.source.tangents import axes_at
from octex.source.vectors import dot_product, row_of, times, unit

#: Squared length below which a direction counts as missing.
NOWHERE = 1e-12


def rotated(directions: Float32s, before: Float64s, after: Float64s) -> Float32s:
    """Rotate directions (n, 3) by the shortest rotation from unit vectors ``before`` to ``after`` (n, 3)."""
    cosines = np.einsum("nx,nx->n", before, after)[:, None]
    axes = np.cross(before, after)
    along = np.einsum("nx,nx->n", axes, directions)[:, None]
    vectors = directions * cosines + np.cross(axes, directions)
    return np.asarray(vectors + axes * along / np.maximum(1.0 + cosines, 1e-6), np.float32)


def in_tangent_space(
    directions: Float32s, frames: Frames, triangles: Int32s, barycentric: Float64s
) -> Float32s:
    """Return directions at rest (n, 3) as unit vectors in the triangles' tangent frames (MikkTSpace)."""
    vectors = np.empty((triangles.size, 3), np.float32)
    _into_frames(directions, frames, triangles, barycentric, vectors)
    return vectors


@kernel
def _into_frames(
    directions: Float32s, frames: Frames, triangles: Int32s, barycentric: Float64s, vectors: Float32s
) -> None:
    for n in range(triangles.size):
        tangent, bitangent, normal, handedness = axes_at(frames, int(triangles[n]), row_of(barycentric, n))
        direction = row_of(directions, n)
        x = dot_product(direction, tangent)
        y = dot_product(direction, times(bitangent, handedness))
        z = dot_product(direction, normal)
        if x * x + y * y + z * z < NOWHERE:
            x, y, z = 0.0, 0.0, 1.0
        vectors[n, 0], vectors[n, 1], vectors[n, 2] = unit((x, y, z))
