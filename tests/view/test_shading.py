"""Shading normals of corners, and soft light."""

import numpy as np
import pytest

from octex.cameras.camera import Camera
from octex.drawing.soft_light import background, light
from octex.view.shading import corner_normals, corner_normals_of, face_normals
from tests.make.solids import sphere

# A cube of 12 triangles, counter-clockwise seen from outside; its faces share vertices.
CUBE = np.array([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])
QUADS = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
TRIANGLES = np.array([[q[0], q[k], q[k + 1]] for q in QUADS for k in (1, 2)], np.int32)


def test_face_normals_point_outward_and_are_zero_without_area():
    normals, areas = face_normals(CUBE, np.vstack([TRIANGLES, [[0, 0, 1]]]))
    assert np.allclose(areas, [0.5] * 12 + [0.0])
    centers = CUBE[TRIANGLES].mean(axis=1) - 0.5
    assert np.allclose(np.linalg.norm(normals[:-1], axis=1), 1.0)
    assert np.allclose(np.einsum("nc,nc->n", normals[:-1], centers), 0.5)
    assert (normals[-1] == 0.0).all()


def test_a_cube_is_sharp_but_round_by_a_large_crease_angle_whichever_way_its_faces_are_cut():
    flat = np.vstack([TRIANGLES, [[0, 0, 1]]]).astype(np.int32)  # the last has no area, and no normals
    assert np.allclose(corner_normals(CUBE, flat), face_normals(CUBE, flat)[0][:, None])
    # Three faces meet in each corner with 90° each, in three to six triangles.
    normals = corner_normals(CUBE, TRIANGLES, crease=100.0)
    assert np.allclose(normals, (CUBE[TRIANGLES] - 0.5) / np.sqrt(0.75), atol=1e-6)


def test_a_sphere_is_smooth_also_across_doubled_vertices():
    points, triangles = sphere([0.0, 0.0, 0.0], 1.0, 32)
    shared = corner_normals(points, triangles)
    own = corner_normals(
        points[triangles].reshape(-1, 3), np.arange(triangles.size, dtype=np.int32).reshape(-1, 3)
    )
    assert np.allclose(shared, own, atol=1e-6)
    assert np.einsum("nkc,nkc->nk", shared, points[triangles]).min() > 0.995


def test_some_triangles_have_the_normals_that_they_have_among_all():
    points, triangles = sphere([0.0, 0.0, 0.0], 1.0, 32)
    both = np.vstack([points, points]), np.vstack([triangles[::2], triangles[1::2] + len(points)])
    whole = corner_normals(*both)
    for chosen in ([], [7], [200, 3, 250, 3], np.arange(len(triangles))):
        some = corner_normals_of(np.array(chosen, np.int32), *both)
        assert np.array_equal(some, whole[np.array(chosen, int)])


def test_a_triangle_wound_the_other_way_keeps_its_own_normal():
    flipped = TRIANGLES.copy()
    flipped[0] = flipped[0, ::-1]
    normals = corner_normals(CUBE, flipped)
    assert np.allclose(normals[0], -corner_normals(CUBE, TRIANGLES)[0])
    assert np.allclose(normals[1], corner_normals(CUBE, TRIANGLES)[1])


def test_where_very_many_triangles_meet_they_stay_flat():
    n = 300
    angle = np.linspace(0, 2 * np.pi, n + 1)[:-1]
    cone = np.vstack([[0.0, 0.0, 1.0], np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])])
    fan = np.column_stack([np.zeros(n, int), 1 + np.arange(n), 1 + (np.arange(n) + 1) % n]).astype(np.int32)
    normals = corner_normals(cone, fan)
    assert np.allclose(normals[:, 0], face_normals(cone, fan)[0])
    assert not np.allclose(normals[:, 1], face_normals(cone, fan)[0], atol=1e-3)


CAMERAS = {
    "pinhole": Camera.pinhole((8, 8), pose=np.eye(4), convention="opencv", focal=8.0),
    "orthographic": Camera.orthographic((8, 8), pose=np.eye(4), convention="opencv", pixels_per_unit=8.0),
}


def _lit(normals, camera=CAMERAS["orthographic"], faces=None):
    normals = np.asarray(normals, np.float64)
    return light(
        camera, np.tile([0.0, 0.0, 2.0], (len(normals), 1)), normals if faces is None else faces, normals
    )


def test_light_is_never_dark_and_hardly_above_one():
    lit = _lit(np.random.default_rng(0).normal(size=(2000, 3)))
    assert lit.dtype == np.float32
    assert 0.35 < lit.min() < 0.4
    assert 1.0 < lit.max() < 1.04


@pytest.mark.parametrize(
    ("brighter", "darker"), [((0, -1, 0), (0, 1, 0)), ((-1, 0, 0), (1, 0, 0)), ((0, 0, -1), (1, 0, 0))]
)
def test_light_comes_from_above_from_the_left_and_from_the_camera(brighter, darker):
    lit = _lit([brighter, darker])
    assert lit[0] > lit[1]


def test_light_turns_with_the_camera():
    pose = np.eye(4)
    pose[:3, :3] = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    turned = Camera.orthographic((8, 8), pose=pose, convention="opencv", pixels_per_unit=8.0)
    normals = np.random.default_rng(0).normal(size=(20, 3))
    assert np.allclose(_lit(normals @ pose[:3, :3], turned), _lit(normals))


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_both_sides_are_lit_alike(camera):
    normals = np.random.default_rng(0).normal(size=(20, 3))
    assert np.array_equal(_lit(normals, camera), _lit(-normals, camera))


def test_the_side_seen_is_that_from_where_the_camera_is():
    # A wall on the right that faces left, and a little away from the front.
    point, wall = np.array([[3.0, 0.0, 2.0]]), np.array([[-1.0, 0.0, 0.1]])
    from_middle, from_front = (
        light(CAMERAS[name], point, wall, wall)[0] for name in ("pinhole", "orthographic")
    )
    assert from_middle > from_front + 0.05


def test_a_normal_without_length_gets_light_of_its_own():
    assert 0.3 < _lit(np.zeros((1, 3)))[0] < 1.0


def test_the_background_is_grey_and_the_same_across():
    image = background(20, 30)
    assert image.shape == (20, 30, 3)
    assert (image == image[:, :1, :1]).all()
    assert 0.2 < image.min() < image.max() < 0.5
