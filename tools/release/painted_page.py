"""Images of the page: opens a sample in Chromium, shows it, and paints on it with the pointer.

    .venv/bin/python tools/release/painted_page.py      writes viewer.png and browser*.png to samples/images

Needs octex[test] and Chromium. Without a graphics card it takes some minutes.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import PIL.Image

import octex
from octex.session.painting import Session
from octex.viewer import Viewer

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from tests.make.browser import driven, opened, served, started  # noqa: E402

Places = list[tuple[float, float]]

IMAGES = ROOT / "samples" / "images"
SIZE = 1280, 720
_PANEL = 272  # pixels, on the right of the page
_STEP = 480  # the width of each image in the strip
_PATIENCE = 300_000  # milliseconds


class Hand:
    """Paints on a page with the pointer, and keeps images of it."""

    def __init__(self, page: Any) -> None:
        self.page, self.count = page, 0
        self.images: list[PIL.Image.Image] = []

    def look(self, *, sharp: bool = True) -> None:
        """Keep an image of the page; a sharp one is waited for."""
        if sharp:
            self.page.wait_for_function("viewer.isSharp", timeout=_PATIENCE)
        self.images.append(PIL.Image.open(BytesIO(self.page.screenshot())).convert("RGB"))

    def face(self, target: list[float], **camera: float) -> None:
        """Look at a point of the model."""
        self.page.evaluate(
            "(camera) => (Object.assign(viewer.camera, camera), viewer.invalidate())",
            {"target": target, **camera},
        )

    def stroke(self, places: Places, *, is_looked_at: bool = False, **brush: Any) -> None:
        """Draw with the brush set."""
        self.page.evaluate("(brush) => viewer.painting.set(brush)", brush)
        self.page.mouse.move(*places[0])
        self.page.mouse.down()
        for place in places[1:]:
            self.page.mouse.move(*place, steps=2)
        if is_looked_at:
            self.page.wait_for_timeout(1000)
            self.look(sharp=False)
        self.page.mouse.up()
        self.count += 1

    def wait(self) -> None:
        """Wait until all is painted."""
        asked = "(n) => viewer.painting.status.finished[viewer.painting.commands.page] === n"
        self.page.wait_for_function(asked, arg=self.count, timeout=_PATIENCE)


def along(left: float, right: float, height: Callable[[float], float], swing: float = 0.0) -> Places:
    """Return places of a pen that goes up and down on its way."""
    steps = [left + (right - left) * n / 60 for n in range(61)]
    return [(x, height(x) + swing * math.sin((x - left) / 11)) for x in steps]


def paint(hand: Hand) -> None:
    """Paint the droid's head; both of its sides have the same."""
    brush: dict[str, Any] = {"mirror": "x", "opacity": 1, "hardness": 0.8}
    page = hand.page
    page.evaluate("viewer.painting.setTheme('dark')")
    hand.face([0.024, 0.535, 0.13], turn=0.95, tilt=0.25, distance=0.55)
    hand.look()
    cheek = along(245, 485, lambda x: 522 - 0.43 * (x - 245), 12)
    hand.stroke(cheek, **brush, color=[20, 160, 165], size=30, is_looked_at=True)
    hand.stroke(cheek, **brush, color=[225, 250, 240], size=7)
    for n in range(7):
        x = 222 + 42 * n
        hand.stroke([(x, 475 - 0.57 * (x - 222))] * 2, **brush, color=[250, 205, 60], size=22 - n)
    hand.stroke(
        [(690, 395), (735, 385)], **brush | {"hardness": 0, "opacity": 0.7}, color=[235, 90, 150], size=110
    )
    hand.wait()
    hand.look()
    hand.face([-0.024, 0.535, 0.13], turn=-0.75, tilt=0.3, distance=0.55)
    hand.look()


def show(hand: Hand) -> PIL.Image.Image:
    """Return the droid's head as cells on the left, and as the page shows it on the right."""
    hand.face([0.024, 0.535, 0.13], turn=0.95, tilt=0.25, distance=0.55)
    hand.look()
    hand.page.get_by_label("cells as cubes").check()
    hand.page.locator("#level").fill("8")
    hand.look()
    smooth, cells = hand.images
    left = (SIZE[0] - _PANEL) // 2
    smooth.paste(cells.crop((0, 0, left, SIZE[1])))
    return smooth


def main() -> None:
    """Show and paint, and write the images."""
    model = ROOT / "samples" / "droid.glb"
    surface = octex.load_surface(model)
    texture = octex.convert(surface, depth=10)
    with tempfile.TemporaryDirectory() as folder, driven() as driver, started(driver) as browser:
        with served(viewer := Viewer(lambda: texture, Path(folder, "droid.octex"), surface)):
            page = opened(browser, viewer.url, SIZE, finest=2)
            show(Hand(page)).save(IMAGES / "viewer.png", optimize=True)
            page.close()
        session = Session(texture, surface, Path(folder, "painted.octex"))
        viewer = Viewer(lambda: texture, Path(folder, "droid.octex"), surface, session=session)
        with served(viewer):
            page = opened(browser, viewer.url, SIZE, finest=2)
            page.wait_for_function("viewer.painting && viewer.isSharp", timeout=_PATIENCE)
            hand = Hand(page)
            paint(hand)
            page.close()
        session.close()
    plain, under_pen, painted, turned = hand.images
    painted.save(IMAGES / "browser.png", optimize=True)
    width, height = SIZE[0] - _PANEL, SIZE[1]
    strip = PIL.Image.new("RGB", (4 * _STEP, _STEP * height // width))
    for number, image in enumerate((plain, under_pen, painted, turned)):
        step = image.crop((0, 0, width, height)).resize((_STEP, strip.height), PIL.Image.Resampling.LANCZOS)
        strip.paste(step, (number * _STEP, 0))
    strip.save(IMAGES / "browser_strip.png", optimize=True)


if __name__ == "__main__":
    main()
