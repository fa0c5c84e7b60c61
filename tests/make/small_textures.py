"""Small textures made by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from octex.channels import BASE_COLOR, ChannelFormat
from octex.texture import Channel, OctreeTexture
from octex.texture.channel import row_counts
from octex.tree.morton import encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from tests.make.strategies import with_random_data

UNIT = Placement((0.0, 0.0, 0.0), 1.0)
UNIT_BOUNDS = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]


def eight_colors(**changes: Any) -> OctreeTexture:
    """Depth 1, eight leaves; the root's value is 100, leaf n's 10 n."""
    tree = Octree.from_leaves(np.arange(8), 1)
    values = np.array([[100] * 3, *([10 * n] * 3 for n in range(8))], np.uint8)
    arguments = {
        "tree": tree,
        "channels": {"base_color": Channel(BASE_COLOR, values, values[:0], values[:0])},
        "placement": UNIT,
        "bounds": UNIT_BOUNDS,
        "metadata": {"source": "eight"},
    } | changes
    return OctreeTexture(**arguments)


def shell(depth: int, keep: float = 0.3) -> OctreeTexture:
    """A spherical shell of about 4 · 4^depth leaves, coloured at random."""
    random = np.random.default_rng(depth)
    directions = random.normal(size=(10 * 4**depth, 3))
    points = 0.5 + 0.45 * directions / np.linalg.norm(directions, axis=1)[:, None]
    codes = np.unique(encode_cells((points * 2**depth).astype(np.int64)))
    tree = with_random_data(Octree.from_leaves(codes, depth), depth, keep)
    values = random.integers(0, 256, (tree.n_cells, 3), dtype=np.uint8)
    split_values = random.integers(0, 256, (tree.split.areas.size, 3), dtype=np.uint8)
    kept_values = random.integers(0, 256, (tree.kept.cells.size, 3), dtype=np.uint8)
    channel = Channel(BASE_COLOR, values, split_values, kept_values)
    return OctreeTexture(tree, {"base_color": channel}, UNIT, UNIT_BOUNDS)


def with_channel(texture: OctreeTexture, form: ChannelFormat, code: float) -> OctreeTexture:
    """Return a texture with one more channel, of one code everywhere."""
    parts = (np.full((count, form.components), code, form.dtype) for count in row_counts(texture.tree))
    return texture.with_cells(texture.tree, {**texture.channels, form.name: Channel(form, *parts)})


def unit(vectors: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
