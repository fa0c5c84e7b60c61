import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex import jit
from octex.cameras.camera import Camera
from octex.parallel import pool_of
from octex.view.zbuffer import z_buffer
from tests.conftest import few, needs_jit
from tests.make.painted import halved_quads
from tests.oracles import naive_view


def _screen_camera(width, height):
    """An orthographic camera whose world is the image: x and y in pixels, z the depth."""
    return Camera.orthographic(
        (width, height), pose=np.eye(4), convention="opencv", pixels_per_unit=1.0, center=(0.0, 0.0)
    )


def _pinhole(width, height, focal):
    return Camera.pinhole((width, height), pose=np.eye(4), convention="opencv", focal=focal)


def _assert_like_rays(positions, triangles, camera):
    """Compare with the tracer; pixels that a thousandth of a pixel's shift would change may differ."""
    buffers = z_buffer(positions, triangles, camera)
    number, barycentric, depth = naive_view.render(positions, triangles, camera)
    different = np.argwhere(buffers.triangle != number)[:, ::-1] + 0.5
    shifted = [
        naive_view.trace(*camera.rays(different + shift), positions, triangles)[0]
        for shift in 1e-3 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    ]
    assert (np.ptp(shifted, axis=0) > 0).all()
    same = (buffers.triangle == number) & (number >= 0)
    assert np.allclose(buffers.depth[same], depth[same], atol=2e-3)
    # Compared where the points are: a barycentric coordinate of a sliver moves far within a pixel.
    corners = positions[triangles[number[same]]]
    seen, expected = (np.einsum("nk,nkc->nc", b[same], corners) for b in (buffers.barycentric, barycentric))
    assert np.linalg.norm(seen - expected, axis=1).max(initial=0.0) < 2e-3
    assert np.allclose(buffers.barycentric[same].sum(axis=1), 1.0)
    empty = buffers.triangle < 0
    assert (buffers.depth[empty] == np.inf).all()
    assert (buffers.barycentric[empty] == 0.0).all()


FIVE_TRIANGLES = np.arange(15).reshape(5, 3)
SIZE = (9, 7) if jit.DISABLED else (17, 13)


@pytest.mark.parametrize(("middle", "spread", "focal"), [(3, 1.0, 12.0), (0, 2.0, 6.0)])
@few
@given(seed=st.integers(0, 2**32 - 1))
def test_a_pinhole_image_is_what_rays_find_also_of_triangles_through_its_plane(seed, middle, spread, focal):
    random = np.random.default_rng(seed)
    positions = random.normal(size=(15, 3)) * spread + [0, 0, middle]
    _assert_like_rays(positions, FIVE_TRIANGLES, _pinhole(*SIZE, focal))


@few
@given(seed=st.integers(0, 2**32 - 1))
def test_an_orthographic_image_is_what_rays_find(seed):
    random = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(random.normal(size=(3, 3)))[0]
    pose[:3, :3] *= np.sign(np.linalg.det(pose[:3, :3]))
    camera = Camera.orthographic(SIZE, pose=pose, convention="opengl", pixels_per_unit=5.0)
    _assert_like_rays(random.normal(size=(15, 3)), FIVE_TRIANGLES, camera)


