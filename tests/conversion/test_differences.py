"""Which finest cells two fields are far apart in: what samples and patches say, worked out slowly."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from hypothesis import given, settings
from hypothesis import strategies as st

from octex.arrays import bit_counts
from octex.channels import ALPHA, BASE_COLOR, NORMAL, linear_to_srgb
from octex.conversion.differences import Reference, coefficients, find_far, near_nodes, values_at_samples
from octex.conversion.prune import Finest, Pruned, limits_of, prune
from octex.conversion.samples import MOST_POINTS, NORMAL_STEPS, POSITION_STEPS, Samples, lay_out
from octex.jit import DISABLED, kernel, spline_box
from octex.texture import Channel, OctreeTexture
from octex.tree.layout import FACING_FLAGS, SPLIT, SplitTable
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.octree import Octree
from tests.make.small_textures import UNIT
from tests.make.strategies import with_random_data

#: Each example makes two trees and looks up some 400 patches.
few = settings(max_examples=1 if DISABLED else 15)
DEPTH = 4
BETWEEN = 1.0  # codes that fields may be farther apart between samples


class Scene(NamedTuple):
    """A full tree, the same pruned, and samples."""

    finest: Finest
    pruned: Pruned
    depths: npt.NDArray[np.uint8]
    full: OctreeTexture
    found: OctreeTexture
    samples: Samples


def scene(seed, smooth):
    """Random leaves whose values differ by ``smooth`` at most, with facings and split rows, some merged."""
    random = np.random.default_rng(seed)
    forms = [
        form._replace(dtype="float32", space="linear" if form.space == "srgb" else form.space)
        for form in (BASE_COLOR, NORMAL, ALPHA)
        if form is BASE_COLOR or random.random() < 0.4
    ]
    steps = random.integers(0, 1 << DEPTH, (200, 3))
    steps[:120, 2] = 7 + (steps[:120, 0] > 9)  # most in a sheet
    full = with_random_data(Octree.from_leaves(np.unique(encode_cells(steps)), DEPTH), seed, keep=0.0)
    # All face +z, as normals do: where all faces away, what little weighs changes at once at rims of cells.
    others = (SPLIT | 0b101111, 0b000001, SPLIT | 1, 0)[seed % 4]
    flags = full.arrays.flags & np.uint8(others) | np.uint8(1 << 4)
    cells = np.flatnonzero(flags & SPLIT)
    facings = flags[cells] & np.uint8(FACING_FLAGS)
    rows = int(bit_counts(facings).sum())
    split = SplitTable(cells.astype(np.uint32), facings, np.zeros(rows, np.uint8))
    full = full.with_cell_data(flags, full.arrays.areas, split)
    channels = {}
    for form in forms:
        low = random.random(form.components) * (1 - smooth)
        values, rows_of = (
            (low + smooth * random.random((n, form.components))).astype(np.float32)
            for n in (full.n_cells, full.split.areas.size)
        )
        channels[form.name] = Channel(form, values, rows_of, rows_of[:0])
    finest = Finest.of(full)
    depths = limits_of(finest, random.integers(2, 5, finest.codes.size).astype(np.uint8))
    pruned = prune(finest, depths)
    counts = random.integers(1, 3, finest.codes.size)
    normals = random.normal(size=(counts.sum(), 3))
    normals[:, 2] = 0.3 + np.abs(normals[:, 2])
    normals *= NORMAL_STEPS / np.linalg.norm(normals, axis=1, keepdims=True)
    samples = Samples(
        DEPTH, tuple(forms), finest.codes, np.append(0, np.cumsum(counts)),
        random.integers(0, POSITION_STEPS, (counts.sum(), 3)).astype(np.uint16),
        np.rint(normals).astype(np.int8), np.zeros(0, np.uint8), np.zeros((0, 0), np.float32),
    )  # fmt: skip
    box = [[0, 0, 0], [1, 1, 1]]
    return Scene(
        finest, pruned, depths,
        OctreeTexture(full, channels, UNIT, box),
        OctreeTexture(pruned.tree, pruned.carried(channels), UNIT, box),
        samples,
    )  # fmt: skip


def codes(texture, points, normals):
    """All components in codes (n, components), directions once more as unit vectors, and the alpha (n, 1)."""
    values = texture.sample(points, list(texture.channels), "quadratic", normals=normals, normalize=False)
    return codes_of(values), values.get("alpha", np.ones((len(points), 1), np.float32)).astype(np.float64)


def codes_of(values):
    """Values in codes (n, components), directions once more as unit vectors."""
    columns = []
    for name, found in values.items():
        found = found.astype(np.float64)
        if name == "normal":
            columns += [127.5 * found, 127.5 * found / np.linalg.norm(found, axis=1, keepdims=True)]
        else:
            columns.append(255 * (linear_to_srgb(found) if name == "base_color" else found))
    return np.hstack(columns)


def apart(scene, points, normals):
    """By how many codes the pruned tree's field is above the full one's (n, columns)."""
    found, _ = codes(scene.found, points, normals)
    wanted, coverage = codes(scene.full, points, normals)
    coverage = np.repeat(coverage, found.shape[1], axis=1)
    if "alpha" in scene.full.channels:
        coverage[:, -1] = 1.0
    return coverage * (found - wanted)


def polygon(middle, normal):
    """The corners (n, 3) of the plane's polygon in the unit cube, in order around: where it cuts edges."""
    corners = []
    for axis, (p, q) in itertools.product(range(3), itertools.product((0.0, 1.0), repeat=2)):
        ends = np.insert([[p, q], [p, q]], axis, [0.0, 1.0], axis=1)
        heights = (ends - middle) @ normal
        if heights[0] != heights[1] and heights[0] * heights[1] <= 0:
            corners.append(ends[0] + (ends[1] - ends[0]) * heights[0] / (heights[0] - heights[1]))
    points = np.array(corners)
    along = np.linalg.svd(normal[None])[2][1:]
    flat = (points - points.mean(axis=0)) @ along.T
    return points[np.argsort(np.arctan2(flat[:, 1], flat[:, 0]))]


