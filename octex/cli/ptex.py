"""octree-convert TEXTURE.octex OUTPUT.ptx --mesh MODEL: texels for the polygons of a model."""

from __future__ import annotations

import argparse
import time
from typing import Any

import octex
from octex.cli.addresses import check_texture
from octex.cli.common import Reporter, bytes_text, check_outputs, tell
from octex.cli.models import PTEX_ENDING, open_sound
from octex.cli.shape_options import shaped_model
from octex.errors import ExitCode


def write_ptex(options: argparse.Namespace, program: str) -> int:
    """Write a .ptx file, as the options of octree-convert --mesh say; return the exit code."""
    began = time.perf_counter()
    check_texture(options.INPUT)
    inputs = options.INPUT, options.mesh, options.rest
    check_outputs([(options.OUTPUT, (PTEX_ENDING,), "OUTPUT")], inputs, force=options.force)
    with Reporter(program, options.quiet) as progress:
        with progress.stage("read"):
            texture = open_sound(options.INPUT)
            surface = shaped_model(options.mesh, options, channels=["alpha"], sources={"alpha": 1.0})
        octex.write_ptex(texture, surface, options.OUTPUT, channels=options.channels, progress=progress)
    from octex.formats.ptex.reader import PtexFile

    with PtexFile(options.OUTPUT) as file:
        made: dict[str, Any] = {
            "output": str(options.OUTPUT),
            "faces": file.n_faces,
            "texels": int(file.faces.counts.sum()),
            "bytes": options.OUTPUT.stat().st_size,
            "seconds": round(time.perf_counter() - began, 3),
        }
    texels = f"{made['texels']:,} texels on {made['faces']:,} faces"
    tell(options, made, f"{options.OUTPUT}: {texels}, {bytes_text(made['bytes'])}, {made['seconds']:.1f} s")
    return ExitCode.DONE
