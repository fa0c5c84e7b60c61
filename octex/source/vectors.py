"""Vectors of three numbers in kernels, and edges and points of triangles."""

from __future__ import annotations

import math

from octex.arrays import Array, Int32s
from octex.jit import inlined

Vector = tuple[float, float, float]


@inlined
def dot_product(a: Vector, b: Vector) -> float:
    """Return a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def cross_product(a: Vector, b: Vector) -> Vector:
    """Return a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def minus(a: Vector, b: Vector) -> Vector:
    """Return a − b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined
def plus(a: Vector, b: Vector, share: float) -> Vector:
    """Return a + share · b."""
    return a[0] + share * b[0], a[1] + share * b[1], a[2] + share * b[2]


@inlined
def times(a: Vector, factor: float) -> Vector:
    """Return a times a number."""
    return a[0] * factor, a[1] * factor, a[2] * factor


@inlined
def length_of(a: Vector) -> float:
    """Return |a|."""
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@inlined
def unit(a: Vector) -> Vector:
    """Return a / |a|, zeros for zeros."""
    length = length_of(a)
    return times(a, 1.0 / length if length > 0.0 else 0.0)


@inlined
def row_of(values: Array, row: int) -> Vector:
    """Return a row of an array."""
    return float(values[row, 0]), float(values[row, 1]), float(values[row, 2])


@inlined
def edges_from(positions: Array, triangles: Int32s, triangle: int) -> tuple[Vector, Vector]:
    """Return the edges of a triangle from its first corner, whose cross product is its normal."""
    origin = row_of(positions, triangles[triangle, 0])
    second, third = row_of(positions, triangles[triangle, 1]), row_of(positions, triangles[triangle, 2])
    return minus(second, origin), minus(third, origin)


@inlined
def between(values: Array, rows: Int32s, triangle: int, shares: Vector) -> Vector:
    """Interpolate between the rows of a triangle's corners."""
    a, b, c = rows[triangle, 0], rows[triangle, 1], rows[triangle, 2]
    return (
        shares[0] * values[a, 0] + shares[1] * values[b, 0] + shares[2] * values[c, 0],
        shares[0] * values[a, 1] + shares[1] * values[b, 1] + shares[2] * values[c, 1],
        shares[0] * values[a, 2] + shares[1] * values[b, 2] + shares[2] * values[c, 2],
    )
