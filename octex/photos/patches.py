"""Patches: squares of pixels of a picture, each looked at where its middle sees the surface."""

from __future__ import annotations

from functools import reduce

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s
from octex.painting.project import Projected
from octex.painting.sight import Shot
from octex.view.lens import is_bent, undistort

#: Pixels of a patch, each way.
PATCH = 4


def patches_of(shot: Shot) -> tuple[int, int]:
    """Return how many rows and columns of patches a picture has."""
    width, height = shot.levels.sizes[0, 1:].tolist()
    return -(-height // PATCH), -(-width // PATCH)


def widths_of(source: Projected, triangles: Int32s, barycentric: Float64s) -> Float32s:
    """Return how wide patches of the finest picture are at points of the surface, at rest."""
    widths = source.widths(triangles, barycentric)
    return np.where(np.isfinite(widths), PATCH * widths, np.float32(0)).astype(np.float32)


def seen_at(source: Projected, shot: Shot, among: Bools) -> tuple[Int64s, Int32s, Float64s]:
    """Return which patches of some (rows, columns) see the surface in their middle, and what they see."""
    chosen = np.flatnonzero(among)
    y, x = np.divmod(chosen, among.shape[1])
    places = np.column_stack([x + 0.5, y + 0.5]) * PATCH
    places = np.minimum(places, shot.levels.sizes[0, 1:] - 0.5)
    if is_bent(shot.lens):
        bent = np.linalg.solve(shot.K, np.column_stack([places, np.ones(len(places))]).T)[:2].T
        slopes = np.empty_like(bent)
        undistort(shot.lens, np.ascontiguousarray(bent), slopes)
        places = slopes @ shot.camera.K[:2, :2].T + shot.camera.K[:2, 2]
    high, wide = shot.seen.triangle.shape
    inside = np.asarray(np.logical_and(places >= 0, places < [wide, high]).all(axis=1))
    i, j = np.where(inside[:, None], places, 0.0).astype(np.int64).T
    triangles = shot.seen.triangle[j, i]
    found = np.flatnonzero(np.where(inside, triangles, -1) >= 0)
    found = found[np.argsort(triangles[found], kind="stable")]
    seen = triangles[found]
    middles = np.column_stack([i[found], j[found]]) + 0.5
    return chosen[found], seen, source.barycentric_at(shot, seen, middles)


def beside(some: Bools) -> Bools:
    """Say which patches are some, or next to them."""
    return sums_around(some.astype(np.float32)) > 0


def sums_around(values: Float32s, reach: int = 1) -> Float32s:
    """Return the sums of 3 × 3 patches, or of others as far as ``reach``."""
    rows, columns = values.shape
    wide = np.pad(values, reach)
    steps = range(2 * reach + 1)
    sums = reduce(np.add, [wide[i : i + rows] for i in steps])
    found: Float32s = reduce(np.add, [sums[:, j : j + columns] for j in steps])
    return found
