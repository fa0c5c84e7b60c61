"""Deep images come back as they were stored, tiles are joined, and damaged ones are refused by name."""

import json
import struct
import sys

import numpy as np
import pytest

import octex
from octex.channels import srgb_to_linear
from octex.errors import ImageError, MissingExtraError
from octex.source.images.decode import decode_image
from octex.source.images.openimage import deep_format
from octex.source.images.tiles import join_tiles, tile_files, tile_grid
from octex.source.mesh import SurfaceSamples
from tests.make.deep_images import Part, exr, hdr, pfm, pnm, psd, sgi, tiff
from tests.make.fixtures import png, random_image, saved
from tests.make.refusal import refused

needs_extra = pytest.mark.usefixtures("extra")


@pytest.fixture
def extra():
    pytest.importorskip("OpenImageIO", reason="needs octex[images]")


def random_light(height, width, channels, dtype="float32"):
    """Values from −1 to 100, exact in halves."""
    values = np.random.default_rng(channels).uniform(-1, 100, (height, width, channels))
    return values.astype(np.float16).astype(dtype)


def planes(values, names):
    return {name: np.ascontiguousarray(values[..., place]) for place, name in enumerate(names)}


def with_alpha(values, opaque=1):
    """RGBA of grey or RGB."""
    colors = np.broadcast_to(values, (*values.shape[:2], 3))
    return np.dstack([colors, np.full(values.shape[:2], opaque, values.dtype)])


@needs_extra
@pytest.mark.parametrize("dtype", ["float16", "float32"])
@pytest.mark.parametrize("names", ["RGB", "Y", "Z"])
def test_openexr_images_keep_every_value(names, dtype):
    stored = random_light(5, 7, len(names), dtype)
    found = decode_image(exr(Part(planes(stored, names))), "a")
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, with_alpha(stored))


@needs_extra
def test_channels_are_found_by_name_and_the_first_layer_serves_where_no_channel_stands_alone():
    stored = random_light(2, 3, 3)
    channels = planes(stored, "RGB")
    other = {name: np.full((2, 3), 9, np.float32) for name in ("Z", "a.x", "id")}
    ids = {"id": np.full((2, 3), 9, np.uint32)}
    layer = {"diffuse." + name: channel for name, channel in channels.items()}
    second = {"specular." + name: channel + 1 for name, channel in channels.items()}
    for part in (channels | other | ids, other | layer | second, channels | second):
        np.testing.assert_array_equal(decode_image(exr(Part(part)), "a"), with_alpha(stored))


@needs_extra
def test_the_first_part_with_colour_is_taken():
    stored = random_light(2, 3, 3)
    depth = {"Z": np.ones((2, 3), np.float32)}
    data = exr(Part(depth), Part(planes(stored, "RGB")), Part(planes(stored + 1, "RGB")))
    np.testing.assert_array_equal(decode_image(data, "a"), with_alpha(stored))


@needs_extra
def test_alpha_of_openexr_images_is_divided_out_where_it_is_above_0():
    alphas = np.array([[0.0, 0.25, 1.0, 2.0, -0.5]], np.float32)
    stored = np.dstack([np.full((1, 5), value, np.float32) for value in (0.5, 0.25, 0)] + [alphas])
    expected = stored.copy()
    expected[0, 1] = (2, 1, 0, 0.25)
    expected[0, 3] = (0.25, 0.125, 0, 1)
    expected[0, 4, 3] = 0
    np.testing.assert_array_equal(decode_image(exr(Part(planes(stored, "RGBA"))), "a"), expected)
    grey = stored[..., [0, 3]]
    found = decode_image(exr(Part(planes(grey, "YA"))), "a")
    np.testing.assert_array_equal(found, expected[..., [0, 0, 0, 3]])


@needs_extra
def test_the_display_window_of_openexr_images_is_what_is_read():
    stored = random_light(3, 4, 3)
    part = Part(planes(stored, "RGB"), corner=(2, -1), display=(0, 0, 4, 3))
    expected = np.zeros((4, 5, 4), np.float32)
    expected[:2, 2:5] = with_alpha(stored)[1:, :3]
    np.testing.assert_array_equal(decode_image(exr(part), "a"), expected)


@needs_extra
def test_radiance_images_hold_a_shared_exponent():
    stored = np.random.default_rng(1).integers(0, 256, (4, 3, 4), np.uint8)
    stored[0, 0, 3] = 0
    expected = stored[..., :3] * 2.0 ** (stored[..., 3:].astype(float) - 136)
    expected[0, 0] = 0
    for order, turned in (
        (b"-Y %d +X %d", expected),
        (b"+Y %d +X %d", expected[::-1]),
        (b"-Y %d -X %d", expected[:, ::-1]),
        (b"+Y %d -X %d", expected[::-1, ::-1]),
    ):
        found = decode_image(hdr(stored, order), "a")
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, with_alpha(turned.astype(np.float32)))


