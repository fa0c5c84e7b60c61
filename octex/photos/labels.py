"""Chooses one photograph for each patch of the surface, and levels the colours at the patches' borders.

The labels of a sheet, a cell's part of the surface, are the photographs that see it. A label costs what the
photograph lacks in quality there. Two neighbours with different labels cost the difference of the two
photographs at both, and a little for the border itself (Lempitsky & Ivanov, "Seamless Mosaicing of
Image-Based Texture Maps", 2007).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Floats, Int32s, Int64s
from octex.jit import inlined, kernel
from octex.painting.multigrid import Graph, added, coarser, graph_of, solve
from octex.painting.sheets import Sheets

#: Costs of a sheet with the area of a cell face: per loss of quality, and if its photograph does not see it.
_QUALITY, _UNSEEN = 3.0, 1.0
#: Costs of a border one cell long: by itself, and where photographs differ by the whole range.
_BORDER, _DIFFERENCE = 0.5, 10.0
#: Labels are first chosen this many levels above the sheets, among this many of the cheapest photographs.
_ABOVE, _CANDIDATES = 2, 8
#: Passes over all sheets, forward and backward; most rounds of local moves.
_PASSES, _MOVES = 12, 8
#: Light as dark as noise; difference of logarithms from which photographs count for less.
DARK, _FAR = 0.02, 0.3
#: Rounds in which labels fade into their neighbours.
_FEATHER = 3
#: Weight that holds the levelling at zero: it fades over 1/√_HOLD cells.
_HOLD = 1e-3


class LabelCosts(NamedTuple):
    """Costs of the labels."""

    colors: Float32s  # (n, images, 3)   roots of light; the mean of the others where an image sees nothing
    costs: Float32s  # (n, images)   infinite where an image sees nothing


def costs_of(paint: Float32s, weights: Float32s, areas: Float64s) -> LabelCosts:
    """Return the costs of labels from paint (images, n, 3) and weights that rise with quality."""
    seen = weights > 0
    most = np.maximum(weights.max(axis=0), np.float32(1e-30))
    costs = areas * _QUALITY * (1 - weights / most)
    colors = np.sqrt(np.maximum(paint, 0))
    return _completed(colors.transpose(1, 0, 2), np.where(seen, costs, np.inf).T.astype(np.float64))


def _completed(colors: Float32s, costs: Float64s) -> LabelCosts:
    """Fill in the mean colour where images see nothing."""
    seen = np.isfinite(costs)
    sums = (colors * seen[..., None]).sum(axis=1)
    mean = sums / np.maximum(seen.sum(axis=1), 1)[:, None]
    complete = np.ascontiguousarray(np.where(seen[..., None], colors, mean[:, None]), np.float32)
    return LabelCosts(complete, np.ascontiguousarray(costs, np.float32))


def _coarser_costs(views: LabelCosts, areas: Float64s, above: Int64s, count: int) -> LabelCosts:
    """Return the costs for ``count`` coarser sheets, of which ``above`` holds each sheet's number."""
    seen = np.isfinite(views.costs)
    costs = np.where(seen, views.costs, _UNSEEN * areas[:, None]) * seen.any(axis=1, keepdims=True)
    sums = np.zeros((count, seen.shape[1], 5))
    parts = np.concatenate([views.colors * seen[..., None], seen[..., None], costs[..., None]], axis=2)
    np.add.at(sums, above, parts)
    colors = sums[..., :3] / np.maximum(sums[..., 3:4], 1)
    return _completed(colors.astype(np.float32), np.where(sums[..., 3] > 0, sums[..., 4], np.inf))


def labelled(graph: Graph, codes: Int64s, areas: Float64s, views: LabelCosts) -> Int32s:
    """Return the image (n,) of each sheet, −1 where none sees it.

    First sequential tree-reweighted message passing (Kolmogorov 2006) on a coarser level, then local moves.
    """
    levels = [(graph, views)]
    steps = []
    for _ in range(_ABOVE):
        graph, codes, above = coarser(graph, codes)
        views = _coarser_costs(views, areas, above, codes.size)
        areas = np.bincount(above, areas, codes.size).astype(np.float64, copy=False)
        levels.append((graph, views))
        steps.append(above)
    labels = passed(graph, views)
    for above, (finer, costs) in zip([np.arange(codes.size), *steps[::-1]], levels[::-1], strict=True):
        labels = labels[above]
        labels[~np.isfinite(costs.costs).any(axis=1)] = -1
        for _ in range(_MOVES):
            if not _move(finer, costs, labels):
                break
    return labels


