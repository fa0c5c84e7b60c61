"""The entropy coder: symbols of known frequencies to words of 16 bits and back, in one stream.

rANS (Duda 2013, "Asymmetric numeral systems") with four states of 32 bits, which take turns, so that four
symbols are decoded at once (Giesen 2014, "Interleaved entropy coders"). Frequencies are of 4096. It writes
backward: symbols are counted and noted first; when frequencies are known, the notes are turned into words,
the last first. The decoder reads forward.

A coder is an array of whole numbers: the states, then PLACE … TURN. When symbols are noted, a stream is the
notes, each ``context << 8 | symbol``, contexts of all pools numbered through, or for what has an interval of
its own ``1 << 31 | start << 13 | size``; decoding, it is the words.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Float64s, Int64s, Uint8s, Uint16s, Uint32s
from octex.jit import inlined, kernel

#: Bits of a frequency.
PRECISION = 12
ONE = 1 << PRECISION
STATES = 4
_LEAST = 1 << 16  # a state is this or more between two symbols
_WORD = _LEAST - 1

# What a pass does. Of values it also measures how they differ.
NOTES, DECODES, MEASURES = 0, 1, 2

# What a coder is, after the states.
PLACE, FAULT, PASS, TURN = 4, 5, 6, 7


class Pool(NamedTuple):
    """How symbols of some contexts are coded: what kernels take."""

    chosen: Uint8s  # (contexts,)   the table of each
    intervals: Uint32s  # (tables · 256,)   of a symbol: where it begins, and << 16 its frequency
    # To find a symbol, in few bytes, which stay in the fastest memory: where to look from, and of those that
    # occur, one after the other: where it begins, << 12 its frequency less one, << 24 the symbol.
    buckets: Uint8s  # (tables · 256,)   for each 16 of 4096
    occurring: Uint32s  # (tables · 256,)
    counts: Int64s  # (contexts, symbols)   how often which occurred
    first: int  # of its contexts, when all pools' are numbered through


def new_coder(work: int) -> Int64s:
    """Return a coder that begins."""
    return np.array([_LEAST] * STATES + [0, 0, work, 0], np.int64)


def decoder(words: Uint16s) -> tuple[Int64s, Uint32s]:
    """Return a coder that reads words, and these as its stream, which ends with a zero.

    The words begin with the states, low words first; there are none where all was certain.
    """
    coder, stream = new_coder(DECODES), np.empty(words.size + 1, np.uint32)
    stream[:-1], stream[-1] = words, 0
    if words.size >= 2 * STATES:
        coder[:STATES] = words[: 2 * STATES].view(np.uint32)
        coder[PLACE] = 2 * STATES
    return coder, stream


def is_whole(coder: Int64s, stream: Uint32s) -> bool:
    """Say whether a stream was read to its end, where the encoder began."""
    wanted = [_LEAST] * STATES + [stream.size - 1, 0]
    return bool(coder[: FAULT + 1].tolist() == wanted)


@inlined
def wide(number: Any) -> int:
    """Return a number of any type as int64, which no sum of kernels leaves."""
    return np.int64(number)  # type: ignore[return-value]


@inlined
def _put(start: int, size: int, coder: Int64s, stream: Uint32s) -> None:
    """Note an interval."""
    stream[np.uint64(coder[PLACE])] = 1 << 31 | start << 13 | size
    coder[PLACE] += 1


@inlined
def _low(coder: Int64s) -> int:
    """Return what says which symbol is next."""
    return wide(coder[coder[TURN] & (STATES - 1)] & (ONE - 1))


@inlined
def _take(start: int, size: int, coder: Int64s, stream: Uint32s) -> None:
    """Take a symbol's interval off a state."""
    turn = coder[TURN] & (STATES - 1)
    state = coder[turn]
    state = size * (state >> PRECISION) + (state & (ONE - 1)) - start
    # Whether a word is wanted is as good as random: a branch would be missed. Beyond the end PLACE tells.
    wants = wide(state < _LEAST)
    place = coder[PLACE]
    word = wide(stream[np.uint64(min(place, stream.size - 1))])
    coder[turn] = state << 16 * wants | word & -wants
    coder[PLACE] = place + wants
    coder[TURN] = (turn + 1) & (STATES - 1)


@inlined
def code_symbol(work: int, symbol: int, context: int, pool: Pool, coder: Int64s, stream: Uint32s) -> int:
    """Note and count, or decode a symbol in a context; return it. ``work`` is the coder's PASS."""
    if work != DECODES:
        pool.counts[np.uint64(context), np.uint64(symbol)] += 1
        stream[np.uint64(coder[PLACE])] = (pool.first + context) << 8 | symbol
        coder[PLACE] += 1
        return symbol
    found = _found(_low(coder), context, pool)
    _take(found & (ONE - 1), (found >> PRECISION & (ONE - 1)) + 1, coder, stream)
    return found >> 2 * PRECISION


