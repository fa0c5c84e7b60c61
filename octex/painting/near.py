"""Which triangles lie near paint: found by their boxes, in coarse cells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from octex.conversion.fill import on_grid
from octex.jit import inlined, kernel
from octex.source.surface import Surface
from octex.tree.layout import GRID_BITS
from octex.tree.morton import decode_cells
from octex.tree.placement import Placement

Int32s = npt.NDArray[np.int32]
Int64s = npt.NDArray[np.int64]

#: The level of the coarse cells: 128³.
_COARSE = 7


def around(surface: Surface, chosen: Int32s, placement: Placement, reach: int) -> Int32s:
    """Return the triangles that share coarse cells, or cells beside them, with ``chosen`` ones.

    ``reach`` is the level of the coarsest cells that must be found beside them.
    """
    shift = GRID_BITS - min(_COARSE, reach)
    where = on_grid(surface.rest, placement), surface.triangles, shift
    first, last = _reach(*where, chosen)
    first, last = np.maximum(first - 1, 0), np.minimum(last + 1, (1 << (GRID_BITS - shift)) - 1)
    marked = np.zeros(last - first + 1, np.bool_)
    _mark(*where, chosen, first, marked)
    for axis in range(3):
        wide = marked.copy()
        before, after = (np.s_[:],) * axis + (np.s_[:-1],), (np.s_[:],) * axis + (np.s_[1:],)
        wide[after] |= marked[before]
        wide[before] |= marked[after]
        marked = wide
    return _reaching(*where, first, _counts(marked))


def touching(
    surface: Surface, cells: Sequence[tuple[int, npt.NDArray[np.int64]]], placement: Placement
) -> Int32s:
    """Return the triangles that may meet cells, given as levels and Morton codes."""
    marked = np.zeros((1 << _COARSE,) * 3, np.bool_)
    for level, codes in cells:
        if level >= _COARSE:
            marked[tuple((decode_cells(codes) >> (level - _COARSE)).T)] = True
            continue
        side = 1 << (_COARSE - level)
        for x, y, z in (decode_cells(codes) * side).tolist():
            marked[x : x + side, y : y + side, z : z + side] = True
    where = on_grid(surface.rest, placement), surface.triangles, GRID_BITS - _COARSE
    return _reaching(*where, np.zeros(3, np.int64), _counts(marked))


def _counts(marked: npt.NDArray[np.bool_]) -> Int32s:
    """Count the marked cells before each along all axes: a box then has a sum of eight of them."""
    counts = np.zeros(tuple(n + 1 for n in marked.shape), np.int32)
    inner = marked.cumsum(0, np.int32)
    np.cumsum(inner, 1, out=inner)
    np.cumsum(inner, 2, out=counts[1:, 1:, 1:])
    return counts


@inlined
def _range(grid: Int32s, triangles: Int32s, triangle: int, axis: int, shift: int) -> tuple[int, int]:
    """Return the first and the last coarse cell that a triangle reaches along an axis."""
    a = grid[triangles[triangle, 0], axis]
    b = grid[triangles[triangle, 1], axis]
    c = grid[triangles[triangle, 2], axis]
    return int(min(a, min(b, c))) >> shift, int(max(a, max(b, c))) >> shift


@kernel
def _reach(grid: Int32s, triangles: Int32s, shift: int, chosen: Int32s) -> tuple[Int64s, Int64s]:
    """Return the first and the last coarse cell that chosen triangles reach along each axis."""
    first, last = np.full(3, 1 << GRID_BITS), np.full(3, -1)
    for n in range(chosen.size):
        for axis in range(3):
            low, high = _range(grid, triangles, int(chosen[n]), axis, shift)
            first[axis], last[axis] = min(first[axis], low), max(last[axis], high)
    return first, last


@kernel
def _mark(
    grid: Int32s, triangles: Int32s, shift: int, chosen: Int32s, first: Int64s, marked: npt.NDArray[np.bool_]
) -> None:
    """Mark the coarse cells, from ``first`` on, that the boxes of chosen triangles reach."""
    for n in range(chosen.size):
        triangle = int(chosen[n])
        x0, x1 = _range(grid, triangles, triangle, 0, shift)
        y0, y1 = _range(grid, triangles, triangle, 1, shift)
        z0, z1 = _range(grid, triangles, triangle, 2, shift)
        for x in range(x0 - first[0], x1 - first[0] + 1):
            for y in range(y0 - first[1], y1 - first[1] + 1):
                for z in range(z0 - first[2], z1 - first[2] + 1):
                    marked[x, y, z] = True


@kernel
def _reaching(grid: Int32s, triangles: Int32s, shift: int, first: Int64s, counts: Int32s) -> Int32s:
    """Return the triangles whose boxes reach a coarse cell that is marked, of those from ``first`` on."""
    found = np.empty(triangles.shape[0], np.int32)
    count = 0
    for triangle in range(triangles.shape[0]):
        x0, x1 = _within(grid, triangles, triangle, 0, shift, first, counts.shape)
        y0, y1 = _within(grid, triangles, triangle, 1, shift, first, counts.shape)
        z0, z1 = _within(grid, triangles, triangle, 2, shift, first, counts.shape)
        inside = (
            counts[x1, y1, z1]
            - counts[x0, y1, z1]
            - counts[x1, y0, z1]
            - counts[x1, y1, z0]
            + counts[x0, y0, z1]
            + counts[x0, y1, z0]
            + counts[x1, y0, z0]
            - counts[x0, y0, z0]
        )
        found[count] = triangle
        count += inside > 0
    return found[:count].copy()


@inlined
def _within(
    grid: Int32s,
    triangles: Int32s,
    triangle: int,
    axis: int,
    shift: int,
    first: Int64s,
    shape: tuple[int, int, int],
) -> tuple[int, int]:
    """Return the rows of counts between which a triangle lies; the same one twice outside."""
    low, high = _range(grid, triangles, triangle, axis, shift)
    end = shape[axis] - 1
    return min(max(low - first[axis], 0), end), min(max(high - first[axis] + 1, 0), end)
