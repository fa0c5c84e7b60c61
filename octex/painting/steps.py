"""The steps of painting, named and numbered as in the paper (4.1).

1  rasterize_surface   read the source of paint in the cells of the surface; `layer_from` makes a tree of them
2  refine_paint        to the leaves of the texture
3  form_boundary       around the paint: neighbours, and skirts off the surface
4  raise_texture       to the leaves of the paint
5  merge_paint         blend each leaf once, and average the nodes above
6  delete_paint
7  cull_cells          that the surface does not meet

`merge_draft` takes steps 2 to 7 in a draft, the part of the texture that a layer touches. There, cells are
culled before they are made, and the paint is refined once the texture is raised.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s, Uint8s
from octex.channels import ALPHA, ChannelFormat, alpha_of, encode
from octex.conversion.adapt import adapted
from octex.conversion.levels import CellLevels, assemble, cell_levels
from octex.editing.draft import coarsest_of
from octex.editing.refined import Below, refined_below, refined_values, with_rows
from octex.editing.runs import carried
from octex.editing.split import refaced
from octex.errors import ModelError
from octex.painting.blend import (
    Kind,
    Merge,
    Merged,
    Raised,
    averaged,
    averaged_with,
    blend_rows,
    covers,
    facings_of_paint,
    may_differ,
    no_parts,
    nodes_above,
    own_making,
    read,
    with_areas_above,
    with_split_cells,
    writable,
)
from octex.painting.boundary import (
    Finer,
    are_next_to_larger,
    are_next_to_old,
    bare_leaves,
    bare_surface,
    doubted_leaves,
    find_finer,
    free_leaves,
    on_kept,
    skirt_of,
    skirt_on_nothing,
    skirt_paint,
    with_old_skirts,
)
from octex.painting.layer import (
    CELLS,
    Depths,
    Paint,
    PaintSource,
    SurfaceCells,
    blocks_meeting,
    empty_texture,
    facings_within,
    is_plain,
    joined,
    paint_on_leaves,
    painted_channel,
    with_bare_facings,
)
from octex.painting.surface import Job
from octex.parallel import ordered_map, sharing
from octex.texture import OctreeTexture
from octex.tree.areas import SKIRT
from octex.tree.edit import Edited, among, indices_in, locate, raised, rebuilt, unchanged, with_all_above
from octex.tree.layout import FACING_FLAGS, KEPT, SPLIT
from octex.tree.morton import decode_cells
from octex.tree.neighbours import is_within, with_boundary
from octex.tree.octree import Octree, distinct
from octex.tree.placement import Placement
from octex.tree.split import rows_of

_NONE = np.empty(0, np.int64)
#: Cells that are blended in one pass.
_BLOCK = 1 << 16


class Boundary(NamedTuple):
    """Paint with its boundary, and the arguments of `raised`; lists are by level."""

    paint: list[Paint]  # includes the boundary's
    wanted: list[Int64s]
    stored: list[Int64s]
    added: list[Int64s]
    freed: list[Int64s]


class Raster(NamedTuple):
    """The averages of paint in cells, before a tree is made of them."""

    channels: tuple[ChannelFormat, ...]
    placement: Placement
    bounds: Float64s
    cells: CellLevels | None  # None: no paint meets the surface


def rasterize_surface(
    job: Job, source: PaintSource, placement: Placement, depths: Depths, *, fit: bool, cells: float = CELLS
) -> Raster:
    """1. Rasterize the surface: read the source in all cells, so that `layer_from` needs it no more.

    Leaves have ``cells`` per width of the paint's detail, within ``depths``, and samples to ``fit`` their
    values to. Surface without paint has no cells.
    """
    surface, depth = job.surface.surface, depths.deepest
    channels = tuple(source.channels)
    touched = source.touched()
    if not touched.size:
        return Raster(channels, placement, surface.bounds, None)
    root = job.surface.grid(placement).around(touched, depth)
    filled = cell_levels(
        surface, source, channels, placement, depth, job.executor, job.progress,
        has_samples=fit and not is_plain(source),
        wanted=None if depths.is_even else partial(_wanted, source, placement.size, cells, depths),
        root=root, reached=partial(source.reaches, placement=placement, rest=surface.rest),
    )  # fmt: skip
    return Raster(channels, placement, surface.bounds, filled if filled.n_leaves else None)


def layer_from(job: Job, raster: Raster) -> OctreeTexture:
    """Return the paint octree of a raster: a texture of the painted channel and its coverage."""
    channels, placement, bounds, filled = raster
    if filled is None:
        return empty_texture(channels, placement, bounds)
    covered = assemble(filled)
    del raster, filled  # as large as what follows
    tree, values = adapted(covered, fit=True, max_error=None, executor=job.executor, progress=job.progress)
    return with_bare_facings(refaced(OctreeTexture(tree, values, placement, bounds)))


def _wanted(
    source: PaintSource,
    size: float,
    cells: float,
    depths: Depths,
    triangles: Int32s,
    barycentric: Float64s,
    _widths: Float32s,
) -> Float64s:
    return depths.levels(source.widths(triangles, barycentric), size, cells)


def merge_draft(task: Merge, draft: OctreeTexture, paint: list[Paint]) -> Merged | None:
    """Merge paint into a draft of the texture; return None for none."""
    tree = draft.tree
    if alpha_of(task.target) is None:  # coverage alone adds no cells
        if not tree.n_leaves:
            return None
        places = [locate(tree, each.codes, level) for level, each in enumerate(paint)]
        paint = [
            each.of((where.levels == level) | where.is_leaf)
            for level, (each, where) in enumerate(zip(paint, places, strict=True))
        ]
    if not any(each.codes.size for each in paint):
        return None
    surface_cells: SurfaceCells | None = None
    if tree.n_leaves:
        is_skirt = tree.arrays.areas == SKIRT  # leaves without surface
        doubted = doubted_leaves(tree, paint, is_skirt) if tree.kept.cells.size else []
        if doubted:
            met = cull_cells(task, doubted, doubted[-1][0])
            for level, codes in doubted:
                is_skirt[locate(tree, codes[~among(codes, met.codes[level])], level).cells] = True
        edited = unchanged(tree)
        shallowest = coarsest_of(task.texture.tree)
        finer = find_finer(tree, paint, is_skirt, shallowest, task.is_all_painted)
        if finer.leaves or any(codes.size for codes in (*finer.added, *finer.refined)):
            surface_cells = cull_cells(task, finer.leaves, _deepest(paint))
            task.job.progress("merge", 0, 1)
            paint, *levels = form_boundary(task, tree, paint, is_skirt, finer, surface_cells)
            wanted, _, added, _ = levels
            if any(codes.size for codes in (*wanted, *added)):
                with own_making():
                    edited = raised(tree, *levels)
    else:
        is_skirt = np.zeros(tree.n_cells, np.bool_)
        paint = paint[: _deepest(paint) + 1]
        edited = rebuilt(tree, [each.codes for each in paint])
        edited = edited._replace(old=np.full_like(edited.old, -1))  # an empty tree's root is no cell
    with own_making():
        raised_draft = raise_texture(task, draft, edited, surface_cells, paint, is_skirt)
        paint = refine_paint(task, paint, raised_draft.texture.tree)
        return merge_paint(task, draft, raised_draft, paint)


def _deepest(paint: Sequence[Paint]) -> int:
    return max(level for level, each in enumerate(paint) if each.codes.size)


def cull_cells(task: Merge, within: Sequence[tuple[int, Int64s]], depth: int) -> SurfaceCells:
    """7. Cull: return the cells down to ``depth`` that the surface meets within cells, listed by level."""
    job, placement = task.job, task.texture.placement
    none = SurfaceCells(Octree.from_leaves(_NONE, 0), [_NONE] * (depth + 1))
    root = job.surface.grid(placement).touching(within, depth) if within else None
    if root is None or not root.members.size:
        return none
    around = [(level, with_boundary(codes, level)) for level, codes in within]
    try:
        filled = cell_levels(
            job.surface.surface, None, (), placement, depth, job.executor, job.progress,
            has_samples=False, root=root, reached=partial(blocks_meeting, around),
        )  # fmt: skip
    except ModelError:  # no triangle there has an area
        return none
    tree = assemble(filled).tree
    return SurfaceCells(tree, [codes for codes, _ in tree.walk()])


def form_boundary(
    task: Merge, tree: Octree, paint: Sequence[Paint], is_skirt: Bools, finer: Finer, met: SurfaceCells
) -> Boundary:
    """3. Form the boundary around paint: neighbours on the surface, and skirts off the surface.

    Skirts hide the kept coefficients next to paint. Leaves surrounded by opaque paint keep none. New skirts
    would move other channels, so textures with other channels have none.
    """
    depth = _deepest(paint)
    leaves = [
        distinct(np.concatenate([_NONE, *(codes for at, codes in finer.leaves if at == level)]))
        for level in range(max(tree.max_depth, depth) + 1)
    ]
    # New cells of paint and all above them count as met, so that no skirt contains any.
    new = with_all_above(
        [np.concatenate([finer.below[level], finer.added[level]]) for level in range(depth + 1)]
    )
    painted = [each.codes for each in paint]
    above = with_all_above(painted)
    hides = bool(finer.leaves) and any((each.coverage >= task.hiding).any() for each in paint)
    unraised: list[Int64s] = []
    bare: list[Int64s] = []
    if hides or any(codes.size for codes in finer.absent):
        unraised, bare = bare_surface(tree, is_skirt, paint, above, leaves, met)
    coarsest = task.coarsest
    freed = free_leaves(tree, paint, leaves, bare, coarsest, task.hiding) if hides else []
    formed = Boundary([], [], [], [], freed)
    skirts: list[Int64s] = []  # none lies in another one
    for level, each in enumerate(paint[: depth + 1]):
        surface_cells = distinct(np.concatenate([met.codes[level], new[level]]))
        is_met = among(finer.refined[level], surface_cells)
        ring, outer = finer.refined[level][is_met], finer.refined[level][~is_met]
        outer = outer[~is_within(outer, freed, level)]
        whole_ring = np.sort(np.concatenate([ring, finer.stored[level]]), kind="stable")
        if (outer.size or finer.absent[level].size) and level <= tree.max_depth:
            first, end = tree.arrays.level_cells[level : level + 2]
            faced = tree.level_codes(level)[~is_skirt[first:end]]
            surface_cells = distinct(np.concatenate([surface_cells, faced]))
        kinds = [skirt_of(outer, painted, whole_ring, surface_cells, level)]
        absent = finer.absent[level]
        absent = absent[are_next_to_old(absent, level, tree, above, leaves, bare)]
        roots = np.maximum(locate(tree, absent, level).levels + 1, coarsest)
        for top in distinct(roots).tolist():
            around = painted, whole_ring, surface_cells, unraised[:level]
            kinds.append(skirt_on_nothing(absent[roots == top], *around, level, top))
        skirt = np.sort(np.concatenate(kinds), kind="stable")
        skirt = skirt[~is_within(skirt, skirts, level) & ~among(skirt, new[level])]
        where = locate(tree, skirt, level)
        # Which cells the surface meets in unraised leaves next to kept nodes is unknown.
        is_below_kept = (where.levels < level) & (tree.arrays.flags[where.cells] & KEPT != 0)
        is_below_kept[is_below_kept] = are_next_to_larger(skirt[is_below_kept], tree, leaves, level)
        skirt, where = skirt[~is_below_kept], where.of(~is_below_kept)
        skirts.append(skirt)
        is_free = ~is_within(skirt, painted, level)  # the larger cells around the others are painted
        is_new = where.levels < level
        formed.paint.append(joined(each, skirt_paint(skirt[is_free], level, task.job.executor, each)))
        added = [finer.added[level], skirt[is_free & is_new & ~where.is_leaf]]
        formed.added.append(np.sort(np.concatenate(added), kind="stable"))
        wanted = [finer.below[level], ring, skirt[is_new & where.is_leaf]]
        formed.wanted.append(distinct(np.concatenate(wanted)))
    stored = zip(met.codes, new, with_all_above(skirts), strict=True)
    formed.stored.extend(distinct(np.concatenate(each)) for each in stored)
    return formed


def raise_texture(
    task: Merge,
    draft: OctreeTexture,
    edited: Edited,
    met: SurfaceCells | None,
    paint: Sequence[Paint],
    is_skirt: Bools,
) -> Raised:
    """4. Raise the texture where paint is finer: the field's refinement gives the values of new cells.

    Leaves above become nodes that keep their coefficients, so the field does not move.
    """
    tree = edited.tree
    is_fresh = np.zeros(tree.n_cells, np.bool_)
    if tree is draft.tree:
        return Raised(draft, edited.old, is_fresh, is_skirt, [])
    values = {name: edited.carried(channel.values) for name, channel in draft.channels.items()}
    flags, areas = tree.arrays.flags.copy(), tree.arrays.areas.copy()
    rows: list[tuple[Int64s, Below]] = []
    added: list[Int64s] = []
    new_values: list[tuple[Int64s, Mapping[str, Float32s]]] = []
    unpainted = [name for name in draft.channels if name not in (task.target, alpha_of(task.target))]
    shows = _showing(task, draft.tree, edited, paint)
    for level, (codes, is_node) in enumerate(tree.walk()):
        first = int(tree.arrays.level_cells[level])
        new = np.flatnonzero(edited.old[first : first + codes.size] < 0)
        cells, new_codes = first + new, codes[new]
        added.append(_NONE)
        if not new.size:
            continue
        where, inside = locate(draft.tree, new_codes, level), locate(task.layer.tree, new_codes, level)
        is_met = np.zeros(new.size, np.bool_)
        if met is not None and level < len(met.codes) and met.codes[level].size:
            is_met = where.is_leaf & among(new_codes, met.codes[level])
            at = np.searchsorted(met.codes[level], new_codes[is_met])
            _face(flags, areas, cells[is_met], met.tree, at + int(met.tree.arrays.level_cells[level]))
        is_painted = (inside.levels == level) & ~is_met
        _face(flags, areas, cells[is_painted], task.layer.tree, inside.cells[is_painted])
        is_bare = ~is_met & ~is_painted  # skirts, with the facings of the paint next to them, and nodes above
        flags[cells[is_bare]] |= facings_within(new_codes[is_bare], paint, level)
        areas[cells[is_bare]] = SKIRT
        is_added = is_painted & ~where.is_leaf
        added[-1] = new_codes[is_added]
        is_fresh[cells[~where.is_leaf & (is_added | is_node[new])]] = True
        is_kept = draft.tree.arrays.flags[where.cells] & KEPT != 0
        is_refined = where.is_leaf | is_kept | is_bare & ~is_node[new]
        is_other = ~is_refined & ~is_node[new]  # nodes are averaged
        is_refined &= is_node[new] | ~where.is_leaf | shows[where.cells]
        facings = np.where(where.is_leaf, flags[cells] & np.uint8(FACING_FLAGS), np.uint8(0))
        below = refined_below(draft, new_codes[is_refined], level, facings[is_refined], task.job.executor)
        rows.append((cells[is_refined], below))
        new_values.append((cells[is_refined], below.values))
        if unpainted and is_other.any() and draft.tree.n_leaves:
            centres = draft.placement.to_rest((decode_cells(new_codes[is_other]) + 0.5) / 2**level)
            sampled = task.texture.sample(centres, unpainted, normalize=False)
            for name in unpainted:
                if alpha_of(name) is None:
                    sampled[name][:] = 0.0  # other layers have no paint there
            new_values.append((cells[is_other], sampled))
    for name, (form, *_) in draft.channels.items():
        for chosen, by_channel in new_values:
            if name in by_channel:
                values[name][chosen] = encode(by_channel[name], form.dtype, form.space)
    channels = carried(draft, edited, values)
    tree = tree.with_cell_data(flags, areas, tree.split, tree.kept)
    texture = refaced(with_rows(draft.with_cells(tree, channels), rows))
    if any(codes.size for codes in added):
        texture = with_areas_above(texture, added)
    is_skirt = edited.carried(is_skirt) | (texture.tree.arrays.areas == SKIRT)
    return Raised(texture, edited.old, is_fresh, is_skirt, added)


def _showing(task: Merge, tree: Octree, edited: Edited, paint: Sequence[Paint]) -> Bools:
    """Return the leaves of a tree (cells,) that show through paint on the new cells below them."""
    if not (task.is_all_painted and task.blend in ("over", "replace")):
        return np.ones(tree.n_cells, np.bool_)
    shows = np.zeros(tree.n_cells, np.bool_)
    for level, (codes, is_node) in enumerate(edited.tree.walk()):
        first = int(edited.tree.arrays.level_cells[level])
        new = codes[~is_node & (edited.old[first : first + codes.size] < 0)]
        if level < len(paint):
            hides = (paint[level].coverage == 1.0) & (paint[level].flags & SPLIT == 0)
            new = new[~among(new, paint[level].codes[hides])]
        shows[locate(tree, new, level).cells] = True
    return shows


def _face(flags: Uint8s, areas: Uint8s, cells: Int64s, tree: Octree, sources: Int64s) -> None:
    """Copy facings and areas from cells of another tree, in place."""
    flags[cells] |= tree.arrays.flags[sources] & np.uint8(FACING_FLAGS)
    areas[cells] = tree.arrays.areas[sources]


def refine_paint(task: Merge, paint: Sequence[Paint], tree: Octree) -> list[Paint]:
    """2. Refine paint to the leaves of a deeper tree, by the field's refinement.

    The paper does so for translucent paint; here for all, since lookups are faster in trees of even depth.
    """
    none = paint[0].of(slice(0))
    refined = [*paint, *[none] * (tree.max_depth + 1 - len(paint))]
    if all(locate(tree, each.codes, level).is_leaf.all() for level, each in enumerate(paint)):
        return refined
    layer, divided = task.layer, list[Paint]()  # the paint on nodes, by level
    for level, (codes, is_node) in enumerate(tree.walk()):
        is_divided = among(refined[level].codes, codes[is_node])
        divided.append(refined[level].of(is_divided))
        parts, leaves = [refined[level].of(~is_divided)], codes[~is_node]
        for above, coarse in enumerate(divided[:level]):
            if not coarse.codes.size:
                continue
            owners = indices_in(leaves >> 3 * (level - above), coarse.codes)
            below, owners = leaves[owners >= 0], owners[owners >= 0]
            if below.size:
                values = refined_values(layer.tree, layer.channels, below, level)
                coverage = values[ALPHA.name][:, 0] * np.float32(task.opacity)
                columns = values[painted_channel(layer)], coverage, coarse.cells[owners], coarse.flags[owners]
                parts.append(Paint(below, *columns))
        refined[level] = joined(*parts)
    return refined


def merge_paint(task: Merge, draft: OctreeTexture, raised: Raised, paint: list[Paint]) -> Merged:
    """5. Merge the paint: blend each leaf, skirt and kept coefficient under it once; average nodes above."""
    tree, is_skirt, is_fresh, is_new = raised.texture.tree, raised.is_skirt, raised.is_fresh, raised.old < 0
    has_skirts = tree.kept.cells.size or is_skirt.any()
    bare, skirts = bare_leaves(tree, paint, is_skirt) if has_skirts else ([], [])
    paint = with_old_skirts(tree, paint, bare, skirts, task.job.executor)
    painted = [each.codes for each in paint]
    cells, on_leaves = paint_on_leaves(tree, paint)
    above = nodes_above(tree, painted, is_new, draft.tree, task.layer.tree)
    base = with_split_cells(raised.texture, may_differ(tree, cells, on_leaves.flags, above))
    alpha = alpha_of(task.target)
    targets = {name: channel for name, channel in base.channels.items() if name in (task.target, alpha)}
    has_covered = covers(task.blend, task.target) or is_fresh[cells].any()
    names = [name for name in targets if name == task.target or has_covered]
    parts = no_parts(base.tree, names)
    channels = writable(base, base.channels if is_new.any() else averaged_with(base.channels, names))

    def blend(
        kind: Kind,
        rows: Int64s,
        values: Float32s,
        coverage: Float32s,
        fresh: Bools,
        bare: Int64s | None = None,
    ) -> None:
        old = {name: read(channel, kind, rows) for name, channel in targets.items()}
        blend_rows(task, channels, parts, kind, rows, old, values, coverage, fresh, bare)

    def blend_block(begin: int) -> None:
        block = slice(begin, begin + _BLOCK)
        in_block = on_leaves.of(block)
        blend("values", cells[block], in_block.values, in_block.coverage, is_fresh[cells[block]])

    with sharing(task.job.executor) as pool:
        list(ordered_map(pool, blend_block, range(0, cells.size, _BLOCK)))
    kept_rows, values, coverage = on_kept(tree, paint, bare, skirts, task.job.executor)
    if kept_rows.size:
        blend("kept_values", kept_rows, values, coverage, np.zeros(kept_rows.size, np.bool_))
    rows = rows_of(base.tree.split, cells)
    owners = on_leaves.of(np.searchsorted(cells, rows.cells))
    facings = facings_of_paint(task, owners, rows.bits)
    blend("split_values", rows.rows, *facings, is_fresh[rows.cells], rows.cells)
    return averaged(task, draft, raised, base, channels, parts, above, painted)


def delete_paint(merged: Merged) -> OctreeTexture:
    """6. Delete the paint: return the texture without the record of its painted parts."""
    return merged.texture
