"""Rows of split cells read and changed, beside dicts of them."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from octex.channels import decode
from octex.editing.split import refaced, rows_facing, with_split
from octex.texture import Channel, OctreeTexture
from octex.tree.edit import cull, facings_of_nodes
from octex.tree.layout import FACING_FLAGS, SPLIT, SplitTable
from octex.tree.octree import Octree
from octex.tree.split import bits_of
from tests.make.small_textures import eight_colors, shell
from tests.make.strategies import random_values, textures

Rows = dict[tuple[int, int], int]  # (cell, facing flag): row
seeds = st.integers(0, 2**32 - 1)


def bits_in(facings):
    return [1 << n for n in range(6) if facings >> n & 1]


def rows_of(split):
    pairs = zip(split.cells.tolist(), split.facings.tolist(), strict=True)
    keys = [(cell, bit) for cell, facings in pairs for bit in bits_in(facings)]
    return {key: row for row, key in enumerate(keys)}


def assert_stored(found, expected, channel):
    """Values of sRGB floats pass through linear light, and are as good as before; others are exact."""
    assert found.dtype == expected.dtype
    if channel.format.space == "srgb" and found.dtype.kind == "f":
        np.testing.assert_allclose(found.astype(float), expected.astype(float), rtol=0, atol=1e-6)
    else:
        assert np.array_equal(found, expected)


def skirt_facings(tree):
    """The facings (cells,) that leaves have, the cell or below it, none of which has surface."""
    found, surface = np.zeros((2, tree.n_cells), np.uint8)
    levels, first = [], 0
    for codes, is_node in tree.walk():
        levels.append((codes, first))
        leaves = np.flatnonzero(~is_node) + first
        found[leaves] = tree.arrays.flags[leaves] & FACING_FLAGS
        surface[leaves] = np.where(tree.arrays.areas[leaves] == 1, 0, found[leaves])
        first += codes.size
    for (codes, first), (above, first_above) in zip(levels[:0:-1], levels[-2::-1], strict=True):
        owners = first_above + np.searchsorted(above, codes >> 3)
        for each in (found, surface):
            np.bitwise_or.at(each, owners, each[first : first + codes.size])
    return found & ~surface


def check(made, texture, given_rows):
    """Rows that are given are there; others are as they were, or like their cells."""
    old, rows = rows_of(texture.tree.split), rows_of(made.tree.split)
    areas, skirts = made.tree.arrays.areas, skirt_facings(made.tree)
    for (cell, bit), row in rows.items():
        count = int(made.tree.split.facings[made.tree.split.cells == cell][0]).bit_count()
        area = made.tree.split.areas[row]
        if (cell, bit) in old:
            assert area == texture.tree.split.areas[old[cell, bit]]
        elif skirts[cell] & bit:
            assert area == 1
        elif areas[cell] == 0:
            assert area == 0
        else:  # steps of 2^(1/8), see octex/tree/layout.py
            share = 2 ** (int(areas[cell]) / 8) / count
            assert 1 <= area <= 255
            assert abs(8 * np.log2(share) - area) <= 0.5 + 1e-9 or (share < 2 ** (1 / 8) and area == 1)
    assert list(made.channels) == list(texture.channels)
    for name, channel in texture.channels.items():
        after = made.channels[name]
        assert after.format == channel.format
        assert np.array_equal(after.values, channel.values)
        assert np.array_equal(after.kept_values, channel.kept_values)
        for key, row in rows.items():
            if key in given_rows.get(name, {}):
                assert np.array_equal(after.split_values[row], given_rows[name][key])
            elif key in old:
                assert_stored(after.split_values[row], channel.split_values[old[key]], channel)
            else:
                assert_stored(after.split_values[row], channel.values[key[0]], channel)
    assert made.placement == texture.placement
    assert np.array_equal(made.bounds, texture.bounds)
    assert made.metadata == texture.metadata


@given(st.lists(st.integers(0, 63)))
def test_the_bits_of_facings_come_cell_by_cell_from_the_lowest_on(facings):
    found = bits_of(np.array(facings, np.uint8))
    assert found.dtype == np.uint8
    assert found.tolist() == [bit for each in facings for bit in bits_in(each)]


def test_flags_that_are_no_facings_have_no_bits():
    assert bits_of(np.array([0b11000001, 0b11000000], np.uint8)).tolist() == [1]


@given(textures(deepest=8), seeds)
def test_a_cell_shows_each_way_its_row_or_its_value(texture, seed):
    random = np.random.default_rng(seed)
    rows = rows_of(texture.tree.split)
    cells = random.integers(0, texture.tree.n_cells, 60)
    cells = np.concatenate([cells, np.array([cell for cell, _ in rows], np.int64)])
    bits = np.uint8(1) << random.integers(0, 6, cells.size).astype(np.uint8)
    for channel in texture.channels.values():
        values = decode(channel.values, channel.format.space)
        split_values = decode(channel.split_values, channel.format.space)
        found = rows_facing(texture, channel, cells, bits)
        assert found.shape == (cells.size, channel.format.components)
        for own, key in zip(found, zip(cells.tolist(), bits.tolist(), strict=True), strict=True):
            assert np.array_equal(own, split_values[rows[key]] if key in rows else values[key[0]])


def test_no_cells_show_nothing():
    for texture in (shell(2), eight_colors()):
        channel = texture.channels["base_color"]
        none = rows_facing(texture, channel, np.empty(0, np.int64), np.empty(0, np.uint8))
        assert none.shape == (0, 3)


@given(textures(deepest=8), seeds)
def test_cells_that_are_split_have_given_rows_and_others_are_kept(texture, seed):
    """Cells that were split before or not, with their own facings or others, in one channel or all."""
    random = np.random.default_rng(seed)
    tree = texture.tree
    cells = np.flatnonzero(random.random(tree.n_cells) < random.choice([0.0, 0.3, 1.0]))
    facings = tree.arrays.flags[cells] & np.uint8(FACING_FLAGS)
    is_other = random.random(cells.size) < random.choice([0.0, 0.5])
    facings[is_other] = random.integers(0, FACING_FLAGS + 1, int(is_other.sum()))
    keys = [
        (cell, bit)
        for cell, each in zip(cells.tolist(), facings.tolist(), strict=True)
        for bit in bits_in(each)
    ]
    given_rows = {
        name: random_values((len(keys), channel.format.components), channel.format.dtype, random)
        for name, channel in texture.channels.items()
        if random.random() < 0.5
    }
    flags = tree.arrays.flags.copy()
    made = with_split(texture, cells, facings, given_rows)
    assert np.array_equal(tree.arrays.flags, flags)

    stays = [cell for cell in tree.split.cells.tolist() if cell not in set(cells.tolist())]
    expected = {cell: int(flags[cell]) & FACING_FLAGS for cell in stays}
    expected |= dict(zip(cells.tolist(), facings.tolist(), strict=True))
    assert made.tree.split.cells.tolist() == sorted(expected)
    assert made.tree.split.facings.tolist() == [expected[cell] for cell in sorted(expected)]
    assert made.tree.split.areas.size == sum(each.bit_count() for each in expected.values())
    flags[cells] |= SPLIT
    assert np.array_equal(made.tree.arrays.flags, flags)
    assert np.array_equal(made.tree.arrays.areas, tree.arrays.areas)
    assert np.array_equal(made.tree.kept.cells, tree.kept.cells)
    check(made, texture, {name: dict(zip(keys, rows, strict=True)) for name, rows in given_rows.items()})
    if not is_other.any():
        made.tree.validate()


def test_a_cells_area_is_shared_among_its_facings():
    texture = eight_colors()
    flags, areas = np.zeros((2, 9), np.uint8)
    flags[[0, 3, 5, 7]] = 0b110011, 0b110000, 0b11, 0b11
    areas[[0, 3, 7]] = 207, 100, 3
    tree = texture.tree.with_cell_data(flags, areas)
    texture = eight_colors(tree=tree)
    cells = np.array([0, 3, 5, 7])
    made = with_split(texture, cells, flags[cells], {})
    assert made.tree.split.areas.tolist() == [191] * 4 + [92] * 2 + [0] * 2 + [1] * 2
    assert (
        made.channels["base_color"].split_values[:, 0].tolist() == [100] * 4 + [20] * 2 + [40] * 2 + [60] * 2
    )
    made.tree.validate()


def test_a_facing_that_only_skirts_have_gets_their_area():
    texture = eight_colors()
    flags, areas = np.full(9, 0b1, np.uint8), np.full(9, 100, np.uint8)
    flags[[0, 2, 5]] = 0b111, 0b11, 0b110
    areas[5] = 1
    texture = eight_colors(tree=texture.tree.with_cell_data(flags, areas))
    made = with_split(texture, np.array([0]), flags[:1], {})
    assert made.tree.split.areas.tolist() == [87, 87, 1]


@given(textures(deepest=8))
def test_a_texture_whose_nodes_face_as_their_children_do_is_left_alone(texture):
    assert refaced(texture) is texture


@given(textures(deepest=8), seeds)
def test_nodes_are_made_to_face_as_their_children_do_and_gain_and_lose_rows(texture, seed):
    """Leaves face other ways than they did."""
    random = np.random.default_rng(seed)
    tree = texture.tree
    assume(tree.n_leaves and tree.n_nodes)
    flags = tree.arrays.flags.copy()
    leaves = np.setdiff1d(tree.leaf_cells(), tree.split.cells)
    leaves = leaves[random.random(leaves.size) < 0.7]
    flags[leaves] = random.integers(0, 2, leaves.size) << random.integers(0, 6, leaves.size)
    tree = tree.with_cell_data(flags, tree.arrays.areas, tree.split, tree.kept)
    turned = OctreeTexture(tree, texture.channels, texture.placement, texture.bounds, texture.metadata)
    made = refaced(turned)
    assert np.array_equal(made.tree.arrays.flags, facings_of_nodes(tree))
    assert np.array_equal(made.tree.split.cells, tree.split.cells)
    expected = made.tree.arrays.flags[tree.split.cells] & FACING_FLAGS
    assert np.array_equal(made.tree.split.facings, expected)
    assert np.array_equal(made.tree.kept.cells, tree.kept.cells)
    check(made, turned, {})
    made.tree.validate()


@given(textures(deepest=8), seeds)
def test_a_culled_texture_is_sound_once_it_is_refaced(texture, seed):
    tree = texture.tree
    chosen = np.random.default_rng(seed).random(tree.n_cells) < 0.4
    assume(chosen[tree.leaf_cells()].any())
    edited = cull(tree, chosen)
    channels = {
        name: Channel(
            channel.format,
            edited.carried(channel.values),
            channel.split_values[edited.split_rows],
            channel.kept_values[edited.kept_rows],
        )
        for name, channel in texture.channels.items()
    }
    culled = OctreeTexture(edited.tree, channels, texture.placement, texture.bounds)
    made = refaced(culled)
    made.tree.validate()
    check(made, culled, {})


@pytest.mark.parametrize("facings", [0, 0b1])
def test_a_split_node_can_come_to_face_no_way_or_one(facings):
    tree = Octree.from_leaves(np.arange(8), 1)
    flags = np.full(9, 0b11, np.uint8)
    flags[0] |= SPLIT
    split = SplitTable(np.zeros(1, np.uint32), np.full(1, 0b11, np.uint8), np.array([7, 9], np.uint8))
    flags[1:] = facings
    base = eight_colors().channels["base_color"]
    values = np.array([[1] * 3, [2] * 3], np.uint8)
    texture = eight_colors(
        tree=tree.with_cell_data(flags, tree.arrays.areas, split),
        channels={"base_color": base._replace(split_values=values)},
    )
    made = refaced(texture)
    made.tree.validate()
    assert made.tree.split.facings.tolist() == [facings]
    assert made.tree.split.areas.tolist() == [7][:facings]
    assert made.channels["base_color"].split_values.tolist() == [[1] * 3][:facings]
