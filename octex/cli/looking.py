"""From where models are drawn, as options say it: --direction, --up, --zoom, --frame."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from octex.cli.arguments import length, position
from octex.cli.parser import option
from octex.errors import ArgumentError

if TYPE_CHECKING:
    from octex.preview import Viewpoint

LOOKING = (
    option(
        "--direction",
        "from the model toward the camera that draws it (default: the side that shows most)",
        metavar="X,Y,Z",
        type=position,
    ),
    option("--up", "what points up in the picture (default 0,1,0)", metavar="X,Y,Z", type=position),
    option(
        "--zoom",
        "draw so many times as large (default 1: the whole model)",
        metavar="TIMES",
        type=length,
    ),
    option("--frame", "draw through a camera of a glTF model, by its name", metavar="NAME"),
)
LOOKING_WORDS = {each.word for each in LOOKING}


def viewpoint(options: argparse.Namespace, model: Path) -> Viewpoint:
    """Return from where a model is drawn; raises CameraError for a frame that it does not have."""
    from octex.cli.shots import frame_of
    from octex.preview import Viewpoint
    from octex.view.camera_files import read_cameras

    name = options.frame
    frame = None if name is None else frame_of(read_cameras(model), name, model)
    return Viewpoint(options.direction, options.up or (0.0, 1.0, 0.0), options.zoom or 1.0, frame)


def check_looking(options: argparse.Namespace) -> None:
    """Refuse a camera that is given and described at once, and one of no picture."""
    given = [word for word in LOOKING_WORDS if getattr(options, word[2:]) is not None]
    if given and options.preview is None and getattr(options, "view", None) is None:
        raise ArgumentError(f"{min(given)} has no meaning without a picture to draw")
    for word, given in (("--direction", options.direction), ("--up", options.up)):
        if given is not None and options.frame is not None:
            raise ArgumentError(f"{word} and --frame both say where the camera is; give one of them")
    if options.direction is not None and not any(options.direction):
        raise ArgumentError("--direction must not be 0,0,0")
