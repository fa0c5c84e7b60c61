from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load_file, save_file

import octex
from octex import channels as channel_meaning
from octex import container
from octex.channels import ALPHA, BASE_COLOR, NORMAL, ChannelFormat
from octex.errors import ArgumentError, InputError, OctexError, TextureFileError
from octex.texture import Channel, OctreeTexture
from octex.tree.morton import encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from tests import naive
from tests.conftest import needs_jit
from tests.strategies import textures, with_random_data

UNIT = Placement((0.0, 0.0, 0.0), 1.0)
UNIT_BOUNDS = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]


def eight_colors(**changes: Any) -> OctreeTexture:
    """Depth 1, eight leaves; the root's value is 100, leaf n's 10 n."""
    tree = Octree.from_leaves(np.arange(8), 1)
    values = np.array([[100] * 3, *([10 * n] * 3 for n in range(8))], np.uint8)
    arguments = {
        "tree": tree,
        "channels": {"base_color": Channel(BASE_COLOR, values, values[:0])},
        "placement": UNIT,
        "bounds": UNIT_BOUNDS,
        "metadata": {"source": "eight"},
    } | changes
    return OctreeTexture(**arguments)


def shell(depth: int) -> OctreeTexture:
    """A spherical shell of about 4 · 4^depth leaves, coloured at random."""
    random = np.random.default_rng(depth)
    directions = random.normal(size=(10 * 4**depth, 3))
    points = 0.5 + 0.45 * directions / np.linalg.norm(directions, axis=1)[:, None]
    codes = np.unique(encode_cells((points * 2**depth).astype(np.int64)))
    tree = with_random_data(Octree.from_leaves(codes, depth), depth)
    values = random.integers(0, 256, (tree.n_cells, 3), dtype=np.uint8)
    split_values = random.integers(0, 256, (tree.split.areas.size, 3), dtype=np.uint8)
    return OctreeTexture(tree, {"base_color": Channel(BASE_COLOR, values, split_values)}, UNIT, UNIT_BOUNDS)


def assert_same(a: OctreeTexture, b: OctreeTexture) -> None:
    for ours, theirs in zip((*a.tree.arrays, *a.tree.split), (*b.tree.arrays, *b.tree.split), strict=True):
        assert np.array_equal(ours, theirs)
    assert list(a.channels) == list(b.channels)
    for ours, theirs in zip(a.channels.values(), b.channels.values(), strict=True):
        assert ours.format == theirs.format
        assert np.array_equal(ours.values, theirs.values)
        assert np.array_equal(ours.split_values, theirs.split_values)
    assert a.placement == b.placement
    assert np.array_equal(a.bounds, b.bounds)
    assert dict(a.metadata) == dict(b.metadata)


# --- lookups


def normalized(vector: list[float]) -> list[float]:
    length = math.hypot(*vector)
    return [x / length for x in vector] if length else vector


@given(textures(), st.integers(0, 2**32 - 1))
def test_a_sample_is_the_decoded_value_of_the_nearest_cell(texture: OctreeTexture, seed: int) -> None:
    cells = [
        naive.Cell(level, naive.unmorton(code), not is_node)
        for level, (codes, nodes) in enumerate(texture.tree.walk())
        for code, is_node in zip(codes.tolist(), nodes.tolist(), strict=True)
    ]
    random = np.random.default_rng(seed)
    chosen = [cells[n] for n in random.integers(0, len(cells), 6)]
    inside = np.array([(np.array(cell.place) + random.random(3) * 1.5) / 2**cell.level for cell in chosen])
    points = texture.placement.to_rest(np.concatenate([inside, random.random((3, 3)) * 2 - 0.5]))
    numbers = [naive.nearest(cells, point) for point in texture.placement.to_texture_space(points).tolist()]
    samples = texture.sample(points, list(texture.channels), normalize=False)
    for name, (form, values, _) in texture.channels.items():
        expected = channel_meaning.decode(values[numbers], form.space)
        assert samples[name].dtype == np.float32
        assert np.array_equal(samples[name], expected)
        assert np.array_equal(texture.sample(points, name, normalize=False), expected)
        if form.space == "direction":
            expected = np.array([normalized(row) for row in expected.tolist()])
        assert np.allclose(texture.sample(points, name), expected, rtol=0, atol=1e-6)


