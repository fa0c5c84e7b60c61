"""The energy of labels, its least by trying all, and least squares of steps by dense matrices."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


def energy(pairs: Array, weights: Array, colors: Array, costs: Array, labels: Sequence[int]) -> float:
    total = sum(float(costs[n, label]) for n, label in enumerate(labels) if label >= 0)
    for (i, j), weight in zip(pairs, weights, strict=True):
        p, q = labels[i], labels[j]
        if p >= 0 and q >= 0 and p != q:
            apart = sum(np.linalg.norm(colors[n, p].astype(float) - colors[n, q]) for n in (i, j))
            total += weight * (0.5 + 5.0 * apart)
    return float(total)


def least(pairs: Array, weights: Array, colors: Array, costs: Array) -> float:
    seen = [np.flatnonzero(np.isfinite(row)).tolist() or [-1] for row in costs]
    return min(energy(pairs, weights, colors, costs, labels) for labels in product(*seen))


def levelling(pairs: Array, ties: Array, labels: Array, paint: Array, weights: Array, hold: float) -> Array:
    """Return the logarithms of exposures of nodes by which steps between images are least."""
    paint = np.log(paint.astype(float) + 0.02)
    count = len(labels)
    rows, right = [np.sqrt(hold) * np.eye(count)], [np.zeros((count, 3))]
    for (i, j), tie in zip(pairs, ties, strict=True):
        p, q = labels[i], labels[j]
        steps = [paint[q, n] - paint[p, n] for n in (i, j) if min(weights[p, n], weights[q, n]) > 0]
        if min(p, q) < 0 or (p != q and not steps):
            continue
        row = np.zeros((1, count))
        row[0, i], row[0, j] = 1, -1
        step = np.mean(steps, axis=0) if p != q else np.zeros(3)
        tie = tie / (1 + (np.abs(step).max() / 0.3) ** 2) ** 2
        rows.append(np.sqrt(tie) * row)
        right.append(np.sqrt(tie) * step[None])
    found: Array = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    return found


def feathered(
    pairs: Array, ties: Array, labels: Array, exposures: Array, seen: Array, times: int
) -> tuple[Array, Array]:
    """Shares (n, images) of labels that fade into their neighbours', and their mean exposures."""
    count, images = len(labels), len(seen)
    shares = [[float(labels[n] == p) for p in range(images)] for n in range(count)]
    sums = [[shares[n][p] * exposures[n] for p in range(images)] for n in range(count)]
    beside: list[list[tuple[int, float]]] = [[] for _ in range(count)]
    for (a, b), tie in zip(pairs.tolist(), ties.tolist(), strict=True):
        beside[a].append((b, tie))
        beside[b].append((a, tie))
    for _ in range(times):
        old, before = [list(each) for each in shares], [list(each) for each in sums]
        for n in range(count):
            total = sum(tie for _, tie in beside[n])
            for p in range(images):
                shares[n][p] = 0.5 * old[n][p] + 0.5 * sum(tie * old[m][p] for m, tie in beside[n]) / total
                mean = sum(tie * before[m][p] for m, tie in beside[n]) / total
                sums[n][p] = 0.5 * before[n][p] + 0.5 * mean
    found = np.array([[shares[n][p] * bool(seen[p][n]) for p in range(images)] for n in range(count)])
    totals = found.sum(axis=1, keepdims=True)
    means = np.array(sums) / np.maximum(np.array(shares), 1e-12)[..., None]
    return found / np.where(totals > 0, totals, 1), means
