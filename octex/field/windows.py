"""The cells around a point, level by level: nodes, leaves, and their numbers.

The *window* of a level is the 3×3×3 cells of that level around the cell that holds the point, 5×5×5 for
quartic. They are children of a *block* of 2×2×2 (3×3×3) parents, which lie in the window of the level above:

    window      + + +        the block's children are one more along each axis than the window, which begins
                + c +        at the first or the second of them
                + + +

A window depends only on the cell that holds the point, so windows shared with the previous point are cached.
Each block is a few words of bits, and a group is read for each parent that is a node. Every index is clamped
and every descent bounded, so that damaged arrays cannot make a kernel read outside them. Coefficients pass
from a window down to finer cells, and shares up to coarser ones (paper 3.4, after Kobbelt et al. 1997).
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from octex.arrays import Float64s, Int64s, Uint8s, Uint32s, Uint64s
from octex.field.splines import LINEAR, refine, send_up
from octex.jit import inlined, kernel, trailing_zeros
from octex.tree.children import children, rank_in
from octex.tree.layout import KEPT, MAX_DEPTH, TreeArrays

BYTE = np.uint64(0xFF)

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
COLOR = 44  # the part of a refined cell's colour that comes from coloured cells
SHARES = 45  # 4 rows: weights and slopes that fall on a window's cells


class Walk(NamedTuple):
    """The memory of walks through one tree.

    Slots number the parents of a block, and places the cells of a window, x fastest. Child 8·slot + octant of
    a block has bit (child & 63) of the words [level, child >> 6].
    """

    previous: Int64s  # (6,)   the previous position; its last level; filter; last level of COVER
    levels: Int64s  # (22, 6)   see the columns above
    real: Uint64s  # (22, 4)   which children have a parent that is a node; the others are refined
    nodes: Uint64s  # (22, 4)   which of them are nodes
    cells: Uint64s  # (22, 4)   which are stored
    kept: Uint64s  # (22, 4)   which are nodes with kept coefficients
    below_kept: Uint64s  # (22, 4)   which have such a parent
    below_leaves: Uint64s  # (22, 4)   which are below a leaf; for LINEAR
    first_nodes: Int64s  # (22, 27)   by slot: node number of the parent's first child node
    first_cells: Int64s  # (22, 27)   by slot: cell number of its first child
    windows: Float64s  # (49, 125)   values of a window's cells, by place
    taps: Float64s  # (4, MOST_TAPS)   weights and slopes before they are normalized


class Way(NamedTuple):
    """What all steps of a walk share: the tree, the filter, and the memory."""

    arrays: TreeArrays
    kept_cells: Uint32s  # (kept nodes,)   ascending, the nodes flagged KEPT
    walk: Walk
    filter_code: int  # LINEAR, QUADRATIC or QUARTIC
    parents: int  # along an edge of a block: 3 for QUARTIC, else 2
    columns: int  # 4 with slopes, else 1
    is_truncated: bool  # nodes of the last level count as leaves


def _tabulate_blocks() -> tuple[Uint8s, Uint64s, Uint8s, Uint64s]:
    """Tabulate blocks of 2³ and of 3³ parents: see below."""
    slot_at, parents_of = np.zeros((2, 27, 216), np.uint8), np.zeros((2, 27, 4), np.uint64)
    places, inside = np.zeros((2, 8, 216), np.uint8), np.zeros((2, 8, 4), np.uint64)
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
            slot_at[which, above, child] = slot
            parents_of[which, above, child >> 6] |= np.uint64(1 << (child & 63))
    return slot_at, parents_of, places, inside


# All [parents − 2, …]:
# SLOT_AT [ABOVE, child]     the slot of a child of the block above
# PARENTS [ABOVE, word]      which children of the block above are parents
# PLACES [BEGIN, child]      a child's place in the window
# INSIDE [BEGIN, word]       which children are in the window
SLOT_AT, PARENTS, PLACES, INSIDE = _tabulate_blocks()


@kernel
def new_walk() -> Walk:
    """Return an empty walk for one tree and all filters."""
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
def words_of(way: Way) -> int:
    """Return the number of words for the children of a block."""
    return 1 if way.parents == 2 else 4


@inlined
def follow(way: Way, i: int, j: int, k: int) -> int:
    """Go down to the first level without nodes in its window, and return it."""
    walk = way.walk
    previous = walk.previous
    difference = (i ^ previous[0]) | (j ^ previous[1]) | (k ^ previous[2])
    level = int(previous[3])
    if level < 0 or previous[4] != way.filter_code:
        _write_root(way)
        previous[4], previous[5] = way.filter_code, -1
        level = 0
    while level > 0 and difference >> (MAX_DEPTH - level) != 0:
        level -= 1
    previous[5] = min(previous[5], level)
    deepest = min(way.arrays.level_cells.size - 2, MAX_DEPTH)
    while walk.levels[level, NODES] and level < deepest:
        level += 1
        _go_down(way, i, j, k, level)
        if way.filter_code == LINEAR:
            _find_below_leaves(walk, level)
        if way.kept_cells.size > 0:
            _find_kept(way, level)
    previous[0], previous[1], previous[2], previous[3] = i, j, k, level
    return level


@inlined
def _write_root(way: Way) -> None:
    """Write the root's window: the root is the first child of the middle slot; others are empty."""
    walk, parents = way.walk, way.parents
    is_node = way.arrays.groups.shape[0] > 0
    keeps = is_node and way.kept_cells.size > 0 and way.arrays.flags[0] & KEPT != 0
    middle = 1 + parents + parents * parents
    for word in range(4):
        root = flag_at(8 * (middle & 7)) if word == middle >> 3 else np.uint64(0)
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
def _go_down(way: Way, i: int, j: int, k: int, level: int) -> None:
    """Find the window of a level from that of the level above."""
    walk, parents = way.walk, way.parents
    levels, real, nodes, cells = walk.levels, walk.real, walk.nodes, walk.cells
    # the first cells of this window and of that above
    shift = MAX_DEPTH - level
    reach = parents - 1
    a, b, c = (i >> shift) - reach, (j >> shift) - reach, (k >> shift) - reach
    u, v, w = (i >> shift + 1) - reach, (j >> shift + 1) - reach, (k >> shift + 1) - reach
    above = (a >> 1) - (u & ~1) + 3 * ((b >> 1) - (v & ~1)) + 9 * ((c >> 1) - (w & ~1))
    begin = a & 1 | (b & 1) << 1 | (c & 1) << 2
    for word in range(words_of(way)):
        real[level, word] = nodes[level, word] = cells[level, word] = 0
    for word in range(words_of(way)):
        above_nodes = nodes[level - 1, word]
        bits = above_nodes & PARENTS[parents - 2, above, word]
        while bits != 0:
            bit = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            slot = _slot(parents, above, 64 * word + bit)
            node = walk.first_nodes[level - 1, 8 * word + (bit >> 3)] + _rank(above_nodes, bit)
            child_nodes, child_cells, first_node, first_cell = children(way.arrays.groups, int(node))
            walk.first_nodes[level, slot], walk.first_cells[level, slot] = first_node, first_cell
            target_word, offset = slot >> 3, np.uint64(8 * (slot & 7))
            real[level, target_word] |= BYTE << offset
            nodes[level, target_word] |= child_nodes << offset
            cells[level, target_word] |= child_cells << offset
    has_nodes = has_leaves = np.uint64(0)
    for word in range(words_of(way)):
        has_nodes |= nodes[level, word] & INSIDE[parents - 2, begin, word]
        has_leaves |= (nodes[level, word] ^ cells[level, word]) & INSIDE[parents - 2, begin, word]
    levels[level, NODES] = has_nodes != 0
    levels[level, CONTENT] = has_leaves != 0 or levels[level - 1, CONTENT]
    levels[level, KEEPING] = 0
    levels[level, ABOVE] = above
    levels[level, BEGIN] = begin
    levels[level, UPPER] = i >> shift & 1 | (j >> shift & 1) << 1 | (k >> shift & 1) << 2