def test_colours_come_back_in_linear_light() -> None:
    values = eight_colors().sample([[0.25, 0.25, 0.25], [0.75, 0.75, 0.75]])
    assert values[0].tolist() == [0.0] * 3
    assert values[1] == pytest.approx([naive.srgb_to_linear(70 / 255)] * 3)


def directed(values: list[list[float]], dtype: str) -> OctreeTexture:
    """Depth 1; the first leaves hold directions."""
    tree = Octree.from_leaves(np.arange(len(values)), 1)
    stored = channel_meaning.encode(np.array([[0.0, 0.0, 1.0], *values]), dtype, "direction")
    form = NORMAL._replace(dtype=dtype)
    return eight_colors(tree=tree, channels={"normal": Channel(form, stored, stored[:0])})


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float16", "float32"])
def test_directions_come_back_as_unit_vectors_unless_their_lengths_are_asked_for(dtype: str) -> None:
    texture = directed([[0.0, -0.3, 0.4], [-1.0, 0.0, 0.0]], dtype)
    points = [[0.1, 0.1, 0.1], [0.9, 0.1, 0.1]]
    precision = 0.01 if dtype == "uint8" else 1e-3
    assert np.allclose(texture.sample(points, "normal"), [[0, -0.6, 0.8], [-1, 0, 0]], atol=2 * precision)
    lengths = np.linalg.norm(texture.sample(points, ["normal"])["normal"], axis=1)
    assert np.allclose(lengths, 1, rtol=0, atol=1e-6)
    means = texture.sample(points, "normal", normalize=False)
    assert np.allclose(means, [[0, -0.3, 0.4], [-1, 0, 0]], atol=precision)


def test_a_direction_that_cancels_out_stays_zero() -> None:
    texture = directed([[0.0, 0.0, 0.0], [0.0, 0.0, -0.0], [1e-30, 0.0, 0.0]], "float32")
    points = [[0.1, 0.1, 0.1], [0.9, 0.1, 0.1], [0.1, 0.9, 0.1]]
    assert texture.sample(points, "normal").tolist() == [[0, 0, 0], [0, 0, 0], [1, 0, 0]]


def test_samples_are_taken_at_rest_positions() -> None:
    moved = eight_colors(placement=Placement((10.0, 20.0, 30.0), 4.0))
    assert np.array_equal(moved.sample([[13.0, 21.0, 31.0]]), eight_colors().sample([[0.75, 0.25, 0.25]]))


def test_every_point_has_a_value_however_far() -> None:
    texture = eight_colors()
    far = texture.sample([[1e30, -1e30, 1e30], [-0.0, 1.0, 1.0]])
    assert np.array_equal(far, texture.sample([[0.9, 0.1, 0.9], [0.1, 0.9, 0.9]]))


def test_no_points_give_empty_answers() -> None:
    assert eight_colors().sample(np.empty((0, 3))).shape == (0, 3)
    assert eight_colors().contains(np.empty((0, 3))).shape == (0,)


def test_contains_says_whether_a_leaf_holds_the_point() -> None:
    texture = eight_colors(tree=Octree.from_leaves([0, 7], 1), channels={})
    points = [[0.0, 0.0, 0.0], [0.5, 0.5, 0.5], [0.4, 0.4, 0.5], [1.0, 1.0, 1.0], [-0.1, 0.1, 0.1]]
    assert texture.contains(points).tolist() == [True, True, False, False, False]


@needs_jit
def test_many_points_are_looked_up_in_blocks_alike() -> None:
    texture = shell(5)
    points = np.random.default_rng(0).random((40_000, 3))
    pieces = np.concatenate([texture.sample(piece) for piece in np.array_split(points, 7)])
    assert np.array_equal(texture.sample(points), pieces)
    pieces = np.concatenate([texture.contains(piece) for piece in np.array_split(points, 7)])
    assert np.array_equal(texture.contains(points), pieces)


