"""What shape a model takes before it is used, as options say it: --pose, --subdiv-levels."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import octex
from octex.cli.arguments import whole_number
from octex.cli.parser import option
from octex.errors import ArgumentError

if TYPE_CHECKING:
    from octex.source.surface import Surface

SHAPE_OPTIONS = (
    option(
        "--pose",
        "pose of an animated glTF model, like Run@0.5; rest positions do not change (octex help surfaces)",
        metavar="NAME@SECONDS",
    ),
    option(
        "--subdiv-levels",
        "treat the model as a control cage and subdivide it N times, by Catmull–Clark or Loop",
        metavar="N",
        type=whole_number,
    ),
    option(
        "--subdiv-rest",
        "rest positions of a subdivided model: hull, the cage's (default), or limit, the limit surface's",
        metavar="KIND",
        choices=("hull", "limit"),
    ),
)
SHAPE_WORDS = {each.word for each in SHAPE_OPTIONS}


def shaped_model(path: Path, options: argparse.Namespace, **settings: Any) -> Surface:
    """Read a model, as ``octex.load_surface`` does, at its rest positions, in its pose, and subdivided."""
    surface = octex.load_surface(path, options.rest, pose=options.pose, **settings)
    if options.subdiv_levels is None:
        return surface
    return octex.subdivide(surface, options.subdiv_levels, rest=options.subdiv_rest or "hull")


def check_shape(options: argparse.Namespace, is_function: bool) -> None:
    """Refuse a pose of more models than one, and of a function; and options without what they are of."""
    if options.pose is not None:
        if is_function:
            raise ArgumentError("--pose is of glTF models, not of functions")
        if options.also:
            raise ArgumentError("--pose is of one model; with --also there are more")
    if options.subdiv_levels is not None and is_function:
        raise ArgumentError("--subdiv-levels is of meshes, not of functions: give a smaller --edge")
    check_subdivision(options)


def check_subdivision(options: argparse.Namespace) -> None:
    """Refuse rest positions of a subdivision surface that is none."""
    if options.subdiv_rest is not None and options.subdiv_levels is None:
        raise ArgumentError("--subdiv-rest has no meaning without --subdiv-levels")
