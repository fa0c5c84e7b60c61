"""Finds the triangles that are visible from outside.

Cells are 1/256 of the model. A cell is outside if a path of empty, adjacent cells leads to it from beyond the
model. From points of a triangle, rays run in many directions through cells that contain triangles. A ray that
reaches an outside cell makes the triangle visible. A ray ends at another triangle, and at an empty cell that
is not outside. Rays are short, since the cells that contain triangles form a thin layer.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float64s, Int32s, Int64s, Uint8s
from octex.jit import kernel, part
from octex.source.vectors import Vector, cross_product, dot_product, minus, row_of
from octex.tree.layout import GRID_BITS
from octex.tree.morton import decode_cells
from octex.tree.placement import Placement, on_grid
from octex.voxelize.fragments import divided, whole

_DEPTH = 8
_EDGE = 1 << _DEPTH
#: Kinds of cells without triangles; other cells hold a row of `starts`.
_EMPTY, _OUTSIDE = -1, -2
#: Rays from a triangle with one sample point, and the least number a point with several.
_DIRECTIONS, _FEWEST = 64, 8
#: Rays from cells this many cells away from outside never reach it.
_DEEPEST = 8
#: Cells with more triangles than this count as outside: else a part far from the others would take hours.
_CROWDED = 10_000
#: Nearer hits, in cells, are triangles that touch the point, such as copies.
_TOUCHING = 1e-6
#: Triangles are enlarged by this part of an edge, so that no ray slips between two.
_ROUNDING = 1e-9
#: Distance of sample points, in cells.
_APART = 1.0


class _TrianglesInCells(NamedTuple):
    """The cells, and the triangles in them."""

    rows: Int32s  # (256, 256, 256)   row of `starts`, or _EMPTY or _OUTSIDE
    depths: Uint8s  # (cells,)   distance from outside in cells, 0 … _DEEPEST
    starts: Int64s  # (cells + 1,)   each cell's first row of `members`
    members: Int32s  # (pairs,)   triangles
    points: Float64s  # (n, 3)   vertices, in cells
    triangles: Int32s  # (m, 3)


def seen_triangles(rest: Float64s, triangles: Int32s) -> Bools:
    """Return which triangles (m, 3) of vertices (n, 3), all with area, are visible from outside (m,)."""
    used = rest[triangles].reshape(-1, 3)
    placement = Placement.around(np.array([used.min(axis=0), used.max(axis=0)]), _DEPTH)
    grid = on_grid(rest, placement)
    blocks = divided(whole(grid, triangles, _DEPTH), 0)
    cell_coordinates = decode_cells(blocks.codes)
    rows = np.full((_EDGE, _EDGE, _EDGE), _EMPTY, np.int32)
    rows[tuple(cell_coordinates.T)] = np.arange(len(cell_coordinates), dtype=np.int32)
    rows[tuple(cell_coordinates[np.diff(blocks.starts) > _CROWDED].T)] = _OUTSIDE
    _flood(rows.reshape(-1))
    depths = np.full(len(cell_coordinates), _DEEPEST, np.uint8)
    _find_depths(rows, cell_coordinates, depths)
    points = np.ldexp(grid.astype(np.float64), _DEPTH - GRID_BITS)
    cells = _TrianglesInCells(rows, depths, blocks.starts, blocks.members, points, triangles)
    turns = np.arange(_DIRECTIONS) + 0.5  # a spiral of even density (Vogel 1979)
    heights, angles = 1.0 - 2.0 * turns / _DIRECTIONS, turns * np.pi * (3.0 - np.sqrt(5.0))
    radii = np.sqrt(1.0 - heights**2)
    directions = np.stack([radii * np.cos(angles), radii * np.sin(angles), heights], axis=1)
    seen = np.zeros(len(triangles), np.bool_)
    _see(cells, directions, seen)
    return seen


@kernel
def _flood(rows: Int32s) -> None:
    """Mark the empty cells that are connected to the first one, which lies beyond the model."""
    stack = np.empty(rows.size, np.int32)
    stack[0] = 0
    rows[0] = _OUTSIDE
    waiting = 1
    while waiting > 0:
        waiting -= 1
        cell = np.int64(stack[waiting])
        for axis in range(3):
            step = 1 << (_DEPTH * axis)
            coordinate = (cell >> (_DEPTH * axis)) & (_EDGE - 1)
            if coordinate > 0 and rows[cell - step] == _EMPTY:
                rows[cell - step] = _OUTSIDE
                stack[waiting] = cell - step
                waiting += 1
            if coordinate < _EDGE - 1 and rows[cell + step] == _EMPTY:
                rows[cell + step] = _OUTSIDE
                stack[waiting] = cell + step
                waiting += 1


@kernel
def _find_depths(rows: Int32s, coordinates: Int64s, depths: Uint8s) -> None:
    for depth in range(_DEEPEST):
        for row in range(depths.size):
            if depths[row] != _DEEPEST:
                continue
            for number in range(27):
                i = coordinates[row, 0] + number // 9 - 1
                j = coordinates[row, 1] + number // 3 % 3 - 1
                k = coordinates[row, 2] + number % 3 - 1
                if min(i, min(j, k)) < 0 or max(i, max(j, k)) >= _EDGE:
                    continue
                other = rows[i, j, k]
                if (depth == 0 and other == _OUTSIDE) or (
                    depth > 0 and other >= 0 and depths[other] == depth - 1
                ):
                    depths[row] = depth
                    break


@kernel
def _see(cells: _TrianglesInCells, directions: Float64s, seen: Bools) -> None:
    for triangle in range(seen.size):
        a = row_of(cells.points, cells.triangles[triangle, 0])
        b = row_of(cells.points, cells.triangles[triangle, 1])
        c = row_of(cells.points, cells.triangles[triangle, 2])
        e, f, g = minus(b, a), minus(c, a), minus(c, b)
        longest = max(dot_product(e, e), max(dot_product(f, f), dot_product(g, g)))
        count = max(int(np.ceil(np.sqrt(longest) / _APART)), 1)
        lines = max(len(directions) // (count * count), _FEWEST)
        for number in range(count * count):
            row, column = number // count, number % count
            if seen[triangle]:
                break
            # First the upright triangles of the grid, then the inverted ones.
            third = 1.0 / 3.0
            if row + column >= count:
                row, column, third = count - 1 - row, count - 1 - column, 2.0 / 3.0
            p, q = (row + third) / count, (column + third) / count
            point = (a[0] + p * e[0] + q * f[0], a[1] + p * e[1] + q * f[1], a[2] + p * e[2] + q * f[2])
            seen[triangle] = _is_seen(cells, directions, number * lines, lines, triangle, point)


@part
def _is_seen(
    cells: _TrianglesInCells, directions: Float64s, first: int, lines: int, triangle: int, point: Vector
) -> bool:
    """Return whether a sample point is visible: from adjacent outside cells, or along some direction."""
    i, j, k = int(point[0]), int(point[1]), int(point[2])
    cell = cells.rows[i, j, k]
    if cell >= 0 and cells.depths[cell] == _DEEPEST:
        return False
    for number in range(27):
        x, y, z = i + number // 9 - 1, j + number // 3 % 3 - 1, k + number % 3 - 1
        if min(x, min(y, z)) < 0 or max(x, max(y, z)) >= _EDGE or cells.rows[x, y, z] != _OUTSIDE:
            continue
        if _escapes(cells, triangle, point, minus((x + 0.5, y + 0.5, z + 0.5), point)):
            return True
    for row in range(first, first + lines):
        if _escapes(cells, triangle, point, row_of(directions, row % len(directions))):
            return True
    return False


@part
def _escapes(cells: _TrianglesInCells, triangle: int, point: Vector, toward: Vector) -> bool:
    """Walk along a ray, cell by cell (Amanatides & Woo 1987); return whether it gets outside."""
    i, j, k = int(point[0]), int(point[1]), int(point[2])
    x = np.inf if toward[0] == 0.0 else (i + (toward[0] > 0.0) - point[0]) / toward[0]
    y = np.inf if toward[1] == 0.0 else (j + (toward[1] > 0.0) - point[1]) / toward[1]
    z = np.inf if toward[2] == 0.0 else (k + (toward[2] > 0.0) - point[2]) / toward[2]
    while 0 <= i < _EDGE and 0 <= j < _EDGE and 0 <= k < _EDGE:
        row = cells.rows[i, j, k]
        if row < 0:
            return bool(row == _OUTSIDE)
        leave = min(x, min(y, z))
        for at in range(cells.starts[row], cells.starts[row + 1]):
            other = cells.members[at]
            if other != triangle and _hits(cells, other, point, toward, leave):
                return False
        if x == leave:
            i += 1 if toward[0] > 0.0 else -1
            x += abs(1.0 / toward[0])
        elif y == leave:
            j += 1 if toward[1] > 0.0 else -1
            y += abs(1.0 / toward[1])
        else:
            k += 1 if toward[2] > 0.0 else -1
            z += abs(1.0 / toward[2])
    return True


@part
def _hits(cells: _TrianglesInCells, triangle: int, point: Vector, toward: Vector, leave: float) -> bool:
    """Return whether a ray hits a triangle before it leaves a cell (Möller & Trumbore 1997)."""
    a = row_of(cells.points, cells.triangles[triangle, 0])
    e = minus(row_of(cells.points, cells.triangles[triangle, 1]), a)
    f = minus(row_of(cells.points, cells.triangles[triangle, 2]), a)
    across = cross_product(toward, f)
    scale = dot_product(e, across)
    if scale == 0.0:
        return False
    from_a = minus(point, a)
    p = dot_product(from_a, across) / scale
    if p < -_ROUNDING or p > 1.0 + _ROUNDING:
        return False
    along = cross_product(from_a, e)
    q = dot_product(toward, along) / scale
    if q < -_ROUNDING or p + q > 1.0 + _ROUNDING:
        return False
    t = dot_product(f, along) / scale
    return bool(_TOUCHING < t <= leave + _ROUNDING)
