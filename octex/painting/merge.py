"""Paint merged into a texture (paper 4.1, steps 2 to 7, and 4.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import ALPHA, ONE, ChannelFormat, decode, encode
from octex.checks import as_choice, as_number
from octex.conversion.facings import MOST, in_codes
from octex.conversion.fill import assemble, fill
from octex.errors import ArgumentError
from octex.field.refined import refined_taps
from octex.painting.averages import add_up_areas, residuals, updated_averages
from octex.painting.flat import Flat
from octex.painting.pictures import BLENDS, Blend
from octex.painting.rasterize import touching
from octex.parallel import Progress, silent, workers
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.texture.channel import Channel
from octex.texture.split import bits_of, refaced, rows_facing, with_split
from octex.tree.edit import Edited, among, locate, raised
from octex.tree.layout import FACING_FLAGS, KEPT, SPLIT
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.octree import Octree, distinct

Int64s = npt.NDArray[np.int64]
Float32s = npt.NDArray[np.float32]
Array = npt.NDArray[Any]

_AROUND = np.array([[x, y, z] for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1) if x or y or z])
#: Cells whose neighbours are listed at once.
_BLOCK = 1 << 16


class Paint(NamedTuple):
    """Paint on cells of one level."""

    codes: Int64s  # (n,)   Morton codes, ascending
    values: Float32s  # (n, components)   decoded
    coverage: Float32s  # (n,)   0 … 1
    cells: Int64s  # (n,)   the cells of the paint octree that say what each facing has
    is_skirt: npt.NDArray[np.bool_]  # (n,)   not on the surface


def paint_of(layer: OctreeTexture, opacity: float) -> tuple[ChannelFormat, list[Paint]]:
    """Return what a layer paints: its channel, and the paint on its leaves, level by level.

    Raises ArgumentError for a texture that is no layer.
    """
    names = [name for name in layer.channels if name != ALPHA.name]
    if len(names) != 1 or ALPHA.name not in layer.channels:
        raise ArgumentError("a layer has one channel, and alpha: what paint covers")
    values, coverage = layer.channels[names[0]], layer.channels[ALPHA.name]
    found = []
    for level, (codes, is_node) in enumerate(layer.tree.walk()):
        cells = np.flatnonzero(~is_node) + int(layer.tree.arrays.level_cells[level])
        part = decode(coverage.values[cells], "data")[:, 0] * np.float32(opacity)
        has_paint = part > 0
        cells = cells[has_paint]
        own = codes[~is_node][has_paint]
        found.append(
            Paint(
                own,
                decode(values.values[cells], values.format.space),
                part[has_paint],
                cells,
                np.zeros(len(own), np.bool_),
            )
        )
    return values.format, found


def refine_paint(paint: Sequence[Paint], layer: OctreeTexture, tree: Octree, opacity: float) -> list[Paint]:
    """Bring paint to the resolution of a tree that is deeper, by the field's refinement (paper 4.1, step 2).

    The paper does so where paint is translucent. Here opaque paint goes down too: a texture of even depth is
    looked up four times as fast as one of many.
    """
    name = next(name for name in layer.channels if name != ALPHA.name)
    found = list(paint)
    walk = list(tree.walk())
    while len(found) < len(walk):
        found.append(_no_paint(layer.channels[name].format.components))
    for level in range(len(walk) - 1):
        codes, is_node = walk[level]
        below = among(found[level].codes, codes[is_node])
        if not below.any():
            continue
        coarse = found[level]
        found[level] = _some(coarse, ~below)
        parents, cells = coarse.codes[below], coarse.cells[below]
        source_codes = parents
        for deeper in range(level + 1, len(walk)):
            codes, is_node = walk[deeper]
            children = codes[among(codes >> 3, parents)]
            if not children.size:
                break
            is_leaf = ~is_node[np.searchsorted(codes, children)]
            leaves, parents = children[is_leaf], children[~is_leaf]
            if leaves.size:
                owners = np.searchsorted(source_codes, leaves >> 3 * (deeper - level))
                values, coverage = _refined_paint(layer, name, leaves, deeper, opacity)
                finer = Paint(leaves, values, coverage, cells[owners], np.zeros(leaves.size, np.bool_))
                found[deeper] = _joined(found[deeper], finer)
    return found


def boundary(paint: Sequence[Paint]) -> list[Int64s]:
    """Return the cells around paint, by level: the boundary layer (paper 4.1, step 3).

    Of each level those beside its own paint, at faces, edges and corners; not the paint itself.
    """
    return [_beside(each.codes, level) for level, each in enumerate(paint)]


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
        edited, paint, met = _raised(texture, layer, paint, surface, pool, progress or silent)
    tree = edited.tree
    paint = refine_paint(paint, layer, tree, opacity)
    base, is_fresh = _carried(texture, edited, tree, met, layer)
    return _blended(base, is_fresh, paint, layer, target, blend, opacity)


class Met(NamedTuple):
    """The cells of a surface near paint."""

    tree: Octree
    codes: list[Int64s]  # by level


def _raised(
    texture: OctreeTexture,
    layer: OctreeTexture,
    paint: list[Paint],
    surface: Surface,
    executor: Executor,
    progress: Progress,
) -> tuple[Edited, list[Paint], Met | None]:
    """Raise a texture's tree to where paint is finer, add what it lacks (step 4), and cull (step 7).

    Returns also the paint, with skirts: beside paint below what was a leaf, cells that no surface meets would
    be refined from the old coefficients and show through the paint.
    """
    tree = texture.tree
    none = np.empty(0, np.int64)
    shallowest = next((level for level, (leaves, _) in enumerate(tree.cells_by_depth()) if leaves), None)
    added, below, around = [], [], []
    tops: list[tuple[int, Int64s]] = []
    for level, each in enumerate(paint):
        where = locate(tree, each.codes, level)
        is_there = where.levels == level
        below.append(each.codes[~is_there & where.is_leaf])
        added.append(each.codes[~is_there & ~where.is_leaf])
        beside = none
        if shallowest is not None and shallowest < level and each.codes.size:
            beside = _beside(each.codes, level)
            where = locate(tree, beside, level)
            keeps = tree.arrays.flags[where.cells] & KEPT != 0
            beside = beside[(where.levels < level) & (where.is_leaf | keeps)]
        around.append(beside)
        for codes in (below[-1], beside):
            where = locate(tree, codes, level)
            for top in np.unique(where.levels[where.is_leaf]).tolist():
                chosen = where.is_leaf & (where.levels == top)
                tops.append((top, distinct(codes[chosen] >> 3 * (level - top))))
    if not tops:
        if not any(codes.size for codes in added):
            everything = np.arange(tree.n_cells)
            split_rows = np.ones(tree.split.areas.size, np.bool_)
            return Edited(tree, everything, split_rows, np.ones(tree.kept.cells.size, np.bool_)), paint, None
        return raised(tree, [], [], added), paint, None
    depth = max(level for level, each in enumerate(paint) if each.codes.size)
    met = _met_cells(surface, texture, tops, depth, executor, progress)
    wanted, extended, skirted = [], [], []
    for level, each in enumerate(paint):
        codes = met.codes[level] if level < len(met.codes) else none
        is_met = among(around[level], codes)
        ring, outer = around[level][is_met], around[level][~is_met]
        skirt = _skirt(outer, each.codes, ring, codes, level)
        skirted.append(skirt)
        wanted.append(distinct(np.concatenate([below[level], ring, skirt])))
        extended.append(_with_skirt(each, skirt, level))
    for level in range(len(paint) - 1, -1, -1):  # what lies above skirts is stored too
        if level + 1 < len(paint):
            skirted[level] = distinct(np.concatenate([skirted[level], skirted[level + 1] >> 3]))
    stored = [
        distinct(np.concatenate([codes, skirt, codes_wanted]))
        for codes, skirt, codes_wanted in zip(
            [*met.codes, *[none] * len(paint)], skirted, wanted, strict=False
        )
    ]
    return raised(tree, wanted, stored, added), extended, met


def _met_cells(
    surface: Surface,
    texture: OctreeTexture,
    tops: Sequence[tuple[int, Int64s]],
    depth: int,
    executor: Executor,
    progress: Progress,
) -> Met:
    """Find the cells down to ``depth`` that the surface meets in some cells, given by level."""
    chosen = touching(surface, tops, texture.placement)
    part = (
        Surface(surface.vertices, surface.triangles[chosen], Flat(), rest=surface.rest, name=surface.name)
        if chosen.size
        else None
    )
    if part is None:
        empty = Octree.from_leaves(np.empty(0, np.int64), 0)
        return Met(empty, [np.empty(0, np.int64)])
    source = part.source
    filled = fill(part, source.channels, texture.placement, depth, executor, progress, has_samples=False)
    tree, _ = assemble(source.channels, filled)
    return Met(tree, [codes for codes, _ in tree.walk()])


def _beside(codes: Int64s, level: int) -> Int64s:
    """Return the cells around some of a level that are not among them, ascending."""
    found = [np.empty(0, np.int64)]
    for begin in range(0, codes.size, _BLOCK):
        cells = (decode_cells(codes[begin : begin + _BLOCK])[:, None] + _AROUND).reshape(-1, 3)
        cells = cells[((cells >= 0) & (cells < 1 << level)).all(axis=1)]
        found.append(distinct(encode_cells(cells)))
    beside = distinct(np.concatenate(found))
    return beside[~among(beside, codes)]


def _skirt(outer: Int64s, painted: Int64s, ring: Int64s, met: Int64s, level: int) -> Int64s:
    """Return those cells beside paint, off the surface, that nothing but paint and its boundary is beside."""
    inner = distinct(np.concatenate([painted, ring]))
    free = np.ones(outer.size, np.bool_)
    for step in _AROUND:
        cells = decode_cells(outer) + step
        inside = ((cells >= 0) & (cells < 1 << level)).all(axis=1)
        codes = encode_cells(np.where(inside[:, None], cells, 0))
        free &= ~(inside & among(codes, met) & ~among(codes, inner))
    return outer[free]


def _with_skirt(paint: Paint, skirt: Int64s, level: int) -> Paint:
    """Add a skirt: its paint is the mean of the paint beside it."""
    if not skirt.size:
        return paint
    values = np.zeros((skirt.size, paint.values.shape[1]))
    coverage, count = np.zeros(skirt.size), np.zeros(skirt.size)
    cells = np.zeros(skirt.size, np.int64)
    for step in _AROUND:
        beside = decode_cells(skirt) + step
        inside = ((beside >= 0) & (beside < 1 << level)).all(axis=1)
        codes = encode_cells(np.where(inside[:, None], beside, 0))
        at = np.minimum(np.searchsorted(paint.codes, codes), paint.codes.size - 1)
        hit = inside & (paint.codes[at] == codes)
        values[hit] += (paint.values * paint.coverage[:, None])[at[hit]]
        coverage[hit] += paint.coverage[at[hit]]
        count[hit] += 1
        cells[hit] = paint.cells[at[hit]]
    values /= np.maximum(coverage, 1e-30)[:, None]
    coverage /= np.maximum(count, 1)
    is_skirt = np.ones(skirt.size, np.bool_)
    extra = Paint(skirt, values.astype(np.float32), coverage.astype(np.float32), cells, is_skirt)
    return _joined(paint, extra)


def _no_paint(components: int) -> Paint:
    return Paint(
        np.empty(0, np.int64),
        np.empty((0, components), np.float32),
        np.empty(0, np.float32),
        np.empty(0, np.int64),
        np.empty(0, np.bool_),
    )


def _some(paint: Paint, chosen: npt.NDArray[np.bool_]) -> Paint:
    return Paint(*(array[chosen] for array in paint))


def _joined(one: Paint, other: Paint) -> Paint:
    order = np.argsort(np.concatenate([one.codes, other.codes]), kind="stable")
    return Paint(*(np.concatenate(pair)[order] for pair in zip(one, other, strict=True)))


def _refined(tree: Octree, channels: Mapping[str, Channel], codes: Int64s, level: int) -> dict[str, Float32s]:
    """Return what channels refine to in cells of a level below leaves, decoded; others weigh by alpha."""
    starts, rows, weights = refined_taps(tree, codes, level)
    found = {}
    alpha = channels.get(ALPHA.name)
    opaque = None if alpha is None else _rows_of(alpha, rows)[:, :1]
    for name, channel in channels.items():
        values = _rows_of(channel, rows)
        own = weights[:, None]
        if opaque is not None and name != ALPHA.name:
            own = own * np.maximum(opaque, np.float32(1e-6))
        sums = _sum_runs(np.hstack([values * own, own]), starts)
        found[name] = sums[:, :-1] / np.maximum(sums[:, -1:], np.float32(1e-30))
    return found


def _sum_runs(values: Float32s, starts: Int64s) -> Float32s:
    """Add up rows from each start to the next; zeros where there are none."""
    sums = np.add.reduceat(np.vstack([values, np.zeros_like(values[:1])]), starts[:-1], axis=0)
    sums[starts[1:] == starts[:-1]] = 0
    return np.asarray(sums, np.float32)


def _rows_of(channel: Channel, rows: Array) -> Float32s:
    """Decode cells, and after them kept coefficients, by their rows."""
    n_cells = len(channel.values)
    found = decode(channel.values[np.minimum(rows, n_cells - 1)], channel.format.space)
    is_kept = np.flatnonzero(rows >= n_cells)
    if is_kept.size:
        found[is_kept] = decode(channel.kept_values[rows[is_kept] - n_cells], channel.format.space)
    return found


def _refined_paint(
    layer: OctreeTexture, name: str, codes: Int64s, level: int, opacity: float
) -> tuple[Float32s, Float32s]:
    found = _refined(layer.tree, layer.channels, codes, level)
    return found[name], found[ALPHA.name][:, 0] * np.float32(opacity)


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


def _carried(
    texture: OctreeTexture, edited: Edited, tree: Octree, met: Met | None, layer: OctreeTexture
) -> tuple[OctreeTexture, npt.NDArray[np.bool_]]:
    """Give an edited tree the texture's values, and new cells what the field refines to.

    Cells that are added where nothing was, which are marked in the second result, take other channels from
    the coarser averages there.
    """
    is_fresh = np.zeros(tree.n_cells, np.bool_)
    is_fresh[0] = texture.tree.n_leaves == 0
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
        values, _, kept_values = channels[name]
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
            found = _refined(texture.tree, texture.channels, codes[below], level)
            kept_at = np.searchsorted(tree.kept.cells, (first + below).astype(np.uint32))
            kept_at = np.minimum(kept_at, tree.kept.cells.size - 1)
            keeps = tree.kept.cells[kept_at] == first + below
            for name, channel in texture.channels.items():
                stored = encode(found[name], channel.format.dtype, channel.format.space)
                channels[name][0][first + below] = stored
                channels[name][2][kept_at[keeps]] = stored[keeps]
            if met is not None and level < len(met.codes):
                is_met = among(codes[below], met.codes[level])
                source = int(met.tree.arrays.level_cells[level]) + np.searchsorted(
                    met.codes[level], codes[below[is_met]]
                )
                flags[first + below[is_met]] |= met.tree.arrays.flags[source] & np.uint8(FACING_FLAGS)
                areas[first + below[is_met]] = met.tree.arrays.areas[source]
        fresh = new[~where.is_leaf]
        if fresh.size:
            is_fresh[first + fresh] = True
            source = locate(layer.tree, codes[fresh], level).cells
            flags[first + fresh] |= layer.tree.arrays.flags[source] & np.uint8(FACING_FLAGS)
            areas[first + fresh] = layer.tree.arrays.areas[source]
            if texture.tree.n_leaves:
                centres = (decode_cells(codes[fresh]) + 0.5) / 2**level
                points = texture.placement.to_rest(centres)
                found = texture.sample(points, list(texture.channels), normalize=False)
                for name, channel in texture.channels.items():
                    stored = encode(found[name], channel.format.dtype, channel.format.space)
                    channels[name][0][first + fresh] = stored
    if is_fresh.any():
        add_up_areas(tree, is_fresh, areas)
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
    sources = _sources_of(tree, new, texture.tree)
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
    made = {target: values}
    parts = {target: coverage}
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
    nodes = np.empty(0, np.int64)
    for name, paints in made.items():
        form = stored[name].format
        mode: Blend = "over" if name == ALPHA.name and blend != "erase" else blend
        old = decode(stored[name].values[cells], form.space)
        new = blended(old, paints, parts[name], mode)
        fresh = is_fresh[cells]
        new[fresh] = paints[fresh] if name == target else coverage[fresh, None]
        after = stored[name].values.copy()
        after[cells] = encode(new, form.dtype, form.space)
        of_paint = _paint_residuals(tree, layer, form, name == target and blend in ("over", "replace"))
        part = parts[name].copy()
        part[fresh] = 1
        nodes, means, _ = updated_averages(
            tree, stored[name].values, after, form, cells, part, of_paint, ~is_fresh
        )
        after[nodes] = encode(means, form.dtype, form.space)
        channels[name] = stored[name]._replace(values=after)
    made_of = OctreeTexture(tree, channels, base.placement, base.bounds, base.metadata)
    return _facing(made_of, base, is_fresh, cells, sources, nodes, layer, target, blend, opacity)


def _in_tree(tree: Octree, paint: Paint, level: int) -> tuple[Int64s, Float32s, Float32s, Int64s]:
    """Return the numbers of painted cells, their paint, coverage and sources."""
    first = int(tree.arrays.level_cells[level])
    codes = tree.level_codes(level)
    return first + np.searchsorted(codes, paint.codes), paint.values, paint.coverage, paint.cells


def _paint_residuals(tree: Octree, layer: OctreeTexture, form: ChannelFormat, counts: bool) -> Float32s:
    """Return the residuals of the paint's averages, by cells of a tree; zeros if they do not count."""
    found = np.zeros((tree.n_cells, form.components), np.float32)
    if not counts:
        return found
    channel = next(each for name, each in layer.channels.items() if name != ALPHA.name)
    coverage = decode(layer.channels[ALPHA.name].values, "data")[:, 0]
    own = residuals(layer.tree, channel.values, channel.format, coverage)
    for level, (codes, is_node) in enumerate(layer.tree.walk()):
        if level > tree.max_depth:
            break
        nodes = np.flatnonzero(is_node)
        where = locate(tree, codes[nodes], level)
        hit = where.levels == level
        found[where.cells[hit]] = own[nodes[hit] + int(layer.tree.arrays.level_cells[level])]
    return found


