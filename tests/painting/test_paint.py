"""Painting: pictures in, the texture with their paint out."""

from itertools import permutations

import numpy as np
import pytest

import octex
from octex.channels import decode
from octex.errors import ArgumentError
from octex.painting.blend import blended
from octex.painting.layer import paint_of, wanted_depths
from octex.painting.picture import BLENDS
from octex.parallel import pool_of
from octex.photos.balance import exposures
from octex.texture import OctreeTexture
from octex.tree.beside import boundary
from octex.tree.layout import KEPT, SPLIT
from octex.tree.morton import decode_cells
from tests.conftest import needs_jit
from tests.make.painted import above, ball, centres, codes, one_color, picture_of, plain, square, together
from tests.make.small_surfaces import sheet

pytestmark = needs_jit


def spot(camera, color, radius, alpha=1.0):
    """A disc of one colour in the middle of a picture that is else transparent."""
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


def test_a_picture_painted_back_from_its_own_camera_is_what_is_seen():
    surface = ball()
    camera = octex.Camera.fitted(surface.vertices, (0.3, 0.4, 1), size=(160, 140))
    image = picture_of(surface, camera)
    texture = octex.paint(None, surface, octex.Projection(image, camera), max_angle=90)
    texture.validate()
    pixels, rest, normals = centres(surface, camera)
    error = codes(texture.sample(rest, normals=normals)) - codes(image.reshape(-1, 4)[pixels, :3])
    assert np.sqrt((error**2).mean()) < 1.0
    assert set(texture.channels) == {"base_color"}


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


def test_nothing_but_what_is_seen_is_painted():
    surface = ball()
    camera = above(4.0, 128)
    picture = octex.Projection(one_color(camera, (1, 0, 0)), camera)
    texture = octex.paint(None, surface, picture, holes="leave")
    samples = surface.scatter(20_000)
    painted = texture.contains(samples.rest)
    toward = camera.position - samples.points
    angles = np.degrees(
        np.arccos(np.einsum("nx,nx->n", samples.normals, toward) / np.linalg.norm(toward, axis=1))
    )
    assert painted[angles < 70].all()
    leaf = texture.placement.size / 2**texture.tree.max_depth
    edge = np.cos(np.arccos(1 / 4.0) - np.radians(0))  # no point beyond 75° is farther than its leaf
    assert not painted[(angles > 76) & (samples.points[:, 2] < edge * 0.9 - 2 * leaf)].any()


def test_paint_of_alpha_nothing_leaves_the_texture_itself():
    surface, camera = ball(), above(4.0)
    texture = octex.convert(surface, 5)
    for options in ({"opacity": 0.0}, {"mask": np.zeros((64, 64), np.uint8)}):
        projection = octex.Projection(one_color(camera, (1, 0, 0)), camera, **options)
        assert octex.paint(texture, surface, projection) is texture
    clear = octex.Projection(one_color(camera, (1, 0, 0), 0.0), camera)
    assert octex.paint(texture, surface, clear) is texture
    assert octex.paint(None, surface, clear).tree.n_leaves == 0


def test_a_camera_that_looks_away_or_is_inside_paints_nothing():
    surface = ball()
    texture = octex.convert(surface, 5)
    away = np.diag([1.0, -1, -1, 1])
    away[2, 3] = 4
    for pose in (away, np.eye(4)):
        camera = octex.Camera.pinhole((32, 32), pose=pose, convention="opengl", focal=30.0)
        projection = octex.Projection(one_color(camera, (1, 0, 0)), camera)
        assert octex.paint(texture, surface, projection) is texture


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
    layer = octex.project(surface, wash, like=texture, max_angle=90)
    whole = np.zeros(len(leaves), bool)
    at, _ = where(texture, layer)
    whole[np.searchsorted(leaves, at)] = True
    assert whole.sum() > 50
    if dtype == "uint8":
        assert np.abs(codes(after) - codes(expected))[whole].max() < 0.85  # the paint is rounded too
    else:
        np.testing.assert_allclose(after[whole], expected[whole], atol=1e-5)


