"""Textures as PLY point clouds, read back by another library."""

import numpy as np
import pytest
import trimesh

from octex import channels, jit
from octex.channels import ALPHA, BASE_COLOR, ChannelFormat, linear_to_srgb
from octex.errors import TextureFileError
from octex.formats.ply import write_points
from octex.texture import Channel, OctreeTexture
from octex.tree.layout import AREA_ONE
from octex.tree.morton import decode_cells
from octex.tree.normals import estimate_normals
from octex.tree.octree import Octree, walk_leaves
from octex.tree.placement import Placement

PLACEMENT = Placement((-3.0, 2.0, 0.5), 4.0)
# Leaves at mixed depths, as (code, depth) in Morton order.
LEAVES = [(0, 1), (8, 2), (79, 3), (3, 1), (63, 2)]


def texture_of(formats=(BASE_COLOR,), *, leaves=LEAVES, placement=PLACEMENT, values=None):
    tree = Octree.from_leaves(*np.array(leaves, np.int64).reshape(-1, 2).T)
    random = np.random.default_rng(7)
    tree = tree.with_cell_data(
        random.integers(0, 64, tree.n_cells).astype(np.uint8), np.full(tree.n_cells, AREA_ONE, np.uint8)
    )
    stored = {}
    for format_ in formats:
        shape = (tree.n_cells, format_.components)
        array = random.random(shape) if values is None else np.broadcast_to(values, shape)
        array = (array * channels.ONE[format_.dtype]).astype(format_.dtype)
        stored[format_.name] = Channel(format_, array, array[:0], array[:0])
    corners = np.array([placement.origin, np.add(placement.origin, placement.size)])
    return OctreeTexture(tree, stored, placement, corners, {})


def read(path):
    """All properties of the vertices as trimesh reads them."""
    cloud = trimesh.load(path)
    assert isinstance(cloud, trimesh.PointCloud)
    vertices = cloud.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(cloud.vertices, np.column_stack([vertices[axis] for axis in "xyz"]))
    if "red" in vertices.dtype.names:
        colors = np.column_stack([vertices[name] for name in ("red", "green", "blue")])
        np.testing.assert_array_equal(cloud.colors[:, :3], colors)
    if "alpha" in vertices.dtype.names:
        np.testing.assert_array_equal(cloud.colors[:, 3], vertices["alpha"])
    return vertices


def columns(vertices, *names):
    return np.column_stack([vertices[name] for name in names])


def test_another_reader_finds_the_same_points_colours_and_normals(tmp_path):
    texture = texture_of((BASE_COLOR, ALPHA))
    write_points(texture, tmp_path / "points.ply")
    vertices = read(tmp_path / "points.ply")
    assert len(vertices) == texture.tree.n_leaves == len(LEAVES)

    codes, depths = np.array(LEAVES).T
    centres = PLACEMENT.origin + (decode_cells(codes) + 0.5) / 2.0 ** depths[:, None] * PLACEMENT.size
    np.testing.assert_allclose(columns(vertices, *"xyz"), centres, rtol=1e-6)
    (leaves,) = walk_leaves(texture.tree.arrays)
    values = texture.sample(centres, ["base_color", "alpha"])
    colors = np.rint(255 * linear_to_srgb(values["base_color"]))
    np.testing.assert_array_equal(columns(vertices, "red", "green", "blue"), colors)
    np.testing.assert_array_equal(columns(vertices, "alpha"), np.rint(255 * values["alpha"]))
    normals = estimate_normals(texture.tree.arrays, *leaves)
    np.testing.assert_array_equal(columns(vertices, "nx", "ny", "nz"), normals)


def test_the_header_names_its_maker_and_its_units(tmp_path):
    write_points(texture_of(), tmp_path / "points.ply")
    header = (tmp_path / "points.ply").read_bytes().split(b"end_header\n")[0].decode("ascii").splitlines()
    assert header == [
        "ply",
        "format binary_little_endian 1.0",
        "comment octex: a point a leaf of an octree texture",
        "comment units: those of the model; colours: sRGB",
        "element vertex 5",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
    ]


