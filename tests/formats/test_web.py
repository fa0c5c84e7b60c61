"""Web files, and glTF models that carry them, are read back as the textures that they were made of."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import octex
from octex.cli.main import main
from octex.errors import ArgumentError, OctexError, TextureFileError
from octex.formats.web import texture_file
from octex.processing.mapping import cast
from octex.tree.children import node_cells
from octex.tree.layout import FACING_FLAGS
from tests.conftest import needs_jit
from tests.make.painted import ball
from tests.make.same import assert_same
from tests.make.small_textures import eight_colors, shell
from tests.oracles.web_file import WebFile

EXTENSION = Path(octex.__file__).parent / "formats" / "EXT_octree_texture"


def waves(p):
    return 0.5 + 0.4 * np.sin(p * [19.0, 13.0, 7.0])


def colored():
    return ball(24).with_sources({"base_color": waves, "roughness": lambda p: waves(p)[:, :1]})


def with_leaf_areas_of(texture, other):
    """A texture with another's areas of leaves and of split cells' rows, which web files do not store."""
    areas = other.tree.arrays.areas.copy()
    if texture.tree.arrays.level_nodes[-1]:
        nodes = node_cells(texture.tree.arrays)
        areas[nodes] = texture.tree.arrays.areas[nodes]
    split = texture.tree.split._replace(areas=other.tree.split.areas)
    tree = type(texture.tree)(texture.tree.arrays._replace(areas=areas), split, texture.tree.kept)
    return texture.with_cells(tree, texture.channels)


@pytest.mark.parametrize("depth", [*range(6), pytest.param("several", marks=needs_jit)])
def test_a_texture_comes_back_from_its_web_file(depth, tmp_path):
    if depth == "several":
        texture = octex.convert(colored(), depth=5, max_error=8.0)
    else:
        texture = shell(depth) if depth else eight_colors().level(0)
    path, tree, arrays = tmp_path / "shell.octw", texture.tree, texture.tree.arrays
    path.write_bytes(texture_file(texture, "shell"))
    back = octex.open(path)
    back.validate()
    assert_same(with_leaf_areas_of(back, texture), texture)
    assert back.placement == texture.placement
    np.testing.assert_array_equal(back.bounds, texture.bounds)
    found = WebFile(path)
    assert (found.header["depth"], found.header["size"]) == (tree.max_depth, texture.placement.size)
    assert (len(found.parents), len(found.leaves())) == (tree.n_cells, tree.n_leaves)
    np.testing.assert_array_equal(np.array(found.flags) & FACING_FLAGS, arrays.flags & FACING_FLAGS)
    nodes = sorted(found.areas)
    np.testing.assert_array_equal([found.areas[cell] for cell in nodes], arrays.areas[nodes])
    for name, channel in texture.channels.items():
        np.testing.assert_array_equal(found.values[name], channel.values)


def test_leaves_share_what_their_node_leaves_of_its_area(tmp_path):
    texture = octex.convert(ball(24), depth=5, max_error=8.0)
    (tmp_path / "ball.octw").write_bytes(texture_file(texture, "ball"))
    back = octex.open(tmp_path / "ball.octw")
    leaves = back.tree.leaf_cells()
    sums = [
        np.sum(2.0 ** ((each.tree.arrays.areas[leaves] - 207.0) / 8) * 4.0 ** -level_of(each, leaves))
        for each in (back, texture)
    ]
    assert sums[0] == pytest.approx(sums[1], rel=0.05)


def level_of(texture, cells):
    return np.searchsorted(texture.tree.arrays.level_cells, cells, side="right") - 1


@needs_jit
def test_floats_come_back_in_their_range(tmp_path):
    surface = ball(16).with_sources({"base_color": waves, "emissive": lambda p: 2.0 + 2.0 * np.sin(5 * p)})
    texture = octex.convert(surface, depth=4, dtype={"emissive": "float32", "base_color": "uint16"})
    (tmp_path / "ball.octw").write_bytes(texture_file(texture, "ball"))
    back = octex.open(tmp_path / "ball.octw")
    points = surface.scatter(1000, seed=1).rest
    emitted = [each.sample(points, "emissive") for each in (back, texture)]
    assert emitted[1].max() > 2.0
    # A code of sRGB is at most 2.3 / 255 of the range in light.
    np.testing.assert_allclose(*emitted, atol=1.2 * 4.0 / 255)
    assert_same(
        with_leaf_areas_of(cast(back, channels=["base_color"]), texture),
        cast(texture, "uint8", channels=["base_color"]),
    )


@needs_jit
@pytest.mark.parametrize("ending", [".glb", ".gltf"])
@pytest.mark.parametrize("bake", [octex.bake_vertices, octex.bake])
def test_a_model_carries_its_octree(ending, bake, tmp_path):
    surface = colored()
    texture = octex.convert(surface, depth=5)
    options = {"texture_size": 64} if bake is octex.bake else {}
    path = (tmp_path / "ball").with_suffix(ending)
    written = octex.write_model(bake(texture, surface, **options), path, octree=texture)
    assert all(each.is_file() for each in written.files)
    assert (tmp_path / "ball.octw" in written.files) == (ending == ".gltf")
    assert_same(with_leaf_areas_of(octex.open(path), texture), texture)
    model = octex.load_surface(path)
    points = model.scatter(1000, seed=2)
    np.testing.assert_allclose(
        octex.open(path).sample(points.rest), texture.sample(model.scatter(1000, seed=2).rest), atol=1e-6
    )
    assert np.abs(model.evaluate(points) - texture.sample(points.rest)).mean() < 0.1  # the fallback


def document_of(path):
    content = path.read_bytes()
    return json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])


@needs_jit
def test_places_at_rest_are_those_of_the_root_cell(tmp_path):
    """Also of a posed model, and of one so far away that its node is moved."""
    surface = colored()
    texture = octex.convert(surface, depth=4)
    moved = surface.vertices * [2.0, 0.5, 1.0] + [300.0, 0.0, 0.0]
    posed = octex.Surface.from_arrays(moved, surface.triangles).with_rest(surface.vertices)
    octex.write_model(octex.bake_vertices(texture, posed), tmp_path / "posed.glb", octree=texture)
    document = document_of(tmp_path / "posed.glb")
    assert document["nodes"][0]["translation"][0] == pytest.approx(300.0, abs=3.0)
    read = octex.load_surface(tmp_path / "posed.glb")
    one, other = (each.scatter(2000, seed=3) for each in (read, posed))
    assert np.abs(np.sort(one.rest, axis=0) - np.sort(other.rest, axis=0)).max() < 1e-4
    np.testing.assert_allclose(read.bounds, posed.bounds, atol=1e-3)
    assert read.rest.max() < 1.1
    primitive = document["meshes"][0]["primitives"][0]["extensions"]["EXT_octree_texture"]
    translation = np.array(document["nodes"][0]["translation"])
    places = primitive["scale"] * (read.rest - translation) + primitive["offset"]
    np.testing.assert_allclose(places, texture.placement.to_texture_space(read.rest), atol=1e-5)


def test_the_command_writes_and_reads_it(tmp_path):
    surface = ball(12).with_sources({"base_color": waves})
    octex.convert(surface, depth=3).save(tmp_path / "ball.octex")
    octex.write_model(
        octex.bake_vertices(octex.open(tmp_path / "ball.octex"), surface), tmp_path / "ball.ply"
    )
    octex_file, model, glb, back = (
        str(tmp_path / name) for name in ("ball.octex", "ball.ply", "web.glb", "back.octex")
    )
    assert main(["bake", octex_file, model, glb, "--vertex-colors", "--octree", "--quiet"]) == 0
    assert main(["edit", glb, back, "--quiet"]) == 0
    assert_same(with_leaf_areas_of(octex.open(back), octex.open(octex_file)), octex.open(octex_file))
    assert main(["bake", octex_file, model, str(tmp_path / "web.ply"), "--octree", "--quiet"]) == 2


def test_models_of_other_formats_carry_none(tmp_path):
    texture, surface = eight_colors(), octex.Surface.from_arrays(np.eye(3), [[0, 1, 2]])
    with pytest.raises(ArgumentError, match=r"model\.obj cannot carry an octree; write a \.glb or \.gltf"):
        octex.write_model(octex.bake_vertices(texture, surface), tmp_path / "model.obj", octree=texture)
    baked = octex.bake_vertices(texture, surface)
    elsewhere = octex.Surface.from_arrays(np.eye(3) + 9, [[0, 1, 2]])
    with pytest.raises(ArgumentError, match="has no point in the texture"):
        octex.write_model(octex.bake_vertices(texture, elsewhere), tmp_path / "model.glb", octree=texture)
    octex.write_model(baked, tmp_path / "bare.glb")
    with pytest.raises(TextureFileError, match=r"bare\.glb: is a model without EXT_octree_texture; octex"):
        octex.open(tmp_path / "bare.glb")


def test_damaged_files_are_refused_in_words(tmp_path):
    whole = texture_file(shell(3), "shell")
    path = tmp_path / "shell.octw"
    length = 16 + int.from_bytes(whole[12:16], "little")
    header = json.loads(whole[16:length])

    def with_header(change):
        made = json.loads(json.dumps(header))
        change(made)
        text = json.dumps(made).encode()
        return whole[:12] + len(text).to_bytes(4, "little") + text + whole[length:]

    for content, complaint in (
        (whole[:8] + b"\x09" + whole[9:], "has version 9 of web files, and octex reads 1; update octex"),
        (whole[:12], "is damaged: no octex web file; write it again"),
        (whole[:-20], "ends too early: [0-9,]+ bytes are expected; copy it again"),
        (whole[:16] + b"?" + whole[17:], "is damaged, in header; write it again"),
        (whole[:-20] + bytes(20), "is damaged, in 0-levels-1; write it again"),
        (with_header(lambda each: each["parts"].append({})), "has 2 parts; write a file of one part's"),
        (with_header(lambda each: each["parts"][0].update(depth=30)), "is damaged, in header"),
        (with_header(lambda each: each["parts"][0]["levelCells"].__setitem__(2, 9999)), "is damaged, in"),
        (with_header(lambda each: each["parts"][0].update(size=-1.0)), "placement|edge|size"),
    ):
        path.write_bytes(content)
        with pytest.raises(TextureFileError, match=f"shell.octw: .*{complaint}"):
            octex.open(path)


def test_bytes_changed_at_random_are_read_or_refused(tmp_path):
    random, whole, path = np.random.default_rng(7), texture_file(shell(3), "shell"), tmp_path / "shell.octw"
    refused = 0
    for _ in range(300):
        content = bytearray(whole)
        for _ in range(random.integers(1, 4)):
            content[random.integers(len(content) if random.random() < 0.5 else 900)] = random.integers(256)
        path.write_bytes(content)
        try:
            texture = octex.open(path)
            texture.sample(random.random((10, 3)), list(texture.channels))
        except OctexError as error:
            assert "shell.octw" in str(error)
            refused += 1
    assert 100 < refused < 300


def test_the_schema_has_the_fields_that_are_written_and_the_readme_names_them(tmp_path):
    texture, surface = eight_colors(), octex.Surface.from_arrays(np.eye(3), [[0, 1, 2]])
    octex.write_model(octex.bake_vertices(texture, surface), tmp_path / "model.glb", octree=texture)
    document = document_of(tmp_path / "model.glb")
    assert document["extensionsUsed"] == ["EXT_octree_texture"] and "extensionsRequired" not in document
    carried = document["extensions"]["EXT_octree_texture"]
    primitive = document["meshes"][0]["primitives"][0]["extensions"]["EXT_octree_texture"]
    readme = (EXTENSION / "README.md").read_text()
    for name, found in (
        ("glTF.EXT_octree_texture", carried),
        ("octree", carried["octrees"][0]),
        ("mesh.primitive.EXT_octree_texture", primitive),
    ):
        schema = json.loads((EXTENSION / "schema" / f"{name}.schema.json").read_text())
        assert set(found) <= set(schema["properties"])
        assert set(schema.get("required", [])) <= set(found)
        assert f"schema/{name}.schema.json" in readme
        for field in schema["properties"].keys() - {"extensions", "extras"}:
            assert re.search(rf"\*\*{field}\*\*|`{field}`|\"{field}\"", readme), field


VALIDATE = """
const [, folder, ...paths] = process.argv, fs = require("fs"), path = require("path");
const { validateBytes } = require(folder);
const read = (name) => new Uint8Array(fs.readFileSync(name));
const all = paths.map((name) => validateBytes(read(name), {
  uri: name, externalResourceFunction: async (uri) => read(path.join(path.dirname(name), uri)),
}));
Promise.all(all).then((reports) => console.log(JSON.stringify(reports.map(({ issues }) => issues))));
"""


@needs_jit
def test_khronos_validator_has_no_errors(tmp_path):
    folder = Path(os.environ.get("OCTEX_TEST_THREE", "")).parent / "gltf-validator"
    if not folder.is_dir() or shutil.which("node") is None:
        pytest.skip("OCTEX_TEST_THREE names no package with gltf-validator beside it, or there is no node")
    surface = colored()
    texture = octex.convert(surface, depth=4)
    paths = [tmp_path / "one.glb", tmp_path / "two.gltf"]
    octex.write_model(octex.bake_vertices(texture, surface), paths[0], octree=texture)
    octex.write_model(octex.bake(texture, surface, texture_size=64), paths[1], octree=texture)
    command = ["node", "-e", VALIDATE, str(folder), *map(str, paths)]
    said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    for issues in json.loads(said.stdout):
        assert (issues["numErrors"], issues["numWarnings"]) == (0, 0)
        assert {each["code"] for each in issues["messages"]} <= {"UNSUPPORTED_EXTENSION", "UNUSED_OBJECT"}
