"""KTX2 textures of plain texels, against the numbers that they are made of."""

import struct
import sys
import zlib
from importlib import import_module

import numpy as np
import pytest

from octex.errors import ImageError, MissingExtraError
from octex.source.images.decode import decode_image
from tests.make.refusal import refused

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
