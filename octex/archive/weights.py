"""The weights of guesses, fitted to a texture by least squares."""

from __future__ import annotations

import numpy as np

from octex.archive.around import ABOUT, OWN, around_children, around_nodes
from octex.archive.layout import Block, Form, Place
from octex.archive.values import CLASSES, STEPS, TERMS, WEIGHT_BITS, numbers_of
from octex.arrays import Array, Int32s, Int64s, Uint8s, Uint32s
from octex.tree.children import children_before
from octex.tree.layout import TreeArrays

#: About so many nodes of each of the two deepest levels are looked at, so many at a time.
_SAMPLE, _RUN = 1 << 10, 1 << 8
_ROUNDS = 3
_MOST = 8 << WEIGHT_BITS

#: Of some nodes: their children's first cell, and what lies around.
Sampled = list[tuple[int, Int32s, Uint32s]]


def sampled(arrays: TreeArrays) -> Sampled:
    """Return nodes all over the two deepest levels of nodes."""
    found = []
    for level in range(max(arrays.level_cells.size - 4, 0), arrays.level_cells.size - 2):
        begin, end = int(arrays.level_nodes[level]), int(arrays.level_nodes[level + 1])
        count = min(_SAMPLE // _RUN, -(-(end - begin) // _RUN))
        for first in (begin + (end - begin) * n // count for n in range(count)):
            last, none = min(first + _RUN, end), Place(0, 0, 0, 0, 0)
            cell, after = children_before(arrays.groups, np.array([first, last]))[0].tolist()
            around = around_nodes(arrays, Block(level, first, last, none, none))
            rows = np.empty((after - cell, 4), np.int32)
            around_children(arrays.groups, first, last, around, cell, rows)
            found.append((cell, rows, around[:, : OWN + 1]))
    return found


def fitted(raw: Uint8s, form: Form, sample: Sampled) -> Int64s:
    """Return the weights (2 · components · classes · terms,) of a channel's values (cells, components, size).

    Squares are weighted so that their sum is about that of what guesses are off by.
    """
    weights = np.zeros((2, form.components, CLASSES, TERMS), np.int64)
    if not sample:
        return weights.reshape(-1)
    parts = [
        np.concatenate(each, axis=-1)
        for each in zip(*(_terms(raw, form, *run) for run in sample), strict=True)
    ]
    terms, more, groups, kinds = parts
    for j in range(form.components):
        for kind, group in np.ndindex(2, CLASSES):
            own = (kinds == kind) & (groups[j] == group)
            known, wanted = terms[j][: 4 + 2 * min(j, 3), own].astype(np.float64), more[j, own]
            if wanted.size < 4 * TERMS:
                continue
            off = wanted
            for _ in range(_ROUNDS):
                weighted = known / (np.abs(off) + 0.5)
                square = weighted @ known.T + 1e-3 * np.sqrt(wanted.size) * np.eye(len(known))
                found = np.linalg.solve(square, weighted @ wanted)
                off = wanted - found @ known
            whole = np.clip(np.rint(found * (1 << WEIGHT_BITS)), -_MOST, _MOST)
            weights[kind, j, group, : len(known)] = whole
            for later in terms[j + 1 :]:
                if j < 3:
                    later[4 + 2 * j, own], later[5 + 2 * j, own] = np.rint(off), more[j, own]
    return weights.reshape(-1)


def _terms(raw: Uint8s, form: Form, begin: int, rows: Int32s, cells: Uint32s) -> tuple[Array, ...]:
    """Return terms (components, terms, cells), what values have more than their parents', classes, and kinds.

    All but the kinds are by component and cell, in the channel's unit.
    """
    about, count = rows[:, ABOUT], len(rows)
    left = about & 15
    node = np.cumsum(np.append(1, left[:-1] == 1)) - 1
    firsts = np.flatnonzero(np.diff(node, prepend=-1))[node]
    numbers = numbers_of(raw[begin : begin + count], form)
    around = numbers_of(raw[cells.reshape(-1)], form).reshape(-1, 7, form.components)
    values, sides = around[node, OWN], around[:, :OWN] - around[:, OWN:]
    most = np.minimum(np.abs(sides).sum(axis=1) >> form.unit + 1, 255)[node]
    more = numbers - values
    sums = np.cumsum(more, axis=0) - more
    near = beside = np.zeros_like(more)
    for axis in range(3):
        near = near + (sides[node, 2 * axis + (about >> 5 + axis & 1)] >> form.unit)
        other = rows[:, axis]
        beside = beside + np.where(other[:, None] >= 0, numbers[other] - values, 0)
    mean = (sums - sums[firsts] >> form.unit) * STEPS[2][left, None] >> 16
    known = near, (sides >> form.unit).sum(axis=1)[node], beside >> form.unit, mean
    terms = np.zeros((form.components, TERMS, count), np.int64)
    terms[:, :4] = np.stack(known).transpose(2, 0, 1)
    return terms, more.T >> form.unit, STEPS[0][most].T, about >> 4 & 1
