"""The options of octree-paint, and which go together."""

from __future__ import annotations

import argparse

from octex.cli.addresses import TEXTURE_ENDINGS, file_here, output_file, texture_file
from octex.cli.arguments import (
    BALANCES,
    BLENDS,
    HOLES,
    PICTURES,
    angle,
    camera,
    color,
    disc,
    file_size,
    mask_pattern,
    one_of,
    opacity,
    picture_size,
    pixels,
    whole_number,
)
from octex.cli.models import DEFAULT_CHANNEL
from octex.cli.parser import RUNNING, Command, option, words_given
from octex.cli.shape_options import SHAPE_OPTIONS, SHAPE_WORDS, check_subdivision
from octex.cli.view import DEFAULT_SIZE
from octex.cli.view_options import VIEW_OPTIONS, VIEW_WORDS, check_view_options
from octex.errors import ArgumentError

_OPTIONS = (
    option("MODEL", "the model, posed as the cameras see it", nargs="?", type=file_here),
    option(
        "TEXTURE",
        "its texture, .octex or .octz; if it is left out, or not there, a new one is begun",
        nargs="?",
        type=texture_file,
    ),
    option(
        "IMAGE",
        "pictures, whose frames are found by their file names, or IMAGE=FRAME (default: those that FILE "
        "names)",
        nargs="*",
        type=file_here,
    ),
    option(
        "--camera",
        "where the cameras are: transforms.json, a COLMAP folder, Metashape's .xml, OpenMVS's .mvs, "
        "Meshroom's .sfm, OpenSfM's or OpenMVG's .json, Bundler's .out, .npz, glTF, or what --camera-out "
        "wrote",
        metavar="FILE[#NAME]",
        type=camera,
    ),
    option(
        "--unwrap",
        "a disc of the surface laid flat, not a camera: its centre, and its radius along the surface; the "
        "same for --view and for painting what it drew",
        metavar="X,Y,Z,R",
        type=disc,
    ),
    option(
        "--conformal",
        "with --unwrap: lay it out so that angles change least; opens ears and limbs, which fold otherwise",
        action="store_true",
    ),
    option("--out", "the painted texture; with --force also TEXTURE", metavar="NEW", type=output_file),
    option(
        "--mask",
        "white where paint goes: one for all, or one for each IMAGE in order; any number of times",
        metavar="PNG",
        action="append",
        type=file_here,
    ),
    option(
        "--masks",
        "the mask of each picture: a path with {stem}, its name without the ending, or {name}",
        metavar="PATTERN",
        type=mask_pattern,
    ),
    option(
        "--key",
        "a colour that is not painted, of a backdrop: R,G,B from 0 to 255, or '#rrggbb'",
        metavar="COLOUR",
        type=color,
    ),
    option(
        "--since",
        "the picture before it was drawn on: only pixels that differ are painted (default: the view that "
        "--camera-out keeps)",
        metavar="PNG",
        type=file_here,
    ),
    option("--whole", "paint all of a view, not only what was drawn on it", action="store_true"),
    option(
        "--blend",
        f"how paint is put: {', '.join(BLENDS)} (default over)",
        metavar="MODE",
        type=one_of(BLENDS),
    ),
    option("--opacity", "0 to 1: multiplies the pictures' alpha (default 1)", metavar="X", type=opacity),
    option("--channel", f"what is painted (default {DEFAULT_CHANNEL})", metavar="NAME"),
    option(
        "--max-depth",
        "the deepest level that paint goes to (default: cells of half a pixel to one, at most level 14)",
        metavar="N",
        type=whole_number,
    ),
    option(
        "--max-angle",
        "between the surface's normal and the way to the camera, from which on nothing is painted "
        "(default 75; 85 for what was drawn on a view)",
        metavar="DEGREES",
        type=angle,
    ),
    option(
        "--edge-feather",
        "fade paint towards the picture's rim and edges in depth (default 0)",
        metavar="PIXELS",
        type=pixels,
    ),
    option(
        "--pictures",
        "of several that see a place: average; robust, which leaves out what does not agree with most; or "
        "best, one for each patch, with levelled borders (default: robust for three or more)",
        metavar="MODE",
        type=one_of(PICTURES),
    ),
    option(
        "--balance",
        "make overlapping pictures agree: gain multiplies each; full multiplies each component, and undoes "
        "vignetting",
        metavar="MODE",
        type=one_of(BALANCES),
    ),
    option(
        "--reference",
        "the picture that --balance leaves as light as it is, and --refine-cameras where it is (default: the "
        "median gain is 1, and the camera that shares most stays)",
        metavar="IMAGE",
        type=file_here,
    ),
    option(
        "--refine-cameras",
        "turn, move and zoom the cameras a little, by which overlapping pictures agree best",
        action="store_true",
    ),
    option("--save-cameras", "keep the refined cameras, for --camera", metavar="JSON", type=output_file),
    option("--back-faces", "paint also what faces away", action="store_true"),
    option(
        "--holes",
        "what a new texture has where no picture saw the model: smooth fills it from around, over the "
        "surface; leave leaves it without cells (default smooth)",
        metavar="MODE",
        type=one_of(HOLES),
    ),
    option(
        "--coverage",
        "keep how much of each cell pictures cover, in the channel coverage",
        action="store_true",
    ),
    option(
        "--memory",
        "if the pictures would take more, keep them decoded in a folder beside --out meanwhile",
        metavar="SIZE",
        type=file_size,
    ),
    option(
        "--resume",
        "keep what is done in FOLDER, and go on from what is there: after a stop, or with other options; "
        "yours to delete",
        metavar="FOLDER",
        type=output_file,
    ),
    option("--no-fit", "store plain averages; lookups are then softer", action="store_true"),
    option(
        "--background",
        "begin a new texture in this colour all over: R,G,B from 0 to 255, or '#rrggbb'",
        metavar="COLOUR",
        type=color,
    ),
    option("--rest", "the undeformed model, of the same topology as MODEL", metavar="MESH", type=file_here),
    *SHAPE_OPTIONS,
    option("--preview", "draw the model beside the model from its octree", metavar="PNG", type=output_file),
    option("--layer-out", "keep the paint itself, .octex, for --layer", metavar="LAYER", type=output_file),
    option(
        "--layer",
        "merge paint kept before; any number of times, in this order",
        metavar="LAYER",
        action="append",
        type=file_here,
    ),
    option(
        "--view",
        "draw what the camera sees, unlit and as transparent as the texture, to be painted on and sent "
        "back; --blend replace then leaves transparency as it is, over adds to what is translucent",
        metavar="PNG",
        type=output_file,
    ),
    option(
        "--empty-layer",
        "beside that picture, a transparent one of its size: what is painted on it is all that is painted",
        metavar="PNG",
        type=output_file,
    ),
    option(
        "--camera-out", "the camera of that picture, .json, for --camera", metavar="CAMERA", type=output_file
    ),
    option(
        "--size",
        f"pixels of that picture (default: the camera's, or {DEFAULT_SIZE[0]},{DEFAULT_SIZE[1]})",
        metavar="W,H",
        type=picture_size,
    ),
    *VIEW_OPTIONS,
    option("--shaded", "draw that picture in studio light, to be looked at", action="store_true"),
    *RUNNING,
)

