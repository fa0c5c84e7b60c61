"""The slow and obvious versions: what the fast ones are compared with."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

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
    return tuple(coordinate >> bits for coordinate in place)


def srgb_to_linear(encoded: float) -> float:
    return encoded / 12.92 if encoded <= 0.04045 else math.pow((encoded + 0.055) / 1.055, 2.4)
