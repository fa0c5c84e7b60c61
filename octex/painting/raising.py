"""A texture brought to where paint is finer (paper 4.1, steps 4 and 7, and 4.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from itertools import islice
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Int64s, Uint8s
from octex.channels import ALPHA, encode
from octex.conversion.levels import assemble, cell_levels
from octex.conversion.pieces import Blocks
from octex.editing.averages import with_summed_areas
from octex.editing.carried import carried
from octex.editing.draft import coarsest_near, coarsest_of
from octex.editing.nodes import all_children, nodes_at
from octex.editing.refined import Below, refined_below, with_rows
from octex.editing.split import refaced
from octex.errors import ModelError, own_making
from octex.painting.cells import (
    Paint,
    among_at,
    beside_larger,
    facings_within,
    joined,
    leave_bare,
    skirt_of,
    skirt_on_nothing,
    skirt_paint,
    some,
)
from octex.painting.flat import Flat
from octex.painting.kept import bare_leaves
from octex.painting.picture import Blend
from octex.painting.surface import Ground
from octex.parallel import Progress
from octex.texture import OctreeTexture
from octex.tree.areas import SKIRT
from octex.tree.beside import are_beside, boundary, is_within, near, with_boundary
from octex.tree.edit import (
    Edited,
    Located,
    among,
    locate,
    raised,
    rebuilt,
    unchanged,
    with_all_above,
)
from octex.tree.layout import FACING_FLAGS, KEPT
from octex.tree.morton import decode_cells
from octex.tree.octree import Octree, distinct

#: Paint of this coverage or more hides what is below: less than half a step of 8 bits shows through.
_HIDING = 1.0 - 1.0 / 512.0


class Met(NamedTuple):
    """The cells of a surface near paint."""

    tree: Octree
    codes: list[Int64s]  # by level


class Raised(NamedTuple):
    """A texture raised to paint."""

    texture: OctreeTexture
    old: Int64s  # (cells,)   each cell's number in the texture as it was; −1: it was not there
    is_fresh: Bools  # (cells,)   where the texture had nothing
    paint: list[Paint]  # with skirts
    is_skirt: Bools  # (cells,)   leaves that no surface is in
    added: list[Int64s]  # cells of the layer where the texture had nothing, by level


def raise_texture(
    texture: OctreeTexture,
    whole: OctreeTexture,
    layer: OctreeTexture,
    paint: list[Paint],
    ground: Ground,
    executor: Executor,
    progress: Progress,
    *,
    target: str,
    blend: Blend,
    coarsest: int | None = None,
) -> Raised:
    """Bring a texture's tree to where paint, or the boundary around it, is finer; its field does not move.

    ``whole`` is the texture that ``texture`` is a draft of, or itself; ``target`` is the channel to paint.

    Leaves above become nodes that keep their coefficients. Below them stand the cells that the surface meets,
    with what the field refines to; what it does not meet is culled. Where the texture has nothing, the
    layer's cells are added, without values; to erase, the paint there is dropped.

    Paint below what was a leaf gets a skirt: cells off the surface beside it, which would else be refined
    from the coefficients kept, and show through. Leaves that have nothing but paint around them, all of which
    hides what was there, keep none: they need no skirt. ``coarsest`` is the level of the largest leaf or kept
    node near paint, if that is known.

    A skirt where nothing was counts for more than what the field refines to there, in every channel. So there
    is none in textures of channels that are not painted: their field would move.

    All cells of the paint that is returned are cells of the texture, and none lies in another.
    """
    is_empty = texture.tree.n_leaves == 0  # its root stands for nothing
    painted = {target, ALPHA.name} if blend == "over" else {target}
    is_all_painted = painted >= texture.channels.keys()
    least = {"over": _HIDING, "erase": _HIDING, "replace": 0.0}
    hiding = least.get(blend, np.inf) if is_all_painted else np.inf
    if blend == "erase":
        paint = [] if is_empty else [_on(texture.tree, each, level) for level, each in enumerate(paint)]
    is_skirt = _skirts(texture, paint, ground, executor, progress)
    edited, paint, met = _raised(
        texture, whole.tree, is_skirt, paint, ground, is_all_painted, hiding, coarsest, executor, progress
    )  # fmt: skip
    if is_empty:
        edited = edited._replace(old=np.full_like(edited.old, -1))
    with own_making():
        made, is_fresh, added = _carried(texture, whole, edited, edited.tree, met, layer, paint, executor)
    is_skirt = edited.carried(is_skirt) | (made.tree.arrays.areas == SKIRT)
    return Raised(made, edited.old, is_fresh, paint, is_skirt, added)


def _skirts(
    texture: OctreeTexture, paint: Sequence[Paint], ground: Ground, executor: Executor, progress: Progress
) -> Bools:
    """Say which leaves (cells,) no surface is in: skirts, and, near paint, cells that ``resize`` has made.

    Those are in nodes of more than four cells, of which all leaves are alike. Near is what is in or beside
    nodes that paint is in and that keep a coefficient; see `kept.on_kept`.
    """
    tree = texture.tree
    is_skirt: Bools = tree.arrays.areas == SKIRT
    if not tree.kept.cells.size:
        return is_skirt
    codes = np.empty(0, np.int64)
    doubted: list[tuple[int, Int64s]] = []
    painted = with_all_above([each.codes for each in paint])
    walk = islice(enumerate(tree.walk()), 1, None)
    for (deeper, (below, is_node)), above in zip(walk, painted, strict=False):
        where = locate(tree, above, deeper - 1)
        is_kept = (where.levels == deeper - 1) & (tree.arrays.flags[where.cells] & KEPT != 0)
        codes = distinct(np.concatenate([codes, with_boundary(above[is_kept], deeper - 1)]))
        where = locate(tree, codes, deeper - 1)
        children, starts = all_children(tree, where.nodes[(where.levels == deeper - 1) & ~where.is_leaf])
        if not children.size:
            codes = codes[:0]
            continue
        looks = tree.arrays.areas[children].astype(np.int64) << 8 | tree.arrays.flags[children] & FACING_FLAGS
        counts = np.diff(starts, append=children.size)
        own = children - tree.arrays.level_cells[deeper]
        least, most = np.where(is_node[own], 1 << 16, looks), np.where(is_node[own], -1, looks)
        is_filled = np.minimum.reduceat(least, starts) == np.maximum.reduceat(most, starts)
        is_filled = np.repeat(is_filled & (counts > 4), counts) & ~is_node[own] & ~is_skirt[children]
        if is_filled.any():
            doubted.append((deeper, below[own[is_filled]]))
        codes = below[own]
    if doubted:
        met = _met_cells(ground, texture, doubted, doubted[-1][0], executor, progress)
        for level, own in doubted:
            off = own[~among(own, met.codes[level])]
            is_skirt[locate(tree, off, level).cells] = True
    return is_skirt


def _on(tree: Octree, paint: Paint, level: int) -> Paint:
    """Return the paint that lies on cells of a tree."""
    where = locate(tree, paint.codes, level)
    return some(paint, (where.levels == level) | where.is_leaf)


def _raised(
    texture: OctreeTexture,
    whole: Octree,
    is_skirt: Bools,
    paint: list[Paint],
    ground: Ground,
    is_all_painted: bool,
    hiding: float,
    coarsest: int | None,
    executor: Executor,
    progress: Progress,
) -> tuple[Edited, list[Paint], Met | None]:
    """Raise the tree; return also the paint with skirts, and the cells met below what is raised."""
    tree = texture.tree
    none = np.empty(0, np.int64)
    if paint and not tree.n_leaves:
        depth = max((level for level, each in enumerate(paint) if each.codes.size), default=0)
        paint = paint[: depth + 1]
        return rebuilt(tree, [each.codes for each in paint]), paint, None
    shallowest = coarsest_of(whole)
    added: list[Int64s] = []
    below: list[Int64s] = []
    virtual: list[Int64s] = []  # beside paint: refined from what is above
    rings: list[Int64s] = []  # beside paint: stored
    absent: list[Int64s] = []  # beside paint below leaves: where nothing is
    tops: list[tuple[int, Int64s]] = []
    for level, each in enumerate(paint):
        where = locate(tree, each.codes, level)
        is_missing = where.levels < level
        below.append(each.codes[is_missing & where.is_leaf])
        added.append(each.codes[is_missing & ~where.is_leaf])
        tops += _above(below[-1], where.of(is_missing & where.is_leaf), level)
        virtual.append(none)
        rings.append(none)
        absent.append(none)
        if each.codes.size and shallowest < level:
            around = boundary(each.codes, level)
            where = locate(tree, around, level)
            flags = tree.arrays.flags[where.cells]
            is_old = where.is_leaf & is_skirt[where.cells]  # see kept.with_old_skirts
            is_refined = (where.levels < level) & (where.is_leaf | (flags & KEPT != 0)) & ~is_old
            virtual[-1] = around[is_refined]
            rings[-1] = around[(where.levels == level) & ~is_old]
            if is_all_painted:
                is_absent = (where.levels < level - 1) & ~where.is_leaf & (flags & KEPT == 0)
                absent[-1] = around[is_absent & near(around, below[-1], level)]
            is_below = is_refined & where.is_leaf
            tops += _above(around[is_below], where.of(is_below), level)
    if not tops and not any(codes.size for codes in (*added, *virtual)):
        return unchanged(tree), paint, None
    depth = max((level for level, each in enumerate(paint) if each.codes.size), default=0)
    met = _met_cells(ground, texture, tops, depth, executor, progress)
    progress("merge", 0, 1)
    split = [
        distinct(np.concatenate([none, *(own for at, own in tops if at == level)]))
        for level in range(max(tree.max_depth, depth) + 1)
    ]
    # New cells of paint, and what is above them, count as met: whatever the surface says, no skirt holds any.
    new = with_all_above([np.concatenate([below[level], added[level]]) for level in range(depth + 1)])
    painted = [each.codes for each in paint]
    above = with_all_above(painted)
    has_absent = any(codes.size for codes in absent)
    hides = bool(tops) and any((each.coverage >= hiding).any() for each in paint)
    unraised, bare = _bare(tree, is_skirt, paint, above, split, met) if has_absent or hides else ([], [])
    first = next((level for level, codes in enumerate(painted) if codes.size), 0)
    if coarsest is None:
        coarsest = coarsest_near(tree, painted, first) if has_absent or hides else 0
    freed = _freed(tree, paint, split, bare, coarsest, hiding) if hides else []
    wanted: list[Int64s] = []
    skirts: list[Int64s] = []  # none lies in another
    with_skirts: list[Paint] = []
    for level, each in enumerate(paint[: depth + 1]):
        if not each.codes.size:
            with_skirts.append(each)
            skirts.append(none)
            wanted.append(none)
            continue
        surface_cells = distinct(np.concatenate([met.codes[level], new[level]]))
        is_met = among(virtual[level], surface_cells)
        raised_ring, outer = virtual[level][is_met], virtual[level][~is_met]
        outer = outer[~is_within(outer, freed, level)]
        ring = np.sort(np.concatenate([raised_ring, rings[level]]), kind="stable")
        if (outer.size or absent[level].size) and level <= tree.max_depth:
            surface_cells = distinct(np.concatenate([surface_cells, _facing_cells(tree, is_skirt, level)]))
        skirt = skirt_of(outer, painted, ring, surface_cells, level)
        extra = [none]
        here = absent[level][_is_beside_old(absent[level], level, above, bare, coarsest)]
        roots = np.maximum(locate(tree, here, level).levels + 1, coarsest)
        for top in distinct(roots).tolist():
            own = here[roots == top]
            extra.append(skirt_on_nothing(own, painted, ring, surface_cells, unraised[:level], level, top))
        skirt = np.sort(np.concatenate([skirt, *extra]), kind="stable")
        skirt = skirt[~is_within(skirt, skirts, level) & ~among(skirt, new[level])]
        where = locate(tree, skirt, level)
        # What the surface meets in leaves beside kept nodes that are not raised is not known: they might not
        # stay as they are.
        is_below_kept = (where.levels < level) & (tree.arrays.flags[where.cells] & KEPT != 0)
        is_below_kept[is_below_kept] = beside_larger(skirt[is_below_kept], tree, split, level)
        skirt, where = skirt[~is_below_kept], where.of(~is_below_kept)
        skirts.append(skirt)
        is_free = ~is_within(skirt, painted, level)  # others are painted with the larger cells around them
        is_new = where.levels < level
        with_skirts.append(joined(each, skirt_paint(skirt[is_free], level, executor, each)))
        added[level] = np.sort(
            np.concatenate([added[level], skirt[is_free & is_new & ~where.is_leaf]]), kind="stable"
        )
        wanted.append(distinct(np.concatenate([below[level], raised_ring, skirt[is_new & where.is_leaf]])))
    if not any(codes.size for codes in (*wanted, *added)):
        return unchanged(tree), with_skirts, met
    kinds = met.codes, new, with_all_above(skirts)
    stored = [distinct(np.concatenate(each)) for each in zip(*kinds, strict=True)]
    with own_making():
        return raised(tree, wanted, stored, added, freed), with_skirts, met


def _bare(
    tree: Octree,
    is_skirt: Bools,
    paint: Sequence[Paint],
    above: Sequence[Int64s],
    tops: Sequence[Int64s],
    met: Met,
) -> tuple[list[Int64s], list[Int64s]]:
    """Return where the surface is not painted, by level: leaves that are not raised, and all there will be.

    ``above`` are painted cells and all above them, ``tops`` the leaves that are raised.
    """
    painted = [each.codes for each in paint]
    unraised = [own[~among(own, tops[level])] for level, own in enumerate(bare_leaves(tree, paint, is_skirt))]
    bare = [*unraised, *[np.empty(0, np.int64)] * (len(met.codes) - len(unraised))]
    for level, codes in enumerate(met.codes):
        inside = codes[is_within(codes >> 3, tops[:level], level - 1)] if level else codes[:0]
        is_bare = ~among(inside, above[level]) & ~is_within(inside, painted, level)
        there = np.flatnonzero(among(inside, painted[level]))
        at = np.searchsorted(codes, inside[there]) + int(met.tree.arrays.level_cells[level])
        own = paint[level].flags[np.searchsorted(painted[level], inside[there])]
        is_bare[there] = leave_bare(met.tree.arrays.flags[at], own)
        bare[level] = distinct(np.concatenate([bare[level], inside[is_bare]]))
    return unraised, bare


def _freed(
    tree: Octree,
    paint: Sequence[Paint],
    tops: Sequence[Int64s],
    bare: Sequence[Int64s],
    coarsest: int,
    hiding: float,
) -> list[Int64s]:
    """Return those of the leaves that are raised, ``tops``, that need keep nothing, by level.

    Two of their own size around them there is no ``bare`` surface and no paint through which something shows,
    so that no cell off the surface below them is refined from what was there. Nor is there around any cell
    above them that leaves or kept nodes of its size are beside; these are of level ``coarsest`` or deeper.
    """
    none = np.empty(0, np.int64)
    shown = [[none, *bare[level : level + 1]] for level in range(len(tops))]
    for level, each in enumerate(paint[: len(tops)]):
        shown[level].append(each.codes[each.coverage < hiding])
    seen = [distinct(np.concatenate(own)) for own in shown]
    held, freed = none, []
    for level, codes in enumerate(with_all_above(tops)):
        is_held = among(codes >> 3, held)
        if level >= coarsest and codes.size:
            around = with_boundary(codes, level)
            where = locate(tree, around, level)
            has_own = where.is_leaf | (tree.arrays.flags[where.cells] & KEPT != 0)
            own = around[(where.levels == level) & has_own]
            around = around[are_beside(around, seen, level)]
            is_held |= near(codes, own, level) & near(codes, around, level)
        held = codes[is_held]
        freed.append(tops[level][~among(tops[level], held)])
    return freed


def _is_beside_old(
    codes: Int64s, level: int, above: Sequence[Int64s], bare: Sequence[Int64s], coarsest: int
) -> Bools:
    """Say which cells (n,) of a level are in or beside nodes that paint is in and whose coefficient stays.

    See ``kept.on_kept``: unpainted surface is in or beside them. They are of the coarsest level near paint.
    """
    if not codes.size:
        return np.zeros(0, np.bool_)
    cells = codes >> 3 * (level - coarsest)
    around = with_boundary(distinct(cells), coarsest)
    around = around[among(around, above[coarsest])]
    return near(cells, around[are_beside(around, bare, coarsest)], coarsest)


def _facing_cells(tree: Octree, is_skirt: Bools, level: int) -> Int64s:
    """Return the Morton codes of a level's cells that a surface is in."""
    first, end = tree.arrays.level_cells[level : level + 2]
    codes: Int64s = tree.level_codes(level)[~is_skirt[first:end]]
    return codes


