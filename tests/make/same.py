"""Whether two textures are the same, bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from octex.texture import OctreeTexture


def arrays_of(texture: OctreeTexture) -> list[npt.NDArray[Any]]:
    """All arrays of a texture: of its tree, and of each channel."""
    tree = texture.tree
    channels = [array for channel in texture.channels.values() for array in channel[1:]]
    return [*tree.arrays, *tree.split, *tree.kept, *channels]


def assert_same(one: OctreeTexture, other: OctreeTexture) -> None:
    """Two textures have the same tree, channels, formats and values; their place and metadata may differ."""
    formats = [{name: channel.format for name, channel in each.channels.items()} for each in (one, other)]
    assert list(formats[0].items()) == list(formats[1].items())
    for number, (a, b) in enumerate(zip(arrays_of(one), arrays_of(other), strict=True)):
        assert (a.dtype, a.shape) == (b.dtype, b.shape), number
        np.testing.assert_array_equal(a.view(f"V{a.itemsize}"), b.view(f"V{b.itemsize}"), str(number))


def assert_equal(one: OctreeTexture, other: OctreeTexture) -> None:
    """Two textures are the same, and lie in the same place, with the same metadata."""
    assert_same(one, other)
    assert one.placement == other.placement
    np.testing.assert_array_equal(one.bounds, other.bounds)
    assert dict(one.metadata) == dict(other.metadata)
