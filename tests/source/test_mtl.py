"""What MTL files say of materials: each map, each option of maps, and what is refused."""

import hashlib
import json

import numpy as np
import pytest

import octex.source.models.mtl
from octex.channels import srgb_to_linear
from octex.errors import ImageError, ModelError
from octex.source.images.pyramid import CLAMP, REPEAT
from octex.source.load import load_surface
from octex.source.models.mtl import ImageFiles, is_grey, load_materials, normals_of_heights
from octex.source.models.reading import Options, Slot
from tests.make.fixtures import OBJ_SQUARE, obj, png, random_image
from tests.make.refusal import refused

FACES = "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
COLORS = random_image(4, 4)
GREYS = random_image(4, 4, 1)
CUT_OUT = random_image(4, 4, 4)
IMAGES = {"a.png": png(COLORS), "b.png": png(random_image(3, 5, seed=1)), "grey.png": png(GREYS)}
IMAGES["cut.png"] = png(CUT_OUT)


def describe(folder, lines, channels=None):
    """The material of some lines, beside images."""
    for name, data in IMAGES.items():
        (folder / name).write_bytes(data)
    (folder / "m.mtl").write_text(f"newmtl wood\n{lines}\n")
    materials, *_ = load_materials(folder / "m.obj", ["m.mtl"], {"wood"}, Options(channels=channels))
    return materials["wood"]


def stated(folder, lines, channels=None):
    """What some lines state beside a base colour."""
    inputs = dict(describe(folder, lines, channels).material.inputs)
    inputs.pop("base_color")
    return inputs


def texels(given):
    return given.texture.texels


def square(folder, mtl, lines=OBJ_SQUARE + "usemtl wood\n" + FACES):
    """A square of one material."""
    return obj(folder / "a.obj", lines, f"newmtl wood\n{mtl}\n", IMAGES)


@pytest.mark.parametrize(
    ("line", "channel", "factor"),
    [
        ("Kd 0.5 0.25 1", "base_color", srgb_to_linear([0.5, 0.25, 1])),
        ("Kd 0.5", "base_color", srgb_to_linear([0.5] * 3)),
        ("Ks 0.5", "specular", srgb_to_linear([0.5] * 3)),
        ("Ks 2 -1 0", "specular", [1, 0, 0]),
        ("Ke 0.5 0 0", "emissive", srgb_to_linear([0.5, 0, 0])),
        ("Ke 3 0.5 -1", "emissive", [3, 0.5, 0]),
        ("Pm 0.25", "metallic", [0.25]),
        ("Pr 0.25", "roughness", [0.25]),
        ("Pr 7", "roughness", [1]),
        ("d 0.25", "alpha", [0.25]),
        ("Tr 0.25", "alpha", [0.75]),
        ("d -1", "alpha", [0]),
        ("d -halo 0.5", "alpha", [0.5]),
        ("Ns 250", "roughness", [0.5]),
        ("Ns 4000", "roughness", [0]),
    ],
)
def test_a_number_is_a_channel(tmp_path, line, channel, factor):
    found = describe(tmp_path, line, ("base_color", channel)).material
    assert set(found.inputs) == {"base_color", channel}
    assert found.inputs[channel].texture is None
    np.testing.assert_allclose(found.inputs[channel].factor, factor, atol=1e-9)
    assert found.alpha_mode == ("blend" if channel == "alpha" else "opaque")


