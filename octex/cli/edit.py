"""octex edit: writes an edited texture; applies the options' operations in a fixed order."""

from __future__ import annotations

from typing import TYPE_CHECKING

import octex
from octex.cli.common import Reporter, check_outputs, facts_of, tell_file
from octex.cli.convert import OUTPUT_ENDINGS, check_output_kind, write_texture
from octex.cli.inputs import open_texture, refuse, tell_layers
from octex.cli.parser import Options
from octex.cli.values import ARCHIVE_ENDING
from octex.errors import InputError

if TYPE_CHECKING:
    from octex.texture import OctreeTexture


def edit(options: Options, program: str) -> int:
    """Run octex edit."""
    check_output_kind(options.TEXTURE, options.OUTPUT)
    if options.OUTPUT.suffix.lower() != ARCHIVE_ENDING:
        refuse(options, ["--loss"], f"is for NAME{ARCHIVE_ENDING}")
    others = [options.combine, options.mix and options.mix[0]]
    outputs = [(options.OUTPUT, OUTPUT_ENDINGS, "OUTPUT")]
    check_outputs(outputs, [options.TEXTURE, *others], force=options.force)
    with Reporter(program, options.quiet) as progress:
        texture = _edited(options, progress)
        write_texture(texture, options.OUTPUT, progress, options.loss)
    return tell_file(options, *facts_of(texture))


def _edited(options: Options, progress: Reporter) -> OctreeTexture:
    """Open the texture and apply each option."""
    from octex.processing.edit import noted
    from octex.texture import OctreeTexture

    texture = open_texture(options.TEXTURE)
    tell_layers(texture, options.TEXTURE, progress.note)
    if options.channels is not None:
        from octex.checks import as_choice

        for name in options.channels:
            as_choice(name, texture.channels, f"channel of {options.TEXTURE}:")
    if options.crop is not None:
        texture = octex.crop(texture, options.crop[:3], options.crop[3:])
    if options.depth is not None:
        deepest = texture.tree.max_depth
        if options.depth > deepest:
            raise InputError(
                f"{options.TEXTURE}: has depth {deepest}; --depth {options.depth} needs the model"
            )
        # octex.resize would also divide the leaves above it, into cells without new detail.
        coarse = texture.level(options.depth)
        metadata = noted(texture.metadata, "resize", depth=options.depth)
        texture = OctreeTexture(coarse.tree, coarse.channels, coarse.placement, coarse.bounds, metadata)
    if options.combine is not None:
        texture = octex.combine(texture, open_texture(options.combine), over=True)
    if options.mix is not None:
        other, amount = options.mix
        texture = octex.mix(texture, open_texture(other), amount)
    if options.blur is not None:
        texture = octex.blur(texture, options.blur)
    if options.levels is not None:
        texture = octex.levels(texture, "base_color", *options.levels)
    if options.channels is not None or options.dtype is not None:
        texture = octex.cast(texture, options.dtype, options.channels)
    return texture
