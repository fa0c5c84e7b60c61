"""The taps of one lookup in any octree: the cells around a point, followed down from the root.

The *window* of a level is the 3×3×3 cells of that level around the point, 5×5×5 for quartic. Its parents are
a *block* of 2×2×2 (3×3×3) cells of the window above. A walk goes down from window to window, a group read a
parent, until no cell of the window is a node. There the spline's weights fall on the cells: leaves take
theirs, and those of cells below leaves and empty cells are sent up to the window that they are refined from,
until all weight lies on leaves or is lost.

(Paper 3.4, after Kobbelt et al. 1997.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.field.splines import (
    LINEAR,
    QUARTIC,
    REFINE_FIVE,
    REFINE_THREE,
    linear_slopes,
    linear_weights,
    quadratic_slopes,
    quadratic_weights,
    quartic_slopes,
    quartic_weights,
)
from octex.jit import inlined, kernel, popcount, trailing_zeros
from octex.tree.layout import KEPT, MAX_DEPTH, TreeArrays
from octex.tree.search import UNITS, Origin

Int64s = npt.NDArray[np.int64]
Float64s = npt.NDArray[np.float64]
Float32s = npt.NDArray[np.float32]
Uint32s = npt.NDArray[np.uint32]

#: No point has more taps: every cell of every window.
MOST_TAPS = (MAX_DEPTH + 1) * 125

# A parent's mask: bits 0 to 7 say which of its children are nodes, 8 to 15 which are stored, 16 to 23 which
# are nodes with a kept coefficient, 32 to 39 which lie in the window, each by octant; and
VIRTUAL = 1 << 24  # it is no node: its children are refined; bits 8 to 15 are set if they are below a leaf
BELOW_KEPT = 1 << 25  # it is a node with a kept coefficient
INSIDE = 32

# What a level is known to hold.
NODES = 1  # nodes in its window
CONTENT = 2  # leaves or kept coefficients in its window or one above
REFINED = 4  # parents that are no nodes
KEEPING = 8  # parents with kept coefficients

# Rows of Walk.windows.
COVER = 0  # 22 rows: of each level, the weights of the window's coefficients
REFINED_COVER = 22  # 22 rows: of each level, the weights refined from the window above
WORK = 44  # 2 rows
SHARES = 46  # 2 × 4 rows: weight and slopes that fall on a window's cells


class Walk(NamedTuple):
    """What walks through one tree remember from one point to the next, and where they work."""

    previous: Int64s  # (6,)   the previous position; its last level; parents an axis; last level of COVER
    masks: Int64s  # (22, 27)   of each level's parents, x fastest
    first_nodes: Int64s  # (22, 27)   node number of a parent's first child node
    first_cells: Int64s  # (22, 27)   cell number of its first child
    holds: Int64s  # (22,)   NODES | CONTENT | REFINED | KEEPING
    windows: Float64s  # (54, 125)   what lies on a window's cells, x fastest
    splines: Float64s  # (2, 3, 5)   weights and slopes of the spline along each axis
    rows: Int64s  # (MOST_TAPS,)
    taps: Float64s  # (4, MOST_TAPS)   weights and slopes before they are normalized


@kernel
def new_walk() -> Walk:
    """Return a walk without memory. A walk serves one tree, and all filters."""
    return Walk(
        np.full(6, -1, np.int64),
        np.zeros((MAX_DEPTH + 1, 27), np.int64),
        np.zeros((MAX_DEPTH + 1, 27), np.int64),
        np.zeros((MAX_DEPTH + 1, 27), np.int64),
        np.zeros(MAX_DEPTH + 1, np.int64),
        np.zeros((SHARES + 8, 125), np.float64),
        np.zeros((2, 3, 5), np.float64),
        np.zeros(MOST_TAPS, np.int64),
        np.zeros((4, MOST_TAPS), np.float64),
    )


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
) -> int:
    """Write the taps of a point of texture space from index ``first`` on; return the end.

    ``filter_code`` is 1 linear, 2 quadratic, 3 quartic. ``rows``, ``weights`` (m,) and ``slopes`` (m, 3), or
    (0, 3) if they are not wanted, must have room for MOST_TAPS. A row is a cell's number, or the number of
    cells + r for row r of ``kept_cells`` (ascending, the nodes flagged KEPT). Weights sum to 1; slopes are
    their derivatives by x, y and z. The point is first clamped into the root; it must be finite.

    Where the weights of all leaves are zero, the taps are those of the tree truncated at the deepest level
    that has any there.
    """
    if filter_code == QUARTIC:
        return _walk_taps(arrays, kept_cells, x, y, z, filter_code, 3, walk, rows, weights, slopes, first)
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
) -> int:
    x, y, z = _rounded(x), _rounded(y), _rounded(z)
    i, j, k = _place(x), _place(y), _place(z)
    columns = 4 if slopes.shape[0] > 0 else 1
    level = _follow(arrays, kept_cells, walk, i, j, k, parents)
    truncated = 0
    while True:
        _set_splines(walk, filter_code, 0, x, i, level)
        _set_splines(walk, filter_code, 1, y, j, level)
        _set_splines(walk, filter_code, 2, z, k, level)
        n_taps = _collect(arrays, kept_cells, walk, i, j, k, level, truncated, filter_code, parents, columns)
        total = 0.0
        for n in range(n_taps):
            total += walk.taps[0, n]
        if total > 0.0 or (level == 0 and truncated):
            break
        # off the surface: next the level above, or this one if it is the last and yet holds nodes
        level -= truncated | (walk.holds[level] & NODES ^ NODES)
        truncated = 1
    _normalize(walk, n_taps, total, rows, weights, slopes, first)
    return first + n_taps


@inlined
def _rounded(x: float) -> float:
    """Clamp a coordinate to 0 … 1 and round it to 2⁻⁵².

    Weights at the rim of a spline's support are then zero, or large enough for the quotients of slopes.
    """
    return min(max(x, 0.0), 1.0) + 1.0 - 1.0


@inlined
def _place(x: float) -> int:
    """Fixed-point position, 0 … 2²¹ − 1: of the finest cell that holds a coordinate 0 … 1."""
    return min(int(x * UNITS), UNITS - 1)


@inlined
def _normalize(
    walk: Walk, n_taps: int, total: float, rows: Uint32s, weights: Float32s, slopes: Float32s, first: int
) -> None:
    taps = walk.taps
    scale = 1.0 / total
    for n in range(n_taps):
        rows[first + n] = walk.rows[n]
        weights[first + n] = taps[0, n] * scale
    if slopes.shape[0] == 0:
        return
    for axis in range(3):
        total_slope = 0.0
        for n in range(n_taps):
            total_slope += taps[axis + 1, n]
        for n in range(n_taps):
            slopes[first + n, axis] = (taps[axis + 1, n] - taps[0, n] * scale * total_slope) * scale


@inlined
def _set_splines(walk: Walk, filter_code: int, axis: int, x: float, i: int, level: int) -> None:
    """Write the spline's weights and slopes along an axis."""
    splines = walk.splines
    per_cell = float(1 << level)
    t = x * per_cell - (i >> (MAX_DEPTH - level))
    if filter_code == QUARTIC:
        a, b, c, d, e = quartic_weights(t)
        splines[0, axis, 0], splines[0, axis, 1], splines[0, axis, 2] = a, b, c
        splines[0, axis, 3], splines[0, axis, 4] = d, e
        a, b, c, d, e = quartic_slopes(t)
        splines[1, axis, 0], splines[1, axis, 1], splines[1, axis, 2] = (
            a * per_cell,
            b * per_cell,
            c * per_cell,
        )
        splines[1, axis, 3], splines[1, axis, 4] = d * per_cell, e * per_cell
        return
    if filter_code == LINEAR:
        a, b, c = linear_weights(t)
        d, e, f = linear_slopes(t)
    else:
        a, b, c = quadratic_weights(t)
        d, e, f = quadratic_slopes(t)
    splines[0, axis, 0], splines[0, axis, 1], splines[0, axis, 2] = a, b, c
    splines[1, axis, 0], splines[1, axis, 1], splines[1, axis, 2] = d * per_cell, e * per_cell, f * per_cell


