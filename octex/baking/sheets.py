"""Decides which triangles share a set of maps, and where they lie in it."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from octex.arrays import Int32s
from octex.baking.atlas import atlas_layout
from octex.baking.coordinates import (
    PROBE,
    areas_of,
    check_overlaps,
    check_stretches,
    fineness,
    leaf_of,
    squeezed,
)
from octex.baking.layout import BEYOND, PADDING, Layout, Layouts, kept_layout, steps_between, unit_area
from octex.errors import ModelError, ModelWarning
from octex.source.corners import Corners, across, area_vectors, unit
from octex.source.materials import Material, MaterialSource
from octex.source.mesh import Mesh
from octex.source.surface import Surface
from octex.texture import OctreeTexture

#: Smallest and largest size of maps that is chosen automatically.
_SMALLEST, _LARGEST = 64, 8192
#: Texels up to this much wider than leaves count as the same size.
_ABOUT = 1.15
#: Most UDIM tiles of a material.
_MOST_TILES = 100


class Sheet(NamedTuple):
    """Triangles that share a set of maps."""

    mesh: Mesh  # these triangles only
    triangles: Int32s  # (k,)   their numbers in the whole surface
    layout: Layout
    materials: list[Material]  # the model's; names, sidedness and alpha modes count
    owners: Int32s  # (k,)   the material of each triangle


def sheets_of(
    texture: OctreeTexture, surface: Surface, names: list[str], uv: Layouts, size: int | None,
    padding: int | None, pool: Executor, detail: float = np.inf,
) -> list[Sheet]:  # fmt: skip
    """Lay a surface out in maps of a given size, or of sizes that match the texture's leaves and ``detail``.

    Materials that read the same image share maps; others get separate ones; those without coordinates get an
    atlas each. Otherwise all triangles share one atlas, where materials that differ only by name are joined.
    Raises ModelError for coordinates that cannot be kept, and for an atlas without room.
    """
    materials, owners = [Material()], np.zeros(len(surface.triangles), np.int32)
    if isinstance(surface.source, MaterialSource):
        materials, owners = surface.source.materials, surface.source.triangle_materials
    if uv not in ("atlas", "xatlas"):
        try:
            sheets = list(_kept(texture, surface, names, size, padding, materials, owners, pool))
            for sheet in sheets:
                if sheet.mesh.uv is None:  # an atlas
                    continue
                try:
                    check_stretches(texture, sheet.mesh, names, _LARGEST)
                except ModelError as refusal:
                    if uv != "keep":
                        raise
                    warnings.warn(str(refusal), ModelWarning, stacklevel=3)
            return sheets
        except ModelError:
            if uv == "keep":
                raise
    layout = _atlas(texture, surface, names, size, padding, detail, by_xatlas=uv == "xatlas")
    triangles = np.arange(len(surface.triangles), dtype=np.int32)
    kinds: dict[tuple[str, bool], list[int]] = {}
    for number in np.unique(owners).tolist():
        kinds.setdefault((materials[number].alpha_mode, materials[number].double_sided), []).append(number)
    kind_of = np.zeros(len(materials), np.int32)
    for kind, numbers in enumerate(kinds.values()):
        kind_of[numbers] = kind
    joined = [
        materials[numbers[0]] if len(numbers) == 1 else materials[numbers[0]]._replace(name="")
        for numbers in kinds.values()
    ]
    return [Sheet(surface, triangles, layout, joined, kind_of[owners])]


def _kept(
    texture: OctreeTexture, surface: Surface, names: list[str], size: int | None, padding: int | None,
    materials: list[Material], owners: Int32s, pool: Executor,
) -> Iterator[Sheet]:  # fmt: skip
    """Yield the sheets of a surface at its texture coordinates; raises ModelError if they cannot be kept."""
    margin = PADDING if padding is None else padding
    groups: dict[object, list[int]] = {}
    for number in np.unique(owners).tolist():
        textures = [each.texture for each in materials[number].inputs.values() if each.texture is not None]
        key = (id(textures[0].texels), textures[0].slot) if textures else number
        groups.setdefault(key, []).append(number)
    coordinates = [_coordinates(surface, materials[numbers[0]]) for numbers in groups.values()]
    if all(each is None for each in coordinates):
        raise ModelError(f"{surface.name} has no texture coordinates to keep; let octex make an atlas")
    for corners, numbers in zip(coordinates, groups.values(), strict=True):
        triangles = np.flatnonzero(np.isin(owners, numbers)).astype(np.int32)
        group = [materials[number] for number in numbers]
        local_owners = np.searchsorted(numbers, owners[triangles]).astype(np.int32)
        mesh = surface.picked(triangles)[0]
        if corners is None:
            layout = _atlas(texture, mesh, names, size, padding)
            yield Sheet(mesh, triangles, layout, group, local_owners)
            continue
        mesh.uv = corners.of(triangles)
        layout = kept_layout(mesh, size or PROBE, margin)
        try:
            check_overlaps(texture, mesh, names, layout, pool)
        except ModelError:
            tiles = _tiles(mesh)
            if not tiles:
                raise
        else:
            layout = _fitted(texture, mesh, names, layout, size, group)
            yield Sheet(mesh, triangles, layout, group, local_owners)
            continue
        for name, tile, of_tile in tiles:
            layout = kept_layout(tile, size or PROBE, margin)
            check_overlaps(texture, tile, names, layout, pool)
            tile_materials = [each._replace(name=f"{each.name}.{name}") for each in group]
            layout = _fitted(texture, tile, names, layout, size, group)
            yield Sheet(tile, triangles[of_tile], layout, tile_materials, local_owners[of_tile])


def _coordinates(surface: Surface, material: Material) -> Corners | None:
    """Return the coordinates at which a material reads its images, else the surface's, if any."""
    slots = [each.texture.slot for each in material.inputs.values() if each.texture is not None]
    if slots and isinstance(surface.source, MaterialSource):
        return surface.source.coordinates[slots[0]]
    return surface.uv


