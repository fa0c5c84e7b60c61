"""octree-convert: from a textured model to an octree texture, and a look at what one holds."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import octex
from octex.cli.common import (
    Parser,
    Reporter,
    bytes_text,
    check_outputs,
    count,
    length,
    run,
    say,
    whole_number,
)
from octex.errors import ArgumentError, ExitCode, InputError, TextureFileError
from octex.parallel import threads

if TYPE_CHECKING:
    from octex.texture import OctreeTexture

COMMAND = "octree-convert"
TEXTURE_ENDING = ".octex"
OUTPUT_ENDINGS = (TEXTURE_ENDING, ".ply")

# Which options go with which work; INPUT and OUTPUT are options here too.
_OPTIONS = {
    "a conversion": {"INPUT", "OUTPUT", "--depth", "--cell", "--rest", "--preview", "--force", "--threads"}
    | {"--quiet", "--json"},
    "--info": {"--json"},
    "--validate": {"--json", "--quiet"},
    "--warm-up": {"--quiet"},
}
_NEEDS_A_MODEL = ("--cell", "--rest")


def parser() -> argparse.ArgumentParser:
    """Return the parser of octree-convert's arguments."""
    parser = Parser(
        prog=COMMAND,
        description="Convert a textured model (glTF, GLB, OBJ, PLY, OFF, STL) to an octree texture.",
        usage=f"{COMMAND} INPUT OUTPUT [--depth N | --cell SIZE] [--rest MESH] [--preview PNG]\n"
        f"{'':29}[--force] [--threads N] [--quiet] [--json]\n"
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
    add("--rest", metavar="MESH", type=Path, help="the undeformed model, of the same topology as INPUT")
    add("--preview", metavar="PNG", type=Path, help="draw the model beside the model from its octree")
    add("--force", action="store_true", help="overwrite what exists")
    add("--threads", metavar="N", type=count, help="threads to work on (default: all processors)")
    add("--quiet", action="store_true", help="print nothing but errors (and what --json asks for)")
    add("--json", action="store_true", help="print the result as one JSON object")
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
        return _info(options.info, options.json)
    if work == "--validate":
        return _validate(options.validate, options.json, options.quiet)
    if work == "--warm-up":
        return _warm_up(options.quiet)
    return _convert(options)


def _given(options: argparse.Namespace) -> list[str]:
    """Return the words on the command line that were used, as the user knows them."""
    return [
        word if word.isupper() else "--" + word.replace("_", "-")
        for word, value in vars(options).items()
        if value is not None and value is not False
    ]


def _work(options: argparse.Namespace) -> str:
    """Return what is to be done, a key of _OPTIONS, or refuse options that make no sense together."""
    given = _given(options)
    work = next((word for word in given if word in _OPTIONS), "a conversion")
    for word in given:
        if word != work and word not in _OPTIONS[work]:
            raise ArgumentError(f"{word} has no meaning with {work}; see {COMMAND} --help")
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
    inputs = [path for path in (options.INPUT, options.rest) if path is not None]
    check_outputs(outputs, inputs, force=options.force)
    if options.depth is not None:
        from octex.checks import as_depth

        as_depth(options.depth, "--depth")

    with Reporter(COMMAND, options.quiet) as progress:
        if options.INPUT.suffix.lower() == TEXTURE_ENDING:
            surface, texture = None, _coarser(options)
        else:
            with _stage(progress, "read"):
                surface = octex.load_surface(options.INPUT, rest=options.rest)
            with nullcontext() if options.threads is None else threads(options.threads) as executor:
                texture = octex.convert(
                    surface, options.depth, cell=options.cell, executor=executor, progress=progress
                )
        if options.preview is not None:  # first: without room for it, no OUTPUT is left unannounced
            from octex.preview import write_preview

            with _stage(progress, "draw"):
                write_preview(options.preview, surface, texture)
        if options.OUTPUT.suffix.lower() == TEXTURE_ENDING:
            with _stage(progress, "write"):
                texture.save(options.OUTPUT)
        else:
            from octex.formats.ply import write_points

            write_points(texture, options.OUTPUT, progress)

    if not options.quiet or options.json:
        _say_what_was_made(options, texture, time.perf_counter() - began)
    return ExitCode.DONE


@contextmanager
def _stage(progress: Reporter, name: str) -> Iterator[None]:
    """Report a stage that tells nothing of its progress."""
    progress(name, 0, 1)
    yield
    progress(name, 1, 1)


def _coarser(options: argparse.Namespace) -> OctreeTexture:
    """Open a texture, at a coarser depth if one is asked for."""
    for word in _given(options):
        if word in _NEEDS_A_MODEL:
            raise ArgumentError(
                f"{options.INPUT}: {word} needs the model, and this is a texture made from one"
            )
    texture = octex.open(options.INPUT)
    deepest = texture.tree.max_depth
    if options.depth is None:
        if options.OUTPUT.suffix.lower() == TEXTURE_ENDING:
            raise ArgumentError(f"{options.INPUT}: is an octree texture already; --depth makes it coarser")
        return texture
    if options.depth > deepest:
        raise InputError(
            f"{options.INPUT}: has depth {deepest}; --depth {options.depth} is finer and needs the model"
        )
    return texture.level(options.depth)


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


def _info(path: Path, as_json: bool) -> int:
    information = octex.open(path).info()
    say(json.dumps(information) if as_json else "\n".join(_readable(information)))
    return ExitCode.DONE


def _readable(information: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of a texture's information for a person."""
    placement, bounds, parts = (information[key] for key in ("placement", "bounds", "bytes"))
    yield f"depth       {information['depth']}, finest cells of edge {information['finest_cell']:.6g}"
    yield f"root cell   edge {placement['size']:.6g} at {_triple(placement['origin'])}"
    yield f"bounds      {_triple(bounds[0])} to {_triple(bounds[1])}"
    for number, channel in enumerate(information["channels"]):
        stored = f"{channel['components']} x {channel['dtype']}, {channel['space']}"
        yield f"{'' if number else 'channels':10}  {channel['name']}: {stored}"
    yield ""
    yield f"{'level':>5} {'leaves':>15} {'nodes':>15}"
    for level in information["levels"]:
        yield f"{level['level']:5} {level['leaves']:15,} {level['nodes']:15,}"
    yield f"{'all':>5} {information['leaves']:15,} {information['nodes']:15,}"
    yield ""
    leaves = max(information["leaves"], 1)
    yield f"{'part':24} {'bytes':>15} {'a leaf':>7}"
    for part, size in parts.items():
        yield f"{part:24} {size:15,} {size / leaves:7.2f}"
    if information["provenance"]:
        yield ""
    for name, text in information["provenance"].items():
        yield f"{name:11} {text}"


def _triple(numbers: Sequence[float]) -> str:
    return "(" + ", ".join(f"{number:.6g}" for number in numbers) + ")"


def _validate(path: Path, as_json: bool, quiet: bool) -> int:
    with path.open("rb"):  # a file that cannot be read is not a broken one
        pass
    broken = None
    try:
        octex.open(path).validate()
    except TextureFileError as error:
        broken = str(error)
    if as_json:
        say(json.dumps({"file": str(path), "valid": broken is None, "broken": broken}))
    elif not quiet:
        say(broken or "valid")
    return ExitCode.DONE if broken is None else ExitCode.INVALID


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