@inlined
def _find_below_leaves(walk: Walk, level: int) -> None:
    """Find the children of a block that lie below a leaf."""
    walk.below_leaves[level, 0] = 0
    above = walk.levels[level, ABOVE]
    leaves = walk.cells[level - 1, 0] ^ walk.nodes[level - 1, 0] | walk.below_leaves[level - 1, 0]
    bits = leaves & PARENTS[0, above, 0]
    while bits != 0:
        slot = _slot(2, above, trailing_zeros(bits))
        bits &= bits - np.uint64(1)
        walk.below_leaves[level, 0] |= BYTE << np.uint64(8 * slot)


@inlined
def _find_kept(way: Way, level: int) -> None:
    """Find the kept nodes of a window, and the kept parents of its block."""
    arrays, kept_cells, walk, parents = way.arrays, way.kept_cells, way.walk, way.parents
    levels, below_kept = walk.levels, walk.below_kept
    above, begin = levels[level, ABOVE], levels[level, BEGIN]
    for word in range(words_of(way)):
        below_kept[level, word] = 0
    for word in range(words_of(way)):
        bits = walk.kept[level - 1, word] & PARENTS[parents - 2, above, word]
        while bits != 0:
            slot = _slot(parents, above, 64 * word + trailing_zeros(bits))
            bits &= bits - np.uint64(1)
            below_kept[level, slot >> 3] |= BYTE << np.uint64(8 * (slot & 7))
            levels[level, KEEPING] = 1
        kept = np.uint64(0)
        if kept_cells[kept_cells.size - 1] >= arrays.level_cells[level] and (
            kept_cells[0] < arrays.level_cells[level + 1]
        ):
            bits = walk.nodes[level, word] & INSIDE[parents - 2, begin, word]
        while bits != 0:
            bit = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            if arrays.flags[cell_at(arrays, walk, level, word, bit)] & KEPT:
                kept |= flag_at(bit)
        walk.kept[level, word] = kept
        if kept != 0:
            levels[level, CONTENT] = 1