def _tiles(mesh: Mesh) -> list[tuple[int, Mesh, Int32s]]:
    """Split a mesh by UDIM tiles: numbers, meshes, triangles; empty if a triangle lies in several tiles."""
    assert mesh.uv is not None
    uv = mesh.uv.values[mesh.uv.rows].astype(np.float64)
    squares = np.floor(uv.mean(axis=1))
    across, up = squares[:, 0].astype(np.int64), -squares[:, 1].astype(np.int64)
    numbers = 1001 + across + 10 * up
    in_square = uv - squares[:, None]
    is_tiled = (across >= 0) & (across < 10) & (up >= 0)
    is_tiled &= (np.abs(in_square - 0.5) <= 0.5 + BEYOND).all((1, 2))
    present = np.unique(numbers).tolist()
    if not is_tiled.all() or not 1 < len(present) <= _MOST_TILES:
        return []
    tiles = []
    for number in present:
        tile, triangles, _ = mesh.picked(np.flatnonzero(numbers == number))
        values = np.clip(in_square[triangles], 0.0, 1.0).reshape(-1, 2).astype(np.float32)
        tile.uv = Corners(values, np.arange(3 * triangles.size, dtype=np.int32).reshape(-1, 3))
        tiles.append((number, tile, triangles))
    return tiles


def _atlas(
    texture: OctreeTexture, mesh: Mesh, names: list[str], size: int | None, padding: int | None,
    detail: float = np.inf, *, by_xatlas: bool = False,
) -> Layout:  # fmt: skip
    """Return an atlas of a given size, or of the first that matches the texture's leaves and detail."""
    leaf, sizes = leaf_of(texture, mesh), [size or _LARGEST]
    texel = _ABOUT * leaf
    if size is None:
        normals = unit(area_vectors(mesh.rest[mesh.triangles]))
        right = across(normals)
        steps = texel * right, texel * np.cross(normals, right)
        texel /= fineness(texture, mesh, names, leaf, areas_of(mesh), steps)
        texel = max(min(texel, detail), texel / 2.0)
        first = _size_for(texel, areas_of(mesh).sum(), 0.6)
        sizes = [2**n for n in range(first.bit_length() - 1, _LARGEST.bit_length())]
    return atlas_layout(mesh, sizes, padding, texel, by_xatlas=by_xatlas)


def _fitted(
    texture: OctreeTexture, mesh: Mesh, names: list[str], layout: Layout, size: int | None,
    materials: list[Material],
) -> Layout:  # fmt: skip
    """Return a layout of a given size, or of one that matches leaves, detail and the materials' images."""
    if size is not None:
        return layout.sized(size)
    leaf = leaf_of(texture, mesh)
    is_squeezed, areas = squeezed(texture, mesh, _LARGEST), areas_of(mesh)
    is_even = ~is_squeezed
    part = unit_area(layout._replace(uv=layout.uv.of(np.flatnonzero(is_even).astype(np.int32))))
    size = _size_for(_ABOUT * leaf, areas[is_even].sum(), part)
    corners = size * layout.uv.values[layout.uv.rows].astype(np.float64)
    steps = steps_between(mesh.rest[mesh.triangles], corners)
    size = min(size * fineness(texture, mesh, names, leaf, areas * is_even, steps), _LARGEST)
    if is_squeezed.any():
        textures = [each.texture for material in materials for each in material.inputs.values()]
        finest = max((max(each.texels.shape[:2]) for each in textures if each is not None), default=_SMALLEST)
        size = max(size, _power_above(finest))
    return layout.sized(size)


def _size_for(texel: float, area: float, part: float) -> int:
    """Return the size of maps of which a ``part`` shows ``area`` with texels this wide."""
    return _power_above(np.sqrt(area / max(part, 1e-6)) / texel)


def _power_above(side: float) -> int:
    return int(np.clip(2 ** np.ceil(np.log2(max(side, 1.0))), _SMALLEST, _LARGEST))


def coordinates_of(sheets: list[Sheet], count: int) -> Corners:
    """Return the texture coordinates of all ``count`` triangles, each in its sheet's map."""
    if len(sheets) == 1 and len(sheets[0].triangles) == count:
        return sheets[0].layout.uv
    values, rows, first = [], np.empty((count, 3), np.int32), 0
    for sheet in sheets:
        used_rows, local = np.unique(sheet.layout.uv.rows, return_inverse=True)
        rows[sheet.triangles] = first + local.reshape(-1, 3)
        values.append(sheet.layout.uv.values[used_rows])
        first += used_rows.size
    return Corners(np.concatenate(values), rows)
