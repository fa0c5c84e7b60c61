"""glTF files that are refused, each in one line."""

import json
import struct

import numpy as np
import pytest

from octex.errors import ImageError, ModelError, ModelWarning
from octex.source.load import load_surface
from tests.make.fixtures import MISSING, SQUARE, SQUARE_UV, Gltf, png, put, random_image, rows
from tests.make.refusal import refused

PRIMITIVE = "meshes.0.primitives.0"
ATTRIBUTES = f"{PRIMITIVE}.attributes"


def textured():
    """A square with an image; its first accessor and its second view are of the positions."""
    gltf = Gltf()
    material = gltf.material(gltf.texture(gltf.image(png(random_image(4, 4)))))
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=material))
    return gltf


def broken(changes, path):
    gltf = textured()
    put(gltf.json, changes, gltf)
    return gltf.save(path)


def assert_refused(path, message):
    with refused(ModelError, message, path.name):
        load_surface(path)


_NAN = np.where(SQUARE == 1, np.float32(np.nan), SQUARE)
_SIGNALLING = np.where(SQUARE == 1, np.uint32(0x7FA00000), SQUARE.view(np.uint32)).view(np.float32)

RESTART = {
    f"{ATTRIBUTES}.POSITION": rows(*np.repeat(SQUARE, 64, axis=0)),
    f"{PRIMITIVE}.indices": rows(0, 100, 255, dtype="uint8"),
}


def sparse_outside(gltf):
    where = {"bufferView": gltf.view(b"\x63"), "componentType": 5121}
    values = {"bufferView": gltf.view(bytes(12))}
    return {"count": 1, "indices": where, "values": values}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({f"{PRIMITIVE}.indices": rows(0, 1, 9, dtype="uint8")}, "uses vertex 9, but there are 4"),
        ({f"{PRIMITIVE}.indices": rows(0, 1, -1, dtype="int8")}, "uses vertex -1, but there are 4"),
        ({f"{PRIMITIVE}.indices": rows(0, 1, 2)}, r"the indices of meshes\[0\].* are not integers"),
        (RESTART, "uses vertex 255, but uint8 indices keep this number"),
        (
            {f"{ATTRIBUTES}.POSITION": lambda gltf: gltf.accessor(_NAN)},
            "vertices that are not finite; .*--repair",
        ),
        ({f"{ATTRIBUTES}.POSITION": lambda gltf: gltf.accessor(_SIGNALLING)}, "vertices that are not finite"),
        ({f"{ATTRIBUTES}.COLOR_0": rows(*[[np.nan] * 3] * 4)}, "colours are not all finite"),
        ({"materials.0.pbrMetallicRoughness.baseColorFactor": [1e999, 1, 1, 1]}, "Infinity is not JSON"),
        ({"nodes.0.scale": [1e200, 1, 1]}, "not all finite"),
        ({"nodes.0.rotation": [1e308, 1e308, 0, 1], "nodes.0.scale": [1e308, -1e308, 1]}, "not all finite"),
        ({"nodes.0.scale": 0.5}, r"nodes\[0\]: scale must be 3 numbers, not 0\.5"),
        ({f"{ATTRIBUTES}.TEXCOORD_0": rows(*[[np.inf] * 2] * 4)}, "texture coordinates are not all finite"),
        ({"nodes.0.children": [0]}, "reached twice"),
        ({"nodes.0.mesh": 7}, r"meshes\[7\]"),
        ({f"{PRIMITIVE}.mode": 0}, "no triangles"),
        ({"bufferViews.0.byteLength": 10**6}, "outside its buffer"),
        ({"accessors.0.count": 1000}, "outside its buffer view"),
        ({"accessors.0.bufferView": MISSING, "accessors.0.count": 10**12}, "elements without data"),
        ({"accessors.0.sparse": sparse_outside}, "sparse indices outside"),
        ({"accessors.0.type": "VEC2"}, "type VEC2"),
        ({"accessors.0.componentType": 1}, "malformed .1 is missing or unknown"),
        ({"materials.0.alphaMode": "GLASS"}, "unknown alphaMode 'GLASS'"),
        ({"textures.0.sampler": lambda gltf: gltf.add("samplers", wrapS=1)}, "unknown wrapS 1"),
        ({"textures.0.source": MISSING}, r"textures\[0\] names no image"),
        ({"extensionsRequired": ["ACME_magic"]}, "requires the glTF extension ACME_magic"),
        ({"asset.version": "1.0"}, "is glTF 1.0"),
        ({"asset.minVersion": "2.1"}, "needs glTF 2.1; octex reads glTF 2.0"),
        ({"asset": MISSING}, "has no asset"),
        ({"nodes": "three"}, "nodes must be a list, not 'three'"),
        ({"meshes.0.primitives": {"not": "an array"}}, r"primitives\[0\] must be an object, not 'not'"),
    ],
)
def test_a_bad_model_is_refused_in_one_line_that_names_it(tmp_path, changes, message):
    assert_refused(broken(changes, tmp_path / "bad.glb"), message)