def where(texture, layer):
    """Leaves of a texture of even depth that lie wholly under a layer's greatest coverage."""
    alpha = layer.channels["alpha"].values[:, 0] / 65535
    most = alpha.max()
    found = []
    depth = texture.tree.max_depth
    leaf_codes = texture.tree.level_codes(depth)
    for level, (level_codes, is_node) in enumerate(layer.tree.walk()):
        first = layer.tree.arrays.level_cells[level]
        whole = level_codes[~is_node & (alpha[first : first + level_codes.size] >= most - 1e-9)]
        # beside paint of less coverage, refinement mixes: take what lies inside
        inner = (
            whole[np.array([_is_inner(layer, level, int(code), whole) for code in whole.tolist()], bool)]
            if whole.size
            else whole
        )
        found.append(np.flatnonzero(np.isin(leaf_codes >> 3 * (depth - level), inner)))
    cells = np.concatenate(found) + texture.tree.arrays.level_cells[depth]
    return np.sort(cells), alpha


def _is_inner(layer, level, code, whole):
    from octex.tree.morton import decode_cells, encode_cells

    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
    around = encode_cells(np.clip(decode_cells([code]) + steps, 0, (1 << level) - 1))
    stored = around[np.isin(around, layer.tree.level_codes(level))]
    return bool(np.isin(stored, whole).all())


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
    projection = octex.Projection(picture_of(surface, camera), camera)
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


def test_each_side_of_something_thin_is_painted_for_itself():
    surface = sheet(np.eye(3), 0.004)
    texture = octex.convert(surface, 5)
    size = float(np.ptp(surface.bounds, axis=0).max())
    camera = above(3.0, 96, 96 * 3 / size * 0.9)
    blue = octex.paint(texture, surface, octex.Projection(one_color(camera, (0, 0, 1)), camera))
    blue.validate()
    points = surface.scatter(3000)
    inner = np.abs(points.rest[:, :2]).max(axis=1) < 0.4 * size
    front = inner & (points.normals[:, 2] > 0.9)
    back = inner & (points.normals[:, 2] < -0.9)
    seen = blue.sample(points.rest, normals=points.normals)
    before = texture.sample(points.rest, normals=points.normals)
    np.testing.assert_allclose(seen[front], np.tile([0, 0, 1.0], (front.sum(), 1)), atol=0.01)
    np.testing.assert_allclose(seen[back], before[back], atol=0.01)
    assert (blue.tree.arrays.flags & SPLIT != 0).any()


def test_paint_on_a_posed_model_lands_at_rest():
    rest = ball(16)
    posed = rest.vertices * [1.0, 1.6, 0.7] + [3.0, -1.0, 2.0]
    surface = octex.Surface.from_arrays(
        posed, rest.triangles, colors=0.5 + 0.4 * np.sin(3 * rest.vertices), rest=rest.vertices
    )
    camera = octex.Camera.fitted(posed, (0.2, 0.3, 1), size=(120, 120))
    image = picture_of(surface, camera)
    texture = octex.paint(None, surface, octex.Projection(image, camera), max_angle=90)
    assert texture.bounds.tolist() == rest.bounds.tolist()
    pixels, places, normals = centres(surface, camera)
    assert np.abs(places).max() < 1.01
    error = codes(texture.sample(places, normals=normals)) - codes(image.reshape(-1, 4)[pixels, :3])
    assert np.sqrt((error**2).mean()) < 1.5


