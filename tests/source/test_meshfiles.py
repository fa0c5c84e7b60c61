"""PLY, OFF and STL: every way of colouring, every encoding, and what is refused."""

import struct
import subprocess
import sys

import numpy as np
import pytest

from octex.channels import srgb_to_linear
from octex.errors import ImageError, ModelError, ModelWarning
from octex.source.cloud import PointCloud
from octex.source.load import load_surface
from octex.source.surface import Surface
from tests.make.fixtures import SQUARE, SQUARE_TRIANGLES, ply, ply_square, png, random_image, stl
from tests.make.refusal import refused

ENCODINGS = ["ascii", "binary_little_endian", "binary_big_endian"]
CODES = np.array([[255, 0, 10], [0, 255, 20], [128, 128, 30], [1, 2, 250]])


#: Coordinates of the square's vertices as PLY has them, v up.
ST = {"s": ("float", [0, 1, 1, 0]), "t": ("float", [0, 0, 1, 1])}


def interpolated(surface, colors):
    """The surface's values at samples, and those of colours of the square's vertices, as linear light."""
    samples = surface.scatter(40)
    corners = colors[SQUARE_TRIANGLES[samples.triangles]]
    return surface.evaluate(samples), (samples.barycentric[:, :, None] * corners).sum(axis=1)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    ("kind", "scale"),
    [("uchar", 1), ("ushort", 257), ("float", 1 / 255), ("double", 1 / 255), ("float", 1), ("int", 1)],
)
@pytest.mark.parametrize("names", ["red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b"])
def test_ply_colours_of_vertices_are_srgb_values(tmp_path, encoding, kind, scale, names):
    properties = {name: (kind, (CODES[:, i] * scale).tolist()) for i, name in enumerate(names.split())}
    surface = load_surface(ply(tmp_path / "a.ply", ply_square(**properties), encoding=encoding))
    found, expected = interpolated(surface, srgb_to_linear(CODES / 255))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_ply_alpha_below_1_makes_a_channel_and_alpha_of_0_throughout_is_left_out(tmp_path):
    codes = {name: ("uchar", [255] * 4) for name in ("red", "green", "blue", "alpha")}
    assert len(load_surface(ply(tmp_path / "a.ply", ply_square(**codes))).channels) == 1
    codes["alpha"] = ("uchar", [51, 51, 51, 51])
    surface = load_surface(ply(tmp_path / "a.ply", ply_square(**codes)))
    np.testing.assert_allclose(surface.evaluate(surface.scatter(5), "alpha"), 0.2, atol=1e-6)
    codes = {name: ("uchar", [128] * 4) for name in ("red", "green", "blue")}
    path = ply(tmp_path / "a.ply", ply_square(**codes, alpha=("uchar", [0] * 4)))
    with pytest.warns(ModelWarning, match="a.ply: all its colours have alpha 0"):
        assert len(load_surface(path).channels) == 1
    with pytest.warns(ModelWarning, match="alpha 0"):
        assert not PointCloud.load(path).is_translucent


def test_ply_colours_of_faces_count_where_vertices_have_none(tmp_path):
    codes = {"red": ("uchar", [255, 0]), "green": ("uchar", [0, 255]), "blue": ("uchar", [0, 9])}
    surface = load_surface(ply(tmp_path / "a.ply", ply_square(**codes)))
    samples = surface.scatter(30)
    expected = np.array([[1, 0, 0], [0, 1, srgb_to_linear(9 / 255)]])[samples.triangles]
    np.testing.assert_allclose(surface.evaluate(samples), expected, atol=1e-6)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_ply_faces_of_mixed_sizes_keep_their_colours(tmp_path, encoding):
    elements = ply_square()
    elements["vertex"]["x"] = ("double", [0, 2, 2, 0, 1])
    elements["vertex"]["y"] = ("double", [0, 0, 2, 2, 1])
    elements["vertex"]["z"] = ("double", [0, 0, 0, 0, 5])
    elements["face"] = {
        "flags": ("uchar", [7, 7, 7, 7]),
        "vertex_index": ("list int uint", [[0, 1, 2, 3], [0, 1, 4], [0, 1], [3, 0, 4]]),
        "red": ("uchar", [0, 255, 9, 0]),
        "green": ("uchar", [0, 0, 9, 255]),
        "blue": ("uchar", [255, 0, 9, 0]),
        "weights": ("list uchar float", [[], [0.5], [1, 2], []]),
    }
    surface = load_surface(ply(tmp_path / "a.ply", elements, encoding=encoding))
    np.testing.assert_array_equal(surface.triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 4], [3, 0, 4]])
    samples = surface.scatter(60)
    expected = np.array([[0, 0, 1], [0, 0, 1], [1, 0, 0], [0, 1, 0]])[samples.triangles]
    np.testing.assert_array_equal(surface.evaluate(samples), expected)


