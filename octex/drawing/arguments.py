"""Checks of the arguments that all renderings share."""

from __future__ import annotations

import numpy.typing as npt

from octex.cameras.camera import as_size, as_vector
from octex.checks import as_number, as_positive, as_text, as_whole, is_several
from octex.drawing.directions import Viewpoint
from octex.drawing.environment import Environment
from octex.drawing.shaders import Bump
from octex.errors import ArgumentError

_MOST_SAMPLES = 64
_MOST_PIXELS = 1 << 28
_STEEPEST = 1e30


def as_picture_size(size: tuple[int, int]) -> tuple[int, int]:
    """Return a checked width and height in pixels, or raise ArgumentError."""
    width, height = as_size(size)
    if width * height > _MOST_PIXELS:
        raise ArgumentError(f"a picture has at most {_MOST_PIXELS:,} pixels, not {width} × {height}")
    return width, height


def as_viewpoint(direction: npt.ArrayLike | None, up: npt.ArrayLike, zoom: float) -> Viewpoint:
    """Return a checked viewpoint, or raise ArgumentError."""
    direction = None if direction is None else as_vector(direction, "direction")
    return Viewpoint(direction, as_vector(up, "up"), as_positive(zoom, "zoom"))


def as_light(light: Environment | None) -> Environment | None:
    """Return a checked environment or None, or raise ArgumentError."""
    if light is not None and not isinstance(light, Environment):
        raise ArgumentError(f"light must be an octex.Environment, not {light!r}")
    return light


def as_bump(bump: Bump | None) -> Bump | None:
    """Return a checked channel and height or None, or raise ArgumentError."""
    if bump is None:
        return None
    pair = list(bump) if is_several(bump) else []
    if len(pair) != 2:
        raise ArgumentError(f"bump must be (channel, height), not {bump!r}")
    rise = as_number(pair[1], "bump's height", -_STEEPEST, _STEEPEST)
    return as_text(pair[0], "bump's channel"), rise


def as_supersample(supersample: int) -> int:
    """Return a checked number of samples along each side of a pixel, or raise ArgumentError."""
    return as_whole(supersample, "supersample", 1, _MOST_SAMPLES)
