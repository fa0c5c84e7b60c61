from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex.errors import ArgumentError, TextureFileError
from octex.tree import octree as octree_module
from octex.tree import validate as validate_module
from octex.tree.layout import FACING_FLAGS, KEPT, SPLIT, KeptTable, SplitTable, TreeArrays
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from tests.conftest import needs_jit
from tests.make.strategies import leaf_sets, with_random_data
from tests.oracles import naive

coordinates = st.tuples(*[st.integers(0, 2**21 - 1)] * 3)


def full_tree():
    """Depth 2, all 64 leaves; 9 nodes, so that the second group is not full."""
    return Octree.from_leaves(np.arange(64), 2)


def changed(tree, **arrays):
    return Octree(tree.arrays._replace(**arrays), tree.split, tree.kept)


@given(st.lists(coordinates, max_size=5))
def test_morton_codes_interleave_bits(cells):
    codes = encode_cells(np.array(cells, np.int64).reshape(-1, 3))
    assert codes.tolist() == [naive.morton(cell) for cell in cells]
    assert decode_cells(codes).tolist() == [list(cell) for cell in cells]


@given(leaf_sets())
def test_a_tree_has_the_cells_of_its_leaves_in_breadth_first_morton_order(leaves):
    tree = Octree.from_leaves(*leaves)
    tree.validate()
    expected = naive.cells_of(leaves.places())
    assert naive.cells_in(tree) == expected
    assert tree.n_cells == len(expected)
    assert tree.n_leaves == leaves.codes.size
    assert tree.n_nodes == tree.n_cells - tree.n_leaves
    assert tree.max_depth == expected[-1].level
    assert tree.leaf_cells().tolist() == [n for n, cell in enumerate(expected) if cell.is_leaf]


@given(leaf_sets(deepest=5))
def test_levels_list_their_cells_leaves_and_nodes(leaves):
    tree = Octree.from_leaves(*leaves)
    cells = naive.cells_of(leaves.places())
    for level, (n_leaves, n_nodes) in enumerate(tree.cells_by_depth()):
        of_level = [(n, cell) for n, cell in enumerate(cells) if cell.level == level]
        assert tree.level_codes(level).tolist() == [naive.morton(cell.place) for _, cell in of_level]
        assert tree.is_node(level).tolist() == [not cell.is_leaf for _, cell in of_level]
        assert n_leaves == sum(cell.is_leaf for _, cell in of_level)
        assert n_nodes == int(tree.is_node(level).sum())
    with pytest.raises(ArgumentError, match="there is no level"):
        tree.level_codes(tree.max_depth + 1)


@given(leaf_sets(), st.integers(0, 21))
def test_a_truncated_tree_ends_in_the_nodes_of_its_last_level(leaves, level):
    tree = with_random_data(Octree.from_leaves(*leaves), level)
    short = tree.truncated(level)
    short.validate()
    assert naive.cells_in(short) == naive.truncated(naive.cells_in(tree), level)
    flags = tree.arrays.flags[: short.n_cells].copy()
    flags[short.leaf_cells()] &= 0xFF ^ KEPT
    assert np.array_equal(short.arrays.flags, flags)
    assert np.array_equal(short.kept.cells, np.flatnonzero(flags & KEPT))
    assert np.array_equal(short.split.cells, tree.split.cells[tree.split.cells < short.n_cells])
    assert all(np.array_equal(a, b[: a.size]) for a, b in zip(short.split, tree.split, strict=True))


def test_a_truncated_tree_shares_its_cells_arrays():
    tree = full_tree()
    assert np.shares_memory(tree.truncated(1).arrays.flags, tree.arrays.flags)
    assert tree.truncated(2) is tree


def test_no_leaves_make_the_empty_tree_and_the_root_can_be_a_leaf():
    empty = Octree.from_leaves(np.empty(0, np.int64), 5)
    root = Octree.from_leaves(np.zeros(1, np.int64), 0)
    assert (empty.n_cells, empty.n_nodes, empty.n_leaves, empty.max_depth) == (1, 1, 0, 0)
    assert (root.n_cells, root.n_nodes, root.n_leaves, root.max_depth) == (1, 0, 1, 0)
    assert root.nbytes == 2 + 2 * 16


@pytest.mark.parametrize(
    ("codes", "depths"),
    [
        ([1, 0], 2),  # out of order
        ([1, 1], 2),  # twice
        ([64], 2),  # outside
        ([-1], 2),
        ([0, 0], [1, 2]),  # a leaf inside a leaf, whichever comes first
        ([7, 0], [2, 1]),
        ([8, 0], [2, 1]),  # Morton order at mixed depths
        ([0, 1], [21, 0]),
        ([0, 0], [0, 0]),
    ],
)
def test_leaves_out_of_order_or_overlapping_are_refused(codes, depths):
    with pytest.raises(ArgumentError, match="Morton order"):
        Octree.from_leaves(codes, depths)


