"""Bakes vertex colours, on a mesh that is subdivided until they match the texture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Float32s, Float64s, Floats, Int32s, Int64s
from octex.baking.coordinates import cell_of
from octex.baking.directions import NOWHERE
from octex.baking.tessellation import edges_of, in_order
from octex.channels import ALPHA, BASE_COLOR, encode
from octex.checks import as_choice, as_number, as_whole
from octex.errors import ArgumentError
from octex.source.corners import Corners, area_vectors, frames_of, unit
from octex.source.materials import AlphaMode, Input, Material, MaterialSource
from octex.source.surface import Surface, as_surface
from octex.source.welding import distinct_rows, welded
from octex.texture import OctreeTexture, as_texture

#: By their colours, edges are not halved below this part of the finest cells.
_FINEST = 0.5
#: By their colours, an edge is halved with the longest side of its triangle if that is longer by this factor:
#: else triangles get ever thinner.
_THIN = 1.5
#: Most rounds in which edges are halved.
_MOST_ROUNDS = 32
#: Barycentric positions where colours are compared, on edges first the middle: the field is a quadratic
#: spline over the cells, so the middle tells how far an edge of one cell is off.
_MIDDLE = (0.5, 0.5)
_ON_EDGES = ((0.75, 0.25), (0.25, 0.75))
_ON_TRIANGLES = ((1 / 3, 1 / 3, 1 / 3), (0.6, 0.2, 0.2), (0.2, 0.6, 0.2), (0.2, 0.2, 0.6))


class _SplitVertices(NamedTuple):
    """Vertices of a mesh that is being subdivided."""

    posed: Float64s  # (n, 3)
    rest: Float64s  # (n, 3)
    facing: Float64s  # (n, 3)   normals of the triangles there, at rest, for lookups
    shading: Float64s  # (n, 3)   the surface's shading normals at rest; zero without
    colors: Float32s  # (n, 4)   linear light, and alpha
    positions: Int64s  # (n,)     equal for vertices at the same position

    def between(self, ends: Int64s, texture: OctreeTexture, shares: Sequence[float]) -> Float32s:
        """Return the texture's colours between vertices ``ends`` (k, 2 or 3), mixed by ``shares``."""
        return _colors(texture, _mixed(self.rest, ends, shares), _mixed(self.facing, ends, shares))

    def with_middles(self, ends: Int64s, texture: OctreeTexture) -> _SplitVertices:
        """Return these points, followed by the midpoints of edges (k, 2)."""
        middles = [_mixed(each, ends, _MIDDLE) for each in self[:4]]
        numbers = welded(in_order(self.positions[ends])) + int(self.positions.max()) + 1
        added = (*middles, self.between(ends, texture, _MIDDLE), numbers)
        return _SplitVertices._make(np.concatenate([a, b]) for a, b in zip(self, added, strict=True))


