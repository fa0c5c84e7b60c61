"""Cameras that are a little off find back to where their images agree."""

from dataclasses import replace
from functools import cache

import numpy as np
import PIL.Image
import pytest

import octex
from octex.channels import BASE_COLOR, encode
from octex.painting.image import mips_of
from octex.painting.surface import PaintedSurface
from octex.parallel import Run, workers
from octex.photos import refine
from octex.photos.refine import _better, _read, adjusted, pixel_at
from tests.conftest import fewer_points, needs_jit
from tests.make.command import OUT, run
from tests.make.fixtures import obj_lines
from tests.make.painted import above, ball, image_of
from tests.make.photographs import ring

pytestmark = needs_jit


def off(camera, number, points):
    return adjusted(camera, pixel_at(camera, points), np.random.default_rng(number).normal(0, 0.7, 7))


@cache
def textured(count, size):
    """A ball with waves of many lengths, and images all around."""
    plain, random = ball(rings=64), np.random.default_rng(5)
    colors = np.full(plain.vertices.shape, 0.5)
    for _ in range(24):
        along = random.normal(size=3)
        waves = random.uniform(4, 22) * (plain.vertices @ along) / np.linalg.norm(along)
        colors += 0.12 * np.sin(waves + random.uniform(0, 6))[:, None] * random.normal(size=3)
    surface = octex.Surface.from_arrays(plain.vertices, plain.triangles, colors=np.clip(colors, 0.05, 0.95))
    cameras = ring(count, size)[1]
    return surface, cameras, [image_of(surface, camera) for camera in cameras]


def test_points_are_compared_at_the_coarsest_level_too():
    surface, cameras, images = textured(5, 96)
    samples = surface.scatter(500)
    with workers(Run(threads=1)) as executor:
        mips = [mips_of(octex.Projection(*each), BASE_COLOR) for each in zip(images, cameras, strict=True)]
        rim = refine._RIM * 2 ** max(refine._LEVELS)
        source = PaintedSurface(surface).comparable(cameras, mips, rim, executor)
    counts = []
    for level in (0, max(refine._LEVELS)):
        rim = refine._RIM * 2**level
        weights = refine._weights_at(source, samples.triangles, samples.barycentric, rim)
        counts.append(np.count_nonzero(weights))
        for shot, own in zip(source.shots, weights > 0, strict=True):
            assert (refine._margins(shot, samples.points[own]) >= rim).all()
    assert 0.1 * counts[0] < counts[1] < counts[0]


def disturbed(camera, number, pixels):
    """A camera turned and moved by about so many pixels, its focal length by 0.5 %."""
    random, view, K = np.random.default_rng(number), camera.world_to_camera.copy(), camera.K.copy()
    turn, shift = (each / np.linalg.norm(each) for each in random.normal(size=(2, 3)))
    turn *= pixels / K[0, 0]
    x, y, z = 0.7 * turn
    nearly = np.array([[1, -z, y], [z, 1, -x], [-y, x, 1]])
    u, _, v = np.linalg.svd(nearly)
    view[:3] = (u @ v) @ view[:3]
    view[:3, 3] += 0.7 * shift * pixels / K[0, 0] * np.linalg.norm(camera.position)
    K[[0, 1], [0, 1]] *= 1 + 0.005 * random.choice([-1, 1])
    return replace(camera, world_to_camera=view, K=K)


def shift(camera, truth, points):
    """By how many pixels points land elsewhere, of those that a camera sees of the ball (not behind it).

    What is painted is where cameras see; how a camera would see the far side, no image can tell.
    """
    toward = truth.position - points
    cosines = (toward * points).sum(axis=1) / np.linalg.norm(toward, axis=1) / np.linalg.norm(points, axis=1)
    seen = points[cosines > np.cos(np.radians(75))]
    apart = camera.project(seen)[0] - truth.project(seen)[0]
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


@pytest.fixture(params=[False, True], ids=["all points", "few points"])
def is_few(request):
    if request.param:
        request.getfixturevalue("few_points")
    return bool(request.param)


