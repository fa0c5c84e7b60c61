"""Baking: texels against counting, gutters against unfolding by hand, maps against the field."""

import json
import re
from functools import cache

import numpy as np
import pytest

import octex
from octex.baking.layout import kept_layout
from octex.baking.texels import draw_texels
from octex.channels import encode, linear_to_srgb
from octex.errors import ArgumentError, ModelError, ModelWarning
from octex.source.corners import Corners
from octex.source.materials import Input, Material, MaterialSource, Texture
from octex.source.surface import Surface
from octex.source.tangents import corner_frames
from tests.make import solids
from tests.make.fixtures import random_image
from tests.make.painted import ball, square, waves
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


def turned_ball(rings):
    """A ball with the normals of a round one, which its pose turns."""
    points, triangles = solids.sphere([0.0, 0.0, 0.0], 1.0, rings)
    normals = Corners((points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32), triangles)
    frames = corner_frames(points, triangles, normals, None, None)
    turned = points @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    source = Surface.from_arrays(points, triangles).source
    return Surface(turned, triangles, source, rest=points, frames=frames)


def tiles(step, border=0.0):
    """Two squares, each with a square of the coordinates but for its border, so far apart there."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    flat = border + (1 - 2 * border) * points[:, :2]
    uv = np.concatenate([flat, flat + step])
    triangles = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    return Surface.from_arrays(np.concatenate([points, points + np.array([1.5, 0.0, 0.0])]), triangles, uv=uv)


def scattered_triangles(count):
    """Triangles that are a chart each."""
    random = np.random.default_rng(0)
    vertices = np.repeat(random.random((count, 3)), 3, axis=0) + 0.05 * random.random((3 * count, 3))
    return Surface.from_arrays(vertices, np.arange(3 * count).reshape(-1, 3))


def psnr(a, b):
    difference = linear_to_srgb(np.clip(a, 0, 1)) - linear_to_srgb(np.clip(b, 0, 1))
    return float(-10 * np.log10(max(np.mean(difference**2), 1e-20)))


def test_a_map_grows_until_charts_fit_and_texels_are_as_small_as_cells():
    surface = scattered_triangles(300).with_sources({"base_color": waves})
    texture = octex.convert(surface, 6)
    baked = octex.bake(texture, surface)
    image = baked.source.materials[0].inputs["base_color"].texture
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
    surface = Surface.from_arrays(square, [[0, 1, 2], [0, 2, 3]], uv=square[:, :2] * 0.8 + (0.5, -0.4))
    texture = painted(surface)
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


def painted(surface):
    return octex.convert(surface.with_sources({"base_color": waves}), 6)


def on_disk(folder):
    """Write a cube and its texture; return the words of octex bake before its output."""
    surface = cube_with_charts().with_sources({"base_color": waves})
    octex.convert(surface, 4).save(folder / "cube.octex")
    model = octex.bake(octex.open(folder / "cube.octex"), surface, texture_size=64)
    octex.write_model(model, folder / "cube.obj")
    return ["bake", folder / "cube.octex", folder / "cube.obj"]


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_each_material_gets_maps_and_keeps_what_it_is(ending, tmp_path):
    surface = two_squares()
    texture = painted(surface)
    baked = octex.bake(texture, surface, texture_size=128)
    points = baked.scatter(5000)
    field = texture.sample(points, "base_color")
    assert psnr(baked.evaluate(points), field) > 45.0
    left, right = baked.source.materials
    assert (left.name, left.double_sided, left.alpha_mode) == ("left", True, "opaque")
    assert (right.name, right.double_sided, right.alpha_mode) == ("right", False, "blend")
    octex.write_model(baked, tmp_path / f"two{ending}")
    read = octex.load_surface(tmp_path / f"two{ending}")
    assert psnr(read.evaluate(points), field) > 40.0  # images of .obj files repeat
    if ending == ".glb":
        known = [each[2:] for each in read.source.materials]
        assert known == [(0.5, "left", True), (0.5, "right", False)]


def test_materials_that_read_one_image_share_maps_and_an_atlas_joins_those_alike():
    surface = two_squares()
    own = surface.source
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
    kept = octex.bake(texture, shared, uv="keep", texture_size=64).source
    one, two = (each.inputs["base_color"].texture for each in kept.materials)
    assert one.texels is two.texels
    assert [each.name for each in kept.materials] == ["left", "other"]
    joined = octex.bake(texture, shared, uv="atlas", texture_size=64).source
    assert [(each.name, each.double_sided) for each in joined.materials] == [("", True)]
    apart = octex.bake(painted(surface), surface, uv="atlas", texture_size=64).source
    assert [each.name for each in apart.materials] == ["left", "right"]


def test_tiles_become_materials_and_what_overlaps_and_looks_otherwise_is_refused():
    for step, expected in (((1.0, 0.0), [".1001", ".1002"]), ((0.0, 1.0), [".1001", ".1011"])):
        surface = tiles(step)
        texture = painted(surface)
        baked = octex.bake(texture, surface, uv="keep", texture_size=128)
        assert [each.name for each in baked.source.materials] == expected
        seen = baked.scatter(5000)
        assert psnr(baked.evaluate(seen), texture.sample(seen, "base_color")) > 45.0
    surface = tiles((0.0, 0.0))
    with pytest.raises(ModelError, match="texture coordinates overlap"):
        octex.bake(painted(surface), surface, uv="keep")
    # What overlaps but looks alike may stay.
    assert octex.bake(octex.convert(surface, 5), surface, uv="keep", texture_size=64).uv is not None


@pytest.mark.parametrize("across", [0.0, 1.0])
def test_squeezed_coordinates_are_kept_only_where_what_they_show_is_alike(across):
    """As of low-poly models, each part of which is one texel of a palette, or a line of it."""
    points, triangles = square(side=1.0, steps=4)
    uv = np.stack([across * (points[:, 0] + 0.5), np.full(len(points), 0.375)], axis=1)
    palette = np.full((8, 8, 3), 90, np.uint8)
    plain = Surface.from_arrays(points, triangles, uv=uv, image=palette)
    texture = octex.convert(plain, 5)
    kept = octex.bake(texture, plain)
    np.testing.assert_allclose(kept.uv.values[kept.uv.rows], plain.uv.values[plain.uv.rows], atol=1e-6)
    seen = plain.scatter(2000)
    colors = texture.sample(seen, "base_color")
    np.testing.assert_allclose(kept.evaluate(seen), colors, atol=1e-3)
    disc = octex.fill(texture, plain, octex.Sphere((0.1, 0.1, 0.0), 0.3), (1.0, 0.0, 0.0))
    baked = octex.bake(disc, plain)
    assert psnr(baked.evaluate(seen), disc.sample(seen, "base_color")) > 35.0
    with pytest.warns(ModelWarning, match="its texture coordinates are too small: on .* % of it"):
        flat = octex.bake(disc, plain, uv="keep")
    texture_of = flat.source.materials[0].inputs["base_color"].texture
    assert (texture_of is not None) == (across > 0.0)
    if texture_of is not None:
        assert texture_of.texels.shape[:2] == (64, 64)
        columns = flat.evaluate(seen)[np.argsort(seen.rest[:, 0])]
        assert columns[:200, 1].min() > 0.09  # left of the disc
        assert columns[1300:1400, 1].max() < 0.07


@pytest.mark.parametrize("size", [0.0, 1e-5])
def test_coordinates_that_put_differing_triangles_into_one_texel_are_not_kept(size):
    """As of models whose coordinates are all 0, with colours of faces."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]) + np.array([[0.0, 0, 0], [2, 0, 0]])[:, None]
    colors = np.repeat([[200, 30, 30], [30, 30, 200]], 3, axis=0).astype(np.uint8)
    surface = Surface.from_arrays(
        corners.reshape(-1, 3),
        np.arange(6).reshape(-1, 3),
        uv=0.5 + size * corners.reshape(-1, 3)[:, :2],
        colors=colors,
    )
    texture = octex.convert(surface, 5)
    baked = octex.bake(texture, surface)
    seen = surface.scatter(2000)
    np.testing.assert_allclose(baked.evaluate(seen), texture.sample(seen, "base_color"), atol=4e-3)
    with pytest.warns(ModelWarning, match="its texture coordinates are too small"):
        octex.bake(texture, surface, uv="keep")


