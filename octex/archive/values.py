"""Codes the values of channels and the areas of cells, from the level above and from values before.

A cell's value is predicted from its parent's, plus a weighted sum of differences from it: of the cells across
the parent's faces on the cell's side, of those on the other side, of three cells next to it, and of its
siblings so far; and of the components before it, from their parents' and from their predictions. Weights
differ for parents of leaves alone, and by the variance around the parent. They follow the sign of the errors,
first over a sample of the texture, then in each block.

Where all cells around equal the parent, a bit tells first whether its children do, too.

Rows of split cells and kept nodes are predicted from their cells' values.

The areas of a node's children add up to its area. A surface that faces one axis has the same area over each
face of the lattice along that axis: the sum of the cells in a column. So a cell alone in its column has the
area of one next to it, and a cell above another has the rest of the column. The rest of the node's area, and
the cells around, predict other areas.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.archive.entropy import DECODES, Coder, code_bit, code_number, code_token, wide
from octex.archive.layout import CLASSES, TERMS, WEIGHT_BITS, Form
from octex.archive.structure import ABOUT, OWN
from octex.arrays import Int32s, Int64s, Uint8s, Uint32s
from octex.jit import inlined, kernel, popcount
from octex.tree.layout import AREA_ONE, AREA_STEPS, FACING_FLAGS, TreeArrays

#: Contexts for the variance of the cells around, in steps of the channel's unit.
_CONTEXTS = 11
#: Sets of these: leaves, nodes, rows of split cells, kept nodes; and where those of each table begin.
_SETS = 4
CELLS, SPLIT_ROWS, KEPT_NODES = 0, 2, 3
_MOST_TERM = 1 << 12

#: The class, and the context, of how much differences vary, 0 … 255.
_CLASS_OF = np.searchsorted([1, 4, 16, 48], np.arange(256), side="right").astype(np.uint8)
_CONTEXT_OF = np.searchsorted([1, 2, 3, 6, 10, 16, 24, 36, 52, 80], np.arange(256), side="right").astype(
    np.uint8
)
#: 2¹⁶ / n for n from 1 to 8.
_PART_OF = np.array([0, *(65536 // n for n in range(1, 9))], np.int64)
#: By how many bits terms are shifted before they are added to the weights of a class.
_SHIFTS = np.array([9, 8, 7, 5, 3], np.int64)


def extent(form: Form, rows: int) -> tuple[tuple[int, int], int]:
    """Return the numbers of contexts of symbols and bits of values, and the most notes for ``rows``."""
    contexts = _SETS * form.components * _CONTEXTS, 4
    return contexts, rows * (form.components * (1 if form.size == 1 else 9) + 1)


def numbers_of(raw: Uint8s, form: Form) -> Int64s:
    """Return values (n, components, size) as whole numbers (n, components), green first."""
    numbers = raw.view(f"<u{form.size}")[:, _order(form), 0].astype(np.int64, order="C")
    sign = 1 << (8 * form.size - 1)
    return np.where(numbers & sign, 2 * sign - 1 - numbers, numbers | sign) if form.is_float else numbers


def write_numbers(numbers: Uint32s, raw: Uint8s, form: Form) -> None:
    """Write values (n, components, size) from whole numbers."""
    sign = 1 << (8 * form.size - 1)
    if form.is_float:
        numbers = np.where(numbers & sign, numbers ^ sign, 2 * sign - 1 - numbers)
    for column, j in enumerate(_order(form)):
        raw.view(f"<u{form.size}")[:, j, 0] = numbers[:, column]


def _order(form: Form) -> list[int]:
    return [1, 0, 2, 3][: form.components] if form.components > 2 else list(range(form.components))


@inlined
def _number_at(raw: Uint8s, cell: int, j: int, form: Form) -> int:
    """Return a cell's value, of the component coded as the j-th, as a whole number."""
    component = 1 - j if form.components >= 3 and j < 2 else j
    i = np.uint64((cell * form.components + component) * form.size)
    number = wide(raw[i])
    if form.size > 1:
        number |= wide(raw[i + np.uint64(1)]) << 8
        if form.size > 2:
            number |= wide(raw[i + np.uint64(2)]) << 16 | wide(raw[i + np.uint64(3)]) << 24
        if form.is_float:
            sign = 1 << (8 * form.size - 1)
            number = (2 * sign - 1) - number if number & sign else number | sign
    return number


