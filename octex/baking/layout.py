"""Where triangles lie in a map, and which of their sides are edges of charts."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np

from octex.arrays import Bools, Float64s, Int32s, Int64s
from octex.errors import ModelError
from octex.source.corners import Corners
from octex.source.mesh import Mesh
from octex.source.parts import join
from octex.source.welding import first_equal, sides_across

#: Where texture coordinates come from: the model, or an atlas.
Layouts = Literal["auto", "keep", "atlas", "xatlas"]
LAYOUTS: tuple[Layouts, ...] = get_args(Layouts)
#: Coordinates within this distance of whole numbers are rounded.
BEYOND = 1e-4
#: Default texels around charts that are filled.
PADDING = 8
#: Most repetitions of the map within a triangle.
_MOST_REPEATS = 16
#: Ends of edges within this distance, in texels, are one point of the map.
_SAME = 1e-3


class Layout(NamedTuple):
    """Where triangles lie in a map.

    Coordinates outside the unit square repeat: a triangle is drawn in each square that it reaches.
    """

    uv: Corners  # texture coordinates of the surface's triangles, v down
    corners: Float64s  # (k, 3, 2)   drawn triangles, in texels, x to the right and y down
    faces: Int32s  # (k,)   the surface's triangle of each
    charts: Int32s  # (k,)
    edges: Bools  # (k, 3)   sides that are edges of charts; side n goes from corner n to the next
    width: int
    height: int
    padding: int = PADDING  # texels around charts

    def of(self, chosen: Bools) -> Layout:
        """Return the layout of the chosen drawn triangles."""
        return self._replace(
            corners=self.corners[chosen],
            faces=self.faces[chosen],
            charts=self.charts[chosen],
            edges=self.edges[chosen],
        )

    def sized(self, size: int) -> Layout:
        """Return the same layout for square maps of another size."""
        return self._replace(corners=self.corners * (size / self.width), width=size, height=size)


def unit_area(layout: Layout) -> float:
    """Return the area of the triangles in a map, as a part of it; overlaps count each time."""
    corners = layout.uv.values[layout.uv.rows].astype(np.float64)
    return float(np.abs(doubled_areas(corners)).sum() / 2)


def kept_layout(mesh: Mesh, size: int, padding: int = PADDING) -> Layout:
    """Lay a surface out by its texture coordinates, unless a triangle repeats the map often."""
    if mesh.uv is None:
        raise ModelError(f"{mesh.name} has no texture coordinates to keep; let octex make an atlas")
    uv = mesh.uv.values[mesh.uv.rows].astype(np.float64)
    if not np.isfinite(uv).all():
        raise ModelError(f"{mesh.name}: texture coordinates are not all finite; let octex make an atlas")
    whole = np.abs(uv - np.rint(uv)) < BEYOND
    uv = np.where(whole, np.rint(uv), uv)
    low, high = np.floor(uv.min(axis=1)), np.maximum(np.ceil(uv.max(axis=1)), np.floor(uv.min(axis=1)) + 1)
    repeats = (high - low).astype(np.int64)
    if (repeats.prod(axis=1) > _MOST_REPEATS).any():
        raise ModelError(
            f"{mesh.name}: texture coordinates of a triangle reach over "
            f"{int(repeats.prod(axis=1).max()):,} squares; let octex make an atlas"
        )
    faces: Int32s = np.repeat(np.arange(len(uv), dtype=np.int32), repeats.prod(axis=1))
    starts = np.cumsum(repeats.prod(axis=1)) - repeats.prod(axis=1)
    number = np.arange(faces.size) - starts[faces]
    across, down = number % repeats[faces, 0], number // repeats[faces, 0]
    moved = low[faces] + np.stack([across, down], axis=1)
    charts, edges = charts_of(mesh, uv * size)
    row, column = (moved - moved.min(axis=0)).astype(np.int64).T
    squares = (charts[faces].astype(np.int64) * (row.max() + 1) + row) * (column.max() + 1) + column
    _, numbers = np.unique(squares, return_inverse=True)
    corners = (uv[faces] - moved[:, None]) * size
    return Layout(mesh.uv, corners, faces, numbers.astype(np.int32), edges[faces], size, size, padding)


def charts_of(mesh: Mesh, corners: Float64s) -> tuple[Int32s, Bools]:
    """Return charts (m,), connected on the surface and in the map, and the sides (m, 3) that are edges."""
    others, sides = neighbors(mesh)
    are_joined = _joined(corners, others, sides)
    return pieces_of(others, are_joined).astype(np.int32), ~are_joined


def pieces_of(others: Int32s, are_joined: Bools) -> Int64s:
    """Return the connected piece of each triangle (m,), from 0, of triangles joined across sides (m, 3)."""
    parents = np.arange(len(others))
    triangles, sides = np.nonzero(are_joined)
    join(parents, triangles, others[triangles, sides].astype(np.int64))
    return numbered(parents)


def numbered(groups: Int64s) -> Int64s:
    """Renumber groups (m,) from 0 up, in their order."""
    numbers: Int64s = (np.cumsum(np.bincount(groups) > 0) - 1)[groups]
    return numbers


def neighbors(mesh: Mesh) -> tuple[Int32s, Int32s]:
    """Return the triangle across each side (m, 3), −1 for none or several, and the side's number there."""
    return neighbors_of(first_equal(mesh.rest)[mesh.triangles])


def neighbors_of(faces: Int64s) -> tuple[Int32s, Int32s]:
    """Like `neighbors`, of triangles (m, 3) in which each position is one vertex."""
    found = sides_across(faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1))
    others = np.where(found < 0, -1, found // 3).astype(np.int32).reshape(-1, 3)
    return others, np.where(found < 0, -1, found % 3).astype(np.int32).reshape(-1, 3)


def _joined(corners: Float64s, others: Int32s, sides: Int32s) -> Bools:
    """Return the sides (m, 3) across which the map continues like the surface; ``corners`` in texels.

    It does not where it folds, as between the halves of mirrored coordinates.
    """
    there = np.maximum(others, 0), np.maximum(sides, 0)
    starts = corners[there[0], (there[1] + 1) % 3]  # the neighbour's side runs the other way
    same = np.abs(starts - corners).max(axis=-1) < _SAME
    same &= np.abs(corners[there] - np.roll(corners, -1, axis=1)).max(axis=-1) < _SAME
    areas = doubled_areas(corners)
    found: Bools = same & (others >= 0) & (areas[:, None] * areas[there[0]] >= 0.0)
    return found


def doubled_areas(corners: Float64s) -> Float64s:
    """Return twice the signed areas of triangles (m,) in the map."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    doubled: Float64s = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return doubled


def steps_between(rest: Float64s, flat: Float64s) -> tuple[Float64s, Float64s]:
    """Return the derivatives (m, 3) of triangles' rest positions by x and by y in a map."""
    first, second = rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]
    one, two = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    doubled = doubled_areas(flat)
    scale = np.where(doubled != 0, 1.0 / np.where(doubled != 0, doubled, 1.0), 0.0)[:, None]
    return (first * two[:, 1:] - second * one[:, 1:]) * scale, (
        second * one[:, :1] - first * two[:, :1]
    ) * scale
