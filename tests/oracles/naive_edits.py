"""What averages must be after an edit, the slow way: node by node, by places."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import bit_counts
from octex.channels import ChannelFormat, decode, encode
from octex.editing.refined import refined_values
from octex.texture import OctreeTexture
from tests.oracles.naive_processing import AREAS, Cell, Place, cells_of, children_of, mean_below

Floats = npt.NDArray[np.floating[Any]]


class Bounds(NamedTuple):
    """Between what the values of cells, and their rows, must lie; decoded. Those of leaves are their own."""

    low: Floats  # (cells, components)
    high: Floats
    row_low: Floats  # (split rows, components)   −∞ and ∞ where nothing is said
    row_high: Floats


def expected_averages(
    before: OctreeTexture, after: OctreeTexture, layers: Sequence[OctreeTexture] = ()
) -> dict[str, Bounds]:
    """Return bounds of what the averages of ``after`` must be, given its leaves, one edit after ``before``.

    A node's value is the mean of its children's as they are stored after the edit, by area and alpha (alpha's
    own by area alone), and some part, 0 … 1, of the residual that it had: what its value before differed by
    from the mean of its children's before, by their areas and alpha then. A cell that was a leaf, or lay
    below one, had the residual of what the field refines to below. ``layers`` are those that were merged in
    the edit: where they are fitted, their residuals may be there too. The same holds for the rows of split
    cells, by facing; rows below what was a leaf, and those that no child shows, are not bounded.

    It holds for paint, fill, merge (one layer), crop and cast, and for all other edits of textures that are
    not fitted (``convert(…, fit=False)``, processed or not), if they are given as ``before`` too. Bounds are
    exact but for rounding: what is stored may differ by a code (integers), or its last bits (floats); see
    ``assert_averages``.
    """
    then, now = cells_of(before), cells_of(after)
    was = _as_it_was(before, then, now)
    sheets = [(layer, cells_of(layer)) for layer in layers]
    found = {}
    for name, channel in after.channels.items():
        form = channel.format
        values = decode(channel.values, form.space).astype(np.float64)
        rows = decode(channel.split_values, form.space).astype(np.float64)
        bounds = Bounds(values.copy(), values.copy(), np.full_like(rows, -np.inf), np.full_like(rows, np.inf))
        for place, cell in now.items():
            below = [now[each].number for each in children_of(now, place)]
            if not below:
                continue
            mean = mean_below(after, name, now, place)
            residual = _residual(before, name, place, then, now, after, was)
            own = [residual, *(_of_node(*sheet, name, place) for sheet in sheets if name != "alpha")]
            bounds.low[cell.number], bounds.high[cell.number] = _around(mean, own)
            if place not in then or then[place].is_leaf:
                continue
            for facing in (1 << bit for bit in range(6)):
                row, shown = _row(after, cell.number, facing), _facing(after, name, below, facing)
                if row is None or shown is None:
                    continue
                of_row = _of_row(before, then, name, place, facing)
                of_rows = [residual if of_row is None else of_row, *own[1:]]
                for sheet in sheets:
                    own_row = _of_row(*sheet, name, place, facing)
                    of_rows += [] if own_row is None or name == "alpha" else [own_row]
                bounds.row_low[row], bounds.row_high[row] = _around(_mean(*shown), of_rows)
        found[name] = bounds
    return found


def assert_averages(
    before: OctreeTexture, after: OctreeTexture, layers: Sequence[OctreeTexture] = ()
) -> None:
    """Assert that all averages are as ``expected_averages`` says."""
    for name, bounds in expected_averages(before, after, layers).items():
        channel = after.channels[name]
        _assert_between(channel.format, channel.values, bounds.low, bounds.high, f"{name}: cells")
        _assert_between(
            channel.format, channel.split_values, bounds.row_low, bounds.row_high, f"{name}: rows"
        )


def _assert_between(form: ChannelFormat, stored: Any, low: Floats, high: Floats, what: str) -> None:
    if form.dtype.startswith("uint"):
        codes = stored.astype(np.int64)
        ends = [
            encode(np.clip(end, -1, 1), form.dtype, form.space).astype(np.int64) + step
            for end, step in ((low, -1), (high, 1))
        ]
        ends[0][np.isneginf(low)], ends[1][np.isposinf(high)] = -1, 1 << 17
        outside = np.maximum(ends[0] - codes, codes - ends[1])
    else:
        step = 1e-5 if form.dtype == "float32" else 2e-3
        values = decode(stored, form.space)
        outside = np.maximum(low - values, values - high) - step * np.maximum(1, np.abs(values))
    if outside.size:
        at = np.unravel_index(np.argmax(outside), outside.shape)
        assert outside[at] <= 0, (
            f"{what} {at}: {stored[at]} by {outside[at]} outside of {low[at]}, {high[at]}"
        )


def _mean(values: Floats, shares: Floats) -> Floats:
    return np.asarray((values * shares[:, None]).sum(axis=0) / shares.sum())


def _rounded(form: ChannelFormat, value: Floats) -> Any:
    return encode(np.asarray(value, np.float64), form.dtype, form.space)


def _less(form: ChannelFormat, stored: Any, mean: Floats) -> Floats:
    """A residual: nothing if it is no more than rounding."""
    if (_rounded(form, mean) == stored).all():
        return np.zeros_like(mean)
    return np.asarray(decode(stored, form.space) - mean)


def _as_it_was(
    before: OctreeTexture, then: dict[Place, Cell], now: dict[Place, Cell]
) -> dict[Place, dict[str, Any]]:
    """What was stored in places that were leaves, and what the field refined to below them."""
    found: dict[Place, dict[str, Any]] = {}
    below: dict[int, list[int]] = {}
    for level, code in now:
        own = level, code
        if own in then:
            number = then[own].number
            found[own] = {name: channel.values[number] for name, channel in before.channels.items()}
            continue
        while own not in then:
            own = own[0] - 1, own[1] >> 3
        if then[own].is_leaf:
            below.setdefault(level, []).append(code)
    for level, codes in below.items():
        values = refined_values(before.tree, before.channels, np.array(sorted(codes), np.int64), level)
        for row, code in enumerate(sorted(codes)):
            found[level, code] = {
                name: _rounded(before.channels[name].format, own[row]) for name, own in values.items()
            }
    return found


def _residual(
    before: OctreeTexture,
    name: str,
    place: Place,
    then: dict[Place, Cell],
    now: dict[Place, Cell],
    after: OctreeTexture,
    was: dict[Place, dict[str, Any]],
) -> Floats:
    """What a node's value differed by from the mean of what was below it."""
    components = after.channels[name].format.components
    if name not in before.channels or place not in was:
        return np.zeros(components)
    form = before.channels[name].format
    weighs = name != "alpha" and "alpha" in before.channels
    if place in then and not then[place].is_leaf:
        return _of_node(before, then, name, place)
    places = children_of(now, place)
    shares = AREAS[after.tree.arrays.areas[[now[each].number for each in places]]]
    if weighs:
        space = before.channels["alpha"].format.space
        alphas = np.array([decode(np.asarray(was[each]["alpha"]), space)[0] for each in places])
        shares = shares * np.maximum(alphas, 2.0**-40)
    values = np.array([decode(np.asarray(was[each][name]), form.space) for each in places], np.float64)
    return _less(form, was[place][name], _mean(values, shares))