def test_a_subdivided_cage_is_painted_at_its_hull(models):
    folder = models / "opensubdiv-cages"
    hull = octex.load_surface(folder / "catmark_cube_creases0_level4.obj")
    loaded = octex.load_surface(folder / "catmark_cube_level4.obj", rest=hull.vertices)
    surface = octex.Surface.from_arrays(
        loaded.vertices, loaded.triangles, colors=0.5 + 0.4 * np.sin(3 * loaded.rest), rest=loaded.rest
    )
    camera = octex.Camera.fitted(surface.vertices, (0.5, 0.4, 1), size=(128, 128))
    image = picture_of(surface, camera)
    texture = octex.paint(None, surface, octex.Projection(image, camera), max_angle=90)
    pixels, rest, normals = centres(surface, camera)
    error = codes(texture.sample(rest, normals=normals)) - codes(image.reshape(-1, 4)[pixels, :3])
    assert np.sqrt((error**2).mean()) < 2.0
    assert np.abs(loaded.rest - loaded.vertices).max() > 0.01


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
def test_pictures_are_blended_in_linear_light(blend):
    surface, camera = plain(square(), (0.4, 0.2, 0.6)), above(3.0, 64, 192.0)
    texture = octex.convert(surface, 5, dtype="float32")
    image = one_color(camera, (0.5, 0.5, 0.1), 0.5)
    found = octex.paint(texture, surface, octex.Projection(image, camera, blend=blend))
    found.validate()
    points = on_square(100, 0.3)
    part, base, paint = np.array([0.5], np.float32), np.array([[0.4, 0.2, 0.6]]), np.array([[0.5, 0.5, 0.1]])
    if blend == "erase":
        np.testing.assert_allclose(found.sample(points, "alpha"), np.full((100, 1), 0.5), atol=0.003)
        np.testing.assert_allclose(found.sample(points), np.tile(base, (100, 1)), atol=1e-3)
        return
    expected = blended(base.astype(np.float32), paint.astype(np.float32), part, blend)
    np.testing.assert_allclose(found.sample(points), np.tile(expected, (100, 1)), atol=1e-3)


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
    points = on_square(200, 0.4)
    wanted = np.full((200, found.channels[channel].format.components), 0.75)
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


# --- several pictures


def test_the_finer_of_two_pictures_outweighs_the_other():
    surface = plain(square())
    near, far = above(1.5, 128, 192.0), above(6.0, 128, 192.0)
    pictures = [
        octex.Projection(one_color(near, (1, 0, 0)), near),
        octex.Projection(one_color(far, (0, 0, 1)), far),
    ]
    found = octex.paint(None, surface, pictures)
    sampled = found.sample(on_square(200, 0.2))
    assert sampled[:, 0].min() > 0.9  # four times as wide, most of the other's pixels are too coarse
    other = octex.paint(None, surface, pictures[::-1]).sample(on_square(200, 0.2))
    np.testing.assert_allclose(other, sampled, atol=1e-6)


@pytest.mark.usefixtures("few_points")
@pytest.mark.parametrize("balance", [None, "gain", "full"])
def test_the_order_of_pictures_in_one_blend_mode_does_not_matter(balance):
    surface, random = ball(12), np.random.default_rng(4)
    pictures = []
    for number, direction in enumerate([(0.1, 0.2, 1), (0.5, 0.1, 1), (-0.4, 0.3, 1)]):
        camera = octex.Camera.fitted(surface.vertices, direction, size=(48, 48))
        noise = random.integers(0, 256, (48, 48, 3)).astype(np.uint8)
        pictures.append(octex.Projection(noise, camera, opacity=1.0 - 0.2 * number))
    first = octex.paint(None, surface, pictures, max_depth=7, balance=balance)
    assert first.tree.n_leaves > 10_000
    orders = [*permutations(pictures)][1:]
    for order in orders if balance is None else (orders[2], orders[4]):  # turned round, and backwards
        other = octex.paint(None, surface, order, max_depth=7, balance=balance)
        assert np.array_equal(other.tree.arrays.flags, first.tree.arrays.flags)
        for name, channel in first.channels.items():
            assert np.array_equal(other.channels[name].values, channel.values)
            assert np.array_equal(other.channels[name].split_values, channel.split_values)


