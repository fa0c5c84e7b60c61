"""What only one image saw is left out; and images of other exposures come to agree."""

import math
import tempfile
from types import SimpleNamespace

import numpy as np
import pytest

import octex
from octex import parallel
from octex.channels import BASE_COLOR, decode
from octex.conversion import large
from octex.errors import ArgumentError
from octex.painting.image import falloff_at, mips_of
from octex.photos import agreement, weigh
from octex.photos.consensus import agreed_step, few_at, medians, robust_weights
from octex.photos.patches import patch_of, patches_of, put_mask
from tests.conftest import needs_jit
from tests.make.painted import codes
from tests.make.photographs import error, projections, ring, source_of
from tests.oracles import naive_agreement
from tests.properties.edit_claims import LARGEST_GAIN, digest
from tests.properties.edit_models import camera, random_image, waved


def test_the_mode_is_the_colour_that_most_are_near_to():
    random = np.random.default_rng(0)
    for count in (2, 3, 5, 9):
        colors = random.uniform(0, 0.6, (count, 300, 3)).astype(np.float32)
        colors[: count // 2 + 1] = colors[:1] + random.normal(0, 0.01, colors[: count // 2 + 1].shape)
        weights = (random.uniform(0, 1, (count, 300)) * (random.random((count, 300)) < 0.8)).astype(
            np.float32
        )
        for own in range(count):
            found = np.empty((300, 3), np.float32)
            agreement.find_modes(colors, weights, own, found)
            expected = [naive_agreement.mode(colors[:, n], weights[:, n], own) for n in range(300)]
            np.testing.assert_allclose(found, expected, atol=0.01)
            assert np.isfinite(found).any() == (count > 2)


def test_an_image_differs_by_what_it_is_off_all_between_modes():
    random = np.random.default_rng(6)
    codes, modes = random.uniform(0, 255, (2, 9, 13, 3)).astype(np.float32)
    modes[random.random((9, 13)) < 0.6] = np.nan
    found = agreement.off_modes(codes, modes)
    np.testing.assert_allclose(found, naive_agreement.off(codes, modes), atol=1e-3)
    stripes = np.empty((9, 13, 3), np.float32)
    stripes[:, ::2], stripes[:, 1::2] = 200, 30
    assert agreement.off_modes(np.roll(stripes, 1, axis=1), stripes).max() < 1e-3
    green = np.empty_like(stripes)
    green[:] = 90, 150, 90  # no component of it leaves its range
    assert agreement.off_modes(green, stripes).min() > 25


def test_masks_leave_out_what_is_far_off_with_a_rim_and_no_few_patches():
    random = np.random.default_rng(1)
    counts = []
    for _ in range(60):
        differences = random.uniform(0, 21, (14, 18)).astype(np.float32)
        i, j = random.integers(0, 13, 2)
        differences[i : i + 4, j : j + random.integers(1, 6)] += 30
        differences[i : i + 2, j:18] += 30
        looks = random.uniform(0, 255, (14, 18, 4)).astype(np.float32)
        found = agreement._mask(differences, looks, 20.0)
        np.testing.assert_array_equal(found, naive_agreement.mask(differences, 20.0))
        counts.append(int((found == 0).sum()))
    assert min(counts) == 0
    assert max(counts) > 40
    few = np.zeros((9, 9), np.float32)
    few[3:5, 3:6] = 50
    assert agreement._mask(few, np.zeros((9, 9, 4), np.float32), 20.0).all()


def test_what_is_not_known_is_masked_as_it_is_around():
    differences = np.zeros((16, 16), np.float32)
    differences[:, :8] = 50
    differences[3:13, 2:5] = np.nan
    differences[3:13, 11:14] = np.nan
    looks = np.zeros((16, 16, 4), np.float32)
    found = agreement._mask(differences, looks, 20.0)
    assert not found[:, :8].any()
    assert found[:, 9:].all()
    assert agreement._mask(np.full((4, 4), np.nan, np.float32), looks[:4, :4].copy(), 20.0).all()
    differences[:, 4:12] = np.nan
    for edge in (5, 7, 10):  # the image says where the other object ends
        looks[:] = 0
        looks[:, :edge] = 60
        found = agreement._mask(differences, looks, 20.0)
        assert not found[:, : edge + 1].any()  # with a rim
        assert found[:, edge + 1 :].all()


def test_the_unknown_takes_the_value_of_the_known_patch_with_the_cheapest_way():
    random = np.random.default_rng(12)
    for rows, columns in ((9, 13), (1, 7), (12, 2)):
        values = random.random((rows, columns)).astype(np.float32)
        values[random.random((rows, columns)) < 0.8] = np.nan
        values[0, 0] = 0.5
        looks = random.uniform(0, 60, (rows, columns, 4)).astype(np.float32)
        expected = naive_agreement.filled(values, looks, agreement._STEP)
        agreement.fill_unknown(values, looks)
        np.testing.assert_array_equal(values, expected)


def test_a_mask_fades_between_the_middles_of_its_patches():
    image = np.random.default_rng(2).random((16, 16, 4)).astype(np.float32)
    camera = octex.Camera.pinhole((16, 16), pose=np.eye(4), convention="opencv", focal=9.0)
    mips = mips_of(octex.Projection(image, camera), BASE_COLOR)
    mask = np.ones((4, 4), np.float32)
    mask[:, 2:] = 0
    whole = mips.pixels.copy()
    put_mask(mips, mask)
    part = mips.pixels[:256].reshape(16, 16, 4) / whole[:256].reshape(16, 16, 4)
    x = np.arange(16) + 0.5  # patches' middles are at 2, 6, 10, 14
    np.testing.assert_allclose(
        part, np.broadcast_to(np.clip((10 - x) / 4, 0, 1)[:, None], (16, 16, 4)), atol=1e-5
    )


@needs_jit
def test_a_passer_by_is_left_out_in_any_order_of_images():
    surface, cameras, images = ring()
    seen = [image.copy() for image in images]
    seen[2][30:60, 40:70, :3] = 0.9, 0.02, 0.02
    shots = projections(seen, cameras)
    clean = error(octex.paint(None, surface, projections(images, cameras), max_depth=5), surface)
    averaged = error(octex.paint(None, surface, shots, max_depth=5, pictures="average"), surface)
    robust = octex.paint(None, surface, shots, max_depth=5)
    assert averaged > 3.5 * clean
    assert error(robust, surface) < clean + 0.1 * (averaged - clean)
    other = octex.paint(None, surface, shots[::-1], max_depth=5, pictures="robust")
    assert np.array_equal(other.channels["base_color"].values, robust.channels["base_color"].values)


@needs_jit
def test_a_passer_by_is_left_out_also_where_only_one_image_sees_the_surface():
    surface, cameras, images = ring(8, 128)
    for image in [*images[:2], *images[3:]]:
        image[:48, :, 3] = 0
    y, x = np.mgrid[:128, :128]
    there = np.hypot(x - 64, y - 60) < 28
    hidden, seen = images[2].copy(), images[2].copy()
    hidden[there, 3] = 0
    seen[there] = 0.9, 0.02, 0.02, 1
    samples = surface.scatter(5000)
    errors = []
    for image_2 in (hidden, seen):
        shots = projections([*images[:2], image_2, *images[3:]], cameras)
        found = octex.paint(None, surface, shots, max_depth=5)
        apart = codes(found.sample(samples.rest)) - codes(surface.evaluate(samples))
        errors.append(float(np.sqrt((apart**2).mean())))
    assert errors[1] < errors[0] + 0.2


def test_of_many_images_those_are_compared_that_see_most_of_the_same(monkeypatch):
    surface, cameras, images = ring()
    monkeypatch.setattr(agreement, "_MOST", 5)
    found = agreement._compared(source_of(surface, projections(images, cameras)), surface)
    assert found == [sorted((number + step) % 8 for step in range(-2, 3)) for number in range(8)]
    images[2][30:60, 40:70, :3] = 0.9, 0.02, 0.02
    clean = octex.paint(None, surface, projections(ring()[2], cameras), max_depth=5)
    averaged = octex.paint(None, surface, projections(images, cameras), max_depth=5, pictures="average")
    robust = octex.paint(None, surface, projections(images, cameras), max_depth=5)
    least, most = error(clean, surface), error(averaged, surface)
    assert most > least + 2
    assert error(robust, surface) < least + 0.25 * (most - least)


@pytest.mark.parametrize(
    ("pixels", "depth", "share"),
    [
        (16, 3, 1 / 2),  # pixels are 1/32 and 1/8 wide, cells 1/4
        (16, 8, 256 / 257),  # cells 1/128
        (32, 8, 1 / 2),  # pixels are 1/32 and 1/16 wide
    ],
)
def test_pixels_up_to_twice_as_wide_as_cells_or_the_finest_count_alike_and_coarser_ones_little(
    pixels, depth, share
):
    vertices = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    surface = octex.Surface.from_arrays(vertices, [[0, 1, 2], [0, 2, 3]])
    shots = []
    for light, size in ((1.0, 64), (0.0, pixels)):
        pose = np.diag([1.0, -1, -1, 1])
        pose[2, 3] = 4.0
        lens = octex.Camera.pinhole((size, size), pose=pose, convention="opencv", focal=2.0 * size)
        shots.append(octex.Projection(np.full((size, size, 3), light, np.float32), lens))
    found = octex.paint(None, surface, shots, max_depth=depth)
    expected = share**2  # the square of the mean root
    np.testing.assert_allclose(found.sample(np.zeros((1, 3))), expected, atol=0.01)


@needs_jit
@pytest.mark.usefixtures("few_points")
def test_masks_and_exposures_copy_no_image(monkeypatch):
    surface, cameras, images = ring()
    images = [
        image * np.float32(gain) for image, gain in zip(images, (1, 1.3, 1, 0.8, 1.1, 1, 1, 0.9), strict=True)
    ]
    images[2][30:60, 40:70, :3] = 0.9, 0.02, 0.02
    seen = {"before": [], "after": []}

    def noted(source, *rest, weigh=weigh.weighed):
        seen["before"] += [shot.mips.pixels for shot in source.shots]
        alphas = sum(float(pixels[:, 3].sum()) for pixels in seen["before"])
        found = weigh(source, *rest)
        seen["after"] += [shot.mips.pixels for shot in found.shots]
        assert sum(float(pixels[:, 3].sum()) for pixels in seen["after"]) < alphas  # one is masked
        assert any(shot.falloff.any() for shot in found.shots)
        return found

    monkeypatch.setattr(weigh, "weighed", noted)
    octex.paint(None, surface, projections(images, cameras), max_depth=4, balance="full")
    assert len(seen["after"]) == 8
    for one, other in zip(seen["before"], seen["after"], strict=True):
        assert one is other


def test_changes_to_what_lies_in_a_file_lie_there_too(tmp_path, monkeypatch):
    paths = []
    monkeypatch.setattr(large, "_forget", paths.append)
    with large.scratch(tmp_path):
        (array,) = large.moved([np.ones(5000)])
        array[7:] = 2.0
        assert np.array_equal(large._load(paths[0])[0], array)


@needs_jit
@pytest.mark.usefixtures("few_points")
def test_images_that_memory_has_no_room_for_lie_in_files_meanwhile(tmp_path, monkeypatch):
    surface, cameras, images = ring(5, 48)
    images[2][15:30, 20:35, :3] = 0.9, 0.02, 0.02
    shots = [*projections(images[:4], cameras[:4]), octex.Projection(images[4][..., :3], cameras[4])]

    def painted(**run):
        given = octex.Run(**run) if run else None
        return digest(octex.paint(None, surface, shots, max_depth=5, balance="full", run=given))

    expected, need, other = painted(), 64 * 5 * 48 * 48, tmp_path / "other"
    assert painted(memory=need, folder=other) == expected
    with pytest.raises(ArgumentError, match=r"folder: .*other is not a folder; name an existing one"):
        painted(memory=need - 1, folder=other)
    assert painted(memory="1kB", folder=tmp_path) == expected
    refined = octex.refine_cameras(surface, shots, run=octex.Run(memory="1kB", folder=tmp_path))
    expected_matrices = [camera.matrix for camera in octex.refine_cameras(surface, shots)]
    np.testing.assert_array_equal([camera.matrix for camera in refined], expected_matrices)
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(tempfile, "tempdir", str(other))
    for size in (2 * need, math.inf):
        monkeypatch.setattr(parallel, "memory_size", lambda size=size: size)
        assert painted() == expected
    monkeypatch.setattr(parallel, "memory_size", lambda: 2 * need - 2)
    with pytest.raises(ArgumentError, match=r"folder: .*other is not a folder"):
        painted()


@needs_jit
def test_gains_white_balance_and_vignetting_are_undone_beside_a_reference():
    surface, cameras, images = ring()
    random = np.random.default_rng(3)
    y, x = (np.mgrid[:96, :96] + 0.5 - 48) / np.hypot(48, 48)
    clean = error(octex.paint(None, surface, projections(images, cameras), max_depth=5), surface)
    for balance in ("gain", "full"):
        changed = []
        for number, image in enumerate(images):
            gain = np.full(3, random.uniform(0.7, 1.3))
            lost = random.uniform(0, 0.4) if balance == "full" and number != 3 else 0.0
            gain = gain * random.uniform(0.9, 1.1, 3) if balance == "full" else gain
            gain = np.ones(3) if number == 3 else gain
            light = (1 - lost * (x**2 + y**2))[..., None] * gain
            changed.append(
                np.concatenate([image[..., :3] * light, image[..., 3:]], axis=2).astype(np.float32)
            )
        shots = projections(changed, cameras)
        found = octex.paint(None, surface, shots, max_depth=5, balance=balance, reference=3)
        assert error(found, surface) < clean + 0.5
        assert error(octex.paint(None, surface, shots, max_depth=5), surface) > clean + 5
    with pytest.raises(ArgumentError, match="reference must be"):
        octex.paint(None, surface, shots, balance="full", reference=8)
    with pytest.raises(ArgumentError, match="unknown balance 'auto'; there are: gain, full"):
        octex.paint(None, surface, shots, balance="auto")
    with pytest.raises(ArgumentError, match="unknown pictures 'most'; there are: average, best, robust"):
        octex.paint(None, surface, shots, pictures="most")


def test_a_step_is_that_of_least_squares_with_free_means():
    random = np.random.default_rng(4)
    slopes, values = random.normal(size=(4, 50, 3)), random.normal(size=(4, 50))
    weights = random.uniform(0, 1, (4, 50)) * (random.random((4, 50)) < 0.7)
    ridge = np.full((4, 3), 0.1)
    ridge[1] = np.inf
    found = agreed_step(slopes, values, weights, ridge)
    rows, right = [], []  # of all unknowns: changes, then the mean of each point
    for i in range(4):
        for n in range(50):
            row = np.zeros(12 + 50)
            row[3 * i : 3 * i + 3] = slopes[i, n] if i != 1 else 0
            row[12 + n] = -1
            rows.append(np.sqrt(weights[i, n]) * row)
            right.append(-np.sqrt(weights[i, n]) * values[i, n])
    for k in range(12):
        rows.append(np.sqrt(0.1) * np.eye(62)[k])
        right.append(0.0)
    expected = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0][:12].reshape(4, 3)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert (found[1] == 0).all()


