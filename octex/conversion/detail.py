"""How deep to go where: by hand, by a painted channel, or by how a pose stretches the surface."""

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

#: Says how deep to go at rest positions (n, 3): levels (n,), fractions allowed.
DetailFunction: TypeAlias = Callable[[Float64s], npt.ArrayLike]
#: Gives wanted levels (n,), 0 to the tree's depth, at points of triangles with barycentric coordinates (n, 3)
#: and footprints of given widths (n,) in rest units.
Wanted: TypeAlias = Callable[[Int32s, Float64s, Float32s], Float64s]

STRETCH = "stretch"
#: Neither a channel nor a stretch makes cells wider than 2⁸ of the finest: the least that 8 bits can say.
MOST_LEVELS = 8
#: By so much the level of a leaf may fall short: 128, a half in 8 bits, must not take a whole level more.
_SLACK = 0.05
#: The part of the posed surface that is stretched less than what gets the full depth. The largest stretch of
#: all is often a sliver's, beside which everything else would be coarse.
_REFERENCE_SHARE = 0.99


def channel_of(detail: DetailFunction | str | None) -> str | None:
    """Return the name of the channel that ``detail`` reads, if it reads one."""
    return detail if isinstance(detail, str) and detail != STRETCH else None


def wanted_levels(detail: DetailFunction | str, surface: Surface, depth: int) -> Wanted:
    """Return what says how deep to go on a surface, in a tree of ``depth`` levels.

    ``detail`` is a function of rest positions (n, 3) in the model's units that returns levels (n,), cut to
    0 … depth; it is called from any number of threads. Or the name of a channel of one component in 0 … 1:
    the resolution relative to the finest, so that 1 goes to ``depth``, 1/2 a level less, 1/4 two less, and
    what is below 1/256 eight less. Or "stretch": the resolution on the posed surface is evened out. The
    largest singular value of a triangle's map from rest to pose is its stretch (the sizing of Ptex's faces);
    ``depth`` goes to the stretch that 99 % of the posed area does not exceed, and elsewhere a level less for
    each half of it, at most eight.

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


def deepest_wanted(wanted: Wanted, fragments: Fragments, widths: Float32s) -> Uint8s:
    """Return the whole level (cells,) that the middles of the fragments in each cell want to go to."""
    levels = np.maximum(np.ceil(wanted(fragments.triangles, fragments.barycentric, widths) - _SLACK), 0.0)
    counts = bit_counts(fragments.flags).astype(np.int64)
    of_entries = np.zeros(counts.sum(), np.uint8)
    np.maximum.at(of_entries, fragments.entries, levels.astype(np.uint8))
    deepest: Uint8s = np.maximum.reduceat(of_entries, np.cumsum(counts) - counts)
    return deepest


def _by_function(
    function: DetailFunction,
    rest: Float64s,
    faces: Int32s,
    depth: int,
    triangles: Int32s,
    barycentric: Float64s,
    _widths: Float32s,
) -> Float64s:
    points = at_corners(rest, faces[triangles], barycentric)
    levels = answer(function, [points], [(len(points),)], "detail", points.__getitem__)
    clipped: Float64s = np.clip(levels, 0.0, depth)
    return clipped


def _by_channel(
    source: Source,
    name: str,
    depth: int,
    triangles: Int32s,
    barycentric: Float64s,
    widths: Float32s,
) -> Float64s:
    values = by_channel(source.channels, source.evaluate(triangles, barycentric, widths))
    return _levels(values[name][:, 0].astype(np.float64), depth)


def _by_stretch(
    resolutions: Float64s,
    depth: int,
    triangles: Int32s,
    _barycentric: Float64s,
    _widths: Float32s,
) -> Float64s:
    return _levels(resolutions[triangles], depth)


def _levels(resolutions: Float64s, depth: int) -> Float64s:
    """Return levels for resolutions relative to the finest."""
    known = np.fmax(np.fmin(resolutions, 1.0), 2.0**-MOST_LEVELS)  # the finest for what is not a number
    levels: Float64s = np.maximum(depth + np.log2(known), 0.0)
    return levels


def _resolutions(surface: Surface) -> Float64s:
    """Return the stretch of each triangle (m,), relative to what gets the full depth."""
    rest, pose = (positions[surface.triangles] for positions in (surface.rest, surface.vertices))
    along, beside = rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):  # at rest without area: stretched without end
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
    resolutions: Float64s = stretches / reference
    return resolutions