def test_pictures_of_other_blend_modes_are_merged_one_after_another():
    surface, camera = plain(square(), (0.5, 0.5, 0.5)), above(3.0, 32, 96.0)
    texture = octex.convert(surface, 4, dtype="float32")
    steps = [("over", (0.8, 0.4, 0.2)), ("multiply", (0.5, 0.5, 0.5)), ("over", (0.0, 1.0, 0.0))]
    pictures = [
        octex.Projection(one_color(camera, color, 0.5), camera, blend=blend) for blend, color in steps
    ]
    expected = np.array([[0.5, 0.5, 0.5]], np.float32)
    for blend, color in steps:
        expected = blended(
            expected,
            np.array([color], np.float32),
            np.array([0.5], np.float32),
            blend,
        )
    found = octex.paint(texture, surface, pictures, max_depth=4).sample(on_square(50, 0.3))
    np.testing.assert_allclose(found, np.tile(expected, (50, 1)), atol=2e-3)


def test_balance_makes_pictures_agree():
    surface = ball(rings=32)
    cameras = [
        octex.Camera.fitted(surface.vertices, (np.sin(turn), 0.2, np.cos(turn)), size=(100, 100))
        for turn in np.arange(6) * np.pi / 3
    ]
    images = [picture_of(surface, camera) for camera in cameras]
    gains = np.random.default_rng(5).uniform(0.8, 1.2, (6, 3)).astype(np.float32)
    gains /= np.exp(np.log(gains).mean(axis=0))
    changed = [image * np.append(gain, 1) for image, gain in zip(images, gains, strict=True)]
    samples = surface.scatter(5000)
    truth = surface.evaluate(samples)

    def error(pictures, **options):
        shots = [octex.Projection(image, camera) for image, camera in zip(pictures, cameras, strict=True)]
        found = octex.paint(None, surface, shots, max_depth=6, holes="leave", **options)
        seen = found.contains(samples.rest)
        return float(np.sqrt(((codes(found.sample(samples.rest)) - codes(truth))[seen] ** 2).mean()))

    plain_error, off = error(images), error(changed)
    mended = error(changed, balance="full")
    assert off > 2 * plain_error + 1
    assert mended < plain_error + 0.3 * (off - plain_error)


def test_pictures_that_do_not_overlap_keep_their_gains():
    surface = plain(together(square(), (square()[0] + [5, 0, 0], square()[1])))
    from octex.painting.project import take_shots
    from octex.painting.reading import terms_of
    from octex.painting.surface import PaintedSurface

    form = octex.convert(surface, 2).channels["base_color"].format
    shots, painted = [], PaintedSurface(surface)
    with pool_of(1) as pool:
        for x in (0.0, 5.0):
            pose = np.eye(4)
            pose[:3, 3] = x, 0, 3
            camera = octex.Camera.pinhole((64, 64), pose=pose, convention="opengl", focal=180.0)
            picture = octex.Projection(one_color(camera, (0.2 + 0.1 * x, 0.5, 0.5)), camera)
            shots += take_shots([picture], form, [1.0], painted.sights([camera], 0.0, pool), pool)
    source = painted.projected(shots, form, terms_of(75, 0, False))
    np.testing.assert_allclose(exposures(source, surface, "full", None), np.zeros((2, 5)), atol=1e-6)


# --- steps and refusals


def test_the_boundary_is_one_cell_of_the_same_size_around_paint():
    surface, camera = plain(square()), above(3.0, 64, 192.0)
    layer = octex.project(surface, octex.Projection(spot(camera, (1, 0, 0), 8), camera))
    paint = paint_of(layer, 1.0)
    from octex.tree.morton import decode_cells

    for level, each in enumerate(paint):
        around = boundary(each.codes, level)
        if not each.codes.size:
            assert not around.size
            continue
        own, beside = decode_cells(each.codes), decode_cells(around)
        assert not set(map(tuple, own.tolist())) & set(map(tuple, beside.tolist()))
        apart = np.abs(beside[:, None] - own[None]).max(axis=2).min(axis=1)
        assert (apart == 1).all()


