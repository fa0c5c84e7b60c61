"""Values of channels, from those of the level above and those that came before.

A cell's value is guessed from its parent's: to that is added a weighted sum of how the cells across the
parent's faces on its own side, those on the other side, three cells beside the cell, and its siblings so far
differ from it, and of how far the components before it differ from their parents', and from their guesses.
The weights are fitted to the texture, for parents of leaves alone and for others, by how much the cells
around the parent vary. What the guess is off by is coded by how much it may be. Where the cells around the
parent are all as it is, one symbol says first whether its children are, too.

Nodes are taken in runs. By how much errors may be off is known without the guesses: so a component's errors
of a whole run are decoded at once, four states side by side, before the values that they correct.

Values are compared as whole numbers: integers as they are, floats by their bits, in the order of what they
stand for. Components of colours are coded green first.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octex.archive.around import ABOUT, OWN
from octex.archive.entropy import (
    DECODES,
    MEASURES,
    NOTES,
    PASS,
    Pool,
    code_bits,
    code_symbol,
    code_symbols,
    wide,
)
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
    by_cell: int  # errors are coded cell by cell, not a component of many cells after the other
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
def _component(j: int, components: int) -> int:
    """Return which component is coded as the j-th, as ``order_of`` has it."""
    return wide(1 - j if components >= 3 and j < 2 else j)


@inlined
def _number(raw: Uint8s, at: int, size: int, is_float: int) -> int:
    """Return the value whose first byte is ``at`` as a whole number."""
    i = np.uint64(at)
    number = wide(raw[i])
    if size > 1:
        number |= wide(raw[i + np.uint64(1)]) << 8
        if size > 2:
            number |= wide(raw[i + np.uint64(2)]) << 16 | wide(raw[i + np.uint64(3)]) << 24
        if is_float:
            sign = 1 << (8 * size - 1)
            number = (2 * sign - 1) - number if number & sign else number | sign
    return number


@inlined
def _write(number: int, raw: Uint8s, at: int, size: int, is_float: int) -> None:
    i = np.uint64(at)
    if is_float:
        sign = 1 << (8 * size - 1)
        number = number ^ sign if number & sign else (2 * sign - 1) - number
    raw[i] = number & 255
    if size > 1:
        raw[i + np.uint64(1)] = number >> 8 & 255
        if size > 2:
            raw[i + np.uint64(2)] = number >> 16 & 255
            raw[i + np.uint64(3)] = number >> 24


@inlined
def _error(number: int, guess: int, size: int, error: int) -> int:
    """Return what a guess is off by, in steps of 2 ``error`` + 1, as it is coded."""
    most = (1 << 8 * size) - 1
    half = most + 1 >> 1
    if error == 0:
        return wide((number - guess + half & most) - half)
    step = 2 * error + 1
    span = (most + 2 * error) // step + 1
    half = span >> 1
    off = number - min(max(guess, 0), most)
    off = (off + error) // step if off >= 0 else -((error - off) // step)
    if off < -half:
        off += span
    elif off >= span - half:
        off -= span
    return wide(off)


@inlined
def _corrected(guess: int, off: int, size: int, error: int) -> int:
    """Return the number that a guess is so many steps off from."""
    most = (1 << 8 * size) - 1
    if error == 0:
        return wide(guess + off & most)
    step = 2 * error + 1
    number = min(max(guess, 0), most) + off * step
    if number < -error:
        number += ((most + 2 * error) // step + 1) * step
    elif number > most + error:
        number -= ((most + 2 * error) // step + 1) * step
    return wide(min(max(number, 0), most))


@inlined
def _folded(off: int) -> int:
    """Return 0, 1, 2, 3 … for 0, −1, 1, −2 …."""
    return wide(off << 1 ^ off >> 63)


@inlined
def _unfolded(sign: int) -> int:
    return wide(sign >> 1 ^ -(sign & 1))


@inlined
def _code_folded(
    work: int, sign: int, size: int, context: int, pool: Pool, coder: Int64s, stream: Uint32s
) -> int:
    """Note or decode a folded error; return it."""
    if size == 1:
        return code_symbol(work, sign, context, pool, coder, stream)
    return _code_large(work, sign, context, pool, coder, stream)


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
    components = coding.order.size
    room = (
        np.empty(_RUN * components * _AROUND, np.int64),
        np.empty((_RUN, 5), np.int64),
        np.zeros((components, 8 * _RUN), np.int64),
        np.zeros((3, 8 * _RUN), np.int64),
        np.zeros(TERMS + 1, np.int64),
    )
    flat = given.reshape(-1), raw.reshape(-1)
    task = rows, cells, flat[0], flat[1], begin, coding, steps, squares, pool, coder, stream
    work, size, error, unit = coder[PASS], coding.size, coding.error, coding.unit
    # Bytes are read by code of their own, in which these are known.
    if size > 1 or error > 0 or unit > 0 or coding.by_cell:
        _code_runs(task, room, work, components, size, coding.is_float, error, unit, coding.by_cell)
    elif components == 1:
        _code_runs(task, room, work, 1, 1, 0, 0, 0, 0)
    elif components == 3:
        _code_runs(task, room, work, 3, 1, 0, 0, 0, 0)
    else:
        _code_runs(task, room, work, components, 1, 0, 0, 0, 0)


#: So many nodes are a run.
_RUN = 32
# What a run has of each node: its first child, how many it has, whether one of these is a node; 1 if the
# cells around have its value, 3 if its children have, too; which of the run's cells whose errors are coded is
# its first.
_FIRST, _COUNT, _KIND, _FLAT, _PLACE = 0, 1, 2, 3, 4
# And of each component of a node's cell: its value; the sum that guesses begin with; values of the cells
# around; the weights of these, if on a child's side, of the cells beside and of the children so far; where
# the weights stand; how much the cells around differ; where its contexts begin.
_VALUE, _SUM, _SIDES, _NEARER, _BESIDE, _SIBLINGS, _WEIGHTS, _MOST, _CONTEXTS = 0, 1, 2, 8, 9, 10, 11, 12, 13
_AROUND = 14
# And of its cells whose errors are coded: their node, by how much the components so far are off, the context
# of the component that is coded. Errors are folded.
_NODE, _NOISE, _CONTEXT = 0, 1, 2


@inlined
def _code_runs(
    task: Any,
    room: Any,
    work: int,
    components: int,
    size: int,
    is_float: int,
    error: int,
    unit: int,
    by_cell: int,
) -> None:
    """Code run after run: errors before the values that they correct, or after them."""
    rows = task[0]
    nodes = room[1]
    t, node = wide(0), wide(0)
    while t < rows.shape[0]:
        count = wide(0)
        while count < _RUN and t < rows.shape[0]:
            i = np.uint64(count)
            about = wide(rows[np.uint64(t), ABOUT])
            kind = about >> 8 & 1
            nodes[i, _FIRST], nodes[i, _COUNT], nodes[i, _KIND] = t, about >> 4 & 15, kind
            is_flat = wide(_look_around(task, room, count, node, kind, components, size, is_float, unit))
            if work == NOTES and is_flat:
                is_flat |= wide(_has_flat(task, room, count, components, size, is_float, error)) << 1
            nodes[i, _FLAT] = is_flat & -wide(work != MEASURES)
            t += about >> 4 & 15
            node += 1
            count += 1
        cells = _code_flat(task, room, count, work, components, size, error, unit, by_cell)
        if work == DECODES and not by_cell:
            _code_errors(task, room, cells, work, components, size, error, unit)
        for n in range(count):
            _guess_children(task, room, n, work, components, size, is_float, error, unit)
        if work == NOTES:
            _code_errors(task, room, cells, work, components, size, error, unit)


@inlined
def _look_around(
    task: Any, room: Any, n: int, node: int, kind: int, components: int, size: int, is_float: int, unit: int
) -> bool:
    """Write what is known around the run's node ``n``; return whether the cells around are as its own."""
    cells = task[1]
    i, row = np.uint64(node), components * size
    own = cells[i, OWN] * row
    sides = (
        *(cells[i, 0] * row, cells[i, 1] * row, cells[i, 2] * row),
        *(cells[i, 3] * row, cells[i, 4] * row, cells[i, 5] * row),
    )
    differ = _look_at(task, room, n, own, sides, kind, 0, components, size, is_float, unit)
    if components > 1:
        differ |= _look_at(task, room, n, own, sides, kind, 1, components, size, is_float, unit)
    if components > 2:
        differ |= _look_at(task, room, n, own, sides, kind, 2, components, size, is_float, unit)
    if components > 3:
        differ |= _look_at(task, room, n, own, sides, kind, 3, components, size, is_float, unit)
    return differ == 0