@inlined
def _found(low: int, context: int, pool: Pool) -> int:
    """Return what ``occurring`` has of the symbol that ``low`` says."""
    table = wide(pool.chosen[np.uint64(context)]) << 8
    at = table + wide(pool.buckets[np.uint64(table | low >> 4)])
    found = wide(pool.occurring[np.uint64(at)])
    while low > (found & (ONE - 1)) + (found >> PRECISION & (ONE - 1)):
        at += 1
        found = wide(pool.occurring[np.uint64(at)])
    return found


@inlined
def code_symbols(
    work: int, symbols: Int64s, contexts: Int64s, count: int, pool: Pool, coder: Int64s, stream: Uint32s
) -> None:
    """Note and count, or decode so many symbols whose contexts are known before."""
    n = wide(0)
    if work == DECODES:
        turn, place = coder[TURN], coder[PLACE]
        a, b, c, d = coder[turn], coder[turn + 1 & 3], coder[turn + 2 & 3], coder[turn + 3 & 3]
        # Four states at once: none waits for another.
        while n + 4 <= count and place + 4 < stream.size:
            a, place = _taken(a, place, n, symbols, contexts, pool, stream)
            b, place = _taken(b, place, n + 1, symbols, contexts, pool, stream)
            c, place = _taken(c, place, n + 2, symbols, contexts, pool, stream)
            d, place = _taken(d, place, n + 3, symbols, contexts, pool, stream)
            n += 4
        coder[turn], coder[turn + 1 & 3], coder[turn + 2 & 3], coder[turn + 3 & 3] = a, b, c, d
        coder[PLACE] = place
    while n < count:
        at = np.uint64(n)
        symbols[at] = code_symbol(work, symbols[at], contexts[at], pool, coder, stream)
        n += 1


@inlined
def _taken(
    state: int, place: int, n: int, symbols: Int64s, contexts: Int64s, pool: Pool, stream: Uint32s
) -> tuple[int, int]:
    """Decode a symbol; return its state and the place after the words it took, which are there."""
    low = state & (ONE - 1)
    found = _found(low, contexts[np.uint64(n)], pool)
    symbols[np.uint64(n)] = found >> 2 * PRECISION
    state = ((found >> PRECISION & (ONE - 1)) + 1) * (state >> PRECISION) + low - (found & (ONE - 1))
    wants = wide(state < _LEAST)
    return state << 16 * wants | wide(stream[np.uint64(place)]) & -wants, place + wants


@inlined
def code_bits(value: int, count: int, coder: Int64s, stream: Uint32s) -> int:
    """Note or decode ``count`` bits, 0 to 36, any as likely as any; return them."""
    done = 0
    found = 0
    while done < count:
        some = min(count - done, PRECISION)
        if coder[PASS] == DECODES:
            part = _low(coder) >> (PRECISION - some)
            _take(part << (PRECISION - some), ONE >> some, coder, stream)
        else:
            part = value >> done & ((1 << some) - 1)
            _put(part << (PRECISION - some), ONE >> some, coder, stream)
        found |= part << done
        done += some
    return found


@kernel
def _write_words(notes: Uint32s, chosen: Uint32s, intervals: Uint32s, words: Uint16s) -> int:
    """Turn notes into words, the last first, at the far end of ``words``; return where they begin.

    ``chosen`` and ``intervals`` are those of all pools, one after the other.
    """
    states = np.full(STATES, _LEAST, np.int64)
    at = words.size
    is_certain = True
    for i in range(notes.size - 1, -1, -1):
        note = wide(notes[i])
        start, size = note >> 13 & (ONE - 1), note & (2 * ONE - 1)
        if note >> 31 == 0:
            table = wide(chosen[np.uint64(note >> 8)])
            interval = wide(intervals[np.uint64(table << 8 | note & 255)])
            start, size = interval & 0xFFFF, interval >> 16
        if size == ONE:  # it takes nothing
            continue
        is_certain = False
        turn = np.uint64(i & (STATES - 1))
        state = states[turn]
        if state >= size << 20:
            at -= 1
            words[at] = state & _WORD
            state >>= 16
        whole = np.uint32(state) // np.uint32(size)
        states[turn] = (wide(whole) << PRECISION) + state - wide(whole) * size + start
    if is_certain:
        return at
    for last in range(STATES - 1, -1, -1):
        at -= 2
        words[at] = states[last] & _WORD
        words[at + 1] = states[last] >> 16
    return at


