"""What hypothesis draws: octrees and textures of every shape."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from hypothesis import strategies as st

from octex.arrays import bit_counts
from octex.channels import ALPHA, COLOR_SPACES, ONE, ChannelFormat
from octex.texture import Channel, OctreeTexture
from octex.texture.channel import row_counts
from octex.tree.layout import FACING_FLAGS, KEPT, SPLIT, KeptTable, SplitTable
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from tests.oracles import naive


class Leaves(NamedTuple):
    """Disjoint leaves in Morton order."""

    codes: npt.NDArray[np.int64]
    depths: npt.NDArray[np.uint8]

    def places(self) -> list[tuple[int, tuple[int, int, int]]]:
        pairs = zip(self.depths.tolist(), self.codes.tolist(), strict=True)
        return [(depth, naive.unmorton(code)) for depth, code in pairs]


@st.composite
def leaf_sets(draw: st.DrawFn, deepest: int = naive.MAX_DEPTH, most: int = 24) -> Leaves:
    """Leaves at mixed depths, crowded around a few places; none, and the root alone, too."""
    centres = draw(st.lists(st.tuples(*[st.integers(0, 2**21 - 1)] * 3), min_size=1, max_size=3))
    shallowest = draw(st.integers(0, deepest))
    taken: dict[int, tuple[int, int]] = {}
    for _ in range(draw(st.integers(0, most))):
        depth = draw(st.integers(shallowest, deepest))
        centre = draw(st.sampled_from(centres))
        place = [
            min(max((coordinate >> 21 - depth) + draw(st.integers(-2, 2)), 0), 2**depth - 1)
            for coordinate in centre
        ]
        code = naive.morton(place)
        first = code << 3 * (21 - depth)
        last = (code + 1 << 3 * (21 - depth)) - 1
        if all(last < other or first > other_last for other, (other_last, _) in taken.items()):
            taken[first] = last, depth
    ordered = [(first >> 3 * (21 - depth), depth) for first, (_, depth) in sorted(taken.items())]
    return Leaves(
        np.array([code for code, _ in ordered], np.int64), np.array([depth for _, depth in ordered], np.uint8)
    )


def points_around(leaves: Leaves) -> st.SearchStrategy[tuple[float, float, float]]:
    """Points of texture space near the corners and inside of leaves, anywhere in the root, and outside."""
    anywhere = st.floats(-0.5, 1.5)
    free = st.tuples(anywhere, anywhere, anywhere)
    if not leaves.codes.size:
        return free
    steps = st.sampled_from([-1.5, -1.0, -0.25, 0.0, 0.25, 0.5, 1.0, 1.25, 2.5])

    def near(leaf: tuple[int, tuple[int, int, int]], offset: tuple[float, ...]) -> tuple[float, float, float]:
        depth, place = leaf
        x, y, z = ((i + step) / 2**depth for i, step in zip(place, offset, strict=True))
        return x, y, z

    return st.builds(near, st.sampled_from(leaves.places()), st.tuples(steps, steps, steps)) | free


def with_random_data(tree: Octree, seed: int, keep: float | None = None) -> Octree:
    """Give a tree random areas, flags that nodes gather from their children, split cells and kept nodes.

    ``keep`` is the part of the nodes that are kept; by default none or two in five, at random.
    """
    random = np.random.default_rng(seed)
    flags = np.zeros(tree.n_cells, np.uint8)
    level_cells = tree.arrays.level_cells
    masks = [is_node for _, is_node in tree.walk()]
    codes = [found for found, _ in tree.walk()]
    for level in range(tree.max_depth, -1, -1):
        own = flags[level_cells[level] : level_cells[level + 1]]
        own[~masks[level]] = random.integers(1, FACING_FLAGS + 1, int((~masks[level]).sum()))
        if level < tree.max_depth:
            parents = np.searchsorted(codes[level], codes[level + 1] >> 3)
            np.bitwise_or.at(own, parents, flags[level_cells[level + 1] : level_cells[level + 2]])
    is_split = (random.random(tree.n_cells) < 0.3) & (flags > 0)
    facings = flags[is_split]
    rows = int(bit_counts(facings).sum())
    split = SplitTable(
        np.flatnonzero(is_split).astype(np.uint32), facings, random.integers(0, 256, rows, dtype=np.uint8)
    )
    flags[is_split] |= SPLIT
    areas = random.integers(0, 256, tree.n_cells, dtype=np.uint8)
    keep = random.choice([0.0, 0.4]) if keep is None else keep
    is_kept = np.concatenate(masks) & (random.random(tree.n_cells) < keep)
    is_kept &= tree.n_cells > 1  # the empty tree's root has no children
    flags[is_kept] |= KEPT
    return tree.with_cell_data(flags, areas, split, KeptTable(np.flatnonzero(is_kept).astype(np.uint32)))


def random_values(shape: tuple[int, int], dtype: str, random: np.random.Generator) -> npt.NDArray[np.generic]:
    if dtype.startswith("u"):
        return random.integers(0, int(ONE[dtype]) + 1, shape).astype(dtype)
    return random.random(shape).astype(dtype)


def random_channel(form: ChannelFormat, tree: Octree, random: np.random.Generator) -> Channel:
    """Random values for all rows of a tree."""
    rows = (random_values((count, form.components), form.dtype, random) for count in row_counts(tree))
    return Channel(form, *rows)


@st.composite
def textures(draw: st.DrawFn, deepest: int = naive.MAX_DEPTH) -> OctreeTexture:
    """Textures of one to three channels of any type; the first may be alpha, zero here and there."""
    leaves = draw(leaf_sets(deepest))
    seed = draw(st.integers(0, 2**32 - 1))
    tree = with_random_data(Octree.from_leaves(*leaves), seed)
    random = np.random.default_rng(seed)
    channels = {}
    for number in range(draw(st.integers(1, 3))):
        dtype = draw(st.sampled_from(sorted(ONE)))
        if number == 0 and draw(st.booleans()):
            form = ALPHA._replace(dtype=dtype)
        else:
            space = draw(st.sampled_from(COLOR_SPACES))
            form = ChannelFormat(f"channel {number}", draw(st.integers(1, 4)), space, dtype)
        channels[form.name] = random_channel(form, tree, random)
        if form.name == "alpha":
            values = [array * (random.random(array.shape) < 0.7) for array in channels["alpha"][1:]]
            channels["alpha"] = Channel(form, *values)
    placement = Placement(tuple(random.normal(size=3).tolist()), float(random.random() + 0.1))
    low = placement.to_rest(np.zeros((1, 3)))
    return OctreeTexture(
        tree, channels, placement, np.concatenate([low, low + placement.size]), {"source": "drawn"}
    )
