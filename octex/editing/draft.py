"""Drafts: the part of a texture that an edit touches, cut out, edited as a texture, and put back.

A *tile* is a cell of one level, the draft's, with all cells below it. A draft has the open tiles. At each
level above it has the cells that contain them, the neighbours of these, and the children of both. All other
nodes are closed: they become leaves with the node's value. So an edit near the middle of the open tiles, and
all averages above, get the same values as in the whole texture.

A tile's cells are one run of each level, so cutting out and putting back copies runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Int64s, Uint8s
from octex.channels import ALPHA, ONE
from octex.editing.runs import ROOT, Runs, add_below, children_in, joined_runs
from octex.errors import ArgumentError
from octex.jit import kernel
from octex.texture import Channel, OctreeTexture
from octex.tree.children import children_before
from octex.tree.edit import among, locate, with_all_above
from octex.tree.layout import KEPT, KeptTable
from octex.tree.neighbours import with_boundary
from octex.tree.octree import Octree, distinct
from octex.tree.split import rows_of

#: A tile is 2³ times as wide as the largest leaves, kept nodes and edited cells in the open tiles. An edit
#: reads less than that around the edited cells.
STEPS = 3
#: A draft with more than this part of a texture's cells is not worth making.
_MOST = 0.5


class OpenTiles(NamedTuple):
    """The open tiles of a draft."""

    level: int
    codes: Int64s  # (n,)   Morton codes, ascending


class Change(NamedTuple):
    """An edit's change: its open tiles, and the draft before and after it.

    Both drafts are textures, small if the edit was.
    """

    tiles: OpenTiles | None  # None: the whole texture
    before: OctreeTexture
    after: OctreeTexture

    @property
    def nbytes(self) -> int:
        """Bytes of both drafts."""
        return self.before.nbytes + self.after.nbytes

    @property
    def has_same_cells(self) -> bool:
        """Whether both drafts have the same cells, split cells and kept nodes."""
        before, after = self.before.tree, self.after.tree
        arrays: list[list[Array]] = [[*tree.arrays[:3], *tree.split, *tree.kept] for tree in (before, after)]
        is_same = all(np.array_equal(was, now) for was, now in zip(*arrays, strict=True))
        return is_same and self.before.channels.keys() == self.after.channels.keys()

    def inverted(self) -> Change:
        """Return the change that undoes this one."""
        return Change(self.tiles, self.after, self.before)

    def applied(self, texture: OctreeTexture) -> OctreeTexture:
        """Return a texture with this change.

        Raises ArgumentError for a texture that differs from the one that the change started from.
        """
        draft, before = texture, self.before
        is_like = before.channels.keys() == draft.channels.keys() and before.placement == draft.placement
        if self.tiles is not None:
            is_like &= self.tiles.level <= texture.tree.max_depth
            draft = cut_out(texture, self.tiles) if is_like else draft
        if not (is_like and all(map(np.array_equal, _arrays(draft), _arrays(before)))):
            raise ArgumentError("the change belongs to another texture, or to an earlier version of this one")
        return self.put_into(texture)

    def put_into(self, texture: OctreeTexture, shared: OctreeTexture | None = None) -> OctreeTexture:
        """Return the texture that the change started from, with the change.

        With ``shared``, it may write to arrays that ``shared`` lacks: nobody else uses them.
        """
        if self.tiles is None:
            return self.after
        if self.has_same_cells and texture.channels.keys() == self.after.channels.keys():
            return _overwritten(texture, self.tiles, self.before, self.after, shared)
        return put_back(texture, self.tiles, self.after)


def as_change(change: Change) -> Change:
    """Return a checked change, or raise ArgumentError."""
    if not isinstance(change, Change):
        raise ArgumentError(f"change must be what a stroke returns, not {type(change).__name__}")
    return change


def tiles_around(texture: OctreeTexture, codes: Sequence[Int64s], coarsest: int) -> OpenTiles | None:
    """Return the tiles for an edit of cells, listed by level; None if they are most of the texture.

    ``coarsest`` is the result of `coarsest_near` for these cells.
    """
    tree, level = texture.tree, coarsest - STEPS
    if not 0 < level < tree.max_depth:
        return None
    edited = np.concatenate([cells >> 3 * (at - level) for at, cells in enumerate(codes) if cells.size])
    edited = distinct(edited)
    around = np.concatenate([with_boundary(edited, level), brightest_tiles(texture, level)])
    tiles = OpenTiles(level, distinct(around))
    return tiles if _is_small(tree, tiles) else None


def change_in(tiles: OpenTiles, before: OctreeTexture, after: OctreeTexture) -> Change:
    """Return the change between two textures that differ only in tiles and above them."""
    if not _is_small(before.tree, tiles):
        return Change(None, before, after)
    return Change(tiles, cut_out(before, tiles), cut_out(after, tiles))


def joined_change(changes: Sequence[Change], before: OctreeTexture, after: OctreeTexture) -> Change:
    """Return consecutive changes as one, from the first one's texture to the last one's."""
    tiles = [change.tiles for change in changes if change.tiles is not None]
    if len(changes) == 1:
        return changes[0]
    if len(tiles) < len(changes):
        return Change(None, before, after)
    level = min(each.level for each in tiles)
    parents = distinct(np.concatenate([each.codes >> 3 * (each.level - level + 1) for each in tiles]))
    siblings = (parents[:, None] << 3 | np.arange(8)).ravel()  # a closed node is a leaf to its parent
    return change_in(OpenTiles(level, siblings), before, after)


def change_of_values(before: OctreeTexture, after: OctreeTexture) -> Change | None:
    """Return the change between textures of the same cells, with all tiles whose values differ, or None."""
    tree = after.tree
    level = coarsest_of(tree) - STEPS
    differs = np.zeros(tree.n_cells, np.bool_)
    owners, kept = rows_of(tree.split).cells, tree.kept.cells
    for name, channel in after.channels.items():
        for now, was, cells in zip(channel[1:], before.channels[name][1:], (None, owners, kept), strict=True):
            if now is was:
                continue
            differing = np.logical_or.reduce(list((now != was).T))
            if cells is None:
                differs |= differing
            else:
                differs[cells[differing]] = True
    if not differs.any():
        return None
    if level < 1:
        return Change(None, before, after)
    parents = [
        tree.level_codes(at)[differs[first:end]] >> 3 * (at - level + 1)
        for at, (first, end) in enumerate(pairwise(tree.arrays.level_cells.tolist()))
        if at > level
    ]
    siblings = distinct(np.concatenate(parents))[:, None] << 3 | np.arange(8)  # see `joined_change`
    return change_in(OpenTiles(level, siblings.ravel()), before, after)


def brightest_tiles(texture: OctreeTexture, level: int) -> Int64s:
    """Return the tiles with the brightest light of channels above 1, since it limits averages."""
    tree, bright_cells = texture.tree, []
    for channel in texture.channels.values():
        if channel.format.space not in ("srgb", "linear") or not channel.format.dtype.startswith("float"):
            continue
        owners: tuple[Sequence[int] | Int64s, ...] = range(tree.n_cells), rows_of(tree.split).cells
        for stored, cells in zip(channel[1:3], owners, strict=True):
            row = int(stored.argmax()) // stored.shape[1] if stored.size else 0
            if stored[row : row + 1].max(initial=0) > 1:
                bright_cells.append(int(cells[row]))
    tiles = [np.empty(0, np.int64)]
    if not bright_cells:
        return tiles[0]
    codes, is_node = tree.walked_to(level)
    begins = np.arange(*tree.arrays.level_nodes[level : level + 2])
    for deeper in range(level + 1, tree.max_depth + 1):
        firsts, begins = children_before(tree.arrays.groups, begins)
        first, end = tree.arrays.level_cells[deeper : deeper + 2]
        level_cells = [cell for cell in bright_cells if first <= cell < end]
        tiles.append(codes[is_node][np.searchsorted(firsts, level_cells, "right") - 1])
    return np.concatenate(tiles)


def coarsest_of(tree: Octree) -> int:
    """Return the level of the largest leaf or kept node of a tree."""
    leaves = (level for level, (count, _) in enumerate(tree.cells_by_depth()) if count)
    kept = np.searchsorted(tree.arrays.level_cells, tree.kept.cells[:1], "right") - 1
    return int(min([next(leaves, 0), *kept.tolist()]))


def coarsest_near(tree: Octree, codes: Sequence[Int64s]) -> int:
    """Return the level of the largest leaf or kept node that contains cells or neighbours them.

    The cells are listed by level, and neighbours counted at their level. Without any, return the level of the
    largest of these cells.
    """
    largest = next((level for level, cells in enumerate(codes) if cells.size), 0)
    first = coarsest_of(tree)
    above = with_all_above(codes)[first:largest] if first < largest else []
    for level, cells in enumerate(above, first):
        located = locate(tree, with_boundary(cells, level), level)
        is_kept = tree.arrays.flags[located.cells] & KEPT != 0
        if ((located.levels == level) & (located.is_leaf | is_kept)).any():
            return level
    return largest


def _is_small(tree: Octree, tiles: OpenTiles) -> bool:
    """Return whether a draft has few cells compared with the tree."""
    count = int(tree.arrays.level_cells[tiles.level + 1]) + int(cells_in(tree, tiles).sum())
    return count <= _MOST * tree.n_cells


def cells_in(tree: Octree, tiles: OpenTiles) -> Int64s:
    """Count the cells below tiles (n,)."""
    located = locate(tree, tiles.codes, tiles.level)
    is_inner = (located.levels == tiles.level) & ~located.is_leaf
    counts = np.zeros(is_inner.size, np.int64)
    groups, begins = tree.arrays.groups, located.nodes[is_inner]
    ends = begins + 1
    for _ in range(tiles.level, tree.max_depth):
        (first, begins), (last, ends) = children_before(groups, begins), children_before(groups, ends)
        counts[is_inner] += last - first
    return counts


def cut_out(texture: OctreeTexture, tiles: OpenTiles) -> OctreeTexture:
    """Return the draft of open tiles."""
    tree = texture.tree
    codes, is_node, numbers = np.zeros(1, np.int64), np.full(1, tree.n_nodes > 0), np.zeros(1, np.int64)
    cells, nodes, closed = [ROOT], list[Runs](), list[Bools]()
    for level, opened in enumerate(_opened(tiles)):
        if level:
            codes, is_node = _child_codes(tree, numbers, codes)
            children, below = children_in([tree], nodes[-1])
            cells.append(Runs.joined(children))
            numbers = below.numbers()
        is_open = is_node & among(codes, opened)
        closed.append(is_node & ~is_open)
        codes, numbers = codes[is_open], numbers[is_open[is_node]]
        nodes.append(Runs.of_numbers(numbers))
    add_below([tree], cells, nodes)
    turned = np.concatenate(closed)
    draft = joined_runs([texture], texture, cells, nodes, turned)
    stays_kept = ~among(draft.tree.kept.cells.astype(np.int64), np.flatnonzero(turned))  # leaves keep nothing
    if stays_kept.all():
        return draft
    tree = draft.tree
    flags = tree.arrays.flags.copy()
    flags[: turned.size][turned] &= np.uint8(0xFF ^ KEPT)
    tree = tree.with_cell_data(flags, tree.arrays.areas, tree.split, KeptTable(tree.kept.cells[stays_kept]))
    channels = {
        name: channel._replace(kept_values=channel.kept_values[stays_kept])
        for name, channel in draft.channels.items()
    }
    return draft.with_cells(tree, channels)


def _opened(tiles: OpenTiles) -> list[Int64s]:
    """Return the codes of the cells that stay nodes in a draft, from the root down to the tiles."""
    above = [tiles.codes >> 3 * (tiles.level - level) for level in range(1, tiles.level)]
    around = [with_boundary(distinct(codes), level) for level, codes in enumerate(above, 1)]
    return [np.zeros(1, np.int64), *around, tiles.codes]


def _child_codes(tree: Octree, numbers: Int64s, codes: Int64s) -> tuple[Int64s, Bools]:
    """Return the codes of the children of nodes, from numbers and codes, and which children are nodes."""
    words = tree.arrays.groups[numbers >> 3, :2] >> (8 * (numbers & 7)).astype(np.uint64)[:, None]
    nodes, leaves = np.unpackbits(words.astype(np.uint8).T[:, :, None], axis=2, bitorder="little")
    stored = (nodes | leaves) != 0
    return (codes[:, None] << 3 | np.arange(8))[stored], nodes[stored] != 0


def put_back(texture: OctreeTexture, tiles: OpenTiles, draft: OctreeTexture) -> OctreeTexture:
    """Return a texture with an edited draft's cells in the open tiles and above them."""
    if ALPHA.name in draft.channels and ALPHA.name not in texture.channels:
        texture = with_alpha(texture)
    return put_together(draft, texture, [(tiles, draft)])