def words_of(notes: Uint32s, chosen: Uint32s, intervals: Uint32s) -> Uint16s:
    """Return the words of notes; ``chosen`` and ``intervals`` are those of all pools."""
    words = np.empty(notes.size + 2 * STATES, np.uint16)  # an interval is 12 bits or less
    return words[_write_words(notes, chosen, intervals, words) :]


def intervals_of(pools: list[Pool]) -> tuple[Uint32s, Uint32s]:
    """Return the table of each context and the intervals of all pools, numbered through."""
    tables = np.cumsum([0, *(pool.intervals.size >> 8 for pool in pools[:-1])]).tolist()
    chosen = [pool.chosen.astype(np.uint32) + before for pool, before in zip(pools, tables, strict=True)]
    return np.concatenate(chosen), np.concatenate([pool.intervals for pool in pools])


# Whole numbers without a table, for the tables themselves: how many bits one has, then these, each bit coded
# by what was seen of its like.
_KINDS = 4
_LENGTHS = 34


@kernel
def _code_numbers(numbers: Int64s, chances: Int64s, coder: Int64s, stream: Uint32s) -> None:
    """Note or decode whole numbers below 2³² in place: each 0 is followed by how many more there are.

    ``chances`` (5, 34, 2) are those of the length's bits and of the highest bits below the first, by the
    length of the number before; the last kind is that of runs.
    """
    kind = i = 0
    while i < numbers.size:
        numbers[i] = number = _code_number(numbers[i], kind, chances, coder, stream)
        i += 1
        kind = 0
        while kind < _KINDS - 1 and number + 1 >> (kind + 1):
            kind += 1
        if number == 0:
            more = 0
            while coder[PASS] != DECODES and i + more < numbers.size and numbers[i + more] == 0:
                more += 1
            more = _code_number(more, _KINDS, chances, coder, stream)
            if more > numbers.size - i:
                coder[FAULT] = 1
            i += more
        if coder[FAULT]:
            return


@inlined
def _code_number(number: int, kind: int, chances: Int64s, coder: Int64s, stream: Uint32s) -> int:
    value = number + 1
    length = bits = 0
    if coder[PASS] != DECODES:
        while value >> (length + 1):
            length += 1
    while bits < _LENGTHS - 1:
        if not _adapted(int(bits < length), chances, kind, bits, 0, coder, stream):
            break
        bits += 1
    if bits == 0:
        return 0
    if bits > 32:
        coder[FAULT] = 1
        return 0
    high = _adapted(value >> (bits - 1) & 1, chances, kind, bits, 1, coder, stream)
    low = code_bits(value & ((1 << (bits - 1)) - 1), bits - 1, coder, stream)
    return ((2 | high) << (bits - 1) | low) - 1


@inlined
def _adapted(
    bit: int, chances: Int64s, kind: int, length: int, part: int, coder: Int64s, stream: Uint32s
) -> int:
    """Note or decode a bit, 1 in so many of 4096 cases, 1 to 4095, which move to what is seen."""
    chance = chances[kind, length, part]
    if coder[PASS] == DECODES:
        bit = int(_low(coder) < chance)
    start, size = (0, chance) if bit else (chance, ONE - chance)
    if coder[PASS] == DECODES:
        _take(start, size, coder, stream)
    else:
        _put(start, size, coder, stream)
    chances[kind, length, part] = (
        chance + ((ONE - 1 - chance) >> 4) if bit else max(chance - (chance >> 4), 1)
    )
    return bit