@pytest.mark.parametrize("row", [0, 20_000])
def test_positions_that_are_not_finite_are_refused_by_row(row: int) -> None:
    points = np.full((row + 2, 3), 0.5, np.float32)
    points[row, 1] = np.nan
    for look_up in (eight_colors().sample, eight_colors().contains):
        with pytest.raises(ArgumentError, match=rf"points\[{row}\] is \[0.5, nan, 0.5\]"):
            look_up(points)


def test_unknown_channels_and_filters_are_refused() -> None:
    with pytest.raises(ArgumentError, match="unknown channel 'normal'; there are: base_color"):
        eight_colors().sample([[0, 0, 0]], "normal")
    with pytest.raises(ArgumentError, match="unknown channel 'normal'"):
        eight_colors().sample([[0, 0, 0]], ["base_color", "normal"])
    with pytest.raises(ArgumentError, match="unknown filter 'cubic'; there are: nearest"):
        eight_colors().sample([[0, 0, 0]], filter="cubic")
    with pytest.raises(ArgumentError, match=r"shape \(n, 3\)"):
        eight_colors().sample([0, 0, 0])


@given(textures(deepest=6), st.integers(0, 7))
def test_a_level_is_the_coarser_texture(texture: OctreeTexture, level: int) -> None:
    coarse = texture.level(level)
    coarse.validate()
    assert coarse.tree.max_depth == min(level, texture.tree.max_depth)
    for name, channel in coarse.channels.items():
        assert np.array_equal(channel.values, texture.channels[name].values[: coarse.tree.n_cells])
        rows = coarse.tree.split.areas.size
        assert np.array_equal(channel.split_values, texture.channels[name].split_values[:rows])


def test_the_averages_are_the_values_of_a_coarser_level() -> None:
    assert eight_colors().level(0).sample([[0.9, 0.9, 0.9]])[0, 0] == pytest.approx(
        naive.srgb_to_linear(100 / 255)
    )


def test_bytes_are_those_of_all_arrays() -> None:
    texture = eight_colors()
    assert texture.nbytes == texture.tree.nbytes + 27


# --- what does not fit together


@pytest.mark.parametrize(
    ("form", "values", "message"),
    [
        (BASE_COLOR, np.zeros((8, 3), np.uint8), r"array of shape \(9, 3\), not uint8 \(8, 3\)"),
        (BASE_COLOR, np.zeros((9, 4), np.uint8), r"array of shape \(9, 3\)"),
        (BASE_COLOR, np.zeros((9, 3), np.uint16), "uint8 array of shape"),
        (BASE_COLOR, np.zeros((3, 9), np.uint8).T, "C-ordered"),
        (BASE_COLOR._replace(components=5), np.zeros((9, 5), np.uint8), "1 to 4 components, not 5"),
        (BASE_COLOR._replace(space="red"), np.zeros((9, 3), np.uint8), "unknown colour space"),
        (BASE_COLOR._replace(dtype="int8"), np.zeros((9, 3), np.int8), "unknown dtype"),
        (ALPHA, np.zeros((9, 1), np.uint8), "must have the name of its format"),
    ],
)
def test_channels_that_do_not_fit_the_tree_are_refused(
    form: ChannelFormat, values: np.ndarray, message: str
) -> None:
    with pytest.raises(ArgumentError, match=message):
        eight_colors(channels={"base_color": Channel(form, values, values[:0])})


def test_values_of_split_rows_that_do_not_exist_are_refused() -> None:
    values = np.zeros((9, 3), np.uint8)
    with pytest.raises(ArgumentError, match=r"of shape \(0, 3\)"):
        eight_colors(channels={"base_color": Channel(BASE_COLOR, values, values)})


@pytest.mark.parametrize("metadata", [{"depth": 1}, {1: "depth"}])
def test_metadata_that_are_not_texts_are_refused(metadata: dict[Any, Any]) -> None:
    with pytest.raises(ArgumentError, match="metadata must map strings to strings"):
        eight_colors(metadata=metadata)


