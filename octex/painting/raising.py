"""A texture brought to where paint is finer (paper 4.1, steps 4 and 7, and 4.2)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import decode, encode
from octex.conversion.facings import MOST, in_codes
from octex.conversion.fill import assemble, fill
from octex.painting.averages import add_up_areas
from octex.painting.cells import (
    Paint,
    boundary,
    refined_values,
    skirt_of,
    skirt_on_nothing,
    some,
    with_skirt,
)
from octex.painting.flat import Flat
from octex.painting.near import touching
from octex.parallel import Progress
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.texture.channel import Channel
from octex.texture.split import bits_of, refaced, rows_facing, with_split
from octex.tree.edit import Edited, Located, among, locate, raised, unchanged
from octex.tree.layout import FACING_FLAGS, KEPT, SPLIT
from octex.tree.morton import decode_cells
from octex.tree.octree import Octree, distinct

Int64s = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]


#: The area that skirts have, the least there is: in averages they weigh next to nothing.
_SKIRT = np.uint8(1)


class Met(NamedTuple):
    """The cells of a surface near paint."""

    tree: Octree
    codes: list[Int64s]  # by level


class Raised(NamedTuple):
    """A texture raised to paint."""

    texture: OctreeTexture
    is_fresh: Bools  # (cells,)   where the texture had nothing
    paint: list[Paint]  # with skirts


def raise_texture(
    texture: OctreeTexture,
    layer: OctreeTexture,
    paint: list[Paint],
    surface: Surface,
    executor: Executor,
    progress: Progress,
    *,
    adds: bool,
) -> Raised:
    """Bring a texture's tree to where paint, or the boundary around it, is finer; its field does not move.

    Leaves above become nodes that keep their coefficients. Below them stand the cells that the surface meets,
    with what the field refines to; what it does not meet is culled. Where the texture has nothing, the
    layer's cells are added, without values, if it ``adds``; else the paint there is dropped.

    Paint below what was a leaf gets a skirt: cells off the surface beside it, which would else be refined
    from the coefficients kept, and show through.
    """
    if not adds:
        paint = [_on(texture.tree, each, level) for level, each in enumerate(paint)]
    edited, paint, met = _raised(texture, paint, surface, executor, progress)
    made, is_fresh = _carried(texture, edited, edited.tree, met, layer, paint)
    return Raised(made, is_fresh, paint)


def _on(tree: Octree, paint: Paint, level: int) -> Paint:
    """Return the paint that lies on cells of a tree."""
    where = locate(tree, paint.codes, level)
    return some(paint, (where.levels == level) | where.is_leaf)


def _raised(
    texture: OctreeTexture,
    paint: list[Paint],
    surface: Surface,
    executor: Executor,
    progress: Progress,
) -> tuple[Edited, list[Paint], Met | None]:
    """Raise the tree; return also the paint with skirts, and the cells met below what is raised."""
    tree = texture.tree
    none = np.empty(0, np.int64)
    shallowest = next((level for level, (leaves, _) in enumerate(tree.cells_by_depth()) if leaves), None)
    added: list[Int64s] = []
    below: list[Int64s] = []
    virtual: list[Int64s] = []  # beside paint: refined from what is above, or skirts of earlier paint
    absent: list[Int64s] = []  # beside paint below leaves: where nothing is
    tops: list[tuple[int, Int64s]] = []
    for level, each in enumerate(paint):
        where = locate(tree, each.codes, level)
        is_missing = where.levels < level
        below.append(each.codes[is_missing & where.is_leaf])
        added.append(each.codes[is_missing & ~where.is_leaf])
        tops += _above(below[-1], where.of(is_missing & where.is_leaf), level)
        virtual.append(none)
        absent.append(none)
        if each.codes.size and (tree.kept.cells.size or (shallowest is not None and shallowest < level)):
            around = boundary(each.codes, level)
            where = locate(tree, around, level)
            flags = tree.arrays.flags[where.cells]
            is_refined = (where.levels < level) & (where.is_leaf | (flags & KEPT != 0))
            is_skirt = (where.levels == level) & where.is_leaf & (tree.arrays.areas[where.cells] == _SKIRT)
            virtual[-1] = around[is_refined | is_skirt]
            is_absent = (where.levels < level - 1) & ~where.is_leaf & (flags & KEPT == 0)
            absent[-1] = around[is_absent & among(around, boundary(below[-1], level))]
            is_below = is_refined & where.is_leaf
            tops += _above(around[is_below], where.of(is_below), level)
    if not tops and not any(codes.size for codes in (*added, *virtual)):
        return unchanged(tree), paint, None
    depth = max((level for level, each in enumerate(paint) if each.codes.size), default=0)
    met = _met_cells(surface, texture, tops, depth, executor, progress)
    wanted, skirts, with_skirts = [], [], []
    for level, each in enumerate(paint[: depth + 1]):
        surface_cells = met.codes[level]
        is_met = among(virtual[level], surface_cells)
        ring, outer = virtual[level][is_met], virtual[level][~is_met]
        if (outer.size or absent[level].size) and level <= tree.max_depth:
            surface_cells = distinct(np.concatenate([surface_cells, _facing_cells(tree, level)]))
        skirt = skirt_of(outer, paint, ring, surface_cells, level)
        is_new = locate(tree, skirt, level).levels < level
        where = locate(tree, absent[level], level)
        extra = [none]
        for top in (np.flatnonzero(np.bincount(where.levels)) + 1).tolist():
            here = absent[level][where.levels == top - 1]
            tops_here = distinct(here >> 3 * (level - top))
            extra.append(skirt_on_nothing(here, tops_here, paint, ring, surface_cells, level, top))
        added[level] = np.sort(np.concatenate([added[level], *extra]))
        every = np.sort(np.concatenate([skirt, *extra]))
        with_skirts.append(with_skirt(each, every, level))
        skirts.append(skirt)
        wanted.append(distinct(np.concatenate([below[level], ring, skirt[is_new]])))
    stored = list(met.codes)
    above = none
    for level in range(depth, -1, -1):
        above = distinct(np.concatenate([skirts[level], above]))
        stored[level] = distinct(np.concatenate([stored[level], above]))
        above = above >> 3
    return raised(tree, wanted, stored, added), with_skirts, met


def _facing_cells(tree: Octree, level: int) -> Int64s:
    """Return the Morton codes of a level's cells that a surface is in."""
    first, end = tree.arrays.level_cells[level : level + 2]
    codes: Int64s = tree.level_codes(level)[tree.arrays.areas[first:end] != _SKIRT]
    return codes


