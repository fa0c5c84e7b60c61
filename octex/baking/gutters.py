"""Fills the texels around charts: with the surface across the chart's edge, then smoothly."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s
from octex.baking.layout import Layout
from octex.jit import inlined, kernel
from octex.source.vectors import Vector, dot_product, length_of, minus, plus, row_of, times

#: Most triangles that a path over the surface crosses.
_MOST_CROSSED = 64
#: Triangles lower than this part of a side count as without area.
_FLAT = 1e-9


class Borders(NamedTuple):
    """Texels around charts, and the chart edges nearest to them."""

    texels: Int32s  # (n,)   counted row by row
    drawn: Int64s  # (n,)   the drawn triangle of the edge
    sides: Int64s  # (n,)   the edge's side

    @classmethod
    def of(cls, layout: Layout, taken: Bools, padding: int) -> Borders:
        """Find the texels within ``padding`` texels of charts that are not ``taken`` (height, width)."""
        squares = np.full(taken.shape, np.inf, np.float32)
        nearest_border = np.full(taken.shape, -1, np.int32)
        drawn, sides = np.nonzero(layout.edges)
        find_nearest(layout.corners, drawn, sides, taken, float(padding), squares, nearest_border)
        texels = np.flatnonzero(nearest_border >= 0)
        borders = nearest_border.reshape(-1)[texels]
        return cls(texels.astype(np.int32), drawn[borders], sides[borders])

    def parts(self, count: int) -> list[Borders]:
        """Return the texels in runs of ``count``."""
        firsts = range(0, self.texels.size, count)
        return [Borders._make(each[first : first + count] for each in self) for first in firsts]


class Gutter(NamedTuple):
    """The points of a surface that gutter texels show, ordered by triangle."""

    texels: Int32s  # (n,)   counted row by row
    triangles: Int32s  # (n,)
    barycentric: Float64s  # (n, 3)
    beside: Int32s  # (n,)   the triangle of the nearest chart edge
    edges: Float64s  # (n, 3)   the nearest point on that edge, barycentric


def gutter_of(
    borders: Borders, layout: Layout, rest: Float64s, faces: Int32s, neighbours: Int32s, sides: Int32s
) -> Gutter:
    """Find the points that gutter texels show: on the surface across the edge, unfolded, or at its end."""
    count = borders.texels.size
    triangles = np.empty(count, np.int32)
    barycentric, edges = np.zeros((2, count, 3))
    map_triangles = layout.corners, layout.faces, layout.width
    _walk(*map_triangles, rest, faces, neighbours, sides, borders, edges, triangles, barycentric)
    order = np.sort(triangles.astype(np.int64) << 32 | np.arange(count)) & 0xFFFFFFFF
    beside = layout.faces[borders.drawn[order]]
    return Gutter(borders.texels[order], triangles[order], barycentric[order], beside, edges[order])


@inlined
def _nearest_on(ax: float, ay: float, bx: float, by: float, x: float, y: float) -> tuple[float, float, float]:
    """Return where on an edge, 0 … 1, a point is nearest, and the vector from there to the point."""
    ex, ey = bx - ax, by - ay
    square = ex * ex + ey * ey
    t = 0.0 if square == 0.0 else min(max(((x - ax) * ex + (y - ay) * ey) / square, 0.0), 1.0)
    return t, x - ax - t * ex, y - ay - t * ey


@kernel
def find_nearest(
    corners: Float64s, triangles: Int64s, sides: Int64s, taken: Bools, padding: float,
    nearest: Float32s, border: Int32s,
) -> None:  # fmt: skip
    """Write the border nearest to each texel's centre, of those within ``padding``."""
    height, width = taken.shape
    for n in range(triangles.size):
        a = corners[triangles[n], sides[n]]
        b = corners[triangles[n], (sides[n] + 1) % 3]
        x0 = max(int(np.floor(min(a[0], b[0]) - padding - 0.5)), 0)
        x1 = min(int(np.floor(max(a[0], b[0]) + padding + 0.5)), width - 1)
        y0 = max(int(np.floor(min(a[1], b[1]) - padding - 0.5)), 0)
        y1 = min(int(np.floor(max(a[1], b[1]) + padding + 0.5)), height - 1)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if taken[y, x]:
                    continue
                _, dx, dy = _nearest_on(a[0], a[1], b[0], b[1], x + 0.5, y + 0.5)
                distance = np.float32(dx * dx + dy * dy)
                if distance < nearest[y, x] and distance <= padding * padding:
                    nearest[y, x] = distance
                    border[y, x] = n


