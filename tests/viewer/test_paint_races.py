"""Painting pages where events meet: answers arrive during a stroke, before the page is ready, or broken."""

import threading

from octex.viewer import answers
from tests.make.browser import opened, sharp
from tests.make.browser import served as serving
from tests.make.studio import SIZE, Studio, middle
from tests.viewer.test_session import plain

#: Counts the buffers and vertex arrays that the page has.
_COUNTED = """() => {
  const { gl } = viewer.gpu;
  globalThis.count = 0;
  for (const kind of ["Buffer", "VertexArray"]) {
    for (const [action, step] of [["create", 1], ["delete", -1]]) {
      const call = gl[action + kind].bind(gl);
      gl[action + kind] = (...given) => (count += step, call(...given));
    }
  }
}"""


def press(page):
    """Begin a stroke in the middle of the model."""
    x, y = middle(page)
    page.mouse.move(x - 20, y)
    page.mouse.down()
    page.mouse.move(x, y, steps=3)


def release(page):
    x, y = middle(page)
    page.mouse.move(x + 20, y, steps=3)
    page.mouse.up()


def test_a_page_that_is_not_ready_yet_gets_the_steps_that_others_make_meanwhile(
    browser, tmp_path, monkeypatch
):
    studio, is_released, page_text = Studio(browser, tmp_path), threading.Event(), answers.page_text

    def slow_text(name):
        if name == "paint.js":
            assert is_released.wait(60)
        return page_text(name)

    monkeypatch.setattr(answers, "page_text", slow_text)
    with serving(studio.viewer):
        page = opened(browser, studio.viewer.url, SIZE)
        studio.session.take(plain("fill", 1, color=[10, 200, 30]))
        studio.session.wait()
        page.wait_for_function("viewer.latestVersion?.startsWith('1-')")
        is_released.set()
        page.wait_for_function("viewer.painting?.status.done === 1")
        assert page.locator("#undo").is_enabled()
        assert page.complaints == []
        page.close()
    studio.session.close()


def test_a_composite_that_arrives_during_a_stroke_leaves_the_stroke_its_own(studio, page):
    page.evaluate("viewer.painting.layers.sendNew('add', 'Add a layer')")
    page.wait_for_function("viewer.painting.layers.active !== null")
    page.evaluate("viewer.painting.layers.send('set', '', { opacity: 0.6, blend: 'multiply' })")
    studio.drag(page, (-40, -20), (40, 20))
    studio.is_done(page)
    is_loaded = "viewer.painting.preview.composite.key === viewer.painting.preview.key"
    page.wait_for_function(is_loaded)
    press(page)
    assert page.evaluate("viewer.painting.strokes.current.preview.image instanceof Object")
    page.evaluate("viewer.painting.preview.changes++; viewer.painting.preview.load()")
    page.wait_for_function(is_loaded)
    composite = "viewer.painting.strokes.current.preview.image.colors.display.composite"
    for name in page.evaluate(f"{composite}.stores.map(({{ name }}) => name)"):
        store = f"{composite}.stores.find(({{ name }}) => name === '{name}')"
        assert page.evaluate(f"viewer.gpu.gl.isTexture({store}.texture)")
    release(page)
    assert page.evaluate("viewer.painting.preview.retired.length") == 1
    studio.is_done(page)
    page.evaluate("viewer.painting.layers.select(null)")


def test_a_layer_that_another_page_adds_is_not_selected(studio, page):
    page.evaluate("viewer.painting.layers.active = 99")
    page.evaluate("viewer.painting.layers.sendNew('copy', 'Copy a layer')")
    studio.is_done(page)
    assert page.locator("#paint-note").inner_text() == "there is no layer 99"
    studio.session.take(plain("layer", 1, action="add", title="theirs"))
    page.wait_for_function("viewer.painting.layers.stack.length === 1")
    assert page.evaluate("viewer.painting.layers.active") is None


def test_a_patch_that_arrives_broken_is_reported(page):
    page.route("**/patch?*", lambda route: route.fulfill(body="null\n"))
    spot = {"center": [0.0, 0.0, 1.0], "radius": 0.3, "up": [0.0, 1.0, 0.0]}
    assert page.evaluate("(spot) => viewer.painting.flat.show(spot, null)", spot) is False
    assert page.locator("#paint-note").inner_text().startswith("This cannot be laid flat: ")
    page.unroute("**/patch?*")
    assert page.locator("#flat").is_hidden()


def test_a_command_is_sent_again_after_a_refusal_that_breaks_off(studio, page):
    page.evaluate("""() => {
      const { commands } = viewer.painting, { post, showMessage } = commands;
      globalThis.messages = [];
      commands.showMessage = (message) => (messages.push(message), showMessage(message));
      commands.post = async () => {
        commands.post = post;
        const text = () => Promise.reject(new TypeError("network error"));
        return { ok: false, status: 503, statusText: "Busy", text };
      };
    }""")
    studio.drag(page, (-20, 0), (20, 0))
    studio.is_done(page)
    assert page.evaluate("messages") == ["1 change waits to be sent: Busy", ""]
    assert page.evaluate("viewer.painting.status.done") == 1


def test_cubes_of_changed_cells_replace_the_old_ones_in_memory(studio, page):
    page.evaluate("viewer.display.cubes = true; viewer.invalidate()")
    sharp(page)
    page.evaluate(_COUNTED)
    for color in ([250, 0, 0], [0, 250, 0]):
        fill = {"kind": "fill", "name": "Fill all", "color": color}
        page.evaluate("(fill) => viewer.painting.commands.send(fill)", fill)
        studio.is_done(page)
        sharp(page)
    assert page.evaluate("count") == 0
    page.evaluate("viewer.display.cubes = false; viewer.invalidate()")


def test_no_display_mode_and_no_finer_cells_compile_the_programs_of_the_brush_again(studio, page):
    for mode in ("channel", "lit"):
        page.evaluate("(mode) => { viewer.display.mode = mode; viewer.invalidate(); }", mode)
        sharp(page)
        studio.drag(page, (-20, 0), (20, 0))
        studio.is_done(page)
    kinds = page.evaluate("[...viewer.gpu.programs.compiled.keys()].map((key) => key.split('\\n')[0])")
    assert kinds.count("stroke") == kinds.count("outline") == 1