def test_every_camera_gets_better_and_a_textured_ball_brings_them_back(is_few):
    pixels = 1.0 if is_few else 2.0
    surface, cameras, images = textured(6, 128)
    points = surface.scatter(1000).points
    moved = [disturbed(camera, n, pixels) if n else camera for n, camera in enumerate(cameras)]
    light = np.random.default_rng(9).uniform(0.8, 1.2, 6)
    light[0] = 1
    shots = [
        octex.Projection(image * np.array([gain, gain, gain, 1], np.float32), camera)
        for image, camera, gain in zip(images, moved, light, strict=True)
    ]
    found = octex.refine_cameras(surface, shots, reference=0)
    before = np.array([shift(*each, points) for each in zip(moved, cameras, strict=True)])
    after = np.array([shift(*each, points) for each in zip(found, cameras, strict=True)])
    assert np.array_equal(found[0].world_to_camera, cameras[0].world_to_camera)
    assert np.median(before[1:]) > 0.6 * pixels
    assert (after[1:] < before[1:]).all()
    assert np.median(after[1:]) < 0.25


class _Told:
    """What three images show of 1000 points, and how much that tells of where the cameras are."""

    weights = np.ones((3, 1000))

    def __init__(self, values, tells):
        self._values, self._tells = values, tells

    def seen(self, _numbers):
        slopes = np.repeat(np.broadcast_to(self._tells, (3, 1000)), 3, axis=1)[..., None]
        return np.repeat(self._values, 3, axis=1), np.repeat(slopes, 7, axis=2)


def test_where_a_camera_is_the_edges_in_its_image_tell_not_the_plain_rest():
    tells, is_edge = np.full(1000, 0.001), np.arange(1000) < 50
    tells[is_edge] = 1.0
    before, after = np.zeros((2, 3, 1000))
    before[2, is_edge], after[2] = 0.3, np.where(is_edge, 0.02, 0.04)  # the rest in a little other light
    given, found = _Told(before, tells), _Told(after, tells)
    numbers = np.zeros((3, 7))
    assert _better(given, found, numbers).tolist() == [False, False, True]
    assert not _better(found, given, numbers).any()
    assert not _better(found, found, numbers).any()


@pytest.mark.usefixtures("few_points")
def test_the_order_of_images_does_not_matter():
    _, cameras, images = textured(4, 48)
    surface, order = ball(), [3, 1, 0, 2]
    moved = [disturbed(camera, n, 1.0) for n, camera in enumerate(cameras)]
    shots = [octex.Projection(*each) for each in zip(images, moved, strict=True)]
    found = octex.refine_cameras(surface, shots, reference=0)
    again = octex.refine_cameras(surface, [shots[n] for n in order], reference=2)
    assert not all(a is b for a, b in zip(found, moved, strict=True))
    for n, camera in zip(order, again, strict=True):
        assert np.array_equal(camera.world_to_camera, found[n].world_to_camera)
        assert np.array_equal(camera.K, found[n].K)


@pytest.mark.parametrize("part", [3, 10])
def test_smooth_colours_make_no_camera_worse(part, monkeypatch):
    fewer_points(monkeypatch, part)
    surface, cameras, images = ring(6, 128)
    points, random = surface.scatter(1000).points, np.random.default_rng(9)
    moved = [disturbed(camera, n, 1.5) if n else camera for n, camera in enumerate(cameras)]
    if part == 3:  # gains, vignetting and noise
        y, x = (np.mgrid[:128, :128] + 0.5 - 64) / np.hypot(64, 64)
        for n, image in enumerate(images[1:], 1):
            lost = 1 - random.uniform(0, 0.4) * (x**2 + y**2)[..., None]
            seen = image[..., :3] * random.uniform(0.7, 1.3) * lost
            seen += random.normal(0, 0.01, seen.shape) * image[..., 3:]
            images[n] = np.concatenate([np.maximum(seen, 0), image[..., 3:]], axis=2).astype(np.float32)
    shots = [octex.Projection(*each) for each in zip(images, moved, strict=True)]
    for given, truth, found in zip(
        moved, cameras, octex.refine_cameras(surface, shots, reference=0), strict=True
    ):
        assert shift(found, truth, points) <= shift(given, truth, points)


