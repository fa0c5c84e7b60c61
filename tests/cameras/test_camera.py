"""Cameras and lenses: what they project, the rays through pixels, and fits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex.cameras.camera import Camera
from octex.errors import ArgumentError
from octex.view.visibility import straight
from tests.make.small_surfaces import turned
from tests.make.small_textures import unit
from tests.oracles.naive_lens import through

LENS = (-0.3, 0.1, 1e-3, -2e-3)


def _pose(seed):
    pose = np.eye(4)
    pose[:3, :3] = turned(seed)
    pose[:3, 3] = np.random.default_rng(seed).normal(size=3)
    return pose


def _pinhole(**changes):
    return Camera.pinhole(
        **{"size": (640, 480), "pose": np.eye(4), "convention": "opencv", "focal": 500.0} | changes
    )


@pytest.mark.parametrize(("convention", "sign"), [("opencv", 1.0), ("opengl", -1.0)])
def test_a_camera_looks_down_z_with_y_down_or_down_negative_z_with_y_up(convention, sign):
    camera = _pinhole(convention=convention)
    pixels, depth = camera.project([[0.0, 0.0, 2 * sign], [0.2, 0.0, 2 * sign], [0.0, 0.2, 2 * sign]])
    assert np.allclose(pixels, [[320, 240], [370, 240], [320, 240 + sign * 50]])
    assert np.allclose(depth, 2.0)


def test_an_opengl_pose_is_camera_to_world_an_opencv_pose_world_to_camera_perhaps_without_a_last_row():
    pose = _pose(1)
    assert np.allclose(_pinhole(pose=pose, convention="opengl").position, pose[:3, 3])
    assert np.allclose(_pinhole(pose=np.linalg.inv(pose), convention="opencv").position, pose[:3, 3])
    assert np.array_equal(_pinhole(pose=_pose(2)[:3]).matrix, _pinhole(pose=_pose(2)).matrix)


def test_intrinsics_with_skew_and_an_off_centre_principal_point_are_honoured():
    camera = _pinhole(focal=None, K=[[500, 10, 300], [0, 400, 250], [0, 0, 1]])
    pixels, _ = camera.project([[0.2, 0.4, 2.0]])
    assert np.allclose(pixels, [[300 + 50 + 2, 250 + 80]])
    assert np.allclose(
        _pinhole(focal=(500.0, 400.0), center=(300.0, 250.0)).K, [[500, 0, 300], [0, 400, 250], [0, 0, 1]]
    )


def test_points_behind_a_pinhole_camera_have_no_pixel():
    pixels, depth = _pinhole().project([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    assert np.isnan(pixels).all()
    assert np.allclose(depth, [-1.0, 0.0])


def test_an_orthographic_camera_does_not_foreshorten():
    camera = Camera.orthographic((100, 100), pose=np.eye(4), convention="opencv", pixels_per_unit=10.0)
    pixels, depth = camera.project([[1.0, 2.0, 1.0], [1.0, 2.0, 50.0]])
    assert np.allclose(pixels, [60, 70])
    assert np.allclose(depth, [1.0, 50.0])
    assert np.allclose(camera.pixel_width([1.0, 50.0]), 0.1)


@pytest.mark.parametrize("projection", ["pinhole", "orthographic"])
@given(seed=st.integers(0, 1000))
def test_rays_are_the_inverse_of_project(projection, seed):
    if projection == "pinhole":
        camera = _pinhole(pose=_pose(seed), convention="opengl")
    else:
        camera = Camera.orthographic((64, 48), pose=_pose(seed), convention="opengl", pixels_per_unit=7.0)
    pixels = np.random.default_rng(seed).uniform(-10, 700, (5, 2))
    origins, directions = camera.rays(pixels)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1.0)
    seen, depth = camera.project(origins + 3.0 * directions)
    assert np.allclose(seen, pixels)
    assert np.allclose(depth, 3.0 * directions @ camera.world_to_camera[2, :3])


def test_a_pixel_is_as_wide_as_the_step_between_neighbouring_rays():
    camera = _pinhole(pose=_pose(3))
    origins, directions = camera.rays([[320.0, 240.0], [321.0, 240.0]])
    points = origins + 2.0 * directions / (directions @ camera.world_to_camera[2, :3])[:, None]
    assert np.isclose(np.linalg.norm(points[1] - points[0]), camera.pixel_width(2.0))


def test_a_scaled_camera_sees_the_same_with_more_pixels():
    camera = _pinhole(pose=_pose(4), convention="opengl", distortion=LENS)
    points = camera.rays([[100.0, 50.0], [300.5, 420.25]])[1] * 2.0 + camera.position
    assert camera.scaled(3).width == 1920
    assert camera.scaled(3).height == 1440
    assert np.allclose(camera.scaled(3).project(points)[0], 3 * camera.project(points)[0])


@given(
    seed=st.integers(0, 1000),
    size=st.sampled_from([(200, 100), (100, 200), (64, 64)]),
    flat=st.sampled_from([(1, 1, 1), (1, 1, 0), (0, 1, 1), (5, 0, 0.1)]),
)
def test_a_fitted_camera_touches_its_margins_and_holds_all_points(seed, size, flat):
    random = np.random.default_rng(seed)
    points = random.normal(size=(50, 3)) * flat + random.normal(size=3) * 10
    camera = Camera.fitted(points, random.normal(size=3), size=size, fov=40.0, margin=0.05)
    pixels, depth = camera.project(points)
    assert (depth > 0.0).all()
    free = np.array([pixels.min(axis=0), size - pixels.max(axis=0)]) / size
    assert free.min() > 0.05 - 1e-6
    tight = np.abs(free - 0.05) < 1e-6  # both sides of one axis
    # A row of points that is seen from its end fits from nearer than the camera may stand.
    stands_nearest = np.isclose(depth.min(), 1e-3 * np.ptp(points, axis=0).max(), rtol=1e-6)
    assert tight.all(axis=0).any() or stands_nearest


def test_a_fitted_camera_keeps_up_up_and_looks_along_the_direction():
    camera = Camera.fitted([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [0.0, 0.5, 1.0], size=(100, 100))
    pixels, _ = camera.project([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    assert pixels[1, 1] < pixels[0, 1]
    assert np.isclose(pixels[1, 0], pixels[0, 0])
    assert pixels[2, 0] > pixels[0, 0]
    assert np.allclose(camera.world_to_camera[2, :3], -np.array([0.0, 0.5, 1.0]) / np.sqrt(1.25))


def test_a_fitted_camera_may_look_straight_along_up_and_stands_in_front_of_a_single_point():
    camera = Camera.fitted([[0.0, 0.0, 0.0], [1.0, 0.0, 1.0]], [0.0, 1.0, 0.0], size=(100, 100))
    pixels, _ = camera.project([[0.0, 0.0, 0.0], [1.0, 0.0, 1.0]])
    assert (pixels[0] < pixels[1]).all()  # +x to the right, +z down
    pixels, depth = Camera.fitted([[1.0, 2.0, 3.0]], [1.0, 0.0, 0.0], size=(10, 10)).project(
        [[1.0, 2.0, 3.0]]
    )
    assert depth[0] > 0.0
    assert np.allclose(pixels, 5.0)


def test_a_nearly_exact_rotation_becomes_exact():
    rotation = _pinhole(pose=np.round(_pose(5), 6)).world_to_camera[:3, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"size": (0, 10)}, "size must be"),
        ({"size": (10.5, 10)}, "size must be"),
        ({"focal": None}, "either K, or focal"),
        ({"K": np.eye(3)}, "either K, or focal"),
        ({"focal": None, "K": np.eye(3), "center": (1.0, 1.0)}, "either K, or focal"),
        ({"focal": -1.0}, "focal must be finite and above zero"),
        ({"focal": None, "K": np.eye(4)}, "K must be finite numbers of shape"),
        ({"focal": None, "K": np.diag([1.0, -1.0, 1.0])}, "focal lengths must be above zero"),
        ({"focal": None, "K": np.ones((3, 3))}, "K must be upper triangular"),
        ({"distortion": (0.1,)}, "distortion must be finite numbers of shape"),
        ({"distortion": (0.1, np.nan)}, "distortion must be finite numbers of shape"),
        ({"convention": "blender"}, "unknown camera convention 'blender'; there are: opengl, opencv"),
        ({"pose": np.eye(3)}, "pose must be finite numbers of shape"),
        ({"pose": np.full((4, 4), np.nan)}, "pose must be finite numbers of shape"),
        ({"pose": np.eye(4) + np.eye(4)[:, [3, 0, 1, 2]] * [5, 0, 0, 0]}, "last row 0 0 0 1"),
        ({"pose": np.diag([2.0, 2.0, 2.0, 1.0])}, "must not scale or shear"),
        ({"pose": np.diag([1.0, 1.0, 0.0, 1.0])}, "must not scale or shear"),
        ({"pose": np.diag([-1.0, 1.0, 1.0, 1.0])}, "must not mirror"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(changes, complaint):
    with pytest.raises(ArgumentError, match=complaint):
        _pinhole(**changes)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"points": np.zeros((0, 3))}, "at least one"),
        ({"points": [[np.inf, 0.0, 0.0]]}, "must be finite"),
        ({"direction": (0.0, 0.0, 0.0)}, "direction must be three finite numbers"),
        ({"up": (1.0, 0.0)}, "up must be finite numbers of shape"),
        ({"fov": 180.0}, "fov must be at least"),
        ({"margin": 0.5}, "margin must be"),
    ],
)
def test_a_fit_that_cannot_be_is_refused(changes, complaint):
    arguments = {"points": [[0.0, 0.0, 0.0]], "direction": (0.0, 0.0, 1.0), "size": (10, 10)} | changes
    with pytest.raises(ArgumentError, match=complaint):
        Camera.fitted(arguments.pop("points"), arguments.pop("direction"), **arguments)


def test_pixels_and_points_of_another_shape_are_refused():
    with pytest.raises(ArgumentError, match="pixels must be numbers of shape"):
        _pinhole().rays([1.0, 2.0])
    with pytest.raises(ArgumentError, match="points must be numbers of shape"):
        _pinhole().distort([1.0, 2.0])


def test_points_beyond_where_a_lens_would_fold_have_no_pixel_and_pixels_beyond_no_ray():
    camera = _pinhole(distortion=(-1 / 3, 0.0))  # r − r³/3 rises up to r = 1, where it is 2/3
    seen, depth = camera.project([[0.999, 0.0, 1.0], [1.001, 0.0, 1.0], [0.0, -40.0, 1.0], [0.0, 0.0, -1.0]])
    assert np.allclose(seen[0], [320 + 500 * 2 / 3, 240], atol=1e-2)
    assert np.isnan(seen[1:]).all()
    assert np.allclose(depth, [1.0, 1.0, 1.0, -1.0])
    camera = _pinhole(distortion=(-1 / 3, 0.0))
    _, directions = camera.rays([[320 + 500 * 0.66, 240], [320 + 500 * 0.67, 240], [320, 240 + 500 * 1e6]])
    assert np.isfinite(directions[0]).all()
    assert np.isnan(directions[1:]).all()
    assert camera.rays(np.zeros((0, 2)))[1].shape == (0, 3)


def test_a_camera_without_its_lens_has_the_matrix_of_the_one_with_it():
    camera = _pinhole(pose=_pose(8), distortion=LENS)
    assert camera.undistorted.distortion == (0.0, 0.0, 0.0, 0.0)
    assert np.array_equal(camera.undistorted.matrix, camera.matrix)
    points = camera.position + camera.undistorted.rays([[100.0, 50.0]])[1]
    assert np.allclose(camera.undistorted.project(points)[0], [[100.0, 50.0]])
    assert not np.allclose(camera.project(points)[0], [[100.0, 50.0]], atol=1.0)


def test_two_numbers_of_distortion_are_the_radial_ones():
    assert _pinhole(distortion=[0.1, 0.2]).distortion == (0.1, 0.2, 0.0, 0.0)
    assert _pinhole(distortion=np.array([0.1, 0.2, 0.3, 0.4])).distortion == (0.1, 0.2, 0.3, 0.4)
    assert _pinhole().distortion == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("projection", ["pinhole", "orthographic"])
def test_differentials_are_how_hits_on_a_plane_move_from_pixel_to_pixel(projection):
    pose = _pose(2)
    if projection == "pinhole":
        camera = Camera.pinhole((200, 100), pose=pose, convention="opengl", focal=(150.0, 170.0))
    else:
        camera = Camera.orthographic((200, 100), pose=pose, convention="opengl", pixels_per_unit=40.0)
    normal = pose[:3, :3] @ unit(np.array([0.3, -0.4, 0.8]))
    foot = pose[:3, 3] - 4.0 * pose[:3, 2]

    def hits(pixels):
        origins, rays = camera.rays(pixels)
        return origins + ((foot - origins) @ normal / (rays @ normal))[:, None] * rays

    pixels = np.random.default_rng(3).uniform([40, 20], [160, 80], (50, 2))
    found = camera.differentials(hits(pixels), np.tile(normal, (50, 1)))
    for step, along in zip(([1e-4, 0], [0, 1e-4]), found, strict=True):
        expected = (hits(pixels + step) - hits(pixels - np.array(step))) / 2e-4
        np.testing.assert_allclose(along, expected, rtol=1e-5, atol=1e-7)


def test_differentials_on_planes_seen_edge_on_are_finite():
    camera = Camera.orthographic((8, 8), pose=np.eye(4), convention="opengl", pixels_per_unit=4.0)
    right, down = camera.differentials([[0.0, 0.0, -1.0]] * 2, [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert np.isfinite(right).all()
    assert np.isfinite(down).all()


LENSES = [
    ("OPENCV", "opencv", [-0.3, 0.1, 1e-3, -2e-3]),
    ("OPENCV", "opencv", [0.1, 0.05, 0.01, 0.02]),
    ("FULL_OPENCV", "opencv", [-0.2, 0.05, 1e-3, -2e-3, 0.02, 0.1, 0.03, -0.01]),
    ("FULL_OPENCV", "opencv", [0.4, 0.1, 0.0, 0.0, 0.01, 0.5, 0.2, 0.02]),
    ("OPENCV_FISHEYE", "fisheye", [0.1, -0.05, 0.02, -0.01]),
    ("OPENCV_FISHEYE", "fisheye", [0.0, 0.0, 0.0, 0.0]),
    ("THIN_PRISM_FISHEYE", "fisheye", [0.1, -0.03, 1e-3, -2e-3, 0.02, -0.01, 3e-3, -2e-3]),
    ("FOV", "fov", [0.9]),
]


def camera_of(model, lens, focal=400.0):
    K = [[focal, 3.0, 320.0], [0.0, focal + 10.0, 240.0], [0.0, 0.0, 1.0]]
    options = {"pose": np.eye(4), "convention": "opencv", "K": K}
    return Camera.pinhole((640, 480), **options, distortion=lens, distortion_model=model)


@pytest.mark.parametrize(("name", "model", "lens"), LENSES)
def test_points_land_where_the_formulas_of_their_model_say(name, model, lens):
    camera = camera_of(model, lens)
    points = np.random.default_rng(0).uniform([-0.8, -0.6, 1], [0.8, 0.6, 1], (200, 3))
    pixels, _ = camera.project(points * 2.5)
    places = (through(name, lens, x, y) for x, y, _ in points)
    written = [(400 * right + 3 * down + 320, 410 * down + 240) for right, down in places]
    np.testing.assert_allclose(pixels, written, rtol=0, atol=1e-9)
    np.testing.assert_allclose(camera.project([[0.0, 0.0, 2.0]])[0], [[320, 240]])


@pytest.mark.parametrize(("_name", "model", "lens"), LENSES)
def test_rays_lead_back_to_their_pixels(_name, model, lens):
    camera = camera_of(model, lens)
    pixels = np.random.default_rng(1).uniform([0, 0], [640, 480], (500, 2))
    origins, directions = camera.rays(pixels)
    seen, _ = camera.project(origins + 3 * directions)
    assert np.abs(seen - pixels).max() < 1e-9


def test_a_fisheye_lens_reaches_to_where_its_angles_stop_rising():
    camera = camera_of("fisheye", [-0.3, 0.0, 0.0, 0.0])  # θ − 0.3 θ³ rises to θ = 1/√0.9
    turn = np.tan(1 / np.sqrt(0.9))
    near, far = camera.distort([[0.999 * turn, 0.0], [1.001 * turn, 0.0]])
    assert np.isfinite(near).all()
    assert np.isnan(far).all()


def test_a_lens_reaches_to_its_first_turn_or_pole():
    radii = np.linspace(1e-3, 4, 40_000)
    points = np.column_stack([radii, np.zeros_like(radii)])
    radial = ((-0.3, 0.0), (0.0, -0.2), (0.1, -0.2), (-1.0, 0.4), (0.3, 0.1), (-0.3, 0.1))
    rational = [0.0, 0, 0, 0, 0, -0.25, 0, 0], [-0.1, 0, 0, 0, 0.01, 0.2, -0.02, 0]
    for lens in (*rational, *((*each, *[0.0] * 6) for each in radial)):
        found = camera_of("opencv", lens).distort(points)[:, 0]
        k1, k2, _, _, k3, k4, k5, _ = lens
        s = radii**2
        written = radii * (1 + k1 * s + k2 * s**2 + k3 * s**3) / (1 + k4 * s + k5 * s**2)
        falls = np.flatnonzero(np.diff(written) <= 0)
        first = falls[0] if falls.size else radii.size - 1
        assert abs(np.isfinite(found).sum() - 1 - first) <= 2


def test_a_fisheye_without_numbers_still_bends():
    camera = camera_of("fisheye", [0.0] * 4)
    assert camera.is_distorted
    assert not camera.undistorted.is_distorted
    wide = straight(camera_of("fisheye", [0.0] * 4, focal=250.0))
    assert wide.width > 640


@pytest.mark.parametrize(("model", "lens"), [("fisheye", [0.1, 0.2]), ("fov", [0.1, 0.2]), ("opencv", [0.1])])
def test_distortions_of_another_count_are_refused(model, lens):
    with pytest.raises(ArgumentError, match="distortion must"):
        camera_of(model, lens)


@pytest.mark.parametrize("angle", [np.pi, -4.0])
def test_a_lens_whose_angle_is_a_half_circle_or_more_is_refused(angle):
    camera_of("fov", [3.1])
    with pytest.raises(ArgumentError, match="distortion of fov must be an angle of less than π, not "):
        camera_of("fov", [angle])


def test_models_that_are_none_are_refused():
    with pytest.raises(ArgumentError, match="unknown distortion_model 'equirectangular'; there are: opencv"):
        camera_of("equirectangular", [0.0] * 4)
    with pytest.raises(ArgumentError, match="an orthographic camera must have no distortion"):
        Camera(4, 4, np.eye(3), np.eye(4), "orthographic", (0.1, 0.0, 0.0, 0.0))
