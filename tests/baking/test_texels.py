"""Texels against counting, gutters against unfolding by hand, charts in their places."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octex.baking import atlas
from octex.baking.coordinates import stretches_of
from octex.baking.gutters import Borders, fill_up, gutter_of
from octex.baking.layout import kept_layout, neighbours_of_mesh, unit_area
from octex.baking.maps import MapValues, fit_rows, inputs_of, lacking
from octex.baking.texels import draw_texels, texel_points
from octex.errors import ModelError
from octex.source.corners import Corners
from octex.source.images.pyramid import CLAMP
from octex.source.mesh import Mesh
from octex.source.surface import Surface
from tests.baking.test_bake import cube_with_charts, scattered_triangles
from tests.make import solids

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
    np.testing.assert_array_equal(shown.triangle_of_each(), drawn.triangles[rows, columns])
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
    others, sides = neighbours_of_mesh(surface)
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
    gutter = gutter_of(borders, layout, surface.rest, surface.triangles, *neighbours_of_mesh(surface))
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


def test_an_atlas_without_room_says_so():
    with pytest.raises(ModelError, match=r"100 charts do not fit in a map of 64 × 64 texels; make it larger"):
        atlas.atlas_layout(scattered_triangles(100), [64], 8, 1.0)


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
            atlas._occupy(free[rows], longest[rows], mask, column)
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


@pytest.mark.parametrize(("most", "factor"), [(1.0 + 2.0**-23, 1.0), (3.0, 3.0)])
def test_images_are_scaled_only_for_light_that_exceeds_1_by_more_than_rounding(most, factor):
    maps = MapValues.of(["base_color"], 4, 4)
    maps.values[:, :2], maps.areas[:] = most, 1.0
    with ThreadPoolExecutor() as pool:
        read = inputs_of(maps, 8, 1.0, CLAMP, pool)["base_color"]
    assert read.factor == (factor,) * 3
    assert read.texture.texels[..., :3].max() == 65535
