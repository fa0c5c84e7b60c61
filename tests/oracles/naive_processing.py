"""Textures put together the slow way: cell by cell, by places."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import decode, encode
from octex.editing.refined import refined_values
from octex.texture import Channel, OctreeTexture
from octex.tree.morton import decode_cells

Place = tuple[int, int]  # level, Morton code
Floats = npt.NDArray[np.floating[Any]]

AREAS = np.array([2.0**-44, *(2.0 ** ((code - 207) / 8) for code in range(1, 256))])


class Cell(NamedTuple):
    number: int
    is_leaf: bool


def cells_of(texture: OctreeTexture) -> dict[Place, Cell]:
    found: dict[Place, Cell] = {}
    for level, (codes, is_node) in enumerate(texture.tree.walk()):
        for code, node in zip(codes.tolist(), is_node.tolist(), strict=True):
            found[level, code] = Cell(len(found), not node)
    return found


def children_of(cells: dict[Place, Cell], place: Place) -> list[Place]:
    level, code = place
    return [below for octant in range(8) if (below := (level + 1, code << 3 | octant)) in cells]


def mean_below(texture: OctreeTexture, name: str, cells: dict[Place, Cell], place: Place) -> Floats:
    """The mean of the children of a node, weighed by area and alpha."""
    channel = texture.channels[name]
    numbers = [cells[below].number for below in children_of(cells, place)]
    weights = AREAS[texture.tree.arrays.areas[numbers]]
    if "alpha" in texture.channels and name != "alpha":
        weights = weights * np.maximum(
            decode(texture.channels["alpha"].values[numbers], "data")[:, 0], 2.0**-40
        )
    values = decode(channel.values[numbers], channel.format.space).astype(np.float64)
    return np.asarray((values * weights[:, None]).sum(axis=0) / weights.sum())


def unfitted(texture: OctreeTexture) -> OctreeTexture:
    """The texture with the means of children in all nodes."""
    cells = cells_of(texture)
    channels: dict[str, Channel] = {}
    for name in sorted(texture.channels, key=lambda name: name != "alpha"):
        before = texture.channels[name]
        channels[name] = before._replace(values=before.values.copy())
        made = OctreeTexture(texture.tree, channels, texture.placement, texture.bounds)
        for place in sorted(cells, reverse=True):
            if not cells[place].is_leaf and texture.tree.n_leaves:
                mean = mean_below(made, name, cells, place)[None]
                form = before.format
                channels[name].values[cells[place].number] = encode(mean, form.dtype, form.space)[0]
    ordered = {name: channels[name] for name in texture.channels}
    return OctreeTexture(texture.tree, ordered, texture.placement, texture.bounds, texture.metadata)


def value_at(texture: OctreeTexture, name: str, cells: dict[Place, Cell], place: Place) -> Floats | None:
    """A cell's value; below a leaf what is refined to it; None where there is nothing."""
    channel = texture.channels[name]
    if place in cells:
        number = cells[place].number
        return decode(channel.values[number : number + 1], channel.format.space)[0]
    level, code = place
    while (level, code) not in cells:
        level, code = level - 1, code >> 3
    if not cells[level, code].is_leaf:
        return None
    codes = np.array([place[1]], np.int64)
    return refined_values(texture.tree, texture.channels, codes, place[0])[name][0]


def left(texture: OctreeTexture, over: OctreeTexture) -> set[Place]:
    """The cells of a texture that another laid over it wholly does not hide.

    Hidden are what is below the other's leaves, and skirts that it lacks that are beside nothing but what it
    has, in a cell that it lacks, no larger than its largest leaf or kept node, that touches a leaf of it.
    """
    cells, others = cells_of(texture), cells_of(over)
    is_over = {place for place, cell in others.items() if cell.is_leaf and over.tree.n_leaves}
    kept = set(over.tree.kept.cells.tolist())
    coarsest = min(level for (level, _), cell in others.items() if cell.is_leaf or cell.number in kept)
    leaves, skirts, alone = set(), set(), set()
    for place, cell in cells.items():
        level, code = place
        if any((level - up, code >> 3 * up) in is_over for up in range(1, level + 1)):
            continue
        if place in is_over or (cell.is_leaf and place in others):
            leaves.add(place)
        elif cell.is_leaf:
            (skirts if texture.tree.arrays.areas[cell.number] == 1 else alone).add(place)
    for level, code in skirts:
        above = [(level - up, code >> 3 * up) for up in range(max(level - coarsest, 0), -1, -1)]
        top = next(place for place in above if place not in others)
        is_read = any(touch(top, each) for each in is_over)
        if not is_read or any(are_adjacent((level, code), each) for each in alone):
            leaves.add((level, code))
    leaves |= alone
    return {(level - up, code >> 3 * up) for level, code in leaves for up in range(level + 1)}


def are_adjacent(place: Place, other: Place) -> bool:
    """Say whether another cell is in a cell, around it, or holds a cell around it."""
    low, high, one, two = _corners(place, other)
    return bool(((high * two < (low + 2) * one) & ((high + 1) * two > (low - 1) * one)).all())


def touch(place: Place, other: Place) -> bool:
    """Say whether two cells share a point."""
    low, high, one, two = _corners(place, other)
    return bool(((high * two <= (low + 1) * one) & ((high + 1) * two >= low * one)).all())


def _corners(place: Place, other: Place) -> tuple[Any, Any, int, int]:
    """The lowest corners of two cells, each in cells of its level, and both edges in the smaller."""
    low, high = (decode_cells(np.array([code]))[0] for _, code in (place, other))
    finer = max(place[0], other[0])
    return low, high, 2 ** (finer - place[0]), 2 ** (finer - other[0])


class Mixed(NamedTuple):
    """A value for each leaf of the union, the second's part there, and which places are cells."""

    values: dict[Place, Floats]
    share: dict[Place, float]
    places: list[Place]


def mixed(
    first: OctreeTexture, second: OctreeTexture, amount: float, name: str, *, over: bool = False
) -> Mixed:
    """Mix leaf by leaf: both channels' values, weighed by alpha, where both have something."""
    one, other = cells_of(first), cells_of(second)
    cells = [set(one), set(other)]
    if not over and amount in (0.0, 1.0):
        cells[int(1 - amount)] = left(*((first, second) if amount else (second, first)))
    places = sorted(cells[0] | cells[1])
    nodes = {(level - 1, code >> 3) for level, code in places if level}
    values, share = {}, {}
    for place in places:
        if place in nodes:
            continue
        a, b = value_at(first, name, one, place), value_at(second, name, other, place)
        alphas = [
            value_at(each, "alpha", cells, place) if "alpha" in each.channels else np.ones(1)
            for each, cells in ((first, one), (second, other))
        ]
        if a is None or b is None:
            found = a if b is None else b
            assert found is not None
            values[place], share[place] = found, float(a is None)
            continue
        assert alphas[0] is not None
        assert alphas[1] is not None
        if over:
            weights = float(alphas[0][0] * (1 - alphas[1][0])), float(alphas[1][0])
        else:
            weights = float((1 - amount) * alphas[0][0]), float(amount * alphas[1][0])
        total = sum(weights)
        share[place] = weights[1] / total if total > 0 else 1.0 if over else amount
        if name == "alpha":
            values[place] = np.array([total])
        else:
            values[place] = a * (1 - share[place]) + b * share[place]
    return Mixed(values, share, places)
