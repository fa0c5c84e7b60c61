"""Point lookups for your own kernels: functions that numba compiles into your code.

A renderer looks a texture up at every hit, inside its own compiled loop:

    arrays = octex.kernels.arrays_of(texture)  # one channel, base_color

    @numba.njit(nogil=True)
    def shade(arrays, hits, normals, widths, image):
        scratch = octex.kernels.new_scratch(arrays)  # one a thread
        for n in range(len(hits)):
            r, g, b, _ = octex.kernels.footprint(arrays, hits[n], widths[n], normals[n], scratch)
            image[n, 0], image[n, 1], image[n, 2] = r, g, b  # image[n] = r, g, b compiles for 5 s more

``nearest``, ``linear`` and ``quadratic`` sample the leaves, as the same filters of `OctreeTexture.sample` do.
``footprint`` averages over a width, for a normal. All take a rest position (an array or tuple of three
numbers) and return four numbers, linear light for colours; unused components are zero. Directions are means,
not unit vectors. Lookups allocate nothing, raise nothing and need no lock. NaN positions count as the root
cell's corner. Call these four in kernels only. If you let ``numba`` cache your compiled code, it does not
notice a new octex.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Array, Float32s, Float64s, Int32s, Int64s, Uint8s, Uint32s, Uint64s
from octex.checks import as_choice, as_number, locked
from octex.field.footprints import ROUND_FINER, WIDEST, level_of
from octex.field.splines import LINEAR, QUADRATIC, single_quadratic_weights
from octex.field.taps import LEAST, OFF, Flat, Taps, new_taps, value_of
from octex.field.tiles import Tiles, code_in_tile, look_in, tile_row
from octex.field.walk_taps import taps_around
from octex.field.weights import MOST_ROWS, Facings, Visible, Weighing, new_visible, view_along, weigh
from octex.field.windows import MOST_TAPS, Walk, Way, new_walk
from octex.jit import inlined, kernel, step
from octex.texture.channel import Channel, mixed_cells, stored
from octex.texture.lookup import BLEED_THRESHOLD
from octex.texture.texture import OctreeTexture, as_texture
from octex.tree.layout import MAX_DEPTH, TreeArrays
from octex.tree.search import Descent, fixed, nearest_cell, new_descent, placed

#: A sequence indexed by 0, 1 and 2: an array or a tuple.
Vector = Any
Color = tuple[float, float, float, float]

#: Relative weights up to this are rounding errors.
_ROUNDED = 1e-6


class LookupArrays(NamedTuple):
    """One channel of a texture, as ``arrays_of`` returns it; its fields are private.

    All are arrays or numbers, as numba's parallel loops require.
    """

    root: Float64s  # (4,)   the root cell's lowest corner, and its edge
    groups: Uint64s  # the tree, see `TreeArrays`; areas are those of nodes only
    level_cells: Int64s
    level_nodes: Int64s
    flags: Uint8s
    areas: Uint8s
    kept: Uint32s  # (kept nodes,)
    facings: Uint32s  # (cells,)   first row of a split cell; (0,) for no split cells
    tile_levels: Int64s  # (22, 5)   of each level with tiles: top level, ranges in tops and rows
    tops: Int32s
    masks: Uint64s
    firsts: Uint32s
    values: Array  # (cells · components,)
    kept_values: Array
    split_values: Array
    table: Array  # decoding table of codes; empty for float32
    alpha: Array  # (cells,), likewise; (0,) without alpha
    kept_alpha: Array
    split_alpha: Array
    alpha_table: Array
    components: int
    mixed: Uint8s  # (cells,)   averages over opposite facings; (0,) for none


class Scratch(NamedTuple):
    """Scratch of lookups, and their memory from one point to the next. Use one a thread."""

    walk: Walk
    descent: Descent
    taps: Taps  # of one sample, then those that face a normal
    visible: Visible
    tiles: Int64s  # (8,)   the rows of 2×2×2 tiles
    codes: Int32s  # (3, 3)   along each axis, the codes of cells in their tiles
    along: Float32s  # (3, 3)   along each axis, the cells' weights
    sums: Float64s  # (10,)   four components and the weight, times alpha; then without alpha


@inlined
def _tree_of(arrays: LookupArrays, level_cells: Int64s) -> TreeArrays:
    """Return the tree truncated at a level."""
    return TreeArrays(arrays.groups, level_cells, arrays.level_nodes, arrays.flags, arrays.areas)


@kernel
def new_scratch(arrays: LookupArrays) -> Scratch:
    """Return scratch for lookups in one texture: make one a thread, outside the loop."""
    # Not by `_tree_of`: inlined code counts no references and must not return arrays to code that does.
    tree = TreeArrays(arrays.groups, arrays.level_cells, arrays.level_nodes, arrays.flags, arrays.areas)
    return Scratch(
        new_walk(),
        new_descent(tree),
        new_taps(1, (1 + MOST_ROWS) * MOST_TAPS, False),
        new_visible(),
        np.empty(8, np.int64),
        np.empty((3, 3), np.int32),
        np.empty((3, 3), np.float32),
        np.empty(10, np.float64),
    )


@inlined
def _placed(arrays: LookupArrays, point: Vector) -> tuple[float, float, float]:
    """Return a rest position in texture space, clamped to 0 … 1."""
    root = arrays.root
    x, y, z = np.float64(point[0]), np.float64(point[1]), np.float64(point[2])
    x, y, z = placed(x, y, z, (root[0], root[1], root[2]), 1.0 / root[3])
    return _clamped(x, 1.0), _clamped(y, 1.0), _clamped(z, 1.0)


@inlined
def _clamped(x: float, most: float) -> float:
    """Clamp a number to 0 … ``most``; NaN becomes 0, so that it is a valid index."""
    positive = x if x > 0.0 else 0.0
    return positive if positive < most else most


@inlined
def _tiles_of(arrays: LookupArrays, level: int) -> Tiles:
    """Return the tiles of a level that has some."""
    tile_levels = arrays.tile_levels
    rows = slice(tile_levels[level, 3], tile_levels[level, 4])
    return Tiles(
        level,
        tile_levels[level, 0],
        arrays.tops[tile_levels[level, 1] : tile_levels[level, 2]],
        arrays.masks[rows],
        arrays.firsts[rows],
        arrays.masks[:0],  # no finer paint
    )


@inlined
def _weigh_axis(scratch: Scratch, axis: int, x: float, cells: float, filter_code: int) -> int:
    """Weight the cells around a coordinate along an axis; return the lowest cell, −1 … cells."""
    along, codes = scratch.along, scratch.codes
    if filter_code == QUADRATIC:
        cell = min(np.floor(x * cells), cells - 1.0)
        t = np.float32(x * cells - cell)
        a, b, c = single_quadratic_weights(t)
        low = np.int32(cell) - np.int32(1)
    else:
        cell = np.floor(x * cells - 0.5)
        b = np.float32(x * cells - 0.5 - cell)
        a, c = np.float32(1.0) - b, np.float32(0.0)
        low = np.int32(cell)
    along[axis, 0], along[axis, 1], along[axis, 2] = a, b, c
    zero, seven = np.int32(0), np.int32(7)
    for n in range(3):
        code = code_in_tile((low + np.int32(n)) & seven, zero, zero)
        codes[axis, n] = code << np.int32(axis)
    return int(low)


@inlined
def _tiled(
    arrays: LookupArrays, level: int, x: float, y: float, z: float, filter_code: int, scratch: Scratch
) -> tuple[int, np.float32]:
    """Write the taps at a level with tiles; return their number and total weight."""
    tiles = _tiles_of(arrays, level)
    cells = float(1 << level)
    i = _weigh_axis(scratch, 0, x, cells, filter_code)
    j = _weigh_axis(scratch, 1, y, cells, filter_code)
    k = _weigh_axis(scratch, 2, z, cells, filter_code)
    side = 3 if filter_code == QUADRATIC else 2
    # Along each axis, the first cell that lies in the next tile.
    next_i, next_j, next_k = 8 - (i & 7), 8 - (j & 7), 8 - (k & 7)
    rows = scratch.tiles
    for dz in range(2 if next_k < side else 1):
        for dy in range(2 if next_j < side else 1):
            for dx in range(2 if next_i < side else 1):
                row = tile_row(tiles, (i >> 3) + dx, (j >> 3) + dy, (k >> 3) + dz)
                rows[dx + 2 * dy + 4 * dz] = 8 * row
    n = 0
    total = np.float32(0.0)
    last = arrays.flags.size - 1
    along, codes = scratch.along, scratch.codes
    for dz in range(side):
        for dy in range(side):
            of_yz = along[1, dy] * along[2, dz]
            code_yz = codes[1, dy] | codes[2, dz]
            tile = 2 * (dy >= next_j) + 4 * (dz >= next_k)
            for dx in range(side):
                code = np.int64(codes[0, dx] | code_yz)
                octant = rows[tile + (dx >= next_i)] + (code >> 8)
                cell, is_stored = look_in(tiles, int(octant), int(code))
                weight = along[0, dx] * of_yz
                at = np.uint64(n)  # without an unpredictable branch
                scratch.taps.rows[at] = min(cell, last)
                scratch.taps.weights[at] = weight
                total += weight * np.float32(is_stored)
                n += is_stored
    return n, total


@step
def _walked(
    arrays: LookupArrays, level: int, x: float, y: float, z: float, filter_code: int, scratch: Scratch
) -> tuple[int, float]:
    """Write the taps in a truncated tree; return their number and the coverage, 0 off the surface."""
    tree, walk = _tree_of(arrays, arrays.level_cells[: level + 2]), scratch.walk
    walk.previous[3] = min(walk.previous[3], level)
    way = Way(tree, arrays.kept, walk, filter_code, 2, 1, True)
    return taps_around(way, x, y, z, True, scratch.taps, 0)


@inlined
def _find(
    arrays: LookupArrays, level: int, x: float, y: float, z: float, filter_code: int, scratch: Scratch
) -> tuple[int, bool]:
    """Write the taps of a sample at a level; return their number, and whether it is off the surface."""
    tiled_level = level
    while tiled_level >= 0 and arrays.tile_levels[tiled_level, 0] >= 0:
        n, total = _tiled(arrays, tiled_level, x, y, z, filter_code, scratch)
        if total >= LEAST:
            for tap in range(n if tiled_level < level else 0):
                scratch.taps.weights[tap] *= np.float32(OFF / total)
            return n, tiled_level < level
        if n > 0:
            break  # at the border of the spline's support
        tiled_level -= 1
    n, cover = _walked(arrays, level, x, y, z, filter_code, scratch)
    return n, cover == 0.0


@inlined
def _flat(arrays: LookupArrays) -> Flat:
    """Return the channel's values."""
    first_kept = arrays.flags.size
    values = arrays.values, arrays.kept_values, arrays.split_values, arrays.table
    return Flat(*values, first_kept, first_kept + arrays.kept.size)


