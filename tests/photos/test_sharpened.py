"""Images as values at their pixels' centres: the means that they then have, and noise of known strength."""

import numpy as np
import pytest

from octex.channels import linear_to_srgb, srgb_to_linear
from octex.painting.sharpened import noise_of, sharpen, sharpen_above


def sharpened(pixels):
    """Return a sharpened copy."""
    found = pixels.copy()
    sharpen(found)
    return found


def test_what_is_read_of_an_image_has_its_pixels_as_means():
    image = np.random.default_rng(4).uniform(0.3, 0.7, (20, 16, 4)).astype(np.float32)
    image[..., 3] = 1.0
    pixels = sharpened(image)
    steps = (np.arange(8) + 0.5) / 8
    taps = np.array([catmull_rom(steps, at) for at in range(-2, 3)])  # (pixels, places)
    weights = taps.mean(axis=1)  # what a pixel's mean has of the pixels around
    means = np.zeros((12, 8, 3))
    for row, across in enumerate(weights):
        for column, along in enumerate(weights):
            means += across * along * pixels[2 + row : 14 + row, 2 + column : 10 + column, :3]
    off = np.abs(means - image[4:16, 4:12, :3])
    assert np.quantile(off, 0.9) < 4e-3  # others are much like a pixel beside them
    blurred = sum(w * image[2 + n : 14 + n, 4:12, :3] for n, w in enumerate(weights))
    assert np.sqrt((off**2).mean()) < 0.2 * np.sqrt(((blurred - image[4:16, 4:12, :3]) ** 2).mean())


def catmull_rom(places, pixel):
    """What pixels count for, that many beyond the one whose width is 0 … 1, at places in that."""
    t = np.abs(places - 0.5 - pixel)
    inner, outer = 1.5 * t**3 - 2.5 * t**2 + 1, -0.5 * t**3 + 2.5 * t**2 - 4 * t + 2
    return np.where(t < 1, inner, np.where(t < 2, outer, 0.0))


def smooth(size=200):
    """An opaque image of light without detail."""
    y, x = np.mgrid[:size, :size] / size
    light = 0.3 + 0.1 * np.stack([x, y, x * y], axis=2)
    return np.concatenate([light, np.ones((size, size, 1))], axis=2).astype(np.float32)


def noisy(image, codes, is_light=True):
    """Add noise of so many of 255 codes to opaque pixels."""
    noise = np.random.default_rng(1).normal(0, codes / 255, image[..., :3].shape)
    made = image.copy()
    if is_light:
        made[..., :3] = srgb_to_linear(np.clip(linear_to_srgb(image[..., :3]) + noise, 0, 1))
    else:
        made[..., :3] += noise
    return made


@pytest.mark.parametrize("is_light", [True, False])
@pytest.mark.parametrize("codes", [1.0, 2.0, 4.0, 8.0])
def test_noise_is_as_strong_as_it_is(codes, is_light):
    found = 255 * noise_of(noisy(smooth(), codes, is_light), is_light)
    assert found == pytest.approx(codes, rel=0.12)  # square roots of light are codes but for a tenth


def test_detail_in_most_of_an_image_is_no_noise():
    image = smooth()
    image[:, 64:, :3] = np.random.default_rng(2).uniform(0.1, 0.7, (200, 136, 3))
    assert noise_of(image) < 0.5 / 255
    assert 255 * noise_of(noisy(image, 4.0)) == pytest.approx(4.0, rel=0.25)


def test_noise_of_little_is_not_known():
    image = np.random.default_rng(3).random((16, 16, 4)).astype(np.float32)
    assert noise_of(image) == 0.0  # four patches
    cut_off, hidden = noisy(smooth(), 4.0), noisy(smooth(), 4.0)
    cut_off[::8, ::8, :3] = 1.0
    hidden[::8, ::8] = 0.0
    assert noise_of(cut_off) == noise_of(hidden) == 0.0


def test_noise_is_not_sharpened():
    for codes in (2.0, 4.0):
        image = noisy(smooth(), codes)
        before, after = image - smooth(), sharpened(image) - smooth()
        assert np.abs(after[8:-8, 8:-8]).std() < 1.05 * np.abs(before[8:-8, 8:-8]).std()


def test_light_below_zero_stays_what_it_is_beside_noise():
    image = noisy(smooth(), 2.0)
    image[100:, :, :3] = -0.01
    found = sharpened(image)
    assert np.isfinite(found).all()
    assert np.array_equal(found[104:], image[104:])


def test_detail_all_over_an_image_is_sharpened():
    ripples = np.sin(2.4 * np.arange(200))[:, None]
    image = smooth()
    image[:, :, :3] += 0.1 * ripples
    assert noise_of(image) > 20 / 255
    amplitude = (sharpened(image)[8:-8, 8:-8, :3] * ripples[8:-8]).mean() / (ripples**2).mean()
    assert amplitude > 0.12


def test_detail_is_sharpened_in_noise_as_without():
    ripples = np.sin(2.4 * np.arange(136))[:, None]
    image = smooth()
    image[:, 64:, :3] += 0.1 * ripples
    inside = slice(64 + 8, 200 - 8)

    def strength(of):
        return float((of[:, inside, :3] * ripples[8:-8]).mean() / (ripples**2).mean())

    assert strength(sharpened(image)) > 1.3 * strength(image)
    assert strength(sharpened(noisy(image, 2.0))) == pytest.approx(strength(sharpened(image)), rel=0.05)


@pytest.mark.parametrize("is_light", [True, False])
def test_images_are_sharpened_by_the_formula(is_light):
    random = np.random.default_rng(5)
    image = random.uniform(0.1, 0.9, (40, 48, 4)).astype(np.float32)
    image[..., 3] = random.integers(0, 3, (5, 6)).repeat(8, 0).repeat(8, 1) / 2.0
    image[:, :, :3] *= image[:, :, 3:]
    noise = 0.02
    rows = sharpened_along_rows(image, noise, is_light)
    wanted = sharpened_along_rows(rows.transpose(1, 0, 2), noise, is_light).transpose(1, 0, 2)
    sharpen_above(image, noise, is_light)
    np.testing.assert_allclose(image, wanted, atol=2e-6)


def sharpened_along_rows(image, noise, is_light):
    """Sharpen as `sharpened` says, pixel by pixel."""
    found = image.astype(np.float64)
    for row, pixels in enumerate(image.astype(np.float64)):
        for column, (*values, alpha) in enumerate(pixels):
            for part, here in enumerate(values):
                beside = [
                    (step, pixels[column + step, part] - here)
                    for step in (-3, -2, -1, 1, 2, 3)
                    if 0 <= column + step < len(pixels) and pixels[column + step, 3] == alpha > 0
                ]
                taps = {1: -0.14336, 2: 0.03579, 3: -0.00638}
                change = sum(taps[abs(step)] * difference for step, difference in beside)
                one = 2 * np.sqrt(max(here, 0.0) * alpha) if is_light else alpha
                spread = (
                    noise
                    * one
                    * np.sqrt(2 * sum(t * t for t in taps.values()) + (2 * sum(taps.values())) ** 2)
                )
                if change:
                    change *= max(1 - (3 * spread / change) ** 2, 0)
                most = min(
                    [4 * abs(difference) for step, difference in beside if abs(step) == 1], default=np.inf
                )
                found[row, column, part] = here + np.clip(change, -most, most)
    return found
