import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex import channels as channel_meaning
from octex.channels import ALPHA, BASE_COLOR, NORMAL
from octex.errors import ArgumentError
from octex.texture import FILTERS, Channel
from octex.texture.channel import as_channels
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from tests.make.small_textures import eight_colors, shell
from tests.make.strategies import textures
from tests.oracles import naive

# --- lookups


def normalized(vector):
    length = math.hypot(*vector)
    return [x / length for x in vector] if length else vector


@given(textures(), st.integers(0, 2**32 - 1))
def test_a_sample_is_the_decoded_value_of_the_nearest_cell(texture, seed):
    cells = naive.cells_in(texture.tree)
    random = np.random.default_rng(seed)
    chosen = [cells[n] for n in random.integers(0, len(cells), 6)]
    inside = np.array([(np.array(cell.place) + random.random(3) * 1.5) / 2**cell.level for cell in chosen])
    points = texture.placement.to_rest(np.concatenate([inside, random.random((3, 3)) * 2 - 0.5]))
    numbers = [naive.nearest(cells, point) for point in texture.placement.to_texture_space(points).tolist()]
    samples = texture.sample(points, list(texture.channels), "nearest", normalize=False)
    for name, (form, values, *_) in texture.channels.items():
        expected = channel_meaning.decode(values[numbers], form.space)
        assert samples[name].dtype == np.float32
        assert np.array_equal(samples[name], expected)
        assert np.array_equal(texture.sample(points, name, "nearest", normalize=False), expected)
        if form.space == "direction":
            expected = np.array([normalized(row) for row in expected.tolist()])
        assert np.allclose(texture.sample(points, name, "nearest"), expected, rtol=0, atol=1e-6)


def directed(values, dtype):
    """Depth 1; the first leaves hold directions."""
    tree = Octree.from_leaves(np.arange(len(values)), 1)
    stored = channel_meaning.encode(np.array([[0.0, 0.0, 1.0], *values]), dtype, "direction")
    form = NORMAL._replace(dtype=dtype)
    return eight_colors(tree=tree, channels={"normal": Channel(form, stored, stored[:0], stored[:0])})


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float16", "float32"])
def test_directions_come_back_as_unit_vectors_unless_their_lengths_are_asked_for(dtype):
    texture = directed([[0.0, -0.3, 0.4], [-1.0, 0.0, 0.0]], dtype)
    points = [[0.1, 0.1, 0.1], [0.9, 0.1, 0.1]]
    precision = 0.01 if dtype == "uint8" else 1e-3
    units = texture.sample(points, ["normal"], "nearest")["normal"]
    assert np.allclose(units, [[0, -0.6, 0.8], [-1, 0, 0]], atol=2 * precision)
    lengths = np.linalg.norm(units, axis=1)
    assert np.allclose(lengths, 1, rtol=0, atol=1e-6)
    means = texture.sample(points, "normal", "nearest", normalize=False)
    assert np.allclose(means, [[0, -0.3, 0.4], [-1, 0, 0]], atol=precision)


def test_a_direction_that_cancels_out_stays_zero():
    texture = directed([[0.0, 0.0, 0.0], [0.0, 0.0, -0.0], [1e-30, 0.0, 0.0]], "float32")
    points = [[0.1, 0.1, 0.1], [0.9, 0.1, 0.1], [0.1, 0.9, 0.1]]
    assert texture.sample(points, "normal", "nearest").tolist() == [[0, 0, 0], [0, 0, 0], [1, 0, 0]]


def test_samples_are_taken_at_rest_positions():
    moved = eight_colors(placement=Placement((10.0, 20.0, 30.0), 4.0))
    for name in FILTERS:
        there = moved.sample([[13.0, 21.0, 31.0]], filter=name)
        assert np.array_equal(there, eight_colors().sample([[0.75, 0.25, 0.25]], filter=name))


def test_every_point_has_a_value_however_far():
    texture = eight_colors()
    far = texture.sample([[1e30, -1e30, 1e30], [-0.0, 1.0, 1.0]], filter="nearest")
    assert np.array_equal(far, texture.sample([[0.9, 0.1, 0.9], [0.1, 0.9, 0.9]], filter="nearest"))


