"""Each cell of paint blended once, averages and facings with it (paper 4.1, step 5)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Int64s, Uint8s
from octex.channels import ALPHA, ChannelFormat, decode, encode
from octex.editing.averages import Residuals, average_rows
from octex.editing.split import rows_facing, split_in_vain, with_split, without_split
from octex.errors import DefectError
from octex.painting.averages import (
    Above,
    average_above,
    nodes_above,
    residuals_before,
    residuals_of_paint,
)
from octex.painting.cells import Paint, leave_bare, painted_channel, refine_paint, some
from octex.painting.kept import bare_leaves, on_kept, with_old_skirts
from octex.painting.picture import Blend
from octex.painting.raising import Raised
from octex.texture import OctreeTexture
from octex.texture.channel import Channel
from octex.tree.edit import among, locate
from octex.tree.layout import FACING_FLAGS, POSITIVE_FACINGS, SPLIT
from octex.tree.octree import Octree
from octex.tree.split import rows_of

#: Cells that are blended at once.
_BLOCK = 1 << 16


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
    return (1 - part) * base + part * paint  # all of the paint where it is opaque, however bright the base is


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


class Merged(NamedTuple):
    """A texture with paint merged into it."""

    texture: OctreeTexture
    parts: OctreeTexture  # the same cells; how much of the channels that are painted is paint, 0 … 1
    is_fresh: Bools  # (cells,)   where the texture had nothing
    is_new: Bools  # (cells,)   where it had no cell
    painted: list[Int64s]  # the leaves that paint is on, by level
    is_told: bool  # whether rows of all channels are averaged, for cells that are split or faced otherwise


def blend_paint(
    texture: OctreeTexture,
    raised: Raised,
    layer: OctreeTexture,
    target: str,
    blend: Blend,
    opacity: float,
    executor: Executor,
) -> Merged:
    """Blend paint into the cells that it is on, once each, and average anew.

    ``texture`` is what was raised to ``raised``.
    """
    tree, is_skirt, is_fresh = raised.texture.tree, raised.is_skirt, raised.is_fresh
    paint = refine_paint(raised.paint, layer, tree, opacity)
    bare = bare_leaves(tree, paint, is_skirt) if tree.kept.cells.size or is_skirt.any() else []
    paint = with_old_skirts(tree, paint, bare, is_skirt, executor)
    cells, on_leaves = _on_leaves(tree, paint)
    above = nodes_above(tree, [each.codes for each in paint], raised.old < 0, texture.tree, layer.tree)
    may_split = _may_split(tree, cells, on_leaves.flags, above)
    base = _split(raised.texture, may_split)
    met = {name: own for name, own in raised.texture.channels.items() if name in (target, ALPHA.name)}
    fresh = is_fresh[cells]
    names = [name for name in met if name == target or blend == "over" or fresh.any()]
    parts = no_parts(base.tree, names)
    is_averaged = ALPHA.name in names or bool((raised.old < 0).any())
    channels = _writable(base, base.channels if is_averaged else names)
    for begin in range(0, cells.size, _BLOCK):
        here = slice(begin, begin + _BLOCK)
        old = {name: decode(own.values[cells[here]], own.format.space) for name, own in met.items()}
        of_paint = on_leaves.values[here], on_leaves.coverage[here]
        made = mixed(blend, target, old, *of_paint, fresh[here])
        for name, (new, part) in made.items():
            form = channels[name].format
            channels[name].values[cells[here]] = encode(new, form.dtype, form.space)
            parts[name].values[cells[here], 0] = part
    kept = on_kept(tree, paint, bare, is_skirt, executor)
    if kept.rows.size:
        old = {
            name: decode(own.kept_values[kept.rows], own.format.space)
            for name, own in raised.texture.channels.items()
            if name in parts
        }
        no_fresh = np.zeros(kept.rows.size, np.bool_)
        for name, (new, _) in mixed(blend, target, old, kept.values, kept.coverage, no_fresh).items():
            form, stored = channels[name].format, channels[name].kept_values.copy()
            stored[kept.rows] = encode(new, form.dtype, form.space)
            channels[name] = channels[name]._replace(kept_values=stored)

    rows = rows_of(base.tree.split, cells)
    owners = np.searchsorted(cells, rows.cells)
    values, coverage = _shown(layer, some(on_leaves, owners), rows.bits, opacity)
    old = {name: decode(base.channels[name].split_values[rows.rows], met[name].format.space) for name in met}
    fresh = is_fresh[rows.cells]
    bare_rows = fresh & (coverage == 0)
    for name, (new, part) in mixed(blend, target, old, values, coverage, fresh).items():
        form = channels[name].format
        if name != ALPHA.name:
            new[bare_rows] = decode(channels[name].values[rows.cells[bare_rows]], form.space)
        channels[name].split_values[rows.rows] = encode(new, form.dtype, form.space)
        parts[name].split_values[rows.rows, 0] = part
    painted = [each.codes for each in paint]
    return _averaged(
        base, channels, parts, texture, raised, layer, above, may_split, painted, target, blend, False
    )


def average_tiles(
    made: Merged, texture: OctreeTexture, layer: OctreeTexture, target: str, blend: Blend
) -> OctreeTexture:
    """Average anew above cells that are ``painted``, into which paint has been merged already.

    They have no children, in ``texture`` as it was and ``layer`` neither.
    """
    old, no_skirt = np.where(made.is_new, -1, 0), np.zeros(made.is_new.size, np.bool_)
    raised = Raised(made.texture, old, made.is_fresh, [], no_skirt, [])
    above = nodes_above(made.texture.tree, made.painted, made.is_new, texture.tree, layer.tree)
    may_split = _may_split(made.texture.tree, np.empty(0, np.int64), np.empty(0, np.uint8), above)
    base, parts = (_split(each, may_split) for each in (made.texture, made.parts))
    channels, own = _writable(base, base.channels), _writable(parts, parts.channels)
    return _averaged(
        base,
        channels,
        own,
        texture,
        raised,
        layer,
        above,
        may_split,
        made.painted,
        target,
        blend,
        made.is_told,
    ).texture


def no_parts(tree: Octree, names: Iterable[str]) -> dict[str, Channel]:
    """Return how much of the cells of channels is paint: nothing."""
    counts = tree.n_cells, tree.split.areas.size, tree.kept.cells.size
    forms = [ChannelFormat(name, 1, "data", "float32") for name in names]
    return {form.name: Channel(form, *(np.zeros((n, 1), np.float32) for n in counts)) for form in forms}


def _split(texture: OctreeTexture, cells: Int64s) -> OctreeTexture:
    """Return a texture some of whose cells, ascending, are split."""
    if not cells.size:
        return texture
    return with_split(texture, cells, texture.tree.arrays.flags[cells] & np.uint8(FACING_FLAGS), {})


def _writable(texture: OctreeTexture, names: Collection[str]) -> dict[str, Channel]:
    """Return a texture's channels; to the values of some of them, but for kept ones, can be written."""
    return {
        name: Channel(own.format, own.values.copy(), own.split_values.copy(), own.kept_values)
        if name in names
        else own
        for name, own in texture.channels.items()
    }


