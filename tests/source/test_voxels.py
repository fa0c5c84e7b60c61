"""Sparse voxels: what they are read from, and that they are the texture's leaves as they are."""

import json
import struct
from itertools import product

import numpy as np
import pytest

import octex
from octex.channels import decode, encode
from octex.errors import ArgumentError, ModelError
from octex.formats.npz import write_arrays
from octex.source.voxels import is_voxels
from octex.tree.octree import walk_leaves
from tests.make.refusal import refused
from tests.make.vxz import vxz

RNG = np.random.default_rng(3)
COORDS = np.unique(RNG.integers(0, 13, (200, 3)), axis=0)[RNG.permutation(150)]
COLORS = RNG.integers(0, 256, (150, 3), dtype=np.uint8)
ALPHA = RNG.integers(0, 256, (150, 1), dtype=np.uint8)
ROUGHNESS = RNG.random(150).astype(np.float32)


def stored(texture, name):
    """What leaves hold, by the centres of their cells in texture space."""
    found = {}
    for leaves in walk_leaves(texture.tree.arrays):
        for code, depth, cell in zip(leaves.codes, leaves.depths, leaves.cells, strict=True):
            place = [
                sum((int(code) >> 3 * bit + axis & 1) << bit for bit in range(depth)) for axis in range(3)
            ]
            centre = tuple((np.array(place) + 0.5) / 2.0**depth)
            found[centre] = texture.channels[name].values[cell].tolist()
    return found


def test_each_voxel_is_a_leaf_with_its_value():
    channels = {"base_color": COLORS, "alpha": ALPHA, "roughness": ROUGHNESS, "label": ALPHA[:, 0]}
    texture = octex.convert(octex.Voxels(COORDS, channels, origin=(1, 2, 3), size=8.0))
    texture.validate()
    assert (texture.tree.max_depth, texture.tree.n_leaves) == (4, 150)
    assert texture.placement == ((1.0, 2.0, 3.0), 8.0)
    np.testing.assert_array_equal(
        texture.bounds, [COORDS.min(axis=0) / 2 + [1, 2, 3], (COORDS.max(axis=0) + 1) / 2 + [1, 2, 3]]
    )
    for name, codes in (
        ("base_color", COLORS),
        ("alpha", ALPHA),
        ("label", ALPHA),
        ("roughness", np.rint(ROUGHNESS[:, None] * 255)),
    ):
        centres = [tuple((place + 0.5) / 16) for place in COORDS]
        assert stored(texture, name) == dict(zip(centres, codes.tolist(), strict=True))


def test_nodes_are_means_in_linear_light_that_alpha_weighs():
    coords = np.array(list(product(range(2), repeat=3)))
    colors = RNG.integers(0, 256, (8, 4), dtype=np.uint8)
    texture = octex.convert(octex.Voxels(coords, {"base_color": colors}))
    light, alpha = decode(colors[:, :3], "srgb").astype(float), colors[:, 3:] / 255
    expected = encode((light * alpha).sum(axis=0) / alpha.sum(), "uint8", "srgb")
    np.testing.assert_allclose(texture.channels["base_color"].values[0].astype(int), expected, atol=1)
    np.testing.assert_allclose(texture.channels["alpha"].values[0] / 255, alpha.mean(), atol=1 / 255)


def test_voxels_of_several_depths_share_a_grid_and_weigh_as_their_faces():
    texture = octex.convert(
        octex.Voxels([[0, 0, 0], [2, 0, 0], [3, 1, 1]], {"x": np.array([0.0, 1.0, 1.0])}, depth=[1, 2, 2])
    )
    texture.validate()
    assert stored(texture, "x") == {
        (0.25,) * 3: [0],
        (0.625, 0.125, 0.125): [255],
        (0.875, 0.375, 0.375): [255],
    }
    np.testing.assert_allclose(texture.channels["x"].values[0] / 255, 0.5 / (1 + 0.5), atol=0.02)


