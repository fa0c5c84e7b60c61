"""Paint lies once on each leaf, whatever tree and paint are; averages above are those of what is there."""

from pathlib import Path

import numpy as np
import pytest

import octex
from octex.channels import decode
from octex.cli.common import run
from octex.errors import DefectError, ExitCode
from octex.painting import steps
from octex.source.surface import Surface
from octex.tree.octree import Octree
from octex.tree.split import find_rows
from tests.conftest import needs_jit
from tests.make.painted import above, ball, one_color, plain, square, together
from tests.make.small_surfaces import sheet
from tests.oracles.naive_edits import assert_averages
from tests.properties.edit_claims import assert_one_color
from tests.properties.edit_models import beyond, cloud, picture, waved

pytestmark = needs_jit

DROID = Path(octex.__file__).parents[1] / "samples" / "droid.glb"


def color_of(texture, cell, name="base_color"):
    channel = texture.channels[name]
    return decode(channel.values[cell], channel.format.space)


def halves(left, right):
    """Two squares beside each other, farther apart than two cells of depth 5, of a colour and alpha each."""
    one, other = square(steps=8, side=0.5), square(steps=8, side=0.5)
    points, triangles = together(one, other)
    points[: len(one[0]), 0] -= 0.3
    points[len(one[0]) :, 0] += 0.3
    colors = np.repeat(np.array([left, right], np.float64), len(one[0]), axis=0)
    return Surface.from_arrays(points, triangles, colors=colors)


def on_the_left(surface):
    return np.asarray(surface.rest[surface.triangles].mean(axis=1)[:, 0] < 0)


# --- sound


def test_pictures_of_pixels_of_many_sizes_are_painted_onto_a_coarser_texture():
    surface = octex.load_surface(DROID)
    texture = octex.convert(surface, depth=4)
    for direction in ((0.4, 0.3, 1), (-1, 0.2, 0.1)):
        camera = octex.Camera.fitted(surface.vertices, direction=direction, size=(64, 64))
        image = np.full((64, 64, 3), 200, np.uint8)
        octex.paint(texture, surface, octex.Projection(image, camera)).validate()


def test_what_was_painted_finer_is_painted_again():
    surface = octex.load_surface(DROID)
    center = tuple(surface.vertices.mean(axis=0))
    texture = octex.convert(surface, depth=5)
    first = octex.fill(texture, surface, octex.Sphere(center, 0.3), (1, 0, 0), max_depth=7)
    first.validate()
    octex.fill(first, surface, octex.Sphere(center, 0.3), (0, 1, 0)).validate()


@pytest.mark.parametrize("seed", range(12))
def test_any_paint_makes_a_sound_texture_whose_averages_are_those_of_its_leaves(seed):
    random = np.random.default_rng(seed)
    mesh = ball(8) if seed % 2 else sheet(np.eye(3), 0.01)
    colors = random.random((len(mesh.vertices), 4))
    surface = Surface.from_arrays(mesh.vertices, mesh.triangles, colors=colors)
    surface = surface.with_sources({"roughness": 0.5}) if seed % 3 else surface
    texture = octex.convert(surface, 3, max_error=None if seed % 4 else 8.0, fit=seed % 5 > 0)
    for _ in range(2):
        camera = octex.Camera.fitted(surface.vertices, random.normal(size=3), size=(24, 20))
        image = random.integers(0, 256, (20, 24, 4)).astype(np.uint8)
        depth = int(random.integers(3, 6))
        layer = octex.project(surface, octex.Projection(image, camera), like=texture, max_depth=depth)
        blend = random.choice(["over", "over", "erase", "multiply", "replace"])
        before = texture
        texture = octex.merge(before, layer, surface, blend=blend, opacity=random.choice([1.0, 0.6]))
        texture.validate()
        assert_averages(before, texture, [layer])


def test_a_layer_of_another_surface_is_merged_where_it_is():
    surface, other = plain(square()), plain(square(height=0.04))
    texture = octex.convert(surface, 3)
    camera = above(3.0, 64, 192.0)
    shot = octex.Projection(one_color(camera, (1, 0, 0)), camera)
    layer = octex.project(other, shot, like=texture, max_depth=5)
    octex.merge(texture, layer, surface).validate()


