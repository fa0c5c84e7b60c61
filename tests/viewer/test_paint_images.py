"""Tools that put images down, in a real browser: they show what the library paints with these images."""

import base64
import zlib
from contextlib import contextmanager

import numpy as np
import PIL.Image
import pytest

from octex.source.surface import Surface
from tests.make.browser import camera_of, drawn
from tests.make.easel import Easel
from tests.make.fixtures import saved
from tests.make.painted import square, together
from tests.make.same import assert_same
from tests.make.studio import _HOLD


@contextmanager
def painted_in_a_page(browser, folder, surface=None):
    found = Easel(browser, folder, surface)
    with found.opened() as found.shown:
        yield found


@pytest.fixture(scope="module")
def easel(browser, tmp_path_factory):
    with painted_in_a_page(browser, tmp_path_factory.mktemp("easel")) as found:
        yield found


@pytest.fixture
def clean(easel):
    easel.clear()
    return easel


def smooth(width=200, height=160):
    """An image of smooth colours, transparent towards its right."""
    y, x = np.mgrid[:height, :width]
    alpha = np.clip(255 * (width - x) / 20, 0, 255)
    return np.dstack([255 * x / width, 255 * y / height, 128 + 60 * np.sin(x / 30), alpha]).astype(np.uint8)


def middle(easel):
    width, height = easel.shown.evaluate("[viewer.screenSize.width, viewer.screenSize.height]")
    return width // 2, height // 2


def assert_shown_as_baked(easel, plain):
    """Wait until what is held back is painted, and compare; return where the image has changed."""
    easel.shown.wait_for_function("viewer.painting.commands.waiting.length > 0")
    before = seen(easel).astype(int)
    easel.shown.evaluate("release()")
    easel.done()
    after = seen(easel).astype(int)
    inside = np.abs(before - plain.astype(int)).max(axis=2) > 12
    assert inside.mean() > 0.005
    assert np.sqrt(((before - after)[inside] ** 2).mean()) <= 2
    return inside


def test_a_stencil_that_is_put_down_is_the_image_that_the_library_paints(clean):
    image = np.random.default_rng(1).integers(0, 256, (80, 120, 3), np.uint8)
    clean.lay(image)
    clean.shown.evaluate("viewer.painting.stencil.set({ scale: 1, x: 10, y: -5 })")
    clean.shown.keyboard.press("Enter")
    clean.done()
    given, sent, camera = clean.sent()
    x, y = middle(clean)
    expected = np.zeros_like(sent)
    expected[y - 45 : y + 35, x - 50 : x + 70] = np.dstack([image, np.full(image.shape[:2], 255, np.uint8)])
    assert (sent == expected).all()
    assert given["name"] == "Image"
    assert_same(clean.session.shown.texture, clean.painted(expected, camera))


def test_the_brush_paints_through_a_stencil_and_shows_what_is_baked(clean):
    clean.lay(smooth())
    clean.shown.evaluate("viewer.painting.stencil.set({ scale: 0.8, x: 0, y: 0, angle: 0.3 })")
    clean.shown.keyboard.press("b")
    plain = seen(clean)
    clean.shown.evaluate(_HOLD)
    clean.drag(clean.shown, (-70, -20), (90, 30))
    inside = assert_shown_as_baked(clean, plain)
    assert inside.mean() < 0.2
    given, sent, camera = clean.sent()
    assert given["name"] == "Stencil"
    assert np.unique(sent[..., 3]).size > 3
    assert np.ptp(sent[..., 0][sent[..., 3] == 255]) > 100
    assert_same(clean.session.shown.texture, clean.painted(sent, camera))
    x, _ = middle(clean)
    assert not sent[:, x + 85 :, 3].any(), "nothing is painted where the stencil is transparent"


