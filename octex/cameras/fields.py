"""What files say of cameras: frames, and the fields of their records, each read or refused by its name."""

from __future__ import annotations

import contextlib
import math
import re
import reprlib
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from octex.arrays import Float64s
from octex.cameras.camera import (
    LARGEST,
    LARGEST_SIZE,
    NO_DISTORTION,
    SMALLEST,
    Camera,
    Convention,
    Distortion,
)
from octex.cameras.lens import DistortionModel
from octex.errors import ArgumentError, CameraError, ModelError
from octex.files import referred
from octex.source.models.gltf_file import rotation_matrix

Json = dict[str, Any]

#: The intrinsics (3, 3) for a picture's width and height.
Lens = Callable[[int, int], Float64s]

_LISTED = 10


class Frame(NamedTuple):
    """A camera of a file; ``camera`` makes it."""

    name: str  # transforms.json: file_path; COLMAP: the image's name; glTF: the node's or camera's name
    # Where the file says that the picture is, which need not exist; of an absolute path only the name counts,
    # beside the file. transforms.json, OpenMVS, Meshroom, OpenSfM, OpenMVG and Bundler only.
    image: Path | None
    size: tuple[int, int] | None  # (width, height), if the file says
    file: Path
    lens: Lens
    world_to_camera: Float64s  # (4, 4), as Camera's
    projection: Literal["pinhole", "orthographic"] = "pinhole"
    distortion: Distortion = NO_DISTORTION
    distortion_model: DistortionModel = "opencv"
    view: bytes | None = None  # a PNG file of what it saw, if a file of octex's own holds it
    is_named: bool = True  # False where the file has no names: ``name`` is then the camera's number, from 0

    def camera(self, size: tuple[int, int] | None = None) -> Camera:
        """Make the camera for a picture of ``size`` (width, height); default: the size that the file says.

        Where both are known, ``size`` may be that of the picture made smaller or larger. Raises CameraError
        if neither is known, and for a picture of another shape.
        """
        frame = f"frame {self.name!r} of {self.file}"
        if size is None and self.size is None:
            raise CameraError(f"{frame} does not say how large its picture is; give the size or the picture")
        width, height = self.size or size or (0, 0)
        if size is not None and not self.fits(size):
            raise CameraError(
                f"{frame} is for {width}×{height} pixels, the picture has {size[0]}×{size[1]}, another "
                "shape; give the picture that the camera was made for"
            )
        try:
            camera = Camera.pinhole(
                (width, height),
                pose=self.world_to_camera,
                convention="opencv",
                K=self.lens(width, height),
                distortion=self.distortion,
                distortion_model=self.distortion_model,
            )
        except (BrokenError, ArgumentError) as error:
            raise CameraError(f"{frame}: {error}") from None
        camera = replace(camera, projection=self.projection, world_to_camera=self.world_to_camera)
        return camera if size is None else camera.resized(size)

    def fits(self, size: tuple[int, int]) -> bool:
        """Say whether a picture of ``size`` (width, height) has the file's shape, but for rounding."""
        width, height = size
        return self.size is None or abs(width * self.size[1] - height * self.size[0]) <= max(self.size)


class Optics(NamedTuple):
    """What pictures of one camera share."""

    size: tuple[int, int]  # (width, height)
    K: Float64s
    distortion: Distortion
    model: DistortionModel

    def frame(self, name: str, file: Path, view: Float64s) -> Frame:
        """Return a frame of a file by its world-to-camera matrix."""
        lens = fixed_lens(self.K)
        return Frame(
            name, None, self.size, file, lens, view,
            distortion=self.distortion, distortion_model=self.model,
        )  # fmt: skip


