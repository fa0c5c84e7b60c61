"""Cameras of structure from motion: Meshroom's .sfm, OpenMVG's and OpenSfM's JSON, Bundler's .out.

All but Bundler's use OpenCV's axes. In Meshroom and OpenMVG pixel centres are whole numbers.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from octex.cameras.camera import FLIP_YZ, intrinsics
from octex.cameras.fields import BrokenError, Record, within
from octex.cameras.frames import (
    Frame,
    Optics,
    centred,
    image_path,
    is_file,
    rigid,
    rotation_of,
    view_matrix,
    with_ending,
)
from octex.cameras.lens import DistortionModel
from octex.files import read_bytes

BUNDLER_MARK = b"# Bundle file"
#: Numbers a camera in Bundler's file.
_WIDTH = 15
#: Coefficients of Meshroom's distortions, by distortion name and by camera type of older versions.
_MESHROOM = {
    **dict.fromkeys(("none", "pinhole"), ""),
    **dict.fromkeys(("radialk1", "radial1"), "k1"),
    **dict.fromkeys(("radialk3", "radial3"), "k1 k2 k3"),
    "brown": "k1 k2 k3 p1 p2",
    "fisheye": "k1 k2 k3 k4",
}
#: OpenMVG's distortions by field: octex's model, and the names of the field's coefficients.
_OPENMVG: dict[str, tuple[DistortionModel, str]] = {
    "disto_k1": ("opencv", "k1"),
    "disto_k3": ("opencv", "k1 k2 k3"),
    "disto_t2": ("opencv", "k1 k2 k3 p1 p2"),
    "fisheye": ("fisheye", "k1 k2 k3 k4"),
}
#: OpenSfM's distortions by projection_type: octex's model, and the fields of the coefficients.
_OPENSFM: dict[str, tuple[DistortionModel, str]] = {
    **dict.fromkeys(("perspective", "simple_radial", "radial"), ("opencv", "k1 k2")),
    "brown": ("opencv", "k1 k2 p1 p2 k3"),
    **dict.fromkeys(("fisheye", "fisheye_opencv"), ("fisheye", "k1 k2 k3 k4")),
}
#: Endings that OpenSfM adds to the names of undistorted images.
_UNDISTORTED = "", ".jpg", ".tif", ".png"


def read_meshroom(path: Path, document: dict[str, Any]) -> list[Frame]:
    """Read the cameras of all views of AliceVision's JSON that have a pose; it stores numbers as texts.

    From version 1.2.3 on, AliceVision turns y and z of meshes round, but not of poses.
    """
    scene = Record(document, are_texts=True)
    if "poses" not in scene:
        raise BrokenError("has views without poses; give the .sfm file that StructureFromMotion wrote")
    version = scene.numbers("version", 3).tolist()
    optics = {each.key("intrinsicId"): each for each in scene.records("intrinsics")}
    poses = {each.key("poseId"): each for each in scene.records("poses")}
    frames = []
    for number, record in enumerate(scene.records("views")):
        with within(f"view {number}"):
            name = record.text("path")
        pose, lens = poses.get(str(record.find("poseId"))), optics.get(str(record.find("intrinsicId")))
        if pose is None or lens is None:
            continue  # no pose
        with within(f"view {name!r}"):
            if "rigId" in record and str(record.find("isPoseIndependant", True)).lower() in ("false", "0"):
                raise BrokenError("belongs to a rig, which octex does not read; leave the rig out")
            with within("pose"):
                transform = pose.record("pose").record("transform")
                rotation = transform.numbers("rotation", 9).reshape(3, 3).T
                view = view_matrix(rigid(rotation, -rotation @ transform.numbers("center", 3)))
            if version >= [1, 2, 3]:
                view = view @ FLIP_YZ
            with within("intrinsics"):
                shared = _meshroom_optics(lens, version)
            frames.append(Frame(name, path, shared, view, image_path(path, name)))
    return frames


def _meshroom_optics(record: Record, version: list[float]) -> Optics:
    size = record.size()
    kind = record.text("type")
    if version >= [1, 2, 8]:
        kinds = [kind, record.text("distortionType"), record.text("undistortionType")]
        kind = kinds[1] if kinds[::2] == ["pinhole", "none"] else ", ".join(kinds)
    if kind not in _MESHROOM:
        raise BrokenError(
            f"type {kind!r} is not known; octex knows pinholes with radial, brown or fisheye distortion"
        )
    center = record.numbers("principalPoint", 2)
    if version >= [1, 2, 1]:
        center += np.array(size) / 2
    across, down = _meshroom_focal(record, version, size[0])
    if not min(across, down) > 0.0:
        raise BrokenError(f"the focal length must be above zero, not {min(across, down):g}")
    names = _MESHROOM[kind]
    numbers = record.numbers("distortionParams", len(names.split())).tolist() if names else []
    K = intrinsics(across, down, center[0] + 0.5, center[1] + 0.5)
    model: DistortionModel = "fisheye" if kind == "fisheye" else "opencv"
    return Optics(size, K).bent(model, names, numbers)


def _meshroom_focal(record: Record, version: list[float], width: int) -> tuple[float, float]:
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


def read_openmvg(path: Path, document: dict[str, Any]) -> list[Frame]:
    """Read the cameras of all views of sfm_data.json that have a pose."""
    scene = Record(document)
    poses = {each.key("key"): each.record("value") for each in scene.records("extrinsics")}
    optics = {each.key("key"): each for each in scene.records("intrinsics")}
    root = str(scene.find("root_path", "")).rstrip("/")
    frames = []
    for number, record in enumerate(scene.records("views")):
        with within(f"view {number}"):
            data = _openmvg_data(record)
            name = data.text("filename")
        pose, lens = poses.get(str(data.find("id_pose"))), optics.get(str(data.find("id_intrinsic")))
        if pose is None or lens is None:
            continue  # no pose
        with within(f"view {name!r}"):
            with within("intrinsics"):
                shared = _openmvg_optics(_openmvg_data(lens))
            rotation = pose.matrix("rotation", (3, 3))
            view = view_matrix(rigid(rotation, -rotation @ pose.numbers("center", 3)))
        folders = root, str(data.find("local_path", "")).strip("/")
        image = image_path(path, "/".join([*filter(None, folders), name]))
        frames.append(Frame(name, path, shared, view, image))
    return frames


def _openmvg_data(record: Record) -> Record:
    """Return the data of a pointer record; older versions keep shared fields in ``value0``."""
    data = record.record("value").record("ptr_wrapper").record("data")
    return data.over(data.record("value0")) if "value0" in data else data


def _openmvg_optics(record: Record) -> Optics:
    if "focal_length" not in record:
        raise BrokenError("focal_length is missing; undistort images of panoramas")
    size, focal = record.size(), record.positive("focal_length")
    center = record.numbers("principal_point", 2) + 0.5
    K = intrinsics(focal, focal, *center.tolist())
    for field, (model, names) in _OPENMVG.items():
        if field in record:
            numbers = record.numbers(field, len(names.split())).tolist()
            return Optics(size, K).bent(model, names, numbers)
    return Optics(size, K)


def read_opensfm(path: Path, reconstructions: list[dict[str, Any]]) -> list[Frame]:
    """Read the cameras of the first and largest reconstruction of reconstruction.json (also OpenDroneMap's).

    A camera maps X to R·X + t; the file stores R as axis times angle.
    """
    frames = []
    scene = Record(reconstructions[0])
    cameras, shots = scene.record("cameras"), scene.record("shots")
    for name in shots:
        with within(f"shot {name!r}"):
            shot = shots.record(name)
            camera = shot.text("camera")
            with within(f"camera {camera!r}"):
                optics = _opensfm_optics(cameras.record(camera))
            axis = shot.numbers("rotation", 3)
            angle = float(np.linalg.norm(axis))
            quaternion = np.append(np.cos(angle / 2), np.sinc(angle / 2 / np.pi) / 2 * axis)
            view = rigid(rotation_of(quaternion, "rotation"), shot.numbers("translation", 3))
            image = with_ending(image_path(path, f"images/{name}"), _UNDISTORTED)
            frames.append(Frame(name, path, optics, view_matrix(view), image))
    return frames


def _opensfm_optics(record: Record) -> Optics:
    """Return a camera's optics; focal lengths and centres in the file are parts of the longer image side."""
    kind = record.text("projection_type") if "projection_type" in record else "perspective"
    if kind not in _OPENSFM:
        raise BrokenError(
            f"projection_type {kind!r} is not known; octex knows {', '.join(_OPENSFM)}: undistort the images"
        )
    width, height = size = record.size()
    side = max(size)
    x, y = ("focal", "focal") if "focal" in record else ("focal_x", "focal_y")
    center_x, center_y = (record.number(field, 0.0) * side for field in ("c_x", "c_y"))
    focal_x, focal_y = (record.positive(field) * side for field in (x, y))
    K = intrinsics(focal_x, focal_y, width / 2 + center_x, height / 2 + center_y)
    model, names = _OPENSFM[kind]
    numbers = [record.number(field, 0.0) for field in names.split()]
    return Optics(size, K).bent(model, names, numbers)


def read_bundler(path: Path, content: bytes) -> list[Frame]:
    """Read the cameras of Bundler, RealityCapture, VisualSFM and others that have a focal length.

    A camera maps X to R·X + t and looks along −z with y up. At normalised (x, y) the pixel is f·(1 + k1·s +
    k2·s²)·(x, y) from the image's middle, s = x² + y². A list in the same folder names the images, or
    list.txt next to a folder ``bundle``.
    """
    words = content.decode("utf-8", errors="replace").partition("\n")[2].split()
    what = "the number of cameras"
    count = Record({what: words[0] if words else None}, are_texts=True).number(what)
    if not (0 <= 2 + _WIDTH * count <= len(words) and count.is_integer()):
        raise BrokenError(f"the number of cameras, {count:g}, is more than the file has room for")
    names: list[str] = []
    ending = "".join(path.suffixes[:-1])  # Bundler lists the images of bundle.rd.out in list.rd.txt
    in_folder = f"{path.stem}.list.txt", f"{path.stem}_list.txt", f"list{ending}.txt", "list.txt"
    lists = [path.with_name(name) for name in in_folder]
    folder = path.absolute().parent
    if folder.name == "bundle":  # Bundler's own, next to its list
        lists.append(folder.with_name("list.txt"))
    list_file = next(filter(is_file, lists), None)
    if list_file is not None:
        lines = read_bytes(list_file).decode("utf-8", errors="replace").splitlines()
        # Bundler's lists have a zero and a focal length after each name.
        names = [re.sub(r"\s+0\s+\S+$", "", line.strip()) for line in lines if line.strip()]
    if names and len(names) != count:
        raise BrokenError(f"its list names {len(names)} images for {count:g} cameras; export both again")
    frames = []
    for number in range(int(count)):
        with within(f"camera {number}"):
            f, k1, k2, *pose = words[2 + _WIDTH * number : 2 + _WIDTH * (number + 1)]
            fields = {"f": f, "k1": k1, "k2": k2, "R": pose[:9], "t": pose[9:]}
            record = Record(fields, are_texts=True)
            focal, *bends = (record.number(field) for field in ("f", "k1", "k2"))
            rotation, shift = record.numbers("R", 9), record.numbers("t", 3)
            if focal == 0.0:
                continue  # no pose
            if focal < 0.0:
                raise BrokenError(f"f must be above zero, not {focal:g}")
            view = view_matrix(FLIP_YZ @ rigid(rotation.reshape(3, 3), shift))
        name = names[number] if names else str(number)
        optics = Optics(None, partial(centred, focal), (*bends, 0.0, 0.0))
        image = image_path(list_file, name) if list_file and names else None
        frames.append(Frame(name, path, optics, view, image, is_named=bool(names)))
    return frames
