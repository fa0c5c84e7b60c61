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
    refine,
    send_up,
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

# Columns of Walk.levels.
NODES = 0  # whether the window has nodes
CONTENT = 1  # whether it or one above has leaves or kept coefficients
KEEPING = 2  # whether parents have kept coefficients
ABOVE = 3  # where the block begins among the children of the block above: x + 3·y + 9·z, each 0 to 2
BEGIN = 4  # where the window begins among the children of the block: x + 2·y + 4·z, each 0 or 1
UPPER = 5  # in which half of its parent the cell in the middle lies: x + 2·y + 4·z

# Rows of Walk.windows.
COVER = 0  # 22 rows: of each level, the weights of the window's coefficients
REFINED = 22  # 22 rows: of each level, the weights refined from the window above
COLOR = 44  # how much of a refined cell's colour comes from coloured cells
SHARES = 45  # 4 rows: weights and slopes that fall on a window's cells


class Walk(NamedTuple):
    """What walks through one tree remember from one point to the next, and where they work.

    Slots number the parents of a block, and places the cells of a window, x fastest. Child 8·slot + octant of
    a block has bit (child & 63) of the words [level, child >> 6].
    """

    previous: Int64s  # (6,)   the previous position; its last level; filter; last level of COVER
    levels: Int64s  # (22, 6)   what is known of each level
    real: Uint64s  # (22, 4)   which children have a parent that is a node; the others are refined
    nodes: Uint64s  # (22, 4)   which of them are nodes
    cells: Uint64s  # (22, 4)   which are stored
    kept: Uint64s  # (22, 4)   which are nodes with kept coefficients
    below_kept: Uint64s  # (22, 4)   which have such a parent
    below_leaves: Uint64s  # (22, 4)   which are below a leaf; for LINEAR
    first_nodes: Int64s  # (22, 27)   by slot: node number of the parent's first child node
    first_cells: Int64s  # (22, 27)   by slot: cell number of its first child
    windows: Float64s  # (49, 125)   what lies on a window's cells, by place
    taps: Float64s  # (4, MOST_TAPS)   weights and slopes before they are normalized


Table = npt.NDArray[np.uint8]

BYTE = np.uint64(0xFF)


def _tables() -> tuple[Table, Table, Uint64s, Table, Uint64s]:
    """Tabulate what is where in blocks of 2³ and of 3³ parents."""
    parent_at, slot_at = np.zeros((2, 27, 27), np.uint8), np.zeros((2, 27, 216), np.uint8)
    parents_of, inside = np.zeros((2, 27, 4), np.uint64), np.zeros((2, 8, 4), np.uint64)
    places = np.zeros((2, 8, 216), np.uint8)
    octants = [(x, y, z) for z, y, x in product(range(2), repeat=3)]
    for which, parents in enumerate((2, 3)):
        side = 2 * parents - 1
        slots = [(x, y, z) for z, y, x in product(range(parents), repeat=3)]
        children = {}
        for slot, octant in product(range(len(slots)), range(8)):
            at = [2 * q + o for q, o in zip(slots[slot], octants[octant], strict=True)]
            child = children[tuple(at)] = 8 * slot + octant
            for begin, starts in enumerate(octants):
                x, y, z = (c - start for c, start in zip(at, starts, strict=True))
                if 0 <= min(x, y, z) <= max(x, y, z) < side:
                    inside[which, begin, child >> 6] |= np.uint64(1 << (child & 63))
                    places[which, begin, child] = x + side * (y + side * z)
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
# PLACES [BEGIN, child]      a child's place in the window
# INSIDE [BEGIN, word]       which children are in the window
PARENT_AT, SLOT_AT, PARENTS, PLACES, INSIDE = _tables()