@inlined
def _look_at(
    task: Any,
    room: Any,
    n: int,
    own: int,
    sides: tuple[int, int, int, int, int, int],
    kind: int,
    j: int,
    components: int,
    size: int,
    is_float: int,
    unit: int,
) -> int:
    """Write what is known around in component ``j``; return how much the cells differ."""
    raw, weights, steps = task[3], task[5].weights, task[6]
    around = room[0]
    at, component = np.uint64(_AROUND * (components * n + j)), _component(j, components) * size
    value = _number(raw, own + component, size, is_float)
    a = _number(raw, sides[0] + component, size, is_float)
    b = _number(raw, sides[1] + component, size, is_float)
    c = _number(raw, sides[2] + component, size, is_float)
    d = _number(raw, sides[3] + component, size, is_float)
    e = _number(raw, sides[4] + component, size, is_float)
    f = _number(raw, sides[5] + component, size, is_float)
    differs = abs(a - value) + abs(b - value) + abs(c - value)
    differs += abs(d - value) + abs(e - value) + abs(f - value)
    most = min(differs >> unit + 1, 255)
    place = ((kind * components + j) * CLASSES + wide(steps[0][np.uint64(most)])) * TERMS
    far, beside = weights[np.uint64(place + 1)], weights[np.uint64(place + 2)]
    nearer, siblings = weights[np.uint64(place)] - far, weights[np.uint64(place + 3)]
    total = ((1 << WEIGHT_BITS) - 6 * far - 3 * (nearer + beside)) * value + (1 << WEIGHT_BITS - 1)
    around[at] = value
    around[at + np.uint64(_SUM)] = total + far * (a + b + c + d + e + f)
    around[at + np.uint64(_SIDES)], around[at + np.uint64(_SIDES + 1)] = a, b
    around[at + np.uint64(_SIDES + 2)], around[at + np.uint64(_SIDES + 3)] = c, d
    around[at + np.uint64(_SIDES + 4)], around[at + np.uint64(_SIDES + 5)] = e, f
    around[at + np.uint64(_NEARER)] = nearer
    around[at + np.uint64(_BESIDE)] = beside
    around[at + np.uint64(_SIBLINGS)] = siblings
    around[at + np.uint64(_WEIGHTS)] = place
    around[at + np.uint64(_MOST)] = most
    around[at + np.uint64(_CONTEXTS)] = (kind * components + j) * CONTEXTS
    return differs


