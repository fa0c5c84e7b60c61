"""The stored cell at a point, or nearest to it; and points in Morton order.

Points are cast once to fixed point, rounded to 30 bits an axis and cut to 21; the descent then reads an
octant a level. Every index is clamped and every descent bounded, so that damaged arrays cannot make a kernel
read outside them.

Many points that lie close together share most of what a lookup reads. They are sorted first by coarse cells,
so that blocks are compact; then by fine ones in each block.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Floats, Int32s, Int64s
from octex.jit import inlined, kernel, prefetch
from octex.tree.children import children, rank_in
from octex.tree.layout import GRID_BITS, MAX_DEPTH, TreeArrays
from octex.tree.morton import encode

#: Fixed-point units in the root's edge.
UNITS = 1 << MAX_DEPTH

Origin = tuple[float, float, float]

_NO_SINGLES, _NO_DOUBLES = np.empty((0, 3), np.float32), np.empty((0, 3))


class Positions(NamedTuple):
    """Rest positions of either precision, for kernels of one version: one of the arrays is empty."""

    singles: Floats  # (n, 3) or (0, 3)   float32
    doubles: Floats  # (n, 3) or (0, 3)   float64

    @classmethod
    def of(cls, rows: Floats) -> Positions:
        """Return rows (n, 3) of float32 or float64, as kernels take them."""
        return cls(rows, _NO_DOUBLES) if rows.itemsize == 4 else cls(_NO_SINGLES, rows)


@inlined
def count_of(points: Positions) -> int:
    """Return the number of points."""
    return len(points.singles) + len(points.doubles)


@inlined
def position(points: Positions, n: int | np.uint64) -> tuple[float, float, float]:
    """Return a point."""
    if len(points.singles) > 0:
        rows = points.singles
        return np.float64(rows[n, 0]), np.float64(rows[n, 1]), np.float64(rows[n, 2])
    return points.doubles[n, 0], points.doubles[n, 1], points.doubles[n, 2]


@inlined
def placed(x: float, y: float, z: float, origin: Origin, inverse: float) -> tuple[Any, Any, Any]:
    """Return a rest position in texture space; ``inverse`` is 1 / the root cell's edge.

    All code places points by this formula, `Placement.to_texture_space` too: a division by the edge would
    round some points between two fixed-point steps to the other one.
    """
    return (x - origin[0]) * inverse, (y - origin[1]) * inverse, (z - origin[2]) * inverse


@inlined
def finite_place(
    points: Positions, n: int, origin: Origin, inverse: float
) -> tuple[bool, float, float, float]:
    """Return whether a rest position is finite, and its place in texture space."""
    x, y, z = position(points, n)
    is_finite = abs(x) < np.inf and abs(y) < np.inf and abs(z) < np.inf
    x, y, z = placed(x, y, z, origin, inverse)
    return is_finite, x, y, z


@inlined
def fixed(coordinate: float) -> int:
    """Return the fixed-point position, 0 … 2²¹ − 1, of a coordinate 0 … 1 of texture space."""
    return min(int(coordinate * (1 << GRID_BITS) + 0.5) >> (GRID_BITS - MAX_DEPTH), UNITS - 1)


@inlined
def child(arrays: TreeArrays, node: int, octant: int) -> tuple[int, int]:
    """Return the cell and node number of a node's child: cell −1 for no child, node −1 for a leaf."""
    nodes, cells, first_node, first_cell = children(arrays.groups, node)
    bit = np.uint64(1) << np.uint64(octant)
    if cells & bit == 0:
        return -1, -1
    cell = min(first_cell + rank_in(cells, octant), arrays.flags.size - 1)
    if nodes & bit == 0:
        return cell, -1
    return cell, first_node + rank_in(nodes, octant)


