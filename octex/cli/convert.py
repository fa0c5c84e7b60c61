"""octree-convert: from a textured model to an octree texture, and a look at what one holds."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import octex
from octex.ahead import SECTIONS, ahead, warm_up
from octex.cli.addresses import TEXTURE_ENDINGS, check_texture
from octex.cli.bake import bake, baking
from octex.cli.common import Reporter, bytes_text, check_outputs, limited, run, say, tell
from octex.cli.convert_options import COMMANDS, CONVERT, OUTPUT_ENDINGS, archive_error, check_input, work_of
from octex.cli.diff import diff
from octex.cli.inspect import info, validate
from octex.cli.models import PTEX_ENDING, input_files, kind_of, read_model, settings_of, told_of
from octex.cli.overlaps import overlaps, separated_as_json, separated_text
from octex.cli.parser import Parser
from octex.cli.process import others_of, processed
from octex.cli.ptex import write_ptex
from octex.cli.sets import convert_parts
from octex.cli.view_options import previewing
from octex.cli.viewer import PAGE_ENDING, write_mesh_page, write_page
from octex.errors import ExitCode
from octex.parallel import workers

if TYPE_CHECKING:
    from octex.source.cloud import PointCloud
    from octex.source.parts import Overlaps
    from octex.source.surface import Surface
    from octex.source.voxels import Voxels
    from octex.texture import OctreeTexture

COMMAND = "octree-convert"


def main(arguments: Sequence[str] | None = None, program: str = COMMAND, command: str = "convert") -> int:
    """Run octree-convert, or one of COMMANDS, and return its exit code (octex.errors.ExitCode)."""
    return run(program, lambda: _main(arguments, program, command))


def _main(arguments: Sequence[str] | None, program: str, command: str) -> int:
    options = Parser(program, CONVERT).parse_args([])
    vars(options).update(vars(Parser(program, COMMANDS[command]).parsed(arguments)))
    if command == "edit":
        check_texture(options.INPUT)
    options.warm_up |= command == "warm-up"
    work = work_of(options, program)
    with limited(options.threads):
        if work == "--info":
            return info(options.info, options.json)
        if work == "--validate":
            return validate(options.validate, options.json, options.quiet)
        if work == "--diff":
            return diff(program, options)
        if work == "--overlaps":
            return overlaps(program, options)
        if work == "--mesh" and options.OUTPUT.suffix.lower() == PTEX_ENDING:
            return write_ptex(options, program)
        if work == "--mesh" and options.OUTPUT.suffix.lower() == PAGE_ENDING:
            return write_mesh_page(options, program)
        if work == "--mesh":
            return bake(baking(options, program), program)
        if work == "--warm-up":
            return _warm_up(options.quiet, program)
        return convert_parts(program, options) if options.parts else _convert(options, program)


def _convert(options: argparse.Namespace, program: str) -> int:
    began = time.perf_counter()
    found: Overlaps | None = None
    outputs = (options.OUTPUT, OUTPUT_ENDINGS, "OUTPUT"), (options.preview, (".png",), "--preview")
    inputs = [options.INPUT, *input_files(options), *others_of(options)]
    model: PointCloud | Voxels | Surface
    surface: Surface | None = None
    check_outputs(outputs, inputs, force=options.force)
    kind = kind_of(options.INPUT)
    check_input(options, kind, program)
    stages = ("convert", "preview") if options.preview is not None else ("convert",)
    is_shared = options.threads is None and kind == "model"
    with Reporter(program, options.quiet) as progress, ahead(*stages if is_shared else ()):
        draw = previewing(options, options.INPUT)
        if kind == "texture":
            with workers() as executor:
                texture = processed(options, executor)
        else:
            with progress.stage("read"):
                if kind == "cloud":
                    model = octex.PointCloud.load(options.INPUT)
                elif kind == "voxels":
                    model = octex.Voxels.load(options.INPUT)
                else:
                    model = surface = read_model(options.INPUT, options)
            if options.separate is not None and surface is not None:
                with progress.stage("separate"):
                    surface, found = octex.separate(
                        surface, options.separate, depth=options.depth, cell=options.cell
                    )
                    model = surface
            memory = {} if options.memory is None else {"memory": options.memory, "path": options.OUTPUT}
            texture = octex.convert(model, **settings_of(options), **memory, progress=progress)
        if draw is not None:  # first: without room for it, no OUTPUT is left unannounced
            with progress.stage("draw"):
                draw(surface, texture)
        if options.memory is not None:
            pass  # it is written
        elif options.OUTPUT.suffix.lower() in TEXTURE_ENDINGS:
            with progress.stage("write"):
                texture.save(options.OUTPUT, max_error=archive_error(options, kind))
        elif options.OUTPUT.suffix.lower() == ".npz":
            from octex.formats.npz import write_arrays

            write_arrays(texture, options.OUTPUT, progress)
        elif options.OUTPUT.suffix.lower() == PAGE_ENDING:
            for note in write_page(texture, surface, options, progress):
                progress.note(note)
        else:
            from octex.formats.ply import write_points

            write_points(texture, options.OUTPUT, progress)

    _tell_what_was_made(options, texture, found, time.perf_counter() - began, is_new=surface is not None)
    return ExitCode.DONE


def _tell_what_was_made(
    options: argparse.Namespace,
    texture: OctreeTexture,
    found: Overlaps | None,
    seconds: float,
    *,
    is_new: bool,
) -> None:
    tree = texture.tree
    made = told_of(texture, options.OUTPUT, seconds)
    made["cell"] = texture.placement.size / 2**tree.max_depth
    empty = json.loads(texture.metadata["convert"]).get("empty", 0) if is_new else 0
    if empty:
        made["empty"] = empty
    if options.preview is not None:
        made["preview"] = str(options.preview)
    if found is not None:
        made["separated"] = separated_as_json(texture, found)
    cells = f"{tree.n_leaves:,} leaves, depth {tree.max_depth} (cells of {made['cell']:.4g})"
    lines = [f"{options.OUTPUT}: {cells}, {bytes_text(made['bytes'])}, {seconds:.1f} s"]
    if empty:
        # With leaves of several sizes, finest cells are no part of their number.
        is_even = options.max_error is None and options.detail is None
        share = f" ({100 * empty / (empty + tree.n_leaves):.3g} %)" if is_even else ""
        why = "is near enough" if options.max_angle is None else "is near enough and faces as they do"
        lines.append(f"{empty:,} finest cells{share} stay empty: nothing to take from {why}")
    if options.preview is not None:
        lines.append(f"{options.preview}: a picture of it")
    if found is not None:
        lines += separated_text(texture, found)
    tell(options, made, *lines)


def _warm_up(quiet: bool, program: str) -> int:
    began = time.perf_counter()
    with Reporter(program, quiet, announce=False) as progress, ahead(*SECTIONS):
        warm_up(progress)
    if not quiet:
        say(f"compiled and cached in {time.perf_counter() - began:.1f} s")
    return ExitCode.DONE


if __name__ == "__main__":
    sys.exit(main())