def passed(graph: Graph, views: LabelCosts) -> Int32s:
    """Return the best labels of all message passes; −1 where no image sees the sheet."""
    order = np.argsort(views.costs, axis=1, kind="stable")[:, :_CANDIDATES].astype(np.int32)
    order[~np.isfinite(np.take_along_axis(views.costs, order, axis=1))] = -1
    count = graph.starts.size - 1
    rows = np.repeat(np.arange(count), np.diff(graph.starts))
    back = np.searchsorted(rows * count + graph.others, graph.others * count + rows)
    messages = np.zeros((graph.others.size, order.shape[1]))
    labels, best = order[:, 0].copy(), order[:, 0].copy()
    least = energy(graph, views, best)
    for number in range(2 * _PASSES):
        _pass(graph, views, order, back, messages, number % 2, labels)
        if number % 2 == 0 and (cost := energy(graph, views, labels)) < least:
            least, best = cost, labels.copy()
    return best


@inlined
def _between(views: LabelCosts, i: int, j: int, p: int, q: int) -> float:
    """Return the cost of a border one cell long between sheet i of image p and sheet j of image q."""
    if p == q:
        return 0.0
    total = 0.0
    for n in (i, j):
        squares = 0.0
        for component in range(3):
            squares += (views.colors[n, p, component] - views.colors[n, q, component]) ** 2
        total += np.sqrt(squares)
    return _BORDER + 0.5 * _DIFFERENCE * total


@kernel
def energy(graph: Graph, views: LabelCosts, labels: Int32s) -> float:
    """Return the cost of labels; unseen sheets, −1, cost nothing."""
    total = 0.0
    for n in range(labels.size):
        if labels[n] < 0:
            continue
        total += views.costs[n, labels[n]]
        for row in range(graph.starts[n], graph.starts[n + 1]):
            other = graph.others[row]
            if other > n and labels[other] >= 0:
                total += graph.weights[row] * _between(views, n, other, labels[n], labels[other])
    return total


@kernel
def _pass(
    graph: Graph,
    views: LabelCosts,
    candidates: Int32s,
    back: Int64s,
    messages: Float64s,
    backward: int,
    labels: Int32s,
) -> None:
    """Send ``messages`` (rows, candidates) onward from sheet to sheet; a forward pass also chooses labels."""
    count, most = candidates.shape
    sums, costs = np.empty(most, np.float64), np.empty(most, np.float64)
    for step in range(count):
        n = count - 1 - step if backward else step
        if candidates[n, 0] < 0:
            continue
        before = after = 0
        for k in range(most):
            if candidates[n, k] >= 0:
                sums[k] = costs[k] = views.costs[n, candidates[n, k]]
        for row in range(graph.starts[n], graph.starts[n + 1]):
            other = graph.others[row]
            if candidates[other, 0] < 0:
                continue
            is_after = (other < n) if backward else (other > n)
            after += is_after
            before += not is_after
            for k in range(most):
                if candidates[n, k] < 0:
                    continue
                sums[k] += messages[row, k]
                if is_after:
                    costs[k] += messages[row, k]
                else:
                    costs[k] += graph.weights[row] * _between(
                        views, n, other, candidates[n, k], labels[other]
                    )
        if not backward:
            least = np.inf
            for k in range(most):
                if candidates[n, k] >= 0 and costs[k] < least:
                    least, labels[n] = costs[k], candidates[n, k]
        share = 1.0 / max(before, after, 1)
        for row in range(graph.starts[n], graph.starts[n + 1]):
            other = graph.others[row]
            if candidates[other, 0] < 0 or ((other > n) if backward else (other < n)):
                continue
            to = back[row]
            lowest = np.inf
            for k in range(most):
                q = candidates[other, k]
                if q < 0:
                    continue
                least = np.inf
                for m in range(most):
                    p = candidates[n, m]
                    if p >= 0:
                        cost = share * sums[m] - messages[row, m]
                        cost += graph.weights[row] * _between(views, n, other, p, q)
                        least = min(least, cost)
                messages[to, k] = least
                lowest = min(lowest, least)
            for k in range(most):
                if candidates[other, k] >= 0:
                    messages[to, k] -= lowest


