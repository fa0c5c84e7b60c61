"""The split table, read and changed: a row for each facing of each split cell; see layout."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Bools, Int64s, Uint8s, bit_counts, in_runs
from octex.tree.layout import AREA_STEPS, FACING_FLAGS, SplitTable


class Rows(NamedTuple):
    """Rows of the split table, ascending."""

    rows: Int64s  # (n,)
    cells: Int64s  # (n,)   the cell of each
    bits: Uint8s  # (n,)   their facings, as flags

    def of(self, chosen: Bools | slice) -> Rows:
        """Select rows."""
        return Rows(self.rows[chosen], self.cells[chosen], self.bits[chosen])


def bits_of(facings: Uint8s) -> Uint8s:
    """Return a flag for each facing of cells (n,), cell after cell, in the order of the bits."""
    bits = facings[:, None] & np.uint8(1) << np.arange(6, dtype=np.uint8)
    return np.asarray(bits[bits != 0], np.uint8)


def counts_of(facings: Uint8s) -> Int64s:
    """Return the number of rows of cells with these facings."""
    counts: Int64s = bit_counts(facings & np.uint8(FACING_FLAGS)).astype(np.int64)
    return counts


def shared_codes(codes: Uint8s, parts: npt.ArrayLike) -> Uint8s:
    """Return the codes of areas (n,) divided evenly into ``parts``, each 1 at least."""
    steps = np.rint(codes - AREA_STEPS * np.log2(np.maximum(parts, 1)))
    return np.where(codes > 0, np.clip(steps, 1, 255), 0).astype(np.uint8)


def rows_of(split: SplitTable, cells: Int64s | None = None) -> Rows:
    """Return all rows, or those of the split ones among ``cells``, ascending."""
    entries = np.arange(split.cells.size)
    if cells is not None:
        split_cells = split.cells.astype(np.int64)
        few, many = (split_cells, cells) if split_cells.size < cells.size else (cells, split_cells)
        shared = few[many[np.minimum(np.searchsorted(many, few), many.size - 1)] == few] if few.size else few
        entries = np.searchsorted(split_cells, shared)
    counts = counts_of(split.facings)
    firsts, counts = (np.cumsum(counts) - counts)[entries], counts[entries]
    owners = np.repeat(split.cells[entries].astype(np.int64), counts)
    return Rows(in_runs(firsts, counts), owners, bits_of(split.facings[entries]))


def find_rows(split: SplitTable, cells: Int64s, bits: Uint8s) -> tuple[Bools, Int64s]:
    """Return which cells (n,) have a row for a facing, and these rows."""
    if not split.cells.size:
        return np.zeros(cells.size, np.bool_), np.empty(0, np.int64)
    entries = np.minimum(np.searchsorted(split.cells, cells.astype(np.uint32)), split.cells.size - 1)
    has_row = (split.cells[entries] == cells) & (split.facings[entries] & bits != 0)
    counts = counts_of(split.facings)
    rows = (np.cumsum(counts) - counts)[entries] + bit_counts(split.facings[entries] & (bits - np.uint8(1)))
    return has_row, rows[has_row]


def taken(split: SplitTable, numbers: Int64s) -> tuple[SplitTable, Bools]:
    """Return the table of the split cells with new numbers, −1 for dropped ones, and their rows as a mask.

    ``numbers`` (split cells,) ascend.
    """
    is_taken = numbers >= 0
    rows = np.repeat(is_taken, counts_of(split.facings))
    return SplitTable(numbers[is_taken].astype(np.uint32), split.facings[is_taken], split.areas[rows]), rows


def inserted(
    split: SplitTable, cells: Int64s, facings: Uint8s, areas: Uint8s
) -> tuple[SplitTable, Int64s, Rows]:
    """Return a table in which ascending cells (n,) are split, again if they are already.

    Existing rows keep their areas; others get even parts of the cells' ``areas`` (n,), as codes. Also returns
    the order of all rows, first the remaining ones, then those of these cells; and the latter, by their
    numbers in ``split``, −1 for new ones.
    """
    entries = np.minimum(np.searchsorted(cells, split.cells), max(cells.size - 1, 0))
    is_other = cells[entries] != split.cells if cells.size else np.ones(split.cells.size, np.bool_)
    others, _ = taken(split, np.where(is_other, split.cells.astype(np.int64), -1))
    counts = counts_of(facings)
    owners, bits = np.repeat(cells, counts), bits_of(facings)
    has_row, old_rows = find_rows(split, owners, bits)
    row_areas = np.repeat(shared_codes(areas, counts), counts)
    row_areas[has_row] = split.areas[old_rows]
    rows = np.full(owners.size, -1, np.int64)
    rows[has_row] = old_rows
    cell_order = np.argsort(np.concatenate([others.cells, cells]), kind="stable")
    old_owners = np.repeat(others.cells, counts_of(others.facings))
    row_order = np.argsort(np.concatenate([old_owners, owners]), kind="stable")
    table = SplitTable(
        np.concatenate([others.cells, cells]).astype(np.uint32)[cell_order],
        np.concatenate([others.facings, facings])[cell_order],
        np.concatenate([others.areas, row_areas])[row_order],
    )
    return table, row_order, Rows(rows, owners, bits)