def _above(codes: Int64s, where: Located, level: int) -> list[tuple[int, Int64s]]:
    """Return the leaves above cells of a level, as levels and codes."""
    return [
        (top, distinct(codes[where.levels == top] >> 3 * (level - top)))
        for top in np.flatnonzero(np.bincount(where.levels)).tolist()
    ]


def _met_cells(
    surface: Surface,
    texture: OctreeTexture,
    tops: Sequence[tuple[int, Int64s]],
    depth: int,
    executor: Executor,
    progress: Progress,
) -> Met:
    """Find the cells down to ``depth`` that the surface meets in some cells, given by level."""
    chosen = touching(surface, tops, texture.placement) if tops else np.empty(0, np.int32)
    if not chosen.size:
        nothing = Octree.from_leaves(np.empty(0, np.int64), 0)
        return Met(nothing, [np.empty(0, np.int64)] * (depth + 1))
    part = Surface(surface.vertices, surface.triangles[chosen], Flat(), rest=surface.rest, name=surface.name)
    channels = part.source.channels
    filled = fill(part, channels, texture.placement, depth, executor, progress, has_samples=False)
    tree, _ = assemble(channels, filled)
    return Met(tree, [codes for codes, _ in tree.walk()])


def _carried(
    texture: OctreeTexture,
    edited: Edited,
    tree: Octree,
    met: Met | None,
    layer: OctreeTexture,
    paint: Sequence[Paint],
) -> tuple[OctreeTexture, npt.NDArray[np.bool_]]:
    """Give an edited tree the texture's values, and new cells what the field refines to.

    Cells that are added where nothing was, which are marked in the second result, take other channels from
    the coarser averages there.
    """
    is_fresh = np.zeros(tree.n_cells, np.bool_)
    is_fresh[0] = texture.tree.n_leaves == 0
    is_added = np.zeros(tree.n_cells, np.bool_)
    if tree is texture.tree:
        return texture, is_fresh
    channels = {
        name: [
            edited.carried(channel.values),
            channel.split_values[edited.split_rows],
            np.zeros((tree.kept.cells.size, channel.format.components), channel.format.dtype),
        ]
        for name, channel in texture.channels.items()
    }
    flags, areas = tree.arrays.flags.copy(), tree.arrays.areas.copy()
    old_kept = edited.old[tree.kept.cells]
    at = np.searchsorted(texture.tree.kept.cells, np.maximum(old_kept, 0).astype(np.uint32))
    at = np.minimum(at, max(texture.tree.kept.cells.size - 1, 0))
    was_kept = np.zeros(old_kept.size, np.bool_)
    if texture.tree.kept.cells.size:
        was_kept = (old_kept >= 0) & (texture.tree.kept.cells[at] == old_kept)
    for name, channel in texture.channels.items():
        kept_values = channels[name][2]
        kept_values[was_kept] = channel.kept_values[at[was_kept]]
        was_leaf = ~was_kept & (old_kept >= 0)
        kept_values[was_leaf] = channel.values[old_kept[was_leaf]]
    for level, (codes, _) in enumerate(tree.walk()):
        first = int(tree.arrays.level_cells[level])
        new = np.flatnonzero(edited.old[first : first + codes.size] < 0)
        if not new.size:
            continue
        where = locate(texture.tree, codes[new], level)
        below = new[where.is_leaf]
        if below.size:
            found = refined_values(texture.tree, texture.channels, codes[below], level)
            kept_at = np.searchsorted(tree.kept.cells, (first + below).astype(np.uint32))
            kept_at = np.minimum(kept_at, tree.kept.cells.size - 1)
            keeps = tree.kept.cells[kept_at] == first + below
            for name, channel in texture.channels.items():
                stored = encode(found[name], channel.format.dtype, channel.format.space)
                channels[name][0][first + below] = stored
                channels[name][2][kept_at[keeps]] = stored[keeps]
            if met is not None and level < len(met.codes) and met.codes[level].size:
                is_met = among(codes[below], met.codes[level])
                source = int(met.tree.arrays.level_cells[level]) + np.searchsorted(
                    met.codes[level], codes[below[is_met]]
                )
                flags[first + below[is_met]] |= met.tree.arrays.flags[source] & np.uint8(FACING_FLAGS)
                areas[first + below[is_met]] = met.tree.arrays.areas[source]
            if level < len(paint):  # skirts face as the paint beside them
                own = paint[level]
                bare = below[flags[first + below] & FACING_FLAGS == 0]
                bare = bare[among(codes[bare], own.codes)]
                flags[first + bare] |= own.facings[np.searchsorted(own.codes, codes[bare])]
                areas[first + bare] = _SKIRT
        fresh = new[~where.is_leaf]
        if fresh.size:
            inside = locate(layer.tree, codes[fresh], level)
            is_own = inside.levels == level
            own_cells, cells = first + fresh[is_own], inside.cells[is_own]
            is_added[own_cells] = True
            flags[own_cells] |= layer.tree.arrays.flags[cells] & np.uint8(FACING_FLAGS)
            areas[own_cells] = layer.tree.arrays.areas[cells]
            bare = fresh[~is_own]  # skirts, and nodes above them
            areas[first + bare] = _SKIRT
            is_fresh[first + fresh] = True
            if level < len(paint):
                bare = bare[among(codes[bare], paint[level].codes)]
                at = np.searchsorted(paint[level].codes, codes[bare])
                flags[first + bare] |= paint[level].facings[at]
                is_fresh[first + bare] = False
            if texture.tree.n_leaves:
                centres = (decode_cells(codes[fresh]) + 0.5) / 2**level
                points = texture.placement.to_rest(centres)
                around = texture.sample(points, list(texture.channels), normalize=False)
                refined = refined_values(texture.tree, texture.channels, codes[bare], level)
                is_bare = np.isin(fresh, bare)
                for name, channel in texture.channels.items():
                    around[name][is_bare] = refined[name]
                    stored = encode(around[name], channel.format.dtype, channel.format.space)
                    channels[name][0][first + fresh] = stored
    if is_added.any():
        add_up_areas(tree, is_added, areas)
    tree = tree.with_cell_data(flags, areas, tree.split, tree.kept)
    made = {name: Channel(texture.channels[name].format, *arrays) for name, arrays in channels.items()}
    whole = OctreeTexture(tree, made, texture.placement, texture.bounds, texture.metadata)
    return refaced(_split_below(whole, texture, edited)), is_fresh


