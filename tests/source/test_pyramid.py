"""Stored images and their levels, against sums written out; footprints of surfaces."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from octex.channels import srgb_to_linear
from octex.source.images.pyramid import DATA, FLOAT, SRGB, ImageTexels, store
from octex.source.surface import Surface
from tests.make.fixtures import SQUARE, SQUARE_TRIANGLES, SQUARE_UV, random_image
from tests.oracles.naive_filters import halved, reduction

UV_UP = SQUARE_UV * [1, -1] + [0, 1]


def square(image, *, size=(1.0, 1.0), **options):
    """A square of the given size in rest units, with an image."""
    vertices = SQUARE * np.array([*size, 1.0])
    return Surface.from_arrays(vertices, SQUARE_TRIANGLES, uv=UV_UP, image=image, **options)


def read(surface, points, width):
    """Every channel at points of the unit square or beside it, in parts of its sides, y up."""
    x, y = points[:, 0], points[:, 1]
    barycentric = np.stack([1 - x, x - y, y], axis=1)
    triangles = np.zeros(len(points), np.int32)
    return surface.evaluate_all(triangles, barycentric, np.full(len(points), width, np.float32))


def levels_of(images, image=0, layout=0):
    """Each level (height + 2, width + 2, 4) of an image with its rim, decoded: light or fractions."""
    first, count = images.layouts[layout].tolist()
    kind, base = images.kinds[image], images.bases[image]
    found = []
    for start, width, height in images.levels[first : first + count].tolist():
        stride = width + 2
        corner = base + start - stride - 1
        rows = slice(corner, corner + stride * (height + 2))
        if kind == FLOAT:
            values = images.floats[rows].astype(float)
        else:
            words = images.codes[rows]
            lanes = [(words >> np.uint64(16 * lane)) & np.uint64(65535) for lane in range(4)]
            values = np.stack(lanes, axis=1) / 65535
            if kind == SRGB:
                values[:, :3] = srgb_to_linear(values[:, :3])
        found.append(values.reshape(height + 2, width + 2, 4))
    return found


def around(values):
    """An image with its border's texels once more around it."""
    return np.pad(values, ((1, 1), (1, 1), (0, 0)), mode="edge")


def shares(size, smaller):
    """The reduction of a row with its rim, which stays."""
    both = np.zeros((smaller + 2, size + 2))
    both[0, 0] = both[-1, -1] = 1
    both[1:-1, 1:-1] = reduction(size, smaller)
    return both


def reduced(values, height, width, covered):
    """A level with its rim reduced to a size: area means, colours weighed by alpha if ``covered``."""
    across, down = shares(values.shape[1] - 2, width), shares(values.shape[0] - 2, height)
    if not covered:
        return np.einsum("yj,xi,jik->yxk", down, across, values)
    alpha = down @ values[..., 3] @ across.T
    colors = np.einsum("yj,xi,jik->yxk", down, across, values[..., :3] * values[..., 3:])
    return np.concatenate([colors / np.where(alpha > 0, alpha, 1)[..., None], alpha[..., None]], axis=2)


@st.composite
def images(draw):
    """Images of any size, of every kind; half of them hold how much they cover."""
    height, width = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    texels = random_image(height, width, 4, "uint16", draw(st.integers(0, 99)))
    texels[..., 3] |= 4096  # faint texels leave no bits of colour to compare
    kind = draw(st.sampled_from([SRGB, DATA, FLOAT]))
    if kind == FLOAT:
        texels = (texels / 65535 * [9, 5, 1, 1]).astype(np.float32)
    return ImageTexels(texels, kind == SRGB, draw(st.booleans()))


def decoded(image):
    values = np.asarray(image.texels, float) / (1 if image.texels.dtype == np.float32 else 65535)
    if image.is_light and image.texels.dtype != np.float32:
        values[..., :3] = srgb_to_linear(values[..., :3])
    return values


@given(images())
def test_each_level_is_the_area_mean_of_the_one_below_for_any_size(image):
    height, width = image.texels.shape[:2]
    levels = levels_of(store([image], True)[0])
    expected = around(decoded(image))
    assert len(levels) == len(halved(max(height, width)))
    for number, level in enumerate(levels):
        if number > 0:
            height, width = max(height // 2, 1), max(width // 2, 1)
            expected = reduced(expected, height, width, image.covered)
        np.testing.assert_allclose(level, expected, atol=4e-5)
    assert (height, width) == (1, 1)


def test_averages_of_masked_alpha_are_of_0_and_1_but_the_finest_level_is_as_it_is():
    texels = random_image(7, 6, 4, "uint16")
    threshold = 0.6
    levels = levels_of(store([ImageTexels(texels, True, True, threshold)], True)[0])
    values = decoded(ImageTexels(texels, True))
    np.testing.assert_allclose(levels[0], around(values), atol=1e-6)
    values[..., 3] = values[..., 3] >= threshold
    height, width = levels[1].shape[0] - 2, levels[1].shape[1] - 2
    expected = reduced(around(values), height, width, True)
    np.testing.assert_allclose(levels[1][..., 3], expected[..., 3], atol=1e-5)
    seen = expected[..., 3] > 0
    np.testing.assert_allclose(levels[1][seen], expected[seen], atol=1e-4)


def test_images_of_one_size_share_a_layout_and_each_comes_back():
    small, large = random_image(2, 3, 4, "uint16"), random_image(4, 4, 4, "uint16")
    light = random_image(2, 3, 4).astype(np.float32)
    given = [ImageTexels(small, True), ImageTexels(large, False, True), ImageTexels(light, True)]
    given += [ImageTexels(small[::-1], False), ImageTexels(light * 2, True)]
    images, layouts = store(given, False)
    assert layouts == [0, 1, 0, 0, 0]
    assert images.kinds.tolist() == [SRGB, DATA, FLOAT, DATA, FLOAT]
    assert images.covered.tolist() == [False, True, False, False, False]
    for number, image in enumerate(given):
        [level] = levels_of(images, number, layouts[number])
        np.testing.assert_allclose(level, around(decoded(image)), atol=1e-6)


def test_turning_the_model_changes_no_footprint():
    plain = square(random_image(32, 32), size=(1.0, 3.0))
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turned = plain.with_rest(plain.vertices @ turn.T + 5)
    points = np.random.default_rng(0).random((50, 2))
    np.testing.assert_allclose(read(turned, points, 0.2), read(plain, points, 0.2), atol=1e-4)


def test_triangles_without_area_and_coordinates_without_spread_are_read_at_the_point():
    plain = square(random_image(8, 8))
    points = np.random.default_rng(0).random((20, 2))
    for rest in (plain.vertices * 0, plain.vertices * [1, 0, 0], plain.vertices[[0, 0, 2, 3]]):
        flat = plain.with_rest(rest)
        np.testing.assert_array_equal(read(flat, points, 0.3), read(plain, points, 0.0))
    surface = Surface.from_arrays(SQUARE, SQUARE_TRIANGLES, uv=np.full((4, 2), 0.3), image=random_image(8, 8))
    points = np.random.default_rng(0).random((20, 2))
    np.testing.assert_array_equal(read(surface, points, 0.3), read(surface, points, 0.0))
