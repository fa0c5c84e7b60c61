"""The taps of one lookup in any octree: the cells around a point, followed down from the root.

The *window* of a level is the 3×3×3 cells of that level around the point, 5×5×5 for quartic. They are
children of a *block* of 2×2×2 (3×3×3) parents, which lie in the window of the level above:

    window      + + +        c: the cell that holds the point
                + c +        the block's children are one more along each axis than the window:
                + + +        it begins at the first or the second of them

A walk goes down from window to window, a group read a parent, until no cell of the window is a node. There
the spline's weights fall on the cells. Leaves take theirs; those of cells below leaves and empty cells are
sent up to the cells that they are refined from, until all weight has come to rest on leaves, nodes and empty
cells; what lies on leaves and kept coefficients is the answer.

(Paper 3.4, after Kobbelt et al. 1997.)
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.field.splines import (
    LINEAR,
    QUARTIC,
    linear_slopes,
    linear_weights,
    quadratic_slopes,
    quadratic_weights,
    quartic_slopes,
    quartic_weights,
    refinement,
)
from octex.jit import inlined, kernel, popcount, trailing_zeros
from octex.tree.layout import KEPT, MAX_DEPTH, TreeArrays
from octex.tree.search import UNITS, Origin

Int64s = npt.NDArray[np.int64]
Uint64s = npt.NDArray[np.uint64]
Float64s = npt.NDArray[np.float64]
Float32s = npt.NDArray[np.float32]
Uint32s = npt.NDArray[np.uint32]

#: No point has more taps: every cell of every window.
MOST_TAPS = (MAX_DEPTH + 1) * 125

# Columns of Walk.levels. Slots number the parents of a block, x fastest.
NODES = 0  # whether the window has nodes
CONTENT = 1  # whether it or one above has leaves or kept coefficients
REFINED = 2  # bits of the slots whose parent is no node: their children are refined
BELOW_LEAF = 3  # bits of those among them that are below a leaf
BELOW_KEPT = 4  # bits of the slots whose parent is a node with a kept coefficient
ABOVE = 5  # where the block begins among the children of the block above: x + 3·y + 9·z, each 0 to 2
BEGIN = 6  # where the window begins among the children of the block: x + 2·y + 4·z, each 0 or 1

# Rows of Walk.windows.
COVER = 0  # 22 rows: of each level, the weights of the window's coefficients
REFINED_COVER = 22  # 22 rows: of each level, the weights refined from the window above
COLOR = 44  # which cells of a window have a colour
SHARES = 45  # 2 × 4 rows: weights and slopes that fall on a window's cells


class Walk(NamedTuple):
    """What walks through one tree remember from one point to the next, and where they work.

    Child 8·slot + octant of a block has bit (child & 63) of the words [level, child >> 6].
    """

    previous: Int64s  # (6,)   the previous position; its last level; filter; last level of COVER
    levels: Int64s  # (22, 7)   what is known of each level
    nodes: Uint64s  # (22, 4)   which children are nodes
    cells: Uint64s  # (22, 4)   which are stored
    kept: Uint64s  # (22, 4)   which are nodes with kept coefficients
    first_nodes: Int64s  # (22, 27)   by slot: node number of the parent's first child node
    first_cells: Int64s  # (22, 27)   by slot: cell number of its first child
    windows: Float64s  # (53, 512)   what lies on the children of a block, in a frame that is one wider
    taps: Float64s  # (4, MOST_TAPS)   weights and slopes before they are normalized


Table = npt.NDArray[np.uint8]


def _tables() -> tuple[Table, Table, Uint64s, npt.NDArray[np.uint16], Uint64s]:
    """Tabulate what is where in blocks of 2³ and of 3³ parents."""
    parent_at, slot_at = np.zeros((2, 27, 27), np.uint8), np.zeros((2, 27, 216), np.uint8)
    parents_of, inside = np.zeros((2, 27, 4), np.uint64), np.zeros((2, 8, 4), np.uint64)
    places = np.zeros((2, 216), np.uint16)
    for which, parents in enumerate((2, 3)):
        frame = 2 * parents + 2
        slots = [(x, y, z) for z, y, x in product(range(parents), repeat=3)]
        octants = [(x, y, z) for z, y, x in product(range(2), repeat=3)]
        children = {}
        for slot, octant in product(range(len(slots)), range(8)):
            x, y, z = (2 * q + o for q, o in zip(slots[slot], octants[octant], strict=True))
            child = 8 * slot + octant
            children[x, y, z] = child
            places[which, child] = x + 1 + frame * (y + 1 + frame * (z + 1))
            for begin, starts in enumerate(octants):
                if all(0 <= c - start <= 2 * parents - 2 for c, start in zip((x, y, z), starts, strict=True)):
                    inside[which, begin, child >> 6] |= np.uint64(1 << (child & 63))
        for above, slot in product(range(27), range(len(slots))):
            firsts = (above % 3, above // 3 % 3, above // 9)
            x, y, z = (first + q for first, q in zip(firsts, slots[slot], strict=True))
            child = children[x, y, z]
            parent_at[which, above, slot] = child
            slot_at[which, above, child] = slot
            parents_of[which, above, child >> 6] |= np.uint64(1 << (child & 63))
    return parent_at, slot_at, parents_of, places, inside


# All [parents − 2, …]:
# PARENT_AT [ABOVE, slot]    which child of the block above a parent is
# SLOT_AT [ABOVE, child]     the slot of a child of the block above
# PARENTS [ABOVE, word]      which children of the block above are parents
# PLACES [child]             a child's place in a window's frame
# INSIDE [BEGIN, word]       which children are in the window
PARENT_AT, SLOT_AT, PARENTS, PLACES, INSIDE = _tables()


@kernel
def new_walk() -> Walk:
    """Return a walk without memory. A walk serves one tree, and all filters."""
    return Walk(
        np.full(6, -1, np.int64),
        np.zeros((MAX_DEPTH + 1, 7), np.int64),
        np.zeros((MAX_DEPTH + 1, 4), np.uint64),
        np.zeros((MAX_DEPTH + 1, 4), np.uint64),
        np.zeros((MAX_DEPTH + 1, 4), np.uint64),
        np.zeros((MAX_DEPTH + 1, 27), np.int64),
        np.zeros((MAX_DEPTH + 1, 27), np.int64),
        np.zeros((SHARES + 8, 512), np.float64),
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
) -> int:
    x, y, z = _rounded(x), _rounded(y), _rounded(z)
    i, j, k = _place(x), _place(y), _place(z)
    columns = 4 if slopes.shape[0] > 0 else 1
    level = _follow(arrays, kept_cells, walk, i, j, k, filter_code, parents)
    truncated = False
    while True:
        _fill(walk, filter_code, parents, columns, x, y, z, i, j, k, level)
        n_taps, total = _collect(
            arrays, kept_cells, walk, level, truncated, filter_code, parents, columns, rows, first
        )
        if total > 0.0 or (level == 0 and truncated):
            break
        # Off the surface: next is the level above, or this one if it is the last and yet holds nodes.
        if truncated or walk.levels[level, NODES] == 0:
            level -= 1
        truncated = True
    _normalize(walk, n_taps, total, weights, slopes, first)
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
    walk: Walk, n_taps: int, total: float, weights: Float32s, slopes: Float32s, first: int
) -> None:
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


@inlined
def _bit(place: int) -> np.uint64:
    return np.uint64(1) << np.uint64(place)


@inlined
def _below(place: int) -> np.uint64:
    return (np.uint64(1) << np.uint64(place)) - np.uint64(1)


@inlined
def _follow(
    arrays: TreeArrays,
    kept_cells: Uint32s,
    walk: Walk,
    i: int,
    j: int,
    k: int,
    filter_code: int,
    parents: int,
) -> int:
    """Go down to the first level whose window holds no node, and return it."""
    previous = walk.previous
    difference = (i ^ previous[0]) | (j ^ previous[1]) | (k ^ previous[2])
    level = int(previous[3])
    if level < 0 or previous[4] != filter_code:
        _enter(arrays, kept_cells, walk, parents)
        previous[4], previous[5] = filter_code, -1
        level = 0
    while level > 0 and difference >> (MAX_DEPTH - level) != 0:
        level -= 1
    previous[5] = min(previous[5], level)
    deepest = min(arrays.level_cells.size - 2, MAX_DEPTH)
    while walk.levels[level, NODES] and level < deepest:
        level += 1
        _go_down(arrays, walk, i, j, k, level, parents)
        if filter_code == LINEAR:
            _find_below_leaves(walk, level)
        if kept_cells.size > 0:
            _find_kept(arrays, walk, level, parents)
    previous[0], previous[1], previous[2], previous[3] = i, j, k, level
    return level


@inlined
def _enter(arrays: TreeArrays, kept_cells: Uint32s, walk: Walk, parents: int) -> None:
    """Write the root's window: it is the first child of the slot in the middle, the others have none."""
    is_node = arrays.groups.shape[0] > 0
    keeps = is_node and kept_cells.size > 0 and arrays.flags[0] & KEPT != 0
    for word in range(4):
        walk.nodes[0, word] = walk.cells[0, word] = walk.kept[0, word] = 0
    middle = 1 + parents + parents * parents
    word, bit = middle >> 3, _bit(8 * (middle & 7))
    walk.cells[0, word] = bit
    if is_node:
        walk.nodes[0, word] = bit
    if keeps:
        walk.kept[0, word] = bit
    walk.first_nodes[0, middle] = walk.first_cells[0, middle] = 0
    levels = walk.levels
    levels[0, NODES] = is_node
    levels[0, CONTENT] = keeps or not is_node
    levels[0, REFINED] = levels[0, BELOW_LEAF] = levels[0, BELOW_KEPT] = levels[0, ABOVE] = 0
    levels[0, BEGIN] = 7 if parents == 2 else 0


