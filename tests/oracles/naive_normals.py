"""The slow, obvious way to a leaf's normal."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from octex.tree.layout import AREA_ONE, AREA_STEPS, FACING_FLAGS
from octex.tree.morton import decode_cells
from octex.tree.octree import Octree

AXES = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], float)


def estimate_normals(tree: Octree, radius: int = 4) -> npt.NDArray[np.float64]:
    """Normals of all leaves of a tree whose leaves are all at the deepest level, in Morton order."""
    level = tree.max_depth
    centres = decode_cells(tree.level_codes(level)) + 0.5
    first = tree.arrays.level_cells[level]
    facings = [[f for f in range(6) if flags >> f & 1] for flags in tree.arrays.flags[first:] & FACING_FLAGS]
    areas = 2.0 ** ((np.maximum(tree.arrays.areas[first:], 1).astype(float) - AREA_ONE) / AREA_STEPS)
    normals = np.empty(centres.shape)
    for n, centre in enumerate(centres):
        offsets = centres - centre
        weights = areas * np.maximum(0, 1 - (offsets**2).sum(axis=1) / radius**2)
        own = facings[n]
        for other in np.flatnonzero(weights):
            theirs = facings[other]
            if theirs and all(facing ^ 1 in own and facing not in own for facing in theirs):
                weights[other] = 0
        mean = weights @ offsets / weights.sum()
        values, vectors = np.linalg.eigh(
            (weights[:, None] * offsets).T @ offsets / weights.sum() - np.outer(mean, mean)
        )
        has_direction = (values[1] - values[0]) * (values[2] - values[0]) > 1e-4 * values.mean() ** 2
        estimate = vectors[:, 0] if has_direction else np.zeros(3)
        outward = AXES[own].sum(axis=0)
        least = 0.4
        if not outward.any() and own:
            outward, least = AXES[own[0]], 0.0
        if not outward.any():
            normals[n] = estimate if has_direction else (0, 0, 1)
            continue
        outward /= np.linalg.norm(outward)
        agreement = estimate @ outward
        trusted = has_direction and abs(agreement) >= least
        normals[n] = (estimate if agreement >= 0 else -estimate) if trusted else outward
    return normals
