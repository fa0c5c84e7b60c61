"""The options of octree-convert and of the commands beside it, and which go together."""

from __future__ import annotations

import argparse
from collections.abc import Collection, Iterable

from octex.cli.addresses import ARCHIVE_ENDING, TEXTURE_ENDINGS, file_here, output_file, texture_file
from octex.cli.arguments import (
    AXES,
    DTYPES,
    FILTERS,
    PROJECTIONS,
    angle,
    box,
    cells_apart,
    channel_names,
    count,
    dtypes,
    error_codes,
    file_and_amount,
    file_size,
    length,
    levels,
    one_of,
    position,
    sizes,
    source,
    whole_number,
)
from octex.cli.bake import BAKED_ENDINGS
from octex.cli.models import DEFAULT_FILTER, PTEX_ENDING, check_elsewhere, sources_of
from octex.cli.overlaps import SEPARATE_CELLS
from octex.cli.parser import RUNNING, Command, Option, option, words_given
from octex.cli.shape_options import SHAPE_OPTIONS, SHAPE_WORDS
from octex.cli.view_options import VIEW_OPTIONS, VIEW_WORDS, check_view_options
from octex.cli.viewer import PAGE_ENDING, check_page_options
from octex.errors import ArgumentError

_OPTIONS = (
    option(
        "INPUT",
        "the model, a cloud of points, voxels, an .octex file made before, or FILE.py:NAME, "
        "a function of positions (n, 3), below 0 inside",
        nargs="?",
        type=texture_file,
    ),
    option(
        "OUTPUT",
        "NAME.octex; an archive of it, NAME.octz; a coloured point a leaf, with normal: NAME.ply, or "
        "NAME.npz for numpy; NAME.html, a page that shows it in any browser; with --parts a folder",
        nargs="?",
        type=output_file,
    ),
    option(
        "--depth",
        "levels below the root: cells of 1/2^N of its edge (default 10)",
        metavar="N",
        type=whole_number,
    ),
    option(
        "--cell", "edge of the finest cells in the model's units, not --depth", metavar="SIZE", type=length
    ),
    option(
        "--max-error",
        "merge leaves where lookups then stay this near to what they were, in 8-bit codes, like 2; from a "
        "texture to NAME.octz, by how many codes of their own its whole numbers may move",
        metavar="CODES",
        type=error_codes,
    ),
    option(
        "--detail",
        "go less deep where the pose stretches less than elsewhere, or where a channel is below 1 (1/2: "
        "a level less); --source detail=mask.png paints one",
        metavar="stretch|CHANNEL",
    ),
    option(
        "--memory",
        "if the conversion would take more, keep what is large in a folder beside OUTPUT, NAME.octex, "
        "meanwhile",
        metavar="SIZE",
        type=file_size,
    ),
    option("--no-fit", "store plain averages; lookups are then softer", action="store_true"),
    option(
        "--mesh",
        "the model that INPUT is a texture of: OUTPUT is it with images, .glb, .gltf, .obj or .usdz, "
        "with vertex colours, .3mf (octex bake has more options), in a page, .html, or texels for its "
        "polygons, .ptx; where INPUT is a .ptx, the mesh that it was painted on",
        metavar="MODEL",
        type=file_here,
    ),
    option(
        "--max-size",
        "of a page: leave the finest levels out until it is no larger, like 20MB",
        metavar="SIZE",
        type=file_size,
    ),
    option("--rest", "the undeformed model, of the same topology as INPUT", metavar="MESH", type=file_here),
    *SHAPE_OPTIONS,
    option(
        "--also",
        "another model that shares the texture; any number of times",
        metavar="MODEL",
        type=file_here,
        action="append",
    ),
    option("--bounds", "where a surface that is a function lies: x0,y0,z0,x1,y1,z1", metavar="BOX", type=box),
    option("--edge", "how long the triangles' edges are on such a surface", metavar="LENGTH", type=length),
    option(
        "--channels",
        "what to convert or compare, like base_color,normal (default: all that there is)",
        metavar="NAMES",
        type=channel_names,
    ),
    option(
        "--source",
        "take a channel from an image, read at the model's texture coordinates, from a .ptx file, from a "
        "function of positions (n, 3), base_color=wood.py:rings, or make it constant: roughness=0.5, "
        "base_color=0.2,0.4,0.6 (linear light); any number of times",
        metavar="CHANNEL=FILE",
        type=source,
        action="append",
    ),
    option(
        "--project",
        "read the images that --source gives by position, not at texture coordinates: "
        f"{', '.join(PROJECTIONS)}",
        metavar="KIND",
        type=one_of(PROJECTIONS),
    ),
    option(
        "--project-axis",
        f"where a plane is seen from, or the other kinds' up: {', '.join(AXES)} (default z)",
        metavar="AXIS",
        type=one_of(AXES),
    ),
    option(
        "--project-center",
        "where the picture's middle is, or what it goes around (default: the middle of the bounds)",
        metavar="X,Y,Z",
        type=position,
    ),
    option(
        "--project-size",
        "what one copy of the picture spans, in the model's units, or along x, y and z: 1,1,0.5 "
        "(default: the bounds; for a box their largest extent)",
        metavar="SIZE",
        type=sizes,
    ),
    option(
        "--transfer",
        "take all channels that another model has where its surface is nearest",
        metavar="MODEL",
        type=file_here,
    ),
    option(
        "--cloud",
        "take colours from points (.ply, .xyz, .npz): the nearest, or the mean of those in --radius",
        metavar="POINTS",
        type=file_here,
    ),
    option("--radius", "how far points of --cloud count, in the model's units", metavar="R", type=length),
    option(
        "--max-distance",
        "leave cells empty that are farther than this from what they would take values from",
        metavar="D",
        type=length,
    ),
    option(
        "--max-angle",
        "by how much normals may differ from where values are taken (default 180, 90 for points)",
        metavar="DEGREES",
        type=angle,
    ),
    option(
        "--filter",
        f"how images are read: {', '.join(FILTERS)} (default {DEFAULT_FILTER})",
        metavar="NAME",
        type=one_of(FILTERS),
    ),
    option(
        "--dtype",
        f"what is stored: {', '.join(DTYPES)}; for some channels normal=uint16,emissive=float16 "
        "(default uint8, float16 for light above 1)",
        metavar="TYPE",
        type=dtypes,
    ),
    option(
        "--separate",
        "move parts apart at rest that intersect or come nearer than so many of the finest cells "
        f"(default {SEPARATE_CELLS:g}), so that their colours do not run together",
        metavar="CELLS",
        nargs="?",
        const=SEPARATE_CELLS,
        type=cells_apart,
    ),
    option(
        "--parts",
        "give each part a texture of its own, so that nothing bleeds: OUTPUT is a folder then",
        action="store_true",
    ),
    option(
        "--crop",
        "of a texture: only the cells that meet a box, x0,y0,z0,x1,y1,z1 in rest positions",
        metavar="BOX",
        type=box,
    ),
    option(
        "--combine",
        "of a texture: lay another .octex file of the same root cell over it",
        metavar="FILE",
        type=texture_file,
    ),
    option(
        "--mix",
        "of a texture: mix it with another .octex file, of which there is AMOUNT, 0 to 1",
        metavar="FILE=AMOUNT",
        type=file_and_amount,
    ),
    option("--blur", "of a texture: blur it, in the model's units", metavar="WIDTH", type=length),
    option(
        "--levels",
        "of a texture: base colour from BLACK to WHITE, encoded 0 to 1, becomes 0 to 1",
        metavar="BLACK,WHITE[,GAMMA]",
        type=levels,
    ),
    option("--preview", "draw the model beside the model from its octree", metavar="PNG", type=output_file),
    *VIEW_OPTIONS,
    *RUNNING,
    option(
        "--diff",
        "say how two textures, or a texture and a model, differ over the surface; --preview draws it. "
        "The exit code is 0 whether they differ or not",
        metavar=("A", "B"),
        nargs=2,
        type=texture_file,
    ),
    option(
        "--points",
        "points on the model to compare at (default 1,000,000); two textures are compared at all leaves",
        metavar="N",
        type=count,
    ),
    option(
        "--overlaps",
        "say which parts of a model intersect, or come nearer to each other than --margin. The exit "
        "code is 0 whether some do or not",
        metavar="MODEL",
        type=file_here,
    ),
    option(
        "--margin",
        "how near parts may come to each other, in the model's units (default: not at all)",
        metavar="SIZE",
        type=length,
    ),
    option(
        "--info",
        "say what an .octex or .octz file or a folder of --parts holds",
        metavar="FILE",
        type=texture_file,
    ),
    option(
        "--validate",
        "check that an .octex or .octz file, or each in a folder of --parts, is sound, or say what is broken",
        metavar="FILE",
        type=texture_file,
    ),
    option("--warm-up", "compile everything now; later runs start at once", action="store_true"),
)