@inlined
def _add(arrays: LookupArrays, begin: int, end: int, share: float, scratch: Scratch) -> None:
    """Add the weighted values of taps to the sums."""
    sums, flat = scratch.sums, _flat(arrays)
    values = arrays.alpha, arrays.kept_alpha, arrays.split_alpha, arrays.alpha_table
    alpha = Flat(*values, flat.first_kept, flat.first_row)
    for tap in range(begin, end):
        weight, row = share * np.float64(scratch.taps.weights[tap]), int(scratch.taps.rows[tap])
        a, b, c, d = value_of(flat, row, arrays.components)
        sums[5], sums[6], sums[7] = sums[5] + weight * a, sums[6] + weight * b, sums[7] + weight * c
        sums[8], sums[9] = sums[8] + weight * d, sums[9] + weight
        if arrays.alpha.size > 0:
            weight *= value_of(alpha, row, 1)[0]
            sums[0], sums[1], sums[2] = sums[0] + weight * a, sums[1] + weight * b, sums[2] + weight * c
            sums[3], sums[4] = sums[3] + weight * d, sums[4] + weight


@inlined
def _mean(scratch: Scratch) -> Color:
    """Return the mean of the sums: weighted by alpha, if any."""
    sums = scratch.sums
    if sums[4] > 0.0:
        inverse = 1.0 / sums[4]
        return sums[0] * inverse, sums[1] * inverse, sums[2] * inverse, sums[3] * inverse
    inverse = 1.0 / sums[9] if sums[9] != 0.0 else 0.0
    return sums[5] * inverse, sums[6] * inverse, sums[7] * inverse, sums[8] * inverse


