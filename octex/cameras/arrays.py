"""Cameras from arrays of numpy, as gsplat and others take them.

viewmats       (n, 4, 4), or w2c or extrinsics: world-to-camera, OpenCV's axes (x right, y down, z forward);
               or instead of it
camtoworlds    (n, 4, 4), or c2w or poses: camera-to-world, of a ``convention``
Ks             (n, 3, 3), or K or intrinsics (3, 3) for all: in pixels, whose centres are at (i+½, j+½)
convention     "opencv" or "opengl" (camtoworlds only): the camera's axes; never guessed
width, height  of the pictures, for all or (n,); default: the pictures'
names          (n,), texts: the pictures' file names; without it cameras are numbered from 0
distortion     (n, numbers) or (numbers,), and distortion_model: see `octex.Camera`
"""

from __future__ import annotations

import io
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.cameras.camera import LARGEST, NO_DISTORTION, Camera, Convention
from octex.cameras.fields import BrokenError, Frame, choice_field, fixed_lens, view_of_pose, within
from octex.cameras.lens import DISTORTION_MODELS
from octex.npz import read_npz

_VIEWS, _POSES = ("viewmats", "w2c", "extrinsics"), ("camtoworlds", "c2w", "poses")
_INTRINSICS = ("Ks", "K", "intrinsics")


def read_arrays(path: Path, content: bytes) -> list[Frame]:
    """Read the cameras of an .npz file."""
    try:
        arrays = read_npz(io.BytesIO(content))
    except (ValueError, OSError) as error:
        raise BrokenError(
            f"cannot be read as an .npz file ({error}); save it again, without objects"
        ) from None
    views, poses = _one_of(arrays, _VIEWS), _one_of(arrays, _POSES)
    name = views or poses
    if name is None or (views and poses):
        raise BrokenError(
            f"must have one of {', '.join((*_VIEWS, *_POSES))}; has {', '.join(arrays) or 'nothing'}"
        )
    convention: Convention = "opencv"
    if poses is not None:
        record = {key: str(arrays[key]) for key in ("convention",) if key in arrays}
        chosen = choice_field(record, "convention", ("opencv", "opengl"))
        convention = "opengl" if chosen == "opengl" else "opencv"
    matrices = _numbers(arrays, name, 3)
    if matrices.shape[1:] not in ((4, 4), (3, 4)):
        raise BrokenError(f"{name} must have shape (n, 4, 4), not {matrices.shape}")
    count = len(matrices)
    intrinsics = _one_of(arrays, _INTRINSICS)
    if intrinsics is None:
        raise BrokenError(f"must have one of {', '.join(_INTRINSICS)}; has {', '.join(arrays)}")
    Ks = _for_each(_numbers(arrays, intrinsics, 3), count, intrinsics)
    sizes = _sizes(arrays, count)
    names = [str(number) for number in range(count)]
    if "names" in arrays:
        names = [str(each) for each in _for_each(np.atleast_1d(arrays["names"]), count, "names")]
    record = {"distortion_model": str(arrays.get("distortion_model", "opencv"))}
    model = next(
        each
        for each in DISTORTION_MODELS
        if each == choice_field(record, "distortion_model", DISTORTION_MODELS)
    )
    lenses = [NO_DISTORTION] * count
    if "distortion" in arrays:
        given = _for_each(_numbers(arrays, "distortion", 2), count, "distortion")
        lenses = [tuple(each) for each in given.tolist()]
    frames = []
    for number in range(count):
        with within(f"camera {number}"):
            with within(name):
                pose = matrices[number]
                if poses is not None and convention == "opencv":
                    pose = np.linalg.inv(_whole(pose))
                view = view_of_pose(pose, convention)
            with within(intrinsics):
                Camera.pinhole(
                    (1, 1), pose=np.eye(4), convention="opencv", K=Ks[number], distortion=lenses[number],
                    distortion_model=model,
                )  # fmt: skip
            frames.append(
                Frame(
                    names[number],
                    None,
                    sizes[number],
                    path,
                    fixed_lens(Ks[number]),
                    view,
                    distortion=lenses[number],
                    distortion_model=model,
                    is_named="names" in arrays,
                )
            )
    return frames


def _one_of(arrays: Mapping[str, Any], names: tuple[str, ...]) -> str | None:
    return next((name for name in names if name in arrays), None)


def _whole(pose: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return a pose with its last row, or refuse one that cannot be inverted."""
    pose = np.vstack([pose, [0.0, 0.0, 0.0, 1.0]]) if len(pose) == 3 else pose
    if not abs(np.linalg.det(pose)) > 0.0:
        raise BrokenError("its upper left 3×3 must be a rotation")
    return pose


def _numbers(arrays: Mapping[str, Any], name: str, dimensions: int) -> npt.NDArray[np.float64]:
    """Return an array of finite numbers, with a row for each camera or one for all."""
    array = arrays[name]
    if array.dtype.kind not in "fiu" or not (np.abs(array) <= LARGEST).all():
        raise BrokenError(f"{name} must be finite numbers, not {reprlib.repr(array)}")
    if array.ndim == dimensions + 1 and len(array) == 1:
        array = array[0]
    if array.ndim == dimensions - 1:
        array = array[None]
    if array.ndim != dimensions:
        raise BrokenError(f"{name} must have {dimensions} dimensions, not the shape {arrays[name].shape}")
    found: npt.NDArray[np.float64] = array.astype(np.float64)
    return found


def _for_each(array: npt.NDArray[Any], count: int, name: str) -> npt.NDArray[Any]:
    """Return an array that has a row for each camera, or one for all."""
    if len(array) not in (1, count):
        raise BrokenError(f"{name} has {len(array)} rows for {count} cameras")
    return np.broadcast_to(array, (count, *array.shape[1:]))


def _sizes(arrays: Mapping[str, Any], count: int) -> list[tuple[int, int] | None]:
    if not ("width" in arrays and "height" in arrays):
        return [None] * count
    both = [_for_each(_numbers(arrays, name, 1), count, name) for name in ("width", "height")]
    if not all((each >= 1).all() and (each == np.floor(each)).all() for each in both):
        raise BrokenError("width and height must be whole numbers of pixels above zero")
    return [(int(width), int(height)) for width, height in zip(*both, strict=True)]
