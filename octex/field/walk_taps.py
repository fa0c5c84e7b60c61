"""The taps of one lookup in any octree, and of cells that are not stored.

A walk goes down from window to window (`windows`) until no cell of the window is a node. There the spline's
weights fall on the cells. Leaves take theirs. Weights on cells below leaves and on empty cells are sent up to
the cells that those are refined from, until all rest on leaves, nodes and empty cells. The weights on leaves
and kept nodes are the taps. Sent up from a cell below a leaf, they are the coefficients that the field
refines to it (paper 4.2).
"""

from __future__ import annotations

import numpy as np

from octex.arrays import Float64s, Int64s, Uint32s
from octex.field.splines import (
    LINEAR,
    QUADRATIC,
    QUARTIC,
    linear_slopes,
    linear_weights,
    quadratic_slopes,
    quadratic_weights,
    quartic_slopes,
    quartic_weights,
)
from octex.field.taps import LEAST, OFF, TapList, Taps, new_taps
from octex.field.windows import (
    BEGIN,
    CONTENT,
    INSIDE,
    KEEPING,
    MOST_TAPS,
    NODES,
    REFINED,
    SHARES,
    UPPER,
    Walk,
    Way,
    cell_at,
    change_level,
    flag_at,
    follow,
    kept_row,
    new_walk,
    place_of,
    retain_refined,
    weigh_windows,
    words_of,
)
from octex.jit import inlined, kernel, trailing_zeros
from octex.tree.layout import MAX_DEPTH, TreeArrays
from octex.tree.morton import decode
from octex.tree.octree import Octree
from octex.tree.search import UNITS, cell_of

#: Cells whose taps are found at once: most have 8 to 27.
_CELLS_AT_ONCE = 1 << 14
_MIDDLE = 13


@inlined
def taps_around(
    way: Way, x: float, y: float, z: float, is_constant: bool, taps: Taps, first: int
) -> tuple[int, float]:
    """Write the taps of a point of texture space from index ``first`` on; return the end and the cover.

    ``taps`` has room for MOST_TAPS. A row is a cell's number, or the number of cells + r for row r of the
    kept nodes. Weights sum to the cover, or to OFF where it is zero; slopes are their derivatives by x, y and
    z, if ``is_constant`` with a constant sum. The point is first clamped into the root; it must be finite.

    The cover is the part of the spline's weight on leaves, 0 … 1. Where it is zero, the taps are those of the
    tree truncated at the deepest level with cells there.
    """
    walk = way.walk
    x, y, z = _rounded(x), _rounded(y), _rounded(z)
    i, j, k = cell_of(x, UNITS), cell_of(y, UNITS), cell_of(z, UNITS)
    level = follow(way, i, j, k)
    is_cut = way.is_truncated and walk.levels[level, NODES] != 0
    is_off = False
    while True:
        _fill_window(way, x, y, z, i, j, k, level)
        n_taps, total = _collect(way, level, is_cut, taps.rows, first)
        if total > 0.0 or (level == 0 and is_cut):
            break
        # Off the surface: next is the level above, or this one if it is the last and yet holds nodes.
        if is_cut or walk.levels[level, NODES] == 0:
            level -= 1
        is_cut = is_off = True
    cover = 0.0 if is_off else total
    weight_sum = np.float64(OFF) if is_off else max(cover, np.float64(LEAST))
    _write_taps(walk, n_taps, total, weight_sum, is_constant or weight_sum != total, taps, first)
    return first + n_taps, cover


@inlined
def _rounded(x: float) -> float:
    """Clamp a coordinate to 0 … 1 and round it to 2⁻⁵²: weights at the spline's rim are then exact."""
    return min(max(x, 0.0), 1.0) + 1.0 - 1.0


@inlined
def _fill_window(way: Way, x: float, y: float, z: float, i: int, j: int, k: int, level: int) -> None:
    """Let the spline's weights and slopes fall on the cells of a window."""
    windows, filter_code, side = way.walk.windows, way.filter_code, 2 * way.parents - 1
    shift = MAX_DEPTH - level
    cells = float(1 << level)
    x, y, z = x * cells - (i >> shift), y * cells - (j >> shift), z * cells - (k >> shift)
    for column in range(way.columns):
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
    """Return the weights of the spline along an axis, or their slopes by a coordinate of texture space."""
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
def _collect(way: Way, level: int, truncated: bool, rows: Uint32s, first: int) -> tuple[int, float]:
    """Write the taps of a window and of those above by refinement; return their number and weight."""
    walk, n_taps, total = way.walk, 0, 0.0
    while True:
        n_taps, total = _collect_level(way, level, truncated, rows, first, n_taps, total)
        if level == 0 or walk.levels[level - 1, CONTENT] == 0:
            break
        if not retain_refined(way, level):
            break
        for column in range(way.columns):
            change_level(walk, SHARES + column, level, way.parents, False)
        level -= 1
        truncated = False
    return n_taps, total