def test_colors_that_blender_wrote_are_linear_light(tmp_path):
    lines = OBJ_SQUARE + "usemtl wood\n" + FACES
    found = obj(
        tmp_path / "a.obj",
        lines,
        "# Blender 5.0.1 MTL File: 'a.blend'\n\nnewmtl wood\nKd 0.5 0.25 0.1\nKe .5 0 0\n",
    )
    values = octex.load_surface(found).evaluate_all([0], np.array([[1.0, 0, 0]]), [0.0])[0]
    np.testing.assert_allclose(values, [0.5, 0.25, 0.1, 0.5, 0, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("key", "channel", "lanes"),
    [
        ("map_Kd", "base_color", (0, 1, 2)),
        ("map_Ks", "specular", (0, 1, 2)),
        ("map_Ke", "emissive", (0, 1, 2)),
        ("map_emissive", "emissive", (0, 1, 2)),
        ("map_Pm", "metallic", (0,)),
        ("map_metallic", "metallic", (0,)),
        ("MAP_PR", "roughness", (0,)),
        ("map_roughness", "roughness", (0,)),
        ("map_ao", "occlusion", (0,)),
        ("map_d", "alpha", (0,)),
        ("norm", "normal", (0, 1, 2)),
        ("map_Kn", "normal", (0, 1, 2)),
        ("map_tangentSpaceNormal", "normal", (0, 1, 2)),
        ("map_Bump", "normal", (0, 1, 2)),
        ("bump", "normal", (0, 1, 2)),
    ],
)
def test_a_map_is_a_channel(tmp_path, key, channel, lanes):
    found = describe(tmp_path, f"{key} a.png")
    given = found.material.inputs[channel]
    assert set(found.material.inputs) == {"base_color", channel}
    np.testing.assert_array_equal(texels(given)[..., :3], COLORS.astype(np.uint16) * 257)
    assert given.lanes == lanes
    assert given.factor == (1.0,) * len(lanes)
    assert given.offset == ()
    assert found.slots == (Slot(),)
    assert found.material.alpha_mode == ("blend" if channel == "alpha" else "opaque")


@pytest.mark.parametrize(
    "lines",
    [
        "", "d 1", "Tr 0", "Tr 1", "Ke 0 0 0", "Ke 0", "Ks 1 1 1", "Ns 96", "map_Kd", "map_Kd -clamp on",
        "map_Pr", "map_Kd .",
    ]
    + [f"{key} a.png" for key in ("map_Ns", "map_Ka", "disp", "decal", "refl", "map_Ps")]
    + [f"{key} 0.5" for key in ("Ps", "Pc", "Pcr", "aniso", "anisor", "Ni", "Tf", "Ka", "illum")],
)  # fmt: skip
def test_what_says_nothing_is_no_channel(tmp_path, lines):
    assert stated(tmp_path, lines) == {}


def test_colours_and_opacity_multiply_their_maps_unless_they_are_zero_but_others_give_way(tmp_path):
    lines = "Kd .5 .5 .5\nKs .5\nKe 3 3 3\nd .5\nPr .5\nPm 0\n" + "".join(
        f"map_{key} a.png\n" for key in ("Kd", "Ks", "Ke", "d", "Pr", "Pm")
    )
    inputs = describe(tmp_path, lines).material.inputs
    half = float(srgb_to_linear(0.5))
    factors = {name: given.factor[0] for name, given in inputs.items()}
    assert factors == pytest.approx(
        {"base_color": half, "specular": half, "emissive": 3, "alpha": 0.5, "roughness": 1, "metallic": 1}
    )
    lines = "Kd 0 0 0\nKs 0 0 0\nKe 0 0 0\nd 0\nmap_Kd a.png\nmap_Ks a.png\nmap_Ke a.png\nmap_d a.png"
    for given in describe(tmp_path, lines).material.inputs.values():
        assert given.factor == (1.0,) * len(given.factor)


def test_ks_and_ns_count_beside_a_map_or_a_roughness_or_when_asked_for(tmp_path):
    lines = "newmtl a\nKs .5\nNs 90\nnewmtl b\nmap_Ks a.png\nPr .1\nNs 250\n"
    (tmp_path / "m.mtl").write_text(lines)
    (tmp_path / "a.png").write_bytes(png(COLORS))

    def read(*wanted, channels=None):
        return load_materials(tmp_path / "m.obj", ["m.mtl"], set(wanted), Options(channels=channels))[0]

    assert set(read("a")["a"].material.inputs) == {"base_color"}
    assert set(read("a", channels=("specular",))["a"].material.inputs) == {"base_color", "specular"}
    both = read("a", "b")
    assert set(both["a"].material.inputs) == {"base_color", "specular", "roughness"}
    np.testing.assert_allclose(both["a"].material.inputs["roughness"].factor, 0.7)
    np.testing.assert_allclose(both["b"].material.inputs["roughness"].factor, 0.1)


@pytest.mark.parametrize(
    ("line", "lane"),
    [
        ("map_d cut.png", 3), ("map_d grey.png", 0), ("map_d -mm 0 0.5 grey.png", 0),
        ("map_d -imfchan z cut.png", 3), ("map_d -imfchan r cut.png", 0), ("map_d -imfchan M grey.png", 3),
        ("map_Pr cut.png", 0), ("map_Pr -imfchan g a.png", 1), ("map_Pm -imfchan b a.png", 2),
        ("map_ao -imfchan m cut.png", 3),
    ],
)  # fmt: skip
def test_a_single_value_is_read_from_one_component(tmp_path, line, lane):
    (given,) = stated(tmp_path, line).values()
    assert given.lanes == (lane,)


def test_luminance_is_weighted_from_the_stored_values(tmp_path, monkeypatch):
    weights = [0.2126, 0.7152, 0.0722]
    given = stated(tmp_path, "map_Pr -imfchan l a.png")["roughness"]
    assert given.lanes == (0,)
    np.testing.assert_allclose(texels(given)[..., 0], COLORS.astype(float) @ weights * 257, atol=0.51)
    light = np.random.default_rng(0).random((2, 3, 4), np.float32)
    monkeypatch.setattr(octex.source.models.mtl, "decode_image", lambda *_: light)
    given = stated(tmp_path, "map_Pr -imfchan l a.png")["roughness"]
    np.testing.assert_allclose(texels(given)[..., 0], light[..., :3] @ np.float32(weights), atol=1e-6)


def test_base_and_gain_change_the_stored_values(tmp_path, monkeypatch):
    given = describe(tmp_path, "map_Kd -mm -0.25 2 a.png").material.inputs["base_color"]
    expected = np.clip(2 * (COLORS / 255.0) - 0.25, 0, 1) * 65535
    np.testing.assert_allclose(texels(given)[..., :3], expected, atol=0.51)
    light = np.array([[[0, 0.5, 3, 1]]], np.float32)
    monkeypatch.setattr(octex.source.models.mtl, "decode_image", lambda *_: light)
    given = stated(tmp_path, "map_Ke -mm -0.25 2 a.png")["emissive"]
    np.testing.assert_allclose(texels(given)[0, 0, :3], [0, 0.75, 5.75])


def test_absolute_paths_are_names_beside_the_model(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "near").mkdir()
    (tmp_path / "far" / "a.png").write_bytes(png(255 - COLORS))
    found = describe(tmp_path / "near", f"map_Kd {tmp_path / 'far' / 'a.png'}").material.inputs["base_color"]
    np.testing.assert_array_equal(texels(found)[..., :3], COLORS.astype(np.uint16) * 257)
    (tmp_path / "far" / "other.png").write_bytes(png(COLORS))
    with pytest.raises(
        ImageError, match=r"other\.png is missing; put it next to m\.mtl, or read only other channels"
    ):
        describe(tmp_path / "near", f"map_Kd {tmp_path / 'far' / 'other.png'}")


def test_maps_that_move_coordinates_alike_share_a_slot(tmp_path):
    found = describe(
        tmp_path,
        "map_Kd -s 2 3 1 -o .5 a.png\nmap_Ks -o .5 0 0 -s 2 3 b.png\n"
        "map_Pr a.png\nmap_d -clamp on -t 1 1 1 a.png",
    )
    assert found.slots == (Slot(), Slot("", (2, 3), 0.0, (0.5, 0)))
    slots = {name: given.texture.slot for name, given in found.material.inputs.items() if given.texture}
    assert slots == {"base_color": 1, "specular": 1, "roughness": 0, "alpha": 0}
    wraps = {name: given.texture.wrap_u for name, given in found.material.inputs.items() if given.texture}
    assert wraps == {"base_color": REPEAT, "specular": REPEAT, "roughness": REPEAT, "alpha": CLAMP}


def test_an_image_is_read_once_however_often_it_is_named(tmp_path):
    inputs = describe(tmp_path, "map_Kd cut.png\nmap_d cut.png\nmap_Pr -s 2 cut.png").material.inputs
    assert texels(inputs["base_color"]) is texels(inputs["alpha"]) is texels(inputs["roughness"])
    inputs = describe(tmp_path, "map_Pr -imfchan l a.png\nmap_Pm -imfchan l -s 2 a.png").material.inputs
    assert texels(inputs["roughness"]) is texels(inputs["metallic"])


def test_options_that_are_left_out_change_nothing(tmp_path):
    options = (
        '-blendu off -blendv on -boost 2 -cc on -colorspace sRGB -texres 64 -t 1 2 3 -type sphere "a.png"'
    )
    found = describe(tmp_path, f"map_Kd {options}")
    np.testing.assert_array_equal(
        texels(found.material.inputs["base_color"])[..., :3], COLORS.astype(np.uint16) * 257
    )
    assert found.slots == (Slot(),)


@pytest.mark.parametrize("wrap", [REPEAT, CLAMP])
def test_heights_become_normals_by_central_differences_and_wrap(wrap):
    heights = np.random.default_rng(1).random((259, 3))
    codes = normals_of_heights(heights, 4.0, wrap)
    rows, columns = heights.shape

    def height(row, column):
        if wrap == CLAMP:
            return float(heights[min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)])
        return float(heights[row % rows, column % columns])

    for row in range(rows):
        for column in range(columns):
            right = 4 * (height(row, column + 1) - height(row, column - 1)) / 2
            up = 4 * (height(row - 1, column) - height(row + 1, column)) / 2
            normal = np.array([-right, -up, 1]) / np.sqrt(right**2 + up**2 + 1)
            np.testing.assert_allclose(codes[row, column, :3] / 32767.5 - 1, normal, atol=3e-5)


