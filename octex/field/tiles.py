"""Tiles: cells found by a bit test and a count instead of a descent.

A *tile* is the 8×8×8 cells three levels below a node, which are consecutive in the numbering. Each of its
eight octants is a word, 4×4×4 cells in Morton order with a bit for each stored one, and a number:

    cell = first of the octant + popcount(mask of the octant & below)        where its bit is set

Tiles of the deepest level lead to cells. Those three, six … levels above lead likewise to the rows of the
tiles below them. Every search begins in a dense grid of the rows of one level. Tiles hold the cells of a
tree's deepest level and take 1.5 bytes each. A tree of less than three levels is one tile, filled in part.
Where a part of a tree of one depth was painted more finely, both levels have tiles; cells near the other
level are marked.

A group of points is placed in vectors before any tile is read, and all tiles are found before any value:
with random points most time is spent waiting for memory, so the group waits together. The latest tile is
cached.
"""

from __future__ import annotations

from itertools import islice
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Int32s, Int64s, Uint8s, Uint32s, Uint64s, zeros
from octex.errors import OutputError
from octex.field.taps import Batch, prefetch_cell
from octex.jit import by_constants, fused_part, inlined, kernel, part, popcount, prefetch, trailing_zeros
from octex.tree.children import children, rank_in
from octex.tree.layout import GRID_BITS
from octex.tree.morton import decode, decode_cells
from octex.tree.neighbours import with_boundary
from octex.tree.octree import Octree, distinct

#: Deepest level of the dense grid, which then takes 128 kB.
MOST_TOP_LEVEL = 5

#: Least part of the surface for which a second level gets tiles.
_LEAST_PART = 1 / 16

#: Bytes of a cache line.
CACHE_LINE = 64

#: Most bytes of rows in memory, enough for 64 M cells; more go to a file.
_IN_MEMORY = 1 << 26

Integer: TypeAlias = int | np.integer[Any]

_NO_MARKS = np.empty(0, np.uint64)


class Tiles(NamedTuple):
    """The tiles of one tree. Row r has octants 8·r … 8·r + 7; the last row is empty, for no node."""

    depth: int  # the level of the cells
    top_level: int
    top: Int32s  # (8 ** top_level,)   the row of the tile below each place, x fastest
    masks: Uint64s  # (8 · rows,)
    firsts: Uint32s  # (8 · rows,)
    #: (words,) or (0,)   a bit for each cell: whether cells of other levels count near it
    marks: Uint64s


def can_be_tiled(tree: Octree) -> bool:
    """Return whether a tree has leaves, all at the deepest level, and no kept nodes."""
    counts = tree.cells_by_depth()
    return tree.n_leaves > 0 and not any(leaves for leaves, _ in counts[:-1]) and not tree.kept.cells.size