def patches(samples):
    """The points (n, 3) of each sample's patch, in its cell: itself, corners, middles of spokes and sides."""
    middles, normals = (samples.positions + 0.5) / POSITION_STEPS, samples.normals.astype(np.float64)
    found = []
    for middle, normal in zip(middles, normals, strict=True):
        ends = polygon(middle, normal)
        after = np.roll(ends, -1, axis=0)
        found.append(np.concatenate([[middle], ends, (ends + middle) / 2, (ends + after) / 2]))
    return found


def owners(samples):
    """The finest cell of each sample."""
    return np.repeat(np.arange(samples.codes.size), np.diff(samples.firsts))


def apart_on(scene, points):
    """By how many codes fields are apart at each sample's points, without normals and with its own."""
    samples, counts = scene.samples, [len(each) for each in points]
    corners = np.repeat(decode_cells(samples.codes)[owners(samples)], counts, axis=0)
    places = (corners + np.concatenate(points)) / (1 << DEPTH)
    normals = np.repeat(samples.normals.astype(np.float64), counts, axis=0)
    columns = np.hstack([apart(scene, places, facing) for facing in (None, normals)])
    return np.split(columns, np.cumsum(counts)[:-1])


def scores(scene):
    """By how many codes each finest cell's fields are apart; those between samples by one less."""
    found = np.zeros(scene.samples.codes.size)
    values = apart_on(scene, patches(scene.samples))
    for cell, each in zip(owners(scene.samples), values, strict=True):
        corners, spokes, sides = np.split(each[1:], 3)
        spokes = 2 * spokes - (corners + each[0]) / 2
        sides = 2 * sides - (corners + np.roll(corners, -1, axis=0)) / 2
        between = np.abs([corners, spokes, sides]).max() - BETWEEN
        found[cell] = max(found[cell], np.abs(each[0]).max(), between)
    return found


def fields(scene):
    """The pruned tree's field, and the full one's."""
    forms = scene.samples.channels
    found, full = (coefficients(each.tree, each.channels, forms) for each in (scene.found, scene.full))
    return found, Reference.of(full, scene.samples, forms)


@few
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.02, 0.2, 0.9]))
def test_cells_are_far_where_samples_and_patches_say_so(seed, smooth):
    made = scene(seed, smooth)
    found, reference = fields(made)
    expected = scores(made)
    chosen = np.arange(0, expected.size, 2)
    for part in (0.2, 0.6, 0.95):
        most = float(np.quantile(expected, part))
        clear = np.abs(expected[chosen] - most) > 0.02
        far = find_far(found, reference, most, np.zeros(expected.size, np.int64), True, chosen)
        np.testing.assert_array_equal(far[clear], expected[chosen][clear] > most)


def scores_at_samples(scene, values, wanted, coverage):
    """By how many codes each finest cell's values are apart at its samples."""
    coverage = np.repeat(coverage, wanted.shape[1], axis=1)
    if "alpha" in scene.full.channels:
        coverage[:, -1] = 1.0
    apart = np.abs(coverage * (values - wanted)).max(axis=1)
    return np.maximum.reduceat(apart, scene.samples.firsts[:-1])


