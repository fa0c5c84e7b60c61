"""What shape a model takes before it is used, as options say it: --pose."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import octex
from octex.cli.parser import option
from octex.errors import ArgumentError

if TYPE_CHECKING:
    from octex.source.surface import Surface

SHAPE_OPTIONS = (
    option(
        "--pose",
        "how an animation of a glTF model moves it, by its skins, morph targets and nodes, like Run@0.5; "
        "rest positions stay (octex help surfaces)",
        metavar="NAME@SECONDS",
    ),
)
SHAPE_WORDS = {each.word for each in SHAPE_OPTIONS}


def shaped_model(path: Path, options: argparse.Namespace, **settings: Any) -> Surface:
    """Read a model, as ``octex.load_surface`` does, at its rest positions and in its pose."""
    return octex.load_surface(path, options.rest, pose=options.pose, **settings)


def check_shape(options: argparse.Namespace, is_function: bool) -> None:
    """Refuse a pose of more models than one, and of a function."""
    if is_function and options.pose is not None:
        raise ArgumentError("--pose is of glTF models, not of functions")
    if options.also and options.pose is not None:
        raise ArgumentError("--pose is of one model; with --also there are more")