@inlined
def _go_down(arrays: TreeArrays, walk: Walk, i: int, j: int, k: int, level: int, parents: int) -> None:
    """Find the window of a level from that of the level above."""
    levels, nodes, cells = walk.levels, walk.nodes, walk.cells
    groups = arrays.groups
    words = 1 if parents == 2 else 4
    # the first cells of this window and of that above
    shift = MAX_DEPTH - level
    reach = parents - 1
    a, b, c = (i >> shift) - reach, (j >> shift) - reach, (k >> shift) - reach
    u, v, w = (i >> shift + 1) - reach, (j >> shift + 1) - reach, (k >> shift + 1) - reach
    above = (a >> 1) - (u & ~1) + 3 * ((b >> 1) - (v & ~1)) + 9 * ((c >> 1) - (w & ~1))
    begin = a & 1 | (b & 1) << 1 | (c & 1) << 2
    for word in range(words):
        nodes[level, word] = cells[level, word] = 0
    slots = 0
    for word in range(words):
        above_nodes = nodes[level - 1, word]
        bits = above_nodes & PARENTS[parents - 2, above, word]
        while bits != 0:
            place = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            slot = np.int64(SLOT_AT[parents - 2, above, 64 * word + place])
            slots |= 1 << slot
            node = walk.first_nodes[level - 1, 8 * word + (place >> 3)] + _rank(above_nodes, place)
            group = min(node >> 3, groups.shape[0] - 1)
            in_group = 8 * (node & 7)
            below = _below(in_group)
            group_nodes = groups[group, 0]
            group_cells = group_nodes | groups[group, 1]
            firsts = groups[group, 2]
            first_node, first_cell = firsts & np.uint64(0xFFFFFFFF), firsts >> np.uint64(32)
            walk.first_nodes[level, slot] = np.int64(first_node) + popcount(group_nodes & below)
            walk.first_cells[level, slot] = np.int64(first_cell) + popcount(group_cells & below)
            at = np.uint64(8 * (slot & 7))
            nodes[level, slot >> 3] |= (group_nodes >> np.uint64(in_group) & np.uint64(0xFF)) << at
            cells[level, slot >> 3] |= (group_cells >> np.uint64(in_group) & np.uint64(0xFF)) << at
    has_nodes = has_leaves = np.uint64(0)
    for word in range(words):
        has_nodes |= nodes[level, word] & INSIDE[parents - 2, begin, word]
        has_leaves |= (nodes[level, word] ^ cells[level, word]) & INSIDE[parents - 2, begin, word]
    levels[level, NODES] = has_nodes != 0
    levels[level, CONTENT] = has_leaves != 0 or levels[level - 1, CONTENT]
    levels[level, REFINED] = slots ^ (1 << parents * parents * parents) - 1
    levels[level, BELOW_KEPT] = 0
    levels[level, ABOVE] = above
    levels[level, BEGIN] = begin


