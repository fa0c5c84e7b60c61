"""The taps of rest positions in a field, listed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Floats, Int64s, Uint32s
from octex.field.blend import joined, listed
from octex.field.field import Field, Finder
from octex.field.taps import TapList, Taps
from octex.tree.placement import Placement


class ListedTaps(NamedTuple):
    """The taps of points, one point after another: see `octex.field.taps.TapList`."""

    starts: Int64s
    rows: Uint32s | Int64s
    weights: Float32s
    slopes: Floats  # (taps, 3)   derivatives of the weights by rest position; (0, 3) if they are not wanted
    covers: Float32s  # (points,)   how much of the spline's weight falls on leaves; 0 off the surface


def spread(starts: Int64s, rows: Uint32s | Int64s, column: Floats | Float32s, n_rows: int) -> Floats:
    """Return a column of taps by point and row (points, rows); a row may have several taps."""
    found = np.zeros((starts.size - 1, n_rows))
    np.add.at(found, (np.repeat(np.arange(starts.size - 1), np.diff(starts)), rows), column)
    return found


def taps_of(
    field: Field, points: Floats, placement: Placement, filter: str = "quadratic", *, gradient: bool = False
) -> ListedTaps:
    finder, lists = Finder(field, placement, filter, gradient=gradient), []
    slopes, covers = [np.empty((0, 3))], [np.empty(0, np.float32)]
    for _, taps in finder.blocks(points, field.weighing(field, False)):
        lists.append(_all_of(taps) if gradient else listed(taps))
        slopes += _slopes_of(taps, placement.size) if gradient else []
        covers.append(taps.covers.copy())
    return ListedTaps(*joined(lists), np.concatenate(slopes), np.concatenate(covers))


def _all_of(taps: Taps) -> TapList:
    """List taps, also those that have slopes alone."""
    parts = [slice(*ends) for ends in zip(taps.starts.tolist(), taps.ends.tolist(), strict=True)]
    weights = [taps.weights[part] / taps.weights[part].sum() for part in parts]
    starts = np.cumsum([0, *map(len, weights)])
    return TapList(starts, np.concatenate([taps.rows[part] for part in parts]), np.concatenate(weights))


def _slopes_of(taps: Taps, size: float) -> list[Floats]:
    """Derivatives of weights that sum to 1, by rest position."""
    found = []
    for begin, end in zip(taps.starts.tolist(), taps.ends.tolist(), strict=True):
        weights, slopes = (array[begin:end].astype(np.float64) for array in (taps.weights, taps.slopes))
        drift = weights[:, None] / weights.sum() * slopes.sum(axis=0)
        found.append((slopes - drift) / weights.sum() / size)
    return found
