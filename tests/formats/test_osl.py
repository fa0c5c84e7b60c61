"""Textures as an image for an OSL shader, read back by another walk; test_blender runs the shader."""

import re
import struct
import zlib

import numpy as np
import pytest

import octex
from octex.channels import ChannelFormat, srgb_to_linear
from octex.errors import ArgumentError
from octex.formats import osl
from octex.texture import Channel
from tests.make.small_surfaces import TETRAHEDRON, tetrahedron


def surface(**sources):
    return tetrahedron().with_sources(sources)


def texels_of(path):
    """Read a TIFF of deflated strips, of 16-bit texels."""
    data = path.read_bytes()
    assert data[:4] == b"II*\0"
    (at,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, at)
    tags = {}
    for n in range(count):
        tag, kind, number, value = struct.unpack_from("<HHII", data, at + 2 + 12 * n)
        width = {3: 2, 4: 4}[kind]
        if number * width > 4:
            tags[tag] = struct.unpack_from(f"<{number}{'?HI'[width // 2]}", data, value)
        else:
            tags[tag] = (value,)
    assert tags[258] == (16,) * 4 and tags[259] == (8,) and tags[338] == (0,)
    strips = zip(tags[273], tags[279], strict=True)
    unpacked = b"".join(zlib.decompress(data[start : start + size]) for start, size in strips)
    return np.frombuffer(unpacked, "<u2").reshape(tags[257][0] * tags[256][0], 4)


class Written:
    """A shader file and its image; `nearest` finds a point's cell as the shader does."""

    def __init__(self, texture, folder, **options):
        self.path = folder / "made.osl"
        osl.write_osl(texture, self.path, **options)
        self.shader = self.path.read_text("utf-8")
        self.texels = texels_of(self.path.with_name("made.osl.tif"))
        self.n_split = 0  # leaves that were found
        self.numbers = dict(re.findall(r"#define (\w+) (\S.*)", self.shader))

    def number(self, name):
        return int(self.numbers[name])

    def nearest(self, place, plane=0):
        """Return the texel of the leaf that holds a point of texture space, and count split ones."""
        cell = node = 0
        for level in range(1, self.number("DEPTH") + 1):
            low = self.texels[node].astype(np.int64)
            words = low[0] | low[1] << 16, low[2] | low[3] << 16
            nodes, stored = words[0] & 255, (words[0] | words[1]) & 255
            octant = sum(int(place[axis] * 2**level) % 2 << axis for axis in range(3))
            assert stored >> octant & 1
            before = (1 << octant) - 1
            cell = (words[0] >> 8) + int(stored & before).bit_count()
            node = (words[1] >> 8) + int(nodes & before).bit_count()
        begin = self.number("CELLS") + plane * self.number("ROWS")
        texel = self.texels[begin + cell].astype(np.int64)
        self.n_split += bool(texel[3] & 128)
        return self.texels[begin + (texel[1] << 16 | texel[0])] if texel[3] & 128 else texel


def points_of(texture):
    rest = surface().scatter(200, seed=3).points.astype(np.float64)
    return rest, (rest - texture.placement.origin) / texture.placement.size


def test_the_image_holds_the_leaves_of_the_tree_in_linear_light(tmp_path):
    texture = octex.convert(surface(), 5)
    written = Written(texture, tmp_path)
    rest, places = points_of(texture)
    expected = texture.sample(rest, filter="nearest")
    for place, value in zip(places, expected, strict=True):
        texel = written.nearest(place)
        np.testing.assert_allclose(texel[:3] / 65535, value, atol=1e-5)
        assert texel[3] >> 8 == 255
    assert 0 < written.n_split < len(places)


def test_a_split_cell_has_a_row_for_each_facing(tmp_path):
    texture = octex.convert(surface(), 5)
    written = Written(texture, tmp_path)
    split = texture.tree.split
    first = written.number("CELLS")
    values = texture.rows(numbers=np.arange(texture.tree.n_cells + split.areas.size))
    row = texture.tree.n_cells
    for cell, facings in zip(split.cells.tolist(), split.facings.tolist(), strict=True):
        red, green, _, last = written.texels[first + cell].tolist()
        assert last & 63 == facings & 63
        for n in range(1, (facings & 63).bit_count() + 1):
            found = written.texels[first + (green << 16 | red) + n, :3] / 65535
            np.testing.assert_allclose(found, values[row], atol=1e-5)
            row += 1


