"""Blurred images count for less: by the detail that they share with the others."""

from functools import cache

import numpy as np
import pytest

import octex
from octex.parallel import Run, workers
from octex.photos import sharpness, weigh
from octex.photos.sharpness import Details, details_of, shown_of, weighed_by_sharpness
from tests.conftest import needs_jit
from tests.make.painted import image_of
from tests.make.photographs import error, projections, source_of
from tests.make.photographs import ring as smooth_ring
from tests.properties.edit_claims import digest


@cache
def ring(count=8):
    """A sphere with waves four to eight pixels long, and images of it."""

    def waves(points):
        values = 0.4 + 0.1 * (np.sin(31 * points) + np.sin(23 * points[:, [1, 2, 0]] + 1))
        return np.asarray(values + 0.05 * np.sin(9 * points.sum(axis=1))[:, None])

    surface, cameras, _ = smooth_ring(count)
    surface = surface.with_sources({"base_color": waves})
    return surface, cameras, [image_of(surface, camera) for camera in cameras]


def blurred(image, pixels):
    """The same image blurred by a Gaussian, of what it shows alone."""
    reach = np.arange(-12, 13)
    weights = np.exp(-0.5 * (reach / pixels) ** 2)
    made = np.concatenate([image[..., :3] * image[..., 3:], image[..., 3:]], axis=2)
    for axis in (0, 1):
        made = np.apply_along_axis(lambda row: np.convolve(row, weights / weights.sum(), "same"), axis, made)
    colors = made[..., :3] / np.maximum(made[..., 3:], 1e-6)
    return np.concatenate([colors, image[..., 3:]], axis=2).astype(np.float32)


def shown_by(surface, images, cameras):
    source = source_of(surface, projections(images, cameras))
    with workers(Run(threads=2)) as pool:
        return shown_of(details_of(source, surface, pool), len(images))


def weighed(source, surface):
    with workers(Run(threads=2)) as pool:
        return weighed_by_sharpness(source, surface, pool)


def test_what_an_image_shows_is_what_a_loop_over_pairs_says():
    random = np.random.default_rng(0)
    for count, points, is_sharp in ((3, 40, [1, 1, 1]), (5, 60, [1, 0, 1, 1, 1]), (4, 30, [0, 0, 1, 1])):
        sees = random.random((count, points)) < 0.8
        true = random.normal(size=(points, 3))
        values = true * random.uniform(0.2, 1, count)[:, None, None]
        values = (values + random.normal(0, 0.2, values.shape)) * sees[..., None]
        sharp = np.array(is_sharp, np.bool_)
        numbers, at = np.nonzero(sees)
        found = sharpness._compared(Details(numbers, at, values[sees].astype(np.float32)), sharp)
        np.testing.assert_allclose(found, naive_beside(values, sees, sharp), rtol=1e-4)


def naive_beside(values, sees, is_sharp):
    found = []
    for own in range(len(values)):
        products, theirs = [], []
        for point in np.flatnonzero(sees[own]):
            others = [n for n in range(len(values)) if n != own and sees[n, point] and is_sharp[n]]
            if len(others) < 2:
                continue

            def product(one, point=point):
                rest = [n for n in range(len(values)) if n != one and sees[n, point] and is_sharp[n]]
                return float(values[one, point] @ np.mean([values[n, point] for n in rest], axis=0))

            products.append(product(own))
            theirs.append(np.mean([product(n) for n in others]))
        little = len(products) / 255**2
        most = np.sum(products) + 2 * np.sqrt(np.sum(np.square(products))) + little
        least = np.sum(theirs) - 2 * np.sqrt(np.sum(np.square(theirs))) + little
        found.append(max(most, 0) / least if least > 0 else 1.0)
    return np.array(found)


def test_detail_that_others_do_not_have_is_cut_to_twice_their_mean():
    values = np.array([[1, 0, 0], [0, 2, 0], [0, 0, 9], [3, 4, 0], [0, 0, 0]], np.float32)
    points = np.array([0, 0, 0, 1, 1])
    found = sharpness._within_others(Details(np.array([0, 1, 2, 0, 1]), points, values)).values
    np.testing.assert_allclose(found, [[1, 0, 0], [0, 2, 0], [0, 0, 3], [0, 0, 0], [0, 0, 0]], atol=1e-6)


@needs_jit
def test_smooth_things_and_passers_by_do_not_look_blurred():
    surface, cameras, images = smooth_ring()
    assert (shown_by(surface, images, cameras) > 0.85).all()
    seen = [image.copy() for image in images]
    seen[2][30:60, 40:70, :3] = 0.9, 0.02, 0.02
    assert (shown_by(surface, seen, cameras) > 0.85).all()


@needs_jit
def test_blurred_images_are_told_from_noisy_and_darker_ones():
    surface, cameras, images = ring()
    assert (shown_by(surface, images, cameras) > 0.9).all()
    random = np.random.default_rng(0)
    noisy = [
        np.clip(image + random.normal(0, 0.02, image.shape) * [1, 1, 1, 0], 0, 1).astype(np.float32)
        for image in images
    ]
    noisy[5][..., :3] *= 0.8
    for pixels, most in ((1.5, 0.85), (2.5, 0.4)):
        given = [blurred(each, pixels) if n in (2, 6) else each for n, each in enumerate(noisy)]
        shown = shown_by(surface, given, cameras)
        assert (shown[[2, 6]] < most).all()
        assert (np.delete(shown, [2, 6]) > 0.9).all()


@needs_jit
@pytest.mark.parametrize("pictures", ["average", "robust", "best"])
def test_a_blurred_image_is_painted_where_no_other_sees(pictures):
    surface, cameras, images = ring()
    given = [blurred(each, 2.0) if n == 2 else each for n, each in enumerate(images)]
    options = {"max_depth": 6, "pictures": pictures}
    clean = error(octex.paint(None, surface, projections(images, cameras), **options), surface)
    made = octex.paint(None, surface, projections(given, cameras), **options)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(weigh, "weighed_by_sharpness", lambda source, *_: source)
        plain = octex.paint(None, surface, projections(given, cameras), **options)
    assert error(made, surface) - clean < 0.6 * (error(plain, surface) - clean)
    others = projections(given[:2] + given[3:], cameras[:2] + cameras[3:])
    assert error(made, surface) < error(octex.paint(None, surface, others, **options), surface)
    assert digest(octex.paint(None, surface, projections(given, cameras)[::-1], **options)) == digest(made)


@needs_jit
def test_what_cannot_be_told_changes_nothing():
    surface, cameras, images = ring(4)
    two = source_of(surface, projections(images[:2], cameras[:2]))
    assert weighed(two, surface) is two
    plain = [np.full_like(image, 0.5) for image in images]
    apart = [cameras[0], cameras[0], cameras[2], cameras[2]]  # never three of one place
    for source in (
        source_of(surface, projections(plain, cameras)),
        source_of(surface, projections([images[0], blurred(images[0], 3), *images[2:]], apart)),
        source_of(surface, projections(images, cameras)),
    ):
        assert all(shot.weight == 1.0 for shot in weighed(source, surface).shots)