def test_a_stencil_is_mirrored_only_if_that_is_asked(clean):
    clean.lay(smooth())
    clean.shown.evaluate("viewer.painting.set({ mirror: 'x' })")
    for is_asked in (False, True):
        clean.shown.locator("#stencil-isMirrored").set_checked(is_asked)
        clean.shown.locator("#stencil-stamp").click()
        clean.done()
        assert clean.sent()[0]["mirror"] == ("x" if is_asked else "")
    steps = clean.shown.evaluate("viewer.painting.status.steps")
    assert steps == ["Image", "Image, mirrored"]


def test_a_stencil_is_paint_of_one_colour_where_it_is_dark(clean):
    image = np.full((40, 40, 3), 255, np.uint8)
    image[:, 20:] = 0
    clean.lay(image)
    clean.shown.evaluate("viewer.painting.set({ color: [10, 200, 30] })")
    clean.shown.evaluate("viewer.painting.stencil.set({ scale: 1, x: 0, y: 0 })")
    clean.shown.select_option("#stencil-colors", "dark")
    clean.shown.locator("#stencil-stamp").click()
    clean.done()
    _, sent, _ = clean.sent()
    x, y = middle(clean)
    assert (sent[y - 20 : y + 20, x : x + 20] == (10, 200, 30, 255)).all()
    assert sent[..., 3].astype(bool).sum() == 800


def test_pointers_and_keys_move_turn_and_scale_a_stencil(clean):
    page = clean.shown
    clean.lay(smooth(100, 100))
    page.evaluate("viewer.painting.stencil.set({ scale: 1, x: 0, y: 0 })")
    before = page.evaluate("String(viewer.camera.view)")

    def stands():
        code = "(({ x, y, angle, scale }) => [x, y, angle, scale])(viewer.painting.stencil)"
        return page.evaluate(code)

    clean.drag(page, (0, 0), (30, -20))
    np.testing.assert_allclose(stands(), [30, -20, 0, 1])
    clean.drag(page, (80, 30), (-70, 80))  # a corner goes around the middle, twice as far away
    np.testing.assert_allclose(stands(), [30, -20, np.pi / 2, 2], atol=0.02)
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Shift+ArrowDown")
    page.keyboard.press(".")
    np.testing.assert_allclose(stands(), [29, -10, np.pi / 2 + np.pi / 180, 2], atol=0.02)
    page.mouse.wheel(0, 200)
    assert stands()[3] < 2
    page.evaluate("viewer.painting.stencil.set({ scale: 1, x: 0, y: 0, angle: 0 })")
    page.evaluate(
        """() => {
          const frame = document.getElementById("stencil"), box = viewer.canvas.getBoundingClientRect();
          frame.setPointerCapture = () => {};
          const send = (name, pointerId, x, y) => {
            const at = { clientX: box.left + box.width / 2 + x, clientY: box.top + box.height / 2 + y };
            const event = new PointerEvent(name, { pointerId, pointerType: "touch", bubbles: true, ...at });
            frame.dispatchEvent(event);
          };
          send("pointerdown", 7, -20, 0);
          send("pointerdown", 8, 20, 0);
          send("pointermove", 8, 60, 0);
          send("pointermove", 7, 20, 0);
          for (const finger of [7, 8]) send("pointerup", finger, 0, 0);
        }"""
    )
    np.testing.assert_allclose(stands(), [40, 0, 0, 1], atol=1e-6)
    assert page.evaluate("String(viewer.camera.view)") == before
    clean.drag(page, (-200, 100), (-180, 100))  # beside it the view turns
    assert page.evaluate("String(viewer.camera.view)") != before
    page.keyboard.press("Delete")
    assert page.evaluate("viewer.painting.tool.name") == "brush"
    assert not page.locator("#stencil").is_visible()
    assert clean.bodies == []


def animated(kind):
    first, second = (PIL.Image.new("RGB", (8, 8), color) for color in ("red", "blue"))
    return saved(first, kind, save_all=True, append_images=[second])


