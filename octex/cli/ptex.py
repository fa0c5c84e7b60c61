"""octree-convert TEXTURE.octex OUTPUT.ptx --mesh MODEL: texels for the polygons of a model."""

from __future__ import annotations

import argparse
import json
import time

import octex
from octex.cli.addresses import TEXTURE_ENDING, TEXTURE_ENDINGS
from octex.cli.common import Reporter, bytes_text, check_outputs, say
from octex.cli.models import PTEX_ENDING, open_sound
from octex.cli.shape_options import shaped_model
from octex.errors import ArgumentError, ExitCode


def write_ptex(options: argparse.Namespace, program: str) -> int:
    """Write a .ptx file, as the options of octree-convert --mesh say; return the exit code."""
    began = time.perf_counter()
    if options.INPUT.suffix.lower() not in TEXTURE_ENDINGS:
        raise ArgumentError(
            f"{options.INPUT}: is no {TEXTURE_ENDING} file; octex convert makes one of a model"
        )
    inputs = [path for path in (options.INPUT, options.mesh, options.rest) if path is not None]
    check_outputs([(options.OUTPUT, (PTEX_ENDING,), "OUTPUT")], inputs, force=options.force)
    with Reporter(program, options.quiet) as progress:
        with progress.stage("read"):
            texture = open_sound(options.INPUT)
            surface = shaped_model(options.mesh, options, channels=["alpha"], sources={"alpha": 1.0})
        octex.write_ptex(texture, surface, options.OUTPUT, channels=options.channels, progress=progress)
    from octex.formats.ptex.reader import PtexFile

    with PtexFile(options.OUTPUT) as file:
        made = {
            "output": str(options.OUTPUT),
            "faces": file.n_faces,
            "texels": int(file.faces.counts.sum()),
            "bytes": options.OUTPUT.stat().st_size,
            "seconds": round(time.perf_counter() - began, 3),
        }
    if options.json:
        say(json.dumps(made))
    elif not options.quiet:
        size = bytes_text(options.OUTPUT.stat().st_size)
        texels = f"{made['texels']:,} texels on {made['faces']:,} faces"
        say(f"{options.OUTPUT}: {texels}, {size}, {made['seconds']:.1f} s")
    return ExitCode.DONE