@inlined
def _find_below_leaves(walk: Walk, level: int) -> None:
    """Find the parents of a block that are leaves or below one."""
    leaves = walk.cells[level - 1, 0] ^ walk.nodes[level - 1, 0]
    slots = 0
    for slot in range(8):
        child = np.int64(PARENT_AT[0, walk.levels[level, ABOVE], slot])
        if leaves & _bit(child) != 0 or walk.levels[level - 1, BELOW_LEAF] >> (child >> 3) & 1:
            slots |= 1 << slot
    walk.levels[level, BELOW_LEAF] = slots


@inlined
def _find_kept(arrays: TreeArrays, walk: Walk, level: int, parents: int) -> None:
    """Find the parents of a block and the nodes of a window that have kept coefficients."""
    levels = walk.levels
    for word in range(1 if parents == 2 else 4):
        bits = walk.kept[level - 1, word] & PARENTS[parents - 2, levels[level, ABOVE], word]
        while bits != 0:
            place = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            levels[level, BELOW_KEPT] |= 1 << np.int64(
                SLOT_AT[parents - 2, levels[level, ABOVE], 64 * word + place]
            )
        kept = np.uint64(0)
        bits = walk.nodes[level, word] & INSIDE[parents - 2, levels[level, BEGIN], word]
        while bits != 0:
            place = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            if arrays.flags[_cell(arrays, walk, level, word, place)] & KEPT:
                kept |= _bit(place)
        walk.kept[level, word] = kept
        if kept != 0:
            levels[level, CONTENT] = 1


