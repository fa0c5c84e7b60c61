"""Masks of what only one image saw, where several images see the surface.

Each image is cut into patches. The images that see a patch's point vote on its mode, the colour that most
of them are near to; all are read as wide as the patch. A patch saw something else, a passer-by or a
reflection, if its colour is far from all lines between its mode and its neighbours' modes: detail that is a
little displaced lies on these lines. An image is masked where enough patches saw something else, and in all
patches connected to them. Where at most two images see the surface, a patch counts as the known patch does
from which the image's colours change least on the way: other objects end at edges of the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial

import numpy as np

from octex.arrays import Float32s
from octex.conversion.large import NOT_STORED, Stages
from octex.jit import inlined, kernel
from octex.painting.project import Projected
from octex.parallel import ordered_map, sharing
from octex.photos.patches import (
    batches,
    colors_of,
    grown,
    patches_of,
    put_mask,
    seen_at,
    sums_around,
    widths_of,
)
from octex.source.surface import Surface

#: An image is compared with at most _MOST, itself included: those that share most of the surface with it, by
#: _POINTS points. Comparing all of a hundred would take six times as long.
_MOST, _POINTS = 17, 4000
#: Least number of images for a mode: two alone cannot decide.
_LEAST = 3
#: An image votes with this power of its weight, so that three oblique views outvote a frontal one.
_VOTE = 0.5
#: Noise and displacement limit the differences: this multiple of their quantile, within these bounds in
#: 1/255, separates them from other objects.
_TIMES, _QUANTILE, _LEAST_FAR, _MOST_FAR = 3.0, 0.9, 16.0, 40.0
#: Distance in 1/255 at which colours support each other by a fourth.
_APART = 10.0
#: A mode needs support from others: this part of the image's own vote.
_SUPPORT = 0.5
#: A patch differs if more than this part of its surroundings is far off.
_MAJORITY = 0.5
#: Cost in 1/255 of a step from patch to patch, besides that of the difference of their colours.
_STEP = 4.0
#: Differing patches are masked if most of the 5 × 5 around one of them, and at least this many, are far off.
_CERTAIN = 8


def agreeing(
    source: Projected, surface: Surface, executor: Executor, stages: Stages = NOT_STORED
) -> Projected:
    """Mask the images of ``source``, in place, where they disagree with the others; return it."""
    numbers, compared = range(len(source.shots)), _compared(source, surface)

    def differences(number: int) -> Float32s:
        stage, measure = stages.of(lambda: [number]), partial(_differences, source, compared[number], number)
        return stage.arrays("differences", lambda: {"codes": measure()})["codes"]

    def mask(number: int) -> None:
        shot = source.shots[number]
        put_mask(shot.mips, _mask(off_by[number], as_codes(colors_of(shot)), far))

    with sharing(executor) as pool:
        off_by = list(ordered_map(pool, differences, numbers))
        known = np.concatenate([each[np.isfinite(each)] for each in off_by])
        if known.size:
            far = float(np.clip(_TIMES * np.quantile(known, _QUANTILE), _LEAST_FAR, _MOST_FAR))
            list(ordered_map(pool, mask, numbers))
    return source


def _compared(source: Projected, surface: Surface) -> list[list[int]]:
    """Return the images to compare each one with, itself included: those that share most with it."""
    count = len(source.shots)
    if count <= _MOST:
        return [list(range(count))] * count
    points = surface.scatter(_POINTS)
    where = points.triangles, points.barycentric
    _, weights = source.each(*where, np.zeros(_POINTS, np.float32))
    sees = (weights > 0.0).astype(np.float32)
    shared = sees @ sees.T
    np.fill_diagonal(shared, np.inf)
    nearest = np.argsort(-shared, axis=1, kind="stable")[:, :_MOST]
    return [sorted(row[shared[number, row] > 0.0].tolist()) for number, row in enumerate(nearest)]


def _differences(source: Projected, compared: Sequence[int], number: int) -> Float32s:
    """Return the difference of an image from the modes, per patch in 1/255; NaN where unknown."""
    shot, row = source.shots[number], compared.index(number)
    rows, columns = patches_of(shot)
    codes, modes = np.full((2, rows * columns, 3), np.nan, np.float32)
    patches, triangles, barycentric = seen_at(source, shot, np.ones((rows, columns), np.bool_))
    own_paint = source.with_shots([shot])
    source = source.with_shots([source.shots[each] for each in compared])
    for batch in batches(len(patches), len(compared)):
        where = triangles[batch], barycentric[batch]
        colors, weights = source.each(*where, widths_of(own_paint, *where))
        batch_modes = np.empty_like(colors[row])
        find_modes(colors, weights, row, batch_modes)
        codes[patches[batch]], modes[patches[batch]] = as_codes(colors[row]), batch_modes
    return off_modes(codes.reshape(rows, columns, 3), modes.reshape(rows, columns, 3))


def as_codes(colors: Float32s) -> Float32s:
    """Return 255 times the square root of light."""
    codes: Float32s = np.float32(255.0) * np.sqrt(np.maximum(colors, np.float32(0.0)))
    return codes


@kernel
def off_modes(codes: Float32s, modes: Float32s) -> Float32s:
    """Return the distances of codes from the lines between a patch's mode and its neighbours' modes."""
    rows, columns = modes.shape[:2]
    distances = np.full((rows, columns), np.float32(np.nan))
    for row in range(rows):
        for column in range(columns):
            a, b, c = modes[row, column, 0], modes[row, column, 1], modes[row, column, 2]
            x, y, z = codes[row, column, 0] - a, codes[row, column, 1] - b, codes[row, column, 2] - c
            least = max(abs(x), abs(y), abs(z))
            if np.isnan(least):
                continue
            for i in range(max(row - 1, 0), min(row + 2, rows)):
                for j in range(max(column - 1, 0), min(column + 2, columns)):
                    u, v, w = modes[i, j, 0] - a, modes[i, j, 1] - b, modes[i, j, 2] - c
                    if not np.isnan(u):
                        part = (x * u + y * v + z * w) / max(u * u + v * v + w * w, np.float32(1e-6))
                        part = min(max(part, np.float32(0.0)), np.float32(1.0))
                        least = min(least, max(abs(x - part * u), abs(y - part * v), abs(z - part * w)))
            distances[row, column] = least
    return distances


@inlined
def _apart(codes: Float32s, i: int, j: int) -> float:
    """Return the largest difference of two colours' components, in codes."""
    most = np.float32(0.0)
    for component in range(3):
        most = max(most, abs(codes[i, component] - codes[j, component]))
    return float(most)