@pytest.mark.parametrize(
    ("line", "lane", "strength", "wrap"),
    [
        ("bump grey.png", None, 1, REPEAT),
        ("map_Bump -bm 3 -clamp on grey.png", None, 3, CLAMP),
        ("map_bump -bm -2 -mm 0.5 2 grey.png", None, -4, REPEAT),
        ("bump -imfchan g a.png", 1, 1, REPEAT),
        ("bump -imfchan m cut.png", 3, 1, REPEAT),
    ],
)
def test_a_grey_bump_map_or_a_component_of_one_holds_heights(tmp_path, line, lane, strength, wrap):
    given = stated(tmp_path, line)["normal"]
    image = GREYS[..., 0] if lane is None else (CUT_OUT if lane == 3 else COLORS)[..., lane]
    expected = normals_of_heights(image / 255.0, strength, wrap)
    assert given.factor == (1, 1, 1)
    assert given.texture.wrap_v == wrap
    np.testing.assert_allclose(texels(given).astype(float), expected, atol=1.1)


def test_materials_share_the_normals_of_one_height_map_also_of_luminance(tmp_path):
    (tmp_path / "m.mtl").write_text("newmtl a\nbump grey.png\nnewmtl b\nbump -s 2 grey.png\n")
    (tmp_path / "grey.png").write_bytes(IMAGES["grey.png"])
    found, *_ = load_materials(tmp_path / "m.obj", ["m.mtl"], {"a", "b"}, Options())
    assert texels(found["a"].material.inputs["normal"]) is texels(found["b"].material.inputs["normal"])
    given = stated(tmp_path, "bump -imfchan l a.png")["normal"]
    heights = COLORS / 255.0 @ [0.2126, 0.7152, 0.0722]
    np.testing.assert_allclose(texels(given).astype(float), normals_of_heights(heights, 1, REPEAT), atol=2)


