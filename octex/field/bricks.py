"""Bricks: the quadratic field of many points in any tree, decoded where they lie close together.

A *brick* is the coefficients of the cells below one cell, one to three levels down, and of those around them:

    level          L    L + 1    L + 2    L + 3
    cells in it    1      2³       4³       8³
    decoded       3³      4³       6³      10³

Each block of coefficients is refined from the one above (`splines`); children of nodes overwrite it. At the
first level where no decoded cell is a node, the field of all points in the brick is their weighted sum.
Refinement does not move the field, so coarser leaves among them change nothing. If a node lies three levels
down, the cell is split in eight.

A cell with few points is walked to, point by point. Walk and bricks differ by rounding only, about 10⁻⁷.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, ChannelValues, Float32s, Float64s, Int32s, Int64s, Uint32s
from octex.field.splines import QUADRATIC
from octex.field.taps import LEAST, Codes, Flat, Taps, flat_of, new_taps, put_value, value_of
from octex.field.tiles import Integer
from octex.field.walk_taps import taps_around
from octex.field.windows import MOST_TAPS, Way, kept_row, new_walk
from octex.jit import fused_kernel, inlined, prefetch, refine_rows, spline_box, trailing_zeros
from octex.tree.children import children, rank_in
from octex.tree.layout import KEPT, MAX_DEPTH, TreeArrays
from octex.tree.search import AHEAD, end_of_cell

# Where blocks lie in `Bricks.rows`, in cells: first a 4³ for each level, then those of the brick.
_AT_SIX = 64 * (MAX_DEPTH + 2)
_AT_TEN = _AT_SIX + 216
_AT_WIDE = _AT_TEN + 1000  # refined along x
_AT_FLAT = _AT_WIDE + 360  # refined along x and y
_CELLS = _AT_FLAT + 600
#: Cells along an edge of the block that each step decodes from.
_SIDES = 0, 3, 4, 6


class BrickValues(NamedTuple):
    """A channel to decode, and the alpha that weights it, empty for none."""

    codes: Flat
    alpha: Flat
    components: int


class Bricks(NamedTuple):
    """Memory for bricks: 170 kB for one thread. Blocks count their cells x fastest.

    A coefficient is two fours: four components, and the weight and another.
    """

    rows: Float32s  # (2 · _CELLS · 4,)
    nodes: Int64s  # ((MAX_DEPTH + 2) · 64,)   of the 4³ of each level, node numbers, or −1
    keeps: Bools  # (same,)   whether such a node has a kept coefficient
    filled: Bools  # (MAX_DEPTH + 5,)   whether the block of a level has any coefficients
    #: (4 · 1000,)   of each block, the values below nodes: whether the node keeps one itself | place << 1 |
    #: row + 1 << 16; row −1 is zero
    values_below: Int64s
    #: (4 · 216,)   of each block, its nodes: whether they keep one | x << 1 | y << 5 | z << 9 | number << 16
    nodes_below: Int64s
    n_values: Int64s  # (4,)
    n_nodes: Int64s  # (4,)
    ends: Int64s  # (MAX_DEPTH + 2,)   where the points of the cell of each level end
    split: Bools  # (MAX_DEPTH + 2,)   whether that cell is split


def new_bricks() -> Bricks:
    """Return memory for bricks."""
    levels = MAX_DEPTH + 2
    return Bricks(
        np.zeros(2 * _CELLS * 4, np.float32),
        np.full(levels * 64, -1, np.int64),
        np.zeros(levels * 64, np.bool_),
        np.zeros(levels + 3, np.bool_),
        np.zeros(4 * 1000, np.int64),
        np.zeros(4 * 216, np.int64),
        np.zeros(4, np.int64),
        np.zeros(4, np.int64),
        np.zeros(levels, np.int64),
        np.zeros(levels, np.bool_),
    )


@inlined
def _covered_value(
    values: BrickValues, row: int
) -> tuple[np.float32, np.float32, np.float32, np.float32, np.float32]:
    """Return the components of a row times its alpha, and its alpha."""
    a, b, c, d = value_of(values.codes, row, values.components)
    covered = np.float32(1.0)
    if values.alpha.values.size > 0:
        covered = np.float32(value_of(values.alpha, row, 1)[0])
    return (
        covered * np.float32(a),
        covered * np.float32(b),
        covered * np.float32(c),
        covered * np.float32(d),
        covered,
    )


@inlined
def _write_value(
    values: BrickValues, bricks: Bricks, at: int, row: int, planes: int, weight: np.float32
) -> None:
    """Write the coefficient of a row times a weight, or zeros for row −1."""
    rows, one = bricks.rows, np.uint64(1)
    a = b = c = d = covered = np.float32(0.0)
    if row >= 0:
        a, b, c, d, covered = _covered_value(values, row)
    else:
        weight = covered
    first = np.uint64(4 * at)
    if planes == 1:
        d = covered
    else:
        second = first + np.uint64(4 * _CELLS)
        rows[second], rows[second + one] = weight * covered, weight
    rows[first], rows[first + one] = weight * a, weight * b
    rows[first + np.uint64(2)], rows[first + np.uint64(3)] = weight * c, weight * d


@inlined
def _inside(x: int, y: int, z: int, last: int) -> np.uint64:
    """Return the children of a cell that lie in the block below; ``last`` is the last cell's coordinate."""
    inside = np.uint64(0xFF)
    inside &= np.uint64(0b10101010 if x == 0 else 0b01010101 if x == last else 0xFF)
    inside &= np.uint64(0b11001100 if y == 0 else 0b00110011 if y == last else 0xFF)
    return inside & np.uint64(0b11110000 if z == 0 else 0b00001111 if z == last else 0xFF)


