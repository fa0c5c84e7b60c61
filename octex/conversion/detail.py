"""The depth in places: by a function, by a channel, or by how a pose stretches the surface."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from octex.arrays import Float32s, Float64s, Int32s, Uint8s, bit_counts
from octex.checks import answer, as_choice
from octex.errors import ArgumentError, ModelError
from octex.source.base import Source, by_channel
from octex.source.corners import at_corners
from octex.source.surface import Surface
from octex.voxelize.fragments import Fragments

#: Returns levels (n,), fractions allowed, at rest positions (n, 3).
DetailFunction: TypeAlias = Callable[[Float64s], npt.ArrayLike]
#: Returns wanted levels (n,), 0 to the tree's depth, at points of triangles (n,) by barycentric coordinates
#: (n, 3), under footprints of these widths (n,) in rest units.
Wanted: TypeAlias = Callable[[Int32s, Float64s, Float32s], Float64s]

STRETCH = "stretch"
#: A channel or a stretch coarsens by 2⁸ at most: the smallest step of 8 bits.
MOST_LEVELS = 8
#: A leaf may be coarser than wanted by this part of a level: 128, a half in 8 bits, must not cost a level.
_SLACK = 0.05
#: This part of the posed area is stretched at most as far as full depth allows. The largest stretch is often
#: a sliver's: compared with it, everything else would be coarse.
_REFERENCE_SHARE = 0.99


def wanted_levels(detail: DetailFunction | str, surface: Surface, depth: int) -> Wanted:
    """Return a function of surface points that returns the wanted levels, in a tree of ``depth`` levels.

    ``detail`` is a function of rest positions (n, 3) in the model's units that returns levels (n,), clipped
    to 0 … depth; any thread may call it. Or the name of a channel of one component in 0 … 1, the resolution
    relative to the finest: 1 means ``depth``, 1/2 a level less, 1/4 two less, and below 1/256 eight less. Or
    "stretch", which evens out the resolution on the posed surface: a triangle's stretch is the largest
    singular value of its map from rest to pose (the sizing of Ptex's faces). 99 % of the posed area is
    stretched at most as far as ``depth`` allows; each half of that stretch costs a level, at most eight.

    Raises ArgumentError for another type, a channel that is not there or has more than one component, and,
    when called, for a function that returns another shape or NaN; ModelError for a surface whose pose has no
    area.
    """
    if callable(detail):
        return partial(_by_function, detail, surface.rest, surface.triangles, depth)
    if not isinstance(detail, str):
        raise ArgumentError(f'detail must be a function, the name of a channel or "stretch", not {detail!r}')
    if detail == STRETCH:
        return partial(_by_stretch, _resolutions(surface), depth)
    forms = {form.name: form for form in surface.channels}
    form = forms[as_choice(detail, [*forms, STRETCH], "detail")]
    if form.components != 1 or form.space != "data":
        raise ArgumentError(f"detail must be a channel with one component in 0 … 1, and {detail!r} is not")
    return partial(_by_channel, surface.with_channels([detail]).source, detail, depth)


# These are partial functions of a module, so that processes can receive them.


def _by_function(
    function: DetailFunction, rest: Float64s, faces: Int32s, depth: int,
    triangles: Int32s, barycentric: Float64s, _widths: Float32s,
) -> Float64s:  # fmt: skip
    points = at_corners(rest, faces[triangles], barycentric)
    levels = answer(function, [points], [(len(points),)], "detail", points.__getitem__)
    return np.asarray(np.clip(levels, 0.0, depth))


def _by_channel(
    source: Source, name: str, depth: int, triangles: Int32s, barycentric: Float64s, widths: Float32s
) -> Float64s:
    values = by_channel(source.channels, source.evaluate(triangles, barycentric, widths))
    return _levels(values[name][:, 0].astype(np.float64), depth)


def _by_stretch(
    resolutions: Float64s, depth: int, triangles: Int32s, _barycentric: Float64s, _widths: Float32s
) -> Float64s:
    return _levels(resolutions[triangles], depth)


def deepest_wanted(wanted: Wanted, fragments: Fragments, widths: Float32s) -> Uint8s:
    """Return the deepest whole level (cells,) that is wanted at a centroid of the fragments in each cell."""
    levels = np.maximum(np.ceil(wanted(fragments.triangles, fragments.barycentric, widths) - _SLACK), 0.0)
    counts = bit_counts(fragments.flags).astype(np.int64)
    of_entries = np.zeros(counts.sum(), np.uint8)
    np.maximum.at(of_entries, fragments.entries, levels.astype(np.uint8))
    deepest: Uint8s = np.maximum.reduceat(of_entries, np.cumsum(counts) - counts)
    return deepest


def _levels(resolutions: Float64s, depth: int) -> Float64s:
    """Return levels for resolutions relative to the finest; NaN gets the finest."""
    known = np.fmax(np.fmin(resolutions, 1.0), 2.0**-MOST_LEVELS)
    return np.asarray(np.maximum(depth + np.log2(known), 0.0))


def _resolutions(surface: Surface) -> Float64s:
    """Return the stretch of each triangle (m,), relative to the stretch at full depth."""
    rest, pose = (positions[surface.triangles] for positions in (surface.rest, surface.vertices))
    along, beside = rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]
    with np.errstate(
        divide="ignore", invalid="ignore"
    ):  # a triangle without rest area is stretched infinitely
        base = np.linalg.norm(along, axis=1)[:, None]
        shift = np.sum(along * beside, axis=1)[:, None] / base
        rise = np.linalg.norm(np.cross(along, beside), axis=1)[:, None] / base
        x = (pose[:, 1] - pose[:, 0]) / base
        y = (pose[:, 2] - pose[:, 0] - x * shift) / rise
        xx, xy, yy = np.sum(x * x, axis=1), np.sum(x * y, axis=1), np.sum(y * y, axis=1)
        stretches = np.sqrt((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy))
    stretches[~np.isfinite(stretches)] = np.inf
    areas = surface.areas()
    order = np.argsort(stretches, kind="stable")
    totals = np.cumsum(areas[order])
    if not totals[-1] > 0:
        raise ModelError(f'{surface.name}: its pose has no area, which detail="stretch" needs')
    reference = stretches[order[np.searchsorted(totals, _REFERENCE_SHARE * totals[-1])]]
    if not 0.0 < reference < np.inf:
        raise ModelError(f'{surface.name}: its rest mesh has no area, which detail="stretch" needs')
    return np.asarray(stretches / reference)