#: What a conversion writes, each in one file.
OUTPUT_ENDINGS = (*TEXTURE_ENDINGS, ".ply", ".npz", PAGE_ENDING)

# Which options go with what is done.
_PROJECTION = {"--project", "--project-axis", "--project-center", "--project-size"}
_ELSEWHERE = {"--transfer", "--cloud", "--radius", "--max-distance", "--max-angle"}
_MATERIALS = {"--channels", "--source", "--filter", "--rest", "--also", "--bounds", "--edge"}
_MATERIALS |= _PROJECTION | _ELSEWHERE | SHAPE_WORDS
_MATERIALS |= {"--ptex"}  # what an INPUT is that is a .ptx
#: What has no meaning where only textures are compared.
OF_MODELS = {"--points"} | _MATERIALS - {"--channels"}
#: What makes another texture of a texture alone.
_OF_TEXTURES = {"--crop", "--combine", "--mix", "--blur", "--levels"}
#: In the order in which they are done.
_EDITS = ("--crop", "--depth", "--combine", "--mix", "--blur", "--levels", "--channels", "--dtype")
_OF_ANYTHING = {"INPUT", "OUTPUT", "--depth", "--channels", "--dtype"}
_OF_ANYTHING |= {"--max-size", "--preview", "--force", "--threads", "--quiet", "--json"}
_OF_ANYTHING |= VIEW_WORDS - {"--frame"}
_CONVERSION = "a conversion"
_WORDS = {
    _CONVERSION: {"--cell", "--max-error", "--detail", "--memory", "--no-fit", "--separate", "--parts"}
    | {"--frame"}
    | _OF_ANYTHING
    | _OF_TEXTURES
    | _MATERIALS,
    "--diff": {"--points", "--preview", "--force", "--threads", "--quiet", "--json"} | _MATERIALS,
    "--overlaps": {"--margin", "--rest", "--threads", "--json", "--quiet"},
    "--info": {"--json"},
    "--validate": {"--json", "--quiet"},
    "--warm-up": {"--quiet"},
    "--mesh": {"INPUT", "OUTPUT", "--channels", "--max-size", "--rest", "--force", "--threads", "--quiet"}
    | {"--json"}
    | SHAPE_WORDS,
}
_BY_WORD = {each.word: each for each in _OPTIONS}


