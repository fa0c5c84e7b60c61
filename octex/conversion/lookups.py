"""The lookups that a brick of leaves is fitted by: which leaves each sample blends, and how much of each.

Leaves are numbered within a brick. Where all leaves are finest cells, lookups go by cubes of cells, without
lists of taps: a cube is 8³ cells, some of them in the brick, and the cells next to them. Their values lie on
10³ positions, where a lookup is a sum of 27 neighbours, and the samples that a leaf weighs in lie around it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Int32s, Int64s, Integers, Uint16s, bit_counts, in_runs
from octex.conversion import large
from octex.conversion.samples import POSITION_STEPS, Samples
from octex.conversion.solve import LEAST_WEIGHT, Equations, by_unknown, write_residual
from octex.field.tiles import Tiles, tile_row
from octex.jit import fused_kernel, kernel, spline_box
from octex.tree.morton import decode, decode_cells
from octex.tree.octree import Octree, distinct

#: Bits of a cell's code below that of its cube.
_BITS = 9
_SIDE = 10
_CUBE_SIZE = _SIDE**3
_STEPS = 1, _SIDE, _SIDE**2
#: Offset of the middle of 3³ positions from the first.
_CENTRE = 1 + _SIDE * (1 + _SIDE)
_CELLS = decode_cells(np.arange(1 << _BITS))
#: The position of a cell among a cube's 8³, by its code; and its sides of the cube: low x, high x, low y …
_POSITIONS = _CENTRE + _CELLS @ _STEPS
_SIDES = sum((_CELLS[:, bit >> 1] == (bit & 1) * 7) << bit for bit in range(6))


class FittedLeaves(NamedTuple):
    """The leaves of a tree, of any levels, in Morton order, as samples are; or the rows of split leaves."""

    cells: Int64s  # (leaves,)   cell numbers; empty if they are consecutive, from `offset` on
    ranks: Int64s  # (cells,)   each leaf's rank in this order, −1 for nodes; empty likewise
    offset: int
    firsts: Int64s  # (leaves,)   the samples of each are from its first
    ends: Int64s  # (leaves,)   to its end
    heads: Int64s  # (rows,)   of rows of leaves: the rank of their leaf's first row, which has the samples

    @classmethod
    def of(cls, tree: Octree, samples: Samples) -> FittedLeaves:
        """Put the leaves of a tree in order: the samples' finest cells, or cells above them."""
        none = np.empty(0, np.int64)
        if tree.max_depth == samples.depth and tree.n_leaves == len(samples.codes):
            offset = tree.n_cells - tree.n_leaves
            return cls(none, none, offset, samples.firsts[:-1], samples.firsts[1:], none)
        codes, cells = [], []
        first = 0
        for level, (level_codes, is_node) in enumerate(tree.walk()):
            codes.append(level_codes[~is_node] << 3 * (samples.depth - level))
            cells.append(first + np.flatnonzero(~is_node))
            first += len(level_codes)
        finest = np.concatenate(codes)
        order = np.argsort(finest, kind="stable")
        in_order = np.concatenate(cells)[order]
        ranks = np.full(tree.n_cells, -1, np.int64)
        ranks[in_order] = np.arange(len(in_order))
        firsts = samples.firsts[np.searchsorted(samples.codes, finest[order])]
        return cls(in_order, ranks, 0, firsts, np.append(firsts[1:], samples.firsts[-1]), none)

    def chosen(self, chosen: Bools, n_cells: int) -> FittedLeaves:
        """Put only chosen leaves (leaves,) in order."""
        cells = self.numbers_of(chosen)
        ranks = np.full(n_cells, -1, np.int64)
        ranks[cells] = np.arange(cells.size)
        return FittedLeaves(cells, ranks, 0, self.firsts[chosen], self.ends[chosen], self.heads)

    def rows_of(self, tree: Octree, chosen: Bools) -> FittedLeaves:
        """Put the rows of chosen split leaves (leaves,) in order, numbered after all cells, by table."""
        cells = self.numbers_of(chosen)
        counts = bit_counts(tree.split.facings).astype(np.int64)
        at = np.searchsorted(tree.split.cells, cells)
        first_rows, counts = (np.cumsum(counts) - counts)[at], counts[at]
        heads = np.cumsum(counts) - counts
        rows = tree.n_cells + in_runs(first_rows, counts)
        ranks = large.empty(tree.n_cells + tree.split.areas.size, np.int64)
        ranks[:] = -1
        ranks[rows] = np.arange(rows.size)
        firsts = np.repeat(self.firsts[chosen], counts)
        ends = firsts.copy()
        ends[heads] = self.ends[chosen]
        return FittedLeaves(rows, ranks, 0, firsts, ends, np.repeat(heads, counts))

    def numbers(self, first: int, end: int) -> Int64s:
        """Return the cell numbers of the leaves of ranks ``first`` to ``end`` − 1."""
        return self.cells[first:end] if self.cells.size else np.arange(first, end) + self.offset

    def numbers_of(self, chosen: Bools) -> Int64s:
        """Return the cell numbers of chosen leaves (leaves,), in order."""
        return self.cells[chosen] if self.cells.size else np.flatnonzero(chosen) + self.offset

    def with_samples(self, ranks: Int64s) -> Int64s:
        """Return the ranks, each once, under which ``ranks`` have their samples."""
        return distinct(self.heads[ranks]) if self.heads.size else np.sort(ranks)

    def ranks_of(self, rows: Integers) -> Int64s:
        """Return the ranks of rows that lookups read, −1 for rows that are not here."""
        if self.ranks.size:
            return self.ranks.take(rows)
        ranks = rows.astype(np.int64) - self.offset
        return np.where((ranks >= 0) & (ranks < len(self.firsts)), ranks, -1)


