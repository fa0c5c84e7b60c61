"""Which pictures agree where several see the surface: masks without what only one of them saw.

A picture is looked at in patches. At each the colours of all pictures that see that place, as wide as the
patch, have a mode: the colour that most of them are near to. A picture whose colour is far from all between
that mode and those of the next patches saw something else, a passer-by or a reflection: detail that is a
little out of place lies between them. It is masked where enough patches say so, and in all that hangs
together with them; where no more than two see, as it is around. What is masked in all of them no picture has
seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial

import numpy as np

from octex.arrays import Bools, Float32s
from octex.conversion import large
from octex.jit import inlined, kernel
from octex.painting.project import Projected
from octex.painting.resume import NOT_STORED, Stages
from octex.parallel import ordered_map, sharing
from octex.photos.patches import batches, beside, masked, patches_of, seen_at, sums_around, widths_of
from octex.source.surface import Surface

#: A picture is compared with no more than so many, itself among them: those that see most of what it sees,
#: of so many points of the surface. Of a hundred, all would take six times as long.
_MOST, _POINTS = 17, 4000
#: Of how many pictures the mode is sought at least: of two none is right.
_LEAST = 3
#: A picture's vote grows with its weight, by this power: three that see a place aslant outvote one ahead.
_VOTE = 0.5
#: Pictures differ by noise, and by what is out of place: more than so many times this quantile of their
#: differences is another thing, which lies in this range of codes.
_TIMES, _QUANTILE, _LEAST_FAR, _MOST_FAR = 3.0, 0.9, 16.0, 40.0
#: So far apart, in codes, colours support each other by a fourth.
_APART = 10.0
#: A mode is none unless others vote so too: this much of the picture's own vote.
_SUPPORT = 0.5
#: Patches are unlike the others where so much of what is around is far off; where that is not known,
#: where so much of it is filled in.
_MAJORITY, _FILLED = 0.5, 0.3
#: They are masked if most of the 5 × 5 patches around one of them, and at least so many, are far off.
_CERTAIN = 8


def agreeing(
    source: Projected, surface: Surface, executor: Executor, stages: Stages = NOT_STORED
) -> Projected:
    """Mask the pictures of ``source``, in its list, where they do not agree with the others; return it."""
    numbers, compared = range(len(source.shots)), _compared(source, surface)
    with sharing(executor) as pool:
        found = list(ordered_map(pool, partial(_stored_differences, source, compared, stages), numbers))
    known = np.concatenate([each[np.isfinite(each)] for each in found])
    if not known.size:
        return source
    far = float(np.clip(_TIMES * np.quantile(known, _QUANTILE), _LEAST_FAR, _MOST_FAR))

    for number in numbers:  # one after the other: masked and as they were, all would take twice the memory
        shot, mask = source.shots[number], _mask(found[number], far)
        if not mask.all():
            source.shots[number] = shot._replace(mips=large.moved(masked(shot.mips, mask)))
    return source


def _compared(source: Projected, surface: Surface) -> list[list[int]]:
    """Return which pictures each is compared with, itself among them: those that share most with it."""
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
    return [sorted(own[shared[number, own] > 0.0].tolist()) for number, own in enumerate(nearest)]


def _stored_differences(
    source: Projected, compared: Sequence[Sequence[int]], stages: Stages, number: int
) -> Float32s:
    own = stages.of(lambda: [number])
    return own.arrays("differences", lambda: {"codes": _differences(source, compared[number], number)})[
        "codes"
    ]


def _differences(source: Projected, compared: Sequence[int], number: int) -> Float32s:
    """Return by how many codes a picture is off what most say, per patch; NaN where that is not known."""
    shot, own = source.shots[number], compared.index(number)
    rows, columns = patches_of(shot)
    codes, modes = np.full((2, rows * columns, 3), np.nan, np.float32)
    patches, triangles, barycentric = seen_at(source, shot, np.ones((rows, columns), np.bool_))
    alone = source.with_shots([shot])
    source = source.with_shots([source.shots[each] for each in compared])
    for some in batches(len(patches), len(compared)):
        where = triangles[some], barycentric[some]
        colors, weights = source.each(*where, widths_of(alone, *where))
        found = np.empty_like(colors[own])
        find_modes(colors, weights, own, found)
        codes[patches[some]], modes[patches[some]] = as_codes(colors[own]), found
    return off_modes(codes.reshape(rows, columns, 3), modes.reshape(rows, columns, 3))


def as_codes(colors: Float32s) -> Float32s:
    """Return codes, of a square root of light."""
    found: Float32s = np.float32(255.0) * np.sqrt(np.maximum(colors, np.float32(0.0)))
    return found


@kernel
def off_modes(codes: Float32s, modes: Float32s) -> Float32s:
    """Return how far codes are from the lines between a patch's mode and its neighbours' (rows, columns)."""
    rows, columns = modes.shape[:2]
    found = np.full((rows, columns), np.float32(np.nan))
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
            found[row, column] = least
    return found


@inlined
def _apart(codes: Float32s, i: int, j: int) -> float:
    """Return by how many codes two colours differ in their worst component."""
    most = np.float32(0.0)
    for component in range(3):
        most = max(most, abs(codes[i, component] - codes[j, component]))
    return float(most)


@inlined
def nearness_of(codes: float) -> float:
    """Return how much colours so many codes apart support each other: 1 … 0 (Geman & McClure 1985)."""
    share = codes / _APART
    return float(1.0 / (1.0 + share * share) ** 2)


@kernel
def find_modes(colors: Float32s, weights: Float32s, own: int, found: Float32s) -> None:
    """Write the codes (n, 3) of each point's mode, the colour that most votes support; NaN if unknown."""
    count = len(weights)
    codes, votes, supports = np.empty((count, 3), np.float32), np.empty(count), np.empty(count)
    for n in range(len(found)):
        found[n] = np.nan
        if not weights[own, n] > 0.0:
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
                found[n, component] = codes[best, component]


