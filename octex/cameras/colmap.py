"""Cameras of COLMAP's models, as text and binary."""

from __future__ import annotations

import reprlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from octex.cameras.fields import (
    BrokenError,
    Bytes,
    Frame,
    Optics,
    as_finite,
    intrinsics_of,
    is_file,
    reading,
    rotation_of,
    size_of,
    view_of_pose,
    within,
)
from octex.cameras.lens import DistortionModel
from octex.errors import CameraError
from octex.files import read_bytes


class _Model(NamedTuple):
    """One of COLMAP's models: focal length or lengths, centre, and numbers of the distortion."""

    focals: int
    distortion: int
    lens: DistortionModel = "opencv"


#: COLMAP's models in the order of their numbers.
_COLMAP_MODELS = {
    "SIMPLE_PINHOLE": _Model(1, 0),
    "PINHOLE": _Model(2, 0),
    "SIMPLE_RADIAL": _Model(1, 1),
    "RADIAL": _Model(1, 2),
    "OPENCV": _Model(2, 4),
    "OPENCV_FISHEYE": _Model(2, 4, "fisheye"),
    "FULL_OPENCV": _Model(2, 8),
    "FOV": _Model(2, 1, "fov"),
    "SIMPLE_RADIAL_FISHEYE": _Model(1, 1, "fisheye"),
    "RADIAL_FISHEYE": _Model(1, 2, "fisheye"),
    "THIN_PRISM_FISHEYE": _Model(2, 8, "fisheye"),
}
#: How many numbers a distortion has at least, where COLMAP leaves out the last ones.
_LEAST: dict[DistortionModel, int] = {"opencv": 4, "fisheye": 4, "fov": 1}


def colmap_folder(path: Path) -> tuple[Path, str] | None:
    """Return the folder of a COLMAP model and the ending of its files; None for files of other kinds."""
    if path.name in {f"{stem}{ending}" for stem in ("cameras", "images") for ending in (".bin", ".txt")}:
        return path.parent, path.suffix
    if not path.is_dir():
        return None
    for folder in (path, path / "sparse" / "0", path / "sparse"):
        for ending in (".bin", ".txt"):
            if all(is_file(folder / f"{stem}{ending}") for stem in ("cameras", "images")):
                return folder, ending
    raise CameraError(
        f"{path}: has no COLMAP model; choose a folder with cameras.bin and images.bin, or cameras.txt and "
        "images.txt, or a file of cameras"
    )


def read_colmap(folder: Path, ending: str) -> list[Frame]:
    """Read the cameras and images of a folder whose files have an ending."""
    optics_path, images_path = folder / f"cameras{ending}", folder / f"images{ending}"
    with reading(optics_path):
        content = read_bytes(optics_path)
        optics = dict((_optics_binary if ending == ".bin" else _optics_text)(content))
    with reading(images_path):
        content = read_bytes(images_path)
        images = (_images_binary if ending == ".bin" else _images_text)(content)
        return [_colmap_frame(images_path, image, optics) for image in images]


def _colmap_frame(path: Path, image: tuple[str, list[float], int], optics: dict[int, Optics]) -> Frame:
    name, numbers, camera = image
    with within(f"frame {name!r}"):
        values = np.array([as_finite(value, "quaternion and translation") for value in numbers])
        pose = np.eye(4)
        pose[:3, :3] = rotation_of(values[:4], "quaternion")
        pose[:3, 3] = values[4:]
        if camera not in optics:
            raise BrokenError(f"camera {camera} does not stand in {path.with_stem('cameras').name}")
        return optics[camera].frame(name, path, view_of_pose(pose, "opencv"))


def _optics(model: str, width: int, height: int, parameters: Sequence[float]) -> Optics:
    size = size_of(width, height)
    values = [as_finite(value, "parameters") for value in parameters]
    focals, count, lens = _COLMAP_MODELS[model]
    focal_x, focal_y = values[0], values[focals - 1]
    center_x, center_y, *rest = values[focals:]
    if not (focal_x > 0.0 and focal_y > 0.0):
        raise BrokenError(f"focal lengths must be above zero, not {focal_x:g} and {focal_y:g}")
    rest += [0.0] * (_LEAST[lens] - count)
    return Optics(size, intrinsics_of(focal_x, focal_y, center_x, center_y), tuple(rest), lens)


def _parameters_of(model: str) -> int:
    if model not in _COLMAP_MODELS:
        known = ", ".join(_COLMAP_MODELS)
        raise BrokenError(
            f"model {reprlib.repr(model)} is not known; undistort the pictures to one of {known}"
        )
    return _COLMAP_MODELS[model].focals + 2 + _COLMAP_MODELS[model].distortion


def _optics_binary(content: bytes) -> Iterator[tuple[int, Optics]]:
    data = Bytes(content)
    with within("the number of cameras"):
        (count,) = data.take("Q")
    for number in range(count):
        with within(f"camera {number + 1} of {count}"):
            key, model, width, height = data.take("iiQQ")
            known = 0 <= model < len(_COLMAP_MODELS)
            name = list(_COLMAP_MODELS)[model] if known else f"number {model}"
            parameters = data.take(f"{_parameters_of(name)}d")
            yield key, _optics(name, width, height, parameters)


def _images_binary(content: bytes) -> Iterator[tuple[str, list[float], int]]:
    data = Bytes(content)
    with within("the number of images"):
        (count,) = data.take("Q")
    for number in range(count):
        with within(f"image {number + 1} of {count}"):
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


def _optics_text(content: bytes) -> Iterator[tuple[int, Optics]]:
    for number, line in _lines(content):
        if not line:
            continue
        with within(f"line {number}"):
            key, model, width, height, *parameters = _columns(line.split(), 4, "CAMERA_ID MODEL WIDTH HEIGHT")
            count = _parameters_of(model)
            if len(parameters) != count:
                raise BrokenError(f"{model} must have {count} parameters, not {len(parameters)}")
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
        with within(f"line {number}"):
            columns = _columns(line.split(maxsplit=9), 10, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
            with within(f"frame {columns[9]!r}"):
                numbers = [_float(value, "quaternion and translation") for value in columns[1:8]]
                camera = _int(columns[8], "CAMERA_ID")
        points, text = next(lines, (0, ""))
        if len(text.split()) % 3:
            raise BrokenError(
                f"line {points}: must be the points of frame {columns[9]!r}, in threes; each image must have "
                "two lines, of which the second may be empty"
            )
        yield columns[9], numbers, camera


def _columns(columns: list[str], least: int, names: str) -> list[str]:
    if len(columns) < least:
        raise BrokenError(f"must have the columns {names}, not only {len(columns)} of them")
    return columns


def _int(text: str, field: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise BrokenError(f"{field} must be a whole number, not {reprlib.repr(text)}") from None


def _float(text: str, field: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise BrokenError(f"{field} must be numbers, not {reprlib.repr(text)}") from None
