"""Cameras of OpenMVS's scenes (.mvs, its Interface.h): versions 1 to 7, undistorted images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from octex.arrays import Float64s
from octex.cameras.fields import BrokenError, Bytes, Record, within
from octex.cameras.frames import Frame, Optics, image_path, rigid, view_matrix

#: The first bytes of a scene.
MARK = b"MVSI"
_NEWEST = 7
#: The number that stands for a missing pose.
_NONE = 2**32 - 1
#: From pixels with centres at whole numbers to pixels with centres at ½.
_TO_CORNERS = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])


def read(path: Path, content: bytes) -> list[Frame]:
    """Read the cameras of a scene's images that have poses."""
    data = Bytes(content)
    data.piece(len(MARK))
    version, _ = data.take("II")
    if not 1 <= version <= _NEWEST:
        raise BrokenError(f"is an OpenMVS scene of version {version}; octex reads versions 1 to {_NEWEST}")
    platforms = [_platform(data, version) for _ in _numbered(data, "platform")]
    frames = []
    for number in _numbered(data, "image"):
        with within(f"image {number}"):
            name = _text(data)
            if version > 4:
                _text(data)  # the mask's name
            platform, camera, pose = data.take("III")
            data.piece(4 if version > 2 else 0)
            if version > 6:
                data.piece(12)
                data.piece(24 * data.take("Q")[0])
        if pose == _NONE:
            continue
        with within(f"frame {name!r}"):
            if platform >= len(platforms):
                raise BrokenError(f"platform {platform} is not in the file")
            optics, mounts, poses = platforms[platform]
            if camera >= len(optics) or pose >= len(poses):
                raise BrokenError(f"camera {camera} or pose {pose} is not in the file")
            view = view_matrix(mounts[camera] @ poses[pose])
            frames.append(Frame(name, path, optics[camera], view, image_path(path, name)))
    return frames


def _platform(data: Bytes, version: int) -> tuple[list[Optics], list[Float64s], list[Float64s]]:
    """Return each camera's optics and matrix (4, 4) from the platform's axes; and the poses (4, 4)."""
    _text(data)
    optics: list[Optics] = []
    mounts, poses = [], []
    for number in _numbered(data, "camera"):
        with within(f"camera {number}"):
            for _ in range(2 if version > 3 else 1):  # the camera's name, and its band's
                _text(data)
            width, height = data.take("II")
            size = Record({"width": width, "height": height}).size() if width or height else None
            optics.append(_optics(size, data.numbers("K", 3, 3)))
            mounts.append(_pose(data))
    for number in _numbered(data, "pose"):
        with within(f"pose {number}"):
            poses.append(_pose(data))
    return optics, mounts, poses


def _optics(size: tuple[int, int] | None, K: Float64s) -> Optics:
    if size is not None:
        return Optics(size, _TO_CORNERS @ K)

    def scaled(width: int, height: int) -> Float64s:
        """Return the intrinsics in pixels from intrinsics whose image is 1 along the longer side."""
        longest = max(width, height)
        return _TO_CORNERS @ np.diag([longest, longest, 1.0]) @ K

    return Optics(None, scaled)


def _pose(data: Bytes) -> Float64s:
    rotation, origin = data.numbers("R", 3, 3), data.numbers("C", 3)
    return rigid(rotation, -rotation @ origin)


def _text(data: Bytes) -> str:
    return data.piece(*data.take("Q")).decode("utf-8")


def _numbered(data: Bytes, what: str) -> range:
    """Return the range of a list's item numbers; each item takes more than a byte."""
    (count,) = data.take("Q")
    if count > data.left:
        raise BrokenError(f"the number of {what}s, {count}, is more than the file has room for")
    return range(count)
