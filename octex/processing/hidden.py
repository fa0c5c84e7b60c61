"""One texture without what another hides that is laid over it wholly."""

from __future__ import annotations

import numpy as np

from octex.arrays import Int64s
from octex.editing.carried import carried
from octex.editing.split import refaced, without_split
from octex.texture import OctreeTexture
from octex.tree.areas import SKIRT
from octex.tree.beside import are_beside
from octex.tree.edit import locate, rebuilt
from octex.tree.layout import FACING_FLAGS, SPLIT
from octex.tree.octree import Octree


def without_hidden(texture: OctreeTexture, over: OctreeTexture) -> OctreeTexture:
    """Return a texture without what another hides that is laid over it.

    Its nodes become leaves where the other has leaves. A skirt that the other lacks goes, unless it is beside
    surface that the other lacks: it would move the other's field. Leaves of both face as the other's.
    """
    edited = rebuilt(texture.tree, _left(texture.tree, over.tree))
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
    turned = split[flags[split] != tree.arrays.flags[split]]
    flags[turned] &= np.uint8(0xFF ^ SPLIT)
    texture = without_split(texture, turned)
    tree = texture.tree
    tree = tree.with_cell_data(flags, tree.arrays.areas, tree.split, tree.kept)
    return refaced(texture.with_cells(tree, texture.channels))


def _left(tree: Octree, over: Octree) -> list[Int64s]:
    """Return the codes of the leaves that another tree does not hide, by level."""
    leaves: list[Int64s] = []
    skirts: list[Int64s] = []
    alone: list[Int64s] = []  # surface that the other lacks
    for level, (codes, is_node) in enumerate(tree.walk()):
        where = locate(over, codes, level)
        is_lacking = ~is_node & ~where.is_leaf & (where.levels < level)
        first, end = tree.arrays.level_cells[level : level + 2]
        is_skirt = is_lacking & (tree.arrays.areas[first:end] == SKIRT)
        is_left = np.where(where.is_leaf, where.levels == level, ~is_node & ~is_skirt)
        leaves.append(codes[is_left])
        skirts.append(codes[is_skirt])
        alone.append(codes[is_lacking & ~is_skirt])
    for level, own in enumerate(skirts):
        stays = own[are_beside(own, alone, level)]
        leaves[level] = np.sort(np.concatenate([leaves[level], stays]), kind="stable")
    return leaves
