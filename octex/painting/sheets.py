"""The surface in cells as a graph: its nodes are sheets, the connected pieces of surface in a cell.

Two sheets are neighbours if a triangle is in both, in cells that share a face. So nothing leads through a
thin part, from one of two walls in a cell to the other, or from part to part.
"""

from __future__ import annotations

from concurrent.futures import Executor
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np

from octex.arrays import Float64s, Int32s, Int64s, Uint8s, bit_counts
from octex.editing.draft import OpenTiles
from octex.jit import kernel
from octex.painting.layer import blocks_meeting
from octex.parallel import ordered_map
from octex.source.corners import at_corners
from octex.source.parts import edges_of, join
from octex.source.surface import Surface
from octex.source.welding import welded
from octex.tree import morton
from octex.tree.edit import among, first_not_below
from octex.tree.layout import GRID_BITS
from octex.tree.octree import distinct
from octex.tree.placement import Placement, on_grid
from octex.tree.split import bits_of
from octex.voxelize.fragments import BlockRange, Blocks, cut, divided, even_runs, most_fragments, whole

#: Tolerance for rounding, in cells, of edges that join the triangles on both sides.
_SLACK = 1e-6
#: Least distance of two sheets, in cells.
_NEAR = 0.2


#: Of pieces: their cells' Morton codes, facings, triangles, centroids and areas.
Columns: TypeAlias = tuple[Int64s, Uint8s, Int32s, Float64s, Float64s]


class Table(NamedTuple):
    """The pieces of triangles, one for each cell that a triangle meets."""

    firsts: Int64s  # (triangles + 1,)   each triangle's first row
    codes: Int64s  # (pieces,)   the cells' Morton codes, ascending within a triangle
    sheets: Int32s  # (pieces,)


class Sheets(NamedTuple):
    """The sheets of a surface in the cells of a level, by the Morton codes of their cells."""

    level: int
    codes: Int64s  # (n,)   ascending
    areas: Float64s  # (n,)   in cell faces
    bits: Uint8s  # (n,)   the facing of the largest piece, as a flag
    triangles: Int32s  # (n,)   that piece's
    barycentric: Float64s  # (n, 3)   its centroid
    table: Table
    pairs: Int64s  # (k, 2)   neighbours, the smaller number first, ascending
    ties: Float64s  # (k,)   one over their distance in cells
    grid: Int32s  # (v, 3)   the surface's vertices in steps of 2⁻³⁰ of the root's edge
    faces: Int32s  # (m, 3)   its triangles

    def at(self, triangles: Int32s, barycentric: Float64s) -> Int64s:
        """Return the sheets of points (n,), in their cell or a neighbour; −1 for none."""
        sheets = np.empty(len(triangles), np.int64)
        _find(self.table, self.level, self.grid, self.faces, triangles, barycentric, sheets)
        return sheets


