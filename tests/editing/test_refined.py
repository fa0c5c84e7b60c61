"""Coefficients of cells that are not stored, beside the slow reference, and what they are for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex.channels import ChannelFormat
from octex.field import walk_taps
from octex.field.walk_taps import refined_taps
from octex.texture import Channel, OctreeTexture
from octex.tree.edit import raised
from octex.tree.octree import Octree
from tests.make.small_textures import UNIT, UNIT_BOUNDS
from tests.make.strategies import leaf_sets, points_around, random_channel, with_random_data
from tests.make.taps import spread
from tests.oracles import naive

Codes = npt.NDArray[np.int64]
HEIGHT = ChannelFormat("height", 2, "data", "float32")
seeds = st.integers(0, 2**32 - 1)


class Drawn(NamedTuple):
    tree: Octree
    codes: dict[int, Codes]  # by level, in any order: cells below leaves, one to three levels
    beside: dict[int, Codes]  # cells that are not stored, whose parents are neither


@st.composite
def trees_and_cells(draw):
    leaves = draw(leaf_sets())
    keep = draw(st.sampled_from([0.0, 0.3, 1.0]))
    seed = draw(seeds)
    tree = with_random_data(Octree.from_leaves(*leaves), seed, keep)
    random = np.random.default_rng(seed)
    below = {}
    around = {}
    places = leaves.places()
    for level, place in [places[n] for n in random.permutation(len(places))[:4]]:
        for down in range(1, min(3, naive.MAX_DEPTH - level) + 1):
            own = [(i << down) + int(random.integers(1 << down)) for i in place]
            below.setdefault(level + down, []).append(naive.morton(own))
            near = [i + int(random.integers(-2 << down, (2 << down) + 1)) for i in own]
            near = [min(max(i, 0), (1 << level + down) - 1) for i in near]
            around.setdefault(level + down, []).append(naive.morton(near))
    nodes = {
        (level, code)
        for level, (codes, is_node) in enumerate(tree.walk())
        for code in codes[is_node].tolist()
    }
    return Drawn(
        tree,
        {level: np.array(codes) for level, codes in below.items()},
        {
            level: np.array([code for code in codes if (level - 1, code >> 3) not in nodes], np.int64)
            for level, codes in around.items()
        },
    )


@given(trees_and_cells())
def test_cells_below_leaves_and_in_empty_places_are_refined_as_by_the_reference(drawn):
    field = naive.field_of(drawn.tree, "quadratic")
    for level, codes in [*drawn.codes.items(), *drawn.beside.items()]:
        starts, rows, weights = refined_taps(drawn.tree, codes, level)
        assert (starts[0], starts[-1]) == (0, rows.size) and rows.size == weights.size
        assert weights.min(initial=0) >= 0
        found = spread(starts, rows, weights, len(field.values))
        for own, count, code in zip(found, np.diff(starts), codes.tolist(), strict=True):
            *expected, total = field.refined(level, naive.unmorton(code))
            assert (count > 0) == (total > 0)
            np.testing.assert_allclose(own, np.array(expected) / (total or 1), rtol=0, atol=1e-6)


@given(trees_and_cells(), seeds)
def test_what_is_refined_to_a_cell_does_not_depend_on_the_cells_before_it(drawn, seed):
    random = np.random.default_rng(seed)
    for level in drawn.codes:
        codes = random.permutation(np.concatenate([drawn.codes[level], drawn.beside[level]]))
        starts, rows, weights = refined_taps(drawn.tree, codes, level)
        for n in range(codes.size):
            alone = refined_taps(drawn.tree, codes[n : n + 1], level)
            here = slice(starts[n], starts[n + 1])
            assert alone[0].tolist() == [0, starts[n + 1] - starts[n]]
            assert np.array_equal(alone[1], rows[here])
            assert np.array_equal(alone[2], weights[here])


def test_no_cells_have_no_taps():
    starts, rows, weights = refined_taps(Octree.from_leaves(np.arange(8), 1), np.empty(0, np.int64), 2)
    assert (starts.tolist(), rows.tolist(), weights.tolist()) == ([0], [], [])


def test_below_the_root_alone_all_is_the_roots():
    tree = Octree.from_leaves(np.zeros(1, np.int64), 0)
    for level in (1, 2, 21):
        starts, rows, weights = refined_taps(tree, np.array([8**level - 1, 0]), level)
        assert (starts.tolist(), rows.tolist(), weights.tolist()) == ([0, 1, 2], [0, 0], [1.0, 1.0])


def test_cells_found_in_several_batches_are_those_found_at_once(monkeypatch):
    tree = with_random_data(Octree.from_leaves(np.arange(0, 512, 3), 3), 1, 0.3)
    codes = np.random.default_rng(2).permutation(512)
    codes = codes[codes % 3 == 0][:150] * 8 + 5
    at_once = refined_taps(tree, codes, 4)
    monkeypatch.setattr(walk_taps, "_CELLS_AT_ONCE", 1)
    assert at_once[1].size > 27
    for own, expected in zip(refined_taps(tree, codes, 4), at_once, strict=True):
        assert own.dtype == expected.dtype
        assert np.array_equal(own, expected)


# --- what they are for: raised leaves do not move the field


def textured(tree, seed):
    channel = random_channel(HEIGHT, tree, np.random.default_rng(seed))
    return OctreeTexture(tree, {"height": channel}, UNIT, UNIT_BOUNDS)


def raise_leaves(texture, wanted, met):
    """Raise a texture's tree: new cells have the refined values, nodes that were leaves keep theirs."""
    tree, channel = texture.tree, texture.channels["height"]
    edited = raised(tree, wanted, met, [])
    old_rows = np.concatenate([channel.values, channel.kept_values])
    values = edited.carried(channel.values)
    for level, (codes, _) in enumerate(edited.tree.walk()):
        first = int(edited.tree.arrays.level_cells[level])
        new = np.flatnonzero(edited.old[first : first + codes.size] < 0)
        starts, rows, weights = refined_taps(tree, codes[new], level)
        assert (np.diff(starts) > 0).all()
        terms = weights[:, None].astype(np.float64) * old_rows[rows]
        values[first + new] = np.add.reduceat(terms, starts[:-1]) if new.size else terms
    kept = dict(zip(tree.kept.cells.tolist(), channel.kept_values, strict=True))
    kept_values = np.empty((edited.tree.kept.cells.size, 2), np.float32)
    for row, cell in enumerate(edited.tree.kept.cells.tolist()):
        kept_values[row] = kept.get(int(edited.old[cell]), values[cell])
    made = Channel(HEIGHT, values, channel.split_values[edited.split_rows], kept_values)
    return OctreeTexture(edited.tree, {"height": made}, UNIT, UNIT_BOUNDS)


