"""Triangles that lie on a point or a line of a map, as those of low-poly models do on a palette's texels."""

from __future__ import annotations

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s
from octex.baking.layout import Layout, doubled_areas
from octex.source.corners import at_corners

#: Twice the area of flat triangles, at most, in texels.
_FLAT = 1e-9
#: Points on one, and more for each texel of its length; those on all, at most, beside the former.
_POINTS, _ALONG, _MOST = 16, 4, 1 << 22


def are_flat(layout: Layout) -> Bools:
    """Say which triangles of a layout (k,) are flat in the map."""
    found: Bools = np.abs(doubled_areas(layout.corners)) <= _FLAT
    return found


def points_on(layout: Layout) -> tuple[Int64s, Float64s]:
    """Return points that follow each other evenly on flat triangles: of which they are, and barycentric."""
    lengths = np.ptp(layout.corners, axis=1).max(axis=1)
    along = _ALONG * lengths * min(1.0, _MOST / max(_ALONG * float(lengths.sum()), 1.0))
    counts = _POINTS + along.astype(np.int64)
    own = np.repeat(np.arange(counts.size), counts)
    number = np.arange(own.size) - np.repeat(np.cumsum(counts) - counts, counts)
    # The sequence R2: whole multiples of two powers of the plastic number's inverse.
    root, part = np.sqrt(number * 0.7548776662466927 % 1.0), number * 0.5698402909980532 % 1.0
    return own, np.stack([1.0 - root, root * (1.0 - part), root * part], axis=1)


def means_at_texels(
    layout: Layout, own: Int64s, barycentric: Float64s, values: Float32s, areas: Float64s
) -> tuple[Int32s, Float32s]:
    """Return the texels that points (n,) are read from, each one's four, and their means by area (t, lanes).

    ``own`` are the triangles of the points, ``areas`` (k,) those of the triangles on the surface.
    """
    corners = layout.corners.reshape(-1, 2)
    rows = 3 * own[:, None] + np.arange(3)
    columns, lines = np.floor(at_corners(corners, rows, barycentric) - 0.5).astype(np.int64).T
    read = [
        np.clip(lines + down, 0, layout.height - 1) * layout.width
        + np.clip(columns + right, 0, layout.width - 1)
        for down, right in np.ndindex(2, 2)
    ]
    texels, which = np.unique(np.concatenate(read), return_inverse=True)
    weights = np.tile((areas / np.maximum(np.bincount(own, minlength=areas.size), 1))[own], 4)
    totals = np.maximum(np.bincount(which, weights), 1e-300)
    lanes = [np.bincount(which, weights * np.tile(lane, 4)) / totals for lane in values.T]
    return texels.astype(np.int32), np.stack(lanes, axis=1).astype(np.float32)
