"""Cameras from files that people have, and to a file of our own.

glTF               .gltf, .glb: the cameras of the scene's nodes
transforms.json    NeRF, instant-ngp, nerfstudio: a JSON object with "frames"
COLMAP             a folder with cameras and images, .bin or .txt, or one of these files
octex cameras      a JSON object with "octex_cameras", as ``write_cameras`` writes it

What a file holds decides how it is read, not its name (but for COLMAP's files, which go by their names).
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import reprlib
import secrets
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.errors import ArgumentError, CameraError, OutputError
from octex.view.camera import NO_DISTORTION, Camera, Convention, Distortion

Floats = npt.NDArray[np.float64]
Json = dict[str, Any]

#: The intrinsics (3, 3) for a picture's width and height.
Lens = Callable[[int, int], Floats]

_OURS = "octex_cameras"
_VERSION = 1
_LARGEST = 1e30  # of a number in a file: its powers are still far from overflow
_SMALLEST = 1e-30  # above zero
_LARGEST_SIZE = 1_000_000
_LISTED = 10
_ENDINGS = ("", ".png", ".jpg", ".jpeg")

#: Models of transforms.json that are what ``Camera`` can be.
_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")

#: COLMAP's models in the order of their numbers, and how many parameters those have that are read.
_COLMAP_MODELS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE",
)  # fmt: skip
_COLMAP_PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8}


class Frame(NamedTuple):
    """A camera of a file; ``camera`` makes it."""

    name: str  # transforms.json: file_path; COLMAP: the image's name; glTF: the node's or camera's name
    image: Path | None  # where the file says that the picture is, which need not exist; transforms.json only
    size: tuple[int, int] | None  # (width, height), if the file says
    file: Path
    lens: Lens
    world_to_camera: Floats  # (4, 4), as Camera's
    projection: Literal["pinhole", "orthographic"] = "pinhole"
    distortion: Distortion = NO_DISTORTION

    def camera(self, size: tuple[int, int] | None = None) -> Camera:
        """Make the camera for a picture of ``size`` (width, height); default: the size that the file says.

        Raises CameraError if neither is known, if they differ, and if the camera is for pictures of another
        shape.
        """
        frame = f"frame {self.name!r} of {self.file}"
        if size is None and self.size is None:
            raise CameraError(f"{frame} does not say how large its picture is; give the size or the picture")
        if size is not None and self.size is not None and tuple(size) != self.size:
            raise CameraError(
                f"{frame} is for {self.size[0]}×{self.size[1]} pixels, the picture has {size[0]}×{size[1]}; "
                "give the picture that the camera was made for"
            )
        width, height = self.size or size or (0, 0)
        try:
            camera = Camera.pinhole(
                (width, height),
                pose=self.world_to_camera,
                convention="opencv",
                K=self.lens(width, height),
                distortion=self.distortion,
            )
        except _BrokenError as error:
            raise CameraError(f"{frame}: {error}") from None
        return replace(camera, projection=self.projection, world_to_camera=self.world_to_camera)


def read_cameras(path: str | os.PathLike[str]) -> list[Frame]:
    """Read the cameras of a file, or of a folder with a COLMAP model, in the file's order.

    Raises CameraError if there is no such file, if it is of no known kind, damaged or without cameras, and
    for cameras that octex does not know (fisheye and such).
    """
    path = Path(path)
    with _reading(path):
        folder = _colmap_folder(path)
    if folder is not None:
        frames = _read_colmap(*folder)
    else:
        with _reading(path):
            frames = _read_document(path, _content(path))
    if not frames:
        raise CameraError(f"{path}: has no cameras; choose another file")
    return frames


def find_frame(frames: Sequence[Frame], name: str) -> Frame:
    """Return the frame of that name; else of the same file name in whatever folder; else of the same stem.

    Raises CameraError listing names if there is none, or more than one.
    """
    keys: tuple[Callable[[str], str], ...] = (str, _file_name, lambda text: Path(_file_name(text)).stem)
    for key in keys:
        found = [frame for frame in frames if key(frame.name) == key(name)]
        if len(found) == 1:
            return found[0]
        if found:
            listing = _listing(frame.name for frame in found)
            raise CameraError(f"frame {name!r} may be {len(found)} frames: {listing}; give the whole name")
    raise CameraError(f"there is no frame {name!r}; there are: {_listing(frame.name for frame in frames)}")


def write_cameras(path: str | os.PathLike[str], cameras: Mapping[str, Camera]) -> None:
    """Write cameras, by name, to a JSON file that ``read_cameras`` reads back to the same bits.

    What stood at ``path`` is replaced when all is written, or not at all: raises OutputError if it cannot be.
    """
    entries = [json.dumps(_entry(name, camera), allow_nan=False) for name, camera in cameras.items()]
    head = f'{{"{_OURS}": {_VERSION}, "cameras": ['
    _replace(Path(path), (head + ",".join("\n" + entry for entry in entries) + "\n]}\n").encode("ascii"))


def _entry(name: str, camera: Camera) -> Json:
    return {
        "name": name,
        "width": camera.width,
        "height": camera.height,
        "projection": camera.projection,
        "K": camera.K.tolist(),
        "pose": camera.world_to_camera.tolist(),
        "convention": "opencv",
        "distortion": list(camera.distortion),
    }


def _replace(path: Path, content: bytes) -> None:
    temporary: Path | None = None
    try:
        real = Path(os.path.realpath(path))  # through links, so that a link stays one
        if real.exists() and not real.is_file():
            raise OutputError(f"{path}: is not a file that can be replaced; choose another name")
        new = real.with_name(f".octex-{secrets.token_hex(8)}")
        with new.open("xb") as file:
            temporary = new
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        new.replace(real)
        temporary = None
    except (OSError, ValueError) as error:  # ValueError: names that no file can have
        reason = getattr(error, "strerror", None) or str(error)
        raise OutputError(f"{path}: cannot be written: {reason}; choose another place") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


# What is wrong, and where


class _BrokenError(Exception):
    """Say what is wrong, without the file's name."""


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn what goes wrong while a file is read into a CameraError that names the file."""
    try:
        with np.errstate(all="ignore"):  # what overflows is found by its value
            yield
    except (_BrokenError, ArgumentError) as error:
        raise CameraError(f"{path}: {error}") from None
    except UnicodeDecodeError:
        raise CameraError(f"{path}: is not UTF-8 text; is the file damaged?") from None
    except (OSError, ValueError) as error:  # ValueError: names that no file can have
        reason = getattr(error, "strerror", None) or str(error)
        raise CameraError(f"{path}: cannot be read: {reason}; give a file of cameras") from error


@contextlib.contextmanager
def _within(place: str) -> Iterator[None]:
    """Put a place before what goes wrong in it."""
    try:
        yield
    except (_BrokenError, ArgumentError) as error:
        raise _BrokenError(f"{place}: {error}") from None


def _listing(names: Iterable[str]) -> str:
    known = [repr(name) for name in names]
    more = f" and {len(known) - _LISTED} more" if len(known) > _LISTED else ""
    return (", ".join(known[:_LISTED]) or "none") + more


def _file_name(name: str) -> str:
    return re.split(r"[/\\]", name)[-1]


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long a name, for example
        return False


def _content(path: Path) -> bytes:
    if path.exists() and not path.is_file():  # reading a device or a pipe may never end
        raise _BrokenError("is not a file; give a file of cameras")
    return path.read_bytes()


# Fields of JSON objects


def _get(record: Json, field: str, kind: type, what: str) -> Any:
    if field not in record:
        raise _BrokenError(f"{field} is missing; it must be {what}")
    if not isinstance(record[field], kind):
        raise _BrokenError(f"{field} must be {what}, not {reprlib.repr(record[field])}")
    return record[field]


def _text(record: Json, field: str) -> str:
    return str(_get(record, field, str, "a text"))


def _object(record: Json, field: str) -> Json:
    found: Json = _get(record, field, dict, "an object")
    return found


def _objects(record: Json, field: str) -> list[Json]:
    found: list[Json] = _get(record, field, list, "a list of objects")
    for item in found:
        if not isinstance(item, dict):
            raise _BrokenError(f"{field} must be a list of objects, not of {reprlib.repr(item)}")
    return found


def _choice(record: Json, field: str, choices: Sequence[str]) -> str:
    found = _text(record, field)
    if found not in choices:
        raise _BrokenError(f"{field} must be one of {', '.join(choices)}, not {reprlib.repr(found)}")
    return found


def _index(record: Json, field: str, items: Sequence[Any]) -> int:
    return _as_index(_get(record, field, object, "an index"), field, items)


def _as_index(value: object, field: str, items: Sequence[Any]) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < len(items):
        raise _BrokenError(f"{field} must be an index below {len(items)}, not {reprlib.repr(value)}")
    return value


def _as_number(value: object, field: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= _LARGEST:
        raise _BrokenError(f"{field} must be a finite number, not {reprlib.repr(value)}")
    return float(value)


def _number(record: Json, field: str, default: float | None = None) -> float:
    if default is not None and field not in record:
        return default
    return _as_number(_get(record, field, object, "a number"), field)


def _above_zero(record: Json, field: str, below: float = math.inf) -> float:
    number = _number(record, field)
    if not _SMALLEST <= number < below:
        limit = "" if below == math.inf else f" and below {below:g}"
        raise _BrokenError(f"{field} must be above zero{limit}, not {number:g}")
    return number


def _pixels(record: Json, field: str) -> int:
    number = _number(record, field)
    if not (1.0 <= number <= _LARGEST_SIZE and number.is_integer()):
        raise _BrokenError(f"{field} must be a whole number from 1 to {_LARGEST_SIZE}, not {number:g}")
    return int(number)


def _numbers(record: Json, field: str, count: int) -> Floats:
    found = _get(record, field, list, f"{count} numbers")
    if len(found) != count:
        raise _BrokenError(f"{field} must be {count} numbers, not {len(found)}")
    return np.array([_as_number(value, field) for value in found])


def _matrix(record: Json, field: str, *shapes: tuple[int, int]) -> Floats:
    what = "a matrix of " + " or ".join(f"{rows}×{columns}" for rows, columns in shapes) + " numbers"
    found = _get(record, field, list, what)
    widths = {len(row) if isinstance(row, list) else -1 for row in found}
    if not any(len(found) == rows and widths == {columns} for rows, columns in shapes):
        raise _BrokenError(f"{field} must be {what}, row by row")
    return np.array([[_as_number(value, field) for value in row] for row in found])


def _view(pose: Floats, convention: Convention) -> Floats:
    """Return a pose as a world-to-camera matrix; one that is that already, to the same bits."""
    view = Camera.pinhole((1, 1), pose=pose, convention=convention, focal=1.0).world_to_camera
    exact = convention == "opencv" and pose.shape == (4, 4) and np.allclose(view, pose, rtol=0.0, atol=1e-12)
    return pose if exact else view


def _fixed(K: Floats) -> Lens:
    return lambda *_: K


def _intrinsics(x: float, y: float, center_x: float, center_y: float) -> Floats:
    return np.array([[x, 0.0, center_x], [0.0, y, center_y], [0.0, 0.0, 1.0]])


# JSON files


def _read_document(path: Path, content: bytes) -> list[Frame]:
    if content.startswith(b"glTF"):
        return _read_gltf(path, _parsed(_json_chunk(content)))
    document = _parsed(content)
    if _OURS in document:
        return _read_ours(path, document)
    if "frames" in document:
        return _read_transforms(path, document)
    if "asset" in document:
        return _read_gltf(path, document)
    raise _BrokenError(
        "is no file of cameras; give a .gltf or .glb file, a transforms.json, a COLMAP model or a file that "
        "octex wrote"
    )


def _parsed(content: bytes) -> Json:
    try:
        document = json.loads(content.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise
    except (ValueError, RecursionError) as error:
        reason = str(error) if isinstance(error, json.JSONDecodeError) else "a number or nesting too long"
        raise _BrokenError(f"is not JSON ({reason}), nor another file of cameras; is it damaged?") from None
    if not isinstance(document, dict):
        raise _BrokenError("is no file of cameras: its JSON must be an object; choose another file")
    return document


def _read_ours(path: Path, document: Json) -> list[Frame]:
    version = document[_OURS]
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise _BrokenError(f"{_OURS} must be the number {_VERSION}, not {reprlib.repr(version)}")
    if version > _VERSION:
        newer = reprlib.repr(version)
        raise _BrokenError(f"{_OURS} is {newer}, from a newer octex; this one reads {_VERSION}, update it")
    frames = []
    for number, record in enumerate(_objects(document, "cameras")):
        with _within(f"camera {number}"):
            name = _text(record, "name")
        with _within(f"frame {name!r}"):
            frames.append(_our_frame(path, name, record))
    return frames


def _our_frame(path: Path, name: str, record: Json) -> Frame:
    size = _pixels(record, "width"), _pixels(record, "height")
    orthographic = _choice(record, "projection", ("pinhole", "orthographic")) == "orthographic"
    convention: Convention = (
        "opencv" if _choice(record, "convention", ("opencv", "opengl")) == "opencv" else "opengl"
    )
    K, pose = _matrix(record, "K", (3, 3)), _matrix(record, "pose", (4, 4))
    distortion = _numbers(record, "distortion", 4) if "distortion" in record else np.zeros(4)
    if orthographic and distortion.any():
        raise _BrokenError("distortion must be zeros for an orthographic camera")
    with _within("K"):
        camera = Camera.pinhole(
            size, pose=np.eye(4), convention="opencv", K=K, distortion=distortion.tolist()
        )
    with _within("pose"):
        view = _view(pose, convention)
    projection: Literal["pinhole", "orthographic"] = "orthographic" if orthographic else "pinhole"
    return Frame(name, None, size, path, _fixed(K), view, projection, camera.distortion)


# transforms.json


def _read_transforms(path: Path, document: Json) -> list[Frame]:
    frames = []
    shared = {field: value for field, value in document.items() if field != "frames"}
    for number, record in enumerate(_objects(document, "frames")):
        with _within(f"frame {number}"):
            name = _text(record, "file_path")
        with _within(f"frame {name!r}"):
            frames.append(_transforms_frame(path, name, shared | record))
    return frames


def _transforms_frame(path: Path, name: str, record: Json) -> Frame:
    if "camera_model" in record and _text(record, "camera_model") not in _MODELS:
        model = reprlib.repr(record["camera_model"])
        raise _BrokenError(
            f"camera_model {model} is not known; undistort the pictures to one of {', '.join(_MODELS)}"
        )
    for field in ("k3", "k4"):
        if _number(record, field, 0.0) != 0.0:
            raise _BrokenError(f"{field} must be zero: octex knows k1, k2, p1, p2; undistort the pictures")
    for field in ("is_fisheye", "ftheta", "is_equirectangular", "equirectangular"):
        if record.get(field):
            raise _BrokenError(f"{field} is set: such cameras are not known; undistort the pictures")
    size = (_pixels(record, "w"), _pixels(record, "h")) if "w" in record or "h" in record else None
    k1, k2, p1, p2 = (_number(record, field, 0.0) for field in ("k1", "k2", "p1", "p2"))
    lens = _transforms_lens(record)
    pose = _matrix(record, "transform_matrix", (4, 4), (3, 4))
    with _within("transform_matrix"):
        view = _view(pose, "opengl")
    base = path.parent / name
    tried = [Path(f"{base}{ending}") for ending in _ENDINGS]
    image = next((place for place in tried if _is_file(place)), base)
    return Frame(name, image, size, path, lens, view, distortion=(k1, k2, p1, p2))


def _transforms_lens(record: Json) -> Lens:
    x = _above_zero(record, "fl_x") if "fl_x" in record else None
    y = _above_zero(record, "fl_y") if "fl_y" in record else None
    across = down = None
    if x is None:
        if "camera_angle_x" not in record:
            raise _BrokenError("fl_x is missing, and so is camera_angle_x; one of them must be given")
        across = _focal_per_size(record, "camera_angle_x")
        down = _focal_per_size(record, "camera_angle_y") if "camera_angle_y" in record else None
    center_x = _number(record, "cx") if "cx" in record else None
    center_y = _number(record, "cy") if "cy" in record else None

    def lens(width: int, height: int) -> Floats:
        focal_x = across * width if across is not None else x
        focal_y = y if y is not None else down * height if down is not None else focal_x
        assert focal_x is not None
        assert focal_y is not None
        return _intrinsics(
            focal_x,
            focal_y,
            width / 2 if center_x is None else center_x,
            height / 2 if center_y is None else center_y,
        )

    return lens


def _focal_per_size(record: Json, field: str) -> float:
    """Return the focal length, in pictures, for the angle across a picture."""
    return 0.5 / math.tan(_above_zero(record, field, below=math.pi) / 2)


# glTF


def _json_chunk(content: bytes) -> bytes:
    if len(content) < 20:
        raise _BrokenError("ends in its header; copy or export it again")
    version, _, length, kind = struct.unpack_from("<IIII", content, 4)
    if version != 2:
        raise _BrokenError(f"is glTF {version}; octex reads glTF 2, export it as that")
    if kind != 0x4E4F534A:
        raise _BrokenError("does not begin with a JSON chunk; export it again")
    if length > len(content) - 20:
        raise _BrokenError("ends in its JSON chunk; copy or export it again")
    return content[20 : 20 + length]


def _read_gltf(path: Path, document: Json) -> list[Frame]:
    nodes = _objects(document, "nodes") if "nodes" in document else []
    cameras = _objects(document, "cameras") if "cameras" in document else []
    frames: list[Frame] = []
    names: set[str] = set()
    for number, to_world in _scene_nodes(document, nodes):
        if "camera" not in nodes[number]:
            continue
        with _within(f"node {number}"):
            index = _index(nodes[number], "camera", cameras)
            name = _gltf_name(nodes[number], cameras[index], index, names)
        with _within(f"frame {name!r}"):
            lens, projection = _gltf_lens(cameras[index])
            frames.append(Frame(name, None, None, path, lens, _gltf_view(to_world), projection))
    return frames


def _scene_nodes(document: Json, nodes: list[Json]) -> Iterator[tuple[int, Floats]]:
    """Yield the scene's nodes, and the matrices (4, 4) that take them to the world, parents first."""
    roots = list(range(len(nodes)))
    children = [_links(node, f"node {number}", "children", nodes) for number, node in enumerate(nodes)]
    if document.get("scenes"):
        scenes = _objects(document, "scenes")
        number = _index(document, "scene", scenes) if "scene" in document else 0
        roots = _links(scenes[number], f"scene {number}", "nodes", nodes)
    else:
        roots = sorted(set(roots).difference(*children))
    pending = [(root, np.eye(4)) for root in reversed(roots)]
    seen: set[int] = set()
    while pending:
        number, parent = pending.pop()
        if number in seen:
            raise _BrokenError(f"node {number} stands twice in the scene; a node must have one parent")
        seen.add(number)
        with _within(f"node {number}"):
            to_world = parent @ _local(nodes[number])
        yield number, to_world
        pending.extend((child, to_world) for child in reversed(children[number]))


