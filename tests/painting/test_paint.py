"""Painting: images in, the texture with their paint out."""

from itertools import permutations

import numpy as np
import pytest

import octex
from octex.channels import decode
from octex.errors import ArgumentError
from octex.painting.blend import blended
from octex.painting.image import BLENDS
from octex.photos.balance import exposures
from octex.texture import OctreeTexture
from octex.tree.layout import KEPT
from tests.conftest import needs_jit
from tests.make.painted import above, ball, codes, image_of, one_color, plain, square, together
from tests.make.photographs import error, projections, ring, source_of
from tests.properties.edit_claims import cells_of

pytestmark = needs_jit


def spot(camera, color, radius, alpha=1.0):
    """A disc of one colour in the middle of an image that is else transparent."""
    image = one_color(camera, color)
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    away = np.hypot(x - camera.width / 2, y - camera.height / 2)
    image[..., 3] = alpha * (away < radius)
    return image


def on_square(count, within=0.5, seed=0):
    points = np.zeros((count, 3))
    points[:, :2] = np.random.default_rng(seed).uniform(-within, within, (count, 2))
    return points


# --- right


@pytest.mark.parametrize(("is_drawn", "fading", "vanished"), [(False, 65.0, 75.0), (True, 75.0, 85.0)])
def test_what_was_drawn_on_a_view_reaches_farther_around_the_model(is_drawn, fading, vanished):
    surface = ball(48)
    camera = octex.Camera.fitted(surface.vertices, (0, 0, 1), size=(128, 128))
    before = one_color(camera, (0, 0, 0)) if is_drawn else None
    layer = octex.project(surface, octex.Projection(one_color(camera, (1, 0, 0)), camera, since=before))
    samples = surface.scatter(2000)
    toward = camera.position - samples.rest
    cosines = np.einsum("nk,nk->n", samples.normals, toward) / np.linalg.norm(toward, axis=1)
    angles = np.degrees(np.arccos(cosines))
    covered = layer.sample(samples.rest, "alpha", "nearest")[:, 0] * layer.contains(samples.rest)
    assert (covered[angles < fading - 3] > 0.99).all()
    assert (covered[angles > vanished + 3] < 0.01).all()
    halfway = np.abs(angles - (fading + vanished) / 2) < 1
    assert 0.1 < np.median(covered[halfway]) < 0.9


def test_images_that_paint_nothing_leave_the_texture_itself():
    surface, camera = ball(), above(4.0)
    texture = octex.convert(surface, 5)
    red, clear = one_color(camera, (1, 0, 0)), one_color(camera, (1, 0, 0), 0.0)
    images = [octex.Projection(clear, camera), octex.Projection(red, camera, opacity=0.0)]
    images.append(octex.Projection(red, camera, mask=np.zeros((64, 64), np.uint8)))
    away = np.diag([1.0, -1, -1, 1])
    away[2, 3] = 4
    for pose in (away, np.eye(4)):  # it looks away, or is inside
        other = octex.Camera.pinhole((64, 64), pose=pose, convention="opengl", focal=60.0)
        images.append(octex.Projection(red, other))
    for image in images:
        assert octex.paint(texture, surface, image) is texture
    assert octex.paint(None, surface, images[0]).tree.n_leaves == 0


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_a_wash_scales_the_contrast_of_detail(dtype):
    surface = ball()
    texture = octex.convert(surface, 7, dtype=dtype)
    camera = above(4.0, 24)  # its pixels are some four cells wide
    wash = octex.Projection(one_color(camera, (0.2, 0.5, 0.9), 0.3), camera)
    found = octex.paint(texture, surface, wash, max_angle=90)
    found.validate()
    assert found.tree.n_leaves == texture.tree.n_leaves
    leaves = texture.tree.leaf_cells()
    format = texture.channels["base_color"].format
    before = decode(texture.channels["base_color"].values[leaves], format.space)
    after = decode(found.channels["base_color"].values[leaves], format.space)
    expected = 0.7 * before + 0.3 * np.array([0.2, 0.5, 0.9])
    whole = cells_of(texture).low[leaves, 2] > 0.7  # all of these cells and of those beside them is seen
    assert whole.sum() > 50
    if dtype == "uint8":
        assert np.abs(codes(after) - codes(expected))[whole].max() < 0.85  # the paint is rounded too
    else:
        np.testing.assert_allclose(after[whole], expected[whole], atol=1e-5)


