"""Sheets, their neighbours and harmonic values, by clipping each triangle to each cell."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


def clipped(polygon: Array, low: Array, high: Array) -> Array:
    """Return what of a polygon (k, 3) lies in a box (Sutherland & Hodgman)."""
    for axis in range(3):
        for side, sign in ((low[axis], 1), (high[axis], -1)):
            points = []
            for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
                of_a, of_b = sign * (a[axis] - side), sign * (b[axis] - side)
                if of_a >= 0:
                    points.append(a)
                if (of_a < 0) != (of_b < 0):
                    points.append(a + (b - a) * of_a / (of_a - of_b))
            polygon = np.array(points).reshape(-1, 3)
            if not len(polygon):
                return polygon
    return polygon


def area(polygon: Array) -> float:
    if len(polygon) < 3:
        return 0.0
    return float(
        np.linalg.norm(np.cross(polygon[1:-1] - polygon[0], polygon[2:] - polygon[0]).sum(axis=0)) / 2
    )


class Sheets:
    """Of positions (n, 3) in cells' edges: each sheet as its cell and its triangles; neighbours; areas."""

    def __init__(self, positions: Array, triangles: Array) -> None:
        pieces: dict[tuple[int, ...], dict[int, float]] = {}
        for number, triangle in enumerate(triangles):
            corners = positions[triangle]
            low, high = np.floor(corners.min(axis=0)).astype(int), np.floor(corners.max(axis=0)).astype(int)
            for cell in np.ndindex(*(high - low + 1)):
                place = low + cell
                piece = clipped(corners, place, place + 1)
                if len(piece):
                    pieces.setdefault(tuple(place.tolist()), {})[number] = area(piece)
        self.sheets: list[tuple[tuple[int, ...], frozenset[int]]] = []
        self.areas: list[float] = []
        for cell, members in pieces.items():
            groups = [{number} for number in members]
            for a, b in combinations(members, 2):
                shared = {tuple(p) for p in positions[triangles[a]]} & {
                    tuple(p) for p in positions[triangles[b]]
                }
                if len(shared) == 2 and len(
                    clipped(np.array(sorted(shared)), np.array(cell), np.array(cell) + 1)
                ):
                    one = next(group for group in groups if a in group)
                    other = next(group for group in groups if b in group)
                    if one is not other:
                        groups.remove(other)
                        one |= other
            for group in groups:
                self.sheets.append((cell, frozenset(group)))
                self.areas.append(sum(members[number] for number in group))
        self.pairs = {
            frozenset((a, b))
            for a, b in combinations(range(len(self.sheets)), 2)
            if self.sheets[a][1] & self.sheets[b][1]
            and np.abs(np.subtract(self.sheets[a][0], self.sheets[b][0])).sum() == 1
        }


def harmonic(pairs: Array, weights: Array, values: Array, known: Array, hold: float) -> Array:
    """Return values (n, components) by a dense solve: means of neighbours where they are not known."""
    count = len(values)
    matrix, right = np.zeros((count, count)), np.zeros(values.shape)
    for (a, b), weight in zip(pairs, weights, strict=True):
        matrix[a, b] -= weight
        matrix[b, a] -= weight
        matrix[a, a] += weight
        matrix[b, b] += weight
    matrix[np.diag_indices(count)] += hold
    right += hold * values[known].mean(axis=0)
    matrix[known] = np.eye(count)[known]
    right[known] = values[known]
    found: Array = np.linalg.solve(matrix, right)
    return found
