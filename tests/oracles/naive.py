"""The slow and obvious versions: what the fast ones are compared with."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial

from octex.tree.octree import Octree

Floats = npt.NDArray[np.float64]

MAX_DEPTH = 21
GRID = 2**30


class Cell(NamedTuple):
    level: int
    place: tuple[int, int, int]  # i, j, k at this level
    is_leaf: bool


def morton(place: Sequence[int], bits: int = MAX_DEPTH) -> int:
    """Interleave the bits of (i, j, k) one by one, i lowest."""
    return sum((place[axis] >> bit & 1) << (3 * bit + axis) for bit in range(bits) for axis in range(3))


def unmorton(code: int) -> tuple[int, int, int]:
    i, j, k = (sum((code >> (3 * bit + axis) & 1) << bit for bit in range(MAX_DEPTH)) for axis in range(3))
    return i, j, k


def cells_of(leaves: Iterable[tuple[int, tuple[int, int, int]]]) -> list[Cell]:
    """All cells of the octree with the given leaves (depth, place), in the order of their numbers."""
    found = {(0, (0, 0, 0)): False}
    for depth, place in leaves:
        for level in range(depth):
            found[level, shifted(place, depth - level)] = False
        found[depth, place] = True
    cells = [Cell(level, place, is_leaf) for (level, place), is_leaf in found.items()]
    return sorted(cells, key=lambda cell: (cell.level, morton(cell.place)))


def cells_in(tree: Octree) -> list[Cell]:
    """All cells of a tree, in the order of their numbers."""
    return [
        Cell(level, unmorton(code), not is_node)
        for level, (codes, nodes) in enumerate(tree.walk())
        for code, is_node in zip(codes.tolist(), nodes.tolist(), strict=True)
    ]


def truncated(cells: list[Cell], level: int) -> list[Cell]:
    """The tree down to a level, where nodes become leaves."""
    if level >= cells[-1].level:
        return cells
    return [
        cell._replace(is_leaf=cell.is_leaf or cell.level == level) for cell in cells if cell.level <= level
    ]


def find(cells: list[Cell], point: Sequence[float], max_level: int = MAX_DEPTH) -> int:
    """Number of the deepest stored cell that holds a point of texture space, or −1 outside the root."""
    if not all(0 <= x < 1 for x in point):
        return -1
    rounded = [min(math.floor(x * GRID + 0.5), GRID - 1) / GRID for x in point]
    holding = [
        number
        for number, cell in enumerate(cells)
        if cell.level <= max_level
        and all(place <= x * 2**cell.level < place + 1 for place, x in zip(cell.place, rounded, strict=True))
    ]
    return holding[-1] if holding else -1


def nearest(cells: list[Cell], point: Sequence[float]) -> int:
    """Number of the leaf that holds a point, else of the nearest of the 27 cells around it."""
    clamped = [min(max(x, 0.0), 1.0) * 2.0**MAX_DEPTH for x in point]
    steps = [min(max(math.floor(x * GRID + 0.5), 0), GRID - 1) for x in point]
    fixed = tuple(step * 2**MAX_DEPTH // GRID for step in steps)
    numbers = {(cell.level, cell.place): number for number, cell in enumerate(cells)}

    def stored(level: int, place: tuple[int, ...]) -> int:
        if (level, place) in numbers:
            return numbers[level, place]
        for above in range(level):
            number = numbers.get((above, shifted(place, level - above)), -1)
            if number >= 0 and cells[number].is_leaf:
                return number
        return -1

    def key(number: int) -> tuple[float, int]:
        cell = cells[number]
        edge = 2 ** (MAX_DEPTH - cell.level)
        low = [place * edge for place in cell.place]
        dx, dy, dz = (max(a - x, x - (a + edge), 0.0) for a, x in zip(low, clamped, strict=True))
        return dx * dx + dy * dy + dz * dz, morton(low)

    for level in range(cells[-1].level, -1, -1):
        middle = shifted(fixed, MAX_DEPTH - level)
        around = {
            stored(level, (middle[0] + a, middle[1] + b, middle[2] + c))
            for a in OFFSETS
            for b in OFFSETS
            for c in OFFSETS
        } - {-1}
        holding = stored(level, middle)
        if holding >= 0 and cells[holding].is_leaf:
            return holding
        if around:
            return min(around, key=key)
    raise AssertionError("the root is always stored")


OFFSETS = (-1, 0, 1)


def shifted(place: Sequence[int], bits: int) -> tuple[int, ...]:
    x, y, z = place
    return x >> bits, y >> bits, z >> bits


def srgb_to_linear(encoded: float) -> float:
    return encoded / 12.92 if encoded <= 0.04045 else math.pow((encoded + 0.055) / 1.055, 2.4)


class Field:
    """The field between the values of a tree: the rules of octex/field, cell by cell, in float64.

    A coefficient is a vector (w·c, w). ``values`` (rows, components) are decoded: a row a cell, a leaf's
    value or a node's average, then those that nodes keep. ``kept`` says which row each kept node's is:
    {cell number: row}. With the unit matrix for values a coefficient is the weight of each row.
    """

    def __init__(
        self, cells: list[Cell], values: npt.ArrayLike, filter: str, kept: Mapping[int, int] | None = None
    ) -> None:
        self.cells = cells
        self.values = np.column_stack([values, np.ones(len(np.asarray(values)))])
        self.filter = filter
        self.kept = dict(kept or {})
        self.reach = 2 if filter == "quartic" else 1
        self.max_depth = cells[-1].level
        self.numbers = {(cell.level, cell.place): number for number, cell in enumerate(cells)}
        self.nothing = np.zeros(self.values.shape[1])
        self.coefficient = cache(self._coefficient)
        self.window = cache(self._window)
        self.divided = cache(self._divided)
        self.meets_node = cache(self._meets_node)
        self.truncated = cache(self._truncated)

    def at(self, point: Sequence[float]) -> Floats:
        """The field; outside the root that of the nearest point inside."""
        field, inside = self._answering(point)
        if field is None:
            return self.values[0, :-1]
        (total,) = field.series(inside)
        return total[:-1] / total[-1]

    def derivatives(
        self, point: Sequence[float], direction: Sequence[float], order: int, *, before: bool = False
    ) -> Floats:
        """d^r/ds^r of the field at point + s·direction, r = 0 … order, at s = 0⁺ or, ``before``, 0⁻."""
        field, inside = self._answering(point)
        if field is None:
            return np.vstack([self.values[0, :-1], np.zeros((order, self.nothing.size - 1))])
        totals = field.series(inside, direction, order, before=before)
        weights = totals[:, -1:]
        quotient: list[Floats] = []  # of two power series, by long division
        for n in range(order + 1):
            rest = sum((quotient[m] * weights[n - m] for m in range(n)), self.nothing[:-1])
            quotient.append((totals[n, :-1] - rest) / weights[0])
        return np.array([math.factorial(n) * term for n, term in enumerate(quotient)])

    def weight(self, point: Sequence[float]) -> float:
        """Σ B·w of the whole tree: zero off the surface."""
        return float(self.series(clamped(point))[0, -1])

    def series(
        self,
        point: Sequence[float],
        direction: Sequence[float] = (0.0, 0.0, 0.0),
        order: int = 0,
        *,
        before: bool = False,
    ) -> Floats:
        """Σ B·(w·c, w) around a point of the root as a power series in s, see ``derivatives``."""
        level, middle = self.stop(point, [-d if before else d for d in direction])
        block = self.window(level, middle, self.reach)
        for x, i, d in zip(point, middle, direction, strict=True):
            t = x * 2.0**level - i
            speeds = (d * 2.0**level) ** np.arange(order + 1)
            block = contracted(block, speeds[:, None] * weights_of(self.filter, order, t))
        totals = np.zeros((order + 1, self.nothing.size))
        for powers in itertools.product(range(order + 1), repeat=3):
            if sum(powers) <= order:
                totals[sum(powers)] += block[:, *powers]
        return totals

    def stop(self, point: Sequence[float], side: Sequence[float]) -> tuple[int, tuple[int, ...]]:
        """The first level at which no cell of the window is a node, and the cell there that holds the point.

        Of two cells that meet at the point, the one toward ``side``.
        """
        size = 2 ** (self.max_depth + 1)
        cells = [
            math.floor(x * size) if d >= 0 else math.ceil(x * size) - 1
            for x, d in zip(point, side, strict=True)
        ]
        deepest = [min(max(i, 0), size - 1) for i in cells]
        middles = [shifted(deepest, above) for above in range(self.max_depth + 1, -1, -1)]
        return next(
            (level, middle) for level, middle in enumerate(middles) if not self.meets_node(level, middle)
        )

    def is_node(self, number: int) -> bool:
        return number >= 0 and not self.cells[number].is_leaf

    def stored(self, number: int) -> Floats:
        """What a cell has of its own: a leaf's value, a kept node's, or nothing."""
        if number >= 0 and self.cells[number].is_leaf:
            return self.values[number]
        return self.values[self.kept[number]] if number in self.kept else self.nothing

    def _meets_node(self, level: int, middle: tuple[int, ...]) -> bool:
        return any(self.is_node(self.numbers.get((level, place), -1)) for place in around(middle, self.reach))

    def _window(self, level: int, middle: tuple[int, ...], reach: int) -> Floats:
        coefficients = [self.coefficient(level, place) for place in around(middle, reach)]
        return np.reshape(coefficients, (2 * reach + 1,) * 3 + (-1,))

    def _coefficient(self, level: int, place: tuple[int, ...]) -> Floats:
        number = self.numbers.get((level, place), -1)
        above = self.numbers.get((level - 1, shifted(place, 1)), -1)
        if level == 0:
            return self.stored(number)
        if not self.is_node(above):
            return self.refined(level, place)
        if above not in self.kept or self.filter == "linear":
            return self.stored(number)
        refined = self.refined(level, place)
        return refined if number < 0 else refined[-1] * self.stored(number)

    def refined(self, level: int, place: tuple[int, ...]) -> Floats:
        """The tensor product of the filter's refinement of the level above."""
        parent = shifted(place, 1)
        if self.filter == "linear" and not self.coefficient(level - 1, parent)[-1]:
            return self.nothing
        x, y, z = place
        total = self.divided(level - 1, parent)[(x & 1) << 2 | (y & 1) << 1 | z & 1]
        return total / total[-1] if self.filter == "linear" else total

    def _divided(self, level: int, place: tuple[int, ...]) -> Floats:
        """What a cell's eight children are refined to, x slowest."""
        return tensor_products(self.filter) @ self.window(level, place, 1).reshape(27, -1)

    def _answering(self, point: Sequence[float]) -> tuple[Field | None, list[float]]:
        """The field of the deepest levels with any weight at a point, and the nearest point of the root."""
        inside = clamped(point)
        levels = range(self.max_depth, -1, -1)
        return next((f for f in map(self.truncated, levels) if f.series(inside)[0, -1] > 0), None), inside

    def _truncated(self, level: int) -> Field:
        if level >= self.max_depth:
            return self
        cells = truncated(self.cells, level)
        kept = {n: row for n, row in self.kept.items() if n < len(cells) and not cells[n].is_leaf}
        return Field(cells, self.values[:, :-1], self.filter, kept)


