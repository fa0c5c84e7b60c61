"""Image files of every kind become texels without loss, or are refused by name."""

import io
import struct
import sys
import warnings
import zlib
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module

import numpy as np
import PIL.Image
import pytest

from octex.errors import ImageError, MissingExtraError
from octex.source.images.decode import as_texels, decode_image, global_settings
from octex.source.images.openimage import MAX_TEXELS
from octex.source.models.reading import parse_numbers
from tests.make.deep_images import tiff
from tests.make.fixtures import _chunk, png, random_image, saved
from tests.make.refusal import refused


def expected_texels(stored):
    """Texels of stored codes (height, width, 1 to 4), by the definition."""
    height, width, channels = stored.shape
    unit = 257 if stored.dtype == np.uint8 else 1
    texels = np.full((height, width, 4), 65535)
    for y in range(height):
        for x in range(width):
            codes = [int(code) * unit for code in stored[y, x]]
            texels[y, x, :3] = codes[:3] if channels >= 3 else codes[:1] * 3
            if channels in (2, 4):
                texels[y, x, 3] = codes[-1]
    return texels


@pytest.mark.parametrize("interlaced", [False, True])
@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_png_images_of_8_and_16_bits_keep_every_code(channels, dtype, interlaced):
    for height, width in ((5, 7), (1, 1), (9, 2)):
        stored = random_image(height, width, channels, dtype)
        found = decode_image(png(stored, interlaced=interlaced), "a.png")
        assert found.dtype == np.uint16
        np.testing.assert_array_equal(found, expected_texels(stored))


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("channels", [1, 3])
def test_the_transparent_colour_of_a_png_image_is_transparent(channels, dtype):
    stored = random_image(3, 3, channels, dtype)
    codes = stored[1, 2].tolist()
    alpha = decode_image(png(stored, transparent=codes), "a.png")[..., 3]
    np.testing.assert_array_equal(alpha == 0, (stored == stored[1, 2]).all(axis=2))


def test_palettes_give_their_colours_and_transparencies_and_bilevel_images_are_black_and_white():
    palette = random_image(1, 5)[0]
    indices = np.array([[[0], [1], [2]], [[3], [4], [0]]], np.uint8)
    found = decode_image(png(indices, palette=palette, palette_alpha=[0, 128]), "a.png")
    np.testing.assert_array_equal(found[..., :3], palette[indices[..., 0]].astype(int) * 257)
    np.testing.assert_array_equal(found[..., 3] // 257, [[0, 128, 255], [255, 255, 0]])
    image = PIL.Image.fromarray(np.array([[True, False]]))
    np.testing.assert_array_equal(decode_image(saved(image), "a")[0, :, 0], [65535, 0])


@pytest.mark.parametrize(
    ("kind", "options"), [("BMP", {}), ("TIFF", {}), ("TGA", {}), ("WEBP", {"lossless": True}), ("GIF", {})]
)
def test_other_formats_keep_their_codes(kind, options):
    stored = np.repeat(random_image(4, 4, 1), 3, axis=2)
    image = PIL.Image.fromarray(stored[..., 0] if kind == "GIF" else stored)
    np.testing.assert_array_equal(decode_image(saved(image, kind, **options), "a"), expected_texels(stored))


def test_colour_profiles_and_gamma_are_ignored():
    stored = random_image(2, 2)
    data = png(stored)
    at = data.index(b"IDAT") - 4
    gamma = _chunk(b"gAMA", struct.pack(">I", 100000))
    np.testing.assert_array_equal(decode_image(data[:at] + gamma + data[at:], "a"), expected_texels(stored))


@pytest.mark.parametrize("channels", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_arrays_are_taken_as_codes(channels, dtype):
    stored = random_image(3, 4, max(channels, 1), dtype)
    given = stored if channels else stored[..., 0]
    np.testing.assert_array_equal(as_texels(given), expected_texels(stored))


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
def test_arrays_of_floats_are_taken_as_linear_values(dtype):
    for channels in (1, 2, 3, 4):
        values = np.random.default_rng(channels).uniform(-1, 9, (3, 4, channels)).astype(dtype)
        expected = np.ones((3, 4, 4), np.float32)
        expected[..., :3] = values[..., : 3 if channels >= 3 else 1]
        if channels in (2, 4):
            expected[..., 3] = np.clip(values[..., -1], 0, 1)
        found = as_texels(values)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, expected)
    grey = PIL.Image.fromarray(np.array([[0.5, 7.0]], np.float32))
    np.testing.assert_array_equal(as_texels(grey)[..., 2:], [[[0.5, 1], [7, 1]]])


def test_images_of_pillow_are_taken_as_they_are():
    stored = random_image(3, 4, 4)
    np.testing.assert_array_equal(as_texels(PIL.Image.fromarray(stored)), expected_texels(stored))
    grey = random_image(3, 4, 1, "uint16")
    np.testing.assert_array_equal(as_texels(PIL.Image.fromarray(grey[..., 0])), expected_texels(grey))


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((2, 2, 5), np.uint8), "shape"),
        (np.zeros((0, 2, 3), np.uint8), "shape"),
        (np.zeros(3, np.uint8), "shape"),
        (np.zeros((2, 2, 3), np.int16), "uint8 or uint16"),
        (np.zeros((2, 2, 3), bool), "uint8 or uint16"),
        (np.full((1, 2, 3), np.nan, np.float16), "6 values that are infinite or not a number"),
        (np.full((1, 2, 3), 1e300), "6 values that are infinite"),
        (PIL.Image.new("I", (2, 2)), "depth"),
    ],
)
def test_other_arrays_are_refused(image, message):
    with pytest.raises(ImageError, match=message):
        as_texels(image)


