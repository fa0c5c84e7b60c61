"""Paint over finer paint, over kept coefficients and beside both."""

import numpy as np
import pytest

import octex
from octex.channels import decode
from octex.source.surface import Surface
from tests.conftest import needs_jit
from tests.make.painted import ball, plain, square
from tests.make.small_surfaces import sheet
from tests.oracles.naive_edits import assert_averages
from tests.painting.test_paint_sound import DROID
from tests.properties.edit_claims import assert_one_color, kept_edge
from tests.properties.edit_models import beyond, cloud, waved

pytestmark = needs_jit


def within(surface, texture, center, low, high):
    """Points of a surface that a texture is on, so far from a centre."""
    points = surface.scatter(4000, 1).rest
    away = np.linalg.norm(points - center, axis=1)
    points = points[(away > low) & (away < high)]
    return np.asarray(points[texture.contains(points)])


@pytest.mark.parametrize(("kind", "depth"), [("grown", 5), ("divided", 3)])
def test_what_is_erased_over_kept_coefficients_leaves_nothing(kind, depth):
    if kind == "grown":
        surface = waved("open", 6, ["base_color"], 99)
        texture = octex.fill(None, surface, octex.Sphere(surface.rest[0], 0.387), (0, 0.2, 0.2), max_depth=3)
    else:
        surface = waved("triangle", 7, ["base_color", "roughness"], 3)
        texture = octex.resize(octex.convert(surface, 3), 4)
    everywhere = np.ones(len(surface.triangles), bool)
    found = octex.fill(texture, surface, everywhere, (0, 0, 1), blend="erase", max_depth=depth)
    found.validate()
    points = within(surface, texture, np.zeros(3), 0, 9)
    assert len(points) > 30
    np.testing.assert_array_equal(found.sample(points, "alpha"), 0)


def test_deep_in_fine_paint_there_is_nothing_but_paint_and_beyond_it_nothing_moves():
    surface = waved("flat", 11, ["base_color"], 19)
    texture = octex.convert(surface, 5, dtype="uint16", fit=False)
    center, radius, edge = np.array([-0.165, 0.283, 0]), 0.4, texture.placement.size / 32
    found = octex.fill(texture, surface, octex.Sphere(tuple(center), radius), (0, 0.2, 1), max_depth=6)
    points = within(surface, texture, center, 0, radius - 4.3 * edge)
    assert len(points) > 100
    np.testing.assert_allclose(found.sample(points), np.tile([0, 0.2, 1], (len(points), 1)), atol=1e-4)
    points = within(surface, texture, center, radius + 2 * edge, 9)
    assert len(points) > 100
    np.testing.assert_allclose(found.sample(points), texture.sample(points), atol=1e-4)


def test_beside_finer_paint_what_is_seen_with_normals_moves_no_more_than_is_said():
    surface = waved("sheet", 4, ["base_color"], 7)
    texture = octex.convert(surface, 4, dtype="float32")
    edge = texture.placement.size / 16
    points, normals = surface.scatter(4000, 3)[1:3]
    center, radius = points[0], 2.2 * edge
    region = octex.Sphere(tuple(center.tolist()), radius)
    found = octex.fill(texture, surface, region, (1, 0, 0), max_depth=6)
    before, after = (each.sample(points, normals=normals) for each in (texture, found))
    moved = np.abs(before - after).max(axis=1)
    cells = (np.linalg.norm(points - center, axis=1) - radius) / edge - 0.25  # a fine cell around is paint
    for low, high, most in ((0.5, 1, 0.13), (1, 1.5, 0.07), (1.5, 2, 0.006), (2, 99, 1e-4)):
        here = (cells > low) & (cells <= high)
        assert here.any()
        assert moved[here].max() <= most