@pytest.mark.parametrize("dtype", ["float32", "uint8"])
def test_fine_paint_over_a_coarse_texture_moves_nothing_beyond_its_boundary(dtype):
    points, triangles = square()
    surface = octex.Surface.from_arrays(points, triangles, colors=0.5 + 0.4 * np.sin(5 * points + [0, 1, 2]))
    texture = octex.convert(surface, 4, dtype=dtype)
    camera = above(3.0, 128, 384.0)  # 128 pixels to a unit
    found = octex.paint(texture, surface, octex.Projection(spot(camera, (1, 0, 0), 20), camera))
    found.validate()
    assert found.tree.kept.cells.size
    assert found.tree.max_depth > 6
    cell = texture.placement.size / 2**found.tree.max_depth
    samples = on_square(4000)
    away = np.hypot(samples[:, 0], samples[:, 1])
    outside = away > 20 / 128 + 8 * cell
    before, after = texture.sample(samples), found.sample(samples)
    step = 5e-6 if dtype == "float32" else 0.0045  # half a step of sRGB codes, in light
    assert np.abs(after - before)[outside].max() < step
    inside = away < 20 / 128 - 4 * cell
    assert inside.sum() > 200
    np.testing.assert_allclose(after[inside], np.tile([1.0, 0, 0], (inside.sum(), 1)), atol=0.02)
    # what was a leaf and is a node now keeps its coefficient
    kept = found.tree.kept.cells
    assert (found.tree.arrays.flags[kept] & KEPT != 0).all()


def test_painting_twice_with_full_opacity_is_painting_once():
    surface, camera = ball(), above(4.0, 100)
    projection = octex.Projection(image_of(surface, camera), camera)
    for base in (None, octex.convert(surface, 5)):
        once = octex.paint(base, surface, projection, max_angle=90)
        twice = octex.paint(once, surface, projection, max_angle=90)
        assert twice.tree.n_leaves == once.tree.n_leaves
        samples = surface.scatter(5000)
        toward = camera.position - samples.points
        cosine = np.einsum("nx,nx->n", samples.normals, toward) / np.linalg.norm(toward, axis=1)
        apart = np.abs(twice.sample(samples.rest) - once.sample(samples.rest)).max(axis=1)
        assert apart[cosine > 0.25].max() < (1e-6 if base is None else 0.01)


def test_averages_stay_those_of_what_is_there():
    surface = plain(square(steps=16), (0.25, 0.5, 0.75))
    texture = octex.convert(surface, 7, dtype="float32")
    camera = above(3.0, 128, 384.0)
    image = one_color(camera, (1.0, 0.0, 0.0))
    image[:, :48, 3] = 0  # the left three eighths stay
    found = octex.paint(texture, surface, octex.Projection(image, camera))
    root = found.channels["base_color"].values[0]
    expected = 0.375 * np.array([0.25, 0.5, 0.75]) + 0.625 * np.array([1.0, 0, 0])
    np.testing.assert_allclose(root, expected, atol=0.01)
    whole = octex.paint(texture, surface, octex.Projection(one_color(camera, (1, 0, 0)), camera))
    nodes = np.setdiff1d(np.arange(whole.tree.n_cells), whole.tree.leaf_cells())
    np.testing.assert_allclose(
        whole.channels["base_color"].values[nodes], np.tile([1.0, 0, 0], (nodes.size, 1)), atol=1e-4
    )
    small = octex.paint(texture, surface, octex.Projection(spot(camera, (0, 0, 0), 6), camera))
    there = slice(*texture.tree.arrays.level_cells[3:5].tolist())
    stays = small.channels["base_color"].values[there] == texture.channels["base_color"].values[there]
    assert 0.5 < stays.all(axis=1).mean() < 1