@needs_extra
def test_run_lengths_of_radiance_images_are_read():
    row = bytes([2, 2, 0, 8]) + bytes([136, 128] * 3 + [136, 136])  # eight times 128 · 2⁰
    data = hdr(np.zeros((1, 8, 4), np.uint8))[: -8 * 4] + row
    np.testing.assert_array_equal(decode_image(data, "a")[..., :3], np.full((1, 8, 3), 128.0))


@needs_extra
@pytest.mark.parametrize("samples", [1, 3])
@pytest.mark.parametrize("dtype", ["uint16", "uint32", "float16", "float32", "float64"])
def test_tiff_images_keep_every_code_and_value(dtype, samples):
    if dtype.startswith("u"):
        stored = random_image(3, 4, samples, "uint16")
        expected = with_alpha(stored, 65535)
        stored = stored.astype(dtype) * (np.iinfo(dtype).max // 65535)
    else:
        stored = random_light(3, 4, samples, dtype)
        expected = with_alpha(stored.astype(np.float32))
    for order in "<>":
        found = decode_image(tiff(stored, 1 if samples == 1 else 2, order=order), "a")
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("order", ["<", ">"])
def test_tiff_images_of_eight_bits_have_either_byte_order(order):
    stored = random_image(3, 4, 3, "uint8")
    found = decode_image(tiff(stored, 2, order=order), "a")
    np.testing.assert_array_equal(found, with_alpha(257 * stored.astype(np.uint16), 65535))


@needs_extra
def test_tiff_alpha_is_what_its_tag_says():
    stored = np.array([[[100, 200, 300, 6553], [9, 8, 7, 0], [60000, 2, 1, 6553]]], np.uint16)
    given = tiff(stored, 2, alpha=2)
    np.testing.assert_array_equal(decode_image(given, "a"), stored)
    divided = np.array([[[1000, 2000, 3000, 6553], [9, 8, 7, 0], [65535, 20, 10, 6553]]])
    found = decode_image(tiff(stored, 2, alpha=1), "a").astype(int)
    assert abs(found - divided).max() <= 1
    unknown = decode_image(tiff(stored, 2, alpha=0), "a")
    np.testing.assert_array_equal(unknown, with_alpha(stored[..., :3], 65535))


@needs_extra
def test_tiff_images_may_call_white_0():
    stored = random_image(3, 4, 1, "uint16")
    np.testing.assert_array_equal(decode_image(tiff(stored, 0), "a"), with_alpha(65535 - stored, 65535))
    light = random_light(3, 4, 1)
    np.testing.assert_array_equal(decode_image(tiff(light, 0), "a"), with_alpha(1 - light))


@needs_extra
def test_deep_images_are_to_be_flattened(tmp_path):
    import OpenImageIO

    spec = OpenImageIO.ImageSpec(2, 2, 4, "half")
    spec.channelnames, spec.deep = ("R", "G", "B", "A"), True
    file = OpenImageIO.ImageOutput.create("a.exr")
    assert file.open(str(tmp_path / "a.exr"), spec)
    texels = OpenImageIO.DeepData()
    texels.init(4, 4, ["half"] * 4, ["R", "G", "B", "A"])
    assert file.write_deep_image(texels)
    file.close()
    with pytest.raises(ImageError, match=r"a\.exr is a deep image, of several layers at a pixel; flatten it"):
        decode_image((tmp_path / "a.exr").read_bytes(), "a.exr")


@needs_extra
def test_other_formats_of_16_bits_keep_every_code():
    stored = random_image(3, 4, 3, "uint16")
    for data in (psd(stored), sgi(stored), pnm(stored)):
        np.testing.assert_array_equal(decode_image(data, "a"), with_alpha(stored, 65535))
    short = pnm(np.array([[[0, 1023, 511]]], np.uint16), 1023)
    np.testing.assert_allclose(decode_image(short, "a")[0, 0, :3], [0, 65535, 511 / 1023 * 65535], atol=1)
    found = decode_image(saved(stored[..., 0], "JPEG2000", irreversible=False), "a")
    np.testing.assert_array_equal(found, with_alpha(stored[..., :1], 65535))


@needs_extra
def test_other_formats_of_floats_keep_every_value():
    stored = random_light(3, 4, 3)
    for data in (psd(stored), pfm(stored)):
        found = decode_image(data, "a")
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, with_alpha(stored))