def rebuilt(raw):
    """A 16-bit PNG file of 1 × 1 grey texels with given compressed data."""
    header = struct.pack(">IIBBBBB", 1, 1, 16, 0, 0, 0, 0)
    chunks = _chunk(b"IHDR", header) + _chunk(b"IDAT", raw) + _chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


def with_header(data, **changes):
    """A PNG file with another header, its checksum right."""
    fields = dict(
        zip(
            ("width", "height", "depth", "kind", "c", "f", "i"),
            struct.unpack_from(">IIBBBBB", data, 16),
            strict=True,
        )
    )
    return data[:8] + _chunk(b"IHDR", struct.pack(">IIBBBBB", *(fields | changes).values())) + data[33:]


DEEP = png(random_image(8, 8, 3, "uint16"))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not an image"),
        (b"nothing like it", "not an image"),
        (png(random_image(64, 64))[:500], "truncated"),
        (saved(PIL.Image.fromarray(random_image(64, 64)), "JPEG")[:500], "cannot be read as an image"),
        (png(random_image(4, 4))[:60] + b"!" + png(random_image(4, 4))[61:], "checksum"),
        (with_header(png(random_image(4, 4)), width=30000, height=20000), "30000 × 20000 texels"),
        (with_header(png(random_image(4, 4)), width=16000, height=16000), "truncated"),
        (tiff(np.ones((2, 2, 1), np.int32), 1), "not colours"),
        (DEEP[:-12] + _chunk(b"tEXt", b"a\0b") + _chunk(b"IDAT", b"") + DEEP[-12:], "torn apart"),
        (DEEP[:-40], "truncated"),
        (with_header(DEEP, height=9), "truncated"),
        (with_header(DEEP, kind=3), "cannot be read as an image"),
        (DEEP[:60] + b"!" + DEEP[61:], "checksum"),
        (rebuilt(b"not deflate"), "the image data are damaged"),
        (rebuilt(zlib.compress(b"\x09\0\0")), "the image data are damaged .unknown filter"),
    ],
)
def test_bad_images_are_refused_in_one_line_that_names_them(data, message):
    with refused(ImageError, message, "wood.png"):
        decode_image(data, "wood.png")


