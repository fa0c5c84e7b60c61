"""Points in Morton order.

Of many points in one call those that lie close together share most of what a lookup reads. They are sorted
first by coarse cells, all of the call, so that blocks of them are compact; then, in each block, by three
levels at a time where a cell is split.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Int64s
from octex.jit import inlined, kernel, prefetch
from octex.tree.morton import encode
from octex.tree.search import UNITS, Origin, Positions, count_of, finite_place

#: Fewer points than this are sorted one by one.
_SORTED_SINGLY = 24
#: How far ahead points are asked for.
AHEAD = 16
#: Level of the cells by which many points are sorted before any is looked up; and how many of them that come
#: one after the other lie in the same one, on average, if they need not be.
_COARSE = 4
_RUN = 8


class Order(NamedTuple):
    """Points on their way to being sorted by Morton code, and as much room for that."""

    codes: Int64s  # (n,)
    numbers: Int32s  # (n,)   which points these are
    other_codes: Int64s  # (n,)
    other_numbers: Int32s  # (n,)


@kernel
def order_of(places: Float64s) -> Order:
    """Return points of texture space (n, 3) unsorted."""
    n = places.shape[0]
    order = Order(np.empty(n, np.int64), np.empty(n, np.int32), np.empty(n, np.int64), np.empty(n, np.int32))
    for m in range(n):
        i, j, k = cell_of(places[m, 0], UNITS), cell_of(places[m, 1], UNITS), cell_of(places[m, 2], UNITS)
        order.codes[m], order.numbers[m] = encode(i, j, k), m
    return order


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
def sort_by_digit(order: Order, begin: int, end: int, shift: int, counts: Int64s) -> None:
    """Sort points by nine bits of their codes."""
    codes, numbers = order.codes, order.numbers
    if end - begin < _SORTED_SINGLY:
        for m in range(begin + 1, end):
            code, number = codes[m], numbers[m]
            key, at = code >> shift, m
            while at > begin and codes[at - 1] >> shift > key:
                codes[at], numbers[at] = codes[at - 1], numbers[at - 1]
                at -= 1
            codes[at], numbers[at] = code, number
        return
    counts[:] = 0
    previous, is_sorted = np.int64(0), True
    for m in range(begin, end):
        digit = codes[m] >> shift & 511
        is_sorted &= bool(digit >= previous)
        previous = digit
        counts[np.uint64(digit + 1)] += 1
    if is_sorted:
        return
    total = np.int64(begin)
    for each in range(513):
        total += counts[each]
        counts[each] = total
    for m in range(begin, end):
        code = codes[m]
        bucket = np.uint64(code >> shift & 511)
        place = np.uint64(counts[bucket])
        counts[bucket] += 1
        order.other_codes[place], order.other_numbers[place] = code, numbers[m]
    for m in range(begin, end):
        codes[m], numbers[m] = order.other_codes[m], order.other_numbers[m]


@inlined
def end_of_cell(codes: Int64s, begin: int, end: int, shift: int) -> int:
    """Return the end of the points from ``begin`` on that lie in one cell."""
    key = codes[begin] >> shift
    low, step = begin, 8
    while low + step < end and codes[low + step] >> shift == key:
        low += step
        step *= 2
    high = min(low + step, end)  # there, or before, they end
    low += 1
    while low < high:
        middle = low + high >> 1
        if codes[middle] >> shift == key:
            low = middle + 1
        else:
            high = middle
    return low
