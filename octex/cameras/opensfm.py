"""Cameras of OpenSfM, reconstruction.json, and of OpenDroneMap, which keeps one in its folder opensfm.

A camera sees X at R·X + t, R by its axis and angle, in axes like OpenCV's. Focal lengths and centres are
parts of the picture's longer side, centres from its middle.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from octex.arrays import Float64s
from octex.cameras.fields import (
    BrokenError,
    Frame,
    Json,
    Optics,
    beside,
    intrinsics_of,
    number_field,
    numbers_field,
    object_field,
    pixels_field,
    positive_field,
    rotation_of,
    text_field,
    view_of_pose,
    within,
)
from octex.cameras.lens import DistortionModel

#: Where pictures are, beside the file.
_FOLDER = "images"
#: What octex calls the distortions, and the fields of their numbers in its order.
_DISTORTIONS: dict[str, tuple[DistortionModel, tuple[str, ...]]] = {
    "perspective": ("opencv", ("k1", "k2")),
    "simple_radial": ("opencv", ("k1", "k2")),
    "radial": ("opencv", ("k1", "k2")),
    "brown": ("opencv", ("k1", "k2", "p1", "p2", "k3")),
    "fisheye": ("fisheye", ("k1", "k2", "k3", "k4")),
    "fisheye_opencv": ("fisheye", ("k1", "k2", "k3", "k4")),
}


def read_opensfm(path: Path, document: list[Json]) -> list[Frame]:
    """Read the cameras of the first reconstruction, the largest; others have space of their own."""
    frames = []
    cameras = object_field(document[0], "cameras")
    for name, shot in object_field(document[0], "shots").items():
        with within(f"shot {name!r}"):
            if not isinstance(shot, dict):
                raise BrokenError("must be an object")
            camera = text_field(shot, "camera")
            with within(f"camera {camera!r}"):
                optics = _optics(object_field(cameras, camera))
            view = np.eye(4)
            view[:3, :3] = _rotation(numbers_field(shot, "rotation", 3))
            view[:3, 3] = numbers_field(shot, "translation", 3)
            frame = optics.frame(name, path, view_of_pose(view, "opencv"))
        frames.append(frame._replace(image=beside(path, f"{_FOLDER}/{name}")))
    return frames


def _optics(record: Json) -> Optics:
    kind = text_field(record, "projection_type") if "projection_type" in record else "perspective"
    if kind not in _DISTORTIONS:
        raise BrokenError(
            f"projection_type {kind!r} is not known; octex knows {', '.join(_DISTORTIONS)}: undistort the "
            "pictures"
        )
    width, height = size = pixels_field(record, "width"), pixels_field(record, "height")
    side = max(size)
    x, y = ("focal", "focal") if "focal" in record else ("focal_x", "focal_y")
    center = [number_field(record, field, 0.0) for field in ("c_x", "c_y")]
    K = intrinsics_of(
        positive_field(record, x) * side,
        positive_field(record, y) * side,
        width / 2 + center[0] * side,
        height / 2 + center[1] * side,
    )
    model, fields = _DISTORTIONS[kind]
    return Optics(size, K, tuple(number_field(record, field, 0.0) for field in fields), model)


def _rotation(axis: Float64s) -> Float64s:
    """Return the matrix of a rotation about an axis, by its length in radians."""
    angle = float(np.linalg.norm(axis))
    quaternion = np.append(np.cos(angle / 2), np.sinc(angle / 2 / np.pi) / 2 * axis)
    return rotation_of(quaternion, "rotation")