def test_floats_are_linear_light_and_stay_so_above_1():
    light = RNG.random((150, 3)) * [1, 1, 5]
    texture = octex.convert(octex.Voxels(COORDS, {"base_color": light, "emissive": light / 5}))
    assert texture.channels["base_color"].format[2:] == ("linear", "float16")
    assert texture.channels["emissive"].format[2:] == ("srgb", "uint8")
    bright = octex.convert(octex.Voxels(COORDS, {"emissive": light * 1e5}))  # more than float16 holds
    assert bright.channels["emissive"].format[2:] == ("linear", "float32")
    np.testing.assert_allclose(
        stored(bright, "emissive")[tuple((COORDS[0] + 0.5) / 16)], light[0] * 1e5, 1e-6
    )
    found = octex.convert(octex.Voxels(COORDS, {"emissive": light / 5}), dtype="float32")
    leaves = stored(found, "emissive")
    for place, value in zip(COORDS, light / 5, strict=True):
        np.testing.assert_allclose(leaves[tuple((place + 0.5) / 16)], value, rtol=1e-6)
    with pytest.raises(ArgumentError, match="channel 'emissive' has values above 1, which uint8 cannot"):
        octex.convert(octex.Voxels(COORDS, {"emissive": light}), dtype="uint8")


@pytest.mark.parametrize("seed", range(4))
def test_random_voxels_are_textures_that_can_be_edited(seed):
    random = np.random.default_rng(seed)
    depth = int(random.integers(1, 6))
    coords = np.unique(random.integers(0, 2**depth, (int(random.integers(1, 60)), 3)), axis=0)
    rows = len(coords)
    channels = [
        {"base_color": random.random((rows, 3), np.float32)},
        {"base_color": random.integers(0, 256, (rows, 4), np.uint8)},
        {
            "base_color": random.random((rows, 3)),
            "alpha": random.random((rows, 1)),
            "roughness": coords[:, 0] / 32,
        },
        {"base_color": random.integers(0, 65536, (rows, 3), np.uint16), "normal": random.random((rows, 3))},
    ][seed % 4]
    texture = octex.convert(octex.Voxels(coords, channels, depth=depth + seed % 2, size=2.0))
    texture.validate()
    points = 2 * random.random((200, 3))
    for filter in ("nearest", "linear", "quadratic", "quartic"):
        for options in ({}, {"width": 0.3}, {"normals": points - 1}):
            assert np.isfinite(texture.sample(points, "base_color", filter, **options)).all()
    for edited in (
        octex.blur(texture, 0.2),
        octex.resize(texture, depth=depth),
        octex.levels(texture, black=0.1),
        octex.mix(texture, octex.levels(texture, gamma=1.2)),
    ):
        edited.validate()


def test_arrays_of_files_have_usual_names_too(tmp_path):
    np.savez(
        tmp_path / "a.npz",
        ijk=np.c_[np.zeros(150, int), COORDS], rgb=COLORS, voxel_size=0.5, depth=5, points=COORDS, note="a",
    )  # fmt: skip
    assert is_voxels(tmp_path / "a.npz")
    voxels = octex.Voxels.load(tmp_path / "a.npz")
    assert (voxels.size, set(voxels.depths.tolist()), list(voxels.values)) == (16.0, {5}, ["base_color"])
    texture = octex.convert(tmp_path / "a.npz")
    assert texture.metadata["source"] == "a.npz"
    np.testing.assert_array_equal(voxels.values["base_color"].rows, COLORS)


def test_points_in_a_npz_are_no_voxels(tmp_path):
    np.savez(tmp_path / "a.npz", points=COORDS, colors=COLORS)
    assert not is_voxels(tmp_path / "a.npz")
    assert not is_voxels(tmp_path / "none.npz")


