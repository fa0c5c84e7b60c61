"""Sessions of painting: what single calls give, bit for bit, forth and back."""

from __future__ import annotations

import pickle
from unittest import mock

import numpy as np
import pytest

import octex
from octex.errors import ArgumentError
from octex.painting.pictures import BLENDS, Blend
from octex.painting.projected import sight_of
from tests import random_edits
from tests.test_draft import assert_same, case

DIRECTIONS = (0.3, 0.5, 1.0), (-1.0, 0.2, 0.1)


def shots(surface: octex.Surface, random: np.random.Generator) -> list[octex.Projection]:
    """Pictures with a hole or two, of a few cameras."""
    found = []
    for _ in range(random.integers(1, 3)):
        camera = octex.Camera.fitted(surface.vertices, DIRECTIONS[random.integers(2)], size=(24, 18))
        image = random_edits.picture(int(random.integers(1000)), 24, 18, translucent=True)
        image[: random.integers(12), :, 3] = 0
        blend: Blend = BLENDS[(0, 1, 4)[random.integers(3)]]
        found.append(octex.Projection(image, camera, opacity=float(random.choice([0.5, 1])), blend=blend))
    return found


@pytest.mark.parametrize("seed", range(6))
def test_a_session_gives_what_single_calls_give_forth_and_back(seed: int) -> None:
    random, surface, texture, depth = case(seed)
    painter = octex.Painter(texture, surface)
    states, at = [texture], 0
    for _ in range(10):
        move = random.choice(["paint", "fill", "undo", "redo"], p=[0.35, 0.2, 0.3, 0.15])
        if move in ("paint", "fill"):
            if states[at].tree.n_cells > 60_000:
                continue
            before = states[at]
            if move == "paint":
                given, max_depth = shots(surface, random), int(random.integers(depth - 1, depth + 2))
                stroke = painter.paint(given, max_depth=max_depth)
                expected = octex.paint(before, surface, given, max_depth=max_depth)
            else:
                middle = surface.rest[surface.triangles[random.integers(len(surface.triangles))]].mean(axis=0)
                sphere = octex.Sphere(tuple(middle.tolist()), 0.1 * float(np.ptp(surface.rest, axis=0).max()))
                color = random.random(3)
                stroke = painter.fill(sphere, color, opacity=0.7)
                expected = octex.fill(before, surface, sphere, color, opacity=0.7)
            assert_same(painter.texture(), expected)
            assert bool(stroke) == (expected is not before)
            if stroke:
                states[at + 1 :] = [expected]
                at += 1
        elif move == "undo":
            assert painter.undo() == (at > 0)
            at = max(at - 1, 0)
        else:
            assert painter.redo() == (at + 1 < len(states))
            at = min(at + 1, len(states) - 1)
        assert len(painter.strokes) == at
        painter.texture().tree.validate()
        assert_same(painter.texture(), states[at])


def brush(surface: octex.Surface, color: int, pixels: int = 12) -> octex.Projection:
    """A disc of a colour on a small part of a surface."""
    camera = octex.Camera.fitted(surface.vertices, DIRECTIONS[0], size=(96, 96))
    image = np.zeros((96, 96, 4), np.uint8)
    y, x = np.mgrid[:96, :96]
    image[np.hypot(x - 48, y - 48) < pixels / 2] = (color, 20, 30, 255)
    return octex.Projection(image, camera)


def test_what_a_stroke_changes_can_be_applied_elsewhere_and_is_small() -> None:
    surface = random_edits.waved("sphere", 0, ["base_color"], 0)
    texture = octex.convert(surface, 8)
    painter = octex.Painter(texture, surface)
    (change,) = painter.paint(brush(surface, 200), max_depth=8)
    assert change.nbytes < 0.1 * texture.nbytes
    (sent,) = pickle.loads(pickle.dumps([change]))
    assert_same(sent.applied(texture), painter.texture())
    assert_same(sent.inverted().applied(painter.texture()), texture)
    (deeper,) = painter.paint(brush(surface, 100), max_depth=9)
    with pytest.raises(ArgumentError, match="made from another texture"):
        deeper.inverted().applied(texture)


def test_a_camera_that_stays_looks_once() -> None:
    surface = random_edits.waved("sphere", 0, ["base_color"], 0)
    painter = octex.Painter(octex.convert(surface, 6), surface)
    with mock.patch("octex.painting.ground.sight_of", wraps=sight_of) as look:
        for color in (10, 20, 30):
            painter.paint(brush(surface, color, 30))
        assert look.call_count == 1
        painter.paint(octex.Projection(brush(surface, 1).image, brush(surface, 1).camera), edge_feather=2.0)
        assert look.call_count == 2


def test_a_stroke_beside_the_surface_is_none() -> None:
    surface = random_edits.waved("sphere", 0, ["base_color"], 0)
    texture = octex.convert(surface, 5)
    painter = octex.Painter(texture, surface)
    assert painter.fill(octex.Sphere((9, 9, 9), 0.1), (1, 0, 0)) == ()
    assert painter.texture() is texture
    assert not painter.undo()
    assert not painter.redo()


def test_a_refused_stroke_leaves_all_as_it_was() -> None:
    surface = random_edits.waved("sphere", 0, ["base_color"], 0)
    texture = octex.convert(surface, 5)
    painter = octex.Painter(texture, surface)
    with pytest.raises(ArgumentError, match="channel"):
        painter.paint(brush(surface, 9), channel="roughness")
    assert painter.texture() is texture
    with pytest.raises(ArgumentError, match=r"must be an octex\.OctreeTexture"):
        octex.Painter(None, surface)  # type: ignore[arg-type]
