"""Adaptive trees: what merges, what stays, and what is guaranteed then."""

import json
from concurrent.futures import ThreadPoolExecutor
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import octex
from octex.arrays import bit_counts
from octex.channels import ALPHA, BASE_COLOR, ROUGHNESS, ChannelFormat, decode, encode, linear_to_srgb
from octex.conversion.adapt import adapted, as_max_error
from octex.conversion.fit import Fitter
from octex.conversion.levels import Filled
from octex.conversion.prune import Finest, limits_of, prune
from octex.conversion.samples import Samples
from octex.errors import ArgumentError
from octex.parallel import silent
from octex.texture import Channel, OctreeTexture
from octex.texture.channel import as_channels
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.octree import Octree
from tests.conftest import needs_jit
from tests.make.fixtures import SQUARE, SQUARE_TRIANGLES
from tests.make.small_textures import UNIT
from tests.make.strategies import with_random_data
from tests.oracles import naive

ROUNDING = 1 / 8  # of samples, and what is allowed for that, in codes


def plane(depth):
    """A full tree of the cells of a plane: x and y everywhere, z in the middle."""
    steps = np.arange(1 << depth)
    x, y = np.meshgrid(steps, steps)
    codes = np.sort(encode_cells(np.stack([x, y, np.full_like(x, 1 << depth >> 1)], axis=-1).reshape(-1, 3)))
    return Octree.from_leaves(codes, depth)


def places(tree, level=None):
    """The middles (n, 3) of the cells of a level, by default the deepest, in texture space."""
    level = tree.max_depth if level is None else level
    return (decode_cells(tree.level_codes(level)) + 0.5) / (1 << level)


def means(tree, leaves, form):
    """A channel of leaves' values (n, components), linear, and their means above."""
    levels = [leaves.astype(np.float64)]
    for level in range(tree.max_depth, 0, -1):
        codes = tree.level_codes(level) >> 3
        starts = np.flatnonzero(np.diff(codes, prepend=-1))
        counts = np.diff(starts, append=codes.size)[:, None]
        levels.append(np.add.reduceat(levels[-1], starts) / counts)
    values = encode(np.concatenate(levels[::-1]), form.dtype, form.space)
    return Channel(form, values, values[:0], values[:0])


def sampled(tree, channels):
    """A sample in the middle of each finest cell that sees its leaf's value."""
    n = tree.n_leaves
    forms = tuple(channel.format for channel in channels.values())
    values = [decode(channel.values[-n:], channel.format.space) for channel in channels.values()]
    return Samples(
        depth=tree.max_depth,
        channels=forms,
        codes=tree.level_codes(tree.max_depth),
        firsts=np.arange(n + 1),
        positions=np.full((n, 3), 1 << 15, np.uint16),
        normals=np.tile(np.array([[0, 0, 127]], np.int8), (n, 1)),
        shares=np.full(n, 255, np.uint8),
        values=np.hstack(values).astype(np.float16),
    )


def merge(tree, channels, max_error, wanted=None, fit=None):
    """Adapt a tree to what its finest cells hold."""

    class Own(Fitter):
        def fit(self, tree, channels, chosen=None):
            assert fit is not None
            return fit(tree, channels, chosen)

    filled = Filled(tree, dict(channels), sampled(tree, channels), wanted, False)
    with ThreadPoolExecutor(1) as pool, mock.patch("octex.conversion.adapt.Fitter", Own):
        found, values = adapted(
            filled, fit=fit is not None, max_error=max_error, executor=pool, progress=silent
        )
    found.validate()
    return OctreeTexture(found, values, UNIT, [[0, 0, 0], [1, 1, 1]])


def painted(tree, color, form=BASE_COLOR):
    return {form.name: means(tree, color, form)}


def errors(texture, full):
    """How far two fields of colours are apart in the middles of the full tree's leaves, in codes (n,)."""
    found, wanted = (each.sample(places(full.tree), "base_color", "quadratic") for each in (texture, full))
    return np.asarray(np.abs(255 * (linear_to_srgb(found) - linear_to_srgb(wanted))).max(axis=1))