def test_paint_goes_no_deeper_than_asked_for_and_as_deep_as_pixels_are_fine():
    surface = plain(square())
    near, far = above(1.5, 128, 192.0), above(6.0, 128, 192.0)
    depths = [
        octex.paint(None, surface, octex.Projection(one_color(camera, (1, 0, 0)), camera)).tree.max_depth
        for camera in (near, far)
    ]
    assert depths[0] == depths[1] + 2
    cell = 1.0 / 2 ** depths[0]
    assert 0.5 / 128 <= cell <= 1.1 / 128
    shallow = octex.paint(None, surface, octex.Projection(one_color(near, (1, 0, 0)), near), max_depth=4)
    assert shallow.tree.max_depth == 4


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
    with pytest.raises(ArgumentError, match="unknown channel 'colour'"):
        octex.paint(None, surface, good, channel="colour")
    with pytest.raises(ArgumentError, match='alpha is painted with blend="erase"'):
        octex.paint(None, surface, good, channel="alpha")
    with pytest.raises(ArgumentError, match=r"out of the texture's root cell .* belongs to another model"):
        octex.paint(texture, ball(radius=3.0), good)


# --- regions


def test_regions_are_filled_to_their_borders():
    surface = plain(square(), (0.25, 0.25, 0.25))
    texture = octex.convert(surface, 6, dtype="float32")
    points = on_square(3000)
    x, y = points[:, 0], points[:, 1]
    left = surface.vertices[surface.triangles][:, :, 0].max(axis=1) < 1e-9
    cases = [
        (octex.Sphere((0, 0, 0), 0.3), np.hypot(x, y) - 0.3),
        (
            octex.Box((-0.2, -0.1, -1), (0.3, 0.4, 1)),
            np.maximum(np.abs(x - 0.05) - 0.25, np.abs(y - 0.15) - 0.25),
        ),
        (lambda p: (p[:, 0] > p[:, 1]).astype(float), (y - x) / np.sqrt(2)),
        (left, x),
        (np.flatnonzero(left), x),
    ]
    cell = texture.placement.size / 64
    for region, distance in cases:
        found = octex.fill(texture, surface, region, (1, 0, 0))
        found.validate()
        sampled = found.sample(points)
        inner, outer = distance < -2 * cell, distance > 2.5 * cell
        np.testing.assert_allclose(sampled[inner], np.tile([1.0, 0, 0], (inner.sum(), 1)), atol=1e-4)
        np.testing.assert_allclose(sampled[outer], np.full((outer.sum(), 3), 0.25), atol=1e-4)


def test_soft_regions_and_opacity_fade():
    surface = plain(square(), (0.0, 0.0, 0.0))
    texture = octex.convert(surface, 7, dtype="float32")
    found = octex.fill(texture, surface, octex.Sphere((0, 0, 0), 0.4, soft=0.4), (1, 1, 1), opacity=0.5)
    points = on_square(500, 0.25)
    away = np.hypot(points[:, 0], points[:, 1])
    far = away > 0.05
    np.testing.assert_allclose(
        found.sample(points)[far, 0], 0.5 * np.clip((0.4 - away[far]) / 0.4, 0, 1), atol=0.01
    )


def test_filling_starts_from_nothing_too():
    surface = plain(square())
    found = octex.fill(None, surface, octex.Sphere((0, 0, 0), 0.2), 0.5, channel="roughness", max_depth=6)
    found.validate()
    assert set(found.channels) == {"roughness"}
    points = on_square(300)
    inside = np.hypot(points[:, 0], points[:, 1]) < 0.18
    assert found.contains(points[inside]).all()
    assert not found.contains(points[np.hypot(points[:, 0], points[:, 1]) > 0.26]).any()


