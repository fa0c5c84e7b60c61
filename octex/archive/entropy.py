"""The entropy coder: symbols of known probabilities to words of 32 bits and back, in one stream.

rANS (Duda 2013, "Asymmetric numeral systems") with a state of 63 bits. Probabilities are of 4096. It writes
backward: the encoder lists where each symbol lies in the unit interval, and turns the list into words at the
end; the decoder reads forward. Models may therefore adapt as they go.

A coder is an array of four whole numbers, STATE … FAULT. Encoding, a stream is the list of intervals, each
``start << 16 | size``; decoding, it is the words.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from octex.arrays import Int64s, Uint8s, Uint32s
from octex.jit import inlined, kernel

#: Bits of a probability.
PRECISION = 12
ONE = 1 << PRECISION
_LEAST = 1 << 31  # the state is this or more between two symbols
_WORD = (1 << 32) - 1

# What a pass does.
COUNTS, ENCODES, DECODES = 0, 1, 2

# What a coder is.
STATE, PLACE, FAULT, PASS = 0, 1, 2, 3


def new_coder(work: int) -> Int64s:
    """Return a coder that begins."""
    return np.array([_LEAST, 0, 0, work], np.int64)


def decoder(stream: Uint32s) -> Int64s:
    """Return a coder that reads a stream, whose first two words are the state."""
    coder = new_coder(DECODES)
    if stream.size < 2 or stream[1] >> np.uint32(31):
        coder[FAULT] = 1
    else:
        coder[STATE] = int(stream[1]) << 32 | int(stream[0])
        coder[PLACE] = 2
    return coder


def is_whole(coder: Int64s, stream: Uint32s) -> bool:
    """Say whether a stream was read to its end, where the encoder began."""
    return bool(coder[FAULT] == 0 and coder[STATE] == _LEAST and coder[PLACE] == stream.size)


@inlined
def wide(number: Any) -> int:
    """Return a number of any type as int64, which no sum of kernels leaves."""
    return np.int64(number)  # type: ignore[return-value]


@inlined
def put(start: int, size: int, coder: Int64s, stream: Uint32s) -> None:
    """Note a symbol's interval; certain ones take nothing."""
    if size < ONE:
        stream[coder[PLACE]] = start << 16 | size
        coder[PLACE] += 1


@inlined
def advance(start: int, size: int, coder: Int64s, stream: Uint32s) -> None:
    """Take a symbol's interval off the state."""
    state = size * (coder[STATE] >> PRECISION) + (coder[STATE] & (ONE - 1)) - start
    if state < _LEAST:
        if coder[PLACE] < stream.size:
            state = state << 32 | wide(stream[coder[PLACE]])
            coder[PLACE] += 1
        else:
            state = _LEAST
            coder[FAULT] = 1
    coder[STATE] = state


@inlined
def code_bit(bit: int, chance: int, coder: Int64s, stream: Uint32s) -> int:
    """Encode or decode a bit that is 1 in ``chance`` of 4096 cases, 1 to 4095; return it."""
    if coder[PASS] == DECODES:
        bit = int(coder[STATE] & (ONE - 1) < chance)
        if bit:
            advance(0, chance, coder, stream)
        else:
            advance(chance, ONE - chance, coder, stream)
    elif bit:
        put(0, chance, coder, stream)
    else:
        put(chance, ONE - chance, coder, stream)
    return bit


@inlined
def code_bits(value: int, count: int, coder: Int64s, stream: Uint32s) -> int:
    """Encode or decode ``count`` bits, 0 to 36, any as likely as any; return them."""
    done = 0
    found = 0
    while done < count:
        some = min(count - done, PRECISION)
        size = ONE >> some
        if coder[PASS] == DECODES:
            part = (coder[STATE] & (ONE - 1)) >> (PRECISION - some)
            advance(part << (PRECISION - some), size, coder, stream)
        else:
            part = value >> done & ((1 << some) - 1)
            put(part << (PRECISION - some), size, coder, stream)
        found |= part << done
        done += some
    return found


