"""Drafts: the part of a texture that an edit touches, cut out, edited as a texture of its own, and put back.

A *tile* is a cell of one level, the draft's, with all that is below it. A draft holds all cells down to that
level, and below it only the open tiles; the others are closed: leaves with the value of the node that they
are. So what an edit near the middle of the open tiles sees, and all averages above, are as in the whole.

Cells of a level stand in Morton order, so those of a tile are one run of each level: cutting and putting back
is copying runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Int64s, Uint8s, Uint32s, bit_counts
from octex.channels import ALPHA, ONE
from octex.errors import ArgumentError
from octex.jit import kernel
from octex.texture import Channel, OctreeTexture
from octex.tree.beside import with_boundary
from octex.tree.children import children_before, groups_of, masks_of
from octex.tree.edit import among, locate, with_all_above
from octex.tree.layout import KEPT, KeptTable, SplitTable, TreeArrays
from octex.tree.octree import Octree, distinct
from octex.tree.split import counts_of, rows_of

#: A tile is 2³ times as wide as the largest leaves, kept nodes and edited cells in the open tiles: an edit
#: reads less than that around what it edits.
STEPS = 3
#: Drafts of more than this part of a texture's cells are no gain.
_MOST = 0.5


class Tiles(NamedTuple):
    """The open tiles of a draft."""

    level: int
    codes: Int64s  # (n,)   Morton codes, ascending


class Change(NamedTuple):
    """What an edit has changed: its open tiles, and the draft without and with it.

    Both are textures of their own, small where the edit was.
    """

    tiles: Tiles | None  # None: all of the texture
    before: OctreeTexture
    after: OctreeTexture

    @property
    def nbytes(self) -> int:
        """Bytes of both drafts."""
        return self.before.nbytes + self.after.nbytes

    def inverted(self) -> Change:
        """Return the change that undoes this one."""
        return Change(self.tiles, self.after, self.before)

    def applied(self, texture: OctreeTexture) -> OctreeTexture:
        """Return a texture with this change.

        Raises ArgumentError for a texture that is not as the one was from which the change was made.
        """
        here, before = texture, self.before
        is_like = before.channels.keys() == here.channels.keys() and before.placement == here.placement
        if is_like and self.tiles is not None:
            here = cut_out(texture, self.tiles)
        if not (is_like and all(map(np.array_equal, _arrays(here), _arrays(before)))):
            raise ArgumentError("the change belongs to another texture, or to an earlier version of this one")
        return self.put_into(texture)

    def put_into(self, texture: OctreeTexture) -> OctreeTexture:
        """Return the texture from which the change was made with it."""
        if self.tiles is None:
            return self.after
        if _is_same(self.before, self.after) and texture.channels.keys() == self.after.channels.keys():
            return _overwritten(texture, self.tiles, self.before, self.after)
        return put_back(texture, self.tiles, self.after)


class Runs(NamedTuple):
    """Cells, or nodes, of several textures, end to end."""

    owners: Int64s
    begins: Int64s
    ends: Int64s

    @classmethod
    def joined(cls, *parts: tuple[Int64s, Int64s, Int64s]) -> Runs:
        """Put runs one after the other; those that follow on each other become one."""
        owners, begins, ends = (np.concatenate(column) for column in zip(*parts, strict=True))
        some = begins < ends
        owners, begins, ends = owners[some], begins[some], ends[some]
        follows = np.zeros(owners.size + 1, np.bool_)
        follows[1:-1] = (owners[1:] == owners[:-1]) & (begins[1:] == ends[:-1])
        return cls(owners[~follows[:-1]], begins[~follows[:-1]], ends[~follows[1:]])

    @classmethod
    def of_numbers(cls, owners: Int64s, numbers: Int64s) -> Runs:
        """Return the runs of consecutive numbers of one owner."""
        return cls.joined((owners, numbers, numbers + 1))

    @classmethod
    def one(cls, owner: int, end: int) -> Runs:
        """Return the first run of a texture, up to ``end``."""
        return cls(*(np.array([number], np.int64) for number in (owner, 0, end)))

    def of(self, arrays: Sequence[Array]) -> Array:
        """Join the runs of an array of each texture."""
        runs = zip(*(column.tolist() for column in self), strict=True)
        return np.concatenate([arrays[owner][begin:end] for owner, begin, end in runs] or [arrays[0][:0]])


def tiles_around(texture: OctreeTexture, codes: Sequence[Int64s]) -> Tiles | None:
    """Return the tiles for an edit of cells, given level by level; None if that is most of the texture."""
    tree = texture.tree
    finest = next((level for level, own in enumerate(codes) if own.size), 0)
    level = coarsest_near(tree, codes, finest) - STEPS
    if not 0 < level < tree.max_depth:
        return None
    edited = _at(codes, level)
    around = np.concatenate([with_boundary(edited, level), brightest_tiles(texture, level)])
    tiles = Tiles(level, distinct(around))
    return tiles if _is_small(tree, tiles) else None


def change_in(tiles: Tiles, before: OctreeTexture, after: OctreeTexture) -> Change:
    """Return the change from one texture to another that differs in tiles, and above them, alone."""
    if not _is_small(before.tree, tiles):
        return Change(None, before, after)
    return Change(tiles, cut_out(before, tiles), cut_out(after, tiles))


def brightest_tiles(texture: OctreeTexture, level: int) -> Int64s:
    """Return the tiles with the most light of channels that have more than 1: it limits averages."""
    return _tiles_of(texture.tree, _brightest(texture), level)


def _brightest(texture: OctreeTexture) -> Int64s:
    """Return the cells with the most light of channels that have more than 1."""
    found = []
    split = texture.tree.split
    for channel in texture.channels.values():
        for number, stored in enumerate((channel.values, channel.split_values)):
            if channel.format.space not in ("srgb", "linear") or stored.dtype.kind != "f" or not stored.size:
                continue
            row = int(stored.argmax()) // stored.shape[1]
            if stored[row].max() > 1:
                ends = np.cumsum(counts_of(split.facings)) if number else None
                found.append(row if ends is None else int(split.cells[np.searchsorted(ends, row, "right")]))
    return np.array(found, np.int64)


def _tiles_of(tree: Octree, cells: Int64s, level: int) -> Int64s:
    """Return the tiles that hold cells; none for cells above them."""
    if not cells.size:
        return cells
    codes, is_node = tree.walked_to(level)
    begins = np.arange(*tree.arrays.level_nodes[level : level + 2])
    found = [codes[:0]]
    for deeper in range(level + 1, tree.max_depth + 1):
        firsts, begins = children_before(tree.arrays.groups, begins)
        own = cells[
            (cells >= tree.arrays.level_cells[deeper]) & (cells < tree.arrays.level_cells[deeper + 1])
        ]
        found.append(codes[is_node][np.searchsorted(firsts, own, "right") - 1])
    return np.concatenate(found)


def coarsest_of(tree: Octree) -> int:
    """Return the level of the largest leaf or kept node of a tree."""
    leaves = (level for level, (count, _) in enumerate(tree.cells_by_depth()) if count)
    kept = np.searchsorted(tree.arrays.level_cells, tree.kept.cells[:1], "right") - 1
    return int(min([next(leaves, 0), *kept.tolist()]))


def coarsest_near(tree: Octree, codes: Sequence[Int64s], finest: int) -> int:
    """Return the level of the largest leaf or kept node, down to ``finest``, that cells are in or beside.

    The cells are given level by level; beside it is what is so at its own level. ``finest`` if there is none.
    """
    first = coarsest_of(tree)
    above = with_all_above(codes)[first:finest] if first < finest else []
    for level, own in enumerate(above, first):
        where = locate(tree, with_boundary(own, level), level)
        is_kept = tree.arrays.flags[where.cells] & KEPT != 0
        if ((where.levels == level) & (where.is_leaf | is_kept)).any():
            return level
    return finest


def _at(codes: Sequence[Int64s], level: int) -> Int64s:
    """Return the cells of a level that hold cells given level by level, none of which is larger."""
    return distinct(np.concatenate([own >> 3 * (at - level) for at, own in enumerate(codes) if own.size]))


def _is_small(tree: Octree, tiles: Tiles) -> bool:
    """Say whether a draft's cells are few beside the tree's."""
    count = int(tree.arrays.level_cells[tiles.level + 1]) + int(cells_in(tree, tiles).sum())
    return count <= _MOST * tree.n_cells


def cells_in(tree: Octree, tiles: Tiles) -> Int64s:
    """Count the cells below tiles (n,)."""
    where = locate(tree, tiles.codes, tiles.level)
    there = (where.levels == tiles.level) & ~where.is_leaf
    counts = np.zeros(there.size, np.int64)
    groups, begins = tree.arrays.groups, where.nodes[there]
    ends = begins + 1
    for _ in range(tiles.level, tree.max_depth):
        (first, begins), (last, ends) = children_before(groups, begins), children_before(groups, ends)
        counts[there] += last - first
    return counts


def cut_out(texture: OctreeTexture, tiles: Tiles) -> OctreeTexture:
    """Return a texture of all cells down to the tiles' level, and of the open tiles."""
    tree, level = texture.tree, tiles.level
    codes, is_node = tree.walked_to(level)
    is_open = is_node & among(codes, tiles.codes)
    is_closed = is_node & ~is_open
    numbers = int(tree.arrays.level_nodes[level]) + np.flatnonzero(is_open[is_node])
    levels, cells, nodes = _below([tree], Runs.of_numbers(np.zeros_like(numbers), numbers))
    runs = (
        Runs.joined(Runs.one(0, int(tree.arrays.level_cells[level + 1])), *cells),
        Runs.joined(Runs.one(0, int(tree.arrays.level_nodes[level])), *nodes),
    )
    made = _joined([texture], texture, level, levels, runs, is_closed)
    tree, closed = made.tree, int(tree.arrays.level_cells[level]) + np.flatnonzero(is_closed)
    stays = ~among(tree.kept.cells.astype(np.int64), closed)  # as leaves these keep nothing
    if stays.all():
        return made
    flags = tree.arrays.flags.copy()
    flags[closed] &= np.uint8(0xFF ^ KEPT)
    tree = tree.with_cell_data(flags, tree.arrays.areas, tree.split, KeptTable(tree.kept.cells[stays]))
    channels = {
        name: channel._replace(kept_values=channel.kept_values[stays])
        for name, channel in made.channels.items()
    }
    return made.with_cells(tree, channels)


