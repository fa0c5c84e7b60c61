"""A mesh: triangles at posed and rest positions, attributes of their corners, and points on them."""

from __future__ import annotations

from functools import cached_property
from types import NoneType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Bools, Float64s, Int32s, Integers
from octex.checks import as_array, as_reals, as_row_numbers, as_whole, locked
from octex.errors import ArgumentError, ModelError, damaged
from octex.source.corners import (
    Corners,
    Creases,
    Frames,
    Polygons,
    area_vectors,
    at_corners,
    scattered,
    unit_normals,
)  # fmt: skip
from octex.source.parts import Overlaps, overlapping_parts, parts_of
from octex.source.tangents import carried
from octex.source.welding import first_equal

#: Farther positions would overflow widths in single precision.
FARTHEST = 1e30


class SurfaceSamples(NamedTuple):
    """Points of a surface."""

    points: Float64s  # (n, 3)   posed positions
    rest: Float64s  # (n, 3)   rest positions, the texture coordinates
    normals: Float64s  # (n, 3)   unit normals of the posed triangles
    triangles: Int32s  # (n,)
    barycentric: Float64s  # (n, 3)
    rest_normals: Float64s  # (n, 3)   of the triangles at rest; zeros without area

    def __repr__(self) -> str:
        return f"<SurfaceSamples of {len(self.points):,} points>"


