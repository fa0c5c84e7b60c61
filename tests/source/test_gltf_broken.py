"""glTF files that are refused, each in one line."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octex.errors import ImageError, ModelError, ModelWarning
from octex.source.load import load_surface
from tests.make.fixtures import (
    SQUARE,
    SQUARE_UV,
    Gltf,
    png,
    random_image,
)


def broken(change: str, tmp_path: Path) -> Path:
    """A model with one thing wrong."""
    gltf = Gltf()
    texture = gltf.texture(gltf.image(png(random_image(4, 4))))
    material = gltf.material(texture)
    entry = gltf.primitive(uv=SQUARE_UV, material=material)
    node = gltf.show(entry)
    attributes = entry["attributes"]
    accessors, views = gltf.json["accessors"], gltf.json["bufferViews"]
    position = accessors[attributes["POSITION"]]
    path = tmp_path / "bad.glb"
    if change == "vertex out of range":
        entry["indices"] = gltf.accessor(np.array([0, 1, 9], np.uint8))
    elif change == "negative index":
        entry["indices"] = gltf.accessor(np.array([0, 1, -1], np.int8))
    elif change == "fractional index":
        entry["indices"] = gltf.accessor(np.array([0, 1, 2], np.float32))
    elif change == "restart":
        attributes["POSITION"] = gltf.accessor(np.repeat(SQUARE, 64, axis=0))
        entry["indices"] = gltf.accessor(np.array([0, 100, 255], np.uint8))
    elif change == "not finite":
        attributes["POSITION"] = gltf.accessor(np.where(SQUARE == 1, np.float32(np.nan), SQUARE))
    elif change == "signalling":
        bits = np.where(SQUARE == 1, np.uint32(0x7FA00000), SQUARE.view(np.uint32))
        attributes["POSITION"] = gltf.accessor(bits.view(np.float32))
    elif change == "colours not finite":
        attributes["COLOR_0"] = gltf.accessor(np.full((4, 3), np.nan, np.float32))
    elif change == "factor not finite":
        gltf.json["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [1e999, 1, 1, 1]
    elif change == "beyond all bounds":
        gltf.json["nodes"][node]["scale"] = [1e200, 1, 1]
    elif change == "boundless by boundless":
        gltf.json["nodes"][node] |= {"rotation": [1e308, 1e308, 0, 1], "scale": [1e308, -1e308, 1]}
    elif change == "scale of one number":
        gltf.json["nodes"][node]["scale"] = 0.5
    elif change == "translation of one number":
        gltf.json["nodes"][node]["translation"] = True
    elif change == "infinite transform":
        gltf.json["nodes"][node]["scale"] = [1e999, 1, 1]
    elif change == "coordinates not finite":
        attributes["TEXCOORD_0"] = gltf.accessor(np.full((4, 2), np.inf, np.float32))
    elif change == "few coordinates":
        attributes["TEXCOORD_0"] = gltf.accessor(SQUARE_UV[:2])
    elif change == "node cycle":
        gltf.json["nodes"][node]["children"] = [node]
    elif change == "no such mesh":
        gltf.json["nodes"][node]["mesh"] = 7
    elif change == "points only":
        entry["mode"] = 0
    elif change == "nothing shown":
        gltf.json["scenes"] = [{}]
    elif change == "view outside buffer":
        views[0]["byteLength"] = 10**6
    elif change == "accessor outside view":
        position["count"] = 1000
    elif change == "zeros without end":
        del position["bufferView"]
        position["count"] = 10**12
    elif change == "sparse index":
        where = {"bufferView": gltf.view(b"\x63"), "componentType": 5121}
        values = {"bufferView": gltf.view(bytes(12))}
        position["sparse"] = {"count": 1, "indices": where, "values": values}
    elif change == "wrong type":
        position["type"] = "VEC2"
    elif change == "unknown component":
        position["componentType"] = 1
    elif change == "alpha mode":
        gltf.json["materials"][0]["alphaMode"] = "GLASS"
    elif change == "wrap":
        gltf.json["textures"][0]["sampler"] = gltf.add("samplers", wrapS=1)
    elif change == "texture without image":
        del gltf.json["textures"][0]["source"]
    elif change == "unknown extension":
        gltf.json["extensionsRequired"] = ["ACME_magic"]
    elif change == "image missing":
        gltf.json["images"][0] = {"uri": "wood.png"}
    elif change.startswith("image at "):
        gltf.json["images"][0] = {"uri": change.removeprefix("image at ")}
    elif change == "image nowhere":
        gltf.json["images"][0] = {}
    elif change == "image broken":
        gltf.json["images"][0] = {"bufferView": 1}
    elif change == "image on the web":
        gltf.json["images"][0] = {"uri": "https://example.org/wood.png"}
    elif change == "image uri without data":
        gltf.json["images"][0] = {"uri": "data:image/png;base64"}
    elif change == "image not base64":
        gltf.json["images"][0] = {"uri": "data:image/png;base64,!!!"}
    elif change == "no buffer":
        path = tmp_path / "bad.gltf"
        gltf.save(path)
        header = json.loads(path.read_text())
        header["buffers"] = [{"byteLength": 4}]
        path.write_text(json.dumps(header))
        return path
    elif change == "buffer missing":
        path = tmp_path / "bad.gltf"
        gltf.save(path, external=True)
        (tmp_path / "a buffer.bin").unlink()
        return path
    elif change == "buffer truncated":
        path = tmp_path / "bad.gltf"
        gltf.save(path, external=True)
        (tmp_path / "a buffer.bin").write_bytes(b"12")
        return path
    elif change == "glTF 1":
        gltf.json["asset"]["version"] = "1.0"
    elif change == "later glTF":
        gltf.json["asset"]["minVersion"] = "2.1"
    elif change == "no asset":
        del gltf.json["asset"]
    elif change == "types":
        gltf.json["nodes"] = "three"
    else:
        data = bytearray(gltf.save(path).read_bytes())
        if change == "truncated":
            data = data[:-20]
        elif change == "header only":
            data = data[:15]
        elif change == "GLB 1":
            struct.pack_into("<I", data, 4, 1)
        elif change == "first chunk":
            data[16:20] = b"BIN\0"
        elif change == "binary chunk":
            at = 20 + struct.unpack_from("<I", data, 12)[0]
            struct.pack_into("<I", data, at, 10**6)
        elif change == "empty":
            data = bytearray()
        elif change == "another type":
            data = bytearray(png(random_image(2, 2)))
        elif change == "not JSON":
            data = bytearray(b'{"asset": NaN}')
        path.write_bytes(data)
        return path
    return gltf.save(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("vertex out of range", "uses vertex 9, but there are 4"),
        ("negative index", "uses vertex -1, but there are 4"),
        ("fractional index", r"the indices of meshes\[0\].* are not integers"),
        ("restart", "uses vertex 255, but uint8 indices keep this number"),
        ("not finite", "vertices that are not finite"),
        ("signalling", "vertices that are not finite"),
        ("colours not finite", "colours are not all finite"),
        ("factor not finite", "Infinity is not JSON|colours are not all finite"),
        ("beyond all bounds", "not all finite"),
        ("boundless by boundless", "not all finite"),
        ("scale of one number", r"nodes\[0\]: scale must be 3 numbers, not 0\.5"),
        ("translation of one number", r"nodes\[0\]: translation must be 3 numbers"),
        ("infinite transform", "Infinity is not JSON|not all finite"),
        ("coordinates not finite", "texture coordinates are not all finite"),
        ("few coordinates", "has 2 rows for 4 vertices"),
        ("node cycle", "reached twice"),
        ("no such mesh", r"meshes\[7\]"),
        ("points only", "no triangles"),
        ("nothing shown", "no triangles"),
        ("view outside buffer", "outside its buffer"),
        ("accessor outside view", "outside its buffer view"),
        ("zeros without end", "elements without data"),
        ("sparse index", "sparse indices outside"),
        ("wrong type", "type VEC2"),
        ("unknown component", "malformed .1 is missing or unknown"),
        ("alpha mode", "unknown alphaMode 'GLASS'"),
        ("wrap", "unknown wrapS 1"),
        ("texture without image", r"textures\[0\] names no image"),
        ("unknown extension", "requires the glTF extension ACME_magic"),
        ("no buffer", r"buffers\[0\] has no data"),
        ("buffer missing", "a%20buffer.bin: No such file"),
        ("buffer truncated", r"buffers\[0\] is truncated"),
        ("glTF 1", "is glTF 1.0"),
        ("later glTF", "needs glTF 2.1; octex reads glTF 2.0"),
        ("no asset", "has no asset"),
        ("types", "nodes must be a list, not 'three'"),
        ("truncated", "truncated"),
        ("header only", "truncated"),
        ("GLB 1", "GLB version 1"),
        ("first chunk", "first chunk is not JSON"),
        ("binary chunk", "binary chunk ends early"),
        ("empty", "is empty"),
        ("another type", "neither GLB nor JSON"),
        ("not JSON", "NaN is not JSON"),
    ],
)
def test_a_bad_model_is_refused_in_one_line_that_names_it(tmp_path: Path, change: str, message: str) -> None:
    path = broken(change, tmp_path)
    with pytest.raises(ModelError, match=message) as caught:
        load_surface(path)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("image missing", "wood.png: No such file"),
        ("image at /dev/zero", "/dev/zero: absolute paths are not followed; name it from"),
        ("image at %2Fdev%2Fzero", "absolute paths are not followed"),
        ("image at C:\\wood.png", "absolute paths are not followed"),
        ("image at ../../../../../../../../../../dev/zero", "it is a pipe or a device, not a file"),
        ("image nowhere", "neither a uri nor a bufferView"),
        ("image broken", "not an image"),
        ("image on the web", "download it first"),
        ("image uri without data", "data: URI without data"),
        ("image not base64", "not valid base64"),
    ],
)
def test_a_bad_image_is_named(tmp_path: Path, change: str, message: str) -> None:
    with pytest.raises(ImageError, match=message) as caught:
        load_surface(broken(change, tmp_path))
    assert "bad.glb" in str(caught.value)
    assert "images[0]" in str(caught.value)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("pbrMetallicRoughness", ["x"], "pbrMetallicRoughness must be an object, not"),
        ("pbrMetallicRoughness.baseColorFactor", [1, 1, 1], "baseColorFactor must be 4 numbers"),
        ("pbrMetallicRoughness.baseColorFactor", [1, 1, 1, "a"], "baseColorFactor must be 4 numbers"),
        ("pbrMetallicRoughness.baseColorFactor", 0.5, "baseColorFactor must be 4 numbers, not 0.5"),
        ("pbrMetallicRoughness.metallicFactor", "shiny", "metallicFactor must be a number, not 'shiny'"),
        ("pbrMetallicRoughness.roughnessFactor", True, "roughnessFactor must be a number, not True"),
        ("pbrMetallicRoughness.roughnessFactor", 10**400, "roughnessFactor must be a number, not 1000"),
        ("pbrMetallicRoughness.baseColorTexture", 0, "baseColorTexture must be an object, not 0"),
        ("pbrMetallicRoughness.baseColorTexture", {}, r"refers to textures\[None\]"),
        ("normalTexture.scale", "not a number", r"normalTexture.scale must be a number, not 'not a number'"),
        ("occlusionTexture.strength", None, "occlusionTexture.strength must be a number, not None"),
        ("occlusionTexture.index", 5, r"refers to textures\[5\]"),
        ("occlusionTexture.index", "first", r"refers to textures\['first'\]"),
        ("emissiveFactor", {}, "emissiveFactor must be 3 numbers"),
        ("extensions.KHR_materials_emissive_strength.emissiveStrength", [], "emissiveStrength must be a"),
        ("extensions.KHR_materials_pbrSpecularGlossiness.glossinessFactor", "a", "glossinessFactor must be"),
        ("extensions.KHR_materials_pbrSpecularGlossiness.specularFactor", [1], "specularFactor must be 3"),
        ("extensions", "none", r"materials\[0\].extensions must be an object, not 'none'"),
        ("alphaCutoff", "half", "alphaCutoff must be a number"),
        ("occlusionTexture.texCoord", -1, "texCoord must be a whole number, not -1"),
        ("occlusionTexture.texCoord", 0.5, "texCoord must be a whole number, not 0.5"),
        ("occlusionTexture.extensions.KHR_texture_transform", "turned", "transform must be an object"),
        ("occlusionTexture.extensions.KHR_texture_transform.rotation", "left", "rotation must be a number"),
        ("occlusionTexture.extensions.KHR_texture_transform.scale", 2, "scale must be 2 numbers, not 2"),
        ("occlusionTexture.extensions.KHR_texture_transform.offset", [1], "offset must be 2 numbers"),
    ],
)
def test_what_is_wrong_with_a_material_is_named(tmp_path: Path, place: str, value: Any, message: str) -> None:
    gltf = Gltf()
    gltf.texture(gltf.image(png(random_image(4, 4))))
    entry: dict[str, Any] = {"occlusionTexture": {"index": 0}, "emissiveFactor": [1, 1, 1]}
    *holders, key = place.split(".")
    holder = entry
    for each in holders:
        holder = holder.setdefault(each, {})
    holder[key] = value
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.add("materials", **entry)))
    with pytest.raises(ModelError, match=message) as caught:
        load_surface(gltf.save(tmp_path / "bad.glb"))
    assert str(caught.value).startswith("bad.glb")
    assert len(str(caught.value)) < 250


def test_textured_meshes_without_coordinates_read_one_texel(tmp_path: Path) -> None:
    gltf = Gltf()
    gltf.show(gltf.primitive(material=gltf.material(gltf.texture(gltf.image(png(random_image(4, 4)))))))
    with pytest.warns(ModelWarning, match="of meshes without TEXCOORD_0, which read one texel"):
        surface = load_surface(gltf.save(tmp_path / "a.glb"))
    found = surface.evaluate(surface.scatter(20))
    np.testing.assert_allclose(found, np.repeat(found[:1], 20, axis=0), atol=1e-6)


@pytest.mark.parametrize("name", ["NORMAL", "TANGENT", "TEXCOORD_0", "TEXCOORD_1", "COLOR_0"])
def test_an_attribute_must_have_a_row_for_each_vertex(tmp_path: Path, name: str) -> None:
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


def test_primitives_must_be_objects(tmp_path: Path) -> None:
    gltf = Gltf()
    gltf.show(gltf.primitive())
    gltf.json["meshes"][0]["primitives"] = {"not": "an array"}
    with pytest.raises(ModelError, match=r"meshes\[0\].primitives\[0\] must be an object, not 'not'"):
        load_surface(gltf.save(tmp_path / "bad.glb"))
