"""Strokes below other layers and erasers are shown as they will be painted."""

from types import SimpleNamespace

import numpy as np
import pytest

import octex
from octex.errors import ArgumentError
from octex.painting.composites import composite_after
from octex.viewer.answers import packed_composite
from tests.conftest import needs_jit
from tests.make.painted import ball
from tests.make.studio import _HOLD, SIZE, imaged
from tests.painting.test_layers import everywhere

pytestmark = needs_jit

_KEY = "[null, viewer.painting.preview.composite.key].includes(viewer.painting.preview.key)"


def stacked():
    """Return layers that cover parts of a ball, and their numbers."""
    surface = ball(32)
    source = surface.with_sources({"base_color": lambda p: np.clip(0.4 * p + 0.5, 0, 1)})
    layers = octex.Layers(octex.convert(source, depth=5), surface)
    layers.fill(lambda p: (p[:, 2] > 0).astype(float), [0.5, 0.4, 0.1])
    first = layers.add_layer(opacity=0.7).number
    layers.fill(lambda p: (p[:, 0] > 0.1).astype(float), [0.8, 0.1, 0.1])
    second = layers.add_layer(blend="multiply", opacity=0.5, name="shade").number
    layers.fill(lambda p: (p[:, 1] > 0).astype(float), [0.2, 0.9, 0.3])
    return layers, [first, second]


@pytest.mark.parametrize("place", [None, 0, 1])
@pytest.mark.parametrize(
    ("stroke", "channel"), [("erased", "base_color"), ("painted", "base_color"), ("painted", "white")]
)
def test_what_strokes_lead_to_is_what_they_make_of_all(place, stroke, channel):
    layers, numbers = stacked()
    number = None if place is None else numbers[place]
    found = composite_after(layers.stacked, number, stroke)
    assert found is not None
    layers.choose(number)
    layers.fill(everywhere, [float(channel == "white")] * 3, blend="erase" if stroke == "erased" else "over")
    made = layers.texture()
    points = ball(32).rest
    own, wanted = (
        texture.sample(points, [name], "nearest")[name]
        for texture, name in ((found, channel), (made, "base_color"))
    )
    known = np.ones(len(points), np.bool_)
    if "alpha" in found.channels:
        known = found.sample(points, ["alpha"], "nearest")["alpha"][:, 0] > 0.5
    assert known.mean() > 0.2
    assert (own[known] == wanted[known]).all()


def test_nothing_is_told_where_no_other_paint_is_met():
    surface = ball(8)
    layers = octex.Layers(octex.convert(surface.with_sources({"base_color": np.ones_like}), depth=3), surface)
    number = layers.add_layer().number
    assert composite_after(layers.stacked, number, "painted") is None
    session = SimpleNamespace(shown=SimpleNamespace(stacked=layers.stacked))
    for asked in (number, number + 1):  # a page may ask for a layer that is being undone
        assert packed_composite(session, f'{{"layer": {asked}, "stroke": "painted"}}') == b"null\n"
    for refused in ("", "[]", '{"layer": -1, "stroke": "painted"}', '{"layer": null, "stroke": "up"}'):
        with pytest.raises(ArgumentError):
            packed_composite(session, refused)


def test_paint_below_layers_and_erasers_are_shown_as_they_are_baked(studio, page):
    page.set_viewport_size({"width": 900, "height": 210})  # without a GPU, each pixel beneath costs 0.1 ms

    told = page.wait_for_function

    def stroke(tool, **brush):
        """Draw a stroke; return how far what is shown is from what is baked, inside it, in codes."""
        page.evaluate(
            "([tool, brush]) => (viewer.painting.selectTool(tool), viewer.painting.set(brush))", [tool, brush]
        )
        told(_KEY)
        plain = imaged(page)
        page.evaluate(_HOLD)
        studio.drag(page, (-35, 3), (35, -3))
        told("viewer.painting.strokes.sent.length === 1")
        before = imaged(page)
        page.evaluate("release()")
        told("!viewer.painting.strokes.sent.length")
        after = imaged(page)
        inside = np.abs(after - plain).max(axis=2) > 20
        assert inside.mean() > 0.01
        return float(np.sqrt(((before - after)[inside] ** 2).mean()))

    colors = {"color": [250, 210, 40], "hardness": 0.7, "size": 30}
    numbers = []  # of the layers: other tests have had some too
    for reach, color in ((20, [30, 60, 220]), (40, [20, 200, 90])):
        page.evaluate("viewer.painting.layers.sendNew('add', 'Add a layer')")
        told(f"viewer.painting.layers.stack.length === {len(numbers) + 1}")
        numbers.append(page.evaluate("viewer.painting.layers.active"))
        page.evaluate("(brush) => viewer.painting.set(brush)", {"color": color, "size": 40})
        studio.drag(page, (-reach, -30), (20, 30))
        told("!viewer.painting.strokes.sent.length")
    page.evaluate("viewer.painting.layers.send('set', '', { opacity: 0.6, blend: 'multiply' })")
    told("viewer.painting.layers.stack[1].blend === 'multiply'")
    found = {}
    for chosen in (None, *numbers):
        page.evaluate("(chosen) => viewer.painting.layers.select(chosen)", chosen)
        found["paint", chosen] = stroke("brush", **colors)
        found["eraser", chosen] = stroke("eraser", **colors)
    page.set_viewport_size({"width": SIZE[0], "height": SIZE[1]})
    assert max(found.values()) <= 2