def _facing(
    texture: OctreeTexture,
    before: OctreeTexture,
    is_fresh: npt.NDArray[np.bool_],
    leaves: Int64s,
    sources: Int64s,
    nodes: Int64s,
    layer: OctreeTexture,
    target: str,
    blend: Blend,
    opacity: float,
) -> OctreeTexture:
    """Paint what cells show each way, where the paint or the cells tell facings apart."""
    tree = texture.tree
    flags, paint_flags = tree.arrays.flags, layer.tree.arrays.flags
    node_sources = _sources_of(tree, nodes, layer.tree)
    cells, sources = np.concatenate([leaves, nodes]), np.concatenate([sources, node_sources])
    chosen = ((flags[cells] | paint_flags[sources]) & SPLIT != 0) & (flags[cells] & FACING_FLAGS != 0)
    cells, sources = cells[chosen], sources[chosen]
    if not cells.size:
        return texture
    order = np.argsort(cells, kind="stable")
    cells, sources = cells[order], sources[order]
    facings = flags[cells] & np.uint8(FACING_FLAGS)
    owners = np.repeat(np.arange(cells.size), np.bitwise_count(facings))
    bits = bits_of(facings)
    name = next(each for each in layer.channels if each != ALPHA.name)
    paint = rows_facing(layer, layer.channels[name], sources[owners], bits)
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


def _sources_of(tree: Octree, nodes: Int64s, other: Octree) -> Int64s:
    """Return the cells of another tree that hold nodes of a tree, or the deepest that do."""
    found = np.zeros(nodes.size, np.int64)
    for level, (codes, _) in enumerate(tree.walk()):
        first = int(tree.arrays.level_cells[level])
        here = (nodes >= first) & (nodes < first + codes.size)
        if here.any():
            found[here] = locate(other, codes[nodes[here] - first], level).cells
    return found
