"""What a painting page tells its user, and where its keys go."""

from tests.make.same import assert_same
from tests.make.studio import SIZE
from tests.viewer.test_painting import _CLOSE, _OPEN

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


def test_each_press_that_cannot_paint_says_why(studio, page):
    page.evaluate("viewer.display.cubes = true")
    for _ in range(2):
        studio.drag(page, (0, 0), (10, 0))
        assert "to paint" in page.locator("#paint-note").inner_text()
        page.evaluate("viewer.painting.showMessage('')")
    page.evaluate("viewer.display.cubes = false")


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