@few
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.02, 0.2, 0.9]))
def test_cells_and_nodes_are_near_where_their_samples_are(seed, smooth):
    made = scene(seed, smooth)
    samples, names, level = made.samples, list(made.full.channels), 2
    owned = owners(samples)
    points = (decode_cells(samples.codes)[owned] + (samples.positions + 0.5) / POSITION_STEPS) / (1 << DEPTH)
    found, reference = fields(made)
    count = samples.codes.size
    values = values_at_samples(reference, np.arange(count))
    reference = reference._replace(values=values)
    full = made.full.sample(points, names, normalize=False)
    np.testing.assert_allclose(values, np.hstack([full[name] for name in names]), atol=1e-5)
    wanted, coverage = codes(made.full, points, None)
    at_cells = scores_at_samples(made, codes(made.found, points, None)[0], wanted, coverage)
    # Nodes of a level: the field of all of them, in a cell of each child; and what each holds, in all cells.
    firsts = np.append(made.finest.firsts[level], count)
    children = np.append(made.finest.firsts[level + 1], count)
    even = made.full.level(level)
    of_even = scores_at_samples(made, codes(even, points, None)[0], wanted, coverage)
    first_node = made.full.tree.arrays.level_cells[level]
    node = first_node + np.searchsorted(firsts, owned, side="right") - 1
    own = codes_of({name: made.full.channels[name].values[node] for name in names})
    of_own = scores_at_samples(made, own, wanted, coverage)
    by_child = np.zeros(count)
    by_child[children[:-1]] = of_even[children[:-1]]
    at_nodes = np.minimum(*(np.maximum.reduceat(each, firsts[:-1]) for each in (by_child, of_own)))
    tree = reference.field._replace(arrays=even.tree.arrays)
    nodes = firsts, np.searchsorted(children, firsts), children
    for part in (0.2, 0.6, 0.95):
        most = float(np.quantile(at_cells, part))
        clear = np.abs(at_cells - most) > 0.02
        far = find_far(found, reference, most, np.zeros(count, np.int64), False, np.arange(count))
        np.testing.assert_array_equal(far[clear], at_cells[clear] > most)
        most = float(np.quantile(at_nodes, part))
        chosen = np.arange(0, at_nodes.size, 2)
        clear = np.abs(at_nodes[chosen] - most) > 0.02
        near = near_nodes(tree, reference, most, nodes, int(first_node), chosen)
        np.testing.assert_array_equal(near[clear], at_nodes[chosen][clear] <= most)


@kernel
def _points_of(places, normals, points):
    return lay_out(places, normals, 0, points)


@given(st.integers(0, 2**32 - 1))
def test_a_patch_covers_what_the_plane_of_a_sample_has_in_its_cell(seed):
    random = np.random.default_rng(seed)
    normal = random.integers(-2, 3, 3) if seed % 2 else random.normal(size=3)
    normal = normal if np.any(normal) else np.array([0, 0, 1])
    normal = np.rint(NORMAL_STEPS * normal / np.linalg.norm(normal)).astype(np.int8)
    place = random.choice(
        [0, POSITION_STEPS // 2, POSITION_STEPS - 1, int(random.integers(POSITION_STEPS))], 3
    )
    points = np.zeros((3, MOST_POINTS), np.float32)
    count = _points_of(place.astype(np.uint16)[None], normal[None], points)
    points = points[:, :count].T
    middle, (corners, spokes, sides) = points[0], np.split(points[1:], 3)
    assert 3 <= len(corners) <= 8
    np.testing.assert_allclose(middle, (place + 0.5) / POSITION_STEPS, atol=1e-6)
    np.testing.assert_allclose(spokes, (corners + middle) / 2, atol=1e-6)
    np.testing.assert_allclose(sides, (corners + np.roll(corners, -1, axis=0)) / 2, atol=1e-6)
    for expected in polygon((place + 0.5) / POSITION_STEPS, normal.astype(np.float64)):
        assert np.abs(corners - expected).max(axis=1).min() < 1e-4
    # They go around: each side turns the same way.
    turns = np.cross(np.roll(corners, -1, axis=0) - middle, corners - middle) @ normal
    assert turns.max() < 1e-4 or turns.min() > -1e-4


@kernel
def _spline_box(rows, first, weights):
    x = weights[0, 0], weights[0, 1], weights[0, 2]
    y = weights[1, 0], weights[1, 1], weights[1, 2]
    z = weights[2, 0], weights[2, 1], weights[2, 2]
    return spline_box(rows, first, (2, 8, 40), x, y, z)


def test_rows_are_summed_under_products_of_weights():
    random = np.random.default_rng(0)
    rows, weights = random.random((40, 4)).astype(np.float32), random.random((3, 3)).astype(np.float32)
    block = rows[5:32].reshape(3, 3, 3, 4).astype(np.float64)
    expected = np.einsum("zyxc,x,y,z->c", block, *weights.astype(np.float64))
    apart = np.zeros((6, 5, 4, 2, 4), np.float32)  # every other row of a box of 4 × 5 × 6
    apart[2:5, 1:4, 1:, 1] = block
    found = _spline_box(apart.reshape(-1, 4), 2 * 40 + 8 + 2 + 1, weights)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
