"""The taps of one lookup in any octree.

A walk goes down from window to window (`windows`) until no cell of the window is a node. There the spline's
weights fall on the cells. Leaves take theirs; what falls on cells below leaves and empty cells is sent up to
the cells that they are refined from, until all has come to rest on leaves, nodes and empty cells. What lies
on leaves and kept coefficients are the taps.
"""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s, Float64s, Floats, Int64s, Uint32s
from octex.field.refinement import change_level, leave_refined, weigh
from octex.field.splines import (
    LINEAR,
    QUARTIC,
    linear_slopes,
    linear_weights,
    quadratic_slopes,
    quadratic_weights,
    quartic_slopes,
    quartic_weights,
)
from octex.field.taps import OFF, Taps
from octex.field.windows import (
    BEGIN,
    CONTENT,
    INSIDE,
    KEEPING,
    NODES,
    REFINED,
    SHARES,
    bit_at,
    cell_at,
    follow,
    place_of,
)
from octex.field.windows import MOST_TAPS as MOST_TAPS
from octex.field.windows import Walk as Walk
from octex.field.windows import new_walk as new_walk
from octex.jit import inlined, kernel, trailing_zeros
from octex.tree.layout import MAX_DEPTH, TreeArrays
from octex.tree.search import UNITS, Origin


@inlined
def walk_taps(
    arrays: TreeArrays,
    kept_cells: Uint32s,
    x: float,
    y: float,
    z: float,
    filter_code: int,
    walk: Walk,
    rows: Uint32s,
    weights: Float32s,
    slopes: Float32s,
    first: int,
) -> tuple[int, float]:
    """Write the taps of a point of texture space from index ``first`` on; return the end, and the cover.

    ``filter_code`` is 1 linear, 2 quadratic, 3 quartic. ``rows``, ``weights`` (m,) and ``slopes`` (m, 3), or
    (0, 3) if they are not wanted, must have room for MOST_TAPS. A row is a cell's number, or the number of
    cells + r for row r of ``kept_cells`` (ascending, the nodes flagged KEPT). Weights sum to 1; slopes are
    their derivatives by x, y and z. The point is first clamped into the root; it must be finite.

    The cover is how much of the spline's weight falls on leaves, 0 … 1. Where it is zero, the taps are those
    of the tree truncated at the deepest level that has any there.
    """
    if filter_code == QUARTIC:
        return _walk_taps(arrays, kept_cells, x, y, z, QUARTIC, 3, walk, rows, weights, slopes, first)
    return _walk_taps(arrays, kept_cells, x, y, z, filter_code, 2, walk, rows, weights, slopes, first)


@inlined
def _walk_taps(
    arrays: TreeArrays,
    kept_cells: Uint32s,
    x: float,
    y: float,
    z: float,
    filter_code: int,
    parents: int,
    walk: Walk,
    rows: Uint32s,
    weights: Float32s,
    slopes: Float32s,
    first: int,
) -> tuple[int, float]:
    x, y, z = _rounded(x), _rounded(y), _rounded(z)
    i, j, k = _finest(x), _finest(y), _finest(z)
    columns = 4 if slopes.shape[0] > 0 else 1
    level = follow(arrays, kept_cells, walk, i, j, k, filter_code, parents)
    truncated = False
    while True:
        _fill(walk, filter_code, parents, columns, x, y, z, i, j, k, level)
        n_taps, total = collect(
            arrays, kept_cells, walk, level, truncated, filter_code, parents, columns, rows, first
        )
        if total > 0.0 or (level == 0 and truncated):
            break
        # Off the surface: next is the level above, or this one if it is the last and yet holds nodes.
        if truncated or walk.levels[level, NODES] == 0:
            level -= 1
        truncated = True
    normalize(walk, n_taps, total, weights, slopes, first)
    return first + n_taps, 0.0 if truncated else total


@inlined
def _rounded(x: float) -> float:
    """Clamp a coordinate to 0 … 1 and round it to 2⁻⁵².

    Weights at the rim of a spline's support are then zero, or large enough for the quotients of slopes.
    """
    return min(max(x, 0.0), 1.0) + 1.0 - 1.0


@inlined
def _finest(x: float) -> int:
    """Fixed-point position, 0 … 2²¹ − 1: of the finest cell that holds a coordinate 0 … 1."""
    return min(int(x * UNITS), UNITS - 1)


