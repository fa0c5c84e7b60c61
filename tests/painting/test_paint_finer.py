"""Paint over finer paint, over kept coefficients and beside both."""

import numpy as np
import pytest

import octex
from octex.channels import decode
from tests.conftest import needs_jit
from tests.make.painted import ball, plain, square
from tests.make.small_surfaces import sheet
from tests.oracles.naive_edits import assert_averages
from tests.painting.test_paint_sound import DROID
from tests.properties.edit_claims import assert_one_color, code_width, kept_edge
from tests.properties.edit_models import vars_of_scripts, waved

pytestmark = needs_jit


def within(surface, texture, center, low, high):
    """Points of a surface that a texture is on, so far from a centre."""
    points = surface.scatter(4000, 1).rest
    away = np.linalg.norm(points - center, axis=1)
    points = points[(away > low) & (away < high)]
    return np.asarray(points[texture.contains(points)])


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


def test_a_second_coat_over_part_of_finer_paint_adds_no_cells():
    for surface in (plain(square(steps=8), (0.2, 0.5, 0.7)), ball(16)):
        texture = octex.convert(surface, 3)
        radius = 0.3 * texture.placement.size
        first, second = (octex.Sphere(tuple(surface.rest[0] + [x, 0, 0]), radius) for x in (0, radius))
        found = octex.fill(texture, surface, first, (1, 0, 0), max_depth=5)
        once = octex.fill(found, surface, second, (0, 1, 0), max_depth=5)
        twice = octex.fill(once, surface, second, (0, 1, 0), max_depth=5)
        assert found.tree.n_leaves < once.tree.n_leaves == twice.tree.n_leaves


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


@pytest.mark.parametrize("max_depth", [None, 5, 3])
def test_a_transparent_image_paints_what_its_opaque_part_alone_paints(max_depth):
    surface = ball()
    texture = octex.convert(surface, 5)
    camera = octex.Camera.fitted(surface.vertices, (0.2, 0.1, 1), size=(96, 96))
    drawn = np.zeros((96, 96, 4), np.uint8)
    rows, columns = np.mgrid[:96, :96]
    drawn[np.hypot(rows - 40, columns - 52) < 6] = [200, 30, 10, 255]
    left, top, side = 28, 16, 48  # all that a cell of depth 3 sees of the disc
    K = camera.K.copy()
    K[:2, 2] -= left, top
    size = side, side
    part = octex.Camera.pinhole(size, pose=camera.world_to_camera, convention="opencv", K=K)
    cropped = np.ascontiguousarray(drawn[top : top + side, left : left + side])
    whole, alone = (
        octex.paint(texture, surface, octex.Projection(image, seen), max_depth=max_depth)
        for image, seen in ((drawn, camera), (cropped, part))
    )
    assert np.array_equal(whole.tree.arrays.flags, alone.tree.arrays.flags)
    leaves = whole.tree.leaf_cells()
    values = [each.channels["base_color"].values[leaves].astype(int) for each in (whole, alone)]
    assert np.abs(values[0] - values[1]).max() <= 1  # the centre of the crop is rounded otherwise
    assert whole.tree.n_leaves >= texture.tree.n_leaves


#: Scripts that make a surface, a texture, and the depths at which all of it is painted.
COATED = {
    "nothing but a fill of its own": """
surface = waved("open", 6, ["base_color"], 99)
texture = octex.fill(None, surface, octex.Sphere(surface.rest[0], 0.387), (0, 0.2, 0.2), max_depth=3)
depths = (5,)
""",
    "one triangle, divided": """
surface = waved("triangle", 7, ["base_color", "roughness"], 3)
texture = octex.resize(octex.convert(surface, 3, dtype="float32"), 4)
depths = (3,)
""",
    "facings other than the surface's, and finer paint": """
surface = ball(16)
colors = 0.5 + 0.4 * surface.vertices
inside_out = octex.Surface.from_arrays(surface.vertices, surface.triangles[:, ::-1], colors=colors)
texture = octex.convert(inside_out, 4)
texture = octex.fill(texture, inside_out, octex.Sphere((0, 0, 1), 0.7), (1, 0, 0), max_depth=5)
depths = (4,)
""",
    "a little finer paint": """
surface = waved("overlapping", 14, ["base_color"], 26)
texture = octex.convert(surface, 3, dtype="float16", fit=False)
texture = octex.fill(texture, surface, octex.Sphere(surface.rest[0], 0.3), (1, 0, 0), max_depth=4)
depths = (5,)
""",
    "much finer paint": """
surface = waved("overlapping", 14, ["base_color"], 26)
texture = octex.convert(surface, 3, dtype="float16", fit=False)
texture = octex.fill(texture, surface, octex.Sphere(surface.rest[0], 0.8), (1, 0, 0), max_depth=5)
depths = (6,)
""",
    "finer paint on one triangle": """
surface = waved("triangle", 11, ["base_color"], 98)
place = octex.Sphere(surface.rest[surface.triangles[0]].mean(axis=0), 0.5)
texture = octex.fill(octex.convert(surface, 4), surface, place, (1, 0, 0), max_depth=5)
depths = 3, 5, 6
""",
    "no finer paint": """
surface = waved("overlapping", 17, ["base_color", "roughness"], 16)
texture = octex.convert(surface, 3, dtype="float32")
depths = 4, 5
""",
    "cells divided in the planes of squares": """
surface = waved("planes", 16, ["base_color", "alpha", "roughness"], 52)
texture = octex.resize(octex.convert(surface, 4, dtype="uint8", max_error=20), 5)
depths = 5, 6
""",
    "cells divided beside thin walls": """
surface = waved("sheet", 0, ["base_color", "roughness"], 0)
texture = octex.resize(octex.convert(surface, 4, dtype="float32", max_error=20), 5)
depths = 5, 6
""",
    "finer paint made coarser": """
surface = waved("cube", 16, ["base_color"], 48)
texture = octex.convert(surface, 5, dtype="float32")
texture = octex.fill(texture, surface, octex.Sphere(surface.rest[0], 0.4), (1, 0, 0), max_depth=7)
texture = octex.resize(texture, 4)
depths = 4, 5
""",
    "divided cells of points, beside finer paint": """
surface = waved("sheet", 0, ["base_color", "roughness"], 0)
texture = octex.resize(octex.convert(cloud(surface, 11), 3, dtype="float32"), 4)
texture = octex.fill(texture, surface, octex.Sphere(surface.rest[0], 0.3), (1, 0, 0), max_depth=5)
depths = (5,)
""",
    "an adaptive tree, divided": """
surface = waved("flat", 17, ["base_color", "alpha"], 22)
texture = octex.convert(surface, 3, dtype="float32", detail=lambda points: 1 + 2 * (points[:, 0] * 3 % 1))
texture = octex.resize(texture, 4)
depths = (6,)
""",
}