def test_an_image_that_needs_too_much_memory_is_refused(monkeypatch):
    def exhausted(*_):
        raise MemoryError

    monkeypatch.setattr("octex.source.images.decode._texels", exhausted)
    with pytest.raises(ImageError, match="does not fit into memory"):
        decode_image(png(random_image(2, 2)), "wood")


@pytest.mark.parametrize("kind", ["ICO", "ICNS", "PCX"])
def test_formats_that_are_not_listed_are_not_opened(kind):
    data = saved(PIL.Image.fromarray(random_image(16, 16)), kind)
    with pytest.raises(ImageError, match="not an image of a format that octex reads: PNG, JPEG"):
        decode_image(data, "a")


def test_a_pillow_without_some_formats_reads_the_others(monkeypatch):
    PIL.Image.init()
    for kind in ("AVIF", "WEBP"):
        monkeypatch.delitem(PIL.Image.OPEN, kind)
    assert decode_image(png(random_image(2, 2)), "a").shape == (2, 2, 4)


@pytest.mark.parametrize(
    ("kind", "mark", "skipped", "size", "side"),
    [
        ("WEBP", b"VP8L", 9, struct.pack("<I", (1 << 28) - 1), 16384),  # 14 bits of width − 1, of height − 1
        ("JPEG2000", b"\xff\x4f\xff\x51", 8, struct.pack(">II", 16000, 16000), 16000),  # in its codestream
    ],
)
def test_an_image_of_a_few_bytes_cannot_be_of_any_size(kind, mark, skipped, size, side):
    data = bytearray(saved(PIL.Image.new("RGB", (8, 8)), kind, lossless=True))
    at = data.index(mark) + skipped
    data[at : at + len(size)] = size
    with pytest.raises(ImageError, match=f"it cannot hold {side} × {side} texels"):
        decode_image(bytes(data), "a")


def test_plain_images_of_formats_that_pack_well_are_read():
    plain = PIL.Image.new("RGB", (1024, 1024), (10, 20, 30))
    for kind in ("WEBP", "JPEG2000"):
        assert decode_image(saved(plain, kind), "a").shape == (1024, 1024, 4)


@pytest.mark.parametrize("compression", ["tiff_adobe_deflate", "tiff_lzw", "jpeg"])
def test_nothing_is_printed_of_a_damaged_tiff_image(compression, capfd):
    image = PIL.Image.fromarray(random_image(16, 16))
    data = bytearray(saved(image, "TIFF", compression=compression))
    refused = 0
    for at in range(8, len(data) - 8, 16):
        damaged = bytearray(data)
        damaged[at : at + 8] = bytes(byte ^ 0x55 for byte in damaged[at : at + 8])
        try:
            decode_image(bytes(damaged), "a")
        except ImageError as error:
            refused += "\n" not in str(error)
    assert refused > 5
    assert capfd.readouterr() == ("", "")


def test_large_images_are_not_mistaken_for_bombs():
    before = PIL.Image.MAX_IMAGE_PIXELS
    image = PIL.Image.new("1", (16384, 11000))
    assert MAX_TEXELS > 11000 * 16384
    from octex.source.images import decode as images

    with images._open(io.BytesIO(saved(image, "PNG"))) as opened:
        assert opened.size == (16384, 11000)
    after = PIL.Image.MAX_IMAGE_PIXELS
    assert after == before


def test_the_png_suite_is_read_like_pillow_reads_it_and_its_broken_files_are_refused(models):
    folder = models / "fragile" / "png-suite" / "tests"
    if not folder.is_dir():
        pytest.skip("the png suite is not there")
    read = 0
    for path in sorted(folder.rglob("*.png")):
        data = path.read_bytes()
        try:
            texels = decode_image(data, path.name)
        except ImageError as error:
            assert path.name in str(error)
            assert path.parent.name != "pngsuite" or path.name.startswith("x"), path.name
            continue
        assert path.parent.name != "pngsuite" or path.name[0] != "x", path.name
        with PIL.Image.open(io.BytesIO(data)) as image:
            try:
                whole = np.asarray(image.convert("RGBA"))
            except OSError:  # Pillow stops at other chunks between those of the data
                continue
        if image.mode != "I;16":  # of which Pillow's own conversion keeps the wrong byte
            difference = (texels >> 8).astype(int) - whole
            assert abs(difference).max() <= (1 if data[24] == 16 else 0), path.name
        read += 1
    assert read > 150