def _above(codes: Int64s, where: Located, level: int) -> list[tuple[int, Int64s]]:
    """Return the leaves above cells of a level, as levels and codes."""
    return [
        (top, distinct(codes[where.levels == top] >> 3 * (level - top)))
        for top in np.flatnonzero(np.bincount(where.levels)).tolist()
    ]


def _met_cells(
    ground: Ground,
    texture: OctreeTexture,
    tops: Sequence[tuple[int, Int64s]],
    depth: int,
    executor: Executor,
    progress: Progress,
) -> Met:
    """Find the cells down to ``depth`` that the surface meets in some cells, given by level."""
    chosen = ground.near(texture.placement).touching(tops) if tops else np.empty(0, np.int32)
    nothing = Met(Octree.from_leaves(np.empty(0, np.int64), 0), [np.empty(0, np.int64)] * (depth + 1))
    if not chosen.size:
        return nothing
    part = ground.surface.part(chosen, Flat())
    channels = part.source.channels
    try:
        filled = cell_levels(
            part, channels, texture.placement, depth, executor, progress,
            has_samples=False, reached=partial(_are_near, tops),
        )  # fmt: skip
    except ModelError:  # no triangle there has an area
        return nothing
    tree, _ = assemble(channels, filled)
    return Met(tree, [codes for codes, _ in tree.walk()])


