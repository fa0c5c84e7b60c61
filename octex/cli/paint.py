"""octree-paint: pictures and cameras in, an octree texture with their paint out; and pictures to paint on."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import octex
from octex.ahead import ahead
from octex.cli.addresses import TEXTURE_ENDING
from octex.cli.common import Reporter, bytes_text, check_outputs, fail, identity, limited, run, tell
from octex.cli.layers import begun, channel_of, entries_of, merged, projected, refined, with_entries
from octex.cli.models import (
    DEFAULT_CHANNEL,
    new_texture,
    only,
    open_sound,
    posed_inputs,
    read_posed,
    texture_of,
    told_of,
)
from octex.cli.paint_options import PAINT, work_of
from octex.cli.parser import Parser
from octex.cli.shots import flat_shots, images_of, shots_of
from octex.cli.view import view
from octex.cli.view_options import previewing
from octex.errors import ExitCode
from octex.parallel import workers

if TYPE_CHECKING:
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture

COMMAND = "octree-paint"


def main(arguments: Sequence[str] | None = None, program: str = COMMAND) -> int:
    """Run octree-paint, whatever it is called, and return its exit code (octex.errors.ExitCode)."""
    return run(program, lambda: _main(Parser(program, PAINT).parsed(arguments), program))


def _main(options: argparse.Namespace, program: str) -> int:
    with limited(options.threads):
        work = work_of(options, program)
        if options.max_depth is not None:
            from octex.checks import as_depth

            as_depth(options.max_depth, "--max-depth")
        stages = {"painting": ("paint",), "--view": ("view",)}
        with ahead(*stages.get(work, ()) if options.threads is None else ()):
            return view(program, options) if work == "--view" else _paint(options, program)


def _paint(options: argparse.Namespace, program: str) -> int:
    began = time.perf_counter()
    _check_files(options)
    with Reporter(program, options.quiet) as progress:
        draw = previewing(options, options.MODEL)
        shots, skipped = ([], []) if options.layer or options.unwrap else shots_of(options, progress)
        texture = texture_of(options)
        if texture is None:
            progress.note(f"{new_texture(options)}: painting begins a new texture")
        with progress.stage("read"):
            surface = whole = read_posed(options)
        if options.unwrap is not None:
            surface, shots = flat_shots(options, whole, texture, progress)
        with workers() as executor:
            if options.refine_cameras:
                shots = refined(options, surface, shots, executor, progress)
                if options.save_cameras is not None:  # what comes next may take hours
                    octex.write_cameras(options.save_cameras, {shot.name: shot.camera for shot in shots})
            if options.layer:
                layers = [open_sound(path) for path in options.layer]
            else:
                texture, layers = projected(options, texture, surface, shots, executor, progress)
            base = begun(options, layers[0], surface, executor, progress) if texture is None else texture
            made = merged(options, base, layers, surface, executor, progress)
        if made is not base:
            entries = entries_of(options, [shot.path for shot in shots] or options.layer, layers[0])
            made = with_entries(made, surface, entries)
            if draw is not None:  # first: without room for it, nothing is left unannounced
                with progress.stage("draw"):
                    cameras = [] if options.unwrap else [shot.camera for shot in shots]
                    draw(*_previewed(whole, made, channel_of(layers[0])), cameras)
            with progress.stage("write"):
                if options.layer_out is not None:
                    with_entries(layers[0], surface, entries).save(options.layer_out)
                made.save(options.out)
    if made is base:
        reasons = [
            "no camera sees the model (do they look away from it, or stand behind or inside it?)",
            "the pictures' alpha, the mask or --opacity are zero all over",
            *["nothing was drawn on the view (--whole paints all of it)" for shot in shots[:1] if shot.since],
        ]
        reason = ", or ".join(reasons)
        message = f"nothing was painted, and {options.out} is not written: {reason}"
        return fail(program, message, ExitCode.NOTHING_PAINTED)
    names = [str(entry["image"]) for entry in entries]
    _tell_what_was_painted(options, made, names, skipped, time.perf_counter() - began)
    return ExitCode.DONE


def _check_files(options: argparse.Namespace) -> None:
    outputs = (
        (options.out, (TEXTURE_ENDING,), "--out"),
        (options.layer_out, (TEXTURE_ENDING,), "--layer-out"),
        (options.save_cameras, (".json",), "--save-cameras"),
        (options.preview, (".png",), "--preview"),
    )
    # --out may take the place of TEXTURE, which is not written to: the old file is there until all is done.
    is_replaced = options.TEXTURE is not None and identity(options.TEXTURE) == identity(options.out)
    others = [*images_of(options), *(options.mask or []), *(options.layer or []), options.since]
    inputs = [*posed_inputs(options), *others, None if is_replaced else options.TEXTURE]
    check_outputs(outputs, inputs, force=options.force)


def _previewed(
    surface: Surface, texture: OctreeTexture, channel: str
) -> tuple[Surface | None, OctreeTexture]:
    """Return what shows what was painted: beside the model's own, if it has such a channel."""
    if channel == DEFAULT_CHANNEL:
        return surface, texture
    if channel in [form.name for form in surface.channels]:
        return surface.with_channels([channel]), texture
    return None, only(texture, channel)


def _tell_what_was_painted(
    options: argparse.Namespace,
    texture: OctreeTexture,
    painted: Sequence[str],
    skipped: Sequence[str],
    seconds: float,
) -> None:
    tree = texture.tree
    made = {**told_of(texture, options.out, seconds), "painted": list(painted), "skipped": list(skipped)}
    what = "layer" if options.layer else "picture"
    number = f"{len(painted):,} {what}{'s' if len(painted) > 1 else ''} painted"
    cells = f"{tree.n_leaves:,} leaves, depth {tree.max_depth}"
    lines = [f"{options.out}: {number}, {cells}, {bytes_text(made['bytes'])}, {seconds:.1f} s"]
    if options.layer_out is not None:
        made["layer"] = str(options.layer_out)
        lines.append(f"{options.layer_out}: the paint alone")
    if options.preview is not None:
        made["preview"] = str(options.preview)
        lines.append(f"{options.preview}: a picture of it")
    tell(options, made, *lines)


if __name__ == "__main__":
    sys.exit(main())
