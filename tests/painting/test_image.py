"""Images to paint with: decoded, masked, and read at any width."""

import numpy as np
import PIL.Image
import pytest

from octex.channels import BASE_COLOR, NORMAL, ROUGHNESS, srgb_to_linear
from octex.errors import ArgumentError, ImageError
from octex.jit import kernel
from octex.painting.image import Projection, check_projections, mips_of, read_paint
from octex.painting.sharpened import sharpen
from tests.make.painted import above


@kernel
def _read(mips, x, y, width):
    return read_paint(mips, x, y, width)


def projection(image, **options):
    height, width = np.shape(image)[:2]
    camera = above(size=width)
    assert height == width
    return Projection(image, camera, **options)


def values(means):
    """Return what opaque pixels with these means have at their centres (height, width, 4)."""
    found = np.concatenate([means, np.ones_like(means[..., :1])], axis=2).astype(np.float32)
    sharpen(found)
    return found


def test_colours_are_decoded_as_their_channel_has_them():
    codes = np.random.default_rng(0).integers(0, 256, (6, 6, 3), np.uint8)
    for form, expected in (
        (BASE_COLOR, srgb_to_linear(codes / 255)),
        (ROUGHNESS, codes / 255),
        (NORMAL, codes / 127.5 - 1),
    ):
        mips = mips_of(projection(codes), form)
        np.testing.assert_allclose(mips.pixels[:36].reshape(6, 6, 4), values(expected), atol=1e-4)
        assert (mips.pixels[:36, 3] == 1).all()


def test_alpha_and_mask_multiply_and_colours_with_them():
    random = np.random.default_rng(1)
    image = random.random((4, 4, 4)).astype(np.float32)
    mask = random.integers(0, 256, (4, 4), np.uint8)
    mips = mips_of(projection(image, mask=mask), BASE_COLOR, 0.5)
    alpha = image[..., 3] * mask / 255 * 0.5
    np.testing.assert_allclose(mips.pixels[:16, 3].reshape(4, 4), alpha, atol=1e-5)
    np.testing.assert_allclose(
        mips.pixels[:16, :3].reshape(4, 4, 3), image[..., :3] * alpha[..., None], atol=1e-5
    )


def test_a_pixel_is_read_exactly_at_its_centre():
    image = np.random.default_rng(2).random((8, 8, 3)).astype(np.float32)
    mips, expected = mips_of(projection(image), BASE_COLOR), values(image)
    expected[..., :3] = expected[..., :3].clip(image.min((0, 1)), image.max((0, 1)))  # no colour is new
    for row in range(8):
        for column in range(8):
            found = _read(mips, column + 0.5, row + 0.5, 0.3)
            np.testing.assert_allclose(found, expected[row, column], atol=1e-6)


@pytest.mark.parametrize("width", [0.0, 1.0, 1.5, 2.0, 3.0, 4.0, 7.0, 100.0])
def test_what_is_alike_everywhere_is_read_so_at_any_width(width):
    mips = mips_of(projection(np.full((13, 13, 3), 0.3, np.float32)), BASE_COLOR)
    for x, y in ((0.0, 0.0), (6.5, 2.2), (12.99, 12.99)):
        np.testing.assert_allclose(_read(mips, x, y, width), [0.3, 0.3, 0.3, 1], atol=1e-6)


@pytest.mark.parametrize("width", [2.0, 3.0, 4.0, 6.0, 8.0])
def test_wide_readings_are_means_over_boxes(width):
    y, x = np.mgrid[:64, :64] + 0.5
    image = np.repeat((0.5 + 0.5 * np.sin(x * 0.15) * np.cos(y * 0.12))[..., None], 3, axis=2)
    mips = mips_of(projection(image.astype(np.float32)), BASE_COLOR)
    fine = (np.arange(400) + 0.5) / 400 - 0.5
    for at_x, at_y in ((20.3, 31.7), (40.0, 25.5), (33.3, 18.1)):
        of_x, of_y = np.sin((at_x + width * fine) * 0.15).mean(), np.cos((at_y + width * fine) * 0.12).mean()
        assert abs(_read(mips, at_x, at_y, width)[0] - (0.5 + 0.5 * of_x * of_y)) < 0.012


def test_files_are_read_and_named_if_they_cannot_be(tmp_path):
    image = PIL.Image.fromarray(np.full((5, 5, 3), 128, np.uint8))
    image.save(tmp_path / "fine.png")
    assert projection_of(tmp_path / "fine.png").name == str(tmp_path / "fine.png")
    mips = mips_of(projection_of(tmp_path / "fine.png"), ROUGHNESS)
    np.testing.assert_allclose(mips.pixels[:25, 0], 128 / 255, atol=1e-4)
    (tmp_path / "bad.png").write_bytes(b"no image")
    for name in ("bad.png", "none.png"):
        with pytest.raises(ImageError, match=name):
            mips_of(projection_of(tmp_path / name), BASE_COLOR)


def projection_of(path):
    return Projection(path, above(size=5))


def test_sizes_that_do_not_fit_are_refused():
    camera = above(size=8)
    image = np.zeros((8, 8, 3), np.uint8)
    with pytest.raises(ArgumentError, match="the mask has 3×8 pixels"):
        mips_of(Projection(image, camera, mask=np.zeros((8, 3), np.uint8)), BASE_COLOR)
    with pytest.raises(ImageError, match="the image: an image must have shape"):
        mips_of(Projection(np.zeros(3), camera), BASE_COLOR)


def test_projections_that_make_no_sense_are_refused():
    image, camera = np.zeros((8, 8, 3), np.uint8), above(size=8)
    with pytest.raises(ArgumentError, match="opacity must be from 0 to 1"):
        Projection(image, camera, opacity=1.5)
    with pytest.raises(ArgumentError, match=r"camera must be an octex\.Camera or a Patch, not ndarray"):
        Projection(image, np.eye(4))
    with pytest.raises(ArgumentError, match="projection to paint is missing"):
        check_projections([])
    with pytest.raises(ArgumentError, match=r"must be an octex\.Projection, not 'a\.png'"):
        check_projections(["a.png"])
