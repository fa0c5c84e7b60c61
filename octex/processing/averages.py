"""Averages of channels of integers whose codes all change alike: means and residuals in one pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import ColorSpace, decode_table, encode
from octex.editing.averages import AREAS, Change, coverage, node_cells
from octex.jit import kernel, popcount
from octex.texture import Channel
from octex.tree.octree import Octree

Array = npt.NDArray[np.generic]
Int64s = npt.NDArray[np.int64]
Float32s = npt.NDArray[np.float32]
Float64s = npt.NDArray[np.float64]


class Tables(NamedTuple):
    """A function of each component of a channel of integers: what becomes of their codes' values."""

    decoded: Float32s  # (codes,)   the value of each code, ascending
    mapped: Float32s  # (components, codes)   what it becomes
    bins: Int64s  # (_BINS + 1,)   the last code up to each of as many steps from the first value to the last


_BINS = 4096


def tables_of(mapped: Float32s, dtype: str, space: ColorSpace) -> Tables:
    """Return the tables of a channel whose codes become ``mapped`` (components, codes), decoded."""
    values = decode_table(dtype, space)
    steps = np.linspace(float(values[0]), float(values[-1]), _BINS + 1)
    return Tables(values, mapped, np.searchsorted(values, steps.astype(np.float32), side="right") - 1)


def average_by_tables(
    tree: Octree, before: Channel, after: Channel, alpha: Array | None, tables: Tables
) -> None:
    """Do with ``after`` what ``residuals`` and ``average`` do, at once; in place.

    Alpha stays as it is. Between its codes a function is taken to be straight.
    """
    form, nodes = before.format, node_cells(tree)
    weights = np.empty(0, np.float32) if alpha is None else coverage(alpha)
    for level in range(tree.max_depth - 1, -1, -1):
        first, end = tree.arrays.level_nodes[level : level + 2].tolist()
        below = slice(*tree.arrays.level_cells[level + 1 : level + 3].tolist())
        here = nodes[first:end]
        found = np.zeros((end - first, form.components))
        _mapped_means(
            *(tree.arrays.groups, first, tree.arrays.areas[below], AREAS, weights[below]),
            *(before.values[below], after.values[below], before.values[here], tables, found),
        )
        after.values[here] = encode(found, form.dtype, form.space)


def changed_by(tables: Tables) -> Change:
    """Return what tables do to residuals."""

    def changed(_cells: Int64s, values: Float64s, means: Float64s) -> Float64s:
        columns = [
            np.interp(values[:, k], tables.decoded, mapped) - np.interp(means[:, k], tables.decoded, mapped)
            for k, mapped in enumerate(tables.mapped)
        ]
        return np.stack(columns, axis=1)

    return changed


@kernel
def _mapped_means(
    groups: npt.NDArray[np.uint64],
    first: int,
    areas: npt.NDArray[np.uint8],
    shares: Float64s,
    weights: Float32s,
    before: npt.NDArray[np.uint8 | np.uint16],
    after: npt.NDArray[np.uint8 | np.uint16],
    nodes: npt.NDArray[np.uint8 | np.uint16],
    tables: Tables,
    found: Float64s,
) -> None:
    """Write the means of children as they are after, and what of residuals is mapped."""
    values, last = tables.decoded, tables.decoded.size - 1
    sums = np.zeros((2, found.shape[1]))
    low, scale = np.float64(values[0]), _BINS / (np.float64(values[last]) - np.float64(values[0]))
    begin = 0
    for n in range(found.shape[0]):
        node = first + n
        children = (groups[node >> 3, 0] | groups[node >> 3, 1]) >> np.uint64(8 * (node & 7))
        end = min(begin + popcount(children & np.uint64(0xFF)), areas.size)
        total = 0.0
        sums[:] = 0.0
        for child in range(begin, end):
            share = shares[areas[child]]
            if weights.size > 0:
                share *= np.float64(weights[child])
            total += share
            for k in range(found.shape[1]):
                sums[0, k] += share * np.float64(values[before[child, k]])
                sums[1, k] += share * np.float64(values[after[child, k]])
        begin = end
        for k in range(found.shape[1] if total > 0.0 else 0):
            mean, mapped = sums[0, k] / total, sums[1, k] / total
            step = min(max(int((mean - low) * scale), 0), _BINS - 1)
            at, beyond = tables.bins[step], tables.bins[step + 1]
            while at < beyond:  # the last code whose value is not above the mean
                middle = (at + beyond + 1) >> 1
                if np.float64(values[middle]) <= mean:
                    at = middle
                else:
                    beyond = middle - 1
            at = min(max(at, 0), last - 1)
            code = int(nodes[n, k])
            part = (mean - values[at]) / (np.float64(values[at + 1]) - np.float64(values[at]))
            if abs(at + part - code) > 0.5:
                one, other = np.float64(tables.mapped[k, at]), np.float64(tables.mapped[k, at + 1])
                mapped += np.float64(tables.mapped[k, code]) - (one + part * (other - one))
            found[n, k] = mapped