# Which options go with which work.
_SHARED = {"MODEL", "TEXTURE", "--rest", "--force", "--threads", "--quiet", "--json"} | SHAPE_WORDS
_MERGE = _SHARED | VIEW_WORDS | {"--out", "--blend", "--opacity", "--preview"}
_WORDS = {
    "painting": _MERGE
    | {"IMAGE", "--camera", "--unwrap", "--conformal", "--mask", "--masks", "--key", "--since", "--whole"}
    | {"--channel", "--max-depth", "--max-angle", "--edge-feather", "--pictures", "--balance", "--reference"}
    | {"--refine-cameras", "--save-cameras", "--back-faces", "--holes", "--coverage", "--memory", "--resume"}
    | {"--background", "--layer-out", "--no-fit"},
    "--layer": _MERGE,
    "--view": _SHARED
    | VIEW_WORDS
    | {"--shaded", "--empty-layer", "--camera-out", "--camera", "--size", "--channel"}
    | {"--unwrap", "--conformal"},
}
_NEEDED = {
    "painting": ("MODEL", "--camera", "--out"),
    "--layer": ("MODEL", "--out"),
    "--view": ("MODEL",),
}

PAINT = Command(
    "Paint pictures through their cameras onto a model's octree texture.",
    [each for each in _OPTIONS if not each.word.startswith("-")],
    [each for each in _OPTIONS if each.word.startswith("-")],
    [
        "droid.glb droid.octex --view view.png --camera-out camera.json",
        "droid.glb droid.octex view.png --camera camera.json --out painted.octex",
    ],
    usual=(
        *("--camera", "--out", "--mask", "--blend", "--opacity", "--max-depth", "--balance", "--preview"),
        *("--layer-out", "--layer", "--view", "--empty-layer", "--camera-out", "--size"),
        *("--force", "--quiet", "--json"),
    ),
    usages=[
        ["MODEL", "TEXTURE", "IMAGE", "--camera", "--out"],
        ["MODEL", "TEXTURE", "--layer", "--out"],
        ["MODEL", "TEXTURE", "--view"],
        ["MODEL", "TEXTURE", "IMAGE", "--unwrap", "--out"],
    ],
)


