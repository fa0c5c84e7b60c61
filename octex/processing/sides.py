"""What each of two textures has in the cells of their union."""

from __future__ import annotations

from concurrent.futures import Executor
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import decode
from octex.editing.averages import Nodes, alpha_beside, node_cells, residuals
from octex.editing.facings import Rows, row_residuals
from octex.processing.refine import refined, rows_below
from octex.processing.union import BELOW, NOTHING, Origins
from octex.texture import OctreeTexture
from octex.texture.split import find_rows, rows_facing
from octex.tree.edit import among
from octex.tree.layout import KEPT, SPLIT

Bools = npt.NDArray[np.bool_]
Int64s = npt.NDArray[np.int64]
Uint8s = npt.NDArray[np.uint8]
Float32s = npt.NDArray[np.float32]
Float64s = npt.NDArray[np.float64]


class Cells(NamedTuple):
    """The cells of a union, by their codes."""

    codes: Int64s  # (cells,)
    levels: Int64s  # (max_depth + 2,)   the first cell of each level, then their number


class Side:
    """One of the textures."""

    def __init__(
        self, texture: OctreeTexture, origins: Origins, cells: Cells | None, executor: Executor
    ) -> None:
        self.texture, self.origins = texture, origins
        self._below = np.empty(0, np.int64)
        self._refined: dict[str, list[Float32s]] = {name: [] for name in texture.channels}
        if cells is not None:
            self._refine(cells, executor)

    def _refine(self, cells: Cells, executor: Executor) -> None:
        """Find values below leaves."""
        self._below = np.flatnonzero(self.origins.cells < NOTHING)
        ends = np.searchsorted(self._below, cells.levels)
        for level, (begin, end) in enumerate(pairwise(ends.tolist())):
            if begin < end:
                codes = cells.codes[self._below[begin:end]]
                for name, values in refined(self.texture, codes, level, executor).values.items():
                    self._refined[name].append(values)

    def has(self, cells: Int64s) -> Bools:
        """Say which cells (n,) of the union there is something in."""
        found: Bools = self.origins.cells[cells] != NOTHING
        return found

    def values(self, name: str, cells: Int64s) -> Float32s:
        """Return the values of cells (n,), decoded: own ones, or refined ones; of others, any."""
        channel = self.texture.channels[name]
        where = self.origins.cells[cells]
        found = decode(channel.values[np.maximum(where, 0)], channel.format.space)
        below = np.flatnonzero(where < NOTHING)
        if below.size and self._below.size:
            found[below] = np.concatenate(self._refined[name])[np.searchsorted(self._below, cells[below])]
        return found

    def coefficients(self, name: str, nodes: Int64s) -> Float32s:
        """Return what nodes (n,) keep or could keep, decoded: values, but for those of kept nodes."""
        channel, cells = self.texture.channels[name], self.texture.tree.kept.cells.astype(np.int64)
        found, own = self.values(name, nodes), self.origins.cells[nodes]
        kept = np.flatnonzero(among(own, cells))
        rows = np.searchsorted(cells, own[kept])
        found[kept] = decode(channel.kept_values[rows], channel.format.space)
        return found

    def rows(self, name: str, cells: Int64s, bits: Uint8s) -> Float32s:
        """Return what cells (n,) show facings, decoded."""
        channel, found = self.texture.channels[name], self.values(name, cells)
        where = self.origins.cells[cells]
        own, below = np.flatnonzero(where > NOTHING), np.flatnonzero(where < NOTHING)
        found[own] = rows_facing(self.texture, channel, where[own], bits[own])
        leaves = BELOW - where[below]
        found[below] = rows_below(self.texture, channel, found[below], leaves, bits[below])
        return found

    def row_areas(self, cells: Int64s, bits: Uint8s, areas: Uint8s) -> None:
        """Write the areas of those of these rows that cells (n,) have here."""
        where, split = self.origins.cells[cells], self.texture.tree.split
        own = np.flatnonzero(where > NOTHING)
        there, rows = find_rows(split, where[own], bits[own])
        areas[own[there]] = split.areas[rows]

    def is_split(self) -> Bools:
        """Say which cells of the union are split here, or below a leaf that is."""
        where = self.origins.cells
        if not self.texture.tree.split.cells.size:
            return np.zeros(where.size, np.bool_)
        found: Bools = self.texture.tree.arrays.flags[self.origins.sources] & SPLIT != 0
        found &= where != NOTHING
        return found

    def keeps(self, nodes: Int64s) -> Bools:
        """Say which nodes, all of the union, keep a coefficient here, or divide a leaf."""
        where = self.origins.cells[nodes]
        is_kept = (where > NOTHING) & (self.texture.tree.arrays.flags[np.maximum(where, 0)] & KEPT != 0)
        found: Bools = is_kept | (self.origins.nodes < NOTHING)
        return found

    def residuals(self, name: str, nodes: Int64s) -> npt.NDArray[np.floating[Any]]:
        """Return the residuals of nodes (n,) of the union, by number; zeros for what is no node here."""
        own = self.origins.nodes[nodes]
        is_own = own >= 0
        tree, channels = self.texture.tree, self.texture.channels
        chosen = Nodes(own[is_own], node_cells(tree)[own[is_own]])
        known = residuals(tree, channels[name], alpha_beside(channels, name), nodes=chosen)
        found = np.zeros((own.size, known.shape[1]), known.dtype)
        found[is_own] = known
        return found

    def row_residuals(self, name: str, rows: Rows) -> tuple[Float64s, Bools]:
        """Return the residuals of rows (n,) of the union, zeros for what is no row here, and which are."""
        where, channel = self.origins.cells[rows.cells], self.texture.channels[name]
        found = np.zeros((where.size, channel.format.components))
        own = np.flatnonzero(where > NOTHING)
        there, known = find_rows(self.texture.tree.split, where[own], rows.bits[own])
        is_here = np.zeros(where.size, np.bool_)
        is_here[own[there]] = True
        if known.size:
            found[is_here] = row_residuals(self.texture, channel)[known]
        return found, is_here