@pytest.mark.parametrize(("kind", "blend", "opacity"), [("flat", "add", 1.0), ("cube", "over", 0.5)])
def test_deep_in_fine_paint_the_old_field_shows_through_as_far_as_paint_leaves_it(kind, blend, opacity):
    surface = waved(kind, 12, ["base_color"], 95)
    (low, *_), (high, *_) = surface.bounds
    cut, color = 0.4 * low + 0.6 * high, (1, 0.5, 1)
    texture = octex.convert(
        surface, 4, dtype="float32", fit=False, detail=lambda points: np.where(points[:, 0] > cut, 1, 5)
    )
    region = octex.Box((-9, -9, -9), (cut, 9, 9))  # beside the larger leaves
    found = octex.fill(texture, surface, region, color, blend=blend, opacity=opacity, max_depth=6)
    points = surface.scatter(4000, 1).rest
    reach = 3 * kept_edge(found) + texture.placement.size / 64
    points = points[texture.contains(points) & (points[:, 0] < cut - reach)]
    assert len(points) > 1000
    was = texture.sample(points)
    expected = (was if blend == "add" else (1 - opacity) * was) + opacity * np.array(color)
    # Sums of 27 taps of each of the levels 3 to 6, of values up to 2: of two lookups, and of refined values.
    np.testing.assert_allclose(found.sample(points), expected, atol=3 * 27 * 4 * 2 * 2.0**-24)


def test_half_a_coat_of_fine_paint_is_half_a_coat_on_kept_coefficients_too():
    surface = waved("triangle", 7, ["base_color"], 3)
    texture = octex.resize(octex.convert(surface, 3, dtype="float32"), 4)
    everywhere = np.ones(len(surface.triangles), bool)
    found = octex.fill(texture, surface, everywhere, (0, 0, 1), opacity=0.5, max_depth=3)
    points = within(surface, texture, np.zeros(3), 0, 9)
    expected = 0.5 * texture.sample(points) + [0, 0, 0.5]
    np.testing.assert_allclose(found.sample(points), expected, atol=2e-5)
    assert found.tree.kept.cells.size


@pytest.mark.parametrize(("radius", "depth"), [(0.3, 4), (0.8, 5)])
def test_half_erased_over_finer_paint_is_half_everywhere(radius, depth):
    surface = waved("overlapping", 14, ["base_color"], 26)
    texture = octex.convert(surface, 3, dtype="float16", fit=False)
    place = octex.Sphere(tuple(surface.rest[0]), radius)
    texture = octex.fill(texture, surface, place, (1, 0, 0), max_depth=depth)
    everything = np.ones(len(surface.triangles), np.bool_)
    texture = octex.fill(
        texture, surface, everything, (0, 0, 0), opacity=0.5, blend="erase", max_depth=depth + 1
    )
    found = texture.sample(surface.scatter(3000).rest, "alpha")
    np.testing.assert_allclose(found, np.full((3000, 1), 0.5), atol=0.003)


def test_a_coat_is_on_kept_coefficients_also_where_a_texture_faces_other_ways_than_the_surface():
    surface = ball(16)
    colors = 0.5 + 0.4 * surface.vertices
    inside_out = Surface.from_arrays(surface.vertices, surface.triangles[:, ::-1], colors=colors)
    texture = octex.convert(inside_out, 4)
    texture = octex.fill(texture, inside_out, octex.Sphere((0, 0, 1), 0.7), (1, 0, 0), max_depth=5)
    assert texture.tree.kept.cells.size
    everywhere = np.ones(len(surface.triangles), bool)
    found = octex.fill(texture, surface, everywhere, (0, 0, 0), opacity=0.2, blend="erase", max_depth=4)
    np.testing.assert_allclose(found.sample(surface.scatter(2000).rest, "alpha"), 0.8, atol=1e-6)


def test_a_second_coat_over_part_of_finer_paint_adds_no_cells():
    for surface in (plain(square(steps=8), (0.2, 0.5, 0.7)), ball(16)):
        texture = octex.convert(surface, 3)
        radius = 0.3 * texture.placement.size
        first, second = (octex.Sphere(tuple(surface.rest[0] + [x, 0, 0]), radius) for x in (0, radius))
        found = octex.fill(texture, surface, first, (1, 0, 0), max_depth=5)
        once = octex.fill(found, surface, second, (0, 1, 0), max_depth=5)
        twice = octex.fill(once, surface, second, (0, 1, 0), max_depth=5)
        assert found.tree.n_leaves < once.tree.n_leaves == twice.tree.n_leaves