def put_back(texture: OctreeTexture, tiles: Tiles, draft: OctreeTexture) -> OctreeTexture:
    """Return a texture with what a draft, cut out of it and edited, has in the open tiles and above them."""
    if ALPHA.name in draft.channels and ALPHA.name not in texture.channels:
        texture = with_alpha(texture)
    return put_together(draft, texture, [(tiles, draft)])


def _is_same(before: OctreeTexture, after: OctreeTexture) -> bool:
    """Say whether an edit has left all cells, split cells and kept nodes where they were."""
    arrays: list[list[Array]] = [
        [*tree.arrays[:3], *tree.split, *tree.kept] for tree in (before.tree, after.tree)
    ]
    is_same = all(np.array_equal(was, now) for was, now in zip(*arrays, strict=True))
    return is_same and before.channels.keys() == after.channels.keys()


def cells_below(tree: Octree, tiles: Tiles) -> Int64s:
    """Return the numbers of the cells below tiles, ascending: those of a draft below the tiles' level."""
    codes, is_node = tree.walked_to(tiles.level)
    numbers = int(tree.arrays.level_nodes[tiles.level]) + np.flatnonzero(among(codes[is_node], tiles.codes))
    _, below, _ = _below([tree], Runs.of_numbers(np.zeros_like(numbers), numbers))
    runs = [
        np.arange(*run) for own in below for run in zip(own.begins.tolist(), own.ends.tolist(), strict=True)
    ]
    return np.concatenate([numbers[:0], *runs])


