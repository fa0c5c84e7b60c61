import json
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from safetensors.numpy import load_file, save_file

import octex
from octex import container
from octex.channels import ChannelFormat
from octex.errors import ArgumentError, TextureFileError
from octex.texture import Channel
from tests.conftest import needs_jit
from tests.make.same import assert_equal
from tests.make.small_textures import eight_colors, shell
from tests.make.strategies import textures


@given(texture=textures())
def test_a_saved_texture_opens_as_it_was(texture, tmp_path_factory):
    path = tmp_path_factory.mktemp("files") / "a.octex"
    texture.save(path)
    opened = octex.open(path)
    assert_equal(opened, texture)
    opened.validate()
    assert opened.info() == texture.info()
    assert path.stat().st_size == texture.info()["bytes"]["total"]


def test_a_texture_is_saved_under_its_own_ending_only(tmp_path):
    with pytest.raises(ArgumentError, match=r"a texture is saved as NAME\.octex"):
        eight_colors().save(tmp_path / "points.ply")
    assert not list(tmp_path.iterdir())


def test_a_texture_and_its_tree_introduce_themselves():
    assert repr(eight_colors()) == "<OctreeTexture of base_color; <Octree of depth 1: 8 leaves, 1 nodes>>"


def test_the_format_is_what_it_was(tmp_path):
    eight_colors().save(tmp_path / "a.octex")
    data = (tmp_path / "a.octex").read_bytes()
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    assert 8 + length == 4096
    assert header.pop("__metadata__") == {
        "format": "octex",
        "format_version": "1",
        "placement": '{"origin": [0.0, 0.0, 0.0], "size": 1.0}',
        "bounds": "[[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]",
        "channels": '{"base_color": "srgb"}',
        "provenance": '{"source": "eight"}',
    }
    assert {name: (entry["dtype"], entry["shape"]) for name, entry in header.items()} == {
        "tree/groups": ("U64", [1, 3]),
        "tree/level_cells": ("I64", [3]),
        "tree/level_nodes": ("I64", [3]),
        "tree/flags": ("U8", [9]),
        "tree/areas": ("U8", [9]),
        "channels/base_color": ("U8", [9, 3]),
    }
    assert data[4096:] == bytes.fromhex(
        "0000000000000000 ff00000000000000 0100000001000000"  # node masks, leaf masks, first children
        "0000000000000000 0100000000000000 0900000000000000"  # level_cells
        "0000000000000000 0100000000000000 0100000000000000"  # level_nodes
        "000000000000000000 000000000000000000"  # flags, areas
        "646464 000000 0a0a0a 141414 1e1e1e 282828 323232 3c3c3c 464646"
    )


def test_the_safetensors_library_reads_a_texture(tmp_path):
    texture = shell(3)
    texture.save(tmp_path / "a.octex")
    tensors = load_file(tmp_path / "a.octex")
    assert np.array_equal(tensors["tree/groups"], texture.tree.arrays.groups)
    assert np.array_equal(tensors["split/cells"], texture.tree.split.cells)
    assert np.array_equal(tensors["kept/cells"], texture.tree.kept.cells)
    values = texture.channels["base_color"]
    assert np.array_equal(tensors["channels/base_color"], values.values)
    assert np.array_equal(tensors["split/channels/base_color"], values.split_values)
    assert np.array_equal(tensors["kept/channels/base_color"], values.kept_values)


def test_unknown_tensors_and_metadata_are_kept(tmp_path):
    eight_colors().save(tmp_path / "a.octex")
    contents = container.read(tmp_path / "a.octex")
    extra = {"rest/vertices": np.arange(12.0).reshape(4, 3)}
    container.write(
        tmp_path / "b.octex", contents.tensors | extra, contents.metadata | {"painter": "Vermeer"}
    )
    texture = octex.open(tmp_path / "b.octex")
    texture.save(tmp_path / "c.octex")
    assert (tmp_path / "b.octex").read_bytes() == (tmp_path / "c.octex").read_bytes()
    assert texture.info()["bytes"]["other"] == 96


def test_info_says_where_the_bytes_go():
    info = eight_colors().info()
    assert json.loads(json.dumps(info)) == info
    assert info["bytes"] == {
        "header": 4096, "structure": 24 + 24 + 24, "flags": 9, "areas": 9, "split": 0, "kept": 0,
        "channel base_color": 27, "other": 0, "total": 4096 + 72 + 9 + 9 + 27,
    }  # fmt: skip
    assert info["levels"] == [{"level": 0, "leaves": 0, "nodes": 1}, {"level": 1, "leaves": 8, "nodes": 0}]
    assert info["finest_cell"] == 0.5
    assert info["provenance"] == {"source": "eight"}


def test_a_file_is_opened_by_its_metadata_not_by_its_name(tmp_path):
    save_file({"a": np.zeros(3)}, tmp_path / "a.octex")
    with pytest.raises(TextureFileError, match=r"a\.octex: is not an octree texture"):
        octex.open(tmp_path / "a.octex")


