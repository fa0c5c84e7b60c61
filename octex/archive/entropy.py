"""The entropy coder: adaptive symbols and bits, in one stream of 32-bit words.

rANS (Duda 2013, "Asymmetric numeral systems") with two states of 63 bits, which take turns (Giesen 2014,
"Interleaved entropy coders"). Frequencies are parts of 32768 and adapt in each context, so none are stored.
rANS writes backward: symbols are noted first, then the notes become words, the last first. The decoder reads
forward.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Int16s, Int64s, Uint32s
from octex.jit import chosen, inlined, kernel, mask_bits, popcount, put, sixteen, sixteen_at

#: Bits of a frequency.
PRECISION = 15
ONE = 1 << PRECISION
STATES = 2
_LEAST = 1 << 31  # a state is this or more between two symbols

NOTES, DECODES = 0, 1  # the work of a coder
# Indices of a coder's state, after the states of rANS, the next one first.
PLACE, FAULT = 2, 3
_BEGIN = [_LEAST] * STATES + [0, 0]

#: Symbols of a context. Its row of numbers has the begin of symbol i minus i, so that each frequency is at
#: least 1; the end of the last symbol, likewise; and the number of symbols so far, up to a limit.
SYMBOLS = 16
_MOST, _SEEN = ONE - SYMBOLS, SYMBOLS + 1
_ROW = 32
#: Shifts by which numbers move towards 0 up to a coded symbol, and towards ``_MOST`` after it: the first
#: symbols of a context move them far.
_RATES = np.repeat(np.arange(1, 8), [1, 2, 4, 12, 40, 100, 90])
#: The least number of each token, and the bits that follow it.
_LEAST_OF = np.array([*range(8), 8, 12, 16, 24, 32, 48, 64, 128])
_BITS_OF = np.array([0] * 8 + [2, 2, 3, 3, 4, 4, 6, 7])
_BITS_OF_LONG = np.append(_BITS_OF[:-1], 5)
_TOKEN_OF = np.searchsorted(_LEAST_OF, np.arange(256), side="right").astype(np.uint8) - np.uint8(1)
_NO_BITS = np.zeros(SYMBOLS, np.int64)
#: The initial row of a context.
_EVEN = np.array([_MOST // SYMBOLS * i for i in range(SYMBOLS)] + [_MOST] + [0] * (_ROW - _SEEN), np.int16)
_LANES = np.arange(SYMBOLS, dtype=np.int16)


class AdaptiveModel(NamedTuple):
    """The adaptive state of a stream."""

    numbers: Int16s  # (contexts · 32,)
    odds: Uint32s  # (contexts of bits,)   of 65536: how likely 0 is


def new_model(symbols: int, bits: int) -> AdaptiveModel:
    """Return a model of contexts of symbols, and of bits."""
    return AdaptiveModel(np.tile(_EVEN, symbols), np.full(bits, 1 << 15, np.uint32))


class Coder(NamedTuple):
    """A stream to note or to decode."""

    work: int  # NOTES or DECODES
    state: Int64s  # the states, then PLACE and FAULT
    stream: Int64s  # the words that are decoded, or notes: size | start << 16 | plain << 32 | count << 48
    model: AdaptiveModel


def noter(model: AdaptiveModel, most: int) -> Coder:
    """Return a coder that notes, with room for ``most`` notes."""
    return Coder(NOTES, np.array(_BEGIN, np.int64), np.empty(most, np.int64), model)


def decoder(model: AdaptiveModel, content: bytes) -> Coder:
    """Return a coder that reads a stream's bytes: first the states, then words, then an added zero."""
    words = np.frombuffer(content, "<u4", len(content) // 4)
    coder = Coder(DECODES, np.array(_BEGIN, np.int64), np.append(words, np.uint32(0)).astype(np.int64), model)
    if words.size >= 2 * STATES:
        coder.state[:STATES] = words[: 2 * STATES].view("<i8")
        coder.state[PLACE] = 2 * STATES
    return coder


def is_whole(coder: Coder) -> bool:
    """Return whether a stream was read to its end, where the encoder began."""
    return bool(coder.state.tolist() == [_LEAST] * STATES + [coder.stream.size - 1, 0])


@inlined
def wide(number: Any) -> int:
    """Return a number of any type as int64, so that kernels' sums stay int64."""
    return np.int64(number)  # type: ignore[return-value]


@inlined
def _low(coder: Coder) -> int:
    """Return the state's part that selects the next symbol."""
    return wide(coder.state[0] & (ONE - 1))


@inlined
def _code(start: int, size: int, plain: int, count: int, coder: Coder) -> int:
    """Code a symbol's interval and ``count`` plain bits, 0 to 15; return the bits."""
    place = coder.state[PLACE]
    if coder.work != DECODES:
        coder.stream[np.uint64(place)] = count << 48 | plain << 32 | start << 16 | size
        coder.state[PLACE] = place + 1
        return plain
    state = coder.state[0]
    state = size * (state >> PRECISION) + (state & (ONE - 1)) - start
    plain = state & (1 << count) - 1
    state >>= count
    # Whether a word is needed is random: without a branch, the zero at the end is read otherwise. PLACE shows
    # reads beyond the end.
    wants, last = wide(state < _LEAST), coder.stream.size - 1
    word = coder.stream[np.uint64(last ^ (last ^ min(place, last)) & -wants)]
    coder.state[0], coder.state[1] = coder.state[1], state << 32 * wants | word
    coder.state[PLACE] = place + wants
    return plain


@inlined
def code_token(symbol: int, plain: int, bits: Int64s, context: int, coder: Coder) -> tuple[int, int]:
    """Code one of 16 symbols in a context, and its plain bits, ``bits`` of each symbol; return both."""
    numbers, at = coder.model.numbers, context * _ROW
    if coder.work == DECODES:
        begins = sixteen_at(numbers, at) + sixteen_at(_LANES, 0)
        symbol = popcount(mask_bits(begins <= sixteen(_low(coder)))) - 1
    at_symbol = np.uint64(at + symbol)
    start = wide(numbers[at_symbol])
    size = wide(numbers[at_symbol + np.uint64(1)]) - start + 1
    plain = _code(start + symbol, size, plain, bits[np.uint64(symbol)], coder)
    seen = wide(numbers[np.uint64(at + _SEEN)])
    numbers[np.uint64(at + _SEEN)] = min(seen + 1, _RATES.size - 1)
    row, rate = sixteen_at(numbers, at), sixteen(_RATES[np.uint64(seen)])
    is_after = sixteen_at(_LANES, 0) > sixteen(symbol)
    put(numbers, at, row - (row >> rate) + chosen(is_after, sixteen(_MOST) >> rate, sixteen(0)))
    return symbol, plain


@inlined
def code_symbol(symbol: int, context: int, coder: Coder) -> int:
    """Code one of 16 symbols in a context; return it."""
    return code_token(symbol, 0, _NO_BITS, context, coder)[0]


@inlined
def code_bit(bit: int, context: int, coder: Coder) -> int:
    """Code a bit in a context of bits; return it."""
    at = np.uint64(context)
    odds = wide(coder.model.odds[at])
    size = min(max(odds >> 1, 16), ONE - 16)
    if coder.work == DECODES:
        bit = wide(_low(coder) >= size)
    _code(size & -bit, ONE - size if bit else size, 0, 0, coder)
    coder.model.odds[at] = odds - (odds >> 5) if bit else odds + (65536 - odds >> 5)
    return bit


@inlined
def code_number(number: int, unit: int, is_byte: bool, context: int, coder: Coder) -> tuple[int, int]:
    """Code a number, and return it, and about its size.

    It has at most 8 bits if ``is_byte``, else 39. A token gives its range in units of 2ᵘⁿⁱᵗ, and plain bits
    its place there. The number of bits follows the last token.
    """
    high, token, plain = number >> unit, wide(0), wide(0)
    if coder.work != DECODES:
        token = wide(_TOKEN_OF[np.uint64(min(high, 255))])
        plain = high - _LEAST_OF[np.uint64(token)]
    if is_byte:
        token, plain = code_token(token, plain, _BITS_OF, context, coder)
        about = _LEAST_OF[np.uint64(token)]  # available before its bits
        return about + plain, about
    if token == SYMBOLS - 1:
        plain = wide(0)
        while high >> 8 + plain:
            plain += 1
    token, plain = code_token(token, plain, _BITS_OF_LONG, context, coder)
    least, bits = _LEAST_OF[np.uint64(token)] + plain, wide(0)
    if token == SYMBOLS - 1:
        bits = 7 + plain
        least = wide(1) << bits
    high = least + _code_long(high - least, bits, coder)
    number = high << unit | _code_long(number & (1 << unit) - 1, unit, coder)
    return number, number


@inlined
def _code_long(value: int, count: int, coder: Coder) -> int:
    """Code ``count`` plain bits, the lowest first; return them."""
    bits = done = wide(0)
    while done < count:
        n_bits = min(count - done, PRECISION)
        bits |= _code(0, ONE, value >> done & (1 << n_bits) - 1, n_bits, coder) << done
        done += n_bits
    return bits


@kernel
def _write_words(notes: Int64s, words: Uint32s) -> int:
    """Write notes as words, the last first, at the end of ``words``; return where they begin."""
    states = np.full(STATES, _LEAST, np.int64)
    at = words.size
    for i in range(notes.size - 1, -1, -1):
        note = notes[i]
        size, start, plain, count = note & 0xFFFF, note >> 16 & 0xFFFF, note >> 32 & 0xFFFF, note >> 48
        turn = np.uint64(i & (STATES - 1))
        state = states[turn]
        words[np.uint64(at - 1)] = state & 0xFFFFFFFF  # no branch: it would be random
        wants = wide(state >= size << 48 - count)
        at -= wants
        state = state >> 32 * wants << count | plain
        whole = wide(np.uint64(state) // np.uint64(size))
        states[turn] = (whole << PRECISION) + (state - whole * size) + start
    for last in range(STATES - 1, -1, -1):
        at -= 2
        words[at] = states[last] & 0xFFFFFFFF
        words[at + 1] = states[last] >> 32
    return at


def encoded(coder: Coder) -> bytes:
    """Return the stream of all notes."""
    notes = coder.stream[: coder.state[PLACE]]
    words = np.empty(notes.size + 2 * STATES + 1, np.uint32)  # a note takes a word at most
    return words[_write_words(notes, words) :].astype("<u4").tobytes()