@inlined
def _rank(word: np.uint64, place: int) -> int:
    """Count a parent's children, of those in a word, that are before the one at a place."""
    return popcount(word >> np.uint64(place & 56) & _below(place & 7))


@inlined
def _cell(arrays: TreeArrays, walk: Walk, level: int, word: int, place: int) -> int:
    """Cell number of a block's child."""
    cell = walk.first_cells[level, 8 * word + (place >> 3)] + _rank(walk.cells[level, word], place)
    return min(cell, arrays.flags.size - 1)


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
    frame = 2 * parents + 2
    begin = walk.levels[level, BEGIN]
    first = 1 + (begin & 1) + frame * (1 + (begin >> 1 & 1) + frame * (1 + (begin >> 2)))
    shift = MAX_DEPTH - level
    cells = float(1 << level)
    x, y, z = x * cells - (i >> shift), y * cells - (j >> shift), z * cells - (k >> shift)
    clears = level > 0 and walk.levels[level - 1, CONTENT] != 0  # for what is sent up
    for column in range(columns):
        if clears:
            windows[SHARES + column, : frame * frame * frame] = 0.0
        of_x = _spline(filter_code, column == 1, x, cells)
        of_y = _spline(filter_code, column == 2, y, cells)
        of_z = _spline(filter_code, column == 3, z, cells)
        for dz in range(2 * parents - 1):
            for dy in range(2 * parents - 1):
                share = of_z[dz] * of_y[dy]
                at = first + frame * (dy + frame * dz)
                for dx in range(2 * parents - 1):
                    windows[SHARES + column, at + dx] = share * of_x[dx]


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
def _collect(
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
    row, other = SHARES, SHARES + 4
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
            row,
            rows,
            first,
            n_taps,
            total,
        )
        if level == 0 or walk.levels[level - 1, CONTENT] == 0:
            break
        if not _send_up(walk, level, filter_code, parents, columns, row, other):
            break
        row, other = other, row
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
    row: int,
    rows: Uint32s,
    first: int,
    n_taps: int,
    total: float,
) -> tuple[int, float]:
    """Write taps for what falls on the leaves and kept nodes of a window; return number and weight of all."""
    windows = walk.windows
    below_kept = 0 if filter_code == LINEAR else walk.levels[level, BELOW_KEPT]
    if below_kept:
        _weigh(walk, level, parents)
    for word in range(1 if parents == 2 else 4):
        nodes, stored, kept = walk.nodes[level, word], walk.cells[level, word], np.uint64(0)
        if kept_cells.size > 0 and not truncated:
            kept = walk.kept[level, word]
        bits = (stored if truncated else stored ^ nodes | kept) & INSIDE[
            parents - 2, walk.levels[level, BEGIN], word
        ]
        while bits != 0:
            place = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            cell = _cell(arrays, walk, level, word, place)
            at = np.int64(PLACES[parents - 2, 64 * word + place])
            factor = 1.0
            if kept_cells.size > 0:
                if below_kept >> 8 * word + (place >> 3) & 1:
                    factor = windows[REFINED_COVER + level, at]
                if kept & _bit(place) != 0:
                    cell = _kept_row(kept_cells, cell, arrays.flags.size)
            share = windows[row, at] * factor
            walk.taps[0, n_taps] = share
            rows[first + n_taps] = max(cell, 0)
            any_share = share != 0.0
            for column in range(1, columns):
                slope = windows[row + column, at] * factor
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
def _send_up(
    walk: Walk, level: int, filter_code: int, parents: int, columns: int, row: int, other: int
) -> bool:
    """Send what falls on refined cells up to those that they are refined from.

    Returns whether there was any. What falls on the window above stands in the rows from ``other`` on.
    """
    windows, levels = walk.windows, walk.levels
    frame = 2 * parents + 2
    slots = levels[level, REFINED]
    if filter_code == LINEAR:
        slots &= levels[level, BELOW_LEAF]
        if slots:
            _find_colors(walk, level - 1)
    else:
        slots |= levels[level, BELOW_KEPT]
    moved = False
    while slots:
        slot = trailing_zeros(slots)
        slots &= slots - 1
        first = np.int64(PLACES[parents - 2, 8 * slot])
        if levels[level, BELOW_KEPT] >> slot & 1:  # only its empty cells are refined
            for octant in range(8):
                if walk.cells[level, slot >> 3] & _bit(8 * (slot & 7) + octant) != 0:
                    for column in range(columns):
                        windows[row + column, np.int64(PLACES[parents - 2, 8 * slot + octant])] = 0.0
        if not _any(windows, row, first, frame, columns):
            continue
        if not moved:
            for column in range(columns):
                windows[other + column, : frame * frame * frame] = 0.0
            moved = True
        parent = np.int64(PLACES[parents - 2, np.int64(PARENT_AT[parents - 2, levels[level, ABOVE], slot])])
        if filter_code == LINEAR:
            for octant in range(8):
                total = _refined(windows, COLOR, parent, frame, octant)
                at = first + (octant & 1) + frame * ((octant >> 1 & 1) + frame * (octant >> 2))
                for column in range(columns):
                    windows[row + column, at] /= total
        for column in range(columns):
            _spread(windows, row + column, first, other + column, parent, frame)
    return moved


