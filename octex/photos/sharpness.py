"""How sharp pictures are beside others: a blurred one counts as if its pixels were as wide as the blur.

Read at two widths, a picture tells of detail between them. What of a picture's detail the others show too is
the surface's: noise, and what only one of them saw, sums to nothing. A picture that shows less of it than
others do of theirs at the same points is blurred, or lies out of place.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s
from octex.painting.project import Projected
from octex.photos.patches import batches
from octex.source.surface import Surface

#: Points of the surface that are looked at.
_POINTS = 40_000
#: Detail is what lies between so many pixels and twice that, of the coarsest picture that counts.
_WIDTH = 2.0
#: With how many others a picture is compared at least: of two none is right.
_OTHERS = 2
#: What counts for less at a point than so much of what counts most is left out: pixels 1.8 times as wide.
_LEAST_WEIGHT = 0.3
#: What shows so much of the detail is sharp: the surface is seen from other sides.
_SHARP = 0.7
#: What shows more detail than so many times the others' mean sees something else there.
_MOST = 2.0
#: Detail of less than a code tells of little: smooth things are shaded otherwise from elsewhere.
_LITTLE = 1.0 / 255.0
#: Standard errors by which a picture must show less detail than others to be blurred.
_ERRORS = 2.0
#: A Gaussian blur of s pixels leaves exp(−s² / 3) of the detail, as measured at s = 1 and 2.
_FALL = 3.0
#: Rounds in which pictures that are not sharp are left out of what others are compared with.
_ROUNDS = 4


class Details(NamedTuple):
    """What pictures show at points that several of them see."""

    shots: Int64s  # (n,)   the picture
    points: Int64s  # (n,)   the point
    values: Float32s  # (n, 3)   its detail there, of square roots of light


def weighed_by_sharpness(source: Projected, surface: Surface) -> Projected:
    """Return the same paint, blurred pictures counting by their variance; a sharp pixel's is 1/12."""
    if len(source.shots) <= _OTHERS:
        return source
    shown = shown_of(details_of(source, surface), len(source.shots))
    blurs = -_FALL * np.log(np.clip(shown / _SHARP, 1e-3, 1.0))  # variances
    weights = ((1.0 + 12.0 * blurs) ** -4.0).tolist()
    return source.with_shots(
        [shot._replace(weight=weight) for shot, weight in zip(source.shots, weights, strict=True)]
    )


def shown_of(details: Details, count: int) -> Float64s:
    """Return how much of the sharp pictures' detail each of ``count`` shows; 1 where that is not known."""
    details = _within_others(details)
    is_sharp = np.ones(count, np.bool_)
    for _ in range(_ROUNDS):
        shown = _beside(details, is_sharp)
        before, is_sharp = is_sharp, shown >= _SHARP
        if (is_sharp == before).all():
            break
    return shown


def _within_others(details: Details) -> Details:
    """Return details no larger than `_MOST` times the mean of what the others show at the point."""
    _, points, values = details
    lengths = np.linalg.norm(values.astype(np.float64), axis=1)
    others = np.bincount(points)[points] - 1
    most = _MOST * np.maximum(np.bincount(points, lengths)[points] - lengths, 0.0) / np.maximum(others, 1)
    factors = np.minimum(most / np.maximum(lengths, 1e-300), 1.0)
    return details._replace(values=(values * factors[:, None]).astype(np.float32))


def _beside(details: Details, is_sharp: Bools) -> Float64s:
    """Return how much of the detail that the sharp others show each picture shows (shots,)."""
    shots, points, values = details
    weights = is_sharp[shots].astype(np.float64)
    others = np.bincount(points, weights)[points] - weights
    share = np.maximum(others, 1.0)
    own = np.zeros(shots.size)
    for value in values.T:
        own += value * (np.bincount(points, weights * value)[points] - weights * value) / share
    their = (np.bincount(points, weights * own)[points] - weights * own) / share
    some = others >= _OTHERS
    sums, squares, of_others, their_squares = (
        np.bincount(shots[some], each[some], len(is_sharp)) for each in (own, own**2, their, their**2)
    )
    little = np.bincount(shots[some], minlength=len(is_sharp)) * _LITTLE**2
    most = np.maximum(sums + _ERRORS * np.sqrt(squares) + little, 0.0)
    least = of_others - _ERRORS * np.sqrt(their_squares) + little
    found: Float64s = np.divide(most, least, out=np.ones(len(is_sharp)), where=least > 0.0)
    return found


def details_of(source: Projected, surface: Surface) -> Details:
    """Return what pictures show at points of the surface."""
    samples = surface.scatter(_POINTS)
    parts = []
    for some in batches(_POINTS, len(source.shots)):
        part = _details_at(source, samples.triangles[some], samples.barycentric[some])
        parts.append(part._replace(points=part.points + some.start))
    return Details(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _details_at(source: Projected, triangles: Int32s, barycentric: Float64s) -> Details:
    where = triangles, barycentric
    _, weights = source.each(*where, np.zeros(len(triangles), np.float32))
    counts = weights > _LEAST_WEIGHT
    counts &= counts.sum(axis=0) > _OTHERS
    coarsest = np.zeros(len(triangles), np.float32)
    for number, shot in enumerate(source.shots):
        widths = source.with_shots([shot]).widths(*where)
        coarsest = np.where(counts[number], np.maximum(coarsest, widths), coarsest)
    fine, coarse = (
        np.sqrt(np.maximum(source.each(*where, np.float32(width) * coarsest)[0][counts], np.float32(0)))
        for width in (_WIDTH, 2 * _WIDTH)
    )
    shots, points = np.nonzero(counts)
    return Details(shots, points, fine - coarse)
