"""Cameras of OpenSfM, OpenMVG and COLMAP, each written here from known poses."""

import struct

import numpy as np
import pytest

from octex.cameras.files import read_cameras
from tests.make.camera_files import (
    CAMERAS,
    bent,
    colmap_binary,
    colmap_text,
    quaternion,
    refusal,
    sees,
    view,
    write_json,
)

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


def colmap_pixels(model, values, matrix):
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"):
        values = values[0], *values
    focal_x, focal_y, x, y, *lens = values
    return bent(model, lens, matrix) * [focal_x, focal_y] + [x, y]


@pytest.mark.parametrize("write", [colmap_text, colmap_binary])
def test_colmap_cameras_see_what_their_numbers_say(tmp_path, write):
    frames = read_cameras(write(tmp_path))
    assert [frame.name for frame in frames] == [f"dir/im {key}.jpg" for key, _, _ in CAMERAS]
    for frame, (key, model, values) in zip(frames, CAMERAS, strict=True):
        assert frame.size == (640, 480)
        assert frame.image is None
        sees(frame.camera(), colmap_pixels(model, values, view(key)))


def test_a_colmap_model_is_found_below_its_folder_and_by_each_of_its_files(tmp_path):
    colmap_binary(tmp_path / "a/sparse/0")
    colmap_text(tmp_path / "b/sparse")
    for path in ("a", "a/sparse", *(f"a/sparse/0/{name}.bin" for name in ("images", "cameras", "points3D"))):
        assert len(read_cameras(tmp_path / path)) == len(CAMERAS)
    for path in ("b", "b/sparse/cameras.txt"):
        assert len(read_cameras(tmp_path / path)) == len(CAMERAS)


@pytest.mark.parametrize("model", ["sparse/0", "sparse", "."])
def test_the_images_of_a_colmap_workspace_are_in_images(model, tmp_path):
    colmap_binary(tmp_path / model)
    assert {frame.image for frame in read_cameras(tmp_path / model)} == {None}
    (tmp_path / "images").mkdir()
    for frame in read_cameras(tmp_path / model):
        assert frame.image.resolve() == (tmp_path / "images" / frame.name).resolve()


def test_a_folder_without_a_model_is_refused(tmp_path):
    assert "has no COLMAP model; choose a folder with" in refusal(tmp_path)
    colmap_text(tmp_path)
    (tmp_path / "cameras.txt").unlink()
    assert "has no COLMAP model" in refusal(tmp_path)
    assert "cameras.txt: cannot be read: No such file" in refusal(tmp_path / "images.txt")


@pytest.mark.parametrize(
    ("file", "old", "new", "complaint"),
    [
        ("cameras.txt", "PINHOLE", "DIVISION", "line 2: model 'SIMPLE_DIVISION' is not known; undistort"),
        ("cameras.txt", "2 PINHOLE 640", "2 PINHOLE 0", "line 3: width must be a whole number from 1"),
        ("cameras.txt", "2 PINHOLE 640", "2 PINHOLE x", "line 3: width must be a number, not 'x'"),
        ("cameras.txt", "2 PINHOLE", "2", "line 3: model '640' is not known"),
        ("cameras.txt", "310.0 250.0\n", "310.0\n", "SIMPLE_PINHOLE must have 3 parameters, not 2"),
        ("cameras.txt", "500.0", "nan", "line 2: parameters must be a finite number, not nan"),
        ("cameras.txt", "500.0", "-1", "line 2: focal lengths must be above zero"),
        ("cameras.txt", "500.0", "f", "line 2: parameters must be a number, not 'f'"),
        ("images.txt", " dir/im 1.jpg", "", "line 3: must have the columns IMAGE_ID QW"),
        ("images.txt", " 3.0 1 dir", " 3.0 99 dir", "frame 'dir/im 1.jpg': camera 99 is not in cameras"),
        ("images.txt", " 3.0 1 dir", " 3.0 x dir", "CAMERA_ID must be a whole number, not 'x'"),
        ("images.txt", " 3.0 1 dir", " inf 1 dir", "must be a finite number, not inf"),
        ("images.txt", "\n\n", "\n", "each image must have two lines"),
    ],
)
def test_a_broken_text_model_is_refused_by_line(tmp_path, file, old, new, complaint):
    path = colmap_text(tmp_path) / file
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace("im ", "im") if new == "\n" else text, encoding="utf-8")
    path.write_text(path.read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8")
    message = refusal(tmp_path)
    assert message.startswith(f"{path}: ")
    assert complaint in message


def test_a_binary_model_that_lies_about_its_length_is_refused(tmp_path):
    colmap_binary(tmp_path)
    whole = (tmp_path / "images.bin").read_bytes()
    last = len(CAMERAS)
    for count in (last + 1, 2**64 - 1):
        (tmp_path / "images.bin").write_bytes(struct.pack("<Q", count) + whole[8:])
        assert f"images.bin: image {last + 1} of {count}: the file ends here" in refusal(tmp_path)
    (tmp_path / "images.bin").write_bytes(whole[:-8] + struct.pack("<Q", 2**63))
    assert f"image {last} of {last}: the file ends here" in refusal(tmp_path)
    (tmp_path / "images.bin").write_bytes(whole[:80])
    assert f"image 1 of {last}: the file ends in a name" in refusal(tmp_path)
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 0))
    assert "has no cameras" in refusal(tmp_path)
    (tmp_path / "images.bin").write_bytes(whole.replace(b"dir", b"\xff\xfe\xfd"))
    assert "images.bin: is not UTF-8 text" in refusal(tmp_path)


@pytest.mark.parametrize(("number", "name"), [(11, "'number 11'"), (99, "'number 99'"), (-1, "'number -1'")])
def test_a_binary_model_of_an_unknown_kind_is_refused_by_name(tmp_path, number, name):
    colmap_binary(tmp_path)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ", 1, 1, number, 640, 480))
    assert f"cameras.bin: camera 1 of 1: model {name} is not known" in refusal(tmp_path)


def test_a_quaternion_of_nothing_is_refused(tmp_path):
    colmap_binary(tmp_path)
    content = struct.pack("<Qi7di", 1, 1, *np.zeros(7), 1) + b"a\0" + struct.pack("<Q", 0)
    (tmp_path / "images.bin").write_bytes(content)
    assert "images.bin: frame 'a': quaternion must not be zero" in refusal(tmp_path)
