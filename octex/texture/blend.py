"""From rows to values: decoded, blended under the weights of taps, and made unit vectors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.channels import ColorSpace, decode, decode_table
from octex.field.blend import Codes
from octex.field.facings import all_in_sight, spreads_of
from octex.field.field import Field, NotFiniteError, Taps
from octex.field.filtered import NO_AREAS, Query, filtered_colors, filtered_taps
from octex.jit import decoded, kernel
from octex.texture.channel import Channel
from octex.tree.octree import Octree
from octex.tree.placement import Placement

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]
Rows = npt.NDArray[np.uint32 | np.int64]

NO_GRADIENTS = np.empty((0, 4, 3), np.float32)
NO_TABLE = np.empty(0, np.float32)


def look_up(
    field: Field,
    placement: Placement,
    points: Array,
    query: Query,
    channels: Sequence[Channel],
    alpha: Channel | None,
    answers: Sequence[Floats],
    gradients: Sequence[Floats],
) -> int:
    """Write the field of channels at rest positions (n, 3) to ``answers`` (n, components), decoded.

    ``gradients`` (n, components, 3) or none. Channels other than ``alpha``, if there is one, weigh by it,
    except where it is zero throughout. Returns the first row of points that is not finite, or −1.
    """
    if not query.is_plain:  # what is looked up then are the footprints' own points
        is_finite = np.isfinite(points)
        if not is_finite.all():
            return int(np.argmin(is_finite)) // 3
    try:
        missed = None
        is_one_cell = query.is_plain and query.filter == "nearest"  # which alpha does not weigh
        if len(channels) == 1 and not gradients and (alpha is None or is_one_cell):
            missed = _look_up_colors(field, placement, points, query, channels[0], answers[0])
        if missed is None:
            _look_up(field, placement, points, query, channels, alpha, answers, gradients)
        elif missed.size:
            found = np.empty((missed.size, channels[0].format.components), np.float32)
            _look_up(field, placement, points[missed], query.of(missed), channels, alpha, [found], gradients)
            answers[0][missed] = found
    except NotFiniteError as error:
        return error.row
    return -1


def _look_up_colors(
    field: Field, placement: Placement, points: Array, query: Query, channel: Channel, answers: Floats
) -> npt.NDArray[np.int64] | None:
    """Take the shortest way, if there is one: see `Field.colors`."""
    if channel.format.components != 3 or _is_encoded(channel):
        return None
    values, _, split_values, table = _codes(channel)
    codes = Codes(values, split_values, table)
    if query.is_plain:
        return field.colors(
            points, placement, query.filter, all_in_sight(), codes, NO_AREAS, answers, NO_TABLE, NO_TABLE
        )
    return filtered_colors(field, points, placement, query, codes, answers)


def _look_up(
    field: Field,
    placement: Placement,
    points: Array,
    query: Query,
    channels: Sequence[Channel],
    alpha: Channel | None,
    answers: Sequence[Floats],
    gradients: Sequence[Floats],
) -> None:
    if query.is_plain:
        batches = field.batches(points, placement, query.filter, gradient=bool(gradients))
    else:
        batches = filtered_taps(field, points, placement, query, gradient=bool(gradients))
    begin = 0
    for taps in batches:
        here = slice(begin, begin + taps.starts.size - 1)
        covered = taps if alpha is None else _covered(taps, alpha)
        for number, channel in enumerate(channels):
            values = np.empty((taps.rows.size, channel.format.components), np.float32)
            gather(channel, taps.rows, values)
            used = taps if channel is alpha else covered
            _blend(
                *(used.starts, used.weights, used.slopes, values, answers[number][here]),
                gradients[number][here] if gradients else NO_GRADIENTS,
            )
        begin = here.stop


def _covered(taps: Taps, alpha: Channel) -> Taps:
    """Return taps weighted by their alpha, too."""
    coverage = np.empty((taps.rows.size, 1), np.float32)
    gather(alpha, taps.rows, coverage)
    taps = taps._replace(weights=taps.weights.copy(), slopes=taps.slopes.copy())
    _cover(taps.starts, coverage, taps.weights, taps.slopes)
    return taps


def gather(channel: Channel, rows: Rows, result: Floats) -> None:
    """Write the decoded values of rows, cells', then kept nodes' and then facings', to ``result``."""
    _gather(*_codes(channel), rows, result)
    if _is_encoded(channel):
        result[:] = decode(result, channel.format.space)


def facing_spreads(channel: Channel, tree: Octree) -> Floats:
    """Say how far opposite facings differ in split cells of the tree's deepest level, at their first rows."""
    spreads = np.zeros(tree.split.areas.size, np.float32)
    first = int(np.searchsorted(tree.split.cells, tree.arrays.level_cells[tree.max_depth]))
    row = int(np.bitwise_count(tree.split.facings[:first]).sum())
    _, _, split_values, table = _codes(channel)
    if _is_encoded(channel):
        split_values = decode(split_values, channel.format.space)
    spreads_of(table, split_values, tree.split.facings[first:], row, spreads)
    return spreads