def test_numbers_lie_three_to_a_plane_and_alpha_beside_each_value(tmp_path):
    made = surface(base_color=(0.2, 0.4, 0.6), alpha=0.25, roughness=0.5, metallic=0.75, occlusion=1.0)
    texture = octex.convert(made, 4)
    written = Written(texture, tmp_path)
    _, places = points_of(texture)
    assert written.number("HAS_ALPHA") == 1
    names = [name for name in texture.channels if name != "base_color"]
    last = written.number("CELLS") + 3 * written.number("ROWS")
    assert len(written.texels) == last + written.number("WIDTH") and (written.texels[last:] == 65535).all()
    assert written.texels[0, 1] < 32768  # where a renderer that turns images reads the last row
    row = written.nearest(places[0], 1)
    assert row[3] >> 8 == 64
    stored = {"alpha": 64 / 255, "roughness": 128 / 255, "metallic": 191 / 255}
    np.testing.assert_allclose(row[:3] / 65535, [stored[name] for name in names[:3]], atol=1e-5)
    for name in texture.channels:
        assert re.search(rf"output (color|float) {name}\b", written.shader)


def test_floats_and_directions_are_scaled_to_their_range(tmp_path):
    texture = octex.convert(surface(emissive=(4.0, 1.0, 0.0)), 3, dtype="float32")
    written = Written(texture, tmp_path)
    _, places = points_of(texture)
    high = float(re.findall(r"emissive = 0\.0 \+ (\S+) \*", written.shader)[0])
    assert high == pytest.approx(4.0, rel=1e-4)
    np.testing.assert_allclose(written.nearest(places[0], 1)[:3] / 65535 * high, (4, 1, 0), atol=1e-4)


def test_leaves_of_several_depths_are_divided(tmp_path):
    texture = octex.convert(surface(base_color=(0.5, 0.5, 0.5)), 5, max_error=2)
    assert any(leaves for leaves, _ in texture.tree.cells_by_depth()[:5])
    written = Written(texture, tmp_path)
    _, places = points_of(texture)
    depth = texture.tree.max_depth
    assert written.number("DEPTH") == depth
    for place in places:
        np.testing.assert_allclose(written.nearest(place)[:3] / 65535, srgb_to_linear(188 / 255), atol=1e-4)


def test_a_root_without_children_is_the_only_cell(tmp_path):
    texture = octex.resize(octex.convert(surface(), 3), 0)
    np.testing.assert_allclose(
        Written(texture, tmp_path).nearest(np.zeros(3))[:3] / 65535,
        texture.sample(TETRAHEDRON[:1])[0],
        atol=1e-5,
    )


def test_what_cannot_be_written_is_refused(tmp_path, monkeypatch):
    texture = octex.convert(surface(), 4)
    with pytest.raises(ArgumentError, match=r"an OSL shader is saved as NAME\.osl"):
        octex.write_osl(texture, tmp_path / "made.txt")
    with pytest.raises(ArgumentError, match="'gloss'; there are: base_color"):
        octex.write_osl(texture, tmp_path / "made.osl", channels=["gloss"])
    with pytest.raises(ArgumentError, match="there is no channel to write"):
        octex.write_osl(texture, tmp_path / "made.osl", channels=[])
    monkeypatch.setattr(osl, "_MOST_CELLS", texture.tree.n_leaves)
    with pytest.raises(ArgumentError, match=r"write texture\.level\(3\)"):
        octex.write_osl(texture, tmp_path / "made.osl")
    assert not list(tmp_path.iterdir())


def test_four_components_are_refused_by_name_and_left_out_otherwise(tmp_path):
    texture = octex.convert(surface(), 3)
    rows = texture.tree.n_cells, texture.tree.split.areas.size, texture.tree.kept.cells.size
    glaze = Channel(ChannelFormat("glaze", 4, "data"), *(np.zeros((count, 4), np.uint8) for count in rows))
    channels = {**texture.channels, "glaze": glaze}
    four = octex.OctreeTexture(texture.tree, channels, texture.placement, texture.bounds)
    with pytest.raises(ArgumentError, match="'glaze' has 4 components"):
        octex.write_osl(four, tmp_path / "made.osl", channels=["glaze"])
    assert "glaze" not in Written(four, tmp_path).shader


def test_convert_and_edit_write_it(tmp_path):
    from octex.cli.main import main

    octex.convert(surface(), 4).save(tmp_path / "a.octex")
    assert main(["convert", str(tmp_path / "a.octex"), str(tmp_path / "a.osl"), "--quiet"]) == 0
    assert main(["edit", str(tmp_path / "a.octex"), str(tmp_path / "b.osl"), "--depth", "3", "--quiet"]) == 0
    assert "#define DEPTH 4" in (tmp_path / "a.osl").read_text()
    assert "#define DEPTH 3" in (tmp_path / "b.osl").read_text()
    assert (tmp_path / "b.osl.tif").exists()


def test_outputs_have_names_that_osl_does_not_keep_to_itself(tmp_path):
    made = surface(normal=lambda points: 0.5 * points, alpha=0.5)
    shader = Written(octex.convert(made, 3), tmp_path).shader
    assert "output normal normal_ = N" in shader
    assert "output float alpha = 0" in shader
    assert [osl.output_name(each) for each in ("base_color", "my glaze", "color", "P")] == [
        "base_color", "my_glaze", "color_", "P_",
    ]  # fmt: skip