def _links(record: Json, place: str, field: str, nodes: list[Json]) -> list[int]:
    if field not in record:
        return []
    with _within(place):
        return [_as_index(value, field, nodes) for value in _get(record, field, list, "a list of indices")]


def _local(node: Json) -> Floats:
    if "matrix" in node:
        return _numbers(node, "matrix", 16).reshape(4, 4).T
    local = np.eye(4)
    if "rotation" in node:
        x, y, z, w = _numbers(node, "rotation", 4)
        local[:3, :3] = _rotation(np.array([w, x, y, z]), "rotation")
    if "scale" in node:
        local[:3, :3] *= _numbers(node, "scale", 3)
    if "translation" in node:
        local[:3, 3] = _numbers(node, "translation", 3)
    return local


def _rotation(quaternion: Floats, field: str) -> Floats:
    """Return the matrix (3, 3) of a quaternion w, x, y, z of any length."""
    length = float(np.linalg.norm(quaternion))
    if not length > 0.0:
        raise _BrokenError(f"{field} must not be zero")
    w, x, y, z = quaternion / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _gltf_name(node: Json, camera: Json, index: int, names: set[str]) -> str:
    """Return a name that is not in ``names`` yet, and put it there."""
    wanted = next(
        (_text(record, "name") for record in (node, camera) if record.get("name")), f"camera_{index}"
    )
    name, count = wanted, 1
    while name in names:
        count += 1
        name = f"{wanted}_{count}"
    names.add(name)
    return name


