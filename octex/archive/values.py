"""Values of channels, from those of the level above and those that came before.

A cell's value is guessed from its parent's: to that is added a weighted sum of how ten cells around the
parent, three cells beside the cell, and its siblings so far differ from it, and of how far the guesses of
the components before it were off. The weights are fitted to the texture, for nodes and for leaves, by how
much these differences vary. What the guess is off by is coded by how much it may be.

Values are compared as whole numbers: integers as they are, floats by their bits, in the order of what they
stand for. Components of colours are coded green first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.archive.around import ABOVE, LEFT, PARENT, SHAPE
from octex.archive.entropy import DECODES, FAULT, PASS, code_bits, code_symbol, wide
from octex.arrays import Float64s, Int64s, Uint8s, Uint32s
from octex.jit import inlined, kernel

#: Differences that a guess weighs: 10 above, 3 beside, the siblings'; then 3 components' errors.
TERMS = 17
_AROUND = 13
_SIBLINGS = 13
_ERRORS = 14
#: How much the differences vary, in steps of the channel's unit: classes have weights, contexts tables.
CLASSES = 5
CONTEXTS = 11
#: Nodes, leaves, rows of split cells, kept nodes.
SETS = 4
LEAVES, NODES, SPLIT_ROWS, KEPT_NODES = 0, 1, 2, 3
#: Weights are of 2¹².
WEIGHT_BITS = 12
_MOST_WEIGHT = 8 << WEIGHT_BITS
_ROUNDS = 4  # of least squares

_CLASS_ENDS = np.array([1, 4, 16, 48], np.int64)
_CONTEXT_ENDS = np.array([1, 2, 3, 6, 10, 16, 24, 36, 52, 80], np.int64)
#: 2¹⁶ / n, for the mean of siblings.
PARTS = np.array([0, *(65536 // n for n in range(1, 9))], np.int64)


def _steps(ends: Int64s) -> Uint8s:
    return np.searchsorted(ends, np.arange(256), side="right").astype(np.uint8)


#: The class, and the context, of how much differences vary, 0 … 255.
CLASS_OF = _steps(_CLASS_ENDS)
CONTEXT_OF = _steps(_CONTEXT_ENDS)
#: What kernels take of these.
STEPS = CLASS_OF, CONTEXT_OF, PARTS


class Coding(NamedTuple):
    """How a channel's values are coded: what kernels take."""

    order: Int64s  # (components,)   in which they are coded
    size: int  # bytes of a value: 1, 2, 4
    is_float: int
    error: int  # by how much a value may move
    unit: int  # differences are measured in 2ᵘⁿⁱᵗ
    weights: Int64s  # (2 · components · CLASSES, TERMS)   of leaves and nodes


def order_of(components: int) -> Int64s:
    """Return the order in which components are coded."""
    return np.array([1, 0, 2, 3][:components] if components >= 3 else range(components), np.int64)


@inlined
def _number(raw: Uint8s, row: int, component: int, size: int, is_float: int) -> int:
    """Return a value as a whole number."""
    number = wide(raw[row, component, 0])
    if size > 1:
        number |= wide(raw[row, component, 1]) << 8
        if size > 2:
            number |= wide(raw[row, component, 2]) << 16 | wide(raw[row, component, 3]) << 24
        if is_float:
            sign = 1 << (8 * size - 1)
            number = (2 * sign - 1) - number if number & sign else number | sign
    return number


@inlined
def _write(number: int, raw: Uint8s, row: int, component: int, size: int, is_float: int) -> None:
    if is_float:
        sign = 1 << (8 * size - 1)
        number = number ^ sign if number & sign else (2 * sign - 1) - number
    for place in range(size):
        raw[row, component, place] = number >> 8 * place & 255


@inlined
def _gathered(
    rows: Int64s,
    t: int,
    raw: Uint8s,
    component: int,
    size: int,
    is_float: int,
    siblings: int,
    parts: Int64s,
    terms: Int64s,
    place: int,
) -> tuple[int, int]:
    """Write the terms of a guess; return the parent's value, and by how much terms differ most."""
    parent = _number(raw, rows[t, PARENT], component, size, is_float)
    most = 0
    for n in range(_AROUND):
        term = _number(raw, rows[t, ABOVE + n], component, size, is_float) - parent
        terms[place + n] = term
        most = max(most, abs(term))
    terms[place + _SIBLINGS] = siblings * parts[rows[t, LEFT]] >> 16
    return parent, most