@pytest.mark.parametrize(
    ("region", "message"),
    [
        ("all", "region must be a Sphere, a Box, a function, or triangles"),
        ([99], "region must be a Sphere"),
        (octex.Sphere((0, 0, 0), -1), "radius must be finite and above zero"),
        (octex.Box((1, 0, 0), (0, 1, 1)), "low must not exceed high"),
        (lambda _: np.zeros(3), r"region must return an array of shape \("),
        (lambda p: np.full(len(p), 2.0), r"region returned 2 at \(.*\); values must be from 0 to 1"),
        (lambda p: np.full(len(p), np.nan), r"region returned nan at \(.*\); values must be from 0 to 1"),
        (lambda _: "x", "region must return an array of shape"),
        (lambda _: {}["cover"], "region raised KeyError: 'cover' for"),
    ],
)
def test_regions_that_make_no_sense_are_refused(region, message):
    surface = plain(square())
    with pytest.raises(ArgumentError, match=message):
        octex.fill(octex.convert(surface, 3), surface, region, (1, 0, 0))


def test_colours_that_do_not_fit_are_refused():
    surface = plain(square())
    for color in ((1, 0), (np.nan, 0, 0), 1.0):
        with pytest.raises(ArgumentError, match=r"color of .base_color. must be finite numbers of shape"):
            octex.fill(None, surface, octex.Sphere((0, 0, 0), 1), color)


@pytest.mark.parametrize("channel", ["base_color", "roughness", "normal"])
def test_colours_beyond_the_channels_range_are_refused(channel):
    surface = plain(square())
    sphere = octex.Sphere((0, 0, 0), 1)
    color = 255 if channel == "roughness" else (255, 0, 0)
    least = -1 if channel == "normal" else 0
    message = rf"color of '{channel}' must be from {least} to 1, not .*255.*; divide numbers up to 255 by 255"
    with pytest.raises(ArgumentError, match=message):
        octex.fill(None, surface, sphere, color, channel=channel)
    with pytest.raises(ArgumentError, match=message):
        octex.fill(octex.convert(surface, 3), surface, sphere, (-255, 0, 0)) if channel == "base_color" else (
            octex.fill(None, surface, sphere, -np.asarray(color), channel=channel)
        )
    bright = octex.fill(octex.cast(octex.convert(surface, 3), "float32"), surface, sphere, (5, 9, 2))
    assert bright.sample([[0.5, 0.5, 0.0]]).max() > 4.0


def test_colours_are_given_as_on_a_screen():
    surface = plain(square())
    sphere = octex.Sphere((0, 0, 0), 9)
    found = octex.fill(None, surface, sphere, "#ff8000", max_depth=3)
    values = found.channels["base_color"].values
    assert (values == (255, 128, 0)).all()
    for bad, channel, message in (
        ("#ff80", "base_color", "'#ff80' is not a colour '#rrggbb'"),
        ("red", "base_color", "'red' is not a colour '#rrggbb'"),
        ("#ff8000", "roughness", "'roughness' holds no colours"),
        ("#ff8000", "normal", "'normal' holds no colours"),
    ):
        with pytest.raises(ArgumentError, match=message):
            octex.fill(None, surface, sphere, bad, channel=channel)
    camera = octex.Camera.fitted(surface.vertices, (0, 0, 1), size=(8, 8))
    with pytest.raises(ArgumentError, match="key must be a colour '#rrggbb'"):
        octex.Projection(np.zeros((8, 8, 3), np.uint8), camera, key="green")
    assert octex.Projection(np.zeros((8, 8, 3), np.uint8), camera, key="#00ff00").key == (0, 255, 0)
    made = surface.with_sources({"base_color": "#ff8000"})
    assert (octex.convert(made, 3).channels["base_color"].values == (255, 128, 0)).all()
    with pytest.raises(ArgumentError, match="'#ff8' is not a colour '#rrggbb'"):
        surface.with_sources({"base_color": "#ff8"})


