"""Where two trees' fields are near all over the surface in finest cells: most of them, found brick by brick.

A brick (`field.bricks`) of the finest cells is decoded from both trees; then both fields are sums of 27
coefficients anywhere in a cell.
"""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s, Int64s, Uint8s, Uint64s
from octex.conversion.coefficients import SPLIT_KIND
from octex.conversion.distances import Looked
from octex.conversion.facings import HIDDEN
from octex.conversion.measure import ErrorColumns, all_near
from octex.conversion.nearness import BETWEEN, Places, full_facings
from octex.conversion.samples import MOST_POINTS, Samples, lay_out
from octex.field.bricks import (
    AT_SIX,
    AT_TEN,
    CELLS,
    Bricks,
    Tree,
    Values,
    decode,
    enter,
    list_around,
    list_children,
    new_bricks,
    note_nodes,
)
from octex.field.weights import view_of
from octex.jit import fused_kernel, inlined, step, weighted_cube
from octex.texture.blend import stored
from octex.tree.layout import FACING_FLAGS, SPLIT
from octex.tree.morton import decode as decode_cell

#: What is found out of cells: nothing, or that fields are near looked up without normals, or in any way.
UNSURE, BARE, NEAR = 0, 1, 2
#: Levels that a brick goes down.
_STEPS = 3
#: Where the root lies in its block: the second cell along each axis.
_ROOT = 1 + 4 * (1 + 4)
#: Most components of a channel whose coefficients are one vector each.
_MOST_COMPONENTS = 3


def near_cells(found: Looked, full: Looked, samples: Samples, most: float, cells: Int64s) -> Uint8s:
    """Say in which finest cells (n,), which ascend, two fields are surely not far apart: see `far_cells`.

    Returns UNSURE, BARE or NEAR for each. Between points the difference of the values, decoded, is taken for
    the quadratic polynomial.
    """
    near = np.full(cells.size, UNSURE, np.uint8)
    forms = samples.channels
    if samples.depth < _STEPS or any(form.components > _MOST_COMPONENTS for form in forms):
        return near
    near[:] = NEAR
    places = Places(samples.depth, samples.codes, samples.firsts, samples.places, samples.normals)
    trees = found.field.mixed, full.field.mixed
    pairs = [[stored(channel) for channel in each.channels] for each in (found, full)]
    alphas = [next((each.codes for each in read if each.is_alpha), None) for read in pairs]
    for form, *both in zip(forms, *pairs, strict=True):
        if any(each.space is not None for each in both):  # not decoded by a table
            near[:] = UNSURE
            continue
        values = [
            Values.of(each.codes, None if each.is_alpha else alpha)
            for each, alpha in zip(both, alphas, strict=True)
        ]
        bricks = new_bricks(), new_bricks()
        _find_near(
            trees, (values[0], values[1]), bricks, places, ErrorColumns.of([form]), cells, float(most), near
        )
    return near


@inlined
def _kind_of(tree: Tree, row: int) -> np.uint64:
    """Return the kind of a cell: see `coefficients.SPLIT_KIND`."""
    flags = tree.arrays.flags[row]
    if flags & np.uint8(SPLIT) != 0:
        return SPLIT_KIND
    facings = flags & np.uint8(FACING_FLAGS)
    return np.uint64(1) << np.uint64(facings) if facings != 0 else np.uint64(0)


@inlined
def _note_kinds(
    tree: Tree, bricks: Bricks, kinds: Uint64s, number: int, source: int, stride: int, side: int, target: int
) -> np.uint64:
    """Write what kinds of cells the coefficients of a block below another are made of; return all of them.

    They are those of the cells that it is refined from, and of its own where it has any. Places are those in
    ``Bricks.rows``.
    """
    below = 2 * side - 2
    found = np.uint64(0)
    for z in range(side - 1):
        for y in range(side - 1):
            for x in range(side - 1):
                at, to = source + x + stride * (y + stride * z), target + 2 * (x + below * (y + below * z))
                of_cell = np.uint64(0)
                for corner in range(8):
                    more = (corner & 1) + stride * ((corner >> 1 & 1) + stride * (corner >> 2))
                    of_cell |= kinds[at + more]
                for child in range(8):
                    kinds[to + (child & 1) + below * ((child >> 1 & 1) + below * (child >> 2))] = of_cell
                found |= of_cell
    for n in range(bricks.n_over[number]):
        listed = bricks.over[1000 * number + n]
        own = _kind_of(tree, max(int(listed >> 16) - 1, 0))
        kinds[target + (listed >> 1 & 1023)] = own
        found |= own
    return found