def test_nodes_beside_the_surface_are_means_in_all_channels_when_skirts_are_added_below():
    surface = waved("open", 9, ["base_color", "normal"], 34)
    texture = octex.convert(surface, 2, dtype="float16", fit=False)
    blue, up, place = (
        (0.2, 0.0, 0.7),
        (0.0, 0.0, 1.0),
        octex.Sphere((-0.624, 0.262, 1.046), 0.654, soft=0.164),
    )
    texture = octex.fill(texture, surface, [0, 7], blue, opacity=0.5, blend="replace", max_depth=4)
    found = octex.fill(texture, surface, place, up, channel="normal", blend="multiply", max_depth=4)
    assert found.tree.n_leaves > texture.tree.n_leaves
    assert_averages(texture, found)


def test_rows_that_nothing_but_skirts_faces_are_means_of_new_ones_too():
    surface = waved("sphere", 17, ["base_color", "alpha"], 41)
    start = octex.convert(
        surface, 2, dtype="float16", fit=False, detail=lambda points: 1 + points[:, 0] * 3 % 1
    )
    cyan = (0.7, 1.0, 1.0)
    texture = octex.fill(start, surface, beyond(1, 0.193, 0.2), cyan, blend="add", max_depth=3)
    everywhere = np.ones(len(surface.triangles), bool)
    found = octex.fill(texture, surface, everywhere, (0.2, 0.2, 0), blend="replace", max_depth=3)
    assert_averages(texture, found)


def test_averages_of_hardly_any_surface_are_means_of_new_skirts_too():
    surface = waved("open", 16, ["base_color", "alpha"], 4)
    start = octex.convert(surface, 4, dtype="float32")
    texture = octex.mix(start, octex.resize(start, 3), beyond(1, 0.226, 0.2))
    pink = (1.0, 0.2, 0.2)
    found = octex.fill(texture, surface, beyond(0, -0.507, 0.171), pink, opacity=0.2, blend="screen")
    assert_averages(texture, found)


@pytest.mark.parametrize(("max_error", "deeper"), [(None, 1), (None, 2), (4, 0), (4, 1)])
@pytest.mark.parametrize("kind", ["sheet", "open", "cube"])
def test_finer_paint_moves_no_other_channel(kind, max_error, deeper):
    surface = waved(kind, 1, ["base_color", "roughness"], 7)
    texture = octex.convert(surface, 5, dtype="float32", max_error=max_error)
    points = surface.scatter(5000, 0).rest
    ball = octex.Sphere(tuple(points[0]), 0.3 * float(np.ptp(surface.bounds, axis=0).max()))
    found = octex.fill(texture, surface, ball, (1, 0, 0), max_depth=texture.tree.max_depth + deeper)
    assert found.tree.n_leaves > texture.tree.n_leaves
    before, after = (each.sample(points, "roughness") for each in (texture, found))
    np.testing.assert_allclose(after, before, atol=1e-5)


@pytest.mark.parametrize("blend", ["multiply", "screen"])
def test_rows_above_leaves_that_paint_splits_are_means_of_them_in_all_channels(blend):
    surface = waved("overlapping", 18, ["base_color", "alpha"], 92)
    texture = octex.convert(surface, 3, fit=False, dtype="float32")
    green = (0.0, 0.2, 0.0)
    found = octex.fill(texture, surface, beyond(1, 0.477, 0.09), green, blend=blend, max_depth=2)
    assert_averages(texture, found)


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_rows_of_colours_weigh_by_the_alpha_that_newly_split_leaves_have(seed):
    surface = waved("overlapping", seed, ["base_color", "alpha"], 11 * seed)
    texture = octex.convert(surface, 2)
    place = octex.Sphere(tuple(surface.rest[0]), 0.4)
    yellow = (0.7, 0.7, 0.0)
    found = octex.fill(texture, surface, place, yellow, opacity=0.5, blend="screen", max_depth=3)
    assert_averages(texture, found)


def test_rows_above_leaves_divided_beside_paint_are_means_of_what_faces_that_way_then():
    surface = waved("sheet", 4, ["base_color"], 26)
    texture = octex.convert(cloud(surface, 1), 5, dtype="float32")
    blue = (0.2, 0.7, 1.0)
    found = octex.fill(texture, surface, beyond(2, 0.41, 0.132), blue, opacity=0.2, max_depth=6)
    assert_averages(texture, found)


