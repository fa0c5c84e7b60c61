"""Queries of a point cloud: a weighted mean of the points within a radius, or the nearest point."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int64s
from octex.jit import inlined, kernel, trailing_zeros
from octex.nearest.boxes import (
    WIDTH,
    Boxes,
    Search,
    Sought,
    agrees,
    begin,
    boxes_of,
    local,
    morton_order,
    new_search,
    next_node,
    reach,
)

_MOST_POINTS = 0.95


class Points(NamedTuple):
    """A searchable cloud of points with values: in Morton order, in groups of eight."""

    boxes: Boxes  # over groups
    positions: Float64s  # (n, 3)
    values: Float32s  # (n, components)
    normals: Float32s  # (n, 3), unit length; or (0, 3)
    order: Int64s  # (n,)   their numbers in the original cloud

    @classmethod
    def of(cls, positions: Float64s, values: Float32s, normals: Float32s | None = None) -> Points:
        """Build from positions (n, 3), n > 0, values (n, components) and unit normals (n, 3)."""
        order = morton_order(positions)
        ordered = positions.take(order, axis=0)
        starts = np.arange(0, len(ordered), WIDTH)
        low, high = np.minimum.reduceat(ordered, starts), np.maximum.reduceat(ordered, starts)
        facing = np.empty((0, 3), np.float32) if normals is None else normals.take(order, axis=0)
        return cls(boxes_of(low, high), ordered, values.take(order, axis=0), facing, order)

    def around(
        self,
        places: Float64s,
        radii: Float64s,
        directions: Float64s | None = None,
        *,
        nearest: float | None = None,
        least_cosine: float = -1.0,
    ) -> tuple[Float32s, Bools]:
        """Return means (n, components) of the values around places (n, 3), and where there are any (n,).

        A point at distance d within a place's radius r weighs (1 − d²/r²)². Without such points, the nearest
        point within ``nearest`` counts; at equal distance the first. With unit ``directions`` (n, 3), only
        points count whose normal's cosine to the direction is at least ``least_cosine``.
        """
        means = np.zeros((len(places), self.values.shape[1]), np.float32)
        has_value = np.zeros(len(places), np.bool_)
        facing = np.empty((0, 3)) if directions is None or not len(self.normals) else directions
        farthest = -1.0 if nearest is None else float(nearest)
        _around(self, places, radii, facing, farthest, float(least_cosine), means, has_value)
        return means, has_value

    def spacing(self) -> float:
        """Return the distance within which 19 of 20 points have a neighbour, from at most 10,000 points."""
        chosen = np.unique(np.linspace(0, len(self.positions) - 1, 10_000).astype(np.int64))
        return float(np.sqrt(np.quantile(_to_others(self, chosen), _MOST_POINTS, method="higher")))


@inlined
def _square(positions: Float64s, row: int, point: tuple[float, float, float]) -> float:
    dx, dy, dz = positions[row, 0] - point[0], positions[row, 1] - point[1], positions[row, 2] - point[2]
    return float(dx * dx + dy * dy + dz * dz)


@inlined
def _add_group(cloud: Points, group: int, sought: Sought, square: float, sums: Float64s) -> float:
    """Add the values of a group's points within a squared radius; return their summed weight."""
    total = 0.0
    for row in range(group * 8, min(group * 8 + 8, cloud.positions.shape[0])):
        squared = _square(cloud.positions, row, sought.point)
        part = 1.0 - squared / square if squared < square else 0.0
        if part > 0.0 and agrees(cloud.normals, row, sought):
            total += part * part
            for k in range(sums.size):
                sums[k] += part * part * cloud.values[row, k]
    return total


@kernel
def _around(
    cloud: Points,
    places: Float64s,
    radii: Float64s,
    directions: Float64s,
    farthest: float,
    least_cosine: float,
    means: Float32s,
    has_value: Bools,
) -> None:
    boxes = cloud.boxes
    search = new_search()
    sums = np.zeros(means.shape[1], np.float64)
    last = -1
    for n in range(len(places)):
        point = places[n, 0], places[n, 1], places[n, 2]
        sought = Sought(point, local(boxes, *point), directions, n, least_cosine)
        at = sought.local
        radius, total = radii[n], 0.0
        if radius > 0.0:
            square = radius * radius
            bound = reach(square, at[3])
            sums[:] = 0.0
            waiting = begin(boxes, search)
            while waiting > 0:
                node, children, waiting = next_node(boxes, search, waiting, at, bound)
                while children != np.uint64(0):
                    group = node * 8 + trailing_zeros(children)
                    children &= children - np.uint64(1)
                    total += _add_group(cloud, group, sought, square, sums)
        if total > 0.0:
            has_value[n] = True
            for component in range(sums.size):
                means[n, component] = sums[component] / total
        elif farthest >= 0.0:
            last = _nearest(cloud, search, sought, farthest, last, -1)
            if last >= 0:
                has_value[n] = True
                for component in range(sums.size):
                    means[n, component] = cloud.values[last, component]


@inlined
def _nearest(cloud: Points, search: Search, sought: Sought, farthest: float, guess: int, without: int) -> int:
    """Return the row of the nearest point within ``farthest``, or −1; a good guess speeds it up.

    Row ``without`` does not count.
    """
    boxes, point, slack = cloud.boxes, sought.point, sought.local[3]
    best, nearest = farthest * farthest, -1
    if guess >= 0 and agrees(cloud.normals, guess, sought):
        square = _square(cloud.positions, guess, point)
        if square <= best:
            best, nearest = square, guess
    bound = reach(best, slack)
    waiting = begin(boxes, search)
    while waiting > 0:
        node, children, waiting = next_node(boxes, search, waiting, sought.local, bound)
        while children != np.uint64(0):
            child = trailing_zeros(children)
            children &= children - np.uint64(1)
            if search.children[child] > bound:
                continue
            first = (node * 8 + child) * 8
            for row in range(first, min(first + 8, cloud.positions.shape[0])):
                square = _square(cloud.positions, row, point)
                if square > best or row in (nearest, without):
                    continue
                if not agrees(cloud.normals, row, sought):
                    continue
                if square < best or nearest < 0 or cloud.order[row] < cloud.order[nearest]:
                    best, nearest = square, row
                    bound = reach(best, slack)
    return nearest


@kernel
def _to_others(cloud: Points, chosen: Int64s) -> Float64s:
    """Return the squared distance from each chosen row to the nearest other point; 0 for a duplicate."""
    search, no_directions = new_search(), np.empty((0, 3), np.float64)
    squares = np.empty(chosen.size, np.float64)
    for n in range(chosen.size):
        row_here = int(chosen[n])
        point = cloud.positions[row_here, 0], cloud.positions[row_here, 1], cloud.positions[row_here, 2]
        sought = Sought(point, local(cloud.boxes, *point), no_directions, n, -1.0)
        other = _nearest(cloud, search, sought, np.inf, -1, row_here)
        squares[n] = _square(cloud.positions, other, point) if other >= 0 else np.inf
    return squares