def with_long_chunk(data):
    at = 20 + struct.unpack_from("<I", data, 12)[0]
    return data[:at] + struct.pack("<I", 10**6) + data[at + 4 :]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data[:-20], "truncated"),
        (lambda data: data[:15], "truncated"),
        (lambda data: data[:4] + struct.pack("<I", 1) + data[8:], "GLB version 1"),
        (lambda data: data[:16] + b"BIN\0" + data[20:], "first chunk is not JSON"),
        (with_long_chunk, "binary chunk ends early"),
        (lambda _: b"", "is empty"),
        (lambda _: png(random_image(2, 2)), "neither GLB nor JSON"),
        (lambda _: b'{"asset": NaN}', "NaN is not JSON"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line_that_names_it(tmp_path, damage, message):
    path = textured().save(tmp_path / "bad.glb")
    path.write_bytes(damage(path.read_bytes()))
    assert_refused(path, message)


def test_buffers_that_are_not_there_are_named(tmp_path):
    path, buffer = tmp_path / "bad.gltf", tmp_path / "a buffer.bin"
    textured().save(path, external=True)
    buffer.write_bytes(b"12")
    assert_refused(path, r"buffers\[0\] is truncated")
    buffer.unlink()
    assert_refused(path, "a%20buffer.bin: No such file")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"buffers": [{"byteLength": 4}]}))
    assert_refused(path, r"buffers\[0\] has no data")