def _are_near(cells: Sequence[tuple[int, Int64s]], blocks: Blocks, level: int) -> Bools:
    """Say which blocks of a level meet cells, given by level, or cells beside these."""
    found = np.zeros(blocks.codes.size, np.bool_)
    for at, codes in cells:
        found |= among_at(blocks.codes, level, with_boundary(codes, at), at)
    return found


def _carried(
    texture: OctreeTexture,
    whole: OctreeTexture,
    edited: Edited,
    tree: Octree,
    met: Met | None,
    layer: OctreeTexture,
    paint: Sequence[Paint],
    executor: Executor,
) -> tuple[OctreeTexture, Bools, list[Int64s]]:
    """Give an edited tree the texture's values, and new cells what the field refines to.

    Cells that are added where nothing was take other channels from the coarser averages there. They are
    listed by level in the third result, and marked in the second with new nodes above them.
    """
    is_fresh = np.zeros(tree.n_cells, np.bool_)
    if tree is texture.tree:
        return texture, is_fresh, []
    values = {name: edited.carried(channel.values) for name, channel in texture.channels.items()}
    flags, areas = tree.arrays.flags.copy(), tree.arrays.areas.copy()
    rows: list[tuple[Int64s, Below]] = []
    added: list[Int64s] = []
    found: list[tuple[Int64s, Mapping[str, Float32s]]] = []
    looked_up = [(np.empty(0, np.int64), np.empty((0, 3)))]
    for level, (codes, is_node) in enumerate(tree.walk()):
        first = int(tree.arrays.level_cells[level])
        new = np.flatnonzero(edited.old[first : first + codes.size] < 0)
        cells, new_codes = first + new, codes[new]
        added.append(new_codes[:0])
        if not new.size:
            continue
        where, inside = locate(texture.tree, new_codes, level), locate(layer.tree, new_codes, level)
        is_met = np.zeros(new.size, np.bool_)
        if met is not None and level < len(met.codes) and met.codes[level].size:
            is_met = where.is_leaf & among(new_codes, met.codes[level])
            at = np.searchsorted(met.codes[level], new_codes[is_met])
            _face(flags, areas, cells[is_met], met.tree, at + int(met.tree.arrays.level_cells[level]))
        is_painted = (inside.levels == level) & ~is_met
        _face(flags, areas, cells[is_painted], layer.tree, inside.cells[is_painted])
        is_bare = ~is_met & ~is_painted  # skirts, which face as the paint beside them, and nodes above them
        flags[cells[is_bare]] |= facings_within(new_codes[is_bare], paint, level)
        areas[cells[is_bare]] = SKIRT
        is_own = is_painted & ~where.is_leaf
        added[-1] = new_codes[is_own]
        is_fresh[cells[~where.is_leaf & (is_own | is_node[new])]] = True
        is_kept = texture.tree.arrays.flags[where.cells] & KEPT != 0
        is_refined = where.is_leaf | is_kept | is_bare & ~is_node[new]
        facings = np.where(where.is_leaf, flags[cells] & np.uint8(FACING_FLAGS), np.uint8(0))
        below = refined_below(texture, new_codes[is_refined], level, facings[is_refined], executor)
        rows.append((cells[is_refined], below))
        found.append((cells[is_refined], below.values))
        is_other = ~is_refined & ~is_node[new]  # nodes are averaged
        looked_up.append((cells[is_other], (decode_cells(new_codes[is_other]) + 0.5) / 2**level))
    others, centres = (np.concatenate(column) for column in zip(*looked_up, strict=True))
    if texture.tree.n_leaves and others.size:
        points = texture.placement.to_rest(centres)
        found.append((others, whole.sample(points, list(texture.channels), normalize=False)))
    for name, channel in texture.channels.items():
        for chosen, own in found:
            values[name][chosen] = encode(own[name], channel.format.dtype, channel.format.space)
    channels = carried(texture, edited, values)
    tree = tree.with_cell_data(flags, areas, tree.split, tree.kept)
    made = refaced(with_rows(texture.with_cells(tree, channels), rows))
    if any(codes.size for codes in added):
        nodes = nodes_at(made.tree, [distinct(codes >> 3) for codes in with_all_above(added)[1:]])
        tree = with_summed_areas(made.tree, nodes)
        made = made.with_cells(tree, made.channels)
    return made, is_fresh, added


def _face(flags: Uint8s, areas: Uint8s, cells: Int64s, tree: Octree, sources: Int64s) -> None:
    """Give cells the facings and areas of cells of another tree, in place."""
    flags[cells] |= tree.arrays.flags[sources] & np.uint8(FACING_FLAGS)
    areas[cells] = tree.arrays.areas[sources]
