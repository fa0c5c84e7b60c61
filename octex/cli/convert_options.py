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
        "a model, points, voxels, an .octex file, or FILE.py:NAME, a function of positions (n, 3) "
        "that is negative inside",
        nargs="?",
        type=texture_file,
    ),
    option(
        "OUTPUT",
        "NAME.octex; compressed: NAME.octz; a point for each leaf: NAME.ply or NAME.npz; a page for "
        "the browser: NAME.html; with --parts a folder",
        nargs="?",
        type=output_file,
    ),
    option(
        "--depth",
        "number of levels: the finest cells are 1/2^N of the model's size (default 10)",
        metavar="N",
        type=whole_number,
    ),
    option(
        "--cell",
        "width of the finest cells in the model's units, instead of --depth",
        metavar="SIZE",
        type=length,
    ),
    option(
        "--max-error",
        "largest colour error allowed when merging cells, in 1/255 (try 2); for NAME.octz: by how "
        "much stored integers may change",
        metavar="CODES",
        type=error_codes,
    ),
    option(
        "--detail",
        "use coarser cells where the pose stretches the model less, or where a channel is below 1 "
        "(1/2: one level coarser)",
        metavar="stretch|CHANNEL",
    ),
    option(
        "--memory",
        "limit of memory, like 2GB: work in files next to OUTPUT beyond it",
        metavar="SIZE",
        type=file_size,
    ),
    option("--no-fit", "store plain averages; lookups are less sharp", action="store_true"),
    option(
        "--mesh",
        "the model that belongs to the texture INPUT: write it with images (.glb .gltf .obj .usdz), "
        "with vertex colours (.3mf), as a page (.html) or as .ptx. With a .ptx as INPUT: its mesh",
        metavar="MODEL",
        type=file_here,
    ),
    option(
        "--max-size",
        "for a page: leave out the finest levels until the file is no larger, like 20MB",
        metavar="SIZE",
        type=file_size,
    ),
    option(
        "--rest",
        "the undeformed model, with the same vertices and triangles as INPUT",
        metavar="MESH",
        type=file_here,
    ),
    *SHAPE_OPTIONS,
    option(
        "--also",
        "another model that shares the texture; may be repeated",
        metavar="MODEL",
        type=file_here,
        action="append",
    ),
    option("--bounds", "for a function: the box that it fills, x0,y0,z0,x1,y1,z1", metavar="BOX", type=box),
    option("--edge", "for a function: length of the triangles' edges", metavar="LENGTH", type=length),
    option(
        "--channels",
        "names of the channels to convert or compare, like base_color,normal (default: all)",
        metavar="NAMES",
        type=channel_names,
    ),
    option(
        "--source",
        "replace a channel by an image at the model's UVs, a .ptx file, a function of positions "
        "(base_color=wood.py:rings) or a constant (roughness=0.5; base_color=0.2,0.4,0.6 in linear "
        "light); may be repeated",
        metavar="CHANNEL=FILE",
        type=source,
        action="append",
    ),
    option(
        "--project",
        f"place the images of --source by position instead of UVs: {', '.join(PROJECTIONS)}",
        metavar="KIND",
        type=one_of(PROJECTIONS),
    ),
    option(
        "--project-axis",
        f"direction from which a plane is seen, or up for the other kinds: {', '.join(AXES)} (default z)",
        metavar="AXIS",
        type=one_of(AXES),
    ),
    option(
        "--project-center",
        "centre of the image or of the box, cylinder or sphere (default: centre of the model)",
        metavar="X,Y,Z",
        type=position,
    ),
    option(
        "--project-size",
        "width of one copy of the image in the model's units, or along x, y and z: 1,1,0.5 (default: "
        "the model's size)",
        metavar="SIZE",
        type=sizes,
    ),
    option(
        "--transfer",
        "take all channels from the nearest surface of another model",
        metavar="MODEL",
        type=file_here,
    ),
    option(
        "--cloud",
        "take colours from points (.ply, .xyz, .npz): the nearest, or the mean within --radius",
        metavar="POINTS",
        type=file_here,
    ),
    option(
        "--radius",
        "for --cloud: average points within this distance, in the model's units",
        metavar="R",
        type=length,
    ),
    option(
        "--max-distance",
        "leave cells empty whose --transfer or --cloud colours are farther away than this",
        metavar="D",
        type=length,
    ),
    option(
        "--max-angle",
        "largest angle between the normals of both surfaces (default 180; 90 for points)",
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
        f"stored type: {', '.join(DTYPES)}; for some channels: normal=uint16,emissive=float16 (default "
        "uint8; float16 for light above 1)",
        metavar="TYPE",
        type=dtypes,
    ),
    option(
        "--separate",
        "move parts apart that intersect or come nearer than this many cells (default "
        f"{SEPARATE_CELLS:g}), so that their colours do not mix",
        metavar="CELLS",
        nargs="?",
        const=SEPARATE_CELLS,
        type=cells_apart,
    ),
    option(
        "--parts",
        "write a folder with a texture for each part, so that nothing bleeds between parts",
        action="store_true",
    ),
    option(
        "--crop",
        "for a texture: keep only cells that meet the box x0,y0,z0,x1,y1,z1, in rest positions",
        metavar="BOX",
        type=box,
    ),
    option(
        "--combine",
        "for a texture: lay another .octex file with the same root cell over it",
        metavar="FILE",
        type=texture_file,
    ),
    option(
        "--mix",
        "for a texture: mix in AMOUNT (0 to 1) of another .octex file",
        metavar="FILE=AMOUNT",
        type=file_and_amount,
    ),
    option(
        "--blur",
        "for a texture: blur over the surface by this width, in the model's units",
        metavar="WIDTH",
        type=length,
    ),
    option(
        "--levels",
        "for a texture: stretch encoded base colours from BLACK to WHITE to the range 0 to 1",
        metavar="BLACK,WHITE[,GAMMA]",
        type=levels,
    ),
    option(
        "--preview",
        "write a PNG: the original on the left, the octree texture on the right",
        metavar="PNG",
        type=output_file,
    ),
    *VIEW_OPTIONS,
    *RUNNING,
    option(
        "--diff",
        "print how two textures, or a texture and a model, differ; --preview draws the difference. "
        "The exit code is 0 in either case",
        metavar=("A", "B"),
        nargs=2,
        type=texture_file,
    ),
    option(
        "--points",
        "number of points at which a model is compared (default 1,000,000); two textures are compared "
        "at all leaves",
        metavar="N",
        type=count,
    ),
    option(
        "--overlaps",
        "list parts of a model that intersect or come nearer than --margin. The exit code is 0 in "
        "either case",
        metavar="MODEL",
        type=file_here,
    ),
    option(
        "--margin",
        "smallest allowed distance between parts, in the model's units (default 0)",
        metavar="SIZE",
        type=length,
    ),
    option(
        "--info",
        "print the contents of an .octex or .octz file, or of a folder of parts",
        metavar="FILE",
        type=texture_file,
    ),
    option(
        "--validate",
        "check an .octex or .octz file, or each in a folder of parts, and print what is broken",
        metavar="FILE",
        type=texture_file,
    ),
    option("--warm-up", "compile everything now; later commands start at once", action="store_true"),
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
            rest="the undeformed model, with the same vertices and triangles",
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
        "Make a texture from a texture. Options are applied in the order listed here.",
        [
            option("INPUT", "an .octex file", metavar="TEXTURE", type=texture_file),
            option(
                "OUTPUT",
                "NAME.octex; compressed: NAME.octz; a point for each leaf: NAME.ply or NAME.npz; NAME.html",
                type=output_file,
            ),
        ],
        _those(
            [*_EDITS, *(word for word in _BY_WORD if word in _OF_ANYTHING.difference(_EDITS))],
            depth="number of levels to keep",
            channels="names of the channels to keep, like base_color,normal",
            dtype=f"stored type: {', '.join(DTYPES)}; for some channels: normal=uint16",
            preview="draw the texture",
        ),
        ["droid.octex coarse.octex --depth 7", "droid.octex worn.octex --levels 0.1,0.75,1.3 --blur 0.02"],
    ),
    "info": _alone(
        "--info",
        "Print what a texture holds and where its bytes go.",
        "an .octex or .octz file, or a folder of parts",
        "droid.octex",
        "droid.octex --json",
    ),
    "diff": _alone(
        "--diff",
        "Print how two textures, or a texture and a model, differ over the surface.",
        "two .octex files, or one and a model; the exit code is 0 in either case",
        "droid.octex droid.glb --preview difference.png",
        "before.octex after.octex --channels base_color --json",
        usual=("--channels", "--points", "--rest", "--preview", "--force", "--quiet", "--json"),
    ),
    "validate": _alone(
        "--validate",
        "Check a texture, and print what is broken.",
        "an .octex or .octz file, or a folder of parts",
        "droid.octex",
        "robot/ --quiet",
    ),
    "overlaps": _alone(
        "--overlaps",
        "List parts of a model that intersect or nearly touch: their colours would mix.",
        "the model; the exit code is 0 in either case",
        "robot.glb",
        "robot.glb --margin 0.01",
    ),
    "warm-up": Command(
        "Compile everything now, so that later commands start at once.", [], _those(_WORDS["--warm-up"]), [""]
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
