"""Fills of regions, and the colours that paint may have."""

import numpy as np
import pytest

import octex
from octex.errors import ArgumentError
from tests.conftest import needs_jit
from tests.make.painted import plain, square
from tests.painting.test_paint import on_square

pytestmark = needs_jit


def test_regions_are_filled_to_their_borders():
    surface = plain(square(), (0.25, 0.25, 0.25))
    texture = octex.convert(surface, 6, dtype="float32")
    points = on_square(3000)
    x, y = points[:, 0], points[:, 1]
    left = surface.vertices[surface.triangles][:, :, 0].max(axis=1) < 1e-9
    cases = [
        (octex.Sphere((0, 0, 0), 0.3), np.hypot(x, y) - 0.3),
        (
            octex.Box((-0.2, -0.1, -1), (0.3, 0.4, 1)),
            np.maximum(np.abs(x - 0.05) - 0.25, np.abs(y - 0.15) - 0.25),
        ),
        (lambda p: (p[:, 0] > p[:, 1]).astype(float), (y - x) / np.sqrt(2)),
        (left, x),
        (np.flatnonzero(left), x),
    ]
    cell = texture.placement.size / 64
    for region, distance in cases:
        found = octex.fill(texture, surface, region, (1, 0, 0))
        found.validate()
        sampled = found.sample(points)
        inner, outer = distance < -2 * cell, distance > 2.5 * cell
        np.testing.assert_allclose(sampled[inner], np.tile([1.0, 0, 0], (inner.sum(), 1)), atol=1e-4)
        np.testing.assert_allclose(sampled[outer], np.full((outer.sum(), 3), 0.25), atol=1e-4)


def test_soft_regions_and_opacity_fade():
    surface = plain(square(), (0.0, 0.0, 0.0))
    texture = octex.convert(surface, 7, dtype="float32")
    found = octex.fill(texture, surface, octex.Sphere((0, 0, 0), 0.4, soft=0.4), (1, 1, 1), opacity=0.5)
    points = on_square(500, 0.25)
    away = np.hypot(points[:, 0], points[:, 1])
    far = away > 0.05
    np.testing.assert_allclose(
        found.sample(points)[far, 0], 0.5 * np.clip((0.4 - away[far]) / 0.4, 0, 1), atol=0.01
    )


def test_filling_starts_from_nothing_too():
    surface = plain(square())
    found = octex.fill(None, surface, octex.Sphere((0, 0, 0), 0.2), 0.5, channel="roughness", max_depth=6)
    found.validate()
    assert set(found.channels) == {"roughness"}
    points = on_square(300)
    inside = np.hypot(points[:, 0], points[:, 1]) < 0.18
    assert found.contains(points[inside]).all()
    assert not found.contains(points[np.hypot(points[:, 0], points[:, 1]) > 0.26]).any()


@pytest.mark.parametrize(
    ("region", "message"),
    [
        ("all", "region must be a Sphere, a Box, a function, or triangles"),
        ([99], "region must be a Sphere"),
        (octex.Sphere((0, 0, 0), -1), "radius must be finite and above zero"),
        (octex.Box((1, 0, 0), (0, 1, 1)), "low must not exceed high"),
        (lambda _: np.zeros(3), r"region must return an array of shape \("),
        (lambda p: np.full(len(p), 2.0), r"region returned 2 at \(.*\); values must be from 0 to 1"),
        (lambda p: np.full(len(p), np.nan), r"region returned nan at \(.*\); values must be from 0 to 1"),
        (lambda _: "x", "region must return an array of shape"),
        (lambda _: {}["cover"], "region raised KeyError: 'cover' for"),
    ],
)
def test_regions_that_make_no_sense_are_refused(region, message):
    surface = plain(square())
    with pytest.raises(ArgumentError, match=message):
        octex.fill(octex.convert(surface, 3), surface, region, (1, 0, 0))


@pytest.mark.parametrize(
    ("channel", "color", "message"),
    [
        *(("base_color", odd, "finite numbers of shape") for odd in ((1, 0), (np.nan, 0, 0), 1.0)),
        *(("base_color", (sign * 255, 0, 0), "from 0 to 1") for sign in (1, -1)),
        *(("roughness", sign * 255, "from 0 to 1") for sign in (1, -1)),
        *(("normal", (sign * 255, 0, 0), "from -1 to 1") for sign in (1, -1)),
        *(("base_color", odd, f"'{odd}' is not a colour '#rrggbb'") for odd in ("#ff80", "red")),
        *((name, "#ff8000", f"'{name}' holds no colours") for name in ("roughness", "normal")),
    ],
)
def test_colours_that_do_not_fit_are_refused(channel, color, message):
    surface = plain(square())
    for texture in (None, octex.convert(surface, 3)) if channel == "base_color" else (None,):
        with pytest.raises(ArgumentError, match=message) as refused:
            octex.fill(texture, surface, octex.Sphere((0, 0, 0), 1), color, channel=channel)
        assert f"'{channel}'" in str(refused.value) or isinstance(color, str)
        assert ("divide numbers up to 255 by 255" in str(refused.value)) == message.startswith("from")


def test_light_of_floats_may_be_above_1():
    surface = plain(square())
    texture = octex.cast(octex.convert(surface, 3), "float32")
    bright = octex.fill(texture, surface, octex.Sphere((0, 0, 0), 1), (5, 9, 2))
    assert bright.sample([[0.5, 0.5, 0.0]]).max() > 4.0


def test_colours_are_given_as_on_a_screen():
    surface = plain(square())
    found = octex.fill(None, surface, octex.Sphere((0, 0, 0), 9), "#ff8000", max_depth=3)
    made = octex.convert(surface.with_sources({"base_color": "#ff8000"}), 3)
    for texture in (found, made):
        assert (texture.channels["base_color"].values == (255, 128, 0)).all()
    camera = octex.Camera.fitted(surface.vertices, (0, 0, 1), size=(8, 8))
    assert octex.Projection(np.zeros((8, 8, 3), np.uint8), camera, key="#00ff00").key == (0, 255, 0)
    with pytest.raises(ArgumentError, match="key must be a colour '#rrggbb'"):
        octex.Projection(np.zeros((8, 8, 3), np.uint8), camera, key="green")
    with pytest.raises(ArgumentError, match="'#ff8' is not a colour '#rrggbb'"):
        surface.with_sources({"base_color": "#ff8"})
