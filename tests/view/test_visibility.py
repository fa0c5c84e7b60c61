"""What a camera sees of points between its pixels' centres, beside rays against every triangle."""

import numpy as np
import pytest

from octex.cameras.camera import Camera
from octex.channels import BASE_COLOR
from octex.painting.image import Projection
from octex.painting.project import sight_of, spread, take_shots
from octex.painting.surface import PaintedSurface, terms_of
from octex.parallel import pool_of
from octex.source.corners import Corners
from octex.source.surface import Surface
from octex.source.tangents import corner_frames
from octex.view.visibility import distances_to_edges, straight, view_of, visibility_of
from tests.make.painted import above, ball, image_of, one_color, plain, square, together
from tests.make.small_surfaces import OCTAHEDRON, OCTAHEDRON_FACES
from tests.make.solids import cube
from tests.oracles import naive_view


def seen(surface, camera, triangles, barycentric, **terms):
    """Coverage of points under a white image."""
    white = Projection(one_color(camera, (1, 1, 1)), camera)
    hidden = terms.get("hidden", False)
    with pool_of(1) as pool:
        feather = terms.get("feather", 0.0)
        painted = PaintedSurface(surface)
        sights = painted.sights([camera], feather, pool, hidden=hidden)
        shots = take_shots([white], BASE_COLOR, [1.0], sights, pool)
        limits = terms_of(terms.get("max_angle", 90.0), feather, terms.get("back_faces", False), hidden)
        source = painted.projected(list(shots), BASE_COLOR, limits)
    return source.evaluate(triangles.astype(np.int32), barycentric, np.zeros(len(triangles), np.float32))[
        :, 3
    ]


def unhidden(surface, eye, points, own):
    """Whether no triangle lies between a camera and points: all are tried."""
    found, _, parts = naive_view.trace(
        np.tile(eye, (len(points), 1)), points - eye, surface.vertices, surface.triangles
    )
    return (found == own) | (parts > 1 - 1e-6)


@pytest.mark.parametrize("seed", [0, 1])
def test_points_are_seen_as_rays_see_them_but_beside_edges(seed):
    random = np.random.default_rng(seed)
    surface = blobs_of(random)
    camera = Camera.fitted(surface.vertices, random.normal(size=3), size=(96, 80))
    samples = surface.scatter(3000, seed)
    found = seen(surface, camera, samples.triangles, samples.barycentric)
    eye = camera.position
    faces = np.einsum("nx,nx->n", samples.normals, eye - samples.points) > 0
    expected = faces & unhidden(surface, eye, samples.points, samples.triangles)
    assert (found[~faces] == 0).all()
    wrong = (found > 0.5) != expected
    pixels, _ = camera.project(samples.points)
    margins = distances_to_edges(
        visibility_of(surface.vertices, surface.triangles, camera), view_of(camera), 9.0
    )
    near_edge = margins[pixels[:, 1].astype(int), pixels[:, 0].astype(int)] < 2.5
    assert not wrong[~near_edge].any()
    assert wrong.mean() < 0.03
    assert expected.mean() > 0.15


def blobs_of(random):
    blobs = []
    for middle in ((-0.6, -0.6, 0.6), (0.6, 0.5, -0.6), (-0.5, 0.6, -0.6), (0.1, 0.0, 0.55)):
        one = ball(8, 0.5)
        blobs.append((one.vertices * random.uniform(0.4, 1, 3) + middle, one.triangles))
    return plain(together(*blobs))


def test_hidden_points_are_painted_if_asked_for_wherever_they_face_the_camera():
    seed, random = 0, np.random.default_rng(0)
    surface = blobs_of(random)
    camera = Camera.fitted(0.6 * surface.vertices, random.normal(size=3), size=(96, 80))
    samples = surface.scatter(3000, seed)
    found = seen(surface, camera, samples.triangles, samples.barycentric, hidden=True)
    eye = camera.position
    faces = np.einsum("nx,nx->n", samples.normals, eye - samples.points) > 0
    pixels, depths = camera.project(samples.points)
    inside = ((pixels >= 0) & (pixels < (96, 80))).all(axis=1) & (depths > 0)
    assert 0.01 < (faces & ~unhidden(surface, eye, samples.points, samples.triangles)).mean() < 0.5
    assert 0.2 < inside.mean() < 0.95
    assert (found == (faces & inside)).all()


