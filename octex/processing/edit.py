"""Replaces the values of a texture, recomputes its averages, and records the operation."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Protocol

import numpy as np

from octex.arrays import Array, Float64s, Int64s
from octex.channels import ALPHA
from octex.checks import as_names
from octex.editing.averages import ResidualsOf, as_they_are, average, coverage, residuals
from octex.texture import Channel, OctreeTexture, as_texture
from octex.tree.morton import decode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from octex.tree.split import rows_of

#: Alphas that differ by less count as equal: half an 8-bit code.
_FAINT = np.float32(0.5 / 255)


class Edit(Protocol):
    """A change of one channel's values."""

    def stored(self, values: Array, cells: Int64s | None) -> Array:
        """Map stored values (n, components) of ``cells``, or of all cells for None."""

    def changed(self, cells: Int64s, values: Float64s, means: Float64s) -> Float64s:
        """Return new residuals; see ``averages.ResidualsOf``."""


def with_operation(metadata: Mapping[str, str], operation: str, **how: object) -> dict[str, str]:
    """Return metadata with one more operation."""
    return with_listed(metadata, "processed", [{"operation": operation, **how}])


def with_listed(metadata: Mapping[str, str], name: str, entries: Sequence[object]) -> dict[str, str]:
    """Return metadata with more entries in a JSON list; a value of another kind becomes its first entry."""
    try:
        value = json.loads(metadata.get(name, "[]"))
    except ValueError:
        value = metadata[name]
    earlier = value if isinstance(value, list) else [value]
    return {**metadata, name: json.dumps([*earlier, *entries])}


def names_of(texture: OctreeTexture, channel: str | Sequence[str] | None) -> list[str]:
    """Return channel names, all for None. Raises ArgumentError, also for an argument that is no texture."""
    as_texture(texture)
    names = texture.channels if channel is None else as_names(channel, "channel", texture.channels)
    return list(dict.fromkeys(names))


class Centres:
    """The centres of a tree's cells, in rest positions."""

    def __init__(self, tree: Octree, placement: Placement) -> None:
        self._tree, self._placement = tree, placement

    @cached_property
    def codes(self) -> Int64s:
        """The Morton codes of all cells (cells,)."""
        return np.concatenate([codes for codes, _ in self._tree.walk()])

    def __getitem__(self, cells: Int64s | range) -> Float64s:
        numbers = np.asarray(cells, np.int64)
        levels = np.searchsorted(self._tree.arrays.level_cells, numbers, side="right") - 1
        positions = (decode_cells(self.codes[numbers]) + 0.5) * np.ldexp(1.0, -levels)[:, None]
        return self._placement.to_rest(positions)


def edited(
    texture: OctreeTexture,
    names: Sequence[str],
    edit_of: Callable[[Channel], Edit],
    operation: str,
    **how: object,
) -> OctreeTexture:
    """Return a texture with some channels edited: the values of cells, split rows and kept nodes."""
    tree = texture.tree
    cells = None, rows_of(tree.split).cells, tree.kept.cells.astype(np.int64)
    channels: dict[str, Channel] = {}
    changes: dict[str, ResidualsOf] = {}
    for name in names:
        form, *arrays = texture.channels[name]
        edit = edit_of(texture.channels[name])
        channels[name] = Channel(form, *map(edit.stored, arrays, cells))
        changes[name] = edit.changed
    metadata = with_operation(texture.metadata, operation, channels=list(channels), **how)
    return with_values(texture, channels, changes, metadata)


def with_values(
    texture: OctreeTexture,
    channels: Mapping[str, Channel],
    changes: Mapping[str, ResidualsOf],
    metadata: Mapping[str, str],
) -> OctreeTexture:
    """Return a texture with other values in some of its ``channels``, and matching averages.

    It writes to ``channels``: averages of nodes and of split nodes' rows, plus residuals by the ``changes``
    of each channel. If alpha changes, all channels are averaged with the new alpha, and residuals shrink
    where the new alpha is larger.
    """
    alpha_changes = ALPHA.name in channels and not all(
        map(np.array_equal, channels[ALPHA.name][1:], texture.channels[ALPHA.name][1:])
    )
    copies = {
        name: channel._replace(values=channel.values.copy(), split_values=channel.split_values.copy())
        for name, channel in texture.channels.items()
        if alpha_changes and name not in channels
    }
    channels = {**channels, **copies}
    edited = texture.with_cells(texture.tree, {**texture.channels, **channels}, metadata)
    for name in sorted(channels, key=lambda name: name != ALPHA.name):
        change = changes.get(name, as_they_are)
        if alpha_changes and name != ALPHA.name:
            change = _covered(change, texture.channels[ALPHA.name].values, channels[ALPHA.name].values)
        average(edited, channels[name], residuals(texture, name, change=change))
    return edited


def _covered(change: ResidualsOf, old_alpha: Array, alpha: Array) -> ResidualsOf:
    """Return a change that scales residuals by the ratio of old to new opacity, at most 1."""
    ratios = np.minimum((coverage(old_alpha) + _FAINT) / (coverage(alpha) + _FAINT), 1)
    return lambda cells, values, means: change(cells, values, means) * ratios[cells, None]
