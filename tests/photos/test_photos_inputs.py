"""Photographs as they come: turned, masked, cut out, before a backdrop, deep, with cameras in arrays."""

import numpy as np
import PIL.Image
import pytest

from octex.cameras.camera import Camera
from octex.channels import BASE_COLOR, srgb_to_linear
from octex.errors import ArgumentError, ExitCode
from octex.painting.image import Projection, mips_of
from octex.painting.sharpened import sharpen
from octex.source.images.decode import PNG_SIGNATURE, orientation_of, turned
from octex.texture import open_texture
from tests.make.command import OUT, run
from tests.make.deep_images import pfm
from tests.make.fixtures import png
from tests.make.painted import above


def wide(width=6, height=4):
    return Camera.pinhole((width, height), pose=np.eye(4), convention="opencv", focal=8.0)


def pixels_of(projection):
    camera = projection.camera
    rows = mips_of(projection, BASE_COLOR).pixels[: camera.width * camera.height]
    return rows.reshape(camera.height, camera.width, 4)


def held(light):
    """What the finest level of an opaque image of so much light holds."""
    found = np.concatenate([light, np.ones_like(light[..., :1])], axis=2).astype(np.float32)
    sharpen(found)
    return found


@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_are_turned_as_pillow_turns_them(tmp_path, orientation):
    image = PIL.Image.fromarray(np.random.default_rng(0).integers(0, 256, (4, 6, 3), np.uint8))
    exif = image.getexif()
    exif[0x0112] = orientation
    image.save(tmp_path / "a.png", exif=exif)
    data = (tmp_path / "a.png").read_bytes()
    assert orientation_of(data) == orientation
    from PIL.ImageOps import exif_transpose

    upright = np.asarray(exif_transpose(PIL.Image.open(tmp_path / "a.png")))
    np.testing.assert_array_equal(turned(np.asarray(image), orientation), upright)
    camera = wide(upright.shape[1], upright.shape[0])
    found = pixels_of(Projection(tmp_path / "a.png", camera))
    np.testing.assert_allclose(found, held(srgb_to_linear(upright / 255)), atol=1e-5)


def test_an_image_that_fits_its_camera_only_as_it_is_stored_is_not_turned(tmp_path):
    image = PIL.Image.fromarray(np.random.default_rng(0).integers(0, 256, (4, 6, 3), np.uint8))
    exif = image.getexif()
    exif[0x0112] = 6
    image.save(tmp_path / "a.jpg", exif=exif)
    stored = np.asarray(PIL.Image.open(tmp_path / "a.jpg"))
    found = pixels_of(Projection(tmp_path / "a.jpg", wide()))
    np.testing.assert_allclose(found, held(srgb_to_linear(stored / 255)), atol=1e-5)
    with pytest.raises(ArgumentError, match="has 6×4 pixels, its camera 5×5"):
        mips_of(Projection(tmp_path / "a.jpg", wide(5, 5)), BASE_COLOR)


def test_what_is_no_photograph_has_no_orientation():
    assert orientation_of(b"nothing") == orientation_of(PNG_SIGNATURE) == 1


def test_a_cut_out_is_a_mask_by_its_alpha_whatever_its_colours():
    random = np.random.default_rng(1)
    cut_out = random.integers(0, 256, (4, 6, 4), np.uint8)
    found = pixels_of(Projection(np.ones((4, 6, 3), np.float32), wide(), mask=cut_out))
    np.testing.assert_allclose(found[..., 3], cut_out[..., 3] / 255, atol=1e-6)
    grey = random.integers(0, 256, (4, 6), np.uint16) * 200
    found = pixels_of(Projection(np.ones((4, 6, 3), np.float32), wide(), mask=grey))
    np.testing.assert_allclose(found[..., 3], grey / 65535, atol=2e-5)


