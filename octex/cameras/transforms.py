"""Cameras of transforms.json: NeRF, instant-ngp, nerfstudio."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from octex.arrays import Float64s
from octex.cameras.camera import intrinsics
from octex.cameras.fields import BrokenError, Record, within
from octex.cameras.frames import Frame, Optics, image_path, view_matrix, with_ending
from octex.cameras.lens import DistortionModel

_ENDINGS = ("", ".png", ".jpg", ".jpeg")
#: Fields of the distortion coefficients.
_NUMBERS = "k1 k2 p1 p2 k3 k4"
#: Distortion models by camera_model.
_MODELS: dict[str, DistortionModel] = {
    "PINHOLE": "opencv", "SIMPLE_PINHOLE": "opencv", "OPENCV": "opencv", "SIMPLE_RADIAL": "opencv",
    "RADIAL": "opencv", "OPENCV_FISHEYE": "fisheye", "SIMPLE_RADIAL_FISHEYE": "fisheye",
    "RADIAL_FISHEYE": "fisheye",
}  # fmt: skip


def read(path: Path, document: dict[str, Any]) -> list[Frame]:
    """Read the frames; the document's fields are defaults for the frames' fields."""
    frames = []
    shared = Record(document)
    for number, record in enumerate(shared.records("frames")):
        with within(f"frame {number}"):
            name = record.text("file_path")
        with within(f"frame {name!r}"):
            record = record.over(shared)
            optics = _optics(record)
            pose = record.matrix("transform_matrix", (4, 4), (3, 4))
            with within("transform_matrix"):
                view = view_matrix(pose, "opengl")
        image = with_ending(image_path(path, name), _ENDINGS)
        frames.append(Frame(name, path, optics, view, image))
    return frames


def _optics(record: Record) -> Optics:
    kind = record.text("camera_model") if "camera_model" in record else "OPENCV"
    if kind not in _MODELS:
        raise BrokenError(
            f"camera_model {reprlib.repr(kind)} is not known; undistort the images to one of "
            f"{', '.join(_MODELS)}"
        )
    model: DistortionModel = "fisheye" if record.find("is_fisheye") else _MODELS[kind]
    for field in ("ftheta", "is_equirectangular", "equirectangular"):
        if record.find(field):
            raise BrokenError(f"{field} is set: such cameras are not known; undistort the images")
    size = record.size("w", "h") if "w" in record or "h" in record else None
    numbers = [record.number(field, 0.0) for field in _NUMBERS.split()]
    if model != "fisheye" and numbers[-1] != 0.0:
        raise BrokenError("k4 must be zero: octex knows k1, k2, k3, p1, p2; undistort the images")
    return Optics(size, _intrinsics(record)).bent(model, _NUMBERS, numbers)


def _intrinsics(record: Record) -> Callable[[int, int], Float64s]:
    x = _focal(record, "fl_x", "camera_angle_x")
    if x is None:
        raise BrokenError("fl_x is missing, and so is camera_angle_x; one of them must be given")
    y = _focal(record, "fl_y", "" if "fl_x" in record else "camera_angle_y")
    center_x, center_y = (record.number(field) if field in record else None for field in ("cx", "cy"))

    def scaled(width: int, height: int) -> Float64s:
        focal_x = x[0] + x[1] * width
        return intrinsics(
            focal_x,
            focal_x if y is None else y[0] + y[1] * height,
            width / 2 if center_x is None else center_x,
            height / 2 if center_y is None else center_y,
        )

    return scaled


def _focal(record: Record, field: str, angle: str) -> tuple[float, float] | None:
    """Return a focal length (in pixels, in image widths or heights), of which one is 0; None if missing."""
    if field in record:
        return record.positive(field), 0.0
    return (0.0, focal_of_angle(record, angle)) if angle in record else None


def focal_of_angle(record: Record, field: str) -> float:
    """Return the focal length, in image widths or heights, for the field of view across the image."""
    return 0.5 / math.tan(record.positive(field, below=math.pi) / 2)
