"""Derivatives of the visible surface point by pixel (H. Igehy, "Tracing Ray Differentials", 1999)."""

from __future__ import annotations

import math

from octex.arrays import Float64s
from octex.jit import kernel, part

#: Smallest sine of the angle between a ray and a plane; flatter planes are tilted to it.
_LEAST = 1e-3


@part
def differential(
    eye: Float64s, perspective: bool, x: float, y: float, z: float, a: float, b: float, c: float
) -> tuple[float, float, float, float, float, float]:
    """Return the steps of a visible point, in the world, for one pixel to the right and one down.

    The point moves on a plane.

    eye            (4, 3): position, axis, and the steps of one pixel to the right and down at depth 1
    perspective    True: rays start at the position; False: rays are parallel to the axis
    x, y, z        the point
    a, b, c        the plane's unit normal
    """
    right, down, ahead = eye[1, 0], eye[1, 1], eye[1, 2]
    depth = 1.0
    if perspective:
        right, down, ahead = x - eye[0, 0], y - eye[0, 1], z - eye[0, 2]
        depth = right * eye[1, 0] + down * eye[1, 1] + ahead * eye[1, 2]
        right, down, ahead = right / depth, down / depth, ahead / depth
    facing = a * right + b * down + c * ahead
    least = _LEAST * math.sqrt(right * right + down * down + ahead * ahead)
    if abs(facing) < least:
        facing = math.copysign(least, facing)
    first = (a * eye[2, 0] + b * eye[2, 1] + c * eye[2, 2]) / facing
    second = (a * eye[3, 0] + b * eye[3, 1] + c * eye[3, 2]) / facing
    return (
        depth * (eye[2, 0] - right * first),
        depth * (eye[2, 1] - down * first),
        depth * (eye[2, 2] - ahead * first),
        depth * (eye[3, 0] - right * second),
        depth * (eye[3, 1] - down * second),
        depth * (eye[3, 2] - ahead * second),
    )


@kernel
def differentials(
    eye: Float64s, perspective: bool, points: Float64s, normals: Float64s, right: Float64s, down: Float64s
) -> None:
    """Write the steps (n, 3) of points (n, 3) on planes with normals (n, 3)."""
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        a, b, c = normals[n, 0], normals[n, 1], normals[n, 2]
        ax, ay, az, bx, by, bz = differential(eye, perspective, x, y, z, a, b, c)
        right[n, 0], right[n, 1], right[n, 2] = ax, ay, az
        down[n, 0], down[n, 1], down[n, 2] = bx, by, bz