def test_ply_elements_before_and_after_are_passed_over(tmp_path):
    unread = {"s": ("float", [0, 1, 2, 3]), "t": ("float", [0, 1, 2, 3])}  # coordinates without an image
    square = ply_square(**unread)
    elements = {
        "camera": {"view": ("list uchar double", [[1, 2, 3], []]), "f": ("short", [-4, 5])},
        **square,
        "edge": {"vertex1": ("int", [0]), "vertex2": ("int", [1])},
    }
    for encoding in ENCODINGS:
        surface = load_surface(ply(tmp_path / "a.ply", elements, encoding=encoding))
        np.testing.assert_array_equal(surface.vertices, SQUARE)
        np.testing.assert_array_equal(surface.triangles, SQUARE_TRIANGLES)
        assert (surface.evaluate(surface.scatter(5)) == 1).all()


def test_ply_headers_may_end_their_lines_like_windows(tmp_path):
    path = ply(tmp_path / "a.ply", ply_square(), encoding="binary_little_endian")
    head, _, body = path.read_bytes().partition(b"end_header\n")
    path.write_bytes(head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body)
    np.testing.assert_array_equal(load_surface(path).vertices, SQUARE)


@pytest.mark.parametrize("names", ["s t", "u v", "texture_u texture_v"])
def test_ply_textures_are_bound_with_v_up(tmp_path, names):
    (tmp_path / "my wood.png").write_bytes(png(random_image(5, 4)))
    u, v = names.split()
    properties = {u: ("float", SQUARE[:, 0].tolist()), v: ("float", SQUARE[:, 1].tolist())}
    path = ply(tmp_path / "a.ply", ply_square(**properties), comments=["TextureFile my wood.png"])
    surface = load_surface(path)
    reference = Surface.from_arrays(SQUARE, SQUARE_TRIANGLES, uv=SQUARE[:, :2], image=random_image(5, 4))
    samples = surface.scatter(50)
    for width in (0.0, 0.3):
        found, expected = surface.evaluate(samples, width=width), reference.evaluate(samples, width=width)
        np.testing.assert_array_equal(found, expected)