class Descent(NamedTuple):
    """The memory of kernels from one point to the next."""

    path: Int64s  # (22,)   the node at each level above the previous point
    previous: Int64s  # (4,)   the previous position, and the last level of the path
    cells: Int64s  # (22, 8)   2×2×2 cells of each level around a position, x fastest; −1: none
    nodes: Int64s  # (22, 8)
    levels: Int64s  # (22, 8)   above the row's for a leaf that stands for its children


@kernel
def new_descent(arrays: TreeArrays) -> Descent:
    """Return the memory of a descent that is at the root."""
    path = np.full(MAX_DEPTH + 1, -1, np.int64)
    path[0] = 0 if arrays.groups.shape[0] > 0 else -1
    return Descent(
        path,
        np.zeros(4, np.int64),
        np.empty((MAX_DEPTH + 1, 8), np.int64),
        np.empty((MAX_DEPTH + 1, 8), np.int64),
        np.empty((MAX_DEPTH + 1, 8), np.int64),
    )


@inlined
def find_leaf(arrays: TreeArrays, i: int, j: int, k: int, descent: Descent) -> int:
    """Return the leaf that holds the fixed-point position (i, j, k), 0 … 2²¹ − 1, or −1.

    The descent starts at the deepest node shared with the previous position: neighbours in an image share
    most.
    """
    path, previous = descent.path, descent.previous
    difference = (i ^ previous[0]) | (j ^ previous[1]) | (k ^ previous[2])
    level = int(previous[3])
    while difference >> (MAX_DEPTH - level) != 0:
        level -= 1
    deepest = arrays.level_cells.size - 2
    cell = 0 if path[level] < 0 else -1
    while cell < 0 and level < deepest:
        bit = MAX_DEPTH - 1 - level
        cell, node = child(arrays, path[level], i >> bit & 1 | (j >> bit & 1) << 1 | (k >> bit & 1) << 2)
        if node < 0:
            break
        cell = -1
        level += 1
        path[level] = node
    previous[0], previous[1], previous[2], previous[3] = i, j, k, level
    return cell


@inlined
def nearest_cell(arrays: TreeArrays, x: float, y: float, z: float, descent: Descent) -> tuple[int, bool]:
    """Return the leaf that holds a point of texture space, else the nearest cell; and which of both it is.

    The point is first clamped into the root. Where no leaf holds it, the level is the deepest at which any of
    the 27 cells around it is stored, or lies in a leaf of a level above, whose box then counts. The nearest
    box wins; of equally near ones, the first in Morton order.
    """
    x, y, z = min(max(x, 0.0), 1.0), min(max(y, 0.0), 1.0), min(max(z, 0.0), 1.0)
    i, j, k = fixed(x), fixed(y), fixed(z)
    cell = find_leaf(arrays, i, j, k, descent)
    if cell >= 0:
        return cell, True
    return _nearest_neighbor(arrays, x * UNITS, y * UNITS, z * UNITS, i, j, k, descent), False


@inlined
def _nearest_neighbor(
    arrays: TreeArrays, x: float, y: float, z: float, i: int, j: int, k: int, descent: Descent
) -> int:
    """Return the nearest stored cell of the 27 around a position, at the deepest level that has one there.

    The parents of 27 cells are 2×2×2. Only these are followed down from the root, each level from the one
    above (paper 3.4, after Kobbelt et al. 1997).
    """
    cells, nodes, levels = descent.cells, descent.nodes, descent.levels
    cells[0] = nodes[0] = -1
    bit = MAX_DEPTH - 1
    root = 7 - (i >> bit | (j >> bit) << 1 | (k >> bit) << 2)
    cells[0, root] = levels[0, root] = 0
    nodes[0, root] = 0 if arrays.groups.shape[0] > 0 else -1
    deepest = arrays.level_cells.size - 2
    level = 0
    any_stored = True
    while any_stored and level < deepest - 1:
        any_stored = False
        shift = MAX_DEPTH - 1 - level
        u, v, w = _first(i >> shift - 1), _first(j >> shift - 1), _first(k >> shift - 1)
        u, v, w = u - 2 * _first(i >> shift), v - 2 * _first(j >> shift), w - 2 * _first(k >> shift)
        for n in range(8):
            cell, node, at = _grandchild(arrays, descent, level, u + (n & 1), v + (n >> 1 & 1), w + (n >> 2))
            cells[level + 1, n], nodes[level + 1, n], levels[level + 1, n] = cell, node, at
            any_stored |= cell >= 0
        level += 1
    for below in range(min(level + 1, deepest), 0, -1):
        cell = _nearest_of_27(arrays, x, y, z, i, j, k, descent, below)
        if cell >= 0:
            return cell
    return 0