# --- blend modes, channels, layers


def test_blend_modes_are_their_formulas():
    random = np.random.default_rng(0)
    base, paint = random.random((2, 50, 3)).astype(np.float32)
    part = random.random(50).astype(np.float32)
    part[:5] = 0
    a = part[:, None]
    expected = {
        "over": (1 - a) * base + a * paint,
        "multiply": (1 - a) * base + a * base * paint,
        "screen": (1 - a) * base + a * (1 - (1 - base) * (1 - paint)),
        "add": base + a * paint,
        "erase": (1 - a) * base,
        "replace": np.where(a > 0, paint, base),
    }
    assert tuple(expected) == BLENDS
    for blend in BLENDS:
        np.testing.assert_allclose(blended(base, paint, part, blend), expected[blend], atol=1e-6)


def test_opaque_paint_leaves_nothing_of_what_was_there_however_bright_it_was():
    old, new = np.full((1, 3), 3e7, np.float32), np.array([[0.2, 0.7, 0.0]], np.float32)
    for blend in ("over", "replace"):
        np.testing.assert_array_equal(blended(old, new, np.ones(1, np.float32), blend), new)


@pytest.mark.parametrize("blend", BLENDS)
def test_images_are_blended_in_linear_light(blend):
    surface, camera = plain(square(), (0.4, 0.2, 0.6)), above(3.0, 64, 192.0)
    texture = octex.convert(surface, 5, dtype="float32")
    image = one_color(camera, (0.5, 0.5, 0.1), 0.5)
    found = octex.paint(texture, surface, octex.Projection(image, camera, blend=blend))
    found.validate()
    points = on_square(60, 0.3)  # few: for many, a kernel is compiled for each pair of types
    part, base, paint = np.array([0.5], np.float32), np.array([[0.4, 0.2, 0.6]]), np.array([[0.5, 0.5, 0.1]])
    if blend == "erase":
        np.testing.assert_allclose(found.sample(points, "alpha"), np.full((60, 1), 0.5), atol=0.003)
        np.testing.assert_allclose(found.sample(points), np.tile(base, (60, 1)), atol=1e-3)
        return
    expected = blended(base.astype(np.float32), paint.astype(np.float32), part, blend)
    np.testing.assert_allclose(found.sample(points), np.tile(expected, (60, 1)), atol=1e-3)


def test_paint_over_what_is_translucent_makes_it_more_opaque():
    points, triangles = square()
    colors = np.tile([0.2, 0.2, 0.2, 0.5], (len(points), 1))
    surface, camera = octex.Surface.from_arrays(points, triangles, colors=colors), above(3.0, 64, 192.0)
    texture = octex.convert(surface, 5, dtype="float32")
    found = octex.paint(texture, surface, octex.Projection(one_color(camera, (1, 0, 0), 0.5), camera))
    places = on_square(50, 0.3)
    np.testing.assert_allclose(found.sample(places, "alpha"), np.full((50, 1), 0.75), atol=1e-3)
    expected = (0.5 * np.array([1, 0, 0]) + 0.5 * 0.5 * np.array([0.2, 0.2, 0.2])) / 0.75
    np.testing.assert_allclose(found.sample(places), np.tile(expected, (50, 1)), atol=2e-3)


