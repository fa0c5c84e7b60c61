"""Values of channels, from those of the level above and those that came before.

A cell's value is guessed from its parent's: to that is added a weighted sum of how the cells across the
parent's faces on its own side, those on the other side, three cells beside the cell, and its siblings so far
differ from it, and of how far the components before it differ from their parents', and from their guesses.
The weights are fitted to the texture, for parents of leaves alone and for others, by how much the cells
around the parent vary. What the guess is off by is coded by how much it may be. Where the cells around the
parent are all as it is, one symbol says first whether its children are, too.

Values are compared as whole numbers: integers as they are, floats by their bits, in the order of what they
stand for. Components of colours are coded green first.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octex.archive.around import ABOUT, OWN
from octex.archive.entropy import DECODES, MEASURES, PASS, Pool, code_bits, code_symbol, wide
from octex.arrays import Float64s, Int64s, Uint8s, Uint32s
from octex.jit import inlined, kernel

#: What a guess weighs: sums of differences on the cell's side, on the other, beside; the mean of the
#: siblings' so far; how 3 components were off, and differ.
TERMS = 10
_ERRORS = 4
#: How much the cells around vary, in steps of the channel's unit: classes have weights, contexts tables.
CLASSES = 5
CONTEXTS = 11
#: Nodes, leaves, rows of split cells, kept nodes.
SETS = 4
LEAVES, NODES, SPLIT_ROWS, KEPT_NODES = 0, 1, 2, 3
#: Weights are of 2¹².
WEIGHT_BITS = 12
_MOST_WEIGHT = 8 << WEIGHT_BITS

_CLASS_ENDS = np.array([1, 4, 16, 48], np.int64)
_CONTEXT_ENDS = np.array([1, 2, 3, 6, 10, 16, 24, 36, 52, 80], np.int64)
#: 2¹⁶ / n, for the mean of siblings.
_PARTS = np.array([0, *(65536 // n for n in range(1, 9))], np.int64)


def _steps(ends: Int64s) -> Uint8s:
    return np.searchsorted(ends, np.arange(1 << 11), side="right").astype(np.uint8)


#: What kernels take: the class, and the context, of how much differences vary, 0 … 2047; parts of means.
STEPS = _steps(_CLASS_ENDS), _steps(_CONTEXT_ENDS), _PARTS


class Coding(NamedTuple):
    """How a channel's values are coded: what kernels take."""

    order: Int64s  # (components,)   in which they are coded
    size: int  # bytes of a value: 1, 2, 4
    is_float: int
    error: int  # by how much a value may move
    unit: int  # differences are measured in 2ᵘⁿⁱᵗ
    weights: Int64s  # (2 · components · CLASSES · TERMS,)   of leaves and nodes


def weights_of(components: int) -> int:
    """Return how many weights a channel has."""
    return 2 * components * CLASSES * TERMS


def contexts_of(components: int) -> int:
    """Return how many contexts a channel has."""
    return SETS * components * CONTEXTS + 2


def new_squares(components: int) -> Float64s:
    """Return room for what ``code_values`` measures: of each class sums of squares, the count last."""
    return np.zeros((2 * components * CLASSES, TERMS + 1, TERMS + 1))


def order_of(components: int) -> Int64s:
    """Return the order in which components are coded."""
    return np.array([1, 0, 2, 3][:components] if components >= 3 else range(components), np.int64)


def numbers_of(raw: Uint8s, coding: Coding) -> Int64s:
    """Return values (n, components, size) as whole numbers (n, components)."""
    numbers: Int64s = raw.astype(np.int64) @ (1 << 8 * np.arange(coding.size))
    sign = 1 << (8 * coding.size - 1)
    return np.where(numbers & sign, 2 * sign - 1 - numbers, numbers | sign) if coding.is_float else numbers


@inlined
def _number(raw: Uint8s, row: int, component: int, size: int, is_float: int) -> int:
    """Return a value as a whole number."""
    at, part = np.uint64(row), np.uint64(component)
    number = wide(raw[at, part, 0])
    if size > 1:
        number |= wide(raw[at, part, 1]) << 8
        if size > 2:
            number |= wide(raw[at, part, 2]) << 16 | wide(raw[at, part, 3]) << 24
        if is_float:
            sign = 1 << (8 * size - 1)
            number = (2 * sign - 1) - number if number & sign else number | sign
    return number


@inlined
def _write(number: int, raw: Uint8s, row: int, component: int, size: int, is_float: int) -> None:
    at, part = np.uint64(row), np.uint64(component)
    if is_float:
        sign = 1 << (8 * size - 1)
        number = number ^ sign if number & sign else (2 * sign - 1) - number
    raw[at, part, 0] = number & 255
    if size > 1:
        raw[at, part, 1] = number >> 8 & 255
        if size > 2:
            raw[at, part, 2] = number >> 16 & 255
            raw[at, part, 3] = number >> 24


