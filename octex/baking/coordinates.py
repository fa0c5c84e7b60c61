"""Checks whether a model's texture coordinates can show a texture: no texel may cover differing areas."""

from __future__ import annotations

from concurrent.futures import Executor
from itertools import pairwise

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int64s
from octex.baking.layout import Layout, doubled_areas, unit_area
from octex.baking.texels import Drawing, TexelRows, barycentric_at
from octex.channels import CHANNELS, linear_to_srgb
from octex.errors import ModelError
from octex.parallel import ordered_map
from octex.source.corners import area_vectors, at_corners, scattered
from octex.source.mesh import Mesh
from octex.texture import OctreeTexture

#: Coordinates are refused if more than this part of the texels cover differing areas.
_MOST = 0.01
#: Size of the map that is checked, number of points, and largest difference, of 1, that counts as alike.
PROBE, _TRIED, _ALIKE = 1024, 20_000, 0.1
#: Coordinates that overlap more than this often on average are refused at once.
_MOST_DRAWN = 8.0
#: A triangle is squeezed if its texels are this many cells long, and this many times longer than in a map
#: that shows the mesh evenly.
_LONG, _UNEVEN = 4.0, 16.0
#: A point is inside a triangle if its clamped barycentric coordinates give it back, within this many texels.
_INSIDE = 1e-6
#: Rows of texels in one task.
_ROWS = 128
#: Points at which sizes of texels are compared; factors by which texels may be finer than a leaf.
_COMPARED, _FINER = 5_000, (1, 2, 4)
#: Largest error (RMS, of 1) of bilinear reading where the texture varies. The worst 1 % of points do not
#: count: they include the surface's rims, beyond which there is no texture.
_READ = 3.0 / 255.0
#: The texture varies where averaging over this many leaves changes it by more than this, of 1.
_AVERAGED, _VARIES = 4.0, 2.0 / 255.0


