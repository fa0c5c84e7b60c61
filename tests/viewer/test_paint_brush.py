"""The brush of pages that paint: what it shows is what is painted, whatever it is set to."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import octex
from octex.errors import ArgumentError
from octex.viewer.session import Session
from tests.conftest import needs_jit
from tests.make.browser import served
from tests.make.same import assert_same
from tests.viewer.test_painting import _HOLD, Studio, pictured
from tests.viewer.test_session import SIZE, camera, canvas, disc, plain, stroke

BLENDS = ["over", "multiply", "screen", "add"]


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    found = Session(*canvas(), tmp_path / "out.octex")
    yield found
    found.close()


@pytest.fixture(scope="module")
def studio(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    found = Studio(browser, tmp_path_factory.mktemp("studio"))
    with served(found.viewer):
        found.shared = found.page()
        yield found
        assert found.shared.complaints == []
        found.shared.close()
    found.session.close()


@pytest.fixture
def page(studio: Studio) -> Iterator[Any]:
    """A page whose brush is as at the beginning, on a model without paint."""
    page = studio.shared
    brush = page.evaluate("({ ...viewer.painting.brush })")
    view = page.evaluate("viewer.camera.state")
    yield page
    page.evaluate("(brush) => viewer.painting.set(brush)", brush)
    page.evaluate("(view) => viewer.camera.restore(view)", view)
    while studio.session.shown.told["done"]:
        done = studio.session.shown.told["done"]
        page.keyboard.press("Control+z")
        page.wait_for_function("(n) => viewer.painting.last.done < n", arg=done, timeout=60_000)


def drawn_and_baked(studio: Studio, page: Any, drags: list[tuple[dict[str, Any], Any]]) -> tuple[Any, ...]:
    """Draw strokes; return the picture before, with what the page draws of them, and with them baked."""
    before = pictured(page)
    page.evaluate(_HOLD)
    for brush, places in drags:
        page.evaluate("(brush) => viewer.painting.set(brush)", brush)
        studio.drag(page, *places)
    page.wait_for_function("(n) => viewer.painting.sending.waiting.length === n", arg=len(drags))
    shown = pictured(page)
    page.evaluate("release()")
    studio.is_done(page, page.evaluate("viewer.painting.sending.number"))
    return before, shown, pictured(page)


def rms(one: Any, other: Any, where: Any) -> float:
    return float(np.sqrt(((one - other)[where] ** 2).mean()))


@pytest.mark.parametrize("blend", BLENDS)
def test_each_blend_mode_paints_bit_for_bit_as_the_library_does(blend: Any, session: Session) -> None:
    painter = octex.Painter(*canvas())
    image = np.zeros((SIZE[1], SIZE[0], 4), np.uint8)
    image[..., :3], image[4:28, 10:40, 3] = (200, 10, 30), disc(1)
    session.take(stroke(1, blend=blend))
    painter.paint(octex.Projection(image, camera(), opacity=0.8, blend=blend), max_angle=85)
    session.take(plain("fill", 2, color=[255, 255, 0], opacity=0.5, blend=blend))
    painter.fill(lambda points: np.ones(len(points)), (1.0, 1.0, 0.0), opacity=0.5, blend=blend)
    session.wait()
    assert session.shown.told["done"] == 2
    assert_same(session.shown.texture, painter.texture())


@pytest.mark.parametrize("blend", ["darken", "erase", 3, None, []])
def test_other_blend_modes_are_refused(blend: Any, session: Session) -> None:
    for body in (stroke(1, blend=blend), plain("fill", 1, color=[1, 2, 3], blend=blend)):
        with pytest.raises(ArgumentError, match=r"unknown blend .*; there are: over, multiply, screen, add"):
            session.take(body)


@needs_jit
@pytest.mark.parametrize("blend", BLENDS)
def test_each_blend_mode_is_seen_at_once_as_it_is_baked(blend: str, studio: Studio, page: Any) -> None:
    brush = {"blend": blend, "color": [60, 140, 230], "opacity": 0.7, "hardness": 0.8}
    other = brush | {"color": [240, 120, 40]}
    drags = [(brush, [(-60, -20), (50, 10)]), (other, [(-10, -50), (0, 40)])]
    before, shown, baked = drawn_and_baked(studio, page, drags)
    inside = np.abs(shown - before).max(axis=2) > 20
    assert inside.mean() > 0.02
    assert rms(shown, baked, inside) <= 2
