"""Attributes of triangle corners."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Float32s, Float64s, Int32s, Int64s, Integers


class Corners(NamedTuple):
    """An attribute of triangle corners: rows of values, and the row of each corner."""

    values: Float32s  # (rows, components)
    rows: Int32s  # (triangles, 3)

    @classmethod
    def joined(cls, attributes: Sequence[Corners]) -> Corners:
        """Return one attribute for the concatenated triangles of several."""
        if len(attributes) == 1:
            return attributes[0]
        values, rows = stacked(attributes)
        return cls(values, np.concatenate(rows))

    @classmethod
    def chosen(cls, attributes: Sequence[Corners], numbers: Int64s) -> Corners:
        """Return an attribute that triangle i takes from ``attributes[numbers[i]]``."""
        values, rows = stacked(attributes)
        return cls(values, np.stack(rows)[numbers, np.arange(len(numbers))])

    @classmethod
    def of_triangles(cls, values: Float32s, rows: Integers) -> Corners:
        """Return an attribute that is constant on each triangle, with its row in ``rows`` (m,)."""
        return cls(values, np.repeat(rows.astype(np.int32), 3).reshape(-1, 3))

    def of(self, triangles: Int32s) -> Corners:
        """Return the attribute of chosen triangles (k,)."""
        return Corners(self.values, self.rows[triangles])

    def at(self, triangles: Int32s, barycentric: Float64s) -> Float64s:
        """Return the values (n, components) at points of triangles (n,)."""
        return at_corners(self.values, self.rows[triangles], barycentric)


def stacked(attributes: Sequence[Corners]) -> tuple[Float32s, list[Int32s]]:
    """Return the values of all attributes in one array, and each attribute's rows in that array."""
    firsts = np.cumsum([0, *(len(values) for values, _ in attributes)])
    rows = [rows + np.int32(first) for (_, rows), first in zip(attributes, firsts, strict=False)]
    return np.concatenate([values for values, _ in attributes]), rows


def area_vectors(corners: Float64s) -> Float64s:
    """Return the normals (m, 3) of triangles with corners (m, 3, 3), each twice the area long."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


#: Least doubled area of a triangle, over the square of its longest edge.
_THINNEST = 1e-12


def has_area(corners: Float64s) -> Bools:
    """Say which triangles with corners (m, 3, 3) have an area."""
    longest = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=2).max(axis=1)
    return np.asarray(np.linalg.norm(area_vectors(corners), axis=1) > _THINNEST * longest)


def unit_normals(corners: Float64s) -> Float64s:
    """Return the unit normals of triangles (m, 3); zeros without area."""
    return unit(area_vectors(corners))


def unit(vectors: Float64s) -> Float64s:
    """Return vectors (n, 3) of length 1; zeros stay."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(lengths > 0, lengths, 1.0), np.float64)


def at_corners(values: Array, rows: Integers, barycentric: Float64s) -> Float64s:
    """Interpolate (n, components) between the values in the rows (n, 3) of three corners."""
    return np.asarray(np.einsum("nc,ncx->nx", barycentric, values[rows]))


def scattered(areas: Float64s, count: int, seed: int) -> tuple[Int64s, Float64s]:
    """Draw points, uniform by the areas of triangles (m,): their triangles (n,), and barycentric (n, 3)."""
    random = np.random.default_rng(seed).random((count, 3))
    cumulative = np.cumsum(areas)
    triangles = np.searchsorted(cumulative, random[:, 0] * cumulative[-1], side="right")
    root = np.sqrt(random[:, 1])
    barycentric = np.stack([1 - root, root * (1 - random[:, 2]), root * random[:, 2]], axis=1)
    return np.minimum(triangles, len(areas) - 1), barycentric


class Polygons(NamedTuple):
    """The polygons that triangles were cut from."""

    numbers: Int32s  # (triangles,)     the polygon of each triangle, in the file's order
    corners: Int32s  # (triangles, 3)   which corner of its polygon each corner is, from 0

    @classmethod
    def of_triangles(cls, count: int) -> Polygons:
        """Return polygons of ``count`` triangles, each its own polygon."""
        corners = np.broadcast_to(np.arange(3, dtype=np.int32), (count, 3))
        return cls(np.arange(count, dtype=np.int32), corners)

    @classmethod
    def joined(cls, parts: Sequence[tuple[Polygons | None, int]]) -> Polygons | None:
        """Return the polygons of concatenated parts, numbered consecutively; None if no part has any."""
        if all(polygons is None for polygons, _ in parts):
            return None
        numbers, corners, first = [], [], 0
        for polygons, count in parts:
            part = polygons or cls.of_triangles(count)
            numbers.append(part.numbers + np.int32(first))
            corners.append(part.corners)
            first = int(numbers[-1].max()) + 1
        return cls(np.concatenate(numbers), np.concatenate(corners))

    def loops(self) -> tuple[Int32s, Int64s, Int64s, Int64s]:
        """Return the polygons and their corners, concatenated.

        That is the numbers of the polygons (k,); their numbers of corners (k,); for each polygon corner (c,)
        its first triangle corner, 0 … 3·m − 1; and for each triangle corner (m, 3) its polygon corner.
        """
        keys = self.numbers[:, None].astype(np.int64) << 32 | self.corners
        keys, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
        numbers, sizes = np.unique((keys >> 32).astype(np.int32), return_counts=True)
        return numbers, sizes.astype(np.int64), first.astype(np.int64), inverse.reshape(-1, 3)

    def of(self, triangles: Int32s) -> Polygons:
        """Return the polygons of chosen triangles (k,); they keep their numbers."""
        return Polygons(self.numbers[triangles], self.corners[triangles])


class Creases(NamedTuple):
    """Sharp edges and corners of a subdivision surface, for ``subdivide``.

    edges      (k, 2): pairs of vertices
    sharpness  (k,) of the edges: 0 is smooth, 10 or more is sharp at every level
    vertices   (j,) numbers of vertices
    spikes     (j,) the sharpness of these vertices
    """

    edges: Int32s
    sharpness: Float32s
    vertices: Int32s
    spikes: Float32s


class Frames(NamedTuple):
    """Shading normals and tangents at triangle corners, unit vectors."""

    normals: Corners  # x, y, z
    tangents: Corners  # x, y, z, and the handedness w: the bitangent is w · (normal × tangent)

    def of(self, triangles: Int32s) -> Frames:
        """Return the attribute of chosen triangles (k,)."""
        return Frames(self.normals.of(triangles), self.tangents.of(triangles))


def across(normals: Float64s) -> Float64s:
    """Return unit vectors (n, 3) at right angles to normals (n, 3)."""
    return unit(np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))))


def frames_of(normals: Float64s, rows: Int32s) -> Frames:
    """Return frames of unit normals (n, 3), by corner, with tangents of any direction."""
    tangents = np.ones((len(normals), 4), np.float32)
    tangents[:, :3] = across(normals)
    return Frames(Corners(normals.astype(np.float32), rows), Corners(tangents, rows))
