"""Areas of cells, from their parents' and their siblings'.

The areas of a node's children make up its own. What is left of it, how many children are left, and which
cells lie across the child's faces, and the largest of their areas, say what its area may be; that of the last
child is nearly known.
"""

from __future__ import annotations

import numpy as np

from octex.archive.around import ABOUT, OWN
from octex.archive.entropy import DECODES, PASS, Pool, code_symbol, wide
from octex.arrays import Int64s, Uint8s, Uint32s
from octex.jit import inlined, kernel
from octex.tree.layout import AREA_ONE, AREA_STEPS

#: Contexts: 10 shapes, 4 numbers of children left, 5 of the largest area beside, 12 parts of the area that is
#: left; then 36 of split rows.
CONTEXTS = 2400 + 36
_BITS = 30  # of an area of one
#: From so many steps of area below all of it on, what is left is a smaller part.
_PARTS = np.array([4, 6, 9, 12, 17, 20, 25, 33, 36, 41, 49])


def area_tables() -> tuple[Int64s, Uint8s, Uint8s]:
    """Return what kernels take: 2³⁰ times the areas of codes, whole; steps of an octave; parts of steps."""
    areas = np.rint(np.exp2((np.arange(256) - AREA_ONE) / AREA_STEPS + _BITS)).astype(np.int64)
    areas[0] = 0
    steps = np.floor(AREA_STEPS * np.log2(1 + (np.arange(256) + 0.5) / 256)).astype(np.uint8)
    parts = 11 - np.searchsorted(_PARTS, np.arange(256), side="right")
    return areas, steps, parts.astype(np.uint8)


@inlined
def _code(area: int, areas: Int64s, steps: Uint8s) -> int:
    """Return the code of the largest area that is not above ``area``, below 2⁵²."""
    bits = wide(np.float64(area).view(np.int64))
    code = AREA_ONE + AREA_STEPS * ((bits >> 52) - 1023 - _BITS) + wide(steps[bits >> 44 & 255]) - 1
    code = min(max(code, 0), 253)
    # Areas ascend: neither waits for the other.
    return code + wide(areas[np.uint64(code + 1)] <= area) + wide(areas[np.uint64(code + 2)] <= area)


@inlined
def _code_area(
    work: int,
    area: int,
    whole: int,
    rest: int,
    is_last: bool,
    context: int,
    span: int,
    tables: tuple[Int64s, Uint8s, Uint8s],
    pool: Pool,
    coder: Int64s,
    stream: Uint32s,
) -> tuple[int, int]:
    """Code an area as part of a whole; return it and what is left of the ``rest``."""
    areas, steps, parts = tables
    rest = max(rest, areas[np.uint64(whole)] >> 8)
    code = _code(rest, areas, steps)
    part = wide(parts[np.uint64(min(max(whole - code, 0), 255))])
    guess = code if is_last else whole
    symbol = code_symbol(work, (area - guess) & 255, context + span * part, pool, coder, stream)
    area = (guess + symbol) & 255
    return area, rest - areas[np.uint64(area)]


@kernel
def code_areas(
    rows: Uint32s,
    cells: Int64s,
    areas: Uint8s,
    begin: int,
    tables: tuple[Int64s, Uint8s, Uint8s],
    pool: Pool,
    coder: Int64s,
    stream: Uint32s,
) -> None:
    """Note or decode the areas of cells from ``begin`` on; ``rows``, ``cells`` lie around them."""
    work = coder[PASS]
    rest = whole = wide(0)
    left, node = 1, -1
    for t in range(rows.shape[0]):
        if left == 1:
            node += 1
            # A child's face is a quarter of its parent's: so many steps.
            whole = min(wide(areas[cells[node, OWN]]) + 2 * AREA_STEPS, 255)
            rest = tables[0][whole]
        about = wide(rows[np.uint64(t), ABOUT])
        left = about >> 4 & 15
        beside = wide(0)
        for axis in range(3):
            other = wide(rows[np.uint64(t), axis])
            # Whether one lies there is as good as random: no branch.
            beside = max(beside, wide(areas[np.uint64(other)]) & -wide(other >= begin))
        below = whole - beside
        size = 0 if beside == 0 else 1 + wide(below >= 6) + wide(below >= 12) + wide(below >= 20)
        context = (about & 15) + 10 * (min(left, 4) - 1) + 40 * size
        area = wide(areas[np.uint64(begin + t)])
        area, rest = _code_area(work, area, whole, rest, left == 1, context, 200, tables, pool, coder, stream)
        if work == DECODES:
            areas[begin + t] = area


@kernel
def code_row_areas(
    cells: Uint32s,
    facings: Uint8s,
    areas: Uint8s,
    begin: int,
    cell_areas: Uint8s,
    tables: tuple[Int64s, Uint8s, Uint8s],
    pool: Pool,
    coder: Int64s,
    stream: Uint32s,
) -> None:
    """Likewise the areas of split cells' rows, from row ``begin`` on."""
    work, row = coder[PASS], begin
    for n in range(cells.size):
        whole = wide(cell_areas[cells[n]])
        rest = tables[0][whole]
        left = 0
        for place in range(6):
            left += wide(facings[n]) >> place & 1
        while left:
            context = 2400 + min(left, 3) - 1
            area = wide(areas[row])
            area, rest = _code_area(
                work, area, whole, rest, left == 1, context, 3, tables, pool, coder, stream
            )
            if work == DECODES:
                areas[row] = area
            left -= 1
            row += 1