def test_ply_textures_take_precedence_over_colours_and_may_be_named_after_the_file(tmp_path):
    (tmp_path / "a.png").write_bytes(png(np.full((2, 2, 3), 204, np.uint8)))
    codes = {name: ("uchar", [192] * 4) for name in ("red", "green", "blue", "alpha")}
    surface = load_surface(ply(tmp_path / "a.ply", ply_square(**ST, **codes), comments=["TextureFile a.png"]))
    assert [form.name for form in surface.channels] == ["base_color"]
    np.testing.assert_allclose(surface.evaluate(surface.scatter(5)), srgb_to_linear(0.8), rtol=1e-5)
    (tmp_path / "square.v2_A.png").write_bytes(png(np.full((2, 2, 3), 51, np.uint8)))
    path = ply(tmp_path / "square.v2.ply", ply_square(**ST), comments=["TextureFile <this>_A.png"])
    surface = load_surface(path)
    np.testing.assert_allclose(surface.evaluate(surface.scatter(5)), srgb_to_linear(0.2), rtol=1e-5)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_ply_textures_may_be_bound_by_corner_and_be_several(tmp_path, encoding):
    images = [random_image(4, 4, seed=i) for i in range(2)]
    for i, image in enumerate(images):
        (tmp_path / f"{i}.png").write_bytes(png(image))
    uv = np.random.default_rng(0).random((2, 3, 2)).astype(np.float32)
    properties = {"texcoord": ("list uchar float", uv.reshape(2, 6).tolist()), "texnumber": ("int", [1, 0])}
    comments = ["TextureFile 0.png", "TextureFile 1.png"]
    surface = load_surface(
        ply(tmp_path / "a.ply", ply_square(**properties), encoding=encoding, comments=comments)
    )
    samples = surface.scatter(60)
    found = surface.evaluate(samples)
    for number, image in enumerate(images):
        reference = Surface.from_arrays(SQUARE, SQUARE_TRIANGLES, uv=uv, image=image)
        chosen = samples.triangles == 1 - number
        np.testing.assert_allclose(found[chosen], reference.evaluate(samples)[chosen], atol=1e-6)


def test_a_rest_mesh_of_another_format_needs_no_image(tmp_path):
    rest = ply(tmp_path / "rest.ply", ply_square(), comments=["TextureFile gone.png"])
    posed = off(tmp_path / "posed.off", "OFF\n4 2 0\n0 0 0\n9 0 0\n9 9 0\n0 9 0\n3 0 1 2\n3 0 2 3\n")
    np.testing.assert_allclose(load_surface(posed, rest=rest).bounds[1], [1, 1, 0])


def edited(path, old, new):
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new))
    return path


def plain(tmp_path, encoding="ascii", **properties):
    return ply(tmp_path / "bad.ply", ply_square(**properties), encoding=encoding)