@inlined
def _code_flat(
    task: Any,
    room: Any,
    count: int,
    work: int,
    components: int,
    size: int,
    error: int,
    unit: int,
    by_cell: int,
) -> int:
    """Note or decode which of a run's nodes are flat; list the children of the others, return their number.

    Decodes their errors, too, if these stand cell ``by_cell``.
    """
    steps, pool, coder, stream = task[6], task[8], task[9], task[10]
    around, nodes, errors, listed, _ = room
    place = wide(0)
    for n in range(count):
        i = np.uint64(n)
        nodes[i, _PLACE] = place
        if nodes[i, _FLAT]:
            context = SETS * components * CONTEXTS + nodes[i, _KIND]
            flat = code_symbol(work, nodes[i, _FLAT] >> 1, context, pool, coder, stream)
            nodes[i, _FLAT] = 1 | flat << 1
            if flat:
                continue
        node = components * _AROUND * n
        most = around[np.uint64(node + _MOST)]
        context = around[np.uint64(node + _CONTEXTS)] + wide(steps[1][np.uint64(most)])
        for _ in range(nodes[i, _COUNT]):
            at = np.uint64(place)
            listed[_NODE, at], listed[_NOISE, at], listed[_CONTEXT, at] = node, 0, context
            for j in range(components if by_cell else 0):
                about = node + _AROUND * j
                varies = min(around[np.uint64(about + _MOST)] + listed[_NOISE, at], 255)
                own = around[np.uint64(about + _CONTEXTS)] + wide(steps[1][np.uint64(varies)])
                sign = _code_folded(work, wide(0), size, own, pool, coder, stream)
                errors[j, at] = sign
                listed[_NOISE, at] += 2 * (sign + 1 >> 1) * (2 * error + 1) >> unit
            place += 1
    return place