@inlined
def _any(windows: Float64s, row: int, first: int, frame: int, columns: int) -> bool:
    """Say whether anything falls on the eight children of a parent, of which the first is at ``first``."""
    found = False
    for column in range(columns):
        for octant in range(8):
            at = first + (octant & 1) + frame * ((octant >> 1 & 1) + frame * (octant >> 2))
            found |= windows[row + column, at] != 0.0
    return found


@inlined
def _spread(windows: Float64s, row: int, first: int, row_above: int, parent: int, frame: int) -> None:
    """Spread what falls on the eight children of a parent over it and the cells around it."""
    near, middle, far = refinement(frame == 8)
    up, back = frame, frame * frame
    for dz in range(3):
        low, high = (
            near if dz == 0 else middle if dz == 1 else far,
            far if dz == 0 else middle if dz == 1 else near,
        )
        a = low * windows[row, first] + high * windows[row, first + back]
        b = low * windows[row, first + 1] + high * windows[row, first + 1 + back]
        c = low * windows[row, first + up] + high * windows[row, first + up + back]
        d = low * windows[row, first + 1 + up] + high * windows[row, first + 1 + up + back]
        for dy in range(3):
            low, high = (
                near if dy == 0 else middle if dy == 1 else far,
                far if dy == 0 else middle if dy == 1 else near,
            )
            e, f = low * a + high * c, low * b + high * d
            at = parent + up * (dy - 1) + back * (dz - 1)
            windows[row_above, at - 1] += near * e + far * f
            windows[row_above, at] += middle * (e + f)
            windows[row_above, at + 1] += far * e + near * f


