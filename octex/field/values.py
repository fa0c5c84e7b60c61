"""Stored values as kernels read them: decoded, row by row."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import ChannelValues, Float32s, Floats
from octex.jit import by_constants, decoded, inlined, part

Four = tuple[float, float, float, float]
#: Four components under weights, and the sum of the weights.
Five = tuple[float, float, float, float, float]
NO_FIVE = 0.0, 0.0, 0.0, 0.0, 0.0


class Codes(NamedTuple):
    """A channel as it is stored, and what its codes stand for."""

    values: ChannelValues  # (cells, components)
    kept_values: ChannelValues  # (kept nodes, components)
    split_values: ChannelValues  # (split rows, components)
    #: (codes,)   the decoded values, float64 for 8 bits, which saves an instruction each; empty for float32
    table: Floats


class Flat(NamedTuple):
    """`Codes` as kernels read them."""

    values: ChannelValues
    kept: ChannelValues
    split: ChannelValues
    table: Floats
    first_kept: int
    first_row: int


@part
def flat_of(codes: Codes) -> Flat:
    """Flatten the values."""
    n_cells = codes.values.shape[0]
    return Flat(
        codes.values.reshape(-1),
        codes.kept_values.reshape(-1),
        codes.split_values.reshape(-1),
        codes.table,
        n_cells,
        n_cells + codes.kept_values.shape[0],
    )


@by_constants
@inlined
def value_at(values: ChannelValues, table: Floats, at: np.uint64, components: int) -> Four:
    """Return the decoded components from a place of some values on, and zeros after them."""
    a = np.float64(decoded(table, values[at]))
    b = c = d = 0.0
    if components > 1:
        b = np.float64(decoded(table, values[at + np.uint64(1)]))
    if components > 2:
        c = np.float64(decoded(table, values[at + np.uint64(2)]))
    if components > 3:
        d = np.float64(decoded(table, values[at + np.uint64(3)]))
    return a, b, c, d


@inlined
def put_value(results: Float32s, at: int, components: int, a: float, b: float, c: float, d: float) -> None:
    """Write components to flat results from a place on."""
    results[np.uint64(at)] = a
    if components > 1:
        results[np.uint64(at + 1)] = b
    if components > 2:
        results[np.uint64(at + 2)] = c
    if components > 3:
        results[np.uint64(at + 3)] = d


@by_constants
@inlined
def value_of(flat: Flat, row: int, components: int) -> Four:
    """Return the decoded components of a row: by branches, as most rows are cells."""
    if row < flat.first_kept:
        return value_at(flat.values, flat.table, np.uint64(row * components), components)
    if row < flat.first_row:
        return value_at(flat.kept, flat.table, np.uint64((row - flat.first_kept) * components), components)
    row = min(row - flat.first_row, flat.split.size // components - 1)
    return value_at(flat.split, flat.table, np.uint64(row * components), components)


@by_constants
@inlined
def with_row(five: Five, flat: Flat, row: int, weight: np.float32, components: int) -> Five:
    """Add a row times a weight to four components, and the weight to the fifth."""
    factor = np.float64(weight)
    a, b, c, d = value_of(flat, row, components)
    return (
        five[0] + factor * a,
        five[1] + factor * b,
        five[2] + factor * c,
        five[3] + factor * d,
        five[4] + factor,
    )
