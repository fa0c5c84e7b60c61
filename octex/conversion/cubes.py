"""The lookups of a brick whose leaves are all finest cells, by cubes of cells: without lists of taps.

A cube is 8³ cells in which the brick has some, and those beside them. Their values are laid out on 10³
places, where lookups are sums of 27 neighbours, and which samples a leaf weighs in stands around it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Int32s, Int64s, Uint16s
from octex.conversion.numbering import Leaves, Outside, extend, number_of
from octex.conversion.samples import PLACE_STEPS, Samples
from octex.conversion.solve import LEAST_WEIGHT, Equations, by_unknown, write_residual
from octex.field.tiles import Tiles, tile_row
from octex.jit import fused_kernel, kernel, weighted_cube
from octex.tree.morton import decode, decode_cells
from octex.tree.octree import distinct

#: Bits of a cell's code below that of its cube.
_BITS = 9
_SIDE = 10
_PLACES_OF_CUBE = _SIDE**3
#: How far the middle of 3³ places lies behind the first.
_CENTRE = 1 + _SIDE * (1 + _SIDE)
_CELLS = decode_cells(np.arange(1 << _BITS))
#: Where a cell of a cube's 8³ lies, by its code; and at which of their sides: low x, high x, low y …
_PLACES = _CENTRE + _CELLS @ [1, _SIDE, _SIDE**2]
_SIDES = sum((_CELLS[:, bit >> 1] == (bit & 1) * 7) << bit for bit in range(6))


class Heads(NamedTuple):
    """The cubes of a whole tree: its tiles."""

    tiles: Tiles
    first_row: int  # the tile of the first
    firsts: Int64s  # (cubes + 1,)   the first finest cell of each

    @classmethod
    def of(cls, tiles: Tiles, codes: Int64s) -> Heads:
        """List the cubes of finest cells (n,), which ascend."""
        firsts = np.append(np.flatnonzero(np.diff(codes >> _BITS, prepend=-1)), codes.size)
        return cls(tiles, tiles.masks.size // 8 - firsts.size, firsts)


class Cubes(NamedTuple):
    """The cubes of a run of cells, which ascend: of each first its own cells, then the others in it."""

    starts: Int64s  # (cubes + 1,)   the first entry of each
    owns: Int64s  # (cubes,)   how many are its own
    places: Uint16s  # (entries,)   x + 10 · (y + 10 · z)
    cells: Int32s  # (entries,)   numbers of cells: in the tree, then in the brick


class CubeLookups(NamedTuple):
    """The samples of a brick and its halo, and what is around them. See `fit.Lookups`."""

    samples: Int64s  # (n,)
    strides: Float32s  # (1,)   1
    cells: Int64s  # (m,)
    unknowns: int
    cubes: tuple[Cubes, Cubes]  # of the brick, of its halo
    firsts: Int64s  # (unknowns + 1,)   the first of the samples of each cell that is solved for
    axes: Float32s  # (n, 12)   the spline's weights along each axis; the inverse of what all sum to
    coverage: Float32s  # (m,)   by which cells weigh

    @classmethod
    def of(cls, samples: Samples, heads: Heads, leaves: Leaves, first: int, end: int) -> CubeLookups:
        """Find what is around leaves ``first`` … ``end`` − 1, which are finest cells."""
        own = np.arange(first, end)
        inner = _cubes(samples, heads, own)
        ring = distinct(inner.cells[(inner.cells < first) | (inner.cells >= end)])
        outer = _cubes(samples, heads, ring)
        others = int(np.count_nonzero((outer.cells < first) | (outer.cells >= end)))
        outside = Outside.of(ring.size + others)
        extend(outside, ring)
        for each in (inner, outer):
            _number(each.cells, first, end, outside)
        solved = np.concatenate([own, ring])
        rows = samples.rows(solved)
        counts = samples.firsts[solved + 1] - samples.firsts[solved]
        cells = np.concatenate([own, outside.found()]) + leaves.offset
        return cls(
            rows,
            np.ones(1, np.float32),
            cells,
            solved.size,
            (inner, outer),
            np.append(0, np.cumsum(counts)),
            _axes(samples.places, rows),
            np.ones(cells.size, np.float32),
        )

    def residuals(
        self,
        values: Float32s,
        targets: Float32s,
        shares: Float32s,
        components: int,
        is_light: int,
    ) -> Float32s:
        """Return the residuals of values. See `solve.residuals`."""
        rows = np.empty((self.samples.size, 4), np.float32)
        for cubes in self.cubes:
            place = cubes, self.firsts, self.axes, self.coverage
            _residuals(*place, values, targets, shares, components, is_light, rows)
        return rows

    def equations(self) -> Equations:
        """List by unknown what lookups blend; after residuals, which find by how much weights are divided."""
        return _equations(*self.cubes, self.firsts, self.axes, self.coverage, self.unknowns)

    def covered(self, coverage: Float32s) -> CubeLookups:
        """Return the same with cells (m,) that weigh by their coverage."""
        return self._replace(coverage=coverage)


def _cubes(samples: Samples, heads: Heads, cells: Int64s) -> Cubes:
    """List the cubes of finest cells, which ascend."""
    count = np.count_nonzero(np.diff(samples.codes[cells] >> _BITS, prepend=-1))
    cubes = Cubes(
        np.zeros(count + 1, np.int64),
        np.empty(count, np.int64),
        np.empty(_PLACES_OF_CUBE * count + 1, np.uint16),
        np.empty(_PLACES_OF_CUBE * count + 1, np.int32),
    )
    _list(samples.codes, heads, cells, cubes)
    end = cubes.starts[-1]
    return cubes._replace(places=cubes.places[:end].copy(), cells=cubes.cells[:end].copy())


@kernel
def _list(codes: Int64s, heads: Heads, chosen: Int64s, cubes: Cubes) -> None:
    """List the cubes of chosen cells, which ascend."""
    places, cells, n_heads = cubes.places, cubes.cells, heads.firsts.size - 1
    n = cube = 0
    entry = np.uint64(0)
    for cube in range(cubes.owns.size):
        first, head = n, codes[chosen[n]] >> _BITS
        while n < chosen.size and codes[chosen[n]] >> _BITS == head:
            places[entry] = _PLACES[codes[chosen[n]] & (1 << _BITS) - 1]
            cells[entry] = chosen[n]
            entry += np.uint64(1)
            n += 1
        cubes.owns[cube] = n - first
        i, j, k = decode(head)
        for around in range(27):
            a, b, c = around % 3 - 1, around // 3 % 3 - 1, around // 9 - 1
            row = tile_row(heads.tiles, i + a, j + b, k + c) - heads.first_row
            if not 0 <= row < n_heads:
                continue
            sides = (a > 0) | (a < 0) << 1 | (b > 0) << 2 | (b < 0) << 3 | (c > 0) << 4 | (c < 0) << 5
            shift = 8 * (a + _SIDE * (b + _SIDE * c))
            own, last = first, n if sides == 0 else first
            for cell in range(heads.firsts[row], heads.firsts[row + 1]):
                if own < last and chosen[own] == cell:
                    own += 1
                    continue
                at = np.uint64(codes[cell]) & np.uint64((1 << _BITS) - 1)
                places[entry], cells[entry] = _PLACES[at] + shift, cell
                entry += np.uint64(_SIDES[at] & sides == sides)
        cubes.starts[cube + 1] = entry


@kernel
def _number(cells: Int32s, first: int, end: int, outside: Outside) -> None:
    """Replace cells by their numbers: ``first`` … ``end`` − 1 from 0 on, then the rest as they came."""
    for n in range(cells.size):
        cell = int(np.int64(cells[n]))
        is_own = first <= cell < end
        cells[n] = cell - first if is_own else end - first + number_of(outside, cell)


@kernel
def _axes(places: Uint16s, chosen: Int64s) -> Float32s:
    """Return the weights of the quadratic B-spline along each axis."""
    half, one = np.float32(0.5), np.float32(1)
    axes = np.empty((chosen.size, 12), np.float32)
    for n in range(chosen.size):
        row, sample = np.uint64(n), np.uint64(chosen[n])
        for axis in range(3):
            t = np.float32((places[sample, axis] + 0.5) * (1.0 / PLACE_STEPS))
            low, high = half * (one - t) * (one - t), half * t * t
            axes[row, 3 * axis], axes[row, 3 * axis + 1], axes[row, 3 * axis + 2] = (
                low,
                one - low - high,
                high,
            )
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
    """Write the residuals of the samples in cubes, and the inverse of what their weights sum to."""
    zero, one = np.float32(0), np.float32(1)
    grid = np.zeros(4 * _PLACES_OF_CUBE, np.float32)
    for cube in range(cubes.owns.size):
        begin, end = cubes.starts[cube], cubes.starts[cube + 1]
        for entry in range(begin, end):
            number, to = np.uint64(cubes.cells[entry]), np.uint64(4) * np.uint64(cubes.places[entry])
            covered = coverage[number]
            grid[to], grid[to + np.uint64(1)] = covered * values[number, 0], covered * values[number, 1]
            grid[to + np.uint64(2)], grid[to + np.uint64(3)] = covered * values[number, 2], covered
        for entry in range(begin, begin + cubes.owns[cube]):
            cell, at = cubes.cells[entry], int(cubes.places[entry]) - _CENTRE
            for sample in range(firsts[cell], firsts[cell + 1]):
                n = np.uint64(sample)
                of_x, of_y = (axes[n, 0], axes[n, 1], axes[n, 2]), (axes[n, 3], axes[n, 4], axes[n, 5])
                x, y, z, total = weighted_cube(
                    grid, at, _SIDE, of_x, of_y, (axes[n, 6], axes[n, 7], axes[n, 8])
                )
                inverse = one / total if total > zero else zero
                axes[n, 9] = inverse
                share = shares[n] if total > zero else zero
                found = x * inverse, y * inverse, z * inverse
                write_residual(found, targets, share, components, is_light, sample, rows)
        for entry in range(begin, end):
            to = np.uint64(4) * np.uint64(cubes.places[entry])
            for part in range(4):
                grid[to + np.uint64(part)] = zero


@kernel
def _equations(
    inner: Cubes, outer: Cubes, firsts: Int64s, axes: Float32s, coverage: Float32s, unknowns: int
) -> Equations:
    """List what samples blend by sample, in the order of cubes, and then by unknown.

    What is made here is known to overlap nothing: given arrays take half as long again.
    """
    size = axes.shape[0]
    ends = np.zeros(size + 1, np.int64)
    leaves, weights = np.empty(27 * size + 1, np.int32), np.empty(27 * size + 1, np.float32)
    grid = np.empty(_PLACES_OF_CUBE, np.int32)
    grid[:] = -1
    cells, offsets = np.empty(28, np.int32), np.empty(28, np.int32)
    products = np.empty(27, np.float32)
    one = np.uint64(1)
    count = 0
    for part in range(2):
        cubes = inner if part == 0 else outer
        for cube in range(cubes.owns.size):
            begin, end = cubes.starts[cube], cubes.starts[cube + 1]
            for entry in range(begin, end):
                number = cubes.cells[np.uint64(entry)]
                grid[np.uint64(cubes.places[np.uint64(entry)])] = number if number < unknowns else -1
            for entry in range(begin, begin + cubes.owns[cube]):
                cell = np.uint64(cubes.cells[np.uint64(entry)])
                at = int(cubes.places[np.uint64(entry)]) - _CENTRE
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
                grid[np.uint64(cubes.places[np.uint64(entry)])] = -1
    return by_unknown(ends, leaves[:count], weights[:count], unknowns)