@inlined
def _follow(arrays: TreeArrays, kept_cells: Uint32s, walk: Walk, i: int, j: int, k: int, parents: int) -> int:
    """Go down to the first level whose window holds no node, and return it."""
    previous = walk.previous
    difference = (i ^ previous[0]) | (j ^ previous[1]) | (k ^ previous[2])
    level = int(previous[3])
    if level < 0 or previous[4] != parents:
        _enter(arrays, kept_cells, walk, parents)
        level = 0
    while level > 0 and difference >> (MAX_DEPTH - level) != 0:
        level -= 1
    previous[5] = min(previous[5], level)
    deepest = min(arrays.level_cells.size - 2, MAX_DEPTH)
    while walk.holds[level] & NODES and level < deepest:
        level += 1
        _go_down(arrays, kept_cells, walk, i, j, k, level, parents)
    previous[0], previous[1], previous[2], previous[3] = i, j, k, level
    return level


@inlined
def _enter(arrays: TreeArrays, kept_cells: Uint32s, walk: Walk, parents: int) -> None:
    """Write the root's window: it is the first child of the parent in the middle; the others have none."""
    is_node = 1 if arrays.groups.shape[0] > 0 else 0
    keeps = is_node if kept_cells.size > 0 and arrays.flags[0] & KEPT else 0
    for slot in range(parents * parents * parents):
        walk.masks[0, slot] = 0
    middle = 1 + parents + parents * parents
    walk.masks[0, middle] = is_node | 1 << 8 | keeps << 16 | 0xFF << INSIDE
    walk.first_nodes[0, middle] = walk.first_cells[0, middle] = 0
    walk.holds[0] = (NODES if is_node else CONTENT) | (CONTENT if keeps else 0)
    walk.previous[4] = parents
    walk.previous[5] = -1


