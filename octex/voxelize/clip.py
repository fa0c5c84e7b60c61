"""The fragment of a triangle inside each cell: its area and centroid.

Polygons are projected along w (see `grid`), in cell units from the block's corner. Positions stay small, and
exact differences become floating point only once. A triangle is cut into strips along u, a strip into columns
along v, a column into cells along w: one cut for each fragment but the last.
"""

from __future__ import annotations

import numpy as np

from octex.arrays import Float64s, Int64s
from octex.jit import inlined
from octex.voxelize.grid import COLUMN_FIRST, COLUMN_INSIDE, COLUMN_LAST, COLUMN_U, COLUMN_V

#: A triangle has three vertices, and each of the six planes around a cell adds one at most.
MAX_VERTICES = 12
#: Weight of a contact without area, in cell faces: negligible next to any area.
CONTACT = 2.0**-70

POLYGONS = 6


@inlined
def split(
    polygons: Float64s, row: int, count: int, a: float, b: float, c: float, below: int, above: int
) -> tuple[int, int]:
    """Split polygon ``row`` at the line a·u + b·v = c into two other rows; return their vertex counts."""
    n_below = 0
    n_above = 0
    if count == 0:
        return 0, 0
    u0, v0 = polygons[row, 0, count - 1], polygons[row, 1, count - 1]
    d0 = a * u0 + b * v0 - c
    for i in range(count):
        u1, v1 = polygons[row, 0, i], polygons[row, 1, i]
        d1 = a * u1 + b * v1 - c
        if (d0 < 0.0) != (d1 < 0.0):
            t = d0 / (d0 - d1)
            u, v = u0 + t * (u1 - u0), v0 + t * (v1 - v0)
            polygons[below, 0, n_below] = u
            polygons[below, 1, n_below] = v
            n_below += 1
            polygons[above, 0, n_above] = u
            polygons[above, 1, n_above] = v
            n_above += 1
        if d1 < 0.0:
            polygons[below, 0, n_below] = u1
            polygons[below, 1, n_below] = v1
            n_below += 1
        else:
            polygons[above, 0, n_above] = u1
            polygons[above, 1, n_above] = v1
            n_above += 1
        u0, v0, d0 = u1, v1, d1
    return n_below, n_above


@inlined
def area_and_center(polygons: Float64s, row: int, count: int) -> tuple[float, float, float]:
    """Return a convex polygon's area, and its centroid's u and v (its first vertex's if without area)."""
    u0, v0 = polygons[row, 0, 0], polygons[row, 1, 0]
    doubled = 0.0
    moment_u = 0.0
    moment_v = 0.0
    u1, v1 = polygons[row, 0, 1] - u0, polygons[row, 1, 1] - v0
    for i in range(2, count):
        u2, v2 = polygons[row, 0, i] - u0, polygons[row, 1, i] - v0
        cross = u1 * v2 - v1 * u2
        doubled += cross
        moment_u += cross * (u1 + u2)
        moment_v += cross * (v1 + v2)
        u1, v1 = u2, v2
    if abs(doubled) < 1e-30:
        return 0.0, u0, v0
    share = 1.0 / (3.0 * doubled)
    return 0.5 * abs(doubled), u0 + moment_u * share, v0 + moment_v * share


@inlined
def _store_fragment(
    b: float, c: float, area: float, barycentric: Float64s, areas: Float64s, fragment: int
) -> None:
    b = min(max(b, 0.0), 1.0)
    c = min(max(c, 0.0), 1.0 - b)
    barycentric[fragment, 0] = 1.0 - b - c
    barycentric[fragment, 1] = b
    barycentric[fragment, 2] = c
    areas[fragment] = max(area, CONTACT)


