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
    option("MODEL", "the model, in the pose that the cameras see", nargs="?", type=file_here),
    option(
        "TEXTURE",
        "its texture, .octex or .octz; if missing, a new one is made",
        nargs="?",
        type=texture_file,
    ),
    option(
        "IMAGE",
        "pictures; each takes the camera with its file name, or IMAGE=FRAME names one (default: the "
        "pictures that FILE names)",
        nargs="*",
        type=file_here,
    ),
    option(
        "--camera",
        "file with the cameras: octex's camera.json, transforms.json, a COLMAP folder, Metashape "
        ".xml, OpenMVS .mvs, Meshroom .sfm, OpenSfM or OpenMVG .json, Bundler .out, .npz, glTF",
        metavar="FILE[#NAME]",
        type=camera,
    ),
    option(
        "--unwrap",
        "paint on a disc of the surface laid flat instead of a camera's view: centre and radius along "
        "the surface",
        metavar="X,Y,Z,R",
        type=disc,
    ),
    option(
        "--conformal",
        "with --unwrap: preserve angles, so that ears and limbs lie open instead of folding",
        action="store_true",
    ),
    option(
        "--out",
        "write the painted texture here; with --force it may be TEXTURE",
        metavar="NEW",
        type=output_file,
    ),
    option(
        "--mask",
        "mask image, white = paint; give one, or one per IMAGE",
        metavar="PNG",
        action="append",
        type=file_here,
    ),
    option(
        "--masks",
        "path of each picture's mask, with {stem} for the picture's name without ending, or {name}",
        metavar="PATTERN",
        type=mask_pattern,
    ),
    option(
        "--key",
        "do not paint this backdrop colour: R,G,B from 0 to 255, or '#rrggbb'",
        metavar="COLOUR",
        type=color,
    ),
    option(
        "--since",
        "the unedited view: only pixels that you changed are painted (default: the view in the camera file)",
        metavar="PNG",
        type=file_here,
    ),
    option("--whole", "paint all pixels of a view, not only those that you changed", action="store_true"),
    option(
        "--blend",
        f"how paint combines with the texture: {', '.join(BLENDS)} (default over)",
        metavar="MODE",
        type=one_of(BLENDS),
    ),
    option("--opacity", "opacity of the paint, 0 to 1 (default 1)", metavar="X", type=opacity),
    option("--channel", f"channel to paint (default {DEFAULT_CHANNEL})", metavar="NAME"),
    option(
        "--max-depth",
        "deepest level of the paint (default: cells of half a pixel to one, at most level 14)",
        metavar="N",
        type=whole_number,
    ),
    option(
        "--max-angle",
        "do not paint surfaces tilted more than DEGREES from the camera (default 75; 85 for a view "
        "drawn by octex)",
        metavar="DEGREES",
        type=angle,
    ),
    option(
        "--edge-feather",
        "fade paint toward the picture's border and toward edges in depth (default 0)",
        metavar="PIXELS",
        type=pixels,
    ),
    option(
        "--pictures",
        "how overlapping pictures combine: average; robust leaves out what only one shows; best takes "
        "one per patch and levels the borders (default robust for three or more)",
        metavar="MODE",
        type=one_of(PICTURES),
    ),
    option(
        "--balance",
        "match the exposures of overlapping pictures: gain scales each; full scales each colour "
        "component and removes vignetting",
        metavar="MODE",
        type=one_of(BALANCES),
    ),
    option(
        "--reference",
        "the picture that --balance and --refine-cameras do not change (default: median gain 1, and "
        "the camera that overlaps most)",
        metavar="IMAGE",
        type=file_here,
    ),
    option(
        "--refine-cameras",
        "turn, move and zoom cameras by a few pixels until the pictures agree",
        action="store_true",
    ),
    option("--save-cameras", "write the refined cameras, for --camera", metavar="JSON", type=output_file),
    option("--back-faces", "also paint surface that faces away from the camera", action="store_true"),
    option(
        "--holes",
        "how to fill unseen areas of a new texture: smooth (continue the colours) or leave (no cells) "
        "(default smooth)",
        metavar="MODE",
        type=one_of(HOLES),
    ),
    option(
        "--coverage",
        "also store how much of each cell the pictures cover, as channel coverage",
        action="store_true",
    ),
    option(
        "--memory",
        "limit of memory, like 4GB: keep decoded pictures in files next to --out beyond it",
        metavar="SIZE",
        type=file_size,
    ),
    option(
        "--resume",
        "store finished stages in FOLDER and reuse them, after a stop or with other options; you may "
        "delete it",
        metavar="FOLDER",
        type=output_file,
    ),
    option("--no-fit", "store plain averages; lookups are less sharp", action="store_true"),
    option(
        "--background",
        "colour of a new texture: R,G,B from 0 to 255, or '#rrggbb'",
        metavar="COLOUR",
        type=color,
    ),
    option(
        "--rest",
        "the undeformed model, with the same vertices and triangles as MODEL",
        metavar="MESH",
        type=file_here,
    ),
    *SHAPE_OPTIONS,
    option(
        "--preview",
        "write a PNG: the original on the left, the octree texture on the right",
        metavar="PNG",
        type=output_file,
    ),
    option(
        "--layer-out", "write the paint as a layer, .octex, for --layer", metavar="LAYER", type=output_file
    ),
    option(
        "--layer",
        "merge a layer that --layer-out wrote; may be repeated, in this order",
        metavar="LAYER",
        action="append",
        type=file_here,
    ),
    option(
        "--view",
        "write what the camera sees, unlit, to paint on it. When painted back, --blend replace keeps "
        "its transparency",
        metavar="PNG",
        type=output_file,
    ),
    option(
        "--empty-layer",
        "with --view: also write a transparent picture of the same size; only what you draw on it is painted",
        metavar="PNG",
        type=output_file,
    ),
    option(
        "--camera-out", "write the camera of --view, .json, for --camera", metavar="CAMERA", type=output_file
    ),
    option(
        "--size",
        "width and height of --view in pixels (default: the camera's, or "
        f"{DEFAULT_SIZE[0]},{DEFAULT_SIZE[1]})",
        metavar="W,H",
        type=picture_size,
    ),
    *VIEW_OPTIONS,
    option("--shaded", "draw --view in studio light, to look at", action="store_true"),
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
    "Project pictures through their cameras onto a model's octree texture.",
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
