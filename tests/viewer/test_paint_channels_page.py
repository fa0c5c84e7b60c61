"""Painting of any channel in a real browser: seen at once as it will be painted; what is redrawn then."""

import numpy as np
import pytest

import octex
from octex.channels import ChannelFormat, encode
from octex.drawing import render_surface, texture_shader
from octex.drawing.environment import Environment
from octex.texture import Channel
from octex.viewer import write_page
from tests.make.browser import Probe, camera_of, drawn, sharp
from tests.make.painted import ball
from tests.make.small_textures import with_channel
from tests.make.studio import Studio

SCALARS = {"roughness": 0.6, "metallic": 0.1, "occlusion": 0.9}
VIEW = 240, 200


@pytest.fixture(scope="module")
def shop(browser, tmp_path_factory):
    """A ball of a plain material, with a height and a number that light does not show, of 1/2 everywhere."""
    plain = {"base_color": lambda p: np.full_like(p, 0.5), "emissive": (0.0, 0.0, 0.0), **SCALARS}
    surface = ball(24).with_sources(plain)
    texture = octex.convert(surface, depth=6)
    for name in ("height", "moisture"):
        texture = with_channel(texture, ChannelFormat(name, 1, "data"), 128)
    with Studio(browser, tmp_path_factory.mktemp("shop"), surface, texture).shared() as found:
        yield found


@pytest.fixture
def page(shop):
    with shop.restored() as found:
        yield found


def imaged(page, shown, channel="base_color"):
    return drawn(page, VIEW, mode=shown, channel=channel, highlight=None, facing=False).astype(np.int64)


def ticked(page, **values):
    known = page.evaluate("viewer.painting.brush.values")
    page.evaluate("(brush) => viewer.painting.set(brush)", {"channels": [*values], "values": known | values})


@pytest.mark.parametrize(
    "values",
    [
        {"roughness": 0.1},
        {"metallic": 1.0, "roughness": 0.2},
        {"base_color": 0, "roughness": 0.9, "metallic": 0.9, "occlusion": 0.3, "emissive": [60, 10, 90]},
        {"moisture": 1.0},
        {"height": 1.0},
    ],
    ids=" ".join,
)
def test_channels_are_seen_at_once_as_they_will_be_painted(values, shop, page):
    ticked(page, **values)
    looks = [*(("channel", name) for name in values), ("lit", "base_color")]
    plain = {look: imaged(page, *look) for look in looks}
    page.evaluate(
        "viewer.display.mode = 'channel'; viewer.display.channel = viewer.painting.brush.channels[0]"
    )
    with shop.held(page, 2):
        for places in (((-60, 0), (0, -40)), ((0, -40), (60, 20))):
            shop.drag(page, *places)
    before = {look: imaged(page, *look) for look in looks}
    shop.bake(page)
    is_painted = np.zeros(VIEW[::-1], np.bool_)
    for look in looks:
        after = imaged(page, *look)
        is_changed = np.abs(after - plain[look]).max(axis=2)
        if look[0] == "channel":
            is_painted |= is_changed > 12
            assert 0.02 < is_painted.mean() < 0.3
        assert (is_changed > 2).any() == (look[0] == "channel" or "moisture" not in values)
        assert np.sqrt(((before[look] - after)[is_painted] ** 2).mean()) <= 2, look
    for name, channel in shop.texture.channels.items():
        shape = channel.values.shape
        if name not in values and shop.session.shown.texture.channels[name].values.shape == shape:
            assert (shop.session.shown.texture.channels[name].values == channel.values).all()


