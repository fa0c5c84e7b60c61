"""What images have cut off counts for nothing where others show that it is lighter."""

import numpy as np
import pytest

import octex
from octex.parallel import pool_of
from octex.photos import balance, weigh
from octex.photos.balance import balanced, without_overexposed
from tests.conftest import needs_jit
from tests.make.painted import codes
from tests.make.photographs import projections, ring, source_of

GAINS = (1.0, 1.0, 2.4, 1.8, 1.1, 0.8, 3.0, 2.0, 1.0, 0.9, 1.5, 2.0)


def exposed(images, gains, dtype=np.uint8):
    """Images of other exposures, cut off; as floats they are not."""
    made = []
    for image, gain in zip(images, gains, strict=True):
        light = np.concatenate([image[..., :3] * np.float32(gain), image[..., 3:]], axis=2)
        if dtype is np.uint8:
            light[..., :3] = octex.channels.linear_to_srgb(np.clip(light[..., :3], 0, 1))
            light = np.round(255 * light)
        made.append(light.astype(dtype))
    return made


def error(found, surface):
    """Root of the mean square, in codes, in the middle: what is above and below some images alone see."""
    samples = surface.scatter(5000)
    middle = np.abs(samples.points[:, 1]) < 0.4
    apart = codes(found.sample(samples.rest)) - codes(surface.evaluate(samples))
    return float(np.sqrt((apart[middle] ** 2).mean()))


@needs_jit
@pytest.mark.usefixtures("few_points")
@pytest.mark.parametrize("pictures", ["average", "best", "robust"])
def test_what_is_cut_off_is_painted_by_others_that_show_it(pictures, monkeypatch):
    surface, cameras, images = ring(12, 96)
    given = projections(exposed(images, GAINS), cameras)
    options = {"max_depth": 6, "balance": "gain", "reference": 0, "pictures": pictures}
    as_they_are = error(octex.paint(None, surface, projections(images, cameras), **options), surface)
    found = error(octex.paint(None, surface, given, **options), surface)
    monkeypatch.setattr(weigh, "without_overexposed", lambda _, evened, __: evened)
    without = error(octex.paint(None, surface, given, **options), surface)
    assert found < as_they_are + 1.0
    assert without > as_they_are + 3.0


def test_patches_are_wrong_where_most_of_what_is_not_cut_off_is_lighter():
    """Beside a loop over points, images and components."""
    surface, cameras, images = ring(5, 32)
    source = source_of(surface, projections(exposed(images, (1.0, 2.0, 3.0, 1.6, 1.0)), cameras))
    evened = balanced(source, surface, "full", 0)
    samples = surface.scatter(300)
    where = samples.triangles, samples.barycentric
    counts = np.zeros(2, np.int64)
    for number in range(5):
        widths = source.with_shots([source.shots[number]]).widths(*where)
        widths = np.where(np.isfinite(widths), 4 * widths, 0).astype(np.float32)
        found, told = balance._compared(source, evened, number, *where, widths)
        before, (after, weights) = source.each(*where, widths)[0], evened.each(*where, widths)
        light = 255 * np.sqrt(np.maximum(after.astype(np.float64), 0))
        for n in range(300):
            expected, is_told = False, True
            for component in range(3):
                others = [
                    light[other, n, component]
                    for other in range(5)
                    if other != number and weights[other, n] > 0 and before[other, n, component] <= 0.955
                ]
                is_told &= len(others) > 0
                if before[number, n, component] > 0.955 and others:
                    expected |= float(np.median(others)) > light[number, n, component] + 2
            assert (found[n], told[n]) == (expected, is_told)
            counts[int(expected)] += 1
    assert counts.min() > 20


def test_images_that_are_not_cut_off_stay_as_they_are():
    surface, cameras, images = ring(4, 32)
    for shown in (exposed(images, (1.0, 2.0, 3.0, 1.6), np.float32), exposed(images, (0.5,) * 4)):
        source = source_of(surface, projections(shown, cameras))
        before = [shot.mips.pixels.copy() for shot in source.shots]
        with pool_of(1) as pool:
            found = without_overexposed(source, balanced(source, surface, "gain", 0), pool)
        for shot, pixels in zip(found.shots, before, strict=True):
            assert np.array_equal(shot.mips.pixels, pixels)
