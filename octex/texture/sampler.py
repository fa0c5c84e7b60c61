"""A texture's channels looked up, a block of points after another."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from octex.arrays import Array, Uint8s
from octex.field.field import Field
from octex.field.listing import list_blends
from octex.field.lookups import ChannelRows, PlainLookup, Query, look_up, plain_lookup
from octex.field.splines import FILTERS
from octex.texture.blend import NO_GRADIENTS, make_unit, mixed_cells, stored
from octex.texture.channel import Channel
from octex.texture.lookup import Given, Lens
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from octex.tree.search import Positions, in_leaves

#: Points that are looked up the short way, and their types.
_FEW = 64
_TAKEN = {np.dtype(np.float32), np.dtype(np.float64)}


class Sampler:
    """Looks channels up, and keeps what the points do not change."""

    def __init__(
        self, tree: Octree, channels: Mapping[str, Channel], placement: Placement, field: Field | None = None
    ) -> None:
        self.channels, self.placement = channels, placement
        self.field = field or Field(tree)
        self._known_mixed: dict[tuple[str, int], tuple[float, Uint8s]] = {}
        self._plain: dict[tuple[str, str], PlainLookup | None] = {}
        self._stored: dict[str, ChannelRows] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return Sampler, (self.field.tree, dict(self.channels), self.placement)

    def plain(self, points: Any, channel: Any, filter: Any) -> PlainLookup | None:
        """Return what looks up few points of the leaves the short way; None where that is not for them.

        A call with one point takes a third of the time so.
        """
        if type(points) is not np.ndarray or points.ndim != 2 or not 0 < len(points) <= _FEW:
            return None
        flags = points.flags
        is_taken = points.dtype in _TAKEN and flags.c_contiguous and flags.aligned
        if not (is_taken and points.shape[1] == 3 and type(channel) is type(filter) is str):
            return None
        key = channel, filter
        if key not in self._plain:
            if channel not in self.channels or filter not in FILTERS:
                return None
            self._plain[key] = None
            if self.channels[channel].format.space != "direction":  # these are made unit vectors
                (read,), alpha = self.read(channel)
                self._plain[key] = plain_lookup(self.field, self.placement, filter, read, alpha)
        return self._plain[key]

    def sampled(
        self, names: list[str], lens: Lens, normalize: bool, given: Given, answers: list[Array]
    ) -> int:
        """Look up a block: what `lookup.in_blocks` takes.

        Its values are written to ``answers``, and then, if they are wanted, as many gradients.
        """
        if not names:
            return -1
        channels = list(map(self.channels.__getitem__, names))
        values, gradients = answers[: len(channels)], answers[len(channels) :]
        read, alpha = self.read(*names)
        task = self.field, self.placement, given["points"]
        fault = -1
        query = self.query(lens, given, names[0])
        if len(channels) == 1 or query.mixed is None:
            fault = look_up(*task, query, read, alpha, values, gradients)
        else:  # each channel mixes facings in cells of its own
            for n, name in enumerate(names):
                query, one = self.query(lens, given, name), slice(n, n + 1)
                fault = look_up(*task, query, read[one], alpha, values[one], gradients[one])
        if fault < 0 and normalize:
            for number, channel in enumerate(channels):
                if channel.format.space == "direction":
                    make_unit(values[number], gradients[number] if gradients else NO_GRADIENTS)
        return fault

    def query(self, lens: Lens, given: Given, name: str) -> Query:
        """Return what is asked of a block of points of a channel."""
        query = lens.query(given)
        if query.footprints is not None and query.normals is None and self.field.tree.split.cells.size:
            query = query._replace(mixed=partial(self._mixed, self.channels[name], lens.bleed_threshold))
        return query

    def read(self, *names: str) -> tuple[list[ChannelRows], ChannelRows | None]:
        """Return channels as lookups read them, and that which others weigh by, if there is one."""
        found: list[ChannelRows] = []
        for name in (*names, "alpha") if "alpha" in self.channels else names:
            if name not in self._stored:
                self._stored[name] = stored(self.channels[name])
            found.append(self._stored[name])
        alpha = found.pop() if len(found) > len(names) else None
        return found, alpha if alpha and alpha.is_alpha else None

    def _mixed(self, channel: Channel, threshold: float, level: int) -> Uint8s:
        key = channel.format.name, level
        known = self._known_mixed.get(key)
        if known is None or known[0] != threshold:
            known = threshold, mixed_cells(channel, self.field.level(level).tree, threshold)
            self._known_mixed[key] = known
        return known[1]

    def listed(self, name: str, lens: Lens, given: Given, answers: list[Array]) -> int:
        """Add the taps of a block to ``answers``: what `lookup.each_block` takes."""
        query = self.query(lens, given, name)
        (read,), alpha = self.read(name)
        answers += list_blends(self.field, self.placement, given["points"], query, read, alpha)
        return -1

    def holds(self, given: Given, answers: list[Array]) -> int:
        """Say of a block of points whether leaves hold them: what `lookup.in_blocks` takes."""
        arrays = self.field.tree.arrays
        return in_leaves(arrays, Positions.of(given["points"]), *self.placement, answers[0])