def _overwritten(
    texture: OctreeTexture, tiles: Tiles, before: OctreeTexture, after: OctreeTexture
) -> OctreeTexture:
    """Return what `put_back` does for a draft of the same cells: only arrays that differ are copied."""
    tree, draft, level = texture.tree, after.tree, tiles.level
    codes, _ = tree.walked_to(level)
    is_open = among(codes, tiles.codes)
    first, end = tree.arrays.level_cells[level : level + 2].tolist()
    top = np.concatenate([np.arange(first), first + np.flatnonzero(is_open)])
    # The cells' numbers in the texture, and in the draft.
    here = np.concatenate([top, cells_below(tree, tiles)])
    there = np.concatenate([top, np.arange(end, draft.n_cells)])
    targets, sources = (
        (own, rows_of(each.split, own).rows, among(each.kept.cells.astype(np.int64), own))
        for each, own in ((tree, here), (draft, there))
    )

    def changed(whole: Array, was: Array, own: Array, at: Array, source: Array) -> Array:
        if np.array_equal(was, own):
            return whole
        made = whole.copy()
        made[at] = own[source]
        return made

    flags, areas = (
        changed(*arrays, here, there)
        for arrays in zip(tree.arrays[3:], before.tree.arrays[3:], draft.arrays[3:], strict=True)
    )
    channels = {}
    for name, (form, *stored) in texture.channels.items():
        parts = stored, before.channels[name][1:], after.channels[name][1:], targets, sources
        channels[name] = Channel(form, *(changed(*part) for part in zip(*parts, strict=True)))
    return texture.with_cells(tree.with_cell_data(flags, areas, tree.split, tree.kept), channels)