def test_coordinates_that_overlap_in_a_small_part_of_the_map_but_on_much_of_the_surface_are_not_kept():
    """Two squares share a thousandth of the map; a third one, a sixth of their area, has half of it."""
    corners, sides = square(side=1.0, steps=1)
    places = [corners, corners + np.array([2.0, 0.0, 0.0]), 0.4 * corners + np.array([4.0, 0.0, 0.0])]
    spots = [0.03 * corners + 0.1, 0.03 * corners + 0.1, 0.7 * corners + 0.6]
    points, uv = np.concatenate(places), np.concatenate(spots)[:, :2]
    triangles = np.concatenate([sides + n * len(corners) for n in range(3)])
    colors = np.repeat([[200, 30, 30], [30, 30, 200], [30, 200, 30]], len(corners), axis=0).astype(np.uint8)
    surface = Surface.from_arrays(points, triangles, uv=uv, colors=colors)
    texture = octex.convert(surface, 6)
    seen = surface.scatter(2000)
    baked = octex.bake(texture, surface)
    np.testing.assert_allclose(baked.evaluate(seen), texture.sample(seen, "base_color"), atol=4e-3)
    with pytest.raises(ModelError, match=r"coordinates overlap on at least [0-9.]+ % of"):
        octex.bake(texture, surface, uv="keep")