def noise(tree, seed=0):
    return np.random.default_rng(seed).random((tree.n_leaves, 3))


def ramp(tree):
    """Light that rises along x by a code a cell."""
    codes = 100 + (places(tree)[:, :1] * [1, 1, 1]) * (1 << tree.max_depth)
    return decode(np.rint(codes).astype(np.uint8), "srgb").astype(np.float64)


@given(st.integers(0, 2**32 - 1), st.integers(0, 4))
def test_pruned_cells_are_those_of_the_full_tree_with_all_that_they_hold(seed, depth):
    random = np.random.default_rng(seed)
    codes = np.unique(random.integers(0, 8**depth, random.integers(1, 40)))
    full = with_random_data(Octree.from_leaves(codes, depth), seed, keep=0.0)
    finest = Finest.of(full)
    depths = limits_of(finest, random.integers(0, depth + 1, codes.size).astype(np.uint8))
    pruned = prune(finest, depths)
    tree = pruned.tree
    tree.validate()
    assert int((np.diff(pruned.starts, append=codes.size)).sum()) == codes.size
    for level, (codes_left, is_node) in enumerate(tree.walk()):
        rows = slice(*tree.arrays.level_cells[level : level + 2])
        numbers = pruned.cells[rows] - full.arrays.level_cells[level]
        np.testing.assert_array_equal(full.level_codes(level)[numbers], codes_left)
        np.testing.assert_array_equal(pruned.leaves[rows], ~is_node)
    np.testing.assert_array_equal(tree.arrays.flags, full.arrays.flags[pruned.cells])
    np.testing.assert_array_equal(tree.arrays.areas, full.arrays.areas[pruned.cells])
    # A value for each cell and each row of the split table, by which they are known again.
    rows_of = np.repeat(full.split.cells, bit_counts(full.split.facings))
    form = ChannelFormat("number", 1, "data", "float32")
    channel = Channel(
        form,
        np.arange(full.n_cells, dtype=np.float32)[:, None],
        rows_of.astype(np.float32)[:, None],
        np.empty((0, 1), np.float32),
    )
    carried = pruned.carried({"number": channel})["number"]
    as_channels({"number": carried}, tree)
    np.testing.assert_array_equal(carried.values[:, 0], pruned.cells)
    owners = np.repeat(tree.split.cells, bit_counts(tree.split.facings))
    np.testing.assert_array_equal(carried.split_values[:, 0], pruned.cells[owners])


@given(st.integers(0, 2**32 - 1))
def test_a_node_becomes_a_leaf_where_nothing_in_it_wants_to_go_deeper(seed):
    random = np.random.default_rng(seed)
    depth = 3
    codes = np.unique(random.integers(0, 8**depth, 60))
    wanted = random.integers(0, depth + 1, codes.size).astype(np.uint8)
    limits = limits_of(Finest.of(Octree.from_leaves(codes, depth)), wanted)
    for code, limit in zip(codes, limits, strict=True):
        inside = [wanted[codes >> 3 * (depth - level) == code >> 3 * (depth - level)] for level in range(4)]
        assert limit == next(level for level in range(4) if inside[level].max() <= level)


def test_cells_become_one_where_every_channel_that_shows_is_near():
    tree = plane(4)
    flat, noisy = (painted(tree, color) for color in (np.full((tree.n_leaves, 3), 0.3), noise(tree)))
    rough = painted(tree, noise(tree)[:, :1], ROUGHNESS)
    clear = painted(tree, np.zeros((tree.n_leaves, 1)), ALPHA)
    for channels, most in ((flat, 0), (flat, 2), (noisy | clear, 2)):
        assert merge(tree, channels, most).tree.n_cells == 1
    for channels, most in ((noisy, None), (noisy, 0), (flat | rough, 2)):
        texture = merge(tree, channels, most)
        assert texture.tree.n_leaves == tree.n_leaves
        for name, channel in texture.channels.items():
            np.testing.assert_array_equal(channel.values, channels[name].values)