BAD_PLY = {
    "not PLY": (lambda t: edited(plain(t), b"ply\n", b"plx\n"), "not a PLY file"),
    "cut in the header": (lambda t: edited(plain(t), b"end_header", b"end"), "not a PLY file"),
    "encoding": (lambda t: edited(plain(t), b"ascii", b"utf-8"), "format 'utf-8'"),
    "type": (lambda t: edited(plain(t), b"property float x", b"property quad x"), "'property quad x'"),
    "property first": (lambda t: edited(plain(t), b"element vertex 4\n", b""), "'property float x'"),
    "count": (lambda t: edited(plain(t), b"vertex 4", b"vertex four"), "'element vertex four'"),
    "negative count": (lambda t: edited(plain(t), b"vertex 4", b"vertex -4"), "'vertex' elements are"),
    "huge count": (lambda t: edited(plain(t), b"face 2", b"face 999999999"), "'face' elements are missing"),
    "words": (lambda t: edited(plain(t), b"3 0 1 2", b"3 0 one 2"), "not all numbers"),
    "cut ascii": (lambda t: edited(plain(t), b"3 0 2 3\n", b"3 0 2"), "'face' elements are missing"),
    "no length": (lambda t: edited(plain(t), b"3 0 1 2\n3 0 2 3\n", b"4 0 1 2 3 "), "'face' elements are"),
    "no axis": (lambda t: edited(plain(t), b"float z", b"float w"), "no vertices with x, y and z"),
    "no faces": (lambda t: edited(plain(t), b"face 2", b"face 0"), "no triangles"),
    "points": (lambda t: ply(t / "bad.ply", {"vertex": ply_square()["vertex"]}), "no triangles"),
    "not a list": (lambda t: edited(plain(t), b"list uchar int v", b"int v"), "no triangles"),
    "pairs": (lambda t: edited(plain(t), b"3 0 1 2\n3 0 2 3\n", b"2 0 1\n2 0 2\n"), "no triangles"),
    "index": (lambda t: edited(plain(t), b"3 0 2 3", b"3 0 2 4"), "a vertex that is not among the 4"),
    "index of no number": (lambda t: edited(plain(t), b"3 0 2 3", b"3 0 2 nan"), "that is not among the 4"),
    "negative index": (lambda t: edited(plain(t), b"3 0 2 3", b"3 0 2 -1"), "a vertex that is not among"),
    "negative length": (
        lambda t: edited(edited(plain(t), b"3 0 2 3", b"-3 0 2 3"), b"uchar int", b"int int"),
        "'face' elements are missing",
    ),
    "not finite": (lambda t: edited(plain(t), b"1.0 1.0 0.0", b"1.0 nan 0.0"), "not all finite"),
    "colours": (
        lambda t: plain(t, **{c: ("float", [0.5, float("nan"), 0, 0]) for c in ("red", "green", "blue")}),
        "colours are not all finite",
    ),
    "empty": (lambda t: edited(plain(t), plain(t).read_bytes(), b""), "is empty"),
    "lists for numbers": (
        lambda t: edited(edited(plain(t), b"property float x", b"property list int float x"),
                         b"0.0 0.0 0.0\n", b"1 0 0 0\n"), "data of|no vertices with x",
    ),
    "endless nothing": (
        lambda t: edited(edited(plain(t), b"element v", b"element no 999999999999999999\nelement v"),
                         b"3 0 2 3", b"3 0 2 4"), "a vertex that is not among the 4",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_PLY)
def test_a_bad_ply_file_is_refused_in_one_line_that_names_it(tmp_path, case):
    make, message = BAD_PLY[case]
    path = make(tmp_path)
    with refused(ModelError, message, "bad.ply"):
        load_surface(path)


@pytest.mark.parametrize("encoding", ENCODINGS[1:])
def test_a_binary_ply_file_that_ends_early_is_refused(tmp_path, encoding):
    path = plain(tmp_path, encoding)
    data = path.read_bytes()
    for cut in (1, 6, 13, 30, 60):
        path.write_bytes(data[:-cut])
        with pytest.raises(ModelError, match=r"bad\.ply is truncated"):
            load_surface(path)


def test_bad_textures_of_a_ply_file_are_named(tmp_path):
    comments = ["TextureFile wood.png"]
    path = ply(tmp_path / "a.ply", ply_square(**ST), comments=comments)
    with pytest.raises(ImageError, match=r"a\.ply: wood\.png cannot be read: No such file"):
        load_surface(path)
    (tmp_path / "wood.png").write_bytes(b"no image")
    with pytest.raises(ImageError, match=r"a\.ply: wood\.png cannot be read as an image"):
        load_surface(path)
    (tmp_path / "wood.png").write_bytes(png(random_image(2, 2)))
    with pytest.warns(ModelWarning, match=r"a\.ply names the image wood\.png but has no texture coordinates"):
        load_surface(ply(tmp_path / "a.ply", ply_square(), comments=comments))
    with pytest.raises(ModelError, match="a face names TextureFile 1, but there are 1"):
        load_surface(ply(tmp_path / "a.ply", ply_square(**ST, texnumber=("int", [0, 1])), comments=comments))
    elsewhere = ["TextureFile /dev/zero"]
    with pytest.raises(ImageError, match=r"a\.ply: /dev/zero .*: absolute paths are not followed"):
        load_surface(ply(tmp_path / "a.ply", ply_square(**ST), comments=elsewhere))


@pytest.mark.parametrize("name", [r"textures\wood.png", r"C:\scans\Wood.PNG", "/home/someone/wood.png"])
def test_ply_textures_are_found_next_to_the_model_by_their_names(tmp_path, name):
    (tmp_path / "wood.png").write_bytes(png(np.full((2, 2, 3), 51, np.uint8)))
    surface = load_surface(ply(tmp_path / "a.ply", ply_square(**ST), comments=[f"TextureFile {name}"]))
    np.testing.assert_allclose(surface.evaluate(surface.scatter(5)), srgb_to_linear(0.2), rtol=1e-5)


def off(path, text):
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("head", "tails"),
    [
        ("COFF", ["255 0 10", "0 255 20", "128 128 30", "1 2 250"]),
        ("COFF", ["255 0 10 255", "0 255 20 255", "128 128 30 255", "1 2 250 255"]),
        ("OFF", ["255 0 10", "0 255 20", "128 128 30", "1 2 250"]),
        ("CNOFF", ["0 0 1 255 0 10", "0 0 1 0 255 20", "0 0 1 128 128 30", "0 0 1 1 2 250"]),
        ("STCOFF", ["255 0 10 0.5 0.5", "0 255 20 0 0", "128 128 30 1 1", "1 2 250 0 1"]),
    ],
)
def test_off_colours_of_vertices_are_srgb_values(tmp_path, head, tails):
    points = ["0 0 0", "1 0 0", "1 1 0", "0 1 0"]
    rows = "\n".join(f"{point} {tail}" for point, tail in zip(points, tails, strict=True))
    surface = load_surface(off(tmp_path / "a.off", f"{head}\n# square\n4 2 0\n\n{rows}\n3 0 1 2\n3 0 2 3\n"))
    assert len(surface.channels) == 1
    found, expected = interpolated(surface, srgb_to_linear(CODES / 255))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_off_colours_may_be_fractions_with_alpha(tmp_path):
    text = "COFF 3 1 0\n0 0 0 1.0 0 0 0.5\n1 0 0 1.0 0 0 0.5\n0 1 0 1.0 0 0 0.5\n3 0 1 2\n"
    surface = load_surface(off(tmp_path / "a.off", text))
    samples = surface.scatter(5)
    np.testing.assert_allclose(surface.evaluate(samples), [[1, 0, 0]] * 5)
    np.testing.assert_allclose(surface.evaluate(samples, "alpha"), 0.5)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_triangle_strips_of_a_ply_file_are_its_faces(tmp_path, encoding):
    """Range scans have them: −1 ends a strip, and repeated vertices begin another within one."""
    points = {axis: ("float", [n**k for n in range(8)]) for k, axis in enumerate("xyz", 1)}
    strips = [[0, 1, 2, 3, -1, 4, 5, 6, -1, -1, 1, 2], [3, 4, 5, 5, 6, 6, 7, 0]]
    path = ply(
        tmp_path / "a.ply",
        {
            "vertex": points,
            "face": {"vertex_indices": ("list uchar int", [])},
            "tristrips": {"vertex_indices": ("list int int", strips)},
        },
        encoding=encoding,
    )
    expected = [[0, 1, 2], [2, 1, 3], [4, 5, 6], [3, 4, 5], [7, 6, 0]]
    found = load_surface(path).triangles
    assert {tuple(np.roll(row, -row.argmin())) for row in found} == {
        tuple(np.roll(row, -np.argmin(row))) for row in expected
    }
    assert len(found) == len(expected)