def test_what_octex_writes_of_leaves_of_several_depths_it_reads(tmp_path):
    coords = np.array([[0, 0, 0], [2, 0, 0], [3, 1, 1], [2, 2, 2]])
    colors, light = RNG.random((4, 3)), RNG.random((4, 3)) * 4
    given = octex.Voxels(
        coords, {"base_color": colors, "emissive": light}, depth=[1, 2, 2, 2], origin=(1, 2, 3), size=3.0
    )
    texture = octex.convert(given)
    write_arrays(texture, tmp_path / "a.npz")
    found = octex.convert(tmp_path / "a.npz", dtype="float32")
    assert found.placement == texture.placement
    assert found.tree.cells_by_depth() == texture.tree.cells_by_depth()
    centres = np.array([*stored(texture, "emissive")])
    for name, values in texture.sample(centres * 3 + [1, 2, 3], ["base_color", "emissive"]).items():
        np.testing.assert_allclose([*stored(found, name).values()], values, rtol=1e-6)


def test_the_command_converts_them(tmp_path, cli):
    np.savez(tmp_path / "a.npz", coords=COORDS, base_color=COLORS)
    told = cli.result(tmp_path / "a.npz", tmp_path / "a.octex", "--json", "--quiet")
    assert json.loads(told)["leaves"] == 150
    assert octex.open(tmp_path / "a.octex").tree.max_depth == 4
    refused = cli.refusal(tmp_path / "a.npz", tmp_path / "b.octex", "--depth", "3")
    assert "--depth is not for voxels" in refused


VALUES = {"base_color": COLORS, "alpha": ALPHA, "label": ALPHA}


def whole(**changes):
    return vxz(COORDS, VALUES, **changes)


def moved(index):
    """A file whose first chunk says that it lies elsewhere."""
    data = whole()
    (start,) = struct.unpack_from(">I", data, 4)
    chunks = json.loads(data[8:start])["chunks"]
    chunks[0]["idx"][1] = index
    return whole(chunks=chunks)