@pytest.mark.parametrize("depth", [3, 5, 6])
@pytest.mark.parametrize("kind", ["triangle", "sphere"])
def test_paint_over_all_leaves_nothing_of_finer_paint_below(kind, depth):
    surface = waved(kind, 11, ["base_color"], 98)
    texture = octex.convert(surface, 4)
    place = octex.Sphere(tuple(surface.rest[surface.triangles[0]].mean(axis=0)), 0.5)
    red = octex.fill(texture, surface, place, (1, 0, 0), max_depth=5)
    green = octex.fill(red, surface, octex.Sphere((0, 0, 0), 9.0), (0, 1, 0), max_depth=depth)
    points = surface.scatter(2000).rest
    np.testing.assert_allclose(green.sample(points), np.tile([0.0, 1, 0], (2000, 1)), atol=1e-6)


@pytest.mark.parametrize("blend", ["over", "replace"])
def test_paint_over_all_is_seen_with_normals_too_where_there_was_finer_paint(blend):
    surface, color = octex.load_surface(DROID), np.array([0.2, 0.7, 0.4])
    texture = octex.convert(surface, 4, channels=["base_color"])
    samples = surface.scatter(3000, 0)
    extent = np.ptp(texture.bounds, axis=0).max()
    place = octex.Sphere(tuple(samples.rest[0]), 0.2 * extent)
    texture = octex.fill(texture, surface, place, (1, 0, 0), max_depth=6)
    painted = octex.fill(texture, surface, np.ones(len(surface.triangles), np.bool_), color, blend=blend)
    painted.validate()
    for width in (None, 0.02 * extent):
        found = painted.sample(samples.rest, normals=samples.normals, width=width)
        np.testing.assert_allclose(found, np.tile(color, (len(found), 1)), atol=0.003)
    rows = decode(painted.channels["base_color"].split_values, "srgb")
    np.testing.assert_allclose(rows, np.tile(color, (len(rows), 1)), atol=0.003)


@pytest.mark.parametrize(("thickness", "depth"), [(0.004, 5), (0.004, 6), (0.03, 6), (0.04, 6)])
def test_paint_over_one_side_of_a_thin_sheet_is_seen_on_it_where_there_was_finer_paint(thickness, depth):
    surface = sheet(np.eye(3), thickness)
    place = octex.Sphere((0.0, 0.0, 0.0), 0.3)
    red = octex.fill(octex.convert(surface, 4), surface, place, (1, 0, 0), max_depth=depth)
    samples = surface.scatter(3000, 0)
    inner = np.abs(samples.rest[:, :2]).max(axis=1) < 0.35
    front, back = (inner & (sign * samples.normals[:, 2] > 0.9) for sign in (1, -1))
    chosen = np.flatnonzero(surface.rest[surface.triangles][..., 2].min(axis=1) > 0)
    painted = octex.fill(red, surface, chosen, (0, 0, 1))
    before, found = (each.sample(samples.rest, normals=samples.normals) for each in (red, painted))
    np.testing.assert_allclose(found[front], np.tile([0.0, 0, 1], (front.sum(), 1)), atol=0.003)
    assert np.abs(found - before)[back].max() < 0.13


@pytest.mark.parametrize("depth", [4, 5])
@pytest.mark.parametrize("kind", ["overlapping", "triangle"])
def test_finer_paint_over_all_changes_the_field_by_its_part_everywhere(kind, depth):
    surface = waved(kind, 17, ["base_color", "roughness"], 16)
    texture = octex.convert(surface, 3, dtype="float32")
    whole = octex.Sphere((0, 0, 0), 9.0)
    found = octex.fill(texture, surface, whole, (0, 0, 0), opacity=0.5, max_depth=depth)
    points = surface.scatter(2000).rest
    np.testing.assert_allclose(found.sample(points), 0.5 * texture.sample(points), atol=1e-5)


@pytest.mark.parametrize("max_depth", [None, 5, 3])
def test_a_transparent_picture_paints_what_its_opaque_part_alone_paints(max_depth):
    surface = ball()
    texture = octex.convert(surface, 5)
    camera = octex.Camera.fitted(surface.vertices, (0.2, 0.1, 1), size=(96, 96))
    picture = np.zeros((96, 96, 4), np.uint8)
    rows, columns = np.mgrid[:96, :96]
    picture[np.hypot(rows - 40, columns - 52) < 6] = [200, 30, 10, 255]
    left, top, side = 28, 16, 48  # all that a cell of depth 3 sees of the disc
    K = camera.K.copy()
    K[:2, 2] -= left, top
    size = side, side
    part = octex.Camera.pinhole(size, pose=camera.world_to_camera, convention="opencv", K=K)
    cropped = np.ascontiguousarray(picture[top : top + side, left : left + side])
    whole, alone = (
        octex.paint(texture, surface, octex.Projection(image, seen), max_depth=max_depth)
        for image, seen in ((picture, camera), (cropped, part))
    )
    assert np.array_equal(whole.tree.arrays.flags, alone.tree.arrays.flags)
    leaves = whole.tree.leaf_cells()
    values = [each.channels["base_color"].values[leaves].astype(int) for each in (whole, alone)]
    assert np.abs(values[0] - values[1]).max() <= 1  # the centre of the crop is rounded otherwise
    assert whole.tree.n_leaves >= texture.tree.n_leaves