def work_of(options: argparse.Namespace, program: str) -> str:
    """Return what is to be done, a key of _WORDS, or refuse options that make no sense together."""
    if options.TEXTURE is not None and options.TEXTURE.suffix.lower() not in TEXTURE_ENDINGS:
        options.IMAGE.insert(0, options.TEXTURE)  # a new texture needs no name
        options.TEXTURE = None
    given = words_given(options)
    work = next((word for word in ("--view", "--layer") if word in given), "painting")
    for word in given:
        if word != work and word not in _WORDS[work]:
            raise ArgumentError(f"{word} has no meaning with {work}; see {program} --help")
    check_subdivision(options)
    for word in _NEEDED[work]:
        if word not in given and not (word == "--camera" and options.unwrap is not None):
            raise ArgumentError(f"{word} is missing; see {program} --help")
    check_view_options(options)
    is_there = options.TEXTURE is not None and options.TEXTURE.exists()
    if options.unwrap is not None:
        for word in ("--camera", "--camera-out", "--direction", "--zoom", "--frame"):
            if word in given:
                raise ArgumentError(f"{word} has no meaning with --unwrap, which says what is seen")
        if work == "painting" and not options.IMAGE:
            raise ArgumentError(f"IMAGE is missing; see {program} --help")
    elif options.conformal:
        raise ArgumentError("--conformal has no meaning without --unwrap")
    elif work == "--view" and options.camera is None and options.camera_out is None:
        raise ArgumentError(
            "--view without --camera needs --camera-out: without its camera a picture cannot be painted back"
        )
    if options.empty_layer is not None and options.empty_layer.name == options.view.name:
        raise ArgumentError(
            f"--empty-layer has the name of --view, {options.view.name}, by which its camera is found; "
            "give it another"
        )
    if options.background is not None and is_there:
        raise ArgumentError(f"{options.TEXTURE}: exists already; --background is for a new texture")
    if options.holes is not None and (is_there or options.background is not None):
        why = (
            "--background leaves none" if options.background is not None else f"{options.TEXTURE} has colours"
        )
        raise ArgumentError(f"{why}; --holes is for a new texture")
    if options.blend == "erase" and not is_there:
        what = "there is no TEXTURE" if options.TEXTURE is None else f"{options.TEXTURE}: does not exist"
        raise ArgumentError(f"{what}; there is nothing to erase")
    if options.reference is not None and options.balance is None and not options.refine_cameras:
        raise ArgumentError(
            "--reference has no meaning without --balance or --refine-cameras; give one of them"
        )
    if options.save_cameras is not None and not options.refine_cameras:
        raise ArgumentError("--save-cameras has no meaning without --refine-cameras; give both")
    if options.mask is not None and options.masks is not None:
        raise ArgumentError("--mask and --masks both say what the masks are; give one of them")
    if options.mask is not None and len(options.mask) not in (1, len(options.IMAGE)):
        raise ArgumentError(
            f"--mask gives {len(options.mask)} for {len(options.IMAGE)} IMAGEs; give one for all, or one for "
            "each IMAGE"
        )
    return work