@inlined
def _code_errors(
    task: Any, room: Any, count: int, work: int, components: int, size: int, error: int, unit: int
) -> None:
    """Note or decode the errors of the cells that are listed, a component after the other."""
    steps, pool, coder, stream = task[6], task[8], task[9], task[10]
    around, _, errors, listed, _ = room
    for j in range(components):
        if j:
            for n in range(count):
                i = np.uint64(n)
                about = listed[_NODE, i] + _AROUND * j
                listed[_NOISE, i] += 2 * (errors[j - 1, i] + 1 >> 1) * (2 * error + 1) >> unit
                varies = min(around[np.uint64(about + _MOST)] + listed[_NOISE, i], 255)
                context = around[np.uint64(about + _CONTEXTS)] + wide(steps[1][np.uint64(varies)])
                listed[_CONTEXT, i] = context
        if size == 1:
            code_symbols(work, errors[j], listed[_CONTEXT], count, pool, coder, stream)
        else:
            for n in range(count):
                i = np.uint64(n)
                sign, context = errors[j, i], listed[_CONTEXT, i]
                errors[j, i] = _code_folded(work, sign, size, context, pool, coder, stream)


@inlined
def _has_flat(task: Any, room: Any, n: int, components: int, size: int, is_float: int, error: int) -> bool:
    """Return whether a node's children are given as its cell is."""
    given, begin = task[2], task[4]
    around, nodes, _, _, _ = room
    i = np.uint64(n)
    for t in range(begin + nodes[i, _FIRST], begin + nodes[i, _FIRST] + nodes[i, _COUNT]):
        for j in range(components):
            number = _number(given, (t * components + _component(j, components)) * size, size, is_float)
            if abs(number - around[np.uint64(_AROUND * (components * n + j) + _VALUE)]) > error:
                return False
    return True


@inlined
def _guess_children(
    task: Any,
    room: Any,
    n: int,
    work: int,
    components: int,
    size: int,
    is_float: int,
    error: int,
    unit: int,
) -> None:
    """Guess the values of a node's children: write these by their errors, or the errors, or measure."""
    rows, raw, begin, steps = task[0], task[3], task[4], task[6]
    around, nodes = room[0], room[1]
    i = np.uint64(n)
    first, count = nodes[i, _FIRST], nodes[i, _COUNT]
    if nodes[i, _FLAT] == 3:
        if work == DECODES or error > 0:
            for t in range(begin + first, begin + first + count):
                for j in range(components):
                    number = around[np.uint64(_AROUND * (components * n + j) + _VALUE)]
                    _write(number, raw, (t * components + _component(j, components)) * size, size, is_float)
        return
    at = _AROUND * components * n
    sum_0 = sum_1 = sum_2 = sum_3 = wide(0)
    for t in range(first, first + count):
        part = steps[2][np.uint64(first + count - t)]
        row, each = np.uint64(t), components * size
        about = wide(rows[row, ABOUT])
        beside = wide(rows[row, 0]) * each, wide(rows[row, 1]) * each, wide(rows[row, 2]) * each
        sides = _SIDES + (about >> 9 & 1), _SIDES + 2 + (about >> 10 & 1), _SIDES + 4 + (about >> 11 & 1)
        child = (begin + t) * each, nodes[i, _PLACE] + t - first, at, beside, sides
        before = wide(0), wide(0), wide(0), wide(0), wide(0), wide(0)
        off_0, more_0 = _guess_child(
            task, room, work, child, 0, sum_0 * part >> 16, before, components, size, is_float, error, unit
        )
        sum_0 += more_0
        if components > 1:
            before = off_0, wide(0), wide(0), more_0, wide(0), wide(0)
            off_1, more_1 = _guess_child(
                task,
                room,
                work,
                child,
                1,
                sum_1 * part >> 16,
                before,
                components,
                size,
                is_float,
                error,
                unit,
            )
            sum_1 += more_1
            if components > 2:
                before = off_0, off_1, wide(0), more_0, more_1, wide(0)
                off_2, more_2 = _guess_child(
                    task,
                    room,
                    work,
                    child,
                    2,
                    sum_2 * part >> 16,
                    before,
                    components,
                    size,
                    is_float,
                    error,
                    unit,
                )
                sum_2 += more_2
                if components > 3:
                    before = off_0, off_1, off_2, more_0, more_1, more_2
                    _, more_3 = _guess_child(
                        task,
                        room,
                        work,
                        child,
                        3,
                        sum_3 * part >> 16,
                        before,
                        components,
                        size,
                        is_float,
                        error,
                        unit,
                    )
                    sum_3 += more_3