@given(seed=st.integers(0, 2**32 - 1), step=st.sampled_from([1.0, 0.5, 0.125, 2.0**-14]))
def test_every_pixel_of_a_mesh_is_covered_exactly_once_folds_counted_with_their_sign(seed, step):
    # The border stays a rectangle, inner vertices go anywhere, often onto pixel centres and each other.
    columns, rows, size = 3, 3, 6
    random = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(0, size, columns + 1), np.linspace(0, size, rows + 1))
    screen = np.column_stack([x.ravel(), y.ravel()])
    inner = (screen > 0).all(axis=1) & (screen < size).all(axis=1)
    screen[inner] = np.round(random.uniform(-1, size + 1, (inner.sum(), 2)) / step) * step
    triangles = halved_quads(rows + 1, columns + 1)
    positions = np.column_stack([screen, np.ones(len(screen))])
    a, b, c = np.moveaxis(screen[triangles], 1, 0)
    sides = np.sign((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    camera = _screen_camera(size + 2, size + 2)
    covered = sum(
        side * (z_buffer(positions, triangle[None], camera).triangle == 0)
        for side, triangle in zip(sides, triangles, strict=True)
    )
    expected = np.zeros((size + 2, size + 2))
    expected[:size, :size] = 1
    assert np.array_equal(covered, expected)
    if step == 0.5:
        assert np.array_equal(covered, naive_view.signed_coverage(screen, triangles, expected.shape))


@pytest.mark.parametrize("offset", [(0.0, 0.0), (1e6, -3e5)])
def test_a_floor_under_the_camera_has_no_holes_and_no_pixel_twice(offset):
    # Triangles behind, beside, under and before the camera, some passing through its plane; then the same
    # floor with the vertices of each triangle its own.
    n = 5
    x, z = np.meshgrid(np.linspace(-8.3, 9.1, n + 1), np.linspace(-6.7, 11.9, n + 1))
    floor = np.column_stack([x.ravel() + offset[0], np.full(x.size, 1.0), z.ravel() + offset[1]])
    pose = np.eye(4)
    pose[:3, 3] = -offset[0], 0.0, -offset[1]
    triangles = halved_quads(n + 1, n + 1)
    camera = Camera.pinhole(SIZE, pose=pose, convention="opencv", focal=SIZE[1] / 2)
    layers = [z_buffer(floor, triangle[None], camera).triangle == 0 for triangle in triangles]
    # The floor ends where its depth is 11.9.
    rows = np.arange(SIZE[1]) + 0.5 - SIZE[1] / 2
    reached = (rows > 0) & (camera.K[1, 1] / np.maximum(rows, 1e-9) < 11.9)
    assert np.array_equal(np.sum(layers, axis=0), np.repeat(reached[:, None], SIZE[0], axis=1))
    own = z_buffer(floor[triangles].reshape(-1, 3), np.arange(triangles.size).reshape(-1, 3), camera)
    shared = z_buffer(floor, triangles, camera)
    assert all(np.array_equal(a, b) for a, b in zip(own, shared, strict=True))


def test_the_first_of_triangles_at_one_depth_is_seen():
    positions = np.array([[0.0, 0.0, 1.0], [9.0, 1.0, 2.0], [2.0, 8.0, 1.7]])
    camera = _screen_camera(8, 8)
    orders = [[0, 1, 2], [2, 1, 0], [1, 2, 0], [0, 2, 1]]
    for first in range(4):
        buffers = z_buffer(positions, orders[first:] + orders[:first], camera)
        assert set(np.unique(buffers.triangle)) == {-1, 0}


@pytest.mark.parametrize(
    "positions",
    [
        [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]],  # a point
        [[0.0, 0.0, 1.0], [4.0, 4.0, 1.0], [8.0, 8.0, 1.0]],  # a line
        [[0.5, 0.5, 1.0], [0.5, 0.5, 2.0], [6.5, 6.5, 3.0]],  # seen along its plane
        [[9.0, 0.0, 1.0], [20.0, 0.0, 1.0], [9.0, 8.0, 1.0]],  # beside the image
        [[0.0, 1e300, 1.0], [8.0, 1e300, 1.0], [0.0, 2e300, 1.0]],  # far away
        [[0.6, 0.6, 1.0], [0.7, 0.6, 1.0], [0.6, 0.7, 1.0]],  # between centres
    ],
)
def test_triangles_that_cover_no_centre_are_harmless(positions):
    assert (z_buffer(np.array(positions), [[0, 1, 2]], _screen_camera(8, 8)).triangle == -1).all()


def test_a_huge_triangle_covers_the_image():
    positions = np.array([[-1e7, -1e7, 5.0], [1e7, -1e7, 5.0], [0.0, 2e7, 5.0]])
    for camera in (_screen_camera(8, 8), _pinhole(8, 8, 4.0)):
        buffers = z_buffer(positions, [[0, 1, 2]], camera)
        assert (buffers.triangle == 0).all()
        assert np.allclose(buffers.depth, 5.0)


def test_a_mesh_without_triangles_gives_an_empty_image():
    for positions in (np.zeros((0, 3)), np.ones((3, 3))):
        buffers = z_buffer(positions, np.zeros((0, 3), np.int32), _screen_camera(4, 3))
        assert buffers.triangle.shape == (3, 4)
        assert (buffers.triangle == -1).all()


@needs_jit
def test_a_closed_surface_of_many_small_triangles_shows_only_its_front():
    n = 300
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, n + 1), np.linspace(0, np.pi, n + 1))
    sphere = np.column_stack(
        [(np.cos(u) * np.sin(v)).ravel(), np.cos(v).ravel(), (np.sin(u) * np.sin(v)).ravel()]
    )
    camera = Camera.fitted(sphere, [1.0, 2.0, 3.0], size=(200, 200))
    triangles = halved_quads(n + 1, n + 1)
    buffers = z_buffer(sphere, triangles, camera)
    origins, directions = camera.rays(naive_view.pixel_centers(camera))
    toward = -np.einsum("nc,nc->n", origins, directions)
    miss = np.linalg.norm(origins + toward[:, None] * directions, axis=1).reshape(200, 200)
    assert (buffers.triangle[miss < 0.999] >= 0).all()
    assert (buffers.triangle[miss > 1.0] < 0).all()
    distance = toward.reshape(200, 200) - np.sqrt(np.maximum(1.0 - miss**2, 0.0))
    depth = distance * (directions @ camera.world_to_camera[2, :3]).reshape(200, 200)
    assert np.abs(buffers.depth - depth)[miss < 0.95].max() < 1e-3
    with pool_of(3) as pool:
        spread = z_buffer(sphere, triangles, camera, pool)
    for of_bands, whole in zip(spread, buffers, strict=True):
        assert np.array_equal(of_bands, whole)


