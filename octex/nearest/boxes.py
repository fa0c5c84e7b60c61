"""Boxes about boxes, eight to one, over things in Morton order: what lies near a point is found top down.

The tree is implicit: the children of node i of a level are nodes 8·i … 8·i + 7 of the level below, and those
of its lowest level are the things themselves. A node holds the boxes of its eight children side by side, so
that they are measured in vectors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.jit import inlined, kernel, squares_to_boxes, trailing_zeros
from octex.tree.morton import encode

Floats = npt.NDArray[np.float64]
Float32s = npt.NDArray[np.float32]
Int64s = npt.NDArray[np.int64]

WIDTH = 8
#: Nodes that can wait at once: seven of each level, and one.
_STACK = 256
#: Nodes that are kept for searches nearby, and how many of them are few and many: the ball grows and shrinks.
_MOST_KEPT, _FEW, _MANY = 64, 6, 16
#: Boxes and points are rounded to single precision: by at most this part of the largest coordinate.
_ROUNDING = 4.0 * 2.0**-24
_FARTHEST = 3e38


class Boxes(NamedTuple):
    """A tree of boxes over things."""

    bounds: Float32s  # (nodes, 6, 8)   low x, y, z and high x, y, z of each child, relative to the origin
    firsts: Int64s  # (levels + 1,)   the first node of each level, from the lowest to the root's
    origin: Floats  # (3,)
    extent: float  # the largest coordinate, relative to the origin
    things: int


class Search(NamedTuple):
    """Where a search works."""

    nodes: Int64s  # (256, 2)   level and number of nodes that wait
    squares: Float32s  # (256,)   how far they are, squared
    children: Float32s  # (8,)   how far the boxes in a node are, squared


class Kept(NamedTuple):
    """The nodes of the lowest level around a ball: searches in it need no other."""

    nodes: Int64s  # (64,)
    filled: Int64s  # (1,)   how many they are
    ball: Floats  # (5,)   x, y, z relative to the origin, its radius, and how much wider than asked for it is


@kernel
def new_search() -> Search:
    """Return room for a search."""
    return Search(np.empty((_STACK, 2), np.int64), np.empty(_STACK, np.float32), np.empty(8, np.float32))


@kernel
def new_kept(margin: float) -> Kept:
    """Return an empty ball, to be made wider than asked for by ``margin`` at first."""
    ball = np.zeros(5)
    ball[3], ball[4] = -1.0, margin
    return Kept(np.empty(_MOST_KEPT, np.int64), np.zeros(1, np.int64), ball)


def morton_order(positions: Floats) -> Int64s:
    """Return the order (n,) of positions (n, 3) along a Morton curve; the same for the same positions."""
    if not len(positions):
        return np.empty(0, np.int64)
    index_bits = max(int(len(positions) - 1).bit_length(), 1)
    axis_bits = min((63 - index_bits) // 3, 16)
    low = positions.min(axis=0)
    extent = float((positions.max(axis=0) - low).max())
    scale = (2**axis_bits - 1) / extent if extent > 0.0 else 0.0
    keys = _keys(np.ascontiguousarray(positions), low, scale, index_bits)
    keys.sort()  # of code and index in one: six times as fast as an argsort
    keys &= (1 << index_bits) - 1
    return keys


@kernel
def _keys(positions: Floats, low: Floats, scale: float, index_bits: int) -> Int64s:
    keys = np.empty(len(positions), np.int64)
    for n in range(keys.size):
        i = int((positions[n, 0] - low[0]) * scale)
        j = int((positions[n, 1] - low[1]) * scale)
        k = int((positions[n, 2] - low[2]) * scale)
        keys[n] = encode(i, j, k) << index_bits | n
    return keys


def boxes_of(low: Floats, high: Floats) -> Boxes:
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
def _fill(low: Floats, high: Floats, origin: Floats, firsts: Int64s, bounds: Float32s) -> None:
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


@inlined
def local(boxes: Boxes, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Return a point relative to the origin, and what boxes may seem farther from it than they are."""
    x, y, z = x - boxes.origin[0], y - boxes.origin[1], z - boxes.origin[2]
    return x, y, z, _ROUNDING * (boxes.extent + max(abs(x), max(abs(y), abs(z))))


