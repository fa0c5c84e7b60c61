"""An eraser on the bottom of a stack: it brings back the texture as it was opened."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from octex.arrays import Float32s, Int64s, Uint8s
from octex.channels import ALPHA, ONE, alpha_of, channel_in, decode, encode
from octex.editing.averages import Residuals, average, residuals
from octex.editing.nodes import Nodes, all_children, nodes_at
from octex.editing.refined import refined_rows, refined_values
from octex.editing.split import rows_facing
from octex.painting.blend import writable
from octex.texture import Channel, OctreeTexture
from octex.tree.children import node_cells
from octex.tree.edit import locate, with_all_above
from octex.tree.layout import KEPT
from octex.tree.morton import decode_cells
from octex.tree.octree import Octree, distinct
from octex.tree.split import rows_of

#: How much of cells is erased, while that is done.
ERASED = channel_in("eraser", ALPHA.name)


def without_erased(texture: OctreeTexture) -> OctreeTexture:
    """Return a texture without what says how much of it is erased."""
    channels = {name: own for name, own in texture.channels.items() if name != ERASED}
    return texture.with_cells(texture.tree, channels)


def restored(texture: OctreeTexture, opened: OctreeTexture, erased: Channel) -> OctreeTexture:
    """Return a texture of which as much as is ``erased`` is as another one, of no finer cells, has it.

    Values blend in linear light. Nodes are averaged anew, with the residuals of both.
    """
    tree = texture.tree
    is_leaf = np.ones(tree.n_cells, np.bool_)
    is_leaf[node_cells(tree.arrays)] = False
    rows = rows_of(tree.split)
    places = [
        np.flatnonzero(is_leaf & (erased.values[:, 0] > 0)),
        np.flatnonzero(is_leaf[rows.cells] & (erased.split_values[:, 0] > 0)),
        np.flatnonzero(erased.kept_values[:, 0]),
    ]
    cells = places[0], rows.cells[places[1]], tree.kept.cells[places[2]].astype(np.int64)
    names = [name for name in opened.channels if name in texture.channels]
    names += [ALPHA.name for name in (ALPHA.name,) if name in texture.channels and name not in names]
    channels = writable(texture, names)
    for kind, (at, own, covers) in enumerate(zip(places, cells, erased[1:], strict=True)):
        part = decode(covers[at], "data")
        before = _values(opened, tree, own, rows.bits[at] if kind == 1 else None, kind == 2)
        for name in names:
            form, stored = channels[name].format, list(channels[name][1:])[kind]
            now = decode(stored[at], form.space)
            new = (1 - part) * now + part * before.get(name, np.ones_like(now))
            stored[at] = encode(new, form.dtype, form.space)
    made = texture.with_cells(tree, channels)
    levels = [tree.level_codes(level)[each] for level, each in _by_level(tree, places[0])]
    above = [distinct(codes >> 3) for codes in with_all_above(levels)[1:]]
    nodes = nodes_at(tree, above)
    split = rows_of(tree.split, nodes.cells)
    part, row_part = (
        decode(each, "data") for each in (erased.values[nodes.cells], erased.split_values[split.rows])
    )
    whole = _laid_on(opened, made, names, nodes)
    for name in sorted(names, key=lambda name: alpha_of(name) is not None):
        ours, theirs = residuals(texture, name, nodes), residuals(whole, name, nodes)
        left = Residuals(
            ours.nodes * (1 - part) + theirs.nodes * part,
            ours.rows * (1 - row_part) + theirs.rows * row_part,
        )
        average(made, channels[name], left, nodes)
    return made


def _laid_on(opened: OctreeTexture, texture: OctreeTexture, names: list[str], nodes: Nodes) -> OctreeTexture:
    """Return a texture on the tree of another, right in nodes and their children.

    What were leaves and are nodes now have the values that they had, as lookups with a width read these.
    """
    tree = texture.tree
    cells = distinct(np.concatenate([nodes.cells, all_children(tree, nodes.numbers)[0]]))
    rows = rows_of(tree.split, cells)
    channels = writable(texture, names)
    for kind, at, own, bits in ((0, cells, cells, None), (1, rows.rows, rows.cells, rows.bits)):
        found = _values(opened, tree, own, bits, are_nodes=True)
        for name in names:
            form, stored = channels[name].format, list(channels[name][1:])[kind]
            stored[at] = encode(found[name], form.dtype, form.space) if name in found else ONE[form.dtype]
    made = texture.with_cells(tree, {name: channels[name] for name in names})
    had = [
        locate(opened.tree, tree.level_codes(level)[own], level).levels == level
        for level, own in _by_level(tree, nodes.cells)
    ]
    for name in sorted(names, key=lambda name: alpha_of(name) is not None):
        average(made, channels[name], None, nodes.of(~np.concatenate(had)))
    return made


def _by_level(tree: Octree, cells: Int64s) -> Iterator[tuple[int, Int64s]]:
    """Yield each level of a tree, and which of its cells are among some, ascending."""
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
    """Return what a texture has, decoded, in cells (n,) of a tree, ascending: beside its cells, what is near.

    It is of facings, if ``bits`` (n,) are given; else of leaves, of kept nodes, or averages of any nodes.
    """
    names = list(opened.channels)
    found = {
        name: np.zeros((cells.size, own.format.components), np.float32)
        for name, own in opened.channels.items()
    }
    begin = 0
    for level, own in _by_level(tree, cells):
        if not own.size:
            continue
        codes = tree.level_codes(level)[own]
        where = locate(opened.tree, codes, level)
        is_kept = opened.tree.arrays.flags[where.cells] & KEPT != 0
        has_own = where.is_leaf | (is_kept & are_kept) | are_nodes
        is_same = (where.levels == level) & has_own
        is_below = (where.levels < level) & (where.is_leaf | is_kept)
        same, below, other = (
            begin + np.flatnonzero(each) for each in (is_same, is_below, ~is_same & ~is_below)
        )
        begin += own.size
        if bits is None:
            refined = refined_values(opened.tree, opened.channels, codes[is_below], level)
        else:
            refined = refined_rows(opened, codes[is_below], level, bits[below])
        centres = opened.placement.to_rest((decode_cells(codes[~is_same & ~is_below]) + 0.5) / 2**level)
        sampled = opened.sample(centres, names, normalize=False)
        for name, channel in opened.channels.items():
            if bits is not None:
                found[name][same] = rows_facing(opened, channel, where.cells[is_same], bits[same])
            else:
                stored = channel.values[where.cells[is_same]]
                kept = np.flatnonzero(is_kept[is_same] & (not are_nodes))
                rows = np.searchsorted(opened.tree.kept.cells, where.cells[is_same][kept].astype(np.uint32))
                stored[kept] = channel.kept_values[rows]
                found[name][same] = decode(stored, channel.format.space)
            found[name][below] = refined[name]
            found[name][other] = sampled[name]
    return found
