"""glTF and GLB against an independent reader: what is shown, where, and with which images and normal maps."""

import base64
import hashlib
import json
import shutil
import struct

import numpy as np
import pytest

from octex.errors import ModelError
from octex.source.load import load_surface
from tests.make.agreement import assert_agrees
from tests.make.fixtures import (
    CLAMP,
    MIRROR,
    NEAREST,
    REPEAT,
    SQUARE,
    SQUARE_TRIANGLES,
    SQUARE_UV,
    Gltf,
    png,
    random_image,
    saved,
    textured_square,
)


def test_transforms_apply_down_the_tree_and_meshes_may_be_shown_often(tmp_path):
    gltf = Gltf()
    material = gltf.material(gltf.texture(gltf.image(png(random_image(4, 4)))))
    mesh = gltf.add("meshes", primitives=[gltf.primitive(uv=SQUARE_UV, material=material)])
    half = 0.5**0.5
    leaf = gltf.add("nodes", mesh=mesh, rotation=[0, half, 0, half], translation=[1, 2, 3])
    camera = gltf.add("nodes", camera=0, children=[leaf], scale=[2, 3, 4])
    matrix = [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]
    root = gltf.add("nodes", children=[camera, gltf.add("nodes", mesh=mesh)], matrix=matrix)
    gltf.json["scenes"][0]["nodes"] += [root, gltf.add("nodes", mesh=mesh, scale=[-1, 1, 0.5])]
    surface = assert_agrees(gltf.save(tmp_path / "a.gltf"))
    assert len(surface.triangles) == 6


def test_instances_of_the_extension_are_placed(tmp_path):
    gltf = Gltf()
    node = gltf.show(gltf.primitive(), translation=[0, 0, 10])
    places = np.array([[1, 0, 0], [5, 0, 0]], np.float32)
    sizes = np.array([[1, 1, 1], [2, 2, 2]], np.float32)
    gltf.json["nodes"][node]["extensions"] = {
        "EXT_mesh_gpu_instancing": {
            "attributes": {"TRANSLATION": gltf.accessor(places), "SCALE": gltf.accessor(sizes)}
        }
    }
    gltf.json["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    surface = load_surface(gltf.save(tmp_path / "a.glb"))
    assert len(surface.triangles) == 4
    np.testing.assert_allclose(surface.bounds, [[1, 0, 10], [7, 2, 10]])


def test_hidden_nodes_and_those_below_them_are_not_shown(tmp_path):
    gltf = Gltf()
    mesh = gltf.add("meshes", primitives=[gltf.primitive()])
    low = gltf.add("nodes", mesh=mesh)
    below = gltf.add("nodes", mesh=mesh, children=[low])
    hidden = {"KHR_node_visibility": {"visible": False}}
    nodes = [
        gltf.add("nodes", mesh=mesh, children=[below], extensions=hidden),
        gltf.add("nodes", mesh=mesh, translation=[0, 0, 5], extensions={"KHR_node_visibility": {}}),
    ]
    gltf.json["scenes"][0]["nodes"] += nodes
    gltf.json["extensionsRequired"] = ["KHR_node_visibility"]
    surface = load_surface(gltf.save(tmp_path / "a.glb"))
    np.testing.assert_array_equal(surface.bounds, [[0, 0, 5], [1, 1, 5]])
    gltf.json["nodes"][nodes[0]]["children"] = 1
    with pytest.raises(ModelError, match=rf"nodes\[{nodes[0]}\]: children must be a list of indices"):
        load_surface(gltf.save(tmp_path / "b.glb"))


@pytest.mark.parametrize("mode", [4, 5, 6])
@pytest.mark.parametrize("indexed", [True, False])
def test_lists_strips_and_fans_become_triangles(tmp_path, mode, indexed):
    ring = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 2, 0], [0, 1, 0]], np.float32)
    zigzag = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0], [1, 2, 0]], np.float32)
    positions = ring if mode == 6 else zigzag
    gltf = Gltf()
    indices = np.arange(len(positions), dtype=np.uint32) if indexed else None
    colors = np.linspace(0, 1, 3 * len(positions), dtype=np.float32).reshape(-1, 3)
    gltf.show(gltf.primitive(positions, indices, colors=colors, mode=mode))
    surface = assert_agrees(gltf.save(tmp_path / "a.glb"))
    if mode != 4:
        np.testing.assert_allclose(surface.scatter(20).normals, [[0, 0, 1]] * 20)