@kernel
def gather(
    rows: Int64s, raw: Uint8s, begin: int, coding: Coding, parts: Int64s, terms: Int64s, values: Int64s
) -> None:
    """Write, of cells from ``begin`` on, terms (n · components · TERMS,) and values less the parents'."""
    siblings = np.zeros(4, np.int64)
    left_before = 0
    for t in range(rows.shape[0]):
        if left_before <= 1:
            siblings[:] = 0
        left_before = rows[t, LEFT]
        for j in range(coding.order.size):
            component = coding.order[j]
            parent, _ = _gathered(
                rows,
                t,
                raw,
                component,
                coding.size,
                coding.is_float,
                siblings[j],
                parts,
                terms,
                (t * coding.order.size + j) * TERMS,
            )
            value = _number(raw, begin + t, component, coding.size, coding.is_float) - parent
            values[t, j] = value
            siblings[j] += value


@inlined
def _code_number(
    number: int,
    guess: int,
    coding: Coding,
    table: int,
    counts: Int64s,
    starts: Int64s,
    symbols: Uint8s,
    coder: Int64s,
    stream: Uint32s,
) -> int:
    """Count, encode or decode a number near a guess; return it as it will be decoded."""
    most = (1 << 8 * coding.size) - 1
    error = coding.error
    step = 2 * error + 1
    span = (most + 2 * error) // step + 1
    half = span >> 1
    guess = min(max(guess, 0), most)
    sign = 0
    if coder[PASS] != DECODES:
        off = number - guess
        if error:
            off = (off + error) // step if off >= 0 else -((error - off) // step)
        if off < -half:
            off += span
        elif off >= span - half:
            off -= span
        sign = 2 * off if off >= 0 else -2 * off - 1
    if coding.size == 1:
        sign = code_symbol(sign, table, counts, starts, symbols, coder, stream)
    else:
        sign = _code_large(sign, table, counts, starts, symbols, coder, stream)
    off = -(sign + 1 >> 1) if sign & 1 else sign >> 1
    number = guess + off * step
    if number < -error:
        number += span * step
    elif number > most + error:
        number -= span * step
    return min(max(number, 0), most)


@inlined
def _code_large(
    sign: int,
    table: int,
    counts: Int64s,
    starts: Int64s,
    symbols: Uint8s,
    coder: Int64s,
    stream: Uint32s,
) -> int:
    """Code a number below 2³² as its length and two highest bits, and the others as they are."""
    token, rest = sign, 0
    if sign >= 16:
        length = 4
        while sign >> (length + 1):
            length += 1
        token = 16 + (length - 4) * 4 + (sign >> (length - 2) & 3)
        rest = sign & ((1 << (length - 2)) - 1)
    token = code_symbol(token, table, counts, starts, symbols, coder, stream)
    if token < 16:
        return token
    length = min(4 + (token - 16 >> 2), 31)
    if coder[PASS] != 0:
        rest = code_bits(rest, length - 2, coder, stream)
    return (4 | (token & 3)) << (length - 2) | rest


@kernel
def code_values(
    rows: Int64s,
    given: Uint8s,
    raw: Uint8s,
    begin: int,
    coding: Coding,
    steps: tuple[Uint8s, Uint8s, Int64s],
    counts: Int64s,
    starts: Int64s,
    symbols: Uint8s,
    coder: Int64s,
    stream: Uint32s,
) -> None:
    """Count, encode or decode the values of cells from ``begin`` on, around which lie ``rows``.

    Bytes ``given`` (cells, components, size) are what is encoded; ``raw`` is what will be decoded, written
    unless they are one. ``steps`` are CLASS_OF, CONTEXT_OF and the parts of means.
    """
    class_of, context_of, parts = steps
    components = coding.order.size
    siblings = np.zeros(4, np.int64)
    terms = np.zeros(TERMS, np.int64)
    writes = coder[PASS] == DECODES or coding.error > 0
    left_before = 0
    for t in range(rows.shape[0]):
        if left_before <= 1:
            siblings[:] = 0
        left_before = rows[t, LEFT]
        kind = rows[t, SHAPE] >> 6
        noise = 0
        for j in range(components):
            component = coding.order[j]
            parent, most = _gathered(
                rows, t, raw, component, coding.size, coding.is_float, siblings[j], parts, terms, 0
            )
            most >>= coding.unit
            which = (kind * components + j) * CLASSES + wide(class_of[min(most, 255)])
            total = 1 << WEIGHT_BITS - 1
            for n in range(_ERRORS + j):
                total += coding.weights[which, n] * terms[n]
            guess = parent + (total >> WEIGHT_BITS)
            context = wide(context_of[min(most + noise, 255)])
            table = (kind * components + j) * CONTEXTS + context
            number = wide(0)
            if coder[PASS] != DECODES:
                number = _number(given, begin + t, component, coding.size, coding.is_float)
            number = _code_number(number, guess, coding, table, counts, starts, symbols, coder, stream)
            if writes:
                _write(number, raw, begin + t, component, coding.size, coding.is_float)
            siblings[j] += number - parent
            off = number - guess
            if j < 3:
                terms[_ERRORS + j] = off
            noise += 2 * abs(off) >> coding.unit
        if coder[FAULT]:
            return


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
    counts: Int64s,
    starts: Int64s,
    symbols: Uint8s,
    coder: Int64s,
    stream: Uint32s,
) -> None:
    """Likewise the values of rows from ``first`` on, a row of each cell of ``owners``, by the cells' own."""
    _, context_of, _ = steps
    components = coding.order.size
    writes = coder[PASS] == DECODES or coding.error > 0
    before = np.zeros(4, np.int64)
    for n in range(owners.size):
        if n == 0 or owners[n] != owners[n - 1]:
            before[:] = 0
        noise = shift = 0
        for j in range(components):
            component = coding.order[j]
            own = _number(cell_raw, owners[n], component, coding.size, coding.is_float)
            guess = own + (shift if components >= 3 else 0)
            context = wide(context_of[min((abs(before[j]) >> coding.unit) + noise, 255)])
            table = (kind * components + j) * CONTEXTS + context
            number = wide(0)
            if coder[PASS] != DECODES:
                number = _number(given, first + n, component, coding.size, coding.is_float)
            number = _code_number(number, guess, coding, table, counts, starts, symbols, coder, stream)
            if writes:
                _write(number, raw, first + n, component, coding.size, coding.is_float)
            before[j] = number - own
            shift = number - own
            noise += 2 * abs(number - guess) >> coding.unit
        if coder[FAULT]:
            return


