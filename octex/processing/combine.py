"""One texture on another, and all that is between the two, on the tree of the cells of both."""

from __future__ import annotations

from concurrent.futures import Executor

import numpy as np

from octex.channels import ALPHA, ONE, ChannelFormat
from octex.checks import as_flag, as_number
from octex.errors import ArgumentError
from octex.parallel import workers
from octex.processing.cast import in_format
from octex.processing.edit import noted
from octex.processing.hidden import without_hidden
from octex.processing.mixing import Amount, Mixing
from octex.source.separation import SEPARATION
from octex.texture import Channel, OctreeTexture, as_texture
from octex.tree.octree import Octree


def combine(
    first: OctreeTexture,
    second: OctreeTexture,
    *,
    over: bool = False,
    threads: int | None = None,
    executor: Executor | None = None,
) -> OctreeTexture:
    """Return two textures of the same root cell in one: ``second`` on ``first``.

    Where only one has cells, its own stand, with all that they have. Where both have them, those of
    ``second`` do, as in ``mix`` with an amount of 1; with ``over`` they are laid over those of ``first`` by
    their alpha, in linear light (Porter & Duff 1984). See ``mix`` for cells of different depth, and for what
    becomes of averages, facings and channels.

    Who works in parallel: ``threads``, so many, by default all processors for large batches and the calling
    thread alone for small ones; or the workers of ``executor``, any concurrent.futures.Executor. The result
    is the same.

    Raises ArgumentError for textures of different root cells or separated otherwise, or without a channel in
    common.
    """
    as_texture(first, "first")
    as_texture(second, "second")
    over = as_flag(over, "over")
    amount = None if over and ALPHA.name in second.channels else 1.0
    metadata = noted(first.metadata, "combine", over=over, second=dict(second.metadata))
    return _united(first, second, amount, metadata, threads, executor)


def mix(
    first: OctreeTexture,
    second: OctreeTexture,
    amount: Amount = 0.5,
    *,
    threads: int | None = None,
    executor: Executor | None = None,
) -> OctreeTexture:
    """Return first · (1 − amount) + second · amount for two textures of the same root cell.

    ``amount`` is a number, 0 … 1, or differs from place to place: a texture of one channel of one component,
    read at the centres of cells, or a function of their positions (n, 3), in rest space, that returns (n,).
    It is clamped to 0 … 1. Values are mixed in linear light, weighed by alpha.

    The tree is that of all cells of both; where only one has a cell, its own values stand. Where one has a
    leaf and the other divides the cell, its values below are what its field refines to (paper 4.2), and the
    node keeps the leaf's coefficient if that texture prevails, with an amount of a half or more: then a
    field that is not mixed stays as it was. A leaf of the other texture lends its values to the cells that
    are there below it, and nothing where there are none.

    With the number 0 or 1 a texture prevails everywhere: what both have is as it is there, and finer cells of
    the other below its leaves are left out. So are the other's cells off the surface beside nothing but
    what both have.

    Averages are the means of what is below them, and the residuals of both by their parts. Cells face as
    those of both do; rows are mixed facing by facing. Areas are those of the texture that prevails; of nodes
    to which both add cells, and of their rows, the sums of what is below. The channels are those that both
    have, as ``first`` stores them; a texture without alpha is opaque.

    Who works in parallel: ``threads``, so many, by default all processors for large batches and the calling
    thread alone for small ones; or the workers of ``executor``, any concurrent.futures.Executor. The result
    is the same.

    Raises ArgumentError for textures of different root cells or separated otherwise, or without a channel in
    common, for channels that differ in their components or meaning, and for an amount that cannot be used.
    """
    as_texture(first, "first")
    as_texture(second, "second")
    if isinstance(amount, OctreeTexture):
        how: object = "a texture"
        if [each.format.components for each in amount.channels.values()] != [1]:
            raise ArgumentError(
                "an amount must be a texture of one channel of one component, not of "
                + (", ".join(amount.channels) or "none")
            )
    elif callable(amount):
        how = "a function"
    else:
        how = amount = as_number(amount, "amount", 0.0, 1.0)
    metadata = noted(first.metadata, "mix", amount=how, second=dict(second.metadata))
    return _united(first, second, amount, metadata, threads, executor)


def _united(
    first: OctreeTexture,
    second: OctreeTexture,
    amount: Amount | None,
    metadata: dict[str, str],
    threads: int | None,
    executor: Executor | None,
) -> OctreeTexture:
    """Mix two textures by an amount, or lay the second over the first."""
    first, second = _alike(first, second)
    bounds = np.array(
        [np.minimum(first.bounds[0], second.bounds[0]), np.maximum(first.bounds[1], second.bounds[1])]
    )
    if first.tree.n_leaves and second.tree.n_leaves:
        if amount == 0.0:
            second = without_hidden(second, first)
        elif amount == 1.0:
            first = without_hidden(first, second)
    if not (first.tree.n_leaves and second.tree.n_leaves):
        only = first if first.tree.n_leaves else second
        return OctreeTexture(only.tree, only.channels, only.placement, only.bounds, metadata)
    with workers(threads, executor) as pool:
        tree, channels = Mixing(first, second, amount, pool).mixed()
    return OctreeTexture(tree, channels, first.placement, bounds, metadata)


def _alike(first: OctreeTexture, second: OctreeTexture) -> tuple[OctreeTexture, OctreeTexture]:
    """Return two textures with the channels that both have, as the first stores them, or raise ArgumentError.

    If only one has an alpha, the other becomes opaque.
    """
    if first.metadata.get(SEPARATION) != second.metadata.get(SEPARATION):
        raise ArgumentError(
            "parts of these textures' surfaces were moved apart, and not by the same; separate both or "
            "neither"
        )
    if first.placement != second.placement:
        cells = " and ".join(
            f"of edge {size:.6g} at ({', '.join(f'{x:.6g}' for x in origin)})"
            for origin, size in (first.placement, second.placement)
        )
        raise ArgumentError(
            f"the textures' root cells differ, {cells}, and so do their cells, which are not resampled; "
            "convert both models with the same bounds and depth or cell"
        )
    one, other = {}, {}
    for name, channel in first.channels.items():
        form = channel.format
        if name not in second.channels and name != ALPHA.name:
            continue
        found = second.channels.get(name) or _opaque(second.tree, form)
        meanings = [each.space in ("srgb", "linear") or each.space for each in (form, found.format)]
        if form.components != found.format.components or meanings[0] != meanings[1]:
            raise ArgumentError(
                f"channel {name!r} has {form.components} components of {form.space} in one texture and "
                f"{found.format.components} of {found.format.space} in the other"
            )
        one[name], other[name] = channel, in_format(found, form)
    if ALPHA.name in second.channels and ALPHA.name not in first.channels:
        other[ALPHA.name] = second.channels[ALPHA.name]
        one[ALPHA.name] = _opaque(first.tree, other[ALPHA.name].format)
    if not first.channels.keys() & second.channels.keys():
        raise ArgumentError(
            f"the textures have no channel in common: {', '.join(first.channels) or 'none'} and "
            f"{', '.join(second.channels) or 'none'}"
        )
    made = [
        OctreeTexture(each.tree, own, each.placement, each.bounds)
        for each, own in ((first, one), (second, other))
    ]
    return made[0], made[1]


def _opaque(tree: Octree, form: ChannelFormat) -> Channel:
    """Return an alpha of 1 for a tree."""
    rows = tree.n_cells, tree.split.areas.size, tree.kept.cells.size
    return Channel(form, *(np.full((count, 1), ONE[form.dtype], form.dtype) for count in rows))