def sheets_of(
    surface: Surface, placement: Placement, level: int, executor: Executor, within: OpenTiles | None = None
) -> Sheets:
    """Cut a surface at rest into its sheets in cells of a level, or ``within`` tiles of no finer level."""
    grid, faces = on_grid(surface.rest, placement), surface.triangles
    blocks = divided(
        whole(grid, faces, level), reached=None if within is None else partial(blocks_meeting, [within])
    )
    runs = even_runs(most_fragments(blocks))
    columns = list(ordered_map(executor, partial(_columns_of, blocks, level, within), runs))
    codes, bits, triangles, barycentric, areas = (np.concatenate(each) for each in zip(*columns, strict=True))
    order = np.lexsort((codes, triangles))
    codes, triangles = codes[order], triangles[order]
    firsts = np.searchsorted(triangles, np.arange(len(faces) + 1))
    parents = np.arange(codes.size)
    join(parents, *np.ascontiguousarray(_joined(grid, faces, firsts, codes, level).T))
    roots = np.flatnonzero(parents == np.arange(codes.size))
    roots = roots[np.argsort(codes[roots], kind="stable")]
    ranks = np.empty(codes.size, np.int32)
    ranks[roots] = np.arange(roots.size, dtype=np.int32)
    sheets = ranks[parents]
    largest = np.empty(roots.size, np.int64)
    by_area = np.argsort(areas[order], kind="stable")
    largest[sheets[by_area]] = by_area  # the last one stays
    chosen = order[largest]
    table = Table(firsts, codes, sheets)
    keys = distinct(_neighbours(table, roots.size))
    pairs = np.column_stack([keys // roots.size, keys % roots.size])
    centroids = at_corners(grid * 2.0 ** (level - GRID_BITS), faces[triangles[largest]], barycentric[chosen])
    distances = np.linalg.norm(centroids[pairs[:, 0]] - centroids[pairs[:, 1]], axis=1)
    return Sheets(
        level,
        codes[roots],
        np.bincount(sheets, areas[order], roots.size).astype(np.float64, copy=False),
        bits[chosen],
        triangles[largest],
        barycentric[chosen],
        table,
        pairs,
        1.0 / np.maximum(distances, _NEAR),
        grid,
        faces,
    )


def _columns_of(blocks: Blocks, level: int, within: OpenTiles | None, run: BlockRange) -> Columns:
    """Cut the surface in a run of blocks, within tiles if given."""
    pieces = cut(blocks, run)
    owners = np.repeat(np.arange(pieces.codes.size), bit_counts(pieces.flags))[pieces.entries]
    rows: slice | Int64s = slice(None)
    if within is not None:
        rows = np.flatnonzero(among(pieces.codes >> 3 * (level - within.level), within.codes)[owners])
    bits = bits_of(pieces.flags)[pieces.entries[rows]]
    columns = pieces.codes[owners[rows]], bits, pieces.triangles[rows], pieces.barycentric[rows]
    return *columns, pieces.areas[rows]


def _joined(grid: Int32s, faces: Int32s, firsts: Int64s, codes: Int64s, level: int) -> Int64s:
    """Return pairs (k, 2) of pieces in one cell whose triangles share an edge that is in the cell."""
    used = np.flatnonzero(np.diff(firsts))  # triangles without area would part their neighbours
    keys, _ = edges_of(faces[used], welded(grid).astype(np.int64))
    order = np.argsort(keys, kind="stable")
    same = keys[order[1:]] == keys[order[:-1]]
    owners, sides = used[order % used.size], order // used.size
    first, second = owners[:-1][same], owners[1:][same]
    side = sides[:-1][same]
    ends = np.column_stack([faces[first, side], faces[first, (side + 1) % 3], first, second]).astype(np.int64)
    count = _pair_up(grid, ends, firsts, codes, level, np.empty((0, 2), np.int64))
    pairs = np.empty((count, 2), np.int64)
    _pair_up(grid, ends, firsts, codes, level, pairs)
    return pairs


@kernel
def _pair_up(grid: Int32s, ends: Int64s, firsts: Int64s, codes: Int64s, level: int, pairs: Int64s) -> int:
    """Write the pairs of pieces that edges join, of two vertices and two triangles; return their number."""
    scale = 2.0 ** (level - GRID_BITS)
    count = 0
    for edge in range(len(ends)):
        p, q, left, right = ends[edge, 0], ends[edge, 1], ends[edge, 2], ends[edge, 3]
        i, j = firsts[left], firsts[right]
        while i < firsts[left + 1] and j < firsts[right + 1]:
            if codes[i] < codes[j]:
                i += 1
            elif codes[j] < codes[i]:
                j += 1
            else:
                cell = morton.decode(codes[i])
                first, last = 0.0, 1.0  # of the edge
                for axis in range(3):
                    start = grid[p, axis] * scale - cell[axis]
                    step = grid[q, axis] * scale - cell[axis] - start
                    if step == 0.0:
                        if start < -_SLACK or start > 1.0 + _SLACK:
                            last = -1.0
                    else:
                        a, b = (-_SLACK - start) / step, (1.0 + _SLACK - start) / step
                        first, last = max(first, min(a, b)), min(last, max(a, b))
                if first <= last:
                    if count < len(pairs):
                        pairs[count, 0], pairs[count, 1] = i, j
                    count += 1
                i += 1
                j += 1
    return count


@kernel
def _neighbours(table: Table, count: int) -> Int64s:
    """Return a · count + b for sheets a < b in cells that share a face, once for each triangle in both."""
    firsts, codes, sheets = table
    keys = np.empty(3 * codes.size, np.int64)
    size = 0
    for triangle in range(firsts.size - 1):
        first, end = firsts[triangle], firsts[triangle + 1]
        if end - first < 2:
            continue
        for piece in range(first, end):
            i, j, k = morton.decode(codes[piece])
            for axis in range(3):
                code = morton.encode(i + (axis == 0), j + (axis == 1), k + (axis == 2))
                at = first + first_not_below(codes[first:end], code, 0)
                if at < end and codes[at] == code:
                    a, b = np.int64(sheets[piece]), np.int64(sheets[at])
                    keys[size] = min(a, b) * count + max(a, b)
                    size += 1
    return keys[:size].copy()


@kernel
def _find(
    table: Table,
    level: int,
    grid: Int32s,
    faces: Int32s,
    triangles: Int32s,
    barycentric: Float64s,
    sheets: Int64s,
) -> None:
    """Write the sheets of points (n,); see `Sheets.at`."""
    scale = 2.0 ** (level - GRID_BITS)
    most = (1 << level) - 1
    cell = np.empty(3, np.int64)
    for n in range(triangles.size):
        triangle = triangles[n]
        first, end = table.firsts[triangle], table.firsts[triangle + 1]
        for axis in range(3):
            coordinate = 0.0
            for corner in range(3):
                coordinate += barycentric[n, corner] * grid[faces[triangle, corner], axis]
            cell[axis] = min(max(int(coordinate * scale), 0), most)
        code = morton.encode(cell[0], cell[1], cell[2])
        at = first + first_not_below(table.codes[first:end], code, 0)
        if at == end or table.codes[at] != code:  # by rounding it is the triangle's in a neighbour
            at, nearest = end, 4
            for side in range(27 if end > first else 0):
                x, y, z = side % 3 - 1, side // 3 % 3 - 1, side // 9 - 1
                square = x * x + y * y + z * z
                i, j, k = cell[0] + x, cell[1] + y, cell[2] + z
                if square >= nearest or min(i, j, k) < 0 or max(i, j, k) > most:
                    continue
                code = morton.encode(i, j, k)
                piece = first + first_not_below(table.codes[first:end], code, 0)
                if piece < end and table.codes[piece] == code:
                    nearest, at = square, piece
        sheets[n] = table.sheets[at] if at < end else -1