def _those(words: Iterable[str], **helps: str) -> list[Option]:
    """Return options, some with a help of their own."""
    settings = {word: _BY_WORD[word].settings for word in words if word.startswith("-")}
    return [
        option(word, **{**given, "help": helps.get(word[2:], given["help"])})
        for word, given in settings.items()
    ]


def _alone(word: str, summary: str, file: str, *examples: str, usual: Collection[str] = ()) -> Command:
    """Return the command that does what octree-convert does where it is given a word."""
    settings = {**_BY_WORD[word].settings, "help": file}
    if isinstance(settings["metavar"], tuple):
        settings["metavar"] = " ".join(settings["metavar"])
    return Command(
        summary,
        [option(word.lstrip("-"), **settings)],
        _those(
            [each for each in _BY_WORD if each in _WORDS[word]],
            rest="the undeformed model, of the same topology",
            preview="draw the difference",
        ),
        examples,
        usual,
    )


CONVERT = Command(
    "Convert a textured model, or coloured points, to an octree texture.",
    [_BY_WORD["INPUT"], _BY_WORD["OUTPUT"]],
    [each for each in _OPTIONS if each.word.startswith("-")],
    [
        "droid.glb droid.octex --depth 10 --preview droid.png",
        "statue.stl statue.octex --source base_color=wood.png --project box",
    ],
    usual=(
        *("--depth", "--cell", "--max-error", "--channels", "--source", "--transfer", "--cloud"),
        *("--separate", "--parts", "--preview", "--force", "--threads"),
    ),
    usages=[
        ["INPUT", "OUTPUT"],
        ["INPUT", "OUTPUT", "--mesh"],
        *([word] for word in _WORDS if word not in (_CONVERSION, "--mesh")),
    ],
)
#: The commands of octex beside octree-paint; the first is octree-convert.
COMMANDS = {
    "convert": CONVERT,
    "edit": Command(
        "Make a texture from a texture; what is asked for is done in the order listed here.",
        [
            option("INPUT", "an .octex file", metavar="TEXTURE", type=texture_file),
            option(
                "OUTPUT",
                "NAME.octex, NAME.octz, a coloured point a leaf: NAME.ply, or NAME.npz; NAME.html",
                type=output_file,
            ),
        ],
        _those(
            [*_EDITS, *(word for word in _BY_WORD if word in _OF_ANYTHING.difference(_EDITS))],
            depth="the averages of a coarser level",
            channels="those to keep, like base_color,normal",
            dtype=f"what is stored: {', '.join(DTYPES)}; for some channels normal=uint16",
            preview="draw the texture",
        ),
        ["droid.octex coarse.octex --depth 7", "droid.octex worn.octex --levels 0.1,0.75,1.3 --blur 0.02"],
    ),
    "info": _alone(
        "--info",
        "Say what a texture holds, and where its bytes go.",
        "an .octex file, or a folder of them as --parts makes it",
        "droid.octex",
        "droid.octex --json",
    ),
    "diff": _alone(
        "--diff",
        "Say how two textures, or a texture and a model, differ over the surface.",
        "two .octex files, or one and a model; the exit code is 0 whether they differ or not",
        "droid.octex droid.glb --preview difference.png",
        "before.octex after.octex --channels base_color --json",
        usual=("--channels", "--points", "--rest", "--preview", "--force", "--quiet", "--json"),
    ),
    "validate": _alone(
        "--validate",
        "Check that a texture is sound, or say what is broken.",
        "an .octex file, or a folder of them as --parts makes it",
        "droid.octex",
        "robot/ --quiet",
    ),
    "overlaps": _alone(
        "--overlaps",
        "Say which parts of a model intersect or nearly touch: their colours would run together.",
        "the model; the exit code is 0 whether some do or not",
        "robot.glb",
        "robot.glb --margin 0.01",
    ),
    "warm-up": Command(
        "Compile all that octex compiles; later runs start at once.", [], _those(_WORDS["--warm-up"]), [""]
    ),
}


