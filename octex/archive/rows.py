"""Values of the rows of split cells, and of kept nodes, from their cells' own."""

from __future__ import annotations

import numpy as np

from octex.archive.coding import (
    CONTEXTS,
    Coding,
    code_folded,
    corrected,
    error_of,
    folded,
    number_at,
    unfolded,
    write_number,
)
from octex.archive.entropy import DECODES, NOTES, PASS, Pool, wide
from octex.arrays import Int64s, Uint8s, Uint32s
from octex.jit import kernel


@kernel
def code_rows(
    owners: Uint32s,
    cell_raw: Uint8s,
    given: Uint8s,
    raw: Uint8s,
    first: int,
    kind: int,
    coding: Coding,
    steps: tuple[Uint8s, Uint8s, Int64s],
    pool: Pool,
    coder: Int64s,
    stream: Uint32s,
) -> None:
    """Note or decode the values of rows from ``first`` on, a row of each cell of ``owners``."""
    _, context_of, _ = steps
    order, size, is_float, error, unit, _, _ = coding
    components = order.size
    work = coder[PASS]
    flat = cell_raw.reshape(-1), given.reshape(-1), raw.reshape(-1)
    before = np.zeros(4, np.int64)
    for n in range(owners.size):
        if n == 0 or owners[n] != owners[n - 1]:
            before[:] = 0
        noise = shift = wide(0)
        for j in range(components):
            at = (wide(owners[n]) * components + order[j]) * size
            own = number_at(flat[0], at, size, is_float)
            at = ((first + n) * components + order[j]) * size
            guess = min(max(own + (shift if components >= 3 else 0), 0), (1 << 8 * size) - 1)
            varies = min((abs(before[j]) >> unit) + noise, 255)
            context = (kind * components + j) * CONTEXTS + wide(context_of[np.uint64(varies)])
            off = wide(0)
            if work == NOTES:
                off = error_of(number_at(flat[1], at, size, is_float), guess, size, error)
            off = unfolded(code_folded(work, folded(off), size, context, pool, coder, stream))
            number = corrected(guess, off, size, error)
            if work == DECODES or error > 0:
                write_number(number, flat[2], at, size, is_float)
            before[j] = shift = number - own
            noise += 2 * abs(off) * (2 * error + 1) >> unit