def bake_vertices(
    texture: OctreeTexture,
    surface: Surface,
    *,
    subdivide: float | Literal["auto"] | None = None,
    max_error: float = 8.0,
    most_triangles: int = 5_000_000,
) -> Surface:
    """Return a surface with a texture's base colour and alpha at its vertices.

    subdivide       None: keep the triangles. A length in units of rest positions: halve edges until none is
                    longer. "auto": halve edges where colours between their ends differ from the field by more
                    than ``max_error``, at most to half of the finest cells
    max_error       in 1/255 of sRGB
    most_triangles  "auto" stops before there are more triangles than this

    Neighbours halve a shared edge alike, so there are no cracks. The surface's shading normals (``frames``)
    are interpolated.

    Raises ArgumentError for numbers out of range, for a length that makes more than ``most_triangles``, and
    for a texture without base_color.
    """
    as_texture(texture)
    as_surface(surface)
    if BASE_COLOR.name not in texture.channels:
        names = ", ".join(texture.channels)
        raise ArgumentError(f"vertex colours need the channel base_color; the texture has {names}")
    longest = None
    if isinstance(subdivide, str):
        as_choice(subdivide, ("auto",), "subdivide")
    elif subdivide is not None:
        longest = as_number(subdivide, "subdivide", 0.0, np.inf)
    error = as_number(max_error, "max_error", 0.0, 255.0) / 255.0
    most = as_whole(most_triangles, "most_triangles", 1, 2**31 - 1)
    surface = surface.placed_on(texture)
    points, triangles = _undivided(texture, surface)
    cell = cell_of(texture)
    shortest = _FINEST * cell
    first = 0  # position of the last round: only edges with an end from there on can still be halved
    settled = np.empty((0, 3), np.int64)
    for _ in range(0 if subdivide is None else _MOST_ROUNDS):
        edges, sides = edges_of(triangles)
        lengths = np.linalg.norm(points.rest.take(edges[:, 0], 0) - points.rest.take(edges[:, 1], 0), axis=1)
        is_new = _any(points.positions[edges] >= first)
        if longest is not None:
            halved = is_new & (lengths > longest)
        else:
            halved = is_new & (lengths > shortest)
            halved[halved] = _is_off(points, edges[halved], texture, error, [_MIDDLE])
            is_wide = lengths > cell
            unhalved = is_new & is_wide & ~halved
            halved[unhalved] = _is_off(points, edges[unhalved], texture, error, _ON_EDGES)
            differs = _any(is_wide[sides]) & _any(~halved[sides])
            differs[differs] = _is_off(points, triangles[differs], texture, error, _ON_TRIANGLES)
            chosen = sides[differs].reshape(-1)
            halved[chosen] |= lengths[chosen] > shortest
        halved_positions = in_order(points.positions[edges[halved]])
        if longest is None:
            halved_positions = _with_longest(halved_positions, [triangles, settled], points)
        is_near = _have_two(settled, points.positions, halved_positions[halved_positions[:, 1] < first])
        candidates = np.concatenate([triangles, settled[is_near]])
        new_edges, cut, uncut = _cut_at(candidates, points.positions, halved_positions)
        is_too_many = len(triangles) + len(settled) + int((cut[1] >= 0).sum()) > most
        if len(new_edges) and is_too_many and longest is not None:
            raise ArgumentError(
                f"edges no longer than {longest:g} make more than {most:,} triangles; edges of up to "
                f"{lengths.max():g} make {len(triangles) + len(settled):,}; allow longer edges"
            )
        if not len(new_edges) or is_too_many:
            break
        first = int(points.positions.max()) + 1
        points = points.with_middles(new_edges, texture)
        settled = np.concatenate([settled[~is_near], uncut])
        triangles = _divided(*cut, points.rest)
    triangles = np.concatenate([settled, triangles])
    faces = triangles.astype(np.int32)
    frames = None
    if surface.frames is not None:
        is_known = (points.shading**2) @ np.ones(3) > NOWHERE
        frames = frames_of(unit(np.where(is_known[:, None], points.shading, points.facing)), faces)
    mode: AlphaMode = "blend" if ALPHA.name in texture.channels else "opaque"
    material = Material({"base_color": Input((1.0, 1.0, 1.0)), "alpha": Input((1.0,))}, mode)
    source = MaterialSource(
        [material], np.zeros(len(faces), np.int32), points.rest, faces,
        colors=Corners(points.colors, faces), name=surface.name,
    )  # fmt: skip
    return Surface(
        points.posed, faces, source, rest=None if surface.rest is surface.vertices else points.rest,
        frames=frames, name=surface.name, provenance=surface.provenance,
    )  # fmt: skip


def _undivided(texture: OctreeTexture, surface: Surface) -> tuple[_SplitVertices, Int64s]:
    """Return a surface's vertices, split where shading normals differ, and its triangles (m, 3)."""
    corners = np.zeros((3 * len(surface.triangles), 2), np.int64)
    corners[:, 0] = surface.triangles.reshape(-1)
    if surface.frames is not None:
        normals = surface.frames.normals
        corners[:, 1] = welded(normals.values)[normals.rows].reshape(-1)
    vertices, triangles = distinct_rows(corners)
    triangles = triangles.reshape(-1, 3)
    posed, rest = surface.vertices[vertices[:, 0]], surface.rest[vertices[:, 0]]
    positions = welded(np.concatenate([posed, rest], axis=1)).astype(np.int64)
    crosses = area_vectors(rest[triangles])
    facing, shading = np.zeros_like(rest), np.zeros_like(rest)
    for corner in range(3):
        np.add.at(facing, triangles[:, corner], crosses)
        if surface.frames is not None:
            shading[triangles[:, corner]] = normals.values[normals.rows[:, corner]]
    return _SplitVertices(posed, rest, facing, shading, _colors(texture, rest, facing), positions), triangles


def _colors(texture: OctreeTexture, rest: Float64s, normals: Float64s) -> Float32s:
    names = [name for name in (BASE_COLOR.name, ALPHA.name) if name in texture.channels]
    samples = texture.sample(rest, names, normals=normals)
    colors = np.ones((len(rest), 4), np.float32)
    colors[:, :3] = samples[BASE_COLOR.name]
    if ALPHA.name in samples:
        colors[:, 3:] = samples[ALPHA.name]
    return np.clip(colors, 0.0, 1.0)


def _is_off(
    points: _SplitVertices,
    ends: Int64s,
    texture: OctreeTexture,
    error: float,
    positions: Sequence[Sequence[float]],
) -> Bools:
    """Return the edges or triangles (k, 2 or 3) whose interpolated colours are off by more than an error."""
    is_off = np.zeros(len(ends), np.bool_)
    for shares in positions:
        rows = np.flatnonzero(~is_off)
        exact = points.between(ends[rows], texture, shares)
        mixed = _mixed(points.colors, ends[rows], shares)
        is_off[rows] = _any(np.abs(_codes(exact) - _codes(mixed)) > 65535.0 * error)
    return is_off


def _mixed(values: Array, ends: Int64s, shares: Sequence[float]) -> Float64s:
    """Return the sum of values (n, components) at ``ends`` (k, j), weighted by ``shares`` (j,)."""
    parts = [share * values.take(ends[:, n], 0) for n, share in enumerate(shares)]
    return np.asarray(sum(parts[1:], start=parts[0]), np.float64)


