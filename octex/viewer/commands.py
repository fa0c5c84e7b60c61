"""Commands of pages that paint: a line of JSON with fields, and what follows. Each is checked as it comes."""

from __future__ import annotations

import json
import math
import re
import zlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Array, Uint8s
from octex.cameras.camera import Camera
from octex.channels import decode
from octex.checks import as_flag, as_number, as_reals, as_whole
from octex.errors import ArgumentError
from octex.painting.options import DRAWN_ANGLE, PaintOptions
from octex.painting.picture import Projection

#: Bytes of a command, and pixels along a side of the view that a stroke is painted on.
MOST_BYTES, MOST_PIXELS = 32 << 20, 4096
_LONGEST_NAME = 40
_MOST_NUMBER = 2**53 - 1


class Moment(NamedTuple):
    """A frame of an animation, between frames too."""

    animation: int
    time: float  # seconds


class Spot(NamedTuple):
    """Where the surface is laid flat, as `octex.unwrap` takes it."""

    center: tuple[float, float, float]
    radius: float
    up: tuple[float, float, float]


class Command(NamedTuple):
    """What a page asks for; pages count their commands from 1."""

    page: str
    number: int
    kind: str
    given: dict[str, Any]
    content: bytes


def command_of(body: bytes) -> Command:
    """Return what a page sent: a line of JSON, and what follows. Raises ArgumentError for anything else."""
    line, _, content = body.partition(b"\n")
    try:
        given = json.loads(line)
    except (ValueError, RecursionError):
        raise ArgumentError("the command is no line of JSON") from None
    if not isinstance(given, dict):
        raise ArgumentError("the command is no JSON object")
    page, kind, name = given.get("page"), given.get("kind"), given.get("name", "")
    if not isinstance(page, str) or not re.fullmatch(r"[0-9a-f-]{8,40}", page):
        raise ArgumentError("page must be hexadecimal digits")
    number = as_whole(given.get("number"), "number", 1, _MOST_NUMBER)  # type: ignore[arg-type]
    if not isinstance(kind, str) or kind not in _READERS:
        raise ArgumentError(f"kind must be one of {', '.join(_READERS)}")
    if not isinstance(name, str) or len(name) > _LONGEST_NAME or not name.isprintable():
        raise ArgumentError(f"name must be a line of at most {_LONGEST_NAME} characters")
    command = Command(page, number, kind, given, content)
    _READERS[kind](command)
    return command


def stroke_of(command: Command) -> tuple[Projection, dict[str, Any], int | None]:
    """Return the picture of a stroke, the options to paint it with, and its mirror. Raises ArgumentError."""
    given = command.given
    options = {"max_angle": given.get("maxAngle", DRAWN_ANGLE), "back_faces": given.get("backFaces", False)}
    PaintOptions(**options)
    moment_of(given)
    spot_of(given)
    camera = camera_of(command)
    picture = Projection(picture_of(command, camera), camera, opacity=opacity_of(command))
    return picture, options, mirror_of(command)


def moment_of(given: dict[str, Any]) -> Moment | None:
    """Return the frame that a page shows the model in; None as it stands."""
    moved = _object_of(given, "moved")
    if moved is None:
        return None
    number = as_whole(moved.get("animation"), "animation", 0, 1 << 20)  # type: ignore[arg-type]
    return Moment(number, as_number(moved.get("time"), "time", 0.0, 1e9))  # type: ignore[arg-type]


def spot_of(given: dict[str, Any]) -> Spot | None:
    """Return where the surface is laid flat that a page shows; None if it is not."""
    patch = _object_of(given, "patch")
    if patch is None:
        return None
    center, up = (tuple(numbers(patch, name, (3,)).tolist()) for name in ("center", "up"))
    return Spot(center, as_number(patch.get("radius"), "radius", 1e-12, 1e12), up)  # type: ignore[arg-type]


def _object_of(given: dict[str, Any], name: str) -> dict[str, Any] | None:
    found = given.get(name)
    if found is not None and not isinstance(found, dict):
        raise ArgumentError(f"{name} must be an object")
    return found


