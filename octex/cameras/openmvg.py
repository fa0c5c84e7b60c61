"""Cameras of OpenMVG, sfm_data.json.

A camera sees X at R(X − C), in axes like OpenCV's; pixels' centres are whole numbers. The names of their
distortions' numbers tell the kinds of cameras apart.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from octex.cameras.camera import intrinsics
from octex.cameras.fields import BrokenError, Record, within
from octex.cameras.frames import Frame, Optics, picture_path, rigid, view_of
from octex.cameras.lens import DistortionModel

#: The distortions by their fields: octex's model, how many numbers it has, and where those of the field go.
_DISTORTIONS: dict[str, tuple[DistortionModel, int, list[int]]] = {
    "disto_k1": ("opencv", 5, [0]),
    "disto_k3": ("opencv", 5, [0, 1, 4]),
    "disto_t2": ("opencv", 5, [0, 1, 4, 2, 3]),
    "fisheye": ("fisheye", 4, [0, 1, 2, 3]),
}


def read(path: Path, document: dict[str, Any]) -> list[Frame]:
    """Read the cameras of all views that are placed."""
    scene = Record(document)
    poses = {each.key("key"): each.record("value") for each in scene.records("extrinsics")}
    optics = {each.key("key"): each for each in scene.records("intrinsics")}
    root = str(scene.find("root_path", "")).rstrip("/")
    frames = []
    for number, record in enumerate(scene.records("views")):
        with within(f"view {number}"):
            seen = _data(record)
            name = seen.text("filename")
        pose, lens = poses.get(str(seen.find("id_pose"))), optics.get(str(seen.find("id_intrinsic")))
        if pose is None or lens is None:
            continue  # not placed
        with within(f"view {name!r}"):
            with within("intrinsics"):
                shared = _optics(_data(lens))
            rotation = pose.matrix("rotation", (3, 3))
            view = view_of(rigid(rotation, -rotation @ pose.numbers("center", 3)))
        folders = root, str(seen.find("local_path", "")).strip("/")
        image = picture_path(path, "/".join([*filter(None, folders), name]))
        frames.append(Frame(name, path, shared, view, image))
    return frames


def _data(record: Record) -> Record:
    """Return the object that a pointer points at; older versions hold shared fields in ``value0``."""
    data = record.record("value").record("ptr_wrapper").record("data")
    return data.over(data.record("value0")) if "value0" in data else data


def _optics(record: Record) -> Optics:
    if "focal_length" not in record:
        raise BrokenError("focal_length is missing; undistort pictures of panoramas")
    size, focal = record.size(), record.positive("focal_length")
    center = record.numbers("principal_point", 2) + 0.5
    K = intrinsics(focal, focal, *center.tolist())
    for field, (model, count, places) in _DISTORTIONS.items():
        if field in record:
            numbers = np.zeros(count)
            numbers[places] = record.numbers(field, len(places))
            return Optics(size, K, tuple(numbers.tolist()), model)
    return Optics(size, K)