def test_mirrored_coordinates_are_kept_only_where_both_halves_are_alike():
    """The halves of a square lie on one another in the map, folded along its middle."""
    points, triangles = square(side=1.0, steps=8)
    uv = np.column_stack([0.1 + np.abs(points[:, 0]), points[:, 1] + 0.5])
    plain = Surface.from_arrays(points, triangles, uv=uv, image=random_image(16, 16))
    texture = octex.convert(plain, 6)
    kept = octex.bake(texture, plain, texture_size=128)
    np.testing.assert_allclose(kept.uv.values[kept.uv.rows], plain.uv.values[plain.uv.rows], atol=1e-6)
    seen = plain.scatter(2000)
    assert psnr(kept.evaluate(seen), texture.sample(seen, "base_color")) > 30.0
    half = octex.fill(texture, plain, octex.Box((0.0, -1.0, -1.0), (1.0, 1.0, 1.0)), (1.0, 0.0, 0.0))
    baked = octex.bake(half, plain, texture_size=128)
    assert psnr(baked.evaluate(seen), half.sample(seen, "base_color")) > 30.0


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
    texture_of = baked.source.materials[0].inputs["base_color"].texture
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
    texels = near.source.materials[0].inputs["base_color"].texture
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


def test_texels_are_the_means_of_so_many_lookups(monkeypatch):
    def as_it_is(values, _areas, _part, first, fitted):
        fitted[:] = values[first : first + len(fitted)]

    monkeypatch.setattr("octex.baking.maps.fit_rows", as_it_is)
    surface = cube_with_charts().with_sources({"base_color": waves})
    texture = octex.convert(surface, 6)
    maps = []
    for size, times in ((96, 3), (288, 1)):
        baked = octex.bake(texture, surface, texture_size=size, supersample=times, bits=32)
        given = baked.source.materials[0].inputs["base_color"].texture
        maps.append(given.texels[..., :3])
    means = maps[1].reshape(96, 3, 96, 3, 3).mean(axis=(1, 3))
    layout = kept_layout(surface, 96)
    drawn = draw_texels(layout.corners, layout.charts, layout.edges, 96, 0, 96)
    inside = drawn.areas > 0.999
    assert inside.sum() > 2000
    np.testing.assert_allclose(maps[0][inside], means[inside], atol=1e-5)