def test_a_weighted_median_halves_the_weight():
    random = np.random.default_rng(3)
    values = random.integers(0, 6, (7, 200)).astype(np.float64)
    weights = random.integers(0, 4, (7, 200)).astype(np.float64)
    weights[:, 0] = 0
    found = medians(values, weights)
    for n in range(200):
        each = np.sort(np.repeat(values[:, n], weights[:, n].astype(int)))  # as often as it weighs
        assert found[n] == (np.median(each) if len(each) else 0)
    assert np.allclose(medians(values, weights / 7), found)


def test_of_many_images_that_see_a_point_sixteen_are_compared_all_as_often():
    random = np.random.default_rng(2)
    weights = random.uniform(0.1, 1, (40, 2000)) * (random.random((40, 2000)) < 0.6)
    found = few_at(weights)
    expected = np.minimum((weights > 0).sum(axis=0), 16)
    np.testing.assert_array_equal((found > 0).sum(axis=0), expected)
    np.testing.assert_array_equal(found[found > 0], weights[found > 0])
    share = (found > 0).sum(axis=1) / (weights > 0).sum(axis=1)
    assert np.ptp(share) < 0.1
    np.testing.assert_array_equal(few_at(weights[:16]), weights[:16])


def test_values_far_from_the_weighted_median_count_for_little():
    values = np.array([[0.0, 1.0], [0.02, 1.0], [0.01, 9.0], [7.0, 1.1]])
    weights, scale = robust_weights(values, np.array([[1.0, 1], [1, 1], [1, 1], [1, 0]]), 0.05)
    assert weights[3, 0] < 1e-4
    assert weights[2, 1] < 1e-4
    assert (weights[:3, 0] > 0.3).all()
    assert scale == 0.05
    alone, _ = robust_weights(values[:1], np.ones((1, 2)), 0.01)
    assert not alone.any()


