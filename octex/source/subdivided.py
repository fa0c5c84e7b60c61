"""Subdivision surfaces of meshes, with their attributes: polygons in, triangles on the limit surface out."""

from __future__ import annotations

import json
from typing import Literal, TypeVar

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s
from octex.checks import as_choice, as_whole
from octex.errors import ArgumentError, ModelError
from octex.source.base import Forwarded, Source
from octex.source.corners import Corners, Creases, Polygons, area_vectors
from octex.source.mesh import Mesh, as_creases
from octex.source.subdivision import SCHEMES, CageLevel, Scheme, base_level, divided, limits
from octex.source.surface import Surface
from octex.source.welding import welded

AnyMesh = TypeVar("AnyMesh", Mesh, Surface)

#: The choices of rest positions.
RESTS = ("hull", "limit")
_MOST_TRIANGLES = 2**28


def subdivide(
    mesh: AnyMesh,
    levels: int,
    *,
    rest: Literal["hull", "limit"] = "hull",
    scheme: Scheme | None = None,
    creases: Creases | None = None,
) -> AnyMesh:
    """Subdivide a control cage, and return a mesh, or a Surface, whose vertices lie on the limit surface.

    levels    1 to 10; each divides a face in four, the first one into quads
    scheme    "catmull-clark" for polygons, "loop" for triangles (default: the one that suits the cage)
    creases   sharp edges and corners (default: those of the mesh, from OpenSubdiv's tags in OBJ files).
              Boundaries and their corners are sharp
    rest      "hull": rest positions of the cage, divided linearly, so that its textures fit; "limit":
              positions on the limit surface of the cage at rest

    Vertices at one position are merged. Texture coordinates and the source are the cage's. Polygons are the
    quads; shading normals follow from the new shape.

    Raises ArgumentError for arguments out of range; ModelError for "loop" on other polygons than triangles,
    and for more than 2²⁸ triangles.
    """
    if not isinstance(mesh, Mesh):
        raise ArgumentError(f"mesh must be an octex.Surface, not {mesh!r}")
    levels = as_whole(levels, "levels", 1, 10)
    as_choice(rest, RESTS, "rest")
    if scheme is not None:
        as_choice(scheme, SCHEMES, "scheme")
    sharp = mesh.creases if creases is None else as_creases(creases, len(mesh.vertices), mesh.name)
    cage = _Cage(mesh)
    if scheme is None:
        scheme = "loop" if (cage.sizes == 3).all() else "catmull-clark"
    if scheme == "loop" and (cage.sizes != 3).any():
        raise ModelError(
            f"{mesh.name} has polygons that are not triangles, which Loop's scheme does not support"
        )
    first = len(cage.sizes) if scheme == "loop" else len(cage.corners) // 2
    if first * 4**levels > _MOST_TRIANGLES:
        raise ModelError(f"{mesh.name}: {levels} levels make more than {_MOST_TRIANGLES:,} triangles")
    is_posed = mesh.rest is not mesh.vertices
    values = mesh.vertices
    if is_posed and rest == "limit":
        values = np.concatenate([mesh.vertices, mesh.rest], axis=1)
    level = cage.level(values, sharp)
    for _ in range(levels):
        level = divided(level, scheme)
    values = limits(level, scheme)
    faces, corners = _triangles(level, scheme, cage)
    triangles = level.corners[corners].astype(np.int32)
    parents, shares, positions = cage.located(level.faces[faces], level.domain[corners])
    hull = np.empty((len(values), 3))
    hull[triangles] = positions
    at_rest = values[:, 3:] if is_posed and rest == "limit" else values[:, :3]
    polygons = None
    if scheme == "catmull-clark":
        polygons = Polygons(faces.astype(np.int32), (corners % 4).astype(np.int32))
    uv = None
    if mesh.uv is not None:
        at_corners = np.einsum("mkc,mcx->mkx", shares, mesh.uv.values[mesh.uv.rows[parents]])
        rows = np.arange(triangles.size, dtype=np.int32).reshape(-1, 3)
        uv = Corners(at_corners.reshape(-1, 2).astype(np.float32), rows)
    subdivided = Mesh(
        values[:, :3], triangles, rest=hull if rest == "hull" else at_rest if is_posed else None, uv=uv,
        polygons=polygons, name=mesh.name,
    )  # fmt: skip
    if not isinstance(mesh, Surface):
        return subdivided
    source = OnCage(mesh.source, parents, shares, hull, subdivided.rest, subdivided.triangles)
    record = json.dumps({"scheme": scheme, "levels": levels, "rest": rest})
    return Surface._on(subdivided, source, {**mesh.provenance, "subdivided": record})


