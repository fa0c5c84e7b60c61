"""Measures how sharp images are: a blurred image counts as if its pixels were as wide as the blur.

An image read at two widths shows the detail between them. Detail that other images show too belongs to the
surface: noise, and things that only one image saw, cancel on average. An image that shows less detail than
others at the same points is blurred or misplaced.
"""

from __future__ import annotations

from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s
from octex.painting.project import Projected
from octex.parallel import ordered_map, sharing
from octex.photos.patches import batches
from octex.source.surface import Surface

#: Points of the surface that are read.
_POINTS = 40_000
#: Detail lies between this many pixels and twice that, of the coarsest image that counts.
_WIDTH = 2.0
#: Least number of other images to compare with: two alone cannot decide.
_OTHERS = 2
#: An image counts at a point if it has this part of the largest weight: pixels up to 1.8 times as wide.
_LEAST_WEIGHT = 0.3
#: An image that shows this part of the detail is sharp: directions of view differ.
_SHARP = 0.7
#: Detail above this multiple of the others' mean is another object, and is limited to it.
_MOST = 2.0
#: Detail below 1/255 does not count: shading of smooth surfaces changes with direction.
_LITTLE = 1.0 / 255.0
#: A blurred image shows less detail than others by this many standard errors.
_ERRORS = 2.0
#: A Gaussian blur of s pixels leaves exp(−s² / 3) of the detail, measured at s = 1 and 2.
_FALL = 3.0
#: Rounds in which blurred images are removed from the comparison.
_ROUNDS = 4


class Details(NamedTuple):
    """The images' detail at points that several of them see."""

    shots: Int64s  # (n,)   the image
    points: Int64s  # (n,)   the point
    values: Float32s  # (n, 3)   its detail there, of square roots of light


def weighed_by_sharpness(source: Projected, surface: Surface, executor: Executor) -> Projected:
    """Return the same paint with blurred images weighted by their variance; a sharp pixel's is 1/12."""
    if len(source.shots) <= _OTHERS:
        return source
    shown = shown_of(details_of(source, surface, executor), len(source.shots))
    blurs = -_FALL * np.log(np.clip(shown / _SHARP, 1e-3, 1.0))  # variances
    weights = ((1.0 + 12.0 * blurs) ** -4.0).tolist()
    return source.with_shots(
        [shot._replace(weight=weight) for shot, weight in zip(source.shots, weights, strict=True)]
    )


def shown_of(details: Details, count: int) -> Float64s:
    """Return which part of the sharp images' detail each of ``count`` shows; 1 if unknown."""
    details = _within_others(details)
    is_sharp = np.ones(count, np.bool_)
    for _ in range(_ROUNDS):
        shown = _compared(details, is_sharp)
        before, is_sharp = is_sharp, shown >= _SHARP
        if (is_sharp == before).all():
            break
    return shown


def _within_others(details: Details) -> Details:
    """Limit each detail to `_MOST` times the mean of the other images' at the point."""
    _, points, values = details
    lengths = np.linalg.norm(values.astype(np.float64), axis=1)
    others = np.bincount(points)[points] - 1
    most = _MOST * np.maximum(np.bincount(points, lengths)[points] - lengths, 0.0) / np.maximum(others, 1)
    factors = np.minimum(most / np.maximum(lengths, 1e-300), 1.0)
    return details._replace(values=(values * factors[:, None]).astype(np.float32))


def _compared(details: Details, is_sharp: Bools) -> Float64s:
    """Return which part of the sharp others' detail each image shows (shots,)."""
    shots, points, values = details
    weights = is_sharp[shots].astype(np.float64)
    others = np.bincount(points, weights)[points] - weights
    share = np.maximum(others, 1.0)
    shared = np.zeros(shots.size)
    for value in values.T:
        shared += value * (np.bincount(points, weights * value)[points] - weights * value) / share
    theirs = (np.bincount(points, weights * shared)[points] - weights * shared) / share
    known = others >= _OTHERS
    sums, squares, of_others, their_squares = (
        np.bincount(shots[known], each[known], len(is_sharp))
        for each in (shared, shared**2, theirs, theirs**2)
    )
    little = np.bincount(shots[known], minlength=len(is_sharp)) * _LITTLE**2
    most = np.maximum(sums + _ERRORS * np.sqrt(squares) + little, 0.0)
    least = of_others - _ERRORS * np.sqrt(their_squares) + little
    parts: Float64s = np.divide(most, least, out=np.ones(len(is_sharp)), where=least > 0.0)
    return parts


def details_of(source: Projected, surface: Surface, executor: Executor) -> Details:
    """Read images at points of the surface."""
    samples = surface.scatter(_POINTS)

    def read(batch: slice) -> Details:
        part = _details_at(source, samples.triangles[batch], samples.barycentric[batch])
        return part._replace(points=part.points + batch.start)

    with sharing(executor) as pool:
        parts = list(ordered_map(pool, read, list(batches(_POINTS, len(source.shots)))))
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
