"""Cells below leaves: the field's refinement there (paper 4.2), and the values of their facings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Float32s, Int64s, Uint8s, Uint32s, in_runs
from octex.channels import alpha_of, decode, encode
from octex.editing.averages import weighted_means
from octex.editing.split import differ, with_split
from octex.field.taps import TapList
from octex.field.walk_taps import refined_taps
from octex.jit import kernel
from octex.parallel import ordered_map
from octex.texture import Channel, OctreeTexture
from octex.tree.layout import FACING_FLAGS, OPPOSITE, SPLIT
from octex.tree.octree import Octree
from octex.tree.split import bits_of, counts_of, find_rows

#: Number of cells refined at once.
_BLOCK = 1 << 14
#: Weight of a transparent tap, relative to an opaque one.
_FAINT = np.float32(1e-6)
#: Weight of a hidden tap, relative to a visible one: it counts only where no other does.
_AWAY = np.float32(1e-6)
_NO_TAPS = TapList(np.zeros(1, np.int64), np.empty(0, np.uint32), np.empty(0, np.float32))


class Below(NamedTuple):
    """Decoded values, by channel, of cells of one level below leaves."""

    values: dict[str, Float32s]  # (n, components)
    is_split: Bools  # (n,)   whether a facing's value differs
    rows: dict[str, Float32s]  # (rows, components)   of the split cells


def refined_below(
    texture: OctreeTexture, codes: Int64s, level: int, facings: Uint8s, executor: Executor
) -> Below:
    """Refine a texture to cells (n,) of a level below its leaves, from their codes and facings."""
    blocks = [slice(begin, begin + _BLOCK) for begin in range(0, codes.size, _BLOCK)] or [slice(0)]
    tasks = [(codes[block], facings[block]) for block in blocks]
    refine = partial(_refined_below, texture, level)
    values, is_split, rows = zip(*ordered_map(executor, refine, tasks), strict=True)
    return Below(_joined(values), np.concatenate(is_split), _joined(rows))


def _joined(parts: Sequence[Mapping[str, Float32s]]) -> dict[str, Float32s]:
    return {name: np.concatenate([each[name] for each in parts]) for name in parts[0]}


def _refined_below(texture: OctreeTexture, level: int, task: tuple[Int64s, Uint8s]) -> Below:
    codes, facings = task
    tree, channels = texture.tree, texture.channels
    taps = refined_taps(tree, codes, level)
    cell_values = _blended(channels, taps)
    may_differ = np.zeros(codes.size, np.bool_)
    _see_apart(taps, tree.arrays.flags, tree.kept.cells, facings, may_differ)
    split_candidates = np.flatnonzero(may_differ)
    facings = facings[split_candidates]
    owners, bits = np.repeat(split_candidates, counts_of(facings)), bits_of(facings)
    rows = _blended(channels, *_facing(tree, taps, owners, bits))
    is_split = np.zeros(codes.size, np.bool_)
    for name, values in rows.items():
        form = channels[name].format
        stored = (encode(part, form.dtype, form.space) for part in (values, cell_values[name][owners]))
        is_split[owners[differ(form, *stored)]] = True
    return Below(cell_values, is_split, {name: values[is_split[owners]] for name, values in rows.items()})


def with_rows(texture: OctreeTexture, parts: Sequence[tuple[Int64s, Below]]) -> OctreeTexture:
    """Return a texture with cells (n,), ascending over all parts, split as their refinement is."""
    cells = np.concatenate([np.empty(0, np.int64), *(each[below.is_split] for each, below in parts)])
    if not cells.size:
        return texture
    rows = {}
    for name, values in _joined([below.rows for _, below in parts]).items():
        form = texture.channels[name].format
        rows[name] = encode(values, form.dtype, form.space)
    return with_split(texture, cells, texture.tree.arrays.flags[cells] & np.uint8(FACING_FLAGS), rows)


def refined_values(
    tree: Octree, channels: Mapping[str, Channel], codes: Int64s, level: int
) -> dict[str, Float32s]:
    """Return refined channels in cells of a level below leaves, decoded; alpha weights the others."""
    return _blended(channels, refined_taps(tree, codes, level))


def refined_rows(texture: OctreeTexture, codes: Int64s, level: int, bits: Uint8s) -> dict[str, Float32s]:
    """Return the decoded refinement for facings (n,) of cells (n,) of a level below leaves.

    Taps that face only the opposite way are hidden. Taps that face sideways are not: a normal between two
    facings sees both.
    """
    blocks = [_blended(texture.channels, _NO_TAPS)]
    for begin in range(0, codes.size, _BLOCK):
        block = slice(begin, begin + _BLOCK)
        distinct_codes, owners = np.unique(codes[block], return_inverse=True)
        taps = refined_taps(texture.tree, distinct_codes, level)
        blocks.append(_blended(texture.channels, *_facing(texture.tree, taps, owners, bits[block])))
    return _joined(blocks)


def _facing(tree: Octree, taps: TapList, owners: Int64s, bits: Uint8s) -> tuple[TapList, Bools, Int64s]:
    """Return the taps of cells' facings, which of them have rows in the split table, and these rows."""
    counts = np.diff(taps.starts)[owners]
    starts = np.cumsum(np.concatenate([[0], counts]))
    tap_numbers = in_runs(taps.starts[owners], counts)
    rows, weights, bits = taps.rows[tap_numbers], taps.weights[tap_numbers], np.repeat(bits, counts)
    cells = rows.astype(np.int64)
    is_kept = cells >= tree.n_cells
    cells[is_kept] = tree.kept.cells[cells[is_kept] - tree.n_cells]
    facings = tree.arrays.flags[cells] & np.uint8(FACING_FLAGS)
    weights[(facings & bits == 0) & (facings & OPPOSITE[bits] != 0)] *= _AWAY
    return TapList(starts, rows, weights), *find_rows(tree.split, cells, bits)


def _blended(
    channels: Mapping[str, Channel], taps: TapList, has_row: Bools | None = None, rows: Int64s | None = None
) -> dict[str, Float32s]:
    """Blend channels, decoded; taps in ``has_row`` use ``rows`` of the split table."""

    def values_of(channel: Channel) -> Array:
        stored = channel.rows(taps.rows)
        if has_row is not None:
            stored[has_row] = channel.split_values[rows]
        return stored

    blended = {}
    weights: dict[str | None, Float32s] = {}
    for name, channel in channels.items():
        alpha = alpha_of(name)
        if alpha not in channels:
            alpha = None
        if alpha not in weights:
            weights[alpha] = taps.weights
            if alpha is not None:
                coverage = decode(values_of(channels[alpha]), channels[alpha].format.space)[:, 0]
                weights[alpha] = taps.weights * np.maximum(coverage, _FAINT)
        blended[name] = weighted_means(taps.starts, weights[alpha], values_of(channel), channel.format.space)
    return blended


@kernel
def _see_apart(taps: TapList, flags: Uint8s, kept_cells: Uint32s, facings: Uint8s, may_differ: Bools) -> None:
    """Mark cells (n,) whose facings may differ in value: a tap is split, or hidden from a facing."""
    for n in range(facings.size):
        if facings[n] == 0:
            continue
        for tap in range(taps.starts[n], taps.starts[n + 1]):
            row = np.int64(taps.rows[tap])
            if row >= flags.size:
                row = np.int64(kept_cells[min(row - flags.size, np.int64(kept_cells.size) - 1)])
            flag = flags[min(row, np.int64(flags.size) - 1)]
            if flag & SPLIT or facings[n] & ~flag & OPPOSITE[flag & FACING_FLAGS]:
                may_differ[n] = True
                break
