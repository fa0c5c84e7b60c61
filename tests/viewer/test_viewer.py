"""What a browser shows: each pixel as lookups have it; the page, its tools, and pages of one file."""

import re
import subprocess
import sys
from itertools import product
from urllib.parse import urlsplit

import numpy as np
import pytest

import octex
from octex.channels import decode
from octex.errors import ArgumentError
from octex.formats.web import prepared
from octex.texture import OctreeTexture
from octex.viewer import write_page
from octex.viewer.export import MODULES, page_text
from octex.viewer.pack import pack
from tests.make.browser import (
    Probe,
    differences,
    drawn,
    file_url,
    lose_gpu,
    opened,
    restore_gpu,
    sharp_image,
)
from tests.make.fixtures import obj_lines
from tests.make.painted import ball, balls
from tests.make.small_surfaces import sheet
from tests.make.small_textures import shell

SIZE = 48, 36


def colored(surface, **sources):
    """A surface of colours that vary much within a cell, and of other channels."""
    low, high = surface.bounds
    waves = lambda p: 0.5 + 0.5 * np.sin(40 * (p - low) / (high - low).max() * [1.0, 1.3, 0.7])  # noqa: E731
    return surface.with_sources({"base_color": waves, "roughness": lambda p: waves(p)[:, :1], **sources})


def even():
    surface = colored(ball())
    return octex.convert(surface, depth=6), surface


def adaptive():
    def spots(p):
        return 0.5 + 0.4 * np.sign(np.sin(30 * p[:, :1])) * (p[:, 1:2] > 0.2) * [1.0, 0.5, -1.0]

    surface = ball().with_sources({"base_color": spots})
    return octex.convert(surface, depth=6, max_error=3), surface


def painted():
    """Finer in the middle of a thin sheet: nodes there are split, and keep what they were."""
    surface = sheet(np.eye(3), 0.01)
    texture = octex.convert(surface, depth=4)
    low, high = surface.bounds
    middle = octex.Sphere((low + high) / 2, 0.25 * float((high - low).max()))
    red = octex.fill(texture, surface, middle, (1.0, 0.1, 0.0), max_depth=6)
    assert np.isin(red.tree.kept.cells, red.tree.split.cells).any()
    return red, surface


def thin():
    surface = sheet(np.eye(3), 0.01)
    return octex.convert(surface, depth=5), surface


def floating():
    """Alpha; light up to 3, data from −2 on and 16-bit colours."""
    surface = colored(
        ball(),
        alpha=lambda p: np.clip(0.6 + p[:, :1], 0.0, 1.0),
        emissive=lambda p: 1.5 + 1.5 * np.sin(9 * p),
    )
    texture = octex.convert(
        surface, depth=5, dtype={"base_color": "uint16", "emissive": "float16", "roughness": "float32"}
    )
    data = texture.channels["roughness"]
    wide = data._replace(values=5 * data.values - 2, split_values=5 * data.split_values - 2)
    channels = {**texture.channels, "roughness": wide}
    return OctreeTexture(texture.tree, channels, texture.placement, texture.bounds, texture.metadata), surface


MADE = {each.__name__: each for each in (even, adaptive, painted, thin, floating)}


@pytest.mark.parametrize("name", MADE)
def test_each_pixel_is_what_a_lookup_there_gives(name, opens, tmp_path):
    assert_shown(*MADE[name](), opens, tmp_path)


@pytest.mark.parametrize("name", ["BoomBoxWithAxes.gltf", "Avocado.gltf", "Suzanne.gltf", "spot.obj"])
def test_each_pixel_of_a_real_model_is_what_a_lookup_there_gives(name, models, opens, tmp_path):
    path = next(models.rglob(name), None)
    if path is None:
        pytest.skip(f"there is no {name}")
    surface = octex.load_surface(path)
    whole, merged = (octex.convert(surface, depth=8, max_error=most) for most in (None, 3))
    ball = octex.Sphere(surface.scatter(1, seed=1).rest[0], 0.2 * np.ptp(surface.bounds, axis=0).max())
    for texture in (whole, merged, octex.fill(whole, surface, ball, (1.0, 0.1, 0.0), max_depth=9)):
        assert_shown(texture, surface.placed_in(texture), opens, tmp_path)


