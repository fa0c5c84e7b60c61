"""Sums over the surface in each cell, from the fragments up to the root, and the stored means.

Averages start as float64 sums for each *entry*, a (cell, facing) pair: a row of

    area · coverage · value, for each component (for the component `alpha`, area · coverage) …, and the area

in cell faces of the current level. Coverage is 1 without an alpha channel. The entries of a level are sorted
by cell, then facing. A cell has popcount(flags) rows, one for each facing in its flags.

Rows hold the components of all channels side by side, so that each fragment and each child is read once.
Means are stored channel by channel, so that each channel is encoded in one pass through memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Int64s, Uint8s, bit_counts, in_runs
from octex.channels import LEAST_COVERAGE, ChannelFormat
from octex.jit import inlined, kernel, popcount
from octex.tree.areas import area_code
from octex.tree.layout import POSITIVE_FACINGS


class SumColumns(NamedTuple):
    """The position of all channels' components in a row of values."""

    first: Int64s  # (components,)   the first column of each column's channel
    place: Int64s  # (components,)   each column's index in its channel
    width: Int64s  # (components,)   number of components of each column's channel
    alpha: int  # the column of coverage, or −1

    @classmethod
    def of(cls, channels: Sequence[ChannelFormat]) -> SumColumns:
        """Lay out channels side by side."""
        widths = np.array([channel.components for channel in channels], np.int64)
        firsts = np.cumsum(widths) - widths
        names = [channel.name for channel in channels]
        alpha = int(firsts[names.index("alpha")]) if "alpha" in names else -1
        first = np.repeat(firsts, widths)
        return cls(first, np.arange(len(first)) - first, np.repeat(widths, widths), alpha)


class Sums(NamedTuple):
    """The sums of the cells of one level."""

    codes: Int64s  # (cells,)   Morton codes, ascending
    flags: Uint8s  # (cells,)   normal flags
    sums: Float64s  # (entries, components + 1)


class Means(NamedTuple):
    """Means and areas of one level's cells, and of each facing in cells with two opposite facings.

    Values are stored channel by channel: a channel that begins at column f begins at f · rows.
    """

    values: Float64s  # (cells · components,)
    areas: Uint8s  # (cells,)
    two_sided: Int64s  # (cells with opposite facings,)   index into the level's cells
    facing_values: Float64s  # (their entries · components,)
    facing_areas: Uint8s  # (their entries,)


def by_channel(values: Float64s, channels: Sequence[ChannelFormat]) -> Iterator[Float64s]:
    """Yield each channel's values (rows, components), from values stored channel by channel."""
    rows = values.size // max(sum(channel.components for channel in channels), 1)
    end = 0
    for channel in channels:
        start, end = end, end + rows * channel.components
        yield values[start:end].reshape(rows, channel.components)


@kernel
def sum_fragments(entries: Int32s, areas: Float64s, values: Float32s, alpha: int, n_entries: int) -> Float64s:
    """Sum the fragments of each entry. ``alpha`` is the column of coverage, or −1."""
    components = values.shape[1]
    sums = np.empty((n_entries, components + 1), np.float64)
    cleared = 0
    for i in range(entries.size):
        row = entries[i]
        while cleared <= row:  # in step with the fragments, while the rows are in the cache
            for k in range(components + 1):
                sums[cleared, k] = 0.0
            cleared += 1
        area = areas[i]
        if alpha < 0:
            for k in range(components):
                sums[row, k] += area * np.float64(values[i, k])
        else:
            weight = area * max(np.float64(values[i, alpha]), LEAST_COVERAGE)
            for k in range(components):
                sums[row, k] += weight * (np.float64(values[i, k]) if k != alpha else 1.0)
        sums[row, components] += area
    return sums


