"""Parts of a model, taken apart and converted into textures of their own."""

import json

import numpy as np
import pytest

import octex
from octex.channels import linear_to_srgb
from octex.errors import ArgumentError, ModelError
from octex.source.surface import Surface
from octex.source.tangents import corner_frames
from tests.conftest import needs_jit
from tests.conversion.test_separate import pair
from tests.make.command import colored_box
from tests.make.fixtures import random_image
from tests.make.painted import square, together
from tests.make.small_surfaces import FACES, TETRAHEDRON, tetrahedron, whole
from tests.make.solids import colored, cube


def rich():
    """Two squares with an image, a normal map, deformed at rest."""
    points, triangles = together(square(0.0), square(0.5))
    image = random_image(8, 8)
    surface = Surface.from_arrays(
        points, triangles, image=image, uv=points[:, :2], rest=points * [2.0, 1.0, 3.0]
    )
    mapped = octex.MappedImage(image, "box")
    given = {"normal": image, "roughness": lambda at: at[:, 0] % 1.0, "emissive": mapped}
    return surface.with_sources(given)


def codes(difference):
    return float(255 * np.abs(difference).max())


# --- some of a surface's triangles


def of_part(samples, numbers):
    """The same points of the whole, whose triangles have these numbers there."""
    return samples._replace(triangles=np.asarray(numbers, np.int32)[samples.triangles])


@pytest.mark.parametrize("surface", [pair(), rich(), whole()], ids=["colors", "rich", "faces"])
def test_a_part_gives_what_the_whole_gives(surface):
    numbers = np.flatnonzero(np.arange(len(surface.triangles)) % 3 == 1)[::-1]
    part = surface.part(numbers)
    assert np.array_equal(part.rest[part.triangles], surface.rest[surface.triangles[numbers]])
    assert np.array_equal(part.vertices[part.triangles], surface.vertices[surface.triangles[numbers]])
    assert len(part.vertices) == len(np.unique(surface.triangles[numbers]))
    assert (part.name, part.provenance) == (surface.name, surface.provenance)
    samples = part.scatter(200)
    for form in surface.channels:
        for width in (0.0, 0.3):
            found = part.evaluate(samples, form.name, width)
            assert np.array_equal(found, surface.evaluate(of_part(samples, numbers), form.name, width))
    edges = part.source.texel_edges(np.arange(len(numbers), dtype=np.int32))
    assert np.array_equal(edges, surface.source.texel_edges(numbers.astype(np.int32)))


def test_a_part_is_changed_as_the_whole_is():
    surface, rows, image = rich(), np.arange(7, 20, dtype=np.int32), random_image(4, 4)
    part = surface.part(rows)
    used = np.unique(surface.triangles[rows])
    rest = surface.rest * [1.0, 0.25, 5.0] + 1.0
    changes = (
        (part.with_rest(rest[used]), surface.with_rest(rest)),
        (part.with_filter("nearest"), surface.with_filter("nearest")),
        (part.with_channels(["roughness"]), surface.with_channels(["roughness"])),
        (part.with_sources({"metallic": image}), surface.with_sources({"metallic": image})),
    )
    for changed, wanted in changes:
        assert changed.channels == wanted.channels
        samples = changed.scatter(100)
        for form in changed.channels:
            found = changed.evaluate(samples, form.name, 0.2)
            other = wanted.evaluate(of_part(samples, rows), form.name, 0.2)
            np.testing.assert_allclose(found, other, atol=2e-6)


def test_a_part_knows_its_gaps():
    near = octex.Transfer(tetrahedron(), distance=0.1)
    surface = Surface.from_arrays(TETRAHEDRON, FACES).with_sources(near.sources)
    assert surface.part([0, 2]).source.has_gaps
    assert not pair().part([0]).source.has_gaps


def test_frames_stay_with_their_corners():
    surface = rich()
    frames = corner_frames(surface.rest, surface.triangles, None, None, surface.uv)
    framed = Surface(surface.vertices, surface.triangles, surface.source, uv=surface.uv, frames=frames)
    part = framed.part([5, 3])
    assert part.frames is not None
    assert np.array_equal(part.frames.normals.rows, frames.normals.rows[[5, 3]])
    assert np.array_equal(part.frames.tangents.rows, frames.tangents.rows[[5, 3]])