def work_of(options: argparse.Namespace, program: str) -> str:
    """Return what is to be done, a key of _WORDS, or refuse options that make no sense together."""
    if options.INPUT is not None and options.INPUT.suffix.lower() == PTEX_ENDING:
        if options.mesh is None:
            raise ArgumentError(f"{options.INPUT}: is texels of a mesh's polygons: give --mesh MODEL")
        options.ptex, options.INPUT, options.mesh = options.INPUT, options.mesh, None
    given = words_given(options)
    work = next((word for word in given if word in _WORDS), _CONVERSION)
    for word in given:
        if word != work and word not in _WORDS[work]:
            raise ArgumentError(f"{word} has no meaning with {work}; see {program} --help")
    if options.source is not None or not _PROJECTION.isdisjoint(given):
        sources_of(options)  # refuses what contradicts itself
    check_elsewhere(options)
    check_view_options(options)
    check_page_options(options)
    if work in (_CONVERSION, "--mesh"):
        for word in ("INPUT", "OUTPUT"):
            if word not in given:
                raise ArgumentError(f"{word} is missing; see {program} --help")
        if work == _CONVERSION and options.OUTPUT.suffix.lower() in (*BAKED_ENDINGS, PTEX_ENDING):
            raise ArgumentError(
                f"{options.OUTPUT}: a texture is baked onto its model: {_mesh_needed(options)}"
            )
        if work == _CONVERSION and options.OUTPUT.suffix.lower() == PAGE_ENDING and options.INPUT.is_dir():
            raise ArgumentError(f"{options.INPUT}: is a folder of parts: give --mesh MODEL")
    if work == _CONVERSION:
        if options.depth is not None and options.cell is not None:
            raise ArgumentError("--depth and --cell both say how fine the cells are; give one of them")
        for word in ("--separate", "--preview", "--memory", *sorted(VIEW_WORDS)):
            if options.parts and word in given:
                raise ArgumentError(f"{word} has no meaning with --parts; see {program} --help")
    return work


