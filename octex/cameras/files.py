"""Reads cameras of many formats, and writes octex's format.

glTF               .gltf, .glb: the cameras of the scene's nodes
transforms.json    NeRF, instant-ngp, nerfstudio: a JSON object with "frames"
COLMAP             a folder with cameras and images, .bin or .txt, or one of these files
Metashape          .xml, exported as Agisoft XML
OpenMVS            .mvs: a scene
Meshroom           .sfm: JSON that AliceVision's StructureFromMotion writes
OpenSfM            reconstruction.json, also of OpenDroneMap
OpenMVG            sfm_data.json
Bundler            .out, with the list of images in the same folder
octex cameras      a JSON object with "octex_cameras", as ``write_cameras`` writes it
arrays             .npz: ``viewmats`` and ``Ks`` as in gsplat, and more; see `octex.cameras.arrays`

The content of a file selects the reader. Only COLMAP's files are selected by name.
"""

from __future__ import annotations

import codecs
import json
import os
import reprlib
from base64 import b64decode, b64encode
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from octex.cameras import arrays, colmap, gltf, metashape, openmvs, sfm, transforms
from octex.cameras.camera import Camera
from octex.cameras.fields import BrokenError, Record, reading, within
from octex.cameras.frames import Frame as Frame
from octex.cameras.frames import file_name, frame_of
from octex.checks import as_entries, as_path
from octex.errors import ArgumentError, CameraError, OutputError
from octex.files import listing, read_bytes, replacing

#: The field that marks octex's format; its value is the version.
MARK = "octex_cameras"
_VERSION = 1
_LISTED = 10
_UNKNOWN = (
    "is not a camera file; give a .gltf or .glb file, a transforms.json, a COLMAP model, Metashape's "
    ".xml, OpenMVS's .mvs, Meshroom's .sfm, OpenSfM's reconstruction.json, OpenMVG's sfm_data.json, "
    "Bundler's .out, an .npz of viewmats and Ks, or a file that octex wrote"
)


def read_cameras(path: str | os.PathLike[str]) -> list[Frame]:
    """Read the cameras of a file or of a folder with a COLMAP model, in the file's order.

    Raises CameraError for a missing, unknown or damaged file, for a file without cameras, and for camera
    models that octex does not support (equirectangular and others).
    """
    path = as_path(path, refusal=CameraError)
    with reading(path):
        model = colmap.find(path)
    if model is not None:
        frames = colmap.read(*model)
    else:
        with reading(path):
            frames = _read(path, read_bytes(path))
    if not frames:
        raise CameraError(f"{path}: has no cameras; choose another file")
    return frames


def _read(path: Path, content: bytes) -> list[Frame]:
    for mark, read in _BY_MARK.items():
        if content.startswith(mark):
            return read(path, content)
    if content.removeprefix(codecs.BOM_UTF8).lstrip().startswith(b"<"):
        return metashape.read(path, content)
    text = content.decode("utf-8-sig")
    if text.strip() and not text.lstrip().startswith(("{", "[")):
        raise BrokenError(_UNKNOWN)
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = str(error) if isinstance(error, json.JSONDecodeError) else "a number or nesting too long"
        raise BrokenError(f"is not JSON ({reason}), nor another camera file; export it again") from None
    if isinstance(document, list) and document and isinstance(document[0], dict) and "shots" in document[0]:
        return sfm.read_opensfm(path, document)
    if not isinstance(document, dict):
        raise BrokenError("is not a camera file: its JSON must be an object; choose another file")
    for fields, read_fields in _BY_FIELDS.items():
        if all(field in document for field in fields):
            return read_fields(path, document)
    if "asset" in document:
        return gltf.read(path, content)
    raise BrokenError(_UNKNOWN)