def _around(mean: Floats, residuals: Sequence[Floats]) -> tuple[Floats, Floats]:
    """The least and the most that some parts of residuals make of a mean."""
    parts = [np.zeros_like(mean), *(np.broadcast_to(each, mean.shape) for each in residuals)]
    return mean + np.min(parts, axis=0), mean + np.max(parts, axis=0)


def _of_node(texture: OctreeTexture, cells: dict[Place, Cell], name: str, place: Place) -> Floats:
    """The residual of a node; nothing where there is none."""
    if name not in texture.channels or place not in cells or not children_of(cells, place):
        return np.zeros(texture.channels[name].format.components if name in texture.channels else 1)
    channel = texture.channels[name]
    mean = mean_below(texture, name, cells, place)
    return _less(channel.format, channel.values[cells[place].number], mean)


def _of_row(
    texture: OctreeTexture, cells: dict[Place, Cell], name: str, place: Place, facing: int
) -> Floats | None:
    """The residual of a node's row; None where it has none."""
    row = _row(texture, cells[place].number, facing) if place in cells else None
    if row is None or name not in texture.channels:
        return None
    channel = texture.channels[name]
    below = [cells[each].number for each in children_of(cells, place)]
    shown = _facing(texture, name, below, facing)
    if shown is None:
        return np.zeros(channel.format.components)
    return _less(channel.format, channel.split_values[row], _mean(*shown))


def _facing(
    texture: OctreeTexture, name: str, cells: Sequence[int], facing: int
) -> tuple[Floats, Floats] | None:
    """The values that cells show one way, and their shares; None if none does."""
    split = texture.tree.split
    values, shares = [], []
    for cell in cells:
        flags = int(texture.tree.arrays.flags[cell]) & 0b111111
        if not flags & facing:
            continue
        row = _row(texture, cell, facing)
        arrays = {key: own.values[cell] for key, own in texture.channels.items()}
        area = AREAS[texture.tree.arrays.areas[cell]] / flags.bit_count()
        if row is not None:
            arrays = {key: own.split_values[row] for key, own in texture.channels.items()}
            area = AREAS[split.areas[row]]
        if name != "alpha" and "alpha" in arrays:
            area *= max(float(decode(np.asarray(arrays["alpha"]), "data")[0]), 2.0**-40)
        values.append(decode(np.asarray(arrays[name]), texture.channels[name].format.space))
        shares.append(area)
    return (np.array(values, np.float64), np.array(shares)) if values else None


def _row(texture: OctreeTexture, cell: int, facing: int) -> int | None:
    """The row of a split cell for a facing."""
    split = texture.tree.split
    at = int(np.searchsorted(split.cells, cell))
    if at == split.cells.size or split.cells[at] != cell or not split.facings[at] & facing:
        return None
    first = int(bit_counts(split.facings[:at]).sum())
    return first + (int(split.facings[at]) & (facing - 1)).bit_count()
