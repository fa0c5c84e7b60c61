"""The arguments of pictures, checked once."""

from __future__ import annotations

from typing import NamedTuple

import numpy.typing as npt

from octex.cameras.camera import as_size, as_vector
from octex.checks import as_number, as_positive, as_text, as_whole, is_several
from octex.drawing.directions import Viewpoint
from octex.drawing.environment import Environment
from octex.drawing.shaders import Bump
from octex.errors import ArgumentError
from octex.source.surface import Surface, as_surface
from octex.texture import OctreeTexture, as_texture

_MOST_SAMPLES = 64
_MOST_PIXELS = 1 << 28
_STEEPEST = 1e30


class Arguments(NamedTuple):
    """What ``octex.render`` and ``octex.write_preview`` are called with, checked."""

    texture: OctreeTexture | None
    surface: Surface | None
    size: tuple[int, int]
    view: Viewpoint
    channel: str | None
    light: Environment | None
    bump: Bump | None
    supersample: int

    @classmethod
    def checked(
        cls,
        texture: OctreeTexture | None,
        surface: Surface | None,
        size: tuple[int, int],
        view: tuple[npt.ArrayLike | None, npt.ArrayLike, float],
        channel: str | None,
        light: Environment | None,
        bump: Bump | None,
        supersample: int,
    ) -> Arguments:
        """Return arguments that make sense, or raise ArgumentError."""
        direction, up, zoom = view
        width, height = as_size(size)
        if width * height > _MOST_PIXELS:
            raise ArgumentError(f"a picture has at most {_MOST_PIXELS:,} pixels, not {width} × {height}")
        if light is not None and not isinstance(light, Environment):
            raise ArgumentError(f"light must be an octex.Environment, not {light!r}")
        if bump is not None:
            pair = list(bump) if is_several(bump) else []
            if len(pair) != 2:
                raise ArgumentError(f"bump must be (channel, height), not {bump!r}")
            rise = as_number(pair[1], "bump's height", -_STEEPEST, _STEEPEST)
            bump = as_text(pair[0], "bump's channel"), rise
        return cls(
            None if texture is None else as_texture(texture),
            None if surface is None else as_surface(surface),
            (width, height),
            Viewpoint(
                None if direction is None else as_vector(direction, "direction"),
                as_vector(up, "up"),
                as_positive(zoom, "zoom"),
            ),
            None if channel is None else as_text(channel, "channel"),
            light,
            bump,
            as_whole(supersample, "supersample", 1, _MOST_SAMPLES),
        )
