"""Painting of any channel in a real browser: what the pen draws is what is baked, and heights are seen as relief."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import octex
from octex.channels import ChannelFormat, encode
from octex.drawing import render_surface, texture_shader
from octex.drawing.environment import Environment
from octex.source.surface import Surface
from octex.texture import Channel, OctreeTexture
from octex.texture.channel import row_counts
from octex.viewer import Viewer, write_page
from octex.viewer.session import Session
from tests.conftest import needs_jit
from tests.make.browser import Probe, camera_of, drawn, file_url, opened, served
from tests.make.painted import ball
from tests.viewer.test_painting import _HOLD, Studio

SCALARS = {"roughness": 0.6, "metallic": 0.1, "occlusion": 0.9}
VIEW = 240, 200


class Workshop(Studio):
    """A ball of a plain material, with a height and a number that light does not show."""

    open: Any

    def __init__(self, browser: Any, folder: Path) -> None:
        self.surface: Surface = ball(24).with_sources(
            {"base_color": lambda p: np.full_like(p, 0.5), "emissive": (0.0, 0.0, 0.0), **SCALARS}
        )
        self.texture: OctreeTexture = octex.convert(self.surface, depth=6)
        for name in ("height", "moisture"):
            self.texture = with_halves(self.texture, name)
        self.session = Session(self.texture, self.surface, folder / "out.octex")
        self.viewer = Viewer(lambda: self.texture, folder / "ball.octex", self.surface, session=self.session)
        self.browser = browser


def with_halves(texture: OctreeTexture, name: str) -> OctreeTexture:
    """Return a texture with one more channel, of 1/2 everywhere."""
    parts = (np.full((count, 1), 128, np.uint8) for count in row_counts(texture.tree))
    channel = Channel(ChannelFormat(name, 1, "data"), *parts)
    return texture.with_cells(texture.tree, {**texture.channels, name: channel})


@pytest.fixture(scope="module")
def shop(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workshop]:
    found = Workshop(browser, tmp_path_factory.mktemp("shop"))
    with served(found.viewer):
        found.open = found.page()
        yield found
        found.open.close()
    found.session.close()


@pytest.fixture
def page(shop: Workshop) -> Iterator[Any]:
    """A page, whose steps are undone afterwards."""
    page = shop.open
    yield page
    page.evaluate("() => { for (let n = viewer.painting.last.done; n > 0; n--) viewer.painting.undo(); }")
    page.wait_for_function("viewer.painting.last.done === 0", timeout=60_000)
    assert page.complaints == []


def pictured(page: Any, shown: str, channel: str = "base_color") -> npt.NDArray[np.int64]:
    return drawn(page, VIEW, shown=shown, channel=channel, marked=None, facing=False).astype(np.int64)


def ticked(page: Any, **values: float | list[int]) -> None:
    page.evaluate(
        "(values) => viewer.painting.set({ ticked: Object.keys(values), values: { ...viewer.painting.brush.values, ...values } })",
        values,
    )


@needs_jit
@pytest.mark.parametrize(
    "values",
    [
        {"roughness": 0.1},
        {"metallic": 1.0, "roughness": 0.2},
        {"base_color": 0, "roughness": 0.9, "metallic": 0.9, "occlusion": 0.3, "emissive": [60, 10, 90]},
        {"moisture": 1.0},
        {"height": 1.0},
    ],
    ids=" ".join,
)
def test_channels_are_seen_at_once_as_they_will_be_painted(
    values: dict[str, Any], shop: Workshop, page: Any
) -> None:
    ticked(page, **values)
    looks = [*(("channel", name) for name in values), ("lit", "base_color")]
    plain = {look: pictured(page, *look) for look in looks}
    page.evaluate(_HOLD)
    page.evaluate("viewer.look.shown = 'channel'; viewer.look.channel = viewer.painting.brush.ticked[0]")
    first = page.evaluate("viewer.painting.sending.number")
    for places in (((-60, 0), (0, -40)), ((0, -40), (60, 20))):
        shop.drag(page, *places)
    page.wait_for_function("viewer.painting.sending.waiting.length === 2")
    before = {look: pictured(page, *look) for look in looks}
    page.evaluate("release()")
    shop.is_done(page, first + 2)
    is_painted = np.zeros(VIEW[::-1], np.bool_)
    for look in looks:
        after = pictured(page, *look)
        is_changed = np.abs(after - plain[look]).max(axis=2)
        if look[0] == "channel":
            is_painted |= is_changed > 12
            assert 0.02 < is_painted.mean() < 0.3
        assert (is_changed > 2).any() == (look[0] == "channel" or "moisture" not in values)
        assert np.sqrt(((before[look] - after)[is_painted] ** 2).mean()) <= 2, look
    for name, channel in shop.texture.channels.items():
        shape = channel.values.shape
        if name not in values and shop.session.shown.texture.channels[name].values.shape == shape:
            assert (shop.session.shown.texture.channels[name].values == channel.values).all()