@inlined
def _child_place(x: int, y: int, z: int, octant: int, side: int) -> int:
    """Return where a child lies in the block below, of ``side`` cells along an edge."""
    x, y, z = 2 * x - 1 + (octant & 1), 2 * y - 1 + (octant >> 1 & 1), 2 * z - 1 + (octant >> 2)
    return x + side * (y + side * z)


@inlined
def _list_children(way: Way, values: ChannelValues, bricks: Bricks, step: int) -> bool:
    """List a block's coefficients below nodes, and child nodes; False for nodes after the last step."""
    arrays, side = way.arrays, _SIDES[step]
    values_below, nodes_below = bricks.values_below, bricks.nodes_below
    n_nodes, above = bricks.n_nodes[step - 1], np.uint64(216 * (step - 1))
    to_value, to_node = np.uint64(1000 * step), np.uint64(216 * step)
    below, n_cells = 2 * side - 2, arrays.flags.size
    one = np.uint64(1)
    for _ in range(n_nodes):
        listed = nodes_below[above]
        above += one
        keeps, node = listed & 1, listed >> 16
        x, y, z = listed >> 1 & 15, listed >> 5 & 15, listed >> 9 & 15
        inside = _inside(x, y, z, side - 1)
        nodes, stored, first_node, first_cell = children(arrays.groups, node)
        nodes_inside = nodes & inside
        if step == 3 and nodes_inside != 0:
            return False
        prefetch(values, first_cell)
        leaves = stored & ~nodes & inside
        while leaves != 0:
            octant = trailing_zeros(leaves)
            leaves &= leaves - one
            row = min(first_cell + rank_in(stored, octant), n_cells - 1)
            place = _child_place(x, y, z, octant, below)
            values_below[to_value] = keeps | place << 1 | row + 1 << 16
            to_value += one
        while nodes_inside != 0:
            octant = trailing_zeros(nodes_inside)
            nodes_inside &= nodes_inside - one
            number, is_kept = first_node + rank_in(nodes, octant), 0
            a, b, c = 2 * x - 1 + (octant & 1), 2 * y - 1 + (octant >> 1 & 1), 2 * z - 1 + (octant >> 2)
            if way.kept_cells.size > 0:
                row = min(first_cell + rank_in(stored, octant), n_cells - 1)
                place = a + below * (b + below * c)
                if arrays.flags[np.uint64(row)] & np.uint8(KEPT) != 0:
                    is_kept = 1
                    values_below[to_value] = keeps | place << 1 | kept_row(way, row) + 1 << 16
                    to_value += one
                elif keeps:  # else zeros are there
                    values_below[to_value] = place << 1
                    to_value += one
            nodes_below[to_node] = is_kept | a << 1 | b << 5 | c << 9 | number << 16
            to_node += one
    bricks.n_values[step] = np.int64(to_value) - 1000 * step
    bricks.n_nodes[step] = np.int64(to_node) - 216 * step
    return True