def test_what_pillow_keeps_whole_needs_no_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenImageIO", None)
    codes, light = random_image(3, 4, 1, "uint16"), random_light(3, 4, 1)
    deep = png(random_image(3, 4, 3, "uint16"))
    for data, expected in (
        (tiff(codes, 1), with_alpha(codes, 65535)),
        (pnm(codes), with_alpha(codes, 65535)),
        (tiff(light, 1), with_alpha(light)),
        (pfm(light), with_alpha(light)),
    ):
        np.testing.assert_array_equal(decode_image(data, "a"), expected)
    assert deep_format(deep) is None
    with pytest.raises(ImageError, match="3 values that are infinite or not a number"):
        decode_image(tiff(np.array([[[np.nan]]], np.float32), 1), "a")


RGB = Part(planes(random_light(4, 4, 3), "RGB"))
CODES = random_image(4, 4, 3, "uint16")
ONES = np.ones((2, 2), np.float32)
DEEP = {
    "exr": exr(RGB), "hdr": hdr(random_image(4, 4, 4)), "tif": tiff(CODES, 2), "psd": psd(CODES),
    "sgi": sgi(CODES), "ppm": pnm(CODES), "pfm": pfm(random_light(4, 4, 3)),
}  # fmt: skip


@pytest.mark.parametrize("ending", DEEP)
def test_a_missing_extra_is_named_with_the_command_that_installs_it(ending, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenImageIO", None)
    assert deep_format(DEEP[ending]) == ending
    with pytest.raises(MissingExtraError, match=r"wood: .* OpenImageIO is needed; .*octex\[images\]'"):
        decode_image(DEEP[ending], "wood")


def jpeg2000(width, height):
    """The head of a JPEG 2000 codestream of 16 bits."""
    sizes = struct.pack(">HHIIIIIIIIH", 41, 0, width, height, 0, 0, width, height, 0, 0, 1)
    return b"\xff\x4f\xff\x51" + sizes + b"\x0f\1\1" + b"\xff\xd9"


@needs_extra
@pytest.mark.parametrize(
    ("data", "message"),
    [
        (exr(RGB)[:-40], "cannot be read as an image"),
        (b"\x76\x2f\x31\x01nothing like it", "cannot be read as an image"),
        (b"\x76\x2f\x31\x01", "cannot be read as an image"),
        (hdr(random_image(4, 4, 4))[:-4], "cannot be read as an image"),
        (hdr(random_image(4, 4, 4), b"+X %d -Y %d"), "stored column by column"),
        (tiff(CODES, 2)[:40], "cannot be read as an image"),
        (tiff(CODES.astype(np.int16), 2), "texels of int16, which are not colours"),
        (tiff(CODES, 8), "a form that octex does not read"),
        (exr(RGB._replace(display=(9, 9, 12, 12))), "outside of the display window"),
        (exr(Part({"Z": ONES, "u.B": ONES})), "no channels R, G and B or Y, but Z, u.B"),
        (exr(Part({"Z": ONES}), Part({"id": ONES})), "no channels R, G and B or Y, but Z, id"),
        (exr(Part({"Y": ONES, "RY": ONES, "BY": ONES})), "no channels R, G and B or Y, but Y"),
        (exr(Part({"Y": ONES.astype(np.uint32)})), "texels of uint"),
        (exr(Part({"Y": ONES * np.inf})), "12 values that are infinite or not a number"),
        (exr(RGB._replace(display=(0, 0, 29999, 19999))), "30000 × 20000 texels; octex reads up to"),
        (exr(RGB._replace(display=(0, 0, 15999, 15999))), "truncated: it cannot hold 16000 × 16000"),
        (hdr(random_image(4, 4, 4), b"-Y 15%.3d +X 1600%d"), "cannot"),
        (tiff(CODES, 2, size=(16000, 16000)), "cannot"),
        (jpeg2000(30000, 20000), "30000 × 20000 texels"),
        (jpeg2000(1000, 1000), "truncated"),
        (jpeg2000(0, 0), "cannot be read as an image"),
    ],
)
def test_bad_deep_images_are_refused_in_one_line_that_names_them(data, message):
    with refused(ImageError, message, "wood.exr"):
        decode_image(data, "wood.exr")


@needs_extra
@pytest.mark.parametrize("ending", DEEP)
def test_damaged_deep_images_are_read_or_refused(ending):
    whole = DEEP[ending]
    random = np.random.default_rng(7)
    for count in range(0, len(whole), max(len(whole) // 40, 1)):
        changed = bytearray(whole)
        changed[int(random.integers(len(whole)))] ^= 1 << int(random.integers(8))
        for data in (whole[:count], bytes(changed)):
            try:
                texels = decode_image(data, "wood")
            except ImageError as error:
                assert "wood" in str(error)
            else:
                assert texels.ndim == 3


@needs_extra
def test_real_panoramas_are_read(models):
    paths = sorted((models / "pmndrs-hdri").glob("*.exr"))
    if not paths:
        pytest.skip("the panoramas are not there")
    for path in paths:
        texels = decode_image(path.read_bytes(), path.name)
        assert texels.shape == (256, 512, 4)
        assert texels.dtype == np.float32
        assert texels.max() > 1


RED, GREEN, BLUE = [255, 0, 0], [0, 255, 0], [0, 0, 255]
#: Below tile 1012 lies a gap, which is black.
TILES = {1001: [[RED, BLUE], [GREEN, BLUE]], 1011: [[GREEN]], 1012: [[BLUE]]}
#: A square over two columns and two rows of tiles, v up.
CORNERS = [(0, 0), (2, 0), (2, 2), (0, 2)]
PLACES = {
    (0.5, 1.5): RED,
    (0.5, 0.5): GREEN,
    (1.5, 1.0): BLUE,
    (1, 3): GREEN,
    (3, 3): BLUE,
    (3, 1): [0, 0, 0],
}


def as_mtl(folder):
    positions = "".join(f"v {2 * x} {2 * y} 0\nvt {x} {y}\n" for x, y in CORNERS)
    (folder / "a.obj").write_text(f"mtllib a.mtl\n{positions}usemtl a\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    (folder / "a.mtl").write_text("newmtl a\nmap_Kd textures\\wood.<UDIM>.png\n")
    return folder / "a.obj"


def as_usd(folder):
    pytest.importorskip("pxr", reason="the extra octex[usd] is not installed")
    (folder / "a.usda").write_text(f"""#usda 1.0
(upAxis = "Y"
metersPerUnit = 1)
def Mesh "square" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
    point3f[] points = {[(2 * x, 2 * y, 0) for x, y in CORNERS]}
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    float2[] primvars:st = {CORNERS} (interpolation = "vertex")
    rel material:binding = </wood>
}}
def Material "wood" {{
    token outputs:surface.connect = </wood/surface.outputs:surface>
    def Shader "surface" {{
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </wood/image.outputs:rgb>
        token outputs:surface
    }}
    def Shader "image" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @textures/wood.<UDIM>.png@
        float3 outputs:rgb
    }}
}}
""")
    return folder / "a.usda"


@pytest.mark.parametrize("write", [as_mtl, as_usd])
def test_tiles_lie_where_their_numbers_say(write, tmp_path):
    path = write(tmp_path)
    with refused(ImageError, "wood.<UDIM>.png is missing; put it next to"):
        octex.load_surface(path)
    (tmp_path / "textures").mkdir()
    for number, texels in TILES.items():
        (tmp_path / f"textures/wood.{number}.png").write_bytes(png(np.array(texels, np.uint8)))
    surface = octex.load_surface(path)
    assert sum(name.endswith(".png") for name in json.loads(surface.provenance["files"])) == len(TILES)
    xy = np.array(list(PLACES), np.float64)
    places = np.column_stack([xy, np.zeros(len(xy))])
    upper = xy[:, 1] > xy[:, 0]
    weights = np.where(
        upper[:, None],
        np.column_stack([4 - xy[:, 1], xy[:, 0], xy[:, 1] - xy[:, 0]]),
        np.column_stack([4 - xy[:, 0], xy[:, 0] - xy[:, 1], xy[:, 1]]),
    )
    samples = SurfaceSamples(places, places, places, upper.astype(np.int32), weights / 4, places)
    np.testing.assert_allclose(
        surface.evaluate(samples), srgb_to_linear(np.array(list(PLACES.values())) / 255), atol=1e-4
    )


def test_only_files_with_a_tile_number_are_tiles(tmp_path):
    for name in (
        "a.1001.png",
        "a.1012.PNG",
        "a.0999.png",
        "a.1000.png",
        "a.10010.png",
        "b.1001.png",
        "a.1110.png",
    ):
        (tmp_path / name).write_bytes(b"")
    found = tile_files(tmp_path / "a.<UDIM>.png")
    assert {number: path.name for number, path in found.items()} == {1001: "a.1001.png", 1110: "a.1110.png"}
    assert tile_grid(found) == (10, 11)
    assert not tile_files(tmp_path / "none" / "a.<UDIM>.png")


def test_tiles_of_two_kinds_or_of_too_many_texels_are_refused():
    whole = random_image(2, 2, 4).astype(np.uint16)
    with refused(ImageError, "wood: some tiles have integers, others floats; save all in one format"):
        join_tiles({1001: whole, 1002: whole.astype(np.float32)}, "wood")
    with refused(ImageError, "wood: the image of all 2 tiles has 50000 × 6600 texels; octex reads up to"):
        join_tiles(
            {1001: np.zeros((1, 5000, 4), np.uint16), 1110: np.zeros((600, 1, 4), np.uint16)},
            "wood",
        )
