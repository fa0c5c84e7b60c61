"""What the coders of a texture are told: frequencies that contexts share, and weights.

Pools stand in the order occupied octants, leaves, flags, areas, then each channel's values. All is one list
of numbers. Of zeros in a row only one is written, and after all numbers, whose count comes first, how many
more there are of each. A number is bytes of seven bits, the lowest first; all but the last have the eighth.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.archive import areas, structure
from octex.archive.coding import Coding, contexts_of
from octex.archive.entropy import ONE, TABLES, Pool, counting_pool, pool_of, shared_tables
from octex.arrays import Int64s, Uint32s

#: The most bytes of a number: 28 bits.
_BYTES = 4


class Models(NamedTuple):
    """How all is coded."""

    pools: list[Pool]
    codings: dict[str, Coding]

    def pool(self, name: str) -> Pool:
        """Return how a channel is coded."""
        return self.pools[4 + list(self.codings).index(name)]


def sizes_of(codings: dict[str, Coding]) -> list[tuple[int, int]]:
    """Return how many contexts and symbols each pool has."""
    fixed = [structure.OCCUPIED, structure.LEAVES, structure.FLAGS, (areas.CONTEXTS, 256)]
    return fixed + [(contexts_of(coding.form.components), 256) for coding in codings.values()]


def counting(codings: dict[str, Coding]) -> Models:
    """Return what symbols are noted and counted with."""
    pools, first = [], 0
    for contexts, symbols in sizes_of(codings):
        pools.append(counting_pool(contexts, symbols, first))
        first += contexts
    return Models(pools, codings)


def made(counts: list[Uint32s], codings: dict[str, Coding]) -> tuple[Models, bytes]:
    """Return the models for what was counted, and the bytes that say them."""
    pools, numbers = [], []
    for each in counts:
        chosen, sizes = shared_tables(each)
        pools.append(pool_of(chosen, sizes))
        numbers += [np.array([len(sizes)]), chosen, sizes.reshape(-1)]
    for coding in codings.values():
        signed = coding.weights
        numbers.append(np.where(signed < 0, -2 * signed - 1, 2 * signed))
    return Models(pools, codings), as_bytes(np.concatenate(numbers).astype(np.int64))


def as_bytes(numbers: Int64s) -> bytes:
    """Return the bytes of numbers."""
    is_zero = numbers == 0
    written = np.flatnonzero(~is_zero | np.diff(is_zero, prepend=False))
    more = np.diff(written, append=numbers.size)[is_zero[written]] - 1
    said = np.concatenate([[written.size], numbers[written], more])
    parts = said[:, None] >> 7 * np.arange(_BYTES + 1)
    is_more, is_there = parts[:, 1:] > 0, parts[:, :-1] > 0
    is_there[:, 0] = True
    return (parts[:, :-1] & 127 | is_more << 7)[is_there].astype(np.uint8).tobytes()


def numbers_in(content: bytes, most: int) -> Int64s:
    """Return the numbers of bytes; raises ValueError for what are none, or more than ``most``."""
    found = np.frombuffer(content, np.uint8)
    lengths = np.diff(np.flatnonzero(found < 128), prepend=-1)
    if lengths.sum() != found.size or not 0 < lengths.max(initial=0) <= _BYTES:
        raise ValueError
    firsts = np.cumsum(lengths) - lengths
    said = np.zeros(lengths.size, np.int64)
    for n in range(_BYTES):
        is_long = lengths > n
        said[is_long] |= (found[firsts[is_long] + n] & np.int64(127)) << 7 * n
    numbers, more = np.split(said[1:], said[:1])
    times = np.ones(numbers.size, np.int64)
    if more.size != np.count_nonzero(numbers == 0):
        raise ValueError
    times[numbers == 0] += more
    if times.sum() > most:
        raise ValueError
    return np.repeat(numbers, times)


def read(content: bytes, codings: dict[str, Coding]) -> Models:
    """Return the models that bytes say; raises ValueError for what no archive holds."""
    most = sum(1 + contexts + TABLES * 256 for contexts, _ in sizes_of(codings))
    most += sum(coding.weights.size for coding in codings.values())
    numbers, at = numbers_in(content, most), 0

    def take(count: int) -> Int64s:
        nonlocal at
        at += count
        if at > numbers.size:
            raise ValueError
        return numbers[at - count : at]

    pools = []
    for contexts, _ in sizes_of(codings):
        count = int(take(1)[0])
        chosen = take(contexts)
        if not 1 <= count <= TABLES or (chosen >= count).any():
            raise ValueError
        sizes = take(count * 256).reshape(count, 256)
        if (sizes > ONE).any() or (sizes.sum(axis=1) != ONE).any():
            raise ValueError
        pools.append(pool_of(chosen.astype(np.uint8), sizes))
    found = {}
    for name, coding in codings.items():
        folded = take(coding.weights.size)
        if (folded > 1 << 17).any():
            raise ValueError
        found[name] = coding._replace(weights=np.where(folded & 1, -(folded + 1 >> 1), folded >> 1))
    if at != numbers.size:
        raise ValueError
    return Models(pools, found)
