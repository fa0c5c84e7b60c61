"""A layer merged by tiles: only those around the paint, and of a large layer some at a time.

A piece is some tiles in Morton order. The paint in and beside them is merged into a draft of the texture, as
if there were no other; of that draft the tiles are kept. What is above the tiles is averaged at the end.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Int64s
from octex.conversion import large
from octex.editing.averages import with_summed_areas
from octex.editing.carried import carried
from octex.editing.draft import (
    STEPS,
    Change,
    Tiles,
    brightest_tiles,
    cells_in,
    change_in,
    coarsest_near,
    cut_out,
    put_together,
    tiles_around,
)
from octex.editing.nodes import nodes_at
from octex.editing.split import refaced
from octex.errors import own_making
from octex.painting.blend import Merge, Merged, averaged_above, no_parts
from octex.painting.cells import Paint, paint_of, some
from octex.painting.steps import delete_paint, merge_draft, refine_paint
from octex.parallel import Run, ordered_map, sharing, silent, workers
from octex.texture import Channel, OctreeTexture
from octex.tree.areas import SKIRT
from octex.tree.beside import with_boundary
from octex.tree.edit import among, locate, rebuilt, with_all_above
from octex.tree.octree import Octree, distinct

#: Cells of layer and texture that a piece has, about, without those beside it.
PIECE = 1 << 20
#: Pieces that are merged side by side at most, and where memory is scarce.
_AT_ONCE, _LEAST_AT_ONCE = 4, 2
#: If all pieces with what is beside them have more than so many times the cells that there are, they are no
#: gain.
MOST = 3.0
#: Begins the names under which a piece's top has how much of its channels is paint; no other name does.
_PART = "\0part of "


class Pieces(NamedTuple):
    """How a layer is divided."""

    level: int  # of the tiles
    coarsest: int  # the level of the largest leaf or kept node that the layer is in or beside
    tiles: list[Int64s]  # of each piece, Morton codes, ascending


class _Piece(NamedTuple):
    tiles: Tiles
    whole: OctreeTexture  # its tiles, and all above them
    top: OctreeTexture  # the tiles as leaves, with the parts that are paint
    averages_rows: bool  # see Merged
    painted: Int64s  # the tiles with paint
    new: Int64s  # with new cells
    fresh: Int64s  # with cells where the texture had nothing
    added: Int64s  # with cells of the layer there


def merge_layer(task: Merge) -> Change | None:
    """Merge a layer into a texture, piece by piece; return the change, or None if there is no paint."""
    texture, pieces = task.texture, pieces_of(task.texture, task.layer)
    if pieces is not None:
        with own_making():
            found = _merge_pieces(task, pieces)
        tiles = Tiles(pieces.level, np.concatenate(pieces.tiles))
        return None if found is None else change_in(tiles, texture, found)
    paint = paint_of(task.layer, task.opacity)
    if not any(each.codes.size for each in paint):
        return None
    around = tiles_around(texture, [each.codes for each in paint])
    draft = texture if around is None else cut_out(texture, around)
    merged = merge_draft(task, draft, paint)
    task.progress("merge", 1, 1)
    return None if merged is None else Change(around, draft, delete_paint(merged))


def pieces_of(texture: OctreeTexture, layer: OctreeTexture) -> Pieces | None:
    """Divide a layer for a texture; return None for one that is merged in one draft."""
    tree, painted = texture.tree, layer.tree
    if painted.n_leaves + tree.n_leaves <= PIECE or not tree.n_leaves or not painted.n_leaves:
        return None
    finest = next(level for level, (leaves, _) in enumerate(painted.cells_by_depth()) if leaves)
    codes, _ = next(islice(painted.walk(), finest, None))
    coarsest = coarsest_near(tree, [codes[:0]] * finest + [codes], finest)
    level = coarsest - STEPS
    if not 0 < level < tree.max_depth:
        return None
    tiles = Tiles(level, with_boundary(distinct(codes >> 3 * (finest - level)), level))
    counts = cells_in(painted, tiles) + cells_in(tree, tiles)
    numbers = (np.cumsum(counts) - counts) // PIECE
    found = [tiles.codes[numbers == number] for number in distinct(numbers)]
    around = (Tiles(level, with_boundary(own, level)) for own in found)
    total = sum(int(cells_in(painted, own).sum() + cells_in(tree, own).sum()) for own in around)
    if len(found) < 2 or total > MOST * counts.sum():
        return None
    return Pieces(level, coarsest, found)


def _merge_pieces(task: Merge, pieces: Pieces) -> OctreeTexture | None:
    """Return the texture with the layer, or None if there is no paint."""
    texture, level = task.texture, pieces.level
    bright = brightest_tiles(texture, level)

    def merge_piece(tiles: Int64s) -> _Piece | None:
        near = with_boundary(tiles, level)
        opened = Tiles(level, distinct(np.concatenate([with_boundary(near, level), bright])))
        layer = cut_out(task.layer, Tiles(level, near))
        with workers(Run(threads=1)) as one_worker:
            own = task._replace(layer=layer, coarsest=pieces.coarsest, executor=one_worker, progress=silent)
            made = merge_draft(
                own, cut_out(texture, opened), _inside(paint_of(layer, task.opacity), near, level)
            )
        return None if made is None else _piece_of(made, Tiles(level, tiles))

    window = _LEAST_AT_ONCE if large.is_mapped() else _AT_ONCE
    with sharing(task.executor) as pool:
        all_merged = ordered_map(
            pool, merge_piece, pieces.tiles, stage="merge", progress=task.progress, window=window
        )
        found = [large.moved(each) for each in all_merged if each is not None]
    if not any(each.painted.size for each in found):
        return None
    closed = Tiles(level, np.empty(0, np.int64))
    before, task = cut_out(texture, closed), task._replace(layer=cut_out(task.layer, closed))
    top = averaged_above(task, before, _top(before, task.layer, found))
    return put_together(delete_paint(top), texture, [(each.tiles, each.whole) for each in found])


def paint_by_tiles(
    texture: OctreeTexture, layer: OctreeTexture
) -> Iterator[tuple[OctreeTexture, list[Paint]]]:
    """Yield piece by piece what of a layer is around it, and its paint as it lies on a texture's leaves."""
    pieces = pieces_of(texture, layer)
    if pieces is None:
        yield layer, refine_paint(paint_of(layer, 1.0), layer, texture.tree, 1.0)
        return
    level = pieces.level
    for tiles in pieces.tiles:
        own = cut_out(layer, Tiles(level, with_boundary(tiles, level)))
        yield own, refine_paint(_inside(paint_of(own, 1.0), tiles, level), own, texture.tree, 1.0)


