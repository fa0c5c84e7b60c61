"""Finds the cells that a triangle meets, exactly.

Vertices are rounded once to a grid of 2³⁰ steps along the root cell's edge. 2D cross products then fit 64
bits and the plane's test 128, and all further arithmetic is in integers. A half-open cell [a, b)³ is met if
it shares a point with the closed rounded triangle. The result does not depend on depth, triangle order or
blocks.

A triangle is projected along the axis w nearest to its normal, onto the two axes u and v that follow w
cyclically. It crosses a column of cells along w in a run without gaps, of at most three.

The test uses separating axes. Two sets overlap in 3D unless the box axes, the triangle's plane, or one of the
projections along the three axes separates them. In a projection the outward side of each edge suffices. A
half-open box is a union of closed boxes [a, b−ε]³. Along a direction d it reaches its largest value only if d
has no positive component, and its smallest only if d has no negative one.
"""

from __future__ import annotations

import numpy as np

from octex.arrays import Int32s, Int64s
from octex.jit import inlined, kernel

#: Blocks have 32³ cells: a block's masks fit the second-level cache.
BLOCK_BITS = 5
BLOCK_EDGE = 1 << BLOCK_BITS

#: A triangle rises by at most two cells along w over a column, so it meets at most three of its cells.
MOST_IN_COLUMN = 3

#: The low five bits of a coordinate, spread to every third bit: a block's Morton codes.
SPREAD = np.array(
    [sum(((i >> bit) & 1) << (3 * bit) for bit in range(BLOCK_BITS)) for i in range(BLOCK_EDGE)], np.int64
)

# The scratch table of `columns_met` has a row for each column of cells: its position along u and v, its first
# and last cell along w, and whether it lies wholly inside the triangle's projection along w.
COLUMN_U, COLUMN_V, COLUMN_FIRST, COLUMN_LAST, COLUMN_INSIDE = range(5)


@inlined
def load_triangle(grid: Int32s, triangles: Int32s, triangle: int, corners: Int64s, normal: Int64s) -> int:
    """Load a triangle's corners (3, 3) and normal (3,) with axes in the order u, v, w; return w.

    Returns −1 for a triangle that is degenerate after rounding.
    """
    a, b, c = triangles[triangle, 0], triangles[triangle, 1], triangles[triangle, 2]
    ax, ay, az = np.int64(grid[a, 0]), np.int64(grid[a, 1]), np.int64(grid[a, 2])
    bx, by, bz = np.int64(grid[b, 0]), np.int64(grid[b, 1]), np.int64(grid[b, 2])
    cx, cy, cz = np.int64(grid[c, 0]), np.int64(grid[c, 1]), np.int64(grid[c, 2])
    nx = (by - ay) * (cz - az) - (bz - az) * (cy - ay)
    ny = (bz - az) * (cx - ax) - (bx - ax) * (cz - az)
    nz = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    sx, sy, sz = abs(nx), abs(ny), abs(nz)
    if sx == 0 and sy == 0 and sz == 0:
        return -1
    if sx >= sy and sx >= sz:
        corners[0, 0], corners[0, 1], corners[0, 2] = ay, az, ax
        corners[1, 0], corners[1, 1], corners[1, 2] = by, bz, bx
        corners[2, 0], corners[2, 1], corners[2, 2] = cy, cz, cx
        normal[0], normal[1], normal[2] = ny, nz, nx
        return 0
    if sy >= sz:
        corners[0, 0], corners[0, 1], corners[0, 2] = az, ax, ay
        corners[1, 0], corners[1, 1], corners[1, 2] = bz, bx, by
        corners[2, 0], corners[2, 1], corners[2, 2] = cz, cx, cy
        normal[0], normal[1], normal[2] = nz, nx, ny
        return 1
    corners[0, 0], corners[0, 1], corners[0, 2] = ax, ay, az
    corners[1, 0], corners[1, 1], corners[1, 2] = bx, by, bz
    corners[2, 0], corners[2, 1], corners[2, 2] = cx, cy, cz
    normal[0], normal[1], normal[2] = nx, ny, nz
    return 2


