"""Values of channels, from those of the level above and those that came before.

A cell's value is guessed from its parent's: to that is added a weighted sum of how the cells across the
parent's faces on its own side, those on the other side, three cells beside the cell, and its siblings so far
differ from it, and of how far the components before it differ from their parents', and from their guesses.
The weights are fitted to the texture, for parents of leaves alone and for others, by how much the cells
around the parent vary. What the guess is off by is coded by how much it may be. Where the cells around the
parent are all as it is, one symbol says first whether its children are, too.

Nodes are taken in runs. By how much errors may be off is known without the guesses: so a component's errors
of a whole run are decoded at once, four states side by side, before the values that they correct.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from octex.archive.around import ABOUT, OWN
from octex.archive.coding import (
    CLASSES,
    CONTEXTS,
    SETS,
    TERMS,
    WEIGHT_BITS,
    Coding,
    code_folded,
    component_of,
    corrected,
    error_of,
    folded,
    number_at,
    unfolded,
    write_number,
)
from octex.archive.entropy import DECODES, MEASURES, NOTES, PASS, Pool, code_symbol, code_symbols, wide
from octex.archive.weights import measure
from octex.arrays import Float64s, Int64s, Uint8s, Uint32s
from octex.jit import inlined, kernel

_ERRORS = 4


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
    at, component = np.uint64(_AROUND * (components * n + j)), component_of(j, components) * size
    value = number_at(raw, own + component, size, is_float)
    a = number_at(raw, sides[0] + component, size, is_float)
    b = number_at(raw, sides[1] + component, size, is_float)
    c = number_at(raw, sides[2] + component, size, is_float)
    d = number_at(raw, sides[3] + component, size, is_float)
    e = number_at(raw, sides[4] + component, size, is_float)
    f = number_at(raw, sides[5] + component, size, is_float)
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
                sign = code_folded(work, wide(0), size, own, pool, coder, stream)
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
                errors[j, i] = code_folded(work, sign, size, context, pool, coder, stream)


@inlined
def _has_flat(task: Any, room: Any, n: int, components: int, size: int, is_float: int, error: int) -> bool:
    """Return whether a node's children are given as its cell is."""
    given, begin = task[2], task[4]
    around, nodes, _, _, _ = room
    i = np.uint64(n)
    for t in range(begin + nodes[i, _FIRST], begin + nodes[i, _FIRST] + nodes[i, _COUNT]):
        for j in range(components):
            number = number_at(given, (t * components + component_of(j, components)) * size, size, is_float)
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
                    place = (t * components + component_of(j, components)) * size
                    write_number(number, raw, place, size, is_float)
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
    component = component_of(j, components) * size
    at += _AROUND * j
    beside = number_at(raw, beside_x + component, size, is_float)
    beside += number_at(raw, beside_y + component, size, is_float)
    beside += number_at(raw, beside_z + component, size, is_float)
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
        number = number_at(given, row + component, size, is_float)
        terms[0], terms[1] = near - 3 * value, -3 * value - near
        for k in range(6):
            terms[1] += around[at + _SIDES + k]
        terms[2], terms[3], terms[TERMS] = beside - 3 * value, mean, number - value
        for k in range(6):
            terms[4 + k] = before[k]
        off = number - guess
        measure(terms, off, 2.0**-unit, squares, around[at + _WEIGHTS] // TERMS)
        return off, number - value
    off = unfolded(errors[j, np.uint64(place)])
    if work == NOTES:
        off = error_of(number_at(given, row + component, size, is_float), guess, size, error)
        errors[j, np.uint64(place)] = folded(off)
    number = corrected(guess, off, size, error)
    if work == DECODES or error > 0:
        write_number(number, raw, row + component, size, is_float)
    return off * (2 * error + 1), number - value