def _gltf_lens(camera: Json) -> tuple[Lens, Literal["pinhole", "orthographic"]]:
    if _choice(camera, "type", ("perspective", "orthographic")) == "perspective":
        fields = _object(camera, "perspective")
        with _within("perspective"):
            focal = _focal_per_size(fields, "yfov")
        return lambda width, height: _centred(focal * height, width, height), "pinhole"
    fields = _object(camera, "orthographic")
    with _within("orthographic"):
        x, y = _above_zero(fields, "xmag"), _above_zero(fields, "ymag")

    def lens(width: int, height: int) -> Floats:
        across, down = width / (2 * x), height / (2 * y)
        if abs(across - down) > 0.01 * down:
            raise _BrokenError(
                f"xmag {x:g} and ymag {y:g} are not of the shape of a picture of {width}×{height} pixels; "
                "give one of their shape"
            )
        return _centred(down, width, height)

    return lens, "orthographic"


def _centred(focal: float, width: int, height: int) -> Floats:
    return _intrinsics(focal, focal, width / 2, height / 2)


def _gltf_view(to_world: Floats) -> Floats:
    pose = to_world.copy()
    lengths = np.linalg.norm(pose[:3, :3], axis=0)
    if not (np.isfinite(pose).all() and (lengths > 0.0).all() and np.isfinite(lengths).all()):
        raise _BrokenError("its node, with the nodes above it, must not scale to nothing or to infinity")
    pose[:3, :3] /= lengths
    return _view(pose, "opengl")