@pytest.mark.parametrize(
    "placement", [Placement((0, 0, np.nan), 1), Placement((0, 0, 0), 0), Placement((0, 0, 0), np.inf)]
)
def test_an_impossible_root_cell_is_refused(placement: Placement) -> None:
    with pytest.raises(ArgumentError, match="root cell must be finite"):
        eight_colors(placement=placement)


@pytest.mark.parametrize("bounds", [[[0, 0, 0]], [[0, 0, 0], [1, 1, np.inf]]])
def test_impossible_bounds_are_refused(bounds: list[list[float]]) -> None:
    with pytest.raises(ArgumentError, match="two finite corners"):
        eight_colors(bounds=bounds)


# --- files


@given(texture=textures())
def test_a_saved_texture_opens_as_it_was(
    texture: OctreeTexture, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("files") / "a.octex"
    texture.save(path)
    opened = octex.open(path)
    assert_same(opened, texture)
    opened.validate()
    assert opened.info() == texture.info()
    assert path.stat().st_size == texture.info()["bytes"]["total"]


def test_a_texture_is_saved_under_its_own_ending_only(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"a texture is saved as NAME\.octex"):
        eight_colors().save(tmp_path / "points.ply")
    assert not list(tmp_path.iterdir())


def test_a_texture_and_its_tree_introduce_themselves() -> None:
    assert repr(eight_colors()) == "<OctreeTexture of base_color; <Octree of depth 1: 8 leaves, 1 nodes>>"


def test_the_same_texture_gives_the_same_bytes(tmp_path: Path) -> None:
    shell(3).save(tmp_path / "a.octex")
    octex.open(tmp_path / "a.octex").save(tmp_path / "b.octex")
    assert (tmp_path / "a.octex").read_bytes() == (tmp_path / "b.octex").read_bytes()


def test_the_format_is_what_it_was(tmp_path: Path) -> None:
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


def test_the_safetensors_library_reads_a_texture(tmp_path: Path) -> None:
    texture = shell(2)
    texture.save(tmp_path / "a.octex")
    tensors = load_file(tmp_path / "a.octex")
    assert np.array_equal(tensors["tree/groups"], texture.tree.arrays.groups)
    assert np.array_equal(tensors["split/cells"], texture.tree.split.cells)
    assert np.array_equal(tensors["channels/base_color"], texture.channels["base_color"].values)


def test_unknown_tensors_and_metadata_are_kept(tmp_path: Path) -> None:
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


def test_info_says_where_the_bytes_go() -> None:
    info = eight_colors().info()
    assert json.loads(json.dumps(info)) == info
    assert info["bytes"] == {
        "header": 4096,
        "structure": 24 + 24 + 24,
        "flags": 9,
        "areas": 9,
        "split": 0,
        "channel base_color": 27,
        "other": 0,
        "total": 4096 + 72 + 9 + 9 + 27,
    }
    assert info["levels"] == [{"level": 0, "leaves": 0, "nodes": 1}, {"level": 1, "leaves": 8, "nodes": 0}]
    assert info["finest_cell"] == 0.5
    assert info["provenance"] == {"source": "eight"}


def test_a_file_is_opened_by_its_metadata_not_by_its_name(tmp_path: Path) -> None:
    save_file({"a": np.zeros(3)}, tmp_path / "a.octex")
    with pytest.raises(TextureFileError, match=r"a\.octex: is not an octree texture"):
        octex.open(tmp_path / "a.octex")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("format_version", "2", r"format version '2', newer than this octex reads; update octex"),
        ("format_version", None, "format version ''"),
        ("placement", None, "'placement' are missing or damaged"),
        ("placement", "{}", "'placement' are missing or damaged"),
        ("placement", '{"origin": [0, 0], "size": 1}', "'placement' are missing or damaged"),
        ("placement", '{"origin": [0, 0, [1]], "size": 1}', "'placement' are missing or damaged"),
        (
            "placement",
            '{"origin": [0, 0, 0], "size": 1' + "0" * 400 + "}",
            "'placement' are missing or damaged",
        ),
        ("placement", '{"origin": [0, 0, NaN], "size": 1}', "root cell must be finite"),
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
def test_damaged_metadata_are_refused_by_name(
    tmp_path: Path, name: str, text: str | None, message: str
) -> None:
    path = tmp_path / "a.octex"
    eight_colors().save(path)
    tensors, metadata, _ = container.read(path)
    changed = {key: value for key, value in (metadata | {name: text}).items() if value is not None}
    container.write(path, tensors, changed)
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
    ],
)
def test_missing_and_misshapen_tensors_are_refused_by_name(
    tmp_path: Path, name: str, array: np.ndarray | None, message: str
) -> None:
    path = tmp_path / "a.octex"
    eight_colors().save(path)
    tensors, metadata, _ = container.read(path)
    changed = {key: value for key, value in (tensors | {name: array}).items() if value is not None}
    container.write(path, changed, metadata)
    with pytest.raises(TextureFileError, match=message):
        octex.open(path)