def places_of(texture, cells):
    """The middles of cells at rest (n, 3)."""
    levels = np.searchsorted(texture.tree.arrays.level_cells, cells, side="right") - 1
    found = np.empty((len(cells), 3))
    for level in np.unique(levels):
        own = levels == level
        codes = texture.tree.level_codes(int(level))[cells[own] - texture.tree.arrays.level_cells[level]]
        found[own] = texture.placement.to_rest((decode_cells(codes) + 0.5) / 2 ** int(level))
    return found


@pytest.mark.parametrize(("opacity", "blend"), [(1.0, "over"), (0.5, "over"), (0.5, "replace"), (1.0, "add")])
def test_what_opaque_paint_covers_keeps_nothing_and_has_no_skirts(opacity, blend):
    surface = ball(24)
    texture = octex.convert(surface, 6)
    edge = texture.placement.size / 2**6
    sphere = octex.Sphere((1.0, 0.0, 0.0), 0.8)
    found = octex.fill(texture, surface, sphere, (0.2, 0.5, 0.7), max_depth=7, opacity=opacity, blend=blend)
    leaves = found.tree.leaf_cells()
    skirts = places_of(found, leaves[found.tree.arrays.areas[leaves] == 1])
    kept = places_of(found, found.tree.kept.cells.astype(np.int64))
    hides = (opacity == 1.0 and blend == "over") or blend == "replace"
    for off in (skirts, kept):
        inside = 0.8 - np.linalg.norm(off - [1.0, 0.0, 0.0], axis=1)
        assert len(off)
        assert (inside.max() < 6 * edge) == hides
    points = surface.scatter(2000, 1)
    away = np.linalg.norm(points.rest - [1.0, 0.0, 0.0], axis=1)
    if hides:
        np.testing.assert_allclose(found.sample(points)[away < 0.8 - 2 * edge][:, 1], 0.5, atol=4e-3)
    beside = away > 0.8 + 3 * edge
    before, after = (each.sample(points.rest[beside]) for each in (texture, found))
    np.testing.assert_allclose(after, before, atol=1e-6)


def test_pictures_get_cells_of_half_a_pixel_to_one_unless_they_may_be_finer():
    surface = plain(square(0.0, 1.0))
    image = spot(above(size=64), (1, 0, 0), 20.0)
    for pixels_per_unit in (20.0, 30.0, 40.0, 55.0):
        pose = np.eye(4)
        pose[2, 3] = 2.0
        camera = octex.Camera.orthographic(
            (64, 64), pose=pose, convention="opengl", pixels_per_unit=pixels_per_unit
        )
        layer = octex.project(surface, octex.Projection(image, camera))
        deepest = octex.project(surface, octex.Projection(image, camera), max_depth=12)
        cell = layer.placement.size / 2**layer.tree.max_depth * pixels_per_unit
        assert 0.5 < cell < 1.1
        finest = deepest.placement.size / 2**deepest.tree.max_depth * pixels_per_unit
        assert 0.25 < finest < 0.55
        assert finest < cell
        assert octex.project(surface, octex.Projection(image, camera), max_depth=3).tree.max_depth == 3


def test_paint_of_one_color_is_that_color_in_all_leaves():
    surface, camera = ball(), above(4.0, 64)
    image = np.full((64, 64, 4), (200, 40, 90, 0), np.uint8)
    y, x = np.mgrid[:64, :64] - 31.5
    image[..., 3] = np.clip(25 * (24 - np.hypot(x, y)), 0, 255)
    layer = octex.project(surface, octex.Projection(image, camera))
    leaves = layer.tree.leaf_cells()
    assert (layer.channels["base_color"].values[leaves] == (200, 40, 90)).all()
    assert np.unique(layer.channels["alpha"].values[leaves]).size > 100


