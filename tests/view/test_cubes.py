"""Images of cubes, against rays."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octex.cameras.camera import Camera
from octex.view.cubes import rasterize_cubes
from tests.make.small_surfaces import turned
from tests.oracles import naive_view
from tests.view.test_shading import CUBE, TRIANGLES

SIZE = (17, 13)


def _pose(random):
    pose = np.eye(4)
    pose[:3, :3] = turned(int(random.integers(1000)))
    pose[2, 3] = 6.0
    return pose


def _camera(projection, pose):
    if projection == "pinhole":
        return Camera.pinhole(SIZE, pose=pose, convention="opencv", focal=20.0)
    return Camera.orthographic(SIZE, pose=pose, convention="opencv", pixels_per_unit=4.0)


@pytest.mark.parametrize("projection", ["pinhole", "orthographic"])
@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_cubes_are_what_rays_find(projection, seed):
    random = np.random.default_rng(seed)
    camera = _camera(projection, _pose(random))
    corners, edges = random.uniform(-2.0, 1.0, (6, 3)), random.uniform(0.2, 1.5, 6)
    buffers = rasterize_cubes(corners, edges, camera)

    positions = (CUBE * edges[:, None, None] + corners[:, None]).reshape(-1, 3)
    triangles = (TRIANGLES + 8 * np.arange(6)[:, None, None]).reshape(-1, 3)
    number, barycentric, depth = naive_view.render(positions, triangles, camera)
    assert np.array_equal(buffers.cube, np.where(number >= 0, number // 12, -1))
    hit = number >= 0
    assert np.allclose(buffers.depth[hit], depth[hit])
    assert (buffers.depth[~hit] == np.inf).all()
    assert np.array_equal(buffers.axis[hit], np.array([2, 2, 1, 1, 0, 0])[number[hit] % 12 // 2])
    inside = np.einsum("nk,nkc->nc", barycentric[hit], CUBE[TRIANGLES[number[hit] % 12]])
    to_edges = np.sort(np.minimum(inside, 1.0 - inside), axis=1)[:, 1]  # the first is across the face
    assert np.allclose(buffers.border[hit], to_edges, atol=1e-6)


def test_cubes_side_by_side_leave_no_gap():
    n = 4
    corners = np.stack(np.meshgrid(*[np.arange(n) - n / 2] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    camera = Camera.fitted(np.vstack([corners, corners + 1.0]), [1.0, 2.0, 3.0], size=(60, 60))
    many = rasterize_cubes(corners, np.ones(len(corners)), camera)
    one = rasterize_cubes(np.full((1, 3), -n / 2), np.array([float(n)]), camera)
    assert np.array_equal(many.cube >= 0, one.cube >= 0)
    assert np.allclose(many.depth[many.cube >= 0], one.depth[one.cube >= 0])
    assert np.array_equal(many.axis, one.axis)


def test_a_ray_along_an_axis_hits_the_face_across_it():
    camera = Camera.orthographic((3, 3), pose=np.eye(4), convention="opencv", pixels_per_unit=1.0)
    buffers = rasterize_cubes(np.array([[-0.4, -0.4, 2.0]]), np.array([1.0]), camera)
    assert np.argwhere(buffers.cube == 0).tolist() == [[1, 1]]
    assert buffers.depth[1, 1] == 2.0
    assert buffers.axis[1, 1] == 2
    assert np.isclose(buffers.border[1, 1], 0.4)


@pytest.mark.parametrize(
    "corner", [[0.0, 0.0, -0.5], [0.0, 0.0, -3.0], [100.0, 0.0, 1.0], [1e200, 0.0, 1.0], [0.0, -1e200, 1.0]]
)
def test_cubes_at_behind_and_beside_the_camera_and_none_are_not_seen(corner):
    camera = Camera.pinhole(SIZE, pose=np.eye(4), convention="opencv", focal=10.0)
    for corners in (np.array([corner]), np.zeros((0, 3))):
        assert (rasterize_cubes(corners, np.ones(len(corners)), camera).cube == -1).all()


@given(seed=st.integers(0, 2**32 - 1))
def test_layers_of_cubes_are_all_that_lie_behind_each_other(seed):
    random = np.random.default_rng(seed)
    camera = _camera("pinhole", _pose(random))
    corners, edges = random.uniform(-2.0, 1.0, (6, 3)), random.uniform(0.2, 1.5, 6)
    layer, seen = None, []
    for _ in range(7):
        layer = rasterize_cubes(corners, edges, camera, layer)
        seen.append(layer.cube)
    assert (seen[-1] < 0).all()
    depths = np.array([rasterize_cubes(corners[n : n + 1], edges[n : n + 1], camera).depth for n in range(6)])
    order = np.where(np.isfinite(np.sort(depths, axis=0)), np.argsort(depths, axis=0), -1)
    assert np.array_equal(seen[:6], order)
