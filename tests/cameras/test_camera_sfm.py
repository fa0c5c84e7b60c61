"""Cameras of OpenSfM and OpenMVG, each written here by hand from known poses."""

import numpy as np
import pytest

from octex.cameras.files import read_cameras
from tests.make.camera_files import bent, quaternion, refusal, sees, view, write_json

BROWN = {"k1": -0.2, "k2": 0.05, "k3": 0.01, "p1": 2e-3, "p2": -1e-3}
ANGLES = {"k1": -0.02, "k2": 0.005, "k3": 1e-3, "k4": -2e-3}


def brown(**numbers):
    """Return where OpenCV's lens puts POINTS, seen from ``view(1)``, to the right and down."""
    return bent("FULL_OPENCV", [numbers.get(each, 0.0) for each in ("k1", "k2", "p1", "p2", "k3")])


def fisheye(**numbers):
    """Return where OpenCV's fisheye lens does."""
    return bent("OPENCV_FISHEYE", [numbers.get(each, 0.0) for each in ("k1", "k2", "k3", "k4")])


# OpenSfM


def opensfm(**camera):
    """Write a reconstruction with one shot, and another that is not connected to it."""
    w, *axis = quaternion(view(1)[:3, :3])
    angle = 2 * np.arctan2(np.linalg.norm(axis), w)
    rotation = (angle * np.array(axis) / np.linalg.norm(axis)).tolist()
    shot = {"rotation": rotation, "translation": view(1)[:3, 3].tolist(), "camera": "v2 kodak"}
    cameras = {"v2 kodak": {"width": 640, "height": 480} | camera}
    first = {"cameras": cameras, "shots": {"a.jpg": shot}, "points": {}}
    return [first, {"cameras": cameras, "shots": {"b.jpg": shot}}]


@pytest.mark.parametrize(
    ("camera", "center", "places"),
    [
        ({"focal": 0.8, "k1": -0.2, "k2": 0.05}, (0.0, 0.0), brown(k1=-0.2, k2=0.05)),
        ({"projection_type": "perspective", "focal": 0.8}, (0.0, 0.0), brown()),
        ({"projection_type": "simple_radial", "k1": -0.2}, (0.01, -0.02), brown(k1=-0.2)),
        ({"projection_type": "radial", "k1": -0.2, "k2": 0.05}, (0.01, -0.02), brown(k1=-0.2, k2=0.05)),
        ({"projection_type": "brown", **BROWN}, (0.01, -0.02), brown(**BROWN)),
        ({"projection_type": "fisheye", "focal": 0.8, "k1": -0.02}, (0.0, 0.0), fisheye(k1=-0.02)),
        ({"projection_type": "fisheye_opencv", **ANGLES}, (0.01, -0.02), fisheye(**ANGLES)),
    ],
)
def test_opensfm_cameras_see_what_its_manual_says(tmp_path, camera, center, places):
    focal = [0.8, 0.8]
    if "focal" not in camera:
        focal = [0.8, 0.79]
        camera = camera | {"focal_x": 0.8, "focal_y": 0.79, "c_x": center[0], "c_y": center[1]}
    path = write_json(tmp_path / "reconstruction.json", opensfm(**camera))
    (frame,) = read_cameras(path)
    assert (frame.name, frame.size, frame.image) == ("a.jpg", (640, 480), tmp_path / "images" / "a.jpg")
    sees(frame.camera(), 640 * (places * focal + center) + [320, 240])


def test_an_opensfm_camera_that_is_not_turned_is_read(tmp_path):
    document = opensfm(focal=0.8)
    document[0]["shots"]["a.jpg"]["rotation"] = [0.0, 0.0, 0.0]
    (frame,) = read_cameras(write_json(tmp_path / "reconstruction.json", document))
    assert np.array_equal(frame.world_to_camera[:3, :3], np.eye(3))