def test_what_is_no_image_is_refused_in_a_line(clean):
    huge = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", (10_000).to_bytes(4, "big") * 2 + bytes([8, 0, 0, 0, 0]))
    huge += chunk(b"IDAT", zlib.compress(bytes(10_001 * 100))) + chunk(b"IEND", b"")
    for name, content, text in (
        ("notes.txt", b"hello", "notes.txt is no PNG, JPEG or WebP image."),
        ("empty.png", b"", "empty.png is no PNG"),
        ("moving.gif", animated("GIF"), "moving.gif is no PNG"),
        ("moving.png", animated("PNG"), "moving.png is animated"),
        ("moving.webp", animated("WEBP"), "moving.webp is animated"),
        ("half.png", saved(smooth())[:40], "half.png is damaged"),
        ("huge.png", huge, "huge.png has 10000 × 10000 pixels"),
    ):
        clean.give(name, content)
        clean.says(text)
    assert clean.shown.evaluate("viewer.painting.stencil.bitmap") is None
    folder = "[{ webkitGetAsEntry: () => ({ isDirectory: true, name: 'photos' }) }]"
    for items, files, text in (
        (folder, "[1]", "photos is a folder"),
        ("[]", "[1, 2]", "Drop one image at a time"),
        ("[]", "[]", "Drop an image that is a file"),
    ):
        event = f"Object.assign(new Event('drop'), {{ dataTransfer: {{ items: {items}, files: {files} }} }})"
        clean.shown.evaluate(f"document.dispatchEvent({event})")
        clean.says(text)


def chunk(name, content):
    return len(content).to_bytes(4, "big") + name + content + zlib.crc32(name + content).to_bytes(4, "big")


def seen(easel):
    """Return the colours of the view, as large as strokes are."""
    size = easel.shown.evaluate("[viewer.screenSize.width, viewer.screenSize.height]")
    look = {"mode": "channel", "channel": "base_color", "highlight": None, "facing": False}
    return drawn(easel.shown, tuple(size), **look)


def stripes(easel):
    """Paint stripes of smooth edges across the middle."""
    y, x = np.mgrid[:120, :240]
    wave = 128 + 100 * np.sin(x / 4)
    easel.lay(np.dstack([wave, 255 - wave, np.full_like(wave, 60 + y)]).astype(np.uint8))
    easel.shown.evaluate("viewer.painting.stencil.set({ scale: 1, x: 0, y: 0 })")
    easel.shown.keyboard.press("Enter")
    easel.done()
    easel.shown.keyboard.press("Delete")


def test_a_clone_copies_the_pixels_around_its_source(clean):
    page = clean.shown
    stripes(clean)
    page.keyboard.press("o")
    page.keyboard.down("Alt")
    clean.drag(page, (-40, -10))
    page.keyboard.up("Alt")
    before = seen(clean)
    page.evaluate(_HOLD)
    clean.drag(page, (20, 60), (50, 55))
    inside = assert_shown_as_baked(clean, before)
    assert inside.mean() < 0.2
    given, sent, _ = clean.sent()
    assert given["name"] == "Clone"
    copied = np.roll(before, (70, 60), axis=(0, 1))
    is_painted = sent[..., 3] > 0
    assert is_painted.sum() > 1000
    assert np.abs(sent[is_painted][:, :3].astype(int) - copied[is_painted]).max() <= 1
    clean.drag(page, (30, 60))  # the next stroke goes on beside it
    clean.done()
    _, again, _ = clean.sent()
    is_painted = again[..., 3] > 0
    assert np.abs(again[is_painted][:, :3].astype(int) - copied[is_painted]).max() <= 12


def test_a_clone_asks_for_its_source_and_says_when_that_is_hidden(clean):
    page = clean.shown
    page.keyboard.press("o")
    clean.drag(page, (0, 0))
    clean.says("The source is set: now paint.")
    assert clean.bodies == []
    clean.drag(page, (30, 30), (40, 30))
    clean.done()
    assert len(clean.bodies) == 1
    page.evaluate("viewer.camera.orbit(3, 0)")
    clean.drag(page, (0, 0), (10, 0))
    clean.says("hidden: press Set another source, or Alt and click.")
    assert len(clean.bodies) == 1


