"""Cameras of Meshroom, as AliceVision writes them to .sfm: JSON whose numbers are texts.

A camera sees X at R(X − C), R column by column, in axes like OpenCV's; pixels' centres are whole numbers.
From version 1.2.3 on, meshes are written with y and z turned round, poses are not.
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
    field_of,
    intrinsics_of,
    number_of,
    object_field,
    objects_field,
    size_of,
    text_field,
    view_of_pose,
    within,
)

_FROM_MESH = np.diag([1.0, -1.0, -1.0, 1.0])
#: How many numbers a distortion has, by its name and by the camera's type that older versions name.
_DISTORTIONS = {
    "none": 0, "radialk1": 1, "radialk3": 3, "brown": 5, "fisheye": 4,
    "pinhole": 0, "radial1": 1, "radial3": 3,
}  # fmt: skip


def read_meshroom(path: Path, document: Json) -> list[Frame]:
    """Read the cameras of all views that are placed."""
    version = _numbers(document, "version", 3)
    optics = {_id(each, "intrinsicId"): each for each in objects_field(document, "intrinsics")}
    poses = {_id(each, "poseId"): each for each in objects_field(document, "poses")}
    frames = []
    for number, record in enumerate(objects_field(document, "views")):
        with within(f"view {number}"):
            name = text_field(record, "path")
        given, of_lens = poses.get(str(record.get("poseId"))), optics.get(str(record.get("intrinsicId")))
        if given is None or of_lens is None:
            continue  # not placed
        with within(f"view {name!r}"):
            if "rigId" in record and str(record.get("isPoseIndependant", True)).lower() in ("false", "0"):
                raise BrokenError("is one of a rig's, which octex does not read; leave the rig out")
            view = _view(given)
            if version >= [1, 2, 3]:
                view = view @ _FROM_MESH
            with within("intrinsics"):
                lens = _optics(of_lens, version)
            frames.append(lens.frame(name, path, view)._replace(image=beside(path, name)))
    return frames


def _view(record: Json) -> Float64s:
    with within("pose"):
        transform = object_field(object_field(record, "pose"), "transform")
        rotation = np.array(_numbers(transform, "rotation", 9)).reshape(3, 3).T
        view = np.eye(4)
        view[:3, :3], view[:3, 3] = rotation, -rotation @ _numbers(transform, "center", 3)
        return view_of_pose(view, "opencv")


def _optics(record: Json, version: list[float]) -> Optics:
    size = size_of(*(number_of(record.get(each), each) for each in ("width", "height")))
    kind = text_field(record, "type")
    if version >= [1, 2, 8]:
        kinds = [kind, text_field(record, "distortionType"), text_field(record, "undistortionType")]
        kind = kinds[1] if kinds[::2] == ["pinhole", "none"] else ", ".join(kinds)
    if kind not in _DISTORTIONS:
        raise BrokenError(
            f"type {kind!r} is not known; octex knows pinholes with radial, brown or fisheye distortion"
        )
    center = np.array(_numbers(record, "principalPoint", 2))
    if version >= [1, 2, 1]:
        center += np.array(size) / 2
    across, down = _focal(record, version, size[0])
    if not min(across, down) > 0.0:
        raise BrokenError(f"the focal length must be above zero, not {min(across, down):g}")
    found = _numbers(record, "distortionParams", _DISTORTIONS[kind]) if _DISTORTIONS[kind] else []
    K = intrinsics_of(across, down, center[0] + 0.5, center[1] + 0.5)
    if kind == "fisheye":
        return Optics(size, K, tuple(found), "fisheye")
    k1, k2, k3, p1, p2 = [*found, *[0.0] * (5 - len(found))]
    return Optics(size, K, (k1, k2, p1, p2, k3), "opencv")


def _focal(record: Json, version: list[float], width: int) -> tuple[float, float]:
    """Return the focal lengths across and down, in pixels."""
    if version < [1, 2, 0]:
        focal = number_of(record.get("pxFocalLength"), "pxFocalLength")
        return focal, focal
    if version < [1, 2, 2]:
        across, down = _numbers(record, "pxFocalLength", 2)
        return across, down
    sensor = number_of(record.get("sensorWidth", 36.0), "sensorWidth")
    ratio = number_of(record.get("pixelRatio", 1.0), "pixelRatio")
    if not (sensor > 0.0 and ratio > 0.0):
        raise BrokenError("sensorWidth and pixelRatio must be above zero")
    focal = number_of(record.get("focalLength"), "focalLength") / sensor * width
    if version < [1, 2, 5]:
        return focal, focal / ratio
    return (focal, focal * ratio) if version < [1, 2, 11] else (focal / ratio, focal)


def _id(record: Json, field: str) -> str:
    return str(field_of(record, field, object, "a number"))


def _numbers(record: Json, field: str, count: int) -> list[float]:
    given = field_of(record, field, list, f"{count} numbers")
    if len(given) != count:
        raise BrokenError(f"{field} must be {count} numbers, not {len(given)}")
    return [number_of(each, field) for each in given]
