"""Values of channels, from those of the level above and those that came before.

A cell's value is guessed from its parent's: to that is added a weighted sum of how the cells across the
parent's faces on its own side, those on the other side, three cells beside the cell, and its siblings so far
differ from it, and of how far the components before it differ from their parents', and from their guesses.
The weights are fitted to the texture, for parents of leaves alone and for others, by how much the cells
around the parent vary. What the guess is off by is coded by how much it may be. Where the cells around the
parent are all as it is, one symbol says first whether its children are, too.

Nodes are taken in runs. By how much errors may be off is known without the guesses: so a component's errors
of a whole run are decoded at once, four states side by side, before the values that they correct.

Rows of split cells and kept nodes are guessed from their cells' own values.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octex.archive.around import ABOUT, OWN
from octex.archive.coding import (
    CLASSES,
    CONTEXTS,
    SETS,
    TERMS,
    WEIGHT_BITS,
    Coding,
    Form,
    code_folded,
    component_of,
    corrected,
    error_of,
    folded,
    number_at,
    unfolded,
    write_number,
)
from octex.archive.entropy import DECODES, MEASURES, NOTES, PASS, Coder, Pool, code_symbol, code_symbols, wide
from octex.archive.weights import measure
from octex.arrays import Float64s, Int64s, Uint8s, Uint32s
from octex.jit import inlined, kernel

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
# And of a child, by component: by how much it is off, what it has more than its parent; the sum of what its
# siblings so far have more.
_OFF, _MORE, _SUMS = 0, 1, 2
#: Of a guess's terms, the first that weighs how a component before was off, and what it has more.
_OFFS, _MORES = 4, 7


class _Task(NamedTuple):
    """What is coded; see `code_values`."""

    rows: Uint32s
    cells: Int64s
    given: Uint8s
    raw: Uint8s
    begin: int
    weights: Int64s
    steps: tuple[Uint8s, Uint8s, Int64s]
    squares: Float64s
    pool: Pool
    coder: Coder


class _Room(NamedTuple):
    """What a run's nodes have by component, and as a whole; its cells' errors, and their contexts."""

    around: Int64s
    nodes: Int64s
    errors: Int64s
    listed: Int64s
    terms: Int64s
    own: Int64s


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
    coder: Coder,
) -> None:
    """Note, decode or measure the values of cells from ``begin`` on.

    ``rows`` and ``cells`` are what lies around them. Bytes ``given`` (cells, components, size) are what is
    noted; ``raw`` is what will be decoded, written unless they are one. ``steps`` are STEPS.
    """
    form = coding.form
    room = _Room(
        np.empty(_RUN * form.components * _AROUND, np.int64),
        np.empty((_RUN, 5), np.int64),
        np.zeros((form.components, 8 * _RUN), np.int64),
        np.zeros((3, 8 * _RUN), np.int64),
        np.zeros(TERMS + 1, np.int64),
        np.zeros((3, 4), np.int64),
    )
    flat = given.reshape(-1), raw.reshape(-1)
    task = _Task(rows, cells, flat[0], flat[1], begin, coding.weights, steps, squares, pool, coder)
    # Bytes are read by code of their own, in which these are known.
    is_plain = form.size == 1 and form.error == 0 and form.unit == 0
    if is_plain and form.components == 3:
        _code_runs(task, room, Form(3, 1, 0, 0, 0))
    elif is_plain and form.components == 1:
        _code_runs(task, room, Form(1, 1, 0, 0, 0))
    else:
        _code_runs(task, room, form)


@inlined
def _code_runs(task: _Task, room: _Room, form: Form) -> None:
    """Code run after run: errors before the values that they correct, or after them."""
    rows, work, nodes = task.rows, task.coder.state[PASS], room.nodes
    t, node = wide(0), wide(0)
    while t < rows.shape[0]:
        count = wide(0)
        while count < _RUN and t < rows.shape[0]:
            i = np.uint64(count)
            about = wide(rows[np.uint64(t), ABOUT])
            nodes[i, _FIRST], nodes[i, _COUNT], nodes[i, _KIND] = t, about & 15, about >> 4 & 1
            differ = wide(0)
            for j in range(form.components):
                differ |= _look_around(task, room, count, node, j, form)
            is_flat = wide(differ == 0) & -wide(work != MEASURES)
            if work == NOTES and is_flat:
                is_flat |= wide(_has_flat(task, room, count, form)) << 1
            nodes[i, _FLAT] = is_flat
            t += about & 15
            node += 1
            count += 1
        cells = _code_flat(task, room, count, form)
        if work == DECODES:
            _code_errors(task, room, cells, form)
        for n in range(count):
            if nodes[np.uint64(n), _FLAT] == 3:
                _copy_children(task, room, n, form)
            else:
                _guess_children(task, room, n, form)
        if work == NOTES:
            _code_errors(task, room, cells, form)


@inlined
def _look_around(task: _Task, room: _Room, n: int, node: int, j: int, form: Form) -> int:
    """Write what is known around the run's node ``n`` in a component; return how much the cells differ."""
    cells, raw, weights, steps, around = task.cells, task.raw, task.weights, task.steps, room.around
    i, row, component = np.uint64(node), form.components * form.size, component_of(j, form) * form.size
    at = np.uint64(_AROUND * (form.components * n + j))
    value = number_at(raw, cells[i, OWN] * row + component, form)
    total, differs = wide(0), wide(0)
    for k in range(6):
        side = number_at(raw, cells[i, np.uint64(k)] * row + component, form)
        around[at + np.uint64(_SIDES + k)] = side
        differs += abs(side - value)
        total += side
    kind = room.nodes[np.uint64(n), _KIND]
    most = min(differs >> form.unit + 1, 255)
    place = ((kind * form.components + j) * CLASSES + wide(steps[0][np.uint64(most)])) * TERMS
    far, beside = weights[np.uint64(place + 1)], weights[np.uint64(place + 2)]
    nearer = weights[np.uint64(place)] - far
    begin = ((1 << WEIGHT_BITS) - 6 * far - 3 * (nearer + beside)) * value + (1 << WEIGHT_BITS - 1)
    around[at] = value
    around[at + np.uint64(_SUM)] = begin + far * total
    around[at + np.uint64(_NEARER)] = nearer
    around[at + np.uint64(_BESIDE)] = beside
    around[at + np.uint64(_SIBLINGS)] = weights[np.uint64(place + 3)]
    around[at + np.uint64(_WEIGHTS)] = place
    around[at + np.uint64(_MOST)] = most
    around[at + np.uint64(_CONTEXTS)] = (kind * form.components + j) * CONTEXTS
    return differs


