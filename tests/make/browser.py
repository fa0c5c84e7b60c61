"""A real browser for tests, driven by playwright: whatever Chromium or Firefox is installed."""

from __future__ import annotations

import base64
import math
import os
import re
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np
import numpy.typing as npt
import pytest

import octex
from octex.texture import OctreeTexture
from octex.viewer import Viewer

Floats = npt.NDArray[np.float32]

_PROGRAMS = {
    "chromium": ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable"),
    "firefox": ("firefox-esr", "firefox"),
}
#: Pages of a site share a process, and Chromium puts pages together itself: a page then takes half the time.
_OPTIONS = ["--headless=new", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
_OPTIONS += ["--disable-gpu-compositing", "--process-per-site"]
#: Returns what ``Gpu.probe`` finds as base64.
_PROBE = """([look, asked]) => {
  const found = viewer.gpu.probe({ ...viewer.display, ...look }, viewer.camera, asked);
  const text = (array) => {
    const bytes = new Uint8Array(array.buffer);
    let made = "";
    for (let n = 0; n < bytes.length; n += 4096) made += String.fromCharCode(...bytes.subarray(n, n + 4096));
    return btoa(made);
  };
  return [text(found.positions), text(found.values), text(found.normals)];
}"""
#: Returns the normals that pixels are lit by, in view space, as codes of an unfolded octahedron.
_NORMALS = """([look, [width, height]]) => {
  const { gpu, camera } = viewer, { gl } = gpu;
  const target = gpu.target("lit", width, height, [gl.RGBA32UI, gl.RGBA32UI]);
  const bits = new Uint32Array(4 * width * height);
  gpu.drawGBuffer({ ...viewer.display, ...look }, camera, target, width, height);
  gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
  gl.readBuffer(gl.COLOR_ATTACHMENT1);
  gl.readPixels(0, 0, width, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, bits);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  return Array.from(bits.filter((_, n) => n % 4 === 0));
}"""


#: Draws an image and returns its codes, the lowest row first, as base64.
_DRAWN = """([look, [width, height]]) => {
  const { gpu, camera } = viewer, { gl } = gpu, codes = new Uint8Array(4 * width * height);
  gpu.draw({ ...viewer.display, ...look }, camera, width, height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, codes);
  let text = "";
  for (const code of codes) text += String.fromCharCode(code);
  return btoa(text);
}"""


#: Has the page's viewer differ in something from the beginning.
_CHANGED = """Object.defineProperty(globalThis, "viewer", {
  configurable: true,
  set(value) {
    Object.defineProperty(globalThis, "viewer", { value: Object.assign(value, %s) });
  },
})"""
#: Returns the arrays in which the page's octree differs from one that is loaded anew.
UNLIKE = """async () => {
  const { Octree } = await import("./octree.js");
  const header = await (await fetch("data/header")).json(), [part] = header.parts, anew = new Octree(part);
  const held = viewer.parts[0].octree;
  const names = ["words", "planes", "entries", "owners", "cells", "nodes", "tables", "depth"];
  for (const [n, chunk] of part.chunks.entries()) {
    const packed = (await fetch(`data/${header.version}/0-levels-${n}`)).body;
    const unpacked = packed.pipeThrough(new DecompressionStream("deflate-raw"));
    const bytes = new Uint8Array(await new Response(unpacked).arrayBuffer());
    anew.readChunk(chunk, bytes);
  }
  const isLike = (a, b) => {
    if (ArrayBuffer.isView(a)) return a.length === b.length && a.every((each, n) => each === b[n]);
    const isSame = (x, y) => (y instanceof Object ? isLike(x, y) : x === y);
    return Object.keys(b).every((key) => isSame(a[key], b[key]));
  };
  return names.filter((name) => !isLike([held[name]], [anew[name]]));
}"""


@contextmanager
def driven() -> Iterator[Any]:
    """Start playwright, which drives browsers: one at a time in a process."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser: pip install it")
    with api.sync_playwright() as driver:
        yield driver


@contextmanager
def started(driver: Any, *more: str) -> Iterator[Any]:
    """Start the browser that OCTEX_TEST_BROWSER names, by default chromium; skip where there is none.

    ``more`` are options of chromium.

    Firefox is driven by WebDriver BiDi. Without a GPU it has WebGL2 on a screen only (Xvfb).
    """
    name = os.environ.get("OCTEX_TEST_BROWSER", "chromium")
    kind = getattr(driver, name)
    program = next(filter(None, map(shutil.which, _PROGRAMS[name])), kind.executable_path)
    if not Path(program).exists():
        pytest.skip(f"there is no browser: none of {', '.join(_PROGRAMS[name])}, and none of playwright")
    options: dict[str, Any] = {"args": [*_OPTIONS, *more]}
    if name == "firefox":
        options = {"channel": "moz-firefox", "headless": "DISPLAY" not in os.environ}
        options["firefox_user_prefs"] = {"webgl.force-enabled": True}
    browser = kind.launch(executable_path=program, **options)
    browser.shared = browser.new_context(bypass_csp=True)
    yield browser
    browser.close()


@contextmanager
def served(viewer: Viewer) -> Iterator[Viewer]:
    """Serve a page while the block lasts, and until it is closed."""
    thread = threading.Thread(target=viewer.run, kwargs={"alone": 1.0})
    thread.start()
    yield viewer
    until = time.monotonic() + 30.0
    while thread.is_alive() and time.monotonic() < until:
        if not viewer._pages:
            viewer._closed_at = -math.inf  # no other page comes
        thread.join(0.05)
    assert not thread.is_alive()


def _is_fault(line: Any) -> bool:
    return line.type == "error" or "GL_INVALID" in line.text


def opened(
    browser: Any,
    url: str,
    size: tuple[int, int] = (1280, 720),
    bypass_csp: bool = True,
    finest: float = 0.1,
    is_drawn: bool = True,
    **options: bool,
) -> Any:
    """Open a page and wait until all has come; what it complains of fails the test at `complaints`.

    ``finest`` is how many pixels it draws a pixel along both axes: without a GPU, an image costs seconds, as
    does compiling for it. A page that is not drawn has no image.
    ``options`` are playwright's for new pages; pages without any share what a browser remembers.
    """
    viewport = {"width": size[0], "height": size[1]}
    if bypass_csp and not options:
        page = browser.shared.new_page()
        page.set_viewport_size(viewport)
    else:
        page = browser.new_page(viewport=viewport, bypass_csp=bypass_csp, **options)
    page.set_default_timeout(60_000)
    page.complaints = []
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    page.on("console", lambda line: _is_fault(line) and page.complaints.append(line.text))
    page.add_init_script(_CHANGED % f"{{ maxScale: {finest}{'' if is_drawn else ', frame() {}'} }}")
    if bypass_csp and browser.browser_type.name == "firefox":
        url = _without_policy(page, url)
    page.goto(url)
    if bypass_csp:
        done = "viewer.isLoaded && viewer.imageCount > 0" if is_drawn else "viewer.isLoaded"
        done += " || !document.getElementById('message').hidden"
        page.wait_for_function(f"globalThis.viewer && ({done})")
    return page


def _without_policy(page: Any, url: str) -> str:
    """Take its policy off a page, as asking it takes eval and BiDi cannot pass it by; return where it is."""
    if url.startswith("file:"):
        path = Path(url2pathname(urlsplit(url).path))
        text = re.sub("<meta http-equiv=.Content-Security-Policy.[^>]*>", "", path.read_text("utf-8"))
        path.with_name(f"free-{path.name}").write_text(text, "utf-8")
        return file_url(path.with_name(f"free-{path.name}"))

    def answer(route: Any) -> None:
        found = route.fetch()
        kept = {name: text for name, text in found.headers.items() if name != "content-security-policy"}
        route.fulfill(response=found, headers=kept)

    page.route(url, answer)
    return url


class Probe:
    """What pixels see of a part: points at rest (n, 3), footprints' widths, normals, and values."""

    def __init__(
        self, page: Any, texture: OctreeTexture, size: tuple[int, int], part: int = 0, **look: Any
    ) -> None:
        self._page, self._size, self._look = page, size, look
        self._footprint = look.pop("width", 0.0)
        look["footprints"] = bool(self._footprint)
        places, values, normals = self._asked(-1)
        self.seen = (values[:, 3] == 1) & (normals[:, 3] == part)
        self.places = places[self.seen, :3]
        self.points = texture.placement.to_rest(self.places.astype(np.float64))
        widths = places[self.seen, 3] if self._footprint < 0 else np.full(len(self.points), self._footprint)
        self.widths = widths.astype(np.float32).astype(np.float64) * texture.placement.size
        self.normals = normals[self.seen, :3]
        self.alpha, self.fetches = values[self.seen, 0], values[self.seen, 1]

    def _asked(self, plane: int) -> list[Floats]:
        asked = {
            "width": self._size[0], "height": self._size[1], "plane": plane, "footprint": self._footprint,
        }  # fmt: skip
        found = self._page.evaluate(_PROBE, [self._look, asked])
        return [np.frombuffer(base64.b64decode(text), np.float32).reshape(-1, 4) for text in found]

    def plane(self, number: int) -> Floats:
        """What is looked up of a plane's four components."""
        return self._asked(number)[1][self.seen]


def drawn(page: Any, size: tuple[int, int], **look: Any) -> npt.NDArray[np.uint8]:
    """Return an image that a page draws, sRGB codes (height, width, 3); ``look`` changes what is shown."""
    text = page.evaluate(_DRAWN, [look, size])
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(size[1], size[0], 4)[::-1, :, :3]


def lit_normals(page: Any, size: tuple[int, int], **look: Any) -> Floats:
    """Return the unit vectors in view space that pixels (n, 3) are lit by, the lowest row first."""
    codes = np.array(page.evaluate(_NORMALS, [look, size]), np.uint32).view(np.int16).reshape(-1, 2)
    flat = np.maximum(codes / 32767, -1.0)
    up = 1 - np.abs(flat).sum(axis=1)
    folded = (1 - np.abs(flat[:, ::-1])) * np.where(flat < 0, -1, 1)
    ways = np.column_stack([np.where(up[:, None] < 0, folded, flat), up])
    return np.asarray(ways / np.linalg.norm(ways, axis=1, keepdims=True), np.float32)


def sharp(page: Any) -> None:
    """Wait for the sharp image."""
    page.wait_for_function("viewer.isSharp && !viewer.frameRequest")


def sharp_image(page: Any) -> bytes:
    """Return a screenshot of the image that a page draws now, once it is sharp."""
    page.evaluate("viewer.invalidate()")
    sharp(page)
    return bytes(page.locator("canvas").screenshot())


def file_url(path: Path) -> str:
    return path.resolve().as_uri()


def lose_gpu(page: Any) -> None:
    """Take a page's GPU away."""
    page.evaluate("globalThis.lose = viewer.gpu.gl.getExtension('WEBGL_lose_context'); lose.loseContext()")
    page.wait_for_function("viewer.isContextLost")


def restore_gpu(page: Any) -> None:
    """Give it back, and wait for an image."""
    page.evaluate("lose.restoreContext()")
    page.wait_for_function("!viewer.isContextLost && viewer.isSharp")


def camera_of(page: Any, size: tuple[int, int]) -> octex.Camera:
    """Return the page's camera for images of a size, as its file says."""
    file = page.evaluate("(size) => JSON.stringify(viewer.camera.file('page.png', ...size))", size)
    with TemporaryDirectory() as folder:
        (Path(folder) / "camera.json").write_text(file)
        (frame,) = octex.read_cameras(Path(folder) / "camera.json")
    assert (frame.name, frame.size) == ("page.png", tuple(size))
    return frame.camera()


def differences(
    probe: Probe, texture: OctreeTexture, header: dict[str, Any], filter: str, width: float, facing: bool
) -> dict[str, Floats]:
    """Return by how much of 255 pixels (n,) differ from lookups where they see the surface, by channel.

    Left out are those of ``nearest`` that are within 10⁻⁶ of a cell's face.
    """
    options: dict[str, Any] = {"width": probe.widths} if width else {}
    if facing:
        options["normals"] = probe.normals
    elif width:
        options["bleed_threshold"] = 10.0
    expected = texture.sample(probe.points, list(texture.channels), filter, normalize=False, **options)
    cell = 2.0**-texture.tree.max_depth
    is_inner = np.abs(probe.places / cell - np.rint(probe.places / cell)).min(axis=1) > 1e-6 / cell
    found = {}
    for channel in header["channels"]:
        plane, slot = channel["at"]
        values = probe.alpha[:, None]
        if channel["name"] != "alpha":
            values = probe.plane(plane)[:, slot : slot + channel["components"]]
        if channel["space"] == "direction":
            values = 2 * values - 1
        away = 255 * np.abs(values - expected[channel["name"]]).max(axis=1)
        if "alpha" in expected and channel["name"] != "alpha":  # what is seen is multiplied by it
            away *= expected["alpha"][:, 0]
        found[channel["name"]] = away[is_inner] if filter == "nearest" else away
    return found
