"""Paint merged into a texture: each cell blended once, averages and facings with it (paper 4.1, step 5)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

import numpy as np
import numpy.typing as npt

from octex.channels import ALPHA, ONE, decode, encode
from octex.checks import as_choice, as_number
from octex.conversion.facings import MOST, in_codes
from octex.errors import ArgumentError
from octex.painting.averages import updated_averages
from octex.painting.cells import Paint, paint_of, painted_channel, refine_paint
from octex.painting.pictures import BLENDS, Blend
from octex.painting.raising import raise_texture
from octex.parallel import Progress, as_progress, workers
from octex.source.surface import Surface, as_surface
from octex.texture import OctreeTexture, as_texture
from octex.texture.channel import Channel
from octex.texture.split import bits_of, rows_facing, with_split
from octex.tree.edit import locate
from octex.tree.layout import FACING_FLAGS, SPLIT
from octex.tree.octree import Octree

Int64s = npt.NDArray[np.int64]
Float32s = npt.NDArray[np.float32]


def merge(
    texture: OctreeTexture,
    layer: OctreeTexture,
    surface: Surface,
    *,
    opacity: float = 1.0,
    blend: Blend = "over",
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> OctreeTexture:
    """Merge a layer of paint, as ``rasterize_paint`` makes it, into a texture; both stay as they are.

    Each cell is blended once, in linear light, with the layer's coverage times ``opacity``; see BLENDS.
    Where the layer is finer the texture is raised to it, and keeps the coefficients that it had, so that the
    field beside the paint does not move. ``surface`` is the one that both were made on.

    Raises ArgumentError for a layer of another root cell, of several channels, or of one that the texture
    does not have.
    """
    as_texture(texture)
    as_texture(layer, "layer")
    as_surface(surface)
    report = as_progress(progress)
    as_choice(blend, BLENDS, "blend")
    opacity = as_number(opacity, "opacity", 0.0, 1.0)
    form, paint = paint_of(layer, opacity)
    target = ALPHA.name if blend == "erase" else form.name
    if layer.placement != texture.placement:
        raise ArgumentError(
            f"the layer's root cell, {layer.placement}, is not the texture's, {texture.placement}; "
            "project the pictures onto this texture anew"
        )
    if not any(each.codes.size for each in paint):
        return texture
    given = texture
    surface = surface.placed_in(texture)
    if target == ALPHA.name and target not in texture.channels:
        texture = _with_alpha(texture)
    as_choice(target, texture.channels, "channel to paint")
    stored = texture.channels[target].format
    if stored.components != form.components and blend != "erase":
        raise ArgumentError(
            f"the layer paints {form.components} components, but {target!r} of the texture has "
            f"{stored.components}"
        )
    with workers(executor) as pool:
        base, is_fresh, paint = raise_texture(
            texture, layer, paint, surface, pool, report, adds=blend != "erase"
        )
    if not any(each.codes.size for each in paint):
        return given
    paint = refine_paint(paint, layer, base.tree, opacity)
    return _blended(base, is_fresh, paint, layer, target, blend, opacity)


def _with_alpha(texture: OctreeTexture) -> OctreeTexture:
    """Give a texture a channel alpha: opaque."""
    channel = Channel(
        ALPHA,
        *(
            np.full((rows, 1), ONE[ALPHA.dtype], ALPHA.dtype)
            for rows in (texture.tree.n_cells, texture.tree.split.areas.size, texture.tree.kept.cells.size)
        ),
    )
    return OctreeTexture(
        texture.tree,
        {**texture.channels, ALPHA.name: channel},
        texture.placement,
        texture.bounds,
        texture.metadata,
    )


def blended(base: Float32s, paint: Float32s, coverage: Float32s, blend: Blend) -> Float32s:
    """Return paint (n, components) of some coverage (n,) over what is there; see BLENDS."""
    if blend == "replace":
        coverage = (coverage > 0).astype(np.float32)
    part = coverage[:, None]
    if blend == "add":
        return base + part * paint
    if blend == "multiply":
        paint = base * paint
    elif blend == "screen":
        paint = 1 - (1 - base) * (1 - paint)
    elif blend == "erase":
        paint = np.zeros_like(base)
    return base + part * (paint - base)


def _blended(
    base: OctreeTexture,
    is_fresh: npt.NDArray[np.bool_],
    paint: Sequence[Paint],
    layer: OctreeTexture,
    target: str,
    blend: Blend,
    opacity: float,
) -> OctreeTexture:
    """Blend paint into the cells that it is on, once each (step 5), and average anew."""
    tree = base.tree
    whole = [_in_tree(tree, each, level) for level, each in enumerate(paint) if each.codes.size]
    cells, values, coverage, sources = (np.concatenate(arrays) for arrays in zip(*whole, strict=True))
    order = np.argsort(cells, kind="stable")
    cells, values, coverage, sources = cells[order], values[order], coverage[order], sources[order]
    stored = base.channels
    if blend == "erase":
        values = np.zeros((len(values), 1), np.float32)
    made = {target: values}
    parts = {target: (coverage > 0).astype(np.float32) if blend == "replace" else coverage}
    if blend == "over" and target != ALPHA.name and ALPHA.name in stored:
        # Over what is translucent itself, paint counts for more of the colour (Porter & Duff 1984).
        there = decode(stored[ALPHA.name].values[cells], "data")[:, 0]
        there[is_fresh[cells]] = 0
        united = coverage + there * (1 - coverage)
        parts[target] = np.where(united > 0, coverage / np.maximum(united, 1e-9), 0).astype(np.float32)
        made[ALPHA.name], parts[ALPHA.name] = np.ones((len(cells), 1), np.float32), coverage
    elif ALPHA.name in stored and target != ALPHA.name and is_fresh.any():
        made[ALPHA.name], parts[ALPHA.name] = np.ones((len(cells), 1), np.float32), np.zeros_like(coverage)
    channels = dict(stored)
    for name, paints in made.items():
        form = stored[name].format
        mode: Blend = "over" if name == ALPHA.name and blend != "erase" else blend
        old = decode(stored[name].values[cells], form.space)
        new = blended(old, paints, parts[name], mode)
        fresh = is_fresh[cells]
        new[fresh] = paints[fresh] if name == target else coverage[fresh, None]
        after = stored[name].values.copy()
        after[cells] = encode(new, form.dtype, form.space)
        part = parts[name].copy()
        part[fresh] = 1
        codes = [each.codes for each in paint]
        counts = name == target and blend in ("over", "replace")
        above = updated_averages(
            tree, stored[name].values, after, form, cells, part, codes, layer,
            layer.channels[painted_channel(layer)] if counts else None, ~is_fresh,
        )  # fmt: skip
        after[above.nodes] = encode(above.values, form.dtype, form.space)
        channels[name] = stored[name]._replace(values=after)
    made_of = OctreeTexture(tree, channels, base.placement, base.bounds, base.metadata)
    cells, sources = np.concatenate([cells, above.nodes]), np.concatenate([sources, above.sources])
    return _facing(made_of, base, is_fresh, cells, sources, layer, target, blend, opacity)


def _in_tree(tree: Octree, paint: Paint, level: int) -> tuple[Int64s, Float32s, Float32s, Int64s]:
    """Return the numbers of painted cells of a level, their paint, coverage and sources."""
    return locate(tree, paint.codes, level).cells, paint.values, paint.coverage, paint.cells


def _facing(
    texture: OctreeTexture,
    before: OctreeTexture,
    is_fresh: npt.NDArray[np.bool_],
    cells: Int64s,
    sources: Int64s,
    layer: OctreeTexture,
    target: str,
    blend: Blend,
    opacity: float,
) -> OctreeTexture:
    """Paint what cells show each way, where the paint, of ``sources``, or the cells tell facings apart."""
    tree = texture.tree
    if not (tree.split.cells.size or layer.tree.split.cells.size):
        return texture
    flags, paint_flags = tree.arrays.flags, layer.tree.arrays.flags
    chosen = ((flags[cells] | paint_flags[sources]) & SPLIT != 0) & (flags[cells] & FACING_FLAGS != 0)
    cells, sources = cells[chosen], sources[chosen]
    if not cells.size:
        return texture
    order = np.argsort(cells, kind="stable")
    cells, sources = cells[order], sources[order]
    facings = flags[cells] & np.uint8(FACING_FLAGS)
    owners = np.repeat(np.arange(cells.size), np.bitwise_count(facings))
    bits = bits_of(facings)
    paint = rows_facing(layer, layer.channels[painted_channel(layer)], sources[owners], bits)
    coverage = rows_facing(layer, layer.channels[ALPHA.name], sources[owners], bits)[:, 0]
    coverage = coverage * np.float32(opacity)
    coverage[paint_flags[sources[owners]] & bits == 0] = 0
    if blend == "erase":
        paint = np.zeros((len(owners), 1), np.float32)
    form = texture.channels[target].format
    old = rows_facing(before, before.channels[target], cells[owners], bits)
    new = blended(old, paint, coverage, blend)
    fresh = is_fresh[cells[owners]]
    bare = fresh & (coverage == 0)
    new[fresh] = paint[fresh]
    new[bare] = decode(texture.channels[target].values[cells[owners[bare]]], form.space)
    rows = encode(new, form.dtype, form.space)
    scaled = in_codes(rows, form)
    starts = np.flatnonzero(np.diff(owners, prepend=-1))
    spread = np.maximum.reduceat(scaled, starts) - np.minimum.reduceat(scaled, starts)
    was_split = flags[cells] & SPLIT != 0
    is_split = was_split | (spread > MOST).any(axis=1)
    return with_split(texture, cells[is_split], facings[is_split], {target: rows[is_split[owners]]})