def test_threads_change_the_warning_filters_one_at_a_time():
    before = list(warnings.filters)
    for read in (partial(parse_numbers, "1 2 x"), partial(decode_image, png(random_image(4, 4)), "a")):
        with ThreadPoolExecutor(1) as pool:
            with global_settings():
                other = pool.submit(read)
                with pytest.raises(TimeoutError):
                    other.result(timeout=0.02)
            other.result()
    assert list(warnings.filters) == before


ZSTD = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
PLAIN, BASIS, PACKED, DEFLATED = 0, 1, 2, 3
FORMATS = {
    9: ("u1", "r"), 15: ("u1", "r"), 16: ("u1", "rg"), 22: ("u1", "rg"), 23: ("u1", "rgb"), 29: ("u1", "rgb"),
    30: ("u1", "bgr"), 36: ("u1", "bgr"), 37: ("u1", "rgba"), 43: ("u1", "rgba"), 44: ("u1", "bgra"),
    50: ("u1", "bgra"), 70: ("u2", "r"), 77: ("u2", "rg"), 84: ("u2", "rgb"), 91: ("u2", "rgba"),
    76: ("f2", "r"), 83: ("f2", "rg"), 90: ("f2", "rgb"), 97: ("f2", "rgba"),
    100: ("f4", "r"), 103: ("f4", "rg"), 106: ("f4", "rgb"), 109: ("f4", "rgba"),
}  # fmt: skip


def ktx2(values, vk_format, scheme=PLAIN, flags=0, layers=0, **keys):
    """A texture of texels (height, width, lanes), and below it a mip of zeros."""
    height, width, _ = values.shape
    levels = [values.tobytes(), bytes(values[::2, ::2].nbytes)]
    packed = levels
    if scheme == PACKED:
        packed = [import_module(ZSTD).compress(each) for each in levels]
    elif scheme == DEFLATED:
        packed = [zlib.compress(each) for each in levels]
    entries = b""
    for key, value in keys.items():
        entry = f"{key}\0{value}\0".encode()
        entries += struct.pack("<I", len(entry)) + entry + bytes(-len(entry) % 4)
    description = struct.pack("<IIHH4B", 44, 0, 2, 40, 1, 1, 2, flags) + bytes(28)
    at_description = 80 + 24 * len(levels)
    at_entries = at_description + len(description)
    at_levels = at_entries + len(entries)
    head = struct.pack("<9I", vk_format, values.itemsize, width, height, 0, layers, 1, len(levels), scheme)
    head += struct.pack("<4I2Q", at_description, len(description), at_entries, len(entries), 0, 0)
    ends = np.cumsum([at_levels, *map(len, reversed(packed))]).tolist()  # the smallest level comes first
    for at, data, level in zip(reversed(ends[:-1]), packed, levels, strict=True):
        head += struct.pack("<3Q", at, len(data), len(level))
    return b"\xabKTX 20\xbb\r\n\x1a\n" + head + description + entries + b"".join(reversed(packed))


def random_values(vk_format, height=3, width=5):
    dtype, lanes = FORMATS[vk_format]
    random, shape = np.random.default_rng(vk_format), (height, width, len(lanes))
    if dtype[0] == "u":
        return random.integers(0, np.iinfo(dtype).max, shape, f"<{dtype}", endpoint=True)
    return random.random(shape).astype(f"<{dtype}")


