"""glTF content in Draco's, meshopt's and Basis Universal's codes against the same content in plain bytes."""

import base64
import json
import sys

import numpy as np
import pytest

from octex.errors import ImageError, MissingExtraError, ModelError
from octex.source.images.decode import decode_image
from octex.source.load import load_surface
from tests.make.fixtures import SQUARE, Gltf, png, put, random_image
from tests.make.refusal import refused

# Images of 12 × 8 texels in blocks of 4 × 4, by basis_universal's encoder.
BLOCKS = np.array(
    [
        [[200, 40, 60, 255], [30, 180, 90, 128], [20, 60, 220, 255]],
        [[240, 240, 240, 255], [90, 90, 90, 0], [250, 200, 20, 64]],
    ]
)
KTX2 = {
    "etc1s": (
        "q0tUWCAyMLsNChoKAAAAAAEAAAAMAAAACAAAAAAAAAAAAAAAAQAAAAEAAAABAAAAaAAAADwAAACkAAAAJAAAAMgAAAAAAAAA"
        "qQAAAAAAAABxAQAAAAAAAAgAAAAAAAAAAAAAAAAAAAA8AAAAAAAAAAIAOACjAQIAAwMAAAgIAAAAAAAAAAA/AAAAAAAAAAAA"
        "/////0AAPw8AAAAAAAAAAP////8fAAAAS1RYd3JpdGVyAEJhc2lzIFVuaXZlcnNhbCAyLjUwAAAKAAQAQAAAABEAAAAwAAAA"
        "AAAAAAAAAAAAAAAABAAAAAQAAAAEAAAAGUAcAAEAACCY8uxRyiMDiAMgAAAABLs9mpJgAFEABAAABmFfPgzEIAIwAUAAAAAI"
        "AC0F2n1dNf9uqvrJcgAAAAQAAACoqqqq+v///1dVVVUFAMFEAAAAAAAA8l8phQIwBWAAAAAQhPnkMAHeNgwAAACJUyqNQAAw"
        "AQAAAAAAgAACZ2iEDq5WwwA="
    ),
    "uastc": (
        "q0tUWCAyMLsNChoKAAAAAAEAAAAMAAAACAAAAAAAAAAAAAAAAQAAAAEAAAACAAAAaAAAACwAAACUAAAAJAAAAAAAAAAAAAAA"
        "AAAAAAAAAAC4AAAAAAAAAEgAAAAAAAAAYAAAAAAAAAAsAAAAAAAAAAIAKACmAQIAAwMAABAAAAAAAAAAAAB/AwAAAAAAAAAA"
        "/////x8AAABLVFh3cml0ZXIAQmFzaXMgVW5pdmVyc2FsIDIuNTAAACi1L/0gYP0BAOQCFxmF5z+1owDXg1YLMDO4AZeCh/u/"
        "MMsDFx4e/h90zgFXS0sLQCylAB+ZAmj6eQYosOMBEG4fFI6TD9eTCw=="
    ),
}
RNG = np.random.default_rng(1)
GRID = np.stack([*np.meshgrid(np.arange(6), np.arange(5)), np.zeros((5, 6))], axis=-1).reshape(-1, 3)
CORNERS = np.array([0, 1, 7, 0, 7, 6])
FIRST = np.array([6 * y + x for y in range(4) for x in range(5)])
TRIANGLES = (FIRST[:, None] + CORNERS).reshape(-1, 3).astype(np.uint16)
NORMALS = RNG.normal(size=(30, 3)) * 0.2 + [0, 0, 1]
TANGENTS = np.cross(NORMALS, [0, 1, 0])
ATTRIBUTES = {
    "POSITION": (GRID + RNG.uniform(-0.3, 0.3, GRID.shape)).astype(np.float32),
    "NORMAL": (NORMALS / np.linalg.norm(NORMALS, axis=1)[:, None]).astype(np.float32),
    "TANGENT": np.c_[TANGENTS / np.linalg.norm(TANGENTS, axis=1)[:, None], np.ones(30)].astype(np.float32),
    "TEXCOORD_0": RNG.uniform(-1, 2, (30, 2)).astype(np.float32),
    "TEXCOORD_1": RNG.uniform(0, 1, (30, 2)).astype(np.float32),
    "COLOR_0": RNG.integers(0, 256, (30, 4), dtype=np.uint8),
}


