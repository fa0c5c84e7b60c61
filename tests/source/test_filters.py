"""Image filters against weights written out in the open, and against dense sampling."""

import numpy as np
import pytest

from octex import jit
from octex.channels import linear_to_srgb, srgb_to_linear
from octex.source.corners import Corners
from octex.source.images.filters import FILTERS
from octex.source.images.pyramid import WRAPS
from octex.source.materials import Input, Material, MaterialSource, Texture
from tests.conftest import needs_jit
from tests.make.fixtures import random_image
from tests.oracles import naive_filters
from tests.oracles.naive_filters import Axis

AVERAGING = ("trilinear", "ewa")
COUNT = 3 if jit.DISABLED else 12


def corners_of(uv, jacobians):
    """Coordinates (n, 3, 2) of right triangles with sides of 1 around points (n, 2).

    ``jacobians`` (n, 2, 2) hold the change of coordinates along each side, one in each column.
    """
    uv, jacobians = np.atleast_2d(np.asarray(uv, float)), np.asarray(jacobians, float).reshape(-1, 2, 2)
    first = uv - jacobians.sum(axis=2) / 3
    corners = [first, first + jacobians[..., 0], first + jacobians[..., 1]]
    return np.stack(np.broadcast_arrays(*corners), axis=1).astype(np.float32)


def footprints_of(corners):
    """The points and Jacobians that corners hold after rounding."""
    exact = corners.astype(float)
    return exact.mean(axis=1), np.stack([exact[:, 1] - exact[:, 0], exact[:, 2] - exact[:, 0]], axis=2)


def read(texels, corners, filter, wraps=("repeat", "repeat"), *, nearest=False, alpha="opaque", cutoff=0.5):
    """The colours, and alpha unless it is opaque, of an image under unit squares of surfaces."""
    count = len(corners)
    if texels.dtype != np.float32 and texels.dtype != np.uint16:
        texels = texels.astype(np.uint16) * np.uint16(257)
    if texels.shape[2] == 3:
        opaque = 1.0 if texels.dtype == np.float32 else 65535
        texels = np.concatenate([texels, np.full_like(texels[..., :1], opaque)], axis=2)
    texture = Texture(texels, WRAPS.index(wraps[0]), WRAPS.index(wraps[1]), nearest)
    inputs = {"base_color": Input((1.0, 1.0, 1.0), texture), "alpha": Input((1.0,), texture, (3,))}
    source = MaterialSource(
        [Material(inputs, alpha, cutoff)],
        np.zeros(count, np.int32),
        np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]),
        np.tile(np.array([[0, 1, 2]], np.int32), (count, 1)),
        coordinates=[Corners(corners.reshape(-1, 2), np.arange(3 * count, dtype=np.int32).reshape(-1, 3))],
        filter=filter,
    )
    third = np.full((count, 3), 1 / 3)
    return source.evaluate(np.arange(count, dtype=np.int32), third, np.ones(count, np.float32))


