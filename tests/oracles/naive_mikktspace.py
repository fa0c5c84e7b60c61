"""Tangents by MikkTSpace's rules, triangle by triangle."""

from __future__ import annotations

from math import acos

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


def mikktspace(positions: Floats, normals: Floats, uv: Floats) -> Floats:
    """Tangents with handedness (m, 3, 4) at the corners of triangles; ``uv`` (m, 3, 2) has v running up.

    As mikktspace.c makes them with its default threshold. NaN at corners that it leaves to chance: of
    triangles without area on the image that share no corner with another.
    """
    count = len(positions)
    rows = np.concatenate([positions, normals, uv], axis=2).reshape(-1, 8)
    vertices = np.unique(rows, axis=0, return_inverse=True)[1].reshape(count, 3)
    along, mirrored, loose = np.zeros((count, 3)), np.zeros(count, bool), np.zeros(count, bool)
    for f in range(count):
        (s1, t1), (s2, t2) = uv[f, 1] - uv[f, 0], uv[f, 2] - uv[f, 0]
        area = s1 * t2 - t1 * s2
        direction = t2 * (positions[f, 1] - positions[f, 0]) - t1 * (positions[f, 2] - positions[f, 0])
        other = s1 * (positions[f, 2] - positions[f, 0]) - s2 * (positions[f, 1] - positions[f, 0])
        mirrored[f] = not area > 0
        loose[f] = area == 0 or not direction.any() or not other.any()
        along[f] = direction * np.sign(area)

    # Two triangles are neighbours across an edge that they run along in opposite directions.
    waiting: dict[tuple[int, int], list[tuple[int, int]]] = {}
    neighbors = -np.ones((count, 3), int)
    for f in range(count):
        for i in range(3):
            a, b = int(vertices[f, i]), int(vertices[f, (i + 1) % 3])
            if waiting.get((b, a)):
                g, j = waiting[b, a].pop(0)
                neighbors[f, i], neighbors[g, j] = g, f
            else:
                waiting.setdefault((a, b), []).append((f, i))

    group = -np.ones((count, 3), int)
    groups: list[list[tuple[int, int]]] = []
    for f in range(count):
        for i in range(3):
            if loose[f] or group[f, i] >= 0:
                continue
            members: list[tuple[int, int]] = []
            pending = [f]
            while pending:
                g = pending.pop()
                corner = int(np.flatnonzero(vertices[g] == vertices[f, i])[0])
                if group[g, corner] >= 0:
                    continue
                if loose[g] and (group[g] < 0).all():
                    mirrored[g] = mirrored[f]
                if mirrored[g] != mirrored[f]:
                    continue
                group[g, corner] = len(groups)
                members.append((g, corner))
                pending += [n for n in (neighbors[g, corner], neighbors[g, corner - 1]) if n >= 0]
            groups.append(members)

    tangents = np.full((count, 3, 4), np.nan)
    for members in groups:
        total = np.zeros(3)
        for f, i in members:
            if loose[f]:
                continue
            normal = normals[f, i]
            before, after = positions[f, i - 1] - positions[f, i], positions[f, (i + 1) % 3] - positions[f, i]
            before, after = _projected(before, normal), _projected(after, normal)
            total += acos(np.clip(before @ after, -1, 1)) * _projected(along[f], normal)
        for f, i in members:
            tangents[f, i, :3] = unit(total)
            tangents[f, i, 3] = -1 if mirrored[f] else 1
    return tangents


def _projected(vector: Floats, normal: Floats) -> Floats:
    """A vector's direction in the plane across a normal."""
    vector = vector - normal * (normal @ vector)
    length = np.linalg.norm(vector)
    return vector / length if length else vector


def unit(vectors: Floats) -> Floats:
    """Vectors at unit length; NaN for those without one."""
    with np.errstate(invalid="ignore", divide="ignore"):
        result: Floats = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return result
