"""The taps of lookups beside the slow reference, whichever way they are found."""

from __future__ import annotations

import errno
import gc
import mmap
import os
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Barrier
from time import sleep
from typing import NamedTuple
from weakref import ref

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex.field.blend import blend
from octex.field.field import Field, Finder
from octex.field.splines import FILTERS
from octex.field.taps import Codes, to_coordinates
from octex.field.tiles import CACHE_LINE, build_tiles
from octex.tree.morton import decode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from octex.tree.search import Positions
from tests.conftest import needs_jit
from tests.make.small_textures import UNIT
from tests.make.strategies import Leaves, leaf_sets, points_around, with_random_data
from tests.make.taps import spread, taps_of
from tests.oracles import naive

each_filter = pytest.mark.parametrize("filter", FILTERS[1:])


class Drawn(NamedTuple):
    tree: Octree
    points: npt.NDArray[np.float64]  # multiples of 2⁻²⁴: no rounding moves one across a face


@st.composite
def trees_and_points(draw):
    """Trees of leaves at one depth, which have tiles, and at mixed ones, with kept nodes or without."""
    leaves = draw(leaf_sets(deepest=12))
    if draw(st.booleans()):
        deepest = leaves.depths == leaves.depths.max(initial=0)
        leaves = Leaves(leaves.codes[deepest], leaves.depths[deepest])
    keep = draw(st.sampled_from([0.0, 0.0, 0.3, 1.0]))
    tree = with_random_data(Octree.from_leaves(*leaves), draw(st.integers(0, 2**32 - 1)), keep)
    points = draw(st.lists(points_around(leaves), min_size=1, max_size=6))
    return Drawn(tree, np.round(np.array(points) * 2.0**24) / 2.0**24)


def blended(taps, values):
    terms = taps.weights[:, None].astype(np.float64) * values[taps.rows]
    return np.add.reduceat(terms, taps.starts[:-1])


@each_filter
@given(trees_and_points())
def test_weights_and_slopes_are_those_of_the_reference(filter, drawn):
    tree, points = drawn
    field = naive.field_of(tree, filter)
    n_rows = len(field.values)
    plain = taps_of(Field(tree), points, UNIT, filter)
    with_slopes = taps_of(Field(tree), points, UNIT, filter, gradient=True)
    expected = np.array([field.at(point) for point in points.tolist()])
    for taps in (plain, with_slopes):
        found = spread(taps.starts, taps.rows, taps.weights, n_rows)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    edge = 2.0**-tree.max_depth
    for axis, direction in enumerate(np.eye(3).tolist()):
        slopes = [
            field.derivatives(point, direction, 1)[1] * edge * (0 < point[axis] < 1)  # clamped outside
            for point in points.tolist()
        ]
        found = spread(with_slopes.starts, with_slopes.rows, with_slopes.slopes[:, axis], n_rows) * edge
        np.testing.assert_allclose(found, slopes, rtol=0, atol=1e-5)
    assert plain.slopes.shape == (0, 3)


@needs_jit
@each_filter
@pytest.mark.parametrize("depth", [3, 12, 21])
def test_weights_are_never_negative_and_sum_to_one(filter, depth):
    """Beside faces and centres too, where a cell of the deepest level is but 512 steps of fixed point."""
    places = np.stack(np.unravel_index(np.arange(64), (4, 4, 4)), 1) + 2**depth // 2 - 1
    codes = sorted(naive.morton(place) for place in places.tolist())
    random = np.random.default_rng(depth)
    halves = random.integers(0, 8, (2_000, 3)) / 2
    steps = halves + random.normal(size=(2_000, 3)) * random.choice([0, 1e-4, 1e-3, 0.3], (2_000, 3))
    for tree in (Octree.from_leaves(codes, depth), Octree.from_leaves(codes[::3], depth)):
        taps = taps_of(Field(tree), (places[0] + steps) / 2.0**depth, UNIT, filter)
        assert taps.weights.min() >= 0
        assert np.abs(blended(taps, np.ones((tree.n_cells, 1))) - 1).max() <= 1e-6


def shell(depth, fine):
    """A spherical shell of leaves at ``depth``, at ``fine`` where x is above the middle."""
    random = np.random.default_rng(0)
    points = on_sphere(random.normal(size=(20_000, 3)))
    depths = np.where(points[:, 0] > 0.5, fine, depth)
    places = np.floor(points * 2.0 ** depths[:, None]).astype(int).tolist()
    codes = [naive.morton(place, depth) for place, depth in zip(places, depths.tolist(), strict=True)]
    firsts = np.array(codes) << 3 * (21 - depths)
    order = np.unique(firsts, return_index=True)[1]
    return Octree.from_leaves(np.array(codes)[order], depths[order].astype(np.uint8))