@inlined
def _edge_frame(
    rest: Float64s, faces: Int32s, triangle: int, side: int
) -> tuple[Vector, Vector, float, float, float]:
    """Return unit vectors along a side and inward, the side's length (0: none), and the tip there."""
    start = row_of(rest, faces[triangle, side])
    along = minus(row_of(rest, faces[triangle, (side + 1) % 3]), start)
    to_tip = minus(row_of(rest, faces[triangle, (side + 2) % 3]), start)
    length = length_of(along)
    if not length > 0.0:
        return along, to_tip, 0.0, 0.0, 0.0
    along = (along[0] / length, along[1] / length, along[2] / length)
    tip_along = dot_product(to_tip, along)
    inward = minus(to_tip, times(along, tip_along))
    height = length_of(inward)
    if not height > _FLAT * length:
        return along, inward, 0.0, 0.0, 0.0
    inward = (inward[0] / height, inward[1] / height, inward[2] / height)
    return along, inward, length, tip_along, dot_product(to_tip, inward)


@kernel
def _walk(
    corners: Float64s, owners: Int32s, width: int, rest: Float64s, faces: Int32s, neighbours: Int32s,
    sides: Int32s, borders: Borders, edges: Float64s, triangles: Int32s, barycentric: Float64s,
) -> None:  # fmt: skip
    """Walk straight over the surface from chart edges to texels' centres (n,)."""
    for n in range(triangles.size):
        drawn, side = borders.drawn[n], int(borders.sides[n])
        triangle = int(owners[drawn])
        a, b, c = corners[drawn, side], corners[drawn, (side + 1) % 3], corners[drawn, (side + 2) % 3]
        row, column = borders.texels[n] // width, borders.texels[n] % width
        t, dx, dy = _nearest_on(a[0], a[1], b[0], b[1], column + 0.5, row + 0.5)
        edges[n, side], edges[n, (side + 1) % 3] = 1.0 - t, t
        barycentric[n] = edges[n]
        triangles[n] = triangle
        along, inward, length, tip_along, tip_away = _edge_frame(rest, faces, triangle, side)
        neighbour = int(neighbours[triangle, side])
        doubled = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if neighbour < 0 or length == 0.0 or doubled == 0.0:
            continue
        # The vector in the map, as parts of the sides a → b and a → c, then along and away from the edge.
        s = (dx * (c[1] - a[1]) - dy * (c[0] - a[0])) / doubled
        u = ((b[0] - a[0]) * dy - (b[1] - a[1]) * dx) / doubled
        forward, away = s * length + u * tip_along, max(-u * tip_away, 0.0)
        along_edge = t * length
        for _ in range(_MOST_CROSSED):
            # Across the edge, whose direction is reversed there.
            triangle, side = neighbour, int(sides[triangle, side])
            along, inward, length, tip_along, tip_away = _edge_frame(rest, faces, triangle, side)
            if length == 0.0:
                break
            along_edge, forward = min(max(length - along_edge, 0.0), length), -forward
            # Barycentric coordinates of the end: of the tip, of the side's end, of its start.
            r = away / tip_away
            q = (along_edge + forward - r * tip_along) / length
            p = 1.0 - q - r
            if p >= -1e-9 and q >= -1e-9:
                triangles[n] = triangle
                barycentric[n, side] = max(p, 0.0)
                barycentric[n, (side + 1) % 3] = max(q, 0.0)
                barycentric[n, (side + 2) % 3] = r
                break
            # The path leaves by the side whose coordinate, p or q, reaches 0 first.
            p0, q0 = 1.0 - along_edge / length, along_edge / length
            part_p = p0 / (p0 - p) if p < 0.0 else 2.0
            part_q = q0 / (q0 - q) if q < 0.0 else 2.0
            by_end = part_p < part_q  # through the side from end to tip
            part = min(part_p, part_q)
            triangles[n] = triangle
            r0 = r * part
            other_part = q0 + (q - q0) * part if by_end else p0 + (p - p0) * part
            barycentric[n, side] = 0.0 if by_end else other_part
            barycentric[n, (side + 1) % 3] = other_part if by_end else 0.0
            barycentric[n, (side + 2) % 3] = r0
            out = (side + 1) % 3 if by_end else (side + 2) % 3
            neighbour = int(neighbours[triangle, out])
            if neighbour < 0:
                break
            # The rest of the path, in the frame of the side that it crosses.
            path = plus(times(along, forward * (1.0 - part)), inward, away * (1.0 - part))
            new_along, new_inward, new_length, _, _ = _edge_frame(rest, faces, triangle, out)
            if new_length == 0.0:
                break
            forward, away = dot_product(path, new_along), max(-dot_product(path, new_inward), 0.0)
            along_edge = (r0 if by_end else other_part) * new_length
            side = out


