"""Commands of painting pages: a line of JSON with fields, then binary content. Each is checked on arrival."""

from __future__ import annotations

import json
import math
import re
import zlib
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Array, Uint8s
from octex.cameras.camera import Camera
from octex.checks import as_choice, as_flag, as_number, as_reals, as_whole
from octex.errors import ArgumentError
from octex.painting.image import Blend, Projection
from octex.painting.stack import Layer, check_layer
from octex.painting.surface import DRAWN_ANGLE, PaintOptions

#: Largest size of a command in bytes, and largest side of a stroke's view in pixels.
MOST_BYTES, MOST_PIXELS = 32 << 20, 4096
_LONGEST_NAME = 40
_FARTHEST = 1e12
_MOST_CHANNELS = 16
_BLENDS: tuple[Blend, ...] = ("over", "multiply", "screen", "add")
_MOST_NUMBER = 2**53 - 1
#: Actions on layers, with the painter's words for them, and the fields that they take.
_ACTIONS = {name: name for name in ("add", "set", "move", "copy", "merge", "delete")} | {"set": "change"}
_FIELDS = {
    "title": "name",
    "opacity": "opacity",
    "blend": "blend",
    "isVisible": "is_visible",
    "hasMask": "has_mask",
}


class Moment(NamedTuple):
    """A time of an animation, also between frames."""

    animation: int
    time: float  # seconds


class Spot(NamedTuple):
    """The spot around which the surface is unwrapped, as arguments of `octex.unwrap`."""

    center: tuple[float, float, float]
    radius: float
    up: tuple[float, float, float]


class PageCommand(NamedTuple):
    """A command of a page; each page numbers its commands from 1."""

    page: str
    number: int
    kind: str
    fields: dict[str, Any]
    content: bytes


def object_of(text: str | bytes, name: str) -> dict[str, Any]:
    """Parse a JSON object; raise ArgumentError for anything else, with ``name`` in its message."""
    with suppress(ValueError, RecursionError):
        fields = json.loads(text)
        if isinstance(fields, dict):
            return fields
    raise ArgumentError(f"{name} must be a JSON object")


def command_of(body: bytes) -> PageCommand:
    """Parse a line of JSON and the bytes after it. Raises ArgumentError for anything else."""
    line, _, content = body.partition(b"\n")
    fields = object_of(line, "the command's line")
    page, kind, name = fields.get("page"), fields.get("kind"), fields.get("name", "")
    if not isinstance(page, str) or not re.fullmatch(r"[0-9a-f-]{8,40}", page):
        raise ArgumentError("page must be hexadecimal digits")
    number = as_whole(fields.get("number"), "number", 1, _MOST_NUMBER)  # type: ignore[arg-type]
    if not isinstance(kind, str) or kind not in _READERS:
        raise ArgumentError(f"kind must be one of {', '.join(_READERS)}")
    if not isinstance(name, str) or len(name) > _LONGEST_NAME or not name.isprintable():
        raise ArgumentError(f"name must be a line of at most {_LONGEST_NAME} characters")
    command = PageCommand(page, number, kind, fields, content)
    target_of(command)
    _READERS[kind](command)
    return command


class Where(NamedTuple):
    """A rest point, or None, and the mirror plane."""

    point: Array | None
    axis: int | None  # normal axis of the mirror; None: no mirror
    offset: float  # of the mirror from the model's middle


def stroke_of(command: PageCommand) -> tuple[Projection, dict[str, Any], Where]:
    """Return a stroke's image, its options of painting, and the connected part that limits it, if any."""
    fields = command.fields
    options = {
        "max_angle": fields.get("maxAngle", DRAWN_ANGLE),
        "back_faces": fields.get("backFaces", False),
        "hidden": fields.get("hidden", False),
    }
    PaintOptions(**options)
    moment_of(fields)
    spot_of(fields)
    camera = camera_of(command)
    image = image_of(command, camera)
    projection = Projection(image, camera, opacity=opacity_of(command), blend=blend_of(command))
    return projection, options, where_of(command)


def moment_of(fields: dict[str, Any]) -> Moment | None:
    """Return the animation time that the page shows; None for the model as loaded."""
    record = _object_of(fields, "moved")
    if record is None:
        return None
    number = as_whole(record.get("animation"), "animation", 0, 1 << 20)  # type: ignore[arg-type]
    return Moment(number, as_number(record.get("time"), "time", 0.0, 1e9))  # type: ignore[arg-type]