def test_primitives_without_triangles_are_passed_over(tmp_path):
    gltf = Gltf()
    empty = gltf.primitive(triangles=np.empty((0, 3), np.uint16))
    gltf.show(empty, gltf.primitive(mode=0), gltf.primitive(mode=1), gltf.primitive())
    assert len(load_surface(gltf.save(tmp_path / "a.glb")).triangles) == 2


@pytest.mark.parametrize("on_zeros", [False, True])
def test_sparse_accessors_are_filled_in(tmp_path, on_zeros):
    gltf = Gltf()
    entry = gltf.primitive()
    accessor = gltf.json["accessors"][entry["attributes"]["POSITION"]]
    rows, values = (np.array([1, 2, 3], np.uint16), SQUARE[1:]) if on_zeros else (
        np.array([2], np.uint8), np.array([4, 4, 0], np.float32)
    )  # fmt: skip
    if on_zeros:
        del accessor["bufferView"]
    accessor["sparse"] = {
        "count": len(rows),
        "indices": {"bufferView": gltf.view(rows.tobytes()), "componentType": 5123 if on_zeros else 5121},
        "values": {"bufferView": gltf.view(values.tobytes())},
    }
    gltf.show(entry)
    assert assert_agrees(gltf.save(tmp_path / "a.glb")).bounds[1, 0] == (1 if on_zeros else 4)


def test_interleaved_attributes_are_read_by_their_stride(tmp_path):
    gltf = Gltf()
    material = gltf.material(gltf.texture(gltf.image(png(random_image(4, 4)))))
    view = gltf.view(np.hstack([SQUARE, SQUARE_UV]).astype(np.float32).tobytes(), stride=20)
    shared = {"bufferView": view, "componentType": 5126, "count": 4}
    attributes = {
        "POSITION": gltf.add("accessors", type="VEC3", byteOffset=0, **shared),
        "TEXCOORD_0": gltf.add("accessors", type="VEC2", byteOffset=12, **shared),
    }
    indices = gltf.accessor(SQUARE_TRIANGLES.reshape(-1))
    gltf.show({"attributes": attributes, "indices": indices, "material": material})
    assert_agrees(gltf.save(tmp_path / "a.glb"))


def test_quantized_positions_are_read_as_the_numbers_they_are(tmp_path):
    gltf = Gltf()
    entry = gltf.primitive((SQUARE * 7).astype(np.int8))
    gltf.json["extensionsRequired"] = ["KHR_mesh_quantization"]
    gltf.show(entry, scale=[0.5, 0.5, 0.5])
    np.testing.assert_allclose(assert_agrees(gltf.save(tmp_path / "a.glb")).bounds[1], [3.5, 3.5, 0])


def test_without_scenes_the_roots_of_the_nodes_are_shown(tmp_path):
    gltf = Gltf()
    node = gltf.show(gltf.primitive())
    gltf.add("nodes", children=[node], scale=[3, 3, 3])
    del gltf.json["scenes"], gltf.json["scene"]
    surface = load_surface(gltf.save(tmp_path / "a.glb"))
    assert len(surface.triangles) == 2
    assert surface.bounds[1, 0] == 3


def test_what_the_file_says_of_its_origin_is_kept(tmp_path):
    gltf = Gltf()
    extras = {"license": "CC-BY-4.0", "author": "Somebody", "licence": 7, "title": "A"}
    gltf.json["asset"] |= {"copyright": "2002 Somebody", "generator": "by hand", "extras": extras}
    gltf.show(gltf.primitive())
    provenance = load_surface(gltf.save(tmp_path / "a.glb")).provenance
    assert len(provenance["sha256"]) == 64
    assert provenance.items() >= {
        "source": "a.glb", "copyright": "2002 Somebody", "generator": "by hand", "license": "CC-BY-4.0",
        "author": "Somebody",
    }.items()  # fmt: skip
    gltf.json["asset"]["extras"] = "none"
    assert "license" not in load_surface(gltf.save(tmp_path / "a.glb")).provenance