@pytest.mark.parametrize(
    ("codes", "depths", "message"),
    [
        *(([0, 1], depths, "whole numbers") for depths in ([1], [[1, 1]], [0.5, 1.0])),
        *(([0], depth, "21") for depth in (-1, 22, [-1], [22])),
    ],
)
def test_depths_must_be_whole_numbers_from_0_to_21_one_a_leaf(codes, depths, message):
    with pytest.raises(ArgumentError, match=message):
        Octree.from_leaves(codes, depths)


def test_more_cells_than_32_bits_number_are_refused(monkeypatch):
    monkeypatch.setattr(octree_module, "MAX_CELLS", 72)
    with pytest.raises(ArgumentError, match="73 cells"):
        full_tree()


def test_more_rows_than_32_bits_number_are_refused(monkeypatch):
    validate_module.check_rows(2**32 - 3, 1, 1)
    with pytest.raises(ArgumentError, match="2 rows of split cells and 1 kept nodes together are more"):
        validate_module.check_rows(2**32 - 3, 2, 1)
    tree = with_random_data(full_tree(), 0)
    tables = tree.split, tree.kept
    rows = tree.n_cells + tree.split.areas.size + tree.kept.cells.size
    assert rows > tree.n_cells + 1
    monkeypatch.setattr(validate_module, "MAX_CELLS", rows)
    Octree(tree.arrays, *tables)
    monkeypatch.setattr(validate_module, "MAX_CELLS", rows - 1)
    for make in (
        lambda: Octree(tree.arrays, *tables),
        lambda: full_tree().with_cell_data(tree.arrays.flags, tree.arrays.areas, *tables),
    ):
        with pytest.raises(ArgumentError, match="together are more than can be numbered"):
            make()


@pytest.mark.parametrize(
    "codes", [[0.5], [True], ["0"], [[0]], 0, [None], [[0], [0, 1]], np.array([2**63], np.uint64), [2**70]]
)
def test_codes_that_are_not_whole_numbers_are_refused(codes):
    with pytest.raises(ArgumentError, match="codes must be"):
        Octree.from_leaves(codes, 1)


@needs_jit
def test_a_large_tree_is_sound():
    codes = np.unique(np.random.default_rng(0).integers(0, 8**10, 300_000))
    tree = Octree.from_leaves(codes, 10)
    tree.validate()
    assert np.array_equal(tree.level_codes(10), codes)


# --- what arrays are refused


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"flags": np.zeros(73, np.int8)}, "flags must be a C-ordered uint8"),
        ({"areas": np.zeros(146, np.uint8)[::2]}, "areas must be a C-ordered uint8"),
        ({"groups": np.zeros(6, np.uint64)}, "groups must be a C-ordered uint64 array of 2"),
        ({"level_cells": np.zeros(1, np.int64)}, "an entry a level"),
        ({"level_cells": np.arange(25), "level_nodes": np.arange(25)}, "an entry a level"),
        ({"level_nodes": np.array([0, 1, 9])}, "an entry a level"),
        ({"level_cells": np.array([1, 2, 10, 74])}, "children of the nodes above"),
        ({"level_cells": np.array([0, 1, 1, 73])}, "children of the nodes above"),
        ({"level_cells": np.array([0, 1, 9, 2**63 - 1])}, "children of the nodes above"),
        ({"level_cells": np.array([0, 1, -(2**63), 73])}, "children of the nodes above"),
        ({"level_cells": np.array([0, 2, 10, 73])}, "children of the nodes above"),
        ({"level_nodes": np.array([0, 1, 2, 9])}, "children of the nodes above"),
        ({"level_nodes": np.array([1, 1, 9, 9])}, "children of the nodes above"),
        ({"level_nodes": np.array([0, 0, 9, 9])}, "children of the nodes above"),
        ({"level_nodes": np.array([0, 1, 10, 10])}, "children of the nodes above"),
        ({"groups": np.zeros((1, 3), np.uint64)}, r"groups must have shape \(2, 3\)"),
        ({"flags": np.zeros(72, np.uint8)}, r"flags must have shape \(73,\)"),
        ({"areas": np.zeros(74, np.uint8)}, r"areas must have shape \(73,\)"),
    ],
)
def test_arrays_that_do_not_fit_together_are_refused(changes, message):
    with pytest.raises(ArgumentError, match=message):
        changed(full_tree(), **changes)


def test_tables_of_unequal_columns_or_of_another_type_are_refused():
    split = SplitTable(np.zeros(1, np.uint32), np.zeros(2, np.uint8), np.zeros(2, np.uint8))
    with pytest.raises(ArgumentError, match="split facings must have shape"):
        Octree(full_tree().arrays, split)
    with pytest.raises(ArgumentError, match="kept cells must be a C-ordered uint32"):
        Octree(full_tree().arrays, kept=KeptTable(np.zeros(1, np.int64)))


