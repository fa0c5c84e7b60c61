"""Pyramids and reads from them, against brute force."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex.channels import linear_to_srgb, srgb_to_linear
from octex.source.images import as_texels
from octex.source.pyramid import Layer, build_pyramids
from octex.source.surface import Surface
from tests.conftest import needs_jit
from tests.fixtures import SQUARE, SQUARE_TRIANGLES, SQUARE_UV, random_image

UV_UP = SQUARE_UV * [1, -1] + [0, 1]


def square(image: npt.NDArray[Any], *, size: tuple[float, float] = (1.0, 1.0), **options: Any) -> Surface:
    """A square of the given size in rest units, with an image."""
    vertices = SQUARE * np.array([*size, 1.0])
    return Surface.from_arrays(vertices, SQUARE_TRIANGLES, uv=UV_UP, image=image, **options)


def read(surface: Surface, points: npt.NDArray[np.float64], width: float) -> npt.NDArray[np.float32]:
    """Every channel at points of the unit square or beside it, in parts of its sides, y up."""
    x, y = points[:, 0], points[:, 1]
    barycentric = np.stack([1 - x, x - y, y], axis=1)
    triangles = np.zeros(len(points), np.int32)
    return surface.evaluate_all(triangles, barycentric, np.full(len(points), width, np.float32))


def levels_of(texels: npt.NDArray[np.uint16], **options: Any) -> list[npt.NDArray[np.float64]]:
    """Each level's texels as fractions (height, width, 4), colours still sRGB."""
    pyramids = build_pyramids([Layer(texels, options.get("alpha", True), options.get("threshold", -1.0))])
    found = []
    for first, width, height in pyramids.levels.tolist():
        words = np.ascontiguousarray(pyramids.texels[first : first + width * height]).view(np.uint16)
        found.append(words.reshape(height, width, 4) / 65535)
    return found


def area_means(level: npt.NDArray[np.float64], height: int, width: int) -> npt.NDArray[np.float64]:
    """The level reduced to a size: linear colours weighted by alpha and area, and mean alpha."""
    below_y, below_x = level.shape[:2]
    means = np.zeros((height, width, 4))
    for y in range(height):
        for x in range(width):
            covered = np.zeros(3)
            alpha = total = 0.0
            for j in range(below_y):
                for i in range(below_x):
                    part = float(overlap(j, y, below_y, height) * overlap(i, x, below_x, width))
                    covered += part * level[j, i, 3] * srgb_to_linear(level[j, i, :3])
                    alpha += part * level[j, i, 3]
                    total += part
            means[y, x] = [*(covered / alpha if alpha else covered), alpha / total]
    return means


