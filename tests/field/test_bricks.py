"""Many points in trees of several depths, looked up in the order of space."""

import numpy as np
import pytest

from octex.channels import BASE_COLOR
from octex.field import lookups
from octex.jit import kernel, refine_rows, spline_box
from octex.texture import Channel, OctreeTexture
from octex.texture import lookup as blocks
from octex.tree.layout import KEPT, KeptTable
from octex.tree.octree import Octree
from tests.conftest import needs_jit
from tests.make.small_textures import shell
from tests.properties.random_lookups import random_points, random_texture


def crowded(texture, random, count):
    """Points in and around cells, many to each."""
    centres = random_points(texture, random, 40)[0]
    chosen = centres[random.integers(0, len(centres), count)]
    return chosen + random.normal(size=(count, 3)) * 0.4 * texture.placement.size / 2**texture.tree.max_depth


def walked(monkeypatch, texture, points, name):
    """What the walk alone answers."""
    with monkeypatch.context() as patch:
        patch.setattr(lookups, "_LEAST_SORTED", len(points) + 1)
        return np.asarray(texture.sample(points, name, normalize=False))


@needs_jit
@pytest.mark.parametrize(("dtype", "seeds"), [("uint8", 24), ("float16", 12), ("float32", 12)])
def test_many_points_are_answered_as_few_are(dtype, seeds, monkeypatch):
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        texture = random_texture(random, (dtype,))
        points = crowded(texture, random, 600)
        for name in texture.channels:
            expected = walked(monkeypatch, texture, points, name)
            found = texture.sample(points, name, normalize=False)
            limit = 2e-6 * max(np.abs(expected).max(), 1e-3)
            np.testing.assert_allclose(found, expected, rtol=0, atol=limit, err_msg=f"seed {seed}: {name}")


@kernel
def refine_and_weigh(rows, weights, sums):
    refine_rows(rows, 4, 8, 40, 16, 8, 2)
    x, y, z = (weights[0], weights[1], weights[2]), (weights[3], weights[4], weights[5]), weights
    sums[0], sums[1], sums[2], sums[3] = spline_box(rows, 3, (1, 4, 16), x, y, (z[6], z[7], z[8]))


def test_rows_of_four_are_refined_and_weighed():
    random = np.random.default_rng(0)
    rows, weights, sums = random.random(256), random.random(9), np.zeros(4, np.float32)
    rows, weights = rows.astype(np.float32), weights.astype(np.float32)
    expected = rows.reshape(-1, 4).astype(np.float64)
    for first, to in ((1, 10), (2, 12)):
        a, b = expected[first].copy(), expected[first + 2].copy()
        expected[to], expected[to + 4] = 0.75 * a + 0.25 * b, 0.25 * a + 0.75 * b
    refine_and_weigh(rows, weights, sums)
    np.testing.assert_allclose(rows.reshape(-1, 4), expected, rtol=1e-6)
    cube = expected[3:].reshape(-1, 4)[: 4 * 4 * 3 - 1]
    total = sum(
        weights[i] * weights[3 + j] * weights[6 + k] * cube[i + 4 * (j + 4 * k)]
        for i in range(3)
        for j in range(3)
        for k in range(3)
    )
    np.testing.assert_allclose(sums, total, rtol=1e-5)


def adaptive(depth):
    """A shell whose leaves of one half are one level coarser."""
    full = shell(depth, keep=0.0)
    codes = full.tree.level_codes(depth)
    is_coarse = codes >> 3 * depth - 1 == 0
    depths = np.where(is_coarse, depth - 1, depth).astype(np.uint8)
    codes = np.where(is_coarse, codes >> 3, codes)
    first = np.append(True, (np.diff(codes) != 0) | (np.diff(depths) != 0))
    tree = Octree.from_leaves(codes[first], depths[first])
    channels = {name: channel.of(tree) for name, channel in full.channels.items()}
    return OctreeTexture(tree, channels, full.placement, full.bounds)


def on_shell(count):
    directions = np.random.default_rng(5).normal(size=(count, 3))
    return np.asarray(0.5 + 0.45 * directions / np.linalg.norm(directions, axis=1)[:, None], np.float32)


def painted(depth):
    """A shell of which a part is a level finer below nodes of which most keep coefficients."""
    random = np.random.default_rng(depth)
    full = shell(depth, keep=0.0)
    codes = full.tree.level_codes(depth)
    is_painted = codes >> 3 * depth - 6 == codes[codes.size // 3] >> 3 * depth - 6
    children = (codes[is_painted][:, None] << 3 | np.arange(8)).ravel()
    children = children[random.random(children.size) < 0.6]
    leaves = np.concatenate([codes[~is_painted] << 3, children])
    order = np.argsort(leaves)
    depths = np.concatenate([np.full((~is_painted).sum(), depth), np.full(children.size, depth + 1)])[order]
    tree = Octree.from_leaves(leaves[order] >> 3 * (depth + 1 - depths), depths)
    nodes = np.flatnonzero(tree.is_node(depth)) + int(tree.arrays.level_cells[depth])
    kept = nodes[random.random(nodes.size) < 0.7].astype(np.uint32)
    flags = tree.arrays.flags.copy()
    flags[kept] |= KEPT
    tree = tree.with_cell_data(flags, tree.arrays.areas, kept=KeptTable(kept))
    values, kept_values = (random.integers(0, 256, (n, 3), np.uint8) for n in (tree.n_cells, kept.size))
    channel = Channel(BASE_COLOR, values, values[:0], kept_values)
    return OctreeTexture(tree, {"base_color": channel}, full.placement, full.bounds)


@needs_jit
@pytest.mark.parametrize("filter", ["linear", "quadratic"])
def test_beside_finer_paint_tiles_answer_as_the_walk_does(filter):
    texture, walked = painted(5), painted(5)
    assert texture._field.painted
    setattr(walked._field, "painted", None)  # noqa: B010
    points = np.concatenate([reach * on_shell(2000) for reach in np.float32([1.0, 1.02, 0.8])])
    for view in ({}, {"gradient": True}, {"normals": points - np.float32(0.5)}):
        answers = (each.sample(points, filter=filter, **view) for each in (texture, walked))
        found, expected = (np.hstack(_flat(answer)) for answer in answers)
        np.testing.assert_allclose(found, expected, rtol=0, atol=5e-6 * np.abs(expected).max())


def _flat(answer):
    parts = answer if isinstance(answer, tuple) else (answer,)
    return [part.reshape(len(part), -1) for part in parts]


@needs_jit
def test_points_are_answered_in_their_own_order(monkeypatch):
    texture, points = adaptive(5), on_shell(2000)
    expected = walked(monkeypatch, texture, points, "base_color")
    monkeypatch.setattr(blocks, "BLOCK", 200)
    monkeypatch.setattr(blocks, "_SORTED", 700)
    np.testing.assert_allclose(texture.sample(points), expected, rtol=0, atol=1e-6)
    values, gradients = texture.sample(points, gradient=True)
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-6)
    assert gradients.shape == (2000, 3, 3)


@needs_jit
def test_the_first_row_that_is_not_finite_is_named_also_of_sorted_points(monkeypatch):
    texture, points = adaptive(5), on_shell(2000)
    monkeypatch.setattr(blocks, "BLOCK", 200)
    points[1800, 1] = points[900, 2] = np.nan
    with pytest.raises(ValueError, match=r"points\[900\]"):
        texture.sample(points)
    normals = np.ones((2000, 3))
    normals[[700, 1500]] = np.inf
    with pytest.raises(ValueError, match=r"normals\[700\]"):
        texture.sample(on_shell(2000), normals=normals)