@pytest.mark.parametrize("gap", [1.0, 0.1, 0.01])
def test_the_nearer_of_two_close_sheets_hides_the_other(gap):
    camera = above(size=64)
    pixel = 3.0 / 128
    surface = plain(together(square(), square(-gap * pixel * 2)))
    middles = np.full((len(surface.triangles), 3), 1 / 3)
    found = seen(surface, camera, np.arange(len(surface.triangles)), middles)
    front = len(surface.triangles) // 2
    assert (found[:front] == 1).all()
    inner = np.abs(surface.vertices[surface.triangles[front:]].mean(axis=1)[:, :2]).max(axis=1) < 0.4
    assert (found[front:][inner] == 0).all()


def test_a_crease_is_seen_right_into_its_corner():
    floor, wall = square(), square()
    wall = wall[0][:, [0, 2, 1]] * [1, 1, 1] + [0, 0.0, 0.5], wall[1][:, ::-1]
    surface = plain(together(floor, wall))
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1, 0, 0], [0, np.cos(0.7), np.sin(0.7)], [0, -np.sin(0.7), np.cos(0.7)]]).T
    pose[:3, 3] = pose[:3, 2] * 4
    camera = Camera.pinhole((128, 128), pose=pose, convention="opengl", focal=300.0)
    samples = surface.scatter(4000, 3)
    eye = camera.position
    faces = np.einsum("nx,nx->n", samples.normals, eye - samples.points) > 0.2
    expected = faces & unhidden(surface, eye, samples.points, samples.triangles)
    beside = expected & (np.abs(samples.points[:, 1]) < 0.01) & (samples.points[:, 2] < 0.4)
    pixels, _ = camera.project(samples.points)
    beside &= ((pixels > 2) & (pixels < 126)).all(axis=1) & (np.abs(samples.points[:, 0]) < 0.45)
    assert beside.sum() > 10
    assert (seen(surface, camera, samples.triangles, samples.barycentric)[beside] > 0.5).all()


