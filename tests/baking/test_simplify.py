"""Meshes of fewer triangles, and what is baked onto them from the surface that they stand for."""

import json

import numpy as np
import pytest

import octex
from octex.errors import ArgumentError, MissingExtraError, ModelError, ModelWarning
from octex.nearest.triangles import Triangles
from octex.source.surface import Surface
from tests.conftest import needs_jit
from tests.make.fixtures import ply
from tests.make.painted import ball, halved_quads
from tests.make.small_surfaces import OCTAHEDRON, OCTAHEDRON_FACES

pytest.importorskip("fast_simplification", reason="needs the extra simplify")


def colors(points):
    return 0.5 + 0.4 * np.sin(3.0 * points)


def radius(points):
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    return 1.0 + 0.01 * np.sin(20.0 * directions).prod(axis=1)


def bumpy(around=64):
    """A ball with bumps that few triangles cannot follow."""
    surface = ball(around)
    directions = surface.rest / np.linalg.norm(surface.rest, axis=1, keepdims=True)
    bumps = Surface.from_arrays(directions * radius(directions)[:, None], surface.triangles)
    return bumps.with_sources({"base_color": colors})


def distances(surface, other):
    """Return how far points scattered over a surface are from another."""
    points = surface.scatter(2000, 1).points
    found = Triangles.of(other.rest, other.triangles).nearest(points)
    return np.linalg.norm(points - other.rest_at(found.triangles, found.barycentric), axis=1)


@needs_jit
def test_fewer_triangles_stay_near_the_surface_and_face_outwards():
    surface = bumpy()
    low = octex.simplify(surface, 1000)
    assert 900 <= len(low.triangles) <= 1020
    assert max(distances(low, surface).max(), distances(surface, low).max()) < 0.02
    corners = low.vertices[low.triangles]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((outward * corners.mean(axis=1)).sum(axis=1) > 0).mean() > 0.99
    assert low.frames is not None
    again = octex.simplify(surface, 1000)
    np.testing.assert_array_equal(low.vertices, again.vertices)
    np.testing.assert_array_equal(low.triangles, again.triangles)


