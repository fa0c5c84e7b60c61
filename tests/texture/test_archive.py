import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import octex
from octex import container
from octex.archive.layout import MAGIC
from octex.channels import ChannelFormat
from octex.errors import ArgumentError, TextureFileError
from octex.parallel import at_most
from octex.texture import Channel, OctreeTexture
from octex.tree import morton
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from tests.make.same import assert_equal
from tests.make.strategies import random_values, textures, with_random_data
from tests.oracles import naive_archive


def hilly(depth=8, dtype="uint8"):
    """A wavy sheet, coloured smoothly, of several blocks; half of it two levels coarser."""
    size = 1 << depth
    x, y = np.divmod(np.arange(size * size), size)
    z = (size * (0.5 + 0.2 * np.sin(7 * x / size) * np.cos(5 * y / size))).astype(int)
    codes = np.unique(morton.encode_cells(np.stack([x, y, z], 1)))
    is_fine = morton.decode_cells(codes)[:, 0] < size // 2
    leaves = [np.empty(0, np.int64)] * (depth + 1)
    leaves[depth], leaves[depth - 2] = codes[is_fine], np.unique(codes[~is_fine] >> 6)
    tree = with_random_data(Octree.from_levels(leaves), 1)
    places = np.concatenate(
        [morton.decode_cells(codes) / 2.0**level for level, (codes, _) in enumerate(tree.walk())]
    )
    random = np.random.default_rng(2)
    smooth = 0.5 + 0.4 * np.sin(9 * places + random.normal(0, 0.02, places.shape))
    one = 1 if dtype.startswith("f") else np.iinfo(dtype).max
    rows = tree.split.areas.size, tree.kept.cells.size
    values = (smooth * one).astype(dtype)
    others = [random_values((count, 3), dtype, random) for count in rows]
    channel = Channel(ChannelFormat("base_color", 3, "linear", dtype), values, *others)
    return OctreeTexture(tree, {"base_color": channel}, Placement((0.0, 0.0, 0.0), 1.0), [[0] * 3, [1] * 3])


@given(texture=textures())
def test_an_archived_texture_opens_as_it_was(texture, tmp_path_factory):
    folder = tmp_path_factory.mktemp("archive")
    texture.save(folder / "a.octz")
    opened = octex.open(folder / "a.octz")
    assert_equal(opened, texture)
    opened.validate()
    texture.save(folder / "a.octex")
    opened.save(folder / "b.octex")
    assert (folder / "a.octex").read_bytes() == (folder / "b.octex").read_bytes()


@given(texture=textures(), error=st.integers(1, 255))
def test_values_of_an_archive_move_by_no_more_than_they_may(texture, error, tmp_path_factory):
    path = tmp_path_factory.mktemp("archive") / "a.octz"
    texture.save(path, max_error=error)
    opened = octex.open(path)
    assert all(np.array_equal(*pair) for pair in zip(opened.tree.arrays, texture.tree.arrays, strict=True))
    for name, channel in texture.channels.items():
        for ours, theirs in zip(channel[1:], opened.channels[name][1:], strict=True):
            if ours.dtype.kind == "f":
                assert np.array_equal(ours, theirs)
            elif ours.size:
                assert np.abs(ours.astype(int) - theirs.astype(int)).max() <= error


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float16", "float32"])
def test_several_blocks_come_back_smaller_and_the_same(dtype, tmp_path):
    texture = hilly(8, dtype)
    texture.save(tmp_path / "a.octz")
    assert_equal(octex.open(tmp_path / "a.octz"), texture)
    texture.save(tmp_path / "a.octex")
    packed = zlib.compress((tmp_path / "a.octex").read_bytes(), 9)
    assert (tmp_path / "a.octz").stat().st_size < 0.9 * len(packed)


def test_an_archive_has_the_same_bytes_on_one_thread_and_from_what_was_opened(tmp_path):
    texture = hilly(8)
    texture.save(tmp_path / "a.octz")
    with at_most(1):
        octex.open(tmp_path / "a.octz").save(tmp_path / "b.octz")
    assert (tmp_path / "a.octz").read_bytes() == (tmp_path / "b.octz").read_bytes()


def assert_read_naively(path, texture):
    found, tree = naive_archive.Archive(path.read_bytes()), texture.tree
    assert found.flags == tree.arrays.flags.tolist()
    assert found.areas == tree.arrays.areas.tolist()
    assert found.split_areas == tree.split.areas.tolist()
    for number, (head, channel) in enumerate(zip(found.channels, texture.channels.values(), strict=True)):
        pairs = (
            (found.values, channel.values),
            (found.split_values, channel.split_values),
            (found.kept_values, channel.kept_values),
        )
        for ours, theirs in pairs:
            keys = found.keys(head, theirs.tobytes())
            assert [key for row in ours[number] for key in row] == keys