def spot_of(fields: dict[str, Any]) -> Spot | None:
    """Return the spot of the unwrapped view; None for an ordinary view."""
    record = _object_of(fields, "patch")
    if record is None:
        return None
    center, up = (tuple(numbers(record, name, (3,)).tolist()) for name in ("center", "up"))
    return Spot(center, as_number(record.get("radius"), "radius", 1e-12, 1e12), up)  # type: ignore[arg-type]


def _object_of(fields: dict[str, Any], name: str) -> dict[str, Any] | None:
    record = fields.get(name)
    if record is not None and not isinstance(record, dict):
        raise ArgumentError(f"{name} must be an object")
    return record


def fill_of(command: PageCommand) -> tuple[dict[str, Any], Where, dict[str, Any] | None]:
    """Return a fill's options, its point (None: everywhere), and its limits by colour, for `alike`.

    Without limits it fills the whole connected part.
    """
    _no_content(command)
    if not values_of(command) or "color" in command.fields:
        codes_of(command)
    where, color_limits = where_of(command), None
    if "tolerance" in command.fields:
        if where.point is None:
            raise ArgumentError("tolerance needs at, the point whose colour is replaced")
        tolerance = as_number(command.fields["tolerance"], "tolerance", 0.0, 255.0)
        connected = as_flag(command.fields.get("connected", True), "connected")
        color_limits = {"tolerance": tolerance, "connected": connected}
    return {"opacity": opacity_of(command), "blend": blend_of(command)}, where, color_limits


def channel_of(command: PageCommand) -> str:
    """Return the name of the channel to add."""
    _no_content(command)
    name = command.fields.get("channel")
    if not isinstance(name, str):
        raise ArgumentError("channel must be a name")
    return name


def layer_of(command: PageCommand) -> tuple[str, dict[str, Any]]:
    """Return an action of the painter's, and its arguments for the command's layer."""
    _no_content(command)
    fields, (layer, _) = command.fields, target_of(command)
    action = as_choice(fields.get("action", ""), tuple(_ACTIONS), "action")
    if layer is None and action != "add":
        raise ArgumentError(f"name the layer to {action}")
    wanted: dict[str, Any] = {}
    if action == "move":
        wanted["place"] = as_whole(fields.get("place"), "place", 0, _MOST_NUMBER)  # type: ignore[arg-type]
    elif action in ("add", "set"):
        wanted = {parameter: fields[name] for name, parameter in _FIELDS.items() if name in fields}
        check_layer(Layer(1, "Layer")._replace(**wanted))
    return _ACTIONS[action], wanted


def fields_of(layer: Layer) -> dict[str, Any]:
    """Return a layer as pages read it."""
    return {"number": layer.number} | {name: getattr(layer, field) for name, field in _FIELDS.items()}


def replaces_of(command: PageCommand) -> bool:
    """Return whether to overwrite a file that another program has changed."""
    _no_content(command)
    return as_flag(command.fields.get("replace", False), "replace")


def file_of(command: PageCommand) -> str:
    """Return which file to take: "output", the saved texture, or "opened", the opened one."""
    file: str = as_choice(command.fields.get("file", ""), ("output", "opened"), "file")
    return file


def _no_content(command: PageCommand) -> None:
    if command.content:
        raise ArgumentError(f"a command of the kind {command.kind} has no content")


#: Parsers by kind of command; each raises ArgumentError for bad fields.
_READERS: dict[str, Callable[[PageCommand], Any]] = {
    "stroke": stroke_of,
    "fill": fill_of,
    "layer": layer_of,
    "channel": channel_of,
    "undo": _no_content,
    "redo": _no_content,
    "save": replaces_of,
    "take": file_of,
    "keep": _no_content,
}


def camera_of(command: PageCommand) -> Camera:
    """Return the camera of the view that was painted on."""
    record = _object_of(command.fields, "camera")
    if record is None:
        raise ArgumentError("camera is missing")
    width, height = (as_whole(record.get(name), name, 1, MOST_PIXELS) for name in ("width", "height"))  # type: ignore[arg-type]
    pose, K = (numbers(record, name, shape) for name, shape in (("pose", (4, 4)), ("K", (3, 3))))
    return Camera.pinhole((width, height), pose=pose, convention="opencv", K=K)