# COLMAP


def _colmap_folder(path: Path) -> tuple[Path, str] | None:
    """Return the folder of a COLMAP model and the ending of its files; None for files of other kinds."""
    if path.name in {f"{stem}{ending}" for stem in ("cameras", "images") for ending in (".bin", ".txt")}:
        return path.parent, path.suffix
    if not path.is_dir():
        return None
    for folder in (path, path / "sparse" / "0", path / "sparse"):
        for ending in (".bin", ".txt"):
            if all(_is_file(folder / f"{stem}{ending}") for stem in ("cameras", "images")):
                return folder, ending
    raise CameraError(
        f"{path}: has no COLMAP model; choose a folder with cameras.bin and images.bin, or cameras.txt and "
        "images.txt, or a file of cameras"
    )


class _Optics(NamedTuple):
    size: tuple[int, int]
    K: Floats
    distortion: Distortion


def _read_colmap(folder: Path, ending: str) -> list[Frame]:
    optics_path, images_path = folder / f"cameras{ending}", folder / f"images{ending}"
    with _reading(optics_path):
        content = _content(optics_path)
        optics = dict((_optics_binary if ending == ".bin" else _optics_text)(content))
    with _reading(images_path):
        content = _content(images_path)
        images = (_images_binary if ending == ".bin" else _images_text)(content)
        return [_colmap_frame(images_path, image, optics) for image in images]