@kernel
def members_of(firsts: Int64s, ends: Int64s, leaves: Int64s, most: int) -> tuple[Int64s, Float32s]:
    """List about ``most`` evenly chosen samples of each leaf, and how many samples each stands for."""
    total = 0
    for leaf in leaves:
        total += min(ends[leaf] - firsts[leaf], most + 1)
    members = np.empty(total, np.int64)
    strides = np.empty(total, np.float32)
    n = 0
    for leaf in leaves:
        count = ends[leaf] - firsts[leaf]
        stride = 1 if count <= most else (count + most - 1) // most  # division takes longer than all the rest
        for sample in range(firsts[leaf], ends[leaf], stride):
            members[n] = sample
            strides[n] = stride
            n += 1
    return members[:n].copy(), strides[:n].copy()


def numbered(rows: Integers, ranks: Integers, first: int, end: int, others: Int64s) -> Int32s:
    """Return the numbers of rows in a brick: ranks ``first`` … ``end`` − 1, then ``others``, the rest."""
    outside = np.flatnonzero((ranks < first) | (ranks >= end))
    numbers = (ranks - first).astype(np.int32)
    order = np.argsort(others)
    numbers[outside] = end - first + order[np.searchsorted(others, rows[outside], sorter=order)]
    return numbers


class Heads(NamedTuple):
    """The cubes of a whole tree: its tiles."""

    tiles: Tiles
    first_row: int  # the first cube's tile
    firsts: Int64s  # (cubes + 1,)   the first finest cell of each

    @classmethod
    def of(cls, tiles: Tiles, codes: Int64s) -> Heads:
        """List the cubes of finest cells (n,), which ascend."""
        firsts = np.append(np.flatnonzero(np.diff(codes >> _BITS, prepend=-1)), codes.size)
        return cls(tiles, tiles.masks.size // 8 - firsts.size, firsts)


class Cubes(NamedTuple):
    """The cubes of a run of ascending cells: in each, first the run's cells, then the others."""

    starts: Int64s  # (cubes + 1,)   the first entry of each
    solved: Int64s  # (cubes,)   how many of its entries are the run's
    positions: Uint16s  # (entries,)   x + 10 · (y + 10 · z)
    cells: Int32s  # (entries,)   numbers of cells: in the tree, then in the brick


class CubeLookups(NamedTuple):
    """The samples of a brick and its halo, and the cells around them. See `fit.SampleLookups`."""

    samples: Int64s  # (n,)
    strides: Float32s  # (1,)   1
    cells: Int64s  # (m,)
    unknowns: int
    cubes: tuple[Cubes, Cubes]  # of the brick, of its halo
    firsts: Int64s  # (unknowns + 1,)   the first sample of each cell that is solved for
    axes: Float32s  # (n, 12)   the spline's weights along each axis; the inverse of their sum
    coverage: Float32s  # (m,)   the cells' weights

    @classmethod
    def of(cls, samples: Samples, heads: Heads, leaves: FittedLeaves, first: int, end: int) -> CubeLookups:
        """Find the cells around leaves ``first`` … ``end`` − 1, which are finest cells."""
        brick = np.arange(first, end)
        inner = _cubes(samples, heads, brick)
        ring = distinct(inner.cells[(inner.cells < first) | (inner.cells >= end)])
        outer = _cubes(samples, heads, ring)
        beyond = distinct(outer.cells[(outer.cells < first) | (outer.cells >= end)])
        others = np.append(ring, np.setdiff1d(beyond, ring, assume_unique=True))
        inner, outer = (
            each._replace(cells=numbered(each.cells, each.cells, first, end, others))
            for each in (inner, outer)
        )
        solved = np.append(brick, ring)
        rows = samples.rows(solved)
        counts = samples.firsts[solved + 1] - samples.firsts[solved]
        cells = np.append(brick, others) + leaves.offset
        return cls(
            rows,
            np.ones(1, np.float32),
            cells,
            solved.size,
            (inner, outer),
            np.append(0, np.cumsum(counts)),
            _axes(samples.positions, rows),
            np.ones(cells.size, np.float32),
        )

    def residuals(
        self, values: Float32s, targets: Float32s, shares: Float32s, components: int, is_light: int
    ) -> Float32s:
        """Return the residuals of values. See `solve.residuals`."""
        rows = np.empty((self.samples.size, 4), np.float32)
        for cubes in self.cubes:
            _residuals(
                cubes, self.firsts, self.axes, self.coverage,
                values, targets, shares, components, is_light, rows,
            )  # fmt: skip
        return rows

    def equations(self) -> Equations:
        """List the lookups by unknown; call `residuals` before, which finds the sums of weights."""
        return _equations(*self.cubes, self.firsts, self.axes, self.coverage, self.unknowns)

    def covered(self, coverage: Float32s) -> CubeLookups:
        """Return the same lookups with cells (m,) weighted by coverage."""
        return self._replace(coverage=coverage)


def _cubes(samples: Samples, heads: Heads, cells: Int64s) -> Cubes:
    count = np.count_nonzero(np.diff(samples.codes[cells] >> _BITS, prepend=-1))
    cubes = Cubes(
        np.zeros(count + 1, np.int64),
        np.empty(count, np.int64),
        np.empty(_CUBE_SIZE * count + 1, np.uint16),
        np.empty(_CUBE_SIZE * count + 1, np.int32),
    )
    _list(samples.codes, heads, cells, cubes)
    end = cubes.starts[-1]
    return cubes._replace(positions=cubes.positions[:end].copy(), cells=cubes.cells[:end].copy())


@kernel
def _list(codes: Int64s, heads: Heads, chosen: Int64s, cubes: Cubes) -> None:
    """List the cubes of ``chosen`` cells, which ascend."""
    positions, cells, n_heads = cubes.positions, cubes.cells, heads.firsts.size - 1
    n = cube = 0
    entry = np.uint64(0)
    for cube in range(cubes.solved.size):
        first, head = n, codes[chosen[n]] >> _BITS
        while n < chosen.size and codes[chosen[n]] >> _BITS == head:
            positions[entry] = _POSITIONS[codes[chosen[n]] & (1 << _BITS) - 1]
            cells[entry] = chosen[n]
            entry += np.uint64(1)
            n += 1
        cubes.solved[cube] = n - first
        i, j, k = decode(head)
        for around in range(27):
            a, b, c = around % 3 - 1, around // 3 % 3 - 1, around // 9 - 1
            row = tile_row(heads.tiles, i + a, j + b, k + c) - heads.first_row
            if not 0 <= row < n_heads:
                continue
            sides = (a > 0) | (a < 0) << 1 | (b > 0) << 2 | (b < 0) << 3 | (c > 0) << 4 | (c < 0) << 5
            shift = 8 * (a + _SIDE * (b + _SIDE * c))
            listed, last = first, n if sides == 0 else first
            for cell in range(heads.firsts[row], heads.firsts[row + 1]):
                if listed < last and chosen[listed] == cell:
                    listed += 1
                    continue
                at = np.uint64(codes[cell]) & np.uint64((1 << _BITS) - 1)
                positions[entry], cells[entry] = _POSITIONS[at] + shift, cell
                entry += np.uint64(_SIDES[at] & sides == sides)
        cubes.starts[cube + 1] = entry


@kernel
def _axes(positions: Uint16s, chosen: Int64s) -> Float32s:
    """Return the weights of the quadratic B-spline along each axis."""
    half, one = np.float32(0.5), np.float32(1)
    axes = np.empty((chosen.size, 12), np.float32)
    for n in range(chosen.size):
        row, sample = np.uint64(n), np.uint64(chosen[n])
        for axis in range(3):
            t = np.float32((positions[sample, axis] + 0.5) * (1.0 / POSITION_STEPS))
            low, high = half * (one - t) * (one - t), half * t * t
            axes[row, 3 * axis], axes[row, 3 * axis + 2] = low, high
            axes[row, 3 * axis + 1] = one - low - high
    return axes


@fused_kernel
def _residuals(
    cubes: Cubes,
    firsts: Int64s,
    axes: Float32s,
    coverage: Float32s,
    values: Float32s,
    targets: Float32s,
    shares: Float32s,
    components: int,
    is_light: int,
    rows: Float32s,
) -> None:
    """Write the residuals of the samples in cubes, and the inverse sums of their weights."""
    zero, one = np.float32(0), np.float32(1)
    grid = np.zeros(4 * _CUBE_SIZE, np.float32)
    for cube in range(cubes.solved.size):
        begin, end = cubes.starts[cube], cubes.starts[cube + 1]
        for entry in range(begin, end):
            number, to = np.uint64(cubes.cells[entry]), np.uint64(4) * np.uint64(cubes.positions[entry])
            covered = coverage[number]
            grid[to], grid[to + np.uint64(1)] = covered * values[number, 0], covered * values[number, 1]
            grid[to + np.uint64(2)], grid[to + np.uint64(3)] = covered * values[number, 2], covered
        for entry in range(begin, begin + cubes.solved[cube]):
            cell, at = cubes.cells[entry], int(cubes.positions[entry]) - _CENTRE
            for sample in range(firsts[cell], firsts[cell + 1]):
                n = np.uint64(sample)
                of_x, of_y = (axes[n, 0], axes[n, 1], axes[n, 2]), (axes[n, 3], axes[n, 4], axes[n, 5])
                of_z = axes[n, 6], axes[n, 7], axes[n, 8]
                x, y, z, total = spline_box(grid, at, _STEPS, of_x, of_y, of_z)
                inverse = one / total if total > zero else zero
                axes[n, 9] = inverse
                share = shares[n] if total > zero else zero
                position = x * inverse, y * inverse, z * inverse
                write_residual(position, targets, share, components, is_light, sample, rows)
        for entry in range(begin, end):
            to = np.uint64(4) * np.uint64(cubes.positions[entry])
            for part in range(4):
                grid[to + np.uint64(part)] = zero


@kernel
def _equations(
    inner: Cubes, outer: Cubes, firsts: Int64s, axes: Float32s, coverage: Float32s, unknowns: int
) -> Equations:
    """List the cells that samples blend by sample, in the order of cubes, and then by unknown.

    The compiler knows that arrays made here overlap nothing: arrays from outside take half as long again.
    """
    size = axes.shape[0]
    ends = np.zeros(size + 1, np.int64)
    leaves, weights = np.empty(27 * size + 1, np.int32), np.empty(27 * size + 1, np.float32)
    grid = np.empty(_CUBE_SIZE, np.int32)
    grid[:] = -1
    cells, offsets = np.empty(28, np.int32), np.empty(28, np.int32)
    products = np.empty(27, np.float32)
    one = np.uint64(1)
    count = 0
    for part in range(2):
        cubes = inner if part == 0 else outer
        for cube in range(cubes.solved.size):
            begin, end = cubes.starts[cube], cubes.starts[cube + 1]
            for entry in range(begin, end):
                number = cubes.cells[np.uint64(entry)]
                grid[np.uint64(cubes.positions[np.uint64(entry)])] = number if number < unknowns else -1
            for entry in range(begin, begin + cubes.solved[cube]):
                cell = np.uint64(cubes.cells[np.uint64(entry)])
                at = int(cubes.positions[np.uint64(entry)]) - _CENTRE
                around, offset = np.uint64(0), 0
                for k in range(3):
                    for j in range(3):
                        for i in range(3):
                            number = grid[np.uint64(at + i + _SIDE * (j + _SIDE * k))]
                            cells[around], offsets[around] = number, offset
                            offset += 1
                            around += np.uint64(number >= 0)
                for sample in range(firsts[cell], firsts[cell + one]):
                    row, place = np.uint64(sample), np.uint64(0)
                    for k in range(3):
                        for j in range(3):
                            both = axes[row, 6 + k] * axes[row, 3 + j] * axes[row, 9]
                            for i in range(3):
                                products[place] = both * axes[row, i]
                                place += one
                    for n in range(around):
                        leaf = cells[n]
                        weight = products[np.uint64(offsets[n])] * coverage[np.uint64(leaf)]
                        leaves[np.uint64(count)], weights[np.uint64(count)] = leaf, weight
                        count += weight >= LEAST_WEIGHT
                    ends[row + one] = count
            for entry in range(begin, end):
                grid[np.uint64(cubes.positions[np.uint64(entry)])] = -1
    return by_unknown(ends, leaves[:count], weights[:count], unknowns)
