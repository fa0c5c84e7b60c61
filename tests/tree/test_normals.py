"""Leaves one after another, and which way each faces."""

import numpy as np
import pytest

from octex import jit
from octex.tree.layout import AREA_ONE, AREA_STEPS, SplitTable, TreeArrays
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.normals import estimate_normals
from octex.tree.octree import Octree, walk_leaves
from tests.conftest import needs_jit
from tests.oracles import naive_normals

PX, MX, PY, MY, PZ, MZ = (1 << facing for facing in range(6))


def tree_of(codes, depths, flags=0, areas=AREA_ONE):
    """A tree whose leaves, in Morton order, have these flags and areas."""
    tree = Octree.from_leaves(codes, depths)
    cells = np.concatenate([leaves.cells for leaves in walk_leaves(tree.arrays)])
    cell_flags, cell_areas = (np.zeros(tree.n_cells, np.uint8) for _ in range(2))
    cell_flags[cells], cell_areas[cells] = flags, areas
    return tree.with_cell_data(cell_flags, cell_areas)


def tree_of_points(points, normals, depth):
    """A tree of the cells that hold points of texture space, each point with its facing and share of area."""
    codes = encode_cells(np.floor(points * 2**depth))
    axes = np.abs(normals).argmax(axis=1)
    facings = 2 * axes + (normals[np.arange(len(axes)), axes] < 0)
    order = np.argsort(codes)
    leaves, first, counts = np.unique(codes[order], return_index=True, return_counts=True)
    flags = np.bitwise_or.reduceat((1 << facings[order]).astype(np.uint8), first)
    areas = np.rint(AREA_STEPS * np.log2(counts / counts.max())) + AREA_ONE
    return tree_of(leaves, depth, flags, areas)


def normals_of(tree):
    return np.concatenate([estimate_normals(tree.arrays, *leaves) for leaves in walk_leaves(tree.arrays)])


def sphere(depth):
    """The tree of a sphere of radius 0.4, and the directions of its leaves' centres."""
    n = np.arange(600 * 4**depth) + 0.5  # a Fibonacci lattice of some 200 points a leaf
    z = 1 - 2 * n / len(n)
    angle = np.pi * (1 + 5**0.5) * n
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    centre = 0.5 + 1 / 3 / 2**depth
    tree = tree_of_points(0.4 * directions + centre, directions, depth)
    radii = (decode_cells(tree.level_codes(depth)) + 0.5) / 2**depth - centre
    return tree, radii / np.linalg.norm(radii, axis=1, keepdims=True)


# --- leaves one after another


@pytest.mark.parametrize("block", [1, 3, 1 << 16])
def test_leaves_come_in_morton_order_at_any_mix_of_depths(block):
    leaves = [(0, 1), (8, 2), (9 * 8 + 7, 3), (3, 1), (63, 2)]
    tree = Octree.from_leaves(*zip(*leaves, strict=True))
    walked = list(walk_leaves(tree.arrays, block))
    assert all(len(some.cells) <= block for some in walked)
    cells, codes, depths = (np.concatenate(column) for column in zip(*walked, strict=True))
    assert list(zip(codes.tolist(), depths.tolist(), strict=True)) == leaves
    for level in range(tree.max_depth + 1):
        np.testing.assert_array_equal(
            cells[depths == level], np.flatnonzero(~tree.is_node(level)) + tree.level_cells[level]
        )


def test_a_root_leaf_is_one_leaf_and_an_empty_tree_has_none():
    assert [
        tuple(column.tolist() for column in some) for some in walk_leaves(Octree.from_leaves([0], 0).arrays)
    ] == [([0], [0], [0])]
    assert list(walk_leaves(Octree.from_leaves([], 0).arrays)) == []


def test_a_walk_over_damaged_arrays_ends():
    groups = np.array([[2**64 - 1, 0, 0]], np.uint64)  # every child of every node is node 0
    none = np.zeros(10, np.uint8)
    for deepest in (1, 21):
        levels = np.minimum(np.arange(deepest + 2), 8)
        arrays = TreeArrays(groups, np.append(levels[:-1], 10), levels, none, none)
        assert sum(len(some.cells) for some in walk_leaves(arrays)) == 0
    groups[0] = (0, 2**64 - 1, 0)
    arrays = TreeArrays(groups, np.array([0, 1, 4]), np.array([0, 1, 1]), none[:4], none[:4])
    assert sum(len(some.cells) for some in walk_leaves(arrays)) == 3  # as many as it claims, not eight


# --- normals


def test_normals_agree_with_the_slow_reference():
    random = np.random.default_rng(3)
    points = np.column_stack([random.random((1500, 2)), 0.5 + 0.06 * random.standard_normal(1500)])
    normals = random.standard_normal((1500, 3)) + np.array([0, 0, 2])
    tree = tree_of_points(np.clip(points, 0, 0.999), normals, 3)
    expected = naive_normals.estimate_normals(tree)
    np.testing.assert_allclose(normals_of(tree), expected, atol=1e-6)


@needs_jit
def test_normals_of_a_sphere_point_outward_within_half_a_degree_at_the_median():
    tree, directions = sphere(6)
    cosines = (normals_of(tree) * directions).sum(axis=1)
    errors = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    assert np.median(errors) < 0.5
    assert np.percentile(errors, 99) < 7.5
    assert errors.max() < 10


