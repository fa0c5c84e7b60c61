"""glTF and GLB against an independent reader: what is shown, and where."""

import base64
import hashlib
import json
import struct

import numpy as np
import pytest

from octex.errors import ModelError
from octex.source.load import load_surface
from tests.make.agreement import assert_agrees
from tests.make.fixtures import SQUARE, SQUARE_TRIANGLES, SQUARE_UV, Gltf, png, random_image, textured_square


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
