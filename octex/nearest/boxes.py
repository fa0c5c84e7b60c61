"""A bounding box hierarchy with eight children a node, over items in Morton order.

The tree is implicit: the children of node i of a level are nodes 8·i … 8·i + 7 of the level below. Children
of the lowest level are the items. A node holds the boxes of its eight children side by side, to measure them
in vectors.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from octex.arrays import Float32s, Float64s, Int64s
from octex.jit import inlined, kernel, part, squares_to_boxes, trailing_zeros
from octex.tree.morton import encode

WIDTH = 8
#: Largest number of waiting nodes: seven of each level, and one.
_STACK = 256
#: Boxes and points are rounded to single precision: by at most this part of the largest coordinate.
_ROUNDING = 4.0 * 2.0**-24
_FARTHEST = 3e38


class Boxes(NamedTuple):
    """A box hierarchy over items."""

    bounds: Float32s  # (nodes, 6, 8)   low x, y, z and high x, y, z of each child, relative to the origin
    firsts: Int64s  # (levels + 1,)   the first node of each level, from the lowest to the root
    origin: Float64s  # (3,)
    extent: float  # the largest coordinate, relative to the origin


class Search(NamedTuple):
    """Scratch of a search."""

    nodes: Int64s  # (256, 2)   level and number of waiting nodes
    squares: Float32s  # (256,)   their squared distances
    children: Float32s  # (8,)   squared distances of a node's child boxes


@part
def new_search() -> Search:
    """Return scratch for a search."""
    return Search(np.empty((_STACK, 2), np.int64), np.empty(_STACK, np.float32), np.empty(8, np.float32))


def morton_order(positions: Float64s) -> Int64s:
    """Return the order (n,) of positions (n, 3) along a Morton curve; equal input gives equal order."""
    if not len(positions):
        return np.empty(0, np.int64)
    bits = min((63 - _index_bits(len(positions))) // 3, 16)
    low = positions.min(axis=0)
    extent = float((positions.max(axis=0) - low).max())
    scale = (2**bits - 1) / extent if extent > 0.0 else 0.0
    return order_of(_keys(np.ascontiguousarray(positions), low, scale), 3 * bits)


def order_of(keys: Int64s, bits: int) -> Int64s:
    """Return the stable order (n,) that sorts keys (n,) of at most ``bits`` bits."""
    index_bits = _index_bits(keys.size)
    if bits + index_bits > 63:
        return np.argsort(keys, kind="stable")
    packed = keys << index_bits | np.arange(keys.size)
    packed.sort()  # key and index in one integer: six times as fast as argsort
    packed &= (1 << index_bits) - 1
    return packed


def _index_bits(count: int) -> int:
    return max(int(count - 1).bit_length(), 1)


@kernel
def _keys(positions: Float64s, low: Float64s, scale: float) -> Int64s:
    keys = np.empty(len(positions), np.int64)
    for n in range(keys.size):
        i = int((positions[n, 0] - low[0]) * scale)
        j = int((positions[n, 1] - low[1]) * scale)
        k = int((positions[n, 2] - low[2]) * scale)
        keys[n] = encode(i, j, k)
    return keys


def boxes_of(low: Float64s, high: Float64s) -> Boxes:
    """Build the hierarchy over items in Morton order, with corners ``low`` and ``high`` (n, 3), n > 0."""
    first, last = low.min(axis=0), high.max(axis=0)
    origin = (first + last) / 2
    counts = [-(-len(low) // WIDTH)]
    while counts[-1] > 1:
        counts.append(-(-counts[-1] // WIDTH))
    firsts = np.cumsum([0, *counts])
    bounds = np.empty((int(firsts[-1]), 6, WIDTH), np.float32)
    bounds[:, :3], bounds[:, 3:] = np.inf, -np.inf
    _fill(low, high, origin, firsts, bounds)
    return Boxes(bounds, firsts, origin, float((last - first).max() / 2))


@kernel
def _fill(low: Float64s, high: Float64s, origin: Float64s, firsts: Int64s, bounds: Float32s) -> None:
    for n in range(len(low)):
        for axis in range(3):
            bounds[n // 8, axis, n % 8] = low[n, axis] - origin[axis]
            bounds[n // 8, axis + 3, n % 8] = high[n, axis] - origin[axis]
    for level in range(1, firsts.size - 1):
        for n in range(firsts[level] - firsts[level - 1]):
            node, child = firsts[level] + n // 8, firsts[level - 1] + n
            for axis in range(3):
                bounds[node, axis, n % 8] = bounds[child, axis].min()
                bounds[node, axis + 3, n % 8] = bounds[child, axis + 3].max()


#: A point relative to the origin, and a bound of the rounding error of its distances to boxes.
Local: TypeAlias = tuple[float, float, float, float]


class Sought(NamedTuple):
    """A query: a point, and the direction that results must face."""

    point: tuple[float, float, float]
    local: Local
    directions: Float64s  # (points, 3) or (0, 3)
    n: int  # its row in them
    least_cosine: float


@inlined
def local(boxes: Boxes, x: float, y: float, z: float) -> Local:
    """Return a point relative to the hierarchy's origin."""
    x, y, z = x - boxes.origin[0], y - boxes.origin[1], z - boxes.origin[2]
    return x, y, z, _ROUNDING * (boxes.extent + max(abs(x), max(abs(y), abs(z))))


