"""Benchmarks of the page: its frames, and what the server takes from a stroke to its change."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from inputs import painted_torus
from measuring import Setup, Spent, line, note, title

import octex
from octex.viewer import write_page
from tests.make.browser import driven, file_url, opened, started
from tests.make.paint_server import PaintServer, disc

_TOWARD = (0.0, 0.9, 0.35)
_VIEW = 1200, 800
#: Cells in the width of a pixel: paint of the texture's depth, and of one more.
_WIDTHS = {"": 1.1, ", one finer": 0.8}
#: Milliseconds of frames of 640 × 480 of what is shown.
_FRAMES = """([shown, count]) => {
  const { gpu, display, camera } = viewer, times = [];
  display.mode = shown;
  for (let n = 0; n <= count; n++) {
    const begin = performance.now();
    gpu.draw(display, camera, 640, 480);
    gpu.finish();
    times.push(performance.now() - begin);
  }
  return times.slice(1);
}"""


def session(setup: Setup) -> None:
    """Strokes sent to octex view, until their changes are read; a texture, and a seventh of it."""
    around, across, depth, sizes = (24, 12, 6, (8,)) if setup.quick else (103, 52, 10, (32, 128, 512))
    surface = painted_torus(around, across, 256)
    textures = [octex.convert(surface, depth)]
    if not setup.quick:
        textures.append(octex.crop(textures[0], (0.3, 0.75, -1.0), (0.75, 2.0, 2.0)))
    cell = textures[0].placement.size / 2**depth
    for texture in textures:
        title(f"session: strokes on {texture.tree.n_leaves:,} leaves, from sending to the change")
        folder = setup.folder / f"{texture.tree.n_leaves}"
        folder.mkdir()
        texture.save(folder / "a.octex")
        octex.write_model(surface, folder / "a.glb")
        server = PaintServer(folder / "a.octex", folder / "a.glb", folder / "out.octex")
        server.wait(0)
        time.sleep(1.0)  # until all is compiled
        kinds = list(product(_WIDTHS, sizes))
        strokes = [(_WIDTHS[finer] * cell, size) for finer, size in kinds for _ in range(setup.repeats)]
        first, *times = _strokes(server, surface, [strokes[0], *strokes])
        server.end()
        line("the first stroke", first)
        for (finer, size), own in zip(kinds, zip(*[iter(times)] * setup.repeats, strict=True), strict=True):
            spent = Spent(median(t.cpu for t in own), median(t.wall for t in own))
            line(f"a stroke of {size}² pixels{finer}", spent)


def _strokes(
    server: PaintServer, surface: octex.Surface, strokes: list[tuple[float, int]]
) -> Iterator[Spent]:
    """Send discs, by the width of a pixel and the pixels across; yield what each takes."""
    toward = np.array(_TOWARD) / np.linalg.norm(_TOWARD)
    middle = surface.vertices[np.argmax(surface.vertices @ toward)]
    for number, (width, size) in enumerate(strokes, 1):
        corners = middle + 0.5 * width * _VIEW[0] * np.array([[-1, 0, 0], [1, 0, 0]])
        camera = octex.Camera.fitted(corners, _TOWARD, size=_VIEW, margin=0.0)
        place = camera.project(middle[None])[0][0] + 3.0 * (number % 5)
        body = disc(number, camera, place, size / 2, [200, 10 * number % 256, 30])
        cpu, wall = _cpu_of(server), time.perf_counter()
        assert server.send(body)
        server.wait(number)
        wall = time.perf_counter() - wall
        time.sleep(0.3)  # until it has put the stroke away
        yield Spent(_cpu_of(server) - cpu, wall)
    assert server.told["done"] == len(strokes), "a stroke has hit nothing"


def _cpu_of(server: PaintServer) -> float:
    words = Path(f"/proc/{server.process.pid}/stat").read_text("utf-8").rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def frames(setup: Setup) -> None:
    """Frames of the page in Chromium: of a texture, and of one with cells of several sizes."""
    _, path, depth = next(setup.models())
    surface = octex.load_surface(path)
    title(f"frames: the droid at depth {depth}, 640 × 480, without a GPU")
    try:
        with driven() as driver, started(driver) as browser:
            kinds = {"even": None, "max_error=3": 3}
            for kind, error in list(kinds.items())[: 1 if setup.quick else 2]:
                written = setup.folder / f"{kind}.html"
                write_page(octex.convert(surface, depth, max_error=error), written, surface)
                page = opened(browser, file_url(written))
                for shown in ("unlit", "lit"):
                    times = page.evaluate(_FRAMES, [shown, setup.repeats])
                    line(f"{kind}, {shown}", f"{median(times):.1f} ms")
                page.close()
    except pytest.skip.Exception as why:
        note(f"frames: left out without a browser: {why}")