@pytest.mark.parametrize("deeper", [0, 1])
def test_nothing_shows_through_paint_on_cells_that_were_divided_off_the_surface_too(deeper):
    """The squares lie in planes of cells, beside cells of a resize that they are not in."""
    surface = waved("planes", 16, ["base_color", "alpha", "roughness"], 52)
    texture = octex.resize(octex.convert(surface, 4, dtype="uint8", max_error=20), 5)
    everything = octex.Box((-2, -2, -2), (2, 2, 2))
    made = octex.fill(texture, surface, everything, (0, 0, 0), blend="erase", max_depth=5 + deeper)
    made.validate()
    found = made.sample(surface.scatter(3000).rest, "alpha")
    assert found.max() < 1e-6


@pytest.mark.parametrize("depth", [5, 6])
@pytest.mark.parametrize("kind", ["planes", "sheet"])
def test_paint_over_all_of_a_divided_texture_leaves_nothing(kind, depth):
    surface = waved(kind, 0, ["base_color", "roughness"], 0)
    texture = octex.resize(octex.convert(surface, 4, dtype="float32", max_error=20), 5)
    everywhere = np.ones(len(surface.triangles), bool)
    found = octex.fill(texture, surface, everywhere, (0.2, 0.7, 0.4), max_depth=depth)
    assert_one_color(found, surface, "base_color", (0.2, 0.7, 0.4), 0, averages=False)


@pytest.mark.parametrize("depth", [4, 5])
@pytest.mark.parametrize("kind", ["cube", "sheet"])
def test_paint_over_all_leaves_nothing_of_finer_paint_that_was_made_coarser(kind, depth):
    surface = waved(kind, 16, ["base_color"], 48)
    place = octex.Sphere(tuple(surface.rest[0]), 0.4)
    texture = octex.fill(octex.convert(surface, 5, dtype="float32"), surface, place, (1, 0, 0), max_depth=7)
    coarse = octex.resize(texture, depth)
    found = octex.fill(coarse, surface, np.ones(len(surface.triangles), bool), (0.2, 0.7, 0.4))
    assert_one_color(found, surface, "base_color", (0.2, 0.7, 0.4), 0)


@pytest.mark.parametrize("kind", ["planes", "sheet"])
def test_cells_divided_off_the_surface_are_told_also_beside_finer_paint(kind):
    surface = waved(kind, 0, ["base_color", "roughness"], 0)
    texture = octex.resize(octex.convert(cloud(surface, 11), 3, dtype="float32"), 4)
    place = octex.Sphere(tuple(surface.rest[0]), 0.3)
    finer = octex.fill(texture, surface, place, (1, 0, 0), max_depth=5)
    everywhere = np.ones(len(surface.triangles), bool)
    found = octex.fill(finer, surface, everywhere, (0.2, 0.7, 0.4), max_depth=5)
    assert_one_color(found, surface, "base_color", (0.2, 0.7, 0.4), 0, averages=False)


def test_cells_off_the_surface_take_paint_as_far_as_they_are_refined():
    surface = waved("flat", 17, ["base_color", "alpha"], 22)
    start = octex.convert(surface, 3, dtype="float32", detail=lambda points: 1 + 2 * (points[:, 0] * 3 % 1))
    blue, everything = (0.0, 0.0, 0.7), octex.Box((-2, -2, -2), (2, 2, 2))
    made = octex.fill(octex.resize(start, 4), surface, everything, blue, max_depth=6)
    found = made.sample(surface.scatter(3000).rest)
    np.testing.assert_allclose(found, np.broadcast_to(blue, found.shape), atol=1e-5)
