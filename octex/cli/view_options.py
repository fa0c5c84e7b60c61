"""From where models are drawn, as options say it: --direction, --up, --zoom, --frame."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from octex.cli.arguments import bump, length, light, position, real
from octex.cli.parser import option
from octex.errors import ArgumentError

if TYPE_CHECKING:
    from octex.drawing import Bump
    from octex.drawing.environment import Environment
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture
    from octex.view.camera import Camera

VIEW_OPTIONS = (
    option(
        "--direction",
        "direction from the model to the camera (default: where painted pictures were taken, "
        "otherwise the side that shows most)",
        metavar="X,Y,Z",
        type=position,
    ),
    option("--up", "direction that points up in the picture (default 0,1,0)", metavar="X,Y,Z", type=position),
    option(
        "--zoom",
        "enlarge by this factor (default 1: the whole model)",
        metavar="TIMES",
        type=length,
    ),
    option(
        "--light",
        "light the materials by a panorama, .hdr or .exr, or by 'studio' (default: soft light on base "
        "colours only)",
        metavar="FILE",
        type=light,
    ),
    option("--exposure", "double the --light this many times (default 0)", metavar="STOPS", type=real),
    option(
        "--bump",
        "bend the normals as if the surface were displaced by HEIGHT where the channel is 1, in the "
        "model's units",
        metavar="CHANNEL=HEIGHT",
        type=bump,
    ),
    option("--frame", "draw through a camera of the glTF model, by its name", metavar="NAME"),
)
VIEW_WORDS = {each.word for each in VIEW_OPTIONS}


class Draw(Protocol):
    """Draws --preview of a surface and its texture, as some cameras see it if no option says from where."""

    def __call__(
        self, surface: Surface | None, texture: OctreeTexture, cameras: Sequence[Camera] = ()
    ) -> None:
        """Write the picture."""


def previewing(options: argparse.Namespace, model: Path) -> Draw | None:
    """Return what draws --preview; None where none is asked for.

    Raises CameraError for a frame that the model's file does not have.
    """
    if options.preview is None:
        return None
    from octex.cli.shots import frame_of
    from octex.drawing import Viewpoint, viewpoint_among, write_preview
    from octex.view.camera_files import read_cameras

    name, light, bump = options.frame, light_of(options), bump_of(options)
    frame = None if name is None else frame_of(read_cameras(model), name, model)
    view = Viewpoint(options.direction, options.up or (0.0, 1.0, 0.0), options.zoom or 1.0, frame)
    is_free = frame is None and options.direction is None and options.up is None

    def draw(surface: Surface | None, texture: OctreeTexture, cameras: Sequence[Camera] = ()) -> None:
        seen = viewpoint_among(cameras)._replace(zoom=view.zoom) if cameras and is_free else view
        write_preview(options.preview, surface, texture, view=seen, light=light, bump=bump)

    return draw


def light_of(options: argparse.Namespace) -> Environment | None:
    """Return the light that --light names; None without. Raises ImageError for a file that is no picture."""
    if options.light is None:
        return None
    from octex.drawing.environment import Environment

    exposure = options.exposure or 0.0
    if options.light == "studio":
        return Environment.studio(exposure)
    return Environment.load(options.light, exposure, options.up or (0.0, 1.0, 0.0))


def bump_of(options: argparse.Namespace) -> Bump | None:
    """Return what bends the normals; None for nothing."""
    from octex.drawing import Bump

    return None if options.bump is None else Bump(*options.bump)


def check_view_options(options: argparse.Namespace) -> None:
    """Refuse a camera that is given and described at once, and one of no picture."""
    given = [word for word in VIEW_WORDS if getattr(options, word[2:]) is not None]
    if given and options.preview is None and getattr(options, "view", None) is None:
        raise ArgumentError(f"{min(given)} has no meaning without a picture to draw")
    for word, given in (("--direction", options.direction), ("--up", options.up)):
        if given is not None and options.frame is not None:
            raise ArgumentError(f"{word} and --frame both say where the camera is; give one of them")
    is_view = getattr(options, "view", None) is not None
    if is_view and options.bump is not None and options.light is None and not options.shaded:
        raise ArgumentError("--bump has no meaning in a view without light: give --shaded or --light too")
    if options.exposure is not None and options.light is None:
        raise ArgumentError("--exposure has no meaning without --light")
    if options.direction is not None and not any(options.direction):
        raise ArgumentError("--direction must not be 0,0,0")