#: Weights of the cells before, at and after the parent, for the lower and the upper child of an axis.
REFINEMENTS = {
    "linear": np.array([[1, 3, 0], [0, 3, 1]]) / 4,
    "quadratic": np.array([[1, 3, 0], [0, 3, 1]]) / 4,
    "quartic": np.array([[5, 10, 1], [1, 10, 5]]) / 16,
}


@cache
def tensor_products(filter: str) -> Floats:
    """The weights of the 27 cells around a cell in each of its eight children, x slowest."""
    by_axis = REFINEMENTS[filter]
    return np.kron(np.kron(by_axis, by_axis), by_axis)


def field_of(tree: Octree, filter: str, values: npt.ArrayLike | None = None) -> Field:
    """The field of a tree with values (rows, components); without values, that of the rows' weights."""
    cells = cells_in(tree)
    kept = {node: len(cells) + row for row, node in enumerate(tree.kept.cells.tolist())}
    return Field(cells, np.eye(len(cells) + len(kept)) if values is None else values, filter, kept)


def around(middle: Sequence[int], reach: int) -> list[tuple[int, ...]]:
    """The places of the cells around one and of itself, x slowest."""
    return list(itertools.product(*(range(i - reach, i + reach + 1) for i in middle)))


def contracted(window: Floats, weights: Floats) -> Floats:
    """Sum over the first axis under weights (n, cells); n is the new last axis."""
    total = weights @ window.reshape(len(window), -1)
    return total.T.reshape(*window.shape[1:], len(weights))