@inlined
def _refined(windows: Float64s, row: int, parent: int, frame: int, octant: int) -> float:
    """Refine a child of a parent from it and the cells around it."""
    near, middle, far = refinement(frame == 8)
    # toward the child's side
    x, y, z = 2 * (octant & 1) - 1, 2 * (octant >> 1 & 1) - 1, 2 * (octant >> 2) - 1
    total = 0.0
    for dz in range(-1, 2):
        factor_z = middle if dz == 0 else near if dz == z else far
        for dy in range(-1, 2):
            factor_yz = factor_z * (middle if dy == 0 else near if dy == y else far)
            at = parent + frame * (dy + frame * dz)
            total += factor_yz * (
                near * windows[row, at + x] + middle * windows[row, at] + far * windows[row, at - x]
            )
    return total


@inlined
def _find_colors(walk: Walk, level: int) -> None:
    """Write 1 for the cells of a window that have a colour as ``linear`` sees it, and 0 for the others."""
    windows, levels = walk.windows, walk.levels
    windows[COLOR, :216] = 0.0
    nodes, cells, kept = walk.nodes[level, 0], walk.cells[level, 0], walk.kept[level, 0]
    inside = INSIDE[0, levels[level, BEGIN], 0]
    for slot in range(8):
        below_leaf = levels[level, BELOW_LEAF] >> slot & 1
        for octant in range(8):
            bit = _bit(8 * slot + octant)
            if inside & bit != 0 and (below_leaf or (cells ^ nodes | kept) & bit != 0):
                windows[COLOR, np.int64(PLACES[0, 8 * slot + octant])] = 1.0


@inlined
def _weigh(walk: Walk, level: int, parents: int) -> None:
    """Find the weights of the coefficients in the windows down to a level."""
    windows, levels = walk.windows, walk.levels
    frame = 2 * parents + 2
    if walk.previous[5] < 0:
        windows[COVER, : frame * frame * frame] = 0.0
        middle = 1 + parents + parents * parents
        windows[COVER, np.int64(PLACES[parents - 2, 8 * middle])] = levels[0, CONTENT]
        walk.previous[5] = 0
    while walk.previous[5] < level:
        walk.previous[5] += 1
        below = walk.previous[5]
        for slot in range(parents * parents * parents):
            word = slot >> 3
            parent = np.int64(
                PLACES[parents - 2, np.int64(PARENT_AT[parents - 2, levels[below, ABOVE], slot])]
            )
            is_refined = levels[below, REFINED] >> slot & 1
            is_below_kept = levels[below, BELOW_KEPT] >> slot & 1
            for octant in range(8):
                bit = _bit(8 * (slot & 7) + octant)
                if INSIDE[parents - 2, levels[below, BEGIN], word] & bit == 0:
                    continue
                at = np.int64(PLACES[parents - 2, 8 * slot + octant])
                weight = 0.0
                if is_refined or is_below_kept:
                    weight = _refined(windows, COVER + below - 1, parent, frame, octant)
                    windows[REFINED_COVER + below, at] = weight
                if not is_refined:
                    if walk.nodes[below, word] & ~walk.kept[below, word] & bit != 0:
                        weight = 0.0
                    elif walk.cells[below, word] & bit != 0 and not is_below_kept:
                        weight = 1.0
                windows[COVER + below, at] = weight


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
