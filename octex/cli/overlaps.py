"""octree-convert --overlaps and --separate: which parts of a model are too near, and how far they moved."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import octex
from octex.cli.common import Reporter, tell
from octex.errors import ExitCode

if TYPE_CHECKING:
    from octex.source.parts import Overlaps
    from octex.texture import OctreeTexture

SEPARATE_CELLS = 3.0  # as conversion.apart.CELLS
_LINES = 10  # so many parts are listed


def overlaps(command: str, options: argparse.Namespace) -> int:
    """Say which parts of a model intersect or come near to each other."""
    with Reporter(command, options.quiet) as progress:
        with progress.stage("read"):
            surface = octex.load_surface(
                options.overlaps, options.rest, channels=["alpha"], sources={"alpha": 1.0}
            )
        with progress.stage("compare"):
            found = surface.overlapping_parts(options.margin or 0.0)
    told = {"model": str(options.overlaps), "margin": found.margin, **_as_json(found)}
    tell(options, told, f"{options.overlaps}: {found}")
    return ExitCode.DONE


def _as_json(found: Overlaps) -> dict[str, Any]:
    """Return what was found for a machine; a gap beyond the margin, and a volume not known, are null."""
    pairs = [pair._asdict() for pair in found.pairs]
    for pair in pairs:
        pair["gap"] = pair["gap"] if math.isfinite(pair["gap"]) else None
    return {"parts": found.n_parts, "pairs": pairs, "unchecked": [each._asdict() for each in found.unchecked]}


def separated_as_json(texture: OctreeTexture, found: Overlaps) -> dict[str, Any]:
    """Return which parts were moved, how far and why, for a machine."""
    return {**_as_json(found), "moved": _moved(texture)}


def separated_text(texture: OctreeTexture, found: Overlaps) -> Iterator[str]:
    """Yield the lines that say which parts were moved, and how far, and what could not be checked."""
    moved = _moved(texture)
    if not moved:
        yield (
            f"{found.n_parts:,} parts, none too near to another: none is moved"
            if found.n_parts > 1
            else "one part alone: nothing to move apart; where it runs through itself it stays as it is"
        )
    else:
        yield f"{len(moved):,} of {found.n_parts:,} parts moved apart; Surface.rest_positions says where to"
        for part, offset in list(moved.items())[:_LINES]:
            yield f"  part {part} by {', '.join(f'{step:.6g}' for step in offset)}"
        if len(moved) > _LINES:
            yield f"  and {len(moved) - _LINES:,} more; --json lists them"
    if found.unchecked:
        yield (
            f"{len(found.unchecked):,} of them are no solids: only their surfaces were checked, not what "
            "lies inside; --overlaps lists them"
        )


def _moved(texture: OctreeTexture) -> dict[str, list[float]]:
    moved: dict[str, list[float]] = json.loads(texture.metadata.get("separation", '{"moved": {}}'))["moved"]
    return moved
