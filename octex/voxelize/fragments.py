"""Cuts a surface into fragments, one for each pair of triangle and cell, block by block.

A mask has one byte for each cell of a block, whose bits are the facings of the surface in it: the cell's
normal flags. The rank of a bit among all set bits numbers the *entry* (cell, facing) in Morton order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from octex.arrays import Bools, Float64s, Int32s, Int64s, Uint8s
from octex.jit import inlined, kernel, popcount, trailing_zeros
from octex.tree.layout import GRID_BITS
from octex.tree.morton import decode
from octex.voxelize.clip import MAX_VERTICES, POLYGONS, clip_to_columns
from octex.voxelize.grid import (
    BLOCK_BITS,
    BLOCK_EDGE,
    COLUMN_FIRST,
    COLUMN_LAST,
    COLUMN_U,
    COLUMN_V,
    MOST_IN_COLUMN,
    SPREAD,
    columns_met,
    load_triangle,
)

#: Most fragments of a task: enough to hide the overhead, few enough to stay in the cache.
TASK_FRAGMENTS = 400_000
#: Small work is cut into this many tasks, with at least this many fragments each.
_TASKS, _LEAST_FRAGMENTS = 8, 250_000


class Blocks(NamedTuple):
    """Blocks of cells in Morton order, and the triangles of a surface that meet each."""

    grid: Int32s  # (n, 3)   vertices in steps of 2⁻³⁰ of the root's edge
    faces: Int32s  # (m, 3)   triangles
    level: int
    bits: int  # a block has 2 to the power of this many cells along an edge
    codes: Int64s  # (blocks,)   Morton codes at the blocks' level
    starts: Int64s  # (blocks + 1,)   each block's first row of `members`
    members: Int32s  # (pairs,)   triangles, ascending within a block

    def of_cells(self, depth: int) -> Blocks:
        """Return the blocks with cells of another level."""
        return self._replace(bits=depth - self.level)

    def chosen(self, mask: Bools) -> Blocks:
        """Return the blocks of a mask, the first one if it is empty."""
        mask[0] |= not mask.any()
        counts = np.diff(self.starts)
        return self._replace(
            codes=self.codes[mask],
            starts=np.concatenate([[0], np.cumsum(counts[mask])]),
            members=self.members[np.repeat(mask, counts)],
        )


#: Returns which blocks are to be cut.
Reached: TypeAlias = Callable[[Blocks], Bools]


class Fragments(NamedTuple):
    """The fragments of a run of blocks, and their cells."""

    codes: Int64s  # (cells,)   Morton codes, ascending
    flags: Uint8s  # (cells,)   normal flags; each set bit is an entry, in order of bits
    entries: Int32s  # (fragments,)   the entry of each fragment
    triangles: Int32s  # (fragments,)
    barycentric: Float64s  # (fragments, 3)   of the fragment's centroid
    areas: Float64s  # (fragments,)   in cell faces


class BlockRange(NamedTuple):
    """The work of one task: a run of blocks, with a bound of the number of fragments."""

    first_block: int
    last_block: int  # exclusive
    most: int


@inlined
def _block_origin(code: int, bits: int) -> tuple[int, int, int]:
    i, j, k = decode(code)
    return i << bits, j << bits, k << bits


@inlined
def _block_columns(
    axis: int,
    corners: Int64s,
    normal: Int64s,
    shift: int,
    origin: Int64s,
    edge: int,
    sides: Int64s,
    columns: Int64s,
) -> int:
    u, v = (axis + 1) % 3, (axis + 2) % 3
    return columns_met(corners, normal, shift, origin[u], origin[v], origin[axis], edge, sides, columns)


@kernel
def most_fragments(blocks: Blocks) -> Int64s:
    """Bound from above how many cells the triangles of each block can meet, by their boxes.

    It sizes the arrays of `cut`, and divides the work.
    """
    shift, edge = GRID_BITS - blocks.level - blocks.bits, 1 << blocks.bits
    bounds = np.empty(blocks.codes.size, np.int64)
    corners = np.empty((3, 3), np.int64)
    normal = np.empty(3, np.int64)
    for block in range(blocks.codes.size):
        bounds[block] = 0
        origin = _block_origin(blocks.codes[block], blocks.bits)
        for row in range(blocks.starts[block], blocks.starts[block + 1]):
            axis = load_triangle(
                blocks.grid, blocks.faces, int(np.int64(blocks.members[row])), corners, normal
            )
            if axis < 0:
                continue
            cells = np.int64(1)
            for i in range(3):
                start = origin[(axis + 1 + i) % 3]
                low = max(min(corners[0, i], corners[1, i], corners[2, i]) >> shift, start)
                high = min(max(corners[0, i], corners[1, i], corners[2, i]) >> shift, start + edge - 1)
                span = max(high - low + 1, 0)
                cells *= span if i < 2 else min(span, MOST_IN_COLUMN)
            bounds[block] += cells
    return bounds


@kernel
def _bin(blocks: Blocks, most: int, most_in_block: int) -> tuple[Int64s, Int64s, Int32s]:
    """Cut blocks into their cells, and return the cells' codes, starts and members.

    ``most`` is the sum, ``most_in_block`` the largest of the bounds that `most_fragments` returns.
    """
    shift, edge = GRID_BITS - blocks.level - blocks.bits, 1 << blocks.bits
    n_cells = edge * edge * edge
    corners = np.empty((3, 3), np.int64)
    normal = np.empty(3, np.int64)
    sides = np.empty((6, 3), np.int64)
    columns = np.empty((BLOCK_EDGE * BLOCK_EDGE, 5), np.int64)
    origin = np.empty(3, np.int64)
    counts = np.empty(n_cells, np.int64)
    for cell in range(n_cells):
        counts[cell] = 0
    codes = np.empty(min(most, blocks.codes.size * n_cells), np.int64)
    starts = np.empty(codes.size + 1, np.int64)
    n_blocks = 0
    members = np.empty(most, np.int32)
    n_members = 0
    pair_cells = np.empty(most_in_block, np.int32)
    pair_triangles = np.empty(most_in_block, np.int32)
    for block in range(blocks.codes.size):
        origin[0], origin[1], origin[2] = _block_origin(blocks.codes[block], blocks.bits)
        n_pairs = 0
        for row in range(blocks.starts[block], blocks.starts[block + 1]):
            triangle = int(np.int64(blocks.members[row]))
            axis = load_triangle(blocks.grid, blocks.faces, triangle, corners, normal)
            if axis < 0:
                continue
            n_columns = _block_columns(axis, corners, normal, shift, origin, edge, sides, columns)
            u, v = (axis + 1) % 3, (axis + 2) % 3
            for i in range(n_columns):
                in_plane = (SPREAD[columns[i, COLUMN_U] - origin[u]] << u) | (
                    SPREAD[columns[i, COLUMN_V] - origin[v]] << v
                )
                for w in range(columns[i, COLUMN_FIRST], columns[i, COLUMN_LAST] + 1):
                    cell = in_plane | (SPREAD[w - origin[axis]] << axis)
                    pair_cells[n_pairs] = cell
                    pair_triangles[n_pairs] = triangle
                    n_pairs += 1
                    counts[cell] += 1
        # A counting sort by cell keeps the triangles of a cell in order.
        for cell in range(n_cells):
            if counts[cell] > 0:
                codes[n_blocks] = (blocks.codes[block] << (3 * blocks.bits)) | cell
                starts[n_blocks] = n_members
                n_blocks += 1
                size = counts[cell]
                counts[cell] = n_members
                n_members += size
        for i in range(n_pairs):
            cell = pair_cells[i]
            members[counts[cell]] = pair_triangles[i]
            counts[cell] += 1
        for i in range(n_pairs):
            counts[pair_cells[i]] = 0
    starts[n_blocks] = n_members
    return codes[:n_blocks].copy(), starts[: n_blocks + 1].copy(), members[:n_members].copy()


def whole(grid: Int32s, faces: Int32s, depth: int, members: Int32s | None = None) -> Blocks:
    """Return the root as one block of cells of ``depth``, with the triangles ``members`` (default: all)."""
    if members is None:
        members = np.arange(len(faces), dtype=np.int32)
    starts = np.array([0, len(members)], np.int64)
    return Blocks(grid, faces, 0, depth, np.zeros(1, np.int64), starts, members)


def divided(blocks: Blocks, bits: int = BLOCK_BITS, reached: Reached | None = None) -> Blocks:
    """Cut blocks, in steps, into blocks of 2^``bits`` cells along an edge; keep only those reached."""
    depth = blocks.level + blocks.bits
    while blocks.bits > bits:
        level = min(blocks.level + BLOCK_BITS, depth - bits)
        coarse = blocks.of_cells(level)
        bounds = most_fragments(coarse)
        codes, starts, members = _bin(coarse, int(bounds.sum()), int(bounds.max(initial=0)))
        blocks = Blocks(blocks.grid, blocks.faces, level, depth - level, codes, starts, members)
        if reached is not None and codes.size:
            blocks = blocks.chosen(reached(blocks))
    return blocks


@kernel
def cut(blocks: Blocks, run: BlockRange) -> Fragments:
    """Cut the triangles of a run of blocks along the cells."""
    shift, edge = GRID_BITS - blocks.level - blocks.bits, 1 << blocks.bits
    n_words = max(edge * edge * edge // 8, 1)
    corners = np.empty((3, 3), np.int64)
    normal = np.empty(3, np.int64)
    sides = np.empty((6, 3), np.int64)
    columns = np.empty((edge * edge, 5), np.int64)
    origin = np.empty(3, np.int64)
    polygons = np.empty((POLYGONS, 2, MAX_VERTICES), np.float64)
    mask = np.empty(n_words, np.uint64)
    for word in range(mask.size):
        mask[word] = np.uint64(0)
    ranks = np.empty(n_words, np.int32)
    used = np.empty(n_words, np.int32)
    codes = np.empty(min(run.most, (run.last_block - run.first_block) * edge * edge * edge), np.int64)
    flags = np.empty(codes.size, np.uint8)
    n_cells = 0
    n_entries = 0
    entries = np.empty(run.most, np.int32)
    members = np.empty(run.most, np.int32)
    barycentric = np.empty((run.most, 3), np.float64)
    areas = np.empty(run.most, np.float64)
    n_fragments = int(np.int64(0))  # not a literal, for which numba would compile `clip_to_columns` again
    for block in range(run.first_block, run.last_block):
        origin[0], origin[1], origin[2] = _block_origin(blocks.codes[block], blocks.bits)
        first_fragment = n_fragments
        for row in range(blocks.starts[block], blocks.starts[block + 1]):
            triangle = int(np.int64(blocks.members[row]))
            axis = load_triangle(blocks.grid, blocks.faces, triangle, corners, normal)
            if axis < 0:
                continue
            n_columns = _block_columns(axis, corners, normal, shift, origin, edge, sides, columns)
            u, v = (axis + 1) % 3, (axis + 2) % 3
            facing = 2 * axis + (1 if normal[2] < 0 else 0)
            if n_columns > 0:
                clip_to_columns(
                    corners,
                    normal,
                    shift,
                    origin[u],
                    origin[v],
                    origin[axis],
                    edge,
                    columns,
                    n_columns,
                    polygons,
                    barycentric,
                    areas,
                    n_fragments,
                )
            origin_u, origin_v, origin_w = origin[u], origin[v], origin[axis]
            for i in range(n_columns):
                in_plane = (
                    (SPREAD[columns[i, COLUMN_U] - origin_u] << (u + 3))
                    | (SPREAD[columns[i, COLUMN_V] - origin_v] << (v + 3))
                    | facing
                )
                for w in range(columns[i, COLUMN_FIRST] - origin_w, columns[i, COLUMN_LAST] - origin_w + 1):
                    key = in_plane | (SPREAD[w] << (axis + 3))
                    mask[key >> 6] |= np.uint64(1) << np.uint64(key & 63)
                    entries[n_fragments] = key
                    members[n_fragments] = triangle
                    n_fragments += 1
        n_used = 0
        for word in range(mask.size):
            if mask[word] == np.uint64(0):
                continue
            used[n_used] = word
            n_used += 1
            ranks[word] = n_entries
            n_entries += popcount(mask[word])
            remaining = mask[word]
            while remaining != np.uint64(0):
                octant = trailing_zeros(remaining) >> 3
                byte = (remaining >> np.uint64(8 * octant)) & np.uint64(255)
                remaining ^= byte << np.uint64(8 * octant)
                codes[n_cells] = (blocks.codes[block] << (3 * blocks.bits)) | (word << 3) | octant
                flags[n_cells] = byte
                n_cells += 1
        for fragment in range(first_fragment, n_fragments):
            key = np.int64(entries[fragment])
            below = (np.uint64(1) << np.uint64(key & 63)) - np.uint64(1)
            entries[fragment] = ranks[key >> 6] + popcount(mask[key >> 6] & below)
        for i in range(n_used):
            mask[used[i]] = np.uint64(0)
    return Fragments(
        codes[:n_cells].copy(),
        flags[:n_cells].copy(),
        entries[:n_fragments],
        members[:n_fragments],
        barycentric[:n_fragments],
        areas[:n_fragments],
    )


def even_runs(bounds: Int64s) -> list[BlockRange]:
    """Group blocks into runs of at most about TASK_FRAGMENTS, by their bounds."""
    totals = np.cumsum(bounds)
    size = min(max(int(totals[-1]) // _TASKS, _LEAST_FRAGMENTS), TASK_FRAGMENTS)
    ends = np.searchsorted(totals, np.arange(size, totals[-1], size)) + 1
    ends = np.unique(np.append(ends, len(totals)))
    starts = np.append(0, ends[:-1])
    most = np.add.reduceat(bounds, starts)
    return [BlockRange(*row) for row in zip(starts.tolist(), ends.tolist(), most.tolist(), strict=True)]
