"""Joins textures from runs of other textures' cells, since the cells of a level are in Morton order."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Int64s, Uint32s, bit_counts, in_runs
from octex.texture import Channel, OctreeTexture
from octex.tree.children import children_before, groups_of, masks_of
from octex.tree.edit import Edited, among
from octex.tree.layout import KeptTable, SplitTable, TreeArrays
from octex.tree.octree import Octree


class Runs(NamedTuple):
    """Runs of cells, or of nodes, of several textures, end to end."""

    owners: Int64s
    begins: Int64s
    ends: Int64s

    @classmethod
    def joined(cls, *parts: Iterable[Int64s]) -> Runs:
        """Concatenate runs; consecutive ones become one."""
        owners, begins, ends = (np.concatenate(column) for column in zip(*parts, strict=True))
        is_filled = begins < ends
        owners, begins, ends = owners[is_filled], begins[is_filled], ends[is_filled]
        follows = np.zeros(owners.size + 1, np.bool_)
        follows[1:-1] = (owners[1:] == owners[:-1]) & (begins[1:] == ends[:-1])
        return cls(owners[~follows[:-1]], begins[~follows[:-1]], ends[~follows[1:]])

    @classmethod
    def of_numbers(cls, numbers: Int64s) -> Runs:
        """Return the runs of consecutive numbers of the first texture."""
        return cls.joined((np.zeros_like(numbers), numbers, numbers + 1))

    def numbers(self) -> Int64s:
        """Return all numbers of the runs."""
        return in_runs(self.begins, self.ends - self.begins)

    def of(self, arrays: Sequence[Array]) -> Array:
        """Concatenate the runs of one array a texture."""
        runs = zip(*(column.tolist() for column in self), strict=True)
        return np.concatenate([arrays[owner][begin:end] for owner, begin, end in runs] or [arrays[0][:0]])


#: The root of the first texture.
ROOT = Runs(*np.array([[0], [0], [1]], np.int64))


def children_in(trees: Sequence[Octree], nodes: Runs) -> tuple[Runs, Runs]:
    """Return the runs of the children of runs of nodes: all cells, and those that are nodes."""
    first, last = np.zeros((2, 2, nodes.owners.size), np.int64)
    for number, tree in enumerate(trees):
        of_tree = nodes.owners == number
        first[:, of_tree] = children_before(tree.arrays.groups, nodes.begins[of_tree])
        last[:, of_tree] = children_before(tree.arrays.groups, nodes.ends[of_tree])
    return Runs(nodes.owners, first[0], last[0]), Runs(nodes.owners, first[1], last[1])


def add_below(trees: Sequence[Octree], cells: list[Runs], nodes: list[Runs]) -> None:
    """Append, level by level, all runs of cells and nodes below the last runs of nodes."""
    while True:
        children, below = children_in(trees, nodes[-1])
        if not (children.begins < children.ends).any():
            return
        cells.append(Runs.joined(children))
        nodes.append(Runs.joined(below))


def joined_runs(
    textures: Sequence[OctreeTexture],
    like: OctreeTexture,
    cells: Sequence[Runs],
    nodes: Sequence[Runs],
    turned: Bools,
) -> OctreeTexture:
    """Return a texture of runs of cells and nodes, level by level, with the channels of ``like``.

    Where ``turned``, the first cells change from leaves to nodes, or from nodes to leaves.
    """
    counts = np.array([[(run.ends - run.begins).sum() for run in runs] for runs in (cells, nodes)], np.int64)
    counts = counts[:, : np.count_nonzero(counts[0])]
    level_cells, level_nodes = np.pad(np.cumsum(counts, axis=1), ((0, 0), (1, 0)))
    all_cells, all_nodes = (Runs.joined(*runs) for runs in (cells, nodes))
    n_nodes = int(level_nodes[-1])
    masks = np.zeros((2, -(-n_nodes // 8) * 8), np.uint8)
    for word, mask in enumerate(masks):
        mask[:n_nodes] = all_nodes.of([masks_of(each.tree.arrays.groups, word) for each in textures])
    # The children of the first nodes are the first cells, from cell 1 on.
    last = int(level_nodes[max(np.searchsorted(level_cells, turned.size) - 1, 0)])
    bits = np.unpackbits(masks[0, :last] | masks[1, :last], bitorder="little").view(np.bool_)
    bits[bits] = turned[1:]
    masks[:, :last] ^= np.packbits(bits, bitorder="little")
    trees = [each.tree for each in textures]
    flags = all_cells.of([tree.arrays.flags for tree in trees])
    areas = all_cells.of([tree.arrays.areas for tree in trees])
    split_cells, split_runs, row_runs = _split_runs(trees, all_cells)
    kept_cells, kept_runs = _listed([tree.kept.cells for tree in trees], all_cells)
    split = SplitTable(
        split_cells,
        split_runs.of([tree.split.facings for tree in trees]),
        row_runs.of([tree.split.areas for tree in trees]),
    )
    tree = Octree(
        TreeArrays(groups_of(masks), level_cells, level_nodes, flags, areas), split, KeptTable(kept_cells)
    )
    channels = {}
    for name, channel in like.channels.items():
        parts = [each.channels[name] for each in textures]
        channels[name] = Channel(
            channel.format,
            all_cells.of([each.values for each in parts]),
            row_runs.of([each.split_values for each in parts]),
            kept_runs.of([each.kept_values for each in parts]),
        )
    return like.with_cells(tree, channels)


def _split_runs(trees: Sequence[Octree], cells: Runs) -> tuple[Uint32s, Runs, Runs]:
    """Return the new numbers of split cells in runs of cells, and the runs of table entries and rows."""
    split, runs = _listed([tree.split.cells for tree in trees], cells)
    ends = [
        np.concatenate([[0], np.cumsum(bit_counts(tree.split.facings), dtype=np.int64)]) for tree in trees
    ]
    firsts = np.cumsum([0, *map(len, ends)])[runs.owners]
    all_ends = np.concatenate(ends)
    rows = Runs(runs.owners, all_ends[firsts + runs.begins], all_ends[firsts + runs.ends])
    return split, runs, rows


def _listed(tables: Sequence[Uint32s], cells: Runs) -> tuple[Uint32s, Runs]:
    """Return the new numbers of the cells in runs that tables list, and the runs of table entries."""
    owners, begins, ends = cells
    counts = ends - begins
    shifts = np.cumsum(counts) - counts - begins
    first, last = np.zeros((2, owners.size), np.int64)
    for number, table in enumerate(tables):
        of_table = owners == number
        first[of_table] = np.searchsorted(table, begins[of_table].astype(np.uint32))
        last[of_table] = np.searchsorted(table, ends[of_table].astype(np.uint32))
    is_listed = last > first
    runs = Runs(owners[is_listed], first[is_listed], last[is_listed])
    listed = runs.of(tables).astype(np.int64) + np.repeat(shifts[is_listed], (last - first)[is_listed])
    return listed.astype(np.uint32), runs


def carried(
    texture: OctreeTexture, edited: Edited, values: Mapping[str, Array] | None = None
) -> dict[str, Channel]:
    """Return the channels of a texture for the cells, rows and kept nodes of an edited tree.

    Stored ``values`` (cells, components) are those of the new cells; default: ``edited.carried``, with zeros
    in cells that the texture lacked. Newly kept nodes keep their values as coefficients.
    """
    kept = edited.tree.kept.cells
    was_kept = among(edited.old[kept], texture.tree.kept.cells.astype(np.int64))
    channels = {}
    for name, channel in texture.channels.items():
        stored = edited.carried(channel.values) if values is None else values[name]
        kept_values = np.ascontiguousarray(stored[kept])
        kept_values[was_kept] = channel.kept_values[edited.kept_rows]
        channels[name] = Channel(channel.format, stored, channel.split_values[edited.split_rows], kept_values)
    return channels