def _inside(paint: Sequence[Paint], tiles: Int64s, level: int) -> list[Paint]:
    """Return the paint on smaller cells in tiles."""
    return [
        some(each, among(each.codes >> 3 * (at - level), tiles) if at > level else slice(0))
        for at, each in enumerate(paint)
    ]


def _piece_of(made: Merged, tiles: Tiles) -> _Piece:
    """Return what a piece has in its tiles."""
    tree = made.texture.tree
    parts = {_PART + name: _named(own, _PART + name) for name, own in made.parts.channels.items()}
    top = made.texture.with_cells(tree, {**made.texture.channels, **parts})
    lists = made.painted, _codes_of(tree, made.is_new), _codes_of(tree, made.is_fresh), made.added
    return _Piece(
        tiles,
        cut_out(made.texture, tiles),
        cut_out(top, Tiles(tiles.level, tiles.codes[:0])),
        made.averages_rows,
        *(_tiles_with(codes, tiles) for codes in lists),
    )


def _named(channel: Channel, name: str) -> Channel:
    return channel._replace(format=channel.format._replace(name=name))


def _codes_of(tree: Octree, chosen: Bools) -> list[Int64s]:
    """Return the codes of some cells (cells,), by level."""
    ends = tree.arrays.level_cells
    return [codes[chosen[ends[level] : ends[level + 1]]] for level, (codes, _) in enumerate(tree.walk())]


def _tiles_with(codes: Sequence[Int64s], tiles: Tiles) -> Int64s:
    """Return the tiles in which there are some of cells given level by level."""
    inside: Iterable[Int64s] = (
        own >> 3 * (at - tiles.level) for at, own in enumerate(codes) if at >= tiles.level
    )
    found = distinct(np.concatenate([tiles.codes[:0], *inside]))
    return found[among(found, tiles.codes)]


def _top(before: OctreeTexture, layer: OctreeTexture, pieces: Sequence[_Piece]) -> Merged:
    """Return the texture down to the tiles, of which those of pieces have their values; nodes are to average.

    ``before`` is it as it was, ``layer`` the paint, both down to the tiles.
    """
    level, none = pieces[0].tiles.level, np.empty(0, np.int64)
    leaves = [codes[~is_node] for codes, is_node in before.tree.walk()]
    own = [next(islice(each.top.tree.walk(), level, None))[0] for each in pieces]
    own = [codes[among(codes, each.tiles.codes)] for codes, each in zip(own, pieces, strict=True)]
    leaves[level] = distinct(np.concatenate([leaves[level], *own]))
    edited = rebuilt(before.tree, leaves)
    names = sorted({name for each in pieces for name in each.top.channels if name.startswith(_PART)})
    tree = edited.tree
    areas = np.where(edited.old < 0, SKIRT, tree.arrays.areas)
    for at, (codes, _) in enumerate(tree.walk()):
        here = slice(*tree.arrays.level_cells[at : at + 2].tolist())
        where = locate(layer.tree, codes, at)
        is_own = (edited.old[here] < 0) & (where.levels == at)
        areas[here][is_own] = layer.tree.arrays.areas[where.cells[is_own]]
    tree = tree.with_cell_data(tree.arrays.flags, areas, tree.split, tree.kept)
    base = before.with_cells(tree, {**carried(before, edited), **no_parts(tree, names)})
    tops = [
        (
            each.tiles,
            each.top.with_cells(each.top.tree, {**no_parts(each.top.tree, names), **each.top.channels}),
        )
        for each in pieces
    ]
    made = refaced(put_together(base, base, tops))
    tree = made.tree
    painted, new, fresh, added = (
        distinct(np.concatenate(own))
        for own in zip(*((each.painted, each.new, each.fresh, each.added) for each in pieces), strict=True)
    )
    if added.size:
        tree = with_summed_areas(tree, nodes_at(tree, with_all_above([none] * level + [added])[:-1]))
    codes, first = tree.level_codes(level), int(tree.arrays.level_cells[level])
    is_new, is_fresh = edited.old < 0, edited.old < 0
    is_new[first:] |= among(codes, new)
    is_fresh[first:] |= among(codes, fresh)
    channels = {name: own for name, own in made.channels.items() if name not in names}
    parts = {}
    for each in names:
        name = each.removeprefix(_PART)
        parts[name] = _named(made.channels[each], name)
    return Merged(
        made.with_cells(tree, channels),
        made.with_cells(tree, parts),
        is_fresh,
        is_new,
        [none] * level + [painted],
        any(each.averages_rows for each in pieces),
        [],
    )
