"""Cameras of OpenMVG, sfm_data.json.

A camera sees X at R(X − C), in axes like OpenCV's; pixels' centres are whole numbers. What cameras are shows
in the names of their distortions' numbers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from octex.cameras.fields import (
    BrokenError,
    Frame,
    Json,
    Optics,
    beside,
    field_of,
    intrinsics_of,
    matrix_field,
    numbers_field,
    object_field,
    objects_field,
    pixels_field,
    positive_field,
    text_field,
    view_of_pose,
    within,
)
from octex.cameras.lens import DistortionModel

#: The distortions by their fields: how many numbers, and where octex has these among its own.
_DISTORTIONS: dict[str, tuple[DistortionModel, tuple[int, ...]]] = {
    "disto_k1": ("opencv", (0,)),
    "disto_k3": ("opencv", (0, 1, 4)),
    "disto_t2": ("opencv", (0, 1, 4, 2, 3)),
    "fisheye": ("fisheye", (0, 1, 2, 3)),
}
#: How many numbers octex has of each model.
_COUNTS = {"opencv": 5, "fisheye": 4}


def read_openmvg(path: Path, document: Json) -> list[Frame]:
    """Read the cameras of all views that are placed."""
    poses = {_key(each): object_field(each, "value") for each in objects_field(document, "extrinsics")}
    optics = {_key(each): each for each in objects_field(document, "intrinsics")}
    root = document.get("root_path", "")
    frames = []
    for number, record in enumerate(objects_field(document, "views")):
        with within(f"view {number}"):
            given = _data(record)
            name = text_field(given, "filename")
        pose, of_lens = poses.get(str(given.get("id_pose"))), optics.get(str(given.get("id_intrinsic")))
        if pose is None or of_lens is None:
            continue  # not placed
        with within(f"view {name!r}"):
            with within("intrinsics"):
                lens = _optics(_data(of_lens))
            rotation, view = matrix_field(pose, "rotation", (3, 3)), np.eye(4)
            view[:3, :3], view[:3, 3] = rotation, -rotation @ numbers_field(pose, "center", 3)
            frame = lens.frame(name, path, view_of_pose(view, "opencv"))
        folders = (str(root).rstrip("/"), str(given.get("local_path", "")).strip("/"))
        image = "/".join([*filter(None, folders), name])
        frames.append(frame._replace(image=beside(path, image)))
    return frames


def _key(record: Json) -> str:
    return str(field_of(record, "key", object, "a number"))


def _data(record: Json) -> Json:
    """Return what a pointer points at, of older and newer versions: in a record of its own, what all have."""
    data = object_field(object_field(object_field(record, "value"), "ptr_wrapper"), "data")
    return {**object_field(data, "value0"), **data} if "value0" in data else data


def _optics(record: Json) -> Optics:
    if "focal_length" not in record:
        raise BrokenError("focal_length is missing; undistort pictures of panoramas")
    size = pixels_field(record, "width"), pixels_field(record, "height")
    focal = positive_field(record, "focal_length")
    center = numbers_field(record, "principal_point", 2) + 0.5
    K = intrinsics_of(focal, focal, *center.tolist())
    for field, (model, places) in _DISTORTIONS.items():
        if field in record:
            numbers = np.zeros(_COUNTS[model])
            numbers[list(places)] = numbers_field(record, field, len(places))
            return Optics(size, K, tuple(numbers.tolist()), model)
    return Optics(size, K, (0.0,) * _COUNTS["opencv"], "opencv")