def build_tiles(tree: Octree) -> Tiles:
    """Build the tiles of a tree's deepest level."""
    depth, groups, level_nodes = tree.max_depth, tree.arrays.groups, tree.arrays.level_nodes.tolist()
    if depth < 3:  # one tile, whose cells lie in its first octant
        masks, firsts = _new_rows(1, np.uint64), _new_rows(1, np.uint32)
        masks[0] = np.bitwise_or.reduce(np.uint64(1) << tree.level_codes(depth).astype(np.uint64))
        firsts[0] = tree.arrays.level_cells[depth]
        return Tiles(depth, 0, np.zeros(1, np.int32), masks, firsts, _NO_MARKS)
    top_level = depth - 3 * max(-(-(depth - MOST_TOP_LEVEL) // 3), 1)
    nodes = {level: level_nodes[level : level + 2] for level in range(top_level, depth - 2, 3)}
    rows = sum(end - first for first, end in nodes.values())
    masks, firsts = _new_rows(rows, np.uint64), _new_rows(rows, np.uint32)
    row = 0
    for level, (first, end) in nodes.items():
        octants, row = slice(8 * row, 8 * (row + end - first)), row + end - first
        of_cells = level == depth - 3
        offset = 0 if of_cells else row - level_nodes[level + 3]
        _fill_tiles(groups, first, of_cells, offset, masks[octants], firsts[octants])
    top = np.full((1 << top_level,) * 3, rows, np.int32)
    codes, is_node = tree.walked_to(top_level)
    cells = decode_cells(codes[is_node])
    top[tuple(cells.T[::-1])] = np.arange(len(cells))
    return Tiles(depth, top_level, top.reshape(-1), masks, firsts, _NO_MARKS)


def painted_levels(tree: Octree) -> list[int]:
    """Return the one or two levels with most leaves of a tree of one depth with finer paint.

    The first of them is the first with leaves, and no node above is kept; else none is returned.
    """
    leaves = np.array([leaves for leaves, _ in tree.cells_by_depth()])
    parts = leaves * 0.25 ** np.arange(leaves.size)
    levels: list[int] = np.flatnonzero(parts >= _LEAST_PART * parts.sum()).tolist()
    first, kept = int(np.argmax(leaves > 0)), tree.kept.cells
    is_bare = not kept.size or kept[0] >= tree.arrays.level_cells[first]
    return levels if first >= 3 and levels[:1] == [first] and len(levels) <= 2 and is_bare else []


def marked(tiles: Tiles, tree: Octree) -> Tiles:
    """Mark the cells of tiles whose fields read others: nodes, coarser leaves, kept nodes.

    Those count within one of their cells. Marks reach two cells farther, as any of its cells identifies a
    window, and cover whole octants, 4³ cells.
    """
    depth, firsts = tiles.depth, tree.arrays.level_cells
    marks = np.zeros(int(firsts[depth + 1]) + 63 >> 6, np.uint64)
    codes, is_node = tree.walked_to(depth)
    _mark(tiles, distinct(codes[is_node] >> 6), 0, 1, marks)
    octants = distinct(codes >> 6)
    for level, (codes, is_node) in enumerate(islice(tree.walk(), depth)):
        counts, kept = ~is_node, tree.kept.cells.astype(np.int64) - int(firsts[level])
        counts[kept[(kept >= 0) & (kept < counts.size)]] = True
        if not counts.any():
            continue
        up = max(depth - 2 - level, 0)
        reach = (1 << up) + (level <= depth - 2)
        blocks = distinct(codes[counts] >> 3 * max(level - depth + 2, 0))
        around = distinct(octants >> 3 * up)
        for _ in range(2):
            around = with_boundary(around, depth - 2 - up)
        _mark(tiles, np.intersect1d(blocks, around, assume_unique=True), up, reach, marks)
    return tiles._replace(marks=marks)


@kernel
def _mark(tiles: Tiles, codes: Int64s, up: int, reach: int, marks: Uint64s) -> None:
    """Mark the cells of octants in blocks of 2ᵘᵖ octants an edge, and ``reach`` octants around them."""
    side = (1 << up) + 2 * reach
    for n in range(codes.size):
        i, j, k = decode(codes[n])
        for around in range(side * side * side):
            a = (i << up) - reach + around % side
            b = (j << up) - reach + around // side % side
            c = (k << up) - reach + around // (side * side)
            row = tile_row(tiles, a >> 1, b >> 1, c >> 1)
            octant = 8 * row + (a & 1 | (b & 1) << 1 | (c & 1) << 2)
            first = int(np.int64(tiles.firsts[octant]))
            for cell in range(first, min(first + popcount(tiles.masks[octant]), 64 * marks.size)):
                marks[cell >> 6] |= np.uint64(1) << np.uint64(cell & 63)


def _new_rows(rows: int, dtype: npt.DTypeLike) -> Array:
    """Return zeros for the octants of rows and of the empty one; no row straddles two cache lines."""
    size = 8 * (rows + 1) * np.dtype(dtype).itemsize
    try:
        memory = zeros(size + CACHE_LINE, _IN_MEMORY)
    except OutputError:  # no room for a file
        memory = np.zeros(size + CACHE_LINE, np.uint8)
    start = -memory.ctypes.data % CACHE_LINE
    return memory[start : start + size].view(dtype)


@kernel
def _fill_tiles(
    groups: Uint64s, first_node: int, of_cells: bool, offset: int, masks: Uint64s, firsts: Uint32s
) -> None:
    """Fill in the tiles below consecutive nodes: of cells, or of nodes, whose rows are ``offset`` higher."""
    for row in range(masks.size >> 3):
        octants, _, child, _ = children(groups, first_node + row)
        for octant in range(8):
            if (octants >> np.uint64(octant)) & np.uint64(1) == np.uint64(0):
                continue
            nodes, _, grandchild, _ = children(groups, child)
            child += 1
            mask = np.uint64(0)
            first = 0
            for n in range(8):
                if (nodes >> np.uint64(n)) & np.uint64(1) == np.uint64(0):
                    continue
                stored, cells, number, first_cell = children(groups, grandchild)
                if of_cells:
                    stored, number = cells, first_cell
                grandchild += 1
                if mask == np.uint64(0):
                    first = number
                mask |= stored << np.uint64(8 * n)
            masks[8 * row + octant] = mask
            firsts[8 * row + octant] = max(first + offset, 0)


@inlined
def _spread_bits(i: Integer) -> Any:
    """Move the four low bits of an integer, of 32 or 64 bits, to bits 0, 3, 8 and 11."""
    one, two, four, eight, six = np.int32(1), np.int32(2), np.int32(4), np.int32(8), np.int32(6)
    return (i & one) | (i & two) << two | (i & four) << six | (i & eight) << eight


@inlined
def code_in_tile(i: Integer, j: Integer, k: Integer) -> Any:
    """Return a cell's bit in its octant, plus 256 · octant; coordinates 8 … 15 lie in the next tiles."""
    return _spread_bits(i) | _spread_bits(j) << np.int32(1) | _spread_bits(k) << np.int32(2)


@inlined
def is_marked(tiles: Tiles, cell: int) -> bool:
    """Return whether cells of other levels count near a cell."""
    word = cell >> 6
    if word >= tiles.marks.size:
        return False
    return bool((tiles.marks[np.uint64(word)] >> np.uint64(cell & 63)) & np.uint64(1) != np.uint64(0))


@inlined
def look_in(tiles: Tiles, octant: int, code: int) -> tuple[int, bool]:
    """Return the number of an octant's cell, and whether the cell is stored."""
    bit = np.uint64(code & 63)
    mask = tiles.masks[np.uint64(octant)]
    number = np.int64(tiles.firsts[np.uint64(octant)]) + rank_in(mask, bit)
    return int(number), (mask >> bit) & np.uint64(1) != np.uint64(0)


@inlined
def tile_row(tiles: Tiles, i: int, j: int, k: int) -> int:
    """Return the row of the tile at a place of the grid of tiles; outside, the empty row."""
    none = (tiles.masks.size >> 3) - 1
    level = max(tiles.depth - 3, 0)
    if (i | j | k) >> level != 0:
        return none
    top, shift = tiles.top_level, level - tiles.top_level
    row = int(np.int64(tiles.top[(i >> shift) | (j >> shift) << top | (k >> shift) << 2 * top]))
    while shift > 0:
        shift -= 3
        a, b, c = i >> shift, j >> shift, k >> shift
        code = code_in_tile(a & 7, b & 7, c & 7)
        row, is_stored = look_in(tiles, 8 * row + (code >> 8), code)
        if not is_stored:
            return none
        row = min(row, none)
    return row


#: Points placed at once: all wait for memory together, and fit the first cache.
GROUP = 64


_AXIS_BITS = 20  # of a tile's coordinate plus one, in a key


class TilesAround(NamedTuple):
    """The tiles around each point of a group. Octants are counted over all tiles."""

    keys: Int64s  # (GROUP,)   the tile of the lowest cell read, see `tile_key`
    reached: Uint8s  # (GROUP,)   whether the next tile is read too: a bit for each axis
    slots: Int64s  # (GROUP,)   the start of the point's `octants`
    octants: Int64s  # (8 · (GROUP + 1),)   the first of each of 2×2×2 tiles, as far as reached
    latest: Int64s  # (3,)   the latest key, its slot, and its known tiles


@part
def new_tiles_around() -> TilesAround:
    """Return an empty group for one tree."""
    latest = np.zeros(3, np.int64)
    latest[0] = -1
    return TilesAround(
        np.zeros(GROUP, np.int64),
        np.zeros(GROUP, np.uint8),
        np.zeros(GROUP, np.int64),
        np.zeros(8 * (GROUP + 1), np.int64),
        latest,
    )


@inlined
def tile_key(i: Integer, j: Integer, k: Integer) -> Any:
    """Pack a tile's coordinates, each from −1 on."""
    one = np.int64(1)
    return i + one | (j + one) << np.int64(_AXIS_BITS) | (k + one) << np.int64(2 * _AXIS_BITS)


@by_constants
@inlined
def _find_octant(tiles: Tiles, key: int, neighbour: int) -> int:
    """Find and prefetch the first octant of one of the 2×2×2 tiles from that of a key on."""
    low = (1 << _AXIS_BITS) - 1
    i = (key & low) - 1 + (neighbour & 1)
    j = (key >> _AXIS_BITS & low) - 1 + (neighbour >> 1 & 1)
    k = (key >> 2 * _AXIS_BITS) - 1 + (neighbour >> 2)
    octant = 8 * tile_row(tiles, i, j, k)
    prefetch(tiles.masks, octant)
    prefetch(tiles.firsts, octant)
    return octant


@inlined
def find_tiles(tiles: Tiles, around: TilesAround, count: int) -> None:
    """Find and prefetch the tiles of a group of points with known keys and reach."""
    octants = around.octants
    key, slot, known = around.latest[0], around.latest[1], around.latest[2]
    for neighbour in range(8):
        octants[neighbour] = octants[slot + neighbour]
    slot = 0
    for n in range(count):
        at = np.uint64(n)
        if around.keys[at] != key:
            key = around.keys[at]
            slot += 8
            octants[np.uint64(slot)] = _find_octant(tiles, key, 0)
            known = np.int64(1)
        around.slots[at] = slot
        reached = np.int64(around.reached[at])
        if reached != 0:
            needed = 1 | (reached & 1) << 1
            needed |= needed << 2 & -(reached >> 1 & 1)
            needed |= needed << 4 & -(reached >> 2)
            missing = needed & ~known
            known |= missing
            while missing != 0:
                neighbour = trailing_zeros(np.uint64(missing))
                missing &= missing - 1
                octants[np.uint64(slot + neighbour)] = _find_octant(tiles, key, neighbour)
    around.latest[0], around.latest[1], around.latest[2] = key, slot, known


@inlined
def rounded_cell(x: float, depth: int) -> np.int32:
    """Return the cell that holds a coordinate 0 … 1, rounded as the vertices of surfaces are."""
    cell = np.int32(x * (1 << GRID_BITS) + 0.5) >> np.int32(GRID_BITS - depth)
    return min(cell, np.int32((1 << depth) - 1))


@fused_part
def nearest_rows(tiles: Tiles, batch: Batch, rows: Uint32s) -> int:
    """Write the cells that hold points to ``rows`` (n,); list the points without, return their number."""
    coords, last, empty, ahead = batch.coords, batch.last, batch.empty, batch.ahead
    around, codes = new_tiles_around(), np.zeros(GROUP, np.int32)
    flat = coords.reshape(-1)
    three, seven, n_empty = np.int32(3), np.int32(7), 0
    for begin in range(0, coords.shape[0], GROUP):
        count = min(GROUP, coords.shape[0] - begin)
        for n in range(count):
            at = np.uint64(3 * (begin + n))
            i = rounded_cell(flat[at], tiles.depth)
            j = rounded_cell(flat[at + np.uint64(1)], tiles.depth)
            k = rounded_cell(flat[at + np.uint64(2)], tiles.depth)
            key = tile_key(np.int64(i >> three), np.int64(j >> three), np.int64(k >> three))
            around.keys[np.uint64(n)] = key
            codes[np.uint64(n)] = code_in_tile(i & seven, j & seven, k & seven)
        find_tiles(tiles, around, count)
        for n in range(count):
            code = np.int64(codes[np.uint64(n)])
            octant = around.octants[np.uint64(around.slots[np.uint64(n)])] + (code >> 8)
            cell, is_stored = look_in(tiles, int(octant), int(code))
            prefetch_cell(ahead, int(cell))
            rows[np.uint64(begin + n)] = min(cell, last)
            empty[np.uint64(n_empty)] = begin + n
            n_empty += not is_stored
    return n_empty