@inlined
def nearness_of(codes: float) -> float:
    """Return how much colours this many codes apart support each other: 1 … 0 (Geman & McClure 1985)."""
    share = codes / _APART
    return float(1.0 / (1.0 + share * share) ** 2)


@kernel
def find_modes(colors: Float32s, weights: Float32s, image: int, modes: Float32s) -> None:
    """Write the codes (n, 3) of each point's mode, the colour with the most support; NaN if unknown."""
    count = len(weights)
    codes, votes, supports = np.empty((count, 3), np.float32), np.empty(count), np.empty(count)
    for n in range(len(modes)):
        modes[n] = np.nan
        if not weights[image, n] > 0.0:
            continue
        several = 0
        largest = np.float32(0.0)
        for i in range(count):
            if weights[i, n] > 0.0:
                several += 1
                largest = max(largest, weights[i, n])
        if several < _LEAST:
            continue
        for i in range(count):
            votes[i] = np.float64(weights[i, n] / largest) ** _VOTE if weights[i, n] > 0.0 else 0.0
            supports[i] = votes[i]
            for component in range(3):
                light = max(colors[i, n, component], np.float32(0.0))
                codes[i, component] = np.float32(255.0) * np.sqrt(light)
            for j in range(i if votes[i] > 0.0 else 0):
                if votes[j] > 0.0:
                    near = nearness_of(_apart(codes, i, j))
                    supports[i] += votes[j] * near
                    supports[j] += votes[i] * near
        best = 0
        for i in range(count):
            if supports[i] > supports[best]:
                best = i
        if supports[best] - votes[best] >= _SUPPORT * votes[best]:
            for component in range(3):
                modes[n, component] = codes[best, component]


def _mask(differences: Float32s, colors: Float32s, far: float) -> Float32s:
    """Return a mask (rows, columns), 1 on patches that agree with the others, else 0."""
    known = np.isfinite(differences)
    is_far = np.where(known, np.nan_to_num(differences) > far, False).astype(np.float32)
    sees = known.astype(np.float32)
    around = sums_around(sees)
    share = np.where(known, sums_around(is_far) / np.maximum(around, np.float32(1e-9)), np.float32(np.nan))
    fill_unknown(share, colors)
    unlike = share > _MAJORITY
    far_around = sums_around(is_far, 2)
    group = unlike & (far_around >= _CERTAIN) & (far_around > _MAJORITY * sums_around(sees, 2))
    count = -1
    while count < group.sum():  # all that hangs together
        count = group.sum()
        group = grown(group) & unlike
    mask: Float32s = (~grown(group)).astype(np.float32)
    return mask


@kernel
def fill_unknown(values: Float32s, codes: Float32s) -> None:
    """Replace NaN, in place, by the nearest known value; steps cost more across edges of ``codes``.

    ``values`` has shape (rows, columns), ``codes`` (rows, columns, components); all NaN stay NaN.
    """
    rows, columns = values.shape
    costs = np.where(np.isnan(values), np.float32(np.inf), np.float32(0.0))
    has_changed = True
    while has_changed:  # sweeps, forward and backward
        has_changed = False
        for side in (1, -1):
            for number in range(rows * columns):
                place = number if side > 0 else rows * columns - 1 - number
                i, j = place // columns, place % columns
                for k in range(4):  # the neighbours that this sweep has passed
                    row, column = (i, j - side) if k == 3 else (i - side, j + k - 1)
                    if not (0 <= row < rows and 0 <= column < columns and costs[row, column] < costs[i, j]):
                        continue
                    edge = np.float32(0.0)
                    for component in range(codes.shape[2]):
                        edge = max(edge, abs(codes[i, j, component] - codes[row, column, component]))
                    cost = costs[row, column] + edge + np.float32(_STEP)
                    if cost < costs[i, j]:
                        costs[i, j], values[i, j], has_changed = cost, values[row, column], True