@inlined
def kept_row(way: Way, cell: int) -> int:
    """Return the row of a kept node, counted after all cells; −1 for other nodes."""
    low, high = 0, way.kept_cells.size
    while low < high:
        middle = low + high >> 1
        if np.int64(way.kept_cells[middle]) < cell:
            low = middle + 1
        else:
            high = middle
    is_listed = low < way.kept_cells.size and np.int64(way.kept_cells[low]) == cell
    return way.arrays.flags.size + low if is_listed else -1


@inlined
def cell_at(arrays: TreeArrays, walk: Walk, level: int, word: int, bit: int) -> int:
    """Return the cell number of a block's child."""
    cell = walk.first_cells[level, 8 * word + (bit >> 3)] + _rank(walk.cells[level, word], bit)
    return min(int(cell), arrays.flags.size - 1)


@inlined
def _rank(word: np.uint64, bit: int) -> int:
    """Count the bits of a word below a bit, in its byte."""
    return rank_in(word >> np.uint64(bit & 56), bit & 7)


@inlined
def place_of(parents: int, begin: int, child: int) -> int:
    """Return a child's place in a window."""
    return int(np.int64(PLACES[parents - 2, begin, child]))


@inlined
def _slot(parents: int, above: int, child: int) -> int:
    """Return the slot in which a child of the block above is a parent."""
    return int(np.int64(SLOT_AT[parents - 2, above, child]))


@inlined
def flag_at(bit: int) -> np.uint64:
    """Return a word with one bit."""
    return np.uint64(1) << np.uint64(bit)


@inlined
def retain_refined(way: Way, level: int) -> bool:
    """Keep only the shares of refined cells in a window; return whether there are any."""
    walk, is_linear = way.walk, way.filter_code == LINEAR
    windows, levels = walk.windows, walk.levels
    begin = levels[level, BEGIN]
    if is_linear:
        _find_colors(walk, level)
    any_refined = False
    for word in range(words_of(way)):
        refined = ~walk.real[level, word]
        if is_linear:
            refined = walk.below_leaves[level, word]
        elif levels[level, KEEPING]:
            refined |= walk.below_kept[level, word] & ~walk.cells[level, word]
        inside = INSIDE[way.parents - 2, begin, word]
        bits = inside & ~refined
        while bits != 0:
            at = place_of(way.parents, begin, 64 * word + trailing_zeros(bits))
            bits &= bits - np.uint64(1)
            for column in range(way.columns):
                windows[SHARES + column, at] = 0.0
        bits = inside & refined
        while bits != 0:
            at = place_of(way.parents, begin, 64 * word + trailing_zeros(bits))
            bits &= bits - np.uint64(1)
            for column in range(way.columns):
                any_refined |= windows[SHARES + column, at] != 0.0
                if is_linear:
                    windows[SHARES + column, at] /= windows[COLOR, at]
    return any_refined


