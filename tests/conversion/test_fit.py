"""Leaf values fitted to the source."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import octex
from octex.arrays import bit_counts
from octex.channels import (
    ALPHA,
    BASE_COLOR,
    METALLIC,
    NORMAL,
    ONE,
    ROUGHNESS,
    ChannelFormat,
    decode,
    encode,
    linear_to_srgb,
)
from octex.conversion import fit
from octex.conversion.levels import assemble, cell_levels
from octex.conversion.lookups import FittedLeaves, members_of
from octex.conversion.samples import SHARE_STEPS, sample_points
from octex.conversion.solve import SHRINK
from octex.errors import ArgumentError
from octex.field.field import Field
from octex.parallel import silent
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from tests.conftest import needs_jit
from tests.make.small_surfaces import FACES, LIGHT, TETRAHEDRON, FaceSource, tetrahedron
from tests.make.solids import cube
from tests.make.taps import taps_of
from tests.oracles import naive_fit

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0.2], [1, 1, 0.3], [0, 1, 0.1]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def painted(image):
    """A slanted square that shows an image."""
    return Surface.from_arrays(SQUARE, HALVES, uv=SQUARE[:, :2], image=image, wrap="clamp")


def waves(texels):
    """A smooth image of two colours."""
    x, y = np.meshgrid(np.arange(texels), np.arange(texels))
    bright = 0.5 + 0.4 * np.sin(x / 3.0) * np.cos(y / 4.0)
    return (255 * np.stack([bright, 1 - bright, 0 * bright + 0.5], axis=-1)).astype(np.uint8)


def error(texture, surface, filter="quadratic"):
    """The root of the mean square error at points of the surface, in sRGB codes."""
    points = surface.scatter(20_000, seed=1)
    found = linear_to_srgb(np.clip(texture.sample(points.rest, filter=filter), 0, 1))
    return 255 * float(np.sqrt(np.mean((found - linear_to_srgb(surface.evaluate(points))) ** 2)))


def pair(surface, depth, **options):
    """The same conversion without the fit and with it."""
    return tuple(octex.convert(surface, depth, fit=fit, **options) for fit in (False, True))


def sampled(surface, depth):
    """The levels of cells of a surface, the tree and channels, the samples, and where they are placed."""
    placement = Placement.around(surface.bounds, depth)
    with ThreadPoolExecutor(1) as pool:
        full = cell_levels(
            surface, surface.source, surface.channels, placement, depth, pool, silent, has_samples=True
        )
    made = assemble(full)
    return full, made, made.samples, placement


class Pattern(FaceSource):
    """One number that varies over each triangle, between 0 and 1 and reaching both."""

    def __init__(self):
        form = ChannelFormat("height", 1, "data", "float32")
        super().__init__((form,), np.zeros((len(FACES), 1)))

    def vary(self, values, barycentric):
        values[:, 0] = np.clip(0.5 + np.sin(9 * barycentric[:, 1]), 0, 1)


@pytest.mark.parametrize("dtype", ["float32", "uint16"])
def test_the_fit_is_the_least_squares_between_the_bounds(dtype):
    form = ChannelFormat("own", 1, "data", dtype)
    source = Pattern()
    source._channels = (form,)
    surface = Surface(TETRAHEDRON, FACES, source)
    _, made, samples, placement = sampled(surface, 4)
    tree, channels = made.tree, made.channels
    with ThreadPoolExecutor(1) as pool:
        found = fit.Fitter(samples, pool, silent).fit(tree, channels)
    chosen = np.arange(len(samples.shares))
    taps = taps_of(Field(tree), placement.to_rest(sample_points(samples, chosen)), placement)
    first = tree.n_cells - tree.n_leaves
    lookups = np.zeros((len(chosen), tree.n_leaves))
    np.add.at(lookups, (np.repeat(chosen, np.diff(taps.starts)), taps.rows - first), taps.weights)
    means, values = (decode(each["own"].values[first:], "data").astype(float) for each in (channels, found))
    low, high = (0.0, 1.0) if dtype == "uint16" else (-np.inf, np.inf)
    weights = samples.shares / SHARE_STEPS
    problem = lookups, weights, samples.values.astype(float), means, float(SHRINK)
    best = naive_fit.fitted(*problem, low, high)
    before, after, least = (naive_fit.objective(*problem, each) for each in (means, values, best))
    assert least < after < least + 0.12 * (before - least)
    if dtype == "uint16":  # without bounds some values hardly matter
        assert np.sqrt(np.mean((values - best) ** 2)) < 0.35 * np.sqrt(np.mean((means - best) ** 2))


def shaded():
    """A slanted square of hardly more than one colour."""
    colors = np.array([[0.1] * 3, [0.11] * 3, [0.112] * 3, [0.1025] * 3])
    return Surface.from_arrays(SQUARE, HALVES, colors=colors)


def checkered(squares, texels):
    checkers = (np.indices((squares, squares)).sum(axis=0) % 2 * 255).astype(np.uint8)
    return painted(checkers.repeat(texels, axis=0).repeat(texels, axis=1))


@needs_jit
@pytest.mark.parametrize(
    ("surface", "depth", "part", "part_of_linear"),
    [
        (painted(waves(16)), 6, 0.56, 0.63),  # by 5 dB, and by 4
        (painted(waves(64)), 6, 0.56, 0.63),
        (checkered(16, 4), 7, 0.71, 0.71),
        (shaded(), 6, 0.56, 1.0),  # what a leaf is rounded by its neighbours make good
    ],
    ids=["smooth", "smooth texels", "checkers", "shades"],
)
def test_a_fitted_field_is_nearer_to_the_source(surface, depth, part, part_of_linear):
    means, fitted = pair(surface, depth)
    fitted.validate()
    assert error(fitted, surface) < part * error(means, surface)
    assert error(fitted, surface) < part_of_linear * error(means, surface, "linear")


@pytest.mark.parametrize("dtype", ONE)
def test_values_stay_inside_the_range_of_every_type(dtype):
    forms = (
        BASE_COLOR._replace(dtype=dtype, space="linear" if dtype.startswith("float") else "srgb"),
        METALLIC._replace(dtype=dtype),
        NORMAL._replace(dtype=dtype),
    )
    rows = [[0, 0, 0, 0, 1, 0, 0], [1, 1, 1, 1, -1, 0, 0], [0, 1, 0, 1, 0, 0, 1], [1, 0, 1, 0, 0, 0, -1]]
    texture = octex.convert(Surface(TETRAHEDRON, FACES, FaceSource(forms, rows)), depth=4)
    texture.validate()
    for form in forms:
        values = decode(texture.channels[form.name].values, form.space)
        assert np.isfinite(values).all()
        assert values.min() >= (-1 if form.space == "direction" else 0) - 1e-6
        assert form.space == "linear" or values.max() <= 1 + 1e-6


@pytest.mark.parametrize("dtype", ["float16", "float32"])
def test_light_that_is_nowhere_above_one_is_fitted_below_it_and_other_light_is_not(dtype):
    texture = octex.convert(checkered(8, 2), 4, dtype=dtype)
    values = texture.channels["base_color"].values
    assert values.max() <= 1 + 1e-6
    whole = octex.cast(texture, "uint8")
    assert np.array_equal(whole.channels["base_color"].values, encode(values, "uint8", "srgb"))
    bright = FaceSource((LIGHT._replace(dtype=dtype),), [[9.0] * 3, [0.0] * 3, [1.5] * 3, [0.0] * 3])
    light = octex.convert(Surface(TETRAHEDRON, FACES, bright), 3).channels["emissive"]
    assert light.values.max() > 9
    with pytest.raises(ArgumentError, match="channel 'emissive' has values above 1, which uint8 cannot hold"):
        octex.cast(octex.convert(Surface(TETRAHEDRON, FACES, bright), 3), "uint8")


def test_nodes_and_their_sides_keep_the_means_of_the_source():
    sides = np.array([[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 3, 2]], np.int32)
    source = FaceSource((BASE_COLOR,), [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]])
    means, fitted = pair(Surface(SQUARE, sides, source), 4)
    leaves = means.tree.leaf_cells()
    nodes = np.setdiff1d(np.arange(means.tree.n_cells), leaves)
    ours, theirs = fitted.channels["base_color"], means.channels["base_color"]
    assert np.array_equal(ours.values[nodes], theirs.values[nodes])
    owners = np.repeat(means.tree.split.cells, bit_counts(means.tree.split.facings))
    of_nodes = np.isin(owners, nodes)
    assert of_nodes.any()
    assert np.array_equal(ours.split_values[of_nodes], theirs.split_values[of_nodes])
    assert not np.array_equal(ours.split_values[~of_nodes], theirs.split_values[~of_nodes])
    for one, other in zip(fitted.tree.arrays, means.tree.arrays, strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("dtype", ONE)
def test_constants_stay_exact(dtype):
    # None of these is a stored number of 8 bits.
    rows = np.tile([0.2158, 0.0123, 0.7771, 0.3333, 0.6, 0.48, 0.64], (4, 1))
    source = FaceSource((BASE_COLOR, METALLIC, NORMAL), rows)
    means, fitted = pair(Surface(TETRAHEDRON, FACES, source), 4, dtype=dtype)
    for name, channel in fitted.channels.items():
        if dtype == "uint8":
            assert np.array_equal(channel.values, means.channels[name].values)
        else:
            apart = decode(channel.values, channel.format.space) - decode(
                means.channels[name].values, channel.format.space
            )
            assert np.abs(apart).max() < 5e-4


@pytest.mark.parametrize("depth", [0, 1])
def test_a_tree_of_few_cells_can_be_fitted(depth):
    means, fitted = pair(tetrahedron(), depth)
    fitted.validate()
    ours, theirs = (texture.channels["base_color"].values.astype(int) for texture in (fitted, means))
    assert depth or np.abs(ours - theirs).max() < 128


def tiles(across, first=0):
    """A slanted square of small squares; up to column ``first`` it is two large triangles."""
    corners = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]) / across
    x, y = (each.ravel() / across for each in np.meshgrid(np.arange(first, across), np.arange(across)))
    small = (np.stack([x, y], axis=1)[:, None] + corners).reshape(-1, 2)
    flat = np.concatenate([corners * [first, across], small]) if first else small
    vertices = np.column_stack([flat, 0.2 * flat[:, 0] + 0.1 * flat[:, 1]])
    triangles = 4 * np.arange(len(flat) // 4)[:, None, None] + HALVES
    return Surface.from_arrays(vertices, triangles.reshape(-1, 3).astype(np.int32))


@pytest.mark.parametrize("depth", [0, 1, 3, 5])
@pytest.mark.parametrize("channel", ["base_color", "roughness"])
@pytest.mark.parametrize(("across", "first"), [(24, 12), (24, 0), (96, 0)])
def test_fitted_fields_of_cells_of_many_pieces_are_no_farther_from_the_source_than_means(
    across, first, channel, depth
):
    def halves(points):
        value = np.where(points[:, 0] < 0.5, 0.996, 0.02)
        return value if channel == "roughness" else np.repeat(value[:, None], 3, axis=1)

    surface = tiles(across, first).with_sources({channel: halves})
    points = surface.scatter(20_000, seed=1)
    curve = linear_to_srgb if channel == "base_color" else np.asarray
    truth = curve(halves(points.rest))
    errors = []
    for is_fitted in (False, True):
        texture = octex.convert(surface, depth, channels=[channel], fit=is_fitted)
        found = curve(np.clip(texture.sample(points.rest, channel), 0, 1))
        errors.append(np.sqrt(np.mean((found.reshape(truth.shape) - truth) ** 2)))
    plain, fitted = errors
    assert fitted < (1.02 if depth < 3 else 1.0) * plain


def checkers(points):
    """Black and white squares, 96 along an edge."""
    return np.repeat(np.floor(points[:, :2] * 96).sum(axis=1)[:, None] % 2, 3, axis=1)


@pytest.mark.parametrize("depth", [0, 2, 4, 6])
def test_a_fitted_field_sends_out_the_light_of_what_its_cells_cannot_show(depth):
    surface = tiles(96).with_sources({"base_color": checkers})
    points = surface.scatter(20_000, seed=1)
    plain, fitted = (
        texture.sample(points.rest)[:, 0] - 0.5
        for texture in pair(surface, depth, channels=["base_color"], dtype="float32")
    )
    assert abs(fitted.mean()) < 0.002
    assert np.sqrt(np.mean(fitted**2)) < 1.6 * np.sqrt(np.mean(plain**2)) + 0.001


@pytest.mark.parametrize("depth", [3, 6])
def test_a_function_read_at_one_point_a_cell_keeps_its_mean_light(depth):
    surface = Surface.from_arrays(SQUARE, HALVES).with_sources({"base_color": checkers})
    points = surface.scatter(20_000, seed=1)
    plain, fitted = (
        abs(texture.sample(points.rest).mean() - 0.5)
        for texture in pair(surface, depth, channels=["base_color"], dtype="float32")
    )
    assert fitted < max(1.5 * plain, 0.01)


def test_a_leaf_of_two_values_is_fitted_to_their_mean_in_linear_light():
    def halves(points):
        return np.where(points[:, :1] < 0.5, 0.02, 1.0).repeat(3, axis=1)

    surface = Surface.from_arrays(SQUARE * [1, 1, 0], HALVES).with_sources({"base_color": halves})
    for texture in pair(surface, 0, dtype="float32"):
        assert np.abs(texture.channels["base_color"].values - 0.51).max() < 1e-6


def test_a_cell_met_without_area_is_fitted_like_others():
    corners, triangles = cube((0, 0, 0))  # whose lower faces touch the cells below
    surface = Surface.from_arrays(corners, triangles, colors=corners)
    texture = octex.convert(surface, cell=3 / 20)
    texture.validate()
    points = surface.scatter(500)
    assert np.abs(texture.sample(points.rest) - surface.evaluate(points)).max() < 0.25


def test_alpha_steers_what_other_channels_are_fitted_to():
    # What lies under the half that nothing covers does not matter to the other.
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    sources = [
        FaceSource((BASE_COLOR, ALPHA, ROUGHNESS), [[0.2, 0.4, 0.6, 1, 0.5], [*hidden, 0, 0.5]])
        for hidden in ([0, 0, 0], [1, 1, 1])
    ]
    found = []
    for source in sources:
        surface = Surface(SQUARE, triangles, source)
        texture = octex.convert(surface, 4)
        texture.validate()
        points = surface.scatter(300)
        covered = points.triangles == 0
        found.append(texture.sample(points.rest)[covered])
    assert np.abs(found[0] - found[1]).max() < 0.06


def test_bricks_meet_without_seams(monkeypatch):
    surface = painted(waves(16))
    whole = octex.convert(surface, 5)
    monkeypatch.setattr(fit, "BRICK_SAMPLES", 100)
    bricks = octex.convert(surface, 5)
    ours, theirs = (texture.channels["base_color"].values.astype(int) for texture in (bricks, whole))
    apart = np.abs(ours - theirs)
    assert apart.max() > 0  # there are several
    assert apart.mean() < 0.5
    assert error(bricks, surface) < 1.25 * error(whole, surface)


def merged(tree, channels):
    """Merge the finest leaves in one half of the root into their parents, which keep their means."""
    depth = tree.max_depth
    codes, above = tree.level_codes(depth), tree.level_codes(depth - 1)
    merges = above & 1 << 3 * (depth - 2) == 0  # the lower half of x
    stays = ~merges[np.searchsorted(above, codes >> 3)]
    all_codes = np.concatenate([above[merges], codes[stays]])
    depths = np.repeat([depth - 1, depth], [merges.sum(), stays.sum()])
    order = np.argsort(all_codes << np.where(depths == depth, 0, 3))
    made = Octree.from_leaves(all_codes[order], depths[order])
    kept = np.concatenate(
        [np.arange(tree.arrays.level_cells[depth]), tree.n_cells - len(codes) + np.flatnonzero(stays)]
    )
    return made, {
        name: channel._replace(values=channel.values[kept], split_values=channel.split_values[:0])
        for name, channel in channels.items()
    }


@needs_jit
def test_trees_of_any_depths_are_fitted(monkeypatch):
    monkeypatch.setattr(fit, "BRICK_SAMPLES", 500)
    surface = painted(waves(16))
    _, made, samples, placement = sampled(surface, 6)
    tree, channels = merged(made.tree, made.channels)
    leaves = FittedLeaves.of(tree, samples)
    assert np.array_equal(leaves.ranks[leaves.cells], np.arange(tree.n_leaves))
    assert np.array_equal(leaves.firsts[1:], leaves.ends[:-1])
    assert (leaves.firsts[0], leaves.ends[-1]) == (0, len(samples.shares))
    with ThreadPoolExecutor(2) as pool:
        found = fit.Fitter(samples, pool, silent).fit(tree, channels)
    textures = [OctreeTexture(tree, each, placement, surface.bounds, {}) for each in (channels, found)]
    assert error(textures[1], surface) < 0.5 * error(textures[0], surface)


def test_a_leaf_is_fitted_to_some_of_its_samples_evenly_chosen():
    members, strides = members_of(np.array([0, 5]), np.array([5, 105]), np.array([0, 1]), 10)
    assert members.tolist() == [0, 1, 2, 3, 4, *range(5, 105, 10)]
    assert strides.tolist() == [1] * 5 + [10] * 10


def test_components_that_weigh_alike_are_solved_together_and_alpha_first():
    forms = (BASE_COLOR, ALPHA, METALLIC, ROUGHNESS, ChannelFormat("height", 1, "data", "uint16"), LIGHT)
    groups = fit._groups((*forms, ChannelFormat("four", 4, "data")))
    columns = list(range(sum(form.components for form in forms) + 4))
    assert [(group.format.name, columns[group.columns]) for group in groups] == [
        ("alpha", [3]), ("base_color", [0, 1, 2]), ("metallic", [4, 5]), ("height", [6]),
        ("emissive", [7, 8, 9]), ("four", [10, 11, 12]), ("four", [13]),
    ]  # fmt: skip