def test_off_numbers_may_follow_without_a_blank_and_faces_go_on_to_other_lines(tmp_path):
    rows = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"
    for head in ("OFF4 2 0", "  OFF4 2 0", "OFF 4 2 0"):
        surface = load_surface(off(tmp_path / "a.off", f"{head}\n{rows}"))
        np.testing.assert_array_equal(surface.vertices[surface.triangles], SQUARE[SQUARE_TRIANGLES])
    points = "0 0 0\n2 0 0\n2 2 0\n0 2 0\n1 1 5\n"
    surface = load_surface(off(tmp_path / "a.off", f"OFF\n5 2 0\n{points}4 0 \n1 \n2 \n3 \n\n3 0\n1 4\n"))
    np.testing.assert_array_equal(surface.triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 4]])


def test_off_faces_have_colours_of_their_own_and_any_number_of_corners(tmp_path):
    points = "0 0 0\n2 0 0\n2 2 0\n0 2 0\n1 1 5\n"
    text = f"OFF\n5 4 0\n{points}4 0 1 2 3 255 0 0\n3 0 1 4\n3 1 2 4 7\n2 0 1 0 255 0\n"
    surface = load_surface(off(tmp_path / "a.off", text))
    np.testing.assert_array_equal(surface.triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 4], [1, 2, 4]])
    samples = surface.scatter(60)
    expected = np.array([[1, 0, 0], [1, 0, 0], [1, 1, 1], [1, 1, 1]])[samples.triangles]
    np.testing.assert_array_equal(surface.evaluate(samples), expected)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("# only\n", "first word is not OFF"),
        ("4OFF\n1 1 0\n", "a kind of OFF file"),
        ("OFF BINARY\n1 1 0\n", "a kind of OFF file"),
        ("OFF\n", "numbers of vertices and faces are missing"),
        ("OFF\n3 1 0\n0 0 0\n", "is truncated"),
        ("OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n", "no triangles"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 zero\n3 0 1 2\n", "not numbers"),
        ("OFF\n3 1 0\n0 0 0\n1 0\n0 1 0\n3 0 1 2\n", "less than three numbers"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\nnan 0 1 2\n", "fewer corners"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 1.5\n", "not among the 3"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "fewer corners than it says"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 -1\n", "not among the 3"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n2 0 1\n", "no triangles"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 nan\n3 0 1 2\n", "not all finite"),
        ("COFF\n3 1 0\n0 0 0 1 1 x\n1 0 0 1 1 1\n0 1 0 1 1 1\n3 0 1 2\n", "not numbers"),
    ],
)
def test_a_bad_off_file_is_refused_in_one_line_that_names_it(tmp_path, text, message):
    with refused(ModelError, message, "bad.off"):
        load_surface(off(tmp_path / "bad.off", text))


