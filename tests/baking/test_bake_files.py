"""Baked models in files: what is written is read back."""

import json
import re
import urllib.parse
from functools import cache

import numpy as np
import pytest

import octex
from octex.errors import ArgumentError, ModelError
from octex.source.materials import Input, Material, MaterialSource
from octex.source.surface import Surface
from tests.baking.test_bake import painted, psnr, tiles, turned_ball
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