@inlined
def _guess_child(
    task: Any,
    room: Any,
    work: int,
    child: Any,
    j: int,
    mean: int,
    before: tuple[int, int, int, int, int, int],
    components: int,
    size: int,
    is_float: int,
    error: int,
    unit: int,
) -> tuple[int, int]:
    """Guess component ``j`` of a child; return the error, and what it has more than its parent."""
    given, raw, weights, squares = task[2], task[3], task[5].weights, task[7]
    around, _, errors, _, terms = room
    row, place, at, (beside_x, beside_y, beside_z), (x, y, z) = child
    component = _component(j, components) * size
    at += _AROUND * j
    beside = _number(raw, beside_x + component, size, is_float)
    beside += _number(raw, beside_y + component, size, is_float)
    beside += _number(raw, beside_z + component, size, is_float)
    near = around[np.uint64(at + x)] + around[np.uint64(at + y)] + around[np.uint64(at + z)]
    total = around[np.uint64(at + _SUM)] + around[np.uint64(at + _NEARER)] * near
    total += around[np.uint64(at + _BESIDE)] * beside
    if j > 0:
        own = around[np.uint64(at + _WEIGHTS)] + _ERRORS
        total += weights[np.uint64(own)] * before[0] + weights[np.uint64(own + 3)] * before[3]
        if j > 1:
            total += weights[np.uint64(own + 1)] * before[1] + weights[np.uint64(own + 4)] * before[4]
            if j > 2:
                total += weights[np.uint64(own + 2)] * before[2] + weights[np.uint64(own + 5)] * before[5]
    total += around[np.uint64(at + _SIBLINGS)] * mean
    guess = total >> WEIGHT_BITS
    value = around[np.uint64(at)]
    if work == MEASURES:
        number = _number(given, row + component, size, is_float)
        terms[0], terms[1] = near - 3 * value, -3 * value - near
        for k in range(6):
            terms[1] += around[at + _SIDES + k]
        terms[2], terms[3], terms[TERMS] = beside - 3 * value, mean, number - value
        for k in range(6):
            terms[4 + k] = before[k]
        off = number - guess
        _measure(terms, off, 2.0**-unit, squares, around[at + _WEIGHTS] // TERMS)
        return off, number - value
    off = _unfolded(errors[j, np.uint64(place)])
    if work == NOTES:
        off = _error(_number(given, row + component, size, is_float), guess, size, error)
        errors[j, np.uint64(place)] = _folded(off)
    number = _corrected(guess, off, size, error)
    if work == DECODES or error > 0:
        _write(number, raw, row + component, size, is_float)
    return off * (2 * error + 1), number - value


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
            own = _number(flat[0], at, size, is_float)
            at = ((first + n) * components + order[j]) * size
            guess = min(max(own + (shift if components >= 3 else 0), 0), (1 << 8 * size) - 1)
            varies = min((abs(before[j]) >> unit) + noise, 255)
            context = (kind * components + j) * CONTEXTS + wide(context_of[np.uint64(varies)])
            off = wide(0)
            if work == NOTES:
                off = _error(_number(flat[1], at, size, is_float), guess, size, error)
            off = _unfolded(_code_folded(work, _folded(off), size, context, pool, coder, stream))
            number = _corrected(guess, off, size, error)
            if work == DECODES or error > 0:
                _write(number, flat[2], at, size, is_float)
            before[j] = shift = number - own
            noise += 2 * abs(off) * (2 * error + 1) >> unit
