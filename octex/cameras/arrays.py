"""Cameras from numpy arrays in an .npz file, named as in gsplat and similar projects.

viewmats       (n, 4, 4), or w2c or extrinsics: world-to-camera, OpenCV's axes (x right, y down, z forward);
               or instead of it
camtoworlds    (n, 4, 4), or c2w or poses: camera-to-world, in the axes of ``convention``
Ks             (n, 3, 3), or K or intrinsics (3, 3) for all: in pixels, with pixel centres at (i+½, j+½)
convention     "opencv" or "opengl" (required with camtoworlds): the camera's axes
width, height  image size, a number or (n,); default: the size of the images
names          (n,) texts: the images' file names; default: camera numbers from 0
distortion     (n, numbers) or (numbers,), and distortion_model: see `octex.Camera`
"""

from __future__ import annotations

import io
import reprlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from octex.arrays import Array, Float64s
from octex.cameras.camera import LARGEST
from octex.cameras.fields import BrokenError, Record, within
from octex.cameras.frames import Frame, frame_of
from octex.npz import read_npz

#: The first bytes of an .npz file.
MARK = b"PK"
_VIEWS, _POSES = ("viewmats", "w2c", "extrinsics"), ("camtoworlds", "c2w", "poses")
_INTRINSICS = ("Ks", "K", "intrinsics")
_SHAPES = ((4, 4), (3, 4))


def read(path: Path, content: bytes) -> list[Frame]:
    """Read the cameras of an .npz file; camera i has row i of each array."""
    try:
        arrays = read_npz(io.BytesIO(content))
    except (ValueError, OSError) as error:
        raise BrokenError(
            f"cannot be read as an .npz file ({error}); save it again, without objects"
        ) from None
    keys = [key for key in (_first_of(_VIEWS, arrays), _first_of(_POSES, arrays)) if key]
    if len(keys) != 1:
        raise BrokenError(
            f"must have one of {', '.join((*_VIEWS, *_POSES))}; has {', '.join(arrays) or 'nothing'}"
        )
    [pose] = keys
    shared = {"projection": "pinhole", "distortion_model": str(arrays.get("distortion_model", "opencv"))}
    if pose in _VIEWS:
        shared["convention"] = "opencv"
    elif "convention" in arrays:
        shared["convention"] = str(arrays["convention"])
    is_inverse = pose in _POSES and Record(shared).choice("convention", ("opencv", "opengl")) == "opencv"
    matrices = _numbers(arrays, pose, 3)
    if matrices.shape[1:] not in _SHAPES:
        raise BrokenError(f"{pose} must have shape (n, 4, 4), not {matrices.shape}")
    count = len(matrices)
    K = _first_of(_INTRINSICS, arrays)
    if not K:
        raise BrokenError(f"must have one of {', '.join(_INTRINSICS)}; has {', '.join(arrays)}")
    columns = {K: _numbers(arrays, K, 3)}
    for name, dimensions in (("width", 1), ("height", 1), ("distortion", 2)):
        if name in arrays:
            columns[name] = _numbers(arrays, name, dimensions)
    if "names" in arrays:
        columns["names"] = np.atleast_1d(arrays["names"])
    for name, column in columns.items():
        if len(column) not in (1, count):
            raise BrokenError(f"{name} has {len(column)} rows for {count} cameras")
    frames = []
    for number in range(count):
        row = {name: column[number % len(column)].tolist() for name, column in columns.items()}
        with within(f"camera {number}"):
            with within(pose):
                row[pose] = (_inverse(matrices[number]) if is_inverse else matrices[number]).tolist()
            record = Record({**shared, **row})
            size = record.size() if "width" in record or "height" in record else None
            frame = frame_of(path, str(row.get("names", number)), record, size, K, pose, _SHAPES)
            frames.append(frame._replace(is_named="names" in arrays))
    return frames


def _first_of(names: tuple[str, ...], arrays: Mapping[str, Array]) -> str:
    """Return the first name that an array has, or else an empty text."""
    return next((name for name in names if name in arrays), "")


def _inverse(pose: Float64s) -> Float64s:
    """Return the inverse of a pose (4, 4) or (3, 4), or raise BrokenError if it has none."""
    pose = np.vstack([pose, [0.0, 0.0, 0.0, 1.0]]) if len(pose) == 3 else pose
    if not abs(np.linalg.det(pose)) > 0.0:
        raise BrokenError("its upper left 3×3 must be a rotation")
    return np.linalg.inv(pose).astype(np.float64)


def _numbers(arrays: Mapping[str, Array], name: str, dimensions: int) -> Float64s:
    """Return a checked float64 array with one row a camera, or one row for all."""
    array = arrays[name]
    if array.dtype.kind not in "fiu" or not (np.abs(array) <= LARGEST).all():
        raise BrokenError(f"{name} must be finite numbers, not {reprlib.repr(array)}")
    if array.ndim == dimensions + 1 and len(array) == 1:
        array = array[0]
    if array.ndim == dimensions - 1:
        array = array[None]
    if array.ndim != dimensions:
        raise BrokenError(f"{name} must have {dimensions} dimensions, not the shape {arrays[name].shape}")
    return array.astype(np.float64)