def test_relief_near_a_change_is_drawn_anew_as_if_all_were(shop, page):
    ticked(page, height=1.0)
    page.evaluate("viewer.display.mode = 'lit'; viewer.maxScale = 0.25; viewer.invalidate()")
    page.evaluate("viewer.painting.set({ size: 8 })")
    sharp(page)
    near = 0
    for number in range(1, 5):
        looked_up, images = page.evaluate("[viewer.lookupKey, viewer.imageCount]")
        shop.drag(page, (10 * number, 0), (10 * number, 20))
        shop.is_done(page)
        page.wait_for_function("!viewer.changedRegion && viewer.isSharp")
        unlike, shown = page.evaluate(_UNLIKE)
        assert unlike == 0
        assert shown > 100
        if looked_up == page.evaluate("viewer.lookupKey"):
            near += page.evaluate("viewer.imageCount") == images
    assert near > 0


def test_the_picker_takes_what_is_ticked_and_a_fill_paints_it(shop, page):
    ticked(page, roughness=0.0, moisture=1.0)
    page.evaluate("viewer.painting.set({ fills: 'all' })")
    color = page.evaluate("viewer.painting.brush.color")
    page.keyboard.press("f")
    shop.drag(page, (0, 0))
    shop.is_done(page)
    points = shop.surface.vertices[:20]
    for name, value in (("roughness", 0.0), ("moisture", 1.0), ("metallic", 0.1)):
        found = shop.session.shown.texture.sample(points, name)
        np.testing.assert_allclose(found, value, atol=2 / 255)
    ticked(page, roughness=0.7, occlusion=0.0)
    page.keyboard.down("Alt")
    shop.drag(page, (0, 0))
    page.keyboard.up("Alt")
    picked = page.evaluate("viewer.painting.brush.values")
    assert abs(picked["roughness"]) < 0.01
    assert abs(picked["occlusion"] - 0.9) < 0.01
    assert picked["moisture"] == 1.0
    assert page.evaluate("viewer.painting.brush.color") == color


def test_what_is_ticked_is_shown_and_what_is_not_seen_is_not_painted(shop, page):
    look = "[viewer.display.mode, viewer.display.channel]"
    page.evaluate("viewer.painting.set({ channels: ['base_color'] }); viewer.painting.material.showPainted()")
    page.evaluate("document.getElementById('material').open = true")
    page.check("#paints-moisture")
    assert page.evaluate(look)[0] == "lit"
    page.uncheck("#paints-base_color")
    assert page.evaluate(look) == ["channel", "moisture"]
    assert page.evaluate("document.getElementById('mode').value") == "channel moisture"
    page.check("#paints-roughness")
    page.uncheck("#paints-moisture")
    assert page.evaluate(look)[0] == "lit"
    page.evaluate("viewer.display.mode = 'channel'; viewer.display.channel = 'metallic'")
    shop.drag(page, (0, 0), (20, 0))
    assert page.locator("#paint-note").inner_text() == "Tick Metal under Material to paint it."
    page.evaluate("viewer.display.mode = 'lit'")
    page.uncheck("#paints-roughness")
    shop.drag(page, (0, 0), (20, 0))
    assert page.locator("#paint-note").inner_text() == "Tick under Material what to paint."
    assert page.evaluate("viewer.painting.status.done") == 0
    page.locator("#value-metallic").fill("0.5")
    assert page.evaluate("viewer.painting.material.paint") == {"color": None, "values": {"metallic": [0.5]}}


def test_a_channel_is_added_in_the_page_and_the_brush_stays_as_it_was(studio):
    with studio.restored() as page:
        page.evaluate("viewer.painting.set({ size: 77 })")
        page.evaluate("globalThis.isSame = true")
        page.click("#material summary")
        page.select_option("#add-channel", "roughness")
        page.wait_for_function("globalThis.viewer?.painting?.status.done === 1 && viewer.isSharp")
        assert page.evaluate("viewer.painting.brush.size") == 77
        assert page.evaluate("isSame")  # the page was not loaded anew
        assert page.evaluate("viewer.painting.status.steps") == ["Add roughness"]
        assert page.is_checked("#paints-roughness")
        assert page.locator("#value-roughness").is_visible()
        studio.drag(page, (-20, 0), (20, 0))
        page.wait_for_function("viewer.painting.status.done === 2")
        rough = studio.session.shown.texture.channels["roughness"].values
        assert (rough.min(), rough.max()) == (76, 255)
        again = studio.page()
        for name in ("base_color", "roughness"):
            assert (imaged(page, "channel", name) == imaged(again, "channel", name)).all()
        again.close()
        for done in (1, 0):
            page.keyboard.press("Control+z")
            page.wait_for_function("(n) => viewer.painting.status.done === n", arg=done)
        assert page.locator("#paints-roughness").count() == 0
        assert page.locator("#add-channel option[value=roughness]").count() == 1
        assert page.evaluate("isSame && viewer.parts[0].channel('roughness') === undefined")


