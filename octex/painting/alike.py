"""The leaves of one colour: regions for fills that begin at a point."""

from __future__ import annotations

import numpy as np

from octex.arrays import Array, Bools, Float64s, Int64s
from octex.channels import BASE_COLOR, linear_to_srgb
from octex.checks import as_number, as_reals
from octex.painting.region import RegionFunction
from octex.source.parts import join
from octex.texture import OctreeTexture
from octex.tree.edit import locate
from octex.tree.layout import GRID_BITS
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import on_grid

_FARTHEST = 1e100


def alike(
    texture: OctreeTexture, point: Array, tolerance: float, *, connected: bool = True
) -> RegionFunction:
    """Return the region of the leaves whose base colour is nearly that of a point at rest.

    The colours of leaves are those of lookups in their middles. ``tolerance`` is the largest difference of a
    component, in 8-bit sRGB codes, 0 … 255. With ``connected``, the region has only leaves that hang together
    with the point's through the faces of leaves. It is empty if the point is in no leaf.

    Raises ArgumentError for numbers out of range.
    """
    where = as_reals(point, "point", (3,), most=_FARTHEST)[None]
    most = as_number(tolerance, "tolerance", 0.0, 255.0)
    tree = texture.tree
    first = _leaf_at(texture, where)[0]
    is_chosen = np.zeros(tree.n_cells, np.bool_)
    if first >= 0:
        wanted = _codes(texture, where)
        for level, cells, codes in _leaves(texture):
            middles = texture.placement.to_rest((decode_cells(codes) + 0.5) / 2**level)
            is_chosen[cells] = np.abs(_codes(texture, middles) - wanted).max(axis=1) <= most
        is_chosen[first] = True
        if connected:
            is_chosen = _hanging_together(texture, is_chosen, first)

    def covers(points: Float64s) -> Bools:
        cells = _leaf_at(texture, points)
        return is_chosen[cells] & (cells >= 0)

    return covers


def _codes(texture: OctreeTexture, points: Array) -> Array:
    """Return base colours of points (n, 3) in sRGB codes, not rounded."""
    return 255.0 * linear_to_srgb(np.clip(texture.sample(points, BASE_COLOR.name), 0.0, 1.0))


def _leaf_at(texture: OctreeTexture, points: Array) -> Int64s:
    """Return the leaf that each point at rest (n, 3) is in; −1 for none."""
    depth = texture.tree.max_depth
    places = texture.placement.to_texture_space(points)
    is_inside = np.asarray(((places >= 0) & (places <= 1)).all(axis=1))
    codes = encode_cells(on_grid(points, texture.placement) >> (GRID_BITS - depth))
    return _leaf_of(texture.tree, codes, depth, is_inside)


def _leaf_of(tree: Octree, codes: Int64s, level: int, among: Bools) -> Int64s:
    """Return the leaf that is, or holds, each cell (n,) of a level; −1 for none and for others than some."""
    found = locate(tree, codes, level)
    is_leaf = found.is_leaf & among & (tree.n_leaves > 0)
    return np.where(is_leaf, found.cells, -1)


def _leaves(texture: OctreeTexture) -> list[tuple[int, Int64s, Int64s]]:
    """Return the levels of a texture, and the cells and Morton codes of their leaves."""
    first = texture.tree.arrays.level_cells
    return [
        (level, first[level] + np.flatnonzero(~is_node), codes[~is_node])
        for level, (codes, is_node) in enumerate(texture.tree.walk())
    ]


def _hanging_together(texture: OctreeTexture, is_chosen: Bools, first: int) -> Bools:
    """Return of the leaves that are chosen those that hang together with the first one by faces."""
    pairs = []
    for level, cells, codes in _leaves(texture):
        own = is_chosen[cells]
        cells, places = cells[own], decode_cells(codes[own])
        for axis in range(3):
            for step in (-1, 1):  # the finer of two leaves finds the other, which is as large or larger
                beside = places.copy()
                beside[:, axis] += step
                is_inside = (beside[:, axis] >= 0) & (beside[:, axis] < 2**level)
                beside[~is_inside] = 0
                others = _leaf_of(texture.tree, encode_cells(beside), level, is_inside)
                both = (others >= 0) & is_chosen[others]
                pairs.append(np.stack([cells[both], others[both]]))
    parents = np.arange(len(is_chosen))
    join(parents, *np.concatenate(pairs, axis=1))
    found: Bools = is_chosen & (parents == parents[first])
    return found