@inlined
def reach(square: float, slack: float) -> np.float32:
    """Return how far, squared, boxes may seem to be that hold something nearer than a squared distance."""
    far = np.sqrt(square) * (1.0 + 1e-6) + slack
    return np.float32(min(far * far * (1.0 + 1e-6), _FARTHEST))  # of what is not there the box is at infinity


@inlined
def begin(boxes: Boxes, search: Search) -> int:
    """Let the root wait; return how many nodes do."""
    search.nodes[0, 0], search.nodes[0, 1] = boxes.firsts.size - 2, 0
    search.squares[0] = np.float32(0.0)
    return 1


@inlined
def next_node(
    boxes: Boxes,
    search: Search,
    waiting: int,
    x: np.float32,
    y: np.float32,
    z: np.float32,
    bound: np.float32,
) -> tuple[int, np.uint64, int]:
    """Go down to the next node of the lowest level that may hold something nearer than ``bound``.

    Returns its number, −1 at the end, a bit for each of its things whose box is that near, and how many nodes
    wait; ``search.children`` holds how far these boxes are, squared.
    """
    while waiting > 0:
        waiting -= 1
        if search.squares[waiting] > bound:
            continue
        level, number = search.nodes[waiting, 0], search.nodes[waiting, 1]
        node = boxes.firsts[level] + number
        near = squares_to_boxes(boxes.bounds, node, x, y, z, bound, search.children)
        if level == 0:
            return int(number), near, waiting
        bottom = waiting
        while near != np.uint64(0) and waiting < search.squares.size:
            child = trailing_zeros(near)
            near &= near - np.uint64(1)
            square = search.children[child]
            at = waiting  # the nearest comes last, and is next
            while at > bottom and search.squares[at - 1] < square:
                search.squares[at] = search.squares[at - 1]
                search.nodes[at, 0], search.nodes[at, 1] = search.nodes[at - 1, 0], search.nodes[at - 1, 1]
                at -= 1
            search.squares[at] = square
            search.nodes[at, 0], search.nodes[at, 1] = level - 1, number * 8 + child
            waiting += 1
    return -1, np.uint64(0), 0


@inlined
def is_around(kept: Kept, x: float, y: float, z: float, radius: float) -> bool:
    """Say whether a ball about a point relative to the origin lies in the one whose nodes are kept."""
    ball = kept.ball
    dx, dy, dz = x - ball[0], y - ball[1], z - ball[2]
    return bool(np.sqrt(dx * dx + dy * dy + dz * dz) + radius <= ball[3])


@inlined
def keep_around(
    boxes: Boxes, search: Search, kept: Kept, x: float, y: float, z: float, radius: float, slack: float
) -> bool:
    """Keep all nodes of the lowest level that reach into a ball about a point relative to the origin.

    It is wider than asked for, so that points that follow share it. Says no if there are too many nodes.
    """
    ball = kept.ball
    ball[0], ball[1], ball[2], ball[3] = x, y, z, radius + ball[4]
    bound = reach(ball[3] * ball[3], slack)
    i, j, k = np.float32(x), np.float32(y), np.float32(z)
    count = 0
    waiting = begin(boxes, search)
    while waiting > 0:
        node, near, waiting = next_node(boxes, search, waiting, i, j, k, bound)
        if near == np.uint64(0):
            continue
        if count == kept.nodes.size:
            kept.filled[0] = 0
            ball[3], ball[4] = -1.0, 0.5 * ball[4]
            return False
        kept.nodes[count] = node
        count += 1
    kept.filled[0] = count
    if count < _FEW:
        ball[4] *= 1.5
    elif count > _MANY:
        ball[4] *= 0.7
    return True