@inlined
def _inside(place: int, offset: int, parents: int, lower: int) -> int:
    """Octants, as bits, that lie in the window as far as one axis says; ``lower`` are the axis' lower ones.

    The children of a block are one more along each axis than the window, which begins at ``offset``, 0 or 1.
    """
    if place == 0 and offset == 1:
        return 0xFF ^ lower
    if place == parents - 1 and offset == 0:
        return lower
    return 0xFF


@inlined
def _go_down(
    arrays: TreeArrays, kept_cells: Uint32s, walk: Walk, i: int, j: int, k: int, level: int, parents: int
) -> None:
    """Find the window of a level from that of the level above."""
    masks, first_nodes, first_cells = walk.masks, walk.first_nodes, walk.first_cells
    groups = arrays.groups
    shift = MAX_DEPTH - level
    radius = parents - 1
    # the window's first cell, and where the first parent lies among the children of the block above
    a, b, c = (i >> shift) - radius, (j >> shift) - radius, (k >> shift) - radius
    u = (a >> 1) - ((i >> shift + 1) - radius >> 1 << 1)
    v = (b >> 1) - ((j >> shift + 1) - radius >> 1 << 1)
    w = (c >> 1) - ((k >> shift + 1) - radius >> 1 << 1)
    holds = walk.holds[level - 1] & CONTENT
    slot = 0
    for dz in range(parents):
        inside_z = _inside(dz, c & 1, parents, 0x0F)
        for dy in range(parents):
            inside_yz = inside_z & _inside(dy, b & 1, parents, 0x33)
            for dx in range(parents):
                inside = inside_yz & _inside(dx, a & 1, parents, 0x55)
                above = (u + dx >> 1) + parents * ((v + dy >> 1) + parents * (w + dz >> 1))
                octant = u + dx & 1 | (v + dy & 1) << 1 | (w + dz & 1) << 2
                mask = masks[level - 1, above] >> octant
                if mask & 1 == 0:
                    masks[level, slot] = VIRTUAL | inside << INSIDE | (0xFF00 if mask & 1 << 8 else 0)
                    holds |= REFINED
                    slot += 1
                    continue
                node = first_nodes[level - 1, above]
                node += popcount(masks[level - 1, above] & (1 << octant) - 1)
                group = min(node >> 3, groups.shape[0] - 1)
                at = np.uint64(8 * (node & 7))
                nodes, cells = groups[group, 0], groups[group, 0] | groups[group, 1]
                before = (np.uint64(1) << at) - np.uint64(1)
                firsts = groups[group, 2]
                first_cell = int(np.int64(firsts >> np.uint64(32))) + popcount(cells & before)
                first_nodes[level, slot] = np.int64(firsts & np.uint64(0xFFFFFFFF)) + popcount(nodes & before)
                first_cells[level, slot] = first_cell
                own_nodes = int(np.int64(nodes >> at)) & 0xFF
                own_cells = int(np.int64(cells >> at)) & 0xFF
                masks[level, slot] = own_nodes | own_cells << 8 | inside << INSIDE
                if own_nodes & inside:
                    holds |= NODES
                if (own_cells ^ own_nodes) & inside:
                    holds |= CONTENT
                if kept_cells.size > 0:
                    if mask & 1 << 16:
                        masks[level, slot] |= BELOW_KEPT
                        holds |= KEEPING
                    bits = own_nodes & inside
                    while bits:
                        child = trailing_zeros(bits)
                        bits &= bits - 1
                        cell = first_cell + popcount(own_cells & (1 << child) - 1)
                        if arrays.flags[min(cell, arrays.flags.size - 1)] & KEPT:
                            masks[level, slot] |= 1 << 16 + child
                            holds |= CONTENT
                slot += 1
    walk.holds[level] = holds


