"""Boxes, spheres and other parts of models, in pieces that are put together."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from manifold3d import Manifold

from octex.source.surface import Surface
from tests.make.painted import together

Array = npt.NDArray[Any]
Mesh = tuple[Array, Array]


def mesh_of(solid: Manifold) -> Mesh:
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, np.int32)


def cube(low: npt.ArrayLike, side: float = 1.0) -> Mesh:
    return mesh_of(Manifold.cube([side] * 3).translate(np.asarray(low, float).tolist()))


def sphere(center: npt.ArrayLike, radius: float, segments: int = 48) -> Mesh:
    return mesh_of(Manifold.sphere(radius, segments).translate(np.asarray(center, float).tolist()))


def inside_out(mesh: Mesh) -> Mesh:
    return mesh[0], mesh[1][:, ::-1]


def open_cube(low: npt.ArrayLike, side: float = 1.0) -> Mesh:
    points, triangles = cube(low, side)
    return points, triangles[2:]


def torn(mesh: Mesh) -> Mesh:
    """The same triangles, each with vertices of its own."""
    return mesh[0][mesh[1]].reshape(-1, 3), np.arange(mesh[1].size, dtype=np.int32).reshape(-1, 3)


def colored(*meshes: Mesh) -> Surface:
    """Parts in one surface, each in a colour of its own."""
    points, triangles = together(*meshes)
    counts = [len(mesh[0]) for mesh in meshes]
    hues = np.random.default_rng(1).random((len(meshes), 3))
    return Surface.from_arrays(points, triangles, colors=np.repeat(hues, counts, axis=0), name="parts")