@pytest.mark.parametrize("is_posed", [False, True])
def test_relief_in_the_page_is_as_in_the_librarys_images(is_posed, opens, tmp_path):
    size, relief = (240, 180), 0.05
    waves = {
        "base_color": lambda p: np.full_like(p, 0.5),
        "occlusion": lambda p: 0.5 + 0.4 * np.sin(9 * p[:, :1]) * np.sin(7 * p[:, 1:2] + 5 * p[:, 2:]),
        "roughness": 0.5,
    }
    surface = ball(48)
    if is_posed:
        turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
        surface = surface.with_rest(surface.vertices @ (turn * np.linalg.det(turn)).T)
    surface = surface.with_sources(waves)
    texture = octex.convert(surface, depth=7)
    channels = dict(texture.channels)
    _, *parts = channels.pop("occlusion")
    channels["height"] = Channel(ChannelFormat("height", 1, "data"), *parts)
    texture = texture.with_cells(texture.tree, channels)
    write_page(texture, tmp_path / "page.html", surface)
    page = opens(tmp_path / "page.html", (912, 480))
    assert page.is_visible("#relief")
    assert page.evaluate("Boolean(viewer.parts[0].header.mesh.posed)") == is_posed
    seen = Probe(page, texture, size).seen.reshape(size[1], size[0])[::-1]
    found, flat = (drawn(page, size, relief=own).astype(int) for own in (relief, 0.0))
    bump = ("height", relief * texture.placement.size)
    images = []
    for own in (bump, None):
        look = texture_shader(texture, materials=True, bump=own)
        light = render_surface(surface, camera_of(page, size), look, 1, Environment.studio())
        images.append(encode(light, "uint8", "srgb").astype(int))
    rises, expected = (found - flat)[seen], (images[0] - images[1])[seen]
    assert np.sqrt((expected**2).mean()) > 6
    assert np.corrcoef(rises.ravel(), expected.ravel())[0, 1] > 0.95
    assert np.sqrt(((rises - expected) ** 2).mean()) < 2


def test_a_posed_page_is_lit_by_the_surfaces_own_normals_as_the_librarys_images_are(opens, tmp_path):
    size, base = (240, 180), ball(48)
    normals = base.vertices + 0.3 * np.sin(4 * base.vertices[:, [1, 2, 0]])
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    turned = base.vertices @ (turn * np.linalg.det(turn)).T
    images, lit = [], []
    for number, own in enumerate((normals, None)):
        still = octex.Surface.from_arrays(base.vertices, base.triangles, normals=own)
        still = still.with_sources({"base_color": lambda p: np.full_like(p, 0.5), "roughness": 0.5})
        posed, texture = still.with_pose(turned), octex.convert(still, depth=5)
        path = tmp_path / f"{number}.html"
        write_page(texture, path, posed)
        page = opens(path, (912, 480))
        assert page.evaluate("Boolean(viewer.parts[0].header.mesh.posed)")
        seen = Probe(page, texture, size).seen.reshape(size[1], size[0])[::-1]
        lit.append(drawn(page, size).astype(int)[seen])
        light = render_surface(
            posed, camera_of(page, size), texture_shader(texture, materials=True), 1, Environment.studio()
        )
        images.append(encode(light, "uint8", "srgb").astype(int)[seen])
    assert np.sqrt(((images[0] - images[1]) ** 2).mean()) > 6
    for found, expected in zip(lit, images, strict=True):
        assert np.sqrt(((found - expected) ** 2).mean()) < 2


