"""Textures of another depth, and parts of textures."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import octex
from octex.channels import BASE_COLOR, ROUGHNESS, decode, encode
from octex.errors import ArgumentError
from octex.texture import Channel
from octex.tree.split import rows_of
from tests.conftest import needs_jit
from tests.make.same import assert_same
from tests.make.small_textures import eight_colors, shell
from tests.make.strategies import textures
from tests.oracles import naive_processing as naive
from tests.oracles.naive import unmorton
from tests.processing.test_processing_values import assert_averaged, assert_same_values
from tests.properties.edit_models import waved

CORNERS = st.tuples(*[st.floats(0, 1)] * 3)


@given(textures(6), st.integers(0, 6))
def test_a_coarser_texture_is_a_level(texture, depth):
    depth = min(depth, texture.tree.max_depth)
    shallow = [leaves for leaves, _ in texture.tree.cells_by_depth()[:depth]]
    assume(not any(shallow))
    made = octex.resize(texture, depth)
    made.validate()
    assert_same(made, texture.level(depth))


@needs_jit
@pytest.mark.parametrize("more", [1, 2])
def test_a_finer_texture_has_the_same_field_and_the_same_levels(more):
    texture = octex.cast(shell(3), "float32")
    made = octex.resize(texture, 3 + more)
    made.validate()
    assert made.tree.n_leaves == texture.tree.n_leaves * 8**more
    assert_same_values(made.level(3), texture)
    points = np.random.default_rng(0).random((400, 3))
    inside = points[texture.contains(points)]
    assert len(inside) > 50
    np.testing.assert_allclose(made.sample(inside), texture.sample(inside), atol=2e-6)


@needs_jit
@pytest.mark.parametrize("more", [1, 2])
def test_either_side_of_a_thin_sheet_looks_the_same_in_a_finer_texture(more):
    surface = waved("sheet", 4, ["base_color"], 7)
    texture = octex.convert(surface, 4, dtype="float32")
    made = octex.resize(texture, 4 + more)
    made.validate()
    found = surface.scatter(1000, 3)
    inside = texture.contains(found.rest)
    points, normals = found.rest[inside], found.normals[inside]
    before, after = (each.sample(points, normals=normals) for each in (texture, made))
    assert np.abs(before - after).max() < 0.03
    assert np.abs(before - texture.sample(points)).max() > 0.25


@given(textures(3))
def test_leaves_at_any_depth_are_divided_soundly_and_rows_stay_in_range(texture):
    assume(texture.tree.n_leaves)
    made = octex.resize(texture, texture.tree.max_depth + 1)
    made.validate()
    assert not any(leaves for leaves, _ in made.tree.cells_by_depth()[:-1])
    for name, channel in made.channels.items():
        if channel.format.space in ("srgb", "linear") or name == "alpha":
            assert channel.split_values.min(initial=0) >= 0, name
        if name == "alpha" and channel.format.dtype.startswith("float"):
            assert channel.split_values.max(initial=0) <= 1


def test_a_depth_that_cannot_be_is_refused():
    for depth in (-1, 22):
        with pytest.raises(ArgumentError, match="depth must be a whole number from 0 to 21"):
            octex.resize(eight_colors(), depth)
    with pytest.raises(ArgumentError, match=r"depth 21 takes .* more than a tree can hold"):
        octex.resize(eight_colors(), 21)


@given(textures(5), CORNERS, CORNERS)
def test_a_part_has_the_leaves_that_meet_the_box(texture, one, other):
    low, high = texture.placement.to_rest(np.array([np.minimum(one, other), np.maximum(one, other)]))
    box = texture.placement.to_texture_space([low, high])
    texture = naive.unfitted(texture)
    before = naive.cells_of(texture)
    wanted = []
    for (level, code), cell in before.items():
        place = np.array(unmorton(code))
        if cell.is_leaf and (place <= box[1] * 2**level).all() and (place + 1 > box[0] * 2**level).all():
            wanted.append((level, code))
    if not wanted:
        with pytest.raises(ArgumentError, match="no leaf of the texture meets the box"):
            octex.crop(texture, low, high)
        return
    made = octex.crop(texture, low, high)
    made.validate()
    after = naive.cells_of(made)
    assert [place for place, cell in after.items() if cell.is_leaf] == wanted
    for place in wanted:
        for name, channel in texture.channels.items():
            np.testing.assert_array_equal(
                made.channels[name].values[after[place].number], channel.values[before[place].number]
            )
    assert_averaged(made)
    assert made.placement == texture.placement


@needs_jit
def test_a_part_of_a_part_is_the_part_of_both_boxes():
    texture = octex.map(octex.cast(shell(4), "float32"), lambda values: 0.4 + 0.2 * values)  # stays positive
    twice = octex.crop(octex.crop(texture, (0, 0, 0), (0.6, 1, 1)), (0.2, 0.3, 0), (1, 1, 1))
    once = octex.crop(texture, (0.2, 0.3, 0), (0.6, 1, 1))
    np.testing.assert_array_equal(twice.tree.arrays.groups, once.tree.arrays.groups)
    np.testing.assert_array_equal(twice.bounds, once.bounds)
    for a, b in zip(twice.channels["base_color"][1:], once.channels["base_color"][1:], strict=True):
        np.testing.assert_allclose(a, b, atol=0.02)
    assert_same(octex.crop(texture, (0, 0, 0), (1, 1, 1)), texture)


def test_areas_of_cut_nodes_are_those_of_what_is_left():
    texture = eight_colors()
    tree = texture.tree.with_cell_data(texture.tree.arrays.flags, np.full(9, 207, np.uint8))
    made = octex.crop(eight_colors(tree=tree), (0, 0, 0), (0.3, 1, 1))
    assert made.tree.n_leaves == 4
    np.testing.assert_array_equal(made.tree.arrays.areas, 207)  # four quarters


@needs_jit
def test_rows_of_cut_nodes_have_the_areas_of_what_is_left():
    texture = octex.convert(waved("sheet", 4, ["base_color"], 7), 4, dtype="float32")
    low, high = texture.bounds
    made = octex.crop(texture, low, [(low[0] + high[0]) / 2, *high[1:]])
    tree, cells, found = made.tree, naive.cells_of(made), rows_of(made.tree.split)
    gone = naive.cells_of(texture).keys() - cells.keys()
    cut = {(place[0] - n, place[1] >> 3 * n) for place in gone for n in range(place[0] + 1)}
    rows = {(int(cell), int(bit)): int(row) for cell, bit, row in zip(*found[1:], found[0], strict=True)}
    tested = 0
    for place, cell in cells.items():
        below = [cells[each].number for each in naive.children_of(cells, place) if place in cut]
        for bit in (1 << n for n in range(6)):
            if not below or (cell.number, bit) not in rows:
                continue
            total = 0.0
            for each in below:
                facings = int(tree.arrays.flags[each]) & 0b111111
                if (each, bit) in rows:
                    total += naive.AREAS[tree.split.areas[rows[each, bit]]]
                elif facings & bit:
                    total += naive.AREAS[tree.arrays.areas[each]] / facings.bit_count()
            own = naive.AREAS[tree.split.areas[rows[cell.number, bit]]]
            assert abs(np.log2(own / (total / 4))) < 0.07  # half a step
            tested += 1
    assert tested > 5


@needs_jit
def test_nodes_that_lose_nothing_stay_to_the_last_bit():
    surface = waved("overlapping", 10, ["base_color", "alpha"], 99)
    half = octex.Transfer(surface.part(range(len(surface.triangles) // 2)), distance=0.45)
    texture = octex.convert(surface, 3, dtype="float32", fit=False, separate=1.0, sources=half.sources)
    made = octex.crop(texture, [-0.726, -0.683, 0.675], [1.3, 1.343, 2.701])
    then, now = naive.cells_of(texture), naive.cells_of(made)
    cut = {
        (place[0] - n, place[1] >> 3 * n) for place in then.keys() - now.keys() for n in range(place[0] + 1)
    }
    kept = [place for place, cell in now.items() if place not in cut and not cell.is_leaf]
    old, new = (np.array([cells[place].number for place in kept]) for cells in (then, now))
    assert old.size
    for name, channel in texture.channels.items():
        np.testing.assert_array_equal(made.channels[name].values[new], channel.values[old])
        one, other = (rows_of(each.tree.split, cells).rows for each, cells in ((texture, old), (made, new)))
        assert one.size
        np.testing.assert_array_equal(made.channels[name].split_values[other], channel.split_values[one])


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        ((0, 0, 0), (np.nan, 1, 1), "a finite lowest and highest corner"),
        ((1, 0, 0), (0, 1, 1), "a finite lowest and highest corner"),
        ((0, 0), (0, 1, 1), "low must be numbers of shape"),
        ((0, 0, 0), [(0, 1, 1), (1, 1, 1)], "high must be numbers of shape"),
        ((2, 2, 2), (3, 3, 3), "no leaf of the texture meets the box"),
    ],
)
def test_a_box_that_is_none_is_refused(low, high, message):
    with pytest.raises(ArgumentError, match=message):
        octex.crop(eight_colors(), low, high)


def test_what_is_left_of_a_node_is_not_darker_than_black():
    values = np.array([[0.4], *([[0.0]] * 4 + [[1.0]] * 4)], np.float32)  # the root is darker than its mean
    form = ROUGHNESS._replace(dtype="float32")
    texture = eight_colors(channels={"roughness": Channel(form, values, values[:0], values[:0])})
    made = octex.crop(texture, (0.1, 0.1, 0.1), (0.9, 0.9, 0.4))
    assert made.tree.n_leaves == 4
    assert made.channels["roughness"].values.min() == 0.0


@pytest.mark.parametrize("brightest", [1.0, 3.0])
def test_what_is_left_of_a_node_is_as_bright_as_the_texture_at_most(brightest):
    form = BASE_COLOR._replace(dtype="float32")
    light = np.array([0.9, *([0.0] * 4 + [1.0] * 4)])[:, None] * np.full(3, brightest)
    values = encode(light, form.dtype, form.space)  # the root is brighter than its mean
    texture = eight_colors(channels={"base_color": Channel(form, values, values[:0], values[:0])})
    for low, high, root in ((0.1, 0.4, 0.4), (0.6, 0.9, 1.0)):
        made = octex.crop(texture, (0.1, 0.1, low), (0.9, 0.9, high)).channels["base_color"]
        np.testing.assert_allclose(decode(made.values[0], form.space), root * brightest, rtol=1e-5)