def _new_chances() -> Int64s:
    return np.full((_KINDS + 1, _LENGTHS, 2), ONE // 2, np.int64)


def encoded_numbers(numbers: Int64s) -> Uint16s:
    """Return the stream of whole numbers (n,), 0 to 2³² − 2."""
    coder, stream = new_coder(NOTES), np.empty(120 * numbers.size, np.uint32)
    _code_numbers(numbers.copy(), _new_chances(), coder, stream)
    return words_of(stream[: coder[PLACE]], *[np.empty(0, np.uint32)] * 2)


def decoded_numbers(words: Uint16s, count: int) -> Int64s | None:
    """Return so many numbers of a stream's words; None if it does not hold them."""
    numbers, (coder, stream) = np.zeros(count, np.int64), decoder(words)
    _code_numbers(numbers, _new_chances(), coder, stream)
    return numbers if is_whole(coder, stream) else None


# Tables of symbols' frequencies, which contexts share.

#: Most tables of a pool.
TABLES = 64
_SIZES = (64, 24, 8, 1)
_SYMBOL_BITS = 7.0  # about what the frequency of a symbol takes


def normalized(counts: Int64s) -> Int64s:
    """Return frequencies (n, 256) of 4096, at least 1 for each symbol that occurs; 0 for rows without any."""
    found = np.zeros_like(counts)
    rows = np.flatnonzero(counts.any(axis=1))
    own, places = counts[rows], np.arange(rows.size)
    sizes = np.maximum(np.rint(own * (ONE / own.sum(axis=1, keepdims=True))), 1).astype(np.int64)
    sizes[own == 0] = 0
    excess = sizes.sum(axis=1) - ONE
    while (excess > 0).any():  # what was rounded up comes off the largest
        largest = sizes.argmax(axis=1)
        less = np.minimum(np.maximum(excess, 0), np.maximum(sizes[places, largest] // 2, 1))
        sizes[places, largest] -= less
        excess -= less
    sizes[places, sizes.argmax(axis=1)] -= excess
    found[rows] = sizes
    return found


def pool_of(chosen: Uint8s, sizes: Int64s) -> Pool:
    """Return what kernels take to decode by frequencies (tables, 256), each row's sum 4096."""
    starts = np.cumsum(sizes, axis=1) - sizes
    intervals = (sizes << 16 | starts).astype(np.uint32).reshape(-1)
    tables, symbols = np.nonzero(sizes)
    ranks = np.cumsum(sizes > 0, axis=1) - 1
    occurring = np.zeros(sizes.shape, np.uint32)
    own = sizes[tables, symbols] - 1 << PRECISION | starts[tables, symbols]
    occurring[tables, ranks[tables, symbols]] = symbols << 2 * PRECISION | own
    buckets = np.repeat(ranks.astype(np.uint8).reshape(-1), sizes.reshape(-1))[:: ONE >> 8].copy()
    return Pool(chosen, intervals, buckets, occurring.reshape(-1), np.empty((0, 0), np.int64), 0)


@kernel
def _choose_tables(
    symbols: Uint8s, counts: Int64s, ends: Int64s, bits: Float64s, chosen: Int64s, sums: Int64s
) -> float:
    """Choose for each context the table that codes its symbols in fewest bits; return how many all take.

    Of contexts, one after the other up to ``ends``, there are the ``symbols`` that occur, and how often.
    ``bits`` (symbols, tables) are what tables take for a symbol; counts are added to their table's ``sums``.
    """
    total = 0.0
    costs = np.empty(bits.shape[1])
    begin = wide(0)
    for context in range(ends.size):
        costs[:] = 0.0
        for i in range(begin, ends[context]):
            count = np.float64(counts[i])
            for table in range(np.uint64(bits.shape[1])):  # in vectors
                costs[table] += bits[np.uint64(symbols[i]), table] * count
        table = 0
        for other in range(1, costs.size):
            if costs[other] < costs[table]:
                table = other
        chosen[context] = table
        total += costs[table]
        for i in range(begin, ends[context]):
            sums[table, symbols[i]] += counts[i]
        begin = ends[context]
    return total


def shared_tables(counts: Int64s) -> tuple[Uint8s, Int64s]:
    """Return which table each context uses (contexts,), and frequencies (tables, 256).

    Contexts whose symbols are spread alike share a table (k-means); there are as many tables as make them
    and what they code smallest. Those that code most come first.
    """
    used = np.flatnonzero(counts.any(axis=1))
    chosen = np.zeros(len(counts), np.uint8)
    own = counts[used]
    contexts, symbols = np.nonzero(own)
    occurring = symbols.astype(np.uint8), own[contexts, symbols]
    ends = np.cumsum(np.bincount(contexts, minlength=used.size))
    sums = own[np.argsort(-own.sum(axis=1), kind="stable")]
    least, nearest, sizes = np.inf, np.zeros(used.size, np.int64), np.ones((1, counts.shape[1]), np.int64)
    for size in sorted({min(size, used.size) for size in _SIZES} - {0}, reverse=True):
        found = np.zeros(used.size, np.int64)
        for _ in range(3):
            sums = sums[np.argsort(-sums.sum(axis=1), kind="stable")][:size]
            centres = sums + 0.02
            bits = (np.log2(centres.sum(axis=1, keepdims=True)) - np.log2(centres)).T.copy()
            sums = np.zeros_like(sums)
            total = _choose_tables(*occurring, ends, bits, found, sums)
        total += _SYMBOL_BITS * np.count_nonzero(sums) + used.size * np.log2(size + 1)
        if total < least:
            least, nearest, sizes = total, found, sums
    kept = sizes.any(axis=1)
    chosen[used] = (np.cumsum(kept) - 1)[nearest]
    frequencies = np.zeros((np.count_nonzero(kept), 256), np.int64)
    frequencies[:, : counts.shape[1]] = sizes[kept]
    return chosen, normalized(frequencies)