def fill_up(values: Float32s, weights: Float32s) -> None:
    """Fill texels of weight 0 from their surroundings, in place: push–pull (Gortler et al. 1996, 3.4)."""
    height, width = weights.shape
    if max(height, width) == 1:
        return
    shape = (height + 1) // 2, (width + 1) // 2
    coarse = np.zeros((*shape, values.shape[2]), np.float32)
    above = np.zeros(shape, np.float32)
    if _push(values, weights, coarse, above):
        fill_up(coarse, above)
        _pull(coarse, weights, values)


@kernel
def _push(values: Float32s, weights: Float32s, coarse: Float32s, above: Float32s) -> bool:
    """Average texels two by two, with weights up to 1; return whether part of the texels have no weight."""
    none = known = False
    for row in range(weights.shape[0]):
        for column in range(weights.shape[1]):
            weight = weights[row, column]
            none |= weight <= 0.0
            known |= weight > 0.0
            above[row >> 1, column >> 1] += weight
            for k in range(values.shape[2]):
                coarse[row >> 1, column >> 1, k] += weight * values[row, column, k]
    for row in range(above.shape[0]):
        for column in range(above.shape[1]):
            if above[row, column] > 0.0:
                for k in range(coarse.shape[2]):
                    coarse[row, column, k] /= above[row, column]
                above[row, column] = min(above[row, column], np.float32(1.0))
    return none and known


@kernel
def _pull(coarse: Float32s, weights: Float32s, values: Float32s) -> None:
    """Interpolate coarse values at texels of weight 0."""
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            if weights[row, column] > 0.0:
                continue
            y, x = 0.5 * row - 0.25, 0.5 * column - 0.25
            y0, x0 = int(np.floor(y)), int(np.floor(x))
            fy, fx = np.float32(y - y0), np.float32(x - x0)
            ya, yb = max(y0, 0), min(y0 + 1, coarse.shape[0] - 1)
            xa, xb = max(x0, 0), min(x0 + 1, coarse.shape[1] - 1)
            one = np.float32(1.0)
            for k in range(values.shape[2]):
                upper = (one - fx) * coarse[ya, xa, k] + fx * coarse[ya, xb, k]
                lower = (one - fx) * coarse[yb, xa, k] + fx * coarse[yb, xb, k]
                values[row, column, k] = (one - fy) * upper + fy * lower
