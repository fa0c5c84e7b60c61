"""Directions of a surface: unit vectors, normals with tangents, and directions relative to these."""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s
from octex.jit import kernel
from octex.source.corners import Frames
from octex.source.vectors import between, cross_product, dot_product, minus, row_of, times, unit

#: Directions shorter than this point nowhere; squared.
NOWHERE = 1e-12


def turned(directions: Float32s, before: Float64s, after: Float64s) -> Float32s:
    """Return directions (n, 3), turned as unit vectors ``before`` (n, 3) turn straight to ``after``."""
    cosines = np.einsum("nx,nx->n", before, after)[:, None]
    axes = np.cross(before, after)
    along = np.einsum("nx,nx->n", axes, directions)[:, None]
    made = directions * cosines + np.cross(axes, directions) + axes * along / np.maximum(1.0 + cosines, 1e-6)
    return np.asarray(made, np.float32)


def in_tangent_space(
    directions: Float32s, frames: Frames, triangles: Int32s, barycentric: Float64s
) -> Float32s:
    """Return unit directions at rest (n, 3) in triangles' frames (MikkTSpace)."""
    found = np.empty((triangles.size, 3), np.float32)
    _turn_in(directions, *frames.normals, *frames.tangents, triangles, barycentric, found)
    return found


@kernel
def _turn_in(
    directions: Float32s, normals: Float32s, normal_rows: Int32s, tangents: Float32s, tangent_rows: Int32s,
    triangles: Int32s, barycentric: Float64s, found: Float32s,
) -> None:  # fmt: skip
    for n in range(triangles.size):
        triangle, shares = int(triangles[n]), row_of(barycentric, n)
        normal = unit(between(normals, normal_rows, triangle, shares))
        tangent = between(tangents, tangent_rows, triangle, shares)
        tangent = unit(minus(tangent, times(normal, dot_product(normal, tangent))))
        hand = 1.0 if tangents[tangent_rows[triangle, 0], 3] >= 0.0 else -1.0
        direction = row_of(directions, n)
        x = dot_product(direction, tangent)
        y = dot_product(direction, times(cross_product(normal, tangent), hand))
        z = dot_product(direction, normal)
        if x * x + y * y + z * z < NOWHERE:
            x, y, z = 0.0, 0.0, 1.0
        found[n, 0], found[n, 1], found[n, 2] = unit((x, y, z))
