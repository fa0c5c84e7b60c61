"""The slow, obvious version of parts and the distances between them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from manifold3d import Manifold, Mesh64

Array = npt.NDArray[Any]


def components(points: Array, triangles: Array) -> list[set[int]]:
    """Triangles that hang together by positions."""
    left = {n: {tuple((points[v] + 0.0).tolist()) for v in row} for n, row in enumerate(triangles)}
    found = []
    while left:
        first = min(left)
        members, positions = {first}, left.pop(first)
        while True:
            more = {n for n, row in left.items() if row & positions}
            if not more:
                break
            for n in more:
                positions |= left.pop(n)
            members |= more
        found.append(members)
    return found


def distance(a: Array, b: Array, steps: int = 24) -> tuple[float, float]:
    """The least distance of points strewn over triangles (3, 3), and by how much it may be too large."""
    weights = np.array([(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)], float)
    p, q = weights / steps @ a, weights / steps @ b
    apart = np.linalg.norm(p[:, None] - q[None], axis=2).min()
    longest = max(np.linalg.norm(np.roll(t, 1, axis=0) - t, axis=1).max() for t in (a, b))
    return float(apart), 2 * float(longest) / steps


def solid(points: Array, triangles: Array) -> Manifold:
    """What triangles that share vertices enclose."""
    used, corners = np.unique(triangles, return_inverse=True)
    made = Manifold(
        Mesh64(np.ascontiguousarray(points[used], np.float64), corners.reshape(-1, 3).astype(np.uint64))
    )
    return made if made.volume() > 0 else solid(points, triangles[:, ::-1])
