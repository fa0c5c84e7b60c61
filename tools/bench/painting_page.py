"""Benchmarks of the page: its frames, and what the server takes from a stroke to its change."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from inputs import painted_torus
from measuring import DROID, HERE, Report, Setup, Spent

import octex
from octex.viewer import write_page

sys.path.append(str(HERE.parents[1]))
from tests.make.browser import driven, file_url, opened, started
from tests.make.paint_server import PaintServer, disc

_TOWARD = (0.0, 0.9, 0.35)
_VIEW = 1200, 800
#: Cells in the width of a pixel: paint of the texture's depth, and of one more.
_WIDTHS = {"": 1.1, ", one finer": 0.8}


def session(setup: Setup, report: Report) -> None:
    """Strokes sent to octex view, until their changes are read; a texture, and a seventh of it."""
    around, across, depth, sizes = (24, 12, 6, (8,)) if setup.quick else (103, 52, 10, (32, 128, 512))
    surface = painted_torus(around, across, 256)
    texture = octex.convert(surface, depth)
    textures = [texture]
    if not setup.quick:
        textures.insert(0, octex.crop(texture, (0.3, 0.75, -1.0), (0.75, 2.0, 2.0)))
    counts = [each.tree.n_leaves for each in textures]
    few, many = counts[0], counts[-1]
    report.title(f"session: strokes on {few:,} and {many:,} leaves, from sending to the change")
    spent: dict[tuple[int, str, int], Spent] = {}
    for leaves, each in zip(counts, textures, strict=True):
        with _served(setup.folder / f"{leaves}", each, surface) as server:
            cell = texture.placement.size / 2**depth
            strokes = [(_WIDTHS[""], sizes[0])]
            strokes += [
                (width, size) for width in _WIDTHS.values() for size in np.repeat(sizes, setup.repeats)
            ]
            first, *times = _strokes(server, surface, cell, strokes)
        report.line(f"the first stroke, {leaves:,} leaves", f"{first.wall:.3f} s")
        for finer, size in product(_WIDTHS, sizes):
            own, times = times[: setup.repeats], times[setup.repeats :]
            spent[leaves, finer, size] = Spent(median(t.cpu for t in own), median(t.wall for t in own))
            report.line(f"a stroke of {size}² pixels{finer}, {leaves:,} leaves", spent[leaves, finer, size])
    report.at_most("session: the first stroke", first.wall, 0.3, "s")
    for size, target in zip(sizes, (0.08, 0.15, 0.5), strict=False):
        report.at_most(f"session: a stroke of {size}² pixels", spent[many, "", size].wall, target, "s")
    for finer, size in product(_WIDTHS, sizes):
        small, large = (spent[leaves, finer, size] for leaves in (few, many))
        growth = large.cpu / max(small.cpu, 0.01)
        report.at_most(f"session: {size}² pixels{finer}, growth with the texture", growth, 1.2, "×")


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


def frames(setup: Setup, report: Report) -> None:
    """Frames of the page in Chromium: of a texture, and of one with cells of several sizes."""
    surface, depth = octex.load_surface(DROID), 6 if setup.quick else 10
    report.title(f"frames: the droid at depth {depth}, 640 × 480, without a GPU")
    try:
        with driven() as driver, started(driver) as browser:
            for kind, error in (("even", None), ("max_error=3", 3)):
                path = setup.folder / f"{kind}.html"
                write_page(octex.convert(surface, depth, max_error=error), path, surface)
                page = opened(browser, file_url(path))
                for shown in ("unlit", "lit"):
                    seconds = median(page.evaluate(_FRAMES, [shown, setup.repeats])) / 1000
                    report.at_most(f"frames: {kind}, {shown}", seconds, 0.125, "s")
                page.close()
    except pytest.skip.Exception as why:
        report.note(f"frames: left out without a browser: {why}")


def _strokes(
    server: PaintServer, surface: octex.Surface, cell: float, strokes: list[tuple[float, int]]
) -> Iterator[Spent]:
    """Send discs, by the cells in the width of a pixel and the pixels across; yield what each takes."""
    toward = np.array(_TOWARD) / np.linalg.norm(_TOWARD)
    middle = surface.vertices[np.argmax(surface.vertices @ toward)]
    for number, (width, size) in enumerate(strokes, 1):
        corners = middle + 0.5 * width * cell * _VIEW[0] * np.array([[-1, 0, 0], [1, 0, 0]])
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


@contextmanager
def _served(folder: Path, texture: octex.OctreeTexture, surface: octex.Surface) -> Iterator[PaintServer]:
    folder.mkdir()
    texture.save(folder / "a.octex")
    octex.write_model(surface, folder / "a.glb")
    server = PaintServer(folder / "a.octex", folder / "a.glb", folder / "out.octex")
    server.wait(0)
    time.sleep(1.0)  # until all is compiled
    yield server
    server.end()