@inlined
def _list_blocks(way: Way, values: ChannelValues, bricks: Bricks, corner: int) -> int:
    """List the blocks of the brick around the 3³ cells from ``corner`` of a 4³.

    Returns the first block without nodes, or −1 if there is none.
    """
    count = 0
    for place in range(27):
        x, y, z = place % 3, place // 3 % 3, place // 9
        at = np.uint64(corner + x + 4 * (y + 4 * z))
        node = bricks.nodes[at]
        if node >= 0:
            bricks.nodes_below[count] = bricks.keeps[at] | x << 1 | y << 5 | z << 9 | node << 16
            count += 1
    bricks.n_nodes[0] = count
    for step in range(1, 4):
        if bricks.n_nodes[step - 1] == 0:
            return step - 1
        if not _list_children(way, values, bricks, step):
            return -1
    return 3


@inlined
def _note_nodes(bricks: Bricks, level: int) -> None:
    """Note the nodes of the 4³ of a level, which are listed."""
    nodes, first = bricks.nodes, 64 * level
    nodes[first : first + 64] = -1
    for n in range(bricks.n_nodes[1]):
        listed = bricks.nodes_below[216 + n]
        x, y, z = listed >> 1 & 15, listed >> 5 & 15, listed >> 9 & 15
        at = first + x + 4 * (y + 4 * z)
        nodes[at], bricks.keeps[at] = listed >> 16, listed & 1 != 0