@pytest.mark.parametrize(
    ("triangles", "error", "message"),
    [
        ([0, 24], ArgumentError, "there is no triangle 24; there are 0 to 23"),
        ([-1], ArgumentError, "there is no triangle -1; there are 0 to 23"),
        ([0.0], ArgumentError, r"triangles must be whole numbers \(n,\), not float64 \(1,\)"),
        ([[0]], ArgumentError, r"not int64 \(1, 1\)"),
        (np.ones(24, bool), ArgumentError, "not bool"),
        ([], ModelError, "parts has no triangles"),
    ],
)
def test_triangles_that_are_not_there_are_refused(triangles, error, message):
    with pytest.raises(error, match=message):
        pair().part(triangles)


# --- conversion


@needs_jit
def test_parts_that_interpenetrate_keep_their_own_colours():
    surface = pair()
    samples = surface.scatter(5000)
    wanted = linear_to_srgb(surface.evaluate(samples))
    own = octex.convert_set(surface, 5)
    assert own.names == ("part-0", "part-1")
    found = own.sample(samples.rest, surface.parts[samples.triangles])
    assert codes(linear_to_srgb(found) - wanted) < 2.0
    assert own.contains(samples.rest, surface.parts[samples.triangles]).all()
    shared = octex.convert(surface, 5).sample(samples.rest)
    assert codes(linear_to_srgb(shared) - wanted) > 50.0


def test_each_part_is_converted_as_if_it_were_alone():
    surface = rich()
    found = octex.convert_set(surface, 3, dtype={"normal": "uint16"}, max_error=1)
    for number, (name, texture) in enumerate(found.items()):
        part = surface.part(np.flatnonzero(surface.parts == number))
        alone = octex.convert(part, 3, dtype={"normal": "uint16"}, max_error=1)
        assert texture.placement == alone.placement
        assert np.array_equal(texture.tree.arrays.groups, alone.tree.arrays.groups)
        for channel in alone.channels:
            assert texture.channels[channel].format == alone.channels[channel].format
            assert np.array_equal(texture.channels[channel].values, alone.channels[channel].values)
        assert texture.metadata["part"] == name == f"part-{number}"
        texture.validate()
    assert "source_roughness" in found.metadata


def test_cells_are_as_deep_in_each_part_or_as_large_in_all():
    surface = colored(cube([0, 0, 0]), cube([3, 0, 0], 0.25))
    deep = octex.convert_set(surface, 3, fit=False)
    assert [texture.tree.max_depth for texture in deep.values()] == [3, 3]
    assert deep["part-0"].placement.size == pytest.approx(4 * deep["part-1"].placement.size)
    even = octex.convert_set(surface, cell=0.2, fit=False)
    cells = [texture.info()["finest_cell"] for texture in even.values()]
    assert cells == pytest.approx([0.2, 0.2])
    with pytest.raises(ArgumentError, match="give depth or cell, not both"):
        octex.convert_set(surface, 3, cell=0.2)


def test_options_reach_every_part():
    surface = pair()
    counted = []
    found = octex.convert_set(
        surface,
        3,
        rest=2.0 * surface.rest,
        channels=["roughness"],
        sources={"roughness": lambda at: at[:, 0] / 4.0, "metallic": 0.5, "detail": 0.5},
        detail="detail",
        filter="bilinear",
        fit=False,
        progress=lambda *told: counted.append(told),
    )
    assert counted == [("convert", done, 2) for done in range(3)]
    assert found.metadata["filter"] == "bilinear"
    for texture in found.values():
        assert list(texture.channels) == ["roughness"]
        assert texture.tree.max_depth == 2
        assert json.loads(texture.metadata["convert"])["fit"] is False
    samples = surface.scatter(50)
    values = found.sample(2.0 * samples.rest, surface.parts[samples.triangles], "roughness", "nearest")
    assert np.abs(values[:, 0] - samples.rest[:, 0] / 2.0).max() < 0.25


