"""Samples that paint is fitted to: those of a conversion, and the centres of pixels."""

from __future__ import annotations

import numpy as np

from octex.conversion.levels import on_grid
from octex.conversion.samples import PLACE_STEPS, SHARE_STEPS, Samples, face_normals
from octex.painting.source import PaintSource
from octex.source.corners import at_corners
from octex.source.surface import Surface
from octex.tree.layout import GRID_BITS
from octex.tree.morton import encode_cells
from octex.tree.placement import Placement

#: How many times as much as other samples of a cell a centre in it counts.
_OUTWEIGH = 16


def with_centres(samples: Samples, source: PaintSource, surface: Surface, placement: Placement) -> Samples:
    """Add a source's centres to samples, where cells are no larger than its detail.

    A picture's pixels say what is at their centres; what lies between is only read from them.
    """
    edge = placement.size / 2**samples.depth
    grid = on_grid(surface.rest, placement)
    owners, places, normals, values = [], [], [], []
    for triangles, barycentric in source.centres():
        fine = source.widths(triangles, barycentric) >= edge
        triangles, barycentric = triangles[fine], barycentric[fine]
        steps = at_corners(grid, surface.triangles[triangles], barycentric)
        steps /= 1 << (GRID_BITS - samples.depth)
        cells = np.floor(steps).astype(np.int64)
        codes = encode_cells(np.clip(cells, 0, (1 << samples.depth) - 1))
        at = np.minimum(np.searchsorted(samples.codes, codes), samples.codes.size - 1)
        there = np.flatnonzero(samples.codes[at] == codes)
        found = source.evaluate(triangles[there], barycentric[there], np.zeros(there.size, np.float32))
        opaque = found[:, -1] > 0
        there = there[opaque]
        within = (steps[there] - cells[there]) * PLACE_STEPS
        owners.append(at[there])
        places.append(np.clip(within, 0, PLACE_STEPS - 1).astype(np.uint16))
        normals.append(face_normals(grid, surface.triangles, triangles[there]))
        values.append(found[opaque].astype(samples.values.dtype))
    if not owners:
        return samples
    own = np.concatenate(owners)
    order = np.argsort(own, kind="stable")
    counts = np.bincount(own, minlength=samples.codes.size)
    shares = samples.shares.copy()
    faint = np.repeat(counts > 0, np.diff(samples.firsts))
    shares[faint] = np.maximum(shares[faint] // _OUTWEIGH, 1)
    ends = samples.firsts[own[order] + 1]
    return samples._replace(
        firsts=samples.firsts + np.concatenate([[0], np.cumsum(counts)]),
        places=np.insert(samples.places, ends, np.concatenate(places)[order], axis=0),
        normals=np.insert(samples.normals, ends, np.concatenate(normals)[order], axis=0),
        shares=np.insert(shares, ends, np.uint8(SHARE_STEPS)),
        values=np.insert(samples.values, ends, np.concatenate(values)[order], axis=0),
    )