@pytest.mark.parametrize(
    ("channel", "dtype"), [("roughness", "uint8"), ("roughness", "uint16"), ("emissive", "float16")]
)
def test_any_channel_is_painted_and_the_others_stay(channel, dtype):
    surface = plain(square()).with_sources({"roughness": 0.25, "emissive": (0.5, 0.25, 0.0)})
    camera = above(3.0, 128, 384.0)
    texture = octex.convert(surface, 4, dtype={channel: dtype})
    image = one_color(camera, (0.75, 0.75, 0.75))
    found = octex.paint(texture, surface, octex.Projection(image, camera), channel=channel)
    found.validate()
    points = on_square(60, 0.4)
    wanted = np.full((60, found.channels[channel].format.components), 0.75)
    np.testing.assert_allclose(found.sample(points, channel), wanted, atol=0.01)
    for other in set(texture.channels) - {channel}:
        np.testing.assert_allclose(found.sample(points, other), texture.sample(points, other), atol=0.005)


def test_layers_are_kept_and_merged_later(tmp_path):
    surface, camera = ball(), above(4.0, 100)
    texture = octex.convert(surface, 6)
    projection = octex.Projection(spot(camera, (1, 0, 0), 20), camera, opacity=0.6)
    layer = octex.project(surface, projection, like=texture)
    layer.validate()
    layer.save(tmp_path / "layer.octex")
    again = octex.open(tmp_path / "layer.octex")
    points = surface.scatter(3000).rest
    at_once = octex.paint(texture, surface, projection).sample(points)
    later = octex.merge(texture, again, surface, opacity=0.6).sample(points)
    np.testing.assert_array_equal(at_once, later)
    full = octex.merge(texture, again, surface).sample(points)
    assert np.abs(full - later).max() > 0.1
    multiplied = octex.merge(texture, again, surface, blend="multiply")
    assert np.abs(multiplied.sample(points) - full).max() > 0.05


def test_layers_that_do_not_fit_are_refused():
    surface, camera = ball(), above(4.0, 32)
    texture = octex.convert(surface, 5)
    layer = octex.project(surface, octex.Projection(one_color(camera, (1, 0, 0)), camera), like=texture)
    with pytest.raises(ArgumentError, match="a layer must have one channel and alpha"):
        octex.merge(texture, texture, surface)
    with pytest.raises(ArgumentError, match=r"the layer's root cell, .* is not the texture's"):
        octex.merge(octex.convert(surface, 3), layer, surface)
    rough = octex.convert(plain(square()).with_sources({"roughness": 0.5}), 5, channels=["roughness"])
    moved = OctreeTexture(rough.tree, rough.channels, texture.placement, texture.bounds)
    with pytest.raises(ArgumentError, match="unknown channel to paint 'base_color'; there are: roughness"):
        octex.merge(moved, layer, surface)
    with pytest.raises(ArgumentError, match="unknown blend 'burn'"):
        octex.merge(texture, layer, surface, blend="burn")


# --- several images


def test_the_finer_of_two_images_outweighs_the_other():
    surface = plain(square())
    near, far = above(1.5, 128, 192.0), above(6.0, 128, 192.0)
    images = [
        octex.Projection(one_color(near, (1, 0, 0)), near),
        octex.Projection(one_color(far, (0, 0, 1)), far),
    ]
    found = octex.paint(None, surface, images)
    sampled = found.sample(on_square(200, 0.2))
    assert sampled[:, 0].min() > 0.9  # four times as wide, most of the other's pixels are too coarse
    other = octex.paint(None, surface, images[::-1]).sample(on_square(200, 0.2))
    np.testing.assert_allclose(other, sampled, atol=1e-6)


@pytest.mark.usefixtures("few_points")
@pytest.mark.parametrize("balance", [None, "gain", "full"])
def test_the_order_of_images_in_one_blend_mode_does_not_matter(balance):
    surface, random = ball(12), np.random.default_rng(4)
    images = []
    for number, direction in enumerate([(0.1, 0.2, 1), (0.5, 0.1, 1), (-0.4, 0.3, 1)]):
        camera = octex.Camera.fitted(surface.vertices, direction, size=(48, 48))
        noise = random.integers(0, 256, (48, 48, 3)).astype(np.uint8)
        images.append(octex.Projection(noise, camera, opacity=1.0 - 0.2 * number))
    first = octex.paint(None, surface, images, max_depth=7, balance=balance)
    assert first.tree.n_leaves > 10_000
    orders = [*permutations(images)]
    for order in (orders[3], orders[5]):  # turned round, and backwards
        other = octex.paint(None, surface, order, max_depth=7, balance=balance)
        assert np.array_equal(other.tree.arrays.flags, first.tree.arrays.flags)
        for name, channel in first.channels.items():
            assert np.array_equal(other.channels[name].values, channel.values)
            assert np.array_equal(other.channels[name].split_values, channel.split_values)