def fill_of(command: Command) -> tuple[Array, float, Array | None, int | None]:
    """Return the colour of a fill, its opacity, a point of the part or None for all, and its mirror."""
    _no_content(command)
    at = numbers(command.given, "at", (3,)) if "at" in command.given else None
    return color_of(command), opacity_of(command), at, mirror_of(command)


def replaces_of(command: Command) -> bool:
    """Return whether a save replaces a file that another program has written meanwhile."""
    _no_content(command)
    return as_flag(command.given.get("replace", False), "replace")


def _no_content(command: Command) -> None:
    if command.content:
        raise ArgumentError(f"a command of the kind {command.kind} has no content")


#: What reads a command of each kind, and raises ArgumentError for what it does not accept.
_READERS: dict[str, Callable[[Command], Any]] = {
    "stroke": stroke_of,
    "fill": fill_of,
    "undo": _no_content,
    "redo": _no_content,
    "save": replaces_of,
}


def camera_of(command: Command) -> Camera:
    """Return the camera of the view that a page has painted on."""
    given = command.given.get("camera")
    if not isinstance(given, dict):
        raise ArgumentError("camera must be an object")
    width, height = (as_whole(given.get(name), name, 1, MOST_PIXELS) for name in ("width", "height"))  # type: ignore[arg-type]
    pose, K = (numbers(given, name, shape) for name, shape in (("pose", (4, 4)), ("K", (3, 3))))
    return Camera.pinhole((width, height), pose=pose, convention="opencv", K=K)


def picture_of(command: Command, camera: Camera) -> Uint8s:
    """Return the picture (height, width, 4) of a stroke, in sRGB.

    The content has its ``box`` alone, deflated: the coverage by its ``color``; without that, planes of red,
    green, blue and coverage.
    """
    width, height = camera.width, camera.height
    left, top, right, bottom = box = numbers(command.given, "box", (4,)).tolist()
    if not (0 <= left < right <= width and 0 <= top < bottom <= height and all(n == int(n) for n in box)):
        raise ArgumentError(f"box must be a part of {width}×{height} pixels")
    left, top, right, bottom = map(int, box)
    has_color = "color" in command.given
    shape = (1 if has_color else 4, bottom - top, right - left)
    size = math.prod(shape)
    unpacker = zlib.decompressobj(-15)
    try:
        planes = unpacker.decompress(command.content, size + 1)
    except zlib.error:
        planes = b""
    if len(planes) != size or not unpacker.eof or unpacker.unused_data:
        what = "coverage" if has_color else "red, green, blue and coverage"
        raise ArgumentError(f"the content is no deflated {what} of {math.prod(shape[1:]):,} pixels")
    image = np.zeros((height, width, 4), np.uint8)
    if has_color:
        image[..., :3] = codes_of(command)
    image[top:bottom, left:right, -shape[0] :] = (
        np.frombuffer(planes, np.uint8).reshape(shape).transpose(1, 2, 0)
    )
    return image


def mirror_of(command: Command) -> int | None:
    """Return the axis that a command is mirrored across; None if it is not."""
    name = command.given.get("mirror", "")
    if name not in ("", "x", "y", "z"):
        raise ArgumentError("mirror must be x, y, z or nothing")
    return "xyz".index(name) if name else None


def opacity_of(command: Command) -> float:
    """Return the opacity of paint, 1 unless it is given."""
    return as_number(command.given.get("opacity", 1.0), "opacity", 0.0, 1.0)


def color_of(command: Command) -> Array:
    """Return a colour in linear light."""
    return decode(codes_of(command), "srgb")


def codes_of(command: Command) -> Uint8s:
    """Return a colour as a page has it, in 8-bit sRGB."""
    codes = numbers(command.given, "color", (3,), 255.0)
    if (codes < 0).any():
        raise ArgumentError("color must be codes of 0 to 255")
    return np.rint(codes).astype(np.uint8)


def numbers(given: dict[str, Any], name: str, shape: tuple[int, ...], most: float = 1e12) -> Array:
    """Return numbers of a field; raise ArgumentError for others than finite ones of a shape."""
    return as_reals(given.get(name), name, shape, most=most)  # type: ignore[arg-type]
