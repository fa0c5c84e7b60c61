"""Cameras of COLMAP, as text and binary, from known poses."""

import struct

import numpy as np
import pytest

from octex.cameras.files import read_cameras
from tests.make.camera_files import CAMERAS, bent, colmap_binary, colmap_text, refusal, sees, view


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
