"""Implicit surfaces: level sets of functions of position (Benson & Davis 2002, 1 and 5)."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from octex.arrays import Float64s, Int32s
from octex.checks import answer, as_number, as_points, as_positive
from octex.errors import ArgumentError, ModelError
from octex.parallel import memory_size

#: Returns values (n,) at positions (n, 3).
ImplicitFunction: TypeAlias = Callable[[Float64s], npt.ArrayLike]

_BATCH = 1 << 18
# Nodes of the grid in a cube of the edge length, and bytes for each.
_NODES, _NODE_MEMORY = 2.1, 64
# Newton's method doubles the digits with each step: after a step this short, in edges, all are right.
_STEPS, _NEAR = 8, 1e-7
# Step of finite differences, as a part of the edge length.
_DIFFERENCE = 1e-4
_LARGEST = 1e30


def level_set(
    f: ImplicitFunction, bounds: npt.ArrayLike, edge_length: float, level: float
) -> tuple[Float64s, Int32s]:
    """Return the vertices and triangles of a function's level set: see ``Surface.from_function``."""
    box = as_points(bounds, "bounds").astype(np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or (box[0] >= box[1]).any():
        raise ArgumentError(f"bounds must be a finite lowest and highest corner, not {box.tolist()}")
    low, high = box
    edge = as_positive(edge_length, "edge_length")
    level = as_number(level, "level", -_LARGEST, _LARGEST)
    with np.errstate(over="ignore"):
        nodes = _NODES * float(np.prod((high - low) / edge + 1.0))
    if nodes * _NODE_MEMORY > memory_size():
        raise ArgumentError(
            f"an edge_length of {edge:g} takes about {nodes:.2g} values of the function, more than fit into "
            "memory; use a larger one or smaller bounds"
        )

    def inside(points: Float64s) -> Float64s:
        values = np.empty(len(points))
        for first in range(0, len(points), _BATCH):
            batch = points[first : first + _BATCH]
            numbers = answer(f, [batch], [(len(batch),)], "the function", batch.__getitem__)
            values[first : first + _BATCH] = np.clip(numbers, -_LARGEST, _LARGEST)
        return level - values

    vertices, triangles = _polygonized(inside, low, high, edge)
    if not len(triangles):
        raise ModelError(
            f"the function has no surface at {level:g} inside {low.tolist()} … {high.tolist()}, or one finer "
            f"than the edge_length of {edge:g}"
        )
    # Vertices of the caps, where the bounds cut the shape, do not move.
    rim = 1e-9 * float((high - low).max())
    free = ((vertices > low + rim) & (vertices < high - rim)).all(axis=1)
    vertices[free] = _moved_onto(inside, vertices[free], edge)
    return vertices, triangles


def _polygonized(
    inside: Callable[[Float64s], Float64s], low: Float64s, high: Float64s, edge: float
) -> tuple[Float64s, Int32s]:
    """Polygonize the zero set of ``inside`` by marching tetrahedra.

    manifold3d evaluates one point at a time, in an order that does not depend on values. So a first run lists
    the points, and a second reads their values: 10 times as fast as single calls of ``inside``.
    """
    from manifold3d import Manifold

    box = [*low.tolist(), *high.tolist()]
    points = array("d")

    def note(x: float, y: float, z: float) -> float:
        points.extend((x, y, z))
        return -1.0

    Manifold.level_set(note, box, edge)
    values = iter(array("d", inside(np.frombuffer(points).reshape(-1, 3))))
    mesh = Manifold.level_set(lambda _x, _y, _z: next(values), box, edge).to_mesh64()
    assert next(values, None) is None
    return np.array(mesh.vert_properties[:, :3], np.float64), np.array(mesh.tri_verts, np.int32)


def _moved_onto(inside: Callable[[Float64s], Float64s], start: Float64s, edge: float) -> Float64s:
    """Move points (n, 3) onto the zero set of ``inside`` by Newton's method, by at most an edge."""
    points = start.copy()
    values = inside(points)
    shares = np.ones(len(points))
    difference = _DIFFERENCE * edge * np.eye(3)
    moving = np.flatnonzero(values)
    for _ in range(_STEPS):
        if not moving.size:
            break
        current = points[moving]
        gradients = np.stack([inside(current + step) - inside(current - step) for step in difference], axis=1)
        gradients /= 2.0 * _DIFFERENCE * edge
        squares = (gradients**2).sum(axis=1)
        steps = shares[moving] * values[moving] / np.where(squares > 0.0, squares, np.inf)
        moves = current - steps[:, None] * gradients - start[moving]
        lengths = np.linalg.norm(moves, axis=1)
        trials = start[moving] + moves * np.minimum(1.0, edge / np.maximum(lengths, 1e-300))[:, None]
        trial_values = inside(trials)
        is_better = np.abs(trial_values) < np.abs(values[moving])
        better = moving[is_better]
        points[better], values[better] = trials[is_better], trial_values[is_better]
        shares[moving[~is_better]] *= 0.5
        shares[better] = 1.0
        is_done = is_better & (np.abs(steps) * np.sqrt(squares) < _NEAR * edge)
        moving = moving[~is_done & (values[moving] != 0.0)]
    return points