@inlined
def _edge(
    corners: Int64s, i: int, j: int, first: int, second: int, orientation: int, cell: int
) -> tuple[int, int, int, int]:
    """Return p, q, c and span of the edge from corner i to corner j, projected onto two axes.

    p·a + q·b + c ≥ 0 unless the edge separates the cell with corner (a, b); span is how much the edge's own
    function changes over a cell. ``orientation`` is the sign of the projected triangle's area.
    """
    p = corners[i, second] - corners[j, second]
    q = corners[j, first] - corners[i, first]
    if orientation < 0:
        p = -p
        q = -q
    # The function's maximum over the cell minus its value at the corner; less one if the maximum is on an
    # open side.
    reach = cell * (max(p, 0) + max(q, 0)) - (1 if p > 0 or q > 0 else 0)
    return p, q, reach - (p * corners[i, first] + q * corners[i, second]), cell * (abs(p) + abs(q))


@inlined
def _sign_of_dot(normal: Int64s, u: int, v: int, w: int) -> int:
    """Return the exact sign of normal · (u, v, w): up to 93 bits, summed in two halves."""
    low_bits = (1 << 31) - 1
    high = (normal[0] >> 31) * u + (normal[1] >> 31) * v + (normal[2] >> 31) * w
    low = (normal[0] & low_bits) * u + (normal[1] & low_bits) * v + (normal[2] & low_bits) * w
    high += low >> 31
    if high != 0:
        return 1 if high > 0 else -1
    return 1 if (low & low_bits) != 0 else 0


@inlined
def _meets_plane(corners: Int64s, normal: Int64s, cell: int, u: int, v: int, w: int) -> bool:
    """Return whether the triangle's plane meets the half-open cell at (u, v, w), in grid steps."""
    du, dv, dw = u - corners[0, 0], v - corners[0, 1], w - corners[0, 2]
    up_u = cell if normal[0] > 0 else 0
    up_v = cell if normal[1] > 0 else 0
    up_w = cell if normal[2] > 0 else 0
    largest = _sign_of_dot(normal, du + up_u, dv + up_v, dw + up_w)
    if largest < 0 or (largest == 0 and up_u + up_v + up_w > 0):
        return False
    down_u = cell if normal[0] < 0 else 0
    down_v = cell if normal[1] < 0 else 0
    down_w = cell if normal[2] < 0 else 0
    smallest = _sign_of_dot(normal, du + down_u, dv + down_v, dw + down_w)
    return not (smallest > 0 or (smallest == 0 and down_u + down_v + down_w > 0))


@inlined
def _set_sides(corners: Int64s, normal: Int64s, cell: int, sides: Int64s) -> None:
    """Write the edges as projected along u, then along v, into ``sides`` (6, 3)."""
    zero = int(np.int64(0))  # not a literal; see `columns_met`
    for i in range(3):
        j = i + 1 if i < 2 else zero
        sides[i, 0], sides[i, 1], sides[i, 2], _ = _edge(corners, i, j, zero + 1, zero + 2, normal[0], cell)
        sides[i + 3, 0], sides[i + 3, 1], sides[i + 3, 2], _ = _edge(
            corners, i, j, zero + 2, zero, normal[1], cell
        )


@inlined
def _meets_sides(sides: Int64s, u: int, v: int, w: int) -> bool:
    """Return whether no edge, projected along u or v, separates the cell at (u, v, w), in grid steps."""
    along_u = (
        (sides[0, 0] * v + sides[0, 1] * w + sides[0, 2])
        | (sides[1, 0] * v + sides[1, 1] * w + sides[1, 2])
        | (sides[2, 0] * v + sides[2, 1] * w + sides[2, 2])
    )
    along_v = (
        (sides[3, 0] * w + sides[3, 1] * u + sides[3, 2])
        | (sides[4, 0] * w + sides[4, 1] * u + sides[4, 2])
        | (sides[5, 0] * w + sides[5, 1] * u + sides[5, 2])
    )
    return bool((along_u | along_v) >= 0)