def _colmap_frame(path: Path, image: tuple[str, list[float], int], optics: dict[int, _Optics]) -> Frame:
    name, numbers, camera = image
    with _within(f"frame {name!r}"):
        values = np.array([_as_number(value, "quaternion and translation") for value in numbers])
        pose = np.eye(4)
        pose[:3, :3] = _rotation(values[:4], "quaternion")
        pose[:3, 3] = values[4:]
        if camera not in optics:
            raise _BrokenError(f"camera {camera} does not stand in {path.with_stem('cameras').name}")
        size, K, distortion = optics[camera]
        return Frame(name, None, size, path, _fixed(K), _view(pose, "opencv"), distortion=distortion)


def _optics(model: str, width: int, height: int, parameters: Sequence[float]) -> _Optics:
    record: Json = {"width": width, "height": height}
    size = _pixels(record, "width"), _pixels(record, "height")
    values = [_as_number(value, "parameters") for value in parameters]
    if model in ("PINHOLE", "OPENCV"):
        focal_x, focal_y, center_x, center_y, *rest = values
    else:
        focal_x, center_x, center_y, *rest = values
        focal_y = focal_x
    if not (focal_x > 0.0 and focal_y > 0.0):
        raise _BrokenError(f"focal lengths must be above zero, not {focal_x:g} and {focal_y:g}")
    k1, k2, p1, p2 = [*rest, 0.0, 0.0, 0.0, 0.0][:4]
    return _Optics(size, _intrinsics(focal_x, focal_y, center_x, center_y), (k1, k2, p1, p2))