@inlined
def _coded(number: int, guess: int, context: int, form: Form, coder: Coder) -> tuple[int, int, int]:
    """Code a predicted number; return it, its error, and about twice that."""
    most, step = (1 << 8 * form.size) - 1, 2 * form.error + 1
    guess = min(max(guess, 0), most)
    steps = (most + 2 * form.error) // step + 1
    off, half = wide(0), steps >> 1
    if coder.work != DECODES:
        if form.error == 0:
            off = (number - guess + half & most) - half
        else:
            off = (number - guess + form.error) // step
            off = off + steps if off < -half else off - steps if off >= steps - half else off
    unit, is_byte = form.unit + 4 * (form.size > 1), form.size == 1
    sign, about = code_number(off << 1 ^ off >> 63, unit, is_byte, context, coder)  # 0, −1, 1, −2 … from 0 on
    if coder.work == DECODES:  # else known: later steps need not wait
        off = wide(sign >> 1 ^ -(sign & 1))
    noise = (about + 1 & -2) * step >> form.unit
    number = guess + off * step
    if form.error == 0:
        return number & most, off, noise
    if number < -form.error:
        number += steps * step
    elif number > most + form.error:
        number -= steps * step
    return min(max(number, 0), most), off * step, noise


class _Room(NamedTuple):
    """State of a node, by component, and of a child."""

    numbers: Uint32s  # of all cells by component; at the end the node's, for missing cells
    sides: Int64s  # (components · 6,)   differences of the cells around from the node's
    values: Int64s  # of the node's cell
    total: Int64s  # of ``sides``
    sums: Int64s  # differences of the children so far
    most: Int64s  # variance of the cells around
    off: Int64s  # errors of a child's predictions
    more: Int64s  # its differences from the node's
    at: Int64s  # index of the node's weights
    shifts: Int64s  # bits by which terms are shifted before they are added to these
    contexts: Int64s  # its first contexts
    terms: Int64s
    places: Int64s  # of a child's sides, and of the neighbours, by axis
    weights: Int64s


@kernel
def code_values(
    rows: Int32s, around: Uint32s, raw: Uint8s, numbers: Uint32s, form: Form, weights: Int64s, coder: Coder
) -> None:
    """Code the values of a block's cells, with their neighbours ``rows`` and ``around``.

    ``raw`` are the bytes of the levels above. ``numbers`` (cells + 1, components) are coded, and written as
    they will be read; the last row is scratch. ``weights`` follow the errors.
    """
    part = np.zeros((9, 4), np.int64)
    places, terms, sides = np.zeros(6, np.int64), np.zeros(TERMS, np.int64), np.zeros(24, np.int64)
    vectors = part[0], part[1], part[2], part[3], part[4], part[5], part[6], part[7], part[8]
    room = _Room(numbers.reshape(-1), sides, *vectors, terms, places, weights)
    # Code for bytes has these as constants.
    is_plain = form.size == 1 and form.error == 0 and form.unit == 0
    if is_plain and form.components == 3:
        _code_values(rows, around, raw, Form(3, 1, 0, 0, 0), room, coder)
    elif is_plain and form.components == 1:
        _code_values(rows, around, raw, Form(1, 1, 0, 0, 0), room, coder)
    else:
        _code_values(rows, around, raw, form, room, coder)