def on_sphere(directions):
    return 0.5 + 0.31 * directions / np.linalg.norm(directions, axis=1)[:, None]


@needs_jit
@pytest.mark.parametrize("keep", [0.0, 0.3])
@each_filter
def test_values_and_slopes_go_on_across_faces_where_the_depth_changes(filter, keep):
    tree = with_random_data(shell(4, 6), 3, keep)
    values = np.random.default_rng(7).random((tree.n_cells + tree.kept.cells.size, 1))
    random = np.random.default_rng(5)
    x, turns = random.integers(-8, 9, 2000) / 128, random.uniform(0, 2 * np.pi, 2000)  # faces and middles
    radii = np.sqrt(0.31**2 - x**2) + random.uniform(-0.005, 0.005, 2000)
    points = 0.5 + np.column_stack([x, radii * np.cos(turns), radii * np.sin(turns)])
    step = np.array([2.0**-24, 0.0, 0.0])
    before, after = (
        taps_of(Field(tree), each, UNIT, filter, gradient=True) for each in (points - step, points + step)
    )
    jump = np.abs(blended(after, values) - blended(before, values)).max()
    if filter == "linear":
        assert jump > 0.05
        return
    assert jump < 1e-4
    edge = 2.0**-tree.max_depth
    by_axis = [
        np.add.reduceat(taps.slopes * values[taps.rows], taps.starts[:-1]) * edge for taps in (before, after)
    ]
    assert np.abs(by_axis[0]).max() > 0.1
    assert np.abs(by_axis[1] - by_axis[0]).max() < 1e-3


@needs_jit
@each_filter
def test_leaves_have_weight_throughout(filter):
    tree = with_random_data(shell(4, 6), 3, 0.3)
    centers, edges = leaf_boxes(tree)
    offsets = np.random.default_rng(1).uniform(-0.5, 0.5, centers.shape)
    offsets[::2] = np.sign(offsets[::2]) * 0.499999
    coords = centers + offsets * edges[:, None]
    assert (Finder(Field(tree), UNIT, filter).find(coords).covers > 0).all()


def leaf_boxes(tree):
    """The middles and edges of all leaves."""
    found = [
        ((decode_cells(codes[~is_node]) + 0.5) / 2.0**level, np.full((~is_node).sum(), 2.0**-level))
        for level, (codes, is_node) in enumerate(tree.walk())
    ]
    return tuple(np.concatenate(each) for each in zip(*found, strict=True))


@needs_jit
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("fine", [5, 7])
@each_filter
def test_values_on_and_beside_a_sphere_are_those_of_the_reference(filter, fine, dtype):
    tree = shell(5, fine)
    random = np.random.default_rng(1)
    values = random.random((tree.n_cells, 2))
    field = naive.field_of(tree, filter, values)
    directions = random.normal(size=(120, 3))
    directions[60:] = [[0.0, 0.6, -0.8]] + np.linspace(-0.1, 0.1, 60)[:, None] * np.eye(3)[:1]  # in a row
    beside = 1 + 0.2 * random.random((120, 1)) * (random.random((120, 1)) < 0.2)
    placement = Placement((-3.0, 0.5, 10.0), 4.0)
    points = placement.to_rest(0.5 + (on_sphere(directions) - 0.5) * beside).astype(dtype)
    taps = taps_of(Field(tree), points, placement, filter)
    expected = [field.at(point) for point in placement.to_texture_space(points).tolist()]
    np.testing.assert_allclose(blended(taps, values), expected, rtol=0, atol=1e-5)


@needs_jit
@pytest.mark.parametrize("fine", [5, 7])
@each_filter
def test_taps_do_not_depend_on_the_points_before_them(filter, fine, monkeypatch):
    tree = shell(5, fine)
    random = np.random.default_rng(2)
    points = on_sphere(random.normal(size=(2_000, 3)))
    order = random.permutation(len(points))
    values = random.random((tree.n_cells, 1))
    found = blended(taps_of(Field(tree), points, UNIT, filter), values)
    monkeypatch.setattr("octex.field.field.BLOCK", 100)
    monkeypatch.setattr("octex.field.field._WALKED", 1)
    field = Field(tree)
    again = taps_of(field, points[order], UNIT, filter)
    assert len(list(Finder(field, UNIT, filter).blocks(points, field.weighing(field, False)))) > 1
    assert (found[order] == blended(again, values)).all()


