"""From which side a model is seen."""

import numpy as np
import pytest

import octex
from octex.drawing import draw_preview
from octex.drawing.directions import best_direction, view_directions
from octex.source.surface import Surface
from tests.drawing.test_preview import SQUARE, TWO


def test_flat_models_are_seen_aslant_from_the_sides_that_they_face_others_from_above_and_the_right():
    for normal in np.vstack([np.eye(3), -np.eye(3)]):
        (direction,) = view_directions(normal[None], np.ones(1))
        assert np.isclose(np.linalg.norm(direction), 1.0)
        assert 0.88 < direction @ normal < 0.95
        front, back = view_directions(np.array([normal, -normal]), np.ones(2)) @ normal
        assert 0.88 < abs(front) < 0.95
        assert 0.88 < abs(back) < 0.95
        assert front * back < 0
    usual = view_directions(np.eye(3), np.ones(3))[0]
    assert np.allclose(view_directions(usual[None], np.ones(1)), usual)
    directions = view_directions(np.vstack([np.eye(3), -np.eye(3)]), np.ones(6))
    assert directions[0, 2] > directions[0, 0] > 0.0
    assert (directions[:, 1] > 0.0).all()
    assert len(np.unique(np.sign(directions), axis=0)) == 4
    assert np.array_equal(view_directions(np.zeros((1, 3)), np.zeros(1)), directions)


@pytest.mark.parametrize(
    ("front", "back", "seen"), [(20, 10, 1.0), (20, 21, 1.0), (20, 23, -1.0), (0, 1, -1.0)]
)
def test_a_model_is_seen_from_behind_only_if_that_shows_clearly_more_detail(front, back, seen):
    def unlit(camera):
        image = np.zeros((camera.height, camera.width, 3))
        image[:10] = np.nan
        image[20, 2 : 2 + 2 * (front if camera.position[2] > 0.0 else back) : 2] = 1.0
        return image

    directions = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    assert best_direction(directions, SQUARE, unlit)[2] == seen
    assert best_direction(directions[:1], SQUARE, unlit)[2] == 1.0


@pytest.mark.parametrize("kind", ["surface", "texture"])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_preview_shows_the_side_with_most_detail(kind, side):
    # Two squares back to back, one grey, one in four quarters of black and white.
    vertices = np.vstack([SQUARE, SQUARE - [0.0, 0.0, 0.4]]) * [1.0, 1.0, side]
    triangles = np.vstack([TWO, TWO[:, ::-1] + 4])[:, :: int(side)]
    image = np.full((16, 32), 128, np.uint8)
    image[:, 16:] = np.kron(np.eye(2), np.ones((8, 8))) * 255
    uv = np.vstack([SQUARE[:, :2], SQUARE[:, :2] + [1.0, 0.0]]) * [0.5, 1.0]
    surface = Surface.from_arrays(vertices, triangles, uv=uv, image=image, mag_filter="nearest", wrap="clamp")
    things = (None, surface) if kind == "surface" else (octex.convert(surface, depth=3),)
    preview = draw_preview(*things, size=(80, 64), supersample=1)
    assert (preview[:40].max(axis=2) < 20).any()  # black


@pytest.mark.parametrize(
    ("details", "seen"), [((10, 22, 23), 1), ((10, 22, 25), 2), ((22, 22, 23), 0), ((0, 0.02, 0.04), 0)]
)
def test_the_first_of_the_sides_that_show_about_most_is_seen_and_rounding_is_no_detail(details, seen):
    directions = np.eye(3)

    def unlit(camera):
        image = np.zeros((camera.height, camera.width))
        shown = details[int(np.argmax(camera.position - SQUARE.mean(axis=0)))]
        image[20, 2:46:2] = shown / 25
        return image

    assert np.array_equal(best_direction(directions, SQUARE, unlit), directions[seen])
