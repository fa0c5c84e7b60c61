"""The composites that strokes lead to; pages show them before a stroke is painted. And the bottom's eraser.

Layers blend linearly, so a stroke mixes the composite with another one, by its coverage: that in which all of
the layer has the stroke's paint, or for an eraser that without the layer.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple, get_args

import numpy as np

from octex.arrays import Float32s, Int64s, Uint8s
from octex.channels import ALPHA, BASE_COLOR, ONE, alpha_of, channel_in, decode
from octex.checks import as_choice
from octex.editing.averages import Residuals, average, residuals
from octex.editing.draft import change_of_values, numbers_in
from octex.editing.nodes import Nodes, all_children, all_leaves, nodes_at
from octex.editing.refined import refined_rows, refined_values
from octex.editing.split import rows_facing
from octex.painting.blend import (
    KINDS,
    all_above,
    alpha_first,
    blended,
    mixed_residuals,
    read,
    writable,
    write,
)
from octex.painting.layer import COVERAGE
from octex.painting.stack import (
    Layer,
    Stack,
    only,
    shown_names,
    with_channels,
    with_composite,
    with_layer_channels,
)
from octex.texture import Channel, OctreeTexture
from octex.tree.edit import locate
from octex.tree.layout import KEPT
from octex.tree.morton import decode_cells
from octex.tree.octree import Octree, distinct
from octex.tree.split import rows_of

#: The kinds of strokes: the layer is erased, its mask hides nothing, or it is painted.
StrokeKind = Literal["erased", "unmasked", "painted"]
_STROKES: tuple[StrokeKind, ...] = get_args(StrokeKind)
#: The channel of the composite with white paint.
WHITE = "white"


class Stacked(NamedTuple):
    """A stack at a time."""

    texture: OctreeTexture  # with the channels of all layers
    stack: Stack
    opened: OctreeTexture  # the bottom as it was opened


def composite_after(stacked: Stacked, number: int | None, stroke: StrokeKind) -> OctreeTexture | None:
    """Return the base colour of the composite to which strokes in a layer lead; None is the bottom.

    For paint it is the composite with black paint, and channel ``white`` that with white. Alpha is 0 in
    unknown cells, which no layer above covers. Returns None if no paint matters, for textures with alpha, and
    for an unknown layer: a page may ask while the layer is undone.
    """
    as_choice(stroke, _STROKES, "stroke")
    texture, stack, opened = stacked
    index = next((at for at, each in enumerate(stack) if each.number == number), -1)
    if ALPHA.name in texture.channels or (index < 0 and number is not None):
        return None
    if index < 0 and stroke != "painted":
        if stack:
            erased = _filled(texture, Channel(COVERAGE, *texture.channels[BASE_COLOR.name][1:]), 1)
            color = _composite(restored(texture, opened, erased), stack)
            return with_channels(texture, {BASE_COLOR.name: color.named(BASE_COLOR.name)})
        return only(opened, [BASE_COLOR.name])
    layer = stack[index] if index >= 0 else None
    met = [each for each in stack[index + 1 :] if each.is_visible and each.opacity > 0]
    if layer is not None and (stroke != "painted" or layer.opacity < 1 or layer.blend != "over"):
        met.append(layer)
    names = [alpha_of(each.paints(name)) or "" for each in met for name in each.painted(texture.channels)]
    bare = {name: _filled(texture, texture.channels[name], 0) for name in names}
    change = change_of_values(with_channels(texture, {**texture.channels, **bare}), texture)
    if change is None:
        return None
    draft = change.after
    known = np.ones(draft.tree.n_cells, np.bool_)
    if change.tiles is not None:
        known = numbers_in(texture, change.tiles, draft) >= 0
    if stroke == "painted":
        colors = {name: _composite(_painted(draft, layer, value), stack) for name, value in _PAINTS.items()}
    else:
        unmasked = () if stroke == "erased" or layer is None else (layer._replace(has_mask=False),)
        colors = {BASE_COLOR.name: _composite(draft, (*stack[:index], *unmasked, *stack[index + 1 :]))}
    owners = slice(None), rows_of(draft.tree.split).cells, draft.tree.kept.cells
    alphas = (np.where(known[cells], ONE[ALPHA.dtype], 0) for cells in owners)
    alpha = Channel(ALPHA, *(each.astype(ALPHA.dtype)[:, None] for each in alphas))
    channels = {name: color.named(name) for name, color in colors.items()}
    return with_channels(draft, {**channels, ALPHA.name: alpha})


_PAINTS = {BASE_COLOR.name: 0, WHITE: 1}


def _composite(texture: OctreeTexture, stack: Stack) -> Channel:
    """Return the base colour of a stack's composite, made from its layers."""
    stacked = with_composite(texture, stack)
    return stacked.channels[shown_names(stacked)[BASE_COLOR.name]]