@inlined
def _collect_level(
    way: Way, level: int, truncated: bool, rows: Uint32s, first: int, n_taps: int, total: float
) -> tuple[int, float]:
    """Write the taps on the leaves and kept nodes of a window; return number and weight of all."""
    walk, parents, has_kept = way.walk, way.parents, way.kept_cells.size > 0
    windows = walk.windows
    begin = walk.levels[level, BEGIN]
    has_kept_parents = way.filter_code != LINEAR and walk.levels[level, KEEPING] != 0
    if has_kept_parents:
        weigh_windows(way, level)
    for word in range(words_of(way)):
        nodes, stored, kept = walk.nodes[level, word], walk.cells[level, word], np.uint64(0)
        if has_kept and not truncated:
            kept = walk.kept[level, word]
        bits = (stored if truncated else stored ^ nodes | kept) & INSIDE[parents - 2, begin, word]
        while bits != 0:
            bit = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            cell = cell_at(way.arrays, walk, level, word, bit)
            at = place_of(parents, begin, 64 * word + bit)
            factor = 1.0
            if has_kept:
                if has_kept_parents and walk.below_kept[level, word] & flag_at(bit) != 0:
                    factor = windows[REFINED + level, at]
                if kept & flag_at(bit) != 0:
                    cell = kept_row(way, cell)
            share = windows[SHARES, at] * factor
            walk.taps[0, n_taps] = share
            rows[first + n_taps] = max(cell, 0)
            any_share = share != 0.0
            for column in range(1, way.columns):
                slope = windows[SHARES + column, at] * factor
                walk.taps[column, n_taps] = slope
                any_share |= slope != 0.0
            if cell >= 0:
                n_taps += any_share
                total += share
    return n_taps, total


@inlined
def _write_taps(
    walk: Walk, n_taps: int, total: float, weight_sum: float, is_constant: bool, to: Taps, first: int
) -> None:
    """Write taps' weights, scaled to the sum ``weight_sum``, and slopes, of sum 0 if ``is_constant``."""
    taps = walk.taps
    scale = weight_sum / total
    for n in range(n_taps):
        to.weights[first + n] = taps[0, n] * scale
    for axis in range(3 if to.slopes.shape[0] > 0 else 0):
        drift = 0.0
        if is_constant:
            for n in range(n_taps):
                drift += taps[axis + 1, n]
            drift /= total
        for n in range(n_taps):
            to.slopes[first + n, axis] = (taps[axis + 1, n] - taps[0, n] * drift) * scale


@kernel
def walked_taps(
    arrays: TreeArrays,
    kept_cells: Uint32s,
    first_kept: int,
    coords: Float64s,
    which: Int64s,
    begin: int,
    filter_code: int,
    is_constant: bool,
    walk: Walk,
    taps: Taps,
    end: int,
) -> tuple[int, int]:
    """Find the taps of points ``which[begin:]`` in texture space (n, 3), from index ``end`` on.

    ``first_kept`` is the row number of the first kept node. With ``is_constant`` slopes are those of weights
    with a constant sum: more exact at the rim of the spline's support, but not to be added up over levels.
    Stops where a point's taps might not fit; returns the number of points done, and the end of the taps.
    """
    n_cells = np.uint32(arrays.flags.size)
    shift, columns = np.uint32(first_kept - arrays.flags.size), 4 if taps.slopes.shape[0] > 0 else 1
    for m in range(begin, which.size):
        if end + MOST_TAPS > taps.rows.size:
            return m, end
        n = which[m]
        start = end
        x, y, z = coords[n, 0], coords[n, 1], coords[n, 2]
        task = x, y, z, is_constant, taps, start
        if filter_code == QUARTIC:
            end, cover = taps_around(Way(arrays, kept_cells, walk, QUARTIC, 3, columns, False), *task)
        else:
            end, cover = taps_around(Way(arrays, kept_cells, walk, filter_code, 2, columns, False), *task)
        for tap in range(start, end):
            if taps.rows[tap] >= n_cells:
                taps.rows[tap] += shift
        taps.starts[n], taps.ends[n], taps.covers[n] = start, end, cover
    return which.size, end


def refined_taps(tree: Octree, codes: Int64s, level: int) -> TapList:
    """List the taps that the quadratic field refines to cells (n,) of a level, below leaves of a tree.

    ``codes`` are Morton codes. A cell without refinement has no taps.
    """
    walk = new_walk()
    counts = np.zeros(codes.size, np.int64)
    rows, weights = [np.empty(0, np.uint32)], [np.empty(0, np.float32)]
    room = new_taps(0, 27 * _CELLS_AT_ONCE + MOST_TAPS, False)
    begin = 0
    while begin < codes.size:
        begin, end = _refine_cells(tree.arrays, tree.kept.cells, codes, begin, level, walk, counts, room)
        rows.append(room.rows[:end].copy())
        weights.append(room.weights[:end].copy())
    return TapList(np.cumsum(np.append(0, counts)), np.concatenate(rows), np.concatenate(weights))


@kernel
def _refine_cells(
    arrays: TreeArrays,
    kept_cells: Uint32s,
    codes: Int64s,
    begin: int,
    level: int,
    walk: Walk,
    counts: Int64s,
    taps: Taps,
) -> tuple[int, int]:
    """Write the taps of cells from ``begin`` on, while they fit; return the ends of cells and taps."""
    way = Way(arrays, kept_cells, walk, QUADRATIC, 2, 1, False)
    shift = MAX_DEPTH - level
    end = 0
    for n in range(begin, codes.size):
        if end + MOST_TAPS > taps.rows.size:
            return n, end
        i, j, k = decode(codes[n])
        i, j, k = i << shift, j << shift, k << shift
        deepest = follow(way, i, j, k)
        walk.windows[SHARES, :27] = 0.0
        walk.windows[SHARES, _MIDDLE] = 1.0
        for deeper in range(level, deepest, -1):  # windows without stored cells
            half = MAX_DEPTH - deeper
            walk.levels[deeper, UPPER] = i >> half & 1 | (j >> half & 1) << 1 | (k >> half & 1) << 2
            change_level(walk, SHARES, deeper, 2, False)
        count, total = _collect(way, min(level, deepest), False, taps.rows, end)
        if total > 0.0:
            _write_taps(walk, count, total, 1.0, True, taps, end)
            counts[n] = count
            end += count
    return codes.size, end