@pytest.mark.parametrize("ascii", [False, True])
def test_stl_models_are_white(tmp_path, ascii):
    surface = load_surface(stl(tmp_path / "a.stl", SQUARE, SQUARE_TRIANGLES, ascii=ascii))
    corners = surface.vertices[surface.triangles]
    np.testing.assert_array_equal(corners, SQUARE[SQUARE_TRIANGLES])
    assert (surface.evaluate(surface.scatter(5)) == 1).all()


@pytest.mark.parametrize(
    ("header", "words", "colors"),
    [
        (b"", [0x8000 | 31 << 10, 0x8000 | 31], [[255, 0, 0], [0, 0, 255]]),
        (b"", [0x8000 | 31 << 5, 0x2020], [[0, 255, 0], [255, 255, 255]]),  # blanks are no colour
        (b"COLOR=\x33\x66\x99\xff", [31, 0xFFFF], [[255, 0, 0], [51, 102, 153]]),
        (b"MeshMagic COLOR=\x33\x66\x99\xff", [31 << 10, 0], [[0, 0, 255], [0, 0, 0]]),
        (b"COLOR=\x33\x66\x99", [0, 0], [[51, 102, 153]] * 2),  # none has a colour of its own
    ],
)
def test_facets_of_binary_stl_files_have_colours(tmp_path, header, words, colors):
    path = stl(tmp_path / "a.stl", SQUARE, SQUARE_TRIANGLES)
    data = bytearray(path.read_bytes())
    data[: len(header)] = header
    for facet, word in enumerate(words):
        struct.pack_into("<H", data, 84 + 50 * facet + 48, word)
    path.write_bytes(data)
    surface = load_surface(path)
    samples = surface.scatter(20)
    expected = srgb_to_linear(np.array(colors)[samples.triangles] / 255)
    np.testing.assert_allclose(surface.evaluate(samples), expected, atol=1e-6)


def test_bytes_after_stl_facets_are_passed_over_and_names_may_be_any_words_in_any_encoding(tmp_path):
    path = stl(tmp_path / "a.stl", SQUARE, SQUARE_TRIANGLES)
    path.write_bytes(path.read_bytes() + b"\r\n")
    assert len(load_surface(path).triangles) == len(SQUARE_TRIANGLES)
    path = stl(tmp_path / "a.stl", SQUARE, SQUARE_TRIANGLES, ascii=True)
    text = path.read_bytes()
    for name in ("Körper".encode("latin-1"), "Körper".encode(), b"vertex one"):
        named = text.replace(b"solid a\n", b"solid " + name + b"\n")
        for end in (b"\n", b"\r\n", b"\r"):
            path.write_bytes(named.replace(b"\n", end))
            assert len(load_surface(path).triangles) == 2