#: Counts the textures of the program that shows all that there can be, of the most channels.
_TEXTURES = """() => {
  const { gpu, parts: [part], display } = viewer, { gl } = gpu, channels = [];
  const names = { base_color: 3, emissive: 3, specular: 3, normal: 3 };
  for (const name of ["metallic", "roughness", "occlusion", "height", "alpha"]) names[name] = 1;
  for (const [name, components] of Object.entries(names)) {
    channels.push({ name, components, space: "data", range: [0, 1], at: [channels.length, 0] });
  }
  const header = { ...part.header, channels, planes: channels.map((_, n) => n < 3), flags: [8, 3] };
  Object.assign(header, { isMixed: true, kept: 1, split: [1, 2] });
  const full = Object.create(part, { header: { value: header }, source: { value: {} } });
  const programs = Object.create(gpu.programs, { parts: { value: [full] } });
  const all = { ...display, mode: "lit", relief: 0.1, divider: 0.5, isTranslucent: true, facing: true };
  const { handle } = programs.use("surface", full, all, 9), kinds = [gl.UNSIGNED_INT_SAMPLER_2D];
  kinds.push(gl.SAMPLER_2D, gl.SAMPLER_2D_ARRAY);
  const count = gl.getProgramParameter(handle, gl.ACTIVE_UNIFORMS);
  const uniforms = Array.from({ length: count }, (_, n) => gl.getActiveUniform(handle, n));
  return uniforms.filter(({ type }) => kinds.includes(type)).map(({ name }) => name);
}"""


def test_no_program_has_more_textures_than_webgl_promises(page):
    names = page.evaluate(_TEXTURES)
    known = {"u_srgb", "u_linear", "u_source", "u_heights", "u_background", "u_studio", "u_strokes"}
    assert known < set(names)
    assert len(names) <= 16


#: How many pixels of the image differ from one that is drawn anew, and how many of that one show the model.
_UNLIKE = """() => {
  const { gpu, canvas: { width, height }, display, camera } = viewer, { gl } = gpu;
  const read = () => {
    const codes = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, gpu.targets.image.buffer);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, codes);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return new Uint32Array(codes.buffer);
  };
  const before = read();
  gpu.draw(display, camera, width, height);
  const now = read();
  return [before.filter((code, n) => code !== now[n]).length, now.filter((code) => code !== now[0]).length];
}"""


def test_only_what_is_near_a_change_is_drawn_anew(browser, tmp_path):
    studio, random = Studio(browser, tmp_path, depth=8), np.random.default_rng(0)
    with studio.opened() as page:
        near = 0
        page.set_viewport_size({"width": 760, "height": 280})
        page.evaluate("viewer.maxScale = 0.5")
        for view in ("orbit(0.3, 0.2)", "zoom(0.2)", "zoom(9.0)", "orbit(0.9, 0.1)"):
            page.evaluate(f"viewer.camera.{view}; viewer.invalidate()")
            sharp(page)
            for step in range(3):
                size = int(random.integers(3, 20))
                page.evaluate("(size) => viewer.painting.set({ size })", size)
                looked_up, images = page.evaluate("[viewer.lookupKey, viewer.imageCount]")
                x, y = random.integers(-15, 15, 2).tolist()
                if step < 2:
                    studio.drag(page, (x, y), (x + 6, y + 4))
                else:
                    page.keyboard.press("Control+z")
                studio.is_done(page)
                page.wait_for_function("!viewer.changedRegion && viewer.isSharp")
                unlike, shown = page.evaluate(_UNLIKE)
                assert unlike == 0
                assert shown > 100
                is_small = all(change.tiles is not None for change in studio.session.shown.changes)
                if is_small and looked_up == page.evaluate("viewer.lookupKey"):
                    assert page.evaluate("viewer.imageCount") == images
                    near += 1
        assert near >= 6