@inlined
def _code_values(rows: Int32s, around: Uint32s, raw: Uint8s, form: Form, room: _Room, coder: Coder) -> None:
    node, remaining, flat, was_flat = wide(-1), wide(1), wide(0), wide(0)
    for t in range(np.uint64(rows.shape[0])):
        about = wide(rows[t, ABOUT])
        if remaining == 1:
            node += 1
            node_row = around[np.uint64(node)]
            flat = _begin_node(wide(t), about, node_row, was_flat, raw, form, room, coder)
            was_flat = was_flat if flat < 0 else flat
        remaining = about & 15
        if flat > 0:
            for j in range(form.components):
                room.numbers[np.uint64(wide(t) * form.components + j)] = np.uint32(room.values[j])
            continue
        part = _PART_OF[np.uint64(remaining)]
        spare = wide(rows.shape[0])  # the row of the node's values, for missing cells
        for axis in range(3):
            other = wide(rows[t, np.uint64(axis)])
            room.places[axis] = 2 * axis + (about >> 5 + axis & 1)
            room.places[3 + axis] = (other if other >= 0 else spare) * form.components
        # Code for each component has its number as a constant.
        noise = _code_component(wide(t), 0, part, 0, form, room, coder)
        if form.components > 1:
            noise = _code_component(wide(t), 1, part, noise, form, room, coder)
        if form.components > 2:
            noise = _code_component(wide(t), 2, part, noise, form, room, coder)
        if form.components > 3:
            noise = _code_component(wide(t), 3, part, noise, form, room, coder)


@inlined
def _begin_node(
    t: int, about: int, around: Uint32s, was_flat: int, raw: Uint8s, form: Form, room: _Room, coder: Coder
) -> int:
    """Read a node's neighbours; return whether its children equal them, −1 if the neighbours differ."""
    differ, numbers = wide(0), room.numbers
    for j in range(form.components):
        value, total, sum_ = _number_at(raw, wide(around[OWN]), j, form), wide(0), wide(0)
        for k in range(6):
            side = _number_at(raw, wide(around[np.uint64(k)]), j, form) - value
            differ |= side
            total += abs(side)
            side = _term(side, form)
            sum_ += side
            room.sides[np.uint64(6 * j + k)] = side
        index = np.uint64(j)
        room.values[index], room.sums[index], room.total[index] = value, 0, sum_
        numbers[np.uint64(numbers.size - form.components + j)] = np.uint32(value)
        most = min(total >> form.unit + 1, 255)
        class_ = np.uint64(_CLASS_OF[np.uint64(most)])
        kind = (about >> 4 & 1) * form.components + j
        room.most[index], room.contexts[index] = most, kind * _CONTEXTS
        room.at[index], room.shifts[index] = (kind * CLASSES + wide(class_)) * TERMS, _SHIFTS[class_]
    if differ != 0:
        return wide(-1)
    is_flat = wide(1)
    for n in range(t, t + (about & 15)):
        for j in range(form.components):
            number = wide(numbers[np.uint64(n * form.components + j)])
            is_flat &= wide(abs(number - room.values[np.uint64(j)]) <= form.error)
    return code_bit(is_flat, 2 * (about >> 4 & 1) + was_flat, coder)


@inlined
def _term(difference: int, form: Form) -> int:
    """Return a difference in the channel's unit, which bounds the weights."""
    if form.size == 1:
        return difference
    return wide(min(max(difference >> form.unit, -_MOST_TERM), _MOST_TERM))


@inlined
def _code_component(t: int, j: int, part: int, noise: int, form: Form, room: _Room, coder: Coder) -> int:
    """Code component ``j`` of a child; return how much the components so far were off."""
    components, index = form.components, np.uint64(j)
    terms, weights, numbers, value = room.terms, room.weights, room.numbers, room.values[index]
    same_side, next_to = wide(0), -3 * value
    for axis in range(3):
        same_side += room.sides[np.uint64(6 * j) + np.uint64(room.places[axis])]
        next_to += wide(numbers[np.uint64(j) + np.uint64(room.places[3 + axis])])
    mean = _term(room.sums[index], form) * part >> 16
    first_weight = np.uint64(room.at[index])
    terms[0], terms[1], terms[2], terms[3] = same_side, room.total[index], _term(next_to, form), mean
    for k in range(min(j, 3)):
        terms[4 + 2 * k], terms[5 + 2 * k] = _term(room.off[k], form), _term(room.more[k], form)
    count, total = np.uint64(4 + 2 * min(j, 3)), wide(1 << WEIGHT_BITS - 1)
    for k in range(count):
        total += weights[first_weight + k] * terms[k]
    context = room.contexts[index] + wide(_CONTEXT_OF[np.uint64(min(room.most[index] + noise, 255))])
    at = np.uint64(t * components + j)
    guess = value + (total >> WEIGHT_BITS << form.unit)
    number, off, noise_here = _coded(wide(numbers[at]), guess, context, form, coder)
    numbers[at] = np.uint32(number)
    if j + 1 < components:
        room.off[index], room.more[index] = off, number - value
    room.sums[index] += number - value
    if t & 3 == 0:  # for a quarter of the cells, to save time
        move = (wide(off > 0) - wide(off < 0)) << room.shifts[index]
        for k in range(count):
            weights[first_weight + k] += move * terms[k]
    return noise + noise_here