@inlined
def _sample_leaves(
    arrays: LookupArrays, x: float, y: float, z: float, filter_code: int, scratch: Scratch
) -> Color:
    """Sample the leaves."""
    scratch.sums[:] = 0.0
    n, _ = _find(arrays, arrays.level_cells.size - 2, x, y, z, filter_code, scratch)
    _add(arrays, 0, n, 1.0, scratch)
    return _mean(scratch)


@inlined
def nearest(arrays: LookupArrays, point: Vector, scratch: Scratch) -> Color:
    """Return the stored value of the leaf that contains a rest position, or of the nearest cell around it."""
    x, y, z = _placed(arrays, point)
    flat = _flat(arrays)
    depth = arrays.level_cells.size - 2
    if arrays.tile_levels[depth, 0] >= 0:
        tiles = _tiles_of(arrays, depth)
        shift = MAX_DEPTH - depth
        i, j, k = fixed(x) >> shift, fixed(y) >> shift, fixed(z) >> shift
        row = tile_row(tiles, i >> 3, j >> 3, k >> 3)
        code = code_in_tile(np.int32(i & 7), np.int32(j & 7), np.int32(k & 7))
        cell, is_stored = look_in(tiles, 8 * row + int(code >> 8), int(code))
        if is_stored:
            return value_of(flat, min(cell, arrays.flags.size - 1), arrays.components)
    cell, _ = nearest_cell(_tree_of(arrays, arrays.level_cells), x, y, z, scratch.descent)
    return value_of(flat, cell, arrays.components)


