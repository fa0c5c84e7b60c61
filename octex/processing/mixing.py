"""Mixes two textures, cell by cell of their union."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Bools, Float32s, Float64s, Int64s, Uint8s
from octex.channels import ALPHA, decode, encode
from octex.checks import answer
from octex.editing.averages import Residuals, average, average_plain, residuals_at, with_summed_areas
from octex.editing.nodes import Nodes, all_children, by_level
from octex.editing.refined import refined_below, refined_rows
from octex.editing.split import rows_facing
from octex.parallel import ordered_map, sharing, start
from octex.processing.edit import Centres
from octex.processing.union import NOTHING, Origins, find_mixed_nodes, take, unite
from octex.texture import Channel, OctreeTexture
from octex.tree.children import node_cells
from octex.tree.edit import among
from octex.tree.layout import FACING_FLAGS, KEPT, SPLIT, KeptTable, SplitTable
from octex.tree.octree import Octree
from octex.tree.split import bits_of, counts_of, find_rows, rows_of, shared_codes

#: Share of the second texture in cells of both: a number, a function of the rest positions (n, 3) of cell
#: centres, or a texture of one channel with one component.
Amount = float | OctreeTexture | Callable[[Float64s], npt.ArrayLike]

#: Cells a task: mixed, and copied.
_BLOCK, _MANY = 1 << 14, 1 << 20


class UnionCells(NamedTuple):
    """The cells of a union."""

    codes: Int64s  # (cells,)
    facings: Uint8s  # (cells,)
    levels: Int64s  # (max_depth + 2,)   first cell of each level, then the number of cells

    def by_level(self, cells: Int64s) -> list[Int64s]:
        """Group ascending cells (n,) by level."""
        ends = np.searchsorted(cells, self.levels)
        return [cells[begin:end] for begin, end in pairwise(ends.tolist())]


class Side:
    """One of the two textures, read by the union's cells; with ``refines`` also below its leaves."""

    def __init__(
        self, texture: OctreeTexture, origins: Origins, cells: UnionCells, refines: bool, executor: Executor
    ) -> None:
        self.texture, self.origins, self._cells = texture, origins, cells
        self._below = np.flatnonzero(origins.cells < NOTHING) if refines else np.empty(0, np.int64)
        refined = [
            refined_below(texture, cells.codes[numbers], level, cells.facings[numbers], executor)
            for level, numbers in enumerate(cells.by_level(self._below) if self._below.size else ())
        ]
        self._is_split = np.concatenate([np.empty(0, np.bool_), *(each.is_split for each in refined)])
        self._refined = {
            name: np.concatenate([each.values[name] for each in refined])
            for name in (texture.channels if refined else ())
        }

    def values(self, cells: Int64s) -> dict[str, Float32s]:
        """Return decoded values of cells (n,): stored, or refined below a leaf; any for missing cells."""
        origins = self.origins.cells[cells]
        below = np.flatnonzero(origins < NOTHING) if self._below.size else np.empty(0, np.int64)
        rows = np.searchsorted(self._below, cells[below])
        values = {}
        for name, channel in self.texture.channels.items():
            values[name] = decode(channel.values[np.maximum(origins, 0)], channel.format.space)
            if below.size:
                values[name][below] = self._refined[name][rows]
        return values

    def coefficients(self, nodes: Int64s) -> dict[str, Float32s]:
        """Return the decoded coefficients of nodes (n,): that of a kept node, otherwise the value."""
        values, origins = self.values(nodes), self.origins.cells[nodes]
        cells = self.texture.tree.kept.cells.astype(np.int64)
        kept = np.flatnonzero(among(origins, cells))
        rows = np.searchsorted(cells, origins[kept])
        for name, channel in self.texture.channels.items():
            values[name][kept] = decode(channel.kept_values[rows], channel.format.space)
        return values

    def rows(self, cells: Int64s, bits: Uint8s) -> dict[str, Float32s]:
        """Return the decoded values of ascending cells (n,) for facings (n,)."""
        values, origins = self.values(cells), self.origins.cells[cells]
        present, below = np.flatnonzero(origins > NOTHING), np.flatnonzero(origins < NOTHING)
        for name, channel in self.texture.channels.items():
            values[name][present] = rows_facing(self.texture, channel, origins[present], bits[present])
        for level, of_level in enumerate(self._cells.by_level(cells[below]) if self._below.size else ()):
            rows = below[np.isin(cells[below], of_level)]
            codes = self._cells.codes[cells[rows]]
            for name, refined in refined_rows(self.texture, codes, level, bits[rows]).items():
                values[name][rows] = refined
        return values

    def find_rows(self, cells: Int64s, bits: Uint8s) -> tuple[Bools, Int64s]:
        """Return which rows of the union this texture has, and their numbers in it."""
        return find_rows(self.texture.tree.split, self.origins.cells[cells], bits)

    def is_split(self) -> Bools:
        """Return which cells of the union are split in this texture, or would be split below a leaf."""
        is_split = self._has_flag(self.origins.cells, SPLIT)
        is_split[self._below] = self._is_split
        return is_split

    def keeps(self, nodes: Int64s) -> Bools:
        """Return which of the union's nodes are kept in this texture, or divide a leaf of it."""
        return self._has_flag(self.origins.cells[nodes], KEPT) | (self.origins.nodes < NOTHING)

    def _has_flag(self, origins: Int64s, flag: int) -> Bools:
        flags = self.texture.tree.arrays.flags[np.maximum(origins, 0)]
        return np.asarray((origins > NOTHING) & (flags & flag != 0))

    def residuals(self, name: str, nodes: Nodes, owners: Int64s, bits: Uint8s) -> Residuals:
        """Return the residuals of the union's nodes and of their rows; see `residuals_at`."""
        numbers = np.maximum(self.origins.nodes[nodes.numbers], NOTHING)
        origins = Nodes(numbers, self.origins.cells[nodes.cells])
        return residuals_at(self.texture, name, origins, owners, bits)


