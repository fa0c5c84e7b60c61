"""The brush of pages that paint: what it shows is what is painted, whatever it is set to."""

import json

import numpy as np
import pytest

from tests.make.browser import sharp
from tests.make.painted import balls
from tests.make.studio import Studio, imaged, middle
from tests.viewer.test_paint_commands import BLENDS


def drawn_and_baked(studio, page, drags):
    """Draw strokes; return the image before, with what the page draws of them, and with them baked."""
    before = imaged(page)
    with studio.held(page, len(drags)):
        for brush, places in drags:
            page.evaluate("(brush) => viewer.painting.set(brush)", brush)
            studio.drag(page, *places)
    shown = imaged(page)
    studio.bake(page)
    return before, shown, imaged(page)


def assert_same_inside(images, *, ends_sharply=False):
    """Check that an image shows strokes as they are baked but at their rims; return where they are."""
    before, shown, baked = images
    changes = np.abs(shown - before).max(axis=2)
    inside = changes > 0.4 * changes.max()
    assert changes.max() > 25
    assert inside.mean() > 0.008
    inner = inside.copy()
    if ends_sharply:  # at the next part: of pixels there, baked paint has a part
        for axis in (0, 1):
            inner &= np.roll(inside, 1, axis) & np.roll(inside, -1, axis)
    assert float(np.sqrt(((shown - baked)[inner] ** 2).mean())) <= 2
    return inside


@pytest.mark.parametrize("blends", [BLENDS[:2], BLENDS[2:]])
def test_each_blend_mode_is_seen_at_once_as_it_is_baked(blends, studio, page):
    brush = {"blend": blends[0], "color": [60, 140, 230], "opacity": 0.7, "hardness": 0.8}
    other = brush | {"blend": blends[1], "color": [240, 120, 40]}
    drags = [(brush, [(-60, -20), (50, 10)]), (other, [(-10, -50), (0, 40)])]
    assert_same_inside(drawn_and_baked(studio, page, drags))


#: Returns the box and the coverage of the stroke that was sent last.
_SENT = """() => {
  const { box, coverage } = viewer.painting.strokes.sent.at(-1);
  return [box, Array.from(coverage), viewer.painting.strokes.size];
}"""


def stroke_drawn(studio, page, places, steps=5, **brush):
    """Draw a stroke; return its coverage as codes (height, width)."""
    page.evaluate("(brush) => viewer.painting.set(brush)", brush)
    with studio.held(page):
        studio.drag(page, *places, steps=steps)
    return sent(studio, page)


def sent(studio, page):
    """Return the coverage of the stroke that waits, as codes (height, width), and let it be baked."""
    (left, top, right, bottom), codes, (width, height) = page.evaluate(_SENT)
    studio.bake(page)
    found = np.zeros((height, width), np.int64)
    found[top:bottom, left:right] = np.reshape(codes, (bottom - top, right - left))
    return found


LINE = [(-70, 20), (60, -10)]


@pytest.mark.parametrize("brush", [{"flow": 0.25}, {"flow": 0.1, "spacing": 0.3}, {"spacing": 1.25}, {}])
def test_a_stroke_does_not_depend_on_how_often_the_pen_is_told(brush, studio, page):
    often = stroke_drawn(studio, page, LINE, 20, **brush)
    rarely = stroke_drawn(studio, page, LINE, 2, **brush)
    assert often.max() > 40
    assert np.abs(often - rarely).max() <= 1