def _parameters_of(model: str) -> int:
    if model not in _COLMAP_PARAMETERS:
        known = ", ".join(_COLMAP_PARAMETERS)
        raise _BrokenError(
            f"model {reprlib.repr(model)} is not known; undistort the pictures to one of {known}"
        )
    return _COLMAP_PARAMETERS[model]


class _Bytes:
    """Bytes that are read from the front."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """Return the next values, little-endian."""
        start = self._at
        self.skip(struct.calcsize(f"<{layout}"))
        return struct.unpack_from(f"<{layout}", self._content, start)

    def skip(self, count: int) -> None:
        """Leave out bytes."""
        if count > len(self._content) - self._at:
            raise _BrokenError("the file ends here; copy or export it again")
        self._at += count

    def text(self) -> str:
        """Return what stands before the next zero, and leave out both."""
        start, end = self._at, self._content.find(b"\0", self._at)
        if end < 0:
            raise _BrokenError("the file ends in a name; copy or export it again")
        self._at = end + 1
        return self._content[start:end].decode("utf-8")


def _optics_binary(content: bytes) -> Iterator[tuple[int, _Optics]]:
    data = _Bytes(content)
    with _within("the number of cameras"):
        (count,) = data.take("Q")
    for number in range(count):
        with _within(f"camera {number + 1} of {count}"):
            key, model, width, height = data.take("iiQQ")
            name = _COLMAP_MODELS[model] if 0 <= model < len(_COLMAP_MODELS) else f"number {model}"
            parameters = data.take(f"{_parameters_of(name)}d")
            yield key, _optics(name, width, height, parameters)


def _images_binary(content: bytes) -> Iterator[tuple[str, list[float], int]]:
    data = _Bytes(content)
    with _within("the number of images"):
        (count,) = data.take("Q")
    for number in range(count):
        with _within(f"image {number + 1} of {count}"):
            _, *numbers, camera = data.take("i7di")
            name = data.text()
            (points,) = data.take("Q")
            data.skip(points * 24)
        yield name, numbers, camera


def _lines(content: bytes) -> Iterator[tuple[int, str]]:
    """Yield a text's lines but for comments, and their numbers from 1."""
    for number, line in enumerate(content.decode("utf-8-sig").split("\n"), 1):
        if not line.startswith("#"):
            yield number, line.strip()


