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
from tests.properties.edit_models import beyond, random_image, waved

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


@pytest.mark.parametrize("seed", range(6))
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


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
@pytest.mark.parametrize(
    ("alpha", "painted", "blend", "root"),
    [
        (0, "right", "over", [0.5, 0, 0.5, 1, 0.4]),
        (1, "right", "erase", [1, 0, 0, 0.5, 0]),
        (1, "all", "erase", [0.5, 0.5, 0, 0, 0.4]),
    ],
)
def test_averages_are_of_what_shows_and_where_nothing_does_of_what_is_hidden(
    alpha, painted, blend, root, dtype
):
    surface = halves((1, 0, 0, 1), (0, 1, 0, alpha))
    surface = surface.with_sources({"roughness": lambda points: (points[:, 0] > 0) * 0.8})
    texture = octex.convert(surface, 5, dtype=dtype)
    region = ~on_the_left(surface) | (painted == "all")
    found = octex.fill(texture, surface, region, (0, 0, 1), blend=blend)
    assert_averages(texture, found)
    names = "base_color", "alpha", "roughness"
    np.testing.assert_allclose(np.concatenate([color_of(found, 0, name) for name in names]), root, atol=0.02)
    assert found.channels["base_color"].values.min() >= 0


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
def test_images_on_floats_stay_in_the_range_of_their_pixels(seed):
    surface = plain(square())
    texture = octex.convert(surface, 4, dtype="float32", fit=False)
    painted = random_image(seed, 32, 32, translucent=True)
    found = octex.paint(texture, surface, octex.Projection(painted, above(size=32)), max_depth=6)
    assert found.tree.n_leaves > texture.tree.n_leaves
    for values in found.channels["base_color"][1:]:
        assert 0 <= values.min(initial=0) <= values.max(initial=0) <= 1