def put_together(
    top: OctreeTexture, texture: OctreeTexture, drafts: Sequence[tuple[Tiles, OctreeTexture]]
) -> OctreeTexture:
    """Return a texture of the cells above the tiles' level of one, and from there on of others.

    These are, in each draft's open tiles, that draft; no two have a tile in common. In all other tiles it is
    ``texture``. ``top`` says which tiles there are.
    """
    level, textures = drafts[0][0].level, [top, texture, *(draft for _, draft in drafts)]
    codes, is_node = top.tree.walked_to(level)
    owners = np.ones(codes.size, np.int64)
    for number, (tiles, _) in enumerate(drafts, 2):
        owners[among(codes, tiles.codes)] = number
    cells, nodes = np.full((2, codes.size), -1, np.int64)  # each tile's numbers in its texture
    for number, each in enumerate(textures[1:], 1):
        of_tile = owners == number
        where = locate(each.tree, codes[of_tile], level)
        cells[of_tile], nodes[of_tile] = where.cells, where.nodes
    is_below = nodes >= 0
    trees = [each.tree for each in textures]
    levels, cells_below, nodes_below = _below(trees, Runs.of_numbers(owners[is_below], nodes[is_below]))
    runs = (
        Runs.joined(
            Runs.one(0, int(top.tree.arrays.level_cells[level])), Runs.of_numbers(owners, cells), *cells_below
        ),
        Runs.joined(Runs.one(0, int(top.tree.arrays.level_nodes[level])), *nodes_below),
    )
    return _joined(textures, top, level, levels, runs, is_below != is_node)


def with_alpha(texture: OctreeTexture) -> OctreeTexture:
    """Give a texture a channel alpha: opaque."""
    tree = texture.tree
    rows = tree.n_cells, tree.split.areas.size, tree.kept.cells.size
    opaque = (np.full((count, 1), ONE[ALPHA.dtype], ALPHA.dtype) for count in rows)
    return texture.with_cells(tree, {**texture.channels, ALPHA.name: Channel(ALPHA, *opaque)})


def with_channels_of(draft: OctreeTexture, texture: OctreeTexture) -> OctreeTexture:
    """Return a draft with those of its channels that a texture has."""
    if draft.channels.keys() == texture.channels.keys():
        return draft
    channels = {name: draft.channels[name] for name in texture.channels}
    return draft.with_cells(draft.tree, channels)


def _arrays(texture: OctreeTexture) -> list[Array]:
    """Return what a texture is made of."""
    tree = texture.tree
    channels = [array for name in sorted(texture.channels) for array in texture.channels[name][1:]]
    return [*tree.arrays, *tree.split, *tree.kept, *channels]


def _below(trees: Sequence[Octree], runs: Runs) -> tuple[list[tuple[int, int]], list[Runs], list[Runs]]:
    """Return all below runs of nodes of a level: level by level the runs of cells, and of nodes, these first.

    The first are how many cells each deeper level has, and how many nodes are above these.
    """
    counts: list[tuple[int, int]] = []
    cells: list[Runs] = []
    nodes = [runs]
    while True:
        first, last = np.zeros((2, 2, runs.owners.size), np.int64)
        for number, tree in enumerate(trees):
            own = runs.owners == number
            first[:, own] = children_before(tree.arrays.groups, runs.begins[own])
            last[:, own] = children_before(tree.arrays.groups, runs.ends[own])
        counts.append((int((last[0] - first[0]).sum()), int((runs.ends - runs.begins).sum())))
        if not counts[-1][0]:
            return counts, cells, nodes
        cells.append(Runs(runs.owners, first[0], last[0]))
        runs = Runs(runs.owners, first[1], last[1])
        nodes.append(runs)