@kernel
def sum_children(children: Sums) -> Sums:
    """Sum the cells of one level into their parents."""
    codes, flags, sums = children
    columns = sums.shape[1]
    parent_codes = np.empty(codes.size, np.int64)
    parent_flags = np.empty(codes.size, np.uint8)
    parent_sums = np.empty(sums.shape, np.float64)
    cells = 0
    entries = 0
    row = 0
    first = 0
    while first < codes.size:
        code = codes[first] >> 3
        facings = np.int64(0)
        last = first
        while last < codes.size and codes[last] >> 3 == code:
            facings |= np.int64(flags[last])
            last += 1
        if facings & (facings - 1) == 0:  # one facing, as almost everywhere: one row a child
            for k in range(columns):
                parent_sums[entries, k] = 0.25 * sums[row, k]
            for child in range(row + 1, row + last - first):
                for k in range(columns):
                    parent_sums[entries, k] += 0.25 * sums[child, k]
            row += last - first
        else:
            parent_sums[entries : entries + popcount(np.uint64(facings))] = 0.0
            for i in range(first, last):
                remaining = np.int64(flags[i])
                while remaining != 0:
                    facing = remaining & -remaining
                    remaining ^= facing
                    parent = entries + popcount(np.uint64(facings & (facing - 1)))
                    for k in range(columns):
                        parent_sums[parent, k] += 0.25 * sums[row, k]
                    row += 1
        parent_codes[cells] = code
        parent_flags[cells] = facings
        cells += 1
        entries += popcount(np.uint64(facings))
        first = last
    return Sums(parent_codes[:cells].copy(), parent_flags[:cells].copy(), parent_sums[:entries])


def coverages(level: Sums, alpha: int) -> Float64s:
    """Return the mean coverage (cells,) of a level; ``alpha`` is its column."""
    counts = bit_counts(level.flags).astype(np.int64)
    weights, areas = np.add.reduceat(level.sums[:, [alpha, -1]], np.cumsum(counts) - counts).T
    return np.asarray(weights / areas)


def sums_of(level: Sums, cells: Int64s) -> Sums:
    """Return the sums of cells (n,) of a level."""
    counts = bit_counts(level.flags).astype(np.int64)
    rows = in_runs((np.cumsum(counts) - counts)[cells], counts[cells])
    return Sums(level.codes[cells], level.flags[cells], level.sums.take(rows, axis=0))


@inlined
def _store_mean(
    sums: Float64s, entry: int, columns: SumColumns, starts: Int64s, values: Float64s, row: int
) -> None:
    components = sums.shape[1] - 1
    alpha = columns.alpha
    inverse = 1.0 / (sums[entry, components] if alpha < 0 else sums[entry, alpha])
    for k in range(components):
        # An unsigned index is not tested for counting from the end, which saves 3 ns a cell.
        values[np.uint64(starts[k] + row * columns.width[k])] = sums[entry, k] * inverse
    if alpha >= 0:
        values[starts[alpha] + row] = sums[entry, alpha] / sums[entry, components]


@kernel
def level_means(level: Sums, columns: SumColumns) -> Means:
    """Divide the sums of a level by its areas, weighted by coverage."""
    sums = level.sums
    components = sums.shape[1] - 1
    n_cells = level.codes.size
    n_two_sided = 0
    n_rows = 0
    for i in range(n_cells):
        facings = np.int64(level.flags[i])
        if facings & (facings >> 1) & POSITIVE_FACINGS:
            n_two_sided += 1
            n_rows += popcount(np.uint64(facings))
    values = np.empty(n_cells * components, np.float64)
    areas = np.empty(n_cells, np.uint8)
    two_sided = np.empty(n_two_sided, np.int64)
    facing_values = np.empty(n_rows * components, np.float64)
    starts = columns.first * n_cells + columns.place
    facing_starts = columns.first * n_rows + columns.place
    facing_areas = np.empty(n_rows, np.uint8)
    total = np.empty((1, components + 1), np.float64)
    zero = int(np.int64(0))  # not a literal, for which `_store_mean` would compile again
    entry = row = cell = zero
    for i in range(n_cells):
        facings = np.int64(level.flags[i])
        n_facings = popcount(np.uint64(facings))
        if n_facings == 1:
            areas[i] = area_code(sums[entry, components])
            _store_mean(sums, entry, columns, starts, values, i)
            entry += 1
            continue
        for k in range(components + 1):
            total[0, k] = 0.0
            for j in range(entry, entry + n_facings):
                total[0, k] += sums[j, k]
        areas[i] = area_code(total[0, components])
        _store_mean(total, zero, columns, starts, values, i)
        if facings & (facings >> 1) & POSITIVE_FACINGS:
            two_sided[cell] = i
            cell += 1
            for j in range(entry, entry + n_facings):
                facing_areas[row] = area_code(sums[j, components])
                _store_mean(sums, j, columns, facing_starts, facing_values, row)
                row += 1
        entry += n_facings
    return Means(values, areas, two_sided, facing_values, facing_areas)