@pytest.mark.parametrize("tool", ["Smudge", "Blur", "Sharpen"])
def test_what_is_smudged_or_blurred_is_shown_as_it_is_baked(clean, tool):
    page = clean.shown
    stripes(clean)
    page.keyboard.press("u" if tool == "Smudge" else "r")
    page.evaluate(
        "(effect) => viewer.painting.retouch.set({ effect, radius: 8 })",
        "sharpen" if tool == "Sharpen" else "blur",
    )
    before = seen(clean)
    page.evaluate(_HOLD)
    clean.drag(page, (-60, -20), (60, 10))
    assert_shown_as_baked(clean, before)
    given, sent, _ = clean.sent()
    assert (given["name"], given["mirror"]) == (tool, "")
    is_painted = sent[..., 3] == 255
    spread = [image[is_painted][:, 0].astype(float).std() for image in (sent, before)]
    assert spread[0] > spread[1] + 5 if tool == "Sharpen" else spread[0] < spread[1] - 5


def test_a_smudge_pulls_a_line_out_without_ribs(clean):
    page = clean.shown
    page.evaluate("viewer.painting.set({ color: [0, 0, 0], size: 8 })")
    clean.drag(page, (-40, -60), (-40, 60))
    clean.done()
    page.evaluate("viewer.painting.set({ size: 40 })")
    page.keyboard.press("u")
    clean.drag(page, (-27, 0), (60, 0))
    clean.done()
    _, sent, _ = clean.sent()
    x, y = middle(clean)
    pulled = sent[y, x - 40 : x + 40, 0].astype(int)
    darkest = pulled.argmin()
    assert pulled[darkest] < 20
    assert np.diff(pulled[:darkest]).max() <= 0 <= np.diff(pulled[darkest:]).min()