def assert_shown(texture, surface, opens, folder):
    """A page shows what lookups give; also as cubes without complaint."""
    write_page(texture, folder / "page.html", surface)
    page = opens(folder / "page.html", (760, 300))
    assert page.complaints == []
    parity(page, texture, surface)
    page.check("#cubes")
    sharp_image(page)


def parity(page, texture, surface):
    """Compare all channels, filters, widths, levels and sides."""
    header = pack(texture, surface).header
    texture = prepared(texture).texture  # of 8 bits, 0 to 1
    is_split = texture.tree.split.cells.size > 1
    deepest = texture.tree.max_depth
    looks = [("quadratic", 0.0, deepest), ("quadratic", -1.0, deepest), ("quadratic", 0.2, 3)]
    looks += [("nearest", -1.0, deepest)]
    looks += [("linear", 0.0, deepest)]
    if not header["isMixed"]:  # which takes long without a GPU
        looks += [("quadratic", 0.03, deepest), ("quadratic", 0.0, 3), ("nearest", 0.0, deepest)]
        looks += [("linear", -1.0, deepest), ("quadratic", 1.1, deepest), ("linear", 4.0, deepest)]
    for facing, (filter, width, level) in product({False, is_split}, looks):
        probe = Probe(page, texture, SIZE, filter=filter, width=width, facing=facing, level=level)
        case = f"{filter}, width {width}, facing {facing}, level {level}"
        compared(probe, texture.level(level), header, filter, width, facing, case)