@inlined
def _collect(
    arrays: TreeArrays,
    kept_cells: Uint32s,
    walk: Walk,
    i: int,
    j: int,
    k: int,
    level: int,
    truncated: int,
    filter_code: int,
    parents: int,
    columns: int,
) -> int:
    """Write the taps of the spline over the window of a level; return their number.

    ``truncated`` is 1 if the level's nodes count as leaves.
    """
    side = 2 * parents - 1
    windows, splines = walk.windows, walk.splines
    for column in range(columns):
        of_x, of_y, of_z = int(column == 1), int(column == 2), int(column == 3)
        entry = 0
        for dz in range(side):
            for dy in range(side):
                share = splines[of_z, 2, dz] * splines[of_y, 1, dy]
                for dx in range(side):
                    windows[SHARES + column, entry] = share * splines[of_x, 0, dx]
                    entry += 1
    row, other = SHARES, SHARES + 4
    n_taps, left = _settle(
        arrays, kept_cells, walk, i, j, k, level, truncated, filter_code, parents, columns, row, 0
    )
    while left:
        shift = MAX_DEPTH - level
        if filter_code == LINEAR:
            _divide_by_color(walk, i, j, k, level, columns, row)
        for column in range(columns):
            _refine(windows, row + column, other + column, side, i >> shift & 1, True)
            _refine(windows, other + column, row + column, side, j >> shift & 1, True)
            _refine(windows, row + column, other + column, side, k >> shift & 1, True)
        row, other = other, row
        level -= 1
        n_taps, left = _settle(
            arrays, kept_cells, walk, i, j, k, level, 0, filter_code, parents, columns, row, n_taps
        )
    return n_taps