@inlined
def _code_number(
    work: int,
    number: int,
    guess: int,
    size: int,
    error: int,
    context: int,
    pool: Pool,
    coder: Int64s,
    stream: Uint32s,
) -> tuple[int, int]:
    """Note or decode a number near a guess; return it as it will be decoded, and what was coded."""
    most = (1 << 8 * size) - 1
    step = 2 * error + 1
    span = most + 1
    if error:
        span = (most + 2 * error) // step + 1
        guess = min(max(guess, 0), most)
    sign = wide(0)
    if work != DECODES:
        half = span >> 1
        off = number - guess
        if error:
            off = (off + error) // step if off >= 0 else -((error - off) // step)
            if off < -half:
                off += span
            elif off >= span - half:
                off -= span
        else:
            off = (off + half & most) - half
        sign = 2 * off if off >= 0 else -2 * off - 1
    if size == 1:
        sign = code_symbol(work, sign, context, pool, coder, stream)
    else:
        sign = _code_large(work, sign, context, pool, coder, stream)
    off = (sign >> 1 ^ -(sign & 1)) * step
    number = guess + off
    if error == 0:
        return number & most, off
    if number < -error:
        number += span * step
    elif number > most + error:
        number -= span * step
    return min(max(number, 0), most), off


@inlined
def _code_large(work: int, sign: int, context: int, pool: Pool, coder: Int64s, stream: Uint32s) -> int:
    """Code a number below 2³² as its length and two highest bits, and the others as they are."""
    token, rest = sign, wide(0)
    if sign >= 16:
        length = 4
        while sign >> (length + 1):
            length += 1
        token = 16 + (length - 4) * 4 + (sign >> (length - 2) & 3)
        rest = sign & ((1 << (length - 2)) - 1)
    token = code_symbol(work, token, context, pool, coder, stream)
    if token < 16:
        return token
    length = min(4 + (token - 16 >> 2), 31)
    rest = code_bits(rest, length - 2, coder, stream)
    return (4 | (token & 3)) << (length - 2) | rest


@kernel
def code_values(
    rows: Uint32s,
    cells: Int64s,
    given: Uint8s,
    raw: Uint8s,
    begin: int,
    coding: Coding,
    steps: tuple[Uint8s, Uint8s, Int64s],
    squares: Float64s,
    pool: Pool,
    coder: Int64s,
    stream: Uint32s,
) -> None:
    """Note, decode or measure the values of cells from ``begin`` on.

    ``rows`` and ``cells`` are what lies around them. Bytes ``given`` (cells, components, size) are what is
    noted; ``raw`` is what will be decoded, written unless they are one. ``steps`` are STEPS.
    """
    values = np.zeros((rows.shape[0] + 1) * coding.order.size, np.int64)
    around, terms = np.zeros(4 * _AROUND, np.int64), np.zeros(TERMS + 1, np.int64)
    task = rows, cells, given, raw, begin, coding, steps, squares, pool, coder, stream
    # Bytes are read by code of their own, in which these are known.
    if coding.size == 1 and coding.error == 0 and coding.unit == 0:
        _code_cells(task, values, around, terms, coder[PASS], 1, 0, 0, 0)
    else:
        _code_cells(
            task, values, around, terms, coder[PASS], coding.size, coding.is_float, coding.error, coding.unit
        )


# What ``around`` has of each component of a node's cell: its value; the sum that guesses begin with; weighted
# differences of the cells around; of the cells beside and of the children so far the weights; where the
# weights stand; how much the cells around differ; of the children so far the sum of differences; differences.
_VALUE, _SUM, _SIDES, _BESIDE, _SIBLINGS, _WEIGHTS, _MOST, _BEFORE, _RAW = 0, 1, 2, 8, 9, 10, 11, 12, 13
_AROUND = 20