def grid(change=None):
    """A grid with every attribute that octex reads, some of it changed."""
    gltf = Gltf()
    textures = [gltf.texture(gltf.image(png(random_image(8, 8, seed=seed)))) for seed in range(3)]
    material = gltf.material(
        textures[0],
        alphaMode="BLEND",
        normalTexture={"index": textures[1]},
        occlusionTexture={"index": textures[2], "texCoord": 1},
    )
    attributes = {name: gltf.accessor(rows, rows.dtype == np.uint8) for name, rows in ATTRIBUTES.items()}
    entry = {"attributes": attributes, "indices": gltf.accessor(TRIANGLES.reshape(-1)), "material": material}
    gltf.show(entry)
    if change is not None:
        change(gltf, entry)
    return gltf


def draco(gltf, entry, *, required=True):
    """Code a primitive by Draco; its accessors have no content left."""
    coder = pytest.importorskip("DracoPy", reason="the extra octex[draco] is not installed")
    data = coder.encode(
        ATTRIBUTES["POSITION"],
        TRIANGLES.astype(np.uint32),
        quantization_bits=24,  # 30 take two seconds
        preserve_order=True,
        colors=ATTRIBUTES["COLOR_0"],
        tex_coord=ATTRIBUTES["TEXCOORD_0"].astype(np.float64),
        normals=ATTRIBUTES["NORMAL"].astype(np.float64),
        generic_attributes={7: ATTRIBUTES["TEXCOORD_1"], 9: ATTRIBUTES["TANGENT"]},
    )
    kinds = {each["attribute_type"]: each["unique_id"] for each in coder.decode(data).attributes}
    kind = coder.AttributeType
    numbers = {
        "POSITION": kinds[kind.POSITION],
        "NORMAL": kinds[kind.NORMAL],
        "TEXCOORD_0": kinds[kind.TEX_COORD],
        "COLOR_0": kinds[kind.COLOR],
        "TEXCOORD_1": 7,
        "TANGENT": 9,
    }
    coded = {"bufferView": gltf.view(data), "attributes": numbers}
    entry["extensions"] = {"KHR_draco_mesh_compression": coded}
    gltf.json["extensionsUsed"] = ["KHR_draco_mesh_compression"]
    if required:
        gltf.json["extensionsRequired"] = gltf.json["extensionsUsed"]
        for number in [*entry["attributes"].values(), entry["indices"]]:
            del gltf.json["accessors"][number]["bufferView"]