@inlined
def _fill(
    walk: Walk,
    filter_code: int,
    parents: int,
    columns: int,
    x: float,
    y: float,
    z: float,
    i: int,
    j: int,
    k: int,
    level: int,
) -> None:
    """Let the spline's weights and slopes fall on the cells of a window."""
    windows = walk.windows
    side = 2 * parents - 1
    shift = MAX_DEPTH - level
    cells = float(1 << level)
    x, y, z = x * cells - (i >> shift), y * cells - (j >> shift), z * cells - (k >> shift)
    for column in range(columns):
        of_x = _spline(filter_code, column == 1, x, cells)
        of_y = _spline(filter_code, column == 2, y, cells)
        of_z = _spline(filter_code, column == 3, z, cells)
        for dz in range(side):
            for dy in range(side):
                share = of_z[dz] * of_y[dy]
                for dx in range(side):
                    windows[SHARES + column, dx + side * (dy + side * dz)] = share * of_x[dx]


@inlined
def _spline(
    filter_code: int, is_slope: bool, t: float, cells: float
) -> tuple[float, float, float, float, float]:
    """Weights of the spline along an axis, or their slopes by a coordinate of texture space."""
    if filter_code == QUARTIC:
        if not is_slope:
            return quartic_weights(t)
        a, b, c, d, e = quartic_slopes(t)
        return a * cells, b * cells, c * cells, d * cells, e * cells
    if filter_code == LINEAR:
        a, b, c = linear_slopes(t) if is_slope else linear_weights(t)
    else:
        a, b, c = quadratic_slopes(t) if is_slope else quadratic_weights(t)
    if is_slope:
        a, b, c = a * cells, b * cells, c * cells
    return a, b, c, 0.0, 0.0


@inlined
def collect(
    arrays: TreeArrays,
    kept_cells: Uint32s,
    walk: Walk,
    level: int,
    truncated: bool,
    filter_code: int,
    parents: int,
    columns: int,
    rows: Uint32s,
    first: int,
) -> tuple[int, float]:
    """Write taps for what falls on a window, and on those above by refinement.

    If ``truncated``, the level's nodes count as leaves. Returns the number of taps and their weight.
    """
    n_taps = 0
    total = 0.0
    while True:
        n_taps, total = _settle(
            arrays,
            kept_cells,
            walk,
            level,
            truncated,
            filter_code,
            parents,
            columns,
            rows,
            first,
            n_taps,
            total,
        )
        if level == 0 or walk.levels[level - 1, CONTENT] == 0:
            break
        if not leave_refined(walk, level, filter_code, parents, columns):
            break
        for column in range(columns):
            change_level(walk, SHARES + column, level, parents, False)
        level -= 1
        truncated = False
    return n_taps, total


@inlined
def _settle(
    arrays: TreeArrays,
    kept_cells: Uint32s,
    walk: Walk,
    level: int,
    truncated: bool,
    filter_code: int,
    parents: int,
    columns: int,
    rows: Uint32s,
    first: int,
    n_taps: int,
    total: float,
) -> tuple[int, float]:
    """Write taps for what falls on the leaves and kept nodes of a window; return number and weight of all."""
    windows = walk.windows
    begin = walk.levels[level, BEGIN]
    keeping = filter_code != LINEAR and walk.levels[level, KEEPING] != 0
    if keeping:
        weigh(walk, level, parents)
    for word in range(1 if parents == 2 else 4):
        nodes, stored, kept = walk.nodes[level, word], walk.cells[level, word], np.uint64(0)
        if kept_cells.size > 0 and not truncated:
            kept = walk.kept[level, word]
        bits = (stored if truncated else stored ^ nodes | kept) & INSIDE[parents - 2, begin, word]
        while bits != 0:
            place = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            cell = cell_at(arrays, walk, level, word, place)
            at = place_of(parents, begin, 64 * word + place)
            factor = 1.0
            if kept_cells.size > 0:
                if keeping and walk.below_kept[level, word] & bit_at(place) != 0:
                    factor = windows[REFINED + level, at]
                if kept & bit_at(place) != 0:
                    cell = _kept_row(kept_cells, cell, arrays.flags.size)
            share = windows[SHARES, at] * factor
            walk.taps[0, n_taps] = share
            rows[first + n_taps] = max(cell, 0)
            any_share = share != 0.0
            for column in range(1, columns):
                slope = windows[SHARES + column, at] * factor
                walk.taps[column, n_taps] = slope
                any_share |= slope != 0.0
            if cell >= 0:
                n_taps += any_share
                total += share
    return n_taps, total