@given(seed=st.integers(0, 2**32 - 1))
def test_layers_are_all_that_lies_behind_each_other_by_depth(seed):
    random = np.random.default_rng(seed)
    camera = _screen_camera(9, 8)
    positions = random.uniform([-3, -3, 1], [12, 12, 4], (24, 3))
    triangles = np.arange(24, dtype=np.int32).reshape(8, 3)
    triangles = np.vstack([triangles, triangles[:2, ::-1]])  # two lie at the same depth as others
    layer, seen = None, []
    for _ in range(len(triangles) + 1):
        layer = z_buffer(positions, triangles, camera, behind=layer)
        seen.append(layer.triangle.copy())
    assert (seen[-1] < 0).all()
    alone = [z_buffer(positions, one[None], camera) for one in triangles]
    depths = np.array([each.depth for each in alone])
    for row, column in np.ndindex(8, 9):
        there = np.flatnonzero(np.isfinite(depths[:, row, column]))
        order = sorted(there, key=lambda n: (round(depths[n, row, column], 9), n))
        assert [layer[row, column] for layer in seen if layer[row, column] >= 0] == order


def test_nothing_is_found_behind_what_is_taken_out():
    camera, triangles = _screen_camera(4, 4), np.array([[0, 1, 2], [3, 4, 5]])
    corners = np.array([[-9, -9], [30, -9], [-9, 30]])
    positions = np.vstack([np.column_stack([corners, [z] * 3]) for z in (1.0, 2.0)])
    first = z_buffer(positions, triangles, camera)
    first.triangle[:2] = -1
    with pool_of(2) as executor:
        for workers in (None, executor):
            second = z_buffer(positions, triangles, camera, workers, behind=first)
            assert (second.triangle[:2] == -1).all()
            assert (second.triangle[2:] == 1).all()
            assert (second.depth[2:] == 2.0).all()
