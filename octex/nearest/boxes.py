"""Boxes about boxes, eight to one, over things in Morton order: what lies near a point is found top down.

The tree is implicit: the children of node i of a level are nodes 8·i … 8·i + 7 of the level below, and those
of its lowest level are the things themselves. A node holds the boxes of its eight children side by side, so
that they are measured in vectors.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from octex.arrays import Array, Float32s, Float64s, Int64s
from octex.jit import inlined, kernel, part, squares_to_boxes, trailing_zeros
from octex.tree.morton import encode

WIDTH = 8
#: Nodes that can wait at once: seven of each level, and one.
_STACK = 256
#: Nodes that are kept for searches nearby; balls grow and shrink so that they hold about so many of them.
_MOST_KEPT, _INNER, _OUTER = 64, 12, 32
#: Boxes and points are rounded to single precision: by at most this part of the largest coordinate.
_ROUNDING = 4.0 * 2.0**-24
_FARTHEST = 3e38


class Boxes(NamedTuple):
    """A tree of boxes over things."""

    bounds: Float32s  # (nodes, 6, 8)   low x, y, z and high x, y, z of each child, relative to the origin
    firsts: Int64s  # (levels + 1,)   the first node of each level, from the lowest to the root's
    origin: Float64s  # (3,)
    extent: float  # the largest coordinate, relative to the origin
    things: int


class Search(NamedTuple):
    """Where a search works."""

    nodes: Int64s  # (256, 2)   level and number of nodes that wait
    squares: Float32s  # (256,)   how far they are, squared
    children: Float32s  # (8,)   how far the boxes in a node are, squared


class Kept(NamedTuple):
    """The nodes around a ball: searches in it need no other.

    Inside a larger ball those of the level above the lowest are kept, so that the smaller one moves cheaply.
    """

    nodes: Int64s  # (64,)   of the lowest level
    outer: Int64s  # (64,)   of the level above
    filled: Int64s  # (2,)   how many nodes, and how many outer ones
    ball: (
        Float64s  # (5,)   x, y, z relative to the origin, its radius, and how much wider than asked for it is
    )
    outer_ball: Float64s  # (5,)


@part
def new_search() -> Search:
    """Return room for a search."""
    return Search(np.empty((_STACK, 2), np.int64), np.empty(_STACK, np.float32), np.empty(8, np.float32))


@part
def new_kept(margin: float) -> Kept:
    """Return empty balls, to be made wider than asked for by about ``margin`` at first."""
    balls = np.zeros((2, 5), np.float64)
    balls[:, 3] = -1.0
    balls[0, 4], balls[1, 4] = margin, 4.0 * margin
    nodes = np.empty((2, _MOST_KEPT), np.int64)
    return Kept(nodes[0], nodes[1], np.zeros(2, np.int64), balls[0], balls[1])


def morton_order(positions: Float64s) -> Int64s:
    """Return the order (n,) of positions (n, 3) along a Morton curve; the same for the same positions."""
    if not len(positions):
        return np.empty(0, np.int64)
    bits = min((63 - _index_bits(len(positions))) // 3, 16)
    low = positions.min(axis=0)
    extent = float((positions.max(axis=0) - low).max())
    scale = (2**bits - 1) / extent if extent > 0.0 else 0.0
    return order_of(_keys(np.ascontiguousarray(positions), low, scale), 3 * bits)


def order_of(keys: Int64s, bits: int) -> Int64s:
    """Return the order (n,) that sorts keys (n,) of so many bits; what is equal stays in order."""
    index_bits = _index_bits(keys.size)
    if bits + index_bits > 63:
        return np.argsort(keys, kind="stable")
    packed = keys << index_bits | np.arange(keys.size)
    packed.sort()  # of key and index in one: six times as fast as an argsort
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


@kernel
def rows_in(order: Int64s, rows: Array) -> Array:
    """Return rows (n, components) in an order: in a third of the time of numpy, where they lie far apart."""
    found = np.empty_like(rows)
    for n in range(order.size):
        for k in range(rows.shape[1]):
            found[n, k] = rows[order[n], k]
    return found


def boxes_of(low: Float64s, high: Float64s) -> Boxes:
    """Build the tree over things in Morton order, with corners ``low`` and ``high`` (n, 3), n > 0."""
    first, last = low.min(axis=0), high.max(axis=0)
    origin = (first + last) / 2
    counts = [-(-len(low) // WIDTH)]
    while counts[-1] > 1:
        counts.append(-(-counts[-1] // WIDTH))
    firsts = np.cumsum([0, *counts])
    bounds = np.empty((int(firsts[-1]), 6, WIDTH), np.float32)
    bounds[:, :3], bounds[:, 3:] = np.inf, -np.inf
    _fill(low, high, origin, firsts, bounds)
    return Boxes(bounds, firsts, origin, float((last - first).max() / 2), len(low))


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


#: A point relative to the origin, and how much farther from it boxes may seem than they are.
Local: TypeAlias = tuple[float, float, float, float]


class Sought(NamedTuple):
    """A point that something is sought near to."""

    point: tuple[float, float, float]
    local: Local
    directions: Float64s  # (points, 3) or (0, 3)
    n: int  # its row of them
    least_cosine: float


@inlined
def local(boxes: Boxes, x: float, y: float, z: float) -> Local:
    """Place a point among boxes."""
    x, y, z = x - boxes.origin[0], y - boxes.origin[1], z - boxes.origin[2]
    return x, y, z, _ROUNDING * (boxes.extent + max(abs(x), max(abs(y), abs(z))))


@inlined
def reach(square: float, slack: float) -> np.float32:
    """Return how far, squared, boxes may seem to be that hold something nearer than a squared distance."""
    far = np.sqrt(square) * (1.0 + 1e-6) + slack
    return np.float32(min(far * far * (1.0 + 1e-6), _FARTHEST))  # of what is not there the box is at infinity


@inlined
def agrees(normals: Float32s, row: int, sought: Sought) -> bool:
    """Say whether a thing faces as is wanted (without directions, any way); one without a normal does."""
    directions, n = sought.directions, sought.n
    if directions.shape[0] == 0:
        return True
    x, y, z = normals[row, 0], normals[row, 1], normals[row, 2]
    cosine = directions[n, 0] * x + directions[n, 1] * y + directions[n, 2] * z
    return bool(cosine >= sought.least_cosine or x * x + y * y + z * z == 0.0)


@inlined
def begin(boxes: Boxes, search: Search) -> int:
    """Let the root wait; return how many nodes do."""
    search.nodes[0, 0], search.nodes[0, 1] = boxes.firsts.size - 2, 0
    search.squares[0] = np.float32(0.0)
    return 1


@inlined
def next_node(
    boxes: Boxes, search: Search, waiting: int, lowest: int, at: Local, bound: np.float32
) -> tuple[int, np.uint64, int]:
    """Go down to the next node of a level, the ``lowest`` or above, that may hold something near.

    Returns its number, −1 at the end, a bit for each of its children whose box is no farther than ``bound``,
    squared, and how many nodes wait; ``search.children`` holds how far these boxes are.
    """
    x, y, z = np.float32(at[0]), np.float32(at[1]), np.float32(at[2])
    while waiting > 0:
        waiting -= 1
        if search.squares[waiting] > bound:
            continue
        level, number = search.nodes[waiting, 0], search.nodes[waiting, 1]
        node = boxes.firsts[level] + number
        near = squares_to_boxes(boxes.bounds, node, x, y, z, bound, search.children)
        if level <= lowest:
            return int(number), near, waiting
        bottom = waiting
        while near != np.uint64(0) and waiting < search.squares.size:
            child = trailing_zeros(near)
            near &= near - np.uint64(1)
            square = search.children[child]
            to = waiting  # the nearest comes last, and is next
            while to > bottom and search.squares[to - 1] < square:
                search.squares[to] = search.squares[to - 1]
                search.nodes[to, 0], search.nodes[to, 1] = search.nodes[to - 1, 0], search.nodes[to - 1, 1]
                to -= 1
            search.squares[to] = square
            search.nodes[to, 0], search.nodes[to, 1] = level - 1, number * 8 + child
            waiting += 1
    return -1, np.uint64(0), 0


@inlined
def _holds(ball: Float64s, at: Local, radius: float) -> bool:
    dx, dy, dz = at[0] - ball[0], at[1] - ball[1], at[2] - ball[2]
    return bool(np.sqrt(dx * dx + dy * dy + dz * dz) + radius <= ball[3])


@inlined
def is_around(kept: Kept, at: Local, radius: float) -> bool:
    """Say whether a ball about a point lies in the one whose nodes are kept."""
    return _holds(kept.ball, at, radius)


@inlined
def _move(ball: Float64s, at: Local, radius: float) -> float:
    """Put a ball around a point, wider than asked for; return its radius."""
    ball[0], ball[1], ball[2], ball[3] = at[0], at[1], at[2], radius + ball[4]
    return float(ball[3])


@inlined
def _adapt(ball: Float64s, count: int, wanted: int) -> None:
    """Make a ball wider the next time if it holds few nodes, and narrower if many."""
    if 2 * count < wanted:
        ball[4] *= 1.5
    elif 2 * count > 3 * wanted:
        ball[4] *= 0.7


@inlined
def _give_up(ball: Float64s, kept: Kept) -> bool:
    ball[3], ball[4] = -1.0, 0.5 * ball[4]
    kept.ball[3] = -1.0
    kept.filled[0] = 0
    return False


@inlined
def keep_around(boxes: Boxes, search: Search, kept: Kept, at: Local, radius: float) -> bool:
    """Keep all nodes of the lowest level that reach into a ball about a point.

    It is wider than asked for, so that points that follow share it. Says no if there are too many nodes.
    """
    above = min(1, boxes.firsts.size - 2)
    wide = _move(kept.ball, at, radius)
    if not _holds(kept.outer_ball, at, wide):
        outer = _move(kept.outer_ball, at, wide)
        bound = reach(outer * outer, at[3])
        count = 0
        waiting = begin(boxes, search)
        while waiting > 0:
            node, near, waiting = next_node(boxes, search, waiting, above, at, bound)
            if near == np.uint64(0):
                continue
            if count == kept.outer.size:
                return _give_up(kept.outer_ball, kept)
            kept.outer[count] = node
            count += 1
        kept.filled[1] = count
        _adapt(kept.outer_ball, count, _OUTER)
    bound = reach(wide * wide, at[3])
    x, y, z = np.float32(at[0]), np.float32(at[1]), np.float32(at[2])
    count = 0
    for row in range(kept.filled[1]):
        node = kept.outer[row]
        if above == 0:
            kept.nodes[count] = node
            count += 1
            continue
        near = squares_to_boxes(boxes.bounds, boxes.firsts[1] + node, x, y, z, bound, search.children)
        while near != np.uint64(0):
            if count == kept.nodes.size:
                return _give_up(kept.ball, kept)
            kept.nodes[count] = node * 8 + trailing_zeros(near)
            near &= near - np.uint64(1)
            count += 1
    kept.filled[0] = count
    _adapt(kept.ball, count, _INNER)
    return True