def test_one_image_has_nothing_to_agree_with():
    surface, cameras, images = ring(1, 16)
    assert octex.refine_cameras(surface, octex.Projection(images[0], cameras[0])) == cameras


@pytest.mark.parametrize("is_parallel", [False, True])
def test_a_number_of_a_camera_is_about_a_pixel(is_parallel):
    camera = above(3.0, 64)
    if is_parallel:
        camera = octex.Camera(64, 64, np.diag([50.0, 50, 1]), camera.world_to_camera, "orthographic")
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 3))
    for number in range(7):
        there = adjusted(camera, pixel_at(camera, points), np.eye(7)[number])
        if number not in (2, 5):  # about the axis of the view and along it, where less changes
            assert 0.2 < shift(there, camera, points) < 3
    assert np.array_equal(adjusted(camera, pixel_at(camera, points), np.zeros(7)).K, camera.K)


def test_images_are_read_with_their_slopes():
    random = np.random.default_rng(4)
    image = random.uniform(0.1, 1, (6, 9, 4)).astype(np.float32)
    image[..., 3] = 1
    image[2, 3, 3] = 0  # no paint
    pixels = image.reshape(-1, 4) * image.reshape(-1, 4)[:, 3:]
    places = random.uniform([-1, -1], [10, 7], (400, 2))
    found = np.empty((400, 9))
    falloff = np.array([0.4, -0.1])
    _read(np.concatenate([pixels[:5], pixels]), np.array([5, 9, 6]), falloff, places, found)
    light = np.where(image[..., 3:] > 0, np.sqrt(image[..., :3]).astype(np.float64), np.nan)
    ringed = np.pad(light, ((1, 1), (1, 1), (0, 0)), mode="edge")
    across = (ringed[1:-1, 2:] - ringed[1:-1, :-2]) / 2
    down = (ringed[2:, 1:-1] - ringed[:-2, 1:-1]) / 2
    each = np.concatenate([light, across, down], axis=2)
    expected = np.full((400, 9), np.nan)
    squares = ((places - [4.5, 3.0]) ** 2).sum(axis=1, keepdims=True) / (4.5**2 + 3.0**2)
    for n, (x, y) in enumerate(places - 0.5):
        if 0 <= x <= 8 and 0 <= y <= 5:
            left, top = min(int(x), 7), min(int(y), 4)
            u, v = x - left, y - top
            upper = each[top, left] * (1 - u) + each[top, left + 1] * u
            lower = each[top + 1, left] * (1 - u) + each[top + 1, left + 1] * u
            expected[n] = upper * (1 - v) + lower * v
    assert np.isfinite(expected).all(axis=1).sum() > 100
    expected *= np.exp(0.5 * squares * (0.4 - 0.1 * squares))
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.usefixtures("few_points")
def test_refined_cameras_are_kept_in_a_file(tmp_path):
    surface, cameras, images = ring(4, 64)
    (tmp_path / "ball.obj").write_text(obj_lines(surface.vertices, surface.triangles))
    points = surface.scatter(300).points
    names = [f"{n}.png" for n in range(4)]
    for name, image in zip(names, images, strict=True):
        PIL.Image.fromarray(encode(image, "uint8", "srgb")).save(tmp_path / name)
    moved = {
        name: off(camera, n, points) for n, (name, camera) in enumerate(zip(names, cameras, strict=True))
    }
    octex.write_cameras(tmp_path / "cameras.json", moved)
    words = ["--camera", tmp_path / "cameras.json", OUT, tmp_path / "out.octex", "--max-depth", 4, "--quiet"]
    words += ["--refine-cameras", tmp_path / "refined.json"]
    files = [tmp_path / "ball.obj", *(tmp_path / name for name in names)]
    assert run(*files, *words) == 0
    frames = octex.read_cameras(tmp_path / "refined.json")
    assert [frame.name for frame in frames] == names
    assert not all(
        np.array_equal(frame.camera().world_to_camera, moved[frame.name].world_to_camera) for frame in frames
    )
