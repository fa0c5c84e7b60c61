"""Lookups of one point at a time: its taps at a level, weighed, and their blend."""

from __future__ import annotations

from typing import Any

import numpy as np

from octex.field.find import Cells, search_tiles
from octex.field.footprints import ROUND_FINER, WHOLE
from octex.field.neighborhood import Way, taps_around
from octex.field.splines import LINEAR, NEAREST, QUADRATIC
from octex.field.taps import OFF, Ahead
from octex.field.tiles import Levels
from octex.field.values import Flat, value_of
from octex.field.weights import Facings, Weighing, view_along, weigh
from octex.jit import inlined, step
from octex.kernels.layout import LookupArrays, Scratch
from octex.tree.layout import MAX_DEPTH, TreeArrays
from octex.tree.search import nearest_cell, placed

#: What can be indexed by 0, 1 and 2: an array, or a tuple.
Vector = Any
Color = tuple[float, float, float, float]

#: What is no more than this of a weight is rounding.
_ROUNDED = 1e-6


@inlined
def _placed(arrays: LookupArrays, point: Vector) -> tuple[float, float, float]:
    """Return where a rest position lies in texture space, clamped to 0 … 1."""
    place = arrays.place
    x, y, z = np.float64(point[0]), np.float64(point[1]), np.float64(point[2])
    x, y, z = placed(x, y, z, (place[0], place[1], place[2]), 1.0 / place[3])
    return _clamped(x, 1.0), _clamped(y, 1.0), _clamped(z, 1.0)


@inlined
def _clamped(x: float, most: float) -> float:
    """Clamp a number to 0 … ``most``; what is none becomes 0, so that no index is made of it."""
    positive = x if x > 0.0 else 0.0
    return positive if positive < most else most


@inlined
def _cells(arrays: LookupArrays, level: int) -> Cells:
    """Return the cells of a truncated tree."""
    cells = arrays.level_cells[: level + 2]
    tree = TreeArrays(arrays.groups, cells, arrays.level_nodes, arrays.flags, arrays.areas)
    levels = Levels(arrays.tops, arrays.top, arrays.masks, arrays.firsts)
    first = level if arrays.tops[level, 0] >= 0 else -1
    return Cells(tree, arrays.kept, arrays.flags.size, levels, arrays.masks[:0], first, -1)


@step
def _walked(
    cells: Cells, level: int, x: float, y: float, z: float, filter_code: int, scratch: Scratch
) -> tuple[int, float]:
    """Write the taps in a truncated tree; return their number and the cover, 0 off the surface."""
    walk, taps = scratch.walk, scratch.taps
    walk.previous[3] = min(walk.previous[3], level)
    taps.starts[0] = 0
    way = Way(cells.arrays, cells.kept, walk, filter_code, 2, 1, True)
    return taps_around(way, x, y, z, True, taps.rows, taps.weights, taps.slopes, 0)


@inlined
def _find(
    arrays: LookupArrays, level: int, x: float, y: float, z: float, filter_code: int, scratch: Scratch
) -> tuple[int, bool]:
    """Write the taps of a look at a level; return their number, and whether it is off the surface."""
    cells, place, none = _cells(arrays, level), scratch.place, arrays.flags[:0]
    if cells.first >= 0:
        place[0, 0], place[0, 1], place[0, 2] = x, y, z
        ahead = Ahead(none.reshape((0, 1)), none.reshape((0, 1)), none, none)
        n, n_rim, _ = search_tiles(cells, filter_code, place, ahead, scratch.room, scratch.taps)
        if n_rim == 0:
            return n, scratch.taps.covers[0] == np.float32(0.0)
    n, cover = _walked(cells, level, x, y, z, filter_code, scratch)
    return n, cover == 0.0


@inlined
def _tree_of(arrays: LookupArrays) -> TreeArrays:
    return TreeArrays(arrays.groups, arrays.level_cells, arrays.level_nodes, arrays.flags, arrays.areas)


@inlined
def _flat(arrays: LookupArrays) -> Flat:
    """Return the channel's values."""
    first_kept = arrays.flags.size
    values = arrays.values, arrays.kept_values, arrays.split_values, arrays.table
    return Flat(*values, first_kept, first_kept + arrays.kept.size)


@inlined
def _alpha(arrays: LookupArrays) -> Flat:
    first_kept = arrays.flags.size
    values = arrays.alpha, arrays.kept_alpha, arrays.split_alpha, arrays.alpha_table
    return Flat(*values, first_kept, first_kept + arrays.kept.size)


@inlined
def _add(arrays: LookupArrays, begin: int, end: int, share: float, scratch: Scratch) -> None:
    """Add the blend of some taps to the sums."""
    sums, flat, alpha = scratch.sums, _flat(arrays), _alpha(arrays)
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
    """Return what the sums are the sums of: under alpha, if there is any."""
    sums = scratch.sums
    if sums[4] > 0.0:
        inverse = 1.0 / sums[4]
        return sums[0] * inverse, sums[1] * inverse, sums[2] * inverse, sums[3] * inverse
    inverse = 1.0 / sums[9] if sums[9] != 0.0 else 0.0
    return sums[5] * inverse, sums[6] * inverse, sums[7] * inverse, sums[8] * inverse


