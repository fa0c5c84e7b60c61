"""octree-paint: pictures and cameras in, an octree texture with their paint out; and pictures to paint on."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import octex
from octex.cli.arguments import (
    BLENDS,
    angle,
    blend,
    camera,
    color,
    count,
    opacity,
    picture_size,
    pixels,
    whole_number,
)
from octex.cli.common import (
    Parser,
    Reporter,
    bytes_text,
    check_outputs,
    fail,
    limited,
    run,
    say,
    words_given,
)
from octex.cli.layers import channel_of, empty_like, entries_of, merged, projected, with_entries
from octex.cli.models import (
    DEFAULT_CHANNEL,
    TEXTURE_ENDING,
    only,
    open_sound,
    posed_inputs,
    read_posed,
    texture_of,
)
from octex.cli.shots import shots_of
from octex.cli.view import DEFAULT_SIZE, view
from octex.errors import ArgumentError, ExitCode, InputError
from octex.parallel import workers

if TYPE_CHECKING:
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture

COMMAND = "octree-paint"

# Which options go with which work.
_SHARED = {"MODEL", "TEXTURE", "--rest", "--force", "--quiet", "--json"}
_MERGE = _SHARED | {"--out", "--blend", "--opacity", "--preview", "--threads"}
_OPTIONS = {
    "painting": _MERGE
    | {"IMAGE", "--camera", "--mask", "--channel", "--max-depth", "--max-angle", "--edge-feather"}
    | {"--balance", "--back-faces", "--no-fit", "--background", "--layer-out"},
    "--layer": _MERGE,
    "--view": _SHARED | {"--camera-out", "--camera", "--size", "--channel"},
}
_NEEDED = {
    "painting": ("MODEL", "TEXTURE", "--camera", "--out"),
    "--layer": ("MODEL", "TEXTURE", "--out"),
    "--view": ("MODEL", "TEXTURE"),
}


def parser() -> Parser:
    """Return the parser of octree-paint's arguments."""
    indent = f"{'':20}"
    parser = Parser(
        prog=COMMAND,
        description="Paint pictures through their cameras onto a model's octree texture.",
        usage=f"{COMMAND} MODEL TEXTURE [IMAGE ...] --camera FILE[#NAME] --out NEW\n"
        f"{indent}[--mask PNG ...] [--blend MODE] [--opacity X] [--channel NAME]\n"
        f"{indent}[--max-depth N] [--max-angle DEGREES] [--edge-feather PIXELS]\n"
        f"{indent}[--balance] [--back-faces] [--no-fit] [--background COLOUR]\n"
        f"{indent}[--rest MESH] [--preview PNG] [--layer-out LAYER] [--force]\n"
        f"{indent}[--threads N] [--quiet] [--json]\n"
        f"       {COMMAND} MODEL TEXTURE --layer LAYER [--layer LAYER ...] --out NEW\n"
        f"{indent}[--blend MODE] [--opacity X] [--rest MESH] [--preview PNG]\n"
        f"{indent}[--force] [--threads N] [--quiet] [--json]\n"
        f"       {COMMAND} MODEL TEXTURE --view PNG [--camera-out CAMERA] [--camera FILE[#NAME]]\n"
        f"{indent}[--size W,H] [--channel NAME] [--rest MESH] [--force] [--quiet] [--json]\n"
        f"       {COMMAND} --version | --help",
    )
    add = parser.add_argument
    add("MODEL", nargs="?", type=Path, help="the model, posed as the cameras see it")
    add("TEXTURE", nargs="?", type=Path, help="its texture, .octex; if it is not there, a new one is begun")
    add(
        "IMAGE",
        nargs="*",
        type=Path,
        help="pictures; the frame of each is found by its file name (default: those that FILE names)",
    )
    add(
        "--camera",
        metavar="FILE[#NAME]",
        type=camera,
        help="where the cameras are: transforms.json, a COLMAP folder, glTF, or what --camera-out wrote",
    )
    add("--out", metavar="NEW", type=Path, help="the painted texture, .octex; with --force also TEXTURE")
    add(
        "--mask",
        metavar="PNG",
        action="append",
        type=Path,
        help="white where paint goes: one for all, or one for each IMAGE in order; any number of times",
    )
    add("--blend", metavar="MODE", type=blend, help=f"how paint is put: {', '.join(BLENDS)} (default over)")
    add("--opacity", metavar="X", type=opacity, help="0 to 1: multiplies the pictures' alpha (default 1)")
    add("--channel", metavar="NAME", help=f"what is painted (default {DEFAULT_CHANNEL})")
    add(
        "--max-depth",
        metavar="N",
        type=whole_number,
        help="the deepest level that paint goes to (default: cells of half a pixel, at most level 14)",
    )
    add(
        "--max-angle",
        metavar="DEGREES",
        type=angle,
        help="between the surface's normal and the way to the camera, from which on nothing is painted "
        "(default 75)",
    )
    add(
        "--edge-feather",
        metavar="PIXELS",
        type=pixels,
        help="fade paint towards the picture's rim and edges in depth (default 0)",
    )
    add("--balance", action="store_true", help="multiply pictures so that overlapping ones agree")
    add("--back-faces", action="store_true", help="paint also what faces away")
    add("--no-fit", action="store_true", help="store plain averages; lookups are then softer")
    add(
        "--background",
        metavar="COLOUR",
        type=color,
        help="begin a new texture in this colour all over: R,G,B from 0 to 255, or '#rrggbb'",
    )
    add("--rest", metavar="MESH", type=Path, help="the undeformed model, of the same topology as MODEL")
    add("--preview", metavar="PNG", type=Path, help="draw the model beside the model from its octree")
    add("--layer-out", metavar="LAYER", type=Path, help="keep the paint itself, .octex, for --layer")
    add(
        "--layer",
        metavar="LAYER",
        action="append",
        type=Path,
        help="merge paint kept before; any number of times, in this order",
    )
    add(
        "--view",
        metavar="PNG",
        type=Path,
        help="draw what the camera sees, unlit and as transparent as the texture, to be painted on and sent "
        "back; --blend replace then leaves transparency as it is, over adds to what is translucent",
    )
    add("--camera-out", metavar="CAMERA", type=Path, help="the camera of that picture, .json, for --camera")
    add(
        "--size",
        metavar="W,H",
        type=picture_size,
        help=f"pixels of that picture (default: the camera's, or {DEFAULT_SIZE[0]},{DEFAULT_SIZE[1]})",
    )
    add("--force", action="store_true", help="overwrite what exists")
    add("--threads", metavar="N", type=count, help="threads to work on (default: all processors)")
    add("--quiet", action="store_true", help="print nothing but errors (and what --json asks for)")
    add("--json", action="store_true", help="print the result as one JSON object")
    add("--version", action="version", version=f"{COMMAND} {octex.__version__}")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run octree-paint and return its exit code (octex.errors.ExitCode)."""
    return run(COMMAND, lambda: _main(parser().parsed(arguments)))


def _main(options: argparse.Namespace) -> int:
    with limited(options.threads):
        return _done(_work(options), options)


def _done(work: str, options: argparse.Namespace) -> int:
    if options.max_depth is not None:
        from octex.checks import as_depth

        as_depth(options.max_depth, "--max-depth")
    return view(COMMAND, options) if work == "--view" else _paint(options)


def _work(options: argparse.Namespace) -> str:
    """Return what is to be done, a key of _OPTIONS, or refuse options that make no sense together."""
    given = words_given(options)
    work = next((word for word in ("--view", "--layer") if word in given), "painting")
    for word in given:
        if word != work and word not in _OPTIONS[work]:
            raise ArgumentError(f"{word} has no meaning with {work}; see {COMMAND} --help")
    for word in _NEEDED[work]:
        if word not in given:
            raise ArgumentError(f"{word} is missing; see {COMMAND} --help")
    is_there = options.TEXTURE.exists()
    if work == "--view" and options.camera is None and options.camera_out is None:
        raise ArgumentError(
            "--view without --camera needs --camera-out: without its camera a picture cannot be painted back"
        )
    if options.background is not None and is_there:
        raise ArgumentError(f"{options.TEXTURE}: exists already; --background is for a new texture")
    if options.blend == "erase" and not is_there:
        raise ArgumentError(f"{options.TEXTURE}: does not exist; there is nothing to erase")
    if not is_there and options.TEXTURE.suffix.lower() != TEXTURE_ENDING:
        raise InputError(f"{options.TEXTURE}: does not exist; a new texture is named NAME{TEXTURE_ENDING}")
    if options.mask is not None and len(options.mask) not in (1, len(options.IMAGE)):
        raise ArgumentError(
            f"--mask gives {len(options.mask)} for {len(options.IMAGE)} IMAGEs; give one for all, or one for "
            "each IMAGE"
        )
    return work


def _paint(options: argparse.Namespace) -> int:
    began = time.perf_counter()
    _check_files(options)
    with Reporter(COMMAND, options.quiet) as progress:
        shots, skipped = ([], []) if options.layer else shots_of(options, progress)
        texture = texture_of(options)
        if texture is None:
            progress.note(f"{options.TEXTURE} does not exist yet: painting begins a new texture")
        with progress.stage("read"):
            surface = read_posed(options)
        with workers() as executor:
            if options.layer:
                layers = [open_sound(path) for path in options.layer]
            else:
                texture, layers = projected(options, texture, surface, shots, executor, progress)
            base = empty_like(layers[0]) if texture is None else texture
            made = merged(options, base, layers, surface, executor, progress)
        if made is not base:
            entries = entries_of(options, [shot.path for shot in shots] or options.layer, layers[0])
            made = with_entries(made, surface, entries)
            if options.preview is not None:  # first: without room for it, nothing is left unannounced
                with progress.stage("draw"):
                    _write_preview(options.preview, surface, made, channel_of(layers[0]))
            with progress.stage("write"):
                if options.layer_out is not None:
                    with_entries(layers[0], surface, entries).save(options.layer_out)
                made.save(options.out)
    if made is base:
        return fail(
            COMMAND,
            f"nothing was painted, and {options.out} is not written: no camera sees the model (do they look "
            "away from it, or stand behind or inside it?), or the pictures' alpha, the mask or --opacity are "
            "zero all over",
            ExitCode.NOTHING_PAINTED,
        )
    if not options.quiet or options.json:
        names = [str(entry["image"]) for entry in entries]
        _say_what_was_painted(options, made, names, skipped, time.perf_counter() - began)
    return ExitCode.DONE


def _check_files(options: argparse.Namespace) -> None:
    outputs: list[tuple[Path, tuple[str, ...], str]] = [(options.out, (TEXTURE_ENDING,), "--out")]
    if options.layer_out is not None:
        outputs.append((options.layer_out, (TEXTURE_ENDING,), "--layer-out"))
    if options.preview is not None:
        outputs.append((options.preview, (".png",), "--preview"))
    others = [*options.IMAGE, *(options.mask or []), *(options.layer or [])]
    # --out may take the place of TEXTURE, which is not written to: the old file is there until all is done.
    if os.path.realpath(options.out) != os.path.realpath(options.TEXTURE):
        others.append(options.TEXTURE)
    check_outputs(outputs, posed_inputs(options) + others, force=options.force)


def _write_preview(path: Path, surface: Surface, texture: OctreeTexture, channel: str) -> None:
    """Draw what was painted: beside the model's own, if it has such a channel."""
    from octex.preview import write_preview

    if channel == DEFAULT_CHANNEL:
        write_preview(path, surface, texture)
    elif channel in [form.name for form in surface.channels]:
        write_preview(path, surface.with_channels([channel]), texture)
    else:
        write_preview(path, None, only(texture, channel))


