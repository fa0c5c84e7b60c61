"""Lenses of every model: there, as they are written out, and back."""

import numpy as np
import pytest

from octex.cameras.camera import Camera
from octex.errors import ArgumentError
from octex.view.visibility import straight
from tests.oracles.naive_lens import through

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