def image_of(command: PageCommand, camera: Camera) -> Uint8s:
    """Return the image (height, width, 4) of a stroke, in sRGB.

    The content covers only its ``box`` and is deflated: coverage alone if the command has ``color`` or
    ``values``, otherwise planes of red, green, blue and coverage.
    """
    width, height = camera.width, camera.height
    left, top, right, bottom = box = numbers(command.fields, "box", (4,)).tolist()
    if not (0 <= left < right <= width and 0 <= top < bottom <= height and all(n == int(n) for n in box)):
        raise ArgumentError(f"box must be a part of {width}×{height} pixels")
    left, top, right, bottom = map(int, box)
    is_plain = bool(values_of(command)) or "color" in command.fields
    shape = (1 if is_plain else 4, bottom - top, right - left)
    size = math.prod(shape)
    unpacker = zlib.decompressobj(-15)
    try:
        planes = unpacker.decompress(command.content, size + 1)
    except zlib.error:
        planes = b""
    if len(planes) != size or not unpacker.eof or unpacker.unused_data:
        expected = "coverage" if is_plain else "red, green, blue and coverage"
        raise ArgumentError(f"the content is not deflated {expected} of {math.prod(shape[1:]):,} pixels")
    image = np.zeros((height, width, 4), np.uint8)
    inside = image[top:bottom, left:right]
    if "color" in command.fields:
        inside[..., :3] = codes_of(command)
    inside[..., -shape[0] :] = np.frombuffer(planes, np.uint8).reshape(shape).transpose(1, 2, 0)
    return image


def where_of(command: PageCommand) -> Where:
    """Return the point of a command, if any, and its mirror."""
    point = numbers(command.fields, "at", (3,)) if "at" in command.fields else None
    offset = as_number(command.fields.get("offset", 0.0), "offset", -_FARTHEST, _FARTHEST)
    mirror = command.fields.get("mirror", "")
    if mirror not in ("", "x", "y", "z"):
        raise ArgumentError("mirror must be x, y, z or nothing")
    return Where(point, "xyz".index(mirror) if mirror else None, offset)


def opacity_of(command: PageCommand) -> float:
    """Return the opacity of paint; default 1."""
    return as_number(command.fields.get("opacity", 1.0), "opacity", 0.0, 1.0)


def blend_of(command: PageCommand) -> Blend:
    """Return the blend mode of paint, or "erase"."""
    blend = as_choice(command.fields.get("blend", "over"), _BLENDS, "blend")
    return "erase" if as_flag(command.fields.get("erases", False), "erases") else blend


def target_of(command: PageCommand) -> tuple[int | None, bool]:
    """Return the number of the layer to paint, None for the texture itself, and whether to paint its mask."""
    layer, mask = command.fields.get("layer"), as_flag(command.fields.get("mask", False), "mask")
    if layer is not None:
        layer = as_whole(layer, "layer", 1, _MOST_NUMBER)
    elif mask:
        raise ArgumentError("the texture itself has no mask; name a layer")
    return layer, mask


def codes_of(command: PageCommand) -> Uint8s:
    """Return a colour as a page has it, in 8-bit sRGB."""
    codes = numbers(command.fields, "color", (3,))
    if (codes < 0).any() or (codes > 255).any():
        raise ArgumentError("color must be codes of 0 to 255")
    return np.rint(codes).astype(np.uint8)


def values_of(command: PageCommand) -> dict[str, Array]:
    """Return the values to paint by channel; empty without a field ``values``."""
    values = command.fields.get("values", {})
    if not isinstance(values, dict) or len(values) > _MOST_CHANNELS:
        raise ArgumentError(f"values must be an object of at most {_MOST_CHANNELS} channels")
    return {name: numbers(values, name, (-1,)) for name in values}


def numbers(fields: dict[str, Any], name: str, shape: tuple[int, ...]) -> Array:
    """Return numbers of a field; raise ArgumentError for others than finite ones of a shape."""
    return as_reals(fields.get(name), name, shape, most=_FARTHEST)  # type: ignore[arg-type]
