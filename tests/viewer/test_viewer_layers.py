"""Translucent surfaces in the page: what is opaque first, then the nearest translucent layer over it."""

import numpy as np
import pytest

import octex
from octex.channels import linear_to_srgb
from octex.source.surface import Surface
from octex.viewer import write_page
from tests.make.browser import drawn

SIZE = 64, 48
RED, GREEN, BLUE = np.eye(3)
GROUND = np.array([0.925, 0.93, 0.94])


def panes(alphas):
    """Squares one behind another: at each z a colour and its alpha."""
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = np.concatenate([square + np.array([0, 0, z]) for z in alphas])
    triangles = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * n for n in range(len(alphas))])
    places, kinds = np.array(list(alphas)), list(alphas.values())

    def nearest(p):
        return np.abs(p[:, 2:] - places).argmin(axis=1)

    colors, covers = np.array([kind[0] for kind in kinds]), np.array([kind[1] for kind in kinds])
    return Surface.from_arrays(vertices, triangles).with_sources(
        {"base_color": lambda p: colors[nearest(p)], "alpha": lambda p: covers[nearest(p)][:, None]}
    )


def middle(opens, surface, path):
    """Return the colour in the middle of the image, without light, and what a pick finds there."""
    write_page(octex.convert(surface, depth=5), path, surface)
    page = opens(path, (912, 480), is_drawn=False)
    page.evaluate("viewer.camera.reset(0, 0)")
    color = drawn(page, SIZE, mode="unlit")[SIZE[1] // 2, SIZE[0] // 2]
    found = page.evaluate("viewer.pick(viewer.canvas.clientWidth / 2, viewer.canvas.clientHeight / 2)")
    return color, found


def over(color, alpha, behind):
    return alpha * np.asarray(color) + (1 - alpha) * np.asarray(behind)


@pytest.mark.parametrize(
    ("layers", "expected", "picked"),
    [
        ({-1.0: (BLUE, 1.0), 1.0: (RED, 0.4)}, over(RED, 0.4, BLUE), 1.0),  # glass over what is opaque
        ({-1.0: (BLUE, 1.0), 0.0: (GREEN, 0.5), 1.0: (RED, 0.4)}, over(RED, 0.4, BLUE), 1.0),  # the nearest
        ({-1.0: (BLUE, 1.0), 0.0: (GREEN, 0.5), 1.0: (RED, 0.0)}, over(GREEN, 0.5, BLUE), 0.0),  # cut out
        ({-1.0: (BLUE, 0.5), 1.0: (RED, 1.0)}, RED, 1.0),  # what is hidden adds nothing
    ],
)
def test_the_nearest_translucent_layer_lies_over_what_is_opaque(layers, expected, picked, opens, tmp_path):
    color, found = middle(opens, panes(layers), tmp_path / "panes.html")
    assert np.abs(color - 255 * linear_to_srgb(expected)).max() <= 2
    assert found["rest"][2] == pytest.approx(picked, abs=1e-3)


def test_a_translucent_layer_alone_lies_over_the_ground_in_linear_light(opens, tmp_path):
    from octex.channels import srgb_to_linear

    color, _ = middle(opens, panes({0.0: (GREEN, 0.5)}), tmp_path / "pane.html")
    expected = over(GREEN, 0.5, srgb_to_linear(GROUND))
    assert np.abs(color - 255 * linear_to_srgb(expected)).max() <= 2