def _split_below(made: OctreeTexture, texture: OctreeTexture, edited: Edited) -> OctreeTexture:
    """Split new cells below leaves that are split: each facing differs from the cell as it did there."""
    tree = made.tree
    new = np.flatnonzero((edited.old < 0) & (tree.arrays.flags & FACING_FLAGS != 0))
    if not texture.tree.split.cells.size or not new.size:
        return made
    sources = sources_of(tree, new, texture.tree)
    below = texture.tree.arrays.flags[sources] & SPLIT != 0
    is_leaf = np.zeros(texture.tree.n_cells, np.bool_)
    is_leaf[texture.tree.leaf_cells()] = True
    below &= is_leaf[sources]
    cells, sources = new[below], sources[below]
    if not cells.size:
        return made
    facings = tree.arrays.flags[cells] & np.uint8(FACING_FLAGS)
    owners = np.repeat(np.arange(cells.size), np.bitwise_count(facings))
    bits = bits_of(facings)
    rows = {}
    differs = np.zeros(len(owners), np.bool_)
    for name, channel in texture.channels.items():
        form = channel.format
        own = decode(made.channels[name].values[cells[owners]], form.space)
        whole = decode(channel.values[sources[owners]], form.space)
        facing = rows_facing(texture, channel, sources[owners], bits)
        rows[name] = encode(own + facing - whole, form.dtype, form.space)
        apart = in_codes(rows[name], form) - in_codes(made.channels[name].values[cells[owners]], form)
        differs |= (np.abs(apart) > MOST).any(axis=1)
    is_split = np.zeros(cells.size, np.bool_)
    is_split[owners[differs]] = True
    rows = {name: own[is_split[owners]] for name, own in rows.items()}
    return with_split(made, cells[is_split], facings[is_split], rows) if is_split.any() else made


def sources_of(tree: Octree, nodes: Int64s, other: Octree) -> Int64s:
    """Return the cells of another tree that hold nodes of a tree, or the deepest that do."""
    found = np.zeros(nodes.size, np.int64)
    for level, (codes, _) in enumerate(tree.walk()):
        first = int(tree.arrays.level_cells[level])
        here = (nodes >= first) & (nodes < first + codes.size)
        if here.any():
            found[here] = locate(other, codes[nodes[here] - first], level).cells
    return found