def check_overlaps(
    texture: OctreeTexture, mesh: Mesh, names: list[str], layout: Layout, pool: Executor
) -> None:
    """Raise ModelError if differing areas of a mesh share its texture coordinates."""
    area, whole = unit_area(layout), "the map"
    shared = 1.0 - 1.0 / area if area > _MOST_DRAWN else 0.0
    if 0.0 < area <= _MOST_DRAWN:
        layout = layout.sized(PROBE)
        drawing, ends = Drawing.of(layout), [*range(0, layout.height, _ROWS), layout.height]
        parts = list(ordered_map(pool, lambda rows: drawing.rows(*rows), list(pairwise(ends))))
        drawn = TexelRows(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
        covered = float(drawn.areas.sum(dtype=np.float64)) / (layout.width * layout.height)
        shared = max(area - covered, 0.0) / area
        areas = None
        if shared <= _MOST:  # small parts of a map may show most of the surface
            areas, whole = areas_of(mesh)[layout.faces], "its surface"
            areas /= np.bincount(layout.faces)[layout.faces]
        shared = _differing(texture, mesh, names, layout, drawn, areas)
    if shared > _MOST:
        raise ModelError(
            f"{mesh.name}: its texture coordinates overlap on at least {100 * shared:.3g} % of {whole}, "
            "and the overlapping areas differ in colour; let octex make an atlas"
        )


def check_stretches(texture: OctreeTexture, mesh: Mesh, names: list[str], size: int) -> None:
    """Raise ModelError if texels of a map are so long, or so crowded, that they cover differing areas."""
    is_squeezed = squeezed(texture, mesh, size)
    if not is_squeezed.any():
        return
    stretch, along = stretches_of(mesh, size)
    rows, weights = scattered(areas_of(mesh), _TRIED, 0)
    rows, weights = rows[is_squeezed[rows]], weights[is_squeezed[rows]]
    # Offsets stay within the triangle, and within half a texel.
    steps = along[rows]
    reach = np.where(steps < 0.0, weights / np.maximum(-steps, 1e-300), np.inf).min(axis=1)
    reach = np.minimum(reach, 0.5 / np.maximum(stretch[rows], 1e-300))
    part = np.random.default_rng(1).random((rows.size, 1))
    shifted = np.clip(weights + part * reach[:, None] * steps, 0.0, 1.0)
    others = _in_same_texels(mesh, rows, weights, size)
    width, points = cell_of(texture), (rows, weights)
    differs = _differ(texture, mesh, names, points, (rows, shifted), width=width)
    differs |= _differ(texture, mesh, names, points, (rows[others], weights[others]), width=width)
    spread = float(differs.sum()) / _TRIED
    if spread > _MOST:
        raise ModelError(
            f"{mesh.name}: its texture coordinates are too small: on {100 * spread:.3g} % of it one "
            "texel covers areas that differ in colour; let octex make an atlas"
        )


def _in_same_texels(mesh: Mesh, triangles: Int64s, weights: Float64s, size: int) -> Int64s:
    """Return for each point (n,) another one in its texel of a map, at random, or itself if it is alone."""
    assert mesh.uv is not None
    uv = np.einsum("nk,nkx->nx", weights, mesh.uv.values[mesh.uv.rows[triangles]].astype(np.float64))
    _, texels = np.unique(np.floor(size * (uv % 1.0)), axis=0, return_inverse=True)
    texels = texels.reshape(-1)  # some versions of numpy return a column
    order = np.lexsort((np.random.default_rng(2).random(texels.size), texels))
    counts = np.bincount(texels)
    ends = np.cumsum(counts)
    after = np.arange(1, texels.size + 1)
    after[ends - 1] = ends - counts  # the last of a texel is followed by the first
    others = np.empty(texels.size, np.int64)
    others[order] = order[after]
    return others


def _differing(
    texture: OctreeTexture, mesh: Mesh, names: list[str], layout: Layout, drawn: TexelRows,
    shares: Float64s | None,
) -> float:  # fmt: skip
    """Return the part of a map's triangles whose texels show another, differing area.

    Triangles weigh by ``shares`` (k,), where only points inside both areas count; None: by area in the map.
    """
    corners = layout.corners
    areas = np.abs(doubled_areas(corners))
    triangles, weights = scattered(areas if shares is None else shares, _TRIED, 0)
    points = np.einsum("nk,nkx->nx", weights, corners[triangles])
    columns, rows = np.clip(points.astype(np.int64), 0, (layout.width - 1, layout.height - 1)).T
    covering = drawn.triangles[rows, columns]
    is_overlap = (covering >= 0) & (layout.charts[covering] != layout.charts[triangles])
    triangles, covering, weights = triangles[is_overlap], covering[is_overlap], weights[is_overlap]
    points = points[is_overlap]
    covering_weights = barycentric_at(corners, covering, points)
    if shares is not None:
        nearest = np.einsum("nk,nkx->nx", covering_weights, corners[covering])
        is_inside = (np.abs(nearest - points) < _INSIDE).all(axis=1)
        if is_inside.sum() <= _MOST * _TRIED:
            return 0.0
        triangles, covering, weights = triangles[is_inside], covering[is_inside], weights[is_inside]
        covering_weights = covering_weights[is_inside]
    width = np.sqrt(areas_of(mesh).sum() / max(float(areas.sum()) / 2, 1e-300))
    first, second = (layout.faces[triangles], weights), (layout.faces[covering], covering_weights)
    return float(_differ(texture, mesh, names, first, second, width=width).sum()) / _TRIED


def squeezed(texture: OctreeTexture, mesh: Mesh, size: int) -> Bools:
    """Return the triangles (m,) whose texels are far too long; none if they cover little area."""
    stretch, _ = stretches_of(mesh, size)
    areas = areas_of(mesh)
    even = size / np.sqrt(max(float(areas.sum()), 1e-300))
    is_long = stretch < min(1.0 / (_LONG * cell_of(texture)), even / _UNEVEN)
    is_squeezed: Bools = is_long & (areas > 0.0)
    return is_squeezed if areas[is_squeezed].sum() > _MOST * areas.sum() else np.zeros_like(is_squeezed)


def stretches_of(mesh: Mesh, size: int) -> tuple[Float64s, Float64s]:
    """Return texels per unit along the least stretched direction (m,), and it in barycentrics (m, 3)."""
    assert mesh.uv is not None
    rest = mesh.rest[mesh.triangles]
    first, second = rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]
    length = np.linalg.norm(first, axis=1)
    heights = np.linalg.norm(np.cross(first, second), axis=1)
    has_area = heights > 0.0
    length, heights = np.where(has_area, length, 1.0), np.where(has_area, heights, 1.0)
    # Barycentric steps of a unit along the first edge, and perpendicular to it; then in coordinates.
    along, across = 1.0 / length, length / heights
    slant = -(first * second).sum(axis=1) / (length * heights)
    corners = size * mesh.uv.values[mesh.uv.rows].astype(np.float64)
    flat_first, flat_second = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    (x, y), (z, w) = flat_first * along, flat_first * slant + flat_second * across
    # The least singular value and its vector: of a symmetric matrix' least eigenvalue.
    a, b, c = x * x + y * y, x * z + y * w, z * z + w * w
    largest = (a + c) / 2 + np.hypot((a - c) / 2, b)
    least = np.abs(x * w - y * z) / np.sqrt(np.maximum(largest, 1e-300))
    right, up = np.where(a > c, -b, largest - a), np.where(a > c, largest - c, -b)
    norm = np.hypot(right, up)
    right, up = np.where(norm > 0.0, [right, up], [np.ones_like(norm), up])  # equal in all directions
    norm = np.where(norm > 0.0, norm, 1.0)
    steps = np.stack([along * right + slant * up, across * up], axis=1) * (has_area / norm)[:, None]
    return least, np.concatenate([-steps.sum(axis=1, keepdims=True), steps], axis=1)


