"""Lays one texture over another, or mixes two, on the union of their trees."""

from __future__ import annotations

import numpy as np

from octex.arrays import Bools, Int64s
from octex.channels import ALPHA, ONE
from octex.checks import as_flag, as_number
from octex.editing.draft import coarsest_of
from octex.editing.runs import carried
from octex.editing.split import refaced, without_split
from octex.errors import ArgumentError
from octex.parallel import Run, as_run, workers
from octex.processing.edit import with_operation
from octex.processing.mapping import in_format
from octex.processing.mixing import Amount, Mixing
from octex.processing.resize import with_leaves
from octex.source.parts import SEPARATION
from octex.texture import Channel, OctreeTexture, as_texture
from octex.tree.areas import SKIRT
from octex.tree.edit import locate, rebuilt
from octex.tree.layout import FACING_FLAGS, SPLIT
from octex.tree.neighbours import are_adjacent, touch
from octex.tree.octree import Octree, distinct


def combine(
    first: OctreeTexture,
    second: OctreeTexture,
    *,
    over: bool = False,
    threads: int | None = None,
    run: Run | None = None,
) -> OctreeTexture:
    """Return a texture with the cells of both; ``second`` lies on top of ``first``.

    A cell of only one texture stays. In a cell of both, ``second`` replaces ``first``, as ``mix`` does with
    an amount of 1. With ``over`` they are composited by alpha, in linear light (Porter & Duff 1984). See
    ``mix`` for cells of different depth, averages, facings and channels. ``run`` says how to work
    (octex.Run).

    Raises ArgumentError for textures of different root cells or separations, or without a common channel.
    """
    as_texture(first, "first")
    as_texture(second, "second")
    over = as_flag(over, "over")
    amount = None if over and ALPHA.name in second.channels else 1.0
    metadata = with_operation(first.metadata, "combine", over=over, second=dict(second.metadata))
    return _united(first, second, amount, metadata, as_run(run, threads))


def mix(
    first: OctreeTexture,
    second: OctreeTexture,
    amount: Amount = 0.5,
    *,
    threads: int | None = None,
    run: Run | None = None,
) -> OctreeTexture:
    """Return first · (1 − amount) + second · amount for two textures of the same root cell.

    amount   0 … 1: a number; a texture of one one-component channel, read at the cells' centres; or a
             function of rest positions (n, 3) that returns (n,). It is clamped
    run      how to work (octex.Run)

    Values mix in linear light, weighted by alpha. The tree has all cells of both textures; a cell of only one
    texture keeps its values. Where one has a leaf that the other divides, the leaf's field gives the values
    below it (paper 4.2). If the leaf's share is a half or more, the node also stores the leaf's value (a kept
    node), so that an unmixed field does not move. Amounts of exactly 0 and 1 return one texture's field.

    Averages are recomputed. A cell has the facings of both; values mix facing by facing. Areas come from the
    texture with the larger share. The result has the common channels, stored as in ``first``; a texture
    without alpha is opaque.

    Raises ArgumentError for textures of different root cells or separations, or without a common channel, for
    channels that differ in components or meaning, and for an unusable amount.
    """
    as_texture(first, "first")
    as_texture(second, "second")
    if isinstance(amount, OctreeTexture):
        recorded: object = "a texture"
        if [channel.format.components for channel in amount.channels.values()] != [1]:
            raise ArgumentError(
                "an amount must be a texture of one channel of one component, not of "
                + (", ".join(amount.channels) or "none")
            )
    elif callable(amount):
        recorded = "a function"
    else:
        recorded = amount = as_number(amount, "amount", 0.0, 1.0)
    metadata = with_operation(first.metadata, "mix", amount=recorded, second=dict(second.metadata))
    return _united(first, second, amount, metadata, as_run(run, threads))


def _united(
    first: OctreeTexture,
    second: OctreeTexture,
    amount: Amount | None,
    metadata: dict[str, str],
    run: Run,
) -> OctreeTexture:
    first, second = _same_formats(first, second)
    bounds = np.array(
        [np.minimum(first.bounds[0], second.bounds[0]), np.maximum(first.bounds[1], second.bounds[1])]
    )
    if first.tree.n_leaves and second.tree.n_leaves:
        if amount == 0.0:
            second = _without_hidden_cells(second, first)
        elif amount == 1.0:
            first = _without_hidden_cells(first, second)
    if not (first.tree.n_leaves and second.tree.n_leaves):
        only = first if first.tree.n_leaves else second
        return only.with_cells(only.tree, only.channels, metadata)
    with workers(run) as pool:
        tree, channels = Mixing(first, second, amount, pool).mixed()
    return OctreeTexture(tree, channels, first.placement, bounds, metadata)


