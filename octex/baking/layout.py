"""Where triangles lie in a map, and which of their sides are edges of charts."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np

from octex.arrays import Array, Bools, Float64s, Int32s, Int64s, Integers, in_runs
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

    def of(self, chosen: Bools | Int32s) -> Layout:
        """Return the layout of the chosen drawn triangles."""
        columns = ("corners", "faces", "charts", "edges")
        return self._replace(**{name: getattr(self, name)[chosen] for name in columns})

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
    is_whole = np.abs(uv - np.rint(uv)) < BEYOND
    uv = np.where(is_whole, np.rint(uv), uv)
    low = np.floor(uv.min(axis=1))
    repeats = (np.maximum(np.ceil(uv.max(axis=1)), low + 1) - low).astype(np.int64)
    counts = repeats.prod(axis=1)
    if (counts > _MOST_REPEATS).any():
        raise ModelError(
            f"{mesh.name}: texture coordinates of a triangle reach over "
            f"{int(counts.max()):,} squares; let octex make an atlas"
        )
    faces: Int32s = np.repeat(np.arange(len(uv), dtype=np.int32), counts)
    number = in_runs(np.zeros_like(counts), counts)
    across, down = number % repeats[faces, 0], number // repeats[faces, 0]
    square = low[faces] + np.stack([across, down], axis=1)
    charts, edges = charts_of(mesh, uv * size)
    row, column = (square - square.min(axis=0)).astype(np.int64).T
    squares = (charts[faces].astype(np.int64) * (row.max() + 1) + row) * (column.max() + 1) + column
    _, numbers = np.unique(squares, return_inverse=True)
    corners = (uv[faces] - square[:, None]) * size
    return Layout(mesh.uv, corners, faces, numbers.astype(np.int32), edges[faces], size, size, padding)


def charts_of(mesh: Mesh, corners: Float64s) -> tuple[Int32s, Bools]:
    """Return charts (m,), connected on the surface and in the map, and the sides (m, 3) that are edges.

    ``corners`` (m, 3, 2) are in texels. A chart ends where the map folds, as between mirrored halves.
    """
    neighbours, sides = neighbours_of_mesh(mesh)
    beyond = np.maximum(neighbours, 0), np.maximum(sides, 0)
    starts = corners[beyond[0], (beyond[1] + 1) % 3]  # the neighbour's side runs the other way
    are_joined = np.abs(starts - corners).max(axis=-1) < _SAME
    are_joined &= np.abs(corners[beyond] - np.roll(corners, -1, axis=1)).max(axis=-1) < _SAME
    areas = doubled_areas(corners)
    are_joined &= (neighbours >= 0) & (areas[:, None] * areas[beyond[0]] >= 0.0)
    return pieces_of(neighbours, are_joined).astype(np.int32), ~are_joined


def pieces_of(neighbours: Int32s, are_joined: Bools) -> Int64s:
    """Return the connected piece of each triangle (m,), from 0, of triangles joined across sides (m, 3)."""
    parents = np.arange(len(neighbours))
    triangles, sides = np.nonzero(are_joined)
    join(parents, triangles, neighbours[triangles, sides].astype(np.int64))
    return numbered(parents)


def numbered(groups: Int64s) -> Int64s:
    """Renumber groups (m,) from 0 up, in their order."""
    numbers: Int64s = (np.cumsum(np.bincount(groups) > 0) - 1)[groups]
    return numbers


def sums_of(groups: Integers, values: Array) -> Float64s:
    """Return the sums (n, k) of the values (m, k) in each group (m,), from 0."""
    return np.stack([np.bincount(groups, column) for column in values.T], axis=1).astype(np.float64)


def neighbours_of_mesh(mesh: Mesh) -> tuple[Int32s, Int32s]:
    """Return the triangle across each side (m, 3), −1 for none or several, and the side's number there."""
    return neighbours_of(first_equal(mesh.rest)[mesh.triangles])


def neighbours_of(faces: Int64s) -> tuple[Int32s, Int32s]:
    """Like `neighbours_of_mesh`, of triangles (m, 3) in which each position is one vertex."""
    across = sides_across(faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1))
    neighbours = np.where(across < 0, -1, across // 3).astype(np.int32).reshape(-1, 3)
    return neighbours, np.where(across < 0, -1, across % 3).astype(np.int32).reshape(-1, 3)


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
