"""Painting in a real browser: what the pen draws is painted, saved, undone, seen by all pages, and told."""

import numpy as np
import pytest

import octex
from tests.make.same import assert_same
from tests.make.studio import SIZE, imaged, middle

#: Opens all sections of the panel; returns the names of those that were open.
_OPEN = """() => {
  const all = [...document.querySelectorAll("aside details")], open = all.filter((each) => each.open);
  for (const each of all) each.open = true;
  return open.map((each) => each.id);
}"""
_CLOSE = """(open) => {
  for (const each of document.querySelectorAll("aside details")) each.open = open.includes(each.id);
}"""
#: Returns how many lines of text buttons have.
_LINES = """(all) => all.map((each) => {
  const range = document.createRange();
  range.selectNodeContents(each);
  return new Set([...range.getClientRects()].map(({ top }) => Math.round(top))).size;
})"""


def test_a_stroke_is_seen_at_once_as_it_will_be_painted(studio, page):
    plain = imaged(page)
    with studio.held(page):
        studio.drag(page, (-60, 0), (0, -40), (60, 20))
    before = imaged(page)
    is_painted = np.abs(before - plain).max(axis=2) > 60
    assert 0.02 < is_painted.mean() < 0.3
    assert_same(studio.session.shown.texture, studio.texture)
    page.evaluate("viewer.camera.orbit(0.5, 0.15)")
    turned, plain_turned = imaged(page), imaged(page, strokes=None)
    studio.bake(page)
    turned_after = imaged(page)
    is_seen = np.abs(turned_after - plain_turned).max(axis=2) > 60
    assert is_seen.mean() > 0.01
    assert np.sqrt(((turned - turned_after)[is_seen] ** 2).mean()) <= 8
    assert (np.abs(turned - turned_after).max(axis=2) > 40).mean() < 0.002
    page.evaluate("viewer.camera.orbit(-0.5, -0.15)")
    after = imaged(page)
    inside = before[is_painted] - after[is_painted]
    assert np.sqrt((inside**2).mean()) <= 2
    again = studio.page()
    assert np.abs(imaged(again) - after).max() <= 1
    assert again.complaints == []
    again.close()


def test_undo_gives_the_texture_back_and_redo_the_stroke(studio, page):
    plain = imaged(page)
    for offset in (0, 20):
        studio.drag(page, (-30, offset), (30, offset))
    studio.is_done(page)
    twice = studio.session.shown.texture
    for key, done in (("Control+z", 1), ("Control+z", 0), ("Control+Shift+Z", 1), ("Control+y", 2)):
        page.keyboard.press(key)
        page.wait_for_function("(n) => viewer.painting.status.done === n", arg=done)
        if done == 0:
            assert_same(studio.session.shown.texture, studio.texture)
            assert (imaged(page) == plain).all()
    assert_same(studio.session.shown.texture, twice)
    page.locator("#steps button", has_text="Opened").click()
    page.wait_for_function("viewer.painting.status.done === 0")
    assert_same(studio.session.shown.texture, studio.texture)
    listed = """() => Array.from(document.querySelectorAll("#steps li"),
      (row) => [row.textContent, row.className, row.firstChild.ariaCurrent])"""
    brush = ["Brush", "undone", None]
    assert page.evaluate(listed) == [["Opened", "", "step"], brush, brush]
    page.click("#redo")
    page.wait_for_function("viewer.painting.status.done === 1")
    assert page.evaluate(listed) == [["Opened", "", None], ["Brush", "", "step"], brush]
    page.click("#undo")
    page.click("#tool-eraser")
    studio.drag(page, (-30, 0), (30, 0))
    studio.is_done(page)
    assert page.evaluate(listed) == [["Opened", "", None], ["Eraser", "", "step"]]