@inlined
def _corner(level: int, octant: int) -> int:
    """Return where what is around a cell begins in the block of its level, by the cell's octant."""
    return 64 * level + (octant & 1) + 4 * (octant >> 1 & 1) + 16 * (octant >> 2)


@step
def _go_down(
    tree: Tree, values: Values, bricks: Bricks, kinds: Uint64s, level: int, octant: int, steps: int
) -> np.uint64:
    """Decode the blocks below a cell of a level, of which the octant of its parent is given.

    Returns the kinds of the cells that these are made of.
    """
    corner = _corner(level, octant)
    list_around(bricks, corner)
    has, source, stride = bricks.has[level], corner, 4
    for number in range(1, steps + 1):
        side = 3 if number == 1 else (4 if number == 2 else 6)
        target = 64 * (level + 1) if number == 1 else (AT_SIX if number == 2 else AT_TEN)
        list_children(tree, values.codes.values, bricks, number, side)
        has = decode(values, bricks, 1, number, source, stride, side, target, has)
        if number == 1:
            bricks.has[level + 1] = has
        source, stride = target, 2 * side - 2
    if steps == 1:
        note_nodes(bricks, level + 1)
    found = _note_kinds(tree, bricks, kinds, 1, corner, 4, 3, 64 * (level + 1))
    for number in range(2, steps + 1):
        for n in range(bricks.n_over[number]):
            found |= _kind_of(tree, max(int(bricks.over[1000 * number + n] >> 16) - 1, 0))
    return found


@step
def _kinds_below(tree: Tree, bricks: Bricks, kinds: Uint64s, level: int) -> None:
    """Write the kinds that a brick below a cell of a level is made of."""
    _note_kinds(tree, bricks, kinds, 2, 64 * (level + 1), 4, 4, AT_SIX)
    _note_kinds(tree, bricks, kinds, 3, AT_SIX, 6, 6, AT_TEN)


@inlined
def _kinds_at(kinds: Uint64s, at: int) -> np.uint64:
    """Return the kinds that the coefficients of the 27 cells from one on are made of."""
    found = np.uint64(0)
    for k in range(3):
        for j in range(3):
            for number in range(3):
                found |= kinds[at + number + 10 * (j + 10 * k)]
    return found


@fused_kernel
def _find_near(
    trees: tuple[Tree, Tree],
    values: tuple[Values, Values],
    bricks: tuple[Bricks, Bricks],
    samples: Places,
    columns: ErrorColumns,
    cells: Int64s,
    most: float,
    near: Uint8s,
) -> None:
    bottom = samples.depth - _STEPS  # the level of bricks
    kinds = np.zeros((2, CELLS), np.uint64)
    points = np.zeros((3, MOST_POINTS), np.float32)
    found = np.zeros((2, columns.kinds.size, MOST_POINTS), np.float32)
    bounds = np.zeros((2, columns.kinds.size), np.float32)
    normal = np.zeros((1, 3), np.float32)
    latest = np.int64(-1)
    of_brick = np.uint64(0)
    are_known = False
    for side in range(2):
        enter(trees[side], values[side], bricks[side], 1)
        if trees[side].arrays.groups.shape[0] == 0:
            kinds[side, _ROOT] = _kind_of(trees[side], 0)
    for n in range(cells.size):
        if near[n] == UNSURE:
            continue
        code = samples.codes[cells[n]]
        brick = code >> 3 * _STEPS
        if brick != latest:
            level = 0 if latest < 0 else bottom
            changed = brick ^ latest
            while level > 0 and changed >> 3 != 0:
                changed >>= 3
                level -= 1
            latest = brick
            of_brick, are_known = np.uint64(0), False
            while level <= bottom:
                octant = int(brick >> 3 * (bottom - level) & 7) if level > 0 else 0
                steps = 1 if level < bottom else _STEPS
                for side in range(2):
                    below = _go_down(
                        trees[side], values[side], bricks[side], kinds[side], level, octant, steps
                    )
                    if level == bottom:
                        of_brick |= below
                level += 1
        i, j, k = decode_cell(code & (1 << 3 * _STEPS) - 1)
        at = AT_TEN + i + 10 * (j + 10 * k)
        if _are_equal(bricks[0].rows, bricks[1].rows, at):
            continue
        for sample in range(samples.firsts[cells[n]], samples.firsts[cells[n] + 1]):
            for axis in range(3):
                normal[0, axis] = samples.normals[sample, axis]
            hidden = HIDDEN[full_facings(view_of(normal, 0))]
            if of_brick & hidden != np.uint64(0):
                if not are_known:
                    for side in range(2):
                        _kinds_below(trees[side], bricks[side], kinds[side], bottom)
                    are_known = True
                if (_kinds_at(kinds[0], at) | _kinds_at(kinds[1], at)) & hidden != np.uint64(0):
                    near[n] = BARE  # with its normal the field is another
            count = lay_out(samples.places, samples.normals, sample, points)
            if not _look_up(bricks[0].rows, bricks[1].rows, at, points, count, found) or not (
                _are_near(found, columns, count, most, bounds)
                or (
                    _are_near(found, columns, 1, most, bounds)
                    and _are_near(found, columns, count, most + BETWEEN, bounds)
                )
            ):
                near[n] = UNSURE
                break