def test_undistorted_images_of_opensfm_have_an_ending_more(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.jpg.tif").touch()
    (frame,) = read_cameras(write_json(tmp_path / "reconstruction.json", opensfm(focal=0.8)))
    assert frame.image == tmp_path / "images" / "a.jpg.tif"


@pytest.mark.parametrize(
    ("camera", "complaint"),
    [
        ({"focal": 0.0}, "shot 'a.jpg': camera 'v2 kodak': focal must be above zero, not 0"),
        ({}, "shot 'a.jpg': camera 'v2 kodak': focal_x is missing; it must be a number"),
        ({"projection_type": "spherical"}, "projection_type 'spherical' is not known; octex knows persp"),
        ({"focal": 0.8, "width": 0}, "camera 'v2 kodak': width must be a whole number from 1 to 1000000"),
    ],
)
def test_opensfm_files_that_cannot_be_used_are_refused(tmp_path, camera, complaint):
    assert complaint in refusal(write_json(tmp_path / "reconstruction.json", opensfm(**camera)))


@pytest.mark.parametrize("document", [[], [1], [{"shots": []}], [{"shots": {"a": 1}, "cameras": {}}]])
def test_lists_that_are_no_reconstructions_are_refused(tmp_path, document):
    refusal(write_json(tmp_path / "reconstruction.json", document))


# OpenMVG


def openmvg(kind="pinhole", nested=False, **numbers):
    """Write a view that is placed and one that is not."""
    shared = {"width": 640, "height": 480, "focal_length": 500.0, "principal_point": [309.5, 249.5]}
    data = {"value0": shared, **numbers} if nested else {**shared, **numbers}
    rotation, center = view(1)[:3, :3], -view(1)[:3, :3].T @ view(1)[:3, 3]
    seen = {"local_path": "/day 1/", "filename": "a.jpg", "width": 640, "height": 480, "id_view": 0}
    views = [
        seen | {"id_intrinsic": 0, "id_pose": 7},
        seen | {"filename": "b.jpg", "id_intrinsic": 0, "id_pose": (1 << 32) - 1},
    ]
    named = {"polymorphic_id": (1 << 31) + 1, "polymorphic_name": kind}
    return {
        "sfm_data_version": "0.3",
        "root_path": "photos",
        "views": [
            {"key": key, "value": {"polymorphic_id": 1 << 30, "ptr_wrapper": {"id": key, "data": each}}}
            for key, each in enumerate(views)
        ],
        "intrinsics": [{"key": 0, "value": {**named, "ptr_wrapper": {"id": 3, "data": data}}}],
        "extrinsics": [{"key": 7, "value": {"rotation": rotation.tolist(), "center": center.tolist()}}],
    }


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize(
    ("kind", "numbers", "places"),
    [
        ("pinhole", {}, brown()),
        ("pinhole_radial_k1", {"disto_k1": [-0.2]}, brown(k1=-0.2)),
        ("pinhole_radial_k3", {"disto_k3": [-0.2, 0.05, 0.01]}, brown(k1=-0.2, k2=0.05, k3=0.01)),
        ("pinhole_brown_t2", {"disto_t2": [-0.2, 0.05, 0.01, 2e-3, -1e-3]}, brown(**BROWN)),
        ("fisheye", {"fisheye": [-0.02, 0.005, 1e-3, -2e-3]}, fisheye(**ANGLES)),
    ],
)
def test_openmvg_cameras_see_what_its_source_says(tmp_path, kind, numbers, places, nested):
    (frame,) = read_cameras(write_json(tmp_path / "sfm_data.json", openmvg(kind, nested, **numbers)))
    assert (frame.name, frame.size) == ("a.jpg", (640, 480))
    assert frame.image == tmp_path / "photos" / "day 1" / "a.jpg"
    sees(frame.camera(), 500 * places + [310, 250])  # pixels' centres are whole numbers there


@pytest.mark.parametrize(
    ("numbers", "complaint"),
    [
        ({"disto_k3": [0.1]}, "view 'a.jpg': intrinsics: disto_k3 must be 3 numbers, not 1"),
        ({"focal_length": -1}, "view 'a.jpg': intrinsics: focal_length must be above zero, not -1"),
        ({"principal_point": 1}, "view 'a.jpg': intrinsics: principal_point must be 2 numbers, not 1"),
    ],
)
def test_openmvg_files_that_cannot_be_used_are_refused(tmp_path, numbers, complaint):
    assert complaint in refusal(write_json(tmp_path / "sfm_data.json", openmvg(**numbers)))


def test_panoramas_of_openmvg_are_refused(tmp_path):
    document = openmvg("spherical")
    del document["intrinsics"][0]["value"]["ptr_wrapper"]["data"]["focal_length"]
    assert "focal_length is missing; undistort images" in refusal(write_json(tmp_path / "a.json", document))