def weights_of(filter: str, order: int, t: float) -> Floats:
    """d^r/dt^r / r! of the weight of each cell of an axis (order + 1, cells) over the middle, t = 0 … 1."""
    if t > 0.5:  # mirrored: weights that end at t = 1 are exactly zero there
        return weights_of(filter, order, 1 - t)[:, ::-1] * (-1.0) ** np.arange(order + 1)[:, None]
    return expanded(filter, order, t == 0.5) @ t ** np.arange(5.0)


@cache
def expanded(filter: str, order: int, upper: bool) -> Floats:
    """The factor of s^r·t^m in the weight of each cell at t + s: (order + 1, cells, 5)."""
    if filter == "linear":  # its pieces part at the cells' centres
        falling, rising = (piece(Polynomial([-0.5 if upper else 0.5, 1])) for piece in b_spline(1)[::-1])
        pieces = [Polynomial(0), falling, rising] if upper else [falling, rising, Polynomial(0)]
    else:
        pieces = b_spline(4 if filter == "quartic" else 2)[::-1]
    coefficients = [[*piece.coef, *[0.0] * (5 + order)] for piece in pieces]
    return np.array(
        [
            [[math.comb(m + r, r) * each[m + r] for m in range(5)] for each in coefficients]
            for r in range(order + 1)
        ]
    )


@cache
def b_spline(degree: int) -> list[Polynomial]:
    """The pieces of the B-spline over [0, degree + 1], each of its own t = 0 … 1, by Cox and de Boor."""
    if degree == 0:
        return [Polynomial(1)]
    lower = [Polynomial(0), *b_spline(degree - 1), Polynomial(0)]
    return [
        (Polynomial([n, 1]) * lower[n + 1] + Polynomial([degree + 1 - n, -1]) * lower[n]) / degree
        for n in range(degree + 1)
    ]


def clamped(point: Sequence[float]) -> list[float]:
    return [min(max(x, 0.0), 1.0) for x in point]


def blended(weights: Floats, values: Floats, alpha: Floats | None = None) -> Floats:
    """Values (rows, components) under their rows' weights, times the rows' alpha where that leaves any."""
    if alpha is not None and (weights * alpha).sum() > 0:
        weights = weights * alpha
    return weights @ values / weights.sum()