def test_validate_names_the_file_and_the_channel(tmp_path: Path) -> None:
    form = ChannelFormat("height", 1, "data", "float32")
    values = np.zeros((9, 1), np.float32)
    values[3] = np.nan
    texture = eight_colors(channels={"height": Channel(form, values, values[:0])})
    with pytest.raises(TextureFileError, match=r"^channel 'height' has values that are not finite"):
        texture.validate()
    texture.save(tmp_path / "a.octex")
    with pytest.raises(TextureFileError, match=r"a\.octex: channel 'height'"):
        octex.open(tmp_path / "a.octex").validate()


def use(path: Path) -> None:
    """Everything that reads a file; only octex's own errors may come of it."""
    points = np.random.default_rng(0).random((60, 3))
    texture = octex.open(path)
    for name, channel in texture.channels.items():
        assert texture.sample(points, name).shape == (60, channel.format.components)
    texture.contains(points)
    texture.info()
    texture.level(2).contains(points)
    texture.validate()


@pytest.mark.parametrize("seed", range(4))
def test_damaged_files_are_refused_or_harmless(tmp_path: Path, seed: int) -> None:
    random = np.random.default_rng(seed)
    shell(3).save(tmp_path / "whole.octex")
    whole = np.fromfile(tmp_path / "whole.octex", np.uint8)
    text_length = bytes(whole[:4096]).rstrip().__len__()
    path = tmp_path / "damaged.octex"
    for case in range(50):
        data = whole.copy()
        if case % 5 == 0:
            data = data[: random.integers(data.size)]
        elif case % 5 == 1:  # the header's text
            data[random.integers(8, text_length, 3)] = random.choice(list(b'0123456789[]{},:"-aU'), 3)
        elif case % 5 == 2:
            data[random.integers(0, data.size, 20)] ^= random.integers(1, 256, 20, dtype=np.uint8)
        elif case % 5 == 3:  # the structure
            data[random.integers(4096, 6000, 50)] = random.integers(0, 256, 50, dtype=np.uint8)
        else:  # pieces moved
            begin, end = sorted(random.integers(0, data.size, 2))
            data = np.concatenate([data[:begin], data[end:], data[begin:end]])
        data.tofile(path)
        try:
            use(path)
        except OctexError as error:
            assert isinstance(error, InputError)
            assert "\n" not in str(error)


@needs_jit
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_coarse_look_loads_few_pages_of_a_large_file(tmp_path: Path) -> None:
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


def test_an_opened_file_describes_itself_without_reading_a_cell(tmp_path: Path) -> None:
    path = tmp_path / "a.octex"
    shell(3).save(path)
    with path.open("r+b") as file:  # damage all cells
        file.seek(4096 + 24 * 20)
        file.write(b"\xff" * 100)
    texture = octex.open(path)
    assert texture.tree.n_leaves > 0 and texture.info()["leaves"] == texture.tree.n_leaves