@pytest.mark.parametrize("name", COATED)
def test_a_coat_over_all_changes_the_field_by_its_part_everywhere(name):
    names = {**vars_of_scripts(), "ball": ball}
    exec(COATED[name], names)
    surface, texture = names["surface"], names["texture"]
    points = within(surface, texture, np.zeros(3), 0, 9)
    assert len(points) > 30
    before, color = texture.sample(points), np.array([0.2, 0.7, 0.4])
    slack = 1.5 * code_width(texture.channels["base_color"].format) + 2e-5
    everywhere = octex.Sphere((0, 0, 0), 9.0)
    is_opaque = "alpha" not in texture.channels and len(points) == 4000  # all of the surface is
    for depth in names["depths"]:
        for opacity in (1.0, 0.5) if is_opaque else (1.0,):
            coat = {"opacity": opacity, "max_depth": depth}
            painted = octex.fill(texture, surface, everywhere, color, **coat)
            erased = octex.fill(texture, surface, everywhere, color, blend="erase", **coat)
            expected = (1 - opacity) * before + opacity * color
            np.testing.assert_allclose(painted.sample(points), expected, atol=slack)
            erased.validate()
            left, rounding = 1 - opacity, 0.006 * (1 - opacity) + 1e-6
            np.testing.assert_allclose(erased.sample(points, "alpha"), left, atol=rounding)
            if opacity == 1.0:
                assert_one_color(painted, surface, "base_color", color, 0, averages="divided" not in name)


#: Scripts whose last line paints a texture, by what its averages are means of.
AVERAGED = {
    "nodes beside the surface, in all channels, above new skirts": """
surface = waved("open", 9, ["base_color", "normal"], 34)
texture = octex.convert(surface, 2, dtype="float16", fit=False)
texture = octex.fill(texture, surface, [0, 7], (0.2, 0.0, 0.7), opacity=0.5, blend="replace", max_depth=4)
place = octex.Sphere((-0.624, 0.262, 1.046), 0.654, soft=0.164)
made = octex.fill(texture, surface, place, (0.0, 0.0, 1.0), channel="normal", blend="multiply", max_depth=4)
""",
    "rows that nothing but skirts faces": """
surface = waved("sphere", 17, ["base_color", "alpha"], 41)
detail = lambda points: 1 + points[:, 0] * 3 % 1
texture = octex.convert(surface, 2, dtype="float16", fit=False, detail=detail)
texture = octex.fill(texture, surface, beyond(1, 0.193, 0.2), (0.7, 1.0, 1.0), blend="add", max_depth=3)
everywhere = np.ones(len(surface.triangles), bool)
made = octex.fill(texture, surface, everywhere, (0.2, 0.2, 0), blend="replace", max_depth=3)
""",
    "skirts of cells of hardly any surface": """
surface = waved("open", 16, ["base_color", "alpha"], 4)
texture = octex.convert(surface, 4, dtype="float32")
texture = octex.mix(texture, octex.resize(texture, 3), beyond(1, 0.226, 0.2))
made = octex.fill(texture, surface, beyond(0, -0.507, 0.171), (1, 0.2, 0.2), opacity=0.2, blend="screen")
""",
    "leaves that paint splits, in all channels": """
surface = waved("overlapping", 18, ["base_color", "alpha"], 92)
texture = octex.convert(surface, 3, fit=False, dtype="float32")
made = octex.fill(texture, surface, beyond(1, 0.477, 0.09), (0.0, 0.2, 0.0), blend="multiply", max_depth=2)
""",
    "colours of newly split leaves, by alpha": """
surface = waved("overlapping", 2, ["base_color", "alpha"], 22)
texture, place = octex.convert(surface, 2), octex.Sphere(surface.rest[0], 0.4)
made = octex.fill(texture, surface, place, (0.7, 0.7, 0), opacity=0.5, blend="screen", max_depth=3)
""",
    "facings of leaves divided beside paint": """
surface = waved("sheet", 4, ["base_color"], 26)
texture = octex.convert(cloud(surface, 1), 5, dtype="float32")
made = octex.fill(texture, surface, beyond(2, 0.41, 0.132), (0.2, 0.7, 1), opacity=0.2, max_depth=6)
""",
}


@pytest.mark.parametrize("script", AVERAGED.values(), ids=AVERAGED)
def test_averages_above_finer_paint_are_means_of_what_is_there(script):
    names = dict(vars_of_scripts())
    exec(script, names)
    assert names["made"].tree.n_leaves != 0
    assert_averages(names["texture"], names["made"])