def test_normals_are_unit_and_do_not_depend_on_the_blocks():
    tree, _ = sphere(3 if jit.DISABLED else 5)
    normals = normals_of(tree)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    one_by_one = [estimate_normals(tree.arrays, *some) for some in walk_leaves(tree.arrays, 7)]
    np.testing.assert_array_equal(np.concatenate(one_by_one), normals)


def test_a_plane_at_mixed_depths_keeps_its_normal():
    # Half of the sheet in cells of depth 4, half in cells of depth 3 that hold it too.
    fine = [(i, j, 8) for i in range(8) for j in range(16)]
    coarse = [(i, j, 4) for i in range(4, 8) for j in range(8)]
    codes = np.concatenate([encode_cells(fine), encode_cells(coarse)])
    depths = np.repeat([4, 3], [len(fine), len(coarse)])
    order = np.argsort(codes << 3 * (21 - depths))
    normals = normals_of(tree_of(codes[order], depths[order], MZ))
    assert (normals[:, 2] < -0.9).all()
    inside = np.abs(decode_cells(codes[order]) * 2.0 ** (4 - depths[order])[:, None] - 8)[:, 0] > 5
    np.testing.assert_allclose(normals[inside], np.tile([0, 0, -1], (inside.sum(), 1)), atol=1e-6)


def test_the_two_sides_of_a_slab_do_not_bend_each_other():
    cells = [(i, j, k) for i in range(16) for j in range(16) for k in (7, 8)]
    codes = np.sort(encode_cells(cells))
    upper = decode_cells(codes)[:, 2] == 8
    normals = normals_of(tree_of(codes, 4, np.where(upper, PZ, MZ)))
    np.testing.assert_allclose(normals[:, 2], np.where(upper, 1, -1), atol=1e-6)


def test_a_sheet_flagged_on_both_sides_takes_its_first():
    u, v = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(64) + 0.5) / 64)
    points = np.stack([u, v, 0.2 + u / 2], axis=-1).reshape(-1, 3)  # one up for two along x
    tree = tree_of_points(
        np.concatenate([points, points]), np.repeat([[0, 0, 1], [0, 0, -1]], len(points), axis=0), 4
    )
    normals = normals_of(tree)
    assert (normals @ np.array([-1, 0, 2]) / 5**0.5).min() > np.cos(np.radians(10))


@pytest.mark.parametrize(
    ("flags", "normal"),
    [
        (PX, (1, 0, 0)),
        (MY, (0, -1, 0)),
        (PX | PY, (0.70710678, 0.70710678, 0)),
        (PX | PY | MY, (1, 0, 0)),
        (MZ | PZ, (0, 0, 1)),
        (0, (0, 0, 1)),
    ],
)
@pytest.mark.parametrize("depth", [0, 1, 5, 21])
def test_a_leaf_on_its_own_faces_as_its_flags_say(depth, flags, normal):
    tree = tree_of([0 if depth == 0 else 5], depth, flags)
    np.testing.assert_allclose(normals_of(tree), [normal], atol=1e-6)


def test_leaves_in_a_line_face_as_their_flags_say():
    codes = np.sort(encode_cells([(i, 3, 3) for i in range(8)]))
    np.testing.assert_allclose(
        normals_of(tree_of(codes, 3, PY | PZ)), [(0, 0.5**0.5, 0.5**0.5)] * 8, atol=1e-6
    )


def test_flags_that_contradict_the_surroundings_win():
    codes = np.sort(encode_cells([(i, j, 3) for i in range(8) for j in range(8)]))
    flags = np.where(codes == codes[20], PX, PZ)
    normals = normals_of(tree_of(codes, 3, flags))
    np.testing.assert_allclose(normals[20], (1, 0, 0), atol=1e-6)
    assert (np.delete(normals, 20, axis=0)[:, 2] > 0.99).all()


def test_without_flags_and_areas_the_normal_has_some_sign():
    codes = np.sort(encode_cells([(i, j, 3) for i in range(8) for j in range(8)]))
    np.testing.assert_allclose(np.abs(normals_of(tree_of(codes, 3, 0, 0))[:, 2]), 1, atol=1e-6)


def test_nodes_stand_for_all_below_them():
    # A look at the coarse level sees the same sheet: nodes count as cells.
    codes = np.sort(encode_cells([(i, j, 8) for i in range(16) for j in range(16)]))
    tree = tree_of(codes, 4, PZ)
    flags, areas = tree.arrays.flags.copy(), tree.arrays.areas.copy()
    flags[:] = PZ
    areas[:] = AREA_ONE
    tree = tree.with_cell_data(flags, areas, SplitTable(*tree.split))
    cells = np.arange(tree.arrays.level_cells[3], tree.arrays.level_cells[4])
    coarse = estimate_normals(tree.arrays, cells, tree.level_codes(3), np.full(len(cells), 3, np.uint8))
    np.testing.assert_allclose(coarse, np.tile([0, 0, 1], (len(cells), 1)), atol=1e-6)
    root = estimate_normals(tree.arrays, np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros(1, np.uint8))
    np.testing.assert_allclose(root, [(0, 0, 1)])