@needs_jit
@pytest.mark.parametrize("detail", ["none", "dot", "decal"])
def test_slow_changes_merge_and_detail_stays(detail):
    tree = plane(7)
    x, y, _ = places(tree).T
    is_fine = {
        "none": np.zeros(tree.n_leaves, bool),
        "dot": np.arange(tree.n_leaves) == 5000,
        "decal": np.maximum(np.abs(x - 0.3), np.abs(y - 0.6)) < 0.04,
    }[detail]
    color = ramp(tree)
    color[is_fine] = noise(tree)[is_fine]
    channels = painted(tree, color)
    texture = merge(tree, channels, 2)
    assert texture.tree.n_leaves < 0.1 * tree.n_leaves
    assert errors(texture, merge(tree, channels, None)).max() <= 2 + ROUNDING
    assert np.isin(tree.level_codes(7)[is_fine], texture.tree.level_codes(texture.tree.max_depth)).all()


@pytest.mark.parametrize("most", [1, 8])
def test_all_samples_are_as_near_as_asked_for(most):
    tree = plane(6)
    random = np.random.default_rng(3)
    color = ramp(tree)
    spots = places(tree)[random.integers(0, tree.n_leaves, 8)]
    for spot in spots:  # hard edges
        near = np.abs(places(tree)[:, :2] - spot[:2]).max(axis=1) < 0.05 * random.random()
        color[near] = random.random(3)
    channels = painted(tree, color)
    texture = merge(tree, channels, most)
    assert 1 < texture.tree.n_leaves < tree.n_leaves
    assert errors(texture, merge(tree, channels, None)).max() <= most + ROUNDING


def test_the_slow_field_agrees_that_all_samples_are_near():
    tree = plane(4)
    color = ramp(tree)
    color[:20] = noise(tree)[:20]
    channels = painted(tree, color)
    full, texture = merge(tree, channels, None), merge(tree, channels, 3)
    assert 1 < texture.tree.n_leaves < tree.n_leaves
    fields = []
    for each in (full, texture):
        leaves = [
            (level, naive.unmorton(code))
            for level in range(each.tree.max_depth + 1)
            for code in each.tree.level_codes(level)[~each.tree.is_node(level)].tolist()
        ]
        values = decode(each.channels["base_color"].values, "srgb")
        fields.append(naive.Field(naive.cells_of(leaves), values, "quadratic").at)
    for place in places(tree)[::3]:
        wanted, found = (linear_to_srgb(field(place)) for field in fields)
        assert 255 * np.abs(found - wanted).max() <= 3 + ROUNDING + 1e-3


@needs_jit
def test_what_a_fit_breaks_is_split_again():
    tree = plane(6)
    channels = painted(tree, ramp(tree))
    plain = merge(tree, channels, 2)

    def fit(pruned, values, _chosen):
        spoilt = values["base_color"].values.copy()
        broken = pruned.leaf_cells()[::5]
        spoilt[broken] = 255 - spoilt[broken] if pruned.n_leaves < tree.n_leaves else spoilt[broken]
        return {"base_color": values["base_color"]._replace(values=spoilt)}

    texture = merge(tree, channels, 2, fit=fit)
    assert plain.tree.n_leaves < texture.tree.n_leaves < tree.n_leaves
    assert errors(texture, merge(tree, channels, None)).max() <= 2 + ROUNDING


def test_leaves_hold_what_was_fitted_and_nodes_the_means():
    tree = plane(5)

    def fit(pruned, values, _chosen):
        fitted = values["base_color"].values.copy()
        fitted[pruned.leaf_cells()] += 1
        return {"base_color": values["base_color"]._replace(values=fitted)}

    color = np.full((tree.n_leaves, 3), 0.3)
    color[:16] = [0.9, 0.1, 0.5]
    means = painted(tree, color)["base_color"].values
    for most in (None, 3):
        texture = merge(tree, painted(tree, color), most, fit=fit)
        values = texture.channels["base_color"].values
        for level, (codes, is_node) in enumerate(texture.tree.walk()):
            first, end = texture.tree.arrays.level_cells[level : level + 2]
            rows = tree.arrays.level_cells[level] + np.searchsorted(tree.level_codes(level), codes)
            shift = values[first:end, 0] - means[rows, 0]
            assert (shift[is_node] == 0).all()
            if level == tree.max_depth:  # those of the full tree
                assert (shift == 1).all()