def overlap(small: int, large: int, smalls: int, larges: int) -> Fraction:
    low = max(Fraction(small), Fraction(large * smalls, larges))
    high = min(Fraction(small + 1), Fraction((large + 1) * smalls, larges))
    return max(high - low, Fraction(0))


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 99))
def test_each_level_is_the_area_mean_of_the_one_below_for_any_size(
    height: int, width: int, seed: int
) -> None:
    levels = levels_of(random_image(height, width, 4, "uint16", seed))
    for below, level in pairwise(levels):
        assert level.shape[:2] == (max(below.shape[0] // 2, 1), max(below.shape[1] // 2, 1))
        expected = area_means(below, *level.shape[:2])
        np.testing.assert_allclose(level[..., 3], expected[..., 3], atol=1e-5)
        np.testing.assert_allclose(level[..., :3], linear_to_srgb(expected[..., :3]), atol=1e-5)
    assert levels[-1].shape[:2] == (1, 1)


def test_averages_are_of_light_and_not_of_codes() -> None:
    checker = np.array([[[0] * 3, [255] * 3]], np.uint8)
    half = levels_of(as_texels(checker))[1][0, 0, 0]
    assert round(half * 255) == 188


def test_an_image_read_without_alpha_has_none() -> None:
    texels = as_texels(random_image(4, 4, 4))
    levels = levels_of(texels, alpha=False)
    assert all((level[..., 3] == 1).all() for level in levels)


def test_what_covers_nothing_lends_no_colour() -> None:
    image = np.zeros((8, 8, 4), np.uint8)
    image[..., 0] = 255
    image[2:5, 3:7] = [0, 255, 0, 255]
    surface = square(image)
    points = np.random.default_rng(0).random((200, 2))
    for width in (0.0, 0.1, 0.5, 3.0):
        values = read(surface, points, width)
        seen = values[:, 3] > 1e-6
        np.testing.assert_allclose(values[seen, :3], [[0, 1, 0]] * seen.sum(), atol=1e-5)
    np.testing.assert_allclose(read(surface, points, 100.0)[:, 3], 12 / 64, atol=1e-3)


def test_where_nothing_covers_the_colour_is_still_that_of_the_texels() -> None:
    image = np.zeros((4, 4, 4), np.uint8)
    image[..., 2] = 255
    values = read(square(image), np.random.default_rng(0).random((50, 2)), 0.4)
    np.testing.assert_allclose(values, [[0, 0, 1, 0]] * 50, atol=1e-6)


@pytest.mark.parametrize("filter", ["linear", "nearest"])
def test_masked_alpha_is_0_or_1_at_points_and_a_share_of_texels_in_footprints(filter: str) -> None:
    image = random_image(16, 16, 4)
    surface = square(image, alpha="mask", cutoff=0.5, filter=filter)
    points = np.random.default_rng(0).random((300, 2))
    assert set(np.unique(read(surface, points, 0.0)[:, 3])) == {0.0, 1.0}
    share = (image[..., 3] >= 128).mean()
    np.testing.assert_allclose(read(surface, points, 1000.0)[:, 3], share, atol=1e-4)
    alpha = read(surface, points, 0.25)[:, 3]
    assert 0.05 < alpha.std() < 0.3
    np.testing.assert_allclose(alpha.mean(), share, atol=0.05)


@given(
    st.sampled_from(["repeat", "mirror", "clamp"]),
    st.sampled_from(["linear", "nearest"]),
    st.floats(0, 1e4),
    st.floats(0.01, 100),
    st.integers(1, 7),
    st.integers(1, 7),
)
def test_a_plain_image_stays_plain_at_every_footprint(
    wrap: str, filter: str, width: float, stretch: float, rows: int, columns: int
) -> None:
    image = np.full((rows, columns, 3), 100, np.uint8)
    surface = square(image, size=(1.0, stretch), wrap=wrap, filter=filter)
    values = read(surface, np.random.default_rng(0).uniform(-3, 3, (20, 2)), width)
    np.testing.assert_allclose(values, srgb_to_linear(100 / 255), rtol=1e-4)


@given(st.sampled_from(["linear", "nearest"]), st.floats(0, 10), st.floats(0.1, 10), st.integers(0, 99))
def test_averages_stay_between_the_least_and_the_largest_texel(
    filter: str, width: float, stretch: float, seed: int
) -> None:
    image = random_image(6, 5, 4, seed=seed)
    surface = square(image, size=(1.0, stretch), filter=filter)
    values = read(surface, np.random.default_rng(seed).uniform(-2, 2, (30, 2)), width)
    linear = srgb_to_linear(image / 255.0)
    assert (values[:, :3] >= linear[..., :3].min((0, 1)) - 1e-5).all()
    assert (values[:, :3] <= linear[..., :3].max((0, 1)) + 1e-5).all()
    assert (values[:, 3] >= image[..., 3].min() / 255 - 1e-5).all()
    assert (values[:, 3] <= image[..., 3].max() / 255 + 1e-5).all()


def smooth_image(size: int) -> npt.NDArray[np.uint8]:
    """Four waves across the image at most, repeating."""
    random = np.random.default_rng(5)
    y, x = np.mgrid[0:size, 0:size] / size
    image = np.zeros((size, size, 3))
    for channel in range(3):
        for _ in range(6):
            a, b = random.integers(-4, 5, 2)
            image[..., channel] += np.cos(2 * np.pi * (a * x + b * y + random.random()))
    image = (image - image.min()) / np.ptp(image)
    return (image * 255).astype(np.uint8)


def box_mean(
    surface: Surface, points: npt.NDArray[np.float64], width: float, size: tuple[float, float]
) -> Any:
    """The mean of the surface over squares of a width in rest units, from points."""
    steps = (np.arange(12) + 0.5) / 12 - 0.5
    total = np.zeros((len(points), 3))
    for dx in steps:
        for dy in steps:
            total += read(surface, points + np.array([dx / size[0], dy / size[1]]) * width, 0.0)[:, :3]
    return total / 144


@needs_jit
@pytest.mark.parametrize("filter", ["linear", "nearest"])
@pytest.mark.parametrize("size", [(1.0, 1.0), (1.0, 6.0), (9.0, 1.0)])
def test_footprints_are_averaged_like_boxes_square_or_long(size: tuple[float, float], filter: str) -> None:
    # Widths of 0.2 to 4 texels on the square; long ones reach 36 texels. Errors in codes of 255, RMS.
    surface = square(smooth_image(64), size=size, filter=filter)
    points = np.random.default_rng(0).random((200, 2))
    for texels in (0.2, 0.7, 1.0, 1.5, 2.5, 4.0):
        width = texels / 64 * max(size)
        found = linear_to_srgb(read(surface, points, width))
        expected = linear_to_srgb(box_mean(surface, points, width, size))
        error = 255 * np.sqrt(((found - expected) ** 2).mean())
        assert error < (1.5 if texels < 2 else 2.5), (texels, error)


def test_a_long_footprint_does_not_blur_across() -> None:
    # Stripes of one texel along u: a footprint 8 texels along u must leave rows apart.
    rows = np.repeat(np.array([0, 255] * 8, np.uint8)[:, None, None], 16, axis=1).repeat(3, axis=2)
    surface = square(rows, size=(1.0, 64.0))
    centres = np.stack([np.full(16, 0.4), (np.arange(16) + 0.5) / 16], axis=1)
    values = read(surface, centres, 8 / 16)[:, 0]
    assert (abs(values - (np.arange(16) % 2 == 0)) < 0.05).all()


def test_flat_texels_under_a_small_footprint_are_their_exact_mean() -> None:
    image = random_image(8, 8)
    surface = square(image, filter="nearest", wrap="clamp")
    linear = srgb_to_linear(image / 255.0)
    width = 0.5 / 8
    points = np.random.default_rng(0).uniform(0.05, 0.9, (100, 2))
    expected = []
    for x, y in points.tolist():
        weights = []
        for centre in (x, 1 - y):
            low, high = centre - width / 2, centre + width / 2
            parts = [max(min(high, (i + 1) / 8) - max(low, i / 8), 0.0) / width for i in range(8)]
            weights.append(parts)
        expected.append(np.einsum("i,j,jic->c", weights[0], weights[1], linear))
    np.testing.assert_allclose(read(surface, points, width), expected, atol=1e-4)


def test_small_footprints_approach_points() -> None:
    points = np.random.default_rng(0).random((100, 2))
    for filter in ("linear", "nearest"):
        surface = square(random_image(8, 8), filter=filter)
        np.testing.assert_allclose(read(surface, points, 1e-5), read(surface, points, 0), atol=2e-3)


def test_large_footprints_approach_the_mean_of_a_repeating_image() -> None:
    image = random_image(16, 8)
    values = read(square(image), np.random.default_rng(0).random((20, 2)), 50.0)
    np.testing.assert_allclose(values, [srgb_to_linear(image / 255.0).mean((0, 1))] * 20, rtol=1e-3)


def test_widths_are_measured_on_rest_positions() -> None:
    image = random_image(32, 32)
    plain = square(image)
    points = np.random.default_rng(0).random((50, 2))
    larger = plain.with_rest(plain.vertices * 10)
    np.testing.assert_allclose(read(larger, points, 1.0), read(plain, points, 0.1), atol=1e-6)


def test_turning_the_model_changes_no_footprint() -> None:
    image = random_image(32, 32)
    plain = square(image, size=(1.0, 3.0))
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turned = plain.with_rest(plain.vertices @ turn.T + 5)
    points = np.random.default_rng(0).random((50, 2))
    np.testing.assert_allclose(read(turned, points, 0.2), read(plain, points, 0.2), atol=1e-4)


def test_triangles_without_area_are_read_at_the_point() -> None:
    image = random_image(8, 8)
    plain = square(image)
    points = np.random.default_rng(0).random((20, 2))
    for rest in (plain.vertices * 0, plain.vertices * [1, 0, 0]):
        flat = plain.with_rest(rest)
        np.testing.assert_array_equal(read(flat, points, 0.3), read(plain, points, 0.0))


def test_coordinates_without_spread_are_read_at_the_point() -> None:
    surface = Surface.from_arrays(SQUARE, SQUARE_TRIANGLES, uv=np.full((4, 2), 0.3), image=random_image(8, 8))
    points = np.random.default_rng(0).random((20, 2))
    np.testing.assert_array_equal(read(surface, points, 0.3), read(surface, points, 0.0))


@pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
def test_far_coordinates_stay_inside_the_image(wrap: str) -> None:
    image = np.full((3, 5, 3), 77, np.uint8)
    for far in (1e6, 1e15, 1e30, -1e30):
        surface = Surface.from_arrays(SQUARE, SQUARE_TRIANGLES, uv=UV_UP * far, image=image, wrap=wrap)
        for width in (0.0, 0.1, 10.0):
            values = read(surface, np.random.default_rng(0).random((20, 2)), width)
            np.testing.assert_allclose(values, srgb_to_linear(77 / 255), rtol=1e-4)