def numbers_in(texture: OctreeTexture, tiles: OpenTiles, draft: OctreeTexture) -> Int64s:
    """Return each draft cell's number in the texture; −1 for closed ones."""
    tree = texture.tree
    numbers = np.full(draft.tree.n_cells, -1, np.int64)
    nodes = numbers[:0]
    for level, (codes, is_node) in enumerate(islice(draft.tree.walk(), tiles.level + 1)):
        located = locate(tree, codes, level)
        numbers[draft.tree.cells_at(level)] = np.where(is_node | located.is_leaf, located.cells, -1)
        nodes = located.nodes[is_node]
    cells: list[Runs] = []
    add_below([tree], cells, [Runs.of_numbers(nodes)])
    cells_below = np.concatenate([nodes[:0], *(runs.numbers() for runs in cells)])
    numbers[numbers.size - cells_below.size :] = cells_below
    return numbers


def _overwritten(
    texture: OctreeTexture,
    tiles: OpenTiles,
    before: OctreeTexture,
    after: OctreeTexture,
    shared: OctreeTexture | None,
) -> OctreeTexture:
    """Return the result of `put_back` for a draft of the same cells; copy only arrays that differ.

    It writes to arrays that ``shared`` lacks.
    """
    tree, draft = texture.tree, after.tree
    numbers = numbers_in(texture, tiles, after)
    if tiles.level <= draft.max_depth:  # leaves next to the tiles stay
        numbers[draft.cells_at(tiles.level)][~among(draft.level_codes(tiles.level), tiles.codes)] = -1
    draft_cells = np.flatnonzero(numbers >= 0)
    sizes = draft.split.areas.size, draft.kept.cells.size
    numbers_by_table = [numbers, *(np.full(size, -1, np.int64) for size in sizes)]
    cells = numbers[draft_cells]
    numbers_by_table[1][rows_of(draft.split, draft_cells).rows] = rows_of(tree.split, cells).rows
    kept, draft_kept = (each.kept.cells.astype(np.int64) for each in (tree, draft))
    numbers_by_table[2][among(draft_kept, draft_cells)] = np.flatnonzero(among(kept, cells))
    shared_addresses = set() if shared is None else {each.ctypes.data for each in _arrays(shared)}
    writes: list[tuple[Array, Array, Int64s]] = []  # once all copies exist: an error changes nothing

    def changed(whole: Array, was: Array, now: Array, numbers: Int64s) -> Array:
        if np.array_equal(was, now):
            return whole
        target = whole if whole.flags.writeable else whole.base
        is_free = shared is not None and whole.ctypes.data not in shared_addresses
        if not (is_free and isinstance(target, np.ndarray) and target.flags.carray):
            target = whole.copy()
        writes.append((target, now, numbers))
        return target

    flags, areas = (
        changed(*arrays, numbers_by_table[0])
        for arrays in zip(tree.arrays[3:], before.tree.arrays[3:], draft.arrays[3:], strict=True)
    )
    channels = {}
    for name, (form, *stored) in texture.channels.items():
        parts = stored, before.channels[name][1:], after.channels[name][1:], numbers_by_table
        channels[name] = Channel(form, *(changed(*part) for part in zip(*parts, strict=True)))
    edited = texture.with_cells(tree.with_cell_data(flags, areas, tree.split, tree.kept), channels)
    for array, rows, numbers in writes:
        new = np.ascontiguousarray(rows).view(np.uint8).reshape(len(rows), -1)
        _write(array.view(np.uint8).reshape(len(array), -1), new, numbers)
    return edited


