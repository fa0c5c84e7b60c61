"""A model that is painted in a real browser."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import octex
from octex.session.painting import Session
from octex.source.motion import Motion
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.viewer import Viewer
from tests.make.browser import drawn, opened, served
from tests.make.painted import ball

SIZE = 900, 420
#: Keeps answers of the server back, as a slow line does.
_HOLD = """() => {
  const { fetch } = window;
  globalThis.release = () => void (window.fetch = fetch);
  window.fetch = async (...asked) => {
    while (asked[0] === "session" && window.fetch !== fetch) await new Promise((go) => setTimeout(go, 20));
    return fetch(...asked);
  };
}"""
#: What of a page each test finds as it was at first.
_STATE = """() => ({
  brush: { ...viewer.painting.brush },
  view: viewer.camera.state,
  scale: viewer.maxScale,
  open: [...document.querySelectorAll("aside details[open]")].map((each) => each.id),
})"""
_RESTORE = """({ brush, view, scale, open }) => {
  const { painting, camera } = viewer;
  globalThis.release?.(); // a test that failed holds answers back
  painting.set(brush);
  painting.selectTool("brush");
  for (const each of document.querySelectorAll("aside details")) each.open = open.includes(each.id);
  camera.restore(view);
  viewer.maxScale = scale;
  viewer.invalidate();
  for (let n = painting.status.done; n > 0; n--) painting.undo();
}"""


class Studio:
    """A model that is painted in a page: by default a grey ball."""

    def __init__(
        self,
        browser: Any,
        folder: Path,
        surface: Surface | None = None,
        texture: OctreeTexture | None = None,
        *,
        depth: int = 6,
        motion: Motion | None = None,
    ) -> None:
        self.browser, self.output = browser, folder / "out.octex"
        self.surface: Surface = surface or ball(32)
        if surface is None:
            surface = self.surface.with_sources({"base_color": lambda p: np.full_like(p, 0.5)})
        self.texture = texture or octex.convert(surface, depth=depth)
        self.session = Session(self.texture, self.surface, self.output, motion=motion)
        path, shown = folder / "ball.octex", {"motion": motion, "session": self.session}
        self.viewer = Viewer(lambda: self.texture, path, self.surface, **shown)

    def page(self) -> Any:
        """Open a page; the cell under a pointer that rests is not marked, as its program takes a second."""
        page = opened(self.browser, self.viewer.url, SIZE)
        page.wait_for_function("viewer.painting && viewer.isSharp")
        page.evaluate("viewer.pickSoon = () => {}")
        return page

    @contextmanager
    def opened(self) -> Iterator[Any]:
        """Serve the model, and lend a page that complains of nothing."""
        with served(self.viewer):
            page = self.page()
            yield page
            assert page.complaints == []
            page.close()
        self.session.close()

    @contextmanager
    def shared(self) -> Iterator[Studio]:
        """Serve the model, with a page that tests share."""
        with self.opened() as self._shared:
            self._state = self._shared.evaluate(_STATE)
            yield self

    @contextmanager
    def restored(self) -> Iterator[Any]:
        """Lend the shared page; then undo all, and set the brush and the view as they were at first."""
        page = self._shared
        page.complaints.clear()
        yield page
        page.evaluate(_RESTORE, self._state)
        self.is_done(page)
        assert page.evaluate("viewer.painting.status.done") == 0
        assert page.complaints == []

    def is_done(self, page: Any, number: int | None = None) -> None:
        """Wait until a page shows its command of a number, or all that it has sent."""
        page.wait_for_function(
            "(n) => (viewer.painting.status.finished[viewer.painting.commands.page] ?? 0) === n",
            arg=page.evaluate("viewer.painting.commands.number") if number is None else number,
        )

    @contextmanager
    def held(self, page: Any, count: int = 1) -> Iterator[None]:
        """Keep the server's answers back while strokes are drawn, until so many commands wait."""
        page.evaluate(_HOLD)
        yield
        page.wait_for_function("(n) => viewer.painting.commands.waiting.length === n", arg=count)

    def bake(self, page: Any, number: int | None = None) -> None:
        """Let the server answer, and wait until what was kept back is painted."""
        page.evaluate("release()")
        self.is_done(page, number)

    def drag(self, page: Any, *places: tuple[float, float], steps: int = 5, **options: Any) -> None:
        """Press a button at the first place, from the middle of the image, and drag it on."""
        left, top = middle(page)
        places = [(left + x, top + y) for x, y in places]
        page.mouse.move(*places[0])
        page.mouse.down(**options)
        for place in places[1:]:
            page.mouse.move(*place, steps=steps)
        page.mouse.up(**options)


def middle(page: Any) -> tuple[float, float]:
    """Return the middle of the image in the window, in pixels."""
    box = page.locator("#image").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def imaged(page: Any, **more: Any) -> npt.NDArray[np.int64]:
    look = more | {"mode": "channel", "channel": "base_color", "highlight": None, "facing": False}
    return drawn(page, (240, 200), **look).astype(np.int64)
