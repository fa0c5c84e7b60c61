"""Normal maps of glTF, from the tangent's frame to the model's space."""

import json
import shutil

import numpy as np
import pytest

from octex.source.load import load_surface
from tests.make.fixtures import SQUARE, SQUARE_UV, Gltf, png

# A normal map of one direction, leaning to the right and a little up.
CODES = (200, 150, 220)
UP = np.tile(np.float32([0, 0, 1]), (4, 1))


def leaning(scale=1.0):
    """The direction of CODES in the tangent's frame."""
    direction = (np.array(CODES) / 255 * 2 - 1) * (scale, scale, 1)
    return direction / np.linalg.norm(direction)


def mapped(gltf, **info):
    """A material with the normal map."""
    texture = gltf.texture(gltf.image(png(np.full((1, 1, 3), CODES, np.uint8))))
    return gltf.material(normalTexture={"index": texture} | info)


def square(gltf, material, *, uv=SQUARE_UV, normals=UP, tangents=None):
    attributes = {}
    if normals is not None:
        attributes["NORMAL"] = gltf.accessor(normals)
    if tangents is not None:
        attributes["TANGENT"] = gltf.accessor(tangents)
    return gltf.primitive(uv=uv.astype(np.float32), material=material, **attributes)


def along(*tangent):
    return np.tile(np.float32(tangent), (4, 1))


X, Y, Z = leaning()
TURNED = {"extensions": {"KHR_texture_transform": {"rotation": np.pi / 2}}}


@pytest.mark.parametrize(
    ("info", "options", "expected"),
    [
        # Without tangents x runs along u and y against v.
        ({}, {}, leaning()),
        # The scale stretches x and y before the length is made 1.
        ({"scale": -3.0}, {"normals": None}, leaning(-3.0)),
        # Where the image is mirrored, so is what it shows.
        ({}, {"uv": SQUARE_UV * (1, -1)}, leaning() * (1, -1, 1)),
        # Coordinates turned counter-clockwise show the image turned clockwise: its right is down.
        (TURNED, {}, [Y, -X, Z]),
        # Tangents of the file count with their handedness, but not without normals.
        *(({}, {"tangents": along(0, 1, 0, hand)}, [-hand * Y, X, Z]) for hand in (1, -1)),
        ({}, {"tangents": along(0, 1, 0, 1), "normals": None}, leaning()),
    ],
)
def test_a_normal_map_leans_in_the_frame_of_the_tangents(tmp_path, info, options, expected):
    gltf = Gltf()
    gltf.show(square(gltf, mapped(gltf, **info), **options))
    surface = load_surface(gltf.save(tmp_path / "a.glb"))
    found = surface.evaluate(surface.scatter(30), "normal")
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=2e-4)


def test_each_instance_of_a_mesh_has_normals_of_its_own(tmp_path):
    gltf = Gltf()
    half = 0.5**0.5
    first = gltf.show(square(gltf, mapped(gltf)))
    mesh = gltf.json["nodes"][first]["mesh"]
    second = gltf.add("nodes", mesh=mesh, rotation=[0, half, 0, half], translation=[5, 0, 0])
    third = gltf.add("nodes", mesh=mesh, scale=[-1, 1, 1], translation=[20, 0, 0])
    gltf.json["scenes"][0]["nodes"] += [second, third]
    surface = load_surface(gltf.save(tmp_path / "a.glb"))
    samples = surface.scatter(90)
    place = np.searchsorted([3, 10], samples.points[:, 0])
    expected = np.array([[X, Y, Z], [Z, Y, -X], [-X, Y, Z]])[place]
    np.testing.assert_allclose(surface.evaluate(samples, "normal"), expected, atol=2e-4)


def test_beside_a_normal_map_other_materials_give_their_shading_normals(tmp_path):
    gltf = Gltf()
    tilted = np.tile(np.float32([0.6, 0, 0.8]), (4, 1))
    plain = gltf.material(factor=(1, 0, 0, 1))
    gltf.show(square(gltf, mapped(gltf)))
    gltf.show(square(gltf, plain, normals=tilted), translation=[0, 0, 1])
    gltf.show(gltf.primitive(SQUARE[:, [2, 0, 1]]), translation=[0, 0, 5])
    surface = load_surface(gltf.save(tmp_path / "a.glb"))
    samples = surface.scatter(60)
    place = np.searchsorted([0.5, 3], samples.points[:, 2])
    expected = np.array([leaning(), [0.6, 0, 0.8], [1, 0, 0]])[place]
    np.testing.assert_allclose(surface.evaluate(samples, "normal"), expected, atol=2e-4)


def test_a_normal_map_that_is_not_wanted_is_not_read(tmp_path):
    gltf = Gltf()
    material = gltf.material(normalTexture={"index": gltf.add("textures", source=7)})
    entry = square(gltf, material)
    entry["attributes"]["NORMAL"] = 99
    gltf.show(entry)
    surface = load_surface(gltf.save(tmp_path / "a.glb"), channels=["base_color"])
    assert [channel.name for channel in surface.channels] == ["base_color"]


@pytest.mark.parametrize("name", ["Avocado/Avocado.gltf", "BoomBoxWithAxes/BoomBoxWithAxes.gltf"])
def test_tangents_made_for_real_models_are_close_to_those_that_they_have(tmp_path, models, name):
    path = models / name
    document = json.loads(path.read_text())
    for each in [*document["buffers"], *document["images"]]:
        shutil.copy(path.parent / each["uri"], tmp_path)
    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            del primitive["attributes"]["TANGENT"]
    (tmp_path / "without.gltf").write_text(json.dumps(document))
    given, made = (load_surface(p, channels=["normal"]) for p in (path, tmp_path / "without.gltf"))
    samples = given.scatter(2000)
    cosines = (given.evaluate(samples, "normal") * made.evaluate(samples, "normal")).sum(axis=1)
    degrees = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    assert np.percentile(degrees, 95) < 1