def _differ(
    texture: OctreeTexture, mesh: Mesh, names: list[str], *ends: tuple[Int64s, Float64s], width: float
) -> Bools:
    """Return where two points, each as triangles (n,) and barycentric coordinates, differ."""
    codes = []
    for triangles, weights in ends:
        rows = mesh.triangles[triangles]
        normals, points = area_vectors(mesh.rest[rows]), at_corners(mesh.rest, rows, weights)
        codes.append(_stored(texture.sample(points, names, normals=normals, width=width, threads=1)))
    return np.asarray((np.abs(codes[0] - codes[1]) > _ALIKE).any(axis=1))


def fineness(
    texture: OctreeTexture, mesh: Mesh, names: list[str], leaf: float, areas: Float64s,
    steps: tuple[Float64s, Float64s],
) -> int:  # fmt: skip
    """Return the factor, 1, 2 or 4, by which texels must be finer to read like the texture where it varies.

    Triangles weigh by ``areas`` (m,); ``steps`` (m, 3) lead from a texel to the next one right and down.
    """
    triangles, weights = scattered(areas, _COMPARED, 0)
    rows = mesh.triangles[triangles]
    points, normals = at_corners(mesh.rest, rows, weights), area_vectors(mesh.rest[rows])

    def sampled(points: Float64s, width: float = 0.0) -> dict[str, Float32s]:
        return texture.sample(points, names, normals=normals, width=width, threads=1)

    expected, width = _stored(sampled(points)), _AVERAGED * leaf
    varies = (np.abs(expected - _stored(sampled(points, width))) > _VARIES).any(axis=1)
    varies &= texture.contains(points, threads=1)
    if varies.mean() <= _MOST:
        return 1
    expected, points, normals = expected[varies], points[varies], normals[varies]
    right, down = (each[triangles[varies]] for each in steps)
    x, y = np.random.default_rng(1).random((2, len(points), 1))
    for finer in _FINER[:-1]:
        read: dict[str, Float32s] = {}
        for i, j in np.ndindex(2, 2):
            weight = np.float32((x if i else 1.0 - x) * (y if j else 1.0 - y))
            for name, values in sampled(points + ((i - x) * right + (j - y) * down) / finer).items():
                read[name] = read.get(name, np.float32(0.0)) + weight * values
        missed = np.sort(((_stored(read) - expected) ** 2).max(axis=1))[: -int(_MOST * _COMPARED)]
        if missed.mean() <= _READ**2:
            return finer
    return _FINER[-1]


def _stored(values: dict[str, Float32s]) -> Float64s:
    """Return channels side by side (n, components) as stored, 0 to 1, without directions."""
    shown = [item for item in values.items() if CHANNELS[item[0]].space != "direction"]
    if not shown:
        return np.zeros((len(next(iter(values.values()))), 1))
    columns = [
        linear_to_srgb(np.clip(item, 0, 1)) if CHANNELS[name].space == "srgb" else item
        for name, item in shown
    ]
    return np.concatenate(columns, axis=1, dtype=np.float64)


def areas_of(mesh: Mesh) -> Float64s:
    """Return the areas of a mesh's triangles (m,) at rest."""
    areas: Float64s = np.linalg.norm(area_vectors(mesh.rest[mesh.triangles]), axis=1) / 2
    return areas


def cell_of(texture: OctreeTexture) -> float:
    """Return the width of a texture's finest cells."""
    return float(texture.placement.size / 2**texture.tree.max_depth)


def leaf_of(texture: OctreeTexture, mesh: Mesh) -> float:
    """Return the width of the finest leaves that hold at least 1 % of a mesh; else of finest cells."""
    triangles, weights = scattered(areas_of(mesh), _TRIED, 0)
    points = at_corners(mesh.rest, mesh.triangles[triangles], weights)
    points = points[texture.contains(points, threads=1)]
    if not len(points):
        return cell_of(texture)
    cells = texture.taps(points, next(iter(texture.channels)), "nearest", threads=1).rows
    levels = np.searchsorted(texture.tree.arrays.level_cells, cells, side="right") - 1
    level = int(np.sort(levels)[::-1][int(_MOST * levels.size)])
    return float(texture.placement.size / 2**level)