@inlined
def _are_equal(rows: Float32s, others: Float32s, at: int) -> bool:
    """Say whether the coefficients of the 27 cells from one on are the same in two bricks."""
    for k in range(3):
        for j in range(3):
            first = 4 * (at + 10 * (j + 10 * k))
            for number in range(first, first + 12):
                if rows[number] != others[number]:
                    return False
    return True


@inlined
def _look_up(
    rows: Float32s, others: Float32s, at: int, points: Float32s, count: int, found: Float32s
) -> bool:
    """Write both fields' values at points of a cell; say whether they weigh anything at all of them."""
    weigh = True
    for point in range(count):
        of_x = _weights(points[0, point])
        of_y = _weights(points[1, point])
        of_z = _weights(points[2, point])
        a, b, c, total = weighted_cube(rows, at, 10, of_x, of_y, of_z)
        u, v, w, other = weighted_cube(others, at, 10, of_x, of_y, of_z)
        weigh &= min(total, other) > np.float32(0)
        one, two = np.float32(1) / total, np.float32(1) / other
        found[0, 0, point], found[1, 0, point] = a * one, u * two
        if found.shape[1] > 1:
            found[0, 1, point], found[1, 1, point] = b * one, v * two
        if found.shape[1] > 2:
            found[0, 2, point], found[1, 2, point] = c * one, w * two
    return weigh


@inlined
def _weights(t: np.float32) -> tuple[np.float32, np.float32, np.float32]:
    """Return the weights of the quadratic B-spline in a cell, 0 … 1."""
    half, one = np.float32(0.5), np.float32(1)
    low, high = half * (one - t) * (one - t), half * t * t
    return low, one - low - high, high


@inlined
def _are_near(values: Float32s, columns: ErrorColumns, count: int, most: float, bounds: Float32s) -> bool:
    """Say whether values (2, components, points) are ``most`` codes apart or less all over a patch.

    It is as in `are_near_between`, with the difference of the values themselves for the polynomial. Of all
    pairs that differ by as much as its largest coefficient, the darkest is apart by most codes.
    """
    two, half = np.float32(2), np.float32(0.5)
    for component in range(columns.kinds.size):
        found, wanted = values[0, component], values[1, component]
        middle = found[0] - wanted[0]
        low, apart = min(found[0], wanted[0]), abs(middle)
        for corner in range(1, count, 3):
            other = corner + 3 if corner + 3 < count else 1
            here, after = found[corner] - wanted[corner], found[other] - wanted[other]
            inner = found[corner + 1] - wanted[corner + 1]
            along = found[corner + 2] - wanted[corner + 2]
            apart = max(apart, abs(here))
            apart = max(apart, abs(two * inner - half * (here + middle)))
            apart = max(apart, abs(two * along - half * (here + after)))
            for point in range(corner, corner + 3):
                low = min(low, min(found[point], wanted[point]))
        bounds[0, component], bounds[1, component] = low, low + apart
    return all_near(bounds, columns, most)
