"""Displaces a surface along its normals by a channel, subdivided to the size of the cells."""

from __future__ import annotations

import json

import numpy as np

from octex.arrays import Float64s, Int32s, Int64s
from octex.baking.coordinates import cell_of
from octex.baking.layout import sums_of
from octex.baking.tessellation import Tessellation, edges_of, tessellated
from octex.channels import LUMINANCE, ChannelFormat
from octex.checks import as_choice, as_number, as_positive, as_whole
from octex.errors import ArgumentError
from octex.jit import inlined, kernel
from octex.source.corners import Corners, frames_of, unit
from octex.source.mesh import FARTHEST
from octex.source.subdivided import OnCage
from octex.source.surface import Surface, as_surface
from octex.source.tangents import carried
from octex.source.vectors import Vector, cross_product, dot_product, length_of, minus, plus, row_of
from octex.source.welding import welded
from octex.texture import OctreeTexture, as_texture
from octex.view.shading import corner_normals

#: Part and number of smoothing rounds of the field at vertices. Leaves are fitted, so where the surface
#: passes from layer to layer of cells, the field is off by a tenth of its change per cell. Slopes are then
#: sharpened.
#: Without, normals of a sphere in steep relief are off by up to 10 degrees instead of 1, positions by four
#: times as much.
_PART, _ROUNDS = 0.9, 10
#: Bounds of the angles' cotangents: below, smoothing diverges on some meshes; above, means move off their
#: vertices at obtuse triangles.
_LEAST, _LARGEST = -0.2, 1e3
#: Most halvings of an edge.
_MOST_LEVELS = 10


def displace(
    texture: OctreeTexture,
    surface: Surface,
    channel: str,
    scale: float,
    *,
    middle: float = 0.0,
    cell: float | None = None,
    most_triangles: int = 20_000_000,
) -> Surface:
    """Move a surface along its normals by a channel of its texture, and divide it to the size of the cells.

    channel         its values h; of colours, their luminance
    scale, middle   each point moves by scale · (h − middle) along its normal
    cell            longest edge at rest (default: the texture's finest cell)
    most_triangles  refuse to make more than this

    Normals are the surface's shading normals (``frames``), or else means of the adjacent triangles', in the
    pose. Neighbours divide a shared edge alike. Rest positions, texture coordinates and the source do not
    change. New normals, ``posed_frames()``, follow from the field's gradient. Heights are smoothed over about
    two cells: relief finer than 8 cells loses a tenth of its slope.

    Raises ArgumentError for a channel that is missing or holds directions, and for numbers out of range. Also
    for more than ``most_triangles``, and for a displacement that is not finite.
    """
    as_surface(surface)
    as_texture(texture)
    as_choice(channel, texture.channels, "channel of the texture")
    form = texture.channels[channel].format
    if form.space == "direction":
        raise ArgumentError(f"{channel} holds directions; displace by numbers or colours")
    scale = as_number(scale, "scale", -FARTHEST, FARTHEST)
    middle = as_number(middle, "middle", -FARTHEST, FARTHEST)
    finest = cell_of(texture)
    cell = finest if cell is None else as_positive(cell, "cell")
    limit = as_whole(most_triangles, "most_triangles", 1, 2**31 - 1)
    resting = surface.placed_in(texture).rest
    vertex_of = welded(np.concatenate([surface.vertices, surface.rest, resting], axis=1)).astype(np.int64)
    triangles = vertex_of[surface.triangles]
    mesh = _divided(triangles, resting, surface, cell, limit)
    corners, rest_corners = surface.vertices[surface.triangles], resting[surface.triangles]
    normals = _normals(surface, triangles)
    undisplaced = mesh.spread(rest_corners)
    posed = undisplaced if resting is surface.vertices else mesh.spread(corners)
    rest = undisplaced if resting is surface.rest else mesh.spread(surface.rest[surface.triangles])
    directions = mesh.spread(normals)
    lengths = np.linalg.norm(directions, axis=1)
    directions = unit(directions)
    facing = mesh.spread(corner_normals(resting, surface.triangles, 180.0).astype(np.float64))
    heights, slopes = _heights(texture, form, undisplaced, facing, scale, middle)
    _smooth(mesh.triangles, undisplaced, heights, slopes)
    with np.errstate(over="ignore", invalid="ignore"):
        vertices = posed + heights[:, None] * directions
    is_finite = (np.abs(vertices) <= FARTHEST).all(axis=1)
    if not is_finite.all():
        first = undisplaced[int(np.argmin(is_finite))]
        raise ArgumentError(
            f"{surface.name}: {channel} displaces a vertex to a position that is not finite, "
            f"at {first.tolist()} at rest; repair the texture, or give another scale"
        )
    bent = np.zeros_like(vertices)
    _add_normals(
        mesh.owners, mesh.points, corners, rest_corners, normals, directions, lengths, heights, slopes, bent,
    )  # fmt: skip
    bent = np.where(bent.any(axis=1, keepdims=True), unit(bent), directions)
    frames = carried(frames_of(bent, mesh.triangles), mesh.triangles, vertices, rest)
    uv = None
    if surface.uv is not None:
        parent_uv = surface.uv.values[surface.uv.rows[mesh.parents]]
        values = np.einsum("mkc,mcx->mkx", mesh.shares, parent_uv).reshape(-1, 2).astype(np.float32)
        uv = Corners(values, np.arange(len(values), dtype=np.int32).reshape(-1, 3))
    source = OnCage(surface.source, mesh.parents, mesh.shares, rest, rest, mesh.triangles)
    settings = json.dumps({"channel": channel, "scale": scale, "middle": middle})
    return Surface(
        vertices, mesh.triangles, source, rest=rest, uv=uv, frames=frames, name=surface.name,
        provenance={**surface.provenance, "displaced": settings},
    )  # fmt: skip


