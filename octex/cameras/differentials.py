"""Derivatives of the visible surface point by pixel (H. Igehy, "Tracing Ray Differentials", 1999)."""

from __future__ import annotations

import math

from octex.arrays import Float64s
from octex.jit import kernel, part
from octex.source.vectors import Vector, dot_product, length_of, minus, row_of, times

#: Smallest sine of the angle between a ray and a plane; flatter planes are tilted to it.
_LEAST = 1e-3


@part
def differential(eye: Float64s, perspective: bool, point: Vector, normal: Vector) -> tuple[Vector, Vector]:
    """Return the steps of a visible point on a plane, in the world, for one pixel to the right and one down.

    eye            (4, 3): position, axis, and the steps of one pixel to the right and down at depth 1
    perspective    True: rays start at the position; False: rays are parallel to the axis
    normal         the plane's unit normal
    """
    ray, depth = row_of(eye, 1), 1.0
    if perspective:
        toward = minus(point, row_of(eye, 0))
        depth = dot_product(toward, ray)
        ray = (toward[0] / depth, toward[1] / depth, toward[2] / depth)
    facing, least = dot_product(normal, ray), _LEAST * length_of(ray)
    if abs(facing) < least:
        facing = math.copysign(least, facing)
    right, down = row_of(eye, 2), row_of(eye, 3)
    right = minus(right, times(ray, dot_product(normal, right) / facing))
    down = minus(down, times(ray, dot_product(normal, down) / facing))
    return times(right, depth), times(down, depth)


@kernel
def differentials(
    eye: Float64s, perspective: bool, points: Float64s, normals: Float64s, right: Float64s, down: Float64s
) -> None:
    """Write the steps (n, 3) of points (n, 3) on planes with normals (n, 3)."""
    for n in range(len(points)):
        right[n], down[n] = differential(eye, perspective, row_of(points, n), row_of(normals, n))
