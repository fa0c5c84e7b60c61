"""What octree-convert does with a texture: an operation for each option, in the order listed here."""

from __future__ import annotations

import argparse
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING

import octex
from octex.cli.models import open_sound
from octex.errors import InputError

if TYPE_CHECKING:
    from octex.texture import OctreeTexture


def others_of(options: argparse.Namespace) -> list[Path]:
    """Return the files of the other textures that are read."""
    return [*([options.combine] if options.combine else []), *([options.mix[0]] if options.mix else [])]


def processed(options: argparse.Namespace, executor: Executor | None) -> OctreeTexture:
    """Open a texture and do what is asked for: crop, depth, combine, mix, blur, levels, channels and dtype.

    Raises InputError and ArgumentError for what cannot be done.
    """
    from octex.processing.edit import noted
    from octex.texture import OctreeTexture

    texture = open_sound(options.INPUT)
    if options.channels is not None:
        from octex.checks import as_choice

        for name in options.channels:
            as_choice(name, texture.channels, f"channel of {options.INPUT}:")
    if options.crop is not None:
        texture = octex.crop(texture, options.crop[:3], options.crop[3:])
    if options.depth is not None:
        deepest = texture.tree.max_depth
        if options.depth > deepest:
            raise InputError(
                f"{options.INPUT}: has depth {deepest}; --depth {options.depth} is finer and needs the model"
            )
        # octex.resize would also divide the leaves that are above it, into cells that nothing is known of.
        coarse = texture.level(options.depth)
        metadata = noted(texture.metadata, "resize", depth=options.depth)
        texture = OctreeTexture(coarse.tree, coarse.channels, coarse.placement, coarse.bounds, metadata)
    if options.combine is not None:
        texture = octex.combine(texture, open_sound(options.combine), over=True, executor=executor)
    if options.mix is not None:
        other, amount = options.mix
        texture = octex.mix(texture, open_sound(other), amount, executor=executor)
    if options.blur is not None:
        texture = octex.blur(texture, options.blur, executor=executor)
    if options.levels is not None:
        texture = octex.levels(texture, "base_color", *options.levels)
    if options.channels is not None or options.dtype is not None:
        texture = octex.cast(texture, options.dtype, options.channels)
    return texture