def _same_formats(first: OctreeTexture, second: OctreeTexture) -> tuple[OctreeTexture, OctreeTexture]:
    """Return two textures with their common channels, stored as in the first; missing alpha becomes 1."""
    if first.metadata.get(SEPARATION) != second.metadata.get(SEPARATION):
        raise ArgumentError(
            "the parts of these textures were separated by different distances; separate both or neither"
        )
    if first.placement != second.placement:
        cells = " and ".join(
            f"of edge {size:.6g} at ({', '.join(f'{x:.6g}' for x in origin)})"
            for origin, size in (first.placement, second.placement)
        )
        raise ArgumentError(
            f"the textures' root cells differ, {cells}, and octex does not resample them; "
            "convert both from one model, at the same depth or cell"
        )
    of_first, of_second = {}, {}
    for name, channel in first.channels.items():
        form = channel.format
        if name not in second.channels and name != ALPHA.name:
            continue
        other = second.channels.get(name) or Channel.full(form, second.tree, ONE[form.dtype])
        meaning, other_meaning = (f.space in ("srgb", "linear") or f.space for f in (form, other.format))
        if form.components != other.format.components or meaning != other_meaning:
            raise ArgumentError(
                f"channel {name!r} has {form.components} components of {form.space} in one texture and "
                f"{other.format.components} of {other.format.space} in the other"
            )
        of_first[name], of_second[name] = channel, in_format(other, form)
    if ALPHA.name in second.channels and ALPHA.name not in first.channels:
        of_second[ALPHA.name] = second.channels[ALPHA.name]
        form = of_second[ALPHA.name].format
        of_first[ALPHA.name] = Channel.full(form, first.tree, ONE[form.dtype])
    if not first.channels.keys() & second.channels.keys():
        raise ArgumentError(
            f"the textures have no channel in common: {', '.join(first.channels) or 'none'} and "
            f"{', '.join(second.channels) or 'none'}"
        )
    return first.with_cells(first.tree, of_first), second.with_cells(second.tree, of_second)


def _without_hidden_cells(texture: OctreeTexture, over: OctreeTexture) -> OctreeTexture:
    """Return a texture without the cells that ``over`` hides; leaves of both get the facings of ``over``."""
    is_idle = _idle_skirts(texture.tree, over.tree)
    if is_idle.any():
        texture = with_leaves(texture, ~is_idle)
    edited = rebuilt(texture.tree, _visible_leaves(texture.tree, over.tree))
    texture = texture.with_cells(edited.tree, carried(texture, edited))
    tree = texture.tree
    flags = tree.arrays.flags.copy()
    for level, (codes, is_node) in enumerate(tree.walk()):
        where = locate(over.tree, codes, level)
        both = np.flatnonzero(~is_node & where.is_leaf & (where.levels == level))
        cells = both + int(tree.arrays.level_cells[level])
        facings = over.tree.arrays.flags[where.cells[both]] & np.uint8(FACING_FLAGS)
        flags[cells] = flags[cells] & np.uint8(0xFF ^ FACING_FLAGS) | facings
    split = tree.split.cells.astype(np.int64)
    refacing = split[flags[split] != tree.arrays.flags[split]]
    flags[refacing] &= np.uint8(0xFF ^ SPLIT)
    texture = without_split(texture, refacing)
    tree = texture.tree
    tree = tree.with_cell_data(flags, tree.arrays.areas, tree.split, tree.kept)
    return refaced(texture.with_cells(tree, texture.channels))


def _idle_skirts(tree: Octree, over: Octree) -> Bools:
    """Return which skirt leaves (cells,) would move the other tree's field, and adjoin no surface it lacks.

    They lie in cells that it lacks, no larger than its largest leaf or kept node, next to leaves of it: there
    nodes end what the field spreads to empty cells.
    """
    idle_by_level: list[Bools] = []
    lacked: list[Int64s] = []
    leaves, coarsest = [codes[~is_node] for codes, is_node in over.walk()], coarsest_of(over)
    for level, (codes, is_node) in enumerate(tree.walk()):
        where = locate(over, codes, level)
        is_lacking = ~is_node & ~where.is_leaf & (where.levels < level)
        first, end = tree.arrays.level_cells[level : level + 2]
        is_idle = is_lacking & (tree.arrays.areas[first:end] == SKIRT)
        lacked.append(codes[is_lacking & ~is_idle])
        tops = np.clip(where.levels + 1, min(coarsest, level), level)
        for top in distinct(tops[is_idle]).tolist():
            below = is_idle & (tops == top)
            is_idle[below] = touch(codes[below] >> 3 * (level - top), leaves, top)
        idle_by_level.append(is_idle)
    for level, (is_idle, (codes, _)) in enumerate(zip(idle_by_level, tree.walk(), strict=True)):
        is_idle[is_idle] = ~are_adjacent(codes[is_idle], lacked, level)
    return np.concatenate(idle_by_level)


def _visible_leaves(tree: Octree, over: Octree) -> list[Int64s]:
    """Return the codes of the leaves that another tree does not hide, by level.

    Nodes become leaves where the other has leaves.
    """
    leaves: list[Int64s] = []
    for level, (codes, is_node) in enumerate(tree.walk()):
        where = locate(over, codes, level)
        leaves.append(codes[np.where(where.is_leaf, where.levels == level, ~is_node)])
    return leaves
