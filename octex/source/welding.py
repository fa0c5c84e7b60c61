"""Equal rows of arrays: vertices at one position, or equal directions and coordinates."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Int32s, Int64s, Uint32s
from octex.jit import kernel

# Odd, and without a pattern in its bits: the golden ratio's fraction (Knuth, TAOCP 3, 6.4).
_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)


def first_equal(rows: npt.NDArray[np.floating | np.integer]) -> Int64s:
    """Return for each row the first one that equals it (n,)."""
    numbers = welded(rows)
    _, first = np.unique(numbers, return_index=True)
    return first[numbers].astype(np.int64)


def distinct_rows(rows: Array) -> tuple[Array, Int64s]:
    """Return the distinct rows (k, columns) and each row's number (n,); a sort takes five times as long."""
    numbers = welded(rows)
    distinct = np.empty((int(numbers.max(initial=-1)) + 1, rows.shape[1]), rows.dtype)
    distinct[numbers] = rows
    return distinct, numbers.astype(np.int64)


def welded(rows: npt.NDArray[np.floating | np.integer]) -> Int32s:
    """Return a number for each row, the same for equal rows and counting from 0 up."""
    words = np.ascontiguousarray(rows + np.zeros((), rows.dtype)).view(np.uint32)  # −0 becomes 0
    hashes = np.zeros(len(rows), np.uint64)
    for column in words.T:
        hashes ^= column
        hashes *= _MULTIPLIER
        hashes ^= hashes >> np.uint64(32)
    size = 2 ** (2 * len(rows)).bit_length()
    numbers = np.empty(len(rows), np.int32)
    _weld(words, (hashes & np.uint64(size - 1)).astype(np.int64), np.full(size, -1, np.int32), numbers)
    return numbers


@kernel
def _weld(words: Uint32s, slots: Int64s, table: Int32s, numbers: Int32s) -> None:
    """Give equal rows equal numbers, by a hash table with linear probing, its size a power of two."""
    count = 0
    for row in range(len(words)):
        slot = slots[row]
        while True:
            other = table[slot]
            if other < 0:
                table[slot] = row
                numbers[row] = count
                count += 1
                break
            same = True
            for k in range(words.shape[1]):
                same = same and words[row, k] == words[other, k]
            if same:
                numbers[row] = numbers[other]
                break
            slot = (slot + 1) & (len(table) - 1)


def paired_sides(starts: Int64s, ends: Int64s) -> tuple[Int64s, Int64s]:
    """Return the pairs of sides, from ``starts`` to ``ends`` (n,), that share an edge with no third side."""
    low, high = np.minimum(starts, ends), np.maximum(starts, ends)
    keys = low * (int(high.max(initial=0)) + 1) + high
    order = np.argsort(keys, kind="stable")
    firsts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    pairs = firsts[np.diff(firsts, append=keys.size) == 2]
    return order[pairs], order[pairs + 1]


def sides_across(starts: Int64s, ends: Int64s) -> Int64s:
    """Return for each side (n,) the one side in the reverse direction; −1 for none."""
    a, b = paired_sides(starts, ends)
    is_sound = (starts[a] == ends[b]) & (starts[a] != ends[a])
    across = np.full(starts.size, -1, np.int64)
    across[a[is_sound]], across[b[is_sound]] = b[is_sound], a[is_sound]
    return across