def turned(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def some_footprints(random, count, size, *, straight_up_to=0.0):
    """Footprints of 0 to 16 texels, up to 8 times as long as wide; those that reach less are not turned."""
    jacobians = np.zeros((count, 2, 2))
    for i in range(1, count):
        width = 16 ** random.uniform(-1, 1)
        texels = np.diag([width, width * random.uniform(0.125, 1)])[:: random.choice([-1, 1])]
        if i % 2 and (abs(texels) > straight_up_to).any():
            texels = turned(random.uniform(0, 2 * np.pi)) @ texels @ turned(random.uniform(0, 2 * np.pi))
        jacobians[i] = texels / np.array(size)[:, None]
    return corners_of(random.uniform(-2, 3, (count, 2)), jacobians)


def naively(values, corners, filter, wraps, flat=False, covered=False):
    height, width = values.shape[:2]
    across, down = Axis(width, wraps[0]), Axis(height, wraps[1])
    found = []
    for uv, jacobian in zip(*footprints_of(corners), strict=True):
        texels = jacobian * [[width], [height]]
        shares = naive_filters.weights(filter, across, down, uv, texels, flat)
        found.append(naive_filters.filtered(values, shares, covered))
    return np.array(found)


@pytest.mark.parametrize("flat", [False, True], ids=["patches", "flat"])
@pytest.mark.parametrize("filter", FILTERS)
def test_every_filter_is_its_weighted_mean_of_texels(filter, flat):
    random = np.random.default_rng(3)
    for height, width in ((8, 8), (5, 7), (16, 3), (1, 1)):
        image = random_image(height, width, 4, "uint16")
        values = srgb_to_linear(image[..., :3] / 65535)
        for wraps in (("repeat", "mirror"), ("mirror", "clamp"), ("clamp", "repeat")):
            corners = some_footprints(random, COUNT, (width, height), straight_up_to=3.0)
            expected = naively(values, corners, filter, wraps, flat)
            found = read(image, corners, filter, wraps, nearest=flat)
            np.testing.assert_allclose(found, expected, atol=2e-4, err_msg=f"{width}×{height}, {wraps}")


@pytest.mark.parametrize("filter", [name for name in FILTERS if name != "bicubic"])
def test_colours_are_weighed_by_alpha(filter):
    image = random_image(8, 6, 4, "uint16", seed=1)
    image[1:4, 2:5, 3] = 0
    values = np.concatenate([srgb_to_linear(image[..., :3] / 65535), image[..., 3:] / 65535], axis=2)
    corners = some_footprints(np.random.default_rng(5), 4 * COUNT, (6, 8), straight_up_to=3.0)
    expected = naively(values, corners, filter, ("clamp", "repeat"), covered=True)
    found = read(image, corners, filter, ("clamp", "repeat"), alpha="blend")
    np.testing.assert_allclose(found[:, 3], expected[:, 3], atol=1e-4)
    seen = expected[:, 3] > 0.02
    np.testing.assert_allclose(found[seen, :3], expected[seen, :3], atol=1e-3)
    if filter in AVERAGING:
        large = read(image, corners_of([[0.3, 0.4]], np.eye(2) * 100), filter, alpha="blend")
        mean = naive_filters.filtered(values, np.full((8, 6), 1 / 48), covered=True)
        np.testing.assert_allclose(large, [mean], atol=1e-3)


@pytest.mark.parametrize("filter", FILTERS)
def test_where_nothing_covers_the_colour_is_still_that_of_the_texels(filter):
    image = np.zeros((4, 4, 4), np.uint8)
    image[..., 2] = 255
    values = read(image, some_footprints(np.random.default_rng(0), COUNT, (4, 4)), filter, alpha="blend")
    np.testing.assert_allclose(values, [[0, 0, 1, 0]] * COUNT, atol=1e-5)


@pytest.mark.parametrize("flat", [False, True], ids=["patches", "flat"])
@pytest.mark.parametrize("filter", FILTERS)
def test_masked_alpha_is_0_or_1_at_points_and_a_share_of_texels_in_footprints(filter, flat):
    image = random_image(16, 16, 4)
    options = {"alpha": "mask", "nearest": flat}
    random = np.random.default_rng(0)
    points = corners_of(random.random((8 * COUNT, 2)), np.zeros((2, 2)))
    at_points = read(image, points, filter, **options)[:, 3]
    assert set(np.unique(at_points)) == {0.0, 1.0}
    if filter not in AVERAGING:
        return
    share = (image[..., 3] >= 128).mean()
    large = read(image, corners_of([[0.1, 0.7]], np.eye(2) * 1000), filter, **options)
    np.testing.assert_allclose(large[:, 3], share, atol=1e-4)
    # From texels that are 0 or 1, and not from what is between them.
    values = np.concatenate([srgb_to_linear(image[..., :3] / 255), image[..., 3:] >= 128], axis=2)
    for texels in (1.5, 2.4, 6.0):
        corners = corners_of(random.random((4 * COUNT, 2)), turned(texels) @ np.diag([texels, texels]) / 16)
        if texels > 2 or filter != "ewa":  # which is exact there for boxes that are not turned
            found = read(image, corners, filter, **options)
            expected = naively(values, corners, filter, ("repeat", "repeat"), flat, covered=True)
            np.testing.assert_allclose(found[:, 3], expected[:, 3], atol=1e-4)


@needs_jit
@pytest.mark.parametrize("width", [0.6, 1.0, 1.5, 1.9, 2.2, 4.0])
def test_masks_cover_as_much_on_average_at_any_footprint(width):
    image = random_image(64, 64, 4)
    uv = np.random.default_rng(1).random((4000, 2))
    found = read(image, corners_of(uv, np.eye(2) * width / 64), "ewa", alpha="mask")[:, 3]
    assert abs(found.mean() - (image[..., 3] >= 128).mean()) < 0.03


def test_bicubic_colours_are_those_of_what_covers_and_stay_colours():
    image = random_image(16, 16, 4)
    image[..., 3] = np.random.default_rng(2).choice([0, 1, 255], (16, 16))
    image[..., 0] = np.where(image[..., 3] == 0, 255, 0)
    corners = corners_of(np.random.default_rng(3).random((COUNT, 2)), np.zeros((2, 2)))
    values = read(image, corners, "bicubic", alpha="blend")
    assert values.min() >= 0
    assert values.max() <= 1
    assert (values[values[:, 3] > 1e-5, 0] < 1e-5).all()


@pytest.mark.parametrize("filter", AVERAGING)
def test_footprints_longer_than_16_widths_are_read_wider(filter):
    image = random_image(8, 6, 3, "uint16")
    random = np.random.default_rng(4)
    jacobians = [turned(angle) @ np.diag([12.0, 0.1]) / [[6], [8]] for angle in random.uniform(0, 6, COUNT)]
    corners = corners_of(random.random((COUNT, 2)), np.array(jacobians))
    expected = naively(srgb_to_linear(image / 65535), corners, filter, ("repeat", "clamp"))
    np.testing.assert_allclose(read(image, corners, filter, ("repeat", "clamp")), expected, atol=2e-4)


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize("width", [0.0, 0.1, 1.0, 100.0])
def test_beyond_the_border_of_a_clamped_image_is_its_border_alone(filter, width):
    image = np.zeros((16, 12, 3), np.uint8)
    image[..., 1] = 255
    image[:, 0] = [255, 0, 0]
    far = width + 3 / 12
    places = [[-far, 0.5], [-far, -0.3 * width], [-far - 3 * width, 7.0]]
    for jacobian in (np.eye(2), turned(0.7)):
        corners = corners_of(places, jacobian * width)
        values = read(image, corners, filter, ("clamp", "clamp"))
        np.testing.assert_allclose(values, [[1, 0, 0]] * 3, atol=1e-5)
        corners = corners_of(np.array(places)[:, ::-1], jacobian.T * width)
        values = read(image.transpose(1, 0, 2), corners, filter, ("clamp", "clamp"))
        np.testing.assert_allclose(values, [[1, 0, 0]] * 3, atol=1e-5)


@pytest.mark.parametrize("filter", AVERAGING)
def test_footprints_of_many_images_are_the_mean_of_an_image(filter):
    for size in ((16, 8), (5, 7), (1, 9)):
        image = random_image(*size)
        mean = srgb_to_linear(image / 255.0).mean((0, 1))
        for wrap in ("repeat", "mirror"):
            for width in (50.0, 1e6, 1e25):
                corners = corners_of(np.random.default_rng(0).random((3, 2)), np.eye(2) * width)
                np.testing.assert_allclose(read(image, corners, filter, (wrap, wrap)), [mean] * 3, atol=2e-3)


@pytest.mark.parametrize("wrap", WRAPS)
@pytest.mark.parametrize("filter", FILTERS)
def test_far_coordinates_stay_inside_the_image(filter, wrap):
    image = np.full((3, 5, 3), 77, np.uint8)
    for far in (1e6, 1e15, 1e30, -1e30):
        uv = np.array([[far, 0.3], [0.6, -far], [far, far]])
        for width in (0.0, 0.1, 10.0, abs(far)):
            values = read(image, corners_of(uv, np.eye(2) * width), filter, (wrap, wrap))
            np.testing.assert_allclose(values, srgb_to_linear(77 / 255), rtol=1e-4)


@pytest.mark.parametrize("filter", FILTERS)
def test_light_above_1_is_not_cut_off(filter):
    random = np.random.default_rng(7)
    image = (100 * random.random((6, 5, 4)) ** 8).astype(np.float32)
    image[..., 3] = 1.0
    corners = some_footprints(random, 2 * COUNT, (5, 6), straight_up_to=3.0)
    expected = naively(image[..., :3].astype(float), corners, filter, ("mirror", "clamp"))
    found = read(image, corners, filter, ("mirror", "clamp"))
    np.testing.assert_allclose(found, expected, atol=2e-3)


def errors_of(codes, corners, filters, wrap, flat=False):
    """The RMS difference of filters from dense means over footprints of a grey image, in codes of 255."""
    linear = srgb_to_linear(codes[..., None] / 255)
    steps = (np.arange(40) + 0.5) / 40 - 0.5
    uv, jacobians = footprints_of(corners)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    places = uv[:, None] + grid @ jacobians.swapaxes(-1, -2)
    reads = naive_filters.dense_reads(linear, (wrap, wrap), places.reshape(-1, 2), flat)
    truth = linear_to_srgb(reads.reshape(len(corners), -1).mean(axis=1))
    image = np.repeat(codes[..., None], 3, axis=2)
    found = [linear_to_srgb(read(image, corners, name, (wrap, wrap), nearest=flat))[:, 0] for name in filters]
    return [255 * float(np.sqrt(np.mean((values - truth) ** 2))) for values in found]


@needs_jit
@pytest.mark.parametrize("wrap", WRAPS)
def test_ewa_is_three_times_as_near_to_stretched_footprints_as_mipmaps(wrap):
    # Footprints 8 times as long as wide in noise of equal power in all octaves, across borders too.
    random = np.random.default_rng(0)
    size = 128
    frequencies = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    frequencies[0, 0] = 1
    pink = np.fft.ifft2(np.fft.fft2(random.normal(size=(size, size))) / frequencies).real
    codes = np.clip((pink - pink.mean()) / pink.std() * 50 + 128, 0, 255).astype(np.uint8)
    for texels in (1.0, 1.5, 2.2):
        errors = []
        for angle in (0.0, 0.3, 0.8, 1.2):
            jacobian = turned(angle) @ np.diag([8.0, 1.0]) @ turned(1.7 * angle) * texels / size
            corners = corners_of(random.uniform(-0.1, 1.1, (50, 2)), jacobian)
            errors.append(errors_of(codes, corners, ("ewa", "trilinear"), wrap))
        ewa, trilinear = np.sqrt(np.mean(np.square(errors), axis=0))
        assert ewa < trilinear / 3, texels


@needs_jit
@pytest.mark.parametrize("flat", [False, True], ids=["patches", "flat"])
@pytest.mark.parametrize("stretch", [1.0, 6.0, 9.0])
def test_footprints_are_averaged_like_boxes_square_or_long(stretch, flat):
    # Widths of 0.2 to 4 texels across and up to 36 along, turned, in waves of 16 texels and more. A long
    # footprint's soft ellipse does not end at the edges of flat texels as a box does.
    random = np.random.default_rng(5)
    y, x = np.mgrid[0:64, 0:64] / 64
    waves = np.zeros((64, 64))
    for a, b in random.integers(-4, 5, (6, 2)):
        waves += np.cos(2 * np.pi * (a * x + b * y + random.random()))
    codes = (255 * (waves - waves.min()) / np.ptp(waves)).astype(np.uint8)
    for texels in (0.2, 0.7, 1.0, 1.5, 2.5, 4.0):
        jacobian = turned(texels) @ np.diag([stretch, 1.0]) @ turned(2 * texels) * texels / 64
        corners = corners_of(random.random((60, 2)), jacobian)
        [error] = errors_of(codes, corners, ("ewa",), "repeat", flat)
        # Beyond 30 texels EWA reads a level that is coarse for the width.
        limits = ((stretch * texels > 30, 10.0), (flat and stretch > 1, 4.0), (texels < 2, 2.0), (True, 3.0))
        most = next(limit for applies, limit in limits if applies)
        assert error < most, texels