def test_one_level_serves_where_pixels_vary_little():
    # Cells as wide as these would be of levels 6.6, 7.5, 5.3 and 8.6.
    widths = np.repeat([1 / 100, 1 / 180, 1 / 40, 1 / 400], [60, 20, 17, 3])
    areas = np.ones(100)
    found = wanted_depths(widths, areas, 1.0, 1.0)
    assert found == (7, 9, False)
    some = np.array([1 / 100, 1 / 180, 1 / 40, 1 / 400, 1 / 12, np.inf])
    assert np.ceil(found.levels(some, 1.0, 1.0)).tolist() == [7, 7, 7, 9, 4, 0]
    assert wanted_depths(widths[:-3], areas[:-3], 1.0, 1.0) == (7, 7, True)
    alone = wanted_depths(widths, areas, 1.0, 1.0, is_single=True)
    assert alone == (9, 9, False)
    assert np.ceil(alone.levels(some, 1.0, 1.0)).tolist() == [7, 9, 6, 9, 4, 0]
    assert wanted_depths(widths, areas, 1.0, 1.0, 6) == (6, 6, True)
    assert wanted_depths(widths[:0], areas[:0], 1.0, 1.0) == (0, 0, True)
    surface, camera = ball(), above(4.0, 100)
    layer = octex.project(surface, octex.Projection(one_color(camera, (1, 0, 0)), camera))
    assert [level for level, (leaves, _) in enumerate(layer.tree.cells_by_depth()) if leaves] == [7]


@pytest.mark.parametrize("size", [(512, 384), (391, 450)])
@pytest.mark.parametrize("place", [(0.5, 0.5), (0.02, 0.9)])
@pytest.mark.parametrize(("max_depth", "feather"), [(7, 0.0), (3, 0.0), (6, 20.0), (6, 100.0)])
def test_transparent_parts_far_from_paint_are_not_looked_at(size, place, max_depth, feather, monkeypatch):
    """Nor do they change the paint, but for how pixels fit into those of smaller pictures."""
    surface = ball(12)
    texture = octex.convert(surface, 4)
    camera = octex.Camera.fitted(surface.vertices, (0.3, 0.5, 1.0), size=size)
    y, x = np.mgrid[: size[1], : size[0]]
    image = np.full((size[1], size[0], 4), (200, 40, 90, 0), np.uint8)
    image[..., 3] = np.clip(25 * (30 - np.hypot(x - place[0] * size[0], y - place[1] * size[1])), 0, 255)
    shot = octex.Projection(image, camera)
    found = octex.paint(texture, surface, shot, max_depth=max_depth, edge_feather=feather)
    monkeypatch.setattr("octex.painting.paint.AROUND", 1 << 20)
    expected = octex.paint(texture, surface, shot, max_depth=max_depth, edge_feather=feather)
    seen = surface.scatter(20_000)
    np.testing.assert_allclose(found.sample(seen), expected.sample(seen), atol=0.02)
    if size[0] % 64 == 0:
        np.testing.assert_array_equal(found.tree.arrays.flags, expected.tree.arrays.flags)
        one, other = (each.channels["base_color"].values.astype(int) for each in (found, expected))
        assert np.abs(one - other).max() <= 1


def test_a_mask_is_its_alpha_wherever_the_paint_is():
    """A mask that has alpha is not read by its light, though near the paint all of it is opaque."""
    surface = plain(square())
    camera = above(size=512)
    image = spot(camera, (200, 40, 90), 12.0)
    mask = np.zeros((512, 512, 4), np.uint8)
    mask[100:412, 100:412, 3] = 255
    texture = octex.convert(surface, 5)
    found = octex.paint(texture, surface, octex.Projection(image, camera, mask=mask))
    expected = octex.paint(texture, surface, octex.Projection(image, camera))
    np.testing.assert_array_equal(found.sample(surface.scatter(500)), expected.sample(surface.scatter(500)))