def _mask(differences: Float32s, far: float) -> Float32s:
    """Return a mask (rows, columns), 0 or 1, of patches that are near what most say."""
    known = np.isfinite(differences)
    if not known.any():
        return np.ones(differences.shape, np.float32)
    is_far = np.where(known, np.nan_to_num(differences) > far, False).astype(np.float32)
    sees = known.astype(np.float32)
    share = sums_around(is_far) / np.maximum(sums_around(sees), np.float32(1e-9))
    unlike = _filled(np.where(known, share, 0), known) > np.where(known, _MAJORITY, _FILLED)
    say = sums_around(is_far, 2)
    group = unlike & (say >= _CERTAIN) & (say > _MAJORITY * sums_around(sees, 2))
    count = -1
    while count < group.sum():  # all that hangs together
        count = group.sum()
        group = beside(group) & unlike
    found: Float32s = (~beside(group)).astype(np.float32)
    return found


def _filled(values: Float32s, known: Bools) -> Float32s:
    """Fill what is not known by push and pull (Gortler et al., "The Lumigraph", 1996)."""
    if known.all() or min(values.shape) < 2:
        return values if known.all() else np.where(known, values, values[known].mean() if known.any() else 0)
    rows, columns = values.shape
    pad = ((0, rows % 2), (0, columns % 2))
    shape = (rows + 1) // 2, 2, (columns + 1) // 2, 2
    weights = np.pad(known.astype(np.float32), pad).reshape(shape).sum(axis=(1, 3))
    sums = np.pad(np.where(known, values, 0), pad).reshape(shape).sum(axis=(1, 3))
    coarse = _filled((sums / np.maximum(weights, 1)).astype(np.float32), weights > 0)
    above = np.repeat(np.repeat(coarse, 2, axis=0), 2, axis=1)[:rows, :columns]
    found: Float32s = np.where(known, values, above)
    return found
