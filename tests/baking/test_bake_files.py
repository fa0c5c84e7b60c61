"""Baked models in files, which are read back; colours baked to vertices, and triangles divided for them."""

import json
import re
import urllib.parse
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh

import octex
from octex.channels import encode
from octex.errors import ArgumentError, ModelError
from octex.source.materials import Input, Material, MaterialSource
from octex.source.surface import Surface
from octex.source.tangents import corner_frames
from tests.baking.test_bake import cube_with_charts, painted, painted_sphere, psnr, tiles, turned_ball
from tests.conftest import needs_jit
from tests.make import solids
from tests.make.painted import waves
from tests.make.small_surfaces import whole


@cache
def ball_at(aside):
    points, triangles = solids.sphere([0.0, 0.0, 0.0], 1.0, 12)
    points += [aside, -aside / 8, 0.0]
    surface = Surface.from_arrays(points, triangles).with_sources({"base_color": (0.2, 0.5, 0.8)})
    texture = octex.convert(surface, 3)
    return octex.bake(texture, surface, texture_size=64), octex.bake_vertices(texture, surface)


@pytest.mark.parametrize("ending", [".glb", ".gltf", ".obj", ".usdz", ".3mf", ".ply"])
@pytest.mark.parametrize("aside", [60.0, 4_500_321.91])
def test_files_keep_the_shape_of_models_far_from_the_origin(ending, aside, tmp_path):
    if ending in (".usdz", ".3mf"):
        pytest.importorskip("pxr" if ending == ".usdz" else "lib3mf")
    baked = ball_at(aside)[ending in (".3mf", ".ply")]
    octex.write_model(baked, tmp_path / f"ball{ending}")
    read = octex.load_surface(tmp_path / f"ball{ending}")
    found, expected = (np.unique(each.vertices.round(4), axis=0) for each in (read, baked))
    np.testing.assert_allclose(found, expected, atol=2e-4)


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_shading_normals_are_kept_and_posed(ending, tmp_path):
    surface = turned_ball(12)
    baked = octex.bake(octex.convert(surface, 3), surface, texture_size=256)
    octex.write_model(baked, tmp_path / f"ball{ending}")
    read = octex.load_surface(tmp_path / f"ball{ending}", normals=True)
    found = read.frames.normals.values[read.frames.normals.rows]
    np.testing.assert_allclose(found, read.vertices[read.triangles], atol=1e-5)


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
    material = baked.source.materials[0]
    octex.write_model(baked, tmp_path / "a.obj", images=images)
    for name in names:
        given = material.inputs[name]
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
    given = baked.source.materials[0].inputs["emissive"]
    assert given.factor == (1.0, 1.0, 1.0)
    assert given.texture.texels[..., :3].max() > 4.5
    with pytest.raises(ModelError, match="only exr holds"):
        octex.write_model(baked, tmp_path / "a.glb")


def test_images_of_udim_tiles_are_named_by_them(tmp_path):
    surface = tiles((1.0, 0.0), border=0.1)
    baked = octex.bake(painted(surface), surface, uv="keep", texture_size=64)
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
    read = octex.load_surface(tmp_path / "a.obj").source
    found = [read.materials[number] for number in read.triangle_materials]
    known = ["wood", "worn_steel", "worn_steel_", "material3", "material3_", "a___b"]
    assert [each.name for each in found] == known
    np.testing.assert_allclose([each.inputs["base_color"].factor for each in found], colors, atol=1e-6)


def test_materials_that_read_one_image_have_one_file(tmp_path):
    surface = whole()
    baked = octex.bake(octex.convert(surface, 3), surface, texture_size=64, channels=["base_color"])
    source = baked.source
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


DROID = Path(__file__).parents[2] / "samples" / "droid.glb"


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
    found = made.frames.normals.values[made.frames.normals.rows]
    np.testing.assert_allclose(found, np.broadcast_to(crosses[:, None], found.shape), atol=1e-6)


@needs_jit
def test_no_triangle_gets_ever_thinner_where_edges_are_halved_by_their_colours():
    surface = octex.load_surface(DROID, channels=["base_color"])
    made = octex.bake_vertices(octex.convert(surface, 8), surface, subdivide="auto", max_error=40.0)
    _, places = np.unique(made.vertices.astype(np.float32), axis=0, return_inverse=True)
    triangles = places.reshape(-1)[made.triangles]
    assert (triangles != np.roll(triangles, 1, axis=1)).all()
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    _, counts = np.unique(np.sort(ends, axis=1), axis=0, return_counts=True)
    assert (counts == 2).all()
    assert len(made.triangles) < 150_000


@pytest.mark.parametrize("ending", [".ply", ".glb", ".obj"])
def test_divided_triangles_are_shaded_as_the_whole_was(ending, tmp_path):
    surface = turned_ball(8)
    made = octex.bake_vertices(octex.convert(surface, 3), surface, subdivide=0.2)
    assert len(made.triangles) > 4 * len(surface.triangles)
    octex.write_model(made, tmp_path / f"ball{ending}")
    if ending == ".ply":
        mesh = trimesh.load(tmp_path / "ball.ply", process=False)
        assert "vertex_normals" in mesh._cache  # those of the file
        found, places = mesh.vertex_normals[mesh.faces], mesh.vertices[mesh.faces]
    else:
        read = octex.load_surface(tmp_path / f"ball{ending}", normals=True)
        found, places = read.frames.normals.values[read.frames.normals.rows], read.vertices[read.triangles]
    # On a sphere what lies between the corners' normals points as positions do.
    expected = places / np.linalg.norm(places, axis=2, keepdims=True)
    assert np.einsum("tcx,tcx->tc", found, expected).min() > np.cos(np.radians(2.0))


def test_edges_are_halved_until_none_is_longer():
    surface = whole()
    texture = octex.convert(surface, 5)
    made = octex.bake_vertices(texture, surface, subdivide=0.1)
    sides = made.vertices[np.roll(made.triangles, -1, axis=1)] - made.vertices[made.triangles]
    assert np.linalg.norm(sides, axis=2).max() <= 0.1
    assert made.areas().sum() == pytest.approx(surface.areas().sum(), rel=1e-9)
    shorter = octex.bake_vertices(texture, surface, subdivide=0.008)  # a quarter of the finest cells
    sides = shorter.vertices[np.roll(shorter.triangles, -1, axis=1)] - shorter.vertices[shorter.triangles]
    assert np.linalg.norm(sides, axis=2).max() <= 0.008
    with pytest.raises(ArgumentError, match=r"0\.1 make more than 200 triangles; edges of up to"):
        octex.bake_vertices(texture, surface, subdivide=0.1, most_triangles=200)
    same = octex.bake_vertices(texture, surface, subdivide=9.0, most_triangles=1)  # nothing to halve
    assert len(same.triangles) == len(surface.triangles)
    for most in (20, 200):
        few = octex.bake_vertices(texture, surface, subdivide="auto", max_error=0.0, most_triangles=most)
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