@inlined
def _first(coordinate: int) -> int:
    """Return the lower of the two parents of the three cells around a cell."""
    return coordinate - 1 >> 1


@inlined
def _grandchild(
    arrays: TreeArrays, descent: Descent, level: int, u: int, v: int, w: int
) -> tuple[int, int, int]:
    """Return cell, node and level at (u, v, w), 0 … 3, among the children of the 2×2×2 cells of a level."""
    parent = u >> 1 | v >> 1 << 1 | w >> 1 << 2
    node = int(descent.nodes[level, parent])
    if node < 0:  # a leaf, which stands for its children too, or nothing
        return int(descent.cells[level, parent]), -1, int(descent.levels[level, parent])
    cell, node = child(arrays, node, u & 1 | (v & 1) << 1 | (w & 1) << 2)
    return cell, node, level + 1


@inlined
def _nearest_of_27(
    arrays: TreeArrays, x: float, y: float, z: float, i: int, j: int, k: int, descent: Descent, level: int
) -> int:
    shift = MAX_DEPTH - level
    a, b, c = (i >> shift) - 1, (j >> shift) - 1, (k >> shift) - 1
    u, v, w = a & 1, b & 1, c & 1
    nearest = -1
    nearest_distance = np.inf
    nearest_code = 0
    for n in range(27):
        dn, dm, dl = n % 3, n // 3 % 3, n // 9
        cell, _, at = _grandchild(arrays, descent, level - 1, u + dn, v + dm, w + dl)
        if cell < 0:
            continue
        size = 1 << (MAX_DEPTH - at)
        low = (a + dn << shift) & -size, (b + dm << shift) & -size, (c + dl << shift) & -size
        is_nearer, distance, code = nearer_box((x, y, z), low, size, nearest_distance, nearest_code)
        if is_nearer:
            nearest, nearest_distance, nearest_code = cell, distance, code
    return nearest


@inlined
def nearer_box(
    point: Origin, low: tuple[Any, Any, Any], size: int, least: float, least_code: Any
) -> tuple[bool, float, Any]:
    """Return whether a box is nearer to a point than ``least``, or as near and first in Morton order.

    All in fixed point; ``low`` is the box's lowest corner. Also returns its squared distance and Morton code.
    """
    dx = max(low[0] - point[0], point[0] - (low[0] + size), 0.0)
    dy = max(low[1] - point[1], point[1] - (low[1] + size), 0.0)
    dz = max(low[2] - point[2], point[2] - (low[2] + size), 0.0)
    distance, code = dx * dx + dy * dy + dz * dz, encode(low[0], low[1], low[2])
    return distance < least or (distance == least and code < least_code), distance, code


@kernel
def nearest_cells(
    arrays: TreeArrays, points: Positions, origin: Origin, size: float, cells: Int64s, held: Bools
) -> int:
    """Write the ``nearest_cell`` of each rest position to ``cells`` (n,), and whether it holds it.

    Returns the index of the first position that is not finite, where it stopped, or −1.
    """
    descent = new_descent(arrays)
    for n in range(count_of(points)):
        is_finite, x, y, z = finite_place(points, n, origin, 1.0 / size)
        if not is_finite:
            return n
        cells[n], held[n] = nearest_cell(arrays, x, y, z, descent)
    return -1