def fitted(terms: Int64s, values: Int64s, is_node: Uint8s, unit: int) -> Int64s:
    """Return weights (2 · components · CLASSES, TERMS) for terms (n, components, TERMS) of cells.

    They make the sum of absolute errors small (least squares, reweighted).
    """
    components = values.shape[1]
    weights = np.zeros((2, components, CLASSES, TERMS), np.int64)
    for kind in (LEAVES, NODES):
        chosen = is_node == kind
        own, wanted = terms[chosen].astype(np.float64), values[chosen].astype(np.float64)
        for j in range(components):
            most = np.abs(own[:, j, :_AROUND]).max(axis=1, initial=0) / 2.0**unit
            classes = CLASS_OF[np.minimum(most, 255).astype(np.int64)]
            guess = np.zeros(len(own))
            for number in range(CLASSES):
                here = classes == number
                if here.sum() < 4 * TERMS:
                    continue
                columns = own[here, j, : _ERRORS + j]
                found = np.zeros(_ERRORS + j)
                _least(columns, wanted[here, j], 2.0**unit, found)
                fixed = np.clip(np.rint(found * 2**WEIGHT_BITS), -_MOST_WEIGHT, _MOST_WEIGHT)
                weights[kind, j, number, : found.size] = fixed.astype(np.int64)
                guess[here] = (columns * (fixed / 2**WEIGHT_BITS)).sum(axis=1)
            if j < 3:
                own[:, j + 1 :, _ERRORS + j] = (wanted[:, j] - guess)[:, None]
    return weights.reshape(-1, TERMS)


@kernel
def _least(columns: Float64s, wanted: Float64s, unit: float, found: Float64s) -> None:
    """Solve columns @ found ≈ wanted; Cholesky's way, the same on every machine."""
    count, width = columns.shape
    square, right = np.zeros((width, width)), np.zeros(width)
    for _ in range(_ROUNDS):
        square[:] = 0.0
        right[:] = 0.0
        for i in range(count):
            off = wanted[i]
            for n in range(width):
                off -= columns[i, n] * found[n]
            weight = 1.0 / (abs(off) / unit + 0.5)
            for n in range(width):
                weighted = weight * columns[i, n]
                if weighted != 0.0:
                    right[n] += weighted * wanted[i]
                    for m in range(n + 1):
                        square[n, m] += weighted * columns[i, m]
        ridge = 1e-3 * np.sqrt(count) * unit * unit
        for n in range(width):
            square[n, n] += ridge
            for m in range(n + 1):
                total = square[n, m]
                for k in range(m):
                    total -= square[n, k] * square[m, k]
                square[n, m] = np.sqrt(max(total, ridge)) if n == m else total / square[m, m]
        for n in range(width):
            for k in range(n):
                right[n] -= square[n, k] * right[k]
            right[n] /= square[n, n]
        for n in range(width - 1, -1, -1):
            for k in range(n + 1, width):
                right[n] -= square[k, n] * right[k]
            right[n] /= square[n, n]
        found[:] = right