@pytest.mark.parametrize("filter", FILTERS)
@given(trees_and_points(), st.sampled_from([np.uint8, np.uint16, np.float32]))
def test_blends_and_covers_are_those_of_the_reference(filter, drawn, dtype):
    tree, points = drawn
    random = np.random.default_rng(0)
    rows = [(count, 3) for count in (tree.n_cells, tree.kept.cells.size, tree.split.areas.size)]
    table = np.empty(0, np.float32)
    if dtype == np.float32:
        values = decoded = [random.random(shape, np.float32) for shape in rows]
    else:
        table = random.random(np.iinfo(dtype).max + 1, np.float32 if dtype == np.uint16 else np.float64)
        values = [random.integers(0, table.size, shape, dtype) for shape in rows]
        decoded = [table[codes] for codes in values]
    coords, results = np.empty_like(points), np.empty((len(points), 3), np.float32)
    assert to_coordinates(Positions.of(points), *UNIT, coords) == -1
    taps = Finder(Field(tree), UNIT, filter).find(coords)
    blend(taps, Codes(*values, table), False, results)
    field = naive.field_of(tree, "linear" if filter == "nearest" else filter, np.concatenate(decoded[:2]))
    for n, point in enumerate(points.tolist()):
        if filter == "nearest":
            number = naive.find(field.cells, np.clip(point, 0, 1 - 2.0**-30).tolist())
            expected, weight = (
                decoded[0][naive.nearest(field.cells, point)],
                float(field.cells[number].is_leaf),
            )
        else:
            expected, weight = field.at(point), field.weight(point)
        np.testing.assert_allclose(results[n], expected, rtol=0, atol=1e-5)
        assert taps.covers[n] == pytest.approx(weight, abs=1e-5)


@each_filter
def test_no_points_have_no_taps(filter):
    for gradient in (False, True):
        taps = taps_of(Field(shell(3, 3)), np.empty((0, 3)), UNIT, filter, gradient=gradient)
        assert taps.starts.tolist() == [0]
        assert taps.rows.size == taps.weights.size == len(taps.slopes) == 0


def off_the_surface(depth=6):
    """A tree of one leaf, and points at all distances from it, which coarser levels answer."""
    return Octree.from_leaves([0], depth), np.linspace(0.0, 1.0, 8)[:, None] * np.ones(3)


def test_threads_build_what_they_share_once(monkeypatch):
    tree, points = off_the_surface()
    built = []

    def slowly(build, level_of, *given):
        built.append(level_of(*given))
        sleep(0.005)  # for the others to come
        return build(*given)

    truncated = partial(slowly, Octree.truncated, lambda _, level: -1 - level)
    monkeypatch.setattr(Octree, "truncated", lambda tree, level: truncated(tree, level))
    tiled = partial(slowly, build_tiles, lambda tree: tree.max_depth)
    monkeypatch.setattr("octex.field.field.build_tiles", tiled)
    field, start = Field(tree), Barrier(4)
    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(lambda _: (start.wait(), taps_of(field, points, UNIT)), range(4)))
    assert len(built) == len(set(built)) > tree.max_depth
    assert all(np.array_equal(taps.rows, found[0][1].rows) for _, taps in found)


def test_the_field_of_a_level_does_not_keep_the_whole_one():
    tree, points = off_the_surface()
    field = Field(tree)
    level, whole = field.level(3), ref(field)
    expected = taps_of(level, points, UNIT)
    del field
    gc.collect()
    assert whole() is None
    assert np.array_equal(taps_of(level, points, UNIT).rows, expected.rows)
    assert level.level(2) is level.level(2)


@pytest.mark.parametrize("is_full", [False, True])
def test_tiles_of_many_cells_lie_in_a_file_if_there_is_room(is_full, monkeypatch):
    def no_room(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    tree = Octree.from_leaves(np.unique(np.random.default_rng(0).integers(0, 8**5, 3000)), 5)
    expected = build_tiles(tree)
    monkeypatch.setattr("octex.field.tiles._IN_MEMORY", 0)
    if is_full:
        monkeypatch.setattr("octex.arrays.zeros_in", no_room)
    found = build_tiles(tree)
    for ours, theirs in ((found.masks, expected.masks), (found.firsts, expected.firsts)):
        assert np.array_equal(ours, theirs)
        assert ours.ctypes.data % CACHE_LINE == 0
        assert (type(_owner(ours)) is mmap.mmap) is not is_full


def _owner(array):
    """Return what an array's memory belongs to."""
    while isinstance(array, np.ndarray | memoryview) and (base := getattr(array, "base", None)) is not None:
        array = base
    return array.obj if isinstance(array, memoryview) else array