def test_nothing_is_printed_of_what_other_libraries_log(tmp_path):
    path = stl(tmp_path / "a.stl", SQUARE, SQUARE_TRIANGLES, ascii=True)
    edited(path, b"normal 0 0 0", b"normal 0 x 0")
    (tmp_path / "a.tif").write_bytes(
        b"II*\0\x08\0\0\0\x03\0"
        + b"".join(struct.pack("<HHII", tag, 3, 1, value) for tag, value in ((256, 4), (257, 4), (277, 36)))
    )
    script = (
        "from octex.source.load import load_surface\n"
        "from octex.source.images.decode import decode_image\n"
        "from octex.errors import ImageError\n"
        f"assert len(load_surface({str(path)!r}).triangles) == 2\n"
        "try:\n"
        f"    decode_image(open({str(tmp_path / 'a.tif')!r}, 'rb').read(), 'a')\n"
        "except ImageError:\n"
        "    print('refused')\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("refused\n", "")


def test_bad_stl_files_are_refused_in_one_line_that_names_them(tmp_path):
    path = tmp_path / "bad.stl"
    whole = stl(path, SQUARE, SQUARE_TRIANGLES).read_bytes()
    text = stl(path, SQUARE, SQUARE_TRIANGLES, ascii=True).read_bytes()
    broken = np.where(SQUARE == 1, np.float32(np.nan), SQUARE)
    for data, message in (
        (b"", "is empty"),
        (whole[:-10], "is truncated, or not an STL file"),
        (whole[:80] + bytes(4), "no triangles"),
        (b"solid a\nendsolid a\n", "no triangles"),
        (png(random_image(4, 4)), "is truncated, or not an STL file"),
        (text.replace(b"vertex 1.0", b"vertex one", 1), "not three times three numbers"),
        (text.replace(b"vertex 1.0 ", b"vertex ", 1), "not three times three numbers"),
        (text[:-10], "is truncated, or not an STL file"),
        (stl(path, broken, SQUARE_TRIANGLES).read_bytes(), "not all finite"),
    ):
        path.write_bytes(data)
        with refused(ModelError, message, "bad.stl"):
            load_surface(path)


def test_files_that_are_not_there_or_not_models_are_refused(tmp_path):
    for ending in ("glb", "gltf", "obj", "ply", "off", "stl"):
        with pytest.raises(ModelError, match=rf"nothing\.{ending} cannot be read: No such file"):
            load_surface(tmp_path / f"nothing.{ending}")
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(ModelError, match=r"folder\.obj cannot be read: Is a directory"):
        load_surface(tmp_path / "folder.obj")
    (tmp_path / "a.txt").write_text("hello")
    with pytest.raises(ModelError, match=r"a\.txt is not a model that octex reads; it reads \.glb, \.gltf"):
        load_surface(tmp_path / "a.txt")


def test_a_model_too_large_for_the_memory_is_refused(tmp_path, monkeypatch):
    def exhausted(*_):
        raise MemoryError

    monkeypatch.setitem(load_surface.__globals__["_READERS"], ".off", exhausted)
    with pytest.raises(ModelError, match=r"a\.off does not fit into memory"):
        load_surface(off(tmp_path / "a.off", "OFF"))


def test_real_models_with_colours_agree_between_formats(models):
    folder = models / "pyntcloud"
    if not folder.is_dir():
        pytest.skip("pyntcloud is not there")
    names = ["diamond_color.obj", "diamond_color.off", "diamond.ply", "diamond_ascii.ply"]
    surfaces = [load_surface(folder / name) for name in names]
    samples = surfaces[0].scatter(50)
    for surface in surfaces[1:]:
        np.testing.assert_array_equal(surface.triangles, surfaces[0].triangles)
        np.testing.assert_allclose(surface.evaluate(samples), surfaces[0].evaluate(samples), atol=1e-5)
