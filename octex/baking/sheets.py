"""Sheets: triangles that share a set of maps, with where they lie in it and the materials that show it."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s
from octex.baking.atlas import atlas_layout
from octex.baking.layout import BEYOND, Layout, Layouts, kept_layout, unit_area
from octex.baking.texels import Drawing, Texels, barycentric_at
from octex.channels import CHANNELS, ColorSpace, linear_to_srgb
from octex.errors import ModelError
from octex.parallel import ordered_map
from octex.source.corners import Corners, area_vectors, at_corners
from octex.source.materials import Material, MaterialSource
from octex.source.mesh import Mesh
from octex.source.surface import Surface
from octex.texture import OctreeTexture

#: The sizes of maps that are chosen by themselves.
_SMALLEST, _LARGEST = 64, 8192
#: Texels are about as large as cells if they are at most so much wider.
_ABOUT = 1.15
#: Coordinates of which more than this part is covered twice, by what looks otherwise, are not kept.
_OVERLAPPING = 0.01
#: Texels a side of the maps in which that is looked for, at most; places where it is; and what looks alike,
#: of 1, as stored.
_PROBE, _TRIED, _LOOKS_ALIKE = 1024, 20_000, 0.1
#: Coordinates that cover more maps than this look otherwise somewhere.
_MOST_DRAWN = 8.0
#: Rows of texels in one task.
_ROWS = 128
#: Most UDIM tiles that a material may have.
_MOST_TILES = 100


class Sheet(NamedTuple):
    """Triangles that share a set of maps."""

    mesh: Mesh  # the triangles alone
    triangles: Int32s  # (k,)   their numbers in the whole surface
    layout: Layout
    materials: list[Material]  # the model's, of which names, sides and alpha modes are kept
    owners: Int32s  # (k,)   which of these each triangle has


def sheets_of(
    texture: OctreeTexture, surface: Surface, names: list[str], uv: Layouts, size: int | None, padding: int,
    pool: Executor,
) -> list[Sheet]:  # fmt: skip
    """Lay a surface out in maps of a size, or of sizes that keep the texture's cells.

    Materials that read the same image share maps, others have their own; those without coordinates get an
    atlas each. Otherwise all triangles share one atlas, and materials that differ in nothing but their names
    are one there. Raises ModelError for coordinates that cannot be kept, and for an atlas that has no room.
    """
    materials, owners = _own_materials(surface)
    if uv != "atlas":
        try:
            return list(_kept(texture, surface, names, size, padding, materials, owners, pool))
        except ModelError:
            if uv == "keep":
                raise
    layout = _atlas(texture, surface, size, padding)
    every = np.arange(len(surface.triangles), dtype=np.int32)
    kinds: dict[tuple[str, bool], list[int]] = {}
    for number in np.unique(owners).tolist():
        kinds.setdefault((materials[number].alpha_mode, materials[number].double_sided), []).append(number)
    numbers = np.zeros(len(materials), np.int32)
    for kind, alike in enumerate(kinds.values()):
        numbers[alike] = kind
    shown = [
        materials[alike[0]] if len(alike) == 1 else materials[alike[0]]._replace(name="")
        for alike in kinds.values()
    ]
    return [Sheet(surface, every, layout, shown, numbers[owners])]


def _own_materials(surface: Surface) -> tuple[list[Material], Int32s]:
    if isinstance(surface.source, MaterialSource):
        return surface.source.materials, surface.source.triangle_materials
    return [Material()], np.zeros(len(surface.triangles), np.int32)


def _kept(
    texture: OctreeTexture, surface: Surface, names: list[str], size: int | None, padding: int,
    materials: list[Material], owners: Int32s, pool: Executor,
) -> Iterator[Sheet]:  # fmt: skip
    """Yield the sheets of a surface at its own coordinates; raises ModelError if they cannot be kept."""
    groups: dict[object, list[int]] = {}
    for number in np.unique(owners).tolist():
        read = [each.texture for each in materials[number].inputs.values() if each.texture is not None]
        key = (id(read[0].texels), read[0].slot) if read else number
        groups.setdefault(key, []).append(number)
    coordinates = [_coordinates(surface, materials[alike[0]]) for alike in groups.values()]
    if all(each is None for each in coordinates):
        raise ModelError(f"{surface.name} has no texture coordinates to keep; have an atlas made")
    for own, alike in zip(coordinates, groups.values(), strict=True):
        chosen = np.flatnonzero(np.isin(owners, alike)).astype(np.int32)
        shown = [materials[number] for number in alike]
        numbers = np.searchsorted(alike, owners[chosen]).astype(np.int32)
        mesh = surface.picked(chosen)[0]
        if own is None:
            yield Sheet(mesh, chosen, _atlas(texture, mesh, size, padding), shown, numbers)
            continue
        mesh.uv = own.of(chosen)
        layout = kept_layout(mesh, size or _PROBE)
        shared = _shared(texture, mesh, names, layout, pool)
        if shared <= _OVERLAPPING:
            yield Sheet(mesh, chosen, _fitted(texture, mesh, layout, size), shown, numbers)
            continue
        for name, tile, there in _tiles(mesh):
            layout = kept_layout(tile, size or _PROBE)
            shared = _shared(texture, tile, names, layout, pool)
            if shared > _OVERLAPPING:
                break
            named = [each._replace(name=f"{each.name}.{name}") for each in shown]
            yield Sheet(tile, chosen[there], _fitted(texture, tile, layout, size), named, numbers[there])
        if shared > _OVERLAPPING:
            raise ModelError(
                f"{surface.name}: at least {100 * shared:.3g} % of its texture coordinates overlap, so that "
                "one texel would show several places that differ; have an atlas made"
            )


def _coordinates(surface: Surface, material: Material) -> Corners | None:
    """Return the coordinates that a material's images are read at, else the surface's, if it has any."""
    slots = [each.texture.slot for each in material.inputs.values() if each.texture is not None]
    if slots and isinstance(surface.source, MaterialSource):
        return surface.source.coordinates[slots[0]]
    return surface.uv


def _tiles(mesh: Mesh) -> list[tuple[int, Mesh, Int32s]]:
    """Cut a mesh by the UDIM tiles that its triangles lie in: their numbers, meshes and triangles.

    The tiles' coordinates are moved to the unit square. Empty if a triangle lies in several or elsewhere.
    """
    assert mesh.uv is not None
    uv = mesh.uv.values[mesh.uv.rows].astype(np.float64)
    squares = np.floor(uv.mean(axis=1))
    across, up = squares[:, 0].astype(np.int64), -squares[:, 1].astype(np.int64)
    numbers = 1001 + across + 10 * up
    moved = uv - squares[:, None]
    is_tiled = (across >= 0) & (across < 10) & (up >= 0) & (np.abs(moved - 0.5) <= 0.5 + BEYOND).all((1, 2))
    known = np.unique(numbers).tolist()
    if not is_tiled.all() or not 1 < len(known) <= _MOST_TILES:
        return []
    tiles = []
    for number in known:
        tile, there, _ = mesh.picked(np.flatnonzero(numbers == number))
        values = np.clip(moved[there], 0.0, 1.0).reshape(-1, 2).astype(np.float32)
        tile.uv = Corners(values, np.arange(3 * there.size, dtype=np.int32).reshape(-1, 3))
        tiles.append((number, tile, there))
    return tiles


def _atlas(texture: OctreeTexture, mesh: Mesh, size: int | None, padding: int) -> Layout:
    """Return an atlas of a size, or of the first that keeps the texture's cells."""
    texel = _ABOUT * _cell(texture)
    if size is not None:
        return atlas_layout(mesh, [size], padding, texel)
    first = _size_for(texture, mesh, 0.6)
    return atlas_layout(
        mesh, [2**n for n in range(first.bit_length() - 1, _LARGEST.bit_length())], padding, texel
    )


