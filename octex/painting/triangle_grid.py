"""Which triangles lie near paint: found by their boxes, in coarse cells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from octex.arrays import Bools, Int32s, Int64s, Uint8s
from octex.conversion.levels import on_grid
from octex.jit import inlined, kernel
from octex.source.surface import Surface
from octex.tree.layout import GRID_BITS
from octex.tree.morton import decode_cells
from octex.tree.placement import Placement

#: The level of the coarse cells: 128³, whose coordinates fit a byte.
_COARSE = 7


class Near:
    """Where the triangles of a surface lie in a root cell: the coarse cells that their boxes reach."""

    def __init__(self, surface: Surface, placement: Placement) -> None:
        self._boxes = _boxes(on_grid(surface.rest, placement), surface.triangles, GRID_BITS - _COARSE)

    def around(self, chosen: Int32s, reach: int) -> Int32s:
        """Return the triangles that share coarse cells, or cells beside them, with ``chosen`` ones.

        ``reach`` is the level of the coarsest cells that must be found beside them.
        """
        shift = max(_COARSE - reach, 0)
        boxes = self._boxes[chosen] >> np.uint8(shift)
        first, last = boxes[:, :3].min(axis=0).astype(np.int64), boxes[:, 3:].max(axis=0).astype(np.int64)
        first, last = np.maximum(first - 1, 0), np.minimum(last + 1, (1 << (_COARSE - shift)) - 1)
        marked = np.zeros(last - first + 1, np.bool_)
        _mark(boxes, first, marked)
        for axis in range(3):
            wide = marked.copy()
            before, after = (np.s_[:],) * axis + (np.s_[:-1],), (np.s_[:],) * axis + (np.s_[1:],)
            wide[after] |= marked[before]
            wide[before] |= marked[after]
            marked = wide
        return _reaching(self._boxes, shift, first, _counts(marked))

    def touching(self, cells: Sequence[tuple[int, Int64s]]) -> Int32s:
        """Return the triangles that may meet cells, given as levels and Morton codes."""
        ends = [(_coarse(codes, level, 0), _coarse(codes, level, 1)) for level, codes in cells if codes.size]
        if not ends:
            return np.empty(0, np.int32)
        first = np.min([low.min(axis=0) for low, _ in ends], axis=0)
        marked = np.zeros(np.max([high.max(axis=0) for _, high in ends], axis=0) - first, np.bool_)
        for low, high in ends:
            if ((high - low) == 1).all():
                marked[tuple((low - first).T)] = True
                continue
            for (x, y, z), (u, v, w) in zip((low - first).tolist(), (high - first).tolist(), strict=True):
                marked[x:u, y:v, z:w] = True
        return _reaching(self._boxes, 0, first, _counts(marked))


def _coarse(codes: Int64s, level: int, end: int) -> Int64s:
    """Return the first coarse cell (n, 3) that cells of a level reach; with ``end`` 1 that after the last."""
    cells = decode_cells(codes)
    if level >= _COARSE:
        return (cells >> (level - _COARSE)) + end
    return (cells + end) << (_COARSE - level)


def _counts(marked: Bools) -> Int32s:
    """Count the marked cells before each along all axes: a box then has a sum of eight of them."""
    counts = np.zeros(tuple(n + 1 for n in marked.shape), np.int32)
    inner = marked.cumsum(0, np.int32)
    np.cumsum(inner, 1, out=inner)
    np.cumsum(inner, 2, out=counts[1:, 1:, 1:])
    return counts


@kernel
def _boxes(grid: Int32s, triangles: Int32s, shift: int) -> Uint8s:
    """Return the first and the last coarse cell that triangles reach along each axis (m, 6)."""
    boxes = np.empty((triangles.shape[0], 6), np.uint8)
    for triangle in range(triangles.shape[0]):
        for axis in range(3):
            a = grid[triangles[triangle, 0], axis]
            b = grid[triangles[triangle, 1], axis]
            c = grid[triangles[triangle, 2], axis]
            boxes[triangle, axis] = min(a, min(b, c)) >> shift
            boxes[triangle, 3 + axis] = max(a, max(b, c)) >> shift
    return boxes


@kernel
def _mark(boxes: Uint8s, first: Int64s, marked: Bools) -> None:
    """Mark the coarse cells, from ``first`` on, that boxes reach."""
    for n in range(boxes.shape[0]):
        for x in range(np.int64(boxes[n, 0]) - first[0], np.int64(boxes[n, 3]) - first[0] + 1):
            for y in range(np.int64(boxes[n, 1]) - first[1], np.int64(boxes[n, 4]) - first[1] + 1):
                for z in range(np.int64(boxes[n, 2]) - first[2], np.int64(boxes[n, 5]) - first[2] + 1):
                    marked[x, y, z] = True


@kernel
def _reaching(boxes: Uint8s, shift: int, first: Int64s, counts: Int32s) -> Int32s:
    """Return the triangles whose boxes reach a coarse cell that is marked, of those from ``first`` on."""
    found = np.empty(boxes.shape[0], np.int32)
    count = 0
    for triangle in range(boxes.shape[0]):
        x0, x1 = _within(boxes, triangle, 0, shift, first, counts.shape)
        if x0 == x1:
            continue
        y0, y1 = _within(boxes, triangle, 1, shift, first, counts.shape)
        z0, z1 = _within(boxes, triangle, 2, shift, first, counts.shape)
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
    boxes: Uint8s, triangle: int, axis: int, shift: int, first: Int64s, shape: tuple[int, int, int]
) -> tuple[int, int]:
    """Return the rows of counts between which a triangle lies; the same one twice outside."""
    low, high = np.int64(boxes[triangle, axis]) >> shift, np.int64(boxes[triangle, 3 + axis]) >> shift
    end = shape[axis] - 1
    return min(max(low - first[axis], 0), end), min(max(high - first[axis] + 1, 0), end)
