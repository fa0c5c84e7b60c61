"""Baking: texels against counting, gutters against unfolding by hand, maps against the field."""

import json
import re
import urllib.parse
from functools import cache

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

import octex
from octex.baking import atlas
from octex.baking.coordinates import stretches_of
from octex.baking.gutters import Borders, fill_up, gutter_of
from octex.baking.layout import kept_layout, neighbors, unit_area
from octex.baking.maps import fit_rows, lacking
from octex.baking.texels import draw_texels, texel_points
from octex.channels import encode, linear_to_srgb
from octex.errors import ArgumentError, ModelError, ModelWarning
from octex.source.corners import Corners
from octex.source.materials import Input, Material, MaterialSource, Texture
from octex.source.mesh import Mesh
from octex.source.surface import Surface
from octex.source.tangents import corner_frames
from tests.make import solids
from tests.make.painted import ball, square
from tests.make.small_surfaces import whole

#: The faces of a unit cube: the triangles' corners at rest, and in the unit square, a chart for each face.
CUBE_AXES = [(axis, side) for axis in range(3) for side in (0.0, 1.0)]


def cube_with_charts():
    """A cube whose faces are squares of a quarter of the map's edge, well apart."""
    vertices, triangles, uv = [], [], []
    for number, (axis, side) in enumerate(CUBE_AXES):
        across, up = (axis + 1) % 3, (axis + 2) % 3
        corners = np.zeros((4, 3))
        corners[:, axis] = side
        corners[:, across] = [0, 1, 1, 0]
        corners[:, up] = [0, 0, 1, 1]
        place = np.array([0.05 + 0.32 * (number % 3), 0.05 + 0.5 * (number // 3)])
        flat = place + 0.25 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        order = [[0, 1, 2], [0, 2, 3]] if side else [[0, 2, 1], [0, 3, 2]]
        for triangle in order:
            triangles.append([len(vertices) + k for k in range(3)])
            vertices += [corners[k] for k in triangle]
            uv.append([flat[k] for k in triangle])
    return Surface.from_arrays(np.array(vertices), np.array(triangles), uv=np.array(uv))


@cache
def painted_sphere():
    points, triangles = solids.sphere([0.0, 0.0, 0.0], 1.0, 32)
    surface = Surface.from_arrays(points, triangles).with_sources({"base_color": waves})
    return octex.convert(surface, 6), surface


def waves(points):
    return 0.5 + 0.4 * np.sin(3.0 * points + [0.0, 1.0, 2.0])


def psnr(a, b):
    difference = linear_to_srgb(np.clip(a, 0, 1)) - linear_to_srgb(np.clip(b, 0, 1))
    return float(-10 * np.log10(max(np.mean(difference**2), 1e-20)))


coordinates = st.floats(-2.0, 10.0, width=32)


@given(st.lists(coordinates, min_size=6, max_size=6))
@settings(max_examples=60, deadline=None)
def test_a_triangle_covers_as_much_of_the_texels_as_points_in_it_say(numbers):
    corners = np.array(numbers).reshape(1, 3, 2)
    drawn = draw_texels(corners, np.zeros(1, np.int32), np.ones((1, 3), np.bool_), 8, 0, 8)
    steps = (np.arange(8 * 32) + 0.5) / 32
    points = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    a, b, c = corners[0]
    sides = [
        (q - p)[0] * (points - p)[:, 1] - (q - p)[1] * (points - p)[:, 0] for p, q in ((a, b), (b, c), (c, a))
    ]
    inside = np.all(np.array(sides) > 0, axis=0) | np.all(np.array(sides) < 0, axis=0)
    counted = inside.reshape(8, 32, 8, 32).mean(axis=(1, 3))
    np.testing.assert_allclose(drawn.areas, counted, atol=0.08)
    well = counted > 0.3
    assert (drawn.triangles[well] == 0).all()
    for axis in range(2):
        weights = inside.reshape(8, 32, 8, 32)
        place = (np.arange(32) + 0.5) / 32
        along = place[None, :, None, None] if axis else place[None, None, None, :]
        middle = (weights * along).sum(axis=(1, 3)) / np.maximum(weights.sum(axis=(1, 3)), 1)
        np.testing.assert_allclose(drawn.centroids[..., axis][well], middle[well], atol=0.06)


def test_triangles_of_a_chart_share_texels_and_charts_do_not():
    corners = np.array(
        [[[0.0, 0], [4, 0], [0, 4]], [[4.0, 0], [4, 4], [0, 4]], [[4.0, 0], [4.4, 0], [4.0, 4]]]
    )
    edges = np.array([[True, False, True], [True, True, False], [True, True, True]])
    drawn = draw_texels(corners, np.array([0, 0, 1], np.int32), edges, 6, 0, 4)
    np.testing.assert_allclose(drawn.areas[:, :4], 1.0, atol=1e-6)
    np.testing.assert_allclose(drawn.centroids[:, :4], 0.5, atol=1e-6)
    assert (drawn.triangles[:, 4][:3] == 2).all()
    assert 0.0 < drawn.areas[0, 4] < 0.4
    diagonal = drawn.triangles[[0, 1, 2, 3], [3, 2, 1, 0]]
    assert set(diagonal.tolist()) <= {0, 1}
    flat = np.concatenate([corners.reshape(-1, 2), np.zeros((9, 1))], axis=1)
    faces = np.arange(9, dtype=np.int32).reshape(-1, 3)
    shown = texel_points(corners, np.arange(3, dtype=np.int32), drawn, 0, flat, faces)
    rows, columns = shown.texels // 6, shown.texels % 6
    np.testing.assert_array_equal(np.sort(shown.texels), np.flatnonzero(drawn.triangles >= 0))
    np.testing.assert_array_equal(shown.each(), drawn.triangles[rows, columns])
    np.testing.assert_allclose(
        shown.rest[:, :2] - np.stack([columns, rows], axis=1), drawn.centroids[rows, columns], atol=1e-6
    )
    assert (shown.barycentric >= 0).all()
    np.testing.assert_allclose(shown.barycentric.sum(axis=1), 1.0)


def test_rows_drawn_apart_are_those_drawn_together():
    corners = np.random.default_rng(3).random((40, 3, 2)) * 20 - 2
    charts = np.arange(40, dtype=np.int32) // 4
    edges = np.ones((40, 3), np.bool_)
    together = draw_texels(corners, charts, edges, 16, 0, 16)
    apart = [draw_texels(corners, charts, edges, 16, first, first + 4) for first in range(0, 16, 4)]
    for whole_map, parts in zip(together, zip(*apart, strict=True), strict=True):
        np.testing.assert_array_equal(whole_map, np.concatenate(parts))


def test_beyond_an_edge_the_surface_goes_on_as_if_unfolded():
    surface = cube_with_charts()
    layout = kept_layout(surface, 256)
    drawn = draw_texels(layout.corners, layout.charts, layout.edges, 256, 0, 256)
    others, sides = neighbors(surface)
    assert (others >= 0).all()
    taken = drawn.areas > 0
    borders = Borders.of(layout, taken, 6)
    gutter = gutter_of(borders, layout, surface.rest, surface.triangles, others, sides)
    assert gutter.texels.size > 6 * 4 * 50
    rest = surface.rest_at(gutter.triangles, gutter.barycentric)
    edges = surface.rest_at(gutter.beside, gutter.edges)
    texel = 1 / 64
    flat = np.array([layout.corners[t] for t in gutter.beside])
    at_edge = np.einsum("nk,nkx->nx", gutter.edges, flat)
    away = np.linalg.norm(
        np.stack([gutter.texels % 256 + 0.5, gutter.texels // 256 + 0.5], axis=1) - at_edge, axis=1
    )
    # Straight beyond a side, not around a corner: as far from the edge as in the map, on the face beyond.
    straight = gutter.edges.min(axis=1) == 0.0
    straight &= np.sort(gutter.edges, axis=1)[:, 1] > 1e-9
    np.testing.assert_allclose(
        np.linalg.norm(rest - edges, axis=1)[straight], away[straight] * texel, rtol=1e-6
    )
    assert (gutter.triangles[straight] // 2 != gutter.beside[straight] // 2).all()


def test_where_the_surface_ends_gutters_show_its_edge():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    surface = Surface.from_arrays(square, [[0, 1, 2], [0, 2, 3]], uv=square[:, :2] * 0.5 + 0.25)
    layout = kept_layout(surface, 64)
    drawn = draw_texels(layout.corners, layout.charts, layout.edges, 64, 0, 64)
    borders = Borders.of(layout, drawn.areas > 0, 4)
    gutter = gutter_of(borders, layout, surface.rest, surface.triangles, *neighbors(surface))
    rest = surface.rest_at(gutter.triangles, gutter.barycentric)
    on_edge = np.isclose(rest[:, :2], 0.0) | np.isclose(rest[:, :2], 1.0)
    assert on_edge.any(axis=1).all()


def test_maps_are_nearer_to_the_field_when_read_bilinearly():
    def curved(x, y):
        return np.stack([0.01 * x * x + 0.02 * y * y + 0.1 * x, 0.3 * x - 0.2 * y], axis=-1)

    grid = np.arange(12) + 0.5
    values = curved(*np.meshgrid(grid, grid)).astype(np.float32)
    nothing = lacking(1, 0.0)

    def fit(values, areas, part=nothing):
        fitted = np.empty(values.shape, np.float32)
        fit_rows(values, areas, part, 0, fitted)
        return fitted

    def fit_values(values, part):
        return fit(values.astype(np.float32), np.ones((12, 12), np.float32), part)

    fitted = fit(values, np.ones((12, 12), np.float32))
    np.testing.assert_allclose(fitted[..., 1], values[..., 1], atol=1e-5)  # what is straight stays
    random = np.random.default_rng(0).random((5000, 2)) * 8 + 2
    errors = [bilinear(each, random) - curved(*random.T) for each in (values, fitted)]
    assert np.sqrt((errors[1][:, 0] ** 2).mean()) < 0.5 * np.sqrt((errors[0][:, 0] ** 2).mean())
    # Means over texels lack more: of 0.01 x² + 0.02 y² they are 0.03 / 12 above what is in the middles.
    means = fit_values(values + 0.03 / 12.0, lacking(1, 1.0))
    np.testing.assert_allclose(means[1:-1, 1:-1, 0], fitted[1:-1, 1:-1, 0], atol=1e-5)
    halves = fit_values(values + 0.03 / 12.0 * 0.75, lacking(2, 0.0))
    np.testing.assert_allclose(halves[1:-1, 1:-1, 0], fitted[1:-1, 1:-1, 0], atol=1e-5)
    some = np.empty((4, 12, 2), np.float32)
    fit_rows(values, np.ones((12, 12), np.float32), lacking(1, 0.0), 3, some)
    np.testing.assert_array_equal(some, fitted[3:7])
    holes = np.ones((12, 12), np.float32)
    holes[5, 5] = 0.0
    np.testing.assert_array_equal(fit(values, holes)[5, 4:7], values[5, 4:7])


def bilinear(values, places):
    """Read a map (height, width, components) at places (n, 2) to the right and down, in texels."""
    low = np.floor(places - 0.5).astype(int)
    x, y = (places - 0.5 - low).T[:, :, None]
    upper = (1 - x) * values[low[:, 1], low[:, 0]] + x * values[low[:, 1], low[:, 0] + 1]
    lower = (1 - x) * values[low[:, 1] + 1, low[:, 0]] + x * values[low[:, 1] + 1, low[:, 0] + 1]
    return (1 - y) * upper + y * lower


def test_what_is_empty_is_filled_from_around_it():
    values = np.zeros((40, 40, 2), np.float32)
    weights = np.zeros((40, 40), np.float32)
    values[:, 5], weights[:, 5] = (0.2, 0.8), 1.0
    values[:, 30], weights[:, 30] = (0.6, 0.4), 1.0
    fill_up(values, weights)
    assert (weights.sum(), values[:, 5, 0].max()) == (80.0, np.float32(0.2))
    assert values[..., 0].min() >= np.float32(0.2) - 1e-6
    assert values[..., 0].max() <= np.float32(0.6) + 1e-6
    assert values[20, 0, 0] < 0.3 < 0.42 < values[20, 39, 0]  # more like what is nearer
    np.testing.assert_allclose(values.sum(axis=2), 1.0, atol=1e-5)


@pytest.fixture(params=["xatlas", "xatlas by pieces", "atlas"])
def by_xatlas(request, monkeypatch):
    """Say which charts to make: those of octex, or those of xatlas, all at once or by pieces."""
    if request.param != "atlas":
        pytest.importorskip("xatlas", reason="the extra octex[atlas] is not installed")
    if request.param == "xatlas by pieces":
        monkeypatch.setattr(atlas, "_PIECE", 400)
    return bool(request.param != "atlas")


def test_an_atlas_has_room_for_every_triangle_once(by_xatlas):
    points, triangles = solids.sphere([0.0, 0.0, 0.0], 1.0, 24)
    surface = Surface.from_arrays(points, triangles)
    layout = atlas.atlas_layout(surface, [256], 4, 1.0, by_xatlas=by_xatlas)
    drawn = draw_texels(layout.corners, layout.charts, layout.edges, 256, 0, 256)
    assert float(drawn.areas.sum()) / 256**2 == pytest.approx(unit_area(layout), rel=2e-3)
    assert unit_area(layout) > 0.3
    assert layout.corners.min() >= 4.0
    assert layout.corners.max() <= 252.0
    own = np.unique(drawn.triangles[drawn.triangles >= 0])
    assert own.size > 0.99 * len(triangles)


@pytest.mark.parametrize("scale", [2.0**-13, 2.0**17])
def test_charts_do_not_depend_on_the_units_of_a_model(scale, by_xatlas):
    points, triangles = solids.sphere([0.0, 0.0, 0.0], 1.0, 24)
    surfaces = [Surface.from_arrays(points * each, triangles) for each in (1.0, scale)]
    layouts = [atlas.atlas_layout(each, [256], 4, 1.0, by_xatlas=by_xatlas) for each in surfaces]
    charts = [np.unique(each.charts).size for each in layouts]
    assert charts[0] == charts[1] > 1


@pytest.mark.parametrize("ending", [".glb", ".gltf", ".obj", ".usdz", ".3mf", ".ply"])
@pytest.mark.parametrize("aside", [0.0, 60.0, 4_500_321.91])
def test_files_keep_the_shape_of_models_far_from_the_origin(ending, aside, tmp_path):
    if ending in (".usdz", ".3mf"):
        pytest.importorskip("pxr" if ending == ".usdz" else "lib3mf")
    points, triangles = solids.sphere([0.0, 0.0, 0.0], 1.0, 12)
    points += [aside, -aside / 8, 0.0]
    surface = Surface.from_arrays(points, triangles).with_sources({"base_color": (0.2, 0.5, 0.8)})
    texture = octex.convert(surface, 3)
    if ending in (".3mf", ".ply"):
        baked = octex.bake_vertices(texture, surface)
    else:
        baked = octex.bake(texture, surface, texture_size=256)
    octex.write_model(baked, tmp_path / f"ball{ending}")
    read = octex.load_surface(tmp_path / f"ball{ending}")
    found, expected = (np.unique(each.vertices.round(4), axis=0) for each in (read, baked))
    np.testing.assert_allclose(found, expected, atol=2e-4)


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_shading_normals_are_kept_and_posed(ending, tmp_path):
    points, triangles = solids.sphere([0.0, 0.0, 0.0], 1.0, 12)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    frames = corner_frames(points, triangles, Corners(normals.astype(np.float32), triangles), None, None)
    turned = points @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    source = Surface.from_arrays(points, triangles).source
    surface = Surface(turned, triangles, source, rest=points, frames=frames)
    baked = octex.bake(octex.convert(surface, 3), surface, texture_size=256)
    octex.write_model(baked, tmp_path / f"ball{ending}")
    read = octex.load_surface(tmp_path / f"ball{ending}", normals=True)
    assert read.frames is not None
    found = read.frames.normals.values[read.frames.normals.rows]
    np.testing.assert_allclose(found, read.vertices[read.triangles], atol=1e-5)


def test_an_atlas_without_room_says_so():
    random = np.random.default_rng(0)
    vertices = np.repeat(random.random((100, 3)), 3, axis=0) + 0.05 * random.random((300, 3))
    surface = Surface.from_arrays(vertices, np.arange(300).reshape(-1, 3))
    with pytest.raises(ModelError, match=r"100 charts do not fit in a map of 64 × 64 texels; make it larger"):
        atlas.atlas_layout(surface, [64], 8, 1.0)


@pytest.mark.parametrize("part", [0.05, 0.3, 0.9])
def test_charts_are_placed_in_the_first_place_where_they_fit(part):
    random, size, missed = np.random.default_rng(7), 24, 0
    free, longest = np.ones((size, size), np.bool_), np.full(size, size, np.int64)
    for _ in range(300):
        mask = random.random(random.integers(1, 8, 2)) < part
        mask[0, 0] = True
        start = int(random.integers(0, size**2 // 2))
        expected = _first_place(free, mask, start)
        assert atlas._place(free, longest, mask, start) == expected
        missed += expected < 0
        if expected >= 0:
            row, column = divmod(expected, size)
            i, j = np.argwhere(mask).T + np.array([[row], [column]])
            after = free.copy()
            after[i, j] = False
            rows = slice(row, row + len(mask))
            atlas._take(free[rows], longest[rows], mask, column)
            assert np.array_equal(free, after)
    assert missed


def _first_place(free, mask, start):
    """Return the first place from one on where all of a mask's blocks are free, −1 for none."""
    (rows, columns), size = mask.shape, len(free)
    for at in range(start, size**2):
        i, j = divmod(at, size)
        if i + rows <= size and j + columns <= size and free[i : i + rows, j : j + columns][mask].all():
            return at
    return -1


def test_a_map_grows_until_charts_fit_and_texels_are_as_small_as_cells():
    random = np.random.default_rng(0)
    vertices = np.repeat(random.random((300, 3)), 3, axis=0) + 0.05 * random.random((900, 3))
    surface = Surface.from_arrays(vertices, np.arange(900).reshape(-1, 3)).with_sources({"base_color": waves})
    texture = octex.convert(surface, 6)
    baked = octex.bake(texture, surface)
    assert isinstance(baked.source, MaterialSource)
    image = baked.source.materials[0].inputs["base_color"].texture
    assert baked.uv is not None
    assert image is not None
    side = image.texels.shape[0]
    rest, flat = surface.rest[surface.triangles], side * baked.uv.values[baked.uv.rows].astype(np.float64)
    area = np.linalg.norm(np.cross(rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]), axis=1).sum()
    texels = np.abs(np.linalg.det(flat[:, 1:] - flat[:, :1])).sum()
    assert np.sqrt(area / texels) <= 1.15 * texture.placement.size / 2**6
    assert side > 2 * np.sqrt(area / 2) / (texture.placement.size / 2**6)  # what the area alone would need


@pytest.mark.parametrize("uv", ["keep", "atlas"])
def test_baked_maps_show_the_field(uv):
    texture, surface = painted_sphere()
    if uv == "keep":
        cube = cube_with_charts()
        surface = cube.with_sources({"base_color": waves})
        texture = octex.convert(surface, 6)
    baked = octex.bake(texture, surface, uv=uv, texture_size=512)
    points = baked.scatter(20_000, seed=1)
    field = texture.sample(points, "base_color")
    assert psnr(baked.evaluate(points), field) > 48.0
    # Read as widely as a smaller level of the maps is coarse: no seam, nothing from outside the charts.
    wide = 8 * 2 * np.sqrt(surface.areas().sum() / 512**2)
    assert psnr(baked.evaluate(points, width=wide), texture.sample(points, "base_color", width=wide)) > 38.0


def test_all_channels_of_a_material_are_baked():
    surface = whole()
    texture = octex.convert(surface, 5)
    baked = octex.bake(texture, surface, texture_size=128)
    assert [form.name for form in baked.channels] == [*texture.channels]
    assert {form.name: form.space for form in baked.channels}["emissive"] == "linear"
    points = baked.scatter(4000)
    for name in texture.channels:
        expected, found = texture.sample(points, name), baked.evaluate(points, name)
        if name == "normal":
            expected = expected / np.linalg.norm(expected, axis=1, keepdims=True)
            cosines = np.einsum("nx,nx->n", expected, found)
            assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean() < 1.5
            continue
        scale = max(1.0, float(expected.max()))
        assert float(np.mean(np.abs(expected - found))) / scale < 0.01


def test_coordinates_that_repeat_are_drawn_in_each_square():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    uv = square[:, :2] * 0.8 + (0.5, -0.4)
    surface = Surface.from_arrays(square, [[0, 1, 2], [0, 2, 3]], uv=uv).with_sources({"base_color": waves})
    texture = octex.convert(surface, 6)
    baked = octex.bake(texture, surface, uv="keep", texture_size=256)
    points = baked.scatter(5000)
    assert psnr(baked.evaluate(points), texture.sample(points, "base_color")) > 45.0


@pytest.mark.parametrize(
    ("uv", "words"),
    [
        (None, "has no texture coordinates to keep"),
        ([0.1, 0.1, 0.9, 0.1, 0.5, 0.9], "texture coordinates overlap"),
        ([0.1, 0.1, 9.9, 0.1, 0.5, 9.9], "reach over 100 squares"),
    ],
)
def test_coordinates_that_cannot_be_kept_are_refused_or_made_anew(uv, words):
    points, triangles = whole().vertices, whole().triangles
    own = None if uv is None else np.tile(uv, 4).reshape(4, 3, 2)  # all triangles in one place
    surface = Surface.from_arrays(points, triangles, uv=own)
    texture = octex.convert(surface.with_sources({"base_color": waves}), 4)
    with pytest.raises(ModelError, match=words):
        octex.bake(texture, surface, uv="keep")
    baked = octex.bake(texture, surface, texture_size=64)
    assert baked.uv is not None
    assert 0.0 <= baked.uv.values.min() <= baked.uv.values.max() <= 1.0


def two_squares():
    """Two squares side by side, each with all of the unit square, of two materials."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]], np.int32)
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    uv = Corners(square, np.array([[0, 1, 2], [0, 2, 3]] * 2, np.int32))
    images = [Texture(np.full((4, 4, 4), 65535 - n, np.uint16)) for n in range(2)]
    materials = [
        Material({"base_color": Input((1.0,) * 3, images[0])}, name="left", double_sided=True),
        Material(
            {"base_color": Input((1.0,) * 3, images[1]), "alpha": Input((0.5,), None, (3,))},
            "blend",
            name="right",
        ),
    ]
    source = MaterialSource(
        materials, np.array([0, 0, 1, 1], np.int32), vertices, triangles, coordinates=[uv]
    )
    return Surface(vertices, triangles, source, uv=uv)


def as_source(surface):
    assert isinstance(surface.source, MaterialSource)
    return surface.source


def painted(surface):
    return octex.convert(surface.with_sources({"base_color": waves}), 6)


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_each_material_gets_maps_and_keeps_what_it_is(ending, tmp_path):
    surface = two_squares()
    texture = painted(surface)
    baked = octex.bake(texture, surface, texture_size=128)
    points = baked.scatter(5000)
    field = texture.sample(points, "base_color")
    assert psnr(baked.evaluate(points), field) > 45.0
    left, right = as_source(baked).materials
    assert (left.name, left.double_sided, left.alpha_mode) == ("left", True, "opaque")
    assert (right.name, right.double_sided, right.alpha_mode) == ("right", False, "blend")
    octex.write_model(baked, tmp_path / f"two{ending}")
    read = octex.load_surface(tmp_path / f"two{ending}")
    assert psnr(read.evaluate(points), field) > 40.0  # images of .obj files repeat
    if ending == ".glb":
        known = [each[2:] for each in as_source(read).materials]
        assert known == [(0.5, "left", True), (0.5, "right", False)]


def test_materials_that_read_one_image_share_maps_and_an_atlas_joins_those_alike():
    surface = two_squares()
    own = as_source(surface)
    first = own.materials[0]
    uv = np.concatenate(
        [own.coordinates[0].values * (0.5, 1.0), own.coordinates[0].values * (0.5, 1.0) + (0.5, 0)]
    )
    rows = own.coordinates[0].rows.copy()
    rows[2:] += 4
    corners = Corners(uv.astype(np.float32), rows)
    materials = [first, first._replace(name="other")]
    source = MaterialSource(
        materials, own.triangle_materials, surface.rest, surface.triangles, coordinates=[corners]
    )
    shared = Surface(surface.vertices, surface.triangles, source, uv=corners)
    texture = painted(shared)
    kept = as_source(octex.bake(texture, shared, uv="keep", texture_size=64))
    one, two = (each.inputs["base_color"].texture for each in kept.materials)
    assert one is not None
    assert two is not None
    assert one.texels is two.texels
    assert [each.name for each in kept.materials] == ["left", "other"]
    joined = as_source(octex.bake(texture, shared, uv="atlas", texture_size=64))
    assert [(each.name, each.double_sided) for each in joined.materials] == [("", True)]
    apart = as_source(octex.bake(painted(surface), surface, uv="atlas", texture_size=64))
    assert [each.name for each in apart.materials] == ["left", "right"]


def test_tiles_become_materials_and_what_overlaps_and_looks_otherwise_is_refused():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    points = np.concatenate([square, square + np.array([1.5, 0.0, 0.0])])
    triangles = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    flat = square[:, :2]
    for moved, words in (((1.0, 0.0), None), ((0.0, 1.0), None), ((0.0, 0.0), "texture coordinates overlap")):
        surface = Surface.from_arrays(points, triangles, uv=np.concatenate([flat, flat + moved]))
        texture = painted(surface)
        if words is not None:
            with pytest.raises(ModelError, match=words):
                octex.bake(texture, surface, uv="keep")
            continue
        baked = octex.bake(texture, surface, uv="keep", texture_size=128)
        names = [each.name for each in as_source(baked).materials]
        assert names == ([".1001", ".1002"] if moved[0] else [".1001", ".1011"])
        seen = baked.scatter(5000)
        assert psnr(baked.evaluate(seen), texture.sample(seen, "base_color")) > 45.0
    # What overlaps but looks alike may stay.
    plain = octex.convert(surface, 5)
    assert octex.bake(plain, surface, uv="keep", texture_size=64).uv is not None


def test_stretches_are_least_singular_values_and_their_ways():
    random = np.random.default_rng(0)
    points, uv = random.normal(size=(300, 3)), random.normal(size=(300, 2)).astype(np.float32)
    uv[:30], uv[30:60, 1], points[60:63, 1:] = uv[0], 0.25, 0.0  # points, lines, and no area
    faces = np.arange(300).reshape(-1, 3)
    found, ways = stretches_of(Mesh(points, faces, uv=Corners(uv, faces.astype(np.int32))), 100)
    assert np.isfinite(found).all()
    assert not ways[20].any()
    for n in np.delete(np.arange(100), 20):
        edges = np.diff(points[faces[n]], axis=0)
        lengths = np.linalg.qr(edges.T)[1]
        stretch = 100.0 * np.diff(uv[faces[n]].astype(np.float64), axis=0).T @ np.linalg.inv(lengths)
        most, least = np.linalg.svd(stretch)[1]
        np.testing.assert_allclose(found[n], least, atol=1e-7 * max(most, 1.0))
        np.testing.assert_allclose(np.linalg.norm(ways[n] @ points[faces[n]]), 1.0)
        moved = np.linalg.norm(100.0 * ways[n] @ uv[faces[n]])
        np.testing.assert_allclose(moved, least, atol=1e-5 * max(most, 1.0))


@pytest.mark.parametrize("across", [0.0, 1.0])
def test_squeezed_coordinates_are_kept_only_where_what_they_show_is_alike(across):
    """As of low-poly models, each part of which is one texel of a palette, or a line of it."""
    points, triangles = square(side=1.0, steps=4)
    uv = np.stack([across * (points[:, 0] + 0.5), np.full(len(points), 0.375)], axis=1)
    palette = np.full((8, 8, 3), 90, np.uint8)
    plain = Surface.from_arrays(points, triangles, uv=uv, image=palette)
    texture = octex.convert(plain, 5)
    kept = octex.bake(texture, plain)
    assert kept.uv is not None
    np.testing.assert_allclose(kept.uv.values[kept.uv.rows], plain.uv.values[plain.uv.rows], atol=1e-6)
    seen = plain.scatter(2000)
    colors = texture.sample(seen, "base_color")
    np.testing.assert_allclose(kept.evaluate(seen), colors, atol=1e-3)
    disc = octex.fill(texture, plain, octex.Sphere((0.1, 0.1, 0.0), 0.3), (1.0, 0.0, 0.0))
    baked = octex.bake(disc, plain)
    assert psnr(baked.evaluate(seen), disc.sample(seen, "base_color")) > 35.0
    with pytest.warns(ModelWarning, match="its texture coordinates are too small: on .* % of it"):
        flat = octex.bake(disc, plain, uv="keep")
    texture_of = as_source(flat).materials[0].inputs["base_color"].texture
    assert (texture_of is not None) == (across > 0.0)
    if texture_of is not None:
        assert texture_of.texels.shape[:2] == (64, 64)
        columns = flat.evaluate(seen)[np.argsort(seen.rest[:, 0])]
        assert columns[:200, 1].min() > 0.09  # left of the disc
        assert columns[1300:1400, 1].max() < 0.07


@pytest.mark.parametrize("supersample", [1, 2])
def test_a_palette_is_kept_part_by_part(supersample):
    """Each triangle has one point of a palette, and lies apart from the others."""
    random = np.random.default_rng(0)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]) + 4.0 * np.stack(
        [*np.divmod(np.arange(16), 4), np.zeros(16)], axis=1
    )[:, None].astype(np.float64)
    uv = np.repeat((random.permutation(64)[:16, None] // [1, 8] % 8 + 0.5) / 8, 3, axis=0)
    palette = random.integers(30, 250, (8, 8, 3)).astype(np.uint8)
    surface = Surface.from_arrays(
        corners.reshape(-1, 3), np.arange(48).reshape(-1, 3), uv=uv, image=palette, mag_filter="nearest"
    )
    texture = octex.convert(surface, 6)
    baked = octex.bake(texture, surface, supersample=supersample)
    texture_of = as_source(baked).materials[0].inputs["base_color"].texture
    assert texture_of is not None
    assert texture_of.texels.shape[:2] == (64, 64)
    seen = surface.scatter(2000)
    np.testing.assert_allclose(baked.evaluate(seen), texture.sample(seen, "base_color"), atol=2e-3)


def test_another_mesh_of_the_object_shows_its_nearest_points():
    texture, fine = painted_sphere()
    points, triangles = solids.sphere([0.0, 0.0, 0.0], 1.0, 10)
    simple = Surface.from_arrays(points, triangles)
    baked = octex.bake(texture, simple, source=fine, max_distance=0.2, texture_size=256)
    seen = baked.scatter(5000)
    outward = seen.rest / np.linalg.norm(seen.rest, axis=1, keepdims=True)
    expected = texture.sample(outward, "base_color", normals=outward)
    assert psnr(baked.evaluate(seen), expected) > 40.0
    # Too far away: filled from around.
    square = np.array([[-1.0, -1, 0.999], [1, -1, 0.999], [1, 1, 0.999], [-1, 1, 0.999]])
    plane = Surface.from_arrays(square, [[0, 1, 2], [0, 2, 3]], uv=(square[:, :2] + 1) / 2)
    near = octex.bake(texture, plane, source=fine, max_distance=0.01, texture_size=64)
    middle = np.array([[0.0, 0.0, 1.0]])
    texels = as_source(near).materials[0].inputs["base_color"].texture
    assert texels is not None
    codes = encode(texture.sample(middle, "base_color", normals=middle), "uint8", "srgb")[0].astype(int)
    assert abs((texels.texels[..., :3] // 257).astype(int) - codes).max() < 30
    with pytest.raises(ArgumentError, match="give source too"):
        octex.bake(texture, simple, max_distance=0.1)
    away = Surface.from_arrays(square + 9.0, [[0, 1, 2], [0, 2, 3]], uv=(square[:, :2] + 1) / 2)
    with pytest.raises(ModelError, match="has no surface near surface that faces the same"):
        octex.bake(texture, away, source=fine, max_distance=0.01, texture_size=64)


def test_texels_no_larger_than_leaves_need_no_footprint():
    texture, surface = painted_sphere()
    points = surface.scatter(2000)
    leaf = texture.placement.size / 2**texture.tree.max_depth
    across = np.cross(points.normals, (0.3, 0.5, 0.8))
    across *= leaf / np.linalg.norm(across, axis=1, keepdims=True)
    sides = 0.6 * across, 0.8 * np.cross(points.normals, across)
    given = texture.sample(points.rest, normals=points.normals, dPdx=sides[0], dPdy=sides[1])
    np.testing.assert_array_equal(given, texture.sample(points.rest, normals=points.normals))


def test_what_bake_cannot_do_is_said():
    surface = whole()
    texture = octex.convert(surface, 3)
    for options, words in [
        ({"texture_size": 100}, "multiple of 8"),
        ({"texture_size": 8}, "texture_size"),
        ({"padding": -1}, "padding"),
        ({"uv": "kept"}, "keep"),
        ({"channels": ["gloss"]}, "channel of the texture"),
        ({"bits": 12}, "8, 16 or 32"),
        ({"supersample": 0}, "supersample"),
    ]:
        with pytest.raises(ArgumentError, match=words):
            octex.bake(texture, surface, **options)


@pytest.mark.parametrize("ending", [".glb", ".gltf", ".obj"])
def test_written_models_read_back_as_they_were(ending, tmp_path):
    surface = whole()
    channels = ["base_color", "metallic", "roughness", "normal"] + ([] if ending == ".obj" else ["emissive"])
    baked = octex.bake(octex.convert(surface, 4), surface, texture_size=64, channels=channels)
    path = tmp_path / f"whole{ending}"
    octex.write_model(baked, path)
    read = octex.load_surface(path)
    assert [form.name for form in read.channels] == [form.name for form in baked.channels]
    np.testing.assert_allclose(
        read.vertices[read.triangles], baked.vertices[baked.triangles], rtol=1e-6, atol=1e-7
    )
    points = baked.scatter(2000)
    for form in baked.channels:
        np.testing.assert_allclose(
            read.evaluate(points, form.name), baked.evaluate(points, form.name), atol=2e-3
        )


@pytest.mark.parametrize("images", ["png", "exr"])
def test_maps_of_more_bits_are_written_whole(images, tmp_path):
    reader = pytest.importorskip("OpenImageIO", reason="the extra octex[images] is not installed")
    surface = whole().with_sources({"alpha": lambda points: 0.2 + 0.6 * waves(points)[:, :1]})
    names = ["base_color", "alpha", "roughness", "normal"]
    bits = 16 if images == "png" else 32
    baked = octex.bake(octex.convert(surface, 4), surface, texture_size=64, channels=names, bits=bits)
    material = as_source(baked).materials[0]
    octex.write_model(baked, tmp_path / "a.obj", images=images)
    for name in names:
        given = material.inputs[name]
        assert given.texture is not None
        expected = given.texture.texels[..., list(given.lanes)]
        assert expected.dtype == (np.uint16 if images == "png" else np.float32)
        file = reader.ImageInput.open(str(tmp_path / f"a-0-{name}.{images}"))
        found = file.read_image("uint16" if images == "png" else "float")
        file.close()
        np.testing.assert_array_equal(found.reshape(expected.shape), expected)
    read, points = octex.load_surface(tmp_path / "a.obj"), baked.scatter(2000)
    for name in names:  # between texels colours weigh by alpha where that is in the same image
        np.testing.assert_allclose(read.evaluate(points, name), baked.evaluate(points, name), atol=2e-2)
    fewer = octex.bake(octex.convert(surface, 4), surface, texture_size=64, channels=names)
    assert psnr(baked.evaluate(points), fewer.evaluate(points)) > 50.0
    with pytest.raises(ModelError, match="exr"):
        octex.write_model(fewer if images == "exr" else baked, tmp_path / "b.glb", images="exr")


def test_maps_of_floats_hold_light_above_1(tmp_path):
    surface = whole().with_sources({"emissive": lambda points: 4.0 + waves(points)})
    baked = octex.bake(octex.convert(surface, 4), surface, texture_size=64, channels=["emissive"], bits=32)
    given = as_source(baked).materials[0].inputs["emissive"]
    assert given.texture is not None
    assert given.factor == (1.0, 1.0, 1.0)
    assert given.texture.texels[..., :3].max() > 4.5
    with pytest.raises(ModelError, match="only exr holds"):
        octex.write_model(baked, tmp_path / "a.glb")


def test_texels_are_the_means_of_so_many_lookups(monkeypatch):
    def as_it_is(values, _areas, _part, first, fitted):
        fitted[:] = values[first : first + len(fitted)]

    monkeypatch.setattr("octex.baking.maps.fit_rows", as_it_is)
    surface = cube_with_charts().with_sources({"base_color": waves})
    texture = octex.convert(surface, 6)
    maps = []
    for size, times in ((96, 3), (288, 1)):
        baked = octex.bake(texture, surface, texture_size=size, supersample=times, bits=32)
        given = as_source(baked).materials[0].inputs["base_color"].texture
        assert given is not None
        maps.append(given.texels[..., :3])
    means = maps[1].reshape(96, 3, 96, 3, 3).mean(axis=(1, 3))
    layout = kept_layout(surface, 96)
    drawn = draw_texels(layout.corners, layout.charts, layout.edges, 96, 0, 96)
    inside = drawn.areas > 0.999
    assert inside.sum() > 2000
    np.testing.assert_allclose(maps[0][inside], means[inside], atol=1e-5)


def test_images_of_udim_tiles_are_named_by_them(tmp_path):
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    points = np.concatenate([square, square + np.array([1.5, 0.0, 0.0])])
    triangles = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    flat = 0.1 + 0.8 * square[:, :2]
    surface = Surface.from_arrays(points, triangles, uv=np.concatenate([flat, flat + np.array([1.0, 0.0])]))
    texture = painted(surface)
    baked = octex.bake(texture, surface, uv="keep", texture_size=64)
    seen = baked.scatter(2000)
    for ending in (".obj", ".gltf"):
        path = tmp_path / f"a{ending}"
        octex.write_model(baked, path)
        names = [f"a-base_color.{tile}.png" for tile in (1001, 1002)]
        assert all((tmp_path / name).exists() for name in names)
        assert psnr(octex.load_surface(path).evaluate(seen), baked.evaluate(seen)) > 60.0


def test_gltf_files_beside_are_named_by_valid_uris(tmp_path):
    surface = whole()
    baked = octex.bake(octex.convert(surface, 3), surface, texture_size=64, channels=["base_color"])
    path = tmp_path / f"a %41#?{'é' * 60}.gltf"  # as a URI longer than a file's name may be
    octex.write_model(baked, path)
    written = json.loads(path.read_text())
    for entry, ending in ((written["buffers"][0], ".bin"), (written["images"][0], "-0.png")):
        assert re.fullmatch(r"(?:[\w.~-]|%[0-9A-F]{2})+", entry["uri"], re.ASCII)
        assert urllib.parse.unquote(entry["uri"]) == path.stem + ending
    points = baked.scatter(500)
    assert psnr(octex.load_surface(path).evaluate(points), baked.evaluate(points)) > 100.0


def test_obj_files_keep_the_names_of_materials(tmp_path):
    names = ["wood", "worn steel", "worn_steel", "", "material3", "a\n\0\ud800b"]
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    points = np.concatenate([square + np.array([n, 0, 0]) for n in range(len(names))])
    triangles = np.arange(len(points), dtype=np.int32).reshape(-1, 3)
    colors = [(n / 8, 0.5, 0.5) for n in range(len(names))]
    materials = [
        Material({"base_color": Input(color)}, name=name) for color, name in zip(colors, names, strict=True)
    ]
    source = MaterialSource(materials, np.arange(len(names), dtype=np.int32), points, triangles)
    octex.write_model(Surface(points, triangles, source), tmp_path / "a.obj")
    read = as_source(octex.load_surface(tmp_path / "a.obj"))
    found = [read.materials[number] for number in read.triangle_materials]
    known = ["wood", "worn_steel", "worn_steel_", "material3", "material3_", "a___b"]
    assert [each.name for each in found] == known
    np.testing.assert_allclose([each.inputs["base_color"].factor for each in found], colors, atol=1e-6)


def test_materials_that_read_one_image_have_one_file(tmp_path):
    surface = whole()
    baked = octex.bake(octex.convert(surface, 3), surface, texture_size=64, channels=["base_color"])
    source = as_source(baked)
    owners = (np.arange(len(surface.triangles)) > 1).astype(np.int32)
    twice = MaterialSource(
        source.materials * 2, owners, surface.rest, surface.triangles, coordinates=source.coordinates
    )
    shared = Surface(surface.vertices, surface.triangles, twice, rest=surface.rest, uv=baked.uv)
    octex.write_model(shared, tmp_path / "a.obj")
    assert len(list(tmp_path.glob("*.png"))) == 1
    points = shared.scatter(500)
    assert psnr(octex.load_surface(tmp_path / "a.obj").evaluate(points), shared.evaluate(points)) > 60.0


def test_what_cannot_be_written_is_said(tmp_path):
    surface = whole()
    with pytest.raises(ModelError, match="bake it first"):
        octex.write_model(surface, tmp_path / "a.glb")
    with pytest.raises(ArgumentError, match=r"a.fbx must end in .glb, .gltf, .*, .ply or .3mf"):
        octex.write_model(surface, tmp_path / "a.fbx")


def test_vertex_colours_follow_the_field_and_neighbours_divide_alike():
    texture, surface = painted_sphere()
    coarse = octex.bake_vertices(texture, surface)
    assert len(coarse.triangles) == len(surface.triangles)
    fine = octex.bake_vertices(texture, surface, subdivide="auto", max_error=2.0)
    near = texture.sample(fine.vertices, "base_color", normals=fine.vertices)
    np.testing.assert_allclose(fine.source.colors.values[:, :3], near, atol=0.02)
    for seed, made, least in ((3, coarse, 20.0), (4, fine, 43.0)):
        some = made.scatter(20_000, seed=seed)
        assert psnr(made.evaluate(some), texture.sample(some, "base_color")) > least
    # Each edge has two triangles, as before, and the sphere is where it was.
    ends = np.stack([fine.triangles, np.roll(fine.triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    _, counts = np.unique(np.sort(ends, axis=1), axis=0, return_counts=True)
    assert (counts == 2).all()
    assert fine.areas().sum() == pytest.approx(surface.areas().sum(), rel=1e-9)


@pytest.mark.parametrize("subdivide", ["auto", 0.07])
def test_where_vertices_are_apart_at_one_place_edges_are_divided_alike(subdivide):
    surface = cube_with_charts()  # no two of its triangles share a vertex
    flat = corner_frames(surface.rest, surface.triangles, None, None, None)
    surface = Surface(surface.vertices, surface.triangles, surface.source, frames=flat)
    texture = octex.convert(surface.with_sources({"base_color": waves}), 5)
    made = octex.bake_vertices(texture, surface, subdivide=subdivide, max_error=2.0)
    _, places = np.unique(made.vertices, axis=0, return_inverse=True)
    triangles = places[made.triangles]
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    _, counts = np.unique(np.sort(ends, axis=1), axis=0, return_counts=True)
    assert len(triangles) > 100
    assert (counts == 2).all()
    # And the cube's edges stay sharp.
    sides = made.vertices[made.triangles]
    crosses = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    crosses /= np.linalg.norm(crosses, axis=1, keepdims=True)
    assert made.frames is not None
    found = made.frames.normals.values[made.frames.normals.rows]
    np.testing.assert_allclose(found, np.broadcast_to(crosses[:, None], found.shape), atol=1e-6)


@pytest.mark.parametrize("ending", [".ply", ".glb", ".obj"])
def test_divided_triangles_are_shaded_as_the_whole_was(ending, tmp_path):
    points, triangles = solids.sphere([0.0, 0.0, 0.0], 1.0, 8)
    normals = Corners((points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32), triangles)
    frames = corner_frames(points, triangles, normals, None, None)
    turned = points @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    source = Surface.from_arrays(points, triangles).source
    surface = Surface(turned, triangles, source, rest=points, frames=frames)
    made = octex.bake_vertices(octex.convert(surface, 3), surface, subdivide=0.2)
    assert len(made.triangles) > 4 * len(triangles)
    octex.write_model(made, tmp_path / f"ball{ending}")
    if ending == ".ply":
        mesh = trimesh.load(tmp_path / "ball.ply", process=False)
        assert "vertex_normals" in mesh._cache  # those of the file
        found, places = mesh.vertex_normals[mesh.faces], mesh.vertices[mesh.faces]
    else:
        read = octex.load_surface(tmp_path / f"ball{ending}", normals=True)
        assert read.frames is not None
        found, places = read.frames.normals.values[read.frames.normals.rows], read.vertices[read.triangles]
    # On a sphere what lies between the corners' normals points as positions do.
    expected = places / np.linalg.norm(places, axis=2, keepdims=True)
    assert np.einsum("tcx,tcx->tc", found, expected).min() > np.cos(np.radians(2.0))


def test_edges_are_halved_until_none_is_longer():
    surface = whole()
    texture = octex.convert(surface, 6)
    made = octex.bake_vertices(texture, surface, subdivide=0.1)
    sides = made.vertices[np.roll(made.triangles, -1, axis=1)] - made.vertices[made.triangles]
    assert np.linalg.norm(sides, axis=2).max() <= 0.1
    assert made.areas().sum() == pytest.approx(surface.areas().sum(), rel=1e-9)
    for most in (20, 200):
        few = octex.bake_vertices(texture, surface, subdivide=0.1, most_triangles=most)
        assert most / 6 < len(few.triangles) <= most


@pytest.mark.parametrize("ending", [".ply", ".glb", ".obj"])
def test_vertex_colours_are_written_and_read_back(ending, tmp_path):
    texture, surface = painted_sphere()
    made = octex.bake_vertices(texture, surface)
    octex.write_model(made, tmp_path / f"ball{ending}")
    read = octex.load_surface(tmp_path / f"ball{ending}")
    assert read.triangles.shape == made.triangles.shape
    points = made.scatter(2000)
    np.testing.assert_allclose(read.evaluate(points), made.evaluate(points), atol=0.01)
    if ending == ".ply":
        cloud = trimesh.load(tmp_path / "ball.ply", process=False)
        np.testing.assert_array_equal(cloud.faces, made.triangles)
        codes = encode(made.source.colors.values[:, :3], "uint8", "srgb")
        np.testing.assert_array_equal(cloud.visual.vertex_colors[:, :3], codes)


def test_the_command_bakes(tmp_path, cli):
    surface = cube_with_charts().with_sources({"base_color": waves})
    octex.convert(surface, 4).save(tmp_path / "cube.octex")
    model = octex.bake(octex.open(tmp_path / "cube.octex"), surface, texture_size=64)
    octex.write_model(model, tmp_path / "cube.obj")
    given = ["bake", tmp_path / "cube.octex", tmp_path / "cube.obj"]

    def made(output, *words):
        told = json.loads(cli.result(*given, tmp_path / output, *words, "--json", "--quiet"))
        assert told["output"] == str(tmp_path / output)
        return told

    told = made("baked.glb", "--texture-size", 64)
    size = (tmp_path / "baked.glb").stat().st_size
    assert (told["texture_size"], told["channels"], told["bytes"]) == (64, ["base_color"], size)
    simple = "--original", given[2], "--max-distance", 0.1, "--texture-size", 64
    assert made("simple.glb", *simple)["texture_size"] == 64
    assert made("b.obj", "--vertex-colors", "--vertex-error", 4)["vertices"] > 8
    assert made("b.ply", "--max-edge", "auto")["vertices"] > 8
    made("d.obj")
    assert (tmp_path / "d-0-base_color.png").exists()
    for output, words, message in (
        ("c.glb", "-q", "-q is not an option"),
        ("c.glb", "--texture-size 1", "--texture-size must be a whole number from"),
        ("c.obj", "--vertex-error 4", "--vertex-error is for vertex colours; add --vertex-colors"),
        ("c.obj", "--vertex-colors --max-edge 0.5 --vertex-error 4", "--vertex-error needs --max-edge auto"),
        ("c.ply", "--uv keep", "--uv cannot be used with vertex colours"),
        ("baked.glb", "", "exists"),
    ):
        assert message in cli.refusal(*given, tmp_path / output, *words.split(), "--quiet")


@pytest.mark.parametrize("bake", [octex.bake, octex.bake_vertices])
def test_the_texture_of_another_model_is_refused(bake):
    surface = whole()
    texture = octex.convert(surface, 3)
    other = Surface.from_arrays(surface.vertices + 10.0, surface.triangles)
    with pytest.raises(ArgumentError, match="has no point in the texture; is it of another model"):
        bake(texture, other)
    if bake is octex.bake:
        with pytest.raises(ArgumentError, match="has no point in the texture"):
            bake(texture, surface, source=other)
    shifted = Surface.from_arrays(surface.vertices + np.array([0.7, 0, 0]), surface.triangles, name="b")
    with pytest.warns(ModelWarning, match=r"\d+% of b lies outside of the texture; is it of another model"):
        bake(texture, shifted)


def test_triangles_that_have_an_area_by_rounding_alone_are_baked():
    surface = ball(16)  # at its poles
    baked = octex.bake(octex.convert(surface, 4), surface, texture_size=64)
    points = surface.scatter(2000)
    assert np.abs(baked.evaluate(points) - surface.evaluate(points)).mean() < 0.02
