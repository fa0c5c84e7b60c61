"""Nearest points by a look at every triangle and every point, for comparison."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


def nearest_on_triangles(
    vertices: Array, faces: Array, points: Array, directions: Array | None, distance: float, cosine: float
) -> Array:
    """How far each point is from the nearest triangle that has area and agrees; infinity if none is near."""
    found = np.full(len(points), np.inf)
    for face in faces:
        a, b, c = vertices[face]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length <= 1e-12 * ((np.max([a, b, c], axis=0) - np.min([a, b, c], axis=0)) ** 2).sum():
            continue
        normal = normal / length
        apart = np.min([to_segment(points, *ends) for ends in ((a, b), (b, c), (c, a))], axis=0)
        height = (points - a) @ normal
        foot = points - height[:, None] * normal
        inside = np.all(
            [(np.cross(q - p, foot - p) @ normal) >= 0 for p, q in ((a, b), (b, c), (c, a))], axis=0
        )
        apart = np.where(inside, np.abs(height), apart)
        agrees = True if directions is None else directions @ normal.astype(np.float32) >= cosine
        found = np.where(agrees & (apart < found), apart, found)
    return np.where(found <= distance, found, np.inf)


def to_segment(points: Array, a: Array, b: Array) -> Array:
    """How far points are from a segment."""
    along = np.clip((points - a) @ (b - a) / max((b - a) @ (b - a), 1e-300), 0, 1)
    distances: Array = np.linalg.norm(points - a - along[:, None] * (b - a), axis=1)
    return distances


def around(
    positions: Array,
    values: Array,
    normals: Array,
    places: Array,
    radii: Array,
    directions: Array | None,
    nearest: float | None,
    cosine: float,
) -> tuple[Array, Array]:
    """Means of the values around places, and where there are any."""
    means, found = np.zeros((len(places), values.shape[1])), np.zeros(len(places), bool)
    for n, (place, radius) in enumerate(zip(places, radii, strict=True)):
        apart = np.linalg.norm(positions - place, axis=1)
        agrees = np.ones(len(positions), bool) if directions is None else normals @ directions[n] >= cosine
        weights = agrees * np.clip(1 - (apart / radius) ** 2 if radius else 0 * apart, 0, None) ** 2
        if weights.sum() > 0:
            means[n], found[n] = weights @ values / weights.sum(), True
        elif nearest is not None and agrees.any():
            best = np.flatnonzero(agrees)[np.argmin(apart[agrees])]
            if apart[best] <= nearest:
                means[n], found[n] = values[best], True
    return means, found