def test_a_backdrop_is_keyed_out_as_codes_are_near():
    image = np.full((4, 6, 3), (20, 200, 30), np.uint8)
    image[0, 0], image[1, 1], image[2, 2] = (200, 100, 30), (44, 176, 54), (45, 200, 30)
    linear = srgb_to_linear(image / 255).astype(np.float32)
    for given in (image, linear, image.astype(np.uint16) * 257):
        alpha = pixels_of(Projection(given, wide(), key=(20, 200, 30)))[..., 3]
        assert (np.argwhere(alpha == 1) == [[0, 0], [2, 2]]).all()
    with pytest.raises(ArgumentError, match="key must be"):
        Projection(image, wide(), key=(1, 2))


def test_images_of_16_bits_keep_them_and_floats_are_linear_light(tmp_path):
    pytest.importorskip("OpenImageIO")
    codes = np.random.default_rng(2).integers(0, 65536, (4, 6, 3), np.uint16)
    (tmp_path / "a.png").write_bytes(png(codes))
    found = pixels_of(Projection(tmp_path / "a.png", wide()))
    np.testing.assert_allclose(found, held(srgb_to_linear(codes / 65535)), atol=2e-6)
    light = np.random.default_rng(3).uniform(0, 4, (4, 6, 3)).astype(np.float32)
    (tmp_path / "a.pfm").write_bytes(pfm(light))
    np.testing.assert_array_equal(pixels_of(Projection(tmp_path / "a.pfm", wide())), held(light))


# From the shell


def scene(folder, **arrays):
    """Write a square, and cameras above it without names."""
    (folder / "square.obj").write_text(
        "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3 4\n", encoding="utf-8"
    )
    camera = above(size=32)
    matrices = np.stack([camera.world_to_camera] * 2)
    np.savez(folder / "cameras.npz", viewmats=matrices, Ks=np.stack([camera.K] * 2), **arrays)
    for name, color in (("red", (255, 0, 0)), ("blue", (0, 0, 255))):
        PIL.Image.new("RGB", (32, 32), color).save(folder / f"{name}.png")
    return [str(folder / "square.obj"), str(folder / "red.png"), str(folder / "blue.png")]


def test_masks_are_found_by_the_images_names(tmp_path):
    files = scene(tmp_path)
    (tmp_path / "masks").mkdir()
    PIL.Image.new("L", (32, 32), 255).save(tmp_path / "masks" / "red.png")
    PIL.Image.new("L", (32, 32), 0).save(tmp_path / "masks" / "blue.png")
    words = ["--camera", str(tmp_path / "cameras.npz"), OUT, str(tmp_path / "out.octex"), "--quiet"]
    pattern = str(tmp_path / "masks" / "{stem}.png")
    assert run(*files, *words, "--mask", pattern) == 0
    found = open_texture(tmp_path / "out.octex").sample([[0.0, 0.0, 0.0]])
    np.testing.assert_allclose(found, [[1, 0, 0]], atol=1e-3)


def test_masks_that_are_missing_are_named(tmp_path, cli):
    files = scene(tmp_path)
    words = ["--camera", str(tmp_path / "cameras.npz"), OUT, str(tmp_path / "out.octex")]
    message = cli.errors(*files, *words, "--mask", tmp_path / "{name}.mask.png", code=ExitCode.REFUSED)
    assert "--mask: 2 of 2 masks are missing" in message
    assert "red.png.mask.png" in message
    message = cli.errors(*files, *words, "--mask", "{stem}.png", "--mask", "m.png", code=ExitCode.REFUSED)
    assert "--mask gives a pattern and more masks; give one of them" in message


def test_a_key_keeps_a_backdrop_from_being_painted(tmp_path):
    files = scene(tmp_path, names=["red.png", "blue.png"], width=32, height=32)
    words = ["--camera", str(tmp_path / "cameras.npz"), OUT, str(tmp_path / "out.octex"), "--quiet"]
    assert run(*files, *words, "--mask", "#ff0000") == 0
    found = open_texture(tmp_path / "out.octex").sample([[0.0, 0.0, 0.0]])
    np.testing.assert_allclose(found, [[0, 0, 1]], atol=1e-3)
