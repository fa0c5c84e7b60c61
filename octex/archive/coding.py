"""How values are coded: compared as whole numbers, and what guesses are off by as symbols.

Integers are whole numbers as they are, floats by their bits, in the order of what they stand for. Components
of colours are coded green first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.archive.entropy import Coder, Pool, code_bits, code_symbol, wide
from octex.arrays import Int64s, Uint8s
from octex.jit import inlined

#: Types of values.
DTYPES = "uint8", "uint16", "float16", "float32"
#: What a guess weighs: sums of differences on the cell's side, on the other, beside; the mean of the
#: siblings' so far; how 3 components were off, and differ.
TERMS = 10
#: How much the cells around vary, in steps of the channel's unit: classes have weights, contexts tables.
CLASSES = 5
CONTEXTS = 11
#: Leaves, nodes, rows of split cells, kept nodes.
SETS = 4
SPLIT_ROWS, KEPT_NODES = 2, 3
#: Weights are of 2¹².
WEIGHT_BITS = 12


def _steps(ends: list[int]) -> Uint8s:
    return np.searchsorted(ends, np.arange(1 << 11), side="right").astype(np.uint8)


#: What kernels take: the class, and the context, of how much differences vary, 0 … 2047; and 2¹⁶ / n.
STEPS = (
    _steps([1, 4, 16, 48]),
    _steps([1, 2, 3, 6, 10, 16, 24, 36, 52, 80]),
    np.array([0, *(65536 // n for n in range(1, 9))], np.int64),
)


class Form(NamedTuple):
    """What a channel's values are."""

    components: int
    size: int  # bytes of a value: 1, 2, 4
    is_float: int
    error: int  # by how much a value may move
    unit: int  # differences are measured in 2ᵘⁿⁱᵗ


class Coding(NamedTuple):
    """How a channel's values are coded: what kernels take."""

    form: Form
    weights: Int64s  # (2 · components · CLASSES · TERMS,)   of leaves and nodes


def coding_of(form: Form) -> Coding:
    """Return a coding without weights."""
    return Coding(form, np.zeros(2 * form.components * CLASSES * TERMS, np.int64))


def contexts_of(components: int) -> int:
    """Return how many contexts a channel has."""
    return SETS * components * CONTEXTS + 2


def numbers_of(raw: Uint8s, form: Form) -> Int64s:
    """Return values (n, components, size) as whole numbers (n, components)."""
    numbers: Int64s = raw.astype(np.int64) @ (1 << 8 * np.arange(form.size))
    sign = 1 << (8 * form.size - 1)
    return np.where(numbers & sign, 2 * sign - 1 - numbers, numbers | sign) if form.is_float else numbers


@inlined
def component_of(j: int, form: Form) -> int:
    """Return which component is coded as the j-th."""
    return wide(1 - j if form.components >= 3 and j < 2 else j)


@inlined
def number_at(raw: Uint8s, at: int, form: Form) -> int:
    """Return the value whose first byte is ``at`` as a whole number."""
    i = np.uint64(at)
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
def write_number(number: int, raw: Uint8s, at: int, form: Form) -> None:
    """Write a value, given as a whole number, whose first byte is ``at``."""
    i = np.uint64(at)
    if form.is_float:
        sign = 1 << (8 * form.size - 1)
        number = number ^ sign if number & sign else (2 * sign - 1) - number
    raw[i] = number & 255
    if form.size > 1:
        raw[i + np.uint64(1)] = number >> 8 & 255
        if form.size > 2:
            raw[i + np.uint64(2)] = number >> 16 & 255
            raw[i + np.uint64(3)] = number >> 24


@inlined
def error_of(number: int, guess: int, form: Form) -> int:
    """Return what a guess is off by, in steps of 2 ``error`` + 1, as it is coded."""
    most, error = (1 << 8 * form.size) - 1, form.error
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
def corrected(guess: int, off: int, form: Form) -> int:
    """Return the number that a guess is so many steps off from."""
    most, error = (1 << 8 * form.size) - 1, form.error
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
def folded(off: int) -> int:
    """Return 0, 1, 2, 3 … for 0, −1, 1, −2 …."""
    return wide(off << 1 ^ off >> 63)


@inlined
def unfolded(sign: int) -> int:
    """Return the error that was folded."""
    return wide(sign >> 1 ^ -(sign & 1))


@inlined
def code_folded(work: int, sign: int, form: Form, context: int, pool: Pool, coder: Coder) -> int:
    """Note or decode a folded error; return it.

    Of more than a byte, 16 and above are coded as their length and two highest bits, then the others.
    """
    if form.size == 1:
        return code_symbol(work, sign, context, pool, coder)
    token, rest = sign, wide(0)
    if sign >= 16:
        length = 4
        while sign >> (length + 1):
            length += 1
        token = 16 + (length - 4) * 4 + (sign >> (length - 2) & 3)
        rest = sign & ((1 << (length - 2)) - 1)
    token = code_symbol(work, token, context, pool, coder)
    if token < 16:
        return token
    length = min(4 + (token - 16 >> 2), 31)
    rest = code_bits(rest, length - 2, coder)
    return (4 | (token & 3)) << (length - 2) | rest
