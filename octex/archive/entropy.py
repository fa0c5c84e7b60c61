"""The entropy coder: symbols of known frequencies to words of 16 bits and back, in one stream.

rANS (Duda 2013, "Asymmetric numeral systems") with four states of 32 bits, which take turns, so that four
symbols are decoded at once (Giesen 2014, "Interleaved entropy coders"). Frequencies are of 4096. It writes
backward: symbols are counted and noted first; when frequencies are known, the notes are turned into words,
the last first. The decoder reads forward.
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

# What a pass does. Of values it also measures how they differ.
NOTES, DECODES, MEASURES = 0, 1, 2
# What a coder's state holds, after the states of rANS.
PLACE, FAULT, PASS, TURN = 4, 5, 6, 7


class Coder(NamedTuple):
    """A stream that is noted or decoded: what kernels take."""

    state: Int64s  # the states, then PLACE … TURN
    # The words that are decoded, or notes: ``context << 8 | symbol``, contexts of all pools numbered through,
    # or for plain bits, which have an interval of their own, ``1 << 31 | start << 13 | size``.
    stream: Uint32s


class Pool(NamedTuple):
    """How symbols of some contexts are coded: what kernels take."""

    chosen: Uint8s  # (contexts,)   the table of each
    intervals: Uint32s  # (tables · 256,)   of a symbol: where it begins, and << 16 its frequency
    # To find a symbol, in few bytes, which stay in the fastest memory: where to look from, and of those that
    # occur, one after the other: where it begins, << 12 its frequency less one, << 24 the symbol.
    buckets: Uint8s  # (tables · 256,)   for each 16 of 4096
    occurring: Uint32s  # (tables · 256,)
    counts: Uint32s  # (contexts, symbols)   how often which occurred
    first: int  # of its contexts, when all pools' are numbered through


def new_coder(work: int, size: int) -> Coder:
    """Return a coder that begins, for a stream of so many notes or words."""
    return Coder(np.array([_LEAST] * STATES + [0, 0, work, 0], np.int64), np.empty(size, np.uint32))


def decoder(content: bytes) -> Coder:
    """Return a coder that reads a stream's bytes; a zero ends its words.

    The words begin with the states, low words first; there are none where all was certain.
    """
    words = np.frombuffer(content, "<u2", len(content) // 2)
    coder = new_coder(DECODES, words.size + 1)
    coder.stream[:-1], coder.stream[-1] = words, 0
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
def _note(note: int, coder: Coder) -> None:
    coder.stream[np.uint64(coder.state[PLACE])] = note
    coder.state[PLACE] += 1


@inlined
def _low(coder: Coder) -> int:
    """Return what says which symbol is next."""
    return wide(coder.state[coder.state[TURN] & (STATES - 1)] & (ONE - 1))


@inlined
def _take(start: int, size: int, coder: Coder) -> None:
    """Take a symbol's interval off a state."""
    turn = coder.state[TURN] & (STATES - 1)
    state = coder.state[turn]
    state = size * (state >> PRECISION) + (state & (ONE - 1)) - start
    # Whether a word is wanted is as good as random: a branch would be missed. Beyond the end PLACE tells.
    wants = wide(state < _LEAST)
    place = coder.state[PLACE]
    word = wide(coder.stream[np.uint64(min(place, coder.stream.size - 1))])
    coder.state[turn] = state << 16 * wants | word & -wants
    coder.state[PLACE] = place + wants
    coder.state[TURN] = (turn + 1) & (STATES - 1)


