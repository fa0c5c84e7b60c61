"""Points in Morton order.

Of many points in one call those that lie close together share most of what a lookup reads. They are sorted
first by coarse cells, all of the call, so that blocks of them are compact; then by fine ones in each block.
"""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Int64s
from octex.jit import inlined, kernel, prefetch
from octex.tree.morton import encode
from octex.tree.search import Origin, Positions, count_of, finite_place

#: How far ahead points are asked for.
AHEAD = 16
#: Level of the cells by which many points are sorted before any is looked up; and how many of them that come
#: one after the other lie in the same one, on average, if they need not be.
_COARSE = 4
_RUN = 8


@kernel
def keys_of(places: Float64s, level: int, bits: int) -> Int64s:
    """Return for points of texture space (n, 3) the Morton code of their cells of a level << bits | number.

    Sorting these takes a sixth of the time of numpy's argsort.
    """
    keys, cells = np.empty(places.shape[0], np.int64), 1 << level
    for n in range(keys.size):
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        keys[n] = encode(cell_of(x, cells), cell_of(y, cells), cell_of(z, cells)) << bits | n
    return keys


@kernel
def order_in_space(points: Positions, origin: Origin, size: float) -> Int32s:
    """Return the numbers of points by cells of the level _COARSE, in Morton order.

    Returns none if they come in a like order, or are not all finite.
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
    """Write rows (n, m) where they belong among as many others, by number."""
    for n in range(numbers.size):
        prefetch(target, int(numbers[min(n + AHEAD, numbers.size - 1)]))
        at = np.uint64(numbers[n])
        for m in range(rows.shape[1]):
            target[at, m] = rows[n, m]


@inlined
def cell_of(x: float, cells: int) -> int:
    """Find the cell, of so many along an edge, that holds a coordinate 0 … 1."""
    return min(int(x * cells), cells - 1)


@inlined
def end_of_cell(keys: Int64s, begin: int, end: int, shift: int) -> int:
    """Return the end of the keys from ``begin`` on that are alike but for so many bits."""
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
