"""Trees made from trees, beside sets of cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from octex.errors import ArgumentError
from octex.tree.children import children_of, node_cells
from octex.tree.edit import among, cull, facings_of_nodes, indices_in, locate, raised, rebuilt
from octex.tree.layout import FACING_FLAGS, KEPT, SPLIT
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.neighbours import boundary, near, with_boundary
from octex.tree.octree import Octree
from tests.conftest import needs_jit
from tests.make.strategies import leaf_sets, with_random_data

Key = tuple[int, int]  # level, Morton code
ROOT = (0, 0)
NONE = np.empty(0, np.int64)
seeds = st.integers(0, 2**32 - 1)


@given(st.lists(st.integers(-3, 40)), st.sets(st.integers(0, 40)), st.booleans())
def test_places_are_those_of_a_dictionary(codes, known, ascend):
    places_of = {code: place for place, code in enumerate(sorted(known))}
    asked = sorted(codes) if ascend else codes
    found = indices_in(np.array(asked, np.int64), np.array(sorted(known), np.int64))
    assert found.tolist() == [places_of.get(code, -1) for code in asked]


def keys_of(tree):
    """The cells in the order of their numbers, and which of them are leaves."""
    return {
        (level, code): not is_node
        for level, (codes, nodes) in enumerate(tree.walk())
        for code, is_node in zip(codes.tolist(), nodes.tolist(), strict=True)
    }


def above(key):
    level, code = key
    return [(level - n, code >> 3 * n) for n in range(1, level + 1)]


def children(key):
    level, code = key
    return [(level + 1, code << 3 | octant) for octant in range(8)]


def by_level(keys, least=1):
    keys = set(keys)
    levels = max([level + 1 for level, _ in keys] + [least])
    found = [[] for _ in range(levels)]
    for level, code in sorted(keys):
        found[level].append(code)
    return [np.array(codes, np.int64) for codes in found]


def leaves_of(tree):
    return {key for key, is_leaf in keys_of(tree).items() if is_leaf}


def with_noise(tree, seed):
    """Flags that nodes do not gather from their children; split cells and kept nodes as they are."""
    random = np.random.default_rng(seed)
    flags = random.integers(0, FACING_FLAGS + 1, tree.n_cells, dtype=np.uint8)
    flags[tree.split.cells] = tree.arrays.flags[tree.split.cells] & FACING_FLAGS
    flags |= tree.arrays.flags & (KEPT | SPLIT)
    return tree.with_cell_data(flags, tree.arrays.areas, tree.split, tree.kept)


@st.composite
def trees(draw, deepest=8):
    return with_random_data(Octree.from_leaves(*draw(leaf_sets(deepest))), draw(seeds))


# --- from levels


@given(leaf_sets())
def test_leaves_by_level_make_the_tree_of_the_same_leaves(leaves):
    expected = Octree.from_leaves(*leaves)
    levels = by_level(zip(leaves.depths.tolist(), leaves.codes.tolist(), strict=True), 22)
    for given_levels in (levels, levels[: expected.max_depth + 1]):
        tree = Octree.from_levels(given_levels)
        tree.validate()
        for own, array in zip(tree.arrays, expected.arrays, strict=True):
            assert own.dtype == array.dtype
            assert np.array_equal(own, array)
        assert (tree.split.cells.size, tree.kept.cells.size) == (0, 0)


@given(leaf_sets(deepest=18), seeds)
def test_a_leaf_above_or_below_another_is_refused(leaves, seed):
    assume(leaves.codes.size)
    random = np.random.default_rng(seed)
    keys = list(zip(leaves.depths.tolist(), leaves.codes.tolist(), strict=True))
    level, code = keys[random.integers(len(keys))]
    down = int(random.integers(1, 4))
    others = [(level + down, (code << 3 * down) + int(random.integers(8**down)))]
    if level:
        others.append(above((level, code))[random.integers(level)])
    for other in others:
        with pytest.raises(ArgumentError, match="overlap"):
            Octree.from_levels(by_level([*keys, other]))


@pytest.mark.parametrize("levels", [[[], [1, 0]], [[], [1, 1]], [[], [], [9, 10, 3]], [[0, 0]], [[0], [3]]])
def test_levels_out_of_order_are_refused(levels):
    with pytest.raises(ArgumentError, match="overlap others, or are out of order"):
        Octree.from_levels([np.array(codes, np.int64) for codes in levels])


def test_levels_without_leaves_make_the_empty_tree():
    empty = Octree.from_levels([NONE, NONE, NONE])
    assert (empty.n_cells, empty.n_nodes, empty.max_depth) == (1, 1, 0)


# --- what is where


@given(trees(), seeds)
def test_cells_are_located_as_by_a_search_through_all_cells(tree, seed):
    random = np.random.default_rng(seed)
    cells = keys_of(tree)
    numbers = {key: n for n, key in enumerate(cells)}
    keys = [*cells, *(child for key in cells for child in children(key))]
    keys += [(level + 2, (code << 6) + int(random.integers(64))) for level, code in cells]
    for level, codes in enumerate(by_level(keys)):
        shuffled = random.permutation(codes)
        found = locate(tree, shuffled, level)
        holders = [
            next(key for key in [(level, code), *above((level, code))] if key in cells)
            for code in shuffled.tolist()
        ]
        assert found.cells.tolist() == [numbers[key] for key in holders]
        assert found.levels.tolist() == [key[0] for key in holders]
        assert found.is_leaf.tolist() == [cells[key] for key in holders]


@given(st.lists(st.integers(0, 40)), st.sets(st.integers(0, 40)))
def test_codes_are_among_others_as_in_sets(codes, known):
    found = among(np.array(codes, np.int64), np.array(sorted(known), np.int64))
    assert found.tolist() == [code in known for code in codes]


@given(trees())
def test_nodes_and_their_first_children_are_those_of_a_search_through_all_cells(tree):
    cells = keys_of(tree)
    numbers = {key: n for n, key in enumerate(cells)}
    assume(tree.n_leaves)
    nodes = [key for key, is_leaf in cells.items() if not is_leaf]
    assert node_cells(tree.arrays).tolist() == [numbers[key] for key in nodes]
    below = [[numbers[child] for child in children(key) if child in cells] for key in nodes]
    firsts, counts = children_of(tree.arrays.groups, np.arange(tree.n_nodes))
    assert firsts.tolist() == list(map(min, below))
    assert counts.tolist() == list(map(len, below))


@given(trees(), seeds)
def test_nodes_face_as_their_children_do(tree, seed):
    assert np.array_equal(facings_of_nodes(tree), tree.arrays.flags)
    tree = with_noise(tree, seed)
    before = tree.arrays.flags.copy()
    cells = keys_of(tree)
    numbers = {key: n for n, key in enumerate(cells)}
    expected = before.tolist()
    for key in reversed(cells):
        own = [expected[numbers[child]] for child in children(key) if child in cells]
        if own:
            facings = np.bitwise_or.reduce(own) & FACING_FLAGS
            expected[numbers[key]] = expected[numbers[key]] & ~FACING_FLAGS | int(facings)
    assert facings_of_nodes(tree).tolist() == expected
    assert np.array_equal(tree.arrays.flags, before)


# --- what is carried over


def check(edited, tree, leaves, keeping):
    """Compare with the tree of some leaves; ``keeping`` are the nodes that keep, beside those that did."""
    old = {key: n for n, key in enumerate(keys_of(tree))}
    cells = sorted({ROOT, *leaves, *(key for leaf in leaves for key in above(leaf))})
    assert keys_of(edited.tree) == {key: key in leaves for key in cells}
    assert list(keys_of(edited.tree)) == cells
    assert edited.old.tolist() == [old.get(key, -1) for key in cells]

    names = {n: key for key, n in old.items()}
    were_kept = [names[n] for n in tree.kept.cells.tolist()]
    has_children = {key for cell in cells for key in above(cell)}
    kept = {key for key in were_kept if key in has_children} | keeping
    assert edited.kept_rows.tolist() == [key in has_children for key in were_kept]
    assert [cells[n] for n in edited.tree.kept.cells.tolist()] == sorted(kept)

    for n, key in enumerate(cells):
        flags = int(tree.arrays.flags[old[key]]) & ~KEPT if key in old else 0
        assert edited.tree.arrays.flags[n] == flags | KEPT * (key in kept)
        assert edited.tree.arrays.areas[n] == (tree.arrays.areas[old[key]] if key in old else 0)

    rows, split, facings, areas = [], [], [], []
    at = 0
    for cell, facing in zip(tree.split.cells.tolist(), tree.split.facings.tolist(), strict=True):
        stays = names[cell] in cells
        count = facing.bit_count()
        rows += [stays] * count
        if stays:
            split.append(cells.index(names[cell]))
            facings.append(facing)
            areas += tree.split.areas[at : at + count].tolist()
        at += count
    assert edited.split_rows.tolist() == rows
    assert [column.tolist() for column in edited.tree.split] == [split, facings, areas]

    for shape in [(), (3,)]:
        values = np.random.default_rng(0).random((tree.n_cells, *shape)) + 1
        carried = edited.carried(values)
        for n, key in enumerate(cells):
            assert np.array_equal(carried[n], values[old[key]] if key in old else np.zeros(shape))

    edited.tree.with_cell_data(  # what split nodes face may change: that is for octex.editing.split
        facings_of_nodes(edited.tree) & np.uint8(0xFF ^ SPLIT),
        edited.tree.arrays.areas,
        kept=edited.tree.kept,
    ).validate()


@given(trees(), seeds)
def test_a_culled_tree_has_the_chosen_leaves_and_what_is_above_them(tree, seed):
    random = np.random.default_rng(seed)
    is_kept = random.random(tree.n_cells) < random.choice([0.1, 0.5, 0.9])
    leaves = {
        key
        for (key, is_leaf), keep in zip(keys_of(tree).items(), is_kept.tolist(), strict=True)
        if is_leaf and keep
    }
    assume(leaves)
    check(cull(tree, is_kept), tree, leaves, set())


@given(trees())
def test_a_tree_of_which_all_is_kept_is_as_it_was(tree):
    edited = cull(tree, np.ones(tree.n_cells, np.bool_))
    assert edited.old.tolist() == list(range(tree.n_cells))
    assert edited.split_rows.all() and edited.kept_rows.all()
    for own, other in zip(
        (*edited.tree.arrays, *edited.tree.split, *edited.tree.kept),
        (*tree.arrays, *tree.split, *tree.kept),
        strict=True,
    ):
        assert np.array_equal(own, other)
    edited.tree.validate()


@pytest.mark.parametrize("keep", [0.0, 1.0])
def test_a_tree_of_which_nothing_is_kept_is_empty_and_sound(keep):
    tree = with_random_data(Octree.from_leaves(np.arange(20), 2), 0, keep)
    edited = cull(tree, np.zeros(tree.n_cells, np.bool_))
    assert (edited.tree.n_cells, edited.tree.n_leaves, edited.old.tolist()) == (1, 0, [0])
    edited.tree.validate()


@given(trees(), leaf_sets(deepest=8))
def test_a_tree_rebuilt_of_other_leaves_carries_what_it_shares(tree, leaves):
    assume(leaves.codes.size)
    keys = set(zip(leaves.depths.tolist(), leaves.codes.tolist(), strict=True))
    check(rebuilt(tree, by_level(keys)), tree, keys, set())


@given(trees(), seeds)
def test_a_tree_is_rebuilt_where_leaves_and_nodes_change_places(tree, seed):
    random = np.random.default_rng(seed)
    keys = set()
    for key, is_leaf in keys_of(tree).items():
        if not keys & set(above(key)) and (is_leaf or random.random() < 0.1):
            first = int(random.integers(6))
            keys |= set(children(key)[first : first + 3]) if is_leaf and random.random() < 0.3 else {key}
    assume(keys)
    check(rebuilt(tree, by_level(keys)), tree, keys, set())


# --- raised


class Wanted(NamedTuple):
    tree: Octree
    wanted: set[Key]
    met: set[Key]
    added: set[Key]


@st.composite
def wanted_cells(draw, part=None):
    """Met cells below some leaves, with all above them; some of these are wanted; leaves in empty places."""
    tree = draw(trees())
    random = np.random.default_rng(draw(seeds))
    cells = keys_of(tree)
    met = set()
    for leaf in leaves_of(tree):
        part_here = random.choice([0.0, 0.2, 0.6, 1.0]) if part is None else part
        found = [leaf]
        for _ in range(random.integers(1, 4)):
            found = [child for key in found for child in children(key) if random.random() < part_here][:40]
            met |= set(found)
    candidates = sorted(met)
    chosen = random.random(len(candidates)) < random.choice([0.0, 0.03, 0.2])
    wanted = {key for key, choose in zip(candidates, chosen.tolist(), strict=True) if choose}
    added = set()
    for key, is_leaf in cells.items():
        for child in [] if is_leaf else children(key):
            if child not in cells and random.random() < 0.05:
                for _ in range(random.integers(0, 3)):
                    child = children(child)[random.integers(8)]
                added.add(child)
    return Wanted(tree, wanted, met, added)


def raised_leaves(drawn):
    """The leaves there should be, and the nodes that were leaves or are new below them."""
    cells = keys_of(drawn.tree)
    nodes = {
        key for cell in drawn.wanted for key in above(cell) if cells.get(key, True) and below(key, cells)
    }
    leaves = leaves_of(drawn.tree) - nodes | drawn.added
    leaves |= {key for key in drawn.met - nodes if above(key)[0] in nodes}
    return leaves, nodes


def new_below_kept(drawn):
    """The new nodes above what is added that lie below nodes which keep a coefficient."""
    cells = keys_of(drawn.tree)
    kept = {list(cells)[n] for n in drawn.tree.kept.cells.tolist()}
    new = {key for cell in drawn.added for key in above(cell) if key not in cells}
    return {key for key in new if next(each for each in above(key) if each in cells) in kept}


def below(key, cells):
    """Whether a cell is a leaf or below one."""
    return any(cells.get(each, False) for each in [key, *above(key)])


@given(wanted_cells())
def test_a_raised_tree_goes_down_to_wanted_cells_by_cells_that_are_met(drawn):
    tree, wanted, met, added = drawn
    edited = raised(tree, by_level(wanted), by_level(met), by_level(added))
    leaves, nodes = raised_leaves(drawn)
    if leaves:
        check(edited, tree, leaves, nodes | new_below_kept(drawn))
    cells = keys_of(edited.tree)
    old = keys_of(tree)
    assert wanted <= set(cells)
    assert added <= leaves_of(edited.tree)
    assert {key for key in cells if below(key, old)} - set(old) <= met
    of_kept = {list(cells)[n] for n in edited.tree.kept.cells.tolist()}
    assert {key for key, is_leaf in cells.items() if not is_leaf and below(key, old)} <= of_kept
    assert {key for key, is_leaf in old.items() if is_leaf and not set(children(key)) & met} <= leaves_of(
        edited.tree
    )


@given(wanted_cells(part=1.0))
def test_where_all_children_are_met_raised_nodes_have_all_eight(drawn):
    tree, wanted, _, _ = drawn
    full = {child for key in raised_leaves(drawn)[1] for child in children(key)}
    edited = raised(tree, by_level(wanted), by_level(full), [])
    cells = keys_of(edited.tree)
    for key in raised_leaves(drawn)[1]:
        assert set(children(key)) <= set(cells)
    if leaves_of(tree):
        check(edited, tree, *raised_leaves(drawn._replace(met=full, added=set())))


@given(trees())
def test_a_tree_in_which_nothing_is_wanted_stays(tree):
    cells = keys_of(tree)
    met = {child for key, is_leaf in cells.items() if is_leaf for child in children(key)}
    for nothing in ([], [NONE] * 12):
        edited = raised(tree, nothing, by_level(met), nothing)
        assert keys_of(edited.tree) == cells
        assert np.array_equal(edited.tree.arrays.flags, tree.arrays.flags)
        assert np.array_equal(edited.tree.kept.cells, tree.kept.cells)


def test_wanted_cells_below_a_leaf_that_nothing_is_met_below_are_not_made():
    tree = Octree.from_leaves(np.arange(8), 1)
    edited = raised(tree, by_level({(3, 5), (3, 64)}), by_level({(2, 8), (3, 64), (3, 65)}), [])
    assert leaves_of(edited.tree) == {*((1, code) for code in (0, *range(2, 8))), (3, 64), (3, 65)}
    assert edited.tree.kept.cells.tolist() == [2, 9]


def test_a_new_cell_that_nothing_is_met_below_stays_a_leaf():
    tree = Octree.from_leaves(np.arange(8), 1)
    edited = raised(tree, by_level({(3, 0)}), by_level({(2, 0), (2, 1)}), [])
    assert leaves_of(edited.tree) == {*((1, code) for code in range(1, 8)), (2, 0), (2, 1)}
    assert edited.tree.kept.cells.tolist() == [1]


@pytest.mark.parametrize("added", [{ROOT}, {(1, 3)}, {(2, 9), (5, 0)}])
def test_leaves_are_added_to_the_empty_tree(added):
    tree = Octree.from_leaves(NONE, 0)
    check(raised(tree, [], [], by_level(added)), tree, added, set())


def test_the_root_is_raised():
    tree = with_random_data(Octree.from_leaves(np.zeros(1, np.int64), 0), 0)
    edited = raised(tree, by_level({(2, 9)}), by_level({(1, 0), (1, 1), (2, 9), (2, 10)}), [])
    check(edited, tree, {(1, 0), (2, 9), (2, 10)}, {ROOT, (1, 1)})


@needs_jit
def test_a_large_tree_is_raised_and_culled_back():
    random = np.random.default_rng(0)
    codes = np.unique(random.integers(0, 8**8, 100_000))
    tree = with_random_data(Octree.from_leaves(codes, 8), 0, 0.0)
    fine = np.unique((random.choice(codes, 30_000) << 6) + random.integers(0, 64, 30_000))
    met = [*[NONE] * 9, np.unique(fine >> 3), fine]
    edited = raised(tree, [*[NONE] * 10, fine], met, [])
    assert edited.tree.n_leaves == codes.size - np.unique(fine >> 6).size + fine.size
    assert np.array_equal(edited.tree.level_codes(10), fine)
    nodes = edited.tree.arrays.level_cells[8] + np.searchsorted(codes, np.unique(fine >> 6))
    assert np.array_equal(edited.tree.kept.cells[: nodes.size], nodes)
    assert edited.tree.kept.cells.size == nodes.size + met[9].size
    edited.tree.with_cell_data(
        facings_of_nodes(edited.tree) & np.uint8(0xFF ^ SPLIT),
        edited.tree.arrays.areas,
        kept=edited.tree.kept,
    ).validate()
    back = cull(edited.tree, np.arange(edited.tree.n_cells) < edited.tree.arrays.level_cells[9])
    whole = np.setdiff1d(codes, fine >> 6)
    assert np.array_equal(back.tree.level_codes(8), whole)
    assert back.tree.kept.cells.size == 0


def test_cells_beside_others_are_those_that_share_a_corner():
    random = np.random.default_rng(5)
    for _ in range(100):
        level = int(random.integers(0, 7))
        codes = np.unique(random.integers(0, 8**level, int(random.integers(1, 60))))
        cells = {tuple(cell) for cell in decode_cells(codes).tolist()}
        steps = [step for step in np.ndindex(3, 3, 3) if step != (1, 1, 1)]
        wide = {tuple(x + d - 1 for x, d in zip(cell, step, strict=True)) for cell in cells for step in steps}
        inside = sorted(cell for cell in wide - cells if min(cell) >= 0 and max(cell) < 2**level)
        expected = encode_cells(np.array(inside, np.int64).reshape(-1, 3))
        np.testing.assert_array_equal(boundary(codes, level), np.sort(expected))
        both = np.union1d(codes, expected)
        np.testing.assert_array_equal(with_boundary(codes, level), both)
        asked = random.integers(0, 8**level, 60)
        np.testing.assert_array_equal(near(asked, codes, level), np.isin(asked, both))
