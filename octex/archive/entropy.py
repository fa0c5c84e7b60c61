"""The entropy coder: adaptive symbols and bits to words of 16 bits and back, in one stream.

rANS (Duda 2013, "Asymmetric numeral systems") with four states of 32 bits, which take turns (Giesen 2014,
"Interleaved entropy coders"). Frequencies are of 32768. A context's frequencies follow what occurs in it, so
nothing about them is stored. rANS writes backward: symbols are noted first, then the notes are turned into
words, the last first. The decoder reads forward.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Int64s, Uint8s, Uint16s, Uint32s, Uint64s
from octex.jit import inlined, kernel, popcount

#: Bits of a frequency.
PRECISION = 15
ONE = 1 << PRECISION
STATES = 4
_LEAST = 1 << 16  # a state is this or more between two symbols

NOTES, DECODES = 0, 1
# What a coder's state holds, after the states of rANS.
PLACE, FAULT, PASS, TURN = 4, 5, 6, 7

#: Symbols of a context. Its frequencies are 16 numbers of 15 bits in four words of 64: where symbol i begins
#: less i, so that each symbol keeps a frequency of 1 at least.
SYMBOLS = 16
_MOST = ONE - SYMBOLS
#: By how many bits less each number moves towards 0 up to the symbol that occurs, and to ``_MOST`` after it:
#: the first symbols of a context move it far.
_RATES = np.repeat(np.arange(1, 8, dtype=np.uint64), [1, 2, 4, 12, 40, 100, 90])
_LANES = np.uint64(0x0001_0001_0001_0001)
_HIGH = np.uint64(0x8000_8000_8000_8000)
_NUMBERS = np.arange(SYMBOLS, dtype=np.uint16)
#: The numbers after each symbol (symbol, words), and of all symbols their numbers.
_AFTER = np.where(_NUMBERS[:, None] < _NUMBERS, np.uint16(0xFFFF), np.uint16(0)).view(np.uint64)
#: Of the tokens of numbers: the least number, and how many bits follow.
_TOKENS = np.array([*range(8), 8, 12, 16, 24, 32, 48, 64, 128]), np.array([0] * 8 + [2, 2, 3, 3, 4, 4, 6, 7])
_TOKEN_OF = np.searchsorted(_TOKENS[0], np.arange(256), side="right").astype(np.uint8) - np.uint8(1)
#: Of differences: 0, 1, 2, then how many bits they have less one, and 2.
_LENGTHS = np.searchsorted([1, 2, 3, 5, 9, 17, 33, 65], np.arange(256), side="right").astype(np.uint8)
_STEPS = _RATES, _AFTER, _NUMBERS.view(np.uint64), *_TOKENS, _TOKEN_OF, _LENGTHS
#: What a context begins with.
_EVEN = (_NUMBERS * (_MOST // SYMBOLS)).astype(np.uint16).view(np.uint64)


class Model(NamedTuple):
    """What a stream has learned: what kernels take."""

    starts: Uint64s  # (contexts, 4)
    seen: Uint8s  # (contexts,)   how many symbols occurred, up to some
    odds: Uint32s  # (contexts of bits,)   of 65536: how likely 0 is


def new_model(symbols: int, bits: int = 0) -> Model:
    """Return a model of so many contexts of symbols, and of bits."""
    begin = np.tile(_EVEN, (symbols, 1)), np.zeros(symbols, np.uint8)
    return Model(*begin, np.full(bits, 1 << 15, np.uint32))


class Coder(NamedTuple):
    """A stream that is noted or decoded: what kernels take."""

    state: Int64s  # the states, then PLACE … TURN
    stream: Uint32s  # the words that are decoded, or notes: where an interval begins, << 16 its size
    model: Model
    rates: Uint64s
    after: Uint64s  # (16, 4)
    numbers: Uint64s  # (4,)
    least: Int64s  # (16,)   of tokens
    bits: Int64s  # (16,)
    tokens: Uint8s  # (256,)   of numbers
    lengths: Uint8s  # (256,)


def _coder(work: int, stream: Uint32s, model: Model) -> Coder:
    return Coder(np.array([_LEAST] * STATES + [0, 0, work, 0], np.int64), stream, model, *_STEPS)


def noter(model: Model, most: int) -> Coder:
    """Return a coder that notes, with room for so many notes."""
    return _coder(NOTES, np.empty(most, np.uint32), model)


def decoder(model: Model, content: bytes) -> Coder:
    """Return a coder that reads a stream's bytes; a zero ends its words. These begin with the states."""
    words = np.frombuffer(content, "<u2", len(content) // 2)
    coder = _coder(DECODES, np.append(words, np.uint16(0)).astype(np.uint32), model)
    if words.size >= 2 * STATES:
        coder.state[:STATES] = words[: 2 * STATES].view("<u4")
        coder.state[PLACE] = 2 * STATES
    return coder


def is_whole(coder: Coder) -> bool:
    """Say whether a stream was read to its end, where the encoder began."""
    wanted = [_LEAST] * STATES + [coder.stream.size - 1, 0]
    return bool(coder.state[: FAULT + 1].tolist() == wanted)


@inlined
def wide(number: Any) -> int:
    """Return a number of any type as int64, which no sum of kernels leaves."""
    return np.int64(number)  # type: ignore[return-value]


@inlined
def _note(start: int, size: int, coder: Coder) -> None:
    coder.stream[np.uint64(coder.state[PLACE])] = start << 16 | size
    coder.state[PLACE] += 1


@inlined
def _low(coder: Coder) -> int:
    """Return what says which symbol is next."""
    return wide(coder.state[coder.state[TURN] & (STATES - 1)] & (ONE - 1))


@inlined
def _take(start: int, size: int, coder: Coder) -> None:
    """Take a symbol's interval off a state."""
    turn = np.uint64(coder.state[TURN])
    state = coder.state[turn]
    state = size * (state >> PRECISION) + (state & (ONE - 1)) - start
    # Whether a word is wanted is as good as random: a branch would be missed. Beyond the end PLACE tells.
    wants = wide(state < _LEAST)
    place = coder.state[PLACE]
    word = wide(coder.stream[np.uint64(min(place, coder.stream.size - 1))])
    coder.state[turn] = state << 16 * wants | word & -wants
    coder.state[PLACE] = place + wants
    coder.state[TURN] = (turn + np.uint64(1)) & np.uint64(STATES - 1)


@inlined
def _code(start: int, size: int, coder: Coder) -> None:
    if coder.state[PASS] == DECODES:
        _take(start, size, coder)
    else:
        _note(start, size, coder)


@inlined
def code_symbol(symbol: int, context: int, coder: Coder) -> int:
    """Note or decode a symbol of 16 in a context; return it."""
    at, starts = np.uint64(context), coder.model.starts
    if coder.state[PASS] == DECODES:
        low = np.uint64(_low(coder)) * _LANES | _HIGH
        symbol = wide(-1)
        for i in range(np.uint64(4)):
            symbol += popcount(low - starts[at, i] - coder.numbers[i] & _HIGH)
    start, end = _number(starts, context, symbol), wide(_MOST)
    if symbol < SYMBOLS - 1:
        end = _number(starts, context, symbol + 1)
    _code(start + symbol, end - start + 1, coder)
    seen, own = np.uint64(coder.model.seen[at]), np.uint64(symbol)
    coder.model.seen[at] = min(seen + np.uint64(1), np.uint64(coder.rates.size - 1))
    rate = coder.rates[seen]
    part, most = (np.uint64(0xFFFF) >> rate) * _LANES, (np.uint64(_MOST) >> rate) * _LANES
    for i in range(np.uint64(4)):
        there = starts[at, i]
        starts[at, i] = there - (there >> rate & part) + (coder.after[own, i] & most)
    return symbol


@inlined
def _number(starts: Uint64s, context: int, symbol: int) -> int:
    """Return a context's number of a symbol."""
    return wide(starts[np.uint64(context), np.uint64(symbol >> 2)] >> np.uint64(16 * (symbol & 3))) & 0xFFFF


@inlined
def code_bit(bit: int, context: int, coder: Coder) -> int:
    """Note or decode a bit in a context of bits; return it."""
    at = np.uint64(context)
    odds = wide(coder.model.odds[at])
    size = min(max(odds >> 1, 16), ONE - 16)
    if coder.state[PASS] == DECODES:
        bit = wide(_low(coder) >= size)
    _code(size & -bit, ONE - size if bit else size, coder)
    coder.model.odds[at] = odds - (odds >> 5) if bit else odds + (65536 - odds >> 5)
    return bit


@inlined
def code_plain(value: int, count: int, coder: Coder) -> int:
    """Note or decode ``count`` bits, 0 to 15, any as likely as any; return them."""
    size = wide(ONE) >> count
    if coder.state[PASS] == DECODES:
        value = _low(coder) >> PRECISION - count
    _code(value * size, size, coder)
    return value


@inlined
def code_number(number: int, unit: int, is_byte: bool, context: int, coder: Coder) -> int:
    """Note or decode a number; return it. It has 8 bits at most if it is a byte's, else 39.

    A token says where it lies in units of 2ᵘⁿⁱᵗ, and plain bits where from there. The last token is followed
    by the number of bits.
    """
    high, token = number >> unit, wide(0)
    if coder.state[PASS] != DECODES:
        token = wide(coder.tokens[np.uint64(min(high, 255))])
    found = np.uint64(code_symbol(token, context, coder))
    least, bits = wide(coder.least[found]), wide(coder.bits[found])
    if is_byte:
        return least + code_plain(high - least, bits, coder)
    if found == SYMBOLS - 1:
        length = wide(8)
        while high >> length:
            length += 1
        bits = 7 + code_plain(length - 8, 5, coder)
        least = wide(1) << bits
    high = least + _code_long(high - least, bits, coder)
    return high << unit | _code_long(number & (1 << unit) - 1, unit, coder)


@inlined
def _code_long(value: int, count: int, coder: Coder) -> int:
    """Note or decode ``count`` plain bits, the lowest first; return them."""
    found = done = wide(0)
    while done < count:
        some = min(count - done, PRECISION)
        found |= code_plain(value >> done & (1 << some) - 1, some, coder) << done
        done += some
    return found


@inlined
def folded(off: int) -> int:
    """Return 0, 1, 2, 3 … for 0, −1, 1, −2 …."""
    return wide(off << 1 ^ off >> 63)


@inlined
def unfolded(number: int) -> int:
    """Return what was folded."""
    return wide(number >> 1 ^ -(number & 1))


@kernel
def _write_words(notes: Uint32s, words: Uint16s) -> int:
    """Turn notes into words, the last first, at the far end of ``words``; return where they begin."""
    states = np.full(STATES, _LEAST, np.int64)
    at = words.size
    for i in range(notes.size - 1, -1, -1):
        start, size = wide(notes[i]) >> 16, wide(notes[i]) & 0xFFFF
        turn = np.uint64(i & (STATES - 1))
        state = states[turn]
        if state >= size << 32 - PRECISION:
            at -= 1
            words[at] = state & 0xFFFF
            state >>= 16
        whole = wide(np.uint32(state) // np.uint32(size))
        states[turn] = (whole << PRECISION) + state - whole * size + start
    for last in range(STATES - 1, -1, -1):
        at -= 2
        words[at] = states[last] & 0xFFFF
        words[at + 1] = states[last] >> 16
    return at


def encoded(coder: Coder) -> bytes:
    """Return the stream of what was noted."""
    notes = coder.stream[: coder.state[PLACE]]
    words = np.empty(notes.size + 2 * STATES, np.uint16)  # a note takes a word at most
    return words[_write_words(notes, words) :].astype("<u2").tobytes()