def test_a_coloured_bump_map_is_a_normal_map_with_scaled_slopes_and_a_normal_map_stands_before_it(tmp_path):
    for line in ("bump -bm 0.5 a.png", "norm -bm 0.5 a.png", "map_Bump -imfchan z -bm 0.5 a.png"):
        assert stated(tmp_path, line)["normal"].factor == (0.5, 0.5, 1)
    given = stated(tmp_path, "bump grey.png\nnorm a.png")["normal"]
    np.testing.assert_array_equal(texels(given)[..., 0], COLORS[..., 0].astype(np.uint16) * 257)


def test_grey_survives_the_noise_of_jpeg():
    grey = np.repeat(np.linspace(0, 65535, 600).astype(np.uint16)[:, None, None], 4, axis=2)
    assert is_grey(grey)
    grey[400, 0, 1] += 3 * 257
    assert is_grey(grey)
    grey[400, 0, 1] += 30 * 257
    assert not is_grey(grey)
    assert not is_grey(np.array([[[0.5, 0.5, 1, 1]]], np.float32))


def test_images_of_channels_that_nobody_wants_are_not_read_and_missing_channels_are_refused(tmp_path):
    keys = ("map_Ks", "map_Ke", "map_Pm", "map_Pr", "map_ao", "map_d", "norm")
    lines = "map_Kd a.png\nKs red\nPr rough\nNs many\n" + "".join(f"{key} gone.png\n" for key in keys)
    path = square(tmp_path, lines)
    surface = load_surface(path, channels=["base_color"])
    assert [channel.name for channel in surface.channels] == ["base_color"]
    assert "gone.png" not in surface.provenance["files"]
    assert load_surface(square(tmp_path, "map_Kd gone.png\nPr 0.5"), channels=["roughness"]).uv is not None
    path = square(tmp_path, "map_Kd a.png\nKe 0 0 0\nmap_Pr gone.png\nNs 10\nKs 1 1 1")
    with pytest.raises(ModelError, match=r"a\.obj has no channel metallic; it has base_color, roughness$"):
        load_surface(path, channels=["metallic"])