@inlined
def _clear(scratch: Scratch) -> None:
    for n in range(10):
        scratch.sums[n] = 0.0


@inlined
def _look(arrays: LookupArrays, x: float, y: float, z: float, filter_code: int, scratch: Scratch) -> Color:
    """Look at the leaves."""
    _clear(scratch)
    n, _ = _find(arrays, arrays.level_cells.size - 2, x, y, z, filter_code, scratch)
    _add(arrays, 0, n, 1.0, scratch)
    return _mean(scratch)


@inlined
def nearest(arrays: LookupArrays, point: Vector, scratch: Scratch) -> Color:
    """Return what is stored of the leaf that holds a rest position, else of the nearest cell around it."""
    x, y, z = _placed(arrays, point)
    flat = _flat(arrays)
    depth = arrays.level_cells.size - 2
    if arrays.tops[depth, 0] >= 0:
        _find(arrays, depth, x, y, z, NEAREST, scratch)
        return value_of(flat, int(scratch.taps.rows[scratch.taps.starts[0]]), arrays.components)
    cell, _ = nearest_cell(_tree_of(arrays), x, y, z, scratch.search)
    return value_of(flat, cell, arrays.components)


@inlined
def linear(arrays: LookupArrays, point: Vector, scratch: Scratch) -> Color:
    """Return the field between leaves by the paper's own rule, which jumps where the depth changes."""
    x, y, z = _placed(arrays, point)
    return _look(arrays, x, y, z, LINEAR, scratch)


@inlined
def quadratic(arrays: LookupArrays, point: Vector, scratch: Scratch) -> Color:
    """Return the field between leaves: a quadratic spline, continuous in its slopes."""
    x, y, z = _placed(arrays, point)
    return _look(arrays, x, y, z, QUADRATIC, scratch)


@inlined
def footprint(arrays: LookupArrays, point: Vector, width: float, normal: Vector, scratch: Scratch) -> Color:
    """Return the mean over a square of some width around a rest position, of what faces a normal.

    ``width`` is in the model's units, 0 for the leaves alone; ``normal`` of any length, in rest space. With
    zeros for it nothing is known of where one looks from: then it is as without ``normals``.
    """
    _clear(scratch)
    x, y, z = _placed(arrays, point)
    view = view_along(np.float64(normal[0]), np.float64(normal[1]), np.float64(normal[2]))
    is_facing = bool(max(view[0], max(view[1], view[2])) > np.float32(0.0))
    flat, facings = _flat(arrays), Facings(arrays.flags, arrays.facings, arrays.kept)
    depth = arrays.level_cells.size - 2
    level, upper = _level_of(width, arrays.place[3], depth)
    share, passed = 1.0 - upper, 0.0
    while level <= depth and (share > 0.0 or upper > 0.0):
        left = 0.0
        if share > 0.0:
            n, is_off = _find(arrays, level, x, y, z, QUADRATIC, scratch)
            scratch.taps.ends[0] = n
            is_leaf, is_split = level == depth, is_facing and facings.rows.size > 0
            areas = arrays.areas[: 0 if is_leaf else arrays.areas.size]
            first = int(arrays.level_cells[level])
            mixed = arrays.mixed[
                first : first if is_leaf or is_facing else int(arrays.level_cells[level + 1])
            ]
            by = Weighing(areas, mixed, int(first), facings, is_facing, flat.first_kept, flat.first_row)
            end, _, total, gone = weigh(
                scratch.taps, 0, n, by, view, scratch.sight, is_facing, is_split, flat, 0
            )
            left = gone / total if gone > 0.0 else 0.0
            part = share * np.float64(OFF) / total if is_off and total > 0.0 and not is_leaf else share
            _add(arrays, n, end, part, scratch)
        passed = share * left if left > _ROUNDED else 0.0
        share, upper = upper + passed, 0.0
        level += 1
    return _mean(scratch)


@inlined
def _level_of(width: float, size: float, depth: int) -> tuple[int, float]:
    """Return the coarser of the two levels that a width is looked up at, and the share of the other."""
    cells = size / max(_clamped(np.float64(width), size * 4.0**MAX_DEPTH), size * 0.25**MAX_DEPTH)
    level = np.float64(np.float32(np.log2(np.float32(cells))) + np.float32(ROUND_FINER[QUADRATIC]))
    whole = np.floor(level)
    part = (level - whole - WHOLE) / (1.0 - 2.0 * WHOLE)
    level = min(max(whole + min(max(part, 0.0), 1.0), 0.0), float(depth))
    lower = min(int(level), depth)
    return lower, level - lower