@kernel
def _write(whole: Uint8s, rows: Uint8s, numbers: Int64s) -> None:
    """Write rows of bytes to the rows of a whole with these numbers; −1 is none."""
    for n in range(numbers.size):
        if 0 <= numbers[n] < whole.shape[0]:
            for k in range(whole.shape[1]):
                whole[numbers[n], k] = rows[n, k]


def put_together(
    top: OctreeTexture, texture: OctreeTexture, drafts: Sequence[tuple[OpenTiles, OctreeTexture]]
) -> OctreeTexture:
    """Return a texture with the cells of ``top`` above the tiles' level, and cells of others from there on.

    Each draft fills its open tiles; drafts share no tile. ``texture`` fills the other tiles. ``top``
    determines which tiles exist.
    """
    level, textures = drafts[0][0].level, [top, texture, *(draft for _, draft in drafts)]
    trees = [each.tree for each in textures]
    cells, nodes, turned = [ROOT], [ROOT], [np.zeros(1, np.bool_)]
    for at, (codes, is_node) in enumerate(islice(top.tree.walk(), 1, level + 1), 1):
        owners = np.zeros(codes.size, np.int64)  # the texture that each cell comes from
        numbers = int(top.tree.arrays.level_cells[at]) + np.arange(codes.size)
        cell_nodes = np.where(is_node, int(top.tree.arrays.level_nodes[at]) + np.cumsum(is_node) - 1, -1)
        if at == level:
            owners[:] = 1
            for number, (tiles, _) in enumerate(drafts, 2):
                owners[among(codes, tiles.codes)] = number
        else:
            located = locate(texture.tree, codes, at)
            owners[~is_node & (located.levels == at) & ~located.is_leaf] = 1
        for number in distinct(owners[owners > 0]).tolist():
            is_owned = owners == number
            located = locate(trees[number], codes[is_owned], at)
            numbers[is_owned], cell_nodes[is_owned] = located.cells, located.nodes
        has_children = cell_nodes >= 0
        children, below = children_in(trees, nodes[-1])
        # Cells of the top are copied one by one, from any texture; others in runs.
        counts = np.where(children.owners == 0, children.ends - children.begins, 1)
        rows = np.stack([*children, below.begins, below.ends]).repeat(counts, axis=1)
        is_top = rows[0] == 0
        rows[:, is_top] = owners, numbers, numbers + 1, cell_nodes, cell_nodes + has_children
        cells.append(Runs.joined(rows[:3]))
        nodes.append(Runs.joined(rows[[0, 3, 4]]))
        ends = np.cumsum(rows[2] - rows[1])
        turned.append(np.zeros(int(ends[-1]), np.bool_))
        turned[-1][ends[is_top] - 1] = has_children != is_node
    add_below(trees, cells, nodes)
    return joined_runs(textures, top, cells, nodes, np.concatenate(turned))


def with_alpha(texture: OctreeTexture) -> OctreeTexture:
    """Give a texture a channel alpha: opaque."""
    opaque = Channel.full(ALPHA, texture.tree, ONE[ALPHA.dtype])
    return texture.with_cells(texture.tree, {**texture.channels, ALPHA.name: opaque})


def with_channels_of(draft: OctreeTexture, texture: OctreeTexture) -> OctreeTexture:
    """Return a draft reduced to the channels of a texture."""
    if draft.channels.keys() == texture.channels.keys():
        return draft
    channels = {name: draft.channels[name] for name in texture.channels}
    return draft.with_cells(draft.tree, channels)


def _arrays(texture: OctreeTexture) -> list[Array]:
    """Return all arrays of a texture."""
    tree = texture.tree
    channels = [array for name in sorted(texture.channels) for array in texture.channels[name][1:]]
    return [*tree.arrays, *tree.split, *tree.kept, *channels]
