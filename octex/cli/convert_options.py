"""The options of octree-convert, and which go together."""

from __future__ import annotations

import argparse
from pathlib import Path

import octex
from octex.cli.arguments import (
    AXES,
    DTYPES,
    FILTERS,
    PROJECTIONS,
    angle,
    axis,
    box,
    cells_apart,
    channel_names,
    count,
    dtypes,
    error_codes,
    file_and_amount,
    image_filter,
    length,
    levels,
    position,
    projection,
    sizes,
    source,
    whole_number,
)
from octex.cli.common import Parser, words_given
from octex.cli.models import DEFAULT_FILTER, TEXTURE_ENDING, check_elsewhere, sources_of
from octex.cli.overlaps import SEPARATE_CELLS
from octex.errors import ArgumentError

COMMAND = "octree-convert"

# Which options go with which work; INPUT and OUTPUT are options here too.
_PROJECTION = {"--project", "--project-axis", "--project-center", "--project-size"}
_ELSEWHERE = {"--transfer", "--cloud", "--radius", "--max-distance", "--max-angle"}
_MATERIALS = {"--channels", "--source", "--filter", "--rest", "--also", "--bounds", "--edge"}
_MATERIALS |= _PROJECTION | _ELSEWHERE
#: What makes another texture of a texture alone.
_OF_TEXTURES = {"--crop", "--combine", "--mix", "--blur", "--levels"}
_OF_ANYTHING = {"INPUT", "OUTPUT", "--depth", "--channels", "--dtype"}
_OF_ANYTHING |= {"--preview", "--force", "--threads", "--quiet", "--json"}
_OPTIONS = {
    "a conversion": {"--cell", "--max-error", "--detail", "--no-fit", "--separate", "--parts"}
    | _OF_ANYTHING
    | _OF_TEXTURES
    | _MATERIALS,
    "--diff": {"--points", "--preview", "--force", "--quiet", "--json"} | _MATERIALS,
    "--overlaps": {"--margin", "--rest", "--json", "--quiet"},
    "--info": {"--json"},
    "--validate": {"--json", "--quiet"},
    "--warm-up": {"--quiet"},
}


