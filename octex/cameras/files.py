"""Cameras from files that people have, and to a file of our own.

glTF               .gltf, .glb: the cameras of the scene's nodes
transforms.json    NeRF, instant-ngp, nerfstudio: a JSON object with "frames"
COLMAP             a folder with cameras and images, .bin or .txt, or one of these files
Metashape          .xml, exported as Agisoft XML
OpenMVS            .mvs: a scene
Meshroom           .sfm: what AliceVision's StructureFromMotion writes as JSON
OpenSfM            reconstruction.json, of OpenDroneMap too
OpenMVG            sfm_data.json
Bundler            .out, with the list of the pictures beside it
octex cameras      a JSON object with "octex_cameras", as ``write_cameras`` writes it
arrays             .npz: ``viewmats`` and ``Ks`` as gsplat has them, and what `octex.cameras.arrays` says

What a file holds decides how it is read, not its name (but for COLMAP's files, which go by their names).
"""

from __future__ import annotations

import codecs
import json
import os
import reprlib
from base64 import b64decode, b64encode
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from octex.arrays import Float64s
from octex.cameras.arrays import read_arrays
from octex.cameras.bundler import MARK as BUNDLER_MARK
from octex.cameras.bundler import read_bundler
from octex.cameras.camera import Camera, Convention
from octex.cameras.colmap import colmap_folder, read_colmap
from octex.cameras.fields import (
    BrokenError,
    Json,
    Lens,
    beside,
    choice_field,
    file_name,
    fixed_lens,
    focal_per_size,
    intrinsics_of,
    is_file,
    listing,
    matrix_field,
    number_field,
    numbers_field,
    objects_field,
    pixels_field,
    positive_field,
    reading,
    text_field,
    view_of_pose,
    within,
)
from octex.cameras.fields import Frame as Frame
from octex.cameras.gltf import read_gltf
from octex.cameras.lens import COUNTS, DISTORTION_MODELS, DistortionModel
from octex.cameras.meshroom import read_meshroom
from octex.cameras.metashape import read_metashape
from octex.cameras.openmvg import read_openmvg
from octex.cameras.openmvs import MARK, read_openmvs
from octex.cameras.opensfm import read_opensfm
from octex.checks import as_entries, as_path
from octex.errors import ArgumentError, CameraError, OutputError
from octex.files import read_bytes, replacing
from octex.source.models.gltf_file import Document

_OURS = "octex_cameras"
_VERSION = 1
_ENDINGS = ("", ".png", ".jpg", ".jpeg")

#: Models of transforms.json, and what their numbers k1, k2, … mean.
_MODELS: dict[str, DistortionModel] = {
    "PINHOLE": "opencv", "SIMPLE_PINHOLE": "opencv", "OPENCV": "opencv", "SIMPLE_RADIAL": "opencv",
    "RADIAL": "opencv", "OPENCV_FISHEYE": "fisheye", "SIMPLE_RADIAL_FISHEYE": "fisheye",
    "RADIAL_FISHEYE": "fisheye",
}  # fmt: skip


def read_cameras(path: str | os.PathLike[str]) -> list[Frame]:
    """Read the cameras of a file, or of a folder with a COLMAP model, in the file's order.

    Raises CameraError for a missing, unknown or damaged file, for one without cameras, and for camera models
    that octex does not support (equirectangular and others).
    """
    path = as_path(path, refusal=CameraError)
    with reading(path):
        folder = colmap_folder(path)
    if folder is not None:
        frames = read_colmap(*folder)
    else:
        with reading(path):
            frames = _read_document(path, read_bytes(path))
    if not frames:
        raise CameraError(f"{path}: has no cameras; choose another file")
    return frames


def find_frame(frames: Sequence[Frame], name: str) -> Frame:
    """Return the frame of that name; else of the same file name in whatever folder; else of the same stem.

    Raises CameraError listing names if there is none, or more than one.
    """
    keys: tuple[Callable[[str], str], ...] = (str, file_name, lambda text: Path(file_name(text)).stem)
    for key in keys:
        found = [frame for frame in frames if key(frame.name) == key(name)]
        if len(found) == 1:
            return found[0]
        if found:
            names = listing(frame.name for frame in found)
            raise CameraError(f"frame {name!r} may be {len(found)} frames: {names}; give the whole name")
    raise CameraError(f"there is no frame {name!r}; there are: {listing(frame.name for frame in frames)}")