@pytest.mark.parametrize("space", ["srgb", "linear"])
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float16", "float32"])
def test_colours_of_every_storage_become_srgb_codes(tmp_path, dtype, space):
    texture = texture_of((ChannelFormat("base_color", 3, space, dtype),), values=(0.0, 0.5, 1.0))
    write_points(texture, tmp_path / "points.ply")
    half = 0.5 if space == "srgb" else float(linear_to_srgb(127 / 255 if dtype == "uint8" else 0.5))
    colors = columns(read(tmp_path / "points.ply"), "red", "green", "blue").astype(int)
    assert np.abs(colors - np.rint(np.array([0, half, 1]) * 255)).max() <= 1


def test_alpha_of_more_bits_becomes_bytes_and_a_texture_without_colours_gives_bare_points(tmp_path):
    texture = texture_of((BASE_COLOR, ALPHA._replace(dtype="float32")), values=0.25)
    write_points(texture, tmp_path / "points.ply")
    assert set(read(tmp_path / "points.ply")["alpha"]) == {64}
    write_points(texture_of((ChannelFormat("roughness", 1, "data"),)), tmp_path / "points.ply")
    assert read(tmp_path / "points.ply").dtype.names == ("x", "y", "z", "nx", "ny", "nz")


@pytest.mark.parametrize(
    ("placement", "depth", "kind"),
    [
        (Placement((0.0, 0.0, 0.0), 1.0), 10, "f4"),
        (Placement((0.0, 0.0, 0.0), 1.0), 20, "f8"),
        (Placement((-5e6, 0.0, 0.0), 1.0), 10, "f8"),
    ],
)
def test_positions_have_the_precision_that_the_cells_need(tmp_path, placement, depth, kind):
    code = 8**depth - 1
    texture = texture_of(leaves=[(code - 3, depth), (code, depth)], placement=placement)
    write_points(texture, tmp_path / "points.ply")
    vertices = read(tmp_path / "points.ply")
    assert vertices["x"].dtype.str[1:] == kind
    edge = placement.size / 2**depth
    corner = np.array(placement.origin) + placement.size
    error = columns(vertices, *"xyz")[1].astype(np.float64) - (corner - edge / 2)
    assert np.abs(error).max() <= edge / 50


def test_leaves_that_need_several_blocks_all_come(tmp_path, monkeypatch):
    texture = texture_of()
    write_points(texture, tmp_path / "whole.ply")
    monkeypatch.setattr("octex.formats.ply.walk_leaves", lambda arrays: walk_leaves(arrays, 2))
    calls = []
    write_points(texture, tmp_path / "blocks.ply", progress=lambda *call: calls.append(call))
    assert (tmp_path / "blocks.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert calls == [("write", done, 5) for done in (0, 2, 4, 5)]


def test_an_empty_texture_gives_no_points(tmp_path):
    write_points(texture_of(leaves=[]), tmp_path / "points.ply")
    text = (tmp_path / "points.ply").read_bytes()
    assert b"element vertex 0\n" in text
    assert text.endswith(b"end_header\n")


def test_a_damaged_tree_is_named_and_what_stood_there_stays(tmp_path):
    texture = texture_of()
    texture.tree.arrays.groups[0, :2] = 0
    (tmp_path / "points.ply").write_bytes(b"old")
    with pytest.raises(TextureFileError, match=r"points\.ply: not written: .* damaged, with 0 of 5"):
        write_points(texture, tmp_path / "points.ply")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


@pytest.mark.skipif(jit.DISABLED, reason="too slow without compilation")
def test_memory_does_not_grow_with_the_leaves(tmp_path):
    import tracemalloc

    from octex.tree.morton import encode_cells

    peaks = []
    for width in (256, 512):
        cells = np.stack(np.meshgrid(np.arange(width), np.arange(width), [0]), axis=-1).reshape(-1, 3)
        texture = texture_of(leaves=[(int(code), 9) for code in np.sort(encode_cells(cells))])
        write_points(texture, tmp_path / "points.ply")
        tracemalloc.start()
        write_points(texture, tmp_path / "points.ply")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]
