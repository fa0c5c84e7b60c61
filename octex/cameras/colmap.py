"""Cameras of COLMAP's models, text and binary."""

from __future__ import annotations

import reprlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from octex.arrays import Float64s
from octex.cameras.camera import intrinsics
from octex.cameras.fields import BrokenError, Bytes, Record, reading, within
from octex.cameras.frames import Frame, Optics, image_path, is_file, rigid, rotation_of, view_matrix
from octex.cameras.lens import DistortionModel
from octex.errors import CameraError
from octex.files import read_bytes


class _ParameterCounts(NamedTuple):
    """Counts of the parameters of a camera model, in order: focal lengths, the centre, the distortion."""

    focals: int
    distortion: str = ""
    lens: DistortionModel = "opencv"

    @property
    def n_numbers(self) -> int:
        """Number of parameters."""
        return self.focals + 2 + len(self.distortion.split())


#: COLMAP's camera models, indexed by COLMAP's model id.
_MODELS = {
    "SIMPLE_PINHOLE": _ParameterCounts(1),
    "PINHOLE": _ParameterCounts(2),
    "SIMPLE_RADIAL": _ParameterCounts(1, "k1"),
    "RADIAL": _ParameterCounts(1, "k1 k2"),
    "OPENCV": _ParameterCounts(2, "k1 k2 p1 p2"),
    "OPENCV_FISHEYE": _ParameterCounts(2, "k1 k2 k3 k4", "fisheye"),
    "FULL_OPENCV": _ParameterCounts(2, "k1 k2 p1 p2 k3 k4 k5 k6"),
    "FOV": _ParameterCounts(2, "omega", "fov"),
    "SIMPLE_RADIAL_FISHEYE": _ParameterCounts(1, "k1", "fisheye"),
    "RADIAL_FISHEYE": _ParameterCounts(1, "k1 k2", "fisheye"),
    "THIN_PRISM_FISHEYE": _ParameterCounts(2, "k1 k2 p1 p2 k3 k4 sx1 sy1", "fisheye"),
}
#: Names of a model's files.
_FILES = ("cameras", "images", "points3D", "rigs", "frames")
_CAMERA, _IMAGE = "CAMERA_ID MODEL WIDTH HEIGHT", "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"


def find(path: Path) -> tuple[Path, str] | None:
    """Return the folder of a COLMAP model and the ending of its files; None for any other path."""
    if path.stem in _FILES and path.suffix in (".bin", ".txt"):
        return path.parent, path.suffix
    if not path.is_dir():
        return None
    for folder in (path, path / "sparse" / "0", path / "sparse", path / "0"):
        for ending in (".bin", ".txt"):
            if all(is_file(folder / f"{stem}{ending}") for stem in ("cameras", "images")):
                return folder, ending
    raise CameraError(
        f"{path}: has no COLMAP model; choose a folder with cameras.bin and images.bin, or cameras.txt and "
        "images.txt, or a camera file"
    )


def read(folder: Path, ending: str) -> list[Frame]:
    """Read the cameras and images of a folder whose files have this ending.

    COLMAP's workspaces have the images in ``images``, next to ``sparse`` or to a model's files.
    """
    cameras, images = folder / f"cameras{ending}", folder / f"images{ending}"
    is_binary = ending == ".bin"
    with reading(cameras):
        optics = dict((_cameras_binary if is_binary else _cameras)(read_bytes(cameras)))
    roots = (folder, *folder.absolute().parents[:2])
    root = next((root for root in roots if (root / "images").is_dir()), None)
    with reading(images):
        frames = []
        for name, pose, camera in list((_images_binary if is_binary else _images)(read_bytes(images))):
            with within(f"frame {name!r}"):
                if camera not in optics:
                    raise BrokenError(f"camera {camera} is not in {cameras.name}")
                view = rigid(rotation_of(pose[:4], "quaternion"), pose[4:])
                image = None if root is None else image_path(root / images.name, f"images/{name}")
                frames.append(Frame(name, images, optics[camera], view_matrix(view), image))
        return frames