def test_two_pages_see_the_same_and_one_saves(studio, page):
    other = studio.page()
    studio.drag(page, (0, 0), (10, 10))
    other.wait_for_function("viewer.painting.status.done === 1")
    studio.drag(other, (-20, 0), (-40, 10))
    page.wait_for_function("viewer.painting.status.done === 2")
    assert (imaged(page) == imaged(other)).all()
    assert not studio.output.exists()
    page.keyboard.press("Control+s")
    other.wait_for_function("viewer.painting.status.isSaved")
    assert_same(octex.open(studio.output), studio.session.shown.texture)
    assert "all is saved" in other.locator("#saved").inner_text()
    other.evaluate("() => { viewer.painting.commands.post = () => new Promise(() => {}); }")
    studio.drag(other, (-20, 20), (-40, 30))
    assert "not saved" in other.locator("#saved").inner_text()
    assert other.complaints == []
    other.close()


def test_a_line_that_is_lost_holds_no_stroke_up_and_loses_none(studio, page):
    page.route("**/session", lambda route: route.abort())
    for offset in (-30, 0, 30):
        studio.drag(page, (-30, offset), (30, offset))
    page.wait_for_function("document.getElementById('paint-note').textContent.startsWith('3 changes wait')")
    assert studio.session.shown.status["done"] == 0
    page.wait_for_function("document.getElementById('saved').textContent.endsWith('working …')")
    page.unroute("**/session")
    studio.is_done(page)
    assert studio.session.shown.status["done"] == 3
    assert page.locator("#saved").inner_text().endswith("not saved")
    assert page.locator("#paint-note").inner_text() == ""
    assert page.complaints
    page.complaints.clear()


def test_the_view_turns_with_other_buttons_and_beside_the_model(studio, page):
    for start, options in (((0, 0), {"button": "middle"}), ((0, 0), {"button": "right"}), ((200, 150), {})):
        before = page.evaluate("String(viewer.camera.view)")
        studio.drag(page, start, (start[0] + 20, start[1] + 10), **options)
        assert page.evaluate("String(viewer.camera.view)") != before
    before = page.evaluate("String(viewer.camera.view)")
    studio.drag(page, (0, 0), (20, 10))
    assert page.evaluate("String(viewer.camera.view)") == before
    studio.is_done(page)
    assert studio.session.shown.status["done"] == 1


def test_a_stroke_begins_where_the_brush_touches_the_model_and_not_farther_away(studio, page):
    edge = page.evaluate(
        """() => {
          const { clientWidth: width, clientHeight: height } = viewer.canvas;
          let x = 0;
          while (viewer.surfaceAt(width / 2 + x, height / 2)) x++;
          viewer.painting.set({ size: 40 });
          return x;
        }"""
    )
    for away, one_part, is_painted in ((14, False, True), (14, True, False), (26, False, False)):
        page.evaluate("(onePart) => viewer.painting.set({ onePart })", one_part)
        before = page.evaluate("[String(viewer.camera.view), viewer.painting.commands.number]")
        studio.drag(page, (edge + away, 0), (edge - 20, 0))
        view, number = page.evaluate("[String(viewer.camera.view), viewer.painting.commands.number]")
        assert (view == before[0], number - before[1]) == (is_painted, int(is_painted))
    studio.is_done(page)
    assert studio.session.shown.status["done"] == 1


def test_the_fill_stays_chosen_and_the_pick_returns_to_the_tool_before(studio, page):
    page.evaluate("viewer.painting.set({ fills: 'all' })")
    page.keyboard.press("f")
    studio.drag(page, (0, 0))
    page.keyboard.press("i")
    page.evaluate("viewer.painting.set({ color: [1, 2, 3] })")
    studio.is_done(page)
    studio.drag(page, (0, 0))
    np.testing.assert_allclose(page.evaluate("viewer.painting.brush.color"), [200, 60, 40], atol=0.01)
    assert page.evaluate("viewer.painting.tool.name") == "fill"


def test_the_view_stays_while_a_stroke_is_drawn_and_it_can_be_undone_at_once(studio, page):
    left, top = middle(page)
    before = page.evaluate("String(viewer.camera.view)")
    page.mouse.move(left, top)
    page.mouse.down()
    page.mouse.wheel(0, -200)
    page.keyboard.press("ArrowLeft")
    page.mouse.move(left + 20, top)
    assert page.evaluate("String(viewer.camera.view)") == before
    with studio.held(page, 2):
        page.mouse.up()
        page.keyboard.press("Control+z")
    studio.bake(page)
    assert page.evaluate("[viewer.painting.status.steps, viewer.painting.status.done]") == [["Brush"], 0]
    assert_same(studio.session.shown.texture, studio.texture)