class Mixing:
    """The mixture of two textures with equal channel formats, on the union of their trees.

    ``amount`` None composites the second over the first by its alpha. A cell of only one texture is copied.
    For the amounts 0 and 1 the other texture must lack cells that this one hides.
    """

    def __init__(
        self, first: OctreeTexture, second: OctreeTexture, amount: Amount | None, executor: Executor
    ) -> None:
        self._amount, self._executor = amount, executor
        self._texture = first  # source of placement and formats
        self._tree, *origins = unite(first.tree, second.tree)
        arrays = self._tree.arrays
        self._nodes = node_cells(arrays)
        self._centres = Centres(self._tree, first.placement)
        self._cells = UnionCells(
            self._centres.codes, arrays.flags & np.uint8(FACING_FLAGS), arrays.level_cells
        )
        # An amount of 0 or 1 needs no values below the unused texture's leaves.
        self._sides = [
            Side(texture, of_texture, self._cells, amount != unused, executor)
            for texture, of_texture, unused in zip((first, second), origins, (1.0, 0.0), strict=True)
        ]
        has_first, has_second = (cells != NOTHING for cells, _ in origins)
        self._in_both = has_first & has_second
        self._share = has_second.astype(np.float32)  # of the second texture in each cell's colour

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the executor, which cannot be sent to its worker processes."""
        return {**self.__dict__, "_executor": None}

    def mixed(self) -> tuple[Octree, dict[str, Channel]]:
        """Return the tree and its channels."""
        first, second = self._sides
        values, mixed_nodes = self._leaves()
        # Areas come from the texture with the larger share; nodes' shares are averages weighted by them.
        areas = self._tree.arrays.areas[:, None]
        areas_of_sides = [side.texture.tree.arrays.areas[:, None] for side in self._sides]
        self._take(areas_of_sides, areas)
        average_plain(self._tree, self._share, mixed_nodes)
        self._take(areas_of_sides, areas)
        # A node is kept if it is kept in the texture with the larger share. A cell is split if it is split in
        # a texture with a share above 0.
        is_second = self._share[self._nodes] >= 0.5
        kept = self._nodes[np.where(is_second, second.keeps(self._nodes), first.keeps(self._nodes))]
        is_split = first.is_split() & (self._share < 1) | second.is_split() & (self._share > 0)
        split = np.flatnonzero(is_split & (self._cells.facings != 0))
        flags = self._tree.arrays.flags.copy()
        flags[kept] |= np.uint8(KEPT)
        flags[split] |= np.uint8(SPLIT)
        facings = self._cells.facings[split]
        owners, bits = np.repeat(split, counts_of(facings)), bits_of(facings)
        kept_values, _ = self._mix(kept, [side.coefficients(kept) for side in self._sides])
        rows = self._rows(owners, bits)
        split_table = SplitTable(split.astype(np.uint32), facings, self._row_areas(owners, bits))
        kept_table = KeptTable(kept.astype(np.uint32))
        tree = self._tree.with_cell_data(flags, self._tree.arrays.areas, split_table, kept_table)
        tree = with_summed_areas(tree, self._summed(mixed_nodes))
        channels: dict[str, Channel] = {}
        for name in sorted(values, key=lambda name: name != ALPHA.name):
            form = self._texture.channels[name].format
            stored = (encode(each[name], form.dtype, form.space) for each in (rows, kept_values))
            channels[name] = Channel(form, values[name], *stored)
            texture = self._texture.with_cells(tree, channels)
            average(texture, channels[name], self._residuals(tree, name, mixed_nodes), mixed_nodes)
        return tree, {name: channels[name] for name in values}

    def _residuals(self, tree: Octree, name: str, nodes: Nodes) -> Residuals:
        """Return the residuals of mixed nodes: the shares weight those of both textures."""
        rows = rows_of(tree.split, nodes.cells)
        owners = np.searchsorted(nodes.cells, rows.cells)
        tasks = [
            start(self._executor, side.residuals, name, nodes, owners, rows.bits) for side in self._sides
        ]
        first, second = (task.result() for task in tasks)
        # A facing that only one texture has takes that texture's residual.
        has_first, has_second = (side.find_rows(rows.cells, rows.bits)[0] for side in self._sides)
        share = self._share[nodes.cells, None]
        row_share = np.where(has_first == has_second, self._share[rows.cells], has_second)[:, None]
        return Residuals(
            (1 - share) * first.nodes + share * second.nodes,
            (1 - row_share) * first.rows + row_share * second.rows,
        )

    def _leaves(self) -> tuple[dict[str, Array], Nodes]:
        """Return stored values by channel, and the nodes whose content mixes both textures."""
        is_mixed = self._in_both.copy()
        is_mixed[self._nodes] = False
        if isinstance(self._amount, float) and self._amount in (0.0, 1.0):
            self._share[self._in_both] = self._amount
            is_mixed[:] = False
        values: dict[str, Array] = {}
        for name, channel in self._texture.channels.items():
            values[name] = np.empty((self._tree.n_cells, channel.format.components), channel.format.dtype)
            self._take([side.texture.channels[name].values for side in self._sides], values[name])
        cells = np.flatnonzero(is_mixed)
        is_mixed_node = np.zeros(self._tree.n_nodes, np.bool_)
        first, second = (side.origins.nodes for side in self._sides)
        find_mixed_nodes(self._tree.arrays, self._nodes, first, second, self._share, is_mixed, is_mixed_node)
        blocks = [cells[begin : begin + _BLOCK] for begin in range(0, cells.size, _BLOCK)]
        for block, (mixed, share) in zip(
            blocks, ordered_map(self._executor, self._leaves_mixed, blocks), strict=True
        ):
            self._share[block] = share
            for name, mixed_values in mixed.items():
                values[name][block] = mixed_values
        return values, Nodes(np.flatnonzero(is_mixed_node), self._nodes[is_mixed_node])

    def _leaves_mixed(self, cells: Int64s) -> tuple[dict[str, Array], Float32s]:
        values, share = self._mix(cells, [side.values(cells) for side in self._sides])
        forms = {name: self._texture.channels[name].format for name in values}
        return {name: encode(values[name], form.dtype, form.space) for name, form in forms.items()}, share

    def _mix(
        self, cells: Int64s, values: Sequence[dict[str, Float32s]], amounts: Float32s | None = None
    ) -> tuple[dict[str, Float32s], Float32s]:
        """Mix both sides' ``values`` of cells (n,); return them, and the second's share (n,) of colour."""
        has = [(side.origins.cells[cells] != NOTHING).astype(np.float32) for side in self._sides]
        first, second = values
        alphas = [np.ones(cells.size, np.float32)] * 2
        if ALPHA.name in first:
            alphas = [of_side[ALPHA.name][:, 0] for of_side in values]
        if amounts is None and self._amount is None:
            weights = has[0] * alphas[0] * (1 - has[1] * alphas[1]), has[1] * alphas[1]
            amounts = has[1]
        else:
            amounts = self._amounts(cells) if amounts is None else amounts
            amounts = np.where(has[0] * has[1] > 0, amounts, has[1])
            weights = (1 - amounts) * alphas[0], amounts * alphas[1]
        total = weights[0] + weights[1]
        share = np.where(total > 0, weights[1] / np.where(total > 0, total, 1), amounts).astype(np.float32)
        column = share[:, None]
        mixed = {name: (1 - column) * first[name] + column * second[name] for name in first}
        if ALPHA.name in first:
            mixed[ALPHA.name] = total[:, None]
        return mixed, share

    def _amounts(self, cells: Int64s) -> Float32s:
        """Return the amount of the second texture in cells (n,), 0 … 1."""
        if isinstance(self._amount, float):
            return np.full(cells.size, self._amount, np.float32)
        centres = self._centres[cells]
        if isinstance(self._amount, OctreeTexture):
            return np.clip(self._amount.sample(centres, next(iter(self._amount.channels)))[:, 0], 0, 1)
        assert self._amount is not None
        amounts = answer(self._amount, [centres], [(cells.size,)], "the amount", centres.__getitem__)
        return np.clip(amounts, 0, 1).astype(np.float32)

    def _take(self, sides: Sequence[Array], taken: Array) -> None:
        """Copy each cell from the texture with the larger share, or from the only one that has it."""
        first, second, rows = (array.view(np.uint8) for array in (*sides, taken))
        first_cells, second_cells = (side.origins.cells for side in self._sides)
        share = self._share

        def copy(block: slice) -> None:
            take(first_cells[block], second_cells[block], share[block], first, second, rows[block])

        blocks = [slice(begin, begin + _MANY) for begin in range(0, len(rows), _MANY)]
        with sharing(self._executor) as pool:
            for _ in ordered_map(pool, copy, blocks):
                pass

    def _summed(self, nodes: Nodes) -> Nodes:
        """Return the nodes below which each texture has cells that the other lacks."""
        adds = ~self._in_both  # cells with cells of one texture only, themselves or below
        for rows in reversed(by_level(self._tree, nodes)):
            children, starts = all_children(self._tree, nodes.numbers[rows])
            adds[nodes.cells[rows]] |= np.logical_or.reduceat(adds[children], starts)
        return nodes.of(adds[nodes.cells] & self._in_both[nodes.cells])

    def _rows(self, owners: Int64s, bits: Uint8s) -> dict[str, Float32s]:
        """Mix decoded values of cells (n,) for facings (n,); nodes use the average share below them."""
        is_node = np.isin(owners, self._nodes)
        rows = {
            name: np.empty((owners.size, channel.format.components), np.float32)
            for name, channel in self._texture.channels.items()
        }
        for mask, amounts in ((~is_node, None), (is_node, self._share[owners[is_node]])):
            cells, facings = owners[mask], bits[mask]
            mixed, _ = self._mix(cells, [side.rows(cells, facings) for side in self._sides], amounts)
            for name, values in mixed.items():
                rows[name][mask] = values
        return rows

    def _row_areas(self, owners: Int64s, bits: Uint8s) -> Uint8s:
        """Return rows' areas: from the texture with the larger share, else equal parts of the cell's area."""
        areas = shared_codes(self._tree.arrays.areas[owners], counts_of(self._tree.arrays.flags[owners]))
        is_second = self._share[owners] >= 0.5
        for side, prevails in zip(self._sides, (~is_second, is_second), strict=True):
            has_row, rows = side.find_rows(owners, bits)
            areas[has_row & prevails] = side.texture.tree.split.areas[rows[prevails[has_row]]]
        return areas
