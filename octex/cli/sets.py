"""octree-convert --parts, and a look at the folders that it writes."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import octex
from octex.cli.common import Reporter, bytes_text, tell
from octex.cli.convert_options import OUTPUT_ENDINGS, check_input
from octex.cli.models import kind_of, read_model, settings_of
from octex.errors import ArgumentError, ExitCode, OutputError

INDEX = "set.json"  # as octex.texture.folder.INDEX


def convert_parts(command: str, options: argparse.Namespace) -> int:
    """Convert the parts of a model into a folder of textures of their own."""
    began = time.perf_counter()
    _check_folder(options.OUTPUT, force=options.force)
    check_input(options, kind_of(options.INPUT), command)
    with Reporter(command, options.quiet) as progress:
        with progress.stage("read"):
            surface = read_model(options.INPUT, options)
        made = octex.convert_set(surface, **settings_of(options), progress=progress)
        with progress.stage("write"):
            made.save(options.OUTPUT)
    seconds = time.perf_counter() - began
    leaves, size = sum(texture.tree.n_leaves for texture in made.values()), made.info()["bytes"]
    told = {"output": str(options.OUTPUT), "parts": len(made), "leaves": leaves, "bytes": size}
    count = f"{len(made):,} part{'' if len(made) == 1 else 's'}"
    line = f"{options.OUTPUT}: {count}, {leaves:,} leaves, {bytes_text(size)}, {seconds:.1f} s"
    tell(options, {**told, "seconds": round(seconds, 3)}, line)
    return ExitCode.DONE


def _check_folder(folder: Path, *, force: bool) -> None:
    """Refuse a folder that cannot or must not be written, before any work is done."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; --parts writes a folder, give OUTPUT another name")
    if folder.suffix.lower() in OUTPUT_ENDINGS:
        raise ArgumentError(f"{folder}: --parts writes a folder; give OUTPUT no ending")
    if not folder.parent.is_dir():
        raise OutputError(f"{folder}: there is no folder {folder.parent}; make it first")
    if (folder / INDEX).exists() and not force:
        raise OutputError(f"{folder}: holds a texture set already; --force replaces it")
    place = folder if folder.exists() else folder.parent
    if not os.access(place, os.W_OK):
        raise OutputError(f"{folder}: the folder {place} cannot be written")


def set_text(information: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of a set's information for a person."""
    parts = information["parts"]
    width = max(len("part"), *map(len, parts))
    yield f"{'part':{width}} {'depth':>5} {'finest cell':>12} {'leaves':>15} {'nodes':>15} {'bytes':>15}"
    for name, part in parts.items():
        yield (
            f"{name:{width}} {part['depth']:5} {part['finest_cell']:12.6g} {part['leaves']:15,} "
            f"{part['nodes']:15,} {part['bytes']['total']:15,}"
        )
    leaves, nodes = (sum(part[each] for part in parts.values()) for each in ("leaves", "nodes"))
    yield f"{'all':{width}} {'':5} {'':12} {leaves:15,} {nodes:15,} {information['bytes']:15,}"