def _optics(model: _ParameterCounts, record: Record) -> Optics:
    size = record.size()
    values = record.numbers("parameters", model.n_numbers).tolist()
    focal_x, focal_y = values[0], values[model.focals - 1]
    center_x, center_y, *bends = values[model.focals :]
    if not (focal_x > 0.0 and focal_y > 0.0):
        raise BrokenError(f"focal lengths must be above zero, not {focal_x:g} and {focal_y:g}")
    optics = Optics(size, intrinsics(focal_x, focal_y, center_x, center_y))
    return optics.bent(model.lens, model.distortion, bends)


def _model_of(name: str) -> _ParameterCounts:
    if name not in _MODELS:
        raise BrokenError(
            f"model {reprlib.repr(name)} is not known; undistort the images to one of {', '.join(_MODELS)}"
        )
    return _MODELS[name]


def _cameras_binary(content: bytes) -> Iterator[tuple[int, Optics]]:
    data = Bytes(content)
    with within("the number of cameras"):
        (count,) = data.take("Q")
    for number in range(1, count + 1):
        with within(f"camera {number} of {count}"):
            key, model_id, width, height = data.take("iiQQ")
            model = _model_of(dict(enumerate(_MODELS)).get(model_id, f"number {model_id}"))
            parameters = list(data.take(f"{model.n_numbers}d"))
            yield key, _optics(model, Record({"width": width, "height": height, "parameters": parameters}))


def _images_binary(content: bytes) -> Iterator[tuple[str, Float64s, int]]:
    data = Bytes(content)
    with within("the number of images"):
        (count,) = data.take("Q")
    for number in range(count):
        with within(f"image {number + 1} of {count}"):
            _, *pose, camera = data.take("i7di")
            name = data.text()
            data.piece(24 * data.take("Q")[0])
            yield name, _pose(name, pose), camera


def _pose(name: str, numbers: list[Any]) -> Float64s:
    field = "quaternion and translation"
    with within(f"frame {name!r}"):
        return Record({field: numbers}, are_texts=True).numbers(field, 7)


def _lines(content: bytes) -> Iterator[tuple[int, str]]:
    """Yield line numbers, from 1, and lines of a text, without comments."""
    for number, line in enumerate(content.decode("utf-8-sig").split("\n"), 1):
        if not line.startswith("#"):
            yield number, line.strip()


def _cameras(content: bytes) -> Iterator[tuple[int, Optics]]:
    for number, line in _lines(content):
        if not line:
            continue
        with within(f"line {number}"):
            key, name, width, height, *parameters = _columns(line, _CAMERA)
            model = _model_of(name)
            if len(parameters) != model.n_numbers:
                raise BrokenError(f"{name} must have {model.n_numbers} parameters, not {len(parameters)}")
            record = Record({"width": width, "height": height, "parameters": parameters}, are_texts=True)
            yield _camera_id(key), _optics(model, record)


def _images(content: bytes) -> Iterator[tuple[str, Float64s, int]]:
    lines = _lines(content)
    for number, line in lines:
        if not line:
            continue
        with within(f"line {number}"):
            _, *numbers, camera, name = _columns(line, _IMAGE, 9)
            pose, key = _pose(name, numbers), _camera_id(camera)
        points, text = next(lines, (0, ""))
        if len(text.split()) % 3:
            raise BrokenError(
                f"line {points}: must be the points of frame {name!r}, in threes; each image must have "
                "two lines, of which the second may be empty"
            )
        yield name, pose, key


def _columns(line: str, names: str, most: int = -1) -> list[str]:
    columns = line.split(maxsplit=most)
    if len(columns) < len(names.split()):
        raise BrokenError(f"must have the columns {names}, not only {len(columns)} of them")
    return columns


def _camera_id(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise BrokenError(f"CAMERA_ID must be a whole number, not {reprlib.repr(text)}") from None
