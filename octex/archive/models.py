"""What the coders of a texture are told: frequencies that contexts share, and weights; one list of numbers.

Pools stand in the order occupied octants, leaves, flags, areas, then each channel's values.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.archive import areas, structure
from octex.archive.coding import Coding, contexts_of
from octex.archive.entropy import ONE, TABLES, Pool, pool_of, shared_tables
from octex.archive.layout import FORMAT_VERSION
from octex.arrays import Int64s


class Models(NamedTuple):
    """How all is coded."""

    pools: list[Pool]
    codings: dict[str, Coding]
    version: int  # of the format

    def pool(self, name: str) -> Pool:
        """Return how a channel is coded."""
        return self.pools[4 + list(self.codings).index(name)]


def _sizes(codings: dict[str, Coding], version: int) -> list[tuple[int, int]]:
    """Return how many contexts and symbols each pool has."""
    leaves, symbols = structure.LEAVES
    fixed = [structure.OCCUPIED, (leaves - (version == 1), symbols), structure.FLAGS, (areas.CONTEXTS, 256)]
    return fixed + [(contexts_of(coding.order.size), 256) for coding in codings.values()]


def no_counts(codings: dict[str, Coding]) -> list[Int64s]:
    """Return counts of nothing."""
    return [np.zeros(size, np.int64) for size in _sizes(codings, FORMAT_VERSION)]


def counting(counts: list[Int64s], codings: dict[str, Coding]) -> Models:
    """Return what symbols are noted and counted with."""
    none = pool_of(np.zeros(0, np.uint8), np.zeros((0, 256), np.int64))
    firsts = np.cumsum([0, *map(len, counts)]).tolist()
    pools = [none._replace(counts=each, first=first) for each, first in zip(counts, firsts, strict=False)]
    return Models(pools, codings, FORMAT_VERSION)


def made(counts: list[Int64s], codings: dict[str, Coding]) -> tuple[Models, Int64s]:
    """Return the models for what was counted, and the numbers that say them."""
    pools, numbers = [], []
    for each in counts:
        chosen, sizes = shared_tables(each)
        pools.append(pool_of(chosen, sizes))
        numbers += [np.array([len(sizes)]), chosen, sizes.reshape(-1)]
    for coding in codings.values():
        signed = coding.weights
        numbers.append(np.where(signed < 0, -2 * signed - 1, 2 * signed))
    return Models(pools, codings, FORMAT_VERSION), np.concatenate(numbers).astype(np.int64)


def most_numbers(codings: dict[str, Coding], version: int) -> int:
    """Return the most numbers that models of such channels have."""
    weights = sum(coding.weights.size for coding in codings.values())
    return weights + sum(1 + contexts + TABLES * 256 for contexts, _ in _sizes(codings, version))


def read(numbers: Int64s, codings: dict[str, Coding], version: int) -> Models:
    """Return what numbers say; raises ValueError for what no archive holds."""
    at = 0

    def take(count: int) -> Int64s:
        nonlocal at
        at += count
        if at > numbers.size:
            raise ValueError
        return numbers[at - count : at]

    pools = []
    for contexts, _ in _sizes(codings, version):
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
    return Models(pools, found, version)