def _averaged(
    base: OctreeTexture,
    channels: Mapping[str, Channel],
    parts: Mapping[str, Channel],
    texture: OctreeTexture,
    raised: Raised,
    layer: OctreeTexture,
    above: Above,
    may_split: Int64s,
    painted: list[Int64s],
    target: str,
    blend: Blend,
    was_told: bool,
) -> Merged:
    """Average anew, in place, what is above paint that has been blended; keep cells split that need it.

    ``was_told`` says that rows of all channels have been averaged below; see Merged.
    """
    after, is_fresh = base.with_cells(base.tree, channels), raised.is_fresh
    names = channels if ALPHA.name in parts or (raised.old < 0).any() else parts
    rows = rows_of(base.tree.split, above.nodes.cells)
    left = {}
    for name in sorted(names, key=lambda name: name != ALPHA.name):
        had = residuals_before(texture, raised.texture, name, above, is_fresh, rows)
        takes_on = name == target and blend in ("over", "replace")
        of_paint = residuals_of_paint(layer, painted_channel(layer), above, rows) if takes_on else None
        left[name] = average_above(after, channels[name], parts.get(name), above, rows, had, of_paint)
    new_split = may_split[raised.texture.tree.arrays.flags[may_split] & SPLIT == 0]
    excess = split_in_vain(after, new_split)
    is_told = was_told or excess.size < new_split.size
    made, is_told = _settled(after, excess, texture, raised, above, left, is_told=is_told)
    own = without_split(base.with_cells(base.tree, parts), excess)
    return Merged(made, own, is_fresh, raised.old < 0, painted, is_told)