def parser() -> Parser:
    """Return the parser of octree-convert's arguments."""
    parser = Parser(
        prog=COMMAND,
        description="Convert a textured model (glTF, GLB, OBJ, PLY, OFF, STL), or coloured points (PLY, XYZ, "
        "NPZ), to an octree texture.",
        usage=f"{COMMAND} INPUT OUTPUT [--depth N | --cell SIZE] [--max-error CODES]\n"
        f"{'':29}[--detail stretch|CHANNEL] [--no-fit] [--rest MESH] [--channels NAMES]\n"
        f"{'':29}[--source CHANNEL=FILE ...] [--filter NAME] [--dtype TYPE]\n"
        f"{'':29}[--also MODEL ...] [--bounds BOX --edge LENGTH]\n"
        f"{'':29}[--project planar|box|cylindrical|spherical] [--project-axis AXIS]\n"
        f"{'':29}[--project-center X,Y,Z] [--project-size SIZE]\n"
        f"{'':29}[--transfer MODEL | --cloud POINTS [--radius R]] [--max-distance D]\n"
        f"{'':29}[--max-angle DEGREES]\n"
        f"{'':29}[--separate [CELLS] | --parts] [--preview PNG] [--force] [--threads N] [--quiet]\n"
        f"{'':29}[--json]\n"
        f"       {COMMAND} TEXTURE OUTPUT [--crop BOX] [--depth N] [--combine FILE] [--mix FILE=AMOUNT]\n"
        f"{'':29}[--blur WIDTH] [--levels BLACK,WHITE[,GAMMA]] [--channels NAMES]\n"
        f"{'':29}[--dtype TYPE] [--preview PNG] [--force] [--threads N] [--quiet] [--json]\n"
        f"       {COMMAND} --diff A B [--channels NAMES] [--points N] [--rest MESH] [--filter NAME]\n"
        f"{'':29}[--source CHANNEL=FILE ...] [--project KIND ...] [--preview PNG] [--force]\n"
        f"{'':29}[--quiet] [--json]\n"
        f"       {COMMAND} --overlaps MODEL [--margin SIZE] [--rest MESH] [--quiet] [--json]\n"
        f"       {COMMAND} --info FILE [--json]\n"
        f"       {COMMAND} --validate FILE [--quiet] [--json]\n"
        f"       {COMMAND} --warm-up [--quiet]\n"
        f"       {COMMAND} --version | --help",
    )
    add = parser.add_argument
    add(
        "INPUT",
        nargs="?",
        type=Path,
        help="the model, a cloud of points, an .octex file made before, or FILE.py:NAME, "
        "a function of positions (n, 3), below 0 inside",
    )
    add(
        "OUTPUT",
        nargs="?",
        type=Path,
        help="NAME.octex, or NAME.ply: a coloured point a leaf, with normal; with --parts a folder",
    )
    add(
        "--depth",
        metavar="N",
        type=whole_number,
        help="levels below the root: cells of 1/2^N of its edge (default 10)",
    )
    add(
        "--cell",
        metavar="SIZE",
        type=length,
        help="edge of the finest cells in the model's units, not --depth",
    )
    add(
        "--max-error",
        metavar="CODES",
        type=error_codes,
        help="merge leaves where lookups then stay this near to what they were, in 8-bit codes, like 2",
    )
    add(
        "--detail",
        metavar="stretch|CHANNEL",
        help="go less deep where the pose stretches less than elsewhere, or where a channel is below 1 (1/2: "
        "a level less); --source detail=mask.png paints one",
    )
    add("--no-fit", action="store_true", help="store plain averages; lookups are then softer")
    add("--rest", metavar="MESH", type=Path, help="the undeformed model, of the same topology as INPUT")
    add(
        "--also",
        metavar="MODEL",
        type=Path,
        action="append",
        help="another model that shares the texture; any number of times",
    )
    add(
        "--bounds",
        metavar="BOX",
        type=box,
        help="where a surface that is a function lies: x0,y0,z0,x1,y1,z1",
    )
    add("--edge", metavar="LENGTH", type=length, help="how long the triangles' edges are on such a surface")
    add(
        "--channels",
        metavar="NAMES",
        type=channel_names,
        help="what to convert or compare, like base_color,normal (default: all that there is)",
    )
    add(
        "--source",
        metavar="CHANNEL=FILE",
        type=source,
        action="append",
        help="take a channel from an image, read at the model's texture coordinates, from a function of "
        "positions (n, 3), base_color=wood.py:rings, or make it constant: roughness=0.5, "
        "base_color=0.2,0.4,0.6 (linear light); any number of times",
    )
    add(
        "--project",
        metavar="KIND",
        type=projection,
        help="read the images that --source gives by position, not at texture coordinates: "
        f"{', '.join(PROJECTIONS)}",
    )
    add(
        "--project-axis",
        metavar="AXIS",
        type=axis,
        help=f"where a plane is seen from, or the other kinds' up: {', '.join(AXES)} (default z)",
    )
    add(
        "--project-center",
        metavar="X,Y,Z",
        type=position,
        help="where the picture's middle is, or what it goes around (default: the middle of the bounds)",
    )
    add(
        "--project-size",
        metavar="SIZE",
        type=sizes,
        help="what one copy of the picture spans, in the model's units, or along x, y and z: 1,1,0.5 "
        "(default: the bounds; for a box their largest extent)",
    )
    add(
        "--transfer",
        metavar="MODEL",
        type=Path,
        help="take all channels that another model has where its surface is nearest",
    )
    add(
        "--cloud",
        metavar="POINTS",
        type=Path,
        help="take colours from points (.ply, .xyz, .npz): the nearest, or the mean of those in --radius",
    )
    add("--radius", metavar="R", type=length, help="how far points of --cloud count, in the model's units")
    add(
        "--max-distance",
        metavar="D",
        type=length,
        help="leave cells empty that are farther than this from what they would take values from",
    )
    add(
        "--max-angle",
        metavar="DEGREES",
        type=angle,
        help="by how much normals may differ from where values are taken (default 180, 90 for points)",
    )
    add(
        "--filter",
        metavar="NAME",
        type=image_filter,
        help=f"how images are read: {', '.join(FILTERS)} (default {DEFAULT_FILTER})",
    )
    add(
        "--dtype",
        metavar="TYPE",
        type=dtypes,
        help=f"what is stored: {', '.join(DTYPES)}; for some channels normal=uint16,emissive=float16 "
        "(default uint8, float16 for light above 1)",
    )
    add(
        "--separate",
        metavar="CELLS",
        nargs="?",
        const=SEPARATE_CELLS,
        type=cells_apart,
        help="move parts apart at rest that intersect or come nearer than so many of the finest cells "
        f"(default {SEPARATE_CELLS:g}), so that their colours do not run together",
    )
    add(
        "--parts",
        action="store_true",
        help="give each part a texture of its own, so that nothing bleeds: OUTPUT is a folder then",
    )
    add(
        "--crop",
        metavar="BOX",
        type=box,
        help="of a texture: only the cells that meet a box, x0,y0,z0,x1,y1,z1 in rest positions",
    )
    add(
        "--combine",
        metavar="FILE",
        type=Path,
        help="of a texture: lay another .octex file of the same root cell over it",
    )
    add(
        "--mix",
        metavar="FILE=AMOUNT",
        type=file_and_amount,
        help="of a texture: mix it with another .octex file, of which there is AMOUNT, 0 to 1",
    )
    add("--blur", metavar="WIDTH", type=length, help="of a texture: blur it, in the model's units")
    add(
        "--levels",
        metavar="BLACK,WHITE[,GAMMA]",
        type=levels,
        help="of a texture: base colour from BLACK to WHITE, encoded 0 to 1, becomes 0 to 1",
    )
    add("--preview", metavar="PNG", type=Path, help="draw the model beside the model from its octree")
    add("--force", action="store_true", help="overwrite what exists")
    add("--threads", metavar="N", type=count, help="threads to work on (default: all processors)")
    add("--quiet", action="store_true", help="print nothing but errors (and what --json asks for)")
    add("--json", action="store_true", help="print the result as one JSON object")
    add(
        "--diff",
        metavar=("A", "B"),
        nargs=2,
        type=Path,
        help="say how two textures, or a texture and a model, differ over the surface; --preview draws it. "
        "The exit code is 0 whether they differ or not",
    )
    add(
        "--points",
        metavar="N",
        type=count,
        help="points on the model to compare at (default 1,000,000); two textures are compared at all leaves",
    )
    add(
        "--overlaps",
        metavar="MODEL",
        type=Path,
        help="say which parts of a model intersect, or come nearer to each other than --margin. The exit "
        "code is 0 whether some do or not",
    )
    add(
        "--margin",
        metavar="SIZE",
        type=length,
        help="how near parts may come to each other, in the model's units (default: not at all)",
    )
    add("--info", metavar="FILE", type=Path, help="say what an .octex file or a folder of --parts holds")
    add(
        "--validate",
        metavar="FILE",
        type=Path,
        help="check that an .octex file, or each in a folder of --parts, is a sound octree, or say what is "
        "broken",
    )
    add("--warm-up", action="store_true", help="compile everything now; later runs start at once")
    add("--version", action="version", version=f"{COMMAND} {octex.__version__}")
    return parser