class Mesh:
    """Triangles at posed and at rest positions.

    vertices   (n, 3) posed positions, in the model's units
    triangles  (m, 3) rows of vertices, counter-clockwise seen from outside
    rest       (n, 3) rest positions: the vertices themselves if None
    uv         texture coordinates at corners, v running down; or None
    frames     shading normals and tangents at corners, at rest; or None
    polygons   the polygons that the triangles were cut from; None if each triangle is one
    creases    sharp edges and corners for subdivision; or None
    bounds     (2, 3) the lowest and the highest rest position that triangles use

    Arrays are copied, and those of the mesh are read-only. Raises ModelError for positions that are not
    finite, triangles that use missing vertices, no triangles, or rest positions of another shape.
    """

    def __init__(
        self,
        vertices: npt.ArrayLike,
        triangles: npt.ArrayLike,
        *,
        rest: npt.ArrayLike | None = None,
        uv: Corners | None = None,
        frames: Frames | None = None,
        polygons: Polygons | None = None,
        creases: Creases | None = None,
        name: str = "surface",
    ) -> None:
        self.vertices = as_positions(vertices, f"{name}: vertices")
        self.triangles = as_triangles(triangles, len(self.vertices), name)
        self.rest = self.vertices if rest is None else as_positions(rest, f"{name}: rest positions")
        if len(self.rest) != len(self.vertices):
            raise ModelError(
                f"{name}: {len(self.rest)} rest positions for {len(self.vertices)} vertices; give one each"
            )
        if not isinstance(uv, (Corners, NoneType)) or not isinstance(frames, (Frames, NoneType)):
            raise ArgumentError(f"{name}: uv must be Corners, and frames must be Frames, or None")
        self.uv = uv and _locked_corners(uv)
        self.frames = frames and _locked_frames(frames)
        if not isinstance(polygons, (Polygons, NoneType)):
            raise ArgumentError(f"{name}: polygons must be Polygons, or None")
        shapes = ((len(self.triangles),), (len(self.triangles), 3))
        for array, shape in zip(polygons or (), shapes, strict=False):
            if array.shape != shape or array.dtype.kind not in "iu" or (array < 0).any():
                raise ArgumentError(f"{name}: polygons must be whole numbers from 0 on, of shapes {shapes}")
        self.polygons = polygons and Polygons(*(_owned(array, np.int32) for array in polygons))
        self.creases = None if creases is None else as_creases(creases, len(self.vertices), name)
        self.name = name
        is_used = self._used(self.triangles)
        self.bounds: Float64s = locked(
            np.array([self.rest[is_used].min(axis=0), self.rest[is_used].max(axis=0)])
        )

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name!r} of {len(self.triangles):,} triangles>"

    def with_rest(self, rest: npt.ArrayLike) -> Mesh:
        """Return the same mesh at other rest positions (n, 3), its frames carried along.

        Raises ModelError for another number of them, or if they are not finite.
        """
        positions = as_positions(rest, f"{self.name}: rest positions")
        mesh = self.with_positions(self.vertices, positions)
        if self.frames is not None:
            mesh.frames = _locked_frames(carried(self.frames, self.triangles, self.rest, positions))
        return mesh

    def with_pose(self, vertices: npt.ArrayLike) -> Mesh:
        """Return the same mesh at other posed positions (n, 3); it rests where it does.

        Raises ModelError for another number of them, or if they are not finite.
        """
        posed = as_positions(vertices, f"{self.name}: posed positions")
        if len(posed) != len(self.vertices):
            raise ModelError(
                f"{self.name}: {len(posed)} posed positions for {len(self.vertices)} vertices; give one each"
            )
        return self.with_positions(posed, self.rest)

    def posed_frames(self, numbers: Int32s | None = None) -> Frames | None:
        """Return the frames of the posed mesh, each moved with its triangle; None if there are none.

        With the ``numbers`` (k,) of triangles, return only their frames.
        """
        frames, triangles = self.frames, self.triangles
        if frames is not None and numbers is not None:
            frames, triangles = frames.of(numbers), triangles[numbers]
        if frames is None or self.rest is self.vertices:
            return frames
        return carried(frames, triangles, self.rest, self.vertices)

    def with_positions(self, vertices: Float64s, rest: Float64s) -> Mesh:
        """Return the same mesh at other posed and rest positions (n, 3); frames do not change."""
        return Mesh(
            vertices, self.triangles, rest=rest, uv=self.uv, frames=self.frames, polygons=self.polygons,
            creases=self.creases, name=self.name,
        )  # fmt: skip

    def picked(self, triangles: npt.ArrayLike) -> tuple[Mesh, Int32s, Int32s]:
        """Return chosen triangles (k,) as a mesh with only their vertices, and the old numbers of both.

        Raises ArgumentError for unknown triangles, ModelError for an empty list.
        """
        numbers = as_row_numbers(triangles, len(self.triangles), "triangle").astype(np.int32)
        faces = self.triangles[numbers]
        is_used = self._used(faces)
        renumbered = np.cumsum(is_used, dtype=np.int32) - np.int32(1)
        creases = self.creases
        if creases is not None:
            edges, points = is_used[creases.edges].all(axis=1), is_used[creases.vertices]
            creases = Creases(
                renumbered[creases.edges[edges]], creases.sharpness[edges],
                renumbered[creases.vertices[points]], creases.spikes[points],
            )  # fmt: skip
        mesh = Mesh(
            self.vertices[is_used],
            renumbered[faces],
            rest=None if self.rest is self.vertices else self.rest[is_used],
            uv=self.uv and self.uv.of(numbers),
            frames=self.frames and self.frames.of(numbers),
            polygons=self.polygons and self.polygons.of(numbers),
            creases=creases,
            name=self.name,
        )
        return mesh, numbers, np.flatnonzero(is_used).astype(np.int32)

    def _used(self, triangles: Int32s) -> Bools:
        """Say which vertices (n,) triangles use."""
        is_used = np.zeros(len(self.vertices), np.bool_)
        is_used[triangles] = True
        return is_used

    @cached_property
    def parts(self) -> Int32s:
        """The part of each triangle (m,), numbered by their first triangles, as ``overlapping_parts`` does.

        A part is a connected component at rest, where vertices at the same position are one.
        """
        return parts_of(self.triangles, first_equal(self.rest))

    def loops(self) -> tuple[Int32s, Int32s, Int32s]:
        """Return the polygons' numbers (k,), their numbers of corners (k,), and their vertices, concatenated.

        The vertices of a polygon are in the file's order, from its first corner on, and wind as its triangles
        do. If triangles of a polygon were left out, only the other triangles' corners are listed.
        """
        numbers, sizes, first, _ = (self.polygons or Polygons.of_triangles(len(self.triangles))).loops()
        return numbers, sizes.astype(np.int32), self.triangles.ravel()[first]

    def overlapping_parts(self, margin: float = 0.0) -> Overlaps:
        """Find the parts that intersect at rest, or come nearer than ``margin`` (in the model's units).

        In an octree texture such parts share cells, and their colours bleed (Benson & Davis 2002, 4.3.1 and
        6.2). Each pair has the smallest distance of the surfaces and, for two solids, the volume of their
        intersection, by an exact boolean. ``unchecked`` lists parts that are no solids: parts inside them are
        not found. A part that intersects itself is not found.

        Raises ArgumentError for a negative margin.
        """
        return overlapping_parts(self.rest, self.triangles, margin)

    def points_at(self, triangles: Integers, barycentric: Float64s) -> Float64s:
        """Return posed positions (n, 3) of points of triangles (n,) by barycentric (n, 3); checks nothing."""
        return at_corners(self.vertices, self.triangles[triangles], barycentric)

    def rest_at(self, triangles: Integers, barycentric: Float64s) -> Float64s:
        """Return rest positions (n, 3) of points of triangles (n,) by barycentric (n, 3); checks nothing."""
        return at_corners(self.rest, self.triangles[triangles], barycentric)

    def areas(self) -> Float64s:
        """Return the posed area of each triangle (m,), in square model units."""
        areas: Float64s = np.linalg.norm(area_vectors(self.vertices[self.triangles]), axis=1) / 2
        return areas

    def scatter(self, n: int, seed: int = 0) -> SurfaceSamples:
        """Draw ``n`` points, uniform by posed area; the same seed gives the same points.

        Raises ModelError if the surface has no area, ArgumentError for a negative ``n``.
        """
        n = as_whole(n, "n, the number of points,", 0, 2**32)
        seed = as_whole(seed, "seed", 0, 2**128)
        areas = self.areas()
        if not areas.any():
            raise ModelError(
                f"{self.name}: all triangles are degenerate, there is no area to scatter points on"
            )
        triangles, barycentric = scattered(areas, n, seed)
        normals = rest_normals = unit_normals(self.vertices[self.triangles[triangles]])
        if self.rest is not self.vertices:
            rest_normals = unit_normals(self.rest[self.triangles[triangles]])
        return SurfaceSamples(
            points=self.points_at(triangles, barycentric),
            rest=self.rest_at(triangles, barycentric),
            normals=normals,
            triangles=triangles.astype(np.int32),
            barycentric=barycentric,
            rest_normals=rest_normals,
        )