def _read_octex(path: Path, document: dict[str, Any]) -> list[Frame]:
    version = document[MARK]
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise BrokenError(f"{MARK} must be the number {_VERSION}, not {reprlib.repr(version)}")
    if version > _VERSION:
        raise BrokenError(
            f"{MARK} is {reprlib.repr(version)}, from a newer octex; this one reads {_VERSION}, update it"
        )
    frames = []
    for number, record in enumerate(Record(document).records("cameras")):
        with within(f"camera {number}"):
            name = record.text("name")
        with within(f"frame {name!r}"):
            frame = frame_of(path, name, record, record.size())
            try:
                view = b64decode(record.text("view"), validate=True) if "view" in record else None
            except ValueError as error:
                raise BrokenError(f"view is not an image in base64 ({error}); draw the view again") from None
            frames.append(frame._replace(view=view, image=path.parent / name))
    return frames


#: Readers, selected by the first bytes of a file ...
_BY_MARK: dict[bytes, Callable[[Path, bytes], list[Frame]]] = {
    b"glTF": gltf.read,
    arrays.MARK: arrays.read,
    openmvs.MARK: openmvs.read,
    sfm.BUNDLER_MARK: sfm.read_bundler,
}
#: ... or by the fields of a JSON object.
_BY_FIELDS: dict[tuple[str, ...], Callable[[Path, dict[str, Any]], list[Frame]]] = {
    (MARK,): _read_octex,
    ("frames",): transforms.read,
    ("views", "poses"): sfm.read_meshroom,
    ("views", "extrinsics"): sfm.read_openmvg,
    ("views", "intrinsics"): sfm.read_meshroom,  # it may lack poses
}


#: Parts of a name by which frames are found, the most certain one first.
_KEYS: tuple[Callable[[str], str], ...] = (str, file_name, lambda text: Path(file_name(text)).stem)


def has_frame(frames: Sequence[Frame], name: str) -> bool:
    """Return whether `find_frame` finds one frame or several."""
    return any(key(frame.name) == key(name) for key in _KEYS for frame in frames)


def find_frame(frames: Sequence[Frame], name: str, file: Path) -> Frame:
    """Return a file's frame of this name, or else of the same file name in any folder, or of the same stem.

    Raises CameraError, which names the file and lists names, for no match or several.
    """
    for key in _KEYS:
        matches = [frame for frame in frames if key(frame.name) == key(name)]
        if len(matches) == 1:
            return matches[0]
        if matches:
            names = listing([frame.name for frame in matches], _LISTED)
            raise CameraError(
                f"{file}: frame {name!r} may be {len(matches)} frames: {names}; give the whole name"
            )
    names = listing([frame.name for frame in frames], _LISTED)
    raise CameraError(f"{file}: there is no frame {name!r}; there are: {names}")


def write_cameras(
    path: str | os.PathLike[str], cameras: Mapping[str, Camera], views: Mapping[str, bytes] | None = None
) -> None:
    """Write cameras, by name, to a JSON file; ``read_cameras`` returns bit-identical cameras.

    ``views`` are PNG bytes of the views that octex drew, by the same names; ``Frame.view`` returns them.

    The file is replaced completely or not at all. Raises OutputError if it cannot be written.
    """
    path = as_path(path, refusal=OutputError)
    for name, camera in as_entries(cameras, "cameras").items():
        if not isinstance(camera, Camera):
            raise ArgumentError(f"camera {name!r} must be an octex.Camera, not {camera!r}")
    views = {} if views is None else as_entries(views, "views")
    for name, view in views.items():
        if name not in cameras or not isinstance(view, bytes):
            raise ArgumentError(f"view {name!r} must be the bytes of a PNG file, for one of the cameras")
    records = (_record(name, camera, views.get(name)) for name, camera in cameras.items())
    lines = [json.dumps(record, allow_nan=False) for record in records]
    head = f'{{"{MARK}": {_VERSION}, "cameras": ['
    with replacing(path) as file:
        file.write((head + ",".join("\n" + line for line in lines) + "\n]}\n").encode("ascii"))


def _record(name: str, camera: Camera, view: bytes | None) -> dict[str, Any]:
    """Return the fields of a camera in octex's format."""
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