def _painted(texture: OctreeTexture, layer: Layer | None, value: int) -> OctreeTexture:
    """Return a stack's texture with a layer, or the bottom, all black (0) or white (1)."""
    color = BASE_COLOR.name if layer is None else layer.paints(BASE_COLOR.name)
    cover = None if layer is None else alpha_of(color)
    texture = with_layer_channels(texture, [each for each in (color, cover) if each])
    painted = {color: _filled(texture, texture.channels[color], value)}
    if cover:
        painted[cover] = _filled(texture, texture.channels[cover], 1)
    return with_channels(texture, {**texture.channels, **painted})


def _filled(texture: OctreeTexture, channel: Channel, value: int) -> Channel:
    return Channel.full(channel.format, texture.tree, value * ONE[channel.format.dtype])


#: The channel with the erased part of cells, while an eraser works.
ERASED = channel_in("eraser", ALPHA.name)


def without_erased(texture: OctreeTexture) -> OctreeTexture:
    """Return a texture without the channel ERASED."""
    return only(texture, texture.channels.keys() - {ERASED})


def restored(texture: OctreeTexture, opened: OctreeTexture, erased: Channel) -> OctreeTexture:
    """Blend a texture with an ``opened`` one of no finer cells, by the ``erased`` part of cells.

    Values blend in linear light. Nodes are averages, with the residuals of both.
    """
    tree = texture.tree
    is_leaf = all_leaves(tree)
    split = rows_of(tree.split)
    rows = (
        np.flatnonzero(is_leaf & (erased.values[:, 0] > 0)),
        np.flatnonzero(is_leaf[split.cells] & (erased.split_values[:, 0] > 0)),
        np.flatnonzero(erased.kept_values[:, 0]),
    )
    cells = rows[0], split.cells[rows[1]], tree.kept.cells[rows[2]].astype(np.int64)
    names = [name for name in (*opened.channels, ALPHA.name) if name in texture.channels]
    names = list(dict.fromkeys(names))
    channels = writable(texture, names)
    for kind, of_kind, owners in zip(KINDS, rows, cells, strict=True):
        part = read(erased, kind, of_kind)[:, 0]
        bits = split.bits[of_kind] if kind == "split_values" else None
        before = _values(opened, tree, owners, bits, are_kept=kind == "kept_values")
        for name in names:
            now = read(channels[name], kind, of_kind)
            new = blended(now, before.get(name, np.ones_like(now)), part, "over")
            write(channels[name], kind, of_kind, new)
    result = with_channels(texture, channels)
    erased_codes = [tree.level_codes(level)[each] for level, each in _by_level(tree, rows[0])]
    nodes = nodes_at(tree, all_above(erased_codes))
    node_rows = nodes.cells, rows_of(tree.split, nodes.cells).rows
    parts = [read(erased, kind, of_kind) for kind, of_kind in zip(KINDS, node_rows, strict=False)]
    whole = _laid_on(opened, result, names, nodes)
    for name in alpha_first(names):
        mix = map(mixed_residuals, residuals(texture, name, nodes), residuals(whole, name, nodes), parts)
        average(result, channels[name], Residuals(*mix), nodes)
    return result