def as_positions(positions: npt.ArrayLike, what: str) -> Float64s:
    """Return a read-only copy of positions (n, 3), or raise ModelError, which calls them ``what``."""
    array = as_array(positions)
    if array.dtype.kind not in "fiu":
        raise ModelError(f"{what} must be numbers of shape (n, 3)")
    array = _owned(array, np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ModelError(f"{what} must have shape (n, 3), not {array.shape}")
    usable = (np.abs(array) <= FARTHEST).all(axis=1)
    if not usable.all():
        first = int(np.argmin(usable))
        x, y, z = array[first].tolist()
        raise ModelError(
            f"{what} are not all finite (and below {FARTHEST:g}): number {first} is {x:g}, {y:g}, {z:g}; "
            "repair the model (--repair leaves such triangles out)"
        )
    return array


def as_triangles(array_like: npt.ArrayLike, vertices: int, name: str) -> Int32s:
    """Return triangles (m, 3) of ``vertices`` vertices, or raise ModelError."""
    triangles = as_array(array_like)
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        kind = f"{triangles.dtype} {triangles.shape}"
        raise ModelError(f"{name}: triangles must be whole numbers of shape (m, 3), not {kind}")
    if len(triangles) == 0:
        raise ModelError(f"{name} has no triangles; octex needs a surface, not points or lines")
    check_below(triangles, vertices, f"{name}: a triangle uses vertex")
    return _owned(triangles, np.int32)


def check_below(numbers: Integers, count: int, what: str) -> None:
    """Raise ModelError, which begins with ``what``, unless all numbers are from 0 on and below ``count``."""
    low, high = int(numbers.min(initial=0)), int(numbers.max(initial=0))
    if numbers.size and not 0 <= low <= high < count:
        raise damaged(f"{what} {low if low < 0 else high}, but there are {count}")


def _owned(array_like: npt.ArrayLike, dtype: type) -> Array:
    """Return a read-only copy of an array, or the array itself if it owns its memory and is read-only."""
    if isinstance(array_like, np.ndarray) and array_like.base is None and not array_like.flags.writeable:
        return np.asarray(array_like, dtype, order="C")
    array: Array = np.array(array_like, dtype, order="C")
    array.flags.writeable = False
    return array


def as_creases(creases: Creases, vertices: int, name: str) -> Creases:
    """Return a read-only copy of creases, or raise ArgumentError."""
    if not isinstance(creases, Creases):
        raise ArgumentError(f"{name}: creases must be Creases, or None")
    edges = as_reals(creases.edges, f"{name}: edges of creases", (-1, 2), most=vertices - 1)
    points = as_reals(creases.vertices, f"{name}: vertices of creases", (-1,), most=vertices - 1)
    for numbers in (edges, points):
        if (numbers < 0).any() or (numbers != np.floor(numbers)).any():
            raise ArgumentError(f"{name}: creases must name vertices by whole numbers from 0 on")
    sharpness = as_reals(creases.sharpness, f"{name}: sharpness of creases", (len(edges),), most=1e30)
    spikes = as_reals(creases.spikes, f"{name}: sharpness of vertices", (len(points),), most=1e30)
    types = (np.int32, np.float32, np.int32, np.float32)
    return Creases(*map(_owned, (edges, sharpness, points, spikes), types))


def _locked_frames(frames: Frames) -> Frames:
    return Frames(*map(_locked_corners, frames))


def _locked_corners(corners: Corners) -> Corners:
    if not any(array.flags.writeable for array in corners):
        return corners
    return Corners(locked(corners.values), locked(corners.rows))