@inlined
def change_level(walk: Walk, row: int, level: int, parents: int, down: bool) -> None:
    """Refine a row from the window above a level to that of the level, or send it up to the one above."""
    windows = walk.windows
    side = 2 * parents - 1
    is_quartic = parents == 3
    step = 1
    for axis in range(3):
        upper = walk.levels[level, UPPER] >> axis & 1 != 0
        for block in range(0, side * side * side, side * step):
            for at in range(block, block + step):
                a, b, c = windows[row, at], windows[row, at + step], windows[row, at + 2 * step]
                d = e = 0.0
                if is_quartic:
                    d, e = windows[row, at + 3 * step], windows[row, at + 4 * step]
                if upper:
                    a, b, c, d, e = (e, d, c, b, a) if is_quartic else (c, b, a, d, e)
                a, b, c, d, e = (
                    refine(is_quartic, a, b, c, d, e) if down else send_up(is_quartic, a, b, c, d, e)
                )
                if upper:
                    a, b, c, d, e = (e, d, c, b, a) if is_quartic else (c, b, a, d, e)
                windows[row, at], windows[row, at + step], windows[row, at + 2 * step] = a, b, c
                if is_quartic:
                    windows[row, at + 3 * step], windows[row, at + 4 * step] = d, e
        step *= side


@inlined
def _find_colors(walk: Walk, level: int) -> None:
    """Find the part of a window's refined cells that comes from cells with a colour, for ``linear``."""
    windows = walk.windows
    begin = walk.levels[level - 1, BEGIN]
    windows[COLOR, :27] = 0.0
    nodes, cells, kept = walk.nodes[level - 1, 0], walk.cells[level - 1, 0], walk.kept[level - 1, 0]
    bits = (cells ^ nodes | kept | walk.below_leaves[level - 1, 0]) & INSIDE[0, begin, 0]
    while bits != 0:
        windows[COLOR, place_of(2, begin, trailing_zeros(bits))] = 1.0
        bits &= bits - np.uint64(1)
    change_level(walk, COLOR, level, 2, True)


@inlined
def weigh_windows(way: Way, level: int) -> None:
    """Find the weights of the coefficients in the windows down to a level."""
    walk, parents = way.walk, way.parents
    windows, levels = walk.windows, walk.levels
    places = 125 if parents == 3 else 27
    if walk.previous[5] < 0 or levels[walk.previous[5], CONTENT] == 0:
        above = 0
        while levels[above + 1, CONTENT] == 0:
            above += 1
        windows[COVER + above, :places] = 0.0
        windows[COVER + above, places // 2] = levels[above, CONTENT]  # the root's, or nothing
        walk.previous[5] = above
    while walk.previous[5] < level:
        walk.previous[5] += 1
        below = int(walk.previous[5])
        begin = levels[below, BEGIN]
        for at in range(places):
            windows[REFINED + below, at] = windows[COVER + below - 1, at]
        change_level(walk, REFINED + below, below, parents, True)
        for word in range(words_of(way)):
            real, below_kept = walk.real[below, word], walk.below_kept[below, word]
            nodes, cells, kept = walk.nodes[below, word], walk.cells[below, word], walk.kept[below, word]
            refined = ~real | below_kept & ~(nodes & ~kept)
            ones = (cells ^ nodes | kept) & ~below_kept
            bits = INSIDE[parents - 2, begin, word]
            while bits != 0:
                bit = trailing_zeros(bits)
                bits &= bits - np.uint64(1)
                at = place_of(parents, begin, 64 * word + bit)
                weight = 1.0 if ones & flag_at(bit) != 0 else 0.0
                if refined & flag_at(bit) != 0:
                    weight = windows[REFINED + below, at]
                windows[COVER + below, at] = weight