def test_the_digest_of_each_other_file_that_was_read_is_kept_by_its_name_there(tmp_path):
    (tmp_path / "maps").mkdir()
    image = png(random_image(4, 4))
    (tmp_path / "maps" / "a b.png").write_bytes(image)
    gltf = Gltf()
    gltf.texture(gltf.add("images", uri="maps/a%20b.png"))
    gltf.texture(gltf.add("images", uri="data:image/png;base64," + base64.b64encode(image).decode()))
    material = gltf.material(0, occlusionTexture={"index": 1}, emissiveTexture={"index": 0})
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=material))
    path = gltf.save(tmp_path / "a.gltf", external=True)
    expected = {
        "a%20buffer.bin": hashlib.sha256((tmp_path / "a buffer.bin").read_bytes()).hexdigest(),
        "maps/a%20b.png": hashlib.sha256(image).hexdigest(),
    }
    assert json.loads(load_surface(path).provenance["files"]) == expected
    few = load_surface(path, channels=["occlusion"]).provenance["files"]
    assert list(json.loads(few)) == ["a%20buffer.bin"]
    assert "files" not in load_surface(gltf.save(tmp_path / "a.glb"), channels=["occlusion"]).provenance


def test_chunks_of_unknown_kinds_are_passed_over(tmp_path):
    path = textured_square(tmp_path / "a.glb", png(random_image(4, 4)))
    data = path.read_bytes()
    at = 20 + struct.unpack_from("<I", data, 12)[0]
    data = data[:at] + struct.pack("<I4s", 4, b"ACME") + b"more" + data[at:]
    path.write_bytes(data[:8] + struct.pack("<I", len(data)) + data[12:])
    assert len(load_surface(path).triangles) == 2


def test_a_rest_mesh_lends_its_positions_and_needs_no_images(tmp_path):
    posed = textured_square(tmp_path / "posed.glb", png(random_image(4, 4)))
    gltf = Gltf()
    image = gltf.add("images", uri="not there.png")
    gltf.show(gltf.primitive(SQUARE * 3, uv=SQUARE_UV, material=gltf.material(gltf.texture(image))))
    rest = gltf.save(tmp_path / "rest.gltf")
    surface = load_surface(posed, rest=rest)
    np.testing.assert_allclose(surface.rest, surface.vertices * 3)
    assert surface.provenance["rest"] == "rest.gltf"
    assert surface.provenance["rest_sha256"] == hashlib.sha256(rest.read_bytes()).hexdigest()
    np.testing.assert_allclose(surface.bounds[1], [3, 3, 0])
    samples = surface.scatter(20)
    np.testing.assert_allclose(samples.rest, samples.points * 3)
    np.testing.assert_array_equal(surface.evaluate(samples), load_surface(posed).evaluate(samples))


def test_a_rest_mesh_of_another_topology_is_refused(tmp_path):
    posed = textured_square(tmp_path / "posed.glb", png(random_image(4, 4)))
    for number, triangles in enumerate((SQUARE_TRIANGLES[:1], SQUARE_TRIANGLES[::-1])):
        gltf = Gltf()
        gltf.show(gltf.primitive(triangles=triangles))
        rest = gltf.save(tmp_path / f"rest{number}.glb")
        with pytest.raises(ModelError, match=r"the rest mesh of posed\.glb: the topology differs"):
            load_surface(posed, rest=rest)
    with pytest.raises(ModelError, match="3 rest positions for 4 vertices"):
        load_surface(posed, rest=np.zeros((3, 3)))


