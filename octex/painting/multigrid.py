"""Smooth functions on a graph whose nodes lie in cells: the screened Laplace equation, by multigrid.

Conjugate gradients, preconditioned by a W-cycle over the tree. Connected nodes in a cell become one node of
the level above (aggregation; Notay 2010), so coarse levels never join separate parts of the graph.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

from octex.arrays import Complex128s, Float64s, Int64s
from octex.jit import kernel
from octex.source.parts import join

Values = TypeVar("Values", Float64s, Complex128s)

#: Reduction of the error in the energy norm, and the largest number of steps.
_LESS, _STEPS = 1e-6, 200
#: Coarse solves per step, 2 for a W-cycle; and the number of rows up to which there is one.
_CYCLES, _FEW = 2, 256


class Graph(NamedTuple):
    """Neighbours of each node, in rows."""

    starts: Int64s  # (n + 1,)   each node's first row
    others: Int64s  # (rows,)   its neighbours
    weights: Float64s  # (rows,)   of the edges to them


class _GraphLevel(NamedTuple):
    graph: Graph
    diagonal: Float64s  # (n,)
    above: Int64s  # (n,)   the node of the next coarser level that each is part of


def graph_of(pairs: Int64s, weights: Float64s, count: int) -> Graph:
    """Return the graph of ``count`` nodes whose edges are pairs (k, 2); equal pairs add their weights."""
    first, second = pairs.T
    keys = np.concatenate([first * count + second, second * count + first])
    keys, inverse = np.unique(keys, return_inverse=True)
    summed = added(inverse, np.concatenate([weights, weights]), keys.size)
    rows = keys // max(count, 1)
    return Graph(np.searchsorted(rows, np.arange(count + 1)), keys % max(count, 1), summed)


def added(numbers: Int64s, values: Float64s, count: int) -> Float64s:
    """Return the sums (count,) of values (n,) that have the same number."""
    return np.bincount(numbers, values, count).astype(np.float64, copy=False)


def coarser(graph: Graph, codes: Int64s) -> tuple[Graph, Int64s, Int64s]:
    """Return the graph one level up, its nodes' codes, and the coarse node of each node (n,)."""
    rows = np.repeat(np.arange(graph.starts.size - 1), np.diff(graph.starts))
    once = rows < graph.others
    pairs, weights = np.column_stack([rows[once], graph.others[once]]), graph.weights[once]
    parents = np.arange(codes.size)
    inside = codes[pairs[:, 0]] >> 3 == codes[pairs[:, 1]] >> 3
    join(parents, *np.ascontiguousarray(pairs[inside].T))
    roots, above = np.unique(parents, return_inverse=True)
    joined = above[pairs[~inside]]
    return graph_of(joined, weights[~inside], roots.size), codes[roots] >> 3, above


def solve(graph: Graph, codes: Int64s, level: int, hold: Float64s, right: Float64s) -> Float64s:
    """Return x (n, components) with hold · x + Σ weight · (x − x of the neighbour) = right.

    ``codes`` (n,) are the Morton codes of the nodes' cells; each part needs a ``hold`` (n,) above 0.
    """
    levels = []
    level_graph, cells = graph, codes
    for _ in range(level + 1):
        rows = np.repeat(np.arange(hold.size), np.diff(level_graph.starts))
        diagonal = hold + added(rows, level_graph.weights, hold.size)
        above_graph, cells, above = coarser(level_graph, cells)
        levels.append(_GraphLevel(level_graph, diagonal, above))
        if not level_graph.others.size:
            break  # no edges are left: each node is solved by itself
        level_graph, hold = above_graph, added(above, hold, cells.size)

    def left_sides(x: Float64s) -> Float64s:
        sums = np.empty_like(x)
        _apply(graph, levels[0].diagonal, x, sums)
        return sums

    return conjugate_gradients(left_sides, right, lambda residual: _cycle(levels, 0, residual), _LESS, _STEPS)


def conjugate_gradients(
    apply: Callable[[Values], Values],
    right: Values,
    eased: Callable[[Values], Values],
    less: float,
    steps: int,
) -> Values:
    """Return x with apply(x) = right, for each column; ``eased`` approximates the inverse of ``apply``."""
    x, residual = np.zeros_like(right), right.copy()
    z = eased(residual)
    direction, energy = z.copy(), _products(residual, z)
    aim = less**2 * energy
    for _ in range(steps):
        if (energy <= aim).all():
            break
        product = apply(direction)
        length = energy / np.maximum(_products(direction, product), 1e-300)
        x += length * direction
        residual -= length * product
        z = eased(residual)
        before, energy = energy, _products(residual, z)
        direction = z + energy / np.maximum(before, 1e-300) * direction
    return x


def _products(first: Values, second: Values) -> Float64s:
    """Return the real parts of the inner products of columns."""
    products: Float64s = (np.conj(first) * second).real.sum(axis=0)
    return products


def _cycle(levels: list[_GraphLevel], number: int, right: Float64s) -> Float64s:
    """Return an approximate solution of a level's equation."""
    graph, diagonal, above = levels[number]
    x = np.zeros_like(right)
    _relax(graph, diagonal, right, x, 0)
    if number + 1 < len(levels):
        residual = np.empty_like(right)
        for cycle in range(_CYCLES if number and graph.others.size > _FEW else 1):
            if cycle:
                _relax(graph, diagonal, right, x, 1)
                _relax(graph, diagonal, right, x, 0)
            _apply(graph, diagonal, x, residual)
            np.subtract(right, residual, out=residual)
            count = levels[number + 1].diagonal.size
            coarse = np.stack([added(above, column, count) for column in residual.T], axis=1)
            x += _cycle(levels, number + 1, coarse)[above]
    _relax(graph, diagonal, right, x, 1)
    return x


@kernel
def _relax(graph: Graph, diagonal: Float64s, right: Float64s, x: Float64s, backward: int) -> None:
    """Solve each node's equation in turn, from the first on or from the last (Gauss and Seidel)."""
    count = diagonal.size
    for step in range(count):
        n = count - 1 - step if backward else step
        for component in range(x.shape[1]):
            total = right[n, component]
            for row in range(graph.starts[n], graph.starts[n + 1]):
                total += graph.weights[row] * x[graph.others[row], component]
            x[n, component] = total / diagonal[n]


@kernel
def _apply(graph: Graph, diagonal: Float64s, x: Float64s, left_sides: Float64s) -> None:
    """Write the left sides of all nodes' equations."""
    for n in range(diagonal.size):
        for component in range(x.shape[1]):
            total = diagonal[n] * x[n, component]
            for row in range(graph.starts[n], graph.starts[n + 1]):
                total -= graph.weights[row] * x[graph.others[row], component]
            left_sides[n, component] = total