@inlined
def linear(arrays: LookupArrays, point: Vector, scratch: Scratch) -> Color:
    """Return the field of leaves by the paper's rule, which jumps where the depth changes."""
    x, y, z = _placed(arrays, point)
    return _sample_leaves(arrays, x, y, z, LINEAR, scratch)


@inlined
def quadratic(arrays: LookupArrays, point: Vector, scratch: Scratch) -> Color:
    """Return the field of leaves: a quadratic spline with continuous slopes."""
    x, y, z = _placed(arrays, point)
    return _sample_leaves(arrays, x, y, z, QUADRATIC, scratch)


@inlined
def footprint(arrays: LookupArrays, point: Vector, width: float, normal: Vector, scratch: Scratch) -> Color:
    """Return the mean over a square around a rest position, of surface that faces a normal.

    ``width`` is in the model's units; 0 samples the leaves. ``normal`` has any length, in rest space; zeros
    average all facings, as without ``normals``.
    """
    scratch.sums[:] = 0.0
    x, y, z = _placed(arrays, point)
    view = view_along(np.float64(normal[0]), np.float64(normal[1]), np.float64(normal[2]))
    is_facing = bool(max(view[0], max(view[1], view[2])) > np.float32(0.0))
    flat, facings = _flat(arrays), Facings(arrays.flags, arrays.facings, arrays.kept)
    depth = arrays.level_cells.size - 2
    size = arrays.root[3]
    between = level_of(_clamped(np.float64(width), size * WIDEST), size, depth, ROUND_FINER[QUADRATIC])
    level = min(int(between), depth)  # the coarser of two levels, and the weight of the finer
    upper: float = np.float64(between) - level
    share, passed = 1.0 - upper, 0.0
    while level <= depth and (share > 0.0 or upper > 0.0):
        mixed_share = 0.0
        if share > 0.0:
            n, is_off = _find(arrays, level, x, y, z, QUADRATIC, scratch)
            scratch.taps.ends[0] = n
            is_leaf, is_split = level == depth, is_facing and facings.rows.size > 0
            areas = arrays.areas[: 0 if is_leaf else arrays.areas.size]
            first = int(arrays.level_cells[level])
            mixed = arrays.mixed[
                first : first if is_leaf or is_facing else int(arrays.level_cells[level + 1])
            ]
            weighing = Weighing(areas, mixed, int(first), facings, is_facing, flat.first_kept, flat.first_row)
            end, _, total, of_mixed = weigh(
                scratch.taps, 0, n, weighing, view, scratch.visible, is_facing, is_split, flat, 0
            )
            mixed_share = of_mixed / total if of_mixed > 0.0 else 0.0
            part = share * np.float64(OFF) / total if is_off and total > 0.0 and not is_leaf else share
            _add(arrays, n, end, part, scratch)
        passed = share * mixed_share if mixed_share > _ROUNDED else 0.0
        share, upper = upper + passed, 0.0
        level += 1
    return _mean(scratch)