def test_compressed_content_with_a_plain_copy_beside_it_is_read(tmp_path):
    gltf = Gltf()
    texture = gltf.add(
        "textures",
        source=gltf.image(png(random_image(4, 4))),
        extensions={"KHR_texture_basisu": {"source": 9}},
    )
    entry = gltf.primitive(uv=SQUARE_UV, material=gltf.material(texture))
    entry["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {}}}
    for view in gltf.json["bufferViews"]:
        view["extensions"] = {"EXT_meshopt_compression": {}}
    gltf.show(entry)
    assert_agrees(gltf.save(tmp_path / "a.gltf"))


@pytest.mark.parametrize("sampler", [{}, {"wrap": (REPEAT, REPEAT), "minify": NEAREST}])
def test_a_texture_repeats_and_is_linear_without_a_sampler_that_says_otherwise(tmp_path, sampler):
    image = png(random_image(4, 4))
    assert_agrees(textured_square(tmp_path / "a.glb", image, scale=3.0, shift=-1.0, **sampler))


def test_coordinates_may_be_normalized_integers(tmp_path):
    gltf = Gltf()
    material = gltf.material(gltf.texture(gltf.image(png(random_image(4, 4))), wrap=(CLAMP, CLAMP)))
    gltf.show(gltf.primitive(uv=(SQUARE_UV * 65535).astype(np.uint16), material=material))
    gltf.show(gltf.primitive(uv=(SQUARE_UV * 255).astype(np.uint8), material=material), translation=[2, 0, 0])
    assert_agrees(gltf.save(tmp_path / "a.glb"))


def test_several_materials_images_and_primitives_keep_their_own(tmp_path):
    gltf = Gltf()
    images = [gltf.image(png(random_image(3 + i, 4, seed=i))) for i in range(2)]
    materials = [
        gltf.material(gltf.texture(images[0], wrap=(CLAMP, MIRROR)), factor=(1, 0.5, 1, 1)),
        gltf.material(gltf.texture(images[1], mag=NEAREST)),
        gltf.material(gltf.texture(images[0], wrap=(REPEAT, REPEAT))),
        gltf.material(factor=(0.1, 0.2, 0.3, 1)),
        None,
    ]
    shapes = [
        gltf.primitive(SQUARE + np.float32([0, 0, i]), uv=SQUARE_UV * 2 - np.float32(0.5), material=material)
        for i, material in enumerate(materials)
    ]
    gltf.show(*shapes[:2])
    gltf.show(*shapes[2:])
    assert_agrees(gltf.save(tmp_path / "a.glb"), 300)


def test_a_quarter_turn_of_the_transform_is_the_example_of_the_extension(tmp_path):
    # The lower left quadrant of the image, turned clockwise.
    texels = np.zeros((2, 2, 3), np.uint8)
    texels[1, 0] = 255
    change = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}
    gltf = Gltf()
    info = {
        "index": gltf.texture(gltf.image(png(texels)), mag=NEAREST),
        "extensions": {"KHR_texture_transform": change},
    }
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.material(info)))
    gltf.json["extensionsRequired"] = ["KHR_texture_transform"]
    surface = load_surface(gltf.save(tmp_path / "a.glb"))
    assert (surface.evaluate(surface.scatter(50)) == 1).all()


def test_webp_images_are_read(tmp_path):
    gltf = Gltf()
    image = gltf.image(saved(random_image(4, 4), "WEBP", lossless=True), "image/webp")
    texture = gltf.add("textures", extensions={"EXT_texture_webp": {"source": image}})
    gltf.json["extensionsRequired"] = ["EXT_texture_webp"]
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.material(texture)))
    assert_agrees(gltf.save(tmp_path / "a.glb"))


def test_buffers_and_images_may_lie_in_files_with_blanks_and_in_other_folders(tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "a ü.png").write_bytes(png(random_image(4, 4)))
    assert_agrees(textured_square(tmp_path / "model" / "a.gltf", "../maps/a%20%C3%BC.png", external=True))


def test_a_name_with_a_percent_sign_is_found_as_it_stands(tmp_path):
    data = png(random_image(4, 4))
    (tmp_path / "50%25.png").write_bytes(data)
    paths = [textured_square(tmp_path / f"{n}.gltf", each) for n, each in enumerate(("50%25.png", data))]
    surfaces = [load_surface(path) for path in paths]
    samples = surfaces[0].scatter(100)
    values = [surface.evaluate(samples) for surface in surfaces]
    assert values[0].std() > 0.05
    np.testing.assert_array_equal(*values)


@pytest.mark.parametrize("style", ["base64", "base64 with line ends and no padding", "percent"])
def test_images_may_be_data_uris(tmp_path, style):
    data = png(random_image(4, 4))
    text = base64.b64encode(data).decode()
    uri = {
        "base64": f"data:image/png;base64,{text}",
        "percent": "data:image/png," + "".join(f"%{byte:02x}" for byte in data),
    }.get(style, f"data:image/png;base64,{text[:8]}\n{text[8:].rstrip('=')}")
    surface = load_surface(textured_square(tmp_path / "a.gltf", uri))
    assert surface.evaluate(surface.scatter(100)).std() > 0.05


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
