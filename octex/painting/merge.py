"""Paint merged into a texture: each cell blended once, averages and facings with it (paper 4.1, step 5)."""

from __future__ import annotations

from concurrent.futures import Executor

import numpy as np

from octex.channels import ALPHA
from octex.checks import as_choice, as_number
from octex.editing.draft import Change, Tiles, change_in, cut_out, tiles_around, with_alpha, with_channels_of
from octex.errors import ArgumentError, own_making
from octex.painting.blending import blend_paint
from octex.painting.cells import channel_of, paint_of
from octex.painting.ground import Ground
from octex.painting.pictures import BLENDS, Blend
from octex.painting.raising import raise_texture
from octex.painting.tilewise import merge_by_tiles, pieces_of
from octex.parallel import Progress, as_progress, workers
from octex.source.surface import Surface, as_surface
from octex.texture import OctreeTexture, as_texture


def merge(
    texture: OctreeTexture,
    layer: OctreeTexture,
    surface: Surface,
    *,
    opacity: float = 1.0,
    blend: Blend = "over",
    threads: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> OctreeTexture:
    """Merge a layer of paint, as ``rasterize_paint`` makes it, into a texture; both stay as they are.

    Each cell is blended once, in linear light, with the layer's coverage times ``opacity``; see BLENDS.
    Where the layer is finer the texture is raised to it, and keeps the coefficients that it had, so that the
    field beside the paint does not move, and other channels nowhere, but where surface is added. Coefficients
    that only painted surface depends on are blended too. Less than three of the coarser cells from unpainted
    surface some of what was there shows through finer paint. Measured on a robot, of white below black, where
    cells are halved: 99 % of lookups show less than 0.09 in the second fine cell from the rim, 0.03 in the
    third, 0.001 in the fourth. If the texture has channels that are not painted, it is 0.17, 0.12 and 0.07,
    0.04 in the fifth and 0.004 in the sixth.

    Looked up with normals, the field beside finer paint does move where facings are told apart: nodes show
    them the means of what is below, paint too, and what is raised has rows for six facings, not for every
    normal. Measured on thin sheets and creases: by up to 0.13 of the range in the first of the coarser cells
    from the paint, 0.07 to the middle of the second, 0.006 in the rest of it, nothing beyond.

    ``surface`` is the one that both were made on.

    Who works in parallel: ``threads``, so many, by default all processors for large batches and the calling
    thread alone for small ones; or the workers of ``executor``, any concurrent.futures.Executor. The result
    is the same.

    Raises ArgumentError for a layer of another root cell, of several channels, or of one that the texture
    does not have.
    """
    as_surface(surface)
    as_texture(texture)
    as_texture(layer, "layer")
    ground = Ground(surface.placed_in(texture))
    with workers(threads, executor) as pool:
        change = merged(
            texture, layer, ground, opacity=opacity, blend=blend, executor=pool, progress=progress
        )
    return texture if change is None else change.put_into(texture)


def merged(
    texture: OctreeTexture,
    layer: OctreeTexture,
    ground: Ground,
    *,
    opacity: float,
    blend: Blend,
    executor: Executor,
    progress: Progress | None,
) -> Change | None:
    """Return the change that merging a layer makes, or None for none; see `merge`."""
    report = as_progress(progress)
    as_choice(blend, BLENDS, "blend")
    opacity = as_number(opacity, "opacity", 0.0, 1.0)
    form = channel_of(layer)
    target = ALPHA.name if blend == "erase" else form.name
    if layer.placement != texture.placement:
        raise ArgumentError(
            f"the layer's root cell, {layer.placement}, is not the texture's, {texture.placement}; "
            "project the pictures onto this texture anew"
        )
    if opacity == 0.0 or not layer.tree.n_leaves:
        return None
    given = texture
    if target == ALPHA.name and target not in texture.channels:
        texture = with_alpha(texture)
    as_choice(target, texture.channels, "channel to paint")
    stored = texture.channels[target].format
    if stored.components != form.components and blend != "erase":
        raise ArgumentError(
            f"the layer paints {form.components} components, but {target!r} of the texture has "
            f"{stored.components}"
        )
    pieces = pieces_of(texture, layer)
    if pieces is not None:
        with own_making():
            found = merge_by_tiles(
                texture, layer, pieces, ground, target=target, blend=blend, opacity=opacity,
                executor=executor, progress=report,
            )  # fmt: skip
        if found is None:
            return None
        return change_in(Tiles(pieces.level, np.concatenate(pieces.tiles)), given, found)
    paint = paint_of(layer, opacity)
    if not any(each.codes.size for each in paint):
        return None
    tiles = tiles_around(texture, [each.codes for each in paint])
    part = texture if tiles is None else cut_out(texture, tiles)
    raised = raise_texture(part, texture, layer, paint, ground, executor, report, target=target, blend=blend)
    if not any(each.codes.size for each in raised.paint):
        return None
    report("merge", 0, 1)
    with own_making():
        made = blend_paint(part, raised, layer, target, blend, opacity, executor).texture
    report("merge", 1, 1)
    return Change(tiles, with_channels_of(part, given), made)