@kernel
def code_rows(
    owners: Uint32s, cell_numbers: Int64s, numbers: Uint32s, kind: int, form: Form, coder: Coder
) -> None:
    """Code numbers of rows, one for each cell of ``owners``, predicted from ``cell_numbers``."""
    before = np.zeros(4, np.int64)
    for n in range(owners.size):
        if n == 0 or owners[n] != owners[n - 1]:
            before[:] = 0
        noise = shift = wide(0)
        for j in range(form.components):
            guess = cell_numbers[n, j] + (shift if form.components >= 3 else 0)
            varies = min((abs(before[j]) >> form.unit) + noise, 255)
            context = (kind * form.components + j) * _CONTEXTS + wide(_CONTEXT_OF[varies])
            number, _, noise_here = _coded(wide(numbers[n, j]), guess, context, form, coder)
            numbers[n, j] = np.uint32(number)
            before[j] = shift = number - cell_numbers[n, j]
            noise += noise_here


_PARTS = 6
#: Contexts: 21 of the cells around, 3 of the number of remaining children, 4 each of the largest neighbouring
#: area and of that along the axis, parts of the remaining area; then those of split rows.
_SHAPES = 21 * 3 * 4 * 4 + 3
AREA_CONTEXTS = _SHAPES * _PARTS, 0
_BITS = 30  # of an area of one
#: Limits of the parts, in steps below the whole area.
_STEPS = 4, 9, 17, 25, 36
_NO_AXIS = 20
#: 2³⁰ times the areas of codes, as integers.
_AREAS = np.rint(np.exp2((np.arange(256) - AREA_ONE) / AREA_STEPS + _BITS)).astype(np.int64)
_AREAS[0] = 0
#: Steps of an octave, by the eight bits below the highest.
_STEPS_OF = np.floor(AREA_STEPS * np.log2(1 + (np.arange(256) + 0.5) / 256)).astype(np.uint8)
#: The axis of a cell's facings, 3 for several.
_AXIS_OF = np.full(FACING_FLAGS + 1, 3, np.uint8)
_AXIS_OF[1 << np.arange(6)] = np.arange(6) >> 1
#: Tokens of differences: 8 minus or plus 0, 1, 2, then the number of bits plus 1; the last has 7. The bits of
#: each, and the least difference.
_TOKEN_OF = np.searchsorted([1, 2, 3, 5, 9, 17, 33, 65], np.arange(256), side="right").astype(np.uint8)
_BITS_OF = np.array([6, 5, 4, 3, 2, 1, 0, 0, 0, 0, 0, 1, 2, 3, 4, 7])
_LEAST_OF = np.array([65, 33, 17, 9, 5, 3, 2, 1, 0, 1, 2, 3, 5, 9, 17, 33])


@inlined
def _code(area: int) -> int:
    """Return the code of the largest area up to ``area``, below 2⁵²."""
    bits = wide(np.float64(area).view(np.int64))
    code = AREA_ONE + AREA_STEPS * ((bits >> 52) - 1023 - _BITS) + wide(_STEPS_OF[bits >> 44 & 255]) - 1
    code = min(max(code, 0), 253)
    # Areas ascend: neither waits for the other.
    return code + wide(_AREAS[np.uint64(code + 1)] <= area) + wide(_AREAS[np.uint64(code + 2)] <= area)


