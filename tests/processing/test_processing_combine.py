"""Two textures in one."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import octex
from octex.channels import ALPHA, BASE_COLOR, NORMAL, ROUGHNESS, ChannelFormat, decode, encode
from octex.errors import ArgumentError
from octex.texture import Channel, OctreeTexture
from octex.tree.areas import SKIRT
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from octex.tree.split import rows_of
from tests.conftest import needs_jit
from tests.make.same import assert_same
from tests.make.small_textures import UNIT, UNIT_BOUNDS, eight_colors, shell
from tests.make.solids import cube
from tests.make.strategies import leaf_sets, random_channel, with_random_data
from tests.oracles import naive_processing as naive
from tests.properties.edit_claims import cells_of
from tests.properties.edit_models import waved

COLOR = ChannelFormat("base_color", 3, "srgb")
AMOUNTS = st.sampled_from([0.0, 0.3, 0.5, 1.0])


def texture_of(tree, seed, *forms):
    random = np.random.default_rng(seed)
    channels = {form.name: random_channel(form, tree, random) for form in forms}
    return OctreeTexture(tree, channels, UNIT, UNIT_BOUNDS, {"seed": str(seed)})


@st.composite
def pairs(draw):
    """Two textures of one root cell; both, one or none have alpha."""
    found = []
    for _ in range(2):
        seed = draw(st.integers(0, 2**31))
        tree = with_random_data(Octree.from_leaves(*draw(leaf_sets(4, 12))), seed)
        forms = [COLOR, ALPHA] if draw(st.booleans()) else [COLOR]
        found.append(naive.unfitted(texture_of(tree, seed, *forms)))
    return found[0], found[1]


def assert_mixed(made, found, name):
    """Leaves are as the reference has them, and nodes the means of their children."""
    cells = naive.cells_of(made)
    assert list(cells) == found.places
    channel = made.channels[name]
    most = 1.5 / 255 if name == "alpha" else 0.01  # of linear light: a code and a half where it is steepest
    for place, cell in cells.items():
        value = naive.value_at(made, name, cells, place)
        if cell.is_leaf:
            np.testing.assert_allclose(value, np.clip(found.values[place], 0, 1), atol=most)
        elif made.tree.n_leaves:
            mean = naive.mean_below(made, name, cells, place)
            wanted = encode(mean, "uint8", channel.format.space)
            np.testing.assert_allclose(channel.values[cell.number], wanted, atol=1)


@given(pairs(), AMOUNTS)
def test_a_mixture_equals_the_slow_one(both, amount):
    made = octex.mix(*both, amount)
    made.validate()
    if all(each.tree.n_leaves for each in both):
        for name in both[0].channels.keys() & both[1].channels.keys():
            assert_mixed(made, naive.mixed(*both, amount, name), name)


@given(pairs())
def test_one_over_the_other_equals_the_slow_one(both):
    made = octex.combine(*both, over=True)
    made.validate()
    if all(each.tree.n_leaves for each in both):
        over = "alpha" in both[1].channels
        assert_mixed(made, naive.mixed(*both, 1.0, "base_color", over=over), "base_color")


@given(pairs())
def test_to_combine_without_alpha_is_to_mix_wholly(both):
    assert_same(octex.combine(*both), octex.mix(*both, 1.0))
    for texture in both:
        assert_same(octex.combine(texture, texture), texture)
        if "alpha" not in texture.channels:
            assert_same(octex.mix(texture, texture, 0.3), texture)


def test_what_does_not_meet_stays_as_it_was():
    whole = shell(4)
    left = octex.crop(whole, (0, 0, 0), (0.49, 1, 1))
    right = octex.crop(whole, (0.51, 0, 0), (1, 1, 1))
    made = octex.combine(left, right)
    made.validate()
    assert made.tree.n_leaves == left.tree.n_leaves + right.tree.n_leaves
    parts = naive.cells_of(left), naive.cells_of(right)
    for place, cell in naive.cells_of(made).items():
        of = [(each, cells) for each, cells in zip((left, right), parts, strict=True) if place in cells]
        if len(of) == 1:
            own, cells = of[0]
            number = cells[place].number
            assert made.tree.arrays.areas[cell.number] == own.tree.arrays.areas[number]
            assert made.tree.arrays.flags[cell.number] == own.tree.arrays.flags[number]
            np.testing.assert_array_equal(
                made.channels["base_color"].values[cell.number], own.channels["base_color"].values[number]
            )


@needs_jit
@pytest.mark.parametrize("kind", ["sheet", "overlapping"])
def test_what_prevails_everywhere_is_the_result_also_over_what_is_finer(kind):
    surface = waved(kind, 4, ["base_color"], 7)
    texture = octex.convert(surface, 4)
    place = octex.Sphere(tuple(surface.rest[0]), 0.5)
    finer = octex.fill(texture, surface, place, (1, 0, 0), max_depth=6)  # with skirts and finer facings
    samples = surface.scatter(2000, 0)
    for one, other in ((texture, finer), (finer, texture)):
        for made in (octex.mix(one, other, 0), octex.mix(other, one, 1), octex.combine(other, one)):
            for normals in (None, samples.normals):
                wanted = one.sample(samples.rest, normals=normals)
                np.testing.assert_array_equal(made.sample(samples.rest, normals=normals), wanted)
    assert_same(octex.mix(texture, finer, 0), texture)


@needs_jit
def test_skirts_far_from_what_lies_on_top_stay():
    surface = waved("flat", 5, ["base_color"], 94)
    place = octex.Sphere((0.0, 0.0, 0.0), 0.5)
    finer = octex.fill(octex.convert(surface, 3), surface, place, (1, 0, 0), max_depth=4)
    texture = octex.resize(finer, 5)  # skirts among skirts
    assert (texture.tree.arrays.areas == SKIRT).sum() > 1000
    part = octex.crop(texture, (0.02, 0.02, -0.1), (0.03, 0.03, 0.1))
    cells, left, top = (cells_of(each) for each in (texture, octex.combine(texture, part), part))
    gone = ~np.isin(cells.keys, left.keys)
    edge = texture.placement.size / 8  # of the largest leaves that were divided
    assert (cells.high[gone] <= top.high[top.is_leaf].max(axis=0) + edge).all()
    assert (cells.low[gone] >= top.low[top.is_leaf].min(axis=0) - edge).all()


def test_rows_are_mixed_facing_by_facing():
    one, other = shell(3), octex.map(shell(3), lambda values: 1 - values)
    made = octex.mix(one, other, 0.5)
    assert made.tree.split.cells.size == one.tree.split.cells.size > 0
    light = decode(made.channels["base_color"].split_values, "srgb")
    np.testing.assert_allclose(light, 0.5, atol=0.01)
    np.testing.assert_array_equal(made.tree.split.areas, one.tree.split.areas)


def test_an_amount_can_differ_from_place_to_place():
    dark = octex.map(eight_colors(), np.zeros_like)
    light = octex.map(eight_colors(), np.ones_like)
    by_function = octex.mix(dark, light, lambda points: 2 * points[:, 0] - 0.5)
    values = by_function.channels["base_color"].values[1:, 0]
    np.testing.assert_array_equal(values, [0, 255] * 4)
    form = ROUGHNESS
    codes = np.full((9, 1), 51, np.uint8)
    mask = OctreeTexture(
        dark.tree, {form.name: Channel(form, codes, codes[:0], codes[:0])}, UNIT, UNIT_BOUNDS
    )
    by_texture = octex.mix(dark, light, mask)
    np.testing.assert_allclose(by_texture.sample([[0.2, 0.2, 0.2]]), 0.2, atol=0.003)
    assert json.loads(by_texture.metadata["processed"])[-1]["amount"] == "a texture"
    assert json.loads(by_function.metadata["processed"])[-1]["amount"] == "a function"


def test_channels_are_those_in_common_as_the_first_stores_them():
    tree = eight_colors().tree
    first = texture_of(tree, 0, BASE_COLOR, ROUGHNESS)
    second = octex.cast(texture_of(tree, 1, ROUGHNESS, BASE_COLOR, ALPHA), "float32")
    made = octex.combine(first, second)
    assert [(each.format.name, each.format.dtype) for each in made.channels.values()] == [
        ("base_color", "uint8"),
        ("roughness", "uint8"),
        ("alpha", "float32"),
    ]
    np.testing.assert_array_equal(
        made.channels["base_color"].values[1:], octex.cast(second, "uint8").channels["base_color"].values[1:]
    )
    np.testing.assert_array_equal(octex.combine(second, first).channels["alpha"].values, 1.0)


def test_an_empty_texture_adds_nothing():
    full = eight_colors()
    empty_tree = Octree.from_leaves(np.empty(0, np.int64), 0)
    empty = texture_of(empty_tree, 0, BASE_COLOR)
    assert_same(octex.combine(empty, full), full)
    assert_same(octex.mix(full, empty, 1.0), full)


def test_what_cannot_be_put_together_is_refused():
    full = eight_colors()
    moved = eight_colors(placement=Placement((1.0, 0.0, 0.0), 1.0))
    apart = eight_colors(metadata={"separation": "{}"})
    rough = texture_of(full.tree, 0, ROUGHNESS)
    strange = texture_of(full.tree, 0, NORMAL._replace(name="base_color"))
    for call, others, message in (
        (octex.combine, [moved], "root cells differ"),
        (octex.combine, [apart], "separate both or neither"),
        (octex.mix, [rough], "no channel in common: base_color and roughness"),
        (octex.mix, [strange], "3 components of srgb in one texture and 3 of direction"),
        (octex.mix, [full, 2.0], "amount must be from 0 to 1"),
        (octex.mix, [full, full], "one channel of one component, not of base_color"),
        (octex.mix, [full, lambda points: points], r"shape \(8,\), not \(8, 3\)"),
        (octex.mix, [full, lambda points: np.where(points[:, 0] > 0.5, np.nan, 0)],
         r"the amount returned nan at \(0.75, 0.25, 0.25\)"),
        (octex.mix, [full, lambda points: len(points) // 0], "the amount raised ZeroDivisionError"),
    ):  # fmt: skip
        with pytest.raises(ArgumentError, match=message):
            call(full, *others)


@needs_jit
def test_a_part_laid_over_its_whole_leaves_what_nodes_show_each_way():
    points, triangles = cube((0, 0, 0))
    hues = np.random.default_rng(0).random((len(triangles), 3))
    texture = octex.convert(octex.Surface.from_arrays(points, triangles, face_colors=hues), 3, fit=False)
    part = octex.crop(texture, (0.5, 0.5, 0.5), (1.1, 1.1, 1.1))  # which shows three ways of six
    made = octex.combine(texture, part)
    np.testing.assert_array_equal(made.tree.split.cells, texture.tree.split.cells)
    rows = made.channels["base_color"].split_values.astype(float)
    np.testing.assert_allclose(rows, texture.channels["base_color"].split_values, atol=2)


@needs_jit
def test_two_parts_put_together_have_the_areas_of_their_whole_in_rows_too():
    surface = waved("sheet", 4, ["base_color"], 7)
    whole = octex.convert(surface, 4, dtype="float32")
    low, high = whole.bounds
    cut = low[2] + 0.65 * (high[2] - low[2])  # inside nodes
    below, beyond = octex.crop(whole, low, (*high[:2], cut)), octex.crop(whole, (*low[:2], cut), high)
    found = octex.combine(below, beyond).tree.split
    np.testing.assert_array_equal(found.cells, whole.tree.split.cells)
    apart = found.areas.astype(int) - whole.tree.split.areas
    assert np.abs(apart).max() <= 3


@needs_jit
@pytest.mark.parametrize("kind", ["sheet", "overlapping"])
def test_cells_below_leaves_show_each_way_what_a_finer_texture_shows(kind):
    texture = octex.convert(waved(kind, 4, ["base_color", "alpha"], 7), 3, dtype="float32")
    finer = octex.resize(texture, 4)
    made = octex.mix(texture, finer, lambda points: np.zeros(len(points)))
    assert finer.tree.split.cells.size > texture.tree.split.cells.size > 0
    for one, other in zip(
        [*made.tree.arrays, *made.tree.split], [*finer.tree.arrays, *finer.tree.split], strict=True
    ):
        np.testing.assert_array_equal(one, other)
    of_leaves = np.isin(rows_of(finer.tree.split).cells, finer.tree.leaf_cells())
    assert of_leaves.sum() > 20
    for name, channel in finer.channels.items():
        rows = made.channels[name].split_values[of_leaves]
        np.testing.assert_allclose(rows, channel.split_values[of_leaves], atol=1e-6)
