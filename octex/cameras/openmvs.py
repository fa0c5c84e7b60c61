"""Cameras of OpenMVS's scenes (.mvs), as its Interface.h has them: versions 1 to 7, undistorted pictures."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from octex.arrays import Float64s
from octex.cameras.fields import (
    BrokenError,
    Bytes,
    Frame,
    as_finite,
    beside,
    fixed_lens,
    size_of,
    view_of_pose,
    within,
)

#: What a scene begins with.
MARK = b"MVSI"
_NEWEST = 7
#: What stands where there is none.
_NONE = 2**32 - 1


class _Camera(NamedTuple):
    size: tuple[int, int] | None
    K: Float64s  # (3, 3)   of pixels whose centres are whole numbers; without a size, of pictures 1 wide
    mount: Float64s  # (4, 4)   from its platform's axes


def read_openmvs(path: Path, content: bytes) -> list[Frame]:
    """Read the cameras of a scene's pictures, those that have poses."""
    data = Bytes(content)
    data.skip(len(MARK))
    version, _ = data.take("II")
    if not 1 <= version <= _NEWEST:
        raise BrokenError(f"is of version {version} of OpenMVS's scenes; octex reads 1 to {_NEWEST}")
    platforms = [_platform(data, version) for _ in _numbered(data, "platform")]
    frames = []
    for number in _numbered(data, "image"):
        with within(f"image {number}"):
            name = _text(data)
            if version > 4:
                _text(data)  # of its mask
            platform, camera, pose = data.take("III")
            data.skip(4 if version > 2 else 0)
            if version > 6:
                data.skip(12)
                data.skip(24 * data.take("Q")[0])
        if pose == _NONE:
            continue
        with within(f"frame {name!r}"):
            if platform >= len(platforms):
                raise BrokenError(f"platform {platform} does not stand in the file")
            cameras, poses = platforms[platform]
            if camera >= len(cameras) or pose >= len(poses):
                raise BrokenError(f"camera {camera} or pose {pose} does not stand in the file")
            frames.append(_frame(path, name, cameras[camera], poses[pose]))
    return frames


def _frame(path: Path, name: str, camera: _Camera, pose: Float64s) -> Frame:
    view = view_of_pose(camera.mount @ pose, "opencv")
    image = beside(path, name)
    middle = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    if camera.size is not None:
        return Frame(name, image, camera.size, path, fixed_lens(middle @ camera.K), view)

    def lens(width: int, height: int) -> Float64s:
        longest = max(width, height)
        return middle @ np.diag([longest, longest, 1.0]) @ camera.K

    return Frame(name, image, None, path, lens, view)


def _platform(data: Bytes, version: int) -> tuple[list[_Camera], list[Float64s]]:
    _text(data)
    cameras, poses = [], []
    for number in _numbered(data, "camera"):
        with within(f"camera {number}"):
            for _ in range(2 if version > 3 else 1):  # its name, and its band's
                _text(data)
            width, height = data.take("II")
            size = size_of(width, height) if width or height else None
            K = _matrix(data, 3, "K").reshape(3, 3)
            cameras.append(_Camera(size, K, _pose(data)))
    for number in _numbered(data, "pose"):
        with within(f"pose {number}"):
            poses.append(_pose(data))
    return cameras, poses


def _pose(data: Bytes) -> Float64s:
    """Return the matrix (4, 4) of a rotation and of where its origin stands."""
    turn, origin = _matrix(data, 3, "R").reshape(3, 3), _matrix(data, 1, "C")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ origin
    return pose


def _matrix(data: Bytes, rows: int, field: str) -> Float64s:
    return np.array([as_finite(value, field) for value in data.take(f"{3 * rows}d")])


def _text(data: Bytes) -> str:
    (size,) = data.take("Q")
    return data.piece(size).decode("utf-8")


def _numbered(data: Bytes, what: str) -> range:
    """Return the numbers of what a list holds; each is longer than a byte."""
    (count,) = data.take("Q")
    if count > data.left:
        raise BrokenError(f"the number of {what}s, {count}, is more than the file has room for")
    return range(count)
