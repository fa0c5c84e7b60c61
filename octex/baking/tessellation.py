"""Divides triangles edge by edge, so that neighbours share the new vertices."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float64s, Int32s, Int64s
from octex.jit import kernel
from octex.source.welding import distinct_rows


class Tessellation(NamedTuple):
    """Triangles that divide others, their parents. Points are listed once per parent that they lie on."""

    triangles: Int32s  # (m, 3)   vertices
    parents: Int64s  # (m,)
    shares: Float64s  # (m, 3, 3)   barycentric coordinates of the corners in the parent
    points: Int64s  # (p,)   the vertex of each point
    owners: Int64s  # (p,)   its parent
    barycentric: Float64s  # (p, 3)   its barycentric coordinates there
    vertices: int  # number of vertices

    def spread(self, corners: Float64s) -> Float64s:
        """Interpolate values at the corners of parents (t, 3, k) to the vertices (vertices, k)."""
        values = np.empty((self.vertices, corners.shape[2]))
        a, b, c = (self.barycentric[:, n, None] * corners[self.owners, n] for n in range(3))
        values[self.points] = a + b + c
        return values


def tessellated(triangles: Int64s, levels: Int64s, edges: tuple[Int64s, Int64s]) -> Tessellation:
    """Divide triangles (t, 3) so that each edge has 2ˡ parts.

    ``edges`` are the (e, 2) vertices of edges, and the edges that are each triangle's sides (t, 3);
    ``levels`` (e,) are their l. A triangle is divided like its finest edge; along coarser ones the vertices
    of finer rows snap to the nearest vertex.
    """
    ends, sides = edges
    count = int(triangles.max()) + 1
    firsts = count + np.cumsum(2**levels - 1) - (2**levels - 1)  # the first vertex between an edge's ends
    count += int((2**levels - 1).sum())
    depth = levels[sides].max(axis=1)
    parts = []
    for level in np.unique(depth).tolist():
        group = np.flatnonzero(depth == level)
        n = 2**level
        points, fine = _grid(n)
        numbers = np.empty((len(group), len(points)), np.int64)
        inside = (points > 0).all(axis=1)
        inside_count = int(inside.sum())
        numbers[:, inside] = count + np.arange(len(group) * inside_count).reshape(len(group), inside_count)
        count += len(group) * inside_count
        barycentric = np.broadcast_to(points / n, (len(group), *points.shape)).copy()
        for side in range(3):
            a, b, c = side, (side + 1) % 3, (side + 2) % 3
            rim = np.flatnonzero(points[:, c] == 0)
            edge = sides[group, side]
            step = (n >> levels[edge])[:, None]  # rows of the grid a part of the edge
            along = (points[rim, b] + step // 2) // step
            most = (2 ** levels[edge])[:, None]
            is_turned = (ends[edge, 0] != triangles[group, a])[:, None]
            between = firsts[edge][:, None] - 1 + np.where(is_turned, most - along, along)
            parent_corners = triangles[group]
            numbers[:, rim] = np.where(
                along == 0,
                parent_corners[:, a, None],
                np.where(along == most, parent_corners[:, b, None], between),
            )
            barycentric[:, rim, b] = along * step / n
            barycentric[:, rim, a] = 1 - barycentric[:, rim, b]
        capacity = len(group) * len(fine)
        corners, parents = np.empty((capacity, 3), np.int32), np.empty(capacity, np.int64)
        shares = np.empty((capacity, 3, 3))
        kept = slice(_divide(group, numbers, barycentric, fine, corners, parents, shares))
        owners = np.repeat(group, len(points))
        vertices = numbers.ravel(), owners, barycentric.reshape(-1, 3)
        parts.append((corners[kept], parents[kept], shares[kept], *vertices))
    joined = parts[0] if len(parts) == 1 else map(np.concatenate, zip(*parts, strict=True))
    return Tessellation._make([*joined, count])


@kernel
def _divide(
    group: Int64s, numbers: Int64s, barycentric: Float64s, fine: Int64s, triangles: Int32s, parents: Int64s,
    shares: Float64s,
) -> int:  # fmt: skip
    """Write the triangles of the parents' grids that have area; return how many there are."""
    count = 0
    for t in range(len(group)):
        for f in range(len(fine)):
            a, b, c = numbers[t, fine[f, 0]], numbers[t, fine[f, 1]], numbers[t, fine[f, 2]]
            if a == b or b == c or c == a:
                continue
            triangles[count, 0], triangles[count, 1], triangles[count, 2] = a, b, c
            parents[count] = group[t]
            for corner in range(3):
                for k in range(3):
                    shares[count, corner, k] = barycentric[t, fine[f, corner], k]
            count += 1
    return count


def edges_of(triangles: Int64s) -> tuple[Int64s, Int64s]:
    """Return the distinct edges (k, 2) of triangles, and the edges that are each triangle's sides (m, 3)."""
    ends = np.stack([triangles, triangles[:, [1, 2, 0]]], axis=-1).reshape(-1, 2)
    edges, sides = distinct_rows(in_order(ends))
    return edges, sides.reshape(-1, 3)


def in_order(pairs: Int64s) -> Int64s:
    """Return pairs (k, 2) with the lower number first; np.sort takes ten times as long."""
    return np.stack([np.minimum(pairs[:, 0], pairs[:, 1]), np.maximum(pairs[:, 0], pairs[:, 1])], axis=1)


def _grid(n: int) -> tuple[Int64s, Int64s]:
    """Return the points (k, 3) of a triangle in n rows, barycentric in 1/n, and its triangles (n², 3)."""
    i, j = np.mgrid[: n + 1, : n + 1].reshape(2, -1)
    known = i + j <= n
    i, j = i[known], j[known]
    numbers = np.full((n + 2, n + 2), -1)
    numbers[i, j] = np.arange(len(i))
    up = np.stack([numbers[i, j], numbers[i + 1, j], numbers[i, j + 1]], axis=1)
    down = np.stack([numbers[i + 1, j], numbers[i + 1, j + 1], numbers[i, j + 1]], axis=1)
    triangles = np.concatenate([up[(up >= 0).all(axis=1)], down[(down >= 0).all(axis=1)]])
    return np.stack([n - i - j, i, j], axis=1), triangles