# --- what validate finds


def damaged(tree, group, word, flip):
    groups = tree.arrays.groups.copy()
    groups[group, word] ^= np.uint64(flip)
    return changed(tree, groups=groups)


@pytest.mark.parametrize(
    ("group", "word", "flip", "message"),
    [
        (0, 1, 1, "group 0: a child is both node and leaf"),
        (1, 1, 1 << 8, "group 1: children of nodes beyond the last"),
        (0, 1, 0xFF00, "node 1 has no children"),
        (1, 2, 1, "group 1: its first child"),
        (0, 1, 0x8000, "group 1: its first child"),
        (1, 1, 1, "level 2: the masks above count other cells"),
        (1, 0, 0, ""),
    ],
)
def test_validate_names_what_is_broken_in_the_structure(group, word, flip, message):
    tree = damaged(full_tree(), group, word, flip)
    with pytest.raises(TextureFileError, match=message) if message else nullcontext():
        tree.validate()


def test_validate_finds_levels_that_are_cut_elsewhere():
    # Two nodes above one leaf each, and one above two: the totals stay, the levels do not.
    tree = Octree.from_leaves([0, 8, 9], 2)
    wrong = changed(tree, level_cells=np.array([0, 1, 4, 6]))
    with pytest.raises(TextureFileError, match="level 1: the masks above count other cells"):
        wrong.validate()


def test_validate_finds_nodes_whose_flags_are_not_their_childrens():
    tree = full_tree()
    flags = np.zeros(tree.n_cells, np.uint8)
    flags[-1] = flags[8] = flags[0] = 0b100
    tree.with_cell_data(flags, tree.arrays.areas).validate()
    flags[8] = 0b1100
    with pytest.raises(TextureFileError, match="node cell 0: its normal flags"):
        tree.with_cell_data(flags, tree.arrays.areas).validate()


@needs_jit
@given(leaf_sets(6), st.integers(0, 2**32 - 1), st.data())
def test_validate_names_the_node_whose_flags_are_not_its_childrens(leaves, seed, data):
    tree = with_random_data(Octree.from_leaves(*leaves), seed, keep=0.0)
    tree.validate()
    nodes = np.flatnonzero(np.concatenate([is_node for _, is_node in tree.walk()]))
    if nodes.size == 0 or tree.max_depth == 0:
        return
    flags = tree.arrays.flags & FACING_FLAGS
    flags[data.draw(st.sampled_from(nodes.tolist()))] ^= data.draw(st.integers(1, FACING_FLAGS))
    together = np.zeros_like(flags)
    for level in range(tree.max_depth):
        first, end, last = tree.arrays.level_cells[level : level + 3]
        parents = np.searchsorted(tree.level_codes(level), tree.level_codes(level + 1) >> 3)
        np.bitwise_or.at(together[first:end], parents, flags[end:last])
    node = nodes[together[nodes] != flags[nodes]][0]
    with pytest.raises(TextureFileError, match=f"node cell {node}: its normal flags"):
        Octree(tree.arrays._replace(flags=flags)).validate()


@pytest.mark.parametrize(
    ("cells", "facings", "rows", "message"),
    [
        ([0, 99], [3, 3], 4, "not those flagged as split"),
        ([2, 0], [3, 3], 4, "not those flagged as split"),
        ([0, 1], [3, 3], 4, "not those flagged as split"),
        ([0], [3], 2, "not those flagged as split"),
        ([], [], 0, "not those flagged as split"),
        ([0, 2], [3, 1], 3, "facings are not its normal flags"),
        ([0, 2], [3, 3], 3, "3 rows, but the facings number 4"),
        ([0, 2], [3, 3], 4, ""),
    ],
)
def test_validate_checks_the_split_table(cells, facings, rows, message):
    tree = full_tree()
    flags = np.full(tree.n_cells, 0b11, np.uint8)
    flags[[0, 2]] |= SPLIT
    split = SplitTable(np.array(cells, np.uint32), np.array(facings, np.uint8), np.zeros(rows, np.uint8))
    tree = tree.with_cell_data(flags, tree.arrays.areas, split)
    with pytest.raises(TextureFileError, match=message) if message else nullcontext():
        tree.validate()