@inlined
def _look_around(
    task: Any, values: Int64s, around: Int64s, kind: int, node: int, size: int, is_float: int, unit: int
) -> bool:
    """Write ``around`` for a node, and its cell's value for children beside which there is none.

    Returns whether the cells around are as it is.
    """
    rows, cells, _, raw, _, coding, steps, _, _, _, _ = task
    order, weights = coding.order, coding.weights
    components = order.size
    differ = wide(0)
    for j in range(components):
        at, component = _AROUND * j, order[np.uint64(j)]
        value = _number(raw, cells[np.uint64(node), OWN], component, size, is_float)
        total = differs = wide(0)
        for k in range(6):
            side = _number(raw, cells[np.uint64(node), k], component, size, is_float) - value
            around[np.uint64(at + _RAW + k)] = side
            total += side
            differs += abs(side)
        differ |= differs
        most = min(differs >> unit + 1, 255)
        own = ((kind * components + j) * CLASSES + wide(steps[0][np.uint64(most)])) * TERMS
        far, beside = weights[np.uint64(own + 1)], weights[np.uint64(own + 2)]
        nearer = weights[np.uint64(own)] - far
        for k in range(6):
            around[np.uint64(at + _SIDES + k)] = nearer * around[np.uint64(at + _RAW + k)]
        around[np.uint64(at + _VALUE)] = value
        around[np.uint64(at + _SUM)] = (
            (value << WEIGHT_BITS) + (1 << WEIGHT_BITS - 1) + far * total - 3 * beside * value
        )
        around[np.uint64(at + _BESIDE)] = beside
        around[np.uint64(at + _SIBLINGS)] = weights[np.uint64(own + 3)]
        around[np.uint64(at + _WEIGHTS)] = own
        around[np.uint64(at + _MOST)] = most
        around[np.uint64(at + _BEFORE)] = 0
        values[np.uint64(rows.shape[0] * components + j)] = value
    return differ == 0


@inlined
def _code_flat(
    task: Any,
    values: Int64s,
    around: Int64s,
    t: int,
    count: int,
    work: int,
    size: int,
    is_float: int,
    error: int,
) -> bool:
    """Code whether a node's children have its cell's values, and these if they do."""
    rows, _, given, raw, begin, coding, _, _, pool, coder, stream = task
    order = coding.order
    components = order.size
    kind = wide(rows[np.uint64(t), ABOUT]) >> 8 & 1
    flat = wide(1)
    if work != DECODES:
        for n in range(t, t + count):
            for j in range(components):
                number = _number(given, begin + n, order[np.uint64(j)], size, is_float)
                if abs(number - around[np.uint64(_AROUND * j + _VALUE)]) > error:
                    flat = wide(0)
    flat = code_symbol(work, flat, SETS * components * CONTEXTS + kind, pool, coder, stream)
    if flat:
        for n in range(t, t + count):
            for j in range(components):
                number = around[np.uint64(_AROUND * j + _VALUE)]
                values[np.uint64(n * components + j)] = number
                if work == DECODES or error > 0:
                    _write(number, raw, begin + n, order[np.uint64(j)], size, is_float)
    return flat != 0