def _is_encoded(channel: Channel) -> bool:
    """Say whether the values are float32 numbers that are still to be decoded."""
    return channel.values.dtype == np.float32 and channel.format.space == "srgb"


def _codes(channel: Channel) -> tuple[Array, Array, Array, Floats]:
    """Return values, kept values and split values as codes, and what each stands for; or float32 as it is."""
    arrays = channel.values, channel.kept_values, channel.split_values
    dtype, space = channel.values.dtype, channel.format.space
    if dtype == np.float32:
        return *arrays, NO_TABLE
    if dtype == np.float16:
        values, kept_values, split_values = (array.view(np.uint16) for array in arrays)
        return values, kept_values, split_values, _half_table(space)
    return *arrays, decode_table(dtype.name, space)


@cache
def _half_table(space: ColorSpace) -> Floats:
    """Decode all bit patterns of float16."""
    with np.errstate(invalid="ignore"):  # NaNs are among them
        return decode(np.arange(1 << 16, dtype=np.uint16).view(np.float16), space)


@kernel
def _gather(
    values: npt.NDArray[np.uint8 | np.uint16 | np.float32],
    kept_values: npt.NDArray[np.uint8 | np.uint16 | np.float32],
    split_values: npt.NDArray[np.uint8 | np.uint16 | np.float32],
    table: Floats,
    rows: Rows,
    result: Floats,
) -> None:
    for n in range(rows.size):
        row = np.int64(rows[n])
        kept = row - values.shape[0]
        split = min(kept - kept_values.shape[0], split_values.shape[0] - 1)
        for component in range(values.shape[1]):
            if kept < 0:
                code = values[row, component]
            elif split < 0:
                code = kept_values[kept, component]
            else:
                code = split_values[split, component]
            result[n, component] = decoded(table, code)


@kernel
def _blend(
    starts: npt.NDArray[np.int64],
    weights: Floats,
    slopes: Floats,
    values: Floats,
    answers: Floats,
    gradients: Floats,
) -> None:
    """Write Σ w·v / Σ w, and Σ w′·(v − that): so constants are exact, however the weights are rounded."""
    for n in range(starts.size - 1):
        for component in range(values.shape[1]):
            total = sum_of_weights = 0.0
            for tap in range(starts[n], starts[n + 1]):
                total += np.float64(weights[tap]) * np.float64(values[tap, component])
                sum_of_weights += np.float64(weights[tap])
            answers[n, component] = total / sum_of_weights if sum_of_weights > 0.0 else 0.0
            if gradients.shape[0] > 0:
                x = y = z = 0.0
                for tap in range(starts[n], starts[n + 1]):
                    apart = np.float64(values[tap, component]) - np.float64(answers[n, component])
                    x += np.float64(slopes[tap, 0]) * apart
                    y += np.float64(slopes[tap, 1]) * apart
                    z += np.float64(slopes[tap, 2]) * apart
                gradients[n, component, 0], gradients[n, component, 1] = x, y
                gradients[n, component, 2] = z


@kernel
def _cover(starts: npt.NDArray[np.int64], alpha: Floats, weights: Floats, slopes: Floats) -> None:
    """Multiply the weights of each point by alpha and divide by their sum, unless that is zero."""
    for n in range(starts.size - 1):
        total = 0.0
        for tap in range(starts[n], starts[n + 1]):
            total += np.float64(weights[tap]) * np.float64(alpha[tap, 0])
        if not total > 0.0:
            continue
        for axis in range(3 if slopes.shape[0] > 0 else 0):
            slope = 0.0
            for tap in range(starts[n], starts[n + 1]):
                slope += np.float64(slopes[tap, axis]) * np.float64(alpha[tap, 0])
            slope /= total
            for tap in range(starts[n], starts[n + 1]):
                own = np.float64(slopes[tap, axis]) - np.float64(weights[tap]) * slope
                slopes[tap, axis] = own * np.float64(alpha[tap, 0]) / total
        for tap in range(starts[n], starts[n + 1]):
            weights[tap] = np.float64(weights[tap]) * np.float64(alpha[tap, 0]) / total


@kernel
def make_unit(vectors: Floats, gradients: Floats) -> None:
    """Make vectors (n, components) of length 1, in place; zeros stay.

    ``gradients`` (n or 0, components, 3) become those of the unit vectors: what of them is across the vector,
    divided by its length; zeros where it has none.
    """
    components = vectors.shape[1]
    for n in range(vectors.shape[0]):
        square = 0.0
        for component in range(components):
            square += np.float64(vectors[n, component]) ** 2
        inverse = 1.0 / np.sqrt(square) if square > 0.0 else 0.0
        if square > 0.0:
            for component in range(components):
                vectors[n, component] *= inverse
        for axis in range(3 if gradients.shape[0] > 0 else 0):
            along = 0.0
            for component in range(components):
                along += np.float64(vectors[n, component]) * np.float64(gradients[n, component, axis])
            for component in range(components):
                across = np.float64(gradients[n, component, axis]) - along * np.float64(vectors[n, component])
                gradients[n, component, axis] = across * inverse
