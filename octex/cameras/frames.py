"""Frames: the cameras of a file, each with the name of its image, and helpers to build them."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from octex.arrays import Float64s
from octex.cameras.camera import NO_DISTORTION, Camera, Convention, Distortion, ProjectionKind, intrinsics
from octex.cameras.fields import BrokenError, Record, within
from octex.cameras.lens import COUNTS, DISTORTION_MODELS, DistortionModel
from octex.errors import ArgumentError, CameraError
from octex.files import referred
from octex.gltf import rotation_matrix

#: Coefficients of each distortion model in the order of `Camera`; COLMAP's fisheyes have more.
_ORDERS = {"opencv": "k1 k2 p1 p2 k3 k4 k5 k6", "fisheye": "k1 k2 k3 k4", "fov": "omega"}
_WHOLE_FISHEYE = "k1 k2 p1 p2 k3 k4 sx1 sy1"


class Optics(NamedTuple):
    """The lens and image size that the frames of one camera share."""

    size: tuple[int, int] | None  # (width, height), if the file has it
    K: Float64s | Callable[[int, int], Float64s]  # (3, 3) intrinsics, or a function of width and height
    distortion: Distortion = NO_DISTORTION
    model: DistortionModel = "opencv"
    projection: ProjectionKind = "pinhole"

    def bent(self, model: DistortionModel, names: str, numbers: Sequence[float]) -> Optics:
        """Return the optics with distortion coefficients, which are in the order of ``names``."""
        by_name = dict(zip(names.split(), numbers, strict=True))
        order = _WHOLE_FISHEYE if model == "fisheye" and "p1" in by_name else _ORDERS[model]
        return self._replace(distortion=tuple(by_name.get(name, 0.0) for name in order.split()), model=model)


class Frame(NamedTuple):
    """A camera of a file; ``camera`` makes the `Camera`."""

    name: str  # transforms.json: file_path; COLMAP: the image's name; glTF: the node's or camera's name
    file: Path
    optics: Optics
    world_to_camera: Float64s  # (4, 4), as in Camera
    # The image's path, if the file has it; the image may be missing. An absolute path becomes its name next
    # to the camera file.
    image: Path | None = None
    view: bytes | None = None  # only in octex's files: the PNG that octex drew with this camera
    is_named: bool = True  # False where the file has no names: ``name`` is then the camera's number

    @property
    def size(self) -> tuple[int, int] | None:
        """The image's (width, height), if the file has it."""
        return self.optics.size

    def camera(self, size: tuple[int, int] | None = None) -> Camera:
        """Make the camera for an image of ``size`` (width, height); default: the file's size.

        ``size`` may differ from the file's size by a scale. Raises CameraError if neither is known, and for
        another aspect ratio.
        """
        frame = f"frame {self.name!r} of {self.file}"
        if size is None and self.size is None:
            raise CameraError(f"{frame} has no image size; give the size or the image")
        width, height = self.size or size or (0, 0)
        if size is not None and not self.fits(size):
            is_turned = self.fits(size[::-1])
            advice = "turn it by 90 degrees" if is_turned else "give the image that the camera was made for"
            raise CameraError(
                f"{frame} is for {width}×{height} pixels, the image has {size[0]}×{size[1]}, another "
                f"shape; {advice}"
            )
        _, K, distortion, model, projection = self.optics
        try:
            K = K(width, height) if callable(K) else K
            camera = Camera(width, height, K, self.world_to_camera, projection, distortion, model)
        except (BrokenError, ArgumentError) as error:
            raise CameraError(f"{frame}: {error}") from None
        return camera if size is None else camera.resized(size)

    def fits(self, size: tuple[int, int]) -> bool:
        """Return whether ``size`` (width, height) has the file's aspect ratio, up to rounding."""
        width, height = size
        return self.size is None or abs(width * self.size[1] - height * self.size[0]) <= max(self.size)


def file_name(name: str) -> str:
    """Return the last part of a path with slashes or backslashes."""
    return re.split(r"[/\\]", name)[-1]


def image_path(file: Path, name: str) -> Path:
    """Return the path of an image that a file names; an absolute path becomes its name next to the file."""
    try:
        return referred(file.parent, name)
    except OSError:
        return file.parent / file_name(name)


def is_file(path: Path) -> bool:
    """Return whether a path is a file; False where that cannot be checked."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # for example, too long a name
        return False


def with_ending(base: Path, endings: Sequence[str]) -> Path:
    """Return the first path with one of these endings that is a file, or else ``base``."""
    return next(filter(is_file, (Path(f"{base}{ending}") for ending in endings)), base)


def centred(focal: float, width: int, height: int) -> Float64s:
    """Return the intrinsics with the principal point in the middle of the image."""
    return intrinsics(focal, focal, width / 2, height / 2)


def rigid(rotation: Float64s, shift: Float64s) -> Float64s:
    """Return the matrix (4, 4) that rotates, then shifts."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, shift
    return matrix


def rotation_of(quaternion: Float64s, field: str) -> Float64s:
    """Return the matrix (3, 3) of a quaternion w, x, y, z of any length."""
    if not quaternion.any():
        raise BrokenError(f"{field} must not be zero")
    return rotation_matrix(*quaternion)


def view_matrix(pose: Float64s, convention: Convention = "opencv") -> Float64s:
    """Return a checked pose as a world-to-camera matrix; a valid one keeps its bits."""
    view = Camera.pinhole((1, 1), pose=pose, convention=convention, focal=1.0).world_to_camera
    exact = convention == "opencv" and pose.shape == (4, 4) and np.allclose(view, pose, rtol=0.0, atol=1e-12)
    return pose if exact else view


def frame_of(
    path: Path,
    name: str,
    record: Record,
    size: tuple[int, int] | None,
    K: str = "K",
    pose: str = "pose",
    shapes: Sequence[tuple[int, int]] = ((4, 4),),
) -> Frame:
    """Return the frame of a record; ``K`` and ``pose`` name the fields of its matrices."""
    projection = record.choice("projection", ("pinhole", "orthographic"))
    convention = record.choice("convention", ("opencv", "opengl"))
    matrix, pose_matrix = record.matrix(K, (3, 3)), record.matrix(pose, *shapes)
    model: DistortionModel = record.choice("distortion_model", DISTORTION_MODELS, DISTORTION_MODELS[0])
    distortion = record.numbers("distortion", *COUNTS[model]) if "distortion" in record else None
    if projection == "orthographic" and (model != "opencv" or (distortion is not None and distortion.any())):
        raise BrokenError("distortion must be zeros for an orthographic camera")
    with within(K):
        camera = Camera.pinhole(
            size or (1, 1), pose=np.eye(4), convention="opencv", K=matrix, distortion_model=model,
            distortion=None if distortion is None else distortion.tolist(),
        )  # fmt: skip
    with within(pose):
        view = view_matrix(pose_matrix, convention)
    return Frame(name, path, Optics(size, matrix, camera.distortion, model, projection), view)