@inlined
def code_symbol(work: int, symbol: int, context: int, pool: Pool, coder: Coder) -> int:
    """Note and count, or decode a symbol in a context; return it. ``work`` is the coder's PASS."""
    if work != DECODES:
        pool.counts[np.uint64(context), np.uint64(symbol)] += 1
        _note((pool.first + context) << 8 | symbol, coder)
        return symbol
    found = _found(_low(coder), context, pool)
    _take(found & (ONE - 1), (found >> PRECISION & (ONE - 1)) + 1, coder)
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
def code_symbols(work: int, symbols: Int64s, contexts: Int64s, count: int, pool: Pool, coder: Coder) -> None:
    """Note and count, or decode so many symbols whose contexts are known before."""
    n, states = wide(0), coder.state
    if work == DECODES:
        turn, place = states[TURN], states[PLACE]
        a, b, c, d = states[turn], states[turn + 1 & 3], states[turn + 2 & 3], states[turn + 3 & 3]
        # Four states at once: none waits for another.
        while n + 4 <= count and place + 4 < coder.stream.size:
            a, place = _taken(a, place, n, symbols, contexts, pool, coder.stream)
            b, place = _taken(b, place, n + 1, symbols, contexts, pool, coder.stream)
            c, place = _taken(c, place, n + 2, symbols, contexts, pool, coder.stream)
            d, place = _taken(d, place, n + 3, symbols, contexts, pool, coder.stream)
            n += 4
        states[turn], states[turn + 1 & 3], states[turn + 2 & 3], states[turn + 3 & 3] = a, b, c, d
        states[PLACE] = place
    while n < count:
        at = np.uint64(n)
        symbols[at] = code_symbol(work, symbols[at], contexts[at], pool, coder)
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
def code_bits(value: int, count: int, coder: Coder) -> int:
    """Note or decode ``count`` bits, 0 to 36, any as likely as any; return them."""
    found = done = 0
    while done < count:
        some = min(count - done, PRECISION)
        if coder.state[PASS] == DECODES:
            part = _low(coder) >> (PRECISION - some)
            _take(part << (PRECISION - some), ONE >> some, coder)
        else:
            part = value >> done & ((1 << some) - 1)
            _note(1 << 31 | part << (PRECISION - some) << 13 | ONE >> some, coder)
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
            words[at] = state & 0xFFFF
            state >>= 16
        whole = np.uint32(state) // np.uint32(size)
        states[turn] = (wide(whole) << PRECISION) + state - wide(whole) * size + start
    if is_certain:
        return at
    for last in range(STATES - 1, -1, -1):
        at -= 2
        words[at] = states[last] & 0xFFFF
        words[at + 1] = states[last] >> 16
    return at


def encoded(notes: Uint32s, chosen: Uint32s, intervals: Uint32s) -> bytes:
    """Return the stream of notes; ``chosen`` and ``intervals`` are those of all pools."""
    words = np.empty(notes.size + 2 * STATES, np.uint16)  # an interval is 12 bits or less
    return words[_write_words(notes, chosen, intervals, words) :].astype("<u2").tobytes()


def intervals_of(pools: list[Pool]) -> tuple[Uint32s, Uint32s]:
    """Return the table of each context and the intervals of all pools, numbered through."""
    tables = np.cumsum([0, *(pool.intervals.size >> 8 for pool in pools[:-1])]).tolist()
    chosen = [pool.chosen.astype(np.uint32) + before for pool, before in zip(pools, tables, strict=True)]
    return np.concatenate(chosen), np.concatenate([pool.intervals for pool in pools])


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
    return Pool(chosen, intervals, buckets, occurring.reshape(-1), np.empty((0, 0), np.uint32), 0)


def counting_pool(contexts: int, symbols: int, first: int) -> Pool:
    """Return what kernels take to count symbols, in contexts that are numbered from ``first`` on."""
    none = pool_of(np.zeros(0, np.uint8), np.zeros((0, 256), np.int64))
    return none._replace(counts=np.zeros((contexts, symbols), np.uint32), first=first)


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
        table = wide(np.argmin(costs))
        chosen[context] = table
        total += costs[table]
        for i in range(begin, ends[context]):
            sums[table, symbols[i]] += counts[i]
        begin = ends[context]
    return total


def shared_tables(counts: Uint32s) -> tuple[Uint8s, Int64s]:
    """Return which table each context uses (contexts,), and frequencies (tables, 256).

    Contexts whose symbols are spread alike share a table (k-means); there are as many tables as make them
    and what they code smallest. Those that code most come first.
    """
    used = np.flatnonzero(counts.any(axis=1))
    chosen = np.zeros(len(counts), np.uint8)
    own = counts[used].astype(np.int64)
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
