"""The quadratic field of many points in any tree: bricks where they lie close together, else the walk.

A cell is split in eight while it holds more than a few points and its brick ends above nodes. What the walk
and bricks answer differs by rounding only, some 10⁻⁷.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s
from octex.field.bricks import (
    AT_SIX,
    AT_TEN,
    CELLS,
    Bricks,
    Tree,
    Values,
    decode,
    enter,
    kept_row,
    list_around,
    look_below,
    note_nodes,
    value_of,
)
from octex.field.order import AHEAD, Order, cell_of, end_of_cell, sort_by_digit
from octex.field.refinement import change_level, leave_refined, weigh
from octex.field.splines import QUADRATIC, quadratic_weights
from octex.field.taps import LEAST
from octex.field.tiles import Integer
from octex.field.windows import (
    BEGIN,
    CONTENT,
    INSIDE,
    KEEPING,
    REFINED,
    SHARES,
    Walk,
    bit_at,
    cell_at,
    follow,
    place_of,
)
from octex.jit import fused_kernel, inlined, prefetch, trailing_zeros, weighted_cube
from octex.tree.layout import MAX_DEPTH
from octex.tree.search import UNITS

#: Points in a cell for which a brick is not worth its while: a walk takes longer where coefficients are kept.
_FEW, _FEW_KEPT = 8, 2


class Asked(NamedTuple):
    """What is asked, and answered."""

    places: Float64s  # (n, 3)   in texture space
    order: Order  # of the places
    results: Float32s  # (n, components)   the mean of the channel
    missed: Int32s  # (n,)   points that are not answered


@inlined
def _answer(
    asked: Asked, n: Integer, n_missed: int, a: float, b: float, c: float, d: float, total: float
) -> int:
    """Answer a point with a sum of values divided by that of its weights; it is missed if that says nothing.

    Returns how many points are missed then.
    """
    results = asked.results
    inverse = 1.0 / total
    a, b, c, d = a * inverse, b * inverse, c * inverse, d * inverse
    if not (total >= LEAST and abs(a) + abs(b) + abs(c) + abs(d) < np.inf):
        asked.missed[n_missed] = n
        return n_missed + 1
    components = results.shape[1]
    results[n, 0] = a
    if components > 1:
        results[n, 1] = b
    if components > 2:
        results[n, 2] = c
    if components > 3:
        results[n, 3] = d
    return n_missed


@inlined
def _walk(
    tree: Tree,
    values: Values,
    walk: Walk,
    asked: Asked,
    n: int,
    n_missed: int,
) -> int:
    """Answer a point by the walk, see `neighborhood`; return how many are missed then."""
    x, y, z = asked.places[n, 0] + 1.0 - 1.0, asked.places[n, 1] + 1.0 - 1.0, asked.places[n, 2] + 1.0 - 1.0
    i, j, k = cell_of(x, UNITS), cell_of(y, UNITS), cell_of(z, UNITS)
    arrays, kept_cells = tree.arrays, tree.kept_cells
    level = follow(arrays, kept_cells, walk, i, j, k, QUADRATIC, 2)
    windows, levels = walk.windows, walk.levels
    shift, cells = MAX_DEPTH - level, float(1 << level)
    of_x = quadratic_weights(x * cells - (i >> shift))
    of_y = quadratic_weights(y * cells - (j >> shift))
    of_z = quadratic_weights(z * cells - (k >> shift))
    for w in range(3):
        for v in range(3):
            both = of_z[w] * of_y[v]
            for u in range(3):
                windows[SHARES, u + 3 * (v + 3 * w)] = both * of_x[u]
    sum_a = sum_b = sum_c = sum_d = total = 0.0
    while True:
        begin, keeping = levels[level, BEGIN], levels[level, KEEPING] != 0
        if keeping:
            weigh(walk, level, 2)
        kept = np.uint64(0)
        if kept_cells.size > 0:
            kept = walk.kept[level, 0]
        bits = (walk.cells[level, 0] ^ walk.nodes[level, 0] | kept) & INSIDE[0, begin, 0]
        while bits != 0:
            place = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            at = place_of(2, begin, place)
            share = windows[SHARES, at]
            if keeping and walk.below_kept[level, 0] & bit_at(place) != 0:
                share *= windows[REFINED + level, at]
            row = max(cell_at(arrays, walk, level, 0, place), 0)
            if kept & bit_at(place) != 0:
                row = kept_row(tree, row)
            if share != 0.0:
                a, b, c, d, covered = value_of(values, row)
                sum_a, sum_b, sum_c = sum_a + share * a, sum_b + share * b, sum_c + share * c
                sum_d, total = sum_d + share * d, total + share * covered
        if level == 0 or levels[level - 1, CONTENT] == 0 or not leave_refined(walk, level, QUADRATIC, 2, 1):
            break
        change_level(walk, SHARES, level, 2, False)
        level -= 1
    return _answer(asked, n, n_missed, sum_a, sum_b, sum_c, sum_d, total)


@inlined
def _weights(t: float) -> tuple[np.float32, np.float32, np.float32]:
    """Weights of the quadratic B-spline: small ones keep their digits."""
    half = np.float32(0.5)
    s, r = np.float32(1.0 - t), np.float32(t)
    low, high = half * s * s, half * r * r
    return low, np.float32(1.0) - low - high, high


@inlined
def _blend(
    bricks: Bricks,
    planes: int,
    first: int,
    side: int,
    level: int,
    low: tuple[int, int, int],
    asked: Asked,
    begin: int,
    end: int,
    n_missed: int,
) -> int:
    """Answer points from a block of a level, whose first cell is ``low``; return how many are missed."""
    rows, places, numbers = bricks.rows, asked.places, asked.order.numbers
    cells = np.float64(np.int64(1) << level)
    for m in range(begin, end):
        ahead = int(numbers[min(m + AHEAD, numbers.size - 1)])
        prefetch(places, ahead)
        prefetch(asked.results, ahead)
        n = np.uint64(numbers[m])
        x = (places[n, 0] + 1.0 - 1.0) * cells
        y = (places[n, 1] + 1.0 - 1.0) * cells
        z = (places[n, 2] + 1.0 - 1.0) * cells
        most = cells - 1.0
        i, j, k = min(np.floor(x), most), min(np.floor(y), most), min(np.floor(z), most)
        of_x, of_y, of_z = _weights(x - i), _weights(y - j), _weights(z - k)
        at = (int(i) - low[0] - 1) + side * ((int(j) - low[1] - 1) + side * (int(k) - low[2] - 1))
        at += first
        a, b, c, d = weighted_cube(rows, at, side, of_x, of_y, of_z)
        total = d
        if planes > 1:
            total, _, _, _ = weighted_cube(rows, at + CELLS, side, of_x, of_y, of_z)
        n_missed = _answer(asked, n, n_missed, a, b, c, d, total)
    return n_missed


@fused_kernel
def look_up_crowded(
    tree: Tree,
    values: Values,
    asked: Asked,
    bricks: Bricks,
    walk: Walk,
) -> int:
    """Look up all that is asked; return how many points are missed.

    These lie off the surface, or nearly, or where alpha is zero.
    """
    ends, split, order = bricks.ends, bricks.split, asked.order
    codes, numbers = order.codes, order.numbers
    planes, few = 1, _FEW_KEPT if tree.kept_cells.size > 0 else _FEW
    if values.codes.values.shape[1] > 3 or (values.alpha.values.shape[0] > 0 and tree.kept_cells.size > 0):
        planes = 2
    enter(tree, values, bricks, planes)
    level, begin, n_missed = 0, 0, 0
    ends[0], split[0] = codes.size, False
    path = np.zeros((MAX_DEPTH + 2, 4), np.int64)  # the cell of each level, and its octant
    while begin < codes.size:
        while begin >= ends[level]:
            level -= 1
        end = ends[level]
        i, j, k, octant = path[level, 0], path[level, 1], path[level, 2], path[level, 3]
        if not split[level]:
            is_done = end - begin <= few
            if not is_done:
                corner = 64 * level + (octant & 1) + 4 * (octant >> 1 & 1) + 16 * (octant >> 2)
                list_around(bricks, corner)
                last = look_below(tree, values.codes.values, bricks)
                has, source, stride = bricks.has[level], corner, 4
                first = 64 * (level + 1)
                for step in range(1, max(last, 1) + 1):
                    if step > last >= 0:
                        break
                    target = AT_TEN if step == 3 else AT_SIX if step == 2 else first
                    side = (0, 3, 4, 6)[step]
                    has = decode(values, bricks, planes, step, source, stride, side, target, has)
                    if step == 1:
                        bricks.has[level + 1] = has
                    source, stride = target, 2 * side - 2
                if last >= 0:
                    low = (i << last) - 1, (j << last) - 1, (k << last) - 1
                    task = planes, source, stride, level + last, low
                    n_missed = _blend(bricks, *task, asked, begin, end, n_missed)
                    begin = end
                    continue
                is_done = level >= MAX_DEPTH
            if is_done:
                for m in range(begin, end):
                    n_missed = _walk(tree, values, walk, asked, int(numbers[m]), n_missed)
                begin = end
                continue
            note_nodes(bricks, level + 1)
            if level % 3 == 0:
                sort_by_digit(order, begin, end, 3 * (MAX_DEPTH - level - 3), bricks.counts)
            split[level] = True
        level += 1
        shift = 3 * (MAX_DEPTH - level)
        ends[level], split[level] = end_of_cell(codes, begin, end, shift), False
        octant = codes[begin] >> shift & 7
        path[level, 0], path[level, 1] = 2 * i + (octant & 1), 2 * j + (octant >> 1 & 1)
        path[level, 2], path[level, 3] = 2 * k + (octant >> 2), octant
    return n_missed