@kernel
def _move(graph: Graph, views: LabelCosts, labels: Int32s) -> int:
    """Give sheets the cheapest label of neighbours, or of all if unseen (Besag 1986); count changes."""
    changed = 0
    images = views.costs.shape[1]
    tried = np.empty(images, np.int64)
    tried[:] = -1
    for n in range(labels.size):
        if labels[n] < 0:
            continue
        is_seen = np.isfinite(views.costs[n, labels[n]])
        best, least = labels[n], np.inf
        first, end = graph.starts[n], graph.starts[n + 1]
        for number in range(-1, end - first if is_seen else images):
            if number < 0:
                p = labels[n]
            else:
                p = labels[graph.others[first + number]] if is_seen else number
            if p < 0 or tried[p] == n or not np.isfinite(views.costs[n, p]):
                continue
            tried[p] = n
            cost = np.float64(views.costs[n, p])
            for row in range(first, end):
                other = graph.others[row]
                if labels[other] >= 0:
                    cost += graph.weights[row] * _between(views, n, other, p, labels[other])
            if cost < least:
                best, least = p, cost
        changed += best != labels[n]
        labels[n] = best
    return changed


def levelling(sheets: Sheets, labels: Int32s, paint: Float32s, weights: Float32s) -> Float64s:
    """Return the exposures (n, 3) of sheets, for `exposed`, that level the steps at borders.

    Least squares of the steps across borders and of the changes from sheet to sheet. A border weighs less the
    more its two images differ on a sheet that both see.
    """
    pairs, (one, other), codes = sheets.pairs, sheets.pairs.T, sheets.codes
    p, q = labels[one], labels[other]
    apart, count = np.zeros((len(pairs), 3)), np.zeros(len(pairs))
    for sheet in (one, other):
        both = (p >= 0) & (q >= 0) & (weights[p, sheet] > 0) & (weights[q, sheet] > 0)
        light = np.maximum(paint[:, sheet].astype(np.float64), 0.0) + DARK
        numbers = np.arange(len(pairs))
        apart[both] += np.log(light[q, numbers] / light[p, numbers])[both]
        count += both
    apart /= np.maximum(count, 1)[:, None]
    apart[p == q] = 0.0
    tied = (p >= 0) & (q >= 0) & ((p == q) | (count > 0))
    ties = sheets.ties / (1.0 + (np.abs(apart).max(axis=1) / _FAR) ** 2) ** 2
    right = np.zeros((codes.size, 3))
    for component in range(3):
        step = ties * tied * apart[:, component]
        right[:, component] = np.bincount(one, step, codes.size) - np.bincount(other, step, codes.size)
    graph = graph_of(pairs[tied], ties[tied], codes.size)
    return solve(graph, codes, sheets.level, np.full(codes.size, _HOLD), right)


def feathered(
    graph: Graph, labels: Int32s, exposures: Float64s, weights: Float32s
) -> tuple[Float32s, Float32s]:
    """Return sheets' shares of images (n, images), and exposures (n, images, 3), both feathered."""
    count, images = labels.size, len(weights)
    rows = np.repeat(np.arange(count), np.diff(graph.starts))
    totals = np.maximum(added(rows, graph.weights, count), 1e-12)
    shares = np.zeros((count, images), np.float32)
    feathered_exposures = np.zeros((count, images, 3), np.float32)
    for number in range(images):
        is_here = labels == number
        values = np.column_stack([is_here, is_here[:, None] * exposures])
        for _ in range(_FEATHER):
            around = [added(rows, graph.weights * column[graph.others], count) for column in values.T]
            values = (values + np.stack(around, axis=1) / totals[:, None]) / 2
        shares[:, number] = values[:, 0] * (weights[number] > 0)
        feathered_exposures[:, number] = values[:, 1:] / np.maximum(values[:, :1], 1e-12)
    shares /= np.maximum(shares.sum(axis=1, keepdims=True), np.float32(1e-12))
    return shares, feathered_exposures


def exposed(light: Float32s, exposures: Floats) -> Float32s:
    """Return light (n, 3) times exp(exposures); nearly dark light changes less."""
    levelled_light = (np.maximum(light, 0) + DARK) * np.exp(exposures) - DARK
    return np.maximum(levelled_light, 0).astype(np.float32)
