"""Layers that lie behind each other, and masks."""

import numpy as np
import pytest

import octex
from octex.cameras.camera import Camera
from octex.drawing import (
    rasters,
    render_leaves,
    render_surface,
    source_shader,
    texture_shader,
)
from octex.drawing.shaders import Appearance
from octex.drawing.soft_light import background
from octex.source.surface import Surface
from tests.drawing.test_preview import FRONT, SQUARE, TWO, _camera, _square


def _sheets(alphas, colors, order):
    """Squares behind each other toward −z, in some order, each of a colour and an alpha."""
    vertices = np.vstack([SQUARE - [0.0, 0.0, 0.1 * n] for n in order])
    triangles = np.vstack([TWO + 4 * n for n in range(len(order))])
    rgba = np.column_stack([colors, alphas])[order]
    return Surface.from_arrays(vertices, triangles, colors=rgba.repeat(4, axis=0), alpha="blend")


def _over(alphas, colors, behind):
    """Composite, the nearest first."""
    for alpha, color in zip(alphas[::-1], colors[::-1], strict=True):
        behind = alpha * np.asarray(color) * FRONT + (1 - alpha) * behind
    return behind


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [3, 1, 0, 2]])
def test_layers_are_drawn_over_what_is_behind_them_in_whatever_order_they_are_stored(order):
    alphas, colors = np.array([0.5, 0.0, 0.25, 0.6]), np.array([[1, 0, 0], [1, 1, 1], [0, 1, 0], [0, 0, 1.0]])
    surface = _sheets(alphas, colors, order)
    truth = _over(alphas, colors, background(4, 4))
    assert np.allclose(render_surface(surface, _camera(4), source_shader(surface), 2), truth, atol=1e-5)
    texture = octex.convert(surface, 7)
    found = render_surface(surface, _camera(4), texture_shader(texture), 2)
    assert np.allclose(found[1:-1, 1:-1], truth[1:-1, 1:-1], atol=0.02)


def test_what_is_opaque_ends_the_layers_and_each_look_has_its_own():
    surface = _sheets(np.array([0.5, 1.0, 1.0]), np.eye(3), [2, 0, 1])
    seen = []

    def red(hits):
        seen.append(len(hits.width))
        return Appearance(np.tile([1.0, 0.0, 0.0], (len(hits.width), 1)))

    both = rasters.film_surface(surface, _camera(4), [source_shader(surface), red], 1)
    assert seen == [16, 16]  # behind the first layer, nothing behind the second
    truth = _over(np.array([0.5, 1.0]), np.eye(3)[:2], 0.0)
    assert np.allclose(both[0].image(), truth, atol=1e-6)
    assert np.allclose(both[1].image(), FRONT * np.array([1.0, 0, 0]), atol=1e-6)


@pytest.mark.parametrize("cutoff", [0.25, 0.5, 0.75])
def test_masks_are_cut_out_at_their_cutoff_and_show_what_is_behind(cutoff):
    ramp = np.zeros((64, 64, 4), np.uint8)
    ramp[..., 0] = 255
    ramp[..., 3] = np.rint(np.linspace(0, 255, 64))[:, None]
    card = {"uv": SQUARE[:, :2], "image": ramp, "wrap": "clamp"}
    masked = _square(**card, alpha="mask", cutoff=cutoff)
    wall = Surface.from_arrays(SQUARE - [0, 0, 0.5], TWO, factor=(0.0, 0.0, 1.0))
    both = Surface.joined([masked, wall])
    texture = octex.convert(both, 6)
    for look in (source_shader(both), texture_shader(texture)):
        image = render_surface(both, _camera(32), look, 2) / FRONT
        rows = np.arange(32)
        is_card = (rows + 0.5) / 32 > cutoff
        clear = np.abs((rows + 0.5) / 32 - cutoff) > 0.06
        clear[:2] = clear[-2:] = False
        assert np.allclose(image[is_card & clear][:, 4:-4], [1, 0, 0], atol=0.02)
        assert np.allclose(image[~is_card & clear][:, 4:-4], [0, 0, 1], atol=0.02)


def test_leaves_that_cover_nothing_hide_nothing():
    both = _sheets(np.array([0.0, 1.0]), np.array([[1, 1, 1], [0.2, 0.4, 0.6]]), [0, 1])
    camera = Camera.fitted(SQUARE, [0.0, 0.0, 1.0], size=(64, 64), margin=0.25)
    image = render_leaves(octex.convert(both, 6), camera, supersample=1)
    assert np.allclose(image[24:40, 24:40] / FRONT, [0.2, 0.4, 0.6], atol=0.03)