def _divided(triangles: Int64s, rest: Float64s, surface: Surface, cell: float, limit: int) -> Tessellation:
    """Divide triangles (m, 3) until no edge is longer than a cell."""
    positions = np.empty((int(triangles.max()) + 1, 3))
    positions[triangles] = rest[surface.triangles]
    edges, sides = edges_of(triangles)
    lengths = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
    with np.errstate(over="ignore"):
        levels = np.ceil(np.log2(np.clip(lengths / cell * (1 - 1e-9), 1.0, FARTHEST))).astype(np.int64)
    finest = levels[sides].max(axis=1)
    if finest.max() > _MOST_LEVELS or (count := int((4**finest).sum())) > limit:
        number = f"{count:,}" if finest.max() <= _MOST_LEVELS else f"4^{finest.max()} for a triangle"
        raise ArgumentError(
            f"{surface.name} divided to cells of {cell:g} would need too many triangles, {number}; "
            "give a larger cell"
        )
    return tessellated(triangles, levels, (edges, sides))


def _normals(surface: Surface, triangles: Int64s) -> Float64s:
    """Return posed unit normals at the corners of triangles (m, 3, 3), one per place."""
    frames = surface.posed_frames()
    if frames is None:
        return corner_normals(surface.vertices, surface.triangles, 180.0).astype(np.float64)
    normals = frames.normals.values[frames.normals.rows].reshape(-1, 3)
    return unit(sums_of(triangles.ravel(), normals))[triangles]


def _heights(
    texture: OctreeTexture, form: ChannelFormat, rest: Float64s, facing: Float64s, scale: float, middle: float
) -> tuple[Float64s, Float64s]:
    """Return the displacements of vertices (n,), and their derivatives by rest position (n, 3)."""
    values, gradients = texture.sample(rest, form.name, normals=facing, gradient=True)
    weights = LUMINANCE if form.components == 3 else np.eye(form.components)[0]
    with np.errstate(over="ignore", invalid="ignore"):  # refused by the caller
        heights = scale * (values.astype(np.float64) @ weights - middle)
        return heights, scale * np.einsum("ncx,c->nx", gradients.astype(np.float64), weights)