def test_the_command_bakes(tmp_path, cli):
    given = on_disk(tmp_path)

    def made(output, *words):
        told = json.loads(cli.result(*given, tmp_path / output, *words, "--json", "--quiet"))
        assert told["output"] == str(tmp_path / output)
        return told

    told = made("baked.glb", "--texture-size", 64)
    size = (tmp_path / "baked.glb").stat().st_size
    assert (told["texture_size"], told["channels"], told["bytes"]) == (64, ["base_color"], size)
    assert "exists" in cli.refusal(*given, tmp_path / "baked.glb", "--quiet")
    simple = "--original", given[2], "--max-distance", 0.1, "--texture-size", 64
    assert made("simple.glb", *simple)["texture_size"] == 64
    assert made("b.obj", "--vertex-colors", "--vertex-error", 4)["vertices"] > 8
    assert made("b.ply", "--max-edge", "auto")["vertices"] > 8
    made("d.obj")
    assert (tmp_path / "d-0-base_color.png").exists()


@pytest.mark.parametrize("bake", [octex.bake, octex.bake_vertices])
def test_the_texture_of_another_model_is_refused(bake):
    surface = whole()
    texture = octex.convert(surface, 3)
    other = Surface.from_arrays(surface.vertices + 10.0, surface.triangles)
    with pytest.raises(ArgumentError, match=r"has no point in the texture; it lies at \(10, 10, 10\) from"):
        bake(texture, other)
    if bake is octex.bake:
        with pytest.raises(ArgumentError, match="has no point in the texture"):
            bake(texture, surface, source=other)
    for away, stops in ((0.5, pytest.warns(ModelWarning)), (0.7, pytest.raises(ArgumentError))):
        shifted = Surface.from_arrays(surface.vertices + np.array([away, 0, 0]), surface.triangles, name="b")
        with stops as found:
            bake(texture, shifted)
        text = str(found.value if away == 0.7 else found[0].message)
        where = f"; it lies at ({away:g}, 0, 0) from the texture's model: move it back"
        assert re.fullmatch(r"\d+% of b lies outside of the texture" + re.escape(where), text)


def test_a_surface_that_is_not_the_textures_is_refused_with_the_cause_but_a_part_fits():
    whole = octex.load_surface("samples/droid.glb")
    texture = octex.convert(whole, 6, channels=["base_color"])
    for turn, cause in (
        (100 * np.eye(3), "it is 100 times as large as the texture's model: use the same units"),
        (2.54 * np.eye(3), "it is 2.54 times as large as the texture's model: use the same units"),
        (np.eye(3)[[0, 2, 1]], "its axes are not those of the texture's model: turn it"),
        (np.diag([2.0, 1, 3]), "is it of another model?"),
    ):
        with pytest.raises(ArgumentError, match=re.escape(cause)):
            Surface.from_arrays(whole.rest @ turn, whole.triangles).placed_on(texture)
    part = Surface.from_arrays(whole.rest, whole.triangles[:1000])
    part.placed_on(texture)
    with pytest.warns(ModelWarning, match="lies outside of the texture; is it of another model"):
        whole.placed_on(octex.convert(part, 7))


def test_triangles_that_have_an_area_by_rounding_alone_are_baked():
    surface = ball(16)  # at its poles
    baked = octex.bake(octex.convert(surface, 4), surface, texture_size=64)
    points = surface.scatter(2000)
    assert np.abs(baked.evaluate(points) - surface.evaluate(points)).mean() < 0.02