class BrokenError(Exception):
    """Say what is wrong, without the file's name."""


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what goes wrong while a file is read into a CameraError that names the file."""
    try:
        with np.errstate(all="ignore"):  # what overflows is found by its value
            yield
    except (BrokenError, ArgumentError) as error:
        raise CameraError(f"{path}: {error}") from None
    except ModelError as error:  # which begins with the file's name
        raise CameraError(f"{path}: {str(error).removeprefix(path.name).lstrip(': ')}") from None
    except UnicodeDecodeError:
        raise CameraError(f"{path}: is not UTF-8 text; is the file damaged?") from None
    except (OSError, ValueError) as error:  # ValueError: names that no file can have
        reason = getattr(error, "strerror", None) or str(error)
        raise CameraError(f"{path}: cannot be read: {reason}; give a file of cameras") from error


@contextlib.contextmanager
def within(place: str) -> Iterator[None]:
    """Put a place before what goes wrong in it."""
    try:
        yield
    except (BrokenError, ArgumentError) as error:
        raise BrokenError(f"{place}: {error}") from None


def listing(names: Iterable[str]) -> str:
    """Return names as a message lists them: some, and how many more."""
    known = [repr(name) for name in names]
    more = f" and {len(known) - _LISTED} more" if len(known) > _LISTED else ""
    return (", ".join(known[:_LISTED]) or "none") + more


def file_name(name: str) -> str:
    """Return the last part of a path, whatever its slashes."""
    return re.split(r"[/\\]", name)[-1]


def beside(path: Path, name: str) -> Path:
    """Return where a file says that a picture is; of an absolute path, the name beside the file."""
    try:
        return referred(path.parent, name)
    except OSError:
        return path.parent / file_name(name)


def is_file(path: Path) -> bool:
    """Say whether a path is a file that can be looked at."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long a name, for example
        return False


class Bytes:
    """Bytes that are read from the front."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    @property
    def left(self) -> int:
        """How many bytes there are still."""
        return len(self._content) - self._at

    def take(self, layout: str) -> tuple[Any, ...]:
        """Return the next values, little-endian."""
        start = self._at
        self.skip(struct.calcsize(f"<{layout}"))
        return struct.unpack_from(f"<{layout}", self._content, start)

    def skip(self, count: int) -> None:
        """Leave out bytes."""
        if count > self.left:
            raise BrokenError("the file ends here; copy or export it again")
        self._at += count

    def piece(self, count: int) -> bytes:
        """Return the next bytes."""
        start = self._at
        self.skip(count)
        return self._content[start : self._at]

    def text(self) -> str:
        """Return what stands before the next zero, and leave out both."""
        start, end = self._at, self._content.find(b"\0", self._at)
        if end < 0:
            raise BrokenError("the file ends in a name; copy or export it again")
        self._at = end + 1
        return self._content[start:end].decode("utf-8")


# Fields of JSON objects


def field_of(record: Json, field: str, kind: type, what: str) -> Any:
    """Return a field of a kind, or raise BrokenError that says what it must be."""
    if field not in record:
        raise BrokenError(f"{field} is missing; it must be {what}")
    if not isinstance(record[field], kind):
        raise BrokenError(f"{field} must be {what}, not {reprlib.repr(record[field])}")
    return record[field]


def text_field(record: Json, field: str) -> str:
    """Return a field that is a text."""
    return str(field_of(record, field, str, "a text"))


def object_field(record: Json, field: str) -> Json:
    """Return a field that is an object."""
    found: Json = field_of(record, field, dict, "an object")
    return found


def objects_field(record: Json, field: str) -> list[Json]:
    """Return a field that is a list of objects."""
    found: list[Json] = field_of(record, field, list, "a list of objects")
    for item in found:
        if not isinstance(item, dict):
            raise BrokenError(f"{field} must be a list of objects, not of {reprlib.repr(item)}")
    return found


def choice_field(record: Json, field: str, choices: Sequence[str]) -> str:
    """Return a field that is one of some texts."""
    found = text_field(record, field)
    if found not in choices:
        raise BrokenError(f"{field} must be one of {', '.join(choices)}, not {reprlib.repr(found)}")
    return found


def as_finite(value: object, field: str) -> float:
    """Return a value that is a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= LARGEST:
        raise BrokenError(f"{field} must be a finite number, not {reprlib.repr(value)}")
    return float(value)