def test_wishes_and_errors_combine():
    tree = plane(6)
    x, y, _ = places(tree).T
    color = noise(tree)
    color[y < 0.5] = 0.3
    texture = merge(tree, painted(tree, color), 2, np.where(x < 0.5, 4, 6).astype(np.uint8))

    def depths(low, high):
        return {
            level
            for level in range(texture.tree.max_depth + 1)
            for middle in places(texture.tree, level)[~texture.tree.is_node(level)]
            if (low < middle[:2]).all() and (middle[:2] < high).all()
        }

    assert depths((0, 0.5), (0.5, 1)) == {4}  # noise, but no more is wanted
    assert depths((0.5, 0.5), (1, 1)) == {6}
    assert max(depths((0, 0), (1, 0.25))) < 4


def test_an_error_must_be_a_number_from_zero_on():
    assert (as_max_error(0), as_max_error(np.float32(2))) == (0.0, 2.0)
    for error in (-1, np.nan, np.inf):
        with pytest.raises(ArgumentError, match=f"max_error must be finite and not negative, not {error}"):
            octex.convert(body(), 3, max_error=error)
    for error, told in (("two", "'two'"), ([], r"\[\]")):
        with pytest.raises(ArgumentError, match=f"max_error must be a number, in 1/255, not {told}"):
            as_max_error(error)


def body(size=64):
    """A square in one colour with a small speckled decal."""
    image = np.full((size, size, 3), 90, np.uint8)
    decal = size // 16
    image[decal : 2 * decal, decal : 2 * decal] = np.random.default_rng(0).integers(0, 256, (decal, decal, 3))
    return octex.Surface.from_arrays(SQUARE, SQUARE_TRIANGLES, uv=SQUARE[:, :2], image=image)


@needs_jit
def test_a_conversion_spends_its_leaves_on_the_decal():
    surface = body(128)
    full, adaptive = octex.convert(surface, 8), octex.convert(surface, 8, max_error=2)
    adaptive.validate()
    assert adaptive.tree.n_leaves < 0.05 * full.tree.n_leaves
    points = surface.scatter(20_000).rest
    apart = 255 * (
        linear_to_srgb(adaptive.sample(points, filter="quadratic"))
        - linear_to_srgb(full.sample(points, filter="quadratic"))
    )
    assert np.sqrt(np.mean(apart**2)) < 1
    assert np.quantile(np.abs(apart), 0.999) < 3


@needs_jit
def test_a_conversion_goes_as_deep_as_a_function_says():
    texture = octex.convert(body(), 6, detail=lambda points: np.where(points[:, 0] < 0.5, 3, 5.5), fit=False)
    full = octex.convert(body(), 6, fit=False)
    for level, (leaves, _) in enumerate(texture.tree.cells_by_depth()):
        assert (leaves > 0) == (level in (3, 6))
    right = full.tree.level_codes(6)
    middles = full.placement.to_rest((decode_cells(right) + 0.5) / 64)
    right = right[middles[:, 0] > 0.52]
    assert np.isin(right, texture.tree.level_codes(6)).all()
    is_leaf = ~texture.tree.is_node(3)
    coarse = np.flatnonzero(is_leaf) + texture.tree.arrays.level_cells[3]
    same = np.searchsorted(full.tree.level_codes(3), texture.tree.level_codes(3)[is_leaf])
    same += full.tree.arrays.level_cells[3]
    found, expected = (each.channels["base_color"].values for each in (texture, full))
    np.testing.assert_array_equal(found[coarse], expected[same])


def test_provenance_says_how_a_tree_was_adapted():
    options = json.loads(octex.convert(body(), 3, max_error=2, detail="stretch").metadata["convert"])
    assert (options["max_error"], options["detail"]) == (2, "stretch")
    options = json.loads(octex.convert(body(), 3, detail=lambda points: points[:, 0]).metadata["convert"])
    assert options["detail"] == "function"
    assert "max_error" not in options