def _joined(
    textures: Sequence[OctreeTexture],
    top: OctreeTexture,
    level: int,
    below: Sequence[tuple[int, int]],
    runs: tuple[Runs, Runs],
    turned: Bools,
) -> OctreeTexture:
    """Return a texture of runs of cells and nodes of others.

    Down to ``level`` it is as ``top``, but that of this level's cells those ``turned`` are nodes instead of
    leaves, or the other way round. ``below`` are the numbers of each deeper level's cells, and of the nodes
    above them.
    """
    cells, nodes = runs
    arrays = top.tree.arrays
    counts = [count for count, _ in below if count]
    level_cells = np.concatenate([arrays.level_cells[: level + 2], np.zeros(len(counts), np.int64)])
    level_cells[level + 2 :] = level_cells[level + 1] + np.cumsum(counts)
    level_nodes = np.concatenate([arrays.level_nodes[: level + 1], np.zeros(len(counts) + 1, np.int64)])
    level_nodes[level + 1 :] = level_nodes[level] + np.cumsum([count for _, count in below])
    n_nodes = int(level_nodes[-1])
    masks = np.zeros((2, -(-n_nodes // 8) * 8), np.uint8)
    for word, own in enumerate(masks):
        own[:n_nodes] = nodes.of([masks_of(each.tree.arrays.groups, word) for each in textures])
    _turn(masks, int(arrays.level_nodes[level - 1]), int(arrays.level_nodes[level]), turned)
    trees = [each.tree for each in textures]
    flags = cells.of([tree.arrays.flags for tree in trees])
    areas = cells.of([tree.arrays.areas for tree in trees])
    split_cells, split_runs, row_runs = _split_runs(trees, cells)
    kept_cells, kept_runs = _listed([tree.kept.cells for tree in trees], cells)
    split = SplitTable(
        split_cells,
        split_runs.of([tree.split.facings for tree in trees]),
        row_runs.of([tree.split.areas for tree in trees]),
    )
    tree = Octree(
        TreeArrays(groups_of(masks), level_cells, level_nodes, flags, areas), split, KeptTable(kept_cells)
    )
    channels = {}
    for name, channel in top.channels.items():
        own_channels = [each.channels[name] for each in textures]
        channels[name] = Channel(
            channel.format,
            cells.of([own.values for own in own_channels]),
            row_runs.of([own.split_values for own in own_channels]),
            kept_runs.of([own.kept_values for own in own_channels]),
        )
    return top.with_cells(tree, channels)


@kernel
def _turn(masks: Uint8s, first: int, end: int, turned: Bools) -> None:
    """Make leaves of those of the children of nodes first … end−1 that are nodes and ``turned``, or nodes."""
    cell = 0
    for node in range(first, end):
        children = masks[0, node] | masks[1, node]
        for octant in range(8):
            bit = np.uint8(1 << octant)
            if children & bit:
                if cell < turned.size and turned[cell]:
                    masks[0, node] ^= bit
                    masks[1, node] ^= bit
                cell += 1


def _split_runs(trees: Sequence[Octree], cells: Runs) -> tuple[Uint32s, Runs, Runs]:
    """Return the split cells among runs of cells, by new numbers, and the runs of them and of their rows."""
    found, runs = _listed([tree.split.cells for tree in trees], cells)
    ends = [
        np.concatenate([[0], np.cumsum(bit_counts(tree.split.facings), dtype=np.int64)]) for tree in trees
    ]
    firsts = np.cumsum([0, *map(len, ends)])[runs.owners]
    every = np.concatenate(ends)
    rows = Runs(runs.owners, every[firsts + runs.begins], every[firsts + runs.ends])
    return found, runs, rows


def _listed(tables: Sequence[Uint32s], cells: Runs) -> tuple[Uint32s, Runs]:
    """Return which of runs of cells tables list, by their new numbers, and the runs of the tables."""
    owners, begins, ends = cells
    counts = ends - begins
    shifts = np.cumsum(counts) - counts - begins
    first, last = np.zeros((2, owners.size), np.int64)
    for number, table in enumerate(tables):
        own = owners == number
        first[own] = np.searchsorted(table, begins[own].astype(np.uint32))
        last[own] = np.searchsorted(table, ends[own].astype(np.uint32))
    has = last > first
    runs = Runs(owners[has], first[has], last[has])
    found = runs.of(tables).astype(np.int64) + np.repeat(shifts[has], (last - first)[has])
    return found.astype(np.uint32), runs
