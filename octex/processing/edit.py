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
    """Maps the values of one channel."""

    def stored(self, values: Array, cells: Int64s | None) -> Array:
        """Map stored values (n, components) of ``cells``, or of all cells for None."""

    def changed(self, cells: Int64s, values: Float64s, means: Float64s) -> Float64s:
        """Return new residuals; see ``averages.ResidualsOf``."""


def noted(metadata: Mapping[str, str], operation: str, **how: object) -> dict[str, str]:
    """Return metadata with one more operation."""
    return with_listed(metadata, "processed", [{"operation": operation, **how}])


def with_listed(metadata: Mapping[str, str], name: str, entries: Sequence[object]) -> dict[str, str]:
    """Return metadata with more entries in a JSON list; a value of another kind becomes its first entry."""
    try:
        before = json.loads(metadata.get(name, "[]"))
    except ValueError:
        before = metadata[name]
    listed = before if isinstance(before, list) else [before]
    return {**metadata, name: json.dumps([*listed, *entries])}


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
        chosen = np.asarray(cells, np.int64)
        levels = np.searchsorted(self._tree.arrays.level_cells, chosen, side="right") - 1
        places = (decode_cells(self.codes[chosen]) + 0.5) * np.ldexp(1.0, -levels)[:, None]
        return self._placement.to_rest(places)


def edited(
    texture: OctreeTexture,
    names: Sequence[str],
    edit_of: Callable[[Channel], Edit],
    operation: str,
    **how: object,
) -> OctreeTexture:
    """Return a texture with some channels edited: the values of cells, split rows and kept nodes."""
    tree = texture.tree
    owners, kept = rows_of(tree.split).cells, tree.kept.cells.astype(np.int64)
    made: dict[str, Channel] = {}
    change: dict[str, ResidualsOf] = {}
    for name in names:
        before = texture.channels[name]
        edit = edit_of(before)
        made[name] = before._replace(
            values=edit.stored(before.values, None),
            split_values=edit.stored(before.split_values, owners),
            kept_values=edit.stored(before.kept_values, kept),
        )
        change[name] = edit.changed
    return with_values(texture, made, change, noted(texture.metadata, operation, channels=list(made), **how))


def with_values(
    texture: OctreeTexture,
    made: Mapping[str, Channel],
    change: Mapping[str, ResidualsOf],
    metadata: Mapping[str, str],
) -> OctreeTexture:
    """Return a texture with other values in some of its channels, and matching averages.

    It writes to ``made``: averages of nodes and of split nodes' rows, plus residuals by the ``change`` of
    each channel. If alpha changes, all channels are averaged with the new alpha, and residuals shrink where
    the new alpha is larger.
    """
    alpha_changes = ALPHA.name in made and not all(
        map(np.array_equal, made[ALPHA.name][1:], texture.channels[ALPHA.name][1:])
    )
    others = {
        name: channel._replace(values=channel.values.copy(), split_values=channel.split_values.copy())
        for name, channel in texture.channels.items()
        if alpha_changes and name not in made
    }
    made = {**made, **others}
    after = texture.with_cells(texture.tree, {**texture.channels, **made}, metadata)
    for name in sorted(made, key=lambda name: name != ALPHA.name):
        of_channel = change.get(name, as_they_are)
        if alpha_changes and name != ALPHA.name:
            of_channel = _covered(of_channel, texture.channels[ALPHA.name].values, made[ALPHA.name].values)
        average(after, made[name], residuals(texture, name, change=of_channel))
    return after


def _covered(change: ResidualsOf, was: Array, alpha: Array) -> ResidualsOf:
    """Return a change that scales residuals by the ratio of old to new opacity, at most 1."""
    parts = np.minimum((coverage(was) + _FAINT) / (coverage(alpha) + _FAINT), 1)
    return lambda cells, values, means: change(cells, values, means) * parts[cells, None]