@pytest.mark.parametrize("scheme", [PLAIN, PACKED, DEFLATED])
@pytest.mark.parametrize("vk_format", FORMATS)
def test_plain_texels_are_read_lane_by_lane(vk_format, scheme):
    if scheme == PACKED:
        pytest.importorskip(ZSTD, reason="the extra octex[ktx2] is not installed")
    values = random_values(vk_format)
    texels = decode_image(ktx2(values, vk_format, scheme), "a.ktx2")
    dtype, lanes = FORMATS[vk_format]
    most = 65535 if dtype[0] == "u" else 1.0
    assert texels.dtype == (np.uint16 if dtype[0] == "u" else np.float32)
    for place, lane in enumerate("rgba"):
        expected = most if lane == "a" else 0
        if lane in lanes:
            expected = values[..., lanes.index(lane)].astype(np.float64) * (257 if dtype == "u1" else 1)
        np.testing.assert_array_equal(texels[..., place], np.broadcast_to(expected, (3, 5)))


def test_lanes_and_rows_are_turned_as_the_file_says():
    values = random_values(16)
    swizzled = decode_image(ktx2(values, 16, KTXwriter="me", KTXswizzle="rrrg"), "a.ktx2")
    np.testing.assert_array_equal(swizzled / 257, values[..., [0, 0, 0, 1]])
    constant = decode_image(ktx2(values, 16, KTXswizzle="1g0r"), "a.ktx2") / 257
    np.testing.assert_array_equal(constant[..., [1, 3]], values[..., [1, 0]])
    assert (constant[..., [0, 2]] == [255, 0]).all()
    turned = decode_image(ktx2(values, 16, KTXorientation="lu"), "a.ktx2")
    np.testing.assert_array_equal(turned, decode_image(ktx2(values[::-1, ::-1], 16), "a.ktx2"))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (ktx2(random_values(37), 145), "vkFormat 145, which octex does not read; save it as R8G8B8A8"),
        (ktx2(random_values(37), 37, BASIS), "of vkFormat 37 packed by scheme 1, which octex does not read"),
        (ktx2(random_values(37), 37, flags=1), "colours multiplied by alpha"),
        (ktx2(random_values(37), 37, layers=2), "a volume, an array or a cube"),
        (ktx2(random_values(37), 37)[:-1], "vkFormat 37 take 60 bytes"),
        (ktx2(random_values(23), 37), "is damaged: 5 × 3 texels of vkFormat 37 take 60 bytes"),
        (ktx2(random_values(23), 9), "vkFormat 9 take 15 bytes"),
        (ktx2(random_values(37), 37, DEFLATED)[:-3], "vkFormat 37 take 60 bytes"),
        (ktx2(random_values(23), 9, DEFLATED), "vkFormat 9 take 15 bytes"),
        (ktx2(random_values(37), 37)[:100], "cannot be read as an image"),
        (ktx2(random_values(37)[:0], 37)[:28] + struct.pack("<2I", 0, 0) + bytes(80), "is damaged|a volume"),
        (ktx2(np.full((1, 1, 4), np.nan, "<f4"), 109), "4 values that are infinite or not a number"),
    ],
)
def test_what_is_damaged_or_not_read_is_refused_in_one_line(data, message):
    with refused(ImageError, message, "wood.ktx2"):
        decode_image(data, "wood.ktx2")


def test_large_sizes_are_refused_before_they_take_memory():
    data = ktx2(random_values(37), 37, DEFLATED)
    data = data[:20] + struct.pack("<2I", 16000, 16000) + data[28:]
    with pytest.raises(ImageError, match="16000 × 16000 texels"):
        decode_image(data, "wood.ktx2")


def test_without_zstd_its_extra_is_named(monkeypatch):
    data = ktx2(random_values(37), 37, DEFLATED)
    for module in ("compression.zstd", "backports.zstd"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=r"backports.zstd is needed.*octex\[ktx2\]"):
        decode_image(data[:44] + struct.pack("<I", PACKED) + data[48:], "wood.ktx2")