@pytest.mark.parametrize(
    ("image", "message"),
    [
        ({"uri": "wood.png"}, "wood.png: No such file or directory; put it next to the model, or read only"),
        ({"uri": "/dev/zero"}, "/dev/zero: absolute paths are not followed; name it from"),
        ({"uri": "%2Fdev%2Fzero"}, "absolute paths are not followed"),
        ({"uri": "C:\\wood.png"}, "absolute paths are not followed"),
        ({"uri": "../../../../../../../../../../dev/zero"}, "it is a pipe or a device, not a file"),
        ({}, "neither a uri nor a bufferView"),
        ({"bufferView": 1}, "not an image"),
        ({"uri": "https://example.org/wood.png"}, "download it first"),
        ({"uri": "data:image/png;base64"}, "data: URI without data"),
        ({"uri": "data:image/png;base64,!!!"}, "not valid base64"),
    ],
)
def test_a_bad_image_is_named(tmp_path, image, message):
    with refused(ImageError, message, "bad.glb", "images[0]"):
        load_surface(broken({"images.0": image}, tmp_path / "bad.glb"))


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("pbrMetallicRoughness", ["x"], "pbrMetallicRoughness must be an object, not"),
        ("pbrMetallicRoughness.baseColorFactor", [1, 1, 1], "baseColorFactor must be 4 numbers"),
        ("pbrMetallicRoughness.baseColorFactor", 0.5, "baseColorFactor must be 4 numbers, not 0.5"),
        ("pbrMetallicRoughness.metallicFactor", "shiny", "metallicFactor must be a number, not 'shiny'"),
        ("pbrMetallicRoughness.roughnessFactor", 10**400, "roughnessFactor must be a number, not 1000"),
        ("pbrMetallicRoughness.baseColorTexture", 0, "baseColorTexture must be an object, not 0"),
        ("pbrMetallicRoughness.baseColorTexture", {}, r"refers to textures\[None\]"),
        ("normalTexture.scale", "not a number", r"normalTexture.scale must be a number, not 'not a number'"),
        ("occlusionTexture.strength", None, "occlusionTexture.strength must be a number, not None"),
        ("occlusionTexture.index", 5, r"refers to textures\[5\]"),
        ("emissiveFactor", {}, "emissiveFactor must be 3 numbers"),
        ("extensions.KHR_materials_emissive_strength.emissiveStrength", [], "emissiveStrength must be a"),
        ("extensions.KHR_materials_pbrSpecularGlossiness.glossinessFactor", "a", "glossinessFactor must be"),
        ("extensions.KHR_materials_pbrSpecularGlossiness.specularFactor", [1], "specularFactor must be 3"),
        ("extensions", "none", r"materials\[0\].extensions must be an object, not 'none'"),
        ("alphaCutoff", "half", "alphaCutoff must be a number"),
        ("occlusionTexture.texCoord", -1, "texCoord must be a whole number, not -1"),
        ("occlusionTexture.extensions.KHR_texture_transform", "turned", "transform must be an object"),
        ("occlusionTexture.extensions.KHR_texture_transform.rotation", "left", "rotation must be a number"),
        ("occlusionTexture.extensions.KHR_texture_transform.scale", 2, "scale must be 2 numbers, not 2"),
    ],
)
def test_what_is_wrong_with_a_material_is_named(tmp_path, place, value, message):
    gltf = Gltf()
    gltf.texture(gltf.image(png(random_image(4, 4))))
    entry = {"occlusionTexture": {"index": 0}, "emissiveFactor": [1, 1, 1]}
    put(entry, {place: value})
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.add("materials", **entry)))
    with pytest.raises(ModelError, match=f"^bad.glb.*{message}") as caught:
        load_surface(gltf.save(tmp_path / "bad.glb"))
    assert len(str(caught.value)) < 250


def test_textured_meshes_without_coordinates_read_one_texel(tmp_path):
    gltf = Gltf()
    gltf.show(gltf.primitive(material=gltf.material(gltf.texture(gltf.image(png(random_image(4, 4)))))))
    with pytest.warns(ModelWarning, match="no TEXCOORD_0, so they read one texel"):
        surface = load_surface(gltf.save(tmp_path / "a.glb"))
    found = surface.evaluate(surface.scatter(20))
    np.testing.assert_allclose(found, np.repeat(found[:1], 20, axis=0), atol=1e-6)


@pytest.mark.parametrize("name", ["NORMAL", "TANGENT", "TEXCOORD_0", "TEXCOORD_1", "COLOR_0"])
def test_an_attribute_must_have_a_row_for_each_vertex(tmp_path, name):
    gltf = Gltf()
    gltf.texture(gltf.image(png(random_image(4, 4))))
    material = gltf.material(
        normalTexture={"index": 0}, occlusionTexture={"index": 0, "texCoord": 1}, texture=0
    )
    widths = {"NORMAL": 3, "TANGENT": 4, "TEXCOORD_0": 2, "TEXCOORD_1": 2, "COLOR_0": 3}
    attributes = {
        each: gltf.accessor(np.ones((3 if each == name else 4, width), np.float32))
        for each, width in widths.items()
    }
    gltf.show(gltf.primitive(material=material, **attributes))
    with pytest.raises(ModelError, match=rf"primitives\[0\] {name} has 3 rows for 4 vertices"):
        load_surface(gltf.save(tmp_path / "bad.glb"))
