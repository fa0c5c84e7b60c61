"""Paint merged into a texture: each cell blended once, averages and facings with it (paper 4.1, step 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor

import numpy as np

from octex.arrays import Bools, Float32s, Int64s, Uint8s
from octex.channels import ALPHA, decode, encode
from octex.checks import as_choice, as_number
from octex.editing.averages import Residuals, average_rows
from octex.editing.draft import Change, cut_out, tiles_around, with_alpha, with_channels_of
from octex.editing.split import rows_facing, split_in_vain, with_split, without_split
from octex.errors import ArgumentError, DefectError, own_making
from octex.painting.averages import (
    Above,
    average_above,
    nodes_above,
    residuals_before,
    residuals_of_paint,
)
from octex.painting.cells import Paint, paint_of, painted_channel, refine_paint
from octex.painting.ground import Ground
from octex.painting.kept import bare_leaves, on_kept, with_old_skirts
from octex.painting.pictures import BLENDS, Blend
from octex.painting.raising import Raised, raise_texture
from octex.parallel import Progress, as_progress, workers
from octex.source.surface import Surface, as_surface
from octex.texture import OctreeTexture, as_texture
from octex.texture.channel import Channel
from octex.tree.edit import among, locate
from octex.tree.layout import FACING_FLAGS, POSITIVE_FACINGS, SPLIT
from octex.tree.octree import Octree
from octex.tree.split import rows_of

#: Paint of this coverage or more hides what is below: less than half a step of 8 bits shows through.
_HIDING = 1.0 - 1.0 / 512.0
#: Cells that are blended at once.
_BLOCK = 1 << 16


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
    field beside the paint does not move; those that only painted surface depends on are blended too. Less
    than three of the coarser cells from unpainted surface some of what was there is seen through finer paint:
    of white below black, where cells are halved, up to 0.18 in the second fine cell from the rim, 0.02 in the
    fourth, 0.001 from the fifth on; where they are quartered, up to 0.4, 0.2 and 0.005. So near the rim what
    is seen through half opaque paint is up to 0.04 off its half, from the fifth fine cell on.

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
    form, paint = paint_of(layer, opacity)
    target = ALPHA.name if blend == "erase" else form.name
    if layer.placement != texture.placement:
        raise ArgumentError(
            f"the layer's root cell, {layer.placement}, is not the texture's, {texture.placement}; "
            "project the pictures onto this texture anew"
        )
    if not any(each.codes.size for each in paint):
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
    tiles = tiles_around(texture, [each.codes for each in paint])
    part = texture if tiles is None else cut_out(texture, tiles)
    raised = raise_texture(
        part, texture, layer, paint, ground, executor, report,
        adds=blend != "erase", hiding=_hiding(texture, target, blend),
    )  # fmt: skip
    if not any(each.codes.size for each in raised.paint):
        return None
    report("merge", 0, 1)
    with own_making():
        paint = refine_paint(raised.paint, layer, raised.texture.tree, opacity)
        tree, is_skirt = raised.texture.tree, raised.is_skirt
        bare = bare_leaves(tree, paint, is_skirt) if tree.kept.cells.size else []
        paint = with_old_skirts(tree, paint, bare, is_skirt, executor)
        made = _blended(part, raised, paint, bare, layer, target, blend, opacity)
    report("merge", 1, 1)
    return Change(tiles, with_channels_of(part, given), made)


def _hiding(texture: OctreeTexture, target: str, blend: Blend) -> float:
    """Return the coverage from which on paint leaves nothing of what a texture had, of any channel."""
    changed = {target, ALPHA.name} if blend == "over" else {target}
    if blend not in ("over", "erase", "replace") or not changed >= texture.channels.keys():
        return np.inf
    return 0.0 if blend == "replace" else _HIDING


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


def mixed(
    blend: Blend,
    target: str,
    old: Mapping[str, Float32s],
    paint: Float32s,
    coverage: Float32s,
    is_fresh: Bools,
) -> dict[str, tuple[Float32s, Float32s]]:
    """Return what paint (n, components) makes of the values of channels, and how much of each is paint (n,).

    ``old`` are the channel that is painted, ``target``, and alpha if there is one; where the texture had
    nothing, ``is_fresh``, there is paint alone.
    """
    ones = np.ones((len(paint), 1), np.float32)
    if blend == "erase":
        paint = 0 * ones
    found = {target: (paint, (coverage > 0).astype(np.float32) if blend == "replace" else coverage)}
    if blend == "over" and target != ALPHA.name and ALPHA.name in old:
        # Over what is translucent itself, paint counts for more of the colour (Porter & Duff 1984).
        there = np.where(is_fresh, np.float32(0), old[ALPHA.name][:, 0])
        united = coverage + there * (1 - coverage)
        part = np.where(united > 0, coverage / np.maximum(united, np.float32(1e-9)), np.float32(0))
        found = {target: (paint, part), ALPHA.name: (ones, coverage)}
    elif ALPHA.name in old and target != ALPHA.name and is_fresh.any():
        found[ALPHA.name] = ones, np.zeros_like(coverage)
    for name, (own, part) in found.items():
        new = blended(old[name], own, part, "over" if name == ALPHA.name and blend != "erase" else blend)
        new[is_fresh] = own[is_fresh] if name == target else coverage[is_fresh, None]
        found[name] = new, np.where(is_fresh, np.float32(1), part)
    return found


def _blended(
    texture: OctreeTexture,
    raised: Raised,
    paint: Sequence[Paint],
    bare: Sequence[Int64s],
    layer: OctreeTexture,
    target: str,
    blend: Blend,
    opacity: float,
) -> OctreeTexture:
    """Blend paint into the cells that it is on, once each (step 5), and average anew."""
    tree, is_fresh = raised.texture.tree, raised.is_fresh
    cells, values, coverage, sources = _on_leaves(tree, paint)
    above = nodes_above(tree, [each.codes for each in paint], raised.old < 0, texture.tree, layer.tree)
    may_split = _may_split(tree, layer.tree, cells, sources, above)
    base = raised.texture
    if may_split.size:
        base = with_split(base, may_split, tree.arrays.flags[may_split] & np.uint8(FACING_FLAGS), {})
    met = {name: own for name, own in base.channels.items() if name in (target, ALPHA.name)}
    fresh = is_fresh[cells]
    blends = [name for name in met if name == target or blend == "over" or fresh.any()]
    channels, parts = dict(base.channels), dict[str, Channel]()
    averaged: list[str] = []
    for name, channel in base.channels.items():
        if name in blends or ALPHA.name in blends or is_fresh.any():
            arrays = channel.values.copy(), channel.split_values.copy(), channel.kept_values
            channels[name] = Channel(channel.format, *arrays)
            averaged.append(name)
    for name in blends:
        counts = len(channels[name].values), len(channels[name].split_values), 0
        nothing = (np.zeros((count, 1), np.float32) for count in counts)
        parts[name] = Channel(channels[name].format, *nothing)
    for begin in range(0, cells.size, _BLOCK):
        here = slice(begin, begin + _BLOCK)
        old = {name: decode(own.values[cells[here]], own.format.space) for name, own in met.items()}
        made = mixed(blend, target, old, values[here], coverage[here], fresh[here])
        for name, (new, part) in made.items():
            form = channels[name].format
            channels[name].values[cells[here]] = encode(new, form.dtype, form.space)
            parts[name].values[cells[here], 0] = part
    kept = on_kept(tree, paint, bare)
    if kept.rows.size:
        old = {
            name: decode(own.kept_values[kept.rows], own.format.space)
            for name, own in raised.texture.channels.items()
            if name in blends
        }
        fresh = is_fresh[tree.kept.cells[kept.rows]]
        for name, (new, _) in mixed(blend, target, old, kept.values, kept.coverage, fresh).items():
            form, stored = channels[name].format, channels[name].kept_values.copy()
            stored[kept.rows] = encode(new, form.dtype, form.space)
            channels[name] = channels[name]._replace(kept_values=stored)
    after = base.with_cells(base.tree, channels)

    rows = rows_of(base.tree.split, cells)
    owners = np.searchsorted(cells, rows.cells)
    values, coverage = _shown(layer, sources[owners], rows.bits, opacity)
    old = {name: decode(own.split_values[rows.rows], own.format.space) for name, own in met.items()}
    fresh = is_fresh[rows.cells]
    bare = fresh & (coverage == 0)
    for name, (new, part) in mixed(blend, target, old, values, coverage, fresh).items():
        form = channels[name].format
        if name != ALPHA.name:
            new[bare] = decode(channels[name].values[rows.cells[bare]], form.space)
        channels[name].split_values[rows.rows] = encode(new, form.dtype, form.space)
        parts[name].split_values[rows.rows, 0] = part

    rows = rows_of(base.tree.split, above.nodes.cells)
    left = {}
    for name in sorted(averaged, key=lambda name: name != ALPHA.name):
        had = residuals_before(texture, raised.texture, name, above, is_fresh, rows)
        takes_on = name == target and blend in ("over", "replace")
        of_paint = residuals_of_paint(layer, painted_channel(layer), above, rows) if takes_on else None
        left[name] = average_above(after, channels[name], parts.get(name), above, rows, had, of_paint)
    new_split = may_split[tree.arrays.flags[may_split] & SPLIT == 0]
    return _settled(after, new_split, texture, raised, above, left)


def _shown(layer: OctreeTexture, sources: Int64s, bits: Uint8s, opacity: float) -> tuple[Float32s, Float32s]:
    """Return what paint, of cells ``sources`` (n,) of its octree, shows facings (n,), and its coverage."""
    values = rows_facing(layer, layer.channels[painted_channel(layer)], sources, bits)
    coverage = rows_facing(layer, layer.channels[ALPHA.name], sources, bits)[:, 0] * np.float32(opacity)
    coverage[layer.tree.arrays.flags[sources] & bits == 0] = 0
    return values, coverage


def _settled(
    after: OctreeTexture,
    new_split: Int64s,
    texture: OctreeTexture,
    raised: Raised,
    above: Above,
    left: Mapping[str, Residuals],
) -> OctreeTexture:
    """Keep those of the newly split cells that need it; average rows for the cells that are then split."""
    excess = split_in_vain(after, new_split)
    found, channels = _writable(without_split(after, excess))
    rows = rows_of(found.tree.split, above.nodes.cells)
    stays = ~among(rows_of(after.tree.split, above.nodes.cells).cells, excess)
    rows_left = {name: own.rows[stays] for name, own in left.items()}
    # Rows of other channels change where, or above where, cells are split or faced otherwise than before.
    was = np.where(above.before.numbers >= 0, texture.tree.arrays.flags[above.before.cells], np.uint8(0))
    is_new = (found.tree.arrays.flags[above.nodes.cells] ^ was) & np.uint8(FACING_FLAGS | SPLIT) != 0
    if is_new.any() or excess.size < new_split.size:
        for name in found.channels.keys() - left.keys():
            own = residuals_before(texture, raised.texture, name, above, raised.is_fresh, rows)
            rows_left[name] = own.rows
    elif not excess.size:
        return found
    for name in sorted(rows_left, key=lambda name: name != ALPHA.name):  # the others weigh by alpha's rows
        average_rows(found, channels[name], rows_left[name], above.nodes)
    return found


def _writable(texture: OctreeTexture) -> tuple[OctreeTexture, dict[str, Channel]]:
    """Return a texture with rows of its own, and its channels, to whose rows can be written."""
    channels = {
        name: channel._replace(split_values=channel.split_values.copy())
        for name, channel in texture.channels.items()
    }
    return texture.with_cells(texture.tree, channels), channels


def _on_leaves(tree: Octree, paint: Sequence[Paint]) -> tuple[Int64s, Float32s, Float32s, Int64s]:
    """Return the leaves that are painted, ascending, and their paint, coverage and sources."""
    found = []
    for level, each in enumerate(paint):
        if each.codes.size:
            where = locate(tree, each.codes, level)
            if not (where.is_leaf & (where.levels == level)).all():
                raise DefectError(f"paint of level {level} does not lie on leaves")
            found.append((where.cells, each.values, each.coverage, each.cells))
    columns = zip(*found, strict=True)
    cells, values, coverage, sources = (own[0] if len(own) == 1 else np.concatenate(own) for own in columns)
    if (np.diff(cells) <= 0).any():
        raise DefectError("paint lies twice on a cell, or out of order")
    return cells, values, coverage, sources


def _may_split(tree: Octree, layer: Octree, cells: Int64s, sources: Int64s, above: Above) -> Int64s:
    """Return cells, ascending, in which paint may make a difference between facings.

    These are painted leaves that tell facings apart, or whose paint does, and nodes above that show both
    ways along an axis.
    """
    flags = tree.arrays.flags
    facings = flags & np.uint8(FACING_FLAGS)
    leaves = cells[((flags[cells] | layer.arrays.flags[sources]) & SPLIT != 0) & (facings[cells] != 0)]
    nodes = above.nodes.cells
    both = facings[nodes] & facings[nodes] >> np.uint8(1) & np.uint8(POSITIVE_FACINGS)
    chosen = (both != 0) | (flags[nodes] & SPLIT != 0)
    return np.sort(np.concatenate([leaves, nodes[chosen]]))