def number_of(value: object, field: str) -> float:
    """Return a value that is a finite number, or the text of one."""
    try:
        return as_finite(float(value) if isinstance(value, str) else value, field)
    except ValueError:
        raise BrokenError(f"{field} must be a number, not {reprlib.repr(value)}") from None


def number_field(record: Json, field: str, default: float | None = None) -> float:
    """Return a field that is a finite number, or the default if it is not there."""
    if default is not None and field not in record:
        return default
    return as_finite(field_of(record, field, object, "a number"), field)


def positive_field(record: Json, field: str, below: float = math.inf) -> float:
    """Return a field that is a number above zero, and below another."""
    number = number_field(record, field)
    if not SMALLEST <= number < below:
        limit = "" if below == math.inf else f" and below {below:g}"
        raise BrokenError(f"{field} must be above zero{limit}, not {number:g}")
    return number


def pixels_field(record: Json, field: str) -> int:
    """Return a field that is a whole number of pixels."""
    number = number_field(record, field)
    if not (1.0 <= number <= LARGEST_SIZE and number.is_integer()):
        raise BrokenError(f"{field} must be a whole number from 1 to {LARGEST_SIZE}, not {number:g}")
    return int(number)


def size_of(width: object, height: object) -> tuple[int, int]:
    """Return how large a picture is: whole numbers of pixels."""
    record: Json = {"width": width, "height": height}
    return pixels_field(record, "width"), pixels_field(record, "height")


def numbers_field(record: Json, field: str, *counts: int) -> Float64s:
    """Return a field that is a list of numbers, so many or so many."""
    what = " or ".join(map(str, counts))
    found = field_of(record, field, list, f"{what} numbers")
    if len(found) not in counts:
        raise BrokenError(f"{field} must be {what} numbers, not {len(found)}")
    return np.array([as_finite(value, field) for value in found])


def matrix_field(record: Json, field: str, *shapes: tuple[int, int]) -> Float64s:
    """Return a field that is a matrix of one of some shapes."""
    what = "a matrix of " + " or ".join(f"{rows}×{columns}" for rows, columns in shapes) + " numbers"
    found = field_of(record, field, list, what)
    widths = {len(row) if isinstance(row, list) else -1 for row in found}
    if not any(len(found) == rows and widths == {columns} for rows, columns in shapes):
        raise BrokenError(f"{field} must be {what}, row by row")
    return np.array([[as_finite(value, field) for value in row] for row in found])


def view_of_pose(pose: Float64s, convention: Convention) -> Float64s:
    """Return a pose as a world-to-camera matrix; one that is that already, to the same bits."""
    view = Camera.pinhole((1, 1), pose=pose, convention=convention, focal=1.0).world_to_camera
    exact = convention == "opencv" and pose.shape == (4, 4) and np.allclose(view, pose, rtol=0.0, atol=1e-12)
    return pose if exact else view


def fixed_lens(K: Float64s) -> Lens:
    """Return intrinsics that are the same for any size."""
    return lambda *_: K


def intrinsics_of(x: float, y: float, center_x: float, center_y: float) -> Float64s:
    """Return the matrix of focal lengths and a centre."""
    return np.array([[x, 0.0, center_x], [0.0, y, center_y], [0.0, 0.0, 1.0]])


def focal_per_size(record: Json, field: str) -> float:
    """Return the focal length, in pictures, for the angle across a picture."""
    return 0.5 / math.tan(positive_field(record, field, below=math.pi) / 2)


def rotation_of(quaternion: Float64s, field: str) -> Float64s:
    """Return the matrix (3, 3) of a quaternion w, x, y, z of any length."""
    if not quaternion.any():
        raise BrokenError(f"{field} must not be zero")
    return rotation_matrix(*quaternion)