def check_input(options: argparse.Namespace, kind: str, program: str) -> None:
    """Refuse options that make no sense for what INPUT is: "texture", "cloud", "voxels" or "model"."""
    given = words_given(options)
    for word in given:
        if kind != "texture" and word in _OF_TEXTURES:
            raise ArgumentError(f"{options.INPUT}: {word} is for .octex textures; convert the model first")
        if word == "--max-error" and kind == "texture" and _is_archive(options):
            archive_error(options, kind)
        elif kind == "texture" and word not in _OF_ANYTHING | _OF_TEXTURES:
            raise ArgumentError(
                f"{options.INPUT}: {word} needs the model, and this is a texture made from one"
            )
        if kind == "cloud" and word not in _OF_ANYTHING | {"--cell"}:
            raise ArgumentError(f"{word} needs a surface, and {options.INPUT} is points")
        if kind == "voxels" and word not in _OF_ANYTHING - {"--depth"}:
            raise ArgumentError(f"{options.INPUT}: {word} is not for voxels, which have their own depth")
    is_same = not {"--depth", "--channels", "--dtype", "--max-error", *_OF_TEXTURES} & {*given}
    ending = options.OUTPUT.suffix.lower()
    if kind == "texture" and is_same and ending in TEXTURE_ENDINGS and ending == options.INPUT.suffix.lower():
        raise ArgumentError(
            f"{options.INPUT}: is an octree texture already; --depth makes it coarser, --channels smaller; "
            f"see {program} --help"
        )
    if options.depth is not None:
        from octex.checks import as_depth

        as_depth(options.depth, "--depth")


def _mesh_needed(options: argparse.Namespace) -> str:
    """Say how what is made of a texture and its model is made, of INPUT."""
    if options.INPUT.suffix.lower() in TEXTURE_ENDINGS or options.INPUT.is_dir():
        return "give --mesh MODEL"
    return f"convert {options.INPUT} to NAME.octex first, then that with --mesh {options.INPUT}"


def archive_error(options: argparse.Namespace, kind: str) -> int:
    """Return by how many codes an archive's values may move; raises ArgumentError for part of a code."""
    if kind != "texture" or options.max_error is None:
        return 0
    if options.max_error != int(options.max_error):
        raise ArgumentError(f"--max-error of {options.OUTPUT} must be a whole number of codes")
    return int(options.max_error)


def _is_archive(options: argparse.Namespace) -> bool:
    return bool(options.OUTPUT.suffix.lower() == ARCHIVE_ENDING)