def test_vignetting_multiplies_light_by_the_distance_from_the_middle():
    falloff, factor = np.array([0.3, -0.2]), getattr(falloff_at, "py_func", falloff_at)
    for x, y in ((5.0, 3.0), (0.0, 0.0), (9.5, 0.5), (2.0, 6.0)):
        square = ((x - 5) ** 2 + (y - 3) ** 2) / (25 + 9)
        assert np.isclose(factor(falloff, 10, 6, x, y), np.exp(0.3 * square - 0.2 * square**2))
        assert factor(np.zeros(2), 10, 6, x, y) == 1.0


@pytest.mark.parametrize(("kind", "first"), [("cube", 27), ("open", 12)])
def test_images_that_no_lens_took_are_not_evened_towards_their_corners(kind, first):
    surface = waved(kind, 1, ["base_color"], 0)
    texture = octex.convert(surface, 2, dtype="float32")
    shots = [
        octex.Projection(random_image(3 * n + 1, 30, 20), camera(surface, n, 30, 20))
        for n in range(first, first + 3)
    ]
    layer = octex.project(surface, shots, like=texture, max_depth=4, balance="full", fit=False)
    colors = decode(layer.channels["base_color"].values, "srgb")
    assert colors.max() < LARGEST_GAIN


def test_large_images_have_larger_patches():
    for size, patch in (((1024, 1024), 4), ((1920, 1080), 4), ((2832, 2128), 8), ((6000, 4000), 16)):
        sizes = np.array([[0, *size]], np.int64)
        shot = SimpleNamespace(mips=SimpleNamespace(sizes=sizes))
        assert patch_of(shot) == patch
        rows, columns = patches_of(shot)
        assert rows * columns <= 1 << 17