def some_below(tree, part, all_children, random):
    """Wanted cells one or two levels below a part of the leaves, and the cells met: all children, or some."""
    wanted = [[] for _ in range(tree.max_depth + 3)]
    met = [[] for _ in wanted]
    for level, (codes, is_node) in enumerate(tree.walk()):
        for code in codes[~is_node].tolist():
            nodes = [code] if random.random() < part else []
            for below in range(level + 1, level + 1 + int(random.integers(1, 3))):
                found = []
                for node in nodes:
                    octants = random.permutation(8)[: 8 if all_children else int(random.integers(1, 9))]
                    found += [node << 3 | int(octant) for octant in octants]
                    wanted[below].append(found[-1])
                met[below] += found
                nodes = found[::3]
    return ascending(wanted), ascending(met)


def ascending(codes):
    return [np.array(sorted(of_level), np.int64) for of_level in codes]


def assert_unmoved(before, after, points):
    expected = before.sample(points, "height", "quadratic")
    np.testing.assert_allclose(after.sample(points, "height", "quadratic"), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("all_children", [True, False])
@given(st.data())
def test_leaves_raised_to_refined_values_do_not_move_the_quadratic_field(all_children, data):
    leaves = data.draw(leaf_sets(deepest=6, most=12))
    seed = data.draw(seeds)
    random = np.random.default_rng(seed)
    keep = data.draw(st.sampled_from([0.0, 0.4, 1.0]))
    points = np.array(data.draw(st.lists(points_around(leaves), min_size=1, max_size=6)))
    inside = [
        (np.array(place) + random.random(3)) / 2.0**level
        for level, place in leaves.places()
        for _ in range(8)
    ]
    points = np.round(np.concatenate([points, np.reshape(inside, (-1, 3))]) * 2.0**24) / 2.0**24
    before = textured(with_random_data(Octree.from_leaves(*leaves), seed, keep), seed)
    once = raise_leaves(before, *some_below(before.tree, 0.5, all_children, random))
    twice = raise_leaves(once, *some_below(once.tree, 0.2, all_children, random))
    assert_unmoved(before, once, points)
    assert_unmoved(before, twice, points)
