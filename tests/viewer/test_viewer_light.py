"""Studio light in the page: it looks as in the library's own images."""

import numpy as np
import pytest

import octex
from octex.channels import encode
from octex.drawing import render_surface, texture_shader
from octex.drawing.environment import Environment
from octex.viewer import write_page
from tests.make.browser import Probe, camera_of, drawn
from tests.make.painted import ball

SIZE = 160, 120
_APART = np.arange(3.0)  # of the components of colours


def shiny(p):
    """What a ball is made of: from mirror to matte, half of it metal."""
    turn = np.arctan2(p[:, 2], p[:, 0])[:, None]
    return {
        "base_color": 0.5 + 0.45 * np.sin(2 * turn + _APART),
        "metallic": 0.5 + 0.5 * np.tanh(8 * p[:, 1:2]),
        "roughness": 0.5 + 0.5 * np.sin(turn),
        "occlusion": 0.7 + 0.3 * np.cos(turn),
        "emissive": 0.1 + 0.1 * np.sin(3 * turn + 2 * _APART),
        "specular": 0.05 + 0.04 * np.cos(turn + _APART),
    }


def made(names):
    return ball(32).with_sources({name: lambda p, name=name: shiny(p)[name] for name in names})


@pytest.mark.parametrize("names", [["base_color"], list(shiny(np.ones((1, 3))))])
def test_studio_light_is_the_same_in_the_page_and_in_previews(names, opens, tmp_path):
    surface = made(names)
    texture = octex.convert(surface, depth=6)
    write_page(texture, tmp_path / "page.html", surface)
    page = opens(tmp_path / "page.html", (912, 480))  # the image is 4:3
    seen = Probe(page, texture, SIZE).seen.reshape(SIZE[1], SIZE[0])[::-1]
    found = drawn(page, SIZE).astype(int)
    look = texture_shader(texture, materials=True)
    light = render_surface(surface, camera_of(page, SIZE), look, 1, Environment.studio())
    away = np.abs(found - encode(light, "uint8", "srgb")).max(axis=2)[seen]
    assert away.size > 3000
    assert np.quantile(away, 0.97) <= 2