def test_models_by_name_are_parts_of_any_kind(tmp_path):
    box = colored_box(tmp_path)
    samples = tetrahedron().scatter(200)
    cloud = octex.PointCloud(samples.rest, tetrahedron().evaluate(samples))
    found = octex.convert_set({"box": box, "thing": tetrahedron(), "dots": cloud}, 3, fit=False)
    assert found.names == ("box", "thing", "dots")
    assert not found.metadata
    assert found["box"].metadata["source"] == "box.glb"
    alone = octex.convert(tetrahedron(), 3, fit=False)
    assert np.array_equal(found.sample(samples.rest, "thing"), alone.sample(samples.rest))


def test_a_file_is_taken_apart(tmp_path):
    box = colored_box(tmp_path)
    found = octex.convert_set(box, 2, channels="base_color")
    assert found.names == ("part-0",)
    assert found.metadata["source"] == "box.glb"
    assert list(found["part-0"].channels) == ["base_color"]
    with pytest.raises(ModelError, match="cannot be read"):
        octex.convert_set(tmp_path / "missing.obj")


def test_a_part_without_area_keeps_its_number_and_its_colour(tmp_path):
    line = np.array([[5.0, 0, 0], [6.0, 0, 0], [7.0, 0, 0]]), np.array([[0, 1, 2]])
    dot = np.full((3, 3), 9.0), np.array([[0, 1, 2]])
    surface = colored(line, cube([0, 0, 0]), dot)
    found = octex.convert_set(surface, 2, dtype="uint16")
    assert len(found) == 3
    found.save(tmp_path / "set")
    found = octex.TextureSet.open(tmp_path / "set")
    found.validate()
    thirds = np.full((len(surface.triangles), 3), 1 / 3)
    middles = surface.scatter(len(surface.triangles))._replace(
        triangles=np.arange(len(surface.triangles), dtype=np.int32),
        barycentric=thirds,
        rest=surface.rest[surface.triangles].mean(axis=1),
    )
    for filter in ("nearest", "linear", "quadratic", "quartic"):
        values = found.sample(middles.rest, surface.parts, filter=filter)
        np.testing.assert_allclose(values, surface.evaluate(middles), atol=1e-4)
    only = octex.convert_set(surface, 2, channels=["base_color"])
    assert list(only["part-2"].channels) == ["base_color"]
    with pytest.raises(ModelError, match="parts: none of its parts has an area"):
        octex.convert_set(colored(line, dot), 2)


def test_what_has_no_parts_is_refused():
    samples = tetrahedron().scatter(20)
    cloud = octex.PointCloud(samples.rest, tetrahedron().evaluate(samples), name="dots")
    with pytest.raises(ArgumentError, match="dots is points, which have no parts; convert takes it"):
        octex.convert_set(cloud)
    with pytest.raises(
        ArgumentError, match="rest is for one model; load each part with its own rest positions"
    ):
        octex.convert_set({"a": tetrahedron()}, rest=tetrahedron().rest)
    with pytest.raises(ArgumentError, match="a texture set needs at least one part"):
        octex.convert_set({})


def test_a_part_that_cannot_be_converted_is_named():
    near = octex.Transfer(tetrahedron(), distance=0.1)
    points, triangles = together((TETRAHEDRON, FACES), (TETRAHEDRON + np.array([9.0, 0, 0]), FACES))
    surface = Surface.from_arrays(points, triangles, name="two").with_sources(near.sources)
    with pytest.raises(ModelError, match=r"two \(part-1\): its source has no value anywhere on it"):
        octex.convert_set(surface, 3)


@needs_jit
def test_a_real_model_in_parts_looks_as_it_is(models):
    surface = octex.load_surface(models / "BoomBoxWithAxes/BoomBoxWithAxes.gltf", channels=["base_color"])
    found = octex.convert_set(surface, 6)
    assert len(found) == surface.parts.max() + 1 > 1
    samples = surface.scatter(20_000)
    values = found.sample(samples.rest, surface.parts[samples.triangles])
    whole = octex.convert(surface, 6).sample(samples.rest)
    wanted = surface.evaluate(samples)
    assert np.abs(values - wanted).mean() < np.abs(whole - wanted).mean()
