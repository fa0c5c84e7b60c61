"""What helps a hand: straight lines, a pulled brush, sizes by dragging, colours and ready brushes."""

import numpy as np
import pytest

from tests.make.browser import camera_of
from tests.make.studio import _HOLD, middle

_BRUSH = "viewer.painting.brush"
#: What the last stroke covers, and the box of that.
_LAST = """() => {
  const { coverage, box } = viewer.painting.strokes.sent.at(-1);
  return { box, coverage: Array.from(coverage) };
}"""


def last(page, count):
    """Return the box of the last of so many strokes that wait, and what it covers."""
    page.wait_for_function("(n) => viewer.painting.strokes.sent.length === n", arg=count)
    found = page.evaluate(_LAST)
    left, top, right, bottom = box = found["box"]
    return box, np.array(found["coverage"]).reshape(bottom - top, right - left)


def test_with_shift_a_stroke_goes_on_from_the_last_one_in_a_straight_line(studio, page):
    page.evaluate(_HOLD)
    page.evaluate("viewer.painting.set({ size: 12, hardness: 1 })")
    x, y = middle(page)
    studio.drag(page, (-60, -30))
    page.keyboard.down("Shift")
    studio.drag(page, (60, 30))
    (left, top, right, bottom), coverage = last(page, 2)
    np.testing.assert_allclose([left, right], [x - 66, x + 66], atol=2)
    np.testing.assert_allclose([top, bottom], [y - 36, y + 36], atol=2)
    for part in np.linspace(-1, 1, 25):
        assert coverage[round(y + 30 * part) - top, round(x + 60 * part) - left] > 250
    assert coverage[round(y) - top - 20, round(x) - left] == 0
    view = page.evaluate("String(viewer.camera.view)")
    page.evaluate("viewer.camera.orbit(0.15, 0.1); viewer.invalidate()")
    page.wait_for_function("viewer.isDrawn")
    point = np.array(page.evaluate("viewer.painting.lastEnd.point"))
    assert np.linalg.norm(point - studio.surface.vertices.mean(axis=0)) == pytest.approx(1, abs=0.05)
    size = page.evaluate("[viewer.screenSize.width, viewer.screenSize.height]")
    (at,), _ = camera_of(page, size).project(point[None])
    studio.drag(page, (0, -60))
    page.keyboard.up("Shift")
    (left, top, right, bottom), _ = last(page, 1)
    np.testing.assert_allclose([right, bottom], at + 6, atol=3)
    assert view != page.evaluate("String(viewer.camera.view)")
    page.evaluate("release()")
    studio.is_done(page)


def test_a_brush_that_is_pulled_follows_the_pen_smoothly(studio, page):
    page.evaluate(_HOLD)
    x, y = middle(page)
    wave = [(-60 + 6 * n, 8 * (-1) ** n) for n in range(21)]
    boxes = []
    for count, smoothing in enumerate((0, 30), 1):
        page.evaluate("(smoothing) => viewer.painting.set({ size: 10, smoothing })", smoothing)
        studio.drag(page, *wave, steps=1)
        boxes.append(last(page, count)[0])
    np.testing.assert_allclose(boxes[0], [x - 65, y - 13, x + 65, y + 13], atol=2)
    assert boxes[1][2] == pytest.approx(x + 60 - 30 + 5, abs=4)
    assert boxes[1][3] - boxes[1][1] < boxes[0][3] - boxes[0][1] - 4
    studio.drag(page, (0, 0), (20, 0))
    left, _, right, _ = last(page, 3)[0]
    assert right - left <= 14
    page.mouse.down()
    page.mouse.move(x + 80, y)
    assert page.locator("#string").is_visible()
    page.mouse.up()
    page.evaluate("release()")
    studio.is_done(page)


def test_dragging_with_control_changes_size_and_hardness(page):
    x, y = middle(page)
    view = page.evaluate("String(viewer.camera.view)")
    page.keyboard.down("Control")
    for button in ("left", "right"):
        page.evaluate("viewer.painting.set({ size: 40, hardness: 0.7 })")
        page.mouse.move(x, y)
        page.mouse.down(button=button)
        page.mouse.move(x + 10, y - 20, steps=3)
        assert page.locator("#ring b").inner_text() == "60 px, 80 %"
        ring = page.locator("#ring").bounding_box()
        assert ring["x"] + ring["width"] / 2 == pytest.approx(x, abs=1)
        page.mouse.up(button=button)
        assert page.evaluate(f"[{_BRUSH}.size, {_BRUSH}.hardness]") == [60, pytest.approx(0.8)]
    page.keyboard.up("Control")
    assert page.locator("#ring b").inner_text() == ""
    assert page.evaluate("String(viewer.camera.view)") == view
    assert page.evaluate("viewer.painting.commands.waiting.length + viewer.painting.status.done") == 0


def test_colours_are_typed_and_those_used_last_are_at_hand(studio, page):
    field, used = page.locator("#color-text"), page.locator("#recent button")
    for text, color in (("#0f8", [0, 255, 136]), ("C83C28", [200, 60, 40])):
        field.fill(text)
        field.press("Enter")
        assert page.evaluate(f"{_BRUSH}.color") == color
    for text in ("red", "#12345", ""):
        field.fill(text)
        field.press("Enter")
        assert "hexadecimal" in page.locator("#paint-note").inner_text()
        assert field.input_value() == "#c83c28"
    assert used.count() == 0
    for color in ([10, 20, 30], [40, 50, 60], [10, 20, 30]):
        page.evaluate("(color) => viewer.painting.set({ color })", color)
        studio.drag(page, (0, 0))
    page.keyboard.press("e")
    page.evaluate("viewer.painting.set({ color: [1, 2, 3] })")
    studio.drag(page, (0, 0))
    assert [each.get_attribute("title") for each in used.all()] == ["#0a141e", "#28323c"]
    used.nth(1).click()
    assert page.evaluate(f"{_BRUSH}.color") == [40, 50, 60]
    page.keyboard.down("Alt")
    studio.drag(page, (40, 0))
    page.keyboard.up("Alt")
    np.testing.assert_allclose(page.evaluate(f"{_BRUSH}.color"), 188, atol=1)
    assert page.evaluate("viewer.painting.tool.name") == "eraser"
    studio.is_done(page)


def test_ready_brushes_change_all_but_size_and_colour(page):
    before = page.evaluate(_BRUSH)
    for name, own in (("Air", {"hardness": 0, "flow": 0.1}), ("Ink", {"smoothing": 30, "flow": 1})):
        page.locator("#brushes button", has_text=name).click()
        found = page.evaluate(_BRUSH)
        assert own.items() <= found.items()
        assert [found["size"], found["color"]] == [before["size"], before["color"]]
    for tool, then in (("eraser", "eraser"), ("fill", "brush")):
        page.evaluate("(tool) => viewer.painting.selectTool(tool)", tool)
        page.locator("#brushes button", has_text="Hard").click()
        assert page.evaluate("viewer.painting.tool.name") == then
