"""Lookups from one's own kernels, beside those of arrays."""

import sys

import numpy as np
import pytest

import octex.kernels
from octex import jit
from octex.errors import ArgumentError
from octex.jit.cache import cached
from octex.texture import Channel, OctreeTexture
from tests.conftest import needs_jit
from tests.make.small_textures import eight_colors, shell
from tests.make.strategies import random_values
from tests.properties.random_lookups import random_points, random_texture

FILTERS = "nearest", "linear", "quadratic"
SEEDS = range(3 if jit.DISABLED else 40)


def compiled(function):
    """As numba.njit compiles it; the code is stored until the source changes here or in octex."""
    return function if jit.DISABLED else cached(function, {"nogil": True})


@compiled
def look_up(arrays, points, widths, normals, way, results):
    """Look points up as FILTERS[way], or by their widths and normals."""
    scratch = octex.kernels.new_scratch(arrays)
    for n in range(len(points)):
        if way == 0:
            found = octex.kernels.nearest(arrays, points[n], scratch)
        elif way == 1:
            found = octex.kernels.linear(arrays, points[n], scratch)
        elif way == 2:
            found = octex.kernels.quadratic(arrays, points[n], scratch)
        else:
            found = octex.kernels.footprint(arrays, points[n], widths[n], normals[n], scratch)
        for component in range(4):
            results[n, component] = found[component]


@compiled
def find(arrays, points, results):
    """Look points up in their cells, as (n, 4)."""
    scratch = octex.kernels.new_scratch(arrays)
    for n in range(len(points)):
        a, b, c, d = octex.kernels.nearest(arrays, (points[n, 0], points[n, 1], points[n, 2]), scratch)
        results[n, 0], results[n, 1], results[n, 2], results[n, 3] = a, b, c, d


def found_by(texture, name, points, way, widths=0.0, normals=0.0):
    results = np.empty((len(points), 4))
    arrays = octex.kernels.arrays_of(texture, name)
    widths = np.broadcast_to(np.asarray(widths, np.float64), len(points)).copy()
    normals = np.broadcast_to(np.asarray(normals, np.float64), (len(points), 3)).copy()
    look_up(arrays, points, widths, normals, way, results)
    components = texture.channels[name].format.components
    assert not results[:, components:].any()
    return results[:, :components]


def check_all_ways(texture, points, random, about):
    n = len(points)
    widths = texture.placement.size * np.where(random.random(n) < 0.2, 0, 2.0 ** random.uniform(-8, 2, n))
    normals = random.normal(size=(n, 3))
    for name in texture.channels:
        close = {"atol": 2e-6 * max(float(np.abs(texture.rows(name)).max()), 1), "rtol": 0}
        for way, filter in enumerate(FILTERS):
            expected = texture.sample(points, name, filter, normalize=False)
            found = found_by(texture, name, points, way)
            np.testing.assert_allclose(found, expected, **close, err_msg=f"{about}: {name}, {filter}")
        for views, given in (
            ({"width": widths}, (widths, 0.0)),
            ({"normals": normals}, (0.0, normals)),
            ({"width": widths, "normals": normals}, (widths, normals)),
        ):
            expected = texture.sample(points, name, normalize=False, **views)
            found = found_by(texture, name, points, 3, *given)
            np.testing.assert_allclose(found, expected, **close, err_msg=f"{about}: {name}, {list(views)}")


@pytest.mark.parametrize("seed", SEEDS)
def test_lookups_in_kernels_are_those_of_arrays(seed):
    random = np.random.default_rng(seed)
    texture = random_texture(random, ("uint8",))
    points, _ = random_points(texture, random, 8)
    check_all_ways(texture, points, random, f"seed {seed}: {texture!r}")


@needs_jit
def test_lookups_in_kernels_are_those_of_arrays_where_the_tree_is_large():
    random = np.random.default_rng(0)
    directions = random.normal(size=(2000, 3))
    points = 0.5 + 0.45 * directions / np.linalg.norm(directions, axis=1)[:, None]
    points[1000:] += random.uniform(-0.05, 0.05, (1000, 3))
    for keep in (0.0, 0.3):
        check_all_ways(shell(6, keep), points, random, f"shell, {keep}")


