"""The leaves of a texture as plain arrays."""

import numpy as np
import pytest

import octex
from octex.channels import ALPHA, BASE_COLOR, ChannelFormat
from octex.cli import main as cli
from octex.errors import ArgumentError, TextureFileError
from octex.formats.npz import write_arrays
from octex.texture import Channel, OctreeTexture
from octex.tree.areas import AREAS
from octex.tree.morton import encode_cells
from octex.tree.normals import estimate_normals
from octex.tree.octree import walk_leaves
from tests.make.small_surfaces import whole
from tests.source.test_ply import LEAVES, PLACEMENT, texture_of


def test_arrays_say_where_leaves_are_and_what_is_there(tmp_path):
    texture = texture_of((BASE_COLOR, ALPHA))
    write_arrays(texture, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as file:
        arrays = dict(file)
    codes, depths = np.array(LEAVES).T
    np.testing.assert_array_equal(encode_cells(arrays["coords"]), codes)
    np.testing.assert_array_equal(arrays["depths"], depths)
    np.testing.assert_array_equal(arrays["origin"], PLACEMENT.origin)
    assert arrays["size"] == PLACEMENT.size
    edges = arrays["size"] / 2.0 ** depths[:, None]
    np.testing.assert_allclose(arrays["points"], arrays["origin"] + (arrays["coords"] + 0.5) * edges)
    (leaves,) = walk_leaves(texture.tree.arrays)
    np.testing.assert_array_equal(arrays["normals"], estimate_normals(texture.tree.arrays, *leaves))
    np.testing.assert_allclose(arrays["areas"], edges[:, 0] ** 2)  # each has a face's
    for name in texture.channels:
        np.testing.assert_array_equal(arrays[name], texture.sample(arrays["points"], name))


def test_areas_add_up_to_the_surface(tmp_path):
    surface = whole()
    texture = octex.convert(surface, 5)
    write_arrays(texture, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as arrays:
        assert arrays["areas"].sum() == pytest.approx(surface.areas().sum(), rel=0.01)
        codes = texture.tree.arrays.areas
        assert (arrays["areas"] == 0.0).sum() <= (codes == 0).sum()
        assert float(AREAS[codes[codes > 0]].min()) > 0.0


def test_an_empty_texture_has_empty_arrays_and_a_damaged_one_is_not_written(tmp_path, monkeypatch):
    write_arrays(texture_of(leaves=[]), tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as arrays:
        assert arrays["points"].shape == arrays["base_color"].shape == (0, 3)
    monkeypatch.setattr("octex.formats.ply.walk_leaves", lambda arrays: [*walk_leaves(arrays, 2)][:1])
    with pytest.raises(TextureFileError, match="with 2 of 5 leaves"):
        write_arrays(texture_of(), tmp_path / "b.npz")
    assert not (tmp_path / "b.npz").exists()


def test_a_channel_with_the_name_of_another_array_is_refused(tmp_path):
    texture = texture_of()
    for name in ("size", "file"):
        values = np.zeros((texture.tree.n_cells, 1), np.float32)
        channel = Channel(ChannelFormat(name, 1, "data", "float32"), values, values[:0], values[:0])
        named = OctreeTexture(texture.tree, {name: channel}, texture.placement, texture.bounds)
        with pytest.raises(ArgumentError, match=f"uses the name '{name}' itself; leave"):
            write_arrays(named, tmp_path / "a.npz")
    assert not (tmp_path / "a.npz").exists()


def test_the_command_writes_arrays_and_reads_them_as_points(tmp_path):
    octex.convert(whole(), 4).save(tmp_path / "a.octex")
    assert cli.main(["convert", str(tmp_path / "a.octex"), str(tmp_path / "a.npz"), "--quiet"]) == 0
    cloud = octex.PointCloud.load(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as arrays:
        assert len(cloud) == octex.open(tmp_path / "a.octex").tree.n_leaves
        np.testing.assert_array_equal(cloud.points, arrays["points"])
        np.testing.assert_allclose(cloud.colors[:, :3], arrays["base_color"], atol=1e-6)
        np.testing.assert_allclose(cloud.normals, arrays["normals"], atol=1e-6)
