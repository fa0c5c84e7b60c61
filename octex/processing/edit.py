"""A texture with other values: what they are above leaves, and what provenance says of them."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np

from octex.arrays import Array
from octex.channels import ALPHA
from octex.editing.averages import Change, average, coverage, difference, residuals
from octex.texture import Channel, OctreeTexture

#: The name in the metadata under which operations are listed, as JSON.
PROCESSED = "processed"
#: Alphas that differ by less count as alike: half an 8-bit code.
_FAINT = np.float32(0.5 / 255)


def noted(metadata: Mapping[str, str], operation: str, **how: object) -> dict[str, str]:
    """Return provenance with one more operation."""
    try:
        before = json.loads(metadata.get(PROCESSED, "[]"))
    except ValueError:
        before = metadata[PROCESSED]
    listed = before if isinstance(before, list) else [before]
    return {**metadata, PROCESSED: json.dumps([*listed, {"operation": operation, **how}])}


def with_values(
    texture: OctreeTexture,
    made: Mapping[str, Channel],
    change: Mapping[str, Change],
    metadata: Mapping[str, str],
) -> OctreeTexture:
    """Return a texture with other values in some of its channels, and averages that suit them.

    Leaves, their rows and kept coefficients stay as ``made`` has them, whose arrays are written to; nodes and
    rows of split nodes are made anew, residuals by the ``change`` of each channel. After a change of alpha,
    the averages of all channels weigh by the new one; a node that gets more opaque keeps as much of its
    residual as it was opaque before.
    """
    made = dict(made)
    if ALPHA.name in made:
        for name, channel in texture.channels.items():
            if name not in made:
                made[name] = channel._replace(
                    values=channel.values.copy(), split_values=channel.split_values.copy()
                )
    channels = {**texture.channels, **made}
    after = OctreeTexture(texture.tree, channels, texture.placement, texture.bounds, metadata)
    for name in sorted(made, key=lambda name: name != ALPHA.name):
        own = change.get(name, difference)
        if ALPHA.name in made and name != ALPHA.name:
            own = _covered(own, texture.channels[ALPHA.name].values, made[ALPHA.name].values)
        average(after, made[name], residuals(texture, name, change=own))
    return after


def _covered(change: Change, was: Array, alpha: Array) -> Change:
    """Return a change that keeps of residuals what is as opaque now, by ``alpha``, as it ``was``."""
    parts = np.minimum((coverage(was) + _FAINT) / (coverage(alpha) + _FAINT), 1)
    return lambda cells, values, means: change(cells, values, means) * parts[cells, None]
