"""Two textures mixed, cell by cell of their union."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Float32s, Float64s, Int64s, Uint8s
from octex.channels import ALPHA, encode
from octex.editing.averages import Residuals, average, average_plain, with_summed_areas
from octex.editing.nodes import Nodes, all_children, by_level
from octex.functions import answer
from octex.parallel import ordered_map, sharing, start
from octex.processing.mapping import centres_of, levels_of
from octex.processing.sides import Cells, Side
from octex.processing.union import NOTHING, Origins, find_made, take, unite
from octex.texture import Channel, OctreeTexture
from octex.tree.areas import shared_codes
from octex.tree.children import node_cells
from octex.tree.layout import FACING_FLAGS, KEPT, SPLIT, KeptTable, SplitTable
from octex.tree.octree import Octree
from octex.tree.split import bits_of, counts_of, rows_of

#: How much of the second texture there is in cells that both have: a number, a function of the positions
#: (n, 3), at rest, of the cells' centres, or a texture of one channel of one component.
Amount = float | OctreeTexture | Callable[[Float64s], npt.ArrayLike]

#: Cells that a thread mixes at once, and those that it copies.
_BLOCK, _MANY = 1 << 14, 1 << 20


class Mixing:
    """Two textures of the same channels, stored alike, on the tree of both.

    ``amount`` None lays the second over the first by its alpha. What only one has is taken from that. With
    the number 0 or 1 the texture that is not taken has no cells that the other hides; see `without_hidden`.
    """

    def __init__(
        self, first: OctreeTexture, second: OctreeTexture, amount: Amount | None, executor: Executor
    ) -> None:
        self._amount, self._executor = amount, executor
        self._texture = first  # for its placement and formats
        self._tree, *origins = unite(first.tree, second.tree)
        self._nodes = node_cells(self._tree.arrays)
        self._codes: Int64s | None = None
        # What is taken whole or not at all needs no values below the other's leaves.
        self._first, self._second = (
            Side(texture, own, self._cells(own) if amount != unused else None, executor)
            for texture, own, unused in zip((first, second), origins, (1.0, 0.0), strict=True)
        )
        has_first, has_second = (own.cells != NOTHING for own in origins)
        self._both = has_first & has_second
        self._share = has_second.astype(np.float32)  # of the second, in the colour of cells
        self._is_made = np.zeros(self._tree.n_nodes, np.bool_)  # nodes that are not as in one of the two

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the executor, which does not travel to its own processes."""
        return {**self.__dict__, "_executor": None}

    def _cells(self, origins: Origins) -> Cells | None:
        if not (origins.cells < NOTHING).any():
            return None
        facings = self._tree.arrays.flags & np.uint8(FACING_FLAGS)
        return Cells(self._codes_of(slice(None)), facings, self._tree.arrays.level_cells)

    def _codes_of(self, cells: Int64s | slice) -> Int64s:
        if self._codes is None:
            self._codes = np.concatenate([codes for codes, _ in self._tree.walk()])
        return self._codes[cells]

    def mixed(self) -> tuple[Octree, dict[str, Channel]]:
        """Return the tree and its channels."""
        values = self._leaves()
        self._give_areas()
        kept, split = self._kept_nodes(), self._split_cells()
        flags = self._tree.arrays.flags.copy()
        flags[kept] |= np.uint8(KEPT)
        flags[split] |= np.uint8(SPLIT)
        facings = flags[split] & np.uint8(FACING_FLAGS)
        owners, bits = np.repeat(split, counts_of(facings)), bits_of(facings)
        kept_values, _ = self._mix(kept, lambda side: side.coefficients(kept))
        rows = self._rows(owners, bits)
        tables = (
            SplitTable(split.astype(np.uint32), facings, self._row_areas(owners, bits)),
            KeptTable(kept.astype(np.uint32)),
        )
        tree = self._tree.with_cell_data(flags, self._tree.arrays.areas, *tables)
        tree = with_summed_areas(tree, self._summed())
        channels: dict[str, Channel] = {}
        for name in sorted(values, key=lambda name: name != ALPHA.name):
            form = self._texture.channels[name].format
            own = (
                values[name],
                *(encode(each[name], form.dtype, form.space) for each in (rows, kept_values)),
            )
            channels[name] = Channel(form, *own)
            self._average(tree, channels, name)
        return tree, {name: channels[name] for name in values}

    def _average(self, tree: Octree, channels: dict[str, Channel], name: str) -> None:
        """Make nodes that are not as in one of the two anew, in place; residuals count by the parts."""
        made = self._made()
        rows = rows_of(tree.split, made.cells)
        owners = np.searchsorted(made.cells, rows.cells)
        tasks = [
            start(self._executor, side.residuals, name, made, owners, rows.bits)
            for side in (self._first, self._second)
        ]
        one, other = (task.result() for task in tasks)
        # Where only one tells a facing apart, its own residual stays.
        has_first, has_second = (side.has_rows(rows) for side in (self._first, self._second))
        share = self._share[made.cells, None]
        row_share = np.where(has_first == has_second, self._share[rows.cells], has_second)[:, None]
        left = Residuals(
            (1 - share) * one.nodes + share * other.nodes, (1 - row_share) * one.rows + row_share * other.rows
        )
        whole = OctreeTexture(tree, channels, self._texture.placement, self._texture.bounds)
        average(whole, channels[name], left, made)

    def _made(self) -> Nodes:
        """Return the nodes that are not as in one of the two."""
        return Nodes(np.flatnonzero(self._is_made), self._nodes[self._is_made])

    def _leaves(self) -> dict[str, Array]:
        """Return the channels' values, as stored, those of nodes still to be averaged."""
        whole = self._amount if isinstance(self._amount, float) and self._amount in (0.0, 1.0) else None
        is_mixed = self._both.copy()
        is_mixed[self._nodes] = False
        if whole is not None:
            self._share[self._both] = whole
            is_mixed[:] = False
        found: dict[str, Array] = {}
        for name, channel in self._texture.channels.items():
            stored = [side.texture.channels[name].values for side in (self._first, self._second)]
            found[name] = np.empty((self._tree.n_cells, channel.format.components), channel.format.dtype)
            self._take(stored, found[name])
        cells = np.flatnonzero(is_mixed)
        one, other = self._first.origins.nodes, self._second.origins.nodes
        find_made(self._tree.arrays, self._nodes, one, other, self._share, is_mixed, self._is_made)
        blocks = [cells[begin : begin + _BLOCK] for begin in range(0, cells.size, _BLOCK)]
        for some, (values, share) in zip(
            blocks, ordered_map(self._executor, self._leaves_mixed, blocks), strict=True
        ):
            self._share[some] = share
            for name, own in values.items():
                found[name][some] = own
        return found

    def _leaves_mixed(self, cells: Int64s) -> tuple[dict[str, Array], Float32s]:
        values, share = self._mix(cells, lambda side: side.values(cells))
        forms = {name: channel.format for name, channel in self._texture.channels.items()}
        return {
            name: encode(own, forms[name].dtype, forms[name].space) for name, own in values.items()
        }, share

    def _mix(
        self, cells: Int64s, values: Callable[[Side], dict[str, Float32s]], amounts: Float32s | None = None
    ) -> tuple[dict[str, Float32s], Float32s]:
        """Mix what both have in cells (n,); return it by channel, and the part (n,) of the second in colours.

        ``amounts`` (n,), if they are not what is asked for.
        """
        has = [side.has(cells).astype(np.float32) for side in (self._first, self._second)]
        one, other = values(self._first), values(self._second)
        alphas = [np.ones(cells.size, np.float32)] * 2
        if ALPHA.name in one:
            alphas = [each[ALPHA.name][:, 0] for each in (one, other)]
        if amounts is None and self._amount is None:
            weights = has[0] * alphas[0] * (1 - has[1] * alphas[1]), has[1] * alphas[1]
            amounts = has[1]
        else:
            amounts = self._amounts(cells) if amounts is None else amounts
            amounts = np.where(has[0] * has[1] > 0, amounts, has[1])
            weights = (1 - amounts) * alphas[0], amounts * alphas[1]
        total = weights[0] + weights[1]
        share = np.where(total > 0, weights[1] / np.where(total > 0, total, 1), amounts).astype(np.float32)
        part = share[:, None]
        found = {name: (1 - part) * one[name] + part * other[name] for name in one if name != ALPHA.name}
        return ({ALPHA.name: total[:, None]} if ALPHA.name in one else {}) | found, share

    def _amounts(self, cells: Int64s) -> Float32s:
        """Return how much of the second there is to be in cells (n,), 0 … 1."""
        if isinstance(self._amount, float):
            return np.full(cells.size, self._amount, np.float32)
        centres = centres_of(self._texture, self._codes_of(cells), levels_of(self._tree, cells))
        if isinstance(self._amount, OctreeTexture):
            found = self._amount.sample(centres, next(iter(self._amount.channels)))[:, 0]
            return np.clip(found, 0, 1)
        assert self._amount is not None
        given = answer(self._amount, [centres], [(cells.size,)], "the amount", centres.__getitem__)
        return np.clip(given, 0, 1).astype(np.float32)

    def _take(self, given: Sequence[Array], taken: Array) -> None:
        """Take what cells have in the texture that prevails, or in the other if it lacks the cell."""
        one, other, found = (array.view(np.uint8) for array in (*given, taken))
        cells = self._first.origins.cells, self._second.origins.cells

        parts = [slice(begin, begin + _MANY) for begin in range(0, len(found), _MANY)]
        with sharing(self._executor) as pool:
            for _ in ordered_map(
                pool,
                lambda some: take(cells[0][some], cells[1][some], self._share[some], one, other, found[some]),
                parts,
            ):
                pass

    def _give_areas(self) -> None:
        """Give cells the areas of the texture that prevails; the parts in nodes are averaged by them."""
        areas = self._tree.arrays.areas[:, None]
        given = [side.texture.tree.arrays.areas[:, None] for side in (self._first, self._second)]
        self._take(given, areas)
        average_plain(self._tree, self._share, self._made())
        self._take(given, areas)

    def _summed(self) -> Nodes:
        """Return the nodes to which both add cells of their own."""
        made = self._made()
        adds = ~self._both  # cells, or to what is below them
        for here in reversed(by_level(self._tree, made)):
            children, starts = all_children(self._tree, made.numbers[here])
            adds[made.cells[here]] |= np.logical_or.reduceat(adds[children], starts)
        return made.of(adds[made.cells] & self._both[made.cells])

    def _kept_nodes(self) -> Int64s:
        """Return the nodes that keep a coefficient: those of which the texture that prevails has one."""
        is_second = self._share[self._nodes] >= 0.5
        keeps = np.where(is_second, self._second.keeps(self._nodes), self._first.keeps(self._nodes))
        return self._nodes[keeps]

    def _split_cells(self) -> Int64s:
        """Return the cells in which a texture that has a part in them tells facings apart."""
        is_split = self._first.is_split() & (self._share < 1) | self._second.is_split() & (self._share > 0)
        return np.flatnonzero(is_split & (self._tree.arrays.flags & FACING_FLAGS != 0))

    def _rows(self, owners: Int64s, bits: Uint8s) -> dict[str, Float32s]:
        """Mix what cells (n,) show facings, decoded; in nodes by the parts of the textures below them."""
        is_node = np.isin(owners, self._nodes)
        found = {
            name: np.empty((owners.size, channel.format.components), np.float32)
            for name, channel in self._texture.channels.items()
        }
        for chosen, amounts in ((~is_node, None), (is_node, self._share[owners[is_node]])):
            cells, facings = owners[chosen], bits[chosen]
            mixed, _ = self._mix(
                cells,
                lambda side, cells=cells, facings=facings: side.rows(cells, facings),  # type: ignore[misc]
                amounts,
            )
            for name, own in mixed.items():
                found[name][chosen] = own
        return found

    def _row_areas(self, owners: Int64s, bits: Uint8s) -> Uint8s:
        """Return the areas of rows: those of the texture that prevails, else even parts of their cells'."""
        counts = counts_of(self._tree.arrays.flags[owners])
        areas = shared_codes(self._tree.arrays.areas[owners], counts)
        is_second = self._share[owners] >= 0.5
        for side, prevails in ((self._first, ~is_second), (self._second, is_second)):
            own = areas[prevails]
            side.row_areas(owners[prevails], bits[prevails], own)
            areas[prevails] = own
        return areas
