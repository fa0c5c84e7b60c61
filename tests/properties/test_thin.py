"""Something thin: its sides at any footprint, and what cannot be told apart; averages beside the source."""

import numpy as np
import pytest

import octex
from octex.channels import linear_to_srgb
from octex.source.surface import Surface
from octex.texture import FILTERS
from octex.tree.layout import SPLIT
from tests.conftest import needs_jit
from tests.make.painted import ball
from tests.make.small_surfaces import bent, sheet, turned
from tests.make.small_textures import unit


@needs_jit
@pytest.mark.parametrize("fit", [False, True])
@pytest.mark.parametrize("thickness", [0.0, 0.004, 0.02, 0.035])  # cells are 0.038 or so wide
@pytest.mark.parametrize("seed", range(3))
def test_each_side_of_something_thin_shows_its_own_colour(seed, thickness, fit):
    turn = turned(seed)
    surface = sheet(turn, thickness)
    texture = octex.convert(surface, depth=5, fit=fit)
    texture.validate()
    cell = texture.placement.size / 32
    samples = surface.scatter(150)
    is_front = (samples.triangles < len(surface.triangles) // 2)[:, None]
    normals = np.where(is_front, turn[:, 2], -turn[:, 2])
    expected = np.where(is_front, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    tangents = unit(np.cross(normals, [0.3, 0.5, 0.8]))
    across = np.cross(normals, tangents)
    for cells in (0.1, 0.7, 1, 3, 10, 40):
        width = cells * cell
        for filter in FILTERS:
            found = texture.sample(samples.rest, filter=filter, width=width, normals=normals)
            assert np.abs(found - expected).max() <= 1 / 255
        found = texture.sample(samples.rest, dPdx=5 * width * tangents, dPdy=width * across, normals=normals)
        assert np.abs(found - expected).max() <= 1 / 255
    away = np.cross(normals, [[0.3, -0.5, 0.1]])  # what faces neither shows both
    both = texture.sample(samples.rest, width=40 * cell, normals=1e-3 * away)
    assert (both[:, 2] < 0.01).all()


def test_the_papers_rule_goes_down_to_where_sides_are_apart():
    surface = sheet(np.eye(3), 0.2)
    texture = octex.convert(surface, depth=6, fit=False)
    samples = surface.scatter(300)
    is_front = (samples.triangles < len(surface.triangles) // 2)[:, None]
    expected = np.where(is_front, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    for width in (0.01, 0.2, 1.0, 10.0):
        found = texture.sample(samples.rest, filter="nearest", width=width)
        assert np.abs(found - expected).max() <= 1 / 255
        # The spline between cells reaches the other side's cells where they are the next ones.
        assert np.abs(texture.sample(samples.rest, width=width) - expected).max() < 0.45
    blind = texture.sample(samples.rest, width=10.0, bleed_threshold=2.0)
    np.testing.assert_allclose(blind, [[0.5, 0.5, 0.0]] * 300, atol=0.01)


def test_a_front_and_a_back_that_are_nearly_alike_may_mix():
    surface = sheet(np.eye(3), 0.2)
    half = len(surface.triangles) // 2
    colors = np.where(np.arange(2 * half)[:, None] < half, 0.5, 0.52) * np.ones(3)
    alike = Surface.from_arrays(surface.vertices, surface.triangles, face_colors=colors)
    texture = octex.convert(alike, depth=6, fit=False)
    assert texture.tree.arrays.flags[0] & SPLIT
    rest = alike.scatter(50).rest
    np.testing.assert_allclose(texture.sample(rest, width=10.0), 0.51, atol=0.003)
    apart = texture.sample(rest, filter="nearest", width=10.0, bleed_threshold=0.01)
    assert (np.abs(apart - 0.51) > 0.006).all()


@needs_jit
def test_a_model_without_thin_places_has_no_leaf_split_and_pays_nothing():
    texture = octex.convert(ball(20), depth=6)
    assert (texture.tree.split.cells < texture.tree.arrays.level_cells[3]).all()


@needs_jit
def test_what_is_thin_is_fitted_on_each_of_its_sides():
    surface = bent(0.02)
    samples = surface.scatter(20_000)
    source = linear_to_srgb(surface.evaluate(samples))

    def error(fit, normals):
        found = octex.convert(surface, depth=6, fit=fit).sample(samples.rest, normals=normals)
        return float(np.sqrt(np.mean((linear_to_srgb(found) - source) ** 2)))

    assert error(True, samples.normals) < 0.65 * error(False, samples.normals) < 0.01
    assert error(True, None) < error(False, None)


def test_leaves_that_only_look_moved_are_not_split():
    tree = octex.convert(sheet(np.eye(3), 0.0), depth=4, fit=False).tree
    assert np.array_equal(tree.split.cells, np.arange(tree.n_cells))


@needs_jit
@pytest.mark.parametrize("facing", [False, True])
def test_nothing_jumps_along_a_slow_zoom_or_a_slow_path(facing):
    texture = octex.convert(bent(0.02), depth=5)
    steps = 30_000
    turn = np.linspace(0.3, 2.8, steps)
    outward = np.column_stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
    path = outward + np.array([0.0, 0.0, 0.43])
    for width in (0.0, 0.05, 0.3, 1.0):
        found = texture.sample(path, width=width, normals=outward if facing else None)
        assert np.abs(np.diff(found, axis=0)).max() < 0.003
        assert np.ptp(found) > 0.05
    point = np.repeat(path[5000:5001], steps, axis=0)
    normals = np.repeat(outward[5000:5001], steps, axis=0) if facing else None
    widths = np.exp(np.linspace(np.log(0.005), np.log(9.0), steps))
    zoom = texture.sample(point, width=widths, normals=normals)
    assert np.abs(np.diff(zoom, axis=0)).max() < 0.003
    right, down = np.array([[1.0, 0.3, 0.0]]), np.array([[0.0, 0.2, 0.2]])
    long = texture.sample(point, dPdx=right * widths[:, None], dPdy=down * widths[:, None], normals=normals)
    assert np.abs(np.diff(long, axis=0)).max() < 0.003
    blind = texture.sample(point, width=widths, bleed_threshold=np.inf)
    assert np.abs(np.diff(blind, axis=0)).max() < 0.003
