"""What octree-convert does with a texture: an operation for each option, in the order listed here."""

from __future__ import annotations

import argparse
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING

import octex
from octex.cli.common import words_given
from octex.errors import ArgumentError, InputError

if TYPE_CHECKING:
    from octex.texture import OctreeTexture

#: Options that take a texture alone.
NEEDS_A_TEXTURE = ("--crop", "--combine", "--mix", "--blur", "--levels")
#: Options that take a model alone.
NEEDS_A_MODEL = ("--cell", "--max-error", "--detail", "--no-fit", "--rest", "--source", "--filter")


def others_of(options: argparse.Namespace) -> list[Path]:
    """Return the files of the other textures that are read."""
    return [*([options.combine] if options.combine else []), *([options.mix[0]] if options.mix else [])]


def check_options(options: argparse.Namespace, is_texture: bool) -> None:
    """Refuse options of models for textures, and the other way round. Raises ArgumentError."""
    for word in words_given(options):
        if is_texture and word in NEEDS_A_MODEL:
            raise ArgumentError(
                f"{options.INPUT}: {word} needs the model, and this is a texture made from one"
            )
        if not is_texture and word in NEEDS_A_TEXTURE:
            raise ArgumentError(f"{options.INPUT}: {word} is for .octex textures; convert the model first")


def processed(options: argparse.Namespace, executor: Executor | None) -> OctreeTexture:
    """Open a texture and do what is asked for: crop, depth, combine, mix, blur, levels, channels and dtype.

    Raises InputError and ArgumentError for what cannot be done.
    """
    texture = octex.open(options.INPUT)
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
        texture = octex.resize(texture, options.depth)
    if options.combine is not None:
        texture = octex.combine(texture, octex.open(options.combine), over=True, executor=executor)
    if options.mix is not None:
        other, amount = options.mix
        texture = octex.mix(texture, octex.open(other), amount, executor=executor)
    if options.blur is not None:
        texture = octex.blur(texture, options.blur, executor=executor)
    if options.levels is not None:
        texture = octex.levels(texture, "base_color", *options.levels)
    if options.channels is not None or options.dtype is not None:
        texture = octex.cast(texture, options.dtype, options.channels)
    return texture
