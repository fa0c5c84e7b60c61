"""What the coders of a texture are told: chances, tables of frequencies, weights; one list of numbers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from octex.archive import areas, structure, values
from octex.archive.entropy import ONE, Tables, normalized
from octex.arrays import Int64s, Uint16s


class Counts(NamedTuple):
    """How often what occurs."""

    bits: Int64s  # (structure.CONTEXTS, 2)
    areas: Int64s  # (areas.CONTEXTS, 256)
    channels: dict[str, Int64s]  # (SETS · components · CONTEXTS, 256)

    def add(self, other: Counts) -> None:
        """Add other counts."""
        self.bits[:] += other.bits
        self.areas[:] += other.areas
        for name, counts in other.channels.items():
            self.channels[name][:] += counts


class ChannelModel(NamedTuple):
    """How a channel's values are coded."""

    coding: values.Coding
    tables: Tables


class Models(NamedTuple):
    """How all is coded."""

    chances: Int64s  # (structure.CONTEXTS,)
    area_tables: Uint16s  # (areas.CONTEXTS,)   which of these each context uses
    areas: Tables
    channels: dict[str, ChannelModel]


def no_counts(codings: dict[str, values.Coding]) -> Counts:
    """Return counts of nothing."""
    return Counts(
        np.zeros((structure.CONTEXTS, 2), np.int64),
        np.zeros((areas.CONTEXTS, 256), np.int64),
        {name: np.zeros((_tables_of(coding), 256), np.int64) for name, coding in codings.items()},
    )


def _tables_of(coding: values.Coding) -> int:
    return values.SETS * coding.order.size * values.CONTEXTS


def uncounted(codings: dict[str, values.Coding]) -> Models:
    """Return what is counted with: each context of areas has its own row."""
    none = Tables(np.zeros((0, 256), np.int64))
    channels = {name: ChannelModel(coding, none) for name, coding in codings.items()}
    own = np.arange(areas.CONTEXTS, dtype=np.uint16)
    return Models(np.zeros(structure.CONTEXTS, np.int64), own, none, channels)


def made(counts: Counts, codings: dict[str, values.Coding]) -> tuple[Models, Int64s]:
    """Return the models for what was counted, and the numbers that say them."""
    steps = structure.chances_of(counts.bits)
    chosen = areas.shared_tables(counts.areas)
    shared = np.zeros((areas.TABLES, 256), np.int64)
    np.add.at(shared, chosen, counts.areas)
    sizes = normalized(shared)
    numbers = [_runs(steps), _runs(chosen.astype(np.int64)), _listed(sizes)]
    channels = {}
    for name, coding in codings.items():
        own = normalized(counts.channels[name])
        channels[name] = ChannelModel(coding, Tables(own))
        numbers += [_folded(coding.weights.reshape(-1)), _listed(own)]
    models = Models(structure.chances_from(steps), chosen, Tables(sizes), channels)
    return models, np.concatenate(numbers)


def most_numbers(codings: dict[str, values.Coding]) -> int:
    """Return more numbers than any models of such channels have."""
    tables = areas.TABLES + sum(map(_tables_of, codings.values()))
    weights = sum(coding.weights.size for coding in codings.values())
    return 2 * (structure.CONTEXTS + areas.CONTEXTS + 257 * tables) + weights


class Numbers:
    """Numbers that are read from the first to the last; beyond the last it raises ValueError."""

    def __init__(self, numbers: Int64s) -> None:
        self._numbers: list[int] = numbers.tolist()
        self._at = 0

    def next(self) -> int:
        """Return the next number."""
        if self._at == len(self._numbers):
            raise ValueError
        self._at += 1
        return self._numbers[self._at - 1]

    def take(self, count: int) -> Int64s:
        """Return the next numbers."""
        return np.array([self.next() for _ in range(count)], np.int64)

    def at_end(self) -> bool:
        """Say whether none is left."""
        return self._at == len(self._numbers)


def read(numbers: Numbers, codings: dict[str, values.Coding]) -> Models:
    """Return what numbers say; raises ValueError for what no archive holds."""
    steps = _from_runs(numbers, structure.CONTEXTS)
    chosen = _from_runs(numbers, areas.CONTEXTS)
    if (chosen >= areas.TABLES).any():
        raise ValueError
    area_tables = Tables(_from_list(numbers, areas.TABLES))
    channels = {}
    for name, coding in codings.items():
        weights = _unfolded(numbers.take(coding.weights.size)).reshape(coding.weights.shape)
        if (np.abs(weights) > 1 << 16).any():
            raise ValueError
        tables = Tables(_from_list(numbers, _tables_of(coding)))
        channels[name] = ChannelModel(coding._replace(weights=weights), tables)
    if not numbers.at_end():
        raise ValueError
    return Models(structure.chances_from(steps), chosen.astype(np.uint16), area_tables, channels)


def _folded(signed: Int64s) -> Int64s:
    """Return numbers of either sign as numbers without: 0, −1, 1, −2 … as 0, 1, 2, 3 …."""
    return np.where(signed < 0, -2 * signed - 1, 2 * signed)


def _unfolded(numbers: Int64s) -> Int64s:
    return np.where(numbers & 1, -(numbers + 1 >> 1), numbers >> 1)


def _runs(numbers: Int64s) -> Int64s:
    """Return numbers with each run of zeros as a zero and how many more there are."""
    return np.array(list(_each_run(numbers.tolist())), np.int64)


def _each_run(numbers: list[int]) -> Iterator[int]:
    at = 0
    while at < len(numbers):
        yield numbers[at]
        at += 1
        if numbers[at - 1] == 0:
            begin = at
            while at < len(numbers) and numbers[at] == 0:
                at += 1
            yield at - begin


def _from_runs(numbers: Numbers, count: int) -> Int64s:
    found = np.zeros(count, np.int64)
    at = 0
    while at < count:
        number = numbers.next()
        found[at] = number
        at += 1
        if number == 0:
            at += numbers.next()
    if at != count:
        raise ValueError
    return found


def _listed(sizes: Int64s) -> Int64s:
    """Return tables: of each the number of its symbols up to the last that occurs, and their runs.

    Symbols are small numbers of either sign, folded; the frequency of the last is what is left of 4096.
    """
    numbers: list[int] = []
    for row in sizes:
        used = np.flatnonzero(row)
        count = int(used[-1]) + 1 if used.size else 0
        numbers.append(count)
        numbers += _each_run(row[: max(count - 1, 0)].tolist())
    return np.array(numbers, np.int64)


def _from_list(numbers: Numbers, count: int) -> Int64s:
    found = np.zeros((count, 256), np.int64)
    for row in found:
        used = numbers.next()
        if used > 256:
            raise ValueError
        if used:
            row[: used - 1] = _from_runs(numbers, used - 1)
            rest = ONE - int(row.sum())
            if not 0 < rest <= ONE:
                raise ValueError
            row[used - 1] = rest
    return found