def test_images_of_other_blend_modes_are_merged_one_after_another():
    surface, camera = plain(square(), (0.5, 0.5, 0.5)), above(3.0, 32, 96.0)
    texture = octex.convert(surface, 4, dtype="float32")
    steps = [("over", (0.8, 0.4, 0.2)), ("multiply", (0.5, 0.5, 0.5)), ("over", (0.0, 1.0, 0.0))]
    images = [octex.Projection(one_color(camera, color, 0.5), camera, blend=blend) for blend, color in steps]
    expected = np.array([[0.5, 0.5, 0.5]], np.float32)
    for blend, color in steps:
        expected = blended(expected, np.array([color], np.float32), np.array([0.5], np.float32), blend)
    found = octex.paint(texture, surface, images, max_depth=4).sample(on_square(50, 0.3))
    np.testing.assert_allclose(found, np.tile(expected, (50, 1)), atol=2e-3)


@pytest.mark.usefixtures("few_points")
def test_balance_makes_images_agree():
    surface, cameras, images = ring(6, 100)
    gains = np.random.default_rng(5).uniform(0.8, 1.2, (6, 3)).astype(np.float32)
    gains /= np.exp(np.log(gains).mean(axis=0))
    changed = [image * np.append(gain, 1) for image, gain in zip(images, gains, strict=True)]
    plain_error, off, mended = (
        error(octex.paint(None, surface, projections(shown, cameras), max_depth=6, balance=balance), surface)
        for shown, balance in ((images, None), (changed, None), (changed, "full"))
    )
    assert off > 2 * plain_error + 1
    assert mended < plain_error + 0.3 * (off - plain_error)


@pytest.mark.usefixtures("few_points")
def test_images_that_do_not_overlap_keep_their_gains():
    surface = plain(together(square(), (square()[0] + [5, 0, 0], square()[1])))
    shown = []
    for x in (0.0, 5.0):
        pose = np.eye(4)
        pose[:3, 3] = x, 0, 3
        camera = octex.Camera.pinhole((64, 64), pose=pose, convention="opengl", focal=180.0)
        shown.append(octex.Projection(one_color(camera, (0.2 + 0.1 * x, 0.5, 0.5)), camera))
    found = exposures(source_of(surface, shown), surface, "full", None)
    np.testing.assert_allclose(found, np.zeros((2, 5)), atol=1e-6)


# --- steps and refusals


def test_what_makes_no_sense_is_refused():
    surface, camera = ball(), above(4.0, 32)
    texture = octex.convert(surface, 4)
    good = octex.Projection(one_color(camera, (1, 0, 0)), camera)
    for options, message in (
        ({"channel": "roughness"}, "unknown channel of the texture 'roughness'; there are: base_color"),
        ({"max_angle": -1}, "max_angle must be from 0 to 180, not -1"),
        ({"edge_feather": -2}, "edge_feather must be from 0"),
        ({"max_depth": 30}, "max_depth must be a whole number from 0 to 21"),
    ):
        with pytest.raises(ArgumentError, match=message):
            octex.paint(texture, surface, good, **options)
    for channel, message in (("colour", "unknown channel 'colour'"), ("alpha", 'painted with blend="erase"')):
        with pytest.raises(ArgumentError, match=message):
            octex.paint(None, surface, good, channel=channel)
    with pytest.raises(ArgumentError, match=r"out of the texture's root cell .* belongs to another model"):
        octex.paint(texture, ball(radius=3.0), good)