def test_nothing_is_painted_that_is_not_seen_and_each_press_says_why(studio, page):
    note = page.locator("#paint-note")
    for look in ("viewer.display.cubes = true", "viewer.display.mode = 'depth'"):
        page.evaluate(look)
        for _ in range(2):
            page.evaluate("viewer.painting.showMessage('')")
            studio.drag(page, (0, 0), (10, 0))
            assert "to paint" in note.inner_text()
        page.evaluate("viewer.display.cubes = false; viewer.display.mode = 'lit'")
    studio.drag(page, (0, 0), (10, 0))
    studio.is_done(page)
    assert note.inner_text() == ""


def test_keys_and_the_picker_set_the_brush(studio, page):
    brush = "viewer.painting.brush"
    assert page.evaluate(f"{brush}.size") == 40
    page.keyboard.press("]")
    assert page.evaluate(f"{brush}.size") == 46
    page.keyboard.press("[")
    assert page.evaluate(f"{brush}.size") == 40
    color = page.evaluate(f"{brush}.color")
    page.keyboard.press("x")
    assert page.evaluate(f"{brush}.color") != color
    page.keyboard.press("x")
    assert page.evaluate(f"{brush}.color") == color
    page.keyboard.down("Alt")
    studio.drag(page, (0, 0))
    page.keyboard.up("Alt")
    grey = 255 * (1.055 * 0.5 ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(page.evaluate(f"{brush}.color"), grey, atol=1)
    assert not page.locator("#tolerance").is_visible()
    page.click("#tool-fill")
    assert page.locator("#tolerance").is_visible()
    studio.drag(page, (0, 0))
    studio.is_done(page)
    assert page.evaluate("viewer.painting.status.steps") == ["Fill a part"]


@pytest.mark.parametrize("size", [(1180, 760), (800, 340), (640, 340), (844, 390), (390, 780)])
def test_each_tool_is_within_the_window_and_each_control_within_the_panel(size, page):
    page.set_viewport_size({"width": size[0], "height": size[1]})
    page.evaluate("document.getElementById('flat').hidden = false")
    boxes = page.locator("#tools button, #flat").evaluate_all(
        "(all) => all.map((each) => each.getBoundingClientRect().toJSON())"
    )
    opened = page.evaluate(_OPEN)
    widths = page.locator("#where input[type=checkbox]").evaluate_all(
        "(all) => all.map((each) => each.offsetWidth)"
    )
    height, stage = page.evaluate("[viewer.canvas.clientHeight, viewer.canvas.clientWidth]")
    top = page.locator("#image").bounding_box()["y"]
    panel = page.locator("aside")
    inner, outer = panel.evaluate("(panel) => [panel.scrollWidth, panel.clientWidth]")
    lines = page.locator(".buttons button:visible").evaluate_all(_LINES)
    page.evaluate(_CLOSE, opened)
    page.evaluate("document.getElementById('flat').hidden = true")
    page.set_viewport_size({"width": SIZE[0], "height": SIZE[1]})
    assert len(boxes) == 10
    for box in boxes:
        assert box["left"] >= 0 <= box["top"]
        assert box["right"] <= stage
        assert box["bottom"] <= height
    if size[0] < size[1]:
        assert all(box["bottom"] <= top for box in boxes), "the tools cover nothing of the model"
    assert len(set(widths)) == 1
    assert inner <= outer
    assert len(lines) > 5
    assert set(lines) == {1}


def test_a_tools_settings_are_seen_while_it_is_chosen(page):
    is_seen = """([id]) => {
      const { top, bottom } = document.getElementById(id).getBoundingClientRect();
      const panel = document.querySelector("aside").getBoundingClientRect();
      return document.getElementById(id).open && top >= panel.top - 1 && bottom <= panel.bottom + 1;
    }"""
    settings = {"stencil": "stencil-section", "clone": "retouch", "blur": "retouch", "fill": "filling"}
    for tool, section in settings.items():
        page.click(f"#tool-{tool}")
        assert page.evaluate(is_seen, [section]), tool
        others = {*settings.values()} - {section}
        assert not page.locator(", ".join(f"#{other}[open]" for other in others)).count()
    page.click("#layers summary")
    page.click("#tool-brush")
    assert page.locator("#painting details[open]").evaluate_all("(all) => all.map((each) => each.id)") == [
        "layers",
        "history",
    ]


@pytest.mark.parametrize("size", [(1024, 768), (390, 844)])
def test_fingers_hit_each_control_and_fold_the_panel_away(size, studio, opens):
    page = opens(studio.viewer.url, size, has_touch=True, is_mobile=True)
    page.wait_for_function("viewer.painting")
    page.evaluate(_OPEN)
    page.evaluate("document.getElementById('flat').hidden = false")
    small = page.locator(
        "#tools button:visible, #flat button, #painting :is(button, select, input, summary):visible"
    )
    names = small.evaluate_all(
        """(all) => all.filter((each) => {
          const { width, height } = (each.closest(".check") ?? each).getBoundingClientRect();
          return Math.min(width, height) < 39.5;
        }).map((each) => each.outerHTML)"""
    )
    before = page.evaluate("viewer.canvas.clientHeight")
    if page.locator("#fold").is_visible():
        page.tap("#fold")
        assert page.locator("#fold").get_attribute("aria-expanded") == "false"
        color = page.locator("#fold").evaluate("(fold) => getComputedStyle(fold).backgroundColor")
        assert color == "rgba(0, 0, 0, 0)", "a button that was touched does not look pressed"
    after = page.evaluate("viewer.canvas.clientHeight")
    assert page.complaints == []
    assert names == []
    assert (
        (before > 0.95 * size[1]) if size[0] > size[1] else (before < 0.5 * size[1] < 0.75 * size[1] < after)
    )


def test_a_page_keeps_to_its_policy(studio, opens):
    page = opens(studio.viewer.url, SIZE, bypass_csp=False)
    page.wait_for_selector("#brushes i")
    backgrounds = page.locator("#brushes i").evaluate_all(
        "(all) => all.map((each) => getComputedStyle(each).backgroundImage)"
    )
    assert page.complaints == []
    assert len(backgrounds) == 5
    assert all("gradient" in each for each in backgrounds)


def test_keys_undo_text_where_it_is_typed_and_work_with_alt_gr(studio, page):
    studio.drag(page, (-20, 0), (20, 0))
    studio.is_done(page)
    page.locator("#color-text").press("Control+z")
    studio.is_done(page)
    assert page.evaluate("viewer.painting.status.done") == 1
    size = page.evaluate("viewer.painting.brush.size")
    page.evaluate(
        """() => {
          const altGr = { ctrlKey: true, altKey: true, modifierAltGraph: true, bubbles: true };
          const event = new KeyboardEvent("keydown", { key: "[", ...altGr });
          document.getElementById("image").dispatchEvent(event);
        }"""
    )
    assert page.evaluate("viewer.painting.brush.size") < size


#: Says whether an element is within another one, as that is scrolled.
_IS_SEEN = """([id, around]) => {
  const { top, bottom } = document.getElementById(id).getBoundingClientRect();
  const frame = document.querySelector(around).getBoundingClientRect();
  return bottom > top && top >= frame.top - 1 && bottom <= frame.bottom + 1;
}"""
_SCROLL = "(pixels) => document.querySelector('aside').scrollTo(0, pixels)"


def test_the_outline_of_the_brush_comes_and_goes_with_its_tool(studio, page):
    studio.drag(page, (0, 0))
    studio.is_done(page)
    for key, is_shown in (("f", False), ("b", True), ("i", False), ("e", True)):
        page.keyboard.press(key)
        assert page.locator("#ring").is_visible() == is_shown, key


def test_messages_and_undo_are_seen_however_the_panel_is_scrolled(page):
    opened = page.evaluate(_OPEN)
    height = page.locator("#painting").evaluate("(part) => part.scrollHeight")
    page.evaluate("viewer.painting.showMessage('This layer is hidden: show it to paint on it.')")
    for share in (0, 0.5, 1):
        page.evaluate(_SCROLL, share * height)
        assert [page.evaluate(_IS_SEEN, [each, "aside"]) for each in ("undo", "saved")] == [share < 1] * 2
        assert page.evaluate(_IS_SEEN, ["paint-note", "main"])
    page.evaluate("viewer.painting.showMessage('')")
    page.evaluate(_SCROLL, height)
    page.evaluate("viewer.painting.exporting.showQuestions({ output: 'Which?', opened: '' })")
    assert page.evaluate(_IS_SEEN, ["question", "aside"])
    page.evaluate("viewer.painting.exporting.showQuestions({ output: '', opened: '' })")
    page.evaluate(_CLOSE, opened)


def test_a_lost_connection_is_told_over_the_image_alone(page):
    found = page.evaluate(
        """() => {
          const status = document.getElementById("status");
          status.textContent = "Connection lost; next attempt in 4 s. ".repeat(5);
          const parts = [status, document.querySelector("main")];
          const right = parts.map((each) => each.getBoundingClientRect().right);
          status.textContent = "";
          return right;
        }"""
    )
    assert found[0] <= found[1]


def test_undo_and_redo_count_what_waits(studio, page):
    with studio.held(page, 4):
        page.evaluate("viewer.painting.commands.send({ kind: 'fill', name: 'Fill all', color: [9, 9, 9] })")
        assert page.locator("#undo").is_enabled()
        page.keyboard.press("Control+z")
        page.keyboard.press("Control+Shift+Z")
        page.keyboard.press("Control+z")
    studio.bake(page)
    assert page.evaluate("[viewer.painting.status.steps, viewer.painting.status.done]") == [["Fill all"], 0]
    assert_same(studio.session.shown.texture, studio.texture)
    assert [page.locator(each).is_enabled() for each in ("#undo", "#redo")] == [False, True]


def test_keys_go_to_the_tools_after_a_choice_or_a_text(page):
    page.locator("#blend").focus()
    page.locator("#image").hover()
    page.keyboard.press("e")
    assert page.evaluate("viewer.painting.tool.name") == "eraser"
    page.locator("#color-text").fill("#0f8")
    page.keyboard.press("Enter")
    page.keyboard.press("b")
    assert page.evaluate("viewer.painting.tool.name") == "brush"
    assert page.locator("#color-text").input_value() == "#00ff88"


def test_with_forced_colours_the_chosen_tool_and_colours_are_seen(page):
    backgrounds = "(all) => all.map((each) => getComputedStyle(each).backgroundColor)"
    page.emulate_media(forced_colors="active")
    chosen, *others = page.locator("#tools button").evaluate_all(backgrounds)
    assert chosen not in others
    assert page.locator("#second-color").evaluate_all(backgrounds) == ["rgb(245, 245, 245)"]
    page.emulate_media(forced_colors="none")


def test_the_image_is_as_high_as_a_low_window(page):
    for width, height in ((640, 340), (568, 320)):
        page.set_viewport_size({"width": width, "height": height})
        assert page.evaluate("viewer.canvas.clientHeight") == height
    page.set_viewport_size({"width": SIZE[0], "height": SIZE[1]})


def test_enter_presses_the_tool_in_the_middle(studio, page):
    page.locator("#image").focus()
    for key in ("b", "Enter", "f", "Enter", "i", "Enter"):
        page.keyboard.press(key)
    assert page.evaluate("document.activeElement === viewer.canvas")
    studio.is_done(page)
    assert page.evaluate("viewer.painting.status.steps") == ["Brush", "Fill a part"]
    assert page.evaluate("viewer.painting.tool.name") == "fill"  # as before the press of "pick"