@inlined
def clip_to_columns(
    corners: Int64s,
    normal: Int64s,
    shift: int,
    block_u: int,
    block_v: int,
    block_w: int,
    edge: int,
    columns: Int64s,
    n_columns: int,
    polygons: Float64s,
    barycentric: Float64s,
    areas: Float64s,
    fragment: int,
) -> None:
    """Clip a triangle to the cells that `columns_met` listed, in their order.

    From row ``fragment`` on, ``barycentric`` (…, 3) and ``areas``, in cell faces, receive the centroid and
    the area of the fragment in each cell. ``polygons`` is scratch.
    """
    scale = 1.0 / (1 << shift)
    u0 = np.float64(corners[0, 0] - (block_u << shift)) * scale
    v0 = np.float64(corners[0, 1] - (block_v << shift)) * scale
    w0 = np.float64(corners[0, 2] - (block_w << shift)) * scale
    b_u = np.float64(corners[1, 0] - corners[0, 0]) * scale
    b_v = np.float64(corners[1, 1] - corners[0, 1]) * scale
    c_u = np.float64(corners[2, 0] - corners[0, 0]) * scale
    c_v = np.float64(corners[2, 1] - corners[0, 1]) * scale
    inverse = 1.0 / np.float64(normal[2])
    slope_u, slope_v = -np.float64(normal[0]) * inverse, -np.float64(normal[1]) * inverse
    # Heights are from the first corner's: the plane of a flat triangle would be lost in rounding their sum.
    base = slope_u * u0 + slope_v * v0
    stretch = np.sqrt(slope_u * slope_u + slope_v * slope_v + 1.0)
    inverse /= scale * scale

    # Rows and counts share one type, so that `split` compiles once: each literal has a type of its own.
    zero = int(np.int64(0))
    rest, strip, column, cell, spare, dump = zero, zero + 1, zero + 2, zero + 3, zero + 4, zero + 5
    n_rest, n_strip = zero + 3, zero
    polygons[rest, 0, 0], polygons[rest, 1, 0] = u0, v0
    polygons[rest, 0, 1], polygons[rest, 1, 1] = u0 + b_u, v0 + b_v
    polygons[rest, 0, 2], polygons[rest, 1, 2] = u0 + c_u, v0 + c_v
    strip_u = np.int64(-1)
    last_u = columns[n_columns - 1, COLUMN_U]
    strip_is_cut = True
    # The triangle may continue beyond the block's first and last cells; elsewhere it ends in the listed
    # cells.
    if columns[0, COLUMN_U] == block_u:
        _, n_rest = split(polygons, rest, n_rest, 1.0, 0.0, 0.0, dump, spare)
        rest, spare = spare, rest
    for i in range(n_columns):
        iu, iv = columns[i, COLUMN_U], columns[i, COLUMN_V]
        if iu != strip_u:
            strip_u = iu
            if iu < last_u or iu == block_u + edge - 1:
                n_strip, n_rest = split(
                    polygons, rest, n_rest, 1.0, 0.0, np.float64(iu - block_u + 1), strip, spare
                )
                rest, spare = spare, rest
            else:
                n_strip = n_rest
                strip, rest = rest, strip
            strip_is_cut = iv != block_v
        first, last = columns[i, COLUMN_FIRST], columns[i, COLUMN_LAST]
        at_u, at_v = np.float64(iu - block_u), np.float64(iv - block_v)
        if columns[i, COLUMN_INSIDE] != 0:
            strip_is_cut = False
            if first == last and block_w < first < block_w + edge - 1:
                du, dv = at_u + 0.5 - u0, at_v + 0.5 - v0
                _store_fragment(
                    (du * c_v - dv * c_u) * inverse,
                    (b_u * dv - b_v * du) * inverse,
                    stretch,
                    barycentric,
                    areas,
                    fragment,
                )
                fragment += 1
                continue
            n_column = zero + 4
            polygons[column, 0, 0], polygons[column, 1, 0] = at_u, at_v
            polygons[column, 0, 1], polygons[column, 1, 1] = at_u + 1.0, at_v
            polygons[column, 0, 2], polygons[column, 1, 2] = at_u + 1.0, at_v + 1.0
            polygons[column, 0, 3], polygons[column, 1, 3] = at_u, at_v + 1.0
        else:
            if not strip_is_cut:
                _, n_strip = split(polygons, strip, n_strip, 0.0, 1.0, at_v, dump, spare)
                strip, spare = spare, strip
                strip_is_cut = True
            ends_strip = i == n_columns - 1 or columns[i + 1, COLUMN_U] != iu
            if not ends_strip or iv == block_v + edge - 1:
                n_column, n_strip = split(polygons, strip, n_strip, 0.0, 1.0, at_v + 1.0, column, spare)
                strip, spare = spare, strip
            else:
                n_column = n_strip
                column, strip = strip, column
        if first == block_w:
            _, n_column = split(polygons, column, n_column, slope_u, slope_v, base - w0, dump, spare)
            column, spare = spare, column
        for w in range(first, last + 1):
            if w < last or w == block_w + edge - 1:
                n_cell, n_column = split(
                    polygons,
                    column,
                    n_column,
                    slope_u,
                    slope_v,
                    (np.float64(w - block_w + 1) - w0) + base,
                    cell,
                    spare,
                )
                column, spare = spare, column
            else:
                n_cell = n_column
                cell, column = column, cell
            if n_cell > 0:
                area, center_u, center_v = area_and_center(polygons, cell, n_cell)
            else:
                area, center_u, center_v = 0.0, at_u + 0.5, at_v + 0.5
            du, dv = center_u - u0, center_v - v0
            _store_fragment(
                (du * c_v - dv * c_u) * inverse,
                (b_u * dv - b_v * du) * inverse,
                area * stretch,
                barycentric,
                areas,
                fragment,
            )
            fragment += 1