@inlined
def _kept_row(kept_cells: Uint32s, cell: int, n_cells: int) -> int:
    """Row of a cell's kept coefficient, or −1 if it is not listed."""
    low, high = 0, kept_cells.size
    while low < high:
        middle = low + high >> 1
        if np.int64(kept_cells[middle]) < cell:
            low = middle + 1
        else:
            high = middle
    return n_cells + low if low < kept_cells.size and np.int64(kept_cells[low]) == cell else -1


@inlined
def normalize(walk: Walk, n_taps: int, total: float, weights: Float32s, slopes: Float32s, first: int) -> None:
    """Write the weights and slopes of taps of weight ``total``: weights then sum to 1."""
    taps = walk.taps
    scale = 1.0 / total
    for n in range(n_taps):
        weights[first + n] = taps[0, n] * scale
    if slopes.shape[0] == 0:
        return
    for axis in range(3):
        total_slope = 0.0
        for n in range(n_taps):
            total_slope += taps[axis + 1, n]
        for n in range(n_taps):
            slopes[first + n, axis] = (taps[axis + 1, n] - taps[0, n] * scale * total_slope) * scale


@kernel
def walk_all(
    arrays: TreeArrays,
    kept_cells: Uint32s,
    points: Floats,
    first_point: int,
    origin: Origin,
    size: float,
    filter_code: int,
    walk: Walk,
    starts: Int64s,
    rows: Uint32s,
    weights: Float32s,
    slopes: Float32s,
    covers: Float32s,
) -> int:
    """Write the taps of rest positions (n, 3) from index ``first_point`` on, one point after another.

    Point n of them has taps ``starts[n]`` to ``starts[n + 1]`` − 1; ``starts`` has room for all and one more,
    ``covers`` for all; the others are as in ``walk_taps``, slopes by rest position. Stops where there might
    be no room for a point's taps. Returns the number of points done, or −1 − the index of a point that is not
    finite.
    """
    end = 0
    done = 0
    starts[0] = 0
    for n in range(first_point, points.shape[0]):
        if end + MOST_TAPS > rows.size:
            break
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
            return -1 - n
        x, y, z = (x - origin[0]) / size, (y - origin[1]) / size, (z - origin[2]) / size
        end, cover = walk_taps(arrays, kept_cells, x, y, z, filter_code, walk, rows, weights, slopes, end)
        covers[done] = cover
        done += 1
        starts[done] = end
    if slopes.shape[0] > 0:
        for n in range(end):
            slopes[n, 0] /= size
            slopes[n, 1] /= size
            slopes[n, 2] /= size
    return done


@kernel
def walked_taps(
    arrays: TreeArrays,
    kept_cells: Uint32s,
    first_kept: int,
    places: Float64s,
    which: Int64s,
    begin: int,
    filter_code: int,
    walk: Walk,
    taps: Taps,
    end: int,
) -> tuple[int, int]:
    """Find the taps of points ``which[begin:]`` of those in texture space (n, 3), from index ``end`` on.

    ``first_kept`` is what the first row of ``kept_cells`` is counted as. Stops where there might be no room
    for a point's taps; returns how far it came, and the end of the taps.
    """
    n_cells = np.uint32(arrays.flags.size)
    shift = np.uint32(first_kept - arrays.flags.size)
    gradient = taps.slopes.shape[0] > 0
    for m in range(begin, which.size):
        if end + MOST_TAPS > taps.rows.size:
            return m, end
        n = which[m]
        start = end
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        end, cover = walk_taps(
            arrays, kept_cells, x, y, z, filter_code, walk, taps.rows, taps.weights, taps.slopes, start
        )
        scale = np.float32(max(cover, np.float64(OFF)))
        for tap in range(start, end):
            if taps.rows[tap] >= n_cells:
                taps.rows[tap] += shift
            taps.weights[tap] *= scale
            if gradient:
                for axis in range(3):
                    taps.slopes[tap, axis] *= scale
        taps.starts[n], taps.ends[n], taps.covers[n] = start, end, cover
    return which.size, end