def changed(path, **changes):
    """Write a texture with other tensors or metadata; those that are None are left out."""
    eight_colors().save(path)
    contents = container.read(path)
    parts = [getattr(contents, part) | changes.get(part, {}) for part in ("tensors", "metadata")]
    container.write(path, *({key: each for key, each in part.items() if each is not None} for part in parts))
    return path


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("format_version", "2", r"format version '2', newer than this octex reads; update octex"),
        ("format_version", "12", "format version '12', newer"),
        ("format_version", None, "format version '', which is none: damaged, or made by something else"),
        ("format_version", "0", "format version '0', which is none"),
        ("format_version", "abc", "format version 'abc', which is none"),
        ("placement", None, "'placement' are missing or damaged"),
        ("placement", "{}", "'placement' are missing or damaged"),
        ("placement", '{"origin": [0, 0], "size": 1}', "'placement' are missing or damaged"),
        ("placement", '{"origin": [0, 0, [1]], "size": 1}', "'placement' are missing or damaged"),
        (
            "placement",
            '{"origin": [0, 0, 0], "size": 1' + "0" * 400 + "}",
            "'placement' are missing or damaged",
        ),
        ("placement", '{"origin": [0, 0, NaN], "size": 1}', "the root cell must have a size from 1e-15"),
        ("bounds", "[" * 9999, "'bounds' are missing or damaged"),
        ("bounds", '"all"', "'bounds' are missing or damaged"),
        ("bounds", "3", "two finite corners"),
        ("channels", '["base_color"]', "'channels' are missing or damaged"),
        ("channels", '{"base_color": 3}', "'channels' are missing or damaged"),
        ("channels", '{"base_color": "mauve"}', "unknown colour space"),
        ("channels", '{"roughness": "data"}', "lacks the tensor 'channels/roughness'"),
        ("provenance", "{", "'provenance' are missing or damaged"),
    ],
)
def test_damaged_metadata_are_refused_by_name(tmp_path, name, text, message):
    path = changed(tmp_path / "a.octex", metadata={name: text})
    with pytest.raises(TextureFileError, match=message) as error:
        octex.open(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("tree/flags", None, "lacks the tensor 'tree/flags'"),
        ("tree/flags", np.zeros(8, np.uint8), "flags must have shape"),
        ("tree/level_cells", np.array([0, 1, 8]), "flags must have shape"),
        ("channels/base_color", np.zeros((9, 3), np.uint32), "unknown dtype"),
        ("channels/base_color", np.zeros(9, np.uint8), r"shape \(9,\), not a row a cell"),
        ("channels/base_color", np.array(1, np.uint8), r"shape \(\), not a row a cell"),
        ("split/cells", np.zeros(1, np.uint32), "lacks the tensor 'split/facings'"),
        ("kept/cells", np.zeros(1, np.uint32), "lacks the tensor 'kept/channels/base_color'"),
        ("kept/cells", np.zeros(1, np.int64), "kept cells must be a C-ordered uint32"),
    ],
)
def test_missing_and_misshapen_tensors_are_refused_by_name(tmp_path, name, array, message):
    with pytest.raises(TextureFileError, match=message):
        octex.open(changed(tmp_path / "a.octex", tensors={name: array}))


def test_validate_names_the_file_and_the_channel(tmp_path):
    form = ChannelFormat("height", 1, "data", "float32")
    values = np.zeros((9, 1), np.float32)
    values[3] = np.nan
    texture = eight_colors(channels={"height": Channel(form, values, values[:0], values[:0])})
    with pytest.raises(TextureFileError, match=r"^channel 'height' has values that are not finite"):
        texture.validate()
    texture.save(tmp_path / "a.octex")
    with pytest.raises(TextureFileError, match=r"a\.octex: channel 'height'"):
        octex.open(tmp_path / "a.octex").validate()


@needs_jit
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_coarse_look_loads_few_pages_of_a_large_file(tmp_path):
    path = tmp_path / "large.octex"
    shell(8).save(path)
    assert path.stat().st_size > 3_000_000
    texture = octex.open(path)
    side = np.linspace(0.05, 0.95, 20)
    points = np.stack([*np.meshgrid(side, side), np.full((20, 20), 0.5)], -1).reshape(-1, 3)
    texture.level(4).sample(points)
    lines = iter(Path("/proc/self/smaps").read_text().splitlines())
    while not next(lines).endswith("large.octex"):
        pass
    resident = next(int(line.split()[1]) for line in lines if line.startswith("Rss:"))
    assert resident <= 512


def test_an_opened_file_describes_itself_without_reading_a_cell(tmp_path):
    path = tmp_path / "a.octex"
    shell(3).save(path)
    with path.open("r+b") as file:  # damage all cells
        file.seek(4096 + 24 * 20)
        file.write(b"\xff" * 100)
    texture = octex.open(path)
    assert texture.tree.n_leaves > 0 and texture.info()["leaves"] == texture.tree.n_leaves