@needs_jit
def test_borders_stay_and_few_triangles_are_only_welded():
    across = np.linspace(0, 1, 20)
    x, y = np.meshgrid(across, across, indexing="ij")
    plane = np.stack([x, y, 0.001 * np.sin(9 * x)], axis=2).reshape(-1, 3)
    triangles = halved_quads(20, 20)
    surface = Surface.from_arrays(plane, triangles)
    low = octex.simplify(surface, 150)
    assert len(low.triangles) <= 153
    assert abs(low.areas().sum() - surface.areas().sum()) < 1e-4
    assert len(octex.simplify(surface, 20).triangles) <= 20
    apart = Surface.from_arrays(plane[triangles].reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    assert len(octex.simplify(apart, 5000).vertices) == 400


@needs_jit
def test_what_cannot_be_simplified_is_told(monkeypatch):
    tetrahedron = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    many = np.concatenate([tetrahedron + np.array([3 * n, 0, 0]) for n in range(30)])
    parts = Surface.from_arrays(many, np.concatenate([faces + 4 * n for n in range(30)]), name="parts")
    with pytest.warns(ModelWarning, match=r"^parts: 120 triangles are left, not 20"):
        assert len(octex.simplify(parts, 20).triangles) == 120
    surface = bumpy(32)
    joined = Surface.joined([surface, parts.with_sources({"base_color": colors})])
    with pytest.warns(ModelWarning, match="triangles are left, not 400"):
        low = octex.simplify(joined, 400)
    assert (
        300 <= (low.vertices[low.triangles].max(axis=(1, 2)) < 1.1).sum() - 4 <= 400
    )  # of the ball, less a part's
    flat = Surface.from_arrays(np.zeros((3, 3)) + np.arange(3)[:, None], [[0, 1, 2]], name="flat")
    with pytest.raises(ModelError, match="flat: no triangle has an area"):
        octex.simplify(flat, 10)
    with pytest.raises(ArgumentError, match="triangles"):
        octex.simplify(parts, 3)
    monkeypatch.setattr("octex.baking.simplify.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"octex\[simplify\]"):
        octex.simplify(parts, 20)


@needs_jit
def test_a_low_mesh_shows_the_colours_and_normals_of_the_surface():
    surface = bumpy()
    low = octex.finish(surface, triangles=600, depth=7, texture_size=512)
    assert len(low.triangles) <= 612
    points = low.scatter(3000, 2)
    found = Triangles.of(surface.rest, surface.triangles).nearest(points.points)
    nearest = surface.rest_at(found.triangles, found.barycentric)
    off = low.evaluate(points, "base_color") - colors(nearest)
    assert np.sqrt((off**2).mean()) < 0.012
    # The normals of the bumps, from their formula: they are nearer to the map's than to the low mesh's own.
    at, step = nearest / np.linalg.norm(nearest, axis=1, keepdims=True), 1e-4
    slopes = np.stack([radius(at + step * axis) - radius(at - step * axis) for axis in np.eye(3)], axis=1)
    slopes /= 2 * step
    exact = at - slopes / radius(at)[:, None]
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    mapped = low.evaluate(points, "normal")
    own = low.frames.normals.at(points.triangles, points.barycentric)
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    by_map, by_mesh = (
        np.degrees(np.arccos(np.clip((each * exact).sum(axis=1), -1, 1))) for each in (mapped, own)
    )
    assert np.sqrt((by_map**2).mean()) < 2.5
    assert np.sqrt((by_map**2).mean()) < 0.5 * np.sqrt((by_mesh**2).mean())


@needs_jit
def test_normals_of_the_source_may_be_all_that_is_baked():
    surface = bumpy(32)
    texture = octex.convert(surface, depth=5)
    baked = octex.bake(texture, octex.simplify(surface, 300), source=surface, channels=["normal"])
    source = baked.source
    read = {name for name, each in source.materials[0].inputs.items() if each.texture is not None}
    assert read == {"normal"}
    with pytest.raises(ArgumentError, match="normal"):
        octex.bake(texture, surface, channels=["normal"])


@needs_jit
def test_an_atlas_is_fine_enough_for_the_normals_of_the_source():
    surface = bumpy(64)
    texture, low, widths = octex.convert(surface, depth=4), octex.simplify(surface, 600), []
    for channels in (["base_color"], None):
        source = octex.bake(texture, low, source=surface, channels=channels, uv="atlas").source
        widths.append(source.materials[0].inputs["base_color"].texture.texels.shape[1])
    assert widths[1] == 2 * widths[0]


@needs_jit
def test_a_flat_light_model_has_neither_a_normal_map_nor_tangents(tmp_path):
    across = np.stack(np.meshgrid(*[np.arange(20) / 19] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    triangles = halved_quads(20, 20)
    plane = Surface.from_arrays(np.pad(across, [(0, 0), (0, 1)]), triangles)
    low = octex.finish(plane.with_sources({"base_color": colors}), triangles=20, depth=5, texture_size=64)
    octex.write_model(low, tmp_path / "flat.gltf")
    written = json.loads((tmp_path / "flat.gltf").read_text())
    assert "normalTexture" not in written["materials"][0]
    assert set(written["meshes"][0]["primitives"][0]["attributes"]) == {"POSITION", "NORMAL", "TEXCOORD_0"}


def test_a_triangle_shows_its_own_side_of_a_crease():
    """A roof whose ridge zigzags, shown by one with a straight ridge: no texel beside it sees beyond."""
    steps = np.arange(21)
    ridge = np.stack([0.03 * (-1.0) ** steps, steps / 20.0, -0.03 * np.ones(21)], axis=1)
    feet = [np.stack([side * np.ones(21), steps / 20.0, -np.ones(21)], axis=1) for side in (-1.0, 1.0)]
    rows = np.concatenate([np.stack([steps[1:], steps[:-1], steps[:-1] + 21, steps[1:] + 21], axis=1)] * 2)
    rows[20:] = 21 + rows[:20]
    triangles = rows[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    source = octex.Surface.from_arrays(np.concatenate([feet[0], ridge, feet[1]]), triangles)
    source = source.with_sources({"base_color": lambda rest: 0.5 + 0.0 * rest})
    low = octex.Surface.from_arrays(
        [(-1, 0, -1), (-1, 1, -1), (0, 0, 0), (0, 1, 0), (1, 0, -1), (1, 1, -1)],
        [(0, 2, 3), (0, 3, 1), (2, 4, 5), (2, 5, 3)],
    )
    baked = octex.bake(octex.convert(source, 4), low, source=source, uv="atlas", texture_size=256)
    points = baked.scatter(5000, 0)
    shown = baked.evaluate(points, "normal")
    assert ((shown * points.normals).sum(axis=1) > 0.5).all()


@needs_jit
def test_the_command_bakes_a_model_without_a_texture(tmp_path, cli):
    surface = bumpy(32)
    model, output = tmp_path / "model.ply", tmp_path / "low.glb"
    octex.write_model(octex.bake_vertices(octex.convert(surface, depth=5), surface), model)
    cli.result("bake", model, output, "--triangles", "0.5k", "--texture-size", 256, "--quiet")
    low = octex.load_surface(output)
    assert len(low.triangles) <= 510
    few = cli.result("bake", model, output, "--force", "--triangles", "50k", "--texture-size", 64)
    assert "the model has no more than 50,000 triangles: all stay" in few
    assert [each.name for each in low.channels] == ["base_color", "metallic", "roughness", "normal"]


def write_ply(path, vertices, triangles):
    vertex = {axis: ("float", vertices[:, i]) for i, axis in enumerate("xyz")}
    face = {"vertex_indices": ("list uchar int", triangles)}
    ply(path, {"vertex": vertex, "face": face}, encoding="binary_little_endian")


@needs_jit
@pytest.mark.parametrize("repairs", [False, True])
def test_damaged_meshes_have_a_light_model(tmp_path, repairs):
    surface = bumpy(24)
    count = len(surface.vertices)
    vertices = np.concatenate([surface.vertices, [[np.nan, 0, 0], [3, 0, 0], [1, 1, 1]], surface.vertices])
    vertices[count + 3 :, 0] += 0.7  # another ball crosses the first
    extra = [
        [0, 1, count],  # not finite
        [5, 5, 9],  # without area: two corners in one, and all on a line
        [count + 1, count + 1, count + 1],
        [200, 201, count + 2],  # a fin: three triangles meet at its edge
        [201, 200, count + 2],
    ]
    triangles = np.concatenate([surface.triangles, extra, surface.triangles + count + 3])
    path = tmp_path / "model.ply"
    write_ply(path, vertices, triangles)
    if not repairs:
        with pytest.raises(ModelError, match=r"model.ply: vertices are not all finite"):
            octex.finish(path, triangles=400, texture_size=128)
        vertices[count] = 0.0
        write_ply(path, vertices, triangles)
    low = octex.finish(path, triangles=800, depth=6, texture_size=256, repair=repairs)
    assert np.isfinite(low.vertices).all()
    assert 400 <= len(low.triangles) <= 816
    middles = np.array([[0, 0, 0], [0.7, 0, 0]])
    points = low.scatter(2000, 1).points
    off = np.abs(np.linalg.norm(points[:, None] - middles, axis=2) - 1.0).min(axis=1)
    assert np.median(off) < 0.02
    inside = np.linalg.norm(points[:, None] - middles, axis=2).min(axis=1) < 0.9
    assert inside.any() != repairs  # walls where the balls cross are seen by nobody
    with_colors = low.evaluate(low.scatter(500, 2), "base_color")
    assert np.isfinite(with_colors).all()


@needs_jit
def test_thousands_of_parts_have_a_light_model():
    places = np.stack(np.meshgrid(*[3.0 * np.arange(n) for n in (15, 12, 12)]), axis=-1).reshape(-1, 3)
    vertices = (places[:, None] + OCTAHEDRON).reshape(-1, 3)
    triangles = (6 * np.arange(len(places))[:, None, None] + OCTAHEDRON_FACES).reshape(-1, 3)
    surface = Surface.from_arrays(vertices, triangles, name="crowd")
    assert len(octex.simplify(surface, 20_000).triangles) == len(triangles)
    with pytest.warns(ModelWarning, match="crowd: .* triangles are left, not 100: its loose parts"):
        low = octex.simplify(surface, 100)
    owners = np.rint(low.vertices[low.triangles].mean(axis=1) / 3.0).astype(int)
    assert len(np.unique(owners, axis=0)) == len(places)  # none is lost
    small = surface.part(np.arange(8 * 250)).with_sources({"base_color": colors})
    with pytest.warns(ModelWarning, match="crowd: 2,000 triangles are left, not 1,000"):
        baked = octex.finish(small, triangles=1000, depth=6, texture_size=512)
    assert len(np.unique(baked.parts)) == 250
