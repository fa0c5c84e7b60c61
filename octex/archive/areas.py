"""Areas of cells, from their parents' and their siblings'.

The areas of a node's children make up its own. What is left of it, how many children are left, and which
cells lie across the child's faces say what its area may be; that of the last child is nearly known.
"""

from __future__ import annotations

import numpy as np

from octex.archive.around import LEFT, PARENT, SHAPE
from octex.archive.entropy import DECODES, FAULT, PASS, code_symbol, wide
from octex.arrays import Int64s, Uint8s, Uint16s, Uint32s
from octex.jit import kernel
from octex.tree.layout import AREA_ONE, AREA_STEPS

#: Contexts: 10 shapes, 4 numbers of children left, 12 parts of the area that is left; then 6 of split rows.
CONTEXTS = 480 + 36
#: Most tables that these share.
TABLES = 64


def linear_areas() -> Int64s:
    """Return 2³⁰ times the areas of codes, in cell faces, whole."""
    areas = np.rint(np.exp2((np.arange(256) - AREA_ONE) / AREA_STEPS + 30)).astype(np.int64)
    areas[0] = 0
    return areas


@kernel
def code_areas(
    rows: Int64s,
    areas: Uint8s,
    begin: int,
    linear: Int64s,
    shapes: Uint8s,
    tables: Uint16s,
    counts: Int64s,
    starts: Int64s,
    symbols: Uint8s,
    coder: Int64s,
    stream: Uint32s,
) -> None:
    """Count, encode or decode the areas of cells from ``begin`` on, around which lie ``rows``."""
    rest = whole = wide(0)
    left_before = 0
    for t in range(rows.shape[0]):
        cell, left = begin + t, rows[t, LEFT]
        parent = wide(areas[rows[t, PARENT]])
        if left_before <= 1:
            whole = 4 * linear[parent]
            rest = whole
        left_before = left
        rest = max(rest, whole >> 8)
        guess = _code(rest, linear) if left == 1 else parent
        context = wide(shapes[rows[t, SHAPE] & 63]) + 10 * (min(left, 4) - 1) + 40 * _part(rest, whole)
        symbol = (wide(areas[cell]) - guess) & 255
        symbol = code_symbol(symbol, wide(tables[context]), counts, starts, symbols, coder, stream)
        code = (guess + symbol) & 255
        if coder[PASS] == DECODES:
            areas[cell] = code
        rest -= linear[code]
        if coder[FAULT]:
            return


@kernel
def _part(rest: int, whole: int) -> int:
    """Return how much of an area is left, 0 … 11."""
    part = 0
    if whole > 0:
        ratio = (rest << 6) // whole
        if ratio < 4:
            part = ratio
        elif ratio < 16:
            part = 4 + (ratio - 4) // 4
        elif ratio < 48:
            part = 7 + (ratio - 16) // 8
        else:
            part = 11
    return part


@kernel
def _code(area: int, linear: Int64s) -> int:
    """Return the code of the largest area that is not above ``area``."""
    low, high = 0, 255
    while low < high:
        middle = low + high + 1 >> 1
        if linear[middle] <= area:
            low = middle
        else:
            high = middle - 1
    return low


@kernel
def code_row_areas(
    cells: Uint32s,
    facings: Uint8s,
    areas: Uint8s,
    begin: int,
    cell_areas: Uint8s,
    linear: Int64s,
    tables: Uint16s,
    counts: Int64s,
    starts: Int64s,
    symbols: Uint8s,
    coder: Int64s,
    stream: Uint32s,
) -> None:
    """Likewise the areas of split cells' rows, from row ``begin`` on."""
    row = begin
    for n in range(cells.size):
        code = wide(cell_areas[cells[n]])
        whole = linear[code]
        rest = whole
        facing = wide(facings[n])
        left = 0
        for place in range(6):
            left += facing >> place & 1
        for place in range(left, 0, -1):
            rest = max(rest, whole >> 8)
            guess = _code(rest, linear) if place == 1 else code
            context = 480 + (min(place, 3) - 1) + 3 * _part(rest, whole)
            symbol = (wide(areas[row]) - guess) & 255
            symbol = code_symbol(symbol, wide(tables[context]), counts, starts, symbols, coder, stream)
            found = (guess + symbol) & 255
            if coder[PASS] == DECODES:
                areas[row] = found
            rest -= linear[found]
            row += 1
            if coder[FAULT]:
                return


def shared_tables(counts: Int64s) -> Uint16s:
    """Return which of TABLES each context uses: those whose symbols are spread alike share one (k-means)."""
    used = np.flatnonzero(counts.any(axis=1))
    chosen = np.zeros(len(counts), np.uint16)
    if used.size <= TABLES:
        chosen[used] = np.arange(used.size)
        return chosen
    own = counts[used].astype(np.float64)
    order = np.argsort(-own.sum(axis=1), kind="stable")
    centres = own[order[:TABLES]]
    nearest = np.zeros(used.size, np.int64)
    for _ in range(6):
        chances = (centres + 0.02) / (centres + 0.02).sum(axis=1, keepdims=True)
        nearest = np.argmax(own @ np.log2(chances).T, axis=1)
        centres = np.zeros_like(centres)
        np.add.at(centres, nearest, own)
    chosen[used] = nearest
    return chosen
