"""Vertex colours of an octree texture, on a mesh that is divided until they follow it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Float32s, Float64s, Int64s
from octex.channels import ALPHA, BASE_COLOR, linear_to_srgb
from octex.checks import as_choice, as_number, as_whole
from octex.errors import ArgumentError
from octex.source.corners import Corners
from octex.source.materials import AlphaMode, Input, Material, MaterialSource
from octex.source.surface import Surface, as_surface
from octex.texture import OctreeTexture, as_texture

#: Edges are not divided below this part of the finest cells ...
_FINEST = 0.5
#: ... nor oftener than so.
_MOST_ROUNDS = 16
#: Where on an edge, and on a triangle, colours are compared: shares of the corners.
_ON_EDGES = ((0.75, 0.25), (0.5, 0.5), (0.25, 0.75))
_ON_TRIANGLES = ((1 / 3, 1 / 3, 1 / 3), (0.6, 0.2, 0.2), (0.2, 0.6, 0.2), (0.2, 0.2, 0.6))


class _Points(NamedTuple):
    """Vertices of a mesh that is being divided."""

    posed: Float64s  # (n, 3)
    rest: Float64s  # (n, 3)
    normals: Float64s  # (n, 3)   at rest
    colors: Float32s  # (n, 4)   linear light, and alpha

    def with_others(self, others: _Points) -> _Points:
        """Return these points and others after them."""
        return _Points._make(np.concatenate([a, b]) for a, b in zip(self, others, strict=True))

    def between(self, ends: Int64s, texture: OctreeTexture, shares: Sequence[float]) -> _Points:
        """Return points between others, given by their numbers (k, 2 or 3), with shares of each."""
        posed, rest, normals = (_mixed(each, ends, shares) for each in self[:3])
        return _Points(posed, rest, normals, _colors(texture, rest, normals))


def bake_vertices(
    texture: OctreeTexture,
    surface: Surface,
    *,
    subdivide: float | Literal["auto"] | None = None,
    max_error: float = 8.0,
    most_triangles: int = 5_000_000,
) -> Surface:
    """Return a surface with the base colour, and alpha, of a texture at its vertices.

    subdivide    None: the triangles as they are. A length, in the units of rest positions: edges are halved
                 until none is longer. "auto": edges are halved where colours between their ends are off by
                 more than ``max_error`` codes of 255 in sRGB, down to half of the texture's finest cells
    most_triangles  the halving ends before there would be more

    It has no shading normals: viewers shade it flat.

    Neighbours divide a shared edge alike: there are no cracks. Raises ArgumentError for numbers out of range,
    and for a texture without base_color.
    """
    as_texture(texture)
    as_surface(surface)
    if BASE_COLOR.name not in texture.channels:
        names = ", ".join(texture.channels)
        raise ArgumentError(f"vertex colours are of base_color; the texture has {names}")
    longest = None
    if isinstance(subdivide, str):
        as_choice(subdivide, ("auto",), "subdivide")
    elif subdivide is not None:
        longest = as_number(subdivide, "subdivide", 0.0, np.inf)
    error = as_number(max_error, "max_error", 0.0, 255.0) / 255.0
    most = as_whole(most_triangles, "most_triangles", 1, 2**31 - 1)
    surface = surface.placed_in(texture)
    triangles = surface.triangles.astype(np.int64)
    normals = _vertex_normals(surface)
    points = _Points(surface.vertices, surface.rest, normals, _colors(texture, surface.rest, normals))
    shortest = _FINEST * texture.placement.size / 2**texture.tree.max_depth
    for _ in range(0 if subdivide is None else _MOST_ROUNDS):
        edges, sides = _edges_of(triangles)
        lengths = np.linalg.norm(points.rest[edges[:, 0]] - points.rest[edges[:, 1]], axis=1)
        if longest is not None:
            halved = lengths > max(longest, shortest)
        else:
            halved = lengths > shortest
            chosen = halved[sides].any(axis=1)
            chosen[chosen] = _is_off(points, triangles[chosen], texture, error, _ON_TRIANGLES)
            within = np.zeros(len(edges), np.bool_)
            within[sides[chosen]] = True
            undecided = halved & ~within
            halved[undecided] = _is_off(points, edges[undecided], texture, error, _ON_EDGES)
        if not halved.any() or len(triangles) + int(halved[sides].sum()) > most:
            break
        made = points.between(edges[halved], texture, _ON_EDGES[1])
        numbers = np.full(len(edges), -1, np.int64)
        numbers[halved] = len(points.rest) + np.arange(len(made.rest))
        points = points.with_others(made)
        triangles = _divided(triangles, numbers[sides], points.rest)
    faces = triangles.astype(np.int32)
    mode: AlphaMode = "blend" if ALPHA.name in texture.channels else "opaque"
    material = Material({"base_color": Input((1.0, 1.0, 1.0)), "alpha": Input((1.0,))}, mode)
    source = MaterialSource(
        [material], np.zeros(len(faces), np.int32), points.rest, faces,
        colors=Corners(points.colors, faces), name=surface.name,
    )  # fmt: skip
    return Surface(
        points.posed, faces, source, rest=points.rest, name=surface.name, provenance=surface.provenance
    )


def _vertex_normals(surface: Surface) -> Float64s:
    """Return normals at rest of the vertices (n, 3), of any length: the sums of their triangles' by area."""
    corners = surface.rest[surface.triangles]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = np.zeros_like(surface.rest)
    for corner in range(3):
        np.add.at(sums, surface.triangles[:, corner], crosses)
    return sums