@inlined
def _code_area(area: int, guess: int, whole: int, rest: int, shape: int, coder: Coder) -> int:
    """Code an area as part of a whole; return it. A ``guess`` below 0 stands for all of the rest."""
    rest, part = max(rest, _AREAS[np.uint64(whole)] >> 8), wide(0)
    for step in _STEPS:
        part += wide(rest >= _AREAS[np.uint64(max(whole + 1 - step, 0))])
    if guess < 0:
        guess = _code(rest)
    difference = (area - guess + 128 & 255) - 128
    size = abs(difference)
    token = wide(_TOKEN_OF[np.uint64(size)])
    token = 8 - token if difference < 0 else min(8 + token, 15)
    plain = size - _LEAST_OF[np.uint64(token)]
    token, plain = code_token(token, plain, _BITS_OF, shape * _PARTS + part, coder)
    difference = wide(_LEAST_OF[np.uint64(token)] + plain)
    return guess + (-difference if token < 8 else difference) & 255


@inlined
def _size(area: int, whole: int) -> int:
    """Return one of four sizes of an area."""
    return wide(area > 0) * (1 + wide(whole - area >= 8) + wide(whole - area >= 16))


@kernel
def code_areas(arrays: TreeArrays, begin: int, rows: Int32s, around: Uint32s, coder: Coder) -> None:
    """Code the areas of cells from ``begin`` on, with their neighbours ``rows`` and ``around``."""
    flags, areas = arrays.flags, arrays.areas
    rest = whole = wide(0)
    remaining, node = 1, -1
    side_areas = np.zeros(3, np.int64)
    for t in range(rows.shape[0]):
        if remaining == 1:
            node += 1
            # A child's face is a quarter of its parent's: two octaves.
            whole = min(wide(areas[around[node, OWN]]) + 2 * AREA_STEPS, 255)
            rest = _AREAS[whole]
        about = wide(rows[np.uint64(t), ABOUT])
        remaining = about & 15
        for k in range(3):
            other = wide(rows[np.uint64(t), k])
            # Random: no branch.
            is_there = -wide(other >= 0)
            side_areas[k] = wide(areas[np.uint64(begin + other & is_there)]) & is_there
        axis = wide(_AXIS_OF[flags[begin + t] & FACING_FLAGS])
        x, y, z = side_areas[0], side_areas[1], side_areas[2]
        along = y if axis == 1 else z if axis == 2 else x
        across = max(x if axis == 1 or axis == 2 else 0, max(0 if axis == 1 else y, 0 if axis == 2 else z))
        shape, guess = wide(_NO_AXIS), whole
        if axis < 3:
            pairs = about >> 8 & 63
            pair = pairs >> 2 * axis & 3
            shape = 5 * pair + popcount(pairs) - popcount(pair)
            if pair == 0:
                guess = across if across > 0 else whole
            elif pair < 3 and along > 0:
                column = _AREAS[areas[around[node, OWN]]]
                for k in range(2 * axis, 2 * axis + 2):
                    if around[node, k] != around[node, OWN]:
                        column += _AREAS[areas[around[node, k]]]
                guess = _code(max(column - _AREAS[along], column >> 6))
        context = ((shape * 3 + min(remaining, 3) - 1) * 4 + _size(across, whole)) * 4 + _size(along, whole)
        guess = -1 if remaining == 1 else guess
        area = _code_area(wide(areas[begin + t]), guess, whole, rest, context, coder)
        rest = max(rest, _AREAS[whole] >> 8) - _AREAS[area]
        if coder.work == DECODES:
            areas[begin + t] = area


@kernel
def code_row_areas(owners: Uint32s, areas: Uint8s, begin: int, cell_areas: Uint8s, coder: Coder) -> None:
    """Code the areas of rows from ``begin`` on, one for each cell of ``owners``."""
    rest = whole = remaining = wide(0)
    for n in range(owners.size):
        if remaining == 0:
            while n + remaining < owners.size and owners[n + remaining] == owners[n]:
                remaining += 1
            whole = wide(cell_areas[owners[n]])
            rest = _AREAS[whole]
        context, guess = _SHAPES - 4 + min(remaining, 3), -1 if remaining == 1 else whole
        area = _code_area(wide(areas[begin + n]), guess, whole, rest, context, coder)
        rest = max(rest, _AREAS[whole] >> 8) - _AREAS[area]
        if coder.work == DECODES:
            areas[begin + n] = area
        remaining -= 1
