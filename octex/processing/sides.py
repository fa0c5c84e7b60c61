"""What each of two textures has in the cells of their union."""

from __future__ import annotations

from concurrent.futures import Executor
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Int64s, Uint8s
from octex.channels import decode
from octex.editing.averages import Residuals, residuals_at
from octex.editing.nodes import Nodes
from octex.editing.refined import refined_below, refined_rows
from octex.editing.split import rows_facing
from octex.processing.union import NOTHING, Origins
from octex.texture import OctreeTexture
from octex.tree.edit import among
from octex.tree.layout import KEPT, SPLIT
from octex.tree.split import Rows, find_rows


class Cells(NamedTuple):
    """The cells of a union."""

    codes: Int64s  # (cells,)
    facings: Uint8s  # (cells,)
    levels: Int64s  # (max_depth + 2,)   the first cell of each level, then their number


class Side:
    """One of the textures; without ``cells`` it has nothing of its own below its leaves."""

    def __init__(
        self, texture: OctreeTexture, origins: Origins, cells: Cells | None, executor: Executor
    ) -> None:
        self.texture, self.origins = texture, origins
        self._cells = cells
        self._below = np.empty(0, np.int64)
        self._refined: dict[str, Float32s] = {}
        self._is_split = np.empty(0, np.bool_)
        if cells is not None:
            self._refine(cells, executor)

    def _refine(self, cells: Cells, executor: Executor) -> None:
        """Find values below leaves."""
        self._below = np.flatnonzero(self.origins.cells < NOTHING)
        parts = [
            refined_below(self.texture, cells.codes[own], level, cells.facings[own], executor)
            for level, own in enumerate(_by_level(self._below, cells.levels))
        ]
        self._is_split = np.concatenate([each.is_split for each in parts])
        self._refined = {
            name: np.concatenate([each.values[name] for each in parts]) for name in self.texture.channels
        }

    def has(self, cells: Int64s) -> Bools:
        """Say which cells (n,) of the union there is something in."""
        found: Bools = self.origins.cells[cells] != NOTHING
        return found

    def values(self, cells: Int64s) -> dict[str, Float32s]:
        """Return the values of cells (n,), decoded: own ones, or refined ones; of others, any."""
        where = self.origins.cells[cells]
        below = np.flatnonzero(where < NOTHING) if self._below.size else np.empty(0, np.int64)
        rows = np.searchsorted(self._below, cells[below])
        found = {}
        for name, channel in self.texture.channels.items():
            found[name] = decode(channel.values[np.maximum(where, 0)], channel.format.space)
            if below.size:
                found[name][below] = self._refined[name][rows]
        return found

    def coefficients(self, nodes: Int64s) -> dict[str, Float32s]:
        """Return what nodes (n,) keep or could keep, decoded: values, but for those of kept nodes."""
        found, own = self.values(nodes), self.origins.cells[nodes]
        cells = self.texture.tree.kept.cells.astype(np.int64)
        kept = np.flatnonzero(among(own, cells))
        rows = np.searchsorted(cells, own[kept])
        for name, channel in self.texture.channels.items():
            found[name][kept] = decode(channel.kept_values[rows], channel.format.space)
        return found

    def rows(self, cells: Int64s, bits: Uint8s) -> dict[str, Float32s]:
        """Return what cells (n,), ascending, show facings, decoded."""
        found, where = self.values(cells), self.origins.cells[cells]
        own, below = np.flatnonzero(where > NOTHING), np.flatnonzero(where < NOTHING)
        for name, channel in self.texture.channels.items():
            found[name][own] = rows_facing(self.texture, channel, where[own], bits[own])
        if self._cells is not None:
            for level, here in enumerate(_by_level(cells[below], self._cells.levels)):
                chosen = below[np.isin(cells[below], here)]
                codes = self._cells.codes[cells[chosen]]
                for name, each in refined_rows(self.texture, codes, level, bits[chosen]).items():
                    found[name][chosen] = each
        return found

    def has_rows(self, rows: Rows) -> Bools:
        """Say which rows (n,) of the union are here too."""
        there, _ = find_rows(self.texture.tree.split, self.origins.cells[rows.cells], rows.bits)
        return there

    def row_areas(self, cells: Int64s, bits: Uint8s, areas: Uint8s) -> None:
        """Write the areas of those of these rows that cells (n,) have here."""
        where, split = self.origins.cells[cells], self.texture.tree.split
        own = np.flatnonzero(where > NOTHING)
        there, rows = find_rows(split, where[own], bits[own])
        areas[own[there]] = split.areas[rows]

    def is_split(self) -> Bools:
        """Say which cells of the union are split here, or below a leaf see something else in a facing."""
        where, flags = self.origins.cells, self.texture.tree.arrays.flags
        found: Bools = (where > NOTHING) & (flags[np.maximum(where, 0)] & SPLIT != 0)
        found[self._below] = self._is_split
        return found

    def keeps(self, nodes: Int64s) -> Bools:
        """Say which nodes, all of the union, keep a coefficient here, or divide a leaf."""
        where = self.origins.cells[nodes]
        is_kept = (where > NOTHING) & (self.texture.tree.arrays.flags[np.maximum(where, 0)] & KEPT != 0)
        found: Bools = is_kept | (self.origins.nodes < NOTHING)
        return found

    def residuals(self, name: str, nodes: Nodes, owners: Int64s, bits: Uint8s) -> Residuals:
        """Return the residuals of nodes of the union and of rows of theirs; see `residuals_at`."""
        places = Nodes(
            np.maximum(self.origins.nodes[nodes.numbers], NOTHING), self.origins.cells[nodes.cells]
        )
        return residuals_at(self.texture, name, places, owners, bits)


def _by_level(cells: Int64s, levels: Int64s) -> list[Int64s]:
    """Part cells (n,), ascending, by level."""
    ends = np.searchsorted(cells, levels)
    return [cells[begin:end] for begin, end in pairwise(ends.tolist())]