@inlined
def _settle(
    arrays: TreeArrays,
    kept_cells: Uint32s,
    walk: Walk,
    i: int,
    j: int,
    k: int,
    level: int,
    truncated: int,
    filter_code: int,
    parents: int,
    columns: int,
    row: int,
    n_taps: int,
) -> tuple[int, bool]:
    """Write taps for what falls on the leaves and kept nodes of a window.

    Returns the number of taps, and whether anything falls on cells that are refined from the window above. If
    so, only that is left in the window.
    """
    windows, masks = walk.windows, walk.masks
    side = 2 * parents - 1
    holds = walk.holds[level]
    keeping = filter_code != LINEAR and holds & KEEPING != 0
    goes_up = level > 0 and holds & (REFINED | KEEPING) != 0 and walk.holds[level - 1] & CONTENT != 0
    if keeping:
        _weigh(walk, i, j, k, level, parents)
    first = _first_entry(i, j, k, level, parents)
    left = False
    for slot in range(parents * parents * parents):
        mask = masks[level, slot]
        inside = mask >> INSIDE
        base = first + 2 * (
            slot % parents + side * (slot // parents % parents + side * (slot // (parents * parents)))
        )
        if mask & VIRTUAL:
            refined = 0 if filter_code == LINEAR and mask & 0xFF00 == 0 else inside
        else:
            nodes, stored, kept = mask & inside, mask >> 8 & inside, mask >> 16 & inside
            refined = inside & ~stored if keeping and mask & BELOW_KEPT else 0
            bits = stored if truncated else stored ^ nodes | kept
            while bits:
                child = trailing_zeros(bits)
                bits &= bits - 1
                entry = base + _entry(child, side)
                if not _any(windows, row, entry, columns):
                    continue
                cell = walk.first_cells[level, slot] + popcount(mask >> 8 & (1 << child) - 1)
                cell = min(cell, arrays.flags.size - 1)
                if kept >> child & 1 and not truncated:
                    cell = _kept_row(kept_cells, cell, arrays.flags.size)
                    if cell < 0:
                        continue
                walk.rows[n_taps] = cell
                factor = windows[REFINED_COVER + level, entry] if keeping and mask & BELOW_KEPT else 1.0
                for column in range(columns):
                    walk.taps[column, n_taps] = windows[row + column, entry] * factor
                n_taps += 1
        if goes_up:
            while inside:
                child = trailing_zeros(inside)
                inside &= inside - 1
                entry = base + _entry(child, side)
                if refined >> child & 1:
                    left = left or _any(windows, row, entry, columns)
                else:
                    for column in range(columns):
                        windows[row + column, entry] = 0.0
    return n_taps, left


@inlined
def _any(windows: Float64s, row: int, entry: int, columns: int) -> bool:
    """Say whether weight or slopes of a cell are not zero."""
    found = False
    for column in range(columns):
        found |= windows[row + column, entry] != 0.0
    return found


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
def _entry(octant: int, side: int) -> int:
    """Place of a parent's child in a window, from that of its first child."""
    return (octant & 1) + side * (octant >> 1 & 1) + side * side * (octant >> 2)


@inlined
def _first_entry(i: int, j: int, k: int, level: int, parents: int) -> int:
    """Place in a window of the first child of its first parent, which may lie outside, before it."""
    side = 2 * parents - 1
    shift = MAX_DEPTH - level
    a, b, c = (i >> shift) - parents + 1 & 1, (j >> shift) - parents + 1 & 1, (k >> shift) - parents + 1 & 1
    return -(a + side * (b + side * c))


@inlined
def _refine(windows: Float64s, source: int, target: int, side: int, upper: int, transposed: bool) -> None:
    """Refine a window along its fastest axis, which becomes the slowest: three times, and all axes are done.

    ``upper`` is 1 if the finer window is around the upper half of the cell in the middle. ``transposed``
    sends what falls on the finer cells to those that they are refined from.
    """
    for line in range(side * side):
        for n in range(side):
            total = 0.0
            for m in range(side):
                fine, coarse = (m, n) if transposed else (n, m)
                factor = REFINE_THREE[upper, fine, coarse] if side == 3 else REFINE_FIVE[upper, fine, coarse]
                total += factor * windows[source, line * side + m]
            windows[target, n * side * side + line] = total


@inlined
def _weigh(walk: Walk, i: int, j: int, k: int, level: int, parents: int) -> None:
    """Find the weights of the coefficients in the windows down to a level."""
    windows, masks = walk.windows, walk.masks
    side = 2 * parents - 1
    if walk.previous[5] < 0:
        windows[COVER, : side * side * side] = 0.0
        root = masks[0, 1 + parents + parents * parents]
        windows[COVER, side * side * side // 2] = 0.0 if root & 1 and not root >> 16 & 1 else 1.0
        walk.previous[5] = 0
    while walk.previous[5] < level:
        below = walk.previous[5] + 1
        shift = MAX_DEPTH - below
        refined = REFINED_COVER + below
        _refine(windows, COVER + below - 1, WORK, side, i >> shift & 1, False)
        _refine(windows, WORK, WORK + 1, side, j >> shift & 1, False)
        _refine(windows, WORK + 1, refined, side, k >> shift & 1, False)
        first = _first_entry(i, j, k, below, parents)
        for slot in range(parents * parents * parents):
            mask = masks[below, slot]
            base = first + 2 * (
                slot % parents + side * (slot // parents % parents + side * (slot // (parents * parents)))
            )
            nodes = mask & ~(mask >> 16)
            leaves = (mask >> 8 | mask >> 16) & ~nodes
            inside = mask >> INSIDE
            while inside:
                child = trailing_zeros(inside)
                inside &= inside - 1
                entry = base + _entry(child, side)
                weight = windows[refined, entry]
                if mask & (VIRTUAL | BELOW_KEPT) == 0:
                    weight = 1.0 if leaves >> child & 1 else 0.0
                elif mask & VIRTUAL == 0 and nodes >> child & 1:
                    weight = 0.0
                windows[COVER + below, entry] = weight
        walk.previous[5] = below


@inlined
def _divide_by_color(walk: Walk, i: int, j: int, k: int, level: int, columns: int, row: int) -> None:
    """Divide a window by the coefficients that the coloured cells of the window above have in its cells."""
    windows = walk.windows
    parents = 2
    side = 3
    above = level - 1
    for entry in range(27):
        windows[WORK, entry] = 0.0
    first = _first_entry(i, j, k, above, parents)
    for slot in range(8):
        mask = walk.masks[above, slot]
        base = first + 2 * ((slot & 1) + 3 * ((slot >> 1 & 1) + 3 * (slot >> 2)))
        colored = mask >> 8 if mask & VIRTUAL else (mask >> 8 & ~mask) | mask >> 16
        colored &= mask >> INSIDE & 0xFF
        while colored:
            child = trailing_zeros(colored)
            colored &= colored - 1
            windows[WORK, base + _entry(child, side)] = 1.0
    shift = MAX_DEPTH - level
    _refine(windows, WORK, WORK + 1, side, i >> shift & 1, False)
    _refine(windows, WORK + 1, WORK, side, j >> shift & 1, False)
    _refine(windows, WORK, WORK + 1, side, k >> shift & 1, False)
    for column in range(columns):
        for entry in range(27):
            if windows[row + column, entry] != 0.0:
                windows[row + column, entry] /= windows[WORK + 1, entry]


@kernel
def walk_all(
    arrays: TreeArrays,
    kept_cells: Uint32s,
    points: npt.NDArray[np.float32 | np.float64],
    first_point: int,
    origin: Origin,
    size: float,
    filter_code: int,
    walk: Walk,
    starts: Int64s,
    rows: Uint32s,
    weights: Float32s,
    slopes: Float32s,
) -> int:
    """Write the taps of rest positions (n, 3) from index ``first_point`` on, one point after another.

    Point n of them has taps ``starts[n]`` to ``starts[n + 1]`` − 1; ``starts`` has room for all and one more,
    the others are as in ``walk_taps``, slopes by rest position. Stops where there might be no room for a
    point's taps. Returns the number of points done, or −1 − the index of a point that is not finite.
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
        end = walk_taps(arrays, kept_cells, x, y, z, filter_code, walk, rows, weights, slopes, end)
        done += 1
        starts[done] = end
    if slopes.shape[0] > 0:
        for n in range(end):
            slopes[n, 0] /= size
            slopes[n, 1] /= size
            slopes[n, 2] /= size
    return done