@needs_jit
@pytest.mark.parametrize("dtype", ["uint16", "float16", "float32"])
def test_lookups_in_kernels_are_those_of_arrays_for_every_type(dtype):
    random = np.random.default_rng(3)
    color, points = shell(3), random.random((50, 3))
    channel = color.channels["base_color"]
    for space in ("srgb", "linear") if dtype == "float32" else ("srgb",):
        form = channel.format._replace(dtype=dtype, space=space)
        values = [random_values(part.shape, dtype, random) for part in channel[1:]]
        channels = {"base_color": Channel(form, *values)}
        texture = OctreeTexture(color.tree, channels, color.placement, color.bounds)
        results, arrays = np.empty((50, 4)), octex.kernels.arrays_of(texture)
        expected = texture.sample(points, filter="nearest")
        find(arrays, points, results)  # the others read values alike, and take seconds to compile for a type
        scale = max(float(np.abs(expected).max()), 1)
        np.testing.assert_allclose(results[:, :3], expected, rtol=0, atol=2e-6 * scale)


def test_a_position_that_is_no_number_is_taken_for_the_corner():
    texture = eight_colors()
    points = np.array([[np.nan, 0.9, np.nan], [-np.inf, np.inf, 0.0]])
    for way in range(4):
        found = found_by(texture, "base_color", points, way, np.nan)
        corner = found_by(texture, "base_color", np.array([[0, 0.9, 0], [0, 1, 0]]), way)
        np.testing.assert_array_equal(found, corner)


def test_kernels_leave_mixed_cells_to_finer_levels_by_the_threshold_that_is_given():
    texture, points = shell(3), np.random.default_rng(1).random((20, 3))
    assert texture.tree.split.cells.size
    results = np.empty((20, 4))
    widths, normals = np.full(20, 0.4), np.zeros((20, 3))
    for threshold in (0.0, 0.2, np.inf):
        arrays = octex.kernels.arrays_of(texture, bleed_threshold=threshold)
        look_up(arrays, points, widths, normals, 3, results)
        expected = texture.sample(points, width=0.4, bleed_threshold=threshold)
        np.testing.assert_allclose(results[:, :3], expected, atol=2e-6)


def test_what_kernels_take_can_be_passed_into_parallel_loops_and_is_left_as_it_was():
    texture = shell(2)  # which has some of the arrays
    arrays = octex.kernels.arrays_of(texture)
    assert all(isinstance(each, (np.ndarray, int, float)) for each in arrays)  # numba takes no others there
    held = [each for each in arrays if isinstance(each, np.ndarray)]
    before = [sys.getrefcount(each) for each in held]
    for _ in range(20):
        look_up(arrays, np.full((3, 3), 0.5), np.zeros(3), np.ones((3, 3)), 3, np.empty((3, 4)))
    assert [sys.getrefcount(each) for each in held] == before


def test_kernels_take_textures_and_their_channels_only():
    with pytest.raises(ArgumentError, match="must be an octex"):
        octex.kernels.arrays_of("droid.octex")
    with pytest.raises(ArgumentError, match="unknown channel 'gloss'"):
        octex.kernels.arrays_of(eight_colors(), "gloss")
    with pytest.raises(ArgumentError, match="bleed_threshold must be from 0"):
        octex.kernels.arrays_of(eight_colors(), bleed_threshold=-1)


@pytest.mark.skipif(jit.DISABLED, reason="plain functions can be called anywhere")
def test_what_is_for_kernels_says_so():
    arrays = octex.kernels.arrays_of(eight_colors())
    with pytest.raises(TypeError, match="quadratic can be called in kernels only"):
        octex.kernels.quadratic(arrays, (0.5, 0.5, 0.5), octex.kernels.new_scratch(arrays))