@pytest.mark.parametrize("blend", ["over", "replace", "erase"])
def test_a_texture_without_cells_takes_paint_on_the_root_alone(blend):
    surface = plain(square())
    found = octex.fill(None, surface, np.arange(9), (1, 0, 0), max_depth=0, blend=blend)
    found.validate()
    assert (found.tree.n_cells, found.tree.n_leaves) == (1, blend != "erase")
    if found.tree.n_leaves:
        fresh = octex.convert(surface.with_sources({"base_color": (1.0, 0.0, 0.0)}), 0)
        np.testing.assert_array_equal(color_of(found, 0), [1, 0, 0])
        np.testing.assert_array_equal(found.tree.arrays.flags, fresh.tree.arrays.flags)
        np.testing.assert_array_equal(found.tree.arrays.areas, fresh.tree.arrays.areas)


def test_what_octex_itself_gets_wrong_is_not_blamed_on_who_uses_it(monkeypatch, capsys):
    def broken(*_):
        return Octree.from_levels([np.zeros(1, np.int64), np.zeros(1, np.int64)])

    monkeypatch.setattr(steps, "raised", broken)
    surface = plain(square())
    texture = octex.convert(surface, depth=4)

    def body():
        octex.fill(texture, surface, np.arange(9), (1, 0, 0), max_depth=5)
        return 0

    with pytest.raises(DefectError, match="overlap others"):
        body()
    assert run("octree-paint", body) == ExitCode.CRASHED
    assert "a defect of octex: DefectError" in capsys.readouterr().err


# --- averages


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_the_averages_of_what_is_painted_are_those_of_a_conversion(dtype):
    surface = halves((1, 0, 0, 1), (0, 0, 0, 0))
    texture = octex.convert(surface, 5, dtype=dtype)
    found = octex.fill(texture, surface, on_the_left(surface), (0, 0, 1))
    fresh = octex.convert(halves((0, 0, 1, 1), (0, 0, 0, 0)), 5, dtype=dtype)
    np.testing.assert_allclose(color_of(fresh, 0), [0, 0, 1], atol=1e-3)
    for name, channel in found.channels.items():
        np.testing.assert_array_equal(found.tree.arrays.groups, fresh.tree.arrays.groups)
        away = np.abs(channel.values.astype(float) - fresh.channels[name].values)
        shown = fresh.channels["alpha"].values[:, 0] > 0
        assert away[shown].max() <= (1 if dtype == "uint8" else 1e-3)


def test_opaque_paint_beside_what_shows_makes_no_negative_light():
    surface = halves((1, 0, 0, 1), (0, 1, 0, 0))
    texture = octex.convert(surface, 5, dtype="float32")
    found = octex.fill(texture, surface, ~on_the_left(surface), (0, 0, 1))
    np.testing.assert_allclose(color_of(found, 0), [0.5, 0, 0.5], atol=0.02)
    assert found.channels["base_color"].values.min() >= 0
    assert_averages(texture, found)


def test_what_is_erased_is_in_no_average_of_any_channel():
    surface = halves((1, 0, 0, 1), (0, 1, 0, 1)).with_sources({"roughness": lambda p: (p[:, 0] > 0) * 0.8})
    texture = octex.convert(surface, 5)
    found = octex.fill(texture, surface, ~on_the_left(surface), (0, 0, 0), blend="erase")
    assert_averages(texture, found)
    np.testing.assert_allclose(color_of(found, 0), [1, 0, 0], atol=0.01)
    np.testing.assert_allclose(color_of(found, 0, "roughness"), [0], atol=0.01)
    wide = found.sample(np.array([[-0.1, 0.1, 0.0], [-0.2, 0.0, 0.0]]), width=0.5)
    np.testing.assert_allclose(wide, np.tile([1.0, 0, 0], (2, 1)), atol=0.02)