@kernel
def new_walk() -> Walk:
    """Return a walk without memory. A walk serves one tree, and all filters."""
    levels = MAX_DEPTH + 1
    return Walk(
        np.full(6, -1, np.int64),
        np.zeros((levels, 6), np.int64),
        np.zeros((levels, 4), np.uint64),
        np.zeros((levels, 4), np.uint64),
        np.zeros((levels, 4), np.uint64),
        np.zeros((levels, 4), np.uint64),
        np.zeros((levels, 4), np.uint64),
        np.zeros((levels, 4), np.uint64),
        np.zeros((levels, 27), np.int64),
        np.zeros((levels, 27), np.int64),
        np.zeros((SHARES + 4, 125), np.float64),
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
    i, j, k = _finest(x), _finest(y), _finest(z)
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
def _finest(x: float) -> int:
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
def _parent(parents: int, above: int, slot: int) -> int:
    """Say which child of the block above a parent is."""
    return int(np.int64(PARENT_AT[parents - 2, above, slot]))


@inlined
def _slot(parents: int, above: int, child: int) -> int:
    """Say in which slot a child of the block above is a parent."""
    return int(np.int64(SLOT_AT[parents - 2, above, child]))


@inlined
def _place(parents: int, begin: int, child: int) -> int:
    """Say where a child lies in a window."""
    return int(np.int64(PLACES[parents - 2, begin, child]))


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
    middle = 1 + parents + parents * parents
    for word in range(4):
        root = _bit(8 * (middle & 7)) if word == middle >> 3 else np.uint64(0)
        walk.real[0, word] = ~np.uint64(0)
        walk.cells[0, word] = root
        walk.nodes[0, word] = root if is_node else np.uint64(0)
        walk.kept[0, word] = root if keeps else np.uint64(0)
        walk.below_kept[0, word] = walk.below_leaves[0, word] = 0
    walk.first_nodes[0, middle] = walk.first_cells[0, middle] = 0
    levels = walk.levels
    levels[0, NODES] = is_node
    levels[0, CONTENT] = keeps or not is_node
    levels[0, KEEPING] = 0
    levels[0, BEGIN] = 7 if parents == 2 else 0


@inlined
def _go_down(arrays: TreeArrays, walk: Walk, i: int, j: int, k: int, level: int, parents: int) -> None:
    """Find the window of a level from that of the level above."""
    levels, real, nodes, cells = walk.levels, walk.real, walk.nodes, walk.cells
    groups = arrays.groups
    words = 1 if parents == 2 else 4
    # the first cells of this window and of that above
    shift = MAX_DEPTH - level
    reach = parents - 1
    a, b, c = (i >> shift) - reach, (j >> shift) - reach, (k >> shift) - reach
    u, v, w = (i >> shift + 1) - reach, (j >> shift + 1) - reach, (k >> shift + 1) - reach
    above = (a >> 1) - (u & ~1) + 3 * ((b >> 1) - (v & ~1)) + 9 * ((c >> 1) - (w & ~1))
    begin = a & 1 | (b & 1) << 1 | (c & 1) << 2
    upper = i >> shift & 1 | (j >> shift & 1) << 1 | (k >> shift & 1) << 2
    for word in range(words):
        real[level, word] = nodes[level, word] = cells[level, word] = 0
    for word in range(words):
        above_nodes = nodes[level - 1, word]
        bits = above_nodes & PARENTS[parents - 2, above, word]
        while bits != 0:
            place = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            slot = _slot(parents, above, 64 * word + place)
            node = walk.first_nodes[level - 1, 8 * word + (place >> 3)] + _rank(above_nodes, place)
            group = min(node >> 3, groups.shape[0] - 1)
            in_group = 8 * (node & 7)
            below = _below(in_group)
            group_nodes = groups[group, 0]
            group_cells = group_nodes | groups[group, 1]
            firsts = groups[group, 2]
            first_node, first_cell = firsts & np.uint64(0xFFFFFFFF), firsts >> np.uint64(32)
            walk.first_nodes[level, slot] = int(np.int64(first_node)) + popcount(group_nodes & below)
            walk.first_cells[level, slot] = int(np.int64(first_cell)) + popcount(group_cells & below)
            at = np.uint64(8 * (slot & 7))
            real[level, slot >> 3] |= BYTE << at
            nodes[level, slot >> 3] |= (group_nodes >> np.uint64(in_group) & BYTE) << at
            cells[level, slot >> 3] |= (group_cells >> np.uint64(in_group) & BYTE) << at
    has_nodes = has_leaves = np.uint64(0)
    for word in range(words):
        has_nodes |= nodes[level, word] & INSIDE[parents - 2, begin, word]
        has_leaves |= (nodes[level, word] ^ cells[level, word]) & INSIDE[parents - 2, begin, word]
    levels[level, NODES] = has_nodes != 0
    levels[level, CONTENT] = has_leaves != 0 or levels[level - 1, CONTENT]
    levels[level, KEEPING] = 0
    levels[level, ABOVE] = above
    levels[level, BEGIN] = begin
    levels[level, UPPER] = upper


@inlined
def _find_below_leaves(walk: Walk, level: int) -> None:
    """Find which children of a block are below a leaf."""
    leaves = walk.cells[level - 1, 0] ^ walk.nodes[level - 1, 0] | walk.below_leaves[level - 1, 0]
    walk.below_leaves[level, 0] = 0
    for slot in range(8):
        if leaves & _bit(_parent(2, walk.levels[level, ABOVE], slot)) != 0:
            walk.below_leaves[level, 0] |= BYTE << np.uint64(8 * slot)


@inlined
def _find_kept(arrays: TreeArrays, walk: Walk, level: int, parents: int) -> None:
    """Find which nodes of a window, and which parents of its block, have kept coefficients."""
    levels, below_kept = walk.levels, walk.below_kept
    words = 1 if parents == 2 else 4
    for word in range(words):
        below_kept[level, word] = 0
    for word in range(words):
        bits = walk.kept[level - 1, word] & PARENTS[parents - 2, levels[level, ABOVE], word]
        while bits != 0:
            slot = _slot(parents, levels[level, ABOVE], 64 * word + trailing_zeros(bits))
            bits &= bits - np.uint64(1)
            below_kept[level, slot >> 3] |= BYTE << np.uint64(8 * (slot & 7))
            levels[level, KEEPING] = 1
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
    return min(int(cell), arrays.flags.size - 1)


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
        if not _leave_refined(walk, level, filter_code, parents, columns):
            break
        for column in range(columns):
            _change_level(walk, SHARES + column, level, parents, False)
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
        _weigh(walk, level, parents)
    for word in range(1 if parents == 2 else 4):
        nodes, stored, kept = walk.nodes[level, word], walk.cells[level, word], np.uint64(0)
        if kept_cells.size > 0 and not truncated:
            kept = walk.kept[level, word]
        bits = (stored if truncated else stored ^ nodes | kept) & INSIDE[parents - 2, begin, word]
        while bits != 0:
            place = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            cell = _cell(arrays, walk, level, word, place)
            at = _place(parents, begin, 64 * word + place)
            factor = 1.0
            if kept_cells.size > 0:
                if keeping and walk.below_kept[level, word] & _bit(place) != 0:
                    factor = windows[REFINED + level, at]
                if kept & _bit(place) != 0:
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
def _leave_refined(walk: Walk, level: int, filter_code: int, parents: int, columns: int) -> bool:
    """Leave in a window what falls on cells that are refined, and nothing else; say whether there is any."""
    windows, levels = walk.windows, walk.levels
    begin = levels[level, BEGIN]
    if filter_code == LINEAR:
        _find_colors(walk, level)
    found = False
    for word in range(1 if parents == 2 else 4):
        inside = INSIDE[parents - 2, begin, word]
        refined = ~walk.real[level, word]
        if filter_code == LINEAR:
            refined = walk.below_leaves[level, word]
        elif levels[level, KEEPING]:
            refined |= walk.below_kept[level, word] & ~walk.cells[level, word]
        bits = inside & ~refined
        while bits != 0:
            at = _place(parents, begin, 64 * word + trailing_zeros(bits))
            bits &= bits - np.uint64(1)
            for column in range(columns):
                windows[SHARES + column, at] = 0.0
        bits = inside & refined
        while bits != 0:
            at = _place(parents, begin, 64 * word + trailing_zeros(bits))
            bits &= bits - np.uint64(1)
            for column in range(columns):
                found |= windows[SHARES + column, at] != 0.0
                if filter_code == LINEAR:
                    windows[SHARES + column, at] /= windows[COLOR, at]
    return found


@inlined
def _change_level(walk: Walk, row: int, level: int, parents: int, down: bool) -> None:
    """Refine a row from the window above a level to that of the level, or send it up to the one above."""
    windows = walk.windows
    side = 2 * parents - 1
    for axis in range(3):
        step = 1 if axis == 0 else side if axis == 1 else side * side
        upper = walk.levels[level, UPPER] >> axis & 1
        first = (side - 1) * step if upper else 0
        way = -step if upper else step
        for m in range(side):
            for n in range(side):
                at = first + (n if axis else side * n) + (m * side if axis == 2 else side * side * m)
                a, b, c = windows[row, at], windows[row, at + way], windows[row, at + 2 * way]
                d = e = 0.0
                if side == 5:
                    d, e = windows[row, at + 3 * way], windows[row, at + 4 * way]
                a, b, c, d, e = (
                    refine(side == 5, a, b, c, d, e) if down else send_up(side == 5, a, b, c, d, e)
                )
                windows[row, at], windows[row, at + way], windows[row, at + 2 * way] = a, b, c
                if side == 5:
                    windows[row, at + 3 * way], windows[row, at + 4 * way] = d, e


@inlined
def _find_colors(walk: Walk, level: int) -> None:
    """Find how much of the refined cells of a window comes from cells with a colour, as ``linear`` has it."""
    windows = walk.windows
    begin = walk.levels[level - 1, BEGIN]
    windows[COLOR, :27] = 0.0
    nodes, cells, kept = walk.nodes[level - 1, 0], walk.cells[level - 1, 0], walk.kept[level - 1, 0]
    bits = (cells ^ nodes | kept | walk.below_leaves[level - 1, 0]) & INSIDE[0, begin, 0]
    while bits != 0:
        windows[COLOR, _place(2, begin, trailing_zeros(bits))] = 1.0
        bits &= bits - np.uint64(1)
    _change_level(walk, COLOR, level, 2, True)


@inlined
def _weigh(walk: Walk, level: int, parents: int) -> None:
    """Find the weights of the coefficients in the windows down to a level."""
    windows, levels = walk.windows, walk.levels
    places = 125 if parents == 3 else 27
    if walk.previous[5] < 0:
        windows[COVER, :places] = 0.0
        windows[COVER, places // 2] = levels[0, CONTENT]
        walk.previous[5] = 0
    while walk.previous[5] < level:
        walk.previous[5] += 1
        below = int(walk.previous[5])
        begin = levels[below, BEGIN]
        for at in range(places):
            windows[REFINED + below, at] = windows[COVER + below - 1, at]
        _change_level(walk, REFINED + below, below, parents, True)
        for word in range(1 if parents == 2 else 4):
            real, below_kept = walk.real[below, word], walk.below_kept[below, word]
            nodes, cells, kept = walk.nodes[below, word], walk.cells[below, word], walk.kept[below, word]
            refined = ~real | below_kept & ~(nodes & ~kept)
            ones = (cells ^ nodes | kept) & ~below_kept
            bits = INSIDE[parents - 2, begin, word]
            while bits != 0:
                place = trailing_zeros(bits)
                bits &= bits - np.uint64(1)
                at = _place(parents, begin, 64 * word + place)
                weight = 1.0 if ones & _bit(place) != 0 else 0.0
                if refined & _bit(place) != 0:
                    weight = windows[REFINED + below, at]
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