def _say_what_was_painted(
    options: argparse.Namespace,
    texture: OctreeTexture,
    painted: Sequence[str],
    skipped: Sequence[str],
    seconds: float,
) -> None:
    tree = texture.tree
    made: dict[str, Any] = {
        "output": str(options.out),
        "leaves": tree.n_leaves,
        "nodes": tree.n_nodes,
        "depth": tree.max_depth,
        "painted": list(painted),
        "skipped": list(skipped),
        "bytes": options.out.stat().st_size,
        "seconds": round(seconds, 3),
    }
    if options.layer_out is not None:
        made["layer"] = str(options.layer_out)
    if options.preview is not None:
        made["preview"] = str(options.preview)
    if options.json:
        say(json.dumps(made))
        return
    what = "layer" if options.layer else "picture"
    number = f"{len(painted):,} {what}{'s' if len(painted) > 1 else ''} painted"
    cells = f"{tree.n_leaves:,} leaves, depth {tree.max_depth}"
    say(f"{options.out}: {number}, {cells}, {bytes_text(made['bytes'])}, {seconds:.1f} s")
    if options.layer_out is not None:
        say(f"{options.layer_out}: the paint alone")
    if options.preview is not None:
        say(f"{options.preview}: a picture of it")


if __name__ == "__main__":
    sys.exit(main())
