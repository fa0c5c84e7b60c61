"""Cameras of Meshroom, as AliceVision writes them to .sfm: JSON whose numbers are texts.

A camera sees X at R(X − C), R column by column, in axes like OpenCV's; pixels' centres are whole numbers.
From version 1.2.3 on, meshes are written with y and z turned round, poses are not.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from octex.arrays import Float64s
from octex.cameras.camera import intrinsics
from octex.cameras.fields import BrokenError, Record, within
from octex.cameras.frames import Frame, Optics, picture_path, rigid, view_of

_FROM_MESH = np.diag([1.0, -1.0, -1.0, 1.0])
#: How many numbers a distortion has, by its name and by the camera's type that older versions name.
_DISTORTIONS = {
    "none": 0, "radialk1": 1, "radialk3": 3, "brown": 5, "fisheye": 4,
    "pinhole": 0, "radial1": 1, "radial3": 3,
}  # fmt: skip


def read(path: Path, document: dict[str, Any]) -> list[Frame]:
    """Read the cameras of all views that are placed."""
    scene = Record(document, are_texts=True)
    version = scene.numbers("version", 3).tolist()
    optics = {each.key("intrinsicId"): each for each in scene.records("intrinsics")}
    poses = {each.key("poseId"): each for each in scene.records("poses")}
    frames = []
    for number, record in enumerate(scene.records("views")):
        with within(f"view {number}"):
            name = record.text("path")
        pose, lens = poses.get(str(record.find("poseId"))), optics.get(str(record.find("intrinsicId")))
        if pose is None or lens is None:
            continue  # not placed
        with within(f"view {name!r}"):
            if "rigId" in record and str(record.find("isPoseIndependant", True)).lower() in ("false", "0"):
                raise BrokenError("is one of a rig's, which octex does not read; leave the rig out")
            with within("pose"):
                view = _view(pose.record("pose").record("transform"))
            if version >= [1, 2, 3]:
                view = view @ _FROM_MESH
            with within("intrinsics"):
                frames.append(Frame(name, path, _optics(lens, version), view, picture_path(path, name)))
    return frames


def _view(transform: Record) -> Float64s:
    rotation = transform.numbers("rotation", 9).reshape(3, 3).T
    return view_of(rigid(rotation, -rotation @ transform.numbers("center", 3)))


def _optics(record: Record, version: list[float]) -> Optics:
    size = record.size()
    kind = record.text("type")
    if version >= [1, 2, 8]:
        kinds = [kind, record.text("distortionType"), record.text("undistortionType")]
        kind = kinds[1] if kinds[::2] == ["pinhole", "none"] else ", ".join(kinds)
    if kind not in _DISTORTIONS:
        raise BrokenError(
            f"type {kind!r} is not known; octex knows pinholes with radial, brown or fisheye distortion"
        )
    center = record.numbers("principalPoint", 2)
    if version >= [1, 2, 1]:
        center += np.array(size) / 2
    across, down = _focal(record, version, size[0])
    if not min(across, down) > 0.0:
        raise BrokenError(f"the focal length must be above zero, not {min(across, down):g}")
    count = _DISTORTIONS[kind]
    numbers: list[float] = record.numbers("distortionParams", count).tolist() if count else []
    K = intrinsics(across, down, center[0] + 0.5, center[1] + 0.5)
    if kind == "fisheye":
        return Optics(size, K, tuple(numbers), "fisheye")
    k1, k2, k3, p1, p2 = [*numbers, *[0.0] * (5 - count)]
    return Optics(size, K, (k1, k2, p1, p2, k3))


def _focal(record: Record, version: list[float], width: int) -> tuple[float, float]:
    """Return the focal lengths across and down, in pixels."""
    if version < [1, 2, 0]:
        focal = record.number("pxFocalLength")
        return focal, focal
    if version < [1, 2, 2]:
        across, down = record.numbers("pxFocalLength", 2).tolist()
        return across, down
    sensor, ratio = record.number("sensorWidth", 36.0), record.number("pixelRatio", 1.0)
    if not (sensor > 0.0 and ratio > 0.0):
        raise BrokenError("sensorWidth and pixelRatio must be above zero")
    focal = record.number("focalLength") / sensor * width
    if version < [1, 2, 5]:
        return focal, focal / ratio
    return (focal, focal * ratio) if version < [1, 2, 11] else (focal / ratio, focal)