def compared(probe, texture, header, filter, width, facing, case):
    assert probe.seen.sum() > 100
    worst = 0.0
    for name, away in differences(probe, texture, header, filter, width, facing).items():
        assert away.max() <= 2.0, f"{name}, {case}: {away.max()}"
        assert (away > 1.0).mean() <= 0.001, f"{name}, {case}: {(away > 1.0).mean()}"
        worst = max(worst, float(away.max()))
    return worst


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A page of a small ball."""
    path = tmp_path_factory.mktemp("page") / "ball.html"
    surface = colored(ball(8))
    write_page(octex.convert(surface, depth=4), path, surface, title="ball.octex")
    return path


@pytest.fixture(scope="module")
def shared(browser, small):
    page = opened(browser, file_url(small), (900, 480), finest=0.25)
    yield page
    assert page.complaints == []
    page.close()


@pytest.fixture
def page(shared):
    """The page of the small ball, as it looks at first."""
    shared.evaluate("viewer.camera.reset(0.55, 0.3)")
    yield shared
    shared.set_viewport_size({"width": 900, "height": 480})
    for name, value in (("mode", "lit"), ("filter", "quadratic")):
        shared.select_option(f"#{name}", value)
    shared.uncheck("#cubes")
    shared.locator("#level").fill("4")


def test_each_control_changes_the_image_and_the_first_view_comes_back(page):
    canvas = page.locator("canvas")
    canvas.focus()
    page.keyboard.press("0")
    before = sharp_image(page)
    for keys in (["ArrowLeft"], ["ArrowUp"], ["+"], ["-", "-"], ["Shift+ArrowLeft"], ["1"]):
        for key in keys:
            page.keyboard.press(key)
        assert sharp_image(page) != before
    page.evaluate("viewer.camera.reset(0.55, 0.3)")
    page.keyboard.press("0")
    assert sharp_image(page) == before
    box = canvas.bounding_box()
    page.evaluate(
        "(draw => viewer.invalidate = held => { globalThis.held = held; draw(held); })"
        "(viewer.invalidate.bind(viewer))"
    )
    for button in ("left", "right"):
        page.mouse.move(box["x"] + 100, box["y"] + 100)
        page.mouse.down(button=button)
        page.mouse.move(box["x"] + 140, box["y"] + 120)
        assert page.evaluate("held") is True  # sharp images wait longer
        page.mouse.up(button=button)
        assert sharp_image(page) != before
        page.evaluate("viewer.camera.reset(0.55, 0.3)")
    page.mouse.wheel(0, -300)
    assert sharp_image(page) != before
    page.evaluate("viewer.camera.reset(0.55, 0.3); viewer.invalidate()")
    images = {sharp_image(page)}
    for value in ("unlit", "channel base_color", "channel roughness", "depth", "facing"):
        page.select_option("#mode", value)
        images.add(sharp_image(page))
    page.select_option("#mode", "unlit")
    page.select_option("#filter", "nearest")
    images.add(sharp_image(page))
    page.locator("#level").fill("2")
    images.add(sharp_image(page))
    page.check("#cubes")
    images.add(sharp_image(page))
    assert len(images) == 8  # without emitted light, colours as they are are the channel


def test_under_the_cursor_is_the_cell_that_a_lookup_finds(page):
    texture = octex.convert(colored(ball(8)), depth=4)
    size = page.evaluate("[viewer.canvas.clientWidth, viewer.canvas.clientHeight]")
    found = page.evaluate("viewer.pick(viewer.canvas.clientWidth / 2, viewer.canvas.clientHeight / 2 - 30)")
    assert found["level"] == 4
    assert page.evaluate("viewer.pick(1, 1)") is None
    rest = np.array([found["rest"]])
    assert texture.contains(rest).all()
    index = np.floor(texture.placement.to_texture_space(rest)[0] * 16)
    np.testing.assert_array_equal(found["index"], index)
    base = next(each for each in found["channels"] if each["name"] == "base_color")
    np.testing.assert_array_equal(base["codes"], texture.channels["base_color"].values[found["cell"]])
    page.mouse.move(size[0] / 2, size[1] / 2 - 30)
    page.wait_for_function("document.getElementById('cell').textContent.includes('level 4')")
    page.check("#cubes")
    page.locator("#level").fill("3")
    cube = page.evaluate("viewer.pick(viewer.canvas.clientWidth / 2, viewer.canvas.clientHeight / 2 - 30)")
    above = texture.level(3)
    index = np.floor(texture.placement.to_texture_space(np.array([cube["rest"]]))[0] * 8)
    np.testing.assert_array_equal(cube["index"], index)
    np.testing.assert_allclose(np.array(cube["point"]), (index + 0.5) / 8)
    base = next(each for each in cube["channels"] if each["name"] == "base_color")
    np.testing.assert_array_equal(base["codes"], above.channels["base_color"].values[cube["cell"]])
    stored = above.sample([cube["rest"]], filter="nearest")[0]
    np.testing.assert_allclose(decode(np.array(base["codes"], np.uint8), "srgb"), stored, atol=1e-6)
    assert page.evaluate("viewer.pick(1, 1)") is None
    page.locator("canvas").focus()
    page.keyboard.press("p")
    page.wait_for_function("document.getElementById('cell').textContent.includes('level 3')")


def test_images_are_drawn_up_to_their_rims(page):
    """What is seen is drawn in tiles, and the last ones reach beyond the image."""
    page.evaluate("viewer.camera.distance *= 0.33")  # the ball fills the image
    background = np.rint(255 * np.array(page.evaluate("viewer.gpu.background"))[:3])
    for size in ((37, 21), (16, 33), (5, 3), (1, 1)):
        image = drawn(page, size, mode="unlit")
        assert (np.abs(image - background).max(axis=2) > 2).all(), size


def test_the_file_loads_nothing_and_obeys_its_own_policy(browser, small):
    asked = []
    page = browser.new_page()
    page.on("request", lambda request: asked.append(request.url))
    complaints = []
    page.on("console", lambda line: line.type == "error" and complaints.append(line.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(file_url(small))
    page.wait_for_selector("#progress-box", state="hidden", timeout=60_000)
    assert page.locator("h1").inner_text() == "ball.octex"
    assert [url for url in asked if not url.startswith(("file:", "blob:", "data:"))] == []
    assert complaints == []
    page.close()


def test_a_lost_context_is_restored(page):
    before = sharp_image(page)
    lose_gpu(page)
    assert "lost" in page.locator("#status").inner_text()
    restore_gpu(page)
    assert page.locator("#status").inner_text() == ""
    assert sharp_image(page) == before


def test_without_webgl2_the_page_says_so(browser, small):
    page = browser.new_page(bypass_csp=True)
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(file_url(small))
    page.wait_for_selector("#message", state="visible")
    assert "this browser has no WebGL2" in page.locator("#message").inner_text()
    page.close()


def test_controls_are_named_and_within_the_window(opens, small):
    page = opens(small, (1280, 720), is_drawn=False)
    unnamed = """[...document.querySelectorAll("select, input, button, progress, canvas")]
      .filter((each) => !(each.labels?.length || each.ariaLabel || each.textContent.trim()))
      .map((each) => each.id)"""
    gap = "help.getBoundingClientRect().top - save.getBoundingClientRect().bottom"
    for width, height in ((1280, 720), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), width
        assert page.evaluate("viewer.canvas.clientHeight") >= height * 0.4, width
        assert page.evaluate(unnamed) == [], width
        assert page.evaluate(gap) < 40, width  # between them is the cell under the pointer: none yet


def test_a_page_goes_on_with_the_next_server_of_its_file_and_with_no_other(opens, tmp_path, request):
    surface, path, other = colored(ball(8)), tmp_path / "ball.octex", tmp_path / "other.octex"
    octex.convert(surface, depth=5).save(path)
    octex.convert(surface, depth=1).save(other)

    def served(*words):
        code = "import sys; from octex.cli.main import main; sys.exit(main(['view', *sys.argv[1:]]))"
        call = [sys.executable, "-c", code, *map(str, words), "--no-browser", "--quiet"]
        server = subprocess.Popen(call, stdout=subprocess.PIPE, text=True)
        request.addfinalizer(lambda: ended(server))
        assert server.stdout is not None
        return server, server.stdout.readline().strip()

    def ended(server):
        with server:
            server.kill()

    def until_said(text):
        said = f"document.getElementById('status').textContent.includes({text!r})"
        page.wait_for_function(said)

    def until_depth(depth):
        shown = f"globalThis.viewer?.header?.parts[0].depth === {depth} && viewer.isLoaded"
        page.wait_for_function(shown)

    server, url = served(path)
    page = opens(url, (800, 600), is_drawn=False, is_lost=True)
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.locator("#filter").select_option("nearest")
    page.evaluate("viewer.camera.orbit(1, 0)")
    assert page.locator("#status").inner_text() == ""
    ended(server)
    until_said("Connection lost; next attempt in")
    page.keyboard.press("ArrowLeft")  # what has come is still shown
    turn = page.evaluate("viewer.camera.turn")

    port = str(urlsplit(url).port)
    asked.clear()
    server, _ = served(other, "--port", port)
    until_said("Another program has its port")
    assert asked
    assert all(urlsplit(each).path == "/proof" for each in asked)  # the token is not sent
    ended(server)

    octex.convert(surface, depth=4).save(path)
    server, again = served(path)
    assert again == url
    page.evaluate("window.dispatchEvent(new Event('focus'))")
    until_depth(4)
    assert page.locator("#status").inner_text() == ""
    assert page.locator("#filter").input_value() == "nearest"
    assert page.evaluate("viewer.camera.turn") == pytest.approx(turn)
    ended(server)
    until_said("Connection lost")
    server, _ = served(path)  # nothing has changed
    page.evaluate("window.dispatchEvent(new Event('focus'))")
    page.wait_for_function("document.getElementById('status').textContent === ''")
    until_depth(4)


def test_floats_are_shown_in_the_range_that_they_have():
    texture, surface = floating()
    header = pack(texture, surface).header
    ranges = {each["name"]: each["range"] for each in header["channels"]}
    assert ranges["base_color"] == [0, 1]
    values = texture.channels["emissive"].values, texture.channels["roughness"].values
    assert ranges["emissive"] == [0, values[0].max()]
    assert ranges["roughness"] == [values[1].min(), values[1].max()]
    assert "base color: shown with 8 bits, 0 to 1" in header["notes"]
    assert f"emissive: shown with 8 bits, 0 to {values[0].max():.4g}" in header["notes"]


def test_a_page_of_limited_size_leaves_the_finest_levels_out(tmp_path):
    texture = shell(5, keep=0.0)
    whole = write_page(texture, tmp_path / "whole.html")
    size = (tmp_path / "whole.html").stat().st_size
    assert not any("to fit" in note for note in whole)
    notes = write_page(texture, tmp_path / "cut.html", max_size=size - 1)
    assert notes[0] == f"depth 4 of 5, to fit {size - 1:,} bytes"
    assert (tmp_path / "cut.html").stat().st_size < size
    with pytest.raises(ArgumentError, match=r"the page takes .* kB even without any level; allow [0-9.]+ kB"):
        write_page(texture, tmp_path / "none.html", max_size=100)


def two_parts(folder):
    """Two balls that touch, with channels and depths of their own."""
    both = balls([1.9, 0, 0], 8, 8)
    (folder / "two.obj").write_text(obj_lines(both.vertices, both.triangles))
    surface = octex.load_surface(folder / "two.obj")
    made = {}
    for number in range(2):
        part = surface.part(np.flatnonzero(surface.parts == number))
        waves = part.with_sources({"base_color": lambda p: 0.5 + 0.5 * np.sin(20 * p)})
        made[f"part {number}"] = octex.convert(colored(part) if number else waves, depth=4 + number)
    return octex.TextureSet(made), surface


def test_of_a_set_each_pixel_is_what_a_lookup_in_its_part_gives(opens, tmp_path):
    textures, surface = two_parts(tmp_path)
    write_page(textures, tmp_path / "set.html", surface)
    page = opens(tmp_path / "set.html", (900, 420))
    assert page.locator("#facts").inner_text().startswith("2 parts\n")
    for number, texture in enumerate(textures.values()):
        header = pack(texture, None).header
        probe = Probe(page, texture, SIZE, part=number, filter="quadratic", width=-1.0, facing=False)
        assert compared(probe, texture, header, "quadratic", -1.0, False, f"part {number}") <= 1
    size = page.evaluate("[viewer.canvas.clientWidth, viewer.canvas.clientHeight]")
    page.evaluate("viewer.camera.reset(0, 0)")
    found = [page.evaluate("(at) => viewer.pick(...at)", [x * size[0], size[1] / 2]) for x in (0.3, 0.7)]
    assert [each["name"] for each in found] == list(textures)
    for value in ("channel roughness", "depth", "lit"):
        page.select_option("#mode", value)
        sharp_image(page)
    page.check("#cubes")
    sharp_image(page)
    with pytest.raises(ArgumentError, match=r"two.obj has 2 parts, and the set 1; give the set's model"):
        write_page(octex.TextureSet({"one": textures["part 0"]}), tmp_path / "one.html", surface)
    many = octex.TextureSet({f"{n}": textures["part 0"] for n in range(256)})
    with pytest.raises(ArgumentError, match="a page shows at most 255 parts, not 256; choose one of them"):
        write_page(many, tmp_path / "many.html")
    size = (tmp_path / "set.html").stat().st_size
    notes = write_page(textures, tmp_path / "small.html", surface, max_size=size - 1)
    assert notes[0].startswith("part 0: depth 4 of 5, to fit")


def test_no_two_modules_of_the_page_have_a_name_in_common():
    names = [
        name
        for module in MODULES
        for name in re.findall(
            r"^(?:export )?(?:async )?(?:function|class|const|let) (\w+)", page_text(module), re.M
        )
    ]
    assert len(names) == len(set(names))
    assert len(names) > 20


def test_octex_view_writes_pages_also_of_a_folder_of_parts(made, model, cli, tmp_path):
    page = made.with_name("page.html")
    told = cli.facts("view", made, model, page, "--quiet")
    assert (told["bytes"], told["notes"]) == (page.stat().st_size, [])
    text = page.read_text("utf-8")
    assert all(f'id="data-{name}"' in text for name in ("header", "0-levels-0", "0-mesh"))
    assert not re.search(r"(?:src|href)=.?https?:|^import ", text, re.MULTILINE)
    cli.result("view", made, page, "--force", "--quiet", "--max-size", "500kB")
    assert 'id="data-0-mesh"' not in page.read_text("utf-8")
    textures, _ = two_parts(tmp_path)
    textures.save(tmp_path / "set")
    cli.result("view", tmp_path / "set", tmp_path / "two.obj", tmp_path / "set.html", "--quiet")
    text = (tmp_path / "set.html").read_text("utf-8")
    assert all(f'id="data-{number}-{name}"' in text for number in range(2) for name in ("levels-0", "mesh"))