def _smooth(triangles: Int32s, positions: Float64s, heights: Float64s, slopes: Float64s) -> None:
    """Smooth heights (n,) and slopes (n, 3) of vertices at ``positions`` (n, 3), in place."""
    cotangents, sums = np.empty((len(triangles), 3)), np.empty((len(heights), 5))
    _cotangents(triangles, positions, cotangents)
    for _ in range(_ROUNDS):
        _smooth_once(triangles, cotangents, positions, heights, slopes, sums, _PART, _PART)
    # Restores the height of long waves, to first order.
    _smooth_once(triangles, cotangents, positions, heights, slopes, sums, -_ROUNDS * _PART, 0.0)


@kernel
def _cotangents(triangles: Int32s, positions: Float64s, cotangents: Float64s) -> None:
    """Write the cotangents of the angles opposite the sides of triangles (m, 3)."""
    for t in range(len(triangles)):
        for side in range(3):
            a, b, c = triangles[t, side], triangles[t, (side + 1) % 3], triangles[t, (side + 2) % 3]
            tip = row_of(positions, c)
            u, v = minus(row_of(positions, a), tip), minus(row_of(positions, b), tip)
            dot = dot_product(u, v)
            across = np.sqrt(max(dot_product(u, u) * dot_product(v, v) - dot * dot, 0.0))
            cotangents[t, side] = min(max(dot / across, _LEAST), _LARGEST) if across > 0.0 else 0.0


@kernel
def _smooth_once(
    triangles: Int32s, cotangents: Float64s, positions: Float64s, heights: Float64s, slopes: Float64s,
    sums: Float64s, part: float, lift: float,
) -> None:  # fmt: skip
    """Move slopes (n, 3) by ``part`` toward their neighbours' means, and heights (n,) by ``lift``.

    The means are weighted by cotangents, so linear functions stay. A neighbour's height is extrapolated by
    the slopes on the way, so parabolas stay.
    """
    sums[:] = 0.0
    for t in range(len(triangles)):
        for side in range(3):
            a, b, weight = triangles[t, side], triangles[t, (side + 1) % 3], cotangents[t, side]
            rise = 0.0
            for axis in range(3):
                sums[a, axis] += weight * slopes[b, axis]
                sums[b, axis] += weight * slopes[a, axis]
                mean = 0.5 * (slopes[a, axis] + slopes[b, axis])
                rise += mean * (positions[b, axis] - positions[a, axis])
            sums[a, 3] += weight * (heights[b] - rise)
            sums[b, 3] += weight * (heights[a] + rise)
            sums[a, 4] += weight
            sums[b, 4] += weight
    for n in range(len(heights)):
        if sums[n, 4] > 0.0:
            for axis in range(3):
                slopes[n, axis] += part * (sums[n, axis] / sums[n, 4] - slopes[n, axis])
            heights[n] += lift * (sums[n, 3] / sums[n, 4] - heights[n])


@kernel
def _add_normals(
    owners: Int64s, points: Int64s, corners: Float64s, rest: Float64s, normals: Float64s,
    directions: Float64s, lengths: Float64s, heights: Float64s, slopes: Float64s, bent: Float64s,
) -> None:  # fmt: skip
    """Add up normals of the displaced surface (n, 3): a tangent t becomes t + (∂h) n + h ∂n."""
    for p in range(len(points)):
        t, v = owners[p], points[p]
        normal = row_of(directions, v)
        turn = heights[v] / max(lengths[v], 1e-30)
        a = _displaced_side(row_of(slopes, v), rest[t], corners[t], normals[t], 1, turn, normal)
        b = _displaced_side(row_of(slopes, v), rest[t], corners[t], normals[t], 2, turn, normal)
        x, y, z = cross_product(a, b)
        size = length_of((x, y, z))
        if size > 0.0:
            bent[v, 0] += x / size
            bent[v, 1] += y / size
            bent[v, 2] += z / size


@inlined
def _displaced_side(
    slope: Vector, rest: Float64s, corners: Float64s, normals: Float64s, k: int, turn: float, normal: Vector
) -> Vector:
    """Return a displaced side of a parent (3, 3), from corner 0 to k, at a vertex."""
    bend = minus(row_of(normals, k), row_of(normals, 0))
    side = plus(minus(row_of(corners, k), row_of(corners, 0)), bend, turn)
    rise = dot_product(slope, minus(row_of(rest, k), row_of(rest, 0))) - dot_product(side, normal)
    return plus(side, normal, rise)