@inlined
def _code_flat(task: _Task, room: _Room, count: int, form: Form) -> int:
    """Note or decode which of a run's nodes are flat; list and count the children of the others."""
    steps, pool, coder = task.steps, task.pool, task.coder
    around, nodes, listed = room.around, room.nodes, room.listed
    place = wide(0)
    for n in range(count):
        i = np.uint64(n)
        nodes[i, _PLACE] = place
        if nodes[i, _FLAT]:
            context = SETS * form.components * CONTEXTS + nodes[i, _KIND]
            flat = code_symbol(coder.state[PASS], nodes[i, _FLAT] >> 1, context, pool, coder)
            nodes[i, _FLAT] = 1 | flat << 1
            if flat:
                continue
        node = form.components * _AROUND * n
        most = around[np.uint64(node + _MOST)]
        context = around[np.uint64(node + _CONTEXTS)] + wide(steps[1][np.uint64(most)])
        for _ in range(nodes[i, _COUNT]):
            at = np.uint64(place)
            listed[_NODE, at], listed[_NOISE, at], listed[_CONTEXT, at] = node, 0, context
            place += 1
    return place


@inlined
def _code_errors(task: _Task, room: _Room, count: int, form: Form) -> None:
    """Note or decode the errors of the cells that are listed, a component after the other."""
    steps, pool, coder = task.steps, task.pool, task.coder
    around, errors, listed = room.around, room.errors, room.listed
    for j in range(form.components):
        if j:
            for n in range(count):
                i = np.uint64(n)
                about = listed[_NODE, i] + _AROUND * j
                listed[_NOISE, i] += 2 * (errors[j - 1, i] + 1 >> 1) * (2 * form.error + 1) >> form.unit
                varies = min(around[np.uint64(about + _MOST)] + listed[_NOISE, i], 255)
                context = around[np.uint64(about + _CONTEXTS)] + wide(steps[1][np.uint64(varies)])
                listed[_CONTEXT, i] = context
        if form.size == 1:
            code_symbols(coder.state[PASS], errors[j], listed[_CONTEXT], count, pool, coder)
        else:
            for n in range(count):
                i = np.uint64(n)
                sign, context = errors[j, i], listed[_CONTEXT, i]
                errors[j, i] = code_folded(coder.state[PASS], sign, form, context, pool, coder)


