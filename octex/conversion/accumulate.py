"""Sums over the surface in each cell, from the pieces up to the root, and what is stored of them.

Everything that is averaged is kept as float64 sums for each *entry*, a (cell, facing) pair: a row of

    area · coverage · value for each component …, with area · coverage for the component `alpha`, and last the area

in units of the faces of the level at hand. Coverage is 1 where the model has no alpha. The entries of a level are
sorted by cell, then facing; a cell's flags say which facings it has, so a cell is `popcount(flags)` rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.jit import kernel, popcount
from octex.tree.layout import AREA_ONE, AREA_STEPS, FACING_FLAGS, FACINGS, POSITIVE_FACINGS, SPLIT

#: Where nothing covers a cell its colour is still the mean of what the source holds there.
LEAST_COVERAGE = 2.0**-40
#: Areas below this many faces come from contacts alone and are stored as none.
LEAST_AREA = 2.0**-40


class Sums(NamedTuple):
    """The sums of one level's cells."""

    codes: npt.NDArray[np.int64]  # (cells,)   Morton codes, ascending
    flags: npt.NDArray[np.uint8]  # (cells,)   normal flags
    sums: npt.NDArray[np.float64]  # (entries, components + 1)


class Means(NamedTuple):
    """What is stored of one level's cells; the last three have a row for each entry of a split cell."""

    flags: npt.NDArray[np.uint8]  # (cells,)   normal flags, and SPLIT
    values: npt.NDArray[np.float64]  # (cells, components)
    areas: npt.NDArray[np.uint8]  # (cells,)
    split_cells: npt.NDArray[np.int64]  # (rows,)   index into the level's cells
    split_facings: npt.NDArray[np.uint8]  # (rows,)
    split_values: npt.NDArray[np.float64]  # (rows, components)
    split_areas: npt.NDArray[np.uint8]  # (rows,)


@kernel
def sum_pieces(
    entries: npt.NDArray[np.int32],
    areas: npt.NDArray[np.float64],
    values: npt.NDArray[np.float32],
    alpha: int,
    n_entries: int,
) -> npt.NDArray[np.float64]:
    """Add up the pieces of each entry. ``alpha`` is the component that holds coverage, or −1."""
    components = values.shape[1]
    sums = np.zeros((n_entries, components + 1), np.float64)
    for i in range(entries.size):
        row = entries[i]
        area = areas[i]
        weight = area
        if alpha >= 0:
            weight = area * max(np.float64(values[i, alpha]), LEAST_COVERAGE)
        for k in range(components):
            sums[row, k] += weight if k == alpha else weight * np.float64(values[i, k])
        sums[row, components] += area
    return sums


@kernel
def sum_children(children: Sums) -> Sums:
    """Add up the cells of one level into their parents."""
    codes, flags, sums = children
    columns = sums.shape[1]
    parent_codes = np.empty(codes.size, np.int64)
    parent_flags = np.empty(codes.size, np.uint8)
    parent_sums = np.zeros(sums.shape, np.float64)
    cells = 0
    entries = 0
    row = 0
    first = 0
    while first < codes.size:
        code = codes[first] >> 3
        seen = np.int64(0)
        last = first
        while last < codes.size and codes[last] >> 3 == code:
            seen |= np.int64(flags[last])
            last += 1
        for i in range(first, last):
            for facing in range(FACINGS):
                if (np.int64(flags[i]) >> facing) & 1:
                    parent = entries + popcount(np.uint64(seen & ((1 << facing) - 1)))
                    for k in range(columns):
                        parent_sums[parent, k] += 0.25 * sums[row, k]
                    row += 1
        parent_codes[cells] = code
        parent_flags[cells] = seen
        cells += 1
        entries += popcount(np.uint64(seen))
        first = last
    return Sums(parent_codes[:cells].copy(), parent_flags[:cells].copy(), parent_sums[:entries].copy())


@kernel
def _coded_area(area: float) -> int:
    if area < LEAST_AREA:
        return 0
    return min(max(np.int64(np.rint(AREA_STEPS * np.log2(area))) + AREA_ONE, 1), 255)


@kernel
def _store_mean(
    total: npt.NDArray[np.float64], alpha: int, values: npt.NDArray[np.float64], row: int
) -> None:
    components = total.size - 1
    weight = total[components] if alpha < 0 else total[alpha]
    for k in range(components):
        values[row, k] = total[k] / (total[components] if k == alpha else weight)


@kernel
def level_means(level: Sums, alpha: int) -> Means:
    """Divide the sums of a level; a cell that shows both ways along an axis is split."""
    columns = level.sums.shape[1]
    n_cells = level.codes.size
    n_rows = 0
    for i in range(n_cells):
        seen = np.int64(level.flags[i])
        if seen & (seen >> 1) & POSITIVE_FACINGS:
            n_rows += popcount(np.uint64(seen))
    flags = np.empty(n_cells, np.uint8)
    values = np.empty((n_cells, columns - 1), np.float64)
    areas = np.empty(n_cells, np.uint8)
    split_cells = np.empty(n_rows, np.int64)
    split_facings = np.empty(n_rows, np.uint8)
    split_values = np.empty((n_rows, columns - 1), np.float64)
    split_areas = np.empty(n_rows, np.uint8)
    total = np.empty(columns, np.float64)
    entry = 0
    row = 0
    for i in range(n_cells):
        seen = np.int64(level.flags[i]) & FACING_FLAGS
        is_split = seen & (seen >> 1) & POSITIVE_FACINGS
        total[:] = 0.0
        for facing in range(FACINGS):
            if (seen >> facing) & 1:
                for k in range(columns):
                    total[k] += level.sums[entry, k]
                if is_split:
                    split_cells[row] = i
                    split_facings[row] = facing
                    split_areas[row] = _coded_area(level.sums[entry, columns - 1])
                    _store_mean(level.sums[entry], alpha, split_values, row)
                    row += 1
                entry += 1
        flags[i] = seen | (SPLIT if is_split else 0)
        areas[i] = _coded_area(total[columns - 1])
        _store_mean(total, alpha, values, i)
    return Means(flags, values, areas, split_cells, split_facings, split_values, split_areas)
