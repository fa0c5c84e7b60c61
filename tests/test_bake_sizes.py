"""How large baked maps are, and how their images are stored."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import octex
from octex.baking import atlas
from octex.baking.coordinates import leaf_of
from octex.baking.layout import unit_area
from octex.baking.texels import draw_texels
from octex.source.materials import MaterialSource
from octex.source.surface import Surface
from tests.test_bake import psnr, two_squares, waves

DROID = Path(octex.__file__).parents[1] / "samples" / "droid.glb"


@pytest.fixture(scope="module")
def droid() -> tuple[octex.OctreeTexture, Surface]:
    surface = octex.load_surface(DROID)
    return octex.convert(surface, 8, channels=["base_color"]), surface


def sizes_of(baked: Surface) -> list[int]:
    """Return the sizes of the base colours' maps."""
    assert isinstance(baked.source, MaterialSource)
    textures = [each.inputs["base_color"].texture for each in baked.source.materials]
    return [each.texels.shape[0] for each in textures if each is not None]


@pytest.mark.parametrize("own_charts", [False, True])
@pytest.mark.parametrize("size", [64, 512])
def test_all_charts_of_the_droid_have_room_in_small_maps(
    droid: tuple[octex.OctreeTexture, Surface], size: int, own_charts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    texture, surface = droid
    if own_charts:
        monkeypatch.setitem(sys.modules, "xatlas", None)
    baked = octex.bake(texture, surface, uv="atlas", texture_size=size)
    assert sizes_of(baked) == [size]
    points = baked.scatter(20_000, seed=1)
    assert psnr(baked.evaluate(points), texture.sample(points, "base_color")) > {64: 19.0, 512: 34.0}[size]


@pytest.mark.parametrize("size", [64, 128, 512, None])
def test_whether_coordinates_are_kept_does_not_depend_on_the_size(
    droid: tuple[octex.OctreeTexture, Surface], size: int | None
) -> None:
    texture, surface = droid
    kept = octex.bake(texture, surface, texture_size=size)
    assert isinstance(surface.source, MaterialSource)
    (own,) = surface.source.coordinates
    assert kept.uv is not None
    is_same = np.isclose(kept.uv.values[kept.uv.rows], own.values[own.rows], atol=1e-6).all(axis=(1, 2))
    assert (
        is_same == (own.values[own.rows] != 0.0).any(axis=(1, 2))
    ).mean() > 0.99  # parts without get an atlas


def scattered_triangles(count: int) -> Surface:
    """Return triangles that are a chart each."""
    random = np.random.default_rng(0)
    vertices = np.repeat(random.random((count, 3)), 3, axis=0) + 0.05 * random.random((3 * count, 3))
    return Surface.from_arrays(vertices, np.arange(3 * count).reshape(-1, 3))


@pytest.mark.parametrize(("count", "padding"), [(6, 8), (30, 4), (100, 2), (300, 1), (1200, 0)])
def test_an_atlas_with_more_charts_has_less_padding(count: int, padding: int) -> None:
    layout = atlas.atlas_layout(scattered_triangles(count), [256], None, 1e-4)
    assert layout.padding == padding
    assert unit_area(layout) >= 0.25
    drawn = draw_texels(layout.corners, layout.charts, layout.edges, 256, 0, 256)
    shown = drawn.triangles >= 0
    # Nothing of another chart lies within twice the padding of a texel.
    for move in range(1, 2 * padding - 1):
        for axis in (0, 1):
            one, two = (np.moveaxis(each, axis, 0) for each in (shown, drawn.triangles))
            both = one[move:] & one[:-move]
            assert (two[move:] == two[:-move])[both].all()


def test_maps_are_as_fine_as_the_leaves_on_their_triangles() -> None:
    surface = two_squares()
    texture = octex.convert(surface.with_sources({"base_color": waves}), 7)
    fine = octex.fill(texture, surface, octex.Box((-1, -1, -1), (0.9, 2, 2)), (1.0, 0.0, 0.0), max_depth=9)
    assert fine.tree.max_depth == 9
    size = sizes_of(octex.bake(texture, surface))[0]
    assert sizes_of(octex.bake(fine, surface)) == [4 * size, size]
    spot = octex.fill(texture, surface, octex.Sphere((0.5, 0.5, 0.0), 0.02), (1.0, 0.0, 0.0), max_depth=9)
    assert spot.tree.max_depth == 9
    assert sizes_of(octex.bake(spot, surface)) == [size, size]


def test_where_a_texture_is_not_its_finest_cells_count() -> None:
    surface = two_squares()
    texture = octex.convert(surface.with_sources({"base_color": waves}), 5)
    away = Surface.from_arrays(surface.rest + 9.0, surface.triangles)
    assert leaf_of(texture, surface) == leaf_of(texture, away) == texture.placement.size / 32