def _optics_text(content: bytes) -> Iterator[tuple[int, _Optics]]:
    for number, line in _lines(content):
        if not line:
            continue
        with _within(f"line {number}"):
            key, model, width, height, *parameters = _columns(line.split(), 4, "CAMERA_ID MODEL WIDTH HEIGHT")
            count = _parameters_of(model)
            if len(parameters) != count:
                raise _BrokenError(f"{model} must have {count} parameters, not {len(parameters)}")
            values = [_float(value, "parameters") for value in parameters]
            yield (
                _int(key, "CAMERA_ID"),
                _optics(model, _int(width, "WIDTH"), _int(height, "HEIGHT"), values),
            )


def _images_text(content: bytes) -> Iterator[tuple[str, list[float], int]]:
    lines = _lines(content)
    for number, line in lines:
        if not line:
            continue
        with _within(f"line {number}"):
            columns = _columns(line.split(maxsplit=9), 10, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
            with _within(f"frame {columns[9]!r}"):
                numbers = [_float(value, "quaternion and translation") for value in columns[1:8]]
                camera = _int(columns[8], "CAMERA_ID")
        points, text = next(lines, (0, ""))
        if len(text.split()) % 3:
            raise _BrokenError(
                f"line {points}: must be the points of frame {columns[9]!r}, in threes; each image must have "
                "two lines, of which the second may be empty"
            )
        yield columns[9], numbers, camera


def _columns(columns: list[str], least: int, names: str) -> list[str]:
    if len(columns) < least:
        raise _BrokenError(f"must have the columns {names}, not only {len(columns)} of them")
    return columns


def _int(text: str, field: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise _BrokenError(f"{field} must be a whole number, not {reprlib.repr(text)}") from None


def _float(text: str, field: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise _BrokenError(f"{field} must be numbers, not {reprlib.repr(text)}") from None