@pytest.mark.parametrize(
    ("flagged", "listed", "message"),
    [
        ([0, 3], [0], "not those flagged as kept"),
        ([0], [0, 3], "not those flagged as kept"),
        ([0, 3], [3, 0], "not those flagged as kept"),
        ([8, 9], [8, 9], "kept table: cell 9 has no children"),
        ([72], [72], "kept table: cell 72 has no children"),
        ([0, 1, 8], [0, 1, 8], ""),
    ],
)
def test_validate_checks_the_table_of_kept_nodes(flagged, listed, message):
    tree = full_tree()
    flags = np.zeros(tree.n_cells, np.uint8)
    flags[flagged] |= KEPT
    tree = tree.with_cell_data(flags, tree.arrays.areas, kept=KeptTable(np.array(listed, np.uint32)))
    assert tree.nbytes == full_tree().nbytes + 4 * len(listed)
    with pytest.raises(TextureFileError, match=message) if message else nullcontext():
        tree.validate()


@pytest.mark.parametrize("codes", [[], [0]])
def test_a_root_without_children_keeps_nothing(codes):
    tree = Octree.from_leaves(np.array(codes, np.int64), 0)
    tree = tree.with_cell_data(
        np.full(1, KEPT, np.uint8), tree.arrays.areas, kept=KeptTable(np.zeros(1, np.uint32))
    )
    with pytest.raises(TextureFileError, match="cell 0 has no children"):
        tree.validate()


@given(leaf_sets(deepest=6), st.randoms(use_true_random=False))
def test_damaged_structures_are_walked_and_validated_without_harm(leaves, random):
    tree = Octree.from_leaves(*leaves)
    groups = tree.arrays.groups.copy()
    noise = np.random.default_rng(random.getrandbits(32))
    for _ in range(3):
        if groups.size:
            groups[noise.integers(len(groups)), noise.integers(3)] = noise.integers(0, 2**64, dtype=np.uint64)
    kept = KeptTable(noise.integers(0, 2**32, 4, dtype=np.uint32))
    wrong = Octree(TreeArrays(groups, *tree.arrays[1:]), kept=kept)
    for codes, _ in wrong.walk():
        assert codes.min(initial=0) >= 0
    wrong.truncated(2)
    try:
        wrong.validate()
    except TextureFileError as error:
        assert "\n" not in str(error)


# --- placement


@pytest.mark.parametrize("depth", range(22))
def test_a_placement_keeps_a_margin_and_centres_at_a_third_of_a_cell(depth):
    bounds = np.array([[-3.0, 10.0, 0.5], [1.0, 12.5, 0.5]])
    placement = Placement.around(bounds, depth)
    low, high = placement.to_texture_space(bounds) * 2**depth
    assert np.allclose(((low + high) / 2) % 1, 1 / 3, atol=1e-6)
    if depth >= 2:
        assert high[0] - low[0] == pytest.approx(2**depth - 3)
        assert low.min() >= 1 and high.max() <= 2**depth - 1
    assert low.min() > 0 and high.max() < 2**depth


def test_a_point_without_extent_is_placed():
    placement = Placement.around([[5.0, 6.0, 7.0]] * 2, 3)
    inside = placement.to_texture_space([[5.0, 6.0, 7.0]])
    assert ((inside > 0) & (inside < 1)).all()


@pytest.mark.filterwarnings("ignore:.* is larger than the model")
@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e2))
def test_a_placement_with_a_given_cell_is_no_deeper_than_needed(extent, cell):
    bounds = np.array([[0.0, 0.0, 0.0], [extent, extent / 2, 0.0]])
    placement, depth = Placement.with_cell(bounds, cell)
    assert placement.size == cell * 2**depth
    assert (2**depth - 3) * cell >= extent
    assert depth == 2 or (2 ** (depth - 1) - 3) * cell < extent
    inside = placement.to_texture_space(bounds)
    assert ((inside > 0) & (inside < 1)).all()


def test_a_cell_too_small_for_21_levels_is_refused_and_the_smallest_named():
    with pytest.raises(ArgumentError, match=r"more than 21 levels; the smallest for this model is 4.768"):
        Placement.with_cell([[0, 0, 0], [1, 1, 1]], 4e-7)


@given(st.tuples(*[st.floats(-1e3, 1e3)] * 3))
def test_placements_map_to_texture_space_and_back(point):
    placement = Placement.around([[-1, -2, -3], [1, 2, 3]], 10)
    assert np.allclose(placement.to_rest(placement.to_texture_space([point])), [point])
    assert placement.to_texture_space(np.zeros((1, 3), np.float32)).dtype == np.float64


@pytest.mark.parametrize(
    "bounds", [[[0, 0, 0], [1, 1, np.inf]], [[0, 0, 0], [1, -1, 1]], [[0, 0, 0]], [[np.nan] * 3, [1] * 3]]
)
def test_impossible_bounds_are_refused(bounds):
    with pytest.raises(ArgumentError, match="bounds must be"):
        Placement.around(bounds, 3)


def test_a_root_beyond_floating_point_is_refused():
    with pytest.raises(ArgumentError, match="size of the root cell"):
        Placement.around([[0, 0, 0], [1e308, 1, 1]], 2)