@inlined
def _has_flat(task: _Task, room: _Room, n: int, form: Form) -> bool:
    """Return whether a node's children are given as its cell is."""
    given, begin, around, nodes = task.given, task.begin, room.around, room.nodes
    i = np.uint64(n)
    for t in range(begin + nodes[i, _FIRST], begin + nodes[i, _FIRST] + nodes[i, _COUNT]):
        for j in range(form.components):
            number = number_at(given, (t * form.components + component_of(j, form)) * form.size, form)
            if abs(number - around[np.uint64(_AROUND * (form.components * n + j))]) > form.error:
                return False
    return True


@inlined
def _copy_children(task: _Task, room: _Room, n: int, form: Form) -> None:
    """Write a node's value as its children's."""
    raw, begin, around, nodes = task.raw, task.begin, room.around, room.nodes
    if task.coder.state[PASS] == DECODES or form.error > 0:
        i = np.uint64(n)
        for t in range(begin + nodes[i, _FIRST], begin + nodes[i, _FIRST] + nodes[i, _COUNT]):
            for j in range(form.components):
                number = around[np.uint64(_AROUND * (form.components * n + j))]
                write_number(number, raw, (t * form.components + component_of(j, form)) * form.size, form)


@inlined
def _guess_children(task: _Task, room: _Room, n: int, form: Form) -> None:
    """Guess the values of a node's children: write these by their errors, or the errors, or measure."""
    rows, begin, steps, nodes, own = task.rows, task.begin, task.steps, room.nodes, room.own
    i = np.uint64(n)
    first, count, place = nodes[i, _FIRST], nodes[i, _COUNT], nodes[i, _PLACE]
    for j in range(form.components):
        own[_SUMS, j] = 0
    for t in range(first, first + count):
        part = steps[2][np.uint64(first + count - t)]
        row, each = np.uint64(t), form.components * form.size
        about = wide(rows[row, ABOUT])
        beside = wide(rows[row, 0]) * each, wide(rows[row, 1]) * each, wide(rows[row, 2]) * each
        sides = _SIDES + (about >> 5 & 1), _SIDES + 2 + (about >> 6 & 1), _SIDES + 4 + (about >> 7 & 1)
        child = (begin + t) * each, place + t - first, form.components * _AROUND * n, beside, sides
        # Each component has code of its own, in which its number is known.
        _guess_child(task, room, child, 0, part, form)
        if form.components > 1:
            _guess_child(task, room, child, 1, part, form)
        if form.components > 2:
            _guess_child(task, room, child, 2, part, form)
        if form.components > 3:
            _guess_child(task, room, child, 3, part, form)


