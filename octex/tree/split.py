"""The split table, read and changed: a row for each facing of each split cell; see layout."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Int64s, Uint8s, bit_counts, in_runs
from octex.tree.areas import shared_codes
from octex.tree.layout import FACING_FLAGS, SplitTable


class Rows(NamedTuple):
    """Rows of the split table, ascending."""

    rows: Int64s  # (n,)
    cells: Int64s  # (n,)   the cell of each
    bits: Uint8s  # (n,)   their facings, as flags

    def of(self, chosen: Bools | slice) -> Rows:
        """Select rows."""
        return Rows(self.rows[chosen], self.cells[chosen], self.bits[chosen])


def bits_of(facings: Uint8s) -> Uint8s:
    """Return the facings of cells one by one, as flags, in the order of their bits."""
    bits = np.uint8(1) << np.arange(6, dtype=np.uint8)
    chosen = facings[:, None] & bits
    found: Uint8s = chosen[chosen != 0]
    return found


def counts_of(facings: Uint8s) -> Int64s:
    """Return the number of rows of cells with these facings."""
    counts: Int64s = bit_counts(facings & np.uint8(FACING_FLAGS)).astype(np.int64)
    return counts


def rows_of(split: SplitTable, cells: Int64s | None = None) -> Rows:
    """Return all rows, or those of the split ones among ``cells``, ascending."""
    chosen = np.arange(split.cells.size)
    if cells is not None:
        split_cells = split.cells.astype(np.int64)
        few, many = (split_cells, cells) if split_cells.size < cells.size else (cells, split_cells)
        shared = few[many[np.minimum(np.searchsorted(many, few), many.size - 1)] == few] if few.size else few
        chosen = np.searchsorted(split_cells, shared)
    counts = counts_of(split.facings)
    firsts, counts = (np.cumsum(counts) - counts)[chosen], counts[chosen]
    owners = np.repeat(split.cells[chosen].astype(np.int64), counts)
    return Rows(in_runs(firsts, counts), owners, bits_of(split.facings[chosen]))


def find_rows(split: SplitTable, cells: Int64s, bits: Uint8s) -> tuple[Bools, Int64s]:
    """Return which cells (n,) have a row for a facing, and these rows."""
    if not split.cells.size:
        return np.zeros(cells.size, np.bool_), np.empty(0, np.int64)
    at = np.minimum(np.searchsorted(split.cells, cells.astype(np.uint32)), split.cells.size - 1)
    there = (split.cells[at] == cells) & (split.facings[at] & bits != 0)
    counts = counts_of(split.facings)
    rows = (np.cumsum(counts) - counts)[at] + bit_counts(split.facings[at] & (bits - np.uint8(1)))
    return there, rows[there]


def taken(split: SplitTable, numbers: Int64s) -> tuple[SplitTable, Bools]:
    """Return the table of the split cells with new numbers, −1 for dropped ones, and their rows as a mask.

    ``numbers`` (split cells,) ascend.
    """
    stays = numbers >= 0
    rows = np.repeat(stays, counts_of(split.facings))
    return SplitTable(numbers[stays].astype(np.uint32), split.facings[stays], split.areas[rows]), rows


def inserted(
    split: SplitTable, cells: Int64s, facings: Uint8s, areas: Uint8s
) -> tuple[SplitTable, Int64s, Rows]:
    """Return a table in which ascending cells (n,) are split, again if they are already.

    Existing rows keep their areas; others get even parts of the cells' ``areas`` (n,), as codes. Also returns
    the order of all rows, first the remaining ones, then those of these cells; and the latter, by their
    numbers in ``split``, −1 for new ones.
    """
    at = np.minimum(np.searchsorted(cells, split.cells), max(cells.size - 1, 0))
    stays = cells[at] != split.cells if cells.size else np.ones(split.cells.size, np.bool_)
    rest, _ = taken(split, np.where(stays, split.cells.astype(np.int64), -1))
    counts = counts_of(facings)
    owners, bits = np.repeat(cells, counts), bits_of(facings)
    there, known = find_rows(split, owners, bits)
    own_areas = np.repeat(shared_codes(areas, counts), counts)
    own_areas[there] = split.areas[known]
    rows = np.full(owners.size, -1, np.int64)
    rows[there] = known
    order = np.argsort(np.concatenate([rest.cells, cells]), kind="stable")
    old_owners = np.repeat(rest.cells, counts_of(rest.facings))
    row_order = np.argsort(np.concatenate([old_owners, owners]), kind="stable")
    table = SplitTable(
        np.concatenate([rest.cells, cells]).astype(np.uint32)[order],
        np.concatenate([rest.facings, facings])[order],
        np.concatenate([rest.areas, own_areas])[row_order],
    )
    return table, row_order, Rows(rows, owners, bits)