def arrays_of(
    texture: OctreeTexture, channel: str = "base_color", *, bleed_threshold: float = BLEED_THRESHOLD
) -> LookupArrays:
    """Prepare a channel for lookups in kernels.

    It shares the texture's arrays. It adds 3 bytes a cell to find cells, 5 more where cells are split, and
    decoded values for float32 channels that are not linear light. ``bleed_threshold`` is as for
    `OctreeTexture.sample`. Raises ArgumentError for an unknown channel.
    """
    texture = as_texture(texture)
    chosen = texture.channels[as_choice(channel, texture.channels, "channel")]
    threshold = as_number(bleed_threshold, "bleed_threshold", 0.0, np.inf)
    tree, field = texture.tree, texture._field
    areas = tree.arrays.areas.copy()
    areas[tree.leaf_cells()] = 0
    mixed = np.zeros(tree.n_cells if tree.split.cells.size else 0, np.uint8)
    for level in range(tree.max_depth):
        above = field.level(level).tree
        if above.split.cells.size:
            first = int(tree.arrays.level_cells[level])
            mixed[first : above.n_cells] = mixed_cells(chosen, above, threshold)[first:]
    alpha = texture.channels.get("alpha")
    if alpha is chosen or (alpha is not None and alpha.format.components != 1):
        alpha = None
    tiles = _joined_tiles([field.level(level).tiles for level in range(tree.max_depth + 1)])
    return LookupArrays(
        np.array([*texture.placement.origin, texture.placement.size]),
        *tree.arrays._replace(areas=areas),
        tree.kept.cells,
        field.facings.rows,
        *tiles,
        *_values(chosen),
        *(_NO_VALUES if alpha is None else _values(alpha)),
        chosen.format.components,
        mixed,
    )


_NONE = locked(np.empty(0, np.uint8))
_NO_VALUES: tuple[Array, Array, Array, Array] = _NONE, _NONE, _NONE, locked(np.empty(0, np.float64))


def _values(channel: Channel) -> tuple[Array, Array, Array, Array]:
    """Return a channel's flattened values of cells, kept nodes and facings, and its decoding table."""
    cells, kept, split, table = stored(channel).codes
    return locked(cells.reshape(-1)), locked(kept.reshape(-1)), locked(split.reshape(-1)), locked(table)


def _joined_tiles(levels: list[Tiles | None]) -> tuple[Int64s, Int32s, Uint64s, Uint32s]:
    """Join the tiles of all levels; levels without tiles get a top level of −1."""
    table = np.full((MAX_DEPTH + 1, 5), -1, np.int64)
    tops, masks, firsts = [np.empty(0, np.int32)], [np.empty(0, np.uint64)], [np.empty(0, np.uint32)]
    top = row = 0
    for level, tiles in enumerate(levels):
        if tiles is not None:
            tops, masks, firsts = [*tops, tiles.top], [*masks, tiles.masks], [*firsts, tiles.firsts]
            table[level] = tiles.top_level, top, top + tiles.top.size, row, row + tiles.masks.size
            top, row = top + tiles.top.size, row + tiles.masks.size
    return table, np.concatenate(tops), np.concatenate(masks), np.concatenate(firsts)