def faded(cosines, max_angle):
    """How opaque paint is by the angle to the camera: it fades over the last ten degrees."""
    low, high = np.cos(np.radians([max_angle, max_angle - 10]))
    t = np.clip((cosines - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def cosines_to(camera, points, normals):
    toward = camera.position - points
    return np.einsum("nx,nx->n", normals, toward) / (
        np.linalg.norm(toward, axis=1) * np.linalg.norm(normals, axis=1)
    )


def on_edges(surface):
    """Three points on each edge between two triangles, on the one and on the other."""
    places = np.unique(surface.vertices.round(9), axis=0, return_inverse=True)[1].reshape(-1)
    sides = {}
    for number, corners in enumerate(places[surface.triangles].tolist()):
        for k in range(3):
            a, b = corners[k], corners[(k + 1) % 3]
            first, second = (k, (k + 1) % 3) if a < b else ((k + 1) % 3, k)
            sides.setdefault((min(a, b), max(a, b)), []).append((number, first, second))
    pairs = [pair for (a, b), pair in sides.items() if a != b and len(pair) == 2]
    found = []
    for side in (0, 1):
        number, first, second = np.array([pair[side] for pair in pairs]).T
        barycentric = np.zeros((3, len(pairs), 3))
        for row, part in enumerate((0.25, 0.5, 0.7)):
            barycentric[row, np.arange(len(pairs)), first] = 1 - part
            barycentric[row, np.arange(len(pairs)), second] = part
        found.append((np.tile(number, 3), barycentric.reshape(-1, 3)))
    return found[0], found[1]


@pytest.mark.parametrize("back_faces", [False, True])
def test_paint_on_a_coarse_ball_fades_as_on_a_round_one(back_faces):
    surface, camera = ball(9), above(4.0, 100)
    samples = surface.scatter(1500, 1)
    terms = {"max_angle": 60.0, "back_faces": back_faces}
    found = seen(surface, camera, samples.triangles, samples.barycentric, **terms)
    round_one = faded(cosines_to(camera, samples.points, samples.points), 60.0)
    round_one[samples.points[:, 2] < 0] = 0
    flat = faded(cosines_to(camera, samples.points, samples.normals), 60.0)
    assert np.abs(flat - round_one).max() > 0.9
    assert np.abs(found - round_one).max() < 0.15  # a normal between three corners' is off by a degree
    one, other = (seen(surface, camera, *places, **terms) for places in on_edges(surface))
    assert ((one > 0.1) & (one < 0.9)).sum() > 30
    assert np.abs(one - other).max() < 0.01


def test_paint_on_a_cube_keeps_its_creases():
    points, triangles = cube([-0.5, -0.5, -0.5])
    surface = plain((points, triangles))
    for direction in ((0.75, 0.6, 1), (0.2, 0.5, 1)):
        camera = Camera.fitted(surface.vertices, direction, size=(160, 160))
        samples = surface.scatter(2000)
        inner = samples.barycentric.min(axis=1) > 0.05
        found = seen(surface, camera, samples.triangles, samples.barycentric, max_angle=78.0)
        expected = faded(cosines_to(camera, samples.points, samples.normals), 78.0)
        assert ((expected > 0.05) & (expected < 0.95)).any()
        np.testing.assert_allclose(found[inner], expected[inner], atol=1e-4)


@pytest.mark.parametrize("posed", [False, True])
def test_normals_of_the_model_itself_come_first(posed):
    rest, triangles = OCTAHEDRON, OCTAHEDRON_FACES
    given = Corners(rest.astype(np.float32), triangles)
    frames = corner_frames(rest, triangles, given, None, None)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) if posed else np.eye(3)
    vertices = rest @ turn.T
    source = plain((rest, triangles)).source
    surface = Surface(vertices, triangles, source, rest=rest if posed else None, frames=frames)
    camera = above(4.0, 200)
    samples = surface.scatter(2000)
    found = seen(surface, camera, samples.triangles, samples.barycentric, max_angle=40.0)
    expected = faded(cosines_to(camera, samples.points, samples.points), 40.0)
    shown = samples.points[:, 2] > 0.2
    np.testing.assert_allclose(found[shown], expected[shown], atol=1e-4)
    assert ((expected > 0.1) & (expected < 0.9)).sum() > 20


def test_back_faces_are_painted_only_if_asked_for():
    points, triangles = square()
    surface = plain((points, triangles[:, ::-1]))
    middles = np.full((len(triangles), 3), 1 / 3)
    assert (seen(surface, above(), np.arange(len(triangles)), middles) == 0).all()
    assert (seen(surface, above(), np.arange(len(triangles)), middles, back_faces=True) == 1).all()


def test_feathers_fade_toward_the_rim_and_toward_edges_in_depth():
    surface = plain(together(square(side=4.0, steps=40), square(1.0, side=0.3)))
    camera = above(4.0, 100, 200.0)
    samples = surface.scatter(20_000, 2)
    behind = samples.points[:, 2] < 0.5
    found = seen(surface, camera, samples.triangles, samples.barycentric, feather=8.0)
    pixels, _ = camera.project(samples.points)
    rim = np.minimum(pixels, 100 - pixels).min(axis=1)
    half = 0.15 / 3 * 200  # of the square before
    away = np.abs(pixels - 50).max(axis=1) - half
    inside = behind & (rim > 0) & (away > 0)
    whole = inside & (rim > 8) & (away > 10)
    assert (found[whole] == 1).all()
    near = inside & ((rim < 7) | (away < 6))
    assert (found[near] < 1).all()


def test_distances_to_edges_are_those_of_the_nearest_background():
    surface, camera = ball(), above(4.0, 80, 120.0)
    found = visibility_of(surface.vertices, surface.triangles, camera)
    distances = distances_to_edges(found, view_of(camera), 50.0)
    row, column = np.nonzero(found.rows < 0)
    inside = np.argwhere(found.rows >= 0)
    for r, c in inside[:: len(inside) // 50]:
        expected = np.hypot(row - r, column - c).min()
        rim = min(r, c, 79 - r, 79 - c) + 0.5
        assert abs(distances[r, c] - min(expected, rim)) < 0.09 * expected + 0.6
    assert (distances[row, column] == 0).all()


def test_beside_an_edge_paint_is_that_of_the_surface_itself():
    camera = above(size=64)
    low, high = square(side=1.2), square(0.5, side=0.513)
    own, other = (0.3, 0.6, 0.4), (0.7, 0.2, 0.5)
    colors = np.repeat([own, other], [len(low[0]), len(high[0])], axis=0)
    surface = Surface.from_arrays(*together(low, high), colors=colors)
    image = image_of(surface, camera.scaled(4)).reshape(64, 4, 64, 4, 4).mean((1, 3))
    image[..., :3] /= np.maximum(image[..., 3:], 1e-9)
    image[..., 3] = image[..., 3] > 0
    image[0, :2] = [(0, 0, 0, 1), (1, 1, 1, 1)]  # what splines may reach
    samples = surface.scatter(4000, 0)
    pixels = camera.project(samples.points)[0].astype(int)
    with pool_of(1) as pool:
        sight = sight_of(surface.vertices, surface.triangles, camera, 0.0, pool)
        shots = list(take_shots([Projection(image, camera)], BASE_COLOR, [1.0], [sight], pool))
    source = PaintedSurface(surface).projected(shots, BASE_COLOR, terms_of(90.0, 0.0, False))
    found = source.evaluate(samples.triangles, samples.barycentric, np.zeros(4000, np.float32))
    margins = sight.margins[pixels[:, 1], pixels[:, 0]]
    error = np.abs(found[:, :3] - np.where(samples.points[:, 2:] > 0.25, other, own)).max(axis=1)
    is_seen = found[:, 3] > 0
    assert error[is_seen & (margins > 1.0)].max() < 0.025
    assert error[is_seen & (margins < 1.0)].mean() < 0.05


def test_a_lens_is_seen_through_a_pinhole_that_is_wide_enough():
    surface = ball()
    plain_camera = above(3.0, 120, 100.0)
    lens, world_to_camera = (-0.2, 0.02, 0.001, -0.002), plain_camera.world_to_camera
    camera = Camera(120, 120, plain_camera.K, world_to_camera, "pinhole", lens)
    wide = straight(camera)
    assert wide.width > 120
    samples = surface.scatter(2000, 4)
    there, _ = camera.project(samples.points)
    inside = ((there > 1) & (there < 119)).all(axis=1)
    again, _ = wide.project(samples.points[inside])
    assert ((again > 0) & (again < [wide.width, wide.height])).all()
    toward = camera.position - samples.points
    cosine = np.einsum("nx,nx->n", samples.normals, toward) / np.linalg.norm(toward, axis=1)
    found = seen(surface, camera, samples.triangles, samples.barycentric)
    assert (found[inside & (cosine > 0.3)] == 1).all()
    assert straight(plain_camera) is plain_camera


def test_pixels_near_paint_are_those_whose_square_holds_some():
    random = np.random.default_rng(0)
    for share in np.tile([0.02, 0.1, 0.5], 30):
        some = random.random(random.integers(1, 20, 2)) < share
        reach = int(random.integers(0, 8))
        wide = np.lib.stride_tricks.sliding_window_view(np.pad(some, reach), (2 * reach + 1,) * 2)
        assert np.array_equal(spread(some, reach), wide.any(axis=(2, 3)))
