"""Cameras of OpenSfM, reconstruction.json, and of OpenDroneMap, which keeps one in its folder opensfm.

A camera sees X at R·X + t, R by its axis and angle, in axes like OpenCV's. Focal lengths and centres are
parts of the picture's longer side, centres from its middle.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from octex.arrays import Float64s
from octex.cameras.camera import intrinsics
from octex.cameras.fields import BrokenError, Record, within
from octex.cameras.frames import Frame, Optics, picture_path, rigid, rotation_of, view_of
from octex.cameras.lens import DistortionModel

#: The folder of the pictures, beside the file.
_FOLDER = "images"
#: The distortions by projection_type: octex's model, and the fields of its numbers in its order.
_DISTORTIONS: dict[str, tuple[DistortionModel, tuple[str, ...]]] = {
    **dict.fromkeys(("perspective", "simple_radial", "radial"), ("opencv", ("k1", "k2"))),
    "brown": ("opencv", ("k1", "k2", "p1", "p2", "k3")),
    **dict.fromkeys(("fisheye", "fisheye_opencv"), ("fisheye", ("k1", "k2", "k3", "k4"))),
}


def read(path: Path, reconstructions: list[dict[str, Any]]) -> list[Frame]:
    """Read the cameras of the first reconstruction, the largest; others have space of their own."""
    frames = []
    scene = Record(reconstructions[0])
    cameras, shots = scene.record("cameras"), scene.record("shots")
    for name in shots:
        with within(f"shot {name!r}"):
            shot = shots.record(name)
            camera = shot.text("camera")
            with within(f"camera {camera!r}"):
                optics = _optics(cameras.record(camera))
            view = rigid(_rotation(shot.numbers("rotation", 3)), shot.numbers("translation", 3))
            image = picture_path(path, f"{_FOLDER}/{name}")
            frames.append(Frame(name, path, optics, view_of(view), image))
    return frames


def _optics(record: Record) -> Optics:
    kind = record.text("projection_type") if "projection_type" in record else "perspective"
    if kind not in _DISTORTIONS:
        raise BrokenError(
            f"projection_type {kind!r} is not known; octex knows {', '.join(_DISTORTIONS)}: undistort the "
            "pictures"
        )
    width, height = size = record.size()
    side = max(size)
    x, y = ("focal", "focal") if "focal" in record else ("focal_x", "focal_y")
    center_x, center_y = (record.number(field, 0.0) * side for field in ("c_x", "c_y"))
    focal_x, focal_y = (record.positive(field) * side for field in (x, y))
    K = intrinsics(focal_x, focal_y, width / 2 + center_x, height / 2 + center_y)
    model, fields = _DISTORTIONS[kind]
    return Optics(size, K, tuple(record.number(field, 0.0) for field in fields), model)


def _rotation(axis: Float64s) -> Float64s:
    """Return the matrix of a rotation about an axis, by its length in radians."""
    angle = float(np.linalg.norm(axis))
    quaternion = np.append(np.cos(angle / 2), np.sinc(angle / 2 / np.pi) / 2 * axis)
    return rotation_of(quaternion, "rotation")
