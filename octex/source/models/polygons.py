"""Polygons as triangles: fans where they are convex, ears clipped where they are not."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from octex.jit import kernel

# Clipping ears takes up to the cube of the corners; larger polygons become fans.
_MOST_CLIPPED = 512


def triangulate(
    positions: npt.NDArray[np.float64], corners: npt.NDArray[np.int64], sizes: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Cut polygons into triangles.

    ``corners`` are rows of ``positions``, all in range, polygon after polygon, of ``sizes`` corners each.
    Returns triangles (m, 3) as indices into ``corners``, and the polygon of each (m,). Polygons of fewer than
    three corners give none. A polygon stays as it winds.
    """
    if len(sizes) and (sizes == 3).all():
        return np.arange(len(corners)).reshape(-1, 3), np.arange(len(sizes))
    counts = np.maximum(sizes - 2, 0)
    triangles = np.empty((int(counts.sum()), 3), np.int64)
    work = np.empty(max(int(sizes.max(initial=0)), 1), np.int64)
    _triangulate(positions, corners, sizes, work, triangles)
    return triangles, np.repeat(np.arange(len(sizes)), counts)


@kernel
def _triangulate(
    positions: npt.NDArray[np.float64],
    corners: npt.NDArray[np.int64],
    sizes: npt.NDArray[np.int64],
    work: npt.NDArray[np.int64],
    triangles: npt.NDArray[np.int64],
) -> None:
    first = 0
    done = 0
    for polygon in range(len(sizes)):
        size = sizes[polygon]
        if size > 3 and size <= _MOST_CLIPPED and not _is_convex(positions, corners, first, size):
            _clip_ears(positions, corners, first, size, work, triangles, done)
        else:
            for i in range(size - 2):
                triangles[done + i, 0] = first
                triangles[done + i, 1] = first + i + 1
                triangles[done + i, 2] = first + i + 2
        done += max(size - 2, 0)
        first += size


@kernel
def _normal(
    positions: npt.NDArray[np.float64], corners: npt.NDArray[np.int64], first: int, size: int
) -> tuple[float, float, float]:
    """Return twice the area vector (Newell's method)."""
    x = y = z = 0.0
    for i in range(size):
        a, b = corners[first + i], corners[first + (i + 1) % size]
        x += (positions[a, 1] - positions[b, 1]) * (positions[a, 2] + positions[b, 2])
        y += (positions[a, 2] - positions[b, 2]) * (positions[a, 0] + positions[b, 0])
        z += (positions[a, 0] - positions[b, 0]) * (positions[a, 1] + positions[b, 1])
    return x, y, z


@kernel
def _turn(
    positions: npt.NDArray[np.float64], a: int, b: int, c: int, normal: tuple[float, float, float]
) -> float:
    """Return twice the area of a triangle seen along a normal: positive if it turns left."""
    x1, x2 = positions[b, 0] - positions[a, 0], positions[c, 0] - positions[a, 0]
    y1, y2 = positions[b, 1] - positions[a, 1], positions[c, 1] - positions[a, 1]
    z1, z2 = positions[b, 2] - positions[a, 2], positions[c, 2] - positions[a, 2]
    turn: float = (
        (y1 * z2 - z1 * y2) * normal[0] + (z1 * x2 - x1 * z2) * normal[1] + (x1 * y2 - y1 * x2) * normal[2]
    )
    return turn


@kernel
def _is_convex(
    positions: npt.NDArray[np.float64], corners: npt.NDArray[np.int64], first: int, size: int
) -> bool:
    normal = _normal(positions, corners, first, size)
    for i in range(size):
        a, b = corners[first + i], corners[first + (i + 1) % size]
        if _turn(positions, a, b, corners[first + (i + 2) % size], normal) < 0.0:
            return False
    return True


@kernel
def _clip_ears(
    positions: npt.NDArray[np.float64],
    corners: npt.NDArray[np.int64],
    first: int,
    size: int,
    work: npt.NDArray[np.int64],
    triangles: npt.NDArray[np.int64],
    done: int,
) -> None:
    """Cut off corners that hold no other until three are left (Meisters 1975)."""
    normal = _normal(positions, corners, first, size)
    for i in range(size):
        work[i] = first + i
    left = size
    at = 0
    misses = 0
    while left > 3:
        before, here, after = work[(at + left - 1) % left], work[at % left], work[(at + 1) % left]
        a, b, c = corners[before], corners[here], corners[after]
        is_ear = _turn(positions, a, b, c, normal) > 0.0
        if is_ear:
            for i in range(left):
                p = corners[work[i]]
                if p in (a, b, c):
                    continue
                if (
                    _turn(positions, a, b, p, normal) >= 0.0
                    and _turn(positions, b, c, p, normal) >= 0.0
                    and _turn(positions, c, a, p, normal) >= 0.0
                ):
                    is_ear = False
                    break
        if is_ear or misses >= left:  # a polygon that crosses itself may have no ear
            triangles[done, 0], triangles[done, 1], triangles[done, 2] = before, here, after
            done += 1
            for i in range(at % left, left - 1):
                work[i] = work[i + 1]
            left -= 1
            at = (at % (left + 1)) % left
            misses = 0
        else:
            at += 1
            misses += 1
    triangles[done, 0], triangles[done, 1], triangles[done, 2] = work[0], work[1], work[2]