@inlined
def _guess_child(task: _Task, room: _Room, child: Any, j: int, part: int, form: Form) -> None:
    """Guess component ``j`` of a child; note the error, and what it has more than its parent."""
    given, raw, weights, work = task.given, task.raw, task.weights, task.coder.state[PASS]
    around, errors, terms, own = room.around, room.errors, room.terms, room.own
    row, place, at, (beside_x, beside_y, beside_z), (x, y, z) = child
    mean = own[_SUMS, j] * part >> 16
    component = component_of(j, form) * form.size
    at += _AROUND * j
    beside = number_at(raw, beside_x + component, form)
    beside += number_at(raw, beside_y + component, form)
    beside += number_at(raw, beside_z + component, form)
    near = around[np.uint64(at + x)] + around[np.uint64(at + y)] + around[np.uint64(at + z)]
    total = around[np.uint64(at + _SUM)] + around[np.uint64(at + _NEARER)] * near
    total += around[np.uint64(at + _BESIDE)] * beside + around[np.uint64(at + _SIBLINGS)] * mean
    place_of_weights = around[np.uint64(at + _WEIGHTS)]
    for k in range(min(j, 3)):
        total += weights[np.uint64(place_of_weights + _OFFS + k)] * own[_OFF, k]
        total += weights[np.uint64(place_of_weights + _MORES + k)] * own[_MORE, k]
    guess = total >> WEIGHT_BITS
    value = around[np.uint64(at)]
    if work == MEASURES:
        number = number_at(given, row + component, form)
        terms[:] = 0
        terms[0], terms[1] = near - 3 * value, -3 * value - near
        for k in range(6):
            terms[1] += around[at + _SIDES + k]
        terms[2], terms[3], terms[TERMS] = beside - 3 * value, mean, number - value
        for k in range(min(j, 3)):
            terms[_OFFS + k], terms[_MORES + k] = own[_OFF, k], own[_MORE, k]
        off = number - guess
        measure(terms, off, 2.0**-form.unit, task.squares, place_of_weights // TERMS)
        own[_OFF, j], own[_MORE, j] = off, number - value
        own[_SUMS, j] += number - value
        return
    i = np.uint64(place)
    off = unfolded(errors[j, i])
    if work == NOTES:
        off = error_of(number_at(given, row + component, form), guess, form)
        errors[j, i] = folded(off)
    number = corrected(guess, off, form)
    if work == DECODES or form.error > 0:
        write_number(number, raw, row + component, form)
    own[_OFF, j], own[_MORE, j] = off * (2 * form.error + 1), number - value
    own[_SUMS, j] += number - value


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
    coder: Coder,
) -> None:
    """Note or decode the values of rows from ``first`` on, a row of each cell of ``owners``."""
    form, work = coding.form, coder.state[PASS]
    cell_flat, given_flat, flat = cell_raw.reshape(-1), given.reshape(-1), raw.reshape(-1)
    before = np.zeros(4, np.int64)
    for n in range(owners.size):
        if n == 0 or owners[n] != owners[n - 1]:
            before[:] = 0
        noise = shift = wide(0)
        for j in range(form.components):
            component = component_of(j, form) * form.size
            at = wide(owners[n]) * form.components * form.size + component
            own = number_at(cell_flat, at, form)
            at = (first + n) * form.components * form.size + component
            guess = min(max(own + (shift if form.components >= 3 else 0), 0), (1 << 8 * form.size) - 1)
            varies = min((abs(before[j]) >> form.unit) + noise, 255)
            context = (kind * form.components + j) * CONTEXTS + wide(steps[1][np.uint64(varies)])
            off = wide(0)
            if work == NOTES:
                off = error_of(number_at(given_flat, at, form), guess, form)
            off = unfolded(code_folded(work, folded(off), form, context, pool, coder))
            number = corrected(guess, off, form)
            if work == DECODES or form.error > 0:
                write_number(number, flat, at, form)
            before[j] = shift = number - own
            noise += 2 * abs(off) * (2 * form.error + 1) >> form.unit
