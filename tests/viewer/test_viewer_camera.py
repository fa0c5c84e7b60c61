"""The page's camera: zooming and focusing; pages that load anew, or lose their server."""

import numpy as np
import pytest

import octex
from octex.viewer import Viewer, write_page
from tests.make.painted import ball

#: What a place of the image sees, as a position at rest; null beside the model.
_SEEN = "(at) => viewer.surfaceAt(...at)"
#: Presses a key many times, without an image in between.
_PRESSED = """([key, times]) => {
  for (let n = 0; n < times; n++) viewer.canvas.dispatchEvent(new KeyboardEvent("keydown", { key }));
}"""


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "ball.html"
    surface = ball(16)
    write_page(octex.convert(surface, depth=4), path, surface, title="ball.octex")
    return path


def test_the_wheel_zooms_to_what_is_under_the_cursor_and_never_inside(opens, small):
    page = opens(small, (320, 240), is_drawn=False)
    wide, high = page.evaluate("[viewer.canvas.clientWidth, viewer.canvas.clientHeight]")
    at = [round(0.58 * wide), round(0.4 * high)]
    page.mouse.move(*at)
    for cubes in (False, True):
        page.evaluate("(on) => { viewer.display.cubes = on; viewer.camera.reset(); }", cubes)
        before = page.evaluate(_SEEN, at)
        for _ in range(30):
            page.mouse.wheel(0, -200)
        page.wait_for_function("viewer.camera.distance < 0.01 * viewer.camera.radius")
        after, radius = page.evaluate(_SEEN, at), page.evaluate("viewer.camera.radius")
        np.testing.assert_allclose(after, before, atol=0.002 * radius)  # still before the camera
        page.locator("canvas").focus()
        page.keyboard.press("0")
        page.evaluate(_PRESSED, ["+", 120])
        assert page.evaluate(_SEEN, [wide / 2, high / 2]) is not None


def test_a_double_click_turns_around_what_is_there_and_beside_the_model_shows_all(opens, small):
    page = opens(small, (600, 300), is_drawn=False)
    wide, high = page.evaluate("[viewer.canvas.clientWidth, viewer.canvas.clientHeight]")
    at = [round(0.58 * wide), round(0.4 * high)]
    seen, first = page.evaluate(_SEEN, at), page.evaluate("viewer.camera.distance")
    page.mouse.dblclick(*at)
    np.testing.assert_allclose(page.evaluate("viewer.camera.target"), seen)
    assert page.evaluate("viewer.camera.distance") < first
    page.evaluate("viewer.camera.orbit(0.3, 0.2)")
    radius = page.evaluate("viewer.camera.radius")
    np.testing.assert_allclose(page.evaluate(_SEEN, [wide / 2, high / 2]), seen, atol=0.01 * radius)
    page.keyboard.press("0")
    page.mouse.dblclick(2, 2)
    assert page.evaluate("viewer.camera.distance") == pytest.approx(first)


def test_a_page_of_a_model_that_is_converted_again_keeps_its_camera_and_controls(opens, tmp_path):
    surface, path, lines = ball(8), tmp_path / "ball.octex", list[str]()
    octex.convert(surface, depth=4).save(path)
    viewer = Viewer(lambda: octex.open(path), path, surface, log=lines.append)
    page = opens(viewer, (760, 300), is_drawn=False, is_lost=True)
    assert page.evaluate("viewer.header.parts[0].depth") == 4
    page.select_option("#mode", "depth")
    page.uncheck("#footprints")
    page.evaluate(
        "viewer.camera.orbit(0.4, 0.2); viewer.camera.zoom(2, viewer.camera.low); viewer.invalidate()"
    )
    before = page.evaluate("viewer.camera.state")
    octex.convert(surface, depth=5).save(path)
    page.wait_for_function("globalThis.viewer?.header?.parts[0].depth === 5 && viewer.isLoaded")
    after = page.evaluate("viewer.camera.state")
    for name in ("turn", "tilt", "target", "distance"):
        np.testing.assert_allclose(after[name], before[name], atol=1e-6)
    assert page.input_value("#mode") == "depth"
    assert page.evaluate("[viewer.display.mode, viewer.display.footprints]") == ["depth", False]
    assert page.evaluate("viewer.display.level") == 5  # the finest, as before
    page.reload()
    page.wait_for_function("globalThis.viewer?.isLoaded")
    assert page.evaluate("viewer.display.mode") == "lit"  # what a user loads anew is new
    assert lines == []


#: Notes all that the page's status says from now on.
_LISTEN = """() => {
  const status = document.getElementById("status"), said = (globalThis.said = []);
  new MutationObserver(() => said.push(status.textContent)).observe(status, { childList: true });
}"""


def has_said(page, text):
    """Wait until the page's status has had a text, however briefly; return all that it had."""
    page.wait_for_function("(text) => said.some((each) => each.includes(text))", arg=text, polling=50)
    return page.evaluate("said")


@pytest.fixture
def plain(tmp_path):
    """A viewer without a model, and what it logs."""
    path, lines = tmp_path / "ball.octex", list[str]()
    octex.convert(ball(8), depth=3).save(path)
    return Viewer(lambda: octex.open(path), path, None, log=lines.append), lines


def test_a_page_whose_server_has_another_address_says_so_and_fills_no_log(opens, plain):
    viewer, lines = plain
    page = opens(viewer, (600, 300), is_drawn=False)
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    viewer.token = "another"
    page.evaluate(_LISTEN)
    viewer._ended.set()  # its pages lose their lines
    has_said(page, "new address")
    page.evaluate("window.dispatchEvent(new Event('focus'))")
    has_said(page, "next attempt in 4 s")
    assert all("/proof?" in each for each in asked)
    assert len(asked) < 5
    assert lines == []


def test_a_page_without_a_server_tries_again_after_ever_longer_pauses(opens, plain):
    viewer, _ = plain
    page = opens(viewer, (600, 300), is_drawn=False, is_lost=True)
    for name in ("**/events", "**/proof*"):
        page.route(name, lambda route: route.abort())
    page.evaluate(_LISTEN)
    viewer._ended.set()
    said = has_said(page, "next attempt in 4 s")
    assert [text[17:36] for text in said[:3]] == [f"next attempt in {seconds} s" for seconds in (1, 2, 4)]
    viewer._ended.clear()
    for name in ("**/events", "**/proof*"):
        page.unroute(name)
    page.evaluate("window.dispatchEvent(new Event('focus'))")
    page.wait_for_function("document.getElementById('status').textContent === ''")


def test_texture_coordinates_are_missed_only_where_there_are_none(opens, tmp_path):
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]]
    uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
    texts = []
    for number, given in enumerate((None, uv)):
        surface = octex.Surface.from_arrays(*square, uv=given)
        write_page(octex.convert(surface, depth=2), tmp_path / f"{number}.html", surface)
        page = opens(tmp_path / f"{number}.html", (760, 300), is_drawn=False)
        texts.append(page.locator("#facts").inner_text().split("\n")[1])
    assert texts == ["2 triangles, no texture coordinates", "2 triangles"]