@inlined
def _code_cells(
    task: Any,
    values: Int64s,
    around: Int64s,
    terms: Int64s,
    work: int,
    size: int,
    is_float: int,
    error: int,
    unit: int,
) -> None:
    rows, _, given, raw, begin, coding, steps, squares, pool, coder, stream = task
    _, context_of, parts = steps
    order, weights = coding.order, coding.weights
    components = order.size
    writes = work == DECODES or (error > 0 and work != MEASURES)
    left, node, t = wide(1), wide(-1), wide(-1)
    while t + 1 < rows.shape[0]:
        t += 1
        about = wide(rows[np.uint64(t), ABOUT])
        kind = about >> 8 & 1
        if left == 1:
            node += 1
            is_flat = _look_around(task, values, around, kind, node, size, is_float, unit)
            count = about >> 4 & 15
            if (
                is_flat
                and work != MEASURES
                and _code_flat(task, values, around, t, count, work, size, is_float, error)
            ):
                t += count - 1
                continue
        left = about >> 4 & 15
        x, y, z = _SIDES + (about >> 9 & 1), _SIDES + 2 + (about >> 10 & 1), _SIDES + 4 + (about >> 11 & 1)
        beside_x = wide(rows[np.uint64(t), 0]) * components
        beside_y = wide(rows[np.uint64(t), 1]) * components
        beside_z = wide(rows[np.uint64(t), 2]) * components
        part = parts[np.uint64(left)]
        noise = first_off = second_off = third_off = first = second = third = wide(0)
        for j in range(components):
            at = _AROUND * j
            beside = values[np.uint64(beside_x + j)] + values[np.uint64(beside_y + j)]
            beside += values[np.uint64(beside_z + j)]
            before = around[np.uint64(at + _BEFORE)]
            mean = before * part >> 16
            total = around[np.uint64(at + x)] + around[np.uint64(at + y)] + around[np.uint64(at + z)]
            total += around[np.uint64(at + _SUM)] + around[np.uint64(at + _BESIDE)] * beside
            total += around[np.uint64(at + _SIBLINGS)] * mean
            if j:
                own = around[np.uint64(at + _WEIGHTS)] + _ERRORS
                total += weights[np.uint64(own)] * first_off + weights[np.uint64(own + 3)] * first
                if j > 1:
                    total += weights[np.uint64(own + 1)] * second_off + weights[np.uint64(own + 4)] * second
                    total += weights[np.uint64(own + 2)] * third_off + weights[np.uint64(own + 5)] * third
            guess = total >> WEIGHT_BITS
            value, number = around[np.uint64(at + _VALUE)], wide(0)
            if work != DECODES:
                number = _number(given, begin + t, order[np.uint64(j)], size, is_float)
            if work == MEASURES:
                off = number - guess
                terms[0] = terms[1] = 0
                for k in range(6):
                    terms[0 if _SIDES + k in (x, y, z) else 1] += around[at + _RAW + k]
                terms[2], terms[3], terms[TERMS] = beside - 3 * value, mean, number - value
                terms[4], terms[5], terms[6] = first_off, second_off, third_off
                terms[7], terms[8], terms[9] = first, second, third
                _measure(terms, off, 2.0**-unit, squares, around[at + _WEIGHTS] // TERMS)
            else:
                most = around[np.uint64(at + _MOST)] + noise
                context = wide(context_of[np.uint64(most if size == 1 and error == 0 else min(most, 255))])
                context += (kind * components + j) * CONTEXTS
                number, off = _code_number(work, number, guess, size, error, context, pool, coder, stream)
            if writes:
                _write(number, raw, begin + t, order[np.uint64(j)], size, is_float)
            values[np.uint64(t * components + j)] = number
            around[np.uint64(at + _BEFORE)] = before + number - value
            if j == 0:
                first_off, first = off, number - value
            elif j == 1:
                second_off, second = off, number - value
            else:
                third_off, third = off, number - value
            noise += 2 * abs(off) >> unit


@inlined
def _measure(terms: Int64s, off: int, scale: float, squares: Float64s, number: int) -> None:
    """Add to the sums of least squares: terms by terms, the number wanted last; how many there are."""
    weight = 1.0 / (abs(off) * scale + 0.5)
    for n in range(TERMS + 1):
        if terms[n] == 0:
            continue
        weighted = weight * (terms[n] * scale)
        for m in range(min(n, TERMS - 1) + 1):
            squares[number, n, m] += weighted * (terms[m] * scale)
    squares[number, TERMS, TERMS] += 1.0


@kernel
def solve(squares: Float64s, weights: Int64s) -> None:
    """Write the weights that make weighted squares of errors least, 0 of few; Cholesky's way."""
    for number in range(squares.shape[0]):
        square, right = squares[number], np.zeros(TERMS)
        if square[TERMS, TERMS] < 4 * TERMS:
            continue
        ridge = 1e-3 * np.sqrt(square[TERMS, TERMS])
        for n in range(TERMS):
            right[n] = square[TERMS, n]
            square[n, n] += ridge
            for m in range(n + 1):
                total = square[n, m]
                for k in range(m):
                    total -= square[n, k] * square[m, k]
                square[n, m] = np.sqrt(max(total, ridge)) if n == m else total / square[m, m]
        for n in range(TERMS):
            for k in range(n):
                right[n] -= square[n, k] * right[k]
            right[n] /= square[n, n]
        for n in range(TERMS - 1, -1, -1):
            for k in range(n + 1, TERMS):
                right[n] -= square[k, n] * right[k]
            right[n] /= square[n, n]
            weight = np.rint(right[n] * (1 << WEIGHT_BITS))
            weights[number * TERMS + n] = int(min(max(weight, -_MOST_WEIGHT), _MOST_WEIGHT))


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
    """Likewise the values of rows from ``first`` on, a row of each cell of ``owners``, by the cells' own."""
    _, context_of, _ = steps
    order, size, is_float, error, unit, _ = coding
    components = order.size
    work = coder[PASS]
    writes = work == DECODES or error > 0
    before = np.zeros(4, np.int64)
    for n in range(owners.size):
        if n == 0 or owners[n] != owners[n - 1]:
            before[:] = 0
        noise = shift = wide(0)
        for j in range(components):
            own = _number(cell_raw, owners[n], order[j], size, is_float)
            guess = min(max(own + (shift if components >= 3 else 0), 0), (1 << 8 * size) - 1)
            varies = min((abs(before[j]) >> unit) + noise, 255)
            context = (kind * components + j) * CONTEXTS + wide(context_of[np.uint64(varies)])
            number = wide(0)
            if work != DECODES:
                number = _number(given, first + n, order[j], size, is_float)
            number, off = _code_number(work, number, guess, size, error, context, pool, coder, stream)
            if writes:
                _write(number, raw, first + n, order[j], size, is_float)
            before[j] = shift = number - own
            noise += 2 * abs(off) >> unit
