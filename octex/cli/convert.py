"""octree-convert: from a textured model to an octree texture, and a look at what one holds."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import octex
from octex.cli.arguments import (
    DTYPES,
    FILTERS,
    box,
    channel_names,
    count,
    dtypes,
    error_codes,
    file_and_amount,
    image_filter,
    length,
    levels,
    source,
    whole_number,
)
from octex.cli.common import Parser, Reporter, bytes_text, check_outputs, run, say, words_given
from octex.cli.diff import diff
from octex.cli.inspect import info, validate
from octex.cli.models import DEFAULT_FILTER, TEXTURE_ENDING, read_model, source_files, sources_of
from octex.cli.process import NEEDS_A_TEXTURE, check_options, others_of, processed
from octex.errors import ArgumentError, ExitCode
from octex.parallel import threads

if TYPE_CHECKING:
    from octex.texture import OctreeTexture

COMMAND = "octree-convert"
OUTPUT_ENDINGS = (TEXTURE_ENDING, ".ply")

# Which options go with which work; INPUT and OUTPUT are options here too.
_MATERIALS = {"--channels", "--source", "--filter", "--rest"}
_OPTIONS = {
    "a conversion": {"INPUT", "OUTPUT", "--depth", "--cell", "--max-error", "--detail", "--no-fit", "--dtype"}
    | {"--preview", "--force", "--threads", "--quiet", "--json", *NEEDS_A_TEXTURE}
    | _MATERIALS,
    "--diff": {"--points", "--preview", "--force", "--quiet", "--json"} | _MATERIALS,
    "--info": {"--json"},
    "--validate": {"--json", "--quiet"},
    "--warm-up": {"--quiet"},
}


def parser() -> argparse.ArgumentParser:
    """Return the parser of octree-convert's arguments."""
    parser = Parser(
        prog=COMMAND,
        description="Convert a textured model (glTF, GLB, OBJ, PLY, OFF, STL) to an octree texture.",
        usage=f"{COMMAND} INPUT OUTPUT [--depth N | --cell SIZE] [--max-error CODES]\n"
        f"{'':29}[--detail stretch|CHANNEL] [--no-fit] [--rest MESH] [--channels NAMES]\n"
        f"{'':29}[--source CHANNEL=FILE ...] [--filter NAME] [--dtype TYPE]\n"
        f"{'':29}[--preview PNG] [--force] [--threads N] [--quiet] [--json]\n"
        f"       {COMMAND} TEXTURE OUTPUT [--crop BOX] [--depth N] [--combine FILE] [--mix FILE=AMOUNT]\n"
        f"{'':29}[--blur WIDTH] [--levels BLACK,WHITE[,GAMMA]] [--channels NAMES]\n"
        f"{'':29}[--dtype TYPE] [--preview PNG] [--force] [--threads N] [--quiet] [--json]\n"
        f"       {COMMAND} --diff A B [--channels NAMES] [--points N] [--rest MESH] [--filter NAME]\n"
        f"{'':29}[--source CHANNEL=FILE ...] [--preview PNG] [--force] [--quiet] [--json]\n"
        f"       {COMMAND} --info FILE [--json]\n"
        f"       {COMMAND} --validate FILE [--quiet] [--json]\n"
        f"       {COMMAND} --warm-up [--quiet]\n"
        f"       {COMMAND} --version | --help",
    )
    add = parser.add_argument
    add("INPUT", nargs="?", type=Path, help="the model, or an .octex file made before")
    add("OUTPUT", nargs="?", type=Path, help="NAME.octex, or NAME.ply: a coloured point a leaf, with normal")
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
        help="merge leaves where what is looked up then stays this near to the model, in 8-bit codes, like 2",
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
        help="take a channel from an image, read at the model's texture coordinates, or make it constant: "
        "roughness=0.5, base_color=0.2,0.4,0.6 (linear light); any number of times",
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
    add("--info", metavar="FILE", type=Path, help="say what an .octex file holds")
    add(
        "--validate",
        metavar="FILE",
        type=Path,
        help="check that an .octex file is a sound octree, or say what is broken",
    )
    add("--warm-up", action="store_true", help="compile everything now; later runs start at once")
    add("--version", action="version", version=f"{COMMAND} {octex.__version__}")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run octree-convert and return its exit code (octex.errors.ExitCode)."""
    return run(COMMAND, lambda: _main(parser().parse_args(arguments)))


def _main(options: argparse.Namespace) -> int:
    work = _work(options)
    if work == "--info":
        return info(options.info, options.json)
    if work == "--validate":
        return validate(options.validate, options.json, options.quiet)
    if work == "--diff":
        return diff(COMMAND, options)
    if work == "--warm-up":
        return _warm_up(options.quiet)
    return _convert(options)


def _work(options: argparse.Namespace) -> str:
    """Return what is to be done, a key of _OPTIONS, or refuse options that make no sense together."""
    given = words_given(options)
    work = next((word for word in given if word in _OPTIONS), "a conversion")
    for word in given:
        if word != work and word not in _OPTIONS[work]:
            raise ArgumentError(f"{word} has no meaning with {work}; see {COMMAND} --help")
    if options.source is not None:
        sources_of(options)  # refuses what contradicts itself
    if work == "a conversion":
        for word in ("INPUT", "OUTPUT"):
            if word not in given:
                raise ArgumentError(f"{word} is missing; see {COMMAND} --help")
        if options.depth is not None and options.cell is not None:
            raise ArgumentError("--depth and --cell both say how fine the cells are; give one of them")
    return work


def _convert(options: argparse.Namespace) -> int:
    began = time.perf_counter()
    outputs: list[tuple[Path, tuple[str, ...], str]] = [(options.OUTPUT, OUTPUT_ENDINGS, "OUTPUT")]
    if options.preview is not None:
        outputs.append((options.preview, (".png",), "--preview"))
    inputs = [path for path in (options.INPUT, options.rest) if path is not None] + source_files(options)
    check_outputs(outputs, inputs + others_of(options), force=options.force)
    check_options(options, options.INPUT.suffix.lower() == TEXTURE_ENDING)
    if options.depth is not None:
        from octex.checks import as_depth

        as_depth(options.depth, "--depth")

    with Reporter(COMMAND, options.quiet) as progress:
        if options.INPUT.suffix.lower() == TEXTURE_ENDING:
            surface = None
            is_same = not {"--depth", "--channels", "--dtype", *NEEDS_A_TEXTURE} & {*words_given(options)}
            if is_same and options.OUTPUT.suffix.lower() == TEXTURE_ENDING:
                raise ArgumentError(
                    f"{options.INPUT}: is an octree texture already; --depth makes it coarser, --channels "
                    f"smaller; see {COMMAND} --help"
                )
            with nullcontext() if options.threads is None else threads(options.threads) as executor:
                texture = processed(options, executor)
        else:
            with progress.stage("read"):
                surface = read_model(options.INPUT, options)
            with nullcontext() if options.threads is None else threads(options.threads) as executor:
                texture = octex.convert(
                    surface,
                    options.depth,
                    cell=options.cell,
                    channels=options.channels,
                    dtype=options.dtype,
                    fit=not options.no_fit,
                    max_error=options.max_error,
                    detail=options.detail,
                    executor=executor,
                    progress=progress,
                )
        if options.preview is not None:  # first: without room for it, no OUTPUT is left unannounced
            from octex.preview import write_preview

            with progress.stage("draw"):
                write_preview(options.preview, surface, texture)
        if options.OUTPUT.suffix.lower() == TEXTURE_ENDING:
            with progress.stage("write"):
                texture.save(options.OUTPUT)
        else:
            from octex.formats.ply import write_points

            write_points(texture, options.OUTPUT, progress)

    if not options.quiet or options.json:
        _say_what_was_made(options, texture, time.perf_counter() - began)
    return ExitCode.DONE


def _say_what_was_made(options: argparse.Namespace, texture: OctreeTexture, seconds: float) -> None:
    tree = texture.tree
    made: dict[str, Any] = {
        "output": str(options.OUTPUT),
        "leaves": tree.n_leaves,
        "nodes": tree.n_nodes,
        "depth": tree.max_depth,
        "cell": texture.placement.size / 2**tree.max_depth,
        "bytes": options.OUTPUT.stat().st_size,
        "seconds": round(seconds, 3),
    }
    if options.preview is not None:
        made["preview"] = str(options.preview)
    if options.json:
        say(json.dumps(made))
    else:
        cells = f"{tree.n_leaves:,} leaves, depth {tree.max_depth} (cells of {made['cell']:.4g})"
        say(f"{options.OUTPUT}: {cells}, {bytes_text(made['bytes'])}, {seconds:.1f} s")
        if options.preview is not None:
            say(f"{options.preview}: a picture of it")


def _warm_up(quiet: bool) -> int:
    from octex.cli.warm_up import warm_up

    began = time.perf_counter()
    with Reporter(COMMAND, quiet, announce=False) as progress:
        warm_up(progress)
    if not quiet:
        say(f"compiled and cached in {time.perf_counter() - began:.1f} s")
    return ExitCode.DONE


if __name__ == "__main__":
    sys.exit(main())
