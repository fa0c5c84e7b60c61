"""Drafts: the part of a texture that an edit touches, cut out, edited as a texture of its own, and put back.

A *tile* is a cell of one level, the draft's, with all that is below it. A draft holds the open tiles, and at
each level above the cells that hold them, those beside these, and the children of both. All other nodes are
closed: leaves with the value of the node that they are. So what an edit near the middle of the open tiles
sees, and all averages above, are as in the whole.

Cells of a level stand in Morton order, so those of a tile are one run of each level: cutting and putting back
is copying runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
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

    def put_into(self, texture: OctreeTexture, shared: OctreeTexture | None = None) -> OctreeTexture:
        """Return the texture from which the change was made with it.

        If ``shared`` is given, arrays that it does not have may be written to: nobody else has them.
        """
        if self.tiles is None:
            return self.after
        if _is_same(self.before, self.after) and texture.channels.keys() == self.after.channels.keys():
            return _overwritten(texture, self.tiles, self.before, self.after, shared)
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

    def numbers(self) -> Int64s:
        """Return all numbers of the runs."""
        counts = self.ends - self.begins
        return np.repeat(self.begins - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())

    def of(self, arrays: Sequence[Array]) -> Array:
        """Join the runs of an array of each texture."""
        runs = zip(*(column.tolist() for column in self), strict=True)
        return np.concatenate([arrays[owner][begin:end] for owner, begin, end in runs] or [arrays[0][:0]])


#: The root, the first of all textures.
_ROOT = Runs(*np.array([[0], [0], [1]], np.int64))


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
    """Return the draft of some open tiles."""
    tree = texture.tree
    codes, is_node, numbers = np.zeros(1, np.int64), np.full(1, tree.n_nodes > 0), np.zeros(1, np.int64)
    cells, nodes, closed = [_ROOT], list[Runs](), list[Bools]()
    for level, opened in enumerate(_opened(tiles)):
        if level:
            codes, is_node = _child_codes(tree, numbers, codes)
            found, below = _children([tree], nodes[-1])
            cells.append(Runs.joined(found))
            numbers = below.numbers()
        is_open = is_node & among(codes, opened)
        closed.append(is_node & ~is_open)
        codes, numbers = codes[is_open], numbers[is_open[is_node]]
        nodes.append(Runs.of_numbers(np.zeros_like(numbers), numbers))
    _add_below([tree], cells, nodes)
    turned = np.concatenate(closed)
    made = _joined([texture], texture, cells, nodes, turned)
    stays = ~among(made.tree.kept.cells.astype(np.int64), np.flatnonzero(turned))  # leaves keep nothing
    if stays.all():
        return made
    tree = made.tree
    flags = tree.arrays.flags.copy()
    flags[: turned.size][turned] &= np.uint8(0xFF ^ KEPT)
    tree = tree.with_cell_data(flags, tree.arrays.areas, tree.split, KeptTable(tree.kept.cells[stays]))
    channels = {
        name: channel._replace(kept_values=channel.kept_values[stays])
        for name, channel in made.channels.items()
    }
    return made.with_cells(tree, channels)


def _opened(tiles: Tiles) -> list[Int64s]:
    """Return the codes of the cells that are open if they are nodes, from the root down to the tiles."""
    found = [tiles.codes]
    for level in range(tiles.level - 1, 0, -1):
        found.append(with_boundary(distinct(tiles.codes >> 3 * (tiles.level - level)), level))
    return [np.zeros(1, np.int64), *reversed(found)]


def _child_codes(tree: Octree, numbers: Int64s, codes: Int64s) -> tuple[Int64s, Bools]:
    """Return the codes of the children of nodes, given by numbers and codes, and which of them are nodes."""
    words = tree.arrays.groups[numbers >> 3, :2] >> (8 * (numbers & 7)).astype(np.uint64)[:, None]
    nodes, leaves = np.unpackbits(words.astype(np.uint8).T[:, :, None], axis=2, bitorder="little")
    stored = (nodes | leaves) != 0
    return (codes[:, None] << 3 | np.arange(8))[stored], nodes[stored] != 0


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


def _overwritten(
    texture: OctreeTexture,
    tiles: Tiles,
    before: OctreeTexture,
    after: OctreeTexture,
    shared: OctreeTexture | None,
) -> OctreeTexture:
    """Return what `put_back` does for a draft of the same cells: only arrays that differ are copied.

    Those that ``shared`` does not have are written to.
    """
    tree, draft = texture.tree, after.tree
    here, there = [], []  # the numbers of cells in the texture, and in the draft
    for level, (codes, is_node) in enumerate(islice(draft.walk(), tiles.level + 1)):
        where = locate(tree, codes, level)
        is_open = is_node | where.is_leaf
        here.append(where.cells[is_open])
        there.append(np.flatnonzero(is_open) + draft.arrays.level_cells[level])
        numbers = where.nodes[is_node]
    cells: list[Runs] = []
    _add_below([tree], cells, [Runs.of_numbers(np.zeros_like(numbers), numbers)])
    here = np.concatenate([*here, *(own.numbers() for own in cells)])
    end = draft.arrays.level_cells[min(tiles.level, draft.max_depth) + 1]
    there = np.concatenate([*there, np.arange(end, draft.n_cells)])
    targets = here, rows_of(tree.split, here).rows, _kept_among(tree, here)
    sources = there, rows_of(draft.split, there).rows, _kept_among(draft, there)
    counts = draft.n_cells, draft.split.areas.size, draft.kept.cells.size
    places = [np.full(count, -1, np.int64) for count in counts]  # of the draft's rows, in the texture
    for place, target, source in zip(places, targets, sources, strict=True):
        place[source] = target
    taken = set() if shared is None else {each.ctypes.data for each in _arrays(shared)}
    written: list[tuple[Array, Array, Array]] = []  # to once all have been copied: errors leave all as it was

    def changed(whole: Array, was: Array, own: Array, place: Int64s) -> Array:
        differs = was != own
        if differs.ndim > 1:
            differs = np.logical_or.reduce(list(differs.T))  # twice as fast as along an axis of three
        rows = np.flatnonzero(differs & (place >= 0))
        if not rows.size:
            return whole
        made = whole if whole.flags.writeable else whole.base
        is_free = shared is not None and whole.ctypes.data not in taken
        if not (is_free and isinstance(made, np.ndarray) and made.flags.writeable):
            made = whole.copy()
        written.append((made, place[rows], own[rows]))
        return made

    flags, areas = (
        changed(*arrays, places[0])
        for arrays in zip(tree.arrays[3:], before.tree.arrays[3:], draft.arrays[3:], strict=True)
    )
    channels = {}
    for name, (form, *stored) in texture.channels.items():
        parts = stored, before.channels[name][1:], after.channels[name][1:], places
        channels[name] = Channel(form, *(changed(*part) for part in zip(*parts, strict=True)))
    made = texture.with_cells(tree.with_cell_data(flags, areas, tree.split, tree.kept), channels)
    for array, at, values in written:
        array[at] = values
    return made


def _kept_among(tree: Octree, cells: Int64s) -> Int64s:
    """Return the rows of the kept nodes among cells."""
    return np.flatnonzero(among(tree.kept.cells.astype(np.int64), cells))


def put_together(
    top: OctreeTexture, texture: OctreeTexture, drafts: Sequence[tuple[Tiles, OctreeTexture]]
) -> OctreeTexture:
    """Return a texture of the cells above the tiles' level of one, and from there on of others.

    These are, in each draft's open tiles, that draft; no two have a tile in common. In all other tiles it is
    ``texture``. ``top`` says which tiles there are.
    """
    level, textures = drafts[0][0].level, [top, texture, *(draft for _, draft in drafts)]
    trees = [each.tree for each in textures]
    cells, nodes, turned = [_ROOT], [_ROOT], [np.zeros(1, np.bool_)]
    for at, (codes, is_node) in enumerate(islice(top.tree.walk(), 1, level + 1), 1):
        owners = np.zeros(codes.size, np.int64)  # of what is to stand here
        numbers = int(top.tree.arrays.level_cells[at]) + np.arange(codes.size)
        own_nodes = np.where(is_node, int(top.tree.arrays.level_nodes[at]) + np.cumsum(is_node) - 1, -1)
        if at == level:
            owners[:] = 1
            for number, (tiles, _) in enumerate(drafts, 2):
                owners[among(codes, tiles.codes)] = number
        else:
            where = locate(texture.tree, codes, at)
            owners[~is_node & (where.levels == at) & ~where.is_leaf] = 1
        for number in distinct(owners[owners > 0]).tolist():
            own = owners == number
            where = locate(trees[number], codes[own], at)
            numbers[own], own_nodes[own] = where.cells, where.nodes
        found, below = _children(trees, nodes[-1])
        # Cells of the top stand for themselves, or for what is in their place; those of others follow in runs.
        counts = np.where(found.owners == 0, found.ends - found.begins, 1)
        index = np.repeat(np.arange(counts.size), counts)
        is_top = found.owners[index] == 0

        def spread(of_top: Int64s, of_others: Int64s, index: Int64s = index, is_top: Bools = is_top) -> Int64s:
            every = of_others[index]
            every[is_top] = of_top
            return every

        is_below = own_nodes >= 0
        cells_owned = spread(owners, found.owners), spread(numbers, found.begins), spread(numbers + 1, found.ends)
        cells.append(Runs.joined(cells_owned))
        nodes.append(
            Runs.joined(
                (
                    cells_owned[0],
                    spread(own_nodes, below.begins),
                    spread(own_nodes + is_below, below.ends),
                )
            )
        )
        is_turned = spread((is_below != is_node).astype(np.int64), np.zeros_like(counts))
        turned.append(np.repeat(is_turned != 0, cells_owned[2] - cells_owned[1]))
    _add_below(trees, cells, nodes)
    return _joined(textures, top, cells, nodes, np.concatenate(turned))


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


def _children(trees: Sequence[Octree], nodes: Runs) -> tuple[Runs, Runs]:
    """Return the runs of the children of runs of nodes: of cells, and of those of them that are nodes."""
    first, last = np.zeros((2, 2, nodes.owners.size), np.int64)
    for number, tree in enumerate(trees):
        own = nodes.owners == number
        first[:, own] = children_before(tree.arrays.groups, nodes.begins[own])
        last[:, own] = children_before(tree.arrays.groups, nodes.ends[own])
    return Runs(nodes.owners, first[0], last[0]), Runs(nodes.owners, first[1], last[1])


def _add_below(trees: Sequence[Octree], cells: list[Runs], nodes: list[Runs]) -> None:
    """Add all below the last runs of nodes, level by level: the runs of cells, and of nodes."""
    while True:
        found, below = _children(trees, nodes[-1])
        if not (found.begins < found.ends).any():
            return
        cells.append(Runs.joined(found))
        nodes.append(Runs.joined(below))


def _joined(
    textures: Sequence[OctreeTexture],
    like: OctreeTexture,
    cells: Sequence[Runs],
    nodes: Sequence[Runs],
    turned: Bools,
) -> OctreeTexture:
    """Return a texture of runs of cells and nodes of others, level by level, with the channels of one.

    Of the first cells those ``turned`` are nodes instead of leaves, or the other way round.
    """
    counts = np.array([[(own.ends - own.begins).sum() for own in runs] for runs in (cells, nodes)], np.int64)
    counts = counts[:, : np.count_nonzero(counts[0])]
    level_cells, level_nodes = np.pad(np.cumsum(counts, axis=1), ((0, 0), (1, 0)))
    every, above = (Runs.joined(*runs) for runs in (cells, nodes))
    n_nodes = int(level_nodes[-1])
    masks = np.zeros((2, -(-n_nodes // 8) * 8), np.uint8)
    for word, own in enumerate(masks):
        own[:n_nodes] = above.of([masks_of(each.tree.arrays.groups, word) for each in textures])
    _turn(masks, turned)
    trees = [each.tree for each in textures]
    flags = every.of([tree.arrays.flags for tree in trees])
    areas = every.of([tree.arrays.areas for tree in trees])
    split_cells, split_runs, row_runs = _split_runs(trees, every)
    kept_cells, kept_runs = _listed([tree.kept.cells for tree in trees], every)
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
        own_channels = [each.channels[name] for each in textures]
        channels[name] = Channel(
            channel.format,
            every.of([own.values for own in own_channels]),
            row_runs.of([own.split_values for own in own_channels]),
            kept_runs.of([own.kept_values for own in own_channels]),
        )
    return like.with_cells(tree, channels)


@kernel
def _turn(masks: Uint8s, turned: Bools) -> None:
    """Make leaves of those of the first cells that are nodes and ``turned``, or nodes of leaves."""
    cell = 1
    for node in range(masks.shape[1]):
        if cell >= turned.size:
            break
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