def test_where_all_is_erased_averages_stay_those_of_what_is_hidden():
    surface = halves((1, 0, 0, 1), (0, 1, 0, 1))
    texture = octex.convert(surface, 5)
    everywhere = np.ones(len(surface.triangles), bool)
    found = octex.fill(texture, surface, everywhere, (0, 0, 0), blend="erase")
    assert color_of(found, 0, "alpha") == 0
    np.testing.assert_allclose(color_of(found, 0), color_of(texture, 0), atol=0.01)


def test_each_side_is_averaged_with_the_alpha_that_it_has():
    surface = sheet(np.eye(3), 0.004)
    texture = octex.convert(surface, 5)
    size = float(np.ptp(surface.bounds, axis=0).max())
    camera = above(3.0, 96, 96 * 3 / size * 0.9)
    erased = octex.Projection(one_color(camera, (0, 0, 1)), camera, blend="erase")
    found = octex.paint(texture, surface, erased, max_depth=5)
    assert_averages(texture, found)
    there, rows = find_rows(found.tree.split, np.zeros(2, np.int64), np.array([16, 32], np.uint8))  # +z, −z
    assert there.all()
    front, back = found.channels["alpha"].split_values[rows, 0]
    assert front < 80  # the camera sees most of it
    assert back == 255


def test_nodes_are_split_where_paint_makes_their_sides_differ():
    mesh = sheet(np.eye(3), 0.02)
    surface = plain((mesh.vertices, mesh.triangles), (0.5, 0.5, 0.5))
    texture = octex.convert(surface, 6)
    assert not texture.tree.split.cells.size
    corners = mesh.rest[mesh.triangles]
    front = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0
    found = octex.fill(texture, surface, front, (1, 0, 0))
    found.validate()
    there, rows = find_rows(found.tree.split, np.zeros(2, np.int64), np.array([16, 32], np.uint8))
    assert there.all()
    channel = found.channels["base_color"]
    front_row, back_row = decode(channel.split_values[rows], channel.format.space)
    np.testing.assert_allclose(front_row, [1, 0, 0], atol=0.03)
    np.testing.assert_allclose(back_row, [0.5, 0.5, 0.5], atol=0.03)


def test_tones_of_alpha_and_colours_at_once_average_by_the_new_alpha():
    surface = halves((1, 0, 0, 0.8), (0, 1, 0, 0.2))
    texture = octex.convert(surface, 4, fit=False)
    found = octex.levels(texture, ["base_color", "alpha"], black=0.3)
    assert_averages(texture, found)
    np.testing.assert_allclose(color_of(found, 0), [1, 0, 0], atol=0.01)


def test_rows_carried_below_leaves_stay_in_their_range():
    surface = waved("open", 1, ["base_color", "roughness"], 75)
    half = octex.Transfer(surface.part(range(len(surface.triangles) // 2)), distance=0.264)
    texture = octex.convert(surface, 2, fit=False, sources={"base_color": half})
    texture = octex.cast(texture, dtype="float16")
    found = octex.fill(texture, surface, beyond(1, 0.9, 0.14), (1.0, 0.7, 0.7), blend="add", max_depth=3)
    for name, most in (("alpha", 1), ("roughness", 1), ("base_color", 2)):
        rows = found.channels[name].split_values
        assert rows.size
        assert 0 <= rows.min() <= rows.max() <= most


@pytest.mark.parametrize("seed", [0, 1])  # noise, and patches
def test_pictures_on_floats_stay_in_the_range_of_their_pixels(seed):
    surface = plain(square())
    texture = octex.convert(surface, 4, dtype="float32", fit=False)
    image = picture(seed, 32, 32, translucent=True)
    found = octex.paint(texture, surface, octex.Projection(image, above(size=32)), max_depth=6)
    assert found.tree.n_leaves > texture.tree.n_leaves
    for values in found.channels["base_color"][1:]:
        assert 0 <= values.min(initial=0) <= values.max(initial=0) <= 1


# --- kept coefficients


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


# --- other channels


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


# --- rows of split nodes


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


# --- nothing but paint where all is painted


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