@inlined
def columns_met(
    corners: Int64s,
    normal: Int64s,
    shift: int,
    block_u: int,
    block_v: int,
    block_w: int,
    edge: int,
    sides: Int64s,
    columns: Int64s,
) -> int:
    """List the cells of one block that a triangle meets, column by column; return the number of columns.

    A cell's edge is ``1 << shift`` grid steps; ``block_*`` is the block's first cell, of ``edge`` each way.
    ``columns`` of shape (edge², 5) receives them sorted by u, then v; ``sides`` (6, 3) is scratch.
    """
    cell = 1 << shift
    first_u = max(min(corners[0, 0], corners[1, 0], corners[2, 0]) >> shift, block_u)
    last_u = min(max(corners[0, 0], corners[1, 0], corners[2, 0]) >> shift, block_u + edge - 1)
    first_v = max(min(corners[0, 1], corners[1, 1], corners[2, 1]) >> shift, block_v)
    last_v = min(max(corners[0, 1], corners[1, 1], corners[2, 1]) >> shift, block_v + edge - 1)
    first_w = min(corners[0, 2], corners[1, 2], corners[2, 2]) >> shift
    last_w = max(corners[0, 2], corners[1, 2], corners[2, 2]) >> shift
    # Slope of w from cell to cell along u and v, and its value at the corner of cell (0, 0).
    inverse = -1.0 / np.float64(normal[2])
    rise_u = np.float64(normal[0]) * inverse * cell
    rise_v = np.float64(normal[1]) * inverse * cell
    below = min(rise_u, 0.0) + min(rise_v, 0.0)
    above = max(rise_u, 0.0) + max(rise_v, 0.0)
    scale = 1.0 / cell
    base = corners[0, 2] - rise_u * (corners[0, 0] * scale) - rise_v * (corners[0, 1] * scale)
    zero = int(np.int64(0))  # not a literal: numba would compile `_edge` again for each
    one, two = zero + 1, zero + 2
    p0, q0, c0, span0 = _edge(corners, zero, one, zero, one, normal[2], cell)
    p1, q1, c1, span1 = _edge(corners, one, two, zero, one, normal[2], cell)
    p2, q2, c2, span2 = _edge(corners, two, zero, zero, one, normal[2], cell)
    has_sides = False
    count = 0
    for iu in range(first_u, last_u + 1):
        u = iu << shift
        at_u0, at_u1, at_u2 = p0 * u + c0, p1 * u + c1, p2 * u + c2
        base_u = base + rise_u * iu
        for iv in range(first_v, last_v + 1):
            v = iv << shift
            e0, e1, e2 = at_u0 + q0 * v, at_u1 + q1 * v, at_u2 + q2 * v
            if (e0 | e1 | e2) < 0:
                continue
            inside = ((e0 - span0) | (e1 - span1) | (e2 - span2)) >= 0
            height = base_u + rise_v * iv
            lowest, highest = np.int64(np.floor(height + below)), np.int64(np.floor(height + above))
            # The plane's range over the column, widened and narrowed by more than all rounding. Where both
            # give the same cell, the plane needs no exact test.
            first = max((lowest - 1) >> shift, first_w)
            last = min((highest + 1) >> shift, last_w)
            sure_first = (lowest + 2) >> shift
            sure_last = (highest - 1) >> shift
            if first < last and not inside and not has_sides:
                _set_sides(corners, normal, cell, sides)
                has_sides = True
            # The triangle meets the column, so the last remaining candidate needs no test.
            while first < last and not (
                (inside or _meets_sides(sides, u, v, first << shift))
                and (
                    sure_first <= first <= sure_last
                    or _meets_plane(corners, normal, cell, u, v, first << shift)
                )
            ):
                first += 1
            while first < last and not (
                (inside or _meets_sides(sides, u, v, last << shift))
                and (
                    sure_first <= last <= sure_last
                    or _meets_plane(corners, normal, cell, u, v, last << shift)
                )
            ):
                last -= 1
            first = max(first, block_w)
            last = min(last, block_w + edge - 1)
            if first <= last:
                columns[count, COLUMN_U] = iu
                columns[count, COLUMN_V] = iv
                columns[count, COLUMN_FIRST] = first
                columns[count, COLUMN_LAST] = last
                columns[count, COLUMN_INSIDE] = 1 if inside else 0
                count += 1
    return count


@kernel
def count_degenerate(grid: Int32s, triangles: Int32s) -> tuple[int, float]:
    """Return the number of triangles without area on the grid, and the total area in square grid steps."""
    corners = np.empty((3, 3), np.int64)
    normal = np.empty(3, np.int64)
    count = 0
    doubled = 0.0
    for i in range(triangles.shape[0]):
        if load_triangle(grid, triangles, i, corners, normal) < 0:
            count += 1
        else:
            x, y, z = np.float64(normal[0]), np.float64(normal[1]), np.float64(normal[2])
            doubled += np.sqrt(x * x + y * y + z * z)
    return count, 0.5 * doubled