@inlined
def _refine_block(rows: Float32s, source: int, stride: int, side: int, target: int) -> None:
    """Refine a block of ``side``³ cells to the (2 · side − 2)³ below. Places are in cells."""
    below = 2 * side - 2
    for line in range(side * side):
        at = source + stride * (line % side + stride * (line // side))
        refine_rows(rows, 4 * at, 4, 4 * (_AT_WIDE + below * line), 4, 8, side - 1)
    width = 4 * below
    for z in range(side):
        for y in range(side - 1):
            at, to = 4 * _AT_WIDE + width * (y + side * z), 4 * _AT_FLAT + width * (2 * y + below * z)
            refine_rows(rows, at, width, to, width, 4, below)
    width *= below
    for z in range(side - 1):
        at, to = 4 * _AT_FLAT + width * z, 4 * target + 2 * width * z
        refine_rows(rows, at, width, to, width, 4, below * below)


@inlined
def _clear(bricks: Bricks, planes: int, step: int, side: int, target: int) -> None:
    """Write zeros to the children of nodes without kept coefficients."""
    rows, nodes_below = bricks.rows, bricks.nodes_below
    zero, one = np.float32(0.0), np.uint64(1)
    for n in range(bricks.n_nodes[step - 1]):
        listed = nodes_below[np.uint64(216 * (step - 1) + n)]
        if listed & 1 != 0:
            continue
        x, y, z = listed >> 1 & 15, listed >> 5 & 15, listed >> 9 & 15
        octants = _inside(x, y, z, side - 1)
        while octants != 0:
            place = target + _child_place(x, y, z, trailing_zeros(octants), 2 * side - 2)
            octants &= octants - one
            for plane in range(planes):
                first = np.uint64(4 * (place + plane * _CELLS))
                rows[first] = rows[first + one] = zero
                rows[first + np.uint64(2)] = rows[first + np.uint64(3)] = zero


@inlined
def _decode(
    values: BrickValues,
    bricks: Bricks,
    planes: int,
    step: int,
    source: int,
    stride: int,
    side: int,
    target: int,
    filled: bool,
) -> bool:
    """Write the coefficients of the block below another.

    ``filled`` is whether the other block has any coefficients; returns whether this one has.
    """
    rows, values_below = bricks.rows, bricks.values_below
    below = 2 * side - 2
    for plane in range(planes):
        shift = plane * _CELLS
        if filled:
            _refine_block(rows, source + shift, stride, side, target + shift)
        else:
            rows[4 * (target + shift) : 4 * (target + shift + below * below * below)] = np.float32(0.0)
    if filled:
        _clear(bricks, planes, step, side, target)
    one = np.float32(1.0)
    weight_at = 4 * _CELLS + 1 if planes > 1 else 3
    for n in range(bricks.n_values[step]):
        listed = values_below[np.uint64(1000 * step + n)]
        place = target + (listed >> 1 & 1023)
        weight = one if listed & 1 == 0 else rows[np.uint64(4 * place + weight_at)]
        _write_value(values, bricks, place, (listed >> 16) - 1, planes, weight)
    return filled or bricks.n_values[step] > 0


@inlined
def _enter(way: Way, values: BrickValues, bricks: Bricks, planes: int) -> None:
    """Write the root's block: the root is the second cell along each axis; the others are empty."""
    middle, row = 1 + 4 * (1 + 4), 0
    if way.arrays.groups.shape[0] > 0:
        bricks.nodes[middle] = 0
        bricks.keeps[middle] = way.kept_cells.size > 0 and way.arrays.flags[0] & KEPT != 0
        row = kept_row(way, 0) if bricks.keeps[middle] else -1
    bricks.filled[0] = row >= 0
    if row >= 0:
        _write_value(values, bricks, middle, row, planes, np.float32(1.0))


#: Cells of this level are not split: their points are walked to. Bits of a point's number.
SORTED, NUMBER_BITS = 15, 18
_NUMBER = (1 << NUMBER_BITS) - 1
#: Cells with fewer points are walked to; a walk takes longer in trees with kept nodes.
_FEW, _FEW_KEPT = 8, 2


class Targets(NamedTuple):
    """The points to look up, and their results."""

    coords: Float64s  # (n, 3)   in texture space
    keys: Int64s  # (n,)   ascending: of each the Morton code of level SORTED << NUMBER_BITS | its number
    results: Float32s  # (n · components,)   the mean of the channel
    components: int
    missed: Int32s  # (n,)   output: points without a result


@inlined
def _write_mean(
    targets: Targets, n: Integer, n_missed: int, a: float, b: float, c: float, d: float, total: float
) -> int:
    """Write the mean of a point, or list it as missed if it is not finite; return the number missed."""
    inverse = 1.0 / total
    a, b, c, d = a * inverse, b * inverse, c * inverse, d * inverse
    if not (total >= LEAST and abs(a) + abs(b) + abs(c) + abs(d) < np.inf):
        targets.missed[n_missed] = n
        return n_missed + 1
    put_value(targets.results, int(n) * targets.components, targets.components, a, b, c, d)
    return n_missed


@inlined
def _look_up_by_walk(
    values: BrickValues, way: Way, taps: Taps, targets: Targets, n: int, n_missed: int
) -> int:
    """Look a point up by the walk (`walk_taps`); return the number missed."""
    x, y, z = targets.coords[n, 0], targets.coords[n, 1], targets.coords[n, 2]
    end, _ = taps_around(way, x, y, z, True, taps, 0)
    sum_a = sum_b = sum_c = sum_d = total = 0.0
    for tap in range(end):
        share = np.float64(taps.weights[np.uint64(tap)])
        a, b, c, d, covered = _covered_value(values, int(taps.rows[np.uint64(tap)]))
        sum_a, sum_b, sum_c = sum_a + share * a, sum_b + share * b, sum_c + share * c
        sum_d, total = sum_d + share * d, total + share * covered
    return _write_mean(targets, n, n_missed, sum_a, sum_b, sum_c, sum_d, total)


@inlined
def _brick_weights(t: float) -> tuple[np.float32, np.float32, np.float32]:
    """Return the weights of the quadratic B-spline; small ones keep their digits."""
    half = np.float32(0.5)
    s, r = np.float32(1.0 - t), np.float32(t)
    low, high = half * s * s, half * r * r
    return low, np.float32(1.0) - low - high, high


@inlined
def _blend_brick(
    bricks: Bricks,
    planes: int,
    first: int,
    side: int,
    level: int,
    low: tuple[int, int, int],
    targets: Targets,
    begin: int,
    end: int,
    n_missed: int,
) -> int:
    """Look points up in a block of a level whose first cell is ``low``; return the number missed."""
    rows, coords, keys = bricks.rows, targets.coords, targets.keys
    cells, steps = np.float64(np.int64(1) << level), (1, side, side * side)
    for m in range(begin, end):
        ahead = int(keys[min(m + AHEAD, keys.size - 1)] & _NUMBER)
        prefetch(coords, ahead)
        prefetch(targets.results, ahead * targets.components)
        n = np.uint64(keys[m] & _NUMBER)
        x = (coords[n, 0] + 1.0 - 1.0) * cells
        y = (coords[n, 1] + 1.0 - 1.0) * cells
        z = (coords[n, 2] + 1.0 - 1.0) * cells
        most = cells - 1.0
        i, j, k = min(np.floor(x), most), min(np.floor(y), most), min(np.floor(z), most)
        of_x, of_y, of_z = _brick_weights(x - i), _brick_weights(y - j), _brick_weights(z - k)
        at = (int(i) - low[0] - 1) + side * ((int(j) - low[1] - 1) + side * (int(k) - low[2] - 1))
        at += first
        a, b, c, d = spline_box(rows, at, steps, of_x, of_y, of_z)
        total = d
        if planes > 1:
            total, _, _, _ = spline_box(rows, at + _CELLS, steps, of_x, of_y, of_z)
        n_missed = _write_mean(targets, n, n_missed, a, b, c, d, total)
    return n_missed


@fused_kernel
def look_up_crowded(
    arrays: TreeArrays, kept_cells: Uint32s, codes: Codes, alpha: Codes, targets: Targets, bricks: Bricks
) -> int:
    """Look up a channel, weighted by alpha if that has rows; return how many points are missed.

    Missed points lie off the surface, or nearly, or where alpha is zero. ``bricks`` are new.
    """
    ends, split, keys = bricks.ends, bricks.split, targets.keys
    values = BrickValues(flat_of(codes), flat_of(alpha), codes.values.shape[1])
    planes, few = 1, _FEW_KEPT if kept_cells.size > 0 else _FEW
    if values.components > 3 or (values.alpha.values.size > 0 and kept_cells.size > 0):
        planes = 2
    way, taps = Way(arrays, kept_cells, new_walk(), QUADRATIC, 2, 1, False), new_taps(1, MOST_TAPS, False)
    _enter(way, values, bricks, planes)
    level, begin, n_missed = 0, 0, 0
    ends[0], split[0] = keys.size, False
    path = np.zeros((MAX_DEPTH + 2, 4), np.int64)  # the cell of each level, and its octant
    while begin < keys.size:
        while begin >= ends[level]:
            level -= 1
        end = ends[level]
        i, j, k, octant = path[level, 0], path[level, 1], path[level, 2], path[level, 3]
        if not split[level]:
            is_done = end - begin <= few
            if not is_done:
                corner = 64 * level + (octant & 1) + 4 * (octant >> 1 & 1) + 16 * (octant >> 2)
                last = _list_blocks(way, codes.values, bricks, corner)
                filled, source, stride = bricks.filled[level], corner, 4
                first = 64 * (level + 1)
                for step in range(1, (last if last >= 0 else 1) + 1):
                    target = _AT_TEN if step == 3 else _AT_SIX if step == 2 else first
                    side = _SIDES[step]
                    filled = _decode(values, bricks, planes, step, source, stride, side, target, filled)
                    if step == 1:
                        bricks.filled[level + 1] = filled
                    source, stride = target, 2 * side - 2
                if last >= 0:
                    low = (i << last) - 1, (j << last) - 1, (k << last) - 1
                    task = planes, source, stride, level + last, low
                    n_missed = _blend_brick(bricks, *task, targets, begin, end, n_missed)
                    begin = end
                    continue
                is_done = level >= SORTED
            if is_done:
                for m in range(begin, end):
                    n_missed = _look_up_by_walk(values, way, taps, targets, int(keys[m] & _NUMBER), n_missed)
                begin = end
                continue
            _note_nodes(bricks, level + 1)
            split[level] = True
        level += 1
        shift = NUMBER_BITS + 3 * (SORTED - level)
        ends[level], split[level] = end_of_cell(keys, begin, end, shift), False
        octant = keys[begin] >> shift & 7
        path[level, 0], path[level, 1] = 2 * i + (octant & 1), 2 * j + (octant >> 1 & 1)
        path[level, 2], path[level, 3] = 2 * k + (octant >> 2), octant
    return n_missed