def test_contains_says_whether_a_leaf_holds_the_point():
    texture = eight_colors(tree=Octree.from_leaves([0, 7], 1), channels={})
    points = [[0.0, 0.0, 0.0], [0.5, 0.5, 0.5], [0.4, 0.4, 0.5], [1.0, 1.0, 1.0], [-0.1, 0.1, 0.1]]
    assert texture.contains(points).tolist() == [True, True, False, False, False]


@given(textures(deepest=6), st.integers(0, 7))
def test_a_level_is_the_coarser_texture(texture, level):
    coarse = texture.level(level)
    coarse.validate()
    assert coarse.tree.max_depth == min(level, texture.tree.max_depth)
    for name, channel in coarse.channels.items():
        assert np.array_equal(channel.values, texture.channels[name].values[: coarse.tree.n_cells])
        rows = coarse.tree.split.areas.size
        assert np.array_equal(channel.split_values, texture.channels[name].split_values[:rows])
        rows = coarse.tree.kept.cells.size
        assert np.array_equal(channel.kept_values, texture.channels[name].kept_values[:rows])


def test_bytes_are_those_of_all_arrays():
    texture = eight_colors()
    assert texture.nbytes == texture.tree.nbytes + 27


# --- what does not fit together


@pytest.mark.parametrize(
    ("form", "values", "message"),
    [
        (BASE_COLOR, np.zeros((8, 3), np.uint8), r"array of shape \(9, 3\), not uint8 \(8, 3\)"),
        (BASE_COLOR, np.zeros((9, 4), np.uint8), r"array of shape \(9, 3\)"),
        (BASE_COLOR, np.zeros((9, 3), np.uint16), "uint8 array of shape"),
        (BASE_COLOR, np.zeros((3, 9), np.uint8).T, "C-ordered"),
        (BASE_COLOR._replace(components=5), np.zeros((9, 5), np.uint8), "1 to 4 components, not 5"),
        (BASE_COLOR._replace(space="red"), np.zeros((9, 3), np.uint8), "unknown colour space"),
        (BASE_COLOR._replace(dtype="int8"), np.zeros((9, 3), np.int8), "unknown dtype"),
        (ALPHA, np.zeros((9, 1), np.uint8), "must have the name of its format"),
    ],
)
def test_channels_that_do_not_fit_the_tree_are_refused(form, values, message):
    with pytest.raises(ArgumentError, match=message):
        eight_colors(channels={"base_color": Channel(form, values, values[:0], values[:0])})


@pytest.mark.parametrize("rows", ["split_values", "kept_values"])
def test_values_of_rows_that_do_not_exist_are_refused(rows):
    values = np.zeros((9, 3), np.uint8)
    channel = Channel(BASE_COLOR, values, values[:0], values[:0])
    with pytest.raises(ArgumentError, match=r"of shape \(0, 3\)"):
        eight_colors(channels={"base_color": channel._replace(**{rows: values})})


ROOTS = [
    *(((0, 0, np.nan), 1), ((0, np.nan, 0), 1), ((0, 0, 0), 0), ((0, 0, 0), np.inf)),
    *(((0, 0, 0), 1e-312), ((0, 0, 0), 1e31), ((1e31, 0, 0), 1)),
]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        *(({"metadata": odd}, "must map strings to strings") for odd in ({"depth": 1}, {1: "depth"})),
        *(({"placement": Placement(*root)}, r"a size from 1e-15 to 1e\+30 and a corner") for root in ROOTS),
        *(({"bounds": odd}, "two finite corners") for odd in ([[0, 0, 0]], [[0, 0, 0], [1, 1, np.inf]])),
    ],
)
def test_impossible_metadata_root_cells_and_bounds_are_refused(changes, message):
    with pytest.raises(ArgumentError, match=message):
        eight_colors(**changes)


def test_a_channel_of_one_number_has_it_in_all_rows_and_a_copy_has_its_own():
    tree = shell(4).tree
    assert tree.split.areas.size
    assert tree.kept.cells.size
    for value in (0, 7):
        channel = Channel.full(BASE_COLOR, tree, value)
        as_channels({"base_color": channel}, tree)
        copy = channel.copied().named("other")
        assert (copy.format, channel.format) == (BASE_COLOR._replace(name="other"), BASE_COLOR)
        for array, own in zip(channel[1:], copy[1:], strict=True):
            assert array.shape[1] == 3
            assert (array == value).all()
            assert (own == value).all()
            assert not np.shares_memory(array, own)