@kernel
def in_leaves(arrays: TreeArrays, points: Positions, origin: Origin, size: float, inside: Bools) -> int:
    """Write to ``inside`` (n,) whether a leaf holds each point; return as `nearest_cells` does."""
    descent = new_descent(arrays)
    for n in range(count_of(points)):
        is_finite, x, y, z = finite_place(points, n, origin, 1.0 / size)
        if not is_finite:
            return n
        inside[n] = False
        if 0.0 <= x < 1.0 and 0.0 <= y < 1.0 and 0.0 <= z < 1.0:
            inside[n] = find_leaf(arrays, fixed(x), fixed(y), fixed(z), descent) >= 0
    return -1


#: Distance of prefetching, in points.
AHEAD = 16
#: Level of the cells by which many points are sorted, unless their average run in one of these cells is
#: longer.
_COARSE = 4
_RUN = 8


@kernel
def keys_of(coords: Float64s, level: int, bits: int) -> Int64s:
    """Return the Morton codes of points' cells at a level << bits | their numbers, for points (n, 3).

    Sorting these takes a sixth of the time of numpy's argsort.
    """
    keys, cells = np.empty(coords.shape[0], np.int64), 1 << level
    for n in range(keys.size):
        x, y, z = coords[n, 0], coords[n, 1], coords[n, 2]
        keys[n] = encode(cell_of(x, cells), cell_of(y, cells), cell_of(z, cells)) << bits | n
    return keys


@kernel
def order_in_space(points: Positions, origin: Origin, size: float) -> Int32s:
    """Return the numbers of points by cells of the level _COARSE, in Morton order.

    Returns none for points in a similar order already, and for points that are not all finite.
    """
    n = count_of(points)
    cells, inverse = 1 << _COARSE, 1.0 / size
    digits, counts = np.empty(n, np.uint16), np.zeros((1 << 3 * _COARSE) + 1, np.int64)
    nothing = np.empty(0, np.int32)
    previous, changes = -1, 0
    for m in range(n):
        is_finite, x, y, z = finite_place(points, m, origin, inverse)
        if not is_finite:
            return nothing
        i = int(min(max(x * cells, 0.0), cells - 1.0))
        j = int(min(max(y * cells, 0.0), cells - 1.0))
        k = int(min(max(z * cells, 0.0), cells - 1.0))
        digit = int(encode(i, j, k))
        changes += digit != previous
        previous = digit
        digits[m] = digit
        counts[digit + 1] += 1
    if changes < n // _RUN:
        return nothing
    for digit in range(1, counts.size):
        counts[digit] += counts[digit - 1]
    numbers = np.empty(n, np.int32)
    for m in range(n):
        at = counts[digits[m]]
        counts[digits[m]] = at + 1
        numbers[at] = m
    return numbers


@kernel
def put_rows(rows: Float32s, numbers: Int32s | Int64s, target: Float32s) -> None:
    """Write rows (n, m) to their places among others, by number."""
    for n in range(numbers.size):
        prefetch(target, int(numbers[min(n + AHEAD, numbers.size - 1)]))
        at = np.uint64(numbers[n])
        for m in range(rows.shape[1]):
            target[at, m] = rows[n, m]


@inlined
def cell_of(x: float, cells: int) -> int:
    """Return the cell, of ``cells`` along an edge, that holds a coordinate 0 … 1."""
    return min(int(x * cells), cells - 1)


@inlined
def end_of_cell(keys: Int64s, begin: int, end: int, shift: int) -> int:
    """Return the end of the keys from ``begin`` on that differ in their last ``shift`` bits only."""
    key = keys[begin] >> shift
    low, step = begin, 8
    while low + step < end and keys[low + step] >> shift == key:
        low += step
        step *= 2
    high = min(low + step, end)  # there, or before, they end
    low += 1
    while low < high:
        middle = low + high >> 1
        if keys[middle] >> shift == key:
            low = middle + 1
        else:
            high = middle
    return low