def test_one_colour_blurred_smudged_and_cloned_stays_as_it_is_up_to_the_edge(clean):
    page = clean.shown
    for key, number in (("r", 1), ("u", 2), ("o", 4)):
        page.keyboard.press(key)
        if key == "o":
            clean.drag(page, (0, 0))
        clean.drag(page, (60, 0), (160, 20))
        clean.done()
        _, sent, _ = clean.sent()
        is_painted = sent[..., 3] > 0
        assert is_painted.sum() > 1000
        assert (sent[is_painted][:, :3] == 188).all()
        assert len(clean.bodies) == number - (key == "o")
    points = np.random.default_rng(1).normal(size=(500, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    found = clean.session.shown.texture.sample(points, ["base_color"])["base_color"]
    np.testing.assert_allclose(found, clean.texture.sample(points, ["base_color"])["base_color"], atol=1e-6)


def test_colours_of_another_surface_and_of_nothing_do_not_bleed_in(browser, tmp_path_factory):
    points, triangles = together(square(0.4, 1.0), square(-0.4, 2.0))

    def colors_at(points):
        return np.where(points[:, 2:] > 0, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])

    surface = Surface.from_arrays(points, triangles).with_sources({"base_color": colors_at})
    with painted_in_a_page(browser, tmp_path_factory.mktemp("squares"), surface) as easel:
        page = easel.shown
        page.evaluate("viewer.camera.reset(0.2, 0.1); viewer.invalidate()")
        page.evaluate("viewer.painting.retouch.set({ radius: 12 })")
        page.evaluate("viewer.painting.set({ opacity: 1 })")
        for key in "ru":
            page.keyboard.press(key)
            easel.drag(page, (0, 0), (100, 10), (190, 0))
            easel.done()
            _, sent, _ = easel.sent()
            colors = np.unique(sent[sent[..., 3] > 0][:, :3], axis=0)
            assert colors.tolist() == [[0, 0, 255], [255, 0, 0]]


def drop(easel, name, content):
    """Drop a file on the page."""
    easel.shown.evaluate(
        """([name, codes]) => {
          const bytes = Uint8Array.from(atob(codes), (c) => c.charCodeAt(0));
          const dataTransfer = new DataTransfer();
          dataTransfer.items.add(new File([bytes], name));
          document.body.dispatchEvent(new DragEvent("drop", { bubbles: true, dataTransfer }));
        }""",
        [name, base64.b64encode(content).decode()],
    )


def saved_view(easel):
    """Save the view for another program; return the name and the image of the file."""
    easel.shown.locator("#external").evaluate("(section) => section.open = true")
    with easel.shown.expect_download() as found:
        easel.shown.click("#save-view")
    with PIL.Image.open(found.value.path()) as image:
        return found.value.suggested_filename, np.asarray(image).copy()


def test_a_view_painted_in_another_program_comes_back_after_the_page_was_loaded_again(clean):
    page = clean.shown
    name, before = saved_view(clean)
    camera = camera_of(page, before.shape[1::-1])
    assert name.startswith("ball-view-")
    is_seen = before[..., 3] == 255
    assert (before[is_seen][:, :3] == 188).all()
    assert (before[~is_seen] == 0).all()
    assert 0.1 < is_seen.mean() < 0.4
    edited = before.copy()
    rows, columns = np.s_[180:230], np.s_[280:340]
    edited[rows, columns, :3] = np.random.default_rng(1).integers(0, 256, (50, 60, 3))
    edited[rows, columns, 3] = np.linspace(10, 255, 60).astype(np.uint8)
    edited[300:310, 200:400] = 188, 188, 188, 0  # rubbed out
    edited[100:110, 250:350] = 255, 255, 0, 255  # and some of it beside the model
    page.evaluate("viewer.camera.orbit(0.7, 0.2)")
    page.reload()
    page.wait_for_function("globalThis.viewer?.painting && viewer.isSharp")
    drop(clean, name.replace(".png", " (1).png"), saved(edited))
    page.wait_for_function("viewer.painting.commands.number === 1")
    clean.done()
    assert clean.sent()[0]["name"] == "Painted elsewhere"
    assert_same(clean.session.shown.texture, clean.painted(edited, camera, since=before))
    assert not clean.shown.locator("#stencil").is_visible()


def test_a_view_that_comes_back_to_where_it_was_seen_is_shown_as_it_is_baked(clean):
    name, before = saved_view(clean)
    y, x = np.mgrid[:80, :120]
    edited = before.copy()
    fading = np.clip(12 * np.minimum(40 - np.abs(y - 40), 60 - np.abs(x - 60)), 0, 255)
    edited[170:250, 250:370] = np.dstack([x, 2 * y, np.full_like(x, 60), fading])
    plain = seen(clean)
    clean.shown.evaluate(_HOLD)
    drop(clean, name, saved(edited))
    assert_shown_as_baked(clean, plain)


def test_what_does_not_come_back_as_it_went_is_said(clean):
    name, before = saved_view(clean)
    rgb = PIL.Image.fromarray(before[..., :3])
    other = name.replace(name[-12:-4], "0" * 8)
    drop(clean, name, saved(before))
    clean.says("is the view as it was saved")
    drop(clean, name, saved(before[:-1]))
    clean.says("keep its size")
    drop(clean, name.replace("png", "jpg"), saved(rgb, "JPEG"))
    clean.says("save it as PNG")
    drop(clean, name, b"nothing")
    clean.says("is no PNG, JPEG or WebP image")
    assert clean.shown.evaluate("viewer.painting.stencil.bitmap") is None
    drop(clean, other, saved(before))
    clean.says("it lies over the model as a stencil")
    assert clean.shown.locator("#stencil").is_visible()
    assert clean.bodies == []