def write_cameras(
    path: str | os.PathLike[str], cameras: Mapping[str, Camera], views: Mapping[str, bytes] | None = None
) -> None:
    """Write cameras, by name, to a JSON file from which ``read_cameras`` reads the same bits.

    ``views`` are PNG files of the views that the cameras drew, by the same names: ``Frame.view``.

    The file is replaced completely or not at all. Raises OutputError if it cannot be written.
    """
    path = as_path(path, refusal=OutputError)
    for name, camera in as_entries(cameras, "cameras").items():
        if not isinstance(camera, Camera):
            raise ArgumentError(f"camera {name!r} must be an octex.Camera, not {camera!r}")
    seen = {} if views is None else as_entries(views, "views")
    for name, view in seen.items():
        if name not in cameras or not isinstance(view, bytes):
            raise ArgumentError(f"view {name!r} must be the bytes of a PNG file, for one of the cameras")
    entries = [
        json.dumps(_entry(name, camera, seen.get(name)), allow_nan=False) for name, camera in cameras.items()
    ]
    head = f'{{"{_OURS}": {_VERSION}, "cameras": ['
    with replacing(path) as file:
        file.write((head + ",".join("\n" + entry for entry in entries) + "\n]}\n").encode("ascii"))


def _entry(name: str, camera: Camera, view: bytes | None) -> Json:
    return {
        "name": name,
        "width": camera.width,
        "height": camera.height,
        "projection": camera.projection,
        "K": camera.K.tolist(),
        "pose": camera.world_to_camera.tolist(),
        "convention": "opencv",
        "distortion": list(camera.distortion),
        **({} if camera.distortion_model == "opencv" else {"distortion_model": camera.distortion_model}),
        **({} if view is None else {"view": b64encode(view).decode("ascii")}),
    }


# What is wrong, and where


def _read_document(path: Path, content: bytes) -> list[Frame]:
    if content.startswith(b"glTF"):
        return read_gltf(path, Document(path, content))
    if content.startswith(b"PK"):
        return read_arrays(path, content)
    if content.startswith(MARK):
        return read_openmvs(path, content)
    if content.startswith(BUNDLER_MARK):
        return read_bundler(path, content)
    if content.removeprefix(codecs.BOM_UTF8).lstrip().startswith(b"<"):
        return read_metashape(path, content)
    document = _parsed(content)
    if isinstance(document, list):
        return read_opensfm(path, document)
    if _OURS in document:
        return _read_ours(path, document)
    if "frames" in document:
        return _read_transforms(path, document)
    if "asset" in document:
        return read_gltf(path, Document(path, content))
    if "views" in document and "poses" in document:
        return read_meshroom(path, document)
    if "views" in document and "extrinsics" in document:
        return read_openmvg(path, document)
    raise BrokenError(
        "is no file of cameras; give a .gltf or .glb file, a transforms.json, a COLMAP model, Metashape's "
        ".xml, OpenMVS's .mvs, Meshroom's .sfm, OpenSfM's reconstruction.json, OpenMVG's sfm_data.json, "
        "Bundler's .out, an .npz of viewmats and Ks, or a file that octex wrote"
    )