def _laid_on(opened: OctreeTexture, texture: OctreeTexture, names: list[str], nodes: Nodes) -> OctreeTexture:
    """Return ``opened`` on the tree of another texture; only nodes and their children get values.

    Nodes that were leaves keep their values, since lookups with a width read these.
    """
    tree = texture.tree
    cells = distinct(np.concatenate([nodes.cells, all_children(tree, nodes.numbers)[0]]))
    rows = rows_of(tree.split, cells)
    channels = writable(texture, names)
    for kind, of_kind, owners, bits in zip(
        KINDS, (cells, rows.rows), (cells, rows.cells), (None, rows.bits), strict=False
    ):
        values = _values(opened, tree, owners, bits, are_nodes=True)
        for name in names:
            if name in values:
                write(channels[name], kind, of_kind, values[name])
            else:
                getattr(channels[name], kind)[of_kind] = ONE[channels[name].format.dtype]
    laid = with_channels(texture, {name: channels[name] for name in names})
    had = [
        locate(opened.tree, tree.level_codes(level)[at], level).levels == level
        for level, at in _by_level(tree, nodes.cells)
    ]
    for name in alpha_first(names):
        average(laid, channels[name], None, nodes.of(~np.concatenate(had)))
    return laid


def _by_level(tree: Octree, cells: Int64s) -> Iterator[tuple[int, Int64s]]:
    """Yield each level of a tree, and the places in it of the given cells, ascending."""
    ends = np.searchsorted(cells, tree.arrays.level_cells)
    for level in range(tree.max_depth + 1):
        yield level, cells[ends[level] : ends[level + 1]] - int(tree.arrays.level_cells[level])


def _values(
    opened: OctreeTexture,
    tree: Octree,
    cells: Int64s,
    bits: Uint8s | None,
    are_kept: bool = False,
    are_nodes: bool = False,
) -> dict[str, Float32s]:
    """Return a texture's decoded values in cells (n,) of another tree, ascending: stored, refined or sampled.

    They are those of facings, if ``bits`` (n,) are given; else of leaves, of kept nodes, or of any nodes.
    """
    names = list(opened.channels)
    values = {
        name: np.zeros((cells.size, channel.format.components), np.float32)
        for name, channel in opened.channels.items()
    }
    begin = 0
    for level, at in _by_level(tree, cells):
        if not at.size:
            continue
        codes = tree.level_codes(level)[at]
        where = locate(opened.tree, codes, level)
        is_kept = opened.tree.arrays.flags[where.cells] & KEPT != 0
        is_stored = where.is_leaf | (is_kept & are_kept) | are_nodes
        is_same = (where.levels == level) & is_stored
        is_below = (where.levels < level) & (where.is_leaf | is_kept)
        same, below, absent = (
            begin + np.flatnonzero(each) for each in (is_same, is_below, ~is_same & ~is_below)
        )
        begin += at.size
        if bits is None:
            refined = refined_values(opened.tree, opened.channels, codes[is_below], level)
        else:
            refined = refined_rows(opened, codes[is_below], level, bits[below])
        centres = opened.placement.to_rest((decode_cells(codes[~is_same & ~is_below]) + 0.5) / 2**level)
        sampled = opened.sample(centres, names, normalize=False)
        for name, channel in opened.channels.items():
            if bits is not None:
                values[name][same] = rows_facing(opened, channel, where.cells[is_same], bits[same])
            else:
                stored = channel.values[where.cells[is_same]]
                has_kept = np.flatnonzero(is_kept[is_same] & (not are_nodes))
                kept_cells = where.cells[is_same][has_kept].astype(np.uint32)
                stored[has_kept] = channel.kept_values[np.searchsorted(opened.tree.kept.cells, kept_cells)]
                values[name][same] = decode(stored, channel.format.space)
            values[name][below] = refined[name]
            values[name][absent] = sampled[name]
    return values