def meshopt(path, version=0, name="EXT_meshopt_compression", indices="TRIANGLES"):
    """Code the buffer views of the grid by meshopt, into a file whose other buffer has no content."""
    coder = pytest.importorskip("meshopt", reason="the extra octex[meshopt] is not installed")
    gltf = grid()
    plain, gltf.binary = bytes(gltf.binary), bytearray()
    views, gltf.json["bufferViews"] = gltf.json["bufferViews"], []
    rows = {entry["bufferView"]: entry for entry in gltf.json["accessors"]}
    for number, view in enumerate(views):
        data = plain[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        if number not in rows:
            gltf.view(data)
            continue
        count = rows[number]["count"]
        mode = indices if rows[number]["type"] == "SCALAR" else "ATTRIBUTES"
        stored = np.frombuffer(data, np.uint16 if mode == indices else np.uint8)
        stored = stored if mode == indices else stored.reshape(count, -1)
        entry = gltf.json["bufferViews"][gltf.view(coder.encode_gltf_buffer(stored, mode, version))]
        coded = {**entry, "count": count, "mode": mode, "byteStride": len(data) // count}
        entry |= {"buffer": 1, "byteOffset": 0, "byteLength": len(data), "extensions": {name: coded}}
    gltf.json["extensionsRequired"] = [name]
    gltf.save(path)
    header = json.loads(path.read_text())
    header["buffers"].append({"byteLength": 10**6, "extensions": {name: {"fallback": True}}})
    path.write_text(json.dumps(header))
    return path


def assert_same(surface, expected, atol=1e-5):
    np.testing.assert_array_equal(surface.triangles, expected.triangles)
    np.testing.assert_allclose(surface.vertices, expected.vertices, atol=atol)
    assert surface.channels == expected.channels
    assert len(expected.channels) == 4
    points = expected.scatter(500, seed=0)
    for channel in expected.channels:
        np.testing.assert_allclose(
            surface.evaluate(points, channel.name), expected.evaluate(points, channel.name), atol=50 * atol
        )


def test_draco_meshes_are_as_the_plain_ones_also_beside_a_plain_one(tmp_path):
    coded, plain = grid(draco), grid()
    for each in (coded, plain):
        each.show(each.primitive(SQUARE))
    assert_same(load_surface(coded.save(tmp_path / "a.glb")), load_surface(plain.save(tmp_path / "b.glb")))


def test_draco_positions_may_be_quantized(tmp_path):
    coder = pytest.importorskip("DracoPy", reason="the extra octex[draco] is not installed")
    rows = np.rint(6000 * GRID).astype(np.int16)
    data = coder.encode(rows.astype(np.int32), TRIANGLES.astype(np.uint32), preserve_order=True)
    gltf = Gltf()
    accessor = gltf.accessor(rows, normalized=True)
    entry = {"attributes": {"POSITION": accessor}, "indices": gltf.accessor(TRIANGLES.ravel())}
    number = coder.decode(data).attributes[0]["unique_id"]
    coded = {"bufferView": gltf.view(data), "attributes": {"POSITION": number}}
    entry["extensions"] = {"KHR_draco_mesh_compression": coded}
    gltf.json["extensionsRequired"] = ["KHR_draco_mesh_compression", "KHR_mesh_quantization"]
    for each in (accessor, entry["indices"]):
        del gltf.json["accessors"][each]["bufferView"]
    gltf.show(entry)
    surface = load_surface(gltf.save(tmp_path / "a.glb"))
    np.testing.assert_allclose(surface.vertices, rows / 32767.0, atol=1e-6)


@pytest.mark.parametrize("version", [0, 1])
@pytest.mark.parametrize("name", ["EXT_meshopt_compression", "KHR_meshopt_compression"])
def test_meshopt_buffers_are_as_the_plain_ones(tmp_path, name, version):
    coded = load_surface(meshopt(tmp_path / "coded.gltf", version, name, "INDICES"))
    assert_same(coded, load_surface(grid().save(tmp_path / "plain.glb")), 0.0)


def test_triangles_by_meshopt_keep_their_order_and_the_way_they_wind(tmp_path):
    coded = load_surface(meshopt(tmp_path / "coded.gltf")).triangles
    turns = (np.arange(3) + coded.argmin(axis=1)[:, None]) % 3
    lowest_first = np.take_along_axis(coded, turns, axis=1)
    np.testing.assert_array_equal(lowest_first, TRIANGLES)


def test_meshopt_filters_are_undone(tmp_path):
    coder = pytest.importorskip("meshopt", reason="the extra octex[meshopt] is not installed")
    gltf = grid()
    entry = gltf.json["meshes"][0]["primitives"][0]
    filtered = {
        "POSITION": ("EXPONENTIAL", coder.encode_filter_exp(ATTRIBUTES["POSITION"], 20), None),
        "NORMAL": ("OCTAHEDRAL", coder.encode_filter_oct(np.c_[ATTRIBUTES["NORMAL"], np.ones(30)], 8, 16), 8),
    }
    for semantic, (name, rows, stride) in filtered.items():
        accessor = gltf.json["accessors"][entry["attributes"][semantic]]
        if stride:
            accessor |= {"componentType": 5122, "normalized": True}
            del accessor["min"], accessor["max"]
        number = gltf.view(coder.encode_gltf_buffer(rows, "ATTRIBUTES"), stride)
        view = gltf.json["bufferViews"][number]
        coded = {**view, "count": 30, "byteStride": rows.shape[1], "mode": "ATTRIBUTES", "filter": name}
        view |= {"byteOffset": 0, "byteLength": rows.nbytes, "extensions": {"EXT_meshopt_compression": coded}}
        accessor["bufferView"] = number
    gltf.json["extensionsRequired"] = ["EXT_meshopt_compression"]
    assert_same(
        load_surface(gltf.save(tmp_path / "a.glb")), load_surface(grid().save(tmp_path / "b.glb")), 2e-4
    )


def test_plain_content_beside_coded_is_read_without_the_extra(tmp_path, monkeypatch):
    path = grid(lambda gltf, entry: draco(gltf, entry, required=False)).save(tmp_path / "a.glb")
    expected = load_surface(grid().save(tmp_path / "plain.glb"))
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    assert_same(load_surface(path), expected, 0.0)


@pytest.mark.parametrize("code", KTX2)
def test_ktx2_images_are_read(code):
    pytest.importorskip("opengl_basisu", reason="the extra octex[ktx2] is not installed")
    texels = decode_image(base64.b64decode(KTX2[code]), "a.ktx2")
    expected = BLOCKS.repeat(4, axis=0).repeat(4, axis=1)
    np.testing.assert_allclose(texels / 257, expected, atol=2)


def ktx2(gltf, entry):
    """Give the grid's base colour an image of KTX2 alone."""
    image = gltf.image(base64.b64decode(KTX2["uastc"]), "image/ktx2")
    gltf.json["textures"][0] = {"extensions": {"KHR_texture_basisu": {"source": image}}}
    gltf.json["extensionsRequired"] = ["KHR_texture_basisu"]
    gltf.json["materials"][entry["material"]]["alphaMode"] = "OPAQUE"


def test_textures_of_ktx2_alone_are_read_and_others_are_taken_before_them(tmp_path):
    pytest.importorskip("opengl_basisu", reason="the extra octex[ktx2] is not installed")
    gltf = grid(ktx2)
    surface = load_surface(gltf.save(tmp_path / "a.glb"))
    image = png(BLOCKS[..., :3].repeat(4, axis=0).repeat(4, axis=1).astype(np.uint8))
    gltf.json["textures"][0]["source"] = gltf.image(image)
    gltf.json["images"][3] = {"uri": "none.ktx2"}
    other = load_surface(gltf.save(tmp_path / "b.glb"))
    points = surface.scatter(300)
    np.testing.assert_allclose(surface.evaluate(points), other.evaluate(points), atol=1e-4)


MISSING = {
    "DracoPy": ("draco", lambda path: grid(draco).save(path)),
    "meshopt": ("meshopt", lambda path: meshopt(path.with_suffix(".gltf"))),
    "opengl_basisu": ("ktx2", lambda path: grid(ktx2).save(path)),
}


@pytest.mark.parametrize("package", MISSING)
def test_a_missing_extra_is_named_with_the_command_that_installs_it(tmp_path, monkeypatch, package):
    extra, make = MISSING[package]
    path = make(tmp_path / "a.glb")
    monkeypatch.setitem(sys.modules, package, None)
    with refused(MissingExtraError, rf"needed; install it: pip install 'octex\[{extra}\]'", path.name):
        load_surface(path)


def half_of_it(gltf):
    """Return the first half of what a Draco mesh is decoded from."""
    extensions = gltf.json["meshes"][0]["primitives"][0]["extensions"]
    view = gltf.json["bufferViews"][extensions["KHR_draco_mesh_compression"]["bufferView"]]
    return gltf.view(bytes(gltf.binary[view["byteOffset"] :][: view["byteLength"] // 2]))


def points_alone(gltf):
    coder = pytest.importorskip("DracoPy", reason="the extra octex[draco] is not installed")
    return gltf.view(coder.encode(ATTRIBUTES["POSITION"]))


def color_of(gltf):
    extensions = gltf.json["meshes"][0]["primitives"][0]["extensions"]
    return int(extensions["KHR_draco_mesh_compression"]["attributes"]["COLOR_0"])


DRACO = "meshes.0.primitives.0.extensions.KHR_draco_mesh_compression"
MESHOPT = "bufferViews.3.extensions.EXT_meshopt_compression"


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (f"{DRACO}.bufferView", half_of_it, r"primitives\[0\]: its Draco content is damaged"),
        (f"{DRACO}.bufferView", lambda gltf: gltf.view(b""), "its Draco content is damaged"),
        (f"{DRACO}.attributes.NORMAL", 77, "no attribute 77, for NORMAL"),
        (f"{DRACO}.attributes.NORMAL", color_of, "does not fit what was decoded for it, uint8"),
        (f"{DRACO}.bufferView", points_alone, "its Draco content has no triangles"),
        (f"{DRACO}.attributes", [0], r"attributes must be an object, not \[0\]"),
        (f"{MESHOPT}.byteLength", 40, r"bufferViews\[3\]: its meshopt content is damaged"),
        (f"{MESHOPT}.byteOffset", 10**6, r"bufferViews\[3\] reaches outside its buffer"),
        (f"{MESHOPT}.count", 10**9, "bytes of meshopt content cannot hold 1000000000 rows of 12"),
        (f"{MESHOPT}.count", 3, "(damaged|reaches outside its buffer view)"),
        (f"{MESHOPT}.byteStride", 7, "its meshopt content is damaged .*4 to 256 bytes"),
        (f"{MESHOPT}.filter", "BLUR", "its meshopt content is damaged .*filter must be"),
        (f"{MESHOPT}.mode", 7, "its meshopt content is damaged .*mode must be"),
        (MESHOPT, 1, "EXT_meshopt_compression must be an object, not 1"),
    ],
)
def test_damaged_content_is_refused_in_one_line_that_names_it(tmp_path, place, value, message):
    if place.startswith(DRACO):
        gltf = grid(draco)
        put(gltf.json, {place: value}, gltf)
        path = gltf.save(tmp_path / "bad.glb")
    else:
        path = meshopt(tmp_path / "bad.gltf")
        header = json.loads(path.read_text())
        put(header, {place: value})
        path.write_text(json.dumps(header))
    with refused(ModelError, f"^{path.name}.*{message}"):
        load_surface(path)


@pytest.mark.parametrize("code", KTX2)
def test_damaged_ktx2_images_are_refused_in_one_line_that_names_them(code):
    for module in ("opengl_basisu", "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"):
        pytest.importorskip(module, reason="the extra octex[ktx2] is not installed")
    data = base64.b64decode(KTX2[code])
    large = data[:20] + (16000).to_bytes(4, "little") * 2 + data[28:]
    plain = data[:12] + (43).to_bytes(4, "little") + data[16:]
    for each, message in (
        (data[:-20], "cannot be read as an image"),
        (data[:90], "cannot be read as an image"),
        (large, "16000 × 16000 texels|cannot be read"),
        (plain, "vkFormat 43"),
        (data[:96] + (2**27).to_bytes(8, "little") + data[104:], "too many bytes|not a valid"),
    ):
        with refused(ImageError, message, "wood.ktx2"):
            decode_image(each, "wood.ktx2")