def test_paint_of_little_flow_builds_up_to_what_one_of_full_flow_is(studio, page):
    there_and_back = [*LINE, *LINE[::-1], *LINE]
    line = stroke_drawn(studio, page, LINE, size=30, hardness=0.4)
    found = []
    for places in (LINE, there_and_back, there_and_back * 8):
        found.append(stroke_drawn(studio, page, places, 1, size=30, hardness=0.4, flow=0.06))
        assert (found[-1] <= line + 1).all()
    once, thrice, often = found
    assert 0.3 < once.max() / 255 < 0.7
    assert (once <= thrice).all()
    assert thrice.max() > once.max() + 40
    inner = np.s_[:, line.shape[1] // 2 - 50 : line.shape[1] // 2 + 40]  # dabs end before the line does
    assert np.abs(often - line)[inner].max() <= 10
    full = stroke_drawn(studio, page, LINE, size=30, hardness=0.4, flow=0.99, spacing=0.05)
    assert np.abs(full - line)[inner].max() <= 6


def test_dabs_lie_as_far_from_each_other_as_the_spacing_says(studio, page):
    codes = stroke_drawn(studio, page, [(-60, 0), (60, 0)], size=20, hardness=1, spacing=1.5)
    row = codes[codes.shape[0] // 2] > 128
    starts = np.flatnonzero(np.diff(row.astype(int), prepend=0) == 1)
    assert len(starts) == 5
    assert np.abs(np.diff(starts) - 30).max() <= 1


@pytest.mark.parametrize(
    "brush",
    [
        {"flow": 0.15, "hardness": 0.3},
        {"spacing": 1.2, "hardness": 0.6},
        {"unit": "model", "size": 140},
        {"opacity": 0.5, "flow": 0.5, "blend": "multiply"},
    ],
)
def test_each_setting_of_the_brush_is_seen_at_once_as_it_is_baked(brush, studio, page):
    drags = [(brush, [(-60, 0), (0, -40), (60, 20)])]
    assert_same_inside(drawn_and_baked(studio, page, drags))


def test_a_size_in_the_model_s_units_stays_the_same_on_the_surface(studio, page):
    page.evaluate("viewer.painting.set({ unit: 'model', size: 100, hardness: 1 })")
    edge = studio.texture.placement.size
    for zoom in (1, 2.5):
        page.evaluate("(zoom) => { viewer.camera.zoom(zoom); viewer.invalidate(); }", zoom)
        sharp(page)
        before = studio.session.shown.texture
        studio.drag(page, (0, 0), (0, 0))
        studio.is_done(page)
        points = studio.surface.scatter(40_000, 0)
        apart = studio.session.shown.texture.sample(points) - before.sample(points)
        painted = points.points[np.abs(apart).max(axis=1) > 0.15]
        away = np.linalg.norm(painted - painted.mean(axis=0), axis=1)
        assert away.max() == pytest.approx(0.05 * edge, rel=0.12)
        page.keyboard.press("Control+z")


def test_the_unit_changes_and_the_size_stays(page):
    page.mouse.move(*middle(page))
    page.evaluate("document.getElementById('brush-section').open = true")
    page.select_option("#unit", "model")
    assert page.evaluate("viewer.painting.brush.size") != 40
    assert page.evaluate("viewer.painting.brushWidth") == pytest.approx(40, rel=0.03)
    page.select_option("#unit", "pixels")
    assert page.evaluate("viewer.painting.brush.size") == pytest.approx(40, abs=2)
    page.evaluate("document.getElementById('brush-section').open = false")


def test_a_pen_s_pressure_changes_what_it_is_set_to(studio, page):
    left, top = middle(page)
    pen = page.context.new_cdp_session(page)

    def pressed(how):
        page.evaluate("(pressure) => viewer.painting.set({ pressure, hardness: 1, size: 30 })", how)
        event = {"button": "left", "clickCount": 1, "pointerType": "pen"}
        with studio.held(page):
            for kind, right, force in (("Pressed", 0, 0.2), ("Moved", 30, 0.5), ("Moved", 60, 0.8)):
                place = {"x": left - 30 + right, "y": top, "force": force, "buttons": 1}
                pen.send("Input.dispatchMouseEvent", {"type": f"mouse{kind}", **event, **place})
            pen.send("Input.dispatchMouseEvent", {"type": "mouseReleased", **event, **place, "buttons": 0})
        return sent(studio, page)

    heights, codes = {}, {}
    for how in ("size", "opacity", "both", ""):
        covered = pressed(how)
        near, far = (covered[:, int(left) + x] for x in (-29, 29))
        heights[how], codes[how] = [(each > 60).sum() / 30 for each in (near, far)], [near.max(), far.max()]
    assert heights["size"] == pytest.approx([0.35, 0.8], abs=0.12)
    assert codes["size"] == [255, 255]
    assert heights["opacity"][1] == pytest.approx(1, abs=0.05)
    assert codes["opacity"] == pytest.approx([0.25 * 255, 0.75 * 255], abs=15)
    assert codes["both"][1] < 220
    assert heights[""] == pytest.approx([1, 1], abs=0.05)
    assert codes[""] == [255, 255]


_ARC = """async ([count, radius, turn]) => {
  const { Path } = await import("./path.js"), found = [];
  const place = (n) => [Math.cos, Math.sin].map((of) => radius * of((turn * n) / count)).concat([n]);
  const path = new Path(place(0));
  for (let n = 1; n <= count; n++) {
    for (const [from, to] of path.to(place(n))) {
      for (const t of [0, 0.25, 0.5, 0.75]) found.push(from.map((each, m) => each + t * (to[m] - each)));
    }
  }
  return found;
}"""


def test_the_way_of_a_pen_is_a_curve_through_its_places(page):
    points = np.array(page.evaluate(_ARC, [16, 100, 2 * np.pi]))
    away = np.abs(np.linalg.norm(points[:, :2], axis=1) - 100)
    straight = 100 * (1 - np.cos(np.pi / 16))
    later = points[:, 2] > 2  # it has then seen how the pen turns
    assert away[later].max() < straight / 2.5
    assert (np.diff(points[:, 2]) > -1e-9).all()
    corners = np.array(page.evaluate(_ARC, [3, 100, 2 * np.pi]))  # a triangle stays one
    sides = np.linalg.norm(corners[:, :2], axis=1)
    assert sides.min() == pytest.approx(50, abs=2)
    line = np.array(page.evaluate(_ARC, [4, 1e9, 1e-6]))
    assert np.abs(line[:, 0] - 1e9).max() < 1e-2


def test_the_outline_shows_how_the_surface_is_turned(page):
    left, top = middle(page)
    needle = "document.querySelector('#ring i').getBoundingClientRect()"
    turned = {
        (0, 0): "width < 4 && height < 4",
        (100, 0): "width > 6 && height < 4",
        (0, -100): "width < 4 && height > 6",
    }
    for (x, y), expected in turned.items():
        page.mouse.move(left + x, top + y)
        page.wait_for_function(f"(({{ width, height }}) => {expected})({needle})")
    page.evaluate(  # moved to a place before the image is drawn
        """([x, y]) => {
          viewer.invalidate();
          const place = { clientX: x, clientY: y, bubbles: true };
          viewer.canvas.dispatchEvent(new PointerEvent("pointermove", place));
        }""",
        [left + 100, top],
    )
    page.wait_for_function(f"(({{ width, height }}) => {turned[100, 0]})({needle})")
    sharp(page)
    found, drawn = page.evaluate("""async () => {
      const { hitAt } = await import("./hit.js"), { gl, canvas } = viewer.gpu, drawn = [];
      const names = Object.getOwnPropertyNames(WebGL2RenderingContext.prototype);
      const draws = names.filter((name) => name.startsWith("draw"));
      for (const name of draws) gl[name] = () => drawn.push(name);
      const found = hitAt(viewer, canvas.clientWidth / 2, canvas.clientHeight / 2);
      for (const name of draws) delete gl[name];
      return [found, drawn];
    }""")
    assert found["depth"] > 0
    assert drawn == []  # the pointer moves too often for that


def last_command(session):
    """The command that a page has sent last, as the journal has it."""
    line = bytes(session._journal.path.read_bytes()).rpartition(b'{"page"')[2].partition(b"\n")[0]
    return dict(json.loads(b'{"page"' + line))


def test_pages_send_what_the_controls_of_strokes_and_fills_say(studio, page):
    page.evaluate("for (const id of ['where', 'filling']) document.getElementById(id).open = true")
    for name in ("backFaces", "hidden", "onePart"):
        page.check(f"#{name}")
    page.select_option("#mirror", "y")
    page.fill("#mirrorPosition", "10")
    page.select_option("#blend", "screen")
    studio.drag(page, (0, 0), (20, 0))
    studio.is_done(page)
    found = last_command(studio.session)
    chosen = {name: found[name] for name in ("backFaces", "hidden", "mirror", "blend")}
    assert chosen == {"backFaces": True, "hidden": True, "mirror": "y", "blend": "screen"}
    assert found["offset"] == pytest.approx(0.2, abs=0.01)
    assert np.linalg.norm(found["at"]) == pytest.approx(1, abs=0.02)
    page.keyboard.press("Control+z")  # fills of finer cells take long
    for filled, like in (
        ("color", [8, True]),
        ("colors", [8, False]),
        ("part", [None, None]),
        ("all", [None] * 2),
    ):
        page.select_option("#fills", filled)
        if like[0]:
            page.fill("#tolerance", "8")
        page.click("#tool-fill")
        studio.drag(page, (0, 0))
        studio.is_done(page)
        found = last_command(studio.session)
        assert [found.get("tolerance"), found.get("connected")] == like
        assert ("at" in found) == (filled != "all")
        assert page.locator("#tolerance").is_disabled() == (like[0] is None)
    page.evaluate("for (const id of ['where', 'filling']) document.getElementById(id).open = false")


def turned(page, turn):
    page.evaluate(
        "(turn) => { viewer.camera.turn = turn; viewer.camera.tilt = 0.1; viewer.invalidate(); }", turn
    )
    sharp(page)


@pytest.mark.parametrize("offset", [0, 5])
def test_the_other_half_of_a_stroke_is_seen_at_once_where_it_is_baked(offset, studio, page):
    turned(page, 0.0)
    brush = {"mirror": "x", "mirrorPosition": offset, "hardness": 0.6}
    images = drawn_and_baked(studio, page, [(brush, [(40, 10), (80, -40)])])
    inside = assert_same_inside(images)
    half = inside.shape[1] // 2
    assert inside[:, :half].sum() > 200
    assert inside[:, half:].sum() > 200


def test_a_stroke_that_goes_through_is_seen_when_the_view_turns_before_it_is_baked(studio, page):
    turned(page, 0.0)
    brush = {"hidden": True, "backFaces": True, "angle": 80, "hardness": 0.6}
    page.evaluate("(brush) => viewer.painting.set(brush)", brush)
    with studio.held(page):
        studio.drag(page, (-30, 0), (40, 30))
    page.evaluate("viewer.camera.turn = Math.PI")
    before, shown = imaged(page, strokes=None), imaged(page)
    studio.bake(page)
    assert_same_inside((before, shown, imaged(page)))


@pytest.fixture(scope="module")
def pair(browser, tmp_path_factory):
    """Two balls beside each other along x."""
    surface = balls([2.1, 0.2, -0.3], 16, 16)
    with Studio(browser, tmp_path_factory.mktemp("pair"), surface).shared() as found:
        yield found


@pytest.mark.parametrize("mirror", ["", "x"])
def test_a_stroke_stays_on_its_part_and_is_seen_to(mirror, pair):
    brush = {"onePart": True, "size": 60, "hardness": 0.6, "mirror": mirror}
    drag = [(-40, -10), (60, -10)]
    with pair.restored() as page:
        turned(page, 0.0)
        images = drawn_and_baked(pair, page, [(brush, drag)])
        texture = pair.session.shown.texture
    inside = assert_same_inside(images, ends_sharply=True)
    half = inside.shape[1] // 2
    assert inside[:, :half].sum() > 200
    assert (inside[:, half + 6 :].sum() > 200) == bool(mirror)
    painted = np.abs(texture.sample(pair.surface.scatter(4000, 0)) - 0.5).max(axis=1) > 0.1
    parts = pair.surface.parts[pair.surface.scatter(4000, 0).triangles]
    assert painted[parts == 0].mean() > 0.04
    assert (painted[parts == 1].mean() > 0.04) == bool(mirror)  # cells at the border hold both


def test_a_pen_that_comes_down_before_the_image_is_drawn_stays_on_its_part(pair):
    with pair.restored() as page:
        turned(page, 0.0)
        page.evaluate("(brush) => viewer.painting.set(brush)", {"onePart": True, "size": 20})
        moves = '"pointerdown", () => viewer.invalidate(), { capture: true, once: true }'
        page.evaluate(f"window.addEventListener({moves})")
        with pair.held(page):
            pair.drag(page, (-40, -10), (-20, -10))
        at = page.evaluate("viewer.painting.commands.waiting[0].at")
        pair.bake(page)
    assert at is not None