def _codes(colors: Floats) -> Int32s:
    """Return colours (n, 4) as 16-bit integers: sRGB and coverage."""
    alpha = encode(colors[:, 3:], "uint16", "data")
    return np.concatenate([encode(colors[:, :3], "uint16", "srgb"), alpha], axis=1).astype(np.int32)


def _with_longest(halved: Int64s, triangles: Sequence[Int64s], points: _SplitVertices) -> Int64s:
    """Add the longest sides of triangles that get too thin to ``halved`` edges (k, 2), between positions."""
    new_edges = halved
    while len(new_edges):
        touched = [each[_have_two(each, points.positions, new_edges)] for each in triangles]
        corners = np.concatenate(touched)
        ends = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2)
        lengths = np.linalg.norm(points.rest[ends[:, 0]] - points.rest[ends[:, 1]], axis=1).reshape(-1, 3)
        sides = in_order(points.positions[ends])
        is_halved = np.isin(_keys(sides), _keys(halved)).reshape(-1, 3)
        is_long = _any(is_halved) & (lengths.max(axis=1) > _THIN * (lengths * is_halved).max(axis=1))
        rows = np.flatnonzero(is_long)
        new_edges = np.unique(sides[3 * rows + lengths[rows].argmax(axis=1)], axis=0)
        halved = np.concatenate([halved, new_edges])
    return halved


def _keys(pairs: Int64s) -> Int64s:
    """Return one number for each pair of positions (k, 2)."""
    return pairs[:, 0] << 32 | pairs[:, 1]


def _cut_at(
    triangles: Int64s, positions: Int64s, halved: Int64s
) -> tuple[Int64s, tuple[Int64s, Int64s], Int64s]:
    """Return the edges (k, 2) between ``halved`` positions, the triangles that they cut, and the others.

    The cut ones (m, 3) come with the vertices at the midpoints of their sides (m, 3), −1 for none.
    """
    is_near = _have_two(triangles, positions, halved)
    touched = triangles[is_near]
    edges, sides = edges_of(touched)
    ordered = in_order(positions[edges])
    is_cut = np.isin(_keys(ordered), _keys(halved))
    numbers = np.full(len(edges), -1, np.int64)
    numbers[is_cut] = len(positions) + np.arange(int(is_cut.sum()))
    middles = numbers[sides]
    divided = _any(middles >= 0)
    cut = touched[divided], middles[divided]
    return edges[is_cut], cut, np.concatenate([triangles[~is_near], touched[~divided]])


def _have_two(triangles: Int64s, positions: Int64s, ends: Int64s) -> Bools:
    """Return the triangles (m, 3) with at least two corners at ends of edges (j, 2)."""
    if not len(ends):
        return np.zeros(len(triangles), np.bool_)
    is_end = np.zeros(int(positions.max()) + 1, np.bool_)
    is_end[ends] = True
    a, b, c = is_end[positions][triangles.T]
    return np.asarray((a & b) | (b & c) | (c & a))


def _any(flags: Bools) -> Bools:
    """Return np.any over the columns of flags (m, k), ten times as fast for few columns."""
    return np.asarray(np.logical_or.reduce(list(flags.T)))


def _divided(triangles: Int64s, middles: Int64s, rest: Float64s) -> Int64s:
    """Divide triangles (m, 3) at the midpoints of their sides (m, 3), −1 for none, in two, three or four."""
    counts = (middles >= 0).sum(axis=1)
    parts = [triangles[counts == 0]]
    # Rotated so that halved sides come first: one, two consecutive ones, or all.
    first = np.where(counts == 1, np.argmax(middles >= 0, axis=1), 0)
    first = np.where(counts == 2, (np.argmax(middles < 0, axis=1) + 1) % 3, first)
    turns = (first[:, None] + np.arange(3)) % 3
    turned = np.take_along_axis(triangles, turns, axis=1)
    (a, b, c), (p, q, r) = turned.T, np.take_along_axis(middles, turns, axis=1).T
    halved_once, halved_twice, halved_thrice = (counts == count for count in (1, 2, 3))
    parts += [_faces(a, p, c)[halved_once], _faces(p, b, c)[halved_once]]
    parts += [_faces(*each)[halved_thrice] for each in ((a, p, r), (p, b, q), (r, q, c), (p, q, r))]
    parts.append(_faces(p, b, q)[halved_twice])
    # The remaining quad a, p, q, c is cut along its shorter diagonal.
    quads = np.flatnonzero(halved_twice)
    short = np.linalg.norm(rest[a[quads]] - rest[q[quads]], axis=1) < np.linalg.norm(
        rest[p[quads]] - rest[c[quads]], axis=1
    )
    parts += [_faces(a, p, q)[quads[short]], _faces(a, q, c)[quads[short]]]
    parts += [_faces(a, p, c)[quads[~short]], _faces(p, q, c)[quads[~short]]]
    return np.concatenate(parts)


def _faces(a: Int64s, b: Int64s, c: Int64s) -> Int64s:
    return np.stack([a, b, c], axis=1)
