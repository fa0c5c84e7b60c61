"""USD's basic shapes as polygons: cubes, planes and solids of revolution.

Round shapes have ``_AROUND`` sides, within 0.12 % of their radius.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from pxr import UsdGeom

from octex.arrays import Array, Float64s, Int64s

_AROUND = 64
#: The columns of coordinates, and their signs, that turn a shape's z axis to another one.
_AXES = {"X": ([2, 1, 0], [1, 1, -1]), "Y": ([0, 2, 1], [1, 1, -1]), "Z": ([0, 1, 2], [1, 1, 1])}
_CUBE = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]


def shape_polygons(prim: Any, time: Any) -> tuple[Float64s, Int64s, Int64s] | None:
    """Return a shape's points (n, 3), face sizes and corners; None for other prims.

    Faces are counter-clockwise from outside.
    """
    kind = prim.GetTypeName()
    if kind not in ("Cube", "Sphere", "Plane", "Cylinder", "Cone", "Capsule"):
        return None

    def value(name: str) -> Any:
        return prim.GetAttribute(name).Get(time)

    if kind == "Cube":
        points = np.stack([np.arange(8) >> axis & 1 for axis in range(3)], axis=1) - 0.5
        return points * value("size"), np.full(6, 4), np.ravel(_CUBE)
    if kind == "Plane":
        square = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
        points = square * [value("width"), value("length"), 0.0]
        return _turned(points, value("axis")), np.full(1, 4), np.arange(4)
    radius, axis = value("radius"), UsdGeom.Tokens.z if kind == "Sphere" else value("axis")
    half = 0.0 if kind == "Sphere" else value("height") / 2.0
    if kind == "Cone":
        outline = np.array([[0.0, -half], [radius, -half], [0.0, half]])
    elif kind == "Cylinder":
        outline = np.array([[0.0, -half], [radius, -half], [radius, half], [0.0, half]])
    else:
        turn = np.linspace(-np.pi / 2.0, 0.0, _AROUND // 4 + 1)
        lower = np.stack([np.cos(turn), np.sin(turn)], axis=1) * radius - [0.0, half]
        upper = lower[::-1] * [1.0, -1.0]
        outline = np.concatenate([lower, upper if half else upper[1:]])
    points, sizes, corners = _revolved(outline)
    return _turned(points, axis), sizes, corners


def _turned(points: Float64s, axis: str) -> Float64s:
    columns, signs = _AXES[axis]
    return points[:, columns] * np.array(signs, np.float64)


def _revolved(outline: Float64s) -> tuple[Float64s, Int64s, Int64s]:
    """Turn an outline (n, 2) of radii and heights about z; it starts and ends on the axis."""
    angles = np.arange(_AROUND) * (2.0 * np.pi / _AROUND)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rings = [np.insert(circle * radius, 2, height, axis=1) for radius, height in outline[1:-1]]
    bottom, top = ([[0.0, 0.0, height]] for height in outline[[0, -1], 1])
    points = np.concatenate([bottom, *rings, top])
    around = 1 + np.arange(_AROUND)
    after = np.roll(around, -1)
    last = _AROUND * (len(rings) - 1)
    sides: list[Array] = [
        np.stack([around, after, after + _AROUND, around + _AROUND], axis=1) + _AROUND * ring
        for ring in range(len(rings) - 1)
    ]
    below = np.stack([np.zeros_like(around), after, around], axis=1)
    above = np.stack([around + last, after + last, np.full_like(around, len(points) - 1)], axis=1)
    sizes = np.repeat([3, 4, 3], [_AROUND, _AROUND * len(sides), _AROUND])
    return points, sizes, np.concatenate([each.ravel() for each in (below, *sides, above)])