@kernel
def write_words(intervals: Uint32s, count: int, words: Uint32s) -> int:
    """Turn intervals into words, the last first, at the far end of ``words``; return where they begin."""
    state, at = _LEAST, words.size
    for i in range(count - 1, -1, -1):
        start, size = wide(intervals[i]) >> 16, wide(intervals[i]) & 0xFFFF
        if state >= size << 51:
            at -= 1
            words[at] = state & _WORD
            state >>= 32
        state = (state // size << PRECISION) + state % size + start
    words[at - 1] = state >> 32
    words[at - 2] = state & _WORD
    return at - 2


def words_of(coder: Int64s, intervals: Uint32s) -> Uint32s:
    """Return the words of the intervals that a coder noted."""
    count = int(coder[PLACE])
    words = np.empty(count + 2, np.uint32)  # an interval is 12 bits or less
    return words[write_words(intervals, count, words) :]


# Whole numbers without a table, for the tables themselves: how many bits one has, then these, each bit coded
# by what was seen of its like.
_KINDS = 4
_LENGTHS = 34


@kernel
def code_numbers(numbers: Int64s, chances: Int64s, coder: Int64s, stream: Uint32s) -> None:
    """Encode or decode whole numbers below 2³² in place.

    ``chances`` (4, 34, 2) are those of the length's bits and of the highest bits below the first, by the
    length of the number before.
    """
    kind = 0
    for i in range(numbers.size):
        value = numbers[i] + 1
        length = 0
        if coder[PASS] != DECODES:
            while value >> (length + 1):
                length += 1
        bits = 0
        while bits < _LENGTHS - 1:
            more = _adapted(int(bits < length), chances, kind, bits, 0, coder, stream)
            if not more:
                break
            bits += 1
        found = 1
        if bits > 32:
            coder[FAULT] = 1
            return
        for place in range(bits - 1, -1, -1):
            bit = value >> place & 1
            if place == bits - 1:
                bit = _adapted(bit, chances, kind, bits, 1, coder, stream)
            else:
                bit = code_bits(bit, 1, coder, stream)
            found = found << 1 | bit
        numbers[i] = found - 1
        kind = min(bits, _KINDS - 1)


@inlined
def _adapted(
    bit: int, chances: Int64s, kind: int, length: int, part: int, coder: Int64s, stream: Uint32s
) -> int:
    chance = chances[kind, length, part]
    bit = code_bit(bit, chance, coder, stream)
    chances[kind, length, part] = adapted(chance, bit, 4)
    return bit


@inlined
def adapted(chance: int, bit: int, shift: int) -> int:
    """Return a bit's chance after it was seen: it moves to what was seen by 2⁻ˢʰⁱᶠᵗ of the way."""
    return chance + ((ONE - 1 - chance) >> shift) if bit else max(chance - (chance >> shift), 1)


def encoded_numbers(numbers: Int64s) -> Uint32s:
    """Return the stream of whole numbers (n,), 0 to 2³² − 2."""
    coder, stream = new_coder(ENCODES), np.empty(66 * numbers.size, np.uint32)
    code_numbers(numbers.copy(), np.full((_KINDS, _LENGTHS, 2), ONE // 2, np.int64), coder, stream)
    return words_of(coder, stream)


def decoded_numbers(stream: Uint32s, count: int) -> Int64s | None:
    """Return so many numbers of a stream; None if it does not hold them."""
    numbers, coder = np.zeros(count, np.int64), decoder(stream)
    if coder[FAULT] == 0:
        code_numbers(numbers, np.full((_KINDS, _LENGTHS, 2), ONE // 2, np.int64), coder, stream)
    return numbers if is_whole(coder, stream) else None


# Tables of symbols' frequencies.


def normalized(counts: Int64s) -> Int64s:
    """Return frequencies (n, 256) of 4096, at least 1 for each symbol that occurs; 0 for rows without any."""
    found = np.zeros_like(counts)
    for row in np.flatnonzero(counts.any(axis=1)):
        own = counts[row]
        sizes = np.where(own > 0, np.maximum(np.rint(own * (ONE / own.sum())), 1), 0).astype(np.int64)
        while (excess := int(sizes.sum()) - ONE) > 0:  # what was rounded up comes off the largest
            largest = int(np.argmax(sizes))
            sizes[largest] -= min(excess, max(int(sizes[largest]) // 2, 1))
        sizes[np.argmax(sizes)] -= excess
        found[row] = sizes
    return found


@kernel
def _look_up_tables(sizes: Int64s, starts: Int64s, symbols: Uint8s) -> None:
    for row in range(sizes.shape[0]):
        at = 0
        for symbol in range(256):
            starts[row, symbol] = at
            for _ in range(sizes[row, symbol]):
                symbols[row, at] = symbol
                at += 1
        starts[row, 256] = at


class Tables:
    """Frequencies as kernels take them."""

    def __init__(self, sizes: Int64s) -> None:
        self.sizes = sizes
        self.starts = np.zeros((len(sizes), 257), np.int64)
        self.symbols = np.zeros((len(sizes), ONE), np.uint8)
        _look_up_tables(sizes, self.starts, self.symbols)


@inlined
def code_symbol(
    symbol: int,
    table: int,
    counts: Int64s,
    starts: Int64s,
    symbols: Uint8s,
    coder: Int64s,
    stream: Uint32s,
) -> int:
    """Count, encode or decode a symbol of a table; return it."""
    work = coder[PASS]
    if work == COUNTS:
        counts[table, symbol] += 1
        return symbol
    if work == DECODES:
        symbol = wide(symbols[table, coder[STATE] & (ONE - 1)])
        advance(starts[table, symbol], starts[table, symbol + 1] - starts[table, symbol], coder, stream)
    else:
        put(starts[table, symbol], starts[table, symbol + 1] - starts[table, symbol], coder, stream)
    return symbol