@pytest.mark.parametrize(
    ("line", "error", "message"),
    [
        *(
            (f"{key} gone.png", ImageError, r"a\.mtl: material wood: the image gone.png is missing")
            for key in ("map_Kd", "map_Ks", "map_Ke", "map_d", "map_Pr", "map_Pm", "map_ao", "norm", "bump")
        ),
        ("map_Kd " + "a" * 300, ImageError, "is missing"),
        ("map_Pr a.mtl", ImageError, "material wood: a.mtl cannot be read as an image"),
        ("Kd red", ModelError, "material wood: Kd is 'red'"),
        ("d full", ModelError, "material wood: d is 'full'"),
        ("Tr nan", ModelError, "material wood: Tr is 'nan'"),
        ("Ks spectral file.rfl", ModelError, "material wood: Ks is 'spectral file.rfl', not numbers"),
        ("Ke bright", ModelError, "material wood: Ke is 'bright'"),
        ("Pm inf", ModelError, "material wood: Pm is 'inf'"),
        ("Pr x", ModelError, "material wood: Pr is 'x'"),
        ("Ns x", ModelError, "material wood: Ns is 'x'"),
        ("bump -bm a.png", ModelError, "material wood: bump -bm is 'a.png', not numbers; correct the line"),
        ("map_Kd -mm 0 a.png", ModelError, "material wood: map_Kd -mm is '0 a.png'"),
        ("map_Kd -s a.png", ModelError, "material wood: map_Kd -s is ''"),
        ("map_Kd -o nan 1 a.png", ModelError, "material wood: map_Kd -o is 'nan 1'"),
        ("map_d -imfchan alpha a.png", ModelError, "map_d -imfchan is 'alpha', not one of r, g, b, m, l, z"),
    ],
)
def test_a_bad_line_is_named(tmp_path, line, error, message):
    with refused(error, message):
        load_surface(square(tmp_path, line))


def test_every_file_read_is_in_the_provenance_by_its_name_beside_the_model_or_its_name_alone(tmp_path):
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "c.png").write_bytes(png(COLORS))
    path = square(tmp_path, "map_Kd maps/c.png\nmap_Pr a.png\nmap_ao C:\\work\\a.png")
    names = ("a.mtl", "a.png", "maps/c.png")
    expected = {name: hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() for name in names}
    assert json.loads(load_surface(path).provenance["files"]) == expected
    assert "files" not in load_surface(obj(tmp_path / "b.obj", OBJ_SQUARE + FACES)).provenance
    files = ImageFiles(tmp_path / "models")
    files.note(tmp_path / "shared" / "wood.png", b"")
    assert list(files.files) == ["wood.png"]


def test_maps_at_different_coordinates_are_read_each_at_its_own(tmp_path):
    mtl = "map_Kd -s 2 3 -o 0.25 0.5 a.png\nmap_Ks b.png\nmap_Pr -clamp on -s 2 -o 0.5 0 0 -mm 0 1 a.png"
    surface = load_surface(square(tmp_path, mtl))
    samples = surface.scatter(40)
    for channel, (line, change) in {
        "base_color": ("map_Kd a.png", lambda u, v: (2 * u + 0.25, 3 * v + 0.5)),
        "specular": ("map_Ks b.png", lambda u, v: (u, v)),
        "roughness": ("map_Pr -clamp on a.png", lambda u, v: (2 * u + 0.5, v)),
    }.items():
        moved = OBJ_SQUARE
        for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)):
            moved = moved.replace(f"vt {u} {v}\n", "vt {} {}\n".format(*change(u, v)), 1)
        alone = load_surface(square(tmp_path, line, moved + "usemtl wood\n" + FACES))
        np.testing.assert_allclose(
            surface.evaluate(samples, channel), alone.evaluate(samples, channel), atol=1e-5
        )


@pytest.mark.parametrize(
    ("options", "direction"),
    [("", (1, 1)), ("-s -1 1", (-1, 1)), ("-s 1 -1", (1, -1)), ("-bm 0.5", (0.5, 0.5))],
)
def test_a_normal_map_turns_the_normal_toward_u_and_v(tmp_path, options, direction):
    code = np.array([0.6, 0.48, 0.64])
    image = np.tile(np.rint((code + 1) * 32767.5).astype(np.uint16), (2, 2, 1))
    path = square(tmp_path, f"norm {options} t.png")
    (tmp_path / "t.png").write_bytes(png(image))
    surface = load_surface(path)
    expected = np.array([code[0] * direction[0], code[1] * direction[1], code[2]])
    expected /= np.linalg.norm(expected)
    np.testing.assert_allclose(surface.evaluate(surface.scatter(10), "normal"), [expected] * 10, atol=1e-4)