def _triangles(level: CageLevel, scheme: Scheme, cage: _Cage) -> tuple[Int64s, Int64s]:
    """Cut faces into triangles, each on one of the cage's triangles: their faces (m,), and corners (m, 3)."""
    corners = np.arange(len(level.corners)).reshape(len(level.sizes), -1)
    if scheme == "loop":
        return np.arange(len(corners)), corners
    across, up = (level.domain[2::4] - level.domain[::4]).T
    is_quad = cage.sizes[level.faces] == 4
    along = np.where(cage.is_cut_at_odd[level.faces], across * up < 0, across * up > 0) | ~is_quad
    first = np.where(along[:, None], [0, 1, 2], [1, 2, 3])
    second = np.where(along[:, None], [0, 2, 3], [1, 3, 0])
    within = np.stack([first, second], axis=1).reshape(-1, 3)
    return np.repeat(np.arange(len(corners)), 2), np.repeat(corners[:, 0], 2)[:, None] + within


class OnCage(Forwarded):
    """The source of a cage, for a mesh whose triangles lie on the cage's.

    ``parents`` (m,) are the cage's triangles under the mesh's, ``shares`` (m, 3, 3) the corners' barycentric
    coordinates in them, ``hull`` (n, 3) the vertices on the cage. Widths are measured on ``rest`` (n, 3).
    """

    def __init__(
        self, source: Source, parents: Int64s, shares: Float64s, hull: Float64s, rest: Float64s,
        triangles: Int32s,
    ) -> None:  # fmt: skip
        super().__init__(source, parents.astype(np.int32))
        self._shares = shares
        self._hull = hull
        self._triangles = triangles
        self._stretch: Float32s = np.ones(len(triangles), np.float32)
        if rest is not hull:
            on_cage, at_rest = _sizes(hull, triangles), _sizes(rest, triangles)
            has_area = (on_cage > 0) & (at_rest > 0)
            self._stretch[has_area] = on_cage[has_area] / at_rest[has_area]

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components) at points of triangles, averaged over widths in rest units."""
        on_cage = np.einsum("nk,nkc->nc", barycentric, self._shares[triangles])
        return super().evaluate(triangles, on_cage, widths * self._stretch[triangles])

    def texel_edges(self, triangles: Int32s) -> Float32s:
        """Return the edge of a texel on triangles (n,), in rest units."""
        return super().texel_edges(triangles) / self._stretch[triangles]

    def with_rest(self, rest: Float64s) -> OnCage:
        """Return the same source with widths measured on other rest positions (n, 3)."""
        parents = self._targets.astype(np.int64)
        return OnCage(self._inputs[0], parents, self._shares, self._hull, rest, self._triangles)


def _sizes(positions: Float64s, triangles: Int32s) -> Float64s:
    """Return the roots of the doubled areas of triangles (m,)."""
    return np.asarray(np.sqrt(np.linalg.norm(area_vectors(positions[triangles]), axis=1)))


class _Cage:
    """The polygons of a mesh, each with a plane; vertices at one position are merged."""

    def __init__(self, mesh: Mesh) -> None:
        polygons = mesh.polygons or Polygons.of_triangles(len(mesh.triangles))
        # The corner of a polygon for each corner of a triangle.
        numbers, self.sizes, first, self._at = polygons.loops()
        used = mesh.triangles.ravel()
        self._positions = welded(np.concatenate([mesh.vertices, mesh.rest], axis=1))
        positions, first_uses = np.unique(self._positions[used], return_index=True)
        self._vertices = used[first_uses]  # one of the mesh's vertices at each position
        self._numbers = np.full(int(self._positions.max()) + 1, -1, np.int64)
        self._numbers[positions] = np.arange(len(positions))
        self.corners: Int64s = self._numbers[self._positions[used[first]]]
        self._rest = mesh.rest[mesh.triangles]
        self._domain = _domain(self.sizes)
        owners = np.searchsorted(numbers, polygons.numbers)
        self._order = np.argsort(owners, kind="stable")
        self._counts = np.bincount(owners, minlength=len(self.sizes))
        self._starts = np.cumsum(self._counts) - self._counts
        within = self._at[self._order[self._starts]] - (np.cumsum(self.sizes) - self.sizes)[:, None]
        missing = 6 - within.sum(axis=1)  # the corner that the first triangle lacks
        self.is_cut_at_odd: Bools = (self.sizes == 4) & (missing % 2 == 0)  # between corners 1 and 3
        a, b, c = self._domain[self._at].transpose(1, 0, 2)
        self._origins, self._maps = a, np.linalg.inv(np.stack([b - a, c - a], axis=2))

    def level(self, values: Float64s, creases: Creases | None) -> CageLevel:
        """Return the first level, of values (n, k) at the mesh's vertices."""
        edges, points = np.empty((0, 2), np.int64), np.empty(0, np.int64)
        sharpness = spikes = np.empty(0)
        if creases is not None:
            edges = self._numbers[self._positions[creases.edges]]
            points = self._numbers[self._positions[creases.vertices]]
            has_edge, has_point = (edges >= 0).all(axis=1), points >= 0
            edges, points = edges[has_edge], points[has_point]
            sharpness = creases.sharpness[has_edge].astype(np.float64)
            spikes = creases.spikes[has_point].astype(np.float64)
        vertices, sharp = values[self._vertices], ((edges, sharpness), (points, spikes))
        return base_level(vertices, self.corners, self.sizes, self._domain, *sharp)

    def located(self, faces: Int64s, points: Float64s) -> tuple[Int64s, Float64s, Float64s]:
        """Locate triangles (m, 3, 2), in the planes of faces (m,), on the cage.

        Returns the cage's triangles (m,), barycentric coordinates in them, and rest positions (m, 3, 3).
        """
        parents = self._holders(faces, points.mean(axis=1))
        shares = self._shares(parents[:, None], points)
        positions = np.einsum("mkc,mcx->mkx", shares, self._rest[parents])
        # In polygons of more than four corners a triangle may lie on several: locate its corners one by one.
        across = np.flatnonzero((self.sizes[faces] > 4) & (shares.min(axis=(1, 2)) < -1e-9))
        if len(across):
            corners = points[across].reshape(-1, 2)
            holders = self._holders(np.repeat(faces[across], 3), corners)
            located = np.einsum("nc,ncx->nx", self._shares(holders, corners), self._rest[holders])
            located = located.reshape(-1, 3, 3)
            positions[across] = located
            # Barycentric coordinates in the planes of the triangles, where these have area.
            triangles = self._rest[parents[across]]
            sides = triangles[:, 1:] - triangles[:, :1]
            along = np.einsum("nkx,nxs->nks", located - triangles[:, :1], np.linalg.pinv(sides))
            wide = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) > 0
            shares[across[wide], :, 0], shares[across[wide], :, 1:] = 1 - along[wide].sum(axis=2), along[wide]
        return parents, shares, positions

    def _holders(self, faces: Int64s, points: Float64s) -> Int64s:
        """Return the triangle, of the point's face, that holds each point (n, 2)."""
        parents: Int64s = self._order[self._starts[faces]]
        counts = self._counts[faces]
        best = np.full(len(faces), -np.inf)
        for k in range(int(counts.max()) if counts.max() > 1 else 0):
            rows = np.flatnonzero(counts > k)
            triangles = self._order[self._starts[faces[rows]] + k]
            inside = self._shares(triangles, points[rows]).min(axis=1)
            better = inside > best[rows]
            best[rows[better]], parents[rows[better]] = inside[better], triangles[better]
        return parents

    def _shares(self, triangles: Int64s, points: Float64s) -> Float64s:
        """Return barycentric coordinates (…, 3) of points (…, 2), in their faces' planes, in triangles."""
        maps, away = self._maps[triangles], points - self._origins[triangles]
        shares = np.empty((*points.shape[:-1], 3))
        for row in (0, 1):
            shares[..., 1 + row] = maps[..., row, 0] * away[..., 0] + maps[..., row, 1] * away[..., 1]
        shares[..., 0] = 1 - shares[..., 1] - shares[..., 2]
        return shares


def _domain(sizes: Int64s) -> Float64s:
    """Return the corners of faces in each face's plane (c, 2): on half a square, a square, or a circle."""
    firsts = np.repeat(np.cumsum(sizes) - sizes, sizes)
    within, counts = np.arange(len(firsts)) - firsts, np.repeat(sizes, sizes)
    turns = 2 * np.pi * within / counts
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])[within % 4]
    half = np.array([[0.0, 0], [1, 0], [0, 1]])[within % 3]
    regular = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    return np.select([counts[:, None] == 3, counts[:, None] == 4], [half, square], regular)