def _fitted(texture: OctreeTexture, mesh: Mesh, layout: Layout, size: int | None) -> Layout:
    """Return a layout of a size, or of one that keeps the texture's cells."""
    return layout.sized(size or _size_for(texture, mesh, unit_area(layout)))


def _shared(texture: OctreeTexture, mesh: Mesh, names: list[str], layout: Layout, pool: Executor) -> float:
    """Return how much of what triangles cover in a map others cover too that look otherwise, as a part."""
    whole = unit_area(layout)
    if whole > _MOST_DRAWN:
        return 1.0 - 1.0 / whole
    layout = layout.sized(min(layout.width, _PROBE))
    drawn = _drawn(layout, pool)
    covered = float(drawn.areas.sum(dtype=np.float64)) / (layout.width * layout.height)
    shared = max(whole - covered, 0.0) / whole if whole > 0.0 else 0.0
    return shared if shared <= _OVERLAPPING else _differing(texture, mesh, names, layout, drawn)


def _differing(texture: OctreeTexture, mesh: Mesh, names: list[str], layout: Layout, drawn: Texels) -> float:
    """Return the part of a map's triangles at which its texels show other places that look otherwise."""
    corners, faces = layout.corners, mesh.triangles[layout.faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    random = np.random.default_rng(0).random((_TRIED, 3))
    own = np.minimum(np.searchsorted(np.cumsum(areas), random[:, 0] * areas.sum()), len(areas) - 1)
    root = np.sqrt(random[:, 1:2])
    weights = np.concatenate([1 - root, root * (1 - random[:, 2:]), root * random[:, 2:]], axis=1)
    places = np.einsum("nk,nkx->nx", weights, corners[own])
    columns, rows = np.clip(places.astype(np.int64), 0, (layout.width - 1, layout.height - 1)).T
    shown = drawn.triangles[rows, columns]
    other = (shown >= 0) & (layout.charts[shown] != layout.charts[own])
    own, shown, weights = own[other], shown[other], weights[other]
    theirs = barycentric_at(corners, shown, places[other])
    ends = (faces[own], weights), (faces[shown], theirs)
    rest = [at_corners(mesh.rest, *each) for each in ends]
    kept = [name for name in names if CHANNELS[name].space != "direction"]
    width = np.sqrt(_area(mesh) / max(float(areas.sum()) / 2, 1e-300))
    codes = []
    for at, (rows_of, _) in zip(rest, ends, strict=True):
        normals = np.cross(*(mesh.rest[rows_of[:, n]] - mesh.rest[rows_of[:, 0]] for n in (1, 2)))
        found = texture.sample(at, kept, normals=normals, width=width, threads=1)
        codes.append([_as_seen(found[name], CHANNELS[name].space) for name in kept])
    differs = np.zeros(own.size, np.bool_)
    for one, two in zip(*codes, strict=True):
        differs |= (np.abs(one - two) > _LOOKS_ALIKE).any(axis=1)
    return float(differs.sum()) / _TRIED


def _as_seen(values: Float32s, space: ColorSpace) -> Float64s:
    return linear_to_srgb(np.clip(values, 0, 1)) if space == "srgb" else values.astype(np.float64)


def _drawn(layout: Layout, pool: Executor) -> Texels:
    """Draw a layout, parts of it side by side; ``triangles`` are those of the layout."""
    drawing = Drawing.of(layout)

    def draw(rows: tuple[int, int]) -> Texels:
        which, drawn = drawing.rows(*rows)
        if not which.size:
            return drawn
        return drawn._replace(
            triangles=np.where(drawn.triangles < 0, -1, which[drawn.triangles]).astype(np.int32)
        )

    parts = list(ordered_map(pool, draw, list(pairwise([*range(0, layout.height, _ROWS), layout.height]))))
    return Texels(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _size_for(texture: OctreeTexture, mesh: Mesh, part: float) -> int:
    """Return the size of maps of which a ``part`` shows the mesh with texels about as large as cells."""
    side = np.sqrt(_area(mesh) / max(part, 1e-6)) / (_ABOUT * _cell(texture))
    return int(np.clip(2 ** np.ceil(np.log2(max(side, 1.0))), _SMALLEST, _LARGEST))


def _area(mesh: Mesh) -> float:
    """Return the area of a mesh at rest."""
    return float(np.linalg.norm(area_vectors(mesh.rest[mesh.triangles]), axis=1).sum() / 2)


def _cell(texture: OctreeTexture) -> float:
    """Return the width of a texture's finest cells."""
    return float(texture.placement.size / 2**texture.tree.max_depth)


def coordinates_of(sheets: list[Sheet], count: int) -> Corners:
    """Return the texture coordinates of all of so many triangles, each in its sheet's map."""
    if len(sheets) == 1 and len(sheets[0].triangles) == count:
        return sheets[0].layout.uv
    values, rows, first = [], np.empty((count, 3), np.int32), 0
    for sheet in sheets:
        used, local = np.unique(sheet.layout.uv.rows, return_inverse=True)
        rows[sheet.triangles] = first + local.reshape(-1, 3)
        values.append(sheet.layout.uv.values[used])
        first += used.size
    return Corners(np.concatenate(values), rows)