def _shown(layer: OctreeTexture, paint: Paint, bits: Uint8s, opacity: float) -> tuple[Float32s, Float32s]:
    """Return the paint on facings (n,) of cells (n,), and its coverage.

    A facing that the paint octree's cell lacks, as those of skirts may be, has the paint of the cell as a
    whole; it is bare if the paint has other facings alone.
    """
    values = rows_facing(layer, layer.channels[painted_channel(layer)], paint.cells, bits)
    coverage = rows_facing(layer, layer.channels[ALPHA.name], paint.cells, bits)[:, 0] * np.float32(opacity)
    is_absent = layer.tree.arrays.flags[paint.cells] & bits == 0
    values[is_absent] = paint.values[is_absent]
    is_bare = leave_bare(bits, paint.flags)
    coverage[is_absent] = np.where(is_bare, np.float32(0), paint.coverage)[is_absent]
    return values, coverage


def _settled(
    after: OctreeTexture,
    excess: Int64s,
    texture: OctreeTexture,
    raised: Raised,
    above: Above,
    left: Mapping[str, Residuals],
    *,
    is_told: bool,
) -> tuple[OctreeTexture, bool]:
    """Return a texture without ``excess`` of newly split cells; average rows for those that are then split.

    ``is_told`` says that there are newly split cells in which facings are told apart. Returns also whether
    rows of all channels have been averaged.
    """
    found = without_split(after, excess)
    channels = {
        name: own._replace(split_values=own.split_values.copy()) for name, own in found.channels.items()
    }
    found = found.with_cells(found.tree, channels)
    rows = rows_of(found.tree.split, above.nodes.cells)
    stays = ~among(rows_of(after.tree.split, above.nodes.cells).cells, excess)
    rows_left = {name: own.rows[stays] for name, own in left.items()}
    if is_told:
        for name in found.channels.keys() - left.keys():
            own = residuals_before(texture, raised.texture, name, above, raised.is_fresh, rows)
            rows_left[name] = own.rows
    elif not excess.size:
        return found, False
    for name in sorted(rows_left, key=lambda name: name != ALPHA.name):  # the others weigh by alpha's rows
        average_rows(found, channels[name], rows_left[name], above.nodes)
    return found, is_told


def _on_leaves(tree: Octree, paint: Sequence[Paint]) -> tuple[Int64s, Paint]:
    """Return the leaves that are painted, ascending, and the paint on them."""
    found = []
    for level, each in enumerate(paint):
        if each.codes.size:
            where = locate(tree, each.codes, level)
            if not (where.is_leaf & (where.levels == level)).all():
                raise DefectError(f"paint of level {level} does not lie on leaves")
            found.append((where.cells, *each))
    columns = zip(*found, strict=True)
    cells, *paint_on = (own[0] if len(own) == 1 else np.concatenate(own) for own in columns)
    if (np.diff(cells) <= 0).any():
        raise DefectError("paint lies twice on a cell, or out of order")
    return cells, Paint(*paint_on)


def _may_split(tree: Octree, cells: Int64s, painted: Uint8s, above: Above) -> Int64s:
    """Return cells, ascending, in which paint may make a difference between facings.

    These are painted leaves that tell facings apart, or whose paint does, and nodes above that show both
    ways along an axis. ``painted`` (n,) are the flags of the paint on the leaves.
    """
    flags = tree.arrays.flags
    facings = flags & np.uint8(FACING_FLAGS)
    leaves = cells[((flags[cells] | painted) & SPLIT != 0) & (facings[cells] != 0)]
    nodes = above.nodes.cells
    both = facings[nodes] & facings[nodes] >> np.uint8(1) & np.uint8(POSITIVE_FACINGS)
    chosen = (both != 0) | (flags[nodes] & SPLIT != 0)
    return np.sort(np.concatenate([leaves, nodes[chosen]]))