def _parsed(content: bytes) -> Json | list[Json]:
    """Return an object, or a list of objects with cameras, as OpenSfM's."""
    try:
        document = json.loads(content.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise
    except (ValueError, RecursionError) as error:
        reason = str(error) if isinstance(error, json.JSONDecodeError) else "a number or nesting too long"
        raise BrokenError(f"is not JSON ({reason}), nor another file of cameras; is it damaged?") from None
    if isinstance(document, list) and document and isinstance(document[0], dict) and "shots" in document[0]:
        return document
    if not isinstance(document, dict):
        raise BrokenError("is no file of cameras: its JSON must be an object; choose another file")
    return document


def _read_ours(path: Path, document: Json) -> list[Frame]:
    version = document[_OURS]
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise BrokenError(f"{_OURS} must be the number {_VERSION}, not {reprlib.repr(version)}")
    if version > _VERSION:
        newer = reprlib.repr(version)
        raise BrokenError(f"{_OURS} is {newer}, from a newer octex; this one reads {_VERSION}, update it")
    frames = []
    for number, record in enumerate(objects_field(document, "cameras")):
        with within(f"camera {number}"):
            name = text_field(record, "name")
        with within(f"frame {name!r}"):
            frames.append(_our_frame(path, name, record))
    return frames


def _our_frame(path: Path, name: str, record: Json) -> Frame:
    size = pixels_field(record, "width"), pixels_field(record, "height")
    orthographic = choice_field(record, "projection", ("pinhole", "orthographic")) == "orthographic"
    convention: Convention = (
        "opencv" if choice_field(record, "convention", ("opencv", "opengl")) == "opencv" else "opengl"
    )
    K, pose = matrix_field(record, "K", (3, 3)), matrix_field(record, "pose", (4, 4))
    model = DISTORTION_MODELS[0]
    if "distortion_model" in record:
        choice_field(record, "distortion_model", DISTORTION_MODELS)
        model = record["distortion_model"]
    distortion = numbers_field(record, "distortion", *COUNTS[model]) if "distortion" in record else None
    if orthographic and (model != "opencv" or (distortion is not None and distortion.any())):
        raise BrokenError("distortion must be zeros for an orthographic camera")
    with within("K"):
        camera = Camera.pinhole(
            size, pose=np.eye(4), convention="opencv", K=K, distortion_model=model,
            distortion=None if distortion is None else distortion.tolist(),
        )  # fmt: skip
    with within("pose"):
        view = view_of_pose(pose, convention)
    projection: Literal["pinhole", "orthographic"] = "orthographic" if orthographic else "pinhole"
    seen = _decoded(text_field(record, "view")) if "view" in record else None
    return Frame(name, None, size, path, fixed_lens(K), view, projection, camera.distortion, model, seen)


def _decoded(text: str) -> bytes:
    try:
        return b64decode(text, validate=True)
    except ValueError as error:
        raise BrokenError(f"view is no picture in base64 ({error}); draw the view again") from None


# transforms.json


def _read_transforms(path: Path, document: Json) -> list[Frame]:
    frames = []
    shared = {field: value for field, value in document.items() if field != "frames"}
    for number, record in enumerate(objects_field(document, "frames")):
        with within(f"frame {number}"):
            name = text_field(record, "file_path")
        with within(f"frame {name!r}"):
            frames.append(_transforms_frame(path, name, shared | record))
    return frames


def _transforms_frame(path: Path, name: str, record: Json) -> Frame:
    given = text_field(record, "camera_model") if "camera_model" in record else "OPENCV"
    if given not in _MODELS:
        raise BrokenError(
            f"camera_model {reprlib.repr(given)} is not known; undistort the pictures to one of "
            f"{', '.join(_MODELS)}"
        )
    model: DistortionModel = "fisheye" if record.get("is_fisheye") else _MODELS[given]
    for field in ("ftheta", "is_equirectangular", "equirectangular"):
        if record.get(field):
            raise BrokenError(f"{field} is set: such cameras are not known; undistort the pictures")
    size = (pixels_field(record, "w"), pixels_field(record, "h")) if "w" in record or "h" in record else None
    fields = ("k1", "k2", "p1", "p2", "k3", "k4")
    distortion = tuple(number_field(record, field, 0.0) for field in fields)
    if model == "fisheye":
        distortion = (*distortion, 0.0, 0.0)
    elif distortion[5] != 0.0:
        raise BrokenError("k4 must be zero: octex knows k1, k2, k3, p1, p2; undistort the pictures")
    else:
        distortion = distortion[:5]
    lens = _transforms_lens(record)
    pose = matrix_field(record, "transform_matrix", (4, 4), (3, 4))
    with within("transform_matrix"):
        view = view_of_pose(pose, "opengl")
    base = beside(path, name)
    tried = [Path(f"{base}{ending}") for ending in _ENDINGS]
    image = next((place for place in tried if is_file(place)), base)
    return Frame(name, image, size, path, lens, view, distortion=distortion, distortion_model=model)


def _transforms_lens(record: Json) -> Lens:
    x = positive_field(record, "fl_x") if "fl_x" in record else None
    y = positive_field(record, "fl_y") if "fl_y" in record else None
    across = down = None
    if x is None:
        if "camera_angle_x" not in record:
            raise BrokenError("fl_x is missing, and so is camera_angle_x; one of them must be given")
        across = focal_per_size(record, "camera_angle_x")
        down = focal_per_size(record, "camera_angle_y") if "camera_angle_y" in record else None
    center_x = number_field(record, "cx") if "cx" in record else None
    center_y = number_field(record, "cy") if "cy" in record else None

    def lens(width: int, height: int) -> Float64s:
        focal_x = across * width if across is not None else x
        focal_y = y if y is not None else down * height if down is not None else focal_x
        assert focal_x is not None
        assert focal_y is not None
        return intrinsics_of(
            focal_x,
            focal_y,
            width / 2 if center_x is None else center_x,
            height / 2 if center_y is None else center_y,
        )

    return lens
