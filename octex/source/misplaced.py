"""Whether a surface is a texture's, and if not, how its bounds differ from those of the texture's surface."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np

from octex.arrays import Float64s
from octex.errors import ArgumentError, ModelWarning

if TYPE_CHECKING:
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture

#: The level at which points are sought in leaves, and the level at which leaves are sought at points.
_FINE, _COARSE = 6, 4
#: Nearly all points of a texture's own surface lie in leaves of level 6. If only part of it has cells, nearly
#: all leaves of level 4 hold points. Seven other models of the same size reach at most 28 % and 62 %.
_POINTS, _LEAVES = 0.3, 0.75
#: Bounds are alike if they differ by no more than this share of their longest side.
_ALIKE = 0.02


def check_place(surface: Surface, texture: OctreeTexture) -> None:
    """Raise ArgumentError if a surface is not the texture's; warn if less than half of it lies in it."""
    points = surface.scatter(10_000, seed=0).rest
    share = float(texture.level(_FINE).contains(points).mean())  # of a remote texture little is read
    if share >= 0.5:
        return
    why = _difference(np.array([surface.rest.min(axis=0), surface.rest.max(axis=0)]), texture.bounds)
    if share == 0:
        raise ArgumentError(f"{surface.name} has no point in the texture; {why}")
    outside = f"{1 - share:.0%} of {surface.name} lies outside of the texture; {why}"
    if share < _POINTS and _share_of_leaves(texture.level(_COARSE), points) < _LEAVES:
        raise ArgumentError(outside)
    warnings.warn(outside, ModelWarning, stacklevel=4)


def _share_of_leaves(texture: OctreeTexture, points: Float64s) -> float:
    """Return the share of leaves that hold points; merged leaves count as often as cells in them do."""
    cells = 1 << texture.tree.max_depth
    coords = np.unique(np.floor(texture.placement.to_texture_space(points) * cells), axis=0)
    centres = texture.placement.to_rest((coords + 0.5) / cells)
    return np.count_nonzero(texture.contains(centres)) / max(texture.tree.n_leaves, 1)


def _difference(bounds: Float64s, expected: Float64s) -> str:
    """Return how the bounds (2, 3) of a surface differ from those of a texture's surface."""
    extents, expected_extents = bounds[1] - bounds[0], expected[1] - expected[0]
    size, expected_size = float(extents.max()) or 1.0, float(expected_extents.max()) or 1.0
    shape, expected_shape = extents / size, expected_extents / expected_size
    if np.abs(shape - expected_shape).max() < _ALIKE:
        if abs(size / expected_size - 1) > _ALIKE:
            return (
                f"it is {size / expected_size:.4g} times as large as the texture's model: use the same units"
            )
        offset = bounds.mean(axis=0) - expected.mean(axis=0)
        if np.abs(offset).max() > _ALIKE * size:
            listing = ", ".join(f"{step:.4g}" for step in offset.tolist())
            return f"it lies at ({listing}) from the texture's model: move it back"
    elif np.abs(np.sort(shape) - np.sort(expected_shape)).max() < _ALIKE:
        return "its axes are not those of the texture's model: turn it"
    return "is it of another model?"