@inlined
def reach(square: float, slack: float) -> np.float32:
    """Return the largest squared distance to a box that can hold a nearer item, rounding included."""
    radius = np.sqrt(square) * (1.0 + 1e-6) + slack
    return np.float32(min(radius * radius * (1.0 + 1e-6), _FARTHEST))  # empty children have boxes at infinity


@inlined
def agrees(normals: Float32s, row: int, sought: Sought) -> bool:
    """Return whether an item faces the query's direction; always without directions or a normal."""
    directions, n = sought.directions, sought.n
    if directions.shape[0] == 0:
        return True
    x, y, z = normals[row, 0], normals[row, 1], normals[row, 2]
    cosine = directions[n, 0] * x + directions[n, 1] * y + directions[n, 2] * z
    return bool(cosine >= sought.least_cosine or x * x + y * y + z * z == 0.0)


@inlined
def begin(boxes: Boxes, search: Search) -> int:
    """Push the root; return the number of waiting nodes."""
    search.nodes[0, 0], search.nodes[0, 1] = boxes.firsts.size - 2, 0
    search.squares[0] = np.float32(0.0)
    return 1


@inlined
def next_node(
    boxes: Boxes, search: Search, waiting: int, at: Local, bound: np.float32
) -> tuple[int, np.uint64, int]:
    """Descend to the next node of the lowest level that may hold an item within the bound.

    Returns its number, or −1 at the end; a bit for each child whose box lies within ``bound``, squared; and
    the number of waiting nodes. ``search.children`` holds the squared distances of these boxes.
    """
    x, y, z = np.float32(at[0]), np.float32(at[1]), np.float32(at[2])
    while waiting > 0:
        waiting -= 1
        if search.squares[waiting] > bound:
            continue
        level, number = search.nodes[waiting, 0], search.nodes[waiting, 1]
        node = boxes.firsts[level] + number
        children = squares_to_boxes(boxes.bounds, node, x, y, z, bound, search.children)
        if level == 0:
            return int(number), children, waiting
        bottom = waiting
        while children != np.uint64(0) and waiting < search.squares.size:
            child = trailing_zeros(children)
            children &= children - np.uint64(1)
            square = search.children[child]
            to = waiting  # the nearest comes last, and is popped first
            while to > bottom and search.squares[to - 1] < square:
                search.squares[to] = search.squares[to - 1]
                search.nodes[to, 0], search.nodes[to, 1] = search.nodes[to - 1, 0], search.nodes[to - 1, 1]
                to -= 1
            search.squares[to] = square
            search.nodes[to, 0], search.nodes[to, 1] = level - 1, number * 8 + child
            waiting += 1
    return -1, np.uint64(0), 0