def work_of(options: argparse.Namespace) -> str:
    """Return what is to be done, a key of _OPTIONS, or refuse options that make no sense together."""
    given = words_given(options)
    work = next((word for word in given if word in _OPTIONS), "a conversion")
    for word in given:
        if word != work and word not in _OPTIONS[work]:
            raise ArgumentError(f"{word} has no meaning with {work}; see {COMMAND} --help")
    if options.source is not None or not _PROJECTION.isdisjoint(given):
        sources_of(options)  # refuses what contradicts itself
    check_elsewhere(options)
    if work == "a conversion":
        for word in ("INPUT", "OUTPUT"):
            if word not in given:
                raise ArgumentError(f"{word} is missing; see {COMMAND} --help")
        if options.depth is not None and options.cell is not None:
            raise ArgumentError("--depth and --cell both say how fine the cells are; give one of them")
        for word in ("--separate", "--preview"):
            if options.parts and word in given:
                raise ArgumentError(f"{word} has no meaning with --parts; see {COMMAND} --help")
    return work


def check_input(options: argparse.Namespace, kind: str) -> None:
    """Refuse options that make no sense for what INPUT is: "texture", "cloud" or "model"."""
    given = words_given(options)
    for word in given:
        if kind != "texture" and word in _OF_TEXTURES:
            raise ArgumentError(f"{options.INPUT}: {word} is for .octex textures; convert the model first")
        if kind == "texture" and word not in _OF_ANYTHING | _OF_TEXTURES:
            raise ArgumentError(
                f"{options.INPUT}: {word} needs the model, and this is a texture made from one"
            )
        if kind == "cloud" and word not in _OF_ANYTHING | {"--cell"}:
            raise ArgumentError(f"{word} needs a surface, and {options.INPUT} is points")
    is_same = not {"--depth", "--channels", "--dtype", *_OF_TEXTURES} & {*given}
    if kind == "texture" and is_same and options.OUTPUT.suffix.lower() == TEXTURE_ENDING:
        raise ArgumentError(
            f"{options.INPUT}: is an octree texture already; --depth makes it coarser, --channels smaller; "
            f"see {COMMAND} --help"
        )