@settings(max_examples=15)
@given(texture=textures(), error=st.sampled_from([0, 0, 1, 40]))
def test_the_document_suffices_to_read_an_archive(texture, error, tmp_path_factory):
    path = tmp_path_factory.mktemp("archive") / "a.octz"
    texture.save(path, max_error=error)
    assert_read_naively(path, octex.open(path))


def test_the_document_suffices_to_read_a_smooth_archive(tmp_path):
    hilly(6).save(tmp_path / "a.octz")
    assert_read_naively(tmp_path / "a.octz", octex.open(tmp_path / "a.octz"))


def test_more_error_makes_an_archive_smaller(tmp_path):
    texture = hilly(8)
    sizes = []
    for error in (0, 1, 3):
        texture.save(tmp_path / "a.octz", max_error=error)
        sizes.append((tmp_path / "a.octz").stat().st_size)
    assert sizes[0] > sizes[1] > sizes[2]


def test_what_octex_does_not_know_is_archived_too(tmp_path):
    texture = hilly(4)
    texture.save(tmp_path / "a.octex")
    contents = container.read(tmp_path / "a.octex")
    mesh = np.random.default_rng(0).normal(size=(50_000, 3))
    extra = {"mesh/rest": mesh, "tree/ages": np.arange(3, dtype=np.uint64)}
    container.write(tmp_path / "b.octex", {**contents.tensors, **extra}, {**contents.metadata, "note": "é"})
    octex.open(tmp_path / "b.octex").save(tmp_path / "b.octz")
    octex.open(tmp_path / "b.octz").save(tmp_path / "c.octex")
    again = container.read(tmp_path / "c.octex")
    assert all(np.array_equal(again.tensors[name], array) for name, array in extra.items())
    assert again.metadata["note"] == "é"


def test_a_damaged_archive_is_refused_wherever_it_is_damaged(tmp_path):
    path = tmp_path / "a.octz"
    hilly(3).save(path)
    good = path.read_bytes()
    random = np.random.default_rng(3)
    for at in [*range(32), *random.integers(32, len(good), 60).tolist()]:
        broken = bytearray(good)
        broken[at] ^= int(random.integers(1, 256))
        path.write_bytes(broken)
        with pytest.raises(TextureFileError, match=r"a\.octz: "):
            octex.open(path)
    for length in (8, 31, 32, 100, len(good) - 1):
        path.write_bytes(good[:length])
        with pytest.raises(TextureFileError, match="truncated"):
            octex.open(path)


def test_a_newer_archive_is_refused_by_name(tmp_path):
    path = tmp_path / "a.octz"
    hilly(3).save(path)
    first = bytearray(path.read_bytes())
    first[8] = 2
    first[28:32] = zlib.crc32(first[:28]).to_bytes(4, "little")
    path.write_bytes(first)
    with pytest.raises(TextureFileError, match="format version 2, newer than this octex reads"):
        octex.open(path)
    assert bytes(first[:8]) == MAGIC


def test_an_archive_takes_no_ending_and_no_error_that_makes_no_sense(tmp_path):
    texture = hilly(3)
    with pytest.raises(ArgumentError, match=r"NAME\.octex or NAME\.octz"):
        texture.save(tmp_path / "a.zip")
    with pytest.raises(ArgumentError, match="max_error is for archives"):
        texture.save(tmp_path / "a.octex", max_error=1)
    with pytest.raises(ArgumentError, match="max_error must be a whole number"):
        texture.save(tmp_path / "a.octz", max_error=-1)


def test_the_command_archives_and_brings_back(tmp_path):
    from octex.cli.main import main

    texture = hilly(5)
    texture.save(tmp_path / "a.octex")
    a, b, c = (str(tmp_path / name) for name in ("a.octex", "b.octz", "c.octex"))
    assert main(["convert", a, b, "--quiet"]) == 0
    assert main(["convert", b, c, "--quiet"]) == 0
    assert Path(a).read_bytes() == Path(c).read_bytes()
    assert main(["edit", a, b, "--quiet", "--force", "--loss", "3"]) == 0
    assert main(["edit", a, b, "--quiet", "--force", "--loss", "0.5"]) == 2
    assert main(["validate", b]) == 0
    assert main(["info", b, "--json"]) == 0
    assert main(["convert", b, str(tmp_path / "d.octz")]) == 2