def _colors(texture: OctreeTexture, rest: Float64s, normals: Float64s) -> Float32s:
    names = [name for name in (BASE_COLOR.name, ALPHA.name) if name in texture.channels]
    found = texture.sample(rest, names, normals=normals)
    colors = np.ones((len(rest), 4), np.float32)
    colors[:, :3] = found[BASE_COLOR.name]
    if ALPHA.name in found:
        colors[:, 3:] = found[ALPHA.name]
    return np.clip(colors, 0.0, 1.0)


def _edges_of(triangles: Int64s) -> tuple[Int64s, Int64s]:
    """Return the edges (k, 2) of triangles, each once, and which of them are each triangle's sides (m, 3)."""
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    ends.sort(axis=1)
    keys = ends[:, 0] << 32 | ends[:, 1]
    distinct, sides = np.unique(keys, return_inverse=True)
    return np.stack([distinct >> 32, distinct & 0xFFFFFFFF], axis=1), sides.reshape(-1, 3)


def _is_off(
    points: _Points, ends: Int64s, texture: OctreeTexture, error: float, places: Sequence[Sequence[float]]
) -> Bools:
    """Say between which ends, of edges or triangles (k, 2 or 3), colours differ by more than an error."""
    found = np.zeros(len(ends), np.bool_)
    for shares in places:
        left = np.flatnonzero(~found)
        own = points.between(ends[left], texture, shares).colors
        mixed = _mixed(points.colors, ends[left], shares)
        found[left] = (np.abs(_codes(own) - _codes(mixed)) > error).any(axis=1)
    return found


def _mixed(values: Array, ends: Int64s, shares: Sequence[float]) -> Float64s:
    """Return shares (j,) of values at their ends (k, j), added up."""
    return np.asarray(sum(share * values[ends[:, n]] for n, share in enumerate(shares)), np.float64)


def _codes(colors: Array) -> Float64s:
    codes = linear_to_srgb(colors)
    codes[:, 3] = colors[:, 3]
    return codes


def _divided(triangles: Int64s, middles: Int64s, rest: Float64s) -> Int64s:
    """Divide triangles (m, 3) at the middles of their sides (m, 3), −1 for none, in two, three or four."""
    counts = (middles >= 0).sum(axis=1)
    made = [triangles[counts == 0]]
    # Turned so that what is divided comes first: one side, two that follow each other, or all.
    first = np.where(counts == 1, np.argmax(middles >= 0, axis=1), 0)
    first = np.where(counts == 2, (np.argmax(middles < 0, axis=1) + 1) % 3, first)
    turns = (first[:, None] + np.arange(3)) % 3
    turned = np.take_along_axis(triangles, turns, axis=1)
    (a, b, c), (p, q, r) = turned.T, np.take_along_axis(middles, turns, axis=1).T
    one, two, three = (counts == count for count in (1, 2, 3))
    made += [_faces(a, p, c)[one], _faces(p, b, c)[one]]
    made += [_faces(*each)[three] for each in ((a, p, r), (p, b, q), (r, q, c), (p, q, r))]
    made.append(_faces(p, b, q)[two])
    # The rest is a, p, q, c: cut along its shorter diagonal.
    own = np.flatnonzero(two)
    short = np.linalg.norm(rest[a[own]] - rest[q[own]], axis=1) < np.linalg.norm(
        rest[p[own]] - rest[c[own]], axis=1
    )
    made += [_faces(a, p, q)[own[short]], _faces(a, q, c)[own[short]]]
    made += [_faces(a, p, c)[own[~short]], _faces(p, q, c)[own[~short]]]
    return np.concatenate(made)


def _faces(a: Int64s, b: Int64s, c: Int64s) -> Int64s:
    return np.stack([a, b, c], axis=1)