@pytest.mark.parametrize(
    ("compression", "style", "filtered"),
    [(compression, "as_is", "none") for compression in ("none", "deflate", "zstd")]
    + [("lzma", *both) for both in product(("none", "as_is", "all"), ("none", "parent", "neighbor"))],
)
def test_o_voxels_files_are_read(tmp_path, compression, style, filtered):
    data = vxz(COORDS, VALUES, compression=compression, style=style, filtered=filtered)
    (tmp_path / "a.vxz").write_bytes(data)
    texture = octex.convert(tmp_path / "a.vxz")
    assert texture.placement == ((-0.5,) * 3, 1.0)
    assert set(texture.channels) == {"base_color", "alpha", "label"}
    for name, codes in (("base_color", COLORS), ("alpha", ALPHA), ("label", ALPHA)):
        centres = [tuple((place + 0.5) / 16) for place in COORDS]
        assert stored(texture, name) == dict(zip(centres, codes.tolist(), strict=True))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is empty|is not a .vxz file"),
        (b"VXZ\1" + bytes(20), "version 1"),
        (whole()[:60], "is damaged"),
        (whole()[:-20], "is damaged"),
        (whole(chunk_size=16), "is damaged"),
        (whole(chunk_size=7), "a chunk size of 7"),
        (whole(chunks=[]), "has no voxels"),
        (whole(chunks=[{"ptr": [0, 9]}]), "is damaged .*svo"),
        (whole(attr=[["base_color", 2]]), "is damaged"),
        (whole(attr=[["base_color", 10**9], ["alpha", 1], ["label", 1]]), "is damaged .*1000000000 columns"),
        (whole(attr=[["base_color", -1], ["alpha", 1], ["label", 1]]), "is damaged .*columns"),
        (whole(chunk_size=2**30), "a chunk size of 1073741824"),
        (whole(filter="left"), "filter 'left', which octex does not read; write it with filter='none'"),
        (whole(attr_interleave="odd"), "attr_interleave 'odd', which octex does not read"),
        (whole().replace(b'"compression": "lzma"', b'"compression": "zstd"'), "is damaged .*Zstandard"),
        (moved(10**9), "is damaged .*a chunk at"),
        (moved(10**30), "is damaged"),
        (moved(-1), "coords from -8 to"),
    ],
)
def test_damaged_o_voxels_are_refused_in_one_line(tmp_path, data, message):
    (tmp_path / "bad.vxz").write_bytes(data)
    with refused(ModelError, message, "bad.vxz"):
        octex.convert(tmp_path / "bad.vxz")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"coords": COORDS - 1, "rgb": COLORS}, "coords from -1 to 11 do not fit a grid"),
        ({"coords": COORDS * 0.5, "rgb": COLORS}, "coords must be whole numbers"),
        ({"coords": COORDS[:, :2], "rgb": COLORS}, r"of shape \(n, 3\)"),
        ({"coords": COORDS[:0], "rgb": COLORS[:0]}, "has no voxels"),
        ({"coords": COORDS, "rgb": COLORS, "depth": 3}, "is outside of a grid of depth 3"),
        ({"coords": COORDS, "rgb": COLORS, "depth": 22}, "depth must be from 0 to 21"),
        ({"coords": COORDS, "rgb": COLORS, "depth": [-1] * 149 + [4]}, "from 0 to 21, not -1"),
        ({"coords": COORDS, "rgb": COLORS, "depth": 4.5}, "depth must be a whole number"),
        ({"coords": COORDS, "rgb": COLORS, "origin": [0, np.nan, 0]}, "origin must be finite"),
        ({"coords": COORDS, "rgb": COLORS, "size": -1.0}, "size must be finite and above zero"),
        ({"coords": COORDS, "rgb": COLORS, "voxel_size": 0.0}, "voxel_size must be"),
        ({"coords": COORDS}, "has no channel"),
        ({"coords": COORDS[:9], "rgb": COLORS}, "has no channel"),
        ({"coords": COORDS, "roughness": COLORS}, r"roughness must have shape \(150, 1\)"),
        ({"coords": COORDS, "label": ROUGHNESS.astype(np.int64)}, "must be uint8 or uint16 codes, or floats"),
        ({"coords": COORDS, "label": np.full(150, np.nan)}, "label: voxel 0 is not finite"),
        ({"coords": COORDS[[0, 0]], "rgb": COLORS[:2]}, "overlap"),
        ({"coords": np.array([[0, 0, 0], [1, 1, 1]]), "rgb": COLORS[:2], "depths": [1, 2]}, "overlap"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line_that_names_it(tmp_path, arrays, message):
    np.savez(tmp_path / "bad.npz", **arrays)
    with refused(ModelError, message, "bad.npz"):
        octex.convert(tmp_path / "bad.npz")


def test_rows_of_unequal_lengths_are_refused():
    for coords, values, depth in (([[0], [1, 2]], [1.0], 1), ([[0, 0, 0]], [[1], [2, 3]], 1),
                                  ([[0, 0, 0]], [[1.0]], [[1], [2, 3]])):  # fmt: skip
        with pytest.raises(ArgumentError, match="must"):
            octex.Voxels(coords, {"roughness": values}, depth=depth)


def test_what_needs_a_surface_or_another_grid_is_refused():
    voxels = octex.Voxels(COORDS, {"base_color": COLORS})
    with pytest.raises(ArgumentError, match="voxels have their own depth"):
        octex.convert(voxels, 7)
    with pytest.raises(ArgumentError, match="max_error needs a surface"):
        octex.convert(voxels, max_error=2)
    with pytest.raises(ArgumentError, match="unknown channel 'alpha'"):
        octex.convert(voxels, channels=["alpha"])


def test_a_damaged_npz_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", coords=COORDS, rgb=COLORS)
    data = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "bad.npz").write_bytes(data[:100] + bytes(40) + data[140:])
    with pytest.raises(ModelError, match=r"bad\.npz"):
        octex.convert(tmp_path / "bad.npz")
